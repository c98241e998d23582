"""Limits of synchronization: simulations on both sides of the folds of exact motions."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import jaxvib as jv

S = 1.5
MOTOR = jv.DCMotor(100.0, stall_torque=300.0, inertia=0.5)


def scene_of(drives, ways):
    springs = [jv.support(at=(x, -0.2), stiffness=(4e5, 7e5), damping=(2e3, 3e3)) for x in (-1.0, 1.1)]
    body = jv.plane_body(mass=2000.0, inertia=600.0, supports=springs)
    places = ((-0.9, 0.1), (0.8, 0.2))
    parts = zip(drives, places, ways, strict=True)
    return jv.Scene(body, exciters=[jv.Exciter(drive=d, unbalance=S, at=at, direction=way) for d, at, way in parts])


def phase_at_end(scene, orbit, until):
    """Phase of the second exciter relative to the first after a run that starts on the orbit, 0.03 rad off."""
    start = orbit.at(0.0)
    angle, rate = start.exciters[1].rotor
    start = eqx.tree_at(lambda s: s.exciters[1].rotor, start, (angle + 0.03, rate))
    run = jv.simulate(scene, until, start=start, save="window", estimate=False)
    turned = [e.direction * s.rotor[0][-1] for e, s in zip(scene.exciters, run.window.state.exciters, strict=True)]
    return float(turned[1] - turned[0])


CASES = {
    "speed, up": ("exciters[1].drive.speed", 1, MOTOR, (1, -1)),
    "speed, down": ("exciters[1].drive.speed", 0, MOTOR, (1, 1)),
    "friction": ("exciters[1].drive.bearing", 1, jv.SwitchedOff(MOTOR, bearing=0.005), (1, 1)),
}


@pytest.mark.parametrize("case", [pytest.param(c, marks=() if c == "friction" else pytest.mark.slow) for c in CASES])
def test_motion_stays_inside_the_limit_and_is_lost_outside(case):
    over, end, drive, ways = CASES[case]
    scene = scene_of([MOTOR, drive], ways)
    regime = jv.synchronous_regimes(scene).select(0)
    assert bool(regime.stable)
    limit = jv.synchronization_limit(scene, regime, over=over)
    fold, width = float(limit.value[end]), float(limit.value[end] - limit.start)
    name = over.rsplit(".", 1)[1]

    def changed(value):
        return eqx.tree_at(lambda s: getattr(s.exciters[1].drive, name), scene, jnp.asarray(value))

    inside, outside = changed(fold - 0.03 * width), changed(fold + 0.03 * width)
    # The branch has two motions for each value; the ends of the list lie beyond the folds.
    values, along = limit.branch_values[1:-1], limit.branch_phases[1:-1]
    phases = [0.0, float(np.interp(fold - 0.03 * width, values, along))]
    near = jv.synchronous_orbit(inside, speed=limit.speed[end], phases=phases)
    assert bool(near.stable)
    phase = float(near.phases[1] - near.phases[0])
    assert abs(phase_at_end(inside, near, 60.0) - phase) < 0.02
    assert abs(phase_at_end(outside, near, 60.0) - phase) > 2.0 * np.pi


def run_up_shares(inertia, fold, away):
    """Shares that synchronize after a run-up from rest, for speeds of the second motor within the fold and beyond it."""
    motor = jv.DCMotor(100.0, stall_torque=300.0, inertia=inertia)
    scene = scene_of([motor, motor], (1, -1))
    speeds = jnp.concatenate([fold - away, fold + away])
    found = jv.ensemble(lambda n: eqx.tree_at(lambda s: s.exciters[1].drive.speed, scene, n), speeds, 15.0, estimate=False)
    return [jv.estimate_share(part) for part in np.split(np.asarray(found.synchronous), 2)]


@pytest.mark.slow
def test_share_that_synchronizes_jumps_at_the_exact_limit():
    """Speeds 3 to 20 % of the range within the fold and beyond it. Heavy rotors keep different speeds within the fold too."""
    motor = jv.DCMotor(100.0, stall_torque=300.0, inertia=0.2)
    scene = scene_of([motor, motor], (1, -1))
    limit = jv.synchronization_limit(scene, jv.synchronous_regimes(scene).select(0), over="exciters[1].drive.speed")
    fold = float(limit.value[1])
    away = jnp.linspace(0.03, 0.2, 40) * (fold - 100.0)
    inside, outside = run_up_shares(0.2, fold, away)
    assert inside.value == 1.0 and inside.low > 0.91 and outside.value == 0.0 and outside.high < 0.09
    assert run_up_shares(0.5, fold, away)[0].value == 0.0


def central(torque):
    """One motor at the centre of a body on equal springs: the body moves on circles, and averaging is exact."""
    springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    body = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    return jv.Scene(body, exciters=[jv.Exciter(drive=jv.DCMotor(100.0, stall_torque=torque, inertia=0.5), unbalance=0.4)])


def stall_torque(w):
    """Closed form: T (1 - w/n) = c S^2 w^5 / |K - M w^2 + i w c|^2."""
    return 600.0 * 0.4**2 * w**5 / ((6e4 - 300.0 * w**2) ** 2 + (600.0 * w) ** 2) / (1.0 - w / 100.0)


def test_fold_of_a_single_motor_meets_the_closed_form():
    scene = central(0.6)
    caught = jv.synchronous_orbit(scene, speed=13.6)
    limit = jv.synchronization_limit(scene, caught, over="drive.stall_torque")
    most = minimize_scalar(lambda w: -stall_torque(w), bounds=(13.0, 15.5), method="bounded", options={"xatol": 1e-12})
    least = minimize_scalar(stall_torque, bounds=(15.5, 60.0), method="bounded", options={"xatol": 1e-12})
    np.testing.assert_allclose(limit.value[1], stall_torque(most.x), rtol=1e-9)
    np.testing.assert_allclose(limit.speed[1], most.x, rtol=1e-6)
    passed = jv.synchronous_orbit(scene, speed=90.0)
    lower = jv.synchronization_limit(scene, passed, over="drive.stall_torque")
    np.testing.assert_allclose(lower.value[0], stall_torque(least.x), rtol=1e-9)
    assert limit.plot().axes[0].get_xlabel().startswith("speed")


def test_caught_speed_of_a_run_up_ends_at_its_fold():
    """Slow growth of the torque: below the fold the motor stays caught, above it passes."""
    limit = jv.synchronization_limit(central(0.6), jv.synchronous_orbit(central(0.6), speed=13.6), over="drive.stall_torque")
    fold = float(limit.value[1])
    runs = [jv.run_up(central(share * fold), 300.0) for share in (0.97, 1.03)]
    assert [run.status_name for run in runs] == ["caught", "passed"]
    orbit = jv.synchronous_orbit(central(0.97 * fold), speed=runs[0].speed[0])
    np.testing.assert_allclose(runs[0].speed[0], orbit.speed, rtol=1e-5)
