"""Second derivatives of runs: exact for smooth scenes, refused for scenes with kinks, in which they would be wrong."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv

STEPS = jv.EqualSteps(400)
TORQUE_TABLE = jv.TorqueTable([0.0, 30.0, 70.0], [10.0, 5.0, 0.0], inertia=0.1)


def scene(stiffness, *effects, drive=None):
    machine = jv.one_mass(mass=50.0, stiffness=stiffness, damping=100.0)
    loads = jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5, ball_radius=0.02)
    return jv.Scene(machine, loads, jv.ConstantSpeed("60 rad/s") if drive is None else drive, effects=effects)


def displacement(stiffness, *effects, drive=None, adjoint=None):
    run = jv.simulate(scene(stiffness, *effects, drive=drive), 0.5, stepsize_controller=STEPS, adjoint=adjoint)
    return run.window.state.displacement[-1, 0]


def envelope(stiffness):
    motor = jv.Exciter(drive=TORQUE_TABLE, unbalance=0.05)
    found = jv.envelope(jv.Scene(scene(stiffness).machine, exciters=[motor]), 0.5)
    return jnp.max(found.foundation_force)


def ensemble(stiffness, *effects, drive=None):
    found = jv.ensemble(lambda k: scene(k, *effects, drive=drive), stiffness[None], 0.5, stepsize_controller=STEPS)
    return found.state.displacement[0, 0]


NOT_SMOOTH = {
    "Stop": dict(effects=[jv.Stop(4e4, gap=0.001)]),
    "Stop with damping": dict(effects=[jv.Stop(4e4, gap=0.001, damping=100.0)]),
    "RollingFriction": dict(effects=[jv.RollingFriction(1e-4)]),
    "Sliding": dict(effects=[jv.Sliding(0.01)]),
    "TorqueTable": dict(drive=TORQUE_TABLE),
}


@pytest.mark.parametrize("name", NOT_SMOOTH)
def test_second_derivatives_are_refused_with_kinks(name):
    """Check that wrong values are refused: with the undamped stop the derivative was -6.6e-7 in place of 1.4e-3."""
    parts = NOT_SMOOTH[name]
    with pytest.raises(jv.InputError, match=f"because {name.split()[0]} is not smooth; use central differences"):
        jax.hessian(lambda k: displacement(k, *parts.get("effects", ()), drive=parts.get("drive")))(4e4)


def test_second_derivatives_are_refused_in_forward_mode():
    stop = NOT_SMOOTH["Stop"]["effects"]
    for function in (lambda k: displacement(k, *stop, adjoint=diffrax.ForwardMode()), lambda k: ensemble(k, *stop)):
        with pytest.raises(jv.InputError, match="because Stop is not smooth"):
            jax.jacfwd(jax.jacfwd(function))(jnp.asarray(4e4))
    with pytest.raises(jv.InputError, match="because TorqueTable is not smooth"):
        jax.hessian(envelope)(4e4)


def test_derivatives_of_other_terms_of_a_gradient_are_allowed():
    stop = NOT_SMOOTH["Stop"]["effects"]

    def slope(shift):
        return jax.grad(lambda k: displacement(k, *stop) + shift**2 * k)(4e4)

    assert jax.jacfwd(slope)(3.0) == 6.0


def test_second_derivatives_of_smooth_scenes_are_exact():
    slope = jax.jit(jax.grad(lambda z: displacement(4e4 * (1.0 + z), jv.CubicSupport(1e9))))
    expected = (slope(1e-5) - slope(-1e-5)) / 2e-5  # differs by 1e-7; rounding contributes less
    np.testing.assert_allclose(jax.jacfwd(slope)(0.0), expected, rtol=1e-6)
