"""The programs of one question are compiled at the same time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.runtime import cache, programs, rehearsal, structure

traces = []


@pytest.fixture
def folder(tmp_path, monkeypatch, unwatched):
    traces.clear()
    monkeypatch.setattr(structure, "KNOWN_PACKAGES", structure.KNOWN_PACKAGES | {__name__})
    cache.keep_programs(tmp_path)
    yield tmp_path
    cache.keep_programs(None)


@programs.cached
def squared(x):
    traces.append(("squared", rehearsal.is_rehearsing()))
    return x**2


@programs.cached
def tripled(x):
    traces.append(("tripled", rehearsal.is_rehearsing()))
    return 3.0 * x


def together(between=lambda y: None):
    """3 x^2 by two programs, and what is done with the result of the first one."""

    @rehearsal.compiled_together
    def question(x):
        y = squared(x)
        between(y)
        return tripled(y)

    return question


def test_programs_of_a_question_are_compiled_together(folder):
    seen = []
    question = together(lambda y: seen.append((y.tolist(), rehearsal.is_rehearsing())))
    x = jnp.asarray([1.0, 2.0])
    np.testing.assert_array_equal(question(x), [3.0, 12.0])
    assert seen == [([0.0, 0.0], True), ([1.0, 4.0], False)]
    assert traces == [("squared", False), ("tripled", True)]
    np.testing.assert_array_equal(question(2.0 * x), [12.0, 48.0])
    assert len(seen) == 3 and len(traces) == 2


def test_question_that_depends_on_numbers_is_answered(folder):
    def refused(y):
        if not y.any():
            raise jv.InputError("y", "is zero")

    np.testing.assert_array_equal(together(refused)(jnp.asarray([1.0, 2.0])), [3.0, 12.0])
    assert traces == [("squared", False), ("tripled", False)] and not rehearsal.is_rehearsing()


@pytest.mark.parametrize("way", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
def test_derivatives_of_a_question_are_compiled_together(folder, way):
    jacobian = way(together())(jnp.asarray([1.0, 2.0]))
    np.testing.assert_array_equal(jacobian, [[6.0, 0.0], [0.0, 12.0]])
    assert ("tripled", True) in traces and ("tripled", False) not in traces
