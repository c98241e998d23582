"""Roots in a bracket, with derivatives by the implicit function theorem."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

Numbers = TypeVar("Numbers", np.ndarray, Array)


def bracketed_root(
    f: Callable[[Array], Array],
    low: Array,
    high: Array,
    ends: tuple[Array, Array] | None = None,
    *,
    fast: Callable[[Array], Array] | None = None,
    polish: Array | None = None,
) -> Array:
    """Return the root of `f` between `low` and `high` (scalars) up to rounding; f must change sign once between them.

    Each step is an inverse quadratic interpolation if its result is reliable, otherwise a bisection (Chandrupatla, Adv. Eng.
    Software 28, 1997). Derivatives of any order follow from the implicit function theorem.

    **Arguments**

    - `ends`: f(low) and f(high) if they are known
    - `fast`: the same function at lower cost, for the search; `f` is then used for derivatives only, and for `polish`
    - `polish`: Boolean scalar; if it is True, three steps of Newton's method on `f` follow the search
    """

    def solve(exact: Callable[[Array], Array], _: Array) -> Array:
        g = exact if fast is None else fast
        tolerance = 2.0 * jnp.finfo(low.dtype).eps

        def is_open(carry: tuple[Array, ...]) -> Array:
            steps, a, fa, b, fb, *_ = carry
            width = tolerance * jnp.maximum(jnp.abs(a), jnp.abs(b))
            bracketed = ((fa > 0.0) != (fb > 0.0)) & (fa != 0.0) & (fb != 0.0)
            return (steps < 2 * jnp.finfo(low.dtype).bits) & (jnp.abs(b - a) > width) & bracketed

        def size(value: Array) -> Array:
            return jnp.where(jnp.isnan(value), jnp.inf, jnp.abs(value))

        def step(carry: tuple[Array, ...]) -> tuple[Array, ...]:
            steps, a, fa, b, fb, share, best, least = carry
            x = a + share * (b - a)
            fx = g(x)
            size_at_x = size(fx)
            best, least = jnp.where(size_at_x < least, x, best), jnp.minimum(size_at_x, least)
            same = (fx > 0.0) == (fa > 0.0)
            c, fc = jnp.where(same, a, b), jnp.where(same, fa, fb)
            b, fb = jnp.where(same, b, a), jnp.where(same, fb, fa)
            a, fa = x, fx
            return steps + 1, a, fa, b, fb, next_share(jnp, (a, fa), (b, fb), (c, fc), tolerance), best, least

        # Both ends are evaluated in one `vmap`, so that the program contains one copy of g, not two.
        f_low, f_high = jax.vmap(g)(jnp.stack([low, high])) if ends is None else ends
        # The compiler may recompute g(x) for each use with other rounding. Near the root the signs of two copies can differ,
        # and the bracket is lost. The point with the smallest |g| is then the root.
        at_low, at_high = size(f_low), size(f_high)
        best, least = jnp.where(at_low < at_high, low, high), jnp.minimum(at_low, at_high)
        start = (jnp.asarray(0), low, f_low, high, f_high, jnp.full_like(low, 0.5), best, least)
        root = jax.lax.while_loop(is_open, step, start)[6]
        return root if polish is None else polished(exact, g, root, polish)

    def polished(exact: Callable[[Array], Array], g: Callable[[Array], Array], root: Array, needed: Array) -> Array:
        def newton(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            steps, x = carry
            slope = jax.jvp(g, (x,), (jnp.ones_like(x),))[1]
            better = x - exact(x) / _nonzero(slope)
            inside = (better >= jnp.minimum(low, high)) & (better <= jnp.maximum(low, high))
            return steps + 1, jnp.where(inside, better, x)

        return jax.lax.while_loop(lambda carry: needed & (carry[0] < 3), newton, (jnp.asarray(0), root))[1]

    low, high, ends = jax.lax.stop_gradient((low, high, ends))
    return jax.lax.custom_root(f, low, solve, _by_slope)


def known_root(f: Callable[[Array], Array], root: Array) -> Array:
    """Return the known `root` of `f` (scalar) with the derivatives of `bracketed_root`."""
    root = jax.lax.stop_gradient(root)
    return jax.lax.custom_root(f, root, lambda *_: root, _by_slope)


def _by_slope(g: Callable[[Array], Array], y: Array) -> Array:
    """Return the solution of g(x) = y for a linear function `g`."""
    return y / _nonzero(g(jnp.ones_like(y)))


def next_share(
    xp: ModuleType,
    newest: tuple[Numbers, Numbers],
    other: tuple[Numbers, Numbers],
    before: tuple[Numbers, Numbers],
    tolerance: float | np.floating,
) -> Numbers:
    """Return the next point of the search for a root, as a fraction of the way from `newest` to `other`, the ends (x, f(x)) of
    the bracket. `xp`: numpy or jax.numpy; `before`: the end that was replaced last; `tolerance` of x, relative."""
    (a, fa), (b, fb), (c, fc) = newest, other, before
    xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
    safe = (1.0 - xp.sqrt(1.0 - xi) < phi) & (phi < xp.sqrt(xi))
    guess = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
    edge = xp.minimum(0.5 * tolerance * xp.abs(a) / xp.abs(b - a), 0.5)
    return xp.where(safe, xp.clip(guess, edge, 1.0 - edge), 0.5)


def _nonzero(slope: Array) -> Array:
    """Replace a slope of 0 by a tiny one, which prevents an overflow at a fold, where no derivative exists."""
    tiny = jnp.finfo(slope.dtype).tiny ** 0.5
    return jnp.where(jnp.abs(slope) < tiny, tiny, slope)
