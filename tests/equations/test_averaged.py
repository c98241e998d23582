"""The averaged equations against the mean of the full ones, leading-order jams and exact orbits."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gyroscopic_rotor import rotor
from scenes import jam_rotor_speed, machines, published, scene, steady_displacement

import jaxvib as jv
from jaxvib.equations.averaged import Amplitudes, _with_conjugate, amplitudes_of, averaged_field, averaged_model
from jaxvib.equations.linear import linear_model


@eqx.filter_jit
def averaged_change(scene, t, state):
    return averaged_model(linear_model(scene))(jnp.asarray(t), state)


def at_jam(jam):
    return Amplitudes(jam.displacement, 1j * jam.omega * jam.displacement, jam.omega[None], jnp.zeros(1))


def numbers(state):
    y, v = state.displacement, state.velocity
    return jnp.concatenate([y.real, y.imag, v.real, v.imag, state.rate, state.phase])


@pytest.mark.parametrize(("machine", "load"), [("two_mass", "pendulums"), ("network", "balls"), ("rotor", "balls")])
def test_averaged_is_the_mean_of_the_full_equations_over_a_turn(machine, load):
    """Loads of different speeds and phases, and 1e-6 of their mass: what is left of the difference is of that order."""
    s = rotor(0.093, stiffness=(1.1e6, 0.8e6)) if machine == "rotor" else scene(machine, load)
    light = eqx.tree_at(
        lambda x: (x.loads.mass, x.loads.inertia),
        s,
        (s.loads.mass * 1e-6, None if s.loads.inertia is None else s.loads.inertia * 1e-6),
        is_leaf=lambda x: x is None,
    )
    rng, nd, n = np.random.default_rng(3), s.machine.carrier().mass.shape[0], s.loads.count
    y, v = (1e-3 * scale * jnp.asarray(rng.normal(size=(2, nd)).T @ [1.0, 1j]) for scale in (1.0, 25.0))
    phase = rng.uniform(0.0, 6.0, n)
    slow = Amplitudes(y, v, jnp.asarray(rng.uniform(20.0, 30.0, n)), jnp.asarray(phase - np.mean(phase)))
    angles = jnp.arange(16) * 2.0 * jnp.pi / 16

    @eqx.filter_jit
    def derivatives():
        def at(theta):
            wave = jnp.exp(1j * theta)
            state = jv.State((y * wave).real, (v * wave).real, (slow.phase + theta,), (slow.rate,))
            return jv.vector_field(light)(0.0, state)

        return averaged_field(light)(jnp.zeros(()), slow), jax.vmap(at)(angles)

    change, full = derivatives()
    loads, omega = light.loads, jnp.mean(slow.rate)
    free = loads.drag * (light.drive.speed - slow.rate) / (loads.inertia_factor() * loads.mass)
    np.testing.assert_allclose(change.rate - free, jnp.mean(full.rate[0], axis=0) - free, rtol=1e-6)
    acceleration = 2.0 * jnp.mean(full.velocity * jnp.exp(-1j * angles)[:, None], axis=0)
    size = float(jnp.max(jnp.abs(acceleration)))
    np.testing.assert_allclose(change.velocity + 1j * omega * v, acceleration, atol=1e-6 * size)
    np.testing.assert_allclose(change.displacement + 1j * omega * y, v, rtol=1e-12)
    np.testing.assert_allclose(change.phase, slow.rate - omega, rtol=1e-12)


@pytest.mark.parametrize("machine", machines())
def test_equilibria_are_the_leading_order_jams(machine):
    """The averaged equations are at rest at the jams of `jam_rotor_speed`."""
    s = scene(machine, "balls")

    @eqx.filter_jit
    def at(omega):
        jammed = eqx.tree_at(lambda x: x.drive.speed, s, jam_rotor_speed(s, omega))
        y = steady_displacement(s, omega)
        state = Amplitudes(y, 1j * omega * y, jnp.full((3,), omega), jnp.zeros(3))
        field = averaged_field(jammed)
        free = jnp.max(field.drag * (jammed.drive.speed - omega) / field.inertia)
        return field(jnp.zeros(()), state), omega**2 * jnp.max(jnp.abs(y)), free

    for omega in (9.0, 31.0, 75.0):
        change, acceleration, free = at(omega)
        assert float(jnp.max(jnp.abs(change.displacement))) < 1e-12 * float(acceleration)
        assert float(jnp.max(jnp.abs(change.velocity))) < 1e-11 * float(acceleration)
        assert float(jnp.max(jnp.abs(change.rate))) < 1e-10 * float(free)


@eqx.filter_jit
def slope_at(s, jam):
    """The Jacobian of the averaged equations of two platforms and one load."""

    def right(z):
        y0, y1, v0, v1, rate, phase = jnp.split(z, [2, 4, 6, 8, 9])
        return numbers(averaged_field(s)(jnp.zeros(()), Amplitudes(y0 + 1j * y1, v0 + 1j * v1, rate, phase)))

    return jax.jacfwd(right)(numbers(at_jam(jam)))


def test_small_motions_about_a_jam_are_those_of_the_exact_orbit():
    """Each Floquet exponent is an eigenvalue of the averaged equations, up to the first order in the loads' mass."""
    worst = []
    for eps in (2e-3, 1e-3):
        s = published(speed=0.6, eps=eps, damping=0.01).scene()
        orders, modes = [], jv.jam_modes(s)
        for k in (1, 2):
            orbit = jv.jam_orbit(s, mode=k)
            values = np.linalg.eigvals(slope_at(s, modes.select(k)))
            period = 2.0 * np.pi / float(orbit.omega)
            apart = np.abs(np.exp(values * period)[None, :] - np.asarray(orbit.multipliers)[:, None])
            orders.append(np.max(np.min(apart, axis=1)))
            assert (np.max(values.real) > 1e-6) == (not bool(orbit.stable)) == (k == 2)
        worst.append(orders)
    np.testing.assert_allclose(np.asarray(worst[0]) / np.asarray(worst[1]), 2.0, rtol=0.1)
    assert np.max(worst) < 1e-2


