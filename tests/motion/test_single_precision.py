"""Long runs and single precision."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, scene

import jaxvib as jv
from jaxvib.motion.plan import plan_segment


def test_a_long_run_keeps_its_phase():
    """Angles grow to a thousand turns; were their tolerance relative, so would their error."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    free = jv.Scene(machine, jv.pendulums(count=1, mass=1e-9, radius=0.1, drag=1e-9), jv.ConstantSpeed(100.0))
    start = eqx.tree_at(lambda y: (y.angle, y.rate), jv.initial_state(free), ((jnp.zeros(1),), (jnp.full(1, 100.0),)))
    run = jv.simulate(free, 63.0, start=start, samples=2, stepsize_controller=jv.Tolerance(1e-7))
    assert abs(float(run.trajectory.state.angle[0][-1, 0]) - 6300.0) < 1e-5
    # In double precision the window counts its turns from the run's start too.
    assert abs(float(run.window.state.angle[0][-1, 0]) - 6300.0) < 1e-5


def test_what_float32_cannot_deliver_is_refused():
    with jax.enable_x64(False), pytest.raises(jv.InputError, match=r"in float32 .* switch JAX to float64"):
        jv.simulate(published().scene(), 10.0, stepsize_controller=jv.Tolerance(1e-8))


def test_single_precision_keeps_its_phase():
    """A load that turns with its rotor for 1e5 turns: an angle of 6e5 rad would be good to 0.06 only, and each step would round
    it anew; so the only error, but for 1e-3 of an angle within a turn, is that of the time itself."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    with jax.enable_x64(False):
        free = jv.Scene(machine32(machine), jv.pendulums(count=1, mass=1e-6, radius=0.1, drag=1e-4), jv.ConstantSpeed(100.0))
        start = eqx.tree_at(lambda y: (y.angle, y.rate), jv.initial_state(free), ((jnp.zeros(1),), (jnp.full(1, 100.0),)))
        run = jv.simulate(free, 6283.185, start=start, save="window", stepsize_controller=jv.Tolerance(1e-5), estimate=False)
        phase = np.asarray(run.window.state.angle[0][:, 0], float) - 100.0 * np.asarray(run.window.time, float)
        assert run.amplitude.dtype == jnp.float32
        # A mean speed is an angle over a time between two samples, each of whose times is rounded by up to a spacing.
        times = np.asarray(run.window.time)
        bound = 2.0 * float(np.spacing(times[-1])) / float(times[-1] - times[0])
        np.testing.assert_allclose(float(run.omega), 100.0, rtol=bound)
    assert np.max(np.abs((phase + np.pi) % (2.0 * np.pi) - np.pi)) < 100.0 * float(np.spacing(times[-1])) + 1e-3


def test_long_runs_are_divided_in_both_directions():
    for way in (1, -1):
        turning = jv.Scene(scene().machine, exciters=[jv.Exciter(scene().loads, scene().drive, direction=way)])
        with jax.enable_x64(False):
            single = machine32(turning)
            plan = plan_segment(single, 3e3, jv.initial_state(single), jv.Tolerance(1e-5), throw=True)
        assert plan.segments == 3


def test_an_imbalance_sets_the_unit_where_loads_hardly_shake():
    """Measured by the loads' own unbalance, 1e-9 of the rotor's, steps would be four times as many, and in the end none."""
    machine, moment, w = jv.one_mass(mass=50.0, stiffness=4e4, damping=3e3), 0.5, 100.0
    with jax.enable_x64(False):
        loads = jv.pendulums(count=1, mass=5e-9, radius=0.1, drag=1e-6)
        light = jv.Scene(machine32(machine), loads, jv.ConstantSpeed(w), (jv.StaticImbalance(moment),))
        run = jv.simulate(light, 2.0, save="window", stepsize_controller=jv.Tolerance(1e-5), estimate=False)
        answer = moment * w**2 / abs(4e4 - 50.0 * w**2 + 1j * w * 3e3)
        np.testing.assert_allclose(run.amplitude, [answer], rtol=1e-4)
        assert int(run.steps) < 400


def machine32(machine):
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float32), machine)


def test_a_gradient_in_single_precision_is_that_of_double():
    """The method itself keeps angles within a turn, and must not hold any differentiated value."""

    def force(stiffness, machine):
        stiffer = eqx.tree_at(lambda s: s.machine.stiffness, machine, stiffness)
        run = jv.simulate(stiffer, 2.0, save="window", stepsize_controller=jv.Tolerance(1e-5), estimate=False)
        return run.foundation_force

    double = scene("two_mass", "balls")
    expected = jax.grad(force)(double.machine.stiffness, double)
    with jax.enable_x64(False):
        single = machine32(double)
        found = jax.grad(force)(single.machine.stiffness, single)
        assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=1e-3)
