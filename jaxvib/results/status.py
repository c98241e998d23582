"""Statuses: the name of one, its sentence, and the error that is raised for it."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxvib.errors import ComputationError

__all__ = [
    "Computed",
    "enumeration_of",
    "failure",
    "is_status",
    "member",
    "member_names",
    "sentence",
    "status_name",
    "status_names",
]


class Computed(eqx.Enumeration):
    """The status of a result that cannot fail once its input is accepted."""

    done = "the answer was computed"


def member_names(enumeration: type[eqx.Enumeration]) -> tuple[str, ...]:
    """The names of an enumeration's members in the order of their numbers.

    >>> member_names(Computed)
    ('done',)
    """
    # Equinox has no public way to the names; a test says so where this one goes.
    return tuple(enumeration._name_to_item)


def is_status(value: Any) -> bool:
    """Whether a value is a member of an enumeration, or an array of them."""
    return isinstance(value, type(Computed.done))


def enumeration_of(status: Any) -> Any:
    """The enumeration that a status is a member of."""
    return status._enumeration


def member(enumeration: Any, names: Any) -> Any:
    """The member of that name; of an array of names (any shape) as many, on JAX's device.

    >>> bool(member(Computed, "done") == Computed.done)
    True
    """
    of_name = {name: k for k, name in enumerate(member_names(enumeration))}
    numbers = jnp.asarray(np.vectorize(of_name.__getitem__, otypes=[np.int32])(names))
    return eqx.tree_at(lambda item: item._value, getattr(enumeration, next(iter(of_name))), numbers)


def status_names(status: Any) -> np.ndarray:
    """The name of each member in a status of any shape, an array of text of that shape.

    **Raises** `TypeError` for a status that is not known yet, under a JAX transformation.
    """
    if status.is_traced():
        raise TypeError("a status under a JAX transformation has no name yet; look at it outside")
    return np.asarray(member_names(enumeration_of(status)))[np.asarray(status._value)]


def status_name(status: Any) -> str:
    """The name of a single status.

    >>> status_name(Computed.done)
    'done'
    """
    return str(status_names(status))


def sentence(status: Any) -> str:
    """What a status says, a sentence; of several, each sentence once with how many say it.

    >>> sentence(Computed.done)
    'the answer was computed'
    """
    names = status_names(status)
    enumeration = enumeration_of(status)
    if names.ndim == 0:
        return enumeration[status]
    said = {name: int(np.sum(names == name)) for name in member_names(enumeration)}
    parts = [f"{enumeration[getattr(enumeration, name)]} ({k} of {names.size})" for name, k in said.items() if k]
    return "; ".join(parts) or "there is none"


def failure(status: Any, hint: str = "") -> ComputationError:
    """The error to raise for a single status: its name, its sentence, and a `hint` that follows the sentence."""
    return ComputationError(status_name(status), sentence(status) + hint)
