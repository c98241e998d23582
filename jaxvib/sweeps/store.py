"""The store of a study on disk: labelled arrays in Zarr's format, written chunk by chunk, each chunk whole or not at all.

Numbers of a chunk are written first, its statuses last: a chunk is finished if, and only if, its statuses are there. Every
file appears at once under its name. Nothing is ever unpickled.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from jaxvib.errors import InputError
from jaxvib.machine.files import Tables
from jaxvib.results.fields import Plain
from jaxvib.results.status import member, sentence
from jaxvib.sweeps.axes import SAMPLE
from jaxvib.sweeps.definition import Study
from jaxvib.sweeps.measures import RunMeasure
from jaxvib.sweeps.program import Chunk
from jaxvib.sweeps.status import CASE_STATUSES, CaseStatus

__all__ = ["Store", "require_zarr", "versions"]

_FORMAT = 1
"""Of the store; another number is another layout."""

_PACKAGES = ("jaxvib", "jax", "jaxlib", "equinox", "diffrax", "numpy")
"""Whose versions may change the last digits of a result."""


def require_zarr() -> ModuleType:
    """The module zarr. **Raises** `InputError` where it is not installed."""
    try:
        import zarr
    except ImportError as error:
        raise InputError("sweep", "needs zarr and xarray; install them with: pip install 'jaxvib[sweep]'") from error
    return zarr


def versions() -> dict[str, str]:
    """The versions of all that a result's last digits depend on."""
    return {name: importlib.metadata.version(name) for name in _PACKAGES}


