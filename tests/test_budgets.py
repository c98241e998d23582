"""Budgets of program sizes: the cost of a first question grows with its operations.

A budget is what was counted when it was written down, with a tenth to spare. One that is broken says that something is traced
more often than before: make it less, or raise the budget together with the reason.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib.runtime import operations
from jaxvib.runtime.operations import count_operations

SCENE = scene("two_mass", "balls")
START = jv.initial_state(SCENE, "rest")


def stiffer(k):
    return eqx.tree_at(lambda s: s.machine.stiffness, SCENE, k)


def field(k):
    return jv.vector_field(stiffer(k))(0.0, START)


def modes(k):
    return jv.jam_modes(stiffer(k)).foundation_force[2]


def orbit(k):
    return jv.jam_orbit(stiffer(k), mode=3).foundation_force


def run(k, **options):
    found = jv.simulate(stiffer(k), 5.0, start=START, save="window", max_steps=4096, **options)
    return found.foundation_force


def forward_run(k):
    return run(k, adjoint=diffrax.ForwardMode())


BUDGETS = {
    "vector field": (field, 134),
    "jam_modes": (modes, 1400),
    "jam_modes, gradient": (jax.grad(modes), 2050),
    # With the check of traced numbers, power without cancellation, the number of steps, and the error of multipliers.
    "jam_orbit": (orbit, 3390),
    "jam_orbit, gradient": (jax.grad(orbit), 4010),  # 150 of them fill places of steps that are not taken
    "simulate": (run, 2420),
    "simulate, forward derivatives": (jax.jacfwd(forward_run), 4600),
    "simulate, reverse derivatives": (jax.grad(run), 4190),
}


@pytest.mark.parametrize("name", BUDGETS)
def test_a_program_keeps_its_budget(name):
    question, budget = BUDGETS[name]
    counted = count_operations(question, SCENE.machine.stiffness)
    assert counted <= budget, f"{name}: {counted} operations"
    assert counted > 0.8 * budget, f"{name}: {counted} operations, far fewer than its budget: lower the budget"


def test_a_larger_program_is_noticed():
    """Traced twice, a question has twice the operations."""
    once = count_operations(field, SCENE.machine.stiffness)
    assert count_operations(lambda k: (field(k), field(2.0 * k)), SCENE.machine.stiffness) > 1.8 * once


def two(x):
    shared = jnp.exp(x)
    found = [jnp.sin(shared), jnp.tan(x) * shared, jnp.log(x)]
    return [found[0], found[2]]


def test_operations_that_no_result_needs_are_left_out(monkeypatch):
    """All operations stay where nobody may read programs."""
    x = jnp.asarray(0.5)
    few = operations.pruned(two, x)
    assert count_operations(two, x) == 5 and count_operations(few, x) == 3 and few(x) == two(x)
    slope = x * (jnp.cos(jnp.exp(x)) * jnp.exp(x) + 1.0 / x)
    np.testing.assert_allclose(jax.vjp(few, x)[1]([x, x])[0], slope, rtol=1e-15)
    monkeypatch.setattr(operations, "HAS_JAXPRS", False)
    assert operations.pruned(two, x)(x) == two(x)


def test_an_operation_with_one_needed_result_stays():
    pair = jnp.asarray([3.0, 1.0])
    (found,) = operations.pruned(lambda x: [jax.lax.sort((x, -x), num_keys=1)[1]], pair)(pair)
    assert found.tolist() == [-1.0, -3.0]
