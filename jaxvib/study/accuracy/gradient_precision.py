"""Work-precision of gradients: by the implicit function theorem, through time integration, and by finite differences."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.machine.scene import Scene
from jaxvib.motion.integrate import frequency_bounds
from jaxvib.motion.plan import Tolerance, enough_steps
from jaxvib.motion.simulate import simulate
from jaxvib.steady.jams.jam import JamStatus, jam_modes
from jaxvib.steady.orbits.jam_orbit import collocation_points, jam_orbit
from jaxvib.study.accuracy.cost import Cost, relative, row_of
from jaxvib.study.accuracy.exact_reference import ExactJam, unstable_reason

_GRADIENT_TOLERANCE = 1e-8

_MAX_RECORDED_STEPS = 2**17
"""Maximum number of steps of a run with derivatives; such a run stores the end of each step."""

_support_stiffness = operator.attrgetter("machine.stiffness")
"""Function that returns the stiffnesses of the supports of a scene."""

_Way: TypeAlias = tuple[str, str, str, Callable[[Array], Array | np.ndarray]]
"""Names of tier, method and setting, and the function from stiffnesses to the gradient."""


def gradient_precision(scene: Scene, jam: ExactJam, end: float | None, repeats: int) -> Cost:
    """Return the cost of the gradient of a jam's largest amplitude with respect to the stiffnesses of the supports.

    See `work_precision`.
    """
    mode, supports = jam.mode, _support_stiffness(scene)
    stiffness = jnp.ravel(supports)
    points_coarse, points_medium, points_fine = (collocation_points(scene, points) for points in (16, 24, 32))

    def scene_with(k: Array) -> Scene:
        return eqx.tree_at(_support_stiffness, scene, k.reshape(supports.shape))

    def exact_amplitude(k: Array, points: int = points_coarse) -> Array:
        return jnp.max(jam_orbit(scene_with(k), mode=mode, points=points).amplitude)

    def leading_amplitude(k: Array) -> Array:
        return jnp.max(jam_modes(scene_with(k)).select(mode).amplitude)

    fine, coarse = (
        np.asarray(jax.jacfwd(lambda k, p=p: exact_amplitude(k, p))(stiffness)) for p in (points_fine, points_medium)
    )
    ways: list[_Way] = [
        ("exact orbit", "implicit, reverse", f"{points_coarse} points", jax.jit(jax.grad(exact_amplitude))),
        ("exact orbit", "implicit, forward", f"{points_coarse} points", jax.jit(jax.jacfwd(exact_amplitude))),
    ]
    left_out: list[str] = []
    light = jam_modes(scene).select(mode, throw=False)
    if not bool(light.status == JamStatus.found):
        left_out = [f"leading order, and full (its runs start from the jam of leading order): {light.message}"]
    else:
        ways.insert(0, ("leading order", "implicit, reverse", "", jax.jit(jax.grad(leading_amplitude))))
        if not bool(jam.fine.stable):
            left_out = [unstable_reason("full", jam)]
        else:
            ways += _ways_by_runs(scene, scene_with, jam, end)
    rows = [
        row_of(tier, method, setting, lambda f=f: f(stiffness), lambda slope: relative(slope, fine), repeats)
        for tier, method, setting, f in ways
    ]
    return Cost("gradient", fine.tolist(), relative(coarse, fine), rows, tuple(left_out))


def _ways_by_runs(scene: Scene, scene_with: Callable[[Array], Scene], jam: ExactJam, end: float | None) -> list[_Way]:
    """Return the ways to compute the gradient from runs that start near a stable jam.

    **Arguments**: `scene_with(k)`: the scene with the stiffnesses k (n,); `end` of the runs, s, None for that of
    `ExactJam.length`.
    """
    until = jam.length(scene, _GRADIENT_TOLERANCE) if end is None else end
    max_steps = min(enough_steps(frequency_bounds(scene)[0], jnp.asarray(until)), _MAX_RECORDED_STEPS)

    def amplitude_of_run(k: Array, adjoint: diffrax.AbstractAdjoint | None = None) -> Array:
        run = simulate(
            scene_with(k),
            until,
            start="jam",
            mode=jam.mode,
            save="window",
            stepsize_controller=Tolerance(_GRADIENT_TOLERANCE),
            adjoint=adjoint,
            max_steps=max_steps,
            throw=False,
        )
        return jnp.max(run.amplitude)

    value = eqx.filter_jit(amplitude_of_run)
    ways: list[tuple[str, Callable[[Array], Array | np.ndarray]]] = [
        ("forward", jax.jit(jax.jacfwd(lambda k: amplitude_of_run(k, diffrax.ForwardMode())))),
        ("reverse", jax.jit(jax.grad(amplitude_of_run))),
        ("finite differences", lambda k: _differences(value, k)),
    ]
    return [("full", name, f"{_GRADIENT_TOLERANCE:.0e}", way) for name, way in ways]


def _differences(value: Callable[[Array], Array], at: Array) -> np.ndarray:
    """Return central differences with relative steps of 1e-5.

    For a stiffness of 0 the difference is set to 0, because its step would be 0.
    """
    steps = 1e-5 * np.asarray(at)
    gradient = np.zeros(len(steps))
    for k in np.flatnonzero(steps):
        move = np.eye(len(steps))[k] * steps[k]
        gradient[k] = (float(value(at + move)) - float(value(at - move))) / (2.0 * steps[k])
    return gradient
