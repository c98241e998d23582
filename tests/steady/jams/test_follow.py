"""Jams and folds followed from a near machine, against the whole branch."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scenes import scene

import jaxvib as jv
from jaxvib.equations.linear import jammed_model
from jaxvib.steady.jams.follow import _newton, follow_fold, follow_jam
from jaxvib.steady.jams.jam import jam_at

SCENE = scene("two_mass", speed=120.0)


def stiffer(k):
    return jammed_model(eqx.tree_at(lambda s: s.machine.stiffness, SCENE, k))


def test_followed_jams_are_those_of_the_whole_branch():
    modes = jv.jam_modes(SCENE)
    k = SCENE.machine.stiffness

    def force(k, mode, near):
        return follow_jam(stiffer(k), mode, near).foundation_force

    def whole(k):
        return jv.jam_modes(eqx.tree_at(lambda s: s.machine.stiffness, SCENE, k)).foundation_force

    exact = jax.jacrev(whole)(k)
    for mode in modes.mode_numbers():
        near = modes.omega[mode - 1] * (0.99 if mode % 2 else 1.001)
        value, slope = eqx.filter_jit(jax.value_and_grad(force))(k, mode, near)
        np.testing.assert_allclose(value, modes.foundation_force[mode - 1], rtol=1e-8)
        np.testing.assert_allclose(slope, exact[mode - 1], rtol=1e-6)


def test_what_is_not_that_mode_is_nan():
    falling = jv.jam_modes(SCENE).omega[3]
    assert np.isnan(follow_jam(jammed_model(SCENE), 3, falling).omega)  # mode 4 falls, mode 3 rises
    assert np.isnan(follow_jam(jammed_model(SCENE), 3, jnp.asarray(1.0)).foundation_force)


def test_followed_folds_are_those_of_the_whole_branch():
    folds, k = jv.jam_modes(SCENE).folds, SCENE.machine.stiffness

    def speed(k, near):
        return follow_fold(stiffer(k), near)[1]

    for omega, n in zip(folds.omega, folds.rotor_speed, strict=True):
        value, slope = eqx.filter_jit(jax.value_and_grad(speed))(k, omega * 1.0005)
        np.testing.assert_allclose(value, n, rtol=1e-9)
        # Step 1e-6: truncation 1e-9, rounding 1e-9 of the value; the fold's place moves with k.
        step = 1e-6 * k[0]
        sides = [speed(k.at[0].add(sign * step), omega) for sign in (1.0, -1.0)]
        np.testing.assert_allclose(slope[0], (sides[0] - sides[1]) / (2.0 * step), rtol=1e-5)


def test_steps_are_at_most_a_tenth_and_bounded():
    far = _newton(lambda w: w - 1000.0, jnp.asarray(10.0), jnp.asarray(jnp.inf))
    np.testing.assert_allclose(far, 10.0 * 1.1**6, rtol=1e-12)
    np.testing.assert_allclose(_newton(lambda w: w - 1.0, jnp.asarray(10.0), jnp.asarray(jnp.inf)), 10.0 * 0.9**6, rtol=1e-12)
    np.testing.assert_allclose(_newton(lambda w: w - 50.0, jnp.asarray(10.0), jnp.asarray(10.4)), 10.4 - 0.4 / 2**6, rtol=1e-12)
    np.testing.assert_allclose(_newton(lambda w: w**2 - 110.0, jnp.asarray(10.0), jnp.asarray(20.0)), 110.0**0.5, rtol=1e-12)


def test_undamped_resonance_has_no_amplitude():
    """The exciter's platform at its resonance, without damping and apart from the other one, which does not move."""
    machine = jv.two_mass(mass=(2.0, 1.0), stiffness=(8.0, 9.0), damping=(0.0, 0.0), link_stiffness=0.0, link_damping=0.0)
    alone = jv.Scene(machine, jv.balls(count=1, mass=0.01, radius=0.1, drag=1e-3), jv.ConstantSpeed(20.0))
    resonance = jnp.sqrt(9.0 / 1.01)
    jam = jam_at(jammed_model(alone), jnp.asarray(4), resonance, jnp.asarray(20.0), jnp.asarray(False))
    assert np.isnan(jam.displacement).all()
    beside = jam_at(jammed_model(alone), jnp.asarray(4), 1.01 * resonance, jnp.asarray(20.0), jnp.asarray(False))
    assert np.isfinite(beside.displacement).all()


def test_amplitudes_are_bounded_by_the_lightest_platform():
    """Near an undamped resonance 1e12 times the imbalance over the lightest mass is an answer, however heavy another one is."""
    machine = jv.two_mass(mass=(2e6, 1.0), stiffness=(8e6, 9.0), damping=(0.0, 0.0), link_stiffness=0.0, link_damping=0.0)
    alone = jv.Scene(machine, jv.balls(count=1, mass=0.01, radius=0.1, drag=1e-3), jv.ConstantSpeed(20.0))
    omega = jnp.sqrt(9.0 / 1.01) * (1.0 + 1e-12)
    jam = jam_at(jammed_model(alone), jnp.asarray(4), omega, jnp.asarray(20.0), jnp.asarray(False))
    assert np.isfinite(jam.displacement).all() and float(jnp.max(jnp.abs(jam.displacement))) > 1e11 * 0.01 * 0.1
