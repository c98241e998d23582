"""Messages about numbers that `equinox.tree_at` puts into a scene, and about implausible numbers."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plugins.effect import SealFriction
from scenes import BALLS, machines, scene

import jaxvib as jv
from jaxvib.machine import validation as module
from jaxvib.machine.files import SCREENS, TEMPLATES
from jaxvib.machine.validation import (
    implausible_numbers,
    lifting_torques,
    load_weight_notes,
    start_notes,
    validate_scene,
    weight_notes,
)
from jaxvib.show.moving import sketch_svg


def changed(where, value, s=None):
    return eqx.tree_at(where, scene() if s is None else s, value)


def rub(value):
    return changed(lambda s: s.all_effects[0].torque, value, scene(effects=(SealFriction(0.1, 0.1),)))


WRONG = {
    "a negative mass": (
        lambda: changed(lambda s: s.machine.mass, jnp.asarray([120.0, -95.0])),
        "machine.mass[1] is -95 kg; it must be greater than 0",
    ),
    "no number": (
        lambda: changed(lambda s: s.machine.damping, jnp.full(2, jnp.nan)),
        "scene.machine.damping is nan; it must be",
    ),
    "no speed": (lambda: changed(lambda s: s.drive.speed, 0.0), "drive.speed is 0 rad/s; it must be greater than 0"),
    "a text": (lambda: changed(lambda s: s.drive.speed, "50 rpm"), "scene.drive.speed is '50 rpm', which is not a number"),
    "another shape": (lambda: changed(lambda s: s.machine.mass, jnp.ones(3)), "machine.mass has 3 values; 2 are needed"),
    "a number for an array": (
        lambda: changed(lambda s: s.machine.link_stiffness, 2e5),
        "machine.link_stiffness is an array of shape (); the shape (1,) is needed",
    ),
    "an array for a number": (
        lambda: changed(lambda s: s.drive.speed, jnp.asarray([60.0])),
        "drive.speed is a list of 1 values",
    ),
    "heavy loads": (
        lambda: changed(lambda s: s.loads.mass, 1e18),
        "loads.mass gives 3e+18 kg for all loads on a machine of 215 kg",
    ),
    "weak drag": (
        lambda: changed(lambda s: s.loads.drag, 1e-300),
        "loads.drag changes a load's speed by the fraction 1.0e-302",
    ),
    "an effect": (
        lambda: changed(lambda s: s.all_effects[0].g, -9.81, scene(effects=(jv.Gravity(),))),
        "effects.gravity.g is -9.81 m/s^2; it must be at least 0",
    ),
    "an effect from outside": (lambda: rub(jnp.inf), "scene.effects[0].torque is inf; it must be finite"),
}
QUESTIONS = {
    "jam_modes": jv.jam_modes,
    "simulate": lambda s: jv.simulate(s, 1.0),
    "settle": jv.settle,
    "envelope": lambda s: jv.envelope(s, 1.0),
    "branches": jv.branches,
    "phase_jams": jv.phase_jams,
    "jam_orbit": lambda s: jv.jam_orbit(s, mode=3),
    "criterion": jv.criterion,
    "balanced_states": jv.balanced_states,
    "whirl": jv.whirl,
    "natural_frequencies": jv.natural_frequencies,
    "run_up_map": lambda s: jv.run_up_map(s, 1.0),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_number_is_named(case):
    make, says = WRONG[case]
    with pytest.raises(jv.InputError) as error:
        validate_scene(make())
    assert str(error.value).startswith(says), error.value


@pytest.mark.parametrize("question", QUESTIONS)
def test_every_question_looks(question):
    with pytest.raises(jv.InputError, match=r"machine\.mass\[1\] is -95 kg; it must be greater than 0"):
        QUESTIONS[question](WRONG["a negative mass"][0]())


def test_plain_numbers_are_numbers():
    for value in (130.0, 130, np.float64(130.0), np.asarray(130), jnp.asarray(130)):
        s = validate_scene(changed(lambda s: s.drive.speed, value))
        assert s.drive.speed.dtype == jnp.float64 and float(s.drive.speed) == 130.0
    # What needs no change is handed on as it is, a scene being differentiated too.
    s = scene()
    assert validate_scene(s) is s and validate_scene(s) is s
    plain, exact = (jv.jam_modes(changed(lambda s: s.drive.speed, x)).omega for x in (130.0, jnp.asarray(130.0)))
    np.testing.assert_array_equal(plain, exact)
    slope = jax.grad(lambda m: jv.natural_frequencies(changed(lambda s: (s.machine.mass, s.drive.speed), (m, 130.0)))[0])
    assert np.all(np.asarray(slope(s.machine.mass)) < 0.0)


def test_numbers_lost_by_rounding_are_refused():
    def made(**changes):
        return jv.Scene(machines()["two_mass"], jv.balls(**{**BALLS, **changes}), jv.ConstantSpeed(120.0))

    for changes, says in (
        (dict(mass=1e18), r"loads may have 1e-15 to 1e\+15 times the machine's mass"),
        (dict(mass=1e-18), r"loads\.mass gives 3e-18 kg for all loads on a machine of 215 kg"),
        (dict(drag=1e-300), r"give 0, or at least 1e-13 N s/m"),
    ):
        with pytest.raises(jv.InputError, match=says):
            made(**changes)
    assert made(drag=0.0).loads.count == made(mass=1e-9, drag=1e-20).loads.count == 3
    assert made(mass=1e-9, drag=1e300).loads.count == 3  # what a share of a load's speed comes to is no number


def test_arrays_that_no_memory_holds_are_refused():
    s = scene()
    for ask, says in (
        (
            lambda: jv.simulate(s, 1.0, samples=10**11),
            r"samples is 100000000000, which needs .* GiB, more than half of the comp",
        ),
        (lambda: jv.branches(s, points=10**11), r"points is 100000000000, which needs"),
        (lambda: jv.phase_jams(s, starts=10**11), r"starts is 100000000000, which needs"),
        (lambda: jv.jam_orbit(s, mode=3, points=10**7), r"points is 10000000, which needs"),
        (lambda: jv.jam_orbit(s, mode=3, points=0), r"points is 0; it must be a whole number, at least 2"),
        (lambda: jv.balls(**{**BALLS, "count": 10**11}), r"loads\.count is 100000000000, which needs"),
    ):
        with pytest.raises(jv.InputError, match=says):
            ask()


def test_the_same_numbers_are_looked_at_once(monkeypatch):
    looked = []
    monkeypatch.setattr(module, "rebuild_part", lambda part, section: looked.append(section))
    module._require_valid.cache_clear()

    for _ in range(3):
        validate_scene(changed(lambda s: s.machine.mass, jnp.asarray([120.0, 90.0])))
    assert looked == ["machine", "loads", "drive"]
    validate_scene(changed(lambda s: s.machine.mass, jnp.asarray([120.0, 80.0])))
    assert len(looked) == 6


@pytest.mark.parametrize("stations", [[0.1], [0.1, 0.1], [np.nextafter(0.1, 1.0), 0.1]])
def test_equal_stations_in_a_list_are_one(stations):
    parts = dict(mass=20.0, transverse_inertia=0.5, polar_inertia=0.1, stiffness=1e5, damping=100.0, position=(0.2, -0.2))
    for count in (1, 4):
        loads = jv.balls(count=count, mass=0.1, radius=0.1, drag=0.5)
        listed, single = (jv.Scene(jv.rotor(stations=s, **parts), loads, jv.ConstantSpeed(60.0)) for s in (stations, 0.1))
        assert validate_scene(listed).mounting.at_one_point
        assert jv.scene_to_toml(listed) == jv.scene_to_toml(single)


@pytest.mark.parametrize(("angle", "moment"), [(0.0, 0.7), (np.pi, 0.1), (np.pi / 2, 0.5)])
def test_motor_lifts_the_sum_of_unbalance_and_imbalance(angle, moment):
    motor = jv.DCMotor(100.0, stall_torque=2.5, inertia=0.5)
    exciter = jv.Exciter(drive=motor, unbalance=0.4, effects=jv.StaticImbalance(0.3, angle=angle))
    table = jv.Scene(jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0), exciters=[exciter], effects=jv.Gravity())
    ((needed, start),) = lifting_torques(table)
    assert float(needed) == pytest.approx(0.724611 * moment * 9.81, rel=1e-6) and float(start) == 2.5


@pytest.mark.parametrize(
    ("drive", "start"),
    [
        (lambda motor: jv.Converter(motor, jv.SpinUp(100.0, 5.0)), None),
        (lambda motor: jv.Converter(motor, jv.RunUp(100.0, acceleration=20.0)), None),
        (lambda motor: jv.SwitchedOff(jv.Converter(motor, jv.SpinUp(100.0, 5.0)), at=9.0), None),
        (lambda motor: jv.Converter(motor, jv.ConstantSpeed(50.0)), 1.25),
        (lambda motor: jv.SpeedControl(jv.ConstantSpeed(100.0), 0.5, 2.0, torque_limit=8.0, inertia=0.02), None),
    ],
)
def test_torque_at_rest_that_rises_is_not_judged(drive, start):
    exciter = jv.Exciter(drive=drive(jv.DCMotor(100.0, stall_torque=2.5, inertia=0.5)), unbalance=0.4)
    scene = jv.Scene(jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0), exciters=[exciter], effects=jv.Gravity())
    (torques,) = lifting_torques(scene)
    assert (torques is None) if start is None else float(torques[1]) == start
    assert bool(start_notes(scene)) == (start is not None)


@pytest.mark.parametrize(("speed", "count"), [(1500.0, 1), ("11000 rpm", 0), ("400 Hz", 0), (300.0, 0)])
def test_only_plain_speeds_are_noted(speed, count):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(speed))
    assert len(implausible_numbers(scene)) == count


@pytest.mark.parametrize(
    ("speed", "shown", "meant"), [("1.450 1/min", "1.45", "1450"), ("0.975 rpm", "0.975", "975"), ("0.16 rad/s", "", "")]
)
def test_speeds_with_a_point_between_thousands_are_noted(speed, shown, meant):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    notes = implausible_numbers(jv.Scene(machine, exciters=[jv.Exciter(unbalance=0.05, drive=jv.ConstantSpeed(speed))]))
    says = f"drive.speed is {shown} rpm; a point separates decimals: did you mean '{meant} rpm'?"
    assert notes == [says] * bool(meant)


def test_a_stiffness_far_below_the_others_is_noted():
    says = "but another one is {} N/m; a plain number is in N/m: did you mean '{} N/mm'?"
    feeder = SCREENS["feeder"].replace('["80 N/mm", "126 N/mm"]', '["80 N/mm", 126]', 1)
    assert implausible_numbers(jv.scene_from_toml(feeder)) == [
        "machine.supports[0].stiffness[1] is 126 N/m, " + says.format(126000, 126)
    ]
    two = TEMPLATES["two_mass"].replace("[5.0e4, 5.0e4]", "[5.0e4, 40.0]")
    assert implausible_numbers(jv.scene_from_toml(two)) == ["machine.stiffness[1] is 40 N/m, " + says.format(50000, 40)]
    assert implausible_numbers(jv.scene_from_toml(two.replace("40.0]", "0.0]"))) == []


def test_a_damping_without_its_percent_sign_is_noted():
    says = "machine.link_damping is 2 N s/m, {} % of the critical damping; a plain number is in N s/m: did you mean '2 %'?"
    two = TEMPLATES["two_mass"].replace("link_damping = 60.0", 'link_damping = "2"')
    (note,) = implausible_numbers(jv.scene_from_toml(two))
    assert note == says.format(note.split()[5])
    assert implausible_numbers(jv.scene_from_toml(two.replace('"2"', '"2 %"'))) == []


def test_implausible_bodies_in_a_plane_are_noted():
    wrong = SCREENS["linear_screen"].replace("2600.0", "450e3").replace("[0.46, 0.81]", "[460, 810]")
    notes = implausible_numbers(jv.scene_from_toml(wrong.replace("280 N/mm", "280 N/m").replace("460 N/mm", "460 N/m")))
    assert notes == [
        "exciters[0].at is 931.5 m from the centre of mass, the supports at most 1.628 m; a plain number is in m: "
        "did you mean '810 mm'?",
        "machine.mass is 450 t; a plain number is in kg: did you mean '450 kg'?",
        "machine.supports.stiffness is so small that the machine sags by 2.98 m; a plain number is in N/m: "
        "did you mean '460 N/mm'?",
    ]
    heavy = SCREENS["feeder"].replace("mass = 400.0", "mass = 400e3")
    assert implausible_numbers(jv.scene_from_toml(heavy)) == [
        "exciters.unbalance is so small that it moves the machine by 2.03 µm; a plain number is in kg m, a plain force in N: "
        "did you mean 'kg m' or 'kN'?",
        "machine.mass is 400 t; a plain number is in kg: did you mean '400 kg'?",
    ]
    motor = 'kind = "name_plate_motor"\npower = 1.1\nrated_speed = "930 rpm"\nbreakdown_ratio = 2.6\ninertia = 0.6\n'
    head, _, tail = SCREENS["linear_screen"].partition('kind = "induction_motor"')
    (note,) = implausible_numbers(jv.scene_from_toml(head + motor + tail[tail.index("[[exciters]]") :]))
    assert note == ("exciters[0].drive.power is 1.1 W for a machine of 2600 kg; a plain number is in W: did you mean '1.1 kW'?")
    motor = jv.NamePlateMotor(power=1.5, rated_speed="1440 rpm", breakdown_ratio=2.5, inertia=0.02)
    table = jv.Scene(
        jv.one_mass(mass=60.0, stiffness=2.5e5, damping=1200.0), exciters=[jv.Exciter(unbalance=0.05, drive=motor)]
    )
    assert "drive.power is 1.5 W for a machine of 60 kg" in implausible_numbers(table)[0]
    turned = SCREENS["linear_screen"].replace('# angle = "0 deg"', "angle = 15.0     #", 1)
    (note,) = implausible_numbers(jv.scene_from_toml(turned))
    assert note == "machine.supports[0].angle is 15 rad; a plain number is in rad: did you mean '15 deg'?"


@pytest.mark.parametrize(
    ("frequency", "meant"), [(60, "60 Hz"), (50.2, "50.2 Hz"), ("50 Hz", ""), ("9.55 Hz", ""), (51.0, ""), (314.16, "")]
)
@pytest.mark.parametrize("driven", [lambda motor: motor, lambda motor: jv.BeltDrive(motor, ratio=1.5, shaft_inertia=0.1)])
def test_a_supply_frequency_in_hertz_is_noted(frequency, meant, driven):
    data = {"stator_resistance": 1.0, "rotor_resistance": 0.8, "stator_leakage": 3e-3, "rotor_leakage": 3e-3}
    motor = jv.InductionMotorCircuit(400.0, frequency, 2, **data, magnetizing_inductance=0.1, inertia=0.1)
    machine = jv.one_mass(mass=60.0, stiffness=2.5e5, damping=1200.0)
    notes = implausible_numbers(jv.Scene(machine, exciters=[jv.Exciter(unbalance=0.05, drive=driven(motor))]))
    name = "drive.motor.frequency" if hasattr(driven(motor), "motor") else "drive.frequency"
    says = f"{name} is {float(motor.frequency) / (2 * np.pi):.4g} Hz; a plain number is in rad/s: did you mean '{meant}'?"
    assert notes == [says] * bool(meant)


def test_unbalance_of_a_tenth_of_a_metre_is_noted():
    machine = jv.one_mass(mass=12.0, stiffness=1e5, damping=100.0)
    motor = jv.Exciter(drive=jv.ConstantSpeed(150.0), unbalance=1.2)
    (note,) = implausible_numbers(jv.Scene(machine, exciters=[motor]))
    assert note.startswith("machine.mass is 12 kg, and the unbalances would move the machine by 0.1 m;")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("[-1.6, -0.3]", "[-1600, -300]", r"machine.supports\[0\].at is 1600 m from the centre of mass; .*'1600 mm'\?$"),
        (
            "mass = 2600.0",
            "mass = 2.6",
            r"machine.mass is 2.6 kg, and the unbalances would move the machine by 3.51 m; .*'2.6 t'",
        ),
        ('force = "50 kN"', "force = 50", r"exciters.unbalance is so small that it moves the machine by 3.51 µm; .*'kN'\?$"),
    ],
)
def test_units_of_screens_that_were_confused_are_noted(old, new, says):
    (note,) = implausible_numbers(jv.scene_from_toml(SCREENS["linear_screen"].replace(old, new)))
    assert re.match(says, note)


def test_largest_effect_of_the_weight_on_a_speed_has_a_note():
    """S g / (I w^2) is 0.245 for the first exciter, 0.49 for the second one, and not defined for an ideal drive."""
    machine, motor = jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0), jv.DCMotor(100.0, stall_torque=25.0, inertia=0.4)
    drives = (motor, motor, jv.ConstantSpeed(10.0))
    exciters = [jv.Exciter(drive=drive, unbalance=s) for drive, s in zip(drives, (1.0, 2.0, 9.0), strict=True)]
    scene = jv.Scene(machine, exciters=exciters, effects=jv.Gravity(9.8))
    (note,) = weight_notes(scene, dict.fromkeys(range(3), 10.0))
    assert note.startswith("at 95.493 rpm the weight of an unbalance, which averaging omits, changes the speed by 49 %")
    assert "changes the speed by 24 % within" in weight_notes(scene, {0: 10.0, 2: 10.0})[0]
    assert "at 190.986 rpm" in weight_notes(scene, {0: 20.0, 1: 30.0})[0]  # shares 0.061 and 0.054
    assert weight_notes(scene, {0: 23.0, 1: 32.0}) == weight_notes(scene, {}) == weight_notes(scene, {2: 1.0}) == []
    assert weight_notes(jv.Scene(machine, exciters=exciters), {0: 10.0}) == []


def test_loads_that_their_drag_cannot_turn_over_have_a_note():
    """0.7246 m g R is 0.512 N m; b R^2 n reaches it at b = 0.485 N s/m. The share g/(R w^2) is 0.275 at 24.4 rad/s."""
    machine, drive = jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0), jv.ConstantSpeed("2800 rpm")

    def notes(drag, speed=None, gravity=True):
        loads = jv.pendulums(count=3, mass=1.2, radius=0.06, drag=drag)
        return load_weight_notes(jv.Scene(machine, loads, drive, (jv.Gravity(),) * gravity), speed)

    assert notes(0.49) == notes(0.49, 60.0) == notes(1e-3, 1.0, gravity=False) == []
    (stuck,) = notes([0.49, 0.49, 1e-3])
    assert stuck.startswith("loads at rest swing and do not turn over: the weight of a load needs 0.512 N m, its drag gives")
    (fast,) = notes(0.49, 24.4)
    assert "the weight of the loads, which averaging omits, changes the speed by 27 % within a turn" in fast


def test_equal_motors_that_cannot_start_have_one_note():
    weak, strong = (jv.DCMotor(100.0, stall_torque=torque, inertia=0.5) for torque in (2.5, 25.0))
    exciters = [jv.Exciter(drive=motor, unbalance=s) for motor, s in ((weak, 0.4), (strong, 0.4), (weak, 0.4), (weak, 0.5))]
    scene = jv.Scene(jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0), exciters=exciters, effects=jv.Gravity())
    text = "cannot start: the weight of its unbalance needs {} N m, its starting torque is 2.5 N m"
    fourth = f"the motor of exciter 4 {text.format(3.55)}"
    assert start_notes(scene) == [f"each motor of the exciters 1 and 3 {text.format(2.84)}", fourth]
    assert start_notes(scene, [1, 3]) == [fourth]
    group = jv.synchronous_regimes(scene, masses=[1, 3]).summary()
    assert group.count("cannot start") == 1 and fourth in group


@pytest.mark.parametrize(
    ("where", "value", "says"),
    [
        (lambda s: s.machine, None, "scene.machine is None; it must be a Machine, for example two_mass(...)"),
        (lambda s: s.machine.stiffness, None, "scene.machine.stiffness is None, which is not a number; give"),
        (
            lambda s: s.machine.stiffness,
            [4e4, [1.0]],
            "scene.machine.stiffness is [40000.0, [1.0]], which is not",
        ),
        (lambda s: s.exciters[0].drive, None, "scene.drive is None; it must be a Drive, for example ConstantSpeed"),
        (lambda s: s.exciters[0].drive, "dc", "scene.drive is 'dc'; it must be a Drive"),
        (lambda s: s.exciters[0].drive.speed, 1j, "scene.drive.speed is 1j, which is not a number; give"),
        (lambda s: s.exciters[0].loads, 1.0, "scene.loads is 1.0; it must be a Loads, for example balls(...)"),
        (lambda s: s.exciters, (), "scene.exciters is empty; at least one Exciter is needed"),
        (lambda s: s.exciters, None, "scene.exciters is None; it must be a list of values"),
        (lambda s: s.exciters, (1,), "scene.exciters[0] is 1; it must be an Exciter"),
        (lambda s: s.effects, None, "scene.effects is None; it must be a list of values"),
        (lambda s: s.effects, [], "scene.effects is []; it must be a tuple"),
        (lambda s: s.effects, (1,), "scene.effects[0] is 1; it must be an Effect"),
        (lambda s: s.loads.drag, 10**400, "scene.loads.drag is a whole number of 1329 bits, which is not a number; give"),
        (lambda s: s.loads.drag, range(10**9), "scene.loads.drag is range(0, 1000000000), which is not a number; give"),
    ],
)
def test_other_objects_in_place_of_parts_are_refused(where, value, says):
    scene = changed(where, value)
    for use in (validate_scene, jv.sketch, sketch_svg, jv.scene_to_toml, lambda scene: scene.replace(effects=())):
        with pytest.raises(jv.InputError, match=f"^{re.escape(says)}"):
            use(scene)
    assert "scene" in repr(scene).lower() and scene._repr_html_().startswith("<pre>")


@pytest.mark.parametrize(
    ("part", "where", "value", "says"),
    [
        ("machine", lambda machine: machine.mass, 1j, "machine.mass is 1j, which is not a number"),
        ("machine", lambda machine: machine.mass, 9.0, "machine has an array of a shape that its constructor does not allow"),
        ("loads", lambda loads: loads.drag, "1", "exciters[0].loads.drag is '1', which is not a number"),
        ("loads", lambda loads: loads.drag, np.ones(9), "loads.drag is an array of shape (9,); the shape"),
        ("drive", lambda drive: drive.speed, np.ones(2), "drive.speed is an array of shape (2,); a single number is needed"),
    ],
)
def test_parts_changed_by_tree_at_are_refused_in_a_scene(part, where, value, says):
    parts = {name: getattr(scene(), name) for name in ("machine", "loads", "drive")}
    parts[part] = eqx.tree_at(where, parts[part], value)
    with pytest.raises(jv.InputError, match=f"^{re.escape(says)}"):
        jv.Scene(**parts)
