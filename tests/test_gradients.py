"""Gradients by independent routes: implicit, forward and reverse through time, finite differences."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, scene

import jaxvib as jv

NAMES = ("mass", "stiffness", "damping", "link_stiffness", "link_damping", "load_mass", "drag", "speed")


def numbers(s):
    m = s.machine
    return {
        **{name: getattr(m, name) for name in NAMES[:5]},
        "load_mass": s.loads.mass,
        "drag": s.loads.drag,
        "speed": s.drive.speed,
    }


def with_numbers(s, values):
    def where(x):
        return [*(getattr(x.machine, name) for name in NAMES[:5]), x.loads.mass, x.loads.drag, x.drive.speed]

    return eqx.tree_at(where, s, [values[name] for name in NAMES])


def flat(values):
    return jnp.concatenate([jnp.ravel(values[name]) for name in NAMES])


def unflat(vector, like):
    out, at = {}, 0
    for name in NAMES:
        size = like[name].size
        out[name] = vector[at : at + size].reshape(like[name].shape)
        at += size
    return out


def jam_outputs(s, mode=3):
    """(parameters as multiples of their own value) -> amplitudes and foundation force; relative parameters scale all alike."""
    base = numbers(s)
    x0 = flat(base)

    def outputs(factors):
        jam = jv.jam_modes(with_numbers(s, unflat(x0 * factors, base))).select(mode, throw=False)
        return jnp.append(jam.amplitude, jam.foundation_force)

    return outputs, jnp.ones_like(x0)


def central(f, x, h):
    """Central differences. Noise floor: eps |f| / h; truncation: h^2 f'''/6, narrow peaks making f''' large."""
    columns = []
    for i in range(x.size):
        step = jnp.zeros_like(x).at[i].set(h)
        columns.append((f(x + step) - f(x - step)) / (2.0 * h))
    return jnp.stack(columns, axis=-1)


@pytest.fixture(scope="module", params=["published", "three_mass"])
def case(request):
    s = published(natural=(0.3, 0.36)).scene() if request.param == "published" else scene("three_mass", "balls", 35.0)
    mode = 3 if request.param == "published" else jv.jam_modes(s).mode_numbers()[0]
    outputs, x = jam_outputs(s, mode)
    return outputs, x


def test_implicit_gradient_is_the_finite_difference(case):
    """Forward, reverse, jitted: all numbers of the machine, loads and drive; the step 1e-5 leaves an error of 1e-6."""
    outputs, x = case
    forward, reverse = jax.jit(jax.jacfwd(outputs))(x), jax.jit(jax.jacrev(outputs))(x)
    scale = jnp.max(jnp.abs(forward), axis=1, keepdims=True)
    np.testing.assert_allclose(forward / scale, reverse / scale, atol=1e-12)
    difference = central(jax.jit(outputs), x, 1e-5)
    np.testing.assert_allclose(forward / scale, difference / scale, atol=1e-6)
    assert np.isfinite(forward).all() and (np.abs(forward).max(axis=0) > 0.0).all()


def test_gradient_of_a_batch_is_the_batch_of_gradients():
    outputs, x = jam_outputs(published(natural=(0.3, 0.36)).scene())
    force = jax.jit(jax.grad(lambda v: outputs(v)[-1]))
    batch = x[None, :] * jnp.asarray([0.99, 1.0, 1.01])[:, None]
    np.testing.assert_allclose(jax.vmap(force)(batch), jnp.stack([force(v) for v in batch]), rtol=1e-9)


def test_hessian_is_the_finite_difference_of_the_gradient():
    s = published(natural=(0.3, 0.36)).scene()

    def force(k):
        moved = eqx.tree_at(lambda x: (x.machine.stiffness, x.machine.link_stiffness), s, (k[:2], k[2:]))
        return jv.jam_modes(moved).select(3, throw=False).foundation_force

    k = jnp.concatenate([s.machine.stiffness, s.machine.link_stiffness])
    exact = jax.jit(jax.hessian(force))(k)
    np.testing.assert_allclose(exact, exact.T, rtol=1e-9)
    difference = central(jax.jit(jax.grad(force)), k, 1e-6)
    np.testing.assert_allclose(exact, difference, rtol=1e-5, atol=1e-6 * float(jnp.max(jnp.abs(exact))))


@pytest.mark.parametrize("where", ["equal natural frequencies", "n1 = n2", "one support undamped", "no supports"])
def test_gradient_is_finite_where_machines_degenerate(where):
    s = published().scene()
    mode = 5 if where == "equal natural frequencies" else 3
    if where == "equal natural frequencies":
        s = eqx.tree_at(lambda x: (x.machine.link_stiffness, x.machine.link_damping), s, (jnp.zeros(1), jnp.zeros(1)))
    elif where == "one support undamped":
        s = eqx.tree_at(lambda x: x.machine.damping, s, jnp.asarray([0.0, 0.02]))
    elif where == "no supports":
        s = eqx.tree_at(lambda x: x.machine.stiffness, s, jnp.zeros(2))

    def everything(values):
        moved = with_numbers(s, values)
        jam = jv.jam_modes(moved).select(mode, throw=False)
        return jnp.sum(jam.amplitude) + jam.foundation_force + jnp.sum(jv.natural_frequencies(moved))

    base = numbers(s)
    gradient = jax.jit(jax.grad(everything))(base)
    assert all(np.isfinite(g).all() for g in gradient.values())
    # The stiffness of the first support: a sum over equal frequencies is smooth, and so is everything else here.
    if where != "no supports":
        value = jax.jit(everything)
        h = 1e-6
        up, down = ({**base, "stiffness": base["stiffness"].at[0].add(d)} for d in (h, -h))
        np.testing.assert_allclose(gradient["stiffness"][0], (value(up) - value(down)) / (2 * h), rtol=1e-5)


# Through the time integration: light loads (eps = 1e-4) that are in the jam

EPS = 1e-4


def run_outputs(adjoint):
    """(6 stiffnesses and dampings as multiples) -> amplitudes, foundation force and speed, measured on the run."""
    s = published(speed=3.0, eps=EPS, damping=0.05).scene()
    m = s.machine

    def moved(x):
        return eqx.tree_at(
            lambda y: (y.machine.stiffness, y.machine.damping, y.machine.link_stiffness, y.machine.link_damping),
            s,
            (m.stiffness * x[:2], m.damping * x[2:4], m.link_stiffness * x[4:5], m.link_damping * x[5:]),
        )

    def from_run(x):
        run = jv.simulate(
            moved(x),
            UNTIL,
            start="jam",
            mode=5,
            save="window",
            turns=2,
            tolerance=1e-9,
            adjoint=adjoint,
            max_steps=8192,
            throw=False,
        )
        return jnp.concatenate([run.amplitude, run.foundation_force[None]])

    def from_algebra(x):
        jam = jv.jam_modes(moved(x)).select(5, throw=False)
        return jnp.append(jam.amplitude, jam.foundation_force)

    return from_run, from_algebra


UNTIL = 250.0
