"""Audits: what effects change, what they cost, and what a scene may lack."""

import json
import math
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plugins.effect import SealFriction

import jaxvib as jv
from jaxvib.cli.app import run as command
from jaxvib.cli.study.audit import audit_text
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import RotorImbalance
from jaxvib.machine.files import DRIVES, EFFECTS, LOADS, TEMPLATES
from jaxvib.results.status import member
from jaxvib.study.audit import compared, tiers
from jaxvib.study.audit.audit import _with_computed_advice
from jaxvib.study.audit.compared import EffectRow, RepeatedComparison, effect_row
from jaxvib.study.audit.comparisons import JamComparison, MotionValues, RunComparison, without_excluded_effects
from jaxvib.study.audit.numbers import NumberRow, dimensionless_numbers, gravity_share
from jaxvib.study.audit.operation_counts import operation_counts
from jaxvib.study.audit.variants import Variant, possible_variants, present_variants

SCENE = jv.Scene(
    jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5),
    jv.ConstantSpeed("60 rad/s"),
    (jv.Gravity(),),
)
BARE = jv.Scene(SCENE.machine, SCENE.loads, SCENE.drive)
SEAL = SealFriction(2e-2, 1e-3)
PENDULUMS = jv.pendulums(count=4, mass=0.05, radius=0.08, drag=0.14)
ROTOR = jv.Scene(
    jv.rotor(
        mass=37.0,
        transverse_inertia=0.479,
        polar_inertia=0.093,
        stiffness=(6e5, 5e5),
        damping=400.0,
        position=(0.165, -0.155),
        stations=(0.28, 0.25, -0.25, -0.28),
    ),
    PENDULUMS,
    jv.RunUp(460.0, 230.0),
    (jv.StaticImbalance("8 g m"), jv.Stop(1e7, gap="1 mm", position=0.1), jv.Stop(1e7, gap="1 mm", position=-0.1)),
)


@pytest.fixture(scope="module")
def found():
    return jv.audit(SCENE, accuracy=2e-3, mode=1, possible=(SEAL,), repeats=0)


def test_the_time_of_a_scene_is_that_of_a_hundred_turns(monkeypatch):
    ends, run_of = [], compared.integrate.__wrapped__

    def recording(scene, end, *rest):
        jax.debug.callback(lambda x: ends.append(float(x)), end)
        return run_of(scene, end, *rest)

    monkeypatch.setattr(compared, "integrate", recording)
    seconds, compiling = compared._times(SCENE, jv.initial_state(SCENE), 1)
    jax.effects_barrier()
    assert seconds > 0.0 and compiling > 0.0
    np.testing.assert_allclose(ends, 100.0 * 2.0 * np.pi / 60.0, rtol=1e-12)


def test_change_by_an_effect_is_that_of_both_scenes(found):
    with_, without = (jv.jam_orbit(scene, mode=1) for scene in (SCENE, BARE))
    gravity, _ = found.effects
    assert gravity.effect == "gravity" and gravity.present and gravity.tier == "exact orbit"
    np.testing.assert_allclose(gravity.amplitude, 1.0 - without.amplitude[0] / with_.amplitude[0], rtol=1e-6)
    np.testing.assert_allclose(gravity.omega, 1.0 - without.omega / with_.omega, rtol=1e-6)
    np.testing.assert_allclose(gravity.foundation_force, 1.0 - without.foundation_force / with_.foundation_force, rtol=1e-6)
    assert gravity.advice == "negligible" and found.status_name == "done"
    # Light loads' fold is the exact one but for the loads' share of the mass, times the magnification of the resonance.
    folds = jv.jam_modes(BARE).folds
    peak = float(folds.rotor_speed[np.argmax(np.asarray(folds.omega) > float(with_.omega))])
    np.testing.assert_allclose(found.fold, peak, rtol=0.05)
    assert 0.0 < abs(gravity.fold) < 2e-3


