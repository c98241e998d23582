"""Designs of machines with several exciters: recipes, files, sweeps, held quantities."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.files import SCREENS
from optimize import (
    DesignSpace,
    foundation_force,
    hold,
    load_design,
    motion_spread,
    recipes,
    synthesize,
    throw_angle,
)
from optimize.files import TEMPLATES as DESIGNS

DECK = [(-1.5, 0.1), (1.5, 0.1)]


def screen(**motor):
    scene = jv.scene_from_toml(SCREENS["linear_screen"])
    given = {"breakdown_torque": 80.0, "breakdown_slip": 0.35, "inertia": 0.6, **motor}
    second = jv.Exciter(drive=jv.InductionMotor("1000 rpm", **given), unbalance=4.56, at=(0.7, 0.3), direction=-1)
    return jv.Scene(scene.machine, exciters=[scene.exciters[0], second], effects=scene.effects)


def place(low=0.2, high=1.2):
    """Design space: the place of the second exciter."""
    return {"exciters[1].at[0]": (low, high), "exciters[1].at[1]": (low, high)}


def test_search_finds_the_position_without_rotation():
    """Ideal drives force the body along x: its turn is 0 if i (a_2 - a_1) - (b_1 + b_2) = 2 D_(psi x) / D_xx."""
    machine, speed = screen().machine, 100.0
    drive = jv.ConstantSpeed(speed)
    exciters = [
        jv.Exciter(drive=drive, unbalance=4.0, at=(0.1, 0.4)),
        jv.Exciter(drive=drive, unbalance=4.0, at=(0.5, 0.5), direction=-1),
    ]
    best = synthesize(
        DesignSpace(jv.Scene(machine, exciters=exciters), place(-1.0, 1.0)), motion_spread(DECK), starts=4, verify=False
    )
    k = 2.0 * (280e3 + 1j * speed * 2000.0)  # two springs, 0.3 m below the centre
    share = 2.0 * 0.3 * k / (k - speed**2 * 2600.0)
    assert best.status_name == "done" and best.same == 4 and best.values.min() < 1e-6
    np.testing.assert_allclose(best.scene.exciters[1].position, [0.1 + share.imag, -0.4 - share.real], atol=1e-6)


@pytest.mark.slow
def test_designs_without_a_regime_end_in_a_named_status():
    """A light unbalance does not couple motors of 1000 and at least 2000 rpm."""
    light = eqx.tree_at(lambda s: s.exciters[0].unbalance, screen(), jnp.asarray(0.05))
    apart = DesignSpace(light, {"exciters[1].drive.speed": ("2000 rpm", "2500 rpm")})
    with pytest.raises(jv.ComputationError, match="does not exist for any of the 4 random designs") as raised:
        synthesize(apart, motion_spread(DECK), starts=4, verify=False)
    assert raised.value.status == "no_feasible_start"


@pytest.mark.parametrize("name", [name for name in DESIGNS if name != "design"])
def test_recipe_files_are_the_recipes(name, tmp_path):
    kind = name.removesuffix("-design").replace("-", "_")
    file = {"linear_screen": "screen"}.get(kind, kind)
    (tmp_path / f"{file}.toml").write_text(SCREENS[kind])
    (tmp_path / "design.toml").write_text(DESIGNS[name])
    assert len(DESIGNS[name].splitlines()) <= 10
    design = load_design(tmp_path / "design.toml")
    points = [tuple(p) for p in ([-0.8, 0.1], [0.8, 0.1])] if kind == "feeder" else None
    if points:
        same = recipes.feeder(jv.scene_from_toml(SCREENS[kind]), points=points, stroke="4 mm")
        assert same.objective == design.objective and same.subject_to == design.subject_to
    assert design.search == {"starts": 32} and design.space.size == {"circular_screen": 3, "feeder": 9}.get(kind, 5)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[recipe]\nname = "screen"', "recipe.name is 'screen'"),
        ('[recipe]\nname = "linear_screen"', "recipe.points is missing"),
        ('[recipe]\nname = "linear_screen"\npoints = [[0, 0], [1, 0]]\nangles = 3', "did you mean 'angle'"),
        ('[recipe]\nname = "linear_screen"\npoints = 3', "list of at least two points"),
        ('[free]\na = [1, 2]\n[recipe]\nname = "feeder"', "given together with"),
        ('[recipe]\nname = "antiphase"', "needs a machine of platforms"),
    ],
)
def test_wrong_recipes_in_files_are_refused(text, says, tmp_path):
    (tmp_path / "screen.toml").write_text(SCREENS["linear_screen"])
    (tmp_path / "design.toml").write_text(f'scene = "screen.toml"\n{text}\n')
    with pytest.raises(jv.InputError, match=says):
        load_design(tmp_path / "design.toml")


@pytest.mark.slow
def test_sweep_measures_screens_and_names_those_without_regime(tmp_path):
    places = [0.6, 0.8]
    measure = {"spread": motion_spread(DECK), "force": foundation_force()}
    found = jv.sweep(screen(), {"exciters[1].at[0]": places}, measure, tmp_path / "places.zarr")
    space = DesignSpace(screen(), {"exciters[1].at[0]": (0.5, 1.0)})
    alone = [float(motion_spread(DECK)(space.scene_of(jnp.array([x])))) for x in places]
    np.testing.assert_allclose(found.data["spread"], alone, rtol=1e-9)
    apart = jv.sweep(screen(), {"exciters[1].drive.speed": ["1000 rpm", "2000 rpm"]}, measure, tmp_path / "speeds.zarr")
    assert {count.status: count.cases for count in apart.counts if count.cases} == {"done": 1, "absent": 1}


@pytest.mark.slow
def test_held_quantity_of_a_screen_keeps_its_value():
    space = DesignSpace(screen(), place(), [hold(throw_angle(), "45 deg")])
    best = synthesize(space, motion_spread(DECK), starts=4, iterations=25, verify=False)
    np.testing.assert_allclose(throw_angle()(best.scene), np.pi / 4.0, rtol=1e-7)
