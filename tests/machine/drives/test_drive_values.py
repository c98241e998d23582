"""Numbers of drives: units, bounds, labels; torques, speeds, angles, rates and jumps in closed form."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.drives.drive import Directed, kloss_torque
from jaxvib.machine.numbers import number_specs, read_numbers

POSITIVE, NOT_NEGATIVE = "greater than 0", "at least 0"
SPEED = ("rad/s", POSITIVE, "rotor speed", "", None)
INERTIA = ("kg m^2", POSITIVE, "moment of inertia of the rotor", "", None)
MOTOR = jv.InductionMotor(150.0, breakdown_torque=70.0, breakdown_slip=0.2, inertia=0.02)
WINDING = {
    "voltage": ("V", POSITIVE, "voltage between two lines of the supply", "", None),
    "frequency": ("rad/s", POSITIVE, "frequency of the supply", "", None),
    "stator_resistance": ("ohm", POSITIVE, "resistance of the stator", "", None),
    "rotor_resistance": ("ohm", POSITIVE, "resistance of the rotor", "", None),
    "stator_leakage": ("H", POSITIVE, "leakage inductance of the stator", "", None),
    "rotor_leakage": ("H", POSITIVE, "leakage inductance of the rotor", "", None),
    "magnetizing_inductance": ("H", POSITIVE, "magnetizing inductance", "", None),
    "inertia": INERTIA,
}
CIRCUIT = {"voltage": 220.0, "frequency": 377.0, "pole_pairs": 2, "stator_resistance": 0.4, "rotor_resistance": 0.8}
CIRCUIT |= {"stator_leakage": 2e-3, "rotor_leakage": 3e-3, "magnetizing_inductance": 0.07, "inertia": 0.09}
PARTS = {
    "constant_speed": (jv.ConstantSpeed, {"speed": 60.0}, {"speed": SPEED}),
    "spin_up": (
        jv.SpinUp,
        {"speed": 60.0, "duration": 4.0},
        {"speed": SPEED, "duration": ("s", POSITIVE, "duration of the spin-up", "", None)},
    ),
    "run_up": (
        jv.RunUp,
        {"speed": 60.0, "acceleration": 20.0},
        {"speed": SPEED, "acceleration": ("rad/s^2", POSITIVE, "acceleration of the run-up", "", None)},
    ),
    "dc_motor": (
        jv.DCMotor,
        {"speed": 60.0, "stall_torque": 2.0, "inertia": 0.1},
        {"speed": SPEED, "stall_torque": ("N m", POSITIVE, "stall torque of the motor", "", None), "inertia": INERTIA},
    ),
    "induction_motor": (
        jv.InductionMotor,
        {"speed": 60.0, "breakdown_torque": 2.0, "breakdown_slip": 0.3, "inertia": 0.1},
        {
            "speed": SPEED,
            "breakdown_torque": ("N m", POSITIVE, "breakdown torque of the motor", "", None),
            "breakdown_slip": ("", "greater than 0 and less than 1", "breakdown slip of the motor", "", None),
            "inertia": INERTIA,
        },
    ),
    "switched_off": (
        jv.SwitchedOff,
        {"motor": MOTOR, "at": 3.0, "bearing": 0.1},
        {
            "at": ("s", NOT_NEGATIVE, "time at which the motor is switched off", "", None),
            "bearing": ("N m s", NOT_NEGATIVE, "friction of the bearings", "", None),
        },
    ),
    "belt_drive": (
        jv.BeltDrive,
        {"motor": MOTOR, "ratio": 1.6, "shaft_inertia": 0.1},
        {
            "ratio": ("", POSITIVE, "speed of the motor divided by that of the shaft", "", None),
            "shaft_inertia": INERTIA,
        },
    ),
    "torque_table": (
        jv.TorqueTable,
        {"speeds": [0.0, 100.0], "torques": [10.0, -2.0], "inertia": 0.1},
        {
            "speeds": ("rad/s", NOT_NEGATIVE, "speed of the torque table", "point", None),
            "torques": ("N m", "", "torque of the torque table", "point", 10.0),
            "inertia": INERTIA,
        },
    ),
    "speed_profile": (
        jv.SpeedProfile,
        {"times": [0.0, 1.0], "speeds": [0.0, 50.0]},
        {
            "times": ("s", NOT_NEGATIVE, "time of the speed profile", "point", None),
            "speeds": ("rad/s", NOT_NEGATIVE, "speed of the speed profile", "point", None),
        },
    ),
    "speed_control": (
        jv.SpeedControl,
        {"reference": jv.ConstantSpeed(9.0), "gain": 1.0, "integral_gain": 2.0, "torque_limit": 3.0, "inertia": 0.1},
        {
            "gain": ("N m s", POSITIVE, "gain of the speed control", "", None),
            "integral_gain": ("N m", POSITIVE, "integral gain of the speed control", "", None),
            "torque_limit": ("N m", POSITIVE, "torque limit of the motor", "", None),
            "inertia": INERTIA,
        },
    ),
    "name_plate_motor": (
        jv.NamePlateMotor,
        {
            "power": 4e3,
            "rated_speed": 150.0,
            "breakdown_ratio": 2.8,
            "inertia": 0.02,
            "frequency": 314.0,
            "starting_ratio": 2.0,
        },
        {
            "power": ("W", POSITIVE, "rated power of the motor", "", None),
            "rated_speed": ("rad/s", POSITIVE, "rated speed of the motor", "", None),
            "breakdown_ratio": ("", "greater than 1", "breakdown torque divided by rated torque", "", 2.5),
            "inertia": INERTIA,
            "frequency": ("rad/s", POSITIVE, "frequency of the supply", "", None),
            "starting_ratio": ("", POSITIVE, "starting torque divided by rated torque", "", 2.2),
        },
    ),
    "dc_motor_electrical": (
        jv.DCMotorElectrical,
        {"voltage": 24.0, "resistance": 0.6, "torque_constant": 0.08, "inertia": 0.002, "inductance": 0.02},
        {
            "voltage": ("V", POSITIVE, "voltage of the supply", "", None),
            "resistance": ("ohm", POSITIVE, "resistance of the armature", "", None),
            "torque_constant": ("N m/A", POSITIVE, "torque constant of the motor", "", None),
            "inertia": INERTIA,
            "inductance": ("H", POSITIVE, "inductance of the armature", "", None),
        },
    ),
    "induction_motor_circuit": (jv.InductionMotorCircuit, CIRCUIT, WINDING),
    "induction_motor_electrical": (jv.InductionMotorElectrical, CIRCUIT, WINDING),
}


@pytest.mark.parametrize("kind", PARTS)
def test_each_number_has_its_place_unit_bounds_and_label(kind):
    part, given, expected = PARTS[kind]
    drive, specs = part(**given), number_specs(part)
    assert drive.kind == kind
    assert {name: (s.unit, s.bounds.words, s.words, s.each, s.typical) for name, s in specs.items()} == expected
    for name, value in given.items():
        if name in expected:
            np.testing.assert_array_equal(getattr(drive, name), value)
        else:
            assert getattr(drive, name) is value or getattr(drive, name) == value


def beside(bounds):
    """For each bound in these words: a value just beyond it, and one just within it."""
    for words in bounds.split(" and ") if bounds else ():
        kind, _, last = words.rpartition(" ")
        bound, inward = float(last), 1e-9 if kind in ("greater than", "at least") else -1e-9
        yield (bound, bound + inward) if kind in ("greater than", "less than") else (bound - inward, bound)


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, (_, _, expected) in PARTS.items() for name in expected])
def test_values_just_beyond_the_bounds_are_refused(kind, name):
    part, given, expected = PARTS[kind]
    unit, bounds = expected[name][:2]
    for beyond, within in beside(bounds):
        bad, good, place = ([beyond, 5.0], [within, 5.0], "[0]") if expected[name][3] else (beyond, within, "")
        with pytest.raises(jv.InputError) as error:
            part(**{**given, name: bad})
        assert str(error.value) == f"drive.{name}{place} is " + f"{beyond:g} {unit}".strip() + f"; it must be {bounds}"
        np.testing.assert_array_equal(read_numbers(part, "drive", **{name: good})[name], good)
    with pytest.raises(jv.InputError) as error:
        part(**{**given, name: ["5 lm", "6 lm"] if expected[name][3] else "5 lm"})
    assert error.value.field.startswith(f"drive.{name}")


REFUSED = {
    "one point": (
        lambda: jv.TorqueTable([5.0], [1.0], 0.1),
        "drive.speeds has 1 value; a list of at least 2 is needed",
    ),
    "list for times": (lambda: jv.SpeedProfile([0.0, 1.0], [1.0]), "drive.speeds has 1 value; 2 are needed, one for each of"),
    "three torques": (
        lambda: jv.TorqueTable([0.0, 5.0], [1.0, 2.0, -1.0], 0.1),
        "drive.torques has 3 values; 2 are needed, one for each of the speeds",
    ),
    "equal speeds": (
        lambda: jv.TorqueTable([0.0, 5.0, 5.0, 4.0], [1.0, 1.0, 1.0, -1.0], 0.1),
        "drive.speeds[2] is 5 after 5; list the speeds in ascending or descending order",
    ),
    "falling times": (
        lambda: jv.SpeedProfile([2.0, 1.0, 3.0], [1.0, 2.0, 3.0]),
        "drive.times[1] is 1 after 2; list the times in ascending order",
    ),
    "no torque at the start": (
        lambda: jv.TorqueTable([0.0, 5.0], [0.0, -1.0], 0.1),
        "drive.torques must begin with a positive",
    ),
    "tiny speed": (
        lambda: jv.NamePlateMotor(4e3, 5e-324, 2.8, 0.1),
        "drive.rated_speed is 4.9407e-323 rpm, which needs inf pole",
    ),
    "rise at the end": (lambda: jv.TorqueTable([0.0, 5.0, 9.0], [2.0, -2.0, 0.0], 0.1), "drive.torques rise at the end"),
    "torque at the end": (lambda: jv.TorqueTable([0.0, 5.0], [2.0, 1.0], 0.1), "drive.torques must begin with a positive"),
    "profile at rest": (lambda: jv.SpeedProfile([0.0, 1.0], [0.0, 0.0]), "drive.speeds are all 0; at least one must be"),
    "profile that ends": (lambda: jv.SpeedProfile([0.0, 1.0], [5.0, 0.0]).settled(), "drive.speeds end at 0, so there is no"),
    "rated at 3000 rpm": (
        lambda: jv.NamePlateMotor(4e3, "3000 rpm", 2.8, 0.02),
        "drive.rated_speed is 3000 rpm; it must be below 3000 rpm, the synchronous speed of one pole pair at 50 Hz",
    ),
    "rated at 750 rpm": (
        lambda: jv.NamePlateMotor(4e3, "750 rpm", 2.0, 0.02),
        "drive.rated_speed is 750 rpm, the synchronous speed of 4 pole pairs, at which a motor has no torque; give the speed "
        "at rated load, some percent below it, as '720 rpm'",
    ),
    "breakdown slip": (
        lambda: jv.NamePlateMotor(4e3, "1200 rpm", 3.0, 0.02),
        "drive.rated_speed is 1200 rpm, 20 % below the synchronous speed of 1500 rpm; with the breakdown_ratio 3 the breakdown "
        "slip is 1.17, and must be less than 1; give the speed at rated load",
    ),
    "plain rated speed": (
        lambda: jv.NamePlateMotor(4e3, 1440, 3.0, 0.02),
        "drive.rated_speed is 13751 rpm; it must be below 3000",
    ),
    "pole pairs": (
        lambda: jv.NamePlateMotor(4e3, "10 rpm", 3.0, 0.02),
        "drive.rated_speed is 10 rpm, which needs 299 pole pairs",
    ),
    "converter of a converter": (
        lambda: jv.Converter(jv.Converter(MOTOR, jv.ConstantSpeed(5.0)), jv.ConstantSpeed(5.0)),
        "drive.motor is converter(",
    ),
    "converter of a switched motor": (
        lambda: jv.Converter(jv.SwitchedOff(MOTOR), jv.ConstantSpeed(5.0)),
        "drive.motor is switched_off(",
    ),
    "converter of currents": (
        lambda: jv.Converter(jv.DCMotorElectrical(24.0, 0.6, 0.08, 0.002, 0.02), jv.ConstantSpeed(5.0)),
        "drive.motor is dc_motor_electrical(",
    ),
    "motor as a reference": (lambda: jv.Converter(MOTOR, MOTOR), "drive.reference is induction_motor("),
    "controlled by a motor": (lambda: jv.SpeedControl(MOTOR, 1.0, 1.0, 1.0, 0.1), "drive.reference is induction_motor("),
    "switched off twice": (lambda: jv.SwitchedOff(jv.SwitchedOff(MOTOR)), "drive.motor is switched_off("),
    "ideal drive off": (lambda: jv.SwitchedOff(jv.ConstantSpeed(5.0)), "drive.motor is constant_speed("),
    "belt of a switched motor": (lambda: jv.BeltDrive(jv.SwitchedOff(MOTOR), 2.0, 0.1), "drive.motor is switched_off("),
    "belt of a belt": (lambda: jv.BeltDrive(jv.BeltDrive(MOTOR, 2.0, 0.1), 2.0, 0.1), "drive.motor is belt_drive("),
    "belt of an ideal drive": (lambda: jv.BeltDrive(jv.ConstantSpeed(5.0), 2.0, 0.1), "drive.motor is constant_speed("),
    "half a pole pair": (lambda: jv.InductionMotorCircuit(**{**CIRCUIT, "pole_pairs": 1.5}), "drive.pole_pairs is 1.5"),
    "control without states": (
        lambda: jv.SpeedControl(jv.ConstantSpeed(9.0), 1.0, 1.0, 1.0, 0.1).torque_at(0.0, 5.0),
        "drive is a speed control, whose torque does not follow from the speed; use ConstantSpeed",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_drive_is_one_sentence(case):
    build, sentence = REFUSED[case]
    with pytest.raises(jv.InputError) as error:
        build()
    assert str(error.value).startswith(sentence), str(error.value)


def test_clockwise_drive_is_the_mirror_image():
    drive = jv.SwitchedOff(jv.DCMotorElectrical(24.0, 0.6, 0.08, 0.002, 0.02), at=3.0, bearing=0.01)
    mirrored = Directed(drive)
    rotor, states = (jnp.asarray(0.7), jnp.asarray(-50.0), jnp.asarray(2.0)), (jnp.asarray(2.0),)
    assert float(mirrored.rotor_angle(1.0, rotor)) == 0.7 and float(mirrored.rotor_speed(1.0, rotor)) == -50.0
    assert mirrored.rotor_acceleration(1.0) is None and mirrored.kind == "switched_off" and float(mirrored.speed) == 300.0
    assert [float(x) for x in mirrored.torque_and_inertia(1.0, -50.0, states)] == [-0.16, 0.002]
    assert [float(x) for x in mirrored.torque_and_inertia(4.0, -50.0, states)] == [0.5, 0.002]
    np.testing.assert_allclose(mirrored.state_rates(1.0, -50.0, states), [(24.0 - 1.2 - 4.0) / 0.02], rtol=1e-14)
    assert float(mirrored.state_units()[0]) == 40.0 and [float(t) for t in mirrored.jump_ts()] == [3.0]
    ideal = Directed(jv.RunUp(60.0, acceleration=20.0))
    assert [float(f(1.0, None)) for f in (ideal.rotor_angle, ideal.rotor_speed)] == [-10.0, -20.0]
    assert float(ideal.rotor_acceleration(1.0)) == -20.0 and ideal.torque_and_inertia(1.0, 5.0) is None
    assert [float(t) for t in ideal.jump_ts()] == [3.0] and ideal.state_units() == ()
    assert ideal.state_rates(1.0, 5.0, ()) == ()


def test_ideal_drives_settle_at_their_working_speed():
    constant = jv.ConstantSpeed(60.0)
    assert constant.settled() is constant and constant.constant and constant.ideal
    for drive in (jv.SpinUp(60.0, duration=4.0), jv.RunUp(60.0, acceleration=20.0), jv.SpeedProfile([0.0, 1.0], [70.0, 60.0])):
        settled = drive.settled()
        assert settled.kind == "constant_speed" and float(settled.speed) == 60.0
        assert drive.ideal and not drive.constant and drive.torque_and_inertia(0.0, 5.0) is None
    assert float(constant.acceleration_at(3.0)) == 0.0 and float(constant.angle_at(3.0)) == 180.0
    assert constant.jump_ts() == () == jv.SpinUp(60.0, duration=4.0).jump_ts()


@pytest.mark.parametrize(
    "drive",
    [
        jv.ConstantSpeed(60.0),
        jv.SpinUp(60.0, duration=4.0),
        jv.RunUp(60.0, acceleration=20.0),
        jv.SpeedProfile([0.0, 2.0, 6.0, 8.0], [0.0, 60.0, 60.0, 30.0]),
    ],
    ids=lambda drive: drive.kind,
)
def test_ideal_drives_accept_arrays_of_times(drive):
    for function in (drive.speed_at, drive.angle_at, drive.acceleration_at):
        for times in (np.array([1.0, 3.0, 7.0]), np.ones((2, 3))):  # as many times as segments
            np.testing.assert_allclose(function(times), np.vectorize(lambda t: float(function(t)))(times), rtol=1e-14)  # noqa: B023


def test_run_up_changes_at_its_end():
    drive = jv.RunUp(60.0, acceleration=20.0)
    assert [float(drive.acceleration_at(t)) for t in (0.0, 2.9, 3.0, 4.0)] == [20.0, 20.0, 0.0, 0.0]
    assert [float(drive.angle_at(t)) for t in (1.0, 3.0, 5.0)] == [10.0, 90.0, 210.0]
    assert [float(drive.rotor_speed(t, None)) for t in (1.0, 3.0, 5.0)] == [20.0, 60.0, 60.0]


def test_motor_that_is_switched_off_turns_with_its_friction():
    motor = jv.SpeedControl(jv.RunUp(60.0, acceleration=20.0), 0.5, 2.0, 8.0, 0.2)
    off = jv.SwitchedOff(motor, at=2.5, bearing=0.1)
    states = (jnp.asarray(1.0),)
    assert [round(float(off.torque_at(t, 30.0, states)), 12) for t in (1.0, 2.0, 2.5, 4.0)] == [-4.0, 6.0, -3.0, -3.0]
    assert [float(t) for t in off.jump_ts()] == [2.5, 3.0] and float(off.torque(30.0)) == -3.0
    assert (float(off.speed), float(off.inertia)) == (60.0, 0.2)
    assert [float(x) for x in off.torque_and_inertia(2.0, 30.0, states)] == [6.0, 0.2]
    np.testing.assert_allclose(off.state_rates(2.0, 30.0, states), [2.0 * 10.0], rtol=1e-14)
    assert float(off.state_units()[0]) == 8.0
    settled = off.settled()
    assert float(settled.at) == 0.0 and float(settled.bearing) == 0.1 and settled.motor.kind == "speed_control"
    assert jv.SwitchedOff(MOTOR).at == 0.0 and jv.SwitchedOff(MOTOR).bearing == 0.0


def test_converter_uses_the_reference_at_each_time():
    drive = jv.Converter(MOTOR, jv.RunUp(100.0, acceleration=50.0))
    for t, n in ((0.5, 25.0), (1.0, 50.0), (3.0, 100.0)):
        slip = (n - 20.0) / 150.0
        expected = 2.0 * 70.0 * slip * 0.2 / (slip**2 + 0.04)
        np.testing.assert_allclose(drive.torque_at(t, 20.0), expected, rtol=1e-13)
    np.testing.assert_allclose(drive.torque(20.0), expected, rtol=1e-13)
    assert [float(t) for t in drive.jump_ts()] == [2.0] and float(drive.speed) == 100.0 and float(drive.inertia) == 0.02
    settled = drive.settled()
    assert settled.reference.kind == "constant_speed" and float(settled.torque_at(0.0, 20.0)) == float(drive.torque(20.0))


def test_speed_control_is_limited_on_both_sides():
    drive = jv.SpeedControl(jv.RunUp(100.0, acceleration=50.0), gain=0.5, integral_gain=2.0, torque_limit=8.0, inertia=0.2)
    found = [(float(drive.torque_at(1.0, w, (z,))), float(drive.state_rates(1.0, w, (z,))[0])) for w, z in CONTROLLED]
    np.testing.assert_allclose(found, [(3.5, 10.0), (8.0, 2.0 * (40.0 - 13.0 / 0.5)), (-8.0, 2.0 * (-40.0 + 13.0 / 0.5))])
    assert float(drive.speed) == 100.0 and [float(t) for t in drive.jump_ts()] == [2.0]
    settled = drive.settled()
    assert settled.reference.kind == "constant_speed" and float(settled.speed) == 100.0 and float(settled.gain) == 0.5


CONTROLLED = [(45.0, jnp.asarray(1.0)), (10.0, jnp.asarray(1.0)), (90.0, jnp.asarray(-1.0))]
"""Speeds at the reference of 50 rad/s and integrals: no limit, upper limit, lower limit."""


def test_no_load_speed_is_the_last_fall_through_zero():
    table = jv.TorqueTable([0.0, 10.0, 20.0, 30.0, 40.0, 50.0], [5.0, -5.0, 10.0, 0.0, -1.0, -3.0], 0.1)
    assert float(table.speed) == 30.0 and float(table.torque(table.speed)) == 0.0
    again = jv.TorqueTable([0.0, 10.0, 20.0, 30.0], [5.0, -5.0, 10.0, -30.0], 0.1)
    np.testing.assert_allclose(again.speed, 22.5, rtol=1e-14)
    found = [float(again.torque(w)) for w in (2.5, 15.0, 27.5, 40.0)]
    np.testing.assert_allclose(found, [2.5, 2.5, -20.0, -70.0], rtol=1e-14)
    assert float(table.rotor_speed(0.0, (1.0, 2.0))) == 2.0 and float(table.rotor_angle(0.0, (1.0, 2.0))) == 1.0


def test_speed_profile_jumps_at_its_points():
    drive = jv.SpeedProfile([1.0, 2.0, 6.0, 8.0], [20.0, 100.0, 100.0, 60.0])
    times = (0.5, 1.0, 1.5, 2.0, 6.0, 7.0, 8.0, 9.0)
    assert [float(drive.acceleration_at(t)) for t in times] == [0.0, 80.0, 80.0, 0.0, -20.0, -20.0, 0.0, 0.0]
    assert [float(drive.speed_at(t)) for t in times] == [20.0, 20.0, 60.0, 100.0, 100.0, 80.0, 60.0, 60.0]
    assert [float(drive.angle_at(t)) for t in (0.5, 1.0, 2.0, 6.0, 8.0, 9.0)] == [10.0, 20.0, 80.0, 480.0, 640.0, 700.0]
    assert [float(t) for t in drive.jump_ts()] == [1.0, 2.0, 6.0, 8.0] and float(drive.speed) == 60.0
    stopped = jv.SpeedProfile([0.0, 1.0, 2.0], [30.0, 50.0, 0.0])
    assert float(stopped.speed) == 50.0


def test_name_plate_gives_the_number_of_pole_pairs():
    for rated, frequency, synchronous in ((1001, "50 Hz", 1500.0), (999, "50 Hz", 1000.0), (1740, "60 Hz", 1800.0)):
        motor = jv.NamePlateMotor(2e3, f"{rated} rpm", 1.1, 0.02, frequency)
        np.testing.assert_allclose(motor.speed, synchronous * np.pi / 30.0, rtol=1e-12)
        slip = 1.0 - motor.rated_speed / motor.speed
        np.testing.assert_allclose(motor.breakdown_slip, slip * (1.1 + np.sqrt(0.21)), rtol=1e-9)
        np.testing.assert_allclose(motor.torque(motor.rated_speed) * motor.rated_speed, 2e3, rtol=1e-9)
    assert float(jv.NamePlateMotor(2e3, 150.0, 2.0, 0.02).frequency) == pytest.approx(100.0 * np.pi)
    np.testing.assert_allclose(kloss_torque(np.array([-0.2, 0.1, 0.2, 0.8]), 5.0, 0.2), [-5.0, 4.0, 5.0, 40.0 / 17.0])


def test_motors_with_currents_state_their_magnitudes():
    direct = jv.DCMotorElectrical(24.0, 0.6, 0.08, 0.002, 0.02)
    assert [float(x) for x in direct.state_units()] == [40.0] and float(direct.speed) == pytest.approx(300.0)
    assert float(direct.torque(100.0)) == pytest.approx(0.08 * 16.0 / 0.6) == float(direct.torque_at(0.0, 100.0))
    assert float(direct.torque_at(0.0, 100.0, (jnp.asarray(3.0),))) == pytest.approx(0.24)
    np.testing.assert_allclose(direct.state_rates(0.0, 100.0, (3.0,)), [(24.0 - 1.8 - 8.0) / 0.02], rtol=1e-13)
    motor = jv.InductionMotorElectrical(**CIRCUIT)
    amplitude = 220.0 * np.sqrt(2.0 / 3.0)
    np.testing.assert_allclose(motor.state_units(), [amplitude / 377.0] * 4, rtol=1e-14)
    assert float(motor.speed) == 188.5 and float(motor.torque_at(0.0, 170.0)) == float(motor.torque(170.0))


def test_currents_and_rates_of_an_induction_motor():
    """Different leakages; the flux linkages are not those of a steady motion."""
    motor = jv.InductionMotorElectrical(**CIRCUIT)
    psi, t, speed = np.array([0.3 - 0.2j, 0.1 + 0.25j]), 0.002, 150.0
    current = np.linalg.solve(np.array([[0.072, 0.07], [0.07, 0.073]]), psi)
    states = tuple(jnp.asarray(x) for x in (psi[0].real, psi[0].imag, psi[1].real, psi[1].imag))
    pairs = np.asarray(motor.currents(states)).reshape(2, 2) @ np.array([1.0, 1j])
    np.testing.assert_allclose(pairs, current, rtol=1e-12)
    np.testing.assert_allclose(motor.torque_at(t, speed, states), 3.0 * np.imag(psi[0].conj() * current[0]), rtol=1e-12)
    stator = 220.0 * np.sqrt(2.0 / 3.0) * np.exp(377.0j * t) - 0.4 * current[0]
    rates = np.asarray(motor.state_rates(jnp.asarray(t), jnp.asarray(speed), states)).reshape(2, 2) @ np.array([1.0, 1j])
    np.testing.assert_allclose(rates, [stator, 2j * speed * psi[1] - 0.8 * current[1]], rtol=1e-12)


@pytest.mark.parametrize("speed", [-50.0, 0.0, 100.0, 187.0, 200.0])
def test_steady_torque_is_that_of_the_equivalent_circuit(speed):
    motor = jv.InductionMotorCircuit(**CIRCUIT)
    slip = 377.0 - 2.0 * speed
    matrix = np.array([[0.4 + 377.0j * 0.072, 377.0j * 0.07], [1j * slip * 0.07, 0.8 + 1j * slip * 0.073]])
    stator, rotor = np.linalg.solve(matrix, [220.0 * np.sqrt(2.0 / 3.0), 0.0])
    np.testing.assert_allclose(motor.torque(speed), 3.0 * 0.07 * np.imag(rotor.conj() * stator), rtol=1e-12)


def test_belt_divides_speeds_and_multiplies_torques():
    """Kloss's formula at the shaft of a motor of 7.5 kW and 1450 rpm, whose belt turns the shaft at 900 rpm."""
    motor = jv.NamePlateMotor("7.5 kW", "1450 rpm", breakdown_ratio=2.6, inertia=0.045)
    drive = jv.BeltDrive(motor, ratio=1450.0 / 900.0, shaft_inertia="1 kg m^2")
    rpm = np.pi / 30.0
    assert float(drive.speed) == pytest.approx(1500.0 * 900.0 / 1450.0 * rpm, rel=1e-14) == float(drive.largest_speed)
    assert float(drive.torque(900.0 * rpm)) == pytest.approx(7500.0 / (900.0 * rpm), rel=1e-12)
    breakdown = 50.0 / 1500.0 * (2.6 + np.sqrt(2.6**2 - 1.0))
    at_breakdown = (1.0 - breakdown) * 1500.0 * 900.0 / 1450.0 * rpm
    assert float(drive.torque(at_breakdown)) == pytest.approx(2.6 * 7500.0 / (900.0 * rpm), rel=1e-12)
    torque, inertia = drive.torque_and_inertia(0.0, 900.0 * rpm)
    assert float(inertia) == pytest.approx(1.0 + 0.045 * (1450.0 / 900.0) ** 2, rel=1e-14)
    assert float(torque) == pytest.approx(79.577472, rel=1e-7)
    assert float(drive.starting_torque()) == float(drive.torque(0.0))


