"""The page for contributors: its paths and names exist, and its recipes, in one file each, make parts of a scene."""

import ast
import importlib
import inspect
import math
import pathlib
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from plugins.drive import Turbine
from plugins.effect import SealFriction
from plugins.load import TorusPoints
from plugins.machine import Beam

import jaxvib as jv
from jaxvib.machine import files
from jaxvib.machine.numbers.named import numbers_of
from jaxvib.report.arguments import arguments_of, builder_of

ROOT = pathlib.Path(__file__).parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PARTS = {"machine": (jv.Machine, Beam), "load": (jv.Loads, TorusPoints), "effect": (jv.Effect, SealFriction)}
PARTS |= {"drive": (jv.Motor, Turbine)}


def recipe(name):
    """The text of an item of the page."""
    return re.search(rf"^- \*\*{name.capitalize()}\*\*(.*?)(?=^- )", PAGE, flags=re.M | re.S)[1]


def quoted_names(text):
    return set(re.findall(r"`([^`\s]+)`", text))


def scene_with(part):
    """A scene with one part from outside the package."""
    parts = dict(
        machine=jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
        loads=jv.balls(count=2, mass=0.4, radius=0.1, drag=1.0),
        drive=jv.ConstantSpeed(90.0),
    )
    parts |= {
        "machine": {"machine": Beam("100 kg", 12.0, ["40 N/mm", 4e4], [-0.5, "500 mm"], 0.0)},
        "load": {"loads": TorusPoints(0.4, 0.08, 0.02, 0.9, 2)},
        "effect": {"effects": (SealFriction(2e-3, 1e-3),)},
        "drive": {"drive": Turbine(160.0, 3.0, 0.02)},
    }[part]
    return jv.Scene(**parts)


def accelerations(scene, rotor=None):
    """Accelerations of a load and the rotor at rest, the loads at the lowest point, where they do not push the machine."""
    zero, angle = jnp.zeros(scene.machine.carrier().mass.shape[0]), scene.loads.rest()
    state = jv.State(zero, zero, angle, tuple(map(jnp.zeros_like, angle)), rotor)
    change = jv.vector_field(scene)(jnp.asarray(0.0), state)
    return change.rate[0][0], None if rotor is None else change.rotor[1]


ANSWERS = {
    # Two springs at 0.5 m on both sides of the centre of mass: y and the tilt are independent.
    "machine": (jv.natural_frequencies, [math.sqrt(2.0 * 4e4 / 100.8), math.sqrt(2.0 * 4e4 * 0.5**2 / 12.0)]),
    # m (R + rho)^2 f'' = b_W (R + rho)^2 n
    "load": (lambda scene: accelerations(scene)[0], 0.9 * 90.0 / 0.4),
    # (7/5) m R^2 phi'' = b_W R^2 n + the torque of the seal
    "effect": (lambda scene: accelerations(scene)[0], (1.0 * 0.1**2 * 90.0 + 2e-3) / (1.4 * 0.4 * 0.1**2)),
    # J theta'' = T(50) - 2 b_W R^2 50
    "drive": (
        lambda scene: accelerations(scene, (jnp.asarray(0.0), jnp.asarray(50.0)))[1],
        (3.0 * (1.0 - (50.0 / 160.0) ** 2) - 2.0 * 0.1**2 * 50.0) / 0.02,
    ),
}


def found_paths(name, folders):
    """Files and folders with this path, or whose path ends with it in one of `folders`; modules may lack their suffix."""
    direct = [path for path in (ROOT / name, ROOT / f"{name}.py") if path.exists()]
    return direct or [path for folder in folders for path in folder.rglob(name)]


def faults_of(block):
    """Names of a row or an item of the page that the project does not have: paths (in a row those of files below its
    packages), and constants in the files of the item."""
    names = quoted_names(block)
    paths = {name for name in names if "/" in name or name.endswith((".py", ".pyi")) or name == "optimize"}
    packages = [ROOT / name for name in paths if (ROOT / name).is_dir()] if block.startswith("|") else []
    found = {name: found_paths(name, packages or [ROOT / "jaxvib", ROOT / "optimize", ROOT / "tests"]) for name in paths}
    files = [file for each in found.values() for path in each for file in ([path] if path.is_file() else path.glob("*.py"))]
    code = "\n".join(path.read_text(encoding="utf-8") for path in files)
    constants = {name for name in names if re.fullmatch(r"_?[A-Z]+(_[A-Z]+)*", name)}
    missing = {name for name in constants if not re.search(rf"^{name}\b.* = ", code, flags=re.M)}
    return missing | {name for name, each in found.items() if not each}


@pytest.mark.parametrize(
    ("block", "faults"),
    [
        ("| 8 | `jaxvib/draw` | `dopri8.py` |", {"dopri8.py"}),
        ("| 8 | `jaxvib/draw`, `jaxvib/ode` | `dopri8.py` |", set()),
        ("- `DRIVES` of `registry.py`, `machine/motors`", {"DRIVES", "machine/motors"}),
    ],
)
def test_wrong_names_are_found(block, faults):
    assert faults_of(block) == faults


def test_named_paths_and_constants_exist():
    rows, items = re.findall(r"^\| .*$", PAGE, flags=re.M), re.findall(r"^- .*\n(?:  .*\n)*", PAGE, flags=re.M)
    assert len(rows) > 15 and len(items) > 20
    assert [(block[:40], faults) for block in (*rows, *items) if (faults := faults_of(block))] == []


