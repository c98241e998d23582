"""Newton's method for exact motions: roots in closed form, and evaluations of the equations."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.steady.orbits.solve import newton


def test_a_step_below_rounding_is_taken_without_an_evaluation():
    """x^2 = 2 from 1.5: residuals 0.25, 7e-3, 6e-6, 5e-12; the next one would be 2e-24."""
    calls = []

    def linearize(x):
        jax.debug.callback(lambda _: calls.append(1), x)
        return jnp.abs(x**2 - 2.0), jnp.asarray(2.0), lambda: (2.0 - x**2) / (2.0 * x)

    (root,) = newton(
        linearize, lambda at, change, length: (at[0] + length * change,), (jnp.asarray(1.5),), *jnp.asarray([0.0, 1.0])
    )
    jax.effects_barrier()
    np.testing.assert_allclose(root, np.sqrt(2.0), rtol=4e-16)
    assert len(calls) == 4
