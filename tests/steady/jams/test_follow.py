"""Jams and folds followed from a near machine, against the whole branch."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scenes import scene

import jaxvib as jv
from jaxvib.equations.linear import jammed_model
from jaxvib.steady.jams.follow import follow_fold, follow_jam

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
        value, slope = jax.jit(jax.value_and_grad(force), static_argnums=1)(k, mode, near)
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
        value, slope = jax.jit(jax.value_and_grad(speed))(k, omega * 1.0005)
        np.testing.assert_allclose(value, n, rtol=1e-9)
        # Step 1e-6: truncation 1e-9, rounding 1e-9 of the value; the fold's place moves with k.
        step = 1e-6 * k[0]
        sides = [speed(k.at[0].add(sign * step), omega) for sign in (1.0, -1.0)]
        np.testing.assert_allclose(slope[0], (sides[0] - sides[1]) / (2.0 * step), rtol=1e-5)
