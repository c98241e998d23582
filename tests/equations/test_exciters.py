"""Equations of motion of several exciters against the Lagrangian by automatic differentiation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv

T, G = 0.37, 9.81
GRAVITY = (jv.Gravity(),)


def balls(k):
    return jv.balls(count=1 + k % 3, mass=0.4 + 0.1 * k, radius=0.1 + 0.01 * k, drag=0.7 + 0.1 * k)


def drive(k):
    return (
        jv.DCMotor(100.0 + k, stall_torque=6.0, inertia=0.12),
        jv.InductionMotor(120.0, breakdown_torque=7.0, breakdown_slip=0.2, inertia=0.11 + 0.01 * k),
        jv.ConstantSpeed(60.0 + k),
        jv.SpinUp(90.0, 1.0),
    )[k % 4]


def exciter(k, places):
    """Exciters with loads, with an unbalance and with both, in turn, in both directions, under every kind of drive."""
    loads = None if k % 3 == 1 else balls(k)
    unbalance = None if k % 3 == 0 else 0.05 + 0.02 * k
    at, direction = places[k % len(places)], (1, -1)[(k // 2) % 2]
    imbalance = (jv.StaticImbalance(0.03, angle=0.4 + k),) if k % 4 == 1 else ()
    return jv.Exciter(loads, drive(k), unbalance=unbalance, at=at, direction=direction, effects=imbalance)


NETWORK = jv.network(
    mass=[40.0, 30.0, 50.0],
    stiffness=[2e4, 0.0, 3e4],
    damping=[20.0, 0.0, 30.0],
    links=[(1, 2), (2, 3)],
    link_stiffness=[1e5, 8e4],
    link_damping=[20.0, 10.0],
    exciter=2,
)
ROTOR = jv.rotor(
    mass=37.0,
    transverse_inertia=0.479,
    polar_inertia=0.093,
    stiffness=(0.604e6, 0.555e6),
    damping=(439.0, 404.0),
    position=(0.165, -0.155),
)
MACHINES = {"network": (NETWORK, (None, 1, 3)), "rotor": (ROTOR, (0.2, None, -0.15))}


def scene_of(name, n, effects=GRAVITY):
    machine, places = MACHINES[name]
    return jv.Scene(machine, exciters=[exciter(k, places) for k in range(n)], effects=effects)


def state_of(scene, seed=0):
    rng = np.random.default_rng(seed)
    leaves, structure = jax.tree.flatten(jv.initial_state(scene))
    sizes = [3.0 * rng.normal(size=np.shape(leaf)) for leaf in leaves]
    return jax.tree.unflatten(structure, [jnp.asarray(x) for x in sizes])


@eqx.filter_jit
def field(scene, state):
    return jv.vector_field(scene)(T, state)


def first_moments(e):
    """First moments and phases of the unbalance and of the imbalance of an exciter."""
    own = [] if e.unbalance is None else [(e.unbalance, 0.0)]
    return own + [(effect.moment, effect.angle) for effect in e.effects]


def axis_point(machine, at, q):
    """Motion across and up of the exciter's axis, written anew for each machine."""
    if machine is NETWORK:
        return jnp.stack([0.0 * q[0], q[(2 if at is None else at) - 1]])
    s = 0.0 if at is None else at
    return jnp.stack([q[0] + s * q[2], q[1] + s * q[3]])


