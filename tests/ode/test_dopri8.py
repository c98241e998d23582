"""Both forms of the step of order 8 against diffrax's."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, some_state

import jaxvib as jv
from jaxvib.ode.dopri8 import UnrolledDopri8
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.runtime.compat import no_host_checks


@pytest.mark.parametrize("method", [UnrolledDopri8(), LoopDopri8(), LoopDopri8(reuse=True)])
@no_host_checks()  # programs with these are compiled anew each time
def test_the_step_is_diffraxs(method):
    """Same method, another form: the same steps to rounding, dense output included."""
    s = published(speed=3.0, eps=0.05).scene()
    field, start = jv.vector_field(s), some_state(s)

    def solve(solver):
        term = diffrax.ODETerm(lambda t, y, args: args(t, y))
        control = diffrax.PIDController(rtol=1e-8, atol=1e-8)
        save = diffrax.SaveAt(ts=jnp.linspace(0.0, 5.0, 37))
        return diffrax.diffeqsolve(term, solver, 0.0, 5.0, 0.01, start, field, saveat=save, stepsize_controller=control)

    ours, theirs = solve(method), solve(diffrax.Dopri8())
    assert int(ours.stats["num_steps"]) == int(theirs.stats["num_steps"])
    for a, b in zip(jax.tree.leaves(ours.ys), jax.tree.leaves(theirs.ys), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9, equal_nan=False)


@pytest.mark.parametrize("method", [UnrolledDopri8(), LoopDopri8(reuse=True)])
@no_host_checks()
def test_a_state_may_hold_numbers_and_arrays(method):
    """y' = -2 t y of a number, an array and a number: exp(-1) of each."""
    start = jnp.asarray(2.0), jnp.array([1.0, -3.0]), jnp.asarray(0.5)
    term = diffrax.ODETerm(lambda t, y, args: jax.tree.map(lambda leaf: -2.0 * t * leaf, y))
    end = diffrax.diffeqsolve(term, method, 0.0, 1.0, 0.1, start, saveat=diffrax.SaveAt(t1=True))
    for found, first in zip(end.ys, start, strict=True):
        np.testing.assert_allclose(found[0], np.exp(-1.0) * first, rtol=1e-12)


@pytest.mark.parametrize("method", [UnrolledDopri8(), LoopDopri8(), LoopDopri8(reuse=True)])
def test_a_jump_of_the_field_begins_a_step_anew(method):
    """y' = 1 until t = 1, 3 from then on: with the rate of before as the first of the step after it, 1e-2 would be missing."""
    term = diffrax.ODETerm(lambda t, y, args: jnp.where(t < 1.0, 1.0, 3.0))
    control = diffrax.ClipStepSizeController(diffrax.PIDController(rtol=1e-6, atol=1e-6), jump_ts=jnp.asarray([1.0]))
    end = diffrax.diffeqsolve(term, method, 0.0, 2.0, 0.3, jnp.asarray(0.0), stepsize_controller=control).ys
    np.testing.assert_allclose(end[-1], 4.0, rtol=1e-12)
