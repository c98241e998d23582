"""Bodies that move in their plane: matrices, equations of motion, files, and the synchronization of two motors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.numbers.named import numbers_of

T, G = 0.37, 9.81
GRAVITY = (jv.Gravity(),)
SUPPORTS = [
    jv.support(at=(1.2, -0.2), stiffness=(2e5, 4e5), damping=(2e3, 4e3), angle="20 deg"),
    jv.support(at=(-1.1, -0.3), stiffness=(1e5, 3e5), damping=(1e3, 2e3)),
]
SCREEN = jv.plane_body(mass=200.0, inertia=60.0, supports=SUPPORTS)
ROTOR = jv.rotor(
    mass=37.0, transverse_inertia=0.5, polar_inertia=0.1, stiffness=(6e5, 6e5), damping=(400.0, 400.0), position=(0.2, -0.2)
)
DRIVES = (
    jv.DCMotor(100.0, stall_torque=6.0, inertia=0.12),
    jv.InductionMotor(120.0, breakdown_torque=7.0, breakdown_slip=0.2, inertia=0.13),
    jv.ConstantSpeed(60.0),
    jv.SpinUp(90.0, 1.0),
)
PLACES = ((-0.4, 0.3), (0.5, 0.2), (0.1, -0.3))


def exciter(k, drive):
    """Loads, an unbalance or both, in turn, in both directions."""
    loads = None if k % 3 == 1 else jv.balls(count=1 + k % 2, mass=0.4 + 0.1 * k, radius=0.1, drag=0.7)
    unbalance = None if k % 3 == 0 else 0.05 + 0.02 * k
    return jv.Exciter(loads, drive, unbalance=unbalance, at=PLACES[k % 3], direction=(1, -1)[k % 2])


def scene_of(count, kind=0, effects=GRAVITY):
    return jv.Scene(SCREEN, exciters=[exciter(k, DRIVES[(k + kind) % 4]) for k in range(count)], effects=effects)


def state_of(scene, seed=0):
    rng = np.random.default_rng(seed)
    leaves, structure = jax.tree.flatten(jv.initial_state(scene))
    return jax.tree.unflatten(structure, [jnp.asarray(rng.normal(size=np.shape(leaf))) for leaf in leaves])


def point(at, q):
    """Motion of a point of a body that turns by the small angle psi."""
    return jnp.stack([q[0] - q[2] * at[1], q[1] + q[2] * at[0]])


def stored(q):
    """Energy of the springs, each along its own direction."""
    total = 0.0
    for each in SCREEN.supports:
        for j in (0, 1):
            angle = each.angle + 0.5 * jnp.pi * j
            along = point(each.at, q) @ jnp.stack([jnp.cos(angle), jnp.sin(angle)])
            total += 0.5 * each.stiffness[j] * along**2
    return total


def dissipated(v):
    total = 0.0
    for each in SCREEN.supports:
        for j in (0, 1):
            angle = each.angle + 0.5 * jnp.pi * j
            total += 0.5 * each.damping[j] * (point(each.at, v) @ jnp.stack([jnp.cos(angle), jnp.sin(angle)])) ** 2
    return total


def residual(scene, state, change):
    """Equations of Lagrange in the fixed frame. The torque of each drive acts on its rotor, and on the body against it."""
    x, v, a, parts = [state.displacement], [state.velocity], [change.velocity], []
    place = 3
    for e, own, rates in zip(scene.exciters, state.exciters, change.exciters, strict=True):
        turn = own.rotor or [e.direction * of(T) for of in (e.drive.angle_at, e.drive.speed_at)]
        spin = e.direction * e.drive.acceleration_at(T) if own.rotor is None else rates.rotor[1]
        n = 0 if e.loads is None else e.loads.count
        x += [*own.angle, jnp.reshape(turn[0], 1)]
        v += [*own.rate, jnp.reshape(turn[1], 1)]
        a += [*rates.rate, jnp.reshape(spin, 1)]
        parts.append((e, slice(place, place + n), place + n))
        place += n + 1
    x, v, a = map(jnp.concatenate, (x, v, a))

    def kinetic(x, v):
        total = 0.5 * (SCREEN.mass * (v[0] ** 2 + v[1] ** 2) + SCREEN.inertia * v[2] ** 2)
        for e, balls, rotor in parts:
            moved = point(e.at, v)
            if e.loads is not None:
                m, r, phi, rate = e.loads.mass, e.loads.radius, x[balls], v[balls]
                own = jnp.stack([-r * rate * jnp.sin(phi), r * rate * jnp.cos(phi)])
                total += 0.5 * jnp.sum(m * (own + moved[:, None]) ** 2) + 0.2 * m * r**2 * jnp.sum(rate**2)
            if e.unbalance is not None:
                total += e.unbalance * v[rotor] * (-jnp.sin(x[rotor]) * moved[0] + jnp.cos(x[rotor]) * moved[1])
            if not e.drive.ideal:
                total += 0.5 * e.drive.inertia * v[rotor] ** 2
        return total

    def potential(x):
        total = stored(x[:3])
        for e, balls, rotor in parts:
            if e.loads is not None:
                total += G * e.loads.mass * e.loads.radius * jnp.sum(jnp.sin(x[balls]))
            if e.unbalance is not None:
                total += G * e.unbalance * jnp.sin(x[rotor])
        return total

    force = jnp.zeros_like(v).at[:3].set(-jax.grad(dissipated)(v[:3]))
    for e, balls, rotor in parts:
        if e.loads is not None:
            drag = e.loads.drag * e.loads.radius**2 * (v[rotor] - v[balls])
            force = force.at[balls].add(drag).at[rotor].add(-jnp.sum(drag))
    inertial = jax.jvp(jax.grad(kinetic, 1), (x, v), (v, a))[1]
    left = inertial - jax.grad(kinetic)(x, v) + jax.grad(potential)(x) - force
    scale = jnp.max(jnp.abs(inertial)) + jnp.max(jnp.abs(force))
    wrong = [left[balls] for _, balls, _ in parts]
    body = left[:3]
    for e, _, rotor in parts:
        torque = left[rotor]  # what the drive of a rotor has to give, if it is ideal
        if not e.drive.ideal:
            torque = e.direction * e.drive.torque(e.direction * (v[rotor] - v[2]))
            wrong.append((left[rotor] - torque)[None])
        body = body.at[2].add(torque)
    return jnp.concatenate([body, *wrong]) / scale


@pytest.mark.parametrize(("count", "kind"), [(1, 0), (1, 2), (1, 3), (2, 0), (3, 0), (3, 1), (3, 2), (8, 0)])
def test_equations_of_motion_are_euler_lagrange(count, kind):
    scene = scene_of(count, kind)
    state = state_of(scene)
    wrong = jax.jit(lambda y: residual(scene, y, jv.vector_field(scene)(T, y)))(state)
    np.testing.assert_allclose(wrong, 0.0, atol=1e-12)


@pytest.mark.parametrize("kind", range(4))
def test_energy_changes_by_the_power_of_the_drives(kind):
    scene = scene_of(3, kind)
    state = state_of(scene, 1)

    @jax.jit
    def balance(state):
        change = jv.vector_field(scene)(T, state)
        rate = jax.jvp(lambda y, t: jv.energy(scene, y, t), (state, T), (change, 1.0))[1]
        return rate, jv.power(scene, T, state)

    rate, (given, lost) = balance(state)
    np.testing.assert_allclose(rate, given - lost, rtol=1e-12, atol=1e-12 * float(abs(given) + abs(lost)))


def test_foundation_force_balances_the_springs_and_dampers():
    rng = np.random.default_rng(3)
    q, v = jnp.asarray(rng.normal(size=(2, 3)))
    found = SCREEN.carrier().foundation_force(q, v)
    np.testing.assert_allclose(found, (jax.grad(stored)(q) + jax.grad(dissipated)(v))[:2], rtol=1e-12)


@pytest.mark.parametrize("kind", range(4))
def test_foundation_moment_balances_the_moments_of_inertia(kind):
    """d'Alembert: the moments of all accelerated masses about any point, and that on the foundation, have the sum 0."""
    scene, about = scene_of(3, kind, effects=()), np.array([0.7, -0.4])
    state = state_of(scene, 1)
    change = jax.jit(lambda s: jv.vector_field(scene)(T, s))(state)
    cross = lambda a, b: a[0] * b[1] - a[1] * b[0]  # noqa: E731
    x, y, psi = np.asarray(change.velocity)
    total = 60.0 * psi + cross(-about, 200.0 * np.array([x, y]))
    for exciter, own, rates in zip(scene.exciters, state.exciters, change.exciters, strict=True):
        at, time = np.asarray(exciter.at), jnp.asarray(T)
        axis = np.array([x - at[1] * psi, y + at[0] * psi])
        drive = exciter.turning_drive
        turning = []
        if exciter.unbalance is not None:
            inertia, change_of_speed = (0.0, drive.rotor_acceleration(time)) if own.rotor is None else (1.0, rates.rotor[1])
            inertia *= float(getattr(exciter.drive, "inertia", 0.0))
            angle, speed = drive.rotor_angle(time, own.rotor), drive.rotor_speed(time, own.rotor)
            turning.append((exciter.unbalance, inertia, 0.0, angle, speed, change_of_speed))
        elif own.rotor is not None:
            total += float(exciter.drive.inertia) * float(rates.rotor[1])
        if exciter.loads is not None:
            m, r = float(exciter.loads.mass), float(exciter.loads.radius)
            of_loads = zip(own.angle[0], own.rate[0], rates.rate[0], strict=True)
            turning += [(m * r, 1.4 * m * r**2, m, *map(float, each)) for each in of_loads]
        for s, inertia, mass, angle, speed, change_of_speed in turning:
            out, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
            total += inertia * change_of_speed + s * cross(out, axis)
            total += cross(at - about, mass * axis + s * (change_of_speed * along - speed**2 * out))
    found = float(jv.foundation_moment(scene, state, about=tuple(about)))
    np.testing.assert_allclose(found, -float(total), rtol=1e-11)


