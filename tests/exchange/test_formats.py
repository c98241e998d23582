"""Rules of recorders' formats that a complete run does not show: clocks, rates, names, structures, objects."""

from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.exchange.recordings import formats
from jaxvib.exchange.recordings.formats import _flat, _flat_hdf, _floating, _stated_rate, _with_unique_names, read_channels
from jaxvib.identification.records.recorded import Recorded

T = np.arange(0.0, 1.0, 0.01)
RUN = Path("run.csv")


def read(path, rate=None):
    return {each.name: each for each in read_channels(path, rate)}


def test_rate_replaces_the_times_of_each_channel(tmp_path):
    pytest.importorskip("scipy.io").savemat(tmp_path / "run.mat", {"t": T, "a": np.sin(T), "b": np.cos(T[:50])})
    found = read(tmp_path / "run.mat", 200.0)
    for name, size in (("a", 100), ("b", 50)):
        np.testing.assert_allclose(found[name].time, np.arange(size) / 200.0)
    assert set(read(tmp_path / "run.mat")) == {"a", "b"}


def test_structures_of_matlab_have_separate_times(tmp_path):
    content = {
        "slow": {"t": T[:50], "a": np.sin(T[:50]), "flag": 1.0},
        "fast": {"time": 0.5 * T, "b": np.stack([np.cos(T), np.sin(T)])},
        "alone": np.cos(T[:50]),
        "text": "none",
        "cube": np.zeros((3, 3, 3)),
    }
    pytest.importorskip("scipy.io").savemat(tmp_path / "run.MAT", content)
    found = read(tmp_path / "run.MAT")
    assert list(found) == ["slow.a", "fast.b[0]", "fast.b[1]", "alone"]
    np.testing.assert_array_equal(found["slow.a"].time, T[:50])
    np.testing.assert_array_equal(found["fast.b[1]"].time, 0.5 * T)
    np.testing.assert_array_equal(found["fast.b[1]"].values, np.sin(T))
    np.testing.assert_array_equal(found["alone"].time, T[:50])  # the clock of the same length


@pytest.mark.parametrize(
    ("name", "value", "rate"), [("FS", 50.0, 50.0), ("fs", 0.0, None), ("rate", -3.0, None), ("x", 5.0, None)]
)
def test_rate_of_matlab_arrays_without_times(tmp_path, name, value, rate):
    pytest.importorskip("scipy.io").savemat(tmp_path / "run.mat", {"a": np.sin(T), name: value})
    found = read(tmp_path / "run.mat")["a"]
    if rate is None:
        assert found.time is None
    else:
        np.testing.assert_allclose(found.time, np.arange(100) / rate)


class MatlabOpaque:
    """Object of MATLAB."""


def test_structures_and_objects_are_flat():
    objects = []
    record = np.zeros((), dtype=[("x", "f8"), ("inner", "O")])
    record["x"], record["inner"] = 3.0, {"y": np.arange(4), "z": np.array(["a"]), "o": MatlabOpaque()}
    content = {"s": record, "n": 7, "b": np.array([True]), "c": np.zeros(2, complex), "None": MatlabOpaque()}
    found = dict(_flat(content, "", objects))
    assert list(found) == ["s.x", "s.inner.y", "n", "b"] and objects == ["s.inner.o", "a variable without a name"]
    assert found["s.x"] == 3.0 and found["s.inner.y"].tolist() == [0, 1, 2, 3]
    assert list(_flat(MatlabOpaque(), "", objects)) == [] and objects[-1] == "a variable without a name"


class Dataset:
    """Array of a file of version 7.3."""

    def __init__(self, values, **attributes):
        self.values, self.attrs = np.asarray(values), attributes
        self.dtype, self.ndim = self.values.dtype, self.values.ndim

    def __getitem__(self, key):
        return self.values[key]


class Group(dict):
    """Structure of a file of version 7.3."""

    attrs: ClassVar = {}


def test_arrays_of_version_73():
    objects = []
    content = Group({
        "#refs#": Dataset([1.0]),
        "a": Dataset([[1.0], [2.0]], MATLAB_class=b"double"),
        "s": Group(x=Dataset([5], MATLAB_class="int32"), text=Dataset([65], MATLAB_class=b"char")),
        "cell": Dataset([1.0], MATLAB_class=b"cell"),
        "cube": Dataset(np.zeros((2, 2, 2))),
        "flags": Dataset([True]),
        "tt": Dataset([1.0], MATLAB_class=b"timetable"),
        "o": Dataset([1.0], MATLAB_object_decode=3),
    })  # fmt: skip
    found = dict(_flat_hdf(content, "", objects))
    assert list(found) == ["a", "s.x"] and found["a"].tolist() == [1.0, 2.0] and objects == ["tt", "o"]


