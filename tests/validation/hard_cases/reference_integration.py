"""Motions of a `ReferenceModel` machine by SciPy: runs, runs from event to event, periodic ones by shooting."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from scipy.integrate import solve_ivp

from hard_cases.reference_model import ReferenceModel, number_of, root

__all__ = [
    "Event",
    "Outcome",
    "by_events",
    "is_stiff",
    "multipliers",
    "natural_sizes",
    "orbit_rotor_speed",
    "orbit_speed",
    "run_out",
]

Mode = TypeVar("Mode")

_STEP = 1e-7
"""Relative step of the slopes of a shooting, which need not be exact."""

_IMPLICIT = 1e-9
"""Relative tolerance of runs by Radau's method of order 5, whose steps grow too many below."""

_MOST_CHANGES = 20_000


class Outcome(NamedTuple):
    """The `state` at the end of a motion, and the largest displacement and velocity in its last fifth, m and m/s."""

    state: np.ndarray
    displacement: float
    velocity: float


def run_out(p: ReferenceModel, y: np.ndarray, until: float, *, rtol: float = 1e-12) -> Outcome:
    """The motion from the state `y` at 0; where the drive jumps a step ends.

    Scenes without effects at constant speed whose loads or carrier decay much faster than anything moves are integrated by
    SciPy's implicit Radau method, to `_IMPLICIT` at best; the explicit method would need a step per decay.
    """
    kinks = [float(t) for t in getattr(p.drive, "jump_ts", lambda: ())() if 0.0 < float(t) < until]
    how: dict[str, Any] = {"method": "DOP853"}
    if is_stiff(p):
        how, rtol = {"method": "Radau", "jac": p.slopes}, max(rtol, _IMPLICIT)
    nd, begun, largest = p.mass.shape[0], 0.0, np.zeros(2)
    for end in (*kinks, until):
        found = solve_ivp(p.field, (begun, end), y, rtol=rtol, atol=1e-2 * rtol * natural_sizes(p), **how)
        if not found.success:
            raise ArithmeticError(found.message)
        late = np.abs(found.y[: 2 * nd, found.t >= 0.8 * until])
        if late.size:
            largest = np.maximum(largest, [np.max(late[:nd]), np.max(late[nd:])])
        y, begun = found.y[:, -1], end
    return Outcome(y, *map(float, largest))


def is_stiff(p: ReferenceModel) -> bool:
    """True if drag or damping acts 1000 times as fast as rotor and carrier move, and `ReferenceModel.slopes` holds."""
    if p.effects or getattr(p.drive, "kind", "") != "constant_speed":
        return False
    n = p.m.size
    matrix, _ = p.forces(0.0, np.zeros(2 * (p.mass.shape[0] + n)))
    decay = np.concatenate([np.diag(p.damping), p.drag * p.radius**2]) / np.diag(matrix)
    motion = max(number_of(p.drive, "speed"), float(np.sqrt(np.max(np.diag(p.stiffness) / np.diag(p.mass)))))
    return float(np.max(decay)) > 1000.0 * motion


def natural_sizes(p: ReferenceModel) -> np.ndarray:
    """The natural unit of each number of a state, of which absolute tolerances are shares: the loads' unbalance radius S/M for
    displacements, that times the rotor speed for velocities, 1 rad, the rotor speed."""
    nd, n = p.mass.shape[0], p.m.size
    length = np.sum(p.m * p.radius) / np.sum(p.whole_mass)
    speed = number_of(p.drive, "speed")
    motor = [1.0, speed] if getattr(p.drive, "kind", "") == "dc_motor" else []
    return np.array([length] * nd + [length * speed] * nd + [1.0] * n + [speed] * n + motor)


def multipliers(p: ReferenceModel, motion: Callable[[float], np.ndarray], period: float, *, rtol: float = 1e-10) -> np.ndarray:
    """Floquet multipliers of a known periodic motion y(t) by SciPy: Radau where drag or damping is stiff, otherwise DOP853."""
    size = natural_sizes(p)
    n = size.size

    def slopes(t: float) -> np.ndarray:
        return p.slopes(t, motion(t)) * size[None, :] / size[:, None]

    def field(t: float, x: np.ndarray) -> np.ndarray:
        return (slopes(t) @ x.reshape(n, n)).ravel()

    def jacobian(t: float, _: np.ndarray) -> np.ndarray:
        return np.kron(slopes(t), np.eye(n))

    how = {"method": "Radau", "jac": jacobian} if is_stiff(p) else {"method": "DOP853"}
    run = solve_ivp(field, (0.0, period), np.eye(n).ravel(), t_eval=[period], rtol=rtol, atol=1e-2 * rtol, **how)
    if not run.success:
        raise ArithmeticError(run.message)
    return np.linalg.eigvals(run.y[:, -1].reshape(n, n))


class Event(NamedTuple, Generic[Mode]):
    """End of a segment of motion: `at`(t, y) crosses 0 in the `direction` (1 up, -1 down); and the mode `then`."""

    at: Callable[[float, np.ndarray], float]
    direction: int
    then: Callable[[float, np.ndarray], Mode]
    terminal = True  # to SciPy, which calls it

    def __call__(self, t: float, y: np.ndarray) -> float:
        return self.at(t, y)


