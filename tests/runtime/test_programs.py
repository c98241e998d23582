"""Programs kept on disk, and names that are imported when they are asked for."""

import ast
import pathlib
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib import programs

traces = []


class Pair(eqx.Module):
    first: jax.Array
    name: str = eqx.field(static=True)


def doubled(pair, factor):
    traces.append(pair.name)
    return Pair(factor * pair.first, pair.name + "!"), {"sum": jnp.sum(pair.first), "said": pair.name}


def told(x):
    jax.debug.callback(lambda _: None, x)
    return x + 1.0


@pytest.fixture
def folder(tmp_path):
    traces.clear()
    programs.keep_programs(tmp_path)
    yield tmp_path
    programs.keep_programs(None)


def test_another_process_need_not_trace(folder):
    """A fresh `kept` stands for another process: it finds the program on disk and never calls the function."""
    pair = Pair(jnp.arange(3.0), "a")
    first = programs.kept(doubled)(pair, 2.0)
    assert traces == ["a"] and len(list(folder.iterdir())) == 1
    again = programs.kept(doubled)(Pair(jnp.asarray([1.0, 2.0, 4.0]), "a"), 2.0)
    assert traces == ["a"]
    assert first[0].name == again[0].name == "a!" and again[1]["said"] == "a"
    np.testing.assert_array_equal(again[0].first, [2.0, 4.0, 8.0])
    assert float(again[1]["sum"]) == 7.0


@pytest.mark.parametrize(
    "other",
    [
        (Pair(jnp.arange(4.0), "a"), 2.0),
        (Pair(jnp.arange(3.0, dtype=jnp.float32), "a"), 2.0),
        (Pair(jnp.arange(3.0), "b"), 2.0),
        (Pair(jnp.arange(3.0), "a"), 3.0),
    ],
)
def test_another_question_is_another_program(folder, other):
    programs.kept(doubled)(Pair(jnp.arange(3.0), "a"), 2.0)
    answer = programs.kept(doubled)(*other)
    assert len(traces) == 2 and len(list(folder.iterdir())) == 2
    np.testing.assert_array_equal(answer[0].first, other[1] * other[0].first)


def test_a_damaged_program_is_written_anew(folder):
    pair = Pair(jnp.arange(3.0), "a")
    programs.kept(doubled)(pair, 2.0)
    (file,) = folder.iterdir()
    file.write_bytes(file.read_bytes()[:100])
    np.testing.assert_array_equal(programs.kept(doubled)(pair, 2.0)[0].first, [0.0, 2.0, 4.0])
    assert len(traces) == 2 and file.stat().st_size > 100


def test_what_cannot_be_kept_still_runs(folder):
    """A callback has no form on disk; a function made on the spot has no name to be found under."""
    assert float(programs.kept(told)(jnp.asarray(1.0))) == 2.0
    assert float(programs.kept(lambda f, x: f(x))(lambda x: 3.0 * x, jnp.asarray(1.0))) == 3.0
    assert not [file for file in folder.iterdir() if file.name.startswith("told")]


def test_a_library_call_outlives_its_process(tmp_path):
    """LAPACK must be bound before a kept program calls it, and what JAX's own cache has loaded must not be kept."""
    code = """
import sys, pathlib, jax, jax.numpy as jnp
from jaxvib import programs
jax.config.update("jax_compilation_cache_dir", sys.argv[1] + "/jax")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
folder = pathlib.Path(sys.argv[1]) / "kept"
programs.keep_programs(folder)
def values(x):
    print("traced")
    return jnp.linalg.eigvalsh(x @ x.T)
total = programs.kept(values)(jnp.arange(16.0).reshape(4, 4)).sum()
print(round(float(total)), len(list(folder.iterdir())))
"""
    said = []
    for k in range(4):
        if k == 2:
            (file,) = (tmp_path / "kept").iterdir()
            file.unlink()
        done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, capture_output=True, text=True)
        said.append(done.stdout.split())
    assert said == [["traced", "1240", "1"], ["1240", "1"]] * 2


def test_derivatives_go_through_kept_functions(folder):
    slope = jax.grad(lambda x: programs.kept(doubled)(Pair(x, "a"), 2.0)[0].first.sum())(jnp.arange(3.0))
    np.testing.assert_array_equal(slope, [2.0, 2.0, 2.0])


def test_jams_from_a_kept_program_are_the_same(folder):
    s = scene("two_mass", "balls")
    kept = jv.jam_modes(s)
    programs.keep_programs(None)
    for a, b in zip(jax.tree.leaves(kept), jax.tree.leaves(jv.jam_modes(s)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_import_loads_little():
    """The package alone needs nothing; a jam mode needs neither pictures nor the time integrator."""
    code = """
import sys, jaxvib
assert not {"jax", "matplotlib", "diffrax", "pint"} & set(sys.modules)
jaxvib.jam_modes
assert "jax" in sys.modules and not {"matplotlib", "diffrax", "pint", "rich", "optax"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_is_there():
    """The stub is the one list of names: each is found, and __all__ of the stub leaves none out."""
    stub = ast.parse(pathlib.Path(jv.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    (listed,) = [ast.literal_eval(node.value) for node in stub.body if isinstance(node, ast.Assign)]
    assert sorted(listed) == jv.__all__ and set(jv.__all__) <= set(dir(jv))
    assert all(getattr(jv, name).__name__ for name in jv.__all__ if callable(getattr(jv, name)))
    with pytest.raises(AttributeError, match="no attribute 'jam_mode'"):
        _ = jv.jam_mode
