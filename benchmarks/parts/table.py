"""Results of engine.py as a Markdown table and as figures, also from its JSON file.

    PYTHONPATH=benchmarks python -m parts.table out/engine.json

The command writes engine.md, engine.png and memory.png to the folder of the JSON file.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxvib.draw.style import COLORS, panels

OWN = ("jaxvib", "envelope", "the run itself", "forward", "reverse")
"""Beginnings of the names of jaxvib's own methods, if a group compares it with others."""


def _groups(document: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in document["rows"]:
        groups.setdefault(row["group"], []).append(row)
    return groups


def _time(seconds: float) -> str:
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("us", 1e6)):
        if seconds * factor >= 1.0:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def markdown(document: dict[str, Any]) -> str:
    """A line for each group: jaxvib's time, and all others as multiples of it."""
    lines = [f"Measured with: {document['line']}.", ""]
    if document["quick"]:
        lines[:0] = ["Quick settings: these figures say nothing.", ""]
    lines += ["| what | jaxvib | the others, in multiples of that |", "|---|---|---|"]
    for group, rows in _groups(document).items():
        own = next((row for row in rows if row["name"].startswith(OWN)), rows[0])
        others = [_against(row, own) for row in rows if row is not own]
        lines.append(f"| {group}{_within(own)} | {own['name']}: {_said(own)} | {'; '.join(others)} |")
    return "\n".join(lines) + "\n"


def whole(document: dict[str, Any]) -> str:
    """A line for each measurement."""
    lines = ["| what | way | time | times | error | compile |", "|---|---|---|---|---|---|"]
    for group, rows in _groups(document).items():
        for row in rows:
            ratio = "" if row["ratio"] is None else _times(row["ratio"])
            error = "" if row["error"] is None else f"{row['error']:.0e}"
            compiling = "" if row["compile"] is None else f"{row['compile']:.1f} s"
            name = row["name"] + (f" ({row['note']})" if row["note"] else "")
            lines.append(f"| {group} | {name} | {_time(row['seconds'])} | {ratio} | {error} | {compiling} |")
    return "\n".join(lines) + "\n"


def bars(document: dict[str, Any], wide: int = 40) -> str:
    """The comparisons with other ways as text: time as a multiple of jaxvib's own on a logarithmic scale, a decade 10 signs."""
    lines = []
    for group, rows in _groups(document).items():
        own = next((row for row in rows if row["name"].startswith(OWN)), None)
        if own is None or own["ratio"] is None or all(row["name"].startswith(OWN) for row in rows):
            continue
        lines += ["", f"{group}{_within(own)}"]
        for row in rows:
            times = row["seconds"] / own["seconds"]
            length = min(max(round(10.0 * np.log10(10.0 * times)), 1), wide)
            lines.append(f"  {row['name']:48s} {'#' * length} {_times(times)}")
    return "\n".join(["```text", *lines[1:], "```"]) + "\n"


def _said(row: dict[str, Any]) -> str:
    return _time(row["seconds"]) + (f", {row['note']}" if "bytes" in row or "per_second" in row else "")


def _times(ratio: float) -> str:
    return f"{ratio:.2g}" if ratio < 10.0 else f"{ratio:,.0f}"


def _within(row: dict[str, Any]) -> str:
    return "" if row["error"] is None else f", error {row['error']:.0e}"


def _against(row: dict[str, Any], own: dict[str, Any]) -> str:
    if "bytes" in row:
        return f"{row['name']}: {_said(row)}"
    far = row["error"] is not None and own["error"] is not None and row["error"] > 10.0 * own["error"]
    return f"{row['name']} {_times(row['seconds'] / own['seconds'])}" + (f" (error {row['error']:.0e})" if far else "")


def figures(document: dict[str, Any]) -> dict[str, Figure]:
    """The figures by file name, as far as there are rows for them."""
    groups = _groups(document)
    compared = {group: rows for group, rows in groups.items() if all(row["ratio"] is not None for row in rows)}
    found = {}
    if compared:
        found["engine.png"] = ratios(compared, document["line"])
    kept = [row for rows in groups.values() for row in rows if row.get("bytes")]
    if kept:
        found["memory.png"] = memory(kept)
    return found


def ratios(groups: dict[str, list[dict[str, Any]]], line: str) -> Figure:
    """A bar for each way, as a multiple of its group's base, log scale; jaxvib's own in colour."""
    heights = [len(rows) + 1.6 for rows in groups.values()]
    figure, _ = panels(1, size=(9.0, 0.24 * sum(heights) + 0.6))
    figure.clear()
    cells = figure.subplots(len(groups), 1, squeeze=False, sharex=True, gridspec_kw={"height_ratios": heights})[:, 0]
    low = min(row["ratio"] for rows in groups.values() for row in rows)
    high = max(row["ratio"] for rows in groups.values() for row in rows)
    for axes, (group, rows) in zip(cells, groups.items(), strict=True):
        others = any(not row["name"].startswith(OWN) for row in rows) and any(row["name"].startswith(OWN) for row in rows)
        place = np.arange(len(rows))[::-1]
        values = np.array([row["ratio"] for row in rows])
        colors = [COLORS[0] if not others or row["name"].startswith(OWN) else "#b0b0b0" for row in rows]
        axes.barh(place, values - 0.5 * low, left=0.5 * low, color=colors, height=0.7)
        for y, value in zip(place, values, strict=True):
            axes.text(1.08 * value, y, _times(value), va="center", fontsize=8)
        axes.set_yticks(place, [row["name"] for row in rows], fontsize=8)
        axes.set_title(group, fontsize=9, loc="left", fontweight="bold")
        axes.set_xscale("log")
        axes.set_xlim(0.5 * low, 4.0 * high)
        axes.axvline(1.0, color="black", lw=0.8)
        axes.grid(visible=False, axis="y")
        axes.spines[["top", "right"]].set_visible(False)
    cells[-1].set_xlabel("time, as a multiple of the first of its group, log scale")
    figure.suptitle(line.split(";")[0], fontsize=9)
    return figure


def memory(rows: list[dict[str, Any]]) -> Figure:
    """Memory of a reverse gradient over the turns of the rotor, and what would keep every step."""
    figure, (axes,) = panels(1, size=(6.5, 3.6))
    turns, size = (np.array([row[name] for row in rows], float) for name in ("turns", "bytes"))
    axes.loglog(turns, size / 2**20, "o-", color=COLORS[0], label="reverse mode of simulate")
    axes.loglog(turns, size[0] * turns / turns[0] / 2**20, ":", color="black", label="in proportion to the turns")
    axes.loglog(turns, size[0] * np.sqrt(turns / turns[0]) / 2**20, "--", color="#777777", label="to their square root")
    axes.set_xlabel("turns of the rotor")
    axes.set_ylabel("temporary memory, MiB")
    axes.legend(frameon=False)
    return figure


def main() -> None:
    path = Path(sys.argv[1])
    document = json.loads(path.read_text(encoding="utf-8"))
    path.with_suffix(".md").write_text(f"{markdown(document)}\n{bars(document)}\n{whole(document)}", encoding="utf-8")
    for file, figure in figures(document).items():
        figure.savefig(path.with_name(file))


if __name__ == "__main__":
    main()