def test_an_effect_from_outside_is_audited(found):
    seal = found.effects[1]
    assert (seal.effect, seal.present, seal.note, seal.advice) == ("seal_friction", False, "as given", "needed")
    more = jv.jam_orbit(jv.Scene(SCENE.machine, SCENE.loads, SCENE.drive, (jv.Gravity(), SEAL)), mode=1)
    np.testing.assert_allclose(seal.omega, more.omega / found.omega - 1.0, rtol=1e-6)
    assert seal.omega > 0.0 and seal.operations > 0  # the seal drags the loads along: they jam faster
    there = jv.Scene(SCENE.machine, SCENE.loads, SCENE.drive, (jv.Gravity(), SEAL))
    taken = [variant for variant in present_variants(there, None) if variant.name == "seal_friction"]
    assert len(taken) == 1 and program(taken[0].scene) == program(SCENE)


def test_tiers_are_judged_against_the_best_that_answers(found):
    light, exact, averaged, full = found.tiers
    assert [tier.applicable for tier in found.tiers] == [True] * 4 and exact.amplitude == 0.0
    modes = jv.jam_modes(SCENE)
    np.testing.assert_allclose(light.omega, modes.select(1).omega / found.omega - 1.0, rtol=1e-6)
    np.testing.assert_allclose(averaged.omega, light.omega, rtol=1e-3)
    assert abs(full.amplitude) < 1e-5 < abs(light.amplitude) and math.isnan(full.seconds)


def test_tables_of_the_command_do_not_split_words():
    changes = dict(amplitude=-0.00123, foundation_force=0.0456, omega=-1.2e-5, fold=3.4e-4, uncertainty=1e-6)
    cost = dict(operations=17, seconds=0.004, compile=0.9)
    rows = [
        EffectRow("rolling_friction", present, "exact orbit", **changes, **cost, advice="perhaps needed", note="")
        for present in (True, False)
    ]
    numbers = dict(motion="jam", kind="mode 3", message="done", operations=200, seconds=0.02, compile=3.0, accuracy=0.01)
    text = audit_text(SimpleNamespace(effects=rows, tiers=[], numbers=[], **numbers))
    words = {word for line in text.splitlines() for word in line.replace("│", " ").replace("┃", " ").split()}
    assert max(map(len, text.splitlines())) <= 80 and "in brackets: added effects" in " ".join(text.split())
    assert {
        "rolling",
        "friction",
        "(rolling",
        "friction)",
        "load",
        "amplitude",
        "operations",
        "perhaps",
        "+17",
        "+20",
        "+30",
    } <= words
    names = {line.split("│")[1].strip() for line in text.splitlines() if line.startswith("│")}
    assert names <= {"rolling", "friction", "rolling friction", "(rolling", "friction)", "(rolling friction)"}


