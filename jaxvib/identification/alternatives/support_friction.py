"""Dry friction at supports and links of a linear machine, estimated from the residuals of a fit.

To first order, dry friction F sign(w) at a place with the velocity w adds to the readings the response of the linear machine to
the force -F sign(w) of the fitted motion. The residuals are compared with such responses after all responses to changes of the
masses, stiffnesses and dampings are removed from both.
"""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np

from jaxvib.equations.linear import linear_model
from jaxvib.identification.fit import Fitted, linear_indices
from jaxvib.identification.response import model_states, sensor_rows
from jaxvib.machine.effects.supports import FrictionSupport
from jaxvib.machine.scene import Scene

_WIDTH = 0.05
"""Smoothing width of the friction relative to the largest velocity."""

_MIN_SHARE = 0.1
"""Share of the variance of the residuals that a friction has to explain to first order. In run-ups with a friction of 5 to 20 N
at 95 kg it is 0.26 to 0.73, and 0.03 if a cubic support causes the residuals."""


def likely_friction(fitted: Fitted, scene: Scene) -> FrictionSupport | None:
    """Return the friction, at a platform or between two coupled platforms, that explains the largest share of the residuals of
    a fit; None if no friction explains a tenth, if no damping is unknown, and for machines without platforms.

    **Arguments**: `fitted`: fit of a linear machine with one exciter; the fitted `scene`.
    """
    names = [number.name for number in fitted.problem.unknowns.numbers]
    if scene.machine.places != "platform" or not any("damping" in name for name in names):
        return None
    if any(channel.kind == "force" for samples in fitted.problem.runs for channel in samples.channels):
        return None
    stiffness = np.asarray(linear_model(scene).carrier.stiffness)
    nd = len(stiffness)
    places = [(k, None) for k in range(nd)] + [(i, j) for i, j in itertools.combinations(range(nd), 2) if stiffness[i, j]]
    rows = np.array([np.eye(nd)[i] - (0.0 if j is None else np.eye(nd)[j]) for i, j in places])
    of_runs = [_columns(fitted, scene, r, rows) for r in range(len(fitted.problem.runs))]
    widths = _WIDTH * np.max([largest for largest, _ in of_runs], axis=0)
    residuals, machine, friction = _compared(fitted, [responses for _, responses in of_runs], len(places))
    basis, _ = np.linalg.qr(machine)
    left, friction = (each - basis @ (basis.T @ each) for each in (residuals, friction))
    products, squares = friction.T @ left, np.sum(friction**2, axis=0)
    forces = products / np.maximum(squares, 1e-300)
    shares = np.where(forces > 0.0, products * forces, 0.0) / max(float(np.sum(left**2)), 1e-300)
    best = int(np.argmax(shares))
    if shares[best] < _MIN_SHARE:
        return None
    platform, to = places[best]
    return FrictionSupport(forces[best], widths[best], platform=platform + 1, to=None if to is None else to + 1)


