"""Common parts of commands about motions: measures of a vibration, choice of steps, JSON documents of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

import jaxvib as jv
from jaxvib.cli.output import fields_of, note
from jaxvib.errors import InputError, quoted


class TypeWithUnit(click.ParamType):
    """Number with a unit: a plain number other than 0 could be in either of two `units`, such as rpm and rad/s.

    `several`: True for numbers that are separated by commas.
    """

    def __init__(self, name: str, *units: str, several: bool = False):
        self.name, self.units, self.several = name, units, several

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the text. **Raises** `InputError` for a number without a unit."""
        field = self.name if param is None else param.opts[-1]
        for part in str(value).split(",") if self.several else [str(value)]:
            try:
                plain = float(part)
            except ValueError:
                continue
            if plain != 0.0:
                choices = " or ".join(f"'{plain:g} {unit}'" for unit in self.units)
                raise InputError(field, f"is {quoted(part.strip())}, a number without a unit; write {choices}")
        return value


ANGLE_TYPE = TypeWithUnit("angle", "deg", "rad")
"""Type of options that are angles."""

ANGLES_TYPE = TypeWithUnit("angles", "deg", "rad", several=True)
"""Type of options that are angles, separated by commas."""

SEPARATION = click.option(
    "--separation",
    type=ANGLE_TYPE,
    help="Initial angle between neighbouring loads, such as '60 deg' for six equally spaced loads [at rest: side by side if "
    "the ball_radius is given, otherwise 1 deg; in a jam: 0, for `settle` 1 deg].",
)


_DECK_KEY = "jaxvib.deck_point"
"""Key of the values of --deck and --slope in the context of click."""

_MAX_DECK_SIZES = 20
"""Largest coordinate of a point of the deck, relative to the largest one of supports and exciters."""

_NOTED_KEY = "jaxvib.noted_measures"
"""Key in the context of click. Its value is True if a note about implausible measures was printed."""


_MAX_LAYER = 20.0
"""Largest width or height of a layer of material on a deck, m."""


