"""Type aliases for diffrax's solvers and step size controllers, with the names that diffrax uses."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import diffrax
import numpy as np
from jax import Array
from jaxtyping import PyTree

RealScalarLike: TypeAlias = int | float | Array | np.ndarray
"""Real number, or an array of shape (); for example a time, a tolerance or an order."""

IntScalarLike: TypeAlias = int | Array | np.ndarray
"""Integer, or an integer array of shape (); for example a direction."""

BoolScalarLike: TypeAlias = bool | Array | np.ndarray
"""Boolean: a Python value, or an array of shape ()."""

Y: TypeAlias = PyTree[Array]
"""State of the integration, as any tree of arrays; its errors and changes are trees of the same structure."""

VF: TypeAlias = PyTree[Array]
"""The rates of a state: a tree with the structure of the state."""

Args: TypeAlias = PyTree
"""Arguments of a vector field in addition to the time and the state."""

Terms: TypeAlias = PyTree[diffrax.AbstractTerm]
"""The equations; all methods here take a single term."""

DenseInfo: TypeAlias = dict[str, PyTree[Array]]
"""Data of the interpolation of a step: a dictionary whose keys are the attribute names of the interpolation."""

StepResult: TypeAlias = tuple[Y, Y, DenseInfo, VF | None, diffrax.RESULTS]
"""The state at the end of a step, its error, its interpolation, the internal state of the method, and the success of the
step."""

Norm: TypeAlias = Callable[[PyTree[Array]], RealScalarLike]
"""The size of a tree of numbers."""

Tangents: TypeAlias = PyTree[Array | None]
"""A tree with the structure of the primal values. Each array has a last axis over the tangent directions; None replaces an
array of zeros."""

Batched: TypeAlias = PyTree[bool]
"""A tree with the structure of some values: True for each value that has an axis over the batch (`in_batched` of
`jax.custom_batching.custom_vmap`)."""
