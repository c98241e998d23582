"""Functional mock-up units against the equations in JAX, CVode against `simulate`, and a host without Python."""

import ctypes
import functools
import itertools
import os
import pathlib
import shutil
import subprocess
import tempfile
import zipfile
from types import SimpleNamespace

import fmpy
import fmpy.fmi2
import fmpy.fmi3
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from programs.golden import scenes, scenes_of_exciters, state_of
from scenes import BALLS, machines

import jaxvib as jv
from jaxvib.exchange import fmu as module
from jaxvib.exchange.c_code import write_program
from jaxvib.exchange.description import base_units
from jaxvib.exchange.model import state_signals
from jaxvib.machine.files import TEMPLATES
from jaxvib.ode.scalarize import scalar_program

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
OFF = jv.SwitchedOff(jv.DCMotor(120.0, stall_torque=8.0, inertia=0.2), at=0.4, bearing=0.01)
SPRING = dict(stiffness=(2e5, 4e5), damping=(2e3, 4e3))
SUPPORTS = [jv.support(at=(x, -0.2), **SPRING) for x in (-1.2, 1.2)]
MORE = {
    "motor that is switched off": jv.Scene(machines()["two_mass"], jv.balls(**BALLS), OFF),
    "body with loads and an unbalance": jv.Scene(
        jv.plane_body(mass=900.0, inertia=300.0, supports=SUPPORTS),
        exciters=[
            jv.Exciter(jv.balls(**BALLS), jv.ConstantSpeed(110.0), at=(-0.3, 0.4), direction=-1),
            jv.Exciter(drive=jv.DCMotor(90.0, stall_torque=40.0, inertia=0.5), unbalance=0.8, at=(0.3, 0.4)),
        ],
        effects=(jv.Gravity(),),
    ),
}
MORE["rotor on split supports"] = jv.Scene(
    jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0, stiffness_up=1.7e6, damping_up=900.0),
    jv.balls(count=2, mass=0.05, radius=0.08, drag=0.2),
    jv.ConstantSpeed(300.0),
)
SCENES = scenes() | scenes_of_exciters() | MORE
CHECKED = ["two masses", "stop", "imbalance and a motor", "rotor with stations", "torus, balls spin and slide"]
CHECKED += ["two exciters on platforms", "body with loads and an unbalance"]
"""Scenes that are checked by default; `make test-slow` checks all."""


def each_scene(*checked):
    return pytest.mark.parametrize(
        "name", [pytest.param(name, marks=[] if name in checked else [pytest.mark.slow]) for name in SCENES]
    )


@functools.cache
def home():
    return pathlib.Path(tempfile.mkdtemp())


@functools.cache
def exported(name, fmi="2.0", drive="scene"):
    """A unit, compiled once, and what fmpy reads of it."""
    scene = SCENES[name]
    unit = jv.export_fmu(scene, home() / f"{name} {fmi} {drive}.fmu", fmi=fmi, drive=drive)
    description = fmpy.read_model_description(str(unit.path))
    references = {each.name: each.valueReference for each in description.modelVariables}
    folder = fmpy.extract(str(unit.path), str(home() / f"{name} {fmi} {drive}"))
    return SimpleNamespace(scene=scene, unit=unit, path=str(unit.path), folder=folder, of=description, references=references)


@pytest.fixture
def opened():
    """A function that gives an instance in its initialization mode, with functions to get and set values by name."""
    machines = []

    def instance(found, kind="ModelExchange"):
        two = found.of.fmiVersion == "2.0"
        of = found.of.modelExchange if kind == "ModelExchange" else found.of.coSimulation
        classes = {("ModelExchange", True): fmpy.fmi2.FMU2Model, ("CoSimulation", True): fmpy.fmi2.FMU2Slave}
        classes |= {("ModelExchange", False): fmpy.fmi3.FMU3Model, ("CoSimulation", False): fmpy.fmi3.FMU3Slave}
        machine = classes[kind, two](
            guid=found.of.guid, unzipDirectory=found.folder, modelIdentifier=of.modelIdentifier, instanceName="machine"
        )
        machine.instantiate()
        machines.append(machine)
        if two:
            machine.setupExperiment(startTime=0.0)
        machine.enterInitializationMode()
        get = machine.getReal if two else machine.getFloat64
        machine.value = lambda *names: np.array(get([found.references[name] for name in names]))
        return machine

    yield instance
    for machine in machines:
        machine.freeInstance()


