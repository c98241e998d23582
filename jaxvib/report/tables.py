"""HTML tables of plain values and scenes; every text in them is escaped."""

from __future__ import annotations

import html
import math
import re
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple, TypeAlias, TypeGuard, cast

import equinox as eqx

from jaxvib.display import GRAVITIES, quantity_text, shown_unit
from jaxvib.errors import InputError
from jaxvib.machine.files import EFFECTS, scene_to_toml
from jaxvib.machine.numbers import number_specs
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.results.fields import Plain

Units: TypeAlias = Mapping[str, str]
"""Units of numbers by their names."""

ACCURACY_FIELDS = (
    "status", "message", "error", "reference_error", "uncertainty", "resolution", "residual", "drift", "ripple", "settled",
    "judged", "unverified", "converged", "starts", "steps", "rejected", "evaluations", "seconds",
)  # fmt: skip
"""Names of the fields about the accuracy and the cost of a result."""

_HIDDEN_FIELDS = ("scene", "toml", "before", "after", "verified")
"""Names of the fields that the page shows in another way. The last three are machines of a search, without units; its table has
them as columns, with the unit of each row."""

_FIELDS_OF_TEXT = ("tolerances", "table", "limits", "influences", "machines", "drawn", "same", "kkt")
"""Names of the fields that the text of a result shows with the unit of each row; the last three are numbers of a search about
which only a programmer asks."""

_MAX_INLINE_ENTRIES = 12
"""Maximum number of entries of a list that fits into one cell."""

_MAX_CELL_CHARACTERS = 40
"""Maximum number of characters of a text within a row; a longer text is written below its row."""

_MAX_ROWS = 200
"""Maximum number of rows of a table."""


_GRAVITIES_TEXT = "g = 9.80665 m/s²"
"""Unit of accelerations in reports."""

COMPLEX = ", complex"
"""End of the unit of complex numbers, see `in_display_units`."""


def escaped(text: object) -> str:
    """Return a text with escaped special characters of HTML."""
    return html.escape(str(text), quote=True)


def in_display_units(
    document: Mapping[str, Plain], units: Units, coordinate_units: Sequence[str] = ()
) -> tuple[Mapping[str, Plain], Units]:
    """Return a document whose numbers are in display units, and these units.

    Each name has one unit. It is chosen for the largest value with this name in the document, including lists and rows of
    tables. Values at the coordinates of a machine have a unit such as "m or rad"; if the `coordinate_units` differ, each value
    is a text with its own unit. Units of complex numbers, which are pairs in the document, end in `COMPLEX`.

    >>> in_display_units({"omega": 10.0, "jams": [{"amplitude": [0.002]}]}, {"omega": "rad/s", "amplitude": "m"})
    ({'omega': 95.49296585513721, 'jams': [{'amplitude': [2.0]}]}, {'omega': 'rpm', 'amplitude': 'mm'})
    >>> in_display_units({"amplitude": [0.002, 0.001, 0.01]}, {"amplitude": "m or rad"}, ("m", "m", "rad"))
    ({'amplitude': ['2 mm', '1 mm', '0.572958 deg']}, {'amplitude': ''})
    """
    kinds = {"m": 0, "rad": 1}
    pairs = {name for name, unit in units.items() if unit.endswith(COMPLEX)}
    units = {name: unit.removesuffix(COMPLEX) for name, unit in units.items()}
    if len(set(coordinate_units)) == 1:
        units = {name: _choice(unit, kinds[coordinate_units[0]]) for name, unit in units.items()}
    mixed = {name for name, unit in units.items() if " or " in unit and len(set(coordinate_units)) > 1}
    sizes = dict.fromkeys(units, 0.0)

    def note_size(name: str, x: float, place: tuple[int, int]) -> float:
        sizes[name] = max(sizes.get(name, 0.0), abs(x) if math.isfinite(x) else 0.0)
        return x

    def shown_number(name: str, x: float, place: tuple[int, int]) -> float | str:
        k, count = place
        if name in mixed and count in (0, len(coordinate_units)):  # a single value is that of a point, in the first unit
            return quantity_text(x, _choice(units[name], kinds[coordinate_units[k]] if count else 0), 6)
        return shown[name][1] * x if name in shown else x

    _map_numbers(document, "", note_size, pairs)
    shown = {name: ("", 1.0) if name in mixed else shown_unit(unit, sizes[name]) for name, unit in units.items()}
    scaled = _map_numbers(document, "", shown_number, pairs)
    named = {name: _GRAVITIES_TEXT if units[name] == GRAVITIES else unit for name, (unit, _) in shown.items()}
    return cast("Mapping[str, Plain]", scaled), named


