"""Text and tables of a search, from results with known numbers."""

import dataclasses
import math

import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from optimize import DesignSpace, Quantity, pareto, synthesize, total
from optimize.pareto import Front
from optimize.result import Influence, Limit, Machine, Outcome, Row, _limit_influence, objective_text

SCENE = scene("two_mass")


@pytest.fixture(scope="module")
def searched():
    wish = Quantity("off_by", "N", lambda s: (s.machine.stiffness[0] / 1e4 - 3.0) ** 2 + 1.0)
    return synthesize(DesignSpace(SCENE, {"machine.stiffness[0]": (1e4, 9e4)}), wish, starts=2, iterations=25, verify=False)


def limit(what, value, at, *, broken=0.0, active=True, gain=0.0):
    return Limit(what, "m", value, at, broken, active, 0.0, gain)


def test_results_are_shown_in_practical_units(searched):
    limits = (
        limit("first at most 2 mm", 2e-3, 2e-3, gain=-0.5),
        limit("second at most 3 mm", 3.3e-3, 3e-3, broken=0.1),
        limit("third at most 4 mm", 1e-3, 4e-3, active=False),
    )
    influences = (*(Influence(f"number {k}", float(k), -float(k) / 2.0) for k in range(7)), Influence("last", -1.5, 9.0))
    machines = (Machine(3, 2e4, (1.0,)), Machine(1, 3e4, (2.0,)))
    shown = dataclasses.replace(searched, limits=limits, influences=influences, machines=machines)
    said = shown.findings()
    assert said[0] == "  at its limit: first at most 2 mm (2 mm); relaxed by 1 %: about -0.5 % of the objective"
    assert said[1] == "  not met: second at most 3 mm; at best 3.3 mm, 10 % off"
    assert said[2] == "  met: third at most 4 mm (1 mm)"
    assert said[3] == "  1 % less / more last: -1.5 % / +9 % of the objective"
    assert [line.split(":")[0][-8:] for line in said[4:8]] == [f"number {k}" for k in (6, 5, 4, 3)]
    assert said[8] == "  2 different machines: 3 x 20, 1 x 30 kN"
    greatest = dataclasses.replace(shown, objective="negative pull", machines=(Machine(3, -2e4, (1.0,)), machines[0]))
    assert greatest.findings()[-1] == "  2 different machines: 3 x 20, 3 x -20 kN"
    assert greatest.findings()[0].endswith("relaxed by 1 %: about +0.5 % of the objective")  # of the pull itself
    assert greatest.findings()[3] == "  1 % less / more last: +1.5 % / -9 % of the objective"
    one = dataclasses.replace(searched, limits=(), influences=(Influence("x", 2000.0, -1.0),), machines=machines[:1]).findings()
    assert one == ["  1 % less / more x: +400 kN / -0.2 kN"]  # 2000 % of 2e4 N: of almost nothing a share tells nothing
    none = dataclasses.replace(searched, limits=(), influences=(Influence("x", 2000.0, -1.0),), machines=()).findings()
    assert none == ["  1 % less / more x: +2e+03 % / -1 % of the objective"]


def test_rows_are_in_units_of_the_largest_value(searched):
    table = (
        Row("a", "N/m", 500.0, 2e3, math.nan, math.nan),
        Row("b", "", -3.0, 1.0, 2.0, math.nan),
        Row("c", "s", *[math.nan] * 4),
    )
    rows = dataclasses.replace(searched, table=table).rows()
    assert rows == [["a, N/mm", "0.5", "2", "", ""], ["b", "-3", "1", "2", ""], ["c, s", "", "", "", ""]]
    summary = dataclasses.replace(searched, table=table, unverified="not requested").summary().splitlines()
    assert (
        summary[0].startswith("least off by: the search converged")
        and "2 starts from 2 designs, 2 converged, 2 to" in summary[1]
    )
    assert "  not verified: not requested" in summary
    assert summary[2].split() == ["before", "after", "exact"]  # without a column of blanks
    columns = [line.index(word) + len(word) for line, word in zip(summary[2:5], ("before", "0.5", "-3"), strict=True)]
    assert len(set(columns)) == 1
    assert objective_text("negative foundation_force") == "greatest foundation force"


def test_outcomes_are_plain_for_json():
    found = Outcome({"machine.mass": [1.0, 2.0]}, False, math.nan, (0.5, math.inf), 3.0, math.nan).as_dict()
    assert found["machine.mass"] == [1.0, 2.0] and found["amplitude"] == [0.5, None] and found["foundation_force"] == 3.0
    assert found["omega"] is None and found["force_per_amplitude"] is None and len(found) == 5


