"""Changes of the numbers in the text of a scene file, which keep its comments and units."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Sequence
from typing import NamedTuple

from jaxvib.machine.files import Tables, in_one_line, scene_from_toml, scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.units.reading import SEVERAL, without_typesetting

_BLANK = re.compile(r"(?:\s|#[^\n]*)*")
_NAME = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_KEY = re.compile(rf"{_NAME}(?:[ \t]*\.[ \t]*{_NAME})*")
_HEADER = re.compile(rf"\[(\[?)[ \t]*({_KEY.pattern})[ \t]*\]+")
_STRING = r"""\"{3}(?:[^\\]|\\.)*?\"{3,5}|'{3}.*?'{3,5}|"(?:[^"\\\n]|\\.)*"|'[^'\n]*'"""
_SCALAR = re.compile(rf"{_STRING}|[^,\]}}#\n]*[^,\]}}#\s]", re.DOTALL)
_STRING_OR_COMMENT = re.compile(rf"{_STRING}|#[^\n]*", re.DOTALL)
_NUMBER_AND_UNIT = re.compile(rf"\s*((?:{SEVERAL})?)([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(.*)")

_RELATIVE = re.compile(r"%|\bloss\b")
"""Pattern of a damping that is given as a ratio or a loss factor."""

_UNDER = re.compile(r"\bunder\b")
"""Pattern of a stiffness that is given as a deflection, which is inversely proportional to the stiffness."""

_Path = tuple[str | int, ...]
"""Names of tables and indices of arrays of tables."""

_DIGITS = 8
"""Digits of changed numbers. Numbers with more digits are hard to read."""


class _Value(NamedTuple):
    """Value in a TOML text, from `start` to `end`, and the entries of a list or of an inline table by their paths in it."""

    start: int
    end: int
    entries: tuple[tuple[_Path, _Value], ...] = ()


class _Edit(NamedTuple):
    """Replacement of the text from `start` to `end`, and the old value for the comment of the line, or ""."""

    start: int
    end: int
    written: str
    former: str


class _Values(NamedTuple):
    """A value as TOML reads it in the file, its old and its new value in SI, and the value `kept` that its text has beside the
    new values."""

    read: object
    old: object
    kept: object
    new: object


def rewrite_scene(text: str, scene: Scene) -> str:
    """Return the text of a scene file with the numbers of another scene of the same kind.

    Comments, order and units stay. A changed number has at most 8 digits, and a comment with its old value. A number that
    differs from its default and is not in the text is added. If the text cannot be changed in this way, for example because
    the scene has other effects, the result is `scene_to_toml(scene)`.

    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> scene = jv.scene_from_toml(TEMPLATES["one_mass"].replace("50 N/mm", "44 N/mm"))
    >>> print(rewrite_scene(TEMPLATES["one_mass"], scene).splitlines()[5])
    stiffness = "44 N/mm"  # was "50 N/mm"; of the support
    """
    new = tomllib.loads(scene_to_toml(scene))
    try:
        old = tomllib.loads(scene_to_toml(scene_from_toml(text)))
    except ValueError:  # the text refers to a file of torques, whose folder is not known here
        return scene_to_toml(scene)
    kept = new
    for _ in range(2):  # the second time also dampings that no longer have the ratio of their texts
        result = _with_edits(text, _edits(text, old, kept, new))
        try:
            kept = tomllib.loads(scene_to_toml(scene_from_toml(result)))
        except ValueError:  # the changed text is not a scene file
            break
        if _is_close(kept, new):
            return result
    return scene_to_toml(scene)


def _with_edits(text: str, edits: Sequence[_Edit]) -> str:
    """Return the text with edits, and the old values in comments at the ends of their lines, before the comments there."""
    comments = {found.end(): found.start() for found in _STRING_OR_COMMENT.finditer(text) if found[0].startswith("#")}
    formers: dict[int, list[str]] = {}
    for edit in edits:
        if edit.former:
            formers.setdefault(_line_end(text, edit.end), []).append(edit.former)
    replaced = [(edit.start, edit.end, edit.written) for edit in edits]
    for end, former in formers.items():
        start = comments.get(end, end)
        comment = text[start:end].lstrip("# \t")
        replaced.append((len(text[:start].rstrip()), end, f"  # was {', '.join(former)}{comment and '; '}{comment}"))
    for start, end, written in sorted(replaced, reverse=True):
        text = text[:start] + written + text[end:]
    return text


def _line_end(text: str, at: int) -> int:
    end = text.find("\n", at)
    return len(text) if end < 0 else end


def _edits(text: str, old: Tables, kept: Tables, new: Tables) -> list[_Edit]:
    """Return the edits that make the values of a TOML text new, see `_Values`."""
    read = tomllib.loads(text)
    every = (read, *(_in_form_of(read, tables) for tables in (old, kept, new)))
    section: _Path = ()
    counts: dict[_Path, int] = {}
    edits = []
    at = _skip_blank(text, 0)
    while at < len(text):
        header = _HEADER.match(text, at)
        if header:
            section = _section_of(_names(header[2]), bool(header[1]), counts)
            at, end = header.end(), _line_end(text, header.end())
            added = _added(_Values(*(_value_at(tables, section) for tables in every)))
            edits.append(_Edit(end, end, "".join(f"\n{name} = {number}  # was {former}" for name, number, former in added), ""))
        else:
            names, value = _entry(text, at)
            path, at = (*section, *names), value.end
            values = _Values(*(_value_at(tables, path) for tables in every))
            edits += _changes(text, value, str(names[-1]), values)
        at = _skip_blank(text, at)
    return edits


def _in_form_of(read: Tables, tables: Tables) -> Tables:
    """Return the tables of `scene_to_toml` with an exciter in `exciters` if it is there in the file."""
    if "exciters" not in read or "exciters" in tables:
        return tables
    exciter = {name: tables[name] for name in ("loads", "drive")}
    effects = read["exciters"][0].get("effects", {})
    own = {name: each for name, each in tables["effects"].items() if name in effects}
    others = {name: each for name, each in tables["effects"].items() if name not in effects}
    return {"machine": tables["machine"], "exciters": [{**exciter, "effects": own}], "effects": others}


def _skip_blank(text: str, at: int) -> int:
    """Return the position of the next character that is neither blank nor in a comment."""
    found = _BLANK.match(text, at)
    return found.end() if found else at


def _names(key: str) -> _Path:
    """Return the names in a key.

    >>> _names('exciters . "drive"')
    ('exciters', 'drive')
    """
    names: list[str] = []
    table: object = tomllib.loads(f"{key} = 0")
    while isinstance(table, dict):
        ((name, table),) = table.items()
        names.append(name)
    return tuple(names)


def _entry(text: str, at: int) -> tuple[_Path, _Value]:
    """Return the names and the value of the entry `key = value` at a position of a valid TOML text."""
    key = _KEY.match(text, at)
    assert key is not None
    return _names(key[0]), _value(text, _skip_blank(text, text.index("=", key.end()) + 1))


def _value(text: str, start: int) -> _Value:
    """Return the value at a position of a valid TOML text."""
    if text[start] not in "[{":
        scalar = _SCALAR.match(text, start)
        assert scalar is not None
        return _Value(start, scalar.end())
    entries: list[tuple[_Path, _Value]] = []
    at = _skip_blank(text, start + 1)
    while text[at] not in "]}":
        path, value = ((len(entries),), _value(text, at)) if text[start] == "[" else _entry(text, at)
        entries.append((path, value))
        at = _skip_blank(text, value.end)
        at = _skip_blank(text, at + 1) if text[at] == "," else at
    return _Value(start, at + 1, tuple(entries))


def _added(values: _Values) -> list[tuple[str, str, str]]:
    """Return the names, the new and the former values of the numbers of a table that differ from their defaults and are not in
    the file."""
    read, old, _, new = values
    if not (isinstance(read, dict) and isinstance(old, dict) and isinstance(new, dict)):
        return []
    return [
        (name, _with_unit(None, old[name], value), f"{_with_unit(None, None, old[name])}, the default")
        for name, value in new.items()
        if name in old and name not in read and isinstance(value, (float, list)) and not _is_close(old[name], value)
    ]


def _section_of(names: _Path, is_array: bool, counts: dict[_Path, int]) -> _Path:
    """Return the path of the table in a header; `counts` of the arrays of tables are updated.

    >>> counts = {}
    >>> [_section_of(("a",), True, counts), _section_of(("a",), True, counts), _section_of(("a", "b"), False, counts)]
    [('a', 0), ('a', 1), ('a', 1, 'b')]
    """
    path: _Path = ()
    for k, name in enumerate(names):
        path = (*path, name)
        if is_array and k == len(names) - 1:
            counts[path] = counts.get(path, -1) + 1
        path = (*path, counts[path]) if path in counts else path
    return path


def _value_at(tables: object, path: _Path) -> object:
    for step in path:
        if isinstance(tables, list):
            tables = tables[step] if isinstance(step, int) and step < len(tables) else None
        else:
            tables = tables.get(step) if isinstance(tables, dict) else None
    return tables


def _changes(text: str, value: _Value, label: str, values: _Values) -> list[_Edit]:
    """Return the edits that make a value of a file new. `label`: its path from the name of its entry on, for the comment."""
    read, old, kept, new = values
    was = in_one_line(text[value.start : value.end])
    is_relative = isinstance(read, str) and bool(_RELATIVE.search(read))
    if old is None or new is None or (_is_close(kept, new) and (is_relative or _is_close(old, new))):
        return []
    below = label if "[" in label else label.partition(".")[2]
    former = f"{below} = {was}" if below else was
    is_table = isinstance(read, dict) and isinstance(new, dict)
    if not is_table and not (isinstance(read, list) and isinstance(new, list) and len(read) == len(new)):
        return [_Edit(value.start, value.end, _with_unit(read, old, new), former)]
    is_plain = not is_table and "{" not in was  # a list of numbers
    edits: list[_Edit] = []
    for path, each in value.entries:
        inner = label if is_plain else f"{label}.{'.'.join(map(str, path))}" if is_table else f"{label}[{path[0]}]"
        edits += _changes(text, each, inner, _Values(*(_value_at(one, path) for one in values)))
    if is_plain and edits and "\n" not in text[value.start : value.end]:
        return [edits[0]._replace(former=former), *(edit._replace(former="") for edit in edits[1:])]
    end = value.entries[-1][1].end if value.entries else value.start + 1
    for name, written, default in _added(values):
        edits.append(
            _Edit(end, end, f"{', ' if value.entries else ''}{name} = {written}", f"{below}{below and '.'}{name} = {default}")
        )
    return edits


def _with_unit(read: object, old: object, new: object) -> str:
    """Return the value `new`, SI, as TOML in the form and unit of the value `read` in a file, which is `old` in SI."""
    if isinstance(new, list):
        size = len(new)
        reads, olds = (each if isinstance(each, list) and len(each) == size else [each] * size for each in (read, old))
        return f"[{', '.join(map(_with_unit, reads, olds, new))}]"
    if isinstance(new, dict):  # an effect that the file switches on by `true`
        return f"{{ {', '.join(f'{name} = {written}' for name, written, _ in _added(_Values({}, old, old, new)))} }}"
    written = _NUMBER_AND_UNIT.fullmatch(without_typesetting(read)) if isinstance(read, str) else None
    if isinstance(new, str):
        return f'"{new}"'
    if not isinstance(new, float):
        return str(new).lower()
    is_plain = written is None or bool(_RELATIVE.search(written[0])) or float(written[2]) == 0.0
    if written is None or is_plain or not isinstance(old, float) or old == 0.0:
        return f"{new:.{_DIGITS}g}"
    factor = old / new if _UNDER.search(written[3]) and new != 0.0 else new / old
    return f'"{written[1]}{factor * float(written[2]):.{_DIGITS}g}{written[3]}"'


def _is_close(one: object, other: object) -> bool:
    """Return True if two values of TOML are equal, numbers to `_DIGITS` digits."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_is_close(one[name], other[name]) for name in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_is_close, one, other))
    if isinstance(one, bool) or isinstance(other, bool) or not isinstance(one, (int, float)):
        return one == other
    return isinstance(other, (int, float)) and math.isclose(one, other, rel_tol=10.0 ** (1 - _DIGITS))
