"""Channels of files by their names and units, and runs from dictionaries."""

import re

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.identification.records.recorded import Recorded, described_channels, recorded_from_sep005
from jaxvib.identification.run import Change, MeasuredRun, parse_change

T = 2.0 + 0.1 * np.arange(40)
WAVE = np.sin(3.0 * T)


def entry(**changes):
    found = {"name": "frame", "unit_str": "g", "fs": 10.0, "data": WAVE.tolist()} | changes
    return {name: value for name, value in found.items() if value is not None}


def test_times_of_dictionaries():
    first, second = recorded_from_sep005(
        [entry(data=[1.0, None, 3.0]), entry(fs=None, time=[5, 6], data=[1, 2], name=7)], "run"
    )
    np.testing.assert_allclose(first.time, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(first.values, [1.0, np.nan, 3.0])
    assert (first.name, first.unit, second.name) == ("frame", "g", "7") and second.time.tolist() == [5.0, 6.0]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"data": None}, r"run: timeseries\[1\] has no entry 'data'; SEP-005 needs"),
        ({"name": None, "fs": None}, r"run: timeseries\[1\] has no entry 'name'"),
        ({"unit_str": None}, r"has no entry 'unit_str'"),
        ({"fs": None}, r"has no entry 'fs'"),
        ({"fs": 0.0}, r"run: timeseries\[1\] has values of data, fs or time that are not numbers, or an fs that is not"),
        ({"data": ["a"]}, r"has values of data, fs or time that are not numbers"),
        ({"time": ["a"]}, r"has values of data, fs or time that are not numbers"),
    ],
)
def test_wrong_dictionaries_are_refused(change, says):
    with pytest.raises(jv.InputError, match=says):
        recorded_from_sep005([entry(), entry(**change)], "run")


RECORDED = [
    Recorded("Frame", "g", T, WAVE),
    Recorded("deck (mm/s)", "", T, 2.0 * WAVE),
    Recorded("base", "mm", T, 3.0 * WAVE),
    Recorded("force", "", T, 4.0 * WAVE),
    Recorded("edges", "", None, T),
    Recorded("short", "", T[1:], WAVE),
    Recorded("bare", "", None, WAVE),
]


@pytest.mark.parametrize(
    ("name", "kind", "unit", "expected"),
    [
        ("Frame", "acceleration", None, 9.80665 * WAVE),
        (" frame ", "acceleration", None, 9.80665 * WAVE),
        ("frame (g)", "acceleration", None, 9.80665 * WAVE),
        ("Frame", "acceleration", "mm/s^2", WAVE),  # converted by the run
        ("deck", "velocity", None, 2e-3 * WAVE),
        ("deck (mm/s)", "velocity", None, 2e-3 * WAVE),
        ("base", "displacement", None, 3e-3 * WAVE),
        ("force", "force", None, 4.0 * WAVE),
        ("Frame", "pulses", None, WAVE),
    ],
)
def test_channels_by_name_and_unit(name, kind, unit, expected):
    channel = jv.Channel(name, kind, unit=unit)
    times, values, _ = described_channels(RECORDED, [channel], "run", 3.0, 5.0)
    inside = (T >= 3.0) & (T <= 5.0)
    np.testing.assert_array_equal(times[name], T[inside])
    np.testing.assert_allclose(values[name], expected[inside], rtol=1e-12)
    times, values, _ = described_channels(RECORDED, [channel], "run")
    assert times[name].size == values[name].size == T.size


def test_times_of_pulses_alone():
    times, values, _ = described_channels(RECORDED, [jv.Channel("edges", "pulses")], "run", 3.0, 4.0)
    np.testing.assert_array_equal(times["edges"], T[(T >= 3.0) & (T <= 4.0)])
    assert values == {}


@pytest.mark.parametrize(
    ("name", "kind", "says"),
    [
        ("none", "force", r"run: channel 'none' is not in the file; its channels are 'Frame', 'deck \(mm/s\)'"),
        ("bare", "force", "channel 'bare' has no times in the file; give the sampling rate of the run, `rate`"),
        ("short", "force", "channel 'short' has 39 times but 40 values; save both with the same length"),
        (
            "base",
            "velocity",
            "is in 'mm' in the file, which is not a unit of velocity; correct its kind, or give the",
        ),
    ],
)
def test_unusable_channels_are_refused(name, kind, says):
    with pytest.raises(jv.InputError, match=says):
        described_channels(RECORDED, [jv.Channel(name, kind)], "run")


def test_channels_with_similar_names():
    same = [
        Recorded(name, "N", T, factor * WAVE) for name, factor in (("Pull", 1.0), ("pull", 2.0), ("push", 3.0), ("push", 4.0))
    ]
    for name, factor in (("Pull", 1.0), ("pull", 2.0)):
        np.testing.assert_array_equal(described_channels(same, [jv.Channel(name, "force")], "run")[1][name], factor * WAVE)
    for name in ("PULL", "push", "push (N)"):
        with pytest.raises(jv.InputError, match="is the name of 2 channels of the file; give them different names"):
            described_channels(same, [jv.Channel(name, "force")], "run")


