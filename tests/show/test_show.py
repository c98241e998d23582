"""Sketches of every machine, animations of runs and exact jams."""

import re

import equinox as eqx
import jax
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import jaxvib as jv
from jaxvib.machine.files import TEMPLATES
from jaxvib.show import moving
from jaxvib.show.animate import motion_of_orbit, motion_of_run
from jaxvib.show.sketch import _INCHES_PER_UNIT
from jaxvib.show.views import Connection, order_of_connections, view_of
from jaxvib.show.wheel import Pose, RotorPose, at_rest

SCENE = jv.Scene(
    jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25),
    jv.ConstantSpeed("60 rad/s"),
)


@pytest.fixture(scope="module")
def run():
    return jv.simulate(SCENE, 2.0, start="jam", mode=1, samples=4096, estimate=False)


@pytest.fixture(scope="module")
def orbit():
    return jv.jam_orbit(SCENE, mode=1)


def test_a_title_of_several_lines_has_its_space(monkeypatch):
    """The drawing keeps its size, and the title is inside of the figure."""
    heights = []
    for count in (1, 2, 6):
        monkeypatch.setattr("jaxvib.show.sketch.caption", lambda scene, count=count: "\n".join(["caption"] * count))
        figure = jv.sketch(SCENE)
        figure.canvas.draw()
        heights.append(figure.axes[0].get_window_extent().height / figure.dpi)
        assert figure.axes[0]._left_title.get_window_extent().y1 < figure.bbox.y1
    np.testing.assert_allclose(heights, heights[0], rtol=1e-6)


def test_a_title_wider_than_the_drawing_is_not_cut_off(monkeypatch):
    monkeypatch.setattr("jaxvib.show.sketch.caption", lambda scene: "3 balls, m = 1.33 kg each, R = 120 mm, drag 3.219 N s/m")
    figure = jv.sketch(SCENE)
    figure.canvas.draw()
    title = figure.axes[0]._left_title.get_window_extent()
    assert title.x0 >= 0.0 and title.x1 <= figure.bbox.x1


def thinned(run, every):
    """The run as it had kept fewer states."""
    return eqx.tree_at(lambda r: r.trajectory, run, jax.tree.map(lambda x: x[::every], run.trajectory))


@pytest.mark.parametrize("kind", TEMPLATES)
def test_every_machine_has_a_sketch_with_its_numbers(kind):
    scene = jv.scene_from_toml(TEMPLATES[kind])
    axis = Figure().subplots()
    assert jv.sketch(scene, ax=axis) is axis
    told = " ".join([axis.get_title(loc="left"), *(text.get_text() for text in axis.texts)])
    first = float(np.ravel(scene.machine.mass)[0])
    assert f"{first:.4g} kg" in told and "rpm" in told and f"{scene.loads.count} {scene.loads.kind.replace('_', ' ')}s" in told
    stiffness = float(np.max(np.asarray(scene.machine.stiffness)))
    assert f"{stiffness / 1e3:.4g} N/mm" in told
    # A circle for each load, and nothing outside of the figure.
    left, right, bottom, top = view_of(scene).limits
    assert all(left <= text.x <= right and bottom <= text.y <= top for text in view_of(scene).texts(at_rest(scene), 0.0))
    points = np.concatenate([part.points for part in view_of(scene).parts(at_rest(scene), 0.0)])
    points = points[np.all(np.isfinite(points), axis=1)]
    assert left <= points[:, 0].min() and points[:, 0].max() <= right
    assert bottom <= points[:, 1].min() and points[:, 1].max() <= top


def test_springs_cross_no_platform_without_an_attachment():
    ends = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3), (2, 2)]
    connections = [Connection(low, high) for low, high in ends]
    order = order_of_connections(connections, 3)
    place = {k: x for x, k in enumerate(order)}
    for k, each in enumerate(connections):
        for level in range(each.low + 1, each.high):
            own = [place[j] for j, other in enumerate(connections) if level in (other.low, other.high)]
            assert not min(own) < place[k] < max(own)


def test_forces_of_supports_add_up_to_the_force_on_the_bed():
    rng = np.random.default_rng(0)
    for kind in TEMPLATES:
        scene = jv.scene_from_toml(TEMPLATES[kind])
        view, rest = view_of(scene), at_rest(scene)
        q, v = rng.normal(size=(2, rest.displacement.size))
        total = np.sum(view.support_forces(Pose(q, v, rest.rotors)), axis=0)
        force = np.asarray(scene.machine.carrier().foundation_force(q, v))
        np.testing.assert_allclose(total[1], force[-1], rtol=1e-9)