def test_the_command_prints_what_the_function_gives(found, capsys, tmp_path):
    path = jv.save_scene(SCENE, tmp_path / "machine.toml")
    words = ["audit", str(path), "--mode", "1", "--accuracy", "0.1%", "--no-add-missing", "--no-tiers", "--repeats", "0"]
    assert command([*words, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "gravity" in said and "needed" in said and "lift: R / (M g)" in said
    assert (tmp_path / "out" / "audit.png").stat().st_size > 10_000
    document = json.loads((tmp_path / "out" / "audit.json").read_text())
    assert document["effects"][0]["advice"] == "needed" and document["effects"][0]["seconds"] is None
    np.testing.assert_allclose(document["effects"][0]["amplitude"], found.effects[0].amplitude, rtol=1e-9)
    assert command(["audit"]) == 2 and "SCENE is missing" in capsys.readouterr().err
    assert command(["audit", str(path), "--accuracy", "2"]) == 2 and "accuracy is 2" in capsys.readouterr().err
    assert command(["audit", "--operations", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["operations"]) > 20


def program(scene):
    """The text of the traced equations of motion."""
    state = eqx.filter_eval_shape(jv.initial_state, scene)
    return str(jax.make_jaxpr(lambda s, t, y: jv.vector_field(s)(t, y))(scene, jnp.zeros(()), state))


class Silent(jv.Effect):
    """An effect that adds nothing."""

    kind: str = eqx.field(static=True, default="silent")
    repeatable = True

    def terms(self):
        return ()


@pytest.mark.parametrize("scene", [BARE, ROTOR], ids=["platform", "rotor"])
def test_scene_without_an_effect_traces_the_same_program(scene):
    silent = jv.Scene(scene.machine, scene.loads, scene.drive, (*scene.all_effects, Silent()))
    assert program(silent) == program(scene)
    names = [variant.name for variant in present_variants(silent, None)]
    coupled = ["gyroscopic coupling"] if scene is ROTOR else []
    assert sorted(names) == sorted(["silent", *([*coupled, "static_imbalance", "stop 1", "stop 2"] if coupled else [])])
    for effect, variant in zip(scene.all_effects, present_variants(scene, None), strict=False):
        left = tuple(each for each in scene.all_effects if each is not effect)
        assert program(variant.scene) == program(jv.Scene(scene.machine, scene.loads, scene.drive, left)) != program(scene)


def test_every_part_has_a_price_and_none_if_absent():
    rows = {(row.part, row.kind): row for row in operation_counts()}
    assert {kind for part, kind in rows if part == "effect"} == set(EFFECTS)
    assert {kind for part, kind in rows if part == "drive"} == set(DRIVES)
    assert {kind for part, kind in rows if part == "loads"} == set(LOADS)
    bare = rows["machine", "one_mass"]
    # What was counted when this was written, and a little to spare: more says that something absent is traced.
    assert bare.added == 0 and bare.operations == rows["drive", "constant_speed"].operations <= 185
    assert all((row.added > 0) == (row.kind not in ("constant_speed", "one_mass", "ball", "roller")) for row in rows.values())
    sizes = [
        rows["machine", kind].operations for kind in ("planar_rotor", "rotor, loads at one station", "rotor, loads at stations")
    ]
    assert bare.operations < sizes[0] < sizes[1] < sizes[2] and rows["loads", "torus_ball"].added > 100
    # Nor has a scene a state for what it has not.
    state, motor = jv.initial_state(BARE), jv.Scene(BARE.machine, BARE.loads, jv.DCMotor(60.0, 20.0, 0.1))
    assert state.rotor is None and len(jax.tree.leaves(state)) == 4 and state.displacement.shape == (1,)
    assert len(jax.tree.leaves(jv.initial_state(motor))) == 6


def test_added_effects_change_the_program_even_with_zero_numbers():
    nothing = jv.Scene(SCENE.machine, SCENE.loads, SCENE.drive, (jv.Gravity(0.0), jv.StaticImbalance(0.0)))
    assert len(program(nothing)) > len(program(SCENE)) > len(program(BARE))


def test_a_variant_removes_gyroscopic_coupling():
    taken = next(variant for variant in present_variants(ROTOR, None) if variant.name == "gyroscopic coupling")
    thin = eqx.tree_at(lambda s: s.machine.polar_inertia, ROTOR, 0.0 * ROTOR.machine.polar_inertia)
    rng = np.random.default_rng(1)
    state = jv.State(*(jnp.asarray(1e-3 * rng.normal(size=4)) for _ in range(2)), (jnp.arange(4.0),), (jnp.full(4, 100.0),))
    field = eqx.filter_jit(lambda scene: jv.vector_field(scene)(jnp.asarray(1.0), state))
    ours, theirs = field(taken.scene), field(thin)
    np.testing.assert_allclose(ours.velocity, theirs.velocity, rtol=1e-12)
    np.testing.assert_allclose(ours.rate[0], theirs.rate[0], rtol=1e-12)
    assert len(program(taken.scene)) < len(program(thin))


def test_what_a_scene_could_have_is_put_in_with_usual_numbers():
    put_in = {variant.name: variant for variant in possible_variants(SCENE, (2e-3,), None)}
    assert set(put_in) == {"static_imbalance", "cubic_support", "weak drive"}  # no bearing, no size, no tilt
    (cubic,) = [effect for effect in put_in["cubic_support"].scene.all_effects if effect.kind == "cubic_support"]
    # Its force k3 a^3 cos^3 has the fundamental (3/4) k3 a^3: 1 % of k a.
    np.testing.assert_allclose(0.75 * cubic.stiffness * 2e-3**2, 0.01 * SCENE.machine.stiffness[0], rtol=1e-12)
    (imbalance,) = [effect for effect in put_in["static_imbalance"].scene.all_effects if has_term([effect], RotorImbalance)]
    np.testing.assert_allclose(imbalance.moment, 50.0 * 6.3e-3 / 60.0, rtol=1e-12)
    put_in = {variant.name: variant for variant in possible_variants(ROTOR, (1e-3, 1e-3, 1e-3, 1e-3), None)}
    assert set(put_in) == {"gravity", "moment_imbalance", "dry_friction", "cubic_support"}
    with pytest.raises(jv.InputError, match=r"^possible\[0\] is gravity, which the scene has already; leave it out"):
        jv.audit(SCENE, possible=[jv.Gravity()])


def test_a_number_advises_what_computing_its_effect_came_to():
    row = NumberRow("gravity: g/(R Omega^2)", 0.02, 0.01, "perhaps needed", "its share")

    def effect(advice, kind="gravity"):
        return EffectRow(kind, False, "exact orbit", *[math.nan] * 5, 0, math.nan, math.nan, advice, "")

    assert _with_computed_advice(row, [effect("negligible")]).advice == "negligible"
    assert _with_computed_advice(row, [effect("cannot tell"), effect("negligible", "stop")]) == row


class Answers:
    """A question with known answers."""

    def __init__(self, **by_kind):
        self.by_kind = by_kind

    def has_exact_orbit(self, scene):
        return True

    def exact(self, scene):
        return self.by_kind["with_" if scene.all_effects else "without"]


@pytest.mark.parametrize(
    ("without", "present", "advice"),
    [
        (MotionValues("jam", 10.0, (1.0,), 5.0, 20.0, 1e-9), True, "negligible"),
        (MotionValues("jam", 10.0, (1.009,), 5.0, 20.0, 1e-9), True, "negligible"),
        (MotionValues("jam", 10.0, (1.011,), 5.0, 20.0, 1e-9), True, "needed"),
        (MotionValues("jam", 10.0, (1.0,), 5.0, 20.3, 1e-9), True, "needed"),
        (MotionValues("jam", 10.0, (1.011,), 5.0, 20.0, 1e-9), False, "perhaps needed"),
        (MotionValues("jam", 10.0, (1.009,), 5.0, 20.0, 2e-3), True, "cannot tell"),
        (MotionValues("jam", 10.0, (math.nan,), math.nan, math.nan, math.nan), True, "cannot tell"),
        (MotionValues("no jam", math.nan, (math.nan,), math.nan, math.nan, math.nan), True, "needed"),
        (MotionValues("balanced", 10.0, (1.0,), 5.0, 20.0, 1e-9), True, "needed"),
        (MotionValues("unsettled", 10.0, (1.0,), 5.0, 20.0, 1e-9), True, "cannot tell"),
        (MotionValues("jam", 10.0, (1.0003,), 5.0, 20.0, 1e-9, remark="coarse"), True, "negligible"),
        (MotionValues("jam", 10.0, (1.0003,), 5.0, 20.0, 1e-9, remark="at_fold"), False, "negligible"),
        (MotionValues("unsettled", 10.0, (1.2,), 5.0, 20.0, 0.05), True, "needed"),
    ],
)
def test_advice(without, present, advice):
    own = MotionValues("jam", 10.0, (1.0,), 5.0, 20.0, 1e-9)
    if present:
        ask, scene, variant = Answers(with_=own, without=without), SCENE, Variant("gravity", True, BARE)
    else:
        ask, scene, variant = Answers(with_=without, without=own), BARE, Variant("gravity", False, SCENE)
    assert effect_row(RepeatedComparison(ask, 0), scene, variant, 0.01).advice == advice


def test_a_balanced_machine_is_judged_by_what_its_loads_could_do():
    still = MotionValues("balanced", 10.0, (1e-12,), 1e-10, math.nan, 1e-9, magnified=1e9)
    moved = still._replace(amplitude=(3e-12,), uncertainty=1e-7)
    row = effect_row(RepeatedComparison(Answers(with_=still, without=moved), 0), SCENE, Variant("gravity", True, BARE), 0.01)
    np.testing.assert_allclose([row.amplitude, row.foundation_force, row.uncertainty], [-2e-9, 0.0, 3e-7 + 1e-9], rtol=1e-12)
    assert row.advice == "negligible"


def test_gravity_in_the_radial_load_follows_the_paper():
    """The largest change over a turn of N = m (l f'^2 - g sin f), by `normal_force`: below 0.5 % above 157 rad/s only."""
    still = jv.one_mass(mass=1e9, stiffness=1e15, damping=0.0)
    loads = jv.pendulums(count=1, mass=0.05, radius=0.08, drag=0.0)
    heavy, light = (jv.Scene(still, loads, jv.ConstantSpeed(460.0), e) for e in ((jv.Gravity(),), ()))

    @eqx.filter_jit
    def share(omega):
        def load(scene, phi):
            state = jv.State(jnp.zeros(1), jnp.zeros(1), (phi[None],), (omega[None],))
            return jv.normal_force(scene, 0.0, state)[0]

        angles = jnp.linspace(0.0, 2.0 * jnp.pi, 73)
        return jnp.max(jnp.abs(jax.vmap(lambda x: load(heavy, x) / load(light, x))(angles) - 1.0))

    for omega, below in ((169.6, True), (271.1, True), (460.0, True), (150.0, False)):
        measured = float(share(jnp.asarray(omega)))
        np.testing.assert_allclose(measured, gravity_share(0.08, omega), rtol=1e-6)
        assert (measured < 0.005) == below


def test_numbers_of_the_audit_follow_the_equations():
    values = MotionValues("jam", 27.0, (2e-3,), 600.0, math.nan, 1e-9)
    heavy = jv.balls(count=5, mass=1.0, radius=0.1, drag=0.5)
    scene = jv.Scene(SCENE.machine, heavy, SCENE.drive)
    rows = {row.name.partition(":")[0]: row for row in dimensionless_numbers(scene, values, 0.01)}
    radius = (3.0 / (4.0 * np.pi * 7850.0)) ** (1.0 / 3.0)
    sized = jv.balls(count=5, mass=1.0, radius=0.1, drag=0.5, ball_radius=radius)
    np.testing.assert_allclose(rows["loads side by side"].value, 1.0 - sized.unbalance() / heavy.unbalance(), rtol=1e-9)
    known = dimensionless_numbers(jv.Scene(SCENE.machine, sized, SCENE.drive), values, 0.01)
    assert not any(row.name.startswith("loads side by side") for row in known)
    assert rows["loads side by side"].advice == "perhaps needed" and "31.2 mm" in rows["loads side by side"].note
    rolling = jv.RollingFriction(3e-5)
    friction = rolling.friction(sized, (jnp.zeros(5),), (jnp.full(5, 27.0),), jnp.asarray(60.0), {})
    torque = float(jnp.sum(friction.forces({0: jnp.zeros(5), 1: jnp.zeros(5)})[0]))
    drag = float(jnp.sum(jnp.broadcast_to(sized.resistance((jnp.zeros(5),), (jnp.full(5, 27.0),), 60.0)[0], (5,))))
    np.testing.assert_allclose(rows["rolling"].value, torque / drag, rtol=1e-6)
    np.testing.assert_allclose(rows["gravity"].value, 9.81 / (0.1 * 27.0**2), rtol=1e-9)
    np.testing.assert_allclose(rows["gyroscopic"].value, 1.4 * 5.0 / 55.0, rtol=1e-9)
    np.testing.assert_allclose(rows["lift"].value, 600.0 / (9.81 * 55.0), rtol=1e-9)
    full = jv.Scene(SCENE.machine, jv.balls(count=12, mass=1.0, radius=0.1, drag=0.5), SCENE.drive)
    crowded = {row.name.partition(":")[0]: row for row in dimensionless_numbers(full, values, 0.01)}
    assert crowded["crowding"].value > 1.0 and "do not fit" in crowded["crowding"].note
    assert "gravity" not in {row.name.partition(":")[0] for row in dimensionless_numbers(SCENE, values, 0.01)}
    near = values._replace(closest=0.5)
    meets = [row for row in dimensionless_numbers(scene, near, 0.01) if row.name.startswith("contact")]
    assert meets[0].value == 2.0 and meets[0].advice == "perhaps needed"


def test_bearing_friction_is_that_of_the_effect():
    scene = jv.Scene(SCENE.machine, PENDULUMS, SCENE.drive)
    values = MotionValues("jam", 27.0, (2e-3,), 600.0, math.nan, 1e-9)
    (row,) = [row for row in dimensionless_numbers(scene, values, 0.01) if row.name.startswith("bearing")]
    of_arguments = jv.DryFriction.typical(scene.machine, PENDULUMS, scene.drive.speed, jnp.zeros(1)).effect
    friction = of_arguments.friction(PENDULUMS, (jnp.zeros(4),), (jnp.full(4, 27.0),), scene.drive.speed, {})
    drag = 4 * 0.14 * 0.08**2 * (60.0 - 27.0)
    np.testing.assert_allclose(row.value, float(jnp.sum(friction.lever * friction.static_normal_force)) / drag, rtol=1e-9)


def test_a_run_is_compared_if_no_jam_exists():
    question = RunComparison.of_arguments(ROTOR, None, None)
    assert question.start == "rest" and question.until > 2.0 * 460.0 / 230.0
    assert not question.has_exact_orbit(ROTOR) and without_excluded_effects(ROTOR).all_effects == ()
    slower = eqx.tree_at(lambda s: s.drive.speed, BARE, 20.0)
    assert np.all(np.isnan(JamComparison(3).state(slower).displacement))  # no jam there, and no error
    turning = RunComparison.of_arguments(SCENE, 3.0, None)
    assert turning == RunComparison(3.0, "turning") and float(turning.state(SCENE).rate[0][0]) == 60.0


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"accuracy": 0.0}, "accuracy is 0.0; it must be a number between 0 and 1"),
        ({"accuracy": True}, "accuracy is True"),
        ({"start": "here"}, "start is 'here'; it must be 'rest', 'turning' or a State"),
        ({"start": "rest", "mode": 1}, "mode is 1, but start selects a run"),
        ({"possible": ("gravity",)}, r"possible\[0\] is 'gravity'; it must be an Effect"),
        ({"repeats": -1}, "repeats is -1"),
        ({"mode": 9}, "mode is 9; this machine's jam modes are numbered 1 to 3"),
    ],
)
def test_invalid_arguments_raise_clear_errors(asked, says):
    with pytest.raises(jv.InputError, match=says):
        jv.audit(SCENE, **asked)


