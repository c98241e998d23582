"""Run-ups of a scene: final motions of its loads as functions of drag and initial angles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto, SpeedUnit, speed_text
from jaxvib.equations.state import State
from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import LoadInteraction
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.motion.analysis.regime import REGIMES, Regime
from jaxvib.motion.integrate import frequency_bounds
from jaxvib.motion.plan import StepChoice, Tolerance, enough_steps
from jaxvib.motion.simulate import simulate
from jaxvib.motion.start import initial_state, require_start
from jaxvib.results.estimate import wilson
from jaxvib.results.fields import in_unit, part
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.units import Number, count, number, numbers, random_numbers

_FAILED = "failed"
"""Name of the outcome of a run that did not reach its end and has no regime."""

_TOLERANCE = Tolerance(1e-7)
"""Default tolerance of a step in double precision. It is small enough to determine the regime."""

_MIN_ALLOWED_STEPS = 2**20
"""Smallest default of `max_steps`. It is so large that run-ups of any usual length share one program."""


class RunUpMap(Result):
    """Outcomes of run-ups over nd drags and ns starts.

    **Attributes**

    - `drag` (nd,): b_W, N s/m
    - `angle` (ns, count): initial angles of the loads, rad
    - `regime`: a `Regime` whose arrays have the leading axes (nd, ns)
    - `kind` (nd, ns): short name of the regime, or "failed" if the run did not reach its end
    - `omega` (nd, ns): mean load speed, rad/s, NaN for a failed run
    - `finished` (nd, ns): True if the run reached its end
    """

    status = Computed.done

    drag: np.ndarray = eqx.field(metadata=in_unit("N s/m", "drag"))
    angle: np.ndarray = eqx.field(metadata=in_unit("rad", "start", "load"))
    regime: Regime = eqx.field(metadata=part("drag", "start", prefix="regime_"))
    kind: np.ndarray = eqx.field(metadata=in_unit("", "drag", "start"))
    omega: np.ndarray = eqx.field(metadata=in_unit("rad/s", "drag", "start"))
    finished: np.ndarray = eqx.field(metadata=in_unit("", "drag", "start"))

    def fraction(self, kind: str) -> np.ndarray:
        """Return the share of the starts (nd,), between 0 and 1, whose runs end in a `kind` of motion; "failed" for failed
        runs.

        **Raises** `InputError` for an unknown kind.
        """
        require_one_of(kind, (*REGIMES, _FAILED), "kind")
        return np.mean(self.kind == kind, axis=1)

    def summary(self) -> str:
        """Return a line of text for each drag: shares of the regimes at the end with intervals of 95 %, speeds of jams, and
        failed runs. A single start has no shares."""
        n = len(self.angle)
        note_on_one_start = (
            "one start at each drag; a small change of the start may change the outcome: give more starts for shares"
        )
        lines = [note_on_one_start if n == 1 else f"of {n} starts at each drag (in brackets: 95 % intervals)"]
        for k, drag in enumerate(self.drag):
            portions = []
            for kind in (kind for kind in (*REGIMES, _FAILED) if np.any(self.kind[k] == kind)):
                speeds = self.omega[k][self.kind[k] == kind]
                speed_text_of_kind = f" at {_span(speeds)}" if kind == "jammed" else ""
                if n == 1:
                    portions.append(f"{kind}{speed_text_of_kind}")
                    continue
                low, high = (100.0 * float(end) for end in wilson(np.asarray(speeds.size), np.asarray(n)))
                portions.append(f"{100.0 * speeds.size / n:.3g} % ({low:.3g} to {high:.3g} %) {kind}{speed_text_of_kind}")
            lines.append(f"drag {drag:.4g} N s/m: {', '.join(portions)}")
        return "\n".join(lines)

    def plot(self, *, unit: SpeedUnit | None = None, ax: Onto = None) -> Drawn:
        """Plot the shares of the kinds of motion, and the load speeds in `unit`, over drag, onto two axes `ax` if given."""
        shares = {kind: self.fraction(kind) for kind in (*REGIMES, _FAILED) if np.any(self.kind == kind)}
        rotor = np.max(np.asarray(self.regime.rotor_speed), initial=0.0, where=self.finished)
        from jaxvib.draw.charts import regime_chart  # slow import

        return regime_chart(self.drag, shares, self.omega, float(rotor), unit=unit, ax=ax)


def _span(values: np.ndarray) -> str:
    """Return one speed as text if all speeds agree within a thousandth, otherwise the smallest and the largest."""
    low, high = float(np.min(values)), float(np.max(values))
    return speed_text(low if high - low < 1e-3 * high else [low, high], 4, " .. ")


@validated
def run_up_map(
    scene: Scene,
    until: Number,
    *,
    drag: Sequence[float] | Number | None = None,
    starts: int | None = None,
    seed: int = 0,
    angles: Sequence[Sequence[float]] | None = None,
    separation: Number | None = None,
    stepsize_controller: StepChoice | None = None,
    batch: int = 16,
    max_steps: int | None = None,
) -> RunUpMap:
    """Compute run-ups of a scene for each drag and each set of initial angles of its loads, and the regimes at their ends.

    **Arguments**

    - `scene` with loads on a circle; a run-up needs a drive that starts from rest
    - `until`: end time, s or text; the regime is that of the last turns of the run (see `simulate`); typical: 5 to 20 s
    - `drag`: values of the drag b_W of all loads, N s/m; default: the value of the scene; typical: 5 to 20 values from 0.05 to
      5 N s/m
    - `starts`: number of sets of random angles, uniform over the circle; typical: 32 to 1000. A share
      differs from its value for infinitely many starts by less than about 1 / sqrt(starts), with a probability of 95 %
    - `seed` of the random angles
    - `angles` (sets, count), rad: sets of angles in place of random ones. Without `starts` and `angles` there is one set, at
      the bottom of the track with the `separation` of `simulate`
    - `separation`: angle between neighbouring loads in this single set, rad; typical: 0.02
    - `stepsize_controller`: as for `simulate`, except `Accuracy`; default: `Tolerance(1e-7)`, in single precision 1e-5
    - `batch`: number of runs that advance together on each core; typical: 16 (the default)
    - `max_steps`: a run fails after this number of steps; default: as for `simulate`, but at least 2^20

    **Returns** `RunUpMap`; its `fraction` gives the share of the starts that end in a kind of motion. A run that fails raises
    no error; it is counted as "failed".

    **Raises** `InputError` for values that are not allowed.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.planar_rotor(mass=20.0, stiffness=4e4, damping=60.0),
    ...                  jv.balls(count=2, mass=0.4, radius=0.08, drag=0.5), jv.SpinUp(60.0, duration=1.0))
    >>> found = jv.run_up_map(scene, 4.0, drag=[0.05, 5.0], starts=6, stepsize_controller=jv.Tolerance(1e-5))
    >>> found.kind.shape, found.fraction("jammed").tolist()
    ((2, 6), [0.0, 1.0])
    >>> print(found.summary())
    of 6 starts at each drag (in brackets: 95 % intervals)
    drag 0.05 N s/m: 100 % (61 to 100 %) unsettled
    drag 5 N s/m: 100 % (61 to 100 %) jammed at 39... rpm

    Source: Artyunin 2013, section V, with a single set of angles.
    """
    scene = validate_scene(scene)
    if not scene.loads.circular:
        raise InputError(
            "loads.kind",
            f"is {quoted(scene.loads.kind)}; run_up_map varies the drag of loads on a circle; for balls in a torus use capture",
        )
    loads = cast(CircularLoads, scene.loads)
    drag_values = loads.drag if drag is None else numbers(drag, "N s/m", "drag", None, low=0.0)
    if drag is None and drag_values.ndim:
        raise InputError("loads.drag", "differs from load to load; give the values of `drag` for the run-ups")
    drags = jnp.atleast_1d(drag_values)
    sets = _sets_of_angles(scene, starts, seed, angles, separation)
    count(batch, "batch")
    require_start(scene, State(jnp.zeros(0), jnp.zeros(0), (jnp.asarray(sets),)))

    shape = (len(drags), len(sets))
    size = min(batch, shape[0] * shape[1])
    end = number(until, "s", "until", low=0.0, open_low=True)
    if stepsize_controller is None and end.dtype.itemsize >= 8:
        stepsize_controller = _TOLERANCE
    if max_steps is None:
        max_steps = max(_MIN_ALLOWED_STEPS, enough_steps(frequency_bounds(scene)[0], end))

    def run_batch(drags: Array, angles: Array) -> tuple[Regime, Array, Array]:
        return _run_batch(scene, end, drags, angles, stepsize_controller, max_steps)

    cases = np.repeat(drags, len(sets)), np.tile(np.asarray(sets, drags.dtype), (len(drags), 1))
    regime, omega, finished = in_chunks(size, run_batch, *cases)
    (code,) = jax.tree.leaves(regime.name)
    kind = np.where(finished, np.asarray(REGIMES)[code], _FAILED)

    def reshape_cases(leaf: np.ndarray) -> np.ndarray:
        return leaf.reshape(shape + leaf.shape[1:])

    return RunUpMap(
        drag=np.asarray(drags),
        angle=sets,
        regime=jax.tree.map(lambda leaf: jnp.asarray(reshape_cases(leaf)), regime),
        kind=kind.reshape(shape),
        omega=reshape_cases(omega),
        finished=reshape_cases(finished),
    )


def _sets_of_angles(
    scene: Scene, starts: int | None, seed: int, angles: Sequence[Sequence[float]] | None, separation: Number | None
) -> np.ndarray:
    """Return sets (sets, count) of initial angles: the argument `angles`, `starts` random sets, or the set of
    `initial_state`."""
    n = scene.loads.count
    if starts is not None and angles is not None:
        raise InputError("starts", "cannot be combined with angles; give a number of random starts or the angles")
    if separation is not None and not (starts is None and angles is None):
        raise InputError("separation", f"is {quoted(separation)}; it is only for a single start; leave out starts and angles")
    if angles is not None:
        sets = np.asarray(angles, dtype=float)
        if sets.ndim != 2 or sets.shape[1] != n or not np.all(np.isfinite(sets)):
            raise InputError("angles", f"has shape {sets.shape}; (starts, {n}) finite numbers are needed")
        return sets
    if starts is None:
        return np.asarray(initial_state(scene, separation=separation).azimuth)[None]
    sets = random_numbers(seed).uniform(-np.pi, np.pi, (count(starts, "starts"), n))
    # Loads on one track keep the order of their numbers.
    return np.sort(sets, axis=1) if has_term(scene.all_effects, LoadInteraction) else sets


@cached
def _run_batch(
    scene: Scene, until: Array, drags: Array, angles: Array, chosen: StepChoice | None, max_steps: int
) -> tuple[Regime, Array, Array]:
    """Return the regime of each run-up of a batch, the mean speed of its loads (NaN for a failed run), and True if the run
    reached its end."""

    def run_up(drag: Array, angle: Array) -> tuple[Regime, Array, Array]:
        changed_scene = eqx.tree_at(lambda s: s.loads.drag, scene, drag)
        start = eqx.tree_at(lambda s: s.angle, initial_state(changed_scene), (angle,))
        run = simulate(
            changed_scene, until, start=start, save="window", stepsize_controller=chosen, max_steps=max_steps, throw=False
        )
        has_ended = run.finished
        return run.regime, jnp.where(has_ended, run.omega, jnp.nan), has_ended

    return jax.vmap(run_up)(drags, angles)