def test_moving_parts_are_drawn_at_their_positions():
    view, rest = view_of(SCENE), at_rest(SCENE)
    turned = RotorPose((np.array([0.0, np.pi / 2.0]),), 0.0)
    pose = rest._replace(displacement=np.array([0.01]), rotors=(turned,))
    before, after = view.parts(rest, 5.0), view.parts(pose, 5.0)
    lifted = {
        float(np.round(np.mean(b.points - a.points), 6)) for a, b in zip(before, after, strict=True) if len(a.points) == 5
    }
    assert lifted == {0.025}  # the platform by 0.05 upward, not across
    balls = [part.points for part in after if len(part.points) == 31]
    middle = [np.mean(points[:-1], axis=0) for points in balls]
    np.testing.assert_allclose(middle[1] - middle[0], [-0.6, 0.6], atol=1e-9)


def test_a_run_between_its_samples(run):
    kept = run.trajectory
    t = np.asarray(kept.time)
    some = slice(1000, 1200)
    found = motion_of_run(run, t[some])
    np.testing.assert_allclose(found.displacement, kept.state.displacement[some], rtol=1e-9)
    np.testing.assert_allclose(
        np.exp(1j * found.rotors[0].angle[0]), np.exp(1j * np.asarray(kept.state.angle[0][some])), rtol=1e-9
    )
    # Every other sample, from its neighbours, is what it was.
    coarse = thinned(run, 2)
    found = motion_of_run(coarse, t[some])
    np.testing.assert_allclose(found.displacement, kept.state.displacement[some], atol=1e-5 * float(run.amplitude[0]))
    np.testing.assert_allclose(np.exp(1j * found.rotors[0].turn), np.exp(60j * t[some]), atol=1e-6)


def test_an_orbit_agrees_with_a_settled_run(orbit):
    time = np.linspace(0.0, 0.2, 50)
    found = motion_of_orbit(orbit, SCENE, time)
    force = SCENE.machine.stiffness[0] * found.displacement + SCENE.machine.damping[0] * found.velocity
    np.testing.assert_allclose(found.force, force, rtol=1e-6, atol=1e-6 * float(orbit.foundation_force))
    np.testing.assert_allclose(found.rotors[0].turn, float(orbit.rotor_speed) * time)


def test_a_film_is_a_gif_and_a_page_without_requests(run, orbit, tmp_path):
    short = dict(begin=1.5, end=1.6, seconds=0.4, width=3.0)
    animation = jv.animate(run, tmp_path / "a.gif", **short)
    left, right, bottom, top = view_of(SCENE).limits
    height = 0.8 * 3.0 * (top - bottom) / (right - left) + 2.9  # inches, with the strips below
    jv.animate(run, tmp_path / "b.gif", **short)
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == animation.count == 8 and image.size == (300, int(100.0 * height))
        first = np.asarray(image.convert("RGB"))
        image.seek(4)
        assert np.any(np.asarray(image.convert("RGB")) != first) and first[0, 0].tolist() == [255, 255, 255]
    animation.save(tmp_path / "a<b>.html")
    page = (tmp_path / "a<b>.html").read_text()
    assert not re.search(r"https?:|src=[\"']?//|<link|@import", page) and page.count("iVBOR") == 8
    assert "<title>a&lt;b&gt;</title>" in page
    clock = animation.figure.axes[0].get_title(loc="left")
    assert re.match(r"t =\s+1\.[56]\d\d s\s+foundation force\s+-?\d+ N", clock)
    assert "slowed down 4 x" in animation.figure.axes[0].texts[0].get_text()
    assert jv.animate(orbit, scene=SCENE, width=3.0).count > 50


