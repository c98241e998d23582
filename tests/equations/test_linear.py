"""Natural frequencies beside what rounding leaves of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.equations.linear import jammed_model, linear_model, lost_frequencies
from jaxvib.equations.modal import modal_response


def two_masses(support, link):
    """Two masses of 10.1 kg, the first on a support, joined by a link."""
    machine = jv.two_mass(
        mass=(10.1, 10.0), stiffness=(support, 0.0), damping=(1.0, 1.0), link_stiffness=link, link_damping=1.0, exciter=2
    )
    return jv.Scene(machine, jv.balls(count=1, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))


def closed(support, link):
    """m w^2 = [(k + 2 l) -+ sqrt(k^2 + 4 l^2)] / 2, the lower one from the product k l of both."""
    high = (support + 2.0 * link + np.hypot(support, 2.0 * link)) / 2.0
    return np.sqrt(np.array([support * link / high, high]) / 10.1)


@pytest.mark.parametrize(("double", "support", "link"), [(True, 1e3, 1e12), (False, 1e4, 1e6), (False, 3e3, 3e7)])
def test_natural_frequencies_are_right_or_refused(double, support, link):
    with jax.enable_x64(double):
        found = jv.natural_frequencies(two_masses(support, link))
        np.testing.assert_allclose(np.asarray(found, float), closed(support, link), rtol=0.01)


@pytest.mark.parametrize(("double", "support", "link"), [(True, 1.0, 1e15), (False, 1e3, 1e8), (False, 1.0, 1e8)])
def test_natural_frequencies_without_digits_are_refused(double, support, link):
    with jax.enable_x64(double):
        scene = two_masses(support, link)
        with pytest.raises(
            jv.ComputationError,
            match=r"lost_digits: a natural frequency is lost in rounding errors: "
            r"use double precision",
        ):
            jv.natural_frequencies(scene)
        found = jax.jit(jv.natural_frequencies)(scene)
        assert jnp.isnan(found[0]) and abs(float(found[1]) / closed(support, link)[1] - 1.0) < 1e-3


@pytest.mark.parametrize(("double", "stiff"), [(True, 1e18), (False, 1e9)])
@pytest.mark.parametrize(("support", "link"), [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
def test_soft_springs_beside_a_stiff_support_are_no_drift(double, stiff, support, link):
    machine = {"mass": (1.0, 1e3), "stiffness": (stiff, support), "link_stiffness": link, "damping": (0.0, 0.0)}
    loads = jv.balls(count=1, mass=0.1, radius=0.1, drag=1.0)
    with jax.enable_x64(double):
        scene = jv.Scene(jv.two_mass(**machine, link_damping=0.0), loads, jv.ConstantSpeed(60.0))
        with pytest.raises(jv.ComputationError, match="lost_digits"):
            jv.natural_frequencies(scene)


@pytest.mark.parametrize("double", [True, False])
def test_a_carrier_that_is_free_to_drift_has_frequency_0(double):
    with jax.enable_x64(double):
        found = jv.natural_frequencies(two_masses(0.0, 1e8))
        np.testing.assert_allclose(found, closed(0.0, 1e8), rtol=1e-3)


def test_rounding_of_a_free_motion_is_no_lost_frequency():
    """The motion of the platform without springs contains 1e-9 of that of the other one."""
    model, frequencies = linear_model(two_masses(1e4, 0.0)), jnp.asarray([0.0, np.sqrt(1e4 / 10.1)])
    shapes = jnp.asarray([[1e-9, 1.0], [1.0, 0.0]])
    assert lost_frequencies(model, frequencies, shapes).tolist() == [False, False]
    assert lost_frequencies(model, frequencies, shapes.at[0, 0].set(1e-2)).tolist() == [True, False]


def test_gradients_are_right_with_asymmetric_damping():
    """The derivative of one coordinate with respect to a spring at another, d q_0/d k = -(D^-1)_03 q_3."""
    stiffness = np.diag([4e4, 5e4, 6e4, 7e4]) - 1e4 * (np.eye(4, k=1) + np.eye(4, k=-1))
    damping = 40.0 * np.eye(4) + 300.0 * (np.eye(4, k=2) - np.eye(4, k=-2))
    omega, last = 25.0, np.eye(4)[3]

    def response(spring):
        whole = stiffness + spring * jnp.diag(last)
        machine = jv.from_matrices(50.0 * np.eye(4), damping, whole, places=[[0, 1]])
        model = jammed_model(jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0)))
        return model.decomposed().displacement(jnp.asarray(omega)).real[0]

    mass = 50.0 * np.eye(4) + 0.5 * np.diag([1.0, 1.0, 0.0, 0.0])
    dynamic = np.linalg.inv(stiffness + 1j * omega * damping - omega**2 * mass)
    expected = -(dynamic[0, 3] * dynamic[3] @ (0.05 * omega**2 * np.array([1.0, -1.0j, 0.0, 0.0]))).real
    np.testing.assert_allclose(jax.grad(response)(0.0), expected, rtol=1e-9)


def test_the_modal_form_solves_critically_damped_modes():
    """Against the dense solution; the damping of one mode is critical, so that its poles share one eigenvector."""
    w, mass = np.array([10.0, 30.0]), np.array([[2.0, 0.5], [0.5, 1.0]])
    shapes = np.linalg.inv(np.linalg.cholesky(mass).T) @ np.array([[0.6, -0.8], [0.8, 0.6]])
    inverse = np.linalg.inv(shapes)
    damping, stiffness = (inverse.T @ np.diag(own) @ inverse for own in (2.0 * w * np.array([1.0, 0.1]), w**2))
    direction, force = jnp.asarray([1.0, 0.0]), np.array([3.0, -1.0])
    modal = modal_response(*map(jnp.asarray, (w, shapes, stiffness, damping, mass)), direction)
    np.testing.assert_allclose(modal.norms, [np.linalg.norm(a, np.inf) for a in (stiffness, damping, mass)], rtol=1e-12)
    for omega in (5.0, 10.0, 25.0):
        dense = np.linalg.solve(stiffness + 1j * omega * damping - omega**2 * mass, force)
        np.testing.assert_allclose(modal.solve(jnp.asarray(omega), force), dense, rtol=1e-8)
