"""Reports: one web page that asks for nothing, whose text cannot be code, with units and what the result is worth."""

import base64
import html.parser
import math
import re

import matplotlib
import pytest
from matplotlib.figure import Figure
from plugins.machine import Beam
from scenes import scene
from small_machine import small_run

import jaxvib as jv
from jaxvib.cli.app import run
from jaxvib.machine.files import TEMPLATES
from jaxvib.report.page import Report, units_of, units_of_document
from jaxvib.report.tables import TextTable, mark_of
from jaxvib.study.accuracy.cost import CostRow

RESULT = jv.Cost("amplitude", [1.0], 1e-9, [CostRow("full", "Tsit5", "float64", "1e-3", math.nan, 0.1, 1.0)])

HOSTILE = "<script>alert('x')</script>&\"<img src=http://evil.example/x onerror=alert(1)>"


class Page(html.parser.HTMLParser):
    """Tags of a page, whether each is closed, and the targets of their attributes."""

    VOID = ("meta", "img", "br")

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.links, self.text = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        assert not any(name.startswith("on") for name, _ in attrs)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def checked(text):
    """The page, after a look at what no report may have."""
    page = Page(text)
    assert page.open == [] and text.startswith("<!doctype html>")
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(page.tags)
    assert all(link.startswith("data:image/png;base64,") for link in page.links)
    assert "default-src 'none'" in text and "@import" not in text and "url(" not in text
    return page


def test_text_cannot_become_code():
    """Names, commands, keys and values of a document, figure names: all of them hostile."""
    figure = Figure(figsize=(1.0, 1.0))
    document = {HOSTILE: HOSTILE, "status": HOSTILE, "rows": [{HOSTILE: HOSTILE}], "inner": {HOSTILE: [HOSTILE] * 20}}
    report = Report(HOSTILE, document, {HOSTILE: HOSTILE, "rows": HOSTILE}, HOSTILE, HOSTILE, None, [(HOSTILE, figure)])
    text = report.html()
    page = checked(text)
    assert "evil.example" not in "".join(page.links) and "<script" not in text
    assert HOSTILE in "".join(page.text)


def test_a_scene_file_with_a_hostile_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    name = "a<script>alert(1)<b>.toml"
    (tmp_path / name).write_text("# " + HOSTILE + "\n" + jv.scene_to_toml(scene("two_mass", speed=150.0)))
    monkeypatch.setattr("jaxvib.sketch", lambda scene: Figure(figsize=(1.0, 1.0)), raising=False)
    assert run(["modes", name, "--report", "deep/er/report.html"]) == 0
    assert "wrote deep/er/report.html" in capsys.readouterr().out
    text = (tmp_path / "deep" / "er" / "report.html").read_text()
    page = checked(text)
    said = " ".join(page.text)
    assert name in said and "evil.example" not in text
    assert "Machine" in said and "N s/m" in said and "free to move separately" in said and len(page.links) == 2
    assert "y1, mm" in said and "m or rad" not in said and "rotor, rpm" in said and "jaxvib" in said


def test_numbers_that_are_not_finite_and_long_lists():
    document = {"error": math.nan, "omega": list(range(40)), "table": [[1.0, 2.0]] * 300, "empty": [], "flag": True}
    page = checked(Report("x", {**document, "error": None}, {"omega": "rad/s"}).html())
    said = " ".join(page.text)
    assert "40 numbers from 0 to 372.4" in said and "100 more rows" in said and "yes" in said and "omega, rpm" in said


@pytest.mark.parametrize("kind", TEMPLATES)
def test_parameters_of_every_template_have_units(kind, tmp_path):
    path = jv.html_report(RESULT, tmp_path / "r.html", scene=jv.scene_from_toml(TEMPLATES[kind]), figures=[])
    text = path.read_text()
    checked(text)
    assert "<td class='unit'>kg</td>" in text and "<td class='unit'>rpm</td>" in text
    assert RESULT.message in text


def test_the_machine_is_that_of_the_run_or_of_the_argument(tmp_path):
    run, other = small_run(), jv.scene_from_toml(TEMPLATES["network"])
    own = jv.html_report(run, tmp_path / "own.html", figures=[]).read_text()
    given = jv.html_report(run, tmp_path / "given.html", scene=other, figures=[]).read_text()
    assert f"<h3>machine: {run.scene.machine.kind.replace('_', ' ')}</h3>" in own and "<h3>machine: network</h3>" in given


@pytest.mark.parametrize(
    "make",
    [
        lambda: jv.from_matrices([[52.5]], [[30.0]], [[4e4]], places=[[0]]),
        lambda: Beam(52.5, 12.0, [4e4, 4e4], [-1.0, 1.0], 0.1),
    ],
    ids=["matrices", "plugin"],
)
def test_a_machine_that_no_scene_file_describes_is_shown(make, tmp_path):
    scene = jv.Scene(make(), jv.balls(count=2, mass="410 g", radius=0.1, drag=1.0), jv.ConstantSpeed(90.0))
    text = jv.html_report(RESULT, tmp_path / "r.html", scene=scene, figures=[]).read_text(encoding="utf-8")
    assert "52.5" in text and "410 g" in text


