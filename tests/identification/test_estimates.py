"""Estimates with intervals, and the words of a fit and of a prediction, from values in closed form."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.identification.fit import Fitted
from jaxvib.identification.further_runs import predict
from jaxvib.identification.further_runs.predict import PredictionStatus, RunPrediction
from jaxvib.identification.identify import _estimate, _gains, _refit_near_first_values, _with_ends, fitted_scene, propagate
from jaxvib.identification.problem import Known
from jaxvib.identification.response import Unknowns
from jaxvib.machine.numbers.named import find_number
from jaxvib.results.estimate import Estimate

Z = 1.959964


def test_intervals_of_coordinates():
    np.testing.assert_allclose(_estimate(8.0, 8.0, True, 0.1, True), (8.0, 0.8, 8.0 * np.exp(-0.1 * Z), 8.0 * np.exp(0.1 * Z)))
    np.testing.assert_allclose(_estimate(-3.0, 0.5, False, 0.1, True), (-3.0, 0.05, -3.0 - 0.05 * Z, -3.0 + 0.05 * Z))
    assert _estimate(8.0, 8.0, True, 0.1, False) == (8.0, np.inf, 0.0, np.inf)
    assert _estimate(8.0, 8.0, False, 0.1, False) == (8.0, np.inf, -np.inf, np.inf)
    each = Estimate(8.0, 0.8, 7.0, 9.0)
    np.testing.assert_allclose(_with_ends(each, 8.0, True, -0.3, 0.2), (8.0, 0.8, 8.0 * np.exp(-0.3), 8.0 * np.exp(0.2)))
    np.testing.assert_allclose(_with_ends(each, 0.5, False, -0.3, 0.2), (8.0, 0.8, 7.85, 8.1))


def scene_of(exciters=1):
    machine = jv.two_mass(mass=(80.0, 90.0), stiffness=(4e4, 5e4), damping=(60.0, 70.0), link_stiffness=1e5, link_damping=50.0)
    drive = jv.ConstantSpeed(30.0)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=0.05, at=k + 1) for k in range(exciters)])


def test_errors_of_a_function_of_the_numbers():
    """Functions log k + 2 log m, whose slopes by relative changes are 1 and 2, and -m k."""
    names = ("machine.stiffness[0]", "machine.mass[1]")

    def function(scene):
        k, m = scene.machine.stiffness[0], scene.machine.mass[1]
        return np.array([float(np.log(k) + 2.0 * np.log(m)), -float(k * m)])

    covariance = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    found = propagate(scene_of(), names, np.array([4e4, 90.0]), covariance, np.zeros((2, 0)), np.zeros(0), function)
    value = np.log(4e4) + 2.0 * np.log(90.0)
    error = np.sqrt(4e-4 + 4.0 * 1e-4 + 4.0 * 9e-4)
    ends = value * np.exp(np.array([-Z, Z]) * error / value)
    np.testing.assert_allclose(found[0], (value, error, *ends), rtol=1e-6)
    second = 3.6e6 * np.sqrt(4e-4 + 2.0 * 1e-4 + 9e-4)
    np.testing.assert_allclose(found[1], (-3.6e6, second, -3.6e6 - Z * second, -3.6e6 + Z * second), rtol=1e-6)


def test_errors_refer_to_the_scale_of_each_number():
    """Entries of a matrix may have either sign; their scales are their first values, not the fitted ones."""
    machine = jv.from_matrices(np.eye(2), 0.1 * np.eye(2), [[3.0, -1.0], [-1.0, 2.0]], places=[[0]])
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(1.0), unbalance=0.05)])
    names, covariance = ("machine.stiffness[0]", "machine.stiffness[1]"), np.array([[4e-4, 3e-4], [3e-4, 9e-4]])

    def function(scene):
        return np.array([float(scene.machine.stiffness[0, 0] + 2.0 * scene.machine.stiffness[0, 1])])

    found = propagate(scene, names, np.array([2.0, 4.0]), covariance, np.zeros((2, 0)), np.zeros(0), function)
    slopes = np.array([1.0 * 2.0, 2.0 * 4.0])
    assert found[0].error == pytest.approx(np.sqrt(slopes @ covariance @ slopes), rel=1e-6)


@pytest.mark.parametrize(("error", "is_sure"), [(0.09, True), (0.11, False), (1e9, False)])
def test_function_along_an_undetermined_direction(error, is_sure):
    """The product m k changes along (1, 1)/sqrt(2), the ratio does not."""
    names, axis = ("machine.stiffness[0]", "machine.mass[1]"), np.array([[1.0], [1.0]]) / np.sqrt(2.0)

    def function(scene):
        k, m = float(scene.machine.stiffness[0]), float(scene.machine.mass[1])
        return np.array([k / m, np.sqrt(k * m)])

    scale, errors = np.array([4e4, 90.0]), np.array([error * np.sqrt(2.0)])
    found = propagate(scene_of(), names, scale, np.diag([1e-4, 1e-4]), axis, errors, function)
    assert found[0].error == pytest.approx(4e4 / 90.0 * np.sqrt(2e-4), rel=1e-6)
    assert np.isfinite(found[1].error) == (error * np.sqrt(2.0) * np.sqrt(0.5) < 0.1) == is_sure


def test_number_of_modes_may_change():
    """A damping at which a mode disappears leaves an unbounded interval."""

    def function(scene):
        return np.array([1.0, 2.0]) if float(scene.machine.damping[0]) <= 60.0 else np.array([1.0])

    found = propagate(scene_of(), ("machine.damping[0]",), np.full(1, 60.0), np.eye(1), np.zeros((1, 0)), np.zeros(0), function)
    assert [each[1:] for each in found] == [(np.inf, 0.0, np.inf)] * 2


def test_value_0_has_an_absolute_error():
    def function(scene):
        return np.array([float(scene.machine.stiffness[0]) - 4e4, 0.0])

    names, scale, no = ("machine.stiffness[0]",), np.array([4e4]), np.zeros((1, 0))
    found = propagate(scene_of(), names, scale, np.full((1, 1), 1e-4), no, np.zeros(0), function)
    np.testing.assert_allclose(found[0], (0.0, 400.0, -Z * 400.0, Z * 400.0), rtol=1e-6)
    assert found[1] == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("value", ["a", 1j, None, True])
def test_quantity_of_a_fit_is_a_real_number(value):
    parts = {"names": ("machine.stiffness[0]",), "scale": np.array([4e4]), "covariance": np.eye(1)}
    fit = SimpleNamespace(undetermined=(), scene=scene_of(), **parts)
    with pytest.raises(jv.InputError, match=r"quantity returns .*; it must return one real number"):
        jv.MachineFit.interval_of(fit, lambda scene: value)
    with pytest.raises(jv.InputError, match="quantity cannot be called with"):
        jv.MachineFit.interval_of(fit, lambda: value)


def test_quantity_of_a_fit_may_be_infinite():
    parts = {"names": ("machine.stiffness[0]",), "scale": np.array([4e4]), "covariance": np.eye(1)}
    fit = SimpleNamespace(undetermined=(), scene=scene_of(), **parts)
    assert jv.MachineFit.interval_of(fit, lambda scene: np.inf).error == np.inf


def test_quantity_of_a_fit_is_one_number():
    parts = {"names": ("machine.stiffness[0]",), "scale": np.array([4e4]), "covariance": np.eye(1)}
    fit = SimpleNamespace(undetermined=(), scene=scene_of(), **parts)
    with pytest.raises(jv.InputError, match=r"quantity returns an array of shape \(2,\); it must return one number"):
        jv.MachineFit.interval_of(fit, lambda scene: scene.machine.stiffness)


def problem_of(gains=(), unbalances=(None,), first=(4e4,)):
    number = find_number(scene_of(2), "machine.stiffness[0]", "unknown")
    unknowns = Unknowns((number,), np.array(first), np.array(first), np.array([True]), gains, 0)
    return SimpleNamespace(unknowns=unknowns, unbalances=unbalances, scene=scene_of(2))


def test_fitted_scene_has_the_fitted_values():
    problem = problem_of(unbalances=(None, Known(0.05, 1e-9)))
    scene = fitted_scene(problem, np.array([0.1]), np.array([0.03, -0.04, 3.0, 4.0, 9.0]))
    assert float(scene.machine.stiffness[0]) == pytest.approx(4e4 * np.exp(0.1)) and float(scene.machine.stiffness[1]) == 5e4
    np.testing.assert_allclose([each.unbalance for each in scene.exciters], [0.05, 0.05])
    scene = fitted_scene(problem_of(unbalances=(None, Known(0.05, 0.01))), np.zeros(1), np.array([0.03, -0.04, 0.3, 0.4, 9.0]))
    np.testing.assert_allclose([each.unbalance for each in scene.exciters], [0.05, 0.5])


def test_gains_have_the_errors_of_the_inverse():
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(30, 6))
    problem = problem_of(("a", "b"), (None,))
    fitted = SimpleNamespace(
        problem=problem, x=np.array([0.3, 0.02, -0.03]), linear=np.array([0.03, 0.04, 0.7]), information=slopes.T @ slopes,
        prior=np.diag([0.0, 9.0, 9.0, 0.0, 0.0, 0.0]),
    )  # fmt: skip
    errors = np.sqrt(np.diagonal(np.linalg.inv(fitted.information + fitted.prior)))[1:3]
    for each, x, error in zip(_gains(fitted), (0.02, -0.03), errors, strict=True):
        np.testing.assert_allclose(each, np.exp(x) * np.array([1.0, error, np.exp(-Z * error), np.exp(Z * error)]))
    fitted.problem = problem_of()
    fitted.x, fitted.information, fitted.prior = np.array([0.3]), np.eye(4), np.eye(4)
    assert _gains(fitted) == ()


def test_undetermined_combinations_return_to_the_first_values(monkeypatch):
    """The fit moves by (0.3, 0.5) in the stiffness and the unbalance; only the difference of both is determined."""
    problem = problem_of(unbalances=(None, Known(0.05, 1e-9)))
    axes = np.array([[1.0], [1.0]]) / np.sqrt(2.0)
    starts = []

    def fit_with_torques(problem, given):
        starts.append(given[0])
        return fitted_at(given[0][0], 0.5 if len(starts) < 2 else 0.0)

    def fitted_at(x, unbalance, converged=True, noise=1e-3):
        return Fitted(np.array([x]), np.array([unbalance]), problem, None, None, (), (np.array([noise]),), (), converged)

    def information_of(fitted):
        values = np.array([0.0, 0.05 * np.exp(fitted.linear[0])])
        return SimpleNamespace(undetermined=axes, values=values)

    monkeypatch.setattr(sys.modules[propagate.__module__], "fit_with_torques", fit_with_torques)
    monkeypatch.setattr(sys.modules[propagate.__module__], "information_of", information_of)
    found = _refit_near_first_values(scene_of(2), problem, fitted_at(0.3, 0.5))
    np.testing.assert_allclose(starts[0], [0.3 - 0.4])
    np.testing.assert_allclose(starts[1], [-0.1 - 0.5 * (-0.1 + 0.5)])
    assert len(starts) == 2 and found.x[0] == starts[1][0]
    starts.clear()
    lost = fitted_at(0.3, 0.5, converged=False)
    assert _refit_near_first_values(scene_of(2), problem, lost) is lost and starts == []
    monkeypatch.setattr(sys.modules[propagate.__module__], "fit_with_torques", lambda *_: lost)
    good = fitted_at(0.3, 0.5)
    assert _refit_near_first_values(scene_of(2), problem, good) is good
    worse = fitted_at(-0.1, 0.0, noise=1.02e-3)
    monkeypatch.setattr(sys.modules[propagate.__module__], "fit_with_torques", lambda *_: worse)
    assert _refit_near_first_values(scene_of(2), problem, good) is good
    axes = np.zeros((2, 0))
    assert _refit_near_first_values(scene_of(2), problem, good) is good


def test_prediction_in_words():
    found = RunPrediction(
        PredictionStatus.predicted, ("a note",), 0.3, ("a", "b"), np.array([0.1, 0.2]), np.array([1.25, np.nan]),
        np.arange(3.0), np.zeros((3, 2)), np.zeros((3, 2)),
    )  # fmt: skip
    assert found.summary().splitlines() == [
        "the fit predicts the run within its errors and the noise",
        "residuals: a 0.1 (1.25 times the noise of the fit), b 0.2",
        "a note",
    ]


@pytest.mark.parametrize(
    ("size", "p_values", "deviation", "status", "words"),
    [
        (0.1, (0.5, 0.5), 0.5, "predicted", []),
        (0.145, (0.5, 0.5), 0.5, "predicted", []),
        (0.16, (0.5, 0.5), 0.5, "patterned", ["the residuals of channel 'a' are 1.6 times the noise of the fit"]),
        (0.1, (0.5, 1e-6), 0.5, "patterned", ["the residuals of channel 'new' repeat with the rotor's angle"]),
        (0.1, (0.5, 0.5), 1e-6, "contradicted", ["the run deviates"]),
        (0.16, (0.5, 0.5), 1e-6, "contradicted", ["the residuals of channel 'a' are 1.6 times", "the run deviates"]),
    ],
)
def test_status_of_a_prediction(monkeypatch, size, p_values, deviation, status, words):
    """The second fitted run has another noise of the channel, which is compared; the channel `new` is in no run of the fit."""
    left = np.array([[size, 0.3], [-size, -0.3], [size, np.nan], [-size, np.nan]])
    mask, raw = ~np.isnan(left), np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]])
    channels = [SimpleNamespace(name="a"), SimpleNamespace(name="new")]
    problem = SimpleNamespace(
        runs=[SimpleNamespace(channels=channels)], angles=[np.array([[3.0, 4.0]])], masks=[mask], raw=[raw],
        times=[np.arange(4.0)], notes=("first",), linear=None,
    )  # fmt: skip
    at = SimpleNamespace(problem=problem, residuals=left, taps=["taps a", "taps new"])
    found = SimpleNamespace(p_value=deviation, sentence=lambda run: f"{run} deviates")
    rest = iter(zip(("taps a", "taps new"), left.T, p_values, strict=True))

    def p_value(values, taps, angle, count):
        name, column, own = next(rest)
        np.testing.assert_array_equal(values, column)
        assert taps == name and angle.tolist() == [3.0] and count == 0
        return own

    monkeypatch.setattr(predict, "_at_the_fit", lambda *_: at)
    monkeypatch.setattr(predict, "_deviation", lambda *_: found)
    monkeypatch.setattr(predict, "residual_p_value", p_value)
    noise, time = (np.array([9.0, 9.0]), np.array([0.1])), (np.arange(4.0),) * 2
    fit = SimpleNamespace(channels=(("a", "b"), ("a",)), noise=noise, time=time)
    run = predict.predict_run.__wrapped__(fit, None)
    assert (
        bool(run.status == getattr(PredictionStatus, status)) and run.notes[0] == "first" and len(run.notes) == 1 + len(words)
    )
    assert all(note.startswith(word) for note, word in zip(run.notes[1:], words, strict=True))
    np.testing.assert_allclose(run.noise, [size, 0.3])
    np.testing.assert_allclose(run.ratio, [size / 0.1, np.nan])
    np.testing.assert_array_equal(run.readings, np.where(mask, raw, np.nan))
    np.testing.assert_array_equal(run.predicted, raw - left)
    assert run.channels == ("a", "new") and run.p_value == deviation and run.time.tolist() == [0.0, 1.0, 2.0, 3.0]


@pytest.mark.parametrize(("own", "others"), [(0.001, 0.01), (0.01, 0.001), (0.003, 0.01), (0.01, 0.01)])
@pytest.mark.parametrize("white", [True, False])
def test_noise_is_compared_at_one_sampling_rate(own, others, white):
    """White noise of one spectral density, or a slow vibration; the residuals are twice those of the fit."""
    rng, times = np.random.default_rng(0), [step * np.arange(round(40.0 / step)) for step in (own, others)]
    left = [rng.normal(size=t.size) / np.sqrt(t[1]) if white else np.sin(9.0 * t) for t in times]
    parts = {"time": (times[1],), "noise": ([np.std(left[1])],), "readings": (left[1][:, None],), "fitted": (np.zeros((1, 1)),)}
    fit = SimpleNamespace(channels=(("a",),), **parts)
    assert predict._noise_ratio(fit, "a", times[0], 2.0 * left[0]) == pytest.approx(2.0, rel=0.06)
