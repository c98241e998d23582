"""The toroidal balancer of the tests, and its equations by two other ways."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv

RADIUS, TUBE, OWN, MASS = 0.2, 0.015, 0.0125, 0.064
SPEED = 140.0


def balls(count=2, drag=0.0, **change):
    return jv.torus_balls(**(dict(count=count, mass=MASS, radius=RADIUS, tube=TUBE, ball_radius=OWN, drag=drag) | change))


def scene(effects=(), count=2, drag=0.0, speed=SPEED, **change):
    machine = jv.planar_rotor(mass=6.87, stiffness=1372.0, damping=98.0)
    return jv.Scene(machine, balls(count, drag, **change), jv.ConstantSpeed(speed), effects)


def published(friction=4e-5, direction="along"):
    """Vertical, out of balance, with rolling friction."""
    return (jv.Gravity(along="axis"), jv.StaticImbalance(6.87e-3), jv.RollingFriction(friction, direction, width=0.01))


def some_state(seed=0, count=2):
    """The rotor off its place, balls all over the tube, most of them slower than the rotor."""
    rng = np.random.default_rng(seed)
    draw = lambda n, size: jnp.asarray(rng.normal(size=n) * size)  # noqa: E731
    return jv.State(
        draw(2, 1e-3), draw(2, 0.1), (draw(count, 2.0), draw(count, 2.0)), (100.0 + draw(count, 40.0), draw(count, 60.0))
    )


def _point(gap, radius=RADIUS):
    def point(f, a):
        arm = radius + gap * jnp.sin(a)
        return jnp.stack([arm * jnp.cos(f), arm * jnp.sin(f), -gap * jnp.cos(a)])

    return point


def lagrangian_accelerations(s, t, state, friction=0.0, gravity=0.0):
    """x'' of x = (q, f_1.., a_1..) from T, V and the dissipated power, all by automatic differentiation.

    T of a ball: m |velocity|^2/2 + (m/5) (B^2 f' (f' - w) + rho^2 a'^2), what rolling without slip and twist leaves of it.
    `friction` is (coefficient, direction, width) or 0; the normal force is that of the whole motion.
    """
    n, m, gap = s.loads.count, s.loads.mass, s.loads.gap
    body, k, c = s.machine.mass, s.machine.stiffness, s.machine.damping
    w, b = s.drive.speed, s.loads.drag
    static = [e.moment for e in s.all_effects if e.kind == "static_imbalance"]
    place = _point(gap)

    def ball(x, j):
        return jnp.stack([x[0], x[1], 0.0]) + place(x[2 + j], x[2 + n + j])

    def arm(x, j):
        return RADIUS + gap * jnp.sin(x[2 + n + j])

    def lagrangian(x, v):
        total = 0.5 * body * jnp.sum(v[:2] ** 2) - 0.5 * k * jnp.sum(x[:2] ** 2)
        for j in range(n):
            rate = jax.jvp(lambda x, j=j: ball(x, j), (x,), (v,))[1]
            f, a = v[2 + j], v[2 + n + j]
            total += 0.5 * m * jnp.sum(rate**2) + 0.2 * m * (arm(x, j) ** 2 * f * (f - w) + gap**2 * a**2)
            total -= m * gravity * ball(x, j)[2]
        return total

    def force(x, v):
        total = jnp.zeros_like(x).at[:2].set(-c * v[:2])
        if static:
            total = total.at[:2].add(static[0] * w**2 * jnp.stack([jnp.cos(w * t), jnp.sin(w * t)]))
        for j in range(n):
            total = total.at[2 + j].add(-b * arm(x, j) ** 2 * (v[2 + j] - w)).at[2 + n + j].add(-b * gap**2 * v[2 + n + j])
        return total

    x = jnp.concatenate([state.displacement, *state.angle])
    v = jnp.concatenate([state.velocity, *state.rate])
    mass = jax.hessian(lagrangian, 1)(x, v)
    along = jax.jvp(lambda y: jax.grad(lagrangian, 1)(y, v), (x,), (v,))[1]
    right = jax.grad(lagrangian)(x, v) - along + force(x, v)
    if not friction:
        return jnp.linalg.solve(mass, right)
    coefficient, direction, width = friction

    def rubbing(acceleration):
        """Friction at these accelerations: linear in them while no ball leaves its wall."""
        total = jnp.zeros_like(x)
        for j in range(n):
            f, a, turn, climb = x[2 + j], x[2 + n + j], v[2 + j] - w, v[2 + n + j]
            inertial = jax.jvp(lambda y, j=j: jax.jvp(lambda x: ball(x, j), (y,), (v,))[1], (x,), (v,))[1]
            inertial += jax.jvp(lambda x, j=j: ball(x, j), (x,), (acceleration,))[1]
            outward = jnp.stack([jnp.sin(a) * jnp.cos(f), jnp.sin(a) * jnp.sin(f), -jnp.cos(a)])
            load = jnp.maximum(-m * outward @ (inertial + jnp.asarray([0.0, 0.0, gravity])), 0.0)
            slide = jnp.stack([arm(x, j) * turn, gap * climb])
            size = jnp.linalg.norm(slide)
            unit = jnp.tanh(slide / width) if direction == "each" else jnp.tanh(size / width) * slide / size
            pull = -coefficient / OWN * load * unit
            total = total.at[2 + j].add(arm(x, j) * pull[0]).at[2 + n + j].add(gap * pull[1])
        return total

    acceleration = jnp.linalg.solve(mass, right)
    for _ in range(30):  # a contraction by the coefficient over the ball's radius
        acceleration = jnp.linalg.solve(mass, right + rubbing(acceleration))
    return acceleration


def rolling_ball_accelerations(gap, own, w, gravity, f, a, rates):
    """(f'', a'') of one ball in a tube on a rotor that does not move aside, from Newton's and Euler's equations in space.

    The ball turns with the wall at its point of contact: no slip, and no twist about the normal. Unknown are f'', a'', the
    contact force and the moment about the normal.
    """
    place, axis, m = _point(gap), jnp.asarray([0.0, 0.0, 1.0]), MASS
    normal = lambda f, a: jnp.stack([jnp.sin(a) * jnp.cos(f), jnp.sin(a) * jnp.sin(f), -jnp.cos(a)])  # noqa: E731

    def spin(f, a, df, da):
        """The angular velocity at which the ball's point of contact moves as the wall does, and twists with it."""
        n = normal(f, a)
        centre = jax.jvp(place, (f, a), (df, da))[1]
        wall = w * jnp.cross(axis, place(f, a) + own * n)
        # own Omega x n = wall - centre, and Omega . n = w axis . n
        return jnp.cross(n, wall - centre) / own + w * (axis @ n) * n

    def equations(unknown):
        ddf, dda, contact, twist = unknown[0], unknown[1], unknown[2:5], unknown[5]
        n = normal(f, a)
        acceleration = jax.jvp(lambda f, a: jax.jvp(place, (f, a), rates)[1], (f, a), rates)[1]
        acceleration += jax.jvp(place, (f, a), (ddf, dda))[1]
        turning = jax.jvp(spin, (f, a, *rates), (*rates, ddf, dda))[1]
        newton = acceleration - contact / m + gravity * axis
        euler = 0.4 * m * own**2 * turning - own * jnp.cross(n, contact) - twist * n
        return jnp.concatenate([newton, euler / (m * own**2)])

    zero = jnp.zeros(6)
    unknown = jnp.linalg.solve(jax.jacfwd(equations)(zero), -equations(zero))
    return unknown[:2], -normal(f, a) @ unknown[2:5]
