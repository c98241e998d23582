"""Store of a study on disk: labelled arrays in the Zarr format, written in chunks.

The values of a chunk are written first, then its statuses, and last its seal, a digest of all its files
(`jaxvib.sweeps.seals`). A chunk is finished if and only if its seal agrees with its files. Files are written atomically.
Reading a store executes no code from it (no pickle).
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import re
import shutil
import uuid
import warnings
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from jaxvib.code_changes import code_state, digest_of_sources
from jaxvib.errors import InputError, optional_module, quoted
from jaxvib.machine.files import Tables
from jaxvib.results.fields import Plain
from jaxvib.results.status import member, sentence
from jaxvib.runtime.operations import PYTHON
from jaxvib.sweeps import seals
from jaxvib.sweeps.axes import SAMPLE
from jaxvib.sweeps.definition import CASE_STATUSES, CaseStatus, Study, difference
from jaxvib.sweeps.measures import RunMeasure
from jaxvib.sweeps.program import Chunk

_FORMAT = 2
"""Version number of the layout of the store."""

_PACKAGES = ("jaxvib", "jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax", "numpy")
"""Packages whose versions may change the last digits of a result."""


class ChunkState(IntEnum):
    """State of a chunk on disk: not computed or incomplete, finished, or with changed files."""

    missing = 0
    finished = 1
    damaged = 2


def versions() -> dict[str, str]:
    """Return the versions of all packages on which a result depends, and a digest of the sources of jaxvib.

    The digest also shows whether parts of jaxvib were replaced in this process.
    """
    changed = "" if code_state(compare=True).is_on_disk else " with changes in this process"
    return {name: importlib.metadata.version(name) for name in _PACKAGES} | {"sources": digest_of_sources()[:16] + changed}


class Store:
    """Open store.

    **Attributes**: `path`; `attributes` of the whole store, such as the versions of packages; `record` of the study, see
    `Study`; `arrays` by name; `shape`: number of cases along each dimension; `tile`: number of cases of a chunk along each
    dimension; `names` of the measures; `dims`: names of the dimensions.
    """

    def __init__(self, path: Path, writable: bool = False):
        zarr = optional_module("zarr", "sweep")
        self.path = path
        if not os.path.exists(path):  # `Path.exists` raises an error for long names
            raise InputError("store", f"is {quoted(str(path))}; there is no such store")
        changed = seals.changed_layout(path)
        if changed is not None:
            raise self.damaged(changed)
        try:
            self.group = zarr.open_group(path, mode="r+" if writable else "r", zarr_format=3)
            self.attributes: Tables = dict(self.group.attrs)
            if self.attributes.get("jaxvib_sweep") != _FORMAT:
                raise InputError("store", f"is {quoted(str(path))}, which is not the store of a sweep; name another one")
            self.record: Tables = self.attributes["study"]
            # Chunks of placeholders are written too, because a missing file counts as damage.
            with zarr.config.set({"array.write_empty_chunks": True}):
                self.arrays = {name: self.group[name] for name in self.group.array_keys()}
            self.shape = tuple(self.group["status"].shape)
            self.tile = tuple(int(n) for n in self.record["tile"])
            self.names = tuple(self.record["measure"])
            self.dims = list(self.group["status"].metadata.dimension_names)
        except InputError:
            raise
        except Exception as error:  # for damaged files zarr and its codecs raise errors of any type
            raise self.damaged(f"{type(error).__name__}: {error}") from error

    def damaged(self, what: str) -> InputError:
        """Return the error for a folder that is not a store, or for a damaged store; `what`: the reason."""
        return InputError(
            "store", f"is {quoted(str(self.path))}, which is not the store of a sweep, or is damaged ({what}); give another one"
        )

    @classmethod
    def create(cls, path: Path, study: Study) -> None:
        """Create the empty store of a study atomically. If another process has created the store in the meantime, nothing is
        changed."""
        zarr = optional_module("zarr", "sweep")
        part = path.with_name(f".{uuid.uuid4().hex}.partial")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # zarr warns that consolidated metadata are an extension of the format
                _fill(zarr, part, study)
                zarr.consolidate_metadata(part)
            seals.seal_layout(part)
            os.rename(part, path)
        except OSError as error:
            if not os.path.exists(path / seals.FOLDER):  # False for a name that is too long, unlike `Path.exists`
                raise cannot_write(path, error) from error
        finally:
            shutil.rmtree(part, ignore_errors=True)

    @property
    def coordinates(self) -> int:
        """Number of coordinates of the scene's machine."""
        return int(self.attributes["coordinates_of_machine"])

    def require_same(self, study: Study) -> None:
        """**Raises** `InputError` if the store belongs to another study or to other versions of the packages."""
        if (change := difference(json.loads(json.dumps(study.record)), self.record)) is not None:
            name, mine, its = change
            part = re.split(r"[.\[]", name)[0]
            problem = f"is {str(self.path)!r}, which contains another study: its {part} differs"
            detail = "" if part == name else f" ({name} is {_short(its)} in the store and {_short(mine)} here)"
            if study.program.startswith(PYTHON):
                detail = " (a measure calls Python from its program, whose results cannot be compared)"
            elif name == "program":
                detail = " (a parameter of the scene, the function of a measure, or a value to which it refers)"
            raise InputError("store", f"{problem}{detail}; name another store, or run the study of this store")
        for name, version in versions().items():
            if self.attributes["versions"].get(name) != version:
                begun = f"was created with {name} {self.attributes['versions'].get(name)}, and this is {version}"
                raise InputError("store", f"{begun}: digits may differ; continue with that version, or name another store")

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the store for writing. **Raises** `InputError` if another process or thread is writing."""
        with contextlib.ExitStack() as stack:
            try:
                is_mine = stack.enter_context(seals.locked(self.path))
            except OSError as error:
                raise cannot_write(self.path, error) from error
            if not is_mine:
                problem = f"is {str(self.path)!r}, into which another sweep is writing"
                raise InputError("store", f"{problem}; wait until that has ended, or name another store")
            yield

    @property
    def tiles(self) -> tuple[int, ...]:
        """Number of chunks along each dimension."""
        return tuple(-(-n // t) for n, t in zip(self.shape, self.tile, strict=True))

    def region(self, chunk: int) -> tuple[slice, ...]:
        """Return the slices of a chunk's cases along the dimensions."""
        first = [int(k) * t for k, t in zip(np.unravel_index(chunk, self.tiles), self.tile, strict=True)]
        return tuple(slice(a, min(a + t, n)) for a, t, n in zip(first, self.tile, self.shape, strict=True))

    def _files(self, chunk: int) -> dict[str, Path]:
        """Return the files of a chunk by array name: sampled numbers, measures, errors, statuses."""
        place = tuple(int(k) for k in np.unravel_index(chunk, self.tiles))
        files: dict[str, Path] = {}
        for name in (*self.sampled, *self.names, "error", "status"):
            indices = place[-1:] if name in self.sampled else place
            extra = len(self.arrays[name].shape) - len(self.shape) if name in self.names else 0
            files[name] = self.path / name / "c" / "/".join(str(k) for k in (*indices, *([0] * extra)))
        return files

    @property
    def sampled(self) -> tuple[str, ...]:
        """Names of the axes whose numbers are sampled."""
        return tuple(str(self.attributes.get("coordinates", "")).split())

    def states(self, *, writing: bool = False) -> np.ndarray:
        """Read every file once and return the `ChunkState` (chunks,) of each chunk.

        **Arguments**: `writing`: True if this process has the lock.
        """
        busy = not writing and seals.is_locked(self.path)
        return np.asarray([self._state(chunk, busy) for chunk in range(int(np.prod(self.tiles, dtype=np.int64)))], int)

    def _state(self, chunk: int, busy: bool) -> ChunkState:
        files = self._files(chunk)
        sealed = seals.is_sealed(self.path, chunk, files)
        if sealed:
            return ChunkState.finished
        if busy or (sealed is None and not files["status"].exists() and self._is_readable(chunk, files)):
            return ChunkState.missing
        return ChunkState.damaged

    def _is_readable(self, chunk: int, files: dict[str, Path]) -> bool:
        """Return True if the files that an interrupted process has written for a chunk can be read, or if there are none."""
        if not any(file.exists() for file in files.values()):
            return True
        region = self.region(chunk)
        try:
            for name in files:
                self.group[name][region[-1:] if name in self.sampled else region]
        except Exception:  # any error of zarr and its codecs
            return False
        return True

    def clear(self, chunk: int) -> None:
        """Remove the files of a damaged chunk. The seal is removed first; after an interruption the chunk then counts as
        missing."""
        try:
            for file in (seals.seal_of(self.path, chunk), *reversed(self._files(chunk).values())):
                shutil.rmtree(file) if file.is_dir() and not file.is_symlink() else file.unlink(missing_ok=True)
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def require_whole(self) -> None:
        """**Raises** `InputError` if a chunk is damaged."""
        bad = np.flatnonzero(self.states() == ChunkState.damaged)
        if bad.size:
            problem = f"is {str(self.path)!r}, in which {bad.size} of {int(np.prod(self.tiles))} chunks are damaged"
            advice = "run the study again, which computes them again"
            raise InputError("store", f"{problem}, the first of them chunk {bad[0]}; {advice}")

    def write(self, study: Study, chunk: int, cases: Chunk) -> None:
        """Write a chunk: its values, then its statuses, then its seal, which marks it as finished."""
        region = study.grid.region(chunk)
        shape = tuple(s.stop - s.start for s in region)
        try:
            if study.grid.samples:
                drawn = study.grid.sampled_values(region[-1])
                for k, name in enumerate(self.sampled):
                    self.arrays[name][region[-1]] = drawn[:, k]
            for name, leaf in cases.values.items():
                self.arrays[name][region] = leaf.reshape(*shape, *leaf.shape[1:])
            if cases.errors:
                sentences = np.full(int(np.prod(shape)), "", dtype=object)
                for place, words in cases.errors.items():
                    sentences[place] = words
                self.group["error"][region] = sentences.reshape(shape)
            self.arrays["status"][region] = cases.status.reshape(shape)
            seals.seal(self.path, chunk, self._files(chunk))
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def counts(self, states: np.ndarray) -> np.ndarray:
        """Return the number of cases with each status, in the order of `CASE_STATUSES`.

        Cases of chunks that are not finished count as missing.
        """
        total = np.zeros(len(CASE_STATUSES), np.int64)
        finished = (states == ChunkState.finished).reshape(self.tiles)
        for rows in self.pieces():
            is_finished = finished[rows.start // self.tile[0] : -(-rows.stop // self.tile[0])]
            if np.all(is_finished):
                total += self._count_statuses(rows)
                continue
            for place in np.argwhere(is_finished):
                place[0] += rows.start // self.tile[0]
                total += self._count_statuses(self.region(int(np.ravel_multi_index(tuple(place), self.tiles))))
        total[0] += int(np.prod(self.shape, dtype=np.int64)) - np.sum(total)
        return total

    def _count_statuses(self, region: slice | tuple[slice, ...]) -> np.ndarray:
        return np.bincount(self._values("status", region).ravel(), minlength=len(CASE_STATUSES))[: len(CASE_STATUSES)]

    def pieces(self) -> list[slice]:
        """Return slices of the first dimension; each has whole chunks: one row of them, or several with at most about a million
        cases."""
        cases_per_row = max(int(np.prod(self.shape[1:], dtype=np.int64)), 1)
        rows = max(1, (1 << 20) // (cases_per_row * self.tile[0])) * self.tile[0]
        return [slice(k, min(k + rows, self.shape[0])) for k in range(0, self.shape[0], rows)]

    def read(self, name: str, region: slice | tuple[slice, ...] = slice(None)) -> np.ndarray:
        """Return the values of an array. **Raises** `InputError` if a chunk of the store is damaged."""
        if not self.is_whole:
            self.require_whole()
            self.is_whole = True
        return self._values(name, region)

    is_whole = False

    def _values(self, name: str, region: slice | tuple[slice, ...]) -> np.ndarray:
        try:
            return np.asarray(self.group[name][region])
        except (OSError, RuntimeError, ValueError, TypeError, KeyError) as error:
            raise self.damaged(f"{name}: {error}") from error


def _short(value: Plain) -> str:
    text = json.dumps(value)
    return text if len(text) < 80 else f"{text[:60]} ..."


def cannot_write(path: Path, error: OSError) -> InputError:
    """Return the error for a store that cannot be written. Its finished chunks are not affected."""
    reason = error.strerror or str(error)
    advice = "make room or name another store; finished chunks are kept; run the same command again to continue"
    return InputError("store", f"is {quoted(str(path))}, which cannot be written ({reason}); {advice}")


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
        array_attributes = {key: value for key, value in more.items() if key != "fill" and value}
        return group.create_array(
            name,
            shape=shape,
            chunks=chunks,
            dtype=kind,
            dimension_names=dims,
            fill_value=more["fill"],
            attributes=array_attributes,
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
        is_integer = np.issubdtype(form.dtype, np.integer) and not isinstance(measure, RunMeasure)
        kind, fill = (form.dtype, np.nan) if real else (form.dtype if is_integer else np.dtype("i2"), -1)
        add(name, (*grid.dims, *extra), (*grid.shape, *form.shape), (*grid.tile, *form.shape), kind, fill=fill, **more)
        for dim, size in zip(extra, form.shape, strict=True):
            if dim not in group and len(extra_names.get(dim, ())) == size:
                add(dim, (dim,), (size,), (size,), str, fill="")[:] = np.asarray(extra_names[dim], dtype=object)
    add("error", grid.dims, grid.shape, grid.tile, str, fill="", long_name="reason why a case failed")
    meanings = {
        "flag_values": list(range(len(CASE_STATUSES))),
        "flag_meanings": " ".join(CASE_STATUSES),
        "sentences": [sentence(member(CaseStatus, name)) for name in CASE_STATUSES],
    }
    add("status", grid.dims, grid.shape, grid.tile, "u1", fill=0, long_name="outcome of a case", **meanings)
