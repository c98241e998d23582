"""Identity of studies: every value that results depend on changes it, nothing else does."""

import dataclasses
import functools
import inspect
import json
import subprocess
import sys
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ROTOR, scene

import jaxvib as jv
import optimize
from jaxvib.sweeps.definition import difference
from jaxvib.sweeps.study import study
from jaxvib.sweeps.sweep import run_study
from optimize import Quantity, amplitude, largest
from optimize.files import _QUANTITIES

SCENE = scene("two_mass", "balls", speed=60.0)
AXES = {"drive.speed": [50.0, 60.0]}


def heaviness(scene):
    return scene.machine.mass[0] * scene.drive.speed


def other_heaviness(scene):
    return scene.machine.mass[0] * scene.drive.speed + 1.0


CHEAP = [Quantity("heaviness", "kg rad/s", heaviness)]

ARGUMENTS = {
    "amplitude": ({"mode": 3}, {"mode": 1, "of": 2, "tier": "exact"}),
    "foundation_force": ({"mode": 3}, {"mode": 1, "harmonic": 2, "tier": "exact"}),
    "peak_force": ({"until": 0.5, "spin_up": 0.2}, {"until": 0.4, "spin_up": 0.1}),
    "peak_displacement": ({"until": 0.5, "at": 1}, {"until": 0.4, "at": 2, "spin_up": 0.1}),
    "product": ({"field": "machine.mass"}, {"field": "machine.stiffness"}),
    "spring_cost": ({"prices": [(1e4, 20.0), (1e5, 55.0)]}, {"prices": [(1e4, 20.0), (1e5, 55.5)], "unit": "USD"}),
    "static_deflection": ({}, {"of": 1}),
    "under": (
        {"quantity": amplitude(mode=3), "name": "slow", "changes": {"drive.speed": 40.0}},
        {"quantity": amplitude(mode=1), "changes": {"drive.speed": 41.0}},
    ),
    "worst": (
        {"quantity": CHEAP[0], "tolerances": {"machine.mass": 0.05}},
        {"tolerances": {"machine.mass": 0.06}, "samples": 32, "seed": 1},
    ),
}
"""Arguments of quantities of each kind, with other values."""


def key(measure, scene=SCENE, **given):
    return study(scene, AXES, {"m": measure}, **given).key


@pytest.mark.parametrize("name", ARGUMENTS)
def test_every_argument_of_a_quantity_changes_its_identity(name):
    given, others = ARGUMENTS[name]
    build = _QUANTITIES.get(name) or getattr(optimize, name)
    before = key(build(**given))
    assert before == key(build(**given))
    for argument, value in others.items():
        assert before != key(build(**{**given, argument: value})), argument


def test_arithmetic_of_quantities_changes_their_identity():
    a, b = CHEAP[0], Quantity("heaviness", "kg rad/s", other_heaviness)
    made = [a + b, a - b, a * b, a / b, a * 2.0, a * 2.0000000001, a**2, a**3, -a, largest(a, b), a, b]
    assert len({key(q) for q in made}) == len(made)


@pytest.mark.parametrize(
    "whole",
    [
        SCENE,
        scene("network", "pendulums", effects=(jv.Gravity(),)),
        jv.Scene(jv.rotor(**ROTOR), jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(150.0)),
    ],
)
def test_every_number_of_the_scene_changes_the_identity(whole):
    def energy(scene):
        return jv.energy(scene, jax.tree.map(lambda leaf: leaf + 0.3, jv.initial_state(scene)), 0.3) + sum(
            jnp.sum(leaf) for leaf in jax.tree.leaves(scene) if eqx.is_array(leaf)
        )

    measure = Quantity("energy", "J", energy)
    leaves, structure = jax.tree.flatten(whole)
    found = {key(measure, whole)}
    for k, leaf in enumerate(leaves):
        if eqx.is_array(leaf) and leaf is not whole.drive.speed:
            beside = jnp.asarray(np.nextafter(np.asarray(leaf), np.inf))
            found.add(key(measure, jax.tree.unflatten(structure, [*leaves[:k], beside, *leaves[k + 1 :]])))
    assert len(found) == len([leaf for leaf in leaves if eqx.is_array(leaf)]) > 5