def test_a_spin_that_the_scene_does_not_make_free_is_refused():
    state = jv.initial_state(SCENE)
    spin = jv.Spin(jnp.zeros(SCENE.loads.count), None)
    with pytest.raises(jv.InputError, match=r"start\.spin is given, but no effect of the scene allows it"):
        jv.audit(SCENE, start=jv.State(state.displacement, state.velocity, state.angle, state.rate, spin=spin))


@pytest.mark.parametrize("kind", ["torus", "planar_rotor"])
def test_every_variant_starts_from_a_valid_state(kind):
    """Among the effects that a scene could have are those that make the spin of its balls free."""
    scene = jv.scene_from_toml(TEMPLATES[kind])
    variants = list(possible_variants(scene, np.zeros(2), None))
    spinning = [v.scene for v in variants if "spin" in v.name or "sliding" in v.name]
    assert spinning if kind == "torus" else not spinning
    given = jv.initial_state(spinning[0] if spinning else scene)
    for start in ("turning", "rest", given):
        for each in (scene, *(variant.scene for variant in variants)):
            state = RunComparison(1.0, start).state(each)
            jax.eval_shape(jv.vector_field(each), jnp.zeros(()), state)


@pytest.mark.parametrize(
    ("status", "kind", "words"),
    [
        ("found", "jam mode 1, stable", "jam mode 1, stable"),
        ("under_resolved", "jam mode 1, stable", "jam mode 1, stable (under_resolved)"),
        ("would_separate", "jam mode 1, stable, but the loads separate", "jam mode 1, stable, but the loads separate"),
    ],
)
def test_a_status_of_the_computation_is_no_kind_of_motion(status, kind, words, monkeypatch):
    def orbit(scene, **_):
        changed = member(jv.OrbitStatus, status)
        return eqx.tree_at(lambda o: o.status, jv.jam_orbit(scene, mode=1), changed)

    monkeypatch.setattr("jaxvib.study.audit.comparisons.jam_orbit", orbit)
    found = JamComparison(1).exact(BARE)
    assert (found.kind, found.words) == (kind, words)


