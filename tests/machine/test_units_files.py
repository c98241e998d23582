"""Numbers with units, scene files, and what is said about wrong input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pint
import pytest
from scenes import loads, machines, scene

import jaxvib as jv
from jaxvib.machine.files import TEMPLATES, scene_from_tables
from jaxvib.units import _FACTORS, number, numbers, to_float

TWO_MASS = dict(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0)
BALLS = dict(count=3, mass=0.8, radius=0.12, drag=1.5)


@pytest.mark.parametrize(
    ("given", "unit", "expected"),
    [
        ("1500 rpm", "rad/s", 50 * np.pi),
        ("25 Hz", "rad/s", 50 * np.pi),
        ("0.025 kHz", "rad/s", 50 * np.pi),
        ("157 rad/s", "rad/s", 157.0),
        ("9000 deg/s", "rad/s", 50 * np.pi),
        ("4.4e4 N/m", "N/m", 4.4e4),
        ("44 N/mm", "N/m", 4.4e4),
        ("44 kN/m", "N/m", 4.4e4),
        ("1.5 N s/m", "N s/m", 1.5),
        ("1.5 N*s/m", "N s/m", 1.5),
        ("1.5 kg/s", "N s/m", 1.5),
        ("800 g", "kg", 0.8),
        ("120 mm", "m", 0.12),
        ("2 min", "s", 120.0),
        ("5 kg cm^2", "kg m^2", 5e-4),
        ("4.4e4", "N/m", 4.4e4),
        (44, "N/m", 44.0),
        (np.float32(2.5), "kg", 2.5),
        (jnp.asarray(2.5), "kg", 2.5),
    ],
)
def test_numbers_come_in_any_unit(given, unit, expected):
    value = number(given, unit, "field")
    assert value.shape == () and value.dtype == jnp.float64
    np.testing.assert_allclose(value, expected, rtol=1e-14)


@pytest.mark.parametrize(("unit", "text"), [(unit, text) for unit, known in _FACTORS.items() for text in known])
def test_units_known_by_heart_are_those_of_the_library(unit, text):
    """A quantity goes through the library, a text of a common unit does not."""
    np.testing.assert_allclose(
        to_float(f"3 {text}", unit, "field"),
        to_float(pint.get_application_registry().Quantity(3.0, text), unit, "field"),
        rtol=1e-15,
    )


def test_pint_quantities_come_in():
    units = pint.get_application_registry()
    np.testing.assert_allclose(number(units.Quantity(1500.0, "rpm"), "rad/s", "field"), 50 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(number(units.Quantity(25.0, "Hz"), "rad/s", "field"), 50 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(numbers(units.Quantity([1.0, 2.0], "N/mm"), "N/m", "field", 2), [1e3, 2e3])
    np.testing.assert_allclose(numbers([units.Quantity(1.0, "N/mm"), 5.0], "N/m", "field", 2), [1e3, 5.0])
    with pytest.raises(jv.InputError, match=r"^field is '3.0 kilogram', which is not in N/m"):
        number(units.Quantity(3.0, "kg"), "N/m", "field")


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
        "machine.mass has 2 values; 1 are needed",
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
        "machine.link_stiffness has 1 values; the machine has no links",
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
    "no effect": (lambda: scene(effects=(5,)), "effects[0] is 5; it must be an Effect, for example Gravity()"),
    "twice": (lambda: scene(effects=(jv.Gravity(), jv.Gravity())), "effects names gravity 2 times; once is allowed"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_sentence(case):
    build, sentence = WRONG[case]
    with pytest.raises(jv.InputError) as error:
        build()
    text = str(error.value)
    assert text.startswith(sentence), text
    assert "\n" not in text and text.startswith(error.value.field)


def test_dimensionless_forms_refuse_what_cannot_be():
    numbers_ = dict(natural=(0.3, 0.3), damping=0.01, link_natural=0.6, link_damping=0.01, rho=1.0)
    numbers_ |= dict(eps=1e-3, beta=1.0, speed=3.0)
    for changed, sentence in (
        (dict(form="other"), "form is 'other'; it must be 'antiphase' or 'criterion'"),
        (dict(natural=(1.0,) * 4), "natural has 4 values; the papers' machines have 1, 2 or 3 platforms"),
        (dict(eps=0.0), "eps is 0; it must be greater than 0"),
        (dict(rho=-1.0), "rho is -1; it must be greater than 0"),
        (dict(eps=0.5, count=3), "1 - (mass of all loads)/M2S is -0.5; it must be greater than 0"),
        (dict(kappa=0.5), "kappa is 0.5; it must be at least 1"),
    ):
        with pytest.raises(jv.InputError) as error:
            jv.Dimensionless(**{"form": "antiphase", **numbers_, **changed})
        assert str(error.value) == sentence


# Scene files


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype and x.shape == y.shape
        np.testing.assert_array_equal(x, y)


def uneven(s):
    """Numbers that no short decimal text holds."""
    return jax.tree.map(lambda leaf: leaf * (1.0 + 1.0 / 3.0), s)


@pytest.mark.parametrize("effects", [(), (jv.Gravity(),)], ids=["plain", "gravity"])
@pytest.mark.parametrize("drive", [jv.ConstantSpeed("1500 rpm"), jv.SpinUp("1500 rpm", duration="4 s")], ids=lambda d: d.kind)
@pytest.mark.parametrize("load", loads())
@pytest.mark.parametrize("kind", machines())
def test_scene_file_gives_the_scene_back_bit_for_bit(kind, load, drive, effects, tmp_path):
    s = uneven(jv.Scene(machines()[kind], loads()[load], drive, effects))
    same(jv.scene_from_toml(jv.scene_to_toml(s)), s)
    same(jv.load_scene(jv.save_scene(s, tmp_path / "scene.toml")), s)


def test_one_platform_one_load_and_no_links_survive_the_file():
    machine_ = jv.network(mass=[2.0], stiffness=[3.0], damping=[0.1], exciter=1)
    s = jv.Scene(machine_, jv.balls(count=1, mass=[0.1], radius=0.1, drag=[0.2]), jv.ConstantSpeed(3.0))
    same(jv.scene_from_toml(jv.scene_to_toml(s)), s)


@pytest.mark.parametrize("kind", TEMPLATES)
def test_template_loads_and_jams(kind):
    s = jv.scene_from_toml(TEMPLATES[kind])
    assert s.machine.kind == kind
    if "rotor" in kind:
        assert s.loads.count == 4 and [e.kind for e in s.effects] == ["gravity", "static_imbalance"]
        np.testing.assert_allclose(s.loads.mass, 0.05)
    else:
        assert s.loads.count == 3 and s.effects == ()
        np.testing.assert_allclose(s.loads.mass, 0.8)


ROTOR = dict(
    mass=37.0,
    transverse_inertia=0.479,
    polar_inertia=0.093,
    stiffness=(6e5, 5e5),
    damping=400.0,
    position=(0.165, -0.155),
)
EVERY_EFFECT = (
    jv.Gravity(),
    jv.StaticImbalance(0.01, angle=0.3),
    jv.MomentImbalance(-1e-3, angle=0.1),
    jv.DryFriction(0.0015, diameter=0.012, reaction="run_up", width=0.3),
    jv.CubicSupport(1e9, position=0.1),
    jv.Stop(1e6, gap=1e-3, damping=30.0, position=0.165),
    jv.CubicSupport(2e9, position=-0.1),
    jv.Stop(2e6, gap=2e-3, position=-0.155),
)


@pytest.mark.parametrize(
    "drive",
    [
        jv.RunUp(460.0, acceleration=230.0),
        jv.DCMotor("3000 rpm", stall_torque=2.0, inertia=0.01),
        jv.InductionMotor("3000 rpm", breakdown_torque=3.0, breakdown_slip=0.2, inertia=0.01),
    ],
    ids=lambda d: d.kind,
)
@pytest.mark.parametrize("stations", [0.1, [0.2, 0.1, -0.1, -0.2]], ids=["one station", "stations"])
def test_scene_file_of_a_rotor_with_every_effect(drive, stations, tmp_path):
    machine_ = jv.rotor(**ROTOR, stations=stations, damping_terms=(843.0, -0.47, 10.4))
    loads_ = jv.pendulums(count=4, mass=0.05, radius=0.08, drag=0.1)
    s = eqx.tree_at(lambda s: s.drive.speed, jv.Scene(machine_, loads_, drive, EVERY_EFFECT), drive.speed / 3.0)
    same(jv.scene_from_toml(jv.scene_to_toml(s)), s)
    balls_ = jv.balls(count=4, mass=0.05, radius=0.08, drag=0.1, own_radius=0.01)
    extra = (jv.Stop(1e6, gap=1e-3), jv.LoadContact(stiffness=1e5, damping=2.0))
    plane = jv.Scene(jv.planar_rotor(mass=3.0, stiffness=1e5, damping=0.1), balls_, drive, extra)
    same(jv.load_scene(jv.save_scene(plane, tmp_path / "scene.toml")), plane)


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


def touching():
    balls_ = jv.balls(count=4, mass=0.05, radius=0.08, drag=0.1, own_radius=0.01)
    return jv.Scene(jv.rotor(**ROTOR, stations=[0.2, 0.1, -0.1, -0.2]), balls_, jv.ConstantSpeed(1.0), contact())


WRONG_ROTORS = {
    "stations of other loads": (lambda: rotor_scene(count=3), r"machine\.stations has 4 values; one for all loads or 3"),
    "slip": (lambda: motor(slip=1.2), r"drive\.breakdown_slip is 1\.2; it must be below 1"),
    "no inertia": (lambda: motor(inertia=0.0), r"drive\.inertia is 0 kg m\^2; it must be greater than 0"),
    "terms": (lambda: jv.rotor(**ROTOR, stiffness_terms=(1.0, 2.0)), r"machine\.stiffness_terms has 2 values; 3 are needed"),
    "one term": (
        lambda: jv.rotor(**ROTOR, stiffness_terms=5),
        r"machine\.stiffness_terms is 5; it must be a list of three numbers, in N/m, N, N m",
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
        r"machine\.stiffness_terms \[1000000\.0, 200000\.0, 30000\.0\] would drive the rotor",
    ),
    "negative term": (
        lambda: jv.rotor(**ROTOR, damping_terms=(8e2, 0.0, -1.0)),
        r"damping_terms .* the outer two must be at least 0",
    ),
    "supports at one place": (
        lambda: jv.rotor(**{**ROTOR, "position": 0.165}),
        r"machine\.position puts both supports at 0\.165 m, where nothing holds the rotor's tilt",
    ),
    "leaning platforms": (lambda: rotor_scene(two(), None, (jv.MomentImbalance(1e-3),)), r"goes with a rotor that can tilt"),
    "far platform": (
        lambda: rotor_scene(two(), None, (jv.Stop(1e6, gap=0.0, platform=3),)),
        r"is 3; the machine has platforms 1",
    ),
    "position of platforms": (
        lambda: rotor_scene(two(), None, (jv.Stop(1e6, gap=0.0, position=0.1),)),
        r"name a platform instead",
    ),
    "platform of a rotor": (lambda: rotor_scene(effects=(jv.CubicSupport(1.0, platform=1),)), r"a rotor needs a position"),
    "both places": (lambda: jv.CubicSupport(1.0, platform=1, position=0.1), r"names a platform and a position"),
    "side of a ring": (lambda: rotor_scene(effects=(jv.Stop(1.0, 0.0, side="above", position=0.1),)), r"it must be 'both'"),
    "unknown side": (lambda: jv.Stop(1.0, 0.0, side="left"), r"effects\.stop\.side is 'left'; allowed: above, below, both"),
    "reaction": (lambda: jv.DryFriction(0.1, 0.01, reaction="none"), r"is 'none'; allowed: exact, run_up, steady"),
    "pendulums in contact": (lambda: rotor_scene(effects=contact()), r"give balls or rollers their own_radius"),
    "contact of several tracks": (lambda: touching(), r"needs loads on one track; this machine has them at several stations"),
    "twice": (lambda: rotor_scene(effects=(jv.Gravity(), jv.Gravity())), r"names gravity 2 times"),
}


@pytest.mark.parametrize("name", WRONG_ROTORS)
def test_wrong_rotors_motors_and_effects_say_what_is_wrong(name):
    make, message = WRONG_ROTORS[name]
    with pytest.raises(jv.InputError, match=message):
        make()


def test_effects_in_a_scene_file_say_where_they_are_wrong():
    wrong = TEMPLATES["rotor"] + "\n[[effects.stop]]\nstiffness = 1e6\n[[effects.stop]]\nstiffness = 1e6\ngap = 0.1\n"
    with pytest.raises(jv.InputError, match=r"effects\.stop\[0\]\.gap is missing"):
        jv.scene_from_toml(wrong)
    with pytest.raises(jv.InputError, match=r"effects\.static_imbalance\.moment is missing"):
        jv.scene_from_toml(TEMPLATES["two_mass"] + "static_imbalance = true\n")
    with pytest.raises(jv.InputError, match=r"effects\.gravity is \[\]; write true, false or a table"):
        jv.scene_from_toml(TEMPLATES["two_mass"] + "gravity = []\n")


def tables(**changed):
    base = {
        "machine": {"kind": "two_mass", **{k: list(v) if isinstance(v, tuple) else v for k, v in TWO_MASS.items()}},
        "loads": {"kind": "ball", **BALLS},
        "drive": {"kind": "constant_speed", "speed": "1500 rpm"},
    }
    for path, value in changed.items():
        section, _, field = path.partition("__")
        target = base if not field else base[section]
        if value is None:
            del target[field or section]
        else:
            target[field or section] = value
    return base


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (dict(machine=None), "machine is missing; a scene file needs the table [machine]"),
        (dict(machine=5), "machine is 5; it must be a table, write [machine]"),
        (dict(machin={}), "machin is no table of a scene file; did you mean 'machine'? allowed: machine, loads"),
        (dict(machine__kind=None), "machine.kind is missing; allowed: one_mass, two_mass, three_mass, network"),
        (dict(machine__kind="twomass"), "machine.kind is 'twomass'; did you mean 'two_mass'? allowed: one_mass, two_mass"),
        (dict(machine__kind=["two_mass"]), "machine.kind is ['two_mass']; "),
        (dict(machine__mass=None), "machine.mass is missing; needed here: mass, stiffness, damping, link_stiffness"),
        (dict(machine__stifness=1.0), "machine.stifness is no field here; did you mean 'stiffness'? allowed: mass,"),
        (dict(machine__mass=[120.0, -1.0]), "machine.mass[1] is -1 kg; it must be greater than 0"),
        (dict(machine__mass={"a": 1}), "machine.mass is {'a': 1}, which is not a number; write a number in kg"),
        (dict(loads__count=0), "loads.count is 0; it must be a whole number, at least 1"),
        (dict(loads__count="3"), "loads.count is '3'; it must be a whole number, at least 1"),
        (dict(loads__inertia=1.0), "loads.inertia is no field here"),
        (dict(drive__speed="1500 kg"), "drive.speed is '1500 kg', which is not in rad/s"),
        (dict(drive__sped=3.0), "drive.sped is no field here; did you mean 'speed'? allowed: speed"),
        (dict(effects=5), "effects is not a table"),
        (dict(effects={"gravty": True}), "effects.gravty is no effect; did you mean 'gravity'? allowed: gravity"),
        (dict(effects={"gravity": 3}), "effects.gravity is 3; write true, false or a table of its arguments"),
        (dict(effects={"gravity": {"g": -1.0}}), "effects.gravity.g is -1 m/s^2; it must be at least 0"),
    ],
)
def test_wrong_scene_file_is_one_sentence(changed, sentence):
    with pytest.raises(jv.InputError) as error:
        scene_from_tables(tables(**changed))
    assert str(error.value).startswith(sentence), str(error.value)
    assert "\n" not in str(error.value)


def test_effects_are_called_for_by_name():
    assert scene_from_tables(tables()).effects == ()
    assert scene_from_tables(tables(effects={"gravity": False})).effects == ()
    assert float(scene_from_tables(tables(effects={"gravity": True})).effects[0].g) == 9.81
    assert float(scene_from_tables(tables(effects={"gravity": {"g": "1.62 m/s^2"}})).effects[0].g) == 1.62


def test_a_file_that_cannot_be_read_says_which(tmp_path):
    with pytest.raises(jv.InputError, match=r"missing.toml cannot be read \(No such file or directory\)"):
        jv.load_scene(tmp_path / "missing.toml")
    (tmp_path / "broken.toml").write_text("[machine\nkind = 3")
    with pytest.raises(jv.InputError, match=r"broken\.toml is no TOML file"):
        jv.load_scene(tmp_path / "broken.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(jv.InputError, match=r"bytes\.toml is not UTF-8 text"):
        jv.load_scene(tmp_path / "bytes.toml")
    with pytest.raises(jv.InputError, match="cannot be read"):
        jv.load_scene(tmp_path)
    with pytest.raises(jv.InputError, match="scene is no TOML"):
        jv.scene_from_toml("[machine")


@pytest.mark.parametrize("text", ["1,5 N/m", "1 500 N/m", "1500 N/m 2", "N/m", "(1500 N/m", "1500/0 N/m", "1.5 N/m,", ""])
def test_text_that_only_looks_like_a_number_is_refused(text):
    with pytest.raises(jv.InputError, match=r"which is not in N/m; write for example '1.5 N/m'"):
        to_float(text, "N/m", "machine.stiffness")


def test_hertz_count_as_turns_in_every_power():
    np.testing.assert_allclose(to_float("20 Hz^2", "rad^2/s^2", "hold"), 20 * 4 * np.pi**2)
    assert to_float("20 Hz", "1/s", "rate") == 20.0


def test_a_file_with_a_byte_order_mark_is_read_and_other_encodings_are_named(tmp_path):
    text = TEMPLATES["one_mass"]
    (tmp_path / "bom.toml").write_text(text, encoding="utf-8-sig")
    assert jv.load_scene(tmp_path / "bom.toml").machine.kind == "one_mass"
    (tmp_path / "wide.toml").write_text(text, encoding="utf-16")
    with pytest.raises(jv.InputError, match="save it as UTF-8"):
        jv.load_scene(tmp_path / "wide.toml")
    with pytest.raises(jv.InputError, match="cannot be read"):
        jv.load_scene(tmp_path / "bom.toml" / "below")