def test_figures_are_png_whatever_matplotlib_saves_by_default():
    with matplotlib.rc_context({"savefig.format": "svg"}):
        text = Report("x", {}, figures=[("a", Figure(figsize=(1.0, 1.0)))]).html()
    assert base64.b64decode(checked(text).links[0].split(",")[1]).startswith(b"\x89PNG")


def test_units_follow_the_fields():
    units = units_of(small_run())
    assert units["omega"] == "rad/s" and units["foundation_force"] == "N" and units["time"] == "s" and "steps" not in units


def test_wrong_input(tmp_path, capsys):
    with pytest.raises(jv.InputError, match=r"result is .*; it must be a Result"):
        jv.html_report({}, tmp_path / "r.html")
    with pytest.raises(jv.InputError, match="cannot be written"):
        jv.html_report(RESULT, tmp_path / "none" / "r.html", figures=[])
    assert run(["describe", "--report", str(tmp_path / "r.pdf")]) == 2
    assert "--report is" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert run(["describe", "--report", str(tmp_path / "file" / "r.html")]) == 2
    assert "cannot be created" in capsys.readouterr().err


def test_values_of_a_search_are_shown_with_their_units_only():
    row = {"what": "speed", "unit": "rad/s", "before": 104.4, "after": 104.5}
    page = Report("", {"before": {"omega": 104.4}, "after": {"omega": 104.5}, "verified": None, "table": [row]}, {}).html()
    assert page.count("104.4") == page.count("104.5") == page.count("rad/s") == 1 and "omega" not in page


def test_a_page_with_a_text_has_no_numbers_without_units():
    row = {"words": "speed", "unit": "rad/s", "design": 104.4}
    document = {"tolerances": [row], "table": [row], "kkt": 1e-11, "drawn": 768, "coordinates": ["y1"], "units": ["m"]}
    page = Report("", document | {"unverified": ""}, {}, text="speed 997 rpm").html()
    assert "speed 997 rpm" in page and "y1" in page
    assert not re.search("104.4|rad/s|kkt|768|unverified|<td>m</td>", page)


def test_tables_of_a_text_are_not_repeated():
    """The table of jams shows the speeds of the jams; the text of other rows is not in it, and they stay."""
    table = TextTable("<jams>", ["mode", "rpm"], [["1", "95.49"], ["2", "190.99"]])
    document = {"modes": [{"omega": 10.0}, {"omega": 20.0}], "folds": [{"omega": 30.0}]}
    text = f"(above)\n{mark_of(0)}\n(below)"
    page = Report("", document, {"omega": "rad/s"}, text=text, tables=[table]).html()
    checked(page)
    assert page.count("95.49") == 1 and page.count("286.4") == 1 and "\0" not in page
    assert page.index("(above)") < page.index("&lt;jams&gt;") < page.index("190.99") < page.index("(below)")


def test_a_report_of_a_command_has_no_table_in_characters(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "machine.toml").write_text(jv.scene_to_toml(scene("two_mass", speed=150.0)))
    assert run(["modes", "machine.toml", "--report", "r.html"]) == 0
    page = (tmp_path / "r.html").read_text()
    assert "<h3>jam modes (light loads)</h3>" in page and not re.search("[┏┃│]|<h3>(modes|folds)</h3>", page)


def test_regimes_phases_and_exact_ranges_have_units():
    document = {"regime": {"resonance_speed": 61.2, "ripple": 2.2}, "phases": [0.0, 1.0], "exact_balancing": [[24.8, 45.8]]}
    page = Report("", document, units_of_document(document, None)).html()
    assert all(shown in page for shown in ("584.417", "21.0085", "57.2958", "exact balancing, rpm"))


@pytest.mark.parametrize("document", [{"measures": {"stroke": [0.002]}}, {"regimes": [{"measures": {"stroke": [0.002]}}]}])
def test_measures_in_documents_of_commands_have_units(document):
    page = Report("", {**document, "natural_frequencies": [10.0]}, units_of_document(document, None)).html()
    assert "rpm" in page and re.search(r"stroke( 2 mm|</th><td>2</td><td class='unit'>mm)", page)
    assert "stroke" not in units_of_document({"regimes": []}, None)
    modes, drags = [{"mode": 5, "growth_of_free_loads": 13.2}], [{"drag": 0.7, "factor": 0.5}]
    page = Report("", {"modes": modes, "drag_limits": drags}, units_of_document({}, None)).html()
    assert "growth of free loads, 1/s" in page and "drag, N s/m" in page
