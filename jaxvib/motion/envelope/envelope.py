"""Time integration of the averaged equations, with steps that span many turns."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Literal, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from jaxvib.boundary import validated
from jaxvib.equations.averaged import (
    Amplitudes,
    Averaged,
    amplitudes_of,
    averaged_growth,
    averaged_model,
    require_rotating_masses,
    rotating_angles,
)
from jaxvib.equations.linear import estimated_frequencies, linear_model
from jaxvib.equations.model import Model
from jaxvib.equations.state import State
from jaxvib.equations.torque_balance import can_start
from jaxvib.errors import InputError, quoted
from jaxvib.machine.effects.base import terms_of, total_gravity
from jaxvib.machine.effects.terms import LoadPotential
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.machine.validation import first_moment, validate_scene
from jaxvib.motion.analysis.measure import MIN_CHANGE_SCALE, Measured, turning_directions
from jaxvib.motion.analysis.scaled_error import natural_units
from jaxvib.motion.analysis.separation import MIN_SEPARATION_GROWTH, nearly_coincident_pairs
from jaxvib.motion.envelope.result import Envelope, Envelopes, EnvelopeStatus
from jaxvib.motion.integrate import is_finite, with_jump_times
from jaxvib.motion.integration.system import with_first_derivatives
from jaxvib.motion.plan import Tolerance, require_error_estimate, require_step_choice
from jaxvib.motion.run import SETTLED_DRIFT
from jaxvib.motion.start import Start, initial_state, must_compile_jams, start_state, with_spin_up_drive
from jaxvib.numerics.linalg import magnitude
from jaxvib.ode.control import Decision, WrappedController, step_success
from jaxvib.ode.replay import solve
from jaxvib.ode.rodas4 import Linearization, Rodas4
from jaxvib.ode.scalarize import MAX_SCALARS, scalarized_program, scalars_of
from jaxvib.ode.types import Args, IntScalarLike, RealScalarLike, Terms
from jaxvib.results.status import member, status_name
from jaxvib.runtime.compat import jaxpr_as_fun
from jaxvib.runtime.parallel import in_background
from jaxvib.runtime.programs import cached
from jaxvib.steady.balance.monodromy import at_constant_speed
from jaxvib.steady.outcome import outcome
from jaxvib.units import Number, count, number, validate_tolerance
from jaxvib.units.known import when_known

_WINDOW_SAMPLES = 512
"""Number of samples in the measuring window at the end: 25 in each period of the lowest resonance."""

_MAX_WINDOW_TURNS = 256
"""Largest length of the measuring window, in turns of the rotor, as in `simulate`."""


class _BlockSteps(WrappedController):
    """Step size controller with errors relative to the largest entry of a block of variables, such as all parts of Y.

    The real or imaginary part of an amplitude is often 0, so that an error relative to this part alone would have no meaning.
    `blocks`: the number of variables in each block. In the last block, the phases, only the absolute error counts.
    """

    controller: diffrax.AbstractStepSizeController
    blocks: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, controller: diffrax.AbstractStepSizeController, blocks: tuple[int, ...]):
        self.controller, self.blocks = controller, blocks

    def wrap(self, direction: IntScalarLike) -> _BlockSteps:
        return _BlockSteps(self.controller.wrap(direction), self.blocks)

    def init(
        self,
        terms: Terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Array,
        dt0: RealScalarLike | None,
        args: Args,
        func: Callable[[Terms, RealScalarLike, Array, Args], Array],
        error_order: RealScalarLike | None,
    ) -> tuple[RealScalarLike, PyTree[Array]]:
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(
        self,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Array,
        y1_candidate: Array,
        args: Args,
        y_error: Array | None,
        error_order: RealScalarLike,
        controller_state: PyTree[Array],
    ) -> Decision:
        def sizes(y: Array) -> Array:
            parts = jnp.split(jnp.abs(y), np.cumsum(self.blocks)[:-1])
            # An angle grows without bound; only the absolute tolerance applies to it.
            return jnp.concatenate([*(jnp.broadcast_to(jnp.max(x), x.shape) for x in parts[:-1]), jnp.zeros_like(parts[-1])])

        # A NaN error would make the length of the next step NaN.
        error = None if y_error is None else jnp.where(jnp.isnan(y_error), jnp.inf, y_error)
        keep, start, end, jumped, state, result = self.controller.adapt_step_size(
            t0, t1, sizes(y0), sizes(y1_candidate), args, error, error_order, controller_state
        )
        moved = step_success(keep, start, t1, end)
        return keep, start, end, jumped, state, diffrax.RESULTS.where(result == diffrax.RESULTS.successful, moved, result)


class _Units(eqx.Module):
    """Units of the variables: the unbalance radius S/M, S/M times the rotor speed, the rotor speed, and 1 rad."""

    length: Array
    speed: Array

    def pack(self, state: Amplitudes) -> Array:
        y, v = state.displacement / self.length, state.velocity / (self.length * self.speed)
        return jnp.concatenate([y.real, y.imag, v.real, v.imag, state.rate / self.speed, state.phase])

    def unpack(self, flat: Array, nd: int) -> Amplitudes:
        loads = (flat.shape[-1] - 4 * nd) // 2
        y0, y1, v0, v1, rate, phase = jnp.split(flat, np.cumsum([nd, nd, nd, nd, loads]), axis=-1)
        speed = self.length * self.speed
        return Amplitudes((y0 + 1j * y1) * self.length, (v0 + 1j * v1) * speed, rate * self.speed, phase)


@validated
def envelope(
    scene: Scene,
    until: Number,
    *,
    start: Start | State = "rest",
    mode: int | None = None,
    separation: Number | None = None,
    spin_up: Number | None = None,
    save: Literal["all", "window"] = "all",
    samples: int = 256,
    window_periods: int = 20,
    solver: diffrax.AbstractSolver | None = None,
    stepsize_controller: Tolerance | diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int = 2**16,
    throw: bool = True,
) -> Envelope:
    """Integrate the averaged equations of a scene from 0 to `until`: amplitudes and load speeds in place of vibrations.

    Each step spans many turns, even in a run-up in which loads jam at a resonance or pass through it. Several exciters may
    synchronize, or turn at different speeds; in the second case the steps resolve the beats between them. Each mass that turns,
    a load or the unbalance of a rotor, counts as a load here. The result is the limit of light loads:

    - its relative error is proportional to the share of the loads in the mass of the machine, multiplied by the dynamic
      magnification, and about as large as the `ripple` of the result; typical: 1e-3 to 0.1
    - its equilibria are the jams of `jam_modes` and the regimes of `synchronous_regimes`
    - near the boundary between jamming and passing, small differences decide the outcome: use `simulate` there

    The equations are given in `averaged_field`.

    **Arguments**

    - `scene`, without effects other than gravity
    - `until`, s; typical: 5 to 600
    - `start`, `mode`, `separation`, `spin_up`, `window_periods`, `adjoint`, `throw`: as in `simulate`. Each load has its own
      phase: loads with slightly different initial angles separate if the averaged motion at one angle is unstable
    - `save`: "all" keeps `samples` (default 256) evenly spaced states; "window" keeps only the measuring window
    - `stepsize_controller`: `Tolerance`, the allowed error of a step, both relative to the largest amplitude and absolute in
      natural units (rotor speed for rates, 1 rad for phases); typical: 1e-3 to 1e-6, default 1e-4. A step size controller of
      diffrax is also possible
    - `solver`: a solver of diffrax for stiff systems; default: `Rodas4`
    - `max_steps`: the run fails after this number of steps; typical: 2^16 (the default)

    Gravity has no mean torque on a load that makes full turns. If a load is too slow to pass the top of its track, or its drag
    or motor cannot lift it from the bottom, the status is `not_turning`. Effects other than gravity, and an exciter
    that has, in addition to loads, an unbalance or a motor, raise `InputError`.

    **Returns** `Envelope`. Forward and reverse derivatives, `jit` and `vmap` are supported.

    **Raises** `InputError` for values that are not allowed, `ComputationError` for a run that does not finish or is
    `not_turning`.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> run = jv.envelope(scene, 60.0, start="spin_up")
    >>> bool(run.settled), round(float(run.omega), 1), int(run.steps) < 200      # jammed below the resonance at 28.1 rad/s
    (True, 27.4, True)

    Source: see `averaged_field`.
    """
    scene = validate_scene(scene)
    require_rotating_masses(scene)
    end = number(until, "s", "until", low=0.0, open_low=True)
    if save not in ("all", "window"):
        raise InputError("save", f"is {quoted(save)}; it must be 'all' or 'window'")
    count(samples, "samples", low=2, each=1e3)
    count(window_periods, "window_periods")
    chosen = Tolerance(1e-4) if stepsize_controller is None else stepsize_controller
    require_step_choice(chosen, Tolerance, diffrax.AbstractStepSizeController)
    require_error_estimate(solver, chosen)
    if isinstance(chosen, Tolerance):
        chosen = np.asarray(validate_tolerance(chosen.tolerance, "tolerance", end.dtype, 10.0), end.dtype)
    given_scene, scene = scene, with_spin_up_drive(scene, end, start, spin_up)
    choices = solver, chosen, adjoint, samples if save == "all" else 0, window_periods, count(max_steps, "max_steps")
    if isinstance(start, str) and start == "jam" and must_compile_jams(scene, mode):
        rest = initial_state(scene)
        in_background(partial(_run.prepare, scene, end, rest, *choices), partial(_prepare_growth, scene, rest))
    # The state of rest exists for every scene; therefore it is computed in the compiled run, which takes less time.
    is_rest = isinstance(start, str) and start in ("rest", "spin_up") and mode is None and separation is None
    state = None if is_rest else start_state(scene, start, mode, separation, throw=throw)
    run = _run(scene, end, state, *choices)
    run = outcome(
        run, given_scene, end, throw=throw, failures=(*_HINTS, "not_finite", "no_start"), hint=partial(_hint, max_steps)
    )
    judged = when_known(lambda *_: _with_separation_status(run), run.steps, run.status, run.drift)
    return run if judged is None else judged


def _with_separation_status(run: Envelope) -> Envelope:
    """Return the run with the status `would_separate` (loads of one exciter at nearly one angle) or `unstable` (exciters that
    turn at one speed) if it has settled in a motion that is unstable."""
    if not (float(run.drift) < SETTLED_DRIFT and status_name(run.status) == "done"):
        return run
    phase, time, rate = (np.asarray(x) for x in (run.window.phase, run.window.time, run.window.load_speed))
    plain = run.scene.is_plain
    has_one_speed = phase.shape[1] > 1 and bool(np.max(np.ptp(phase, axis=0)) < SETTLED_DRIFT and np.all(rate != 0.0))
    if not (nearly_coincident_pairs(run.scene, 0, phase) if plain else has_one_speed):
        return run
    last = (np.asarray(x[-1]) for x in map(np.asarray, (run.window.omega, run.window.phase, run.window.displacement)))
    growth = float(_growth_at_end(at_constant_speed(run.scene), *last))
    if not growth * float(time[-1] - time[0]) > MIN_SEPARATION_GROWTH:
        return run
    return dataclasses.replace(run, status=member(EnvelopeStatus, "would_separate" if plain else "unstable"))


def _prepare_growth(scene: Scene, state: State) -> None:
    if scene.loads.count > 1:
        speed, phase, displacement = np.asarray(scene.drive.speed), np.asarray(state.azimuth), np.asarray(state.displacement)
        _growth_at_end.prepare(at_constant_speed(scene), speed, phase, displacement + 0j)


@cached
def _growth_at_end(scene: Scene, omega: np.ndarray, phase: np.ndarray, displacement: np.ndarray) -> Array:
    model = averaged_model(linear_model(scene))
    return averaged_growth(model, jnp.asarray(omega), jnp.asarray(phase), jnp.asarray(displacement), neutral=model.free_shifts)


@cached
def _run(
    scene: Scene,
    end: Array,
    state: State | None,
    solver: diffrax.AbstractSolver | None,
    control: diffrax.AbstractStepSizeController | Array | np.ndarray,
    adjoint: diffrax.AbstractAdjoint | None,
    samples: int,
    window_periods: int,
    max_steps: int,
) -> Envelope:
    scene, (end, state) = with_first_derivatives(scene, (end, state))
    begin = _at_rest(scene) if state is None else amplitudes_of(scene, state)
    # An initial state that does not exist (a jam mode that is absent in one run of a batch) must not slow down the other runs.
    exists = is_finite(begin)
    begin = jax.tree.map(lambda leaf: jnp.where(exists, leaf, 0.0), begin)
    model, nd = linear_model(scene), begin.displacement.shape[0]
    field, frozen = averaged_model(model), jax.lax.stop_gradient(scene)
    units = _units(jax.lax.stop_gradient(model))
    speed, frequencies = frozen.top_speed, estimated_frequencies(frozen)
    saves = _saves(speed, frequencies, end, samples, window_periods)

    is_controller = isinstance(control, diffrax.AbstractStepSizeController)
    controller = control if is_controller else diffrax.PIDController(rtol=control, atol=control)

    rates, args, method = _equations(units.pack(begin), (field, units), nd, solver)
    solution = solve(
        diffrax.ODETerm(rates),
        method,
        end=end,
        first_step=0.05 / jnp.maximum(speed, jnp.max(frequencies)),
        y0=units.pack(begin),
        args=args,
        saveat=diffrax.SaveAt(subs=saves),
        controller=with_jump_times(scene, _BlockSteps(controller, (2 * nd, 2 * nd, *begin.rate.shape, *begin.phase.shape))),
        adjoint=adjoint,
        max_steps=max_steps,
    )
    assert solution.ts is not None and solution.ys is not None

    def envelopes(times: Array, flat: Array) -> Envelopes:
        return jax.vmap(lambda t, y: _at(model, field, t, units.unpack(y, nd)))(times, flat)

    window = envelopes(solution.ts[0], solution.ys[0])
    finite = is_finite(solution.ys[0])
    turning = _can_turn_fully(scene, field, begin, window)
    status = _status(solution.result, exists, finite, turning)
    whole = envelopes(solution.ts[1], solution.ys[1]) if samples else None
    values = (_measure(model, window), jnp.max(window.ripple, axis=0), whole, window)
    measured, ripple, whole, window = jax.tree.map(lambda value: jnp.where(exists, value, jnp.nan), values)
    return Envelope(
        **{name: getattr(measured, name) for name in type(measured).__dataclass_fields__},
        ripple=ripple,
        status=status,
        trajectory=whole,
        window=window,
        steps=solution.stats["num_steps"],
        rejected=solution.stats["num_rejected_steps"],
        scene=scene,
    )


def _saves(speed: Array, frequencies: Array, end: Array, samples: int, window_periods: int) -> list[diffrax.SubSaveAt]:
    """Return the stored times: those of the measuring window at the end, and those of the whole run if `samples` is not 0."""
    slowest = jnp.min(jnp.where(frequencies > 0.0, frequencies, speed))
    window = 2.0 * jnp.pi * jnp.minimum(window_periods / slowest, _MAX_WINDOW_TURNS / speed)
    saves = [diffrax.SubSaveAt(ts=jnp.linspace(end - jnp.minimum(window, end / 2.0), end, _WINDOW_SAMPLES))]
    if samples:
        saves.append(diffrax.SubSaveAt(ts=jnp.linspace(0.0, end, samples)))
    return saves


def _status(result: diffrax.RESULTS, exists: Array, finite: Array, turning: Array) -> EnvelopeStatus:
    failed = EnvelopeStatus.where(result == diffrax.RESULTS.dt_min_reached, EnvelopeStatus.not_finite, EnvelopeStatus.no_step)
    failed = EnvelopeStatus.where(result == diffrax.RESULTS.max_steps_reached, EnvelopeStatus.max_steps_reached, failed)
    status = EnvelopeStatus.where(turning, EnvelopeStatus.done, EnvelopeStatus.not_turning)
    status = EnvelopeStatus.where(finite, status, EnvelopeStatus.not_finite)
    status = EnvelopeStatus.where(result == diffrax.RESULTS.successful, status, failed)
    return EnvelopeStatus.where(exists, status, EnvelopeStatus.no_start)


def _at_rest(scene: Scene) -> Amplitudes:
    rest = initial_state(scene)
    angle, rate = rotating_angles(scene, rest)
    return Amplitudes(rest.displacement + 0.0j, rest.velocity + 0.0j, rate, angle - jnp.mean(angle))


def _equations(
    y: Array, args: tuple[Averaged, _Units], nd: int, solver: diffrax.AbstractSolver | None
) -> tuple[Callable[..., Array], Args, diffrax.AbstractSolver]:
    """Return the averaged equations as a function of the integrator's vector, their arguments, and the method.

    For small systems the equations are computed on scalars. For several exciters the default method eliminates the unknowns of
    one exciter after the other in each step, see `Averaged.shifted_inverse`; for one exciter a dense matrix on scalars is
    faster.
    """

    def on_arrays(t: Array, y: Array, args: tuple[Averaged, _Units]) -> Array:
        field, units = args
        return units.pack(field(t, units.unpack(y, nd)))

    def linearize(terms: Terms, t: RealScalarLike, y: Array, args: tuple[Averaged, _Units]) -> Linearization:
        (field, units), time = args, jnp.asarray(t, y.dtype)

        def shifted_inverse(shift: Array) -> Callable[[Array], Array]:
            solve = field.shifted_inverse(time, units.unpack(y, nd), shift)
            return lambda right: units.pack(solve(units.unpack(right, nd)))

        return shifted_inverse, jax.jvp(lambda t: terms.vf(t, y, args), (time,), (jnp.ones_like(time),))[1]

    if solver is None and len(args[0].counts) > 1:
        return on_arrays, args, Rodas4(linearize)
    solver = Rodas4() if solver is None else solver
    program = scalarized_program(on_arrays, jnp.zeros((), y.dtype), y, args) if y.size <= MAX_SCALARS else None
    if program is None:
        return on_arrays, args, solver

    def on_scalars(t: Array, y: Array, args: list[Array]) -> Array:
        return jnp.stack(jaxpr_as_fun(program)(jnp.asarray(t, y.dtype), *(y[i] for i in range(y.shape[0])), *args))

    return on_scalars, scalars_of(args), solver


def _at(model: Model, field: Averaged, t: Array, state: Amplitudes) -> Envelopes:
    return Envelopes(
        time=t,
        displacement=state.displacement,
        velocity=state.velocity,
        amplitude=magnitude(state.displacement),
        foundation_force=model.known_force(magnitude(model.carrier.foundation_force(state.displacement, state.velocity))),
        omega=jnp.mean(state.rate),
        load_speed=_anticlockwise(model.scene, state.rate),
        phase=state.phase,
        rotor_speeds=tuple(
            n if exciter.direction == 1 else -n
            for exciter, n in zip(model.scene.exciters, field.by_exciter(field.rotor_speeds(t, state.rate)), strict=True)
        ),
        ripple=field.ripple(state),
    )


def _anticlockwise(scene: Scene, rates: Array) -> Array:
    """Convert speeds (..., count) that are positive in the direction of each exciter to speeds that are positive anticlockwise,
    or the reverse."""
    directions = turning_directions(scene)
    return rates if np.all(directions == 1) else jnp.asarray(directions) * rates


def _measure(model: Model, window: Envelopes) -> Measured:
    """Return the values of `Measured` for the window: means of speeds, and the maximum of each amplitude."""
    half = window.time.shape[0] // 2
    amplitude, force = jnp.max(window.amplitude, axis=0), jnp.max(window.foundation_force, axis=0)
    speeds, late = jnp.mean(window.load_speed, axis=0), jnp.mean(window.load_speed[half:], axis=0)
    change = jnp.abs(jnp.max(window.amplitude[half:], axis=0) - jnp.max(window.amplitude[:half], axis=0))
    unit, omega = natural_units(model.scene), jnp.mean(_anticlockwise(model.scene, speeds))
    amplitude_change, largest = (jnp.max(model.carrier.as_lengths(x)) for x in (change, amplitude))
    drift = amplitude_change / jnp.maximum(largest, MIN_CHANGE_SCALE * unit.displacement)
    force_change = jnp.abs(jnp.max(window.foundation_force[half:], axis=0) - jnp.max(window.foundation_force[:half], axis=0))
    force_drift = jnp.max(force_change) / jnp.maximum(jnp.max(force), MIN_CHANGE_SCALE * model.natural_force(unit))
    force_drift = jnp.nan_to_num(force_drift)  # NaN if the foundation force is unknown
    speed_drift = jnp.max(jnp.abs(late - speeds)) / jnp.maximum(jnp.abs(omega), jnp.finfo(omega.dtype).tiny)
    return Measured(
        omega=omega,
        load_speed=speeds,
        amplitude=amplitude,
        foundation_force=force[0] if force.shape[0] == 1 else jnp.sqrt(jnp.sum(force**2)),
        drift=jnp.maximum(jnp.maximum(drift, force_drift), speed_drift),
    )


def _can_turn_fully(scene: Scene, field: Averaged, begin: Amplitudes, window: Envelopes) -> Array:
    """Return True if every rotating mass can make full turns in the potential of gravity.

    At the end of the run a mass must have the energy to pass the top from the mean height, where it has its averaged speed w:
    I w^2/2 > (max V - min V)/2. If it does not have this energy at the start, something must be able to lift it: for a load the
    drag, D n > max |dV/dphi|; for an unbalance the motor, see `can_start`.
    """
    starts, gravity = can_start(scene), total_gravity(scene.all_effects).get(1)
    each, begins = [], np.cumsum([0, *(max(count, 1) for count in field.counts)])
    for k, exciter in enumerate(scene.exciters):
        here = slice(None) if len(scene.exciters) == 1 else slice(begins[k], begins[k + 1])
        if exciter.loads is not None:
            potential = _potential_of_loads(scene, exciter)
            if potential is None:
                continue
            height, slope = potential
            lifted = field.drag[here] * jnp.max(window.rotor_speeds[k] * exciter.direction) > slope
        elif gravity is None or exciter.drive.ideal or (moment := first_moment(exciter)) is None:
            continue
        else:
            height, lifted = 2.0 * moment * jnp.abs(gravity)[None], starts[k]
        passes = height / field.inertia[here]
        ends = jnp.min(window.load_speed[:, here] ** 2, axis=0) > passes
        each.append(jnp.all(ends & (lifted | (begin.rate[here] ** 2 > passes))))
    return jnp.all(jnp.stack(each)) if each else jnp.asarray(True)


def _potential_of_loads(scene: Scene, exciter: Exciter) -> tuple[Array, Array] | None:
    """Return max V - min V, J, and max |dV/dphi|, N m, of each load of an exciter over a turn, (count,); None without V."""
    loads, potentials = exciter.loads, terms_of((*scene.effects, *exciter.effects), LoadPotential)
    if loads is None or not potentials:
        return None

    def potential(u: Array) -> Array:
        found = [term.energy(loads, (u,)) for term in potentials]
        return sum(found[1:], found[0])

    angles = jnp.linspace(0.0, 2.0 * jnp.pi, 64, endpoint=False)
    around = [jnp.broadcast_to(angle, (loads.count,)) for angle in angles]
    height = jnp.stack([potential(u) for u in around])
    slope = jax.vmap(jax.grad(lambda u: jnp.sum(potential(u))))
    torque = slope(jnp.stack(around))
    return jnp.max(height, axis=0) - jnp.min(height, axis=0), jnp.max(jnp.abs(torque), axis=0)


def _units(model: Model) -> _Units:
    scene, mass = model.scene, jnp.mean(jnp.diagonal(model.carrier.mass))
    if scene.is_plain:
        return _Units(cast(CircularLoads, scene.loads).unbalance() / mass, scene.drive.speed)
    return _Units(cast(Array, natural_units(scene).displacement), scene.top_speed)


_HINTS = {
    "max_steps_reached": " ({} steps); give a larger max_steps, a larger tolerance or a shorter run",
    "no_step": "; give a smaller tolerance, or leave the solver out",
    "not_turning": "; integrate the full equations with simulate",
}


def _hint(max_steps: int, name: str) -> str:
    return _HINTS.get(name, "").format(max_steps)
