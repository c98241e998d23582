"""Drawings and animations of bodies in a plane: outline, springs, exciters, ellipses, forces."""

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.draw.machine.deck import ellipses
from jaxvib.draw.machine.parts import turning_arrow
from jaxvib.show.animate import motion_of_run
from jaxvib.show.views import view_of
from jaxvib.show.wheel import at_rest

SPRINGS = [
    jv.support(at=(-1.2, -0.2), stiffness=(2e5, 4e5), damping=(2e3, 4e3), angle="20 deg"),
    jv.support(at=(1.2, -0.3), stiffness=(0.0, 4e5), damping=(0.0, 4e3)),
]
SCREEN = jv.plane_body(mass=2000.0, inertia=600.0, supports=SPRINGS)
PLACES = ((-0.3, 0.6), (0.3, 0.5))


def scene_of(loads=None):
    motor = jv.InductionMotor("1000 rpm", breakdown_torque=150.0, breakdown_slip=0.3, inertia=0.4)
    kinds = zip(PLACES, (1, -1), (loads, None), strict=True)
    each = [jv.Exciter(own, motor, unbalance=None if own else 5.0, at=at, direction=way) for at, way, own in kinds]
    return jv.Scene(SCREEN, exciters=each)


SCENE = scene_of()
BALLS = scene_of(jv.balls(count=2, mass=0.8, radius=0.12, drag=1.5))


def moved(q, reach=20.0, scene=SCENE):
    """Outlines of the parts at rest and at a displacement."""
    view, rest = view_of(scene), at_rest(scene)
    later = rest._replace(displacement=np.asarray(q, float))
    return [(a.points, b.points) for a, b in zip(view.parts(rest, reach), view.parts(later, reach), strict=True)]


def test_exciters_move_with_their_points():
    x, y, psi = 1e-3, 2e-3, 3e-3
    rims = [(a, b) for a, b in moved((x, y, psi)) if len(a) == 61]
    assert len(rims) == 4  # rim and circle of two exciters
    for k, (px, py) in enumerate(PLACES):
        before, after = (np.mean(each[:-1], axis=0) for each in rims[2 * k])
        scale = view_of(SCENE).scale
        np.testing.assert_allclose(before, scale * np.array([px, py]), atol=1e-9)
        np.testing.assert_allclose(after - before, 20.0 * np.array([x - py * psi, y + px * psi]), atol=1e-9)


def test_outline_encloses_everything_attached():
    view = view_of(SCENE)
    outline = view.parts(at_rest(SCENE), 0.0)
    (body,) = [part.points for part in outline if part.filled and part.look.get("fc") == "#c9d7e8"]
    edges = np.diff(body, axis=0)
    for at in (*PLACES, (0.0, 0.0), (-1.2, -0.2), (1.2, -0.3)):
        away = view.scale * np.asarray(at) - body[:-1]
        assert np.all(edges[:, 0] * away[:, 1] - edges[:, 1] * away[:, 0] > 0.0)  # to the left of every edge


def test_springs_end_on_the_foundation_that_stays():
    still = [a for a, b in moved((1e-3, 2e-3, 3e-3)) if np.array_equal(a, b, equal_nan=True)]
    assert len(still) == 3  # two springs of the first support, one of the second


def test_supports_add_up_to_the_force_on_the_foundation():
    q, v = np.random.default_rng(0).normal(size=(2, 3))
    pose = at_rest(SCENE)._replace(displacement=q, velocity=v)
    total = np.sum(view_of(SCENE).support_forces(pose), axis=0)
    np.testing.assert_allclose(total, SCREEN.carrier().foundation_force(q, v), rtol=1e-9)


@pytest.mark.parametrize("direction", [1, -1])
def test_arrow_turns_in_its_direction(direction):
    arc, head = turning_arrow((1.0, 2.0), 0.5, direction)
    (x, y), step = (arc[-1] - (1.0, 2.0)), head[0] - arc[-1]
    assert np.sign(x * step[1] - y * step[0]) == direction
    assert np.all(np.abs(np.hypot(*(arc - (1.0, 2.0)).T) - 0.5) < 1e-12)


