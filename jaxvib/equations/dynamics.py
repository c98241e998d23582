"""Equations of motion of a scene: carrier and exciters, solved for their accelerations."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.equations.exciter import (
    Eliminated,
    ExciterDynamics,
    RotorDynamics,
    depends_on_acceleration,
    signed,
    without_coupling,
)
from jaxvib.equations.model import Group, Model, assemble, grouped, stack_members, ungroup
from jaxvib.equations.sliding import ContactSolution
from jaxvib.equations.state import State
from jaxvib.errors import InputError
from jaxvib.machine.carrier import Mount
from jaxvib.machine.drives.drive import Directed
from jaxvib.machine.effects.base import Effect, has_term, terms_of
from jaxvib.machine.effects.terms import RotorImbalance, SupportForce
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.fence import fence, hidden_one
from jaxvib.numerics.linalg import small_inverse, small_solve, solve_definite, times

T = TypeVar("T")


class _Support(eqx.Module):
    """Place of a `SupportForce` with the displacements `rows` (k, nd) q; `input_matrix` (nd, k): accelerations of the carrier
    per force at this place, 1/kg."""

    rows: Array
    input_matrix: Array


class Dynamics(eqx.Module):
    """Equations of a scene for time integration. Everything that does not change with time is computed once.

    The accelerations of the carrier are those without exciters plus those due to the forces of the exciters. P contains, one
    below the other, nP rows: those of all mounts on which loads or an unbalanced rotor act, and those of the rotations of the
    housings on which drives act.

    - `stiffness_per_mass` M^-1 K, `damping_per_mass` M^-1 C, `gyroscopic_per_mass` M^-1 G (or None), (nd, nd)
    - `input_matrix` M^-1 P^T (nd, nP): acceleration per force on the rows
    - `accelerance` P M^-1 P^T (nP, nP), and `rows` P (nP, nd)
    - `mass` M (nd, nd) if P has more rows than there are coordinates, otherwise None
    - `groups` of the exciters, see `Group`; `supports`, a place for each `SupportForce`
    - `has_fences`: True to compute the arrays of each group once, see `fence`. Without fences XLA repeats the sines of a group
      for each use; time integration has fences of its own
    """

    stiffness_per_mass: Array
    damping_per_mass: Array
    gyroscopic_per_mass: Array | None
    input_matrix: Array
    accelerance: Array
    rows: Array
    mass: Array | None
    groups: tuple[Group[RotorDynamics], ...]
    supports: tuple[_Support, ...]
    has_fences: bool = eqx.field(static=True, default=False)

    @property
    def exciters(self) -> list[RotorDynamics]:
        """The exciters of the scene, in order."""
        return ungroup(self.groups, (group.part for group in self.groups))

    def __call__(self, t: Array, state: State, args: object = None) -> State:  # diffrax passes `args`
        """Return the time derivative of `state` at time `t`; `args` is not used.

        Each exciter is eliminated first, see `RotorDynamics.eliminate`. With the added mass W and the reaction g of all
        exciters, the accelerations a of P's rows then follow from (1 + accelerance W) a = a_free - accelerance g. This is one
        equation per row, for any number of platforms and loads. If there are more rows than coordinates, q'' follows from
        (M + P^T W P) q'' = M q''_free - P^T g instead.
        """
        count = sum(len(group.members) for group in self.groups)
        if len(state.exciters) != count:
            raise InputError("state.exciters", f"are {len(state.exciters)}; this scene needs {count}")
        states = [stack_members(group.members, state.exciters) for group in self.groups]
        speeds = self._each(lambda exciter, of_exciter: exciter.drive.rotor_speed(t, of_exciter.rotor), states)
        unforced = self._unforced(state, speeds)
        housings = self._each(lambda exciter: exciter.housing_speed(state.velocity))
        motions = self._each(lambda exciter, *given: exciter.motion(t, *given), states, speeds, housings)

        def solve(contacts: Sequence[ContactSolution]) -> tuple[list[tuple[Eliminated, list[Array]]], Array]:
            parts = self._each(lambda exciter, *given: exciter.eliminate(*given), motions, contacts)
            parts = self._fenced(parts, unforced)
            accelerations, carrier = self._solve_rows(parts, unforced)
            return list(zip(parts, accelerations, strict=True)), carrier

        contacts = [motion.rolling for motion in motions]
        if any(map(depends_on_acceleration, contacts)):
            # The sign of a normal force that depends on the accelerations is taken from the motion without its friction.
            uncoupled, _ = solve([without_coupling(contact) for contact in contacts])
            contacts = self._each(
                lambda exciter, contact, part: signed(contact, exciter.at_loads(part[1])), contacts, uncoupled
            )
        solved, carrier = solve(contacts)
        rolling = contacts
        if any(group.part.can_slide for group in self.groups):
            sliding = self._each(lambda exciter, *given: exciter.slide(*given[:2], *given[2]), motions, contacts, solved)
            solved, carrier = solve(sliding)
        rates = self._each(lambda exciter, *given: exciter.rates(*given[:2], *given[2]), motions, rolling, solved)
        rates = self._fenced(rates, unforced)
        return State(state.velocity, carrier, exciters=ungroup(self.groups, rates))

    def _each(self, function: Callable[..., T], *values: Sequence[object]) -> list[T]:
        """Return function(exciter, *values) of each exciter, by group."""
        return [group.each(function, *of_group) for group, *of_group in zip(self.groups, *values, strict=True)]

    def _fenced(self, parts: list[T], unforced: Array) -> list[T]:
        """Return parts of the groups, with fences if `has_fences` is True."""
        if not self.has_fences or all(len(group.members) == 1 for group in self.groups):
            return parts
        one = hidden_one(unforced[0])
        arrays = [eqx.partition(part, eqx.is_inexact_array) for part in parts]
        return [
            part if len(group.members) == 1 else eqx.combine(jax.tree.map(lambda x: fence(x, one), own), rest)
            for group, part, (own, rest) in zip(self.groups, parts, arrays, strict=True)
        ]

    def at_rows(self, rows: Array) -> Dynamics:
        """Return the equations with the accelerations of P's rows, at most nd, and of further `rows` (k, nd) in place of the
        carrier's q''. The cost is then proportional to nd, and not to its square."""
        every = jnp.concatenate([self.rows, rows])
        supports = tuple(_Support(support.rows, every @ support.input_matrix) for support in self.supports)
        return dataclasses.replace(
            self,
            stiffness_per_mass=every @ self.stiffness_per_mass,
            damping_per_mass=every @ self.damping_per_mass,
            gyroscopic_per_mass=None if self.gyroscopic_per_mass is None else every @ self.gyroscopic_per_mass,
            input_matrix=every @ self.input_matrix,
            rows=jnp.eye(self.rows.shape[0], every.shape[0], dtype=every.dtype),
            supports=supports,
        )

    def _unforced(self, state: State, speeds: Sequence[Array]) -> Array:
        """Return the accelerations of the carrier without exciters."""
        acceleration = -times(self.stiffness_per_mass, state.displacement) - times(self.damping_per_mass, state.velocity)
        if self.gyroscopic_per_mass is not None:
            each = ungroup(self.groups, speeds)
            speed = each[0] if len(each) == 1 else sum(each[1:], each[0]) / len(each)
            acceleration = acceleration - speed * times(self.gyroscopic_per_mass, state.velocity)
        effects = self.exciters[0].effects if self.supports else ()
        for term, support in zip(terms_of(effects, SupportForce), self.supports, strict=True):
            x, v = times(support.rows, state.displacement), times(support.rows, state.velocity)
            acceleration = acceleration - times(support.input_matrix, term.force(x, v))
        return acceleration

    def _solve_rows(self, parts: Sequence[Eliminated], unforced: Array) -> tuple[list[list[Array]], Array]:
        """Return the accelerations of the rows of each exciter, by group, and those of the carrier."""
        if any(len(group.members) > 1 for group in self.groups):
            return self._solve_rows_of_groups(parts, unforced)
        ends = np.cumsum([len(part.reaction) for part in parts]).tolist()
        blocks = [range(begin, end) for begin, end in zip([0, *ends], ends, strict=False)]
        block_of_row = [block for block in blocks for _ in block]
        weights = [
            dict(zip(block, line, strict=True)) for part, block in zip(parts, blocks, strict=True) for line in part.added_mass
        ]
        reaction = [g for part in parts for g in part.reaction]
        if self.mass is not None:
            carrier = self._solve_in_coordinates(self.mass, unforced, weights, reaction)
            return [[jnp.sum(self.rows[k] * carrier) for k in block] for block in blocks], carrier

        def row_coupling(i: int, k: int) -> Array | float:
            """Return the acceleration of row i that the added mass causes per acceleration of row k of the same exciter."""
            return sum(self.accelerance[i, j] * weights[j][k] for j in block_of_row[k])

        n, free = ends[-1], times(self.rows, unforced)
        matrix = [[(1.0 if i == k else 0.0) + row_coupling(i, k) for k in range(n)] for i in range(n)]
        right = tuple(free[i] - sum(self.accelerance[i, j] * reaction[j] for j in range(n)) for i in range(n))
        a = small_inverse(matrix)(right)
        force = [-sum(w * a[k] for k, w in weights[i].items()) - reaction[i] for i in range(n)]
        carrier = unforced + sum(self.input_matrix[:, i] * force[i] for i in range(n))
        return [[a[k] for k in block] for block in blocks], carrier

    def _solve_rows_of_groups(self, parts: Sequence[Eliminated], unforced: Array) -> tuple[list[list[Array]], Array]:
        """Return the result of `_solve_rows`, computed with arrays over all rows.

        If P has at most as many rows as there are coordinates, the unknowns are the forces f = W a + g:
        (1 + W accelerance) f = W a_free + g.
        """
        arrays = self._each(lambda _, part: (jnp.asarray(part.added_mass), jnp.asarray(part.reaction)), parts)
        weights = [added.reshape(-1, *added.shape[-2:]) for added, _ in arrays]
        reaction = jnp.concatenate([jnp.ravel(g) for _, g in arrays])
        ends = np.cumsum([w.shape[0] * w.shape[1] for w in weights])

        def weighted(x: Array) -> Array:
            """Return W x for x (nP, k) and the added mass W, which couples rows of one exciter only."""
            blocks = (block.reshape(*w.shape[:2], -1) for w, block in zip(weights, jnp.split(x, ends[:-1]), strict=True))
            products = (jnp.sum(w[..., None] * x[:, None], axis=2) for w, x in zip(weights, blocks, strict=True))
            return jnp.concatenate([product.reshape(-1, x.shape[1]) for product in products])

        if self.mass is not None:
            # XLA may call a library for a product of matrices and then runs the time loop as a chain of small functions.
            added = [times(self.rows.T, column) for column in weighted(self.rows).T]
            mass = self.mass + jnp.stack(added, axis=1)
            carrier = solve_definite(mass, times(self.mass, unforced) - times(self.rows.T, reaction))
            a = times(self.rows, carrier)
        else:
            free = times(self.rows, unforced)
            matrix = jnp.eye(reaction.shape[0], dtype=free.dtype) + weighted(self.accelerance)
            force = small_solve(matrix, weighted(free[:, None])[:, 0] + reaction)
            carrier, a = unforced - times(self.input_matrix, force), free - times(self.accelerance, force)
        each = [block.reshape(w.shape[:2]) for w, block in zip(weights, jnp.split(a, ends[:-1]), strict=True)]
        return [list(block[0] if len(block) == 1 else block.T) for block in each], carrier

    def _solve_in_coordinates(
        self, mass: Array, unforced: Array, weights: list[dict[int, Array | float]], reaction: list[Array | float]
    ) -> Array:
        force = times(mass, unforced)
        for row, line, g in zip(self.rows, weights, reaction, strict=True):
            weighted_row = functools.reduce(operator.add, (w * self.rows[k] for k, w in line.items()))
            mass = mass + row[:, None] * weighted_row[None, :]
            force = force - row * g
        return solve_definite(mass, force)


