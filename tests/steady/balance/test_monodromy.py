"""The balanced motion."""

import jax.numpy as jnp
import numpy as np
from scenes import scene

from jaxvib.steady.balance.monodromy import _slowest_decay, balanced_motion, validate_steps


def test_balanced_loads_turn_with_the_rotor():
    s = scene(speed=7.0)
    state = balanced_motion(s, jnp.array([0.1, 2.0, 4.0]), jnp.asarray(0.5))
    np.testing.assert_allclose(state.angle[0], [0.6, 2.5, 4.5])
    np.testing.assert_array_equal(state.rate[0], [7.0, 7.0, 7.0])
    assert not np.any(state.displacement) and not np.any(state.velocity)


def test_one_program_validates_steps_at_all_speeds():
    s = scene()
    before = len(_slowest_decay.stored.ready)
    for speed in (20.0, 21.0, 22.0):
        assert validate_steps(s, [speed], None) is None
    assert len(_slowest_decay.stored.ready) - before <= 1
