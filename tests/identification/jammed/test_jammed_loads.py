"""Machines with jammed balls: fits to records by SciPy, and scenes and records that are refused."""

import dataclasses
import functools
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest
from repeated_records.fits import JAMMED_CASES, JAMMED_NOISE, NAMES, repeated
from repeated_records.jammed import RADIUS, TIMES, TRUTH, bound, clean, first_state, jammed_record, scene_of

import jaxvib as jv
from jaxvib.identification.fit import minimize
from jaxvib.identification.jammed.motion import closed_motion, linearized
from jaxvib.identification.jammed.start import _stiffnesses_of_jam, with_first_motion
from jaxvib.identification.problem import build_problem, channel_sizes, damped_modes, with_noise
from jaxvib.numerics.noise import Noise

UNKNOWN = ["machine.stiffness", "machine.link_stiffness", "exciters[0].unbalance", "loads.mass", "loads.drag"]


def jammed_problem(stiffness=1.0):
    """Return the problem of a record without noise, with first values of all stiffnesses that are off by a factor."""
    first = {name: value * (stiffness if "stiffness" in name else 1.0) for name, value in TRUTH.items()}
    return build_problem(scene_of(first), [jammed_record(1e-9, np.random.default_rng(0))], UNKNOWN, {})


def true_own(offset=0.1):
    """Return the first state of the record by SciPy, the components of the unbalance, and the offsets."""
    own = first_state()
    return np.concatenate([own[:4], [own[4]] * 2, [own[5]] * 2, 0.05 * np.array([np.cos(0.4), np.sin(0.4)]), [offset] * 2])


def test_motion_is_that_of_scipy():
    problem = jammed_problem()
    samples = problem.runs[0]
    shifted = dataclasses.replace(samples, begin=0.0 * samples.begin)  # the record begins at the first pulse
    readings, _ = closed_motion(problem.unknowns, shifted, problem.scene, np.zeros(problem.unknowns.count), true_own())
    np.testing.assert_allclose(readings[: TIMES.size - 2] - 0.1, clean()[: TIMES.size - 2], atol=2e-5)


def body():
    """Return a body in a plane with two unequal pendulums and an unbalance on a clockwise rotor."""
    supports = [jv.support(at=(x, -0.2), stiffness=(6e4, 9e4), damping=(600.0, 700.0)) for x in (-0.5, 0.6)]
    machine = jv.plane_body(mass=80.0, inertia=12.0, supports=supports)
    loads = jv.pendulums(count=2, mass=[0.5, 0.6], radius=0.1, drag=[1.0, 1.2], inertia=0.001)
    exciter = jv.Exciter(loads, jv.RunUp(90.0, acceleration=20.0), unbalance=0.03, at=(0.1, 0.2), direction=-1)
    return jv.Scene(machine, exciters=[exciter], effects=jv.Gravity())


CHANNELS = [
    jv.Channel("a", "acceleration", at=(0.3, -0.1), direction=(0.6, 0.8), high_pass=2.0),
    jv.Channel("v", "velocity", at=(-0.2, 0.1), direction="across", gain_error=0.01),
    jv.Channel("f", "force", direction="up"),
]


def body_problem():
    time = 0.01 * np.arange(120)
    readings = {channel.name: np.sin(20.0 * time) for channel in CHANNELS}
    run = jv.MeasuredRun.from_arrays(CHANNELS, time, readings, change={"machine.mass": "+5 kg"})
    unknown = ["machine.inertia", "loads.mass", "loads.drag", "exciters[0].unbalance"]
    problem = build_problem(body(), [run], unknown, {})
    samples = dataclasses.replace(problem.runs[0], segments=(3, 40, 2))
    return with_noise(problem._replace(runs=(samples,)), [[Noise(np.array([1.0, -0.5]), 1.0)] * 3])


def test_derivatives_against_differences_and_gaps_close():
    problem = body_problem()
    (samples,), rng, p = problem.runs, np.random.default_rng(0), problem.unknowns.count
    states = 2 * (3 + 2) + 1
    own = np.concatenate([1e-3 * rng.normal(size=3), 0.05 * rng.normal(size=3), [0.2, 0.5, -20.0, -21.0], [0.1]])
    own, x = np.concatenate([own, [0.02, 0.01], [0.1, 0.2, 0.3]]), 0.01 * rng.normal(size=p)

    def motion(x, own):
        _, starts = closed_motion(problem.unknowns, samples, problem.scene, x, own)
        return linearized(problem.unknowns, samples, problem.scene, x, own, starts)

    at = motion(x, own)
    assert np.max(np.abs(at.gaps)) < 1e-9 and at.columns.shape[2] == p + states + 2 + 3 + 1
    for k in range(p + own.size):
        step = 1e-6 * np.eye(p + own.size)[k]
        high, low = (motion(x + s * step[:p], own + s * step[p:]).model for s in (1.0, -1.0))
        slope = (high - low) / 2e-6
        np.testing.assert_allclose(at.columns[:, :, k], slope, atol=1e-6 * max(1.0, np.max(np.abs(slope))))

    open_starts = closed_motion(problem.unknowns, samples, problem.scene, x, own)[1] + 1e-5 * rng.normal(size=(3, states))
    open_starts[0] = own[:states]
    gaps = linearized(problem.unknowns, samples, problem.scene, x, own, open_starts)
    closed = open_starts + gaps.start_changes[:, :, -1]
    assert np.max(np.abs(linearized(problem.unknowns, samples, problem.scene, x, own, closed).gaps)) < 1e-3 * np.max(
        np.abs(gaps.gaps)
    )


