"""What is read off a motion: amplitudes, jam speed, forces, energy."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.carrier import Carrier
from jaxvib.machine.drive import Motor
from jaxvib.machine.effects import Gravity
from jaxvib.machine.scene import Scene
from jaxvib.motion.dynamics import State, rotor_angle, rotor_speed, vector_field

__all__ = ["Measured", "Trajectory", "energy", "foundation_force", "measure", "power"]


class Trajectory(eqx.Module):
    """States at some times.

    **Attributes** (nt times): `time` (nt,) s; `state` a `State` whose arrays have a leading axis over the times;
    `foundation_force` (nt, nb) N, what the supports exert on the bed in its nb directions; `rotor_angle` (nt,) rad, but
    for whole turns, and `rotor_speed` (nt,) rad/s.
    """

    time: Array
    state: State
    foundation_force: Array
    rotor_angle: Array
    rotor_speed: Array


class Measured(eqx.Module):
    """A motion in numbers, over the last turns of a run.

    **Attributes**: `omega` mean speed of the loads over whole turns, rad/s; `load_speed` (count,) the same for each load;
    `amplitude` (nd,) m, of tilts rad, and `foundation_force` N, zero to peak, that is half of peak to peak, where it has two
    directions the root of the sum of both squares; `drift` the largest change of an amplitude from the first to the second half
    of those turns, relative to the largest amplitude, or of `omega` where that is more; `settled` whether it is below 1e-3.
    """

    omega: Array
    load_speed: Array
    amplitude: Array
    foundation_force: Array
    drift: Array

    @property
    def settled(self) -> Array:
        """Whether the motion repeats itself, as far as amplitudes and speed tell."""
        return self.drift < 1e-3

    def extent(self, scene: Scene) -> str:
        """Amplitudes and foundation force of the `scene` they belong to, a line for a person to read."""
        structure = scene.machine.structure()
        named = zip(structure.coordinates, self.amplitude, structure.units, strict=True)
        amplitude = ", ".join(f"{name} {float(a):.4g} {unit}" for name, a, unit in named)
        return f"amplitude, zero to peak: {amplitude}; foundation force {float(self.foundation_force):.4g} N"


def foundation_force(scene: Scene, state: State) -> Array:
    """Force of all supports on the bed, gravity excluded, (nb,) N: R = sum_i (k_i y_i + b_i y_i').

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> state = jv.State(jnp.array([1e-3]), jnp.array([0.1]), (jnp.zeros(1),), (jnp.zeros(1),))
    >>> float(jv.foundation_force(scene, state)[0])
    43.0

    Source: the antiphase paper, equation (7).
    """
    carrier = scene.machine.carrier()
    force = carrier.bed_stiffness @ state.displacement + carrier.bed_damping @ state.velocity
    for effect in scene.effects:
        rows = effect.place(carrier)
        if rows is not None:
            force = force + effect.support_force(rows @ state.displacement, rows @ state.velocity)
    return force


def energy(scene: Scene, state: State, t: Array | float = 0.0) -> Array:
    """Kinetic and potential energy of a state, J.

    E = q'.M q'/2 + q.K q/2 + sum_j [ m_j |B_j q' + p_j'|^2/2 + (kappa_j - 1) m_j |p_j'|^2/2 + V_j(u_j) ] + V(q)
        + theta' d'(theta).P q' + J_r theta'^2/2

    d what is out of balance in the rotor, J_r the inertia of a motor's rotor (an ideal drive has none). The time `t`, s, says
    where an ideal drive has its rotor; it matters to an imbalance alone.
    """
    carrier, loads = scene.machine.carrier(), scene.loads
    q, v = state.displacement, state.velocity
    p_rate = jax.jvp(loads.position, state.angle, state.rate)[1]
    at_load = _at_loads(carrier, v)
    total = [rate + at_load.get(axis, 0.0) for axis, rate in enumerate(p_rate)]
    own = loads.inertia_factor() - 1.0
    parts = [
        0.5 * (v @ carrier.mass @ v + q @ carrier.stiffness @ q),
        jnp.sum(0.5 * loads.mass * (sum(w**2 for w in total) + own * sum(w**2 for w in p_rate))),
    ]
    for effect in scene.effects:
        potential = effect.load_potential(loads, state.angle)
        if potential is not None:
            parts.append(jnp.sum(jnp.broadcast_to(potential, (loads.count,))))
        rows = effect.place(carrier)
        if rows is not None:
            parts.append(effect.support_potential(rows @ q))
    t = jnp.asarray(t, q.dtype)
    turn, rate = rotor_angle(scene.drive, t, state), rotor_speed(scene.drive, t, state)
    parts.append(rate * _throw_rate(scene, turn) @ v)
    if isinstance(scene.drive, Motor):
        parts.append(0.5 * scene.drive.inertia * rate**2)
    return sum(parts[1:], parts[0])


def power(scene: Scene, t: Array, state: State) -> tuple[Array, Array]:
    """Power that the rotor puts in, and power that dampers, drag and friction dissipate, W; dE/dt is their difference.

    P_in = speed T, T the motor's torque, or that which turns an ideal drive's rotor against loads and imbalance:
    T = sum_j M_j + d'(theta).P q'';    P_diss = q'.C q' + sum_j M_j (speed - phi_j') + what supports and contacts take,
    M_j = b_W R^2 (speed - phi_j') + friction
    """
    carrier, loads = scene.machine.carrier(), scene.loads
    turn, speed = rotor_angle(scene.drive, t, state), rotor_speed(scene.drive, t, state)
    acceleration = vector_field(scene)(t, state).velocity
    at_load = _at_loads(carrier, acceleration)
    torque = loads.resistance(state.angle, state.rate, speed)
    g = sum(effect.g for effect in scene.effects if isinstance(effect, Gravity))
    lost = [state.velocity @ carrier.damping @ state.velocity]
    for effect in scene.effects:
        friction = effect.friction(loads, state.angle, state.rate, speed, g)
        if friction is not None:
            torque = (torque[0] + friction.torque(at_load), *torque[1:])
        resistance = effect.load_resistance(loads, state.angle, state.rate)
        if resistance is not None:
            lost += [-jnp.sum(f * w) for f, w in zip(resistance, state.rate, strict=True)]
        rows = effect.place(carrier)
        if rows is not None:
            x, v = rows @ state.displacement, rows @ state.velocity
            resisting = effect.support_resistance(x, v)
            if resisting is not None:
                lost.append(resisting @ v)
    braking = jnp.sum(torque[0])
    lost += [speed * braking, *(-jnp.sum(f * w) for f, w in zip(torque, state.rate, strict=True))]
    if isinstance(scene.drive, Motor):
        supplied = speed * scene.drive.torque(speed)
    else:
        supplied = speed * (braking + _throw_rate(scene, turn) @ acceleration)
    return supplied, sum(lost[1:], lost[0])


def _at_loads(carrier: Carrier, rate: Array) -> dict[int, Array]:
    """Velocities (or accelerations) of the points that carry the loads, (count,) or shared, by axis."""
    port = carrier.port @ rate
    if carrier.stations is not None and carrier.tilt is not None:
        port = port[:, None] + (carrier.tilt @ rate)[:, None] * carrier.stations[None, :]
    return dict(zip(carrier.axes, port, strict=True))


def _throw_rate(scene: Scene, turn: Array) -> Array:
    """d'(theta).P (nd,) of the rotor's imbalance: the carrier's share of its momentum per speed of the rotor."""
    carrier = scene.machine.carrier()
    static, lean = carrier.port_at(0.0 if carrier.seat is None else carrier.seat), carrier.tilt
    row = jnp.zeros_like(carrier.mass[0])
    for effect in scene.effects:
        rate = jax.jvp(effect.throw, (turn,), (jnp.ones_like(turn),))[1]
        if rate is None:
            continue
        row = row + jnp.stack([rate.static[axis] for axis in carrier.axes]) @ static
        if lean is not None:
            row = row + jnp.stack([rate.lean[axis] for axis in carrier.axes]) @ lean
    return row


def trajectory(scene: Scene, times: Array, states: State) -> Trajectory:
    """States at times, with the forces and rotor speeds that belong to them."""
    force = jax.vmap(lambda s: foundation_force(scene, s))(states)
    angle = jax.vmap(lambda t, s: rotor_angle(scene.drive, t, s))(times, states)
    speed = jax.vmap(lambda t, s: rotor_speed(scene.drive, t, s))(times, states)
    return Trajectory(times, states, force, angle, speed)


def measure(scene: Scene, field: Callable[[Array, State], State], times: Array, states: State) -> Measured:
    """Amplitudes and jam speed of an evenly sampled stretch of motion, see `Measured`.

    Extrema and whole turns are found on interpolants that use the derivatives the equations of motion give, not on the
    samples. `field` gives the rates of a state at a time; arrays that carry derivatives it has as a tree, not as a function's
    closure.
    """
    early, late, whole = _spans(scene, field, times, states)
    nd, half = states.displacement.shape[1], times.shape[0] // 2

    phi, rate = states.angle[0], states.rate[0]
    turning = jax.vmap(lambda p, w: _mean_speed(times, p, w), in_axes=1)
    speeds = turning(phi, rate)
    late_speeds = jax.vmap(lambda p, w: _mean_speed(times[half:], p, w), in_axes=1)(phi[half:], rate[half:])
    top = jnp.max(whole[:nd])
    drift = jnp.max(jnp.abs(late - early)[:nd]) / jnp.where(top > 0.0, top, 1.0)
    omega = jnp.mean(speeds)
    speed_drift = jnp.max(jnp.abs(late_speeds - speeds)) / jnp.maximum(jnp.abs(omega), jnp.finfo(omega.dtype).tiny)
    return Measured(
        omega=omega,
        load_speed=speeds,
        amplitude=whole[:nd],
        foundation_force=whole[nd] if whole.shape[0] == nd + 1 else jnp.sqrt(jnp.sum(whole[nd:] ** 2)),
        drift=jnp.maximum(drift, speed_drift),
    )


@eqx.filter_custom_jvp
def _spans(scene: Scene, field: Callable[[Array, State], State], times: Array, states: State) -> Array:
    """Half of peak to peak of displacements and foundation forces, over the first half of the samples, the second and all of
    them, (3, outputs).

    Derivatives, of any order, cost next to nothing: the equations are evaluated once more at the few samples beside the
    extrema, and are differentiated there alone.
    """
    (low, high), _, _ = _extrema(scene, field, times, states)
    return (high - low) / 2.0


@_spans.def_jvp
def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
    _, samples, shares = jax.lax.stop_gradient(_extrema(*primals))
    outputs = jnp.broadcast_to(jnp.arange(samples.shape[-1]), samples.shape)

    def spans(scene: Scene, field: Any, times: Array, states: State) -> Array:
        def extremum(output: Array, k: Array, share: Array) -> Array:
            def sample(j: Array) -> list[Array]:
                state = jax.tree.map(lambda leaf: leaf[j], states)
                return [part[output] for part in _moving(scene, field, _step(times), times[j], state)]

            return _extremum(sample(k), sample(k + 1), share)

        low, high = jax.vmap(jax.vmap(jax.vmap(extremum)))(outputs, samples, shares)
        return (high - low) / 2.0

    return eqx.filter_jvp(spans, primals, tangents)


def _extrema(scene: Scene, field: Any, times: Array, states: State) -> tuple[Array, Array, Array]:
    """Least and greatest values of each output, and their places, see `_places`; (2, 3, outputs) each."""
    step = _step(times)
    samples = jax.vmap(lambda t, y: _moving(scene, field, step, t, y))(times, states)
    return jax.vmap(_places, in_axes=1, out_axes=-1)(*samples)


def _moving(scene: Scene, field: Any, step: Array, t: Array, state: State) -> tuple[Array, Array, Array]:
    """Displacements and foundation forces with their first two derivatives, in units of the step."""

    def outputs(state: State) -> Array:
        return jnp.concatenate([state.displacement, foundation_force(scene, state)])

    def first(s: Array, y: State) -> Array:
        return jax.jvp(outputs, (y,), (field(s, y),))[1]

    second = jax.jvp(first, (t, state), (jnp.ones_like(t), field(t, state)))[1]
    return outputs(state), first(t, state) * step, second * step**2


def _places(x: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
    """Where the quintics through evenly spaced samples are least and greatest, over their first half, their second and all.

    x, v, a (n,) are samples and their first two derivatives, in units of the sampling step. **Returns** values there, the
    sample before each place, and at which share of the step after it the place is; (2, 3) each.
    """
    begin, end = ([part[cut] for part in (x, v, a)] for cut in (slice(-1), slice(1, None)))
    quintic = _quintic(begin, end)
    slope = _derived(quintic)
    bend = _derived(slope)
    turns = begin[1] * end[1] < 0.0
    share = jnp.clip(-begin[1] / jnp.where(turns, end[1] - begin[1], 1.0), 0.0, 1.0)
    for _ in range(4):
        curved = _at(bend, share)
        share = jnp.clip(share - _at(slope, share) / jnp.where(turns & (curved != 0.0), curved, 1.0), 0.0, 1.0)
    inner = jnp.where(turns, _at(quintic, share), x[:-1])
    n, half = len(x), len(x) // 2

    def greatest(sign: float, first: int, stop: int) -> tuple[Array, Array, Array]:
        inside = sign * inner > sign * x[:-1]
        reached = jnp.where(inside, sign * inner, sign * x[:-1])[first : stop - 1]
        top, last = jnp.max(reached), sign * x[stop - 1]
        value = jnp.maximum(top, last)
        k = first + jnp.min(jnp.where(reached == top, jnp.arange(stop - 1 - first), stop - 2 - first))
        place = jnp.where(last > top, 1.0, jnp.where(inside, share, 0.0)[k])
        place = jnp.where(jnp.isnan(value), jnp.nan, place)  # what is made of it later is not a number either
        return value, jnp.where(last > top, stop - 2, k), place

    found = []
    for sign in (-1.0, 1.0):
        parts = [greatest(sign, *stretch) for stretch in ((0, half), (half, n), (half - 1, half + 1))]
        value, k, place = (jnp.stack(column) for column in zip(*parts, strict=True))
        best = jnp.argmax(value)
        found.append([jnp.concatenate([row[:2], row[best][None]]) for row in (sign * value, k, place)])
    values, k, places = (jnp.stack(pair) for pair in zip(*found, strict=True))
    return values, k, places


def _extremum(begin: Sequence[Array], end: Sequence[Array], share: Array) -> Array:
    """The quintic's value at an extremum, which stays one: where it is inside the step it moves with what it is made of."""
    quintic = _quintic(begin, end)
    slope = _derived(quintic)
    curved = _at(_derived(slope), share)
    inside = (share > 0.0) & (share < 1.0) & (curved != 0.0)
    move = jnp.where(inside, _at(slope, share), 0.0) / jax.lax.stop_gradient(jnp.where(inside, curved, 1.0))
    return _at(quintic, share - move + jax.lax.stop_gradient(move))


def _quintic(begin: Sequence[Array], end: Sequence[Array]) -> list[Array]:
    """Coefficients, of the lowest power first, of the Hermite interpolant through values and two derivatives at 0 and 1."""
    (x0, v0, a0), (x1, v1, a1) = begin, end
    d, e, f = x1 - x0 - v0 - a0 / 2.0, v1 - v0 - a0, a1 - a0
    return [
        x0,
        v0,
        a0 / 2.0,
        10.0 * d - 4.0 * e + f / 2.0,
        -15.0 * d + 7.0 * e - f,
        6.0 * d - 3.0 * e + f / 2.0,
    ]


def _derived(polynomial: list[Array]) -> list[Array]:
    return [float(k) * c for k, c in enumerate(polynomial)][1:]


def _at(polynomial: list[Array], s: Array) -> Array:
    return functools.reduce(lambda value, c: value * s + c, reversed(polynomial))


def _mean_speed(t: Array, phi: Array, rate: Array) -> Array:
    """Mean speed over as many whole turns as there are before the last sample; over all of it if there is none."""
    total = phi[-1] - phi[0]
    turns = jnp.floor(jnp.abs(total) / (2.0 * jnp.pi))
    target = phi[-1] - jnp.sign(total) * 2.0 * jnp.pi * turns
    i = jnp.clip(jnp.argmin(jnp.abs(phi - target)), 0, t.shape[0] - 1)
    start = t[i] + (target - phi[i]) / _away_from_zero(rate[i])
    # One secant step on the cubic through the sample: enough, the sample is next to it.
    j = jnp.where(start > t[i], jnp.minimum(i + 1, t.shape[0] - 1), jnp.maximum(i - 1, 0))
    h = jnp.where(i == j, 1.0, t[j] - t[i])
    bend = (rate[j] - rate[i]) / h
    start = t[i] + (target - phi[i]) / _away_from_zero(rate[i] + 0.5 * bend * (start - t[i]))
    return jnp.where(turns > 0, 2.0 * jnp.pi * turns * jnp.sign(total) / (t[-1] - start), total / (t[-1] - t[0]))


def _step(times: Array) -> Array:
    """Between even samples: of all of them, for late in a long run two neighbours are rounded each."""
    return (times[-1] - times[0]) / (times.shape[0] - 1)


def _away_from_zero(x: Array) -> Array:
    tiny = jnp.sqrt(jnp.finfo(x.dtype).tiny)
    return jnp.where(jnp.abs(x) < tiny, tiny, x)


def relative_amplitude(scene: Scene, stretch: Trajectory, i: int, j: int) -> Array:
    """Amplitude of platform `i` relative to platform `j` (counted from 1) over an evenly sampled stretch, m zero to peak."""
    acceleration = jax.vmap(vector_field(scene))(stretch.time, stretch.state).velocity
    x, v, a = (
        values[:, i - 1] - values[:, j - 1] for values in (stretch.state.displacement, stretch.state.velocity, acceleration)
    )
    step = _step(stretch.time)
    (low, high), _, _ = _places(x, v * step, a * step**2)
    return (high - low)[2] / 2.0
