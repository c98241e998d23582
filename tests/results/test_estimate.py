"""Shares of runs with Wilson's confidence interval."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.results.estimate import wilson


@pytest.mark.parametrize(("hits", "cases"), [(0, 7), (3, 10), (10, 10), (250, 1000)])
def test_the_ends_of_an_interval_are_shares_just_not_excluded(hits, cases):
    for end in wilson(np.asarray(hits), np.asarray(cases)):
        np.testing.assert_allclose((hits / cases - end) ** 2, 1.959964**2 * end * (1.0 - end) / cases, atol=1e-15)


def test_intervals_hold_the_share_as_often_as_they_say():
    hits = np.random.default_rng(0).binomial(40, 0.1, 20000)
    low, high = wilson(hits, np.full(hits.shape, 40))
    assert 0.93 < np.mean((low <= 0.1) & (high >= 0.1)) < 0.98
    assert wilson(np.asarray(0), np.asarray(0)) == (0.0, 1.0)


MASKED = np.ma.array([True, False], mask=[False, True])


@pytest.mark.parametrize("flags", [np.zeros(0, bool), np.ones(3), [True, False], None, MASKED])
def test_share_of_other_than_booleans_is_refused(flags):
    with pytest.raises(jv.InputError, match=r"^flags is .*; it must be an array of at least one Boolean value"):
        jv.estimate_share(flags)


def test_share_of_traced_flags_is_refused_in_a_sentence():
    with pytest.raises(jv.InputError, match="value is needed here"):
        jax.jit(lambda x: jv.estimate_share(x > 0.0).value)(jnp.ones(3))
