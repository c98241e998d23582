"""Plans of runs: what a run shares with a fit, errors, benefits, and the optimized speed."""

import dataclasses
import functools
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

import jaxvib as jv
from jaxvib.identification.directions import eliminate
from jaxvib.identification.fit import model_readings
from jaxvib.identification.further_runs import plan, speed_profile
from jaxvib.identification.further_runs.plan import RunPlan, plan_runs
from jaxvib.identification.further_runs.planned import (
    Expected,
    PlannedRun,
    expected_errors,
    expected_information,
    expected_run,
    own_precisions,
    range_of_errors,
    shared_indices,
)
from jaxvib.identification.further_runs.speed_profile import Limits, _spread, optimized_profile, require_within

FRAME = jv.Channel("frame", "velocity", at=1, gain_error=0.02)
NAMES = ("machine.stiffness[0]", "exciters[0].unbalance", "machine.damping[0]")


@functools.cache
def fit():
    """Parts of a fit that a plan needs: two runs at 100 and 400 Hz; the first one has the noise of the frame."""
    drive = jv.RunUp(60.0, acceleration=6.0)
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    return SimpleNamespace(
        scene=jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=0.05)]),
        names=NAMES, scale=np.array([4e4, 0.05, 300.0]), gain_names=("deck", "frame"), phase=np.array([0.4]),
        channels=(("frame",), ("deck", "frame")), kinds=(("velocity",), ("velocity",) * 2),
        noise=(np.array([1e-3]), np.array([5e-3, 7e-3])),
        time=(0.01 * np.arange(3), 0.0025 * np.arange(3)), readings=(np.zeros((3, 1)), np.zeros((3, 2))),
        fitted=(np.zeros((3, 1)), np.zeros((3, 2))), information=np.diag([4e4, 100.0, 900.0, 1e4, 1e4, 400.0]),
    )  # fmt: skip


def ramp(duration=1.28, channels=(FRAME,), rate=100.0, **options):
    return PlannedRun("ramp", jv.SpeedProfile([0.0, 1.28], [5.0, 45.0]), duration, list(channels), rate=rate, **options)


def test_planned_run_has_the_numbers_and_the_noise_of_the_fit():
    found = expected_run(fit(), ramp())
    problem = found.fitted.problem
    np.testing.assert_allclose(problem.runs[0].weights[0, :, 0], 1.0 / 1e-3)  # all 128 readings, at the rate of the fit
    np.testing.assert_allclose(found.fitted.linear[:2], 0.05 * np.array([np.cos(0.4), np.sin(0.4)]))
    assert not np.any(found.fitted.linear[2:]) and not np.any(found.fitted.x)
    # Numbers, gain and unbalance; the runs have no common zero of the angle.
    assert found.indices_in_run.tolist() == [0, 1, 3, 2] and found.indices_in_fit.tolist() == [0, 2, 1, 4]
    np.testing.assert_allclose(problem.precisions, 0.0)  # the gain is known by the fit
    assert problem.unbalances == (None,)


@pytest.mark.parametrize(("noise", "deviation"), [({}, 5e-3 * 0.5), ({"deck": "9 mm/s"}, 9e-3)])
def test_noise_of_another_rate_and_of_new_channels(noise, deviation):
    """The deck was recorded at 400 Hz; at 100 Hz the same spectral density has half the deviation."""
    deck, tacho = jv.Channel("deck", "velocity", at=1), jv.Channel("tacho", "pulses")
    found = expected_run(fit(), ramp(channels=(deck, tacho), noise=noise))
    np.testing.assert_allclose(found.fitted.problem.runs[0].weights[0, :, 0], 1.0 / deviation)
    assert found.indices_in_run.tolist() == [0, 1, 2, 3] and found.indices_in_fit.tolist() == [
        0,
        2,
        1,
        5,
    ]  # no gain, but the mark of the angle
    with pytest.raises(jv.InputError, match="candidates: ramp: channel 'new' is new; give its noise, noise="):
        expected_run(fit(), ramp(channels=(jv.Channel("new", "velocity", at=1),)))
    with pytest.raises(jv.InputError, match="channel 'deck' is of kind displacement, but velocity in the fit"):
        expected_run(fit(), ramp(channels=(jv.Channel("deck", "displacement", at=1),)))


