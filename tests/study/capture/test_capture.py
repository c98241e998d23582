"""Captures of balls in a torus: success from an initial speed, thresholds, derivatives of the outcome."""

import dataclasses
import json
from types import SimpleNamespace

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from papers.machines import published_torus
from papers.printed_torus import printed_torus
from papers.step_doubling import refine

import jaxvib as jv
from jaxvib.cli.app import run as command
from jaxvib.draw.capture import torus_paths
from jaxvib.study.capture import curve
from jaxvib.study.capture.capture import (
    CaptureStatus,
    _summarize_captures,
    capture_time,
    moving_state,
    steps_per_second,
)


def test_a_threshold_is_bracketed_ever_finer():
    scene = published_torus(3.5)
    coarse = jv.capture(scene, np.linspace(-1.0, -0.1, 4), turns=150)
    fine = jv.capture(scene, np.linspace(-1.0, -0.1, 4), turns=150, resolution=0.02)
    assert coarse.status_name == fine.status_name == "found"
    assert float(fine.uncertainty) < 0.02 < float(coarse.uncertainty)
    assert abs(float(fine.threshold) - float(coarse.threshold)) <= float(coarse.uncertainty)
    assert np.all(np.diff(fine.speed) > 0.0) and np.all(fine.finite)
    assert np.all(fine.captured[fine.speed > float(fine.threshold)])
    assert "4 speeds, 1 start each, 150 turns" in coarse.summary() and "threshold" in fine.summary()
    # A run of its own says the same on both sides.
    for speed, caught in ((float(fine.threshold) + 0.15, True), (float(fine.threshold) - 0.15, False)):
        until = 150.0 * 2.0 * np.pi / float(scene.drive.speed)
        run = jv.simulate(scene, until, start=moving_state(scene, speed), save="window", estimate=False)
        assert bool(np.all(np.abs(run.load_speed / scene.drive.speed - 1.0) < 3e-3)) == caught


def test_fractions_of_perturbed_starts_have_a_standard_error():
    scene = published_torus(3.5)
    found = jv.capture(scene, [-1.0, -0.6, -0.1], turns=150, starts=6, spread=0.3)
    assert found.captured.shape == (3, 6) and found.fraction[0] == 0.0 and found.fraction[2] == 1.0
    assert np.all(found.standard_error > 0.0)
    again = jv.capture(scene, [-1.0, -0.6, -0.1], turns=150, starts=6, spread=0.3)
    np.testing.assert_array_equal(again.captured, found.captured)


def test_thrown_balls_lie_side_by_side_from_their_shift_on():
    scene = published_torus(3.5)
    beside = 2.0 * np.arctan(float(scene.loads.ball_radius) / float(scene.loads.radius))
    state = moving_state(scene, -0.4, shift=0.3)
    np.testing.assert_allclose(state.angle[0], 0.3 + beside * np.arange(scene.loads.count), rtol=1e-12)
    np.testing.assert_allclose(state.rate[0], 0.6 * float(scene.drive.speed), rtol=1e-12)
    np.testing.assert_allclose(scene.loads.position(*state.angle)[2], -float(scene.loads.tube - scene.loads.ball_radius))


def test_a_threshold_curve_is_captures_beside_each_other():
    speeds = np.linspace(-1.0, -0.1, 4)
    curve = jv.threshold_curve(published_torus, [2.5, 3.5], speeds, turns=150)
    alone = jv.capture(published_torus(3.5), speeds, turns=150)
    assert curve.threshold[1] == float(alone.threshold) and curve.uncertainty[1] == float(alone.uncertainty)
    assert np.all((curve.least >= -1.0) & (curve.least <= -0.1)) and curve.summary().count("+-") == 2
    assert len(curve.plot().axes) == 1
    with pytest.raises(jv.InputError, match=r"values is \[\]; it must be a list"):
        jv.threshold_curve(published_torus, [])