IDEAS = [
    ("motion", "jaxvib/equations", "dynamics.py"),
    ("equal steps", "jaxvib/motion", "batch.py"),
    ("repr", "jaxvib/machine", "numbers/__init__.py"),
    ("averaged", "jaxvib/equations", "averaged.py"),
    ("sizes", "jaxvib/ode", "control.py"),
    ("Floquet", "jaxvib/steady", "orbits/stability.py"),
    ("synchronous exciters", "jaxvib/steady", "regimes/synchronous.py"),
    ("synchronous exciters", "jaxvib/steady", "orbits/synchronous.py"),
    ("whirl", "jaxvib/steady", "whirl.py"),
    ("empirical criterion", "jaxvib/steady", "balance/criterion.py"),
    ("metadata", "jaxvib/machine", "numbers/__init__.py"),
    ("effects", "jaxvib/machine", "effects/rolling.py"),
    ("effects", "jaxvib/machine", "effects/sliding.py"),
    ("currents", "jaxvib/machine", "drives/electrical.py"),
    ("1500 rpm", "jaxvib/units", "reading.py"),
    ("cache", "jaxvib/runtime", "stored.py"),
    ("store", "jaxvib/sweeps", "store.py"),
    ("starts and local search", "optimize", "search/polish.py"),
    ("Pareto", "optimize", "pareto.py"),
    ("foundation force", "optimize", "quantities/jams.py"),
    ("profile likelihood", "jaxvib/identification", "profile_likelihood.py"),
    ("UFF", "jaxvib/exchange", "uff.py"),
    ("", "jaxvib/exchange", "state_space.py"),
    ("HTML", "jaxvib/report", "page.py"),
    ("server", "jaxvib/explore", "server.py"),
]
"""Ideas that a reader looks for, with the package and the file that implement them."""


@pytest.mark.parametrize(("idea", "package", "file"), IDEAS)
def test_ideas_lead_to_their_files(idea, package, file):
    (row,) = re.findall(rf"^\| .*`{package}`.*$", PAGE, flags=re.M)
    assert idea.lower() in row.lower() and f"`{file}`" in row and (ROOT / package / file).exists()


@pytest.mark.parametrize(("part", "base"), [*((name, base) for name, (base, _) in PARTS.items()), ("drive", jv.IdealDrive)])
def test_recipe_names_all_that_a_part_must_define(part, base):
    annotated = {name: str(kind) for each in base.__mro__ for name, kind in inspect.get_annotations(each).items()}
    fields = {name for name, kind in annotated.items() if "AbstractVar" in kind and name != "kind"}
    assert base.__abstractmethods__ | fields <= quoted_names(recipe(part))
    assert fields or part in ("machine", "effect")


@pytest.mark.parametrize("part", PARTS)
def test_example_of_a_recipe_is_one_file(part):
    module = importlib.import_module(f"plugins.{part}")
    tree = ast.parse(pathlib.Path(module.__file__).read_text())
    used = {
        node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
        for node in ast.walk(tree)
        if isinstance(node, (ast.Import, ast.ImportFrom))
    }
    assert [node.name for node in tree.body if isinstance(node, ast.ClassDef)] == [PARTS[part][1].__name__]
    assert {name.partition(".")[0] for name in used} <= {"equinox", "jax", "jaxvib"}


@pytest.mark.parametrize("part", PARTS)
def test_part_of_a_recipe_answers_without_registration(part):
    answer, expected = ANSWERS[part]
    np.testing.assert_allclose(answer(scene_with(part)), expected, rtol=1e-10)


@pytest.mark.parametrize("part", PARTS)
def test_files_refuse_a_part_without_an_entry(part):
    own = PARTS[part][1].__name__
    remedy = rf"which scene files do not describe; build it in Python, or add an entry: (.*)\.([A-Z]+)\['(\w+)'\] = {own}$"
    with pytest.raises(jv.InputError, match=remedy) as refusal:
        jv.scene_to_toml(scene_with(part))
    module, registry, kind = re.search(remedy, str(refusal.value)).groups()
    assert getattr(importlib.import_module(module), registry) is ENTRIES[part] and kind == part_of(scene_with(part), part).kind


ENTRIES = {"machine": files.MACHINES, "load": files.LOADS, "drive": files.DRIVES, "effect": files.EFFECTS}
SECTION = {"machine": "machine", "load": "loads", "drive": "drive", "effect": "effects"}


def part_of(scene, part):
    return scene.all_effects[0] if part == "effect" else getattr(scene, SECTION[part])


@pytest.mark.parametrize("part", PARTS)
def test_one_line_in_a_users_file_makes_the_entry(part, monkeypatch):
    scene = scene_with(part)
    own = part_of(scene, part)
    monkeypatch.setitem(ENTRIES[part], own.kind, type(own))
    read = jv.scene_from_toml(jv.scene_to_toml(scene))
    assert eqx.tree_equal(read, scene)
    assert any(argument.unit for argument in arguments_of(builder_of(f"{part}s", own.kind)))


def test_parameters_of_an_example_have_names_and_units():
    assert {"machine.mass", "machine.stiffness", "machine.exciter"} <= set(numbers_of(scene_with("machine")))
    with pytest.raises(jv.InputError, match=r"machine.mass is '1 m', which is not in kg"):
        Beam("1 m", 12.0, [4e4, 4e4], [-0.5, 0.5], 0.0)


def test_the_page_has_at_most_1000_words():
    assert len(PAGE.split()) <= 1000
