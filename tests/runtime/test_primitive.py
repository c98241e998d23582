"""Primitives with rules of their own."""

import jax
import jax.numpy as jnp

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