def test_threshold_that_did_not_converge_is_shown(monkeypatch):
    found = _summarize_captures(np.array([-1.0, -0.5]), *[np.ones((2, 1), bool)] * 2, np.zeros((2, 1), bool), 60, 1000)
    lost = dataclasses.replace(found, last_change=jnp.asarray(np.inf), status=CaptureStatus.not_converged)
    results = iter([found, lost])
    monkeypatch.setattr(curve, "capture", lambda *_, **__: next(results))
    shown = jv.threshold_curve(published_torus, [2.5, 3.5])
    assert shown.uncertainty.tolist() == [0.0, np.inf] and shown.converged.tolist() == [True, False]
    assert ["+- inf (not converged)" in line for line in shown.summary().splitlines()] == [False, False, True]


@pytest.mark.slow
def test_captures_of_balls_that_are_thrown_without_turning():
    base = published_torus(3.5)
    scene = jv.Scene(base.machine, base.loads, base.drive, (*base.all_effects, jv.Sliding(0.1)))
    rolled, slid = (jv.capture(scene, [-0.7, -0.1], turns=20, rotation=how) for how in ("rolling", "none"))
    assert np.all(rolled.finite) and np.all(slid.finite) and not np.any(rolled.captured[0])
    start = jv.with_spin(scene, moving_state(scene, -0.7), "none")
    np.testing.assert_allclose(start.spin.slip[0], -0.7 * 140.0 * 0.2)
    for scene_, how, says in ((base, "none", "term SlipRelease"), (scene, "asleep", "it must be 'rolling' or 'none'")):
        with pytest.raises(jv.InputError, match=says):
            jv.capture(scene_, [-0.5], turns=5, rotation=how)


def test_steps_double_until_borders_stay():
    """Borders 1 + 1/steps^2 with a tolerance of 0.05: 4 steps, as (1/4 - 1/16) is above it and (1/16 - 1/64) below."""
    asked = []

    def scan(which, multiple):
        asked.append((which.tolist(), multiple))
        # The second point's border never exists, the third's appears late, the fourth's never stays.
        late = np.nan if multiple == 1 else 3.0
        return [([1.0 + multiple**-2.0], [np.nan], [late], [float(multiple)])[k] for k in which]

    found = refine(scan, np.asarray, 4, tolerance=0.05, doublings=3)
    assert asked == [([0, 1, 2, 3], 1), ([0, 1, 2, 3], 2), ([0, 2, 3], 4), ([0, 3], 8)]
    assert found.multiple.tolist() == [8, 2, 4, 8] and found.last_change[:, 0].tolist() == [0.046875, 0.0, 0.0, 4.0]
    unmoved = refine(scan, np.asarray, 2, tolerance=0.05, doublings=0)
    assert unmoved.multiple.tolist() == [1, 1] and np.all(np.isnan(unmoved.last_change))


@pytest.mark.parametrize(("gap", "stiff"), [(0.5, True), (5.1, False)])
def test_first_steps_resolve_friction_up_the_tube(gap, stiff):
    """Closed form: natural frequency w sqrt((R + rho)/(7/5 rho)), friction (k/r) R w^2 R_1/rho over 7/5 of its width 1e-4 w."""
    scene, w, rho = published_torus(gap), 140.0, gap * 1e-3
    own = w * np.sqrt((0.2 + rho) / (1.4 * rho))
    friction = 4e-5 / (15e-3 - rho) * 0.2 * w**2 * 15e-3 / rho / (1.4 * 1e-4 * w)
    decay = 0.5 * (friction + np.sqrt(friction**2 - 4.0 * own**2))
    assert (decay / 3.0 > own) == stiff
    np.testing.assert_allclose(steps_per_second(scene, printed_torus), max(own, decay / 3.0), rtol=0.01 if stiff else 1e-12)
    np.testing.assert_allclose(steps_per_second(scene), own, rtol=1e-12)


