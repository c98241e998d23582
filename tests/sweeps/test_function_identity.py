"""Identity of users' functions: code, closures, globals, helpers; and what cannot be followed."""

import functools
import json
import subprocess
import sys
import types

import jax
import numpy as np
import pytest

from jaxvib.sweeps.identity import UnknownIdentity, identity


def heaviness(scene):
    return scene.machine.mass[0] * scene.drive.speed


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
    from own_numbers import FOURTH
    speed = scene.drive.speed * GAIN + TABLE["a"][1] + TABLE["b"][0] + LIMITS.width() + share + more
    return shifted(jitted(speed)) + part() + own_numbers.FIRST + THIRD + FOURTH + sum(29.0 * k for k in (1, 2)) + 31
"""
NUMBERS = "FIRST = 37.0\nSECOND = 41.0\nTHIRD = 43.0\nFOURTH = 47.0\n"
EDITS = [
    *[(SOURCE, f"{old}", f"{old[:-1]}5" if old[-1] != "5" else f"{old[:-1]}6") for old in (
        "GAIN = 2.0", "([1.0, 2.0", "[3.0", "high = 5.0", "low = 1.0", "return 7.0", "11.0", "closed(13.0", "17.0",
        "share=19.0", "more=23.0", "29.0", "+ 31", "(1, 2")],
    (SOURCE, "speed * GAIN", "speed / GAIN"),
    (SOURCE, "high - self.low", "high + self.low"),
    (SOURCE, '["a"][1]', '["a"][0]'),
    (SOURCE, "@jax.jit\n", ""),
    (NUMBERS, "FIRST = 37.0", "FIRST = 37.5"),
    (NUMBERS, "THIRD = 43.0", "THIRD = 43.5"),
    (NUMBERS, "FOURTH = 47.0", "FOURTH = 47.5"),
]  # fmt: skip


def made(source=SOURCE, numbers=NUMBERS):
    """The function `measured` of a module with this source."""
    for name, text in (("own_numbers", numbers), ("own_measure", source)):
        module = sys.modules[name] = types.ModuleType(name)
        exec(compile(text, name, "exec"), module.__dict__)
    return sys.modules["own_measure"].measured


@pytest.fixture
def modules(monkeypatch):
    for name in ("own_numbers", "own_measure"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))


@pytest.mark.parametrize(("text", "old", "new"), EDITS, ids=[old for _, old, _ in EDITS])
def test_every_edit_of_a_function_changes_its_identity(modules, text, old, new):
    before = identity(made())
    assert text.count(old) == 1
    edited = text.replace(old, new)
    assert identity(made(edited) if text is SOURCE else made(numbers=edited)) != before


def test_comments_and_unused_numbers_change_no_identity(modules):
    before = identity(made())
    moved = "# a comment\n\n" + SOURCE.replace("GAIN = 2.0", "GAIN = 2.0  # why\nUNUSED = 1.0")
    assert identity(made(moved, NUMBERS.replace("41.0", "42.0"))) == before


def test_another_process_finds_the_same_identity(modules, tmp_path):
    (tmp_path / "own_numbers.py").write_text(NUMBERS)
    (tmp_path / "own_measure.py").write_text(SOURCE)
    code = (
        "import json, sys; sys.path.insert(0, sys.argv[1]); from own_measure import measured\n"
        "from jaxvib.sweeps.identity import identity; print(json.dumps(identity(measured)))"
    )
    said = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert json.loads(said.stdout) == identity(made())


def test_changes_in_this_process_change_the_identity(modules):
    function = made()
    module = sys.modules["own_measure"]

    def closure():
        return jax.vmap(lambda x: x * module.GAIN)

    for name, change in (
        ("number", lambda: setattr(module, "GAIN", 3.0)),
        ("entry", lambda: module.TABLE["a"].__setitem__(1, 2.5)),
        ("attribute", lambda: setattr(module.LIMITS, "low", 1.5)),
        ("class", lambda: setattr(module.Limits, "high", 5.5)),
        ("helper", lambda: setattr(module, "helper", closure())),
        ("code", lambda: setattr(module.closed, "__code__", heaviness.__code__)),
    ):
        before = identity(function), identity(functools.partial(function)), identity(module.closed)
        change()
        assert before != (identity(function), identity(functools.partial(function)), identity(module.closed)), name


def test_wrappers_that_bear_a_name_of_a_package_are_followed(modules):
    def wrapped(factor):
        @functools.wraps(np.linalg.norm)
        def norm(scene):
            return scene.drive.speed * factor

        return norm

    def other(factor):
        @functools.wraps(np.linalg.norm)
        def norm(scene):
            return scene.drive.speed + factor

        return norm

    assert len({str(identity(f)) for f in (wrapped(1.0), wrapped(2.0), other(1.0), np.linalg.norm)}) == 4


class Recursive:
    def __init__(self):
        self.itself = self

    def __call__(self, scene, depth=3):
        return heaviness(scene) if depth == 0 else self(scene, depth - 1)


def test_objects_that_hold_themselves_have_an_identity():
    one = Recursive()
    before = identity(one)
    one.more = 1.0
    assert identity(Recursive()) == before != identity(one)


def reads_a_file(scene):
    return scene.drive.speed * float(np.loadtxt("numbers.txt"))


def opens_a_file(scene):
    with open("numbers.txt") as file:
        return scene.drive.speed * float(file.read())


def asks_the_clock(scene):
    import time

    return scene.drive.speed * time.time()


def numbers_one_by_one():
    yield 1.0


NUMBERS_LEFT = numbers_one_by_one()


def takes_the_next(scene):
    return scene.drive.speed * next(NUMBERS_LEFT)


@pytest.mark.parametrize(
    ("function", "says"),
    [
        (reads_a_file, "calls loadtxt, which can read a file"),
        (opens_a_file, "calls open"),
        (asks_the_clock, "uses the module time"),
        (takes_the_next, "a value of the class builtins:generator, which cannot be compared"),
    ],
)
def test_what_cannot_be_followed_is_said(function, says):
    with pytest.raises(UnknownIdentity, match=says):
        identity(function)