def of_state(scene, state):
    """The numbers of a state by name."""
    values = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(state)])
    return dict(zip([each.name for each in state_signals(scene, state)], values.tolist(), strict=True))


def put_all(machine, found, values):
    references = [found.references[name] for name in values]
    (machine.setReal if found.of.fmiVersion == "2.0" else machine.setFloat64)(references, list(values.values()))


def rates_of(found):
    """The names of the rates in the order of the states."""
    return [each.variable.name for each in found.of.derivatives]


@needs_compiler
@pytest.mark.parametrize("fmi", ["2.0", "3.0"])
@each_scene(*CHECKED)
def test_unit_is_valid_and_has_the_rates_of_the_field(name, fmi, opened):
    found = exported(name, fmi)
    assert validate_fmu(found.path) == [] and found.unit.has_binary
    state = state_of(found.scene)
    machine = opened(found)
    put_all(machine, found, of_state(found.scene, state))
    field = jv.vector_field(found.scene)
    expected = of_state(found.scene, field(jnp.asarray(0.0), state))
    given = machine.value(*rates_of(found))
    np.testing.assert_allclose(given, list(expected.values()), rtol=1e-10, atol=1e-10 * np.max(np.abs(given)))
    force = jv.foundation_force(found.scene, state)
    names = [f"foundation_force.{each}" for each in found.scene.machine.structure().foundation_directions]
    np.testing.assert_allclose(machine.value(*names), force, rtol=1e-12)


@needs_compiler
@each_scene("stop", "imbalance and a motor", *MORE)
def test_cvode_agrees_with_simulate_over_two_seconds(name):
    found = exported(name)
    # Balls that spin and slide are chaotic: as long as they agree. The published machine is dimensionless.
    end = {"torus, balls spin and slide": 0.5, "published": 80.0}.get(name, 2.0)
    outputs = [f"displacement.{each}" for each in found.scene.machine.structure().coordinates]
    outputs += [each for each in found.references if each.startswith("foundation_force")]
    got = fmpy.simulate_fmu(
        found.folder, stop_time=end, fmi_type="ModelExchange", output=outputs, output_interval=end / 3200,
        relative_tolerance=1e-12, model_description=found.of,
    )  # fmt: skip
    run = jv.simulate(found.scene, end, stepsize_controller=jv.Tolerance(1e-12), samples=401, estimate=False).trajectory
    expected = np.concatenate([run.state.displacement, run.foundation_force], axis=1).T
    rows = [np.argmin(np.abs(got["time"] - t)) for t in np.asarray(run.time)]
    assert np.max(np.abs(got["time"][rows] - run.time)) < 1e-12
    for name, values in zip(outputs, expected, strict=True):
        assert np.max(np.abs(got[name][rows] - values)) < 1e-6 * np.max(np.abs(values)), name


@needs_compiler
@pytest.mark.parametrize("fmi", ["2.0", "3.0"])
def test_model_exchange_agrees_in_both_versions(fmi):
    found = exported("stop", fmi)
    got = fmpy.simulate_fmu(
        found.folder, stop_time=1.0, fmi_type="ModelExchange", output=["displacement.y2"], relative_tolerance=1e-10,
        model_description=found.of, output_interval=0.01,
    )  # fmt: skip
    run = jv.simulate(found.scene, 1.0, stepsize_controller=jv.Tolerance(1e-11), samples=101, estimate=False).trajectory
    assert np.max(np.abs(run.state.displacement[:, 1])) > 0.01 and found.of.eventIndicators is not None
    assert got["displacement.y2"][-1] == pytest.approx(float(run.state.displacement[-1, 1]), abs=1e-7)


