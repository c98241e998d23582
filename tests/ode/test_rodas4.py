"""A stiff method of order 4."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxvib.ode.rodas4 import Rodas4, _Interpolation


def stiff(t, y, args):
    """Prothero and Robinson's problem with a nonlinear neighbour: the fast part follows cos t whatever its rate."""
    return jnp.stack([-args * (y[0] - jnp.cos(t)) - jnp.sin(t), y[0] * y[1] * (1.0 - y[1]) + 0.1 * jnp.sin(2.0 * t)])


@eqx.filter_jit
def rodas(rate, step, times):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(stiff),
        Rodas4(),
        0.0,
        2.0,
        step,
        jnp.asarray([1.0, 0.3]),
        args=rate,
        saveat=diffrax.SaveAt(ts=times),
    ).ys


@pytest.mark.parametrize(("rate", "order"), [(1.0, 4.0), (1e7, 3.0)])
def test_rodas_has_its_order_and_does_not_mind_stiffness(rate, order):
    times = jnp.linspace(0.0, 2.0, 38)
    exact = solve_ivp(
        lambda t, y: np.asarray([-np.sin(t), np.cos(t) * y[1] * (1.0 - y[1]) + 0.1 * np.sin(2.0 * t)]),
        (0.0, 2.0),
        [1.0, 0.3],
        t_eval=np.asarray(times),
        rtol=1e-12,
        atol=1e-13,
    ).y.T
    coarse, fine = (np.abs(rodas(rate, 2.0 / steps, times) - exact) for steps in (16, 32))
    assert np.max(coarse[-1]) / np.max(fine[-1]) > 2.0 ** (order - 0.5)
    assert np.max(coarse) / np.max(fine) > 2.0**2.5  # between the steps: the interpolant's order 3
    assert np.max(fine) < 1e-5


def test_between_its_ends_a_step_is_a_cubic():
    """y = (1 - s) y0 + s (y1 + (1 - s) (c0 + s c1)), multiplied out."""
    step = _Interpolation(2.0, 4.0, jnp.asarray([3.0]), jnp.asarray([5.0]), jnp.asarray([[7.0], [-2.0]]))
    cubic = np.polynomial.Polynomial([3.0, 9.0, -9.0, 2.0])
    for share in (0.0, 0.25, 0.8, 1.0):
        np.testing.assert_allclose(step.evaluate(2.0 + 2.0 * share), [cubic(share)], rtol=1e-14)
