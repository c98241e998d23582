"""Table of repeated records of one machine (docs/identification.md): intervals that contain the true value, errors, wrong
minima.

PYTHONPATH=tests/helpers python -m repeated_records 400
PYTHONPATH=tests/helpers python -m repeated_records 400 "white noise"
PYTHONPATH=tests/helpers python -m repeated_records 400 "white noise" --store out/white_noise.jsonl

With `--store` the fits of one case are kept in a file. A computation that was interrupted continues after the last of them.
"""

import argparse
import time

import jax
import numpy as np

from repeated_records.fits import CASES, JAMMED_CASES, SUPPORT_CASES, repeated


def main(count: int, names: list[str], store: str | None) -> None:
    print(
        "| case | records | intervals that contain the true value |  largest standard deviation / bound | wrong minima | "
        "of these with status found |"
    )
    for name in names:
        begin = time.process_time()
        found = repeated(count, store=store, **(CASES | JAMMED_CASES | SUPPORT_CASES)[name])
        print(f"| {name} | {found.row} |", flush=True)
        counts = zip(*np.unique(found.statuses, return_counts=True), strict=True)
        print(f"  {time.process_time() - begin:.0f} s of CPU time; {', '.join(f'{n} {name}' for name, n in counts)}")
        print(f"  held {found.held.round(3).tolist()}, ratio {found.ratio.round(2).tolist()}")
        errors = found.error_ratio[~found.wrong]
        print(f"  standard errors {np.min(errors):.2f} to {np.max(errors):.2f} times the bound")
        if found.linear is not None:
            most = np.max(np.abs(found.from_linear[~found.wrong]))
            print(f"  linearized fits: held {found.linear_held.round(3).tolist()}, up to {most:.2f} bounds from the fits")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(prog="repeated_records")
    parser.add_argument("count", type=int)
    parser.add_argument("names", nargs="*", default=[*CASES, *JAMMED_CASES, *SUPPORT_CASES])
    parser.add_argument("--store", help="file of the fits of one case")
    given = parser.parse_args()
    if given.store and len(given.names) != 1:
        parser.error("--store needs the name of one case")
    main(given.count, given.names, given.store)
