"""Checks of values that are not known if JAX is transforming the computation (jit, grad, vmap)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import PyTree

from jaxvib.errors import ComputationError, InputError
from jaxvib.runtime.compat import traced

T = TypeVar("T")


def is_known(*trees: PyTree) -> bool:
    """Return True if no value in the trees is traced.

    >>> is_known({"mass": 1.0}, None)
    True
    """
    return not any(traced(leaf) for leaf in jax.tree.leaves(trees))


def when_known(check: Callable[..., T], *values: PyTree) -> T | None:
    """Return `check(*values)` of the values as Python numbers and NumPy arrays, or None if one of the values is traced.

    >>> when_known(lambda mass: mass > 0.0, np.asarray(2.0))
    True
    """
    return check(*jax.tree.map(_plain, values)) if is_known(values) else None


def require_if_known(allowed: Callable[..., object], *values: PyTree, field: str, problem: str) -> None:
    """Raise `InputError` if the values are known and `allowed(*values)` is False; `problem` is formatted with the values.

    >>> require_if_known(lambda gap, tube: gap < tube, 1.0, 2.0, field="gap", problem="is {:g} m; the tube has {:g} m")
    """

    def check(*known: Any) -> None:
        if not allowed(*known):
            raise InputError(field, problem.format(*known))

    when_known(check, *values)


def _plain(leaf: object) -> object:
    array = np.asarray(leaf)
    return array.item() if array.ndim == 0 else array


def require_known(tree: PyTree, field: str, caller: str, instead: str) -> None:
    """Raise `InputError` if a value in `tree` is traced. The message names the argument `field`, the function `caller`,
    which needs the values, and the remedy `instead`.
    """
    if not is_known(tree):
        problem = f"contains values that JAX is transforming (jit, grad, vmap, ...), but {caller} needs their values"
        raise InputError(field, f"{problem}; {instead}")


def require_finite(what: str, *trees: PyTree) -> None:
    """Raise `ComputationError` with the status "overflow" if a known value in `trees` is NaN or infinite.

    >>> require_finite("the torques", np.asarray([1.0, np.inf]))
    Traceback (most recent call last):
        ...
    jaxvib.errors.ComputationError: overflow: the torques are not finite; check the largest and the smallest numbers
    """
    if is_known(trees) and not all(np.all(np.isfinite(np.asarray(leaf))) for leaf in jax.tree.leaves(trees)):
        raise ComputationError("overflow", f"{what} are not finite; check the largest and the smallest numbers")
