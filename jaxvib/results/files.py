"""Results in files: NumPy archives of arrays with a text that says where each belongs; nothing is ever unpickled."""

from __future__ import annotations

import dataclasses
import importlib
import json
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.errors import InputError, written
from jaxvib.results.fields import Plain, is_named_tuple
from jaxvib.results.status import is_status, member, status_names
from jaxvib.runtime.compat import enumeration_of

__all__ = ["load", "save"]

_LAYOUT = "result"
"""The archive's entry that holds the layout, a JSON text."""

_PACKAGES = ("jaxvib", "optimize")
"""Only classes of these packages are looked for."""

_FIRST_FORMAT = ("jaxvib.motion.run", "from_first_format")
"""What reads an archive without a layout: runs as the first versions wrote them."""


def save(result: eqx.Module, path: str | Path) -> Path:
    """Writes a result to a NumPy archive (".npz", added where it is missing) that `load` reads back bit for bit.

    Arrays are entries of the archive, a scene is a TOML text, all else stands in a JSON text.

    **Returns** the path written to. **Raises** `InputError` for a result that holds what cannot be written, and for a path that
    cannot be written to.
    """
    arrays: dict[str, np.ndarray] = {}
    layout = json.dumps(_encoded(result, arrays))
    path = Path(path)
    path = path if path.suffix == ".npz" else path.with_name(path.name + ".npz")
    with written(path):
        np.savez(path, **{_LAYOUT: np.asarray(layout)}, **arrays)  # pyright: ignore[reportArgumentType]
    return path


def load(path: str | Path) -> Any:
    """Reads a result written by `save`, of whatever class it is; runs of the first versions too.

    **Raises** `InputError` for a file that is missing, was not written by `save`, or holds a class that there is no more.

    >>> import pathlib, tempfile, jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> modes = jv.jam_modes(form.scene())
    >>> again = jv.load(modes.save(pathlib.Path(tempfile.mkdtemp()) / "modes"))
    >>> type(again).__name__, bool((again.stable == modes.stable).all())
    ('JamModes', True)
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            if _LAYOUT not in archive.files:
                module, name = _FIRST_FORMAT
                return getattr(importlib.import_module(module), name)(archive)
            return _decoded(json.loads(str(archive[_LAYOUT])), archive)
    except FileNotFoundError as error:
        raise InputError("path", f"is {str(path)!r}; there is no such file") from error
    except (KeyError, TypeError, ValueError, AttributeError, OSError, EOFError, ImportError, zipfile.BadZipFile) as error:
        if isinstance(error, InputError):
            raise
        raise InputError("path", f"is {str(path)!r}; it is no result written by save") from error


def _encoded(value: object, arrays: dict[str, np.ndarray]) -> Plain:
    """A value as JSON can hold it, its arrays put among `arrays` and named."""
    if value is None or (isinstance(value, (bool, int, float, str)) and not isinstance(value, np.generic)):
        return value
    if is_status(value):
        return {"status": _class(enumeration_of(value)), "names": _stored(status_names(value), arrays)}
    if dataclasses.is_dataclass(value):
        fields = {field.name: _encoded_field(field, value, arrays) for field in dataclasses.fields(value)}
        return {"class": _class(type(value)), "fields": fields}
    if isinstance(value, (jax.Array, np.ndarray, np.generic)):
        kind = "jax" if isinstance(value, jax.Array) else "scalar" if isinstance(value, np.generic) else "numpy"
        return {"array": _stored(np.asarray(value), arrays), "kind": kind}
    if isinstance(value, complex):
        return {"complex": [value.real, value.imag]}
    if is_named_tuple(value):
        return {"class": _class(type(value)), "entries": [_encoded(entry, arrays) for entry in value]}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_encoded(entry, arrays) for entry in value]}
    if isinstance(value, Mapping):
        return {"dict": [[name, _encoded(entry, arrays)] for name, entry in value.items()]}
    raise InputError("result", f"holds {value!r}, which no file can hold; save what it was made from")


def _encoded_field(field: dataclasses.Field, owner: object, arrays: dict[str, np.ndarray]) -> Plain:
    value = getattr(owner, field.name)
    return {"text": field.metadata["write"](value)} if "write" in field.metadata else _encoded(value, arrays)


def _stored(array: np.ndarray, arrays: dict[str, np.ndarray]) -> str:
    name = f"array{len(arrays)}"
    arrays[name] = array
    return name


def _class(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _decoded(value: Any, archive: Mapping[str, np.ndarray], metadata: Mapping[str, Any] | None = None) -> Any:
    """The value that `_encoded` made this of."""
    if not isinstance(value, dict):
        return value
    if "text" in value:
        assert metadata is not None
        return metadata["read"](value["text"])
    if "status" in value:
        return member(_found(value["status"]), archive[value["names"]])
    if "array" in value:
        array = archive[value["array"]]
        return jnp.asarray(array) if value["kind"] == "jax" else array[()] if value["kind"] == "scalar" else array
    if "complex" in value:
        return complex(*value["complex"])
    if "entries" in value:
        return _found(value["class"])(*(_decoded(entry, archive) for entry in value["entries"]))
    if "fields" in value:
        return _rebuilt(_found(value["class"]), value["fields"], archive)
    if "dict" in value:
        return {name: _decoded(entry, archive) for name, entry in value["dict"]}
    ((name, entries),) = value.items()
    return {"tuple": tuple, "list": list}[name](_decoded(entry, archive) for entry in entries)


def _rebuilt(kind: type, fields: Mapping[str, Plain], archive: Mapping[str, np.ndarray]) -> object:
    """An object with these fields as they were: a constructor would read units and check values once more."""
    whole = object.__new__(kind)
    for field in dataclasses.fields(kind):
        value = _decoded(fields[field.name], archive, field.metadata) if field.name in fields else field.default
        if value is dataclasses.MISSING:
            raise KeyError(field.name)
        object.__setattr__(whole, field.name, value)
    return whole


def _found(name: str) -> type:
    """The class of that name, where it was when the file was written, or else among the public names."""
    module, _, inner = name.partition(":")
    if module.split(".")[0] not in _PACKAGES or not inner.isidentifier():
        raise ValueError(f"{name} is no class of a result")
    try:
        found = getattr(importlib.import_module(module), inner)
    except (ImportError, AttributeError):
        found = getattr(sys.modules[module.split(".")[0]], inner)
    if not isinstance(found, type):
        raise ValueError(f"{name} is no class of a result")
    return found
