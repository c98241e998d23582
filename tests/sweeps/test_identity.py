"""Identity of studies: every value that results depend on changes it, nothing else does, and what is in doubt is not reused."""

import dataclasses
import inspect
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ROTOR, scene

import jaxvib as jv
import optimize
from jaxvib.sweeps.identity import difference, digest, identity
from jaxvib.sweeps.study import study
from jaxvib.sweeps.sweep import run_study
from optimize import Quantity, amplitude, expected, foundation_force, largest, least, under, worst
from optimize.files import _QUANTITIES

SCENE = scene("two_mass", "balls", speed=60.0)
AXES = {"drive.speed": [50.0, 60.0]}


def heaviness(scene):
    return scene.machine.mass[0] * scene.drive.speed


def other_heaviness(scene):
    return scene.machine.mass[0] * scene.drive.speed + 1.0


MOTOR = jv.DCMotor(speed=150.0, stall_torque=20.0, inertia=0.1)
CHEAP = [Quantity("heaviness", "kg rad/s", heaviness)]

ARGUMENTS = {
    "amplitude": ({"mode": 3}, {"mode": 1, "of": (1, 2), "tier": "exact"}),
    "fold_margin": ({"mode": 3}, {"mode": 1}),
    "force_per_amplitude": ({"mode": 3}, {"mode": 1, "of": 2, "tier": "time"}),
    "foundation_force": ({"mode": 3}, {"mode": 1, "harmonic": 2, "tier": "exact"}),
    "jam_frequency": ({"mode": 3}, {"mode": 1, "tier": "exact"}),
    "largest_multiplier": ({"mode": 3}, {"mode": 1}),
    "peak_force": ({"until": 20.0, "spin_up": 5.0}, {"until": 10.0, "spin_up": 4.0}),
    "phase": ({"mode": 3}, {"mode": 1, "of": (2, 1), "tier": "exact"}),
    "power": ({"mode": 3}, {"mode": 1, "tier": "exact"}),
    "product": ({"field": "machine.mass"}, {"field": "machine.stiffness"}),
    "settling_time": ({"until": 20.0, "spin_up": 5.0}, {"until": 10.0, "spin_up": 4.0, "within": 0.1, "of": 2}),
    "spring_cost": ({"prices": [(1e4, 20.0), (1e5, 55.0)]}, {"prices": [(1e4, 20.0), (1e5, 55.5)], "unit": "USD"}),
    "static_deflection": ({}, {"of": 1}),
    "support_frequency_squared": ({}, {}),
    "total": ({"field": "machine.mass"}, {"field": "loads.mass"}),
    "total_mass": ({}, {}),
    "under": (
        {"quantity": amplitude(mode=3), "name": "slow", "changes": {"drive.speed": 40.0}},
        {"quantity": amplitude(mode=1), "name": "fast", "changes": {"drive.speed": 41.0}},
    ),
    "expected": (
        {"quantity": amplitude(mode=3), "tolerances": {"machine.mass": 0.05}},
        {"quantity": amplitude(mode=1), "tolerances": {"machine.mass": 0.06}, "samples": 32, "seed": 1},
    ),
    "worst": (
        {"quantity": amplitude(mode=3), "tolerances": {"machine.mass": 0.05}},
        {"quantity": amplitude(mode=1), "tolerances": {"machine.damping": 0.05}, "samples": 32, "seed": 1},
    ),
    "quantile": (
        {"quantity": amplitude(mode=3), "level": 0.9, "tolerances": {"machine.mass": 0.05}},
        {"quantity": amplitude(mode=1), "level": 0.8, "tolerances": {"machine.mass": 0.06}, "samples": 32, "seed": 1},
    ),
}
"""Arguments of each quantity, with another value for every argument."""


def build(name):
    return _QUANTITIES.get(name) or getattr(optimize, name)


def test_every_quantity_and_argument_is_tried():
    assert set(ARGUMENTS) == {*_QUANTITIES, "under", "expected", "worst", "quantile"}
    for name, (_, others) in ARGUMENTS.items():
        assert set(others) == set(inspect.signature(build(name)).parameters), name


@pytest.mark.parametrize("name", ARGUMENTS)
def test_every_argument_of_a_quantity_changes_its_identity(name):
    given, others = ARGUMENTS[name]
    before = identity(build(name)(**given))
    assert before == identity(build(name)(**given))
    for argument, value in others.items():
        assert difference(before, identity(build(name)(**{**given, argument: value}))) is not None, argument


def test_arithmetic_of_quantities_changes_their_identity():
    a, b = amplitude(mode=3), amplitude(mode=1)
    made = [a + b, b + a, a - b, a * b, a / b, a * 2.0, a * 2.0000000001, a**2, a**3, -a, largest(a, b), least(a, b), a]
    made += [a.named("other"), largest(b, a), a + "1 mm", a + "1.0001 mm"]
    made += [f(under(a, "x", {"drive.speed": 40.0}), {"machine.mass": 0.1}) for f in (expected, worst)]
    assert len({digest(identity(q)) for q in made}) == len(made)


