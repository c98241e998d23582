"""Parts of the search for regimes against NumPy: fields of a regime, slopes, fold, starts, exchanges, interaction, text."""

import functools
import itertools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

import jaxvib as jv
from jaxvib.equations.averaged import decays
from jaxvib.equations.torque_balance import assemble_torque_balance, balance_residuals, motion_of, unknowns_of
from jaxvib.machine.scene_field import SCENE
from jaxvib.steady.regimes import local, partitions, search, symmetry, synchronous, working

S, PLACES, WAYS, SPEEDS = (0.4, 0.3, 0.5), ((-0.5, 0.3), (0.4, 0.1), (0.1, -0.4)), (1, -1, 1), (100.0, 99.5, 101.0)
STALL, J, STATUSES = (60.0, 50.0, 40.0), (0.05, 0.06, 0.07), jv.RegimeSearchStatus


def body():
    springs = [jv.support(at=(x, -0.2), stiffness=(3e4, 2e4), damping=(600.0, 500.0)) for x in (-0.6, 0.6)]
    return jv.plane_body(mass=300.0, inertia=75.0, supports=springs)


def scene_of(masses, ideal=()):
    exciters = []
    for k in masses:
        motor = jv.DCMotor(SPEEDS[k], stall_torque=STALL[k], inertia=J[k])
        drive = jv.ConstantSpeed(98.0) if k in ideal else motor
        exciters.append(jv.Exciter(drive=drive, unbalance=S[k], at=PLACES[k], direction=WAYS[k]))
    return jv.Scene(body(), exciters=exciters)


TWO, THREE, DRIVEN = scene_of((0, 1)), scene_of((0, 1, 2)), scene_of((0, 1), ideal=(0,))


@functools.cache
def matrices():
    carrier = body().carrier()
    return [np.asarray(x) for x in (carrier.mass, carrier.damping, carrier.stiffness)]


def stiffness(w):
    m, c, k = matrices()
    return k - w**2 * m + 1j * w * c


def pushes(masses):
    return np.array([[1.0, -1j * WAYS[k], -PLACES[k][1] - 1j * WAYS[k] * PLACES[k][0]] for k in masses])


def influence(w, masses=(0, 1)):
    rows = pushes(masses)
    return rows.conj() @ np.linalg.solve(stiffness(w), rows.T)


def vibration(w, phases, masses=(0, 1)):
    """V_i = w^4/2 sum_k S_i S_k Im(exp(i (alpha_k - alpha_i)) H_ik)."""
    s, turn = np.array([S[k] for k in masses]), np.exp(1j * np.asarray(phases))
    return w**4 / 2.0 * s * np.imag(turn.conj() * (influence(w, masses) @ (s * turn)))


def motors(w, masses=(0, 1)):
    return np.array([STALL[k] * (1.0 - w / SPEEDS[k]) for k in masses])


@pytest.fixture(scope="module")
def two():
    return jv.synchronous_regimes(TWO, near=(99.0, jnp.array([0.0, 2.5])))


@pytest.fixture(scope="module")
def driven():
    return jv.synchronous_regimes(DRIVEN, near=(98.0, jnp.array([0.0, 2.5])))


def test_fields_of_a_regime_follow_from_its_phases(two):
    w, phases = float(two.speed), np.asarray(two.phases)
    assert two.status_name == "found" and phases[0] == 0.0 and bool(two.stable) and 0.01 < abs(phases[1]) < np.pi
    np.testing.assert_allclose(two.torque, motors(w), rtol=1e-12)
    np.testing.assert_allclose(two.vibrational_torque, vibration(w, phases), rtol=1e-9)
    np.testing.assert_allclose(two.torque + two.vibrational_torque, 0.0, atol=1e-9 * np.max(np.abs(two.torque)))
    force = pushes((0, 1)).T @ (np.array(S[:2]) * np.exp(1j * phases))
    z = w**2 * np.linalg.solve(stiffness(w), force)
    np.testing.assert_allclose(two.displacement, z, rtol=1e-12)
    np.testing.assert_allclose(two.amplitude, np.abs(z), rtol=1e-12)
    x, y = z[0] + 0.2 * z[2], z[1]
    foot = [(6e4 + 1200.0j * w) * x, (4e4 + 1000.0j * w) * y]
    np.testing.assert_allclose(two.foundation_force, np.linalg.norm(foot), rtol=1e-12)
    np.testing.assert_allclose(two.power, motors(w) * w, rtol=1e-12)
    assert two.can_start.tolist() == [True, True] and 0.0 <= float(two.residual) < 1e-9
    vibrating = two.vibration()
    exciter = w**2 * np.array([S[0] + S[1] * np.exp(1j * phases[1]), -1j * S[0] + 1j * S[1] * np.exp(1j * phases[1])])
    np.testing.assert_allclose(vibrating.exciter_force, np.linalg.norm(exciter), rtol=1e-12)
    np.testing.assert_allclose(vibrating.torque, motors(w), rtol=1e-12)
    np.testing.assert_array_equal(vibrating.power, two.power)
    assert float(vibrating.speed) == w and float(vibrating.foundation_force) == float(two.foundation_force)
    harmonic = two.harmonic()
    assert float(harmonic.speed) == w and harmonic.rest is None and harmonic.machine is two.scene.machine


