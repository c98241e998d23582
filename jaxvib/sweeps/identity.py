"""Comparison of plain data that describe studies."""

from __future__ import annotations

import hashlib
import json

from jaxvib.results.fields import Plain


def digest(value: Plain) -> str:
    """Return a digest of plain data, a string of 32 hexadecimal digits."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:32]


def difference(one: Plain, other: Plain, name: str = "") -> tuple[str, Plain, Plain] | None:
    """Return the path of the first difference between two plain values, and both entries there; None for equal values."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        pairs = [(f"{name}.{key}" if name else key, one[key], other[key]) for key in one]
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = [(f"{name}[{k}]", a, b) for k, (a, b) in enumerate(zip(one, other, strict=True))]
    else:  # compared as strings, because 1 == 1.0 == True in Python
        return None if json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True) else (name, one, other)
    return next((found for key, a, b in pairs if (found := difference(a, b, key))), None)
