"""Stability of coincident loads: growth of small differences between the angles of loads at nearly one angle.

Loads that have equal parameters and start at one angle stay at one angle in exact arithmetic, even if the motion is unstable. A
run alone therefore does not show whether slightly separated loads would separate further. The linearized equations along the
run show this:

    x' = A(t) x,    growth = ln(spectral radius of the transition matrix over whole turns of the loads) / duration

If the loads have equal parameters and exert no forces on each other, x is the difference of the states of two loads of one
track. Such a difference does not move the carrier, and all differences obey the same equations. Otherwise x is the whole
state. The transition matrix is a product of exponentials (a Magnus method of order 4 on the samples of the run); therefore
strong drag needs no smaller steps.
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
"""If the logarithm of the growth factor over the samples is above this value, loads are said to separate. Smaller values can be
errors of the interpolation."""


def tracks(scene: Scene, k: int) -> list[np.ndarray]:
    """Return the numbers of the loads of exciter `k` on each track. Loads of one exciter at one station share a track."""
    exciter = scene.exciters[k]
    assert exciter.loads is not None
    if scene.machine.mounting(exciter.place).at_one_point:
        return [np.arange(exciter.loads.count)]
    stations = np.asarray(scene.machine.mount(exciter.place).distances(exciter.loads.count))
    return [np.flatnonzero(stations == station) for station in np.unique(stations)]


def _wrap_angle(angle: np.ndarray) -> np.ndarray:
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi


def nearly_coincident_pairs(scene: Scene, k: int, angle: np.ndarray) -> list[tuple[int, int]]:
    """Return the numbers of two loads of each group of nearly coincident loads of exciter `k`, from their angles (nt, count).

    All loads of a track form a group if they stay within `NEARLY_ONE_ANGLE`; otherwise neighbours within `CLUSTER_ANGLE` do.
    """
    pairs = []
    for track in tracks(scene, k):
        track_angle = angle[:, track]
        if len(track) < 2:
            continue
        if np.max(np.ptp(_wrap_angle(track_angle - track_angle[:, :1]), axis=1)) < NEARLY_ONE_ANGLE:
            pairs.append((int(track[0]), int(track[1])))
            continue
        order = np.argsort(np.mod(track_angle[-1], 2.0 * np.pi))
        close = np.max(np.abs(_wrap_angle(track_angle[:, np.roll(order, -1)] - track_angle[:, order])), axis=0) < CLUSTER_ANGLE
        first = np.flatnonzero(close & ~np.roll(close, 1))
        pairs += [(int(track[order[j]]), int(track[order[(j + 1) % len(order)]])) for j in first]
    return pairs


def would_separate(scene: Scene, segment: Trajectory) -> bool:
    """Return True if several loads of a track have nearly one angle, and small differences of their angles grow."""
    duration = float(np.ptp(np.asarray(segment.time)))
    pairs = [
        (k, pair)
        for k, exciter in enumerate(segment.state.exciters)
        if exciter.angle
        for pair in nearly_coincident_pairs(scene, k, np.asarray(exciter.angle[0]))
    ]
    return any(separation_rate(scene, segment, k, pair) * duration > MIN_SEPARATION_GROWTH for k, pair in pairs)


def smallest_distance(scene: Scene, segment: Trajectory) -> float:
    """Return the smallest distance of the centres of two loads on one track, in diameters; infinite without a size."""
    distances = [math.inf]
    for k, (exciter, state) in enumerate(zip(scene.exciters, segment.state.exciters, strict=True)):
        ball_radius = getattr(exciter.loads, "ball_radius", None)
        if exciter.loads is None or ball_radius is None:
            continue
        order = np.argsort(np.mod(np.asarray(state.angle[0]), 2.0 * np.pi), axis=1)
        place = [np.asarray(x) for x in exciter.loads.position(*state.angle)]
        for track in tracks(scene, k):
            if len(track) > 1:
                nearby = order[np.isin(order, track)].reshape(len(order), len(track))
                points = [np.take_along_axis(x, nearby, axis=1) for x in place]
                squares = sum(((x - np.roll(x, 1, axis=1)) ** 2 for x in points), np.zeros(nearby.shape))
                distances.append(float(np.sqrt(np.min(squares)) / (2.0 * ball_radius)))
    return min(distances)


def has_overlap(scene: Scene, segment: Trajectory) -> bool:
    """Return True if the distance of two loads with a size is below 0.9 diameters at some time, which the effect `LoadContact`
    would prevent. Smaller overlaps count as contact."""
    return not has_term(scene.all_effects, LoadInteraction) and smallest_distance(scene, segment) < MIN_DISTANCE


def has_collision(scene: Scene, segment: Trajectory) -> bool:
    """Return True if loads in contact with each other (`LoadContact`) touch at some time."""
    return has_term(scene.all_effects, LoadInteraction) and smallest_distance(scene, segment) < 1.0


def separation_rate(scene: Scene, segment: Trajectory, k: int = 0, pair: tuple[int, int] = (0, 1)) -> float:
    """Return the growth rate, 1/s, of small differences between the angles of a `pair` of loads of exciter `k` at nearly one
    angle in an evenly sampled `segment` of a run; negative for decay."""
    phi = np.mean(np.asarray(segment.state.exciters[k].angle[0])[:, pair], axis=1)
    turns = np.floor(abs(phi[-1] - phi[0]) / (2.0 * np.pi))
    covered = np.abs(phi[-1] - phi) <= 2.0 * np.pi * turns if turns else np.ones(phi.size, bool)
    first = phi.size - 1 - 2 * (np.count_nonzero(covered[:-1]) // 2)
    transition, log_scale, duration = _transition(scene, segment.time, segment.state, np.asarray(first), np.asarray(pair), k)
    radius = float(np.max(np.abs(np.linalg.eigvals(np.asarray(transition)))))
    return float((np.log(max(radius, 1e-300)) + float(log_scale)) / float(duration))


def prepare_separation(scene: Scene, state: State, samples: int) -> None:
    """Compile the program of `separation_rate` in a background thread, for `samples` states with the structure of `state`."""
    states = jax.tree.map(lambda leaf: np.zeros((samples, *leaf.shape), leaf.dtype), state)
    times = np.zeros(samples, state.displacement.dtype)
    in_background(functools.partial(_transition.prepare, scene, times, states, np.asarray(0), np.asarray((0, 1)), 0))


@cached
def _transition(
    scene: Scene, times: Array | np.ndarray, states: State, first: Array | np.ndarray, pair: Array | np.ndarray, k_exciter: int
) -> tuple[Array, Array, Array]:
    """Return A, b and t: the transition matrix from sample `first` to the last sample is A exp(b); t is the time between these
    samples, s."""
    field = vector_field(scene)
    step = (times[-1] - times[0]) / (times.shape[0] - 1)
    begin = jax.tree.map(lambda leaf: leaf[0], states)
    to_tangent, to_unknowns, size = _basis(scene, begin, k_exciter, jnp.asarray(pair))

    def matrix(k: Array) -> Array:
        state = jax.tree.map(lambda leaf: leaf[k], states)

        def rates(x: Array) -> Array:
            return to_unknowns(jax.jvp(lambda s: field(times[k], s), (state,), (to_tangent(x),))[1])

        return jax.vmap(rates, out_axes=1)(jnp.eye(size, dtype=times.dtype))

    def advance(carry: tuple[Array, Array], pair: Array) -> tuple[tuple[Array, Array], None]:
        transition, log_scale = carry
        # Pairs of steps are counted from the end; the first pair ends at the last sample.
        end = times.shape[0] - 1 - 2 * pair
        a, b, c = (matrix(jnp.maximum(end - 2 + k, 0)) for k in range(3))
        span = jnp.where(end - 2 >= first, 2.0 * step, 0.0)
        transition = transition @ expm(span / 6.0 * (a + 4.0 * b + c) + span**2 / 12.0 * (c @ a - a @ c))
        largest = jnp.max(jnp.abs(transition))
        return (transition / largest, log_scale + jnp.log(largest)), None

    start = (jnp.eye(size, dtype=times.dtype), jnp.zeros((), times.dtype))
    (transition, log_scale), _ = jax.lax.scan(advance, start, jnp.arange((times.shape[0] - 1) // 2))
    return transition, log_scale, times[-1] - times[first]


def _basis(
    scene: Scene, state: State, k_exciter: int, pair: Array
) -> tuple[Callable[[Array], State], Callable[[State], Array], int]:
    """Return the function from the unknowns x to a tangent of the state, its inverse, and the number of unknowns."""
    exciter = scene.exciters[k_exciter]
    has_contact = has_term(exciter.effects, LoadInteraction)
    has_equal_loads = all(leaf.ndim == 0 for leaf in jax.tree.leaves(exciter.loads))
    if has_contact or not has_equal_loads:
        flat, restored = ravel_pytree(state)
        return restored, lambda tangent: ravel_pytree(tangent)[0], flat.size
    zero = jax.tree.map(jnp.zeros_like, state)

    def coordinates_of(state: State) -> tuple:
        return state.exciters[k_exciter].angle, state.exciters[k_exciter].rate, state.exciters[k_exciter].spin

    coordinates = coordinates_of(state)
    treedef, size = jax.tree.structure(coordinates), len(jax.tree.leaves(coordinates))
    difference = jnp.zeros_like(state.exciters[k_exciter].angle[0]).at[pair[0]].set(1.0).at[pair[1]].set(-1.0)

    def to_tangent(x: Array) -> State:
        angle, rate, spin = jax.tree.unflatten(treedef, [x[k] * difference for k in range(size)])
        exciters = list(zero.exciters)
        exciters[k_exciter] = ExciterState(angle, rate, exciters[k_exciter].rotor, spin)
        return State(zero.displacement, zero.velocity, exciters=exciters)

    def to_unknowns(tangent: State) -> Array:
        return jnp.stack([leaf[pair[0]] for leaf in jax.tree.leaves(coordinates_of(tangent))])

    return to_tangent, to_unknowns, size
