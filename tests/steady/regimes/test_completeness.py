"""Completeness of the search for regimes: random starts of Newton's method, written here, lead to no other one."""

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.equations.torque_balance import assemble_torque_balance
from jaxvib.steady.regimes.search import _starts

SPEEDS = (100.0, 98.0, 101.0, 99.0, 102.0, 97.0)
PLACES = [(-0.55, 0.21), (0.47, 0.13), (0.08, -0.41), (-0.23, -0.35), (0.31, 0.44), (-0.12, 0.37)]
WAYS = (1, -1, 1, 1, -1, 1)
MASS, INERTIA, S, STALL = 300.0, 75.0, 0.4, 25.0


def machine():
    springs = [jv.support(at=(x, -0.1), stiffness=(2e5, 1.4e5), damping=(800.0, 700.0)) for x in (-0.6, 0.6)]
    return jv.plane_body(mass=MASS, inertia=INERTIA, supports=springs)


def scene_of(n):
    parts = zip(SPEEDS[:n], PLACES, WAYS, strict=False)
    exciters = [
        jv.Exciter(drive=jv.DCMotor(w, stall_torque=STALL, inertia=0.05), unbalance=S, at=at, direction=way)
        for w, at, way in parts
    ]
    return jv.Scene(machine(), exciters=exciters)


def random_solutions(n, starts):
    """Solutions of the torque balance of n motors, (solutions, n): speed and phases relative to the first."""
    carrier = machine().carrier()
    m, c, k = (np.asarray(x) for x in (carrier.mass, carrier.damping, carrier.stiffness))
    push = np.array([[1.0, -1j * d, -y - 1j * d * x] for (x, y), d in zip(PLACES[:n], WAYS[:n], strict=True)])

    def coupling(w):
        receptance = np.linalg.inv(k - w[:, None, None] ** 2 * m + 1j * w[:, None, None] * c)
        return 0.5 * S**2 * w[:, None, None] ** 4 * (push.conj() @ receptance @ push.T)

    def torques(z, coupling):
        turn = np.exp(1j * np.concatenate([np.zeros((len(z), 1)), z[:, 1:]], axis=1))
        each = turn.conj()[:, :, None] * coupling * turn[:, None, :]
        return STALL * (1.0 - z[:, :1] / np.array(SPEEDS[:n])) + each.imag.sum(axis=2), each

    rng = np.random.default_rng(5)
    z = np.concatenate([rng.uniform(5.0, 102.0, (starts, 1)), rng.uniform(-np.pi, np.pi, (starts, n - 1))], axis=1)
    step, most = 1e-4, np.array([2.0] + [0.5] * (n - 1))
    for _ in range(60):
        value, each = torques(z, coupling(z[:, 0]))
        by_speed = [torques(z + step * side * np.eye(n)[0], coupling(z[:, 0] + step * side))[0] for side in (1.0, -1.0)]
        by_phase = each.real - np.eye(n) * each.real.sum(axis=2)[:, :, None]
        slopes = np.concatenate([((by_speed[0] - by_speed[1]) / (2.0 * step))[:, :, None], by_phase[:, :, 1:]], axis=2)
        move = np.linalg.solve(slopes + 1e-12 * np.eye(n), -value[:, :, None])[:, :, 0]
        z = z + move * np.minimum(1.0, (most / np.maximum(np.abs(move), 1e-12)).min(1, keepdims=True))
        z[:, 0] = np.clip(z[:, 0], 1.0, 120.0)
    z = z[np.max(np.abs(torques(z, coupling(z[:, 0]))[0]), axis=1) < 1e-8]
    marks = np.concatenate([z[:, :1], np.exp(1j * z[:, 1:])], axis=1)
    kept = np.zeros(0, int)
    for row in range(len(z)):
        if not np.any(np.max(np.abs(marks[kept] - marks[row]), axis=1, initial=0.0) < 1e-4) or not kept.size:
            kept = np.append(kept, row)
    return z[kept]


SLOW = [pytest.param(n, starts, marks=pytest.mark.slow) for n, starts in ((4, 2000), (5, 3000), (6, 10_000))]


@pytest.mark.parametrize(("n", "starts"), [(3, 3000), *SLOW])
def test_random_starts_find_no_other_regime(n, starts):
    expected, found = random_solutions(n, starts), jv.synchronous_regimes(scene_of(n))
    turn = np.exp(1j * np.asarray(found.phases))
    missing = []
    for row in expected:
        near = np.abs(np.asarray(found.speed) - row[0]) + np.max(np.abs(turn[:, 1:] - np.exp(1j * row[1:])), axis=1)
        if not np.min(near) < 1e-3:
            missing.append(row)
    assert not missing and len(expected) > n
    assert found.speed.size >= len(expected)


def test_equal_exciters_in_one_place_list_their_family_once():
    motor = jv.DCMotor(100.0, stall_torque=60.0, inertia=0.05)
    scene = jv.Scene(machine(), exciters=[jv.Exciter(drive=motor, unbalance=S, at=(0.1, 0.1))] * 4)
    found = jv.synchronous_regimes(scene)
    families = [r for r in map(found.select, range(found.speed.size)) if r.status_name == "degenerate"]
    assert len(families) == 1 and "one of a family" in families[0].summary()
    np.testing.assert_allclose(families[0].speed, 100.0, rtol=1e-9)
    np.testing.assert_allclose(families[0].amplitude, 0.0, atol=1e-9)


def test_starts_are_the_roots_between_two_speeds():
    """Two motors with straight torque lines and hardly any unbalance: the sum of their torques is 0 at the mean speed."""
    motors = [jv.DCMotor(speed, stall_torque=8.0 * speed / 100.0, inertia=0.2) for speed in (100.0, 110.0)]
    exciters = [jv.Exciter(drive=motor, unbalance=1e-9, at=(x, 0.4)) for motor, x in zip(motors, (-0.3, 0.3), strict=True)]
    body = jv.plane_body(
        mass=2000.0, inertia=600.0, supports=[jv.support(at=(0.0, 0.0), stiffness=(2e5, 4e5), damping=(2e3, 4e3))]
    )
    balance = assemble_torque_balance(jv.Scene(body, exciters=exciters))
    speeds, phases = _starts(balance, np.array([80.0, 101.0, 120.0]), np.array([[0.0, 0.5]]))
    np.testing.assert_allclose(speeds, 105.0, rtol=1e-9)
    np.testing.assert_allclose(phases, [[0.0, 0.5]])
