"""Response of a linear machine to rotors of known angle, at the samples of a record, and its normal equations.

The state is x = (s q, q') with a fixed frequency s. With the sampling step h, p = (cos theta, sin theta) and

    x' = A x + B F(t),      F = -p''                (two numbers for each exciter, per unit of its unbalance)

the free motion between two samples is exact, and the force of the rotor is integrated with three Gauss points per step:

    x_{k+1} = exp(A h) x_k + sum_j w_j h exp(A (h - c_j h)) B F(t_k + c_j h)

The steps are computed in blocks: first the responses from the state zero in all blocks of a segment of the record at once, then
the state at the start of each block from that of the block before, then the responses to these states. Readings are linear in
the state at the first sample, the two components (a, b) of each unbalance, and the offsets: these are the linear unknowns, in
this order. Derivatives with respect to all other unknowns are forward derivatives of the same steps; those with respect to
errors of a rotor's angle (`RecordedDrive`) are responses to changes of the force. The normal equations of a whole record are
sums over segments, which bounds the memory.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.model import assemble
from jaxvib.identification.angle import RecordedDrive
from jaxvib.identification.records.channel import Channel
from jaxvib.machine.carrier import Carrier
from jaxvib.machine.drives.drive import Drive
from jaxvib.machine.numbers.named import NamedNumber, put_numbers
from jaxvib.machine.scene import Scene
from jaxvib.runtime.programs import cached

GAUSS_POINTS = 0.5 + np.array([-1.0, 0.0, 1.0]) * np.sqrt(0.15)
"""Times at which the force is evaluated within a step, relative to the length of the step."""

_GAUSS_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0

SEGMENT = 4096
"""Largest number of samples whose derivatives are in memory at once."""

BLOCK = 64
"""Number of steps of a block."""


class Unknowns(eqx.Module):
    """Unknowns except the linear ones, as deviations x from their first values.

        value = first exp(x) for positive parameters,      value = first + scale x otherwise

    **Attributes** (x has the entries of the parameters, the gains, the turns and the errors, in this order)

    - `numbers` (n,) of the scene; `first` (n,) and `scale` (n,), SI, of the equations above; `positive` (n,): True for positive
      parameters
    - `gains`: names of the channels whose gains are unknown; each gain is exp(x)
    - `turns`: number of runs whose rotor angle has an unknown zero; x is this zero, rad
    - `errors`: number of unknown errors of rotor angles; x is the error divided by its standard error
    """

    numbers: tuple[NamedNumber, ...] = eqx.field(static=True)
    first: Array
    scale: Array
    positive: Array
    gains: tuple[str, ...] = eqx.field(static=True)
    turns: int = eqx.field(static=True)
    errors: int = eqx.field(static=True, default=0)

    @property
    def count(self) -> int:
        """Number of all unknowns."""
        return self.first.shape[0] + len(self.gains) + self.turns + self.errors

    def values(self, x: Array | np.ndarray) -> Array:
        """Return the values (n,) of the scene's parameters, SI."""
        part = x[: self.first.shape[0]]
        return jnp.where(self.positive, self.first * jnp.exp(part), self.first + self.scale * part)

    def scene(self, scene: Scene, x: Array | np.ndarray) -> Scene:
        """Return the scene with the values of its unknown parameters."""
        return put_numbers(scene, self.numbers, self.values(x)) if self.numbers else scene

    def gain(self, x: Array, name: str) -> Array | float:
        """Return the gain of a channel."""
        return jnp.exp(x[self.first.shape[0] + self.gains.index(name)]) if name in self.gains else 1.0


