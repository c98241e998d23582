"""The explorer: sliders, figures, file, and the page that wires them, without a browser."""

import base64
import re
import socket
import threading
from xml.etree import ElementTree

import jax
import numpy as np
import pytest
import svg_charts
from scenes import TWO_MASS

import jaxvib as jv
from jaxvib.cli.app import run
from jaxvib.draw import whirl
from jaxvib.draw.style import COLORS
from jaxvib.explore import figures, server
from jaxvib.explore.campbell import _SENSE_STYLES
from jaxvib.explore.figures import SceneOrProblem, scene_or_problem
from jaxvib.explore.panel import PANEL_HEIGHT, PANEL_WIDTH, Panel
from jaxvib.explore.sliders import COUNT, scene_at, sliders_of, typed_value
from jaxvib.machine.files import SCREENS, TEMPLATES
from jaxvib.show.moving import moving_svg

SVG = "{http://www.w3.org/2000/svg}"
RPM = 30.0 / np.pi


@pytest.fixture(scope="module")
def one_mass():
    return jv.scene_from_toml(TEMPLATES["one_mass"])


@pytest.fixture(scope="module")
def two_platforms():
    return jv.scene_from_toml(TEMPLATES["two_mass"])


@pytest.mark.parametrize("kind", [*TEMPLATES, *SCREENS])
def test_sliders_at_their_starts_change_no_bit(kind):
    scene = jv.scene_from_toml({**TEMPLATES, **SCREENS}[kind])
    sliders = sliders_of(scene)
    assert all(each.start in each.steps and list(each.steps) == sorted(each.steps) for each in sliders)
    assert len({each.name for each in sliders}) == len(sliders)
    same = scene_at(scene, {each.name: each.start for each in sliders})
    assert jv.scene_to_toml(same) == jv.scene_to_toml(scene)


def test_each_slider_moves_its_number_alone():
    loads = jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5, ball_radius="20 mm")
    scene = jv.Scene(jv.two_mass(**TWO_MASS), loads, jv.ConstantSpeed("1500 rpm"))
    before = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(scene)])
    moved = []
    for each in sliders_of(scene):
        if each.name == COUNT:
            continue
        top = each.steps[-1]
        after = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(scene_at(scene, {each.name: top}))])
        (place,) = np.flatnonzero(after != before)
        assert after[place] / before[place] == pytest.approx(3.0 if each.name == "drive.speed" else 10.0, rel=1e-3)
        moved.append(place)
    # Two masses, four springs and dampers of supports, two of the link; mass, radius and drag of the loads; speed.
    assert len(set(moved)) == len(moved) == 12
    assert scene_at(scene, {COUNT: 5}).loads.count == 5
    counts = [sliders_of(scene_at(scene, {COUNT: n}))[1].steps for n in (2, 5)]
    assert [(steps[0], steps[-1]) for steps in counts] == [(1, 8), (1, 10)]  # twice as many as there are, 8 at least
    with pytest.raises(jv.InputError, match=r"loads\.ball_radius .* side by side"):
        scene_at(scene, {COUNT: 256})
    with pytest.raises(jv.InputError, match=r"machine\.mass is not a slider of this scene; the sliders are: drive\.speed"):
        scene_at(scene, {"machine.mass": 3.0})  # one slider for each platform