def test_motion_of_pendulums_is_that_of_simulate():
    problem = body_problem()
    (samples,), scene = problem.runs, body()
    heavier = eqx.tree_at(lambda scene: scene.machine.mass, scene, scene.machine.mass + 5.0)
    start = jv.State(np.zeros(3), np.zeros(3), (np.array([-1.6, -1.5]),), (np.zeros(2),))
    run = jv.simulate(heavier, "1.19 s", start=start, samples=120, estimate=False).trajectory.state
    own = np.concatenate([np.zeros(6), [-1.6, -1.5], np.zeros(3), [0.03, 0.0], np.zeros(3)])
    readings, _ = closed_motion(problem.unknowns, samples, problem.scene, np.zeros(problem.unknowns.count), own)
    across = np.asarray(run.velocity) @ np.array([1.0, 0.0, -0.1])
    np.testing.assert_allclose(readings[:, 1], across, atol=1e-6 * np.max(np.abs(across)))


@pytest.mark.parametrize("stiffness", [1.0, 1.1])
def test_first_values_lead_to_the_minimum(stiffness):
    """Natural frequencies that are 5 % too high lead to the motion of this record without noise with the stiffnesses of the jam
    only."""
    problem, first = with_first_motion(jammed_problem(stiffness))
    true = -np.log(stiffness) * np.array([1.0, 1.0, 1.0, 0.0, 0.0])
    noise = [[Noise(np.ones(1), 1e-3 * size) for size in of_run] for of_run in channel_sizes(problem)]
    best, *_, converged = minimize(with_noise(problem, noise), first)
    assert converged
    np.testing.assert_allclose(best.x, true, atol=1e-4)


def test_stiffnesses_of_a_jam_are_below_the_resonance():
    problem, jams = jammed_problem(1.2), [SimpleNamespace(speed=np.array([62.0, 61.0, 62.0]))]
    x = _stiffnesses_of_jam(problem, jams)
    second = damped_modes(problem.scene)[0][1]
    np.testing.assert_allclose(x[:3], 2.0 * np.log(1.04 * 62.0 / second), rtol=1e-12)
    assert not np.any(x[3:])
    assert _stiffnesses_of_jam(problem, [SimpleNamespace(speed=np.array([second / 1.04]))]) is None
    assert _stiffnesses_of_jam(problem._replace(precisions=np.ones(5)), jams) is None


def away_from(fit):
    """Return (fitted - true)/error of each number."""
    return np.array([(each.value - TRUTH[name]) / each.error for name, each in zip(fit.names, fit.estimates, strict=True)])


FACTORS = {"stiffness": 1.05, "damping": 1.0 / 1.3, "loads.mass": 1.1, "drag": 1.0 / 1.2}


def first_scene(factors):
    """Return the scene with first values away from the truth."""
    factor = {name: next((f for word, f in factors.items() if word in name), 1.0) for name in TRUTH}
    return scene_of({name: value * factor[name] for name, value in TRUTH.items()})


@functools.cache
def fitted():
    run = jammed_record(JAMMED_NOISE, np.random.default_rng(0))
    return jv.identify(first_scene(FACTORS), run, unknown=[*NAMES, "loads.mass", "loads.drag"])


def test_jammed_balls_and_unbalance_are_found():
    fit = fitted()
    assert fit.status_name == "found" and fit.notes == ()
    assert np.max(np.abs(away_from(fit))) < 3.5
    np.testing.assert_allclose([e.error / e.value for e in fit.estimates], bound(fit.names, JAMMED_NOISE), rtol=0.15)


def planned(drive, **options):
    channels = jammed_record(JAMMED_NOISE, np.random.default_rng(0)).channels
    return jv.PlannedRun("again", drive, 16.0, channels, rate=62.5, **options)


def test_plan_repeats_a_run_with_jammed_loads():
    """The candidate has the speed and the first motion of the record: the error of each number is divided by sqrt(2)."""
    plan = jv.plan_runs(fitted(), [planned(jv.SpeedProfile([0.0, 16.0], [90.0, 122.0]))])
    np.testing.assert_allclose(plan.errors[0] / plan.now, np.sqrt(0.5), rtol=0.02)


