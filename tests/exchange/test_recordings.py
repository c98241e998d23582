"""Recordings in the formats of recorders, each written by an independent library, and read as one run."""

import pathlib

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.exchange.recordings.overview import overview_of

T = np.arange(0.0, 2.0, 1e-3)
FRAME = np.sin(60.0 * T) + 0.2 * np.cos(131.0 * T)
BASE = 0.3 * np.cos(60.0 * T)
LEVEL = np.where((25.0 * T + 0.01) % 1.0 < 0.2, 5.0, 0.0)

CHANNELS = [
    jv.Channel("frame", "acceleration", at=2),
    jv.Channel("base", "velocity", at=1),
    jv.Channel("tacho", "pulses"),
]


def write_csv(path):
    rows = [f"{t:.4f};{a:.9f};{b:.9f};{c:.1f}".replace(".", ",") for t, a, b, c in zip(T, FRAME, BASE, LEVEL, strict=True)]
    path.write_text("recorder 7\nstate;ready\n\ntime [s];frame [g];base [mm/s];tacho [V]\n" + "\n".join(rows) + "\n")


def write_tdms(path):
    nptdms = pytest.importorskip("nptdms")
    channels = [
        nptdms.ChannelObject("run", name, data, {"wf_increment": 1e-3, "wf_start_offset": 0.0, "unit_string": unit})
        for name, data, unit in (("frame", FRAME, "g"), ("base", BASE, "mm/s"), ("tacho", LEVEL, "V"))
    ]
    with nptdms.TdmsWriter(str(path)) as file:
        file.write_segment(channels)


def write_uff(path):
    pyuff = pytest.importorskip("pyuff")
    names = {
        "abscissa_axis_lab": "Time",
        "abscissa_axis_units_lab": "s",
        "ordinate_axis_lab": "",
        "ordinate_axis_units_lab": "",
    }
    names |= {"orddenom_axis_lab": "NONE", "orddenom_axis_units_lab": "NONE"}
    place = {"type": 58, "func_type": 1, "rsp_node": 1, "rsp_dir": 3, "ref_node": 0, "ref_dir": 0, "orddenom_spec_data_type": 0}
    times = {"x": T, "abscissa_spacing": 1, "abscissa_inc": 1e-3, "abscissa_spec_data_type": 17}
    sets = [
        {**names, **place, **times, "id1": name, "data": data, "ordinate_spec_data_type": kind}
        for name, data, kind in (("frame", 9.80665 * FRAME, 12), ("base", 1e-3 * BASE, 11), ("tacho", LEVEL, 0))
    ]
    pyuff.UFF(str(path)).write_sets(sets, mode="overwrite")


def write_mat(path):
    scipy_io = pytest.importorskip("scipy.io")
    scipy_io.savemat(path, {"t": T, "frame": 9.80665 * FRAME, "base": 1e-3 * BASE, "tacho": LEVEL, "note": "run 3"})


def write_mat_73(path):
    with pytest.importorskip("h5py").File(path, "w") as file:
        for name, data in (("t", T), ("frame", 9.80665 * FRAME), ("base", 1e-3 * BASE), ("tacho", LEVEL)):
            file.create_dataset(name, data=data[:, None]).attrs["MATLAB_class"] = np.bytes_("double")
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    content = path.read_bytes()
    path.write_bytes(head.ljust(512, b"\x00") + content)


