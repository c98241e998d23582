"""Impact test of a beam, published by others (tests/data/beam_frf_3points.csv, MIT licence): accelerances of three points.

Source: github ladisk/pyuff, data/meas_point_1.txt to meas_point_3.txt. The inverse transform of an accelerance is the free
decay of the beam after an impact. A machine whose coordinates are modes is fitted to it: the state at the first sample is free,
and natural frequencies and damping ratios are unknown. sdypy-EMA fits a rational function to the accelerances (LSCF).
"""

import pathlib

import numpy as np
import pytest

import jaxvib as jv

RECORD = pathlib.Path(__file__).parents[1] / "data" / "beam_frf_3points.csv"
FIRST = np.array([51.5, 142.2, 278.7, 460.4, 687.2, 958.5])
"""Peaks of the accelerances, Hz."""


def accelerances():
    """Return frequencies, Hz, and the accelerances (3, n) of the points."""
    frequency, *parts = np.loadtxt(RECORD, delimiter=",", skiprows=3).T
    return frequency, np.array(parts[::2]) + 1j * np.array(parts[1::2])


def by_sdypy():
    """Return natural frequencies, Hz, and damping ratios by sdypy-EMA."""
    ema = pytest.importorskip("sdypy.EMA")
    frequency, response = accelerances()
    model = ema.Model(response, frequency, lower=20, upper=990, pol_order_high=50, frf_form="accelerance")
    model.get_poles(show_progress=False)
    found, ratio = model.pole_freq[-1], model.pole_xi[-1]
    nearest = [int(np.argmin(np.abs(found - each))) for each in FIRST]
    return found[nearest], ratio[nearest]


@pytest.mark.slow
def test_modes_of_the_beam_agree_with_sdypy():
    """The ratios of the modes 1, 5 and 6 are less certain: the band ends at 1000 Hz, and the decay lasts one second only."""
    frequency, response = accelerances()
    decays = 2.0 * frequency[-1] * np.fft.irfft(response)
    inside, w = slice(20, 1980), 2.0 * np.pi * FIRST
    frame = jv.Channel("frame", "acceleration", at=1, gain_error=0.0)
    time = (np.arange(2000) / 2000.0)[inside]
    runs = [jv.MeasuredRun.from_arrays([frame], time, {"frame": decay[inside]}) for decay in decays]
    machine = jv.from_matrices(np.eye(6), np.diag(1e-3 * w), np.diag(w**2), places=[np.ones((1, 6))])
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(1e-3), unbalance=1e-9)])
    names = [f"machine.{matrix}[{7 * k}]" for matrix in ("stiffness", "damping") for k in range(6)]
    fit = jv.identify(scene, runs, unknown=names, throw=False)
    modes, ratio = by_sdypy()
    np.testing.assert_allclose([each.value / (2.0 * np.pi) for each in fit.frequency], modes, rtol=2e-4)
    found = [each.value for each in fit.damping_ratio]
    np.testing.assert_allclose(found[1:4], ratio[1:4], rtol=0.05)
    np.testing.assert_allclose(found, ratio, rtol=0.35)
