"""Files of results: NumPy archives of arrays, with a JSON text that describes the structure of the result.

Reading is safe: nothing is unpickled, and only classes that jaxvib and optimize define are allowed. Objects are rebuilt from
their fields without a call of their constructors, and named tuples from their entries. An archive contains a digest of its
contents.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import io
import json
import math
import sys
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.boundary import validated
from jaxvib.errors import CONTROL, InputError, open_regular, quoted, with_ending, written
from jaxvib.results.fields import Plain, is_named_tuple
from jaxvib.results.status import is_status, member, status_names
from jaxvib.runtime.compat import enumeration_of

_LAYOUT, _DIGEST = "result", "digest"
"""Names of archive entries: the layout, which is a JSON text, and the digest of the layout and all arrays."""

_PACKAGES = ("jaxvib", "optimize")
"""Packages whose classes a file may name."""

_KINDS = "biufcUS"
"""Kinds of NumPy's types that a file may contain: numbers, Booleans and texts."""


def save(result: eqx.Module, path: str | Path) -> Path:
    """Write a result to a NumPy archive that `load` reads back bit for bit; ".npz" is appended to the name if it is missing.

    Arrays are entries of the archive, a scene is stored as a TOML text, and everything else in a JSON text. An existing file is
    replaced when the new one is complete.

    **Returns** the path of the file. **Raises** `InputError` for a result with a value that cannot be stored, and for a path
    that cannot be written to.
    """
    arrays: dict[str, np.ndarray] = {}
    layout = json.dumps(_encoded(result, arrays))
    path = with_ending(path, ".npz")
    head = {_LAYOUT: np.asarray(layout), _DIGEST: np.asarray(_digest(layout, arrays))}
    with written(path) as part, part.open("wb") as file:
        np.savez(file, **head, **arrays)  # pyright: ignore[reportArgumentType]
    return path


@validated
def load(path: str | Path) -> Any:
    """Read a result of any class that was written by `save`.

    **Arguments**: `path` of the file, ".npz".

    **Returns** the result, bit for bit the same.

    **Raises** `InputError` for a file that is missing, was not written by `save`, was changed since, or names a class that no
    longer exists.

    >>> import pathlib, tempfile, jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> modes = jv.jam_modes(form.scene())
    >>> again = jv.load(modes.save(pathlib.Path(tempfile.mkdtemp()) / "modes"))
    >>> type(again).__name__, bool((again.stable == modes.stable).all())
    ('JamModes', True)
    """
    try:
        with open_regular(path) as file:
            arrays = _arrays(file)
        layout, digest = (str(arrays.pop(name, "")) for name in (_LAYOUT, _DIGEST))
        if digest != _digest(layout, arrays):
            raise ValueError("changed after it was saved")
        result = _decoded(json.loads(layout), arrays)
        if not isinstance(result, eqx.Module):
            raise ValueError("not a result")
        return result
    except FileNotFoundError as error:
        raise InputError("path", f"is {quoted(str(path))}; there is no such file") from error
    except OSError as error:
        raise InputError("path", f"is {quoted(str(path))}, which cannot be read ({error.strerror or error})") from error
    except _READ_ERRORS as error:
        raise InputError("path", f"is {quoted(str(path))}; it is not a result written by save") from error


_READ_ERRORS = (
    ArithmeticError, AssertionError, AttributeError, EOFError, ImportError, LookupError, MemoryError, RuntimeError,
    TypeError, ValueError, zipfile.BadZipFile,
)  # fmt: skip
"""Errors that the reading of a file with arbitrary content may raise; `RecursionError` is a `RuntimeError`."""


def _arrays(file: Any) -> dict[str, np.ndarray]:
    """Return the arrays of an archive by name.

    **Raises** an error of `_READ_ERRORS` if an entry is compressed, or if the entries are larger than the file: a few bytes of
    such an entry could expand to more than the memory can hold.
    """
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        size = file.seek(0, io.SEEK_END)
        if sum(entry.file_size for entry in entries) > size or any(e.compress_type != zipfile.ZIP_STORED for e in entries):
            raise ValueError("compressed")
        return {entry.filename.removesuffix(".npy"): _array(archive.read(entry)) for entry in entries}


def _array(content: bytes) -> np.ndarray:
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, kind = read(stream)
    begin = stream.tell()
    if kind.kind not in _KINDS or math.prod(shape) * kind.itemsize != len(content) - begin:
        raise ValueError("no array of numbers or text")
    array = np.ndarray(shape, kind, bytearray(content), begin, order="F" if is_fortran else "C")
    if kind.kind == "U" and CONTROL.search("".join(array.ravel().tolist())):
        raise ValueError("control characters")
    return array


def _digest(layout: str, arrays: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256(layout.encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _encoded(value: object, arrays: dict[str, np.ndarray]) -> Plain:
    """Return a value in a form that JSON can represent. Its arrays are added to `arrays` and replaced by their names."""
    if isinstance(value, str):
        _require_legible(str(value))
    if value is None or (isinstance(value, (bool, int, float, str)) and not isinstance(value, np.generic)):
        return value
    if is_status(value):
        return {"status": _class(enumeration_of(value), eqx.Enumeration), "names": _stored(status_names(value), arrays)}
    if dataclasses.is_dataclass(value):
        fields = {field.name: _encoded_field(field, value, arrays) for field in dataclasses.fields(value)}
        return {"class": _class(type(value), object), "fields": fields}
    if isinstance(value, (jax.Array, np.ndarray, np.generic)):
        kind = "jax" if isinstance(value, jax.Array) else "scalar" if isinstance(value, np.generic) else "numpy"
        return {"array": _stored(np.asarray(value), arrays), "kind": kind}
    if isinstance(value, complex):
        return {"complex": [value.real, value.imag]}
    if is_named_tuple(value):
        return {"class": _class(type(value), tuple), "entries": [_encoded(entry, arrays) for entry in value]}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_encoded(entry, arrays) for entry in value]}
    if isinstance(value, Mapping):
        return {"dict": [[_encoded(name, arrays), _encoded(entry, arrays)] for name, entry in value.items()]}
    raise InputError("result", f"contains {quoted(value)}, which cannot be saved; save the data from which it was computed")