OTHERS = {
    "axes": [{"drive.speed": [50.0, 61.0]}, {"loads.drag": [50.0, 60.0]}, {"drive.speed": {"from": 50, "to": 60, "count": 2}}],
    "measure": [[Quantity("heaviness", "kg rad/s", other_heaviness)], [Quantity("heaviness", "", heaviness)]],
    "tier": ["exact"],
    "chunk": [1],
}
SAMPLED = {
    "axes": [{"drive.speed": {"from": 50.0, "to": 61.0}}, {"drive.speed": {"from": 50.0, "to": 60.0, "scale": "log"}}],
    "samples": [6],
    "sampling": ["random"],
    "seed": [1],
}
RUN = {"until": [2.0000001], "start": ["spin_up"], "steps": [500]}


@pytest.mark.parametrize(
    ("given", "others"),
    [
        ({"axes": AXES, "measure": CHEAP}, OTHERS),
        ({"axes": {"drive.speed": {"from": 50.0, "to": 60.0}}, "measure": CHEAP, "samples": 5}, SAMPLED),
        ({"axes": AXES, "measure": ["run.mode"], "until": 2.0}, RUN),
    ],
)
def test_every_argument_of_a_study_changes_its_identity(given, others):
    before = study(SCENE, **given)
    assert before.key == study(SCENE, **given).key
    for name, values in others.items():
        for value in values:
            assert study(SCENE, **{**given, name: value}).key != before.key, name
    assert dataclasses.replace(before, mode=3).key != before.key or before.plan is None
    assert study(scene("two_mass", "balls", speed=61.0), **given).key != before.key
    single = eqx.tree_at(lambda s: s.machine.mass, SCENE, SCENE.machine.mass.astype(jnp.float32))
    assert study(single, **given).key == before.key  # both are computed in JAX's precision


def test_every_argument_of_a_study_is_tried():
    tried = {*OTHERS, *SAMPLED, *RUN, "mode", "scene"}
    assert tried == set(inspect.signature(study).parameters)


RATE = 1.0


def by_rate(scene):
    return scene.drive.speed * RATE


def test_a_store_answers_no_other_question(tmp_path, monkeypatch):
    """The numbers of each question from a store of its own, where the same store refuses: also of one function object."""

    def asked(measure):
        return study(SCENE, AXES, {"m": measure})

    first, store = asked(Quantity("m", "", by_rate)), tmp_path / "study.zarr"
    assert run_study(first, store).data.m.values.tolist() == [50.0, 60.0]
    monkeypatch.setitem(globals(), "RATE", 3.0)
    with pytest.raises(jv.InputError, match="measure has a function that has changed since the study was created"):
        run_study(first, store)
    with pytest.raises(
        jv.InputError, match=r"contains another study: its program differs \(a parameter of the scene, the function"
    ):
        run_study(asked(Quantity("m", "", by_rate)), store)
    assert run_study(asked(Quantity("m", "", by_rate)), tmp_path / "other.zarr").data.m.values.tolist() == [150.0, 180.0]
    monkeypatch.setitem(globals(), "RATE", 1.0)
    assert run_study(first, store).computed == 0


def test_the_first_difference_is_named(tmp_path):
    store = tmp_path / "study.zarr"
    run_study(study(SCENE, AXES, {"m": CHEAP[0]}), store)
    with pytest.raises(jv.InputError, match=r"its axes differs \(axes.drive.speed\[1\] is 60.0 in the store and 61.0 here\)"):
        run_study(study(SCENE, {"drive.speed": [50.0, 61.0]}, {"m": CHEAP[0]}), store)
    with pytest.raises(jv.InputError, match="its measure differs"):
        run_study(study(SCENE, AXES, {"other": CHEAP[0]}), store)


def test_a_number_that_is_read_from_a_file_counts(tmp_path, monkeypatch):
    def reads_a_file(scene):
        return scene.drive.speed * float(np.loadtxt("numbers.txt"))

    monkeypatch.chdir(tmp_path)
    (tmp_path / "numbers.txt").write_text("2.0")
    asked = study(SCENE, AXES, {"m": Quantity("m", "", reads_a_file)})
    assert run_study(asked, "study.zarr").data.m.values.tolist() == [100.0, 120.0]
    assert run_study(asked, "study.zarr").computed == 0
    (tmp_path / "numbers.txt").write_text("4.0")
    with pytest.raises(jv.InputError, match="has changed since the study was created"):
        run_study(asked, "study.zarr")
    with pytest.raises(jv.InputError, match="its program differs"):
        run_study(study(SCENE, AXES, {"m": Quantity("m", "", reads_a_file)}), "study.zarr")


