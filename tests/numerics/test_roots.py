"""Roots in a bracket: their digits, the number of evaluations, their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.numerics.roots import bracketed_root, known_root

CASES = {
    "cubic": (lambda x: x**3 - 2.0 * x - 5.0, 2.0, 3.0, 2.0945514815423265),
    "downwards": (lambda x: 2.0 - x**2, 0.0, 3.0, np.sqrt(2.0)),
    "steep": (lambda x: jnp.expm1(20.0 * x) - 1.0, -1.0, 1.0, np.log(2.0) / 20.0),
    "far": (lambda x: 1.0 - 1e6 / x, 1.0, 1e9, 1e6),
    "at an end": (lambda x: x - 1.0, 1.0, 2.0, 1.0),
}


@pytest.mark.parametrize("name", CASES)
def test_a_root_has_all_its_digits(name):
    f, low, high, root = CASES[name]
    np.testing.assert_allclose(bracketed_root(f, jnp.asarray(low), jnp.asarray(high)), root, rtol=4e-16)


@pytest.mark.parametrize(("name", "most"), [("cubic", 8), ("downwards", 10), ("steep", 12)])
def test_a_smooth_root_takes_few_evaluations(name, most):
    """Halving would take 53."""
    calls = []
    f, low, high, _ = CASES[name]

    def counted(x):
        jax.debug.callback(lambda _: calls.append(1), x)
        return f(x)

    ends = f(jnp.asarray(low)), f(jnp.asarray(high))
    bracketed_root(counted, jnp.asarray(low), jnp.asarray(high), ends).block_until_ready()
    jax.effects_barrier()
    assert 1 < len(calls) <= most


def test_derivatives_are_those_of_the_implicit_function():
    """x^3 = a: x' = 1 / (3 x^2), x'' = -2 / (9 x^5)."""

    def cube_root(a):
        return bracketed_root(lambda x: x**3 - a, jnp.asarray(0.0), jnp.asarray(9.0))

    def again(a):
        return known_root(lambda x: x**3 - a, jnp.asarray(2.0))

    for root in (cube_root, again):
        np.testing.assert_allclose(root(8.0), 2.0, rtol=4e-16)
        np.testing.assert_allclose(jax.grad(root)(8.0), 1.0 / 12.0, rtol=1e-14)
        np.testing.assert_allclose(jax.jacfwd(root)(8.0), 1.0 / 12.0, rtol=1e-14)
    np.testing.assert_allclose(jax.grad(jax.grad(cube_root))(8.0), -2.0 / (9.0 * 32.0), rtol=1e-13)


def test_roots_of_a_batch_are_independent():
    a = jnp.asarray([0.5, 8.0, 27.0, 700.0])
    roots = jax.vmap(lambda a: bracketed_root(lambda x: x**3 - a, jnp.asarray(0.0), jnp.asarray(9.0)))(a)
    np.testing.assert_allclose(roots, np.cbrt(a), rtol=1e-15)


def test_a_jump_at_zero_ends_the_search():
    """No interval around 0 is narrow relative to its ends."""
    calls = []

    def sign(x):
        calls.append(1)
        assert len(calls) <= 200
        return np.where(x < 0.0, -1.0, 1.0)

    @jax.custom_jvp
    def jump(x):
        return jax.pure_callback(sign, x, x)

    jump.defjvp(lambda at, move: (jump(*at), 0.0 * move[0]))

    ends = jnp.asarray(-1.0), jnp.asarray(1.0)
    bracketed_root(jump, jnp.asarray(-1.0), jnp.asarray(2.0), ends).block_until_ready()
    assert len(calls) > 50