@pytest.mark.parametrize("drive", [jv.ConstantSpeed(40.0), jv.DCMotor(100.0, 3.0, 0.05)], ids=lambda drive: drive.kind)
def test_exciters_without_loads_are_refused(drive):
    scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0), exciters=[jv.Exciter(drive=drive, unbalance=0.02)])
    with pytest.raises(jv.InputError, match=r"^scene.exciters\[0\] has an unbalance; this function needs"):
        jv.audit(scene)


OWN_TIER = SimpleNamespace(name="own", purpose="a purpose", refusal=lambda scene: None)


@pytest.mark.parametrize("scale", [1.0, 0.0])
def test_errors_of_a_tier_are_relative_within_a_unit(monkeypatch, scale):
    """A twofold displacement is an error of 100 % beside tilts of any size; a force or motion of 0 has no relative error."""
    units = np.array(ROTOR.machine.structure().units)
    size = np.where(units == "m", 1e-3 * scale, 0.1)
    reference = MotionValues("jam", 50.0, tuple(size.tolist()), 100.0 * scale, math.nan, 1e-9)
    found = SimpleNamespace(amplitude=np.where(units == "m", 2e-3, 0.1), foundation_force=100.0, omega=50.0)
    monkeypatch.setattr(tiers, "_call", lambda *_: lambda: found)
    row = tiers._row(OWN_TIER, ROTOR, None, reference, 0)
    np.testing.assert_allclose(row[2:5], [scale, 0.0 if scale else math.nan, 0.0])
    assert row.words() == f"error {100 * scale:.2g} %; a purpose"
    found.foundation_force = 0.0
    np.testing.assert_allclose(tiers._row(OWN_TIER, ROTOR, None, reference, 0).foundation_force, -scale)


def test_a_motion_of_which_a_part_is_unknown_does_not_exist(monkeypatch):
    scene = SCENE.replace(
        machine=jv.two_mass(mass=(50.0, 50.0), stiffness=(4e4, 4e4), damping=(1.0, 1.0), link_stiffness=2e5, link_damping=60.0)
    )
    reference = MotionValues("jam", 27.0, (2e-3, 1e-3), 600.0, math.nan, 1e-9)
    for amplitude in ((2e-3, math.nan), (math.nan, math.nan), (2e-3, 1.1e-3)):
        found = SimpleNamespace(amplitude=amplitude, foundation_force=600.0, omega=27.0)
        monkeypatch.setattr(tiers, "_call", lambda *_, found=found: lambda: found)
        row = tiers._row(OWN_TIER, scene, None, reference, 0)
        assert row.applicable == bool(np.all(np.isfinite(amplitude)))
        assert row.note == ("a purpose" if row.applicable else "this motion does not exist")
    np.testing.assert_allclose(row.amplitude, 0.05)
