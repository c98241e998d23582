"""Tables of the stored results of a sweep."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxvib.sweeps.axes import SAMPLE
from jaxvib.sweeps.definition import WITH_RESULTS
from jaxvib.sweeps.figures import axis_label, case_labels, display_unit, is_label, measure_label
from jaxvib.sweeps.store import Store

_MAX_CASES = 40
"""Largest number of cases for which the table has a row for each case."""

_MAX_ENTRIES = 4
"""Largest number of entries of a measure that are shown one by one; if there are more, their range is shown."""

_MAX_READ = 1_000_000
"""Largest number of cases of a store that is read as a whole."""


def results_table(store: str | Path) -> tuple[str, list[str], list[list[str]]]:
    """Return the results of a study as title, headers and rows of a table, in display units.

    A study with at most 40 cases has a row for each finished case, in which absent quantities are empty. For more cases the
    table has a row for each numerical measure, with its smallest value, its median and its largest value. For more than a
    million cases the table is empty.
    """
    opened = Store(Path(store))
    if np.prod(opened.shape, dtype=np.int64) > _MAX_READ:
        return "", [], []
    done = np.isin(opened.read("status"), WITH_RESULTS)
    named = [name for name in opened.names if not (name == "mode" and "regime" in opened.names)]
    if done.size <= _MAX_CASES:
        axes = list(opened.record["axes"])
        heads = [*(axis_label(opened, axis) for axis in axes), *(measure_label(opened, name) for name in named)]
        columns = [*(_axis_column(opened, axis) for axis in axes), *(_case_texts(opened, name) for name in named)]
        rows = [list(row) for row, finished in zip(zip(*columns, strict=True), done.ravel(), strict=True) if finished]
        return "results of the cases", heads, rows
    rows = [[measure_label(opened, name), *_summary(opened, name, done)] for name in named if not is_label(opened, name)]
    return f"results of {np.sum(done)} cases", ["measure", "least", "median", "largest"], rows


def _axis_column(store: Store, axis: str) -> list[str]:
    """Return the value of an axis, or of a sampled parameter, in each case."""
    dim = axis if axis in store.dims else SAMPLE
    along = [-1 if name == dim else 1 for name in store.dims]
    values = np.broadcast_to(store.read(axis).reshape(along), store.shape)
    return [f"{display_unit(store, axis)[1] * x:.5g}" for x in values.ravel()]


def _case_texts(store: Store, name: str) -> list[str]:
    """Return the text of a measure for each case."""
    if is_label(store, name):
        codes, names = case_labels(store, slice(None))
        return [names[k].replace("_", " ") if k >= 0 else "" for k in codes.ravel()]
    values = display_unit(store, name)[1] * store.read(name).astype(float)
    entries = values.reshape(int(np.prod(store.shape)), -1)
    if entries.shape[1] > _MAX_ENTRIES:
        texts = [f"{np.min(row):.4g} to {np.max(row):.4g}" for row in entries]
    else:
        texts = [" ".join(f"{x:.4g}" for x in row) for row in entries]
    return ["" if np.all(np.isnan(row)) else text for text, row in zip(texts, entries, strict=True)]


def _summary(store: Store, name: str, done: np.ndarray) -> list[str]:
    """Return least value, median and largest value of a measure over the finished cases as text."""
    values = display_unit(store, name)[1] * store.read(name).astype(float)[done]
    values = values[np.isfinite(values)]
    return [f"{x:.4g}" for x in np.quantile(values, [0.0, 0.5, 1.0])] if values.size else ["", "no value", ""]