def rates(x, masses, w0):
    """Rates of speeds w and phases of masses whose vibration follows without delay, from their own speeds."""
    n = len(masses)
    w, turn, rows = x[:n], np.exp(1j * x[n:]), pushes(masses)
    s = np.array([S[k] for k in masses])
    felt = np.zeros(n, complex)
    for k in range(n):
        felt += w[k] ** 4 * s[k] * turn[k] * (rows.conj() @ np.linalg.solve(stiffness(w[k]), rows[k]))
    torque = np.array([STALL[m] * (1.0 - w[i] / SPEEDS[m]) for i, m in enumerate(masses)])
    torque += s / 2.0 * np.imag(turn.conj() * felt)
    return np.concatenate([torque / np.array([J[m] for m in masses]), w - w0])


def test_quasi_static_growth_is_that_of_slow_equations(two, driven):
    for regime, fixed, zeros in ((two, [], 1), (driven, [0], 0)):
        w, n = float(regime.speed), 2
        at = np.concatenate([np.full(n, w), regime.phases])
        free = [k for k in range(2 * n) if k % n not in fixed]
        steps = 1e-5 * np.eye(2 * n)[free]
        slopes = np.array([(rates(at + h, (0, 1), w) - rates(at - h, (0, 1), w))[free] / 2e-5 for h in steps]).T
        values = np.linalg.eigvals(slopes)
        values = values[np.argsort(np.abs(values))][zeros:]
        np.testing.assert_allclose(regime.quasi_static, np.max(values.real), rtol=1e-5)


def speed_at(phase):
    """Speed near the no-load speed at which the sum of all torques is 0."""
    return brentq(lambda w: np.sum(motors(w) + vibration(w, [0.0, phase])), 90.0, 101.0, xtol=1e-12)


def test_margin_is_the_largest_factor_along_the_phases(two):
    """Factor of the differences: (L_1 - L_2) f + V_1 - V_2 = 0 at the speed where the sum of all torques is 0."""

    def factor(phase):
        w = speed_at(phase)
        return -float(np.subtract(*vibration(w, [0.0, phase])) / np.subtract(*motors(w)))

    phase = float(two.phases[1])
    np.testing.assert_allclose(factor(phase), 1.0, rtol=1e-7)
    grid = phase + np.linspace(-2.5, 2.5, 101)
    values = np.array([factor(a) for a in grid])
    tops = [k for k in range(1, 100) if values[k] > max(values[k - 1], values[k + 1]) and values[k] > 1.0]
    near = grid[min(tops, key=lambda k: abs(grid[k] - phase))]
    top = minimize_scalar(lambda a: -factor(a), bounds=(near - 0.06, near + 0.06), method="bounded", options={"xatol": 1e-9})
    np.testing.assert_allclose(two.margin, -top.fun, rtol=1e-9)


def test_margin_beside_an_ideal_drive_scales_the_motor(driven):
    """f L_2(98) + V_2 = 0 with V_2 = a + b sin(alpha): f is largest at b."""
    turn = np.linspace(-np.pi, np.pi, 100001)
    s, h = np.array(S[:2]), influence(98.0)
    felt = 98.0**4 / 2.0 * s[1] * np.imag(np.exp(-1j * turn) * h[1, 0] * s[0] + h[1, 1] * s[1])
    assert float(driven.speed) == 98.0 and float(driven.phases[0]) == 0.0
    np.testing.assert_allclose(driven.margin, np.max(-felt) / motors(98.0)[1], rtol=1e-8)
    np.testing.assert_allclose(driven.vibrational_torque, vibration(98.0, driven.phases), rtol=1e-9)
    np.testing.assert_allclose(driven.torque[1], motors(98.0)[1], rtol=1e-12)
    np.testing.assert_allclose(driven.torque[0], -driven.vibrational_torque[0], rtol=1e-12)
    np.testing.assert_allclose(driven.power, 98.0 * np.asarray(driven.torque), rtol=1e-12)


def test_no_fold_without_differences_or_unknowns():
    balance = assemble_torque_balance(DRIVEN)
    assert float(local.margin_of(balance, jnp.zeros(0))) == np.inf


