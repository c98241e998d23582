"""Table of laws of friction that are named after fits to repeated records (docs/identification.md).

PYTHONPATH=tests/helpers python -m repeated_records.laws 100
PYTHONPATH=tests/helpers python -m repeated_records.laws 100 "linear machine"

In the first cases the records are made with the law that the fit assumes, and each named law is a false alarm. `identify` tries
other laws after patterned fits only; here they are tried after every fit.
"""

import argparse
import functools
import time
from typing import NamedTuple

import jax
import numpy as np
from run_ups_by_scipy import TRUTH, record
from run_ups_by_scipy import scene_of as linear_scene_of

from jaxvib.identification.alternatives.clocks import clock_notes
from jaxvib.identification.alternatives.laws import law_notes
from jaxvib.identification.checks import FitStatus, status_of
from jaxvib.identification.directions import information_of
from jaxvib.identification.identify import fitted_scene
from jaxvib.identification.jammed.start import with_first_motion
from jaxvib.identification.problem import build_problem
from jaxvib.identification.start import fit_amplitudes
from jaxvib.identification.torque import fit_with_torques
from jaxvib.results.status import status_name
from repeated_records import jammed, supports
from repeated_records.fits import JAMMED_NOISE, NAMES, NOISE, TIMES, run_up

WORDS = ("dry friction at platform 2", "rolling friction of the loads", "a drag of the air")
"""Words that name the laws of the cases in notes."""

CASES = {
    "linear machine": (None, {}),
    "linear machine, coloured noise": (None, {"color": 0.9}),
    "linear machine, 2 % outliers": (None, {"outliers": 0.02}),
    "jammed balls": (None, {"balls": True}),
    "cubic support": (None, {"support": "cubic"}),
    "dry friction, 20 N": (WORDS[0], {"support": "friction"}),
    "dry friction, 5 N": (WORDS[0], {"support": "friction", "force": 5.0}),
    "rolling friction": (WORDS[1], {"balls": True, "lever": 2e-4}),
    "drag of the air": (WORDS[2], {"balls": True, "air": 2e-5}),
}
"""Words that name the law that the fit lacks (None if it lacks no law of friction), and options of `named`."""


class Named(NamedTuple):
    """Status of a fit, and notes on other laws and on clocks: those of `identify` (`notes`), and those of the laws if they are
    tried after every fit (`tried`)."""

    status: str
    notes: list[str]
    tried: list[str]


@functools.cache
def _motion(support, force):
    numbers = supports.truth(support)
    return supports.motion(numbers if force is None else numbers | {next(iter(supports.FRICTION)): force})


def named(rng, balls=False, support=None, force=None, **options):
    """Return the `Named` laws of a record with noise; the fit begins with the true parameters.

    **Arguments**: `balls`: two jammed balls; `support`: kind of a support that the fit lacks; `force` of its friction, N;
    other options of `jammed_record` or `record`.
    """
    names = [*NAMES, "loads.mass", "loads.drag"] if balls else list(NAMES)
    if balls:
        scene, run = jammed.scene_of(jammed.TRUTH), jammed.jammed_record(JAMMED_NOISE, rng, **options)
    else:
        clean = _motion(support, force) if support else run_up(False)[0]
        scene, run = linear_scene_of(TRUTH), record(TIMES, clean, NOISE, rng, **options)
    problem = build_problem(scene, [run], names, {})
    starts = [np.zeros(problem.unknowns.count)]
    if balls:
        problem, first = with_first_motion(problem)
        starts = [first]
    else:
        starts.append(fit_amplitudes(problem))
    fitted = fit_with_torques(problem, starts)
    status, *_ = status_of(fitted, information_of(fitted))
    tried = law_notes(fitted, fitted_scene(fitted.problem, fitted.x, fitted.linear), [run], names, {})
    notes = (clock_notes(fitted) or tried) if status is FitStatus.patterned else []
    return Named(status_name(status), notes, tried)


def main(count, names):
    print("| case | records | patterned | law or clock named | right law alone | right law and another | always tried |")
    for name in names:
        begin, (words, options) = time.process_time(), CASES[name]
        found = [named(np.random.default_rng([1, k]), **options) for k in range(count)]
        notes = [each.notes[0] for each in found if each.notes]
        right = [note for note in notes if words and words in note]
        alone, patterned = sum(", or with " not in note for note in right), sum(each.status == "patterned" for each in found)
        tried = sum(bool(each.tried) for each in found)
        print(f"| {name} | {count} | {patterned} | {len(notes)} | {alone} | {len(right) - alone} | {tried} |")
        print(
            f"  {time.process_time() - begin:.0f} s of CPU time",
            *sorted({note.split(":")[0] for note in notes}),
            sep="\n  ",
            flush=True,
        )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(prog="repeated_records.laws")
    parser.add_argument("count", type=int)
    parser.add_argument("names", nargs="*", default=list(CASES))
    given = parser.parse_args()
    main(given.count, given.names)
