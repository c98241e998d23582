"""Many runs side by side with equal steps: how they advance, and one that is watched until its end."""

from __future__ import annotations

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.equations.dynamics import State, vector_field
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import Measured, Trajectory, measure, trajectory
from jaxvib.motion.analysis.regime import Regime, regime
from jaxvib.motion.analysis.scaled_error import natural_units
from jaxvib.motion.integrate import is_finite, wrap_angles
from jaxvib.motion.system import PackedSystem
from jaxvib.ode.types import Y as Held
from jaxvib.runtime.compat import short_end

__all__ = ["LANES", "PARTS", "Plan", "WatchedRun", "advance", "watched_run"]

LANES = 64
"""Cases side by side on a core: so many that vectors are full, so few that a step's stages stay in its cache."""

PARTS = 64
"""Into so many equal parts a watched run is cut before its window; over each the loads' mean speeds are taken."""


@short_end()
def advance(motion: PackedSystem, held: Held, begin: Array, length: Array, step: Array) -> tuple[Held, Array]:
    """What the integrator holds a `length` of time after `begin`, by steps of the size `step`, and how many those were."""
    solution = diffrax.diffeqsolve(
        motion.term,
        motion.method(),
        t0=begin,
        t1=begin + length,
        dt0=step,
        y0=held,
        args=motion.args,
        saveat=diffrax.SaveAt(t1=True),
        stepsize_controller=diffrax.ConstantStepSize(),
        adjoint=diffrax.ForwardMode(),
        max_steps=2**30,
        throw=False,
    )
    return jax.tree.map(lambda leaf: leaf[-1], solution.ys), solution.stats["num_steps"]


class Plan(NamedTuple):
    """How watched runs advance, the same for all that go side by side.

    **Attributes**: `until` s, the end; `window` s, the stretch before it that is measured; `samples` states in it, evenly
    apart; `each` steps in each of the `PARTS` before it; `between` steps from one sample to the next.
    """

    until: float
    window: float
    samples: int
    each: int
    between: int


class WatchedRun(NamedTuple):
    """A run and what was seen of it.

    **Attributes**: `scene` that ran; `window` its last stretch; `measured` and `regime` of the window; `part_speed` (PARTS,
    count) rad/s, the loads' mean speeds over the equal parts before it, each `part_length` s long; `finite` whether the motion
    stayed so.
    """

    scene: Scene
    window: Trajectory
    measured: Measured
    regime: Regime
    part_speed: Array
    part_length: Array
    finite: Array


def watched_run(scene: Scene, state: State, plan: Plan) -> WatchedRun:
    """Integrates the full equations from a state with equal steps, and measures the window at the end as `simulate` does.

    Under `vmap` all runs make the same steps, so that none waits for another and no result depends on the runs beside it.
    """
    dtype = state.displacement.dtype
    single, together = wrap_angles(scene, dtype)
    field = vector_field(scene)
    motion = PackedSystem(field, state, wrapped=single, together=together, lanes=True)
    begin, length = plan.until - plan.window, (plan.until - plan.window) / PARTS
    spacing = plan.window / (plan.samples - 1)

    def part(held: Held, k: Array) -> tuple[Held, Held]:
        held, _ = advance(motion, held, k * length, jnp.asarray(length, dtype), jnp.asarray(length / plan.each, dtype))
        return held, held

    def sample(held: Held, k: Array) -> tuple[Held, Held]:
        at, step = begin + k * spacing, jnp.asarray(spacing / plan.between, dtype)
        moved, _ = advance(motion, held, at, jnp.asarray(spacing, dtype), step)
        return moved, moved

    first = motion.pack(state)
    held, parts = jax.lax.scan(part, first, jnp.arange(PARTS, dtype=dtype))
    _, later = jax.lax.scan(sample, held, jnp.arange(plan.samples - 1, dtype=dtype))
    before = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, parts)
    azimuth = motion.unpack(before).azimuth
    states = motion.unpack(jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), held, later))
    times = begin + spacing * jnp.arange(plan.samples, dtype=dtype)
    window = trajectory(scene, times, states)
    speed = (azimuth[1:] - azimuth[:-1]) / length
    found = measure(scene, field, times, states, natural_units(scene)), regime(scene, window)
    return WatchedRun(scene, window, *found, speed, jnp.asarray(length, dtype), is_finite(states))
