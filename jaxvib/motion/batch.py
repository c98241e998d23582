"""Batches of runs with equal steps, and measurements along each run."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.equations.dynamics import dynamics_of
from jaxvib.equations.model import assemble
from jaxvib.equations.state import State
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import (
    Extrema,
    Measured,
    Peaks,
    Trajectory,
    extrema_of_steps,
    locate_peaks,
    measure,
    trajectory,
    turning_angles,
)
from jaxvib.motion.analysis.regime import Regime, regime
from jaxvib.motion.analysis.scaled_error import natural_units
from jaxvib.motion.integrate import angle_wrapping, is_finite, is_unbounded
from jaxvib.motion.integration.contacts import Contacts, ContactSolver
from jaxvib.motion.integration.stiffness import has_contacts, resolves
from jaxvib.motion.integration.system import PackedSystem
from jaxvib.numerics.extrema import NODES
from jaxvib.ode.rodas4 import Rodas4
from jaxvib.ode.types import Y as IntegratorState
from jaxvib.runtime.compat import fast_diffrax_loop_end
from jaxvib.runtime.devices import is_cpu

BATCH_SIZE = 64
"""Number of runs in a batch on a core: enough to fill the vector registers, and few enough to fit into the cache."""

_ACCELERATOR_BATCH_SIZE = 2**18
"""Number of runs in a batch on an accelerator: enough to occupy all of its units, and few enough for its memory."""

PARTS_OF_RUN = 64
"""Number of equal parts of a run before its window; the mean speed of each load is measured over each part."""


_STEPS_PER_BLOCK = 16
"""Approximate number of steps of a block, in which the largest values are determined from the state at each step."""

_DOUBLINGS = 40
"""Number of doublings from the end of the first implicit step, 1e-12 of a regular step, to the end of a regular step."""


@fast_diffrax_loop_end()
def advance(
    motion: PackedSystem, packed: IntegratorState, begin: Array, length: Array, step: Array, *, implicit: bool = False
) -> tuple[IntegratorState, Array]:
    """Return the state of the integrator at the time `begin` + `length`, by steps of size `step`, and the number of steps."""
    solver = Rodas4() if implicit else motion.method()
    solution = diffrax.diffeqsolve(
        motion.term,
        ContactSolver(solver, motion) if motion.has_contacts else solver,
        t0=begin,
        t1=begin + length,
        dt0=step,
        y0=packed,
        args=motion.args,
        saveat=diffrax.SaveAt(t1=True),
        stepsize_controller=diffrax.ConstantStepSize(),
        adjoint=diffrax.ForwardMode(),
        max_steps=2**30,
        throw=False,
    )
    return jax.tree.map(lambda leaf: leaf[-1], solution.ys), solution.stats["num_steps"]


def advance_by_steps(
    motion: PackedSystem, packed: IntegratorState, begin: Array, length: Array, number: int, *, implicit: bool
) -> tuple[IntegratorState, tuple[Array, State]]:
    """Return the state of the integrator at the time `begin` + `length`, and the times and the states of a `number` of equal
    steps."""
    step, indices = length / number, jnp.arange(number + 1, dtype=length.dtype)

    def single_step(packed: IntegratorState, k: Array) -> tuple[IntegratorState, IntegratorState]:
        moved, _ = advance(motion, packed, begin + k * step, step, step, implicit=implicit)
        return moved, moved

    last, later = jax.lax.scan(single_step, packed, indices[:-1])
    return last, (begin + step * indices, motion.unpack(_prepend(packed, later)))


def divide_run(
    motion: PackedSystem, packed: IntegratorState, length: Array, step: Array, number: int, *, implicit: bool
) -> tuple[IntegratorState, Array, Array]:
    """Return the first state of the integrator, and the start times and lengths, s, of `number` parts of equal `length`.

    Before regular implicit steps, which do not resolve the fast acceleration of loads by drag at the start, very short steps
    are taken, the end of each at twice the time of the previous one. The first part begins at their end and is shorter.
    """
    begins, lengths = length * jnp.arange(number, dtype=length.dtype), jnp.full(number, length)
    if not implicit:
        return packed, begins, lengths

    def double_step(k: Array, packed: IntegratorState) -> IntegratorState:
        end = step * 2.0 ** (k - _DOUBLINGS)
        begin = jnp.where(k == 0, 0.0, end / 2.0)
        return advance(motion, packed, begin, end - begin, end - begin, implicit=True)[0]

    packed = jax.lax.fori_loop(0, _DOUBLINGS + 1, double_step, packed)
    return packed, begins.at[0].set(step), lengths.at[0].add(-step)


def pack_batch(scene: Scene, field: Callable[[Array, State], State], state: State, *, implicit: bool) -> PackedSystem:
    """Return the equations of a batch of runs; for an implicit method the state of each run is one vector."""
    contacts = Contacts.of(scene)
    if implicit:
        return PackedSystem(field, state, contacts=contacts, solver=Rodas4())
    wrapped, has_common_turns = angle_wrapping(scene, state.displacement.dtype)
    return PackedSystem(field, state, wrapped=wrapped, has_common_turns=has_common_turns, batch=True, contacts=contacts)


def batch_size() -> int:
    """Return the number of runs that advance together on the default device of JAX."""
    return BATCH_SIZE if is_cpu() else _ACCELERATOR_BATCH_SIZE


class BatchPlan(NamedTuple):
    """Steps of a batch of runs: end time `until` and length `window` of the measuring window at the end, s; numbers of
    `samples` in the window, of steps in `each` of the `PARTS_OF_RUN` parts before it and `between` two samples; `implicit`:
    True if decay is too fast for explicit steps; number of `blocks` of a part whose largest values are determined, 0 for
    none."""

    until: float
    window: float
    samples: int
    each: int
    between: int
    implicit: bool = False
    blocks: int = 0

    def with_peaks(self) -> BatchPlan:
        """Return the plan that also determines the largest values; it has at least as many steps."""
        blocks = -(-self.each // _STEPS_PER_BLOCK)
        return self._replace(blocks=blocks, each=blocks * max(NODES - 1, -(-self.each // blocks)))


class BatchRun(NamedTuple):
    """Run of a batch with its measurements.

    **Attributes**

    - `scene`
    - `window`: trajectory in the measuring window; `measured`: the quantities measured in it
    - `regime` of the window, None for a scene that is not plain (`Scene.is_plain`)
    - `part_speed` (PARTS_OF_RUN, count), rad/s: mean speeds of the loads, or of rotors without loads, over the equal parts
      before the window; `part_length` of such a part, s
    - `finite`: True if the motion stayed finite and bounded
    - `resolved`: False if the steps are too long, see `resolves`
    - `peaks` of the whole run, None if the plan has no blocks
    """

    scene: Scene
    window: Trajectory
    measured: Measured
    regime: Regime | None
    part_speed: Array
    part_length: Array
    finite: Array
    resolved: Array
    peaks: Peaks | None = None


def run_in_batch(scene: Scene, state: State, plan: BatchPlan) -> BatchRun:
    """Integrate the full equations from a state with equal steps, and measure the window at the end like `simulate`.

    Under `vmap` all runs take the same steps. No run waits for another, and no result depends on the other runs.
    """
    dtype = state.displacement.dtype
    model = assemble(scene)
    field = dynamics_of(model)
    motion = pack_batch(scene, field, state, implicit=plan.implicit)
    has_contact = has_contacts(scene)
    begin, length = plan.until - plan.window, (plan.until - plan.window) / PARTS_OF_RUN
    spacing = plan.window / (plan.samples - 1)

    def part(packed: IntegratorState, at: tuple[Array, Array]) -> tuple[IntegratorState, tuple[IntegratorState, Peaks | None]]:
        packed, _ = advance(motion, packed, *at, jnp.asarray(length / plan.each, dtype), implicit=plan.implicit)
        return packed, (packed, None)

    def sample(packed: IntegratorState, k: Array) -> tuple[IntegratorState, tuple[IntegratorState, Extrema | None]]:
        at, length = begin + k * spacing, jnp.asarray(spacing, dtype)
        if has_contact:  # a contact may be shorter than the time between two samples
            moved, steps = advance_by_steps(motion, packed, at, length, plan.between, implicit=plan.implicit)
            return moved, (moved, extrema_of_steps(model, field, *steps))
        moved, _ = advance(motion, packed, at, length, jnp.asarray(spacing / plan.between, dtype), implicit=plan.implicit)
        return moved, (moved, None)

    def block(packed: IntegratorState, at: tuple[Array, Array]) -> tuple[IntegratorState, Peaks]:
        last, steps = advance_by_steps(motion, packed, *at, plan.each // plan.blocks, implicit=plan.implicit)
        return last, extrema_of_steps(model, field, *steps).peaks(model) if has_contact else locate_peaks(model, field, *steps)

    def part_with_peaks(
        packed: IntegratorState, at: tuple[Array, Array]
    ) -> tuple[IntegratorState, tuple[IntegratorState, Peaks | None]]:
        begin, length = at[0], at[1] / plan.blocks
        begins = begin + length * jnp.arange(plan.blocks, dtype=dtype)
        packed, peaks = jax.lax.scan(block, packed, (begins, jnp.full(plan.blocks, length)))
        return packed, (packed, jax.tree.map(lambda peak: jnp.max(peak, axis=0), peaks))

    first = motion.pack(state)
    sizes = jnp.asarray(length, dtype), jnp.asarray(length / plan.each, dtype)
    packed, begins, lengths = divide_run(motion, first, *sizes, PARTS_OF_RUN, implicit=plan.implicit)
    packed, (parts, part_peaks) = jax.lax.scan(part_with_peaks if plan.blocks else part, packed, (begins, lengths))
    _, (later, extrema) = jax.lax.scan(sample, packed, jnp.arange(plan.samples - 1, dtype=dtype))
    packed_history = _prepend(first, parts)
    azimuth, _ = turning_angles(
        scene, lambda: length * jnp.arange(PARTS_OF_RUN + 1, dtype=dtype), motion.unpack(packed_history)
    )
    states = motion.unpack(_prepend(packed, later))
    times = begin + spacing * jnp.arange(plan.samples, dtype=dtype)
    window = trajectory(model, times, states)
    speed = (azimuth[1:] - azimuth[:-1]) / length
    unit, last = natural_units(scene), jax.tree.map(lambda leaf: leaf[-1], states)
    measured = measure(model, field, times, states, unit, extrema)
    kind = regime(scene, window) if scene.is_plain else None
    finite = is_finite(states) & ~is_unbounded(unit, state, last)
    peaks, largest = None, states.displacement
    if part_peaks is not None:
        last_peaks = locate_peaks(model, field, times, states) if extrema is None else extrema.part().peaks(model)
        peaks = jax.tree.map(lambda parts, last: jnp.maximum(jnp.max(parts, axis=0), last), part_peaks, last_peaks)
        largest = jnp.concatenate([largest, peaks.displacement[None]])
    resolved = resolves(scene, max(length / plan.each, spacing / plan.between), largest, implicit=plan.implicit)
    return BatchRun(scene, window, measured, kind, speed, jnp.asarray(length, dtype), finite, resolved, peaks)


def _prepend(first: IntegratorState, later: IntegratorState) -> IntegratorState:
    return jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, later)
