"""Recipes and trade-offs."""

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from optimize import DesignSpace, Quantity, pareto
from optimize.recipes import anti_resonance, antiphase, lightest_exciter, retune, widest_range

SCENE = scene("two_mass", speed=120.0)


def test_a_front_holds_the_machines_between_two_best_ones():
    """The squares of the distances to (2, 5) and (6, 5): the front is the line between them, sqrt(a) + sqrt(b) = 4."""

    def distance(at):
        place = jnp.asarray(at)
        return Quantity(f"distance to {at}", "", lambda s: jnp.sum((s.machine.stiffness / 1e4 - place) ** 2))

    space = DesignSpace(SCENE, {"machine.stiffness": (1e4, 9e4, "even")})
    front = pareto(space, distance([2.0, 5.0]), distance([6.0, 5.0]), points=4, starts=4)
    assert len(front.values) >= 3 and np.all(np.diff(front.values[:, 0]) > 0.0)
    np.testing.assert_allclose(np.sqrt(np.abs(front.values)).sum(axis=1), 4.0, atol=1e-4)  # the root of a rounding near 0
    np.testing.assert_allclose(front.scene(1).machine.stiffness[1], 5e4, rtol=1e-5)
    assert "distance to [2.0, 5.0] against" in front.summary()


def test_one_spring_is_chosen_to_be_exchanged():
    wish = Quantity("wish", "", lambda s: (s.machine.link_stiffness[0] / 1e5 - 3.0) ** 2 + s.machine.stiffness[0] / 1e5)
    found = retune(SCENE, wish, starts=4)
    assert found[0][0] == "machine.link_stiffness[0]" and len(found) == 3
    np.testing.assert_allclose(found[0][1].scene.machine.link_stiffness, [3e5], rtol=1e-4)


def test_recipes_are_designs():
    three = scene("three_mass", speed=60.0)
    for design, free, demands in (
        (antiphase(SCENE), 3, 0),
        (anti_resonance(three, mode=3), 3, 0),
        (lightest_exciter(SCENE, "5 mm", mode=3), 1, 1),
        (widest_range(SCENE, mode=3), 3, 1),
    ):
        assert design.space.size == free and len(design.subject_to) == demands


def test_the_lightest_exciter_shakes_by_what_is_asked_and_no_more():
    best = lightest_exciter(SCENE, "42 mm", mode=3).run(starts=4, iterations=25, verify=False)
    assert best.status_name == "done" and best.limits[0].active
    np.testing.assert_allclose(best.limits[0].value, 0.042, rtol=1e-7)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: anti_resonance(SCENE, mode=3), "this recipe needs 3"),
        (lambda: antiphase(3.0), "has no machine of platforms"),
        (lambda: widest_range(SCENE, mode=3, keep=2.0), "at most 1"),
        (lambda: lightest_exciter(scene("one_mass", "pendulums"), 0.01, mode=1), "differs from load to load"),
        (lambda: pareto(None, None, None, points=1), "points is 1"),
    ],
)
def test_wrong_recipes_are_said_in_one_sentence(make, says):
    with pytest.raises(jv.InputError, match=says):
        make()
