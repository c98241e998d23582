"""Command `regimes` of jaxvib."""

from __future__ import annotations

import bisect
import textwrap
from pathlib import Path

import jaxvib as jv
from jaxvib.cli.app import (
    TOLERANCE,
    WITHOUT,
    Output,
    command,
    loaded_scene,
    ranges_within,
    require_tolerances,
    table,
    tolerance_table,
)
from jaxvib.cli.document import deck_options, indented, measures_of
from jaxvib.cli.output import csv_options, fields_of
from jaxvib.errors import InputError


@command("regimes")
@WITHOUT
@deck_options
@TOLERANCE
@csv_options
def regimes(scene: Path, without: tuple[str, ...], tolerances: tuple[str, ...], csv: Path | None, output: Output) -> None:
    """List the synchronous regimes of SCENE: motions in which all exciters turn at one speed; --out adds a figure of
    phases."""
    from jaxvib.results.status import status_name  # slow import, which --help does not need

    loaded = loaded_scene(scene, without)
    require_tolerances(loaded, tolerances)
    result = jv.synchronous_regimes(loaded)
    selected = [result.select(k) for k in range(result.speed.shape[0])]
    measures = [measures_of(loaded, regime.vibration()) if regime.stable else None for regime in selected]
    if tolerances and not any(regime.stable for regime in selected):
        raise InputError("--tolerance", "is for stable regimes; this scene has none; leave it out")
    ranges = ranges_within(loaded, None, tolerances)
    output.figure("regimes.png", result.plot)
    output.csv(csv, result, "regime")
    frequencies = sorted(map(float, jv.natural_frequencies(loaded)))
    groups = None if any(regime.stable for regime in selected) else _Groups(loaded)
    document = {
        "natural_frequencies": frequencies,
        "judged": "by the growth of small disturbances of the averaged motion",
        "search": status_name(result.search),
        "regimes": [_regime_document(*pair) for pair in zip(selected, measures, strict=True)],
        **({} if groups is None else {"groups": groups.document()}),
        **({"tolerances": [each._asdict() for each in ranges]} if tolerances else {}),
    }

    def text() -> str:
        from jaxvib.display import shown_unit, speed_text, speed_unit  # slow import, which --help does not need

        unit, scale = speed_unit()
        resonances = f"resonances: {speed_text(frequencies)}"
        if not selected:
            return "\n".join([result.summary(), *(groups.lines() if groups else []), resonances])
        force_unit, factor = shown_unit("N", max(float(regime.foundation_force) for regime in selected))
        rows = [[*_row(regime, scale), f"{factor * float(regime.foundation_force):.4g}"] for regime in selected]
        head = [unit, "", " ", "phases, degrees", "margin", "power, W", f"foundation force, {force_unit}"]
        drawing = table("synchronous regimes; phases in the direction of rotation, force zero to peak", head, rows)
        stable = [(regime, figures) for regime, figures in zip(selected, measures, strict=True) if figures is not None]
        directions = ("anticlockwise" if exciter.direction == 1 else "clockwise" for exciter in loaded.exciters)
        notes = [
            resonances,
            f"rotation: {', '.join(f'exciter {k} {direction}' for k, direction in enumerate(directions, 1))}",
            "margin: factor by which the differences of the motors' torques can grow; inf for",
            "equal motors",
            *(groups.lines() if groups else []),
            *([] if status_name(result.search) == "done" else [jv.RegimeSearchStatus[result.search]]),
            *(textwrap.fill(note, 80) for note in result.notes()),
        ]
        blocks = (
            indented(f"at {speed_text(regime.speed)}, stable, {_place_among(float(regime.speed), frequencies)}:", figures)
            for regime, figures in stable
        )
        within = [tolerance_table(ranges, tolerances)] if tolerances else []
        return "\n".join([drawing, *notes, *blocks, *within])

    output.done(document, text, "regimes", result)


