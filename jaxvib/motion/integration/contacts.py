"""Derivatives of steps in which a contact with a damper begins.

The force c p' of a damper jumps when a contact begins, at the time at which the penetration p becomes positive. A variation dp
of the penetration at this time shifts the time by -dp / p'. It changes the momentum of the machine by -c dp grad p
(grad p: the gradient of p with respect to the positions). The derivatives of a step of a method of integration do not contain
this change, however short the step is. It is added here.

The change is the difference between the forces that a velocity w with (grad p) w = dp causes within the contact and
outside it. It does not depend on p', and several contacts may begin in one step.

Source: the saltation matrix of a jump of the equations, as in R. I. Leine and H. Nijmeijer, Dynamics and Bifurcations of
Non-Smooth Mechanical Systems (2004), chapter 7.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from jaxvib.equations.model import assemble
from jaxvib.equations.state import ExciterState, State
from jaxvib.machine.effects.base import Effect, terms_of
from jaxvib.machine.effects.terms import LoadInteraction, SupportForce
from jaxvib.machine.loads import Loads
from jaxvib.machine.scene import Scene
from jaxvib.motion.integration.system import IntegratorState, PackedSystem
from jaxvib.numerics.linalg import times
from jaxvib.ode.batching import flat_tangents
from jaxvib.ode.types import Args, BoolScalarLike, RealScalarLike, StepResult, Tangents, Terms

_MARGIN = 0.05
"""Distance from the beginning of a contact at which the forces outside it (before) and within it (after) are computed, as a
share of the part of the step before or after the beginning."""


class Contacts(eqx.Module):
    """Contacts of a scene whose forces jump when they begin.

    **Attributes**: `effects` of the scene and `rows` (k, nd) of the place of each of their supports; `loads` of each exciter
    with the effects on them.
    """

    effects: tuple[Effect, ...]
    rows: tuple[Array, ...]
    loads: tuple[tuple[Loads | None, tuple[Effect, ...]], ...]

    @staticmethod
    def of(scene: Scene) -> Contacts | None:
        """Return the contacts of a scene, None if it has none."""
        if all(term.penetration is None for term in terms_of(scene.all_effects, SupportForce, LoadInteraction)):
            return None
        model, loads = assemble(scene), []
        for exciter, mount in zip(scene.exciters, model.mounts, strict=True):
            effects, own = (*scene.effects, *exciter.effects), exciter.loads
            loads.append((own, () if own is None else tuple(effect.prepare(own, mount) for effect in effects)))
        return Contacts(scene.all_effects, model.supports, tuple(loads))

    def penetrations(self, state: State) -> Array:
        """Return the penetrations (n,), m, negative without contact."""
        found = [
            term.penetration(times(rows, state.displacement))[0][None]
            for term, rows in zip(terms_of(self.effects, SupportForce), self.rows, strict=True)
            if term.penetration is not None
        ]
        for (loads, effects), exciter in zip(self.loads, state.exciters, strict=True):
            for term in terms_of(effects, LoadInteraction):
                found += [] if loads is None or term.penetration is None else [term.penetration(loads, exciter.angle)]
        return jnp.concatenate(found)


class ContactSolver(diffrax.AbstractWrappedSolver):
    """Method of integration whose derivatives contain the shifts of the beginnings of contacts.

    **Arguments**: `solver`: a method of diffrax; `system`: the equations without their arguments.
    """

    solver: diffrax.AbstractSolver
    system: PackedSystem

    def __init__(self, solver: diffrax.AbstractSolver, system: PackedSystem):
        self.solver = solver  # pyright: ignore[reportIncompatibleVariableOverride]
        self.system = eqx.tree_at(lambda s: s.args, system, None)  # a method must not contain traced arrays

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the method, such as its tableau."""
        if name == "solver":
            raise AttributeError(name)
        return getattr(self.solver, name)

    @property
    def term_structure(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The structure of the equations that the method accepts."""
        return self.solver.term_structure

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Interpolation of the method."""
        return self.solver.interpolation_cls

    def order(self, terms: Terms) -> int | None:
        """Return the order of the method."""
        return self.solver.order(terms)

    def error_order(self, terms: Terms) -> RealScalarLike | None:
        """Return the order of the error of a step."""
        return self.solver.error_order(terms)

    def init(self, terms: Terms, t0: RealScalarLike, t1: RealScalarLike, y0: IntegratorState, args: Args) -> Any:
        """Return the initial state of the method."""
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms: Terms, t0: RealScalarLike, y0: IntegratorState, args: Args) -> IntegratorState:
        """Return the rates, for the choice of the first step."""
        return self.solver.func(terms, t0, y0, args)

    def step(
        self,
        terms: Terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: IntegratorState,
        args: Args,
        solver_state: Any,
        made_jump: BoolScalarLike,
    ) -> StepResult:
        """Compute a step of the method.

        It does not reuse rates from the end of the previous step, because their derivatives lack the shifts.
        """
        end, *rest = self.solver.step(terms, t0, t1, y0, args, solver_state, True)
        span = jax.lax.stop_gradient((t0, t1))
        return _with_shifts(end, y0, args, span=span, system=self.system), *rest  # pyright: ignore[reportReturnType]


