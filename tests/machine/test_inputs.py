"""Messages about invalid machines, loads, drives and effects."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import BALLS, ROTOR, TWO_MASS, scene

import jaxvib as jv


def machine(**changed):
    return jv.two_mass(**{**TWO_MASS, **changed})


def balls(**changed):
    return jv.balls(**{**BALLS, **changed})


WRONG = {
    "wrong unit": (lambda: machine(link_stiffness="3 kg"), "machine.link_stiffness is '3 kg', which is not in N/m; write for"),
    "wrong unit in a list": (lambda: machine(mass=(1.0, "3 s")), "machine.mass[1] is '3 s', which is not in kg; write for"),
    "unknown unit": (lambda: machine(link_damping="3 foo"), "machine.link_damping is '3 foo', which is not in N s/m"),
    "no number": (lambda: machine(link_damping="heavy"), "machine.link_damping is 'heavy', which is not in N s/m"),
    "empty text": (lambda: machine(link_damping=""), "machine.link_damping is '', which is not in N s/m"),
    "negative mass": (lambda: machine(mass=(120.0, -1.0)), "machine.mass[1] is -1 kg; it must be greater than 0"),
    "no mass": (lambda: machine(mass=(0.0, 1.0)), "machine.mass[0] is 0 kg; it must be greater than 0"),
    "negative stiffness": (lambda: machine(stiffness=(-5.0, 1.0)), "machine.stiffness[0] is -5 N/m; it must be at least 0"),
    "negative damping": (lambda: machine(link_damping=-5.0), "machine.link_damping is -5 N s/m; it must be at least 0"),
    "not finite": (lambda: machine(link_damping=float("nan")), "machine.link_damping is nan N s/m; a finite number is needed"),
    "infinite": (lambda: machine(mass=(float("inf"), 1.0)), "machine.mass[0] is inf kg; a finite number is needed"),
    "too many": (lambda: machine(mass=(1.0, 2.0, 3.0)), "machine.mass has 3 values; 2 are needed"),
    "an array too long": (lambda: machine(mass=np.ones(3)), "machine.mass has shape (3,); (2,) is needed"),
    "a list in a list": (lambda: machine(mass=((1.0, 2.0), 3.0)), "machine.mass[0] is not a single number"),
    "nothing": (lambda: machine(mass=None), "machine.mass is None, which is not a number; write a number in kg"),
    "true": (lambda: machine(link_damping=True), "machine.link_damping is True, which is not a number"),
    "exciter": (lambda: machine(exciter=3), "machine.exciter is 3; the machine has platforms 1 to 2"),
    "no exciter": (lambda: machine(exciter=0), "machine.exciter is 0; it must be a whole number, at least 1"),
    "one mass, two values": (
        lambda: jv.one_mass(mass=[1.0, 2.0], stiffness=1.0, damping=1.0),
        "machine.mass has 2 values; 1 is needed; equal parts side by side are written as '2 x 100 kg'",
    ),
    "two springs of a rotor without tilt": (
        lambda: jv.planar_rotor(mass=37.0, stiffness=["150 N/mm", "180 N/mm"], damping=800.0),
        "machine.stiffness is a list of 2 values; for the horizontal and the vertical direction write stiffness = '150 N/mm', "
        "stiffness_up = '180 N/mm'; two equal supports: '2 x 150 N/mm'",
    ),
    "two dampers of a rotor without tilt": (
        lambda: jv.planar_rotor(mass=37.0, stiffness=1e5, damping=("5 %", "6 %")),
        "machine.damping is a list of 2 values; for the horizontal and the vertical direction write damping = '5 %'",
    ),
    "no platform": (lambda: jv.network(mass=[], stiffness=[], damping=[], exciter=1), "machine.mass is an empty list"),
    "a link to nowhere": (
        lambda: jv.network(
            mass=[1, 1], stiffness=1, damping=1, links=[(1, 3)], link_stiffness=[1], link_damping=[1], exciter=1
        ),
        "machine.links[0] is [1, 3]; a link joins two different platforms of 1 to 2",
    ),
    "a link of three": (
        lambda: jv.network(mass=[1, 1], stiffness=1, damping=1, links=[(1, 2, 1)], exciter=1),
        "machine.links[0] is (1, 2, 1); a link is a pair of platforms such as [1, 2]",
    ),
    "stiffness of no link": (
        lambda: jv.network(mass=[1, 1], stiffness=1, damping=1, link_stiffness=[1e3], link_damping=[1.0], exciter=1),
        "machine.link_stiffness has 1 value, but the machine has no links",
    ),
    "links that are no list": (
        lambda: jv.network(mass=[1, 1], stiffness=1, damping=1, links=3, exciter=1),
        "machine.links is 3; it must be a list of pairs of platforms such as [[1, 2]]",
    ),
    "no loads": (lambda: balls(count=0), "loads.count is 0; it must be a whole number, at least 1"),
    "half a load": (lambda: balls(count=1.5), "loads.count is 1.5; it must be a whole number, at least 1"),
    "negative load": (lambda: balls(mass=-0.1), "loads.mass is -0.1 kg; it must be greater than 0"),
    "negative drag": (lambda: balls(drag="-1 N s/m"), "loads.drag is -1 N s/m; it must be at least 0"),
    "masses of two of three": (lambda: balls(mass=[1.0, 2.0]), "loads.mass has 2 values; 3 are needed"),
    "no speed": (lambda: jv.ConstantSpeed(0.0), "drive.speed is 0 rad/s; it must be greater than 0"),
    "speed in kg": (lambda: jv.ConstantSpeed("5 kg"), "drive.speed is '5 kg', which is not in rad/s; write for example"),
    "no duration": (lambda: jv.SpinUp(5.0, 0.0), "drive.duration is 0 s; it must be greater than 0"),
    "gravity in kg": (lambda: jv.Gravity("9.81 kg"), "effects.gravity.g is '9.81 kg', which is not in m/s^2"),
    "no machine": (lambda: jv.Scene(3, balls(), jv.ConstantSpeed(1.0)), "machine is 3; it must be a Machine, for example"),
    "no drive": (lambda: jv.Scene(machine(), balls(), 5.0), "drive is 5.0; it must be a Drive, for example ConstantSpeed("),
    "no exciters": (lambda: jv.Scene(machine()), "exciters are missing; give exciters=[Exciter(drive=Const"),
    "exciters as loads": (
        lambda: jv.Scene(machine(), []),
        "loads is [], which is not of the type Loads; give exciters=[Exciter(drive=",
    ),
    "a regime as vibration": (
        lambda: jv.vibration_measures(scene(), 3),
        "motion is 3; it must be a Jam or a PhaseJam or an Orbit or a Vibration, for example regime.vibration()",
    ),
    "bearings of balls": (
        lambda: scene(effects=(jv.DryFriction(0.1, 0.01),)),
        "effects.dry_friction needs loads with bearings, and a ball has none (property has_bearing); use pendulums",
    ),
    "no effect": (lambda: scene(effects=(5,)), "effects[0] is 5; it must be an Effect, for example Gravity()"),
    "twice": (lambda: scene(effects=(jv.Gravity(), jv.Gravity())), "effects contains gravity 2 times; it is allowed once"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_sentence(case):
    build, sentence = WRONG[case]
    with pytest.raises(jv.InputError) as error:
        build()
    text = str(error.value)
    assert text.startswith(sentence), text
    assert "\n" not in text and text.startswith(error.value.field)


def test_overflow_in_single_precision_is_not_finite():
    with jax.enable_x64(False), pytest.raises(jv.InputError, match=r"loads\.drag is inf N s/m; a finite number is needed"):
        balls(drag=1e300)


def test_dimensionless_forms_refuse_what_cannot_be():
    numbers_ = dict(natural=(0.3, 0.3), damping=0.01, link_natural=0.6, link_damping=0.01, rho=1.0)
    numbers_ |= dict(eps=1e-3, beta=1.0, speed=3.0)
    for changed, sentence in (
        (dict(form="other"), "form is 'other'; it must be 'antiphase' or 'criterion'"),
        (dict(natural=(1.0,) * 4), "natural has 4 values; the machines of these papers have 1, 2 or 3 platforms"),
        (dict(natural=(0.3, -0.3)), "natural[1] is -0.3; it must be at least 0"),
        (dict(eps=0.0), "eps is 0; it must be greater than 0"),
        (dict(rho=-1.0), "rho is -1; it must be greater than 0"),
        (dict(eps=0.5, count=3), "1 - (mass of all loads)/M2S (from eps, kappa and count) is -0.5; it must be greater than 0"),
        (dict(kappa=0.5), "kappa is 0.5; it must be at least 1"),
    ):
        with pytest.raises(jv.InputError) as error:
            jv.Dimensionless(**{"form": "antiphase", **numbers_, **changed})
        assert str(error.value) == sentence


def test_terms_may_come_as_an_array():
    machine_ = jv.rotor(**ROTOR, stiffness_terms=jnp.asarray([1e6, 1e4, 3e4]))
    np.testing.assert_array_equal(machine_.stiffness_terms, [1e6, 1e4, 3e4])


def test_coordinates_have_units():
    assert jv.rotor(**ROTOR).structure().units == ("m", "m", "rad", "rad")
    assert two().structure().units == two().carrier().units == ("m", "m")


def rotor_scene(machine_=None, drive=None, effects=(), count=4):
    machine_ = jv.rotor(**ROTOR, stations=[0.2, 0.1, -0.1, -0.2]) if machine_ is None else machine_
    loads_ = jv.pendulums(count=count, mass=0.05, radius=0.08, drag=0.1)
    return jv.Scene(machine_, loads_, jv.ConstantSpeed(460.0) if drive is None else drive, effects)


def motor(slip=0.2, inertia=0.01):
    return jv.InductionMotor(300.0, breakdown_torque=1.0, breakdown_slip=slip, inertia=inertia)


def two():
    return jv.two_mass(**TWO_MASS)


def contact():
    return (jv.LoadContact(stiffness=1e5),)


WRONG_ROTORS = {
    "stations of other loads": (lambda: rotor_scene(count=3), r"machine\.stations has 4 values; one for all loads or 3"),
    "slip": (lambda: motor(slip=1.2), r"drive\.breakdown_slip is 1\.2; it must be greater than 0 and less than 1"),
    "no inertia": (lambda: motor(inertia=0.0), r"drive\.inertia is 0 kg m\^2; it must be greater than 0"),
    "terms": (lambda: jv.rotor(**ROTOR, stiffness_terms=(1.0, 2.0)), r"machine\.stiffness_terms has 2 values; 3 are needed"),
    "one term": (
        lambda: jv.rotor(**ROTOR, stiffness_terms=5),
        r"machine\.stiffness_terms is 5; it must be a list of 3 numbers, in N/m, N, N m",
    ),
    "terms in words": (lambda: jv.rotor(**ROTOR, damping_terms="5 N s/m"), r"damping_terms is '5 N s/m'; it must be a list"),
    "terms in a table": (lambda: jv.rotor(**ROTOR, damping_terms={"a": 1}), r"damping_terms is {'a': 1}; it must be a list"),
    "a term in words": (lambda: jv.rotor(**ROTOR, damping_terms=(8e2, "soft", 1.0)), r"damping_terms\[1\] is 'soft'"),
    "an array of two terms": (
        lambda: jv.rotor(**ROTOR, damping_terms=jnp.ones(2)),
        r"damping_terms has 2 values; 3 are needed",
    ),
    "term's unit": (lambda: jv.rotor(**ROTOR, stiffness_terms=("1 N/m", "2 m", 3.0)), r"stiffness_terms\[1\] is '2 m'"),
    "terms that no supports have": (
        lambda: jv.rotor(**ROTOR, stiffness_terms=(1e6, 2e5, 3e4)),
        r"machine\.stiffness_terms \[1000000\.0, 200000\.0, 30000\.0\] are not the terms of any supports",
    ),
    "negative term": (
        lambda: jv.rotor(**ROTOR, damping_terms=(8e2, 0.0, -1.0)),
        r"damping_terms .* the first and the last must be at least 0",
    ),
    "a polar inertia that no body has": (
        lambda: jv.rotor(**{**ROTOR, "polar_inertia": 0.96}),
        r"machine\.polar_inertia is 0\.96 kg m\^2; it cannot exceed twice the transverse inertia, 0\.958 kg m\^2",
    ),
    "supports at one place": (
        lambda: jv.rotor(**{**ROTOR, "position": 0.165}),
        r"machine\.position puts both supports at 0\.165 m, which leaves the tilt of the rotor without stiffness",
    ),
    "leaning platforms": (lambda: rotor_scene(two(), None, (jv.MomentImbalance(1e-3),)), r"needs a rotor that can tilt"),
    "far platform": (
        lambda: rotor_scene(two(), None, (jv.Stop(1e6, gap=0.0, platform=3),)),
        r"is 3; the machine has platforms 1",
    ),
    "position of platforms": (
        lambda: rotor_scene(two(), None, (jv.Stop(1e6, gap=0.0, position=0.1),)),
        r"is .*0\.1.*; the machine has platforms 1",
    ),
    "platform of a rotor": (lambda: rotor_scene(effects=(jv.CubicSupport(1.0, platform=1),)), r"on a rotor give a position"),
    "both places": (lambda: jv.CubicSupport(1.0, platform=1, position=0.1), r"has both a platform and a position"),
    "side of a ring": (lambda: rotor_scene(effects=(jv.Stop(1.0, 0.0, side="above", position=0.1),)), r"it must be 'both'"),
    "unknown side": (lambda: jv.Stop(1.0, 0.0, side="left"), r"effects\.stop\.side is 'left'; allowed: above, below, both"),
    "reaction": (lambda: jv.DryFriction(0.1, 0.01, reaction="none"), r"is 'none'; allowed: exact, run_up, steady"),
    "pendulums in contact": (lambda: rotor_scene(effects=contact()), r"give balls or rollers their ball_radius"),
    "twice": (lambda: rotor_scene(effects=(jv.Gravity(), jv.Gravity())), r"contains gravity 2 times"),
}


@pytest.mark.parametrize("name", WRONG_ROTORS)
def test_wrong_rotors_motors_and_effects_say_what_is_wrong(name):
    make, message = WRONG_ROTORS[name]
    with pytest.raises(jv.InputError, match=message):
        make()