def _regime_document(regime: jv.SynchronousRegime, measures: jv.VibrationMeasures | None) -> dict[str, object]:
    return {
        "status": regime.message,
        **fields_of(regime, "speed", "phases", "stable", "growth", "quasi_static", "margin"),
        **fields_of(regime, "torque", "vibrational_torque", "power", "can_start", "amplitude", "foundation_force"),
        **({} if measures is None else {"measures": measures.document()}),
    }


_MAX_MASSES = 4
"""Largest number of rotating masses for which the command computes motions in groups: 15 groups."""


class _Groups:
    """Stable motions of rotating masses in groups of different speeds, for a scene without a stable regime of all masses.

    A motor that is switched off and belongs to no group is assumed to come to rest."""

    def __init__(self, scene: jv.Scene):
        self.scene = scene
        carries = [1 if exciter.loads is None else exciter.loads.count for exciter in scene.exciters]
        self.count = sum(carries)
        self.motions = jv.regime_partitions(scene) if 1 < sum(carries) <= _MAX_MASSES else None
        off = [isinstance(exciter.drive, jv.SwitchedOff) for exciter in scene.exciters]
        running = [k for k, is_off in enumerate(off) if not is_off]
        self.off, self.running = [k + 1 for k, is_off in enumerate(off) if is_off], []
        if self.off and running and sum(carries) == len(carries) and not (self.motions and len(self.motions.speed)):
            found = jv.synchronous_regimes(scene, masses=running)
            self.running = [each for each in map(found.select, range(len(found.speed))) if each.stable]

    def document(self) -> dict[str, object]:
        """Return the motions for a document."""
        names = ("group", "speed", "phases", "stable", "growth", "interaction")
        in_groups = {} if self.motions is None else fields_of(self.motions, *names)
        running = [fields_of(each, "masses", "speed", "phases", "growth") for each in self.running]
        return {**in_groups, "without_switched_off": running}

    def lines(self) -> list[str]:
        """Return the motions as lines of text; an empty list if none is known."""
        from jaxvib.display import speed_text  # slow import, which --help does not need

        if self.motions is not None and len(self.motions.speed):
            lines = [f"  {line}" for line in self.motions.summary().splitlines()]
            about = "motions in groups of different speeds (numbers: rotating masses; interaction:"
            return [about, "estimated relative error, because groups act on each other):", *lines]
        if self.count > _MAX_MASSES:
            return [f"motions in groups of different speeds: regime_partitions in Python (slow for {self.count} masses)"]
        off = f"if exciter {', '.join(map(str, self.off))} (switched off) comes to rest"
        numbers = [", ".join(str(int(k) + 1) for k in each.masses) for each in self.running]
        speeds = [speed_text(each.speed, 6) for each in self.running]
        return [f"exciter {k} alone: {w}, stable, {off}" for k, w in zip(numbers, speeds, strict=True)]


def _place_among(speed: float, frequencies: list[float]) -> str:
    """Return the place of a speed among the ascending resonances, in words."""
    below = bisect.bisect(frequencies, speed)
    if below in (0, len(frequencies)):
        return f"{'below' if below == 0 else 'above'} all resonances"
    return f"between the resonances {below} and {below + 1}"


def _row(regime: jv.SynchronousRegime, scale: float) -> list[str]:
    """Return a regime as a row of the table without its force; `scale` converts rad/s to the display unit."""
    from jaxvib.results.status import status_name  # slow imports, which --help does not need
    from jaxvib.steady.jams.phases import degrees

    name = status_name(regime.status)
    return [
        f"{scale * float(regime.speed):.6g}",
        "stable" if regime.stable else "unknown" if name == "undecided" else "unstable",
        {"degenerate": "family", "no_vibration": "no vibration"}.get(name, ""),
        " ".join(f"{degrees(float(a)):.4g}" for a in regime.phases),
        f"{float(regime.margin):.4g}",
        " ".join(f"{float(p):.4g}" for p in regime.power),
    ]
