"""Study of a scene, created from arguments or read from a file: varied parameters, measures, runs."""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias, cast

from jaxvib.errors import ComputationError, InputError, quoted, require_one_of
from jaxvib.machine.files import load_scene, read_toml, require_fields, require_tables
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.motion.batch import BatchPlan
from jaxvib.motion.start import Start, initial_state, with_spin_up_drive
from jaxvib.results.fields import Plain
from jaxvib.sweeps.axes import SAMPLINGS, Axis, AxisSpec, Grid, axis_of, require_disjoint, tile_of
from jaxvib.sweeps.definition import Study
from jaxvib.sweeps.measures import Measure, RunMeasure, measure_of
from jaxvib.sweeps.program import plan_runs_of_cases, traced_program
from jaxvib.units import Number, count, number
from optimize.files import quantity_from_table
from optimize.quantities.quantity import TIERS, Quantity, Tier

Measures: TypeAlias = Sequence[Measure | str] | Mapping[str, Measure | str]
"""Type of measures: a list, or a mapping from names to measures."""

_CASES_PER_CHUNK = {"leading": 16384, "exact": 512, "time": 1024}
"""Default number of cases of a chunk by tier: about one second of computation, much more than the time to write the chunk."""

_RESERVED_NAMES = ("status", "error")

_LABEL_MEASURES = ("regime", "mode")
"""Names of the measures by which figures label cases."""

_MAX_CASES = 10**9
"""Maximum number of cases of a study, because the list of all chunks is in memory."""


def study(
    scene: Scene,
    axes: Mapping[str, AxisSpec],
    measure: Measures,
    *,
    tier: Tier | None = None,
    until: Number | None = None,
    start: Start = "rest",
    mode: int | None = None,
    steps: int | None = None,
    samples: int = 0,
    sampling: str = "low_discrepancy",
    seed: int = 0,
    chunk: int | None = None,
) -> Study:
    """Return a validated study; for the arguments see `sweep`. **Raises** `InputError` for values that are not allowed."""
    scene = validate_scene(scene)
    if start == "spin_up" and until is not None:
        scene, start = with_spin_up_drive(scene, number(until, "s", "until", low=0.0, open_low=True), start, None), "rest"
    grid = _grid(scene, axes, samples, sampling, seed)
    names, measures = _name_measures(measure)
    _require_free_names(names, measures, [axis.name for axis in grid.axes])
    has_runs = any(isinstance(m, RunMeasure) for m in measures)
    chosen = tier or ("time" if has_runs else "leading")
    require_one_of(chosen, TIERS, "tier")
    measures = tuple(m.at_tier(tier) if tier and isinstance(m, Quantity) else m for m in measures)
    plan = _run_plan(scene, grid.axes, measures, until, start, mode, steps)
    max_cases = count(_CASES_PER_CHUNK["time" if has_runs else chosen] if chunk is None else chunk, "chunk")
    grid = grid._replace(tile=tile_of(grid.shape, max_cases))
    specs = {name: _plain(spec) for name, spec in axes.items()}
    return _traced(Study(scene, grid, names, measures, plan, start, mode, chosen, specs))


def _grid(scene: Scene, axes: Mapping[str, AxisSpec], samples: int, sampling: str, seed: int) -> Grid:
    """Return the cases of a study, without the size of its chunks."""
    if not isinstance(axes, Mapping) or not axes:
        raise InputError("axes", "is empty; name at least one parameter that varies, such as drive.speed")
    read_axes = tuple(axis_of(scene, name, spec) for name, spec in axes.items())
    require_disjoint(scene, read_axes)
    sampled = [axis.name for axis in read_axes if axis.values is None]
    count(samples, "samples", low=0)
    require_one_of(sampling, SAMPLINGS, "sampling")
    if count(seed, "seed", low=0) >= 2**64:
        raise InputError("seed", "has more than 64 bits; give a smaller whole number")
    if sampled and not samples:
        raise InputError(f"axes.{sampled[0]}", "is a range without a count; give samples, or a count")
    if samples and not sampled:
        raise InputError("samples", f"is {samples}, but no axis is sampled; leave out samples, or the count of an axis")
    grid = Grid(read_axes, samples, seed, sampling, ())
    if math.prod(grid.shape) > _MAX_CASES:
        problem = f"make {math.prod(grid.shape):.3g} cases; a study has {_MAX_CASES:.0e} at most"
        raise InputError("axes", f"{problem}: give fewer values, or give ranges without a count and draw samples")
    return grid


