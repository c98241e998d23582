"""Splines of a rotor's angle and their errors, against least squares and covariances by NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

import jaxvib as jv
from jaxvib.identification.angle import (
    RecordedDrive,
    RotorAngle,
    _angle_of_channel,
    drive_of_spline,
    recorded_drive,
    rotor_angles,
)
from jaxvib.identification.records.spline import _breaks, _data, _fit_knots, _mark_offsets, fit_spline

T = np.sort(np.random.default_rng(1).uniform(0.0, 3.0, 150))


def curve(t):
    return 20.0 * t + 5.0 * t**2


def basis_of(time, intervals):
    knots = np.concatenate([[time[0]] * 5, np.linspace(time[0], time[-1], intervals + 1), [time[-1]] * 5])
    return knots, BSpline.design_matrix(time, knots, 5).toarray()


@pytest.mark.parametrize("marks", [None, np.arange(150) % 3])
def test_fit_is_the_weighted_least_squares(marks):
    rng = np.random.default_rng(0)
    spread = np.linspace(1.0, 3.0, T.size)
    value = curve(T) + 0.01 * spread * rng.normal(size=T.size)
    offsets = np.zeros((T.size, 0))
    if marks is not None:
        offsets = np.stack([1.0 * (marks == k) - (marks == 0) for k in (1, 2)], axis=1)
        value = value + np.array([0.02, 0.03, -0.05])[marks]
    weights, intervals = np.mean(spread) / spread, 4
    _, basis = basis_of(T, intervals)
    data = _data(T, value, np.zeros(T.size, int) if marks is None else marks, spread)
    np.testing.assert_allclose(data.columns.toarray(), offsets * weights[:, None], rtol=1e-14)
    fit = _fit_knots(data, intervals)
    columns = np.concatenate([basis, offsets], axis=1) * weights[:, None]
    found = np.linalg.lstsq(columns, value * weights, rcond=None)[0]
    size = basis.shape[1]
    np.testing.assert_allclose(fit.coefficients, found[:size], rtol=1e-8)
    square = np.sum((value * weights - columns @ found) ** 2)
    n, k = columns.shape
    assert fit.criterion == pytest.approx(n * np.log(square / n) + k * np.log(n), rel=1e-9)
    covariance = square / (n - k) * np.linalg.inv(columns.T @ columns)[:size, :size]
    np.testing.assert_allclose(fit.covariance(), covariance, rtol=1e-5, atol=1e-7 * np.max(covariance))
    spline, scatter = fit_spline(T, value, marks, spread)
    counts = [len(_fit_knots(data, each).coefficients) for each in (1, 2)]
    assert spline.c.shape[0] in counts  # a parabola needs one interval, or few
    best = min((_fit_knots(data, each) for each in (1, 2, 3, 4, 5, 7, 9, 12)), key=lambda each: each.criterion)
    np.testing.assert_allclose(spline.c[:, 0], best.coefficients)
    assert scatter == pytest.approx(np.sqrt(best.variance) / np.mean(spread))
    # The errors have the covariance of the coefficients, and are orthogonal over time, the largest first.
    # A common delay of all values moves the curve along its slope.
    t = np.linspace(T[0], T[-1], 30)
    basis, late = (
        BSpline.design_matrix(t, best.knots, 5).toarray(),
        spline(t, 1)[:, 0] * scatter,
    )
    expected = basis @ best.covariance() @ basis.T + np.outer(late, late)
    np.testing.assert_allclose(spline(t)[:, 1:] @ spline(t)[:, 1:].T, expected, atol=1e-8 * np.max(expected))
    grid = spline(np.linspace(T[0], T[-1], 4 * len(best.coefficients)))[:, 1:]
    products = grid.T @ grid
    np.testing.assert_allclose(products, np.diag(np.diagonal(products)), atol=1e-9 * products[0, 0])
    assert np.all(np.diff(np.diagonal(products)) <= 1e-9 * products[0, 0])


def test_offsets_of_many_marks_take_little_memory():
    marks, weights = np.arange(20_000) % 256, np.linspace(1.0, 2.0, 20_000)
    columns, gram = _mark_offsets(marks, weights)
    assert columns.nnz < 2.1 * marks.size
    np.testing.assert_allclose(gram, (columns.T @ columns).toarray(), rtol=1e-12)


def test_intervals_follow_from_the_information_criterion():
    t = np.linspace(0.0, 3.0, 400)
    noise = 1e-3 * np.random.default_rng(0).normal(size=t.size)
    assert fit_spline(t, curve(t) + noise)[0].c.shape[0] == 6
    wavy, _ = fit_spline(t, curve(t) + 0.1 * np.sin(9.0 * t) + noise)
    assert 15 < wavy.c.shape[0] < 40
    np.testing.assert_allclose(wavy(t)[:, 0], curve(t) + 0.1 * np.sin(9.0 * t), atol=1e-3)
    assert np.linalg.norm(wavy(1.5)[1:]) == pytest.approx(1e-3 * np.sqrt(wavy.c.shape[0] / t.size), rel=0.3)


def bent(t, jumps=((1.0, -14.0), (2.2, 6.0))):
    """Return an angle whose acceleration jumps at two times."""
    return curve(t) + sum(0.5 * jump * np.maximum(t - at, 0.0) ** 2 for at, jump in jumps)


@pytest.mark.parametrize(("wave", "every"), [(0.0, 1), (0.05, 1), (0.05, 13)])
def test_jumps_of_the_acceleration_are_found(wave, every):
    """`every` > 1: so many values that a part of them serves for the search."""
    t, rng = np.linspace(0.0, 3.0, 400 * every), np.random.default_rng(0)
    smooth = wave * np.sin(7.0 * t)
    value = bent(t) + smooth + 1e-4 * np.sqrt(every) * rng.normal(size=t.size)
    spline, scatter = fit_spline(t, value, jump_order=2)
    jumps = [each for each in np.unique(spline.t) if np.count_nonzero(spline.t == each) == 5]
    # A jump of 6 rad/s^2 is found to about 2e-4 s: 1e-4 / (6 * 3 s * sqrt(400 / 12)).
    np.testing.assert_allclose(jumps, [1.0, 2.2], atol=2e-3)
    assert scatter == pytest.approx(1e-4 * np.sqrt(every), rel=0.1)
    away = (spline(t)[:, 0] - bent(t) - smooth) / np.linalg.norm(spline(t)[:, 1:], axis=1)
    assert np.max(np.abs(away)) < 4.0 and np.sqrt(np.mean(away**2)) < 1.5
    without, _ = fit_spline(t, value)
    assert without.c.shape[0] > 1.5 * spline.c.shape[0]


def test_a_jump_of_the_slope_of_a_speed_is_found():
    t = np.linspace(0.0, 3.0, 300)
    speed = np.minimum(20.0 * t, 30.0) + 0.01 * np.random.default_rng(0).normal(size=t.size)
    spline, _ = fit_spline(t, speed, jump_order=1)
    (jump,) = (each for each in np.unique(spline.t) if np.count_nonzero(spline.t == each) == 5)
    assert jump == pytest.approx(1.5, abs=1e-3)


def test_smooth_curves_have_no_jumps():
    t = np.linspace(0.0, 3.0, 400)
    for seed in range(5):
        value = curve(t) + 0.1 * np.sin(9.0 * t) + 1e-3 * np.random.default_rng(seed).normal(size=t.size)
        np.testing.assert_array_equal(fit_spline(t, value, jump_order=2)[0].t, fit_spline(t, value)[0].t)


def test_every_interval_has_values():
    """A rotor that starts from rest has few pulses at first; jumps keep their places."""
    t = np.sqrt(np.linspace(0.05, 9.0, 60))
    for jumps in ((), (0.77, 2.05)):
        breaks = _breaks(t, 40, jumps)
        assert np.min(np.histogram(t, breaks)[0]) >= 2 and set(jumps) <= set(breaks) and breaks.size > 20
    assert _breaks(t, 4, ()) == pytest.approx(np.linspace(t[0], t[-1], 5))


def test_drive_of_a_spline_jumps_with_it():
    t = np.linspace(0.0, 3.0, 400)
    spline, _ = fit_spline(t, bent(t) + 1e-4 * np.random.default_rng(0).normal(size=t.size), jump_order=2)
    drive = drive_of_spline(spline)
    for at in (0.0, 0.4, 0.99, 1.01, 1.7, 2.3, 3.0):
        for order in range(3):
            count = spline.c.shape[1]
            np.testing.assert_allclose(drive.columns_at(at, order)[:count], spline(at, order), rtol=1e-9, atol=1e-9)
    assert [float(drive.acceleration_at(at)) for at in (0.98, 1.02)] == pytest.approx([10.0, -4.0], abs=0.5)
    assert float(drive.speed) == pytest.approx(30.0, rel=0.01)


def drive_of(errors=3):
    rng = np.random.default_rng(0)
    knots, _ = basis_of(np.linspace(0.5, 2.5, 50), 5)
    coefficients = np.concatenate(
        [np.cumsum(rng.uniform(1.0, 3.0, (10, 1)), axis=0), 0.1 * rng.normal(size=(10, errors))], axis=1
    )
    spline = BSpline(knots, coefficients, 5)
    times = np.unique(spline.t)
    return spline, recorded_drive(times, [spline(times, order) for order in range(3)])


def test_recorded_drive_follows_its_spline():
    spline, drive = drive_of()
    assert drive.table.shape == (8, 6, 9)  # padded to a power of two and to 1 + 8 columns
    for t in (0.5, 0.7, 1.3, 1.31, 2.2, 2.5):
        for order in range(3):
            expected = spline(t, order)
            np.testing.assert_allclose(drive.columns_at(t, order), np.pad(expected, (0, 5)), rtol=1e-9, atol=1e-12)
        assert float(drive.angle_at(t)) == pytest.approx(spline(t)[0])
        assert float(drive.speed_at(t)) == pytest.approx(spline(t, 1)[0])
        assert float(drive.acceleration_at(t)) == pytest.approx(spline(t, 2)[0])
    assert float(drive.speed) == pytest.approx(np.max(spline(np.linspace(0.5, 2.5, 6), 1)[:, 0]))
    z = np.array([1.0, -2.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    moved = drive.with_errors(jnp.asarray(z))
    assert float(moved.angle_at(1.1)) == pytest.approx(spline(1.1)[0] + spline(1.1)[1:] @ z[:3])
    np.testing.assert_allclose(moved.columns_at(1.1, 0)[1:], drive.columns_at(1.1, 0)[1:])


def test_errors_are_added_in_groups():
    for errors, columns in ((0, 1), (1, 9), (8, 9), (9, 17), (70, 65)):
        assert drive_of(errors)[1].table.shape[2] == columns
    angle = RotorAngle(drive_of(3)[1], drive_of(3)[0], (0.0, 1.0), True, 0.0, 0.0, ())
    assert angle.error_count == 8 and angle.without_errors().table.shape == (8, 6, 1)
    np.testing.assert_allclose(angle.at(np.array([0.6, 1.2])), drive_of(3)[0](np.array([0.6, 1.2]))[:, 0])
    plain = RotorAngle(jv.RunUp(60.0, acceleration=2.0), None, (0.0, 1.0), False, 0.0, 0.0, ())
    assert plain.error_count == 0 and plain.without_errors() is plain.drive
    np.testing.assert_allclose(plain.at(np.array([1.0, 3.0])), [1.0, 9.0])


def run_with(*channels):
    """Return a run with some channels of a rotor that turns at 12 rad/s, and one of the motion."""
    t = np.linspace(0.0, 10.0, 200)
    data = {"pulses": 2.0 * np.pi / 12.0 * np.arange(19), "angle": t, "speed": t, "frame": t}
    values = {"pulses": np.arange(19.0), "angle": 12.0 * t, "speed": np.full(200, 12.1), "frame": t}
    kinds = [jv.Channel(name, "velocity" if name == "frame" else name) for name in (*channels, "frame")]
    names = [each.name for each in kinds]
    none = {name: np.zeros(data[name].size, bool) for name in names}
    return jv.MeasuredRun(
        tuple(kinds), {name: data[name] for name in names}, {name: values[name] for name in names}, none, {}, (), "run 7"
    )


def exciter(drive, at=1):
    return jv.Exciter(drive=drive, unbalance=0.05, at=at)


def test_best_channel_of_the_rotor_is_used():
    scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0), exciters=[exciter(jv.ConstantSpeed(33.0))])
    for channels, marked, speed in (
        (("speed", "angle", "pulses"), True, 12.0),
        (("speed", "angle"), True, 12.0),
        (("speed",), False, 12.1),
    ):
        (found,) = rotor_angles(scene, run_with(*channels))
        assert isinstance(found.drive, RecordedDrive) and found.marked is marked
        assert float(found.drive.speed_at(4.0)) == pytest.approx(speed, rel=1e-6)
        assert found.span[1] == pytest.approx(2.0 * np.pi / 12.0 * 18 if "pulses" in channels else 10.0)
    (found,) = rotor_angles(scene, run_with())
    assert found.drive is scene.exciters[0].drive and found.spline is None and not found.marked
    assert found.span == (-np.inf, np.inf) and found.error == found.left_out == 0.0 and found.notes == ()


def test_two_rotors_need_prescribed_drives():
    machine = jv.two_mass(mass=(80.0, 90.0), stiffness=(4e4, 5e4), damping=(60.0, 70.0), link_stiffness=1e5, link_damping=50.0)
    drives = jv.ConstantSpeed(33.0), jv.RunUp(60.0, acceleration=2.0)
    scene = jv.Scene(machine, exciters=[exciter(each, k + 1) for k, each in enumerate(drives)])
    assert [each.drive for each in rotor_angles(scene, run_with())] == list(drives)
    with pytest.raises(
        jv.InputError, match=r"run 7 has the speed of one rotor, but the scene has 2 exciters; identify needs a"
    ):
        rotor_angles(scene, run_with("speed"))
    motor = jv.DCMotor("1500 rpm", stall_torque=5.0, inertia=0.1)
    scene = jv.Scene(machine, exciters=[exciter(drives[0], 1), exciter(motor, 2)])
    with pytest.raises(
        jv.InputError, match=r"run 7 has no channel of the rotor's angle, and exciters\[1\]\.drive is 'dc_motor'"
    ):
        rotor_angles(scene, run_with())


def measured(kind, times, values, **options):
    channel, none = jv.Channel("rotor", kind, **options), np.zeros(times.size, bool)
    return _angle_of_channel(
        jv.MeasuredRun((channel,), {"rotor": times}, {"rotor": values}, {"rotor": none}, {}, (), "run"), channel
    )


def test_error_of_many_unknowns_is_left_out():
    """A spline with many intervals has more errors than the fit has unknowns for; those have the smallest sizes."""
    t = np.linspace(0.0, 20.0, 4000)
    value = 20.0 * t + 0.3 * np.sin(15.0 * t) + 1e-3 * np.random.default_rng(0).normal(size=t.size)
    found = measured("angle", t, value)
    grid = found.spline(np.linspace(t[0], t[-1], 4 * found.spline.c.shape[0]))[:, 1:]
    sizes = np.sqrt(np.mean(grid**2, axis=0))
    assert found.spline.c.shape[0] > 80
    assert found.error == pytest.approx(np.sqrt(np.sum(sizes**2))) and found.error_count == 64
    assert found.left_out == pytest.approx(np.sqrt(np.sum(sizes[64:] ** 2))) and 0.0 < found.left_out < found.error


def test_missing_readings_of_the_rotor_are_left_out():
    t = np.linspace(0.0, 5.0, 300)
    value = np.where(np.arange(300) % 50 == 3, np.nan, curve(t))
    np.testing.assert_allclose(measured("angle", t, value).at(t), curve(t), atol=1e-8)


def test_pulses_near_rest_have_less_weight():
    """Times of pulses with equal errors: the angle's error is proportional to the speed."""
    numbers = np.arange(200.0)
    edges = np.sqrt(2.0 * np.pi * numbers / 3.0)  # angle 3 t^2
    late = edges + 1e-4 * np.random.default_rng(0).normal(size=200)
    found = measured("pulses", late, numbers, per_turn=1)
    assert found.notes == ()  # only the speed of a rotor that excites nothing changes by more than 10 % between pulses
    t = np.linspace(1.0, edges[-1], 50)
    assert np.std(found.at(t) - 3.0 * t**2) < 3.0 * 1e-4 * 6.0 * edges[-1] / np.sqrt(200.0 / 6.0)
    sizes = np.linalg.norm(found.spline(np.array([2.0, edges[-1] - 1.0]))[:, 1:], axis=1)
    assert 2.0 < sizes[1] / sizes[0] < 20.0
