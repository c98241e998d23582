"""Valid calls of all public functions, from which the trials of hostile input are derived."""

from __future__ import annotations

import contextlib
import functools
import pathlib
import tempfile
import typing
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
import optimize as op

with contextlib.suppress(jv.InputError):  # a test has begun to compute before
    jv.prepare_cpu()

FOLDER = pathlib.Path(tempfile.mkdtemp(prefix="hostile"))
"""Folder of the files that valid calls read and write."""


class Call(typing.NamedTuple):
    """A valid call: its name, the function, its arguments by name, and those that are left as they are."""

    name: str
    function: Callable[..., Any]
    arguments: dict[str, Any]
    skipped: tuple[str, ...] = ()


@functools.cache
def scene() -> jv.Scene:
    machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 3e4), damping=(40.0, 20.0), link_stiffness=2e5, link_damping=60.0)
    return jv.Scene(machine, jv.balls(count=2, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed(120.0))


@functools.cache
def rotor_scene() -> jv.Scene:
    machine = jv.rotor(
        mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, stiffness=(6e5, 5e5), damping=400.0, position=(0.165, -0.155)
    )
    return jv.Scene(machine, jv.balls(count=2, mass=0.05, radius=0.1, drag=0.5), jv.ConstantSpeed(300.0))


@functools.cache
def torus_scene() -> jv.Scene:
    loads = jv.torus_balls(count=2, mass=0.05, radius=0.1, tube=0.02, ball_radius=0.01, drag=0.5)
    return jv.Scene(jv.planar_rotor(mass=10.0, stiffness=1e5, damping=100.0), loads, jv.ConstantSpeed(200.0))


@functools.cache
def run() -> jv.Run:
    return jv.simulate(scene(), 2.0, start="jam", mode=3, samples=16, window_periods=4)


@functools.cache
def orbit() -> jv.Orbit:
    return jv.jam_orbit(scene(), mode=3)


@functools.cache
def record() -> jv.Record:
    t = np.arange(0.0, 12.0, 0.04)
    return jv.Record(t, 0.1 * np.exp(-0.02 * t) * np.cos(5.7 * t))


def pendulum() -> jv.BearingPendulum:
    return jv.BearingPendulum(mass=2.0, length=0.3, bearing=0.01)


def space() -> op.DesignSpace:
    return op.DesignSpace(scene(), free={"machine.stiffness[0]": (3e4, 8e4), "machine.stiffness[1]": (1e4, 6e4)})


def heavy(eps: float) -> jv.Scene:
    links = dict(natural=1 / 3, damping=0.01, link_natural=2 / 3, link_damping=0.01)
    return jv.Dimensionless("antiphase", **links | {"natural": [1 / 3, 1 / 3]}, rho=1.0, eps=eps, beta=1.0, speed=2.0).scene()


def make(value: Any) -> jv.Scene:
    return eqx.tree_at(lambda s: s.loads.drag, scene(), jnp.asarray(value))


def springs() -> list[Any]:
    return [jv.support(at=(x, 0.0), stiffness=(4e5, 4e5), damping=(2e3, 2e3)) for x in (-1.0, 1.0)]


@functools.cache
def screen() -> jv.Machine:
    return jv.plane_body(mass=2000.0, inertia=600.0, supports=springs())


@functools.cache
def screen_scene() -> jv.Scene:
    motor = jv.DCMotor("1000 rpm", stall_torque=300.0, inertia=0.5)
    placed = [jv.Exciter(drive=motor, unbalance=1.5, at=(x, 0.0), direction=d) for x, d in ((-0.3, 1), (0.3, -1))]
    return jv.Scene(screen(), exciters=placed)


def calls() -> Iterator[Callable[[], Call]]:
    """Every valid call, made when it is needed."""

    def call(name: str, of: Callable[[], Callable[..., Any]] | None = None, skip: tuple[str, ...] = (), /, **arguments: Any):
        def made() -> Call:
            function = of() if of else getattr(jv, name) if hasattr(jv, name) else getattr(op, name)
            return Call(name, function, {k: v() if isinstance(v, functools.partial) else v for k, v in arguments.items()}, skip)

        made.named = name  # pyright: ignore[reportFunctionMemberAccess]
        return made

    later = functools.partial
    s, state = later(scene), later(lambda: jv.initial_state(scene()))
    scene()  # made here first: under a transformation of JAX the cache would keep its tracers
    path = FOLDER / "file"
    force = later(lambda: op.foundation_force(mode=3))
    demand = later(lambda: (op.foundation_force(mode=3) < 1e5,))
    yield call("InputError", field="x", problem="is wrong")
    yield call("ComputationError", status="bad", message="is bad")
    yield call("prepare_cpu", devices=1)
    yield call("use_cache", folder=str(path), only_if_unset=True)
    # Parts of scenes
    yield call("one_mass", mass=50.0, stiffness=4e4, damping=30.0)
    two = dict(mass=(120.0, 95.0), stiffness=(5e4, 3e4), damping=(40.0, 20.0))
    yield call("two_mass", **two, link_stiffness=2e5, link_damping=60.0, exciter=2)
    three = dict(mass=(1.0, 2.0, 3.0), stiffness=(1e3, 2e3, 3e3), damping=(1.0, 1.0, 1.0))
    yield call("three_mass", **three, link_stiffness=(1e3, 1e3, 1e3), link_damping=(1.0, 1.0, 1.0), exciter=2)
    yield call("network", **two, links=[(1, 2)], link_stiffness=[2e5], link_damping=[60.0], exciter=2)
    shaft = dict(mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, stiffness=(6e5, 5e5), damping=400.0)
    terms = dict(stiffness_terms=None, damping_terms=None)
    yield call("rotor", **shaft, position=(0.165, -0.155), stations=0.0, **terms)
    yield call("planar_rotor", mass=37.0, stiffness=6e5, damping=400.0)
    numbers = dict(natural=(1 / 3, 1 / 3), damping=(0.01, 0.01), link_natural=2 / 3, link_damping=0.01, rho=1.0)
    form = dict(form="antiphase", **numbers, eps=1e-3, beta=1.0, speed=3.0, count=1)
    scales = dict(mass_scale=1.0, frequency_scale=1.0, radius=1.0, kappa=1.0)
    yield call("Dimensionless", **form, **scales)
    one = dict(omega=1.0, amplitude=(1e-3, 1e-3), force=1.0)
    yield call(
        "Dimensionless.convert_results",
        lambda: jv.Dimensionless(**form).convert_results,
        **{k: jnp.asarray(v) for k, v in one.items()},
    )
    yield call("support", at=(1.0, -0.2), stiffness=(4e5, 4e5), damping=(2e3, 2e3), angle=0.1)
    yield call("plane_body", mass=2000.0, inertia=600.0, supports=later(springs))
    loaded = dict(loads=later(lambda: scene().loads), drive=later(lambda: scene().drive))
    yield call("Exciter", **loaded, unbalance=0.5, unbalance_mass=None, at=2, body=0, direction=-1, effects=())
    yield call("Exciter", **loaded, unbalance=None, unbalance_mass=None, at=(0.1, 0.2), body=0, direction=1, effects=())
    yield call("unbalance", force="20 kN", at="1000 rpm")
    yield call("SwitchedOff", motor=later(lambda: screen_scene().exciters[0].drive), at=1.0, bearing=0.01)
    yield call("balls", count=2, mass=0.8, radius=0.12, drag=1.5, ball_radius=0.01)
    yield call("rollers", count=2, mass=0.8, radius=0.12, drag=1.5, ball_radius=0.01)
    yield call("pendulums", count=2, mass=0.8, radius=0.12, drag=1.5, inertia=0.01)
    yield call("torus_balls", count=2, mass=0.05, radius=0.1, tube=0.02, ball_radius=0.01, drag=0.5)
    yield call("ConstantSpeed", speed=120.0)
    yield call("SpinUp", speed=120.0, duration=2.0)
    yield call("RunUp", speed=120.0, acceleration=20.0)
    yield call("DCMotor", speed=120.0, stall_torque=2.0, inertia=0.1)
    yield call("InductionMotor", speed=120.0, breakdown_torque=2.0, breakdown_slip=0.1, inertia=0.1)
    yield call("NamePlateMotor", power="4 kW", rated_speed="1440 rpm", breakdown_ratio=2.8, inertia=0.02, frequency="50 Hz")
    yield call("DCMotorElectrical", voltage=24.0, resistance=0.6, torque_constant=0.08, inertia=0.1, inductance=0.002)
    circuit = dict(voltage=400.0, frequency="50 Hz", pole_pairs=2, stator_resistance=1.0, rotor_resistance=1.0)
    circuit |= dict(stator_leakage=0.005, rotor_leakage=0.005, magnetizing_inductance=0.15, inertia=0.02)
    yield call("InductionMotorCircuit", **circuit)
    yield call("InductionMotorElectrical", **circuit)
    yield call("TorqueTable", speeds=[0.0, 100.0, 160.0], torques=[10.0, 20.0, -4.0], inertia=0.1)
    yield call("SpeedProfile", times=[0.0, 2.0], speeds=[0.0, 120.0])
    motor, reference = later(lambda: jv.DCMotor(120.0, 2.0, 0.1)), later(lambda: jv.RunUp(120.0, 20.0))
    yield call("Converter", motor=motor, reference=reference)
    yield call("SpeedControl", reference=reference, gain=0.5, integral_gain=2.0, torque_limit=8.0, inertia=0.2)
    yield call("BeltDrive", motor=motor, ratio=1.6, shaft_inertia=0.2)
    yield call("Gravity", g=9.81, along="up")
    yield call("DryFriction", coefficient=0.1, diameter=0.01, reaction="exact", width=0.01)
    yield call("RollingFriction", coefficient=1e-4, direction="along", width=0.01)
    yield call("Sliding", coefficient=0.1, width=0.2)
    yield call("StaticImbalance", moment=0.01, angle=0.0)
    yield call("MomentImbalance", moment=0.01, angle=0.0)
    yield call("CubicSupport", stiffness=1e6, platform=1, position=None)
    yield call("Stop", stiffness=1e6, gap=0.01, damping=0.0, side="both", platform=1, position=None)
    yield call("FrictionSupport", force=50.0, width=0.01, platform=2, position=None, to=1)
    yield call("LoadContact", stiffness=1e6, damping=0.0, restitution=None)
    parts = {name: later(lambda name=name: getattr(scene(), name)) for name in ("machine", "loads", "drive")}
    yield call("Scene", **parts, effects=(jv.Gravity(),))
    yield call("Scene of exciters", lambda: jv.Scene, machine=later(screen), exciters=later(lambda: screen_scene().exciters))
    toml = later(lambda: jv.scene_to_toml(scene()))
    file = later(lambda: jv.save_scene(scene(), FOLDER / "scene.toml"))
    yield call("load_scene", path=file)
    yield call("save_scene", scene=s, path=path)
    yield call("scene_from_toml", text=toml)
    yield call("scene_to_toml", scene=s)
    # Equations
    yield call("vector_field", scene=s)
    yield call("initial_state", scene=s, start="rest", mode=None, angles=None, separation=0.0, throw=True)
    yield call("initial_state", scene=s, start="jam", mode=3, angles=(0.0, 1.0), separation=0.0, throw=False)
    yield call("with_spin", scene=s, state=state, rotation="rolling")
    yield call("natural_frequencies", scene=s)
    yield call("mode_shapes", scene=s)
    yield call("energy", scene=s, state=state, t=0.0)
    yield call("power", lambda: jv.power, scene=s, t=0.0, state=state)
    yield call("foundation_force", lambda: jv.foundation_force, scene=s, state=state)
    yield call("normal_force", scene=s, t=0.0, state=state)
    # Jams
    yield call("jam_modes", scene=s)
    yield call("branches", scene=s, exact=False, points=50, most=None, least=None, accuracy=None)
    yield call("branches", scene=s, exact=True, points=8, most=20.0, least=10.0, accuracy=1e-6)
    yield call("phase_jams", scene=s, starts=8, seed=0, near=None)
    yield call("jam_orbit", scene=s, mode=3, omega=None, near=None, accuracy=None, points=None, throw=True)
    yield call("stability_map", make=make, values=[1.0, 2.0], omega=(10.0, 15.0), points=8)
    ends = dict(between=(0.02, 0.05), omega=(0.36, 0.5))
    yield call("stability_onset", make=heavy, kind="torus", **ends, points=60, accuracy=0.9)
    pair = dict(speed=None, phases=(0.0, 3.1), accuracy=None, points=None, throw=True)
    yield call("synchronous_orbit", scene=later(screen_scene), regime=None, **pair)
    yield call("ellipse_of", amplitude=jnp.array([0.005, -0.005j]), speed=100.0, slope=0.0, remainder=0.0)
    # Balancing
    r = later(rotor_scene)
    yield call("criterion", scene=r)
    yield call("criterion_map", scene=r, speeds=[200.0, 300.0], mass=[0.05], drag=[0.5], steps=16)
    yield call("balanced_states", scene=r)
    yield call("whirl", scene=r, rotor_speed=(100.0, 200.0), loads="fixed")
    yield call("critical_speeds", scene=r, loads="fixed")
    # Motion
    motion = dict(
        start="rest", mode=None, separation=0.0, spin_up=None, save="all", samples=16, window_periods=4, estimate=False
    )
    more = dict(solver=None, stepsize_controller=None, adjoint=None, max_steps=None, progress_meter=None, throw=True)
    yield call("simulate", scene=s, until=0.5, **motion, **more)
    slow = dict(start="rest", mode=None, spin_up=None, save="all", samples=16, window_periods=4)
    fewer = {k: v for k, v in more.items() if k != "progress_meter"} | {"max_steps": 999}
    yield call("envelope", scene=s, until=0.5, **slow, **fewer)
    yield call("settle", scene=s, start="jam", mode=3, drift=0.05, periods=4, segments=2, stepsize_controller=None, throw=False)
    drags = later(lambda: jnp.asarray([1.0, 2.0]))
    fast = later(lambda: jv.EqualSteps(200))
    batch = dict(stepsize_controller=fast, estimate=False, batch=2, equations=jv.vector_field)
    yield call("ensemble", make=make, values=drags, until=0.2, **batch)
    ups = dict(drag=[1.0, 2.0], starts=2, seed=0, angles=None, stepsize_controller=fast, batch=4, max_steps=None)
    yield call("run_up_map", scene=s, until=0.2, **ups)
    yield call("growth", scene=s, until=1.0, start="jam", mode=3, segments=8)
    yield call("regime", scene=s, segment=later(lambda: run().window))
    yield call("Tolerance", tolerance=1e-8)
    yield call("Accuracy", error=1e-4)
    yield call("EqualSteps", number=200)
    for name, steps in (("Tolerance", "tolerance"), ("Accuracy", "error"), ("EqualSteps", "number")):
        kind = {"tolerance": 1e-8, "error": 1e-4, "number": 200}[steps]
        yield call(f"simulate by {name}", lambda name=name: _by_steps(name), value=kind)
    # Accuracy
    cost = dict(quantity="final_state", mode=None, until=0.2, tolerances=(1e-3,), solvers=("default",), repeats=1)
    yield call("work_precision", scene=s, **cost)
    yield call("compare_tiers", scene=s, factors=[1.0], mode=3)
    yield call("harmonic_convergence", scene=s, omega=[10.0], points=(4, 6))
    gradients = dict(free=["machine.mass"], routes=("forward",), implicit=None, tolerance=1e-5)
    yield call("check_gradients", scene=s, quantity=lambda x: jv.natural_frequencies(x)[0], **gradients)
    asked = dict(accuracy=0.1, mode=3, until=None, start=None, possible=(), tiers=False, repeats=0)
    yield call("audit", scene=s, **asked)
    # Bearing
    yield call("BearingPendulum", mass=2.0, length=0.3, inertia=0.0, bearing=0.01, g=9.81)
    p, rec = later(pendulum), later(record)
    given = dict(
        angle=0.1,
        rate=0.0,
        viscous=1e-3,
        dry=1e-3,
        air=None,
        torque=None,
        width=None,
        stepsize_controller=None,
        solver=None,
        adjoint=None,
    )
    yield call("swing", pendulum=p, time=np.linspace(0.0, 2.0, 20), **given, max_steps=9999, throw=True)
    t = np.arange(0.0, 2.0, 0.1)
    yield call("Record", time=t, angle=0.1 * np.cos(6.0 * t), name="record")
    csv = later(_csv)
    yield call("read_record", path=csv, columns=("time (s)", "angle (rad)"), angle_unit="rad")
    yield call("ten_periods", pendulum=p, record=rec, periods=4, instrument=0.0, turns=None)
    yield call("identify", subject=p, records=rec, dry=False, air=False, torque=False, instrument=0.0, throw=False)
    # Capture
    torus = dict(turns=2, starts=1, spread=1e-3, seed=0, resolution=None, rotation="rolling")
    fewer = dict(stepsize_controller=later(lambda: jv.EqualSteps(100)), equations=jv.vector_field)
    yield call("capture", scene=later(torus_scene), speeds=[-0.9, -0.5], **torus, **fewer)
    yield call("threshold_curve", make=lambda x: torus_scene(), values=[1.0], speeds=[-0.5], **torus, equations=jv.vector_field)
    # Figures, results
    yield call("sketch", scene=s, ax=None)
    animation = dict(scene=None, begin=1.9, end=1.94, seconds=0.1, fps=5, magnify=None, width=2.0)
    yield call("animate", motion=later(run), path=None, **animation)
    modes = later(lambda: jv.jam_modes(scene()))
    yield call("load", path=later(lambda: jv.jam_modes(scene()).save(FOLDER / "modes")))
    yield call("write_csv", result=later(run), axis="time", path=path)
    yield call("html_report", result=modes, path=path, title="t", scene=s, figures=())
    # Exchange
    unit = dict(fmi="2.0", start="rest", mode=None, drive="scene", binary=False)
    yield call("export_fmu", scene=s, path=path, **unit)
    yield call("export_fmu of a body", lambda: jv.export_fmu, scene=later(screen_scene), path=path, **unit | {"drive": "input"})
    yield call("state_space", scene=s, at="rest", rotor_speed=100.0)
    yield call("state_space of a jam", lambda: jv.state_space, scene=s, at=later(lambda: jv.jam_modes(scene()).select(3)))
    yield call("StateSpace.frequency_response", lambda: jv.state_space(scene()).frequency_response, omega=[10.0, 20.0])
    yield call("StateSpace.save", lambda: jv.state_space(scene()).save, path=path)
    lines = dict(quantity="displacement", frequencies=(1.0, 2.0, 3.0), rotor_speed=100.0)
    yield call("export_uff", source=s, path=path, **lines)
    yield call("read_uff", path=later(lambda: jv.export_uff(scene(), FOLDER / "machine.uff", frequencies=(1.0, 2.0, 3.0))))
    yield call("display_units", speed="rpm", si=False)
    # Methods of results
    yield call("Result.to_pandas", lambda: jv.branches(scene(), points=50).to_pandas, axis=None)
    yield call("Result.save", lambda: jv.jam_modes(scene()).save, path=path)
    yield call("Result.load", lambda: jv.JamModes.load, path=later(lambda: jv.jam_modes(scene()).save(FOLDER / "modes")))
    figure = dict(unit="Hz", ax=None)
    panels = dict(most=None, show=("speed",))
    yield call("Branches.plot", lambda: jv.branches(scene(), points=50).plot, **figure, **panels)
    yield call("ExactBranches.plot", lambda: exact().plot, **figure, **panels)
    yield call("JamModes.plot", lambda: jv.jam_modes(scene()).plot, **figure)
    yield call("JamModes.row", lambda: jv.jam_modes(scene()).row, mode=3, throw=False)
    yield call("JamModes.select", lambda: jv.jam_modes(scene()).select, mode=3, throw=False)
    yield call("Jam.plot", lambda: jv.jam_modes(scene()).select(3).plot, **figure)
    yield call("ModeShapes.plot", lambda: jv.mode_shapes(scene()).plot, **figure)
    yield call("Orbit.at", lambda: orbit().at, theta=1.0)
    yield call("Orbit.relative_amplitude", lambda: orbit().relative_amplitude, i=1, j=2)
    yield call("Orbit.plot", lambda: orbit().plot, ax=None)
    yield call("PhaseJams.select", lambda: phases().select, index=0)
    yield call("PhaseJams.follow", lambda: phases().follow, index=0, omega=later(lambda: phases().omega[:1]))
    yield call("PhaseJams.plot", lambda: phases().plot, **figure)
    yield call("PhaseJam.plot", lambda: phases().select(0).plot, ax=None)
    yield call("Run.plot", lambda: run().plot, **figure)
    yield call("Run.spectrum", lambda: run().spectrum, parts=1)
    yield call("Run.plot_path", lambda: jv.simulate(rotor_scene(), 0.1, samples=16).plot_path, ax=None)
    yield call("Spectrum.plot", lambda: run().spectrum().plot, show="displacement", coordinate=None, **figure)
    yield call("Envelope.plot", lambda: jv.envelope(scene(), 0.5, samples=16).plot, **figure)
    yield call("Regime.plot", lambda: run().regime.plot, ax=None)
    yield call("Whirl.plot", lambda: jv.whirl(rotor_scene(), (100.0, 200.0)).plot, at=None, **figure)
    yield call("Criterion.plot", lambda: jv.criterion(rotor_scene()).plot, **figure)
    yield call("Criterion.balances", lambda: jv.criterion(rotor_scene()).balances, speed=jnp.asarray(100.0))
    balanced = lambda: jv.balanced_states(rotor_scene())  # noqa: E731
    yield call("BalancedStates.stability", lambda: balanced().stability, arrangement=0, steps=16)
    yield call("BalancedStates.growth", lambda: balanced().growth, speeds=[200.0], arrangement=0, steps=16)
    spans = dict(low=200.0, high=300.0, arrangement=0, points=4, steps=16)
    yield call("BalancedStates.intervals", lambda: balanced().intervals, **spans)
    yield call("BalancedStates.plot", lambda: balanced().plot, ax=None)
    yield call("Record.between", lambda: record().between, start=1.0, stop=9.0)
    yield call("Cost.cheapest", lambda: cost_of().cheapest, error=1e-3)
    # Design
    mode = dict(mode=3)
    tier = dict(tier="leading")
    yield call("foundation_force of a jam", lambda: op.foundation_force, **mode, harmonic=None, **tier)
    yield call("phase", **mode, of=(1, 2), **tier)
    yield call("power of a jam", lambda: op.power, **mode, **tier)
    yield call("peak_force", until=1.0, spin_up=0.5)
    yield call("settling_time", until=1.0, spin_up=0.5, within=0.05, of=1)
    yield call("spring_cost", prices=[(1e4, 10.0), (1e5, 20.0)], unit="EUR")
    of_samples = dict(tolerances={"machine.stiffness": 0.05}, samples=4, seed=0)
    yield call("expected", quantity=force, **of_samples)
    yield call("worst", quantity=force, is_large_good=False, **of_samples)
    yield call("quantile", quantity=force, level=0.9, **of_samples)
    yield call("under", quantity=force, name="slow", changes={"drive.speed": "1200 rpm"})
    yield call("hold", quantity=force, value=10.0)
    yield call("largest", lambda: lambda first: op.largest(first), first=force)
    yield call("least", lambda: lambda first: op.least(first), first=force)
    yield call("Quantity", name="x", unit="N", function=lambda s: s.drive.speed, mode=None, of=None, parts=())
    for sign in ("+", "-", "*", "/", "<", ">", "**"):
        yield call(f"Quantity {sign}", lambda sign=sign: _operator(sign), other=2.0 if sign in "*/**" else "2 N")
    yield call("Quantity.at_tier", lambda: op.foundation_force(mode=3).at_tier, tier="exact")
    yield call("Quantity.named", lambda: op.foundation_force(mode=3).named, name="force")
    yield call("Quantity()", lambda: op.foundation_force(mode=3), scene=s, modes=modes)
    stiffness = {"machine.stiffness[0]": (3e4, 8e4)}
    ties = {"machine.stiffness[1]": ("machine.stiffness[0]", 0.5)}
    yield call("DesignSpace", scene=s, free=stiffness, hold=(), ties=ties, choices={"machine.mass[0]": [100.0, 120.0]})
    for name, value in (("free", (3e4, 8e4)), ("ties", ("machine.stiffness[0]", 0.5)), ("choices", [100.0, 120.0])):
        yield call(f"DesignSpace by {name}", lambda name=name: _space(name), value=value)
    for name in ("numbers", "at", "scene_of", "shares"):
        yield call(f"DesignSpace.{name}", lambda name=name: getattr(space(), name), **_vector(name))
    yield call("DesignSpace.where", lambda: space().where, scene=s)
    yield call("DesignSpace.parameters", lambda: space().parameters, scene=s)
    yield call("DesignSpace.within", lambda: space().within, low=np.asarray([3e4, 2e4]), high=np.asarray([5e4, 3e4]))
    yield call("load_design", path=later(_design))
    search = dict(starts=2, seed=0)
    yield call("pareto", space=later(space), first=force, second=later(op.total_mass), points=2, subject_to=demand, **search)
    ended = dict(
        iterations=2, polishing=0, rate=0.05, searcher="gradients", begin=None, verify=False, throw=False, progress=None
    )
    yield call("synthesize", space=later(space), objective=force, subject_to=demand, **search, **ended)
    yield from machine_calls(call)


@functools.cache
def twins() -> jv.Scene:
    springs = [jv.support(at=(x, 0.0), stiffness=(3e3, 3e3), damping=(150.0, 150.0)) for x in (-0.6, 0.6)]
    motor = jv.DCMotor(100.0, stall_torque=60.0, inertia=0.05)
    placed = [jv.Exciter(drive=motor, unbalance=0.4, at=(x, 0.0), direction=s) for x, s in ((-0.6, 1), (0.6, -1))]
    return jv.Scene(jv.plane_body(mass=300.0, inertia=75.0, supports=springs), exciters=placed)


@functools.cache
def regimes() -> jv.SynchronousRegimes:
    found = jv.synchronous_regimes(twins())
    assert isinstance(found, jv.SynchronousRegimes)
    return found


TIMES = np.arange(0.0, 4.0, 0.01)
SHAKER_DRIVE = jv.RunUp(60.0, acceleration=15.0)


def frame(name: str = "frame") -> jv.Channel:
    return jv.Channel(name, "acceleration", at=1, gain_error=0.0)


@functools.cache
def shaker() -> jv.Scene:
    exciters = [jv.Exciter(drive=SHAKER_DRIVE, unbalance=0.05)]
    return jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0), exciters=exciters)


