"""Energy and power."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rotors import CASES, case, rotor_state

import jaxvib as jv


@pytest.mark.parametrize("name", CASES)
def test_energy_changes_by_the_power_that_comes_and_goes(name):
    s = case(name)
    state, t = rotor_state(s, 3), jnp.asarray(0.7)
    field = jv.vector_field(s)(t, state)
    _, change = jax.jvp(functools.partial(jv.energy, s), (state, t), (field, jnp.ones_like(t)))
    supplied, lost = jv.power(s, t, state)
    size = abs(float(supplied)) + abs(float(lost))
    assert float(lost) > 0.0
    np.testing.assert_allclose(change, supplied - lost, atol=1e-11 * size)
