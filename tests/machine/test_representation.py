"""Representation of scenes and their parts."""

import jax
import jax.numpy as jnp
import pytest
from scenes import loads, machines, scene

import jaxvib as jv


def test_numbers_are_shown_with_units():
    machine = jv.one_mass(mass=50.0, stiffness="40 N/mm", damping=100.0)
    assert repr(machine) == "one_mass(mass=[50.0] kg, stiffness=[40000.0] N/m, damping=[100.0] N s/m, exciter=1)"


@pytest.mark.parametrize("machine", machines())
@pytest.mark.parametrize("load", loads())
def test_scene_shows_every_number(machine, load):
    shown = scene(machine, load)
    for number in filter(jnp.size, jax.tree.leaves(shown)):
        assert str(number.tolist()) in repr(shown)


def test_traced_numbers_show_their_shape():
    shown = []
    jax.jit(lambda speed: shown.append(repr(jv.ConstantSpeed(speed))))(60.0)
    assert shown == ["constant_speed(speed=f64[])"]


def test_texts_are_shown_as_python_writes_them():
    assert repr(jv.Gravity(9.8125, along="axis")) == "gravity(g=9.8125 m/s^2, along='axis')"


def test_a_part_with_arrays_has_no_hash():
    with pytest.raises(TypeError, match=r"Scene contains arrays and has no hash.*jv\.scene_to_toml\(scene\)"):
        hash(scene(next(iter(machines())), next(iter(loads()))))