def test_slopes_are_those_of_scaled_residuals(two):
    """Left singular vectors times values times right ones: derivatives by central differences."""
    balance = assemble_torque_balance(THREE)
    x = unknowns_of(balance, jnp.asarray(97.0), jnp.array([0.2, 1.5, -0.9]))
    np.testing.assert_allclose(x, [97.0 / 101.0, 1.3, -1.1], rtol=1e-14)

    def residuals(x):
        w = 101.0 * x[0]
        return motors(w, (0, 1, 2)) + vibration(w, [0.0, *x[1:]], (0, 1, 2))

    steps = 1e-5 * np.eye(3)
    jacobian = np.array([(residuals(x + h) - residuals(x - h)) / 2e-5 for h in steps]).T
    s = np.array(S)
    largest = 97.0**4 / 2.0 * s * (np.abs(influence(97.0, (0, 1, 2))) @ s)
    np.testing.assert_allclose(jax.jit(local.vibration_scale)(balance, jnp.asarray(97.0)), largest, rtol=1e-12)
    scaled = jacobian / largest[:, None]
    first = np.linalg.norm(scaled[:, 0])
    found = jax.jit(local.slopes_of)(x, balance)
    np.testing.assert_allclose(found.columns, [1.0 / first, 1.0, 1.0], rtol=1e-7)
    np.testing.assert_allclose(found.rows, np.asarray(balance.torque_scale) / largest, rtol=1e-12)
    matrix = np.asarray(found.left) * np.asarray(found.values) @ np.asarray(found.right)
    np.testing.assert_allclose(matrix, scaled * np.array([1.0 / first, 1.0, 1.0]), atol=1e-7)
    moved = local.implicit_step(x, found, balance_residuals(x, balance))
    np.testing.assert_allclose(moved - x, -np.linalg.solve(jacobian, residuals(np.asarray(x))), rtol=1e-6)
    assert int(found.neutral) == 0
    flat = found._replace(values=jnp.array([1.0, 0.5, 1e-9]))
    assert int(flat.neutral) == 1
    along = np.asarray(flat.left).T @ (np.asarray(flat.rows) * np.array([0.1, 0.2, -0.3]))
    step = np.asarray(flat.columns) * (np.asarray(flat.right)[:2].T @ (along[:2] / np.array([1.0, 0.5])))
    np.testing.assert_allclose(local.implicit_step(x, flat, jnp.array([0.1, 0.2, -0.3])), x - step, rtol=1e-12)


def test_growth_decays_beyond_rounding():
    assert [bool(decays(jnp.asarray(g), jnp.asarray(100.0))) for g in (-2e-7, -0.5e-7, 0.0, 1.0, np.nan)] == [
        True, False, False, False, False,
    ]  # fmt: skip


def test_balance_holds_within_rounding(two):
    balance = assemble_torque_balance(TWO)
    x = unknowns_of(balance, two.speed, two.phases)
    holds = jax.jit(search.is_balanced)
    assert bool(holds(balance, x))
    assert not bool(holds(balance, x + jnp.array([0.0, 1e-6])))
    assert not bool(holds(balance, x + jnp.array([1e-4, 0.0])))
    fast = eqx.tree_at(lambda b: b.averaged.unbalance, balance, jnp.full(2, 1e-12))
    equal = eqx.tree_at(lambda b: [g.part.speed for g in b.averaged.groups], fast, [jnp.asarray(100.0)] * 2)
    at = {share: bool(holds(equal, jnp.array([share, 0.3]))) for share in (1.0, 0.9999, -1.0)}
    assert at == {1.0: True, 0.9999: False, -1.0: False}
    w, angles = motion_of(balance, x)
    assert float(w) == pytest.approx(float(two.speed), rel=1e-14) and angles.tolist() == two.phases.tolist()


def test_residual_is_relative_to_the_largest_vibrational_torques(two):
    """Beside the solution, where it is far above rounding."""
    balance = assemble_torque_balance(TWO)
    x = unknowns_of(balance, two.speed, two.phases) + jnp.array([1e-10, 2e-9])
    found = jax.jit(synchronous.fields_at)(balance, x, None)
    w, phases, s = float(found["speed"]), found["phases"], np.array(S[:2])
    largest = w**4 / 2.0 * s * (np.abs(influence(w)) @ s)
    expected = np.max(np.abs(motors(w) + vibration(w, phases)) / largest)
    assert 1e-10 < expected < 1e-8
    np.testing.assert_allclose(found["residual"], expected, rtol=1e-4)


