"""Design files in TOML: free parameters, held quantities, demands and the objective."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted, suggest_name
from jaxvib.machine.files import (
    Tables,
    Templates,
    build_part,
    load_scene,
    read_toml,
    require_fields,
    require_tables,
)
from jaxvib.machine.numbers.named import find_number
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.damping import relative_dampings
from jaxvib.runtime.startup import start
from jaxvib.units import count, number
from jaxvib.units.tables import csv_column, row_names
from optimize import recipes
from optimize.design import Catalogue, Design
from optimize.quantities import exciters, jams, machine, motion, response, severity
from optimize.quantities.cases import expected, worst
from optimize.quantities.quantity import Demand, Quantity
from optimize.search.find import require_searcher
from optimize.space import DesignSpace, hold

_QUANTITIES = {
    name: getattr(module, name) for module in (exciters, jams, machine, motion, response, severity) for name in module.__all__
}
"""Quantities of design files by name."""

_STATISTICS = {"expected": expected, "worst": worst}
_SECTIONS = ["scene", "recipe", "free", "ties", "choices", "hold", "demand", "objective", "search"]
_RECIPES = {name: getattr(recipes, name) for name in recipes.__all__ if name != "retune"}
"""Recipes of design files by name."""


@validated
def load_design(path: str | Path) -> Design:
    """Read a design file.

    **Arguments**: `path` of a TOML file with

    - `scene`: the scene file, relative to the design file
    - `[recipe]`: the `name` of a function of `optimize.recipes` (except `retune`), and its arguments, in place of the next
      four tables and of the objective
    - `[free]`: bounds for each parameter that may change
    - `[ties]`: parameters that follow others. A damping that the scene file gives as a ratio or a loss factor follows the
      stiffness and the mass, unless it is free, chosen or tied
    - `[choices]`: parameters whose values are chosen from a list, or from a catalogue: `file`, a CSV file relative to the
      design file, and the name of its `column`. If whole rows are chosen, such as motors, the key is any name. Its value is
      then a table of `file` and `columns`; `columns` maps parameters to names of columns
    - every `[[hold]]`: a quantity and the `value` that it keeps; default: its value in the scene
    - every `[[demand]]`: a quantity that is `at_most` or `at_least` a value
    - `[objective]`: the quantity to minimize, or to maximize with `maximize = true`
    - `[search]`: the arguments of `synthesize`: `starts`, `seed`, `iterations`, `rate`, `polishing`, `searcher`

    A quantity with `tolerances` is a statistic over machines whose parameters deviate within these tolerances. It is the mean
    (`statistic = "expected"`) or the value of the worst machine (`statistic = "worst"`). The worst value is the largest one,
    but for a quantity that is maximized or `at_least` a value it is the smallest one.

    **Returns** `Design`. **Raises** `InputError` for a file that cannot be read, and for an error in it; the message names the
    field.

    >>> import pathlib, tempfile
    >>> from jaxvib.machine.files import TEMPLATES
    >>> from optimize.files import TEMPLATES as DESIGNS, load_design
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> for name, text in (("machine.toml", TEMPLATES["two_mass"]), ("design.toml", DESIGNS["design"])):
    ...     _ = (folder / name).write_text(text)
    >>> load_design(folder / "design.toml").objective.name
    'force_per_amplitude'
    """
    start()  # before the first arrays of the process, which this function may create
    tables = read_toml(path)
    require_tables(tables, "design", _SECTIONS)
    has_recipe = "recipe" in tables
    for name in ("scene",) if has_recipe else ("scene", "free", "objective"):
        if name not in tables and not (name == "free" and "choices" in tables):
            raise InputError(name, "is missing; a design file needs scene, and either [recipe] or [free] and [objective]")
    if not isinstance(tables["scene"], str):
        raise InputError("scene", f"is {quoted(tables['scene'])}; give the path of a scene file, in quotes")
    for name in ("recipe", "free", "ties", "choices", "objective", "search"):
        if not isinstance(tables.get(name, {}), Mapping):
            raise InputError(name, f"is not a table; write [{name}]")
    for name in ("hold", "demand"):
        if not isinstance(tables.get(name, []), list):
            raise InputError(name, f"is not a list of tables; write [[{name}]] for each quantity")
    scene_file = Path(path).parent / tables["scene"]
    scene = load_scene(scene_file)
    design = _design_from_recipe(scene, tables) if has_recipe else _design_from_tables(scene, tables, Path(path).parent)
    space = design.space.with_relative_dampings(relative_dampings(read_toml(scene_file)["machine"], "machine"))
    demands = tuple(d for k, table in enumerate(tables.get("demand", [])) for d in _demands(table, f"demand[{k}]"))
    search = {**design.search, **_search_options(tables.get("search", {}))}
    return dataclasses.replace(design, space=space, search=search, subject_to=(*design.subject_to, *demands))


def _design_from_recipe(scene: Scene, tables: Tables) -> Design:
    """Return the design task of a file with a table [recipe]."""
    for name in ("free", "ties", "choices", "hold", "objective"):
        if name in tables:
            raise InputError(name, "is given together with [recipe], which defines it; leave one of them out")
    table = dict(tables["recipe"])
    name = table.pop("name", None)
    if not isinstance(name, str) or name not in _RECIPES:
        problem = "is missing" if name is None else f"is {quoted(name)}"
        raise InputError("recipe.name", f"{problem}; {suggest_name(str(name), list(_RECIPES))}")
    return build_part(partial(_RECIPES[name], scene), table, "recipe")


def _design_from_tables(scene: Scene, tables: Tables, folder: Path) -> Design:
    """Return the design task of a file in a `folder` with the tables [free] and [objective]."""
    held_tables = [quantity_from_table(table, f"hold[{k}]", ("value",)) for k, table in enumerate(tables.get("hold", []))]
    held = [hold(q, options.get("value")) for q, options in held_tables]
    ties = {name: tuple(v) if isinstance(v, list) else v for name, v in tables.get("ties", {}).items()}
    free, choices = dict(tables.get("free", {})), dict(tables.get("choices", {}))
    catalogues = {name: _read_catalogue(scene, name, listed, folder) for name, listed in choices.items()}
    for name, catalogue in catalogues.items():
        if catalogue is not None:
            choices[name] = catalogue.columns if "columns" in choices[name] else catalogue.columns[name]
    is_maximized = tables["objective"].get("maximize") is True
    objective, options = quantity_from_table(tables["objective"], "objective", ("maximize",), is_large_good=is_maximized)
    if not isinstance(options.get("maximize", False), bool):
        raise InputError("objective.maximize", f"is {quoted(options['maximize'])}; write true or false, without quotes")
    if is_maximized:
        objective = -objective
    space = DesignSpace(scene, free, held, ties=ties, choices=choices)
    return Design(space, objective, catalogues=tuple(filter(None, catalogues.values())))


def _search_options(table: Tables) -> Tables:
    """Return the validated arguments of `synthesize` in a table [search]."""
    search = dict(table)
    require_fields(search, ["starts", "seed", "iterations", "rate", "polishing", "searcher"], "search")
    for name, value in search.items():
        if name == "searcher":
            require_searcher(value)
        elif name == "rate":
            search[name] = float(number(value, "", "search.rate", low=0.0, open_low=True, high=1.0, open_high=True))
        else:
            count(value, f"search.{name}", low=0 if name in ("seed", "polishing") else 1)
    return search


def _read_catalogue(scene: Scene, name: str, values: Any, folder: Path) -> Catalogue | None:
    """Return the catalogue of a choice, or None if the design file itself contains the values.

    A table `values` with `file` and, if necessary, `column` selects a column of a CSV file. A table with `file` and `columns`
    selects several columns whose rows belong together.
    """
    if not isinstance(values, Mapping) or any("." in parameter for parameter in values):
        return None
    column_names = values.get("columns", {name: values.get("column")})
    if (
        not isinstance(values.get("file"), str)
        or values.keys() - {"file", "column", "columns"}
        or not isinstance(column_names, Mapping)
        or not column_names
    ):
        advice = (
            "write a list, or file = 'springs.csv', column = 'rate', or, for whole rows, "
            "columns = {'drive.power' = 'power', ...}"
        )
        raise InputError(f"choices.{name}", f"is {quoted(dict(values))}; {advice}")
    path = folder / values["file"]
    units = {parameter: find_number(scene, parameter, "choices").unit for parameter in column_names}
    columns = {parameter: csv_column(path, units[parameter], column).tolist() for parameter, column in column_names.items()}
    first, column = next(iter(column_names.items()))
    return Catalogue(name, row_names(path, units[first], column), columns)


def _demands(table: object, section: str) -> list[Demand]:
    if isinstance(table, Mapping) and "equal_to" in table:
        raise InputError(f"{section}.equal_to", "is not a demand; a quantity keeps a value by [[hold]] with value = ...")
    names = ("at_most", "at_least")
    for_at_most, limits = quantity_from_table(table, section, names)
    if not limits:
        raise InputError(section, "has no limit; give at_most, at_least or both")
    for_at_least, _ = quantity_from_table(table, section, names, is_large_good=True)
    return [for_at_most < limit if name == "at_most" else for_at_least > limit for name, limit in limits.items()]


def quantity_from_table(
    table: object, section: str, more: tuple[str, ...], *, is_large_good: bool = False
) -> tuple[Quantity, Tables]:
    """Return the quantity that a table in the `section` of a file describes, and the values of its fields named in `more`.

    The worst machine within tolerances has the largest value or, if `is_large_good` is True, the smallest value.

    **Raises** `InputError` for an unknown quantity, and for values that are not allowed.
    """
    if not isinstance(table, Mapping):
        raise InputError(section, f"is {quoted(table)}; it must be a table with a quantity")
    name = table.get("quantity")
    if not isinstance(name, str) or name not in _QUANTITIES:
        problem = "is missing" if name is None else f"is {name!r}"
        raise InputError(f"{section}.quantity", f"{problem}; {suggest_name(str(name), list(_QUANTITIES))}")
    own_fields = (*more, "tolerances", "statistic", "samples")
    values = {k: v for k, v in table.items() if k not in ("quantity", *own_fields)}
    for key in ("of", "prices"):
        if isinstance(values.get(key), list):
            values[key] = tuple(tuple(v) if isinstance(v, list) else v for v in values[key])
    if "mode" in values:
        count(values["mode"], f"{section}.mode")
    elif (response := f"response_{name}") in _QUANTITIES:
        problem = f"is missing; give the number of a jam mode of the loads; for motors with unbalances use {quoted(response)}"
        raise InputError(f"{section}.mode", problem)
    quantity = build_part(_QUANTITIES[name], values, section)
    for key in ("statistic", "samples"):
        if key in table and "tolerances" not in table:
            raise InputError(f"{section}.{key}", "is used only with tolerances; give tolerances too, or leave it out")
    if "tolerances" in table:
        statistic = table.get("statistic", "expected")
        if not isinstance(statistic, str) or statistic not in _STATISTICS:
            raise InputError(
                f"{section}.statistic", f"is {quoted(statistic)}; {suggest_name(str(statistic), list(_STATISTICS))}"
            )
        sense = {"is_large_good": is_large_good} if statistic == "worst" else {}
        quantity = _STATISTICS[statistic](quantity, table["tolerances"], samples=table.get("samples", 64), **sense)
    return quantity, {k: table[k] for k in more if k in table}


_NAMES = ("design", "linear-screen-design", "circular-screen-design", "feeder-design")

TEMPLATES = Templates(Path(__file__).with_name("templates"), {name: (name,) for name in _NAMES})
"""Commented design files of a machine, of screens and of a feeder, by their names in `jaxvib new`."""
