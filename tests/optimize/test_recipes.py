"""Recipes and trade-offs."""

from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib.machine.files import SCREENS
from jaxvib.machine.numbers.named import find_number, put_numbers
from optimize import DesignSpace, Quantity, amplitude, fold_margin, force_per_amplitude, pareto, recipes
from optimize.recipes import (
    anti_resonance,
    antiphase,
    circular_screen,
    feeder,
    lightest_exciter,
    linear_screen,
    retune,
    widest_range,
)

SCENE = scene("two_mass", speed=120.0)
SCREEN = jv.scene_from_toml(SCREENS["linear_screen"])
DECK = [(0.0, 0.0), (1.0, 0.0)]


def test_front_contains_machines_between_its_ends():
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
    both = pareto(space, distance([2.0, 5.0]), distance([2.0, 5.0]) + 1.0, points=4, starts=4)
    assert len(both.values) == len(both.machines) == 1  # one machine is the best of both


def test_retune_selects_one_spring():
    wish = Quantity("wish", "", lambda s: (s.machine.link_stiffness[0] / 1e5 - 3.0) ** 2 + s.machine.stiffness[0] / 1e5)
    found = retune(SCENE, wish, starts=4)
    assert found[0][0] == "machine.link_stiffness[0]" and len(found) == 3
    np.testing.assert_allclose(found[0][1].scene.machine.link_stiffness, [3e5], rtol=1e-4)


def test_springs_are_ranked_by_their_best_machine(monkeypatch):
    """The order does not depend on the end points of other starts."""
    ends = {"machine.stiffness[0]": [3.0, 9.0], "machine.stiffness[1]": [1.0, 99.0], "machine.link_stiffness[0]": [4.0, 4.0]}

    def search(space, objective, *, starts, verify):
        (number,) = space.free
        assert starts == 16 and not verify and float(space.high[0] / space.low[0]) == pytest.approx(9.0)
        return SimpleNamespace(values=np.array(ends[number.name]))

    monkeypatch.setattr(recipes, "synthesize", search)
    found = [name for name, _ in retune(SCENE, None)]
    assert found == ["machine.stiffness[1]", "machine.stiffness[0]", "machine.link_stiffness[0]"]


def test_recipes_are_designs():
    three = scene("three_mass", speed=60.0)
    for design, free, demands in (
        (antiphase(SCENE), 3, 0),
        (anti_resonance(three, mode=3), 3, 0),
        (lightest_exciter(SCENE, "5 mm", mode=3), 1, 1),
        (widest_range(SCENE, mode=3), 3, 1),
    ):
        assert design.space.size == free and len(design.subject_to) == demands


def test_recipes_have_their_objective_and_held_values():
    design = antiphase(SCENE, range_=4.0)
    assert design.objective == force_per_amplitude(mode=3)
    assert [held.quantity.name for held in design.space.held] == ["jam_frequency", "support_frequency_squared"]
    np.testing.assert_allclose(design.space.low, np.array([5e4, 3e4, 2e5]) / 4.0)
    np.testing.assert_allclose(design.space.high, np.array([5e4, 3e4, 2e5]) * 4.0)
    middle = anti_resonance(scene("three_mass", speed=60.0), mode=3)
    assert middle.objective.operation == "/" and [part.of for part in middle.objective.parts] == [2, (1, 3)]
    assert [place.name for place in middle.space.free] == [f"machine.link_stiffness[{k}]" for k in range(3)]
    assert [held.quantity.name for held in middle.space.held] == ["jam_frequency"]
    light = lightest_exciter(SCENE, "5 mm", mode=3, of=2)
    assert light.objective.name == "total_mass" and light.space.free[0].name == "loads.mass"
    np.testing.assert_allclose([light.space.low[0], light.space.high[0]], [0.08, 8.0])
    assert light.subject_to[0].words == "amplitude of platform 2, mode 3 at least 5 mm"
    wide = widest_range(SCENE, mode=3, keep=0.5, of=1)
    assert wide.objective == -fold_margin(mode=3) and wide.subject_to[0].sense == "at least"
    np.testing.assert_allclose(wide.subject_to[0].constant, 0.5 * float(amplitude(mode=3, of=1)(SCENE)))


