"""What is read off a motion: amplitudes, jam speed, forces, energy."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.scene import Scene
from jaxvib.motion.dynamics import Dynamics, State, vector_field

__all__ = ["Measured", "Trajectory", "energy", "foundation_force", "measure", "power"]


class Trajectory(eqx.Module):
    """States at some times.

    **Attributes** (nt times): `time` (nt,) s; `state` a `State` whose arrays have a leading axis over the times;
    `foundation_force` (nt, nb) N, what the supports exert on the bed in its nb directions; `rotor_speed` (nt,) rad/s.
    """

    time: Array
    state: State
    foundation_force: Array
    rotor_speed: Array


class Measured(eqx.Module):
    """A motion in numbers, over the last turns of a run.

    **Attributes**: `omega` mean speed of the loads over whole turns, rad/s; `load_speed` (count,) the same for each load;
    `amplitude` (nd,) m and `foundation_force` N, zero to peak, that is half of peak to peak; `drift` the largest change of an
    amplitude from the first to the second half of those turns, relative to the largest amplitude, or of `omega` where that is
    more; `settled` whether it is below 1e-3.
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
    return carrier.bed_stiffness @ state.displacement + carrier.bed_damping @ state.velocity


def energy(scene: Scene, state: State) -> Array:
    """Kinetic and potential energy of a state, J.

    E = q'.M q'/2 + q.K q/2 + sum_j [ m_j |B q' + p_j'|^2/2 + (kappa_j - 1) m_j |p_j'|^2/2 + V_j(u_j) ]
    """
    carrier, loads = scene.machine.carrier(), scene.loads
    p_rate = jax.jvp(loads.position, state.angle, state.rate)[1]
    port = carrier.port @ state.velocity
    at_port = dict(zip(carrier.axes, port, strict=True))
    total = [rate + at_port.get(axis, 0.0) for axis, rate in enumerate(p_rate)]
    own = loads.inertia_factor() - 1.0
    kinetic = 0.5 * loads.mass * (sum(v**2 for v in total) + own * sum(v**2 for v in p_rate))
    potential = sum((effect.load_potential(loads, state.angle) for effect in scene.effects), jnp.zeros_like(kinetic))
    q, v = state.displacement, state.velocity
    return 0.5 * (v @ carrier.mass @ v + q @ carrier.stiffness @ q) + jnp.sum(kinetic + potential)


def power(scene: Scene, t: Array, state: State) -> tuple[Array, Array]:
    """Power that the rotor puts in, and power that dampers and drag dissipate, W; dE/dt is their difference.

    P_in = speed sum_j b_W R^2 (speed - phi_j'),    P_diss = q'.C q' + sum_j b_W R^2 (speed - phi_j')^2
    """
    speed = scene.drive.speed_at(t)
    torque = scene.loads.resistance(state.angle, state.rate, speed)
    on_loads = sum(jnp.sum(f * w) for f, w in zip(torque, state.rate, strict=True))
    from_rotor = speed * jnp.sum(torque[0])
    dampers = state.velocity @ scene.machine.carrier().damping @ state.velocity
    return from_rotor, dampers + from_rotor - on_loads


def trajectory(scene: Scene, times: Array, states: State) -> Trajectory:
    """States at times, with the forces and rotor speeds that belong to them."""
    force = jax.vmap(lambda s: foundation_force(scene, s))(states)
    return Trajectory(times, states, force, jax.vmap(scene.drive.speed_at)(times))


def measure(scene: Scene, field: Dynamics, times: Array, states: State) -> Measured:
    """Amplitudes and jam speed of an evenly sampled stretch of motion, see `Measured`.

    Extrema and whole turns are found on interpolants that use the derivatives the equations of motion give, not on the
    samples.
    """

    def outputs(state: State) -> Array:
        return jnp.concatenate([state.displacement, foundation_force(scene, state)])

    def rates(t: Array, state: State) -> tuple[Array, Array, Array]:
        def first(s: Array, y: State) -> Array:
            return jax.jvp(outputs, (y,), (field(s, y),))[1]

        second = jax.jvp(first, (t, state), (jnp.ones_like(t), field(t, state)))[1]
        return outputs(state), first(t, state), second

    x, v, a = jax.vmap(rates)(times, states)
    half = times.shape[0] // 2
    step = times[1] - times[0]
    span = jax.vmap(lambda y, dy, ddy: _zero_to_peak(y, dy * step, ddy * step**2), in_axes=1)
    early, late = span(x[:half], v[:half], a[:half]), span(x[half:], v[half:], a[half:])
    whole = span(x, v, a)
    nd = states.displacement.shape[1]

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


def _zero_to_peak(x: Array, v: Array, a: Array) -> Array:
    """Half of peak to peak; x, v, a are samples and their first two derivatives, in units of the sampling step."""
    low, high = _quintic(x, v, a)
    return (high - low) / 2.0


def _quintic(x: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Least and greatest value of the quintic Hermite interpolant through evenly spaced samples."""
    x0, x1, v0, v1, a0, a1 = x[:-1], x[1:], v[:-1], v[1:], a[:-1], a[1:]
    d, e, f = x1 - x0 - v0 - a0 / 2.0, v1 - v0 - a0, a1 - a0
    c3, c4, c5 = 10.0 * d - 4.0 * e + f / 2.0, -15.0 * d + 7.0 * e - f, 6.0 * d - 3.0 * e + f / 2.0

    def value(s: Array) -> Array:
        return x0 + s * (v0 + s * (a0 / 2.0 + s * (c3 + s * (c4 + s * c5))))

    def slope(s: Array) -> Array:
        return v0 + s * (a0 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))

    turns = (v0 * v1) < 0.0
    safe = jnp.where(turns, v1 - v0, 1.0)
    s = jnp.clip(-v0 / safe, 0.0, 1.0)
    for _ in range(4):
        _, bend = jax.jvp(slope, (s,), (jnp.ones_like(s),))
        s = jnp.clip(s - slope(s) / jnp.where(turns & (bend != 0.0), bend, 1.0), 0.0, 1.0)
    # The value at an extremum does not depend on where it is, to first order: its place carries no derivative.
    inner = jnp.where(turns, value(jax.lax.stop_gradient(s)), x0)
    return jnp.minimum(jnp.min(inner), jnp.min(x)), jnp.maximum(jnp.max(inner), jnp.max(x))


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


def _away_from_zero(x: Array) -> Array:
    tiny = jnp.sqrt(jnp.finfo(x.dtype).tiny)
    return jnp.where(jnp.abs(x) < tiny, tiny, x)


def relative_amplitude(scene: Scene, stretch: Trajectory, i: int, j: int) -> Array:
    """Amplitude of platform `i` relative to platform `j` (counted from 1) over an evenly sampled stretch, m zero to peak."""
    acceleration = jax.vmap(vector_field(scene))(stretch.time, stretch.state).velocity
    x, v, a = (
        values[:, i - 1] - values[:, j - 1] for values in (stretch.state.displacement, stretch.state.velocity, acceleration)
    )
    step = stretch.time[1] - stretch.time[0]
    return _zero_to_peak(x, v * step, a * step**2)
