"""Runs of numbers that are not known while a program is built, and turn out not to be allowed, end in a status."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.results.status import status_names

SCENE = jv.Scene(
    jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5),
    jv.ConstantSpeed(60.0),
)
PLACES = {
    "stiffness": lambda scene: scene.machine.stiffness,
    "damping": lambda scene: scene.machine.damping,
    "machine's mass": lambda scene: scene.machine.mass,
    "loads' mass": lambda scene: scene.loads.mass,
    "radius": lambda scene: scene.loads.radius,
    "drag": lambda scene: scene.loads.drag,
    "speed": lambda scene: scene.drive.speed,
}
GOOD = [place(SCENE) for place in PLACES.values()]
QUESTIONS = {
    "simulate": lambda scene: jv.simulate(scene, 1.0, save="window", max_steps=4096),
    "envelope": lambda scene: jv.envelope(scene, 1.0, max_steps=4096),
}


def with_numbers(values):
    return eqx.tree_at(lambda s: [place(s) for place in PLACES.values()], SCENE, values)


def numbers_of(found):
    """Floating-point numbers of a result, without those of the scene that it is about."""
    found = eqx.tree_at(lambda result: result.scene, found, None) if hasattr(found, "scene") else found
    return [leaf for leaf in jax.tree.leaves(found) if jnp.issubdtype(leaf.dtype, jnp.inexact)]


@pytest.mark.parametrize("question", QUESTIONS)
def test_runs_of_forbidden_numbers_end_in_a_status(question):
    program = jax.jit(lambda values: QUESTIONS[question](with_numbers(values)))
    good = program(GOOD)
    assert good.status_name == "done" and np.isfinite(float(good.foundation_force))
    for k, place in enumerate(PLACES):
        for wrong in (-GOOD[k], GOOD[k] * jnp.nan):
            found = program([*GOOD[:k], wrong, *GOOD[k + 1 :]])
            assert found.status_name == "refused", place
            assert all(bool(jnp.all(jnp.isnan(leaf))) for leaf in numbers_of(found)), place


@pytest.mark.parametrize("question", ["simulate", "envelope", "ensemble"])
def test_an_end_that_is_not_after_the_start_is_refused(question):
    """The end time is not known while the program is built; an ensemble ran backward."""

    def ask(until):
        if question == "ensemble":
            return jv.ensemble(lambda _: SCENE, jnp.ones(2), until, stepsize_controller=jv.EqualSteps(400))
        return getattr(jv, question)(SCENE, until, save="window", max_steps=4096)

    program = jax.jit(ask)
    names = [set(np.ravel(status_names(program(until).status))) for until in (1.0, -1.0, 0.0, jnp.nan, jnp.inf)]
    assert names == [{"done"}, {"refused"}, {"refused"}, {"refused"}, {"refused"}]
    assert bool(jnp.all(jnp.isnan(program(-1.0).foundation_force if question != "ensemble" else program(-1.0).load_speed)))


def test_runs_of_a_batch_are_refused_one_by_one():
    """The others keep their numbers and their derivatives."""
    stiffness, until = jnp.asarray([4e4, -4e4, 5e4]), 1.0

    def run(k):
        return jv.simulate(with_numbers([k[None], *GOOD[1:]]), until, save="window", max_steps=4096)

    found = jax.vmap(run)(stiffness)
    assert status_names(found.status).tolist() == ["done", "refused", "done"]
    alone = run(stiffness[2])
    np.testing.assert_allclose(found.foundation_force[2], alone.foundation_force, rtol=1e-9)


@pytest.mark.parametrize("jitted", [False, True])
def test_an_ensemble_refuses_single_runs(jitted):
    """Its function `make` builds scenes of unknown numbers; the other runs are those of an ensemble without the wrong one."""
    steps = jv.EqualSteps(400)

    def many(values):
        return jv.ensemble(with_numbers, values, 1.0, stepsize_controller=steps)

    values = [jnp.stack([value, wrong, 1.1 * value]) for value, wrong in zip(GOOD, GOOD, strict=True)]
    kept = many([value[::2] for value in values])
    for k, place in enumerate(PLACES):
        for wrong in (-GOOD[k], GOOD[k] * jnp.nan):
            found = (jax.jit(many) if jitted else many)([*values[:k], values[k].at[1].set(wrong), *values[k + 1 :]])
            assert status_names(found.status).tolist() == ["done", "refused", "done"], place
            assert bool(jnp.all(jnp.isnan(found.load_speed[1]))) and found.finite.tolist() == [True, False, True]
            np.testing.assert_allclose(found.load_speed[::2], kept.load_speed, rtol=1e-9)


def test_a_refused_run_does_not_set_the_steps_of_others():
    values = [jnp.stack([value, value]) for value in GOOD]
    drags = values[5].at[1].set(-1e9)
    alone = jv.ensemble(with_numbers, [value[:1] for value in values], 1.0)
    both = jv.ensemble(with_numbers, [*values[:5], drags, *values[6:]], 1.0)
    assert int(both.steps) == int(alone.steps) and status_names(both.status).tolist() == ["done", "refused"]
    none = jv.ensemble(with_numbers, [*(value[1:] for value in values[:5]), drags[1:], values[6][1:]], 1.0)
    assert status_names(none.status).tolist() == ["refused"]
