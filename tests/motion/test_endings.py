"""Endings of runs: missing starts, unfinished runs, divergence, and the known error."""

import re

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, scene

import jaxvib as jv
from jaxvib.motion.analysis.scaled_error import natural_units
from jaxvib.motion.integrate import _status, is_finite, is_unbounded
from jaxvib.motion.plan import plan_segment
from jaxvib.ode.control import PIController
from jaxvib.ode.dopri8 import UnrolledDopri8


def test_a_run_that_does_not_finish_says_so():
    with pytest.raises(jv.ComputationError, match="needs more steps than max_steps to reach its end") as error:
        jv.simulate(published().scene(), 20.0, max_steps=16)
    assert error.value.status == "max_steps_reached"
    run = jv.simulate(published().scene(), 20.0, max_steps=16, throw=False)
    assert bool(run.status == jv.RunStatus.max_steps_reached)
    for ask in (run.plot, run.spectrum, run.plot_path):
        with pytest.raises(jv.InputError, match=r"^run has no values at its end: the run needs more steps than max_steps .*"):
            ask()
    assert "max_steps" in run._repr_html_()  # a notebook shows the text without a figure
    for largest in (run.largest_displacement, run.largest_force, run.point().largest_displacement):
        assert np.all(np.isnan(largest))
    unknown = (
        r"the run needs more steps than max_steps to reach its end: amplitudes, speeds and forces are unknown after \d+ steps"
    )
    assert re.match(unknown, run.summary())


def test_equal_steps_are_within_the_default_limit():
    s = published().scene()
    plan = plan_segment(s, 1.0, jv.initial_state(s), jv.EqualSteps(40_000), throw=True)
    assert plan.integration.max_steps == 65_536 and float(plan.integration.control.steps) == 40_000


@pytest.mark.parametrize(
    ("result", "status"),
    [
        ("successful", "done"),
        ("max_steps_reached", "max_steps_reached"),
        ("dt_min_reached", "not_finite"),  # what is not finite makes every step too large
        ("nonlinear_divergence", "no_step"),
    ],
)
def test_what_the_integrator_says_is_the_status(result, status):
    for bounded in (True, False):
        found = _status(getattr(diffrax.RESULTS, result), jnp.asarray(bounded))
        assert bool(found == getattr(jv.RunStatus, status if bounded else "not_finite"))


def test_a_lane_whose_start_does_not_exist_says_so():
    s = published(eps=1e-3).scene()

    @eqx.filter_jit
    @eqx.filter_vmap
    def batch(speed):
        there = eqx.tree_at(lambda x: x.drive.speed, s, speed)
        run = jv.simulate(there, 20.0, start="jam", mode=4, save="window", max_steps=4096)
        return run.status == jv.RunStatus.no_start, run.omega, run.steps

    missing, omega, steps = batch(jnp.array([1.2, 3.0]))
    assert missing.tolist() == [True, False]
    assert jnp.isnan(omega).tolist() == [True, False]
    assert int(steps[0]) < 4096


def test_missing_mode_has_the_status_no_start():
    s = published(eps=1e-3, speed=1.2).scene()
    with pytest.raises(jv.ComputationError, match="does not exist"):
        jv.simulate(s, 20.0, start="jam", mode=4)
    for run in (jv.simulate(s, 20.0, start="jam", mode=4, throw=False), jv.envelope(s, 5.0, start="jam", mode=4, throw=False)):
        assert run.message == "the initial state does not exist or is not finite"
        for leaf in jax.tree.leaves((run.window, run.trajectory, run.amplitude)):
            assert np.all(np.isnan(leaf))