def test_a_typed_number_has_the_unit_of_its_slider(two_platforms):
    sliders = {each.name: each for each in sliders_of(two_platforms)}
    spring = sliders["machine.stiffness[0]"]
    assert (spring.unit, typed_value(two_platforms, spring, " 43.7 ")) == ("N/mm", 43.7)
    assert typed_value(two_platforms, spring, "0.0437 kN/mm") == pytest.approx(43.7, rel=1e-12)
    assert typed_value(two_platforms, sliders["drive.speed"], "20 Hz") == 1200.0
    assert typed_value(two_platforms, sliders[COUNT], "5") == 5.0
    moved = scene_at(two_platforms, {spring.name: 43.7, COUNT: 5.0})
    assert float(moved.machine.stiffness[0]) == pytest.approx(43700.0, rel=1e-15) and moved.loads.count == 5


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("machine.stiffness[0]", "501", r"stiffness of support 1 is 501 N/mm; the slider is from 5 to 500 N/mm"),
        ("machine.stiffness[0]", "nan", r"is nan N/mm; the slider is from 5 to 500 N/mm"),
        ("machine.stiffness[0]", "43,7", r"with a comma"),
        ("machine.stiffness[0]", "43 kg", r"is '43 kg', which is not in N/m"),
        ("machine.stiffness[0]", "", r"is '', which is not in N/m"),
        (COUNT, "2.5", r"number of loads is 2.5; it must be a whole number"),
        (COUNT, "3 kg", r"number of loads is '3 kg', which is not a plain number"),
    ],
)
def test_a_typed_text_that_does_not_fit_is_refused(two_platforms, name, text, message):
    slider = {each.name: each for each in sliders_of(two_platforms)}[name]
    with pytest.raises(jv.InputError, match=message):
        typed_value(two_platforms, slider, text)


def test_what_no_factor_can_move_has_no_slider():
    machine = jv.three_mass(
        mass=(30.0, 40.0, 20.0),
        stiffness=(0.0, 4e4, 0.0),
        damping=(0.0, 20.0, 0.0),
        link_stiffness=(1e4, 0.0, 2e4),
        link_damping=(5.0, 0.0, 7.0),
        exciter=3,
    )
    loads = jv.balls(count=2, mass=(0.8, 0.7), radius=0.12, drag=1.5)
    names = [each.name for each in sliders_of(jv.Scene(machine, loads, jv.ConstantSpeed(150.0)))]
    assert COUNT not in names  # a third ball would have no mass
    assert [name for name in names if name.startswith("machine.stiffness")] == ["machine.stiffness[1]"]
    assert [name for name in names if "link_damping" in name] == ["machine.link_damping[0]", "machine.link_damping[2]"]


def test_a_large_machine_has_a_slider_for_all_springs():
    n = 10
    machine = jv.network(
        mass=[5.0] * n,
        stiffness=[1e4] * n,
        damping=[5.0] * n,
        links=[(k, k + 1) for k in range(1, n)],
        link_stiffness=[1e4] * (n - 1),
        link_damping=[1.0] * (n - 1),
        exciter=n,
    )
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(150.0))
    titles = {each.title: each for each in sliders_of(scene)}
    every = titles["link stiffness of the machine, common factor"]
    np.testing.assert_array_equal(scene_at(scene, {every.name: 2.0}).machine.link_stiffness, np.full(n - 1, 2e4))


def test_a_rotor_has_a_campbell_diagram_with_an_explanation():
    scene = jv.scene_from_toml(TEMPLATES["planar_rotor"])
    assert "no branch diagram" in figures.heading(scene) and "critical speed" in figures.readings(scene)


def test_missing_panels_state_a_reason(one_mass):
    stop = jv.Stop(platform=1, stiffness=1e6, gap=1e-3)
    bent = jv.Scene(one_mass.machine, one_mass.loads, one_mass.drive, (stop,))
    said = figures.image(lambda: figures.diagram(bent, 100.0), SceneOrProblem(bent, ""))
    assert "<b>No figure:</b> effects.stop" in said
    no_room = scene_or_problem(lambda: jv.Scene(one_mass.machine, jv.balls(count=0, mass=1, radius=1, drag=1), one_mass.drive))
    assert figures.toml(no_room) == "" and "loads.count" in figures.text(lambda: "", no_room)


def _drawn_lines(figure: str) -> list[list[str]]:
    """The outlines in an SVG file, each the list of its points."""
    return [
        re.findall(r"[ML] ?[-.0-9]+ [-.0-9]+", path.get("d", "")) for path in ElementTree.fromstring(figure).iter(f"{SVG}path")
    ]


HOSTILE = "<img src=x onerror=alert(1)> **bold** .toml"