def _compared(fitted: Fitted, responses: list[np.ndarray], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the residuals (m,), the responses (m, k) of a linear machine and those (m, count) to friction, of all readings in
    units of their noise."""
    residuals, columns = [], []
    for own, mask, left, noise in zip(responses, fitted.problem.masks, fitted.differences, fitted.noise, strict=True):
        for c in range(left.shape[1]):
            used = mask[:, c]
            residuals.append(left[used, c] / noise[c])
            columns.append(own[used, c] / noise[c])
    widths = [each.shape[1] - count for each in columns]
    total = np.concatenate(columns)
    assert len(set(widths)) == 1
    scale = np.maximum(np.linalg.norm(total, axis=0), 1e-300)
    machine = (total / scale)[:, :-count]
    return np.concatenate(residuals), machine, total[:, -count:]


def _columns(fitted: Fitted, scene: Scene, r: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest velocities (p,) of the places with these `rows` (p, nd) in a run, and responses (n, C, k + p) of the
    readings: to changes of the linear machine and its excitation (k), and to a friction of 1 N at each place (p)."""
    problem, samples = fitted.problem, fitted.problem.runs[r]
    parts = jnp.asarray(fitted.x), jnp.asarray(fitted.linear[linear_indices(problem)[r]])
    states = np.asarray(model_states(problem.unknowns, samples, problem.scene, *parts))[: len(problem.raw[r])]
    nd, step = rows.shape[1], float(samples.step)
    q, v = states[:, :nd], states[:, nd : 2 * nd]
    at, speed, change = q @ rows.T, v @ rows.T, np.gradient(v, step, axis=0)
    largest = np.max(np.abs(speed), axis=0)
    signs = np.tanh(speed / (_WIDTH * largest))
    forces = [*(-each[:, None] * row for each, row in zip((*at.T, *speed.T), (*rows, *rows), strict=True))]
    forces += [-change[:, k : k + 1] * np.eye(nd)[k] for k in range(nd)]
    forces += [-sign[:, None] * row for sign, row in zip(signs.T, rows, strict=True)]
    model = linear_model(samples.scene(scene))
    matrices = [np.asarray(each) for each in (model.mass, model.carrier.damping, model.carrier.stiffness)]
    outputs = np.asarray(sensor_rows(scene, model.carrier, samples.channels))
    forced, free = _responses(np.stack(forces, axis=2), step, matrices, outputs)
    shown = problem.raw[r] - fitted.differences[r]
    turned = np.gradient(shown, step, axis=0)
    own = [*(shown * unit for unit in np.eye(shown.shape[1])), *(0.0 * shown + unit for unit in np.eye(shown.shape[1])), turned]
    turn_speed = np.gradient(problem.angles[r][:, 0], step)
    own.append(turned / np.maximum(np.abs(turn_speed), 0.05 * np.max(np.abs(turn_speed)))[:, None])
    count = len(rows)
    return largest, np.concatenate([forced[:, :, :-count], free, np.stack(own, axis=2), forced[:, :, -count:]], axis=2)


def _responses(
    forces: np.ndarray, step: float, matrices: list[np.ndarray], outputs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the readings (n, C, f) of a linear machine at rest under the `forces` (n, nd, f), which are linear between the
    samples, and those (n, C, 2 nd) of its free motions.

    **Arguments**: `matrices` of mass, damping and stiffness; `outputs` (C, 3, nd) from displacements, velocities and
    accelerations.
    """
    from scipy.linalg import expm  # slow to import

    mass, damping, stiffness = matrices
    nd, (n, _, count) = len(mass), forces.shape
    flow = np.zeros((4 * nd, 4 * nd))  # displacements, velocities, force, and its change within a step
    flow[:nd, nd : 2 * nd] = step * np.eye(nd)
    flow[nd : 2 * nd, : 3 * nd] = step * np.linalg.solve(mass, np.concatenate([-stiffness, -damping, np.eye(nd)], axis=1))
    flow[2 * nd : 3 * nd, 3 * nd :] = np.eye(nd)
    power = expm(flow)[: 2 * nd]
    state = np.concatenate([np.zeros((2 * nd, count)), np.eye(2 * nd)], axis=1)
    forces = np.concatenate([forces, np.zeros((n, nd, 2 * nd))], axis=2)
    readings = np.zeros((n, len(outputs), count + 2 * nd))
    inverse = np.linalg.inv(mass)
    for k in range(n):
        q, v = state[:nd], state[nd:]
        acceleration = inverse @ (forces[k] - damping @ v - stiffness @ q)
        readings[k] = outputs[:, 0] @ q + outputs[:, 1] @ v + outputs[:, 2] @ acceleration
        if k + 1 < n:
            state = power @ np.concatenate([state, forces[k], forces[k + 1] - forces[k]])
    return readings[:, :, :count], readings[:, :, count:]
