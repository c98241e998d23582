"""Motion, at the samples of a record, of a machine that has loads or nonlinear supports and whose rotor angle is known, and
derivatives of this motion.

The state is y = (q, q', angles of the loads, their rates, states of high-pass filters). The exact equations of the scene are
integrated by equal steps of order 8, over J segments of a record at once. A step also ends where the contact with a stop
begins or ends, see `jaxvib.identification.supports.contact`. The last state end_j of segment j has the derivative G_j with
respect to the first state start_j of the segment, and H_j with respect to all other unknowns z. A change dz, and a change of
the state at the first sample, then change start_j by D_j:

    D_1 = d(state at the first sample),      D_{j+1} = G_j D_j + H_j dz + (end_j - start_{j+1})

The last term closes the gaps between the segments. Without gaps this is the derivative of the whole motion. The motion of
jammed loads or on damped supports is stable; therefore the products of G_j do not grow.

Sizes of arrays: n samples, J segments of `length` samples, C channels, nd coordinates of the carrier, ns states, p unknowns x
of the scene and the sensors (see `Unknowns`). `pair` are the two components of the unbalance.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import Dynamics, dynamics_of
from jaxvib.equations.model import assemble
from jaxvib.equations.state import State
from jaxvib.identification.angle import RecordedDrive
from jaxvib.identification.problem import DELAY_MARGIN
from jaxvib.identification.response import Samples, Unknowns, sensor_rows
from jaxvib.identification.supports.contact import contacts_at, side_count, switched_step, with_contacts, with_fixed_contact
from jaxvib.machine.drives.drive import Drive, IdealDrive
from jaxvib.machine.scene import Scene
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.runtime.programs import cached


class ShiftedDrive(IdealDrive):
    """Prescribed `drive` whose angle is larger by `phase`, rad; after the time `end` its angle, speed and acceleration keep
    their values at `end`."""

    drive: Drive
    phase: Array
    end: Array
    speed: Array
    kind: str = eqx.field(static=True, default="turned", kw_only=True)

    def angle_at(self, t: Array) -> Array:
        """Return the angle, rad."""
        return self.drive.rotor_angle(jnp.minimum(t, self.end), None) + self.phase

    def speed_at(self, t: Array) -> Array:
        """Return the speed, rad/s."""
        return self.drive.rotor_speed(jnp.minimum(t, self.end), None)

    def acceleration_at(self, t: Array) -> Array:
        """Return the acceleration, rad/s^2."""
        acceleration: Any = self.drive.rotor_acceleration(jnp.minimum(t, self.end))
        return acceleration


class _Equations(NamedTuple):
    """Equations of a run: the `dynamics` of the scene; `rows` (C, 3, nd) from displacements, velocities and accelerations to
    the readings, and `gains` (C,) of the readings; `corners`, rad/s, of the channels with a high-pass filter."""

    dynamics: Dynamics
    rows: Array
    gains: Array
    corners: Array


def _equations(unknowns: Unknowns, samples: Samples, scene: Scene, x: Array, pair: Array) -> _Equations:
    scene_of_run = samples.scene(unknowns.scene(scene, x))
    exciter, drive = scene_of_run.exciters[0], samples.drives[0]
    first, count = samples.errors
    if count and isinstance(drive, RecordedDrive):
        drive = drive.with_errors(x[first : first + count])
    phase = jnp.zeros(())
    if exciter.unbalance is not None:
        turn = 0.0 if samples.turn is None else x[unknowns.first.shape[0] + len(unknowns.gains) + samples.turn]
        phase = exciter.direction * (jnp.arctan2(pair[1], pair[0]) + turn)
        scene_of_run = eqx.tree_at(lambda scene: scene.exciters[0].unbalance, scene_of_run, jnp.hypot(pair[0], pair[1]))
    shifted = ShiftedDrive(drive=drive, phase=phase, end=samples.end, speed=drive.speed)
    scene_of_run: Any = eqx.tree_at(lambda scene: scene.exciters[0].drive, scene_of_run, shifted)
    fixed_effects = tuple(with_fixed_contact(effect, scene_of_run.machine) for effect in scene_of_run.effects)
    scene_of_run = eqx.tree_at(lambda scene: scene.effects, scene_of_run, fixed_effects)
    model = assemble(scene_of_run)
    gains = jnp.stack([jnp.asarray(unknowns.gain(x, channel.name)) for channel in samples.channels])
    corners = jnp.asarray([2.0 * np.pi * channel.high_pass for channel in samples.channels if channel.high_pass > 0.0])
    return _Equations(dynamics_of(model), sensor_rows(scene_of_run, model.carrier, samples.channels), gains, corners)


def _rates(samples: Samples, t: Array, y: Array, equations: _Equations) -> tuple[Array, Array]:
    """Return the rates of the state `y`, and the readings (C,) before their gains are applied."""
    nd, filters = equations.rows.shape[2], equations.corners.shape[0]
    loads = (y.shape[0] - 2 * nd - filters) // 2
    q, v, angle, rate, slow = jnp.split(y, np.cumsum([nd, nd, loads, loads]))
    derivative = equations.dynamics(t, State(q, v, (angle,), (rate,)) if loads else State(q, v))
    readings = equations.rows[:, 0] @ q + equations.rows[:, 1] @ v + equations.rows[:, 2] @ derivative.velocity
    filtered = np.flatnonzero([channel.high_pass > 0.0 for channel in samples.channels])
    filter_rates = equations.corners * (readings[filtered] - slow)
    rates = jnp.concatenate([derivative.displacement, derivative.velocity, *derivative.angle, *derivative.rate, filter_rates])
    return rates, readings.at[filtered].add(-slow)


def _segment(
    unknowns: Unknowns, samples: Samples, scene: Scene, x: Array, pair: Array, start: Array, begin: Array, length: int
) -> tuple[Array, Array, Array]:
    """Return the readings (length, C) and the states (length, ns) from the sample `begin` on, and the state at the end."""
    equations = _equations(unknowns, samples, scene, x, pair)
    term = diffrax.ODETerm(lambda t, y, args: _rates(samples, jnp.asarray(t), y, args)[0])
    per_sample, solver, has_stops = samples.segments[2], LoopDopri8(tangents=True), side_count(equations.dynamics) > 0

    def step(t: Array, y: Array, h: Array, dynamics: Dynamics) -> Array:
        return solver.step(term, t, t + h, y, equations._replace(dynamics=dynamics), None, False)[0]

    def rates(t: Array, y: Array, _: Array, dynamics: Dynamics) -> Array:
        return _rates(samples, t, y, equations._replace(dynamics=dynamics))[0]

    def contacts(y: Array) -> Array:
        nd = equations.rows.shape[2]
        return contacts_at(equations.dynamics, y[:nd], y[nd : 2 * nd]) if has_stops else jnp.zeros(0, bool)

    recorded, used = _recorded(samples)

    def sample(state: tuple[Array, Array], k: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        (y, presses), t, h = state, samples.begin + samples.step * (begin + k), samples.step / per_sample
        now = equations._replace(dynamics=with_contacts(equations.dynamics, presses)) if has_stops else equations
        readings = equations.gains * _rates(samples, t, y, now)[1]
        if samples.guide is not None:
            difference = jnp.where(used[begin + k], recorded[begin + k] - readings, 0.0)
            y = y + jnp.where(jnp.any(presses), 0.0, samples.guide @ difference)
            presses = contacts(y)

        def advance(i: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            if has_stops:
                return switched_step(step, rates, equations.dynamics, t + i * h, state[0], state[1], h)
            return step(t + i * h, state[0], h, equations.dynamics), state[1]

        return jax.lax.fori_loop(0, per_sample, advance, (y, presses)), (readings, y)

    (end, _), (readings, states) = jax.lax.scan(sample, (start, contacts(start)), jnp.arange(length))
    return readings, states, end


def _recorded(samples: Samples) -> tuple[Array, Array]:
    """Return the readings (n, C) of a record without their means, and True for the readings that count. Readings of a channel
    with a delay are shifted to the time of the motion, by whole samples."""
    delays = np.array([channel.delay for channel in samples.channels])
    recorded, weights = (each.reshape(-1, each.shape[2]) for each in (samples.readings, samples.weights))
    used = weights > 0.0
    mean = jnp.sum(jnp.where(used, recorded, 0.0), axis=0) / jnp.maximum(jnp.sum(used, axis=0), 1)
    values = recorded - mean[None]
    if np.any(delays):
        late = DELAY_MARGIN + jnp.rint(delays / samples.step).astype(int)
        later = jnp.arange(len(recorded))[:, None] + late[None]
        place = jnp.minimum(later, len(recorded) - 1)
        values, used = (jnp.take_along_axis(each, place, axis=0) for each in (values, used))
        used &= later < len(recorded)
    return values, used


@cached
def segments(
    unknowns: Unknowns, samples: Samples, scene: Scene, x: Array, pair: Array, starts: Array, length: int
) -> tuple[Array, Array, Array]:
    """Return the readings (J, length, C), the states (J, length, ns) and the last states (J, ns) of J segments.

    **Arguments**: `x` (p,) and `pair` (2,): unknowns; `starts` (J, ns): first states.
    """
    begins = length * jnp.arange(starts.shape[0])
    return jax.vmap(lambda start, begin: _segment(unknowns, samples, scene, x, pair, start, begin, length))(starts, begins)


@cached
def _slopes(
    unknowns: Unknowns, samples: Samples, scene: Scene, x: Array, pair: Array, starts: Array
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return the readings and last states of `segments`, and their derivatives (..., p + 2 + ns) with respect to x, `pair` and
    the first state."""
    length, p = samples.segments[1], x.shape[0]

    def motion(free: Array, begin: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        readings, _, end = _segment(unknowns, samples, scene, free[:p], free[p : p + 2], free[p + 2 :], begin, length)
        return (readings, end), (readings, end)

    def of_segment(start: Array, begin: Array) -> tuple[Any, Any]:
        return jax.jacfwd(motion, has_aux=True)(jnp.concatenate([x, pair, start]), begin)

    slopes, values = jax.vmap(of_segment)(starts, length * jnp.arange(starts.shape[0]))
    return values, slopes


class Linearized(NamedTuple):
    """Linearized motion of a run.

    The f = p + ns + 2 + C unknowns are x, the state at the first sample, `pair` and the offsets of the channels, in this order.
    The last axis of `columns` and `start_changes` has f + 1 entries: the derivatives with respect to the unknowns, and the
    change that closes the gaps between the segments.

    **Attributes**

    - `model` (n, C): readings of the model after the filter; `columns` (n, C, f + 1): their changes
    - `start_changes` (J, ns, f + 1): changes of the first states of the segments
    - `gaps` (J - 1, ns): last state of each segment minus the first state of the next one
    """

    model: np.ndarray
    columns: np.ndarray
    start_changes: np.ndarray
    gaps: np.ndarray


def linearized(
    unknowns: Unknowns, samples: Samples, scene: Scene, x: np.ndarray, own: np.ndarray, starts: np.ndarray
) -> Linearized:
    """Return the linearized motion of a run.

    **Arguments**: `x` (p,); `own`: state at the first sample, pair, offsets; `starts` (J, ns): first states of the segments.
    """
    p, count = x.size, starts.shape[1]
    values, slopes = _slopes(unknowns, samples, scene, jnp.asarray(x), jnp.asarray(own[count : count + 2]), jnp.asarray(starts))
    (readings, ends), (by_readings, by_ends) = jax.tree.map(np.asarray, (values, slopes))
    gaps, width = ends[:-1] - starts[1:], p + count + 2 + len(samples.channels) + 1
    direct = np.concatenate([np.arange(p), p + count + np.arange(2)])  # indices of x and pair
    change, start_changes, columns = np.zeros((count, width)), [], []
    change[:, p : p + count] = np.eye(count)
    for j in range(len(starts)):
        start_changes.append(change)
        part = by_readings[j][:, :, p + 2 :] @ change
        part[:, :, direct] += by_readings[j][:, :, : p + 2]
        columns.append(part)
        change = by_ends[j][:, p + 2 :] @ change
        change[:, direct] += by_ends[j][:, : p + 2]
        if j < len(gaps):
            change[:, -1] += gaps[j]
    n = samples.readings.shape[0] * samples.readings.shape[1]
    model, slopes = (np.concatenate(each)[:n] for each in (readings, columns))
    model, slopes = _filtered(samples, model), _filtered(samples, slopes)
    level = np.sum(np.asarray(samples.taps), axis=0)  # response of the filter to a constant offset
    offsets = np.arange(len(level))
    slopes[:, offsets, p + count + 2 + offsets] = level
    return Linearized(model + level * own[count + 2 :], slopes, np.stack(start_changes), gaps)


def _filtered(samples: Samples, values: np.ndarray) -> np.ndarray:
    """Return readings (n, C, ...) after the filter of the model."""
    from scipy.signal import lfilter  # slow to import

    taps = np.asarray(samples.taps)
    filtered = np.stack([lfilter(taps[:, c], 1.0, values[:, c], axis=0) for c in range(taps.shape[1])], axis=1)
    return np.asarray(filtered)


def weighted(samples: Samples, model: np.ndarray) -> np.ndarray:
    """Return the products (n, C) of weights and differences, readings minus model."""
    count = model.shape[1]
    data, weights = (np.asarray(each).reshape(-1, count)[: len(model)] for each in (samples.readings, samples.weights))
    return weights * (data - model)


def closed_motion(
    unknowns: Unknowns, samples: Samples, scene: Scene, x: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the readings (J x length, C) of a run with offsets, before the filter, and the first states (J, ns) of its
    segments.

    The motion is integrated from the state at the first sample, without gaps.

    **Arguments**: `own`: state at the first sample, pair, offsets.
    """
    count, (number, length, _) = own.size - 2 - len(samples.channels), samples.segments
    pair, start = jnp.asarray(own[count : count + 2]), jnp.asarray(own[None, :count])
    motion = segments(unknowns, samples, scene, jnp.asarray(x), pair, start, number * length)
    readings, states = np.asarray(motion[0]), np.asarray(motion[1])
    return readings[0] + own[count + 2 :], states[0, ::length]


def motion_columns(unknowns: Unknowns, samples: Samples, scene: Scene, x: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return Z (n C, p + size of `own` + 1): weighted derivatives of the model with respect to x and `own`, and weighted
    readings minus model. Z^T Z is the matrix of `normal_equations`."""
    at = linearized(unknowns, samples, scene, x, own, closed_motion(unknowns, samples, scene, x, own)[1])
    return weighted_columns(samples, at, at.columns[:, :, :-1])


def weighted_columns(samples: Samples, at: Linearized, columns: np.ndarray) -> np.ndarray:
    """Return Z, which contains `columns` and the differences, readings minus model, all multiplied by the weights."""
    weights = np.asarray(samples.weights).reshape(-1, at.model.shape[1])[: len(at.model)]
    z = np.concatenate([columns * weights[:, :, None], weighted(samples, at.model)[:, :, None]], axis=2)
    return z.reshape(-1, z.shape[2])


def motion_differences(unknowns: Unknowns, samples: Samples, scene: Scene, x: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return the weighted differences (n C,), readings minus model, of the motion without gaps."""
    offsets, level = own[-len(samples.channels) :], np.sum(np.asarray(samples.taps), axis=0)
    readings, _ = closed_motion(unknowns, samples, scene, x, own)
    return weighted(samples, _filtered(samples, readings - offsets) + level * offsets).ravel()