def write_mf4(path):
    asammdf = pytest.importorskip("asammdf")
    signals = [
        asammdf.Signal(samples=data, timestamps=T, name=name, unit=unit)
        for name, data, unit in (("frame", FRAME, "g"), ("base", BASE, "mm/s"), ("tacho", LEVEL, "V"))
    ]
    with asammdf.MDF(version="4.10") as file:
        file.append(signals)
        file.save(path, overwrite=True)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("run.csv", write_csv),
        ("run.tdms", write_tdms),
        ("run.uff", write_uff),
        ("run.mat", write_mat),
        ("run73.mat", write_mat_73),
        ("run.mf4", write_mf4),
    ],
)
def test_each_format_gives_the_same_run(tmp_path, name, write):
    write(tmp_path / name)
    run = jv.read_run(tmp_path / name, CHANNELS, start="0.5 s", until="1.5 s", change={"machine.mass[0]": "+10 kg"})
    part = slice(500, 1501)
    np.testing.assert_allclose(run.times["frame"], T[part], atol=1e-9)
    np.testing.assert_allclose(run.values["frame"], 9.80665 * FRAME[part], atol=1e-6)
    np.testing.assert_allclose(run.values["base"], 1e-3 * BASE[part], atol=1e-9)
    np.testing.assert_allclose(np.diff(run.times["tacho"]), 0.04, atol=1e-9)
    assert run.source == str(tmp_path / name) and run.change["machine.mass[0]"].action == "add"
    without_unit = ("frame", "base") if name.endswith(".mat") else ()
    assert [note.split(": ", 1)[1] for note in run.notes] == [
        f"channel '{each}' has no unit in the file; its readings are taken as {si}"
        for each, si in zip(without_unit, ("m/s^2", "m/s"), strict=False)
    ]


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.uint8, np.float32])
def test_wav_is_relative_to_its_full_scale(tmp_path, kind):
    wavfile = pytest.importorskip("scipy.io.wavfile")
    size = {np.int16: 2**15, np.int32: 2**31, np.uint8: 2**7, np.float32: 1.0}[kind]
    data = np.stack([0.5 * FRAME, BASE], axis=1) * size * 0.99 + (128 if kind is np.uint8 else 0)
    wavfile.write(tmp_path / "run.wav", 1000, data.astype(kind))
    channels = [jv.Channel("channel 1", "acceleration", unit="50 g"), jv.Channel("channel 2", "force")]
    run = jv.read_run(tmp_path / "run.wav", channels)
    error = {np.uint8: 1.1 / 128}.get(kind, 4e-5)
    np.testing.assert_allclose(run.values["channel 1"], 50.0 * 9.80665 * 0.495 * FRAME, atol=491.0 * error)
    np.testing.assert_allclose(run.values["channel 2"], 0.99 * BASE, atol=error)
    assert run.rate("channel 1") == pytest.approx(1000.0)


def test_structures_and_matrices_of_matlab_are_channels(tmp_path):
    scipy_io = pytest.importorskip("scipy.io")
    content = {"rec": {"time": T, "acc": np.stack([FRAME, BASE], axis=1)}, "fs": 1e3}
    scipy_io.savemat(tmp_path / "run.mat", content)
    names = [each.name for each in jv.read_recording(tmp_path / "run.mat")]
    assert names == ["rec.acc[0]", "rec.acc[1]"]
    run = jv.read_run(tmp_path / "run.mat", [jv.Channel("rec.acc[1]", "acceleration")])
    np.testing.assert_allclose(run.values["rec.acc[1]"], BASE, atol=1e-12)


@pytest.mark.parametrize("name", ["testobject_7.4_GLNX86.mat", "parabola.mat"])
def test_objects_of_matlab_raise_a_clear_error(name):
    folder = pathlib.Path(pytest.importorskip("scipy.io.matlab").__file__).parent / "tests" / "data"
    if not (folder / name).exists():
        pytest.skip("scipy was installed without its test data")
    with pytest.raises(jv.InputError, match=r"holds objects of MATLAB \(.*\), such as timetables .* in MATLAB, save arrays"):
        jv.read_recording(folder / name)


