"""Regimes of the runs of an ensemble: groups of one speed, ranges of phases, caught masses, shares."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.motion.analysis.caught import catching_resonance
from jaxvib.motion.analysis.ensemble_regimes import RotatingMasses, regimes_of_runs

TURN = 2.0 * np.pi


def _regimes(rotation, phase, resonance, equal, finite=None):
    """Regimes of runs of 1 s, whose speeds are therefore the angles turned."""
    rotation = np.asarray(rotation, float)
    names = tuple(str(k + 1) for k in range(rotation.shape[1]))
    masses = RotatingMasses(rotation, np.asarray(phase, float), np.asarray(resonance), names, equal)
    return regimes_of_runs(masses, rotation, np.ones(len(rotation), bool) if finite is None else np.asarray(finite))


def test_runs_are_divided_by_speeds_phases_and_resonances():
    rotation = [[100, 100.2], [100, 100], [100, 99.9], [100, 60], [100, 30], [100, 1], [np.nan, np.nan], [100, 100]]
    phase = [[0, 3.1], [0, -3.1], [0, 0.1], [0, 1.0], [0, 2.0], [0, 0.5], [np.nan, np.nan], [0, 3.0]]
    resonance = [[0, 0], [0, 0], [0, 0], [0, 0], [0, 1], [0, 1], [0, 0], [0, 0]]
    found = _regimes(rotation, phase, resonance, (0, 1), [True] * 6 + [False, True])
    assert found.regime_of_run[[0, 1, 7]].tolist() == [1, 1, 1] and found.regime_of_run[6] == 0
    assert sorted(found.regime_of_run[2:6]) == [2, 3, 4, 5]
    assert found.runs.tolist() == [3, 1, 1, 1, 1] and found.share.sum() == 7.0 / 8.0
    np.testing.assert_allclose(found.standard_error[0], np.sqrt(3.0 / 8.0 * 5.0 / 8.0 / 8.0), rtol=1e-12)
    assert found.group[0].tolist() == [0, 0] and found.group[found.regime_of_run[5] - 1].tolist() == [0, -1]
    np.testing.assert_allclose(found.phase[0, 1] % TURN, np.angle(np.mean(np.exp(1j * np.array([3.1, -3.1, 3.0])))) % TURN)
    np.testing.assert_allclose((found.phase_high - found.phase_low)[0, 1], TURN - 3.1 - 3.0, rtol=1e-12)
    assert "3 of 8 runs, 37.5 % (standard error 17 %): exciters 1, 2: 954" in found.summary()
    assert "exciter 2: 286.5 rpm, caught by resonance 1" in found.summary()
    assert "exciter 2: not turning" in found.summary() and "1 of 8 runs did not stay finite" in found.summary()


def test_exchange_of_equal_masses_is_no_other_regime():
    # Two masses of three turn fast, a third of a turn apart; the third is slow.
    rotation, phase = np.array([100.0, 100.0, 60.0]), np.array([0.3, 0.3 + TURN / 3.0, 1.0])
    orders = [[0, 1, 2], [1, 2, 0], [2, 0, 1], [1, 0, 2]]
    runs = [rotation[order] for order in orders], [phase[order] for order in orders], np.zeros((4, 3), int)
    assert _regimes(*runs, (0, 0, 0)).runs.tolist() == [4]
    assert _regimes(*runs, (0, 1, 2)).runs.tolist() == [1, 1, 1, 1]


def test_no_finite_run_has_no_regime():
    none = np.full((2, 2), np.nan)
    found = _regimes(none, none, np.zeros((2, 2), int), (0, 1), [False, False])
    assert found.status_name == "none" and found.regime_of_run.tolist() == [0, 0]
    assert found.summary() == "no run stayed finite"


def test_resonances_that_are_not_passed_catch():
    resonances = jnp.array([10.0, 20.0, 95.0])
    numbers = [int(catching_resonance(speed, 100.0, resonances)) for speed in (5.0, 10.4, 10.6, 20.9, 21.1, 99.0)]
    assert numbers == [1, 1, 2, 2, 0, 0]  # 95 is not below 0.95 of the working speed


def test_a_weak_motor_is_caught_as_in_a_run_up():
    springs = [jv.support(at=(x, 0.0), stiffness=(3e5, 3e5), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    body = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    strong = jv.DCMotor(110.0, stall_torque=100.0, inertia=0.05)
    weak = jv.DCMotor(70.0, stall_torque=4.0, inertia=0.05)
    exciters = [jv.Exciter(drive=m, unbalance=0.4, at=(0.0, y)) for m, y in ((strong, 0.1), (weak, -0.1))]
    scene = jv.Scene(body, exciters=exciters)

    def make(torque):
        return eqx.tree_at(lambda s: s.exciters[1].drive.stall_torque, scene, torque)

    torques = jnp.array([4.0, 60.0])
    many = jv.ensemble(make, torques, 4.0, estimate=False)
    run_ups = [jv.run_up(make(torque), 4.0) for torque in torques]
    assert many.masses.resonance.tolist() == [found.caught_at.tolist() for found in run_ups] == [[0, 1], [0, 0]]
    np.testing.assert_allclose(many.regimes.speed, many.load_speed[np.argsort(many.regimes.regime_of_run)], rtol=1e-12)


def test_regimes_need_several_exciters():
    scene = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5),
        jv.ConstantSpeed("60 rad/s"),
    )
    many = jv.ensemble(lambda n: eqx.tree_at(lambda s: s.drive.speed, scene, n), jnp.array([40.0, 60.0]), 0.1, estimate=False)
    with pytest.raises(jv.InputError, match="one exciter; regimes are those of several exciters; for one exciter use speed"):
        _ = many.regimes
