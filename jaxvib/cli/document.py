"""Common parts of commands with time integration: choice of steps, JSON documents of runs."""

from __future__ import annotations

import click

import jaxvib as jv
from jaxvib.cli.output import fields_of
from jaxvib.errors import InputError

SEPARATION = click.option(
    "--separation",
    help="Initial angle between neighbouring loads, such as '3 deg'; 0 for equal angles [loads in contact, or 1 deg].",
)


def chosen_steps(tolerance: float | None, accuracy: float | None) -> jv.Tolerance | jv.Accuracy | None:
    """Return the step-size controller of the options. **Raises** `InputError` if both options are present."""
    if tolerance is not None and accuracy is not None:
        raise InputError("accuracy", "cannot be combined with tolerance; give one of them")
    if accuracy is not None:
        return jv.Accuracy(accuracy)
    return None if tolerance is None else jv.Tolerance(tolerance)


def measured_document(run: jv.Run | jv.Envelope, scene: jv.Scene) -> dict[str, object]:
    """Return the final values of a motion, and the values measured over its last turns."""
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
    }


def run_document(run: jv.Run) -> dict[str, object]:
    """Return the quantities of a run over its last turns, its error and its cost."""
    return {
        **measured_document(run, run.scene),
        **({"regime": _regime(run.regime)} if run.scene.is_plain else {}),
        **({} if run.trajectory is None else fields_of(run, "largest_displacement", "largest_force")),
        **fields_of(run, "coincident", "error", "evaluations", "seconds"),
    }


def _regime(found: jv.Regime) -> dict[str, object]:
    """Return the regime and the quantities from which it follows, with the names of `RegimeName` and `PhasePattern`."""
    return {
        "name": found.label,
        "pattern": found.pattern_label,
        **fields_of(found, "mode", "resonance", "resonance_speed", "ripple", "phase", "unbalance"),
        "rotor_caught": found.caught,
        "change": found.change,
    }
