"""Drawings of machines: what moves is drawn where it is, parts lie beside each other."""

import numpy as np
import pytest
from scenes import rates_at

import jaxvib as jv
from jaxvib.machine.files import TEMPLATES
from jaxvib.show.views import view_of
from jaxvib.show.wheel import Wheel, at_rest

REACH = 20.0
PLATFORMS = ["one_mass", "two_mass", "three_mass", "network"]


def drawn(kind, displacement=None):
    """The scene of a template and the outlines of its view at a displacement."""
    scene = jv.scene_from_toml(TEMPLATES[kind])
    pose = at_rest(scene)
    if displacement is not None:
        pose = pose._replace(displacement=np.asarray(displacement, float))
    return scene, [part.points for part in view_of(scene).parts(pose, REACH)]


def loads_of(points):
    """Middles of the loads' outlines (n, 2): circles of 31 points."""
    return np.array([np.mean(each[:-1], axis=0) for each in points if len(each) == 31])


@pytest.mark.parametrize("kind", PLATFORMS)
def test_loads_move_with_the_exciters_platform(kind):
    scene, before = drawn(kind)
    displacement = 1e-3 * np.arange(1.0, 1.0 + len(scene.machine.structure().coordinates))
    after = drawn(kind, displacement)[1]
    platforms = [np.mean(b[:, 1] - a[:, 1]) for a, b in zip(before, after, strict=True) if len(a) == 5]
    np.testing.assert_allclose(platforms, REACH * displacement, rtol=1e-9)
    exciter = int(np.argmax(_pushed(scene)))
    np.testing.assert_allclose(
        loads_of(after) - loads_of(before), np.tile([0.0, REACH * displacement[exciter]], (3, 1)), atol=1e-12
    )


def _pushed(scene):
    """Acceleration of each platform by loads that turn on a machine at rest."""
    state = jv.initial_state(scene)
    return np.abs(np.asarray(rates_at(scene, 0.0, state).velocity))


def test_a_rotors_loads_move_across_and_up():
    _, before = drawn("planar_rotor")
    _, after = drawn("planar_rotor", [1e-3, 2e-3])
    np.testing.assert_allclose(loads_of(after) - loads_of(before), np.tile(REACH * np.array([1e-3, 2e-3]), (4, 1)), atol=1e-12)


def test_a_tilting_rotors_loads_move_by_their_stations():
    """The side view has them at their stations, moving up; the front view together, moving as the centre of mass."""
    scene, before = drawn("rotor")
    size, stations = len(scene.machine.structure().coordinates), np.asarray(scene.machine.stations)
    shift = loads_of(drawn("rotor", [1e-3, 2e-3, *[0.0] * (size - 2)])[1]) - loads_of(before)
    np.testing.assert_allclose(shift[:4], np.tile([0.0, REACH * 2e-3], (4, 1)), atol=1e-12)
    np.testing.assert_allclose(shift[4:], np.tile(REACH * np.array([1e-3, 2e-3]), (4, 1)), atol=1e-12)
    for k in range(2, size):
        tilt = 1e-3 * (np.arange(size) == k)
        shift = loads_of(drawn("rotor", tilt)[1]) - loads_of(before)
        np.testing.assert_allclose(shift[:4, 0], 0.0, atol=1e-12)
        np.testing.assert_allclose(shift[:4, 1] * stations[0], stations * shift[0, 1], atol=1e-12)
        np.testing.assert_allclose(shift[4:], 0.0, atol=1e-12)


ROTOR = dict(mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, position=(0.165, -0.155))
ACROSS = dict(stiffness=(0.6e6, 0.5e6), damping=(420.0, 410.0))
SPLIT = {
    "planar": jv.planar_rotor(mass=37.0, stiffness=1e6, damping=800.0, stiffness_up=2e6, damping_up=900.0),
    "vertical values": jv.rotor(**ROTOR, **ACROSS, stiffness_up=(0.8e6, 0.7e6), damping_up=(520.0, 510.0)),
    "terms": jv.rotor(**ROTOR, **ACROSS, stiffness_terms=(1e6, 2e4, 3e4), damping_terms=(800.0, 16.0, 20.0)),
}


