"""Notebooks run from top to bottom, and what they print is what they show."""

import os
import pathlib
import re

import jax
import nbclient
import nbformat
import pytest

FOLDER = pathlib.Path(__file__).parents[2] / "notebooks"
FIRST = FOLDER / "first_machine.ipynb"
OTHERS = sorted(set(FOLDER.glob("*.ipynb")) - {FIRST})
NUMBER = re.compile(r"-?\d+\.?\d*(?:e[+-]?\d+)?")


def printed(notebook, but=()):
    """Text printed by code cells, except those with a tag of `but`."""
    cells = [c for c in notebook.cells if c.cell_type == "code" and not set(but) & set(c.metadata.get("tags", []))]
    return "".join(o.text for c in cells for o in c.outputs if o.output_type == "stream")


def numbers(text):
    return [float(x) for x in NUMBER.findall(text)]


def figures(notebook):
    outputs = [o for c in notebook.cells if c.cell_type == "code" for o in c.outputs]
    return sum("image/png" in o.get("data", {}) for o in outputs)


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    "path", [FIRST, *(pytest.param(path, marks=pytest.mark.slow) for path in OTHERS)], ids=lambda p: p.stem
)
def test_notebook_runs_and_shows_what_it_showed(path):
    kept = nbformat.read(path, as_version=4)
    fresh = nbformat.read(path, as_version=4)
    # The kernel is a process of its own, which shares what the tests compile.
    shared = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir)}
    shared["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.0"
    nbclient.NotebookClient(fresh, timeout=900, kernel_name="python3").execute(env=shared)
    assert figures(fresh) == figures(kept) > 0
    # Words must be the same; numbers may differ in the digits that another CPU rounds otherwise, and cells with the tag
    # "varies" print times and counts.
    assert NUMBER.sub("#", printed(fresh)) == NUMBER.sub("#", printed(kept))
    settled, before = (numbers(printed(shown, but=["varies"])) for shown in (fresh, kept))
    assert len(before) > 0
    assert settled == pytest.approx(before, rel=1e-3)
