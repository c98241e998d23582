"""Work-precision: error and computing time of one quantity of a scene by all methods."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Sequence
from typing import Literal, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import call_user, validated
from jaxvib.equations.state import State
from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import require_double
from jaxvib.motion.analysis.scaled_error import error_scale, natural_units, scaled_error, with_nearest_turns
from jaxvib.motion.envelope.envelope import envelope
from jaxvib.motion.integrate import frequency_bounds
from jaxvib.motion.plan import Tolerance, enough_steps
from jaxvib.motion.run import Run
from jaxvib.motion.simulate import simulate
from jaxvib.motion.start import initial_state
from jaxvib.results.result import Result
from jaxvib.steady.jams.jam import JamStatus, jam_modes
from jaxvib.steady.orbits.jam_orbit import collocation_points, jam_orbit
from jaxvib.study.accuracy.cost import Cost, CostRow, relative, row_of
from jaxvib.study.accuracy.exact_reference import (
    WINDOW_PERIODS,
    ExactJam,
    exact_jam,
    slow_period,
    unstable_reason,
)
from jaxvib.study.accuracy.gradient_precision import gradient_precision
from jaxvib.units import Number, count, number

T = TypeVar("T")
Tree = TypeVar("Tree")
Quantity = Literal["amplitude", "foundation_force", "final_state", "gradient"]
QUANTITIES = ("amplitude", "foundation_force", "final_state", "gradient")

SOLVERS: dict[str, Callable[[], diffrax.AbstractSolver | None]] = {
    "default": lambda: None,
    "Tsit5": diffrax.Tsit5,
    "Dopri8": diffrax.Dopri8,
}
"""Methods of time integration by name; "default" is the default of `simulate`."""

_TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11)
_REFERENCE_ROWS, _ALGEBRAIC_ROWS = 8.0, 4.0
"""Computing times of the reference, and of one row of an algebraic method with its compilation, divided by the time of one row
of an integration. `progress` reports the finished share with these weights, which were measured for the two-mass machine."""

_ORBIT_POINTS = (8, 16)
_ENVELOPE_TOLERANCES = (1e-3, 1e-6)

_MIN_SINGLE_TOLERANCE = 2e-6
"""Smallest tolerance in single precision."""


@validated
def work_precision(
    scene: Scene,
    quantity: Quantity = "amplitude",
    *,
    mode: int | None = None,
    until: Number | None = None,
    tolerances: Sequence[float] = _TOLERANCES,
    solvers: Sequence[str] = tuple(SOLVERS),
    repeats: int = 3,
    progress: Callable[[str, float], None] | None = None,
) -> Cost:
    """Compute a quantity of a scene by every tier, method, tolerance and dtype, and measure its error and computing time.

    - "amplitude" and "foundation_force" of a jam mode, if exact jams of the scene can be computed. The tiers are leading order,
      exact orbit, averaged equations and full equations; the last two are integrated from the leading-order motion. The
      reference is the exact orbit with 32 points on half a period (65 on a period without half-turn symmetry); its error is the
      difference from the orbit with 24 (49) points. For other scenes (run-ups, imbalance, loads at different stations), the
      quantity is measured at the end of a run from rest. The reference is then the full equations with a tolerance of 1e-13;
      its error is the difference from a run with a tolerance of 1e-11
    - "final_state": the state of the full equations at `until`, from rest, by every solver. The reference is a run with a
      tolerance of 1e-13; its error is estimated by this run
    - "gradient" of the largest amplitude of the jam with respect to the stiffnesses of the machine: implicit derivatives of
      leading order and exact orbit; forward mode, reverse mode and finite differences through time integration

    The leading order and the default method of time integration are computed in single precision too. A tier that cannot
    compute the quantity is left out, and the result states the reason.

    **Arguments**

    - `scene` in double precision
    - `quantity`: one of `QUANTITIES`, the names above
    - `mode`: a jam mode; default: the second-highest mode that is stable by slope, or the only one (in the highest mode the
      loads turn almost with the rotor)
    - `until`: end of the runs, s or text; default: 20 times the longest natural period of the carrier. For a jam, the default
      is longer, because deviations of the start must decay to the tolerance of the run. The largest Floquet multiplier gives
      the additional time; the total is at most 2000 times the longest natural period
    - `tolerances` of time integration, at least one; typical: 1e-3 to 1e-11 (the default)
    - `solvers`: names of methods from `SOLVERS`
    - `repeats`: largest number of timings of each method, of which the shortest is reported; no timing begins after 1 s in
      total; typical: 3 (the default)
    - `progress`: a function that is called with the name of each method and the finished share of all methods (0 to 1); it is
      not called for the "gradient"

    **Returns** `Cost`. **Raises** `InputError` for an unknown quantity or solver, an empty list of tolerances, a scene in
    single precision, and a gradient of a scene without an exact jam; and the errors of `jam_modes` and `simulate`.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> cost = jv.work_precision(scene, "amplitude", mode=1, tolerances=(1e-6,), solvers=["default"], repeats=1)
    >>> [row.tier for row in cost.rows if row.error < 1e-6][0], cost.reference_error < 1e-9
    ('exact orbit', True)

    Source: this package; sources of the tiers: see `jam_modes`, `jam_orbit`, `envelope`, `simulate`.
    """
    require_one_of(quantity, QUANTITIES, "quantity")
    unknown = [name for name in solvers if name not in SOLVERS]
    if unknown or not solvers:
        raise InputError("solvers", f"are {quoted(list(solvers))}; name some of {', '.join(SOLVERS)}")
    if not tolerances:
        raise InputError("tolerances", f"are {quoted(tuple(tolerances))}; give at least one, such as 1e-6")
    for k, tolerance in enumerate(tolerances):
        number(tolerance, "", f"tolerances[{k}]", low=0.0, open_low=True)
    count(repeats, "repeats")
    scene = require_double(scene, "a comparison of errors")
    end = None if until is None else float(number(until, "s", "until", low=0.0, open_low=True))
    request = _Request(scene, tuple(tolerances), tuple(solvers), repeats, progress)
    if quantity == "final_state":
        return _cost_of_final_state(request, end)
    if quantity == "gradient":
        return gradient_precision(scene, exact_jam(scene, mode), end, repeats)
    try:
        jam = exact_jam(scene, mode)
    except InputError as problem:
        if mode is not None:
            raise
        return _cost_at_end(request, quantity, end, f"leading order, exact orbit: {problem}")
    return _cost_of_jam(request, quantity, jam, end)


@dataclasses.dataclass
class _Request:
    scene: Scene
    tolerances: tuple[float, ...]
    solvers: tuple[str, ...]
    repeats: int
    progress: Callable[[str, float], None] | None
    finished: float = 0.0

    def row(
        self, tier: str, method: str, setting: str, call: Callable[[], T], error: Callable[[T], float], dtype: str = "float64"
    ) -> CostRow:
        """Return the row of a method, and report it to `progress`."""
        if self.progress is not None:
            single_rows = len(self.tolerances) if "default" in self.solvers else 0
            algebraic = _REFERENCE_ROWS + _ALGEBRAIC_ROWS * (2 + len(_ORBIT_POINTS))
            whole = algebraic + len(_ENVELOPE_TOLERANCES) + len(self.tolerances) * len(self.solvers) + single_rows
            name = ", ".join(filter(None, (tier, method, setting)))
            call_user(self.progress, "progress", name, min((_REFERENCE_ROWS + self.finished) / whole, 1.0))
        self.finished += _ALGEBRAIC_ROWS if tier in ("leading order", "exact orbit") else 1.0
        return row_of(tier, method, setting, call, error, self.repeats, dtype)


def _single(tree: Tree) -> Tree:
    """Convert a scene or a state to single precision, for use under `jax.enable_x64(False)`."""
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float32), tree)


def _cost_of_jam(request: _Request, quantity: str, jam: ExactJam, end: float | None) -> Cost:
    scene, mode = request.scene, jam.mode
    read = operator.attrgetter(quantity)
    reference = np.ravel(np.asarray(read(jam.fine), float))
    units = scene.machine.structure().units if quantity == "amplitude" else ()

    def error(value: Array) -> float:
        return relative(value, reference, units)

    def leading(scene: Scene, dtype: str) -> CostRow:
        call = _compiled(lambda s: read(jam_modes(s).select(mode)), scene)
        return request.row("leading order", "", "", call, error, dtype)

    rows, left_out = [], []
    light = jam_modes(scene).select(mode, throw=False)
    if bool(light.status == JamStatus.found):
        start = initial_state(scene, "jam", mode=mode)
        rows.append(leading(scene, "float64"))
        with jax.enable_x64(False):
            rows.append(leading(_single(scene), "float32"))
    else:
        start = State(*jam.fine.at(jnp.zeros(())))
        left_out.append(f"leading order: {light.message}; runs start from the exact jam instead")
    for few in _ORBIT_POINTS:
        points = collocation_points(scene, few)
        call = _compiled(lambda s, points=points: read(jam_orbit(s, mode=mode, points=points)), scene)
        rows.append(request.row("exact orbit", "", f"{points} points", call, error))
    if not bool(jam.fine.stable):
        left_out.append(unstable_reason("envelope, full", jam))
    else:

        def length(tolerance: float) -> float:
            return jam.length(scene, tolerance) if end is None else end

        integrated, reasons = _integration_rows(request, read, error, start, length)
        rows, left_out = rows + integrated, left_out + reasons
    return Cost(quantity, reference.tolist(), error(read(jam.coarse)), rows, tuple(left_out))


def _cost_at_end(request: _Request, quantity: str, end: float | None, reason: str) -> Cost:
    """Return the cost of a quantity of a scene without an exact jam, measured at the end of a run from rest."""
    end = WINDOW_PERIODS * slow_period(request.scene) if end is None else end
    read = operator.attrgetter(quantity)
    start = initial_state(request.scene)
    units = request.scene.machine.structure().units if quantity == "amplitude" else ()

    @functools.cache
    def reference(tolerance: float = 1e-13) -> np.ndarray:
        """Return the reference value. It is computed when it is first used, after the timing of the first row. If it were
        computed earlier, the program of the first row would already be compiled, and its compile time could not be measured."""
        run = simulate(request.scene, end, save="window", stepsize_controller=Tolerance(tolerance), estimate=False)
        return np.ravel(np.asarray(read(run), float))

    def error(value: Array) -> float:
        return relative(value, reference(), units)

    rows, left_out = _integration_rows(request, read, error, start, lambda tolerance: end)
    return Cost(quantity, reference().tolist(), relative(reference(1e-11), reference(), units), rows, (reason, *left_out))


def _integration_rows(
    request: _Request,
    read: Callable[[Result], Array],
    error: Callable[[Array], float],
    start: State,
    length: Callable[[float], float],
) -> tuple[list[CostRow], list[str]]:
    """Return rows of the quantity at the end of averaged and full runs, and reasons for rows that are left out.

    **Arguments**: `length(tolerance)`: duration of a run, s.
    """
    full, rows, left_out = _full_rows(request, start, length, lambda run: error(read(run))), [], []
    for tolerance in _ENVELOPE_TOLERANCES:
        end = length(tolerance)

        def averaged(end: float = end, tolerance: float = tolerance) -> Array:
            chosen = Tolerance(tolerance)
            return read(envelope(request.scene, end, start=start, save="window", stepsize_controller=chosen, throw=False))

        try:
            rows.append(request.row("envelope", "Rodas4", f"{tolerance:.0e}", averaged, error))
        except InputError as problem:
            left_out.append(f"envelope: {problem}")
            break
    return rows + full, left_out


def _full_rows(
    request: _Request, start: State, length: Callable[[float], float], error: Callable[[Run], float]
) -> list[CostRow]:
    """Return rows of full runs by every solver with every tolerance, in double precision, and by the default method also in
    single precision."""
    ends = {tolerance: length(tolerance) for tolerance in request.tolerances}
    fastest, _ = frequency_bounds(request.scene)
    steps = enough_steps(fastest, jnp.asarray(max(ends.values())))  # the same for all runs, because it is part of the program

    def rows(scene: Scene, start: State, name: str, dtype: str, min_tolerance: float = 0.0) -> list[CostRow]:
        solver = SOLVERS[name]()

        def run(tolerance: float) -> Run:
            return simulate(
                scene,
                ends[tolerance],
                start=start,
                save="window",
                solver=solver,
                stepsize_controller=Tolerance(tolerance),
                max_steps=steps,
                estimate=False,
                throw=False,
            )

        return [
            request.row("full", name, f"{tolerance:.0e}", lambda t=tolerance: run(t), error, dtype)
            for tolerance in request.tolerances
            if tolerance >= min_tolerance
        ]

    all_rows = [row for name in request.solvers for row in rows(request.scene, start, name, "float64")]
    if "default" in request.solvers:
        with jax.enable_x64(False):
            all_rows += rows(_single(request.scene), _single(start), "default", "float32", _MIN_SINGLE_TOLERANCE)
    return all_rows


def _compiled(function: Callable[[Scene], Array], scene: Scene) -> Callable[[], Array]:
    jitted = eqx.filter_jit(function)
    return lambda: jitted(scene)


def _cost_of_final_state(request: _Request, end: float | None) -> Cost:
    end = WINDOW_PERIODS * slow_period(request.scene) if end is None else end
    reference_run = functools.cache(lambda: simulate(request.scene, end, save="window", stepsize_controller=Tolerance(1e-13)))

    @functools.cache
    def scale() -> State:
        return error_scale(reference_run().window.state, natural_units(request.scene))

    def error(run: Run) -> float:
        last, exact = _last(run), _last(reference_run())
        single = run.error.dtype.itemsize < 8  # in single precision the number of whole turns of angles is unknown
        value = float(scaled_error(with_nearest_turns(last, exact) if single else last, exact, scale()))
        return value if np.isfinite(value) else np.inf

    rows = _full_rows(request, initial_state(request.scene), lambda tolerance: end, error)
    reason = "leading order, exact orbit, envelope: these do not determine the phase, which is part of the final state"
    scaled_entries = jax.tree.leaves(jax.tree.map(lambda x, unit: np.ravel(x / unit), _last(reference_run()), scale()))
    return Cost("final_state", np.concatenate(scaled_entries).tolist(), float(reference_run().error), rows, (reason,))


def _last(run: Run) -> State:
    return jax.tree.map(lambda leaf: np.asarray(leaf[-1], float), run.window.state)
