"""Least squares with projected linear unknowns: a model in closed form in place of a machine, against SciPy."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxvib.identification import fit
from jaxvib.identification.problem import Known, Problem
from jaxvib.numerics.noise import Noise

N, CHANNELS, RUNS = 240, 2, 2
TIME = np.linspace(0.0, 6.0, N)
TRUTH = np.array([0.07, -0.1])
LINEAR = np.array([0.8, -0.6, 0.3, 0.2, 1.5, -0.4, -0.2, 0.1, 2.0, 0.5])
"""Components of the unbalance, then state and offsets of each run."""

NOISE = np.array([0.01, 0.03])


def columns(x, run):
    """Return the readings (n, C, 6) of a run per unit of its linear unknowns: state, unbalance, offsets."""
    found = np.zeros((N, CHANNELS, 6), dtype=np.result_type(x))
    for channel in range(CHANNELS):
        for j in range(4):
            found[:, channel, j] = np.cos((1.0 + 0.7 * j + x[0]) * TIME + (0.3 + 0.5 * j) * x[1] + run + channel * (1.0 + j))
        found[:, channel, 4 + channel] = 1.0
    return found


def own_linear(linear, run):
    return np.concatenate([linear[2 + 4 * run : 4 + 4 * run], linear[:2], linear[4 + 4 * run : 6 + 4 * run]])


def slopes(x, linear, run):
    step = 1e-30
    return np.stack([np.imag(columns(x + 1j * step * each, run) @ linear) / step for each in np.eye(x.size)], axis=2)


def linear_equations(unknowns, samples, scene, x):
    z = (
        np.concatenate([columns(np.asarray(x), samples.run), samples.readings[:, :, None]], axis=2)
        * samples.weights[:, :, None]
    )
    z = z.reshape(-1, z.shape[2])
    return z.T @ z


def normal_equations(unknowns, samples, scene, x, linear):
    x, linear = np.asarray(x), np.asarray(linear)
    left = samples.readings - columns(x, samples.run) @ linear
    z = np.concatenate([slopes(x, linear, samples.run), columns(x, samples.run), left[:, :, None]], axis=2)
    z = (z * samples.weights[:, :, None]).reshape(-1, z.shape[2])
    return z.T @ z


def model_readings(unknowns, samples, scene, x, linear):
    return columns(np.asarray(x), samples.run) @ np.asarray(linear)


def with_noise(problem, noise, differences):
    """Return the problem with the weights of white noise."""
    runs = []
    for samples, of_run in zip(problem.runs, noise, strict=True):
        weights = np.ones((N, 1)) / np.array([each.deviation for each in of_run])
        runs.append(SimpleNamespace(**{**vars(samples), "weights": weights}))
    return problem._replace(runs=tuple(runs))


@pytest.fixture(autouse=True)
def closed_form(monkeypatch):
    for function in (linear_equations, normal_equations, model_readings, with_noise):
        monkeypatch.setattr(fit, function.__name__, function)


@functools.cache
def readings():
    rng = np.random.default_rng(0)
    return tuple(columns(TRUTH, run) @ own_linear(LINEAR, run) + NOISE * rng.normal(size=(N, CHANNELS)) for run in range(RUNS))


def problem_with(unbalance=None, means=(0.0, 0.0), precisions=(0.0, 0.0)):
    raw = readings()
    channels = tuple(SimpleNamespace(name=name, high_pass=0.0, delay=0.0) for name in "ab")
    runs = tuple(
        SimpleNamespace(channels=channels, run=k, readings=raw[k], weights=np.ones((N, 1)) / NOISE, step=TIME[1])
        for k in range(2)
    )
    machine = SimpleNamespace(structure=lambda: SimpleNamespace(coordinates=("y",)))
    return Problem(*[None] * len(Problem._fields))._replace(
        scene=SimpleNamespace(machine=machine, exciters=()), runs=runs, raw=raw, masks=(np.ones((N, CHANNELS), bool),) * 2,
        bounds=(np.zeros((N, CHANNELS)),) * 2, means=np.array(means),
        unknowns=SimpleNamespace(count=2, errors=0, positive=np.zeros(2, bool)), precisions=np.array(precisions),
        unbalances=(unbalance,), angle_errors=(0.0, 0.0),
    )  # fmt: skip


def residuals(problem, x, linear):
    """Return all residuals, with those of the known values."""
    parts = [
        ((samples.readings - columns(x, samples.run) @ own_linear(linear, samples.run)) * samples.weights).ravel()
        for samples in problem.runs
    ]
    known = problem.unbalances[0]
    own = [] if known is None else [(known.value - np.hypot(linear[0], linear[1])) / known.error]
    return np.concatenate([*parts, np.sqrt(problem.precisions) * (x - problem.means), own])


def by_scipy(problem, first):
    """Return the minimum over the linear unknowns at `first`, and that over all unknowns from there."""
    start = LINEAR * 1.1
    at = least_squares(lambda linear: residuals(problem, first, linear), start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    both = least_squares(
        lambda y: residuals(problem, y[:2], y[2:]), np.concatenate([first, at.x]), xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    return at, both


KNOWN = [
    {},
    {"unbalance": Known(1.01, 0.002)},
    {"means": (0.09, -0.1), "precisions": (1e6, 0.0), "unbalance": Known(0.97, 0.0005)},
]


@pytest.mark.parametrize("known", KNOWN)
def test_minimum_is_that_of_scipy(known):
    problem, first = problem_with(**known), np.array([0.05, -0.05])
    at, both = by_scipy(problem, first)
    trial = fit.project(problem, first)
    np.testing.assert_allclose(trial.linear, at.x, rtol=1e-6)
    assert trial.cost == pytest.approx(2.0 * at.cost, rel=1e-9)
    found, information, prior, converged = fit.minimize(problem, first)
    slopes_of = both.jac
    spread = np.sqrt(np.diagonal(np.linalg.inv(slopes_of.T @ slopes_of)))
    assert converged and np.max(np.abs(np.concatenate([found.x, found.linear]) - both.x) / spread) < 0.01
    assert found.cost == pytest.approx(2.0 * both.cost, rel=1e-6)
    np.testing.assert_allclose(information + prior, slopes_of.T @ slopes_of, rtol=1e-2, atol=1e-4 * np.max(information))
    assert np.sqrt(fit.project(problem, found.x).cost) == pytest.approx(np.linalg.norm(both.fun), rel=1e-6)


@pytest.mark.parametrize("known", KNOWN)
def test_gradient_and_information_follow_from_the_residuals(known):
    problem, y = problem_with(**known), np.concatenate([TRUTH + 0.03, LINEAR * 1.05])
    step, p = 1e-6, 2
    rows = np.stack(
        [(residuals(problem, *np.split(y + step * e, [p])) - residuals(problem, *np.split(y - step * e, [p]))) / (2.0 * step)
         for e in np.eye(y.size)], axis=1,
    )  # fmt: skip
    data, prior, gradient = fit.joint_equations(problem, y[:p], y[p:])
    size = np.linalg.norm(rows, axis=0)
    np.testing.assert_allclose((data + prior) / np.outer(size, size), rows.T @ rows / np.outer(size, size), atol=1e-8)
    np.testing.assert_allclose(gradient / size, -rows.T @ residuals(problem, y[:p], y[p:]) / size, rtol=1e-5, atol=1e-5)
    alone, _, _ = fit.unbalance_prior(problem, y[p:])
    assert np.allclose(prior[p:, p:], alone) and not np.any(prior[:p, p:])
    each = fit.run_equations(problem, y[:p], y[p:])
    np.testing.assert_allclose(np.sum(each, axis=0)[:-1, :-1], data)
    assert not np.any(each[0][8:12]) and np.any(each[0][4:8]) and not np.any(each[1][4:8])  # states and offsets of one run


def test_linear_unknowns_of_a_known_unbalance():
    problem = problem_with()
    unbalance = np.array([0.7, -0.5])
    found = fit.linear_at(problem, TRUTH, unbalance)
    np.testing.assert_array_equal(found[:2], unbalance)
    at = least_squares(lambda rest: residuals(problem, TRUTH, np.concatenate([unbalance, rest])), LINEAR[2:])
    np.testing.assert_allclose(found[2:], at.x, rtol=1e-6)
    np.testing.assert_allclose(fit.linear_at(problem, TRUTH, None), fit.project(problem, TRUTH).linear)


def test_fit_weighs_channels_by_their_noise():
    problem = problem_with()
    found = fit.fit_from(problem, [np.array([0.3, 0.5]), np.array([0.1, -0.2])])
    _, both = by_scipy(problem, np.array([0.05, -0.05]))
    spread = np.sqrt(np.diagonal(np.linalg.inv(both.jac.T @ both.jac)))[:2]
    assert found.converged and np.max(np.abs(found.x - both.x[:2]) / spread) < 0.15
    for run in range(RUNS):
        left = readings()[run] - columns(found.x, run) @ own_linear(found.linear, run)
        np.testing.assert_allclose(found.differences[run], left, atol=1e-12)
        np.testing.assert_allclose(found.noise[run], np.std(left, axis=0), rtol=0.01)
        np.testing.assert_allclose(found.noise[run], NOISE, rtol=0.15)
    np.testing.assert_allclose(found.outliers, 0.0)
    error = np.sqrt(np.diagonal(np.linalg.inv(found.information)))[:2]
    np.testing.assert_allclose(error, spread, rtol=0.1)


def test_fit_without_resemblance_has_not_converged(monkeypatch):
    problem = problem_with()
    noise = np.random.default_rng(5).normal(size=(2, N, CHANNELS))
    runs = tuple(SimpleNamespace(**{**vars(each), "readings": own}) for each, own in zip(problem.runs, noise, strict=True))
    found = fit.fit_from(problem._replace(runs=runs, raw=tuple(noise)), [np.zeros(2)])
    assert not found.converged


def test_angle_is_fitted_if_it_matters_for_one_channel(monkeypatch):
    """Errors of the angle become unknowns of the runs in which they are above 3 % of a channel's noise."""

    class Asked(Exception):
        pass

    def with_angle_errors(problem, runs):
        raise Asked(runs)

    monkeypatch.setattr(fit, "with_angle_errors", with_angle_errors)
    size = np.std(readings()[0], axis=0)
    shares = size / NOISE / np.max(size / NOISE)
    assert np.min(shares) < 0.9
    error = 0.03 / np.max(size / NOISE)
    fit.fit_from(problem_with()._replace(angle_errors=(0.8 * error, 0.0)), [TRUTH])
    with pytest.raises(Asked) as asked:
        fit.fit_from(problem_with()._replace(angle_errors=(1.2 * error, 0.0)), [TRUTH])
    assert asked.value.args == ([True, False],)