def test_a_straight_throw_needs_two_directions():
    points = [(-1.5, 0.1), (1.5, 0.1)]
    alike = jv.scene_from_toml(SCREENS["linear_screen"].replace("direction = -1", "direction = 1"))
    assert linear_screen(SCREEN, points=points, stroke="7 mm").notes() == []
    (note,) = linear_screen(alike, points=points, stroke="7 mm").notes()
    assert note.startswith("all exciters turn in one direction") and "direction = -1" in note
    assert circular_screen(alike, points=points, stroke="7 mm").notes() == []


@pytest.mark.parametrize("recipe", [linear_screen, circular_screen, feeder])
def test_unbalances_keep_their_ratio(recipe):
    first = SCREEN.exciters[0].unbalance
    uneven = eqx.tree_at(lambda s: s.exciters[1].unbalance, SCREEN, 2.0 * first)
    space = recipe(uneven, points=DECK, stroke="7 mm").space
    heaviest = space.scene_of(jnp.asarray(space.high))
    np.testing.assert_allclose([e.unbalance for e in heaviest.exciters], [3.0 * first, 6.0 * first], rtol=1e-12)


def test_recipes_create_no_absent_springs():
    hung = eqx.tree_at(lambda s: s.machine.stiffness, SCENE, jnp.array([5e4, 0.0]))
    assert [place.name for place in widest_range(hung, mode=3).space.free] == [
        "machine.stiffness[0]",
        "machine.link_stiffness[0]",
    ]
    free = eqx.tree_at(lambda s: (s.machine.stiffness, s.machine.link_stiffness), SCENE, (jnp.zeros(2), jnp.zeros(1)))
    with pytest.raises(jv.InputError, match="has no springs that can be changed"):
        retune(free, None)


def test_lightest_exciter_gives_exactly_the_requested_amplitude():
    best = lightest_exciter(SCENE, "42 mm", mode=3).run(starts=4, iterations=25, verify=False)
    assert best.status_name == "done" and best.limits[0].active
    np.testing.assert_allclose(best.limits[0].value, 0.042, rtol=1e-7)


@pytest.mark.slow
def test_antiphase_machine_has_equal_partial_frequencies():
    """Little damped platforms in antiphase leave the foundation alone where M1 y1 + M2 y2 = 0 and k1 y1 + k2 y2 = 0: k1/M1 =
    k2/M2."""
    light = eqx.tree_at(
        lambda s: (s.machine.damping, s.machine.link_damping), SCENE, (jnp.array([0.04, 0.02]), jnp.array([0.06]))
    )
    best = antiphase(light).run(starts=32, verify=False)
    k, m = best.scene.machine.stiffness, np.asarray([120.0, 95.0 + 2.4])
    assert best.status_name == "done"
    np.testing.assert_allclose(k[0] / m[0], k[1] / m[1], rtol=0.01)
    of = {tier: float(force_per_amplitude(mode=3, tier=tier)(best.scene)) for tier in ("leading", "exact")}
    assert max(of.values()) < 0.05 * best.before.force_per_amplitude


@pytest.mark.slow
def test_the_middle_platform_rests_at_the_anti_resonance():
    """Without damping k12/M1 = k23/M3 = w^2, masses with their loads."""
    machine = jv.three_mass(
        mass=(30.0, 40.0, 30.0), stiffness=(0.0, 4e4, 0.0), damping=(0.0, 0.01, 0.0), link_stiffness=(2e5, 0.0, 3e5),
        link_damping=(0.01, 0.0, 0.01), exciter=3,
    )  # fmt: skip
    start = jv.Scene(machine, jv.balls(count=2, mass=0.05, radius=0.1, drag=0.2), jv.ConstantSpeed(160.0))
    best = anti_resonance(start, mode=3).run(starts=32, verify=False)
    k, omega = best.scene.machine.link_stiffness, best.after.omega
    np.testing.assert_allclose([k[0] / 30.0, k[2] / 30.1], [omega**2, omega**2], rtol=0.01)
    orbit = jv.jam_orbit(best.scene, mode=3)
    assert orbit.amplitude[1] < 0.01 * orbit.relative_amplitude(1, 3)


@pytest.mark.slow
def test_the_spring_that_is_exchanged_is_the_best_of_a_scan():
    found = retune(SCENE, force_per_amplitude(mode=3), starts=8)
    asked = eqx.filter_jit(force_per_amplitude(mode=3).__call__)
    least = {}
    for name, _ in found:
        spring = find_number(SCENE, name, "free")
        scan = [put_numbers(SCENE, (spring,), spring.read(SCENE) * share) for share in np.geomspace(1.0 / 3.0, 3.0, 301)]
        least[name] = np.nanmin([float(asked(each)) for each in scan])
    assert [name for name, _ in found] == sorted(least, key=lambda name: least[name])
    for name, best in found:
        assert best.values.min() <= least[name] * (1.0 + 1e-9)
        np.testing.assert_allclose(best.values.min(), float(asked(best.scene)), rtol=1e-6)