def test_a_files_name_is_text_on_the_page(one_mass, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXVIB_EXPLORE", str(jv.save_scene(one_mass, tmp_path / HOSTILE)))
    from jaxvib.explore.page import app

    outputs, _ = app.run()
    shown = "".join(str(getattr(output, "text", "")) for output in outputs)
    assert "&lt;img src=x onerror=alert(1)&gt; **bold** .toml" in shown
    assert "<img src=x" not in shown and "<strong>" not in shown.split("</b>")[0]


def test_the_page_follows_its_sliders(one_mass, tmp_path, monkeypatch):
    """The page is run as marimo runs it; then what it does with its sliders' values is done again at others."""
    path = jv.save_scene(one_mass, tmp_path / "ma<chine.toml")
    monkeypatch.setenv("JAXVIB_EXPLORE", str(path))
    from jaxvib.explore.page import app

    outputs, found = app.run()
    shown = "".join(str(getattr(output, "text", "")) for output in outputs)
    images = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', shown)
    diagram, machine = (base64.b64decode(image).decode() for image in images)
    assert "stable: for light loads, each of which is free to move separately" in shown and "foundation force, N" in diagram
    assert "stable for light loads, each of which is free to move separately" in diagram
    assert found["mode"].value == 1 and "jam mode 1: slowed down" in machine
    assert found["controls"].value == {each.name: each.start for each in sliders_of(one_mass)}
    assert jv.scene_to_toml(found["machine"].value) == jv.scene_to_toml(one_mass)

    moved = scene_at(one_mass, {**found["controls"].value, "machine.stiffness[0]": 200.0})
    before, after = jv.jam_modes(one_mass), jv.jam_modes(moved)
    assert float(after.resonances[0] / before.resonances[0]) == pytest.approx(2.0, rel=1e-12)
    resonance = f"{30.0 / np.pi * float(after.resonances[0]):.5g} rpm"
    assert resonance in figures.text(lambda: figures.readings(moved), SceneOrProblem(moved, ""))
    drawn = figures.diagram(moved, 4.0 / 3.0 * float(one_mass.drive.speed))
    assert max(map(len, _drawn_lines(diagram))) > 40 and _drawn_lines(drawn) != _drawn_lines(diagram)
    again = jv.scene_from_toml(figures.toml(SceneOrProblem(moved, "")))
    assert float(again.machine.stiffness[0]) == 2e5


def test_the_page_sets_a_slider_to_a_typed_number(one_mass, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXVIB_EXPLORE", str(jv.save_scene(one_mass, tmp_path / "machine.toml")))
    from jaxvib.explore.page import app

    _, found = app.run()
    before = found["starts"]()
    found["set_slider"]({"name": "stiffness of the support, N/mm", "value": "9000"})
    assert found["problem"]() == "stiffness of the support is 9000 N/mm; the slider is from 5 to 500 N/mm"
    assert found["starts"]() == before
    found["current"]["loads.mass"] = 1000.0  # a slider that was moved keeps its place
    found["set_slider"]({"name": "stiffness of the support, N/mm", "value": "43.7"})
    assert found["problem"]() == ""
    assert found["starts"]() == {**before, "machine.stiffness[0]": 43.7, "loads.mass": 1000.0}


def test_the_middle_of_the_limits_is_that_of_a_panel():
    middle = (1.0 + 0.5 * PANEL_WIDTH, 0.5 * PANEL_HEIGHT)
    assert Panel(1.0, "", (0.0, 10.0), (2.0, 6.0)).at(5.0, 4.0) == pytest.approx(middle)
    assert Panel(1.0, "", (0.0, 10.0), (1.0, 100.0), log=True).at(5.0, 10.0) == pytest.approx(middle)


@pytest.mark.parametrize("kind", ["two_mass", "network"])
def test_the_charts_lines_are_the_branches(kind):
    """Read back by the numbers at the ticks, every point of the figure's lines lies on a branch, and every jam is marked."""
    scene = jv.scene_from_toml(TEMPLATES[kind])
    most = 1.4 * float(scene.drive.speed)
    found = jax.device_get(jv.branches(scene, most=most))
    drawn = ElementTree.fromstring(figures.diagram(scene, most))
    spans = svg_charts.texts(drawn)
    wide, tall = float(drawn.get("width")), float(drawn.get("height"))
    assert all(0.0 <= x < wide and 0.0 < y < tall for x, y, _, _ in spans)  # the legend too
    titles = ("load speed, rpm", "amplitude, mm, zero to peak", "foundation force, N, zero to peak")
    starts = [x for x, _, text, _ in spans if text in titles]
    assert len(starts) == 3

    def panel(x):
        return int(np.searchsorted(starts, x + 1.0)) - 1

    names = found.scene.machine.structure().coordinates
    curves = [(0, "#004488", RPM * found.omega), (2, "#004488", found.foundation_force)]
    curves += [(1, color, 1e3 * found.amplitude[:, k]) for k, color in zip(range(len(names)), COLORS, strict=False)]
    for number, color, values in curves:
        across, up = svg_charts.axes([span for span in spans if panel(span[0]) == number], number > 0)
        lines = [line for line, _ in svg_charts.lines(drawn, color) if panel(line[0, 0]) == number]
        points = np.concatenate([line for line in lines if len(line) > 2])  # the legend has two points
        assert len(points) > 150
        heights = np.log(np.maximum(values, 1e-300)) if number else values
        there = np.stack([found.rotor_speed * RPM / across[0], heights / up[0]], axis=1)  # in dots
        line = np.stack([np.polyval(across, points[:, 0]) / across[0], np.polyval(up, points[:, 1]) / up[0]], axis=1)
        a, b = there[:-1], there[1:]
        with np.errstate(invalid="ignore"):
            share = np.clip(((line[:, None] - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1), 0.0, 1.0)
            away = np.nanmin(np.hypot(*np.moveaxis(line[:, None] - a - share[..., None] * (b - a), -1, 0)), axis=1)
        assert np.max(away) < 0.5
    assert set(names) <= {text for *_, text, _ in spans}
    jams = jv.jam_modes(scene)
    told = [int(number) for _, _, text, e in spans if e.get("font-weight") == "bold" for number in text.split(", ")]
    assert sorted(told) == sorted(3 * jams.mode_numbers())
    heights = (lambda jam: RPM * jam.omega, lambda jam: 1e3 * np.max(jam.amplitude), lambda jam: jam.foundation_force)
    for number, height_of in enumerate(heights):
        up = svg_charts.axes([span for span in spans if panel(span[0]) == number], number > 0)[1]
        for x, y, text, e in spans:
            if panel(x) == number and e.get("font-weight") == "bold" and "," not in text:
                height = float(height_of(jams.select(int(text))))
                level = np.polyval(up, y - 0.35 * 11.5)
                assert level == pytest.approx(np.log(height) if number else height, abs=2.0 * abs(up[0]))


def test_many_platforms_share_one_curve_of_amplitudes():
    n = len(COLORS) + 1
    machine = jv.network(
        mass=[5.0] * n,
        stiffness=[1e4] * n,
        damping=[5.0] * n,
        links=[(k, k + 1) for k in range(1, n)],
        link_stiffness=[1e4] * (n - 1),
        link_damping=[1.0] * (n - 1),
        exciter=n,
    )
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(150.0))
    assert "largest of 9" in figures.diagram(scene, 200.0)


@pytest.mark.parametrize("kind", ["rotor", "planar_rotor"])
def test_the_campbell_diagram_is_the_rotors_whirl(kind):
    """Read back by the numbers at the ticks, lines are the whirls of each sense, and every critical speed is written."""
    scene = jv.scene_from_toml(TEMPLATES[kind])
    most = 1.4 * float(scene.drive.speed)
    found = jax.device_get(jv.whirl(scene, np.linspace(0.0, most, figures._CAMPBELL_SPEEDS)))
    drawn = ElementTree.fromstring(figures.diagram(scene, most))
    across, up = svg_charts.axes(svg_charts.texts(drawn))
    for color, dashes, own in (("#004488", None, found.forward), ("#d55e00", "4 2", ~found.forward)):
        whirls = np.sort(RPM * np.where(own, found.speed, np.inf), axis=1)
        lines = [(line, dash) for line, dash in svg_charts.lines(drawn, color) if len(line) > 2]
        assert len(lines) == np.max(own.sum(axis=1)) and {dash for _, dash in lines} == {dashes}
        for k, (line, _) in enumerate(lines):
            right = np.interp(np.polyval(across, line[:, 0]), RPM * found.rotor_speed, whirls[:, k])
            np.testing.assert_allclose(np.polyval(up, line[:, 1]), right, atol=0.6 * abs(up[0]))
    said = " ".join(text for *_, text, _ in svg_charts.texts(drawn) if text)
    speeds = [(w, way) for w, way in zip(RPM * found.critical.speed, found.critical.forward, strict=True) if np.isfinite(w)]
    assert all(f"{w:.4g} {'forward' if way else 'backward'}" in said for w, way in speeds) and len(speeds) >= 2
    marks = [
        outline
        for outline, _ in svg_charts.lines(drawn, "#004488", filled=True) + svg_charts.lines(drawn, "#d55e00", filled=True)
    ]
    assert {len(outline) for outline, _ in svg_charts.lines(drawn, "#d55e00", filled=True)} <= {4, 5}  # squares
    assert min(len(outline) for outline, _ in svg_charts.lines(drawn, "#004488", filled=True)) > 8
    middles = np.array([(np.min(outline, axis=0) + np.max(outline, axis=0)) / 2.0 for outline in marks])
    places = np.stack([np.polyval(across, middles[:, 0]), np.polyval(up, middles[:, 1])], axis=1)
    marked = np.array([[w, w] for w, _ in speeds if w <= RPM * 1.05 * most])
    np.testing.assert_allclose(places[np.argsort(places[:, 0])], np.sort(marked, axis=0), atol=0.6 * abs(up[0]))


def test_both_charts_are_as_wide_as_the_page():
    """A machine may become a rotor without the page moving."""
    widths = set()
    for kind in ("one_mass", "planar_rotor"):
        scene = jv.scene_from_toml(TEMPLATES[kind])
        drawn = ElementTree.fromstring(figures.diagram(scene, 1.4 * float(scene.drive.speed)))
        widths.add(float(drawn.get("width")))
    assert len(widths) == 1


def test_colours_of_whirls_are_those_of_figures():
    colors = {sense: look[0] for sense, look in whirl._SENSES.items()} | {"straight": whirl._STRAIGHT_COLORS[0]}
    assert {sense: look["color"] for sense, look in _SENSE_STYLES.items()} == colors


def test_straight_motions_have_lines_in_their_style():
    rotor = TEMPLATES["planar_rotor"].replace("[loads]", 'stiffness_up = "9 N/um"\n[loads]', 1)
    drawn = figures.diagram(jv.scene_from_toml(rotor), 600.0)
    assert "straight at 0 deg" in drawn and _SENSE_STYLES["straight"]["color"] in drawn


def test_the_machine_moves_as_its_jam_says(two_platforms):
    """The figure's motion, read from its file, is the jam's: stroke and phase of platforms, loads and force arrows."""
    jam = jax.device_get(jv.jam_modes(two_platforms)).select(3)
    drawn = ElementTree.fromstring(moving_svg(two_platforms, jam))

    def shifts(texts: str) -> np.ndarray:
        (group,) = [g for g in drawn.iter(f"{SVG}g") if texts in "".join(g.itertext())]
        (motion,) = group.findall(f"{SVG}animateTransform")
        return np.array([[float(x) for x in pair.split()] for pair in motion.get("values", "").split(";")])

    platforms = [-shifts(f"M{k}")[:, 1] for k in (1, 2)]
    assert all(shift[0] == shift[-1] == 0.0 for shift in platforms)
    waves = [np.fft.rfft(shift[:-1])[1] / (0.5 * (len(shift) - 1)) for shift in platforms]
    ratio = complex(jam.displacement[0] / jam.displacement[1])
    assert complex(waves[0] / waves[1]) == pytest.approx(ratio, rel=0.01)
    assert np.angle(waves[0]) == pytest.approx(np.angle(complex(jam.displacement[0])), abs=0.02)
    turns = {e.get("dur") for e in drawn.iter(f"{SVG}animateTransform") if e.get("type") == "rotate"}
    (seconds,) = {e.get("dur") for e in drawn.iter(f"{SVG}animateTransform") if e.get("type") == "translate"}
    (once,) = turns
    assert float(seconds[:-1]) / float(once[:-1]) == pytest.approx(float(jam.rotor_speed / jam.omega), rel=1e-3)
    with pytest.raises(jv.ComputationError, match="jam mode 1 cannot be shown"):
        moving_svg(two_platforms, jv.jam_modes(two_platforms).select(1, throw=False))


@pytest.mark.parametrize("kind", TEMPLATES)
def test_every_template_has_a_figure_and_modes_to_choose(kind):
    scene = jv.scene_from_toml(TEMPLATES[kind])
    modes = figures.modes_of(scene)
    assert modes == [] if not figures.has_branches(scene) else modes[0] in jv.jam_modes(scene).mode_numbers()
    shown = figures.image(lambda: figures.machine(scene, next(iter(modes), None)), SceneOrProblem(scene, ""))
    data = shown.split("base64,")[1].split('"')[0]
    assert ElementTree.fromstring(base64.b64decode(data)).tag.endswith("svg")


def test_the_command_serves_the_page_to_this_computer_alone(one_mass, tmp_path, monkeypatch, capsys):
    import uvicorn

    path = jv.save_scene(one_mass, tmp_path / "machine.toml")
    monkeypatch.setenv("JAXVIB_EXPLORE", "")
    served = {}
    monkeypatch.setattr(uvicorn, "run", lambda page, **options: served.update(options, page=page))
    counted = threading.Event()
    monkeypatch.setattr(figures, "prepare", lambda scene: None)
    monkeypatch.setattr(figures, "prepare_counts", lambda scene: counted.set())
    monkeypatch.setattr(server, "leave", lambda: None)
    assert run(["explore", str(path), "--port", "27180", "--no-browser"]) == 0
    assert callable(served["page"]) and (served["host"], served["port"]) == ("127.0.0.1", 27180)
    assert served["log_level"] == "warning"  # no line on the terminal for each figure
    address = re.search(r"the page is at (http://127.0.0.1:27180/[-\w]{43}/);", capsys.readouterr().out)
    assert address and server.served_path() == path.resolve()
    assert counted.wait(10.0)  # beside the page, the next numbers of loads are compiled


def test_the_next_numbers_of_loads_are_prepared_first(one_mass, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "_draw_all", lambda scene: drawn.append(scene.loads.count))
    figures.prepare_counts(one_mass)
    assert one_mass.loads.count == 3 and drawn == [4, 2, 5, 1, 6, 7, 8]
    drawn.clear()
    figures.prepare_counts(jv.scene_from_toml(TEMPLATES["rotor"]))
    assert drawn == []  # its loads have stations of their own


def test_a_port_that_was_just_released_is_free():
    """Its last connection waits for a while; the side that closed first keeps it."""
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as other:
            listener.accept()[0].close()
            assert other.recv(1) == b""
    server.require_free(port)


def test_failures_of_the_page_print_one_sentence(one_mass, tmp_path, monkeypatch, capsys):
    path = str(jv.save_scene(one_mass, tmp_path / "machine.toml"))
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert run(["explore", path, "--port", str(port)]) == 2
    assert f"--port is {port}, which cannot be used" in capsys.readouterr().err
    assert run(["explore", str(tmp_path / "none.toml"), "--port", "27181"]) == 2
    assert "none.toml cannot be read" in capsys.readouterr().err
    monkeypatch.setattr(server.importlib.util, "find_spec", lambda name: None)
    assert run(["explore", path]) == 2
    assert "explore needs marimo; install it with: pip install '.[explore]'" in capsys.readouterr().err
    monkeypatch.delenv("JAXVIB_EXPLORE", raising=False)
    with pytest.raises(jv.InputError, match="start the page with: jaxvib explore"):
        server.served_path()
