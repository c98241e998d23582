"""Time integration of a scene, through diffrax."""

from __future__ import annotations

import math
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.drive import ConstantSpeed, IdealDrive, Motor, SpinUp
from jaxvib.machine.scene import Scene
from jaxvib.machine.units import Number, count, number, traced
from jaxvib.motion.dynamics import Dynamics, State, vector_field
from jaxvib.motion.observables import measure, trajectory
from jaxvib.motion.progress import ProgressBar
from jaxvib.motion.run import Run, RunStatus
from jaxvib.motion.start import Start, initial_state
from jaxvib.programs import kept
from jaxvib.steady.response import natural_frequencies

__all__ = ["simulate"]

_WINDOW = 4096
"""Samples in the window over which amplitudes and speeds are measured."""

_PER_TURN = 16
"""Fewest samples in a turn of the rotor: the interpolant between them is then good to 1e-7."""

_MOST_STEPS = 2**31 - 1


def _units(scene: Scene) -> State:
    """What counts as 1 in each part of the state: the throw of the loads, S/M, at the port, at the rotor's speed; 1 rad."""
    carrier, loads = scene.machine.carrier(), scene.loads
    throw = jnp.mean(loads.mass) * jnp.sqrt(sum(jnp.mean(jnp.square(x)) for x in loads.position(jnp.zeros(loads.count))))
    length = loads.count * throw / jnp.mean(jnp.diagonal(carrier.mass))
    speed = scene.drive.speed
    one = jnp.ones_like(speed)
    rotor = (one, speed) if isinstance(scene.drive, Motor) else None
    return jax.lax.stop_gradient(State(length, length * speed, (one,), (speed,), rotor))


def simulate(
    scene: Scene,
    until: Number,
    *,
    start: Start | State = "rest",
    mode: int | None = None,
    spin_up: Number | None = None,
    save: Literal["all", "window"] = "all",
    samples: int | None = None,
    turns: int = 20,
    tolerance: float = 1e-8,
    solver: diffrax.AbstractSolver | None = None,
    controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int | None = None,
    progress: bool = False,
    throw: bool = True,
) -> Run:
    """Integrates the full equations of motion of `scene` from 0 to `until` and measures what comes out.

    **Arguments**

    - `until`: end time, s or text such as "20 s"
    - `start`: "rest", "jam" (near the jam mode with number `mode`), "spin_up" (at rest, the rotor's speed rising smoothly
      over the time `spin_up`, half of `until` unless said otherwise), or a `State`; see `initial_state`
    - `save`: "all" keeps `samples` evenly spaced states (unless said otherwise 16 or more for each turn of the rotor, but 2000
      under a JAX transformation and 262144 at most); "window" keeps no trajectory, only what is measured
    - `turns`: how many periods of the lowest natural frequency the measuring window at the end is long (at most half the run,
      and 256 turns of the rotor)
    - `tolerance`: error a step may make, relative, and absolute in natural units: the throw S/M of the loads for
      displacements, that times the rotor's speed for velocities, 1 rad for angles, whose error is never relative
    - `solver`, `controller`, `adjoint`: diffrax's, passed through; Tsit5, a PI controller to `tolerance`, and checkpointed
      reverse mode unless said otherwise. For forward mode give `diffrax.ForwardMode()`
    - `max_steps`: the run fails after so many steps; unless said otherwise 500 for each turn of what moves fastest
    - `progress`: shows a bar on the error stream
    - `throw`: raise if the run fails; otherwise, and under a JAX transformation, its status says so

    **Returns** `Run`. Gradients, forward and reverse, go through all of it; `jit` and `vmap` too.

    **Raises** `InputError` for values that are not allowed, `ComputationError` for a run that does not finish.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> run = jv.simulate(scene, 10.0, start="jam", mode=1)
    >>> bool(run.settled), round(float(run.omega), 2)      # caught just below the resonance at 28.1 rad/s
    (True, 27.41)

    Source: the antiphase paper, section 5.3; the method is an embedded Runge-Kutta pair, see diffrax.
    """
    if not isinstance(scene, Scene):
        raise InputError("scene", f"is {scene!r}; it must be a Scene, for example load_scene('machine.toml')")
    end = number(until, "s", "until", low=0.0, open_low=True)
    if save not in ("all", "window"):
        raise InputError("save", f"is {save!r}; it must be 'all' or 'window'")
    samples = _enough_samples(scene, end) if samples is None else count(samples, "samples", low=2)
    count(turns, "turns")
    precision = float(jnp.finfo(end.dtype).eps)
    if not isinstance(tolerance, (int, float)) or not 10.0 * precision <= tolerance < 1.0:
        raise InputError(
            "tolerance",
            f"is {tolerance!r}; in {end.dtype} it must be at least {10.0 * precision:.1g} and less than 1"
            + ("; for smaller ones switch JAX to float64" if precision > 1e-10 else ""),
        )
    if spin_up is not None and start != "spin_up":
        raise InputError("spin_up", "goes with start='spin_up' only; leave it out or start with 'spin_up'")
    if isinstance(start, str) and start == "spin_up":
        if not isinstance(scene.drive, ConstantSpeed):
            raise InputError("start", f"is 'spin_up', but the drive is {scene.drive.kind!r} already; start at 'rest'")
        drive = SpinUp(scene.drive.speed, end / 2.0 if spin_up is None else spin_up)
        if not traced(end - drive.duration) and drive.duration > end:
            raise InputError("spin_up", f"is {float(drive.duration):g} s, longer than the run of {float(end):g} s; run longer")
        scene = eqx.tree_at(lambda s: s.drive, scene, drive)
    if isinstance(start, State) and mode is not None:
        raise InputError("mode", f"is {mode!r}, which goes with start='jam' only; leave it out where the start is a State")
    state = _whole(scene, start) if isinstance(start, State) else initial_state(scene, start, mode=mode)
    if max_steps is None:
        max_steps = _enough_steps(scene, end)
    if controller is None:
        steps = diffrax.PIDController(rtol=tolerance, atol=tolerance, pcoeff=0.2, icoeff=0.4)
        controller = _Tolerance(_on_kinks(scene, steps), _units(scene))
    else:
        controller = _on_kinks(scene, controller)
    run = _run(
        scene,
        end,
        state,
        diffrax.Tsit5() if solver is None else solver,
        controller,
        diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        samples if save == "all" else 0,
        turns,
        min(count(max_steps, "max_steps"), _MOST_STEPS),
        progress,
    )
    if throw and not traced(run.steps):
        _raise_if_failed(run, max_steps)
    return run


