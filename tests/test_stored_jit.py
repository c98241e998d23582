"""Compiled functions of tests: a program is found again where all that it depends on is the same, and only there."""

import functools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stored_jit as module
from stored_jit import stored_jit

from jaxvib.runtime.cache import keep_programs

TRACED = []


class Own:
    """Class of no known package."""

    factor = 3.0


@pytest.fixture(autouse=True)
def folder(tmp_path):
    keep_programs(tmp_path)
    TRACED.clear()
    return tmp_path


def scaled(factor, shift=0.0):
    def function(x):
        TRACED.append(factor)
        return factor * x + shift

    return function


def kinds(x):
    """Functions that hold on to others in every way, of which each takes x to 2 x."""
    both = [lambda y: y + x, lambda y: y * 2.0]  # two of one line
    return {
        "the first": (both[0], x),
        "the second": (both[1], x),
        "closure": (scaled(jnp.asarray(2.0)), x),
        "default": (lambda y, factor=2.0: factor * y, x),
        "partial": (functools.partial(lambda factor, y: factor * y, 2.0), x),
        "batch": (jax.vmap(scaled(2.0)), x),
        "derivative": (jax.jacfwd(lambda y: jnp.sum(y**2)), x),
        "value and gradient": (lambda y: jax.value_and_grad(lambda z: jnp.sum(z**2))(y)[1], x),
        "tree": (lambda y: {"a": y * 2.0}["a"], x),
        "one of these": (stored_jit(scaled(2.0)), x),
    }


X = jnp.asarray([1.0, -2.0])


@pytest.mark.parametrize("kind", kinds(X))
def test_programs_are_found_again(kind, folder):
    """The function is made anew, and nothing of it is held in memory."""
    for _ in range(2):
        function, x = kinds(X)[kind]
        np.testing.assert_allclose(stored_jit(function)(x), 2.0 * X, rtol=1e-15)
        assert len([*folder.glob("of_a_test-*.program")]) == 1
        del function
        once, TRACED[:] = len(TRACED), []
    assert once == 0


def test_what_a_function_holds_on_to_tells_programs_apart(folder):
    for factor in (2.0, 3.0, jnp.asarray(2.0), jnp.asarray(3.0), jnp.asarray(2.0, jnp.float32), np.asarray([2.0, 3.0])):
        np.testing.assert_allclose(stored_jit(scaled(factor))(X), factor * X)
    np.testing.assert_allclose(stored_jit(scaled(2.0, 1.0))(X), 2.0 * X + 1.0)
    np.testing.assert_allclose(stored_jit(jax.vmap(scaled(3.0)))(X), 3.0 * X)
    for factor in (3.0, 4.0):
        np.testing.assert_allclose(stored_jit(functools.partial(lambda f, y: f(y), scaled(factor)))(X), factor * X)
    assert len([*folder.glob("*.program")]) == 10


def test_a_changed_file_is_traced_anew(folder, monkeypatch):
    stored_jit(scaled(2.0))(X)
    source = module._source
    for changed in (pathlib.Path(__file__), module.HELPERS / "scenes.py"):
        monkeypatch.setattr(module, "_source", lambda file, changed=changed: source(file) + "#" * (file == changed))
        stored_jit(scaled(2.0))(X)
    assert len([*folder.glob("*.program")]) == 3


def test_what_cannot_be_told_from_others_is_compiled_alone(folder):
    own = Own()
    np.testing.assert_allclose(stored_jit(lambda y: own.factor * y)(X), 3.0 * X)
    own.factor = 4.0
    np.testing.assert_allclose(stored_jit(lambda y: own.factor * y)(X), 4.0 * X)
    assert not [*folder.glob("*.program")]


def test_numbers_are_traced_and_names_are_not():
    def function(x, power, name):
        TRACED.append(name)
        return {"square": x**2, "power": x**power}[name]

    asked = stored_jit(function)
    assert [float(asked(x, 3, "square")) for x in (2.0, 3.0, -1.0)] == [4.0, 9.0, 1.0]
    assert float(asked(2.0, 3, "power")) == 8.0 and float(asked(2.0, 4, "power")) == 16.0
    assert TRACED == ["square", "power", "power"]


def test_they_are_differentiated_and_batched():
    square = stored_jit(lambda x: x**2)
    np.testing.assert_allclose(jax.vmap(jax.grad(square))(X), 2.0 * X)
    np.testing.assert_allclose(jax.jit(jax.grad(lambda x: jnp.sum(square(x))))(X), 2.0 * X)
