"""Derivatives and batches of cached functions, whose programs are cached too."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib.runtime import cache, compat, programs, structure

traces, provided = [], []
X = jnp.asarray([0.3, -1.2, 2.0])
SHIFT = jnp.asarray(0.7)


class Wave(eqx.Module):
    values: jax.Array
    phase: jax.Array
    turns: jax.Array  # whole numbers have no derivative
    name: str = eqx.field(static=True)


def wave(x, shift, name):
    traces.append(name)
    return Wave(jnp.sin(x) * x + shift, jnp.exp(1j * x), jnp.floor(x).astype(int), name + "!")


def from_wave(found, x, shift, name):
    """Outputs that follow from a known wave, as if the sine had been searched for."""
    provided.append(name)
    sine = jax.lax.stop_gradient((found.values - shift) / x) + jnp.cos(x) * (x - jax.lax.stop_gradient(x))
    return Wave(sine * x + shift, None, None, found.name)


def plain(x, shift=SHIFT):
    return wave(x, shift, "plain")


@pytest.fixture(params=[None, from_wave], ids=["residuals", "from solution"])
def asked(tmp_path, monkeypatch, unwatched, request):
    """A function that asks as another process would: no program is held in memory, those on disk are."""
    monkeypatch.setattr(structure, "KNOWN_PACKAGES", structure.KNOWN_PACKAGES | {__name__})
    monkeypatch.setitem(globals(), "wave", programs.cached(outputs_from_solution=request.param)(wave))
    cache.set_program_folder(tmp_path)

    def forgetful(x, shift=SHIFT):
        return globals()["wave"](x, shift, "a")

    def forget():
        traces.clear()
        provided.clear()
        programs._pullbacks.clear()
        kinds = (
            programs._jvp_program,
            programs._vjp_forward,
            programs._vjp_backward,
            programs._vjp_from_solution,
            programs._batched_program,
        )
        for function in (globals()["wave"], *kinds):
            function.stored.ready.clear()

    forget()
    yield forgetful, forget
    forget()
    cache.set_program_folder(None)


def number(function, x, shift=SHIFT):
    found = function(x, shift)
    return jnp.sum(found.values**2) + found.phase[0].imag


ROUTES = {
    "grad": lambda f: jax.grad(functools.partial(number, f))(X),
    "of two": lambda f: jax.grad(functools.partial(number, f), argnums=(0, 1))(X, SHIFT),
    "jvp": lambda f: jax.jvp(lambda x: f(x).values, (X,), (jnp.ones(3),)),
    "jacfwd": lambda f: jax.jacfwd(lambda x: f(x).values)(X),
    "jacfwd, complex": lambda f: jax.jacfwd(lambda x: f(x).phase)(X),
    "jacrev": lambda f: jax.jacrev(lambda x: f(x).values)(X),
    "vmap": lambda f: jax.vmap(lambda x: f(x).values)(jnp.stack([X, 2.0 * X])),
    "vmap along the last axis": lambda f: jax.vmap(lambda x: f(x).values, in_axes=1, out_axes=1)(jnp.stack([X, -X], axis=1)),
    "vmap of one argument": lambda f: jax.vmap(lambda shift: f(X, shift).values)(jnp.arange(4.0)),
    "linearize": lambda f: jax.linearize(lambda x: f(x).values, X)[1](jnp.arange(3.0)),
    "linearize, many": lambda f: jax.vmap(jax.linearize(lambda x: f(x).values, X)[1])(jnp.eye(3)),
    "jvp in a batch of one argument": lambda f: jax.vmap(
        lambda shift: jax.jvp(lambda *both: f(*both).values, (X, shift), (jnp.ones(3), jnp.ones(())))
    )(jnp.arange(4.0)),
    "vjp": lambda f: jax.vjp(lambda x: (f(x).values, f(x).phase), X)[1]((jnp.ones(3), jnp.full(3, 1j))),
}


@pytest.mark.parametrize("route", ROUTES)
def test_another_process_need_not_trace_derivatives(asked, route):
    function, forget = asked
    np.testing.assert_equal(jax.tree.map(np.shape, ROUTES[route](function)), jax.tree.map(np.shape, ROUTES[route](plain_wave)))
    assert set(traces) == {"a"}
    forget()
    again = ROUTES[route](function)
    assert not traces, "traced again, though its program is on disk"
    for ours, theirs in zip(jax.tree.leaves(again), jax.tree.leaves(ROUTES[route](plain_wave)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-14, atol=1e-14)


def plain_wave(x, shift=SHIFT):
    """The function as JAX differentiates it without any of this."""
    return Wave(jnp.sin(x) * x + shift, jnp.exp(1j * x), jnp.floor(x).astype(int), "a!")


OTHERS = {
    "second derivatives": lambda f: jax.hessian(functools.partial(number, f))(X),
    "a gradient of each": lambda f: jax.vmap(jax.grad(functools.partial(number, f)))(jnp.stack([X, 2.0 * X])),
    "within jit": lambda f: jax.jit(jax.grad(functools.partial(number, f)))(X),
    "known numbers within jit": lambda f: jax.jit(lambda t: jax.jvp(lambda x: f(x).values, (X,), (t,)))(jnp.ones(3)),
    "a gradient there within jit": lambda f: jax.jit(lambda c: c * jax.grad(functools.partial(number, f))(X))(2.0),
    "tangents through jit": lambda f: jax.jit(jax.linearize(lambda x: f(x).values, X)[1])(jnp.arange(3.0)),
    "transposed within jit": lambda f: jax.jit(jax.vjp(lambda x: f(x).values, X)[1])(jnp.arange(3.0)),
}


@pytest.mark.parametrize("route", OTHERS)
def test_other_transformations_go_through(asked, route):
    """Derivatives of derivatives and what `jit` compiles: JAX transforms the function itself."""
    function, _ = asked
    for ours, theirs in zip(jax.tree.leaves(OTHERS[route](function)), jax.tree.leaves(OTHERS[route](plain_wave)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-14, atol=1e-14)


def labelled(x, labels):
    return {"label": labels[0], "value": jnp.sin(x), "whole": 2}


@pytest.mark.parametrize("labels", [("a",), ["a"], (np.float64(1.0),)])
def test_static_arguments_and_results_allow_derivatives(asked, labels, monkeypatch, tmp_path):
    function = programs.cached(labelled)
    monkeypatch.setitem(globals(), "labelled", function)  # where it is found by its name
    for route in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(route(lambda x: function(x, labels)["value"])(X), np.diag(np.cos(X)), atol=1e-15)
    values, slopes = jax.jvp(lambda x: function(x, labels)["value"], (X,), (X,))
    np.testing.assert_allclose(values, np.sin(X), rtol=1e-15)
    np.testing.assert_allclose(slopes, X * np.cos(X), rtol=1e-15)
    assert len(list(tmp_path.glob("_batched_program-*"))) == 2 or isinstance(labels[0], np.float64)  # a class from outside


def test_an_argument_without_a_hash_is_differentiated_as_before(asked):
    class Bare:
        __hash__ = None

    call = programs._CallSignature(programs.cached(labelled), structure.Skeleton(((X, Bare()), {})))
    assert not call.is_hashable()


def test_whole_numbers_have_no_tangent(asked):
    function, _ = asked
    found, slopes = jax.jvp(function, (X,), (jnp.ones(3),))
    assert found.name == "a!" and found.turns.tolist() == [0, -2, 2]
    assert slopes.turns.dtype == jax.dtypes.float0


@programs.cached
def with_argument(x, factor):
    return x, factor * x


def test_a_number_that_is_returned_unchanged_has_a_derivative():
    for derivative in (jax.grad, jax.jacfwd):
        assert derivative(lambda x: with_argument(x, 3.0)[1])(2.0) == 3.0
        assert derivative(lambda x: with_argument(x, 3.0)[0])(2.0) == 1.0


def test_a_reverse_derivative_that_was_not_asked_for_before(asked):
    """The forward half is on disk, the backward half is not: it is traced from the function again, or from its result."""
    function, forget = asked
    jax.grad(functools.partial(number, function))(X)
    forget()
    found = jax.grad(lambda x: jnp.sum(function(x).values))(X)
    assert sorted(traces + provided) == ["a"]
    np.testing.assert_allclose(found, np.sin(X) + X * np.cos(X), rtol=1e-14)


@pytest.mark.parametrize("asked", [None], indirect=True)
def test_forms_of_reverse_derivatives_do_not_pile_up(asked, monkeypatch):
    function, _ = asked
    monkeypatch.setattr(programs, "MAX_PULLBACK_FORMS", 2)
    for size in range(2, 6):
        jax.grad(lambda x: jnp.sum(function(x).values))(jnp.arange(float(size)))
    assert len(programs._pullbacks) == 2


def test_without_rules_of_primitives_derivatives_are_traced(asked, monkeypatch):
    function, forget = asked
    monkeypatch.setattr(programs, "CAN_DEFINE_PRIMITIVES", False)
    for _ in range(2):
        forget()
        np.testing.assert_allclose(ROUTES["grad"](function), ROUTES["grad"](plain_wave), rtol=1e-14)
        jax.clear_caches()
    assert traces == ["a"]


def test_an_error_of_the_function_is_raised_under_a_derivative(asked):
    def fails(x):
        raise ValueError("the function's own")

    function = programs.cached(fails)
    function.__wrapped__.__qualname__ = function.__qualname__ = "fails"
    with pytest.raises(ValueError, match="the function's own"):
        jax.grad(function)(jnp.asarray(1.0))


def test_what_has_no_name_is_differentiated_all_the_same(asked):
    cubed = programs.cached(lambda x: x**3)
    assert float(jax.grad(cubed)(2.0)) == 12.0 and jax.vmap(cubed)(jnp.arange(3.0)).tolist() == [0.0, 1.0, 8.0]


def test_derivatives_of_jam_modes_equal_those_without_cache(asked):
    s = scene("two_mass", "balls")

    def force(k):
        return jv.jam_modes(eqx.tree_at(lambda s: s.machine.stiffness, s, k)).select(3, throw=False).foundation_force

    k = s.machine.stiffness
    stored = [jax.grad(force)(k), jax.jacfwd(force)(k), jax.jacrev(force)(k)]
    cache.set_program_folder(None)
    for found in stored:
        np.testing.assert_allclose(found, jax.grad(force)(k), rtol=1e-12)


@pytest.mark.parametrize("tracer", ["grad", "jvp", "vmap"])
def test_inner_value_of_a_tracer_is_found(tracer):
    seen = []

    def look(x):
        seen.append(compat.inner_value(x))
        return x * 1.0

    {"grad": jax.grad(look), "jvp": lambda x: jax.jvp(look, (x,), (x,)), "vmap": lambda x: jax.vmap(look)(x[None])}[tracer](
        SHIFT
    )
    assert seen[0] is not None and not compat.traced(seen[0]) and float(jnp.ravel(seen[0])[0]) == float(SHIFT)
    jax.jit(lambda x: seen.append(compat.inner_value(x)))(SHIFT)
    assert seen[1] is None


@pytest.mark.parametrize("asked", [from_wave], indirect=True)
def test_a_reverse_derivative_is_taken_of_what_the_result_tells(asked):
    """The function is traced once more if other outputs are needed."""
    function, _ = asked
    with pytest.MonkeyPatch.context() as patch:
        for name in ("_vjp_forward", "_vjp_backward"):
            patch.setattr(programs, name, None)
        values = lambda f: jax.grad(lambda x, shift: jnp.sum(f(x, shift).values ** 2), argnums=(0, 1))(X, SHIFT)  # noqa: E731
        for route, times in ((values, 1), (ROUTES["of two"], 2)):
            found = route(function)
            assert traces == ["a"] * times and set(provided) == {"a"}
            for ours, theirs in zip(found, route(plain_wave), strict=True):
                np.testing.assert_allclose(ours, theirs, rtol=1e-12)
