"""Records of vibrations that do not turn with the rotor, fitted by an unbalance; SciPy integrates the run-up."""

import numpy as np
import pytest
from repeated_records.fits import NAMES, NOISE, TIMES, run_up
from run_ups_by_scipy import TRUTH, ramp, record, scene_of

import jaxvib as jv

SIZE = ["exciters[0].unbalance"]


def run_of(vibration=0.0, turning=ramp):
    """Return the run-up with a further vibration of the first mass, m/s^2."""
    clean, _ = run_up(False)
    readings = clean + np.stack([vibration * np.ones(TIMES.size), np.zeros(TIMES.size)], axis=1)
    return record(TIMES, readings, NOISE, np.random.default_rng(0), turning=turning)


def fit_to(run, throw=False, unknown=NAMES):
    return jv.identify(scene_of(TRUTH), run, unknown=unknown, throw=throw)


def test_tachometer_of_another_shaft_is_contradicted():
    other = run_of(turning=lambda t: tuple(0.8 * each for each in ramp(t)))
    fit = fit_to(other, unknown=SIZE)
    assert fit.status_name == "contradicted"
    (words,) = (note for note in fit.notes if "of the readings of channel 'a2' in run 1 is at 1.2" in note)
    assert "times the rotor speed, but an unbalance turns with the rotor: use the tachometer of the shaft that" in words
    with pytest.raises(jv.ComputationError, match=r"contradicted: .* times the rotor speed, but an unbalance turns"):
        fit_to(other, throw=True, unknown=SIZE)


def test_jammed_vibration_is_contradicted():
    """Loads that are jammed below a resonance at 20 rad/s = 3.18 Hz, while the rotor runs up."""
    strong = 8.0 * np.std(run_up(False)[0][:, 0]) * np.cos(20.0 * TIMES)
    clean, _ = run_up(False)
    run = record(TIMES, clean + strong[:, None], NOISE, np.random.default_rng(0))
    fit = fit_to(run, unknown=SIZE)
    assert fit.status_name == "contradicted"
    assert any("is at 3.18 Hz, but an unbalance turns with the rotor" in note for note in fit.notes), fit.notes


@pytest.mark.parametrize(
    ("vibration", "place"),
    [
        (lambda size: 0.2 * size * np.cos(0.7 * ramp(TIMES)[0]), "at 0.7 times the rotor speed"),
        (lambda size: 0.3 * size * np.cos(20.0 * TIMES), "at 3.18 Hz"),
    ],
)
def test_weaker_foreign_vibration_is_patterned(vibration, place):
    fit = fit_to(run_of(vibration(np.std(run_up(False)[0][:, 0]))))
    assert fit.status_name == "patterned"
    assert [place in note for note in fit.notes if "of the residuals of channel 'a1'" in note and "but" in note] == [True]


def test_unbalance_of_the_rotor_is_not_foreign():
    fit = fit_to(run_of())
    assert fit.status_name == "found" and not any("turns with the rotor" in note for note in fit.notes)
