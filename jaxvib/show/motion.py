"""Motion of a film: a part of a run, interpolated between its samples, or an exact jam."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.motion.run import Run
from jaxvib.show.wheel import Pose, RotorPose
from jaxvib.steady.orbits.describe import Orbit

_MAX_ANGLE_BETWEEN_SAMPLES = 1.2
"""Rotation of a load between two samples of a run, rad, up to which interpolation is accurate enough."""


class SampledMotion(NamedTuple):
    """Motion of a machine at the times of a film.

    **Attributes**: `time` (nt,) s; `displacement`, `velocity` (nt, nd); `rotors`, a `RotorPose` for each exciter, whose arrays
    have a leading axis over the times; `force` on the foundation, (nt, directions) N.
    """

    time: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray
    rotors: tuple[RotorPose, ...]
    force: np.ndarray

    def pose(self, k: int) -> Pose:
        """Return the pose at time `k`."""
        return Pose(self.displacement[k], self.velocity[k], jax.tree.map(lambda x: x[k], self.rotors))


def motion_of_run(run: Run, time: np.ndarray) -> SampledMotion:
    """Return a run at these times, by cubic Hermite interpolation between the stored states.

    Velocities and forces are interpolated linearly. **Raises** `InputError` for times outside the stored states, and for states
    that are too far apart.
    """
    kept = _stored_states(run, time)
    t = np.asarray(kept.time, float)
    k = np.clip(np.searchsorted(t, time, side="right") - 1, 0, t.size - 2)
    h = t[k + 1] - t[k]
    share = (time - t[k]) / h
    state = kept.state
    near = np.unique(np.concatenate([k, k + 1]))
    speeds = [own.rate[0] if own.rate else rotor for own, rotor in zip(state.exciters, kept.rotor_speeds, strict=True)]
    rate = max(float(np.max(np.abs(np.asarray(each)[near]), initial=0.0)) for each in speeds)
    if rate * np.max(h) > _MAX_ANGLE_BETWEEN_SAMPLES:
        most = int(np.ceil(t.size * rate * np.max(h) / _MAX_ANGLE_BETWEEN_SAMPLES))
        problem = f"has {t.size} samples, between which loads turn by up to {rate * np.max(h):.3g} rad"
        raise InputError("run", f"{problem}; simulate with samples={most}, or animate the last turns only")

    def cubic(value: np.ndarray, slope: np.ndarray) -> np.ndarray:
        s, step = (x.reshape(-1, *[1] * (value.ndim - 1)) for x in (share, h))
        a, b = value[k], value[k + 1]
        da, db = step * slope[k], step * slope[k + 1]
        return a + s * (da + s * (3.0 * (b - a) - 2.0 * da - db + s * (2.0 * (a - b) + da + db)))

    def arrays(parts: object) -> list[np.ndarray]:
        return [np.asarray(leaf, float) for leaf in jax.tree.leaves(parts)]

    q, v = np.asarray(state.displacement, float), np.asarray(state.velocity, float)
    rotors = []
    for own, *rotor in zip(state.exciters, kept.rotor_angles, kept.rotor_speeds, strict=True):
        angle = [cubic(_continuous_angle(u, w, t), w) for u, w in zip(arrays(own.angle), arrays(own.rate), strict=True)]
        turn, speed = arrays(rotor)
        rotors.append(RotorPose(tuple(angle), cubic(_continuous_angle(turn, speed, t), speed)))
    force = np.asarray(kept.foundation_force, float)
    between = (1.0 - share)[:, None] * force[k] + share[:, None] * force[k + 1]
    velocity = (1.0 - share)[:, None] * v[k] + share[:, None] * v[k + 1]
    return SampledMotion(time, cubic(q, v), velocity, tuple(rotors), between)


def _stored_states(run: Run, time: np.ndarray) -> Trajectory:
    """Return stored states of a run that include these times: those of its window if it includes them."""
    slack = 1e-9 * max(float(run.window.time[-1]), 1e-300)
    kept = [run.window, *([] if run.trajectory is None else [run.trajectory])]
    for states in kept:
        if float(states.time[0]) - slack <= time[0] and time[-1] <= float(states.time[-1]) + slack:
            return states
    first, last = float(kept[-1].time[0]), float(kept[-1].time[-1])
    problem = f"selects {time[0]:.6g} to {time[-1]:.6g} s; the run keeps {first:.6g} to {last:.6g} s"
    raise InputError("begin", problem + ("" if run.trajectory is not None else " (simulate with save='all' for the rest)"))


def _continuous_angle(angle: np.ndarray, rate: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return continuous angles (nt, ...) from angles modulo a turn; their rates determine the number of whole turns."""
    step = np.diff(time).reshape(-1, *[1] * (angle.ndim - 1))
    foreseen = 0.5 * step * (rate[1:] + rate[:-1])
    change = np.diff(angle, axis=0)
    change = change + 2.0 * np.pi * np.round((foreseen - change) / (2.0 * np.pi))
    return np.concatenate([angle[:1], angle[:1] + np.cumsum(change, axis=0)])


def motion_of_orbit(orbit: Orbit, scene: Scene, time: np.ndarray) -> SampledMotion:
    """Return an exact jam of a `scene` at these times, from its Fourier series.

    **Raises** `InputError` for a jam that does not exist, or a scene with other coordinates or loads.
    """
    omega = float(orbit.omega)
    if not np.isfinite(omega) or not np.isfinite(np.asarray(orbit.amplitude)).all():
        raise InputError("orbit", f"is not a motion that can be shown: {orbit.message}")
    if len(orbit.units) != len(scene.machine.structure().coordinates) or orbit.offsets.shape != (scene.loads.count,):
        raise InputError("scene", "is not the scene of the orbit: it has other coordinates or loads")
    theta = omega * time
    q, v, (phi,), _ = jax.vmap(orbit.at)(jnp.asarray(theta))
    wave = np.exp(1j * np.asarray(orbit.orders)[:, None] * theta)
    force = np.real(np.asarray(orbit.force_harmonics) @ wave).T
    rotor = RotorPose((np.asarray(phi),), float(orbit.rotor_speed) * time)
    return SampledMotion(time, np.asarray(q), np.asarray(v), (rotor,), force)