@validated
def vector_field(scene: Scene) -> Dynamics:
    """Return the right-hand side of a scene's equations of motion.

        M q'' + (C + speed G) q' + K q + sum_j m_j B_j^T (B_j q'' + d^2 p_j/dt^2) = forces of the effects
        kappa_j m_j J_j^T J_j u_j'' + kappa_j m_j J_j^T (dJ_j/dt) u_j' + m_j J_j^T B_j q'' = Q_u,      J_j = dp_j/du_j
        I theta'' = T(theta') - torque of loads and imbalance        (under a motor; I: moment of inertia of the rotor)

    q are the coordinates of the carrier, and M, C, K and G its mass, damping, stiffness and gyroscopic matrices. Load j has the
    mass m_j, the inertia factor kappa_j (7/5 for balls), the coordinates u_j, such as its angle, the position p_j(u_j) relative
    to the point that carries it, and the generalized forces Q_u; B_j q is the displacement of this point. theta is the angle of
    the rotor, and T the torque of the motor.

    **Arguments**: `scene`, on any machine, with any drive and effects.

    **Returns** `Dynamics`, a pure function of time (s) and `State` that gives the state's time derivative. `jit`, `vmap` and
    `grad` apply to it and to the scene. The cost of an evaluation is proportional to the number of loads. For other solvers and
    for events, `diffrax.ODETerm(vector_field(scene))` is a term of diffrax, with `initial_state(scene)` as `y0`.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> rest = jv.State(jnp.zeros(1), jnp.zeros(1), (jnp.zeros(1),), (jnp.zeros(1),))
    >>> round(float(jv.vector_field(scene)(0.0, rest).rate[0][0]), 4)     # b_W n / (kappa m) = 142.86 on a fixed platform
    143.8746

    Source: the general form of all five papers; for platforms the antiphase paper, equation (2), for stations Artyunin 2013,
    equation (1). The gyroscopic force depends on the rotor speed only. The term of the rotor's acceleration, half the polar
    moment of inertia times theta'' times the tilt, is neglected as by Artyunin.
    """
    return dataclasses.replace(dynamics_of(assemble(validate_scene(scene))), has_fences=True)


