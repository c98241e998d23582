"""Machines on nonlinear supports: motion and derivatives against SciPy and differences, fits, and scenes that are refused."""

import dataclasses
import functools
from types import SimpleNamespace

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from repeated_records.fits import NAMES, SUPPORT_CASES, repeated
from repeated_records.linearized import bound, linear_errors
from repeated_records.supports import STOP, TIMES, estimator_of_supports, motion, scene_of, support_record, truth
from run_ups_by_scipy import Ramp, ramp

import jaxvib as jv
from jaxvib.equations.dynamics import dynamics_of
from jaxvib.equations.model import assemble
from jaxvib.equations.state import State
from jaxvib.identification.fit import project
from jaxvib.identification.jammed.motion import _recorded, closed_motion, linearized
from jaxvib.identification.jammed.segments import divide
from jaxvib.identification.problem import build_problem
from jaxvib.identification.supports import start
from jaxvib.identification.supports.contact import FixedContactStop, switched_step, with_fixed_contact
from jaxvib.identification.supports.start import _guide
from jaxvib.ode.dopri8_loop import LoopDopri8

SHORT = TIMES[:300]
"""Times of a record that passes the first resonance only."""

LOW_NOISE = 0.005
"""Standard deviation of the noise of short records, m/s^2."""


def unknown(kind):
    return [*NAMES, *(name for name in truth(kind) if name.startswith("effects") and "width" not in name)]


def short_record(kind, noise=1e-9, **changes):
    """Return a record of 4 s, from numbers that differ from the truth by `changes`."""
    clean = motion(truth(kind) | changes, times=SHORT)
    return support_record(kind, noise, np.random.default_rng(0), times=SHORT, clean=clean)


@functools.cache
def problem_of(kind):
    """Return the problem of a short record without noise with the exact angle of the rotor, and the true linear unknowns."""
    problem = build_problem(scene_of(truth(kind)), [short_record(kind)], unknown(kind), {})
    drive, end = Ramp(jnp.asarray(100.0)), jnp.asarray(SHORT[-1])
    samples = dataclasses.replace(problem.runs[0], begin=jnp.zeros(()), end=end, drives=(drive,))
    own = np.concatenate([np.zeros(4), 0.05 * np.array([np.cos(0.4), np.sin(0.4)]), np.zeros(2)])
    return problem._replace(runs=(samples,)), own


@pytest.mark.parametrize("kind", ["stop", "cubic", "friction"])
def test_motion_is_that_of_scipy(kind):
    (problem, own), x = problem_of(kind), np.zeros(len(unknown(kind)) + 2)
    readings, _ = closed_motion(problem.unknowns, problem.runs[0], problem.scene, x[: problem.unknowns.count], own)
    expected = motion(truth(kind), times=SHORT)
    n = len(problem.raw[0])
    assert np.max(np.abs(expected)) > 0.5
    np.testing.assert_allclose(readings[:n], expected[:n], atol=1e-6)


def test_derivatives_against_differences_across_contacts():
    (problem, own), p = problem_of("stop"), problem_of("stop")[0].unknowns.count
    parts = problem.unknowns, problem.runs[0], problem.scene
    x, n = np.zeros(p), len(problem.raw[0])
    _, starts = closed_motion(*parts, x, own)
    at = linearized(*parts, x, own, starts)
    assert np.max(np.abs(at.gaps)) < 1e-10
    names = [number.name for number in problem.unknowns.numbers]
    for k in (*map(names.index, STOP), 0, p, p + 3, p + 5):  # numbers, states at the first sample, unbalance
        step = 1e-6 * np.eye(p + own.size)[k]
        high, low = (closed_motion(*parts, x + s * step[:p], own + s * step[p:])[0][:n] for s in (1.0, -1.0))
        slope = (high - low) / 2e-6
        assert np.max(np.abs(slope)) > 0.1
        np.testing.assert_allclose(at.columns[:n, :, k], slope, atol=2e-5 * max(1.0, np.max(np.abs(slope))))