def test_frames_are_enough_for_the_speed_that_is_shown():
    """A rotor that turns at 25 turns per second from 1 to 2 s, and has stopped before the end of the run."""
    drive = jv.SpeedProfile(times=[0.0, 1.0, 2.0, 3.0], speeds=["0 rpm", "1500 rpm", "1500 rpm", "0 rpm"])
    scene = jv.Scene(SCENE.machine, exciters=[jv.Exciter(drive=drive, unbalance=0.05)])
    run = jv.simulate(scene, 8.0, estimate=False, window_periods=10)
    assert np.max(np.abs(run.window.rotor_speeds[0])) < 1e-6
    assert jv.animate(run, begin=1.4, end=1.6, width=2.0).count >= 50


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda run, orbit: jv.sketch(3.0), "scene is 3.0; it must be a Scene"),
        (lambda run, orbit: jax.jit(lambda s: jv.sketch(s) and 0.0)(SCENE), "a drawing needs their values"),
        (lambda run, orbit: jv.animate(orbit), r"scene is missing; an Orbit does not contain it"),
        (lambda run, orbit: jv.animate(run, scene=SCENE), "scene is only for an Orbit"),
        (lambda run, orbit: jv.animate(SCENE), "it must be a Run or an Orbit"),
        (lambda run, orbit: jv.animate(run, "a.mp4"), "path is 'a.mp4'; an animation must be a .gif or .html file"),
        (lambda run, orbit: jv.animate(run, "no/such/folder.gif", begin=1.99), "cannot be written"),
        (lambda run, orbit: jv.animate(run, begin=1.0, end="0.5 s"), "end is 0.5 s; it must be after the beginning, 1 s"),
        (lambda run, orbit: jv.animate(run, end=3.0), "begin selects .* the run keeps 0 to 2 s"),
        (
            lambda run, orbit: jv.animate(run, begin=0.0, seconds=1.0),
            "end lets rotor or loads turn by 0.955 turns .* or make the animation longer",
        ),
        (lambda run, orbit: jv.animate(run, seconds=-1.0), "seconds is -1 s; it must be greater than 0"),
        (
            lambda run, orbit: jv.animate(run, seconds=40.0),
            "seconds is 40 s, which makes 800 frames; at most 600 are possible; give at most 30 s, or a lower fps",
        ),
        (lambda run, orbit: jv.animate(run, fps=0), "fps is 0; it must be a whole number"),
        (lambda run, orbit: jv.animate(run, width=-1.0), "width is -1 inches; it must be from 1 to 50"),
        (lambda run, orbit: jv.animate(run, width=np.inf), "width is inf inches"),
        (lambda run, orbit: jv.animate(run, begin=1.99, magnify=1e308), r"magnify is 1e\+308, which moves the machine out of"),
        (lambda run, orbit: jv.animate(run, magnify=-1.0), "magnify is -1; it must be greater than 0"),
        (
            lambda run, orbit: jv.animate(thinned(run, 128), begin=0.1, end=0.3),
            "run has 32 samples, between which loads turn by up to .* simulate with samples=",
        ),
        (lambda run, orbit: run.plot_path(), "machine.kind is 'one_mass', which moves only up and down"),
        (lambda run, orbit: run.spectrum(0), "parts is 0; it must be a whole number, at least 1"),
        (lambda run, orbit: run.spectrum(900), "parts is 900, which leaves 9 samples for each segment"),
        (lambda run, orbit: run.spectrum().plot(show="power"), "show is 'power'; it must be"),
        (lambda run, orbit: run.spectrum().plot(coordinate="z"), "coordinate is 'z'; there are y1"),
    ],
)
def test_what_cannot_be_shown_is_refused(run, orbit, ask, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(jv.InputError, match=says):
        ask(run, orbit)


def test_a_spectrum_has_the_height_of_the_vibration(run):
    found = run.spectrum()
    peak = int(np.argmax(found.amplitude[0, :, 0]))
    np.testing.assert_allclose(found.amplitude[0, peak, 0], run.amplitude[0], rtol=0.03)
    assert abs(found.frequency[peak] - run.omega) <= found.frequency[1]  # as finely as frequencies are computed
    figure = found.plot(unit="Hz")
    np.testing.assert_allclose(figure.axes[0].lines[0].get_xydata()[:, 1], 1e3 * found.amplitude[0, :, 0])
    assert "resonances" in [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    fall = run.spectrum(6)
    assert fall.amplitude.shape[0] == 6 and np.all(np.diff(fall.time) > 0.0)
    data = fall.to_xarray()
    assert data["amplitude"].dims == ("segment", "frequency", "coordinate")
    assert data["force"].dims[:2] == ("segment", "frequency")
    for name, unit in (("time", "s"), ("rotor_speeds", "rad/s"), ("load_speeds", "rad/s")):
        assert data[name].dims[0] == "segment" and data[name].attrs["units"] == unit
    labels = [axes.get_ylabel() for axes in fall.plot(unit="rpm").axes]
    assert labels == ["frequency, rpm", "y1, mm, zero to peak"]
    axis = Figure().subplots()
    assert fall.plot(ax=axis) is axis and axis.has_data()


def test_mode_shapes_against_the_eigenproblem():
    scene = jv.scene_from_toml(TEMPLATES["network"])
    found, carrier = jv.mode_shapes(scene), jax.tree.map(np.asarray, scene.machine.carrier())
    row = np.asarray(scene.machine.mount().rows[0])[0]
    mass = np.asarray(carrier.mass) + 2.4 * np.outer(row, row)
    for w, x in zip(np.asarray(found.frequency), np.asarray(found.shape), strict=True):
        np.testing.assert_allclose(carrier.stiffness @ x, w**2 * mass @ x, atol=1e-9 * np.max(np.abs(carrier.stiffness)))
        assert np.max(np.abs(x)) == pytest.approx(1.0)
    assert found.to_xarray()["shape"].dims == ("shape_mode", "coordinate")
    bars = [bar.get_height() for bar in found.plot().axes[0].patches]
    np.testing.assert_allclose(np.sort(bars), np.sort(np.ravel(found.shape)))


def test_forces_on_a_rotors_bed_differ_by_colour_and_stroke():
    rotor = jv.Scene(jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0), SCENE.loads, SCENE.drive)
    short = jv.simulate(rotor, 0.4, samples=256, estimate=False)
    animation = jv.animate(short, begin=0.3, end=0.4, seconds=0.4, width=2.0)
    forces = [line for line in animation.figure.axes[2].lines if line.get_label().startswith("foundation force")]
    assert len({line.get_color() for line in forces}) == len({line.get_linestyle() for line in forces}) == 2


def test_the_path_of_a_rotors_axis(run):
    rotor = jv.Scene(jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0), SCENE.loads, SCENE.drive)
    moved = 1e-3 * np.stack([np.cos(30.0 * np.asarray(run.window.time)), np.sin(30.0 * np.asarray(run.window.time))], axis=1)
    turned = eqx.tree_at(lambda r: (r.scene, r.window.state.displacement), run, (rotor, moved))
    axis = turned.plot_path().axes[0]
    across, up = axis.lines[0].get_data()
    np.testing.assert_allclose(np.stack([across, up], axis=1), 1e3 * moved[-across.size :])
    assert axis.get_aspect() == 1.0 and (axis.get_xlabel(), axis.get_ylabel()) == ("horizontal, mm", "vertical, mm")


