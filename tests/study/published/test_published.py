"""Printed numbers beside computed ones: verdicts, how they are come to, and the papers that take no minutes."""

import math

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.cli.app import run
from jaxvib.study.published.antiphase import antiphase_paper
from jaxvib.study.published.bearing import bearing_paper
from jaxvib.study.published.criterion import criterion_paper
from jaxvib.study.published.entry import compared
from jaxvib.study.published.result import reproduced_of
from jaxvib.study.published.rotor import _critical_speeds, _data
from jaxvib.study.published.torus import _formulas


def row(printed, computed, within=0.5, **more):
    return compared("paper", "(1)", "x", printed, computed, within=within, **more)


def test_verdicts_follow_from_the_numbers():
    """Half a unit of the last digit; a correction counts only where it gives what is computed."""
    assert row(3.0, 3.5).verdict == "reproduced" and row(3.0, 3.51).verdict == "not reproducible"
    assert row(3.0, 4.0, corrected=4.2).verdict == "misprint" and row(3.0, 4.0, corrected=4.6).verdict == "not reproducible"
    assert row(3.0, math.nan, corrected=4.0).verdict == "not reproducible"
    assert row(3.0, 4.0).difference == 1.0


def test_a_verdict_that_is_not_the_known_one_is_told():
    good, bad = row(3.0, 3.0), row(3.0, 4.0)
    assert reproduced_of([good]).status_name == "as_known" and not bad.expected
    found = reproduced_of([good, bad])
    assert found.status_name == "changed" and found.unexpected == [bad]
    assert "not reproducible (known as reproduced): printed 3, computed 4" in found.summary()
    assert "1 reproduced, 0 misprint, 1 not reproducible" in found.summary()


@pytest.mark.parametrize(
    ("rows", "counts"),
    [
        (lambda: antiphase_paper().rows, (16, 1, 0)),
        (lambda: criterion_paper().rows, (13, 5, 0)),
        (lambda: bearing_paper().rows, (6, 1, 2)),
        (lambda: [*_critical_speeds(), *_data()], (1, 1, 2)),
        (_formulas, (0, 4, 0)),
    ],
    ids=["antiphase", "criterion", "bearing", "rotor's data", "torus's equations"],
)
def test_every_number_has_its_known_verdict(rows, counts):
    found = reproduced_of(rows())
    assert found.unexpected == [], found.summary()
    assert counts == tuple(sum(r.verdict == v for r in found.rows) for v in ("reproduced", "misprint", "not reproducible"))
    assert all(r.note for r in found.rows if r.verdict != "reproduced")


def test_corrections_are_not_the_numbers_they_are_checked_with():
    """What proves a misprint is computed in another way: it agrees to rounding, not bit for bit, for most."""
    rows = [r for r in criterion_paper().rows if r.verdict == "misprint"]
    differ = [r.computed != r.corrected for r in rows]
    assert sum(differ) >= 3
    np.testing.assert_allclose([r.computed for r in rows], [r.corrected for r in rows], rtol=1e-12)


@pytest.mark.slow
def test_forty_printed_numbers_have_their_known_verdict():
    figures = []
    found = jv.reproduce(figure=lambda name, draw: figures.append(name))
    assert found.unexpected == [], found.summary()
    assert sum(r.kind == "number" for r in found.rows) >= 40 and len(found.papers) == 5
    assert {name.split("_")[0] for name in figures} == set(found.papers)


def test_papers_that_there_are_not():
    with pytest.raises(jv.InputError, match=r"papers has 'gyro'; allowed: antiphase, criterion, rotor, torus, bearing"):
        jv.reproduce(["gyro"])
    with pytest.raises(jv.InputError, match=r"papers is .*; it must be a list of texts"):
        jv.reproduce("rotor")


def test_the_command(tmp_path, monkeypatch, capsys):
    """Its tables, its JSON, its figures, and exit code 1 where a verdict is another than the known one."""
    assert run(["reproduce", "criterion", "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert "criterion: computing" in err and "(57), c" in out and "misprint" in out
    assert {p.name for p in tmp_path.iterdir()} == {"criterion_three_masses.png", "reproduce.json", "reproduce.png"}
    assert run(["reproduce", "gyro"]) == 2 and "papers has 'gyro'" in capsys.readouterr().err
    assert run(["reproduce", "--list"]) == 0 and "Artyunin 2013" in capsys.readouterr().out
    monkeypatch.setattr("jaxvib.reproduce", lambda *a, **b: reproduced_of([row(3.0, 4.0)._replace(paper="rotor")]))
    assert run(["reproduce", "--json"]) == 1
