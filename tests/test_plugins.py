"""An effect, a load with two coordinates and a drive from outside the package: what their properties allow runs, the rest is
refused by a sentence that names the property."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plugins.drive import Turbine
from plugins.effect import SealFriction
from plugins.load import TorusPoints
from plugins.machine import Beam
from scenes import jam_rotor_speed, machines, published, rates_at

import jaxvib as jv
from jaxvib.equations.averaged import averaged_field
from jaxvib.machine.loads import CircularLoads
from jaxvib.study.audit.tiers import TIERS

TORQUE = 2e-5


def with_friction():
    scene = published(eps=0.01, speed=3.0).scene()
    return jv.Scene(scene.machine, scene.loads, scene.drive, (SealFriction(TORQUE, 1e-3),))


def on_torus(count=2):
    loads = TorusPoints(0.4, 0.08, 0.02, 0.9, count)
    return jv.Scene(jv.planar_rotor(mass=20.0, stiffness=4e4, damping=60.0), loads, jv.ConstantSpeed(90.0))


class BrakingTorque(SealFriction):
    """A constant torque against the rotation of the loads, which increases their slip."""

    def friction(self, loads, u, rate, speed, g):
        return super().friction(loads, u, rate, speed, g)._replace(lever=jnp.full_like(rate[0], -self.torque))


class QuadraticDrag(CircularLoads):
    """Balls whose drag grows with the square of the speed difference, which no balance of a viscous drag describes."""

    def resistance(self, u, rate, speed):
        slip = speed - rate[0]
        return (self.drag * self.radius**2 * jnp.abs(slip) * slip,)

    def inertia_factor(self):
        return jnp.asarray(1.4)


def with_quadratic_drag():
    balls = jv.balls(count=1, mass=0.4, radius=0.1, drag=1.0)
    loads = QuadraticDrag(**{**vars(balls), "kind": "quadratic_ball"})
    return jv.Scene(machines()["two_mass"], loads, jv.ConstantSpeed(90.0))


def with_turbine():
    drive = Turbine(160.0, stall_torque=3.0, inertia=0.02)
    return jv.Scene(machines()["two_mass"], jv.balls(count=2, mass=0.4, radius=0.1, drag=1.0), drive)


def test_plugin_friction_runs_in_every_tier_with_friction():
    scene = with_friction()
    jam, orbit = jv.jam_modes(scene).select(3), jv.jam_orbit(scene, mode=3)
    # The seal turns the load as well: the drag has less to do than the balance without it says.
    bare = jam_rotor_speed(jv.Scene(scene.machine, scene.loads, scene.drive), jam.omega)
    np.testing.assert_allclose(bare - scene.drive.speed, TORQUE / scene.loads.drag_sum(), rtol=1e-9)
    np.testing.assert_allclose(orbit.omega, jam.omega, rtol=1e-3)
    run = jv.simulate(scene, 100.0, start=jv.State(*orbit.at(0.0)), save="window", estimate=False)
    np.testing.assert_allclose(run.omega, orbit.omega, rtol=1e-8)
    np.testing.assert_allclose(run.amplitude, orbit.amplitude, rtol=1e-7)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_jams_include_constant_torques_of_either_sign(sign):
    scene = with_friction()
    braked = jv.Scene(scene.machine, scene.loads, scene.drive, (BrakingTorque(TORQUE, 1e-3),))
    braked = eqx.tree_at(lambda s: s.all_effects[0].torque, braked, jnp.asarray(sign * TORQUE))
    omega = jv.jam_modes(braked).select(3).omega
    bare = jam_rotor_speed(jv.Scene(scene.machine, scene.loads, scene.drive), omega)
    np.testing.assert_allclose(scene.drive.speed - bare, sign * TORQUE / scene.loads.drag_sum(), rtol=1e-9)


def test_every_tier_answers_or_refuses_by_a_property():
    scene = with_friction()
    light, exact = (tier.jam(scene, 3, 100.0) for tier in TIERS[:2])
    np.testing.assert_allclose(light.omega, exact.omega, rtol=1e-3)
    np.testing.assert_allclose(light.amplitude, exact.amplitude, rtol=0.1)
    for make, answering in (
        (with_friction, [True, True, False, True]),
        (on_torus, [False] * 3 + [True]),
        (with_turbine, [False] * 3 + [True]),
    ):
        refusals = [tier.refusal(make()) for tier in TIERS]
        assert [refusal is None for refusal in refusals] == answering
        assert all("(property " in refusal or "(term " in refusal for refusal in refusals if refusal is not None)


def test_the_power_of_an_effect_from_outside_balances_the_energy():
    scene = with_friction()
    state = jv.State(jnp.asarray([0.1, -0.2]), jnp.asarray([0.3, 0.1]), (jnp.asarray([0.4]),), (jnp.asarray([1.1]),))
    change = rates_at(scene, jnp.asarray(0.0), state)
    rate = jax.jvp(lambda y: jv.energy(scene, y), (state,), (change,))[1]
    supplied, lost = jv.power(scene, jnp.asarray(0.0), state)
    np.testing.assert_allclose(rate, supplied - lost, rtol=1e-11)


def test_two_coordinate_loads_at_the_equator_are_plane_loads():
    scene = on_torus()
    plane = jv.Scene(scene.machine, jv.pendulums(count=2, mass=0.4, radius=0.1, drag=0.9), scene.drive)
    torus, track = (jv.simulate(s, 4.0, save="window", estimate=False) for s in (scene, plane))
    np.testing.assert_allclose(torus.window.state.displacement, track.window.state.displacement, atol=1e-9)
    np.testing.assert_allclose(torus.load_speed, track.load_speed, rtol=1e-7)
    np.testing.assert_allclose(torus.window.state.angle[1], np.pi / 2.0, atol=1e-12)
    assert bool(torus.regime.name == track.regime.name)


def test_two_coordinate_loads_balance_power_in_ensembles():
    scene = on_torus()
    angle, rate = (jnp.asarray([0.1, 2.0]), jnp.asarray([1.2, 1.9])), (jnp.full(2, 40.0), jnp.zeros(2))
    start = jv.State(jnp.asarray([1e-3, 0.0]), jnp.zeros(2), angle, rate)
    change = rates_at(scene, jnp.asarray(0.0), start)
    growth = jax.jvp(lambda y: jv.energy(scene, y), (start,), (change,))[1]
    supplied, lost = jv.power(scene, jnp.asarray(0.0), start)
    np.testing.assert_allclose(growth, supplied - lost, rtol=1e-10)

    def make(across):
        return scene, jv.State(start.displacement, start.velocity, (angle[0], across), rate)

    many = jv.ensemble(make, angle[1][None], 0.5)
    one = jv.simulate(scene, 0.5, start=start, stepsize_controller=jv.Tolerance(1e-10), samples=2, estimate=False)
    np.testing.assert_allclose(many.state.angle[1][0], one.trajectory.state.angle[1][-1], atol=1e-6)


def test_gradients_go_through_loads_with_two_coordinates():
    scene = on_torus(count=1)

    def end(tube):
        loads = TorusPoints(scene.loads.mass, scene.loads.radius, tube, scene.loads.drag, 1)
        given = jv.Scene(scene.machine, loads, scene.drive)
        start = jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.zeros(1), jnp.ones(1)), (jnp.full(1, 30.0), jnp.zeros(1)))
        run = jv.simulate(given, 0.2, start=start, stepsize_controller=jv.EqualSteps(200), samples=2)
        return run.trajectory.state.displacement[-1, 0]

    slope = jax.grad(end)(scene.loads.tube)
    step = 1e-5
    difference = (end(scene.loads.tube + step) - end(scene.loads.tube - step)) / (2.0 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


def test_plugin_motor_turns_the_rotor_and_balances_power():
    scene = with_turbine()
    run = jv.simulate(scene, 3.0, save="all", samples=200, estimate=False)
    last = jax.tree.map(lambda leaf: leaf[-1], run.trajectory.state)
    assert 0.0 < float(last.rotor[1]) < 160.0
    t = jnp.asarray(3.0)
    rate = jax.jvp(lambda y: jv.energy(scene, y, t), (last,), (jv.vector_field(scene)(t, last),))[1]
    supplied, lost = jv.power(scene, t, last)
    np.testing.assert_allclose(rate, supplied - lost, rtol=1e-9)


@pytest.mark.parametrize(
    ("make", "ask", "says"),
    [
        (with_friction, lambda s: averaged_field(s), r"effects.seal_friction .*term ContactFriction"),
        (with_friction, lambda s: jv.phase_jams(s), r"effects.seal_friction .*term ContactFriction"),
        (with_friction, lambda s: jv.balanced_states(s), r"effects.seal_friction .*term ContactFriction"),
        (on_torus, lambda s: jv.jam_modes(s), r"loads.kind is 'torus_point'.*property circular"),
        (on_torus, lambda s: jv.jam_orbit(s, near=50.0), r"loads.kind is 'torus_point'.*property circular"),
        (on_torus, lambda s: jv.initial_state(s, "jam", mode=1), r"loads.kind is 'torus_point'.*property circular"),
        (with_quadratic_drag, lambda s: jv.jam_modes(s), r"loads.kind is 'quadratic_ball'.*viscous drag .property circular"),
        (with_quadratic_drag, lambda s: averaged_field(s), r"loads.kind is 'quadratic_ball'.*property circular"),
        (with_turbine, lambda s: jv.jam_modes(s), r"drive.kind is 'turbine'.*property ideal"),
        (with_turbine, lambda s: averaged_field(s), r"drive.kind is 'turbine'.*property ideal"),
    ],
)
def test_what_a_property_does_not_allow_is_refused_by_its_name(make, ask, says):
    with pytest.raises(jv.InputError, match=says):
        ask(make())


class WithScatter(Beam):
    def carrier(self):
        carrier = super().carrier()
        return eqx.tree_at(lambda each: each.mass, carrier, carrier.mass.at[0, 1].set(0.0))


def test_operation_of_a_part_that_prevents_fmus_is_named(tmp_path):
    loads = jv.balls(count=1, mass=0.4, radius=0.1, drag=1.0)
    scene = jv.Scene(WithScatter(100.0, 12.0, [4e4] * 2, [-0.5, 0.5], 0.0), loads, jv.ConstantSpeed(90.0))
    with pytest.raises(jv.InputError, match=r"needs the operation 'scatter' .* write .* jnp.stack in place of .at\[\].set"):
        jv.export_fmu(scene, tmp_path / "m.fmu")
