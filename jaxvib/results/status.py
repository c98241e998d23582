"""Statuses: the name of one, its sentence, and the error that is raised for it."""

from __future__ import annotations

from typing import TypeGuard, TypeVar

import equinox as eqx
import jax
import numpy as np

from jaxvib.errors import ComputationError
from jaxvib.runtime.compat import enumeration_names, enumeration_of
from jaxvib.runtime.devices import on_device

__all__ = ["Computed", "failure", "is_status", "member", "sentence", "status_name", "status_names"]


Status = TypeVar("Status", bound=eqx.Enumeration)


class Computed(eqx.Enumeration):
    """The status of a result that cannot fail once its input is accepted."""

    done = "the answer was computed"


def is_status(value: object) -> TypeGuard[eqx.Enumeration]:
    """True if a value is a member of an enumeration, or an array of members."""
    return isinstance(value, type(Computed.done))


def member(enumeration: type[Status], names: str | np.ndarray) -> Status:
    """The member of that name; of an array of names (any shape) as many, on JAX's device.

    >>> bool(member(Computed, "done") == Computed.done)
    True
    """
    of_name = {name: k for k, name in enumerate(enumeration_names(enumeration))}
    numbers = np.vectorize(of_name.__getitem__, otypes=[np.int32])(names)
    return jax.tree.unflatten(jax.tree.structure(getattr(enumeration, next(iter(of_name)))), [on_device(numbers)])


def status_names(status: eqx.Enumeration) -> np.ndarray:
    """The name of each member in a status of any shape, an array of text of that shape.

    **Raises** `TypeError` for a status that is not known yet, under a JAX transformation.
    """
    (numbers,) = jax.tree.leaves(status)
    try:
        numbers = np.asarray(numbers)
    except jax.errors.TracerArrayConversionError as error:
        raise TypeError("a status under a JAX transformation has no name yet; read it outside of jit, grad and vmap") from error
    return np.asarray(enumeration_names(enumeration_of(status)))[numbers]


def status_name(status: eqx.Enumeration) -> str:
    """The name of a single status.

    >>> status_name(Computed.done)
    'done'
    """
    return str(status_names(status))


def sentence(status: eqx.Enumeration) -> str:
    """Sentence of a status; of several, each sentence once with its number of occurrences.

    >>> sentence(Computed.done)
    'the answer was computed'
    """
    names = status_names(status)
    enumeration = enumeration_of(status)
    if names.ndim == 0:  # by its name: a status that went through NumPy is no member any more
        return enumeration[getattr(enumeration, str(names))]
    counts = {name: int(np.sum(names == name)) for name in enumeration_names(enumeration)}
    parts = [f"{enumeration[getattr(enumeration, name)]} ({k} of {names.size})" for name, k in counts.items() if k]
    return "; ".join(parts) or "no members"


def failure(status: eqx.Enumeration, hint: str = "") -> ComputationError:
    """The error to raise for a single status: its name, its sentence, and a `hint` that follows the sentence."""
    return ComputationError(status_name(status), sentence(status) + hint)