@needs_compiler
@pytest.mark.parametrize("fmi", ["2.0", "3.0"])
def test_co_simulation_converges_with_order_four(fmi):
    found = exported("two masses", fmi)
    exact = np.asarray(
        jv.simulate(found.scene, 1.0, stepsize_controller=jv.Tolerance(1e-12), samples=2).trajectory.state.displacement
    )

    def error(step):
        got = fmpy.simulate_fmu(
            found.folder, stop_time=1.0, fmi_type="CoSimulation", output=["displacement.y1", "displacement.y2"],
            output_interval=0.1, start_values={"co_simulation.step": step}, model_description=found.of,
        )  # fmt: skip
        return np.max(np.abs(np.array(list(got[-1])[1:]) - exact[-1]))

    errors = [error(0.1 / n) for n in (40, 80, 160)]
    assert all(14.0 < coarse / fine < 18.0 for coarse, fine in itertools.pairwise(errors)), errors


@needs_compiler
def test_default_step_of_co_simulation_is_accurate():
    found = exported("two masses")
    got = fmpy.simulate_fmu(
        found.folder, stop_time=2.0, fmi_type="CoSimulation", output=["displacement.y2"], output_interval=0.05,
        model_description=found.of,
    )  # fmt: skip
    run = jv.simulate(found.scene, 2.0, stepsize_controller=jv.Tolerance(1e-11), samples=2).trajectory
    assert float(got["displacement.y2"][-1]) == pytest.approx(float(run.state.displacement[-1, 1]), rel=1e-4)


@needs_compiler
def test_changed_parameters_equal_the_changed_scene_file(opened):
    found = exported("stop")
    changed = {"machine.stiffness[0]": 6.1e4, "loads.mass": 0.7, "effects.stop[0].gap": 0.004, "drive.speed": 110.0}
    text = jv.scene_to_toml(found.scene)
    pairs = (
        ("50000.0,\n", "61000.0,\n"),
        ("mass = 0.8", "mass = 0.7"),
        ("gap = 0.01", "gap = 0.004"),
        ("speed = 120.0", "speed = 110.0"),
    )
    for old, new in pairs:
        assert text.count(old) == 1
        text = text.replace(old, new)
    state = state_of(found.scene)
    expected = of_state(found.scene, jv.vector_field(jv.scene_from_toml(text))(jnp.asarray(0.0), state))
    machine = opened(found)
    machine.exitInitializationMode()
    before = machine.value(*rates_of(found))
    put_all(machine, found, {**of_state(found.scene, state), **changed})
    given = machine.value(*rates_of(found))
    np.testing.assert_allclose(given, list(expected.values()), rtol=1e-10, atol=1e-9)
    assert not np.allclose(before, given)


@needs_compiler
@pytest.mark.parametrize(
    "name", ["two masses", "imbalance and a motor", "stop", "rotor with stations", "body with loads and an unbalance"]
)
def test_directional_derivatives_equal_jvp(name, opened):
    found = exported(name)
    state, machine = state_of(found.scene), opened(found)
    put_all(machine, found, of_state(found.scene, state))
    rng = np.random.default_rng(1)
    direction = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), state)
    field = jv.vector_field(found.scene)
    expected = jax.jvp(lambda x: field(jnp.asarray(0.0), x), (state,), (direction,))[1]
    known = of_state(found.scene, direction)
    given = machine.getDirectionalDerivative(
        [found.references[each] for each in rates_of(found)], [found.references[each] for each in known], list(known.values())
    )
    expected = list(of_state(found.scene, expected).values())
    np.testing.assert_allclose(given, expected, rtol=1e-9, atol=1e-10 * np.max(np.abs(expected)))


