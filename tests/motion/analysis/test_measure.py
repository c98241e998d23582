"""Amplitudes, speeds and forces read from samples of a motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scenes import scene, turning_body
from scipy.optimize import brentq
from small_machine import small_run

import jaxvib as jv
from jaxvib.equations.model import assemble
from jaxvib.motion.analysis.measure import mean_speeds, measure
from jaxvib.motion.analysis.scaled_error import error_scale, estimated_error, natural_units, scaled_error


def test_measure_reads_a_known_motion():
    """Samples miss the extrema and the whole turns: both are read off between them."""
    s = scene("two_mass", "balls")
    w, n = 7.0, 3
    a, c = jnp.asarray([2e-3, 5e-3]), jnp.asarray([0.3, 1.1])
    t = jnp.linspace(1.0, 6.0, 301)
    angle, phase = w * t[:, None], c[None, :]
    states = jv.State(
        a[None, :] * jnp.cos(angle + phase) + 0.7,
        -w * a[None, :] * jnp.sin(angle + phase),
        (jnp.broadcast_to(angle, (301, n)) + jnp.asarray([0.0, 0.4, 2.0])[None, :],),
        (jnp.full((301, n), w),),
    )

    def field(_, y):
        return jv.State(y.velocity, -(w**2) * (y.displacement - 0.7), y.rate, (jnp.zeros(n),))

    measured = eqx.filter_jit(measure)(assemble(s), jax.tree_util.Partial(field), t, states, natural_units(s))
    force = np.abs(np.sum((np.asarray(s.machine.stiffness) + 1j * w * np.asarray(s.machine.damping)) * a * np.exp(1j * c)))
    np.testing.assert_allclose(measured.amplitude, a, rtol=1e-12)
    np.testing.assert_allclose(measured.foundation_force, force, rtol=1e-12)
    np.testing.assert_allclose(measured.omega, w, rtol=1e-9)
    np.testing.assert_allclose(measured.load_speed, w, rtol=1e-9)
    assert bool(measured.settled)


def test_drift_includes_the_gain_of_the_loads_speed():
    """phi = w t + e t^2/2 over T: the mean speed of the later half is e T/4 above that of the whole."""
    s, w, e = scene("two_mass", "balls"), 70.0, 0.02
    t = jnp.linspace(0.0, 5.0, 4001)
    rest = jnp.broadcast_to(jnp.asarray([1e-3, 2e-3]), (4001, 2))
    states = jv.State(
        rest * jnp.sin(w * t)[:, None],
        w * rest * jnp.cos(w * t)[:, None],
        (jnp.broadcast_to((w * t + e * t**2 / 2.0)[:, None], (4001, 3)),),
        (jnp.broadcast_to((w + e * t)[:, None], (4001, 3)),),
    )

    def field(_, y):
        return jv.State(y.velocity, -(w**2) * y.displacement, y.rate, (jnp.full(3, e),))

    measured = eqx.filter_jit(measure)(assemble(s), jax.tree_util.Partial(field), t, states, natural_units(s))
    np.testing.assert_allclose(measured.drift, e * 5.0 / 4.0 / (w + e * 2.5), rtol=0.05)


def test_derivatives_of_an_amplitude_move_its_extrema_along():
    """x = cos wt + p cos(2wt + 0.3): slope and curvature in p of half of peak to peak, against extrema found by bisection."""
    s, w = scene("one_mass", "balls"), 7.0
    t = jnp.linspace(0.0, 4.0, 512)

    def moving(p, t):
        return jnp.cos(w * t) + p * jnp.cos(2.0 * w * t + 0.3)

    def amplitude(p):
        rate, bend = jax.grad(moving, 1), jax.grad(jax.grad(moving, 1), 1)
        at = lambda f: jax.vmap(f, in_axes=(None, 0))(p, t)[:, None]  # noqa: E731
        states = jv.State(at(moving), at(rate), (jnp.zeros((512, 3)),), (jnp.full((512, 3), w),))

        def field(p, t, y):
            return jv.State(y.velocity, bend(p, t)[None], y.rate, (jnp.zeros(3),))

        return measure(assemble(s), jax.tree_util.Partial(field, p), t, states, natural_units(s)).amplitude[0]

    def exactly(p):
        ends = []
        for low, high in ((-0.2, 0.2), (np.pi - 0.9, np.pi + 0.9)):
            slope = lambda u: -np.sin(u) - 2.0 * p * np.sin(2.0 * u + 0.3)  # noqa: E731
            u = brentq(slope, low, high, xtol=1e-15, rtol=1e-15)
            ends.append((u, np.cos(u) + p * np.cos(2.0 * u + 0.3)))
        value = (ends[0][1] - ends[1][1]) / 2.0
        # By the implicit function theorem: dV/dp is that at a fixed place, d2V/dp2 = -(d2x/dp du)^2/(d2x/du2).
        first = [np.cos(2.0 * u + 0.3) for u, _ in ends]
        second = [-((-2.0 * np.sin(2.0 * u + 0.3)) ** 2) / (-np.cos(u) - 4.0 * p * np.cos(2.0 * u + 0.3)) for u, _ in ends]
        return value, (first[0] - first[1]) / 2.0, (second[0] - second[1]) / 2.0

    p = 0.12
    value, slope, curvature = exactly(p)
    np.testing.assert_allclose(eqx.filter_jit(amplitude)(p), value, rtol=1e-12)
    for way in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(eqx.filter_jit(way(amplitude))(p), slope, rtol=1e-11)
        np.testing.assert_allclose(eqx.filter_jit(jax.jacfwd(way(amplitude)))(p), curvature, rtol=1e-9)


def test_a_growing_motion_is_not_settled():
    run = small_run()
    assert not bool(run.settled) and "not settled" in run.summary()


def test_drift_of_the_loads_speed_is_relative():
    """A platform that repeats itself, a load whose speed rises by 1 %: its mean over the second half, against that of all."""
    s, n = scene("one_mass", "balls"), 3
    t = jnp.linspace(0.0, 20.0, 2001)
    angle, rate = 50.0 * (t + 0.5 * 0.01 * t**2 / 20.0), 50.0 * (1.0 + 0.01 * t / 20.0)
    each = lambda x: jnp.broadcast_to(x[:, None], (t.shape[0], n))  # noqa: E731
    states = jv.State(jnp.sin(50.0 * t)[:, None], 50.0 * jnp.cos(50.0 * t)[:, None], (each(angle),), (each(rate),))

    def field(_, y):
        return jv.State(y.velocity, -2500.0 * y.displacement, y.rate, (jnp.full(n, 0.5 * 0.01 * 50.0 / 10.0),))

    measured = eqx.filter_jit(measure)(assemble(s), jax.tree_util.Partial(field), t, states, natural_units(s))
    # Speeds grow evenly: their mean over the second half is that at 15 s, over all of it that at 10 s, but for part of a turn.
    np.testing.assert_allclose(measured.drift, 0.0025 / 1.005, rtol=0.02)
    assert not bool(measured.settled)


def test_drift_does_not_depend_on_the_size_of_a_body():
    """A machine ten times as large has ten times the displacements and the same rotations."""
    small, large = (
        jv.simulate(turning_body(size), 2.0, start="spin_up", estimate=False, save="window") for size in (0.1, 10.0)
    )
    np.testing.assert_allclose(small.amplitude * np.array([100.0, 100.0, 1.0]), large.amplitude, rtol=1e-6)
    np.testing.assert_allclose(small.drift, large.drift, rtol=1e-6)


def test_a_mean_speed_is_that_over_whole_turns():
    """phi = w t + e t^2/2 up to T: from where whole turns are left, between two samples, by a quadratic equation."""
    w, e, end = 7.0, 0.5, 5.0
    t = jnp.linspace(0.0, end, 401)
    turns = np.floor((w * end + e * end**2 / 2.0) / (2.0 * np.pi))
    left = w * end + e * end**2 / 2.0 - 2.0 * np.pi * turns
    start = (np.sqrt(w**2 + 2.0 * e * left) - w) / e
    assert turns == 6.0 and 0.01 < start / (end / 400.0) % 1.0 < 0.99
    for sign in (1.0, -1.0):
        found = mean_speeds(t, sign * (w * t + e * t**2 / 2.0)[:, None], sign * (w + e * t)[:, None], [0])[0, 0]
        np.testing.assert_allclose(found, sign * 2.0 * np.pi * turns / (end - start), rtol=1e-10)


def test_the_mean_speed_of_a_load_that_rests_has_a_derivative():
    """phi = 0.3 + p t: its speed is p, at p = 0 too."""
    t = jnp.linspace(0.0, 4.0, 9)
    speed, slope = jax.value_and_grad(lambda p: mean_speeds(t, 0.3 + p * t[:, None], jnp.full((9, 1), p), [0])[0, 0])(0.0)
    assert speed == 0.0
    np.testing.assert_allclose(slope, 1.0, rtol=1e-12)


def test_rounding_counts_for_every_step_and_radian():
    """2 eps for each, beside the share of the difference; twice the difference where an effect bends the motion."""
    s, eps = scene("one_mass", "balls"), 2.0**-52
    np.testing.assert_allclose(estimated_error(0.0, 0.5, s, 1000, 500), 3000.0 * eps, rtol=1e-12)
    np.testing.assert_allclose(estimated_error(1e-4, 0.5, s), 5e-5, rtol=1e-12)
    bent = scene("one_mass", "balls", effects=(jv.Stop(1e6, gap=1e-3),))
    np.testing.assert_allclose(estimated_error(1e-4, 0.5, bent), 2e-4, rtol=1e-12)
    jumping = eqx.tree_at(lambda s: s.exciters[0].drive, s, jv.RunUp(60.0, acceleration=40.0))
    np.testing.assert_allclose(estimated_error(1e-4, 0.5, jumping), 5e-5, rtol=1e-12)
    np.testing.assert_allclose(estimated_error(1e-4, 0.5, jumping, ends_at_jumps=False), 2e-4, rtol=1e-12)


def test_equal_steps_across_a_jump_have_a_larger_error():
    """The acceleration of the rotor jumps within a step; the error no longer falls with a high power of the length of steps."""
    machine, loads = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0), jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5)
    s = jv.Scene(machine, loads, jv.RunUp(60.0, acceleration=40.0))
    run, exact = (jv.simulate(s, 2.0, stepsize_controller=c) for c in (jv.EqualSteps(195), jv.EqualSteps(6000)))
    scale = error_scale(run.window.state, natural_units(s))
    error = float(scaled_error(run.window.state, exact.window.state, scale))
    assert error < float(run.error) < 100.0 * error


def test_a_force_that_changes_alone_is_a_drift():
    """k1 y1 + k2 y2 = k2 d where y1 = a cos, y2 = d - k1/k2 y1: amplitudes repeat themselves to 1e-6 while d grows by half."""
    s = scene("two_mass", "balls")
    s = eqx.tree_at(lambda s: s.machine.damping, s, jnp.zeros(2))
    w, a, size, end = 50.0, 0.01, 1e-8, 8.0
    t = jnp.linspace(0.0, end, 4001)
    ratio = float(s.machine.stiffness[0] / s.machine.stiffness[1])

    def moving(t):
        d = size * (1.0 + 0.5 * t / end) * jnp.cos(w * t)
        return jnp.stack([a * jnp.cos(w * t), d - ratio * a * jnp.cos(w * t)])

    displacement = jax.vmap(moving)(t)
    velocity = jax.vmap(jax.jacfwd(moving))(t)
    turning = jnp.broadcast_to((w * t)[:, None], (4001, 3))
    states = jv.State(displacement, velocity, (turning,), (jnp.full((4001, 3), w),))

    def field(t, y):
        return jv.State(y.velocity, jax.jacfwd(jax.jacfwd(moving))(t), y.rate, (jnp.zeros(3),))

    force, mass = 3e4 * 1.5 * size, float(jnp.mean(jnp.diagonal(s.machine.carrier().mass)))
    for least, share in ((0.0, 0.25 / 1.5), (1e4 * force, 0.25 / 1.5 / 1e4)):
        # Far below the loads' centrifugal force, length * mass * n^2, a change is relative to 1e-4 of that.
        length = jnp.asarray(least / 1e-4 / mass / 120.0**2)
        unit = eqx.tree_at(lambda u: u.displacement, natural_units(s), length)
        measured = eqx.filter_jit(measure)(assemble(s), jax.tree_util.Partial(field), t, states, unit)
        np.testing.assert_allclose(measured.drift, share, rtol=0.02)
