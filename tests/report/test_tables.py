"""Documents as tables of a page, cell by cell."""

import math
import re

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.files import SCREENS
from jaxvib.report.tables import COMPLEX, accuracy_table, in_display_units, parameter_tables, result_tables
from jaxvib.results.fields import plain

UNITS = {"force": "N", "rows": "m"}


def cells(text, tag="td"):
    return [re.sub("<.*?>", "", cell) for cell in re.findall(rf"<{tag}[^>]*>(.*?)</{tag}>", text)]


def test_only_columns_of_numbers_stand_at_the_right():
    rows = [{"force": 1.0, "kind": "x", "fits": True}, {"force": None, "kind": 2.0, "fits": False}]
    text = result_tables({"rows": rows}, UNITS)
    assert cells(text, "th") == ["force, N", "kind", "fits"] and cells(text) == ["1", "x", "yes", "none", "2", "no"]
    assert re.findall(r"<t[hd]( class='n')?>", text) == [" class='n'", "", ""] * 3


def test_long_texts_stand_below_their_row():
    long = "a sentence of more than forty characters, which no column has room for"
    text = result_tables({"rows": [{"name": "first", "message": long}, {"name": "second", "message": ""}]}, {})
    assert cells(text, "th") == ["name"] and cells(text) == ["first", f"message: {long}", "second"]


def test_accuracy_and_results_are_separate_tables():
    document = {"status": "done", "force": 2.5, "scene": "hidden", "toml": "hidden", "inner": {"status": "inside"}}
    assert cells(accuracy_table(document, UNITS)) == ["done", ""]
    text = result_tables(document, UNITS)
    assert cells(text) == ["2.5", "N", "inside", ""] and cells(text, "h3") == ["inner"] and "hidden" not in text


def test_long_lists_are_shown_by_their_range():
    document = {"times": [0.5 * k for k in range(40)], "names": ["x"] * 40, "grid": [[1.0, 2.0], [3.0, None]]}
    text = result_tables(document, {})
    assert cells(text, "p") == [
        "40 numbers from 0 to 19.5; see the output of --json or --out",
        "40 values; see the output of --json or --out",
    ]
    assert cells(text) == ["1", "2", "3", "none"]
    short = result_tables({"times": [1.0, 2.0], "none": []}, {})
    assert cells(short) == ["1, 2", "", "none", ""]


def test_a_report_shows_what_the_terminal_would(tmp_path):
    scene = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25),
        jv.ConstantSpeed("60 rad/s"),
    )
    modes = jv.jam_modes(scene)
    text = jv.html_report(modes, tmp_path / "r.html", title="Größe µ", figures=[]).read_text(encoding="utf-8")
    assert cells(text, "h1") == ["Größe µ"] and 'class="command"' not in text
    shown = re.search(r"<pre>(.*?)</pre>", text, re.DOTALL)
    assert shown and shown[1].strip().splitlines()[0].split() == modes.summary().strip().splitlines()[0].split()


def test_values_of_coordinates_have_their_own_units():
    units = {"amplitude": "m or rad", "margin": ""}
    document = {"regimes": [{"amplitude": [0.002, 0.0015, 0.01], "margin": math.inf}], "deck": [{"amplitude": 0.003}]}
    shown, units = in_display_units(document, units, ("m", "m", "rad"))
    assert cells(result_tables(shown, units), "th") == ["amplitude", "margin", "amplitude"]
    assert cells(result_tables(shown, units)) == ["2 mm, 1.5 mm, 0.572958 deg", "inf", "3 mm"]


def test_two_coordinates_have_their_own_units():
    units = {"amplitude": "m or rad", "displacement": f"m or rad{COMPLEX}"}
    document = {"amplitude": [0.002, 0.01], "displacement": [[0.002, 0.001], [0.01, 0.0]]}
    shown, _ = in_display_units(document, units, ("m", "rad"))
    assert shown["amplitude"] == ["2 mm", "0.572958 deg"]
    assert shown["displacement"] == [["2 mm", "1 mm"], ["0.572958 deg", "0 deg"]]
    shown, units = in_display_units(document, units, ("m", "m"))
    assert units == {"amplitude": "mm", "displacement": "mm"} and shown["displacement"] == [[2.0, 1.0], [10.0, 0.0]]


def test_reports_show_infinite_numbers_that_json_omits():
    assert plain([math.inf, math.nan]) == [None, None]
    assert plain({"margin": np.asarray([-math.inf, math.nan, 1.0])}, infinity=True) == {"margin": [-math.inf, None, 1.0]}


def test_exciters_are_numbered_and_placed_with_a_unit():
    text = parameter_tables(jv.scene_from_toml(SCREENS["feeder"]))
    assert [head for head in cells(text, "h3") if head.startswith("exciter") and ":" not in head] == ["exciter 1", "exciter 2"]
    heads = [head for head in cells(text, "th") if "," in head]
    assert heads == ["at, mm", "stiffness, N/mm", "damping, N s/m", "angle, deg"]
    assert "<td>-800, -150</td><td>80, 126</td><td>300, 400</td>" in text
    table = text.partition("exciter 2<")[2]
    assert cells(table)[:2] == ["-481, -390", "mm"]


def test_frequencies_of_supplies_are_shown_in_hertz():
    motor = jv.NamePlateMotor("3 kW", "930 rpm", breakdown_ratio=2.6, inertia=0.6)
    scene = jv.Scene(jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0), exciters=[jv.Exciter(drive=motor, unbalance=0.4)])
    values = cells(parameter_tables(scene))
    assert values[values.index("Hz") - 1] == "50" and values[values.index("rpm") - 1] == "930"


@pytest.mark.parametrize(("unit", "shown", "factor"), [("m", "mm", 1e3), ("rad", "deg", 180.0 / np.pi)])
def test_values_along_one_coordinate_have_its_unit(unit, shown, factor):
    units = {"omega": "rad/s", "amplitude": "m or rad"}
    scaled, named = in_display_units({"omega": 10.0, "amplitude": [0.01]}, units, (unit,))
    assert named == {"omega": "rpm", "amplitude": shown}
    np.testing.assert_allclose(scaled["amplitude"], [0.01 * factor], rtol=1e-12)
