"""The swing of a pendulum on a bearing against SciPy and closed forms."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from swings import ROD, T, scipy_swing

import jaxvib as jv
from jaxvib.machine.effects.friction import sliding_sign
from jaxvib.runtime.compat import no_host_checks
from jaxvib.study.bearing.swing import Friction, SwingStatus, controller_to, swing_states


def test_radial_load_is_what_holds_the_bob_on_its_circle():
    f, rate, acceleration = 0.7, 3.0, -11.0
    circle = lambda t: 0.25 * jnp.array([jnp.sin(angle(t)), -jnp.cos(angle(t))])  # noqa: E731
    angle = lambda t: f + rate * t + acceleration * t**2 / 2.0  # noqa: E731
    felt = jax.jacfwd(jax.jacfwd(circle))(0.0) + jnp.array([0.0, 9.81])
    toward_bearing = -circle(0.0) / 0.25
    np.testing.assert_allclose(ROD.radial_load(f, rate), 0.3 * felt @ toward_bearing, rtol=1e-14)


def test_smooth_sign_loses_the_stated_share():
    width = 0.05  # of the largest speed of a swing
    kept = quad(lambda x: float(np.tanh(np.sin(x) / width)) * np.sin(x), 0.0, np.pi, points=[width, np.pi - width])[0] / 2.0
    np.testing.assert_allclose(1.0 - kept, np.pi**2 / 24.0 * width**2, rtol=2e-2)
    assert sliding_sign(width, width) == np.tanh(1.0)


def test_small_viscous_swing_is_the_closed_form():
    t, mu1, size = np.linspace(0.0, 20.0, 301), 2e-3, 1e-4
    n = mu1 / (2.0 * 0.025)
    w = np.sqrt(0.3 * 9.81 * 0.25 / 0.025 - n**2)
    expected = size * np.exp(-n * t) * (np.cos(w * t) + n / w * np.sin(w * t))
    swing = jv.swing(ROD, t, angle=size, viscous=mu1, stepsize_controller=jv.Tolerance(1e-11))
    np.testing.assert_allclose(swing.angle, expected, atol=1e-6 * size)
    assert jv.SwingStatus[swing.status].startswith("the pendulum still swings") and np.isnan(swing.stopped_at)


def test_large_viscous_swing_is_scipys():
    t = np.linspace(0.0, 20.0, 301)
    expected, _ = scipy_swing(ROD, t, 2.8, 1.0, 2e-3)
    swing = jv.swing(ROD, t, angle=2.8, rate=1.0, viscous=2e-3)
    np.testing.assert_allclose(swing.angle, expected, atol=1e-6)


def test_drag_of_the_air_and_a_torque_are_scipys():
    t = np.linspace(0.0, 20.0, 301)
    expected, _ = scipy_swing(ROD, t, 1.6, 0.5, 2e-3, air=3e-3, torque=0.1)
    swing = jv.swing(ROD, t, angle=1.6, rate=0.5, viscous=2e-3, air=3e-3, torque=0.1)
    np.testing.assert_allclose(swing.angle, expected, atol=1e-6)
    rest = float(ROD.rest_angle(0.1))
    np.testing.assert_allclose(0.3 * 9.81 * 0.25 * np.sin(rest), 0.1, rtol=1e-12)
    late = jv.swing(ROD, [0.0, 300.0], angle=rest + 0.01, viscous=2e-3, torque=0.1)
    np.testing.assert_allclose(late.angle[-1], rest, atol=1e-6)


def test_swing_with_a_torque_stops_in_the_shifted_dead_zone():
    t = np.linspace(0.0, 80.0, 801)
    rest, zone = float(ROD.rest_angle(0.02)), float(ROD.dead_zone(jnp.asarray(0.02)))
    swing = jv.swing(ROD, t, angle=0.17, viscous=2e-4, dry=0.02, torque=0.02, width=1e-5)
    assert bool(swing.status == jv.SwingStatus.stopped) and abs(float(swing.angle[-1]) - rest) < zone < 0.5 * rest
    expected, stop = scipy_swing(ROD, t, 0.17, 0.0, 2e-4, 0.02, torque=0.02)
    assert abs(float(swing.stopped_at) - stop) < 0.5
    np.testing.assert_allclose(swing.angle, expected, atol=1e-5)


def test_dry_friction_converges_to_the_sharp_law():
    t = np.linspace(0.0, 80.0, 801)
    expected, stop = scipy_swing(ROD, t, 0.17, 0.0, 2e-4, 0.02)
    errors = []
    for width in (1e-3, 1e-4, 1e-5):
        swing = jv.swing(ROD, t, angle=0.17, viscous=2e-4, dry=0.02, width=width)
        errors.append(np.max(np.abs(swing.angle - expected)))
        assert abs(float(swing.stopped_at) - stop) < 0.5
        assert float(swing.rate[-1]) == 0.0 and float(swing.angle[-1]) == float(swing.angle[-40])
    assert errors[1] < 0.2 * errors[0] and errors[2] < 0.2 * errors[1] and errors[2] < 5e-6
    swing = jv.swing(ROD, t, angle=0.17, viscous=2e-4, dry=0.02)
    assert jv.SwingStatus[swing.status].startswith("dry friction stopped") and abs(float(swing.stopped_at) - stop) < 0.3
    np.testing.assert_allclose(swing.angle, expected, atol=1e-4)


def test_a_pendulum_let_go_in_the_dead_zone_stays():
    zone = float(ROD.dead_zone(jnp.asarray(0.02)))
    np.testing.assert_allclose(np.tan(zone), 0.02 * 0.02 / (2 * 0.25))
    stays = jv.swing(ROD, np.linspace(0.0, 50.0, 11), angle=0.8 * zone, viscous=0.0, dry=0.02)
    np.testing.assert_allclose(stays.angle, 0.8 * zone, rtol=2e-3)
    assert bool(stays.status == jv.SwingStatus.stopped)
    goes = jv.swing(ROD, np.linspace(0.0, 50.0, 11), angle=2.0 * zone, viscous=0.0, dry=0.02)
    assert abs(float(goes.angle[-1])) < 0.1 * zone


@no_host_checks()  # programs with these are compiled anew each time
def test_derivatives_of_the_swing():
    """Central differences, step 1e-4 of each number: their own error is about 1e-6 at a tolerance of 1e-11."""
    t = jnp.linspace(0.0, 10.0, 60)
    at = jnp.array([0.3, 0.1, 2e-3, 0.02, 1e-3, 0.03])

    def angles(x, adjoint=None):
        given = dict(angle=x[0], rate=x[1], viscous=x[2], dry=x[3], air=x[4], torque=x[5], width=5e-3, adjoint=adjoint)
        return jv.swing(ROD, t, stepsize_controller=jv.Tolerance(1e-11), **given).angle

    forward = eqx.filter_jit(jax.jacfwd(lambda x: angles(x, diffrax.ForwardMode())))(at)
    steps = 1e-4 * jnp.diag(at)
    around = eqx.filter_jit(jax.vmap(angles))(jnp.concatenate([at[None, :] + steps, at[None, :] - steps]))
    difference = (around[:6] - around[6:]) / (2.0 * jnp.diagonal(steps)[:, None])
    for k in range(6):
        np.testing.assert_allclose(forward[:, k], difference[k], atol=3e-5 * np.max(np.abs(difference[k])), equal_nan=False)
    weights = jnp.cos(jnp.arange(60.0))
    reverse = jax.grad(lambda x: weights @ angles(x))(at)
    np.testing.assert_allclose(reverse, weights @ forward, rtol=1e-5, equal_nan=False)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(time=1.0), "time is one number"),
        (dict(time=[0.0, 2.0, 1.0]), "time must ascend"),
        (dict(viscous=-1.0), "viscous is -1 N m s; it must be at least 0"),
        (dict(angle="3 kg"), "angle is '3 kg', which is not in rad"),
        (dict(dry=0.1, width=0.0), "width is 0 rad/s; it must be greater than 0"),
        (dict(pendulum=jv.BearingPendulum(0.3, 0.2), dry=0.1), "pendulum.bearing is missing"),
        (dict(torque=1.0), "torque is 1 N m; it must be below m g l, 0.7358 N m"),
        (dict(pendulum="rod"), "pendulum is 'rod'; it must be a BearingPendulum"),
    ],
)
def test_wrong_swings(change, says):
    given = {**dict(pendulum=ROD, time=[0.0, 1.0, 2.0], angle=0.1, viscous=1e-3), **change}
    with pytest.raises(jv.InputError, match=says):
        jv.swing(given.pop("pendulum"), given.pop("time"), **given)
    with pytest.raises(jv.InputError, match=r"pendulum.mass is 0 kg; it must be greater than 0"):
        jv.BearingPendulum(0.0, 0.2)


def test_too_few_steps_have_a_status():
    with pytest.raises(jv.ComputationError, match="max_steps_reached"):
        jv.swing(ROD, [0.0, 100.0], angle=0.1, viscous=1e-3, max_steps=20)
    swing = jv.swing(ROD, [0.0, 100.0], angle=0.1, viscous=1e-3, max_steps=20, throw=False)
    assert bool(swing.status == jv.SwingStatus.max_steps_reached) and np.isnan(swing.angle[-1])


@eqx.filter_jit
@jax.vmap
def swings_with_slopes(x):
    def swing(x):
        pendulum = eqx.tree_at(lambda p: p.g, ROD, x["g"])
        given = (x["angle"], jnp.zeros(()), Friction(jnp.asarray(1e-3), x["dry"]), jnp.asarray(1e-3))
        run = swing_states(pendulum, T[:200], *given, controller_to(1e-8), diffrax.Tsit5(), diffrax.ForwardMode(), 4096)
        return run.angle, run.status

    return swing(x), jax.jacfwd(swing, has_aux=True)(x)[0]


@pytest.mark.parametrize("wrong", [dict(angle=jnp.nan), dict(dry=jnp.inf), dict(g=-9.81)])
@no_host_checks()  # a program with these is compiled anew each time
def test_invalid_swing_leaves_the_others_unchanged(wrong):
    """A step of a fit may lead to such a swing; stops and slopes of all swings are computed together."""
    right = dict(angle=0.3, dry=0.02, g=9.81)
    both = {name: jnp.asarray([value, wrong.get(name, value)]) for name, value in right.items()}
    (value, status), slope = swings_with_slopes(both)
    assert np.all(np.isfinite(value[0])) and np.all(np.isnan(value[1]))
    assert all(np.all(np.isfinite(s[0])) and np.any(s[0]) for s in jax.tree.leaves(slope))
    assert np.asarray(status == SwingStatus.no_start).tolist() == [False, True]
