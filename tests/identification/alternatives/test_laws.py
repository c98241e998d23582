"""Laws of friction that are named after a patterned fit, and dry friction that follows from residuals."""

import numpy as np
import pytest
from repeated_records.fits import JAMMED_NOISE, NAMES, NOISE
from repeated_records.jammed import RADIUS, TIMES, TRUTH, jammed_record, scene_of, turning
from repeated_records.laws import Named, named
from repeated_records.supports import motion, support_record, truth
from run_ups_by_scipy import TRUTH as MACHINE
from run_ups_by_scipy import record
from run_ups_by_scipy import scene_of as linear_scene_of
from scipy.signal import lsim

import jaxvib as jv
from jaxvib.identification.alternatives import laws
from jaxvib.identification.alternatives.laws import AirDrag
from jaxvib.identification.alternatives.support_friction import _responses
from jaxvib.identification.problem import build_problem
from jaxvib.identification.records.decimation import MIN_SAMPLES

FORCE = "effects.friction_support[0].force"


def first_values(numbers, factors):
    return {name: value * next((f for word, f in factors.items() if word in name), 1.0) for name, value in numbers.items()}


def law_notes(fit):
    return [note for note in fit.notes if "fits clearly better" in note]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "changes", "is_named"), [("friction", {}, True), ("friction", {FORCE: 5.0}, True), ("cubic", {}, False)]
)
def test_dry_friction_of_a_support_is_named(kind, changes, is_named):
    """A cubic support also causes residuals, but no friction explains them."""
    run = support_record(kind, NOISE, np.random.default_rng(0), clean=motion(truth(kind) | changes))
    scene = linear_scene_of(first_values(MACHINE, {"stiffness": 1.02, "damping": 1.1}))
    fit = jv.identify(scene, run, unknown=NAMES)
    assert fit.status_name == "patterned"
    notes = law_notes(fit)
    assert len(notes) == is_named
    if is_named:
        assert notes[0].startswith("the model fits clearly better with dry friction at platform 2: the residuals are 0.")
        assert f"platform=2) to the scene, and '{FORCE}' to `unknown`" in notes[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "words"),
    [
        ({"lever": 2e-4}, "rolling friction of the loads"),
        ({"air": 2e-5}, "a drag of the air, proportional to the squared speed"),
    ],
)
def test_law_of_jammed_balls_is_named(law, words):
    """The torques of both laws are about a tenth of that of the drag."""
    run = jammed_record(JAMMED_NOISE, np.random.default_rng(0), **law)
    scene = scene_of(first_values(TRUTH, {"stiffness": 1.05, "damping": 1.0 / 1.3, "loads.mass": 1.1, "drag": 1.0 / 1.2}))
    fit = jv.identify(scene, run, unknown=[*NAMES, "loads.mass", "loads.drag"])
    assert fit.status_name == "patterned"
    (note,) = law_notes(fit)
    assert note.startswith(f"the model fits clearly better with {words}")


def test_no_law_is_named_if_the_fit_lacks_none():
    assert named(np.random.default_rng([1, 0]), color=0.9) == Named("found", [], [])


@pytest.mark.slow
def test_no_law_of_jammed_balls_is_named_if_the_fit_lacks_none():
    assert named(np.random.default_rng([1, 0]), balls=True) == Named("found", [], [])


@pytest.mark.parametrize(("count", "is_tried"), [(MIN_SAMPLES - 1, True), (MIN_SAMPLES, False)])
def test_friction_of_supports_is_not_tried_for_long_runs(monkeypatch, count, is_tried):
    """The rate of a long run is reduced for a linear machine only."""
    monkeypatch.setattr(laws, "likely_friction", lambda fitted, scene: jv.FrictionSupport(20.0, 0.01, platform=2))
    run = jv.MeasuredRun.from_arrays([jv.Channel("a1", "acceleration", at=1)], 0.01 * np.arange(count), {"a1": np.zeros(count)})
    assert [law.name for law in laws._laws_of_supports(None, linear_scene_of(MACHINE), [run])] == [FORCE] * is_tried


def test_responses_are_those_of_scipy():
    rng, step = np.random.default_rng(0), 0.01
    mass, damping, stiffness = (
        np.diag([2.0, 3.0]),
        np.array([[4.0, -1.0], [-1.0, 3.0]]),
        np.array([[900.0, -300.0], [-300.0, 800.0]]),
    )
    forces, outputs = rng.normal(size=(200, 2, 3)), rng.normal(size=(4, 3, 2))
    flow = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)]])
    given = np.concatenate([np.zeros((2, 2)), np.linalg.inv(mass)])
    rows = np.concatenate([outputs[:, 0], outputs[:, 1]], axis=1) + outputs[:, 2] @ flow[2:]
    forced, free = _responses(forces, step, [mass, damping, stiffness], outputs)
    time = step * np.arange(200)
    for k in range(3):
        expected = lsim((flow, given, rows, outputs[:, 2] @ given[2:]), forces[:, :, k], time)[1]
        np.testing.assert_allclose(forced[:, :, k], expected, atol=1e-9 * np.max(np.abs(expected)))
    for k in range(4):
        expected = lsim((flow, given, rows, np.zeros((4, 2))), np.zeros((200, 2)), time, X0=np.eye(4)[k])[1]
        np.testing.assert_allclose(free[:, :, k], expected, atol=1e-9 * np.max(np.abs(expected)))


def test_drag_of_the_air_brakes_both_ways():
    loads = jv.balls(count=2, mass=0.8, radius=RADIUS, drag=1.5)
    (torque,) = AirDrag(drag=np.array(1e-3)).resistance(loads, (np.zeros(2),), (np.array([20.0, -30.0]),))
    np.testing.assert_allclose(torque, [-0.4, 0.9])


@pytest.mark.parametrize("kind", ["balls", "pendulums"])
def test_friction_of_loads_can_be_unknown(kind):
    scene = scene_of(TRUTH)
    if kind == "balls":
        loads, effect = jv.balls(count=2, mass=0.8, radius=RADIUS, drag=1.5, ball_radius=0.01), jv.RollingFriction(2e-5)
    else:
        loads, effect = jv.pendulums(count=2, mass=0.8, radius=RADIUS, drag=1.5), jv.DryFriction(0.002, diameter=0.01)
    name = f"effects.{effect.kind}.coefficient"
    still = record(TIMES, np.zeros((TIMES.size, 2)), 0.2, np.random.default_rng(0), turning=turning)
    problem = build_problem(scene.replace(loads=loads, effects=effect), [still], ["loads.drag", name], {})
    assert [number.name for number in problem.unknowns.numbers] == ["loads.drag", name]
