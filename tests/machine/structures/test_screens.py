"""Files of screens and feeders: they load, and move as the rules of their data sheets say."""

import equinox as eqx
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.files import SCREENS


@pytest.mark.parametrize("name", SCREENS)
def test_file_of_a_screen_is_written_and_read_again(name):
    scene = jv.scene_from_toml(SCREENS[name])
    assert eqx.tree_equal(jv.scene_from_toml(jv.scene_to_toml(scene)), scene)
    speed = min(float(exciter.drive.speed) for exciter in scene.exciters)
    assert float(np.max(jv.natural_frequencies(scene))) < 0.35 * speed  # works far above its resonances
    for exciter in scene.exciters:  # lifts its unbalance from rest
        assert float(exciter.drive.torque(0.0)) > 9.81 * float(exciter.unbalance)


@pytest.mark.parametrize(("name", "angle"), [("linear_screen", 45.0), ("feeder", 25.0)])
def test_opposite_motors_throw_in_the_direction_of_their_middle(name, angle):
    """Soft supports: a straight line at (d_1 + d_2)/2 with the amplitude sum S/M (Blekhman 1988)."""
    scene = jv.scene_from_toml(SCREENS[name])
    path = jv.simulate(scene, 8.0, save="window", estimate=False).ellipse()
    assert abs(np.rad2deg(float(path.direction)) - angle) < 3.0
    assert abs(float(path.semi_minor)) < 0.02 * float(path.semi_major)
    moment = sum(float(exciter.unbalance) for exciter in scene.exciters)
    np.testing.assert_allclose(path.semi_major, moment / scene.machine.mass, rtol=0.06)


def test_circular_screen_moves_on_circles():
    path = jv.simulate(jv.scene_from_toml(SCREENS["circular_screen"]), 8.0, save="window", estimate=False).ellipse()
    assert float(path.sense) == -1.0
    np.testing.assert_allclose(abs(path.semi_minor), path.semi_major, rtol=0.03)


def test_regime_of_a_screen_has_the_ellipses_of_its_run():
    """The error of the averaged theory is about S^2/(2 M I), here 0.7 %. It omits the second and third harmonics, which are 1.4
    and 1.5 % of the acceleration."""
    scene = jv.scene_from_toml(SCREENS["linear_screen"])
    averaged = jv.synchronous_regimes(scene).select(0).ellipse((1.5, 0.1))
    settled = jv.simulate(scene, 15.0, save="window", estimate=False).ellipse((1.5, 0.1))
    np.testing.assert_allclose(averaged.semi_major, settled.semi_major, rtol=0.01)
    np.testing.assert_allclose(averaged.direction, settled.direction, atol=0.01)
    np.testing.assert_allclose(averaged.throw_number, settled.throw_number, rtol=0.014 + 0.015)
