"""How fast small disturbances of a motion grow: whether its derivatives mean anything."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.equations.dynamics import State
from jaxvib.errors import InputError
from jaxvib.machine.checked import checked
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.scaled_error import error_scale, natural_units, turned
from jaxvib.motion.integrate import wrap_angles
from jaxvib.motion.run import Run, RunStatus
from jaxvib.motion.simulate import last_state, simulate, whole_turns
from jaxvib.motion.start import Start, initial_state, whole_state
from jaxvib.motion.steps import Tolerance
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import failure, member
from jaxvib.units import Number, count, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxvib.draw.style import Drawn

__all__ = ["Growth", "GrowthStatus", "growth"]

_THOUSANDFOLD = math.log(1e3)
"""What a disturbance has to grow by, beyond doubt, for a motion to be called chaotic."""


class GrowthStatus(eqx.Enumeration):
    """What becomes of small disturbances; the members are the sentences a user reads."""

    regular = "small disturbances do not grow exponentially: derivatives of the motion mean what they say"
    chaotic = "small disturbances grow exponentially: derivatives of a run longer than the horizon mean nothing"


class Growth(Result):
    """How small disturbances of a motion grow.

    **Attributes**: `status` a `GrowthStatus`; `exponent` the largest Lyapunov exponent, 1/s, and its standard error
    `uncertainty`, over the later half of the stretches; `horizon` s, after which rounding is as large as the motion itself,
    ln(1/eps)/exponent, infinite for a regular motion: a derivative by a number of the scene has grown by 1/eps then, and says
    nothing about a change that is larger than rounding; `rates` (stretches,) 1/s of each stretch, which end at `time` s.
    """

    status: GrowthStatus
    exponent: float = eqx.field(metadata=in_unit("1/s"))
    uncertainty: float = eqx.field(metadata=in_unit("1/s"))
    horizon: float = eqx.field(metadata=in_unit("s"))
    rates: np.ndarray = eqx.field(metadata=in_unit("1/s", "time"))
    time: np.ndarray = eqx.field(metadata=in_unit("s", "time"))

    def summary(self) -> str:
        """The exponent and the horizon, for a person to read."""
        lasts = "" if math.isinf(self.horizon) else f", horizon {self.horizon:.3g} s"
        return f"{self.message}: largest Lyapunov exponent {self.exponent:.3g} +- {self.uncertainty:.1g} 1/s{lasts}"

    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """The rate of each stretch and the exponent over time. **Returns** a matplotlib figure, or the given `ax`."""
        from jaxvib.draw.results import growth_chart  # slow to import: only who draws pays

        return growth_chart(self.time, self.rates, self.exponent, self.uncertainty, ax=ax)


def growth(
    scene: Scene, until: Number, *, start: Start | State = "rest", mode: int | None = None, stretches: int = 40
) -> Growth:
    """Estimates the largest Lyapunov exponent of a motion: how fast two motions part that begin next to each other.

        exponent = mean of ln(d_k / d_0) / T over the later stretches of length T

    A second motion starts at the distance d_0 and is put back to it after each stretch, in the direction that it has come to
    (Benettin's method). Derivatives of a run grow at the same rate: where it is positive, no derivative of a run that is longer
    than the horizon says anything, however exactly it is computed; ask for those of shorter runs, of averages over many
    starts, or of exact motions (`jam_orbit`).

    **Arguments**: `until` s or text, about how long all stretches are together; each is a whole number of turns of the rotor;
    `start`, `mode` as `simulate`; `stretches`, 8 at least: so many that motions a rounding apart are not far apart after one.

    **Returns** `Growth`. **Raises** `InputError` for a drive whose speed changes; `ComputationError` for a run that fails.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> jv.growth(scene, 40.0, start="jam", mode=1).status_name
    'regular'

    Source: Benettin, Galgani, Giorgilli, Strelcyn 1980.
    """
    scene = checked(scene)
    if not scene.drive.constant:
        raise InputError(
            "drive", f"is {scene.drive.kind!r}; how disturbances grow is asked under a constant speed: use ConstantSpeed"
        )
    if count(stretches, "stretches") < 8:
        raise InputError("stretches", f"is {stretches}; at least 8 are needed to tell a rate from its scatter")
    end = float(number(until, "s", "until", low=0.0, open_low=True))
    state = whole_state(scene, start, mode) if isinstance(start, State) else initial_state(scene, start, mode=mode)
    stretch, unit = whole_turns(scene, end / stretches), natural_units(scene)
    double = state.displacement.dtype.itemsize >= 8
    apart, steps = (1e-6, Tolerance(1e-10)) if double else (1e-2, Tolerance(1e-5))

    def run_on(begin: State) -> Run:
        run = simulate(scene, stretch, start=begin, save="window", stepsize_controller=steps, estimate=False, throw=False)
        if not bool(run.status == RunStatus.done):
            raise failure(run.status)
        return run

    rng, rates, other = np.random.default_rng(0), [], None
    for _ in range(stretches):
        if other is None:  # not along the motion, where nothing grows
            scale = error_scale(jax.tree.map(lambda x: x[None], state), unit)
            noise = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), state)
            other = _at_distance(state, jax.tree.map(jnp.add, state, noise), scale, apart)
        first, second = run_on(state), run_on(other)
        scale = error_scale(first.window.state, unit)
        ours, theirs = (jax.tree.map(lambda x: x[-1], run.window.state) for run in (first, second))
        if wrap_angles(scene, ours.displacement.dtype)[0]:
            theirs = turned(theirs, ours)
        rates.append(math.log(max(_distance(ours, theirs, scale), 1e-300) / apart) / stretch)
        state, gone = last_state(scene, first), jax.tree.map(lambda x, y: y - x, ours, theirs)
        other = _at_distance(state, jax.tree.map(jnp.add, state, gone), scale, apart)
    late = np.array(rates[stretches // 2 :])
    exponent, uncertainty = float(np.mean(late)), float(np.std(late, ddof=1) / math.sqrt(late.size))
    chaotic = exponent > 3.0 * uncertainty and exponent * stretch * late.size > _THOUSANDFOLD
    horizon = math.log(1.0 / float(jnp.finfo(scene.drive.speed.dtype).eps)) / exponent if chaotic else math.inf
    times = stretch * np.arange(1, stretches + 1)
    status = member(GrowthStatus, "chaotic" if chaotic else "regular")
    return Growth(status, exponent, uncertainty, horizon, np.array(rates), times)


def _distance(a: State, b: State, scale: State) -> float:
    """The Euclidean distance of two states, each number relative to its part's scale."""
    parts = jax.tree.leaves(jax.tree.map(lambda x, y, s: np.sum(((np.asarray(y) - np.asarray(x)) / s) ** 2), a, b, scale))
    return math.sqrt(float(sum(parts)))


def _at_distance(a: State, b: State, scale: State, apart: float) -> State:
    """The state at the distance `apart` from `a` towards `b`; of two that are one, that with the first number moved."""
    distance = _distance(a, b, scale)
    if distance == 0.0:
        return eqx.tree_at(lambda s: s.displacement, a, a.displacement + apart * scale.displacement)
    return jax.tree.map(lambda x, y: x + (y - x) * (apart / distance), a, b)