@functools.cache
def measured() -> jv.MeasuredRun:
    return jv.MeasuredRun.from_arrays([frame()], TIMES, {"frame": 0.01 * np.random.default_rng(0).normal(size=TIMES.size)})


@functools.cache
def fit() -> jv.MachineFit:
    found = jv.identify(shaker(), measured(), unknown=["machine.stiffness", "machine.damping"], throw=False)
    assert isinstance(found, jv.MachineFit)
    return found


def _text(name: str, text: str) -> pathlib.Path:
    (FOLDER / name).write_text(text)
    return FOLDER / name


RECORDING = "# rate: 100 Hz\nframe (g),speed (rpm)\n" + "0.5,600\n0.4,601\n" * 20
SPRINGS = "part;rate (N/mm);length (mm)\nA1;12,5;80\nA2;20,0;80\n"


@functools.cache
def swept() -> pathlib.Path:
    jv.sweep(scene(), {"drive.speed": [100.0, 120.0]}, [op.jam_frequency(mode=3)], FOLDER / "sweep.zarr")
    return FOLDER / "sweep.zarr"


def machine_calls(call: Callable[..., Any]) -> Iterator[Callable[[], Call]]:
    """Valid calls of functions of machines with several exciters, of recorded runs, of sweeps and of quantities of designs."""
    later = functools.partial
    s, pair, jam = later(scene), later(twins), later(lambda: jv.jam_modes(scene()).select(3))
    yield call("ball_mass", ball_radius="20 mm", material="steel")
    oil = dict(ball_radius="20 mm", viscosity=0.1, density=870.0, mass=None, rolling_lever=None, friction=None, diameter=None)
    yield call("drag_of", cause="oil", radius=0.12, load_speed="780 rpm", rotor_speed="1500 rpm", **oil)
    yield call("body", mass=2000.0, inertia=600.0)
    yield call("plane_network", bodies=later(lambda: [jv.body(mass=2000.0, inertia=600.0)]), supports=later(springs))
    matrices = dict(mass=[[2.0, 0.0], [0.0, 1.0]], damping=[[2.0, -1.0], [-1.0, 1.0]], stiffness=[[2e3, -1e3], [-1e3, 1e3]])
    matrices |= dict(foundation=([[1.0, 0.0]], [[0.1, 0.0]]), gyroscopic=None)
    yield call("from_matrices", **matrices, places=[[0], [1]], reduce=2)
    start = later(lambda: jv.initial_state(screen_scene()))
    yield call("foundation_moment", scene=later(screen_scene), state=start, about=(0.1, 0.0))
    yield call("Scene.replace", lambda: scene().replace, drive=later(lambda: scene().drive))
    yield call("drag_limits", scene=s, phases=False)
    turns = dict(scene=later(screen_scene), phases=None, points=50, most=200.0)
    yield call("response", speeds=None, **turns)
    yield call("response at speeds", lambda: jv.response, speeds=[10.0, 20.0], **turns | {"phases": [0.0, 1.0], "most": None})
    showing = dict(unit="rpm", show=("amplitude",), ax=None)
    yield call("Response.plot", lambda: jv.response(screen_scene(), points=50).plot, **showing)
    yield call("synchronous_regimes", scene=pair, masses=(0, 1), near=None)
    near = later(lambda: (float(regimes().speed[0]), np.asarray(regimes().phases[0])))
    yield call("synchronous_regimes near one", lambda: jv.synchronous_regimes, scene=pair, masses=None, near=near)
    yield call("SynchronousRegimes.select", lambda: regimes().select, index=0)
    yield call("working_regime", scene=pair, throw=True)
    yield call("regime_partitions", scene=pair, stable=True)
    yield call("RegimePartitions.select", lambda: jv.regime_partitions(twins()).select, index=0)
    yield call("synchronization_limit", scene=pair, regime=later(lambda: regimes().select(0)), over="exciters[1].drive.speed")
    yield call("SynchronousOrbit.at", lambda: jv.synchronous_orbit(twins(), phases=(0.0, 3.1)).at, theta=1.0)
    yield call("run_up", scene=pair, until=4.0, least=False)
    yield call("conveying_speed", amplitude=jnp.array([0.002, -0.002j]), speed=100.0, slope=0.1)
    yield call("vibration_measures", scene=s, motion=jam, at=None, body=0, slope=0.0, layer=None)
    plane = dict(at=(0.1, 0.2), body=0, slope=0.1, layer=(0.05, 1.0, 1500.0))
    motion = later(lambda: regimes().select(0).vibration())
    yield call("vibration_measures of a body", lambda: jv.vibration_measures, scene=pair, motion=motion, **plane)
    yield call("vibration_zone", velocity="3 mm/s", machine="medium", supports="flexible", limits=(1e-3, 2e-3, 4e-3))
    yield call("Run.point", lambda: run().point, at=1, body=0, part="window")
    yield call("estimate_share", flags=np.asarray([True, False, True]))
    # Recorded runs
    sensor = dict(direction="up", unit="g", gain_error=0.01, delay=0.0, high_pass=0.5, range="50 g", per_turn=1)
    yield call("Channel", name="frame", kind="acceleration", at=1, **sensor)
    noise, change = {"frame": 0.1 * np.sin(TIMES)}, {"machine.mass[0]": "+10 kg"}
    of_arrays = dict(channels=[frame()], times=TIMES, values=noise, change=change, source="run")
    yield call("MeasuredRun.from_arrays", lambda: jv.MeasuredRun.from_arrays, **of_arrays)
    given = dict(channels=[frame()], timeseries=later(lambda: measured().to_sep005()), change=change, source="run")
    yield call("MeasuredRun.from_sep005", lambda: jv.MeasuredRun.from_sep005, **given)
    yield call("MeasuredRun.rate", lambda: measured().rate, name="frame")
    parts = dict(start=0.1, until=0.3, change=change, rate=None)
    yield call("read_run", path=later(_text, "run.csv", RECORDING), channels=[frame()], **parts)
    yield call("read_recording", path=later(_text, "run.csv", RECORDING), rate=None)
    yield call("csv_column", path=later(_text, "springs.csv", SPRINGS), unit="N/m", column="rate")
    planned: Any = dict(duration="4 s", channels=[frame()], rate=100.0, noise={"frame": 0.01}, change=change)
    yield call("PlannedRun", name="slow", drive=SHAKER_DRIVE, **planned)
    runs = later(lambda: [jv.PlannedRun("slow", SHAKER_DRIVE, **planned)])
    yield call("plan_runs", fit=later(fit), candidates=runs, limits=None)
    yield call("predict_run", fit=later(fit), run=later(measured))
    yield call("MachineFit.estimate", lambda: fit().estimate, name="machine.stiffness[0]")
    yield call("MachineFit.interval_of", lambda: fit().interval_of, quantity=lambda x: jv.natural_frequencies(x)[0])
    told = dict(unknown=["machine.stiffness"], known={"machine.mass": "50 kg +- 1 %"}, throw=False)
    yield call("identify a machine", lambda: jv.identify, subject=later(shaker), records=later(measured), **told)
    # Sweeps
    study = dict(axes={"drive.speed": [100.0, 120.0]}, measure=[op.jam_frequency(mode=3)], store=FOLDER / "new.zarr")
    kept = dict(tier=None, until=None, start="rest", mode=None, steps=None, samples=0, sampling="random", seed=0, chunk=2)
    yield call("sweep", scene=s, **study, **kept, workers=None, scheduler=None, timeout="30 s", report=None)
    yield call("open_sweep", store=later(swept))
    # Quantities of designs
    tier, point = dict(tier="leading"), dict(at=(0.1, 0.0), body=0, tier="leading")
    for names, given in (
        ("acceleration amplitude force_per_amplitude stroke velocity", dict(mode=3, of=1, **tier)),
        ("jam_frequency shaft_torque transmissibility", dict(mode=3, **tier)),
        ("amplitude_spread motion_spread", dict(points=((0.1, 0.0), (0.2, 0.0)), body=0, **tier)),
        ("force_per_throw roundness throw_angle throw_stroke", point),
        ("response_amplitude response_stroke", dict(at=1, body=0, speed=None, between=(10.0, 20.0))),
        ("response_force response_torque response_transmissibility", dict(speed=10.0, between=None)),
        ("fold_margin largest_multiplier", dict(mode=3)),
        ("support_load", dict(mode=3, of=1)),
        ("static_deflection", dict(of=1)),
        ("product total", dict(field="machine.mass")),
        ("throw_number", dict(slope=0.1, **point)),
        ("peak_displacement", dict(until=1.0, at=1, body=0, spin_up=0.5)),
    ):
        for name in names.split():
            yield call(name, **given)
    yield call("conveying speed of a design", lambda: op.conveying_speed, slope=0.1, **point)
    of_machines = dict(tolerances=["stiffness=2%"], samples=4, seed=0)
    yield call("tolerance_ranges", scene=s, quantities=later(lambda: [op.jam_frequency(mode=3)]), **of_machines)