def test_planned_runs_keep_their_jam():
    with pytest.raises(jv.InputError, match="again: drive has a speed at which the loads do not stay jammed"):
        jv.plan_runs(fitted(), [planned(jv.SpeedProfile([0.0, 16.0], [90.0, 40.0]))])
    with pytest.raises(jv.InputError, match=r"fit\.scene has loads that move on the rotor; the optimization of the speed"):
        jv.plan_runs(fitted(), [planned(jv.ConstantSpeed(100.0))], limits={"speed": 130.0, "acceleration": 5.0})


def test_further_run_with_jammed_loads_is_predicted():
    rng = np.random.default_rng(7)
    found = jv.predict_run(fitted(), jammed_record(JAMMED_NOISE, rng, impact=-0.15))
    assert found.status_name == "predicted" and found.p_value > 1e-3
    np.testing.assert_allclose(found.ratio, 1.0, atol=0.1)
    other = jv.predict_run(fitted(), jammed_record(JAMMED_NOISE, rng, impact=-0.15, drag=1.52))
    assert other.status_name == "contradicted"
    assert other.notes[-1].endswith("too much to name a parameter") and np.min(other.ratio) > 5.0


@pytest.mark.slow
@pytest.mark.parametrize("name", JAMMED_CASES)
def test_jammed_balls_are_found_with_other_noise(name):
    found = repeated(2, **JAMMED_CASES[name])
    assert found.statuses.tolist() == ["found"] * 2
    assert np.max(np.abs(found.away)) < 3.5
    ratio = found.error_ratio  # the bound does not know of clipped readings, 24 % of all
    assert np.min(ratio) > 0.9 and np.max(ratio) < (1.35 if "clipped" in name else 1.1)


@pytest.mark.slow
def test_two_runs_with_an_added_mass_give_all_masses():
    """The first values of the natural frequencies are 5 % too low, and the stiffnesses follow from the jam at first."""
    rng = np.random.default_rng([0, 0])
    first = jammed_record(JAMMED_NOISE, rng)
    heavier = jammed_record(JAMMED_NOISE, rng, impact=-0.15, added=5.0, change={"machine.mass[0]": "+5 kg"})
    factors = {"stiffness": 1.0 / 1.05, "link_damping": 1.0 / 1.3, "damping": 1.3, "machine.mass": 1.05}
    scene = first_scene(factors | {"loads.mass": 1.1, "drag": 1.0 / 1.2})
    fit = jv.identify(scene, [first, heavier], unknown=["machine.mass", *NAMES, "loads.mass", "loads.drag"])
    assert fit.status_name == "found" and fit.undetermined == ()
    assert np.max(np.abs(away_from(fit))) < 3.5
    assert fit.estimate("machine.mass[0]").error < 5.0


def test_scene_without_a_jam_in_the_record_is_refused():
    run, rng = jammed_record(0.2, np.random.default_rng(0)), np.random.default_rng(0)
    noise = {name: rng.normal(size=TIMES.size) for name in ("a1", "a2")}
    slow = {"a1": TIMES, "a2": TIMES, "tacho": np.arange(0.0, 16.0, 0.5)}
    channels = (*run.channels[:2], jv.Channel("tacho", "pulses"))
    with pytest.raises(
        jv.InputError,
        match=r"records\[0\] has no vibration of jammed loads below 11\.9 rad/s, 95 % of the lowest rotor speed",
    ):
        jv.identify(scene_of(TRUTH), jv.MeasuredRun.from_arrays(channels, slow, noise), unknown=UNKNOWN)


def refused(scene, words, unknown=("machine.mass",)):
    with pytest.raises(jv.InputError, match=words):
        jv.identify(scene, jammed_record(0.2, np.random.default_rng(0)), unknown=unknown)


def test_loads_that_are_not_included_are_refused():
    scene = scene_of(TRUTH)
    exciter = scene.exciters[0]
    hung = jv.pendulums(count=2, mass=0.8, radius=RADIUS, drag=1.5)
    several = [exciter, jv.Exciter(drive=jv.ConstantSpeed(50.0), unbalance=0.1)]
    refused(jv.Scene(scene.machine, exciters=several), "has 2 exciters, one of them with loads; identify needs loads")
    refused(scene.replace(loads=hung, effects=jv.StaticImbalance("9 g m")), "static_imbalance is not included in identify")
    torus = jv.torus_balls(count=1, mass=0.1, radius=RADIUS, tube=0.02, ball_radius=0.01, drag=1.0)
    refused(
        jv.Scene(scene.machine, torus, exciter.drive), "scene.loads is of kind 'torus_ball'; identify needs loads on a circle"
    )
    refused(scene, "Parameters of a drive can be unknown only if .* no loads", unknown=["drive.inertia"])
    refused(
        scene.replace(loads=jv.balls(count=1, mass=0.8, radius=RADIUS, drag=1e7)),
        "reduce loads.drag, machine.damping or the damping of stops",
    )