@needs_compiler
@each_scene("stop", "imbalance", "imbalance and a motor", "rotor with stations", "body with loads and an unbalance")
def test_derivatives_by_parameters_equal_differences(name, opened):
    """Central differences of the rates over each parameter that may change to both sides, and over time."""
    found, low = exported(name), {each.name: each.min for each in exported(name).of.modelVariables}
    machine, names = opened(found), [*rates_of(found), *(n for n in found.references if n.startswith("foundation_force"))]
    put_all(machine, found, of_state(found.scene, state_of(found.scene)))
    parameters = [each.name for each in found.of.modelVariables if each.causality == "parameter"]

    def rates(known, value):
        machine.setTime(value) if known == "time" else put_all(machine, found, {known: value})
        return machine.value(*names)

    for known in ("time", *parameters):
        (value,) = machine.value(known)
        if value == 0.0 and low[known] is not None and float(low[known]) == 0.0:
            continue
        step = (2e-6 if known == "time" else 1e-5) * (abs(value) or 1.0)  # a supply of 314 rad/s: error (314 step)^2 / 6
        difference = (rates(known, value + step) - rates(known, value - step)) / (2.0 * step)
        size = np.max(np.abs(rates(known, value)))
        slope = machine.getDirectionalDerivative([found.references[n] for n in names], [found.references[known]], [1.0])
        np.testing.assert_allclose(slope, difference, rtol=1e-6, atol=1e-7 * size / (abs(value) or 1.0), err_msg=known)


@needs_compiler
def test_derivatives_by_inputs_equal_differences(opened):
    found = exported("imbalance and a motor")
    machine = opened(found)
    put_all(machine, found, of_state(found.scene, state_of(found.scene)))
    names, before = rates_of(found), None
    for known in ("force.y1", "force.y2", "rotor.torque"):
        before = machine.value(*names)
        slope = machine.getDirectionalDerivative([found.references[n] for n in names], [found.references[known]], [1.0])
        put_all(machine, found, {known: 1.0})
        np.testing.assert_allclose(machine.value(*names) - before, slope, atol=1e-9)
        assert np.max(np.abs(slope)) > 1e-4
        if known == "rotor.torque":  # imbalance and loads change the inertia by little
            assert slope[names.index("der(rotor.speed)")] == pytest.approx(1.0 / float(found.scene.drive.inertia), rel=0.1)
        put_all(machine, found, {known: 0.0})


@needs_compiler
def test_written_operations_equal_jax(tmp_path):
    """Operations that scenes use seldom, on both sides of their branches."""

    def operations(x, y):
        above, equal = x > 0.3, x == y
        kinds = [jnp.where(~above, x, y), jnp.where(above & ~equal, x, 2.0), jnp.where(above | equal, 1.0, x)]
        kinds += [jnp.clip(x, -0.5, y), jnp.maximum(x, y), jnp.minimum(x, y), jnp.sign(x), jnp.abs(x), jnp.round(3.0 * x)]
        kinds += [jnp.floor(x), jnp.ceil(x), jnp.fmod(x, 0.7), x**3, (x + 3.0) ** -2, (x + 3.0) ** y, jax.lax.rsqrt(x + 3.0)]
        kinds += [jnp.arctan2(x, y), jax.nn.sigmoid(x), jnp.expm1(x), jnp.log1p(x + 2.0), jnp.tanh(x), jnp.cbrt(x)]
        kinds += [above.astype(float) * 2.0, jax.lax.select_n((x > y).astype(int) + above, x, y, 5.0 * x)]
        return kinds

    point = jnp.asarray(0.5), jnp.asarray(0.25)
    names = [f"y[{k}]" for k in range(len(operations(*point)))]
    written = write_program(scalar_program(operations, *point), ["x[0]", "x[1]"], 0, names)
    body = "\n".join([*written.prepare, *written.body])
    (tmp_path / "f.c").write_text(f"#include <math.h>\nvoid f(const double *x, double *y) {{\n{body}\n}}\n")
    subprocess.run(["cc", "-std=c99", "-shared", "-fPIC", "-o", "f.so", "f.c", "-lm"], cwd=tmp_path, check=True)
    function = ctypes.CDLL(str(tmp_path / "f.so")).f
    for x, y in ((0.5, 0.25), (-1.7, 0.25), (0.4, 1.3), (0.2, 0.2), (1.5, -0.4)):
        given, found = (ctypes.c_double * 2)(x, y), (ctypes.c_double * len(names))()
        function(given, found)
        np.testing.assert_allclose(list(found), np.array(operations(jnp.asarray(x), jnp.asarray(y))), rtol=1e-14)