def test_objects_of_matlab_73_raise_a_clear_error(tmp_path):
    path = tmp_path / "run.mat"
    with pytest.importorskip("h5py").File(path, "w") as file:
        found = file.create_dataset("tt", data=np.arange(6, dtype=np.uint32)[:, None])
        found.attrs["MATLAB_class"], found.attrs["MATLAB_object_decode"] = np.bytes_("timetable"), np.int32(3)
    path.write_bytes((b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM").ljust(512, b"\x00") + path.read_bytes())
    with pytest.raises(jv.InputError, match=r"holds objects of MATLAB \(tt\)"):
        jv.read_recording(path)


@pytest.mark.parametrize("line", ["# rate: 2000 Hz", "# fs = 2000", "# Sampling rate (Hz): 2e3", "# sampling frequency; 2 kHz"])
def test_one_column_takes_its_rate_from_a_remark(tmp_path, line):
    path = tmp_path / "run.txt"
    path.write_text(f"{line}\nframe (g)\n" + "".join(f"{x:.6f}\n" for x in FRAME))
    run = jv.read_run(path, [jv.Channel("frame", "acceleration")])
    assert run.rate("frame") == pytest.approx(2000.0) and run.values["frame"].size == T.size


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_names_in_a_comment_are_read(tmp_path, mark):
    rows = np.column_stack([1e3 * T, FRAME])
    head = mark.join(["time (ms)", "frame (g)"])
    np.savetxt(tmp_path / "run.csv", rows, delimiter=mark, header=f"recorder 7, state ready\n{head}\n2 channels")
    run = jv.read_run(tmp_path / "run.csv", CHANNELS[:1])
    np.testing.assert_allclose(run.times["frame"], T, atol=1e-9)
    np.testing.assert_allclose(run.values["frame"], 9.80665 * FRAME, atol=1e-6)


def test_rate_replaces_times_of_the_file(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("time (s),frame\n" + "".join(f"{t:.2f},{x:.6f}\n" for t, x in zip(T, FRAME, strict=True)))
    with pytest.raises(jv.InputError, match=r"has the time 0 s twice, at samples 1 and 2; .* give the sampling rate `rate`"):
        jv.read_run(path, [jv.Channel("frame", "acceleration")])
    run = jv.read_run(path, [jv.Channel("frame", "acceleration")], rate="1 kHz")
    np.testing.assert_allclose(run.times["frame"], T, atol=1e-12)


def test_empty_cells_are_missing_readings(tmp_path):
    path = tmp_path / "run.csv"
    slow = ["" if k % 4 else f"{x:.6f}" for k, x in enumerate(BASE)]
    fast = ["NaN" if k == 7 else f"{x:.6f}" for k, x in enumerate(FRAME)]
    path.write_text(
        "time (ms),frame,base\n" + "".join(f"{k},{a},{b}\n" for k, (a, b) in enumerate(zip(fast, slow, strict=True)))
    )
    run = jv.read_run(path, [jv.Channel("frame", "acceleration"), jv.Channel("base", "force")])
    assert np.flatnonzero(np.isnan(run.values["frame"])).tolist() == [7]
    assert (run.rate("frame"), run.rate("base")) == (pytest.approx(1000.0), pytest.approx(250.0))


def text(head="time (s),frame (g)\n", rows=40):
    return head + "".join(f"{k / 10:.1f},{0.1 * (-1) ** k:.2f}\n" for k in range(rows))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (text().replace("0.3,", '0.3,"'), "line 5 has a quotation mark without its partner"),
        (text().replace("0.3,", "0.3,7,"), "line 5 has 3 columns; the lines above have 2"),
        (text("time (s),frame (g),base (g)\n"), "line 2 has 2 columns; the lines above have 3"),
        (text().replace("0.3,-0.10", "0.3,oops"), "line 5 has 'oops' where the frame should be; a finite number is needed"),
        (text("clock (s),frame (g)\n"), "has no column of times; its columns are clock (s), frame (g): rename the column"),
        (text("time (kg),frame (g)\n"), "unit of time is 'kg', which is not a unit of time; write s, ms, us or min"),
        (text("time (s),frame (mm)\n"), "channel 'frame' is in 'mm' in the file, which is not a unit of acceleration; correct"),
        (text("time (s),base (g)\n"), "channel 'frame' is not in the file; its channels are 'base'"),
        (text(rows=9), "has 9 samples; at least 16 are needed"),
        ("time (s)\n" + "0.1\n" * 30, "has a column of times only"),
        ("", "contains no lines of numbers; it needs time and readings"),
    ],
)
def test_wrong_files_raise_clear_errors(tmp_path, content, says):
    path = tmp_path / "run.csv"
    path.write_text(content)
    with pytest.raises(jv.InputError) as error:
        jv.read_run(path, [jv.Channel("frame", "acceleration")])
    assert says in str(error.value) and str(error.value).startswith(str(path))


@pytest.mark.parametrize("name", ["run.tdms", "run.uff", "run.mat", "run.wav", "run.mf4"])
def test_damaged_files_raise_clear_errors(tmp_path, name):
    module = {"tdms": "nptdms", "uff": "pyuff", "mat": "scipy.io", "wav": "scipy.io", "mf4": "asammdf"}[name[4:]]
    pytest.importorskip(module)
    (tmp_path / name).write_bytes(b"not a recording " * 40)
    with pytest.raises(jv.InputError):
        jv.read_recording(tmp_path / name)
    with pytest.raises(jv.InputError, match="cannot be read"):
        jv.read_recording(tmp_path / f"missing_{name}")


def write_wav(path):
    wavfile = pytest.importorskip("scipy.io.wavfile")
    wavfile.write(path, 1000, np.stack([FRAME, BASE], axis=1).astype(np.float32))


@pytest.mark.parametrize("share", [0.5, 0.9, 0.998])
@pytest.mark.parametrize(
    ("name", "write", "says"),
    [
        ("run.csv", write_csv, r"line \d+ has [123] columns; the lines above have 4"),
        ("run.tdms", write_tdms, "where its header states 2000: the recording was cut off"),
        ("run.uff", write_uff, "whose last dataset was cut off; export it again"),
        ("run.wav", write_wav, "bytes where its header states 16058: the recording was cut off; export it again"),
        ("run.mat", write_mat, r"cannot be read as a MATLAB file \(could not read bytes\); export it again"),
        ("run73.mat", write_mat_73, r"cannot be read as a MATLAB file .*truncated file.*; export it again"),
    ],
)
def test_recordings_that_were_cut_off_are_refused(tmp_path, name, write, says, share):
    write(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(share * len(content)) // 36 * 36])
    with pytest.raises(jv.InputError, match=says):
        jv.read_recording(tmp_path / name)


@pytest.mark.parametrize("stated", [1990, 2010])
def test_number_of_values_in_a_header_is_compared_with_the_data(tmp_path, stated):
    write_uff(tmp_path / "run.uff")
    text = (tmp_path / "run.uff").read_text()
    (tmp_path / "run.uff").write_text(text.replace("      2000 ", f"      {stated} ", 1))
    with pytest.raises(jv.InputError, match=f"whose function 1 has 2000 values where its header states {stated}; export"):
        jv.read_recording(tmp_path / "run.uff")


def test_times_and_values_of_different_length_are_refused(tmp_path):
    pytest.importorskip("scipy.io").savemat(tmp_path / "run.mat", {"t": T[:-5], "frame": FRAME})
    with pytest.raises(jv.InputError, match="has 1995 times but 2000 values; save both with the same length"):
        jv.read_run(tmp_path / "run.mat", [jv.Channel("frame", "acceleration")])


def test_dictionaries_of_sep005_are_read_and_returned():
    series = [
        {"name": "frame", "unit_str": "g", "fs": 1000.0, "data": FRAME},
        {"name": "base", "unit_str": "mm/s", "time": T.tolist(), "data": BASE.tolist()},
        {"name": "tacho", "unit_str": "V", "fs": 1000.0, "data": LEVEL},
    ]
    run = jv.MeasuredRun.from_sep005(CHANNELS, series)
    np.testing.assert_allclose(run.values["frame"], 9.80665 * FRAME, rtol=1e-12)
    back = run.to_sep005()
    assert [(each["name"], each["unit_str"]) for each in back] == [("frame", "m/s^2"), ("base", "m/s"), ("tacho", "")]
    pytest.importorskip("sdypy_sep005.sep005").assert_sep005(back)
    again = jv.MeasuredRun.from_sep005(CHANNELS[:2], back)
    np.testing.assert_array_equal(again.values["base"], run.values["base"])


@pytest.mark.parametrize("lost", ["data", "name", "unit_str", "fs"])
def test_incomplete_dictionaries_of_sep005_are_refused(lost):
    entry = {"name": "frame", "unit_str": "g", "fs": 1000.0, "data": FRAME}
    del entry[lost]
    with pytest.raises(jv.InputError, match=rf"run: timeseries\[0\] has no entry '{lost}'; SEP-005 needs"):
        jv.MeasuredRun.from_sep005(CHANNELS[:1], [entry])


def test_missing_library_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "run.tdms").write_bytes(b"TDSm")
    monkeypatch.setitem(__import__("sys").modules, "nptdms", None)
    with pytest.raises(jv.InputError, match=r"nptdms is not installed; install it with: pip install '.\[tdms\]'"):
        jv.read_recording(tmp_path / "run.tdms")


def test_rate_of_a_recording_does_not_depend_on_its_start(tmp_path):
    rows = [f"{5.0 + 0.01 * k:.2f},{np.sin(0.3 * k):.6f}" for k in range(200)]
    (tmp_path / "run.csv").write_text("time [s],frame [g]\n" + "\n".join(rows) + "\n")
    (found,) = map(overview_of, jv.read_recording(tmp_path / "run.csv"))
    assert found.rate == pytest.approx(100.0, rel=1e-6) and (found.start, found.end) == (5.0, 6.99)
    assert (found.low, found.high) == pytest.approx((-1.0, 1.0), abs=0.02) and found.low < 0.0 < found.high


def test_file_above_the_limit_of_size_is_refused(tmp_path):
    with (tmp_path / "run.csv").open("wb") as file:
        file.truncate(2**32 + 1)  # takes no space on the disk
    with pytest.raises(jv.InputError, match=r"is larger than 4 GB; split it"):
        jv.read_recording(tmp_path / "run.csv")
