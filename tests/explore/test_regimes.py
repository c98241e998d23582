"""Explorer of machines whose exciters have unbalances: sliders, chart of the working regime, readings, moving sketch."""

import base64
import re
from xml.etree import ElementTree

import equinox as eqx
import jax
import numpy as np
import pytest
import svg_charts

import jaxvib as jv
from jaxvib.draw.style import COLORS
from jaxvib.explore import figures, regimes
from jaxvib.explore.figures import SceneOrProblem
from jaxvib.explore.regimes import deck_points, regime_chart, regimes_of
from jaxvib.explore.sliders import scene_at, sliders_of, typed_value
from jaxvib.machine.files import SCREENS
from jaxvib.show.moving import regime_svg
from jaxvib.steady.regimes.collected import collected_regimes

SVG = svg_charts.SVG
RPM = 30.0 / np.pi


@pytest.fixture(scope="module")
def linear():
    return jv.scene_from_toml(SCREENS["linear_screen"])


@pytest.fixture(scope="module")
def circular():
    return jv.scene_from_toml(SCREENS["circular_screen"])


def _numbers(scene):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(scene)])


def test_each_slider_of_a_screen_moves_one_number(linear):
    before, moved = _numbers(linear), {}
    for each in sliders_of(linear):
        after = _numbers(scene_at(linear, {each.name: each.steps[-1]}))
        (place,) = np.flatnonzero(after != before)
        moved[each.name] = place, after[place] - before[place], after[place] / before[place] if before[place] else np.inf
    # Per exciter: speed, unbalance, x, y, torque; per support: two springs, two dampers, an angle; mass and inertia.
    assert len({place for place, _, _ in moved.values()}) == len(moved) == 2 * 5 + 2 * 5 + 2
    assert moved["exciters[0].at[0]"][1] == pytest.approx(0.8, rel=1e-9)  # 80 steps of 10 mm
    assert moved["machine.supports[1].angle"][1] == pytest.approx(np.pi, rel=1e-9)
    assert moved["exciters[1].unbalance"][2] == pytest.approx(10.0, rel=1e-3)
    assert moved["exciters[1].drive.speed"][2] == pytest.approx(3.0, rel=1e-3)


def test_a_typed_position_or_angle_is_reached_exactly(linear):
    sliders = {each.name: each for each in sliders_of(linear)}
    x, angle = sliders["exciters[0].at[0]"], sliders["machine.supports[0].angle"]
    assert (x.unit, typed_value(linear, x, "0.5 m"), typed_value(linear, x, "-20")) == ("mm", 500.0, -20.0)
    assert (angle.unit, typed_value(linear, angle, "0.1 rad")) == ("deg", pytest.approx(18.0 / np.pi, rel=1e-11))
    moved = scene_at(linear, {x.name: -20.0, angle.name: 30.0})
    assert float(moved.exciters[0].position[0]) == pytest.approx(-0.02, rel=1e-12)
    assert float(moved.machine.supports[0].angle) == pytest.approx(np.pi / 6.0, rel=1e-12)


def _at_motor_speed(scene, speed):
    factor = speed / float(scene.top_speed)
    old = [exciter.drive.speed for exciter in scene.exciters]
    return eqx.tree_at(lambda s: [exciter.drive.speed for exciter in s.exciters], scene, [factor * each for each in old])