def test_events_are_comparisons_of_changing_real_numbers():
    """A comparison of parameters changes at no event between two communication points, nor does one of whole numbers."""

    def operations(parameter, x):
        return (
            jnp.maximum(parameter, 0.2) + jnp.clip(parameter, 0.0, 1.0),
            jnp.maximum((3.0 * x).astype(int), 1),
            jnp.maximum(x, 0.4),
        )

    program = scalar_program(operations, jnp.asarray(0.5), jnp.asarray(0.25))
    written = write_program(program, ["p", "x"], 1, ["y[0]", "y[1]", "y[2]"], has_events=True)
    assert written.branches == 1 and [line for line in written.body if "indicators" in line] == ["indicators[0] = x - 0.4;"]

    def pivot(x, y):
        return jnp.where(jnp.abs(x) > jnp.abs(y), x + y, x - y), jnp.where(jnp.abs(x) > y, x, y)

    program = scalar_program(pivot, jnp.asarray(0.5), jnp.asarray(0.25))
    written = write_program(program, ["x", "y"], 0, ["a", "b"], has_events=True)
    assert written.branches == 1  # two magnitudes select a pivot


@needs_compiler
def test_force_on_a_platform_enters_its_equation(opened):
    found = exported("two masses")
    machine = opened(found)
    before = machine.value("acceleration.y1", "acceleration.y2")
    put_all(machine, found, {"force.y1": 240.0})
    change = machine.value("acceleration.y1", "acceleration.y2") - before
    np.testing.assert_allclose(change, [240.0 / float(found.scene.machine.mass[0]), 0.0], rtol=1e-12)


@needs_compiler
def test_torque_input_replaces_a_motor_and_its_current(tmp_path):
    motor = jv.DCMotorElectrical("24 V", "0.6 ohm", 0.08, inertia=0.05, inductance="2 mH")
    scene = jv.Scene(machines()["one_mass"], exciters=[jv.Exciter(drive=motor, unbalance=1e-9)])
    unit = jv.export_fmu(scene, tmp_path / "m.fmu", drive="input")
    names = {each.name for each in fmpy.read_model_description(str(unit.path)).modelVariables}
    assert validate_fmu(str(unit.path)) == [] and {"rotor.angle", "rotor.speed", "rotor.torque"} <= names
    assert not any(name.startswith("motor.state") for name in names)


@needs_compiler
def test_rotor_of_a_motor_follows_the_torque_input_alone(opened):
    found = exported("imbalance and a motor", drive="input")
    assert validate_fmu(found.path) == []
    scene, state = found.scene, state_of(found.scene)
    motor = scene.drive
    machine = opened(found)
    torque = float(motor.torque(state.rotor[1]))
    put_all(machine, found, {**of_state(scene, state), "rotor.torque": torque})
    expected = of_state(scene, jv.vector_field(scene)(jnp.asarray(0.0), state))
    np.testing.assert_allclose(machine.value(*rates_of(found)), list(expected.values()), rtol=1e-10, atol=1e-10)


@needs_compiler
def test_speed_input_replaces_an_ideal_drive(opened):
    found = exported("imbalance", drive="input")
    assert validate_fmu(found.path) == []
    scene = jv.Scene(found.scene.machine, found.scene.loads, jv.SpinUp(120.0, 5.0), found.scene.all_effects)
    state, t = state_of(scene), jnp.asarray(1.7)
    drive = scene.drive
    machine = opened(found)
    values = {
        "rotor.angle": drive.angle_at(t),
        "rotor.speed": drive.speed_at(t),
        "rotor.acceleration": drive.acceleration_at(t),
    }
    put_all(machine, found, {**of_state(scene, state), **{name: float(value) for name, value in values.items()}})
    expected = [*of_state(scene, jv.vector_field(scene)(t, state)).values(), float(drive.speed_at(t))]
    np.testing.assert_allclose(machine.value(*rates_of(found)), expected, rtol=1e-10, atol=1e-10)