@pytest.mark.parametrize("scene", [SCENE, BALLS], ids=["unbalances", "balls"])
def test_sketch_states_the_numbers_inside_its_limits(scene):
    axis = jv.sketch(scene).axes[0]
    words = " ".join([axis.get_title(loc="left"), *(text.get_text() for text in axis.texts)])
    for number in (
        "M = 2000 kg",
        "J = 600 kg m²",
        "at 20° | at 110°\n200 N/mm | 400 N/mm",
        "unbalance 5 kg m",
        "1000 rpm",
        "clockwise",
    ):
        assert number in words
    left, right, bottom, top = view_of(scene).limits
    points = np.concatenate([part.points for part in view_of(scene).parts(at_rest(scene), 0.0)])
    points = points[np.all(np.isfinite(points), axis=1)]
    assert left <= points[:, 0].min() and points[:, 0].max() <= right
    assert bottom <= points[:, 1].min() and points[:, 1].max() <= top


@pytest.fixture(scope="module")
def run():
    return jv.simulate(BALLS, 3.0, estimate=False)


def test_ellipses_of_a_deck_lie_at_their_points(run):
    deck = run.deck([(-1.0, 0.1), (1.0, 0.1)])
    figure = jv.sketch(BALLS, deck=deck)
    lines = [line for line in figure.axes[0].lines if len(line.get_xdata()) == 97]
    scale = view_of(BALLS).scale
    for line, point in zip(lines, np.asarray(deck.points), strict=True):
        np.testing.assert_allclose(np.mean(line.get_xydata()[:-1], axis=0), scale * point, atol=1e-9)
    marks = [line.get_xydata()[0] for line in figure.axes[0].lines if line.get_marker() == "o" and len(line.get_xdata()) == 1]
    np.testing.assert_array_equal(marks, [line.get_xydata()[0] for line in lines])  # where the points are at first
    notes = [text.get_text() for text in figure.axes[0].texts]
    assert any("x as large" in note and "dots: positions at one time" in note for note in notes)
    assert "x as large" in deck.plot().axes[0].get_title(loc="left")


def test_path_of_a_point_is_its_motion():
    amplitude = np.array([[1e-3 + 2e-3j, -1e-3j]])
    (path,) = ellipses(np.array([[0.5, 0.1]]), amplitude, 3.0)
    phase = np.linspace(0.0, 2.0 * np.pi, 97)
    np.testing.assert_allclose(path[:, 0], 0.5 + 3e-3 * (np.cos(phase) - 2.0 * np.sin(phase)), atol=1e-12)
    np.testing.assert_allclose(path[:, 1], 0.1 + 3e-3 * np.sin(phase), atol=1e-12)


def test_animation_shows_each_rotor_at_its_angle(run, tmp_path):
    kept = run.trajectory
    found = motion_of_run(run, np.asarray(kept.time)[3000:3010])
    for rotor, angle in zip(found.rotors, kept.rotor_angles, strict=True):
        np.testing.assert_allclose(np.exp(1j * rotor.turn), np.exp(1j * np.asarray(angle[3000:3010])), atol=1e-9)
    assert [len(rotor.angle) for rotor in found.rotors] == [1, 0]
    animation = jv.animate(run, tmp_path / "a.gif", begin=2.97, seconds=0.2)
    assert animation.count > 3 and (tmp_path / "a.gif").stat().st_size > 1000


def test_histories_have_a_line_for_each_rotor(run):
    speeds = run.plot().axes[4]
    names = [text.get_text() for text in speeds.get_legend().get_texts()]
    assert names == ["load 1", "load 2", "rotor 1", "rotor 2 (clockwise: negative)", "band: lowest to highest value"]


def test_deck_on_platforms_raises_a_clear_error(run):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25), jv.ConstantSpeed("60 rad/s"))
    with pytest.raises(jv.InputError, match="deck needs a body in a plane, not a machine of kind 'one_mass'"):
        jv.sketch(scene, deck=run.deck([(0.0, 0.0), (1.0, 0.0)]))


@pytest.mark.parametrize("distance", [0.55, 0.7, 1.5])
def test_arrow_of_an_exciter_does_not_cover_its_neighbour(distance):
    """Supports 4 m apart are drawn 6 units apart."""
    springs = [jv.support(at=(x, -0.5), stiffness=(1e6, 2e6), damping=(5e3, 7e3)) for x in (-2.0, 2.0)]
    machine = jv.plane_body(mass=6000.0, inertia=12000.0, supports=springs)
    motor = jv.DCMotor(100.0, stall_torque=100.0, inertia=1.0)
    view = view_of(jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=7.5, at=(x, 0.5)) for x in (0.0, distance)]))
    first, second = view.wheels
    assert first.rim + second.rim + 0.13 < view.scale * distance
