"""Numbers that are read off the runs of a sweep."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.sweeps.measures import RUN_MEASURES


def watched(speeds, change=1e-4):
    """A run of 10 s under a rotor at 100 rad/s, watched in parts of 2 s: the speeds of two loads in each."""
    speeds = jnp.asarray(speeds)
    return SimpleNamespace(
        part_speed=speeds,
        part_length=jnp.asarray(2.0),
        measured=SimpleNamespace(load_speed=speeds[-1]),
        window=SimpleNamespace(rotor_speed=jnp.full(3, 100.0), time=jnp.asarray([9.0, 9.5, 10.0])),
        regime=SimpleNamespace(change=jnp.asarray(change)),
    )


@pytest.mark.parametrize(
    ("second", "settled"),
    [
        ([27.0, 27.0, 27.0, 27.0, 27.0], 0.0),
        ([10.0, 27.0, 27.0, 27.0, 27.0], 2.0),
        ([10.0, 27.0, 25.9, 27.0, 27.0], 6.0),  # near means within 1 % of the rotor's speed
        ([10.0, 27.0, 26.1, 27.0, 27.0], 2.0),
        ([10.0, 20.0, 23.0, 28.1, 27.0], 8.0),
    ],
)
def test_settling_ends_with_the_last_part_that_is_away(second, settled):
    measure = RUN_MEASURES["run.settling_time"].function
    speeds = np.stack([np.full(5, 27.0), second], axis=1)
    np.testing.assert_allclose(measure(watched(speeds)), settled)
    np.testing.assert_allclose(measure(watched(speeds[:, ::-1])), settled)
    np.testing.assert_allclose(measure(watched(speeds, change=0.02)), 10.0)