@needs_compiler
def test_inputs_of_each_exciter_reach_its_rotor(opened):
    """Inputs are anticlockwise, whatever the direction of the exciter."""
    found = exported("body with loads and an unbalance", drive="input")
    assert validate_fmu(found.path) == []
    first, second = found.scene.exciters
    drive = jv.SpinUp(110.0, 5.0)
    turned = jv.Exciter(first.loads, drive, at=(-0.3, 0.4), direction=-1)
    scene = jv.Scene(found.scene.machine, exciters=[turned, second], effects=found.scene.effects)
    state, t = state_of(scene), jnp.asarray(1.7)
    values = {"angle": drive.angle_at(t), "speed": drive.speed_at(t), "acceleration": drive.acceleration_at(t)}
    given = {f"exciters[0].rotor.{name}": -float(value) for name, value in values.items()}
    relative = float(state.exciters[1].rotor[1] - state.velocity[2])
    given["exciters[1].rotor.torque"] = float(second.drive.torque(relative))
    machine = opened(found)
    assert machine.value("exciters[0].rotor.speed")[0] == -110.0
    put_all(machine, found, {**of_state(scene, state), **given})
    expected = [*of_state(scene, jv.vector_field(scene)(t, state)).values(), -float(drive.speed_at(t))]
    np.testing.assert_allclose(machine.value(*rates_of(found)), expected, rtol=1e-10, atol=1e-9)


@needs_compiler
def test_forces_on_a_body_replace_the_forces_of_its_supports(opened):
    """A force -K q on a body at q = 0 accelerates everything as its displacement q does."""
    found = exported("body with loads and an unbalance")
    machine, q = opened(found), np.array([1e-3, -2e-3, 3e-3])
    state = of_state(found.scene, jv.initial_state(found.scene))
    force = -np.asarray(found.scene.machine.carrier().stiffness) @ q
    names = ["x", "y", "psi"]
    put_all(machine, found, {**state, **{f"force.{n}": f for n, f in zip(names, force, strict=True)}})
    forced = machine.value(*rates_of(found))
    put_all(
        machine, found, {f"force.{n}": 0.0 for n in names} | {f"displacement.{n}": x for n, x in zip(names, q, strict=True)}
    )
    displaced = machine.value(*rates_of(found))
    np.testing.assert_allclose(forced[3:], displaced[3:], rtol=1e-9, atol=1e-9)
    assert np.all(np.abs(forced[3:6]) > 0.1)


@needs_compiler
def test_changed_places_equal_the_changed_scene(opened):
    found = exported("body with loads and an unbalance")
    changed = {"exciters[1].at[0]": 0.5, "exciters[1].unbalance": 0.6, "machine.supports[0].at[0]": -0.9}
    first, second = found.scene.exciters
    moved = jv.Exciter(drive=second.drive, unbalance=0.6, at=(0.5, 0.4))
    body = jv.plane_body(mass=900.0, inertia=300.0, supports=[jv.support(at=(-0.9, -0.2), **SPRING), SUPPORTS[1]])
    scene = jv.Scene(body, exciters=[first, moved], effects=found.scene.effects)
    state, machine = state_of(found.scene), opened(found)
    expected = of_state(found.scene, jv.vector_field(scene)(jnp.asarray(0.0), state))
    machine.exitInitializationMode()
    put_all(machine, found, {**of_state(found.scene, state), **changed})
    np.testing.assert_allclose(machine.value(*rates_of(found)), list(expected.values()), rtol=1e-10, atol=1e-9)