def test_nonfinite_run_does_not_delay_the_others():
    """Each of its steps is refused and made smaller, until a smaller one is none."""
    s = published(eps=1e-3).scene()

    def one(scale):
        there = eqx.tree_at(lambda x: x.machine.link_stiffness, s, s.machine.link_stiffness * scale)
        run = jv.simulate(there, 20.0, save="window")
        return run.status == jv.RunStatus.refused, run.steps, run.omega

    bad, steps, omega = eqx.filter_jit(jax.vmap(one))(jnp.asarray([1.0, jnp.nan, 1.1]))
    assert bad.tolist() == [False, True, False] and np.isfinite(omega).tolist() == [True, False, True]
    assert int(jnp.max(steps)) < 2000
    with pytest.raises(jv.InputError, match=r"scene\.machine\.link_stiffness is nan; it must be finite"):
        jv.simulate(eqx.tree_at(lambda x: x.machine.link_stiffness, s, s.machine.link_stiffness * jnp.nan), 1.0)


def test_an_unbounded_motion_ends_with_its_status():
    """y' = y^2 from 1 has no bound at t = 1."""
    one = jnp.asarray(1.0)
    controller = PIController(tolerance=jnp.asarray(1e-8), unit=(one,), relative=(one,))
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: (y[0] ** 2,)),
        UnrolledDopri8(),
        t0=0.0,
        t1=2.0,
        dt0=0.01,
        y0=(one,),
        saveat=diffrax.SaveAt(steps=True),
        stepsize_controller=controller,
        max_steps=4096,
        throw=False,
    )
    assert found.result == diffrax.RESULTS.dt_min_reached
    times = np.asarray(found.ts)
    np.testing.assert_allclose(times[np.isfinite(times)][-1], 1.0, atol=1e-7)


@pytest.mark.parametrize("stiffness", [-4e9, -1e12])
def test_the_time_of_an_unbounded_motion_is_stated(stiffness):
    """Loads are flung round ever faster, so that steps get smaller without end: more of them would not help."""
    soft = scene("one_mass", "rollers", speed=60.0, effects=(jv.CubicSupport(stiffness),))
    start = jv.State(jnp.asarray([0.01]), jnp.zeros(1), (jnp.zeros(1),), (jnp.zeros(1),))
    with pytest.raises(jv.ComputationError, match="the motion grew without bounds") as error:
        jv.simulate(soft, 5.0, start=start, max_steps=2000)
    assert error.value.status == "not_finite" and (stiffness < -1e10 or ", after t = 0.02" in str(error.value))


def test_a_platform_at_rest_hides_no_other_that_blows_up():
    """The second platform is on springs of its own and stays where it is."""
    machine = jv.network(mass=[50.0, 30.0], stiffness=[4e4, 3e4], damping=[10.0, 10.0], links=[], exciter=1)
    loads = jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0)
    soft = jv.Scene(machine, loads, jv.ConstantSpeed(60.0), (jv.CubicSupport(-1e8, platform=1),))
    start = eqx.tree_at(lambda s: s.displacement, jv.initial_state(soft), jnp.array([0.05, 0.0]))
    run = jv.simulate(soft, 1.0, start=start, max_steps=200, throw=False)
    assert run.status_name == "not_finite" and int(run.steps) > 100


def test_loads_in_contact_start_in_their_order():
    loads = jv.balls(count=3, mass=0.3, radius=0.1, drag=0.5, ball_radius=0.02)
    s = jv.Scene(scene("one_mass").machine, loads, jv.ConstantSpeed(60.0), (jv.LoadContact(stiffness=1e5),))
    for angles in ([0.0, 2.0, 1.0], [0.0, 3.0, -2.0], [0.0, 1.0, 7.0], [1.0, 1.0, 2.0]):
        start = eqx.tree_at(lambda y: y.angle, jv.initial_state(s), (jnp.asarray(angles),))
        for ask in (
            lambda angles=angles: jv.initial_state(s, angles=angles),
            lambda start=start: jv.simulate(s, 1.0, start=start),
            lambda start=start: jv.ensemble(lambda k: (s, start), jnp.ones(2), 1.0),
            lambda angles=angles: jv.run_up_map(s, 1.0, angles=[angles]),
        ):
            with pytest.raises(jv.InputError, match=r"start\.angle is \[.*\] rad; loads in contact cannot pass each other"):
                ask()
    assert jv.initial_state(s, angles=[4.0, 6.0, 8.0]).angle[0].shape == (3,)