def test_capture_doubles_steps_until_its_threshold_stays(monkeypatch):
    """A fifth of the needed steps captures nothing: the first doubling gives a threshold, the second keeps it."""
    scene, speeds = published_torus(3.5), np.linspace(-1.0, -0.1, 4)
    needed = steps_per_second(scene)
    chosen = jv.capture(scene, speeds, turns=150)
    assert int(chosen.steps) == 2 * int(np.ceil(150.0 * 2.0 * np.pi / 140.0 * needed))
    assert chosen.status_name == "found" and float(chosen.last_change) == 0.0
    assert "changed the threshold by 0.0e+00" in chosen.summary()
    monkeypatch.setattr("jaxvib.study.capture.capture.steps_per_second", lambda scene, equations: 0.2 * needed)
    first, early, late = (jv.capture(scene, speeds, turns=150, doublings=n) for n in (0, 1, 3))
    assert first.status_name == "none_captured" and np.isnan(first.last_change)
    assert early.status_name == "not_converged" and np.isinf(early.last_change) and np.isinf(early.uncertainty)
    assert late.status_name == "found" and float(late.last_change) == 0.0 and int(late.steps) == 4 * int(first.steps)
    np.testing.assert_array_equal(late.captured, chosen.captured)
    # Steps that are given are taken as they are.
    fixed = jv.capture(scene, speeds, turns=150, stepsize_controller=jv.EqualSteps(int(chosen.steps)))
    np.testing.assert_array_equal(fixed.captured, chosen.captured)
    assert fixed.steps == chosen.steps and np.isnan(fixed.last_change)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "finer"), [(0.1, 1), (0.1, 2), (0.05, 1), (0.025, 2)])
def test_a_threshold_is_that_of_no_step_and_of_no_smoothed_sign(width, finer):
    """The row p = 0.010, without chaotic outcomes: to 1e-3 of the rotor speed."""
    scene = published_torus(2.7, width=width)
    turns, speed = 1000, float(scene.drive.speed)
    radians = 2.0 * np.pi * turns * float(scene.loads.natural_frequency(speed)) / speed
    steps = jv.EqualSteps(finer * int(np.ceil(radians)))
    found = jv.capture(scene, THRESHOLD + np.linspace(-8e-3, 8e-3, 32), turns=turns, stepsize_controller=steps)
    assert abs(float(found.threshold) - THRESHOLD) < 1e-3


THRESHOLD = -0.572
"""Threshold for the gap of 2.7 in that row, by this package's equations, with the widest sign and the longest steps of the test
above."""


BASE = eqx.tree_at(lambda s: s.loads.drag, published_torus(3.5), jnp.asarray(0.5))
NUMBERS = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(BASE)]
AT, STEP = jnp.zeros(len(NUMBERS) + 1), 1e-5


def outcome(change, adjoint=None):
    """Capture time and what is left of the imbalance, over shares of every number of the scene, and the initial speed."""
    leaves, rest = jax.tree.flatten(BASE)
    # A number that is 0, the angle of the imbalance, has no share.
    leaves = [x * (1.0 + share) if np.asarray(x) else x + share for x, share in zip(leaves, change[:-1], strict=True)]
    scene = jax.tree.unflatten(rest, leaves)
    steps = dict(stepsize_controller=jv.EqualSteps(1500), estimate=False, adjoint=adjoint)
    run = jv.simulate(scene, 1.0, start=moving_state(scene, change[-1] - 0.2), samples=2000, **steps)
    return jnp.stack([capture_time(run), jv.regime(scene, run.window).unbalance])


def test_derivatives_of_capture_time_and_remaining_imbalance():
    evaluate = eqx.filter_jit(outcome)
    assert 0.01 < float(evaluate(AT)[0]) < 1.0 and len(NUMBERS) == 14
    forward = np.asarray(eqx.filter_jit(jax.jacfwd(lambda x: outcome(x, diffrax.ForwardMode())))(AT))
    for k, name in enumerate([*NUMBERS, "initial speed"]):
        by = AT.at[k].set(STEP)
        difference = (np.asarray(evaluate(AT + by)) - np.asarray(evaluate(AT - by))) / (2.0 * STEP)
        # Noise of the run, 1e-11 of either outcome, over the step: 1e-6; the difference's own error is the step's square.
        np.testing.assert_allclose(forward[:, k], difference, rtol=1e-4, atol=1e-5 * np.max(np.abs(forward)), err_msg=name)