def test_foundation_moment_is_equal_in_all_tiers():
    springs = [jv.support(at=(x, -0.2), stiffness=(2e4, 3e4), damping=(300.0, 300.0), angle=0.3) for x in (-0.8, 0.7)]
    body = jv.plane_body(mass=200.0, inertia=60.0, supports=springs)
    motors = [jv.DCMotor(n, stall_torque=40.0, inertia=0.12) for n in (100.0, 100.2)]
    parts = zip(motors, PLACES, (1, -1), strict=False)
    scene = jv.Scene(body, exciters=[jv.Exciter(drive=d, unbalance=0.05, at=at, direction=way) for d, at, way in parts])
    regime = jv.synchronous_regimes(scene).select(0)
    assert bool(regime.stable)
    orbit = jv.synchronous_orbit(scene, regime)
    runs = [tier(scene, 40.0, save="window") for tier in (jv.simulate, jv.envelope)]
    states = jax.vmap(orbit.at)(2.0 * jnp.pi * jnp.arange(64) / 64.0)
    moments = jax.vmap(lambda state: jv.foundation_moment(scene, state, about=(0.2, 0.1)))(states)
    expected = float(jnp.ptp(moments)) / 2.0
    for result in (regime, orbit, *runs):
        np.testing.assert_allclose(result.foundation_moment(about=(0.2, 0.1)), expected, rtol=1e-2)


