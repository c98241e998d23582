"""The step as a loop over its stages, and its forward derivatives in all directions at once."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.ode.batching import multi_tangent_jvp
from jaxvib.ode.dopri8 import UnrolledDopri8
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.runtime.compat import no_host_checks

assert_close = functools.partial(np.testing.assert_allclose, equal_nan=False)


@pytest.fixture(autouse=True)
def _nan_where_a_run_fails():
    """NaN in place of an error: programs that can raise one are compiled anew each time."""
    with no_host_checks():
        yield


POINT = jnp.asarray([0.7, 1.3, 0.2, 0.4, -0.3, 1.9, 0.05, 0.6, 2.5])


def on_numbers(t, y, args):
    force, stiffness, damping = args
    return y[1], force * jnp.cos(1.7 * t) - damping * y[1] - stiffness * jnp.sin(y[0])


def on_arrays(t, y, args):
    force, stiffness, damping = args
    turned = y["x"] @ jnp.asarray([[0.0, 1.0], [-1.0, 0.0]])
    return {"x": damping * turned - stiffness * y["x"] ** 3, "scale": force * jnp.cos(t) * y["scale"] * y["x"][0, 1]}


def motion(point, *, arrays=False, slopes=True, adaptive=True, adjoint=diffrax.ForwardMode()):  # noqa: B008
    """States in the middle of a run and at its end; the point moves the equations, the start and the end."""
    y0 = {"x": point[3:7].reshape(2, 2), "scale": point[7]} if arrays else (point[3], point[4])
    end = point[8]
    control = diffrax.PIDController(rtol=1e-6, atol=1e-6) if adaptive else diffrax.ConstantStepSize()
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(on_arrays if arrays else on_numbers),
        LoopDopri8(tangents=slopes, reuse=isinstance(adjoint, diffrax.ForwardMode)),
        jnp.zeros(()),
        end,
        0.1 if adaptive else end / 12.0,
        y0,
        (point[0], point[1], point[2]),
        saveat=diffrax.SaveAt(ts=jnp.stack([0.31 * end, 0.77 * end, end])),
        stepsize_controller=control,
        adjoint=adjoint,
    )
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(solution.ys)])


@pytest.mark.parametrize(("arrays", "adaptive"), [(True, True), (False, False)])
def test_derivatives_in_all_directions_are_those_in_each(arrays, adaptive):
    """Nine directions, more than a vector holds; they move the length of the steps too."""
    ours, plain = (
        eqx.filter_jit(jax.jacfwd(lambda p, s=slopes: motion(p, arrays=arrays, slopes=s, adaptive=adaptive)))(POINT)
        for slopes in (True, False)
    )
    assert np.max(np.abs(plain)) > 0.1
    assert_close(ours, plain, rtol=1e-11, atol=1e-12)


def test_derivatives_are_finite_differences():
    """Equal steps: a smooth function of the point. Central differences of 1e-5: their own error is about 1e-9."""
    ours = eqx.filter_jit(jax.jacfwd(lambda p: motion(p, adaptive=False)))(POINT)
    value = eqx.filter_jit(lambda p: motion(p, adaptive=False))
    differences = [(value(POINT + m) - value(POINT - m)) / 2e-5 for m in 1e-5 * jnp.eye(9)]
    assert_close(ours, jnp.stack(differences, axis=-1), atol=1e-8)


def test_batches_inside_and_outside():
    """The controller follows an error of 1e-6, a difference of numbers of the order of 1 that is good to 2e-10 of itself; its
    derivative, by which steps move with the point, to some 1e-9, however the same operations are put together."""
    points = jnp.stack([POINT + move for move in (0.0, 0.05, 0.1)])
    alone = eqx.filter_jit(jax.jacfwd(motion))
    single = jnp.stack([alone(p) for p in points])
    of_each = eqx.filter_jit(jax.vmap(jax.jacfwd(motion)))(points)
    assert_close(of_each, single, rtol=1e-8, atol=1e-9)
    of_all = eqx.filter_jit(jax.jacfwd(jax.vmap(motion)))(points)
    assert_close(jnp.stack([of_all[i, :, i] for i in range(3)]), single, rtol=1e-8, atol=1e-9)
    assert np.all(np.asarray(of_all[0, :, 1]) == 0.0)


@pytest.mark.parametrize(("arrays", "slopes"), [(False, False), (True, False), (True, True)])
def test_a_batch_in_lanes_is_its_runs_one_by_one(arrays, slopes):
    """All of the point in lanes; the field's numbers alone, the start and the end common; a batch of batches."""

    def run(p):
        return motion(p, arrays=arrays, slopes=slopes)

    points = jnp.stack([POINT + move for move in (0.0, 0.05, 0.1, 0.2)])
    alone = eqx.filter_jit(run)
    each = jnp.stack([alone(p) for p in points])
    assert np.max(np.abs(each - each[:1])) > 1e-2
    assert_close(eqx.filter_jit(jax.vmap(run))(points), each, rtol=1e-11, atol=1e-12)
    assert_close(eqx.filter_jit(jax.vmap(jax.vmap(run)))(points.reshape(2, 2, 9)).reshape(4, -1), each, rtol=1e-11)
    with_force = lambda force: run(POINT.at[0].set(force))  # noqa: E731
    forces = jnp.asarray([0.7, 0.9])
    each = jnp.stack([alone(POINT.at[0].set(force)) for force in forces])
    assert_close(eqx.filter_jit(jax.vmap(with_force))(forces), each, rtol=1e-11)


