"""The time integrator against others, at equal achieved error; ratios in one run, compile time apart.

    pip install numba scipy mujoco diffrax jitcode scikit-sundae      # those that are missing are left out
    python benchmarks/engine.py [--only single ensemble gradient designs loads length memory] [--json FILE]

The machine is the two-mass one of the antiphase paper with one load, eps = 0.05, rotor speed 5.1779, started at y = (-1, 1),
load speed 1. The error is the largest one in the state at the end, angle in rad; every contender's step or tolerance is made
smaller until it is reached, then the fastest of several runs counts.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jaxvib as jv

FIRST_WRITTEN = "JAXVIB_BENCHMARK_PLAIN" in os.environ
if not FIRST_WRITTEN:
    jv.prepare_cpu(devices=None)

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import diffrax  # noqa: E402
import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import native  # noqa: E402
import numpy as np  # noqa: E402

from jaxvib.motion.engine import Motion, Tolerance  # noqa: E402
from jaxvib.motion.solver import WrittenOut  # noqa: E402

RESULTS: list[dict[str, Any]] = []


def published(speed: float = 5.1779) -> jv.Scene:
    numbers = dict(natural=(1 / 3, 1 / 3), damping=(0.01, 0.01), link_natural=2 / 3, link_damping=0.01, rho=1.0, beta=1.0)
    return jv.Dimensionless("antiphase", **numbers, eps=0.05, speed=speed).scene()


SCENE = published()
PAR = native.numbers(SCENE)
SPEED = float(SCENE.drive.speed)
START = jv.State(jnp.asarray([-1.0, 1.0]), jnp.zeros(2), (jnp.zeros(1),), (jnp.ones(1),))
Y0 = native.flat(START)


def best(call: Callable[[], Any], runs: int = 7) -> float:
    fastest = np.inf
    for _ in range(runs):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        fastest = min(fastest, time.perf_counter() - begun)
    return fastest


def first(call: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - begun


def say(group: str, name: str, seconds: float, base: float, error: float, compiling: float, note: str = "") -> None:
    RESULTS.append(
        dict(group=group, name=name, seconds=seconds, ratio=seconds / base, error=error, compile=compiling, note=note)
    )
    print(
        f"  {name:44s} {1e3 * seconds:11.3f} ms  x{seconds / base:9.2f}  error {error:.1e}  compile {compiling:6.2f} s {note}",
        flush=True,
    )


def reach(
    run: Callable[[float], np.ndarray], settings: list[float], exact: np.ndarray, error: float
) -> tuple[float, float, float]:
    """The first setting that is exact enough, the error it has, and the seconds of the very first call."""
    compiling = first(lambda: run(settings[0]))
    found = np.inf
    for setting in settings:
        found = float(np.max(np.abs(run(setting) - exact)))
        if found <= error:
            return setting, found, compiling
    return settings[-1], found, compiling


def engine(controller: str, adjoint: Any = None) -> Callable[..., Any]:
    """The engine as `simulate` uses it, keeping the end state alone."""

    @jax.jit
    def run(scene: jv.Scene, end: jax.Array, setting: jax.Array) -> Any:
        motion = Motion(jv.vector_field(scene), START)
        one, zero = jnp.ones(()), jnp.zeros(())
        control: Any = diffrax.ConstantStepSize()
        if controller == "adaptive":
            relative = jv.State(jnp.ones(2), jnp.ones(2), (zero[None],), (one[None],))
            control = Tolerance(setting, motion.held(jax.tree.map(jnp.ones_like, START)), motion.held(relative))
        solution = diffrax.diffeqsolve(
            motion.term,
            WrittenOut(),
            t0=0.0,
            t1=end,
            dt0=end / setting if controller == "equal steps" else 0.01,
            y0=motion.held(START),
            args=motion.args,
            stepsize_controller=control,
            adjoint=diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
            max_steps=2**20,
            throw=False,
        )
        return jnp.stack([leaf[-1] for leaf in solution.ys])

    return lambda scene, end, setting: run(scene, jnp.asarray(end), jnp.asarray(setting, float))


def as_first_written(solver: Any, end: float, tolerance: float) -> Any:
    """diffrax as its documentation writes it, on the State itself."""
    term = diffrax.ODETerm(lambda t, y, args: args(t, y))
    control = diffrax.PIDController(rtol=tolerance, atol=tolerance)
    solution = diffrax.diffeqsolve(
        term, solver, 0.0, end, 0.01, START, jv.vector_field(SCENE), stepsize_controller=control, max_steps=2**20, throw=False
    )
    return jnp.concatenate([jnp.ravel(leaf[-1]) for leaf in jax.tree.leaves(solution.ys)])


TOLERANCES = [10.0 ** (-k / 2) for k in range(8, 27)]


def native_field() -> Any:
    import numba

    source = native.rates_source()
    space: dict[str, Any] = {"math": __import__("math")}
    exec(source, space)
    return numba.njit(space["rates"])


def single(end: float = 2000.0, error: float = 1e-6) -> None:
    print(f"single run, T = {end:g}, error {error:g}")
    loop = native.single()
    exact = loop(Y0, SPEED, PAR, end, int(40 * end))
    steps = [float(int(end * r)) for r in np.arange(3.0, 24.0, 0.5)]
    chosen, found, compiling = reach(lambda n: loop(Y0, SPEED, PAR, end, int(n)), steps, exact, error)
    base = best(lambda: loop(Y0, SPEED, PAR, end, int(chosen)), 15)
    say("single", "native loop (numba), Dopri8, equal steps", base, base, found, compiling, f"{chosen:g} steps")
    for kind, settings in (("equal steps", steps), ("adaptive", TOLERANCES)):
        run = engine(kind)
        chosen, found, compiling = reach(lambda x, run=run: np.asarray(run(SCENE, end, x)), settings, exact, error)
        say(
            "single",
            f"jaxvib, {kind}",
            best(lambda run=run, c=chosen: run(SCENE, end, c), 15),
            base,
            found,
            compiling,
            f"{chosen:.1e}",
        )

    def whole(tolerance: float) -> np.ndarray:
        run = jv.simulate(SCENE, end, start=START, save="window", tolerance=tolerance, estimate=False)
        return native.flat(jax.tree.map(lambda leaf: leaf[-1], run.window.state))

    chosen, found, compiling = reach(whole, TOLERANCES, exact, error)
    say(
        "single",
        "jaxvib.simulate, measured over its window",
        best(lambda: whole(chosen)),
        base,
        found,
        compiling,
        f"{chosen:.1e}",
    )
    others(end, exact, error, base)
    plain = subprocess.run(
        [sys.executable, __file__, "--plain", str(end), str(error), json.dumps(exact.tolist())],
        env={**os.environ, "JAXVIB_BENCHMARK_PLAIN": "1", "XLA_FLAGS": ""},
        capture_output=True,
        text=True,
        check=True,
    )
    for name, seconds, found, compiling in json.loads(plain.stdout.splitlines()[-1]):
        say("single", name, seconds, base, found, compiling)


def plain(end: float, error: float, exact: np.ndarray) -> None:
    """In a process without flags: diffrax as first written."""
    rows = []
    for name, solver in (("Tsit5", diffrax.Tsit5()), ("Dopri8", diffrax.Dopri8())):
        run = jax.jit(lambda t, solver=solver: as_first_written(solver, end, t))
        chosen, found, compiling = reach(lambda t, run=run: np.asarray(run(t)), TOLERANCES[4:], exact, error)
        rows.append((f"diffrax {name} as first written", best(lambda run=run, c=chosen: run(c), 2), found, compiling))
    print(json.dumps(rows))


def others(end: float, exact: np.ndarray, error: float, base: float) -> None:
    field = native_field()
    par = np.asarray([SPEED, *PAR])

    def add(name: str, run: Callable[[float], np.ndarray], settings: list[float] = TOLERANCES[2:]) -> None:
        try:
            chosen, found, compiling = reach(run, settings, exact, error)
            say("single", name, best(lambda: run(chosen), 2), base, found, compiling, f"{chosen:.1e}")
        except ImportError as missing:
            print(f"  {name:44s} left out: {missing}")

    def scipy_(method: str) -> Callable[[float], np.ndarray]:
        from scipy.integrate import solve_ivp

        def run(tolerance: float) -> np.ndarray:
            out = solve_ivp(
                lambda t, y: field(y, par), (0.0, end), Y0, method=method, rtol=tolerance, atol=tolerance, t_eval=[end]
            )
            return out.y[:, -1]

        return run

    def cvode(tolerance: float) -> np.ndarray:
        from sksundae.cvode import CVODE

        def right(t: float, y: np.ndarray, out: np.ndarray) -> None:
            out[:] = field(y, par)

        solver = CVODE(right, method="Adams", rtol=tolerance, atol=tolerance, max_num_steps=10**8)
        return solver.solve(np.array([0.0, end]), Y0).y[-1]

    made: dict[str, Any] = {}

    def jitcode_(tolerance: float) -> np.ndarray:
        if not made:
            import symengine
            from jitcode import jitcode, y

            made["ode"] = jitcode(native.symbolic(y, symengine, SPEED, PAR), n=6)
            made["ode"].compile_C(extra_compile_args=["-O3", "-march=native", "-ffast-math"])
        ode = made["ode"]
        ode.set_integrator("dop853", rtol=tolerance, atol=tolerance, nsteps=10**8)
        ode.set_initial_value(Y0, 0.0)
        return ode.integrate(end)

    add("jitcode, dop853 (C)", jitcode_)
    add("SciPy LSODA, compiled field", scipy_("LSODA"))
    add("SciPy DOP853, compiled field", scipy_("DOP853"))
    add("CVODE Adams (scikit-sundae), compiled field", cvode)
    add("MuJoCo, RK4", mujoco_run(end), [0.02, 0.01, 0.005])


def mujoco_run(end: float) -> Callable[[float], np.ndarray]:
    def run(step: float) -> np.ndarray:
        import mujoco

        m, load = SCENE.machine, SCENE.loads
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
        data.qpos[:], data.qvel[:] = (Y0[0], Y0[1], Y0[4]), (Y0[2], Y0[3], Y0[5])
        data.qfrc_applied[2] = drag * SPEED
        mujoco.mj_step(model, data, nstep=round(end / step))
        return np.array([*data.qpos[:2], *data.qvel[:2], data.qpos[2], data.qvel[2]])

    return run


def ensemble(runs: int = 4096, end: float = 200.0, error: float = 1e-5) -> None:
    print(f"ensemble of {runs}, T = {end:g}, error {error:g}, {len(jax.devices())} devices")
    speeds = np.linspace(3.0, 6.0, runs)
    simd, scalar = native.simd_ensemble(), native.scalar_ensemble()
    exact = simd(Y0, speeds, PAR, end, int(20 * end))

    def make(n: jax.Array) -> tuple[jv.Scene, jv.State]:
        return eqx.tree_at(lambda s: s.drive.speed, SCENE, n), START

    def ours(steps: float) -> np.ndarray:
        many = jv.ensemble(make, jnp.asarray(speeds), end, steps=int(steps), estimate=False)
        return np.concatenate([np.asarray(leaf).reshape(runs, -1) for leaf in jax.tree.leaves(many.state)], axis=1)

    settings = [float(int(end * r)) for r in np.arange(3.0, 12.0, 0.5)]
    chosen, found, compiling = reach(lambda n: simd(Y0, speeds, PAR, end, int(n)), settings, exact, error)
    base = best(lambda: simd(Y0, speeds, PAR, end, int(chosen)))
    say("ensemble", "native, vector instructions by hand (numba)", base, base, found, compiling, f"{chosen:g} steps")
    _, found, compiling = reach(ours, [chosen], exact, error)
    values = jnp.asarray(speeds)
    seconds = min(float(jv.ensemble(make, values, end, steps=int(chosen), estimate=False).seconds) for _ in range(7))
    say("ensemble", "jaxvib.ensemble", seconds, base, found, compiling, f"{chosen:g} steps")
    _, found, compiling = reach(lambda n: scalar(Y0, speeds, PAR, end, int(n)), [chosen], exact, error)
    say("ensemble", "native scalar, prange", best(lambda: scalar(Y0, speeds, PAR, end, int(chosen)), 3), base, found, compiling)


def gradient(end: float = 200.0) -> None:
    print(f"gradient of the end state with respect to 6 numbers, T = {end:g}, 1000 equal steps")
    machine = SCENE.machine
    values = jnp.concatenate([machine.stiffness, machine.damping, machine.link_stiffness, machine.link_damping])

    def moved(x: jax.Array) -> jv.Scene:
        parts = (x[:2], x[2:4], x[4:5], x[5:6])
        return eqx.tree_at(
            lambda s: tuple(getattr(s.machine, n) for n in ("stiffness", "damping", "link_stiffness", "link_damping")),
            SCENE,
            parts,
        )

    def value(x: jax.Array, adjoint: Any = None) -> jax.Array:
        return engine("equal steps", adjoint)(moved(x), end, 1000.0)[1]

    run = jax.jit(value)
    compiling = first(lambda: run(values))
    base = best(lambda: run(values), 20)
    say("gradient", "the run itself", base, base, 0.0, compiling)
    forward = jax.jit(jax.jacfwd(lambda x: value(x, diffrax.ForwardMode())))
    reverse = jax.jit(jax.grad(value))
    steps = 1e-6
    differences = jnp.stack([(run(values.at[k].add(steps)) - run(values.at[k].add(-steps))) / (2 * steps) for k in range(6)])
    for name, call in (("forward mode", forward), ("reverse mode, checkpointed", reverse)):
        compiling = first(lambda call=call: call(values))
        error = float(jnp.max(jnp.abs(call(values) - differences)) / jnp.max(jnp.abs(differences)))
        say(
            "gradient", name, best(lambda call=call: call(values), 10), base, error, compiling, "(error: to finite differences)"
        )


def designs(count: int = 200_000) -> None:
    rng = np.random.default_rng(0)
    stiffness = jnp.asarray(rng.uniform(0.05, 0.2, (count, 2)))

    def one(k: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.value_and_grad(
            lambda k: jv.jam_rotor_speed(eqx.tree_at(lambda s: s.machine.stiffness, SCENE, k), jnp.asarray(0.9))
        )(k)

    call = jax.jit(lambda k: jax.lax.map(jax.vmap(one), k.reshape(-1, 1000, 2)))
    compiling = first(lambda: call(stiffness))
    seconds = best(lambda: call(stiffness))
    print(f"leading-order designs with gradients: {count / seconds:.2e} a second on one device, compile {compiling:.2f} s")
    RESULTS.append(dict(group="designs", per_second=count / seconds, compile=compiling))


def growth_with_length() -> None:
    print("growth with the length of a run, equal steps, 5 a unit of time")
    run, before = engine("equal steps"), None
    for end in (200.0, 2000.0, 20000.0):
        call = lambda end=end: run(SCENE, end, 5.0 * end)  # noqa: E731
        first(call)
        seconds = best(call, 5)
        print(
            f"  T = {end:7g}: {1e3 * seconds:9.3f} ms" + ("" if before is None else f", {seconds / before:.2f} times as long")
        )
        RESULTS.append(dict(group="length", end=end, seconds=seconds))
        before = seconds


def memory() -> None:
    print("memory of a reverse gradient, temporary arrays of the compiled program")
    for turns in (100, 1000, 10_000):
        steps = int(turns * 10)
        end = 2.0 * np.pi * turns / SPEED

        def value(n: jax.Array, end: float = end, steps: int = steps) -> jax.Array:
            scene = eqx.tree_at(lambda s: s.drive.speed, SCENE, n)
            motion = Motion(jv.vector_field(scene), START)
            solution = diffrax.diffeqsolve(
                motion.term,
                WrittenOut(),
                0.0,
                end,
                end / steps,
                motion.held(START),
                motion.args,
                max_steps=steps + 1,
                throw=False,
            )
            return solution.ys[1][-1]

        compiled = jax.jit(jax.grad(value)).lower(SCENE.drive.speed).compile()
        analysis = compiled.memory_analysis()
        size = 0 if analysis is None else analysis.temp_size_in_bytes
        seconds = best(lambda compiled=compiled: compiled(SCENE.drive.speed), 2)
        print(f"  {turns:6d} turns: {size / 2**20:8.3f} MiB, {1e3 * seconds:.1f} ms")
        RESULTS.append(dict(group="memory", turns=turns, bytes=size, seconds=seconds))


GROUPS = dict(single=single, ensemble=ensemble, gradient=gradient, designs=designs, length=growth_with_length, memory=memory)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=list(GROUPS), default=list(GROUPS))
    parser.add_argument("--json", help="write the figures there")
    parser.add_argument("--plain", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.plain:
        plain(float(options.plain[0]), float(options.plain[1]), np.asarray(json.loads(options.plain[2])))
        return
    load = os.getloadavg()[0]
    print(
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {load:.1f}; jax {jax.__version__}, diffrax {diffrax.__version__}"  # noqa: E501
    )
    for name in options.only:
        GROUPS[name]()
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(dict(cores=os.cpu_count(), load=load, jax=jax.__version__, rows=RESULTS), file, indent=2)


if __name__ == "__main__":
    main()
