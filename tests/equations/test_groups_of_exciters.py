"""Exciters of equal structure that are computed as one group, against the same exciters one by one."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.equations import model
from jaxvib.equations.dynamics import dynamics_of
from jaxvib.equations.linear import linear_model
from jaxvib.equations.model import assemble
from jaxvib.equations.torque_balance import resultant_of
from jaxvib.machine.drives.drive import Directed

SUPPORTS = [jv.support(at=(x, -0.2), stiffness=(4e5, 7e5), damping=(2e3, 3e3)) for x in (-1.0, 1.1)]
BODY = jv.plane_body(mass=2000.0, inertia=600.0, supports=SUPPORTS)
PLANAR = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
TWELVE = jv.network(
    mass=[40.0 + k for k in range(12)],
    stiffness=[2e4] * 12,
    damping=[20.0] * 12,
    links=[(k, k + 1) for k in range(1, 12)],
    link_stiffness=[1e5] * 11,
    link_damping=[20.0] * 11,
    exciter=1,
)


def dc(k):
    return jv.DCMotor(100.0 + k, stall_torque=6.0 + k, inertia=0.2 + 0.01 * k)


def electrical(k):
    circuit = jv.InductionMotorElectrical(400.0, 314.0, 2, 1.0, 1.0, 0.005, 0.005, 0.15, inertia=0.2)
    return eqx.tree_at(lambda motor: motor.rotor_resistance, circuit, jnp.asarray(1.0 + 0.1 * k))


def loads(k, kind=jv.balls):
    return kind(count=2, mass=0.4 + 0.01 * k, radius=0.1 + 0.001 * k, drag=0.7)


def motors(n, drive=dc, direction=lambda k: (1, -1)[k % 2]):
    """Exciters with unbalances at different places of the body."""
    at = [(-1.0 + 0.03 * k, 0.1 * (k % 3)) for k in range(n)]
    return [jv.Exciter(None, drive(k), unbalance=0.3 + 0.01 * k, at=at[k], direction=direction(k)) for k in range(n)]


def clockwise(k):
    return -1


def torus(k):
    return jv.torus_balls(count=2, mass=0.1 + 0.01 * k, radius=0.2, tube=0.015, ball_radius=0.0145)


LOADED = [jv.Exciter(loads(k), dc(k), unbalance=0.1 + 0.01 * k, at=1 + k) for k in range(8)]
IDEAL = [jv.Exciter(loads(k), jv.SpinUp(90.0 + k, 1.0), at=(0.1 * k, 0.4), direction=clockwise(k)) for k in range(8)]
DRY = [jv.Exciter(loads(k, jv.pendulums), jv.ConstantSpeed(80.0 + k), effects=[jv.DryFriction(0.002, 0.02)]) for k in range(8)]
ROLLS = (jv.RollingFriction(3e-5), jv.FreeSpin(), jv.Sliding(0.2))
SLIDING = [jv.Exciter(torus(k), jv.ConstantSpeed(60.0 + k), effects=ROLLS) for k in range(8)]
MIXED = [jv.Exciter(loads(k), dc(k), unbalance=0.1 + 0.01 * k, direction=(1, -1)[k % 2]) for k in range(8)]
SCENES = {
    "unbalances": jv.Scene(BODY, exciters=motors(8, direction=clockwise), effects=jv.Gravity()),
    "two kinds": jv.Scene(BODY, exciters=[*motors(8, direction=clockwise), *motors(1, electrical)]),
    "both directions": jv.Scene(BODY, exciters=motors(64)),
    "mixed loads": jv.Scene(PLANAR, exciters=MIXED, effects=jv.Gravity()),
    "currents": jv.Scene(BODY, exciters=motors(8, electrical, clockwise)),
    "ideal drives": jv.Scene(BODY, exciters=[*IDEAL, *motors(8, lambda k: jv.ConstantSpeed(60.0 + k), clockwise)][::-1]),
    "more coordinates than rows": jv.Scene(TWELVE, exciters=LOADED, effects=[jv.Gravity(), jv.Stop(1e5, gap=0.01)]),
    "dry friction": jv.Scene(PLANAR, exciters=DRY, effects=jv.Gravity()),
    "sliding": jv.Scene(PLANAR, exciters=SLIDING, effects=jv.Gravity(along="axis")),
}


def state_of(scene):
    rng = np.random.default_rng(0)
    leaves, structure = jax.tree.flatten(jv.initial_state(scene, "rest"))
    return jax.tree.unflatten(structure, [jnp.asarray(rng.normal(size=np.shape(leaf))) for leaf in leaves])


def close(found, expected, error=1e-13):
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=error, atol=error * max(np.max(np.abs(y), initial=0.0), 1.0))


def rate(scene, state):
    return jv.vector_field(scene)(jnp.asarray(0.3), state)


@pytest.mark.parametrize("name", SCENES)
def test_groups_have_the_rates_of_single_exciters(name, monkeypatch):
    scene = SCENES[name]
    state = state_of(scene)
    assert max(len(group.members) for group in jv.vector_field(scene).groups) >= 8
    found = jax.jit(lambda y: rate(scene, y))(state)
    monkeypatch.setattr(model, "_MIN_GROUP_SIZE", 1000)
    assert all(len(group.members) == 1 for group in jv.vector_field(scene).groups)
    close(found, jax.jit(lambda y: rate(scene, y))(state))


def test_fences_reduce_the_operations_of_a_group():
    """Without fences XLA computes sines (jax 0.10) or other values (jax 0.12) again for each use."""
    scene = jv.Scene(BODY, exciters=motors(32))
    state, field = state_of(scene), jv.vector_field(scene)

    def operations(field):
        return jax.jit(lambda y: field(jnp.asarray(0.3), y)).lower(state).compile().cost_analysis()["flops"]

    assert field.has_fences and operations(field) < 0.7 * operations(dataclasses.replace(field, has_fences=False))


@pytest.mark.parametrize("derivative", [False, True])
def test_loops_over_groups_call_no_library(derivative):
    """XLA does not compile a loop with library calls into one function; derivatives of runs then take many times as long."""
    field = dynamics_of(assemble(jv.Scene(PLANAR, exciters=MIXED, effects=jv.Gravity())))
    state = jv.initial_state(jv.Scene(PLANAR, exciters=MIXED), "rest")

    def step(_, y):
        if not derivative:
            return field(jnp.asarray(0.3), y)
        value, back = jax.vjp(lambda y: field(jnp.asarray(0.3), y), y)
        return back(value)[0]

    program = jax.jit(lambda y: jax.lax.fori_loop(0, 9, step, y)).lower(state).compile().as_text()
    assert " while(" in program and "ynn_fusion" not in program and "custom-call" not in program


def test_directions_do_not_divide_a_group():
    for name in ("both directions", "mixed loads"):
        (group,) = jv.vector_field(SCENES[name]).groups
        assert isinstance(group.part.drive, Directed) and group.part.drive.direction.tolist()[:3] == [1.0, -1.0, 1.0]
    kinds = jv.vector_field(jv.Scene(BODY, exciters=[*motors(8, direction=clockwise), *motors(1, electrical)])).groups
    assert [isinstance(group.part.drive, Directed) and group.part.drive.direction for group in kinds] == [None, False]


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("more coordinates than rows", "dry friction")]


@pytest.mark.parametrize("name", ["two kinds", *SLOW])
def test_groups_have_the_derivatives_of_single_exciters(name, monkeypatch):
    scene = SCENES[name]
    state = state_of(scene)

    @jax.jit
    def slopes(scene, state):
        value, back = jax.vjp(rate, scene, state)
        ones = jax.tree.map(jnp.ones_like, (scene, state))
        return jax.jvp(rate, (scene, state), ones)[1], back(jax.tree.map(jnp.ones_like, value))

    found = slopes(scene, state)
    monkeypatch.setattr(model, "_MIN_GROUP_SIZE", 1000)
    jax.clear_caches()
    close(found, slopes(scene, state), 1e-12)


def test_the_resultant_of_exciters_is_the_sum_of_their_forces():
    """Unbalances S_j at the angles theta + alpha_j, one of which turns backward."""
    springs = [jv.support(at=(x, -0.2), stiffness=(2e5, 4e5), damping=(2e3, 4e3)) for x in (-1.0, 1.0)]
    drive, size, phases, turns = jv.ConstantSpeed(60.0), np.array([0.7, 0.4]), np.array([0.3, 1.1]), (1, -1)
    exciters = [
        jv.Exciter(drive=drive, unbalance=own, at=(x, 0.3), direction=way)
        for own, x, way in zip(size, (-0.5, 0.5), turns, strict=True)
    ]
    scene = jv.Scene(jv.plane_body(mass=200.0, inertia=60.0, supports=springs), exciters=exciters)
    found = np.asarray(resultant_of(linear_model(scene), jnp.exp(1j * phases)))
    theta = np.linspace(0.0, 6.0, 25)[:, None]
    across, up = size * np.cos(theta + phases), size * turns * np.sin(theta + phases)
    np.testing.assert_allclose(np.real(np.exp(1j * theta) * found), np.stack([across.sum(1), up.sum(1)], axis=1), atol=1e-12)


def test_a_run_of_a_group_is_that_of_single_exciters(monkeypatch):
    """Eight equal motors that start from rest, with equal steps; the first turns of the motors are not chaotic."""
    motor = jv.DCMotor(100.0, stall_torque=40.0, inertia=0.2)
    at = [(-1.0 + 0.28 * k, 0.1 * (k % 3)) for k in range(8)]
    exciters = [jv.Exciter(drive=motor, unbalance=0.3, at=at[k], direction=(1, -1)[k % 2]) for k in range(8)]
    scene = jv.Scene(BODY, exciters=exciters, effects=jv.Gravity())

    @jax.jit
    def run(start):
        found = jv.simulate(
            scene, 0.5, start=start, stepsize_controller=jv.EqualSteps(400), save="window", estimate=False, throw=False
        )
        return found.window.state, found.foundation_force

    start = jv.initial_state(scene)
    assert len(jv.vector_field(scene).groups) == 1
    grouped = run(start)
    assert float(jnp.max(jnp.abs(grouped[0].exciters[0].rotor[1]))) > 10.0
    monkeypatch.setattr(model, "_MIN_GROUP_SIZE", 1000)
    assert len(jv.vector_field(scene).groups) == 8
    jax.clear_caches()
    close(grouped, run(start), 1e-10)
