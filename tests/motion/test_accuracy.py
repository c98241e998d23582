"""Steps, estimates of the error and the accuracy asked for."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scenes import published, scene, some_state

import jaxvib as jv
from jaxvib.motion.analysis.scaled_error import error_scale, estimated_error, natural_units, scaled_error


def test_equal_steps_are_of_order_8():
    s = published(speed=1.5, eps=0.05).scene()
    start = jv.initial_state(s, "jam", mode=3)
    ends = [ravel_pytree(jax.tree.map(lambda x: x[-1], run.window.state))[0] for run in _runs(s, start, (60, 90, 135, 600))]
    error = [float(jnp.max(jnp.abs(end - ends[-1]))) for end in ends[:-1]]
    orders = np.log(np.array(error[:-1]) / np.array(error[1:])) / np.log(1.5)
    assert np.all(orders > 7.0), (error, orders)


MAX_STEPS = 2**18
"""Enough for the longest run here: the number is part of the program, and one program serves all."""


def _runs(s, start, steps):
    return [
        jv.simulate(s, 40.0, start=start, stepsize_controller=jv.EqualSteps(n), save="window", estimate=False) for n in steps
    ]


def test_the_estimate_is_slightly_above_the_error():
    s = published(speed=5.0, eps=0.05).scene()
    asked = dict(start=some_state(s), save="window", max_steps=MAX_STEPS)
    best = jv.simulate(s, 60.0, **asked, stepsize_controller=jv.Tolerance(1e-13)).window.state

    def apart(run):
        a, b = run.window.state, best
        pairs = ((a.displacement, b.displacement), (a.velocity, b.velocity))
        parts = [float(jnp.max(jnp.abs(x - y)) / jnp.max(jnp.abs(y))) for x, y in pairs]
        return max(
            *parts, float(jnp.max(jnp.abs(a.angle[0] - b.angle[0]))), float(jnp.max(jnp.abs(a.rate[0] - b.rate[0]))) / 5.0
        )

    for tolerance in (1e-5, 1e-7, 1e-9, 1e-11):
        run = jv.simulate(s, 60.0, **asked, stepsize_controller=jv.Tolerance(tolerance))
        assert apart(run) <= float(run.error) <= 300.0 * apart(run), (tolerance, apart(run), float(run.error))
        alone = jv.simulate(s, 60.0, **asked, stepsize_controller=jv.Tolerance(tolerance), estimate=False)
        assert int(alone.evaluations) == 13 * int(alone.steps) == 13 * int(run.steps) and np.isnan(alone.error)
        # What the estimate cost is counted: the run with larger steps takes at least half as many, at most all.
        assert 1.5 * int(alone.evaluations) < int(run.evaluations) < 2 * int(alone.evaluations)
        assert float(run.seconds) > 0.0
    for accuracy in (1e-3, 1e-8):
        run = jv.simulate(s, 60.0, **asked, stepsize_controller=jv.Accuracy(accuracy))
        assert bool(run.status == jv.RunStatus.done) and apart(run) <= float(run.error) <= accuracy
        before = int(run.evaluations) - 13 * int(run.steps)  # of the runs to larger tolerances, each with fewer steps
        assert 13 * int(run.steps) // 3 < before and before % 13 == 0


def test_estimate_knows_the_order_of_the_method():
    """The error of Euler's method halves for twice the number of steps, so that it equals the difference of both runs."""
    s = scene("one_mass", "rollers", speed=60.0)
    many = dict(solver=diffrax.Euler(), save="window", max_steps=2**20)
    run, best = (jv.simulate(s, 0.2, **many, stepsize_controller=jv.EqualSteps(n)) for n in (1000, 100_000))
    scale = error_scale(run.window.state, natural_units(s))
    error = float(scaled_error(run.window.state, best.window.state, scale))
    assert 0.9 * error < float(run.error) < 1.2 * error


def test_an_accuracy_missed_at_first_is_not_overshot():
    """Behind a stop the error is 50 times the accuracy at first: the tolerance falls by a little more than that."""
    loads = jv.pendulums(count=1, mass=1.0, radius=0.125, drag=1.0)
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)
    s = jv.Scene(machine, loads, jv.ConstantSpeed(40.0), (jv.Stop(5e5, gap=1e-3),))
    run = jv.simulate(s, 2.0, save="window", max_steps=2**17, stepsize_controller=jv.Accuracy(1e-5))
    assert 13 * int(run.steps) < int(run.evaluations) / 1.8 and 1e-6 < float(run.error) <= 1e-5


