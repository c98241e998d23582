"""The arguments of a run, and runs in batches."""

import dataclasses
from types import SimpleNamespace

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torus
from scenes import published, scene, some_state
from small_machine import small_machine, small_run, small_start

import jaxvib as jv
from jaxvib.motion.integrate import StepControl, effects_rate, frequency_bounds, integrate, with_jump_times
from jaxvib.motion.plan import _enough_samples, _sample_size, _step_control, enough_steps
from jaxvib.motion.simulate import _error_share
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.steady.jams.jam import jams_of


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (dict(until=-1.0), "until is -1 s; it must be greater than 0"),
        (dict(until="3 kg"), "until is '3 kg', which is not in s"),
        (dict(start="warm"), "start is 'warm'; it must be 'rest', 'jam' or 'spin_up'"),
        (dict(start="jam"), "mode is missing"),
        (dict(start="jam", mode=9), "mode is 9; this machine's jam modes are numbered 1 to 5"),
        (dict(mode=3), "mode is 3; it is used only with start='jam'"),
        (
            dict(stepsize_controller=jv.Tolerance(1e-17)),
            "tolerance is 1e-17; in float64 it must be at least 2.3e-15 and less than 1",
        ),
        (dict(stepsize_controller=jv.Tolerance(2.0)), "tolerance is 2.0; in float64"),
        (dict(spin_up=3.0), "spin_up is used only with start='spin_up'"),
        (dict(start="spin_up", spin_up=-3.0), "drive.duration is -3 s; it must be greater than 0"),
        (dict(save="none"), "save is 'none'; it must be 'all' or 'window'"),
        (dict(samples=1), "samples is 1; it must be a whole number, at least 2"),
        (dict(window_periods=0), "window_periods is 0"),
        (dict(max_steps=0), "max_steps is 0"),
        (
            dict(solver=diffrax.Euler()),
            "solver is Euler, which does not estimate the error of a step; give another solver such as diffrax.Dopri5(), or",
        ),
    ],
)
def test_wrong_arguments_raise_clear_errors(arguments, sentence):
    with pytest.raises(jv.InputError) as error:
        jv.simulate(published().scene(), **{"until": 10.0, **arguments})
    assert str(error.value).startswith(sentence)


@pytest.mark.parametrize(("mode", "says"), [(None, "mode is missing"), (9, "modes are numbered 1 to 5")])
def test_wrong_modes_are_refused_before_a_run_is_compiled(mode, says, monkeypatch):
    for name in ("simulate.prepare_run", "settle.prepare_run", "envelope.envelope.in_background"):
        monkeypatch.setattr(f"jaxvib.motion.{name}", lambda *tasks: pytest.fail("a run is compiled"))
    monkeypatch.setattr(jams_of, "is_ready", lambda scene: False)
    for ask in (jv.simulate, jv.settle, jv.envelope):
        with pytest.raises(jv.InputError, match=says):
            ask(published().scene(), *[] if ask is jv.settle else [10.0], start="jam", mode=mode)


def test_steps_resolve_what_effects_add_to_the_fastest_load():
    quick, none = (
        SimpleNamespace(fastest_rate=lambda loads, speed, rate=rate: rate) for rate in (jnp.array([9.0, 30.0, 20.0]), None)
    )
    exciter = SimpleNamespace(effects=(), loads="any", drive=jv.ConstantSpeed(5.0))
    motion = SimpleNamespace(effects=(none, quick), exciters=(exciter,))
    assert effects_rate(motion) == 30.0
    motion.effects = (none,)
    assert effects_rate(motion) == 0.0


@pytest.mark.parametrize("s", [scene("two_mass", "balls"), torus.scene()], ids=["angles", "angles and places in a tube"])
def test_memory_of_a_sample_is_that_of_its_stored_arrays(s):
    """The state, the force on the foundation, time, angle and speed of the rotor, 8 bytes each, three times; two more may be
    spare."""
    force = s.machine.carrier().foundation_stiffness.shape[0]
    kept = sum(leaf.size for leaf in jax.tree.leaves(jv.initial_state(s))) + force + 3
    assert 24.0 * kept <= _sample_size(s) <= 24.0 * (kept + 2)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(start="spin_up", spin_up=5.0), "longer than the run"),
        (dict(until=1e308), "run shorter segments"),
    ],
)
def test_runs_that_cannot_be_are_refused(change, says):
    with pytest.raises(jv.InputError, match=says):
        jv.simulate(published().scene(), **{"until": 1.0, **change})


