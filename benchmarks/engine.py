"""All measurements behind the statements about speed, in one run: ratios of times at equal achieved error, a table, figures.

    pip install numba scipy mujoco jitcode scikit-sundae      # missing packages are left out of the comparison
    python benchmarks/engine.py [--only single ensemble ...] [--quick] [--out FOLDER]

Prints each measurement when it is finished, and the table at the end. First calls, which include compilation, are separate from
later calls. --out adds the numbers (engine.json), the table and the README's figure as text (engine.md), the figure of all
ratios (engine.png) and the figure of the memory of a reverse-mode gradient (memory.png). --quick runs small problems, as a test
of the program; its numbers have no meaning. The other benchmarks (cost, rotor, criterion) are separate programs.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

os.environ["JAXVIB_AUTOMATIC"] = "off"  # no program comes from a cache

import jaxvib as jv

jv.prepare_cpu()

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

from parts.common import ROWS, cpu_name, machine_line, versions  # noqa: E402
from parts.envelope import run_ups  # noqa: E402
from parts.loads import growth_with_loads  # noqa: E402
from parts.orbits import orbits  # noqa: E402
from parts.single import ensemble, growth_with_length, single  # noqa: E402
from parts.sizes import equal_loads, first_answers, platforms  # noqa: E402
from parts.slopes import designs, gradient, memory  # noqa: E402
from parts.table import bars, figures, markdown, whole  # noqa: E402

GROUPS = dict(
    single=single,
    ensemble=ensemble,
    gradient=gradient,
    memory=memory,
    envelope=run_ups,
    orbits=orbits,
    designs=designs,
    loads=growth_with_loads,
    length=growth_with_length,
    platforms=platforms,
    jams=equal_loads,
    first=first_answers,
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=list(GROUPS), default=list(GROUPS))
    parser.add_argument("--quick", action="store_true", help="small problems, as a test of the program")
    parser.add_argument("--out", type=Path, help="folder for the table, the figures and the numbers")
    options = parser.parse_args()
    print(machine_line())
    load = os.getloadavg()[0]
    for name in options.only:
        GROUPS[name](options.quick)
    document = dict(
        cpu=cpu_name(),
        cores=os.cpu_count(),
        load=load,
        quick=options.quick,
        versions=versions(),
        line=machine_line(),
        rows=ROWS,
    )
    text = markdown(document)
    print("\n" + text)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "engine.json").write_text(json.dumps(document, indent=2), encoding="utf-8")
        (options.out / "engine.md").write_text(f"{text}\n{bars(document)}\n{whole(document)}", encoding="utf-8")
        for file, figure in figures(document).items():
            figure.savefig(options.out / file)


if __name__ == "__main__":
    main()