def test_a_stated_unit_goes_through_dictionaries_and_back():
    channel = jv.Channel("frame", "acceleration", at=1, unit="g")
    run = MeasuredRun.from_arrays([channel], T, {"frame": WAVE})
    (only,) = run.to_sep005()
    assert only["unit_str"] == "g"
    np.testing.assert_allclose(only["data"], WAVE, rtol=1e-12)
    np.testing.assert_allclose(MeasuredRun.from_sep005([channel], [only]).values["frame"], 9.80665 * WAVE, rtol=1e-12)


def test_runs_go_through_dictionaries_and_back():
    """A channel that begins at 0 s has its rate only, one that begins later its times as well."""
    channels = [jv.Channel("frame", "acceleration", at=1), jv.Channel("late", "speed"), jv.Channel("tacho", "pulses")]

    series = [
        entry(),
        entry(name="late", unit_str="rpm", fs=None, time=T.tolist(), data=np.full(40, 200.0).tolist()),
        entry(name="tacho", unit_str="V", fs=100.0, data=np.where(np.arange(600) % 30 > 20, 5.0, 0.0).tolist()),
    ]
    run = MeasuredRun.from_sep005(channels, series, {"machine.mass": "+1 kg"}, "record 4")
    assert run.source == "record 4" and run.change == {"machine.mass": Change("add", "1 kg")}
    np.testing.assert_allclose(run.values["frame"], 9.80665 * WAVE)
    np.testing.assert_allclose(run.values["late"], 200.0 * np.pi / 30.0)
    np.testing.assert_allclose(np.diff(run.times["tacho"]), 0.3, atol=1e-9)
    first, late, tacho = run.to_sep005()
    assert {name: value for name, value in first.items() if name != "data"} == {
        "name": "frame", "unit_str": "m/s^2", "quantity": "a", "fs": pytest.approx(10.0)
    }  # fmt: skip
    assert late["time"] == pytest.approx(T.tolist()) and late["fs"] == pytest.approx(10.0) and "quantity" not in late
    assert len(tacho["time"]) == len(tacho["data"]) >= 19 and "fs" not in tacho and tacho["unit_str"] == ""
    assert run.span == (0.0, pytest.approx(max(T[-1], run.times["tacho"][-1]))) and run.rate("late") == pytest.approx(10.0)
    back = MeasuredRun.from_sep005(channels, run.to_sep005())
    for parts in ("times", "values"):
        for name in ("frame", "late", "tacho"):
            np.testing.assert_allclose(getattr(back, parts)[name], getattr(run, parts)[name], rtol=1e-12, atol=1e-12)
    times, speed = run.rotor_speed()  # pulses before speeds
    np.testing.assert_allclose(speed, 2.0 * np.pi / 0.3, rtol=1e-9)
    assert [each.name for each in run.of_kind("pulses", "speed")] == ["late", "tacho"] and len(times) == 19
    alone = MeasuredRun.from_arrays(channels[:1], T, {"frame": WAVE})
    assert alone.rotor_speed() is None


@pytest.mark.parametrize(("kind", "times"), [("acceleration", {"frame": T}), ("pulses", T), ("acceleration", T)])
def test_only_pulses_with_times_of_their_own_need_no_values(kind, times):
    with pytest.raises(jv.InputError, match="values has no entry 'frame'; it has: none"):
        MeasuredRun.from_arrays([jv.Channel("frame", kind)], times, {})


def test_falling_edges_and_times_of_pulses():
    level = np.where(np.arange(600) % 30 > 20, 5.0, 0.0)
    t = 0.01 * np.arange(600)
    edges = {}
    for direction in ("up", "down"):
        channel = jv.Channel("tacho", "pulses", direction=direction)
        edges[direction] = MeasuredRun.from_arrays([channel], t, {"tacho": level}).times["tacho"]
    assert edges["up"][0] == pytest.approx(0.205, abs=1e-9) and edges["down"][0] == pytest.approx(0.295, abs=1e-9)
    given = MeasuredRun.from_arrays([jv.Channel("tacho", "pulses")], {"tacho": edges["up"]}, {})
    np.testing.assert_array_equal(given.times["tacho"], edges["up"])
    np.testing.assert_array_equal(given.values["tacho"], np.arange(edges["up"].size))
    with pytest.raises(jv.InputError, match="values has no entry 'tacho'; it has: none"):
        MeasuredRun.from_arrays([jv.Channel("tacho", "pulses")], edges["up"], {})
    with pytest.raises(jv.InputError, match="values has no entry 'frame'; it has: x"):
        MeasuredRun.from_arrays([jv.Channel("frame", "force")], {"frame": T}, {"x": WAVE})
    with pytest.raises(jv.InputError, match="times has no entry 'frame'; it has: x"):
        MeasuredRun.from_arrays([jv.Channel("frame", "force")], {"x": T}, {"frame": WAVE})


