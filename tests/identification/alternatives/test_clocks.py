"""Drift between the clocks of a tachometer and of vibration sensors."""

import dataclasses

import numpy as np
import pytest
from repeated_records.fits import NAMES, NOISE, TIMES, run_up
from run_ups_by_scipy import TRUTH, accelerations, ramp, record, scene_of

import jaxvib as jv
from jaxvib.identification.alternatives.clocks import _DELAY, _DRIFT, _with_drift
from jaxvib.identification.angle import rotor_angles


def run_of(drift, accelerations):
    """Return a record whose sensors have a clock that is fast by `drift` against that of the tachometer."""
    run = record(TIMES, accelerations, NOISE, np.random.default_rng(0))
    return dataclasses.replace(run, times=run.times | {"tacho": (1.0 - drift) * run.times["tacho"]})


def first_values():
    return scene_of({name: value * (1.02 if "stiffness" in name else 1.0) for name, value in TRUTH.items()})


def test_angle_of_a_drifting_clock():
    (rotor,) = rotor_angles(scene_of(TRUTH), run_of(0.0, np.zeros((TIMES.size, 2))))
    drive, begin = _with_drift(rotor).drive, rotor.span[0]
    errors = np.zeros(drive.table.shape[2] - 1)
    errors[:2] = 1e-3 / _DRIFT, 2e-3 / _DELAY
    drifted = drive.with_errors(errors)
    for time in (2.0, 9.0, 15.0):
        assert drive.angle_at(time) == pytest.approx(ramp(time)[0], abs=1e-3)
        expected = ramp(time - 1e-3 * (time - begin) - 2e-3)[0] - ramp(time)[0]
        assert drifted.angle_at(time) - drive.angle_at(time) == pytest.approx(expected, abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("drift", [1e-3, -3e-4, 1e-4])
def test_drift_of_the_clock_of_the_sensors_is_noted(drift):
    fit = jv.identify(first_values(), run_of(drift, run_up(False)[0]), unknown=NAMES)
    assert fit.status_name == "patterned"
    (note,) = [note for note in fit.notes if "against that of the tachometer" in note]
    assert f"is {'fast' if drift > 0.0 else 'slow'} against" in note
    assert float(note.split("(")[1].split(" ppm")[0]) == pytest.approx(1e6 * abs(drift), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("drift", [3e-5, 3e-4])
def test_drift_between_two_accelerometers_is_patterned(drift):
    """The clock of the second accelerometer runs fast; the note on the clock of the tachometer would be wrong."""
    clean = run_up(False)[0]
    drifted = accelerations((1.0 - drift) * TIMES, [TRUTH])[0]
    readings = np.stack([clean[:, 0], drifted[:, 1]], axis=1)
    fit = jv.identify(first_values(), run_of(0.0, readings), unknown=NAMES, throw=False)
    assert fit.status_name == "patterned"
    assert not any("clock" in note or "fits clearly better" in note for note in fit.notes)
