"""A bearing's friction from a swing: the fit against records made by SciPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter
from swings import ROD, T, noisy, scipy_swing, scipy_swings

import jaxvib as jv
from jaxvib.results.estimate import student_quantile
from jaxvib.runtime.compat import no_host_checks
from jaxvib.study.bearing.decrement import turning_points
from jaxvib.study.bearing.fit import _least_squares, first_guess, fit_swing, steps_for
from jaxvib.study.bearing.identify import _decay_time


@pytest.mark.parametrize("degrees", [2.0, 20.0, 40.0, 80.0])
def test_neither_formula_nor_fit_is_biased_by_large_swings(degrees):
    record = jv.Record(T, scipy_swing(ROD, T, np.deg2rad(degrees), 0.0, 1.5e-3)[0])
    np.testing.assert_allclose(jv.ten_periods(ROD, record).estimates[0], 1.5e-3, rtol=1.5e-3)
    np.testing.assert_allclose(jv.identify(ROD, record).viscous.value, 1.5e-3, rtol=1e-5)


@pytest.mark.parametrize("dry", [0.1, 0.15, 0.3])
@pytest.mark.parametrize("degrees", [5.0, 15.0, 30.0])
def test_records_that_end_at_rest_hold_both_frictions(degrees, dry):
    """At least three of four records with different noise give mu1 5e-4; no coefficient is below 0 without a message."""
    clean, stop = scipy_swing(ROD, T, np.deg2rad(degrees), 0.0, 5e-4, dry)
    held = 0
    for seed in range(4):
        found = jv.identify(ROD, jv.Record(T, 0.3 + noisy(clean, 5e-4, seed)), dry=True)
        held += found.viscous.low < 5e-4 < found.viscous.high and found.dry.low < dry < found.dry.high
        assert found.status_name == "found" and found.dry.value > 0.0
        assert found.viscous.value > 0.0 or any("mu1 cannot be distinguished from 0" in note for note in found.notes)
        assert not stop < 17.0 or (found.until < stop and any("left out" in note for note in found.notes))
    assert held >= 3


def test_what_comes_before_the_release_is_left_out():
    clean, _ = scipy_swing(ROD, T[:300], 0.3, 0.0, 1.5e-3)
    held_first = np.concatenate([np.full(100, 0.3), clean])
    found = jv.identify(ROD, jv.Record(T, noisy(held_first, 1e-3, 0)))
    assert found.status_name == "found" and found.viscous.low < 1.5e-3 < found.viscous.high


@pytest.mark.parametrize(
    ("law", "degrees", "note"),
    [
        (dict(air=2e-3), 10.0, "a law with drag of the air fits clearly better"),
        (dict(dry=0.02), 10.0, "a law with dry friction fits clearly better"),
        (dict(torque=0.1), 40.0, "a law with a constant torque fits clearly better"),
    ],
)
def test_better_law_is_named_by_the_fit_of_another(law, degrees, note):
    t = 0.05 * np.arange(800)
    clean, _ = scipy_swing(ROD, t, np.deg2rad(degrees), 0.0, 5e-4, **law)
    for seed in range(2):
        found = jv.identify(ROD, jv.Record(t, noisy(clean, 2e-3, seed)))
        assert found.status_name == "patterned" and found.structure > 3.0, (found.structure, found.pattern)
        assert any(note in said for said in found.notes), found.notes


@pytest.mark.parametrize(("law", "degrees"), [(dict(air=2e-3), 60.0), (dict(torque=0.1), 60.0)])
def test_intervals_contain_the_drag_of_the_air_and_the_torque(law, degrees):
    t = 0.05 * np.arange(800)
    clean, _ = scipy_swing(ROD, t, np.deg2rad(degrees), 0.0, 5e-4, **law)
    ((name, value),) = law.items()
    held = []
    for seed in range(4):
        found = jv.identify(ROD, jv.Record(t, 0.2 + noisy(clean, 2e-3, seed)), **{name: True})
        estimate = getattr(found, name)
        assert found.status_name == "found" and estimate.error < 0.1 * value
        held += [estimate.low < value < estimate.high, found.viscous.low < 5e-4 < found.viscous.high]
    assert sum(held) >= 6


def test_noise_alone_has_no_structure():
    t = 0.05 * np.arange(800)
    clean, _ = scipy_swing(ROD, t, 0.3, 0.0, 5e-4)
    found = [jv.identify(ROD, jv.Record(t, noisy(clean, 2e-3, seed))) for seed in range(20)]
    assert {each.status_name for each in found} == {"found"}
    assert abs(np.mean([each.structure for each in found]) - 1.0) < 4.0 * np.sqrt(2.0 / 20.0 / 20.0)


def many(records, t, dry, pendulum=ROD):
    """All records fitted at once."""
    guesses = [first_guess(pendulum, r, turning_points(r), dry) for r in records]
    start, width = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(a) for a in x]), *guesses)
    steps = steps_for(start, t)
    angles = jnp.asarray(np.stack([r.angle for r in records]))
    fit = eqx.filter_vmap(lambda a, s, w: fit_swing(pendulum, jnp.asarray(t), a, jnp.ones(t.size), s, w, steps))(
        angles, start, width
    )
    assert np.all(fit.converged)
    return fit


def trials(count, t, rng, noise, dry=None):
    """Records with every number drawn at random, and the mu1, mu2 in them."""
    drawn = []
    for _ in range(count):
        mu1 = rng.uniform(3e-4, 3e-3) if dry is None else rng.uniform(2e-4, 1e-3)
        mu2 = 0.0 if dry is None else rng.uniform(0.5, 1.5) * dry
        drawn.append((rng.uniform(0.15, 0.8), rng.uniform(-0.5, 0.5), rng.normal(), mu1, mu2))
    angle, rate, offset, *truth = np.array(drawn).T
    if dry is None:
        clean = scipy_swings(ROD, t, angle, rate, truth[0])
    else:
        clean = [scipy_swing(ROD, t, *one)[0] for one in zip(angle, rate, *truth, strict=True)]
    return [jv.Record(t, offset[k] + noisy(clean[k], noise, k)) for k in range(count)], np.stack(truth, axis=1)


def coverage(fit, truth, names, samples):
    """Number of intervals that hold the truth, and the spread of (found - truth)/error, for each of the numbers."""
    out = []
    for k, name in enumerate(names):
        error = np.sqrt(np.asarray(fit.covariance)[:, 4 + k, 4 + k])
        ratio = (np.asarray(getattr(fit.unknowns.friction, name)) - truth[:, k]) / error
        out.append((int(np.sum(np.abs(ratio) < student_quantile(samples - 4 - len(names)))), float(np.std(ratio))))
    return out


def test_identification_holds_mu1_in_its_interval():
    """190 of 200 intervals of 95 %, give or take 3, hold the number."""
    t = np.arange(0.0, 12.0, 0.06)
    records, truth = trials(200, t, np.random.default_rng(11), 3e-3)
    ((held, spread),) = coverage(many(records, t, False), truth, ["viscous"], t.size)
    assert 184 <= held <= 197
    assert 0.85 < spread < 1.15


def test_colored_noise_widens_the_interval():
    """Noise of the same size whose samples are correlated by 0.9: 24 of 25 intervals of 95 %, give or take 2, hold mu1."""
    clean, _ = scipy_swing(ROD, T, 0.4, 0.0, 8e-4)
    held = []
    for seed in range(25):
        white = np.random.default_rng(seed).normal(size=T.size)
        colored = lfilter([3e-3 * np.sqrt(1.0 - 0.9**2)], [1.0, -0.9], white)
        found = jv.identify(ROD, jv.Record(T, clean + colored), throw=False).viscous
        held.append(found.low < 8e-4 < found.high)
    assert sum(held) >= 21


@pytest.mark.slow
def test_intervals_contain_both_frictions():
    t = np.arange(0.0, 25.0, 0.06)
    records, truth = trials(200, t, np.random.default_rng(4), 2e-3, 0.02)
    for held, spread in coverage(many(records, t, True), truth, ["viscous", "dry"], t.size):
        assert 184 <= held <= 197 and 0.85 < spread < 1.15


@no_host_checks()  # programs with these are compiled anew each time
def test_a_whole_swing_down_to_rest_gives_both_frictions():
    clean, stop = scipy_swing(ROD, T, 0.2, 0.0, 8e-4, 0.09)
    found = jv.identify(ROD, jv.Record(T + 100.0, noisy(clean, 2e-4, 0)), dry=True)
    assert found.status_name == "found" and stop < 18.0
    assert abs(found.stopped_at - 100.0 - stop) < 0.2
    assert found.viscous.low < 8e-4 < found.viscous.high and found.viscous.error < 1e-5
    assert found.dry.low < 0.09 < found.dry.high and found.dry.error < 3e-4
    assert -1.0 < found.correlation < -0.5
    assert any("stops the pendulum at" in note for note in found.notes)


def test_notes_name_what_is_wrong_with_a_fit():
    t = T
    clean, _ = scipy_swing(ROD, t, 0.3, 0.0, 3e-4, 0.03)
    without = jv.identify(ROD, jv.Record(t, noisy(clean, 5e-4, 1)))
    assert without.status_name == "patterned" and any("identify mu2" in note for note in without.notes)
    frictionless = scipy_swing(ROD, t, 0.1, 0.0, 0.0)[0]
    nothing = [jv.identify(ROD, jv.Record(t, noisy(frictionless, 5e-3, k))) for k in range(3)]
    assert any(found.status_name == "undetermined" and "cannot be distinguished from 0" in found.notes[0] for found in nothing)
    heavier = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.008)
    clean, _ = scipy_swing(ROD, t, 0.3, 0.0, 1e-3)
    other = jv.identify(heavier, jv.Record(t, noisy(clean, 5e-4, 2)))
    assert "moment of inertia" in other.notes[0]
    np.testing.assert_allclose(other.inertia, 0.025, rtol=1e-3)
    np.testing.assert_allclose(other.viscous.value / 1e-3, float(heavier.total_inertia) / 0.025, rtol=2e-2)
    faster_and_faster = 0.2 * np.sin(4.0 * t + 0.15 * t**2)
    with pytest.raises(jv.ComputationError, match="not_converged: record: no fit was found"):
        jv.identify(ROD, jv.Record(t, faster_and_faster))


def test_a_sum_of_squares_too_small_by_chance_ends_no_fit():
    """An error of the integration makes one point, a standard error from the minimum, better than all others."""
    t = np.linspace(0.0, 1.0, 200)
    data = np.exp(-1.3 * t) + 0.01 * np.random.default_rng(0).normal(size=t.size)

    def model(x):
        return x[1] * jnp.exp(-x[0] * t) - data

    right = least_squares(model, [1.0, 1.0], xtol=1e-12)
    error = np.sqrt(np.diagonal(np.linalg.inv(right.jac.T @ right.jac)) * 2.0 * right.cost / (t.size - 2))
    start = jnp.asarray(right.x + error * [1.0, 0.0])

    def residual(x):
        value = jnp.where(jnp.all(x == start), 0.9, 1.0) * model(x)
        return value, (value, jnp.asarray(0.0), value)

    x, *_, converged = _least_squares(residual, start, jnp.asarray(200.0))
    assert bool(converged)
    np.testing.assert_array_less(np.abs(x - right.x), 0.1 * error)


def test_student_quantile_is_that_of_the_printed_table():
    """R. A. Fisher, Statistical methods for research workers, 1925, table IV, probability 0.05 of both sides."""
    table = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 5: 2.571, 10: 2.228, 30: 2.042, 120: 1.980}
    for freedom, quantile in table.items():
        np.testing.assert_allclose(student_quantile(freedom), quantile, atol=5e-4)


def test_a_growing_swing_and_a_wrong_length_are_named():
    t = np.arange(0.0, 20.0, 0.04)
    grows = jv.identify(ROD, jv.Record(t, noisy(scipy_swing(ROD, t, 0.1, 0.0, -1e-3)[0], 1e-3, 0)))
    assert grows.viscous.high < 0.0 and grows.status_name == "negative" and "whole interval" in grows.notes[0]
    clean = noisy(scipy_swing(ROD, t, 0.3, 0.0, 1e-3)[0], 1e-3, 0)
    for length, inertia, status in ((0.25, 0.00625, "found"), (0.26, 0.00625, "found"), (0.4, 0.0, "contradicted")):
        told = jv.BearingPendulum(mass=0.3, length=length, inertia=inertia)
        assert jv.identify(told, jv.Record(t, clean)).status_name == status, length


def test_decay_of_a_swing_with_few_turning_points():
    time, w = np.arange(0.0, 6.0, 0.02), float(ROD.frequency)
    turns = turning_points(jv.Record(time, 0.5 * np.exp(-0.6 * w * time) * np.sin(w * time)))
    assert turns.time.size == 4 and _decay_time(turns) == turns.time[-1]
