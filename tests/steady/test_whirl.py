"""Whirl and critical speeds against closed forms, published numbers and the equations of motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene as platforms
from stored_jit import stored_jit

import jaxvib as jv
from jaxvib.steady.whirl import _held
from jaxvib.study.maps.published_rotor import published_rotor


@pytest.mark.parametrize(
    "variant, loads, forward",
    [("printed", "none", (176.19, 278.26)), ("printed", "fixed", (175.70, 273.34)), ("uncoupled", "fixed", (176.51, 272.81))],
)
def test_critical_speeds_of_the_published_rotor(variant, loads, forward):
    """The paper prints 176.69 and 274.76, which no convention gives; these are what its data give."""
    found = jv.critical_speeds(published_rotor(variant=variant), loads=loads)
    np.testing.assert_allclose(found.speed[found.forward], forward, atol=0.0051)


def test_second_forward_whirl_at_working_speed():
    """A* w^2 - C n w - c3 = 0 for the tilt, without damping."""
    closed = published_rotor(variant="uncoupled").machine
    c3, tilted = float(closed.stiffness_terms[2]), 0.479 + 0.05 * 2 * (0.28**2 + 0.25**2)
    w = (0.093 * 460.0 + np.sqrt((0.093 * 460.0) ** 2 + 4.0 * tilted * c3)) / (2.0 * tilted)
    assert 292.5 < w < 293.5
    undamped = eqx.tree_at(lambda s: s.machine.damping_terms, published_rotor(variant="uncoupled"), jnp.zeros(3))
    np.testing.assert_allclose(jv.whirl(undamped).speed[0][3], w, rtol=1e-10)


def test_whirl_is_the_free_motion_of_the_vector_field():
    """Eigenvalues of the field's own Jacobian at rest; massless loads leave the rotor's motion alone."""
    loads = jv.pendulums(count=4, mass=1e-13, radius=0.08, drag=1e-10)
    s = jv.Scene(published_rotor().machine, loads, jv.ConstantSpeed(460.0))
    rest = jv.initial_state(s)
    field = jv.vector_field(s)

    def motion(x):
        state = eqx.tree_at(lambda y: (y.displacement, y.velocity), rest, (x[:4], x[4:]))
        change = field(0.0, state)
        return jnp.concatenate([change.displacement, change.velocity])

    values = np.linalg.eigvals(np.asarray(jax.jacfwd(motion)(jnp.zeros(8))))
    values = values[values.imag > 0.0]
    values = values[np.argsort(values.imag)]
    found = jv.whirl(s, loads="none")
    np.testing.assert_allclose(found.speed[0], values.imag, rtol=1e-8)
    np.testing.assert_allclose(found.decay[0], -values.real, rtol=1e-6)


def test_thin_disc_has_no_second_forward_critical_speed():
    s = eqx.tree_at(lambda s: s.machine.polar_inertia, published_rotor(variant="uncoupled"), jnp.asarray(0.9))
    found = jv.critical_speeds(s)
    assert int(jnp.sum(jnp.isinf(found.speed))) == 1
    assert np.all(np.isfinite(np.asarray(found.speed[:3])))


def test_heavily_damped_motion_does_not_oscillate():
    s = jv.Scene(
        jv.planar_rotor(mass=10.0, stiffness=1e3, damping=1e3),
        jv.pendulums(count=1, mass=0.1, radius=0.1, drag=0.1),
        jv.ConstantSpeed(50.0),
    )
    found = jv.whirl(s, loads="none")
    np.testing.assert_array_equal(found.speed[0], 0.0)
    assert np.all(np.asarray(found.decay) > 0.0)


def test_gradients_of_whirl_speeds():
    s = published_rotor()

    def speeds(k):
        changed = eqx.tree_at(lambda s: s.machine.polar_inertia, s, k)
        return jnp.concatenate([jv.whirl(changed).speed[0], jv.critical_speeds(changed).speed])

    at, step = jnp.asarray(0.093), 1e-5
    forward, reverse = stored_jit(jax.jacfwd(speeds))(at), stored_jit(jax.jacrev(speeds))(at)
    numeric = (speeds(at + step) - speeds(at - step)) / (2.0 * step)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-7)
    # Rounding of a speed, 1e-11, over the step: 1e-6; the difference's own error is smaller.
    np.testing.assert_allclose(forward, numeric, rtol=1e-5, atol=1e-4)


def test_campbell_diagram_has_both_senses():
    found = jv.whirl(published_rotor(), list(np.linspace(0.0, 600.0, 13)))
    assert found.speed.shape == (13, 4)
    labels = [line.get_label() for line in found.plot().axes[0].lines]
    assert "forward whirl" in labels and "backward whirl" in labels


def test_platforms_do_not_whirl():
    with pytest.raises(jv.InputError, match=r"machine\.kind is 'two_mass', which moves up and down only"):
        jv.whirl(platforms("two_mass"))
    with pytest.raises(jv.InputError, match=r"rotor_speed\[1\] is -5 rad/s; it must be at least 0"):
        jv.whirl(published_rotor(), [10.0, -5.0])
    with pytest.raises(jv.InputError, match=r"loads is 'some'; allowed: fixed, none"):
        jv.whirl(published_rotor(), loads="some")


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_whirls_of_one_speed_are_told_apart_in_machines_of_every_size(size):
    """Without damping and gyroscopic coupling both turn at sqrt(k/m), one in each sense."""
    machine = jv.planar_rotor(mass=37.0 * size, stiffness=1.16e6 * size, damping=0.0)
    scene = jv.Scene(machine, jv.pendulums(count=1, mass=0.5 * size, radius=0.08, drag=0.1), jv.ConstantSpeed(460.0))
    found = jv.whirl(scene, loads="none")
    np.testing.assert_allclose(found.speed[0], (1.16e6 / 37.0) ** 0.5, rtol=1e-9)
    assert sorted(np.asarray(found.forward[0]).tolist()) == [False, True]


def test_springs_hold_whatever_the_units_of_their_coordinates():
    assert _held(1e-9 * np.eye(3)) and _held(np.diag([1e12, 1e-12]))
    assert not _held(1e10 * np.array([[1.0, 1.0], [1.0, 1.0]])) and not _held(np.diag([1e-9, 0.0]))
