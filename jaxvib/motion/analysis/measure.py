"""Measurement of a sampled motion: amplitudes, mean speeds, foundation force."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxvib.display import quantity_text, speed_text
from jaxvib.equations.dynamics import Dynamics
from jaxvib.equations.model import Model
from jaxvib.equations.state import State
from jaxvib.errors import InputError
from jaxvib.machine.drives.drive import SpinUp
from jaxvib.machine.scene import Scene
from jaxvib.numerics.extrema import NODES, between, extremum_value, locate_extrema, step_extrema
from jaxvib.ode.scalarize import scalarized_vmap
from jaxvib.results.fields import in_unit, part
from jaxvib.results.readable import Readable
from jaxvib.runtime.programs import cached

MIN_CHANGE_SCALE = 1e-4
"""Smallest scale for relative changes, in units of the unbalance radius S/M for amplitudes and of S n^2 for forces. It is
needed because the amplitude and the force of a balanced rotor are almost zero."""

ROOT_SUM_SQUARE = "root sum square of both directions"
"""Text on a foundation force of two directions: the root of the sum of the squares of both peaks."""

ROTATING_FORCE = "sqrt(2) times the magnitude of a force that rotates"
"""Relation of `ROOT_SUM_SQUARE` and the magnitude of a foundation force that rotates."""

_POINTS_IN_STEP = 8
"""Number of points in each sampling step at which a kinked force is searched for extrema. A second search covers the distance
to the next point on each side of the extremum. It divides each of these two distances into the same number of parts."""

_MAX_SPREAD_OF_MEAN = 0.2
"""Largest difference of the speeds of turning masses, relative to the largest speed, with which their mean is stated."""

_MIN_SHOWN_RIPPLE = 0.01
"""Smallest variation of the rotor speeds about their means, relative to the largest speed, that the text of a run states."""

STILL_SHARE = 0.01
"""Speed of a rotor, relative to a working or resonance speed, below which texts state that it is at rest."""

_AT_END = " at the end"

_MAX_SHOWN_AS_MEAN = 0.03
"""Largest difference between the mean speeds at the end of a window and in the whole window, relative to the largest speed, of
a text that states the means of the window only."""

_LAST_PARTS = 10
"""Number of equal parts of a window; the speeds at its end are means over whole turns in the last part."""

_MAX_CONSTANT_SPREAD = 0.01
"""Largest difference of the speeds of a rotor, relative to the largest one, with which its speed counts as constant."""

Field = Callable[[Array, State], State]
"""Equations of motion: function from a time and a state to the rates of the state."""


class Trajectory(Readable):
    """States at some times.

    **Attributes** (nt times)

    - `time` (nt,), s
    - `state`: a `State` whose arrays have a leading axis over the times
    - `foundation_force` (nt, nb), N: force of the supports on the foundation in its nb directions
    - `rotor_angles`, rad, continuous over whole turns, and `rotor_speeds`, rad/s: an array (nt,) for each exciter. If there is
      only one exciter, `rotor_angle` and `rotor_speed` are its arrays
    """

    time: Array = eqx.field(metadata=in_unit("s", "time"))
    state: State = eqx.field(metadata=part("time"))
    foundation_force: Array = eqx.field(metadata=in_unit("N", "time", "direction"))
    rotor_angles: tuple[Array, ...] = eqx.field(metadata=in_unit("rad", "time", name="rotor_angle"))
    rotor_speeds: tuple[Array, ...] = eqx.field(metadata=in_unit("rad/s", "time", name="rotor_speed"))

    @property
    def rotor_angle(self) -> Array:
        """Rotor angle of a scene with one exciter, rad, continuous over whole turns. **Raises** `InputError` for several."""
        return only_exciter_value(self.rotor_angles, "rotor_angles")

    @property
    def rotor_speed(self) -> Array:
        """Speed of the rotor of a scene with one exciter, rad/s. **Raises** `InputError` for several."""
        return only_exciter_value(self.rotor_speeds, "rotor_speeds")


def only_exciter_value(values: tuple[Array, ...], name: str) -> Array:
    """Return the value of the only exciter. **Raises** `InputError` for several exciters."""
    if len(values) != 1:
        raise InputError(name, f"are those of {len(values)} exciters; read {name}[0] and so on")
    return values[0]


class AbstractMeasured(Readable):
    """Quantities of a motion, measured over the window at the end of a run.

    **Attributes**

    - `load_speed` (count,), rad/s: mean speed of each load over whole turns, negative if it turns clockwise; for an exciter
      without loads, that of its rotor
    - `omega`, rad/s: mean of these speeds, each positive in the direction of rotation of its exciter
    - `amplitude` (nd,), m (rad for tilts), zero to peak, that is half of the peak-to-peak value; typical: 0.5 to 10 mm
    - `foundation_force`, N, zero to peak; for a force with two directions the root of the sum of the squares of both; typical:
      10 N to 10 kN
    - `drift`: the largest of three relative changes within the window
    - `settled`: True if the drift is below 1e-3

    The three changes are

    - the change of an amplitude from the first to the second half of the window, relative to the largest amplitude, or to 1e-4
      of the unbalance radius S/M if that is larger (the amplitude of a balanced rotor is almost zero). For this comparison the
      amplitude of a tilt or rotation is multiplied by the length sqrt(mean moment of inertia / mean mass) of the machine
    - the change of the foundation force from the first to the second half, relative to the largest force, or to 1e-4 of S n^2
      (n: rotor speed) if that is larger
    - the difference between the mean speeds of a load in the second half and in the whole window, relative to `omega`
    """

    omega: Array = eqx.field(metadata=in_unit("rad/s"))
    load_speed: Array = eqx.field(metadata=in_unit("rad/s", "load"))
    amplitude: Array = eqx.field(metadata=in_unit("m or rad", "coordinate"))
    foundation_force: Array = eqx.field(metadata=in_unit("N", name="foundation_force_amplitude"))
    drift: Array = eqx.field(metadata=in_unit(""))

    @property
    def settled(self) -> Array:
        """True if the relative changes of amplitudes, force and speeds are below 1e-3."""
        return self.drift < 1e-3

    def require_single(self) -> None:
        """**Raises** `InputError` for a batch of runs."""
        if jnp.ndim(self.omega):
            shape = jnp.shape(self.omega)
            advice = "take one of them, jax.tree.map(lambda x: x[0], runs), or call this inside of jax.vmap"
            raise InputError("run", f"is a batch of runs of shape {shape}; {advice}")

    def amplitude_text(self, scene: Scene) -> str:
        """Return the amplitudes and the foundation force of a `scene` as a line of text."""
        structure = scene.machine.structure()
        named = zip(structure.coordinates, self.amplitude, structure.units, strict=True)
        amplitude = ", ".join(f"{name} {quantity_text(a, unit, 4)}" for name, a, unit in named)
        force = quantity_text(self.foundation_force, "N", 4) if scene.machine.has_foundation else "unknown"
        kind = (
            f" ({ROOT_SUM_SQUARE}: {ROTATING_FORCE})"
            if scene.machine.has_foundation and len(structure.foundation_directions) > 1
            else ""
        )
        return f"amplitude, zero to peak: {amplitude}; foundation force {force}{kind}"

    def speeds_text(self, scene: Scene, rotor_speeds: Sequence[ArrayLike], last_speed: Array | None = None) -> str:
        """Return a line of text with the speeds of the turning masses, the last of the `rotor_speeds` (nt,), rad/s, of each
        exciter with loads, and in a settled motion the variation of the speeds of the other rotors.

        The mean speed is left out if the speeds differ much, for example because a motor stands still. If a rotor speed is not
        constant, the text states that it is the last one. If the mean speeds of the turning masses at the end, `last_speed`
        (loads,), differ from those of the window, because a mass passed a resonance in it, the text begins with them.
        """
        mean, end = np.asarray(self.load_speed), np.asarray(self.load_speed if last_speed is None else last_speed)
        fastest = np.max(np.abs(end))
        turns = fastest > STILL_SHARE * float(scene.top_speed)
        if turns and not bool(self.settled) and np.max(np.abs(end - mean)) > _MAX_SHOWN_AS_MEAN * fastest:
            recent = [speeds[last_samples(len(speeds))] for speeds in map(np.asarray, rotor_speeds)]
            at_end = dataclasses.replace(self, load_speed=end, omega=np.mean(turning_directions(scene) * end))
            means = f"means of the window, in which the speeds change: {speed_text(mean, 6)}"
            return f"at the end, {at_end.speeds_text(scene, recent).replace(_AT_END, '')}; {means}"
        exciters = [*zip(scene.exciters, map(np.asarray, rotor_speeds), strict=True)]
        histories = [speeds for exciter, speeds in exciters if exciter.loads is not None]
        changes = any(np.ptp(speeds) > _MAX_CONSTANT_SPREAD * np.max(np.abs(speeds)) for speeds in histories)
        last = speed_text([speeds[-1] for speeds in histories], 6) + (_AT_END if changes else "")
        rotor = f", {'rotor' if len(histories) == 1 else 'rotors'} at {last}" if histories else ""
        clockwise = np.any(np.asarray([exciter.direction for exciter in scene.exciters]) < 0)
        each = speed_text(self.load_speed, 6) + ("; negative: clockwise" if clockwise else "")
        magnitudes = np.abs(np.asarray(self.load_speed))
        if np.ptp(magnitudes) <= _MAX_SPREAD_OF_MEAN * np.max(magnitudes):
            each = f"{speed_text(self.omega, 6)} (each: {each})"
        swings = [np.asarray(speeds) for speeds in rotor_speeds if np.min(speeds) < 0.0 < np.max(speeds)]
        largest = max((float(np.max(np.abs(speeds))) for speeds in swings), default=0.0)
        swing = f"; a rotor swings, at up to {speed_text(largest, 4)}" if largest > 0.0 else ""
        ripple = max((float(np.ptp(speeds)) / 2.0 for exciter, speeds in exciters if exciter.loads is None), default=0.0)
        if bool(self.settled) and not swing and ripple > _MIN_SHOWN_RIPPLE * float(np.max(magnitudes)):
            swing = f"; rotor speeds vary by ±{speed_text(ripple, 3)}"
        return f"{turning_masses(scene)} turn at {each}{rotor}{swing}"


def last_samples(count: int) -> slice:
    """Return the samples at the end of a window of `count` samples, over which the final speeds are means."""
    return slice(count - max(2, count // _LAST_PARTS), None)


@cached
def last_mean_speeds(times: Array, angle: Array, rate: Array) -> Array:
    """Return the mean speeds (m,), rad/s, over the whole turns at the end of a window, for arguments as in `mean_speeds`."""
    return mean_speeds(times, angle, rate, (last_samples(len(times)).start,))[0]


def duration_text(scene: Scene, end: Array) -> str:
    """Return the time at which a run ends, and the duration of its spin-up, as text."""
    spin_ups = [float(each.drive.duration) for each in scene.exciters if isinstance(each.drive, SpinUp)]
    return f"{float(end):.6g} s" + (f" (spin-up during the first {max(spin_ups):.4g} s)" if spin_ups else "")


def turning_masses(scene: Scene) -> str:
    """Return the name of the masses to which `load_speed` belongs: "loads", "exciters", or both."""
    has_loads = [exciter.loads is not None for exciter in scene.exciters]
    return "loads" if all(has_loads) else "loads and exciters" if any(has_loads) else "exciters"


class Measured(AbstractMeasured):
    """Result of `measure`, see `AbstractMeasured`."""


def trajectory(model: Model, times: Array, states: State) -> Trajectory:
    """Return the trajectory of `states` at `times`, s, with foundation forces, rotor angles and rotor speeds."""
    force = model.known_force(jax.vmap(model.foundation_force)(states.displacement, states.velocity))
    pairs = [
        (exciter.turning_drive, exciter_state.rotor)
        for exciter, exciter_state in zip(model.scene.exciters, states.exciters, strict=True)
    ]
    angles = tuple(jax.vmap(drive.rotor_angle)(times, rotor) for drive, rotor in pairs)
    speeds = tuple(jax.vmap(drive.rotor_speed)(times, rotor) for drive, rotor in pairs)
    return Trajectory(times, states, force, angles, speeds)


def turning_angles(scene: Scene, times: Callable[[], Array], states: State) -> tuple[Array, Array]:
    """Return angles (nt, n), rad, and rates, rad/s, of the turning masses of all exciters, in the order of the exciters: their
    loads or, without loads, their rotor. `times` returns the times (nt,), s, of the states; it is called for rotors only."""
    columns: list[tuple[Array, Array]] = []
    for exciter, exciter_state in zip(scene.exciters, states.exciters, strict=True):
        if exciter_state.angle:
            columns.append((exciter_state.angle[0], exciter_state.rate[0]))
        else:
            drive, time = exciter.turning_drive, times()
            angle = jax.vmap(drive.rotor_angle)(time, exciter_state.rotor)
            rate = jax.vmap(drive.rotor_speed)(time, exciter_state.rotor)
            columns.append((angle[:, None], rate[:, None]))
    if len(columns) == 1:
        return columns[0]
    angles, rates = zip(*columns, strict=True)
    return jnp.concatenate(angles, axis=1), jnp.concatenate(rates, axis=1)


def turning_directions(scene: Scene) -> np.ndarray:
    """Return the direction, 1 or -1, of each column of `turning_angles`."""
    return np.repeat([e.direction for e in scene.exciters], [1 if e.loads is None else e.loads.count for e in scene.exciters])


def measure(model: Model, field: Field, times: Array, states: State, unit: State, extrema: Extrema | None = None) -> Measured:
    """Measure the amplitudes and the load speed of an evenly sampled part of a motion, see `Measured`.

    **Arguments**: `field` returns the rates of a state at a time; it must be a pytree of its arrays, such as `Dynamics` or a
    `jax.tree_util.Partial`; `unit`: the `natural_units` of the scene; `extrema` between each sample and the next; default:
    those of interpolants that use the rates.
    """
    nd, half = states.displacement.shape[1], times.shape[0] // 2
    if extrema is None:
        early, late, whole = (_spans_of_kinked_force if model.has_kinked_force else _spans)(model, field, times, states)
    else:
        early, late, whole = (extrema.part(steps).spans for steps in (slice(half - 1), slice(half, None), slice(None)))

    speeds, late_speeds = mean_speeds(times, *turning_angles(model.scene, lambda: times, states), (0, half))
    change = jnp.abs(late - early)
    amplitude_change, largest = (jnp.max(model.carrier.as_lengths(x[:nd])) for x in (change, whole))
    drift = amplitude_change / jnp.maximum(largest, MIN_CHANGE_SCALE * unit.displacement)
    force_drift = jnp.max(change[nd:]) / jnp.maximum(jnp.max(whole[nd:]), MIN_CHANGE_SCALE * model.natural_force(unit))
    directions = turning_directions(model.scene)
    omega = jnp.mean(speeds if np.all(directions == 1) else directions * speeds)
    speed_drift = jnp.max(jnp.abs(late_speeds - speeds)) / jnp.maximum(jnp.abs(omega), jnp.finfo(omega.dtype).tiny)
    return Measured(
        omega=omega,
        load_speed=speeds,
        amplitude=whole[:nd],
        foundation_force=model.known_force(jnp.sqrt(jnp.sum(whole[nd:] ** 2)) if whole.shape[0] > nd + 1 else whole[nd]),
        drift=jnp.maximum(jnp.maximum(drift, force_drift), speed_drift),
    )


def unmeasured(model: Model, states: State) -> Measured:
    """Return the result of `measure` for these states with NaN for all values."""
    nd, loads = states.displacement.shape[1], turning_directions(model.scene).size
    shapes = {"omega": (), "load_speed": (loads,), "amplitude": (nd,), "foundation_force": (), "drift": ()}
    return Measured(**{name: jnp.full(shape, jnp.nan, states.displacement.dtype) for name, shape in shapes.items()})


@eqx.filter_custom_jvp
def _spans(model: Model, field: Field, times: Array, states: State) -> Array:
    """Return half of the peak-to-peak values of displacements and foundation forces, (3, outputs): over the first half of the
    samples, over the second half, and over all of them. Only evaluations at the samples next to extrema are differentiated."""
    (low, high), _, _ = _extrema(model, field, times, states)
    return (high - low) / 2.0


@_spans.def_jvp
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    _, samples, places = _extrema(*jax.lax.stop_gradient(primals))
    outputs = jnp.broadcast_to(jnp.arange(samples.shape[-1]), samples.shape)

    def spans(model: Model, field: Field, times: Array, states: State) -> Array:
        def extremum(output: Array, k: Array, place: Array) -> Array:
            def sample(j: Array) -> tuple[Array, Array]:
                state = jax.tree.map(lambda leaf: leaf[j], states)
                value, slope = _outputs(model, _step(times), state, field(times[j], state))
                return value[output], slope[output]

            return extremum_value(*jax.vmap(sample)(k + jnp.arange(NODES)), place)

        low, high = jax.vmap(jax.vmap(jax.vmap(extremum)))(outputs, samples, places)
        return (high - low) / 2.0

    return eqx.filter_jvp(spans, primals, tangents)


def _extrema(model: Model, field: Field, times: Array, states: State) -> tuple[Array, Array, Array]:
    """Return extrema of each output, their first samples and positions, (2, 3, outputs) each, see `locate_extrema`."""
    # One output after the other fits the CPU's cache.
    values_and_places = jax.lax.map(lambda pair: locate_extrema(*pair), _sampled_outputs(model, field, times, states))
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), values_and_places)


def _spans_of_kinked_force(model: Model, field: Field, times: Array, states: State) -> Array:
    """Return `_spans` for a force that jumps or has kinks. The polynomials of `locate_extrema` would overshoot at a jump."""

    def outputs(displacement: Array, velocity: Array) -> Array:
        return jnp.concatenate([displacement, model.foundation_force(displacement, velocity)])

    low, high = _kinked_extrema(outputs, field, times, states)
    return (high - low) / 2.0


def _kinked_extrema(outputs: Callable[[Array, Array], Array], field: Field, times: Array, states: State) -> Array:
    """Return the extrema (2, 3, n) of n outputs that are not smooth, in the order of `locate_extrema`.

    `outputs` is their function of displacement and velocity; the other arguments are those of `measure`.

    Between two samples, the outputs are computed from interpolated displacements and velocities. The search for the extrema is
    not differentiated; their values are.
    """
    step, count, m = _step(times), times.shape[0], _POINTS_IN_STEP

    def motion(states: State, rates: State) -> tuple[Array, Array, Array]:
        return states.displacement, states.velocity * step, rates.velocity * step**2

    def at(begin: Sequence[Array], end: Sequence[Array], share: Array) -> Array:
        displacement, slope = between(begin, end, share)
        return outputs(displacement, slope / step)

    def first_sample(place: Array) -> Array:
        return jnp.clip(place.astype(int), 0, count - 2)

    samples = motion(states, scalarized_vmap(_rates)((times, states), field))
    begin, end = [x[:-1] for x in samples], [x[1:] for x in samples]
    points = jnp.asarray(np.arange(m) / m, times.dtype)
    values = jax.vmap(lambda begin, end: jax.vmap(lambda share: at(begin, end, share))(points))(begin, end)
    last = at([x[-1] for x in begin], [x[-1] for x in end], jnp.ones_like(step))
    values = jnp.concatenate([values.reshape(-1, values.shape[-1]), last[None]])
    numbers = jnp.arange(values.shape[-1])

    def places_of_maxima(sign: Array) -> Array:
        """Positions (3, n) of the maxima of `sign` times the outputs, in steps from the first sample."""

        def place(start: int, stop: int) -> Array:
            near = (start * m + jnp.argmax(sign * values[start * m : stop * m + 1], axis=0)) / m
            near = jnp.clip(near[None] + np.linspace(-1.0 / m, 1.0 / m, 2 * m + 1)[:, None], start, stop).astype(times.dtype)

            def value(output: Array, place: Array) -> Array:
                k = first_sample(place)
                return at([x[k] for x in begin], [x[k] for x in end], place - k)[output]

            best = jnp.argmax(sign * jax.vmap(jax.vmap(value), in_axes=(None, 0))(numbers, near), axis=0)
            return near[best, numbers]

        half = count // 2
        return jnp.stack([place(0, half - 1), place(half, count - 1), place(0, count - 1)])

    signs = jnp.asarray([-1.0, 1.0], times.dtype)
    places = jax.lax.stop_gradient(jax.vmap(places_of_maxima)(signs))

    def extremum(output: Array, place: Array, sign: Array) -> Array:
        k = first_sample(place)
        end_times, ends = jax.tree.map(lambda leaf: leaf[k + np.arange(2)], (times, states))
        first, second = zip(*motion(ends, jax.vmap(field)(end_times, ends)), strict=True)

        def value(place: Array) -> Array:
            return at(first, second, place - k)[output]

        # The derivatives are those of the value at a fixed place. They are correct if the slope at this place is 0; therefore a
        # step of Newton's method improves the place. The step fails at a kink; the place is then kept.
        slope, curvature = jax.grad(value)(place), jax.grad(jax.grad(value))(place)
        moved = place - slope / jnp.where(curvature == 0.0, 1.0, curvature)
        near = (jnp.abs(moved - place) * m**2 <= 1.0) & (sign * value(moved) >= sign * value(place))
        return value(jax.lax.stop_gradient(jnp.where(near, moved, place)))

    return jax.vmap(jax.vmap(jax.vmap(extremum, (0, 0, None)), (None, 0, None)), (None, 0, 0))(numbers, places, signs)


class Peaks(NamedTuple):
    """Largest `displacement` (nd,), m or rad, of each coordinate from static equilibrium, and magnitude of the foundation
    `force`, N, in a motion."""

    displacement: Array
    force: Array


def locate_peaks(model: Model, field: Field, times: Array, states: State) -> Peaks:
    """Return the largest values of an evenly sampled part of a motion, for arguments as in `measure`."""
    nd = states.displacement.shape[1]
    if model.has_kinked_force:

        def squares(displacement: Array, velocity: Array) -> Array:
            force = model.foundation_force(displacement, velocity)
            return jnp.concatenate([displacement, jnp.sum(force**2)[None]])

        low, high = _kinked_extrema(squares, field, times, states)
        return Peaks(jnp.maximum(-low[2], high[2])[:nd], model.known_force(jnp.sqrt(high[2, nd])))
    values, slopes = _sampled_outputs(model, field, times, states)
    (low, high), _, _ = jax.vmap(locate_extrema, out_axes=-1)(values[:nd], slopes[:nd])
    force, change = values[nd:], slopes[nd:]
    _, first, position = locate_extrema(jnp.sum(force**2, axis=0), 2.0 * jnp.sum(force * change, axis=0))
    at, place = first[1, 2] + jnp.arange(NODES), position[1, 2]
    largest_force = jax.vmap(lambda x, v: extremum_value(x[at], v[at], place))(force, change)
    return Peaks(jnp.maximum(-low[2], high[2]), model.known_force(jnp.sqrt(jnp.sum(largest_force**2))))


class Extrema(NamedTuple):
    """Extrema `low`, `high` (..., outputs) of displacements and of foundation forces with kinks and jumps, and the largest
    `square` (...), N^2, of the magnitude of the foundation force. A leading axis, if any, counts parts of a run."""

    low: Array
    high: Array
    square: Array

    @property
    def spans(self) -> Array:
        """Half of the peak-to-peak values (..., outputs)."""
        return (self.high - self.low) / 2.0

    def part(self, steps: slice = slice(None)) -> Extrema:
        """Return the extrema over all the given `steps`, a slice of the leading axis."""
        low, high, square = (x[steps] for x in self)
        return Extrema(jnp.min(low, axis=0), jnp.max(high, axis=0), jnp.max(square, axis=0))

    def peaks(self, model: Model) -> Peaks:
        nd = model.carrier.mass.shape[0]
        return Peaks(jnp.maximum(-self.low, self.high)[..., :nd], model.known_force(jnp.sqrt(self.square)))


def extrema_of_steps(model: Model, field: Field, times: Array, states: State) -> Extrema:
    """Return the extrema of consecutive steps of equal length, for arguments as in `measure`."""
    nd = states.displacement.shape[1]
    values, slopes = _sampled_outputs(model, field, times, states)
    low, high = step_extrema(values.T, slopes.T)
    force, change = values[nd:], slopes[nd:]
    _, square = step_extrema(jnp.sum(force**2, axis=0), 2.0 * jnp.sum(force * change, axis=0))
    return Extrema(low, high, square)


def _sampled_outputs(model: Model, field: Field, times: Array, states: State) -> tuple[Array, Array]:
    """Return displacements and foundation forces (outputs, nt), and their rates times the sampling step."""
    carrier, step = model.carrier, _step(times)
    nb, nd = carrier.foundation_damping.shape
    if isinstance(field, Dynamics) and not model.supports and 2 * (field.rows.shape[0] + nb) < nd:
        # The rate of the force is T_K q' + T_C q'' (T_K, T_C: stiffness and damping matrices of the foundation force). The few
        # accelerations T_C q'' cost less than all of q''.
        field = field.at_rows(carrier.foundation_damping)
        q, v = states.displacement, states.velocity
        damping_rate = scalarized_vmap(_rates)((times, states), field).velocity[:, -nb:]
        force, change = jax.vmap(model.foundation_force)(q, v), v @ carrier.foundation_stiffness.T + damping_rate
        return jnp.concatenate([q, force], axis=1).T, jnp.concatenate([v, change], axis=1).T * step
    rates = scalarized_vmap(_rates)((times, states), field)
    return jax.vmap(lambda *y: _outputs(model, step, *y), out_axes=-1)(states, rates)


def _rates(time_and_state: tuple[Array, State], field: Field) -> State:
    return field(*time_and_state)


def _outputs(model: Model, step: Array, state: State, rates: State) -> tuple[Array, Array]:
    """Return displacements and foundation forces, and their rates times the sampling step."""
    force, change = jax.jvp(lambda s: model.foundation_force(s.displacement, s.velocity), (state,), (rates,))
    return jnp.concatenate([state.displacement, force]), jnp.concatenate([rates.displacement, change]) * step


def mean_speeds(times: Array, angle: Array, rate: Array, first: Sequence[int], last: Sequence[int] | None = None) -> Array:
    """Return mean speeds (parts, m), rad/s, over the whole turns that end at the last sample of each part, or over the whole
    part if it is shorter than a turn.

    **Arguments**: `times` (n,) s; `angle` (n, m) rad and its `rate`, rad/s; the `first` and the `last` sample of each part
    (default: the last sample of all).
    """
    ends = [len(times) - 1] * len(first) if last is None else last
    speeds_of_part = jax.vmap(_mean_speed, in_axes=(None, 1, 1, None, None))
    return jax.vmap(speeds_of_part, in_axes=(None, None, None, 0, 0))(times, angle, rate, jnp.asarray(first), jnp.asarray(ends))


def _mean_speed(t: Array, phi: Array, rate: Array, first: Array, last: Array) -> Array:
    samples = jnp.stack([t, phi, rate])

    def sample(k: Array) -> Array:
        return samples.at[:, k].get(mode="promise_in_bounds", wrap_negative_indices=False)

    (begin, phi_begin, _), (end, phi_end, _) = jnp.unstack(sample(first)), jnp.unstack(sample(last))
    total = phi_end - phi_begin
    turns = jnp.floor(jnp.abs(total) / (2.0 * jnp.pi))
    target = phi_end - jnp.sign(total) * 2.0 * jnp.pi * turns
    k = jnp.arange(t.shape[0])
    i = jnp.argmin(jnp.where((k >= first) & (k <= last), jnp.abs(phi - target), jnp.inf))
    t_i, phi_i, rate_i = jnp.unstack(sample(i))
    start = t_i + (target - phi_i) / _away_from_zero(rate_i)
    # Second step, with the mean rate between the sample and the first estimate, for a rate that is linear in time. This is
    # accurate enough because the sample is next to the root.
    j = jnp.where(start > t_i, jnp.minimum(i + 1, last), jnp.maximum(i - 1, first))
    t_j, _, rate_j = jnp.unstack(sample(j))
    h = jnp.where(i == j, 1.0, t_j - t_i)
    acceleration = (rate_j - rate_i) / h
    start = t_i + (target - phi_i) / _away_from_zero(rate_i + 0.5 * acceleration * (start - t_i))
    return jnp.where(turns > 0, 2.0 * jnp.pi * turns * jnp.sign(total) / (end - start), total / (end - begin))


def _step(times: Array) -> Array:
    """Return the step of evenly spaced samples, averaged over all samples, because late in a long run each time is rounded."""
    return (times[-1] - times[0]) / (times.shape[0] - 1)


def _away_from_zero(x: Array) -> Array:
    tiny = jnp.sqrt(jnp.finfo(x.dtype).tiny)
    return jnp.where(jnp.abs(x) < tiny, tiny, x)


@cached
def relative_amplitude(segment: Trajectory, i: int, j: int) -> Array:
    """Return the amplitude, m zero to peak, of platform `i` relative to platform `j` (from 1) over evenly spaced samples."""
    x, v = (values[:, i - 1] - values[:, j - 1] for values in (segment.state.displacement, segment.state.velocity))
    (low, high), _, _ = locate_extrema(x, v * _step(segment.time))
    return (high - low)[2] / 2.0
