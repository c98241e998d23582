"""Table of repeated records of one machine (docs/identification.md): intervals that contain the true value, errors, wrong
minima.

PYTHONPATH=tests/helpers python -m repeated_records 400
PYTHONPATH=tests/helpers python -m repeated_records 400 "white noise"
"""

import sys
import time

import jax
import numpy as np

from repeated_records.fits import CASES, JAMMED_CASES, SUPPORT_CASES, repeated


def main(count: int, names: list[str]) -> None:
    print(
        "| case | records | intervals that contain the true value |  largest standard deviation / bound | wrong minima | "
        "of these with status found |"
    )
    for name in names:
        begin = time.process_time()
        found = repeated(count, **(CASES | JAMMED_CASES | SUPPORT_CASES)[name])
        print(f"| {name} | {found.row} |", flush=True)
        counts = zip(*np.unique(found.statuses, return_counts=True), strict=True)
        print(f"  {time.process_time() - begin:.0f} s of CPU time; {', '.join(f'{n} {name}' for name, n in counts)}")
        print(f"  held {found.held.round(3).tolist()}, ratio {found.ratio.round(2).tolist()}")
        if found.linear is not None:
            most = np.max(np.abs(found.from_linear[~found.wrong]))
            print(f"  linearized fits: held {found.linear_held.round(3).tolist()}, up to {most:.2f} bounds from the fits")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(int(sys.argv[1]), sys.argv[2:] or [*CASES, *JAMMED_CASES, *SUPPORT_CASES])