class Samples(eqx.Module):
    """Samples of a run on an even grid, in segments: input of the compiled programs.

    **Attributes** (N segments of n samples, C channels, E exciters)

    - `drives`: for each exciter the drive that turns its rotor in this run
    - `begin` and `end`, s: times of the first and the last sample
    - `readings` (N, n, C): readings after the whitening filter, see `with_noise` in `jaxvib.identification.problem`
    - `weights` (N, n, C): 1/noise of each reading, 0 for readings that do not count
    - `taps` (m + 1, C): coefficients of the whitening filter, for the readings of the model
    - `step` h, s
    - `changed`: parameters of the scene that differ in this run; `actions` ("add", "scale" or "set") and `amounts` of the
      changes
    - `channels` that are compared; `turn`: index of the run's unknown zero of the rotor's angle; None for a known zero
    - `errors` of the rotor's angle: index of the first one among the unknowns, and their number
    - `segments` in which a nonlinear motion (with loads, or on nonlinear supports) is integrated: their number, samples of
      each, steps per sample; (0, 0, 0) for a linear response
    - `guide` (ns, C), for nonlinear supports only: change of the state at a sample per difference between recorded and
      computed readings; otherwise None
    """

    drives: tuple[Drive, ...]
    begin: Array
    end: Array
    readings: Array
    weights: Array
    taps: Array
    step: Array
    amounts: Array
    channels: tuple[Channel, ...] = eqx.field(static=True)
    changed: tuple[NamedNumber, ...] = eqx.field(static=True)
    actions: tuple[str, ...] = eqx.field(static=True)
    turn: int | None = eqx.field(static=True)
    errors: tuple[int, int] = eqx.field(static=True, default=(0, 0))
    segments: tuple[int, int, int] = eqx.field(static=True, default=(0, 0, 0))
    guide: Array | None = None

    def scene(self, scene: Scene) -> Scene:
        """Return the scene as it was in this run."""
        for number, action, amount in zip(self.changed, self.actions, self.amounts, strict=True):
            now = number.read(scene)
            new = {"add": now + amount, "scale": now * amount, "set": jnp.full_like(now, amount)}[action]
            scene = put_numbers(scene, (number,), new)
        return scene


class _Steps(NamedTuple):
    """Matrices of the steps.

    **Attributes**

    - `power` (ns, ns): exp(A h)
    - `inputs` (3, ns, E, 2, 2): change of the state by F at each Gauss point; the last two axes are the components (a, b) of
      each unbalance and the two entries of F
    - `outputs` (C, ns) and `through` (C, E, 2, 2): readings from the state and from F
    - `scale`: frequency s of the state, rad/s
    """

    power: Array
    inputs: Array
    outputs: Array
    through: Array
    scale: Array


def state_count(scene: Scene, channels: tuple[Channel, ...]) -> int:
    """Return the number of states: coordinates, angles of loads, their rates, and one for each channel with a high-pass
    filter."""
    count = len(scene.machine.structure().coordinates) + sum(e.loads.count for e in scene.exciters if e.loads is not None)
    return 2 * count + sum(channel.high_pass > 0.0 for channel in channels)


def rows_of_channel(scene: Scene, channel: Channel) -> Array:
    """Return the row (nd,) that gives the displacement of a channel's point in its direction from the coordinates."""
    place = scene.exciters[0].place if channel.at is None else channel.at
    place = jnp.asarray(place) if isinstance(place, tuple) else place
    axes, rows = scene.machine.mounting().axes, scene.machine.rows_at(place, f"channel {channel.name!r}: at")
    return sum((channel.direction[axis] * rows[k] for k, axis in enumerate(axes)), jnp.zeros(rows.shape[1]))


def sensor_rows(scene: Scene, carrier: Carrier, channels: tuple[Channel, ...]) -> Array:
    """Return the rows (C, 3, nd) by which readings follow from displacements, velocities and accelerations."""
    found = []
    for channel in channels:
        if channel.kind == "force":
            weights = jnp.asarray(channel.direction[-len(carrier.foundation_directions) :])  # a single direction is up
            stiffness, damping = weights @ carrier.foundation_stiffness, weights @ carrier.foundation_damping
            found.append(jnp.stack([stiffness, damping, jnp.zeros_like(stiffness)]))
        else:
            order = ("displacement", "velocity", "acceleration").index(channel.kind)
            row = rows_of_channel(scene, channel)
            found.append(jnp.zeros((3, row.shape[0])).at[order].set(row))
    return jnp.stack(found)