def lagrange(scene, state):
    """Accelerations of (coordinates, loads and rotor of each exciter), the rotors of ideal drives as they are prescribed."""
    machine, carrier, nd = scene.machine, scene.machine.carrier(), state.displacement.size
    counts = [0 if e.loads is None else e.loads.count for e in scene.exciters]
    places = np.cumsum([nd, *(n + 1 for n in counts)])
    x, v, prescribed = [state.displacement], [state.velocity], {}
    for e, own, place, n in zip(scene.exciters, state.exciters, places, counts, strict=False):
        angle, rate = own.rotor or [e.direction * of(T) for of in (e.drive.angle_at, e.drive.speed_at)]
        if own.rotor is None:
            prescribed[int(place) + n] = e.direction * e.drive.acceleration_at(T)
        x += [*own.angle, jnp.reshape(angle, 1)]
        v += [*own.rate, jnp.reshape(rate, 1)]
    x, v = jnp.concatenate(x), jnp.concatenate(v)

    def parts(x):
        for e, place, n in zip(scene.exciters, places, counts, strict=False):
            yield e, x[place : place + n], x[place + n]

    def kinetic(x, v):
        total = 0.5 * v[:nd] @ carrier.mass @ v[:nd]
        for (e, phi, theta), (_, rate, turn) in zip(parts(x), parts(v), strict=True):
            point = axis_point(machine, e.at, v[:nd])
            if e.loads is not None:
                m, r = e.loads.mass, e.loads.radius
                own = jnp.stack([-r * rate * jnp.sin(phi), r * rate * jnp.cos(phi)])
                total += 0.5 * jnp.sum(m * (own + point[:, None]) ** 2) + 0.5 * 0.4 * m * r**2 * jnp.sum(rate**2)
            for moment, phase in first_moments(e):
                total += moment * turn * (-jnp.sin(theta + phase) * point[0] + jnp.cos(theta + phase) * point[1])
            total += 0.5 * getattr(e.drive, "inertia", 0.1) * turn**2
        return total

    def potential(x):
        total = 0.5 * x[:nd] @ carrier.stiffness @ x[:nd]
        for e, phi, theta in parts(x):
            if e.loads is not None:
                total += G * e.loads.mass * e.loads.radius * jnp.sum(jnp.sin(phi))
            for moment, phase in first_moments(e):
                total += G * moment * jnp.sin(theta + phase)
        return total

    def resisting(v):
        force = jnp.zeros_like(v).at[:nd].set(-carrier.damping @ v[:nd])
        for (e, rate, turn), place, n in zip(parts(v), places, counts, strict=False):
            if e.loads is not None:
                drag = e.loads.drag * e.loads.radius**2 * (turn - rate)
                force = force.at[place : place + n].add(drag).at[place + n].add(-jnp.sum(drag))
            if not e.drive.ideal:
                force = force.at[place + n].add(e.direction * e.drive.torque(e.direction * turn))
        if machine is ROTOR:
            moment = machine.polar_inertia * sum(turn for _, _, turn in parts(v)) / len(counts)
            force = force.at[2].add(-moment * v[3]).at[3].add(moment * v[2])
        return force

    mass = jax.hessian(kinetic, 1)(x, v)
    along = jax.jvp(lambda y: jax.grad(kinetic, 1)(y, v), (x,), (v,))[1]
    force = jax.grad(kinetic)(x, v) - jax.grad(potential)(x) + resisting(v) - along
    known = jnp.zeros_like(x)
    for place, value in prescribed.items():
        known = known.at[place].set(value)
    free = np.setdiff1d(np.arange(x.size), list(prescribed))
    found = jnp.linalg.solve(mass[np.ix_(free, free)], (force - mass @ known)[free])
    return known.at[free].set(found)


def flat(scene, change):
    """Accelerations in the order of `lagrange`."""
    found = [change.velocity]
    for e, own in zip(scene.exciters, change.exciters, strict=True):
        turn = e.direction * e.drive.acceleration_at(T) if own.rotor is None else own.rotor[1]
        found += [*own.rate, jnp.reshape(turn, 1)]
    return jnp.concatenate(found)


@pytest.mark.parametrize(("name", "n"), [("network", 1), ("network", 2), ("network", 3), ("network", 8), ("rotor", 3)])
def test_several_exciters_are_euler_lagrange(name, n):
    scene = scene_of(name, n)
    state = state_of(scene)
    found = flat(scene, field(scene, state))
    expected = jax.jit(lambda y: lagrange(scene, y))(state)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * float(jnp.max(jnp.abs(expected))))