def test_foundation_moment_that_overflows_has_a_status():
    support = jv.support(at=(0.5, 0.0), stiffness=(1e5, 1e5), damping=(1e3, 1e3))
    exciter = jv.Exciter(drive=DRIVES[0], unbalance=0.05)
    scene = jv.Scene(jv.plane_body(mass=100.0, inertia=20.0, supports=[support]), exciters=[exciter])
    with pytest.raises(jv.ComputationError, match=r"^overflow: parts of the foundation moment are not finite"):
        jv.foundation_moment(scene, jv.initial_state(scene), about=(1e308, 0.0))


def test_foundation_moment_of_other_machines_is_refused():
    exciter = jv.Exciter(drive=DRIVES[0], unbalance=0.05)
    with pytest.raises(jv.InputError, match="defined for bodies in a plane"):
        scene = jv.Scene(ROTOR, exciters=[exciter])
        jv.foundation_moment(scene, jv.initial_state(scene))
    pair = [jv.support(at=(0.0, 0.0), stiffness=(1e5, 1e5), damping=(1e3, 1e3), body=k) for k in (0, 1)]
    network = jv.plane_network([jv.body(mass=100.0, inertia=20.0)] * 2, pair)
    scene = jv.Scene(network, exciters=[exciter])
    with pytest.raises(jv.InputError, match="has the bodies 0 and 1 on the foundation"):
        jv.foundation_moment(scene, jv.initial_state(scene))


def test_scene_file_round_trip_is_bit_for_bit():
    scene = scene_of(3)
    assert eqx.tree_equal(jv.scene_from_toml(jv.scene_to_toml(scene)), scene)
    assert "[[machine.supports]]" in jv.scene_to_toml(scene) and "at = [" in jv.scene_to_toml(scene)


