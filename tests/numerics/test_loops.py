"""Loops whose number of steps is traced: values and derivatives in closed form, steps of a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.numerics.loops import repeat


def polynomial(x, count, limit):
    """1 + 2 x + 3 x^2 + ... with `count` terms."""
    return repeat(lambda k, sums: (sums[0] + (k + 1) * x**k, sums[1] + 1), count, (0.0 * x, 0), limit)


def closed_form(x, count):
    terms = np.arange(count)
    return np.sum((terms + 1) * x**terms), np.sum((terms + 1) * terms * x ** np.maximum(terms - 1, 0))


@pytest.mark.parametrize("limit", [None, 5, 9])
@pytest.mark.parametrize("count", [0, 1, 5])
def test_steps_and_forward_derivatives(limit, count):
    (value, taken), (slope, _) = jax.jvp(lambda x: polynomial(x, jnp.asarray(count), limit), (1.3,), (1.0,))
    np.testing.assert_allclose([value, slope], closed_form(1.3, count), rtol=1e-14)
    assert int(taken) == count


def test_reverse_derivatives_of_a_traced_count():
    slope = jax.jit(jax.grad(lambda x, count: polynomial(x, count, 9)[0]))
    np.testing.assert_allclose([slope(0.7, n) for n in (2, 6)], [closed_form(0.7, n)[1] for n in (2, 6)], rtol=1e-14)


def test_entries_of_a_batch_have_their_own_counts():
    counts, xs = np.array([3, 0, 7]), np.array([0.5, 0.6, -0.7])
    values, taken = jax.vmap(lambda x, n: polynomial(x, n, 9))(xs, counts)
    slopes = jax.grad(lambda xs: jnp.sum(jax.vmap(lambda x, n: polynomial(x, n, 9)[0])(xs, counts)))(xs)
    np.testing.assert_allclose(
        [values, slopes], np.transpose([closed_form(*each) for each in zip(xs, counts, strict=True)]), rtol=1e-14
    )
    np.testing.assert_array_equal(taken, counts)


def test_a_batch_takes_no_more_steps_than_its_largest_count():
    seen = []

    def step(k, x):
        jax.debug.callback(lambda k: seen.append(int(k)), k)
        return x + 1.0

    jax.block_until_ready(jax.vmap(lambda n: repeat(step, n, 0.0, 50))(jnp.array([2, 4])))
    jax.effects_barrier()
    assert sorted(set(seen)) == [0, 1, 2, 3]