def test_belt_passes_time_and_states_of_its_motor():
    speed = jnp.asarray(30.0)  # of the shaft; that of the motor is 60
    winding = jv.DCMotorElectrical(24.0, 0.6, 0.08, 0.002, inductance=0.02)
    drive, current = jv.BeltDrive(winding, 2.0, 0.01), (jnp.asarray(3.0),)
    assert float(drive.torque_at(0.0, speed, current)) == pytest.approx(2.0 * 0.08 * 3.0)
    np.testing.assert_allclose(drive.state_rates(0.0, speed, current), [(24.0 - 0.6 * 3.0 - 0.08 * 60.0) / 0.02], rtol=1e-14)
    assert float(drive.state_units()[0]) == 40.0 and drive.supply_frequency() is None
    assert float(jv.BeltDrive(jv.InductionMotorElectrical(**CIRCUIT), 2.0, 0.1).supply_frequency()) == 377.0
    ramp = jv.Converter(MOTOR, jv.RunUp(100.0, acceleration=50.0))
    drive = jv.BeltDrive(ramp, 2.0, 0.1)
    assert float(drive.torque_at(1.0, speed)) == pytest.approx(2.0 * float(MOTOR.torque(60.0 + 150.0 - 50.0)), rel=1e-14)
    assert [float(t) for t in drive.jump_ts()] == [2.0] and drive.starting_torque() is None
    assert float(drive.speed) == 50.0 == float(drive.largest_speed)
    for steady in (drive.settled(), drive.at_working_speed()):
        assert steady.jump_ts() == () and float(steady.torque_at(1.0, speed)) == pytest.approx(float(drive.torque(speed)))


