"""Profile likelihood of costs in closed form."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq, minimize

from jaxvib.identification import fit, profile_likelihood
from jaxvib.identification.problem import Known, Problem
from jaxvib.identification.profile_likelihood import QUANTILE, _Profile, profile_intervals


class _Rise(_Profile):
    """Profile whose cost rises by `cost(distance)`."""

    cost = staticmethod(lambda distance: distance**2)

    def rise(self, distance, is_exact):
        assert is_exact
        return self.cost(distance)


def end(cost, side):
    profile = type("Rise", (_Rise,), {"cost": staticmethod(cost)})(None, 0, False, 0.0, 1.0, np.zeros(0), 0.0)
    return profile.end(side)


@pytest.mark.parametrize("skew", [-0.15, 0.0, 0.1, 0.3])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_end_is_the_root_of_the_rise(skew, side):
    def cost(distance):
        return distance**2 * math.exp(skew * distance)

    root = brentq(lambda distance: cost(side * distance) - QUANTILE**2, 0.5, 1.0 / max(abs(skew), 0.1))
    assert end(cost, side) == pytest.approx(root, rel=0.02)


def test_flat_cost_has_no_end():
    assert end(lambda distance: 1.0 - math.exp(-(distance**2)), 1.0) == math.inf
    assert end(lambda distance: 0.01 * distance**2, 1.0) == pytest.approx(10.0 * QUANTILE, rel=0.02)
    assert end(lambda distance: 0.009 * distance**2, 1.0) == math.inf  # beyond 20 standard errors
    assert end(lambda distance: 4.0 / distance**2, 1.0) == math.inf


HESSIAN = np.array([[400.0, 60.0, -50.0], [60.0, 900.0, 80.0], [-50.0, 80.0, 100.0]])
"""Half the second derivatives of the cost by two numbers and the logarithm of the unbalance."""

MINIMUM = np.array([0.1, -0.2, math.log(0.05)])


def cost_of(y, skew):
    """Return a quadratic cost with a cubic term of the first number and of the unbalance."""
    away = y - MINIMUM
    return away @ HESSIAN @ away + skew[0] * away[0] ** 3 + skew[1] * away[2] ** 3


def held_cost(problem, y, skew):
    away = y[:2] - problem.means
    known = problem.unbalances[0]
    return (
        cost_of(y, skew)
        + away**2 @ problem.precisions
        + (0.0 if known is None else ((math.exp(y[2]) - known.value) / known.error) ** 2)
    )


def solve(problem, first, skew, free):
    """Return the minimum of the cost over the entries `free`; the last one is the linear unknown."""

    def cost(y):
        return held_cost(problem, np.where(free, y, first), skew)

    found = minimize(cost, first, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-10, "maxiter": 4000})
    return SimpleNamespace(x=found.x[:2], cost=found.fun)


def profile_by_scipy(index, skew):
    """Return the ends of the interval of one unknown by minimizing over the other two."""
    spread = math.sqrt(np.linalg.inv(HESSIAN)[index, index])

    def rise(distance):
        others = [k for k in range(3) if k != index]

        def cost(part):
            y = np.empty(3)
            y[others], y[index] = part, MINIMUM[index] + distance * spread
            return cost_of(y, skew)

        return minimize(cost, MINIMUM[others], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-10}).fun - QUANTILE**2

    return brentq(rise, -3.5, -1.0) * spread, brentq(rise, 1.0, 3.5) * spread


@pytest.mark.parametrize(
    ("skew", "names"), [((0.0, 0.0), []), ((800.0, 0.0), ["machine.damping"]), ((0.0, 60.0), ["unbalance"])]
)
def test_intervals_of_numbers_with_a_cubic_cost(monkeypatch, skew, names):
    def minimum(problem, x):
        return (solve(problem, np.append(x, MINIMUM[2]), skew, np.ones(3, bool)),)

    def project(problem, x):
        return solve(problem, np.append(x, MINIMUM[2]), skew, np.array([False, False, True]))

    monkeypatch.setattr(profile_likelihood, "minimize", minimum)
    monkeypatch.setattr(profile_likelihood, "project", project)
    information = np.zeros((5, 5))
    information[:4, :4][np.ix_([0, 1, 2], [0, 1, 2])] = 0.75 * HESSIAN
    monkeypatch.setattr(profile_likelihood, "in_polar_unbalances", lambda _: (information, information / 3.0, np.array([0.05])))
    problem = Problem(*[None] * len(Problem._fields))._replace(
        unknowns=SimpleNamespace(numbers=(1, 2)), means=np.zeros(2), precisions=np.zeros(2), unbalances=(None,)
    )
    fitted = SimpleNamespace(problem=problem, x=MINIMUM[:2])
    known = SimpleNamespace(
        names=("machine.damping", "machine.mass", "unbalance"), determined=[True, True, True], vanished=[False] * 3
    )
    found = profile_intervals(fitted, known)
    assert list(found) == names
    for name in names:
        np.testing.assert_allclose(found[name], profile_by_scipy(known.names.index(name), skew), rtol=0.02)
    known.determined = [False] * 3
    assert profile_intervals(fitted, known) == {}


@pytest.mark.parametrize(("rises", "is_quadratic"), [((4.3, 3.7), True), ((4.5, 4.0), False), ((4.0, 3.5), False)])
def test_a_cost_not_quadratic_on_one_side_has_a_profile(monkeypatch, rises, is_quadratic):
    """A cost that rises by 10 % more or less than 4 at two standard errors."""
    information = np.diag([0.0, 4.0])
    monkeypatch.setattr(profile_likelihood, "in_polar_unbalances", lambda _: (information, np.diag([4.0, 0.0]), np.zeros(0)))
    monkeypatch.setattr(profile_likelihood, "project", lambda *_: SimpleNamespace(cost=0.0))
    costs = {-2.0: rises[0], 2.0: rises[1]}
    monkeypatch.setattr(_Profile, "rise", lambda self, distance, is_exact: 9e9 if is_exact else costs[distance])
    monkeypatch.setattr(_Profile, "end", lambda self, side: 3.0 + side)
    problem = SimpleNamespace(unknowns=SimpleNamespace(numbers=(1, 2)), unbalances=(), linear=None)
    known = SimpleNamespace(names=("mass", "damping"), determined=[False, True], vanished=[False] * 2)
    found = profile_intervals(SimpleNamespace(problem=problem, x=np.zeros(2)), known)
    assert found == ({} if is_quadratic else {"damping": (-0.5 * 2.0, 0.5 * 4.0)})


@pytest.mark.parametrize(("bend", "expected"), [(0.0, [4.0, 4.0]), (2.0, [6.0, 6.0, 4.0, 4.0])])
def test_states_of_loads_follow_the_quadratic_form(monkeypatch, bend, expected):
    """The cost is quadratic in two numbers, the logarithm and the angle of the unbalance, and a state. With a bend, it rises by
    the square of the distance only if all unknowns are fitted."""
    slopes = np.random.default_rng(4).normal(size=(9, 5)) * np.array([20.0, 30.0, 15.0, 9.0, 2.0])
    matrix, x, linear = slopes.T @ slopes, np.array([0.1, -0.2]), np.array([0.03, 0.04, 2.0])

    def cost(problem, now):
        size, angle = np.hypot(*problem.linear[:2]), np.arctan2(*problem.linear[1::-1])
        y = np.array([*(now - x), np.log(size / 0.05), angle - np.arctan2(0.04, 0.03), problem.linear[2] - 2.0])
        return SimpleNamespace(cost=y @ matrix @ y + bend * (now is not x))

    monkeypatch.setattr(profile_likelihood, "project", cost)
    monkeypatch.setattr(profile_likelihood, "minimize", lambda *_: (SimpleNamespace(cost=4.0),))
    monkeypatch.setattr(profile_likelihood, "nonlinear_columns", lambda *_: [np.zeros((3, 6))])
    monkeypatch.setattr(_Profile, "_descend_into_valley", lambda self, problem, x, linear: (x, linear))
    monkeypatch.setattr(profile_likelihood, "in_polar_unbalances", lambda _: (0.75 * matrix, 0.25 * matrix, np.array([0.05])))
    rises, rise = [], _Profile.rise
    monkeypatch.setattr(_Profile, "rise", lambda *arguments: rises.append(rise(*arguments)) or rises[-1])
    problem = Problem(*[None] * len(Problem._fields))._replace(
        unknowns=SimpleNamespace(numbers=(1, 2)), means=np.zeros(2), precisions=np.zeros(2), unbalances=(None,), linear=linear
    )
    names = ("machine.damping", "machine.mass", "unbalance")
    known = SimpleNamespace(names=names, determined=[True] * 3, vanished=[False] * 3)
    assert profile_intervals(SimpleNamespace(problem=problem, x=x, linear=linear), known) == {}
    np.testing.assert_allclose(rises, 3 * expected, rtol=1e-9)
    assert linear.tolist() == [0.03, 0.04, 2.0]


def test_steps_lead_into_a_curved_valley(monkeypatch):
    """Two states follow parabolas over the first number, which is fixed at 0.5; the least cost is 0.25."""

    def differences(problem, x, linear):
        return np.array([20.0 * (linear[0] - x[0] - x[0] ** 2), 20.0 * (linear[1] + x[1] - 0.4 * x[0] ** 2), x[0], x[1], 0.0])

    slopes = np.array([[20.0, 0.0, -20.0, 0.0], [0.0, -20.0, 0.0, -20.0], [-1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, 0, 0]])
    monkeypatch.setattr(profile_likelihood, "nonlinear_differences", differences)
    prior = np.diag([1e6, 0.0, 0.0, 0.0])
    monkeypatch.setattr(fit, "known_cost", lambda problem, x, linear: 1e6 * (x[0] - 0.5) ** 2)
    monkeypatch.setattr(
        profile_likelihood, "prior_equations", lambda problem, x, linear: (prior, -1e6 * np.array([x[0] - 0.5, 0.0, 0.0, 0.0]))
    )
    profile = _Profile(None, 0, False, 0.0, 0.25, np.zeros(4), 0.0, columns=slopes, data=slopes.T @ slopes)
    x, linear = profile._descend_into_valley(None, np.array([0.5, 0.0]), np.array([0.5, 0.0]))
    left = differences(None, np.array([0.5, 0.0]), np.array([0.5, 0.0]))
    assert left @ left > 20.0 and np.sum(differences(None, x, linear) ** 2) == pytest.approx(0.25, abs=1e-3)
    assert x[0] == pytest.approx(0.5, abs=1e-6)


def test_known_values_count_in_the_rise():
    problem = Problem(*[None] * len(Problem._fields))._replace(
        means=np.array([0.1, 0.3]), precisions=np.array([25.0, 16.0]), unbalances=(Known(0.05, 0.01),)
    )
    fitted = SimpleNamespace(problem=problem)
    number = _Profile(fitted, 1, False, 0.0, 0.5, np.zeros(2), 0.0)
    held, cost = number._fix_parameter(0.7)
    assert cost == pytest.approx(16.0 * 0.4**2)
    np.testing.assert_allclose(held.means, [0.1, 0.7])
    np.testing.assert_allclose(held.precisions, [25.0, 1.0 / (1e-3 * 0.5) ** 2])
    assert problem.means[1] == 0.3
    held, cost = _Profile(fitted, 0, True, 0.0, 0.5, np.zeros(2), 0.0)._fix_parameter(math.log(0.08))
    assert cost == pytest.approx(9.0)
    np.testing.assert_allclose(held.unbalances[0], [0.08, 1e-3 * 0.5 * 0.08])
