"""Reverse derivatives through adaptive steps: those of the steps that were taken, to rounding."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.errors import InputError
from jaxvib.ode.control import PIController
from jaxvib.ode.dopri8 import UnrolledDopri8
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.ode.replay import differentiable_once, solve

ARGS = (jnp.asarray(0.7), jnp.asarray(1.3))


def plain(x):
    return x


@jax.custom_vjp
def rounded(x):
    """x, which comes out another when it is computed again to be differentiated: as a compiler's rounding does."""
    return x


rounded.defvjp(lambda x: (x * (1.0 + 1e-13), None), lambda _, slope: (slope,))


def forced(again, jump):
    """A forced oscillator; from t = 7 to 13 with `jump` more force, in proportion to what it is differentiated by."""

    def field(t, y, args):
        force = args[0] * (jnp.cos(1.7 * t) + jnp.where(t < 7.0, 0.0, jump) - jnp.where(t < 13.0, 0.0, jump))
        return y[1], force - 0.05 * y[1] - args[1] * again(y[0])

    return diffrax.ODETerm(field)


def run(args, *, solver=None, again=plain, jump=0.0, adjoint=None, controller=None, end=300.0, noted=False, **options):
    one = (jnp.ones(()), jnp.ones(()))
    if controller is None:
        controller = PIController(tolerance=jnp.asarray(1e-7), unit=one, relative=one)
        if jump:
            controller = diffrax.ClipStepSizeController(controller, jump_ts=jnp.asarray([7.0, 13.0]))
    first_step = None if isinstance(controller, diffrax.StepTo) else jnp.asarray(0.1)
    options = {"first_step": first_step, "max_steps": 2**12, **options}
    solution = solve(
        forced(again, jump),
        solver or (UnrolledDopri8() if again is rounded else diffrax.Dopri8()),
        end=jnp.asarray(end),
        y0=(jnp.asarray(1.0), jnp.asarray(0.0)),
        args=args,
        saveat=diffrax.SaveAt(steps=True)
        if noted
        else diffrax.SaveAt(subs=[diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(ts=jnp.asarray([0.5, 0.9]) * end)]),
        controller=controller,
        adjoint=adjoint,
        **options,
    )
    return solution.ts if noted else jnp.concatenate([*solution.ys[0], *solution.ys[1]])


@pytest.fixture(scope="module")
def right():
    """Forward derivatives through the very steps, prescribed."""
    times = eqx.filter_jit(lambda args: run(args, noted=True, adjoint=diffrax.ForwardMode()))(ARGS)
    steps = diffrax.StepTo(jnp.concatenate([jnp.zeros(1), times[jnp.isfinite(times)]]))
    return jnp.stack(eqx.filter_jit(jax.jacfwd(lambda args: run(args, adjoint=diffrax.ForwardMode(), controller=steps)))(ARGS))


def test_derivatives_are_those_of_the_steps_taken(right):
    """Also where roundings differ when the run is computed again: 1e-13 in each evaluation, some 1e-11 over 80 swings."""
    for again, bound in ((plain, 1e-12), (rounded, 1e-10)):
        reverse = jnp.stack(eqx.filter_jit(jax.jacrev(lambda args, again=again: run(args, again=again)))(ARGS))
        np.testing.assert_allclose(reverse, right, atol=bound * float(jnp.max(jnp.abs(right))))


def test_steps_chosen_again_are_other_steps(right):
    """Recorded steps are needed because choosing steps again amplifies roundings many thousand times."""
    adjoint = diffrax.RecursiveCheckpointAdjoint()
    reverse = jnp.stack(eqx.filter_jit(jax.jacrev(lambda args: run(args, again=rounded, adjoint=adjoint)))(ARGS))
    assert float(jnp.max(jnp.abs(reverse - right))) > 1e-7 * float(jnp.max(jnp.abs(right)))


