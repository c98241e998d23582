"""Run-up of motors: exciters that resonances catch, the weakest motors that pass, bad input."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxvib as jv

MASS, INERTIA, S, WORKING = 300.0, 75.0, 0.4, 100.0


def body(across=6e4, up=6e4, damping=600.0):
    springs = [jv.support(at=(x, 0.0), stiffness=(across / 2, up / 2), damping=(damping / 2,) * 2) for x in (-0.6, 0.6)]
    return jv.plane_body(mass=MASS, inertia=INERTIA, supports=springs)


def motor(torque):
    return jv.DCMotor(WORKING, stall_torque=torque, inertia=0.5)


def central(torque):
    return jv.Scene(body(), exciters=[jv.Exciter(drive=motor(torque), unbalance=S)])


def test_weak_motor_is_caught_below_the_resonance():
    """Circular translation: L(w) = c S^2 w^5 / |K - M w^2 + i w c|^2."""
    found = jv.run_up(central(0.6), 90.0)

    def balance(w):
        return 0.6 * (1.0 - w / WORKING) - 600.0 * S**2 * w**5 / ((6e4 - MASS * w**2) ** 2 + (600.0 * w) ** 2)

    assert found.status_name == "caught" and found.caught_at.tolist() == [1]
    np.testing.assert_allclose(found.resonances[0], np.sqrt(6e4 / MASS), rtol=1e-9)
    np.testing.assert_allclose(found.speed, brentq(balance, 5.0, 14.1), rtol=1e-4)
    assert "caught by resonance 1" in found.summary()


def test_least_torque_separates_capture_from_passage():
    found = jv.run_up(central(5.0), 60.0, least=True)
    assert found.status_name == "passed" and found.caught_at.tolist() == [0]
    ends = [jv.simulate(central(5.0 * float(found.least_torque) * x), 60.0, save="window") for x in (0.9, 1.1)]
    assert float(ends[0].omega) < 1.05 * np.sqrt(6e4 / MASS) < 20.0 < float(ends[1].omega)
    assert float(found.peak_amplitude[0]) > 2.0 * S / MASS


def test_exciters_are_caught_at_different_resonances():
    machine = body(2e4, 2e5)
    exciters = [
        jv.Exciter(drive=motor(0.12), unbalance=0.1, at=(0.0, 0.0)),
        jv.Exciter(drive=motor(0.05), unbalance=0.4, at=(0.0, 0.0), direction=-1),
    ]
    scene = jv.Scene(machine, exciters=exciters)
    found = jv.run_up(scene, 120.0)
    full = jv.simulate(scene, 120.0, save="window")
    assert found.caught_at[0] > found.caught_at[1] > 0
    np.testing.assert_allclose(np.abs(full.load_speed), found.speed, rtol=2e-2)


def test_motor_too_weak_for_gravity_has_a_status():
    scene = jv.Scene(body(), exciters=[jv.Exciter(drive=motor(3.0), unbalance=S)], effects=jv.Gravity())
    found = jv.run_up(scene, 5.0)  # S g = 3.9 N m
    assert found.status_name == "not_turning" and "cannot lift" in found.summary()


def test_run_up_without_a_motor_is_refused():
    scene = jv.Scene(body(), exciters=[jv.Exciter(drive=jv.ConstantSpeed(jnp.asarray(60.0)), unbalance=S)])
    with pytest.raises(jv.InputError, match="has no motor"):
        jv.run_up(scene, 5.0)
