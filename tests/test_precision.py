"""Scenes made in one precision and analyzed in the other, over the public functions."""

import tempfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import BALLS, ROTOR, TWO_MASS

import jaxvib as jv

SPEED, SPEEDS = 62.0, np.array([60.0, 62.0])


def platforms():
    return jv.Scene(jv.two_mass(**TWO_MASS), jv.balls(**BALLS), jv.ConstantSpeed(SPEED))


def balancer():
    return jv.Scene(jv.rotor(**ROTOR), jv.balls(**BALLS), jv.ConstantSpeed(400.0))


def motor():
    drive = jv.DCMotor(SPEED, stall_torque=20.0, inertia=0.5)
    return jv.Scene(jv.two_mass(**TWO_MASS), jv.balls(**BALLS), drive, jv.Gravity())


def several():
    return jv.Scene(
        jv.two_mass(**TWO_MASS), exciters=[jv.Exciter(jv.balls(**BALLS), jv.ConstantSpeed(SPEED), at=k) for k in (1, 2)]
    )


def state_of(scene):
    return jax.tree.map(lambda leaf: leaf + 0.1, jv.initial_state(scene))


QUESTIONS = {
    "natural_frequencies": (platforms, jv.natural_frequencies),
    "mode_shapes": (platforms, lambda s: jv.mode_shapes(s).shape),
    "jam_modes": (platforms, lambda s: jv.jam_modes(s).select(1).omega),
    "branches": (platforms, lambda s: jv.branches(s).rotor_speed[::50]),
    "phase_jams": (platforms, lambda s: jv.phase_jams(s).omega),
    "jam_orbit by mode": (platforms, lambda s: jv.jam_orbit(s, mode=1).omega),
    "jam_orbit by load speed": (platforms, lambda s: jv.jam_orbit(s, omega=20.0).rotor_speed),
    "multiplier of an orbit": (platforms, lambda s: abs(jv.jam_orbit(s, mode=1).multiplier)),
    "balanced_states": (balancer, lambda s: jnp.asarray(jv.balanced_states(s).dimension)),
    "stability of a balance": (balancer, lambda s: jv.balanced_states(s).stability().growth),
    "criterion": (balancer, lambda s: jv.criterion(s).speeds.resonances),
    "whirl": (balancer, lambda s: jv.whirl(s, 400.0).speed),
    "critical_speeds": (balancer, lambda s: jv.critical_speeds(s).speed),
    "vector_field": (motor, lambda s: jv.vector_field(s)(jnp.asarray(0.1), state_of(s)).velocity),
    "energy and power": (motor, lambda s: jv.energy(s, state_of(s)) + sum(jv.power(s, 0.1, state_of(s)))),
    "foundation_force": (motor, lambda s: jv.foundation_force(s, state_of(s))),
    "simulate": (motor, lambda s: jv.simulate(s, 0.3, estimate=False).trajectory.state.displacement[-1]),
    "simulate several exciters": (several, lambda s: jv.simulate(s, 0.3, estimate=False).trajectory.state.displacement[-1]),
    "equal steps": (
        platforms,
        lambda s: jv.simulate(s, 0.3, stepsize_controller=jv.EqualSteps(900)).window.foundation_force[-1],
    ),
    "ensemble": (platforms, lambda s: jv.ensemble(lambda w: s.replace(drive=jv.ConstantSpeed(w)), SPEEDS, 0.3).load_speed),
    "settle": (platforms, lambda s: jv.settle(s, mode=1).omega),
    "envelope": (platforms, lambda s: jv.envelope(s, 0.5).omega),
    "growth": (platforms, lambda s: jnp.asarray(jv.growth(s, 3.0, start="jam", mode=1).exponent)),
    "regime": (platforms, lambda s: jv.regime(s, jv.simulate(s, 1.0, save="window").window).load_speed),
    "state_space": (platforms, lambda s: jv.state_space(s).A[2:]),
    "state_space of a jam": (platforms, lambda s: jv.state_space(s, jv.jam_modes(s).select(1)).A),
    "export_fmu": (platforms, lambda s: jv.export_fmu(s, f"{tempfile.mkdtemp()}/x", binary=False).statements),
}


@pytest.mark.parametrize("made_in_double", [False, True])
@pytest.mark.parametrize("name", QUESTIONS)
def test_scene_of_the_other_precision_is_analyzed(name, made_in_double):
    make, ask = QUESTIONS[name]
    with jax.enable_x64(made_in_double):
        scene = make()
    with jax.enable_x64(not made_in_double):
        expected, found = ask(make()), ask(scene)
        assert jnp.asarray(found).dtype == jnp.asarray(expected).dtype
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * np.max(np.abs(expected)))
