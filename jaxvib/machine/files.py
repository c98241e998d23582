"""Scene files: reading and writing of TOML."""

from __future__ import annotations

import inspect
import json
import math
import re
import tomllib
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias, TypeVar

import numpy as np

from jaxvib.boundary import validated
from jaxvib.errors import CONTROL, InputError, quoted, read_text, suggest_name, within, written
from jaxvib.machine.carrier import Machine
from jaxvib.machine.drag import drag_of
from jaxvib.machine.drives.belt import BeltDrive
from jaxvib.machine.drives.controlled import Converter, SpeedControl, SpeedProfile, SwitchedOff, TorqueTable
from jaxvib.machine.drives.drive import ConstantSpeed, DCMotor, Drive, InductionMotor, RunUp, SpinUp
from jaxvib.machine.drives.electrical import DCMotorElectrical, InductionMotorCircuit, InductionMotorElectrical, NamePlateMotor
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.effects.registry import EFFECTS
from jaxvib.machine.loads import Loads, ball_mass, balls, pendulums, rollers
from jaxvib.machine.numbers import PLAIN, NumberSpec, number_specs, with_display_units
from jaxvib.machine.scene import Exciter, Scene, require_parts, unbalance
from jaxvib.machine.structures.plane_body import body, plane_body, plane_network, support
from jaxvib.machine.structures.platforms import network, one_mass, three_mass, two_mass
from jaxvib.machine.structures.rotor import planar_rotor, rotor
from jaxvib.machine.templates import SCREENS as SCREENS
from jaxvib.machine.templates import TEMPLATES as TEMPLATES
from jaxvib.machine.templates import Templates as Templates
from jaxvib.machine.torus import torus_balls
from jaxvib.units import number
from jaxvib.units.known import require_known, when_known
from jaxvib.units.reading import to_float
from jaxvib.units.tables import csv_column, row_names

MACHINES: dict[str, Callable[..., Machine]] = {
    "one_mass": one_mass,
    "two_mass": two_mass,
    "three_mass": three_mass,
    "network": network,
    "plane_body": plane_body,
    "plane_network": plane_network,
    "planar_rotor": planar_rotor,
    "rotor": rotor,
}
LOADS: dict[str, Callable[..., Loads]] = {"ball": balls, "roller": rollers, "pendulum": pendulums, "torus_ball": torus_balls}
DRIVES: dict[str, Callable[..., Drive]] = {
    "constant_speed": ConstantSpeed,
    "spin_up": SpinUp,
    "run_up": RunUp,
    "dc_motor": DCMotor,
    "induction_motor": InductionMotor,
    "switched_off": SwitchedOff,
    "name_plate_motor": NamePlateMotor,
    "dc_motor_electrical": DCMotorElectrical,
    "induction_motor_circuit": InductionMotorCircuit,
    "induction_motor_electrical": InductionMotorElectrical,
    "torque_table": TorqueTable,
    "speed_profile": SpeedProfile,
    "converter": Converter,
    "speed_control": SpeedControl,
    "belt_drive": BeltDrive,
}
SECTIONS: Mapping[str, Mapping[str, Callable[..., Any]]] = {"machine": MACHINES, "loads": LOADS, "drive": DRIVES}
"""Parts by section and `kind`; each constructor takes the fields of the part's table in a scene file.

A class in a user's file gets an entry by a line in that file, such as `DRIVES["turbine"] = Turbine`.
"""

_ENTRIES: Mapping[str, Callable[..., Any]] = {"supports": support, "bodies": body}
"""Arguments that are lists of parts: for each name the constructor of one entry of the list."""

T = TypeVar("T")

Tables: TypeAlias = dict[str, Any]
"""Content of a file by name, before validation: tables, arrays, texts and numbers."""


_KEY = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_LONG_KEY = re.compile(rf"(?<![\w\"'.-]){_KEY}(?:[ \t]*\.[ \t]*{_KEY}){{16}}")
"""A dotted key of more than 16 names; the time of `tomllib` is proportional to the square of their number."""

