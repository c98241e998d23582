"""Numbers of scenes by name: where they stand, what a designer calls them, in which unit they are shown."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs.golden import scenes as golden_scenes
from rotors import machine as rotor_machine
from scenes import BALLS, machines, scene
from scenes import ROTOR as ROTOR_NUMBERS

import jaxvib as jv
from jaxvib.display import shown_unit
from jaxvib.machine.files import EFFECTS, SCREENS, SECTIONS
from jaxvib.machine.numbers import number_specs
from jaxvib.machine.numbers.named import find_number, numbers_of, put_numbers, read_value
from jaxvib.report.arguments import GROUPS, arguments_of, part_of
from jaxvib.sweeps.axes import axis_of
from optimize import DesignSpace


@pytest.mark.parametrize(
    ("unit", "size", "shown", "factor"),
    [
        ("N/m", 1e3, "N/mm", 1e-3),
        ("N/m", 999.0, "N/m", 1.0),
        ("m", 0.5, "mm", 1e3),
        ("meter", 1e-5, "mm", 1e3),
        ("m", 9e-6, "um", 1e6),
        ("m", 1.0, "m", 1.0),
        ("m", 0.0, "m", 1.0),
        ("rad/s", 3.0, "rpm", 30.0 / np.pi),
        ("rad", 3.0, "deg", 180.0 / np.pi),
        ("kg", 0.5, "g", 1e3),
        ("kg", 1.0, "kg", 1.0),
        ("kg", 0.0, "kg", 1.0),
        ("N", 1e4, "kN", 1e-3),
        ("N", 9999.0, "N", 1.0),
        ("s", 0.5, "s", 1.0),
        ("", 1e9, "", 1.0),
    ],
)
def test_values_are_shown_in_units_that_a_designer_reads(unit, size, shown, factor):
    assert shown_unit(unit, size) == (shown, factor)


ONE, THREE = scene("one_mass", "rollers", effects=(jv.StaticImbalance(0.02),)), scene("three_mass", "pendulums")
SCREEN = jv.scene_from_toml(SCREENS["linear_screen"])
ROTOR = jv.Scene(rotor_machine(0.1), jv.balls(count=2, mass=0.2, radius=0.08, drag=5.0), jv.ConstantSpeed(460.0))


@pytest.mark.parametrize(
    ("of", "name", "words"),
    [
        (ONE, "machine.stiffness", ["stiffness of the support"]),
        (ONE, "machine.mass", ["mass of the platform"]),
        (ONE, "loads.mass", ["mass of each roller"]),
        (ONE, "loads.radius", ["track radius of each roller"]),
        (ONE, "drive.speed", ["rotor speed"]),
        (ONE, "effects.static_imbalance.moment", ["imbalance of the rotor"]),
        (THREE, "machine.damping", [f"damping of support {k}" for k in (1, 2, 3)]),
        (THREE, "machine.mass[1]", ["mass of platform 2"]),
        (THREE, "machine.link_damping", ["damping of link 1-2", "damping of link 1-3", "damping of link 2-3"]),
        (THREE, "loads.drag[2]", ["drag of pendulum 3"]),
        (THREE, "loads.inertia", ["moment of inertia of each pendulum"]),
        (ROTOR, "machine.mass", ["mass of the rotor"]),
        (ROTOR, "machine.stiffness[1]", ["stiffness of support 2"]),
        (ROTOR, "loads.drag", ["drag of each ball"]),
        (SCREEN, "machine.supports[1].stiffness[1]", ["stiffness of support 2 along its axis"]),
        (SCREEN, "exciters[1].at[0]", ["x of the position of exciter 2"]),
        (SCREEN, "exciters[1].unbalance", ["unbalance of the rotor (exciter 2)"]),
        (SCREEN, "machine.supports[0].at[1]", ["y of the position of support 1"]),
    ],
)
def test_what_a_designer_calls_numbers(of, name, words):
    assert find_number(of, name, "free").words(of) == words


def test_numbers_are_read_and_put():
    whole, entry = find_number(THREE, "machine.stiffness", "free"), find_number(THREE, "machine.stiffness[1]", "free")
    assert (whole.size, entry.size, whole.unit) == (3, 1, "N/m")
    assert entry.entries < whole.entries and len(whole.entries) == 3
    np.testing.assert_array_equal(whole.read(THREE), THREE.machine.stiffness)
    np.testing.assert_array_equal(entry.read(THREE), THREE.machine.stiffness[1:2])
    np.testing.assert_array_equal(put_numbers(THREE, (entry,), jnp.array([7.0])).machine.stiffness, [1e4, 7.0, 3e3])
    both = put_numbers(THREE, (whole, entry), jnp.array([7.0, 8.0, 9.0, 5.0]))
    np.testing.assert_array_equal(both.machine.stiffness, [7.0, 5.0, 9.0])


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("machine.stiffness[3]", "does not exist; machine.stiffness has 3 entries, counted from 0"),
        ("drive.speed[0]", "does not exist; drive.speed has 1 entries"),
        ("machine.stifness", "is not a parameter of this scene; did you mean 'machine.stiffness'"),
        ("machine.stiffness[-1]", "is not a parameter of this scene"),
        ("machine.kind", "is 'three_mass', which is not a continuous number"),
        ("loads.count", "is 4, which is not a continuous number"),
        ("loads.ball_radius", "is not set in this scene; did you mean"),
        (3, "is not the name of a parameter"),
    ],
)
def test_wrong_names_of_numbers_are_refused(name, says):
    with pytest.raises(jv.InputError) as error:
        find_number(THREE, name, "free")
    assert str(error.value).startswith(f"free.{name} {says}"), str(error.value)


def test_arrays_whose_entries_have_names_list_them():
    with pytest.raises(jv.InputError) as error:
        find_number(SCREEN, "machine.supports[0].stiffness", "free")
    entries = "machine.supports[0].stiffness[0], machine.supports[0].stiffness[1]"
    assert (
        str(error.value)
        == f"free.machine.supports[0].stiffness has entries with names of their own; give one of them: {entries}"
    )


def test_values_of_names_have_their_unit_and_range():
    assert read_value("machine.stiffness[1]", "2 N/mm") == 2e3
    assert read_value("drive.speed", "30 rpm") == pytest.approx(np.pi)
    assert read_value("effects.static_imbalance.moment", 0.5) == 0.5 and read_value("machine.damping", 0.0) == 0.0
    assert (
        read_value("machine.stiffness_terms[2]", "3 N m") == 3.0
        and read_value("effects.cubic_support[1].stiffness", -1.0) == -1.0
    )
    for name in ("machine.bodies[1].mass", "machine.supports[0].stiffness[1]", "exciters[0].drive.motor.inertia"):
        assert read_value(name, 2.0) == 2.0
    for name, value in (
        ("machine.mass", 0.0),
        ("machine.damping", -1.0),
        ("machine.nothing", 1.0),
        ("loads.mass", "1 m"),
        ("drive.breakdown_slip", 1.0),
        ("machine.stiffness_terms[3]", 1.0),
        ("effects.static_imbalance.gap", 1.0),
    ):
        with pytest.raises(jv.InputError):
            read_value(name, value)


def every_scene():
    """The golden scenes, which have every part, and what their parts leave out."""
    terms = jv.rotor(**ROTOR_NUMBERS, stiffness_terms=(1e6, 0.0, 3e4), damping_terms=(800.0, 1.0, 20.0))
    sized = jv.balls(**BALLS, ball_radius=0.02)
    supports = (jv.CubicSupport(1e9, position=0.1), jv.Stop(1e6, gap=0.01, position=0.1), jv.Stop(1e6, gap=0.02, position=-0.1))
    speed = jv.ConstantSpeed(120.0)
    return golden_scenes() | {
        "rotor with terms": jv.Scene(terms, sized, speed, supports),
        "restitution": jv.Scene(machines()["one_mass"], sized, speed, (jv.LoadContact(1e5, restitution=0.5),)),
    }


SCENES = every_scene()
PART_CLASSES = {
    **{kind: part_of(build) for section in SECTIONS.values() for kind, build in section.items()},
    **EFFECTS,
}


def single_numbers(of):
    return [one for number in numbers_of(of).values() for one in number.single(of)]


def free_numbers(of):
    """Without the damping of contacts that have a restitution in its place."""
    replaced = any(getattr(effect, "restitution", None) is not None for effect in of.all_effects)
    return [n for n in single_numbers(of) if not (replaced and n.name == "effects.load_contact.damping")]


def moved(number, of):
    """A value near that of a number, and itself."""
    value = float(number.read(of)[0])
    return value, value * 1.001 if value else 1e-3 * (number.spec.typical or 1.0)


@pytest.mark.parametrize("kind", PART_CLASSES)
def test_every_array_of_a_part_has_a_unit(kind):
    known = [(f.name, str(f.type)) for f in dataclasses.fields(PART_CLASSES[kind])]
    arrays = [name for name, given in known if "Array" in given and "AbstractVar" not in given]  # abstract ones are properties
    specs = number_specs(PART_CLASSES[kind])
    assert list(specs) == arrays
    assert all(spec.bounds.low == 0.0 or spec.typical for spec in specs.values())


@pytest.mark.parametrize("name", SCENES)
def test_every_number_of_a_scene_has_one_name(name):
    of = SCENES[name]
    every = single_numbers(of)
    assert len(every) == sum(np.size(leaf) for leaf in jax.tree.leaves(of)) == len({next(iter(one.entries)) for one in every})
    for number in every:
        found = find_number(of, number.name, "free")
        assert found == number and len(found.words(of)) == 1 and "{" not in found.words(of)[0]


@pytest.mark.parametrize("name", SCENES)
def test_every_number_is_changed_by_its_name_alone(name):
    of = SCENES[name]
    every = single_numbers(of)
    before = np.concatenate([number.read(of) for number in every])
    for k, number in enumerate(every):
        value, new = moved(number, of)
        after = put_numbers(of, (number,), jnp.asarray([new]))
        expected = before.copy()
        expected[k] = new
        np.testing.assert_array_equal(np.concatenate([one.read(after) for one in every]), expected)
        assert jax.tree.structure(after) == jax.tree.structure(of) and value == before[k]


@pytest.mark.parametrize("name", SCENES)
def test_every_number_stands_in_the_scene_file(name):
    of = SCENES[name]
    for number in free_numbers(of):
        after = put_numbers(of, (number,), jnp.asarray([moved(number, of)[1]]))
        again = jv.scene_from_toml(jv.scene_to_toml(after))
        np.testing.assert_array_equal(number.read(again), number.read(after))


@pytest.mark.parametrize("name", SCENES)
def test_every_number_is_swept_and_freed(name):
    of = SCENES[name]
    for number in free_numbers(of):
        low, high = sorted(moved(number, of))
        axis = axis_of(of, number.name, [low, high])
        assert axis.unit == number.unit and axis.values.tolist() == [low, high]
        space = DesignSpace(of, {number.name: (low, high)})
        np.testing.assert_allclose(number.read(space.at(jnp.array([0.5]))), [0.5 * (low + high)], rtol=1e-12)
        with pytest.raises(jv.InputError, match="give the bounds as"):
            DesignSpace(of, {number.name: None})
        if number.spec.bounds.low == 0.0:
            with pytest.raises(jv.InputError, match="is -1"):
                DesignSpace(of, {number.name: (-1.0, 1.0)})
            with pytest.raises(jv.InputError, match="is -1"):
                axis_of(of, number.name, [-1.0])


def test_described_units_and_bounds_are_those_of_fields():
    for kinds in GROUPS.values():
        for build in kinds.values():
            for argument in arguments_of(build):
                spec = number_specs(part_of(build)).get(argument.name)
                assert (argument.unit, argument.bounds) == (spec.unit, spec.bounds.words) if spec else argument.unit == ""


def test_zero_is_absent_only_where_it_means_that():
    middle = rotor_machine(stations=(0.0, 0.1), stiffness=(0.0, 5e5))
    of = jv.Scene(middle, jv.balls(count=2, mass=0.2, radius=0.08, drag=[0.0, 5.0]), jv.ConstantSpeed(460.0))
    sizes = {
        name: DesignSpace(of, {name: bounds}).size
        for name, bounds in (("machine.stations", (-0.1, 0.1)), ("machine.stiffness", (1e5, 1e6)), ("loads.drag", (1.0, 9.0)))
    }
    assert sizes == {"machine.stations": 2, "machine.stiffness": 1, "loads.drag": 1}


class Bare(jv.Motor):
    """A motor whose fields have no metadata."""

    speed: jax.Array
    stall_torque: jax.Array
    inertia: jax.Array
    kind: str = eqx.field(static=True, default="bare", kw_only=True)

    def torque(self, speed):
        return self.stall_torque * (1.0 - speed / self.speed)


def test_numbers_of_own_parts_are_named_without_metadata():
    values = dict(speed=160.0, stall_torque=3.0, inertia=0.02)
    motor = Bare(**{name: jnp.asarray(value) for name, value in values.items()})
    of = jv.Scene(machines()["two_mass"], jv.balls(**BALLS), motor)
    torque = find_number(of, "drive.stall_torque", "axes")
    assert torque.unit == "" and torque.words(of) == ["stall torque"]
    assert float(put_numbers(of, (torque,), jnp.array([4.0])).drive.stall_torque) == 4.0


def test_entries_of_a_matrix_are_numbered_row_by_row():
    machine = jv.from_matrices(np.eye(2), 0.1 * np.eye(2), np.array([[3.0, -1.0], [-1.0, 2.0]]), places=[[0]])
    of = jv.Scene(machine, jv.balls(**BALLS), jv.ConstantSpeed(100.0))
    entry = find_number(of, "machine.stiffness[2]", "unknown")
    assert float(entry.read(of)[0]) == -1.0
    changed = put_numbers(of, (entry,), np.array([-0.5])).machine.stiffness
    np.testing.assert_array_equal(changed, [[3.0, -1.0], [-0.5, 2.0]])