def _steps(scene: Scene, channels: tuple[Channel, ...], step: Array, turn: Array | float) -> _Steps:
    """Return the matrices of the steps of a scene; `turn` is added to the angle of the rotors, rad."""
    model = assemble(scene)
    mass, damping, stiffness = model.carrier.mass, model.carrier.damping, model.carrier.stiffness
    nd = mass.shape[0]
    forces = []
    for mount in model.mounts:
        across, up = (mount.rotor_rows()[mount.axes.index(axis)] if axis in mount.axes else jnp.zeros(nd) for axis in (0, 1))
        # The component b of the unbalance is a quarter of a turn anticlockwise from a.
        forces.append(jnp.stack([jnp.stack([across, up], axis=-1), jnp.stack([up, -across], axis=-1)], axis=1))
    force = jnp.stack(forces, axis=1)  # (nd, E, 2, 2)
    c, s = jnp.cos(turn), jnp.sin(turn)
    force = jnp.einsum("neaf,ab->nebf", force, jnp.asarray([[c, -s], [s, c]]))
    square = jnp.max(jnp.diagonal(stiffness) / jnp.diagonal(mass))
    scale = jax.lax.stop_gradient(jnp.sqrt(jnp.where(square > 0.0, square, 1.0)))  # any number for a free machine
    solved = jnp.linalg.solve(mass, jnp.concatenate([stiffness / scale, damping, force.reshape(nd, -1)], axis=1))
    elastic, viscous, accelerance = solved[:, :nd], solved[:, nd : 2 * nd], solved[:, 2 * nd :].reshape(force.shape)
    zero = jnp.zeros((nd, nd))
    flow = jnp.block([[zero, scale * jnp.eye(nd)], [-elastic, -viscous]])
    entry = jnp.concatenate([jnp.zeros_like(accelerance), accelerance])

    weights = sensor_rows(scene, model.carrier, channels)
    row = jnp.concatenate([weights[:, 0] / scale, weights[:, 1]], axis=1) + weights[:, 2] @ flow[nd:]
    direct = jnp.tensordot(weights[:, 2], accelerance, axes=1)
    corners = [2.0 * np.pi * channel.high_pass for channel in channels]
    slow = [k for k, corner in enumerate(corners) if corner > 0.0]
    if slow:  # the state z of a high-pass filter, z' = corner (reading - z), is subtracted from the reading
        corner, n = np.array([corners[k] for k in slow]), len(slow)
        flow = jnp.block(
            [[flow, jnp.zeros((2 * nd, n))], [corner[:, None] * row[np.array(slow)], jnp.diag(jnp.asarray(-corner))]]
        )
        entry = jnp.concatenate([entry, corner[:, None, None, None] * direct[np.array(slow)]])
        minus = np.zeros((len(channels), n))
        minus[slow, np.arange(n)] = -1.0
        row = jnp.concatenate([row, minus], axis=1)
    times = jnp.asarray([1.0, *(1.0 - GAUSS_POINTS)]) * step
    powers = jax.vmap(lambda t: jax.scipy.linalg.expm(flow * t, max_squarings=32))(times)
    inputs = jnp.einsum("j,jnm,mebf->jnebf", jnp.asarray(_GAUSS_WEIGHTS) * step, powers[1:], entry)
    return _Steps(powers[0], inputs, row, direct, scale)


