"""Natural units of a state, and the scaled difference of two states."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.state import ExciterState, Spin, State
from jaxvib.machine.effects.base import has_term, terms_of
from jaxvib.machine.effects.terms import DrillingSpinRelease, RotorImbalance, SlipRelease
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.runtime.devices import array_module
from jaxvib.runtime.programs import cached


@cached
def natural_units(scene: Scene) -> State:
    """Return the natural units of the state.

    - Displacements: the unbalance radius S/M, with the unbalance S of the loads, or that of the rotor if it is larger
    - Velocities: S/M times the rotor speed
    - Angles: 1 rad; rates of angles and the drilling spin: the rotor speed
    - Sliding velocities: the rotor speed times the distance of the loads from the axis
    - States of a motor: `Motor.state_units`
    """
    carrier, pairs = scene.machine.carrier(), [_exciter_units(exciter) for exciter in scene.exciters]
    unbalances = [unbalance for unbalances_of_exciter, _ in pairs for unbalance in unbalances_of_exciter]
    length = functools.reduce(jnp.maximum, unbalances) / jnp.mean(jnp.diagonal(carrier.mass))
    exciters = tuple(unit for _, unit in pairs)
    return jax.lax.stop_gradient(State(length, length * scene.top_speed, exciters=exciters))


def _exciter_units(exciter: Exciter) -> tuple[list[Array], ExciterState]:
    """Return the unbalances of an exciter, kg m, and the natural units of its state."""
    loads, speed, effects = exciter.loads, exciter.drive.speed, exciter.effects
    unbalances = [] if exciter.unbalance is None else [exciter.unbalance]
    arm = speed
    if loads is not None:
        across, up, *_ = loads.position(*loads.rest())
        arm = jnp.sqrt(jnp.mean(jnp.square(across)) + jnp.mean(jnp.square(up)))
        unbalances.append(loads.count * (jnp.mean(loads.mass) * arm))
    for term in terms_of(effects, RotorImbalance):
        unbalances.append(jnp.sqrt(sum(x**2 for x in term.at(jnp.zeros_like(arm)).static)))
    ones = jnp.ones_like(speed)
    rotor = None if exciter.drive.ideal else (ones, speed, *exciter.drive.state_units())
    if loads is None:
        return unbalances, ExciterState(rotor=rotor)
    drilling = speed if has_term(effects, DrillingSpinRelease) else None
    slip = (speed * arm,) if has_term(effects, SlipRelease) else None
    spin = None if drilling is None and slip is None else Spin(drilling, slip)
    return unbalances, ExciterState((ones,), (speed,), rotor, spin)


def error_scale(state: State, unit: State) -> State:
    """Return the scales by which differences between states are divided, a scalar for each part of the `State`.

    The scale of displacements, of velocities and of the drilling spin is their largest modulus in one or several states, but at
    least the natural `unit`, because these values of a machine at rest are 0. The scale of all other parts is the natural unit.
    """
    xp = array_module((state, unit))

    def largest(x: Array, least: Array) -> Array:
        return xp.maximum(xp.max(xp.abs(xp.asarray(x))), xp.asarray(least))

    def scale(exciter_state: ExciterState, unit: ExciterState) -> ExciterState:
        spin = None
        if unit.spin is not None and exciter_state.spin is not None:
            drilling, slip = unit.spin.drilling, unit.spin.slip
            slip = None if slip is None else tuple(xp.asarray(slip[0]) for _ in exciter_state.angle)
            own = exciter_state.spin.drilling  # it can grow without bound
            spin = Spin(None if drilling is None or own is None else largest(own, drilling), slip)
        return ExciterState(
            tuple(xp.asarray(unit.angle[0]) for _ in exciter_state.angle),
            tuple(xp.asarray(unit.rate[0]) for _ in exciter_state.rate),
            None if unit.rotor is None else tuple(map(xp.asarray, unit.rotor)),
            spin,
        )

    return State(
        largest(state.displacement, unit.displacement),
        largest(state.velocity, unit.velocity),
        exciters=tuple(map(scale, state.exciters, unit.exciters)),
    )


def scaled_error(a: State, b: State, scale: State) -> Array:
    """Return the largest difference between the entries of two states, or two sequences of states, relative to the
    `error_scale` of its part; NaN if one of them is not finite.

    >>> import numpy as np, jaxvib as jv
    >>> a, b = (jv.State(np.array([x]), np.zeros(1), (np.array([3.0]),), (np.array([50.0]),)) for x in (2e-3, 1e-3))
    >>> unit = jv.State(1e-4, 5e-3, (1.0,), (50.0,))
    >>> float(scaled_error(a, b, error_scale(a, unit))), float(scaled_error(a, b, error_scale(b, unit)))
    (0.5, 1.0)
    """
    xp = array_module((a, b, scale))

    def relative_difference(x: Array, y: Array, unit: Array) -> Array:
        with np.errstate(invalid="ignore"):  # the states of a run that did not finish are NaN
            return xp.max(xp.abs(xp.asarray(x) - xp.asarray(y))) / xp.asarray(unit)

    return xp.max(xp.stack(jax.tree.leaves(jax.tree.map(relative_difference, a, b, scale))))


def estimated_error(
    difference: Array,
    share: Array | np.ndarray | float,
    scene: Scene,
    steps: Array | int = 0,
    radians: Array | np.ndarray | int = 0,
    *,
    ends_at_jumps: bool = True,
) -> Array:
    """Estimate the error of a run from its `difference` to a run with larger steps.

        difference * share + 2 eps (steps + radians)

    If an effect or a drive is not smooth, or if the acceleration of a drive jumps within a step (not if the step
    `ends_at_jumps`), the share is 2 instead of that of a smooth motion: the error then depends on the positions of the steps
    relative to the kinks and jumps, and both runs may have the same error. Rounding adds 2 eps for each step and for each
    radian of the fastest motion, whose phase depends on rounded times. `ensemble` omits this term, because equal steps cause
    much smaller rounding errors.
    """
    is_smooth = not scene.not_smooth and (ends_at_jumps or not any(exciter.drive.jump_ts() for exciter in scene.exciters))
    factor = share if is_smooth else 2.0
    return difference * factor + 2.0 * float(np.finfo(scene.top_speed.dtype).eps) * (steps + radians)


def with_nearest_turns(state: State, to: State) -> State:
    """Return a state (or several states) with angles shifted by whole turns so that they are nearest to the angles of `to`.

    In single precision the integration keeps angles within one turn; one of two nearly equal runs may then have one turn more.

    >>> import numpy as np, jaxvib as jv
    >>> a, b = (jv.State(np.zeros(1), np.zeros(1), (np.array([phi]),), (np.array([50.0]),)) for phi in (3.1, -3.1))
    >>> round(float(with_nearest_turns(a, b).angle[0][0]), 4)
    -3.1832
    """
    xp = array_module((state, to))

    def near(x: Array, y: Array) -> Array:
        return x + 2.0 * np.pi * xp.round((y - x) / (2.0 * np.pi))

    def shifted(exciter_state: ExciterState, to: ExciterState) -> ExciterState:
        rotor = None
        if exciter_state.rotor is not None and to.rotor is not None:
            rotor = (near(exciter_state.rotor[0], to.rotor[0]), *exciter_state.rotor[1:])
        return ExciterState(tuple(map(near, exciter_state.angle, to.angle)), exciter_state.rate, rotor, exciter_state.spin)

    return State(state.displacement, state.velocity, exciters=tuple(map(shifted, state.exciters, to.exciters)))
