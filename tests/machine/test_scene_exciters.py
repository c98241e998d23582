"""Exciters of a scene: both forms of the constructor, singular properties, names, files, bad input."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from scenes import machines

import jaxvib as jv
from jaxvib.machine.numbers.named import find_number, numbers_of, put_numbers

LOADS, DRIVE = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0)
MOTOR = jv.DCMotor(100.0, stall_torque=5.0, inertia=0.1)
TWO = machines()["two_mass"]
ROTOR = jv.rotor(
    mass=37.0, transverse_inertia=0.5, polar_inertia=0.1, stiffness=(6e5, 5e5), damping=(400.0, 300.0), position=(0.2, -0.2)
)
SCREEN = jv.plane_body(mass=300.0, inertia=75.0, supports=[jv.support(at=(0.5, 0.0), stiffness=(1e5, 2e5), damping=(1, 1))])


def two(**changes):
    clockwise = {"drive": MOTOR, "unbalance": 0.2, "at": 1, "direction": -1, "effects": jv.StaticImbalance(0.1)} | changes
    return jv.Scene(TWO, exciters=[jv.Exciter(LOADS, DRIVE), jv.Exciter(**clockwise)], effects=jv.Gravity())


def one_on(machine, at):
    return jv.Scene(machine, exciters=[jv.Exciter(LOADS, DRIVE, at=at)])


def test_one_exciter_is_the_short_form():
    effects = jv.StaticImbalance(0.1), jv.Gravity(), jv.Stop(1e5, gap=1e-3)
    short = jv.Scene(TWO, LOADS, DRIVE, effects)
    assert eqx.tree_equal(short, jv.Scene(TWO, exciters=[jv.Exciter(LOADS, DRIVE)], effects=effects))
    assert eqx.tree_equal(short, jv.Scene(TWO, exciters=[jv.Exciter(LOADS, DRIVE, effects=effects[:1])], effects=effects[1:]))
    assert [effect.kind for effect in short.all_effects] == ["stop", "gravity", "static_imbalance"]
    assert [effect.kind for effect in short.effects] == ["stop", "gravity"]


@pytest.mark.parametrize(
    "where", [lambda s: s.loads.drag, lambda s: s.drive.speed, lambda s: s.drive, lambda s: s.machine.mass]
)
def test_tree_at_replaces_parts_through_singular_properties(where):
    scene = jv.Scene(TWO, LOADS, DRIVE)
    new = jax.tree.map(lambda x: 2.0 * x, where(scene))
    assert eqx.tree_equal(where(eqx.tree_at(where, scene, new)), new)
    state = jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.zeros(2),), (jnp.zeros(2),))
    ones = jnp.ones(2)
    assert eqx.tree_at(lambda s: s.angle[0], state, ones).exciters[0].angle[0] is ones


def test_replaced_values_of_a_state_reach_its_exciter():
    state = jv.State(0, 1, (2, 3), (4, 5), (6, 7), jv.Spin(8, (9,)))
    assert dataclasses.replace(state, spin=None) == jv.State(0, 1, (2, 3), (4, 5), (6, 7))
    assert dataclasses.replace(state, velocity=9, rotor=None, angle=(3, 2)).exciters == (
        jv.ExciterState((3, 2), (4, 5), None, jv.Spin(8, (9,))),
    )
    with pytest.raises(jv.InputError, match=r"^exciters are 2, together with spin; give these to an ExciterState"):
        dataclasses.replace(jv.State(0, 1, exciters=[jv.ExciterState()] * 2), spin=None)


def test_leaves_of_one_exciter_keep_their_order():
    state = jv.State(0, 1, (2, 3), (4, 5), (6, 7), jv.Spin(8, (9,)))
    assert jax.tree.leaves(state) == list(range(10))
    scene = jv.Scene(TWO, LOADS, DRIVE)
    parts = jax.tree.leaves((scene.machine, scene.loads, scene.drive))
    assert all(a is b for a, b in zip(jax.tree.leaves(scene), parts, strict=True))


@pytest.mark.parametrize(
    "ask",
    [
        jv.jam_modes,
        jv.branches,
        jv.phase_jams,
        jv.balanced_states,
        jv.criterion,
        jv.audit,
        lambda s: jv.jam_orbit(s, omega=9.0),
        lambda s: jv.whirl(s, [9.0]),
    ],
)
def test_theories_refuse_several_exciters(ask):
    with pytest.raises(jv.InputError, match=r"has 2 exciters; this function needs a scene with one exciter; for others use"):
        ask(two())


@pytest.mark.parametrize("change", [{"unbalance": 0.1}, {"direction": -1}])
def test_theories_refuse_other_exciters(change):
    scene = jv.Scene(TWO, exciters=[jv.Exciter(LOADS, DRIVE, **change)])
    with pytest.raises(jv.InputError, match=r"scene.exciters\[0\].* simulate"):
        jv.jam_modes(scene)


def test_states_of_several_exciters_are_read_one_by_one():
    with pytest.raises(jv.InputError, match=r"has 2 exciters; read state.exciters\[0\].angle"):
        jv.initial_state(two()).angle  # noqa: B018


def test_place_of_one_exciter_moves_its_mount():
    first, second = (jv.Scene(TWO, exciters=[jv.Exciter(LOADS, DRIVE, at=at)]) for at in (1, 2))
    assert first.mount().rows[0].tolist() == [[1.0, 0.0]] and second.mount().rows[0].tolist() == [[0.0, 1.0]]
    other = jv.Scene(jv.two_mass(**{**PARTS, "exciter": 1}), LOADS, DRIVE)
    assert jnp.allclose(jv.jam_modes(first).omega, jv.jam_modes(other).omega, equal_nan=True, rtol=1e-14)


PARTS = {name: getattr(TWO, name) for name in ("mass", "stiffness", "damping")}
PARTS |= {name: getattr(TWO, name)[0] for name in ("link_stiffness", "link_damping")}


@pytest.mark.parametrize(
    "scene",
    [
        two(),
        jv.Scene(TWO, exciters=[jv.Exciter(LOADS, DRIVE, at=1)]),
        jv.Scene(jv.planar_rotor(mass=9.0, stiffness=2e4, damping=9.0), exciters=[jv.Exciter(drive=MOTOR, unbalance=0.1)] * 2),
    ],
)
def test_scenes_with_exciters_are_read_back_from_files(scene):
    assert eqx.tree_equal(jv.scene_from_toml(jv.scene_to_toml(scene)), scene)


def test_numbers_of_several_exciters_have_names():
    scene = two()
    names = numbers_of(scene)
    assert {"exciters[0].loads.mass", "exciters[1].drive.stall_torque", "exciters[1].unbalance"} < set(names)
    assert {"exciters[1].effects.static_imbalance.moment", "effects.gravity.g", "machine.mass"} < set(names)
    found = find_number(scene, "exciters[1].unbalance", "axes")
    assert found.words(scene) == ["unbalance of the rotor (exciter 2)"] and found.unit == "kg m"
    assert put_numbers(scene, [found], jnp.asarray([0.7])).exciters[1].unbalance == 0.7
    assert "loads.mass" in numbers_of(jv.Scene(TWO, LOADS, DRIVE))


BAD = {
    "direction": (lambda: two(direction=0), r"direction is 0; it must be 1 \(anticlockwise\) or -1"),
    "negative unbalance": (lambda: two(unbalance=-0.2), r"unbalance is -0.2 kg m; it must be greater than 0"),
    "force as unbalance": (
        lambda: two(unbalance="10 kN"),
        r"unbalance is '10 kN', a force; .*: in a file by \{ force = '10 kN', at = '1500 rpm' \}, in Python by jaxvib",
    ),
    "huge unbalance": (
        lambda: two(unbalance=1e308, unbalance_mass=1.0),
        "less than that of the unbalance alone, .* = inf kg m",
    ),
    "neither": (lambda: two(unbalance=None), r"loads is None; .* or give an unbalance"),
    "no drive": (lambda: two(drive=None), r"drive is None; it must be a Drive"),
    "platform": (lambda: two(at=3), r"^exciters\[1\].at is 3; the machine has platforms 1 to 2"),
    "jam": (lambda: jv.initial_state(two(), "jam", mode=1), "start is 'jam', but scene has 2 exciters; start at 'rest'"),
    "zero": (lambda: one_on(ROTOR, at=0), r"^at is 0; .* a distance of 0 m is written 0.0"),
    "truth value": (lambda: two(at=True), r"at is True; it must be a whole number"),
    "distance": (lambda: two(at="2 mm"), r"at is .*0\.002.*; the machine has platforms 1 to 2"),
    "friction without loads": (lambda: two(effects=jv.DryFriction(0.01, 0.02)), r"acts on loads, but this exciter has none"),
    "shared effect": (lambda: jv.Exciter(LOADS, DRIVE, effects=jv.Gravity()), "effects.gravity acts on the whole machine"),
    "own effect": (
        lambda: jv.Scene(TWO, exciters=[jv.Exciter(LOADS, DRIVE)] * 2, effects=jv.StaticImbalance(0.1)),
        r"effects.static_imbalance acts on one rotor; give it to an exciter",
    ),
    "both forms": (
        lambda: jv.Scene(TWO, LOADS, DRIVE, exciters=[jv.Exciter(LOADS, DRIVE)]),
        "are given together with loads or drive",
    ),
    "point": (lambda: one_on(SCREEN, at=0.5), r"^at has 1 number; on a body in a plane give \(x, y\)"),
    "position": (lambda: one_on(ROTOR, at=(0.5, 0.25)), r"^at is .*0\.5 *,? *0\.25.*, a point of a body; on a rotor give"),
    "body": (lambda: jv.Exciter(LOADS, DRIVE, body=0.5), r"body is 0.5; it must be a whole number, at least 0"),
    "none": (lambda: jv.Scene(TWO, exciters=[]), r"exciters is \[\]; it must be a list of exciters"),
    "replaced number": (
        lambda: jv.simulate(eqx.tree_at(lambda s: s.exciters[1].unbalance, two(), -1.0), 1.0),
        r"exciters\[1\].unbalance is -1 kg m; it must be greater than 0",
    ),
    "start": (
        lambda: jv.simulate(two(), 1.0, start=jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.zeros(2),), (jnp.zeros(2),))),
        r"start.exciters are 1; this scene needs 2",
    ),
    "rotor of a motor": (
        lambda: jv.simulate(two(), 1.0, start=jv.State(jnp.zeros(2), jnp.zeros(2), exciters=REST)),
        r"exciters\[1\].start.rotor is None; under the drive 'dc_motor' it must be \(angle, speed\)",
    ),
}
REST = [jv.ExciterState((jnp.zeros(2),), (jnp.zeros(2),)), jv.ExciterState()]


@pytest.mark.parametrize("name", BAD)
def test_wrong_exciters_are_refused_by_name(name):
    make, message = BAD[name]
    with pytest.raises(jv.InputError, match=message):
        make()
