"""Trial of random scenes: each result must be right, a named status, or a message about the input.

    python benchmarks/trials/random_scenes.py --scenes 500 --out out

The scenes are of few kinds, so that few programs are compiled, with parameters over many decades. The tests of each scene are

- `jam_modes`: the torques balance in the dense complex algebra of `hard_cases.reference_model`, to 1e-8
- `jam_orbit` of the first existing mode: its state, integrated by SciPy over one turn, returns to itself, to 1e-6
- `multipliers` of this jam: the largest one agrees with that of SciPy's implicit method along the motion, to 1e-6
- `balance` of two loads and more: the multipliers agree with those of SciPy's implicit method, to 1e-6
- `simulate`: the state at the end agrees with that of SciPy, to the estimated error and 1e-6
- the gradient of the foundation force with respect to the stiffnesses agrees with finite differences for one of two steps, to
  1e-4

Every other outcome, including warnings and more than 60 s, is a failure and is printed with the seed that repeats it.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import functools
import json
import pathlib
import sys
import time
import traceback
import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import numba
import numpy as np
from scipy.linalg import eigh

import jaxvib as jv
from jaxvib.results.status import status_name

sys.path[:0] = [str(pathlib.Path(__file__).parents[2] / "tests" / name) for name in ("helpers", "validation")]

from hard_cases.reference_integration import multipliers, run_out  # noqa: E402
from hard_cases.reference_model import ReferenceModel, light_modes, light_speed, number_of, reference_model  # noqa: E402
from hard_cases.shared import away, compared_state, end_of_run, light_force_slope, state_of  # noqa: E402

jv.prepare_cpu()

PATIENCE = 60.0
"""CPU seconds that no answer may take, without those of other programs and of references."""

reference_seconds = 0.0


def not_counted(function: Callable) -> Callable:
    """Return a reference whose CPU seconds are added to `reference_seconds`."""

    @functools.wraps(function)
    def reference(*args: object, **keywords: object) -> object:
        global reference_seconds
        begun = time.process_time()
        try:
            return function(*args, **keywords)
        finally:
            reference_seconds += time.process_time() - begun

    return reference


run_out, multipliers = map(not_counted, (run_out, multipliers))


def drawn(rng: np.random.Generator) -> jv.Scene:
    """A random machine of one or two platforms with one to three equal loads.

    A fifth each have no damping, drag up to a billion times the usual one, and rotors down to a hundredth of the frequencies.
    In half of the scenes the drag is replaced by that of a jam up to a tenth below a resonance, if the rotor is fast enough:
    most drags of the first kind let the loads turn with the rotor.
    """

    def number(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    size, count = number(1e-3, 1e4), int(rng.integers(1, 4))
    natural, ratio = number(3.0, 300.0), number(1e-4, 0.3)
    if rng.uniform() < 0.5:
        machine = jv.one_mass(mass=size, stiffness=size * natural**2, damping=2.0 * ratio * size * natural)
    else:
        masses = (size, size * number(0.2, 5.0))
        machine = jv.two_mass(
            mass=masses,
            stiffness=[m * (natural * number(0.3, 3.0)) ** 2 for m in masses],
            damping=[2.0 * ratio * m * natural for m in masses],
            link_stiffness=size * (natural * number(0.3, 3.0)) ** 2,
            link_damping=2.0 * ratio * size * natural,
        )
    mass, speed = size * number(1e-6, 0.1) / count, natural * number(0.5, 5.0)
    radius, drag = number(1e-3, 1.0), mass * natural * number(1e-4, 10.0)
    undamped, dragged, slow = rng.uniform(size=3) < 0.2
    if undamped:
        machine = eqx.tree_at(
            lambda m: (m.damping, m.link_damping), machine, (0.0 * machine.damping, 0.0 * machine.link_damping)
        )
    drag, speed = drag * (number(1.0, 1e9) if dragged else 1.0), speed * (number(0.01, 1.0) if slow else 1.0)
    scene = jv.Scene(machine, jv.balls(count=count, mass=mass, radius=radius, drag=drag), jv.ConstantSpeed(speed))
    if rng.uniform() < 0.5:
        p = reference_model(scene)
        natural = np.sqrt(eigh(p.stiffness, p.whole_mass, eigvals_only=True))
        omega = (1.0 - number(1e-4, 0.1)) * natural[int(rng.integers(natural.size))]
        lag = light_speed(p, omega)[0] - omega
        if lag > 0.0 and speed > omega:
            drag *= lag / (speed - omega)
    return jv.Scene(machine, jv.balls(count=count, mass=mass, radius=radius, drag=drag), jv.ConstantSpeed(speed))


@numba.njit(cache=True)
def _rates(
    y: np.ndarray, whole: np.ndarray, damping: np.ndarray, stiffness: np.ndarray, at: int, own: np.ndarray, turned: np.ndarray,
    drag: np.ndarray, speed: float,
) -> np.ndarray:  # fmt: skip
    nd, n = whole.shape[0], own.size
    q, v, phi, rate = y[:nd], y[nd : 2 * nd], y[2 * nd : 2 * nd + n], y[2 * nd + n :]
    matrix, right = np.zeros((nd + n, nd + n)), np.zeros(nd + n)
    matrix[:nd, :nd] = whole
    right[:nd] = -(damping @ v) - stiffness @ q
    for j in range(n):
        matrix[at, nd + j] = matrix[nd + j, at] = own[j] * np.cos(phi[j])
        matrix[nd + j, nd + j] = turned[j]
        right[at] += own[j] * np.sin(phi[j]) * rate[j] ** 2
        right[nd + j] = drag[j] * (speed - rate[j])
    change = np.linalg.solve(matrix, right)
    return np.concatenate((v, change[:nd], rate, change[nd:]))


class Fast(ReferenceModel):
    """The same dense equations without effects at constant speed, compiled: SciPy asks for them a thousand times a scene."""

    @functools.cached_property
    def numbers(self) -> tuple:
        own = self.m * self.radius
        matrices = (np.ascontiguousarray(x) for x in (self.whole_mass, self.damping, self.stiffness))
        drag = self.drag * self.radius**2
        return *matrices, self.at, own, self.kappa * own * self.radius, drag, number_of(self.drive, "speed")

    def field(self, t: float, y: np.ndarray, press: float = 0.0) -> np.ndarray:
        return _rates(y, *self.numbers)


def fast(scene: jv.Scene) -> Fast:
    p = reference_model(scene)
    return Fast(**{field.name: getattr(p, field.name) for field in dataclasses.fields(p)})


def relative(found: np.ndarray, right: np.ndarray) -> float:
    return float(np.max(np.abs(np.asarray(found) - right)) / np.max(np.abs(right)))


def ask_modes(scene: jv.Scene, rng: np.random.Generator) -> str:
    modes, p, speed = jv.jam_modes(scene), reference_model(scene), float(scene.drive.speed)
    for k in modes.mode_numbers():
        jam = modes.select(k)
        n, moved, force = light_speed(p, float(jam.omega))
        if status_name(jam.status) != "found":
            continue
        # a steep branch makes of the last digit of Omega more in n
        if abs(n - speed) > 1e-8 * speed * (1.0 + abs(float(jam.slope)) * float(jam.omega) / speed * 1e-6):
            return f"wrong: torques of mode {k} do not balance by {n / speed - 1.0:.1e}"
        if relative(jam.amplitude, np.abs(moved)) > 1e-7 or abs(float(jam.foundation_force) / force - 1.0) > 1e-6:
            return f"wrong: amplitude of mode {k}"
    missing = light_modes(p, speed)
    found = np.asarray(modes.omega)[np.asarray(modes.exists)]
    lost = [w for w in missing if not np.any(np.abs(found / w - 1.0) < 1e-6)]
    return f"wrong: modes at {lost} are missing, found {found}" if lost else "right"


def ask_orbit(scene: jv.Scene, rng: np.random.Generator) -> str:
    modes = jv.jam_modes(scene).mode_numbers()
    if not modes:
        return "named: no mode"
    orbit = jv.jam_orbit(scene, mode=modes[0], throw=False)
    if status_name(orbit.status) != "found":
        return f"named: {status_name(orbit.status)}"
    q, v, (phi,), (rate,) = orbit.at(0.0)
    y = np.concatenate([np.asarray(x, float) for x in (q, v, phi, rate)])
    out = run_out(fast(scene), y, 2.0 * np.pi / float(orbit.omega))
    nd, n = len(orbit.units), scene.loads.count
    end = out.state.copy()
    end[2 * nd : 2 * nd + n] -= 2.0 * np.pi
    scale = np.array([out.displacement] * nd + [out.velocity] * nd + [1.0] * n + [float(orbit.omega)] * n)
    miss = float(np.max(np.abs(end - y) / scale)) / max(1.0, float(orbit.multiplier))
    return "right" if miss < 1e-6 else f"wrong: the motion comes back but for {miss:.1e}"


def ask_multipliers(scene: jv.Scene, rng: np.random.Generator) -> str:
    modes = jv.jam_modes(scene).mode_numbers()
    if not modes:
        return "named: no mode"
    orbit = jv.jam_orbit(scene, mode=modes[-1], throw=False)
    if status_name(orbit.status) != "found":
        return f"named: {status_name(orbit.status)}"
    w, n, nd = float(orbit.omega), scene.loads.count, len(orbit.units)
    numbers = (orbit.displacement_harmonics, orbit.orders, orbit.deviation_harmonics, orbit.deviation_orders)
    moved, k, ahead, j = (np.asarray(x) for x in numbers)

    def motion(t: float) -> np.ndarray:
        wave, lag = np.exp(1j * k * w * t), np.exp(1j * j * w * t)
        phi, rate = w * t + (ahead @ lag).real, w * (1.0 + (ahead @ (1j * j * lag)).real)
        return np.concatenate([(moved @ wave).real, w * (moved @ (1j * k * wave)).real, np.tile(phi, n), np.tile(rate, n)])

    right = np.abs(multipliers(reference_model(scene), motion, 2.0 * np.pi / w))
    right = np.delete(right, np.argmin(np.abs(right - 1.0)))
    miss = abs(float(orbit.multiplier) - np.max(right)) / max(1.0, float(np.max(right)))
    return "right" if miss < 1e-6 else f"wrong: multiplier {float(orbit.multiplier)}, SciPy {np.max(right)} (nd {nd})"


def ask_balance(scene: jv.Scene, rng: np.random.Generator) -> str:
    states = jv.balanced_states(scene)
    if not len(states.angles):
        return f"named: {status_name(states.status)}"
    found, angles, speed = states.stability(), states.angles[0], float(scene.drive.speed)
    nd = scene.machine.structure().mass.shape[0]

    def motion(t: float) -> np.ndarray:
        return np.concatenate([np.zeros(2 * nd), angles + speed * t, np.full(angles.size, speed)])

    right = np.sort(np.abs(multipliers(reference_model(scene), motion, 2.0 * np.pi / speed)))[::-1]
    miss = float(np.max(np.abs(np.abs(found.multipliers) - right))) / max(1.0, float(right[0]))
    return "right" if miss < 1e-6 else f"wrong: multipliers {np.abs(found.multipliers)}, SciPy {right}"


def ask_run(scene: jv.Scene, rng: np.random.Generator) -> str:
    p = fast(scene)
    fastest = max(float(scene.drive.speed), float(np.sqrt(np.max(np.diag(p.stiffness) / np.diag(p.mass)))))
    until, y = 40.0 / fastest, away(scene, displacement=1.0, rate=0.3)
    run = jv.simulate(scene, until, start=state_of(scene, y), save="window", throw=False)
    if status_name(run.status) != "done":
        return f"named: {status_name(run.status)}"
    right = compared_state(scene, run_out(p, y, until))
    error = float(np.max(np.abs(end_of_run(run) - np.asarray(right.values)) / np.asarray(right.scale)))
    return "right" if error <= max(float(run.error), 1e-9) else f"wrong: error {error:.1e}, claimed {float(run.error):.1e}"


@eqx.filter_jit
@eqx.filter_grad
def force_gradient(scene: jv.Scene, place: jax.Array) -> jax.Array:
    """Derivatives of the foundation force in a mode by all numbers; one program for all modes of a kind of scene."""
    return jv.jam_modes(scene).foundation_force[place]


def ask_gradient(scene: jv.Scene, rng: np.random.Generator) -> str:
    modes = jv.jam_modes(scene)
    numbers = [k for k in modes.mode_numbers() if status_name(modes.select(k).status) == "found"]
    if not numbers:
        return "named: no mode"
    k = numbers[0]
    slopes = force_gradient(scene, np.asarray(k - 1)).machine
    machine = scene.machine
    found = np.concatenate([slopes.stiffness * machine.stiffness, slopes.link_stiffness * machine.link_stiffness])
    jam = modes.select(k)
    # Steps of 1e-6 are near enough to folds; where a spring hardly counts, rounding spoils them and those of 1e-4 hold.
    for step in (1e-6, 1e-4):
        right = light_force_slope(scene, float(jam.omega), step)
        if relative(found, right) < 1e-4:
            return "right"
    return f"wrong: gradient {found}, differences {right}, slope {float(jam.slope):.1e}"


QUESTIONS: dict[str, Callable[[jv.Scene, np.random.Generator], str]] = {
    "modes": ask_modes,
    "gradient": ask_gradient,
    "orbit": ask_orbit,
    "multipliers": ask_multipliers,
    "balance": ask_balance,
    "run": ask_run,
}


def ended(ask: Callable[[], str]) -> str:
    """Outcome of a question, failures by their last line."""
    begun, before = time.process_time(), reference_seconds
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = ask()
    except jv.InputError:
        found = "named: refused"
    except jv.ComputationError as error:
        found = f"named: {error.status}"
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        found = f"failed: {type(error).__name__}: {str(error)[:200]} ({pathlib.Path(place.filename).name}:{place.lineno})"
    if (seconds := time.process_time() - begun - (reference_seconds - before)) > PATIENCE:
        found = f"failed: {seconds:.0f} s"
    return found


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--scenes", type=int, default=500)
    options.add_argument("--first", type=int, default=0, help="number of the first one")
    options.add_argument("--questions", nargs="*", default=list(QUESTIONS), choices=list(QUESTIONS))
    options.add_argument("--minutes", type=float, default=1e9, help="after which nothing more is asked")
    options.add_argument("--out", type=pathlib.Path)
    given = options.parse_args()
    jv.use_cache()
    counts: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    bad: list[str] = []

    def note(question: str, seed: int, found: str) -> None:
        counts[question][found.split(":")[0] if not found.startswith("named") else found] += 1
        if found.startswith(("wrong", "failed")):
            bad.append(f"{question}, number {seed}: {found}")
            print(bad[-1], flush=True)

    def write() -> None:
        if given.out is not None:
            given.out.mkdir(parents=True, exist_ok=True)
            found = {"first": given.first, "counts": counts, "bad": bad}
            (given.out / "random_scenes.json").write_text(json.dumps(found, indent=1) + "\n")

    begun = time.perf_counter()
    for seed in range(given.first, given.first + given.scenes):
        if time.perf_counter() - begun > 60.0 * given.minutes:
            break
        for question in given.questions:
            rng = np.random.default_rng([seed, 1])
            note(question, seed, ended(lambda: QUESTIONS[question](drawn(rng), rng)))  # noqa: B023
        if seed % 5 == 4:
            write()
    for question, found in counts.items():
        print(f"{question}: " + ", ".join(f"{number} {name}" for name, number in found.most_common()))
    write()


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
