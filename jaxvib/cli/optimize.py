"""Command `optimize` of jaxvib."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from jaxvib.cli.app import TOLERANCE, Output, command, require_tolerances, table, tolerance_table
from jaxvib.cli.output import duration_text, fields_of, note, write_file

if TYPE_CHECKING:
    from optimize import Demand, Design, Quantity, Synthesis, ToleranceRange


_MIN_SHARE_OF_MACHINES = 0.95
"""Share of the machines within tolerances that should meet a demand. A text states a smaller share."""

_MIN_SHARE_OF_ESTIMATE = 0.1
"""Smallest finished share of a search from which its remaining time is estimated."""


@command("optimize", "design")
@click.option("--starts", type=int, help="Number of random starts [as in DESIGN].")
@click.option("--seed", type=int, help="Seed of the random starts [as in DESIGN].")
@click.option(
    "--searcher", type=click.Choice(["gradients", "cma"]), help="Method: Adam from many starts, or CMA-ES [as in DESIGN]."
)
@click.option(
    "--resume", type=click.Path(path_type=Path), help="File search.npz of an earlier search of this design, which is continued."
)
@click.option("--no-verify", is_flag=True, help="Skip the verification by an exact periodic motion and time integration.")
@TOLERANCE
def optimize(
    design: Path,
    starts: int | None,
    seed: int | None,
    searcher: str | None,
    resume: Path | None,
    no_verify: bool,
    tolerances: tuple[str, ...],
    output: Output,
) -> None:
    """Search for the best machine of a DESIGN file; --out saves the scene file of the best machine (found.toml), the search,
    the figures and the motion of the verification. Ctrl-C ends the search with the best machine found so far; --resume
    continues the search."""
    from jaxvib.machine.files import read_toml
    from jaxvib.machine.rewrite import rewrite_scene
    from jaxvib.machine.validation import load_weight_notes
    from optimize import Synthesis, load_design, synthesize, tolerance_ranges

    loaded = load_design(design)
    require_tolerances(loaded.space.scene, tolerances)
    for each in (*loaded.notes(), *load_weight_notes(loaded.space.scene)):
        note(f"note: {each}")
    overrides = {"starts": starts, "seed": seed, "searcher": searcher}
    options = {**loaded.search, **{name: value for name, value in overrides.items() if value is not None}}
    with output.progress() as progress:
        best = synthesize(
            loaded.space,
            loaded.objective,
            subject_to=loaded.subject_to,
            begin=None if resume is None else Synthesis.load(resume),
            verify=not no_verify,
            progress=_with_time_left(progress),
            **options,
        )
    output.save_result("search.npz", best)
    path = output.file("found.toml")
    if path is not None:
        source = design.parent / read_toml(design)["scene"]
        write_file(path, rewrite_scene(source.read_text(encoding="utf-8"), best.scene))
    output.figure("before_after.png", best.plot)
    output.figure("convergence.png", best.plot_convergence)
    _draw_working_regime(output, loaded, best)
    if best.run is not None:
        output.figure("history.png", best.run.plot)
        output.save_result("run.npz", best.run)
    ranges = tolerance_ranges(best.scene, _quantities_with_ranges(loaded), list(tolerances)) if tolerances else []
    chosen = [catalogue.chosen(best.scene) for catalogue in loaded.catalogues]
    document = {
        **_document(best),
        **({"chosen": chosen} if chosen else {}),
        **({"tolerances": [ranges_of_quantity._asdict() for ranges_of_quantity in ranges]} if tolerances else {}),
    }

    def text() -> str:
        of_ranges = [tolerance_table(ranges, tolerances), *_few_machines_texts(ranges, loaded.subject_to)] if tolerances else []
        return "\n".join([_text(best), *chosen, *of_ranges])

    output.done(document, text, "optimize", best)


def _with_time_left(progress: Callable[[str, float], None]) -> Callable[[str, float], None]:
    """Return a function that adds the estimated time left to the names of steps."""
    begun = time.monotonic()

    def report(what: str, share: float) -> None:
        left = (time.monotonic() - begun) * (1.0 - share) / max(share, _MIN_SHARE_OF_ESTIMATE)
        progress(f"{what}, about {duration_text(left)} left" if share >= _MIN_SHARE_OF_ESTIMATE else what, share)

    return report


def _draw_working_regime(output: Output, design: Design, best: Synthesis) -> None:
    """Draw the phases of the exciters and the ellipses on the deck of a machine with several exciters."""
    import jaxvib as jv
    from optimize.quantities.exciters import deck_points

    quantities = (
        design.objective,
        *(demand.quantity for demand in design.subject_to),
        *(held.quantity for held in design.space.held),
    )
    points = deck_points(quantities)
    regime = None if points is None else jv.working_regime(best.scene, throw=False)
    if regime is None or not bool(regime.stable):
        return
    if len(best.scene.exciters) > 1:
        output.figure("phases.png", regime.plot)
    if points:
        output.figure("deck.png", lambda: jv.sketch(best.scene, deck=regime.deck(points)))


def _quantities_with_ranges(design: Design) -> list[Quantity | Demand]:
    """Return the quantities and demands whose ranges within tolerances are shown, each once: objective, foundation force, held
    quantities, demands."""
    from optimize import foundation_force

    objective = design.objective
    is_moving = objective.mode is not None or design.space.scene.machine.places == "plane"
    force = [foundation_force(mode=objective.mode)] if is_moving and objective.simplified.name != "foundation_force" else []
    return [objective, *force, *(held.quantity for held in design.space.held), *design.subject_to]


def _few_machines_texts(ranges: Sequence[ToleranceRange], demands: Sequence[Demand]) -> list[str]:
    """Return a text for each demand that fewer than 95 % of the machines within tolerances meet. The ranges of the demands are
    the last ones."""
    return [
        f"only {100.0 * each.share:.3g} % of these machines meet this demand: {each.words}"
        for each in ranges[len(ranges) - len(demands) :]
        if each.share < _MIN_SHARE_OF_MACHINES
    ]


def _document(best: Synthesis) -> dict:
    return {
        "status": best.status_name,
        "message": best.message,
        "objective": best.objective,
        "before": best.before.as_dict(),
        "after": best.after.as_dict(),
        "verified": None if best.verified is None else best.verified.as_dict(),
        **fields_of(best, "unverified", "starts", "drawn", "converged", "same", "kkt"),
        **fields_of(best, "table", "limits", "influences", "unresolved", "machines"),
    }


def _text(best: Synthesis) -> str:
    from optimize.result import objective_text

    heads, *rows = best.columns()
    quantities = table(objective_text(best.objective), heads, rows)
    return "\n".join(
        [f"{best.message}\n{best.counts_text()}", quantities, *(line.strip() for line in best.findings()), *best.verification()]
    )