def test_batch_over_rotor_speeds_is_a_loop():
    s, speeds = small_machine(), jnp.asarray([2.0, 3.0, 5.0])

    def one(n):
        moved = eqx.tree_at(lambda x: x.drive.speed, s, n)
        run = jv.simulate(moved, 5.0, start=small_start(), save="window", max_steps=4096)
        return run.amplitude, run.omega, run.steps

    batch = eqx.filter_jit(jax.vmap(one))(speeds)
    for k, n in enumerate(speeds):
        for a, b in zip(batch, one(n), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-8)


def test_a_scan_of_parameters_is_one_compilation():
    s, start = published(speed=3.0, eps=0.05).scene(), None
    before = len(integrate.stored.ready)
    for n in (2.0, 2.5, 3.0):
        moved = eqx.tree_at(lambda x: x.drive.speed, s, jnp.asarray(n))
        start = some_state(moved) if start is None else start
        for tolerance in (1e-6, 1e-8):
            jv.simulate(moved, 7.0, start=start, stepsize_controller=jv.Tolerance(tolerance), save="window", max_steps=2**14)
    assert len(integrate.stored.ready) - before <= 1


@pytest.mark.parametrize("speed", [10.0, 60.0])
def test_what_moves_fastest_and_slowest(speed):
    """The rotor or the platform, sqrt(4e4 / (50 + 2.4)) rad/s with three balls of 0.8 kg on it, whichever it is."""
    own = np.sqrt(4e4 / 52.4)
    found = frequency_bounds(scene("one_mass", "balls", speed=speed))
    np.testing.assert_allclose(found, [max(own, speed), own], rtol=1e-12)


@pytest.mark.parametrize(("turns", "steps"), [(8, 2**13), (1000, 2**19), (1100, 2**20)])
def test_a_run_may_take_500_steps_a_turn(turns, steps):
    """And 4096 besides, rounded up to a power of 2."""
    s = scene("one_mass", "balls", speed=100.0)
    assert enough_steps(frequency_bounds(s)[0], jnp.asarray(2.0 * np.pi * turns / 100.0)) == steps


@pytest.mark.parametrize(("turns", "samples"), [(1000, 16384), (1100, 262144)])
def test_default_number_of_stored_states(turns, samples):
    """More for more than 1024 turns of the rotor."""
    s = scene("one_mass", "balls", speed=100.0)
    assert _enough_samples(s.top_speed, jnp.asarray(2.0 * np.pi * turns / 100.0)) == samples


def test_default_tolerance_depends_on_the_precision():
    for dtype, tolerance in ((jnp.float64, 1e-8), (jnp.float32, 1e-5)):
        np.testing.assert_allclose(_step_control(jnp.asarray(1.0, dtype), None, None).tolerance, tolerance, rtol=1e-6)


def test_estimate_assumes_less_than_order_8():
    """An eighth is left where steps are half as long, 100^-0.45 where the tolerance is a hundredth."""
    equal, adaptive = ((lambda n: StepControl(steps=jnp.asarray(n))), (lambda x: StepControl(tolerance=jnp.asarray(x))))
    np.testing.assert_allclose(_error_share(equal(200.0), equal(100.0), 8), 0.125, rtol=1e-12)
    np.testing.assert_allclose(_error_share(equal(200.0), equal(100.0), 2), 1.0 / 3.0, rtol=1e-12)
    np.testing.assert_allclose(_error_share(adaptive(1e-8), adaptive(1e-6), 8), 100.0**-0.45, rtol=1e-12)


def test_given_steps_are_not_moved_to_jumps():
    run_up = eqx.tree_at(lambda s: s.exciters[0].drive, scene(), jv.RunUp(60.0, acceleration=40.0))
    for given in (diffrax.StepTo(jnp.asarray([0.0, 1.0])), diffrax.ConstantStepSize()):
        assert with_jump_times(run_up, given) is given
    assert isinstance(with_jump_times(run_up, diffrax.PIDController(1e-6, 1e-6)), diffrax.ClipStepSizeController)


