"""More than six exciters: regimes that an independent integration of the slow motion reaches, exchanges, working regime."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxvib as jv
from jaxvib.steady.regimes.symmetry import exchanges_of

S, STALL, COUNT = 0.4, 25.0, 8
SPEEDS = 100.0 + 0.3 * np.random.default_rng(3).uniform(-1.0, 1.0, COUNT)
WAYS = (1, -1) * (COUNT // 2)


def places_of(seed):
    return [(1.2 * np.cos(a), 1.2 * np.sin(a)) for a in np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, COUNT)]


def scene_of(places, stiffness):
    springs = [jv.support(at=(x, -0.1), stiffness=(stiffness, 0.7 * stiffness), damping=(1600.0, 1400.0)) for x in (-0.6, 0.6)]
    parts = zip(SPEEDS, places, WAYS, strict=True)
    exciters = [
        jv.Exciter(drive=jv.DCMotor(w, stall_torque=STALL, inertia=0.05), unbalance=S, at=at, direction=way)
        for w, at, way in parts
    ]
    return jv.Scene(jv.plane_body(mass=600.0, inertia=150.0, supports=springs), exciters=exciters)


def slow_ends(scene, places, starts):
    """Ends (n, 1 + exciters) of the slow motion alpha' = L + V, Omega' = mean of L + V, by SciPy: speed and phases."""
    carrier = scene.machine.carrier()
    m, c, k = (np.asarray(x) for x in (carrier.mass, carrier.damping, carrier.stiffness))
    push = np.array([[1.0, -1j * d, -y - 1j * d * x] for (x, y), d in zip(places, WAYS, strict=True)])

    def flow(_, z):
        w, turn = z[0], np.exp(1j * z[1:])
        q = np.linalg.solve(k - w**2 * m + 1j * w * c, push.T @ turn)
        left = STALL * (1.0 - w / SPEEDS) + 0.5 * S**2 * w**4 * ((push.conj() @ q) * turn.conj()).imag
        return np.concatenate([[np.mean(left)], left - left[0]])

    rng, ends = np.random.default_rng(1), []
    for phases in rng.uniform(-np.pi, np.pi, (starts, COUNT)):
        run = solve_ivp(flow, (0.0, 2000.0), [99.0, *phases], method="LSODA", rtol=1e-9, atol=1e-9)
        if np.max(np.abs(flow(0.0, run.y[:, -1]))) < 1e-5:
            ends.append(run.y[:, -1] - np.r_[0.0, np.full(COUNT, run.y[1, -1])])
    return np.array(ends)


@pytest.mark.parametrize("seed", [5, 6])
def test_search_contains_every_end_of_the_slow_motion(seed):
    """Regimes below the highest resonance, 101 rad/s, which catches the exciters."""
    places = places_of(seed)
    scene = scene_of(places, 2.5e6)
    found, ends = jv.synchronous_regimes(scene), slow_ends(scene, places, 10)
    assert len(ends) > 5 and len(set(ends[:, 0].round(3))) == 2
    forms = np.column_stack([found.speed, np.exp(1j * np.asarray(found.phases))])
    for speed, *phases in ends:
        near = np.max(np.abs(forms - np.array([speed, *np.exp(1j * np.array(phases))])), axis=1)
        assert np.min(near) < 1e-3
    assert found.search == jv.RegimeSearchStatus.sampled and found.summary().endswith("there may be others")


def test_working_regime_of_eight_is_where_a_run_from_rest_ends():
    scene = scene_of(places_of(6), 6e6)
    regime, run = jv.working_regime(scene), jv.envelope(scene, "40 s", save="window")
    speeds = np.array([np.mean(np.asarray(n)) for n in run.window.rotor_speeds])
    np.testing.assert_allclose(np.abs(speeds), float(regime.speed), rtol=1e-7)
    np.testing.assert_allclose(run.amplitude, regime.amplitude, rtol=1e-5)


@pytest.mark.slow
def test_sixteen_different_motors_are_searched():
    places = [(1.2 * np.cos(a), 1.2 * np.sin(a)) for a in np.random.default_rng(7).uniform(0.0, 2.0 * np.pi, 16)]
    springs = [jv.support(at=(x, -0.1), stiffness=(1.2e7, 1e7), damping=(3e3, 3e3)) for x in (-0.6, 0.6)]
    motors = [jv.DCMotor(100.0 + 0.02 * k, stall_torque=STALL, inertia=0.05) for k in range(16)]
    exciters = [jv.Exciter(drive=motor, unbalance=S, at=at) for motor, at in zip(motors, places, strict=True)]
    scene = jv.Scene(jv.plane_body(mass=1200.0, inertia=300.0, supports=springs), exciters=exciters)
    found, regime = jv.synchronous_regimes(scene), jv.working_regime(scene)
    assert bool(found.stable[0]) and bool(regime.stable)
    assert np.min(np.abs(np.asarray(found.speed)[np.asarray(found.stable)] - float(regime.speed))) < 1e-6


def test_ring_of_twelve_has_the_exchanges_of_its_rotations():
    """Influences that depend on the difference of the numbers; with a phase for each step backwards only rotations are left."""
    gap = np.arange(12)[:, None] - np.arange(12)
    influence = np.exp(-np.minimum(gap % 12, -gap % 12))[None] * (1.0 + 0.2j)
    assert len(exchanges_of(influence, np.ones((12, 1)))) == 24
    orders = [each.permutation for each in exchanges_of(influence * np.exp(0.1j * (gap % 12 == 1)), np.ones((12, 1)))]
    assert sorted(map(tuple, orders)) == sorted(tuple(np.roll(np.arange(12), k)) for k in range(12))


def test_number_of_exchanges_is_bounded():
    found = exchanges_of(np.ones((1, 9, 9)) * (1.0 + 0.1j), np.ones((9, 1)))
    assert len(found) == 5040 and found[0].permutation.tolist() == list(range(9))