def test_short_contact_within_a_step_is_that_of_short_steps():
    """A free vibration passes the gap by 0.5 % of its amplitude, between the ends of a step."""
    machine, y = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0), 1.005e-3 * jnp.array([np.cos(0.3), 28.28 * np.sin(0.3)])
    scene = jv.Scene(
        machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(0.1), unbalance=1e-9)], effects=jv.Stop(2e6, gap=1e-3)
    )
    dynamics = dynamics_of(assemble(eqx.tree_at(lambda s: s.effects, scene, (with_fixed_contact(scene.effects[0], machine),))))
    solver = LoopDopri8(tangents=True)

    def rates(t, y, _, dynamics):
        rate = dynamics(t, State(y[:1], y[1:]))
        return jnp.concatenate([rate.displacement, rate.velocity])

    term = diffrax.ODETerm(lambda t, y, dynamics: rates(t, y, None, dynamics))

    def step(t, y, h, dynamics):
        return solver.step(term, t, t + h, y, dynamics, None, False)[0]

    @jax.jit
    def after(y, n):
        h = 0.02 / n
        state = jnp.asarray(0.0), y, jnp.zeros(2, bool)
        return jax.lax.fori_loop(0, n, lambda k, s: (h * k, *switched_step(step, rates, dynamics, h * k, *s[1:], h)), state)[1]

    np.testing.assert_allclose(after(y, 1), after(y, 500), atol=1e-8)


@pytest.mark.parametrize(
    ("stop", "machine"),
    [
        (jv.Stop(2e5, gap=1e-3, damping=300.0), jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)),
        (jv.Stop(2e5, gap=1e-3, damping=300.0, side="below"), jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)),
        (jv.Stop(2e5, gap=1e-3, damping=300.0), jv.planar_rotor(mass=40.0, stiffness=1e6, damping=100.0)),
    ],
)
def test_fixed_contact_stop_has_the_force_of_the_stop(stop, machine):
    rng, (term,), frozen = np.random.default_rng(0), stop.terms(), with_fixed_contact(stop, machine)
    assert isinstance(frozen, FixedContactStop)
    count, pressed = len(stop.rows(machine)), 0
    for _ in range(60):
        x, v = jnp.asarray(1.5e-3 * rng.normal(size=count)), jnp.asarray(rng.normal(size=count))
        depth, rate = frozen.penetrations(x), (frozen.penetrations(x + 1e-7 * v) - frozen.penetrations(x - 1e-7 * v)) / 2e-7
        presses = (depth > 0.0) & (stop.stiffness * depth + stop.damping * rate > 0.0)
        (smooth,) = dataclasses.replace(frozen, presses=presses.astype(float)).terms()
        np.testing.assert_allclose(smooth.force(x, v), term.force(x, v), atol=1e-4)
        pressed += int(np.any(presses))
    assert 5 < pressed < 55


def test_recorded_readings_are_at_the_times_of_the_motion():
    """Both channels of a run are 2 samples late if one has a delay; the delay adds 3 samples."""
    channels = tuple(jv.Channel(name, "velocity", at=1, delay=delay) for name, delay in (("a", 0.0), ("b", 0.0301)))
    readings = jnp.stack([jnp.arange(8.0), 2.0 * jnp.arange(8.0)], axis=1)[None]
    samples = SimpleNamespace(channels=channels, readings=readings, weights=jnp.ones((1, 8, 2)), step=jnp.asarray(0.01))
    values, used = _recorded(samples)
    np.testing.assert_array_equal(np.sum(used, axis=0), [6, 3])
    np.testing.assert_allclose(values[:3], jnp.stack([jnp.arange(2.0, 5.0) - 3.5, 2.0 * jnp.arange(5.0, 8.0) - 7.0], axis=1))
    samples.channels = channels[:1] * 2
    values, used = _recorded(samples)
    np.testing.assert_allclose(values[:, 0], jnp.arange(8.0) - 3.5)
    assert np.all(used)