def _choice(unit: str, kind: int) -> str:
    """Return the unit for coordinates of a kind, 0 for displacements and 1 for angles, from a unit such as "m or rad"."""
    return unit.split(" or ")[kind] if " or " in unit else unit


def _map_numbers(
    value: Plain | Mapping[str, Plain],
    name: str,
    convert: Callable[[str, float, tuple[int, int]], float | str],
    pairs: Collection[str],
    place: tuple[int, int] = (0, 0),
) -> Plain:
    """Apply `convert` to all numbers of a plain value except Booleans. Its arguments are the name, the number, and a pair: the
    index of the number in its list and the length of the list, (0, 0) outside lists. For the names in `pairs`, the innermost
    lists are complex numbers, and the index is that of the complex number."""
    if isinstance(value, Mapping):
        return {key: _map_numbers(entry, key, convert, pairs) for key, entry in value.items()}
    if isinstance(value, list):
        is_number = name in pairs and not any(isinstance(entry, list) for entry in value)
        return [
            _map_numbers(entry, name, convert, pairs, place if is_number else (k, len(value))) for k, entry in enumerate(value)
        ]
    return convert(name, value, place) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


def accuracy_table(document: Mapping[str, Plain], units: Units) -> str:
    """Return a table of the fields of a document about accuracy and cost: status, error, steps, seconds."""
    return _pair_table(
        [(name, document[name]) for name in ACCURACY_FIELDS if document.get(name, "") != "" and _fits_in_cell(document[name])],
        units,
    )


