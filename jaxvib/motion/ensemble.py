"""Many runs at once, on every core or graphics processor."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.machine.units import Number, count, number, traced
from jaxvib.motion.dynamics import State, vector_field
from jaxvib.motion.engine import Motion
from jaxvib.motion.integrate import fastest_and_slowest, is_finite
from jaxvib.motion.start import initial_state

__all__ = ["Ensemble", "ensemble"]

_PARTS = 4
"""Into so many parts a run is cut; over the last one mean speeds are taken."""

_LANES = 64
"""Runs that advance together on a core: so many that vectors are full, so few that a step's stages stay in its cache."""


class Ensemble(eqx.Module):
    """Where many runs ended.

    **Attributes** (B runs): `state` a `State` whose arrays have a leading axis over the runs, at the end; `omega` (B, count)
    rad/s, the mean speed of each load over the last quarter of the run; `error` (B,) estimated, as that of a `Run` but for the
    end state alone, NaN where no estimate was asked for; `finite` (B,) whether the motion stayed so; `steps` each run took;
    `seconds` all of it took, compiling included where the program was new, NaN under a JAX transformation.
    """

    state: State
    omega: Array
    error: Array
    finite: Array
    steps: Array
    seconds: Array


def ensemble(
    make: Callable[..., Scene | tuple[Scene, State]],
    values: Any,
    until: Number,
    *,
    steps: int | None = None,
    estimate: bool = True,
    lanes: int = _LANES,
) -> Ensemble:
    """Integrates many scenes, or one scene from many starts, from 0 to `until` with equal steps.

    Runs advance together, `lanes` at a time, every number of the state a contiguous array over them, and chunks are spread over
    all devices that JAX has: graphics processors, or as many cores as `prepare_cpu(devices=None)` made devices of.
    Equal steps keep runs together that would wait for each other otherwise; near the boundary between two outcomes they also
    keep the choice of steps from deciding. Other values of the same shape need no new program.

    **Arguments**

    - `make`: gives a run's `Scene`, which starts at rest, or its scene and `State`, from one entry of `values`
    - `values`: an array with a leading axis over the runs, or a tree of them
    - `until`: end time, s or text, of all runs
    - `steps`: how many each run takes; 4 for each radian of what moves fastest unless said otherwise
    - `estimate`: whether to estimate errors by a second run with half as many steps
    - `lanes`: how many runs advance together

    **Returns** `Ensemble`. Derivatives go through it in forward mode.

    **Raises** `InputError` for values that are not allowed, or leading axes that differ.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import equinox as eqx, jax.numpy as jnp, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> speeds = jnp.linspace(40.0, 80.0, 5)
    >>> many = jv.ensemble(lambda n: eqx.tree_at(lambda s: s.drive.speed, scene, n), speeds, 5.0)
    >>> many.state.displacement.shape, bool(many.finite.all()), bool(many.error.max() < 1e-6)
    ((5, 1), True, True)
    """
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(values)}
    if len(sizes) != 1 or sizes & {(), (0,)}:
        raise InputError("values", f"has leading axes {sorted(sizes)}; all need one and the same, with 1 run at least")
    ((runs,),) = sizes
    end = number(until, "s", "until", low=0.0, open_low=True)
    lanes = min(count(lanes, "lanes"), runs)

    def whole(value: Any) -> tuple[Scene, State]:
        made = make(value)
        alone = isinstance(made, Scene)
        scene, state = (made, initial_state(made)) if alone else made if isinstance(made, tuple) else (made, None)
        if not isinstance(scene, Scene) or not isinstance(state, State):
            raise InputError("make", f"gives {made!r}; it must give a Scene, or a Scene and a State")
        return scene, state

    made = eqx.filter_jit(eqx.filter_vmap(whole))(values)
    known = not any(traced(leaf) for leaf in jax.tree.leaves((made, end)))
    # What all runs share stays one number: it is not read anew for each.
    shared = [known and bool(np.all(np.asarray(leaf) == np.asarray(leaf[:1]))) for leaf in jax.tree.leaves(made)]
    leaves, rest = jax.tree.flatten(made)
    parts = [leaf[0] if same else leaf for leaf, same in zip(leaves, shared, strict=True)]
    if steps is None:
        if not known:
            raise InputError("steps", "is missing; under a JAX transformation say how many steps each run takes")
        fastest = float(jnp.max(jax.jit(jax.vmap(lambda s: fastest_and_slowest(s)[0]))(made[0])))
        steps = max(16, math.ceil(4.0 * float(end) * fastest))
    count(steps, "steps")
    chosen = (tuple(shared), rest, lanes, runs)
    begun = time.perf_counter()
    states, finite = _all(parts, end, jnp.asarray(steps, end.dtype), *chosen)
    last = jax.tree.map(lambda leaf: leaf[:, -1], states)
    error = jnp.full((runs,), jnp.nan, end.dtype)
    if estimate:
        coarse, _ = _all(parts, end, jnp.ceil(jnp.asarray(steps, end.dtype) / 2.0), *chosen)
        # What a method of order 3 would leave of the difference; this one is of order 8.
        error = _apart(made[0], last, jax.tree.map(lambda leaf: leaf[:, -1], coarse)) / 8.0
    omega = (states.angle[0][:, -1] - states.angle[0][:, -2]) / (end / _PARTS)
    if known:
        jax.block_until_ready((last, error))
    seconds = jnp.asarray(time.perf_counter() - begun if known else jnp.nan, end.dtype)
    return Ensemble(last, omega, error, finite, jnp.asarray(steps), seconds)


