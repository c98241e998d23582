"""Motors by their electrical data, and controlled drives, against independent integrations and closed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxvib as jv

KRAUSE = {
    "voltage": "220 V",
    "frequency": "60 Hz",
    "pole_pairs": 2,
    "stator_resistance": 0.435,
    "rotor_resistance": 0.816,
    "stator_leakage": 0.754 / (120.0 * np.pi),
    "rotor_leakage": 0.754 / (120.0 * np.pi),
    "magnetizing_inductance": 26.13 / (120.0 * np.pi),
    "inertia": 0.089,
}
"""Motor of 3 hp of P. C. Krause, Analysis of Electric Machinery, with X_ls = X_lr = 0.754 ohm and X_m = 26.13 ohm at 60 Hz."""


def _run(drive: jv.Drive, until: float, unbalance: float = 1e-9) -> jv.Run:
    """Return a run of a rotor on a heavy machine, which hardly moves."""
    machine = jv.one_mass(mass=1e3, stiffness=1e6, damping=1e3)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=unbalance)])
    return jv.simulate(scene, until, save="all", stepsize_controller=jv.Tolerance(1e-9))


def _rotor(run: jv.Run) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return times and the states of the rotor of a run."""
    kept = run.trajectory
    assert kept is not None
    rotor = kept.state.exciters[0].rotor
    assert rotor is not None
    return np.asarray(kept.time), [np.asarray(x) for x in rotor]


