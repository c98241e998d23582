"""Damping given as a ratio or as a loss factor, as the constants of viscous dampers."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import TypeGuard

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError, counted, quoted
from jaxvib.units import Number, Numbers, number
from jaxvib.units.known import when_known

_NUMBER_PATTERN = r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
_RATIO = re.compile(_NUMBER_PATTERN + r"\s*%(?:\s*of\s+(.+))?")
_LOSS = re.compile(r"loss(?:\s+factor)?\s+" + _NUMBER_PATTERN + r"\s+at\s+(.+)")
_LOSS_ALONE = re.compile(r"loss(?:\s+factor)?\s+" + _NUMBER_PATTERN + r"\s*(%?)")


def damping_constants(damping: Numbers, field: str, stiffness: Array, mass: Callable[[], Array] | None = None) -> Numbers:
    """Return damping constants, N s/m, from values some of which are texts with a ratio or a loss factor.

        "5 %", "5 % of 250 kg":       c = 2 (0.05) sqrt(k m)
        "loss factor 0.1 at 16 Hz":   c = 0.1 k / (2 pi 16 Hz)

    A ratio is relative to the critical damping of the mass on this spring alone. Other values are returned unchanged.

    **Arguments**: `damping` of n springs, as a user gives it; `field` for messages; `stiffness` (n,) N/m; `mass`: function that
    returns the mass (n,) kg that each spring carries, None if a ratio must name it.

    **Raises** `InputError` for a negative ratio, for one without a mass, for a spring without stiffness, for a frequency
    without a unit, and for a list of another length.

    >>> import jax.numpy as jnp
    >>> damping_constants(["5 %", 7.0, "loss factor 0.1 at 100 rad/s"], "damping", jnp.full(3, 1e4), lambda: jnp.array(100.0))
    [100.0, 7.0, 10.0]
    """
    if isinstance(damping, (list, tuple)):
        k = jnp.broadcast_to(stiffness, (len(damping),)) if np.ndim(stiffness) == 0 else stiffness
        if not any(map(is_relative, damping)):
            return damping
        if len(damping) != np.size(k):
            raise InputError(field, f"has {counted(len(damping))}; the number of springs is {np.size(k)}")
        m = [None] * len(damping) if mass is None else jnp.broadcast_to(mass(), np.shape(k))
        return [_constant(value, f"{field}[{i}]", k[i], m[i]) for i, value in enumerate(damping)]
    if not is_relative(damping):
        return damping
    if np.ndim(stiffness) == 0:
        return _constant(damping, field, stiffness, None if mass is None else mass())
    return damping_constants([damping] * np.size(stiffness), field, stiffness, mass)


def is_relative(value: object) -> TypeGuard[str]:
    """Return True for a damping that is given as a ratio or as a loss factor."""
    return isinstance(value, str) and ("%" in value or value.strip().startswith("loss"))


def relative_dampings(value: object, name: str) -> dict[str, str]:
    """Return the dampings that a table of a scene file, or a `value` in it, gives as ratios or loss factors, by their names.

    >>> relative_dampings({"kind": "two_mass", "damping": ["3 %", 0], "link_damping": "2 %"}, "machine")
    {'machine.damping[0]': '3 %', 'machine.link_damping': '2 %'}
    """
    if is_relative(value):
        return {name: value}
    inner = {f"{name}.{key}": each for key, each in value.items()} if isinstance(value, Mapping) else {}
    inner |= {f"{name}[{k}]": each for k, each in enumerate(value)} if isinstance(value, list) else {}
    return {found: text for key, each in inner.items() for found, text in relative_dampings(each, key).items()}


def _constant(value: Number, field: str, stiffness: Array, mass: Array | None) -> Number:
    if not is_relative(value):
        return value
    ratio, loss = _RATIO.fullmatch(value.strip()), _LOSS.fullmatch(value.strip())
    if ratio is None and loss is None:
        if alone := _LOSS_ALONE.fullmatch(value.strip()):
            raise InputError(field, _frequency_problem(value, float(alone[1]) / (100.0 if alone[2] else 1.0), stiffness, mass))
        forms = "'5 %', '5 % of 250 kg', 'loss factor 0.1 at 16 Hz' or '40 N s/m'"
        raise InputError(field, f"is {quoted(value)}; write a damping as {forms}")
    size = float((ratio or loss)[1])  # pyright: ignore[reportOptionalSubscript]
    if not size >= 0.0:
        raise InputError(field, f"is {quoted(value)}; a damping must be at least 0")
    when_known(lambda k: _require_spring(k, field, value), stiffness)
    if loss is not None:
        if re.fullmatch(_NUMBER_PATTERN, loss[2]):
            raise InputError(field, f"is {quoted(value)}; write the frequency with its unit: {quoted(value.strip() + ' Hz')}")
        constant = size * stiffness / number(loss[2], "rad/s", field, low=0.0, open_low=True)
    else:
        assert ratio is not None
        carried = mass if ratio[2] is None else number(ratio[2], "kg", field, low=0.0, open_low=True)
        if carried is None:
            problem = "the ratio of the critical damping 2 sqrt(k m), which needs the mass m that this spring carries"
            remedy = f"write for example {quoted(value.strip() + ' of 250 kg')} for a body of 500 kg on two supports"
            raise InputError(field, f"is {quoted(value)}, {problem}; {remedy}")
        constant = 0.02 * size * jnp.sqrt(stiffness * carried)
    known = when_known(float, constant)
    return constant if known is None else known


def _frequency_problem(value: str, loss: float, stiffness: Array, mass: Array | None) -> str:
    """Return the message about a loss factor without a frequency, with the resonance on this spring if it is known."""
    resonance = None if mass is None else when_known(lambda k, m: float(jnp.sqrt(k / m) / (2.0 * jnp.pi)), stiffness, mass)
    place = "for a rotor, that of its resonance" if not resonance else f"at resonance on this spring it is {resonance:.4g} Hz"
    example = quoted(f"loss factor {loss:.6g} at {resonance or 16.0:.4g} Hz")
    return f"is {quoted(value)}, without the frequency of the vibration; write for example {example} ({place})"


def _require_spring(stiffness: float, field: str, value: str) -> None:
    if stiffness == 0.0:
        raise InputError(field, f"is {quoted(value)} of a spring without stiffness; write a number in N s/m")