@pytest.mark.slow
def test_reverse_derivatives_are_the_forward_ones():
    forward = eqx.filter_jit(jax.jacfwd(lambda x: outcome(x, diffrax.ForwardMode())))(AT)
    np.testing.assert_allclose(eqx.filter_jit(jax.jacrev(outcome))(AT), forward, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda s: jv.capture(s, [-0.2, -0.5]), "speeds is .* ascending numbers from -1 to 0 are needed"),
        (lambda s: jv.capture(s, [-1.5]), "ascending numbers from -1 to 0"),
        (lambda s: jv.capture(s, resolution=2.0), "resolution is 2.0; it must be between 0 and 1"),
        (lambda s: jv.capture(s, turns=0), "turns is 0; it must be a whole number, at least 1"),
        (
            lambda s: jv.capture(jv.Scene(s.machine, jv.balls(count=1, mass=0.1, radius=0.1, drag=0.1), s.drive)),
            "loads.kind is 'ball'; capture needs balls in a torus",
        ),
        (
            lambda s: jv.capture(jv.Scene(s.machine, s.loads, jv.DCMotor(140.0, stall_torque=2.0, inertia=0.1))),
            "drive.kind is 'dc_motor'; capture needs a prescribed speed",
        ),
        (
            lambda s: capture_time(jv.simulate(s, 0.1, start=moving_state(s, -0.1), save="window", estimate=False)),
            "run saved only its window",
        ),
    ],
)
def test_invalid_arguments_raise_clear_errors(ask, says):
    with pytest.raises(jv.InputError, match=says):
        ask(published_torus(2.5))


def test_the_command_prints_shares_and_writes_figures(tmp_path, capsys, monkeypatch):
    drawn = []

    def paths(*arrays):
        drawn[:] = arrays
        return torus_paths(*arrays)

    monkeypatch.setattr("jaxvib.draw.capture.torus_paths", paths)
    jv.save_scene(published_torus(3.5), tmp_path / "torus.toml")
    words = ["--from", "-1", "--to", "-0.1", "--speeds", "4", "--turns", "150", "--json", "--out", str(tmp_path / "o")]
    assert command(["capture", str(tmp_path / "torus.toml"), *words]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["status"] == "found" and len(document["fraction"]) == 4
    assert -1.0 < document["threshold"] < -0.1
    assert all((tmp_path / "o" / name).stat().st_size > 10_000 for name in ("capture.png", "paths.png"))
    around, in_the_tube, speed, _ = drawn  # of the run just above the threshold
    np.testing.assert_allclose(around[0], moving_state(published_torus(3.5), 0.0).angle[0], atol=1e-12)
    np.testing.assert_allclose(in_the_tube[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(speed[0], document["threshold"] + 2.0 * document["uncertainty"], rtol=1e-9)
    assert command(["capture", str(tmp_path / "torus.toml"), "--from", "0", "--to", "-1"]) == 2


@pytest.mark.parametrize(
    ("border", "status", "most"), [(-0.37, "found", 4), (-2.0, "all_captured", 1), (2.0, "none_captured", 1)]
)
def test_a_threshold_is_scanned_to_its_resolution(monkeypatch, border, status, most):
    """Runs are replaced by their outcome: starts above the border are captured."""
    scene, asked = published_torus(3.5), []

    def outcome(make, values, end, **options):
        asked.append(np.asarray(values[1]))
        assert len(asked) <= 8
        rotor = float(scene.drive.speed)
        speed = np.where(asked[-1][:, None] > border, rotor, 0.5 * rotor) * np.ones(scene.loads.count)
        none = np.zeros(speed.shape, bool)
        return SimpleNamespace(load_speed=speed, finite=np.ones(len(speed), bool), detached=none)

    monkeypatch.setattr("jaxvib.study.capture.capture.ensemble", outcome)
    monkeypatch.setattr("jaxvib.study.capture.capture.steps_per_second", lambda scene, equations: 1.0)
    found = jv.capture(scene, [-1.0, -0.1], turns=5, resolution=1e-3, doublings=0)
    assert found.status_name == status and len(asked) <= most
    if status == "found":
        assert abs(float(found.threshold) - border) <= 1e-3 and float(found.uncertainty) <= 1e-3
