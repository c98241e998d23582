"""Command `response` of jaxvib."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

import jaxvib as jv
from jaxvib.cli.app import SPEED_TYPE, WITHOUT, Output, command, loaded_scene, table
from jaxvib.cli.document import ANGLES_TYPE, deck_options, force_lines, indented, measures_of
from jaxvib.cli.output import csv_options

if TYPE_CHECKING:
    import numpy as np

    from jaxvib.steady.response import AbstractResponse, TorqueFolds


_MEASURES = (
    *("speed", "amplitude", "phase", "acceleration", "velocity", "exciter_force", "foundation_force"),
    *("transmissibility", "torque", "motor_torque", "power"),
)
"""Fields of a response in the document."""


@command("response")
@click.option("--most", type=SPEED_TYPE, help="Highest speed, such as '2000 rpm' [4/3 of the working speed].")
@click.option(
    "--phases",
    type=ANGLES_TYPE,
    help="Fixed phases of the unbalances of several exciters, as if gears connected them, such as '0 deg, 180 deg' [those of "
    "the first stable synchronous regime].",
)
@click.option("--points", type=int, default=500, help="Number of speeds.")
@click.option(
    "--speed",
    "speeds",
    type=SPEED_TYPE,
    multiple=True,
    help="Add the vibration at this speed, such as '960 rpm', to the tables; --csv then has these speeds only; repeatable.",
)
@WITHOUT
@deck_options
@csv_options
def response(
    scene: Path,
    most: str | None,
    phases: str | None,
    points: int,
    speeds: tuple[str, ...],
    without: tuple[str, ...],
    csv: Path | None,
    output: Output,
) -> None:
    """Compute the vibration of SCENE under the unbalances of its exciters over their speed, and the torque that the vibration
    needs; --out adds a figure.

    The operating points are the speeds at which the torque of the motor is equal to the torque that the vibration needs.
    Several exciters turn as if gears connected them: their phases are fixed, and their torques are added. Motors without gears
    choose other phases at other speeds (`jaxvib regimes`)."""
    import jax  # slow imports, which --help does not need
    import numpy as np

    loaded = loaded_scene(scene, without)
    angles, origin = _phases(loaded, phases)
    result = jax.device_get(jv.response(loaded, phases=angles, points=points, most=most))
    listed = jax.device_get(jv.response(loaded, phases=angles, speeds=[*speeds])) if speeds else None
    output.figure("response.png", result.plot)
    output.csv(csv, result if listed is None else listed, "speed")
    operating = np.flatnonzero(result.operating.exists).tolist()
    folds = np.flatnonzero(result.folds.exists).tolist()
    is_stable = result.operating.stable
    vibration_measures = [measures_of(loaded, result.operating.vibration(k)) if is_stable[k] else None for k in operating]
    document = {
        "resonances": result.resonances,
        "phases": angles,
        "phases_from": origin,
        "operating_points": [
            row | ({} if measured is None else {"measures": measured.document()})
            for row, measured in zip(
                _rows(result.operating, operating, *_MEASURES, "growth", "stable"), vibration_measures, strict=True
            )
        ],
        **({} if listed is None else {"speeds": _rows(listed, [*range(len(speeds))], *_MEASURES)}),
        "peaks": _rows(result, result.peaks(), *_MEASURES),
        "folds": _rows(result.folds, folds, "speed", "factor", "torque", "lands_at"),
    }
    about = (listed, (angles, origin), vibration_measures, operating, folds)
    output.done(document, lambda: _text(result, *about), "response", result)


def _rows(of: object, places: list[int], *names: str) -> list[dict[str, object]]:
    """Return the fields `names` of a result at some places, for a document."""
    return [{name: getattr(of, name)[k] for name in names} for k in places]


def _phases(scene: jv.Scene, given: str | None) -> tuple[np.ndarray, str]:
    """Return the phases of the unbalances, rad, and their origin in words, from the option --phases or a synchronous regime."""
    import numpy as np  # slow imports, which --help does not need

    from jaxvib.units import numbers

    count = len(scene.exciters)
    if given is not None:
        return np.asarray(numbers([part.strip() for part in given.split(",")], "rad", "--phases", count)), "given"
    if count == 1:
        return np.zeros(1), "of one exciter"
    if any(exciter.loads or exciter.effects for exciter in scene.exciters):
        return np.zeros(count), "equal, because regimes do not include effects on a rotor"
    regimes = jv.synchronous_regimes(scene)
    if np.any(regimes.stable):
        return np.asarray(regimes.phases[0]), "those of the first stable regime"
    return np.zeros(count), "equal, because there is no stable regime"


def _text(
    result: jv.Response,
    listed: jv.Response | None,
    phases: tuple[np.ndarray, str],
    vibration_measures: list[jv.VibrationMeasures | None],
    operating: list[int],
    folds: list[int],
) -> str:
    """Return the operating points, peaks and folds as tables, and the vibration at the `listed` speeds; `vibration_measures`:
    those at the stable operating points."""
    import numpy as np  # slow import, which --help does not need

    from jaxvib.display import shown_unit, speed_text, speed_unit
    from jaxvib.machine.validation import off_notes

    unit, scale = speed_unit()
    structure = result.scene.machine.structure()
    # A peak of more than 1 m does not change the unit of the other rows.
    kinds = [shown_unit(each, min(float(np.max(result.amplitude[:, k])), 0.999)) for k, each in enumerate(structure.units)]
    force_unit, force_scale = shown_unit("N", float(np.max(result.foundation_force)))
    moves = [f"{name}, {shown}" for name, (shown, _) in zip(structure.coordinates, kinds, strict=True)]

    def motion(of: AbstractResponse, k: int, *texts: str) -> list[str]:
        amplitudes = [f"{factor * a:.4g}" for a, (_, factor) in zip(of.amplitude[k], kinds, strict=True)]
        last = [f"{force_scale * of.foundation_force[k]:.4g}", f"{np.sum(of.torque[k]):.4g}"]
        return [f"{scale * of.speed[k]:.5g}", *texts, *amplitudes, *last]

    lines = [f"resonances {speed_text(result.resonances)}", *off_notes(result.scene)]
    several = len(result.scene.exciters) > 1
    if several:
        written = ", ".join(f"{a:.4g}" for a in np.rad2deg(phases[0]))
        lines.append(f"phases of the unbalances {written} deg ({phases[1]}), at all speeds")
    end = [f"force, {force_unit}", "torque, N m"]
    if operating:
        points, is_bounded = result.operating, np.all(np.isfinite(result.operating.amplitude), axis=1)
        rows = [motion(points, k, "yes" if points.stable[k] else "no" if is_bounded[k] else "unbounded") for k in operating]
        lines += [table("operating points (zero to peak)", [unit, "stable", *moves, *end], rows), *force_lines(result.scene)]
        if several:
            rows = [
                [f"{scale * points.speed[k]:.5g}", str(number), *(f"{x:.4g}" for x in (needed, motor, points.speed[k] * motor))]
                for k in operating
                for number, (needed, motor) in enumerate(zip(points.torque[k], points.motor_torque[k], strict=True), 1)
            ]
            head = [unit, "exciter", "torque of its vibration, N m", "of its motor, N m", "power of its motor, W"]
            lines.append(table("torques at the operating points", head, rows))
        stable = [(k, each) for k, each in zip(operating, vibration_measures, strict=True) if each is not None]
        lines += [indented(f"at {speed_text(points.speed[k])}:", each) for k, each in stable]
        if len(stable) > 1:
            lines.append("an accelerating motor can pass the slower stable points;")
            lines.append("run-up or simulate shows at which of them a start ends")
    else:
        lines.append("no operating point: at no speed is the torque of the motor equal to the torque that the vibration needs")
    if listed is not None:
        rows = [motion(listed, k) for k in range(len(listed.speed))]
        lines.append(table("at the speeds of --speed (zero to peak)", [unit, *moves, *end], rows))
    if peaks := result.peaks():
        lines.append(table("peaks of the foundation force", [unit, *moves, *end], [motion(result, k) for k in peaks]))
    if folds:
        lines.append(_folds_table(result.folds, folds, unit, scale))
    return "\n".join(lines)


def _folds_table(of: TorqueFolds, folds: list[int], unit: str, scale: float) -> str:
    rows = [
        [
            f"{scale * of.speed[k]:.5g}",
            f"{of.torque[k]:.4g}",
            f"{of.factor[k]:.4g}",
            f"{scale * of.lands_at[k]:.5g}" if math.isfinite(of.lands_at[k]) else "-",
        ]
        for k in folds
    ]
    head = [unit, "torque, N m", "torque / drive torque", f"jump to, {unit}"]
    return table("folds: the speed jumps if the drives have this torque", head, rows)