def _on_kinks(scene: Scene, controller: diffrax.AbstractStepSizeController) -> diffrax.AbstractStepSizeController:
    """The controller, made to step onto the times at which the drive's acceleration jumps; fixed steps are left alone."""
    kinks = scene.drive.kinks() if isinstance(scene.drive, IdealDrive) else ()
    if not kinks or not isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        return controller
    return diffrax.ClipStepSizeController(controller, jump_ts=jax.lax.stop_gradient(jnp.stack(kinks)))


def _whole(scene: Scene, state: State) -> State:
    """The state, if it has the scene's numbers of coordinates and loads."""
    nd, n = scene.machine.carrier().mass.shape[0], scene.loads.count
    if isinstance(scene.drive, Motor) != (state.rotor is not None):
        needed = (
            "(angle, speed), the motor's rotor is a state" if state.rotor is None else "None, the drive alone turns the rotor"
        )
        raise InputError("start.rotor", f"is {state.rotor!r}; under the drive {scene.drive.kind!r} it must be {needed}")
    for name, length in (("displacement", nd), ("velocity", nd), ("angle", n), ("rate", n)):
        shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(getattr(state, name))]
        if any(shape != (length,) for shape in shapes):
            raise InputError(f"start.{name}", f"has shape {shapes[0]}; this scene needs ({length},)")
    return state


def _enough_samples(scene: Scene, end: Array) -> int:
    """So many that a picture shows the vibration and no beat of it with the samples; a power of 2: few compilations."""
    wanted = _PER_TURN * end * scene.drive.speed / (2.0 * jnp.pi)
    return 2000 if traced(wanted) else 2 ** math.ceil(math.log2(min(max(float(wanted), 2000.0), 2.0**18)))


