"""C source of scalar programs.

Statements that depend only on parameters form a separate function, which is called when a parameter changes; the equations read
its results as constants. Each operation is one statement. An operation without a rule raises an error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxvib.errors import InputError
from jaxvib.runtime.compat import ClosedJaxpr, JaxprEqn, Literal, Var

_CALLS = ("exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh")
_CALLS += ("asinh", "acosh", "atanh", "erf", "erfc", "floor", "ceil")

_RULES: Mapping[str, str] = {
    "add": "{0} + {1}",
    "add_any": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "neg": "-{0}",
    "square": "{0} * {0}",
    "abs": "fabs({0})",
    "sign": "{0} > 0.0 ? 1.0 : {0} < 0.0 ? -1.0 : {0}",
    "rsqrt": "1.0 / sqrt({0})",
    "logistic": "1.0 / (1.0 + exp(-{0}))",
    "pow": "pow({0}, {1})",
    "atan2": "atan2({0}, {1})",
    "rem": "fmod({0}, {1})",
    "is_finite": "isfinite({0})",
    "eq": "{0} == {1}",
    "ne": "{0} != {1}",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "gt": "{0} > {1}",
    "ge": "{0} >= {1}",
    "and": "{0} & {1}",
    "or": "{0} | {1}",
    "copy": "{0}",
    "copy_p": "{0}",
    **{name: f"{name}({{0}})" for name in _CALLS},
}
"""C expressions of the operations of JAX, by their names; {0} and {1} are the operands."""

_BRANCHES = {"lt": "<", "le": "<=", "gt": ">", "ge": ">="}
"""Comparisons that select one of two expressions, such as contact or no contact."""


class CProgram(NamedTuple):
    """Program in C.

    **Attributes**: `prepare`: the statements that depend only on parameters; `body`: the other statements; `constants`: number
    of results of `prepare` that `body` reads; `branches`: number of comparisons in `body` that are event indicators.
    """

    prepare: list[str]
    body: list[str]
    constants: int
    branches: int


def number_text(value: Any) -> str:
    """Return a number as C text that a compiler converts to the same bits.

    >>> number_text(0.1), number_text(-3.0), number_text(True)
    ('0.1', '-3.0', '1')
    """
    if isinstance(value, (bool, np.bool_, int, np.integer)):
        return str(int(value))
    value = float(value)
    if math.isnan(value):
        return "NAN"
    return repr(value) if math.isfinite(value) else "INFINITY" if value > 0.0 else "-INFINITY"


def write_program(
    program: ClosedJaxpr, inputs: Sequence[str], parameters: int, outputs: Sequence[str], *, has_events: bool = False
) -> CProgram:
    """Write a scalar program as C.

    **Arguments**: `inputs`: the C expression of each argument; `parameters`: number of leading arguments that change only at
    events; `outputs`: the C expression to which each result is assigned; `has_events`: True for event indicators. Each
    comparison of real numbers in `body`, except choices of pivots, then assigns the difference of both numbers to an indicator.

    **Raises** `InputError` for an operation without a rule; the message names the operation.
    """
    return _Writer(program, inputs, parameters, has_events).translate(outputs)


class _Writer:
    def __init__(self, program: ClosedJaxpr, inputs: Sequence[str], parameters: int, has_events: bool):
        jaxpr = program.jaxpr
        self.program = program
        self.has_events = has_events
        self.names = dict(zip(jaxpr.constvars, map(number_text, map(np.asarray, program.consts)), strict=True))
        self.names |= dict(zip(jaxpr.invars, inputs, strict=True))
        self.early: set[Var] = {*jaxpr.constvars, *jaxpr.invars[:parameters]}
        self.magnitudes: set[Var] = set()
        self.constants: dict[Var, str] = {}
        self.prepare: list[str] = []
        self.body: list[str] = []
        self.branches = 0

    def translate(self, outputs: Sequence[str]) -> CProgram:
        jaxpr = self.program.jaxpr
        for equation in jaxpr.eqns:
            early = all(isinstance(atom, Literal) or atom in self.early for atom in equation.invars)
            for variable, text in zip(equation.outvars, self._expressions(equation, early), strict=True):
                name = f"x{len(self.names)}"
                kind = "double" if np.issubdtype(_dtype(variable), np.floating) else "int"
                (self.prepare if early else self.body).append(f"const {kind} {name} = {text};")
                self.names[variable] = name
                if early:
                    self.early.add(variable)
            if equation.primitive.name == "abs":
                self.magnitudes.update(equation.outvars)
        for atom, target in zip(jaxpr.outvars, outputs, strict=True):
            self.body.append(f"{target} = {self._read(atom, early=False)};")
        self.prepare += [f"{place} = {self.names[variable]};" for variable, place in self.constants.items()]
        return CProgram(self.prepare, self.body, len(self.constants), self.branches)

    def _read(self, atom: Var | Literal, *, early: bool) -> str:
        """Return the C expression of a value, in `prepare` if `early`, otherwise in `body`."""
        if isinstance(atom, Literal):
            text = number_text(np.asarray(atom.val, _dtype(atom)).item())
            return f"({text})" if text.startswith("-") else text
        name = self.names[atom]
        is_computed_early = atom in self.early and name.startswith("x")
        if early or not is_computed_early:
            return name
        return self.constants.setdefault(atom, f"constants[{len(self.constants)}]")

    def _expressions(self, equation: JaxprEqn, early: bool) -> list[str]:
        """Return the C expression of each result of an operation."""
        name, params = equation.primitive.name, equation.params
        values = [self._read(atom, early=early) for atom in equation.invars]
        if name == "custom_jvp_call":  # in scalar programs only `sine_and_cosine` has a custom rule
            return [f"sin({values[0]})", f"cos({values[0]})"]
        # A comparison of two magnitudes selects a pivot in the solution of linear equations; it is not an event of the machine.
        if name in _BRANCHES and not early and _is_real(equation) and not self.magnitudes.issuperset(_variables(equation)):
            return [self._branch(f"{values[0]} {_BRANCHES[name]} {values[1]}", *values)]
        if name in ("max", "min", "clamp"):
            real = not early and _is_real(equation)
            if name != "clamp":
                return [self._select_larger(values[0], values[1], ">" if name == "max" else "<", real)]
            low, x, high = values
            lower_bounded = f"x{len(self.names)}a"
            (self.prepare if early else self.body).append(
                f"const double {lower_bounded} = {self._select_larger(x, low, '>', real)};"
            )
            return [self._select_larger(lower_bounded, high, "<", real)]
        if (rule := _SPECIAL.get(name)) is not None:
            return [rule(values, params, equation)]
        if name not in _RULES or (name == "div" and not _is_real(equation)):
            problem = f"needs the operation {name!r} of JAX, which cannot be written in C; remove the part that needs it"
            raise InputError("scene", problem)
        return [_RULES[name].format(*values)]

    def _select_larger(self, x: str, y: str, than: str, real: bool) -> str:
        """Return the C expression of the larger (`than` is ">") or smaller ("<") of two numbers; NaN if one of them is NaN."""
        test = f"{x} {than} {y} || {x} != {x}"
        return f"{self._branch(test, x, y) if real else f'({test})'} ? {x} : {y}"

    def _branch(self, test: str, x: str, y: str) -> str:
        """Return a comparison as C text, and assign the difference of the two values to an event indicator."""
        if self.has_events:
            self.body.append(f"indicators[{self.branches}] = {x} - {y};")
            self.branches += 1
        return f"({test})"


def _dtype(atom: Any) -> np.dtype:
    return atom.aval.dtype


def _is_real(equation: JaxprEqn) -> bool:
    return np.issubdtype(_dtype(equation.invars[0]), np.floating)


def _variables(equation: JaxprEqn) -> list[Var | None]:
    return [atom if isinstance(atom, Var) else None for atom in equation.invars]


def _power(values: list[str], params: Mapping[str, Any], equation: JaxprEqn) -> str:
    n = int(params["y"])
    product = " * ".join([values[0]] * abs(n)) if 0 < abs(n) <= 4 else f"pow({values[0]}, {abs(n)})"
    return product if n > 0 else f"1.0 / ({product})"


def _select(values: list[str], params: Mapping[str, Any], equation: JaxprEqn) -> str:
    index, *cases = values
    if len(cases) == 2:
        return f"{index} ? {cases[1]} : {cases[0]}"
    return " : ".join([*(f"{index} == {k} ? {case}" for k, case in enumerate(cases[:-1])), cases[-1]])


def _convert(values: list[str], params: Mapping[str, Any], equation: JaxprEqn) -> str:
    new = np.dtype(params["new_dtype"])
    if new.kind == "b":
        return f"{values[0]} != 0"
    return f"({'int' if np.issubdtype(new, np.integer) else 'double'}){values[0]}"


def _not(values: list[str], params: Mapping[str, Any], equation: JaxprEqn) -> str:
    return f"!{values[0]}" if _dtype(equation.invars[0]).kind == "b" else f"~{values[0]}"


def _round(values: list[str], params: Mapping[str, Any], equation: JaxprEqn) -> str:
    return f"{'rint' if params['rounding_method'] == jax.lax.RoundingMethod.TO_NEAREST_EVEN else 'round'}({values[0]})"


_SPECIAL: Mapping[str, Callable[[list[str], Mapping[str, Any], JaxprEqn], str]] = {
    "integer_pow": _power,
    "select_n": _select,
    "convert_element_type": _convert,
    "not": _not,
    "round": _round,
}
"""Operations whose expression depends on their parameters."""