@pytest.mark.slow
def test_lightest_exciter_holds_in_the_full_equations():
    best = lightest_exciter(SCENE, "42 mm", mode=3).run(starts=8)
    assert best.run is not None and best.verified is not None
    np.testing.assert_allclose(float(amplitude(mode=3, tier="exact")(best.scene)), 0.042, rtol=0.02)  # to leading order 0.042
    shaken = next(row for row in best.table if row.what.startswith("amplitude, mode 3"))
    np.testing.assert_allclose(shaken.time, shaken.exact, rtol=1e-3)


@pytest.mark.slow
def test_the_widest_range_is_that_of_the_whole_branch():
    """The distance to the fold that the search followed, against the folds of the machine it found."""
    design = widest_range(SCENE, mode=3, keep=0.9)
    best = design.run(starts=16, verify=False)
    modes = jv.jam_modes(best.scene)
    omega, speed = (np.asarray(a)[np.asarray(modes.folds.exists)] for a in (modes.folds.omega, modes.folds.rotor_speed))
    jam = float(modes.select(3).omega)
    above = speed[omega > jam][np.argmin(omega[omega > jam])]  # the folds beside the jam on the branch
    below = speed[omega < jam][np.argmax(omega[omega < jam])] if np.any(omega < jam) else 0.0
    np.testing.assert_allclose(-best.values.min(), min(above - 120.0, 120.0 - below), rtol=1e-7)
    assert -best.values.min() > 1.05 * float(fold_margin(mode=3)(SCENE))
    assert best.after.amplitude and best.limits[0].violation == 0.0


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: anti_resonance(SCENE, mode=3), "this recipe needs at least 3"),
        (lambda: antiphase(3.0), "needs a machine of platforms"),
        (lambda: widest_range(SCENE, mode=3, keep=2.0), "at most 1"),
        (lambda: lightest_exciter(scene("one_mass", "pendulums"), 0.01, mode=1), "differs from load to load"),
        (lambda: widest_range(SCENE, mode=3, keep="much"), "keep is 'much'"),
        (lambda: widest_range(scene("two_mass", speed=1e-3), mode=5), "mode is 5; this jam mode does not exist"),
        (lambda: antiphase(SCENE, range_=0.0), "range_ is 0.0; it must be greater than 1"),
        (lambda: antiphase(SCENE, range_="wide"), "range_ is 'wide'"),
        (lambda: feeder(SCREEN, points=DECK, range_=0), "range_ is 0; it must be greater than 1"),
        (lambda: feeder(SCREEN, points=DECK, spread=-1), "^spread is -1; it must be greater than 0"),
        (lambda: feeder(SCREEN, points=DECK, angle="100 deg"), "^angle is '100 deg'; it must be between 0 and 90 deg"),
        (lambda: linear_screen(SCREEN, points=DECK, angle=45), "^angle is 45; .*; a number without a unit is in rad"),
        (lambda: linear_screen(SCREEN, points=DECK, stroke="-8 mm"), "^stroke is '-8 mm'; it must be greater than 0"),
        (lambda: circular_screen(SCREEN, points=DECK, stroke=0.0), "^stroke is 0.0; it must be greater than 0"),
        (lambda: circular_screen(SCREEN, points=DECK, reach=-0.1), "^reach is -0.1; it must be greater than 0"),
        (lambda: circular_screen(SCREEN, points=DECK[:1] * 2), "one point several times; give at least two different points"),
        (lambda: lightest_exciter(SCENE, "-1 mm", mode=3), "^least is '-1 mm'; it must be greater than 0"),
        (lambda: lightest_exciter(SCENE, "1 mm", mode=99), "^mode is 99; this machine's jam modes are numbered 1 to 5"),
        (lambda: linear_screen(SCREEN, points=[]), "must be a list of at least two points"),
        (lambda: pareto(None, None, None, points=1), "space is None; it must be a DesignSpace"),
    ],
)
def test_wrong_recipes_raise_clear_errors(make, says):
    with pytest.raises(jv.InputError, match=says):
        make()
