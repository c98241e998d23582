"""Lagrange's equations of the second kind for any scene."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
from jaxvib.machine.structures.platforms import Platforms


def residual(s, t, state, field):
    """Lagrange's equations of the second kind, from positions and potentials alone, in units of their largest term.

    Everything is written anew here: coordinates x = (q, phi_1.., theta), the rotor's angle being one of them.
    """
    nd, n = state.displacement.shape[0], s.loads.count
    planar = nd == 2
    vertical = isinstance(s.machine, Platforms)
    motor = isinstance(s.drive, jv.Motor)
    m, r, drag = (float(getattr(s.loads, name)) for name in ("mass", "radius", "drag"))
    inertia = float(s.loads.inertia) if s.loads.kind == "pendulum" else 0.4 * m * r**2
    stations = np.zeros(n) if planar else np.broadcast_to(np.asarray(s.machine.stations), (n,))
    kinds = {e.kind: e for e in s.all_effects}
    g = float(kinds["gravity"].g) if "gravity" in kinds else 0.0
    if motor:
        theta, spin, change = *state.rotor, field.rotor[1]
    else:
        time = jnp.asarray(t)
        speed_of = jax.grad(s.drive.angle_at)
        theta, spin, change = s.drive.angle_at(time), speed_of(time), jax.grad(speed_of)(time)
    x = jnp.concatenate([state.displacement, state.angle[0], theta[None]])
    v = jnp.concatenate([state.velocity, state.rate[0], spin[None]])
    a = jnp.concatenate([field.velocity, field.rate[0], change[None]])

    def centre(x, s_):
        """Position of the axis at the distance s_ from the centre of mass."""
        if vertical:
            return jnp.stack([0.0 * x[1], x[1]])
        return x[:2] if planar else x[:2] + s_ * x[2:4]

    def bob(x, j):
        return centre(x, stations[j]) + r * jnp.stack([jnp.cos(x[nd + j]), jnp.sin(x[nd + j])])

    def kinetic(x, v):
        def speed2(point):
            return jnp.sum(jax.jvp(point, (x,), (v,))[1] ** 2)

        total = sum(0.5 * m * speed2(lambda x, j=j: bob(x, j)) for j in range(n)) + 0.5 * inertia * jnp.sum(v[nd:-1] ** 2)
        body = s.machine.mass if vertical else jnp.asarray([s.machine.mass])
        heavy = body[-1]
        if "static_imbalance" in kinds:
            e = kinds["static_imbalance"].moment / heavy
            lead = kinds["static_imbalance"].angle

            def off(x):
                return centre(x, 0.0) + e * jnp.stack([jnp.cos(x[-1] + lead), jnp.sin(x[-1] + lead)])

            # The whole of the rotor's inertia, M e^2 included, is the motor's number.
            total += 0.5 * heavy * speed2(off) - 0.5 * heavy * e**2 * v[-1] ** 2
        else:
            total += 0.5 * heavy * speed2(lambda x: centre(x, 0.0))
        if vertical:
            total += 0.5 * body[0] * v[0] ** 2
        elif not planar:
            total += 0.5 * s.machine.transverse_inertia * jnp.sum(v[2:4] ** 2)
        if "moment_imbalance" in kinds:
            moment, lead = kinds["moment_imbalance"].moment, kinds["moment_imbalance"].angle
            total += moment * v[-1] * (-jnp.sin(x[-1] + lead) * v[2] + jnp.cos(x[-1] + lead) * v[3])
        if motor:
            total += 0.5 * s.drive.inertia * v[-1] ** 2
        return total

    def potential(x):
        total = g * m * sum(bob(x, j)[1] - centre(x, stations[j])[1] for j in range(n))
        if "static_imbalance" in kinds:
            e = kinds["static_imbalance"]
            total += g * e.moment * jnp.sin(x[-1] + e.angle)
        if vertical:
            k, link = s.machine.stiffness, s.machine.link_stiffness[0]
            total += 0.5 * jnp.sum(k * x[:2] ** 2) + 0.5 * link * (x[0] - x[1]) ** 2
        elif planar:
            total += 0.5 * s.machine.stiffness * jnp.sum(x[:2] ** 2)
        else:
            for k, at in zip(s.machine.stiffness, s.machine.position, strict=True):
                total += 0.5 * k * jnp.sum(centre(x, at) ** 2)
        for e in s.all_effects:
            if e.kind in ("cubic_support", "stop"):
                at = x[e.platform - 1] if vertical else jnp.sqrt(jnp.sum(centre(x, e.position) ** 2))
                if e.kind == "cubic_support":
                    total += e.stiffness * at**4 / 4.0
                else:
                    total += 0.5 * e.stiffness * jnp.maximum((-at if e.side == "below" else at) - e.gap, 0.0) ** 2
        if "load_contact" in kinds:
            c = kinds["load_contact"]
            for j in range(n):
                apart = jnp.sqrt(jnp.sum((bob(x, j) - bob(x, (j + 1) % n)) ** 2))
                total += 0.5 * c.stiffness * jnp.maximum(2.0 * s.loads.ball_radius - apart, 0.0) ** 2
        return total

    def resisting(x, v):
        """Generalised forces that no potential has."""
        slip = v[-1] - v[nd:-1]
        torque = drag * r**2 * slip
        if "dry_friction" in kinds:
            f = kinds["dry_friction"]
            lever = 0.5 * f.coefficient * f.diameter * jnp.tanh(slip / f.width)
            if f.reaction == "exact":
                across = jnp.stack(
                    [jax.jvp(lambda y, j=j: jax.jvp(lambda x: bob(x, j), (y,), (v,))[1], (x,), (v,))[1] for j in range(n)]
                )
                across += jnp.stack([jax.jvp(lambda x, j=j: bob(x, j), (x,), (a,))[1] for j in range(n)])
                outward = jnp.stack([jnp.cos(x[nd:-1]), jnp.sin(x[nd:-1])], axis=1)
                load = -m * jnp.sum((across + jnp.array([[0.0, g]])) * outward, axis=1)
            elif f.reaction == "run_up":
                load = m * r * v[nd:-1] ** 2 - 2.0 * m * r * v[-1] * slip
            else:
                load = m * r * v[-1] ** 2 * jnp.ones(n)
            torque += lever * jnp.abs(load)
        force = jnp.zeros_like(x).at[nd:-1].add(torque).at[-1].add(-jnp.sum(torque))
        dampers = lambda y: 0.0  # noqa: E731
        if vertical:
            c, link = s.machine.damping, s.machine.link_damping[0]
            dampers = lambda y: 0.5 * jnp.sum(c * y[:2] ** 2) + 0.5 * link * (y[0] - y[1]) ** 2  # noqa: E731
        elif planar:
            dampers = lambda y: 0.5 * s.machine.damping * jnp.sum(y[:2] ** 2)  # noqa: E731
        else:
            each = list(zip(s.machine.damping, s.machine.position, strict=True))
            dampers = lambda y: sum(0.5 * c * jnp.sum(centre(y, at) ** 2) for c, at in each)  # noqa: E731
            polar = s.machine.polar_inertia * v[-1]
            force = force.at[2].add(-polar * v[3]).at[3].add(polar * v[2])
        force -= jax.grad(dampers)(v) if not isinstance(dampers(v), float) else 0.0
        for e in s.all_effects:
            if e.kind == "friction_support":
                place = (lambda y, e=e: y[e.platform - 1 : e.platform]) if vertical else (lambda y, e=e: centre(y, e.position))
                if e.to:
                    place = lambda y, e=e: y[e.platform - 1 : e.platform] - y[e.to - 1 : e.to]  # noqa: E731
                sliding = jax.jvp(place, (x,), (v,))[1]
                speed = jnp.sqrt(jnp.sum(sliding**2))
                force -= jax.vjp(place, x)[1](e.force * jnp.tanh(speed / e.width) * sliding / speed)[0]
            if e.kind == "stop":
                radius = (
                    (lambda y, e=e: (-1.0 if e.side == "below" else 1.0) * y[e.platform - 1])
                    if vertical
                    else (lambda y, e=e: jnp.sqrt(jnp.sum(centre(y, e.position) ** 2)))
                )
                beyond, closing = jax.jvp(radius, (x,), (v,))
                press = jnp.maximum(e.stiffness * (beyond - e.gap) + e.damping * closing, 0.0)
                force -= jnp.where(beyond > e.gap, press - e.stiffness * (beyond - e.gap), 0.0) * jax.grad(radius)(x)
        if "load_contact" in kinds:
            c = kinds["load_contact"]
            for j in range(n):
                apart = lambda y, j=j: jnp.sqrt(jnp.sum((bob(y, j) - bob(y, (j + 1) % n)) ** 2))  # noqa: E731
                gap, rate = jax.jvp(apart, (x,), (v,))
                spring = c.stiffness * (2.0 * s.loads.ball_radius - gap)
                press = jnp.maximum(spring - c.damping * rate, 0.0)
                force += jnp.where(spring > 0.0, press - spring, 0.0) * jax.grad(apart)(x)
        if motor:
            force = force.at[-1].add(s.drive.torque(v[-1]))
        return force

    momentum = jax.grad(kinetic, 1)
    inertial = jax.jvp(momentum, (x, v), (v, a))[1]
    terms = jnp.stack([inertial, -jax.grad(kinetic)(x, v), jax.grad(potential)(x), -resisting(x, v)])
    left = jnp.sum(terms, axis=0) / jnp.max(jnp.abs(terms), axis=0)
    return left if motor else left[:-1]
