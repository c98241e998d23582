"""Swings of a rod by SciPy, with noise."""

import numpy as np
from scipy.integrate import solve_ivp

import jaxvib as jv

T = 0.05 * np.arange(400)
"""The times of most records: one length, so that the fit is compiled once."""


ROD = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.00625, bearing=0.02)


def scipy_swing(rod, times, angle, rate, viscous, dry=0.0, air=0.0, torque=0.0):
    """Return the swing with the sharp sign of sliding, half a swing at a time, and when dry friction stops it (NaN: never).

    `air`: quadratic drag, N m s^2; `torque`: a constant one, N m."""
    m, l, j, d, g = (float(x) for x in (rod.mass, rod.length, rod.total_inertia, rod.bearing, rod.g))
    out, t, y = np.full(len(times), np.nan), times[0], np.array([angle, rate])
    while True:
        pull = torque - m * g * l * np.sin(y[0])
        sign = np.sign(y[1]) if y[1] != 0.0 else np.sign(pull)
        if y[1] == 0.0 and abs(pull) < dry * abs(m * g * np.cos(y[0])) * d / 2.0:
            out[times >= t] = y[0]
            return out, t

        def rhs(t, y, sign=sign):
            load = abs(m * l * y[1] ** 2 + m * g * np.cos(y[0]))
            return [
                y[1],
                (torque - m * g * l * np.sin(y[0]) - (viscous + air * abs(y[1])) * y[1] - dry * load * d / 2.0 * sign) / j,
            ]

        turns = lambda t, y: y[1]  # noqa: E731
        turns.terminal, turns.direction = dry > 0.0, -sign
        found = solve_ivp(rhs, (t, times[-1]), y, "DOP853", rtol=1e-9, atol=1e-12, events=turns, dense_output=True)
        inside = (times >= t) & (times <= found.t[-1])
        out[inside] = found.sol(times[inside])[0]
        if found.status == 0:
            return out, np.nan
        t, y = found.t[-1], np.array([found.y[0, -1], 0.0])


def scipy_swings(rod, times, angle, rate, viscous):
    """Many swings without dry friction, as one system of equations: a row of angles for each."""
    m, l, j, g = (float(x) for x in (rod.mass, rod.length, rod.total_inertia, rod.g))

    def rhs(t, y):
        f, slip = y.reshape(2, -1)
        return np.concatenate([slip, (-m * g * l * np.sin(f) - viscous * slip) / j])

    # The error that SciPy controls is the mean over all swings: a tolerance as much smaller as one of them may lie above it.
    start = np.concatenate([angle, rate])
    rtol, atol = 1e-9 / np.sqrt(start.size), 1e-12 / np.sqrt(start.size)
    return solve_ivp(rhs, (times[0], times[-1]), start, "DOP853", times, rtol=rtol, atol=atol).y[: len(angle)]


def noisy(clean, noise, seed):
    return clean + noise * np.random.default_rng(seed).normal(size=clean.size)
