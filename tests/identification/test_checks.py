"""Status of a fit, and the statistics behind it, against SciPy."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2, f

from jaxvib.identification import checks
from jaxvib.identification.checks import (
    FitStatus,
    coverage_notes,
    disagreement,
    pseudoinverse,
    resembles,
    residual_p_value,
    status_of,
)
from jaxvib.identification.problem import Known


def channel(name):
    return SimpleNamespace(name=name)


def test_p_value_of_residuals_is_that_of_an_f_test():
    rng, n, taps = np.random.default_rng(3), 3000, np.array([1.0, -0.4, 0.2])
    angle = np.linspace(0.0, 200.0, n) ** 1.2
    left = rng.normal(size=n) + 0.15 * np.cos(angle) + 0.2 * np.sin(2.0 * angle) - 0.2 * np.cos(3.0 * angle)
    left[[0, 700, 701, 1500]] = np.nan
    known = np.where(np.isnan(left), 0.0, left)
    white = known.copy()
    white[1:] += taps[1] * known[:-1]
    white[2:] += taps[2] * known[:-2]
    missing = np.isnan(left)
    gone = missing.copy()
    gone[1:] |= missing[:-1]
    gone[2:] |= missing[:-2]
    gone[:2] = True
    explained, place = 0.0, np.flatnonzero(~gone)
    for part in np.array_split(place, 16):
        waves = [np.ones(part.size)] + [wave(k * angle[part]) for k in (1, 2, 3) for wave in (np.cos, np.sin)]
        basis = np.stack(waves, axis=1)
        explained += np.sum((basis @ np.linalg.lstsq(basis, white[part], rcond=None)[0]) ** 2)
    columns, found = 16 * 7, 5
    rest = (np.sum(white[place] ** 2) - explained) / (place.size - columns)
    p_value = f.sf(explained / (columns - found) / rest, columns - found, place.size - columns)
    assert residual_p_value(left, taps, angle, found) == pytest.approx(p_value, rel=1e-9) and 1e-9 < p_value < 0.5
    assert residual_p_value(left[:890], taps, angle[:890], found) == 1.0  # too short
    assert residual_p_value(0.0 * left, taps, angle, found) == 1.0


def test_rotor_at_rest_has_no_orders():
    """The waves of a constant angle are one column in place of seven."""
    rng, n = np.random.default_rng(3), 3200
    left = rng.normal(size=n) + np.repeat(0.15 * rng.normal(size=16), 200)
    means = np.mean(left.reshape(16, 200), axis=1)
    explained, total = 200.0 * np.sum(means**2), np.sum(left**2)
    p_value = f.sf(explained / 12 / ((total - explained) / (n - 16)), 12, n - 16)
    assert residual_p_value(left, np.ones(1), np.full(n, 0.3), 4) == pytest.approx(p_value, rel=1e-9)


def test_disagreement_is_a_ratio_of_likelihoods():
    """Values of two numbers with the information A by other runs, and with B by this run."""
    a, b = np.array([[400.0, 30.0], [30.0, 900.0]]), np.array([[100.0, -20.0], [-20.0, 50.0]])
    away = np.array([0.3, -0.1])
    gradient = b @ np.linalg.inv(a + b) @ a @ away
    found = disagreement(a, b, gradient, ["mass", "stiffness"])
    statistic = away @ np.linalg.inv(np.linalg.inv(a) + np.linalg.inv(b)) @ away
    assert found.p_value == pytest.approx(chi2.sf(statistic, 2), rel=1e-9)
    # A change of one number alone: weighted mean of the differences, with the information A (A + B)^-1 B about them.
    shared = np.diagonal(a @ np.linalg.inv(a + b) @ b)
    assert found.name == "mass"
    assert found.change == pytest.approx(gradient[0] / shared[0]) and found.error == pytest.approx(shared[0] ** -0.5)
    text = (
        f"run 2 deviates from the others by more than their errors (p-value {found.p_value:.1g}); a relative change of mass by "
    )
    assert found.sentence("run 2") == text + f"{found.change:+.3g} +- {1.96 * found.error:.1g} explains most of it"


@pytest.mark.parametrize("rounding", [-1e-13, 1e-13])
def test_rounding_errors_are_no_information_about_a_difference(rounding):
    """The run has no information about the second unknown; its rounding errors have either sign."""
    others, run = np.diag([400.0, 300.0]), np.array([[100.0, 1e-9], [1e-9, rounding]])
    found = disagreement(others, run, np.array([20.0, 1e-5]), ["mass", "angle"])
    expected = disagreement(others[:1, :1], run[:1, :1], np.array([20.0]), ["mass"])
    assert found.name == "mass"
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-6)


@pytest.mark.parametrize(("others", "run"), [(0.0, 100.0), (400.0, 0.0)])
def test_numbers_of_one_side_alone_cannot_disagree(others, run):
    nothing = disagreement(np.array([[others]]), np.array([[run]]), np.array([5.0]), ["mass"])
    assert nothing == (1.0, "mass", 0.0, np.inf)
    both = disagreement(np.diag([others, 4.0]), np.diag([run, 9.0]), np.array([0.0, 6.0]), ["mass", "stiffness"])
    assert both.name == "stiffness" and both.p_value == pytest.approx(chi2.sf(36.0 * (1.0 / 4.0 + 1.0 / 9.0), 1))


def test_pseudoinverse_is_on_the_scale_of_the_diagonal():
    slopes = np.random.default_rng(0).normal(size=(9, 3)) * np.array([1e-6, 1.0, 1e6])
    inverse, rank = pseudoinverse(slopes.T @ slopes)
    np.testing.assert_allclose(inverse, np.linalg.inv(slopes.T @ slopes), rtol=1e-8)
    assert rank == 3
    slopes[:, 2] = 1e6 * slopes[:, 1]
    inverse, rank = pseudoinverse(slopes.T @ slopes)
    assert rank == 2
    np.testing.assert_allclose(slopes.T @ slopes @ inverse @ slopes.T @ slopes, slopes.T @ slopes, rtol=1e-8)
    assert pseudoinverse(np.zeros((2, 2)))[1] == 0


def test_contradicted_values_are_named():
    unknowns = SimpleNamespace(numbers=(channel("machine.mass"), channel("machine.damping")), gains=("frame",))
    problem = SimpleNamespace(
        unknowns=unknowns, means=np.array([0.1, 0.0, 0.0, 0.0]), precisions=np.array([1e4, 0.0, 1e4, 0.0]),
        unbalances=(None, Known(5.0, 0.1), Known(13.0, 0.1)),
    )  # fmt: skip
    fitted = SimpleNamespace(
        problem=problem, x=np.array([0.2, 9.0, -0.05, 9.0]), linear=np.array([9, 9, 3, 4.0, 12.39, 5, 1.0])
    )
    found = list(checks._contradictions(fitted))
    assert found == [
        "machine.mass is 10.0 standard errors away from its known value",
        "the gain of channel 'frame' is 5.0 standard errors away from its known value",
    ]
    fitted.linear[2:4] *= 1.1
    assert list(checks._contradictions(fitted))[2:] == [
        "exciters[1].unbalance is 5.0 standard errors away from its known value"
    ]


def test_resemblance_is_the_share_of_the_best_channel():
    raw = np.array([[2.0, 10.0], [-2.0, -10.0], [2.0, 10.0], [500.0, -10.0]])
    mask = np.array([[True, True], [True, True], [True, True], [False, True]])
    problem = SimpleNamespace(raw=(raw,), masks=(mask,))
    for share, converged, expected in ((0.49, True, True), (0.51, True, False), (0.49, False, False)):
        differences = (raw * np.array([share, 0.9]),)
        assert resembles(SimpleNamespace(problem=problem, differences=differences, converged=converged)) is expected


def runs_of(time, speeds):
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(time))])
    return SimpleNamespace(problem=SimpleNamespace(times=(time,), angles=(angle[:, None],)))


@pytest.mark.parametrize(
    ("frequency", "until", "words"),
    [
        ([30.0, 60.0], 10.0, []),
        (
            [60.0, 80.0],
            10.0,
            ["passes through a resonance: the rotors turn at 10 to 50 rad/s", "are 60, 80 rad/s;"],
        ),
        ([9.0], 40.0, ["no run passes through a resonance"]),
        ([30.0], 6.5, ["run 1 lasts 6.5 s, less than two decay times of the mode that decays most slowly (3.33 s each)"]),
        ([], 10.0, []),
    ],
)
def test_coverage_of_runs_in_words(frequency, until, words):
    time = np.linspace(1.0, 1.0 + until, 2001)
    run = runs_of(time, np.linspace(10.0, 50.0, 2001))
    found = list(coverage_notes(run, np.array(frequency), np.full(len(frequency), 0.01)))
    assert (len(found) > 0) == (len(words) > 0) and all(word in found[0] for word in words)


def test_runs_far_from_a_resonance_state_all_their_speeds():
    slow, fast = (
        runs_of(np.linspace(0.0, 10.0, 2001), np.linspace(*ends, 2001)).problem for ends in ((10.0, 12.0), (40.0, 50.0))
    )
    both = SimpleNamespace(problem=SimpleNamespace(times=fast.times + slow.times, angles=fast.angles + slow.angles))
    (found,) = coverage_notes(both, np.array([30.0]), np.array([0.1]))
    assert "no run passes through a resonance: the rotors turn at 10 to 50 rad/s" in found


def test_a_mode_without_decay_asks_for_its_damping():
    time = np.linspace(0.0, 10.0, 2001)
    (found,) = coverage_notes(runs_of(time, np.linspace(10.0, 50.0, 2001)), np.array([30.0, 40.0]), np.array([0.1, 0.0]))
    assert "a mode of the fitted machine does not decay" in found and found.endswith("check its damping")


def outcome(monkeypatch, **changes):
    """Return the status of a fit of one run with two channels, from the results of its checks."""
    given = {
        "contradictions": [],
        "disagreements": [],
        "foreign": [],
        "fits": True,
        "p_values": (0.5, 0.3),
        "shares": (0.0, 0.0),
    }
    given |= (
        {"errors": (0.01, 0.02), "outliers": (0.0, 0.0), "undetermined": 0, "misfits": (1.9,)} | {"absorbed": False} | changes
    )
    p_values = iter(given["p_values"])
    monkeypatch.setattr(checks, "_contradictions", lambda fitted: given["contradictions"])
    monkeypatch.setattr(checks, "_disagreements", lambda fitted: given["disagreements"])
    monkeypatch.setattr(checks, "_foreign_vibrations", lambda fitted, fits: given["foreign"] if fits == given["fits"] else None)
    monkeypatch.setattr(checks, "resembles", lambda fitted: given["fits"])
    monkeypatch.setattr(checks, "angle_shares", lambda fitted: [np.array(given["shares"])])

    def p_value(left, taps, angle, found):
        assert left.tolist() == taps.tolist() and angle.tolist() == [7.0] and found == 3
        return next(p_values)

    monkeypatch.setattr(checks, "residual_p_value", p_value)
    rotors = [tuple(SimpleNamespace(error=each) for each in given["errors"])]
    two = np.array([[1.0, 2.0]])
    runs = [SimpleNamespace(channels=(channel("a"), channel("b")), taps=two)]
    unknowns = SimpleNamespace(count=5, errors=2)
    problem = SimpleNamespace(
        unknowns=unknowns, rotors=rotors, runs=runs, angles=[np.array([[7.0, 8.0]])], angle_errors=[0.05], has_loads=False
    )
    fitted = SimpleNamespace(
        problem=problem, residuals=[two], outliers=[np.array(given["outliers"])], x=np.zeros(5), misfits=given["misfits"],
        is_absorbed=given["absorbed"],
    )  # fmt: skip
    status, least, notes = status_of(fitted, SimpleNamespace(undetermined=np.zeros((2, given["undetermined"]))))
    return status, least, notes


@pytest.mark.parametrize(
    ("changes", "status", "least", "words"),
    [
        ({}, "found", 0.3, []),
        ({"undetermined": 1}, "undetermined", 0.3, []),
        ({"contradictions": ["no"]}, "contradicted", 0.3, ["no"]),
        ({"disagreements": ["never"]}, "contradicted", 0.3, ["never"]),
        ({"fits": False}, "not_converged", 0.3, []),
        ({"fits": False, "foreign": ["another"]}, "contradicted", 0.3, ["another"]),
        ({"foreign": ["another"]}, "patterned", 0.3, ["another"]),
        ({"p_values": (1e-6, 0.3)}, "patterned", 1e-6, ["the residuals of channel 'a' in run 1 repeat with the rotor's angle"]),
        (
            {"p_values": (2e-5, 2e-6)},
            "patterned",
            2e-6,
            ["the residuals of channel 'b' in run 1 repeat with the rotor's angle"],
        ),
        ({"errors": (0.31, 0.02)}, "patterned", 0.3, ["the rotor's angle in run 1 has the standard error 0.31 rad between"]),
        ({"errors": (0.29, 0.02)}, "found", 0.3, []),
        (
            {"shares": (0.0, 0.12)},
            "patterned",
            0.3,
            ["an error of 0.05 rad of the rotor's angle in run 1, which causes 12 % of the"],
        ),
        ({"shares": (0.0, 0.09)}, "found", 0.3, []),
        ({"misfits": (0.9, 2.1)}, "patterned", 0.3, ["run 2 deviates from the torque balance of its motor by 2.1"]),
        ({"absorbed": True}, "patterned", 0.3, ["no noise model distinguishes such residuals from the motion of the machine"]),
        ({"outliers": (0.02, 0.0)}, "found", 0.3, ["2.0 % of the readings of channel 'a' in run 1 are outliers"]),
    ],
)
def test_status_follows_from_the_checks(monkeypatch, changes, status, least, words):
    found = outcome(monkeypatch, **changes)
    assert bool(found[0] == getattr(FitStatus, status)) and found[1] == least and len(found[2]) == len(words)
    assert all(word in note for word, note in zip(words, found[2], strict=True))


@pytest.mark.parametrize(
    ("fits", "share", "order", "size", "words"),
    [
        (True, 0.6, None, 1.0, "60 % of the power of the residuals of channel 'a' in run 1 is at 9 Hz, but an unbalance turns"),
        (True, 0.4, None, 1.0, ""),
        (True, 0.6, None, 0.09, ""),  # residuals like noise
        (True, 0.6, 2.0, 0.09, "60 % of the power of the residuals"),
        (False, 0.6, None, 0.09, "60 % of the power of the readings"),
    ],
)
def test_foreign_vibration_in_words(monkeypatch, fits, share, order, size, words):
    raw = np.array([[1.0], [-1.0], [90.0]])
    mask, left = np.array([[True], [True], [False]]), np.array([[size], [-size], [np.nan]])

    def foreign(values, angle, step):
        np.testing.assert_array_equal(values, [size, -size, np.nan] if fits else [1.0, -1.0, np.nan])
        assert angle.tolist() == [1.0, 2.0, 3.0] and step == 0.5
        return SimpleNamespace(share=share, order=order, frequency_text="at 9 Hz")

    monkeypatch.setattr(checks, "foreign_vibration", foreign)
    samples = SimpleNamespace(channels=(channel("a"),), step=0.5)
    angles = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    problem = SimpleNamespace(unbalances=(None,), runs=[samples], raw=[raw], masks=[mask], angles=[angles], has_loads=False)
    problem.linear = None
    fitted = SimpleNamespace(problem=problem, residuals=[left])
    found = list(checks._foreign_vibrations(fitted, fits))
    assert (found == []) == (words == "") and all(words in each for each in found)
    problem.unbalances = (None, None)
    assert list(checks._foreign_vibrations(fitted, fits)) == []
    problem.unbalances, problem.has_loads, problem.linear = (None,), True, np.zeros(1)  # loads turn at other speeds
    found = list(checks._foreign_vibrations(fitted, fits))
    assert (found == []) == (words == "" or not fits) and all("the motion of the loads is not that" in each for each in found)


def test_runs_are_compared_at_their_common_minimum(monkeypatch):
    """Two runs about three unknowns: a mass, the zero of a run's angle, and (a, b) of the unbalance; the fit is not exact."""
    rng = np.random.default_rng(0)
    rows = [rng.normal(size=(40, 4)) for _ in range(2)]
    away = [np.array([0.0, 0.0, 0.0, 0.0]), np.array([0.9, 0.0, 0.0, 0.0])]
    at = np.array([0.3, 0.1, 0.4, 0.3])  # not the minimum; a and b are the last two
    equations = []
    for row, true in zip(rows, away, strict=True):
        z = np.concatenate([10.0 * row, 10.0 * (row @ (true - 0.05 * at))[:, None]], axis=1)
        equations.append(z.T @ z)
    known = np.diag([4.0, 0.0, 0.0, 0.0]), np.array([-4.0 * 0.05 * at[0], 0.0, 0.0, 0.0])
    monkeypatch.setattr(checks, "run_equations", lambda *_: equations)
    monkeypatch.setattr(checks, "prior_equations", lambda *_: known)
    unknowns = SimpleNamespace(numbers=(channel("machine.mass"),), gains=(), turns=1, errors=0, count=2)
    problem = SimpleNamespace(runs=[1, 2], unbalances=(None,), unknowns=unknowns)
    fitted = SimpleNamespace(problem=problem, x=at[:2], linear=at[2:])
    (sentence,) = (each for each in checks._disagreements(fitted) if each.startswith("run 2"))
    # By elimination of the zero of the angle, in the size and the angle of the unbalance.
    turn = np.eye(4)
    turn[2:, 2:] = [[0.4, -0.3], [0.3, 0.4]]
    own = [0, 2, 3]
    parts = []
    for matrix, gradient in [(each[:-1, :-1], each[:-1, -1]) for each in equations] + [known]:
        matrix, gradient = turn.T @ matrix @ turn, turn.T @ gradient
        rest = matrix[1, own] / matrix[1, 1] if matrix[1, 1] > 0.0 else np.zeros(3)
        parts.append((matrix[np.ix_(own, own)] - np.outer(rest, matrix[1, own]), gradient[own] - rest * gradient[1]))
    total = sum(part for part, _ in parts)
    moved = np.linalg.solve(total, sum(gradient for _, gradient in parts))
    part, gradient = parts[1]
    names = ["machine.mass", "the size of exciters[0].unbalance", "the angle (rad) of exciters[0].unbalance"]
    assert sentence == disagreement(total - part, part, gradient - part @ moved, names).sentence("run 2")
    problem.runs = [1]
    assert list(checks._disagreements(fitted)) == []
