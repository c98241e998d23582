"""Primitives with rules of their own."""

import jax
import jax.numpy as jnp
import pytest

from jaxvib.runtime import primitive


def test_primitives_take_rules(monkeypatch):
    """`jax.interpreters`: batches, derivatives, transposes, lowering."""
    assert primitive.CAN_DEFINE_PRIMITIVES
    rules = {"impl": lambda x: [2.0 * x], "batching_rule": lambda x, axes: ([2.0 * x[0]], axes)}
    doubled = primitive.primitive("doubled", **rules)
    assert doubled(jnp.asarray(2.0)) == [4.0]
    assert jax.vmap(lambda x: doubled(x)[0])(jnp.arange(3.0)).tolist() == [0.0, 2.0, 4.0]
    monkeypatch.setattr(primitive, "CAN_DEFINE_PRIMITIVES", False)
    assert primitive.primitive("doubled", **rules) is rules["impl"]


@pytest.mark.parametrize("knows", [True, False])
def test_reverse_derivatives_take_no_cotangent_for_a_number(knows):
    """`jax.vjp`'s functions know zeros from 0.10.1 on."""
    values, pullback = jax.vjp(lambda x: [2.0 * x, jnp.sin(x)], jnp.asarray(0.0))

    def older(cotangents):
        if any(map(primitive.is_zero, cotangents)):
            raise ValueError("unexpected tree structure.")
        return pullback(cotangents)

    (found,) = primitive.apply_pullback(pullback if knows else older, [primitive.zero_of(values[0]), jnp.asarray(3.0)])
    assert float(found) == 3.0
