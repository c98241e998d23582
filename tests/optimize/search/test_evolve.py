"""CMA-ES in place of the descent: the same answers where there is one valley, the deepest where there are many."""

import jax.numpy as jnp
import numpy as np
import pytest
from two_springs import FIRST, FREE, NEAREST, SCENE, SUM

import jaxvib as jv
from optimize import DesignSpace, Quantity, hold, synthesize


def found(space, objective, **more):
    options = {"searcher": "cma", "starts": 10, "iterations": 40, "polishing": 12, "verify": False}
    return synthesize(space, objective, **{**options, **more})


@pytest.fixture
def valleys():
    """A bowl with a dozen valleys in each of two numbers; the deepest is at k = (6e4, 5e4)."""

    def rugged(s):
        x = (s.machine.stiffness - jnp.array([6e4, 5e4])) / 1e4
        return jnp.sum(x**2 + 4.0 * jnp.sin(5.0 * x) ** 2)

    return Quantity("rugged", "", rugged)


def test_cma_finds_the_deepest_of_many_valleys(valleys):
    space = DesignSpace(SCENE, FREE)
    best = found(space, valleys, starts=20)
    np.testing.assert_allclose(best.after.parameters["machine.stiffness"], [6e4, 5e4], rtol=1e-6)
    assert best.status_name == "done" and 800 <= best.drawn < 1000 and 1 <= best.starts <= 8
    same = found(space, valleys, starts=20)
    np.testing.assert_array_equal(best.designs, same.designs)
    assert best.history.shape[1] == best.starts and best.plot().axes


def test_cma_keeps_demands_and_what_is_held():
    best = found(DesignSpace(SCENE, FREE), NEAREST, subject_to=[SUM < "90 N/mm", FIRST < 4.5e4])
    np.testing.assert_allclose(best.after.parameters["machine.stiffness"], [4.5e4, 4.5e4], rtol=1e-6)
    held = DesignSpace(SCENE, FREE, [hold(SUM, 9e4)])
    np.testing.assert_allclose(found(held, NEAREST).after.parameters["machine.stiffness"], [5e4, 4e4], rtol=1e-6)


def test_an_interrupt_of_cma_keeps_what_it_has():
    def stop(what, share):
        if what.startswith("evolving") and share > 0.2:
            raise KeyboardInterrupt

    best = found(DesignSpace(SCENE, FREE), NEAREST, progress=stop)
    assert best.status_name == "interrupted" and np.isfinite(best.values.min())


def test_a_searcher_that_is_none_is_refused(monkeypatch):
    with pytest.raises(jv.InputError, match=r"searcher is 'anneal'; it must be one of: 'gradients', 'cma'"):
        found(DesignSpace(SCENE, FREE), NEAREST, searcher="anneal")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(jv.InputError, match=r"needs the package cma; install it with: pip install 'jaxvib\[cma\]'"):
        found(DesignSpace(SCENE, FREE), NEAREST)