@pytest.mark.parametrize("low", [0.0, -180.0])
def test_whole_turns_are_added_to_an_angle_that_begins_anew(low):
    angle, t = 400.0 + 70.0 * np.arange(200.0), 0.01 * np.arange(200)
    readings = (angle - low) % 360.0 + low
    readings[50] = np.nan
    run = MeasuredRun.from_arrays([jv.Channel("rotor", "angle", unit="deg")], t, {"rotor": readings})
    assert run.notes[0] == "run: channel 'rotor' begins anew in each turn; whole turns were added"
    np.testing.assert_allclose(np.delete(np.diff(run.values["rotor"]), [49, 50]), np.deg2rad(70.0))
    same = MeasuredRun.from_arrays([jv.Channel("rotor", "angle", unit="deg")], t, {"rotor": 5.0 * angle})  # fast, continuous
    np.testing.assert_allclose(same.values["rotor"], np.deg2rad(5.0 * angle))


def test_range_of_a_sensor_clips():
    values = 0.3 * np.sin(np.arange(400.0))
    values[[50, 60]] = 0.9995, -1.2
    run = MeasuredRun.from_arrays([jv.Channel("f", "force", range="1 N")], 0.1 * np.arange(400), {"f": values})
    assert np.flatnonzero(run.clipped["f"]).tolist() == [50, 60]
    (note,) = run.notes
    assert "run: channel 'f' is clipped at about -0.999 N and 0.999 N: 2 of 400 readings, the first at 5 s" in note
    speed = MeasuredRun.from_arrays(
        [jv.Channel("n", "speed")], 0.1 * np.arange(400), {"n": np.minimum(np.arange(400.0), 200.0)}
    )
    assert not np.any(speed.clipped["n"]) and speed.notes == ()  # a speed may stay at its largest value


@pytest.mark.parametrize(
    ("text", "change"),
    [
        ("+10 kg", ("add", "10 kg")), ("- 10 kg", ("add", "-10 kg")), ("+5 %", ("scale", 1.05)), ("-5%", ("scale", 0.95)),
        ("- 5 %", ("scale", 0.95)), (" 95 kg ", ("set", "95 kg")), (95, ("set", 95.0)), ("+a %", ("add", "a %")),
    ],
)  # fmt: skip
def test_changes_in_words(text, change):
    assert parse_change(text, "change") == change


@pytest.mark.parametrize(
    ("kind", "stated", "real", "fits"),
    [("speed", "rpm", 1.0, "rad/s"), ("speed", "", 30.0 / np.pi, "rpm"), ("acceleration", "g", 1.0, "m/s^2")],
)
def test_wrong_unit_in_a_file_names_a_fitting_unit(kind, stated, real, fits):
    time = np.arange(0.0, 20.0, 0.01)
    speed, wave = 20.0 + 2.0 * time, np.random.default_rng(0).normal(size=time.size).cumsum()
    first = ("angle", "rad", 20.0 * time + time**2) if kind == "speed" else ("acceleration", "m/s^2", wave)
    second = (kind, stated, real * (speed if kind == "speed" else wave))
    series = [
        {"name": name, "unit_str": unit, "time": time, "data": data}
        for name, (_, unit, data) in zip(("one", "other"), (first, second), strict=True)
    ]
    channels = [jv.Channel("one", first[0], gain_error=0.0), jv.Channel("other", kind, gain_error=0.0)]
    with pytest.raises(jv.InputError, match=rf"the unit '{re.escape(fits)}' (for 'other' .*)?would fit"):
        jv.MeasuredRun.from_sep005(channels, series)


def test_wrong_samples_are_refused():
    channel = jv.Channel("f", "force")
    for times, values, says in (
        (T, np.zeros((40, 2)), r"has an array of shape \(40, 2\); one list of numbers is needed"),
        (T, WAVE[:-1], "has 40 times but 39 values; each value needs its time"),
        (T, 1e300 * WAVE, "has a reading above 1e\\+100 "),
    ):
        with pytest.raises(jv.InputError, match=rf"^record 2: channel 'f' {says}"):
            MeasuredRun.from_arrays([channel], times, {"f": values}, source="record 2")
    with pytest.raises(jv.InputError, match="channels has the name 'f' twice; names must differ"):
        MeasuredRun.from_arrays([channel, channel], T, {"f": WAVE})
    with pytest.raises(jv.InputError, match="change is empty; write for example"):
        parse_change("  ", "change")


@pytest.mark.parametrize("name", ["none", None, [], np.zeros(2)])
def test_rate_of_an_unknown_channel_is_refused(name):
    run = MeasuredRun.from_arrays([jv.Channel("f", "force")], T, {"f": WAVE})
    assert run.rate("f") == pytest.approx(10.0)
    with pytest.raises(jv.InputError, match=r"^name is "):
        run.rate(name)
