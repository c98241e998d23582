"""Records of swings as laboratories write them, and what is said about wrong ones."""

import os

import numpy as np
import pytest
from file_texts import RECORD
from mutations import file_outcome, mutated_text, numbers_of_csv, record_key, seeded
from swings import ROD

import jaxvib as jv
from jaxvib.units import columns


def table(head, separator=",", comma=False, factor=1.0):
    lines = [separator.join((f"{k / 10 * factor:.3f}", f"{0.1 * (-1) ** k:.3f}")) for k in range(20)]
    return head + "".join((line.replace(".", ",") if comma else line) + "\n" for line in lines)


@pytest.mark.parametrize(
    ("text", "degrees"),
    [
        (table(""), False),
        (table("# camera 3\n\ntime,angle\n"), False),
        (table("time (s), angle (deg)\n"), True),
        (table("t [ms];phi [°]\n", ";", True, 1000.0), True),
        (table("time_s\tangle_deg\n", "\t"), True),
        (table("Time;Angle\ns;deg\n", ";"), True),
        (table('"time / s", "angle / mrad"\n'), None),
        (table("", " "), False),
        (table("TIME,ANGLE_DEG\n"), True),
        (table("Time [MS]\tAngle [Deg]\n", "\t", False, 1000.0), True),
        (table("t.ms;phi deg\n", ";", False, 1000.0), True),
        (table("clock (s), deflection (degrees)\n"), True),
    ],
)
def test_records_of_laboratories_are_read(tmp_path, text, degrees):
    path = tmp_path / "swing.csv"
    path.write_text(text, encoding="utf-8")
    record = jv.read_record(path)
    np.testing.assert_allclose(record.time, np.arange(20) / 10, rtol=1e-12)
    unit = {True: np.pi / 180.0, False: 1.0, None: 1e-3}[degrees]
    np.testing.assert_allclose(record.angle, 0.1 * unit * (-1.0) ** np.arange(20), rtol=1e-12)


@pytest.mark.parametrize("columns", [["time_ms", "theta_deg"], ["TIME_MS", " Theta_Deg"], ["time", "theta"]])
def test_columns_are_named_as_in_the_file(tmp_path, columns):
    path = tmp_path / "swing.csv"
    path.write_text("time_ms,theta_deg,rate\n" + "".join(f"{100 * k},{k % 3},0\n" for k in range(20)))
    record = jv.read_record(path, columns=columns)
    np.testing.assert_allclose(record.time, np.arange(20) / 10, rtol=1e-12)
    np.testing.assert_allclose(record.angle, np.deg2rad(np.arange(20) % 3), rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "contains no lines of numbers; it needs two columns"),
        ("time, angle\n", "contains no lines of numbers below its header"),
        (table("").replace("0.300,-0.100", "0.300,oops"), "line 4 has 'oops' where the angle should be"),
        (table("").replace("0.300,-0.100", "0.300,nan"), "line 4 has 'nan' where the angle should be; a finite number"),
        (table("# a\ntime,angle\n").replace("0.300,-0.100", "0.300"), "line 6 has 1 columns; the lines above have 2"),
        (
            table("").replace("0.300,", "0.100,"),
            "line 4 has the time 0.1 s, and 0.2 s in the line before it; times must ascend",
        ),
        ("0.1\n0.2\n", "has one column; two are needed"),
        ("1,2,3\n", "has 3 columns but no line of names"),
        ("time, x, y\n1,2,3\n", "has no column 'angle' for the angle; its columns are time, x, y"),
        (table("time (s), angle (kg)\n"), "unit of angle is 'kg', which is not a unit of angle here; write rad, mrad, deg"),
        (table("time (s), angle (percent)\n"), "unit of angle is 'percent', which is not a unit of angle here"),
        (table("time (s), angle (%)\n"), "unit of angle is '%', which is not a unit of angle here"),
        (table("clock (s), deflection\n"), "has the column 'deflection' for the angle, whose unit is unknown; write angle"),
        (table("TIME,ANGLE_RAW\n"), "has the column 'ANGLE_RAW' for the angle, whose unit is unknown"),
        (table("frame,angle_deg\n"), "has the column 'frame' for the time, whose unit is unknown; write time (s)"),
        ("0,1\n1,2\n", "has 2 samples; a swing needs at least 16"),
        (table("").replace("0.100\n", "25.0\n"), "more than a full turn; if these are degrees, give the unit"),
    ],
)
def test_errors_of_tables_name_the_line(tmp_path, text, says):
    path = tmp_path / "swing.csv"
    path.write_text(text)
    with pytest.raises(jv.InputError) as error:
        jv.read_record(path)
    assert says in str(error.value) and str(error.value).startswith(str(path))


