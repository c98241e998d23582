"""What commands that integrate have in common: how steps are chosen, a run as JSON has it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jaxvib as jv
from jaxvib.errors import InputError

if TYPE_CHECKING:
    from jaxvib.results.fields import Plain

__all__ = ["chosen_steps", "measured_document", "run_document"]


def chosen_steps(tolerance: float | None, accuracy: float | None) -> jv.Tolerance | jv.Accuracy | None:
    """How steps are chosen. **Raises** `InputError` where both options are given."""
    if tolerance is not None and accuracy is not None:
        raise InputError("accuracy", "is given together with tolerance; give one of them")
    if accuracy is not None:
        return jv.Accuracy(accuracy)
    return None if tolerance is None else jv.Tolerance(tolerance)


def measured_document(run: jv.Run | jv.Envelope, scene: jv.Scene) -> dict[str, Plain]:
    """How a motion ended, and what was measured over its last turns."""
    structure = scene.machine.structure()
    return {
        "status": run.status_name,
        "message": run.message,
        "time": float(run.window.time[-1]),
        "rotor_speed": float(run.window.rotor_speed[-1]),
        "omega": float(run.omega),
        "load_speed": run.load_speed.tolist(),
        "coordinates": list(structure.coordinates),
        "units": list(structure.units),
        "amplitude": run.amplitude.tolist(),
        "foundation_force": float(run.foundation_force),
        "drift": float(run.drift),
        "settled": bool(run.settled),
        "steps": int(run.steps),
        "rejected": int(run.rejected),
    }


def run_document(run: jv.Run) -> dict[str, Plain]:
    """A run's quantities over its last turns, its error and its cost."""
    return {
        **measured_document(run, run.scene),
        "regime": _regime(run.regime),
        "together": bool(run.together),
        "error": float(run.error),
        "evaluations": int(run.evaluations),
        "seconds": float(run.seconds),
    }


def _regime(found: jv.Regime) -> dict[str, Plain]:
    """The regime and its evidence; names as in `RegimeName` and `PhasePattern`."""
    return {
        "name": found.label,
        "pattern": found.pattern_label,
        "mode": int(found.mode),
        "resonance": int(found.resonance),
        "resonance_speed": float(found.resonance_speed),
        "ripple": float(found.ripple),
        "phase": found.phase.tolist(),
        "unbalance": float(found.unbalance),
        "rotor_caught": bool(found.caught),
        "change": float(found.change),
    }
