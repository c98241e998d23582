"""Check of the English of names and docstrings: one example of each rule is found, plain text is not."""

import importlib.util
import pathlib

import pytest

PATH = pathlib.Path(__file__).parents[2] / ".ci" / "english.py"


@pytest.fixture(scope="module")
def english():
    spec = importlib.util.spec_from_file_location("english", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('"""What it holds."""', 'docstring begins with "What"'),
        ('def f():\n    """Whether it runs."""', 'docstring begins with "Whether"'),
        ('class A:\n    """Of a run: its end."""', 'docstring begins with "Of"'),
        ('x = 1\n"""By which it is multiplied."""', 'docstring begins with "By"'),
        ("_MOST = 3", "private constant without a noun"),
        ("_POINTS: int = 3", "private constant without a noun"),
        (f"def test_{'a' * 56}():\n    pass", "test name of 61 characters"),
        ('"""Return the accuracy that was asked\n    for."""', 'phrase "asked for"'),
        ('raise ValueError("the names are told by the file")', 'phrase "are told"'),
        ('"""Return the sum, as far as it exists."""', 'phrase "as far as"'),
        ('x = "force on the bed, N"', 'phrase "force on the bed"'),
        ('"""Name that is told."""', 'phrase "is told"'),
        ('"""Values that nobody reads."""', 'phrase "nobody"'),
        ('"""Demands that are not to be had."""', 'phrase "not to be had"'),
        ('"""Width, 6.4 unless said otherwise."""', 'phrase "said otherwise"'),
        ('f"{x}: who asks pays"', 'phrase "who asks"'),
    ],
)
def test_each_rule_finds_its_example(english, text, says):
    ((_, found),) = english.findings(text)
    assert says in found


@pytest.mark.parametrize(
    "text",
    [
        '"""Floquet multipliers of an orbit."""',
        'def f():\n    """True if it runs."""',
        "_MAX_CACHED_PROGRAMS = 3",
        "_GRID_POINTS = 64",
        "MOST = 3",
        f"def test_{'a' * 55}():\n    pass",
        'x = "What is no docstring"',
        '"""Requested accuracy; fast as fast as can be."""',
    ],
)
def test_plain_text_is_not_found(english, text):
    assert list(english.findings(text)) == []


def test_the_check_fails_if_there_is_a_finding(english, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(english, "ROOT", tmp_path)
    (tmp_path / "a.py").write_text('"""How it works."""\n')
    assert english.main(["a.py"]) == 1
    assert capsys.readouterr().out.startswith("a.py:1: ")
    (tmp_path / "a.py").write_text('"""Work."""\n')
    assert english.main(["a.py"]) == 0
