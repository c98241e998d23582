"""Ellipses of points: closed forms, circles, lines, decks, and the harmonic of a run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.motion.analysis.points import fit_harmonic
from jaxvib.steady.points import Harmonic, PathsOfPoints
from jaxvib.steady.vibration import largest_extent

SPEED, G = 90.0, 9.80665


def turned(a, b, angle, phase, sense):
    """Complex amplitudes of an ellipse with known axes: written as a rotation of (a cos, sense b sin)."""
    c, s = np.cos(angle), np.sin(angle)
    own = np.exp(1j * phase) * np.array([a, -1j * sense * b])
    return jnp.asarray(np.array([[c, -s], [s, c]]) @ own)


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("angle", [-1.4, -0.3, 0.0, 0.7, 1.5])
def test_ellipse_has_the_axes_it_was_made_of(angle, sense):
    found = jv.ellipse_of(turned(4e-3, 1e-3, angle, 0.9, sense), SPEED)
    np.testing.assert_allclose([found.semi_major, found.semi_minor], [4e-3, sense * 1e-3], rtol=1e-12)
    np.testing.assert_allclose(found.direction, angle, atol=1e-12)
    assert float(found.sense) == sense and not bool(found.is_circle)
    np.testing.assert_allclose(found.acceleration, SPEED**2 * 4e-3 / G, rtol=1e-12)


def test_axes_are_extremes_of_the_path():
    rng = np.random.default_rng(1)
    amplitude = rng.normal(size=2) + 1j * rng.normal(size=2)
    found = jv.ellipse_of(jnp.asarray(amplitude), SPEED)
    phase = np.linspace(0.0, 2.0 * np.pi, 200001)
    path = np.real(np.exp(1j * phase)[:, None] * amplitude)
    away = np.hypot(*path.T)
    np.testing.assert_allclose([np.max(away), np.min(away)], [found.semi_major, abs(found.semi_minor)], rtol=1e-8)
    across, up = path[np.argmax(away)]
    np.testing.assert_allclose(np.tan(found.direction), up / across, rtol=1e-4)
    area = 0.5 * np.sum(path[:-1, 0] * path[1:, 1] - path[1:, 0] * path[:-1, 1])
    np.testing.assert_allclose(area, np.pi * found.semi_major * found.semi_minor, rtol=1e-8)


@pytest.mark.parametrize("sense", [1, -1])
def test_circle_has_no_direction_and_finite_derivatives(sense):
    amplitude = jnp.array([2e-3 + 0.0j, -2e-3j * sense])
    found = jv.ellipse_of(amplitude, SPEED)
    assert bool(found.is_circle) and float(found.direction) == 0.0 and float(found.sense) == sense
    assert "a circle" in found.summary()

    def axes(parts):
        each = jv.ellipse_of(parts[0] + 1j * parts[1], SPEED)
        return jnp.stack([each.semi_major, each.semi_minor, each.direction, each.throw_number])

    parts = jnp.stack([amplitude.real, amplitude.imag])
    assert np.all(np.isfinite(jax.jacrev(axes)(parts))) and np.all(np.isfinite(jax.jacrev(axes)(0.0 * parts)))


def test_derivatives_equal_finite_differences():
    def axes(parts):
        each = jv.ellipse_of(parts[:2] + 1j * parts[2:], SPEED, slope=-0.2)
        return jnp.stack([each.semi_major, each.semi_minor, each.direction, each.throw_number])

    x = jnp.array([1.0, 0.4, -0.3, 0.9])
    steps = [(axes(x + 1e-6 * e) - axes(x - 1e-6 * e)) / 2e-6 for e in jnp.eye(4)]
    np.testing.assert_allclose(jax.jacfwd(axes)(x), np.stack(steps, 1), rtol=1e-7, atol=1e-7)


def test_throw_number_is_normal_to_the_deck():
    """A point that moves along a deck that falls by 15 degrees does not throw; one normal to it throws by w^2 a/(g cos)."""
    slope = np.radians(-15.0)
    for angle, expected in ((slope, 0.0), (slope + np.pi / 2, SPEED**2 * 4e-3 / (G * np.cos(slope)))):
        amplitude = 4e-3 * jnp.array([np.cos(angle), np.sin(angle)]) * (1.0 + 0.0j)
        np.testing.assert_allclose(jv.ellipse_of(amplitude, SPEED, slope=slope).throw_number, expected, atol=1e-12)


@pytest.mark.parametrize("sense", [1, -1])
def test_negative_speed_reverses_the_sense(sense):
    found = jv.ellipse_of(turned(4e-3, 1e-3, 0.7, 0.9, sense), -SPEED, slope=-0.2)
    forward = jv.ellipse_of(turned(4e-3, 1e-3, 0.7, -0.9, -sense), SPEED, slope=-0.2)
    assert float(found.sense) == -sense
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(forward), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_straight_path_has_no_sense_in_single_precision():
    angle, phase = np.random.default_rng(3).uniform(-1.5, 1.5, (2, 60))
    lines = 4e-3 * np.stack([np.cos(angle), np.sin(angle)], 1) * np.exp(1j * phase)[:, None]
    found = [jv.ellipse_of(jnp.asarray(line, jnp.complex64), jnp.float32(SPEED)) for line in lines]
    assert all(float(each.sense) == 0.0 and each.semi_minor.dtype == jnp.float32 for each in found)


def test_point_at_rest_and_deck_that_only_turns():
    class Turning(PathsOfPoints):
        def harmonic(self):
            return Harmonic(SCREEN, jnp.asarray(SPEED), jnp.array([0.0, 0.0, 1e-3j]))

    turning = Turning()
    still, moving = turning.ellipse(), turning.ellipse((1.0, 0.0))
    assert float(still.remainder) == float(moving.remainder) == float(still.semi_major) == 0.0
    assert np.isposinf(turning.deck([(-1.0, 0.0), (1.0, 0.0)]).motion_spread)
    assert float(turning.deck([(0.0, 0.0), (0.0, 0.0)]).motion_spread) == 0.0


SPRINGS = [jv.support(at=(x, -0.2), stiffness=(2e5, 4e5), damping=(2e4, 4e4)) for x in (-1.2, 1.2)]
SCREEN = jv.plane_body(mass=2000.0, inertia=600.0, supports=SPRINGS)


class Known(PathsOfPoints):
    """Result with given complex amplitudes, as steady motions have."""

    amplitude: jax.Array

    def harmonic(self):
        return Harmonic(SCREEN, jnp.asarray(SPEED), self.amplitude)


def test_moment_about_a_point_too_far_away_has_a_status():
    with pytest.raises(jv.ComputationError, match=r"^overflow: parts of the foundation moment are not finite"):
        Known(jnp.array([3e-3 + 0j, 3e-3, 0.0])).foundation_moment(about=(1e308, 0.0))
    assert np.isnan(Known(jnp.array([jnp.nan + 0j, 3e-3, 0.0])).foundation_moment())  # without a motion


def test_deck_of_a_translation_has_no_spread():
    deck = Known(jnp.array([3e-3 + 0j, 3e-3, 0.0])).deck([(-1.0, 0.2), (0.0, 0.2), (1.0, 0.2)])
    np.testing.assert_allclose(deck.motion_spread, 0.0, atol=1e-15)
    np.testing.assert_allclose([deck.amplitude_spread, deck.direction_spread], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(deck.ellipses.direction), 45.0, rtol=1e-12)


def test_deck_of_a_body_that_turns_has_its_spread():
    """U_p = (0, y + psi x_p): the mean is y, the root mean square of the rest psi x_p."""
    y, psi, x = 2e-3, 1e-3j, np.array([-1.0, 0.0, 1.0])
    deck = Known(jnp.array([0.0, y, psi])).deck([(each, 0.0) for each in x])
    np.testing.assert_allclose(deck.motion_spread, abs(psi) * np.sqrt(2.0 / 3.0) / y, rtol=1e-12)
    np.testing.assert_allclose(deck.ellipses.semi_major, np.abs(y + psi * x), rtol=1e-12)
    assert len(deck.summary().splitlines()) == 4


def test_directions_spread_across_the_vertical():
    """80 and 100 degrees, that is -80, are 20 degrees apart, not 160."""
    angle = np.radians(80.0)
    y, psi = np.sin(angle), 1j * 0.0
    deck = Known(jnp.array([0.0, y + 0j, np.cos(angle) + psi])).deck([(0.0, -1.0), (0.0, 1.0)])
    np.testing.assert_allclose(np.rad2deg(deck.direction_spread), 20.0, rtol=1e-10)


@pytest.mark.parametrize("begin", [0.0, 3.0])
def test_harmonic_is_found_beside_others_and_an_offset(begin):
    t = jnp.linspace(begin, begin + 1.3, 4000)
    first, second = np.array([1.0 - 2.0j, 0.5j]), np.array([0.2 + 0.1j, -0.3])
    phase = SPEED * (t - begin - 0.65)
    q = 0.7 + np.real(np.exp(1j * phase)[:, None] * first) + np.real(np.exp(2j * phase)[:, None] * second)
    amplitude, rest = fit_harmonic(t, jnp.asarray(q), jnp.asarray(SPEED))
    np.testing.assert_allclose(amplitude, first, atol=1e-10)
    np.testing.assert_allclose(jnp.diagonal(rest), 0.5 * np.abs(second) ** 2, rtol=1e-3)


def run_of(*exciters):
    return jv.simulate(jv.Scene(SCREEN, exciters=list(exciters)), 8.0, save="window")


def exciter(at, direction=1):
    return jv.Exciter(drive=jv.ConstantSpeed(SPEED), unbalance=5.0, at=at, direction=direction)


def steady(exciters):
    """q = w^2 (K - w^2 M + i w C)^-1 sum B^T (1, -i s) S for rotors that all pass the angle 0 at the same time."""
    carrier = SCREEN.carrier()
    matrix = np.asarray(carrier.stiffness) - SPEED**2 * np.asarray(carrier.mass) + 1j * SPEED * np.asarray(carrier.damping)
    force = sum(5.0 * np.array([1.0, -1j * s, -y - 1j * s * x]) for (x, y), s in exciters)
    return jnp.asarray(SPEED**2 * np.linalg.solve(matrix, force))


def test_run_has_the_ellipses_of_the_steady_motion():
    places = [((-0.3, 0.5), 1), ((0.4, 0.5), -1)]
    run, expected = run_of(*(exciter(*each) for each in places)), Known(steady(places))
    points = [(-1.2, 0.3), (0.1, 0.2), (1.0, -0.2)]
    found, wanted = run.deck(points, slope="-10 deg"), expected.deck(points, slope="-10 deg")
    for name in ("semi_major", "semi_minor", "direction", "stroke", "acceleration", "throw_number"):
        allowed = 1e-6 if name in ("semi_major", "semi_minor") else 5e-4  # the other ones are those of the whole motion
        np.testing.assert_allclose(getattr(found.ellipses, name), getattr(wanted.ellipses, name), rtol=allowed, err_msg=name)
    np.testing.assert_allclose(found.motion_spread, wanted.motion_spread, rtol=1e-6)
    assert np.max(found.ellipses.remainder) < 1e-4  # what is left of the start
    one = run.ellipse(points[0], slope="-10 deg")
    np.testing.assert_allclose(one.semi_major, found.ellipses.semi_major[0], rtol=1e-12)
    moved, (x, y, psi) = run.point(at=points[0]), np.asarray(run.window.state.velocity).T
    np.testing.assert_allclose(moved.velocity, np.stack([x - 0.3 * psi, y - 1.2 * psi], 1), rtol=1e-12)
    np.testing.assert_allclose(np.max(np.hypot(*moved.velocity.T)), SPEED * one.semi_major, rtol=1e-3)


def test_ellipse_of_a_run_is_differentiable():
    def throw(unbalance):
        scene = jv.Scene(SCREEN, exciters=[jv.Exciter(drive=jv.ConstantSpeed(SPEED), unbalance=unbalance, at=(0.3, 0.5))])
        path = jv.simulate(scene, 4.0, save="window").ellipse((1.0, 0.0))
        return jnp.stack([path.semi_major, path.stroke, path.direction, path.throw_number])

    values, slope = throw(5.0), jax.jacrev(throw)(5.0)
    np.testing.assert_allclose(slope[0], values[0] / 5.0, rtol=1e-6)  # ideal drive: proportional to the unbalance
    np.testing.assert_allclose(slope, (throw(5.01) - throw(4.99)) / 0.02, rtol=1e-4, atol=1e-6)  # its torque on the body is not


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda r: r.ellipse((0.0, 0.0), body=1), "body is 1; the machine has one body, number 0"),
        (lambda r: r.ellipse(2), "at has 1 number; on a body"),
        (lambda r: r.ellipse((0.0, 1.0, 2.0)), "at has 3 values; 2 are needed"),
        (lambda r: r.deck([]), "points is .*; it must be a list of points"),
        (lambda r: r.deck((0.0, 1.0)), r"points is \(0\.0, 1\.0\); it must be a list of points"),
        (lambda r: r.deck([(0.0, 1.0)], slope=-5), r"slope is -5 rad \(-286\.5 degrees\), .* write degrees as '-5 deg'"),
        (lambda r: r.ellipse((0.0, 0.0), slope=-5), r"slope is -5 rad \(-286\.5 degrees\)"),
        (lambda r: r.deck([(0.0, "1 kg")]), r"points\[0\].*not in m"),
    ],
)
def test_wrong_points_end_in_one_sentence(ask, says):
    with pytest.raises(jv.InputError, match=says):
        ask(Known(jnp.array([0.0, 1e-3 + 0j, 0.0])))


def test_run_without_a_trajectory_refuses_its_whole_motion():
    run = run_of(exciter((0.0, 0.5)))
    with pytest.raises(jv.InputError, match="part is 'all', but the run kept only its window"):
        run.point(part="all")
    with pytest.raises(jv.InputError, match="part is 'end'; allowed: window, all"):
        run.point(part="end")


@pytest.mark.parametrize(
    ("amplitude", "speed", "says"),
    [
        (jnp.ones(3), 100.0, r"^amplitude has the shape \(3,\); give two amplitudes, horizontal and up"),
        (jnp.array([1.0, jnp.nan]), 100.0, r"^amplitude is .*; finite numbers are needed"),
        (jnp.ones(2), jnp.asarray(True), "^speed is "),
    ],
)
def test_wrong_numbers_of_ellipses_are_refused(amplitude, speed, says):
    with pytest.raises(jv.InputError, match=says):
        jv.ellipse_of(amplitude, speed)


def widths(path, count=20001):
    """Widths of a path (nt, 2) in evenly spaced directions, by sampling."""
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, count)
    return angle, np.ptp(path @ np.stack([np.cos(angle), np.sin(angle)]), axis=0)


def sampled_path(harmonics, count=1024, further=2):
    """Path (nt, 2) with the complex amplitudes (K, 2) of the orders 1, 2, ..."""
    theta = 2.0 * np.pi * np.arange(count + further) / count
    return jnp.real(jnp.exp(1j * jnp.outer(theta, 1 + np.arange(len(harmonics)))) @ harmonics)


@pytest.mark.parametrize("seed", range(3))
def test_largest_extent_is_that_of_a_dense_sampling(seed):
    rng = np.random.default_rng(seed)
    parts = rng.normal(size=(2, 4, 2)) / np.array([1.0, 2.0, 5.0, 10.0])[:, None]
    extent = jax.jit(lambda x: jnp.stack(largest_extent(sampled_path(x[0] + 1j * x[1]))))
    stroke, direction = extent(jnp.asarray(parts))
    angle, width = widths(np.asarray(sampled_path(parts[0] + 1j * parts[1], 4000)))
    np.testing.assert_allclose(stroke, np.max(width), rtol=2e-6)
    np.testing.assert_allclose(direction, angle[np.argmax(width)], atol=2e-3)

    change, step = rng.normal(size=parts.shape), 1e-6
    slope = jax.jvp(extent, (jnp.asarray(parts),), (jnp.asarray(change),))[1]
    ends = [extent(jnp.asarray(parts + sign * step * change)) for sign in (-1.0, 1.0)]
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / (2.0 * step), rtol=1e-6)
    gradient = jax.grad(lambda x: extent(x)[0])(jnp.asarray(parts))
    np.testing.assert_allclose(np.sum(gradient * change), slope[0], rtol=1e-9)


@pytest.mark.parametrize("amplitude", [(1.0, 1j), (1.0, 1.0), (0.0, 1.0), (1.0, 0.0), (0.0, 0.0)])
def test_extent_of_a_plain_path_has_finite_derivatives(amplitude):
    """A circle, whose extents in all directions are equal, straight lines, and a point at rest."""
    amplitude = jnp.asarray(amplitude) + 0j

    def extent(scale):
        return jnp.stack(largest_extent(sampled_path(scale * amplitude[None])))

    value, slope = jax.jvp(extent, (jnp.asarray(2.0),), (jnp.asarray(1.0),))
    ellipse = jv.ellipse_of(2.0 * amplitude, SPEED)
    np.testing.assert_allclose(value, [2.0 * ellipse.semi_major, ellipse.direction], atol=1e-8)
    np.testing.assert_allclose(slope, [ellipse.semi_major, 0.0], atol=1e-8)