def test_run_with_a_belt_equals_that_of_the_referred_motor():
    machine = jv.one_mass(mass=200.0, stiffness=8e5, damping=600.0)

    def final_angle(drive):
        run = jv.simulate(jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=0.2)]), "1 s")
        return float(run.trajectory.state.exciters[0].rotor[0][-1])

    motor = jv.InductionMotor(150.0, breakdown_torque=70.0, breakdown_slip=0.2, inertia=0.3)
    for ratio in (1.0, 2.0):
        referred = jv.InductionMotor(150.0 / ratio, 70.0 * ratio, 0.2, inertia=0.05 + 0.3 * ratio**2)
        found = final_angle(jv.BeltDrive(motor, ratio=ratio, shaft_inertia=0.05))
        assert found == pytest.approx(final_angle(referred), rel=1e-7)


def test_a_torque_table_may_descend():
    down = jv.TorqueTable(["1500 rpm", "1000 rpm", "0 rpm"], [-4.0, 20.0, 10.0], inertia=0.02)
    up = jv.TorqueTable(["0 rpm", "1000 rpm", "1500 rpm"], [10.0, 20.0, -4.0], inertia=0.02)
    assert repr(down) == repr(up)
    with pytest.raises(jv.InputError, match=r"speeds\[2\] is 7 after 5; list the speeds in ascending or descending"):
        jv.TorqueTable([8.0, 5.0, 7.0], [-1.0, 2.0, 3.0], inertia=0.02)
