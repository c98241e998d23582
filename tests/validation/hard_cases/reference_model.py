"""Machines of platforms once more, written with dense matrices in NumPy: what answers are compared with.

Nothing here comes from `jaxvib.equations`: matrices are put together from the machine's own numbers, loads are not eliminated,
forces are cases in place of properties, and SciPy integrates. It is slow, and knows what the catalogue needs only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar, root_scalar

from jaxvib.machine.drives.drive import Drive
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import Platforms

__all__ = ["ReferenceModel", "light_modes", "light_speed", "number_of", "platforms", "reference_model", "root"]


def number_of(part: object, name: str) -> float:
    """A number of a load, an effect or a drive by its name: references know parts by what they are called, not by class."""
    return float(getattr(part, name))


def platforms(scene: Scene) -> Platforms:
    """The scene's machine, which has to be one of platforms."""
    assert isinstance(scene.machine, Platforms)
    return scene.machine


@dataclass(frozen=True)
class ReferenceModel:
    """The numbers of a scene of platforms: matrices (nd, nd), `at` the exciter's row, of the loads (N,) each, and effects."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    foundation_stiffness: np.ndarray
    foundation_damping: np.ndarray
    at: int
    m: np.ndarray
    radius: np.ndarray
    drag: np.ndarray
    kappa: np.ndarray
    drive: Drive
    effects: dict[str, Effect]

    @property
    def whole_mass(self) -> np.ndarray:
        """The mass matrix, loads on the exciter's platform included, (nd, nd) kg."""
        whole = self.mass.copy()
        whole[self.at, self.at] += np.sum(self.m)
        return whole

    def rotor(self, t: float, y: np.ndarray) -> tuple[float, float, float]:
        """The rotor's angle, speed and acceleration (0 where a motor's is an unknown)."""
        drive = self.drive
        kind, speed = drive.kind, number_of(drive, "speed")
        if kind == "constant_speed":
            return speed * t, speed, 0.0
        if kind == "run_up":
            rate = number_of(drive, "acceleration")
            end = speed / rate
            return (0.5 * rate * t**2, rate * t, rate) if t < end else (speed * (t - 0.5 * end), speed, 0.0)
        return float(y[-2]), float(y[-1]), 0.0

    def forces(self, t: float, y: np.ndarray, press: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """The dense matrix and the right side of the unknown accelerations (q'', phi'', and a motor's theta'').

        `press`: force of a stop on the first platform, N upward.
        """
        nd, n = self.mass.shape[0], self.m.size
        motor = getattr(self.drive, "kind", "") == "dc_motor"
        q, v, phi, rate = np.split(y[: 2 * (nd + n)], [nd, 2 * nd, 2 * nd + n])
        angle, speed, change = self.rotor(t, y)
        size = nd + n + motor
        matrix, right = np.zeros((size, size)), np.zeros(size)
        matrix[:nd, :nd] = self.whole_mass
        own = self.m * self.radius
        matrix[self.at, nd : nd + n] = matrix[nd : nd + n, self.at] = own * np.cos(phi)
        matrix[range(nd, nd + n), range(nd, nd + n)] = self.kappa * own * self.radius
        right[:nd] = -self.damping @ v - self.stiffness @ q
        right[self.at] += np.sum(own * np.sin(phi) * rate**2)
        right[0] += press
        torque = self.drag * self.radius**2 * (speed - rate)
        right[nd : nd + n] = torque
        if "gravity" in self.effects:
            right[nd : nd + n] -= own * number_of(self.effects["gravity"], "g") * np.cos(phi)
        if "cubic_support" in self.effects:
            right[0] -= number_of(self.effects["cubic_support"], "stiffness") * q[0] ** 3
        thrown = self.effects.get("static_imbalance")
        if thrown is not None:
            where = angle + number_of(thrown, "angle")
            moment = number_of(thrown, "moment")
            right[self.at] += moment * (np.sin(where) * speed**2 - np.cos(where) * change)
            if motor:
                matrix[self.at, -1] = matrix[-1, self.at] = moment * np.cos(where)
        if motor:
            drive = self.drive
            matrix[-1, -1] = number_of(drive, "inertia")
            stall = number_of(drive, "stall_torque")
            right[-1] = stall * (1.0 - speed / number_of(drive, "speed")) - np.sum(torque)
        return matrix, right

    def field(self, t: float, y: np.ndarray, press: float = 0.0) -> np.ndarray:
        """dy/dt of y = (q, q', phi, phi', and a motor's theta, theta')."""
        nd, n = self.mass.shape[0], self.m.size
        change = np.linalg.solve(*self.forces(t, y, press))
        moved = [y[nd : 2 * nd], change[:nd], y[2 * nd + n : 2 * (nd + n)], change[nd : nd + n]]
        if change.size > nd + n:
            moved.append(np.array([y[-1], change[-1]]))
        return np.concatenate(moved)

    def slopes(self, t: float, y: np.ndarray) -> np.ndarray:
        """Derivatives of `field` by y, (2 (nd + N), 2 (nd + N)), of a scene without effects at constant speed."""
        nd, n = self.mass.shape[0], self.m.size
        _, _, phi, rate = np.split(y, [nd, 2 * nd, 2 * nd + n])
        matrix, right = self.forces(t, y)
        change, own = np.linalg.solve(matrix, right), self.m * self.radius
        by_place, by_rate, each = np.zeros((nd + n, nd + n)), np.zeros((nd + n, nd + n)), np.arange(nd, nd + n)
        by_place[:nd, :nd], by_rate[:nd, :nd] = -self.stiffness, -self.damping
        by_place[self.at, each] = own * (np.cos(phi) * rate**2 + np.sin(phi) * change[nd:])
        by_place[each, each] = own * np.sin(phi) * change[self.at]
        by_rate[self.at, each] = 2.0 * own * np.sin(phi) * rate
        by_rate[each, each] = -self.drag * self.radius**2
        places, rates = (np.r_[begin : begin + nd, 2 * nd + k : 2 * nd + k + n] for begin, k in ((0, 0), (nd, n)))
        found = np.zeros((2 * (nd + n), 2 * (nd + n)))
        found[places, rates] = 1.0
        found[np.ix_(rates, places)], found[np.ix_(rates, rates)] = np.linalg.solve(matrix, np.stack([by_place, by_rate]))
        return found


def reference_model(scene: Scene) -> ReferenceModel:
    """The scene's numbers in float64, as they are in its dtype."""
    machine, loads = platforms(scene), scene.loads
    assert isinstance(loads, CircularLoads)

    def get(value: object) -> np.ndarray:
        return np.asarray(value, float)

    mass, k, c = get(machine.mass), get(machine.stiffness), get(machine.damping)
    stiffness, damping = np.diag(k), np.diag(c)
    for (i, j), kij, cij in zip(machine.links, get(machine.link_stiffness), get(machine.link_damping), strict=True):
        for matrix, value in ((stiffness, kij), (damping, cij)):
            for row, column, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
                matrix[row - 1, column - 1] += sign * value
    m, radius, drag = (np.broadcast_to(get(x), (loads.count,)) for x in (loads.mass, loads.radius, loads.drag))
    kappa = np.full(loads.count, {"ball": 1.4, "roller": 1.5}.get(loads.kind, 1.0))
    if loads.inertia is not None:
        kappa = 1.0 + get(loads.inertia) / (m * radius**2)
    effects = {effect.kind: effect for effect in scene.all_effects}
    return ReferenceModel(
        np.diag(mass), damping, stiffness, k, c, machine.exciter - 1, m, radius, drag, kappa, scene.drive, effects
    )


def light_speed(p: ReferenceModel, omega: float) -> tuple[float, NDArray[np.complex128], float]:
    """Motion of coincident light loads that turn at `omega`: the rotor speed n, the complex displacements (nd,), the force on
    the foundation.

    n = w - w^4 S^2 Im A / (2 sum b R^2),    A the receptance at the exciter, S = sum m R
    """
    s, column = np.sum(p.m * p.radius), np.zeros(p.mass.shape[0])
    column[p.at] = 1.0
    answer = np.linalg.solve(p.stiffness - omega**2 * p.whole_mass + 1j * omega * p.damping, column)
    speed = omega - omega**4 * s**2 * answer[p.at].imag / (2.0 * np.sum(p.drag * p.radius**2))
    moved = s * omega**2 * answer
    return speed, moved, abs(np.sum((p.foundation_stiffness + 1j * omega * p.foundation_damping) * moved))


def _excess(p: ReferenceModel, omega: float, speed: float) -> float:
    """n(omega) - speed; infinite at a resonance that nothing damps."""
    try:
        return light_speed(p, omega)[0] - speed
    except np.linalg.LinAlgError:
        return np.inf


def _excesses(p: ReferenceModel, omega: np.ndarray, speed: float) -> np.ndarray:
    """The same at many load speeds, in one call of LAPACK where no matrix is singular."""
    w = omega[:, None, None]
    column = np.zeros((p.mass.shape[0], 1))
    column[p.at] = 1.0
    try:
        answer = np.linalg.solve(p.stiffness - w**2 * p.whole_mass + 1j * w * p.damping, column)[:, p.at, 0]
    except np.linalg.LinAlgError:
        return np.array([_excess(p, each, speed) for each in omega])
    torque = -(omega**4) * np.sum(p.m * p.radius) ** 2 * answer.imag / 2.0
    return omega + torque / np.sum(p.drag * p.radius**2) - speed


def light_modes(p: ReferenceModel, speed: float) -> np.ndarray:
    """All load speeds at which light loads jam at the rotor speed, ascending, rad/s: roots between points that crowd at the
    resonances down to their rounding, and folds."""
    squares = np.linalg.eigvals(np.linalg.solve(p.whole_mass, p.stiffness)).real
    resonances = np.sqrt(squares[squares > 0.0])
    away = np.logspace(-15.5, 0.0, 1500)
    points = np.concatenate(
        [np.linspace(1e-3, 1.001, 4000) * speed, *(w * (1.0 + s * away) for w in resonances for s in (-1, 1))]
    )
    points = np.unique(points[(points > 0.0) & (points <= 1.001 * speed)])
    excess = _excesses(p, points, speed)
    points, excess = points[np.isfinite(excess)], excess[np.isfinite(excess)]

    def signed(w: float, sign: float) -> float:
        return sign * _excess(p, w, speed)

    rises = np.diff(excess) > 0.0
    for k in 1 + np.flatnonzero(rises[1:] != rises[:-1]):  # folds, of whose two roots the points may see none
        sign = -1.0 if rises[k - 1] else 1.0
        ends = points[k - 1], points[k + 1]
        top = minimize_scalar(signed, bounds=ends, method="bounded", args=(sign,), options={"xatol": 1e-13 * ends[1]})
        if np.isfinite(top.fun):
            points, excess = np.append(points, top.x), np.append(excess, sign * top.fun)
    order = np.argsort(points)
    points, excess = points[order], excess[order]
    crossed = np.flatnonzero(excess[1:] * excess[:-1] < 0.0)
    return np.array([root(lambda w: _excess(p, w, speed), points[k], points[k + 1]) for k in crossed])


def root(function: Callable[[float], float], low: float, high: float) -> float:
    """Root of a function between two points with different signs, as exactly as it can be computed."""
    return float(root_scalar(function, bracket=(low, high), method="brentq", xtol=1e-300, rtol=1e-15).root)
