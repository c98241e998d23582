"""Growth of small disturbances of a motion: regular, unstable, chaotic, or undecided."""

from __future__ import annotations

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn
from jaxvib.equations.state import State
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.motion.analysis.scaled_error import error_scale, natural_units, with_nearest_turns
from jaxvib.motion.integrate import angle_wrapping, whole_turns
from jaxvib.motion.plan import Tolerance, plan_segment, with_settled_drives
from jaxvib.motion.run import Run
from jaxvib.motion.simulate import last_state, run_planned, simulate
from jaxvib.motion.start import Start, start_state
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import failure, member, status_name
from jaxvib.units import Number, count, number
from jaxvib.units.known import require_known

_EXPONENTIAL_LOG_GROWTH, _LINEAR_LOG_GROWTH = math.log(1e3), math.log(2.1)
"""Logarithms of growth over the later half of a run: above the first the growth is exponential; below the second it can be
proportional to time (a factor of 2, with a margin)."""

_MAX_LOG_GROWTH_OF_ERRORS = math.log(1.01)
"""Largest logarithm of the growth over the later half of a run that integration errors alone can cause."""

_MAX_GROWTH_RATIO_OF_QUARTERS = 0.85
"""Largest ratio of the growth rate in the last quarter of a run to that in the quarter before, for growth that is not
exponential. The ratio is 0.71 for growth proportional to time, and 1 for exponential growth."""

_UNSEPARATED_LOG_GROWTH = 0.1
"""Largest error of the logarithm of the growth over the later half if two equal disturbances with nearly equal rates grow. It
is ln((1 + e^-x)/(1 + e^-2x))/2, at most 0.094, where x is the difference of the rates times the whole time."""

_RETURN_DISTANCE = 1e-2
"""Distance from a previous state below which a motion has returned to it, relative to the largest distance in between."""

_TURNS_TO_RETURN, _SAMPLES_OF_RETURN = 3.0, 4096
"""Number of turns of the slowest of all rotors and loads within which a periodic motion must return to its state, and number of
samples in this time."""


class GrowthStatus(eqx.Enumeration):
    """Growth of small disturbances. The value of each member is the message shown to the user."""

    regular = "small disturbances do not grow exponentially: derivatives of the motion are meaningful"
    unstable = "the motion is periodic and unstable: small disturbances grow exponentially and the machine leaves it"
    chaotic = "small disturbances grow exponentially: derivatives of a run longer than the horizon are meaningless"
    undecided = "the run is too short or too uneven to decide whether small disturbances grow exponentially: run longer"


