"""Steps of a motion that end where the contact with a stop begins or ends.

A side of a stop is in contact if its penetration p and its force k p + c p' are positive. Its switching function is
g = min(p, k p + c p'). A switch is a change of the sign of g. Between two switches the equations are smooth, and a step of
order 8 is accurate. The time t of a switch has the derivative

    dt = -dg / g',      dg: change of g at a constant time

Derivatives of a motion with stops are therefore exact, even if the force of a damper makes the accelerations jump.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxvib.equations.dynamics import Dynamics
from jaxvib.machine.carrier import Machine
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.effects.supports import Side, Stop
from jaxvib.machine.effects.terms import SupportForce, Term

_MAX_SWITCHES = 16
"""Largest number of switches in a step; the rest of the step is then computed without further switches."""

_MAX_TRIALS, _ACCURACY = 60, 1e-13
"""Largest number of trials for the time of a switch, and its error relative to the length of the step."""

_NEAR_TURN = 0.2
"""The machine may approach a side of a stop and move away again within one step. A short contact is possible if the remaining
gap at the nearest point is less than this fraction of the approach. Both follow from a parabola with the rates at both ends of
the step."""

Step = Callable[[Array, Array, Array, Dynamics], Array]
"""Function of a time, a state, the length of a step, and equations of motion, that returns the state after the step."""


class FixedContactStop(Effect):
    """Stop with a fixed contact of each side: in contact or free at any displacement. Its force is therefore smooth.

    **Attributes**: `stop`; `presses` (s,): 1 for each of the s `sides` that is treated as in contact, otherwise 0.
    """

    stop: Stop
    presses: Array
    sides: tuple[Side, ...] = eqx.field(static=True)
    kind: str = eqx.field(static=True, default="fixed_contact_stop", kw_only=True)

    def terms(self) -> tuple[Term, ...]:
        """Return the force of spring and damper."""
        return (SupportForce(self.stop.rows, self.energy, self.resistance, is_smooth=True),)

    def penetrations(self, displacement: Array) -> Array:
        """Return the penetration (s,) of each side, m, at the `displacement` (k,), m."""
        return jnp.stack([self.stop.penetration(displacement, side)[0] for side in self.sides])

    def energy(self, displacement: Array) -> Array:
        """Return the energy of the sides in contact, J."""
        return 0.5 * self.stop.stiffness * jnp.sum(self.presses * self.penetrations(displacement) ** 2)

    def resistance(self, displacement: Array, velocity: Array) -> Array:
        """Return the force (k,) of the dampers of the sides in contact, N."""
        rates, back = jax.jvp(self.penetrations, (displacement,), (velocity,))[1], jax.vjp(self.penetrations, displacement)[1]
        return self.stop.damping * back(self.presses * rates)[0]


def with_fixed_contact(effect: Effect, machine: Machine) -> Effect:
    """Return a stop as a `FixedContactStop` without contact, and any other effect unchanged."""
    if not isinstance(effect, Stop):
        return effect
    sides: tuple[Side, ...] = ("above", "below") if effect.side == "both" and len(effect.rows(machine)) == 1 else (effect.side,)
    return FixedContactStop(effect, jnp.zeros(len(sides)), sides)


def _effects(dynamics: Dynamics) -> list[FixedContactStop]:
    return [effect for effect in dynamics.exciters[0].effects if isinstance(effect, FixedContactStop)]


def side_count(dynamics: Dynamics) -> int:
    """Return the number of sides of all stops."""
    return sum(len(stop.sides) for stop in _effects(dynamics))


def penetrations(dynamics: Dynamics, q: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return the penetrations (s,) of all sides, m, their rates (s,), and the switching functions (s,).

    **Arguments**: `q` and `v` (nd,): displacements and velocities of the coordinates.
    """
    found, effects = [], dynamics.exciters[0].effects
    placed = [effect for effect in effects for term in effect.terms() if isinstance(term, SupportForce)]
    for effect, support in zip(placed, dynamics.supports, strict=True):
        if isinstance(effect, FixedContactStop):
            depth, rate = jax.jvp(effect.penetrations, (support.rows @ q,), (support.rows @ v,))
            force = effect.stop.stiffness * depth + effect.stop.damping * rate
            found.append((depth, rate, jnp.minimum(depth, force)))
    depths, rates, switches = (jnp.concatenate(each) for each in zip(*found, strict=True))
    return depths, rates, switches


def contacts_at(dynamics: Dynamics, q: Array, v: Array) -> Array:
    """Return True (s,) for each side of a stop that is in contact."""
    return penetrations(dynamics, q, v)[2] > 0.0


def with_contacts(dynamics: Dynamics, presses: Array) -> Dynamics:
    """Return the equations in which the sides with `presses` (s,) True are in contact."""
    sizes = [len(stop.sides) for stop in _effects(dynamics)]
    ends = [sum(sizes[: k + 1]) for k in range(len(sizes))]
    parts = [presses[end - size : end].astype(float) for end, size in zip(ends, sizes, strict=True)]

    def places(dynamics: Any) -> list[Array]:
        (group,) = dynamics.groups
        return [effect.presses for effect in group.part.effects if isinstance(effect, FixedContactStop)]

    return eqx.tree_at(places, dynamics, parts)


