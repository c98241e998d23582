"""Impact test of a beam, published by others (tests/data/beam_frf_3points.csv, MIT licence): accelerances of three points.

Source: github ladisk/pyuff, data/meas_point_1.txt to meas_point_3.txt. The inverse transform of an accelerance is the free
decay of the beam after an impact. A machine whose coordinates are modes is fitted to each of them: the state at the first
sample is free, and natural frequencies and damping ratios are unknown. sdypy-EMA fits a rational function to each accelerance
(LSCF); SciPy fits a pole to the lines about each peak.
"""

import functools
import pathlib

import numpy as np
import pytest
from scipy.optimize import least_squares

import jaxvib as jv

RECORD = pathlib.Path(__file__).parents[1] / "data" / "beam_frf_3points.csv"
FIRST = np.array([51.5, 142.2, 278.7, 460.4, 687.2, 958.5])
"""Peaks of the accelerances, Hz."""

_HALF_BAND = 20.0
"""Half-width of the band about a peak to which SciPy fits a pole, Hz."""


@functools.cache
def accelerances():
    """Return frequencies, Hz, and the accelerances (3, n) of the points."""
    frequency, *parts = np.loadtxt(RECORD, delimiter=",", skiprows=3).T
    return frequency, np.array(parts[::2]) + 1j * np.array(parts[1::2])


def by_sdypy(point):
    """Return natural frequencies, Hz, and damping ratios by sdypy-EMA."""
    ema = pytest.importorskip("sdypy.EMA")
    frequency, response = accelerances()
    model = ema.Model(response[point][None], frequency, lower=20, upper=990, pol_order_high=50, frf_form="accelerance")
    model.get_poles(show_progress=False)
    found, ratio = model.pole_freq[-1], model.pole_xi[-1]
    nearest = [int(np.argmin(np.abs(found - each))) for each in FIRST]
    return found[nearest], ratio[nearest]


def by_lines_about_the_peaks(point):
    """Return natural frequencies, Hz, and damping ratios of single poles with a cubic polynomial for all other modes."""
    frequency, response = accelerances()
    poles = []
    for peak in FIRST:
        near = np.abs(frequency - peak) < _HALF_BAND
        place = (frequency[near] - peak) / _HALF_BAND

        def pole(unknown, peak=peak):
            w = 2.0 * np.pi * (peak + unknown[0])
            return w * (-np.exp(unknown[1]) + 1j * np.sqrt(1.0 - np.exp(2.0 * unknown[1])))

        def residuals(unknown, near=near, place=place):
            basis = np.stack([1.0 / (2j * np.pi * frequency[near] - pole(unknown)), *(place**k for k in range(4))], axis=1)
            left = response[point][near] - basis @ np.linalg.lstsq(basis, response[point][near], rcond=None)[0]
            return np.concatenate([left.real, left.imag])

        fits = [least_squares(residuals, [near_peak, np.log(2e-4)]) for near_peak in (-0.1, 0.0, 0.1)]
        poles.append(pole(min(fits, key=lambda each: each.cost).x))
    return np.abs(poles) / (2.0 * np.pi), -np.real(poles) / np.abs(poles)


def by_identify(point):
    """Return natural frequencies, Hz, and damping ratios of a machine of six modes, and the fit."""
    frequency, response = accelerances()
    inside, w = slice(20, 1980), 2.0 * np.pi * FIRST
    decay = 2.0 * frequency[-1] * np.fft.irfft(response[point])[inside]
    frame = jv.Channel("frame", "acceleration", at=1, gain_error=0.0)
    run = jv.MeasuredRun.from_arrays([frame], (np.arange(2000) / 2000.0)[inside], {"frame": decay})
    machine = jv.from_matrices(np.eye(6), np.diag(1e-3 * w), np.diag(w**2), places=[np.ones((1, 6))])
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(1e-3), unbalance=1e-9)])
    names = [f"machine.{matrix}[{7 * k}]" for matrix in ("stiffness", "damping") for k in range(6)]
    fit = jv.identify(scene, run, unknown=names)
    return (
        np.array([each.value for each in fit.frequency]) / (2.0 * np.pi),
        np.array([each.value for each in fit.damping_ratio]),
        fit,
    )


@pytest.mark.slow
@pytest.mark.parametrize("point", range(3))
def test_modes_of_the_beam_agree(point):
    """The damping ratio of mode 1 by sdypy-EMA changes by 9 % with the degree of the polynomials, and is not compared."""
    modes, ratio, fit = by_identify(point)
    found, found_ratio = by_lines_about_the_peaks(point)
    np.testing.assert_allclose(modes, found, rtol=5e-5)
    np.testing.assert_allclose(ratio, found_ratio, rtol=0.02)
    modes_by_sdypy, ratio_by_sdypy = by_sdypy(point)
    np.testing.assert_allclose(modes, modes_by_sdypy, rtol=2e-4)
    np.testing.assert_allclose(ratio[1:], ratio_by_sdypy[1:], rtol=0.08)
    assert fit.status_name == "patterned"
    assert any("the residuals vibrate at natural frequencies of the machine" in note for note in fit.notes)