def test_an_unknown_error_is_infinite():
    s = published(eps=1e-3).scene()
    assert float(jv.simulate(s, 0.1, stepsize_controller=jv.EqualSteps(1)).error) == np.inf
    loose, looser = (jv.simulate(s, 20.0, stepsize_controller=jv.Tolerance(t)) for t in (0.1, 0.5))
    assert 0.0 < float(loose.error) < np.inf and 0.0 < float(looser.error) < np.inf
    failed = jv.simulate(s, 20.0, stepsize_controller=jv.Tolerance(1e-8), max_steps=16, throw=False)
    assert float(failed.error) == np.inf


def test_the_error_is_estimated_under_jit_and_vmap():
    s = published(eps=1e-3).scene()

    def error(speed):
        return jv.simulate(eqx.tree_at(lambda s: s.drive.speed, s, speed), 5.0, estimate=True).error

    speed = s.drive.speed
    at_once = jax.jit(jax.vmap(error))(jnp.stack([speed, speed]))
    np.testing.assert_allclose(at_once, float(error(speed)), rtol=0.1)  # another form of the same method


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            dict(estimate=True, stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6)),
            "estimate is True together with a contr",
        ),
        (dict(estimate=False, stepsize_controller=jv.Accuracy(1e-4)), "estimate is False together with accuracy"),
        (dict(stepsize_controller=jv.Tolerance(np.float32(1e-6))), "a Python number such as 1e-6"),
    ],
)
def test_estimates_that_nobody_can_make_are_refused(change, says):
    with pytest.raises(jv.InputError, match=says):
        jv.simulate(published().scene(), 1.0, **change)


def test_a_motion_has_grown_where_one_platform_alone_has():
    """Divergence is a displacement or a velocity beyond 1e8 of its initial value or of the natural units."""
    s = scene("two_mass", "balls")
    unit = natural_units(s)
    first = jv.initial_state(s)
    for name in ("displacement", "velocity"):
        size = float(getattr(unit, name))
        for last, grown in (([0.0, 1.1e8], True), ([-1.1e8, 0.0], True), ([0.9e8, 0.9e8], False)):
            there = eqx.tree_at(lambda y, name=name: getattr(y, name), first, size * jnp.asarray(last))
            assert bool(is_unbounded(unit, first, there)) == grown
    far = eqx.tree_at(lambda y: y.displacement, first, float(unit.displacement) * jnp.asarray([0.0, 1e3]))
    assert not bool(is_unbounded(unit, far, eqx.tree_at(lambda y: y.displacement, first, 1e8 * far.displacement)))
    assert bool(is_unbounded(unit, first, eqx.tree_at(lambda y: y.rate, first, (jnp.full(3, jnp.inf),))))


def test_one_number_that_is_not_finite_makes_a_state_that_is_not():
    state = jv.initial_state(scene("two_mass", "balls"))
    assert bool(is_finite(state))
    for bad in (jnp.nan, -jnp.inf):
        for k, leaf in enumerate(jax.tree.leaves(state)):
            broken = eqx.tree_at(lambda y, k=k: jax.tree.leaves(y)[k], state, leaf.at[-1].set(bad))
            assert not bool(is_finite(broken))


def test_a_motor_that_cannot_start_is_not_advised_to_run_longer():
    motor = jv.DCMotor(100.0, stall_torque=2.5, inertia=0.5)
    exciter = jv.Exciter(drive=motor, unbalance=0.4)
    table = jv.Scene(jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0), exciters=[exciter], effects=jv.Gravity())
    said = jv.simulate(table, 3.0, save="window", estimate=False).summary()
    assert "not settled: the motor cannot start: the weight of its unbalance needs 2.84 N m" in said
    assert "run longer" not in said
