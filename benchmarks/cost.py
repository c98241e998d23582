"""Cost of accuracy for four scenes: error and time of every tier, method, tolerance and dtype, compared with a reference.

    python benchmarks/cost.py [--only jam fold run_up friction gradient] [--quick] [--out FOLDER]

Prints a table for each scene, as `jaxvib cost` does for a scene file, a table for the gradient of the first scene, and a table
of the cheapest methods; --out adds the figure (cost.png) and the numbers (cost.json). A time is that of a call from Python
until its result is available, without compilation, the shortest of several calls. Each scene takes about a minute, mostly for
compilation.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import jaxvib as jv
from jaxvib.study.accuracy.cost import CostRow, cost_figure

jv.prepare_cpu()

import equinox as eqx  # noqa: E402
import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

from machines import published_rotor  # noqa: E402
from parts.common import machine_line, published  # noqa: E402

from jaxvib.cli.study.cost import cost_document, cost_table  # noqa: E402
from jaxvib.study.accuracy.cost import SHOWN_ERRORS  # noqa: E402

COARSE = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)


def jam() -> jv.Scene:
    """Return the two-mass machine of the antiphase paper, far from any fold."""
    return published(3.0)


def near_a_fold() -> jv.Scene:
    """Return the same machine with lighter loads, at 0.999 times the rotor speed of the exact fold at the second resonance."""
    scene = published(eps=1e-3)
    fold = next(
        point for point in jv.branches(scene, exact=True, least=0.98, most=1.05, points=60).special if point.kind == "fold"
    )
    return eqx.tree_at(lambda s: s.drive.speed, scene, jax.numpy.asarray((1.0 - 1e-3) * fold.rotor_speed))


def dry_friction() -> jv.Scene:
    """Return a platform with two pendulums whose bearings have dry friction."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)
    loads = jv.pendulums(count=2, mass=1.0, radius=0.1, drag=0.7)
    return jv.Scene(machine, loads, jv.ConstantSpeed(50.0), (jv.DryFriction(0.1, diameter=0.02), jv.Gravity()))


SCENES: dict[str, tuple[str, Callable[[], jv.Cost]]] = {
    "jam": ("two-mass jam", lambda: jv.work_precision(jam(), mode=3)),
    "fold": (
        "two-mass jam, at 0.999 times the rotor speed of its fold",
        lambda: jv.work_precision(near_a_fold(), mode=3, tolerances=COARSE),
    ),
    "run_up": (
        "rotor with four pendulums, run-up of 6 s",
        lambda: jv.work_precision(published_rotor(9.2e-4, "uncoupled"), until=6.0, tolerances=COARSE),
    ),
    "friction": ("jam with dry bearing friction", lambda: jv.work_precision(dry_friction(), mode=1, tolerances=COARSE)),
    "gradient": (
        "two-mass jam, largest amplitude, with respect to the stiffnesses",
        lambda: jv.work_precision(jam(), "gradient", mode=3),
    ),
}


def markdown(costs: dict[str, jv.Cost]) -> str:
    """Return a table with a line for each scene: the cheapest method for each error."""
    lines = [
        "| scene | " + " | ".join(f"error {error:.0e}" for error in SHOWN_ERRORS) + " |",
        "|---" * (len(SHOWN_ERRORS) + 1) + "|",
    ]
    for title, cost in costs.items():
        cells = [way(row) for row in map(cost.cheapest, SHOWN_ERRORS)]
        lines.append(f"| {title}: {cost.quantity} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def way(row: CostRow | None) -> str:
    if row is None:
        return "none"
    return ", ".join(part for part in (row.tier, row.method, row.dtype, row.setting) if part) + f": {1e3 * row.seconds:.2g} ms"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--out", type=Path, help="folder for the figure and the numbers")
    parser.add_argument("--quick", action="store_true", help="two tolerances of one scene, as a test of the program")
    options = parser.parse_args()
    print(machine_line())
    costs: dict[str, jv.Cost] = {}
    for name in ["jam"] if options.quick else options.only:
        title, ask = SCENES[name]
        if options.quick:
            ask = lambda: jv.work_precision(jam(), mode=3, tolerances=(1e-3, 1e-6), solvers=("Dopri8",), repeats=1)  # noqa: E731
        begun = time.perf_counter()
        costs[title] = ask()
        print(f"\n{title} ({time.perf_counter() - begun:.0f} s)\n{cost_table(costs[title])}", flush=True)
    print("\n" + markdown(costs))
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        documents = {title: cost_document(cost) for title, cost in costs.items()}
        (options.out / "cost.json").write_text(json.dumps(documents, indent=2), encoding="utf-8")
        # Gradients have their own table; their methods are others than those of the panels.
        cost_figure({title: cost for title, cost in costs.items() if cost.quantity != "gradient"} or costs).savefig(
            options.out / "cost.png"
        )


if __name__ == "__main__":
    main()
