"""Scene files with other numbers."""

import equinox as eqx
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.files import SCREENS, TEMPLATES
from jaxvib.machine.numbers.named import numbers_of, put_numbers
from jaxvib.machine.rewrite import rewrite_scene

CHANGES = [("stiffness", (1.1, 0.7)), ("mass", (1.01, 2.0))]


ALL = {**TEMPLATES, **SCREENS}


@pytest.mark.parametrize("kind", ALL)
def test_unchanged_scene_keeps_its_text(kind):
    assert rewrite_scene(ALL[kind], jv.scene_from_toml(ALL[kind])) == ALL[kind]


@pytest.mark.parametrize("kind", SCREENS)
def test_screens_keep_comments_if_all_numbers_change(kind):
    scene = jv.scene_from_toml(SCREENS[kind])
    found = [each for each in numbers_of(scene).values() if not each.name.startswith("effects")]
    values = np.concatenate([1.01 * np.asarray(each.read(scene)) + 0.01 * ("angle" in each.name) for each in found])
    changed = put_numbers(scene, found, values)
    text = rewrite_scene(SCREENS[kind], changed)
    again = jv.scene_from_toml(text)
    np.testing.assert_allclose(np.concatenate([each.read(again) for each in found]), values, rtol=1e-7)
    assert text.count("angle = 0.01  # was 0, the default") == 2 and 'rpm"  # was "' in text
    assert all(line in text.splitlines() for line in SCREENS[kind].splitlines() if line.startswith("#"))


def test_inline_tables_keep_their_units():
    source = """
machine = { kind = "one_mass", mass = 200.0, stiffness = "800 N/mm", damping = 600.0 }

[[exciters]]  # one
unbalance = "0.2 kg m"
drive = { kind = "dc_motor", speed = "1500 rpm", stall_torque = 12.0, inertia = 0.1 }
"""
    scene = jv.scene_from_toml(source.replace("1500 rpm", "1200 rpm").replace("0.2 kg", "0.3 kg"))
    text = rewrite_scene(source, scene)
    assert (
        'drive = { kind = "dc_motor", speed = "1200 rpm", stall_torque = 12, inertia = 0.1 }  # was speed = "1500 rpm"\n'
        in text
    )
    assert 'unbalance = "0.3 kg m"  # was "0.2 kg m"' in text and 'stiffness = "800 N/mm"' in text


def test_a_static_deflection_stays_a_deflection():
    source = TEMPLATES["one_mass"].replace('"50 N/mm"', '"25 mm under 128 kg"')
    scene = jv.scene_from_toml(source)
    stiffer = eqx.tree_at(lambda s: s.machine.stiffness, scene, 1.25 * scene.machine.stiffness)
    assert 'stiffness = "20 mm under 128 kg"  # was "25 mm under 128 kg"; of the support' in rewrite_scene(source, stiffer)


@pytest.mark.parametrize(("name", "factors"), CHANGES)
def test_changed_numbers_are_read_back(name, factors):
    scene = jv.scene_from_toml(TEMPLATES["two_mass"])
    values = getattr(scene.machine, name) * np.array(factors)
    changed = eqx.tree_at(lambda s: getattr(s.machine, name), scene, values)
    text = rewrite_scene(TEMPLATES["two_mass"], changed)
    again = jv.scene_from_toml(text)
    np.testing.assert_allclose(getattr(again.machine, name), values, rtol=1e-7)
    assert text.count("# was") == 1 and "# number of the platform with the exciter" in text
    assert len(text.splitlines()) == len(TEMPLATES["two_mass"].splitlines())


def test_units_of_the_source_stay():
    source = TEMPLATES["two_mass"].replace("[5.0e4, 5.0e4]", '["50 N/mm", 5.0e4]')
    scene = jv.scene_from_toml(source.replace("1500 rpm", "157 rad/s").replace('"50 N/mm", 5.0e4', "44e3, 6e4"))
    text = rewrite_scene(source, scene)
    assert 'stiffness = ["44 N/mm", 60000]  # was ["50 N/mm", 5.0e4]; N/m, of the supports to the foundation' in text
    assert 'speed = "1499.2396 rpm"  # was "1500 rpm"' in text


def test_lists_over_several_lines_become_one_line():
    scene = jv.scene_from_toml(TEMPLATES["two_mass"])
    text = rewrite_scene(jv.scene_to_toml(scene), eqx.tree_at(lambda s: s.machine.stiffness, scene, np.array([5e4, 6e4])))
    assert "stiffness = [50000, 60000]  # was [50000.0, 50000.0]\n" in text and "mass = [\n    120.0,\n" in text


def test_other_effects_give_a_new_file():
    scene = jv.scene_from_toml(TEMPLATES["one_mass"])
    shaken = jv.Scene(scene.machine, scene.loads, scene.drive, (jv.Gravity(),))
    assert rewrite_scene(TEMPLATES["one_mass"], shaken) == jv.scene_to_toml(shaken)
