"""The one place where a scene becomes equations of motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.machine.drive import Drive
from jaxvib.machine.effects import Effect
from jaxvib.machine.loads import Loads
from jaxvib.machine.scene import Scene

__all__ = ["Dynamics", "State", "vector_field"]


class State(eqx.Module):
    """Where everything is and how fast; also the time derivative of such a state.

    **Attributes**: `displacement` q (nd,) m and `velocity` q' (nd,) m/s of the carrier's coordinates; `angle` and `rate`, a
    tuple of (count,) arrays, one for each coordinate of a load: for loads on a circle ((phi_1, ...),) in rad and rad/s.
    """

    displacement: Array
    velocity: Array
    angle: tuple[Array, ...]
    rate: tuple[Array, ...]


class Dynamics(eqx.Module):
    """A scene made ready for time integration: all that does not change with time is computed once, here.

    The carrier is solved for its accelerations, q'' = flow - with M's inverse already applied:

    - `stiffness` M^-1 K, `damping` M^-1 C, `gyroscopic` M^-1 G (or None), (nd, nd)
    - `push` M^-1 B^T (nd, np): acceleration per force at the port; `mobility` B M^-1 B^T (np, np); `port` B (np, nd)
    """

    stiffness: Array
    damping: Array
    gyroscopic: Array | None
    push: Array
    mobility: Array
    port: Array
    loads: Loads
    drive: Drive
    effects: tuple[Effect, ...]
    axes: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, t: Array, state: State, port_force: Array | None = None) -> State:
        """The time derivative of `state` at time `t`, with an outer `port_force` (np,) N if one is given.

        Each load is eliminated first. With J = p'(u), c = (dJ/dt) u', H = kappa m J^T J and r = Q_u - kappa m J^T c it obeys
        u'' = H^-1 (r - m J^T a), a the port's acceleration, and pushes the port with -(W a + g),
        W = m 1 - m^2 J H^-1 J^T, g = m (J H^-1 r + c). What is left is (1 + mobility W) a = a_free - mobility g, one
        equation for each port direction, however many platforms and loads there are.
        """
        loads, u, rate = self.loads, state.angle, state.rate
        speed = self.drive.speed_at(t)

        columns, curvature = _kinematics(loads, u, rate)
        force = loads.resistance(u, rate, speed)
        for effect in self.effects:
            force = tuple(f + e for f, e in zip(force, effect.load_force(loads, u), strict=True))
        m = loads.mass
        inertia = loads.inertia_factor() * m
        remainder = tuple(
            f - inertia * sum(x * c for x, c in zip(column, curvature, strict=True))
            for f, column in zip(force, columns, strict=True)
        )
        gram = [[inertia * sum(x * y for x, y in zip(a, b, strict=True)) for b in columns] for a in columns]
        solve = _small_inverse(gram)
        free = solve(remainder)

        axes = self.axes
        answers = [solve(tuple(m * column[axis] for column in columns)) for axis in axes]
        weight = [
            [
                _total(
                    m * (1.0 if i == k else 0.0) - m * sum(x[a] * y for x, y in zip(columns, answers[k], strict=True)),
                    loads,
                )
                for k in range(len(axes))
            ]
            for i, a in enumerate(axes)
        ]
        reaction = [_total(m * (sum(x[a] * f for x, f in zip(columns, free, strict=True)) + curvature[a]), loads) for a in axes]

        unforced = -_times(self.stiffness, state.displacement) - _times(self.damping, state.velocity)
        if self.gyroscopic is not None:
            unforced = unforced - speed * _times(self.gyroscopic, state.velocity)
        if port_force is not None:
            unforced = unforced + _times(self.push, port_force)
        port_free = _times(self.port, unforced)
        n = len(axes)
        matrix = [
            [(1.0 if i == k else 0.0) + sum(self.mobility[i, j] * weight[j][k] for j in range(n)) for k in range(n)]
            for i in range(n)
        ]
        right = [port_free[i] - sum(self.mobility[i, j] * reaction[j] for j in range(n)) for i in range(n)]
        port_acceleration = _small_inverse(matrix)(tuple(right))
        push = [-sum(weight[i][k] * port_acceleration[k] for k in range(n)) - reaction[i] for i in range(n)]
        acceleration = unforced + sum(self.push[:, i] * push[i] for i in range(n))
        rate_change = tuple(
            f - sum(answer[i] * a for answer, a in zip(answers, port_acceleration, strict=True)) for i, f in enumerate(free)
        )
        return State(state.velocity, acceleration, rate, rate_change)


def vector_field(scene: Scene) -> Dynamics:
    """The right-hand side of the scene's equations of motion.

        M q'' + (C + speed G) q' + K q + sum_j m_j B^T (B q'' + d^2 p_j/dt^2) = 0
        kappa m J^T J u'' + kappa m J^T (dJ/dt) u' + m J^T B q'' = Q_u          (J = dp/du, for each load)

    **Returns** `Dynamics`, a pure function of time (s) and `State` that gives the state's time derivative; `jit`, `vmap` and
    `grad` go through it and through the scene.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> rest = jv.State(jnp.zeros(1), jnp.zeros(1), (jnp.zeros(1),), (jnp.zeros(1),))
    >>> round(float(jv.vector_field(scene)(0.0, rest).rate[0][0]), 4)     # b_W n / (kappa m), the platform giving way
    143.8746

    Source: the general form of all five papers; for platforms the antiphase paper, equation (2).
    """
    carrier = scene.machine.carrier()
    parts = [carrier.stiffness, carrier.damping, carrier.port.T]
    if carrier.gyroscopic is not None:
        parts.append(carrier.gyroscopic)
    solved = jnp.linalg.solve(carrier.mass, jnp.concatenate(parts, axis=1))
    n, p = carrier.mass.shape[0], carrier.port.shape[0]
    push = solved[:, 2 * n : 2 * n + p]
    return Dynamics(
        stiffness=solved[:, :n],
        damping=solved[:, n : 2 * n],
        gyroscopic=None if carrier.gyroscopic is None else solved[:, 2 * n + p :],
        push=push,
        mobility=carrier.port @ push,
        port=carrier.port,
        loads=scene.loads,
        drive=scene.drive,
        effects=scene.effects,
        axes=carrier.axes,
    )


def _kinematics(
    loads: Loads, u: tuple[Array, ...], rate: tuple[Array, ...]
) -> tuple[list[tuple[Array, Array]], tuple[Array, Array]]:
    """Columns of J and c = (dJ/dt) u', of all loads at once (the position acts elementwise)."""

    def along(direction: tuple[Array, ...]) -> Callable[..., tuple[Array, Array]]:
        return lambda *v: jax.jvp(loads.position, v, direction)[1]

    columns = []
    for i in range(len(u)):
        direction = tuple(jnp.ones_like(x) if k == i else jnp.zeros_like(x) for k, x in enumerate(u))
        columns.append(along(direction)(*u))
    return columns, jax.jvp(along(rate), u, rate)[1]


def _total(values: Array, loads: Loads) -> Array:
    return jnp.sum(jnp.broadcast_to(values, (loads.count,)))


def _times(matrix: Array, vector: Array) -> Array:
    """Matrix times vector as a sum: a library call in the time loop would keep the compiler from fusing it."""
    return jnp.sum(matrix * vector[None, :], axis=-1)


def _small_inverse(a: Sequence[Sequence[Any]]) -> Callable[[tuple[Array, ...]], tuple[Array, ...]]:
    """x of a x = b for 1 or 2 equations, written out; the entries may be arrays of many such systems."""
    if len(a) == 1:
        return lambda b: (b[0] / a[0][0],)
    if len(a) == 2:
        det = a[0][0] * a[1][1] - a[0][1] * a[1][0]
        return lambda b: ((a[1][1] * b[0] - a[0][1] * b[1]) / det, (a[0][0] * b[1] - a[1][0] * b[0]) / det)
    raise ValueError(f"{len(a)} equations: ports with 1 or 2 directions and loads with 1 or 2 coordinates are written out")
