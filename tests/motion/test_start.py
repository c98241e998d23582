"""Starts of runs: at rest, in a jam, with a spin-up, from a given state."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, rates_at, scene
from small_machine import small_machine

import jaxvib as jv
from jaxvib.machine.validation import start_notes


def test_a_mode_that_is_not_there_is_no_start():
    with pytest.raises(
        jv.ComputationError, match=r"jam mode 1 does not exist at rotor speed 28.6479 rpm; existing modes: 3, 4, 5"
    ):
        jv.simulate(published().scene(), 10.0, start="jam", mode=1)


def test_spin_up_of_a_drive_that_spins_up_is_refused():
    with pytest.raises(jv.InputError, match="needs a constant speed, but the drive is 'spin_up'; start at 'rest'"):
        jv.simulate(small_machine(drive=jv.SpinUp(3.0, 2.0)), 5.0, start="spin_up")


def test_spin_up_starts_at_rest_and_ends_at_speed():
    run = jv.simulate(small_machine(), 10.0, start="spin_up", spin_up=4.0, samples=11)
    np.testing.assert_allclose(run.trajectory.rotor_speed[jnp.asarray([0, 2, 4, 10])], [0.0, 1.5, 3.0, 3.0], atol=1e-12)
    assert float(jnp.max(jnp.abs(run.trajectory.state.rate[0][0]))) == 0.0


def test_a_complete_start_state_excludes_a_mode():
    s = published(eps=1e-3).scene()
    with pytest.raises(jv.InputError, match="leave it out"):
        jv.simulate(s, 1.0, start=jv.initial_state(s), mode=3)


def test_platforms_of_a_jam_start_with_the_loads_angle():
    s = published(eps=1e-3).scene()
    turned, plain = (jv.initial_state(s, "jam", mode=3, angles=a) for a in (2.0 * np.pi, 0.0))
    np.testing.assert_allclose(turned.displacement, plain.displacement, rtol=1e-10)
    quarter = jv.initial_state(s, "jam", mode=3, angles=np.pi / 2)
    np.testing.assert_allclose(quarter.displacement, plain.velocity / jv.jam_modes(s).select(3).omega, rtol=1e-10)


def test_a_state_of_another_machine_is_refused():
    state = jv.initial_state(scene("one_mass", "rollers"))
    with pytest.raises(jv.InputError, match=r"start.displacement has shape \(1,\); this scene needs \(2,\)"):
        jv.simulate(published().scene(), 1.0, start=state)
    with pytest.raises(jv.InputError, match=r"goes with|drive is 'spin_up'|starts at another speed"):
        jv.initial_state(eqx.tree_at(lambda s: s.drive, published().scene(), jv.SpinUp(3.0, 1.0)), "jam", mode=3)


def test_a_displacement_per_coordinate_is_refused():
    state = jv.initial_state(published().scene())
    state = eqx.tree_at(lambda s: s.displacement, state, (state.displacement, state.displacement))
    with pytest.raises(jv.InputError, match=r"start.displacement has 2 arrays; one array of shape \(2,\) is needed$"):
        jv.simulate(published().scene(), 1.0, start=state)


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        (dict(angle=jnp.zeros(1)), r"^start.angle is Array.*; it must be a tuple of arrays, \(array,\)"),
        (dict(rate=[jnp.zeros(1)]), r"^start.rate is \[Array.*; it must be a tuple of arrays"),
        (
            dict(angle=(jnp.zeros(1) + 0j,)),
            r"^start.angle is Array\(\[0.\+0.j\].*, which is not a number; write a number in SI",
        ),
    ],
)
def test_states_of_other_types_are_refused(parts, says):
    s = scene("one_mass", "rollers")
    state = jv.State(jnp.zeros(1), jnp.zeros(1), **{"angle": (jnp.zeros(1),), "rate": (jnp.zeros(1),), **parts})
    with pytest.raises(jv.InputError, match=says):
        jv.simulate(s, 1.0, start=state)


def test_touching_loads_start_a_jam_side_by_side():
    """A start in a jam lays touching loads side by side about the jam's angle."""
    s = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        jv.balls(count=3, mass=0.2, radius=0.1, drag=0.15, ball_radius=0.005),
        jv.ConstantSpeed(60.0),
        (jv.LoadContact(stiffness=1e5),),
    )
    start = jv.initial_state(s, "jam", mode=1)
    np.testing.assert_allclose(np.diff(start.angle[0]), 2.0 * np.arcsin(0.05), rtol=1e-12)
    np.testing.assert_allclose(jnp.mean(start.angle[0]), 0.0, atol=1e-12)


