"""Problems of identification: known values, grids of samples, filters, natural modes."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy.linalg import eig
from scipy.stats import norm

import jaxvib as jv
from jaxvib.identification.problem import (
    EXACT,
    Known,
    Problem,
    _delay_taps,
    _require_included,
    build_problem,
    damped_modes,
    read_known,
    with_angle_errors,
    with_noise,
)
from jaxvib.identification.response import Unknowns
from jaxvib.machine.numbers.named import find_number
from jaxvib.numerics.noise import Noise, limited


def scene_of(exciters=1, **drive):
    machine = jv.two_mass(mass=(80.0, 90.0), stiffness=(4e4, 5e4), damping=(60.0, 70.0), link_stiffness=1e5, link_damping=50.0)
    turning = jv.RunUp(60.0, acceleration=2.0)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=turning, unbalance=0.05 * (k + 1), at=k + 1) for k in range(exciters)])


@pytest.mark.parametrize(
    ("text", "value", "error"),
    [
        (95.0, 95.0, 0.0),
        ("95 kg", 95.0, 0.0),
        ("0.1 t", 100.0, 0.0),
        ("95 kg +- 1 %", 95.0, 0.95),
        ("95 kg +- 1e-300 %", 95.0, 0.0),
        ("95 kg +/- 0.5 kg", 95.0, 0.5),
        ("95 kg ± 500 g", 95.0, 0.5),
    ],
)
def test_known_values_with_their_errors(text, value, error):
    number = find_number(scene_of(), "machine.mass", "known").single(scene_of())[0]
    found = read_known(text, number, "known")
    assert found.value == pytest.approx(value) and found.error == pytest.approx(error)


@pytest.mark.parametrize(
    "text",
    [
        "95 kg +- 1 % +- 2 %",
        "95 kg +- much %",
        "95 kg +- 1 N",
        "95 kg +- -1 %",
        "95 kg +- nan %",
        "95 kg +- inf %",
        "95 kg +- -1 kg",
    ],
)
def test_wrong_known_values_raise_clear_errors(text):
    number = find_number(scene_of(), "machine.mass", "known").single(scene_of())[0]
    with pytest.raises(jv.InputError, match=r"^known"):
        read_known(text, number, "known")


def test_exact_values_have_no_error():
    assert Known(-2.0, 2.0 * EXACT).is_exact and Known(3.0, 0.0).is_exact and not Known(3.0, 3.1 * EXACT).is_exact


T = 0.01 * np.arange(400)


def channel(name, kind="velocity", **options):
    return jv.Channel(name, kind, at=1, **options)


def run_with(values, times=None, channels=None, clipped=None, change=None, notes=(), source="run 3"):
    """Return a run; `values` by the names of its channels."""
    channels = tuple(channels or map(channel, values))
    times = times or dict.fromkeys(values, T)
    none = {name: np.zeros(times[name].size, bool) for name in values}
    parsed = jv.MeasuredRun.from_arrays([channel("x")], T, {"x": np.sin(7.0 * T)}, change=change).change
    return jv.MeasuredRun(channels, times, values, none | (clipped or {}), parsed, notes, source)


def test_channels_with_different_times_are_on_one_grid():
    """The second channel begins three steps and ends five steps earlier; it has a gap, and one reading is missing."""
    rng = np.random.default_rng(0)
    early = np.delete(0.01 * np.arange(-3, 395) + 1e-5, [100, 101])
    first, second = rng.normal(size=T.size), rng.normal(size=early.size)
    first[7] = np.nan
    clipped = {"a": np.zeros(T.size, bool), "b": np.zeros(early.size, bool)}
    clipped["a"][[20, 21]] = True
    first[[20, 21]] = 5.0, -5.0
    run = run_with({"a": first, "b": second}, {"a": T, "b": early}, clipped=clipped)
    problem = build_problem(scene_of(), [run], ["machine.stiffness"], {})
    time, raw, mask, bounds = problem.times[0], problem.raw[0], problem.masks[0], problem.bounds[0]
    np.testing.assert_allclose(time, 0.01 * np.arange(-3, 400), atol=1e-12)
    assert raw.shape == mask.shape == bounds.shape == (403, 2)
    shown = np.isfinite(first)
    np.testing.assert_array_equal(raw[3:, 0][shown], first[shown])
    place = np.rint(early / 0.01).astype(int) + 3
    np.testing.assert_array_equal(raw[place, 1], second)
    wanted = np.zeros((403, 2), bool)
    wanted[3:, 0] = shown & ~clipped["a"]
    wanted[place, 1] = True
    np.testing.assert_array_equal(mask, wanted)
    assert np.flatnonzero(bounds[:, 0]).tolist() == [23, 24] and bounds[[23, 24], 0].tolist() == [1, -1]
    assert not np.any(raw[~mask & (bounds == 0)]) and not np.any(bounds[:, 1])
    samples = problem.runs[0]
    assert float(samples.begin) == pytest.approx(-0.03) and float(samples.end) == pytest.approx(3.99)
    assert float(samples.step) == pytest.approx(0.01) and samples.readings.shape == (1, 512, 2)
    np.testing.assert_allclose(problem.angles[0][:, 0], time**2, atol=1e-12)


def test_sides_of_clipped_readings_of_a_slow_channel():
    slow = 9.0 + np.sin(T[::4])
    slow[[20, 60]] = 7.5, 9.8
    clipped = {"b": np.isin(np.arange(slow.size), [20, 60])}
    run = run_with({"a": np.sin(T), "b": slow}, {"a": T, "b": T[::4]}, clipped=clipped)
    problem = build_problem(scene_of(), [run], ["machine.stiffness"], {})
    assert problem.bounds[0][[80, 240], 1].tolist() == [-1, 1]


def test_span_of_the_angle_bounds_the_samples():
    channels = [channel("a"), jv.Channel("rotor", "angle")]
    turning = 12.0 * T[50:350]
    run = run_with({"a": np.sin(T), "rotor": turning}, {"a": T, "rotor": T[50:350]}, channels)
    found = build_problem(scene_of(), [run], ["machine.stiffness"], {})
    np.testing.assert_allclose(found.times[0], T[50:350])
    np.testing.assert_allclose(found.angles[0][:, 0], turning, atol=1e-8)
    assert found.marked and found.raw[0][0, 0] == np.sin(0.5)


def test_long_records_are_in_segments():
    t = 1e-3 * np.arange(9000)
    run = run_with({"a": np.sin(t)}, {"a": t})
    found = build_problem(scene_of(), [run], ["machine.stiffness"], {})
    assert found.runs[0].readings.shape[0] * found.runs[0].readings.shape[1] >= found.raw[0].shape[0]
    assert found.runs[0].readings.shape[1] <= 4096


def test_long_records_of_stops_keep_their_rate():
    t = 0.001 * np.arange(16400)
    run = run_with({"a": np.sin(20.0 * t)}, {"a": t})
    scene = scene_of()
    on_stop = jv.Scene(scene.machine, exciters=scene.exciters, effects=jv.Stop(3e5, gap=1e-3))
    sizes = [build_problem(each, [run], ["machine.stiffness"], {}).times[0].size for each in (scene, on_stop)]
    assert sizes[0] < 4100 and sizes[1] == 16400


def test_uneven_and_short_runs_are_refused():
    late = T + np.where(np.arange(400) > 200, 0.0003, 0.0)
    run = run_with({"a": np.sin(T), "b": np.sin(T)}, {"a": T, "b": late})
    with pytest.raises(jv.InputError, match=r"run 3: channel 'b' is not sampled on the even grid of the others \(100 Hz\)"):
        build_problem(scene_of(), [run], ["machine.stiffness"], {})
    for count in (23, 24):
        short = run_with({"a": np.sin(T[:count])}, {"a": T[:count]})
        if count == 24:
            build_problem(scene_of(), [short], ["machine.stiffness"], {})
            continue
        with pytest.raises(jv.InputError, match="run 3 has 23 samples while the angle of the rotor is known"):
            build_problem(scene_of(), [short], ["machine.stiffness"], {})
    with pytest.raises(jv.InputError, match="run 3 has no channel that the model can be compared with; add a channel of kind"):
        build_problem(
            scene_of(), [run_with({"i": np.sin(T)}, channels=[jv.Channel("i", "current")])], ["machine.stiffness"], {}
        )


def test_unknowns_with_their_known_values():
    channels = [channel("a", gain_error=0.02), channel("b", gain_error=0.0), jv.Channel("i", "current")]
    values = {name: np.sin(T) for name in ("a", "b", "i")}
    runs = [
        run_with(
            values, channels=channels, change={"machine.mass[0]": "+10 kg", "machine.damping": "-20 %"}, notes=("a note",)
        ),
        run_with(values, channels=channels, change={"machine.link_stiffness[0]": 9e4}, notes=("a note",), source="run 4"),
    ]
    known = {"machine.stiffness[1]": "6e4 N/m +- 3 %", "machine.mass[1]": "97 kg", "exciters[0].unbalance": "0.04 kg m +- 5 %"}
    found = build_problem(scene_of(), runs, ["machine.stiffness[0]", "machine.damping", "machine.mass[1]"], known)
    names = [number.name for number in found.unknowns.numbers]
    assert names == ["machine.stiffness[0]", "machine.damping[0]", "machine.damping[1]", "machine.stiffness[1]"]
    np.testing.assert_allclose(found.unknowns.first, [4e4, 60.0, 70.0, 5e4])
    np.testing.assert_allclose(found.unknowns.scale, [4e4, 60.0, 70.0, 5e4])
    assert np.all(np.asarray(found.unknowns.positive)) and found.unknowns.gains == ("a",) and found.unknowns.turns == 0 + 1
    np.testing.assert_allclose(found.means, [0.0, 0.0, 0.0, np.log(6e4 / 5e4), 0.0, 0.0])
    np.testing.assert_allclose(found.precisions, [0.0, 0.0, 0.0, 0.03**-2, 0.02**-2, 0.0])
    assert float(found.scene.machine.mass[1]) == 97.0
    np.testing.assert_allclose(found.unbalances[0], (0.04, 0.002))
    assert found.notes == (
        "a note",
        "run 3: channel 'i' of kind current is not used",
        "run 4: channel 'i' of kind current is not used",
    )
    assert [samples.turn for samples in found.runs] == [None, 0] and not found.marked
    assert found.runs[0].actions == ("add", "scale", "scale")
    np.testing.assert_allclose(found.runs[0].amounts, [10.0, 0.8, 0.8])
    scene = found.runs[0].scene(found.scene)
    np.testing.assert_allclose(scene.machine.mass, [90.0, 97.0])
    np.testing.assert_allclose(scene.machine.damping, [48.0, 56.0])
    np.testing.assert_allclose(found.runs[1].scene(found.scene).machine.link_stiffness, [9e4])


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (
            channel("a", gain_error=0.03),
            "channel 'a': gain_error is 0.02 in one run and 0.03 in another, but channels with the",
        ),
        (channel("a", kind="displacement", gain_error=0.02), "channel 'a': kind is 'velocity' in one run and 'displacement'"),
    ],
)
def test_one_name_of_two_sensors_is_refused(other, words):
    runs = [run_with({"a": np.sin(T)}, channels=[each]) for each in (channel("a", gain_error=0.02), other)]
    with pytest.raises(jv.InputError, match=words):
        build_problem(scene_of(), runs, ["machine.stiffness"], {})


def test_readings_of_the_motion_before_the_record_do_not_count():
    run = run_with({"a": np.sin(T), "b": np.sin(T)}, channels=[channel("a", delay=0.0695), channel("b")])
    (mask,) = build_problem(scene_of(), [run], ["machine.stiffness"], {}).masks
    assert np.flatnonzero(~mask[:, 0]).tolist() == [*range(7)] and np.all(mask[:, 1])
    run = run_with({"a": np.sin(T), "b": np.sin(T)}, channels=[channel("a"), channel("b", delay=4.1)])
    with pytest.raises(jv.InputError, match=r"channel 'b' has no unclipped reading while the motion is known"):
        build_problem(scene_of(), [run], ["machine.stiffness"], {})


def test_silent_channels_and_long_delays_are_refused():
    run = run_with({"a": np.sin(T)}, channels=[channel("a", direction="across")])
    with pytest.raises(jv.InputError, match=r"channel 'a': direction is \(1.0, 0.0\), but the machine moves vertically only"):
        build_problem(scene_of(), [run], ["machine.stiffness"], {})
    with pytest.raises(jv.InputError, match=r"delay is 451 sampling steps; it must be between 0 and 450"):
        _delay_taps(451.0)


def test_without_a_number_to_find_a_fit_is_refused():
    with pytest.raises(jv.InputError, match=r"unknown is \['machine.mass'\]; these parameters are exactly known"):
        build_problem(scene_of(), [run_with({"a": np.sin(T)})], ["machine.mass"], {"machine.mass": "80 kg"})
    only = build_problem(scene_of(), [run_with({"a": np.sin(T)})], ["exciters[0].unbalance"], {})
    assert only.unknowns.count == 0 and only.unbalances == (None,)


@pytest.mark.parametrize(
    ("change", "known", "words"),
    [
        ({"machine.mass[0]": "-80 kg"}, {}, r"run 3: change of machine.mass\[0\] is 0 kg; it must be greater than 0"),
        (
            {"exciters[0].unbalance": "+5 %"},
            {},
            r"run 3: change\['exciters\[0\].unbalance'\] is an unbalance, which must be the",
        ),
        ({}, {"machine.damping": "0 N s/m +- 5 N s/m"}, r"known\['machine.damping\[0\]'\] is 0 with an error; the value of"),
    ],
)
def test_changes_and_known_values_that_do_not_count_are_refused(change, known, words):
    run = run_with({"a": np.sin(T)}, change=change)
    with pytest.raises(jv.InputError, match=words):
        build_problem(scene_of(), [run], ["machine.stiffness"], known)


def test_places_are_unknowns_of_either_sign():
    supports = [jv.support(at=(x, 0.0), stiffness=(6e4, 9e4), damping=(300.0, 200.0)) for x in (-0.5, 0.6)]
    machine = jv.plane_body(mass=80.0, inertia=12.0, supports=supports)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.RunUp(60.0, acceleration=2.0), unbalance=0.05, at=(0.1, 0.2))])
    run = run_with({"a": np.sin(T)}, channels=[jv.Channel("a", "velocity", at=(0.0, 0.0))])
    found = build_problem(scene, [run], ["machine.supports[0].at[0]"], {"machine.supports[1].at[0]": "0.66 m +- 0.03 m"})
    assert [number.name for number in found.unknowns.numbers] == ["machine.supports[0].at[0]", "machine.supports[1].at[0]"]
    assert not np.any(np.asarray(found.unknowns.positive))
    np.testing.assert_allclose(found.unknowns.scale, [0.5, 0.6])
    np.testing.assert_allclose(found.means, [0.0, 0.1])
    np.testing.assert_allclose(found.precisions, [0.0, 0.05**-2])


def test_zero_of_the_angle_of_further_runs():
    """A schedule has no mark; with several exciters it fixes all angles."""
    runs = [run_with({"a": np.sin(T)})] * 3
    one, two = (build_problem(scene_of(k), runs, ["machine.stiffness"], {}) for k in (1, 2))
    assert [each.turn for each in one.runs] == [None, 0, 1] and one.unknowns.turns == 2
    assert [each.turn for each in two.runs] == [None] * 3 and two.unknowns.turns == 0
    np.testing.assert_allclose([two.unbalances[1].value, two.unbalances[1].error], [0.1, 0.1 * EXACT])
    angle = {"a": np.sin(T), "rotor": 12.0 * T}
    marked = run_with(angle, channels=[channel("a"), jv.Channel("rotor", "angle")])
    mixed = build_problem(scene_of(), [marked, marked, runs[0]], ["machine.stiffness"], {})
    assert [each.turn for each in mixed.runs] == [None, None, 0] and not mixed.marked
    late = build_problem(scene_of(), [runs[0], marked], ["machine.stiffness"], {})
    assert [each.turn for each in late.runs] == [None, 0]


def simple_problem(raw, mask, bounds=None, delays=(0.0, 0.0)):
    problem = build_problem(scene_of(), [run_with({"a": np.sin(T), "b": np.sin(T)})], ["machine.stiffness"], {})
    channels = tuple(channel(name, delay=0.01 * each) for name, each in zip("ab", delays, strict=True))
    object.__setattr__(problem.runs[0], "channels", channels)
    bounds = np.zeros(raw.shape, np.int8) if bounds is None else bounds
    return problem._replace(raw=(raw,), masks=(mask,), bounds=(bounds,))


def later(values, k):
    return np.concatenate([np.zeros(k), values[: len(values) - k]]) if k else values


def test_readings_are_filtered_to_white_noise():
    rng = np.random.default_rng(0)
    raw, mask = rng.normal(size=(400, 2)), np.ones((400, 2), bool)
    mask[100, 0] = False
    taps = [np.array([1.0, -0.5, 0.2]), np.ones(1)]
    found = with_noise(simple_problem(raw, mask), [[Noise(taps[0], 0.5), Noise(taps[1], 2.0)]]).runs[0]
    readings, weights = np.asarray(found.readings)[0], np.asarray(found.weights)[0]
    np.testing.assert_allclose(readings[:400, 0], sum(tap * later(raw[:, 0], j) for j, tap in enumerate(taps[0])), atol=1e-12)
    np.testing.assert_allclose(readings[:400, 1], raw[:, 1])
    expected = np.full(400, 2.0)
    expected[[0, 1, 100, 101, 102]] = 0.0
    np.testing.assert_allclose(weights[:400], np.stack([expected, np.full(400, 0.5)], axis=1))
    assert not np.any(readings[400:]) and not np.any(weights[400:])
    np.testing.assert_allclose(found.taps, np.pad(np.array([[1.0, -0.5, 0.2], [1.0, 0.0, 0.0]]).T, ((0, 6), (0, 0))))


def test_delays_are_interpolated_in_the_model():
    """Readings later by 2.3 steps, of a polynomial; both channels are later by two steps in addition."""
    raw = np.stack([np.arange(400.0)] * 2, axis=1)
    found = with_noise(simple_problem(raw, np.ones((400, 2), bool), delays=(2.3, 0.0)), [[Noise(np.ones(1), 1.0)] * 2]).runs[0]
    np.testing.assert_allclose(np.asarray(found.readings)[0, 2:400, :], raw[:-2])
    taps = np.asarray(found.taps)
    assert taps.shape == (9, 2) and np.flatnonzero(np.asarray(found.weights)[0, :, 0])[0] == 7
    x = np.arange(400.0)
    for k, delay in enumerate((2.3, 0.0)):
        for power in range(6):
            moved = np.convolve(x**power, taps[:, k])[20:300]
            np.testing.assert_allclose(moved, (x[20:300] - delay - 2.0) ** power, rtol=1e-9)
    with pytest.raises(jv.InputError, match=r"delay is -2\.5 sampling steps; it must be between 0 and 450"):
        _delay_taps(-2.5)


def test_outliers_and_bounds_change_readings_and_weights():
    rng = np.random.default_rng(0)
    raw, differences = rng.normal(size=(400, 2)), rng.normal(size=(400, 2))
    differences[50, 0] = 40.0
    mask, bounds = np.ones((400, 2), bool), np.zeros((400, 2), np.int8)
    mask[[60, 61], 1] = False
    bounds[[60, 61], 1] = 1, -1
    noise = [Noise(np.ones(1), 0.5, 0.1, 10.0), Noise(np.ones(1), 2.0)]
    found = with_noise(simple_problem(raw, mask, bounds), [noise], [differences]).runs[0]
    readings, weights = np.asarray(found.readings)[0, :400], np.asarray(found.weights)[0, :400]
    moved, factor = limited(differences[:, 0] / 0.5, mask[:, 0], 0.1, 10.0)
    np.testing.assert_allclose(readings[:, 0], raw[:, 0] - differences[:, 0] + 0.5 * moved, atol=1e-12)
    np.testing.assert_allclose(weights[:, 0], 2.0 / factor)
    model = raw - differences
    for k, side in ((60, 1), (61, -1)):
        z = -side * differences[k, 1] / 2.0
        ratio = norm.pdf(z) / norm.cdf(z)  # score; weight^2 is its slope
        assert readings[k, 1] == pytest.approx(model[k, 1] + side * 2.0 * ratio / (ratio * (ratio + z)), rel=1e-9)
        assert weights[k, 1] == pytest.approx(np.sqrt(ratio * (ratio + z)) / 2.0, rel=1e-9)
    others = np.delete(np.arange(400), [60, 61])
    np.testing.assert_allclose(readings[others, 1], raw[others, 1])
    np.testing.assert_allclose(weights[others, 1], 0.5)


def test_outliers_of_coloured_noise_are_filtered():
    """The difference of a reading is filtered before it is limited; bounds are left out."""
    rng = np.random.default_rng(0)
    raw, differences = rng.normal(size=(400, 2)), rng.normal(size=(400, 2))
    mask, bounds = np.ones((400, 2), bool), np.zeros((400, 2), np.int8)
    mask[60, 0], bounds[60, 0] = False, 1
    noise = [Noise(np.array([1.0, -0.6]), 0.5, 0.1, 10.0), Noise(np.ones(1), 2.0)]
    found = with_noise(simple_problem(raw, mask, bounds), [noise], [differences]).runs[0]
    valid = np.ones(400, bool)
    valid[[0, 60, 61]] = False
    white, plain = (each[:, 0] - 0.6 * later(each[:, 0], 1) for each in (differences, raw))
    moved, factor = limited(white / 0.5, valid, 0.1, 10.0)
    np.testing.assert_allclose(
        np.asarray(found.readings)[0, :400, 0], np.where(valid, plain - white + 0.5 * moved, plain), atol=1e-12
    )
    np.testing.assert_allclose(np.asarray(found.weights)[0, :400, 0], valid * 2.0 / factor)


def test_angle_errors_become_unknowns():
    unknowns = Unknowns((), np.zeros(2), np.ones(2), np.zeros(2, bool), ("a",), 1)
    problem = build_problem(scene_of(), [run_with({"a": np.sin(T)})] * 3, ["machine.stiffness"], {})
    rotors = tuple((SimpleNamespace(error_count=m, drive=f"drive {m}", left_out=0.1 * m),) for m in (8, 16, 24))
    blank = Problem(*[None] * len(Problem._fields))._replace(
        unknowns=unknowns, runs=problem.runs, rotors=rotors, means=np.arange(4.0), precisions=np.arange(4.0),
        angle_errors=(9.0, 9.0, 9.0),
    )  # fmt: skip
    found = with_angle_errors(blank, [True, False, True])
    assert found.unknowns.errors == 32 and found.unknowns.count == 4 + 32
    assert [each.errors for each in found.runs] == [(4, 8), (0, 0), (12, 24)]
    assert [each.drives for each in found.runs[::2]] == [("drive 8",), ("drive 24",)]
    np.testing.assert_allclose(found.angle_errors, [0.8, 9.0, 2.4])
    np.testing.assert_array_equal(found.means, [*range(4), *[0.0] * 32])
    np.testing.assert_array_equal(found.precisions, [*range(4), *[1.0] * 32])


def test_natural_modes_of_the_damped_machine():
    scene = scene_of()
    mass, k, c = np.diag([80.0, 90.0]), 1e5, 50.0
    stiffness = np.array([[4e4 + k, -k], [-k, 5e4 + k]])
    damping = np.array([[60.0 + c, -c], [-c, 70.0 + c]])
    one, zero = np.eye(2), np.zeros((2, 2))
    poles = eig(np.block([[zero, one], [-stiffness, -damping]]), np.block([[one, zero], [zero, mass]]))[0]
    poles = sorted(poles[poles.imag > 0.0], key=abs)
    frequency, ratio = damped_modes(scene)
    np.testing.assert_allclose(frequency, np.abs(poles), rtol=1e-9)
    np.testing.assert_allclose(ratio, -np.real(poles) / np.abs(poles), rtol=1e-7)


def test_identification_in_single_precision_is_refused():
    with jax.enable_x64(False), pytest.raises(jv.InputError, match="single precision; an identification needs double"):
        build_problem(scene_of(), [], ["machine.stiffness"], {})


def test_loads_on_one_of_several_exciters_are_refused():
    scene = scene_of(2)
    with_balls = jv.Exciter(jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed(60.0), at=1)
    mixed = jv.Scene(scene.machine, exciters=[with_balls, scene.exciters[1]])
    _require_included(scene, [])
    with pytest.raises(jv.InputError, match=r"^scene has 2 exciters, one of them with loads; identify needs loads"):
        _require_included(mixed, [])