@eqx.filter_custom_jvp
def _with_shifts(
    end: IntegratorState,
    start: IntegratorState,
    args: Args,
    *,
    span: tuple[RealScalarLike, RealScalarLike],
    system: PackedSystem,
) -> IntegratorState:
    """Return the state at the `end` of a step from `start`, with derivatives that contain the shifts of contacts."""
    return end


@_with_shifts.def_jvp
def _with_shifts_jvp(
    primals: tuple[IntegratorState, IntegratorState, Args],
    tangents: tuple[Tangents, Tangents, Tangents],
    *,
    span: tuple[RealScalarLike, RealScalarLike],
    system: PackedSystem,
) -> tuple[IntegratorState, IntegratorState]:
    (end, start, args), (dend, dstart, dargs) = primals, tangents

    def penetrations(y: IntegratorState, args: Args) -> Array:
        return args[1].penetrations(system.state(y))

    before, dbefore = eqx.filter_jvp(penetrations, (start, args), (dstart, dargs))
    after, dafter = eqx.filter_jvp(penetrations, (end, args), (dend, dargs))
    begins = (before <= 0.0) & (after > 0.0)
    share = jnp.where(begins, before / jnp.where(begins, before - after, 1.0), 0.0)
    shift = jnp.where(begins, (1.0 - share) * dbefore + share * dafter, 0.0)
    step = _Step(start, system.unwrap(end, start), *span, args, system)
    zero = jax.tree.map(jnp.zeros_like, end)
    changes = jax.lax.cond(jnp.any(begins), lambda: step.change(begins, share, shift), lambda: zero)
    moves = [0.0 if move is None else move for move in flat_tangents(dend, end)]
    return end, jax.tree.map(jnp.add, jax.tree.unflatten(jax.tree.structure(end), moves), changes)


class _Step(NamedTuple):
    """Step from `t0` to `t1` in which contacts begin, with the states `start` and `end` of the integrator, which have a common
    number of turns, and the `args` of the equations of the `system`."""

    start: IntegratorState
    end: IntegratorState
    t0: RealScalarLike
    t1: RealScalarLike
    args: Args
    system: PackedSystem

    def at(self, share: Array | float) -> IntegratorState:
        """Return the state at a share of the step, by linear interpolation."""
        return jax.tree.map(lambda start, end: start + share * (end - start), self.start, self.end)

    def rates_along(self, share: Array | float, direction: IntegratorState) -> IntegratorState:
        """Return the derivative of the rates at a share of the step along a direction."""
        t = self.t0 + share * (self.t1 - self.t0)
        return jax.jvp(lambda y: self.system.term.vf(t, y, self.args), (self.at(share),), (direction,))[1]

    def change(self, begins: Array, share: Array, shift: Array) -> IntegratorState:
        """Return the change of the derivative of the end of the step by contacts (n,) that begin (`begins`) at a `share` of the
        step; `shift`: the variation dp of their penetration there, 0 for other contacts."""
        first, last = jnp.min(jnp.where(begins, share, 1.0)), jnp.max(share)
        within = last + _MARGIN * (1.0 - last)
        velocity = self.velocity(within, begins, shift)
        outer, inner = (self.rates_along(at, velocity) for at in ((1.0 - _MARGIN) * first, within))
        jump = jax.tree.map(jnp.subtract, inner, outer)
        # The rest of the step changes the jump; this change is included to the first order of the length of the rest.
        rest = (1.0 - 0.5 * (first + last)) * (self.t1 - self.t0)
        return jax.tree.map(lambda jump, rate: jump + rest * rate, jump, self.rates_along(1.0, jump))

    def velocity(self, share: Array, begins: Array, shift: Array) -> IntegratorState:
        """Return the smallest velocity w with (grad p) w = `shift` (n,), for the contacts that begin."""
        state = self.system.state(self.at(share))
        positions, unravel = ravel_pytree((state.displacement, [exciter.angle for exciter in state.exciters]))

        def penetrations(positions: Array) -> Array:
            displacement, angles = unravel(positions)
            exciters = [ExciterState(angle, each.rate) for angle, each in zip(angles, state.exciters, strict=True)]
            return self.args[1].penetrations(State(displacement, state.velocity, exciters=tuple(exciters)))

        gradients = jnp.where(begins[:, None], jax.jacrev(penetrations)(positions), 0.0)
        gram = gradients @ gradients.T
        # Equal contacts begin together and have equal gradients; `size` on the diagonal gives them the mean of their shifts.
        size = jnp.where(begins, jnp.sqrt(jnp.finfo(gram.dtype).eps) * jnp.max(jnp.diagonal(gram)), 1.0)
        displacement, angles = unravel(gradients.T @ jnp.linalg.solve(gram + jnp.diag(size), shift))
        zero = jax.tree.map(jnp.zeros_like, state)
        exciters = [ExciterState(own.angle, rate, own.rotor, own.spin) for own, rate in zip(zero.exciters, angles, strict=True)]
        return self.system.pack(State(zero.displacement, displacement, exciters=tuple(exciters)))
