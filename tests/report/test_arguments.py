"""Arguments of the parts of scene files, with their units written by hand."""

import re

import pytest

import jaxvib as jv
from jaxvib.report.arguments import GROUPS, arguments_of, builder_of

PLATFORMS = {"mass": "kg", "stiffness": "N/m", "damping": "N s/m"}
LINKED = PLATFORMS | {"link_stiffness": "N/m", "link_damping": "N s/m"}
INERTIA = {"transverse_inertia": "kg m^2", "polar_inertia": "kg m^2"}
TERMS = {"stiffness_terms": "N/m, N, N m", "damping_terms": "N s/m, N s, N m s"}
LOADS = {"mass": "kg", "radius": "m", "drag": "N s/m"}
CIRCUIT = {
    "voltage": "V",
    "frequency": "rad/s",
    "stator_resistance": "ohm",
    "rotor_resistance": "ohm",
    "stator_leakage": "H",
    "rotor_leakage": "H",
    "magnetizing_inductance": "H",
    "inertia": "kg m^2",
}
UP = {"stiffness_up": "N/m", "damping_up": "N s/m"}
UNITS = {
    "machines": {
        "one_mass": PLATFORMS,
        "two_mass": LINKED,
        "three_mass": LINKED,
        "network": LINKED,
        "planar_rotor": PLATFORMS | UP,
        "plane_body": {"mass": "kg", "inertia": "kg m^2"},
        "plane_network": {},
        "rotor": PLATFORMS | UP | INERTIA | TERMS | {"position": "m", "stations": "m"},
    },
    "loads": {
        "ball": LOADS | {"ball_radius": "m"},
        "roller": LOADS | {"ball_radius": "m"},
        "pendulum": LOADS | {"inertia": "kg m^2"},
        "torus_ball": LOADS | {"tube": "m", "ball_radius": "m"},
    },
    "drives": {
        "constant_speed": {"speed": "rad/s"},
        "spin_up": {"speed": "rad/s", "duration": "s"},
        "run_up": {"speed": "rad/s", "acceleration": "rad/s^2"},
        "dc_motor": {"speed": "rad/s", "stall_torque": "N m", "inertia": "kg m^2"},
        "induction_motor": {"speed": "rad/s", "breakdown_torque": "N m", "inertia": "kg m^2"},
        "switched_off": {"at": "s", "bearing": "N m s"},
        "name_plate_motor": {"power": "W", "rated_speed": "rad/s", "inertia": "kg m^2", "frequency": "rad/s"},
        "dc_motor_electrical": {
            "voltage": "V",
            "resistance": "ohm",
            "torque_constant": "N m/A",
            "inertia": "kg m^2",
            "inductance": "H",
        },
        "induction_motor_circuit": CIRCUIT,
        "induction_motor_electrical": CIRCUIT,
        "torque_table": {"speeds": "rad/s", "torques": "N m", "inertia": "kg m^2"},
        "speed_profile": {"times": "s", "speeds": "rad/s"},
        "converter": {},
        "belt_drive": {"shaft_inertia": "kg m^2"},
        "speed_control": {"gain": "N m s", "integral_gain": "N m", "torque_limit": "N m", "inertia": "kg m^2"},
    },
    "effects": {
        "gravity": {"g": "m/s^2"},
        "static_imbalance": {"moment": "kg m", "angle": "rad"},
        "moment_imbalance": {"moment": "kg m^2", "angle": "rad"},
        "dry_friction": {"diameter": "m", "width": "rad/s"},
        "rolling_friction": {"coefficient": "m", "width": "m/s"},
        "cubic_support": {"stiffness": "N/m^3", "position": "m"},
        "stop": {"stiffness": "N/m", "gap": "m", "damping": "N s/m", "position": "m"},
        "friction_support": {"force": "N", "width": "m/s", "position": "m"},
        "load_contact": {"stiffness": "N/m", "damping": "N s/m"},
        "free_spin": {},
        "sliding": {"width": "m/s"},
    },
    "tables": {
        "exciter": {"unbalance": "kg m", "unbalance_mass": "kg"},
        "support": {"at": "m", "stiffness": "N/m", "damping": "N s/m", "angle": "rad", "at_other": "m"},
        "body": {"mass": "kg", "inertia": "kg m^2"},
    },
}


@pytest.mark.parametrize(("group", "kind"), [(group, kind) for group, kinds in UNITS.items() for kind in kinds])
def test_every_number_of_a_part_has_its_unit(group, kind):
    listed = {argument.name: argument.unit for argument in arguments_of(builder_of(group, kind)) if argument.unit}
    assert listed == UNITS[group][kind]


def test_parts_agree_with_the_list():
    assert {group: set(kinds) for group, kinds in GROUPS.items()} == {group: set(kinds) for group, kinds in UNITS.items()}


def test_needed_arguments_have_no_default():
    by_name = {argument.name: argument for argument in arguments_of(builder_of("effects", "stop"))}
    assert [name for name, argument in by_name.items() if argument.needed] == ["stiffness", "gap"]
    assert by_name["side"].default == "both" and by_name["position"].default is None


def test_texts_are_chosen_from_the_allowed_ones():
    allowed = {
        argument.name: argument.allowed
        for kind in ("gravity", "stop", "dry_friction")
        for argument in arguments_of(builder_of("effects", kind))
        if argument.allowed
    }
    assert allowed == {"along": ("up", "axis"), "side": ("above", "below", "both"), "reaction": ("exact", "run_up", "steady")}


@pytest.mark.parametrize(("group", "name", "field"), [("machine", "rotor", "group"), ("machines", "rotors", "name")])
def test_an_unknown_part_is_refused(group, name, field):
    with pytest.raises(jv.InputError, match=rf"^{field} is '.*'; did you mean '(machines|rotor)'"):
        builder_of(group, name)


def test_meanings_begin_with_a_noun():
    """Not with a unit, nor with the rest of a phrase whose noun is the name of the argument."""
    parts = [(kind, argument) for kinds in GROUPS.values() for kind, build in kinds.items() for argument in arguments_of(build)]
    wrong = [
        f"{kind} {argument.name}: {argument.meaning}"
        for kind, argument in parts
        if argument.meaning
        and (re.match("of |about |during ", argument.meaning) or argument.meaning.startswith(argument.unit or "?"))
    ]
    assert wrong == []
