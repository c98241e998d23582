"""Functions of arrays written out on single numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.ode.scalar_rules import NotScalarizable, primitive_of, to_scalars
from jaxvib.ode.scalarize import scalarize, scalarized_program


def test_complex_numbers_are_written_in_their_parts():
    """Every operation on complex numbers that has a rule, with real ones among them; a factor i costs no multiplication."""

    def linear_combination(x, w):
        real, imag = x
        z = real + 1j * imag
        chosen = jnp.where(x[0] > 0.0, z * w, jnp.conj(z))
        return jnp.stack([z * jnp.conj(w) / x[1] - x[0], w / z + 2.0, -(z**2) + z**3, jnp.square(w) * chosen, 1j - jnp.exp(z)])

    x, w = jnp.asarray([0.7, -1.3]), jnp.asarray(0.4 - 0.9j)
    cells = [np.array([*x], dtype=object), np.full((), w, dtype=object)]
    np.testing.assert_allclose(
        [complex(v) for v in scalarize(linear_combination, x, w)(*cells)], linear_combination(x, w), rtol=1e-14
    )

    turned = scalarized_program(lambda a, b: (1j * (a + 1j * b)).real, x[0], x[1])
    assert turned is not None and [e.primitive.name for e in turned.jaxpr.eqns] == ["neg"]


def test_an_operation_without_a_rule_is_named():
    with pytest.raises(NotScalarizable, match="cumsum"):
        scalarize(jnp.cumsum, jnp.zeros(3))


@pytest.mark.parametrize(("function", "count"), [(lambda x: x, 0), (lambda x: 2.0 * x + 1.0, 2)])
def test_a_primitive_is_that_of_a_single_operation(function, count):
    assert primitive_of(jax.lax.neg, 1.0).name == "neg"
    with pytest.raises(NotScalarizable, match=f"is made of {count} operations"):
        primitive_of(function, 1.0)


def test_a_term_that_is_not_there_is_not_computed():
    """A product with a known 0 leaves no operation; a sine asked for twice is computed once."""

    def with_zero(x):
        return jnp.zeros(2) * jnp.sin(x) + jnp.ones(2) * x

    written = scalarize(with_zero, jnp.zeros(2))
    cells = np.empty(2, dtype=object)

    def run(a, b):
        cells[0], cells[1] = a, b
        return tuple(written(cells))

    operations = [e.primitive.name for e in jax.make_jaxpr(run)(1.0, 2.0).eqns]
    assert operations.count("mul") == 0 and operations.count("add") == 0


@pytest.mark.parametrize("value", [2.0, np.eye(2), jnp.eye(2)], ids=["a number", "NumPy's", "JAX's"])
def test_scalars_of_a_value_are_its_entries(value):
    found = to_scalars(value)
    assert found.dtype == object and found.shape == np.shape(value) and np.array_equal(found.astype(float), value)
