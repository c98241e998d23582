"""Equivalent but faster forms of programs on scalars, see `jaxvib.ode.scalarize`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from jax import Array, lax

from jaxvib.numerics.fence import fence, hidden_one
from jaxvib.numerics.sincos import unfenced_sine_and_cosine
from jaxvib.ode.scalar_rules import primitive_of
from jaxvib.runtime.compat import (
    Atoms,
    ClosedJaxpr,
    JaxprEqn,
    Literal,
    Primitive,
    Replacement,
    Var,
    jaxpr_as_fun,
    operation_like,
    rewritten,
)

_MAX_RECOMPUTED = 8
"""Largest number of operations that the compiler may repeat for each use of a value, see `fenced`."""


def without_repeats(program: ClosedJaxpr) -> ClosedJaxpr:
    """Return the same program without repeated and unused operations. In programs of automatic differentiation, these are a
    third to a half of all operations."""
    first: dict[Var, Var | Literal] = {}
    done: dict[tuple[object, ...], JaxprEqn] = {}
    kept: list[tuple[JaxprEqn, list[Var | Literal]]] = []

    def replaced(atoms: Sequence[Var | Literal]) -> list[Var | Literal]:
        return [first.get(atom, atom) if isinstance(atom, Var) else atom for atom in atoms]

    def name(atom: Var | Literal) -> str:
        return f"{np.asarray(atom.val).tobytes()!r} {atom.aval}" if isinstance(atom, Literal) else str(id(atom))

    for equation in program.jaxpr.eqns:
        inputs = replaced(equation.invars)
        names = [name(atom) for atom in inputs]
        if equation.primitive in _commutative():
            names.sort()
        key = (equation.primitive, *names, *(f"{k}={v!r}" for k, v in equation.params.items()))
        # Operations with side effects are kept; parameters that are programs are not compared.
        alone = bool(equation.effects) or any(hasattr(v, "jaxpr") or callable(v) for v in equation.params.values())
        if key in done and not alone:
            first.update(zip(equation.outvars, done[key].outvars, strict=True))
        else:
            done[key] = equation
            kept.append((equation, inputs))
    results = replaced(program.jaxpr.outvars)
    read = {atom for atom in results if isinstance(atom, Var)}
    live = []
    for equation, inputs in reversed(kept):
        if equation.effects or any(atom in read for atom in equation.outvars):
            live.append((equation, inputs))
            read.update(atom for atom in inputs if isinstance(atom, Var))
    return rewritten(program, live[::-1], results)


def fenced(program: ClosedJaxpr, arguments: Sequence[Array]) -> list[Array]:
    """Return the results of a program on scalars, computed so that the compiler cannot repeat the computation of shared values.

    Every value with several uses and more than a few operations is fenced, see `jaxvib.numerics.fence`. Without fences, the
    compiler computes shared values again for each use. In derivatives of equations, shared values depend on other shared
    values; the number of operations then grows with the product of the numbers of uses.
    """
    jaxpr = program.jaxpr
    uses: dict[Var, int] = {}
    for atoms in (*(equation.invars for equation in jaxpr.eqns), jaxpr.outvars):
        for atom in _variables(atoms):
            uses[atom] = uses.get(atom, 0) + 1
    known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*program.consts, *arguments), strict=True))
    read = lambda atom: atom.val if isinstance(atom, Literal) else known[atom]  # noqa: E731
    cost: dict[Var, int] = {}
    one = hidden_one(arguments[0])
    for equation in jaxpr.eqns:
        results = _evaluate_equation(equation, [read(atom) for atom in equation.invars])
        spent = _size(equation) + sum(cost.get(atom, 0) for atom in _variables(equation.invars))
        if equation.primitive == _division():
            spent = 0  # its result is not recomputed
        for atom, result in zip(equation.outvars, results, strict=True):
            is_costly = uses.get(atom, 0) > 1 and spent > _MAX_RECOMPUTED and is_floating(atom)
            known[atom], cost[atom] = (fence(result, one), 0) if is_costly else (result, spent)
    return [read(atom) for atom in jaxpr.outvars]


def _size(equation: JaxprEqn) -> int:
    inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
    return 1 if inner is None else sum(_size(each) for each in getattr(inner, "jaxpr", inner).eqns)


def _evaluate_equation(equation: JaxprEqn, values: list[Array]) -> Sequence[Array]:
    inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
    if inner is None:
        found = equation.primitive.bind(*values, **equation.params)
        return found if equation.primitive.multiple_results else [found]
    # Sine and cosine are the only operation with a custom derivative (`call_jaxpr`) in these programs.
    return unfenced_sine_and_cosine(*values) if "call_jaxpr" in equation.params else jaxpr_as_fun(inner)(*values)


@functools.cache
def _division() -> Primitive:
    return primitive_of(lax.div, np.float32(1.0), np.float32(2.0))


@functools.cache
def _commutative() -> set[Primitive]:
    """Commutative operations."""
    return {primitive_of(operation, np.float32(1.0), np.float32(2.0)) for operation in (lax.add, lax.mul)}


def is_floating(x: Any) -> bool:
    """Return True if a variable of a program has single or double precision. `jaxvib.numerics` computes sines only of these."""
    return x.aval.dtype in (np.float32, np.float64)


def _variables(atoms: Iterable[Var | Literal]) -> list[Var]:
    """Return the variables among the atoms, each once, in order."""
    return list(dict.fromkeys(atom for atom in atoms if isinstance(atom, Var)))


def substituted(program: ClosedJaxpr, chosen: Callable[[JaxprEqn, Atoms], Replacement | None]) -> ClosedJaxpr:
    """Return the program in which operations with one result are replaced: `chosen`, a function of an operation and its inputs,
    returns the operations in its place and the variable of their result, or None to keep it."""
    instead: dict[int, Var] = {}
    equations: list[tuple[JaxprEqn, Atoms]] = []

    def replaced(atoms: Sequence[Var | Literal]) -> Atoms:
        return [instead.get(id(atom), atom) for atom in atoms]

    for equation in program.jaxpr.eqns:
        inputs = replaced(equation.invars)
        found = chosen(equation, inputs)
        equations += [(equation, inputs)] if found is None else found[0]
        if found is not None:
            instead[id(equation.outvars[0])] = found[1]
    return rewritten(program, equations, replaced(program.jaxpr.outvars))


def with_reciprocals(program: ClosedJaxpr, changing: int) -> ClosedJaxpr:
    """Return the program in which divisions by constant values are products with the reciprocals of these values.

    A time loop then computes the reciprocals once. The results change by rounding errors. The first `changing` inputs change
    within the loop, the others do not.
    """
    moving = set(program.jaxpr.invars[:changing])
    for equation in program.jaxpr.eqns:
        if moving.intersection(_variables(equation.invars)):
            moving.update(equation.outvars)
    reciprocals: dict[Var, Var] = {}

    def product(equation: JaxprEqn, inputs: Atoms) -> Replacement | None:
        divisor = inputs[-1]
        if equation.primitive != _division() or not isinstance(divisor, Var) or divisor in moving or not is_floating(divisor):
            return None
        added: list[tuple[JaxprEqn, Atoms]] = []
        if divisor not in reciprocals:
            inverse = operation_like(lambda x: 1.0 / x, divisor)
            added.append((inverse, [inverse.invars[0], divisor]))
            reciprocals[divisor] = inverse.outvars[0]
        times = operation_like(lambda x, y: x * y, divisor, divisor)
        return [*added, (times, [inputs[0], reciprocals[divisor]])], times.outvars[0]

    return substituted(program, product)