def test_free_mass_between_stops_is_not_guided():
    """No accelerometer observes the motion of a mass without springs."""
    machine, t = jv.one_mass(mass=50.0, stiffness=0.0, damping=0.0), 0.008 * np.arange(200)
    exciter = jv.Exciter(drive=jv.RunUp(60.0, acceleration=6.0), unbalance=0.05)
    scene = jv.Scene(machine, exciters=[exciter], effects=jv.Stop(3e5, gap=1e-3))
    run = jv.MeasuredRun.from_arrays([jv.Channel("a", "acceleration", at=1)], t, {"a": np.sin(20.0 * t)})
    problem = build_problem(scene, [run], ["machine.mass"], {})
    guide = _guide(problem, 0, np.zeros(problem.unknowns.count), np.array([0.05, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(guide, np.zeros((2, 1)))


def test_guided_motion_begins_at_the_recorded_displacement(monkeypatch):
    """A free vibration; the linear response has multiples of displacements."""
    t, given = 0.005 * np.arange(600), []
    readings = 2e-3 * np.exp(-0.6 * t) * np.cos(np.sqrt(800.0 - 0.36) * t)
    run = jv.MeasuredRun.from_arrays([jv.Channel("d", "displacement", at=1)], t, {"d": readings})
    machine, drive = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0), jv.RunUp(60.0, acceleration=3.0)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=0.05)], effects=jv.Stop(3e5, gap=1.0))

    def minimize(problem, x):
        trial = project(problem._replace(linear=None), x)
        given.append(problem.linear)
        return trial if problem.linear is None else trial._replace(linear=problem.linear), None, None, True

    monkeypatch.setattr(start, "minimize", minimize)
    found, _ = start.with_guided_motion(build_problem(scene, [run], ["machine.stiffness"], {}))
    for linear in (given[0], found.linear):
        np.testing.assert_allclose(linear[2:4], [2e-3, -1.2e-3], atol=5e-5)  # velocities up to 0.06 m/s


FACTORS = {"stop[0].gap": 1.2, "stop[0].stiffness": 1.3, "machine.stiffness": 1.1, "machine.damping": 0.67}
UNKNOWN = ["machine.stiffness", "machine.damping", "exciters[0].unbalance", "effects.stop[0].stiffness", "effects.stop[0].gap"]


def first_scene(factors):
    """Return the scene with a stop and first values away from the truth."""
    numbers = truth("stop").items()
    return scene_of({name: value * next((f for word, f in factors.items() if word in name), 1.0) for name, value in numbers})


@functools.cache
def fitted():
    return jv.identify(first_scene(FACTORS), short_record("stop", LOW_NOISE), unknown=UNKNOWN)


def test_numbers_of_a_stop_and_the_machine_are_found():
    fit = fitted()
    assert fit.status_name == "found"
    away = [(each.value - truth("stop")[name]) / each.error for name, each in zip(fit.names, fit.estimates, strict=True)]
    assert np.max(np.abs(away)) < 3.5
    assert fit.estimate("effects.stop[0].gap").error < 2e-5


def slower(t):
    return tuple(0.8 * each for each in ramp(t))


class Slower(Ramp):
    """`slower` as a prescribed drive."""

    def angle_at(self, t):
        return slower(t)[0]

    def speed_at(self, t):
        return slower(t)[1]

    def acceleration_at(self, t):
        return slower(t)[2]


def slower_record(seed, **changes):
    clean = motion(truth("stop") | changes, times=SHORT, turning=slower)
    return support_record("stop", LOW_NOISE, np.random.default_rng(seed), times=SHORT, clean=clean, turning=slower)


def planned(name, drive):
    channels = [jv.Channel(name, "acceleration", at=k + 1, gain_error=0.0) for k, name in enumerate(("a1", "a2"))]
    return jv.PlannedRun(name, drive(jnp.asarray(100.0)), SHORT[-1] + SHORT[1], channels, rate=62.5)


def test_plan_repeats_a_run_on_a_stop():
    """The candidate has the speed of the record: the error of each number is divided by sqrt(2)."""
    plan = jv.plan_runs(fitted(), [planned("again", Ramp)])
    np.testing.assert_allclose(plan.errors[0] / plan.now, np.sqrt(0.5), rtol=0.05)
    with pytest.raises(jv.InputError, match=r"fit\.scene has nonlinear supports; the optimization of the speed"):
        jv.plan_runs(fitted(), [planned("again", Ramp)], limits={"speed": 130.0, "acceleration": 15.0})


@pytest.mark.slow
def test_expected_errors_on_a_stop_are_those_of_a_later_fit():
    plan = jv.plan_runs(fitted(), [planned("slower", Slower)])
    both = jv.identify(first_scene(FACTORS), [short_record("stop", LOW_NOISE), slower_record(1)], unknown=UNKNOWN)
    assert both.status_name == "found", both.notes
    np.testing.assert_allclose(plan.errors[0], [each.error / each.value for each in both.estimates], rtol=0.1)


@pytest.mark.slow
def test_further_run_on_a_stop_is_predicted():
    """The angle of the unbalance of the linear response differs from the true one by 1.6 rad."""
    found = jv.predict_run(fitted(), slower_record(1))
    assert found.status_name == "predicted" and found.p_value > 1e-3, found.notes
    np.testing.assert_allclose(found.ratio, 1.0, atol=0.15)
    other = jv.predict_run(fitted(), slower_record(2, **{"effects.stop[0].gap": 1.02e-3}))
    assert other.status_name == "contradicted" and other.notes[-1].endswith("too much to name a parameter")


