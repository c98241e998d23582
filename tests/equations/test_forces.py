"""Energy and power."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rotors import CASES, case, rotor_state
from scenes import rates_at

import jaxvib as jv


@pytest.mark.parametrize("name", CASES)
def test_energy_changes_by_the_power_that_comes_and_goes(name):
    s = case(name)
    state, t = rotor_state(s, 3), jnp.asarray(0.7)
    field = rates_at(s, t, state)
    _, change = jax.jvp(functools.partial(jv.energy, s), (state, t), (field, jnp.ones_like(t)))
    supplied, lost = jv.power(s, t, state)
    size = abs(float(supplied)) + abs(float(lost))
    assert float(lost) > 0.0
    np.testing.assert_allclose(change, supplied - lost, atol=1e-11 * size)


def test_every_support_pushes_on_the_bed():
    """Springs and dampers 15 - 6 + 0.8 + 1 N, a spring 2e12 x^3, a stop 1e6 (x - 1e-4) + 500 x', one that is not reached."""
    machine = jv.two_mass(mass=(12.0, 9.0), stiffness=(5e4, 3e4), damping=(40.0, 20.0), link_stiffness=2e5, link_damping=60.0)
    supports = (
        jv.CubicSupport(2e12, platform=2),
        jv.Stop(1e6, gap=1e-4, damping=500.0, side="above", platform=1),
        jv.Stop(3e6, gap=1e-4, damping=700.0, side="below", platform=1),
    )
    s = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0), supports)
    state = jv.State(jnp.array([3e-4, -2e-4]), jnp.array([0.02, 0.05]), (jnp.ones(1),), (jnp.zeros(1),))
    np.testing.assert_allclose(jv.foundation_force(s, state), [10.8 - 16.0 + 200.0 + 10.0], rtol=1e-12)


MOTOR = jv.Exciter(drive=jv.DCMotor(100.0, stall_torque=5.0, inertia=0.1), unbalance=0.1)
BALLS = jv.Exciter(jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
BOTH = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0), exciters=[BALLS, MOTOR])


def state_of_both(coordinates=(1,), loads=2, rotor=(0.0, 0.0)):
    q, angle = jnp.zeros(coordinates), (jnp.zeros(loads),)
    return jv.State(q, q, exciters=[jv.ExciterState(angle, angle), jv.ExciterState(rotor=rotor)])


@pytest.mark.parametrize(
    ("state", "says"),
    [
        (state_of_both((2,)), r"state.displacement has shape \(2,\); this scene needs \(1,\)"),
        (
            state_of_both((5, 1)),
            r"state.displacement has shape \(5, 1\); .* of a trajectory use jax.vmap",
        ),
        (state_of_both(loads=3), r"exciters\[0\].state.angle has shape \(3,\); this scene needs \(2,\)"),
        (
            state_of_both(rotor=None),
            r"exciters\[1\].state.rotor is None; .* it must be \(angle, speed\)",
        ),
        (state_of_both(rotor=(0.0,) * 3), r"exciters\[1\].state.rotor has 3 entries; 2 are needed"),
        (jv.State(jnp.zeros(1), jnp.zeros(1)), "state.exciters are 1; this scene needs 2"),
    ],
)
def test_states_of_other_scenes_are_refused_in_one_sentence(state, says):
    asked = [lambda: jv.energy(BOTH, state), lambda: jv.power(BOTH, 0.0, state), lambda: jv.normal_force(BOTH, 0.0, state)]
    for ask in asked:
        with pytest.raises(jv.InputError, match=says):
            ask()
    if "exciters are" in says:
        with pytest.raises(jv.InputError, match=says):
            jv.vector_field(BOTH)(0.0, state)
    if "displacement" in says:
        with pytest.raises(jv.InputError, match=says):
            jv.foundation_force(BOTH, state)


@pytest.mark.parametrize("time", [(1.0, 2.0), (), np.zeros((2, 2)), np.nan, np.asarray(np.inf)])
@pytest.mark.parametrize(
    "quantity", [lambda t, s: jv.energy(BOTH, s, t), *(lambda t, s, f=f: f(BOTH, t, s) for f in (jv.power, jv.normal_force))]
)
def test_a_time_is_one_finite_number(quantity, time):
    with pytest.raises(jv.InputError, match=r"^t "):
        quantity(time, state_of_both())


@pytest.mark.parametrize("of", [jv.energy, lambda s, state: jv.power(s, 0.0, state)])
def test_energy_and_power_that_overflow_have_a_status(of):
    loads = jv.balls(count=1, mass=0.5, radius=1e200, drag=1.0)
    s = jv.Scene(jv.one_mass(mass=50.0, stiffness=1e300, damping=1e300), loads, jv.ConstantSpeed(60.0))
    state = jv.State(jnp.array([1e10]), jnp.array([-1e10]), (jnp.zeros(1),), (jnp.zeros(1),))
    with pytest.raises(jv.ComputationError, match=r"^overflow: parts of the (energy|power) are not finite; check"):
        of(s, state)