@pytest.mark.parametrize("rate", [100.0, 50.0, 200.0])
def test_coloured_noise_keeps_its_density_at_other_rates(rate):
    """The fit has noise with the correlation 0.9 of neighbours at 100 Hz."""
    white = 1e-3 * np.random.default_rng(0).normal(size=20000)
    left, taps = np.asarray(lfilter([1.0], [1.0, -0.9], white)), np.array([1.0, -0.9])
    parts = {"time": (0.01 * np.arange(20000),), "readings": (left[:, None],), "fitted": (np.zeros((20000, 1)),)}
    coloured = SimpleNamespace(
        **vars(fit()) | {"channels": (("frame",),), "kinds": (("velocity",),), "noise": ([np.std(left)],)} | parts
    )
    samples = expected_run(coloured, ramp(rate=rate)).fitted.problem.runs[0]
    for frequency in (0.5, 3.0, 10.0):  # Hz

        def density(taps, step, deviation, frequency=frequency):
            return deviation**2 * step / np.abs(np.polyval(taps[::-1], np.exp(-2j * np.pi * frequency * step))) ** 2

        found = density(np.asarray(samples.taps)[:, 0], 1.0 / rate, 1.0 / float(samples.weights.max()))
        assert found == pytest.approx(density(taps, 0.01, 1e-3), rel=0.15)


def test_outliers_of_the_fit_are_no_noise_of_a_plan():
    left = 1e-3 * np.random.default_rng(0).normal(size=20000)
    left[::50] *= 20.0
    parts = {"time": (0.01 * np.arange(20000),), "readings": (left[:, None],), "fitted": (np.zeros((20000, 1)),)}
    parts |= {"channels": (("frame",),), "kinds": (("velocity",),), "noise": ([np.std(left)],)}
    other = SimpleNamespace(**vars(fit()) | parts)
    samples = expected_run(other, ramp()).fitted.problem.runs[0]
    np.testing.assert_allclose(samples.weights[0, :, 0], 1.0 / 1e-3, rtol=0.05)