class TextTable(NamedTuple):
    """Table in the text of a result: `title`, `columns` (headers) and `rows` of texts."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def html(self) -> str:
        """Return the table with its title as HTML; all columns except the first are aligned to the right."""

        def line(tag: str, cells: Sequence[str]) -> str:
            classes = ["", *[" class='n'"] * (len(cells) - 1)]
            return f"<tr>{''.join(f'<{tag}{c}>{escaped(cell)}</{tag}>' for c, cell in zip(classes, cells, strict=True))}</tr>"

        lines = "".join([line("th", self.columns), *(line("td", row) for row in self.rows)])
        return f"<h3>{escaped(self.title)}</h3><div class='wide'><table>{lines}</table></div>"

    def shows(self, rows: Sequence[Mapping[str, Plain]]) -> bool:
        """Return True if all numbers of a column, which are not only counts, are those of one entry of the `rows`."""
        entries = [
            [x for row in rows if isinstance(x := row.get(name), (int, float)) and not isinstance(x, bool)] for name in rows[0]
        ]
        for column in zip(*self.rows, strict=True):
            try:
                numbers = [float(cell) for cell in column]
            except ValueError:
                continue
            if all(x.is_integer() for x in numbers):
                continue
            if any(all(any(math.isclose(x, y, rel_tol=1e-3) for y in values) for x in numbers) for values in entries):
                return True
        return False


def mark_of(place: int) -> str:
    """Return the text that stands for the table at this place in the text of a result."""
    return f"\0{place}\0"


def text_with_tables(text: str, tables: Sequence[TextTable]) -> str:
    """Return the text of a result as HTML, with the `tables` in place of their marks."""
    pieces = re.split("\0([0-9]+)\0", text)
    shown = [f"<pre>{escaped(piece)}</pre>" if (piece := each.strip("\n")) else "" for each in pieces[::2]]
    shown[1:] = [tables[int(place)].html() + after for place, after in zip(pieces[1::2], shown[1:], strict=True)]
    return "".join(shown)


def result_tables(
    document: Mapping[str, Plain],
    units: Units,
    inner: bool = False,
    *,
    has_text: bool = False,
    tables: Sequence[TextTable] = (),
) -> str:
    """Return a document as tables: one table for all single values, and a table with a heading for each list or mapping.

    **Arguments**: `has_text`: True if the page also has the text of the result; fields that the text shows better are left out;
    `tables` of this text, which are not repeated.
    """
    single, below = [], []
    hidden = (*_HIDDEN_FIELDS, *_FIELDS_OF_TEXT) if has_text else _HIDDEN_FIELDS
    for name, value in document.items():
        if name == "units" and "coordinates" in document:  # the SI units; the values have their display units
            continue
        if name in hidden or (not inner and name in ACCURACY_FIELDS and _fits_in_cell(value)):
            continue
        if _fits_in_cell(value):
            single.append((name, value))
        elif isinstance(value, Mapping):
            below.append((name, result_tables(value, units, inner=True)))
        elif _entries(value):
            if not any(each.shows(value) for each in tables):
                below.append((name, _row_table(value, units)))
        elif isinstance(value, list) and value:
            below.append((name, _grid_table(value)))
    heads = "".join(f"<h3>{escaped(_words(name))}{_unit_of(name, units)}</h3>{body}" for name, body in below if body)
    return _pair_table(single, units) + heads


def parameter_tables(scene: Scene) -> str:
    """Return the parameters of a scene with their units, in a table for each of its parts; the text of a scene with a part that
    scene files do not describe."""
    try:
        tables = tomllib.loads(scene_to_toml(scene))
    except InputError:
        return f"<pre>{escaped(repr(scene))}</pre>"
    parts = []
    owners = [("", tables, scene.exciters[0])]
    if "exciters" in tables:
        owners = [(f"exciter {k}, ", t, e) for k, (t, e) in enumerate(zip(tables["exciters"], scene.exciters, strict=True), 1)]
    kind = str(tables["machine"].pop("kind"))
    parts.append((f"machine: {_words(kind)}", tables["machine"], _units_of(scene.machine)))
    for prefix, table, exciter in owners:
        own_fields = {name: table[name] for name in ("at", "direction", "unbalance") if name in table}
        units = dict(_units(Exciter))
        if not isinstance(own_fields.get("at"), int):  # a point or a distance, not the number of a platform
            units["at"] = units["position"]
        parts += [(prefix.removesuffix(", "), own_fields, units)] if own_fields else []
        for section in [name for name in ("loads", "drive") if name in table]:
            kind = str(table[section].pop("kind"))
            parts.append((f"{prefix}{section}: {_words(kind)}", table[section], _units_of(getattr(exciter, section))))
    for prefix, table in [("", tables), *((prefix, table) for prefix, table, _ in owners if prefix)]:
        for name, value in table.get("effects", {}).items():
            for effect_table in value if isinstance(value, list) else [value]:
                parts.append((f"{prefix}effect: {_words(name)}", effect_table, _units(EFFECTS[name])))
    shown = [(title, *in_display_units(table, units)) for title, table, units in parts]
    return "".join(f"<h3>{escaped(title)}</h3>{_pair_table(list(table.items()), units)}" for title, table, units in shown)


def _units(part: type) -> dict[str, str]:
    return {name: spec.unit_of_tables for name, spec in number_specs(part).items()}


def _units_of(part: object) -> dict[str, str]:
    """Return the units of the numbers of a part, and of the parts within it such as supports and motors, by name."""
    units: dict[str, str] = {}
    for value in vars(part).values():
        for each in value if isinstance(value, tuple) else (value,):
            units |= _units_of(each) if isinstance(each, eqx.Module) else {}
    return units | _units(type(part))


def _entries(value: Plain) -> TypeGuard[list[Mapping[str, Plain]]]:
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def _words(name: str) -> str:
    return name.replace("_", " ")


def _fits_in_cell(value: Plain) -> bool:
    """Return True if a value fits into one cell."""
    if isinstance(value, list):
        return len(value) <= _MAX_INLINE_ENTRIES and all(not isinstance(x, (list, dict)) for x in value)
    return not isinstance(value, dict)


def _unit_of(name: str, units: Units) -> str:
    return f", {escaped(units[name])}" if units.get(name) else ""


def _pair_table(pairs: Sequence[tuple[str, Plain]], units: Units) -> str:
    if not pairs:
        return ""
    rows = ""
    for name, value in pairs:
        unit = f"<td class='unit'>{escaped(units.get(name, ''))}</td>"
        rows += f"<tr><th>{escaped(_words(name))}</th><td>{_cell(value, units)}</td>{unit}</tr>"
    return f"<div class='wide'><table>{rows}</table></div>"


def _row_table(rows: Sequence[Mapping[str, Plain]], units: Units) -> str:
    """Return a table with a row for each entry. A long text, or an inner table, is below its row, over the whole width."""
    all_names = list(dict.fromkeys(name for row in rows for name in row))
    long_names = [name for name in all_names if any(_is_long(row.get(name)) for row in rows)]
    names = [name for name in all_names if name not in long_names]
    heads = "".join(f"<th{_column_class(rows, name)}>{escaped(_words(name))}{_unit_of(name, units)}</th>" for name in names)
    body = ""
    for row in rows[:_MAX_ROWS]:
        cells = (f"<td{_column_class(rows, name)}>{_cell(row.get(name), units)}</td>" for name in names)
        body += f"<tr>{''.join(cells)}</tr>"
        for name in long_names:
            if row.get(name):
                text = f"{escaped(_words(name))}: {_cell(row[name], units)}"
                body += f"<tr><td class='below' colspan='{len(names)}'>{text}</td></tr>"
    return f"<div class='wide'><table><tr>{heads}</tr>{body}</table></div>{_more_rows_note(len(rows))}"


def _is_long(value: Plain) -> bool:
    return isinstance(value, Mapping) or (isinstance(value, str) and len(value) > _MAX_CELL_CHARACTERS)


def _column_class(rows: Sequence[Mapping[str, Plain]], name: str) -> str:
    """Return the HTML class of a column, by which numbers are aligned to the right."""
    values = [row.get(name) for row in rows]
    numeric = all(v is None or (isinstance(v, (int, float)) and not isinstance(v, bool)) for v in values)
    return " class='n'" if numeric else ""


def _grid_table(values: Sequence[Plain]) -> str:
    """Return a list of lists as a table; for other lists a sentence with the number of entries and their range."""
    rows = [x for x in values if isinstance(x, list) and _fits_in_cell(x)]
    if len(rows) == len(values):
        body = "".join(
            "<tr>" + "".join(f"<td class='n'>{_cell(x, {})}</td>" for x in row) + "</tr>" for row in rows[:_MAX_ROWS]
        )
        return f"<div class='wide'><table>{body}</table></div>{_more_rows_note(len(values))}"
    numbers = [x for x in values if isinstance(x, (int, float)) and not isinstance(x, bool)]
    if not numbers:
        return f"<p>{len(values)} values; see the output of --json or --out</p>"
    least, largest = (_cell(each, {}) for each in (min(numbers), max(numbers)))
    return f"<p>{len(values)} numbers from {least} to {largest}; see the output of --json or --out</p>"


def _more_rows_note(count: int) -> str:
    return f"<p>{count - _MAX_ROWS} more rows; see the output of --json or --out</p>" if count > _MAX_ROWS else ""


def _cell(value: Plain, units: Units) -> str:
    """Return a value as HTML; `units`: those of numbers in tables within it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return escaped(f"{value:.6g}")
    if _entries(value):
        return _row_table(value, units)
    if isinstance(value, list):
        return ", ".join(_cell(x, units) for x in value) or "none"
    if isinstance(value, Mapping):
        return ", ".join(
            f"{escaped(_words(k))} {_cell(v, units)} {escaped(units.get(k, ''))}".rstrip() for k, v in value.items()
        )
    return escaped(value)