def test_sets_of_phases_are_regular_even_and_random():
    sets = search.sets_of_phases(np.zeros(3, bool), np.dtype(float), 4)
    assert sets.shape == (4 + 2 + 16, 3) and np.all(sets[:, 0] == 0.0)
    np.testing.assert_allclose(sets[:4, 1:], np.pi * np.array([(0, 0), (1, 0), (0, 1), (1, 1)]))
    np.testing.assert_allclose(sets[4:6, 1:], 2.0 * np.pi / 3.0 * np.array([(1, 2), (2, 4)]))
    random = sets[6:, 1:]
    assert np.all(np.abs(random) <= np.pi) and random.min() < -2.0 and random.max() > 2.0
    pair = search.sets_of_phases(np.array([True, False]), np.dtype(np.float32), 6)
    assert pair.shape == (2 + 1 + 6, 2) and pair.dtype == np.float32 and np.all(pair[:, 0] == 0.0)
    np.testing.assert_allclose(pair[:, 1], [0.0, np.pi, np.pi, *(-np.pi + np.pi / 3.0 * np.arange(6))], atol=1e-6)
    middle = search.sets_of_phases(np.array([False, True, False]), np.dtype(float), 4)
    assert np.all(middle[:, 1] == 0.0) and np.ptp(middle[:, 0]) > 3.0 < np.ptp(middle[:, 2])
    assert search._regular_sets(7).shape == (64 + 7, 7)


def test_speeds_are_dense_near_resonances_and_drives():
    speeds = search._speeds(assemble_torque_balance(THREE))
    assert np.all(np.diff(speeds) >= 0.0) and 0.0 < speeds[0] < 0.6 and speeds[-1] == 1.02 * 101.0
    for w in (*np.asarray(jv.natural_frequencies(THREE)), *SPEEDS):
        near = np.sort(np.abs(speeds / w - 1.0))
        assert near[0] < 1e-12 and near[1] == pytest.approx(1e-7, rel=1e-6) and np.sum(near < 1e-3) > 40
        assert {-1.0, 1.0} == set(np.sign(speeds / w - 1.0)[np.abs(speeds / w - 1.0) < 2e-7].round()) - {0.0}
    even = np.linspace(0.005, 1.01, 200) * 101.0
    assert np.max([np.min(np.abs(speeds - w)) for w in even]) < 1e-12


def test_starts_are_roots_of_the_sum_of_torques():
    """Motors so weak that resonances brake them: several roots for each set of phases."""
    weak = eqx.tree_at(lambda s: [e.drive.stall_torque for e in s.exciters], TWO, [jnp.asarray(0.3), jnp.asarray(0.2)])
    speeds, sets = np.linspace(5.0, 101.0, 4001), np.array([[0.0, 0.4], [0.0, 2.0], [0.3, -1.0]])
    omega, phases = search._starts(assemble_torque_balance(weak), speeds, sets)
    expected = []
    for phase in sets:

        def total(w, phase=phase):
            return 0.3 * (1.0 - w / 100.0) + 0.2 * (1.0 - w / 99.5) + np.sum(vibration(w, phase))

        values = np.array([total(w) for w in speeds[::20]])
        at = np.flatnonzero(values[:-1] * values[1:] < 0.0)
        expected += [(brentq(total, speeds[20 * k], speeds[20 * k + 20]), *phase) for k in at]
    np.testing.assert_allclose(np.column_stack([omega, phases]), expected, rtol=1e-4)
    assert len(expected) > 5
    omega, phases = search._starts(assemble_torque_balance(DRIVEN), speeds, sets)
    assert omega.tolist() == [99.5] * 3 and phases is sets


def test_near_touches_are_minima_of_one_sign():
    rows = [
        (4, 1, 4, 5),
        (-4, -1, -4, -5),
        (4, 1, -4, -5),
        (-4, 1, 4, 9),
        (4, 2.5, 4, 3),
        (10, 4, 3.5, 5),
        (5, 2.4, 3, 9),
        (3, 2.4, 2.4, 5),
    ]
    found = search._nearly_touching(np.array(rows, float))
    assert [*zip(*np.stack(found).tolist(), strict=True)] == [(0, 1), (1, 1), (6, 1), (7, 2)]


def test_related_phases_are_exchanged_mirrored_and_turned():
    found = search._related_sets(np.array([[0.0, 1.0, 2.0]]), np.zeros(3, bool))
    expected = [sign * np.array(order) for order in ((0, 1, 2), (1, 0, 2), (2, 1, 0), (0, 2, 1)) for sign in (1.0, -1.0)]
    expected += [np.array([0.0, 1.0, 2.0]) + np.pi * row for row in np.eye(3)]
    np.testing.assert_allclose(found, expected)
    fixed = search._related_sets(np.array([[0.0, 1.0, 2.0]]), np.array([True, False, False]))
    assert np.all(fixed[:, 0] == 0.0) and fixed.shape == (11, 3)