def test_a_state_and_its_amplitudes_are_the_same_motion():
    """A platform that vibrates with the loads, faster than half the lowest natural frequency, of 19 and 64 rad/s; and one that
    rings while they rest, with the energy that the state has."""
    s = scene("two_mass", "balls")
    theta = 0.8
    back = eqx.filter_jit(lambda state: amplitudes_of(s, state))
    for omega in (75.0, 12.0):
        y = steady_displacement(s, omega)
        z = y * jnp.exp(1j * theta)
        turning = jv.State(z.real, -omega * z.imag, (jnp.asarray([0.3, 0.9, 1.2]),), (jnp.full(3, omega),))
        slow = back(turning)
        np.testing.assert_allclose(slow.displacement, y, rtol=1e-12)
        np.testing.assert_allclose(slow.velocity, 1j * omega * y, rtol=1e-12)
        np.testing.assert_allclose(slow.phase, [-0.5, 0.1, 0.4], atol=1e-12)

    resting = eqx.tree_at(lambda x: x.rate, turning, (jnp.zeros(3),))
    slow = back(resting)
    q, v = slow.displacement * jnp.exp(1j * theta), slow.velocity * jnp.exp(1j * theta)
    np.testing.assert_allclose(q.real, resting.displacement, rtol=1e-12)
    np.testing.assert_allclose(v.real, resting.velocity, rtol=1e-12)
    mass, stiffness = linear_model(s).mass, s.machine.carrier().stiffness
    np.testing.assert_allclose(v.imag @ mass @ v.imag, q.real @ stiffness @ q.real, rtol=1e-9)
    np.testing.assert_allclose(q.imag @ stiffness @ q.imag, v.real @ mass @ v.real, rtol=1e-9)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_an_equation_with_its_conjugate_is_solved(size):
    a, b, x = np.random.default_rng(size).normal(size=(3, size, size, 2)) @ [1.0, 1.0j]
    x = x[:, 0]
    found = _with_conjugate(jnp.asarray(a), jnp.asarray(b), jnp.asarray(a @ x + b @ np.conj(x)))
    np.testing.assert_allclose(found, x, rtol=1e-12)