def test_an_accuracy_that_is_not_reached_has_a_status(monkeypatch):
    s = published(speed=5.0, eps=0.05).scene()
    monkeypatch.setattr("jaxvib.motion.simulate._MAX_ACCURACY_RUNS", 2)
    asked = dict(start=some_state(s), save="window", stepsize_controller=jv.Accuracy(1e-12), max_steps=MAX_STEPS)
    # So long that rounding alone makes more than this error.
    run = jv.simulate(s, 200.0, **asked, throw=False)
    assert bool(run.status == jv.RunStatus.not_accurate) and float(run.error) > 1e-12
    with pytest.raises(jv.ComputationError, match=r"requested 1\.0e-12") as caught:
        jv.simulate(s, 200.0, **asked)
    assert caught.value.status == "not_accurate"


def test_differences_of_states_are_the_same_within_programs():
    a, b = (
        jv.State(*(np.asarray([k * x]) for x in (1e-3, 0.2)), (np.asarray([k]),), (np.asarray([50.0 * k]),)) for k in (1.0, 1.5)
    )
    unit = jv.State(1e-4, 5e-3, (1.0,), (50.0,))
    found = scaled_error(a, b, error_scale(b, unit))
    assert isinstance(found, np.floating) and found == 0.5  # of the angle, rad, and of the speed
    assert float(jax.jit(lambda a, b: scaled_error(a, b, error_scale(b, unit)))(a, b)) == 0.5


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (dict(stepsize_controller=1e-6), "stepsize_controller is 1e-06; it must be a Tolerance"),
        (dict(stepsize_controller=jv.Accuracy(1e-14)), "accuracy is 1e-14; in float64 it must be at least 2.3e-13"),
        (dict(stepsize_controller=jv.EqualSteps(0)), "steps is 0"),
    ],
)
def test_ways_to_choose_steps_that_cannot_be(given, says):
    with pytest.raises(jv.InputError) as caught:
        jv.simulate(published().scene(), 1.0, **given)
    assert says in str(caught.value)


def test_accuracy_looks_at_numbers():
    s = published().scene()

    def omega(n):
        return jv.simulate(eqx.tree_at(lambda x: x.drive.speed, s, n), 1.0, stepsize_controller=jv.Accuracy(1e-4)).omega

    with pytest.raises(jv.InputError, match="use Tolerance"):
        eqx.filter_jit(omega)(jnp.asarray(2.0))


@pytest.mark.parametrize("double", [True, False], ids=["float64", "float32"])
def test_estimate_exceeds_the_error_with_a_stop(double):
    """Two runs whose steps miss the same touch are nearer to each other than to the truth (benchmarks/trials/estimates.py).

    Two seconds: after four one of these motions has nothing left of its start, and no error is small or large."""
    rng = np.random.default_rng(0)
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)
    asked = dict(save="window", max_steps=2**17)
    below = []
    for tolerance in (1e-6, 1e-7, 1e-8) if double else (1e-4, 1e-5):
        for _ in range(4):
            numbers = (rng.uniform(1e5, 1e6), rng.uniform(1e-4, 2e-3), rng.uniform(0.5, 1.5))
            stiffness, gap, mass = (float(np.float32(x)) for x in numbers)
            loads = jv.pendulums(count=1, mass=mass, radius=0.125, drag=1.0)
            s = jv.Scene(machine, loads, jv.ConstantSpeed(40.0), (jv.Stop(stiffness, gap=gap),))
            best = jv.simulate(s, 2.0, **asked, stepsize_controller=jv.Tolerance(1e-13), estimate=False)
            with jax.enable_x64(double):
                own = jax.tree.map(lambda x: jnp.asarray(x, float), s)
                run = jv.simulate(own, 2.0, **asked, stepsize_controller=jv.Tolerance(tolerance))
            a, b = (jax.tree.map(lambda x: np.asarray(x, float), r.window.state) for r in (run, best))
            error = np.max(np.abs(a.displacement - b.displacement)) / np.max(np.abs(b.displacement))
            below.append(error <= float(run.error))
    assert np.all(below)


def test_the_estimate_counts_rounding_of_steps_and_of_what_turns():
    smooth, rough = scene("two_mass", "balls"), scene("two_mass", "balls", effects=jv.Stop("5 kN/mm", gap="3 mm", platform=1))
    eps = np.finfo(float).eps
    for case, share in ((smooth, 0.01), (rough, 2.0)):
        found = estimated_error(np.asarray(1e-9), 0.01, case, steps=1000, radians=3e5)
        np.testing.assert_allclose(found, share * 1e-9 + 2.0 * eps * 301000.0, rtol=1e-12)
