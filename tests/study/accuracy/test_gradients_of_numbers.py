"""Derivatives by the numbers of drives, effects, rotors and torus loads, against finite differences with their noise."""

import jax
import jax.numpy as jnp
import pytest
from programs.golden import scenes, state_of

import jaxvib as jv
from jaxvib.machine.numbers.named import numbers_of, put_numbers

SCENES = scenes()
FREE = {
    "spin-up": ["drive.duration"],
    "run-up": ["drive.acceleration"],
    "DC motor": ["drive.stall_torque", "drive.inertia"],
    "induction motor": ["drive.breakdown_torque", "drive.breakdown_slip", "drive.inertia"],
    "gravity": ["effects.gravity.g"],
    "dry friction": [f"effects.dry_friction.{name}" for name in ("coefficient", "diameter", "width")],
    "rolling friction": ["loads.ball_radius", "effects.rolling_friction.coefficient", "effects.rolling_friction.width"],
    "imbalance": ["effects.static_imbalance.moment", "effects.static_imbalance.angle"],
    "cubic support": ["effects.cubic_support[0].stiffness"],
    "stop": [f"effects.stop[0].{name}" for name in ("stiffness", "gap", "damping")],
    "friction support": [f"effects.friction_support[0].{name}" for name in ("force", "width")],
    "contact": ["loads.ball_radius", "effects.load_contact.stiffness", "effects.load_contact.damping"],
    "rotor with stations": [f"machine.{name}" for name in ("transverse_inertia", "polar_inertia", "position", "stations")],
    "torus": ["loads.tube", "loads.ball_radius", "effects.gravity.g", "effects.rolling_friction.coefficient"],
    "torus, balls spin and slide": ["effects.sliding.coefficient", "effects.sliding.width"],
}


HAS_UNUSED = ("contact", "torus, balls spin and slide")
"""Scenes whose contacts do not give way in the state that is looked at."""


def with_wide_smoothing(scene):
    """Friction away from the flat part of its smooth sign."""
    widths = [number for name, number in numbers_of(scene).items() if name.endswith(".width")]
    return put_numbers(scene, widths, jnp.full(len(widths), 100.0)) if widths else scene


@pytest.mark.parametrize("name", FREE)
def test_rates_have_right_derivatives_by_new_numbers(name):
    scene = with_wide_smoothing(SCENES[name])
    state = state_of(scene)

    def rates(s):
        each = jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(jv.vector_field(s)(jnp.asarray(0.3), state))])
        return jnp.sum(each * jnp.cos(jnp.arange(each.size)))

    check = jv.check_gradients(scene, jax.jit(rates), free=FREE[name], tolerance=1e-6).require()
    assert check.left_out == ()
    assert (abs(check.gradient[0]) > 0.0).all() or name in HAS_UNUSED


def test_a_quantity_without_the_number_has_no_derivative():
    scene = SCENES["stop"]
    check = jv.check_gradients(scene, lambda s: jv.natural_frequencies(s)[0], free=["effects.stop[0].gap", "machine.mass"])
    assert check.status_name == "agree" and check.gradient[:, 0].tolist() == [0.0, 0.0] and abs(check.gradient[0, 1]) > 0.0


def test_a_choice_has_no_derivative():
    with pytest.raises(jv.InputError, match=r"effects\.stop\[0\]\.platform is 2, which is not a continuous number"):
        jv.check_gradients(SCENES["stop"], lambda s: s.drive.speed, free=["effects.stop[0].platform"])
