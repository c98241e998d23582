"""The command that identifies a bearing's friction."""

import json

import numpy as np
import pytest
from swings import ROD, T, noisy, scipy_swing


@pytest.fixture
def typed(type_, tmp_path, monkeypatch):
    """Runs a command line in a folder with a record in degrees and its measurement file; gives exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    t = T
    clean, _ = scipy_swing(ROD, t, 0.3, 0.0, 1.5e-3)
    angle = np.rad2deg(noisy(clean, 1e-3, 0))
    np.savetxt("swing.csv", np.stack([t, angle], axis=1), delimiter=",", header="time (s), angle (deg)", comments="")
    (tmp_path / "m.toml").write_text(type_("new", "measurement")[1].replace("dry = true", "dry = false"))
    return type_


def test_identify_from_the_command_line(typed, tmp_path):
    code, out, err = typed("identify", "m.toml", "--json", "--out", "o")
    document = json.loads(out)
    assert code == 0 and err == "" and document["status"] == "found"
    assert document["viscous"]["low"] < 1.5e-3 < document["viscous"]["high"] and document["dry"] is None
    np.testing.assert_allclose(document["decrement"]["viscous"]["value"], 1.5e-3, rtol=0.03)
    half = (document["viscous"]["high"] - document["viscous"]["low"]) / 2.0
    assert half > 0.03 * document["viscous"]["value"]
    assert (tmp_path / "o" / "record.png").stat().st_size > 10_000
    kept = np.loadtxt(tmp_path / "o" / "fit.csv", delimiter=",", skiprows=1)
    assert kept.shape == (400, 3) and np.std(kept[:, 1] - kept[:, 2]) < np.rad2deg(1.1e-3)

    (tmp_path / "swing.csv").write_text((tmp_path / "swing.csv").read_text().replace(",", ";").replace(".", ","))
    words = [
        "identify",
        "swing.csv",
        "--decimal-comma",
        "--out",
        "p",
        "--mass",
        "300 g",
        "--length",
        "25 cm",
        "--inertia",
        "0.00625",
    ]
    code, out, err = typed(*words)
    assert code == 0 and "mu1, N m s" in out and "found: the fit explains" in out
    lines = (tmp_path / "p" / "fit.csv").read_text().splitlines()
    assert lines[0] == "time (s);angle (deg);fit (deg)" and lines[2].startswith("0,05") and lines[2].count(";") == 2


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (("swing.csv",), 2, "pendulum.mass is missing; needed here: mass, length"),
        (("swing.csv", "--mass", "3 s", "--length", "1"), 2, "pendulum.mass is '3 s', which is not in kg"),
        (("none.csv", "--mass", "1", "--length", "1"), 2, "none.csv cannot be read"),
        (("m.toml", "--columns", "a,b"), 2, "swing.csv has no column 'a' for the time; its columns are time (s), angle (deg)"),
        (("m.toml", "--columns", "a"), 2, "record.columns is ['a']; write the names of two columns"),
        (("m.toml", "--angle-unit", "rad"), 2, "more than a full turn; if these are degrees"),
        (("m.toml", "--from", "19.9 s"), 2, "has 2 samples from 19.9 s to inf s"),
        (("m.toml", "--instrument", "-1"), 2, "identify.instrument is -1; it must be at least 0"),
        (("swing.csv", "--mass", "1", "--length", "1", "--dry"), 2, "pendulum.bearing is missing"),
    ],
)
def test_wrong_commands(typed, words, code, says):
    got, out, err = typed("identify", *words)
    assert (got, out) == (code, "")
    assert says in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[pendulum]", "[rod]"), "rod is not part of a measurement file"),
        (("mass =", "masses ="), "pendulum.masses is not a field here; did you mean 'mass'"),
        (("dry = false", "dry = 1"), "identify.dry is 1; write true or false"),
        (('file = "swing.csv"', "file = 3"), "record.file is 3; write the path of a CSV file"),
        (("[identify]", "[[identify]]"), "it must be a table; write [identify]"),
    ],
)
def test_wrong_measurement_files(typed, tmp_path, change, says):
    text = (tmp_path / "m.toml").read_text()
    assert change[0] in text
    (tmp_path / "m.toml").write_text(text.replace(*change, 1))
    code, out, err = typed("identify", "m.toml")
    assert (code, out) == (2, "") and says in err