def perturbed(value):
    """Copies of a tree of dataclasses and tuples, each with one leaf changed, with the place of the leaf."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            for where, inner in perturbed(getattr(value, field.name)):
                copy = object.__new__(type(value))
                copy.__dict__.update({**value.__dict__, field.name: inner})
                yield f"{field.name}.{where}", copy
    elif isinstance(value, tuple):
        for k, entry in enumerate(value):
            for where, inner in perturbed(entry):
                yield f"{k}.{where}", (*value[:k], inner, *value[k + 1 :])
    elif isinstance(value, (jax.Array, np.ndarray)):
        for k in range(value.size):
            flat = np.asarray(value).ravel().copy()
            flat[k] = np.nextafter(flat[k], np.inf) if flat.dtype.kind == "f" else flat[k] + 1
            yield f"[{k}]", jnp.asarray(flat.reshape(value.shape))
    elif value is None or isinstance(value, str):
        yield "", f"{value}x"
    elif isinstance(value, bool):
        yield "", not value
    elif isinstance(value, (int, float)):
        yield "", value + 1
    elif callable(value):
        yield "", heaviness
    else:
        raise TypeError(value)


LARGE = worst(
    under(largest(foundation_force(mode=3) * 2.0, amplitude(mode=1) / "1 mm" * "1 N"), "slow", {"drive.speed": 140.0}),
    {"machine.stiffness": 0.05},
)


@pytest.mark.parametrize(
    "value",
    [
        LARGE,
        optimize.spring_cost([(1e4, 20.0), (1e5, 55.0)]),
        optimize.peak_force(until=20.0, spin_up=5.0),
        SCENE,
        scene("network", "pendulums", effects=(jv.Gravity(), jv.DryFriction(1e-3, 0.02))),
        jv.Scene(jv.rotor(**ROTOR), jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0), MOTOR),
    ],
)
def test_every_leaf_changes_the_identity(value):
    before, places = identity(value), 0
    for where, other in perturbed(value):
        assert difference(before, identity(other)) is not None, where
        places += 1
    assert places > 8


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
def test_every_argument_of_a_study_changes_its_identity(given, others, monkeypatch):
    monkeypatch.setattr("jaxvib.sweeps.study.shapes", lambda made: [jax.ShapeDtypeStruct((), float)])  # no run is traced
    before = study(SCENE, **given)
    assert before.key == study(SCENE, **given).key
    for name, values in others.items():
        for value in values:
            assert study(SCENE, **{**given, name: value}).key != before.key, name
    assert dataclasses.replace(before, mode=3).key != before.key or before.plan is None
    assert study(scene("two_mass", "balls", speed=61.0), **given).key != before.key
    single = eqx.tree_at(lambda s: s.machine.mass, SCENE, SCENE.machine.mass.astype(jnp.float32))
    assert study(single, **given).key != before.key


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
    with pytest.raises(jv.InputError, match=r"measure.m is a function whose code or data changed after the study"):
        run_study(first, store)
    with pytest.raises(jv.InputError, match=r"holds another study: its measure differs .*measure.m.function.digest is "):
        run_study(asked(Quantity("m", "", by_rate)), store)
    assert run_study(asked(Quantity("m", "", by_rate)), tmp_path / "other.zarr").data.m.values.tolist() == [150.0, 180.0]
    monkeypatch.setitem(globals(), "RATE", 1.0)
    assert run_study(first, store).computed == 0


def test_the_first_difference_is_named(tmp_path):
    def asked(speed, price=55.0):
        cost = optimize.spring_cost([(1e4, 20.0), (1e5, price)])
        return study(SCENE, AXES, {"slow": under(CHEAP[0], "slow", {"drive.speed": speed}), "cost": cost})

    store = tmp_path / "study.zarr"
    run_study(asked(40.0), store)
    with pytest.raises(jv.InputError, match=r"its measure differs \(measure.slow.case.values.*is 40.0 there and 41.0 here\)"):
        run_study(asked(41.0), store)
    with pytest.raises(jv.InputError, match=r"measure.cost.settings.* is 55.0 there and 56.0 here"):
        run_study(asked(40.0, 56.0), store)


def reads_a_file(scene):
    return scene.drive.speed * float(np.loadtxt("numbers.txt"))


def test_a_function_in_doubt_is_computed_but_not_reused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "numbers.txt").write_text("2.0")

    def asked():
        return study(SCENE, AXES, {"m": Quantity("m", "", reads_a_file)})

    assert run_study(asked(), "study.zarr").data.m.values.tolist() == [100.0, 120.0]
    (tmp_path / "numbers.txt").write_text("4.0")
    with pytest.raises(jv.InputError, match=r"measure.m calls loadtxt, which can read a file; the numbers in"):
        run_study(asked(), "study.zarr")


def test_one_as_a_number_is_not_true():
    assert difference(json.loads('{"a": [1]}'), json.loads('{"a": [true]}')) == ("a[0]", 1, True)
    assert difference({"a": 1}, {"a": 1.0}) == ("a", 1, 1.0) and difference({"a": [1.5]}, {"a": [1.5]}) is None
