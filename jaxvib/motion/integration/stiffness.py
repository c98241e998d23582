"""Stiff scenes: decay rates that are much faster than the motion, and the method and the steps of their runs."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import LinearModel, linear_model
from jaxvib.equations.sliding import kinematics
from jaxvib.equations.state import State
from jaxvib.machine.effects.base import has_term, terms_of
from jaxvib.machine.effects.terms import LoadInteraction, SupportForce
from jaxvib.machine.loads import Loads
from jaxvib.machine.scene import Scene
from jaxvib.motion.integrate import effects_rate, frequency_bounds, motor_poles
from jaxvib.numerics.linalg import hermitian_modes, relative_to
from jaxvib.ode.rodas4 import Rodas4
from jaxvib.runtime.programs import cached

_MAX_DECAY_PER_STEP = 3.0
"""Largest product of decay rate and length of an explicit step for which the method is accurate."""

_MAX_STABLE_DECAY_PER_STEP = 5.1
"""Largest product of decay rate and length of an explicit step for which the method is stable; above 5.17 it diverges."""

_MAX_CONTACT_PER_STEP = 1.0
"""Largest product of the rate during a contact and the length of a step, about a third of a contact, for which runs do not
diverge. The stages of a step in which a damper begins to act amplify its force."""

_DAMPER_FACTOR = 4.0
"""Number of equal steps per decay time of a damper, for each step per radian of a vibration. The force of the damper begins
within a step; the error is then proportional to the length of the step. With 16 steps per decay time it is about 1 % of the
force."""

_MAX_RADIANS_PER_STEP = {False: 2.0, True: 0.5}
"""Largest number of radians of a smooth motion in an explicit step, or in an implicit one (True), for which amplitudes have
errors below about 1 %."""

_STIFF_RATE_RATIO = 100.0
"""Ratio of the rates of decay and motion above which the implicit method takes less time than explicit steps."""

IMPLICIT_STEPS_PER_RADIAN = 32.0
"""Number of equal implicit steps per radian of the fastest motion; the method of order 4 then has an error of about 4e-9 in a
turn."""

_MAX_IMPLICIT_SIZE = 64
"""Largest size of a state for which the implicit method, with dense matrices, takes less time than explicit steps."""


@cached
def fastest_decay(scene: Scene) -> Array:
    """Return the fastest decay rate, 1/s, due to the machine with its loads, `machine_decay`, or to a motor, `motor_poles`."""
    drives = [exciter.drive for exciter in jax.lax.stop_gradient(scene).exciters if not exciter.drive.ideal]
    return functools.reduce(jnp.maximum, [machine_decay(scene), *(jnp.max(-motor_poles(drive).real) for drive in drives)])


@cached
def machine_decay(scene: Scene) -> Array:
    """Return the fastest decay rate, 1/s, due to the drag of the loads or the damping of carrier and supports: the larger of

        max_j(-Q'_j / H_j) / (1 - mu sum_j m_j / kappa_j)   and   the largest eigenvalue of M^-1 C

    C contains the largest damping of nonlinear supports (`SupportForce.damping`).
    Q' is the derivative of the resistance of a load with respect to its rate, H its inertia, mu the trace of P M^-1 P^T with
    the rows P of the mount (the motion of the carrier reduces the effective inertia of the loads). The denominator is at least
    0.1. Explicit steps must resolve this rate, even if the motion is slow.
    """
    scene = jax.lax.stop_gradient(scene)
    linear = linear_model(scene)
    damping, inverse = relative_to(linear.mass, _damping(linear))
    rates = [
        _load_decay(exciter.loads, exciter.drive.speed, jnp.sum((mount.rows[0] @ inverse.T) ** 2))
        for exciter, mount in zip(scene.exciters, linear.mounts, strict=True)
        if exciter.loads is not None
    ]
    return functools.reduce(jnp.maximum, [*rates, jnp.max(hermitian_modes(damping)[0])])


def _damping(linear: LinearModel) -> Array:
    """Return the damping of the carrier and the largest damping of its nonlinear supports, (nd, nd) N s/m."""
    damping = linear.carrier.damping
    for term, rows in zip(terms_of(linear.scene.effects, SupportForce), linear.supports, strict=True):
        damping = damping if term.damping is None else damping + term.damping * rows.T @ rows
    return damping


def _load_decay(loads: Loads, speed: Array, accelerance: Array) -> Array:
    """Return the fastest decay rate due to the drag of the loads of an exciter, 1/s; `accelerance`: mu of its mount, 1/kg."""
    angle = tuple(jnp.broadcast_to(jnp.asarray(x, speed.dtype), (loads.count,)) for x in loads.rest())
    turning = tuple(jnp.full_like(x, speed) if i == 0 else jnp.zeros_like(x) for i, x in enumerate(angle))
    kappa, metric = loads.inertia_factor(), kinematics(loads, angle, turning).metric

    def own(i: int) -> Array:
        along = tuple(jnp.ones_like(x) if k == i else jnp.zeros_like(x) for k, x in enumerate(angle))
        slope = jax.jvp(lambda *rate: loads.resistance(angle, rate, speed)[i], turning, along)[1]
        return jnp.max(-slope / (kappa * loads.mass * metric[i][i]))

    share = accelerance * jnp.sum(jnp.broadcast_to(loads.mass / kappa, (loads.count,)))
    return functools.reduce(jnp.maximum, (own(i) for i in range(len(angle)))) / jnp.maximum(1.0 - share, 0.1)


def stiff_solver(scene: Scene, state: State, fastest: Array | np.ndarray) -> Rodas4 | None:
    """Return the implicit method if it takes less time than explicit steps, otherwise None."""
    is_small = sum(np.size(leaf) for leaf in jax.tree.leaves(state)) <= _MAX_IMPLICIT_SIZE
    return Rodas4() if is_small and float(fastest_decay(scene)) > _STIFF_RATE_RATIO * float(fastest) else None


def fastest_motion(scene: Scene, per_contact: float = 1.0) -> Array:
    """Return the fastest rate that equal steps must resolve, rad/s: that of `frequency_bounds`, or that of a contact, see
    `contact_rate`, multiplied by `per_contact`."""
    fastest = frequency_bounds(scene)[0]
    return fastest if (contact := contact_rate(scene)) is None else jnp.maximum(fastest, per_contact * contact)


def contact_rate(scene: Scene) -> Array | None:
    """Return the fastest rate during a contact with a stop or between loads, rad/s; None for a scene without contacts.

        w^2 = fastest^2 + k max(P M^-1 P^T)   or   w = 4 c max(P M^-1 P^T)   on a stop,    `Effect.fastest_rate` between loads

    k and c are the stiffness and the damping of the stop; P maps q to its displacements. The force of the damper begins within
    a step. The implicit method, whose Jacobian is that before the contact, must therefore resolve c, too.
    """
    if not has_contacts(scene):
        return None
    scene, rates = jax.lax.stop_gradient(scene), []
    if has_term(scene.all_effects, LoadInteraction):
        rates.append(effects_rate(scene, LoadInteraction))
    for _, vibration, decay in _rates_on_stops(scene):
        rates += [vibration] if decay is None else [vibration, _DAMPER_FACTOR * decay]
    return functools.reduce(jnp.maximum, rates)


@cached
def sampling_rate(scene: Scene) -> Array:
    """Return the number of samples per second that resolves the forces of stops; 0 without stops on the foundation.

    It is 8 for each period of the vibration on a stop, and 2 for each decay time of its damper, see `contact_rate`.
    """
    scene = jax.lax.stop_gradient(scene)
    rates = [jnp.zeros_like(scene.top_speed)]
    for term, vibration, decay in _rates_on_stops(scene):
        if not term.is_link:
            rates += [8.0 * vibration / (2.0 * np.pi), *([] if decay is None else [2.0 * decay])]
    return functools.reduce(jnp.maximum, rates)


def _rates_on_stops(scene: Scene) -> list[tuple[SupportForce, Array, Array | None]]:
    """Return each stop, the rate of the vibration on it, rad/s, and the decay rate of its damper, 1/s, None without one."""
    fastest, linear, rates = frequency_bounds(scene)[0], linear_model(scene), []
    for term, rows in zip(terms_of(scene.effects, SupportForce), linear.supports, strict=True):
        if term.stiffness is not None:
            accelerance = _largest_accelerance(linear, rows)
            decay = None if term.contact_damping is None else term.contact_damping * accelerance
            rates.append((term, jnp.sqrt(fastest**2 + term.stiffness * accelerance), decay))
    return rates


def has_contacts(scene: Scene) -> bool:
    """Return True if a scene has stops, or loads that touch each other."""
    stops = (term.stiffness is not None for term in terms_of(scene.effects, SupportForce))
    return any(stops) or has_term(scene.all_effects, LoadInteraction)


def _largest_accelerance(linear: LinearModel, rows: Array) -> Array:
    """Return the largest eigenvalue of P M^-1 P^T, 1/kg, with the `rows` P of a support."""
    return jnp.max(hermitian_modes(rows @ jnp.linalg.solve(linear.mass, rows.T))[0])


def rate_at(scene: Scene, displacements: Array) -> Array:
    """Return the fastest rate, rad/s, that equal steps must resolve at `displacements` q (n, nd) of a run.

        w^2 = fastest^2 + sum of k max(P M^-1 P^T)

    k is the largest eigenvalue of the second derivative of the energy of a support at P q. The sum is over the supports
    whose stiffness has no limit, such as `CubicSupport`. Stops are not included, see `contact_rate`.
    """
    fastest, linear = frequency_bounds(scene)[0], None
    square = fastest**2
    for k, term in enumerate(terms_of(scene.effects, SupportForce)):
        if term.stiffness is None:
            linear = linear_model(scene) if linear is None else linear
            rows = linear.supports[k]
            stiffness = jax.vmap(jax.hessian(term.energy))(displacements @ rows.T)
            largest = jnp.max(jax.vmap(lambda matrix: hermitian_modes(matrix)[0])(stiffness))
            square = square + jnp.maximum(largest, 0.0) * _largest_accelerance(linear, rows)
    return jnp.sqrt(square)


def equal_step_length(fastest: float, decay: float, per_radian: float, step: float | None = None) -> tuple[float, bool]:
    """Return the length of equal steps, s, and True if implicit steps are necessary, for the `fastest` rate of the motion,
    rad/s, the fastest `decay`, 1/s, a number of explicit steps `per_radian` of the motion, or a prescribed length `step`, s."""
    if step is not None:
        return step, decay * step > _MAX_DECAY_PER_STEP
    if decay > _STIFF_RATE_RATIO * fastest:
        return 1.0 / (IMPLICIT_STEPS_PER_RADIAN * fastest), True
    return 1.0 / max(per_radian * fastest, decay / _MAX_DECAY_PER_STEP), False


def is_unresolved(decay: Array | np.ndarray, step: Array | float) -> Array | np.ndarray:
    """Return True if explicit steps of the length `step`, s, diverge because of the decay rate `decay`, 1/s."""
    return decay * step > _MAX_STABLE_DECAY_PER_STEP


def resolves_contact(contact: Array, step: Array | float) -> Array:
    """Return True if steps of the length `step`, s, are short enough for the rate during a `contact`, see `contact_rate`."""
    return contact * step <= _MAX_CONTACT_PER_STEP


def resolves(scene: Scene, step: float, displacements: Array, *, implicit: bool) -> Array:
    """Return True if steps of the length `step`, s, resolve contacts and the motion at `displacements` (n, nd), m or rad."""
    is_resolved = rate_at(scene, displacements) * step <= _MAX_RADIANS_PER_STEP[implicit]
    contact = contact_rate(scene)
    return is_resolved if contact is None else is_resolved & resolves_contact(contact, step)


def advice_on_stiffness(scene: Scene) -> str:
    """Return the cause of short steps as the end of a sentence; "" if no decay is more than 10 times as fast as the motion."""
    decay, motion = float(fastest_decay(scene)), float(frequency_bounds(scene)[0])
    if not decay > 10.0 * motion:
        return ""
    vibrations = ("machine.damping makes vibrations", "friction at a support (force/width) makes vibrations")
    causes = (*vibrations, "loads.drag makes speeds of loads")
    rates = (*_carrier_decays(scene), machine_decay(scene))
    name = next((cause for cause, rate in zip(causes, rates, strict=True) if float(rate) >= decay), None)
    name = name or "a motor makes its speed or its currents"
    return (
        f"; {name} decay at {decay:.2g} 1/s, {decay / motion:.1g} times as fast as the motion: use a "
        "smaller value, or the default solver"
    )


@cached
def _carrier_decays(scene: Scene) -> tuple[Array, ...]:
    """Return the fastest decay rates due to the damping of the carrier without and with its nonlinear supports, 1/s."""
    linear = linear_model(scene)
    squares = (relative_to(linear.mass, damping)[0] for damping in (linear.carrier.damping, _damping(linear)))
    return tuple(jnp.max(hermitian_modes(square)[0]) for square in squares)
