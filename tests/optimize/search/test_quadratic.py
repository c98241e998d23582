"""Small quadratic programs against their conditions and closed forms."""

import jax
import numpy as np
import pytest

from optimize.search.quadratic import solve_penalized

NOTHING = np.zeros((1, 0, 1)), np.zeros((1, 0))


def some_programs():
    """40 of four numbers with one equality and three demands."""
    random = np.random.default_rng(0)
    s, d, me, mi = 40, 4, 1, 3
    root = random.normal(size=(s, d, d))
    hessian = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(d)
    slope = 3.0 * random.normal(size=(s, d))
    held, demands = (random.normal(size=(s, m, d)) for m in (me, mi))
    off, excess = 0.1 * random.normal(size=(s, me)), random.normal(size=(s, mi)) - 0.5
    return hessian, slope, (held, off), (demands, excess), (-np.ones((s, d)), np.ones((s, d))), np.full(s, 1e4)


def test_quadratic_programs_meet_their_conditions():
    hessian, slope, (held, off), (demands, excess), (low, high), penalty = some_programs()
    one = solve_penalized(hessian, slope, (held, off), (demands, excess), (low, high), penalty)
    p = one.p
    gradient = np.einsum("sij,sj->si", hessian, p) + slope + one.bounds
    gradient += np.einsum("sm,smd->sd", one.held, held) + np.einsum("sm,smd->sd", one.demands, demands)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-7 * penalty[0])
    left = np.einsum("smd,sd->sm", demands, p) + excess
    possible = np.max(np.abs(one.held), axis=1) < 5e3
    assert possible.sum() > 30
    np.testing.assert_allclose(np.einsum("smd,sd->sm", held, p)[possible], -off[possible], atol=1e-7)
    # Demands that nearly contradict each other have multipliers near the penalty, known to fewer digits.
    kept = possible & (np.max(one.demands, axis=1) < 1e2)
    assert kept.sum() > 20 and np.all(left[kept] < 1e-7)
    np.testing.assert_allclose((one.demands * left)[kept], 0.0, atol=1e-6 * penalty[0])
    assert np.all(one.demands >= 0.0) and np.all(p >= low) and np.all(p <= high)


def solution_without_violations(hessian, slope, demands):
    """Exact minimum of p.B p/2 + g.p with C p + c <= 0, by trial of all active sets; the multipliers of the two demands."""
    rows, excess = demands
    for active in ([], [0], [1], [0, 1]):
        m = len(active)
        matrix = np.block([[hessian, rows[active].T], [rows[active], np.zeros((m, m))]])
        p, multipliers = np.split(np.linalg.solve(matrix, np.concatenate([-slope, -excess[active]])), [len(slope)])
        if np.all(rows @ p + excess < 1e-9) and np.all(multipliers > -1e-9):
            return p, np.max(multipliers, initial=0.0)
    raise AssertionError


@pytest.mark.parametrize("penalty", [10.0, 1e3, 1e6])
def test_large_penalty_does_not_change_the_solution(penalty):
    random = np.random.default_rng(0)
    s, d, box = 100, 3, 30.0
    root = random.normal(size=(s, d, d))
    hessian, slope = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(d), random.normal(size=(s, d))
    demands = random.normal(size=(s, 2, d)), -np.abs(random.normal(size=(s, 2)))
    bounds = np.full((s, d), -box), np.full((s, d), box)
    none = np.zeros((s, 0, d)), np.zeros((s, 0))
    found = solve_penalized(hessian, slope, none, demands, bounds, np.full(s, penalty))
    exact, multipliers = zip(*map(solution_without_violations, hessian, slope, zip(*demands, strict=True)), strict=True)
    counts = (np.array(multipliers) < penalty) & (np.max(np.abs(exact), axis=1) < box)
    assert counts.sum() > 90
    np.testing.assert_allclose(found.p[counts], np.array(exact)[counts], atol=1e-8 * penalty + 1e-6)


def test_quadratic_program_is_independent_of_its_batch(monkeypatch):
    """Two systems of equations a step, and some twenty steps are usual of Mehrotra's method; an easy program beside hard ones
    ends before them."""
    solved = []
    solve = np.linalg.solve
    monkeypatch.setattr(np.linalg, "solve", lambda a, b: solved.append(1) or solve(a, b))
    hard = some_programs()
    whole = solve_penalized(*hard)
    assert len(solved) <= 2 * 25
    easy = jax.tree.map(lambda a: np.concatenate([np.zeros_like(a[:1]), a[:3]]), hard)
    easy[0][0], easy[4][0][0], easy[4][1][0], easy[5][0] = np.eye(4), -1.0, 1.0, 10.0
    beside = solve_penalized(*easy)
    np.testing.assert_allclose(beside.p[1:], whole.p[:3], atol=1e-9)
    np.testing.assert_allclose(beside.p[0], 0.0, atol=1e-9)


