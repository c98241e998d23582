"""Programs on single numbers: the same values as on arrays, or none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from scenes import scene

import jaxvib as jv
from jaxvib.motion.start import initial_state
from jaxvib.ode import scalarize as module
from jaxvib.ode.scalar_programs import fenced, with_reciprocals, without_repeats
from jaxvib.ode.scalar_rules import primitive_of, rules, to_scalars
from jaxvib.ode.scalarize import (
    MAX_SCALARS,
    NotScalarizable,
    arrays_program,
    scalarize,
    scalarized_program,
    scalarized_vmap,
    scalars_of,
)

X = np.array([[0.3, -0.7, 0.2], [0.9, -0.1, 0.5]])

SAME = {
    "arithmetic": lambda x: (x + 2.0) * x - x / (3.0 + x) + x**3 - (-x) ** 2,
    "elementary": lambda x: jnp.exp(x) + jnp.tanh(x) + jnp.arctan2(x, 2.0) + jnp.sqrt(jnp.abs(x)) + jnp.log1p(x * x),
    "more of them": lambda x: (
        jnp.sinh(x) + jnp.cosh(x) + jnp.expm1(x) + jnp.cbrt(x) + lax.logistic(x) + jnp.tan(x) + jnp.exp2(x)
    ),
    "inverse": lambda x: jnp.arcsin(x) + jnp.arccos(x) + jnp.arctan(x) + lax.erf(x) + lax.rsqrt(x * x + 1.0) + jnp.log(x * x),
    "sines": lambda x: jnp.sin(x) * jnp.cos(3.0 * x),
    "comparisons": lambda x: jnp.where((x > 0.1) & ~(x >= 0.5) | (x == -0.1), x, -x) + jnp.sign(x) + jnp.maximum(x, 0.2),
    "rounding": lambda x: (
        jnp.floor(3.0 * x) + jnp.ceil(x) + jnp.round(5.0 * x) + jnp.clip(x, -0.2, 0.4) + lax.rem(x, jnp.full_like(x, 0.3))
    ),
    "three cases": lambda x: lax.select_n(jnp.int32(2) * (x > 0.0), x, 2.0 * x, 3.0 * x),
    "whole numbers": lambda x: lax.div(jnp.asarray([7, -7, 9]), jnp.asarray([2, 2, 4]))[None] + x,
    "powers": lambda x: x**-2 + lax.pow(jnp.abs(x), jnp.full_like(x, 1.5)) + 2.0**x,
    "sums": lambda x: jnp.sum(x, 0) + jnp.max(x, 0) - jnp.min(x, axis=0) + x.T[:, 0] @ jnp.eye(3),
    "products": lambda x: x @ x.T + jnp.einsum("ij,kj->ik", x, 2.0 * x),
    "shapes": lambda x: jnp.concatenate([x[::-1], jnp.stack([x[0], x[1]]) + jnp.arange(3.0, dtype=x.dtype)[None]]).T.reshape(
        2, 6
    )[:, 1:4],
    "parts": lambda x: jnp.stack(jnp.split(x, [1], axis=1)[0]) + x[:, 2:] + lax.dynamic_slice(x, (5, 0), (1, 1)),
    "inner programs": lambda x: jax.checkpoint(jax.jit(lambda y: y * jnp.sin(y)))(x),
    "a derivative": lambda x: jax.jvp(lambda y: jnp.sin(y) * jnp.sum(y), (x,), (jnp.ones_like(x),))[1],
    "a gradient": lambda x: jax.grad(lambda y: jnp.sum(y[0] * jnp.sin(y[1])) + jnp.sum(y) ** 2)(x),
}


@pytest.mark.parametrize("name", SAME)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_values_are_those_on_arrays(name, dtype):
    x = jnp.asarray(X, dtype)
    on_arrays = SAME[name](x)
    on_scalars = scalarize(SAME[name], x)(to_scalars(x))
    assert on_scalars.shape == on_arrays.shape
    found = np.array([float(v) for v in on_scalars.ravel()]).reshape(on_arrays.shape)
    np.testing.assert_allclose(found, on_arrays, rtol=20 * np.finfo(dtype).eps, atol=20 * np.finfo(dtype).eps)
    program = scalarized_program(SAME[name], x)
    assert program is not None
    assert {v.aval.dtype for v in program.jaxpr.outvars} == {np.dtype(dtype)}


@jax.custom_jvp
def with_its_own_derivative(x):
    return jnp.abs(x)


with_its_own_derivative.defjvp(lambda primals, tangents: (jnp.abs(primals[0]), 0.0 * tangents[0]))


@pytest.mark.parametrize(
    ("function", "named"),
    [
        (jnp.cumsum, "cumsum"),
        (lambda x: lax.fori_loop(0, 3, lambda i, y: 2.0 * y, x), "scan|while"),
        (lambda x: lax.reduce_max(x[:0], (0,)), "empty"),
        (lambda x: x[jnp.argmax(x)], "argmax"),
        (lambda x: lax.pad(x, 0.0, [(1, 1, 1)]), "pad"),
        (with_its_own_derivative, "custom_jvp"),
        (lambda x: jnp.einsum("bi,bi->b", x[:, None], x[:, None]), "batch dimensions"),
    ],
)
def test_what_has_no_rule_stays_on_arrays(function, named):
    x = jnp.arange(1.0, 4.0)
    with pytest.raises(NotScalarizable, match=named):
        scalarize(function, x)(to_scalars(x))
    assert scalarized_program(function, x) is None
    batch = jnp.stack([x, -x])
    alone = scalarized_vmap(lambda y, shared: function(y) * shared)(batch, 2.0)
    np.testing.assert_array_equal(alone, 2.0 * jax.vmap(function)(batch))


def test_failing_or_misshapen_rule_is_not_used(monkeypatch):
    x = jnp.arange(3.0)
    changed = dict(rules())
    monkeypatch.setattr(module, "rules", lambda: changed)
    changed[primitive_of(lax.exp, 1.0)] = lambda x, **_: 1 // 0
    assert scalarized_program(jnp.exp, x) is None
    changed[primitive_of(lax.exp, 1.0)] = lambda x, **_: x[:1]
    assert scalarized_program(jnp.exp, x) is None


def test_an_error_of_the_function_itself_is_not_hidden():
    def broken(x):
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        scalarized_program(broken, jnp.zeros(2))


def test_primitives_are_known_by_themselves_and_not_by_name():
    """Another primitive of the same name has no rule."""
    found = {primitive.name: primitive for primitive in rules()}
    assert {"add", "mul", "select_n", "dot_general", "broadcast_in_dim", "add_any"} <= set(found)
    assert type(found["add"])("add") not in rules()


def test_constant_zero_leaves_no_term_but_a_zero_argument_does():
    """The difference matters if the other factor is infinite."""

    def function(c, x):
        return jnp.stack([jnp.dot(jnp.array([1.0, 0.0]), x), jnp.dot(c, x)])

    c, x = jnp.asarray([1.0, 0.0]), jnp.asarray([2.0, jnp.inf])
    program = scalarized_program(function, c, x)
    assert program is not None
    assert [e.primitive.name for e in program.jaxpr.eqns] == ["mul", "mul", "add"]
    first, second = scalarize(function, c, x)(to_scalars(c), to_scalars(x))
    assert float(first) == 2.0 and np.isnan(float(second))


def expanded(jaxpr):
    """Number of operations of each result if shared values are computed anew for each use, without divisions."""
    cost = {}
    for equation in jaxpr.eqns:
        total = 1 + sum(cost.get(v, 0) for v in {v for v in equation.invars if not hasattr(v, "val")})
        cost.update((v, 0 if equation.primitive.name == "div" else total) for v in equation.outvars)
    return max(cost.get(v, 0) for v in jaxpr.outvars)


def test_nested_shared_values_are_computed_once():
    """A chain in which every value is used twice: 2^40 operations without fences."""

    def chain(t, c):
        a, b = t, c
        for _ in range(40):
            a, b = a * b + c, a - b * c
        return a, b

    program = scalarized_program(chain, jnp.asarray(0.1), jnp.asarray(0.2))
    assert program is not None
    assert expanded(program.jaxpr) > 1e10
    program_of = jax.make_jaxpr(lambda *x: fenced(program, x))(0.1, 0.2)
    assert expanded(program_of.jaxpr) < 200
    for ours, theirs in zip(scalarized_vmap(chain)(jnp.full(3, 0.1), jnp.asarray(0.2)), chain(0.1, 0.2), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-13)


def test_a_batch_has_the_shapes_and_derivatives_that_vmap_gives():
    def function(x, shared):
        t, y = x
        return {"a": y * t * shared["c"][0], "b": jnp.sum(y) + jnp.zeros((0, 2)), "n": jnp.sin(t)}

    batch, shared = (jnp.linspace(0.0, 1.0, 300), jnp.arange(600.0).reshape(300, 2)), {"c": jnp.asarray([2.0])}
    slopes = jax.tree.map(jnp.ones_like, batch)
    ways = (scalarized_vmap(function), jax.vmap(function, in_axes=(0, None)))
    ours, theirs = (jax.jvp(lambda x, way=way: way(x, shared), (batch,), (slopes,)) for way in ways)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-14), ours, theirs)


@pytest.mark.parametrize(("machine", "load"), [("one_mass", "balls"), ("two_mass", "balls")])
def test_second_derivatives_share_their_parts(machine, load):
    """Without fences that of the rotor with four pendulums took ten seconds at 4096 samples."""

    def second(moment, field):
        return jax.jvp(field, moment, (jnp.ones_like(moment[0]), field(*moment)))[1]

    s = scene(machine, load, effects=(jv.Gravity(),))
    moment, field = (jnp.asarray(0.0), initial_state(s)), jv.vector_field(s)
    program = scalarized_program(second, moment, field)
    assert program is not None
    numbers = [*scalars_of(moment), *scalars_of(field)]
    assert expanded(jax.make_jaxpr(lambda *x: fenced(program, x))(*numbers).jaxpr) < 200 < expanded(program.jaxpr)


def test_without_readable_programs_everything_stays_on_arrays(monkeypatch):
    monkeypatch.setattr(module, "HAS_JAXPRS", False)
    x = jnp.arange(3.0)
    assert scalarized_program(jnp.sin, x) is None and arrays_program(jnp.sin, x) is None
    np.testing.assert_array_equal(scalarized_vmap(lambda y, shared: jnp.sin(y) * shared)(x, 2.0), 2.0 * jnp.sin(x))


def test_each_operation_is_done_once_and_none_for_nothing():
    def wasteful(x):
        unread = jnp.tanh(x) ** 3
        del unread
        return (x[0] * x[1] + 2.0) / (x[1] * x[0] + 2.0) + (x[0] - x[1]) * (x[1] - x[0])

    program = scalarized_program(wasteful, jnp.ones(2))
    names = [equation.primitive.name for equation in program.jaxpr.eqns]
    # Differences are not the same in either order; products are.
    assert sorted(names) == ["add", "add", "div", "mul", "mul", "sub", "sub"]
    x = np.array([0.3, -0.7])
    np.testing.assert_allclose(jax.core.eval_jaxpr(program.jaxpr, program.consts, *x), [wasteful(jnp.asarray(x))], rtol=1e-15)


def test_divisions_by_constants_become_products():
    def function(y, c):
        return jnp.stack([y[0] / c[0] + y[1] / c[0], c[1] / y[1], y[0] / y[1], c[0] / c[1]])

    y, c = jnp.asarray([0.3, -0.7]), jnp.asarray([1.7, 2.3])
    program = with_reciprocals(scalarized_program(function, y, c), 2)
    divided = [e.invars for e in program.jaxpr.eqns if e.primitive.name == "div"]
    inputs = program.jaxpr.invars
    assert sum(below in inputs[2:] for _, below in divided) == 2  # 1 / c[0], which two divisions share, and 1 / c[1]
    assert sum(below is inputs[1] for _, below in divided) == 2
    np.testing.assert_allclose(jax.core.eval_jaxpr(program.jaxpr, program.consts, *y, *c), function(y, c), rtol=1e-15)


def test_programs_within_a_program_are_not_taken_for_each_other():
    """They read alike where nothing but the arrays that they hold differs."""

    def function(x):
        one, other = (jax.jit(lambda y, held=held: held * y) for held in np.array([[1.0, 2.0], [3.0, 4.0]]))
        return one(x) + 10.0 * other(x)

    program = without_repeats(jax.make_jaxpr(function)(jnp.ones(2)))
    found = jax.core.eval_jaxpr(program.jaxpr, program.consts, jnp.array([0.5, 0.7]))
    np.testing.assert_allclose(found, [[15.5, 29.4]], rtol=1e-15)


def names_and_values(program, *x):
    names = sorted(equation.primitive.name for equation in program.jaxpr.eqns)
    return names, jax.core.eval_jaxpr(program.jaxpr, program.consts, *x)


def test_on_arrays_sines_and_cosines_are_computed_once_together():
    def function(x):
        y = jnp.sin(x) * jnp.cos(x)
        return jnp.sin(y) + jnp.cos(x), jnp.sin(jnp.float32(2.0))

    x = jnp.linspace(-3.0, 400.0, 50)
    names, found = names_and_values(arrays_program(function, x), x)
    assert names == ["add", "custom_jvp_call", "custom_jvp_call", "mul", "sin"]  # the last of a number of the program
    for ours, jaxs in zip(found, function(x), strict=True):
        np.testing.assert_allclose(ours, jaxs, rtol=0.0, atol=1e-15)


def test_only_so_many_numbers_are_taken_apart():
    """A product of each of a batch's arrays: an operation for each number, or one for all."""

    def size(numbers):
        run = scalarized_vmap(lambda x, factor: factor * x)
        program = jax.make_jaxpr(lambda batch: run(batch, jnp.asarray(3.0)))(jnp.ones((2, numbers)))
        return str(program).count(" mul ")

    assert size(MAX_SCALARS) == MAX_SCALARS and size(MAX_SCALARS + 1) == 1