def deck_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options --deck, --slope and --layer, which `measures_of` reads, to a command."""

    def store_value(context: click.Context, parameter: click.Parameter, value: Any) -> None:
        if isinstance(value, tuple):
            from jaxvib.units import numbers  # slow import, which --help does not need

            for point in value:
                if point.count(",") != 1:
                    raise InputError("--deck", f"is {quoted(point)}; give X,Y from the centre of mass, m, such as 1.5,0.1")
            value = [numbers([part.strip() for part in point.split(",")], "m", "--deck", 2).tolist() for point in value]
        elif parameter.name == "layer":
            parts = None if value is None else [part.strip() for part in value.split(",")]
            if parts is not None and len(parts) != 3:
                problem = "give WIDTH,HEIGHT,DENSITY, such as '1.5 m, 55 mm, 1600 kg/m^3'"
                raise InputError("--layer", f"is {quoted(value)}; {problem}")
            if parts is not None:
                _require_layer(parts)
            value = parts
        elif value is not None:
            from jaxvib.steady.points import read_slope  # slow import, which --help does not need

            value = float(read_slope(value, "--slope"))
        if value:
            context.meta.setdefault(_DECK_KEY, {})[parameter.name] = value

    slope = click.option(
        "--slope",
        expose_value=False,
        callback=store_value,
        help="Slope of the deck of a body in a plane, such as '-15 deg' [0].",
    )
    deck = click.option(
        "--deck",
        "at",
        metavar="X,Y",
        multiple=True,
        expose_value=False,
        callback=store_value,
        help="Point of the deck of a body in a plane, m, such as 1.5,0.1, for which stroke, throw and conveying speed are "
        "computed; repeatable [centre of mass].",
    )
    layer = click.option(
        "--layer",
        metavar="WIDTH,HEIGHT,DENSITY",
        expose_value=False,
        callback=store_value,
        help="Layer of material on the deck, for the throughput, such as '1.5 m, 55 mm, 1600 kg/m^3'.",
    )
    return deck(slope(layer(command)))


def _require_layer(parts: list[str]) -> None:
    """**Raises** `InputError` for a width or height, as text, of more than `_MAX_LAYER` m, which is in another unit."""
    from jaxvib.units import number  # slow import, which --help does not need

    for part, name in zip(parts, ("width", "height"), strict=False):
        size = number(part, "m", "--layer")
        if size > _MAX_LAYER:
            problem = f"has the {name} {float(size):g} m; numbers without a unit are metres"
            raise InputError("--layer", f"{problem}; write for example '1.5 m, 55 mm, 1600 kg/m^3'")


def measures_of(scene: jv.Scene, motion: jv.Jam | jv.PhaseJam | jv.Orbit | jv.Vibration) -> jv.VibrationMeasures:
    """Return the measures of a vibration, at the points of the option --deck, with a note on stderr about implausible ones.

    **Raises** `InputError` for the option with a machine that is not a body in a plane.
    """
    import jax  # slow import, which --help does not need

    require_deck_options(scene)
    meta, deck = click.get_current_context().meta, deck_of_options()
    if "at" in deck:
        deck["at"] = deck["at"][0] if len(deck["at"]) == 1 else deck["at"]
    measures = jax.device_get(jv.vibration_measures(scene, motion, **deck))
    if not meta.get(_NOTED_KEY):  # one note for each command
        for each in measures.notes():
            meta[_NOTED_KEY] = True
            note(f"note: {each}")
    return measures


_MAX_DRAG_SPEED_DIFFERENCE = 0.05
"""Relative difference between the load speed of a jam and that of the drag in the file, up to which there is no note."""


def note_loads(scene: jv.Scene, stable: Sequence[float], path: Path | None, *, averaged: bool = True) -> None:
    """Print notes about the weight of the loads, and about their drag in the scene file.

    **Arguments**: `stable`: load speeds of stable jams, rad/s; `path` of the scene file; `averaged`: True for jams of light
    loads, which omit the change of the speed by the weight within a turn.
    """
    from jaxvib.machine.files import read_toml  # slow imports, which --help does not need
    from jaxvib.machine.validation import load_weight_notes

    of_drag = [] if path is None else drag_notes(read_toml(path), stable)
    for each in (*load_weight_notes(scene, min(stable, default=None) if averaged else None), *of_drag):
        note(f"note: {each}")


def drag_notes(tables: Mapping[str, Any], stable: Sequence[float]) -> list[str]:
    """Return a note for each drag that the tables of a scene file compute for a load speed at which no jam is, and for each
    drag of rollers in oil; `stable`: as above."""
    from jaxvib.display import speed_text  # slow imports, which --help does not need
    from jaxvib.units import number

    notes, owners = [], {"": tables} | {f"exciters[{k}].": table for k, table in enumerate(tables.get("exciters", []))}
    for prefix, owner in owners.items():
        loads = owner.get("loads", {})
        drag = loads.get("drag") if isinstance(loads, Mapping) else None
        if not isinstance(drag, Mapping):
            continue
        if loads.get("kind") == "roller" and drag.get("cause") == "oil":
            notes.append(f"{prefix}loads.drag is that of a sphere in oil; that of a roller depends on its length: measure it")
        if not stable or "load_speed" not in drag:
            continue
        given = float(number(drag["load_speed"], "rad/s", "load_speed"))
        nearest = min(stable, key=lambda speed: abs(speed - given))
        if abs(nearest - given) > _MAX_DRAG_SPEED_DIFFERENCE * nearest:
            is_at = f"{prefix}loads.drag is for {speed_text(given)}, and the nearest stable jam is at {speed_text(nearest)}"
            notes.append(f"{is_at}: repeat with load_speed = '{speed_text(nearest)}' until both agree")
    return notes


def deck_of_options() -> dict[str, Any]:
    """Return the given options of the deck by name: --deck (`at`, a list of points), --slope and --layer."""
    return dict(click.get_current_context().meta.get(_DECK_KEY, {}))


def _given_options() -> list[str]:
    """Return the names of the given options of the deck."""
    return ["--deck" if name == "at" else f"--{name}" for name in deck_of_options()]


def require_deck_options(scene: jv.Scene) -> None:
    """**Raises** `InputError` for the options of the deck with a machine that is not a body in a plane, and for points far
    outside of the machine, which are in another unit."""
    deck = deck_of_options()
    if deck and scene.machine.places != "plane":
        raise InputError(
            _given_options()[0], f"is for bodies in a plane, not for a machine of kind '{scene.machine.kind}'; leave it out"
        )
    for x, y in deck.get("at", []):
        size = largest_coordinate(scene)
        if max(abs(x), abs(y)) > _MAX_DECK_SIZES * size:
            problem = f"is the point ({x:g}, {y:g}) m, more than {_MAX_DECK_SIZES} times as far from the centre of mass as any "
            advice = f"numbers without a unit are metres; for millimetres write '{x:g} mm,{y:g} mm'"
            raise InputError("--deck", f"{problem}support or exciter ({size:.3g} m); {advice}")


def largest_coordinate(scene: jv.Scene) -> float:
    """Return the largest coordinate of the supports and exciters of bodies in a plane, m, at least 0.1 m."""
    supports = getattr(scene.machine, "supports")  # noqa: B009
    places = [support.at for support in supports] + [exciter.position for exciter in scene.exciters]
    return max([0.1, *(float(abs(x)) for place in places if place is not None for x in place)])


def run_measures(run: jv.Run | jv.Envelope) -> jv.VibrationMeasures | None:
    """Return the measures of a run; None, with a note about the options of the deck, for a run without vibration."""
    if not run.no_vibration:
        return measures_of(run.scene, run.vibration())
    if deck_of_options():
        note(f"note: {', '.join(_given_options())}: no stroke, throw and conveying, because the run ends without a vibration")
    return None


def _deck_peaks(run: jv.Run) -> list[dict[str, Any]]:
    """Return the points of the option --deck with their largest displacements, m, during a run whose trajectory was stored, and
    the times of these, s."""
    points = [] if run.trajectory is None else deck_of_options().get("at", [])
    motions = [(at, run.point(at, part="all")) for at in points]
    names = ("largest_displacement", "largest_displacement_time")
    return [{"point": at, **{name: float(getattr(motion, name)) for name in names}} for at, motion in motions]


def run_text(run: jv.Run, measures: jv.VibrationMeasures | None) -> str:
    """Return the summary of a run, and the largest displacement of each point of the option --deck."""
    from jaxvib.display import quantity_text  # slow imports, which --help does not need
    from jaxvib.motion.analysis.points import peak_time_text

    lines = [run.summary(measures)]
    peaks = [(when, *each.values()) for when, part in run.parts().items() for each in _deck_peaks(part)]
    for when, at, peak, time in peaks:
        place, size = ", ".join(f"{x:.4g}" for x in at), quantity_text(peak, "m", 4)
        at_time = peak_time_text(peak, float(run.point(at).largest_displacement), time)
        lines.append(f"  largest on the way{when}, zero to peak: point ({place}) m {size}{at_time}")
    return "\n".join(lines)


def force_lines(scene: jv.Scene) -> list[str]:
    """Return lines about the foundation force of a table."""
    from jaxvib.motion.analysis.measure import ROOT_SUM_SQUARE, ROTATING_FORCE  # slow import, which --help does not need

    if len(scene.machine.structure().foundation_directions) == 1:
        return ["foundation force: zero to peak"]
    return [f"foundation force: zero to peak, {ROOT_SUM_SQUARE}", f"  ({ROTATING_FORCE})"]


def indented(title: str, measures: jv.VibrationMeasures) -> str:
    """Return a title, and below it the measures as indented text."""
    return "\n".join([title, *(f"  {line}" for line in measures.summary().splitlines())])


def chosen_steps(tolerance: float | None) -> jv.Tolerance | None:
    """Return the step-size controller of the option --step-tolerance."""
    return None if tolerance is None else jv.Tolerance(tolerance)


def measured_document(run: jv.Run | jv.Envelope, scene: jv.Scene) -> dict[str, object]:
    """Return the final values of a motion, and the values that were measured in its window, for a document."""
    structure = scene.machine.structure()
    speeds = [speed[-1] for speed in run.window.rotor_speeds]
    return {
        "status": run.status_name,
        "message": run.message,
        "time": run.window.time[-1],
        "rotor_speed": speeds[0] if len(speeds) == 1 else speeds,
        **fields_of(run, "omega", "load_speed"),
        "coordinates": structure.coordinates,
        "units": structure.units,
        **fields_of(run, "amplitude", "foundation_force", "drift", "settled", "steps", "rejected"),
        **({"caught_at": run.caught_at} if isinstance(run, jv.Run) else {}),
        **stays_document(run),
    }


def stays_document(run: jv.Run | jv.Envelope) -> dict[str, object]:
    """Return, for a document, the resonances at which masses stayed before they passed them, if the run has a trajectory."""
    return {} if run.trajectory is None else {"stays": [stay._asdict() for stay in run.stays]}


def measures_document(run: jv.Run | jv.Envelope, measures: jv.VibrationMeasures | None) -> dict[str, object]:
    """Return, for a document, the measures of a run, or the reason why it has none."""
    return {"no_vibration": run.no_vibration} if measures is None else {"measures": measures.document()}


def run_document(run: jv.Run, measures: jv.VibrationMeasures | None) -> dict[str, object]:
    """Return the quantities of a run in its window, its error and its cost, for a document."""
    peaks = _deck_peaks(run)
    parts = run.parts()
    largest = ("largest_displacement", "largest_displacement_time", "largest_force", "largest_force_time")
    return {
        **measured_document(run, run.scene),
        **measures_document(run, measures),
        **({"regime": _regime(run.regime)} if run.scene.is_plain else {}),
        **({} if run.trajectory is None else fields_of(run, *largest)),
        **(
            {"parts": [{"part": when.strip(), **fields_of(each, *largest)} for when, each in parts.items()]}
            if len(parts) > 1
            else {}
        ),
        **({"deck": peaks} if peaks else {}),
        **fields_of(run, "coincident", "error", "evaluations", "seconds"),
    }


def _regime(regime: jv.Regime) -> dict[str, object]:
    """Return the regime and the quantities from which it follows, with the names of `RegimeName` and `PhasePattern`."""
    return {
        "name": regime.label,
        "pattern": regime.pattern_label,
        **fields_of(regime, "mode", "resonance", "resonance_speed", "ripple", "phase", "unbalance"),
        "rotor_caught": regime.caught,
        "change": regime.change,
    }