def _require_free_names(names: Sequence[str], measures: Sequence[Measure], axes: Sequence[str]) -> None:
    """**Raises** `InputError` for names of measures that cannot be used for arrays of a store, or that are used already."""
    dimensions = [measure.axis for measure in measures if isinstance(measure, RunMeasure)]
    for name, measure in zip(names, measures, strict=True):
        if name in _LABEL_MEASURES and measure != measure_of(f"run.{name}", f"measure.{name}"):
            raise InputError(f"measure.{name}", f"is the name of the measure run.{name}; choose another one")
        if name in (*_RESERVED_NAMES, *axes, *dimensions, "sample"):
            raise InputError(f"measure.{name}", "is a name that is used already; choose another one")
        if not _is_name(name):
            problem = "is not a valid name of an array: up to 200 printable characters without /, \\ and $"
            raise InputError(f"measure.{name}", f"{problem}, not beginning with . or __; give it another one")


def _run_plan(
    scene: Scene,
    axes: Sequence[Axis],
    measures: Sequence[Measure],
    until: Number | None,
    start: Start,
    mode: int | None,
    steps: int | None,
) -> BatchPlan | None:
    """Return the plan of the runs of all cases, or None if no measure needs a run."""
    runs = [m for m in measures if isinstance(m, RunMeasure)]
    if not runs:
        options = {"until": until, "mode": mode, "steps": steps, "start": None if start == "rest" else start}
        fields = [name for name, value in options.items() if value is not None]
        fields += [f"axes.{axis.name}" for axis in axes if axis.target.number is None]
        if fields:
            problem = "applies to runs, but no quantity is measured in a run; measure for example run.regime"
            raise InputError(fields[0], problem)
        return None
    if until is None:
        raise InputError("until", f"is missing; {runs[0].name} is measured in a run; give the duration of the run")
    end = float(number(until, "s", "until", low=0.0, open_low=True))
    initial_state(scene, start, mode=mode, throw=False)  # raises an error for a start that the scene cannot have
    plan = plan_runs_of_cases(scene, axes, end, None if steps is None else count(steps, "steps"))
    return plan.with_peaks() if any(m.of_whole_run for m in runs) else plan


def _traced(study: Study) -> Study:
    """Return the study with the digest of its program and the shapes of its measures, which are validated."""
    try:
        forms, program = traced_program(study)
    except (InputError, ComputationError):
        raise
    except Exception as error:  # any error of a user's function
        problem = f"cannot be computed ({type(error).__name__}: {error}); it must take a Scene and return a JAX scalar"
        raise InputError("measure", problem) from error
    for name, m, form in zip(study.names, study.measures, forms, strict=True):
        axes_count = 1 if isinstance(m, RunMeasure) and m.axis else 0
        if len(form.shape) != axes_count:
            needed = "an array with one axis is needed" if axes_count else "a scalar is needed"
            raise InputError(f"measure.{name}", f"has shape {form.shape}; {needed}")
    return dataclasses.replace(study, forms=tuple(forms), program=program)


def _is_name(name: str) -> bool:
    """Return True for a name that is allowed for a folder on all file systems and is not typeset as a formula in figures."""
    fits = name.isprintable() and 0 < len(name.encode()) <= 200 and name == name.strip()
    return fits and not set(name) & set("/\\$") and not name.startswith((".", "__")) and name != "zarr.json"


def _plain(spec: AxisSpec) -> Plain:
    if isinstance(spec, Mapping):
        return {key: v if isinstance(v, int) else _plain_number(v) for key, v in spec.items()}
    return [_plain_number(v) for v in spec]


def _plain_number(value: Number | str) -> str | float:
    """Return a number as plain data; a quantity with a unit is written as text."""
    return str(value) if isinstance(value, str) or hasattr(value, "m_as") else float(cast(float, value))


def _name_measures(measure: Measures) -> tuple[tuple[str, ...], tuple[Measure, ...]]:
    """Return a unique name for each measure, and the measures.

    The number of the jam mode is appended to the names of quantities that differ only in the mode.
    """
    if isinstance(measure, Mapping):
        named = {str(name): measure_of(m, f"measure.{name}") for name, m in measure.items()}
        if named:
            return tuple(named), tuple(named.values())
        measure = ()
    if isinstance(measure, (str, Quantity, RunMeasure)) or not isinstance(measure, Sequence) or not measure:
        raise InputError("measure", f"is {quoted(measure)}; give a list of quantities, such as ['run.regime']")
    measures = [measure_of(m, f"measure[{k}]") for k, m in enumerate(measure)]
    names = [m.name.removeprefix("run.").replace(" ", "_").replace("/", "_per_") for m in measures]
    several = {name for name in names if names.count(name) > 1}
    names = [
        f"{name}_{m.mode}" if name in several and isinstance(m, Quantity) and m.mode is not None else name
        for name, m in zip(names, measures, strict=True)
    ]
    for name in names:
        if names.count(name) > 1:
            raise InputError("measure", f"has several {name}; give their names, {{'{name}_a': ..., '{name}_b': ...}}")
    return tuple(names), tuple(measures)