def test_filters_are_computed_until_the_noise_is_steady(monkeypatch):
    """The deviation changes by 5 %, 4.5 % and 0: the second filter is final."""
    changes, passes = iter([1.05, 1.005, 1.005]), []

    def noise_of(residual):
        return Noise(np.ones(1), np.std(residual) * current[0])

    def run(problem, noise, differences, starts):
        passes.append(differences is not None)
        if len(passes) > 1:
            current[0] = next(changes)
        return original(problem, noise, differences, starts)

    current, original = [1.0], fit._pass
    monkeypatch.setattr(fit, "noise_of", noise_of)
    monkeypatch.setattr(fit, "_pass", run)
    fit.fit_from(problem_with(), [TRUTH])
    assert passes == [False, False, True, True]


@pytest.mark.parametrize(("taps", "growth", "is_absorbed"), [(2, 1.25, True), (2, 1.15, False), (1, 1.25, False)])
def test_coloured_noise_does_not_take_up_the_motion(monkeypatch, taps, growth, is_absorbed):
    """The residuals of a channel grow with its coloured noise, and the fit with white noise is returned."""
    passes, original = [], fit._pass

    def run(*arguments):
        found = original(*arguments)
        passes.append(found)
        if len(passes) > 2:
            found = found._replace(noise=(found.noise[0], passes[1].noise[1] * np.array([1.0, growth])))
        return found

    monkeypatch.setattr(fit, "noise_of", lambda residual: Noise(np.eye(taps)[0], np.std(residual)))
    monkeypatch.setattr(fit, "_pass", run)
    found = fit.fit_from(problem_with(), [TRUTH])
    assert found.is_absorbed is is_absorbed and len(passes) >= 3
    if is_absorbed:
        np.testing.assert_array_equal(found.noise, passes[1].noise)
        np.testing.assert_array_equal(found.information, passes[1].information)


