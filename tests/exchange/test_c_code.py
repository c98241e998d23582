"""C texts of operations."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.exchange.c_code import _power, _select, number_text, write_program
from jaxvib.ode.scalarize import scalar_program


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "1"), (np.bool_(False), "0"), (np.int32(-7), "-7"), (0.1, "0.1"), (np.float32(0.5), "0.5"), (-3.0, "-3.0"),
        (float("nan"), "NAN"), (float("inf"), "INFINITY"), (-float("inf"), "-INFINITY"),
    ],
)  # fmt: skip
def test_numbers_keep_their_bits(value, text):
    assert number_text(value) == text


@pytest.mark.parametrize(
    ("n", "text"),
    [(1, "x"), (2, "x * x"), (4, "x * x * x * x"), (5, "pow(x, 5)"), (-1, "1.0 / (x)"), (-3, "1.0 / (x * x * x)"),
     (-6, "1.0 / (pow(x, 6))"), (0, "1.0 / (pow(x, 0))")],
)  # fmt: skip
def test_whole_powers(n, text):
    assert _power(["x"], {"y": n}, SimpleNamespace()) == text


def test_selection_among_cases():
    assert _select(["c", "a", "b"], {}, SimpleNamespace()) == "c ? b : a"
    assert _select(["c", "x", "y", "z"], {}, SimpleNamespace()) == "c == 0 ? x : c == 1 ? y : z"


def written(operations, parameters, *values, **options):
    names = [f"in[{k}]" for k in range(len(values))]
    program = scalar_program(operations, *map(jnp.asarray, values))
    return write_program(program, names, parameters, ["out[0]", "out[1]"], **options)


def test_statements_of_parameters_are_prepared():
    """The square of a parameter is a constant of the body; a parameter itself is read by both."""
    found = written(lambda p, x: (p * p * x - 2.0, p * p + p), 1, 3.0, 0.5)
    assert found.constants == 2 and found.branches == 0
    assert found.prepare[0] == "const double x2 = in[0] * in[0];"
    assert [line.split(" = ")[0] for line in found.prepare[-2:]] == ["constants[0]", "constants[1]"]
    assert found.body[0].endswith("= constants[0] * in[1];") and found.body[-1] == "out[1] = constants[1];"
    assert "- 2.0;" in found.body[1]


def test_negative_numbers_are_in_brackets():
    found = written(lambda x, y: (x - (-2.0) * y, x), 0, 3.0, 0.5)
    assert any("(-2.0)" in line for line in found.body)


@pytest.mark.parametrize(
    ("operation", "test", "indicator"),
    [
        (lambda x, y: jnp.where(x < y, x, y), "(in[0] < in[1])", "in[0] - in[1]"),
        (lambda x, y: jnp.where(x >= y, x, y), "(in[0] >= in[1])", "in[0] - in[1]"),
        (jnp.maximum, "(in[0] > in[1] || in[0] != in[0]) ? in[0] : in[1]", "in[0] - in[1]"),
        (jnp.minimum, "(in[0] < in[1] || in[0] != in[0]) ? in[0] : in[1]", "in[0] - in[1]"),
    ],
)
def test_branches_have_an_indicator(operation, test, indicator):
    found = written(lambda x, y: (operation(x, y), x), 0, 3.0, 0.5, has_events=True)
    assert found.branches == 1 and f"indicators[0] = {indicator};" in found.body
    assert any(test in line for line in found.body)
    without = written(lambda x, y: (operation(x, y), x), 0, 3.0, 0.5)
    assert without.branches == 0 and any(test in line for line in without.body)
    assert not any("indicators" in line for line in without.body)


def test_bounds_on_both_sides_are_two_branches():
    found = written(lambda x, y: (jax.lax.clamp(y, x, 7.0), x), 0, 3.0, 0.5, has_events=True)
    assert found.branches == 2
    assert [line for line in found.body if line.startswith("indicators")] == [
        "indicators[0] = in[0] - in[1];", "indicators[1] = x2a - 7.0;"
    ]  # fmt: skip
    assert "const double x2a = (in[0] > in[1] || in[0] != in[0]) ? in[0] : in[1];" in found.body
    assert "const double x2 = (x2a < 7.0 || x2a != x2a) ? x2a : 7.0;" in found.body