def test_fronts_are_shown_in_units_of_their_largest_values():
    values = np.array([[0.5e-3, 2e4], [0.25, 1e4]])
    front = Front(values=values, names=("one", "two"), units=("m", "N/m"), machines=("", ""))
    assert front.summary().splitlines() == ["one, mm against two, N/mm", "  0.5  20", "  250  10"]
    empty = Front(values=np.zeros((0, 2)), names=("one", "two"), units=("m", "N/m"), machines=())
    assert empty.summary() == "one, m against two, N/m"
    with pytest.raises(jv.InputError, match="points is 1"):
        pareto(
            DesignSpace(SCENE, {"machine.stiffness": (1e4, 9e4)}), total("machine.stiffness"), total("machine.mass"), points=1
        )


def test_shortfalls_are_shown_in_practical_units():
    assert limit("x", 3.3e-3, 3e-3, broken=0.1).shortfall() == "at best 3.3 mm, 10 % off"
    assert limit("x", math.nan, 3e-3, broken=math.inf).shortfall() == "the nearest machine does not have this quantity"


@pytest.mark.parametrize(
    ("gain", "says"),
    [
        (-10.0, "relaxed by 1 %: about -10 % of the objective"),
        (10.1, "relaxed by 0.1 %: about +1.01 % of the objective"),
        (-2833.0, "relaxed by 0.001 %: about -2.83 % of the objective"),  # not -1360 N of a force of 48 N
        (1e12, "the objective is almost zero relative to its slope"),
        (0.0, "relaxed by 1 %: about +0 % of the objective"),
    ],
)
def test_predictions_are_limited_to_small_changes(searched, gain, says):
    demand = limit("a", 1.0, 1.0, gain=gain)
    shown = dataclasses.replace(searched, limits=(demand, demand._replace(held=True)), influences=(), machines=())
    line, held_line = shown.findings()
    assert line == f"  at its limit: a (1 m); {says}"
    assert held_line == line.replace("relaxed", "increased")


def test_figures_show_the_results(searched, monkeypatch):
    """Before against after, the best start among all, the second quantity across: in a designer's units."""
    shown = {}
    for name in ("before_after", "convergence", "front_chart"):
        monkeypatch.setattr(f"jaxvib.draw.charts.{name}", lambda *what, name=name, **how: shown.update({name: (what, how)}))
    dataclasses.replace(searched, table=(Row("a", "N/m", 500.0, 2e3, math.nan, math.nan),)).plot()
    assert shown["before_after"] == (([("a, N/mm", 0.5, 2.0)],), {"title": "search for least off by", "ax": None})
    history, values = np.array([[5e4, math.nan, 7e4], [3e4, 1e4, 2e4]]), np.array([3e4, 1e4, math.inf])
    histories = {"history": history, "history_violation": np.array([[0.0, 0.1, 0.0], [0.0, 0.0, 0.2]])}
    dataclasses.replace(searched, values=values, **histories, objective="peak_force").plot_convergence()
    (drawn, met), how = shown["convergence"]
    np.testing.assert_allclose(drawn, history / 1e3)
    assert met.tolist() == [[True, False, True], [True, True, False]]
    assert how == {"best": 1, "label": "peak force, kN", "ax": None}
    front = Front(values=np.array([[0.5, 2e4], [0.25, 3e4]]), names=("one", "two"), units=("m", "N"), machines=("", ""))
    front.plot()
    (across, up), how = shown["front_chart"]
    np.testing.assert_allclose([across, up], [[20.0, 30.0], [500.0, 250.0]])
    assert how == {"x_label": "two, kN", "y_label": "one, mm", "ax": None}


@pytest.mark.parametrize(
    ("gain", "text"),
    [
        (0.5, "relaxed by 1 %: about +0.5 % of the objective"),
        (-25.0, "relaxed by 0.1 %: about -2.5 % of the objective"),
        (1e9, "the objective is almost zero relative to its slope"),
    ],
)
def test_influence_of_a_limit_is_stated_for_a_small_change(gain, text):
    assert _limit_influence(gain, "relaxed") == text


def test_machines_of_one_value_are_equally_good(searched):
    """Values equal to their first digits only are different."""
    machines = (Machine(2, 2e4, (1.0,)), Machine(1, 2e4, (2.0,)), Machine(1, 2e4, (3.0,)))
    (line,) = dataclasses.replace(searched, limits=(), influences=(), machines=machines).findings()
    assert line == "  3 different machines are equally good (20 kN): the objective does not decide between them"


def test_machines_whose_objective_vanishes_are_equally_good(searched):
    """Both forces are 0 within rounding: 1 % of the stiffness changes them by 4 N."""
    machines = (Machine(1, 2e-15, (1.0,)), Machine(1, 9e-15, (2.0,)))
    found = dataclasses.replace(searched, limits=(), influences=(Influence("stiffness", 2e17, 1e17),), machines=machines)
    lines = found.findings()
    assert lines[-1] == "  2 different machines are equally good (2e-15 N): the objective does not decide between them"
    lines = dataclasses.replace(found, machines=(*machines, Machine(1, 1e-6, ()))).findings()
    assert lines[-1] == "  3 different machines: 1 x 2e-15, 1 x 9e-15, 1 x 1e-06 N"
