"""Machines fitted to run-ups that SciPy integrates, with noise."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from run_ups_by_scipy import TOP, TRUTH, Ramp, accelerations, bound, free_motions, ramp, record, scene_of

import jaxvib as jv
from jaxvib.identification.directions import _kind_with_kg

T = 0.002 * np.arange(8000)
NOISE = 0.05
NAMES = ("machine.stiffness", "machine.damping", "machine.link_stiffness", "machine.link_damping", "exciters[0].unbalance")


@functools.cache
def clean(**changes):
    return accelerations(T, [TRUTH | {name.replace("__", "."): value for name, value in changes.items()}])[0]


def start(stiffness=1.0, damping=1.0, mass=1.0):
    """Return the scene with first values away from the truth by factors."""
    factors = {"stiffness": stiffness, "damping": damping, "mass": mass}
    factor = {name: next((f for word, f in factors.items() if word in name), 1.0) for name in TRUTH}
    return scene_of({name: value * factor[name] for name, value in TRUTH.items()})


def run_of(seed=0, noise=NOISE, **options):
    return record(T, clean(), noise, np.random.default_rng(seed), **options)


def distances(fit):
    """Return (fitted - true)/error of each determined number."""
    return np.array(
        [
            (each.value - TRUTH[name]) / each.error
            for name, each in zip(fit.names, fit.estimates, strict=True)
            if np.isfinite(each.error)
        ]
    )


@functools.cache
def fitted():
    return jv.identify(start(1.1, 1.5), run_of(), unknown=NAMES)


def test_vanishing_damping_has_an_upper_bound():
    """The least cost lies at a negative damping. The cost rises by 1.96^2 to the bound."""
    times, name = T[::8], "machine.damping[1]"
    run = record(times, accelerations(times, [TRUTH | {name: 0.0}])[0], NOISE, np.random.default_rng(0))
    fit = jv.identify(start(), run, unknown=NAMES)
    found = fit.estimate(name)
    assert fit.status_name == "found" and fit.undetermined == ()
    assert found.low == 0.0 and 20.0 * found.value < found.high < 3.0
    assert any(f"{name} is not distinguishable from 0; it is at most {found.high:.3g} N s/m" in note for note in fit.notes)

    def cost(value):
        held = jv.identify(start(), run, unknown=NAMES, known={name: value})
        return np.nansum(((held.readings[0] - held.fitted[0]) / fit.noise[0]) ** 2)

    assert cost(found.high) - cost(1e-6) == pytest.approx(1.96**2, rel=0.06)


def test_fit_finds_the_numbers_from_wrong_first_values():
    fit = fitted()
    assert fit.status_name == "found" and fit.undetermined == ()
    assert np.max(np.abs(distances(fit))) < 4.0
    assert abs(fit.phase[0] - 0.4) < 1e-3
    np.testing.assert_allclose(fit.noise[0], NOISE, rtol=0.03)
    np.testing.assert_allclose(np.nanstd(fit.readings[0] - fit.fitted[0], axis=0), NOISE, rtol=0.03)
    assert fit.estimate("machine.link_stiffness[0]").error < 40.0
    np.testing.assert_allclose(fit.scene.machine.stiffness, [5e4, 6e4], rtol=3e-3)
    assert float(fit.scene.exciters[0].unbalance) == pytest.approx(fit.estimate("exciters[0].unbalance").value, rel=1e-12)


def test_model_agrees_with_scipy_without_noise():
    fit = jv.identify(start(1.02, 1.1), run_of(noise=1e-6), unknown=NAMES, throw=False)
    values = np.array([each.value for each in fit.estimates])
    np.testing.assert_allclose(values, [TRUTH[name] for name in fit.names], rtol=1e-5)


def test_errors_are_those_of_the_cramer_rao_bound():
    fit = fitted()
    found = [each.error / each.value for each in fit.estimates]
    np.testing.assert_allclose(found, bound(T, fit.names, NOISE), rtol=0.05)


def test_long_record_has_the_errors_of_all_its_readings():
    """At 2 kHz the record has four times as many readings of the same noise as at 500 Hz, and is filtered to 167 Hz."""
    times = 0.0005 * np.arange(32_000)
    run = record(times, accelerations(times, [TRUTH])[0], NOISE, np.random.default_rng(7))
    fit = jv.identify(start(1.05, 1.2), run, unknown=NAMES)
    assert fit.status_name == "found" and any("rate was lowered from 2000 to 166.667 Hz" in note for note in fit.notes)
    assert np.max(np.abs(distances(fit))) < 4.0
    ratio = [each.error / other.error for each, other in zip(fit.estimates, fitted().estimates, strict=True)]
    np.testing.assert_allclose(ratio, 0.5, rtol=0.05)


@pytest.mark.slow
def test_intervals_hold_the_truth_in_repeated_records():
    ratios = np.array([distances(jv.identify(start(), run_of(seed), unknown=NAMES)) for seed in range(1, 25)])
    assert 0.9 < np.mean(np.abs(ratios) < 1.96) < 0.99
    assert np.all(np.abs(np.mean(ratios, axis=0)) < 4.0 / np.sqrt(24.0))
    assert 0.85 < np.std(ratios) < 1.15


@pytest.mark.slow
def test_intervals_hold_the_truth_in_six_records():
    ratios = np.array([distances(jv.identify(start(), run_of(seed), unknown=NAMES)) for seed in range(1, 7)])
    assert np.mean(np.abs(ratios) < 1.96) > 0.8
    assert np.all(np.abs(ratios) < 4.0)


@functools.cache
def everything_free():
    return jv.identify(start(1.05), run_of(), unknown=[*NAMES, "machine.mass"])


@functools.cache
def with_added_mass():
    noise = np.random.default_rng(1)
    heavier = record(T, clean(**{"machine__mass[0]": 130.0}), NOISE, noise, change={"machine.mass[0]": "+10 kg"})
    return jv.identify(start(1.05, mass=1.03), [run_of(), heavier], unknown=[*NAMES, "machine.mass"])


def test_common_factor_of_all_numbers_is_undetermined():
    fit = everything_free()
    assert fit.status_name == "undetermined" and len(fit.undetermined) == 1
    assert fit.undetermined[0].sentence.startswith("multiplying all masses, stiffnesses, dampings and unbalances by one number")
    np.testing.assert_allclose(fit.undetermined[0].weights, 1.0 / 3.0)
    assert all(np.isinf(each.high) and np.isinf(each.error) for each in fit.estimates)
    model = jv.natural_frequencies(scene_of(TRUTH))
    np.testing.assert_allclose([each.value for each in fit.frequency], model, rtol=1e-3)
    assert all(each.error < 1e-3 * each.value for each in fit.frequency)


def test_places_and_torques_do_not_share_the_common_factor():
    inside = ("machine.mass[0]", "machine.link_damping", "exciters[1].unbalance", "exciters[0].drive.inertia")
    assert all(map(_kind_with_kg, inside))
    assert [_kind_with_kg(f"drive.{name}") for name in ("power", "bearing")] == ["powers", "frictions of bearings"]
    assert not any(map(_kind_with_kg, ("machine.supports[0].angle", "machine.supports[1].at[0]")))


def test_known_mass_that_is_added_determines_all_numbers():
    fit = with_added_mass()
    assert fit.status_name == "found"
    assert np.max(np.abs(distances(fit))) < 4.0
    assert fit.estimate("machine.mass[0]").error < 0.5


def test_known_mass_with_an_error_widens_all_intervals():
    fit = jv.identify(start(1.05), run_of(), unknown=[*NAMES, "machine.mass"], known={"machine.mass[1]": "95 kg +- 1 %"})
    assert fit.status_name == "found"
    errors = [each.error / each.value for each in fit.estimates]
    assert all(0.0099 < error < 0.02 for error in errors)


def test_gains_of_sensors_are_named_if_they_alone_determine():
    run = run_of(3, gain_error=0.01)
    fit = jv.identify(start(1.05), run, unknown=[*NAMES[:4], "machine.mass"])
    assert fit.status_name == "found"
    assert "the common factor of all masses, stiffnesses and dampings is known from the gains" in fit.by_gain[0].sentence
    assert fit.estimate("machine.stiffness[0]").error / fit.estimate("machine.stiffness[0]").value > 0.02
    assert np.max(np.abs(distances(fit))) < 4.0


def test_wrong_direction_of_a_sensor_is_no_fit():
    run = run_of()
    upside_down = jv.Channel("a1", "acceleration", at=1, direction="down", gain_error=0.0)
    wrong = jv.MeasuredRun(
        (upside_down, *run.channels[1:]), run.times, run.values, run.clipped, run.change, run.notes, run.source
    )
    fit = jv.identify(start(), wrong, unknown=NAMES, throw=False)
    assert fit.status_name in ("not_converged", "patterned")
    reversed_sign = "with a reversed sign of channel 'a1', or with a reversed sign of channel 'a2'"
    assert fit.notes[0] == f"the model explains the records {reversed_sign}: correct the description of the channels"


@pytest.mark.slow
def test_angle_of_one_pulse_per_turn_is_fitted_too():
    """The samples of the tachometer give the times of its edges to half a step, which is 20 times the noise of the readings."""
    channels = [jv.Channel("a1", "acceleration", at=1, gain_error=0.0), jv.Channel("tacho", "pulses")]
    readings = clean()[:, 0] + 1e-3 * np.random.default_rng(0).normal(size=T.size)
    data = {"a1": readings, "tacho": np.clip(50.0 * np.sin(ramp(T)[0]), 0.0, 5.0)}
    fit = jv.identify(start(1.04, 1.2), jv.MeasuredRun.from_arrays(channels, T, data), unknown=NAMES[:4])
    assert fit.status_name == "found"
    assert np.max(np.abs(distances(fit))) < 4.0
    np.testing.assert_allclose(fit.noise[0], 1e-3, rtol=0.03)
    np.testing.assert_allclose(fit.scene.machine.damping, [160.0, 120.0], rtol=0.1)
    assert any("one pulse to the next" in note and "use more pulses per turn" in note for note in fit.notes)


def test_profile_likelihood_gives_the_interval_of_a_weak_damping():
    """Reference: the sum of squares over the damping by SciPy; states, offsets and unbalance are free at each value."""
    times, noise = T[::8], 2.5
    rng = np.random.default_rng(5)
    run = record(times, clean()[::8], noise, rng)
    name = "machine.damping[0]"
    fit = jv.identify(start(), run, unknown=[name, "exciters[0].unbalance"])
    assert any(f"the interval of {name} follows from its profile likelihood" in note for note in fit.notes)
    estimate, value = fit.estimate(name), np.array([run.values["a1"], run.values["a2"]]).T.ravel()
    grid = estimate.value * np.exp(np.linspace(-6.0, 4.0, 41) * estimate.error / estimate.value)
    cases = [TRUTH | {name: each} for each in grid]
    both = [accelerations(times, cases, phase) for phase in (0.0, np.pi / 2)]
    costs = []
    for case, *waves in zip(cases, *both, strict=True):
        columns = [*waves, *free_motions(times, case), *(np.tile(each, (times.size, 1)) for each in np.eye(2))]
        basis = np.stack([each.ravel() for each in columns], axis=1)
        left = value - basis @ np.linalg.lstsq(basis, value, rcond=None)[0]
        costs.append(left @ left / float(fit.noise[0][0] * fit.noise[0][1]))
    rise = np.array(costs) - min(costs) - 1.959964**2
    ends = np.flatnonzero(np.diff(np.sign(rise)))
    low, high = (float(np.interp(0.0, *_sorted(rise[k : k + 2], grid[k : k + 2]))) for k in ends[[0, -1]])
    np.testing.assert_allclose([estimate.low, estimate.high], [low, high], rtol=0.01)
    quadratic = estimate.value * np.exp(np.array([-1.96, 1.96]) * estimate.error / estimate.value)
    assert np.min(np.abs(np.log([low, high] / quadratic))) > 0.02


def _sorted(x, y):
    order = np.argsort(x)
    return x[order], y[order]


def test_contradicted_mass_is_said():
    known = {"machine.mass[0]": "150 kg +- 1 %", "machine.mass[1]": "95 kg +- 1 %"}
    fit = jv.identify(start(), run_of(), unknown=NAMES, known=known)
    assert fit.status_name == "contradicted"
    assert any("machine.mass[" in note and "standard errors away" in note for note in fit.notes)


def test_results_are_saved_and_drawn(tmp_path):
    fit = fitted()
    again = jv.load(fit.save(tmp_path / "fit"))
    assert again.summary() == fit.summary() and "mode 2" in fit.summary()
    assert len(fit.plot().axes) == 2
    (noise,) = [line for line in fit.summary().splitlines() if line.startswith("noise")]
    assert noise.startswith("noise: ") and noise.count(" m/s^2") == len(fit.channels[0])


def test_each_run_has_its_figure_and_noise():
    fit = fitted()
    fields = ("channels", "kinds", "noise", "time", "readings", "fitted")
    two = dataclasses.replace(fit, **{name: 2 * getattr(fit, name) for name in fields})
    two = dataclasses.replace(two, time=(fit.time[0], fit.time[0] + 100.0))
    assert "noise of run 1: " in two.summary() and "noise of run 2: " in two.summary()
    top = two.plot(run=2).axes[0]
    assert top.get_xlim()[1] > 100.0 and top.get_ylabel() == "acceleration, m/s^2"
    with pytest.raises(jv.InputError, match="run is 3; the fit has the runs 1 to 2"):
        two.plot(run=3)


def test_plan_predicts_the_errors_after_a_run_with_an_added_mass():
    drive, channels = Ramp(jnp.asarray(TOP)), run_of().channels
    again = jv.PlannedRun("again", drive, 16.0, channels, rate=500.0)
    heavier = jv.PlannedRun("heavier", drive, 16.0, channels, rate=500.0, change={"machine.mass[0]": "+10 kg"})
    plan = jv.plan_runs(everything_free(), [again, heavier])
    assert plan.candidates == ("heavier", "again")
    assert np.all(np.isinf(plan.errors[1])) and np.all(np.isinf(plan.now))
    found = np.array([each.error / each.value for each in with_added_mass().estimates])
    np.testing.assert_allclose(plan.errors[0], found, rtol=0.2)


def test_interval_of_a_quantity_follows_from_the_numbers():
    fit = everything_free()
    lowest = fit.interval_of(lambda scene: float(jv.natural_frequencies(scene)[0]))
    np.testing.assert_allclose(lowest, fit.frequency[0], rtol=2e-3)
    assert np.isinf(fit.interval_of(lambda scene: float(scene.machine.mass[0])).high)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"unknown": []}, "unknown is \\[\\]; it must be a list of names"),
        ({"unknown": ["machine.stifness"]}, "did you mean 'machine.stiffness'"),
        ({"unknown": NAMES, "dry": True}, "dry is for a BearingPendulum"),
        ({"unknown": NAMES, "known": {"machine.mass[0]": "95 N"}}, "machine.mass"),
    ],
)
def test_wrong_arguments_end_in_one_sentence(arguments, words):
    with pytest.raises(jv.InputError, match=words):
        jv.identify(start(), run_of(), **arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, r"^records is MeasuredRun; it must be a Record"),
        ({"unknown": NAMES}, r"^unknown is for a Scene; .* dry, air and torque$"),
        ({"known": {"machine.mass[0]": "95 kg"}}, r"^known is for a Scene; .* dry, air and torque$"),
    ],
)
def test_arguments_of_a_scene_are_refused_for_a_pendulum(arguments, words):
    rod = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.00625)
    with pytest.raises(jv.InputError, match=words):
        jv.identify(rod, run_of(), **arguments)


def test_loads_that_are_not_jammed_are_refused():
    scene = jv.Scene(start().machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
    with pytest.raises(jv.InputError, match="has no vibration of jammed loads"):
        jv.identify(scene, run_of(), unknown=["machine.stiffness"])


def test_motor_needs_a_channel_of_the_rotor():
    run = run_of()
    without = jv.MeasuredRun(
        run.channels[:2],
        *({name: each for name, each in part.items() if name != "tacho"} for part in (run.times, run.values, run.clipped)),
        run.change,
        run.notes,
        run.source,
    )
    with pytest.raises(jv.InputError, match="add a channel of kind pulses, angle or speed"):
        jv.identify(start(), without, unknown=NAMES)
