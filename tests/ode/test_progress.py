"""The progress meter of a time integration."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.ode.progress import ProgressMeter


def shares_of(steps):
    """Shares that a meter shows of an integration in equal steps."""
    shown = []
    term = diffrax.ODETerm(lambda t, y, args: -y)
    kept = dict(max_steps=4 * steps, progress_meter=ProgressMeter(shown.append))
    diffrax.diffeqsolve(term, diffrax.Euler(), 0.0, 1.0, 1.0 / steps, jnp.ones(()), **kept)
    jax.effects_barrier()
    return np.array(shown)


def test_the_meter_shows_each_step_up_to_the_end():
    np.testing.assert_allclose(shares_of(8), np.arange(1, 9) / 8.0, rtol=1e-12)


def test_the_meter_shows_a_per_cent_or_more_at_once():
    shares = shares_of(1000)
    assert 80 <= len(shares) <= 101 and shares[-1] == 1.0 and np.min(np.diff(shares[:-1])) > 0.01