def test_the_chart_shows_the_working_regime_at_each_speed(linear):
    """Points of the three panels, read back by the numbers at the ticks, against `working_regime` of a changed machine."""
    drawn = ElementTree.fromstring(regime_chart(linear, 140.0))
    spans = svg_charts.texts(drawn)
    starts = [x for x, _, text, _ in spans if re.match(r"rotor speed, rpm|amplitude, mm|phase, deg", text or "")]

    def panel(x):
        return int(np.searchsorted(starts, x + 1.0)) - 1

    places = {text: panel(x) for x, _, text, _ in spans if text in {"x", "y", "psi", "exciter 2"}}
    assert places == {"x": 1, "y": 1, "psi": 1, "exciter 2": 2}  # the legend
    compared = 0
    for number, color, value in (
        (0, COLORS[0], lambda regime: RPM * regime.speed),
        (1, COLORS[1], lambda regime: 1e3 * regime.amplitude[1]),
        (1, COLORS[2], lambda regime: np.rad2deg(regime.amplitude[2])),
        (2, COLORS[0], lambda regime: np.rad2deg(regime.phases[1])),
    ):
        is_log = number == 1
        across, up = svg_charts.axes([span for span in spans if panel(span[0]) == number], is_log)
        found = [line for line, _ in svg_charts.lines(drawn, color) if panel(line[0, 0]) == number and len(line) > 2]
        points = np.concatenate(found)
        for x, y in points[:: len(points) // 3]:
            motor_speed = 140.0 / 61.0 * round(np.polyval(across, x) / RPM / (140.0 / 61.0))  # a speed of the grid
            regime = jv.working_regime(_at_motor_speed(linear, motor_speed))
            expected = float(value(regime))
            level = np.polyval(up, y)
            assert level == pytest.approx(np.log(expected) if is_log else expected, abs=0.6 * abs(up[0]))
            compared += 1
    assert compared >= 12


def test_the_chart_of_one_exciter_shows_the_force(circular):
    texts = [text for *_, text, _ in svg_charts.texts(ElementTree.fromstring(regime_chart(circular, 125.0)))]
    assert "foundation force, N, zero to peak" in texts and not any("phase" in (text or "") for text in texts)


def test_the_readings_are_regimes_and_motion_of_the_deck(linear):
    text = figures.readings(linear)
    regimes = jv.synchronous_regimes(linear)
    first = regimes.select(0)
    assert text.startswith(regimes.summary())
    assert f"foundation force {float(first.foundation_force):.4g} N" in text
    assert deck_points(linear) == [(-1.6, 0.0), (0.0, 0.0), (1.6, 0.0)]
    assert text.endswith(first.deck([(-1.6, 0.0), (0.0, 0.0), (1.6, 0.0)]).summary())


def _shifts(element):
    (motion,) = [each for each in element.findall(f"{SVG}animateTransform") if each.get("type") == "translate"]
    return np.array([[float(x) for x in pair.split()] for pair in motion.get("values", "").split(";")])[:-1]


def test_the_sketch_moves_as_the_regime(linear):
    """Shifts of the marked points of the deck have the amplitudes and the phases of the regime; rotors turn in their senses."""
    regime = regimes_of(linear)[0]
    points = deck_points(linear)
    text = regime_svg(linear, regime, points)
    drawn = ElementTree.fromstring(text)
    assert f"stable regime, {RPM * float(regime.speed):.5g} rpm" in text
    magnified = float(re.search(r"displacements drawn ([.0-9]+) x", text).group(1))
    dots = [g for g in drawn.iter(f"{SVG}g") if (p := g.find(f"{SVG}path")) is not None and p.get("fill") == "#d55e00"]
    shifts = [_shifts(g) for g in dots if len(re.findall("[ML]", g.find(f"{SVG}path").get("d"))) == 13]
    assert len(shifts) == 3
    amplitude = np.asarray(regime.deck(points).amplitude)
    body = next(p for p in drawn.iter(f"{SVG}path") if p.get("fill") == "#c9d7e8")
    width = np.ptp([float(x) for x in re.findall(r"[ML]([-.0-9]+) ", body.get("d"))])
    scale = (width - 2.0 * 0.32 * 62.0) / 3.2  # the outline is 0.32 units of 62 dots beyond the supports at -1.6 and 1.6 m
    for shift, complex_amplitude in zip(shifts, amplitude, strict=True):
        waves = np.fft.fft(shift, axis=0)[1] / (0.5 * len(shift))  # Re(U exp(i theta)) over one period
        right = complex_amplitude * np.array([1.0, -1.0]) * magnified * scale
        np.testing.assert_allclose(waves, right, atol=0.02 * np.max(np.abs(right)))
    turns = [each.get("to").split() for each in drawn.iter(f"{SVG}animateTransform") if each.get("type") == "rotate"]
    by_height = sorted({(float(y), int(turn)) for turn, _, y in turns})  # the first exciter is above the second
    assert [turn for _, turn in by_height] == [-360, 360]  # in SVG a positive angle is clockwise


@pytest.mark.parametrize("count", [3, 4])
def test_many_exciters_show_the_working_regime_alone(linear, count):
    motor, places = linear.exciters[0].drive, ((-0.8, 0.3), (0.0, 0.9), (0.8, 0.3), (0.3, -0.2))
    exciters = [jv.Exciter(drive=motor, unbalance=2.0, at=at) for at in places[:count]]
    scene = jv.Scene(linear.machine, exciters=exciters)
    (regime,) = regimes_of(scene)
    assert float(regime.growth) < 0.0 and "jaxvib regimes lists all" in figures.readings(scene)
    if count == 4:
        shown = figures.image(lambda: figures.diagram(scene, 100.0), SceneOrProblem(scene, ""))
        assert "<b>No figure:</b> exciters are 4; the chart over the motor speed is drawn for at most 3" in shown


@pytest.fixture(scope="module")
def loaded():
    """A screen with two balls in each of two exciters of opposite directions."""
    springs = [jv.support(at=(x, -0.2), stiffness=(2e5, 3e5), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    body = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    balls, drive = jv.balls(count=2, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed("900 rpm")
    exciters = [jv.Exciter(balls, drive, at=(x, 0.3), direction=way) for x, way in ((-0.3, 1), (0.3, -1))]
    return jv.Scene(body, exciters=exciters)


def test_the_page_of_loads_shows_regimes_and_their_course(loaded):
    first = regimes_of(loaded)[0]
    assert bool(first.stable) and max(np.ptp(first.phases[:2]), np.ptp(first.phases[2:])) < 1e-9
    text = figures.readings(loaded)
    one_phase_each = first.summary().replace(": 0, 0, 0, 0 deg", ": 0, 0 deg")
    assert text.startswith(one_phase_each) and "spread over the deck" in text and "e-1" not in text
    drawn = ElementTree.fromstring(figures.diagram(loaded, 126.0))
    spans = svg_charts.texts(drawn)
    starts = [x for x, _, text, _ in spans if re.match(r"load speed, rpm|amplitude, mm|phase, deg", text or "")]
    assert len(starts) == 3 and "unstable" in [text for _, _, text, _ in spans]
    in_first = [span for span in spans if span[0] + 1.0 < starts[1]]
    across, up = svg_charts.axes(in_first, False)
    lines = [line for line, _ in svg_charts.lines(drawn, COLORS[0]) if len(line) > 2 and line[0, 0] < starts[1]]
    points = np.concatenate([np.stack([np.polyval(across, line[:, 0]), np.polyval(up, line[:, 1])], 1) for line in lines])
    at = RPM * float(loaded.top_speed)
    for regime in regimes_of(loaded)[:4]:  # each line passes through the speed of its regime
        nearest = points[np.abs(points[:, 0] - at) < 40.0, 1]
        assert np.min(np.abs(nearest - RPM * float(regime.speed))) < 15.0
    animation = figures.machine(loaded, None)
    assert f"stable regime, {RPM * float(first.speed):.5g} rpm" in animation and "animate" in animation


def test_three_exciters_with_loads_have_a_page(loaded):
    middle = jv.Exciter(loaded.exciters[0].loads, loaded.exciters[0].drive, at=(0.0, 0.3))
    three = jv.Scene(loaded.machine, exciters=[loaded.exciters[0], middle, loaded.exciters[1]])
    shown = regimes_of(three)
    lines = figures.readings(three).splitlines()
    found = collected_regimes(three)
    assert len(shown) == 12 < found.speed.size and bool(shown[0].stable) and not bool(shown[-1].stable)
    assert [line.count(",") for line in lines[:12]] == [4] * 12  # three phases
    assert lines[12] == f"and {found.speed.size - 12} more regimes, none of them stable"
    texts = [text for *_, text, _ in svg_charts.texts(ElementTree.fromstring(figures.diagram(three, 126.0)))]
    assert {"exciter 2", "exciter 3", "unstable"} <= set(texts)
    assert "stable regime" in figures.machine(three, None)


def test_sliders_of_loads_change_one_exciter(loaded):
    names = {each.name: each for each in sliders_of(loaded)}
    assert len({each.title for each in names.values()}) == len(names)
    moved = scene_at(loaded, {"exciters[1].loads.count": 3, "exciters[0].loads.mass": 400.0})
    assert [exciter.loads.count for exciter in moved.exciters] == [2, 3]
    assert [float(exciter.loads.mass) for exciter in moved.exciters] == [0.4, 0.8]
    clockwise = jv.Scene(loaded.machine, exciters=[loaded.exciters[1]])
    assert scene_at(clockwise, {"loads.count": 1}).exciters[0].loads.count == 1


def test_scenes_that_the_explorer_lacks_name_a_command(linear, loaded):
    five = jv.Scene(loaded.machine, exciters=[*loaded.exciters, *loaded.exciters, linear.exciters[0]])
    with pytest.raises(jv.InputError, match=r"exciters are 5; regimes of loads are listed for at most 4 .* use jaxvib regimes"):
        figures.readings(five)
    table = jv.TorqueTable(speeds=(0.0, 90.0, 100.0), torques=(50.0, 60.0, 0.0), inertia=0.6)
    tabled = jv.Scene(linear.machine, exciters=[jv.Exciter(drive=table, unbalance=2.0, at=(0.0, 0.8))])
    shown = figures.image(lambda: figures.diagram(tabled, 100.0), SceneOrProblem(tabled, ""))
    assert "drive is &#x27;torque_table&#x27;, whose speed follows from other numbers" in shown


def test_the_page_of_a_screen_follows_its_sliders(linear, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXVIB_EXPLORE", str(jv.save_scene(linear, tmp_path / "screen.toml")))
    from jaxvib.explore.page import app

    outputs, found = app.run()
    shown = "".join(str(getattr(output, "text", "")) for output in outputs)
    images = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', shown)
    chart, sketch = (base64.b64decode(image).decode() for image in images)
    assert "No figure" not in shown and "spread over the deck" in shown
    assert "phase, deg" in chart and "stable regime" in sketch
    assert found["controls"].value == {each.name: each.start for each in sliders_of(linear)}
    moved = scene_at(linear, {**found["controls"].value, "exciters[1].unbalance": 2.28})
    assert float(regimes_of(moved)[0].amplitude[1]) < 0.8 * float(regimes_of(linear)[0].amplitude[1])
    assert figures.toml(SceneOrProblem(moved, "")) != figures.toml(SceneOrProblem(linear, ""))


def test_text_and_sketch_of_a_page_share_one_search(circular, monkeypatch):
    scene, calls = scene_at(circular, {"exciters[0].unbalance": sliders_of(circular)[1].steps[3]}), []
    monkeypatch.setattr(regimes, "synchronous_regimes", lambda each: calls.append(each) or jv.synchronous_regimes(each))
    figures.readings(scene)
    figures.machine(scene, None)
    assert len(calls) == 1 and calls[0] is scene
    figures.readings(circular)
    assert len(calls) == 2
