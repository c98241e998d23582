"""Quantities of a run-up, from motions in closed form."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from optimize import peak_force, settling_time

TIME = jnp.linspace(0.0, 10.0, 2001)
SPEED = 7.0


def evaluation(size, force=None):
    """Evaluation of a run-up with this amplitude of platform 2; platform 1 rests."""
    y, v = size * jnp.sin(SPEED * TIME), size * SPEED * jnp.cos(SPEED * TIME)
    state = SimpleNamespace(displacement=jnp.stack([0.0 * y, y], axis=1), velocity=jnp.stack([0.0 * v, v], axis=1))
    run = SimpleNamespace(trajectory=SimpleNamespace(state=state, time=TIME), omega=jnp.asarray(SPEED), largest_force=force)
    return SimpleNamespace(
        start_up=lambda until, spin_up: run if (until, spin_up) == (10.0, 2.0) else None,
        scene=SimpleNamespace(machine=SimpleNamespace(has_foundation=True)),
    )


@pytest.mark.parametrize("within", [0.05, 0.2])
@pytest.mark.parametrize("size", [0.02, 3.0])
def test_settling_time_ends_within_the_given_share(within, size):
    """size (1 - exp(-t)): off by more than the share of its end until t = -ln(within). Samples are 5 ms apart."""
    asked = settling_time(until=10.0, spin_up="2 s", within=within, of=2)
    last = float(jnp.mean(1.0 - jnp.exp(-TIME[-100:])))
    found = float(asked.read(evaluation(size * (1.0 - jnp.exp(-TIME)))))
    np.testing.assert_allclose(found, -np.log(1.0 - last * (1.0 - within)), atol=1e-5)  # h^2/8 of the line between samples
    later = float(asked.read(evaluation(size * (1.0 + jnp.where(TIME > 4.0, 0.0, 1.0)))))  # too large at first
    np.testing.assert_allclose(later, 4.0, atol=0.006)


def test_settling_time_of_unsettled_motion_is_the_end():
    falling = evaluation(2.0 - 0.1 * TIME)
    np.testing.assert_allclose(settling_time(until=10.0, spin_up=2.0, within=0.001, of=2).read(falling), 10.0, atol=0.006)
    # Where not even the last sample is near enough, the end of the run is the answer, and nothing moves it.
    still = lambda slope: settling_time(until=10.0, spin_up=2.0, within=1e-6, of=2).read(evaluation(2.0 - slope * TIME))  # noqa: E731
    time, by_slope = jax.value_and_grad(still)(0.1)
    np.testing.assert_allclose(time, 10.0, atol=0.006)
    assert by_slope == 0.0
    with pytest.raises(jv.InputError, match="platforms 1 to 2"):
        settling_time(until=10.0, spin_up=2.0, of=3).read(falling)
    for within in (0.0, 1.0):
        with pytest.raises(jv.InputError, match="greater than 0 and less than 1"):
            settling_time(until=10.0, spin_up=2.0, within=within)
    for wrong in (0.0, 11.0):
        with pytest.raises(jv.InputError, match="at most until, 10 s"):
            peak_force(until=10.0, spin_up=wrong)


def test_the_peak_of_a_force_is_the_largest_of_the_run():
    assert float(peak_force(until=10.0, spin_up=2.0).read(evaluation(TIME, jnp.asarray(7.5)))) == 7.5


def test_platforms_are_counted_from_one():
    for wrong in (0, -1, True, 1.0, None):
        with pytest.raises(jv.InputError, match="of is"):
            settling_time(until=10.0, spin_up=2.0, of=wrong)