def test_induction_motor_equals_scipy():
    motor = jv.InductionMotorElectrical(**KRAUSE)
    leakage, mutual = KRAUSE["stator_leakage"], KRAUSE["magnetizing_inductance"]
    inductance = np.array([[leakage + mutual, mutual], [mutual, leakage + mutual]])

    def rates(t: float, x: np.ndarray) -> list[float]:
        currents = np.linalg.solve(inductance, x[:4].reshape(2, 2) @ np.array([1.0, 1j]))
        psi = x[0] + 1j * x[1], x[2] + 1j * x[3]
        stator = np.sqrt(2.0 / 3.0) * 220.0 * np.exp(120j * np.pi * t) - 0.435 * currents[0]
        rotor = 2j * x[4] * psi[1] - 0.816 * currents[1]
        torque = 3.0 * np.imag(np.conj(psi[0]) * currents[0])
        return [stator.real, stator.imag, rotor.real, rotor.imag, torque / 0.089]

    run = _run(motor, 0.3)
    time, rotor = _rotor(run)
    found = solve_ivp(rates, (0.0, 0.3), np.zeros(5), t_eval=time, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(rotor[1], found.y[4], atol=2e-6)
    np.testing.assert_allclose(np.stack(rotor[2:]), found.y[:4], atol=2e-7)
    assert np.max(rotor[1]) > 150.0


def test_steady_torque_is_that_of_steady_currents():
    motor = jv.InductionMotorElectrical(**KRAUSE)
    speed, w = 170.0, 120.0 * np.pi
    inductance = np.array([[motor.stator_leakage, 0.0], [0.0, motor.rotor_leakage]]) + motor.magnetizing_inductance
    impedance = np.diag([0.435, 0.816]) + 1j * np.diag([w, w - 2.0 * speed]) @ inductance
    currents = np.linalg.solve(impedance, [np.sqrt(2.0 / 3.0) * 220.0, 0.0])
    psi = inductance @ currents
    states = tuple(jnp.asarray(x) for x in (psi[0].real, psi[0].imag, psi[1].real, psi[1].imag))
    torque = motor.torque_at(0.0, speed, states)
    np.testing.assert_allclose(motor.torque(speed), torque, rtol=1e-12)
    rates = np.asarray(motor.state_rates(jnp.asarray(0.0), jnp.asarray(speed), states))
    np.testing.assert_allclose(rates[:2] @ [1.0, 1j], 1j * w * psi[0], rtol=1e-12)
    np.testing.assert_allclose(rates[2:] @ [1.0, 1j], 1j * w * psi[1], rtol=1e-12)


def test_breakdown_torque_of_krauses_motor():
    motor = jv.InductionMotorCircuit(**KRAUSE)
    speeds = jnp.linspace(0.0, 188.0, 20001)
    largest = float(jnp.max(jax.vmap(motor.torque)(speeds)))
    volts, z = 220.0 / np.sqrt(3.0), 26.13j / (0.435 + 26.884j)
    thevenin = z * (0.435 + 0.754j)
    resistance, reactance = thevenin.real, thevenin.imag + 0.754
    closed = 1.5 * abs(volts * z) ** 2 / (60.0 * np.pi * (resistance + np.hypot(resistance, reactance)))
    assert largest == pytest.approx(closed, rel=1e-6)


def test_name_plate_motor_gives_its_rated_power():
    for frequency, speed, pairs in (("50 Hz", 1440.0, 2), ("50 Hz", 2900.0, 1), ("60 Hz", 1160.0, 3)):
        motor = jv.NamePlateMotor("4 kW", f"{speed} rpm", 2.8, 0.02, frequency)
        rated = speed * np.pi / 30.0
        assert float(motor.torque(rated)) * rated == pytest.approx(4000.0, rel=1e-12)
        assert float(motor.speed) == pytest.approx(2.0 * np.pi * float(frequency[:2]) / pairs, rel=1e-12)
        assert float(motor.breakdown_torque) == pytest.approx(2.8 * 4000.0 / rated, rel=1e-12)


def test_name_plate_is_near_the_equivalent_circuit():
    circuit = jv.InductionMotorCircuit(**KRAUSE)
    rated = 1710.0 * np.pi / 30.0
    largest = float(jnp.max(jax.vmap(circuit.torque)(jnp.linspace(0.0, 188.0, 4001))))
    power = float(circuit.torque(rated)) * rated
    plate = jv.NamePlateMotor(power, rated, largest / float(circuit.torque(rated)), 0.089, "60 Hz")
    slips = np.linspace(rated, 188.0, 9)
    np.testing.assert_allclose(jax.vmap(plate.torque)(slips), jax.vmap(circuit.torque)(slips), atol=0.03 * largest)


def test_starting_torque_is_that_of_a_growing_rotor_resistance():
    plate = jv.NamePlateMotor("4 kW", "1440 rpm", 2.8, 0.02, starting_ratio=2.2)
    plain = jv.NamePlateMotor("4 kW", "1440 rpm", 2.8, 0.02)
    rated = 4000.0 / (1440.0 * np.pi / 30.0)
    assert float(plate.torque(0.0)) == pytest.approx(2.2 * rated, rel=1e-12)
    above = np.linspace(1.0 - float(plain.breakdown_slip), 1.1, 9) * float(plain.speed)
    np.testing.assert_allclose(plate.torque(above), plain.torque(above), rtol=1e-12)

    # An equivalent circuit without resistance of the stator, whose rotor resistance is a linear function of the slip.
    leakage, magnetizing = 3e-3, 80e-3
    blocked = 100.0 * np.pi * (1.0 - (magnetizing / (magnetizing + leakage)) ** 2) * (magnetizing + leakage)
    breakdown, u = float(plain.breakdown_slip), 2.8 / 2.2 + np.sqrt((2.8 / 2.2) ** 2 - 1.0)

    def circuit(slip):
        share = max(slip - breakdown, 0.0) / (1.0 - breakdown)
        resistance = blocked * (breakdown + share * (1.0 / u - breakdown))
        inductances = {"stator_leakage": leakage, "rotor_leakage": leakage, "magnetizing_inductance": magnetizing}
        motor = jv.InductionMotorCircuit("400 V", "50 Hz", 2, 1e-9, resistance, **inductances, inertia=0.02)
        return float(motor.torque((1.0 - slip) * motor.speed))

    slips = np.array([0.04, 0.1, breakdown, 0.3, 0.5, 0.8, 1.0, 1.5])
    torques = [float(plate.torque((1.0 - slip) * plate.speed)) / float(plate.breakdown_torque) for slip in slips]
    np.testing.assert_allclose(torques, [circuit(slip) / circuit(breakdown) for slip in slips], rtol=1e-6)


def test_torque_falls_from_breakdown_to_standstill():
    for ratio in (1.2, 2.0, 2.79):
        motor = jv.NamePlateMotor("4 kW", "1440 rpm", 2.8, 0.02, starting_ratio=ratio)
        torques = np.asarray(motor.torque(jnp.linspace(0.0, float(motor.speed) * (1.0 - float(motor.breakdown_slip)), 50)))
        assert np.all(np.diff(torques) > 0.0) and torques[-1] == pytest.approx(float(motor.breakdown_torque))
    slope = jax.grad(lambda r: jv.NamePlateMotor("4 kW", "1440 rpm", 2.8, 0.02, starting_ratio=r).torque(0.0))(2.0)
    assert float(slope) == pytest.approx(4000.0 / (1440.0 * np.pi / 30.0), rel=1e-9)


def test_dc_motor_with_inductance_equals_its_closed_form():
    motor = jv.DCMotorElectrical("24 V", "0.6 ohm", 0.08, inertia=0.002, inductance="20 mH")
    time, rotor = _rotor(_run(motor, 0.5))
    matrix = np.array([[0.0, 0.08 / 0.002], [-0.08 / 0.02, -0.6 / 0.02]])
    values, vectors = np.linalg.eig(matrix)
    steady = np.array([300.0, 0.0])
    factors = np.linalg.solve(vectors, -steady.astype(complex))
    exact = steady[:, None] + (vectors @ (factors[:, None] * np.exp(values[:, None] * time))).real
    np.testing.assert_allclose(rotor[1], exact[0], atol=1e-5)
    np.testing.assert_allclose(rotor[2], exact[1], atol=1e-6)


def test_dc_motor_without_inductance_has_no_state():
    plain = jv.DCMotorElectrical("24 V", "0.6 ohm", 0.08, 0.002)
    line = jv.DCMotor(300.0, stall_torque=3.2, inertia=0.002)
    speeds = jnp.array([0.0, 120.0, 300.0, 400.0])
    np.testing.assert_allclose(plain.torque(speeds), line.torque(speeds), rtol=1e-12, atol=1e-12)
    assert plain.state_units() == () and len(_rotor(_run(plain, 0.1))[1]) == 2


def test_torque_table_is_interpolated_and_continued():
    motor = jv.TorqueTable([0.0, 100.0, 160.0, 200.0], [10.0, 20.0, -4.0, -24.0], 0.02)
    at = np.array([-10.0, 0.0, 30.0, 100.0, 130.0, 180.0, 200.0, 220.0])
    inside = np.interp(at, [0.0, 100.0, 160.0, 200.0], [10.0, 20.0, -4.0, -24.0])
    inside[0], inside[-1] = 9.0, -34.0
    np.testing.assert_allclose(jax.vmap(motor.torque)(at), inside, rtol=1e-12)
    assert float(motor.torque(motor.speed)) == pytest.approx(0.0, abs=1e-12)
    slope = jax.grad(lambda last: jv.TorqueTable([0.0, 100.0, 160.0], jnp.stack([10.0, 20.0, last]), 0.02).speed)(-4.0)
    assert float(slope) == pytest.approx(20.0 * 60.0 / 24.0**2, rel=1e-12)


def test_speed_profile_is_consistent_with_its_derivatives():
    drive = jv.SpeedProfile([1.0, 2.0, 6.0, 8.0], [20.0, 100.0, 100.0, 0.0])
    for t in (0.5, 1.5, 4.0, 7.0, 9.0):
        assert float(jax.grad(drive.angle_at)(t)) == pytest.approx(float(drive.speed_at(t)), rel=1e-12)
        assert float(jax.grad(drive.speed_at)(t)) == pytest.approx(float(drive.acceleration_at(t)), rel=1e-12)
    assert float(drive.angle_at(9.0)) == pytest.approx(20.0 + 60.0 + 400.0 + 100.0, rel=1e-12)
    assert float(drive.speed) == 100.0
    kept = jv.SpeedProfile([1.0, 2.0], [20.0, 100.0])
    assert float(kept.angle_at(5.0)) == pytest.approx(20.0 + 60.0 + 300.0, rel=1e-12)


def test_converter_follows_its_ramp():
    motor = jv.InductionMotor("1500 rpm", breakdown_torque=70.0, breakdown_slip=0.2, inertia=0.02)
    drive = jv.Converter(motor, jv.SpeedProfile([0.0, 1.0, 2.0, 3.0], [0.0, 150.0, 150.0, 50.0]))
    time, rotor = _rotor(_run(drive, 4.0))

    def rates(t: float, x: np.ndarray) -> list[float]:
        slip = (np.interp(t, [0.0, 1.0, 2.0, 3.0], [0.0, 150.0, 150.0, 50.0]) - x[0]) / (50.0 * np.pi)
        return [2.0 * 70.0 * slip * 0.2 / (slip**2 + 0.2**2) / 0.02]

    found = solve_ivp(rates, (0.0, 4.0), [0.0], t_eval=time, rtol=1e-10, atol=1e-10, max_step=0.01)
    np.testing.assert_allclose(rotor[1], found.y[0], atol=1e-4)
    assert rotor[1][-1] == pytest.approx(50.0, abs=1e-3)


def test_converter_shifts_the_curve_of_its_motor():
    motor = jv.DCMotor(150.0, stall_torque=30.0, inertia=0.02)
    drive = jv.Converter(motor, jv.SpeedProfile([0.0, 1.0], [0.0, 100.0]))
    for speed in (80.0, 100.0, 110.0):
        assert float(drive.torque(speed)) == pytest.approx(30.0 * (100.0 - speed) / 150.0, abs=1e-12)


def test_speed_control_equals_scipy():
    drive = jv.SpeedControl(jv.ConstantSpeed(100.0), gain=0.5, integral_gain=2.0, torque_limit=8.0, inertia=0.2)
    time, rotor = _rotor(_run(drive, 10.0))

    def rates(t: float, x: np.ndarray, unwind: float) -> list[float]:
        error = 100.0 - x[0]
        unlimited = 0.5 * error + x[1]
        torque = min(max(unlimited, -8.0), 8.0)
        return [torque / 0.2, 2.0 * error + unwind * (torque - unlimited)]

    def solved(unwind: float) -> np.ndarray:
        found = solve_ivp(rates, (0.0, 10.0), [0.0, 0.0], args=(unwind,), t_eval=time, rtol=1e-10, atol=1e-10, max_step=0.01)
        return found.y

    np.testing.assert_allclose(np.stack(rotor[1:]), solved(4.0), atol=1e-4)
    assert np.max(rotor[1]) < 108.0 < 150.0 < np.max(solved(0.0)[0])  # the integral does not grow at the limit of the torque


@pytest.mark.parametrize(
    ("build", "field"),
    [
        (lambda: jv.NamePlateMotor("4 kW", "3200 rpm", 2.8, 0.02), "drive.rated_speed"),
        (lambda: jv.NamePlateMotor("4 kW", "1000 rpm", 2.8, 0.02), "drive.rated_speed"),
        (lambda: jv.NamePlateMotor("4 kW", "1440 rpm", 0.9, 0.02), "drive.breakdown_ratio"),
        (lambda: jv.NamePlateMotor("4 kW", "1440 rpm", 2.8, 0.02, starting_ratio=1.1), "drive.starting_ratio"),
        (lambda: jv.NamePlateMotor("4 kW", "1440 rpm", 2.8, 0.02, starting_ratio=2.9), "drive.starting_ratio"),
        (lambda: jv.DCMotorElectrical("24 A", 0.6, 0.08, 0.002), "drive.voltage"),
        (lambda: jv.InductionMotorCircuit(**(KRAUSE | {"pole_pairs": 1.5})), "drive.pole_pairs"),
        (lambda: jv.TorqueTable([0.0, 100.0], [10.0, 5.0], 0.02), "drive.torques"),
        (lambda: jv.TorqueTable([0.0, 100.0, 90.0], [10.0, 5.0, -1.0], 0.02), r"drive.speeds\[2\]"),
        (lambda: jv.TorqueTable([0.0, 100.0], [10.0], 0.02), "drive.torques"),
        (lambda: jv.SpeedProfile([0.0, 1.0], [0.0, 0.0]), "drive.speeds"),
        (lambda: jv.SpeedProfile([0.0, 1.0], [5.0, 0.0]).settled(), "drive.speeds"),
        (lambda: jv.Converter(jv.ConstantSpeed(5.0), jv.ConstantSpeed(5.0)), "drive.motor"),
        (lambda: jv.Converter(jv.DCMotor(100.0, 1.0, 0.1), jv.DCMotor(100.0, 1.0, 0.1)), "drive.reference"),
        (lambda: jv.SpeedControl(jv.ConstantSpeed(9.0), 1.0, 1.0, 1.0, 0.1).torque(5.0), "drive"),
    ],
)
def test_bad_data_is_refused(build, field):
    with pytest.raises(jv.InputError, match=f"^{field} "):
        build()


def test_exact_motions_refuse_motors_with_states():
    motor = jv.DCMotorElectrical("24 V", "0.6 ohm", 0.08, 0.05, "1 mH")
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=0.01), jv.Exciter(drive=motor, unbalance=0.01)])
    with pytest.raises(jv.InputError, match=r"^exciters\[0\].drive .*states"):
        jv.synchronous_orbit(scene)


def test_start_without_the_states_of_a_motor_is_refused():
    motor = jv.DCMotorElectrical("24 V", "0.6 ohm", 0.08, 0.05, "1 mH")
    scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0), exciters=[jv.Exciter(drive=motor, unbalance=0.01)])
    zero = np.zeros(())
    start = jv.State(np.zeros(1), np.zeros(1), rotor=(zero, zero))
    with pytest.raises(jv.InputError, match=r"^start.rotor has 2 entries; 3 are needed: angle, speed and the states"):
        jv.simulate(scene, 1.0, start=start)
