"""The descent against Adam with an augmented Lagrangian, written anew in NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from two_springs import FREE, SCENE, plain

from optimize import DesignSpace, Quantity, hold
from optimize.search.descent import STEPS_PER_CALL, _least_norm_solution, descend
from optimize.search.problem import evaluate, problem_of

STEPS, RATE = 45, 0.05

DEMANDS = [plain("product", lambda x, y: x * y) < 20.0, plain("first", lambda x, y: x) > 1.5, plain("a", lambda x, y: x) < 2.0]


def bowl(x, y, log=np.log):
    return (x - 6.0) ** 2 + 0.5 * (y - 5.0) ** 2 + log(x) * y


def adam(value, slope, excess, rows, z, steps=STEPS):
    """Adam (Kingma and Ba 2015), the first step `RATE` falling to a hundredth by half a cosine; every 20 steps the multipliers
    l = max(0, l + w g), and w three times as much where the worst demand has not become half; a step to where there is no
    value is not taken, and the next ones are half as long and then longer by a fifth each."""
    mean, square, history = np.zeros(2), np.zeros(2), []
    multipliers, weight, worst, length = np.zeros(len(excess(z))), 10.0, np.inf, 1.0
    size = abs(value(z))
    for k in range(steps):
        pull = np.maximum(0.0, multipliers + weight * excess(z))
        gradient = slope(z) / size + pull @ rows(z)
        mean, square = 0.9 * mean + 0.1 * gradient, 0.999 * square + 0.001 * gradient**2
        move = mean / (1.0 - 0.9 ** (k + 1)) / (np.sqrt(square / (1.0 - 0.999 ** (k + 1))) + 1e-8)
        rate = RATE * (0.01 + 0.99 * 0.5 * (1.0 + np.cos(np.pi * k / steps)))
        new = np.clip(z - length * rate * move, 0.0, 1.0)
        if np.isfinite(value(new)):
            z, length = new, min(1.0, 1.2 * length)
        else:
            length *= 0.5
        history.append(value(z))
        if k % 20 == 19:
            multipliers = np.maximum(0.0, multipliers + weight * excess(z))
            now = np.max(np.maximum(excess(z), 0.0), initial=0.0)
            weight = min(3.0 * weight, 1e4) if now > 0.5 * worst and now > 1e-6 else weight
            worst = now
    return z, multipliers, np.array(history)


def value(z):
    return bowl(*(1.0 + 8.0 * z))


def slope(z):
    x, y = 1.0 + 8.0 * z
    return 8.0 * np.array([2.0 * (x - 6.0) + y / x, y - 5.0 + np.log(x)])


def run(problem, starts, steps=STEPS, tell=lambda *_: None):
    return descend(problem, evaluate(problem, starts, ()), steps, RATE, tell)


def test_the_descent_is_adam_with_an_augmented_lagrangian():
    """Two of the demands hinder, the third has room; weights grow where a demand is as far off as 20 steps before."""
    problem = problem_of(DesignSpace(SCENE, FREE), plain("bowl", lambda x, y: bowl(x, y, jnp.log)), DEMANDS, starts=2)
    starts = np.array([[0.6, 0.7], [0.3, 0.25]])
    told = []
    found = run(problem, starts, tell=lambda share, point: told.append((share, point.values[:, 0])))

    def excess(z):
        x, y = 1.0 + 8.0 * z
        return np.array([x * y / 20.0 - 1.0, 1.0 - x / 1.5, x / 2.0 - 1.0])

    def rows(z):
        x, y = 1.0 + 8.0 * z
        return 8.0 * np.array([[y / 20.0, x / 20.0], [-1.0 / 1.5, 0.0], [0.5, 0.0]])

    for k, start in enumerate(starts):
        z, multipliers, history = adam(value, slope, excess, rows, start)
        np.testing.assert_allclose(found.history[:, k, 0], history, rtol=1e-5)
        np.testing.assert_allclose(found.history[-1, k, 1], max(0.0, *excess(z)), rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(found.point.z[k], z, atol=1e-6)
        np.testing.assert_allclose(found.multipliers[k], multipliers, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(found.point.slopes[k, 0], slope(z), rtol=1e-4, atol=1e-5)
    assert found.history.shape == (STEPS, 2, 2)
    assert [share for share, _ in told] == [0.5, 1.0]
    np.testing.assert_array_equal(told[0][1], found.history[STEPS_PER_CALL - 1, :, 0])


def test_step_to_a_missing_objective_is_rejected():
    def edge(x, y, log=np.log):
        return np.where(x < 3.0, bowl(x, y), np.nan)

    problem = problem_of(
        DesignSpace(SCENE, FREE), plain("edge", lambda x, y: jnp.where(x < 3.0, bowl(x, y, jnp.log), jnp.nan)), [], starts=2
    )
    start = np.array([[0.21, 0.3]])
    found = run(problem, start)
    nothing = lambda z: np.zeros(0)  # noqa: E731
    z, _, history = adam(lambda z: edge(*(1.0 + 8.0 * z)), slope, nothing, lambda z: np.zeros((0, 2)), start[0])
    np.testing.assert_allclose(found.history[:, 0, 0], history, rtol=1e-5)
    np.testing.assert_allclose(found.point.z[0], z, atol=1e-6)
    assert np.sum(np.diff(history) == 0.0) > 3  # there were such steps


@pytest.mark.parametrize("start", [[0.2, 0.4], [0.9, 0.05]])
def test_held_quantities_are_corrected_at_every_step(start):
    """x + y = 7 from off it: onto it by the first step but for what bounds forbid, then along it to the least value."""
    total = plain("sum", lambda x, y: x + y)
    problem = problem_of(DesignSpace(SCENE, FREE, [hold(total, 7.0)]), plain("bowl", lambda x, y: bowl(x, y, jnp.log)), [], 2)
    place = []
    found = run(problem, np.array([start]), STEPS_PER_CALL * 6, tell=lambda share, point: place.append(point))
    assert all(np.all(np.abs(point.values[:, 1]) < 1e-9) for point in place)
    at = np.linspace(1.0, 6.0, 100001)
    least = at[np.argmin(bowl(at, 7.0 - at))]
    np.testing.assert_allclose(1.0 + 8.0 * found.point.z[0], [least, 7.0 - least], atol=0.02)


def test_first_step_keeps_the_held_quantity():
    """Adam's first step takes the signs of the gradient's part along x + y = const: both numbers by the rate, one up, one down;
    what was off, the sum by 0.4 of 7, is taken off both alike. A number at its bound stays there."""
    total = plain("sum", lambda x, y: x + y)
    problem = problem_of(DesignSpace(SCENE, FREE, [hold(total, 7.0)]), plain("bowl", lambda x, y: bowl(x, y, jnp.log)), [], 2)
    first = run(problem, np.array([[0.2, 0.475], [0.0, 0.725]]), 1).point
    np.testing.assert_allclose(first.z[0], [0.2 + RATE - 0.025, 0.475 - RATE - 0.025], atol=1e-6)
    drawn = plain("drawn", lambda x, y: x + 3.0 * y)  # to be large: along the line x would fall below its bound
    low = problem_of(DesignSpace(SCENE, FREE, [hold(total, 7.0)]), -drawn, [], 2)
    np.testing.assert_allclose(run(low, np.array([[0.0, 0.625]]), 1).point.z, [[0.0, 0.625]], atol=1e-12)


def test_two_held_quantities_are_kept_together():
    """x + y = 7 and the link at 1e5 x: one number is left, and the least of the bowl on the line is found."""
    total, link = (
        plain("sum", lambda x, y: x + y),
        Quantity("link", "", lambda s: s.machine.link_stiffness[0] / s.machine.stiffness[0]),
    )
    space = DesignSpace(SCENE, {**FREE, "machine.link_stiffness": (5e4, 9.5e5, "even")}, [hold(total, 7.0), hold(link, 10.0)])
    problem = problem_of(space, plain("bowl", lambda x, y: bowl(x, y, jnp.log)), [], 2)
    found = run(problem, np.array([[0.3, 0.4, 0.3]]), STEPS_PER_CALL * 6)
    at = np.linspace(1.0, 6.0, 100001)
    least = at[np.argmin(bowl(at, 7.0 - at))]
    numbers = np.asarray(space.numbers(found.point.z[0])) / 1e4
    np.testing.assert_allclose(numbers, [least, 7.0 - least, 10.0 * least], rtol=0.01)
    assert np.all(np.abs(found.point.values[:, 1:]) < 1e-6)


@pytest.mark.parametrize("size", [1.0, 1e-8, 1e-10])
def test_what_hardly_changes_a_demand_is_not_sent_the_wrong_way(size):
    """x = 1 meets size x = size; where that is rounding, what is between 0 and 1 does."""
    found = _least_norm_solution(jnp.array([[size, 0.0]]), jnp.array([size]))
    assert 0.0 < float(found[0]) <= 1.0 and float(found[1]) == 0.0
    np.testing.assert_allclose(_least_norm_solution(jnp.array([[3.0, 4.0]]), jnp.array([5.0])), [0.6, 0.8], rtol=1e-12)