@functools.cache
def exact() -> jv.ExactBranches:
    found = jv.branches(scene(), exact=True, points=8, most=20.0, least=10.0, accuracy=1e-6)
    assert isinstance(found, jv.ExactBranches)
    return found


@functools.cache
def phases() -> jv.PhaseJams:
    found = jv.phase_jams(scene(), starts=16)
    assert isinstance(found, jv.PhaseJams)
    return found


@functools.cache
def cost_of() -> jv.Cost:
    return jv.work_precision(scene(), "final_state", until=0.2, tolerances=(1e-3,), solvers=("default",), repeats=1)


def _by_steps(name: str) -> Callable[..., Any]:
    def simulate(value: float) -> jv.Run:
        return jv.simulate(scene(), 0.2, stepsize_controller=getattr(jv, name)(value), samples=16, max_steps=4096)

    return simulate


def _operator(sign: str) -> Callable[..., Any]:
    force = op.foundation_force(mode=3)
    signs: dict[str, Callable[[Any], Any]] = {
        "+": lambda other: force + other,
        "-": lambda other: force - other,
        "*": lambda other: force * other,
        "/": lambda other: force / other,
        "<": lambda other: force < other,
        ">": lambda other: force > other,
        "**": lambda other: force**other,
    }
    return lambda other: signs[sign](other)