def test_names_that_occur_twice_are_numbered():
    found = _with_unique_names([Recorded(name, "", None, T) for name in ("a", "b", "a")])
    assert [each.name for each in found] == ["a 1", "b", "a 2"]
    assert _floating(np.arange(3, dtype=np.int16)).dtype == np.float64 and _floating(T.astype(np.float32)).dtype == np.float32
    assert _floating(np.arange(2, dtype=np.longdouble)).dtype == np.float64


@pytest.mark.parametrize(
    ("line", "rate"),
    [
        ("# rate: 200", 200.0),
        ("fs = 2.5e3 Hz", 2500.0),
        ("Sample rate; 2 kHz", 2000.0),
        ("# rate: 0", None),
        ("rated 5 Hz", None),
        ("Sample rate: 51.2 kS/s", 51200.0),
        ("Sampling rate (kHz): 51.2", 51200.0),
        ("Abtastrate / kHz: 51,2", 51200.0),
        ("rate: 1 MHz", 1e6),
        ("fs=.5 kHz", 500.0),
        ("Sampling Frequency;1000,5 Hz", 1000.5),
        ("Sample rate;2000;kHz", 2e6),
        ("Sample rate;2000;;;", 2000.0),
        ("Sample rate,2000,Channels,4", 2000.0),
        ("rate: 2000 Hz, 24 bit", 2000.0),
    ],
)
def test_rate_in_a_remark(line, rate):
    assert _stated_rate(["# recorder 7", line], RUN) == rate and _stated_rate([], RUN) is None


@pytest.mark.parametrize(
    "line",
    ["rate: 2,000 Hz", "rate: 12 800 Hz", "rate: 2'000", "fs = -5", "Sample rate,2,000 Hz", "rate: 5 m/s", "rate: 1e400 Hz"],
)
def test_rates_that_cannot_be_read_are_refused(line):
    with pytest.raises(
        jv.InputError, match=r"states a sampling rate that cannot be read: .*; write it as '# rate: 2000 Hz', or "
    ):
        _stated_rate([line], RUN)


@pytest.mark.parametrize(
    ("head", "columns"),
    [
        ("time (s),T (N m),frame (g)", (T, T + 20.0, T)),
        ("T (N m),time (s),frame (g)", (T + 20.0, T, T)),
        ("T,t,frame (g)", (T + 20.0, T, T)),
        ("T (degC),frame (g),Zeit", (T + 20.0, T, T)),
    ],
)
def test_a_torque_or_temperature_t_is_no_clock(tmp_path, head, columns):
    (tmp_path / "run.csv").write_text(f"{head}\n" + rows(*columns))
    found = read(tmp_path / "run.csv")
    assert list(found) == ["T", "frame"]
    np.testing.assert_allclose(found["frame"].time, T)
    np.testing.assert_allclose(found["T"].values, T + 20.0)


def test_a_single_column_t_is_the_clock(tmp_path):
    (tmp_path / "run.csv").write_text("T (ms),frame (g)\n" + rows(1e3 * T, T))
    np.testing.assert_allclose(read(tmp_path / "run.csv")["frame"].time, T)


@pytest.mark.parametrize(("clock", "channels"), [(20.0 + 10.0 * T, ["T", "a"]), (5.0 + T, ["a"])])
def test_t_of_matlab_agrees_with_the_stated_rate(tmp_path, clock, channels):
    pytest.importorskip("scipy.io").savemat(tmp_path / "run.mat", {"T": clock, "a": np.sin(T), "fs": 100.0})
    found = read(tmp_path / "run.mat")
    assert list(found) == channels
    np.testing.assert_allclose(found["a"].time, T if channels != ["a"] else clock, atol=1e-12)


def rows(*columns, sign=","):
    return "\n".join(sign.join(f"{x:.6g}" for x in row) for row in zip(*columns, strict=True)) + "\n"


def test_lines_with_numbers_above_the_names_are_skipped(tmp_path):
    (tmp_path / "run.txt").write_text("Device X\n\nSerial 5\ntime\tframe\ns\tg\n0\t1\n0.1\t2\n")
    assert [(each.name, each.unit, each.values.tolist()) for each in read_channels(tmp_path / "run.txt", None)] == [
        ("frame", "g", [1.0, 2.0])
    ]


def test_first_column_without_a_head_is_the_time(tmp_path):
    path = tmp_path / "run.txt"
    path.write_text(rows(T, np.sin(T), np.cos(T)))
    found = read(path)
    assert list(found) == ["column 2", "column 3"]
    np.testing.assert_allclose(found["column 3"].time, T)
    np.testing.assert_allclose(found["column 3"].values, np.cos(T), rtol=1e-5)
    assert list(read(path, 10.0)) == ["column 1", "column 2", "column 3"]


def test_a_single_column_without_a_head_has_readings(tmp_path):
    path = tmp_path / "run.txt"
    path.write_text("# rate: 100 Hz\n" + rows(np.cos(T)))
    (found,) = read(path).values()
    assert found.name == "column 1"
    np.testing.assert_allclose(found.time, T, atol=1e-12)
    np.testing.assert_allclose(found.values, np.cos(T), rtol=1e-5)