def test_friction_of_a_support_is_found():
    names = ["machine.stiffness", "machine.damping", "exciters[0].unbalance", "effects.friction_support[0].force"]
    first = {"machine.stiffness": 1.1, "machine.damping": 0.67, "force": 1.5}
    numbers = {
        name: value * next((f for word, f in first.items() if word in name), 1.0) for name, value in truth("friction").items()
    }
    run = short_record("friction", LOW_NOISE)
    fit = jv.identify(scene_of(numbers), run, unknown=names)
    assert fit.status_name == "found"
    true, found = np.array([truth("friction")[name] for name in fit.names]), np.array([each.value for each in fit.estimates])
    estimates = estimator_of_supports("friction", fit.names, SHORT)
    least = bound(estimates, LOW_NOISE)
    np.testing.assert_allclose([each.error for each in fit.estimates], least * true, rtol=0.05)
    linear = linear_errors(estimates, run, motion(truth("friction"), times=SHORT))
    np.testing.assert_allclose((found / true - 1.0) / least, linear / least, atol=0.2)


def test_stop_that_no_run_touches_is_not_determined():
    """The first value of the gap is so small that the model touches the stop."""
    run = short_record("stop", LOW_NOISE, **{"effects.stop[0].gap": 1.0})
    fit = jv.identify(scene_of(truth("stop")), run, unknown=UNKNOWN)
    assert fit.status_name == "undetermined"
    lost = [name for name, each in zip(fit.names, fit.estimates, strict=True) if not np.isfinite(each.error)]
    assert lost == ["effects.stop[0].stiffness", "effects.stop[0].gap"]
    assert any(note.startswith("effects.stop[0] is not touched in the runs, which therefore do not") for note in fit.notes)


@pytest.mark.slow
@pytest.mark.parametrize("name", SUPPORT_CASES)
def test_errors_with_supports_are_those_of_linearized_fits(name):
    """The share of intervals that contain the true value depends on the noise of few records; the difference does not."""
    found = repeated(6, **SUPPORT_CASES[name])
    assert found.statuses.tolist() == ["found"] * 6
    assert np.max(np.abs(found.from_linear)) < 0.3
    np.testing.assert_allclose(found.relative / found.away, np.tile(found.bound, (6, 1)), rtol=0.1)


def refused(scene, words, names=("machine.stiffness",), channels=()):
    run = short_record("stop", LOW_NOISE)
    for channel in channels:
        same = {name: getattr(run, name) | {channel.name: getattr(run, name)["a1"]} for name in ("times", "values", "clipped")}
        run = dataclasses.replace(run, channels=(*run.channels, channel), **same)
    with pytest.raises(jv.InputError, match=words):
        jv.identify(scene, run, unknown=names)


def test_steps_resolve_the_damping_of_a_stop():
    """The method of order 8 diverges if the decay rate times the step is above 5.2."""
    machine, drive, step = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0), jv.RunUp(50.0, acceleration=5.0), 0.005

    def steps_per_sample(damping):
        stop = jv.Stop(2e5, gap=2e-3, damping=damping)
        scene = jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=0.05)], effects=(stop,))
        return divide(scene, 2000, step, {"velocity": 0.1})[2]

    assert steps_per_sample(300.0) == 1
    assert (1e5 + 60.0) / 50.0 * step / steps_per_sample(1e5) <= 3.0
    with pytest.raises(jv.InputError, match="or the damping of stops"):
        steps_per_sample(1e7)


def test_scenes_with_supports_that_are_not_included_are_refused():
    scene = scene_of(truth("stop"))
    balls = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
    refused(jv.Scene(scene.machine, balls, scene.exciter.drive, scene.effects), "effects.stop is a nonlinear support; identify")
    several = [scene.exciter, jv.Exciter(drive=jv.ConstantSpeed(50.0), unbalance=0.1)]
    refused(jv.Scene(scene.machine, exciters=several, effects=scene.effects), "only in scenes with one exciter without loads")
    refused(scene, "effects.stop is a nonlinear support, which the model", channels=(jv.Channel("f", "force", direction="up"),))
    refused(scene, "the scene has one exciter, no loads and linear supports", names=["drive.inertia"])