def test_ripple_of_a_point_mass_is_its_closed_form():
    """A load m R^2 under m R a cos(2 w t)/2 swings by a/(8 w^2 R); one at rest does not."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    field = averaged_field(jv.Scene(machine, jv.pendulums(count=2, mass=0.3, radius=0.1, drag=0.5), jv.ConstantSpeed(60.0)))
    velocity, w = jnp.asarray([0.03 - 0.04j]), 20.0
    for rate, swing in ((w, w * 0.05 / (8.0 * w**2 * 0.1)), (0.0, 0.0)):
        state = Amplitudes(velocity / (1j * w), velocity, jnp.full(2, rate), jnp.zeros(2))
        np.testing.assert_allclose(field.ripple(state), swing, rtol=1e-12)


def test_ideal_drives_turn_unbalances_at_their_acceleration():
    machine = jv.two_mass(mass=(100.0, 80.0), stiffness=(4e4, 5e4), damping=(60.0, 60.0), link_stiffness=1e5, link_damping=50.0)
    profile = jv.SpeedProfile(times=[0.0, 4.0], speeds=[20.0, 60.0])
    exciters = [
        jv.Exciter(drive=profile, unbalance=0.1, at=1, direction=-1),
        jv.Exciter(drive=jv.ConstantSpeed(35.0), unbalance=0.2, at=2),
        jv.Exciter(drive=profile, loads=jv.balls(count=2, mass=0.5, radius=0.1, drag=0.5), at=2),
    ]
    zero = jnp.zeros(2, complex)
    state = Amplitudes(zero, zero, jnp.asarray([30.0, 35.0, 20.0, 25.0]), jnp.zeros(4))
    change = averaged_change(jv.Scene(machine, exciters=exciters), 1.5, state)
    np.testing.assert_allclose(change.rate[:2], [profile.rotor_acceleration(1.5), 0.0], rtol=1e-12)
    assert float(profile.rotor_acceleration(1.5)) > 5.0


@pytest.mark.parametrize("count", [3, 5])
def test_motors_accelerate_by_torque_and_vibration(count):
    """Up to three exciters the accelerations at their axes are the unknowns, beyond those of the body's three coordinates."""
    springs = [jv.support(at=(x, -0.2), stiffness=(4e5, 7e5), damping=(2e3, 3e3)) for x in (-1.0, 1.1)]
    body = jv.plane_body(mass=200.0, inertia=60.0, supports=springs)
    motors = [jv.DCMotor(100.0 + k, stall_torque=300.0, inertia=0.5) for k in range(count)]
    exciters = [
        jv.Exciter(drive=motor, unbalance=1.5, at=(0.4 * k - 1.0, 0.1 * k), direction=(1, -1)[k % 2])
        for k, motor in enumerate(motors)
    ]
    scene = jv.Scene(body, exciters=exciters)
    rng = np.random.default_rng(0)
    y, v = rng.normal(size=(2, 3, 2)) @ np.array([1e-2, 1e-2j])
    w, psi = 60.0 + rng.normal(size=count), rng.normal(size=count)
    change = averaged_change(scene, 0.0, Amplitudes(*map(jnp.asarray, (y, v, w, psi))))
    acceleration = np.asarray(change.velocity) + 1j * np.mean(w) * v
    carrier, force = scene.machine.carrier(), 0.0
    for k, (exciter, motor) in enumerate(zip(exciters, motors, strict=True)):
        turning = np.array([1.0, -1j * exciter.direction]) @ np.asarray(scene.machine.mount(exciter.place).rows[0])
        local = np.exp(-1j * psi[k]) * (turning.conj() @ acceleration)
        expected = (motor.torque(w[k]) - 1.5 / 2.0 * local.imag) / 0.5
        np.testing.assert_allclose(change.rate[k], expected, rtol=1e-12)
        force = force + turning * 1.5 * np.exp(1j * psi[k]) * (w[k] ** 2 - 1j * np.asarray(change.rate)[k])
    rest = carrier.mass @ acceleration + carrier.damping @ v + carrier.stiffness @ y - force
    np.testing.assert_allclose(rest, 0.0, atol=1e-12 * np.max(np.abs(force)))
