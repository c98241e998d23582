"""The explorer: sliders, pictures, file, and the page that wires them, without a browser."""

import base64
import re
import socket
import threading
from xml.etree import ElementTree

import jax
import numpy as np
import pytest
from scenes import TWO_MASS

import jaxvib as jv
from jaxvib.cli.app import run
from jaxvib.explore import charts, pictures, serve
from jaxvib.explore.pictures import SceneOrProblem, scene_or_problem
from jaxvib.explore.sliders import COUNT, scene_at, sliders_of
from jaxvib.machine.files import TEMPLATES
from jaxvib.show.moving import moving_svg

SVG = "{http://www.w3.org/2000/svg}"
RPM = 30.0 / np.pi


@pytest.fixture(scope="module")
def one_mass():
    return jv.scene_from_toml(TEMPLATES["one_mass"])


@pytest.fixture(scope="module")
def two_platforms():
    return jv.scene_from_toml(TEMPLATES["two_mass"])


@pytest.mark.parametrize("kind", TEMPLATES)
def test_sliders_at_their_starts_change_no_bit(kind):
    scene = jv.scene_from_toml(TEMPLATES[kind])
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
    assert len(set(moved)) == len(moved) == 9  # four springs and dampers of supports, two of the link, mass, drag, speed
    assert scene_at(scene, {COUNT: 5}).loads.count == 5
    counts = [sliders_of(scene_at(scene, {COUNT: n}))[1].steps for n in (2, 5)]
    assert [(steps[0], steps[-1]) for steps in counts] == [(1, 8), (1, 10)]  # twice as many as there are, 8 at least
    with pytest.raises(jv.InputError, match=r"loads\.ball_radius .* side by side"):
        scene_at(scene, {COUNT: 256})
    with pytest.raises(jv.InputError, match=r"machine\.mass is not a slider of this scene; the sliders are: drive\.speed"):
        scene_at(scene, {"machine.mass": 3.0})


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


def test_a_rotor_has_a_campbell_diagram_and_a_sentence_why():
    scene = jv.scene_from_toml(TEMPLATES["planar_rotor"])
    assert "no branch diagram" in pictures.heading(scene) and "critical speed" in pictures.readings(scene)