def dynamics_of(model: Model, solve: Callable[[Array, Array], Array] = small_solve) -> Dynamics:
    """Return `vector_field` of a scene that is already assembled. `solve` returns x of a x = b, where a is the mass matrix."""
    scene, carrier, gyroscopic = model.scene, model.carrier, model.mounts[0].gyroscopic
    exciters = [_exciter_dynamics(*each, scene.effects) for each in zip(scene.exciters, model.mounts, strict=True)]
    groups, moving = _groups_of_directions(exciters, [exciter.direction for exciter in scene.exciters]), []
    for k in itertools.chain.from_iterable(group.members for group in groups):
        housing_row = exciters[k].housing_row
        moving += [*model.mounts[k].rows[: exciters[k].block_count], *([] if housing_row is None else [housing_row])]
    rows = moving[0] if len(moving) == 1 else jnp.concatenate(moving)
    parts = [carrier.stiffness, carrier.damping, rows.T, *(place.T for place in model.supports)]
    if gyroscopic is not None:
        parts.append(gyroscopic)
    solved = solve(carrier.mass, jnp.concatenate(parts, axis=1))
    stiffness, damping, input_matrix, *rest = jnp.split(solved, np.cumsum([part.shape[1] for part in parts])[:-1], axis=1)
    return Dynamics(
        stiffness_per_mass=stiffness,
        damping_per_mass=damping,
        gyroscopic_per_mass=None if gyroscopic is None else rest[-1],
        input_matrix=input_matrix,
        accelerance=rows @ input_matrix,
        rows=rows,
        mass=carrier.mass if rows.shape[0] > rows.shape[1] else None,
        groups=groups,
        supports=tuple(map(_Support, model.supports, rest)),
    )


