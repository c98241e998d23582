"""Signals of the equations of a scene, their order and units, and inputs in place of drives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs.golden import scenes
from scenes import BALLS, machines, rates_at

import jaxvib as jv
from jaxvib.exchange.fmu import _variables
from jaxvib.exchange.model import Inputs, RotorInputs, States, equations_of, has_events, named_entries, without_motor_states


def names(signals):
    return [None if each is None else f"{each.name}, {each.unit}".rstrip(", ") for each in signals]


def body():
    spring = dict(stiffness=(2e5, 4e5), damping=(2e3, 4e3))
    supports = [jv.support(at=(x, -0.2), **spring) for x in (-1.2, 1.2)]
    motor = jv.DCMotorElectrical("24 V", "0.6 ohm", 0.08, inertia=0.05, inductance="2 mH")
    return jv.Scene(
        jv.plane_body(mass=900.0, inertia=300.0, supports=supports),
        exciters=[
            jv.Exciter(jv.balls(**{**BALLS, "count": 2}), jv.ConstantSpeed(110.0), at=(-0.3, 0.4), direction=-1),
            jv.Exciter(drive=motor, unbalance=1e-3, at=(0.3, 0.4)),
            jv.Exciter(drive=jv.RunUp(30.0, acceleration=2.0), unbalance=0.1, at=(0.0, 0.4)),
        ],
    )


MOVED = ["displacement.x, m", "displacement.y, m", "displacement.psi, rad"]
MOVED += ["velocity.x, m/s", "velocity.y, m/s", "velocity.psi, rad/s"]
LOADS = [f"exciters[0].{name}.load{k}, {unit}" for name, unit in (("angle", "rad"), ("rate", "rad/s")) for k in (1, 2)]
ROTOR = ["exciters[1].rotor.angle, rad", "exciters[1].rotor.speed, rad/s"]
FORCES = ["force.x, N", "force.y, N", "force.psi, N m"]
RATES = [None, None, None, "acceleration.x, m/s^2", "acceleration.y, m/s^2", "acceleration.psi, rad/s^2"]


def test_signals_of_the_drives_of_the_scene():
    scene = body()
    found = equations_of(scene, jv.initial_state(scene), "scene")
    assert names(found.state_signals) == [*MOVED, *LOADS, *ROTOR, "exciters[1].motor.state1"] and not found.by_input
    assert names(found.rate_signals) == [*RATES, *[None] * 7]
    assert names(found.input_signals) == [*FORCES, "exciters[1].rotor.torque, N m"]
    assert names(found.output_signals) == [
        *("foundation_force.across, N", "foundation_force.up, N"),
        *(f"exciters[{k}].rotor.{name}" for k in (0, 2) for name in ("angle, rad", "speed, rad/s")),
    ]
    assert found.states.rotor_angles == (None,) * 3
    assert found.inputs.force.tolist() == [0.0] * 3
    assert found.inputs.rotors == (RotorInputs(), RotorInputs(torque=0.0), RotorInputs())


def test_signals_of_inputs_in_place_of_drives():
    scene = body()
    found = equations_of(scene, jv.initial_state(scene), "input")
    turned = [f"exciters[{k}].rotor.angle, rad" for k in (0, 2)]
    assert names(found.state_signals) == [*MOVED, *LOADS, *ROTOR, *turned] and found.by_input
    assert names(found.rate_signals) == [*RATES, *[None] * 8]
    rotor = [[f"exciters[{k}].rotor.speed, rad/s", f"exciters[{k}].rotor.acceleration, rad/s^2"] for k in (0, 2)]
    assert names(found.input_signals) == [*FORCES, *rotor[0], "exciters[1].rotor.torque, N m", *rotor[1]]
    assert names(found.output_signals) == ["foundation_force.across, N", "foundation_force.up, N"]
    assert found.states.rotor_angles == (0.0, None, 0.0)
    assert found.inputs.rotors == (
        RotorInputs(speed=-110.0, acceleration=0.0),
        RotorInputs(torque=0.0),
        RotorInputs(speed=30.0, acceleration=0.0),
    )
    assert (
        len(jax.tree.leaves(without_motor_states(jv.initial_state(scene)))) == len(jax.tree.leaves(jv.initial_state(scene))) - 1
    )


def test_known_angles_and_forces_are_outputs():
    """Rotors turn in their own direction; a force on the body changes its acceleration by the inverse of its mass."""
    scene, t = body(), jnp.asarray(1.7)
    found = equations_of(scene, jv.initial_state(scene), "scene")
    state = jax.tree.map(lambda leaf: leaf + 0.01 * jnp.arange(1.0, leaf.size + 1.0).reshape(jnp.shape(leaf)), found.states)
    forced = Inputs(jnp.array([9.0, 0.0, 3.0]), found.inputs.rotors)
    rates, outputs = jax.jit(found.rates)(scene, t, state, found.inputs)
    more, _ = jax.jit(found.rates)(scene, t, state, forced)
    expected = rates_at(scene, t, state.machine)
    for one, other in zip(jax.tree.leaves(rates.machine), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(outputs.foundation_force, jv.foundation_force(scene, state.machine), rtol=1e-12)
    np.testing.assert_allclose(outputs.rotors[0], (-110.0 * 1.7, -110.0))
    np.testing.assert_allclose(outputs.rotors[2], (1.7**2, 3.4))
    assert outputs.rotors[1] is None and rates.rotor_angles == (None,) * 3
    change = np.asarray(more.machine.velocity - rates.machine.velocity)
    assert change[0] == pytest.approx(9.0 / 900.0, rel=0.05) and change[2] == pytest.approx(3.0 / 300.0, rel=0.3)


def test_unknown_force_on_the_foundation_is_no_output():
    machine = jv.from_matrices([[50.0]], [[30.0]], [[4e4]], places=[[0]])
    scene = jv.Scene(machine, jv.balls(**BALLS), jv.ConstantSpeed(60.0))
    found = equations_of(scene, jv.initial_state(scene), "scene")
    _, outputs = found.rates(scene, jnp.zeros(()), found.states, found.inputs)
    assert names(found.output_signals) == ["rotor.angle, rad", "rotor.speed, rad/s"] and outputs.foundation_force.shape == (0,)


def test_inputs_turn_the_rotors():
    """Anticlockwise inputs of the prescribed rotors, and a torque in place of the motor's own, equal the scene's drives."""
    scene, t = body(), jnp.asarray(1.7)
    found = equations_of(scene, jv.initial_state(scene), "input")
    state = jv.initial_state(scene)
    state = jax.tree.map(lambda leaf: leaf + 0.01 * jnp.arange(1.0, leaf.size + 1.0).reshape(jnp.shape(leaf)), state)
    current = float(state.exciters[1].rotor[2])
    rotors = (
        RotorInputs(speed=-110.0, acceleration=0.0),
        RotorInputs(torque=0.08 * current),
        RotorInputs(speed=3.4, acceleration=2.0),
    )
    states = States(without_motor_states(state), (jnp.asarray(-187.0), None, jnp.asarray(1.7**2)))
    rates, outputs = jax.jit(found.rates)(scene, t, states, Inputs(jnp.zeros(3), rotors))
    expected = without_motor_states(rates_at(scene, t, state))
    for one, other in zip(jax.tree.leaves(rates.machine), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-10)
    assert rates.rotor_angles == (-110.0, None, 3.4) and outputs.rotors == (None,) * 3


def test_parameters_of_matrices_have_the_order_of_their_entries():
    machine = jv.from_matrices(np.diag([2.0, 3.0]), 0.1 * np.eye(2), [[3e3, -1e3], [-1e3, 2e3]], places=[[0], [1]])
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(50.0), unbalance=0.1, at=2)])
    values = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(scene)])
    entries = named_entries(scene)
    np.testing.assert_array_equal([each.read(scene)[0] for each in entries], values)
    assert [each.name for each in entries if "stiffness" in each.name] == [f"machine.stiffness[{k}]" for k in range(4)]


def test_variables_of_a_unit_follow_the_signals():
    scene = jv.Scene(
        machines()["one_mass"], jv.balls(**{**BALLS, "count": 1}), jv.DCMotor(120.0, stall_torque=8.0, inertia=0.2)
    )
    equations = equations_of(scene, jv.initial_state(scene), "scene")
    found = _variables(scene, equations, 2, 0.25)
    states = ["displacement.y1", "velocity.y1", "angle.load1", "rate.load1", "rotor.angle", "rotor.speed"]
    rates = ["der(displacement.y1)", "acceleration.y1", *(f"der({name})" for name in states[2:])]
    parameters = [each.name for each in named_entries(scene)]
    assert [each.name for each in found] == [
        "time", *states, *rates, "force.y1", "rotor.torque", "foundation_force.up", *parameters, "co_simulation.step",
        "event_indicator[0]", "event_indicator[1]",
    ]  # fmt: skip
    by_name = {each.name: each for each in found}
    assert [by_name[name].unit for name in rates] == ["m/s", "m/s^2", "rad/s", "rad/s^2", "rad/s", "rad/s^2"]
    assert [by_name[name].state for name in rates] == [1, 2, 3, 4, 5, 6]
    assert [by_name[name].kind for name in rates] == ["local", "output", *["local"] * 4]
    assert all(float(by_name[name].nominal) > 0.0 and by_name[name].kind == "output" for name in states)
    assert by_name["rate.load1"].start == repr(float(jv.initial_state(scene).rate[0][0])) and by_name["force.y1"].start == "0.0"
    mass = by_name["machine.mass[0]"]
    assert (mass.kind, mass.unit, mass.low, mass.high) == ("parameter", "kg", "0.0", None)
    assert mass.start == repr(float(scene.machine.mass[0]))
    step = by_name["co_simulation.step"]
    assert (step.unit, step.start, step.low, step.about) == ("s", "0.25", "0.0", "longest step of co-simulation")
    assert [each.listed for each in found[-3:]] == [True, False, False]


def test_spin_and_slip_of_balls_in_a_torus_are_states():
    scene = scenes()["torus, balls spin and slide"]
    found = names(equations_of(scene, jv.initial_state(scene), "scene").state_signals)
    for name, unit in (("angle_1", "rad"), ("angle_2", "rad"), ("rate_1", "rad/s"), ("rate_2", "rad/s")):
        assert found.index(f"{name}.load2, {unit}") == found.index(f"{name}.load1, {unit}") + 1
    assert found[-6:-4] == ["drilling_spin.load1, rad/s", "drilling_spin.load2, rad/s"]
    assert found[-4:] == [f"slip_{k}.load{j}, m/s" for k in (1, 2) for j in (1, 2)]


def test_stops_and_switches_have_events():
    machine, balls = machines()["two_mass"], jv.balls(**BALLS)
    cases = {
        False: [jv.ConstantSpeed(110.0)],
        True: [jv.RunUp(30.0, acceleration=2.0), jv.SwitchedOff(jv.DCMotor(120.0, stall_torque=8.0, inertia=0.2), at=0.4)],
    }
    for expected, drives in cases.items():
        for drive in drives:
            assert has_events(jv.Scene(machine, balls, drive)) is expected
    assert has_events(jv.Scene(machine, balls, jv.ConstantSpeed(110.0), effects=(jv.Stop(1e6, gap=0.01, platform=2),)))
