"""Command `modes` of jaxvib."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import click

import jaxvib as jv
from jaxvib.cli.app import (
    SPEED,
    TOLERANCE,
    WITHOUT,
    Output,
    command,
    loaded_scene,
    ranges_within,
    remedy_hint,
    require_tolerances,
    table,
    tolerance_table,
)
from jaxvib.cli.document import force_lines, indented, measures_of, note_loads
from jaxvib.cli.output import csv_options, fields_of
from jaxvib.errors import InputError

_MAX_FOLD_SPEEDS = 10.0
"""Largest rotor speed of a fold in the table, relative to the rotor speed of the scene."""


@command("modes")
@SPEED
@click.option("--exact", is_flag=True, help="Compute exact periodic motions of the full equations instead of light-load jams.")
@click.option(
    "--phases", is_flag=True, help="Compute light-load jams with unequal phases (default for a rotor without --exact)."
)
@WITHOUT
@TOLERANCE
@csv_options
def modes(
    scene: Path,
    speed: str | None,
    exact: bool,
    phases: bool,
    without: tuple[str, ...],
    tolerances: tuple[str, ...],
    csv: Path | None,
    output: Output,
) -> None:
    """List all jam modes of SCENE at its rotor speed, for light loads or exactly; --out adds the branch diagram.

    For a rotor, or with --phases, the list contains the jams of light loads with any phases, and --out plots them over the drag
    of the loads. --exact is available for platforms and for rotors without tilt, if all loads have the same station and the
    rotor is balanced."""
    loaded = loaded_scene(scene, without, speed)
    if exact and phases:
        raise InputError(
            "--phases", "cannot be combined with --exact; jams with unequal phases are computed for light loads only"
        )
    _require_light_jams(loaded, tolerances, exact, phases)
    require_tolerances(loaded, tolerances)
    if exact:
        _print_exact_jams(loaded, csv, output)
        return
    if phases or loaded.mounting.axes != (1,):
        if csv is not None:
            raise InputError(
                "--csv", "writes branches over the load speed, which jams with unequal phases do not have; use --json"
            )
        _print_phase_jams(loaded, output)
        return
    _print_light_jams(loaded, csv, tolerances, output)


def _require_light_jams(scene: jv.Scene, tolerances: tuple[str, ...], exact: bool, phases: bool) -> None:
    """**Raises** `InputError` for tolerances of jams other than those of light, coincident loads on platforms."""
    if not tolerances:
        return
    if scene.mounting.axes != (1,):
        problem = "is for jams on platforms; modes has no tolerances of this machine, which moves in two directions"
        remedy = "leave it out, and compute runs for several values with jaxvib sweep (jaxvib new sweep > study.toml)"
        raise InputError("--tolerance", f"{problem}; {remedy}")
    if exact or phases:
        option = "--exact" if exact else "--phases"
        raise InputError("--tolerance", f"is for light, coincident loads; leave out {option}, or leave out --tolerance")


def _print_light_jams(scene: jv.Scene, csv: Path | None, tolerances: tuple[str, ...], output: Output) -> None:
    """Print the jams of light, coincident loads, and their folds."""
    import jax  # slow imports, which --help does not need
    import numpy as np

    from jaxvib.machine.effects.base import has_term
    from jaxvib.machine.effects.terms import ContactFriction
    from jaxvib.steady.jams.jam import STABILITY_CRITERION, STABILITY_OF_FREE_LOADS, growth_of_modes

    modes_found = jax.device_get(jv.jam_modes(scene))  # NumPy arrays, because indexing JAX arrays would compile programs
    output.figure("branches.png", lambda: jv.branches(scene).plot())
    if csv is not None:
        output.csv(csv, jv.branches(scene), "point")
    jams = [modes_found.select(k) for k in modes_found.mode_numbers()]
    growth = growth_of_modes(modes_found, scene)
    remaining = [jam for jam in jams if bool(jam.stable) and not growth[int(jam.mode)] > 0.0]
    measures = {int(jam.mode): measures_of(scene, jam) for jam in remaining}
    folds = [k for k, exists in enumerate(np.asarray(modes_found.folds.exists)) if exists]
    has_friction = has_term(scene.all_effects, ContactFriction)
    limits = None if has_friction else jax.device_get(jv.drag_limits(scene))
    note_loads(scene, [float(jam.omega) for jam in remaining], output.scene)
    ranges = ranges_within(scene, [int(jam.mode) for jam in remaining], tolerances)
    balance = _balance_document(scene)
    document = {
        "rotor_speed": scene.drive.speed,
        "resonances": modes_found.resonances,
        "judged": STABILITY_OF_FREE_LOADS if any(map(math.isfinite, growth.values())) else STABILITY_CRITERION,
        "modes": [_mode_document(jam, growth[int(jam.mode)]) for jam in jams],
        **balance,
        "unresolved": modes_found.unresolved,
        "measures": [{"mode": mode, **entry.document()} for mode, entry in measures.items()],
        "folds": [{"omega": modes_found.folds.omega[k], "rotor_speed": modes_found.folds.rotor_speed[k]} for k in folds],
        "drag_limits": _drag_document(limits),
        **({"tolerances": [entry._asdict() for entry in ranges]} if tolerances else {}),
    }

    def text() -> str:
        from jaxvib.display import speed_text  # slow imports, which --help does not need
        from jaxvib.steady.jams.jam import modes_table, side_by_side_lines

        head, *rows = modes_table(modes_found, growth)
        lines = [
            f"rotor {speed_text(scene.drive.speed)}; resonances {speed_text(modes_found.resonances)}",
            table("jam modes (light loads)", head, rows) if rows else "no jam mode was found at this speed",
        ]
        if rows:
            lines += ["amplitudes and foundation force are zero to peak", *side_by_side_lines(scene)]
        if any(row[2].startswith("no") for row in rows):
            lines.append("not stable: after a small disturbance the loads (balls, rollers, pendulums) leave this jam")
        lines += [text] if (text := modes_found.missing_text()) else []
        if tolerances:
            lines.append(tolerance_table(ranges, tolerances))
        lines += _reached_lines(scene, output, [f"mode {k}{_condition(growth[k])}" for k in measures], balance)
        lines += [indented(f"mode {mode}:", entry) for mode, entry in measures.items()]
        lines += _fold_lines(float(scene.drive.speed), modes_found.folds, folds)
        return "\n".join([*lines, *_drag_lines(scene, limits), *_imbalance_lines(scene)])

    output.done(document, text, "modes", modes_found)


def _condition(growth: float) -> str:
    """Return the condition under which a jam that is stable by slope is stable, from the growth of free loads, 1/s."""
    return " (if its loads stay together)" if math.isnan(growth) else ""


def _fold_lines(rotor_speed: float, folds: Any, existing: list[int]) -> list[str]:
    """Return a table of the existing folds, and a line with the number of those far above the rotor speed, rad/s."""
    from jaxvib.display import speed_unit  # slow import, which --help does not need

    unit, scale = speed_unit()
    near = [k for k in existing if folds.rotor_speed[k] <= _MAX_FOLD_SPEEDS * rotor_speed]
    pairs = [[f"{scale * end[k]:.5g}" for end in (folds.omega, folds.rotor_speed)] for k in near]
    lines = [table("folds: two jams merge", [f"loads, {unit}", f"rotor, {unit}"], pairs)] if near else []
    far = len(existing) - len(near)
    return lines + ([f"folds above {_MAX_FOLD_SPEEDS:g} times the rotor speed, not shown: {far}"] if far else [])


def _balance_document(scene: jv.Scene) -> dict[str, bool | str | None]:
    """Return, for a document, whether the loads can balance the rotor in a stable motion, or why this cannot be computed."""
    try:
        states = jv.balanced_states(scene)
        return {"balanced_motion_stable": any(states.stability(k).stable for k in range(len(states.angles)))}
    except InputError as error:
        reason = f"{error}{remedy_hint(click.get_current_context().obj, error)}"
        return {"balanced_motion_stable": None, "balanced_motion_not_judged": reason}


def _reached_lines(scene: jv.Scene, output: Output, jams: list[str], balance: Mapping[str, bool | str | None]) -> list[str]:
    """Return lines about the stable motions at the speed of the scene, if there are several, or only balanced loads, and about
    balanced loads that are not judged.

    **Arguments**: `jams`: names of the stable jams; `balance`: see `_balance_document`.
    """
    balanced = balance["balanced_motion_stable"]
    motions = jams + (["balanced loads"] if balanced else [])
    if not jams and balanced:
        return [f"balanced loads are stable: the loads spread and balance the rotor (jaxvib balance {output.scene})"]
    not_judged = balance.get("balanced_motion_not_judged")
    lines = [] if not_judged is None else ["balanced loads are not judged, and may be stable as well:", f"  {not_judged}"]
    if len(motions) < 2:
        return lines
    start = "spin_up" if scene.drive.constant else "rest"
    return [
        *lines,
        f"several motions are stable: {', '.join(motions)}",
        "which one the machine reaches depends on its start:",
        f"  jaxvib simulate {output.scene} --until 100s --start {start}",
    ]


def _drag_document(limits: jv.DragLimits | None) -> list[dict[str, Any]]:
    """Return the greatest drag of each resonance that has one; an empty list for loads with dry friction (None)."""
    import numpy as np  # slow import, which --help does not need

    if limits is None:
        return []
    names = ("resonances", "drag", "factor", "omega")
    return [{name: getattr(limits, name)[k] for name in names} for k in np.flatnonzero(np.isfinite(limits.factor))]


def _drag_lines(scene: jv.Scene, limits: jv.DragLimits | None, *, points: bool | None = None) -> list[str]:
    """Return a table of the greatest drags; an empty list if there is none.

    `points`: True if balls count as points in the table, False if only in the table of jams, None if in neither.
    """
    from jaxvib.display import speed_unit  # slow imports, which --help does not need
    from jaxvib.machine.loads import CircularLoads

    unit, scale = speed_unit()
    rows = [
        [f"{scale * row['resonances']:.5g}", f"{row['drag']:.5g}", f"{row['factor']:.4g}", f"{scale * row['omega']:.5g}"]
        for row in _drag_document(limits)
    ]
    equal = isinstance(scene.loads, CircularLoads) and scene.loads.drag.ndim == 0
    of_load = "drag, N s/m" if equal else "drag of load 1, N s/m"
    head = [f"resonance, {unit}", of_load, "times the scene's", f"loads, {unit}"]
    lines = [table("greatest drag: with a larger one no jam exists at the resonance", head, rows)] if rows else []
    if lines and points is not None and getattr(scene.loads, "ball_radius", None) is not None:
        smaller = "touching balls jam only up to a smaller drag"
        lines.append(
            f"loads count as points: {smaller}"
            if points
            else "greatest drag of touching balls; in the jams they count as points"
        )
    return lines


def _mode_document(jam: jv.Jam, growth: float) -> dict[str, Any]:
    beginning, end = fields_of(jam, "mode", "omega"), fields_of(jam, "amplitude", "foundation_force")
    stable = bool(jam.stable) and not growth > 0.0  # as in the table
    return {**beginning, "stable": stable, "growth_of_free_loads": growth, "status": jam.message, **end}


def _imbalance_lines(scene: jv.Scene) -> list[str]:
    """Return lines about the imbalances that a table of jams of light loads ignores; an empty list for a balanced rotor."""
    from jaxvib.machine.effects.base import has_term
    from jaxvib.machine.effects.terms import RotorImbalance

    named = [effect.kind.replace("_", " ") for effect in scene.all_effects if has_term([effect], RotorImbalance)]
    adds = f"the {' and '.join(named)} {'adds' if len(named) == 1 else 'add'} a vibration at the rotor speed"
    return ["amplitudes and forces are those of the loads only:", f"  {adds}"] if named else []


def _print_phase_jams(scene: jv.Scene, output: Output) -> None:
    """Print the jams of light loads at any phases."""
    import jax  # slow imports, which --help does not need

    from jaxvib.machine.loads import CircularLoads
    from jaxvib.results.status import sentence

    is_gathered = cast(CircularLoads, scene.loads).alike and scene.mount().at_one_point
    result, limits = jv.phase_jams(scene), jax.device_get(jv.drag_limits(scene, phases=not is_gathered))
    output.figure("phases.png", lambda: result.plot())
    jams = [result.select(k) for k in range(result.omega.shape[0])]
    measures = [measures_of(scene, jam) if jam.stable else None for jam in jams]
    note_loads(scene, [float(jam.omega) for jam in jams if jam.stable], output.scene)
    balance = _balance_document(scene)
    document = {
        "rotor_speed": scene.drive.speed,
        "judged": "by the growth rate of small disturbances, for light loads that move independently",
        **balance,
        "phase_jams": [
            {
                **fields_of(jam, "omega", "stable", "growth"),
                "pattern": jam.pattern_label,
                **fields_of(jam, "phase", "amplitude", "foundation_force"),
                **({} if measures_of_jam is None else {"measures": measures_of_jam.document()}),
            }
            for jam, measures_of_jam in zip(jams, measures, strict=True)
        ],
        "drag_limits": _drag_document(limits),
    }

    def text() -> str:
        from jaxvib.display import speed_text, speed_unit  # slow imports, which --help does not need
        from jaxvib.steady.jams.patterns import images_text

        unit, scale = speed_unit()
        distinct = result.distinct  # mirror images are one row
        shown = [(jams[each[0]], measures[each[0]]) for each in distinct]
        rows = [_phase_row(jam, scale, images_text(each)) for each, (jam, _) in zip(distinct, shown, strict=True)]
        rotor = speed_text(scene.drive.speed)
        head = [unit, "", "pattern of the loads", "phases, degrees", "foundation force, N"]
        title = f"light-load jams with unequal phases; rotor {rotor}"
        stable_jams = [f"{speed_text(jam.omega)} ({sentence(jam.pattern)})" for jam, _ in shown if jam.stable]
        reached = _reached_lines(scene, output, [f"the jam at {each}" for each in stable_jams], balance)
        if not rows:
            return "\n".join([f"no jam at {rotor}", *reached, *_drag_lines(scene, limits, points=not is_gathered)])
        conclusion = (
            f"loads can stay jammed at {', '.join(stable_jams)}"
            if stable_jams
            else f"no stable jam ({len(rows)} unstable): light loads cannot stay jammed"
        )
        measure_texts = [
            indented(f"at {speed_text(jam.omega)}:", measures_of_jam)
            for jam, measures_of_jam in shown
            if measures_of_jam is not None
        ]
        drags = _drag_lines(scene, limits, points=not is_gathered)
        rows_of_force = [table(title, head, rows), *force_lines(scene)]
        return "\n".join([conclusion, *reached, *rows_of_force, *measure_texts, *drags, *_imbalance_lines(scene)])

    output.done(document, text, "modes", result)


def _phase_row(jam: jv.PhaseJam, scale: float, images: str) -> list[str]:
    """Return a jam as a row of the table; `scale` converts rad/s to the display unit; `images`: number of mirror images as
    text."""
    from jaxvib.results.status import sentence  # slow imports, which --help does not need
    from jaxvib.steady.jams.phases import degrees

    return [
        f"{scale * float(jam.omega):.5g}",
        "stable" if jam.stable else "unstable",
        f"{sentence(jam.pattern)}{images}",
        " ".join(f"{degrees(float(a)):.4g}" for a in jam.phase),
        f"{float(jam.foundation_force):.4g}",
    ]


def _exact_table(scene: jv.Scene, jams: Mapping[int, jv.Orbit]) -> list[list[str]]:
    """Return the headers and the rows of the table of exact jams, given by their mode numbers."""
    from jaxvib.display import shown_unit, speed_unit  # slow import, which --help does not need

    unit, scale = speed_unit()
    structure = scene.machine.structure()
    shown = [shown_unit(each, 0.1) for each in structure.units]
    moves = [f"{name}, {each}" for name, (each, _) in zip(structure.coordinates, shown, strict=True)]
    rows = [
        [
            f"{k}",
            f"{scale * float(jam.omega):.6g}",
            jam.judgement,
            f"{float(jam.multiplier):.5g}",
            *(f"{factor * float(a):.5g}" for a, (_, factor) in zip(jam.amplitude, shown, strict=True)),
            f"{float(jam.foundation_force):.5g}",
        ]
        for k, jam in jams.items()
    ]
    return [["mode", unit, "exactly", "multiplier", *moves, "foundation force, N"], *rows]


def _print_exact_jams(scene: jv.Scene, csv: Path | None, output: Output) -> None:
    """Print all exact jams, including those that do not exist for light loads, and the special points."""
    from jaxvib.steady.orbits.search import exact_mode_speeds  # slow import: it needs the time integrator

    light = jv.jam_modes(scene)
    numbers = sorted({*light.mode_numbers(), *exact_mode_speeds(scene)})
    jams = {k: jv.jam_orbit(scene, mode=k, throw=False) for k in numbers}
    existing = {k: jam for k, jam in jams.items() if math.isfinite(jam.rotor_speed)}
    measures = {k: measures_of(scene, jam) for k, jam in existing.items() if jam.stable}
    note_loads(scene, [float(existing[k].omega) for k in measures], output.scene, averaged=False)
    balance = _balance_document(scene)
    diagram = jv.branches(scene, exact=True)
    output.figure("branches.png", lambda: diagram.plot())
    output.csv(csv, diagram, "point")
    document = {
        "rotor_speed": scene.drive.speed,
        "resonances": light.resonances,
        "judged": "by Floquet multipliers of the full equations",
        **balance,
        "modes": [
            {
                "mode": k,
                **fields_of(jam, "omega", "stable", "amplitude", "foundation_force", "multiplier"),
                "status": jam.message,
                **({"measures": measures[k].document()} if k in measures else {}),
            }
            for k, jam in existing.items()
        ],
        "special": [fields_of(p, "omega", "rotor_speed", "kind") for p in diagram.special],
        "missing": [{"mode": k, "status": jam.message} for k, jam in jams.items() if k not in existing],
    }

    def text() -> str:
        from jaxvib.display import speed_text, speed_unit  # slow imports, which --help does not need
        from jaxvib.steady.jams.branch_plot import KINDS

        unit, scale = speed_unit()
        head, *rows = _exact_table(scene, existing)
        points = [[KINDS[p.kind], f"{scale * p.omega:.6g}", f"{scale * p.rotor_speed:.6g}"] for p in diagram.special]
        lines = [
            f"rotor {speed_text(scene.drive.speed)}",
            table("exact jams; amplitudes and force are zero to peak", head, rows),
            *(f"mode {k}: {jam.message}" for k, jam in jams.items() if k not in existing),
            *_reached_lines(scene, output, [f"mode {k}" for k in measures], balance),
            *(indented(f"mode {k}:", each) for k, each in measures.items()),
        ]
        if points:
            lines.append(table("points where stability changes", ["", f"loads, {unit}", f"rotor, {unit}"], points))
        return "\n".join(lines)

    output.done(document, text, "modes", diagram)
