"""The step-size control of the engine."""

import diffrax
import jax
import jax.numpy as jnp

from jaxvib.ode.control import PIController


@jax.jit
def decay(max_steps):
    control = PIController(jnp.asarray(1e-9), jnp.asarray(1.0), jnp.asarray(1.0), max_steps)
    term = diffrax.ODETerm(lambda t, y, args: -y)
    done = diffrax.diffeqsolve(
        term, diffrax.Dopri8(), 0.0, 20.0, 1.0, jnp.asarray(1.0), stepsize_controller=control, max_steps=None, throw=False
    )
    return done.stats["num_steps"], done.result == diffrax.RESULTS.successful, done.result == diffrax.RESULTS.max_steps_reached


def test_a_run_that_needs_exactly_the_allowed_steps_is_done():
    needed, done, _ = decay(jnp.asarray(1000))
    assert 5 < needed < 100 and done
    assert decay(needed)[1:] == (True, False)
    assert decay(needed - 1)[1:] == (False, True)
