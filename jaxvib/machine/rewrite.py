"""Changes of the numbers in the text of a scene file, which keep its comments and units."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Sequence

from jaxvib.machine.files import in_one_line, scene_from_toml, scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.units.reading import SEVERAL

_TABLE = re.compile(r"\s*\[(\[?)([\w.]+)\]")
_ENTRY = re.compile(r"(\s*(\w+)\s*=\s*)((?:[^\"'#]|\"[^\"]*\"|'[^']*')*?)(\s*)(#\s*(.*))?")
_NUMBER_AND_UNIT = re.compile(rf"\s*((?:{SEVERAL})?)([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(.*)")

_RELATIVE = re.compile(r"%|\bloss\b")
"""Pattern of a damping that is given as a ratio or a loss factor."""

_UNDER = re.compile(r"\bunder\b")
"""Pattern of a stiffness that is given as a deflection, which is inversely proportional to the stiffness."""

_Path = tuple[str | int, ...]
"""Names of tables and indices of arrays of tables."""

_DIGITS = 8
"""Digits of changed numbers. Numbers with more digits are hard to read."""


def rewrite_scene(text: str, scene: Scene) -> str:
    """Return the text of a scene file with the numbers of another scene of the same kind.

    Comments, order and units stay. A changed number has at most 8 digits, and a comment with its old value. A number that
    differs from its default and is not in the text is added in a new line. If the text cannot be changed in this way, for
    example because the scene has other effects, the result is `scene_to_toml(scene)`.

    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> scene = jv.scene_from_toml(TEMPLATES["one_mass"].replace("50 N/mm", "44 N/mm"))
    >>> print(rewrite_scene(TEMPLATES["one_mass"], scene).splitlines()[5])
    stiffness = "44 N/mm"  # was "50 N/mm"; of the support
    """
    read, new = tomllib.loads(text), tomllib.loads(scene_to_toml(scene))
    try:
        old = tomllib.loads(scene_to_toml(scene_from_toml(text)))
    except ValueError:  # the text refers to a file of torques, whose folder is not known here
        return scene_to_toml(scene)
    section: _Path = ()
    counts: dict[_Path, int] = {}
    lines = []
    for line in _whole_entries(text):
        table, entry = _TABLE.match(line), _ENTRY.fullmatch(" ".join(line.split("\n")))
        section = _section_of(table[2].split("."), bool(table[1]), counts) if table else section
        if entry:
            path = (*section, entry[2])
            present, former, value = (_value_at(tables, path) for tables in (read, old, new))
            is_other = path[0] == "machine" and not _is_close(old["machine"], new["machine"])
            line = _rewritten_line(line, entry, present, former, value, is_other)
        lines.append(line)
        if table:
            lines += _added_lines(*(_value_at(tables, section) for tables in (read, old, new)))
    result = "\n".join(lines) + "\n"
    try:
        is_same = _is_close(tomllib.loads(scene_to_toml(scene_from_toml(result))), new)
    except ValueError:  # the changed text is not a scene file
        is_same = False
    return result if is_same else scene_to_toml(scene)


def _added_lines(read: object, old: object, new: object) -> list[str]:
    """Return lines for the numbers of a table that differ from their defaults and are not in the file."""
    if not (isinstance(read, dict) and isinstance(old, dict) and isinstance(new, dict)):
        return []
    return [
        f"{name} = {_with_unit(None, old[name], value)}  # was {_with_unit(None, None, old[name])}, the default"
        for name, value in new.items()
        if name in old and name not in read and isinstance(value, (float, list)) and not _is_close(old[name], value)
    ]


def _whole_entries(text: str) -> list[str]:
    """Return the lines of a text; the lines of a list are one entry."""
    entries: list[str] = []
    for line in text.splitlines():
        is_open = bool(entries) and re.search(r"=\s*\[", entries[-1]) and entries[-1].count("[") > entries[-1].count("]")
        entries[-1:] = [f"{entries[-1]}\n{line}"] if is_open else [*entries[-1:], line]
    return entries


def _section_of(names: Sequence[str], is_array: bool, counts: dict[_Path, int]) -> _Path:
    """Return the path of the table in a header; `counts` of the arrays of tables are updated.

    >>> counts = {}
    >>> [_section_of(["a"], True, counts), _section_of(["a"], True, counts), _section_of(["a", "b"], False, counts)]
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


def _rewritten_line(line: str, entry: re.Match[str], read: object, old: object, new: object, is_other_machine: bool) -> str:
    """Return a line with the value `new`, SI, in place of its value `read`, which is `old` in SI. If the machine has changed, a
    damping ratio becomes a number: the damping is still the same, but the ratio is not."""
    if old is None or new is None or (_is_close(old, new) and not (is_other_machine and _RELATIVE.search(entry[3]))):
        return line
    comment = f"; {entry[6]}" if entry[6] else ""
    written = _with_unit(read, old, new)
    former = in_one_line(entry[3])
    if isinstance(read, dict) and isinstance(new, dict):  # only the numbers that differ
        now = tomllib.loads(f"x = {written}")["x"]
        former = ", ".join(f"{name} = {json.dumps(value)}" for name, value in read.items() if value != now[name])
    return f"{entry[1]}{written}  # was {former}{comment}"


def _with_unit(read: object, old: object, new: object) -> str:
    """Return the value `new`, SI, as TOML in the form and unit of the value `read` in a file, which is `old` in SI."""
    if isinstance(new, list):
        size = len(new)
        reads, olds = (each if isinstance(each, list) and len(each) == size else [each] * size for each in (read, old))
        return f"[{', '.join(map(_with_unit, reads, olds, new))}]"
    if isinstance(new, dict) and isinstance(read, dict):
        olds = old if isinstance(old, dict) else {}
        each = [f"{name} = {_with_unit(value, olds.get(name), new.get(name))}" for name, value in read.items()]
        return f"{{ {', '.join(each)} }}"
    written = _NUMBER_AND_UNIT.fullmatch(read) if isinstance(read, str) else None
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