def test_one_regime_of_each_family_is_kept():
    omega, neutral = np.array([50.0, 90.0, 90.0 + 1e-7, 90.0, 70.0, 50.0]), np.array([0, 2, 1, 0, 1, 0])
    assert search._one_of_each_family(omega, neutral, 1e-8).tolist() == [0, 2, 3, 4, 5]
    assert search._one_of_each_family(omega, neutral, 1e-10).tolist() == [0, 1, 2, 3, 4, 5]
    eps = np.finfo(np.float32).eps
    assert search.tolerances(np.dtype(np.float32)) == (float(eps) ** 0.4, float(eps) ** 0.33)


def test_exchanges_need_equal_numbers_of_masses():
    def orders(**changes):
        motor = jv.DCMotor(100.0, stall_torque=60.0, inertia=0.05)
        exciters = [jv.Exciter(drive=motor, unbalance=0.4, at=(x, 0.0)) for x in (-0.3, 0.3)]
        scene = jv.Scene(body_without_height(), exciters=exciters)
        scene = eqx.tree_at(lambda s: [get(s.exciters[1]) for get in GETTERS.values()], scene, [
            jnp.asarray(changes.get(name, float(get(exciters[1])))) for name, get in GETTERS.items()])  # fmt: skip
        return sorted(tuple(map(int, e.permutation)) for e in search.exchanges_in(assemble_torque_balance(scene)))

    assert orders() == [(0, 1), (1, 0)]
    for change in ({"unbalance": 0.41}, {"inertia": 0.051}, {"torque": 61.0}, {"speed": 100.1}):
        assert orders(**change) == [(0, 1)]


GETTERS = {
    "unbalance": lambda e: e.unbalance,
    "inertia": lambda e: e.drive.inertia,
    "torque": lambda e: e.drive.stall_torque,
    "speed": lambda e: e.drive.speed,
}


def body_without_height():
    springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 2e4), damping=(600.0, 500.0)) for x in (-0.6, 0.6)]
    return jv.plane_body(mass=300.0, inertia=75.0, supports=springs)


def test_regimes_that_differ_by_an_exchange_are_one():
    same = symmetry.Exchange(np.arange(3), np.zeros(3))
    cycle = symmetry.Exchange(np.array([1, 2, 0]), np.array([0.3, -0.2, 0.5]))
    base = np.array([0.0, 1.0, 2.5])
    turned = np.zeros(3)
    turned[cycle.permutation] = base + cycle.shift
    phases = np.stack([base, base + 0.7, turned - 0.4, np.array([0.0, 1.0, 2.4]), base, -base])
    speed = np.array([90.0, 90.0, 90.0 * (1.0 + 1e-9), 90.0, 80.0, 90.0 * (1.0 - 1e-9)])
    tolerance = 1e-6, 1e-4
    assert sorted(symmetry.distinct_regimes(speed, phases, [same, cycle], tolerance)) == [2, 3, 4, 5]
    assert sorted(symmetry.distinct_regimes(speed, phases, [same], tolerance)) == [0, 2, 3, 4, 5]
    assert symmetry.distinct_regimes(speed, phases, [same], (1e-12, 1e-4)).tolist() == [2, 0, 3, 5, 4]


def test_fastest_starts_are_the_last_fall_of_the_sum():
    balance, sets = assemble_torque_balance(TWO), np.array([[0.0, 0.4], [0.0, 2.0], [0.3, -1.0]])
    starts = jax.jit(lambda balance: working._fastest_starts(balance, sets))
    found = starts(balance)
    expected = [brentq(lambda w, a=a: np.sum(motors(w) + vibration(w, a)), 90.0, 101.0) for a in sets]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert working._fastest_starts(assemble_torque_balance(DRIVEN), sets).tolist() == [99.5] * 3
    heavy = eqx.tree_at(lambda b: b.averaged.unbalance, balance, jnp.full(2, 1e3))
    assert starts(heavy).tolist() == [100.0] * 3  # braked at every speed: the working speed


def test_blekhmans_function_is_the_quadratic_form():
    balance, phase, s = assemble_torque_balance(TWO), np.array([0.3, -1.0]), np.array(S[:2])
    forces = s * np.exp(1j * phase)
    expected = -(95.0**4) / 4.0 * np.real(forces.conj() @ influence(95.0) @ forces)
    np.testing.assert_allclose(working._potential(balance, jnp.asarray(95.0), jnp.asarray(phase)), expected, rtol=1e-12)
    assert float(working._potential(balance, jnp.asarray(np.nan), jnp.asarray(phase))) > 1e300


