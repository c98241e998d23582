"""Runs after a fit: planned ones, and held-out ones; SciPy integrates the run-ups."""

import functools
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from run_ups_by_scipy import TOP, TRUTH, Ramp, accelerations, ramp, record, scene_of

import jaxvib as jv
from jaxvib.identification.checks import coverage_notes
from jaxvib.identification.further_runs.planned import expected_run
from jaxvib.identification.further_runs.speed_profile import _spread

T = 0.002 * np.arange(8000)
NOISE = 0.05
NAMES = ("machine.stiffness", "machine.damping", "machine.link_stiffness", "machine.link_damping")
SLOW = 0.45


def slow_ramp(t):
    return tuple(SLOW * each for each in ramp(t))


@functools.cache
def clean(turning=ramp, **changes):
    numbers = TRUTH | {name.replace("__", "."): value for name, value in changes.items()}
    return accelerations(T, [numbers], turning=turning)[0]


def run_of(seed, gain_error=0.0, turning=ramp, change=None, noise=NOISE, **changes):
    """Return a run; the true gains are 1 in all runs, and `gain_error` is what is known about them."""
    rng = np.random.default_rng(seed)
    run = record(T, clean(turning, **changes), noise, rng, turning=turning, change=change)
    channels = [eqx.tree_at(lambda c: c.gain_error, each, gain_error) for each in run.channels[:2]]
    return eqx.tree_at(lambda r: r.channels, run, (*channels, run.channels[2]))


def without(run, name):
    """Return a run without a channel."""
    channels = tuple(channel for channel in run.channels if channel.name != name)
    parts = ({key: each for key, each in part.items() if key != name} for part in (run.times, run.values, run.clipped))
    return jv.MeasuredRun(channels, *parts, run.change, run.notes, run.source)


def first_scene(share=1.0):
    """Return the scene with first values away from the truth by a `share` of 4 % and 19 %."""
    stiffness, damping = (1.0 + 0.04 * share) * 5e4, (1.0 + 0.19 * share) * 160.0
    return scene_of(TRUTH | {"machine.stiffness[0]": stiffness, "machine.damping[0]": damping})


def planned(run, drive=None, **options):
    return jv.PlannedRun(
        "remedy", Ramp(jnp.asarray(TOP)) if drive is None else drive, 16.0, run.channels, rate=500.0, **options
    )


