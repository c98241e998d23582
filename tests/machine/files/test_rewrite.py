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
        'drive = { kind = "dc_motor", speed = "1200 rpm", stall_torque = 12.0, inertia = 0.1 }  # was speed = "1500 rpm"\n'
        in text
    )
    assert 'unbalance = "0.3 kg m"  # was "0.2 kg m"' in text and 'stiffness = "800 N/mm"' in text


def test_a_number_with_spaces_between_thousands_is_rewritten():
    source = TEMPLATES["one_mass"].replace('"50 N/mm"', '"5 x 10 000 N/m"')
    scene = jv.scene_from_toml(source)
    stiffer = eqx.tree_at(lambda scene: scene.machine.stiffness, scene, 1.25 * scene.machine.stiffness)
    assert 'stiffness = "5 x 12500 N/m"' in rewrite_scene(source, stiffer)


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


def test_lists_over_several_lines_keep_their_lines():
    scene = jv.scene_from_toml(TEMPLATES["two_mass"])
    text = rewrite_scene(jv.scene_to_toml(scene), eqx.tree_at(lambda s: s.machine.stiffness, scene, np.array([5e4, 6e4])))
    assert "stiffness = [\n    50000.0,\n    60000,  # was 50000.0\n]" in text and "mass = [\n    120.0,\n" in text


HEAD = """machine = { kind = "one_mass", mass = "200 kg", stiffness = "800 N/mm", damping = "3 %" }  # steel
effects = { gravity = true }
"""
ONE = '{ unbalance = "0.2 kg m", effects.static_imbalance.moment = "72 g m"'
ONE += ', drive = { kind = "constant_speed", speed = "1500 rpm" } }'
TWO = '{ unbalance = "0.3 kg m", effects = { static_imbalance = { moment = "5 kg mm" } }, drive.kind = "constant_speed"'
TWO += ', drive.speed = "1500 rpm" }'


@pytest.mark.parametrize(
    ("source", "changes", "expected"),
    [
        (  # the index tells the exciters of one line apart
            f"exciters = [{ONE}, {TWO}]",
            [("0.3 kg m", "0.4 kg m")],
            f'exciters = [{ONE}, {TWO.replace("0.3 kg", "0.4 kg")}]  # was exciters[1].unbalance = "0.3 kg m"\n',
        ),
        (
            f'exciters = [  # [two]\n    {ONE},  # "A"\n    {TWO},\n]',
            [("0.2 kg m", "0.1 kg m"), ("1500 rpm", "1200 rpm")],
            "exciters = [  # [two]\n"
            f"    {ONE.replace('0.2 kg', '0.1 kg').replace('1500', '1200')},"
            '  # was exciters[0].unbalance = "0.2 kg m", exciters[0].drive.speed = "1500 rpm"; "A"\n'
            f"    {TWO.replace('1500', '1200')},"
            '  # was exciters[1].drive.speed = "1500 rpm"\n]',
        ),
        (
            f"exciters = [{ONE}, {TWO}]",
            [("72 g m", "36 g m")],
            f"exciters = [{ONE.replace('72 g', '36 g')}, {TWO}]"
            '  # was exciters[0].effects.static_imbalance.moment = "72 g m"\n',
        ),
        (  # a damping ratio is one of the old mass
            f"exciters = [{ONE}, {TWO}]",
            [("200 kg", "50 kg")],
            'mass = "50 kg", stiffness = "800 N/mm", damping = 758.94664 }  # was mass = "200 kg", damping = "3 %"; steel\n',
        ),
        (
            f"exciters = [{ONE}, {TWO}]",
            [('5 kg mm"', '5 kg mm", angle = 0.5')],
            "]  # was exciters[1].effects.static_imbalance.angle = 0, the default\n",
        ),
        (f"exciters = [{ONE}, {TWO}]", [("true", "{ g = 3.71 }")], "gravity = { g = 3.71 } }  # was gravity = true\n"),
    ],
)
def test_only_the_changed_numbers_are_written(source, changes, expected):
    changed = source = HEAD + source + "\n"
    for old, new in changes:
        changed = changed.replace(old, new)
    scene = jv.scene_from_toml(changed)
    if "200 kg" not in changed:  # the damping stays, not its ratio
        scene = eqx.tree_at(lambda each: each.machine.damping, scene, jv.scene_from_toml(source).machine.damping)
    text = rewrite_scene(source, scene)
    assert expected in text
    assert sum(line not in source.splitlines() for line in text.splitlines()) == expected.count("# was")


def test_one_exciter_in_a_list_keeps_its_text():
    source = TEMPLATES["one_mass"].replace("[loads]", "[[exciters]]\n[exciters.loads]").replace("[drive]", "[exciters.drive]")
    source += "[exciters.effects]\nstatic_imbalance = { moment = 0.05 }\n"
    text = rewrite_scene(source, jv.scene_from_toml(source.replace("0.05", "0.04")))
    assert text == source.replace("moment = 0.05 }", "moment = 0.04 }  # was moment = 0.05")


def test_a_mass_of_a_material_stays_if_the_radius_changes():
    source = ALL["ball_balancer"]
    scene = jv.scene_from_toml(source)
    text = rewrite_scene(source, eqx.tree_at(lambda each: each.loads.ball_radius, scene, scene.loads.ball_radius * 1.01))
    assert 'mass = 0.043765946  # was { material = "steel" }; of one ball' in text
    assert 'ball_radius = "11.11 mm"  # was "11 mm"\n' in text


def test_other_effects_give_a_new_file():
    scene = jv.scene_from_toml(TEMPLATES["one_mass"])
    shaken = jv.Scene(scene.machine, scene.loads, scene.drive, (jv.Gravity(),))
    assert rewrite_scene(TEMPLATES["one_mass"], shaken) == jv.scene_to_toml(shaken)