def test_long_texts_are_no_units():
    """Pint takes minutes for 100,000 characters; such texts do not reach it."""
    assert columns.unit_factor("rad" + "*m/m" * 24, "rad") == 1.0
    for text in ("rad" + "*m/m" * 25, "m" * 100_000, "2 " + "m" * 100_000):
        assert columns.unit_factor(text, "rad") is None


@pytest.mark.parametrize("unit", ["m" * 100_000, "1 " + "m" * 100_000])
def test_long_texts_as_unit_of_a_record_are_refused(tmp_path, unit):
    path = tmp_path / "swing.csv"
    path.write_text(table(""))
    with pytest.raises(jv.InputError) as error:
        jv.read_record(path, angle_unit=unit)
    assert "not a unit of angle" in str(error.value) and len(str(error.value)) < 500


def test_wrong_records(tmp_path):
    t = np.arange(20.0)
    wrong = [
        ((t, t[:5]), r"has shapes time \(20,\), angle \(5,\)"),
        ((t, ["a"] * 20), "it must be an array of numbers"),
        ((t, np.where(t == 3, np.inf, 0.0)), "has angle inf at sample 4"),
        ((np.where(t == 3, 1.0, t), t), "has the time 1 s at sample 4, and 2 s at the sample before it"),
    ]
    for given, says in wrong:
        with pytest.raises(jv.InputError, match=says):
            jv.Record(*given)
    with pytest.raises(jv.InputError, match="has 3 samples from 1 s to 3 s; it goes from 0 s to 19 s"):
        jv.Record(t, 0.01 * t).between(1.0, 3.0)
    with pytest.raises(jv.InputError, match="cannot be read"):
        jv.read_record(tmp_path / "none.csv")
    with pytest.raises(jv.InputError, match="has 0 turning points; at least 3"):
        jv.identify(ROD, jv.Record(t, 0.01 * t))
    with pytest.raises(jv.InputError, match=r"has \d samples about the turning point at .* s; 5 are needed"):
        jv.identify(ROD, jv.Record(t, 0.1 * np.cos(np.pi * t / 3.0)))
    with pytest.raises(jv.InputError, match=r"records\[0\] is .*; it must be a MeasuredRun"):
        jv.identify(ROD, (t, t))
    with pytest.raises(jv.InputError, match=r"instrument is 2.0; it is the relative uncertainty of J"):
        jv.identify(ROD, jv.Record(t, 0.01 * t), instrument=2.0)
    with pytest.raises(jv.InputError, match=r"instrument is -1.0; it is the relative uncertainty of J"):
        jv.ten_periods(ROD, jv.Record(t, 0.01 * t), instrument=-1.0)
    with pytest.raises(jv.InputError, match=r"pendulum.bearing is missing"):
        jv.identify(jv.BearingPendulum(0.3, 0.2), jv.Record(t, 0.01 * t), dry=True)


def test_records_in_one_line_and_pipes_are_refused_at_once(tmp_path):
    path = tmp_path / "line.csv"
    path.write_text("time,angle\n" + "1.0," * 5_000_000)
    with pytest.raises(jv.InputError, match=r"line 2 has more than 10000 characters; give one row in each line"):
        jv.read_record(path)
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(jv.InputError, match="a pipe or a device"):
        jv.read_record(tmp_path / "pipe.csv")


def test_mutated_records_are_refused_or_other_numbers(tmp_path):
    path = tmp_path / "record.csv"
    path.write_text(RECORD)
    base = RECORD, record_key(jv.read_record(path))
    found = [
        file_outcome(path, mutated_text(RECORD, seeded(seed)), jv.read_record, record_key, base, numbers_of_csv)
        for seed in range(300)
    ]
    assert [(seed, each) for seed, each in enumerate(found) if each[0] not in ("refused", "accepted")] == []
    assert sum(kind == "refused" for kind, _ in found) > 100