def test_steps_end_where_the_field_jumps():
    """A step over the jump, or on from it with the rates of before, would be off by 1e-2."""
    forward = eqx.filter_jit(jax.jacfwd(lambda args: run(args, jump=0.5, end=20.0, adjoint=diffrax.ForwardMode())))(ARGS)
    reverse = eqx.filter_jit(jax.jacrev(lambda args: run(args, jump=0.5, end=20.0)))(ARGS)
    np.testing.assert_allclose(reverse, forward, atol=1e-10)


@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_states_depend_on_the_times_of_jumps(mode):
    """y' = 2 until the first jump, then -1, and 2 again after the second: each later state changes by 3 and -3 per second."""
    one, save = jnp.ones(()), diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=jnp.asarray([0.5, 2.0, 4.5]), t1=True)])

    def value(jumps):
        term = diffrax.ODETerm(lambda t, y, jumps: jnp.where((t < jumps[0]) | (t > jumps[1]), 2.0, -1.0) + 0.0 * y)
        control = diffrax.ClipStepSizeController(PIController(jnp.asarray(1e-7), one, one), jump_ts=jumps)
        adjoint = diffrax.ForwardMode() if mode == "forward" else None
        solution = solve(term, LoopDopri8(reuse=True), end=jnp.asarray(5.0), first_step=jnp.asarray(0.1), y0=one, args=jumps,
                         saveat=save, controller=control, adjoint=adjoint, max_steps=64)  # fmt: skip
        return solution.ys[0]

    slopes = eqx.filter_jit(jax.jacfwd(value) if mode == "forward" else jax.jacrev(value))(jnp.asarray([1.0, 4.0]))
    np.testing.assert_allclose(slopes, [[0.0, 0.0], [3.0, 0.0], [3.0, -3.0], [3.0, -3.0]], atol=1e-12)


@pytest.mark.parametrize("solver", [diffrax.Dopri8(), LoopDopri8(), LoopDopri8(reuse=True)])
def test_every_lane_of_a_batch_has_its_own_steps(solver):
    """Lanes that have come to their end wait for the others in steps of no length; no derivative of theirs may be lost."""
    factors = jnp.asarray([1.0, 3.0])

    def slopes(factor):
        return jax.grad(lambda args: run((args, ARGS[1]), solver=solver, end=10.0 * factor)[0])(factor * ARGS[0])

    each = jnp.stack([eqx.filter_jit(slopes)(factor) for factor in factors])
    np.testing.assert_allclose(eqx.filter_jit(jax.vmap(slopes))(factors), each, rtol=1e-10)


def test_any_adaptive_controller_will_do():
    def value(args, adjoint=None):
        return run(args, end=30.0, controller=diffrax.PIDController(rtol=1e-7, atol=1e-7), adjoint=adjoint)

    forward = eqx.filter_jit(jax.jacfwd(lambda args: value(args, diffrax.ForwardMode())))(ARGS)
    np.testing.assert_allclose(eqx.filter_jit(jax.jacrev(value))(ARGS), forward, atol=1e-9)


@pytest.mark.parametrize("controller", [diffrax.ConstantStepSize(), diffrax.StepTo(jnp.linspace(0.0, 30.0, 301))])
def test_given_steps_need_no_noting(controller):
    def value(args, adjoint=None):
        return run(args, end=30.0, controller=controller, adjoint=adjoint)

    forward = eqx.filter_jit(jax.jacfwd(lambda args: value(args, diffrax.ForwardMode())))(ARGS)
    np.testing.assert_allclose(eqx.filter_jit(jax.jacrev(value))(ARGS), forward, atol=1e-12)


@pytest.mark.parametrize("max_steps", [2**17, 2**20])
def test_states_that_were_not_noted_are_computed_again(right, max_steps):
    """Only every 2nd and 16th state is recorded; the last segment is shorter."""
    reverse = jnp.stack(eqx.filter_jit(jax.jacrev(lambda args: run(args, max_steps=max_steps)))(ARGS))
    np.testing.assert_allclose(reverse, right, atol=1e-12 * float(jnp.max(jnp.abs(right))))


