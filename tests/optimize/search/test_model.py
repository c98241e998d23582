"""The quadratic model of a search, part by part against linear algebra written anew and closed forms."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from two_springs import FREE, SCENE, plain, point_of

from optimize import DesignSpace, hold, largest
from optimize.search.model import (
    Step,
    at_kink,
    curvatures,
    kink_residuals,
    least_norm,
    predicted_decrease,
    second_derivatives,
    solve_model,
)
from optimize.search.problem import evaluate, problem_of


def shape(equalities=0, demands=0, parts=1):
    """Shape of a problem for the model."""
    return SimpleNamespace(equalities=equalities, demands=(None,) * demands, parts=parts)


def test_least_norm_solution_equals_the_pseudoinverse():
    random = np.random.default_rng(0)
    rows, right = random.normal(size=(5, 2, 4)), random.normal(size=(5, 2))
    for size in (1.0, 1e-5):
        awaited = np.einsum("sdm,sm->sd", np.linalg.pinv(size * rows), right)
        np.testing.assert_allclose(least_norm(size * rows, right), awaited, rtol=1e-4 if size < 1.0 else 1e-9)
    twice = np.concatenate([rows, rows[:, :1]], axis=1)  # one condition said twice
    again = least_norm(twice, np.concatenate([right, right[:, :1]], axis=1))
    np.testing.assert_allclose(again, least_norm(rows, right), rtol=1e-6)


def pieces_of_two():
    """Two designs of two numbers, four pieces."""
    pieces = np.array([[1.0, 3.0, 2.5, -4.0], [2.0, 2.0, 7.0, 1.0]])
    piece_gradients = np.random.default_rng(1).normal(size=(2, 4, 2))
    return point_of(np.full((2, 2), 0.5), pieces.max(axis=1)[:, None], piece_gradients[:, :1], pieces, piece_gradients)


def test_active_pieces_are_compared_with_the_largest():
    point = pieces_of_two()
    shares, size = np.array([[0.0, 0.3, 0.7, 0.0], [0.2, 0.3, 0.0, 0.5]]), np.array([2.0, 4.0])
    gap, piece_gradients = kink_residuals(point, shares, size)
    assert gap.shape == (2, 2) and piece_gradients.shape == (2, 2, 2)  # no more can meet than there are numbers, and one
    np.testing.assert_allclose(gap, [[(3.0 - 2.5) / 2.0, 0.0], [(2.0 - 1.0) / 4.0, (2.0 - 1.0) / 4.0]], rtol=1e-14)
    t = point.piece_gradients
    np.testing.assert_allclose(piece_gradients[0], [(t[0, 1] - t[0, 2]) / 2.0, [0.0, 0.0]], rtol=1e-14)
    np.testing.assert_allclose(piece_gradients[1], [(t[1, 1] - t[1, 3]) / 4.0, (t[1, 0] - t[1, 3]) / 4.0], rtol=1e-14)
    for hole in ((0, 1, 0), (0, 1, 1)):
        broken = t.copy()
        broken[hole] = np.nan
        gap, piece_gradients = kink_residuals(point._replace(piece_gradients=broken), shares, size)
        assert not np.any(gap[0]) and not np.any(piece_gradients[0]) and np.all(gap[1] == 0.25)


def test_pieces_about_as_large_as_the_largest_are_at_a_kink():
    point = pieces_of_two()
    slope, piece_gradients, met = at_kink(point, 0.2)
    np.testing.assert_array_equal(slope, [point.piece_gradients[0, 1], point.piece_gradients[1, 2]])
    np.testing.assert_array_equal(piece_gradients[0], point.piece_gradients[0, [2, 0]] - point.piece_gradients[0, 1])
    np.testing.assert_array_equal(met, [[True, False], [False, False]])
    # An objective that is nothing is measured by what it changes by over the bounds, a ten thousandth of its steepest piece.
    none = point._replace(pieces=np.array([[0.0, -1e-3, -3e-3, -9.0]] * 2), piece_gradients=np.zeros((2, 4, 2)))
    none.piece_gradients[:, 1, 1] = -100.0
    np.testing.assert_array_equal(at_kink(none, 0.2)[2], [[True, False]] * 2)
    np.testing.assert_array_equal(at_kink(none, 0.05)[2], [[False, False]] * 2)
    none.piece_gradients[:, 1, 1] = np.nan
    assert not np.any(np.isnan(at_kink(none, 0.2)[1]))


def test_second_derivatives_are_those_of_the_functions():
    """Second derivatives of held quantities, demands, pieces and half the squared objective are those of JAX. The step of 1e-5
    leaves an error of 1e-10 of fourth derivatives, and 1e-16/1e-5 of rounding."""
    first = plain("first", lambda x, y: jnp.sin(x) * y**2 + x)
    second = plain("second", lambda x, y: x**2 * y - 30.0)
    demand, held = plain("demand", lambda x, y: jnp.exp(0.3 * x) * y), plain("held", lambda x, y: x * y**2)
    free = DesignSpace(SCENE, FREE, [hold(held, 50.0)])

    def functions(z):
        x, y = 1.0 + 8.0 * z
        f, g = jnp.sin(x) * y**2 + x, x**2 * y - 30.0
        return jnp.stack([x * y**2 / 50.0 - 1.0, (jnp.exp(0.3 * x) * y - 4.0) / 4.0, f, g])

    z = np.array([[0.4, 0.3], [0.2, 0.8], [0.7, 0.5]])
    for objective, parts in ((first, 1), (largest(first, second), 2)):
        problem = problem_of(free, objective, [demand < 4.0], starts=2)
        assert problem.parts == parts
        found = second_derivatives(problem, evaluate(problem, z, ()))
        assert found.shape == (3, 2, 2 + parts + 1, 2)
        whole = jax.vmap(jax.hessian(functions))(z)[:, : 2 + parts]
        square = jax.vmap(jax.hessian(lambda z, parts=parts: jnp.max(functions(z)[2 : 2 + parts]) ** 2 / 2.0))(z)
        awaited = np.concatenate([whole, square[:, None]], axis=1)
        np.testing.assert_allclose(np.swapaxes(found, 1, 2), awaited, rtol=1e-6, atol=1e-5)


def not_indefinite(hessian, kept=None):
    """|B| on the space that the rows `kept` leave, by an orthonormal basis of it."""
    d = len(hessian)
    basis = np.eye(d) if kept is None else np.linalg.svd(np.atleast_2d(kept))[2][np.linalg.matrix_rank(kept) :].T
    values, vectors = np.linalg.eigh(basis.T @ hessian @ basis)
    return basis @ vectors @ np.diag(np.abs(values)) @ vectors.T @ basis.T


def symmetric(random, *count):
    a = random.normal(size=(*count, 3, 3))
    return a + np.swapaxes(a, -1, -2)


def test_curvatures_are_those_of_the_reduced_lagrangian():
    """One number held, one of two demands active; of four designs of three numbers one lies on a bound, one has not all second
    derivatives."""
    random = np.random.default_rng(2)
    second, slopes = symmetric(random, 4, 5), random.normal(size=(4, 4, 3))
    weights, size = np.array([[0.7, 0.0, 1.3]] * 4), np.array([2.0, 3.0, 4.0, 5.0])
    z = np.full((4, 3), 0.5)
    z[1, 1], z[2, 2] = 0.0, 1.0
    second[3, 0, 1, 2] = np.nan
    values = np.array([[-1.0, 0.0, -3.0, 0.0]] * 4)
    one = point_of(z, values, slopes)
    turned = np.moveaxis(second, 1, 2)  # (designs, numbers, functions, numbers)
    (found,) = curvatures(shape(1, 2), one, turned, weights, np.ones((4, 1)), size)
    for k in range(4):
        hessian = 0.7 * second[k, 0] + 1.3 * second[k, 2] + second[k, 3] / size[k] if k < 3 else np.eye(3)
        awaited = not_indefinite(hessian, slopes[k, [1, 3]] * np.where((z[k] <= 0.0) | (z[k] >= 1.0), 0.0, 1.0))
        np.testing.assert_allclose(found[k], awaited, atol=1e-8 * np.abs(hessian).max())
    # Where the objective is positive, half its square stands beside: (f^2/2)''/f.
    positive = one._replace(values=values.copy())
    positive.values[:2, 0], turned[1, 0, 4, 2] = 3.0, np.nan  # not all of the second one's are known
    both = curvatures(shape(1, 2), positive, turned, weights, np.ones((4, 1)), size)
    assert len(both) == 2
    np.testing.assert_array_equal(both[0], found)
    for k in range(4):
        if k == 0:
            hessian = 0.7 * second[k, 0] + 1.3 * second[k, 2] + second[k, 4] / size[k] / positive.values[k, 0]
            free = slopes[k, [1, 3]] * np.where((z[k] <= 0.0) | (z[k] >= 1.0), 0.0, 1.0)
            np.testing.assert_allclose(both[1][k], not_indefinite(hessian, free), atol=1e-8 * np.abs(hessian).max())
        else:
            np.testing.assert_array_equal(both[1][k], found[k])


def test_curvatures_at_a_kink_are_those_along_it():
    random = np.random.default_rng(3)
    second, piece_gradients = symmetric(random, 1, 4), random.normal(size=(1, 3, 3))
    shares, size = np.array([[0.25, 0.0, 0.75]]), np.array([2.0])
    point = point_of(np.full((1, 3), 0.5), np.array([[1.0]]), piece_gradients[:, :1], np.ones((1, 3)), piece_gradients)
    (found,) = curvatures(shape(parts=3), point, np.moveaxis(second, 1, 2), np.zeros((1, 0)), shares, size)
    hessian = (0.25 * second[0, 0] + 0.75 * second[0, 2]) / 2.0
    np.testing.assert_allclose(found[0], not_indefinite(hessian, piece_gradients[0, 0] - piece_gradients[0, 2]), atol=1e-8)


def test_flat_directions_get_a_small_curvature():
    """A model that is flat somewhere would have no least value: 1e-10 of the greatest curvature stays."""
    flat = np.diag([4.0, 0.0, -1.0])[None, :, None, :]
    point = point_of(np.full((1, 3), 0.5), np.array([[-1.0]]), np.ones((1, 1, 3)))
    (found,) = curvatures(shape(), point, np.concatenate([flat, flat], axis=2), np.zeros((1, 0)), np.ones((1, 1)), np.ones(1))
    np.testing.assert_allclose(found[0], np.diag([4.0, 4e-10, 1.0]), atol=1e-12)


def test_step_minimizes_the_model_within_the_trust_region():
    """Numbers apart: -g/(b size), no further than the reach, and to the bound."""
    hessian = np.diag([2.0, 4.0, 1.0, 1.0])[None]
    z, slope = np.array([[0.5, 0.9, 0.05, 0.5]]), np.array([[[-0.8, -4.0, 4.0, 6.0]]])
    step = solve_model(
        shape(), point_of(z, np.ones((1, 1)), slope), hessian, np.array([2.0]), np.array([10.0]), np.array([0.3])
    )
    np.testing.assert_allclose(step.p, [[0.2, 0.1, -0.05, -0.3]], atol=1e-6)
    np.testing.assert_array_equal(step.shares, [[1.0]])
    # Held: p1 + p2 = 0.1; demanded: p3 - 0.2 <= 0. Multipliers by hand, the objective in parts of its size.
    rows = np.array([[[-1.0, -1.0, -1.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]])
    point = point_of(np.full((1, 4), 0.5), np.array([[1.0, -0.1, -0.2, -0.3]]), rows)
    step = solve_model(shape(1, 2), point, np.eye(4)[None], np.array([1.0]), np.array([10.0]), np.array([0.4]))
    np.testing.assert_allclose(step.p, [[0.05, 0.05, 0.2, 0.0]], atol=1e-6)
    np.testing.assert_allclose(step.held, [[0.95]], atol=1e-6)
    np.testing.assert_allclose(step.demands, [[0.8, 0.0]], atol=1e-6)


@pytest.mark.parametrize("size", [0.01, 1.0, 4.0])
def test_step_ends_at_the_kink_of_two_pieces(size):
    """max(2 p, 0.3 - p) + size p^2/2 of one number: they meet at p = 0.1, where 2 s - (1 - s) + size p = 0 shares them. A third
    piece stays below. Demands keep their own multipliers."""
    pieces, piece_gradients = np.array([[0.0, -0.3, 0.3]]), np.array([[[2.0], [-2.0], [-1.0]]])
    rows = np.array([[[-1.0], [1.0]]])
    point = point_of(np.array([[0.5]]), np.array([[0.3, -0.4]]), rows, pieces, piece_gradients)
    step = solve_model(
        shape(0, 1, 3), point, np.ones((1, 1, 1)), np.array([size]), np.array([50.0 + 5.0 / size]), np.array([0.3])
    )
    np.testing.assert_allclose(step.p, [[0.1]], atol=1e-6)
    first = (1.0 - size * 0.1) / 3.0
    np.testing.assert_allclose(step.shares, [[first, 0.0, 1.0 - first]], atol=1e-6)
    np.testing.assert_allclose(step.demands, [[0.0]], atol=1e-6)
    near = point._replace(values=np.array([[0.3, -0.05]]))  # the demand stops it at 0.05: its price is the slope there
    step = solve_model(
        shape(0, 1, 3), near, np.ones((1, 1, 1)), np.array([size]), np.array([50.0 + 5.0 / size]), np.array([0.3])
    )
    np.testing.assert_allclose(step.p, [[0.05]], atol=1e-6)
    np.testing.assert_allclose(step.demands, [[1.0 / size - 0.05]], rtol=1e-5)
    np.testing.assert_allclose(step.shares, [[0.0, 0.0, 1.0]], atol=1e-6)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_only_pieces_that_can_become_largest_are_used(way):
    """Forty, of which two meet at the least value: one is below all others now, and steep where the bound leaves room."""
    pieces, piece_gradients = np.full((1, 40), 4.7), way * np.linspace(-1.5, 1.5, 40)[None, :, None]
    pieces[0, [7, 21]], piece_gradients[0, [7, 21], 0] = [5.0, 4.5], [-2.0 * way, 8.0 * way]
    point = point_of(np.array([[0.5 - 0.49 * way]]), np.array([[5.0]]), piece_gradients[:, 7:8], pieces, piece_gradients)
    step = solve_model(shape(parts=40), point, np.zeros((1, 1, 1)), np.ones(1), np.array([50.0]), np.array([0.1]))
    np.testing.assert_allclose(step.p, [[0.05 * way]], atol=1e-6)  # 5 - 2 p = 4.5 + 8 p
    np.testing.assert_array_equal(np.flatnonzero(step.shares[0] > 1e-4), [7, 21])
    np.testing.assert_allclose(np.sum(step.shares), 1.0, rtol=1e-12)
    np.testing.assert_allclose(np.sum(step.shares[0] * piece_gradients[0, :, 0]), 0.0, atol=1e-5)


def test_predicted_decrease_is_that_of_the_model():
    """g.p + p.B p/2 to its least value: g.B^-1 g/2, in parts of the objective."""
    random = np.random.default_rng(4)
    root = random.normal(size=(2, 3, 3))
    hessian = root @ np.swapaxes(root, 1, 2) + np.eye(3)
    slope, size, value = 0.01 * random.normal(size=(2, 1, 3)), np.array([2.0, 3.0]), np.array([[-5.0], [0.7]])
    p = -np.linalg.solve(hessian * size[:, None, None], slope[:, 0, :, None])[..., 0]
    nothing = np.zeros((2, 0))
    model = Step(p, nothing, nothing, np.ones((2, 1)))
    awaited = 0.5 * np.abs(np.einsum("sd,sd->s", slope[:, 0], p)) / np.abs(value[:, 0])
    np.testing.assert_allclose(
        predicted_decrease(shape(), point_of(np.full((2, 3), 0.5), value, slope), hessian, model, size), awaited, rtol=1e-12
    )


def test_constraint_terms_do_not_count_as_decrease():
    """f = x, to be at least where it is: the slope 1 is paid by the multiplier 1/size, nothing is left. Off by 0.1 the model
    moves there at that price."""
    for size in (1.0, 5.0):
        for kinds in ((1, 0), (0, 1)):
            rows = np.array([[[1.0], [-1.0]]])
            point = point_of(np.array([[0.5]]), np.array([[2.0, 0.1]]), rows)
            dual = np.array([[1.0 / size]])
            none = np.zeros((1, 0))
            model = Step(np.array([[0.1]]), dual if kinds[0] else none, dual if kinds[1] else none, np.ones((1, 1)))
            found = predicted_decrease(shape(*kinds), point, np.array([[[6.0]]]), model, np.array([size]))
            np.testing.assert_allclose(found, [0.5 * 6.0 * size * 0.01 / 2.0], rtol=1e-12)


def test_scale_of_a_zero_objective_is_its_change():
    model = Step(np.array([[0.1, 0.0]]), np.zeros((1, 0)), np.zeros((1, 0)), np.ones((1, 1)))
    point = point_of(np.full((1, 2), 0.5), np.zeros((1, 1)), np.array([[[-3.0, 8.0]]]))
    none = np.zeros((1, 2, 2))
    np.testing.assert_allclose(
        predicted_decrease(shape(), point, none, model, np.array([7.0])), [0.3 / (1e-4 * 8.0)], rtol=1e-12
    )
    tip = point._replace(slopes=np.zeros((1, 1, 2)))  # no slope there: the curvature over the differences' step
    hessian = np.diag([2.0, 6.0])[None]
    awaited = 0.5 * 2.0 * 7.0 * 0.01 / (1e-4 * 1e-5 * 8.0 * 7.0)
    np.testing.assert_allclose(predicted_decrease(shape(), tip, hessian, model, np.array([7.0])), [awaited], rtol=1e-12)


def test_largest_piece_after_the_step_counts():
    pieces, piece_gradients = np.array([[1.0, 0.9]]), np.array([[[-1.0], [0.5]]])
    point = point_of(np.array([[0.5]]), np.array([[1.0]]), piece_gradients[:, :1], pieces, piece_gradients)
    model = Step(np.array([[0.1]]), np.zeros((1, 0)), np.zeros((1, 0)), np.array([[0.5, 0.5]]))
    found = predicted_decrease(shape(parts=2), point, np.zeros((1, 1, 1)), model, np.ones(1))
    np.testing.assert_allclose(found, [0.05], rtol=1e-12)  # from 1 to 0.95, not 0.9