def switched_step(
    step: Step, rates: Step, dynamics: Dynamics, t: Array, y: Array, presses: Array, h: Array
) -> tuple[Array, Array]:
    """Return the state after the time `h`, and True (s,) for the sides of stops that are in contact then.

    **Arguments**: `step`; `rates`: function of the same arguments, which returns the rates of the state; the time `t`; the
    state `y`, whose first entries are displacements and velocities; `presses` (s,): True for sides in contact at the time `t`.
    """
    nd = dynamics.stiffness_per_mass.shape[0]

    def switching(y: Array, presses: Array, dynamics: Dynamics) -> Array:
        """Return the switching functions (s,), with signs such that a value is positive after a switch: when the state and
        `presses` disagree about the contact of the side."""
        return jnp.where(presses, -1.0, 1.0) * penetrations(dynamics, y[:nd], y[nd : 2 * nd])[2]

    def advance(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        done, y, presses, count = state
        now, begin, rest = with_contacts(dynamics, presses), t + done, h - done
        fixed = lax.stop_gradient((begin, y, rest, now))
        search = _first_switch(step, rates, lambda y: switching(y, presses, fixed[3]), presses, *fixed)
        is_switch = search.is_found & (count < _MAX_SWITCHES)
        length = jnp.where(is_switch, search.length, rest)
        new = step(begin, y, length, now)
        values = switching(new, presses, now)
        side = jnp.argmax(lax.stop_gradient(values))
        slope = rates(*lax.stop_gradient((begin + length, new, length, now)))
        rate = jax.jvp(lambda y: switching(y, presses, fixed[3]), (lax.stop_gradient(new),), (slope,))[1][side]
        # The value of the correction is 0; its derivative is that of the time of the switch.
        correction = (lax.stop_gradient(values) - values)[side] * jnp.where(is_switch, 1.0 / rate, 0.0)
        presses = presses ^ (is_switch & (jnp.arange(presses.size) == side))
        done = jnp.where(is_switch, done + length + correction, h)
        return done, new + correction * slope, presses, count + 1

    start = jnp.zeros_like(h), y, presses, jnp.asarray(0)
    _, y, presses, _ = lax.while_loop(lambda state: state[0] < h, advance, start)
    return y, presses


def _time_of_turn(start: tuple[Array, Array], last: Array, presses: Array, h: Array) -> Array:
    """Return the time from the beginning of a step to the moment at which the machine is nearest to a free side of a stop, if a
    contact is possible at this moment, see `_NEAR_TURN`; otherwise 0.

    **Arguments**: penetrations (s,) and their rates at the `start`; the `last` rates (s,); length of the step.
    """
    depth, rate = start
    share = rate / jnp.where(rate == last, 1.0, rate - last)
    rise = 0.5 * rate * share * h
    is_near = ~presses & (rate > 0.0) & (last < 0.0) & (depth + (1.0 + _NEAR_TURN) * rise > 0.0)
    return jnp.min(jnp.where(is_near, share, 1.0)) * h * jnp.any(is_near)


class _SwitchSearch(NamedTuple):
    """State of the search for the first switch within a step, by Newton's method between bounds. Without a switch the search
    ends after the trials at the end of the step and at `_time_of_turn`.

    **Attributes**: `low` and `high`: bounds of the time from the beginning of the step to the switch; `length`: the next trial
    of this time; `is_final`: True if the search has ended; `is_found`: True if a trial was after a switch; `trials`: number of
    trials.
    """

    low: Array
    high: Array
    length: Array
    is_final: Array
    is_found: Array
    trials: Array


def _first_switch(
    step: Step,
    rates: Step,
    switching: Callable[[Array], Array],
    presses: Array,
    t: Array,
    y: Array,
    h: Array,
    dynamics: Dynamics,
) -> _SwitchSearch:
    """Return the completed search for the first switch within the time `h`; `switching`: function of a state, positive after a
    switch."""
    nd = dynamics.stiffness_per_mass.shape[0]
    start = penetrations(dynamics, y[:nd], y[nd : 2 * nd])[:2]

    def trial(at: _SwitchSearch) -> _SwitchSearch:
        new = step(t, y, at.length, dynamics)
        values, slopes = jax.jvp(switching, (new,), (rates(t + at.length, new, at.length, dynamics),))
        side = jnp.argmax(values)
        is_late = values[side] > 0.0
        # The end of the step is tried first, and then the moment at which the machine is nearest to a free side of a stop.
        turn = _time_of_turn(start, penetrations(dynamics, new[:nd], new[nd : 2 * nd])[1], presses, h)
        is_turn = (at.trials == 0) & ~is_late & (turn > 0.0)
        is_found = at.is_found | is_late
        low, high = jnp.where(is_late | is_turn, at.low, at.length), jnp.where(is_late, at.length, at.high)
        better = at.length - values[side] / slopes[side]
        better = jnp.where((better > low) & (better < high), better, 0.5 * (low + high))
        is_final = ~is_found | (jnp.abs(better - at.length) < _ACCURACY * h) | (at.trials > _MAX_TRIALS)
        return _SwitchSearch(low, high, jnp.where(is_turn, turn, better), is_final & ~is_turn, is_found, at.trials + 1)

    no = jnp.asarray(False)
    return lax.while_loop(lambda at: ~at.is_final, trial, _SwitchSearch(0.0 * h, h, h, no, no, jnp.asarray(0)))
