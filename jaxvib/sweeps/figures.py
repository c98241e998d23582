"""Figures of the stored results of a sweep. The axes determine the kind of figure; large stores are read in parts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.display import Axes, Drawn, Figure, shown_unit
from jaxvib.errors import InputError, quoted, suggest_name
from jaxvib.machine.drives.drive import ConstantSpeed
from jaxvib.machine.files import scene_from_toml
from jaxvib.machine.numbers.named import find_number
from jaxvib.results.estimate import wilson
from jaxvib.steady.jams.branch_plot import KINDS
from jaxvib.steady.orbits.diagram import exact_branches
from jaxvib.sweeps.axes import SAMPLE, axis_of, put_values
from jaxvib.sweeps.definition import WITH_RESULTS
from jaxvib.sweeps.store import Store

if TYPE_CHECKING:
    from jaxvib.draw.style import Look

_MAX_DOTS = 1500
"""Maximum number of cases along an axis of a figure. If there are more, only every k-th case is drawn."""

_THEORY_ROWS = 9
"""Number of values, along the axis that is not the rotor speed, for which folds and torus bifurcations are computed."""

_HISTOGRAM_BINS = 60

_MAX_PANELS = 4
"""Maximum number of measures in the figure of a study with one axis."""

_SPEED = "drive.speed"


class _Labels(NamedTuple):
    """Labels of cases: `codes` (cases ...) are indices of `names`, or -1 without a label."""

    codes: np.ndarray
    names: list[str]


def plot_sweep(store: str | Path, *, ax: Axes | None = None) -> Drawn:
    """Plot the kind of figure that suits the axes of a study.

    - two axes or more: a map, of regimes if they were measured
    - samples as the only axis: the distribution of the first measure
    - one axis: up to four measures as points; with samples, the shares of regimes if they were measured

    For a measure with several values in a case, such as an amplitude for each coordinate, the largest value is shown.
    """
    opened = Store(Path(store))
    dims = opened.dims
    if len([d for d in dims if d != SAMPLE]) >= 2:
        return plot_map(store, ax=ax)
    if dims == [SAMPLE]:
        return plot_distribution(store, ax=ax)
    if SAMPLE in dims and _has_labels(opened):
        return plot_shares(store, ax=ax)
    return _plot_line(opened, ax)


def _plot_line(store: Store, ax: Axes | None) -> Drawn:
    """Plot the measures of a study with one axis as points, with a panel for each. If `ax` is given, only the first measure
    with numbers is drawn."""
    from jaxvib.draw.style import panels
    from jaxvib.draw.sweeps import points_over

    axis = store.dims[0]
    x, step = _thinned(store, axis)
    region = tuple(slice(None, None, step if dim == axis else 1) for dim in store.dims)
    named = [name for name in store.names if not (name == "mode" and "regime" in store.names)][:_MAX_PANELS]
    named = [_measure_name(store, None)] if ax is not None else named
    figure, axes = panels(len(named), size=(7.0, 3.6 if len(named) == 1 else 2.2), share_x=True, ax=ax)
    log = _is_log(store, axis)
    scale = display_unit(store, axis)[1]
    for panel, name in zip(axes, named, strict=True):
        shared = {"log": log, "x_label": axis_label(store, axis) if panel is axes[-1] else ""}
        if is_label(store, name):
            codes, words = case_labels(store, region)
            present = sorted(set(codes[codes >= 0].ravel().tolist()))
            heights = np.array([[present.index(k) if k >= 0 else np.nan for k in row] for row in codes.reshape(x.size, -1)])
            points_over(scale * x, heights, y_label="", ax=panel, **shared)
            panel.set_yticks(range(len(present)), [words[k].replace("_", " ") for k in present])
            panel.set_ylim(-0.6, len(present) - 0.4)
            continue
        values = display_unit(store, name)[1] * _values(store, name, region)
        points_over(scale * x, values.reshape(x.size, -1), y_label=measure_label(store, name), ax=panel, **shared)
    return figure if ax is None else ax


def figures(
    store: str | Path, measure: str | None = None, *, x: str | None = None, y: str | None = None, theory: bool = True
) -> Iterator[tuple[str, Figure]]:
    """Yield the figures that suit the axes of a study, each with its name: "map", "shares", "distribution" or "tornado".

    The arguments are those of `plot_map`.

    **Raises** `InputError` for names that the store does not have.
    """
    opened = Store(Path(store))
    grid = [d for d in opened.dims if d != SAMPLE]
    if len(grid) >= 2:
        yield "map", plot_map(store, measure, x=x, y=y, theory=theory)
    elif x or y:
        raise InputError("--over", f"selects a map, which needs two axes; this study has: {', '.join(grid) or 'none'}")
    if grid and _has_labels(opened):
        yield "shares", plot_shares(store, x)
    if measure is not None or any(not is_label(opened, name) for name in opened.names):
        yield "distribution", plot_distribution(store, measure)
        yield "tornado", plot_tornado(store, measure)


def plot_map(
    store: str | Path,
    measure: str | None = None,
    *,
    x: str | None = None,
    y: str | None = None,
    theory: bool = True,
    ax: Axes | None = None,
) -> Drawn:
    """Plot a map over two axes: values, or labels (regimes, jam modes) with the folds and torus bifurcations of exact jams.

    **Arguments**

    - `measure`: its name in the store; default: the regime or the jam mode if it was measured, otherwise the first measure
      with numbers
    - `x`, `y`: names of the axes of the map; default for `x`: the rotor speed if it is an axis, otherwise the first axis;
      default for `y`: the first of the remaining axes. The map shows the cases in which all other axes have their middle
      value. For a measure with several values in a case, the largest value is shown
    - `theory`: True to draw lines on which exact jams have a fold or lose their stability, computed by
      `branches(scene, exact=True)`; this needs the rotor speed as one of the axes

    **Returns** a matplotlib figure, or the given `ax`. **Raises** `InputError` for names that the store does not have.
    """
    from jaxvib.draw.sweeps import label_map, value_map

    opened = Store(Path(store))
    dims = opened.dims
    grid = [d for d in dims if d != SAMPLE]
    for name, chosen in (("x", x), ("y", y)):
        if chosen is not None and chosen not in grid:
            raise InputError(name, f"is {quoted(chosen)}; {suggest_name(chosen, grid)}")
    rest = [d for d in grid if d not in (x, y)]
    x_name = x or (_SPEED if _SPEED in rest else rest[0] if rest else None)
    rest = [d for d in rest if d != x_name]
    y_name = y or (rest[0] if rest else None)
    if x_name is None or y_name is None or x_name == y_name:
        raise InputError("x", f"and y must be two different axes; this study has: {', '.join(grid) or 'none'}")
    (xs, step_x), (ys, step_y) = _thinned(opened, x_name), _thinned(opened, y_name)
    steps = {x_name: slice(None, None, step_x), y_name: slice(None, None, step_y)}
    region = tuple(steps.get(d, slice(n // 2, n // 2 + 1)) for d, n in zip(dims, opened.shape, strict=True))
    order = sorted(range(len(dims)), key=lambda k: (dims[k] in (y_name, x_name), dims[k] == x_name))
    shape = (ys.size, xs.size)
    labels: Look = {"x_label": axis_label(opened, x_name), "y_label": axis_label(opened, y_name)}
    labels["log"] = (_is_log(opened, x_name), _is_log(opened, y_name))
    (_, scale_x), (_, scale_y) = display_unit(opened, x_name), display_unit(opened, y_name)
    if measure in (None, "regime", "mode") and _has_labels(opened):
        table = case_labels(opened, region)
        lines = _theory_lines(opened, x_name, y_name, xs, ys) if theory else {}
        codes = np.transpose(table.codes, order).reshape(shape)
        lines = {kind: [(scale_x * a, scale_y * b) for a, b in parts] for kind, parts in lines.items()}
        return label_map(scale_x * xs, scale_y * ys, codes, table.names, lines=lines, **labels, ax=ax)
    name = _measure_name(opened, measure)
    values = np.transpose(_values(opened, name, region), order).reshape(shape)
    _, factor = display_unit(opened, name)
    return value_map(scale_x * xs, scale_y * ys, factor * values, label=measure_label(opened, name), **labels, ax=ax)


def plot_shares(store: str | Path, over: str | None = None, *, ax: Axes | None = None) -> Drawn:
    """Plot the share of each label (regimes with their jam modes) over one axis; of samples with Wilson's 95 % intervals.

    Each share is taken over all cases of the other axes. **Returns** a matplotlib figure, or the given `ax`.
    """
    from jaxvib.draw.sweeps import shares_chart

    opened = Store(Path(store))
    dims = opened.dims
    grid = [d for d in dims if d != SAMPLE]
    over = over or (grid[0] if grid else None)
    if over is None or over not in grid:
        raise InputError("over", f"is {quoted(over)}; {suggest_name(str(over), grid)}")
    if not _has_labels(opened):
        raise InputError(
            "store", "contains neither regimes nor jam modes, so that there are no shares to show; measure run.regime"
        )
    place = dims.index(over)
    hits: dict[str, np.ndarray] = {}
    for rows in opened.pieces():
        table = case_labels(opened, rows)
        codes = np.moveaxis(table.codes, place, 0).reshape(table.codes.shape[place], -1)
        at = rows if place == 0 else slice(None)
        for k, name in [(-1, "no result"), *enumerate(table.names)]:
            hits.setdefault(name, np.zeros(opened.shape[place]))[at] += np.sum(codes == k, axis=1)
    total = np.sum(list(hits.values()), axis=0)
    shares = {name: (n / total, *wilson(n, total)) for name, n in hits.items() if np.any(n > 0)}
    log = _is_log(opened, over)
    _, scale = display_unit(opened, over)
    look: Look = {"x_label": axis_label(opened, over), "log": log, "intervals": SAMPLE in dims}
    return shares_chart(scale * opened.read(over), shares, **look, ax=ax)


def plot_distribution(store: str | Path, measure: str | None = None, *, ax: Axes | None = None) -> Drawn:
    """Plot the distribution of a measure over all cases that have a value, stacked by regime if it was measured. **Returns** a
    matplotlib figure, or the given `ax`."""
    from jaxvib.draw.sweeps import distribution_chart

    opened = Store(Path(store))
    name = _measure_name(opened, measure)
    low, high = np.inf, -np.inf
    for rows in opened.pieces():
        values = _values(opened, name, rows)
        values = values[np.isfinite(values)]
        low, high = min(low, np.min(values, initial=np.inf)), max(high, np.max(values, initial=-np.inf))
    if not low <= high:
        raise _no_value(opened, name)
    edges = np.linspace(low, high if high > low else low + max(abs(low), 1.0) * 1e-6, _HISTOGRAM_BINS + 1)
    counts: dict[str, np.ndarray] = {}
    for rows in opened.pieces():
        values, table = _values(opened, name, rows), _regimes(opened, rows)
        for code, label in enumerate(table.names):
            counts[label] = counts.get(label, 0) + np.histogram(values[table.codes == code], edges)[0]
    counts = {label: count for label, count in counts.items() if np.any(count)}
    _, factor = display_unit(opened, name)
    return distribution_chart(factor * edges, counts, x_label=measure_label(opened, name), ax=ax)


def _regimes(store: Store, region: slice | tuple[slice, ...]) -> _Labels:
    """Return the labels of the cases of a region; without measured labels, all cases have the label ""."""
    if _has_labels(store):
        return case_labels(store, region)
    return _Labels(np.zeros(store.read("status", region).shape, int), [""])


def _no_value(opened: Store, name: str) -> InputError:
    problem = "which has no value in any case; choose another one"
    return InputError("measure", f"is {quoted(name)}, {problem}: {', '.join(opened.names)}")


def plot_tornado(store: str | Path, measure: str | None = None, *, ax: Axes | None = None) -> Drawn:
    """Plot two means of a measure for each varied parameter: over the fifth of the cases with the lowest values of this
    parameter, and over the fifth with the highest.

    The cases are those of the most common regime, because a mean over several regimes describes none of them; without measured
    regimes, all cases. The parameter with the largest influence is on top. **Returns** a matplotlib figure, or the given `ax`.
    """
    from jaxvib.draw.sweeps import tornado_chart

    opened = Store(Path(store))
    name, dims = _measure_name(opened, measure), opened.dims
    regimes: Counter[str] = Counter()
    for rows in opened.pieces():
        table = _regimes(opened, rows)
        codes = table.codes[np.isfinite(_values(opened, name, rows)) & (table.codes >= 0)]
        numbers = np.bincount(codes, minlength=len(table.names))
        regimes.update({label: int(n) for label, n in zip(table.names, numbers, strict=True) if n})
    if not regimes:
        raise _no_value(opened, name)
    (regime, cases), *others = regimes.most_common()
    sums = {dim: np.zeros((2, n)) for dim, n in zip(dims, opened.shape, strict=True)}  # sums of values, numbers of cases
    for rows in opened.pieces():
        values, table = _values(opened, name, rows), _regimes(opened, rows)
        chosen = np.isfinite(values) & (table.codes == table.names.index(regime))
        for place, dim in enumerate(dims):
            rest, at = tuple(k for k in range(len(dims)) if k != place), rows if place == 0 else slice(None)
            sums[dim][0, at] += np.sum(values, axis=rest, where=chosen)
            sums[dim][1, at] += np.sum(chosen, axis=rest)
    axes = list(opened.record["axes"])
    means = np.asarray([_means_of_fifths(opened.read(axis), *sums[axis if axis in dims else SAMPLE]) for axis in axes])
    label = f"mean of {measure_label(opened, name)}"
    if others:
        label += f"\nonly the most common regime, {cases} of {regimes.total()} cases: {regime}"
    _, factor = display_unit(opened, name)
    words = [_axis_words(opened, axis) for axis in axes]
    middle = np.sum(sums[dims[0]][0]) / cases
    return tornado_chart(words, *(factor * m for m in (*means.T, middle)), x_label=label, ax=ax)


def _means_of_fifths(values: np.ndarray, sums: np.ndarray, cases: np.ndarray) -> tuple[float, float]:
    """Return two means of a measure: over the fifth of the cases with the lowest `values` (n,) of a parameter, and over the
    fifth with the highest. `sums` (n,) of the measure and numbers of `cases` (n,) belong to the values.

    >>> _means_of_fifths(np.array([1.0, 2.0, 3.0]), np.array([4.0, 8.0, 15.0]), np.array([1, 1, 3]))
    (4.0, 5.0)
    """
    means: list[float] = []
    for along in (values, -values):
        inside = along <= np.nanquantile(along, 0.2, weights=cases, method="inverted_cdf")
        means.append(float(np.sum(sums[inside]) / np.sum(cases[inside])))
    return means[0], means[1]


def _thinned(store: Store, axis: str) -> tuple[np.ndarray, int]:
    """Return at most `_MAX_DOTS` values of an axis, and the step between their indices."""
    values = store.read(axis)
    step = -(-values.size // _MAX_DOTS)
    return values[::step], step


def _is_log(store: Store, axis: str) -> bool:
    spec = store.record["axes"].get(axis)
    if isinstance(spec, Mapping):
        return spec.get("scale") == "log"
    values = np.sort(store.read(axis, slice(0, 1 << 20)))
    if values.size < 3 or not values[0] > 0.0 or values[0] == values[-1]:
        return False
    # A list of values is on the scale on which its gaps differ less.
    linear, log = (np.diff(each)[np.diff(each) > 0.0] for each in (values, np.log(values)))
    return bool(np.max(log) / np.min(log) < np.max(linear) / np.min(linear))


_USUAL_SIZES = {"m": 0.01, "N/m": 1e5, "N": 100.0}
"""Typical values, SI, by unit. The display unit of a figure is chosen for these values; the values in the store do not change
it."""


def display_unit(store: Store, name: str) -> tuple[str, float]:
    """Return the display unit of an axis or a measure, and the factor that converts SI values to it."""
    unit = str(store.group[name].attrs.get("units", ""))
    if unit == "m or rad":  # of coordinates
        kinds = set(scene_from_toml(store.record["scene"]).machine.structure().units)
        unit = kinds.pop() if len(kinds) == 1 else unit
    return shown_unit(unit, _USUAL_SIZES.get(unit, 1.0))


def axis_label(store: Store, axis: str) -> str:
    """Return the label of an axis with its display unit: "rotor speed, rpm"."""
    unit, _ = display_unit(store, axis)
    words = _axis_words(store, axis)
    return f"{words}, {unit}" if unit else words


def _axis_words(store: Store, axis: str) -> str:
    """Return the name of an axis for a reader: "rotor speed", "stiffness of support 2"."""
    words = {_SPEED: "rotor speed", "start.rate": "initial speed of the loads", "start.angle": "initial angle of the loads"}
    if axis in words:
        return words[axis]
    scene = scene_from_toml(store.record["scene"])
    try:
        named = find_number(scene, axis, "axis").words(scene)
    except InputError:  # an axis that is not a parameter of the scene
        return axis
    return named[0] if len(named) == 1 else axis


def _measure_name(store: Store, name: str | None) -> str:
    """Return the name of a measure; default: the first one with numbers."""
    plain = [n for n in store.names if not is_label(store, n)]
    measure = name or next(iter(plain or store.names))
    if measure not in store.names:
        raise InputError("measure", f"is {quoted(measure)}; {suggest_name(measure, list(store.names))}")
    return measure


def measure_label(store: Store, name: str) -> str:
    """Return the label of a measure with its display unit, as text for matplotlib."""
    attributes = store.group[name].attrs
    words, (unit, _) = str(attributes.get("long_name", name)), display_unit(store, name)
    return (f"{words}, {unit}" if unit else words).replace("$", r"\$")  # otherwise matplotlib typesets a formula


def _values(store: Store, name: str, region: slice | tuple[slice, ...]) -> np.ndarray:
    """Return the values of a measure in a region, NaN for missing values; for a measure with an additional axis, the maximum
    along this axis."""
    values = store.read(name, region).astype(float)
    values[~np.isin(store.read("status", region), WITH_RESULTS)] = np.nan  # a missing whole number is -1
    return np.max(values, axis=-1) if values.ndim > len(store.shape) else values


def _has_labels(store: Store) -> bool:
    return "regime" in store.names or "mode" in store.names


def is_label(store: Store, name: str) -> bool:
    """Return True for a measure whose values are names (regimes) or numbers of jam modes."""
    return name == "mode" or "flag_meanings" in store.group[name].attrs


def case_labels(store: Store, region: slice | tuple[slice, ...]) -> _Labels:
    """Return the labels of the cases of a region: the name of the regime, and the jam mode of jammed loads."""
    words: list[str] = str(store.group["regime"].attrs["flag_meanings"]).split() if "regime" in store.names else ["not jammed"]
    first = len(words)
    done = np.isin(store.read("status", region), WITH_RESULTS)
    modes = store.read("mode", region) if "mode" in store.names else np.zeros(done.shape, int)
    codes = store.read("regime", region).astype(int) if "regime" in store.names else np.zeros(done.shape, int)
    codes = np.where(modes > 0, first + modes - 1, codes)
    names = [*words, *(f"jammed, mode {k}" for k in range(1, 2 * store.coordinates + 2))]
    return _Labels(np.where(done, codes, -1), names)


def label_counts(store: Store) -> list[tuple[str, int]]:
    """Return the labels of the finished cases with their numbers of cases, the most frequent first. The list is empty
    if the study has no labels."""
    if not _has_labels(store):
        return []
    total: Counter[str] = Counter()
    for rows in store.pieces():
        codes, names = case_labels(store, rows)
        numbers = np.bincount(codes[codes >= 0].ravel(), minlength=len(names))
        total.update({name: int(n) for name, n in zip(names, numbers, strict=True) if n})
    return total.most_common()


def _theory_lines(
    store: Store, x_name: str, y_name: str, xs: np.ndarray, ys: np.ndarray
) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """Return the lines in a map on which exact jams of the scene have a fold or lose their stability, by kind.

    Axes that are not in the map have their middle values, as in the cases of the map. Lines exist only if one axis is the rotor
    speed. If the other axis is a parameter of the initial state, which does not influence steady motions, the lines are
    straight. If it is a parameter of the scene, the lines connect points that are computed for `_THEORY_ROWS` values, evenly
    spaced on its scale.
    """
    if _SPEED not in (x_name, y_name):
        return {}
    scene = scene_from_toml(store.record["scene"])
    if not isinstance(scene.drive, ConstantSpeed):
        return {}
    for axis in store.record["axes"]:
        if axis not in (x_name, y_name) and not axis.startswith("start."):
            middle = store.read(axis)[store.group[axis].shape[0] // 2]
            scene = put_values(scene, (axis_of(scene, axis, [float(middle)]).target,), jnp.asarray([middle]))
    other_axis, values, speeds = (y_name, ys, xs) if x_name == _SPEED else (x_name, xs, ys)
    fixed = other_axis.startswith("start.")
    # Between unevenly spaced values the lines must not cross a gap without a computed point.
    spaced = np.geomspace if _is_log(store, other_axis) else np.linspace
    rows = values[[0, -1]] if fixed else spaced(values[0], values[-1], _THEORY_ROWS)
    target = axis_of(scene, other_axis, [float(rows[0])]).target
    scene = put_values(scene, (axis_of(scene, _SPEED, [float(speeds[-1])]).target,), jnp.asarray([float(np.max(speeds))]))
    kinds_of_rows: list[dict[str, list[float]]] = []
    for value in rows[:1] if fixed else rows:
        try:
            special = exact_branches(put_values(scene, (target,), jnp.asarray([float(value)]))).special
        except InputError:  # the exact method does not support this scene
            return {}
        kinds: dict[str, list[float]] = {}
        for point in special:
            kinds.setdefault(KINDS[point.kind], []).append(point.rotor_speed)
        kinds_of_rows.append(kinds)
    kinds_of_rows = kinds_of_rows * 2 if fixed else kinds_of_rows
    lines: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for kind in sorted({kind for kinds in kinds_of_rows for kind in kinds}):
        counts = {len(kinds.get(kind, [])) for kinds in kinds_of_rows}
        if len(counts) == 1:  # points are connected only if every row has the same number of points
            parts = [(np.asarray([kinds[kind][k] for kinds in kinds_of_rows]), rows) for k in range(counts.pop())]
        else:
            parts = [
                (np.asarray([n]), np.asarray([row]))
                for kinds, row in zip(kinds_of_rows, rows, strict=True)
                for n in kinds.get(kind, [])
            ]
        lines[kind] = parts if x_name == _SPEED else [(b, a) for a, b in parts]
    return lines