@needs_compiler
@pytest.mark.parametrize("fmi", ["2.0", "3.0"])
def test_states_of_instances_are_saved_and_restored(fmi, opened):
    found = exported("two masses", fmi)
    machine = opened(found, "CoSimulation")
    machine.exitInitializationMode()
    kept = machine.getFMUState() if fmi == "3.0" else machine.getFMUstate()
    machine.doStep(currentCommunicationPoint=0.0, communicationStepSize=0.1)
    after = machine.value("displacement.y2", "rate.load1")
    (machine.setFMUState if fmi == "3.0" else machine.setFMUstate)(kept)
    machine.doStep(currentCommunicationPoint=0.0, communicationStepSize=0.1)
    assert np.array_equal(machine.value("displacement.y2", "rate.load1"), after) and after[0] != 0.0
    machine.reset()


@needs_compiler
@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"machine.mass[0]": -3.0}, "machine.mass[0] is -3; it must be greater than 0"),
        ({"loads.drag": -1.0}, "loads.drag is -1; it must be at least 0"),
        ({"displacement.y1": float("nan")}, "displacement.y1 is not finite; give a number"),
        ({"acceleration.y1": 1.0}, "the value of acceleration.y1 cannot be set"),
    ],
)
def test_wrong_values_raise_clear_errors(values, says, capfd, opened):
    found = exported("two masses")
    machine = opened(found)
    with pytest.raises(fmpy.fmi1.FMICallException):
        put_all(machine, found, values)
    assert says in capfd.readouterr().out
    assert np.all(np.isfinite(machine.value("machine.mass[0]", "displacement.y1")))


@needs_compiler
def test_state_that_is_not_finite_is_refused(capfd, opened):
    found = exported("two masses")
    machine = opened(found)
    put_all(machine, found, {"rate.load1": 1e200})
    with pytest.raises(fmpy.fmi1.FMICallException):
        machine.value("acceleration.y1")
    assert "is not finite at 0 s" in capfd.readouterr().out


@needs_compiler
@pytest.mark.skipif(os.name == "nt", reason="the host opens libraries by dlopen")
def test_host_without_python_steps_the_machine(tmp_path):
    found = exported("two masses")
    program = tmp_path / "host"
    source = pathlib.Path(__file__).with_name("host.c")
    assert len(source.read_text().splitlines()) <= 45
    subprocess.run(["cc", "-std=gnu99", "-o", program, source, "-ldl"], check=True)
    library = next(pathlib.Path(found.folder, "binaries").rglob("*.so"))
    names = ["displacement.y1", "displacement.y2", "foundation_force.up"]
    words = [program, library, found.of.guid, "1.0", "1000", *(str(found.references[name]) for name in names)]
    done = subprocess.run(words, capture_output=True, text=True, env={})
    run = jv.simulate(found.scene, 1.0, stepsize_controller=jv.Tolerance(1e-11), samples=2).trajectory
    expected = [*run.state.displacement[-1], run.foundation_force[-1, 0]]
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose([float(x) for x in done.stdout.split()], expected, rtol=1e-5)
    wrong = subprocess.run([program, library, "{0}", "1.0", "10"], capture_output=True, text=True, env={})
    assert wrong.returncode == 2 and "%s" in wrong.stderr


@needs_compiler
def test_same_scene_gives_the_same_bytes(tmp_path):
    scene = SCENES["one mass"]
    paths = [jv.export_fmu(scene, tmp_path / folder / "m.fmu").path for folder in ("a", "b") if not (tmp_path / folder).mkdir()]
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.parametrize("fmi", ["2.0", "3.0"])
@pytest.mark.parametrize("kind", TEMPLATES)
def test_templates_are_valid_units(kind, fmi, tmp_path):
    unit = jv.export_fmu(jv.scene_from_toml(TEMPLATES[kind]), tmp_path / kind, fmi=fmi, binary=False)
    assert validate_fmu(str(unit.path)) == [] and unit.path.name == f"{kind}.fmu"


