"""Times of one run, of runs of increasing length, and of an ensemble, compared with other integrators at equal achieved error.

Called by engine.py. The machine is the two-mass machine of the antiphase paper with one load, eps = 0.05 and the rotor speed
5.1779; it starts at y = (-1, 1) with the load speed 1. The error is the largest error of the state at the end, with angles in
rad. The step or tolerance of each method is reduced until this error is reached; the time is then the shortest of several runs.
The ensemble has rotor speeds from 3 to 6. diffrax computes only a part of the ensemble, at speeds from the same range, and its
time is scaled to the whole ensemble.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from parts import native
from parts.common import TOLERANCES, as_first_written, best, best_in_turn, first, flat, published, reach, say, thrown, told

import jaxvib as jv
from jaxvib.motion.integration.system import PackedSystem
from jaxvib.ode.control import PIController
from jaxvib.runtime.cpu import cores


def integrator(scene: jv.Scene, start: jv.State, controller: str = "equal steps") -> Callable[..., Any]:
    """f(scene, end, steps or tolerance): the end state as `simulate` would come to it, and nothing else."""

    @jax.jit
    def run(scene: jv.Scene, end: jax.Array, setting: jax.Array) -> Any:
        motion = PackedSystem(jv.vector_field(scene), start)
        control: Any = diffrax.ConstantStepSize()
        if controller == "adaptive":
            one = jax.tree.map(jnp.ones_like, start)
            relative = jv.State(one.displacement, one.velocity, (jnp.zeros_like(one.angle[0]),), one.rate)
            control = PIController(setting, motion.pack(one), motion.pack(relative))
        solution = diffrax.diffeqsolve(
            motion.term,
            motion.method(),
            t0=0.0,
            t1=end,
            dt0=end / setting if controller == "equal steps" else 0.01,
            y0=motion.pack(start),
            args=motion.args,
            stepsize_controller=control,
            adjoint=diffrax.ForwardMode(),
            max_steps=2**20,
            throw=False,
        )
        return jnp.concatenate([jnp.ravel(leaf[-1]) for leaf in jax.tree.leaves(solution.ys)])

    return lambda scene, end, setting: run(scene, jnp.asarray(end), jnp.asarray(setting, float))


def native_field() -> Any:
    import numba

    space: dict[str, Any] = {"math": __import__("math")}
    exec(native.rates_source(), space)
    return numba.njit(space["rates"])


def single(quick: bool = False, error: float = 1e-6) -> None:
    end = 200.0 if quick else 2000.0
    group = "single run"
    print(f"{group}, T = {end:g}, error {error:g}")
    scene, start = published(), thrown()
    par, speed, y0 = native.numbers(scene), float(scene.drive.speed), flat(start)
    loop = native.single()
    native_compile = first(lambda: loop(y0, speed, par, 1.0, 40))
    exact = loop(y0, speed, par, end, int(40 * end))
    steps = [float(int(end * r)) for r in np.arange(3.0, 24.0, 0.5)]
    chosen, found, _ = reach(lambda n: loop(y0, speed, par, end, int(n)), steps, exact, error)
    rows = [("native loop (numba), Dopri8, equal steps", found, native_compile, f"{chosen:g} steps")]
    calls: list[Callable[[], Any]] = [lambda n=int(chosen): loop(y0, speed, par, end, n)]
    for kind, settings in (("adaptive", TOLERANCES), ("equal steps", steps)):
        run = integrator(scene, start, kind)
        chosen, found, compiling = reach(lambda x, run=run: np.asarray(run(scene, end, x)), settings, exact, error)
        rows.append((f"jaxvib, {kind}", found, compiling, told(chosen, found, error)))
        calls.append(lambda run=run, c=chosen: run(scene, end, c))

    def whole(tolerance: float) -> np.ndarray:
        run = jv.simulate(scene, end, start=start, save="window", stepsize_controller=jv.Tolerance(tolerance), estimate=False)
        return flat(jax.tree.map(lambda leaf: leaf[-1], run.window.state))

    chosen, found, compiling = reach(whole, TOLERANCES, exact, error)
    rows.append(("jaxvib.simulate, with measurements", found, compiling, told(chosen, found, error)))
    seconds = best_in_turn([*calls, lambda c=chosen: whole(c)])
    base = seconds[0]
    for each, (name, found, compiling, note) in zip(seconds, rows, strict=True):
        say(group, name, each, base, found, compiling, note)
    others(scene, start, end, exact, error, base)
    for name, seconds, found, compiling in as_first_written("single", end=end, error=error, exact=exact.tolist()):
        say(group, name, seconds, base, found, compiling)


def others(scene: jv.Scene, start: jv.State, end: float, exact: np.ndarray, error: float, base: float) -> None:
    field = native_field()
    numbers, speed, y0 = native.numbers(scene), float(scene.drive.speed), flat(start)
    par = np.asarray([speed, *numbers])

    def add(name: str, run: Callable[[float], np.ndarray], settings: list[float] = TOLERANCES[4:]) -> None:
        try:
            chosen, found, compiling = reach(run, settings, exact, error)
        except ImportError as missing:
            print(f"  {name:52s} left out: {missing}")
            return
        say("single run", name, best(lambda: run(chosen), 2), base, found, compiling, told(chosen, found, error))

    def scipy_(method: str) -> Callable[[float], np.ndarray]:
        from scipy.integrate import solve_ivp

        def run(tolerance: float) -> np.ndarray:
            out = solve_ivp(
                lambda t, y: field(y, par), (0.0, end), y0, method=method, rtol=tolerance, atol=tolerance, t_eval=[end]
            )
            return out.y[:, -1]

        return run

    def cvode(tolerance: float) -> np.ndarray:
        from sksundae.cvode import CVODE

        def right(t: float, y: np.ndarray, out: np.ndarray) -> None:
            out[:] = field(y, par)

        solver = CVODE(right, method="Adams", rtol=tolerance, atol=tolerance, max_num_steps=10**8)
        return solver.solve(np.array([0.0, end]), y0).y[-1]

    made: dict[str, Any] = {}

    def jitcode_(tolerance: float) -> np.ndarray:
        if not made:
            import symengine
            from jitcode import jitcode, y

            made["ode"] = jitcode(native.symbolic(y, symengine, speed, numbers), n=6)
            with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # it reads a pyproject.toml beside it
                made["ode"].compile_C(extra_compile_args=["-O3", "-march=native", "-ffast-math"])
        ode = made["ode"]
        ode.set_integrator("dop853", rtol=tolerance, atol=tolerance, nsteps=10**8)
        ode.set_initial_value(y0, 0.0)
        return ode.integrate(end)

    add("jitcode, dop853 (C)", jitcode_)
    add("SciPy LSODA, compiled field", scipy_("LSODA"))
    add("SciPy DOP853, compiled field", scipy_("DOP853"))
    add("CVODE Adams (scikit-sundae), compiled field", cvode)
    add("MuJoCo, RK4", mujoco_run(scene, start, end), [0.02, 0.01, 0.005])


def mujoco_run(scene: jv.Scene, start: jv.State, end: float) -> Callable[[float], np.ndarray]:
    y0 = flat(start)

    def run(step: float) -> np.ndarray:
        import mujoco

        m, load = scene.machine, scene.loads
        drag = float(load.drag * load.radius**2)
        text = "".join(
            f"""<body><joint name="y{k}" type="slide" axis="0 0 1" stiffness="{float(m.stiffness[k])!r}"
            damping="{float(m.damping[k])!r}"/>
            <inertial pos="0 0 0" mass="{float(m.mass[k])!r}" diaginertia="1 1 1"/>{"BOB" if k else ""}</body>"""
            for k in range(2)
        ).replace(
            "BOB",
            f"""<body><joint name="p" type="hinge" axis="0 -1 0" damping="{drag!r}"/>
            <inertial pos="{float(load.radius)!r} 0 0" mass="{float(load.mass)!r}" diaginertia="1e-9 1e-12 1e-9"/></body>""",
        )
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><compiler boundmass="0" boundinertia="0" balanceinertia="true"/>
            <option timestep="{step!r}" integrator="RK4" gravity="0 0 0"/><worldbody>{text}</worldbody><tendon>
            <fixed stiffness="{float(m.link_stiffness[0])!r}" damping="{float(m.link_damping[0])!r}" springlength="0 0">
            <joint joint="y0" coef="1"/><joint joint="y1" coef="-1"/></fixed>
            </tendon></mujoco>"""
        )
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = (y0[0], y0[1], y0[4]), (y0[2], y0[3], y0[5])
        data.qfrc_applied[2] = drag * float(scene.drive.speed)
        mujoco.mj_step(model, data, nstep=round(end / step))
        return np.array([*data.qpos[:2], *data.qvel[:2], data.qpos[2], data.qvel[2]])

    return run