def by_events(
    field: Callable[[float, np.ndarray, Mode], np.ndarray],
    events: Callable[[Mode], Sequence[Event[Mode]]],
    mode: Mode,
    y: np.ndarray,
    until: float,
    sizes: np.ndarray,
    *,
    nd: int = 1,
    rtol: float = 1e-11,
) -> tuple[Outcome, int]:
    """A motion whose law changes from mode to mode, every change located and a step's end; and how many changes there were."""
    begun, changes, largest = 0.0, 0, np.zeros(2)
    while begun < until:
        told = list(events(mode))
        found = solve_ivp(
            lambda t, x: field(t, x, mode),  # noqa: B023
            (begun, until),
            y,
            method="DOP853",
            rtol=rtol,
            atol=1e-2 * rtol * sizes,
            events=told,
        )
        if found.status == -1 or changes > _MOST_CHANGES:
            raise ArithmeticError(found.message if found.status == -1 else "the reference changes its mode without end")
        late = np.abs(found.y[: 2 * nd, found.t >= 0.8 * until])
        if late.size:
            largest = np.maximum(largest, [np.max(late[:nd]), np.max(late[nd:])])
        y, begun = found.y[:, -1], float(found.t[-1])
        if found.status == 1:
            which = next(k for k, hits in enumerate(found.t_events) if hits.size)
            mode = told[which].then(begun, y)
            changes += 1
    return Outcome(y, *map(float, largest)), changes


def orbit_rotor_speed(p: ReferenceModel, omega: float, start: np.ndarray, speed: float) -> tuple[float, np.ndarray]:
    """The rotor speed at which one load jams at the mean speed `omega`, by shooting over one turn, and the state at phi = 0.

    Unknown are q, q', phi' at phi = 0 and the rotor speed: as many as the motion has to repeat; `start`, `speed` begin.
    """
    nd = p.mass.shape[0]
    period, size = 2.0 * np.pi / omega, float(np.max(np.abs(start[: 2 * nd])))
    unit = np.concatenate([np.full(2 * nd, size), [omega, speed]])

    def missed(x: np.ndarray) -> np.ndarray:
        z = x * unit
        begin = np.concatenate([z[: 2 * nd], [0.0], z[2 * nd : 2 * nd + 1]])
        end = _turned(p, begin, z[-1], period)
        end[2 * nd] -= 2.0 * np.pi
        return (end - begin) / np.concatenate([unit[: 2 * nd], [1.0, omega]])

    x = np.concatenate([start[: 2 * nd], start[2 * nd + 1 :], [speed]]) / unit
    left, slope = np.inf, np.eye(x.size)
    for _ in range(25):
        miss = missed(x)
        before, left = left, float(np.max(np.abs(miss)))
        if left < 1e-12 or (left < 1e-10 and left > 0.1 * before):
            break
        if left > 0.1 * before or before == np.inf:  # a slope serves as long as it leads on quickly
            slope = np.stack([(missed(x + _STEP * e) - miss) / _STEP for e in np.eye(x.size)], axis=1)
        x = x - np.linalg.solve(slope, miss)
    if not left < 1e-9:
        raise ArithmeticError(f"shooting missed by {left:.1e}")
    z = x * unit
    return float(z[-1]), np.concatenate([z[: 2 * nd], [0.0], z[2 * nd : 2 * nd + 1]])


def _turned(p: ReferenceModel, y: np.ndarray, speed: float, period: float) -> np.ndarray:
    now = replace(p, drive=_Constant(speed))
    found = solve_ivp(now.field, (0.0, period), y, method="DOP853", rtol=1e-12, atol=1e-14 * natural_sizes(now))
    return found.y[:, -1]


class _Constant:
    """A constant speed that is a number of Python's own."""

    kind = "constant_speed"

    def __init__(self, speed: float):
        self.speed = speed


def orbit_speed(p: ReferenceModel, low: float, high: float, start: np.ndarray, speed: float, nodes: int = 9) -> np.ndarray:
    """Load speeds between `low` and `high` at which one load jams at the scene's rotor speed, ascending, through a fold too.

    n(Omega) is single-valued there: it is found at Chebyshev points by shooting, from `start` and `speed` on, and interpolated.
    """
    x = np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)
    omega = 0.5 * (high + low) + 0.5 * (high - low) * x
    speeds = []
    for w in omega:
        speed, start = orbit_rotor_speed(p, float(w), start, speed)
        speeds.append(speed)
    curve = np.polynomial.chebyshev.Chebyshev.fit(omega, speeds, nodes - 1, domain=[low, high])
    wanted, slope, grid = number_of(p.drive, "speed"), curve.deriv(), np.linspace(low, high, 201)
    turns = [root(slope, a, b) for a, b in itertools.pairwise(grid) if slope(a) * slope(b) < 0.0]
    ends = np.unique([low, *turns, high])
    pairs = [(a, b) for a, b in itertools.pairwise(ends) if (curve(a) - wanted) * (curve(b) - wanted) < 0.0]
    return np.array([root(lambda w: curve(w) - wanted, a, b) for a, b in pairs])
