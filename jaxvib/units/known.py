"""Checks of numbers that have no value if JAX is transforming the computation (jit, grad, vmap)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np
from jaxtyping import PyTree

from jaxvib.errors import InputError
from jaxvib.runtime.compat import traced

T = TypeVar("T")


def is_known(*trees: PyTree) -> bool:
    """Return True if every number in the trees has a value. Modules that plan a computation call it once per computation.

    >>> is_known({"mass": 1.0}, None)
    True
    """
    return not any(traced(leaf) for leaf in jax.tree.leaves(trees))


def when_known(check: Callable[..., T], *values: PyTree) -> T | None:
    """Return `check(*values)` of the values as Python numbers and NumPy arrays, or None if one of the numbers is traced.

    >>> when_known(lambda mass: mass > 0.0, np.asarray(2.0))
    True
    """
    return check(*jax.tree.map(_plain, values)) if is_known(values) else None


def _plain(leaf: object) -> object:
    array = np.asarray(leaf)
    return array.item() if array.ndim == 0 else array


def require_known(tree: PyTree, field: str, asking: str, instead: str) -> None:
    """Raise `InputError` if a number in `tree` has no value.

    The message names the argument `field`, the function `asking`, which needs the value in Python, and the remedy `instead`.
    """
    if not is_known(tree):
        problem = f"holds numbers that JAX is transforming (jit, grad, vmap, ...), but {asking} needs their values in Python"
        raise InputError(field, f"{problem}; {instead}")
