"""The command that describes a recording."""

import json

import numpy as np
import pytest

T = np.arange(0.0, 10.0, 1e-3)
ANGLE = 20.0 * T + 2.0 * T**2


@pytest.fixture
def typed(type_, tmp_path, monkeypatch):
    """Runs a command line in a folder with a recording of a run-up; gives exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    frame = np.clip(np.sin(ANGLE), -2.0, 0.8)
    frame[700] = np.nan
    kept = np.delete(np.arange(T.size), np.arange(4000, 4200))
    columns = np.stack([T, frame, 5.0 * (np.mod(ANGLE, 2.0 * np.pi) < 0.4), (20.0 + 4.0 * T) * 30.0 / np.pi], axis=1)[kept]
    np.savetxt("run.csv", columns, delimiter=",", header="time (s),frame (g),tacho (V),n (rpm)", comments="", fmt="%.7g")
    return type_


@pytest.mark.parametrize("source", [("--pulses", "tacho"), ("--speed", "N"), ()])
def test_recording_is_described(typed, tmp_path, source):
    code, out, err = typed("record", "run.csv", *source, "--json", "--out", "o")
    document = json.loads(out)
    frame, tacho, speed = document["channels"]
    assert (code, err) == (0, "") and (frame["name"], frame["unit"], frame["kinds"]) == ("frame", "g", ["acceleration"])
    assert frame["rate"] == pytest.approx(1000.0) and frame["missing"] == 201 and 1000 < frame["clipped"] < 3000
    assert tacho["kinds"] == [] and tacho["clipped"] == 0 and speed["kinds"] == ["speed"]
    said = " ".join(document["notes"])
    assert "channel 'frame' has 1 gap; the longest is 0.201 s at 3.999 s" in said and "channel 'frame' is clipped at" in said
    assert "channel 'frame' has 1 reading that is not a number" in said and "channel 'tacho' has two levels, like" in said
    assert document["speed"]["low"] == pytest.approx(20.0, rel=0.1) and document["speed"]["high"] == pytest.approx(
        60.0, rel=0.1
    )
    assert (tmp_path / "o" / "recording.png").stat().st_size > 10_000


def test_recording_is_described_by_a_text(typed):
    code, out, err = typed("record", "run.csv", "--pulses", "tacho")
    assert (code, err) == (0, "")
    assert "rate, Hz" in out and "rotor speed" in out and "rpm" in out and "has 1 gap" in out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("none.csv",), "none.csv cannot be read"),
        (("run.csv", "--pulses", "key"), "pulses is 'key'; the channels are 'frame', 'tacho', 'n'"),
        (("run.csv", "--speed", "frame"), "speed is 'frame', which is in 'g'; give a channel in rpm, rad/s or Hz"),
        (("run.csv", "--rate", "2 kg"), "rate is '2 kg', which is not in Hz"),
        (("run.csv", "--pulses", "n"), "channel 'n' has 1 pulse; at least 12 are needed"),
    ],
)
def test_wrong_commands(typed, words, says):
    code, out, err = typed("record", *words)
    assert (code, out) == (2, "") and says in err and err.count("\n") == 1


def test_a_scene_file_is_not_a_recording(typed):
    assert "machine.toml is a file of jaxvib, not a recording" in typed("record", "machine.toml")[2]


def test_channel_with_wrong_times_is_noted(typed, tmp_path):
    (tmp_path / "bad.csv").write_text("time (s),frame (g)\n" + "".join(f"{k // 2},{k % 3}\n" for k in range(40)))
    code, out, _ = typed("record", "bad.csv", "--json")
    assert code == 0 and "has the time 0 s twice, at samples 1 and 2" in json.loads(out)["notes"][0]


def test_velocity_of_a_vibration_is_printed(typed, tmp_path):
    t = np.arange(0.0, 4.0, 1e-3)
    rows = "".join(f"{x:.3f};{np.sin(2.0 * np.pi * 20.0 * x):.4f}\n" for x in t).replace(".", ",")
    (tmp_path / "bearing.csv").write_text("Zeit [s];Lager [g]\n" + rows)
    code, out, _ = typed("record", "bearing.csv")
    (line,) = [line for line in out.splitlines() if "0.7071 g" in line]
    frequency, velocity = (float(line.split()[k]) for k in (-4, -2))
    assert code == 0 and frequency == 20.0
    np.testing.assert_allclose(velocity, 1e3 * 9.80665 / (2.0 * np.pi * 20.0 * np.sqrt(2.0)), rtol=1e-3)
