"""Places on machines and mounts of exciters, against the geometry of rigid bodies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rotors import STATIONS, machine
from scenes import loads, machines, rates_at

import jaxvib as jv


def rolled(q, distance):
    """The point of a rigid shaft at a distance from its centre of mass, across and up, after the rotations theta and psi."""
    (ct, cp), (st, sp) = jnp.cos(q[2:]), jnp.sin(q[2:])
    across = jnp.array([[ct, 0.0, st], [0.0, 1.0, 0.0], [-st, 0.0, ct]])
    up = jnp.array([[1.0, 0.0, 0.0], [0.0, cp, sp], [0.0, -sp, cp]])
    return q[:2] + (up @ across @ jnp.array([0.0, 0.0, distance]))[:2]


@pytest.mark.parametrize("name", machines())
def test_rows_of_a_platform_are_those_of_its_height(name):
    body = machines()[name]
    n = len(body.structure().coordinates)
    for platform in range(1, n + 1):
        height = jax.jacfwd(lambda y, k=platform: jnp.stack([y[k - 1]]))(jnp.zeros(n))
        np.testing.assert_array_equal(body.rows_at(platform), height)
    np.testing.assert_array_equal(body.mount().rows[0], body.rows_at(body.exciter))


@pytest.mark.parametrize("stations", [STATIONS, 0.1])
def test_rows_along_a_shaft_are_derivatives_of_its_rotation(stations):
    body = machine(stations)
    for distance in (-0.3, 0.0, 0.28):
        moved = jax.jacfwd(rolled)(jnp.zeros(4), distance)
        np.testing.assert_allclose(body.rows_at(distance), moved, atol=1e-15)


@pytest.mark.parametrize("stations", [STATIONS, 0.1, -0.2])
def test_mount_moves_loads_and_mass_centre_with_the_shaft(stations):
    mount, rate = machine(stations).mount(), jnp.asarray([0.3, -1.0, 2.0, 0.7])
    placed = np.broadcast_to(stations, (4,))
    moved = np.stack([jax.jacfwd(rolled)(jnp.zeros(4), s) for s in placed])
    np.testing.assert_allclose(mount.load_rows(4), moved, atol=1e-15)
    np.testing.assert_allclose(mount.rotor_rows(), jax.jacfwd(rolled)(jnp.zeros(4), 0.0), atol=1e-15)
    np.testing.assert_allclose(mount.distances(4), placed, rtol=1e-15)
    for axis, speed in mount.load_rates(rate).items():
        np.testing.assert_allclose(np.broadcast_to(speed, (4,)), moved[:, axis] @ rate, rtol=1e-14)


class Pair(jv.Machine):
    """Two discs on a shaft, each up and down: loads sit on the one or the other, by levers of 0 and 1."""

    kind: str = eqx.field(static=True, default="pair")

    def carrier(self):
        k = jnp.asarray([[3e4, -1e4], [-1e4, 2e4]])
        return jv.Carrier(jnp.diag(jnp.asarray([20.0, 30.0])), 1e-3 * k, k, k[:1], 1e-3 * k[:1], ("y1", "y2"))

    def mount(self, at=None):
        first, second = jnp.eye(2)[:1], jnp.eye(2)[1:]
        on = jnp.asarray([1.0, 0.0, 1.0])
        return jv.Mount((first, second), (1,), levers=(on, 1.0 - on))


def test_loads_on_two_discs_are_euler_lagrange():
    scene = jv.Scene(Pair(), loads()["balls"], jv.ConstantSpeed(40.0), (jv.Gravity(),))
    rng = np.random.default_rng(4)
    state = jv.State(*(jnp.asarray(x) for x in rng.normal(size=(2, 2))), *((jnp.asarray(x),) for x in rng.normal(size=(2, 3))))
    change = rates_at(scene, 0.0, state)
    m, r, kappa, drag = 0.8, 0.12, 1.4, 1.5 * 0.12**2
    carrier, disc = scene.machine.carrier(), np.array([0, 1, 0])
    x, v = (jnp.concatenate(pair) for pair in ((state.displacement, state.angle[0]), (state.velocity, state.rate[0])))
    a = jnp.concatenate([change.velocity, change.rate[0]])

    def lagrangian(x, v):
        def point(x):
            return jnp.stack([r * jnp.cos(x[2:]), x[disc] + r * jnp.sin(x[2:])])

        speed = jax.jvp(point, (x,), (v,))[1]
        kinetic = (
            0.5 * v[:2] @ carrier.mass @ v[:2] + 0.5 * m * jnp.sum(speed**2) + 0.5 * (kappa - 1.0) * m * r**2 * v[2:] @ v[2:]
        )
        return kinetic - 0.5 * x[:2] @ carrier.stiffness @ x[:2] - m * 9.81 * r * jnp.sum(jnp.sin(x[2:]))

    momentum = jax.jvp(jax.grad(lagrangian, 1), (x, v), (v, a))[1]
    forces = jnp.concatenate([-carrier.damping @ v[:2], drag * (40.0 - v[2:])])
    np.testing.assert_allclose(momentum - jax.grad(lagrangian)(x, v), forces, atol=1e-10 * float(jnp.max(jnp.abs(forces))))


@pytest.mark.parametrize(
    ("body", "place", "message"),
    [
        (machines()["two_mass"], 3, "place is 3; the machine has platforms 1 to 2"),
        (machines()["two_mass"], 0.1, "place is 0.1; the machine has platforms 1 to 2"),
        (machines()["two_mass"], {}, "place is {}; the machine has platforms 1 to 2"),
        (machines()["two_mass"], True, "place is True; the machine has platforms 1 to 2"),
        (machine(), {}, "place is {}, which is not a number; write a number in m"),
        (machine(), float("nan"), "place is nan m; a finite number is needed"),
        (machine(), np.int64(1), "place is 1, which numbers a platform; on a rotor give a position"),
        (machine(), 1, "place is 1, which numbers a platform; on a rotor give a position"),
        (jv.planar_rotor(mass=37.0, stiffness=1e6, damping=8.0), 0.1, "names a place .* has only the place of its exciter"),
    ],
    ids=["no platform", "distance", "object", "Boolean", "rotor", "nan", "NumPy", "platform", "planar"],
)
def test_a_place_that_a_machine_lacks_is_refused(body, place, message):
    with pytest.raises(jv.InputError, match=message):
        body.rows_at(place)