def test_reverse_derivatives_of_a_batch_are_those_of_its_runs():
    def size(p):
        return jnp.sum(motion(p, slopes=False, adaptive=False, adjoint=diffrax.RecursiveCheckpointAdjoint()) ** 2)

    points = jnp.stack([POINT, POINT + 0.1])
    ours = eqx.filter_jit(jax.vmap(jax.grad(size)))(points)
    forward = eqx.filter_jit(jax.jacfwd(lambda p: jnp.sum(motion(p, adaptive=False) ** 2)))
    assert_close(ours, jnp.stack([forward(p) for p in points]), rtol=1e-9)


def test_second_derivatives():
    ours, plain = (
        eqx.filter_jit(jax.jacfwd(jax.jacfwd(lambda p, s=slopes: motion(p, slopes=s, adaptive=False)[-1])))(POINT)
        for slopes in (True, False)
    )
    assert_close(ours, plain, rtol=1e-9, atol=1e-10)


def test_one_direction_alone_and_values_alone():
    value, slope = eqx.filter_jit(lambda p: jax.jvp(motion, (p,), (jnp.ones(9),)))(POINT)
    assert_close(slope, jnp.sum(eqx.filter_jit(jax.jacfwd(motion))(POINT), axis=1), rtol=1e-10, atol=1e-11)
    assert_close(value, eqx.filter_jit(lambda p: motion(p, slopes=False))(POINT), rtol=1e-13)


def test_directions_in_a_batch_of_which_only_a_part_differs():
    """f(a, b) = a b^2 by b, for several a: 2 a b on the diagonal."""

    def beside(x, slopes):
        (a, b), (_, slope) = x, slopes
        return a * b**2, (2.0 * a * b)[:, None] * slope

    product = multi_tangent_jvp(lambda x: x[0] * x[1] ** 2, beside)
    a, b = jnp.asarray([1.0, 2.0, -3.0]), jnp.asarray([0.5, 4.0])
    found = jax.jacfwd(lambda b: jax.vmap(lambda a: product((a, b)))(a))(b)
    assert_close(found, [np.diag(2.0 * each * np.asarray(b)) for each in np.asarray(a)])


def test_directions_lie_along_the_last_axis_and_fill_vectors():
    shapes = []

    def beside(x, slope):
        shapes.append(slope.shape)
        return jnp.sin(x), jnp.cos(x)[:, None] * slope

    x = jnp.arange(5.0)
    found = jax.jacfwd(multi_tangent_jvp(jnp.sin, beside))(x)
    assert_close(found, np.diag(np.cos(np.arange(5.0))))
    assert shapes[-1] == (5, 8)


def test_a_step_evaluates_the_field_in_one_place_of_its_program():
    """Whichever stage it is, and whether the last stage of the step before is known or not."""
    evaluations = []

    def field(t, y, args):
        evaluations.append(t)
        return -y

    def end(method):
        evaluations.clear()
        term = diffrax.ODETerm(field)
        found = jax.make_jaxpr(lambda: diffrax.diffeqsolve(term, method, 0.0, 1.0, 0.1, jnp.ones(9)).ys)()
        assert found
        return len(evaluations)

    # diffrax evaluates it once more where it looks up what a step is made of.
    counted = {name: end(method) for name, method in (("loop", LoopDopri8()), ("reuse", LoopDopri8(reuse=True)))}
    assert counted["loop"] == counted["reuse"] < end(UnrolledDopri8()) / 4, counted


def test_a_step_uses_the_time_of_each_of_its_stages():
    """y' = n t^(n - 1) is integrated exactly by a method of order 8."""
    powers = jnp.arange(1.0, 9.0)

    def field(t, y, args):
        return powers * t ** (powers - 1.0)

    term, control = diffrax.ODETerm(field), diffrax.ConstantStepSize()
    found = diffrax.diffeqsolve(term, LoopDopri8(), 0.5, 1.5, 0.5, 0.5**powers, stepsize_controller=control)
    np.testing.assert_allclose(found.ys[0], 1.5**powers, rtol=1e-13)


def test_interpolated_states_move_with_time_or_field_alone():
    """y' = -a y with equal steps: the fraction of the step is fixed if only a moves, the stages are if only the time does."""
    term, control = diffrax.ODETerm(lambda t, y, rate: -rate * y), diffrax.ConstantStepSize()

    def at(rate, t):
        saved, method = diffrax.SaveAt(dense=True), LoopDopri8(tangents=True)
        found = diffrax.diffeqsolve(
            term,
            method,
            0.0,
            1.0,
            0.1,
            jnp.ones(1),
            rate,
            saveat=saved,
            stepsize_controller=control,
            adjoint=diffrax.ForwardMode(),
        )
        return found.evaluate(t)[0]

    right = np.exp(-0.5 * 0.73)
    by_rate, by_time, by_both = (eqx.filter_jit(jax.jacfwd(at, argnums))(0.5, 0.73) for argnums in (0, 1, (0, 1)))
    assert_close(by_both, (by_rate, by_time), rtol=1e-12)
    assert_close((by_rate, by_time), (-0.73 * right, -0.5 * right), rtol=1e-9)
