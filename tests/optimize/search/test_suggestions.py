"""Suggestions of parameters to free: groups, and lines that a design file accepts."""

import tomllib

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.files import SCREENS, TEMPLATES, scene_from_toml
from optimize import DesignSpace, Quantity, synthesize
from optimize.search.suggestions import groups_of, lines_to_free

FEEDER = scene_from_toml(SCREENS["feeder"])
SCENES = {**{name: scene_from_toml(text) for name, text in TEMPLATES.items()}, "feeder": FEEDER}
FREE = {"machine.mass": (200.0, 800.0)}


def pasted(scene, lines, free=None):
    """The design space of a file with these lines."""
    tables = tomllib.loads("\n".join(lines))
    ties = {name: tuple(source) if isinstance(source, list) else source for name, source in tables.get("ties", {}).items()}
    return DesignSpace(scene, {**(free or {}), **tables["free"]}, ties=ties)


@pytest.mark.parametrize("name", SCENES)
def test_lines_of_every_group_change_it_by_one_factor(name):
    scene = SCENES[name]
    speed = DesignSpace(
        scene, {}, choices={"drive.speed" if len(scene.exciters) == 1 else "exciters[0].drive.speed": [1.0, 2.0]}
    )
    for group in (group for kind in groups_of(speed, scene) for group in kind):
        space = pasted(scene, ["[free]", group.free_line(), "[ties]", *group.tie_lines()])
        changed = space.scene_of(jnp.array([1.5 * group.values[0]]))
        np.testing.assert_allclose([n.read(changed)[0] for n in group.members], 1.5 * np.array(group.values), rtol=1e-12)
        assert space.low[0] <= group.values[0] <= space.high[0]


def supports(function):
    """Quantity of the vertical stiffness of both supports, relative to their present value."""
    return Quantity("share", "", lambda s: function(*(each.stiffness[1] / 126e3 for each in s.machine.supports)))


@pytest.mark.parametrize(
    ("function", "lines"),
    [
        (lambda a, b: a + b, ["# 2 by one factor, 1 % more: share +1 %", '["63 N/mm", "252 N/mm"]', "[ties]"]),
        (lambda a, b: 2.0 + a - 0.3 * b, ["# 2 by one factor, 1 % more: share +0.26 %", '["63 N/mm", "252 N/mm"]', "[ties]"]),
        (lambda a, b: 2.0 + a - b, ["# 1 % more: share +0.5 %", '["63 N/mm", "252 N/mm"]']),
    ],
)
def test_equal_springs_are_suggested_together(function, lines):
    """Only if their effects nearly cancel, one of them is suggested."""
    space = DesignSpace(FEEDER, FREE)
    head, *shown = lines_to_free(space, FEEDER, [(supports(function), 5.0)])
    name = "machine.supports[0].stiffness[1]"
    assert head == "[free]" and shown[:2] == [lines[0], f'"{name}" = {lines[1]}']
    ties = [lines[2], f'"machine.supports[1].stiffness[1]" = "{name}"'] if len(lines) > 2 else []
    assert shown[2:] == ties
    assert pasted(FEEDER, [head, *shown], FREE).size == 2


def test_pasted_suggestion_meets_the_demand():
    space = DesignSpace(FEEDER, FREE)
    demand, mass = supports(lambda a, b: a + b) > 3.0, Quantity("mass", "kg", lambda s: s.machine.mass)
    with pytest.raises(jv.ComputationError) as error:
        synthesize(space, mass, subject_to=[demand], starts=4, verify=False)
    assert "at best 2, 33.3 % off); widen the bounds or relax a demand, or free other parameters" in str(error.value)
    first, *lines = str(error.value).splitlines()
    best = synthesize(pasted(FEEDER, lines, FREE), mass, subject_to=[demand], starts=4, verify=False)
    assert best.status_name == "done"
    first, second = (each.stiffness[1] for each in best.scene.machine.supports)
    assert first == second and first >= 1.5 * 126e3 * (1.0 - 1e-6)


def test_directions_are_stated_for_each_quantity():
    light, heavy = Quantity("light", "", lambda s: 1.0 / s.machine.mass), Quantity("heavy", "", lambda s: s.machine.mass)
    lines = lines_to_free(DesignSpace(FEEDER, {"machine.inertia": (80.0, 320.0)}), FEEDER, [(light, 1.0), (heavy, 500.0)])
    assert lines == ["[free]", "# 1 % less: light +0.99 %; 1 % more: heavy +1 %", '"machine.mass" = ["200 kg", "800 kg"]']
