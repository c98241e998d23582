"""Quantities of a scene, their arithmetic, and demands on them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Any, Literal, TypeAlias, TypeVar, cast

import jax.numpy as jnp
from jax import Array

from jaxvib.boundary import call_user, validated, with_known_names
from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import allowed_unknowns
from jaxvib.numerics.extrema import greatest
from jaxvib.steady.jams.jam import JamModes
from jaxvib.units import Number, count
from jaxvib.units.reading import Quantity as UnitQuantity
from jaxvib.units.reading import in_own_unit
from optimize.quantities.evaluation import Evaluation
from optimize.quantities.user_inputs import count_required_arguments, number_in, same_unit

Pair = int | tuple[int, int] | None
"""Platform of an amplitude, or pair of platforms of a relative amplitude; None: see `resolve_pair`."""

Tier: TypeAlias = Literal["leading", "exact", "time"]
"""Method by which a quantity is computed: leading order of light loads, the exact periodic motion, or time integration."""

TIERS: tuple[Tier, ...] = ("leading", "exact", "time")

F = TypeVar("F", bound=Callable[..., Any])

Operand: TypeAlias = "Quantity | Number"

_MAX_WRITTEN = 500
"""Largest number of characters of an argument in the text of a quantity."""

_UNIT = re.compile(r"[+-]?[\d.]+(?:[eE][+-]?\d+)?\s*(\S.*)")
"""Pattern of a limit that is written with a unit, such as "2 mm"."""


@with_known_names
@dataclass(frozen=True, repr=False)
class Quantity:
    """Function of a scene with a scalar value, a name and a unit. Quantities can be added, multiplied and compared.

    **Arguments**

    - `name` of the quantity
    - `unit`, "" for none
    - `function` of a `Scene`, or of a `Scene` and its jam modes (`jaxvib.JamModes`), that returns a
      differentiable scalar, NaN if the quantity does not exist
    - `mode`: the jam mode to which the quantity refers, if any; typical: 1, 3, 5
    - `of`: the platform or the pair of platforms whose amplitude the quantity contains, if any
    - `parts`: the quantities from which this quantity is computed, for example the terms of a sum
    - `written`: the Python expression that `repr` shows; default: one that follows from the other arguments

    The operators `+ - * / **` on quantities and numbers give quantities; `<` and `>` give a `Demand`. Operands of a sum or a
    comparison must have the same unit. A string such as "50 N" can be an operand: `force < "50 N"`,
    `0.3 * a / "1 mm" + force / "10 N"`.

    **Raises** `InputError` if `name` or `unit` is not a string, or if `function` is not a function of one or two arguments. The
    operators raise it for units that do not match.

    >>> import jaxvib as jv
    >>> from optimize import Quantity, foundation_force
    >>> heaviest = Quantity("heaviest platform", "kg", lambda scene: scene.machine.mass.max())
    >>> (foundation_force(mode=3) / heaviest < 0.5).words
    'foundation force, mode 3 / heaviest platform at most 0.5 N/kg'
    """

    name: str
    unit: str
    function: Callable[..., Array] | None = None
    mode: int | None = None
    of: Pair = None
    parts: tuple[Quantity, ...] = field(default=(), kw_only=True)
    written: str = field(default="", kw_only=True, compare=False)

    def __repr__(self) -> str:
        """Return the quantity as it is written in Python."""
        if self.written or type(self) is not Quantity:
            return self.written or f"<{', '.join(filter(None, (self.words, self.unit)))}>"
        return f'Quantity("{self.name}", "{self.unit}", {getattr(self.function, "__name__", "...")})'

    def __post_init__(self) -> None:
        for argument, value in (("name", self.name), ("unit", self.unit)):
            if not isinstance(value, str):
                raise InputError(f"quantity.{argument}", f"is {quoted(value)}; it must be a string")
        if self.mode is not None:
            count(self.mode, f"quantity {quoted(self.name)}.mode")
        if type(self) is Quantity and not (callable(self.function) and count_required_arguments(self.function) in (1, 2)):
            problem = "give a function of a scene, or of a scene and its jam modes"
            raise InputError(f"quantity {quoted(self.name)}", f"has the function {quoted(self.function)}; {problem}")

    @validated
    def __call__(self, scene: Scene, modes: JamModes | None = None) -> Array:
        """Return the value for a scene, a scalar in `unit`.

        **Arguments**: `scene`; `modes`: the jam modes of the scene, default: they are computed.

        **Returns** NaN if a parameter that JAX traces has a value that its constructor would reject.

        **Raises** `ComputationError` for a quantity of the working regime if the scene has no stable synchronous regime.
        """
        value, allowed = self.read(Evaluation(scene, modes=modes)), allowed_unknowns(scene)
        return value if allowed is None else jnp.where(allowed, value, jnp.nan)

    def read(self, evaluation: Evaluation) -> Array:
        """Return the value of the quantity, a scalar in `unit`, from an `evaluation` of a scene."""
        assert self.function is not None
        field, arguments = f"quantity {quoted(self.name)}", (evaluation.scene,)
        if count_required_arguments(self.function) == 2:
            arguments = (evaluation.scene, evaluation.modes)
        value = call_user(self.function, field, *arguments)
        try:
            return jnp.reshape(value, ())
        except TypeError as error:
            raise InputError(field, f"gives {quoted(value)}; it must give one real number") from error

    def pieces(self, evaluation: Evaluation, sign: float = 1.0) -> Array:
        """Return smooth values (p,) in `unit` whose maximum is `sign` (1 or -1) times the quantity, from an `evaluation`.

        At designs for which two pieces are equal and largest, the quantity has a kink, along which a search can move.
        """
        return jnp.reshape(sign * self.read(evaluation), (1,))

    @property
    def words(self) -> str:
        """Name of the quantity for tables and sentences."""
        return self.name.replace("_", " ")

    @property
    def forward_only(self) -> bool:
        """True if the derivatives of the quantity exist in forward mode only."""
        return any(part.forward_only for part in self.parts)

    def at_tier(self, tier: Tier) -> Quantity:
        """Return the same quantity computed by another `tier`, or an equal quantity if that tier cannot compute it.

        **Raises** `InputError` for an unknown tier.
        """
        require_one_of(tier, TIERS, "tier")
        if not self.parts:
            return self
        written = self.written and f'{self.written}.at_tier("{tier}")'
        return replace(self, parts=tuple(part.at_tier(tier) for part in self.parts), written=written)

    @property
    def simplified(self) -> Quantity:
        """Leading-order quantity of the machine without tolerances, for a first search.

        A search with the simplified quantity takes less time than a search with the quantity itself, and its best machines are
        near those of the final search.
        """
        if not self.parts:
            return self
        written = self.written and f"{self.written}.simplified"
        return replace(self, parts=tuple(part.simplified for part in self.parts), written=written)

    @validated
    def named(self, name: str) -> Quantity:
        """Return the same quantity under another `name`."""
        return replace(self, name=name, written=f'{_code(self, in_brackets=True)}.named("{name}")')

    def __add__(self, other: Operand) -> Quantity:
        return _sum("+", self, other)

    def __radd__(self, other: Operand) -> Quantity:
        return _sum("+", other, self)

    def __sub__(self, other: Operand) -> Quantity:
        return _sum("-", self, other)

    def __rsub__(self, other: Operand) -> Quantity:
        return _sum("-", other, self)

    def __mul__(self, other: Operand) -> Quantity:
        return _product(self, other)

    def __rmul__(self, other: Operand) -> Quantity:
        return _product(other, self)

    def __truediv__(self, other: Operand) -> Quantity:
        return _ratio(self, other)

    def __rtruediv__(self, other: Operand) -> Quantity:
        return _ratio(other, self)

    def __neg__(self) -> Quantity:
        return Combined(f"negative {self.name}", self.unit, mode=self.mode, of=self.of, operation="neg", parts=(self,))

    def __pow__(self, power: float) -> Quantity:
        if isinstance(power, str):
            raise InputError(self.name, f"is raised to {quoted(power)}; the power must be a plain number")
        power = number_in(power, "", f"the power of {self.words}")
        unit = f"({self.unit})**{power:g}" if self.unit else ""
        return _combine("**", f"({self.words})^{power:g}", unit, self, _constant(power, ""))

    def __lt__(self, other: Operand) -> Demand:
        return Demand.of(self, other, "at most")

    def __gt__(self, other: Operand) -> Demand:
        return Demand.of(self, other, "at least")

    __le__ = __lt__
    __ge__ = __gt__


@dataclass(frozen=True, repr=False)
class BuiltinQuantity(Quantity):
    """Quantity of this package. Its function has the arguments evaluation (an `Evaluation`), tier and `settings`; without a
    function it is the largest of its `pieces`."""

    tier: Tier = "leading"
    settings: tuple[object, ...] = ()
    tiers: tuple[Tier, ...] = TIERS
    text: str = ""
    pieces_function: Callable[..., Array] | None = None
    """Function that returns the `pieces`, with the arguments evaluation, sign, tier and settings."""

    def __post_init__(self) -> None:
        require_one_of(self.tier, TIERS, "tier")
        if self.tier not in self.tiers:
            raise InputError("tier", f"is {quoted(self.tier)}; {self.words} is computed as: {', '.join(self.tiers)}")

    def read(self, evaluation: Evaluation) -> Array:
        if self.function is None:
            return jnp.max(self.pieces(evaluation))
        return jnp.reshape(self.function(evaluation, self.tier, *self.settings), ())

    def pieces(self, evaluation: Evaluation, sign: float = 1.0) -> Array:
        if self.pieces_function is None:
            return super().pieces(evaluation, sign)
        return self.pieces_function(evaluation, sign, self.tier, *self.settings)

    @property
    def words(self) -> str:
        suffix = {"leading": "", "exact": ", exact", "time": ", in time"}[self.tier]
        return (self.text or self.name.replace("_", " ")) + (suffix if len(self.tiers) > 1 else "")

    @property
    def forward_only(self) -> bool:
        return self.tier == "time"

    def at_tier(self, tier: Tier) -> Quantity:
        super().at_tier(tier)
        if tier not in self.tiers or tier == self.tier:
            return self
        return replace(self, tier=tier, written=self.written and f'{self.written}.at_tier("{tier}")')

    @property
    def simplified(self) -> Quantity:
        return self.at_tier("leading")

    @validated
    def named(self, name: str) -> Quantity:
        return replace(super().named(name), text=name)


@dataclass(frozen=True, repr=False)
class Combined(Quantity):
    """Result of an `operation` on quantities (`parts`), or a constant."""

    operation: str = "+"
    constant: float = 0.0

    def __repr__(self) -> str:
        if self.written:
            return self.written
        if self.operation == "constant":
            return self.name if self.name == f"{self.constant:.6g}" else f'"{self.name}"'
        if self.operation in ("largest", "least"):
            return f"{self.operation}({', '.join(map(repr, self.parts))})"
        texts = [_code(part, in_brackets=self.operation != "+") for part in self.parts]
        return f"-{texts[0]}" if self.operation == "neg" else f" {self.operation} ".join(texts)

    def read(self, evaluation: Evaluation) -> Array:
        values = [part.read(evaluation) for part in self.parts]
        match self.operation:
            case "constant":
                return jnp.asarray(self.constant, evaluation.scene.top_speed.dtype)
            case "neg":
                return -values[0]
            case "+":
                return values[0] + values[1]
            case "-":
                return values[0] - values[1]
            case "*":
                return values[0] * values[1]
            case "/":
                return values[0] / values[1]
            case "**":
                return values[0] ** values[1]
            case "largest":
                return greatest(jnp.stack(values))
            case _:
                return -greatest(-jnp.stack(values))

    def pieces(self, evaluation: Evaluation, sign: float = 1.0) -> Array:
        if self.operation == "neg":
            return self.parts[0].pieces(evaluation, -sign)
        if self.operation == ("largest" if sign > 0.0 else "least"):
            return jnp.concatenate([part.pieces(evaluation, sign) for part in self.parts])
        if self.operation in ("+", "-"):
            left = self.parts[0].pieces(evaluation, sign)
            right = self.parts[1].pieces(evaluation, sign if self.operation == "+" else -sign)
            return (left[:, None] + right[None, :]).reshape(-1)
        if self.operation in ("*", "/"):
            for part, other in (self.parts, self.parts[::-1])[: 1 if self.operation == "/" else 2]:
                numbers = part.pieces(evaluation, sign)
                if len(numbers) > 1:  # the pieces of one factor give those of the product if the other factor is positive
                    factor = other.read(evaluation)
                    products = numbers * factor if self.operation == "*" else numbers / factor
                    return jnp.where(factor > 0.0, products, sign * self.read(evaluation))
        return super().pieces(evaluation, sign)


@with_known_names
@dataclass(frozen=True, repr=False)
class Demand:
    """Condition that a quantity is at most, or at least, a value or another quantity.

    Returned by `<` and `>` of quantities.

    **Attributes**

    - `quantity` and `limit`: quantities of the same unit
    - `sense`: "at most" or "at least"
    - `shown`: the limit as it was written, such as "2 mm"
    """

    quantity: Quantity
    limit: Quantity
    sense: str
    shown: str

    @classmethod
    def of(cls, quantity: Quantity, limit: Operand, sense: str) -> Demand:
        """Return the demand that a `quantity` is "at most" or "at least" (`sense`) a `limit`.

        **Raises** `InputError` for a limit of another unit.
        """
        other = (
            limit if isinstance(limit, Quantity) else _constant(number_in(limit, quantity.unit, quantity.words), quantity.unit)
        )
        if not same_unit(other.unit, quantity.unit):
            units = [f"in {each.unit}" if each.unit else "without a unit" for each in (quantity, other)]
            raise InputError(quantity.words, f"is {units[0]} and compared with {other.words} {units[1]}")
        shown = limit.strip() if isinstance(limit, str) else other.words
        return cls(quantity, other, sense, shown)

    def __repr__(self) -> str:
        """Return the demand as it is written in Python."""
        has_text = self.constant is not None and (self.limit.unit or self.shown != self.limit.words)
        limit = f'"{self.shown}"' if has_text else repr(self.limit)
        return f"{self.quantity!r} {'<' if self.sense == 'at most' else '>'} {limit}"

    @property
    def words(self) -> str:
        """Demand as part of a sentence."""
        return f"{self.quantity.words} {self.sense} {self.shown}"

    @property
    def written_unit(self) -> str:
        """Unit of a limit that was written as text, such as "mm"; "" for other limits."""
        text = _UNIT.fullmatch(self.shown) if self.shown != self.limit.words else None
        return text[1] if text else ""

    @property
    def constant(self) -> float | None:
        """Limit, if it is a number; otherwise None."""
        limit = self.limit
        return limit.constant if isinstance(limit, Combined) and limit.operation == "constant" else None

    def form(self) -> Demand:
        """Return the demand without the text of its limit and without a limit that is a number.

        Demands of one form share programs.
        """
        limit = self.limit if self.constant is None else Combined("", "", operation="constant")
        return replace(self, limit=limit, shown="")

    def excess(self, evaluation: Evaluation, constant: Array) -> Array:
        """Return the violation of the demand in its unit, negative if it is met, from an `evaluation` of a scene.

        **Arguments**: `constant`: the limit, used if the limit is a number and not a quantity.
        """
        value = self.quantity.read(evaluation)
        limit = constant if self.constant is not None else self.limit.read(evaluation)
        return value - limit if self.sense == "at most" else limit - value

    def __bool__(self) -> bool:
        problem = "is a demand, not True or False; write a range as two demands, force > 10 and force < 50"
        raise InputError(self.words, problem)


def quantity_function(function: F) -> F:
    """Check the arguments of a public function that returns a quantity, see `validated`, and record its call in `written`."""
    checked = validated(function)

    @wraps(function)
    def made(*args: Any, **kwargs: Any) -> Quantity:
        quantity = checked(*args, **kwargs)
        arguments = [*map(_code, args), *(f"{name}={_code(value)}" for name, value in kwargs.items())]
        return replace(quantity, written=f"{function.__name__}({', '.join(arguments)})")

    return cast(F, made)


def _code(value: object, in_brackets: bool = False) -> str:
    """Return a value as it is written in Python; an operation `in_brackets` if it would be ambiguous without them."""
    if isinstance(value, str):
        return f'"{value}"'
    is_operation = isinstance(value, Combined) and not value.written and value.operation not in ("constant", "largest", "least")
    return f"({value!r})" if in_brackets and is_operation else quoted(value, _MAX_WRITTEN)


def _constant(value: float, unit: str) -> Combined:
    return Combined(f"{value:.6g} {unit}".strip(), unit, operation="constant", constant=value)


def _with_unit(value: Operand, name: str, beside: Operand = "") -> Quantity:
    """Return a value as a quantity. A number has no unit.

    A string such as "2 mm" is converted to the SI unit of its dimension. A speed or a frequency ("25 Hz") is converted to the
    unit of the other operand `beside` of a ratio if this operand is a speed or a frequency too.
    """
    if isinstance(value, Quantity):
        return value
    if isinstance(value, (str, UnitQuantity)):
        other = beside.unit if isinstance(beside, Quantity) else ""
        magnitude, unit = in_own_unit(value, f"the value combined with {name}", other)
        return replace(_constant(magnitude, unit), name=str(value).strip())
    return _constant(number_in(value, "", f"the value combined with {name}"), "")


def _combine(operation: str, name: str, unit: str, *parts: Quantity) -> Combined:
    mode = next((part.mode for part in parts if part.mode is not None), None)
    of = next((part.of for part in parts if part.of is not None), None)
    return Combined(name, unit, mode=mode, of=of, operation=operation, parts=parts)


def _term(value: Operand, unit: str, name: str) -> Quantity:
    """Return an operand of a sum as a quantity; a string is converted to the unit of the other operand."""
    if isinstance(value, Quantity) or not isinstance(value, (str, UnitQuantity)):
        return _with_unit(value, name)
    return replace(_constant(number_in(value, unit, f"the value combined with {name}"), unit), name=str(value).strip())


def _sum(sign: str, one: Operand, other: Operand) -> Quantity:
    names = [x.words if isinstance(x, Quantity) else quoted(x) for x in (one, other)]
    unit = next(x.unit for x in (one, other) if isinstance(x, Quantity))
    left, right = (_term(x, unit, name) for x, name in zip((one, other), names[::-1], strict=True))
    if not same_unit(left.unit, right.unit):
        raise InputError(
            f"{names[0]} {sign} {names[1]}",
            f"combines {left.unit or 'no unit'} and {right.unit or 'no unit'}; divide each by a value first, for example "
            f'by "1 {left.unit or right.unit}"',
        )
    return _combine(sign, f"{left.words} {sign} {right.words}", left.unit, left, right)


def _bracketed(quantity: Quantity) -> str:
    """Return the name of a quantity, in brackets if a product would be ambiguous without them."""
    is_unambiguous = not (isinstance(quantity, Combined) and quantity.operation in "+-")
    return quantity.words if is_unambiguous else f"({quantity.words})"


def _product(one: Operand, other: Operand) -> Quantity:
    left, right = _with_unit(one, "a quantity"), _with_unit(other, "a quantity")
    unit = " ".join(u if " " not in u else f"({u})" for u in (left.unit, right.unit) if u)
    return _combine("*", f"{_bracketed(left)} * {_bracketed(right)}", unit, left, right)


def _ratio(one: Operand, other: Operand) -> Quantity:
    left, right = _with_unit(one, "a quantity", other), _with_unit(other, "a quantity", one)
    below = f"({right.unit})" if any(c in right.unit for c in " /*") else right.unit
    unit = "" if same_unit(left.unit, right.unit) else left.unit if not right.unit else f"{left.unit or '1'}/{below}"
    return _combine("/", f"{_bracketed(left)} / {_bracketed(right)}", unit, left, right)


def _extreme(operation: str, quantities: tuple[Quantity, ...]) -> Quantity:
    if not quantities or not all(isinstance(q, Quantity) for q in quantities):
        raise InputError(operation, f"has {quoted(quantities)}; give one quantity or several")
    for each in quantities[1:]:
        if not same_unit(each.unit, quantities[0].unit):
            raise InputError(operation, f"combines {quantities[0].unit or 'no unit'} and {each.unit or 'no unit'}")
    name = f"{operation} of ({'; '.join(q.words for q in quantities)})"
    return _combine(operation, name, quantities[0].unit, *quantities)


@validated
def largest(*quantities: Quantity) -> Quantity:
    """Return the largest of some quantities of the same unit, for example of one quantity in several load cases (`under`).

    **Arguments**: `quantities`, at least one; typical: 2 to 5.

    **Returns** `Quantity`. **Raises** `InputError` for quantities of different units.

    >>> from optimize import foundation_force, largest, under
    >>> force = foundation_force(mode=3)
    >>> largest(force, under(force, "slow", {"drive.speed": "1200 rpm"})).unit
    'N'
    """
    return _extreme("largest", quantities)


@validated
def least(*quantities: Quantity) -> Quantity:
    """Return the least of some quantities of the same unit, see `largest`.

    **Arguments**: `quantities`, at least one; typical: 2 to 5.

    **Returns** `Quantity`. **Raises** `InputError` for quantities of different units.

    >>> from optimize import amplitude, least
    >>> (least(amplitude(mode=3, of=1), amplitude(mode=3, of=2)) > "2 mm").words
    'least of (amplitude of platform 1, mode 3; amplitude of platform 2, mode 3) at least 2 mm'
    """
    return _extreme("least", quantities)


def walk(quantity: Quantity) -> Iterator[Quantity]:
    """Yield the quantity and all quantities from which it is computed."""
    yield quantity
    for part in quantity.parts:
        yield from walk(part)
