"""Notebooks run from top to bottom, and what they print is what they show."""

import os
import pathlib
import re

import jax
import nbclient
import nbformat
import pytest

FOLDER = pathlib.Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
NUMBER = re.compile(r"-?\d+\.?\d*(?:e[+-]?\d+)?")


def printed(notebook):
    texts = [o.text for c in notebook.cells if c.cell_type == "code" for o in c.outputs if o.output_type == "stream"]
    return "".join(texts)


def figures(notebook):
    outputs = [o for c in notebook.cells if c.cell_type == "code" for o in c.outputs]
    return sum("image/png" in o.get("data", {}) for o in outputs)


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs_and_shows_what_it_showed(path):
    kept = nbformat.read(path, as_version=4)
    fresh = nbformat.read(path, as_version=4)
    # The kernel is a process of its own, which shares what the tests compile.
    shared = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir)}
    shared["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
    nbclient.NotebookClient(fresh, timeout=900, kernel_name="python3").execute(env=shared)
    assert figures(fresh) == figures(kept) > 0
    # Words must be the same; numbers may differ in the digits that another processor rounds otherwise.
    assert NUMBER.sub("#", printed(fresh)) == NUMBER.sub("#", printed(kept))
    table = re.compile(r"  jam frequency, .*?  force per amplitude[^\n]*", re.S)
    settled, before = ([float(x) for x in NUMBER.findall(table.search(printed(shown))[0])] for shown in (fresh, kept))
    assert settled == pytest.approx(before, rel=1e-3)