def test_one_as_a_number_is_not_true():
    assert difference(json.loads('{"a": [1]}'), json.loads('{"a": [true]}')) == ("a[0]", 1, True)
    assert difference({"a": 1}, {"a": 1.0}) == ("a", 1, 1.0) and difference({"a": [1.5]}, {"a": [1.5]}) is None


SOURCE = """
import functools
import jax, numpy as np
import own_numbers
from own_numbers import THIRD
GAIN = 2.0
TABLE = {"a": np.asarray([1.0, 2.0]), "b": [3.0]}
class Limits:
    high = 5.0
    def __init__(self):
        self.low = 1.0
    def width(self):
        return self.high - self.low
LIMITS = Limits()
def helper(x):
    return 7.0 * x
@jax.jit
def jitted(x):
    return helper(x) + 11.0
def closed(offset):
    def inner(x):
        return x + offset
    return inner
shifted = closed(13.0)
part = functools.partial(helper, 17.0)
def measured(scene, share=19.0, *, more=23.0):
    speed = scene.drive.speed * GAIN + TABLE["a"][1] + TABLE["b"][0] + LIMITS.width() + share + more
    return shifted(jitted(speed)) + part() + own_numbers.FIRST + THIRD
"""
NUMBERS = "FIRST = 37.0\nSECOND = 41.0\nTHIRD = 43.0\n"
EDITS = [
    *[(SOURCE, old, f"{old[:-1]}6") for old in (
        "GAIN = 2.0", "([1.0, 2.0", "[3.0", "high = 5.0", "low = 1.0", "return 7.0", "11.0", "closed(13.0", "17.0",
        "share=19.0", "more=23.0")],
    (SOURCE, "speed * GAIN", "speed / GAIN"),
    (NUMBERS, "FIRST = 37.0", "FIRST = 37.5"),
    (NUMBERS, "THIRD = 43.0", "THIRD = 43.5"),
]  # fmt: skip


def made(source=SOURCE, numbers=NUMBERS):
    """The function `measured` of a module with this source."""
    for name, text in (("own_numbers", numbers), ("own_measure", source)):
        module = sys.modules[name] = types.ModuleType(name)
        exec(compile(text, name, "exec"), module.__dict__)
    return functools.partial(sys.modules["own_measure"].measured)


@pytest.fixture
def modules(monkeypatch):
    for name in ("own_numbers", "own_measure"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))


def test_every_edit_of_a_function_changes_its_identity(modules):
    before = key(Quantity("m", "", made()))
    for text, old, new in EDITS:
        assert text.count(old) == 1
        edited = text.replace(old, new)
        function = made(edited) if text is SOURCE else made(numbers=edited)
        assert key(Quantity("m", "", function)) != before, old


def test_comments_and_unused_numbers_change_no_identity(modules):
    before = key(Quantity("m", "", made()))
    moved = "# a comment\n\n" + SOURCE.replace("GAIN = 2.0", "GAIN = 2.0  # why\nUNUSED = 1.0")
    assert key(Quantity("m", "", made(moved, NUMBERS.replace("41.0", "42.0")))) == before


def test_another_process_finds_the_same_identity(tmp_path):
    jv.save_scene(SCENE, tmp_path / "machine.toml")
    code = (
        "import sys, jax; jax.config.update('jax_enable_x64', True); import jaxvib as jv, optimize\n"
        "from jaxvib.sweeps.study import study\n"
        "scene = jv.load_scene(sys.argv[1])\n"
        "print(study(scene, {'drive.speed': [50.0, 60.0]}, {'m': optimize.foundation_force(mode=3)}).program)"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "machine.toml")]
    said = subprocess.run(command, capture_output=True, text=True, check=True)
    asked = study(jv.load_scene(tmp_path / "machine.toml"), AXES, {"m": optimize.foundation_force(mode=3)})
    assert said.stdout.strip() == asked.program


def test_a_measure_that_calls_python_is_computed_but_not_reused(tmp_path):
    def called(scene):
        return jax.pure_callback(lambda x: np.asarray(2.0 * x), scene.drive.speed, scene.drive.speed, vmap_method="sequential")

    asked = [study(SCENE, AXES, {"m": Quantity("m", "", called)}) for _ in range(2)]
    assert run_study(asked[0], tmp_path / "study.zarr").data.m.values.tolist() == [100.0, 120.0]
    with pytest.raises(jv.InputError, match="a measure calls Python from its program, whose results cannot be compared"):
        run_study(asked[1], tmp_path / "study.zarr")