def test_a_comparison_run_is_not_measured(monkeypatch):
    """Two runs for the estimate; that with larger steps has its window and its steps, and no amplitude."""
    runs = []
    monkeypatch.setattr("jaxvib.motion.simulate.integrate", lambda *given: runs.append(integrate(*given)) or runs[-1])
    run = jv.simulate(small_machine(), 20.0, start=small_start(), save="window")
    coarse, fine = sorted(runs, key=lambda each: int(each.steps))  # in whatever order, or at once
    assert int(coarse.steps) < int(fine.steps) == int(run.steps)
    assert np.all(np.isnan(coarse.amplitude)) and np.all(np.isfinite(fine.amplitude)) and float(run.error) < 1e-3
    assert np.max(np.abs(coarse.window.state.displacement - fine.window.state.displacement)) < 1e-6


class Asked(Exception):
    """Arguments with which the engine was called."""


@pytest.mark.parametrize("adjoint", [None, diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()])
@pytest.mark.parametrize("double", [True, False], ids=["float64", "float32"])
def test_a_transformed_run_takes_the_method_that_compiles_fast(monkeypatch, double, adjoint):
    """The engine's own method is used in single precision, because it alone keeps angles within a turn."""

    def asked(scene, end, state, plan, *_):
        raise Asked(plan.solver)

    monkeypatch.setattr("jaxvib.motion.simulate.integrate", asked)
    with jax.enable_x64(double):
        s = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), small_machine())
        run = lambda n: jv.simulate(eqx.tree_at(lambda x: x.drive.speed, s, n), 5.0, save="window", adjoint=adjoint)  # noqa: E731
        with pytest.raises(Asked) as found:
            jax.eval_shape(run, jnp.asarray(3.0))
        with pytest.raises(Asked) as plainly:
            run(jnp.asarray(3.0))
    (solver,) = found.value.args
    if double:
        forward = isinstance(adjoint, diffrax.ForwardMode)
        assert isinstance(solver, LoopDopri8) and (solver.tangents, solver.reuse) == (forward, forward or adjoint is None)
    else:
        assert solver is None
    assert plainly.value.args == (None,)


def test_next_tolerance_has_a_safety_margin(monkeypatch):
    """The errors are 10, 1e3 and 1e9 times the requested one, and an unknown one."""
    base = small_run(save="window")
    for times, low, high in (
        (10.0, 1e-3, 0.1),
        (1e3, 1e-5, 1e-3),
        (1e9, 0.99e-5, 1.01e-5),
        (np.inf, 1e-3, 0.1),
        (1.01, 0.05, 0.11),
    ):
        asked, errors = [], iter([times * 1e-4, 0.5e-4])

        def run(plan, control, asked=asked):
            asked.append(float(control.tolerance))
            return base

        compared = lambda *_, errors=errors: dataclasses.replace(base, error=jnp.asarray(next(errors)))  # noqa: E731
        monkeypatch.setattr("jaxvib.motion.simulate._run", run)
        monkeypatch.setattr("jaxvib.motion.simulate._compare_runs", compared)
        found = jv.simulate(base.scene, 20.0, save="window", stepsize_controller=jv.Accuracy(1e-4))
        assert bool(found.finished) and len(asked) == 3 and asked[0] > asked[1] == pytest.approx(1e-6)
        assert low <= asked[2] / asked[1] <= high, times


def test_a_run_to_an_accuracy_that_needs_more_steps_says_so(monkeypatch):
    run, asked = small_run(save="window"), jv.Accuracy(1e-6)
    for status, says in ((jv.RunStatus.max_steps_reached, "64 steps"), (jv.RunStatus.not_accurate, "requested 1.0e-06")):
        failed = dataclasses.replace(run, status=status)
        monkeypatch.setattr("jaxvib.motion.simulate._run_to_accuracy", lambda *_, failed=failed: failed)
        with pytest.raises(jv.ComputationError) as error:
            jv.simulate(run.scene, 20.0, save="window", stepsize_controller=asked, max_steps=64)
        assert says in str(error.value)
        assert ("requested" in str(error.value)) == (status is jv.RunStatus.not_accurate)