_HINTS = (
    (re.compile(r"^[^#\n]*=\s*[+-]?\d+,\d", re.MULTILINE), "; write decimals with a point, not with a comma"),
    (
        re.compile(r"^[^#\n\"']*=[ \t]*[+-]?\d[\d.]*[ \t]*(?!e[\d+-])[a-zA-Z%°]", re.MULTILINE),
        '; write a number with a unit in quotes, such as "400 kg"',
    ),
    (
        re.compile(r"^\s*\[(\w+(?:\.\w+)*)\](?:.*\n)+?\s*\[\[\1\]\]", re.MULTILINE),
        "; several tables of one name have two brackets each, such as [[exciters]]",
    ),
)
"""Patterns of mistakes in TOML files, with advice."""


def read_toml(path: str | Path) -> Tables:
    """Return the tables of a TOML file.

    **Raises** `InputError` for a file that is missing, not TOML, larger than 16 MB or nested too deeply, and for control
    characters and numbers of thousands of digits.
    """
    return _tables(read_text(path, "a TOML file, in UTF-8 as `jaxvib new ... --out DIR` writes it"), str(path))


def _tables(text: str, name: str) -> Tables:
    """Return the tables of a TOML text. **Raises** `InputError` whose message begins with `name`."""
    too_deep = "is nested too deeply; files of jaxvib have at most four levels"
    if _LONG_KEY.search(text):
        raise InputError(name, too_deep)
    try:
        tables = tomllib.loads(text)
        _require_plain(tables, "")
    except InputError:
        raise
    except RecursionError as error:
        raise InputError(name, too_deep) from error
    except tomllib.TOMLDecodeError as error:
        hint = next((words for pattern, words in _HINTS if pattern.search(text)), "")
        raise InputError(name, f"is not a TOML file: {error}{hint}") from error
    except ValueError as error:
        raise InputError(name, "has a whole number with more digits than Python reads; write it as 1e6, for example") from error
    return tables