class Growth(Result):
    """Growth of small disturbances of a motion.

    Returned by `growth`.

    **Attributes**

    - `status`: a `GrowthStatus`
    - `exponent`: the largest Lyapunov exponent, 1/s, over the later half of the segments
    - `uncertainty` of the exponent, 1/s: the largest of the standard error, half of the change of the rate between the two
      quarters of this half, and 0.1 divided by the length of this half. (The last value is needed because exponents whose
      difference is smaller cannot be separated.)
    - `horizon`: the time, s, after which rounding errors have grown to the size of the motion itself, ln(1/eps)/exponent, with
      the relative rounding error eps. A derivative with respect to a parameter has then grown by the factor 1/eps, and predicts
      nothing about a change that is larger than rounding. The horizon is infinite for a regular motion; for an undecided one it
      is a lower bound, ln(1/eps)/(exponent + 3 uncertainty)
    - `rates` (segments,): growth rate in each segment, 1/s; `time` (segments,): end of each segment, s
    """

    status: GrowthStatus
    exponent: float = eqx.field(metadata=in_unit("1/s"))
    uncertainty: float = eqx.field(metadata=in_unit("1/s"))
    horizon: float = eqx.field(metadata=in_unit("s"))
    rates: np.ndarray = eqx.field(metadata=in_unit("1/s", "time"))
    time: np.ndarray = eqx.field(metadata=in_unit("s", "time"))

    def summary(self) -> str:
        """Return the exponent and the horizon as text."""
        at_least = "at least " if self.status_name == "undecided" else ""
        horizon = "" if math.isinf(self.horizon) else f", horizon {at_least}{self.horizon:.3g} s"
        return f"{self.message}: largest Lyapunov exponent {self.exponent:.3g} +- {self.uncertainty:.1g} 1/s{horizon}"

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the rate of each segment and the exponent over time."""
        from jaxvib.draw.results import growth_chart  # slow to import

        return growth_chart(self.time, self.rates, self.exponent, self.uncertainty, ax=ax)


@validated
def growth(
    scene: Scene,
    until: Number,
    *,
    start: Start | State = "rest",
    mode: int | None = None,
    separation: Number | None = None,
    segments: int = 40,
) -> Growth:
    """Estimate the largest Lyapunov exponent of a motion: the rate at which two motions with nearly equal starts separate.

        exponent = mean of ln(d_k / d_0) / T over the later segments of length T

    A second motion starts at the distance d_0. At the end of segment k its distance is d_k; it is then reset to d_0 in the
    current direction (Benettin's method).

    Derivatives of a run grow at the same rate. If the rate is positive, a derivative of a run that is longer than the horizon
    is meaningless, however exactly it is computed. Use derivatives of shorter runs, of averages over many starts, or of exact
    motions (`jam_orbit`) instead.

    The result depends on the later half of the run. With G the logarithm of the growth in this half and s its standard error:

    - "chaotic" or "unstable": G > 3 s and G > ln 1000, with rates that agree in the two quarters of this half. The motion is
      unstable if it returns to its former state within three turns of its rotor and loads. An unstable jam is an example; its
      exponent is ln|multiplier| divided by the period of `jam_orbit`. An unstable motion that repeats itself only after more
      turns is called chaotic
    - "regular": G + 3 s < ln 1000, and one of two conditions: G is at most the larger of 2 s and ln 1.01 (the growth that
      errors of integration can cause); or G < ln 2.1 with rates that decrease as for growth proportional to time
    - "undecided": all other cases, for example if the rate is certain but the run is too short to reach ln 1000

    Rounding makes every run leave an unstable motion after some time. The result then belongs to the motion that it reaches.

    **Arguments**

    - `scene` with drives of constant speed or motors; a single exciter with loads needs a constant speed
    - `until`, s or text: approximate length of all segments together; each segment is a whole number of turns of the rotor;
      typical: 20 to 200
    - `start`, `mode`, `separation`: as for `simulate`, except "spin_up"
    - `segments`: number of segments, at least 8; typical: 40 (the default). One segment must be so short that two motions
      with the initial distance d_0 are still close to each other at its end

    **Returns** `Growth`. **Raises** `InputError` for a drive whose prescribed speed changes, and for the motor of a
    single exciter with loads; `ComputationError` for a run that fails.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> jv.growth(scene, 40.0, start="jam", mode=1).status_name
    'regular'

    Source: Benettin, Galgani, Giorgilli, Strelcyn 1980.
    """
    require_known(scene, "scene", "growth", "use jam_orbit or simulate in it")
    scene = validate_scene(scene)
    scene = with_settled_drives(scene, start, "the growth of disturbances needs a constant rotor speed; use ConstantSpeed")
    if count(segments, "segments") < 8:
        raise InputError("segments", f"is {segments}; at least 8 are needed to estimate the scatter of the rate")
    end = float(number(until, "s", "until", low=0.0, open_low=True))
    state = start_state(scene, start, mode, separation)
    segment, unit = whole_turns(scene, end / segments), natural_units(scene)
    double = state.displacement.dtype.itemsize >= 8
    initial_distance, steps = (1e-6, Tolerance(1e-10)) if double else (1e-2, Tolerance(1e-5))

    plan = plan_segment(scene, segment, state, steps, throw=False)

    def run_on(begin: State) -> Run:
        run = run_planned(dataclasses.replace(plan, state=begin), throw=False)
        if status_name(run.status) != "done":
            raise failure(run.status)
        return run

    rng, rates, neighbour, quarters = np.random.default_rng(0), [], None, []
    for k in range(segments):
        if neighbour is None:  # a random direction, because disturbances along the motion do not grow
            scale = error_scale(jax.tree.map(lambda x: x[None], state), unit)
            noise = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), state)
            neighbour = _at_distance(state, jax.tree.map(jnp.add, state, noise), scale, initial_distance)
        if k in (segments // 2, 3 * segments // 4):
            quarters.append(state)
        first, second = run_on(state), run_on(neighbour)
        scale = error_scale(first.window.state, unit)
        reference_end, neighbour_end = (jax.tree.map(lambda x: x[-1], run.window.state) for run in (first, second))
        if angle_wrapping(scene, reference_end.displacement.dtype)[0]:
            neighbour_end = with_nearest_turns(neighbour_end, reference_end)
        rates.append(math.log(max(_distance(reference_end, neighbour_end, scale), 1e-300) / initial_distance) / segment)
        state, difference = last_state(scene, first), jax.tree.map(lambda x, y: y - x, reference_end, neighbour_end)
        neighbour = _at_distance(state, jax.tree.map(jnp.add, state, difference), scale, initial_distance)
    late = np.array(rates[segments // 2 :])
    exponent, uncertainty = float(np.mean(late)), _uncertainty(late, segment)
    name = _classify_growth(late * segment)
    if name == "chaotic" and all(_has_returned(scene, quarter, steps) for quarter in quarters):
        name = "unstable"
    fastest = {"regular": 0.0, "undecided": exponent + 3.0 * uncertainty}.get(name, exponent)
    horizon = math.log(1.0 / float(jnp.finfo(scene.top_speed.dtype).eps)) / fastest if fastest > 0.0 else math.inf
    times = segment * np.arange(1, segments + 1)
    return Growth(member(GrowthStatus, name), exponent, uncertainty, horizon, np.array(rates), times)


def _classify_growth(late: np.ndarray) -> str:
    """Return the name of the `GrowthStatus` from the logarithms `late` (n,) of the growth in the segments of the later half;
    "chaotic" includes "unstable" here."""
    total, error = float(np.sum(late)), _sum_error(late)
    first, last = np.split(late, [late.size // 2])
    increase = float(np.mean(last) - np.mean(first))
    if total > max(3.0 * error, _EXPONENTIAL_LOG_GROWTH):
        spread = math.hypot(*(_sum_error(quarter) / quarter.size for quarter in (first, last)))
        return "chaotic" if abs(increase) < max(3.0 * spread, 0.25 * float(np.mean(late))) else "undecided"
    decreases = total < _LINEAR_LOG_GROWTH and float(np.mean(last)) < _MAX_GROWTH_RATIO_OF_QUARTERS * float(np.mean(first))
    is_resolved = total > max(2.0 * error, _MAX_LOG_GROWTH_OF_ERRORS)
    return "regular" if total + 3.0 * error < _EXPONENTIAL_LOG_GROWTH and (decreases or not is_resolved) else "undecided"


def _uncertainty(late: np.ndarray, segment: float) -> float:
    """Return the uncertainty of the mean of the rates `late` (n,), 1/s, in `segment`s, s, of the later half."""
    first, last = np.split(late, [late.size // 2])
    change = abs(float(np.mean(last) - np.mean(first)))
    return max(_sum_error(late) / late.size, 0.5 * change, _UNSEPARATED_LOG_GROWTH / (late.size * segment))


def _sum_error(values: np.ndarray) -> float:
    """Return the standard error s of the sum of values (n,), of which only neighbours are correlated.

        s^2 = n c_0 + 2 (n - 1) c_1

    with the autocovariances c_k; the result is at least the error of one value. If the phase of the motion differs between the
    ends of segments, the logarithms of the growth in neighbouring segments are large and have opposite signs.
    """
    deviation = values - np.mean(values)
    variance = float(np.sum(deviation**2)) / (values.size - 1)
    return math.sqrt(max(values.size * variance + 2.0 * float(np.sum(deviation[1:] * deviation[:-1])), variance))


def _has_returned(scene: Scene, state: State, steps: Tolerance) -> bool:
    """Return True if the motion from `state` returns to this state within a few turns of rotor and loads."""
    speed = float(scene.top_speed)
    rates = [own.rate[0] for own in state.exciters if own.rate]
    rates += [own.rotor[1] for own in state.exciters if own.rotor is not None and not own.rate]
    turning = np.abs(np.concatenate([np.ravel(rate) for rate in rates] or [np.zeros(0)]))
    slowest = min([speed, *(float(w) for w in turning if w > 1e-2 * speed)])
    run = simulate(
        scene, _TURNS_TO_RETURN * 2.0 * math.pi / slowest, start=state, samples=_SAMPLES_OF_RETURN, stepsize_controller=steps,
        estimate=False, throw=False,
    )  # fmt: skip
    if run.trajectory is None or not bool(run.finished):
        return False
    path = jax.tree.map(np.asarray, run.trajectory.state)
    begin = jax.tree.map(lambda x: x[:1], path)
    scale = error_scale(path, natural_units(scene))
    parts = jax.tree.map(
        lambda x, y, s: np.sum(((x - y) / s) ** 2, axis=tuple(range(1, x.ndim))), with_nearest_turns(path, begin), begin, scale
    )
    distance = np.sqrt(sum(jax.tree.leaves(parts)))
    farthest = float(np.max(distance))
    first_far = int(np.argmax(distance > 0.3 * farthest))
    return float(np.min(distance[first_far:])) < _RETURN_DISTANCE * farthest


def _distance(a: State, b: State, scale: State) -> float:
    """Return the Euclidean distance of two states, with each entry in units of the scale of its part."""
    parts = jax.tree.leaves(jax.tree.map(lambda x, y, s: np.sum(((np.asarray(y) - np.asarray(x)) / s) ** 2), a, b, scale))
    return math.sqrt(float(sum(parts)))


def _at_distance(a: State, b: State, scale: State, distance: float) -> State:
    """Return the state at the `distance` from `a` in the direction of `b`; if `a` and `b` are equal, the displacements of `a`
    are changed."""
    present = _distance(a, b, scale)
    if present == 0.0:
        return eqx.tree_at(lambda s: s.displacement, a, a.displacement + distance * scale.displacement)
    return jax.tree.map(lambda x, y: x + (y - x) * (distance / present), a, b)