def _march(power: Array, forcing: Array, start: Array) -> tuple[Array, Array]:
    """Return the states (n, ns, m) at the starts of n steps x_{k+1} = power x_k + forcing_k, and the state at the end.

    **Arguments**: `forcing` (n, ns, m), `start` (ns, m); n is a multiple of the length of a block.
    """
    n, ns, m = forcing.shape
    blocks = jnp.moveaxis(forcing.reshape(n // BLOCK, BLOCK, ns, m), 1, 0)

    def within(x: Array, w: Array) -> tuple[Array, Array]:
        return jnp.einsum("ij,bjm->bim", power, x) + w, x

    ends, local = jax.lax.scan(within, jnp.zeros((n // BLOCK, ns, m)), blocks)

    def multiplied(p: Array, _: None) -> tuple[Array, Array]:
        return power @ p, p

    whole, powers = jax.lax.scan(multiplied, jnp.eye(ns), None, length=BLOCK)

    def between(x: Array, end: Array) -> tuple[Array, Array]:
        return whole @ x + end, x

    last, starts = jax.lax.scan(between, start, ends)
    states = local + jnp.einsum("kij,bjm->kbim", powers, starts)
    return jnp.moveaxis(states, 0, 1).reshape(n, ns, m), last


def _readings(steps: _Steps, force: Array, start: Array) -> tuple[Array, Array]:
    """Return the derivatives of the readings of a segment (n, C, ns + 2 E), and those of the state at its end (ns, ns + 2 E).

    They are derivatives with respect to the state at the first sample and the components of the unbalances.

    **Arguments**: `start` (ns, ns + 2 E): the derivatives of the state at the start of the segment.
    """
    ns = steps.power.shape[0]
    n, exciters = force.shape[0], steps.inputs.shape[2]
    parts = force.reshape(n, 4, exciters, 2)
    by_unbalance = jnp.einsum("jsebf,njef->nseb", steps.inputs, parts[:, 1:]).reshape(n, ns, 2 * exciters)
    forcing = jnp.concatenate([jnp.zeros((n, ns, ns)), by_unbalance], axis=2)
    states, end = _march(steps.power, forcing, start)
    direct = jnp.einsum("cebf,nef->nceb", steps.through, parts[:, 0]).reshape(n, -1, 2 * exciters)
    readings = jnp.einsum("cs,nsm->ncm", steps.outputs, states)
    return readings.at[:, :, ns:].add(direct), end


def _response(steps: _Steps, force: Array, start: Array, unbalance: Array) -> tuple[Array, Array]:
    """Return the readings (n, C) for `unbalance` (E, 2) from the state `start` (ns,), and the state at the end."""
    n, exciters = force.shape[0], steps.inputs.shape[2]
    parts = force.reshape(n, 4, exciters, 2)
    inputs = jnp.einsum("jsebf,eb->jsef", steps.inputs, unbalance)
    forcing = jnp.einsum("jsef,njef->ns", inputs, parts[:, 1:])
    states, end = _march(steps.power, forcing[:, :, None], start[:, None])
    direct = jnp.einsum("cebf,eb,nef->nc", steps.through, unbalance, parts[:, 0])
    return states[:, :, 0] @ steps.outputs.T + direct, end[:, 0]


def _filtered(taps: Array, before: Array, values: Array) -> tuple[Array, Array]:
    """Return the readings (n, C, k) after the filter `taps` (m + 1, C), and the last m readings for the next segment."""
    m, n = taps.shape[0] - 1, values.shape[0]
    every = jnp.concatenate([before, values])
    parts = [taps[j][None, :, None] * every[m - j : m - j + n] for j in range(m + 1)]
    out = sum(parts[1:], parts[0])
    return out, every[n:]


def _build_steps(unknowns: Unknowns, samples: Samples, scene: Scene, x: Array) -> _Steps:
    """Return the steps of a run, with the gains of its channels, at the unknowns `x`."""
    scene_of_run = samples.scene(unknowns.scene(scene, x))
    turn = 0.0 if samples.turn is None else x[unknowns.first.shape[0] + len(unknowns.gains) + samples.turn]
    steps = _steps(scene_of_run, samples.channels, samples.step, turn)
    gains = jnp.stack([jnp.asarray(unknowns.gain(x, channel.name)) for channel in samples.channels])
    return steps._replace(outputs=gains[:, None] * steps.outputs, through=gains[:, None, None, None] * steps.through)


def _forces(samples: Samples, scene: Scene, x: Array, segment: Array) -> tuple[Array, Array]:
    """Return F (n, 4, 2 E), (horizontal, up) for each exciter, at each sample of a segment and at the three Gauss points of the
    step that follows, and the derivatives (m, n, 4, 2) of F with respect to the errors of the rotor's angle."""
    first, count = samples.errors
    n = samples.readings.shape[1]
    places = (segment * n + jnp.arange(n))[:, None] + jnp.asarray([0.0, *GAUSS_POINTS])[None]
    times = jnp.minimum(samples.begin + samples.step * places, samples.end).ravel()
    forces, changes = [], jnp.zeros((0, n, 4, 2))
    for drive, exciter in zip(samples.drives, scene.exciters, strict=True):
        turned = drive.with_errors(x[first : first + count]) if count and isinstance(drive, RecordedDrive) else drive
        theta = jax.vmap(lambda t, turned=turned: turned.rotor_angle(t, None))(times)
        rate = jax.vmap(lambda t, turned=turned: turned.rotor_speed(t, None))(times)
        acceleration: Any = jax.vmap(turned.rotor_acceleration)(times)
        turning = 1j * exciter.direction
        unit = jnp.exp(turning * theta)
        forces.append((rate**2 - turning * acceleration) * unit)
        if count and isinstance(turned, RecordedDrive):  # the scene has one exciter
            error, error_rate, error_acceleration = (
                jax.vmap(lambda t, k=k, turned=turned: turned.columns_at(t, k)[1:], out_axes=1)(times) for k in range(3)
            )
            change = 2.0 * rate[None] * error_rate - turning * error_acceleration
            found = change * unit[None] + turning * error * forces[0][None]
            changes = jnp.stack([found.real, found.imag], axis=-1).reshape(count, n, 4, 2)
    both = [part for force in forces for part in (force.real, force.imag)]
    return jnp.stack(both, axis=-1).reshape(n, 4, len(both)), changes


def _linear_columns(steps: _Steps, samples: Samples):
    """Return the initial carry and the function of a scan over the segments.

    The function returns the next carry and the columns (n, C, ns + 2 E + C) of a segment: the derivatives of its readings with
    respect to the linear unknowns.
    """
    ns, exciters, count = steps.power.shape[0], steps.inputs.shape[2], len(samples.channels)
    size, m = ns + 2 * exciters, samples.taps.shape[0] - 1
    first = jnp.concatenate([jnp.eye(ns), jnp.zeros((ns, 2 * exciters))], axis=1), jnp.zeros((m, count, size))
    level = jnp.sum(samples.taps, axis=0)  # the filtered value of a constant offset

    def columns(carry: tuple[Array, Array], force: Array) -> tuple[tuple[Array, Array], Array]:
        state, before = carry
        raw, end = _readings(steps, force, state)
        out, after = _filtered(samples.taps, before, raw)
        offsets = jnp.broadcast_to(jnp.diag(level), (force.shape[0], count, count))
        return (end, after), jnp.concatenate([out, offsets], axis=2)

    return first, columns


@cached
def linear_equations(unknowns: Unknowns, samples: Samples, scene: Scene, x: Array) -> Array:
    """Return Z^T Z at the unknowns `x`, with the weighted columns Z = (derivatives of the readings with respect to the linear
    unknowns of the run, readings)."""
    first, columns = _linear_columns(_build_steps(unknowns, samples, scene, x), samples)

    def segment(carry, part):
        (state, total), (k, readings, weights) = carry, part
        state, found = columns(state, _forces(samples, scene, x, k)[0])
        z = (jnp.concatenate([found, readings[:, :, None]], axis=2) * weights[:, :, None]).reshape(-1, found.shape[2] + 1)
        return (state, total + z.T @ z), None

    size = first[0].shape[1] + len(samples.channels) + 1
    parts = jnp.arange(samples.readings.shape[0]), samples.readings, samples.weights
    (_, total), _ = jax.lax.scan(segment, (first, jnp.zeros((size, size))), parts)
    return total


@cached
def normal_equations(unknowns: Unknowns, samples: Samples, scene: Scene, x: Array, linear: Array) -> Array:
    """Return Z^T Z of Z = (derivatives with respect to x and the linear unknowns of the run, readings minus model).

    **Arguments**: `linear`: state at the first sample, components of the unbalances, offsets.
    """
    steps = _build_steps(unknowns, samples, scene, x)
    first, columns = _linear_columns(steps, samples)
    _, unbalance, _ = _split(steps, linear)
    first_error, errors = samples.errors
    tangent_count = x.shape[0] - unknowns.errors

    def tangent(direction: Array) -> _Steps:
        return jax.jvp(lambda at: _build_steps(unknowns, samples, scene, at), (x,), (direction,))[1]

    changes = jax.vmap(tangent)(jnp.eye(x.shape[0])[:tangent_count])

    def segment(carry, part):
        (linear_state, (tangent_states, error_states, before), total), (k, readings, weights) = carry, part
        force, force_changes = _forces(samples, scene, x, k)
        at = linear_state[0] @ linear[: linear_state[0].shape[1]]
        linear_state, found = columns(linear_state, force)

        def along(change: _Steps, start: Array) -> tuple[Array, Array]:
            return jax.jvp(lambda steps, start: _response(steps, force, start, unbalance), (steps, at), (change, start))[1]

        slopes, tangent_states = jax.vmap(along)(changes, tangent_states)
        if errors:
            by_error, error_states = jax.vmap(lambda change, start: _response(steps, change, start, unbalance))(
                force_changes, error_states
            )
            others, place = jnp.zeros((unknowns.errors, *slopes.shape[1:])), first_error - tangent_count
            slopes = jnp.concatenate([slopes, others.at[place : place + errors].set(by_error)])
        elif unknowns.errors:
            slopes = jnp.concatenate([slopes, jnp.zeros((unknowns.errors, *slopes.shape[1:]))])
        slopes, after = _filtered(samples.taps, before, jnp.moveaxis(slopes, 0, 2))
        difference = readings - found @ linear
        z = jnp.concatenate([slopes, found, difference[:, :, None]], axis=2) * weights[:, :, None]
        z = z.reshape(-1, z.shape[2])
        return (linear_state, (tangent_states, error_states, after), total + z.T @ z), None

    count, size, states = x.shape[0], x.shape[0] + linear.shape[0] + 1, steps.power.shape[0]
    before = jnp.zeros((samples.taps.shape[0] - 1, len(samples.channels), count))
    start = (first, (jnp.zeros((tangent_count, states)), jnp.zeros((errors, states)), before), jnp.zeros((size, size)))
    # Reverse derivatives compute each segment again and keep only the states between the segments.
    parts = jnp.arange(samples.readings.shape[0]), samples.readings, samples.weights
    (_, _, total), _ = jax.lax.scan(jax.checkpoint(segment), start, parts)
    return total


@cached
def model_readings(unknowns: Unknowns, samples: Samples, scene: Scene, x: Array, linear: Array) -> Array:
    """Return the readings (N n, C) of the model with its offsets, without the filter."""
    steps = _build_steps(unknowns, samples, scene, x)
    return _all_readings(steps, samples, scene, x, linear) + _split(steps, linear)[2][None]


@cached
def linear_steps(unknowns: Unknowns, samples: Samples, scene: Scene, x: Array) -> tuple[Array, Array]:
    """Return the matrices of a step of the free motion (ns, ns) and of the readings (C, ns), for states whose displacements are
    in m and velocities in m/s."""
    steps, nd = _build_steps(unknowns, samples, scene, x), len(scene.machine.structure().coordinates)
    unit = jnp.where(jnp.arange(steps.power.shape[0]) < nd, steps.scale, 1.0)
    return steps.power * unit[None] / unit[:, None], steps.outputs * unit[None]


@cached
def model_states(unknowns: Unknowns, samples: Samples, scene: Scene, x: Array, linear: Array) -> Array:
    """Return the displacements and velocities (N n, 2 nd) of the coordinates."""
    steps, nd = _build_steps(unknowns, samples, scene, x), len(scene.machine.structure().coordinates)
    outputs = jnp.eye(2 * nd, steps.power.shape[0]) / jnp.where(jnp.arange(2 * nd) < nd, steps.scale, 1.0)[:, None]
    through = jnp.zeros((2 * nd, *steps.through.shape[1:]))
    return _all_readings(steps._replace(outputs=outputs, through=through), samples, scene, x, linear)


def _all_readings(steps: _Steps, samples: Samples, scene: Scene, x: Array, linear: Array) -> Array:
    """Return the readings (N n, C) of the model without offsets."""
    state, unbalance, _ = _split(steps, linear)

    def segment(state: Array, k: Array) -> tuple[Array, Array]:
        readings, state = _response(steps, _forces(samples, scene, x, k)[0], state, unbalance)
        return state, readings

    _, found = jax.lax.scan(segment, state, jnp.arange(samples.readings.shape[0]))
    return found.reshape(-1, found.shape[2])


def _split(steps: _Steps, linear: Array) -> tuple[Array, Array, Array]:
    """Return the state (ns,) at the first sample, the unbalances (E, 2) and the offsets (C,)."""
    ns, exciters = steps.power.shape[0], steps.inputs.shape[2]
    ends = ns + 2 * exciters
    return linear[:ns], linear[ns:ends].reshape(exciters, 2), linear[ends:]