@pytest.mark.parametrize(("name", "kind"), [("network", 5), pytest.param("rotor", 2, marks=pytest.mark.slow)])
def test_a_group_of_exciters_is_euler_lagrange(name, kind):
    """Eight exciters of one kind, `exciter` has a period of twelve, and one of another kind."""
    machine, places = MACHINES[name]
    alike = [exciter(kind + 12 * (j % 3), places) for j in range(8)]
    scene = jv.Scene(machine, exciters=[alike[0], exciter(0, places), *alike[1:]], effects=GRAVITY)
    assert sorted(len(group.members) for group in jv.vector_field(scene).groups) == [1, 8]
    state = state_of(scene)
    found = flat(scene, field(scene, state))
    expected = jax.jit(lambda y: lagrange(scene, y))(state)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * float(jnp.max(jnp.abs(expected))))


@pytest.mark.parametrize(("name", "n"), [("network", 3), ("network", 5), ("rotor", 4)])
def test_energy_changes_by_the_power_of_all_exciters(name, n):
    scene = scene_of(name, n, (*GRAVITY, *([jv.Stop(1e5, gap=0.01, damping=20.0)] if name == "network" else [])))
    state = state_of(scene, 1)

    @jax.jit
    def balance(state):
        change = jv.vector_field(scene)(T, state)
        rate = jax.jvp(lambda y, t: jv.energy(scene, y, t), (state, T), (change, 1.0))[1]
        return rate, jv.power(scene, T, state)

    rate, (given, lost) = balance(state)
    np.testing.assert_allclose(rate, given - lost, rtol=1e-12, atol=1e-12 * float(abs(given) + abs(lost)))


@pytest.mark.parametrize("direction", [1, -1])
def test_two_half_exciters_at_one_place_are_one(direction):
    def motor(share):
        return jv.DCMotor(100.0, stall_torque=6.0 * share, inertia=0.1 * share)

    def half(share):
        loads = jv.balls(count=2, mass=0.5 * share, radius=0.1, drag=0.9 * share)
        return jv.Exciter(loads, motor(share), unbalance=0.1 * share, at=0.1, direction=direction)

    one, two = (jv.Scene(ROTOR, exciters=each, effects=GRAVITY) for each in ([half(1.0)], [half(0.5)] * 2))
    state = state_of(one)
    whole = field(one, state)
    parted = field(two, jv.State(state.displacement, state.velocity, exciters=state.exciters * 2))
    np.testing.assert_allclose(parted.velocity, whole.velocity, rtol=1e-12)
    for own in parted.exciters:
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12), own, whole.exciters[0])


def test_clockwise_exciter_is_the_mirror_image():
    """Reflection across the vertical: the planar rotor's y and all angles, phi -> pi - phi, change their signs."""
    machine = jv.planar_rotor(mass=9.0, stiffness=2e4, damping=20.0)

    def scene(direction):
        loads = jv.balls(count=3, mass=0.3, radius=0.1, drag=0.9)
        return jv.Scene(
            machine, exciters=[jv.Exciter(loads, drive(1), unbalance=0.1, direction=direction)], effects=jv.Gravity()
        )

    def mirrored(state, half_turn):
        own = state.exciters[0]
        angle = tuple(half_turn - x for x in own.angle)
        rotor = (half_turn - own.rotor[0], -own.rotor[1])
        flip = jnp.asarray([-1.0, 1.0])
        other = jv.ExciterState(angle, tuple(-x for x in own.rate), rotor)
        return jv.State(flip * state.displacement, flip * state.velocity, exciters=[other])

    state = state_of(scene(1))
    there = field(scene(-1), mirrored(state, jnp.pi))
    expected = mirrored(field(scene(1), state), 0.0)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-11), there, expected)
