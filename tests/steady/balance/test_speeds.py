"""Parts of the characteristic speeds, by linear algebra of SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxvib as jv
from jaxvib.steady.balance.criterion import _join_intervals
from jaxvib.steady.balance.speeds import _free_and_fixed_modes, _inverse_root, characteristic_speeds


@pytest.mark.parametrize(
    "port", [[3.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, -5.0], [0.3 - 2.0j, 1.0j, 4.0, -0.5], [1e-9, 7.0, 1.0, 0.0]]
)
def test_modes_are_those_of_the_full_and_the_pinned_matrix(port):
    random = np.random.default_rng(0)
    a = random.normal(size=(4, 4)) + (1j * random.normal(size=(4, 4)) if np.iscomplexobj(np.asarray(port)) else 0.0)
    square, c = a @ a.conj().T, np.asarray(port)
    values, vectors, fixed = _free_and_fixed_modes(jnp.asarray(square), jnp.asarray(c))
    np.testing.assert_allclose(values, np.linalg.eigvalsh(square), rtol=1e-10)
    np.testing.assert_allclose(square @ np.asarray(vectors), np.asarray(vectors) * np.asarray(values), atol=1e-9)
    basis = scipy.linalg.null_space(c.conj()[None])
    np.testing.assert_allclose(fixed, np.linalg.eigvalsh(basis.conj().T @ square @ basis), rtol=1e-9)


def test_roots_of_nothing_are_nan():
    np.testing.assert_allclose(_inverse_root(jnp.array([4.0, 0.0, -1.0])), [0.5, np.nan, np.nan])


def test_intervals_that_touch_are_one_and_empty_ones_none():
    rows = np.array(
        [[0.0, 2.0], [2.0, 3.0], [5.0, 5.0], [100.0, 100.0 + 1e-7], [200.0, 300.0], [np.nan, np.nan], [400.0, np.inf]]
    )
    assert _join_intervals(rows) == [[0.0, 3.0], [200.0, 300.0], [400.0, None]]
    assert _join_intervals(np.array([[100.0, 200.0], [200.0 + 1e-7, 300.0]])) == [[100.0, 300.0]]
    assert _join_intervals(np.array([[100.0, 200.0], [200.01, 300.0]])) == [[100.0, 200.0], [200.01, 300.0]]
    assert _join_intervals(np.array([[0.01, 0.02], [0.0200001, 0.03]])) == [[0.01, 0.02], [0.0200001, 0.03]]


@pytest.mark.parametrize(
    ("stiffness", "says"),
    [
        ((1e4, 1e30), "machine.exciter is attached to y2, where the stiffness is too high for"),
        ((1e30, 1e4), "machine.stiffness is too high for this precision at y1"),
        ((1e12, 1e4), None),
        ((1e4, 0.0), None),
    ],
)
def test_what_rounding_holds_fast_is_named(stiffness, says):
    machine = jv.two_mass(mass=(3.0, 2.0), stiffness=stiffness, damping=(1.0, 1.0), link_stiffness=1e3, link_damping=1.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(50.0))
    if says is None:
        assert np.all(np.isfinite(characteristic_speeds(scene).resonances))
    else:
        with pytest.raises(jv.InputError, match=says):
            characteristic_speeds(scene)


def test_stiffnesses_whose_sum_overflows_have_a_status():
    shaft = dict(mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, stiffness=(1e308, 1e308), damping=400.0)
    scene = jv.Scene(
        jv.rotor(**shaft, position=(0.165, -0.155)), jv.balls(count=2, mass=0.05, radius=0.1, drag=0.5), jv.ConstantSpeed(300.0)
    )
    with pytest.raises(jv.ComputationError, match=r"^overflow: stiffnesses and masses of the machine are not finite"):
        characteristic_speeds(scene)