def test_without_a_compiler_the_source_alone_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(module.shutil, "which", lambda name: None)
    unit = jv.export_fmu(SCENES["one mass"], tmp_path / "m.fmu")
    assert not unit.has_binary and unit.message.startswith("source only: a C compiler (CC, cc, gcc or clang) was not found")
    assert validate_fmu(str(unit.path)) == []
    assert zipfile.ZipFile(unit.path).namelist() == [
        "modelDescription.xml", "sources/fmi.h", "sources/fmi2.c", "sources/machine.h", "sources/model.h"
    ]  # fmt: skip


@needs_compiler
def test_failing_compiler_leaves_the_source_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_COMPILER_FLAGS", ("--no-such-option",))
    unit = jv.export_fmu(SCENES["one mass"], tmp_path / "m.fmu")
    assert not unit.has_binary and "failed (" in unit.message and "no-such-option" in unit.message
    assert "non-zero" not in unit.message  # the compiler's own words


def test_operation_without_a_rule_is_named():
    program = scalar_program(lambda x: jnp.floor(x) + jax.lax.erf(x), jnp.ones(()))
    assert write_program(program, ["x"], 0, ["y"]).body[1].endswith("= erf(x);")
    with pytest.raises(jv.InputError, match="needs the operation 'xor' of JAX, which cannot be written in C"):
        write_program(jax.make_jaxpr(lambda a: a ^ 1)(1), ["a"], 0, ["y"])


@pytest.mark.parametrize(
    ("name", "identifier"), [('1 ü&<">', "machine_1______"), ("häger", "h_ger"), ("x" * 200, "x" * 60), ("a.b\x01", "a_b_")]
)
def test_hostile_names_give_valid_units(name, identifier, tmp_path):
    unit = jv.export_fmu(SCENES["one mass"], tmp_path / f"{name}.fmu", binary=False)
    assert validate_fmu(str(unit.path)) == []
    assert fmpy.read_model_description(str(unit.path)).modelExchange.modelIdentifier == identifier


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(path="/none/m.fmu"), "path is '/none/m.fmu', and its folder does not exist; create it or name another one"),
        (dict(path="/proc/m.fmu"), "path is '/proc/m.fmu', which cannot be written"),
        (dict(path="a\0b"), "path is "),
        (dict(path=3), "path is 3; "),
        (dict(fmi="1.0"), "fmi is '1.0'; "),
        (dict(drive="wheel"), "drive is 'wheel'; "),
        (dict(start="spin_up"), "start is 'spin_up', which replaces the drive"),
        (dict(mode=3), "mode is 3; "),
    ],
)
def test_wrong_arguments_of_units_raise_clear_errors(change, says, tmp_path):
    arguments = {"path": tmp_path / "m.fmu", **change}
    with pytest.raises(jv.InputError) as error:
        jv.export_fmu(SCENES["one mass"], **arguments)
    assert str(error.value).startswith(says) and list(tmp_path.iterdir()) == []


def test_read_only_file_is_not_changed(tmp_path):
    path = tmp_path / "m.fmu"
    path.write_text("kept")
    path.chmod(0o444)
    with pytest.raises(jv.InputError, match="which is read-only; name another file"):
        jv.export_fmu(SCENES["one mass"], path)
    assert path.read_text() == "kept"


def test_every_unit_of_a_scene_has_base_units():
    assert base_units("N m s/rad") == {"kg": 1, "m": 2, "s": -1, "rad": -1} and base_units("m/s^2") == {"m": 1, "s": -2}
    assert base_units("1/s") == {"s": -1} and base_units("N/m^3") == {"kg": 1, "s": -2, "m": -2}


def test_steps_of_co_simulation_resolve_stiff_stops():
    scene = jv.Scene(machines()["one_mass"], jv.balls(**BALLS), jv.ConstantSpeed(60.0), effects=[jv.Stop(1e9, gap=2e-3)])
    rate = (1e9 / float(np.sum(scene.machine.mass))) ** 0.5
    assert module._max_step(scene) < 1.0 / (15.0 * rate)
