"""Stability of coincident loads: growth of small differences between the angles of loads at nearly one angle.

Loads that have equal parameters and start at one angle stay at one angle in exact arithmetic, even if the motion is unstable. A
run alone therefore does not show that they would separate. The linearized equations along the run show this:

    x' = A(t) x,    growth = ln(spectral radius of the transition matrix over whole turns of the loads) / duration

If the loads have equal parameters, x is the difference of two loads of one track. Such a difference does not move the carrier,
and all differences obey the same equations. Otherwise x is the whole state. The transition matrix is a product of exponentials
(a Magnus method of order 4 on the samples of the run), so that strong drag needs no smaller steps.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import expm

from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.state import ExciterState, State
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.contact import MIN_DISTANCE
from jaxvib.machine.effects.terms import LoadInteraction
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.runtime.parallel import in_background
from jaxvib.runtime.programs import cached

NEARLY_ONE_ANGLE = 0.2
"""Largest angle between loads that count as loads at one angle, rad."""

CLUSTER_ANGLE = 1e-3
"""Largest angle between loads that count as coincident if other loads of their track are elsewhere, rad."""

MIN_SEPARATION_GROWTH = 1e-2
"""Logarithm of the growth over the samples above which loads separate. Smaller values can be errors of the interpolation."""


def tracks(scene: Scene, k: int) -> list[np.ndarray]:
    """Return the numbers of the loads of exciter `k` on each track. Loads of one exciter at one station share a track."""
    exciter = scene.exciters[k]
    assert exciter.loads is not None
    if scene.machine.mounting(exciter.place).at_one_point:
        return [np.arange(exciter.loads.count)]
    stations = np.asarray(scene.machine.mount(exciter.place).distances(exciter.loads.count))
    return [np.flatnonzero(stations == station) for station in np.unique(stations)]


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi


def nearly_coincident_pairs(scene: Scene, k: int, angle: np.ndarray) -> list[tuple[int, int]]:
    """Return two loads of each group of loads of exciter `k` that stay at nearly one angle on one track.

    A group is all loads of a track within `NEARLY_ONE_ANGLE`, or neighbours within `CLUSTER_ANGLE`.

    **Arguments**: `angle` (nt, count) of the loads, rad.
    """
    found = []
    for track in tracks(scene, k):
        own = angle[:, track]
        if len(track) < 2:
            continue
        if np.max(np.ptp(_wrapped(own - own[:, :1]), axis=1)) < NEARLY_ONE_ANGLE:
            found.append((int(track[0]), int(track[1])))
            continue
        order = np.argsort(np.mod(own[-1], 2.0 * np.pi))
        close = np.max(np.abs(_wrapped(own[:, np.roll(order, -1)] - own[:, order])), axis=0) < CLUSTER_ANGLE
        first = np.flatnonzero(close & ~np.roll(close, 1))
        found += [(int(track[order[j]]), int(track[order[(j + 1) % len(order)]])) for j in first]
    return found


def would_separate(scene: Scene, stretch: Trajectory) -> bool:
    """Return True if several loads of a track have nearly one angle, and small differences of their angles grow."""
    duration = float(np.ptp(np.asarray(stretch.time)))
    angles = [None if not own.angle else np.asarray(own.angle[0]) for own in stretch.state.exciters]
    pairs = [(k, pair) for k, own in enumerate(angles) if own is not None for pair in nearly_coincident_pairs(scene, k, own)]
    return any(separation_rate(scene, stretch, k, pair) * duration > MIN_SEPARATION_GROWTH for k, pair in pairs)


def smallest_distance(scene: Scene, kept: Trajectory) -> float:
    """Return the smallest distance of the centres of two loads on one track, in diameters; inf for loads without a size.

    Loads nearest to each other are neighbours by angle.
    """
    found = [math.inf]
    for k, (exciter, state) in enumerate(zip(scene.exciters, kept.state.exciters, strict=True)):
        own = getattr(exciter.loads, "ball_radius", None)
        if exciter.loads is None or own is None:
            continue
        order = np.argsort(np.mod(np.asarray(state.angle[0]), 2.0 * np.pi), axis=1)
        place = [np.asarray(x) for x in exciter.loads.position(*state.angle)]
        for track in tracks(scene, k):
            if len(track) > 1:
                nearby = order[np.isin(order, track)].reshape(len(order), len(track))
                points = [np.take_along_axis(x, nearby, axis=1) for x in place]
                squares = sum(((x - np.roll(x, 1, axis=1)) ** 2 for x in points), np.zeros(nearby.shape))
                found.append(float(np.sqrt(np.min(squares)) / (2.0 * own)))
    return min(found)


def overlap(scene: Scene, kept: Trajectory) -> bool:
    """Return True if loads with a size overlap, which the effect `LoadContact` would prevent."""
    return not has_term(scene.all_effects, LoadInteraction) and smallest_distance(scene, kept) < MIN_DISTANCE


def separation_rate(scene: Scene, stretch: Trajectory, k: int = 0, pair: tuple[int, int] = (0, 1)) -> float:
    """Return the growth rate, 1/s, of small differences between angles of loads at nearly one angle; negative for decay.

    **Arguments**: `stretch`: an evenly sampled part of a run of `scene`, such as `run.window`; `k`: the number of the exciter
    with the loads, from 0; `pair`: numbers of two of these loads on one track.
    """
    phi = np.mean(np.asarray(stretch.state.exciters[k].angle[0])[:, pair], axis=1)
    turns = np.floor(abs(phi[-1] - phi[0]) / (2.0 * np.pi))
    covered = np.abs(phi[-1] - phi) <= 2.0 * np.pi * turns if turns else np.ones(phi.size, bool)
    first = phi.size - 1 - 2 * (np.count_nonzero(covered[:-1]) // 2)
    transition, log_scale, duration = _transition(scene, stretch.time, stretch.state, np.asarray(first), np.asarray(pair), k)
    radius = float(np.max(np.abs(np.linalg.eigvals(np.asarray(transition)))))
    return float((np.log(max(radius, 1e-300)) + float(log_scale)) / float(duration))


def prepare_separation(scene: Scene, state: State, samples: int) -> None:
    """Compile the program of `separation_rate` in a background thread, for `samples` states with the structure of `state`."""
    states = jax.tree.map(lambda leaf: np.zeros((samples, *leaf.shape), leaf.dtype), state)
    times = np.zeros(samples, state.displacement.dtype)
    in_background(functools.partial(_transition.prepare, scene, times, states, np.asarray(0), np.asarray((0, 1)), 0))


@cached
def _transition(
    scene: Scene, times: Array | np.ndarray, states: State, first: Array | np.ndarray, pair: Array | np.ndarray, which: int
) -> tuple[Array, Array, Array]:
    """Return A, b and t: the transition matrix from sample `first` to the last sample is A exp(b), and t is the time between
    them, s."""
    field = vector_field(scene)
    step = (times[-1] - times[0]) / (times.shape[0] - 1)
    begin = jax.tree.map(lambda leaf: leaf[0], states)
    inserted, extracted, size = _basis(scene, begin, which, jnp.asarray(pair))

    def matrix(k: Array) -> Array:
        state = jax.tree.map(lambda leaf: leaf[k], states)

        def rates(x: Array) -> Array:
            return extracted(jax.jvp(lambda s: field(times[k], s), (state,), (inserted(x),))[1])

        return jax.vmap(rates, out_axes=1)(jnp.eye(size, dtype=times.dtype))

    def moved(carry: tuple[Array, Array], pair: Array) -> tuple[tuple[Array, Array], None]:
        transition, log_scale = carry
        # Pairs of steps are counted from the end, so that they end at the last sample.
        end = times.shape[0] - 1 - 2 * pair
        a, b, c = (matrix(jnp.maximum(end - 2 + k, 0)) for k in range(3))
        span = jnp.where(end - 2 >= first, 2.0 * step, 0.0)
        transition = transition @ expm(span / 6.0 * (a + 4.0 * b + c) + span**2 / 12.0 * (c @ a - a @ c))
        largest = jnp.max(jnp.abs(transition))
        return (transition / largest, log_scale + jnp.log(largest)), None

    start = (jnp.eye(size, dtype=times.dtype), jnp.zeros((), times.dtype))
    (transition, log_scale), _ = jax.lax.scan(moved, start, jnp.arange((times.shape[0] - 1) // 2))
    return transition, log_scale, times[-1] - times[first]


def _basis(
    scene: Scene, state: State, which: int, pair: Array
) -> tuple[Callable[[Array], State], Callable[[State], Array], int]:
    """Return the function from the unknowns x to a tangent of the state, its inverse, and the number of unknowns."""
    exciter = scene.exciters[which]
    touching = has_term(exciter.effects, LoadInteraction)
    shared = all(leaf.ndim == 0 for leaf in jax.tree.leaves(exciter.loads))
    if touching or not shared:
        flat, restored = ravel_pytree(state)
        return restored, lambda tangent: ravel_pytree(tangent)[0], flat.size
    zero = jax.tree.map(jnp.zeros_like, state)

    def own_of(state: State) -> tuple:
        return state.exciters[which].angle, state.exciters[which].rate, state.exciters[which].spin

    own = own_of(state)
    treedef, size = jax.tree.structure(own), len(jax.tree.leaves(own))
    difference = jnp.zeros_like(state.exciters[which].angle[0]).at[pair[0]].set(1.0).at[pair[1]].set(-1.0)

    def inserted(x: Array) -> State:
        angle, rate, spin = jax.tree.unflatten(treedef, [x[k] * difference for k in range(size)])
        exciters = list(zero.exciters)
        exciters[which] = ExciterState(angle, rate, exciters[which].rotor, spin)
        return State(zero.displacement, zero.velocity, exciters=exciters)

    def extracted(tangent: State) -> Array:
        return jnp.stack([leaf[pair[0]] for leaf in jax.tree.leaves(own_of(tangent))])

    return inserted, extracted, size