class Store:
    """A store that was opened, or made.

    **Attributes**: `path`; `attributes` the record of it: the study, versions, seed; `arrays` by name.
    """

    def __init__(self, path: Path, writable: bool = False):
        zarr = require_zarr()
        self.path = path
        if not path.exists():
            raise InputError("store", f"is {str(path)!r}; there is no such store")
        try:
            self.group = zarr.open_group(path, mode="r+" if writable else "r", zarr_format=3)
            self.attributes: Tables = dict(self.group.attrs)
            if self.attributes.get("jaxvib_sweep") != _FORMAT:
                raise InputError("store", f"is {str(path)!r}, which is no store of a sweep; name another one")
            self.record: Tables = self.attributes["study"]
            # Where a chunk has no answer at all its file is written too: one that is missing is a damage.
            with zarr.config.set({"array.write_empty_chunks": True}):
                self.arrays = {name: self.group[name] for name in self.group.array_keys()}
            self.shape = tuple(self.group["status"].shape)
            self.tile = tuple(int(n) for n in self.record["tile"])
            self.names = tuple(self.record["measure"])
            for name in (*self.names, "error", "status"):
                array = self.group[name]
                if tuple(array.shape[: len(self.shape)]) != self.shape or array.chunks[: len(self.tile)] != self.tile:
                    raise ValueError(name)
        except InputError:
            raise
        except Exception as error:  # whatever zarr and its codecs say of files that are not what they should be
            raise self.damaged(f"{type(error).__name__}: {error}") from error

    def damaged(self, what: str) -> InputError:
        """The error to raise for a store that cannot be used."""
        return InputError(
            "store", f"is {str(self.path)!r}, which is no store of a sweep, or a damaged one ({what}); name another"
        )

    @classmethod
    def made(cls, path: Path, study: Study) -> Store:
        """A store of a study, with nothing in it yet: it appears whole, or not at all."""
        zarr = require_zarr()
        part = path.with_name(f"{path.name}.{os.getpid()}.partial")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that metadata in one place are an extension of the format
                _fill(zarr, part, study)
                zarr.consolidate_metadata(part)
            os.rename(part, path)
        except OSError as error:
            raise cannot_write(path, error) from error
        finally:
            shutil.rmtree(part, ignore_errors=True)
        return cls(path, writable=True)

    @property
    def coordinates(self) -> int:
        """How many coordinates the scene's machine has."""
        return int(self.attributes["coordinates_of_machine"])

    def require_same(self, study: Study) -> None:
        """**Raises** `InputError` where the store is of another study, or was begun with other versions."""
        mine, its = json.loads(json.dumps(study.record)), self.record
        for name in mine:
            if mine[name] != its.get(name):
                problem = f"is {str(self.path)!r}, which holds another study: its {name} differs"
                raise InputError("store", f"{problem}; name another store, or run the study that it was made by")
        for name, version in versions().items():
            if self.attributes["versions"].get(name) != version:
                begun = f"was begun with {name} {self.attributes['versions'].get(name)}, and this is {version}"
                raise InputError("store", f"{begun}: digits would differ; go on with that version, or name another store")

    def _file(self, name: str, place: tuple[int, ...], extra: int = 0) -> Path:
        return self.path / name / "c" / "/".join(str(k) for k in (*place, *([0] * extra)))

    def finished(self) -> np.ndarray:
        """Which chunks are finished, (chunks,). **Raises** `InputError` where files of one are missing or damaged."""
        tiles = tuple(-(-n // t) for n, t in zip(self.shape, self.tile, strict=True))
        found = np.zeros(int(np.prod(tiles, dtype=np.int64)), bool)
        extra = {name: len(self.group[name].shape) - len(self.shape) for name in self.names}
        for chunk in range(found.size):
            place = tuple(int(k) for k in np.unravel_index(chunk, tiles))
            if self._file("status", place).exists():
                found[chunk] = True
                for name in self.names:
                    if not self._file(name, place, extra[name]).exists():
                        raise self.damaged(f"{name} of chunk {chunk} is missing")
        return found

    def write(self, study: Study, chunk: int, cases: Chunk) -> None:
        """Writes a chunk: its numbers, then its statuses, which say that it is finished."""
        region = study.grid.region(chunk)
        shape = tuple(s.stop - s.start for s in region)
        try:
            if study.grid.samples:
                drawn = study.grid.drawn(region[-1])
                sampled = [axis.name for axis in study.grid.axes if axis.values is None]
                for k, name in enumerate(sampled):
                    self.arrays[name][region[-1]] = drawn[:, k]
            for name, leaf in cases.found.items():
                self.arrays[name][region] = leaf.reshape(*shape, *leaf.shape[1:])
            if cases.errors:
                said = np.full(int(np.prod(shape)), "", dtype=object)
                for place, words in cases.errors.items():
                    said[place] = words
                self.group["error"][region] = said.reshape(shape)
            self.arrays["status"][region] = cases.status.reshape(shape)
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def counts(self) -> np.ndarray:
        """How many cases have each status, in the order of `CASE_STATUSES`; read piece by piece."""
        total = np.zeros(len(CASE_STATUSES), np.int64)
        for rows in self.pieces():
            total += np.bincount(self.read("status", rows).ravel(), minlength=total.size)[: total.size]
        return total

    def pieces(self) -> list[slice]:
        """Slices of the first dimension, each of whole chunks and of about a million cases at most."""
        wide = max(int(np.prod(self.shape[1:], dtype=np.int64)), 1)
        rows = max(1, (1 << 20) // (wide * self.tile[0])) * self.tile[0]
        return [slice(k, min(k + rows, self.shape[0])) for k in range(0, self.shape[0], rows)]

    def read(self, name: str, region: slice | tuple[slice, ...] = slice(None)) -> np.ndarray:
        """Numbers of an array. **Raises** `InputError` for what is damaged."""
        try:
            return np.asarray(self.group[name][region])
        except (OSError, RuntimeError, ValueError, TypeError, KeyError) as error:
            raise self.damaged(f"{name}: {error}") from error


def cannot_write(path: Path, error: OSError) -> InputError:
    """The error to raise where a store cannot be written: finished chunks are safe all the same."""
    why = error.strerror or str(error)
    advice = "make room or name another store; chunks that are finished are kept, and the same command goes on from there"
    return InputError("store", f"is {str(path)!r}, which cannot be written ({why}); {advice}")


def _fill(zarr: ModuleType, path: Path, study: Study) -> None:
    from zarr.codecs import ZstdCodec

    grid = study.grid
    sampled = [axis for axis in grid.axes if axis.values is None]
    attributes: Tables = {
        "jaxvib_sweep": _FORMAT,
        "study": study.record,
        "versions": versions(),
        "key": study.key,
        "coordinates_of_machine": len(study.scene.machine.structure().coordinates),
    }
    coordinates = [axis.name for axis in sampled]
    if coordinates:
        attributes["coordinates"] = " ".join(coordinates)
    group = zarr.create_group(path, zarr_format=3, attributes=attributes)

    def add(
        name: str, dims: tuple[str, ...], shape: tuple[int, ...], chunks: tuple[int, ...], kind: object, **more: Plain
    ) -> Any:
        told = {key: value for key, value in more.items() if key != "fill" and value}
        return group.create_array(
            name,
            shape=shape,
            chunks=chunks,
            dtype=kind,
            dimension_names=dims,
            fill_value=more["fill"],
            attributes=told,
            compressors=ZstdCodec(level=1, checksum=True),
        )

    for axis in grid.axes:
        if axis.values is None:
            add(axis.name, (SAMPLE,), grid.shape[-1:], grid.tile[-1:], "f8", fill=np.nan, units=axis.unit)
        else:
            size = axis.values.shape
            add(axis.name, (axis.name,), size, size, "f8", fill=np.nan, units=axis.unit)[:] = axis.values
    extra_names: dict[str, tuple[str, ...]] = {"coordinate": study.scene.machine.structure().coordinates}
    for name, measure, form in zip(study.names, study.measures, study.forms, strict=True):
        extra = (measure.axis,) if isinstance(measure, RunMeasure) and measure.axis else ()
        real = np.issubdtype(form.dtype, np.inexact)
        more: dict[str, Plain] = {"units": measure.unit, "long_name": measure.words}
        if isinstance(measure, RunMeasure) and measure.meanings:
            more |= {"flag_values": list(range(len(measure.meanings))), "flag_meanings": " ".join(measure.meanings)}
        kind, fill = (form.dtype, np.nan) if real else (np.dtype("i2"), -1)
        add(name, (*grid.dims, *extra), (*grid.shape, *form.shape), (*grid.tile, *form.shape), kind, fill=fill, **more)
        for dim, size in zip(extra, form.shape, strict=True):
            if dim not in group and len(extra_names.get(dim, ())) == size:
                add(dim, (dim,), (size,), (size,), str, fill="")[:] = np.asarray(extra_names[dim], dtype=object)
    add("error", grid.dims, grid.shape, grid.tile, str, fill="", long_name="why a case failed")
    meanings = {
        "flag_values": list(range(len(CASE_STATUSES))),
        "flag_meanings": " ".join(CASE_STATUSES),
        "sentences": [sentence(member(CaseStatus, name)) for name in CASE_STATUSES],
    }
    add("status", grid.dims, grid.shape, grid.tile, "u1", fill=0, long_name="how a case ended", **meanings)