def test_known_unbalance_without_influence_stays_small(monkeypatch):
    """The readings hardly depend on the unbalance; least squares alone would give it an arbitrary size."""
    original = fit.linear_equations

    def equations(*arguments):
        total = np.array(original(*arguments))
        factors = np.ones(len(total))
        factors[first : first + 2] = 1e-9
        return total * np.outer(factors, factors)

    problem = problem_with(unbalance=Known(1.0, 1e-4))
    first = int(np.flatnonzero(fit.linear_indices(problem)[0] == 0)[0])
    monkeypatch.setattr(fit, "linear_equations", equations)
    found = fit.project(problem, TRUTH)
    assert np.hypot(*found.linear[:2]) == pytest.approx(1.0, abs=1e-3)


def test_best_of_several_minima_is_returned(monkeypatch):
    costs = {0.0: 3.0, 1.0: 1.0, 2.0: 2.0}

    def minimize(problem, x):
        return fit._Trial(x, LINEAR, costs[x[0]]), f"data {x[0]}", f"known {x[0]}", x[0] == 1.0

    monkeypatch.setattr(fit, "minimize", minimize)
    noise = [[Noise(np.ones(1), 1.0, 0.1, 5.0), Noise(np.ones(1), 2.0)]] * 2
    found = fit._pass(problem_with(), noise, None, [np.array([k, 0.0]) for k in costs])
    assert found.x.tolist() == [1.0, 0.0] and (found.information, found.prior, found.converged) == (
        "data 1.0",
        "known 1.0",
        True,
    )
    assert [each.tolist() for each in found.outliers] == [[0.1, 0.0]] * 2