CASES = {
    "gains": (
        lambda noise=NOISE: run_of(0, gain_error=0.01, noise=noise),
        lambda: run_of(1, gain_error=0.01, change={"machine.mass[0]": "+10 kg"}, **{"machine__mass[0]": 130.0}),
        ["machine.mass"],
        "is known from the gains of the sensors only",
    ),
    "one accelerometer": (
        lambda noise=NOISE: without(run_of(0, noise=noise), "a2"),
        lambda: run_of(1),
        ["machine.mass"],
        "add a sensor at another place",
    ),
    "first resonance only": (
        lambda noise=NOISE: run_of(0, turning=slow_ramp, noise=2.6 * noise),
        lambda: run_of(1),
        [],
        "record a run through all resonances",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_remedy_gives_the_predicted_errors(case):
    """A plan is computed with the numbers of the fit, which may be wrong as long as they are not determined. Nearly the true
    ones follow from the same run with a fiftieth of the noise, whose information is reduced by the square of this."""
    record_first, record_remedy, more, words = CASES[case]
    first, remedy, unknown = record_first(), record_remedy(), [*NAMES, *more]
    fit = jv.identify(first_scene(0.25), first, unknown=unknown, throw=False)
    assert any(words in each.sentence for each in (*fit.undetermined, *fit.by_gain))
    change = {"machine.mass[0]": "+10 kg"} if remedy.change else {}
    run = planned(remedy, noise={"a1": NOISE, "a2": NOISE}, change=change)
    inaccurate = jv.plan_runs(fit, [run])
    if case != "gains":
        fit = jv.identify(first_scene(0.25), record_first(NOISE / 50.0), unknown=unknown, throw=False)
        fit = eqx.tree_at(lambda each: each.information, fit, fit.information / 50.0**2)
    plan = jv.plan_runs(fit, [run])
    both = jv.identify(first_scene(), [first, remedy], unknown=unknown)
    assert both.status_name == "found", both.notes
    found = np.array([each.error / each.value for each in both.estimates])
    assert both.undetermined == () and np.all(np.isfinite(found))
    np.testing.assert_allclose(plan.errors[0], found, rtol=0.2 if case == "gains" else 0.1)
    if case == "first resonance only":
        assert np.all(inaccurate.errors_low[0] < 1.2 * found) and np.all(found < 1.2 * inaccurate.errors_high[0])


@functools.cache
def fitted():
    return jv.identify(first_scene(), run_of(20), unknown=NAMES)


LIMITS = {"speed": 110.0, "acceleration": 15.0}


@pytest.mark.slow
def test_speed_is_improved_within_the_limits():
    candidate = jv.PlannedRun("ramp", jv.RunUp(100.0, 12.0), 16.0, run_of(0).channels, rate=250.0)
    plan = jv.plan_runs(fitted(), [candidate], limits=LIMITS)
    assert plan.candidates == ("ramp, optimized speed", "ramp") and "optimized speed:" in plan.summary()
    times, speeds = (np.asarray(each) for each in (plan.profile.times, plan.profile.speeds))
    assert np.all(speeds >= 0.0) and np.all(speeds <= 110.0) and times[-1] == 16.0
    assert np.max(np.abs(np.diff(speeds) / np.diff(times))) < 15.0 * (1.0 + 1e-6)
    assert np.mean(np.log(plan.errors[0])) < np.mean(np.log(plan.errors[1])) - 0.05


@pytest.mark.slow
def test_gradient_of_the_errors_by_the_speed_is_the_difference():
    """Central differences; the step of 0.003 rad/s moves the rotor by up to 0.05 rad."""
    drive = jv.SpeedProfile([0.0, 4.0, 8.0, 16.0], [0.0, 30.0, 70.0, 100.0])
    expected = expected_run(fitted(), planned(run_of(0), drive))
    times, speeds = np.linspace(0.0, 16.0, 9), np.array([0.0, 15.0, 30.0, 50.0, 70.0, 78.0, 85.0, 93.0, 100.0])
    _, gradient = _spread(fitted(), expected, times, speeds)
    step = 3e-3
    for k in (2, 5, 8):
        high, low = (_spread(fitted(), expected, times, speeds + s * step * np.eye(9)[k])[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(gradient[k], (high - low) / (2.0 * step), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"speed": 110.0}, "limits.acceleration is missing"),
        ({**LIMITS, "force": 3.0}, "limits.force is not a limit"),
        ({**LIMITS, "speed": "80 kg"}, "limits.speed"),
        ({**LIMITS, "speed": 60.0}, "remedy: drive reaches 693.1 rpm; limits.speed is 573 rpm"),
        ({**LIMITS, "acceleration": 1.0}, "limits.acceleration is 1 rad/s"),
    ],
)
def test_wrong_limits_raise_clear_errors(limits, words):
    with pytest.raises(jv.InputError, match=words):
        jv.plan_runs(fitted(), [planned(run_of(0))], limits=limits)


def test_further_run_of_the_same_machine_is_predicted():
    p_values = []
    for seed in range(5, 13):
        found = jv.predict_run(fitted(), run_of(seed))
        assert found.status_name == "predicted", found.notes
        np.testing.assert_allclose(found.ratio, 1.0, atol=0.05)
        p_values.append(found.p_value)
    assert 0.2 < np.mean(p_values) < 0.8


def test_run_of_another_machine_contradicts_the_fit():
    found = jv.predict_run(fitted(), run_of(5, **{"machine__stiffness[0]": 5.1e4}))
    assert found.status_name == "contradicted"
    assert any("a relative change of machine.stiffness[0] by +0.0" in note for note in found.notes), found.notes
    assert "contradicts the fit" in found.summary() and len(found.plot().axes) == 2


def test_further_run_with_a_stated_change_is_predicted():
    heavier = run_of(5, change={"machine.mass[0]": "+10 kg"}, **{"machine__mass[0]": 130.0})
    assert jv.predict_run(fitted(), heavier).status_name == "predicted"
    assert jv.predict_run(fitted(), run_of(5, **{"machine__mass[0]": 130.0})).status_name == "contradicted"


def test_records_of_different_machines_are_contradicted():
    other = run_of(5, **{"machine__damping[1]": 150.0})
    fit = jv.identify(first_scene(), [run_of(0), other], unknown=NAMES)
    assert fit.status_name == "contradicted"
    assert any("run 2 deviates from the others" in note for note in fit.notes)
    same = jv.identify(first_scene(), [run_of(0), run_of(5)], unknown=NAMES)
    assert same.status_name == "found", same.notes


ONE = jv.one_mass(mass=50.0, stiffness=4e4, damping=20.0)
FRAME = jv.Channel("frame", "acceleration", at=1, gain_error=0.0)


def notes_of(top, duration):
    """Return the notes about a run-up to `top`, rad/s, of a machine with 28 rad/s and a decay time of 5 s."""
    time = np.linspace(0.0, duration, 1001)
    problem = SimpleNamespace(times=(time,), angles=((0.5 * top / duration * time**2)[:, None],))
    return list(coverage_notes(SimpleNamespace(problem=problem), np.array([28.0]), np.array([1.0 / 28.0 / 5.0])))


def test_run_below_the_resonance_and_a_short_run_are_named():
    (low,) = notes_of(20.0, 12.0)
    assert "no run passes through a resonance: the rotors turn at" in low and "the natural frequencies are 28 rad/s" in low
    (short,) = notes_of(60.0, 9.0)
    assert "run 1 lasts 9 s, less than two decay times of the mode that decays most slowly (5 s each)" in short
    assert notes_of(60.0, 12.0) == []


def test_more_unknowns_than_readings_are_refused():
    scene = jv.Scene(ONE, exciters=[jv.Exciter(drive=jv.RunUp(60.0, acceleration=7.5), unbalance=0.05)])
    t = 0.01 * np.arange(800)
    run = jv.MeasuredRun.from_arrays([FRAME], t, {"frame": np.random.default_rng(0).normal(size=t.size)})
    run.values["frame"][6:] = np.nan
    words = "unknown has 7 unknowns, including initial states and offsets of the runs, for 6 readings"
    with pytest.raises(jv.InputError, match=words):
        jv.identify(scene, run, unknown=["machine.stiffness", "machine.damping"])