def test_numbers_of_supports_and_places_have_names():
    names = numbers_of(scene_of(2))
    assert names["machine.supports[1].stiffness[0]"].unit == "N/m" and "machine.inertia" in names
    assert names["exciters[0].at"].unit == "m"


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: jv.plane_body(mass=1.0, inertia=1.0, supports=[]), r"machine.supports is \[\]; it must be a list"),
        (lambda: jv.plane_body(mass=1.0, inertia=0.0, supports=SUPPORTS), "machine.inertia is 0 kg m\\^2; it must be greater"),
        (lambda: jv.plane_body(mass=1.0, inertia=1.0, supports=[3]), r"machine.supports\[0\] is 3; it must be a support"),
        (lambda: jv.support(at=1.0, stiffness=(1, 1), damping=(0, 0)), "at is 1.0; it must be a list of 2 numbers, in m"),
        (lambda: jv.support(at=(0, 0), stiffness=(1, -1), damping=(0, 0)), r"stiffness\[1\] is -1 N/m; it must be at least 0"),
        (
            lambda: jv.Scene(SCREEN, exciters=[jv.Exciter(drive=DRIVES[0], unbalance=1.0, at=2)]),
            r"at has 1 number; on a body in a plane give \(x, y\)",
        ),
        (lambda: jv.Scene(ROTOR, exciters=[jv.Exciter(drive=DRIVES[0], unbalance=1.0, at=(1, 2))]), "a point of a body; on a"),
        (lambda: jv.Scene(SCREEN, exciters=[jv.Exciter(drive=DRIVES[0], unbalance=1.0, at=(1, 2, 3))]), "at has 3 values; 2"),
        (lambda: jv.Exciter(drive=DRIVES[0], unbalance=1.0, at=range(10**9)), "at is range"),
        (lambda: jv.Exciter(drive=DRIVES[0], unbalance=1.0, direction=np.zeros(2)), "direction is array"),
        (lambda: scene_of(1, effects=(jv.Stop(1e5, gap=0.01),)), "effects.stop acts on a platform"),
        (
            lambda: jv.jam_modes(jv.Scene(SCREEN, jv.balls(count=1, mass=0.1, radius=0.1, drag=1.0), DRIVES[2])),
            "rotates with the housing",
        ),
    ],
)
def test_wrong_input_ends_in_one_sentence(make, says):
    with pytest.raises(jv.InputError, match=says):
        make()


def soft(distance, directions, mass=300.0, inertia=75.0):
    """Two equal motors on opposite sides of the centre of a body on soft springs, each at `distance` from it."""
    springs = [jv.support(at=(x, 0.0), stiffness=(3e3, 3e3), damping=(150.0, 150.0)) for x in (-0.6, 0.6)]
    body = jv.plane_body(mass=mass, inertia=inertia, supports=springs)
    motor = jv.InductionMotor(100.0, breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.05)
    places = [(-distance, 0.0), (distance, 0.0)]
    exciters = [
        jv.Exciter(drive=motor, unbalance=0.4, at=at, direction=way) for at, way in zip(places, directions, strict=True)
    ]
    return jv.Scene(body, exciters=exciters)


def last_phase(scene):
    """Difference of the rotor angles, each in its direction, after 20 s, from a start a quarter of a turn apart."""
    state = jv.initial_state(scene)
    angles, ways = (0.0, 1.5), [e.direction for e in scene.exciters]
    own = [
        eqx.tree_at(lambda s: s.rotor, each, (jnp.asarray(way * angle), jnp.asarray(way * 98.0)))
        for each, angle, way in zip(state.exciters, angles, ways, strict=True)
    ]
    state = eqx.tree_at(lambda s: s.exciters, state, tuple(own))
    run = jv.simulate(scene, 20.0, start=state, save="window")
    rotor = [way * each.rotor[0][-1] for each, way in zip(run.window.state.exciters, ways, strict=True)]
    return float(jnp.angle(jnp.exp(1j * (rotor[1] - rotor[0]))))


@pytest.mark.parametrize(("distance", "expected"), [(0.9, 0.0), (0.3, np.pi)])
def test_equal_motors_run_in_phase_if_far_apart(distance, expected):
    """They run in phase if M l^2 > 2 J, l > 0.707 m here; against each other if it is less: Blekhman 1988, soft supports."""
    assert abs(abs(last_phase(soft(distance, (1, 1)))) - expected) < 0.03


def test_opposite_motors_drive_a_straight_line():
    """alpha_2 - alpha_1 = -(d_1 + d_2) for axes at polar angles d_1 = pi, d_2 = 0: half a turn, a vertical line."""
    assert abs(abs(last_phase(soft(0.6, (1, -1)))) - np.pi) < 0.03