@pytest.mark.parametrize("name", SPLIT)
def test_forces_of_split_supports_sum_to_the_foundation_force(name):
    scene = jv.Scene(SPLIT[name], jv.balls(count=4, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    size = len(scene.machine.structure().coordinates)
    pose = at_rest(scene)._replace(displacement=1e-3 * np.arange(1.0, 1.0 + size), velocity=0.1 * np.arange(2.0, 2.0 + size))
    carrier = scene.machine.carrier()
    total = carrier.foundation_stiffness @ pose.displacement + carrier.foundation_damping @ pose.velocity
    np.testing.assert_allclose(np.sum(view_of(scene).support_forces(pose), axis=0)[1], total[1], rtol=1e-12)


def test_values_of_split_supports_are_written_beside_them():
    texts = {}
    for name in ("planar", "vertical values"):
        scene = jv.Scene(SPLIT[name], jv.balls(count=4, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
        texts[name] = [text.text for text in view_of(scene).texts(at_rest(scene), REACH)]
    below, left = texts["planar"][:2]
    assert "2000 N/mm" in below and "1000 N/mm" in left
    assert any("800 N/mm" in text for text in texts["vertical values"])


def test_loads_are_round():
    for outline in (points for points in drawn("planar_rotor")[1] if len(points) == 31):
        away = np.hypot(*(outline - np.mean(outline[:-1], axis=0)).T)
        np.testing.assert_allclose(away, away[0], rtol=1e-9)


def test_the_cut_track_lies_in_the_middle_of_its_section():
    """Dotted, a circle of the balls' middles: the tube of the template is round."""
    scene = jv.scene_from_toml(TEMPLATES["torus"])
    parts = view_of(scene).parts(at_rest(scene), REACH)
    (track,) = [part.points for part in parts if part.look.get("ls") == ":" and len(part.points) == 61 and not part.filled][-1:]
    wall = max(
        (part.points for part in parts if part.filled and len(part.points) == 61), key=lambda points: np.mean(points[:, 0])
    )
    np.testing.assert_allclose(np.mean(track[:-1], axis=0), np.mean(wall[:-1], axis=0), atol=1e-9)


def test_both_views_of_a_rotor_have_its_loads_at_one_height():
    _, points = drawn("rotor")
    side, front = np.split(loads_of(points), 2)
    np.testing.assert_allclose(side[:, 1], front[:, 1], atol=1e-12)
    assert np.ptp(front[:, 1]) > 0.5 and np.min(front[:, 0]) > np.max(side[:, 0]) + 0.5


@pytest.mark.parametrize("kind", ["one_mass", "planar_rotor"])
def test_a_spring_and_its_damper_lie_beside_each_other(kind):
    scene = jv.scene_from_toml(TEMPLATES[kind])
    lines = [
        part.points for part in view_of(scene).parts(at_rest(scene), 0.0) if part.look.get("lw") == 1.2 and not part.filled
    ]
    spring, damper = (each[np.all(np.isfinite(each), axis=1)] for each in lines[:2])
    across = (spring[0] + spring[-1]) / 2.0 - (np.min(damper, axis=0) + np.max(damper, axis=0)) / 2.0
    along = spring[-1] - spring[0]
    assert np.hypot(*across) == pytest.approx(0.34) and abs(along @ across) < 1e-9 * np.hypot(*along)


@pytest.mark.parametrize(("ball_radius", "size"), [(None, 0.06), ("20 mm", 0.14), ("1 mm", 0.05)])
def test_the_rim_of_a_rotor_encloses_its_loads(ball_radius, size):
    loads = jv.balls(count=2, mass=0.5, radius=0.05, drag=1.0, ball_radius=ball_radius)
    wheel = Wheel(jv.Exciter(loads, jv.ConstantSpeed(100.0)), 0.35)
    assert (wheel.scale, wheel.size) == pytest.approx((7.0, size))
    assert wheel.rim == pytest.approx(0.35 + max(1.15 * size, 0.1))


@pytest.mark.parametrize("direction", [1, -1])
def test_arrows_of_rotors_lie_outside_their_rims(direction):
    wheel = Wheel(jv.Exciter(drive=jv.ConstantSpeed(100.0), unbalance=0.1, direction=direction), 0.35)
    arc, head = wheel.turning_parts((1.0, 2.0))
    np.testing.assert_allclose(np.hypot(*(arc.points - (1.0, 2.0)).T), wheel.rim + 0.13)
    assert np.all(np.hypot(*(head.points - (1.0, 2.0)).T) > wheel.rim)


def test_a_rotor_without_loads_has_a_radius_of_100_mm():
    wheel = Wheel(jv.Exciter(drive=jv.ConstantSpeed(100.0), unbalance=0.1), 0.35)
    assert (wheel.scale, wheel.size, wheel.rim) == pytest.approx((3.5, 0.06, 0.45))


MOTOR = jv.DCMotor(120.0, stall_torque=8.0, inertia=0.2)
LARGE, SMALL = (jv.balls(count=3, mass=0.8, radius=radius, drag=1.5) for radius in (0.12, 0.06))
TWO = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0)


def test_all_exciters_of_platforms_are_drawn():
    """On platform 1 a rotor with balls and one with an unbalance, which turns clockwise; on platform 2 smaller balls."""
    exciters = [
        jv.Exciter(LARGE, MOTOR, at=1),
        jv.Exciter(drive=MOTOR, unbalance=0.3, at=1, direction=-1),
        jv.Exciter(SMALL, MOTOR, at=2),
    ]
    scene = jv.Scene(TWO, exciters=exciters)
    view, rest = view_of(scene), at_rest(scene)
    before, after = (view.parts(rest._replace(displacement=np.array(y)), REACH) for y in ([0.0, 0.0], [0.01, 0.02]))
    rims = [k for k, part in enumerate(before) if part.look.get("fc") == "#f4f4f4"]
    lifts = [np.mean(after[k].points - before[k].points, axis=0) for k in rims]
    np.testing.assert_allclose(lifts, [[0.0, 0.2], [0.0, 0.2], [0.0, 0.4]], atol=1e-12)
    balls = loads_of([part.points for part in before])
    radii = [np.hypot(*(balls[3 * k] - balls[3 * k + 1])) / np.sqrt(3.0) for k in range(2)]
    np.testing.assert_allclose(radii, [0.6, 0.3], rtol=1e-9)  # to one scale
    assert view.scale == pytest.approx(5.0)
    boxes = [(np.min(before[k].points, axis=0), np.max(before[k].points, axis=0)) for k in rims]
    first, second = boxes[:2]
    assert first[1][0] < second[0][0] or second[1][0] < first[0][0]
    texts = {text.text: text for text in view.texts(rest, REACH)}
    assert {"1", "2", "3", "M1 = 120 kg", "M2 = 95 kg"} <= set(texts)
    for low, high in boxes:
        for name in ("M1 = 120 kg", "M2 = 95 kg"):
            assert not (low[0] < texts[name].x < high[0] and low[1] < texts[name].y < high[1])
    heads = [part.points for part in before if part.look.get("zorder") == 3.7 and part.filled]
    turns = [np.mean(head[:, 0]) - np.mean(before[k].points[:-1, 0]) for head, k in zip(heads, rims, strict=True)]
    assert np.sign(turns).tolist() == [-1.0, 1.0, -1.0]  # an arrow above an anticlockwise rotor points to the left


def test_several_exciters_of_a_rotor_are_refused_by_drawings():
    machine = jv.planar_rotor(mass=37.0, stiffness=1e6, damping=800.0)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=MOTOR, unbalance=0.01), jv.Exciter(SMALL, MOTOR)])
    sentence = "scene has 2 exciters; on a machine of kind 'planar_rotor' a drawing shows one"
    with pytest.raises(jv.InputError, match=sentence):
        jv.sketch(scene)