def growth_with_length(quick: bool = False) -> None:
    group = "length of a run"
    print(f"growth with the {group}, equal steps, 5 a unit of time")
    scene = published()
    run, base = integrator(scene, thrown()), None
    for end in (200.0, 2000.0) if quick else (200.0, 2000.0, 20000.0, 200_000.0):
        call = lambda end=end: run(scene, end, 5.0 * end)  # noqa: E731
        first(call)
        seconds = best(call, 5)
        base = seconds if base is None else base
        say(group, f"T = {end:g}", seconds, base, None, None, f"per time unit {1e6 * seconds / end:.3f} us", end=end)


def ensemble(quick: bool = False, error: float = 1e-5) -> None:
    runs, share, end = (256, 64, 50.0) if quick else (4096, 256, 200.0)
    group = f"ensemble of {runs}"
    print(f"{group}, T = {end:g}, error {error:g}, {cores()} cores")
    scene, start = published(), thrown()
    par, y0, speeds = native.numbers(scene), flat(start), np.linspace(3.0, 6.0, runs)
    simd, scalar = native.simd_ensemble(), native.scalar_ensemble()
    native_compile = first(lambda: simd(y0, speeds, par, 1.0, 20))
    exact = simd(y0, speeds, par, end, int(20 * end))

    def make(n: jax.Array) -> tuple[jv.Scene, jv.State]:
        return eqx.tree_at(lambda s: s.drive.speed, scene, n), start

    values = jnp.asarray(speeds)

    def ours(steps: float) -> np.ndarray:
        many = jv.ensemble(make, values, end, stepsize_controller=jv.EqualSteps(int(steps)), estimate=False)
        return np.concatenate([np.asarray(leaf).reshape(runs, -1) for leaf in jax.tree.leaves(many.state)], axis=1)

    settings = [float(int(end * r)) for r in np.arange(3.0, 12.0, 0.5)]
    chosen, found, _ = reach(lambda n: simd(y0, speeds, par, end, int(n)), settings, exact, error)
    base = best(lambda: simd(y0, speeds, par, end, int(chosen)))
    steps = f"{chosen:g} steps"
    say(group, "native, hand-written vector instructions (numba)", base, base, found, native_compile, steps)
    _, found, compiling = reach(ours, [chosen], exact, error)
    seconds = best(lambda: jv.ensemble(make, values, end, stepsize_controller=jv.EqualSteps(int(chosen)), estimate=False).state)
    say(group, "jaxvib.ensemble", seconds, base, found, compiling, steps)
    _, found, compiling = reach(lambda n: scalar(y0, speeds, par, end, int(n)), [chosen], exact, error)
    seconds = best(lambda: scalar(y0, speeds, par, end, int(chosen)), 3)
    say(group, "native scalar loop, prange", seconds, base, found, compiling, steps)
    every = runs // share
    asked = dict(end=end, error=error, exact=exact[::every].tolist(), speeds=speeds[::every].tolist())
    for name, seconds, found, compiling in as_first_written("ensemble", **asked):
        say(group, name, seconds * every, base, found, compiling, f"{share} runs, their time {every} times")
