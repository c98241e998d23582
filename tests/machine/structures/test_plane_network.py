"""Networks of bodies in a plane: Lagrange's equations, one body as a special case, files, wrong input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import rates_at

import jaxvib as jv
from jaxvib.machine.numbers.named import numbers_of

T, G = 0.4, 9.81
BODIES = [jv.body(mass=200.0, inertia=60.0), jv.body(mass=90.0, inertia=25.0)]
SUPPORTS = [
    jv.support(at=(-1.5, -0.2), stiffness=(1e5, 2e5), damping=(500, 900), body=1),
    jv.support(at=(1.4, -0.3), stiffness=(2e5, 1e5), damping=(400, 300), angle="30 deg", body=1),
    jv.support(at=(-1.0, -0.3), stiffness=(2e5, 4e5), damping=(800, 900), to=1, at_other=(-1.1, 0.2), angle="-20 deg"),
    jv.support(at=(0.9, 0.2), stiffness=(1e5, 3e5), damping=(700, 600), body=1, to=0, at_other=(1.0, -0.3)),
]
MACHINE = jv.plane_network(BODIES, SUPPORTS)
BALLS = jv.balls(count=2, mass=0.5, radius=0.1, drag=0.7)
EXCITERS = [
    jv.Exciter(drive=jv.DCMotor(100.0, stall_torque=6.0, inertia=0.12), unbalance=0.06, at=(-0.4, 0.3)),
    jv.Exciter(drive=jv.DCMotor(90.0, 7.0, 0.13), unbalance=0.05, at=(0.5, 0.2), body=1, direction=-1, unbalance_mass=3.0),
    jv.Exciter(BALLS, jv.ConstantSpeed(60.0), at=(0.1, -0.3), body=1),
]
SCENE = jv.Scene(MACHINE, exciters=EXCITERS, effects=jv.Gravity())


def point(at, body, q):
    """Displacement of a point of a body that turns by a small angle."""
    x, y, psi = q[3 * body : 3 * body + 3]
    return jnp.stack([x - psi * at[1], y + psi * at[0]])


def springs(q, kind):
    """Half the sum of coefficient times elongation squared, each spring along its own direction."""
    total = 0.0
    for each in SUPPORTS:
        moved = point(each.at, each.body, q)
        if each.to is not None:
            moved = moved - point(each.at_other, each.to, q)
        for j in (0, 1):
            angle = each.angle + 0.5 * jnp.pi * j
            total += 0.5 * getattr(each, kind)[j] * (jnp.cos(angle) * moved[0] + jnp.sin(angle) * moved[1]) ** 2
    return total


def kinetic(x, v):
    """Coordinates: six of the bodies, two rotors, two balls."""
    total = sum(
        0.5 * (body.mass * (v[3 * b] ** 2 + v[3 * b + 1] ** 2) + body.inertia * v[3 * b + 2] ** 2)
        for b, body in enumerate(BODIES)
    )
    for place, exciter in zip((6, 7), EXCITERS, strict=False):
        u, th = point(exciter.at, exciter.body, v), x[place]
        total += exciter.unbalance * v[place] * (-jnp.sin(th) * u[0] + jnp.cos(th) * u[1])
        total += 0.5 * exciter.drive.inertia * v[place] ** 2
        if exciter.unbalance_mass is not None:
            total += 0.5 * exciter.unbalance_mass * jnp.sum(u**2)
    u = point(EXCITERS[2].at, 1, v)
    own = BALLS.radius * v[None, 8:] * jnp.stack([-jnp.sin(x[8:]), jnp.cos(x[8:])])
    return (
        total + 0.5 * BALLS.mass * jnp.sum((own + u[:, None]) ** 2) + 0.2 * BALLS.mass * BALLS.radius**2 * jnp.sum(v[8:] ** 2)
    )


def potential(x):
    weight = sum(exciter.unbalance * jnp.sin(x[place]) for place, exciter in zip((6, 7), EXCITERS, strict=False))
    return springs(x, "stiffness") + G * (weight + BALLS.mass * BALLS.radius * jnp.sum(jnp.sin(x[8:])))


def random_state():
    rng = np.random.default_rng(2)
    leaves, structure = jax.tree.flatten(jv.initial_state(SCENE))
    return jax.tree.unflatten(structure, [jnp.asarray(rng.normal(size=np.shape(leaf))) for leaf in leaves])


def flat(state, rates):
    """Positions (10,) of a state, or its velocities, or the accelerations of its rates."""
    k = 1 if rates else 0
    rotors = jnp.stack([state.exciters[j].rotor[k] for j in (0, 1)])
    balls = state.exciters[2].rate[0] if rates else state.exciters[2].angle[0]
    return jnp.concatenate([state.velocity if rates else state.displacement, rotors, balls])


def test_equations_of_motion_are_euler_lagrange():
    state = random_state()
    change = rates_at(SCENE, T, state)
    x, v, a = flat(state, False), flat(state, True), flat(change, True)
    inertial = jax.jvp(jax.grad(kinetic, 1), (x, v), (v, a))[1]
    left = inertial - jax.grad(kinetic)(x, v) + jax.grad(potential)(x)
    force = -jax.grad(lambda v: springs(v, "damping"))(v)
    for place, exciter in zip((6, 7), EXCITERS, strict=False):
        turn, way = 3 * exciter.body + 2, exciter.direction
        torque = way * exciter.drive.torque(way * (v[place] - v[turn]))
        force = force.at[place].add(torque).at[turn].add(-torque)
    drag = BALLS.drag * BALLS.radius**2 * (60.0 - v[8:])  # an ideal drive takes it from the second body
    force = force.at[8:].add(drag).at[5].add(-jnp.sum(drag))
    scale = jnp.max(jnp.abs(inertial)) + jnp.max(jnp.abs(force))
    np.testing.assert_allclose((left - force) / scale, 0.0, atol=1e-12)


def test_energy_changes_by_the_power_of_the_drives():
    state = random_state()
    change = rates_at(SCENE, T, state)
    rate = jax.jvp(lambda y, t: jv.energy(SCENE, y, t), (state, T), (change, 1.0))[1]
    given, lost = jv.power(SCENE, T, state)
    np.testing.assert_allclose(rate, given - lost, rtol=1e-12, atol=1e-12 * float(abs(given) + abs(lost)))


def test_one_body_of_a_network_is_a_plane_body():
    own = [jv.support(at=(1.2, -0.2), stiffness=(2e5, 4e5), damping=(2e3, 4e3), angle="20 deg")]
    one = jv.plane_network(BODIES[:1], own).carrier()
    other = jv.plane_body(mass=200.0, inertia=60.0, supports=own).carrier()
    assert eqx.tree_equal(one, other)


def test_rigid_joint_moves_two_bodies_as_one():
    """Two halves of one body joined by very stiff springs have its natural frequencies."""
    ends = [jv.support(at=(x, 0.0), stiffness=(1e5, 2e5), damping=(0, 0), body=b) for b, x in ((0, -1.0), (1, 1.0))]
    joints = [jv.support(at=(0.5, y), stiffness=(1e12, 1e12), damping=(0, 0), to=1, at_other=(-0.5, y)) for y in (-0.5, 0.5)]
    halves = jv.plane_network([jv.body(mass=100.0, inertia=10.0)] * 2, ends + joints)
    whole = [jv.support(at=(x, 0.0), stiffness=(1e5, 2e5), damping=(0, 0)) for x in (-1.5, 1.5)]
    one = jv.plane_body(mass=200.0, inertia=20.0 + 200.0 * 0.25, supports=whole)
    motor = jv.DCMotor(100.0, 6.0, 0.1)
    found, wanted = (
        jv.natural_frequencies(jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=0.1)]))
        for machine in (halves, one)
    )
    np.testing.assert_allclose(np.asarray(found)[:3], wanted, rtol=1e-6)


def test_point_moves_with_its_body():
    run = jv.simulate(SCENE, 0.2, save="window", estimate=False)
    kept = np.asarray(run.window.state.displacement)
    moved = run.point((0.3, 0.1), body=1).displacement
    np.testing.assert_allclose(moved[:, 1], kept[:, 4] + 0.3 * kept[:, 5], rtol=1e-12, atol=1e-15)


def test_file_of_a_network_is_written_and_read_again():
    text = jv.scene_to_toml(SCENE)
    assert eqx.tree_equal(jv.scene_from_toml(text), SCENE)
    assert "bodies = [" in text and "at_other = [" in text
    names = numbers_of(SCENE)
    assert "machine.supports[2].at_other[0]" in names and names["machine.bodies[1].mass"].words(SCENE) == ["mass of body 2"]


def test_file_keeps_the_body_of_loads_at_its_centre():
    scene = jv.Scene(MACHINE, exciters=[jv.Exciter(BALLS, jv.ConstantSpeed(60.0), body=1)])
    assert eqx.tree_equal(jv.scene_from_toml(jv.scene_to_toml(scene)), scene)


def one(**more):
    return jv.support(**{"at": (0.0, 0.0), "stiffness": (1, 1), "damping": (0, 0), **more})


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: jv.plane_network([], SUPPORTS), r"machine.bodies is \[\]; it must be a list of bodies"),
        (lambda: jv.plane_network([3.0], SUPPORTS), r"machine.bodies\[0\] is 3.0; it must be a body"),
        (lambda: jv.plane_network(BODIES, []), r"machine.supports is \[\]; it must be a list of supports"),
        (lambda: jv.plane_network(BODIES, [one(body=2)]), r"machine.supports\[0\].body is 2; the machine has bodies 0 to 1"),
        (lambda: jv.plane_network(BODIES, [one(to=4, at_other=(0, 0))]), r"machine.supports\[0\].to is 4; the machine has"),
        (lambda: jv.plane_body(mass=1, inertia=1, supports=SUPPORTS), r"supports\[0\].body is 1; the machine has one body"),
        (lambda: one(to=1), "at_other is None and to is 1; a support between two bodies needs both"),
        (lambda: one(to=0, at_other=(0, 0)), "to is 0, the body itself"),
        (lambda: one(body=-1), "body is -1; it must be a whole number, at least 0"),
        (
            lambda: jv.Scene(MACHINE, exciters=[jv.Exciter(BALLS, jv.ConstantSpeed(9.0), body=2)]),
            "body is 2; the machine has b",
        ),
    ],
)
def test_wrong_input_ends_in_one_sentence(make, says):
    with pytest.raises(jv.InputError, match=says):
        make()


def test_levers_are_radii_of_gyration_of_each_body():
    bodies = [jv.body(mass=2000.0, inertia=600.0), jv.body(mass=900.0, inertia=400.0)]
    scene = jv.Scene(jv.plane_network(bodies, SUPPORTS), exciters=[jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.1)])
    radii = np.sqrt([600.0 / 2000.0, 400.0 / 900.0])
    found = jv.mode_shapes(scene)
    np.testing.assert_allclose(found.lever, [1.0, 1.0, radii[0], 1.0, 1.0, radii[1]], rtol=1e-12)
    stiffness, mass = np.asarray(scene.machine.carrier().stiffness), np.asarray(scene.machine.carrier().mass)
    amplitude = (np.asarray(found.shape) / np.asarray(found.lever)).T  # each column is a mode of K x = w^2 M x
    residual = stiffness @ amplitude - mass @ amplitude * np.asarray(found.frequency) ** 2
    np.testing.assert_allclose(residual, 0.0, atol=1e-9 * np.max(stiffness))
