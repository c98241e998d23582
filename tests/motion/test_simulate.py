"""The arguments of a run, and runs in batches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, some_state
from small_machine import small_machine, small_start

import jaxvib as jv
from jaxvib.motion.integrate import integrate


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (dict(until=-1.0), "until is -1 s; it must be greater than 0"),
        (dict(until="3 kg"), "until is '3 kg', which is not in s"),
        (dict(start="warm"), "start is 'warm'; it must be 'rest', 'jam' or 'spin_up'"),
        (dict(start="jam"), "mode is missing"),
        (dict(start="jam", mode=9), "mode is 9; this machine's jam modes are numbered 1 to 5"),
        (dict(mode=3), "mode is 3, which goes with start='jam' only"),
        (
            dict(stepsize_controller=jv.Tolerance(1e-17)),
            "tolerance is 1e-17; in float64 it must be at least 2.3e-15 and less than 1",
        ),
        (dict(stepsize_controller=jv.Tolerance(2.0)), "tolerance is 2.0; in float64"),
        (dict(spin_up=3.0), "spin_up goes with start='spin_up' only"),
        (dict(start="spin_up", spin_up=-3.0), "drive.duration is -3 s; it must be greater than 0"),
        (dict(save="none"), "save is 'none'; it must be 'all' or 'window'"),
        (dict(samples=1), "samples is 1; it must be a whole number, at least 2"),
        (dict(turns=0), "turns is 0"),
        (dict(max_steps=0), "max_steps is 0"),
    ],
)
def test_wrong_arguments_are_one_sentence(arguments, sentence):
    with pytest.raises(jv.InputError) as error:
        jv.simulate(published().scene(), **{"until": 10.0, **arguments})
    assert str(error.value).startswith(sentence)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(start="spin_up", spin_up=5.0), "longer than the run"),
        (dict(stepsize_controller=jv.Tolerance("small")), "tolerance is 'small'"),
        (dict(until=1e308), "run shorter stretches"),
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

    batch = jax.jit(jax.vmap(one))(speeds)
    for k, n in enumerate(speeds):
        for a, b in zip(batch, one(n), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-8)


def test_a_scan_of_parameters_is_one_compilation():
    s, start = published(speed=3.0, eps=0.05).scene(), None
    before = integrate.jitted._cached._cache_size()
    for n in (2.0, 2.5, 3.0):
        moved = eqx.tree_at(lambda x: x.drive.speed, s, jnp.asarray(n))
        start = some_state(moved) if start is None else start
        for tolerance in (1e-6, 1e-8):
            jv.simulate(moved, 7.0, start=start, stepsize_controller=jv.Tolerance(tolerance), save="window", max_steps=2**14)
    assert integrate.jitted._cached._cache_size() - before <= 1
