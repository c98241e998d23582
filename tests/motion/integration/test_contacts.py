"""Derivatives of runs after contacts with dampers."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv

TOLERANCE = jv.Tolerance(1e-10)


def platform_on_stops(gap, other_gap, damping, stiffness):
    """Platform that meets two stops, one shortly after the other, in each oscillation."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    stops = [
        jv.Stop(stiffness, gap=gap, damping=damping),
        jv.Stop(stiffness, gap=other_gap, damping=2.0 * damping, side="above"),
    ]
    loads = jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5)
    return jv.Scene(machine, loads, jv.ConstantSpeed("60 rad/s"), effects=stops)


def displacement(numbers, adjoint=None, steps=TOLERANCE):
    run = jv.simulate(platform_on_stops(*numbers), 1.0, start="rest", stepsize_controller=steps, adjoint=adjoint)
    return run.window.state.displacement[-1, 0]


def colliding_balls(damping, stiffness, ball_radius, mass):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    loads = jv.balls(count=2, mass=mass, radius=0.1, drag=0.05, ball_radius=ball_radius)
    return jv.Scene(machine, loads, jv.ConstantSpeed("60 rad/s"), effects=[jv.LoadContact(stiffness, damping=damping)])


def angle(numbers, adjoint=None, steps=TOLERANCE):
    start = jv.State(jnp.zeros(1), jnp.zeros(1), (jnp.array([0.0, 1.5]),), (jnp.array([90.0, 30.0]),))
    run = jv.simulate(colliding_balls(*numbers), 0.3, start=start, stepsize_controller=steps, adjoint=adjoint)
    return run.window.state.angle[0][-1, 0]


def differences(function, numbers, step):
    """Central differences in multiples of each number; their error is about 1e-10 / step of the function's size."""
    shifts = np.diag(step * np.asarray(numbers))
    return np.array([(function(numbers + shift) - function(numbers - shift)) / (2.0 * step) for shift in shifts])


@pytest.mark.parametrize(
    ("function", "numbers", "derivatives"),
    [
        (displacement, [0.001, 0.0012, 300.0, 5e4], lambda f: jax.jacfwd(lambda x: f(x, diffrax.ForwardMode()))),
        (angle, [20.0, 4e4, 0.01, 0.5], jax.grad),
    ],
    ids=["stops", "loads"],
)
def test_derivatives_contain_the_time_of_contacts(function, numbers, derivatives):
    """Without it they are wrong by 6 % for the stops and by factors for the loads. The rest of the error is that of steps over
    the end of a contact, about the root of the tolerance, times the growth of differences from contact to contact."""
    numbers = jnp.asarray(numbers)
    expected = differences(function, numbers, 1e-5)
    found = derivatives(function)(numbers) * numbers
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-3 * np.max(np.abs(expected)))