def _enough_steps(scene: Scene, end: Array) -> int:
    """500 steps for each turn of what moves fastest, rounded up to a power of 2 so that few numbers need few compilations."""
    fastest = jnp.maximum(scene.drive.speed, jnp.max(natural_frequencies(scene)))
    turns = end * fastest / (2.0 * jnp.pi)
    if traced(turns):
        return 2**20
    steps = 4096 + 500 * float(turns)
    if not steps <= _MOST_STEPS:
        raise InputError("until", f"is {float(end):g} s, {float(turns):.2g} turns of what moves fastest; run shorter stretches")
    return min(2 ** math.ceil(math.log2(steps)), _MOST_STEPS)


@kept
def _run(
    scene: Scene,
    end: Array,
    state: State,
    solver: diffrax.AbstractSolver,
    controller: diffrax.AbstractStepSizeController,
    adjoint: diffrax.AbstractAdjoint,
    samples: int,
    turns: int,
    max_steps: int,
    progress: bool,
) -> Run:
    # A start that does not exist (a jam mode absent in one lane of a batch) must not keep the others waiting.
    exists = _finite(state)
    state = jax.tree.map(lambda leaf: jnp.where(exists, leaf, 0.0), state)
    field = vector_field(scene)
    frequencies = natural_frequencies(jax.lax.stop_gradient(scene))
    slowest = jnp.min(jnp.where(frequencies > 0.0, frequencies, jax.lax.stop_gradient(scene.drive.speed)))
    longest = 2.0 * jnp.pi * _WINDOW / (_PER_TURN * jax.lax.stop_gradient(scene.drive.speed))
    window = jnp.minimum(jnp.minimum(2.0 * jnp.pi * turns / slowest, longest), end / 2.0)
    saves = [diffrax.SubSaveAt(ts=jnp.linspace(end - window, end, _WINDOW))]
    if samples:
        saves.append(diffrax.SubSaveAt(ts=jnp.linspace(0.0, end, samples)))
    fastest = jnp.maximum(jax.lax.stop_gradient(scene.drive.speed), jnp.max(frequencies))

    def term(t: Any, y: State, args: Dynamics) -> State:
        return args(t, y)

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(term),
        solver,
        t0=jnp.zeros_like(end),
        t1=end,
        dt0=0.05 / fastest,
        y0=state,
        args=field,
        saveat=diffrax.SaveAt(subs=saves),
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=max_steps,
        throw=False,
        progress_meter=ProgressBar() if progress else diffrax.NoProgressMeter(),
    )
    assert solution.ts is not None and solution.ys is not None
    times, states = solution.ts[0], solution.ys[0]
    measured = measure(scene, field, times, states)
    finished = solution.result == diffrax.RESULTS.successful
    status = RunStatus.where(
        finished, RunStatus.where(_finite(states), RunStatus.done, RunStatus.not_finite), RunStatus.max_steps_reached
    )
    status = RunStatus.where(exists, status, RunStatus.no_start)
    measured = jax.tree.map(lambda value: jnp.where(exists, value, jnp.nan), measured)
    return Run(
        status=status,
        trajectory=trajectory(scene, solution.ts[1], solution.ys[1]) if samples else None,
        window=trajectory(scene, times, states),
        **{name: getattr(measured, name) for name in type(measured).__dataclass_fields__},
        steps=solution.stats["num_steps"],
        rejected=solution.stats["num_rejected_steps"],
        scene=scene,
    )


def _finite(state: State) -> Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(state)]))


def _raise_if_failed(run: Run, max_steps: int) -> None:
    if bool(run.status == RunStatus.done):
        return
    names = ("max_steps_reached", "not_finite", "no_start")
    name = next(name for name in names if bool(run.status == getattr(RunStatus, name)))
    reached = np.asarray(run.window.time)
    reached = reached[np.isfinite(reached)]
    where = f" at t = {reached[-1]:.6g} s" if name == "not_finite" and reached.size else ""
    hint = f"{run.message}{where}"
    if name == "max_steps_reached":
        hint += f" ({max_steps} steps); give a larger max_steps, a larger tolerance or a shorter run"
    raise ComputationError(name, hint)
