"""Names of parameters of scenes, and the keys of scene files: they are the same."""

import tomllib

import numpy as np
import pytest
from programs.golden import scenes as golden_scenes
from programs.golden import scenes_of_exciters
from scenes import BALLS, ROTOR, machines

import jaxvib as jv
from jaxvib.machine.files import DRIVES, EFFECTS, LOADS, MACHINES, SCREENS, TEMPLATES
from jaxvib.machine.numbers.named import find_number, numbers_of, read_value, spec_of
from optimize import DesignSpace

MOTOR = jv.DCMotor("1500 rpm", stall_torque=20.0, inertia=0.2)
WINDING = {"stator_resistance": 0.2, "rotor_resistance": 0.2, "stator_leakage": 0.002, "rotor_leakage": 0.002}
SUPPORTS = [jv.support(at=(x, -0.1), stiffness=(1e5, 2e5), damping=(100.0, 200.0)) for x in (-0.5, 0.5)]
JOINT = jv.support(at=(0.5, 0.1), stiffness=(1e5, 2e5), damping=(9.0, 8.0), angle=0.2, to=1, at_other=(-0.5, 0.1))


def shaft(**more):
    """A rotor with an exciter at a distance along its axis."""
    loads = jv.balls(count=1, mass=0.2, radius=0.1, drag=1.0, ball_radius=0.01)
    return jv.Scene(jv.rotor(**{**ROTOR, "stations": (0.1,)}), exciters=[jv.Exciter(loads, jv.ConstantSpeed(120.0), **more)])


def every_scene():
    """Scenes with every machine, load, drive and effect of scene files, with one exciter and with several."""
    network = jv.plane_network([jv.body(mass=100.0, inertia=20.0)] * 2, [*SUPPORTS, JOINT])
    circuit = jv.InductionMotorCircuit(400.0, 314.0, 2, **WINDING, magnetizing_inductance=0.15, inertia=0.2)
    drives = [jv.SwitchedOff(jv.BeltDrive(MOTOR, 1.5, 0.2), at=3.0), circuit]
    exciters = [jv.Exciter(drive=d, unbalance=0.5, unbalance_mass=9.0, at=(0.1, 0.2), body=k) for k, d in enumerate(drives)]
    rotating = [jv.Exciter(jv.balls(**BALLS), MOTOR, at=k, effects=(jv.StaticImbalance(0.01),)) for k in (1, 2)]
    return {
        **{name: jv.scene_from_toml(text) for name, text in {**TEMPLATES, **SCREENS}.items()},
        **golden_scenes(),
        **scenes_of_exciters(),
        "network of bodies": jv.Scene(network, exciters=exciters),
        "effects of exciters": jv.Scene(machines()["two_mass"], exciters=rotating, effects=(jv.Stop(1e5, 0.01, platform=1),)),
        "exciter on a shaft": shaft(at=0.05, effects=(jv.StaticImbalance(0.01), jv.MomentImbalance(1e-4))),
    }


SCENES = every_scene()


def keys_of(value, name=""):
    """The numbers of the tables of a file by their keys."""
    if isinstance(value, dict):
        return {key: n for field, each in value.items() for key, n in keys_of(each, f"{name}.{field}".lstrip(".")).items()}
    if isinstance(value, list):
        return {key: number for k, each in enumerate(value) for key, number in keys_of(each, f"{name}[{k}]").items()}
    return {name: value} if isinstance(value, float) else {}


@pytest.mark.parametrize("name", SCENES)
def test_key_in_the_file_is_the_name_of_every_number(name):
    scene = SCENES[name]
    keys = keys_of(tomllib.loads(jv.scene_to_toml(scene)))
    named = {key: find_number(scene, key, "free") for key in keys}
    for key, found in named.items():
        np.testing.assert_array_equal(found.read(scene), [keys[key]])
        assert spec_of(key).unit == found.spec.unit
        if len(scene.exciters) > 1 or not key.startswith("exciters"):
            assert found.name == key or found.size == np.size(found.leaf(scene)) == 1
    every = set().union(*(number.entries for number in numbers_of(scene).values()))
    assert set().union(*(found.entries for found in named.values())) == every


def test_every_part_of_scene_files_is_in_the_scenes():
    kinds = {kind for scene in SCENES.values() for kind in kinds_of(scene)}
    assert kinds >= {*MACHINES, *LOADS, *DRIVES, *EFFECTS}


def kinds_of(scene):
    tables = tomllib.loads(jv.scene_to_toml(scene))

    def found(value):
        if isinstance(value, list):
            return [kind for each in value for kind in found(each)]
        if not isinstance(value, dict):
            return []
        effects = list(value.get("effects", {}))
        return [value.get("kind"), *effects, *(kind for each in value.values() for kind in found(each))]

    return found(tables)


SCREEN = jv.scene_from_toml(SCREENS["linear_screen"])


def test_field_of_the_class_is_also_a_name():
    found = find_number(SCREEN, "exciters[1].position[0]", "free")
    assert found == find_number(SCREEN, "exciters[1].at[0]", "free") and found.name == "exciters[1].at[0]"
    assert DesignSpace(SCREEN, {"exciters[1].position": (0.1, 2.0)}).free[0].name == "exciters[1].at"
    assert read_value("exciters[1].at[0]", "20 mm") == read_value("exciters[1].position[0]", "20 mm") == 0.02
    with pytest.raises(jv.InputError, match=r"did you mean 'exciters\[1\]\.at'"):
        find_number(SCREEN, "exciters[1].att", "free")


def test_single_table_of_a_list_needs_no_number():
    scene = SCENES["effects of exciters"]
    assert find_number(scene, "effects.stop.gap", "free") == find_number(scene, "effects.stop[0].gap", "free")
    two = jv.Scene(scene.machine, exciters=scene.exciters, effects=(*scene.effects, jv.Stop(1e5, 0.01, platform=2)))
    with pytest.raises(jv.InputError, match="is not a parameter of this scene"):
        find_number(two, "effects.stop.gap", "free")
