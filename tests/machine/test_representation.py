"""Representation of scenes and their parts."""

import jax
import numpy as np
import pytest
from scenes import loads, machines, scene

import jaxvib as jv
from jaxvib.machine.files import SCREENS, TEMPLATES


def test_numbers_are_shown_with_units():
    machine = jv.one_mass(mass=50.0, stiffness="40 N/mm", damping=100.0)
    assert repr(machine) == "one_mass(mass=['50 kg'], stiffness=['40 N/mm'], damping=['100 N s/m'], exciter=1)"


@pytest.mark.parametrize("machine", machines())
@pytest.mark.parametrize("load", loads())
def test_scene_is_shown_as_its_file(machine, load):
    shown = scene(machine, load)
    read = jv.scene_from_toml(repr(shown))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9), read, shown)


@pytest.mark.parametrize("template", {**TEMPLATES, **SCREENS})
def test_templates_are_shown_with_units(template):
    shown = jv.scene_from_toml({**TEMPLATES, **SCREENS}[template])
    read = jv.scene_from_toml(repr(shown))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9), read, shown)
    assert ' rpm"' in repr(shown) and "rad/s" not in repr(shown) and "<svg" in shown._repr_html_()


def test_scene_with_a_machine_of_matrices_is_shown():
    machine = jv.from_matrices(mass=[[2.0]], stiffness=[[8e3]], damping=[[1.0]], places=[[0]])
    shown = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed("600 rpm"), unbalance=0.01, at=1)])
    assert repr(shown).startswith("Scene(") and "speed='600 rpm'" in repr(shown)
    assert shown._repr_html_().startswith("<pre>Scene(")


def test_a_number_too_large_for_its_display_unit_is_shown():
    assert repr(jv.ConstantSpeed(1e308)) == "constant_speed(speed=1e+308)"


def test_traced_numbers_show_their_shape():
    shown = []
    jax.jit(lambda speed: shown.append(repr(jv.ConstantSpeed(speed))))(60.0)
    assert shown == ["constant_speed(speed=f64[])"]


def test_texts_are_shown_as_python_writes_them():
    assert repr(jv.Gravity(9.8125, along="axis")) == "gravity(g='9.8125 m/s^2', along='axis')"


def test_a_part_with_arrays_has_no_hash():
    with pytest.raises(TypeError, match=r"Scene contains arrays and has no hash.*jv\.scene_to_toml\(scene\)"):
        hash(scene(next(iter(machines())), next(iter(loads()))))
