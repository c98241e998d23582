"""Statuses: their names, their sentences, and the errors that are raised for them."""

from __future__ import annotations

from typing import TypeGuard, TypeVar

import equinox as eqx
import jax
import numpy as np

from jaxvib.errors import ComputationError
from jaxvib.runtime.compat import enumeration_names, enumeration_of
from jaxvib.runtime.devices import on_device

Status = TypeVar("Status", bound=eqx.Enumeration)


class Computed(eqx.Enumeration):
    """Status of a result whose computation cannot fail if its input is valid."""

    done = "the result was computed"


def is_status(value: object) -> TypeGuard[eqx.Enumeration]:
    """Return True for a member of an enumeration or an array of members."""
    return isinstance(value, type(Computed.done))


def member(enumeration: type[Status], names: str | np.ndarray) -> Status:
    """Return the member with a name, or an array of members for an array of names of any shape, on JAX's device.

    >>> bool(member(Computed, "done") == Computed.done)
    True
    """
    of_name = {name: k for k, name in enumerate(enumeration_names(enumeration))}
    numbers = np.vectorize(of_name.__getitem__, otypes=[np.int32])(names)
    return jax.tree.unflatten(jax.tree.structure(getattr(enumeration, next(iter(of_name)))), [on_device(numbers)])


def status_names(status: eqx.Enumeration) -> np.ndarray:
    """Return the names of the members of a status as an array of the same shape. **Raises** `TypeError` for a traced status."""
    (numbers,) = jax.tree.leaves(status)
    try:
        numbers = np.asarray(numbers)
    except jax.errors.TracerArrayConversionError as error:
        raise TypeError("a status under a JAX transformation has no name yet; read it outside of jit, grad and vmap") from error
    return np.asarray(enumeration_names(enumeration_of(status)))[numbers]


def status_name(status: eqx.Enumeration) -> str:
    """Return the name of a single status.

    >>> status_name(Computed.done)
    'done'
    """
    return str(status_names(status))


def sentence(status: eqx.Enumeration) -> str:
    """Return the sentence of a status; for several statuses, each sentence once with its number of occurrences.

    >>> sentence(Computed.done)
    'the result was computed'
    """
    names = status_names(status)
    enumeration = enumeration_of(status)
    if names.ndim == 0:  # the member is found by its name, because a status converted to NumPy is not equal to a member
        return enumeration[getattr(enumeration, str(names))]
    counts = {name: int(np.sum(names == name)) for name in enumeration_names(enumeration)}
    parts = [f"{enumeration[getattr(enumeration, name)]} ({k} of {names.size})" for name, k in counts.items() if k]
    return "; ".join(parts) or "no members"


def failure(status: eqx.Enumeration, hint: str = "") -> ComputationError:
    """Return the error for a single status, with its name, its sentence, and a `hint` that follows the sentence."""
    return ComputationError(status_name(status), sentence(status) + hint)