_FIELDS = ["scene", "tier", "samples", "sampling", "seed", "chunk", "axes", "run", "measure"]


def load_study(path: str | Path) -> Study:
    """Read a study file: TOML with the path of a `scene` relative to the file, `[axes]`, `[[measure]]` and, for runs, `[run]`.

    **Returns** `Study`. **Raises** `InputError` for a file that cannot be read, and for an error in it; the message names the
    field.

    >>> import pathlib, tempfile
    >>> from jaxvib.machine.files import TEMPLATES
    >>> from jaxvib.sweeps.study import TEMPLATE, load_study
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> for name, text in (("machine.toml", TEMPLATES["two_mass"]), ("study.toml", TEMPLATE)):
    ...     _ = (folder / name).write_text(text)
    >>> load_study(folder / "study.toml").grid.shape
    (40, 40)
    """
    tables = read_toml(path)
    require_tables(tables, "study", _FIELDS)
    for name in ("scene", "axes", "measure"):
        if name not in tables:
            raise InputError(name, "is missing; a study file needs scene, [axes] and [[measure]]")
    if not isinstance(tables["scene"], str):
        raise InputError("scene", f"is {quoted(tables['scene'])}; give the path of a scene file, in quotes")
    for name in ("axes", "run"):
        if not isinstance(tables.get(name, {}), Mapping):
            raise InputError(name, f"is not a table; write [{name}]")
    if not isinstance(tables["measure"], list) or not tables["measure"]:
        raise InputError("measure", "is not a list of tables; write [[measure]] for each quantity")
    run = dict(tables.get("run", {}))
    require_fields(run, ["until", "start", "mode", "steps"], "run")
    named_measures = [_measure(table, f"measure[{k}]", Path(path)) for k, table in enumerate(tables["measure"])]
    measure: Measures = [m for _, m in named_measures]
    if any(name for name, _ in named_measures):
        names = [name or (m if isinstance(m, str) else m.name).removeprefix("run.") for name, m in named_measures]
        doubled = [name for name in names if names.count(name) > 1]
        if doubled:
            raise InputError("measure", f"has several {doubled[0]}; give each one a different name")
        measure = dict(zip(names, measure, strict=True))
    options = {name: tables[name] for name in ("tier", "samples", "sampling", "seed", "chunk") if name in tables}
    scene = load_scene(Path(path).parent / tables["scene"])
    return study(scene, tables["axes"], measure, **options, **run)


def _measure(table: object, field: str, path: Path) -> tuple[str, Measure | str]:
    if not isinstance(table, Mapping):
        raise InputError(field, f"is {quoted(table)}; it must be a table with a quantity")
    name, rest = table.get("name", ""), {key: value for key, value in table.items() if key != "name"}
    for key in ("name", "function", "unit", "quantity"):
        if not isinstance(table.get(key, ""), str):
            raise InputError(f"{field}.{key}", f"is {quoted(table[key])}; write a text in quotes")
    if "function" in rest:
        return name, _function(rest, name, field)
    if str(rest.get("quantity", "")).startswith("run."):
        read = measure_of(rest["quantity"], f"{field}.quantity")
        if len(rest) > 1:
            raise InputError(f"{field}.{next(k for k in rest if k != 'quantity')}", "is not a field of a quantity of a run")
        return name, read
    quantity, _ = quantity_from_table(rest, field, ())
    return name, quantity


def _function(table: Mapping[str, object], name: str, field: str) -> Quantity:
    """Return a user's quantity: a function of a scene, in a module that Python can import."""
    require_fields(table, ["function", "unit", "name"], field)
    module, _, function = str(table["function"]).partition(":")
    try:
        user_function = getattr(importlib.import_module(module), function)
    except Exception as error:  # any error of the user's module
        reason = f"{error}" if isinstance(error, (ImportError, AttributeError)) else f"{type(error).__name__}: {error}"
        problem = f"is {quoted(table['function'])}, which cannot be imported ({reason}); write 'module:function'"
        raise InputError(f"{field}.function", problem) from error
    return Quantity(name or function, str(table.get("unit", "")), user_function)


TEMPLATE = Path(__file__).with_name("study.toml").read_text(encoding="utf-8")
"""Commented study file."""
