"""Dampings that a scene file gives as ratios or loss factors, in designs with other springs and masses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.files import SCREENS, scene_from_toml
from jaxvib.machine.rewrite import rewrite_scene
from optimize import DesignSpace, foundation_force, load_design
from optimize.files import TEMPLATES as DESIGNS
from optimize.synthesize import _table

PARTS = """
[loads]
kind = "ball"
count = 2
mass = 0.8
radius = 0.12
drag = 1.5
[drive]
kind = "constant_speed"
speed = "1500 rpm"
"""
TWO = """[machine]
kind = "two_mass"
mass = [260.0, 210.0]
stiffness = [60e3, 0]
damping = ["3 %", 0]
link_stiffness = 900e3
link_damping = "2 %"
"""
BODY = """[machine]
kind = "plane_body"
mass = 400.0
inertia = 80.0
[[machine.supports]]
at = [1.0, 0.0]
stiffness = [1e5, 3e5]
damping = ["5 % of 250 kg", 70.0]
[[machine.supports]]
at = [-1.0, 0.0]
stiffness = [1e5, 3e5]
damping = "loss factor 0.1 at 16 Hz"
"""
ROTOR = """[machine]
kind = "rotor"
mass = 37.0
transverse_inertia = 0.479
polar_inertia = 0.093
stiffness = [0.6e6, 0.5e6]
damping = ["6 %", 420.0]
position = [0.165, -0.155]
damping_up = "4 %"
"""
PLANAR = """[machine]
kind = "planar_rotor"
mass = 37.0
stiffness = 6e5
damping = "5 %"
"""
CASES = [
    (TWO, {"machine.stiffness[0]": 3e4, "machine.link_stiffness[0]": 5e5, "machine.mass[1]": 150.0}),
    (TWO, {"machine.mass[0]": 130.0, "machine.mass[1]": 150.0}),
    (BODY, {"machine.supports[0].stiffness[0]": 4e4, "machine.supports[1].stiffness[1]": 7e5}),
    (ROTOR, {"machine.stiffness[1]": 2e5, "machine.mass": 50.0}),
    (PLANAR, {"machine.stiffness": 9e5}),
    (PLANAR.replace("planar_rotor", "one_mass").replace("5 %", "loss factor 0.1 at 16 Hz"), {"machine.stiffness[0]": 9e5}),
]


def write(folder, machine, more, quantity='quantity = "foundation_force"\nmode = 1'):
    (folder / "machine.toml").write_text(machine + PARTS)
    (folder / "design.toml").write_text(f'scene = "machine.toml"\n{more}\n[objective]\n{quantity}\n')
    return load_design(folder / "design.toml").space


def free_table(names):
    return "[free]\n" + "\n".join(f'"{name}" = [{0.2 * value}, {3.0 * value}]' for name, value in names.items())


@pytest.mark.parametrize(("machine", "values"), CASES)
def test_dampings_keep_the_ratios_of_the_file(tmp_path, machine, values):
    space = write(tmp_path, machine, free_table(values))
    found = jax.jit(lambda x: space.scene_of(x))(jnp.array(list(values.values())))
    text = rewrite_scene(machine + PARTS, found)  # the file with the new springs and masses
    for line in machine.splitlines():
        if "damping =" in line and '"' in line:
            assert line in text.splitlines()
    for one, other in zip(jax.tree.leaves(scene_from_toml(text).machine), jax.tree.leaves(found.machine), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7)


def test_ratios_of_a_two_mass_machine_stay(tmp_path):
    space = write(tmp_path, TWO, free_table(CASES[0][1]))
    found = space.scene_of(jnp.array([3e4, 5e5, 150.0])).machine
    np.testing.assert_allclose(found.damping, [0.06 * np.sqrt(3e4 * 260.0), 0.0], rtol=1e-12)
    np.testing.assert_allclose(found.link_damping, [0.04 * np.sqrt(5e5 * 260.0 * 150.0 / 410.0)], rtol=1e-12)
    rows = _table(space, space.scene_of(jnp.array([3e4, 5e5, 150.0])), [], np.zeros((2, 0)), ([], []))
    assert [row.what for row in rows[3:]] == ["damping of support 1 (3 %)", "damping of link 1-2 (2 %)"]


def test_derivatives_pass_through_the_ratios(tmp_path):
    space = write(tmp_path, TWO, free_table(CASES[0][1]))
    force, at = foundation_force(mode=3), jnp.array([3e4, 5e5, 150.0])
    slopes = jax.grad(lambda x: force(space.scene_of(x)))(at)
    for k, step in enumerate(1e-5 * at):
        two = [float(force(space.scene_of(at.at[k].add(sign * step)))) for sign in (1.0, -1.0)]
        np.testing.assert_allclose(slopes[k], (two[0] - two[1]) / (2.0 * step), rtol=1e-5)


def test_only_dampings_that_change_follow(tmp_path):
    link = {"machine.link_stiffness": 5e5}
    assert [tie.target.name for tie in write(tmp_path, TWO, free_table(link)).ties] == ["machine.link_damping[0]"]
    assert write(tmp_path, TWO, free_table({"loads.drag": 2.0})).ties == ()
    assert write(tmp_path, TWO, free_table({**link, "machine.link_damping": 500.0})).ties == ()
    tied = write(tmp_path, TWO, free_table(link) + '\n[ties]\n"machine.link_damping" = ["machine.link_stiffness", "keep"]')
    assert [tie.mark for tie in tied.ties] == ["tied"]
    half = '\n[ties]\n"machine.stiffness[0]" = ["machine.link_stiffness[0]", "keep"]'
    both = write(tmp_path, TWO, free_table(link) + half).scene_of(jnp.array([4.5e5])).machine
    np.testing.assert_allclose(both.damping[0], 0.06 * np.sqrt(3e4 * 260.0), rtol=1e-12)


def test_recipes_keep_the_ratios_of_the_file(tmp_path):
    springs = SCREENS["feeder"].replace("damping = [300.0, 400.0]", 'damping = "5 % of 250 kg"')
    (tmp_path / "feeder.toml").write_text(springs)
    (tmp_path / "design.toml").write_text(DESIGNS["feeder-design"])
    space = load_design(tmp_path / "design.toml").space
    for support in space.at(jnp.full(space.size, 0.8)).machine.supports:
        np.testing.assert_allclose(support.damping, 0.1 * np.sqrt(support.stiffness * 250.0), rtol=1e-12)


def test_a_tie_states_a_ratio():
    scene = scene_from_toml(TWO + PARTS)
    space = DesignSpace(scene, {"machine.stiffness[0]": (1e4, 9e4)}, ties={"machine.damping": "5 %"})
    np.testing.assert_allclose(space.at(jnp.array([0.5])).machine.damping, [0.1 * np.sqrt(5e4 * 260.0), 0.0], rtol=1e-12)
    for name, text, says in (
        ("loads.drag", "5 %", r"^ties\.loads\.drag is '5 %', which only a damping of the machine"),
        ("machine.damping[1]", "5 %", r"^ties\.machine\.damping\[1\] is '5 %' of a spring without stiffness"),
        ("machine.damping[0]", "5 per %", r"^ties\.machine\.damping\[0\] is '5 per %'; write a damping as"),
    ):
        with pytest.raises(jv.InputError, match=says):
            DesignSpace(scene, {"machine.stiffness[0]": (1e4, 9e4)}, ties={name: text})