def test_information_of_a_run_is_in_the_units_of_the_fit():
    """If the scale of the damping is halved, a relative change of 1 changes the readings half as much."""
    other = SimpleNamespace(**vars(fit()) | {"scale": np.array([4e4, 0.05, 150.0])})
    first, second = (expected_information(each, expected_run(each, ramp())) for each in (fit(), other))
    factors = np.array([1.0, 1.0, 0.5, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(second, first * np.outer(factors, factors), rtol=1e-9, atol=1e-9 * np.max(first))


def test_new_gains_keep_their_known_errors():
    unknowns = SimpleNamespace(numbers=(1, 2), gains=("frame", "new"), count=4)
    problem = SimpleNamespace(unknowns=unknowns, precisions=np.array([0.0, 3.0, 25.0, 16.0]))
    assert own_precisions(fit(), problem).tolist() == [0.0, 3.0, 0.0, 16.0] and problem.precisions[2] == 25.0


def test_indices_of_shared_unknowns():
    named = tuple(SimpleNamespace(name=name) for name in ("machine.damping[0]", "machine.stiffness[0]"))
    unknowns = SimpleNamespace(numbers=named, gains=("new", "frame"), count=5)
    problem = SimpleNamespace(unknowns=unknowns, unbalances=(None,))
    for has_mark, pairs in ((False, [(0, 2), (1, 0), (5, 1), (3, 4)]), (True, [(0, 2), (1, 0), (5, 1), (3, 4), (6, 5)])):
        in_run, in_fit = shared_indices(fit(), problem, has_mark)
        assert list(zip(in_run.tolist(), in_fit.tolist(), strict=True)) == pairs
    shared = Expected(None, in_run[:2], in_fit[:2]).shared(np.diag([3.0, 4.0, 5.0]), 4)
    np.testing.assert_array_equal(shared, np.diag([4.0, 0.0, 3.0, 0.0]))


def test_information_is_that_of_the_slopes_of_the_readings():
    """Differences of the readings over stiffness, damping, gain, size and angle of the unbalance, free motion and offset."""
    expected = expected_run(fit(), ramp())
    fitted = expected.fitted
    problem, samples, step = fitted.problem, fitted.problem.runs[0], 1e-4

    def readings(x, size, angle, rest):
        linear = np.concatenate([rest[:2], size * np.array([np.cos(angle), np.sin(angle)]), rest[2:]])
        return np.asarray(model_readings(problem.unknowns, samples, problem.scene, jnp.asarray(x), jnp.asarray(linear)))[:, 0]

    columns = []
    for k in range(8):
        high, low = (
            readings(sign * step * np.eye(3, 8)[:, k], 0.05 * np.exp(sign * step * (k == 3)), 0.4 + sign * step * (k == 4),
                     sign * step * np.eye(3, 8, -5 + 10)[:, k] if k > 4 else np.zeros(3))
            for sign in (1.0, -1.0)
        )  # fmt: skip
        columns.append((high - low) / (2.0 * step * 1e-3))
    slopes = np.stack(columns, axis=1)
    matrix, own, others = slopes.T @ slopes, [0, 3, 1, 2], [4, 5, 6, 7]
    coupling = matrix[np.ix_(others, own)]
    inner = matrix[np.ix_(own, own)] - coupling.T @ np.linalg.inv(matrix[np.ix_(others, others)]) @ coupling
    found = expected_information(fit(), expected)
    # In the order of the fit: stiffness, unbalance, damping, the gain of the frame.
    places = [0, 1, 2, 4]
    np.testing.assert_allclose(found[np.ix_([0, 1, 2, 4], places)], inner[np.ix_([0, 1, 2, 3], [0, 1, 2, 3])], rtol=1e-4)
    assert not np.any(found[[3, 5]]) and not np.any(found[:, [3, 5]])


def test_expected_errors_eliminate_the_other_unknowns():
    slopes = np.random.default_rng(0).normal(size=(30, 4))
    matrix = 400.0 * slopes.T @ slopes
    np.testing.assert_allclose(expected_errors(matrix, 2), np.sqrt(np.diagonal(np.linalg.inv(matrix))[:2]), rtol=1e-9)
    assert expected_errors(np.diag([0.0, 100.0]), 2).tolist() == [np.inf, 0.1]


def test_gradient_of_short_runs_by_the_speed_is_the_difference():
    expected = expected_run(fit(), ramp())
    times, speeds = np.linspace(0.0, 1.28, 9), np.linspace(5.0, 45.0, 9) + np.array([0, 3, -2, 0, 4, -5, 0, 2, 0.0])
    value, gradient = _spread(fit(), expected, times, speeds)
    run = expected_run(fit(), eqx.tree_at(lambda each: each.drive, ramp(), jv.SpeedProfile(times, speeds)))
    information = fit().information + expected_information(fit(), run)
    variances = np.diagonal(np.linalg.inv(eliminate(information, np.arange(3)) + np.eye(3)))
    assert value == pytest.approx(0.5 * np.sum(np.log(variances)), rel=1e-6)
    step = 1e-3
    for k in (0, 3, 6):
        high, low = (_spread(fit(), expected, times, speeds + s * step * np.eye(9)[k])[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(gradient[k], (high - low) / (2.0 * step), rtol=1e-4, atol=1e-7)


def test_optimized_speed_stays_within_its_limits(monkeypatch):
    """An objective with its minimum at speeds that are too high, and that change too fast."""
    wanted, limits = np.array([0.0, 20.0, 30.0, 70.0, 50.0, 45.0, 40.0, 20.0, -9.0]), Limits(60.0, 15.0)
    monkeypatch.setattr(
        speed_profile, "_spread", lambda *args: (np.sum((args[3] - wanted) ** 2) / 50.0, (args[3] - wanted) / 25.0)
    )
    found = optimized_profile(None, ramp(16.0), None, limits)
    times, speeds = np.asarray(found.times), np.asarray(found.speeds)
    np.testing.assert_allclose(times, np.linspace(0.0, 16.0, 9))
    assert np.all(speeds >= 0.0) and np.all(speeds <= 60.0) and np.max(np.abs(np.diff(speeds))) <= 30.0 * (1.0 + 1e-6)
    # 70 rad/s is 40 above its neighbour: both move by the same amount until the limit of the speed.
    np.testing.assert_allclose(speeds, [0.0, 20.0, 30.0, 60.0, 50.0, 45.0, 40.0, 20.0, 0.0], atol=0.5)


def test_limits_hold_to_rounding():
    planned = ramp(1.28)
    require_within(planned, Limits(45.0 * (1.0 - 5e-7), 31.25 * (1.0 - 5e-7)))
    for limits, says in (
        (Limits(44.99, 40.0), "candidates: ramp: drive reaches"),
        (Limits(50.0, 31.2), r"has an acceleration of 31.25 rad/s\^2; limits.acceleration is 31.2 rad/s\^2"),
    ):
        with pytest.raises(jv.InputError, match=says):
            require_within(planned, limits)
    falling = PlannedRun("fall", jv.SpeedProfile([0.0, 1.0], [50.0, 0.0]), 1.0, [FRAME], rate=100.0)
    with pytest.raises(jv.InputError, match="has an acceleration of 50 rad/s"):
        require_within(falling, Limits(60.0, 40.0))


def planned_as(monkeypatch, errors, better=None, limits=None):
    """Return the plan of three candidates of 1, 2 and 3 minutes with given expected errors; now they are 0.2, inf, 0.1."""
    table = {name: np.diag(1.0 / np.asarray(each) ** 2) for name, each in errors.items()}
    if better is not None:
        table["optimized"] = np.diag(1.0 / np.asarray(better) ** 2)
    names, scene = ("mass", "stiffness", "damping"), SimpleNamespace(exciters=(), effects=())
    fit = SimpleNamespace(names=names, information=np.diag([25.0, 0.0, 100.0]), scene=scene)
    speed = jv.SpeedProfile([0.0, 1.0], [7.0, 8.0])
    monkeypatch.setattr(
        plan, "expected_run", lambda fit, each: "optimized" if isinstance(each.drive, jv.SpeedProfile) else each.name
    )
    monkeypatch.setattr(plan, "expected_information", lambda fit, name: table[name] - fit.information)
    factor = {"a": 2.0, "b": 1.0, "c": 1.0}
    monkeypatch.setattr(
        plan, "range_of_errors", lambda fit, each, errors: (errors / factor[each.name], errors * factor[each.name])
    )
    asked = []
    monkeypatch.setattr(plan, "optimized_profile", lambda *args: asked.append(args) or speed)
    candidates = [
        PlannedRun(name, jv.RunUp(30.0, acceleration=2.0), 60.0 * (k + 1), [FRAME], rate=100.0) for k, name in enumerate(errors)
    ]
    return plan.plan_runs.__wrapped__(fit, candidates, limits), asked, candidates, speed


ERRORS = {"a": (0.1, 0.5, 0.1), "b": (0.02, 0.1, 0.01), "c": (0.2, np.inf, 0.1)}
BENEFITS = {"a": np.log(2.0 * 2.0), "b": np.log(10.0 * 10.0 * 10.0) / 2.0, "c": 0.0}


def test_candidates_are_ordered_by_benefit_per_minute(monkeypatch):
    errors = {name: tuple(min(x, 1e9) for x in each) for name, each in ERRORS.items()}
    found, asked, _, _ = planned_as(monkeypatch, errors)
    assert found.candidates == ("b", "a", "c") and found.numbers == ("mass", "stiffness", "damping") and asked == []
    np.testing.assert_allclose(found.benefit, [BENEFITS[name] for name in "bac"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.errors, [ERRORS[name] for name in "bac"])
    np.testing.assert_allclose(found.now, [0.2, np.inf, 0.1])
    assert found.minutes.tolist() == [2.0, 1.0, 3.0] and found.profile is None
    assert found.summary().splitlines() == [
        "errors now: mass 0.2, stiffness not determined, damping 0.1",
        "b (2 min, benefit 3.45 per minute): mass 0.02, stiffness 0.1, damping 0.01",
        "a (1 min, benefit 1.39 per minute): mass 0.1 (0.05 to 0.2), stiffness 0.5 (0.25 to 1), damping 0.1 (0.05 to 0.2)",
        "c (3 min, benefit 0 per minute): mass 0.2, stiffness not determined, damping 0.1",
    ]


@pytest.mark.parametrize(("better", "first"), [((0.01, 0.1, 0.01), "b, optimized speed"), ((0.03, 0.1, 0.01), "b")])
def test_optimized_speed_is_a_candidate_if_it_is_better(monkeypatch, better, first):
    errors = {name: tuple(min(x, 1e9) for x in each) for name, each in ERRORS.items()}
    limits = {"speed": 40.0, "acceleration": 3.0}
    found, asked, candidates, speed = planned_as(monkeypatch, errors, better, limits)
    assert found.candidates[0] == first and asked[0][1:] == (candidates[1], "b", Limits(40.0, 3.0))
    is_better = first != "b"
    assert (found.profile is speed) == is_better and len(found.candidates) == 3 + is_better
    assert ("optimized speed: 66.85 rpm at 0 s, 76.39 rpm at 1 s" in found.summary()) == is_better
    if is_better:
        assert found.minutes[0] == 2.0
        np.testing.assert_allclose(found.errors[0], better)
        np.testing.assert_allclose(found.benefit[0], np.log(20.0 * 10.0 * 10.0) / 2.0)
    with pytest.raises(jv.InputError, match=r"limits\.speed is 95\.49 rpm"):
        planned_as(monkeypatch, errors, better, {"speed": 10.0, "acceleration": 3.0})


@pytest.mark.parametrize(("error", "factors"), [(0.3, [1.6, 0.4]), (5.0, [3.0, 0.1])])
def test_range_of_errors_is_that_of_the_unbalance(error, factors):
    """The information about the logarithm of the unbalance is proportional to its square; all else is known."""
    parts = vars(fit()) | {"information": np.diag([1e12, error**-2, 1e12, 1e12, 1e12, 1e12])}
    other = dataclasses.make_dataclass("Fit", parts)(**parts)
    errors = expected_errors(other.information + expected_information(other, expected_run(other, ramp())), 3)
    low, high = range_of_errors(other, ramp(), errors)
    of_run = [each[1] ** -2 - error**-2 for each in (errors, low, high)]
    np.testing.assert_allclose(np.sqrt(of_run[1:] / of_run[0]), factors, rtol=1e-5)
    accurate = dataclasses.replace(other, information=1e6 * other.information)
    np.testing.assert_array_equal(range_of_errors(accurate, ramp(), errors), [errors, errors])
    stopped = dataclasses.replace(other, scene=other.scene.replace(effects=jv.CubicSupport(1e9)))
    assert np.all(np.isnan(range_of_errors(stopped, ramp(), errors)))


def test_empty_plan_and_chart():
    with pytest.raises(jv.InputError, match="candidates is empty; give at least one PlannedRun"):
        plan_runs.__wrapped__(None, [])
    errors = np.array([[0.1, np.inf], [0.3, 0.2]])
    shown = RunPlan(("a", "b"), ("m", "k"), errors, errors, errors, errors[0], np.ones(2), np.ones(2), None).plot()
    (line,) = shown.axes[0].lines
    np.testing.assert_allclose(line.get_xdata(), [100.0, 100.0, 30.0])
    assert [each.get_text() for each in shown.axes[0].get_yticklabels()] == ["so far", "a", "b"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            dict(drive=jv.DCMotor(120.0, stall_torque=8.0, inertia=0.2)),
            "drive is 'dc_motor', whose speed depends",
        ),
        (dict(duration=0.0), "duration"),
        (dict(rate=-1.0), "rate"),
        (dict(noise={"deck": 1.0}), r"noise\['deck'\] is not of a channel of the run; its channels are: frame"),
        (dict(noise={"frame": "1 kg"}), r"noise\['frame'\]"),
        (dict(noise={"frame": 0.0}), r"noise\['frame'\]"),
    ],
)
def test_wrong_planned_runs_raise_clear_errors(change, says):
    values = dict(name="x", drive=jv.ConstantSpeed(30.0), duration=10.0, channels=[FRAME], rate=100.0) | change
    with pytest.raises(jv.InputError, match=f"^{says}"):
        PlannedRun(**values)


def test_planned_run_reads_units():
    found = PlannedRun(
        "x", jv.ConstantSpeed(30.0), "1 min", [FRAME], rate="1 kHz", noise={"frame": "2 mm/s"}, change={"a": "+1 kg"}
    )
    assert (found.duration, found.rate, found.noise, found.change) == (60.0, 1000.0, {"frame": 2e-3}, {"a": "+1 kg"})


@pytest.mark.parametrize(("duration", "rate"), [(4.0, 1e12), (1e308, 100.0), (1e308, 1e308)])
def test_runs_that_do_not_fit_into_memory_are_refused(duration, rate):
    with pytest.raises(jv.InputError, match=r"^samples \(duration times rate\) is "):
        PlannedRun("long", jv.RunUp(60.0, 6.0), duration, [FRAME], rate=rate)
