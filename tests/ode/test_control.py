"""The step-size control of the engine."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.ode.control import PIController, step_success


@eqx.filter_jit
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


def decided(error, before=1.0, y0=0.5, y1=-2.0, unit=1.0, relative=1.0, dtype=jnp.float64):
    """Decision of the controller with the tolerance 1e-3 about a step from 2 to 3 with this error, after one with the ratio
    `before`."""
    y0, y1, error = (jnp.asarray(x, dtype) for x in (y0, y1, error))
    control = PIController(jnp.asarray(1e-3, dtype), jnp.asarray(unit, dtype), jnp.asarray(relative, dtype))
    state = jnp.asarray(before ** (1.0 / 32.0), dtype), None
    accept, start, end, _, (root, _), result = control.adapt_step_size(
        jnp.asarray(2.0, dtype), jnp.asarray(3.0, dtype), y0, y1, None, error, 8, state
    )
    return bool(accept), float(start), float(end - start), float(root) ** 32, result == diffrax.RESULTS.successful


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize(("ratio", "before"), [(0.3, 1.0), (0.9, 0.2), (0.05, 0.7), (2.0, 0.5), (7.0, 0.5)])
def test_steps_follow_from_the_errors_of_this_step_and_the_last(ratio, before, dtype):
    """The ratio e is error over tolerance: accepted up to 1, the next step longer by 0.88 e^(-3/32) e_before^(2/32); else
    shorter by 0.88 e^(-4/32), and what was before stays. In single precision 0.97 in place of 0.88."""
    allowed = 1e-3 * (1.0 + 2.0)  # in units of 1 and of the larger of the two states
    accept, start, step, kept, fine = decided(-ratio * allowed, before, dtype=dtype)
    safety, close = (0.88, 1e-12) if dtype == jnp.float64 else (0.97, 1e-4)
    assert accept == (ratio <= 1.0) and fine and start == (3.0 if accept else 2.0)
    awaited = safety * (ratio ** (-3 / 32) * before ** (2 / 32) if accept else ratio ** (-4 / 32))
    np.testing.assert_allclose(step, awaited, rtol=close)
    np.testing.assert_allclose(kept, ratio if accept else before, rtol=100.0 * close)


def test_steps_change_by_no_more_than_five_times_and_a_fifth():
    assert decided(0.0, dtype=jnp.float32)[:4:2] == (True, 5.0)
    for error in (np.nan, np.inf, 1e9):
        assert decided(error)[:4:2] == (False, pytest.approx(0.2, rel=1e-12))
    assert decided(1.0001 * 3e-3)[2] < 0.9


def test_the_largest_error_of_all_parts_decides():
    """Errors are relative to the unit and the size of each entry."""
    entries = decided([1e-3, 5e-3], y0=[0.0, 1.0], y1=[0.0, 0.0], unit=[1.0, 3.0], relative=[7.0, 2.0])
    np.testing.assert_allclose(entries[3], 1.0, rtol=1e-12)  # 1e-3/1e-3, and 5e-3/(3e-3 + 2e-3)
    control = PIController(jnp.asarray(1e-3), (jnp.asarray(1.0),) * 3, (jnp.asarray(0.0),) * 3)
    for k in range(3):
        error = tuple(jnp.asarray(0.7e-3 if j == k else 0.1e-3) for j in range(3))
        zero = (jnp.asarray(0.0),) * 3
        state = control.adapt_step_size(0.0, 1.0, zero, zero, None, error, 8, (jnp.asarray(1.0), None))[4]
        np.testing.assert_allclose(state[0] ** 32, 0.7, rtol=1e-12)


def test_a_step_that_cannot_be_shorter_ends_the_run():
    for accept, end, fine in ((True, 1.0, True), (False, 1.5, True), (False, 2.0, False), (False, 1.0, False)):
        found = step_success(jnp.asarray(accept), jnp.asarray(1.0), jnp.asarray(2.0), jnp.asarray(end))
        assert found == (diffrax.RESULTS.successful if fine else diffrax.RESULTS.dt_min_reached)