def test_units_of_columns(tmp_path):
    """Units in the heads, or in a line below them; times in ms."""
    (tmp_path / "a.csv").write_text("frame (g),Zeit (ms),base\n" + rows(np.sin(T), 1e3 * T, np.cos(T)))
    found = read(tmp_path / "a.csv")
    assert [(each.name, each.unit) for each in found.values()] == [("frame", "g"), ("base", "")]
    np.testing.assert_allclose(found["base"].time, T, atol=1e-12)
    np.testing.assert_allclose(found["frame"].values, np.sin(T), rtol=1e-5)
    (tmp_path / "b.csv").write_text("t,frame,base (mm)\ns,g,V\n" + rows(T, np.sin(T), np.cos(T)))
    assert [(each.name, each.unit) for each in read(tmp_path / "b.csv").values()] == [("frame", "g"), ("base", "mm")]


class Tdms:
    """Channel of a TDMS file."""

    def __init__(self, name, values, **properties):
        self.name, self.values, self.properties, self.dtype = name, np.asarray(values), properties, np.asarray(values).dtype

    def __len__(self):
        return self.values.size

    def __getitem__(self, key):
        return self.values[key]


def test_clocks_and_units_of_tdms(tmp_path, monkeypatch):
    channels = [
        Tdms("Time", T),
        Tdms("own", np.sin(T), wf_increment=0.5, wf_start_offset=2.0, NI_UnitDescription="V"),
        Tdms("with clock", np.cos(T), unit_string="g"),
        Tdms("words", np.array(["a"])),
        Tdms("T", T + 20.0, unit_string="N m"),
    ]
    file = SimpleNamespace(
        file_status=SimpleNamespace(channel_statuses=None), groups=lambda: [SimpleNamespace(channels=lambda: channels)]
    )
    library = SimpleNamespace(TdmsFile=SimpleNamespace(read=lambda path: file))
    monkeypatch.setattr(formats, "optional_module", lambda *_: library)
    (tmp_path / "run.tdms").write_bytes(b"")
    found = read(tmp_path / "run.tdms")
    assert [(each.name, each.unit) for each in found.values()] == [("own", "V"), ("with clock", "g"), ("T", "N m")]
    np.testing.assert_allclose(found["own"].time, 2.0 + 0.5 * np.arange(100))
    np.testing.assert_array_equal(found["with clock"].time, T)
    channels.pop(0)
    assert read(tmp_path / "run.tdms")["with clock"].time is None


def test_histories_of_universal_files(tmp_path, monkeypatch):
    functions = [
        jv.UffFunction("history", T, np.sin(T) + 0j, "velocity", (4, 3), (0, 0), ""),
        jv.UffFunction("response", T, np.sin(T), "velocity", (4, 3), (1, 3), "frf"),
        jv.UffFunction("history", T, np.cos(T), "torque", (4, 3), (0, 0), "shaft"),
    ]
    monkeypatch.setattr(formats, "read_uff", lambda path: SimpleNamespace(functions=functions))
    (tmp_path / "run.58").write_bytes(b"")
    found = read(tmp_path / "run.58")
    assert [(each.name, each.unit, each.values.dtype) for each in found.values()] == [
        ("node 4", "m/s", float),
        ("shaft", "", float),
    ]
    np.testing.assert_array_equal(found["node 4"].values, np.sin(T))


def test_signals_of_mf4(tmp_path, monkeypatch):
    class Mdf:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def iter_channels(self):
            signals = {"a": np.sin(T), "b": np.cos(T), "words": np.array(["x"]), "matrix": np.eye(3)}
            for name, values in signals.items():
                yield SimpleNamespace(name=name, unit="g" if name == "a" else None, samples=values, timestamps=T)

    monkeypatch.setattr(formats, "optional_module", lambda *_: SimpleNamespace(MDF=lambda path: Mdf()))
    (tmp_path / "run.mdf").write_bytes(b"")
    assert [(each.name, each.unit) for each in read(tmp_path / "run.mdf").values()] == [("a", "g"), ("b", "")]


def test_size_in_a_wav_header_may_be_unknown(tmp_path):
    wavfile = pytest.importorskip("scipy.io.wavfile")
    path = tmp_path / "run.wav"
    wavfile.write(path, 100, np.stack([T, 2.0 * T], axis=1).astype(np.float32))
    content = bytearray(path.read_bytes())
    content[4:8] = b"\xff\xff\xff\xff"
    path.write_bytes(content)
    found = read(path)
    assert list(found) == ["channel 1", "channel 2"]
    np.testing.assert_allclose(found["channel 2"].values, 2.0 * T, rtol=1e-6)
    np.testing.assert_allclose(found["channel 2"].time, T)