def test_bounds_and_offsets_may_be_far_from_zero():
    """min p^2/2 between 100 and 101 with p = -1000 required: p is 100, the constraint is penalized, the bound has the rest."""
    box = np.full((1, 1), 100.0), np.full((1, 1), 101.0)
    one = np.ones((1, 1, 1))
    held = solve_penalized(one, np.zeros((1, 1)), (one, np.array([[1e3]])), NOTHING, box, np.array([10.0]))
    np.testing.assert_allclose([held.p[0, 0], held.held[0, 0], held.bounds[0, 0]], [100.0, 10.0, -110.0], rtol=1e-8)
    demanded = solve_penalized(one, np.zeros((1, 1)), NOTHING, (one, np.array([[1e3]])), box, np.array([10.0]))
    np.testing.assert_allclose([demanded.p[0, 0], demanded.demands[0, 0]], [100.0, 10.0], rtol=1e-8)


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e4])
def test_separable_program_ends_at_minima_or_bounds(size):
    """min sum b p^2/2 + g p between -1 and 2: p = -g/b within the bounds, and the bounds push with -(b p + g)."""
    hessian, slope = np.array([2.0, 1.0, 4.0, 0.5]), np.array([-2.0, 3.0, -20.0, 0.1])
    box = -np.ones((1, 4)), 2.0 * np.ones((1, 4))
    nothing = np.zeros((1, 0, 4)), np.zeros((1, 0))
    one = solve_penalized(size * np.diag(hessian)[None], size * slope[None], nothing, nothing, box, np.array([10.0]))
    np.testing.assert_allclose(one.p[0], [1.0, -1.0, 2.0, -0.2], atol=1e-8)
    np.testing.assert_allclose(one.bounds[0] / size, [0.0, -2.0, 12.0, 0.0], atol=1e-7)


@pytest.mark.parametrize(
    ("penalty", "p", "multiplier"),
    [
        (100.0, 1.0, 2.0),  # the constraint is kept, at the penalty of the slope there
        (1.0, 2.0, 1.0),  # it is broken: no multiplier is above the penalty
    ],
)
def test_constraints_beyond_their_penalty_are_violated(penalty, p, multiplier):
    """min p^2/2 - 3 p with p to be 1, or at most 1; and the same on the other side of 0."""
    one, box = np.ones((1, 1, 1)), (np.full((1, 1), -9.0), np.full((1, 1), 7.0))
    for sign in (1.0, -1.0):
        slope, penalties = np.array([[-3.0 * sign]]), np.array([penalty])
        held = solve_penalized(one, slope, (one, np.array([[-sign]])), NOTHING, box, penalties)
        np.testing.assert_allclose([held.p[0, 0], held.held[0, 0]], [sign * p, sign * multiplier], atol=1e-7)
        demanded = solve_penalized(one, slope, NOTHING, (sign * one, np.array([[-1.0]])), box, penalties)
        np.testing.assert_allclose([demanded.p[0, 0], demanded.demands[0, 0]], [sign * p, multiplier], atol=1e-7)


def test_each_multiplier_is_that_of_its_own_constraint():
    """min |p - (3, 4, 5)|^2/2 with p1 to be 1, p2 to be 2; p3 at most 3, and at most 9: multipliers 2, 2 and 2, 0."""
    rows = np.eye(3)[None]
    held = rows[:, :2], np.array([[-1.0, -2.0]])
    demands = rows[:, [2, 2]], np.array([[-3.0, -9.0]])
    box = np.full((1, 3), -20.0), np.full((1, 3), 20.0)
    one = solve_penalized(rows, -np.array([[3.0, 4.0, 5.0]]), held, demands, box, np.array([50.0]))
    np.testing.assert_allclose(one.p, [[1.0, 2.0, 3.0]], atol=1e-8)
    np.testing.assert_allclose(one.held, [[2.0, 2.0]], atol=1e-7)
    np.testing.assert_allclose(one.demands, [[2.0, 0.0]], atol=1e-7)
    np.testing.assert_allclose(one.bounds, 0.0, atol=1e-7)