def test_interaction_is_the_sum_of_alternating_torques():
    speed, group = np.array([[99.0, 99.0, 60.0], [90.0, 75.0, 50.0], [80.0, 80.0, 80.0], [80.0, 80.0, 80.0]]), np.array(
        [[0, 0, 1], [0, 1, 2], [0, 0, 0], [0, 1, 1]]
    )  # fmt: skip
    found = partitions._interactions(jnp.asarray(speed), jnp.asarray(group), THREE)

    def expected(w, g):
        totals = []
        for i in range(3):
            total = 0.0
            for k in range(3):
                if g[i] != g[k]:
                    torque = 0.5 * S[i] * S[k] * w[k] ** 4 * abs(influence(w[k], (0, 1, 2))[i, k])
                    d = w[k] - w[i]
                    total += torque / abs(d) / np.hypot(J[i] * d, STALL[i] / SPEEDS[i])
            totals.append(total)
        return max(totals)

    np.testing.assert_allclose(found[:3], [expected(*row) for row in zip(speed[:3], group[:3], strict=True)], rtol=1e-9)
    assert float(found[2]) == 0.0 and np.isinf(found[3])


def test_interaction_spares_prescribed_speeds():
    scene = scene_of((0, 1), ideal=(0,))
    found = float(partitions._interactions(jnp.array([[98.0, 60.0]]), jnp.array([[0, 1]]), scene)[0])
    torque = 0.5 * S[0] * S[1] * 98.0**4 * abs(influence(98.0)[1, 0])
    np.testing.assert_allclose(found, torque / 38.0 / np.hypot(J[1] * 38.0, STALL[1] / SPEEDS[1]), rtol=1e-9)


def test_partitions_combine_the_regimes_of_their_groups():
    every = [each for size in (1, 2, 3) for each in itertools.combinations(range(3), size)]
    counted = {subset: [f"{subset}{k}" for k in range(sum(subset) % 2 + 1)] for subset in every}
    found = [[name for _, name in parts] for parts in partitions._products((0, 1, 2), counted)]
    assert len(found) == 1 * 2 * 1 + 2 * 1 + 1 * 2 + 2 * 1 + 2 and ["(0, 1)1", "(2,)0"] in found
    assert all(sorted(k for parts, _ in each for k in parts) == [0, 1, 2] for each in partitions._products((0, 1, 2), counted))


def test_ideal_drives_of_two_speeds_cannot_share():
    exciters = [jv.Exciter(drive=jv.ConstantSpeed(w), unbalance=0.1, at=(x, 0.0)) for w, x in ((60.0, 0.1), (70.0, 0.2))]
    loads = jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0)
    scene = jv.Scene(body(), exciters=[*exciters, jv.Exciter(loads, jv.ConstantSpeed(80.0)), *scene_of((0,)).exciters])
    shared = {each: partitions._can_share(scene, np.array(each)) for each in ((0,), (0, 1), (0, 2), (0, 2, 3), (0, 0))}
    assert shared == {(0,): True, (0, 1): False, (0, 2): True, (0, 2, 3): True, (0, 0): True}


UNITS = {
    "masses": ("", ("mass",)),
    "speed": ("rad/s", ()),
    "phases": ("rad", ("mass",)),
    "growth": ("1/s", ()),
    "stable": ("", ()),
    "quasi_static": ("1/s", ()),
    "margin": ("", ()),
    "torque": ("N m", ("mass",)),
    "vibrational_torque": ("N m", ("mass",)),
    "power": ("W", ("exciter",)),
    "can_start": ("", ("exciter",)),
    "displacement": ("m or rad", ("coordinate",)),
    "amplitude": ("m or rad", ("coordinate",)),
    "foundation_force": ("N", ()),
    "residual": ("", ()),
}
MOTION_UNITS = {"group": "", "speed": "rad/s", "phases": "rad", "growth": "1/s", "stable": "", "interaction": ""}


def test_numbers_of_regimes_have_units_and_axes():
    fields = {name: field.metadata for name, field in jv.SynchronousRegimes.__dataclass_fields__.items()}
    found = {name: (m["unit"], m["axes"]) for name, m in fields.items() if "unit" in m}
    assert found == {name: (unit, ("*", *axes)) for name, (unit, axes) in UNITS.items()} | {"search": ("", ())}
    assert fields["scene"] == SCENE == jv.RegimePartitions.__dataclass_fields__["scene"].metadata
    assert jv.SynchronousRegimes.outer_axes == ("regime",)
    fields = {name: field.metadata for name, field in jv.RegimePartitions.__dataclass_fields__.items()}
    found = {name: (m["unit"], m["axes"]) for name, m in fields.items() if "unit" in m}
    each = {"group": ("motion", "mass"), "speed": ("motion", "mass"), "phases": ("motion", "mass")}
    assert found == {name: (unit, each.get(name, ("motion",))) for name, unit in MOTION_UNITS.items()}


def as_list(regime, n):
    """Regimes of which each one is 1 rad/s slower than the one before."""
    fields = {name: getattr(regime, name) for name in jv.SynchronousRegime.__dataclass_fields__ if name != "scene"}
    fields = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], n, axis=0), fields)
    fields["speed"] = fields["speed"] - jnp.arange(float(n))
    return jv.SynchronousRegimes(**fields, scene=regime.scene, search=STATUSES.done if n else STATUSES.none)


