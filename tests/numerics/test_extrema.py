"""Extrema of samples, against those of the motion that they were taken from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.numerics.extrema import between, extremum_value, locate_extrema, sampled_maximum, step_extrema


def samples(per_turn, count, first=0.37):
    s = first + 2.0 * np.pi / per_turn * np.arange(count)
    return jnp.cos(s), -jnp.sin(s) * 2.0 * np.pi / per_turn


@pytest.mark.parametrize(("per_turn", "error"), [(16, 4e-9), (32, 4e-9 / 256), (64, 4e-9 / 256**2)])
def test_extrema_of_a_cosine_have_the_stated_error(per_turn, error):
    x, v = samples(per_turn, 4 * per_turn)
    (low, high), _, _ = locate_extrema(x, v)
    np.testing.assert_allclose(np.abs([low, high]), 1.0, rtol=0.0, atol=error + 1e-15)
    if per_turn == 16:
        assert np.max(np.abs(np.abs([low, high]) - 1.0)) > error / 100.0  # no better than it can be: the bound says something


@pytest.mark.parametrize(("per_turn", "error"), [(8, 9e-3), (16, 6e-4), (32, 4e-5)])
def test_maximum_between_samples_has_the_stated_error(per_turn, error):
    phases = 2.0 * np.pi / per_turn * np.linspace(0.0, 1.0, 51)
    x = jnp.asarray(np.abs(np.cos(phases + 2.0 * np.pi / per_turn * np.arange(4 * per_turn)[:, None])))
    found = sampled_maximum(x, axis=0)
    assert np.all(found <= 1.0 + 1e-15)
    assert error / 2.0 < np.max(1.0 - found) < error < np.max(1.0 - jnp.max(x, axis=0)) / 5.0


def test_unresolved_maximum_is_the_largest_sample():
    for values in ([0.0, 1.0, 0.99, 0.0], [0.3, 0.2, 0.1], [0.1, 0.2, 0.3], [0.0, 0.0, 1.0, 1.0], [0.7], [0.0] * 5):
        assert sampled_maximum(jnp.asarray(values), axis=0) == max(values)
    assert np.isnan(sampled_maximum(jnp.asarray([0.1, jnp.nan, 0.2]), axis=0))
    slope = jax.grad(lambda x: sampled_maximum(x, axis=0))(jnp.asarray([0.0, 0.0, 0.9, 1.0, 0.8]))
    np.testing.assert_allclose(jnp.sum(slope), 1.0, rtol=1e-12)  # a constant that is added to all samples moves the maximum


def test_extrema_of_steps_have_the_stated_error_and_no_overshoot():
    h = 0.25
    x, v = samples(2.0 * np.pi / h, 40)
    low, high = step_extrema(jnp.stack([x, 3.0 * x], axis=1), jnp.stack([v, 3.0 * v], axis=1))
    for sign, found in ((-1.0, low), (1.0, high)):
        np.testing.assert_allclose(found, sign * np.asarray([1.0, 3.0]), rtol=h**4 / 384.0)
    s = jnp.arange(8.0)
    jump = jnp.where(s < 4.0, 0.01 * (s - 4.0), jnp.exp(-h * (s - 4.0)))  # force of a damper that begins at the fifth sample
    slope = jnp.where(s < 4.0, 0.01, -h * jump)
    assert 1.0 <= step_extrema(jump, slope)[1] < 1.01


def test_each_half_has_its_own_and_the_whole_the_better_of_both():
    s = 0.1 * np.arange(200)
    growing, slope = (1.0 + s) * np.sin(s), (np.sin(s) + (1.0 + s) * np.cos(s)) * 0.1
    (low, high), first, place = locate_extrema(jnp.asarray(growing), jnp.asarray(slope))
    fine = np.linspace(0.0, s[-1], 2_000_001)
    exact = (1.0 + fine) * np.sin(fine)
    half = fine <= s[99]
    for k, segment in enumerate((half, ~half, slice(None))):
        np.testing.assert_allclose([low[k], high[k]], [exact[segment].min(), exact[segment].max()], rtol=1e-9)
    np.testing.assert_array_equal(high[2], jnp.max(high[:2]))
    assert np.all((place >= 0.0) & (place <= 3.0)) and np.all((first >= 0) & (first <= 196))
    x, v = (jnp.asarray(y[np.asarray(first)[..., None] + np.arange(4)]) for y in (growing, slope))
    np.testing.assert_allclose(jax.vmap(jax.vmap(extremum_value))(x, v, place), [low, high], rtol=1e-13)


@pytest.mark.parametrize("a", [0.0, 0.3])
def test_second_derivatives_follow_the_place_of_an_extremum(a):
    """Closed form: cos(s) + a sin(s) is at most sqrt(1 + a^2), at s = atan(a)."""
    step, first = 2.0 * np.pi / 64.0, np.arctan(a) - 0.13
    s = first + step * np.arange(4.0)

    def height(a):
        x, v = jnp.cos(s) + a * jnp.sin(s), step * (a * jnp.cos(s) - jnp.sin(s))
        return extremum_value(x, v, jnp.asarray(0.13 / step))

    found = [height(a), jax.grad(height)(a), jax.grad(jax.grad(height))(a)]
    np.testing.assert_allclose(found, [(1.0 + a**2) ** 0.5, a * (1.0 + a**2) ** -0.5, (1.0 + a**2) ** -1.5], atol=1e-9)


def test_at_the_ends_the_outermost_samples_count():
    x = jnp.asarray([0.0, 1.0, 2.0, 3.0])
    (low, high), first, place = locate_extrema(x, jnp.ones(4))
    np.testing.assert_array_equal([low[2], high[2]], [0.0, 3.0])
    np.testing.assert_array_equal(np.asarray(first[:, 2] + place[:, 2]), [0.0, 3.0])


def test_samples_that_are_no_numbers_have_no_place():
    x, v = samples(16, 64)
    values, _, places = locate_extrema(x.at[40].set(jnp.nan), v)
    assert np.all(np.isfinite(values[:, 0])) and np.all(np.isnan(values[:, 1:])) and np.all(np.isnan(places[:, 1:]))


def test_motion_between_two_samples_is_of_degree_five():
    polynomial = np.polynomial.Polynomial([1.0, -2.0, 0.5, 3.0, -1.0, 0.7])
    ends = [[jnp.asarray(polynomial.deriv(k)(s)) if k else jnp.asarray(polynomial(s)) for k in range(3)] for s in (0.0, 1.0)]
    for s in (0.0, 0.3, 1.0):
        np.testing.assert_allclose(between(*ends, jnp.asarray(s)), [polynomial(s), polynomial.deriv()(s)], rtol=1e-13)