def test_states_within_the_first_step_have_derivatives():
    """A state saved within the first step depends on the start in the same way as in forward mode."""

    def value(y0, adjoint=None):
        save = diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=jnp.asarray([0.0, 0.06]))])
        given = dict(first_step=jnp.asarray(0.1), max_steps=32, controller=diffrax.ConstantStepSize(), adjoint=adjoint)
        solution = solve(forced(plain, 0.0), diffrax.Dopri8(), end=jnp.asarray(1.0), y0=y0, args=ARGS, saveat=save, **given)
        return jnp.stack(solution.ys[0])

    start = (jnp.asarray(1.0), jnp.asarray(0.5))
    reverse = jnp.stack(eqx.filter_jit(jax.jacrev(value))(start), axis=-1)
    np.testing.assert_array_equal(reverse[:, 0], np.eye(2))
    forward = jnp.stack(eqx.filter_jit(jax.jacfwd(lambda y0: value(y0, diffrax.ForwardMode())))(start), axis=-1)
    np.testing.assert_allclose(reverse, forward, atol=1e-13)


@pytest.mark.parametrize("controller", [diffrax.ConstantStepSize(), diffrax.PIDController(rtol=1e-7, atol=1e-7)])
def test_slopes_by_the_end_and_by_constant_steps(controller):
    """Saved states follow their times, the last step its end; constant steps move all together, chosen ones do not."""

    def value(end, share, adjoint=None):
        return run(ARGS, end=end, controller=controller, first_step=share, adjoint=adjoint)

    given = (jnp.asarray(30.0), jnp.asarray(1.6))  # steps so long that their error is felt
    by_end, by_step = eqx.filter_jit(jax.jacrev(value, argnums=(0, 1)))(*given)
    forward = eqx.filter_jit(jax.jacfwd(lambda end, share: value(end, share, diffrax.ForwardMode()), argnums=(0, 1)))(*given)
    np.testing.assert_allclose(by_end, forward[0], atol=1e-6)
    if isinstance(controller, diffrax.ConstantStepSize):
        assert float(jnp.max(jnp.abs(forward[1]))) > 1e-4
        np.testing.assert_allclose(by_step, forward[1], atol=1e-9)
    else:
        assert jnp.all(by_step == 0.0)


@pytest.mark.parametrize("max_steps", [256, 2**20])  # each state is recorded, or some of them
def test_second_derivatives_are_forward_over_reverse(max_steps):
    """End state of y' = -k y: exp(-k)."""

    def state(k):
        return solve(
            diffrax.ODETerm(lambda t, y, k: -k * y),
            diffrax.Dopri8(),
            end=jnp.asarray(1.0),
            first_step=jnp.asarray(0.1),
            y0=jnp.asarray(1.0),
            args=k,
            saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(t1=True)]),
            controller=diffrax.PIDController(rtol=1e-10, atol=1e-12),
            adjoint=None,
            max_steps=max_steps,
        ).ys[0][-1]

    np.testing.assert_allclose(jax.hessian(state)(2.0), np.exp(-2.0), rtol=1e-8)
    for reverse in (jax.jacrev, jax.grad):
        with pytest.raises(InputError, match="use forward over reverse"):
            reverse(reverse(state))(2.0)


def test_second_derivatives_are_refused_within_loops():
    def repeated(x):
        return jax.lax.fori_loop(0, 3, lambda _, y: y + 0.1 * differentiable_once(y, "scene", "is not smooth") ** 3, x)

    assert np.isfinite(jax.vmap(jax.grad(repeated))(jnp.arange(2.0))).all()
    for function in (jax.grad(repeated), jax.jit(jax.grad(repeated)), jax.jacfwd(repeated)):
        with pytest.raises(InputError, match="scene is not smooth"):
            jax.jacfwd(function)(0.7)