def test_summary_and_plot_of_regimes(two):
    regime = eqx.tree_at(
        lambda r: (r.speed, r.growth, r.margin, r.phases),
        two,
        (jnp.asarray(10.0 * np.pi), jnp.asarray(-2.5), jnp.asarray(1.75), jnp.array([0.0, -0.5 * np.pi])),
    )
    assert regime.summary() == "Omega 300 rpm, stable (-2.5 1/s), margin 1.75: 0, -90 deg"
    family = eqx.tree_at(lambda r: (r.status, r.stable), regime, (synchronous.RegimeStatus.degenerate, jnp.asarray(False)))
    assert family.summary() == "Omega 300 rpm, unstable (-2.5 1/s), margin 1.75, one of a family: 0, -90 deg"
    lost = eqx.tree_at(lambda r: (r.status, r.speed), regime, (synchronous.RegimeStatus.not_converged, jnp.asarray(np.nan)))
    assert lost.summary() == "no regime was found from this start"
    several = as_list(regime, 3)
    assert [float(several.select(k).speed) for k in range(3)] == [float(regime.speed) - k for k in range(3)]
    assert len(several.summary().splitlines()) == 3 and several.summary().startswith(regime.summary())
    assert as_list(regime, 0).summary() == STATUSES[STATUSES.none]
    heavy = eqx.tree_at(lambda r: r.scene, several, jv.Scene(TWO.machine, exciters=TWO.exciters, effects=jv.Gravity(9.81)))
    assert heavy.summary().startswith(f"{several.summary()}\nat 280.901 rpm the weight") and "by 9 %" in heavy.summary()
    assert [text.get_text() for text in as_list(regime, 0).plot().axes[0].texts] == ["no synchronous regime"]
    for index in (3, -1):
        with pytest.raises(jv.InputError, match=rf"^index is {index}; there are 3 regimes, counted from 0"):
            several.select(index)
    torques, *circles = several.plot().axes
    titles = [each.get_title() for each in circles]
    assert [each.partition(",")[0] for each in titles] == ["300 rpm", "290.451 rpm", "280.901 rpm"]
    assert titles[0].startswith("300 rpm, stable\nphases in the direction of rotation\n0, -90 deg\ntorques ")
    named = {text.get_text() for text in torques.get_legend().get_texts()}
    assert torques.get_ylabel() == "torque, N m" and {"of motor 1", "of motor 2", "regime; hollow: unstable"} <= named
    (axis,) = regime.plot().axes
    assert axis.get_title() == titles[0] and {"1", "2"} <= {text.get_text() for text in axis.texts}
    mixed = eqx.tree_at(lambda r: r.stable, as_list(regime, 12), jnp.arange(12) == 11)
    assert ["unstable" in axis.get_title() for axis in mixed.plot().axes[1:]] == [False, *6 * [True]]
    same = [jv.Exciter(drive=each.drive, unbalance=each.unbalance, at=each.at) for each in TWO.exciters]
    together = eqx.tree_at(lambda r: r.scene, regime, jv.Scene(TWO.machine, exciters=same))
    assert together.plot().axes[0].get_title().splitlines()[4].startswith("resultant")
    plt.close("all")


def motions():
    return jv.RegimePartitions(
        status=jv.RegimeSearchStatus.done,
        group=np.array([[0, 0, 1], [0, 1, 0]]),
        speed=np.pi * np.array([[3.0, 3.0, 2.0], [3.0, 1.0, 3.0]]),
        phases=np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 1.0]]),
        growth=np.array([-2.0, 0.5]),
        stable=np.array([True, False]),
        interaction=np.array([0.12, 0.034]),
        scene=THREE,
    )


def test_motions_in_groups_are_listed_and_selected(monkeypatch):
    found, asked = motions(), []
    assert found.summary().splitlines() == [
        "1, 2: 90 rpm; 3: 60 rpm; stable (-2 1/s), interaction 0.12",
        "1, 3: 90 rpm; 2: 30 rpm; unstable (0.5 1/s), interaction 0.034",
    ]
    scene = jv.Scene(THREE.machine, exciters=THREE.exciters, effects=jv.Gravity(9.81))
    assert "\nat 60 rpm the weight of an unbalance" in eqx.tree_at(lambda r: r.scene, found, scene).summary()
    monkeypatch.setattr(partitions, "synchronous_regimes", lambda *args, **given: asked.append((*args, given)) or len(asked))
    assert found.select(1) == [1, 2] and all(scene is THREE for scene, _ in asked)
    assert [given["masses"] for _, given in asked] == [[0, 2], [1]]
    assert [given["near"][0] for _, given in asked] == [3.0 * np.pi, np.pi]
    assert [given["near"][1].tolist() for _, given in asked] == [[0.0, 1.0], [0.0]]
    for index in (2, -1):
        with pytest.raises(jv.InputError, match=rf"^index is {index}; there are 2 motions, counted from 0"):
            found.select(index)
    (axis,) = found.plot().axes
    assert axis.get_xlabel() == "motion" and axis.get_ylabel() == "speed, rad/s"
    plt.close("all")


