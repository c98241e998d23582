"""Questions that several cases share, to jaxvib and to the reference."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scenes
from jax import Array

from hard_cases.case import Answer, Case, Reference
from hard_cases.reference_integration import Outcome, run_out
from hard_cases.reference_model import light_modes, light_speed, platforms, reference_model
from jaxvib.equations.state import State
from jaxvib.machine.scene import Scene
from jaxvib.motion.plan import StepChoice
from jaxvib.motion.run import Run
from jaxvib.motion.simulate import simulate
from jaxvib.results.status import status_name, status_names
from jaxvib.steady.jams.jam import jam_modes

__all__ = [
    "away",
    "compared_state",
    "end_of_run",
    "final_state",
    "jam_case",
    "light_force_slope",
    "published",
    "run_case",
    "state_of",
]


def published(speed: float = 3.0, **change: float) -> Scene:
    """The machine of the antiphase paper, equation (40), with one load; any of its numbers may be another."""
    return scenes.published(speed, **change).scene()


def _mode_speeds(scene: Scene) -> Answer:
    """Load speeds of the jam modes that exist, ascending, or the first status that is neither found nor absent."""
    modes = jam_modes(scene)
    names = status_names(modes.status)
    other = [str(name) for name in names if name not in ("found", "absent")]
    return Answer(np.sort(np.asarray(modes.omega)[names == "found"]), status=other[0] if other else "")


def _mode_speeds_again(scene: Scene) -> Reference:
    """The same as roots of n(Omega) = n, by dense complex algebra and Brent's method."""
    p = reference_model(scene)
    return Reference(light_modes(p, float(scene.drive.speed)))


jam_case = partial(
    Case,
    quantity="load speeds of all jam modes",
    against="roots of n(Omega) - n by Brent's method",
    answer=_mode_speeds,
    reference=_mode_speeds_again,
    within=(1e-9, 1e-3),
)
run_case = partial(Case, quantity="state at the end of a run", against="reference model, integrated by SciPy's DOP853")


def light_force_slope(scene: Scene, mode_near: float, step: float = 1e-5) -> np.ndarray:
    """Derivatives of the foundation force of light loads by the logarithm of each stiffness, supports then links.

    Central differences to steps h and 2h, extrapolated: the error is about h^4 and 1e-15/h.
    """

    def force(values: np.ndarray) -> float:
        nd = platforms(scene).stiffness.shape[0]
        changed = eqx.tree_at(_stiffnesses, scene, (values[:nd], values[nd:]))
        p = reference_model(changed)
        roots = light_modes(p, float(scene.drive.speed))
        return light_speed(p, roots[np.argmin(np.abs(roots - mode_near))])[2]

    whole = np.concatenate([np.asarray(x, float) for x in _stiffnesses(scene)])

    def slope(k: int, h: float) -> float:
        ends = []
        for sign in (1.0, -1.0):
            values = whole.copy()
            values[k] *= 1.0 + sign * h
            ends.append(force(values))
        return (ends[0] - ends[1]) / (2.0 * h)

    return np.array([(4.0 * slope(k, step) - slope(k, 2.0 * step)) / 3.0 for k in range(whole.size)])


def _stiffnesses(scene: Scene) -> tuple[Array, Array]:
    machine = platforms(scene)
    return machine.stiffness, machine.link_stiffness


def state_of(scene: Scene, y: np.ndarray) -> State:
    """A state of the scene from the numbers of a `ReferenceModel` one, in JAX's precision."""
    nd, n = scene.machine.structure().mass.shape[0], scene.loads.count
    q, v, phi, rate, *rest = (jnp.asarray(x, float) for x in np.split(y, np.cumsum([nd, nd, n, n])))
    rotor = (rest[0][0], rest[0][1]) if rest and rest[0].size else None
    return State(q, v, (phi,), (rate,), rotor)


def end_of_run(run: Run) -> np.ndarray:
    """The state at the end of a run: q, q', cos and sin of angles (which count whole turns or not), speeds."""
    last = run.window.state
    rotor = [] if last.rotor is None else [last.rotor[0][-1:], last.rotor[1][-1:]]
    parts = [last.displacement[-1], last.velocity[-1], last.angle[0][-1], last.rate[0][-1], *rotor]
    return _turned(*(np.asarray(x, float) for x in parts))


def _turned(q: np.ndarray, v: np.ndarray, phi: np.ndarray, rate: np.ndarray, *rotor: np.ndarray) -> np.ndarray:
    parts = [q, v, np.cos(phi), np.sin(phi), rate]
    if rotor:
        parts += [np.cos(rotor[0]), np.sin(rotor[0]), rotor[1]]
    return np.concatenate(parts)


def compared_state(scene: Scene, out: Outcome, unknown: float = 1e-9) -> Reference:
    """A reference's state at the end, with the scales of `Run.error`."""
    p = reference_model(scene)
    nd, n, y = p.mass.shape[0], p.m.size, out.state
    speed = float(scene.drive.speed)
    length = np.sum(p.m * p.radius) / np.sum(p.whole_mass)
    q, v = max(out.displacement, length), max(out.velocity, length * speed)
    scale = [q] * nd + [v] * nd + [1.0] * (2 * n) + [speed] * n + ([] if y.size == 2 * (nd + n) else [1.0, 1.0, speed])
    parts = np.split(y, np.cumsum([nd, nd, n, n]))
    rotor = () if parts[4].size == 0 else (parts[4][:1], parts[4][1:])
    return Reference(_turned(*parts[:4], *rotor), np.array(scale), unknown)


def final_state(
    until: float,
    start: Callable[[Scene], np.ndarray],
    *,
    steps: tuple[StepChoice | None, StepChoice | None] = (None, None),
    unknown: float = 1e-9,
    claims: bool = True,
) -> tuple[Callable[[Scene], Answer], Callable[[Scene], Reference]]:
    """The state at the end of a run from `start`, asked by `simulate`, and by SciPy's integration of the reference model."""

    def answer(scene: Scene) -> Answer:
        chosen = steps[0 if scene.drive.speed.dtype.itemsize == 8 else 1]
        began = state_of(scene, start(scene))
        run = simulate(scene, until, start=began, save="window", stepsize_controller=chosen, throw=False)
        status = status_name(run.status)
        return Answer(end_of_run(run), float(run.error) if claims else None, "" if status == "done" else status)

    def reference(scene: Scene) -> Reference:
        return compared_state(scene, run_out(reference_model(scene), start(scene), until), unknown)

    return answer, reference


def away(scene: Scene, *, displacement: float = 0.0, angle: float = -1.0, rate: float = 0.0) -> np.ndarray:
    """A state away from rest, its numbers those of single precision so that both precisions start alike.

    Platforms are displaced by so many natural units S/M, load j is at `angle` + 0.7 j rad and turns at the share `rate` of the
    rotor speed.
    """
    p = reference_model(scene)
    nd, n = p.mass.shape[0], p.m.size
    length = np.sum(p.m * p.radius) / np.sum(p.whole_mass)
    motor = [] if scene.drive.ideal else [0.0, 0.0]
    y = [displacement * length] * nd + [0.0] * nd + [angle + 0.7 * j for j in range(n)] + [rate * float(scene.drive.speed)] * n
    return np.asarray([*y, *motor], np.float32).astype(float)
