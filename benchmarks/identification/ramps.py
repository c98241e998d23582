"""Errors of stiffness and damping by four methods, from run-ups of 10 to 640 s through one resonance.

    python benchmarks/identification/ramps.py

The record is the displacement of one mass with an unbalance, integrated by SciPy, with noise of 1 % of its largest amplitude.
The methods have the mass and the true angle of the rotor. They are

- half-power: the peak of the amplitude per squared speed, and its width at 0.707 of the peak
- steady: the least-squares fit of the steady amplitude to the amplitudes in segments of whole turns
- averaged: the least-squares fit of the averaged equations (first order in the rate of the complex amplitude)
- `jaxvib.identify`, with the half-width of its 95 % interval

The table is that of `docs/identification.md`. Each cell contains the errors of stiffness and damping, in percent. A line after
a row states the status of `identify` if it is not `found`.
"""

from __future__ import annotations

import jax
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import jaxvib as jv
from jaxvib.identification.start import amplitudes

MASS, STIFFNESS, DAMPING, UNBALANCE = 100.0, 9e4, 120.0, 0.05
"""The natural frequency is 30 rad/s, and the damping ratio 2 %."""

TOP, RATE, NOISE = 60.0, 100.0, 0.01
RAMPS = (10.0, 40.0, 160.0, 640.0)


def recorded(duration: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, readings and the rotor's angle of a run-up from rest."""
    time, rise = np.arange(0.0, duration, 1.0 / RATE), TOP / duration

    def rates(t: float, y: np.ndarray) -> list[float]:
        angle, speed = 0.5 * rise * t**2, rise * t
        force = UNBALANCE * (speed**2 * np.sin(angle) - rise * np.cos(angle))
        return [y[1], (force - STIFFNESS * y[0] - DAMPING * y[1]) / MASS]

    found = solve_ivp(rates, (0.0, duration), [0.0, 0.0], "DOP853", time, rtol=1e-8, atol=1e-11)
    clean = found.y[0]
    return time, clean + NOISE * np.max(np.abs(clean)) * rng.normal(size=time.size), 0.5 * rise * time**2


def amplitudes_over_speed(readings: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return speeds and amplitudes of the vibration in segments of whole turns."""
    speed, size, _ = amplitudes(readings[:, None], np.ones((angle.size, 1), bool), angle, 1.0 / RATE)
    return speed, size[:, 0]


def half_power(speed: np.ndarray, size: np.ndarray) -> tuple[float, float]:
    """Return stiffness and damping by the peak and its width."""
    ratio = size / speed**2
    ratio = np.where(speed > 0.2 * TOP, ratio, 0.0)  # noise of slow turns
    peak = int(np.argmax(ratio))
    level = ratio[peak] / np.sqrt(2.0)
    low = next(k for k in range(peak, 0, -1) if ratio[k - 1] < level)
    high = next(k for k in range(peak, speed.size - 1) if ratio[k + 1] < level)
    edges = [
        np.interp(level, ratio[[low - 1, low]], speed[[low - 1, low]]),
        np.interp(level, ratio[[high + 1, high]], speed[[high + 1, high]]),
    ]
    return MASS * speed[peak] ** 2, MASS * float(edges[1] - edges[0])


def steady(speed: np.ndarray, size: np.ndarray) -> tuple[float, float]:
    """Return stiffness and damping by a fit of the steady amplitude."""

    def residuals(x: np.ndarray) -> np.ndarray:
        k, c, u = np.exp(x) * (STIFFNESS, DAMPING, UNBALANCE)
        return (u * speed**2 / np.abs(k - MASS * speed**2 + 1j * speed * c) - size) / np.max(size)

    return _fit(residuals)


def averaged(time: np.ndarray, angle: np.ndarray, size: np.ndarray, duration: float) -> tuple[float, float]:
    """Return stiffness and damping by a fit of the averaged equations.

    The amplitudes of the solution are computed by `amplitudes_over_speed`, as those of the record are: averaging over a segment
    then lowers and widens the peak of both equally.
    """
    rise = TOP / duration

    def residuals(x: np.ndarray) -> np.ndarray:
        k, c, u = np.exp(x) * (STIFFNESS, DAMPING, UNBALANCE)

        def rates(t: float, y: np.ndarray) -> np.ndarray:
            w = rise * t
            stiffness = k - MASS * w**2 + 1j * rise * MASS + 1j * w * c
            return (u * (w**2 - 1j * rise) - stiffness * y) / (2j * w * MASS + c)

        found = solve_ivp(rates, (time[0], time[-1]), [0j], "DOP853", time, rtol=1e-8, atol=1e-11)
        return (amplitudes_over_speed((found.y[0] * np.exp(1j * angle)).imag, angle)[1] - size) / np.max(size)

    return _fit(residuals)


def _fit(residuals) -> tuple[float, float]:
    found = least_squares(residuals, np.log([1.04, 1.3, 1.0]), method="lm", diff_step=1e-4)
    k, c, _ = np.exp(found.x) * (STIFFNESS, DAMPING, UNBALANCE)
    return float(k), float(c)


def identified(time: np.ndarray, readings: np.ndarray, duration: float) -> tuple[jv.MachineFit, float, float]:
    """Return the fit of the whole record, and its stiffness and damping."""
    machine = jv.one_mass(mass=MASS, stiffness=1.04 * STIFFNESS, damping=1.3 * DAMPING)
    drive = jv.RunUp(TOP, acceleration=TOP / duration)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=UNBALANCE)])
    run = jv.MeasuredRun.from_arrays([jv.Channel("frame", "displacement", at=1)], time, {"frame": readings})
    fit = jv.identify(scene, run, unknown=["machine.stiffness", "machine.damping", "exciters[0].unbalance"])
    assert isinstance(fit, jv.MachineFit)
    return fit, fit.estimates[0].value, fit.estimates[1].value


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    print("| run-up, s | half-power | steady | averaged | `identify` | half-width of the interval |\n|---|---|---|---|---|---|")
    for duration in RAMPS:
        time, readings, angle = recorded(duration, np.random.default_rng(0))
        speed, size = amplitudes_over_speed(readings, angle)
        fit, *numbers = identified(time, readings, duration)
        found = [half_power(speed, size), steady(speed, size), averaged(time, angle, size, duration), numbers]
        cells = [f"{100.0 * (k / STIFFNESS - 1.0):+.2f}, {100.0 * (c / DAMPING - 1.0):+.1f}" for k, c in found]
        half = [50.0 * (each.high - each.low) / each.value for each in fit.estimates[:2]]
        print(f"| {duration:g} | {' | '.join(cells)} | {half[0]:.2f}, {half[1]:.1f} |", flush=True)
        if fit.status_name != "found":
            print(f"the status of identify is {fit.status_name}")


if __name__ == "__main__":
    main()
