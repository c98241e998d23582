"""Design space: free parameters of a scene, their bounds and ties, catalogues, and held quantities."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from types import ModuleType
from typing import Any, Literal, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import is_real, validated
from jaxvib.errors import InputError, quoted, within
from jaxvib.machine.files import rebuild_part
from jaxvib.machine.numbers.named import NamedNumber, find_number, numbers_of, present_numbers, put_numbers
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.damping import is_relative
from jaxvib.results.readable import Readable
from jaxvib.units import Number, count, number
from jaxvib.units.known import require_known
from optimize.quantities.evaluation import Evaluation
from optimize.quantities.quantity import Quantity

Numbers = TypeVar("Numbers", np.ndarray, Array)

Bounds = tuple[Number, Number] | tuple[Number, Number, str]
"""(low, high), or (low, high, "log" or "even")."""

Source = str | tuple[str, float | Literal["keep"]]
"""Source of a tied parameter: the name of another parameter (equal values), (name, factor), (name, "keep") for their present
ratio, or for a damping of the machine its ratio or loss factor, such as "3 %"."""


class HeldQuantity(Readable):
    """Quantity that keeps its value during the search.

    Returned by `hold`.

    **Attributes**: `quantity`; `value` in its unit, None for the value in the initial scene.
    """

    quantity: Quantity = eqx.field(static=True)
    value: float | np.ndarray | None


@validated
def hold(quantity: Quantity, value: Number | None = None) -> HeldQuantity:
    """Return the condition that a quantity keeps a value during the search.

    **Arguments**

    - `quantity` such as `jam_frequency(mode=3)`
    - `value` in the unit of the quantity, or text; typical: 0.8 to 1.2 times the value of the initial scene; default: the value
      of the initial scene

    **Returns** `HeldQuantity`. **Raises** `InputError` for a wrong unit, and for the value 0, because deviations from a held
    value are relative.

    >>> from optimize import hold, jam_frequency
    >>> hold(jam_frequency(mode=3), "600 rpm").quantity.name
    'jam_frequency'
    """
    if value is None:
        return HeldQuantity(quantity, None)
    number_held = float(number(value, quantity.unit, f"hold.{quantity.name}"))
    if number_held == 0.0:
        raise InputError(f"hold.{quantity.name}", "is 0; a held value must differ from 0")
    return HeldQuantity(quantity, number_held)


class Tie(NamedTuple):
    """Tie of a parameter to another one: `target` = `factor` times `source`, entry by entry."""

    target: NamedNumber
    source: NamedNumber
    factor: tuple[float, ...]

    @property
    def mark(self) -> str:
        """Text behind the name of the target in tables."""
        return "tied"

    def sources(self, scene: Scene) -> set:
        """Return the entries of the parameters of a `scene` on which the value depends."""
        return self.source.entries

    def value(self, scene: Scene) -> Array:
        """Return the value of the target in a `scene`."""
        return jnp.asarray(self.factor) * self.source.read(scene)


class RelativeDamping(NamedTuple):
    """Damping `target` that the scene file, or a tie, gives as `text`: "3 %" or "loss factor 0.1 at 16 Hz".

    Its value follows from the stiffness and the mass as in the constructor of the machine.
    """

    target: NamedNumber
    text: str

    @property
    def mark(self) -> str:
        """Text behind the name of the target in tables."""
        return self.text

    def sources(self, scene: Scene) -> set:
        """Return the entries of the parameters of a `scene` on which the value depends."""
        of_machine = [each for each in numbers_of(scene).values() if each.path[0] == "machine" and not each.is_damping]
        return set().union(*(each.entries for each in of_machine))

    def value(self, scene: Scene) -> Array:
        """Return the value of the target in a `scene`. **Raises** `InputError` for a text that the constructor refuses."""
        given = {(*path[1:], k): self.text for path, k in self.target.entries}
        return self.target.read(eqx.tree_at(lambda s: s.machine, scene, rebuild_part(scene.machine, "machine", given)))


class Column(NamedTuple):
    """Column of a catalogue of rows, other than the first column.

    `source` is the parameter of the first column, with the values `at`; `target` is the parameter of this column, with `values`
    (SI). Between rows, `target` is interpolated linearly; the first and the last line continue beyond them, so that the
    sensitivities of a design at the end of a catalogue are those of a whole row.
    """

    target: NamedNumber
    source: NamedNumber
    at: tuple[float, ...]
    values: tuple[float, ...]

    def value(self, x: Array) -> Array:
        """Return the value of `target` if that of `source` is `x`."""
        at, values = jnp.asarray(self.at), jnp.asarray(self.values)
        k = jnp.clip(jnp.searchsorted(at, x) - 1, 0, len(self.at) - 2)
        return values[k] + (values[k + 1] - values[k]) / (at[k + 1] - at[k]) * (x - at[k])


class Choice(NamedTuple):
    """Parameter `name` with its allowed `values`, ascending, SI; `entry`: its index in the design vector."""

    name: str
    values: tuple[float, ...]
    entry: int


class DesignSpace(Readable):
    """Parameters of a scene that may change, between bounds, and quantities that must keep their value.

    **Arguments**

    - `scene`: the design from which the search begins
    - `free`: a mapping from names to (low, high), SI or text with units; typical: 2 to 20 parameters, with
      bounds of 1/2 and 2 times, or 1/10 and 10 times, the present values. More free parameters need more starts
    - `hold`: quantities that keep their value, each in `optimize.hold(...)`, for example a sum (`total`) or a product
      (`product`) of parameters
    - `ties`: a mapping from the name of a parameter to its source. The source is the name of another parameter (equal values),
      (name, factor), or (name, "keep") to keep the present ratio of both. The factor -1 mirrors a position. The source of a
      damping of the machine may also be a ratio, "3 %", or a loss factor, see `jaxvib.one_mass`: the damping then follows the
      stiffness and the mass. Entries of an array that are 0 stay 0, as in `free`
    - `choices`: a mapping from the name of a parameter to its allowed values, such as the springs of a catalogue, or from
      "loads.count" to allowed numbers of loads; typical: 2 to 20 values. If several values belong together, as those of a
      motor, the key is any name. Its value is then a mapping from parameters to the columns of a catalogue, for example
      {"motor": {"drive.speed": ["1450 rpm", "970 rpm"], "drive.inertia": [0.01, 0.02]}}. The values of the first column must
      differ

    Names and bounds of `free`:

    - "machine.stiffness" frees every entry of the array that is not 0; the bounds apply to each entry
    - "machine.stiffness[0]" frees one entry, which may be 0 in the scene (a spring that does not exist yet)
    - "loads.drag" frees the value that all loads share, "drive.speed" the rotor speed
    - (low, high, "log") scales the range logarithmically, (low, high, "even") linearly; default: logarithmically for ranges
      over a factor of 10 or more, otherwise linearly

    A search describes a design by a vector z in [0, 1]^d.

    **Attributes**, of the d free parameters: bounds `low` and `high` (d,), SI; `logs`: True for a logarithmically scaled range;
    `held`: the held quantities; `counts`: the allowed numbers of loads; `columns`: further columns of catalogues of rows.

    **Raises** `InputError` for

    - a name that the scene does not have, and a lower bound that is not below the upper one
    - a parameter that is free twice, or free and tied
    - values of a catalogue that no scene can have
    - as many held quantities as free parameters, or more

    >>> import jaxvib as jv
    >>> from optimize import DesignSpace
    >>> machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0),
    ...                       link_stiffness=2e5, link_damping=60.0)
    >>> scene = jv.Scene(machine, jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed("1500 rpm"))
    >>> space = DesignSpace(scene, free={"machine.stiffness": (1e4, 2e5), "machine.link_stiffness": ("50 N/mm", 5e5)})
    >>> space.size
    3
    >>> DesignSpace(scene, {"machine.stiffness[0]": (1e4, 2e5)}, ties={"machine.stiffness[1]": "machine.stiffness[0]"}).size
    1
    """

    scene: Scene
    low: Array | np.ndarray
    high: Array | np.ndarray
    free: tuple[NamedNumber, ...] = eqx.field(static=True)
    logs: tuple[bool, ...] = eqx.field(static=True)
    ties: tuple[Tie | RelativeDamping, ...] = eqx.field(static=True)
    columns: tuple[Column, ...] = eqx.field(static=True)
    held: tuple[HeldQuantity, ...]
    choices: tuple[Choice, ...] = eqx.field(static=True)
    counts: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        scene: Scene,
        free: Mapping[str, Bounds],
        hold: Sequence[HeldQuantity] = (),
        *,
        ties: Mapping[str, Source] | None = None,
        choices: Mapping[str, Sequence[Number] | Mapping[str, Sequence[Number]]] | None = None,
    ):
        _require_tables(scene, free, hold, ties, choices)
        single, self.columns = _read_rows(scene, choices or {})
        chosen, counts = _read_choices(scene, single)
        if not free and not chosen:
            raise InputError("free", "is empty; name at least one number that may change, such as machine.stiffness")
        ranges = [(name, *_read_bounds(scene, name, bounds)) for name, bounds in free.items()]
        for name, values in chosen.items():
            if name in free:
                raise InputError(f"choices.{name}", "is free already; give it once, as free or as a choice")
            is_log = values[-1] / values[0] >= 10.0 if values[0] > 0.0 else False
            ranges.append((name, find_number(scene, name, "choices"), values[0], values[-1], is_log))
        used: set = set()
        numbers, lows, highs, logs, choices_ = [], [], [], [], []
        for name, array, low, high, log in ranges:
            if array.entries & used:
                field = "choices" if name in chosen else "free"
                raise InputError(f"{field}.{name}", "contains a number that is free already; give each number once")
            used |= array.entries
            for entry in present_numbers(scene, array, "choices" if name in chosen else "free"):
                if name in chosen:
                    choices_ += [Choice(name, chosen[name], len(lows) + k) for k in range(entry.size)]
                numbers.append(entry)
                lows, highs, logs = lows + [low] * entry.size, highs + [high] * entry.size, logs + [log] * entry.size
        self.scene = scene
        self.free, self.logs, self.choices = tuple(numbers), tuple(logs), tuple(choices_)
        self.low, self.high = np.asarray(lows), np.asarray(highs)
        for column in self.columns:
            if column.target.entries & used:
                raise InputError(f"choices.{column.target.name}", "is free or chosen already; give each number once")
            used |= column.target.entries
        self.ties = _read_ties(scene, ties or {}, used)
        self.counts = counts
        for held in hold:
            if not isinstance(held, HeldQuantity):
                raise InputError("hold", f"has {quoted(held)}; wrap quantities in optimize.hold(...)")
        self.held = tuple(_with_value(held, scene) for held in hold)
        if len(self.held) >= self.size:
            raise InputError(
                "hold",
                f"holds {len(self.held)} quantities with {self.size} free parameters; there must be more "
                "free parameters than held quantities",
            )

    @property
    def size(self) -> int:
        """Number d of free parameters."""
        return sum(each.size for each in self.free)

    def _bounds(self, like: np.ndarray | Array) -> tuple[ModuleType, np.ndarray | Array, np.ndarray | Array]:
        """Return the module of the array `like`, NumPy or jax.numpy, and the bounds as arrays of that module."""
        xp = np if isinstance(like, np.ndarray) else jnp
        return xp, xp.asarray(self.low), xp.asarray(self.high)

    def _require_size(self, values: Any, name: str, *, single: bool = False) -> None:
        """**Raises** `InputError` unless the values are an array with an entry for each free parameter."""
        is_array = isinstance(values, (np.ndarray, Array)) and is_real(values) and not np.ma.is_masked(values)
        if not is_array or (values.shape if single else values.shape[-1:]) != (self.size,):
            axis = "" if single else " along its last axis"
            raise InputError(name, f"is {quoted(values)}; it must be an array with {self.size} numbers{axis}")

    def numbers(self, z: Numbers) -> Numbers:
        """Return the free parameters (..., d), SI, of designs `z` (..., d) in [0, 1]; a NumPy array if z is a NumPy array."""
        self._require_size(z, "z")
        xp, low, high = self._bounds(z)
        log = np.asarray(self.logs)
        base = xp.where(log, low, 1.0)
        return xp.where(log, base * xp.where(log, high / base, 1.0) ** z, low + (high - low) * z)

    def at(self, z: Array) -> Scene:
        """Return the scene of the design `z` (d,) in [0, 1]."""
        self._require_size(z, "z", single=True)
        return self.scene_of(self.numbers(z))

    def scene_of(self, values: Array) -> Scene:
        """Return the scene with the free parameters `values` (d,), SI."""
        self._require_size(values, "values", single=True)
        scene = put_numbers(self.scene, self.free, jnp.asarray(values))
        for each in self.columns:
            scene = put_numbers(scene, (each.target,), each.value(each.source.read(scene)))
        for tie in self.ties:
            scene = put_numbers(scene, (tie.target,), tie.value(scene))
        return scene

    @validated
    def where(self, scene: Scene) -> Array:
        """Return the design z (d,) of a `scene`; a parameter outside its bounds is moved to the nearer bound."""
        return self.shares(jnp.concatenate([each.read(scene) for each in self.free]))

    def shares(self, numbers: Numbers) -> Numbers:
        """Return the designs z (..., d) of free parameters `numbers` (..., d), SI; a value outside its bounds is moved to the
        nearer bound."""
        self._require_size(numbers, "numbers")
        xp, low, high = self._bounds(numbers)
        value, log, width = xp.clip(numbers, low, high), np.asarray(self.logs), high - low
        base = xp.where(log, low, 1.0)
        ratio = xp.where(log & (width > 0.0), high / base, 2.0)
        even = (value - low) / xp.where(width > 0.0, width, 1.0)
        return xp.where(width > 0.0, xp.where(log, xp.log(xp.where(log, value, 1.0) / base) / xp.log(ratio), even), 0.0)

    @validated
    def parameters(self, scene: Scene) -> dict[str, float | list[float]]:
        """Return the free parameters of a `scene` by name, in SI."""
        return {n.name: (n.leaf(scene) if n.entry is None else n.leaf(scene)[n.entry]).tolist() for n in self.free}

    def words(self) -> list[tuple[str, str]]:
        """Return the name for tables and the unit for `jaxvib.display.shown_unit` of each free parameter."""
        return [(word, each.unit_of_tables) for each in self.free for word in each.words(self.scene)]

    def words_of_changes(self) -> list[tuple[str, str]]:
        """Return `words`; names of first columns of catalogues state that the other columns change too."""
        rows = [column.source.entries for column in self.columns]
        ends = [" (with its row)" if each.entries in rows else "" for each in self.free for _ in each.words(self.scene)]
        return [(word + end, unit) for (word, unit), end in zip(self.words(), ends, strict=True)]

    @validated
    def within(self, low: np.ndarray, high: np.ndarray) -> DesignSpace:
        """Return the same space with the bounds `low` and `high` (d,), SI; equal bounds fix a parameter."""
        for bounds, name in ((low, "low"), (high, "high")):
            self._require_size(bounds, name, single=True)
        return eqx.tree_at(lambda s: (s.low, s.high), self, (np.asarray(low, float), np.asarray(high, float)))

    def with_relative_dampings(self, texts: Mapping[str, str]) -> DesignSpace:
        """Return the same space, in which dampings follow the stiffness and the mass of each design.

        **Arguments**: `texts`: ratios and loss factors by the names of the dampings, as the scene file gives them. Dampings
        that are free, chosen or tied are left out, and those that are equal in all designs.
        """
        changed = (*self.free, *(each.target for each in (*self.columns, *self.ties)))
        used = set().union(*(each.entries for each in changed))
        ties = {
            each.name: text
            for number in numbers_of(self.scene).values()
            for each in number.single(self.scene)
            if (text := texts.get(each.name) or texts.get(each.name.removesuffix(f"[{each.entry}]")))
            and not each.entries & used
        }
        lowest, highest = (self.scene_of(jnp.asarray(bounds)) for bounds in (self.low, self.high))
        follow = [
            tie
            for tie in _read_ties(self.scene, ties, used)  # a damping increases with the stiffness and with the mass
            if not np.allclose(tie.value(lowest), tie.value(highest), rtol=1e-9, atol=0.0)
        ]
        space = copy.copy(self)
        object.__setattr__(space, "ties", _in_order(self.scene, [*self.ties, *follow]))
        return space

    def residuals(self, evaluation: Evaluation) -> Array:
        """Return the relative deviation (m,) of each held quantity from its held value, from an `evaluation` of a scene."""
        off = [held.quantity.read(evaluation) / held.value - 1.0 for held in self.held if held.value is not None]
        return jnp.stack(off) if off else jnp.zeros((0,))


def _require_tables(scene: object, free: object, hold: object, ties: object, choices: object) -> None:
    """**Raises** `InputError` for arguments of a wrong type."""
    if not isinstance(scene, Scene):
        raise InputError("scene", f"is {quoted(scene)}; it must be a Scene, for example load_scene('machine.toml')")
    require_known(scene, "scene", "DesignSpace", "make the space outside")
    for field, table in (("free", free), ("ties", ties), ("choices", choices)):
        if not isinstance(table, Mapping) and (table is not None or field == "free"):
            raise InputError(field, f"is {quoted(table)}; it must be a dictionary of names such as 'machine.stiffness'")
    if not isinstance(hold, (list, tuple)):
        raise InputError("hold", f"is {quoted(hold)}; it must be a list of quantities in optimize.hold(...)")


def _read_bounds(scene: Scene, name: str, bounds: Bounds) -> tuple[NamedNumber, float, float, bool]:
    if isinstance(bounds, Mapping):
        example = f"{name}.{next(iter(bounds), '')}"
        raise InputError(f"free.{name}", f'is a table; write the whole name in quotes, for example "{example}"')
    found = find_number(scene, name, "free")
    if not isinstance(bounds, (list, tuple)) or len(bounds) not in (2, 3):
        raise InputError(f"free.{name}", f"is {quoted(bounds)}; give the bounds as (low, high)")
    low, high = (found.value(bound, f"free.{name}") for bound in bounds[:2])
    if not low < high:
        raise InputError(f"free.{name}", f"has bounds {low:g} and {high:g}; the first must be less than the second")
    log = low > 0.0 and high / low >= 10.0
    if len(bounds) == 3:
        if bounds[2] not in ("log", "even"):
            raise InputError(f"free.{name}", f"has the scale {quoted(bounds[2])}; it must be 'log' or 'even'")
        log = bounds[2] == "log"
        if log and not low > 0.0:
            raise InputError(f"free.{name}", f"has the scale 'log' and a low bound of {low:g}; give a low bound greater than 0")
    return found, low, high, log


def _read_rows(scene: Scene, choices: Mapping[str, Any]) -> tuple[dict[str, Sequence[Number]], tuple[Column, ...]]:
    """Return the choices of single parameters, including the first column of each catalogue of rows, and the other columns."""
    single: dict[str, Sequence[Number]] = {}
    columns: list[Column] = []
    for label, columns_given in choices.items():
        if not isinstance(columns_given, Mapping):
            single[label] = columns_given
            continue
        field = f"choices.{label}"
        if len(columns_given) < 2:
            raise InputError(field, "needs at least two columns; give a parameter alone as a list of values")
        entries = {name: find_number(scene, name, field) for name in columns_given}
        read: dict[str, list[float]] = {}
        for name, entry in entries.items():
            if not isinstance(columns_given[name], (list, tuple)) or entry.size != 1:
                raise InputError(
                    f"{field}.{name}",
                    "needs the name of a single number, such as machine.stiffness[0], and a list of its values",
                )
            read[name] = [entry.value(v, f"{field}.{name}[{k}]") for k, v in enumerate(columns_given[name])]
        first, *others = read
        lengths = {name: len(values) for name, values in read.items()}
        if len(set(lengths.values())) > 1:
            counted = ", ".join(f"{name} {n}" for name, n in lengths.items())
            raise InputError(field, f"has columns of different lengths ({counted}); each row needs all its values")
        if len(set(read[first])) < len(read[first]):
            raise InputError(field, f"has rows with equal values of {first}; name a column first whose values differ")
        order = np.argsort(read[first])
        at = tuple(read[first][k] for k in order)
        single[first] = at
        columns += [Column(entries[n], entries[first], at, tuple(read[n][k] for k in order)) for n in others]
    return single, tuple(columns)


def _read_choices(
    scene: Scene, choices: Mapping[str, Sequence[Number]]
) -> tuple[dict[str, tuple[float, ...]], tuple[int, ...]]:
    """Return the catalogues by name, ascending without duplicates, and the numbers of loads."""
    allowed: dict[str, tuple[float, ...]] = {}
    counts: tuple[int, ...] = ()
    for name, values in choices.items():
        if not isinstance(values, (list, tuple)) or not values:
            raise InputError(f"choices.{name}", f"is {quoted(values)}; give a list of values")
        if name == "loads.count":
            counts = tuple(sorted({count(v, f"choices.{name}") for v in values}))
            continue
        entry = find_number(scene, name, "choices")
        sorted_values = sorted({entry.value(v, f"choices.{name}[{k}]") for k, v in enumerate(values)})
        if len(sorted_values) < 2:
            raise InputError(f"choices.{name}", "has one value; put the value into the scene, or give several values")
        allowed[name] = tuple(sorted_values)
    return allowed, counts


def _read_ties(scene: Scene, ties: Mapping[str, Source], used: set) -> tuple[Tie | RelativeDamping, ...]:
    read: list[Tie | RelativeDamping] = []
    for name, source_given in ties.items():
        target = find_number(scene, name, "ties")
        if target.entries & used:
            raise InputError(f"ties.{name}", "is free, chosen or tied already; a number has one source")
        if is_relative(source_given):
            read += _read_relative_damping(scene, target, source_given)
            used = used | target.entries
            continue
        pair = isinstance(source_given, (list, tuple)) and len(source_given) == 2
        source_name, factor = source_given if pair else (source_given, 1.0)
        if not isinstance(source_name, str):
            raise InputError(f"ties.{name}", f"is {quoted(source_given)}; give another number's name, or (name, factor)")
        source = find_number(scene, source_name, f"ties.{name}")
        if source.entries & target.entries:
            raise InputError(f"ties.{name}", "is tied to itself; name another number")
        if source.size not in (1, target.size):
            raise InputError(
                f"ties.{name}",
                f"has {target.size} entries, but {source_name} has {source.size}; name a single entry, as in {source_name}[0]",
            )
        if factor == "keep":
            with np.errstate(divide="ignore", invalid="ignore"):  # refused below
                ratio = np.asarray(target.read(scene)) / np.asarray(source.read(scene))
        else:
            lowest = target.spec.bounds.low  # positions and angles may be mirrored
            is_number = isinstance(factor, (int, float)) and not isinstance(factor, bool)
            value = float(factor) if is_number else 0.0
            if not np.isfinite(value) or value == 0.0 or (value < 0.0 and lowest >= 0.0):
                allowed = "greater than 0" if lowest >= 0.0 else "other than 0"
                raise InputError(f"ties.{name}", f"has the factor {quoted(factor)}; give a number {allowed}, or 'keep'")
            ratio = np.full(target.size, value)
        if target.keeps_zeros(scene):  # a spring or damper that does not exist is not created
            ratio = np.where(np.asarray(target.read(scene)) == 0.0, 0.0, ratio)
        if not np.all(np.isfinite(ratio)):
            raise InputError(f"ties.{name}", f"has no ratio to {source_name}, which is 0 in the scene; give a factor")
        used = used | target.entries
        read.append(Tie(target, source, tuple(map(float, ratio))))
    return _in_order(scene, read)


def _read_relative_damping(scene: Scene, target: NamedNumber, text: str) -> list[RelativeDamping]:
    """Return the ties of the entries of a `target`, other than 0, to the stiffness and the mass by a ratio or a loss factor."""
    if target.path[0] != "machine" or not target.is_damping:
        problem = f"is {quoted(text)}, which only a damping of the machine can be"
        raise InputError(f"ties.{target.name}", f"{problem}; give another number's name, or (name, factor)")
    ties = [RelativeDamping(each, text) for each in present_numbers(scene, target, "ties")]
    with within("ties."):
        for tie in ties:
            tie.value(scene)  # raises an error for a wrong text
    return ties


def _in_order(scene: Scene, ties: Sequence[Tie | RelativeDamping]) -> tuple[Tie | RelativeDamping, ...]:
    """Return the ties in an order in which each follows the ties that determine its source."""
    sources = [tie.sources(scene) for tie in ties]
    before = {k: [n for n, other in enumerate(ties) if other.target.entries & each] for k, each in enumerate(sources)}
    try:
        return tuple(ties[k] for k in TopologicalSorter(before).static_order())
    except CycleError as error:
        first, *others, _ = (ties[k].target.name for k in error.args[1])
        problem = f"is tied to itself through {' and '.join(others)}; remove one of these ties"
        raise InputError(f"ties.{first}", problem) from None


def _with_value(held: HeldQuantity, scene: Scene) -> HeldQuantity:
    if held.value is not None:
        return HeldQuantity(held.quantity, np.asarray(held.value))
    value = float(held.quantity(scene))
    if not (np.isfinite(value) and value != 0.0):
        raise InputError(f"hold.{held.quantity.name}", f"is {value} in the initial scene; give the value that it must keep")
    return HeldQuantity(held.quantity, np.asarray(value))