def test_impossible_starts_name_an_alternative():
    effects = (jv.CubicSupport(1e9), jv.Stop(1e6, gap=1e-3))
    for ask in (lambda s: jv.simulate(s, 1.0, start="jam", mode=3), lambda s: jv.settle(s, mode=3)):
        with pytest.raises(jv.InputError) as error:
            ask(scene(effects=effects))
        assert str(error.value) == (
            "start is 'jam', but effects cubic_support and stop are not included in this function (term SupportForce); "
            "start at 'rest', or from a State"
        )
    loads, drive = scene().loads, scene().drive
    clockwise, twice = [jv.Exciter(loads, drive, direction=-1)], 2 * [jv.Exciter(loads, drive)]
    for exciters, problem in ((clockwise, r"scene\.exciters\[0\]\.direction is -1"), (twice, "scene has 2 exciters")):
        with pytest.raises(jv.InputError, match=f"^start is 'jam', but {problem}; start at 'rest', or from a State$"):
            jv.initial_state(jv.Scene(scene().machine, exciters=exciters), "jam", mode=3)
    with pytest.raises(jv.InputError, match=r"separation is 0\.1; it is used only with named starts"):
        jv.simulate(scene(), 1.0, start=jv.initial_state(scene()), separation=0.1)
    np.testing.assert_allclose(jv.initial_state(scene(), separation="3 deg").azimuth, -np.pi / 2 + np.deg2rad([-3.0, 0.0, 3.0]))


@pytest.mark.parametrize("angle", [1e16, -1e308, float("inf"), float("nan")])
def test_angles_without_digits_in_a_turn_are_refused(angle):
    s, says = scene(), r"is .*; (it must be (below 4\.5e\+15 rad|a number)|a finite number)"
    for start in (dict(start="rest"), dict(start="jam", mode=3)):
        with pytest.raises(jv.InputError, match=f"^angles {says}"):
            jv.initial_state(s, **start, angles=angle)
    with pytest.raises(jv.InputError, match=f"^theta {says}"):
        jv.jam_orbit(s, mode=3, points=16).at(angle)


def test_the_motion_at_an_angle_takes_one_angle():
    with pytest.raises(jv.InputError, match=r"^theta has shape \(2,\); one number in rad is needed"):
        jv.jam_orbit(scene(), mode=3, points=16).at([0.0, 1.0])


@pytest.mark.parametrize("direction", [1, -1])
def test_unbalances_of_motors_hang_where_gravity_acts(direction):
    motor, ideal = jv.DCMotor(100.0, stall_torque=30.0, inertia=0.5), jv.ConstantSpeed(100.0)
    exciters = [jv.Exciter(drive=drive, unbalance=0.4, direction=direction) for drive in (motor, ideal)]
    machine = jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0)
    hanging = jv.initial_state(jv.Scene(machine, exciters=exciters, effects=jv.Gravity()))
    assert [own.rotor and float(own.rotor[0]) for own in hanging.exciters] == [-0.5 * np.pi, None]
    rates = rates_at(jv.Scene(machine, exciters=exciters, effects=jv.Gravity()), 0.0, hanging)
    np.testing.assert_allclose(rates.exciters[0].rotor[1], direction * 30.0 / 0.5, rtol=1e-12)
    assert float(jv.initial_state(jv.Scene(machine, exciters=exciters)).exciters[0].rotor[0]) == 0.0


@pytest.mark.parametrize(("share", "passes"), [(0.72, False), (0.73, True)])
def test_motor_of_constant_torque_passes_the_top_above_a_limit(share, passes):
    """The work of the torque from the lowest point is S g (1 - cos x) at the limit: max (1 - cos x)/x = 0.72461."""
    motor = jv.DCMotor(1e4, stall_torque=share * 0.4 * 9.80665, inertia=0.5)
    machine = jv.one_mass(mass=1e7, stiffness=1e10, damping=1e6)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=0.4)], effects=jv.Gravity())
    run = jv.simulate(scene, "10 s", estimate=False)
    assert (float(jnp.max(run.trajectory.rotor_angle)) > 1.5 * np.pi) == passes
    assert bool(start_notes(scene)) != passes
