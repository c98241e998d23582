"""The examples of README and documentation run as they stand."""

import os
import pathlib
import re
import subprocess
import sys

import jax
import pytest

ROOT = pathlib.Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]


def examples():
    """{text of an example: its first page and number}. A block that does not import jaxvib continues the last one."""
    found = {}
    for page in PAGES:
        blocks = []
        for block in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.S):
            if blocks and "import jaxvib" not in block:
                blocks[-1] += block
            else:
                blocks.append(block)
        for number, block in enumerate(blocks):
            found.setdefault(block, f"{page.stem}-{number}")
    return found


EXAMPLES = examples()


def test_readme_has_examples():
    assert "README-0" in EXAMPLES.values()


@pytest.mark.parametrize("block", EXAMPLES, ids=EXAMPLES.values())
def test_example_runs(block, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    if EXAMPLES[block] == "README-0":
        run_alone(block)
    else:
        exec(compile(block, EXAMPLES[block], "exec"), {})


def run_alone(block):
    """Run a block in a process of its own, like a script of a user: jaxvib prepares JAX by itself. As strict as `conftest.py`
    is."""
    clean = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    clean |= {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir), "JAX_NUMPY_RANK_PROMOTION": "raise"}
    clean |= {"MPLBACKEND": "Agg", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.0"}
    words = [sys.executable, "-W", "error", "-c", block]
    done = subprocess.run(words, env=clean, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr


def test_links_of_the_readme_lead_to_files():
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", README.read_text(encoding="utf-8")):
        assert target.startswith("http") or (ROOT / target).exists(), target


def test_files_named_in_texts_exist():
    named = re.compile(
        r"(?<![\w/.])((?:benchmarks|tests|notebooks|docs|jaxvib|optimize)/[\w/]+\.(?:py|md|ipynb|toml|json|png|csv))"
    )
    folders = [ROOT / name for name in ("docs", "jaxvib", "optimize", "tests", "benchmarks", "notebooks")]
    files = [
        *ROOT.glob("*.md"),
        *(path for folder in folders for end in ("md", "py", "ipynb") for path in folder.rglob(f"*.{end}")),
    ]
    texts = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in files}
    missing = [(path, name) for path, text in texts.items() for name in named.findall(text) if not (ROOT / name).exists()]
    assert missing == []