def test_masked_readings_are_not_numbers_in_the_residuals():
    mask = np.ones((N, CHANNELS), bool)
    mask[5, 1] = False
    problem = problem_with()._replace(masks=(mask, mask))
    found = fit.information_at(problem, np.array([0.3, 0.4, *[0.0] * 8]))
    assert found.x.tolist() == [0.0, 0.0]
    _, prior, _ = fit.joint_equations(problem, np.zeros(2), found.linear)
    np.testing.assert_allclose(found.prior, prior)
    left = found._replace(differences=(np.ones((N, CHANNELS)),) * 2).residuals[1]
    assert np.isnan(left[5, 1]) and np.sum(left[mask]) == mask.sum()
    assert fit.unknown_count(problem) == 12


def test_angle_errors_are_compared_with_the_noise():
    """The reading of an angle in error by 0.02 rad changes by 0.02 of its size."""
    problem = problem_with()._replace(angle_errors=(0.02, 0.0))
    fitted = SimpleNamespace(problem=problem, noise=(np.array([0.1, 0.2]), np.array([0.1, 0.2])))
    first, second = fit.angle_shares(fitted)
    np.testing.assert_allclose(first, 0.02 * np.std(readings()[0], axis=0) / np.array([0.1, 0.2]))
    assert not np.any(second)


def test_longest_step_is_a_factor_of_two():
    problem = SimpleNamespace(unknowns=SimpleNamespace(count=3, errors=1))
    np.testing.assert_allclose(fit.limited_step(problem, np.array([0.2, -1.4, 9.0, 5.0])), [0.1, -0.7, 4.5, 2.5])
    np.testing.assert_allclose(fit.limited_step(problem, np.array([0.2, -0.6, 9.0, 5.0])), [0.2, -0.6, 9.0, 5.0])


def test_long_step_of_one_logarithm_does_not_shorten_the_others():
    matrix, gradient = np.array([[1e-4, 1e-3, 0.0], [1e-3, 1.0, 0.0], [0.0, 0.0, 1.0]]), np.array([-1.0, 0.3, 5.0])
    step = fit._damped_step(None, matrix.copy(), gradient, None, np.array([0, 1]))
    np.testing.assert_allclose(step, [-0.7, 0.3 + 0.7e-3, 5.0], rtol=1e-9)
    bent = fit._damped_step(None, matrix.copy(), gradient, lambda _, step: 0.001 * step, np.array([0, 1]))
    np.testing.assert_allclose(bent, [-0.7, 0.3007 * 1.01, 5.05], rtol=1e-9)
    assert gradient.tolist() == [-1.0, 0.3, 5.0]


def test_delayed_values_are_interpolated():
    values = np.sin(0.1 * np.arange(60.0))
    np.testing.assert_allclose(fit._delayed(values, 2.3)[10:], np.sin(0.1 * (np.arange(60.0) - 2.3))[10:], atol=1e-8)
    assert fit._delayed(values, 2.3)[0] == pytest.approx(0.0) and fit._delayed(values, 0.0) is values


def test_largest_change_of_the_noise():
    def noise(*deviations):
        return [[Noise(np.ones(1), each) for each in deviations]]

    assert fit._largest_change(noise(1.0, 2.0), noise(1.1, 1.6)) == pytest.approx(0.2)
    heavy = [[Noise(np.ones(1), 1.0, 0.1, 5.0)]]
    clipped = problem_with()._replace(bounds=(np.zeros((N, 2)), np.ones((N, 2))))
    cases = [(problem_with(), noise(1.0)), (problem_with(), heavy), (clipped, noise(1.0))]
    assert [fit._has_changing_weights(*case) for case in cases] == [False, True, True]


def test_corrected_steps_follow_a_curved_valley():
    """Readings minus model are 1 - x and 100 (x^2 - y), from (3, 9): the valley y = x^2 has sides 1e4 times as steep as its
    floor. Without the correction the limit of 40 steps is reached near (1.9, 3.4)."""
    formed = []

    def differences(x):
        return np.array([1.0 - x[0], 100.0 * (x[0] ** 2 - x[1])])

    def trial(x):
        return SimpleNamespace(x=x, cost=float(np.sum(differences(x) ** 2)))

    def slopes(x):
        return np.array([[1.0, 0.0], [-200.0 * x[0], 100.0]])

    def equations(at):
        formed.append(at)
        return slopes(at.x).T @ slopes(at.x), np.zeros((2, 2)), slopes(at.x).T @ differences(at.x)

    def bend(at, step):
        return slopes(at.x).T @ (differences(at.x + step) - differences(at.x) + slopes(at.x) @ step)

    best, _, converged = fit.descend(
        trial(np.array([3.0, 9.0])), equations, lambda at, step: trial(at.x + step), 2, np.zeros(0, int), bend
    )
    assert converged and len(formed) <= 15
    np.testing.assert_allclose(best.x, 1.0, atol=1e-2)