@eqx.filter_jit
def _all(
    parts: list[Array], end: Array, steps: Array, shared: tuple[bool, ...], rest: Any, lanes: int, runs: int
) -> tuple[State, Array]:
    """All runs in chunks over all devices: states at the ends of the run's parts (runs, parts, ...), and whether finite."""
    devices = jax.devices()
    chunks = -(-runs // (lanes * len(devices)))
    padded = chunks * lanes * len(devices)

    def chunked(leaf: Array) -> Array:
        # The last chunk is filled up with copies of the last run.
        filled = jnp.concatenate([leaf, jnp.broadcast_to(leaf[-1:], (padded - runs, *leaf.shape[1:]))])
        return filled.reshape(chunks * len(devices), lanes, *leaf.shape[1:])

    own = [chunked(leaf) for leaf, same in zip(parts, shared, strict=True) if not same]
    common = [leaf for leaf, same in zip(parts, shared, strict=True) if same]

    def one(own: list[Array], common: list[Array], end: Array, steps: Array) -> tuple[State, Array]:
        mine, ours = iter(own), iter(common)
        scene, state = jax.tree.unflatten(rest, [next(ours) if same else next(mine) for same in shared])
        return _run(scene, state, end, steps)

    def on_device(own: list[Array], common: list[Array], end: Array, steps: Array) -> tuple[State, Array]:
        chunk = jax.vmap(one, in_axes=(0, None, None, None))
        return jax.lax.map(lambda mine: chunk(mine, common, end, steps), own)

    if len(devices) > 1:
        split, whole = PartitionSpec("runs"), PartitionSpec()
        mesh = Mesh(np.asarray(devices), ("runs",))
        specs = (split, whole, whole, whole)
        on_device = jax.shard_map(on_device, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)
    states, finite = on_device(own, common, end, steps)
    return jax.tree.map(lambda leaf: leaf.reshape(padded, *leaf.shape[2:])[:runs], (states, finite))


def _run(scene: Scene, state: State, end: Array, steps: Array) -> tuple[State, Array]:
    """One run of equal steps in a few parts, which share a program; states at their ends."""
    motion = Motion(vector_field(scene), state, wrapped=False)
    each = end / _PARTS
    step = each / jnp.ceil(steps / _PARTS)

    def part(held: Any, begin: Array) -> tuple[Any, Any]:
        solution = diffrax.diffeqsolve(
            motion.term,
            motion.method(lanes=True),
            t0=begin,
            t1=begin + each,
            dt0=step,
            y0=held,
            args=motion.args,
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.ConstantStepSize(),
            adjoint=diffrax.ForwardMode(),
            max_steps=2**30,
            throw=False,
        )
        held = jax.tree.map(lambda leaf: leaf[-1], solution.ys)
        return held, held

    _, helds = jax.lax.scan(part, motion.held(state), each * jnp.arange(_PARTS))
    states, _ = motion.states(helds)
    return states, is_finite(states)


def _apart(scenes: Scene, a: State, b: State) -> Array:
    """How far the ends of runs are apart, (B,): as a `Run`'s `error`, displacements relative to the largest of all."""
    speed = scenes.drive.speed

    def largest(x: Array, y: Array) -> Array:
        return jnp.max(jnp.abs(x - y), axis=-1)

    parts = [largest(x, y) / jnp.max(jnp.abs(x)) for x, y in ((a.displacement, b.displacement), (a.velocity, b.velocity))]
    parts += [largest(x, y) for x, y in zip(a.angle, b.angle, strict=True)]
    parts += [largest(x, y) / speed for x, y in zip(a.rate, b.rate, strict=True)]
    if a.rotor is not None and b.rotor is not None:
        parts += [jnp.abs(a.rotor[0] - b.rotor[0]), jnp.abs(a.rotor[1] - b.rotor[1]) / speed]
    return jnp.max(jnp.stack(parts), axis=0)
