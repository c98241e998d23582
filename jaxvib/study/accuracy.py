"""What accuracy costs in time: one quantity of a scene, computed in every way there is."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.errors import InputError
from jaxvib.machine.effects import Gravity
from jaxvib.machine.scene import Scene
from jaxvib.machine.units import Number, number
from jaxvib.motion.envelope import envelope
from jaxvib.motion.run import Run
from jaxvib.motion.simulate import simulate
from jaxvib.steady.jam import jam_modes
from jaxvib.steady.jam_orbit import jam_orbit
from jaxvib.steady.response import natural_frequencies

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["QUANTITIES", "Cost", "CostRow", "accuracy"]

Quantity = Literal["amplitude", "foundation_force", "final_state", "gradient"]
QUANTITIES = ("amplitude", "foundation_force", "final_state", "gradient")

_TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11)
_SOLVERS: dict[str, Any] = {"written out, order 8": None, "Tsit5": diffrax.Tsit5, "Dopri8": diffrax.Dopri8}
_POINTS = (8, 16)
_AVERAGED = (1e-3, 1e-6)


class CostRow(NamedTuple):
    """One way of computing the quantity: `tier`, `method`, `dtype`, `setting` (a tolerance or a number of points, in words),
    its relative `error`, the `seconds` it took once compiled, and what the first call took besides, `compile`."""

    tier: str
    method: str
    dtype: str
    setting: str
    error: float
    seconds: float
    compile: float


class Cost(NamedTuple):
    """What a quantity costs: the `quantity`, its `reference` values (a list), how far these may be wrong themselves
    (`reference_error`, relative), and the `rows`."""

    quantity: str
    reference: list[float]
    reference_error: float
    rows: list[CostRow]

    def cheapest(self, error: float) -> CostRow | None:
        """The fastest way to that relative error; None if there is none here, or the reference is not good enough to tell."""
        if not self.reference_error < error:
            return None
        able = [row for row in self.rows if row.error + self.reference_error <= error]
        return min(able, key=lambda row: row.seconds, default=None)

    def plot(self) -> Figure:
        """Error against seconds, a line for each method. **Returns** a matplotlib figure."""
        from jaxvib.draw.comparison import cost_chart  # slow to import: only who draws pays

        names = list(dict.fromkeys((row.tier, row.method, row.dtype) for row in self.rows))
        lines = {
            ", ".join(part for part in name if part): (
                np.array([row.seconds for row in self.rows if row[:3] == name]),
                np.array([row.error for row in self.rows if row[:3] == name]),
            )
            for name in names
        }
        return cost_chart(lines, self.reference_error, self.quantity.replace("_", " "))


def accuracy(
    scene: Scene,
    quantity: Quantity = "amplitude",
    *,
    mode: int | None = None,
    until: Number | None = None,
    tolerances: Sequence[float] = _TOLERANCES,
    repeats: int = 3,
) -> Cost:
    """Computes a quantity of a scene by every tier, method, tolerance and dtype, with its error and the time it takes.

    - "amplitude", "foundation_force": of a jam mode; tiers leading order, exact orbit, averaged equations, and full
      integration from the leading order's motion to `until`. The reference is the exact orbit with 32 points, its own error
      the difference to 24.
    - "final_state": of the full equations at `until`; every solver, in double and in single precision. The reference is a
      run to a tolerance of 1e-13, its own error estimated as every run's.
    - "gradient": of the jam's largest amplitude with respect to the machine's stiffnesses; implicit derivatives of leading
      order and exact orbit, forward and reverse mode and finite differences through the full integration.

    **Arguments**: `mode` a jam mode (the highest there is with a rising slope unless said otherwise); `until` s or text, 20
    slow periods unless said otherwise; `tolerances` of time integration; `repeats` how often each is timed, the fastest counts.

    **Returns** `Cost`. **Raises** `InputError` for an unknown quantity; as `jam_modes`, `simulate` besides.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> cost = jv.accuracy(scene, "amplitude", mode=1, tolerances=(1e-6,), repeats=1)
    >>> [row.tier for row in cost.rows if row.error < 1e-6][0], cost.reference_error < 1e-9
    ('exact orbit', True)
    """
    if quantity not in QUANTITIES:
        raise InputError("quantity", f"is {quantity!r}; it must be one of {', '.join(QUANTITIES)}")
    slowest = float(jnp.min(jnp.where(natural_frequencies(scene) > 0.0, natural_frequencies(scene), scene.drive.speed)))
    end = number(40.0 * np.pi / slowest if until is None else until, "s", "until", low=0.0, open_low=True)
    if quantity == "final_state":
        return _final_state(scene, float(end), tolerances, repeats)
    if mode is None:
        modes = jam_modes(scene)
        rising = [k for k in modes.mode_numbers() if bool(modes.select(k).stable)]
        if not rising:
            raise InputError("mode", "is missing, and no jam mode of this scene is stable by its slope; give one")
        mode = rising[-2] if len(rising) > 1 else rising[-1]  # the last one turns with the rotor, nearly
    if quantity == "gradient":
        return _gradient(scene, mode, float(end), repeats)
    return _steady(scene, quantity, mode, float(end), tolerances, repeats)


def _timed(call: Callable[[], Any], repeats: int) -> tuple[Any, float, float]:
    """A result, the seconds of its fastest computation, and what the first one took besides."""
    begun = time.perf_counter()
    value = jax.block_until_ready(call())
    first, best = time.perf_counter() - begun, np.inf
    for _ in range(repeats):
        begun = time.perf_counter()
        value = jax.block_until_ready(call())
        best = min(best, time.perf_counter() - begun)
    return value, best, max(first - best, 0.0)


def _relative(value: Any, reference: np.ndarray) -> float:
    difference = float(np.max(np.abs(np.ravel(np.asarray(value, float)) - reference)) / np.max(np.abs(reference)))
    return difference if np.isfinite(difference) else np.inf


def _row(tier: str, method: str, setting: str, call: Callable[[], Any], reference: np.ndarray, repeats: int) -> CostRow:
    value, seconds, compiling = _timed(call, repeats)
    return CostRow(tier, method, "float64", setting, _relative(value, reference), seconds, compiling)


def _steady(scene: Scene, quantity: str, mode: int, end: float, tolerances: Sequence[float], repeats: int) -> Cost:
    def read(found: Any) -> Any:
        return getattr(found, quantity)

    fine, coarse = (read(jam_orbit(scene, mode=mode, points=points)) for points in (32, 24))
    reference = np.ravel(np.asarray(fine, float))
    rows = [_row("leading order", "", "", _compiled(lambda s: read(jam_modes(s).select(mode)), scene), reference, repeats)]
    for points in _POINTS:
        call = _compiled(lambda s, points=points: read(jam_orbit(s, mode=mode, points=points, throw=False)), scene)
        rows.append(_row("exact orbit", "", f"{points} points", call, reference, repeats))
    if all(isinstance(effect, Gravity) for effect in scene.effects):
        for tolerance in _AVERAGED:

            def averaged(tolerance: float = tolerance) -> Any:
                return read(envelope(scene, end, start="jam", mode=mode, save="window", tolerance=tolerance, throw=False))

            rows.append(_row("envelope", "averaged equations", f"{tolerance:.0e}", averaged, reference, repeats))
    for tolerance in tolerances:
        run = _run_to(scene, end, tolerance, None, mode)
        rows.append(_row("full", "written out, order 8", f"{tolerance:.0e}", lambda run=run: read(run()), reference, repeats))
    return Cost(quantity, reference.tolist(), _relative(coarse, reference), rows)


def _compiled(function: Callable[[Scene], Any], scene: Scene) -> Callable[[], Any]:
    jitted = eqx.filter_jit(function)
    return lambda: jitted(scene)


def _run_to(scene: Scene, end: float, tolerance: float, solver: Any, mode: int | None) -> Callable[[], Run]:
    start: Any = "rest" if mode is None else "jam"
    chosen = None if solver is None else solver()
    return lambda: simulate(
        scene, end, start=start, mode=mode, save="window", tolerance=tolerance, solver=chosen, estimate=False, throw=False
    )


def _final_state(scene: Scene, end: float, tolerances: Sequence[float], repeats: int) -> Cost:
    best = simulate(scene, end, save="window", tolerance=1e-13)
    reference = _scaled(scene, best)
    rows = []
    for name, solver in _SOLVERS.items():
        for tolerance in tolerances:
            run = _run_to(scene, end, tolerance, solver, None)
            found, seconds, compiling = _timed(run, repeats)
            error = _largest(_scaled(scene, found) - reference)
            rows.append(CostRow("full", name, "float64", f"{tolerance:.0e}", error, seconds, compiling))
    with jax.enable_x64(False):
        single = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float32), scene)
        for tolerance in tolerances:
            if tolerance >= 2e-6:
                run = _run_to(single, end, tolerance, None, None)
                found, seconds, compiling = _timed(run, repeats)
                error = _largest(_scaled(single, found) - reference)
                rows.append(CostRow("full", "written out, order 8", "float32", f"{tolerance:.0e}", error, seconds, compiling))
    return Cost("final_state", reference.tolist(), float(best.error), rows)


def _scaled(scene: Scene, run: Run) -> np.ndarray:
    """The final state in the units of a `Run`'s error: the largest displacement and velocity, 1 rad, the rotor's speed."""
    state, last = run.window.state, jax.tree.map(lambda leaf: np.asarray(leaf[-1], float), run.window.state)
    speed = float(scene.drive.speed)
    parts = [last.displacement / np.max(np.abs(state.displacement)), last.velocity / np.max(np.abs(state.velocity))]
    parts += [*last.angle, *(rate / speed for rate in last.rate)]
    if last.rotor is not None:
        parts += [last.rotor[0], last.rotor[1] / speed]
    return np.concatenate([np.ravel(part) for part in parts])


def _largest(difference: np.ndarray) -> float:
    value = float(np.max(np.abs(difference)))
    return value if np.isfinite(value) else np.inf


def _gradient(scene: Scene, mode: int, end: float, repeats: int) -> Cost:
    stiffness = scene.machine.stiffness  # pyright: ignore[reportAttributeAccessIssue]

    def at(k: Any) -> Scene:
        return eqx.tree_at(lambda s: s.machine.stiffness, scene, k)

    def exact(k: Any, points: int = 16) -> Any:
        return jnp.max(jam_orbit(at(k), mode=mode, points=points).amplitude)

    def leading(k: Any) -> Any:
        return jnp.max(jam_modes(at(k)).select(mode).amplitude)

    def full(k: Any, adjoint: Any = None) -> Any:
        run = simulate(
            at(k), end, start="jam", mode=mode, save="window", tolerance=1e-8, adjoint=adjoint, max_steps=2**17, throw=False
        )
        return jnp.max(run.amplitude)

    fine, coarse = (np.asarray(jax.jacfwd(lambda k, p=p: exact(k, p))(stiffness)) for p in (32, 24))
    forward = diffrax.ForwardMode()
    value = eqx.filter_jit(full)

    def differences() -> np.ndarray:
        steps = 1e-5 * np.asarray(stiffness)
        moves = [np.eye(len(steps))[k] * step for k, step in enumerate(steps) if step > 0.0]
        found = [(float(value(stiffness + m)) - float(value(stiffness - m))) / (2.0 * np.sum(m)) for m in moves]
        whole = np.zeros(len(steps))
        whole[steps > 0.0] = found
        return whole

    ways: list[tuple[str, str, str, Callable[..., Any]]] = [
        ("leading order", "implicit, reverse", "", jax.jit(jax.grad(leading))),
        ("exact orbit", "implicit, reverse", "16 points", jax.jit(jax.grad(exact))),
        ("exact orbit", "implicit, forward", "16 points", jax.jit(jax.jacfwd(exact))),
        ("full", "forward", "1e-08", jax.jit(jax.jacfwd(lambda k: full(k, forward)))),
        ("full", "reverse", "1e-08", jax.jit(jax.grad(full))),
        ("full", "finite differences", "1e-08", lambda _: differences()),
    ]
    rows = [_row(tier, method, setting, lambda f=f: f(stiffness), fine, repeats) for tier, method, setting, f in ways]
    return Cost("gradient", fine.tolist(), _relative(coarse, fine), rows)