def _space(name: str) -> Callable[..., Any]:
    free: dict[str, Any] = {"machine.stiffness[0]": (3e4, 8e4)}
    other = {"ties": "machine.stiffness[1]", "choices": "machine.mass[0]"}.get(name)

    def built(value: Any) -> op.DesignSpace:
        if other is None:
            return op.DesignSpace(scene(), free={"machine.stiffness[0]": value})
        return op.DesignSpace(scene(), free=free, **{name: {other: value}})

    return built


def _vector(name: str) -> dict[str, Any]:
    return (
        {"values": jnp.asarray([4e4, 3e4])}
        if name == "scene_of"
        else {"numbers" if name == "shares" else "z": jnp.asarray([0.5, 0.5])}
    )


def _csv() -> pathlib.Path:
    lines = [f"{a:.3f},{b:.6f}" for a, b in zip(record().time, record().angle, strict=True)]
    return _text("swing.csv", "time (s),angle (rad)\n" + "\n".join(lines))


def _design() -> pathlib.Path:
    jv.save_scene(scene(), FOLDER / "machine.toml")
    objective = '[objective]\nquantity = "foundation_force"\nmode = 3\n'
    text = f'scene = "machine.toml"\n[free]\n"machine.stiffness[0]" = [3e4, 8e4]\n{objective}'
    return _text("design.toml", text)
