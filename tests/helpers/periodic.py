"""Time integration from a periodic motion, by SciPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import jaxvib as jv


@functools.partial(jax.jit, static_argnums=0)
def _rate(structure, leaves, size, y):
    """Rate of a state given as one vector, in parts of `size`: one program for all scenes of a structure."""
    scene = jax.tree.unflatten(structure, leaves)
    nd = scene.machine.carrier().mass.shape[0]
    q, v, angle, rate = jnp.split(y * size, [nd, 2 * nd, 2 * nd + scene.loads.count])
    return ravel_pytree(jv.vector_field(scene)(0.0, jv.State(q, v, (angle,), (rate,))))[0] / size


def integrate(scene, orbit, periods):
    """SciPy's DOP853 from the orbit at theta = 0 through whole periods; rows are the changes after each, relative."""
    state, period, w = jv.State(*orbit.at(0.0)), 2.0 * np.pi / float(orbit.omega), float(orbit.omega)
    start, _ = ravel_pytree(state)
    count = orbit.offsets.size
    size = jv.State(orbit.amplitude, w * orbit.amplitude, (jnp.ones(count),), (jnp.full(count, w),))
    turns = jv.State(0.0 * orbit.amplitude, 0.0 * orbit.amplitude, (jnp.ones(count),), (jnp.zeros(count),))
    size, turns = (np.asarray(ravel_pytree(x)[0]) for x in (size, turns))
    leaves, structure = jax.tree.flatten(scene)
    times = period * np.arange(periods + 1)
    start = np.asarray(start) / size

    def field(t, y):
        return np.asarray(_rate(structure, leaves, size, y))

    run = solve_ivp(field, (0.0, times[-1]), start, "DOP853", times, rtol=1e-12, atol=1e-13)
    return run.y.T - 2.0 * np.pi * np.arange(periods + 1)[:, None] * turns - start


def monodromy(scene, orbit):
    """Multipliers by forward-mode differentiation of the full equations, every load for itself, and SciPy's DOP853."""
    start, restore = ravel_pytree(jv.State(*orbit.at(0.0)))
    n = start.size

    def both(z):
        y, columns = z[:n], z[n:].reshape(n, n)
        rate, push = jax.linearize(lambda y: ravel_pytree(jv.vector_field(scene)(0.0, restore(y)))[0], y)
        return jnp.concatenate([rate, jax.vmap(push, in_axes=1, out_axes=1)(columns).ravel()])

    field = jax.jit(both)
    begin = np.concatenate([start, np.eye(n).ravel()])
    period = 2.0 * np.pi / float(orbit.omega)
    run = solve_ivp(lambda t, z: np.asarray(field(z)), (0.0, period), begin, "DOP853", rtol=1e-11, atol=1e-11)
    return np.linalg.eigvals(run.y[n:, -1].reshape(n, n))


def ordered(values):
    """Sorted so that rounding does not part equal pairs."""
    values = np.asarray(values)
    return values[np.lexsort((values.imag.round(5), values.real.round(5)))]