def test_a_clockwise_rotor_has_a_path_for_each_station(run):
    bearings = dict(stiffness=(6e5, 6e5), damping=(400.0, 400.0), position=(-0.2, 0.2))
    rotor = jv.rotor(mass=37.0, transverse_inertia=0.5, polar_inertia=0.1, stations=(-0.1, 0.3), **bearings)
    scene = jv.Scene(rotor, exciters=[jv.Exciter(SCENE.loads, SCENE.drive, direction=-1)])
    moved = np.tile(np.asarray(run.window.state.displacement), (1, 4))
    turned = eqx.tree_at(lambda r: (r.scene, r.window.state.displacement), run, (scene, moved))
    names = [text.get_text() for text in turned.plot_path().axes[0].get_legend().get_texts()]
    assert [name for name in names if name.startswith("axis at")] == ["axis at -100 mm", "axis at +300 mm"]


def test_sketches_of_all_machines_have_one_scale():
    """Inches to a unit of the drawing, from machines of different height with titles of equal length."""
    heights, spans = [], []
    for kind in ("one_mass", "three_mass"):
        figure = jv.sketch(jv.Scene(jv.scene_from_toml(TEMPLATES[kind]).machine, SCENE.loads, SCENE.drive))
        heights.append(figure.get_size_inches()[1])
        spans.append(np.ptp(figure.axes[0].get_ylim()))
    assert heights[1] - heights[0] == pytest.approx(_INCHES_PER_UNIT * (spans[1] - spans[0])) and heights[1] > 1.2 * heights[0]


def test_loads_of_a_sketch_are_spread_evenly():
    loads = jv.balls(count=5, mass=0.1, radius=0.2, drag=1.0)
    (rotor,) = at_rest(jv.Scene(SCENE.machine, loads, SCENE.drive)).rotors
    turns = np.exp(1j * rotor.angle[0])
    np.testing.assert_allclose(turns[1:] / turns[:-1], np.exp(0.4j * np.pi), rtol=1e-12)


def test_velocities_of_a_moving_figure_are_those_of_its_motion(monkeypatch):
    poses = []
    monkeypatch.setattr(moving, "Pose", lambda *given: poses.append(given) or Pose(*given))
    jam = jv.jam_modes(SCENE).select(1)
    moving.moving_svg(SCENE, jam)
    place, velocity = (np.array([pose[k] for pose in poses]) for k in (0, 1))
    step = 2.0 * np.pi / (len(poses) * float(jam.omega))
    slopes = (np.roll(place, -1, axis=0) - np.roll(place, 1, axis=0)) / (2.0 * step)
    np.testing.assert_allclose(velocity, slopes, atol=0.02 * np.max(np.abs(velocity)))
