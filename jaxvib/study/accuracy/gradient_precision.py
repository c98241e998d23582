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
from jaxvib.steady.orbits.jam_orbit import jam_orbit
from jaxvib.study.accuracy.cost import Cost, relative, row_of
from jaxvib.study.accuracy.exact_reference import ExactJam, collocation_points, unstable_reason

_GRADIENT_TOLERANCE = 1e-8

_MAX_RECORDED_STEPS = 2**17
"""Maximum number of steps of a run with derivatives; such a run stores the end of each step."""

_supports = operator.attrgetter("machine.stiffness")
"""Stiffnesses of the supports of a scene."""

_Way: TypeAlias = tuple[str, str, str, Callable[[Array], Array | np.ndarray]]
"""Names of tier, method and setting, and the function from stiffnesses to the gradient."""


def gradient_precision(scene: Scene, jam: ExactJam, end: float | None, repeats: int) -> Cost:
    """Return the cost of the gradient of a jam's largest amplitude with respect to the stiffnesses of the supports.

    See `work_precision`.
    """
    mode, supports = jam.mode, _supports(scene)
    stiffness = jnp.ravel(supports)
    few, more, most = (collocation_points(scene, points) for points in (16, 24, 32))

    def at(k: Array) -> Scene:
        return eqx.tree_at(_supports, scene, k.reshape(supports.shape))

    def exact(k: Array, points: int = few) -> Array:
        return jnp.max(jam_orbit(at(k), mode=mode, points=points).amplitude)

    def leading(k: Array) -> Array:
        return jnp.max(jam_modes(at(k)).select(mode).amplitude)

    fine, coarse = (np.asarray(jax.jacfwd(lambda k, p=p: exact(k, p))(stiffness)) for p in (most, more))
    ways: list[_Way] = [
        ("exact orbit", "implicit, reverse", f"{few} points", jax.jit(jax.grad(exact))),
        ("exact orbit", "implicit, forward", f"{few} points", jax.jit(jax.jacfwd(exact))),
    ]
    left_out: list[str] = []
    light = jam_modes(scene).select(mode, throw=False)
    if not bool(light.status == JamStatus.found):
        left_out = [f"leading order, and full, which starts from it: {light.message}"]
    else:
        ways.insert(0, ("leading order", "implicit, reverse", "", jax.jit(jax.grad(leading))))
        if not bool(jam.fine.stable):
            left_out = [unstable_reason("full", jam)]
        else:
            ways += _by_runs(scene, at, jam, end)
    rows = [
        row_of(tier, method, setting, lambda f=f: f(stiffness), lambda slope: relative(slope, fine), repeats)
        for tier, method, setting, f in ways
    ]
    return Cost("gradient", fine.tolist(), relative(coarse, fine), rows, tuple(left_out))


def _by_runs(scene: Scene, at: Callable[[Array], Scene], jam: ExactJam, end: float | None) -> list[_Way]:
    """Return the ways to compute the gradient from runs that start near a stable jam; `at(k)`: scene with stiffnesses k."""
    until = jam.length(scene, _GRADIENT_TOLERANCE) if end is None else end
    max_steps = min(enough_steps(frequency_bounds(scene)[0], jnp.asarray(until)), _MAX_RECORDED_STEPS)

    def full(k: Array, adjoint: diffrax.AbstractAdjoint | None = None) -> Array:
        run = simulate(
            at(k),
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

    value = eqx.filter_jit(full)
    ways: list[tuple[str, Callable[[Array], Array | np.ndarray]]] = [
        ("forward", jax.jit(jax.jacfwd(lambda k: full(k, diffrax.ForwardMode())))),
        ("reverse", jax.jit(jax.grad(full))),
        ("finite differences", lambda k: _differences(value, k)),
    ]
    return [("full", name, f"{_GRADIENT_TOLERANCE:.0e}", way) for name, way in ways]


def _differences(value: Callable[[Array], Array], at: Array) -> np.ndarray:
    """Return central differences with relative steps of 1e-5.

    The entry of a stiffness that is 0 is 0, because its step would be 0.
    """
    steps = 1e-5 * np.asarray(at)
    whole = np.zeros(len(steps))
    for k in np.flatnonzero(steps):
        move = np.eye(len(steps))[k] * steps[k]
        whole[k] = (float(value(at + move)) - float(value(at - move))) / (2.0 * steps[k])
    return whole