def _groups_of_directions(exciters: Sequence[RotorDynamics], directions: Sequence[int]) -> tuple[Group[RotorDynamics], ...]:
    """Return the exciters in groups. Only a group with both directions of rotation contains them as an array, so that programs
    of other groups have no products with it."""

    def directed(part: RotorDynamics, direction: int) -> RotorDynamics:
        drive = part.drive.drive if isinstance(part.drive, Directed) else part.drive
        return dataclasses.replace(part, drive=Directed(drive, jnp.asarray(direction, drive.speed.dtype)))

    if len(set(directions)) == 1:
        return grouped(exciters)
    groups = grouped([directed(*each) for each in zip(exciters, directions, strict=True)])
    has_both = (len({directions[k] for k in group.members}) == 2 for group in groups)
    return tuple(
        group if both else Group(stack_members(group.members, exciters), group.members)
        for group, both in zip(groups, has_both, strict=True)
    )


def _exciter_dynamics(exciter: Exciter, mount: Mount, shared: tuple[Effect, ...]) -> RotorDynamics:
    """Return the dynamics of an exciter under its own effects and those of the scene."""
    effects, loads = (*shared, *exciter.effects), exciter.loads
    housing_row = None if mount.turn is None else mount.turn[None]
    rotor = (mount.levers, mount.rotor_levers, housing_row, exciter.turning_drive, exciter.unbalance)
    block_count = len(mount.rows) if has_term(effects, RotorImbalance) else len(mount.levers)
    if loads is None:
        return RotorDynamics(*rotor, effects, mount.axes, block_count)
    effects = tuple(effect.prepare(loads, mount) for effect in effects)
    return ExciterDynamics(*rotor, effects, mount.axes, block_count, loads)
