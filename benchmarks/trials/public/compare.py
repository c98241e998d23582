"""Eighty cases in the style of textbooks, catalogues and papers, each beside a computation that shares no code with jaxvib.

    python benchmarks/trials/public/compare.py [frequencies] [jams] [motion] [exciters] [--only WORD]

The reference of a case is a closed form, or NumPy and SciPy on equations written out here. The script prints one line per case,
the largest relative difference and its bound, and exits with 1 if any bound is exceeded.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from collections.abc import Iterator

import jax
import numpy as np
from case import CASES, Case

import jaxvib as jv


def difference(one: Case) -> tuple[float, str]:
    """Return the largest relative difference, and the error message if the question fails."""
    try:
        computed, reference = (np.asarray(side(), float).ravel() for side in (one.computed, one.reference))
    except (jv.InputError, jv.ComputationError) as error:
        return np.inf, f"{type(error).__name__}: {error}"
    if computed.shape != reference.shape:
        return np.inf, f"{computed} beside {reference}"
    return float(np.max(np.abs(computed - reference) / np.abs(reference))), ""


def judged(only: str) -> Iterator[bool]:
    """Print the verdict on each case whose name contains `only`, and yield it."""
    for one in CASES:
        if only in one.name:
            begun = time.perf_counter()
            found, words = difference(one)
            right = found <= one.bound
            spent = time.perf_counter() - begun
            print(
                f"{'ok   ' if right else 'WRONG'} {found:8.1e} of {one.bound:.0e}  {one.name} ({spent:.1f} s) {words}",
                flush=True,
            )
            yield right


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("kinds", nargs="*", help="frequencies, jams, motion, exciters (default: all)")
    options.add_argument("--only", default="", help="cases whose name has this word")
    given = options.parse_args()
    for kind in given.kinds or ("frequencies", "jams", "motion", "exciters"):
        importlib.import_module(kind)  # adds its cases
    outcomes = list(judged(given.only))
    print(f"{sum(outcomes)} of {len(outcomes)} cases agree with their reference")
    return int(not all(outcomes))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main())