@pytest.mark.parametrize("stable", [True, False])
def test_partitions_keep_weak_interactions_and_stable_motions(monkeypatch, stable):
    """Each group has a stable and an unstable regime, groups of 3 none; the interaction of single masses is too large."""

    def regimes(scene, subset, *, stable):
        if len(subset) == 3:
            return []
        numbers = np.arange(float(len(subset)))
        every = [(90.0 - sum(subset), -1.0, True), (50.0 - sum(subset), 2.0, False)]
        return [
            SimpleNamespace(
                speed=w, phases=numbers, torque=10.0 * w + numbers, growth=g, stable=s, status=synchronous.RegimeStatus.found
            )
            for w, g, s in every
            if s or not stable
        ]

    def interaction(speed, group, scene):
        return jnp.where(jnp.max(group, axis=1) == 2, 1.5, 0.25)

    monkeypatch.setattr(partitions, "_regimes_of_group", regimes)
    monkeypatch.setattr(
        partitions, "in_chunks", lambda n, f, speed, group, shared: np.asarray(interaction(speed, group, *shared))
    )
    found = jv.regime_partitions(THREE, stable=stable)
    assert found.status_name == "done" and found.scene is not None
    assert len(found.growth) == (3 if stable else 12) and np.all(found.interaction == 0.25)
    assert np.all(found.stable[:3]) and not np.any(found.stable[3:]) and np.all(np.max(found.group, axis=1) == 1)
    np.testing.assert_array_equal(found.growth, np.where(found.stable, -1.0, 2.0))
    row = found.group[:3].tolist().index([0, 1, 0])
    assert found.speed[row].tolist() == [88.0, 89.0, 88.0] and found.phases[row].tolist() == [0.0, 0.0, 1.0]


def test_wrong_groups_starts_and_speeds_are_refused():
    for masses in ([0, 0], [2], [-1], []):
        with pytest.raises(jv.InputError, match=r"^masses is .*; give different numbers of rotating masses, 0 to 1"):
            jv.synchronous_regimes(TWO, masses=masses)
    assert synchronous._read_group([1, 0], 2) is None is synchronous._read_group(None, 2)
    assert synchronous._read_group((2, 0), 3) == (0, 2)
    for near in (5.0, (99.0,), (99.0, [0.0]), (99.0, [0.0, 1.0, 2.0])):
        with pytest.raises(jv.InputError, match=r"^near must be \(speed, phases\) with one phase for each of the 2 rot"):
            jv.synchronous_regimes(TWO, near=near)
    with pytest.raises(jv.InputError, match=r"^near\[0\] is 0 rad/s; it must be greater than 0"):
        jv.synchronous_regimes(TWO, near=(0.0, [0.0, 1.0]))
    exciters = [jv.Exciter(drive=jv.ConstantSpeed(w), unbalance=0.1) for w in (60.0, 60.0, 70.0)]
    scene = jv.Scene(body(), exciters=exciters)
    with pytest.raises(jv.InputError) as error:
        synchronous.require_one_speed(scene)
    text = "exciters[2].drive.speed is 70 rad/s and that of exciters[0] 60 rad/s; a regime has one speed; give the same speed"
    assert str(error.value).startswith(text)
    synchronous.require_one_speed(scene, [0, 1])
    assert not bool(synchronous._has_one_speed(assemble_torque_balance(scene)))
    assert bool(synchronous._has_one_speed(assemble_torque_balance(DRIVEN)))
    loads = jv.Exciter(jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(80.0))
    synchronous.require_one_speed(jv.Scene(body(), exciters=[exciters[0], loads]))
    assert synchronous.mass_owners(jv.Scene(body(), exciters=[exciters[0], loads, exciters[1]])).tolist() == [0, 1, 1, 2]


def test_working_regime_starts_once_from_equal_phases(monkeypatch):
    asked = []

    def starts(balance, sets):
        asked.append(sets)
        raise StopIteration

    monkeypatch.setattr(working, "_fastest_starts", starts)
    with pytest.raises(StopIteration):
        working._stable_solution(assemble_torque_balance(DRIVEN))
    np.testing.assert_allclose(np.sort(np.mod(asked[0][:, 1], 2.0 * np.pi)), 0.5 * np.pi * np.arange(4), atol=1e-12)