def test_what_cannot_be_shown_is_said(one_mass):
    stop = jv.Stop(platform=1, stiffness=1e6, gap=1e-3)
    bent = jv.Scene(one_mass.machine, one_mass.loads, one_mass.drive, (stop,))
    said = pictures.figure(lambda: pictures.diagram(bent, 100.0), SceneOrProblem(bent, ""))
    assert "<b>No figure:</b> effects.stop" in said
    no_room = scene_or_problem(lambda: jv.Scene(one_mass.machine, jv.balls(count=0, mass=1, radius=1, drag=1), one_mass.drive))
    assert pictures.toml(no_room) == "" and "loads.count" in pictures.text(lambda: "", no_room)


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
    (machine,) = (base64.b64decode(image).decode() for image in re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', shown))
    diagram = found["chart"]
    assert "yes, if they stay together" in shown and "<marimo-plotly" in shown and "foundation force, N" in shown
    assert found["mode"].value == 1 and "jam mode 1, stable by slope" in machine
    assert found["controls"].value == {each.name: each.start for each in sliders_of(one_mass)}
    assert jv.scene_to_toml(found["machine"].value) == jv.scene_to_toml(one_mass)

    moved = scene_at(one_mass, {**found["controls"].value, "machine.stiffness[0]": 200.0})
    before, after = jv.jam_modes(one_mass), jv.jam_modes(moved)
    assert float(after.resonances[0] / before.resonances[0]) == pytest.approx(2.0, rel=1e-12)
    resonance = f"{30.0 / np.pi * float(after.resonances[0]):.5g} rpm"
    assert resonance in pictures.text(lambda: pictures.readings(moved), SceneOrProblem(moved, ""))
    drawn = pictures.diagram(moved, 4.0 / 3.0 * float(one_mass.drive.speed))
    before, after = (_traces(figure, "stable")[0] for figure in (diagram, drawn))
    assert len(before) > 40 and (len(before) != len(after) or not np.array_equal(before, after, equal_nan=True))
    again = jv.scene_from_toml(pictures.toml(SceneOrProblem(moved, "")))
    assert float(again.machine.stiffness[0]) == 2e5


def _traces(figure, name, panel=1):
    """Return the points (n, 2) of the traces with this name in one chart."""
    own = [t for t in figure.data if t.name == name and t.xaxis == ("x" if panel == 1 else f"x{panel}")]
    return [np.stack([t.x, t.y], axis=1).astype(float) for t in own]


@pytest.mark.parametrize("kind", ["two_mass", "network"])
def test_lines_of_the_chart_are_the_branches(kind):
    scene = jv.scene_from_toml(TEMPLATES[kind])
    most = 1.4 * float(scene.drive.speed)
    found = jax.device_get(jv.branches(scene, most=most))
    figure = pictures.diagram(scene, most)
    for panel, values in ((1, RPM * found.omega), (2, found.foundation_force)):
        drawn = np.concatenate([points for name in ("stable", "unstable") for points in _traces(figure, name, panel)])
        drawn = drawn[np.isfinite(drawn[:, 0])]
        there = {(x, y): stable for x, y, stable in zip(RPM * found.rotor_speed, values, found.stable, strict=True)}
        assert len(drawn) > 100 and all((x, y) in there for x, y in drawn.tolist())
        for name, stable in (("stable", True), ("unstable", False)):
            (points,) = _traces(figure, name, panel)
            same = [there[x, y] == stable for x, y in points.tolist() if np.isfinite(x)]
            assert np.mean(same) > 0.9  # a line begins and ends at points of the neighbouring line
        limits = figure.layout[f"yaxis{panel}"].range
        inside = np.log10(drawn[:, 1]) if panel == 2 else drawn[:, 1]
        assert limits[0] <= np.median(inside) <= limits[1]
    modes = jv.jam_modes(scene).mode_numbers()
    marked = [text for trace in figure.data if trace.name == "jam mode" for text in trace.text]
    assert sorted(marked) == sorted(2 * [f"jam mode {mode}" for mode in modes])


def test_points_of_a_line_are_drawn_without_near_neighbours():
    kept = charts._kept(np.stack([np.linspace(0.0, 1.0, 2001), np.zeros(2001)], axis=1))
    assert 190 <= kept.sum() <= 202 and kept[0] and kept[-1]
    gap = np.array([[0.0, 0.0], [1e-6, 0.0], [np.nan, 0.0], [2e-6, 0.0], [3e-6, 0.0], [4e-6, 0.0]])
    assert charts._kept(gap).tolist() == [True, True, True, True, False, True]


@pytest.mark.parametrize("kind", ["rotor", "planar_rotor"])
def test_lines_of_the_campbell_diagram_are_the_whirls(kind):
    scene = jv.scene_from_toml(TEMPLATES[kind])
    most = 1.4 * float(scene.drive.speed)
    found = jax.device_get(jv.whirl(scene, np.linspace(0.0, most, pictures._SPEEDS)))
    figure = pictures.diagram(scene, most)
    for name, own in (("forward whirl", found.forward), ("backward whirl", ~found.forward)):
        (points,) = _traces(figure, name)
        drawn = points[np.isfinite(points).all(axis=1)]
        expected = RPM * np.stack([np.broadcast_to(found.rotor_speed[:, None], own.shape)[own], found.speed[own]], axis=1)
        order = [np.lexsort(values.T[::-1]) for values in (drawn, expected)]
        np.testing.assert_allclose(drawn[order[0]], expected[order[1]], rtol=1e-12)
        critical = RPM * found.critical.speed[np.asarray(found.critical.forward) == (name == "forward whirl")]
        (places,) = _traces(figure, f"critical, {name}")
        shown = np.sort(critical[np.isfinite(critical) & (critical <= RPM * 1.05 * most)])
        np.testing.assert_allclose(np.sort(places, axis=0), np.stack([shown, shown], axis=1))
    said = " ".join(text for trace in figure.data if trace.mode == "text" for text in trace.text)
    assert all(f"{RPM * w:.4g}" in said for w in found.critical.speed[np.isfinite(found.critical.speed)])


def test_the_machine_moves_as_its_jam_says(two_platforms):
    """The picture's motion, read from its file, is the jam's: stroke and phase of platforms, loads and force arrows."""
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
def test_every_template_has_a_picture_and_modes_to_choose(kind):
    scene = jv.scene_from_toml(TEMPLATES[kind])
    modes = pictures.modes_of(scene)
    assert modes == [] if not pictures.has_branches(scene) else modes[0] in jv.jam_modes(scene).mode_numbers()
    shown = pictures.image(lambda: pictures.machine(scene, next(iter(modes), None)), SceneOrProblem(scene, ""))
    data = shown.split("base64,")[1].split('"')[0]
    assert ElementTree.fromstring(base64.b64decode(data)).tag.endswith("svg")


def test_the_command_serves_the_page_to_this_computer_alone(one_mass, tmp_path, monkeypatch, capsys):
    import uvicorn

    path = jv.save_scene(one_mass, tmp_path / "machine.toml")
    monkeypatch.setenv("JAXVIB_EXPLORE", "")
    served = {}
    monkeypatch.setattr(uvicorn, "run", lambda page, **options: served.update(options, page=page))
    counted = threading.Event()
    monkeypatch.setattr(pictures, "prepare", lambda scene: None)
    monkeypatch.setattr(pictures, "prepare_counts", lambda scene: counted.set())
    monkeypatch.setattr(serve, "leave", lambda: None)
    assert run(["explore", str(path), "--port", "27180", "--no-browser"]) == 0
    assert callable(served["page"]) and (served["host"], served["port"]) == ("127.0.0.1", 27180)
    assert served["log_level"] == "warning"  # no line on the terminal for each picture
    address = re.search(r"the page is at (http://127.0.0.1:27180/[-\w]{43}/);", capsys.readouterr().out)
    assert address and serve.served_path() == path.resolve()
    assert counted.wait(10.0)  # beside the page, the next numbers of loads are compiled


def test_the_next_numbers_of_loads_are_prepared_first(one_mass, monkeypatch):
    drawn = []
    monkeypatch.setattr(pictures, "_draw_all", lambda scene: drawn.append(scene.loads.count))
    pictures.prepare_counts(one_mass)
    assert one_mass.loads.count == 3 and drawn == [4, 2, 5, 1, 6, 7, 8]
    drawn.clear()
    pictures.prepare_counts(jv.scene_from_toml(TEMPLATES["rotor"]))
    assert drawn == []  # its loads have stations of their own


def test_what_hinders_the_page_is_one_sentence(one_mass, tmp_path, monkeypatch, capsys):
    path = str(jv.save_scene(one_mass, tmp_path / "machine.toml"))
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert run(["explore", path, "--port", str(port)]) == 2
    assert f"--port is {port}, which cannot be used" in capsys.readouterr().err
    assert run(["explore", str(tmp_path / "none.toml"), "--port", "27181"]) == 2
    assert "none.toml cannot be read" in capsys.readouterr().err
    monkeypatch.setattr(serve.importlib.util, "find_spec", lambda name: None)
    assert run(["explore", path]) == 2
    assert "explore needs marimo; install it with: pip install '.[explore]'" in capsys.readouterr().err
    monkeypatch.delenv("JAXVIB_EXPLORE", raising=False)
    with pytest.raises(jv.InputError, match="start the page with: jaxvib explore"):
        serve.served_path()