def _require_plain(value: object, name: str) -> None:
    """**Raises** `InputError` for control characters in names and texts, because a terminal would execute them."""
    if isinstance(value, Mapping):
        for key, entry in value.items():
            _require_plain(key, name)
            _require_plain(entry, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for k, entry in enumerate(value):
            _require_plain(entry, f"{name}[{k}]")
    elif isinstance(value, str) and (found := CONTROL.search(value)):
        raise InputError(name or "the file", f"contains the control character {quoted(found[0])}; leave it out")


_MARKS = {
    "scene": (*SECTIONS, "effects", "exciters"),
    "design": ("free", "choices", "objective", "search", "recipe"),
    "study": ("axes", "measure", "run"),
    "identification": ("machine", "run", "channel", "identify"),
    "measurement": ("record", "pendulum", "identify"),
}
"""Names that identify each kind of file."""

_COMMANDS = {"design": "optimize", "study": "sweep", "identification": "identify", "measurement": "identify"}
"""Commands that take a file, by its kind."""


def require_tables(tables: Tables, kind: str, allowed: list[str]) -> None:
    """**Raises** `InputError` for a name that is not `allowed` in a file of this `kind`.

    The message suggests a similar name or, if more names of the file belong to another kind of file, states that kind.

    >>> require_tables({"machine": {}}, "design", ["free"])
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: machine is not part of a design file: this is a scene file, for commands such as modes and ...
    """
    name = next((each for each in tables if each not in allowed), None)
    if name is None:
        return
    present = {each: sum(mark in tables for mark in marks) for each, marks in _MARKS.items()}
    found = max(present, key=lambda each: (present[each], each == kind))
    own, other = (f"{'an' if each == 'identification' else 'a'} {each} file" for each in (kind, found))
    if found == kind or not present[found]:
        is_outside = kind == "scene" and not isinstance(tables[name], (Mapping, list))
        header = "[effects]" if name in EFFECTS else "the header of its table, such as [machine]"
        advice = f"write it below {header}" if is_outside else suggest_name(name, allowed)
        raise InputError(name, f"is not part of {own}; {advice}")
    taken = f"`jaxvib {_COMMANDS[found]}`" if found in _COMMANDS else "commands such as modes and regimes"
    new = f"`jaxvib new {'sweep' if kind == 'study' else kind}` prints {own}"
    advice = "give the scene file that it refers to" if kind == "scene" else new
    raise InputError(name, f"is not part of {own}: this is {other}, for {taken}; {advice}")


@validated
def load_scene(path: str | Path) -> Scene:
    """Read a scene file, see `scene_from_toml`.

    **Arguments**: `path` of a TOML file, at most 16 MB; typical: about 20 lines. The command `jaxvib new` writes examples. A
    drive of the kind `torque_table` may have `file`, a CSV file with speeds and torques, relative to the scene file, in place
    of its lists.

    **Returns** `Scene`. **Raises** `InputError` for a file that cannot be read, and for the first error in it; the message
    names the field.

    >>> import pathlib, tempfile, jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "machine.toml"
    >>> _ = path.write_text(TEMPLATES["two_mass"])
    >>> jv.load_scene(path).machine.kind
    'two_mass'
    """
    return scene_from_tables(_with_torque_tables(read_toml(path), Path(path).parent))


def _with_torque_tables(value: Any, folder: Path) -> Any:
    """Return the tables of a scene file in which each `file` of a torque table is replaced by its two columns."""
    if isinstance(value, list):
        return [_with_torque_tables(each, folder) for each in value]
    if not isinstance(value, Mapping):
        return value
    if value.get("kind") == "torque_table" and isinstance(value.get("file"), str):
        path, rest = folder / value["file"], {name: each for name, each in value.items() if name != "file"}
        speeds, torques = csv_column(path, "rad/s"), csv_column(path, "N m")
        rows = row_names(path, "rad/s")
        if rows != row_names(path, "N m"):
            raise InputError(str(path), "has a row with only one of speed and torque; complete this row or remove it")
        steps = np.diff(speeds) * (-1.0 if speeds[-1] < speeds[0] else 1.0)
        if np.any(steps <= 0.0):
            k = int(np.argmax(steps <= 0.0))
            problem = f"has {speeds[k + 1]:g} rad/s in {rows[k + 1]} after {speeds[k]:g} rad/s"
            raise InputError(str(path), f"{problem}; list the speeds in ascending or descending order")
        return {**rest, "speeds": speeds.tolist(), "torques": torques.tolist()}
    return {name: _with_torque_tables(each, folder) for name, each in value.items()}


@validated
def save_scene(scene: Scene, path: str | Path) -> Path:
    """Write a scene file from which `load_scene` returns the same scene, bit for bit.

    **Arguments**

    - `scene` whose parameters have known values (not under a JAX transformation)
    - `path` of the file, which is overwritten

    **Returns** the path. **Raises** `InputError` if the file cannot be written.

    >>> import pathlib, tempfile, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("600 rpm"))
    >>> path = jv.save_scene(scene, pathlib.Path(tempfile.mkdtemp()) / "machine.toml")
    >>> bool(jv.load_scene(path).drive.speed == scene.drive.speed)
    True
    """
    path = Path(path)
    with written(path) as part:
        part.write_text(scene_to_toml(scene), encoding="utf-8")
    return path


@validated
def scene_from_toml(text: str) -> Scene:
    """Return the scene that the text of a scene file describes.

    **Arguments**: `text` in TOML

    - the tables `[machine]`, `[loads]` and `[drive]` have a `kind` and that kind's arguments, in SI or as text with a unit
    - for several exciters, or for one with an unbalance in place of loads, a table `[[exciters]]` for each, with its
      `[exciters.loads]` and `[exciters.drive]`, in place of `[loads]` and `[drive]`
    - the table `[effects]` contains the effects of the scene, each as `gravity = true` or as a table of its arguments

    **Returns** `Scene`.

    **Raises** `InputError` for a table or field that is missing or unknown, and for values that are not allowed.

    >>> import jaxvib as jv
    >>> scene = jv.scene_from_toml('''
    ... [machine]
    ... kind = "one_mass"
    ... mass = 50.0
    ... stiffness = "40 N/mm"
    ... damping = 30.0
    ... [loads]
    ... kind = "ball"
    ... count = 2
    ... mass = 0.5
    ... radius = 0.1
    ... drag = 1.0
    ... [drive]
    ... kind = "constant_speed"
    ... speed = "1500 rpm"
    ... ''')
    >>> float(scene.machine.stiffness[0])
    40000.0
    """
    return scene_from_tables(_tables(text, "scene"))


def scene_from_tables(tables: Tables) -> Scene:
    """Return the scene that the tables of a scene file describe, see `scene_from_toml`."""
    require_tables(tables, "scene", [*SECTIONS, "effects", "exciters"])
    several = "exciters" in tables
    parts = {}
    for name in ("machine",) if several else SECTIONS:
        if name not in tables:
            instead = ", or [[exciters]] with an unbalance if the scene has no loads" if name == "loads" else ""
            kinds = f" with kind, one of {', '.join(SECTIONS[name])}; `jaxvib new` prints examples" if name == "machine" else ""
            raise InputError(name, f"is missing; a scene file needs the table [{name}]{instead}{kinds}")
        parts[name] = build_kind(tables[name], name, SECTIONS[name])
    for name in ("loads", "drive") if several else ():
        if name in tables:
            raise InputError(name, f"is given as well as [[exciters]]; write [exciters.{name}] below each [[exciters]]")
    effects = _build_effects(tables.get("effects", {}))
    if not several:
        return Scene(**parts, effects=effects)
    exciters = tables["exciters"]
    if not isinstance(exciters, list) or not exciters:
        raise InputError("exciters", "is not a list of tables; write [[exciters]] for each")
    return Scene(**parts, effects=effects, exciters=[_build_exciter(table, k) for k, table in enumerate(exciters)])


def _build_exciter(table: object, k: int) -> Exciter:
    if not isinstance(table, Mapping):
        raise InputError(f"exciters[{k}]", f"is {quoted(table)}; it must be a table; write [[exciters]]")
    with within(f"exciters[{k}]."):
        values = {name: value for name, value in table.items() if name not in ("loads", "drive", "effects")}
        parts = {name: build_kind(table[name], name, SECTIONS[name]) for name in ("loads", "drive") if name in table}
        if isinstance(values.get("unbalance"), Mapping):
            with within("unbalance."):
                values["unbalance"] = build_part(unbalance, values["unbalance"], "")
        effects = _build_effects(table.get("effects", {}))
        return build_part(Exciter, {**values, **parts, "effects": effects}, "")


def _build_effects(chosen: object) -> tuple[Effect, ...]:
    if not isinstance(chosen, Mapping):
        raise InputError("effects", "is not a table; write [effects] and below it, for example, gravity = true")
    effects = []
    for name, value in chosen.items():
        if name not in EFFECTS:
            raise InputError(f"effects.{name}", f"is not an effect; {suggest_name(name, list(EFFECTS))}")
        if isinstance(value, Mapping):
            effects.append(build_part(EFFECTS[name], value, f"effects.{name}"))
        elif isinstance(value, list) and EFFECTS[name].repeatable and all(isinstance(each, Mapping) for each in value):
            effects += [build_part(EFFECTS[name], each, f"effects.{name}[{index}]") for index, each in enumerate(value)]
        elif value is True:
            effects.append(build_part(EFFECTS[name], {}, f"effects.{name}"))
        elif value is not False:
            arguments = inspect.signature(EFFECTS[name]).parameters.values()
            allowed = [] if any(each.default is each.empty for each in arguments) else ["true", "false"]
            if arguments:
                allowed.append(_inline_table(name, value, {"": EFFECTS[name]}) or "a table of its arguments")
            raise InputError(f"effects.{name}", f"is {quoted(value)}; write {' or '.join(allowed)}")
    return tuple(effects)


def _inline_table(name: str, value: object, builds: Mapping[str, Callable[..., object]]) -> str:
    """Return the inline table of TOML that is meant by a kind or a number in the place of the table `name`: that of the first
    part in `builds`, by its kind, which has an argument with the unit of the number; "" if there is none."""
    for kind, build in builds.items():
        given = {"kind": json.dumps(kind)} if kind else {}
        parameters = inspect.signature(build).parameters
        if value != kind:
            specs = number_specs(build) if isinstance(build, type) else {}
            fits = (each for each in parameters if each in specs and _is_number_in(value, specs[each].unit))
            argument = next(fits, "")
            if not argument:
                continue
            given[argument] = json.dumps(value, ensure_ascii=False)
        given |= {each: "..." for each, it in parameters.items() if it.default is it.empty and each not in given}
        return f"{name} = {{ {', '.join(f'{each} = {text}' for each, text in given.items())} }}"
    return ""


def _is_number_in(value: object, unit: str) -> bool:
    try:
        return isinstance(value, (str, float, int)) and to_float(value, unit, "") is not None
    except InputError:
        return False


def build_kind(table: object, section: str, kinds: Mapping[str, Callable[..., T]]) -> T:
    """Return the part that a table describes. Its field `kind` is one of `kinds`, the other fields are arguments.

    **Raises** `InputError` for an unknown or missing field.
    """
    if not isinstance(table, Mapping):
        example = _inline_table(section.rpartition(".")[2], table, kinds) or f"[{section}]"
        raise InputError(section, f"is {quoted(table)}; it must be a table; write {example}")
    if "kind" not in table:
        raise InputError(f"{section}.kind", f"is missing; allowed: {', '.join(kinds)}")
    kind = table["kind"]
    if not isinstance(kind, str) or kind not in kinds:
        raise InputError(f"{section}.kind", f"is {quoted(kind)}; {suggest_name(str(kind), list(kinds))}")
    return build_part(kinds[kind], {k: v for k, v in table.items() if k != "kind"}, section)


def require_fields(table: Mapping[str, object], allowed: Collection[str], section: str) -> None:
    """**Raises** `InputError` for a field that is not allowed in a table, which the message names as `section.name`."""
    for name in table:
        if name not in allowed:
            field = f"{section}.{name}" if section else name
            raise InputError(field, f"is not a field here; {suggest_name(name, list(allowed), table)}")


def build_part(build: Callable[..., T], values: Mapping[str, object], section: str) -> T:
    """Return the part that the constructor `build` makes of the fields of a table.

    Before the call, tables in these fields are replaced by their parts or values: supports, bodies, a drag from its cause, a
    mass from its material, and a drive within a drive.

    **Raises** `InputError` for an unknown or missing field, which the message names as `section.name`.
    """
    parameters = inspect.signature(build).parameters
    prefix = f"{section}." if section else ""
    require_fields(values, parameters, section)
    needed = [name for name, parameter in parameters.items() if parameter.default is parameter.empty]
    for name in needed:
        if name not in values:
            raise InputError(prefix + name, f"is missing; needed here: {', '.join(needed)}")
    entries = {name: _build_entries(_ENTRIES[name], values[name], prefix + name) for name in _ENTRIES if name in values}
    if isinstance(drag := values.get("drag"), Mapping):
        with within(f"{prefix}drag."):
            _require_equal_lengths(drag, values, prefix)
            size = {name: values[name] for name in ("radius",) if name in values}
            entries["drag"] = build_part(drag_of, {**size, **drag}, "")
    if build in (balls, torus_balls) and isinstance(mass := values.get("mass"), Mapping):
        with within(f"{prefix}mass."):
            size = {name: values[name] for name in ("ball_radius",) if name in values}
            entries["mass"] = build_part(ball_mass, {**size, **mass}, "")
    for name in ("motor", "reference"):  # drives within a drive
        if isinstance(values.get(name), Mapping):
            entries[name] = build_kind(values[name], prefix + name, DRIVES)
    return build(**{**values, **entries})


def _require_equal_lengths(drag: Mapping[str, Any], loads: Mapping[str, Any], prefix: str) -> None:
    """**Raises** `InputError` for radii in the table of a drag that are not those in the table of the loads."""
    for name in ("radius", "ball_radius"):
        if name in drag and name in loads:
            own, other = (float(number(each[name], "m", name)) for each in (drag, loads))
            if not math.isclose(own, other, rel_tol=1e-6):
                raise InputError(name, f"is {own:g} m, but {prefix}{name} is {other:g} m; give the same value in both")


def _build_entries(build: Callable[..., object], tables: object, section: str) -> object:
    """Return the parts of a list of tables. Other values are returned unchanged; the constructor validates them."""
    if not isinstance(tables, list) or not all(isinstance(each, Mapping) for each in tables):
        return tables
    parts = []
    for k, table in enumerate(tables):
        with within(f"{section}[{k}]."):
            parts.append(build_part(build, table, ""))
    return parts


def rebuild_part(part: Any, section: str, given: Mapping[tuple[str | int, ...], str] = MappingProxyType({})) -> Any:
    """Construct a part of a scene again from its parameters, which validates them. Parts of types from outside the package are
    returned unchanged.

    **Arguments**: `given`: texts in place of numbers, by their paths in the part, such as ("damping", 0).
    """
    build = {**MACHINES, **LOADS, **DRIVES, **EFFECTS}.get(part.kind)
    if build is None or not all(hasattr(part, name) for name in inspect.signature(build).parameters):
        return part
    fields = _fields(part, build, _si_numbers)
    for (*outer, name, entry), text in given.items():
        table: Any = fields
        for step in outer:
            table = table[step]
        values: Any = list(table[name]) if isinstance(table[name], list) or np.ndim(table[name]) else [table[name]]
        values[entry] = text
        table[name] = values if len(values) > 1 else text
    return build_part(build, fields, section)


@validated
def scene_to_toml(scene: Scene) -> str:
    """Return the text of a scene file in SI numbers; `scene_from_toml` returns the same scene, bit for bit.

    **Arguments**: `scene` whose parameters have known values (not under a JAX transformation).

    **Returns** text. **Raises** `InputError` for a scene with traced parameters.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness="40 N/mm", damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
    >>> jv.scene_to_toml(scene).splitlines()[:3]
    ['[machine]', 'kind = "one_mass"', 'mass = 50.0']
    """
    import tomli_w  # slow import

    require_known(scene, "scene", "scene_to_toml", "write the scene outside")
    return tomli_w.dumps(_scene_tables(scene, _si_numbers))


def scene_text(scene: Scene) -> str:
    """Return the text of a scene file with display units and 10 digits, for readers; arguments as for `scene_to_toml`.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness="40 N/mm", damping=30.0),
    ...                  jv.balls(count=2, mass=[0.5, 0.6], radius=0.1, drag=1.0), jv.ConstantSpeed("600 rpm"))
    >>> [line for line in scene_text(scene).splitlines() if line.startswith(("stiff", "mass", "speed"))]
    ['mass = "50 kg"', 'stiffness = "40 N/mm"', 'mass = ["500 g", "600 g"]', 'speed = "600 rpm"']
    """
    import tomli_w  # slow import

    require_known(scene, "scene", "scene_text", "print the scene outside")
    text = tomli_w.dumps({name: table for name, table in _scene_tables(scene, with_display_units).items() if table})
    return re.sub(r"\[\n.*?\n\]", lambda array: in_one_line(array[0]), text, flags=re.S)


def in_one_line(array: str) -> str:
    """Return the text of a TOML array in one line."""
    return " ".join(array.split()).replace("[ ", "[").replace(", ]", "]")


_Write: TypeAlias = Callable[[NumberSpec, Any], Any]
"""Function that converts a number or an array for a scene file. Its arguments are the specification and the SI value; it
returns the value, or the nested list of an array, that the file contains."""


def _si_numbers(spec: NumberSpec, value: Any) -> Any:
    return np.asarray(value, dtype=float).tolist()


def _scene_tables(scene: Scene, write: _Write) -> Tables:
    require_parts(scene)
    tables: Tables = {"machine": _part_table("machine", scene.machine, write)}
    if len(scene.exciters) == 1 and scene.exciters[0].is_plain and scene.exciters[0].place is None:
        tables |= {"loads": _part_table("loads", scene.loads, write), "drive": _part_table("drive", scene.drive, write)}
        return {**tables, "effects": _effect_tables(scene.all_effects, write)}
    tables["exciters"] = [_exciter_table(exciter, write) for exciter in scene.exciters]
    return {**tables, "effects": _effect_tables(scene.effects, write)}


def _part_table(section: str, part: Any, write: _Write) -> Tables:
    return {"kind": part.kind, **_fields_of_kind(section, part, SECTIONS[section], write)}


def _fields_of_kind(section: str, part: Any, kinds: Mapping[str, Callable[..., object]], write: _Write) -> Tables:
    """Return the fields of a part. **Raises** `InputError` for a part of a kind from outside the package."""
    if part.kind not in kinds:
        problem = f"is {part.kind!r}, which scene files do not describe; build it in Python"
        if not type(part).__module__.startswith("jaxvib."):  # a user's class
            registry = {"machine": "MACHINES", "drive": "DRIVES"}.get(section, section.upper())
            problem += f", or add an entry: jaxvib.machine.files.{registry}[{part.kind!r}] = {type(part).__name__}"
        raise InputError(f"{section}.kind", problem)
    return _fields(part, kinds[part.kind], write)


def _exciter_table(exciter: Exciter, write: _Write) -> Tables:
    specs = number_specs(Exciter)
    table: Tables = {} if exciter.platform is None else {"at": exciter.platform}
    numbers = {"at": "position", "unbalance": "unbalance", "unbalance_mass": "unbalance_mass"}
    values = {key: (specs[name], getattr(exciter, name)) for key, name in numbers.items()}
    table |= {key: write(spec, value) for key, (spec, value) in values.items() if value is not None}
    table |= {"body": exciter.body} if exciter.body else {}
    parts = {name: part for name in ("loads", "drive") if (part := getattr(exciter, name)) is not None}
    table |= {"direction": exciter.direction, **{name: _part_table(name, part, write) for name, part in parts.items()}}
    return {**table, "effects": _effect_tables(exciter.effects, write)} if exciter.effects else table


def _effect_tables(effects: tuple[Effect, ...], write: _Write) -> Tables:
    tables: Tables = {}
    for effect in effects:
        fields = _fields_of_kind("effects", effect, EFFECTS, write)
        if effect.repeatable:
            tables.setdefault(effect.kind, []).append(fields)
        else:
            tables[effect.kind] = fields
    return tables


def _fields(part: object, build: Callable[..., object], write: _Write) -> Tables:
    fields: Tables = {}
    specs = number_specs(type(part))
    for name in inspect.signature(build).parameters:
        value = getattr(part, name)
        if value is None:  # an option that is not set
            continue
        if isinstance(value, tuple):
            fields[name] = [_fields(each, _ENTRIES[name], write) if name in _ENTRIES else list(each) for each in value]
        elif isinstance(value, (int, str)):
            fields[name] = value
        elif isinstance(value, Drive):
            fields[name] = _part_table("drive", value, write)
        else:
            # For a machine, an array with one value is written as a number. For loads it stays a list, because a number is the
            # value of all loads, and a list contains the value of each load.
            plain = when_known(partial(write, specs.get(name, PLAIN)), value)
            if isinstance(part, Machine) and isinstance(plain, list) and len(plain) == 1 and not isinstance(plain[0], list):
                plain = plain[0]
            fields[name] = value if plain is None else plain  # `rebuild_part` passes traced values to the constructor
    return fields
