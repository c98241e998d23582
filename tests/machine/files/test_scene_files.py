"""Scene files, and what is said about wrong ones."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import BALLS, ROTOR, TWO_MASS, loads, machines

import jaxvib as jv
from jaxvib.machine.files import TEMPLATES, scene_from_tables


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


def test_template_of_a_torus_holds_what_it_calls_for():
    s = jv.scene_from_toml(TEMPLATES["torus"])
    assert (s.machine.kind, s.loads.kind, s.loads.count) == ("planar_rotor", "torus_ball", 2)
    assert [e.kind for e in s.all_effects] == ["gravity", "static_imbalance", "rolling_friction"] and s.all_effects[
        0
    ].along == "axis"
    s = uneven(eqx.tree_at(lambda s: s.loads.drag, s, jnp.asarray(0.3)))
    same(jv.scene_from_toml(jv.scene_to_toml(s)), s)


@pytest.mark.parametrize("kind", [kind for kind in TEMPLATES if kind not in ("torus", "ball_balancer")])
def test_template_loads_and_jams(kind):
    s = jv.scene_from_toml(TEMPLATES[kind])
    assert s.machine.kind == kind
    if "rotor" in kind:
        assert s.loads.count == 4 and [e.kind for e in s.all_effects] == ["gravity", "static_imbalance"]
        np.testing.assert_allclose(s.loads.mass, 0.05)
    else:
        assert s.loads.count == 3 and s.all_effects == ()
        np.testing.assert_allclose(s.loads.mass, 0.8)


def test_balls_of_a_material_have_its_mass():
    s = jv.scene_from_toml(TEMPLATES["ball_balancer"])
    volume = 4.0 / 3.0 * np.pi * 0.011**3
    np.testing.assert_allclose(s.loads.mass, 7850.0 * volume, rtol=1e-6)
    ceramic = TEMPLATES["ball_balancer"].replace('"steel" }', '"silicon nitride", ball_radius = "22 mm" }')
    np.testing.assert_allclose(jv.scene_from_toml(ceramic).loads.mass, 3200.0 * 8.0 * volume, rtol=1e-6)
    slope = jax.grad(lambda r: jv.ball_mass(r))(0.011)
    np.testing.assert_allclose(slope, 7850.0 * 4.0 * np.pi * 0.011**2, rtol=1e-6)
    for old, new, says in (
        ('"steel"', '"stel"', "loads.mass.material is 'stel'; allowed: steel, silicon nitride"),
        ('ball_radius = "11 mm"\n', "", "loads.mass.ball_radius is missing"),
        ('kind = "ball"', 'kind = "roller"', "loads.mass is"),
    ):
        with pytest.raises(jv.InputError, match=re.escape(says)):
            jv.scene_from_toml(TEMPLATES["ball_balancer"].replace(old, new, 1))


EVERY_EFFECT = (
    jv.Gravity(),
    jv.StaticImbalance(0.01, angle=0.3),
    jv.MomentImbalance(-1e-3, angle=0.1),
    jv.DryFriction(0.0015, diameter=0.012, reaction="run_up", width=0.3),
    jv.CubicSupport(1e9, position=0.1),
    jv.Stop(1e6, gap=1e-3, damping=30.0, position=0.165),
    jv.CubicSupport(2e9, position=-0.1),
    jv.Stop(2e6, gap=2e-3, position=-0.155),
    jv.FrictionSupport(90.0, width=0.02, position=0.165),
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
    balls_ = jv.balls(count=4, mass=0.05, radius=0.08, drag=0.1, ball_radius=0.01)
    extra = (jv.Stop(1e6, gap=1e-3), jv.LoadContact(stiffness=1e5, damping=2.0))
    plane = jv.Scene(jv.planar_rotor(mass=3.0, stiffness=1e5, damping=0.1), balls_, drive, extra)
    same(jv.load_scene(jv.save_scene(plane, tmp_path / "scene.toml")), plane)


def test_effects_in_a_scene_file_say_where_they_are_wrong():
    wrong = TEMPLATES["rotor"] + "\n[[effects.stop]]\nstiffness = 1e6\n[[effects.stop]]\nstiffness = 1e6\ngap = 0.1\n"
    with pytest.raises(jv.InputError, match=r"effects\.stop\[0\]\.gap is missing"):
        jv.scene_from_toml(wrong)
    with pytest.raises(jv.InputError, match=r"effects\.static_imbalance\.moment is missing"):
        jv.scene_from_toml(TEMPLATES["two_mass"] + "static_imbalance = true\n")
    with pytest.raises(jv.InputError, match=r"effects\.gravity is \[\]; write true or false or a table"):
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
        (
            dict(loads=None),
            "loads is missing; a scene file needs the table [loads], or [[exciters]] with an unbalance",
        ),
        (dict(machine=5), "machine is 5; it must be a table; write [machine]"),
        (dict(machin={}), "machin is not part of a scene file; did you mean 'machine'? allowed: machine, loads"),
        (dict(machine__kind=None), "machine.kind is missing; allowed: one_mass, two_mass, three_mass, network"),
        (dict(machine__kind="twomass"), "machine.kind is 'twomass'; did you mean 'two_mass'? allowed: one_mass, two_mass"),
        (dict(machine__kind=["two_mass"]), "machine.kind is ['two_mass']; "),
        (dict(machine__mass=None), "machine.mass is missing; needed here: mass, stiffness, damping, link_stiffness"),
        (
            dict(machine__stiffness=None, machine__stifness=1.0),
            "machine.stifness is not a field here; did you mean 'stiffness'? allowed: mass,",
        ),
        (dict(machine__mass=[120.0, -1.0]), "machine.mass[1] is -1 kg; it must be greater than 0"),
        (dict(machine__mass={"a": 1}), "machine.mass is {'a': 1}, which is not a number; write a number in kg"),
        (dict(loads__count=0), "loads.count is 0; it must be a whole number, at least 1"),
        (dict(loads__count="3"), "loads.count is '3'; it must be a whole number, at least 1"),
        (dict(loads__inertia=1.0), "loads.inertia is not a field here"),
        (dict(loads__own_radius=0.01), "loads.own_radius is not a field here; did you mean 'ball_radius'? allowed: count"),
        (dict(drive__speed="1500 kg"), "drive.speed is '1500 kg', which is not in rad/s"),
        (dict(drive__speed=None, drive__sped=3.0), "drive.sped is not a field here; did you mean 'speed'? allowed: speed"),
        (dict(effects=5), "effects is not a table"),
        (dict(effects={"gravty": True}), "effects.gravty is not an effect; did you mean 'gravity'? allowed: gravity"),
        (dict(effects={"gravity": 3}), "effects.gravity is 3; write true or false or gravity = { g = 3 }"),
        (
            dict(effects={"static_imbalance": "72 g m"}),
            "effects.static_imbalance is '72 g m'; write static_imbalance = { moment = \"72 g m\" }",
        ),
        (
            dict(effects={"stop": "3 mm"}),
            "effects.stop is '3 mm'; write stop = { gap = \"3 mm\", stiffness = ... }",
        ),
        (dict(effects={"static_imbalance": "3 s"}), "effects.static_imbalance is '3 s'; write a table of its arguments"),
        (dict(effects={"free_spin": "on"}), "effects.free_spin is 'on'; write true or false"),
        (
            dict(drive="1200 rpm"),
            'drive is \'1200 rpm\'; it must be a table; write drive = { kind = "constant_speed", speed = "1200 rpm" }',
        ),
        (
            dict(machine="one_mass"),
            "machine is 'one_mass'; it must be a table; write machine = { kind = \"one_mass\", mass = ..., stiffness = ..., ",
        ),
        (dict(machine="large"), "machine is 'large'; it must be a table; write [machine]"),
        (dict(static_imbalance="72 g m"), "static_imbalance is not part of a scene file; write it below [effects]"),
        (dict(effects={"gravity": {"g": -1.0}}), "effects.gravity.g is -1 m/s^2; it must be at least 0"),
    ],
)
def test_wrong_scene_file_is_one_sentence(changed, sentence):
    with pytest.raises(jv.InputError) as error:
        scene_from_tables(tables(**changed))
    assert str(error.value).startswith(sentence), str(error.value)
    assert "\n" not in str(error.value)


def test_effects_are_called_for_by_name():
    assert scene_from_tables(tables()).all_effects == ()
    assert scene_from_tables(tables(effects={"gravity": False})).all_effects == ()
    assert float(scene_from_tables(tables(effects={"gravity": True})).all_effects[0].g) == 9.81
    assert float(scene_from_tables(tables(effects={"gravity": {"g": "1.62 m/s^2"}})).all_effects[0].g) == 1.62


def test_a_file_that_cannot_be_read_says_which(tmp_path):
    with pytest.raises(jv.InputError, match=r"missing.toml cannot be read \(No such file or directory\)"):
        jv.load_scene(tmp_path / "missing.toml")
    (tmp_path / "broken.toml").write_text("[machine\nkind = 3")
    with pytest.raises(jv.InputError, match=r"broken\.toml is not a TOML file"):
        jv.load_scene(tmp_path / "broken.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(jv.InputError, match=r"bytes\.toml is not UTF-8 text"):
        jv.load_scene(tmp_path / "bytes.toml")
    np.savez(tmp_path / "run.npz", time=np.zeros(3))
    with pytest.raises(jv.InputError, match=r"run\.npz is an archive, such as a saved result; give the path of a TOML file"):
        jv.load_scene(tmp_path / "run.npz")
    with pytest.raises(jv.InputError, match="cannot be read"):
        jv.load_scene(tmp_path)
    with pytest.raises(jv.InputError, match="scene is not a TOML"):
        jv.scene_from_toml("[machine")


@pytest.mark.parametrize("key", ["a" + ".a" * 200_000, "a" + " . 'a'" * 100_000, '["a"' + '."a"' * 100_000 + "]"])
def test_keys_of_thousands_of_names_are_refused_at_once(key):
    """The time of `tomllib` is proportional to the square of the number of names."""
    with pytest.raises(jv.InputError, match=r"scene is nested too deeply; files of jaxvib have at most four levels"):
        jv.scene_from_toml(f"{key} = 1")


def test_numbers_with_too_many_digits_are_no_toml_error():
    with pytest.raises(jv.InputError, match="scene has a whole number with more digits than Python reads; write it as 1e6"):
        jv.scene_from_toml(f"[machine]\nmass = {'1' * 4301}")


def test_byte_order_mark_is_read_and_other_encodings_named(tmp_path):
    text = TEMPLATES["one_mass"]
    (tmp_path / "bom.toml").write_text(text, encoding="utf-8-sig")
    assert jv.load_scene(tmp_path / "bom.toml").machine.kind == "one_mass"
    (tmp_path / "wide.toml").write_text(text, encoding="utf-16")
    with pytest.raises(jv.InputError, match="save it as UTF-8"):
        jv.load_scene(tmp_path / "wide.toml")
    with pytest.raises(jv.InputError, match="cannot be read"):
        jv.load_scene(tmp_path / "bom.toml" / "below")