def _encoded_field(field: dataclasses.Field, owner: object, arrays: dict[str, np.ndarray]) -> Plain:
    value = getattr(owner, field.name)
    if "write" not in field.metadata:
        return _encoded(value, arrays)
    double = any(getattr(leaf, "dtype", None) == np.float64 for leaf in jax.tree.leaves(value))
    text = field.metadata["write"](value)
    try:
        with jax.enable_x64(double):
            field.metadata["read"](text)
    except InputError as error:
        problem = f"contains a {field.name} that load could not read; for a batch of results, save each of them"
        raise InputError("result", f"{problem}, jax.tree.map(lambda x: x[0], result)") from error
    return {"text": text, "double": double}


def _stored(array: np.ndarray, arrays: dict[str, np.ndarray]) -> str:
    if array.dtype.kind not in _KINDS:
        raise InputError(
            "result",
            f"contains an array of the type {array.dtype}, which cannot be saved; save the data from which it was computed",
        )
    if array.dtype.kind == "U":
        _require_legible("".join(array.ravel().tolist()))
    name = f"array{len(arrays)}"
    arrays[name] = array
    return name


def _require_legible(text: str) -> None:
    found = CONTROL.search(text)
    if found is not None:
        problem = f"contains the control character {quoted(found[0])} in {quoted(text)}"
        raise InputError("result", f"{problem}, which cannot be saved; delete it in the name or text from which it comes")


def _class(kind: type, base: type) -> str:
    """Return the name of a class in files. **Raises** `InputError` for a class that `load` would refuse."""
    name = f"{kind.__module__}:{kind.__qualname__}"
    try:
        _class_named(name, base)
    except (ValueError, AttributeError, LookupError) as error:
        problem = f"contains an object of the class {kind.__qualname__}, which cannot be saved"
        raise InputError("result", f"{problem}; save the data from which it was computed") from error
    return name


def _decoded(value: Any, arrays: Mapping[str, np.ndarray], read: Callable[[str], object] | None = None) -> Any:
    """Return the value that `_encoded` stored as `value`; `read` as in `as_text`, for a field that is stored as text."""
    if isinstance(value, str) and CONTROL.search(value):
        raise ValueError("control characters")
    if isinstance(value, list):
        raise ValueError("a list without its kind")
    if not isinstance(value, dict):
        return value
    match value:
        case {"text": str(text), "double": bool(double)} if read is not None:
            with jax.enable_x64(double):  # the precision in which it was saved
                return read(text)
        case {"status": str(name), "names": str(names)}:
            return member(_class_named(name, eqx.Enumeration), arrays[names])
        case {"array": str(name), "kind": "jax"}:
            with jax.enable_x64(True):  # otherwise JAX would convert arrays of double precision to single
                return jnp.asarray(arrays[name])
        case {"array": str(name), "kind": "scalar"}:
            return arrays[name][()]
        case {"array": str(name), "kind": "numpy"}:
            return arrays[name]
        case {"complex": [float(real), float(imag)]}:
            return complex(real, imag)
        case {"class": str(name), "entries": list(entries)}:
            return _class_named(name, tuple)(*(_decoded(entry, arrays) for entry in entries))
        case {"class": str(name), "fields": dict(fields)}:
            return _rebuilt(_class_named(name, object), fields, arrays)
        case {"dict": list(pairs)}:
            return {_decoded(name, arrays): _decoded(entry, arrays) for name, entry in pairs}
        case {"tuple": list(entries)}:
            return tuple(_decoded(entry, arrays) for entry in entries)
        case {"list": list(entries)}:
            return [_decoded(entry, arrays) for entry in entries]
        case _:
            raise ValueError("unknown layout")


def _rebuilt(kind: type, fields: Mapping[str, Plain], arrays: Mapping[str, np.ndarray]) -> object:
    """Return an object with these stored fields; its constructor, which would convert and check them again, is not called."""
    instance = object.__new__(kind)
    for field in dataclasses.fields(kind):
        is_stored = field.name in fields
        value = _decoded(fields[field.name], arrays, field.metadata.get("read")) if is_stored else field.default
        if value is dataclasses.MISSING:
            raise KeyError(field.name)
        object.__setattr__(instance, field.name, value)
    return instance


def _class_named(name: str, base: type) -> Any:
    """Return the class with a name in a file, from its module or, if it has moved, from the public names of the package.
    **Raises** `ValueError` for a class of another package, and for one that is not of the kind of `base`: a named tuple for
    `tuple`, a dataclass for `object`, a status for `equinox.Enumeration`."""
    module, _, inner = name.partition(":")
    if module.split(".")[0] not in _PACKAGES or not inner.isidentifier():
        raise ValueError(f"{name} is not a class of a result")
    try:
        found = getattr(importlib.import_module(module), inner)
    except (ImportError, AttributeError):
        found = getattr(sys.modules[module.split(".")[0]], inner)
    is_ours = isinstance(found, type) and issubclass(found, base) and found.__module__.split(".")[0] in _PACKAGES
    is_kind = {tuple: hasattr(found, "_fields"), object: dataclasses.is_dataclass(found)}.get(base, True)
    if not (is_ours and is_kind):
        raise ValueError(f"{name} is not a class of a result")
    return found
