"""Programs stored on disk."""

import gc
import importlib.metadata
import os
import pathlib
import resource
import subprocess
import sys
import weakref

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
import optimize
from jaxvib import code_changes
from jaxvib.runtime import cache, programs, stored, structure
from jaxvib.steady.jams import jam

traces = []


class Pair(eqx.Module):
    first: jax.Array
    name: str = eqx.field(static=True)


def doubled(pair, factor):
    traces.append(pair.name)
    return Pair(factor * pair.first, pair.name + "!"), {"sum": jnp.sum(pair.first), "name": pair.name}


def hidden(x):
    return Pair(x, np.arange(2))  # an array where a text should be


def with_callback(x):
    jax.debug.callback(lambda _: None, x)
    return x + 1.0


@pytest.fixture
def folder(tmp_path, monkeypatch, unwatched):
    traces.clear()
    monkeypatch.setattr(structure, "KNOWN_PACKAGES", structure.KNOWN_PACKAGES | {__name__})
    cache.set_program_folder(tmp_path)
    yield tmp_path
    cache.set_program_folder(None)


def test_another_process_need_not_trace(folder):
    """A fresh `cached` stands for another process: it finds the program on disk and never calls the function."""
    first = programs.cached(doubled)(Pair(jnp.arange(3.0), "a"), 2.0)
    assert traces == ["a"] and len(list(folder.iterdir())) == 1
    again = programs.cached(doubled)(Pair(jnp.asarray([1.0, 2.0, 4.0]), "a"), 2.0)
    assert traces == ["a"]
    assert first[0].name == again[0].name == "a!" and again[1]["name"] == "a"
    np.testing.assert_array_equal(again[0].first, [2.0, 4.0, 8.0])
    assert float(again[1]["sum"]) == 7.0


@pytest.mark.parametrize(
    "other",
    [
        (Pair(jnp.arange(4.0), "a"), 2.0),
        (Pair(jnp.arange(3.0, dtype=jnp.float32), "a"), 2.0),
        (Pair(jnp.arange(3.0), "b"), 2.0),
        (Pair(jnp.arange(3.0), "a"), 3.0),
        (Pair(jnp.arange(3.0), "a"), jnp.asarray(2.0)),
    ],
)
@pytest.mark.parametrize("process", ["same", "other"])
def test_another_question_is_another_program(folder, other, process):
    function = programs.cached(doubled)
    function(Pair(jnp.arange(3.0), "a"), 2.0)
    answer = (function if process == "same" else programs.cached(doubled))(*other)
    assert len(traces) == 2 and len(list(folder.iterdir())) == 2
    np.testing.assert_array_equal(answer[0].first, other[1] * other[0].first)


def test_what_another_program_gave_needs_no_compilation(folder):
    function, compiled = programs.cached(doubled), []

    def listen(event, seconds, **_):
        compiled.extend([event] * (event == "/jax/core/compile/backend_compile_duration"))

    mine = Pair(jnp.arange(3.0), "a")
    given = Pair(function(mine, 2.0)[0].first, "a")
    assert given.first.committed and not mine.first.committed  # JAX may move the one and not the other
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        function(given, 2.0)
        assert not compiled
        function(given, 3.0)
        assert compiled  # the event still has this name
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_zeros_of_both_signs_and_options_are_other_programs(folder):
    function = programs.cached(with_sign)
    assert [float(function(jnp.asarray(1.0), zero)) for zero in (0.0, -0.0)] == [1.0, -1.0]
    with jax.numpy_rank_promotion("allow"):
        function(jnp.asarray(1.0), 0.0)
    assert len(list(folder.iterdir())) == 3


def test_a_scalar_without_a_type_of_its_own_is_another_program(folder):
    """Python's numbers as arrays take the type of what they meet; a program for them must not serve those with a type."""
    pair = Pair(jnp.arange(3.0, dtype=jnp.float32), "a")
    kinds = [programs.cached(doubled)(pair, two)[0].first.dtype for two in (jnp.asarray(2.0), jnp.asarray(2.0, "float64"))]
    assert kinds == ["float32", "float64"]


def test_values_of_numpy_scalars_share_a_program(folder):
    function = programs.cached(with_sign)
    signs = [np.float64(2.0), np.float64(-3.0), np.float32(-3.0)]
    assert [float(function(jnp.asarray(1.0), sign)) for sign in signs] == [1.0, -1.0, -1.0]
    assert len(function.stored.ready) == 2  # one for each type


def with_sign(x, sign):
    return jnp.copysign(x, sign)


def test_programs_that_were_not_used_for_longest_are_freed(folder, monkeypatch):
    monkeypatch.setattr(stored, "_functions", weakref.WeakSet())
    monkeypatch.setattr(stored, "MAX_PROGRAMS_IN_MEMORY", 3)
    function = programs.cached(doubled)

    def ask(name):
        found = function(Pair(jnp.arange(3.0), name), 2.0)
        assert found[0].name == name + "!" and found[0].first.tolist() == [0.0, 2.0, 4.0]
        return {program.result.flat[0][-2].removesuffix("!") for program in function.stored.ready.values()}

    for name in "abca":
        ask(name)
    freed = list(function.stored.ready.values())[1]
    assert freed.run._cache_size() == 1
    assert ask("d") == {"a", "c", "d"} and freed.run._cache_size() == 0
    assert ask("b") == {"a", "d", "b"} and traces == list("abcd")  # read again, not traced


def test_programs_beyond_the_memory_are_freed_and_read_again(folder, monkeypatch):
    monkeypatch.setattr(stored, "_functions", weakref.WeakSet())
    function = programs.cached(doubled)

    def ask(name):
        assert function(Pair(jnp.arange(3.0), name), 2.0)[0].first.tolist() == [0.0, 2.0, 4.0]
        return [program.result.flat[0][-2].removesuffix("!") for program in function.stored.ready.values()]

    ask("a")
    (file,), (program,) = folder.iterdir(), function.stored.ready.values()
    size = len(file.read_bytes().split(b"\n", 2)[2])
    assert 1.0 < (program.memory - stored.MEMORY_PER_PROGRAM) / size < stored.MEMORY_PER_COMPRESSED_BYTE
    monkeypatch.setattr(stored, "MAX_PROGRAM_MEMORY", 2.5 * program.memory)
    assert ask("b") == ["a", "b"] and ask("c") == ["b", "c"]
    assert ask("a") == ["c", "a"]
    monkeypatch.setattr(stored, "MAX_PROGRAM_MEMORY", 0.5 * program.memory)
    assert ask("d") == ["d"]  # the program in use stays
    assert traces == ["a", "b", "c", "d"]


def test_constants_hardly_count_as_memory_of_a_program(folder):
    """Three programs of an exact jam of 200 platforms contain 6 MB of constants; they were freed and compiled at each call."""
    small, large = (programs.cached(lambda x, count=count: x @ jnp.asarray(np.tri(count)[:, :3])[:3]) for count in (3, 1000))
    for function in (small, large):
        function(jnp.arange(3.0))
    (little,), (much,) = (function.stored.ready.values() for function in (small, large))
    assert much.memory < little.memory + 2**20


@pytest.mark.parametrize("reason", ["edited source", "class of another package", "no folder"])
def test_programs_that_cannot_be_stored_are_freed_too(folder, monkeypatch, reason):
    if reason == "edited source":
        monkeypatch.setattr(code_changes._code, "state", code_changes.CodeState(-1, False))
        monkeypatch.setattr(code_changes._code, "update", lambda: None)
    elif reason == "class of another package":
        structure.KNOWN_PACKAGES.discard(__name__)
    else:
        cache.set_program_folder(None)
    monkeypatch.setattr(stored, "_functions", weakref.WeakSet())
    function = programs.cached(doubled)

    def ask(name):
        found, sums = function(Pair(jnp.arange(3.0), name), 2.0)
        assert found.name == name + "!" and found.first.tolist() == [0.0, 2.0, 4.0] and float(sums["sum"]) == 3.0
        return [program.result.tree[0].name.removesuffix("!") for program in function.stored.ready.values()]

    ask("a")
    (program,) = function.stored.ready.values()
    assert stored.MEMORY_PER_PROGRAM < program.memory < stored.MEMORY_PER_PROGRAM + 5000 * stored.MEMORY_PER_COMPRESSED_BYTE
    monkeypatch.setattr(stored, "MAX_PROGRAM_MEMORY", 2.5 * program.memory)
    assert ask("b") == ["a", "b"] and ask("c") == ["b", "c"] and program.run._cache_size() == 0
    assert ask("b") == ["b", "c"] and ask("a") == ["b", "a"]
    assert traces == ["a", "b", "c", "a"] and not list(folder.iterdir())


@pytest.mark.parametrize("reason", ["class of another package", "no folder"])
def test_gradients_that_cannot_be_stored_are_freed_too(folder, monkeypatch, reason):
    structure.KNOWN_PACKAGES.discard(__name__)
    if reason == "no folder":
        cache.set_program_folder(None)
    function = programs.cached(doubled)
    monkeypatch.setattr(function.stored, "jitted", None)  # has a cache without a limit
    parts = [each.stored for each in (function, programs._vjp_forward, programs._vjp_backward)]
    monkeypatch.setattr(stored, "_functions", weakref.WeakSet(parts))
    monkeypatch.setattr(stored, "MAX_PROGRAM_MEMORY", 5 * stored.MEMORY_PER_PROGRAM)
    for name in ("a", "b", "c", "d", "e", "a"):
        slope = jax.grad(lambda x, name=name: function(Pair(x, name), 2.0)[0].first[1])(jnp.arange(3.0))
        assert slope.tolist() == [0.0, 2.0, 0.0]
        assert 2 <= sum(len(part.ready) for part in parts) <= 4
    assert len(traces) >= 6 and not list(folder.iterdir())


def test_a_stored_program_holds_no_trace(folder):
    """An exported program holds the function to differentiate it, and with it the trace; a deserialized one does not."""
    function = programs.cached(doubled)
    function(Pair(jnp.arange(3.0), "a"), 2.0)
    (program,) = function.stored.ready.values()
    (exported,) = (cell.cell_contents for cell in program.run.__wrapped__.__closure__)
    assert isinstance(exported, jax.export.Exported) and not exported.has_vjp()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak of the memory from /proc")
def test_memory_of_two_hundred_structures_is_bounded(tmp_path):
    """Jam modes with 1 to 200 balls; held all, their programs take 2.7 GB.

    `ru_maxrss` would be wrong: the kernel passes the peak of the process that starts a child, here pytest, on to the child.
    """
    code = """
import pathlib, sys
import jaxvib as jv

jv.use_cache(sys.argv[1])
for count in range(1, 201):
    scene = jv.Scene(
        jv.one_mass(mass=49.0, stiffness=4e4, damping=10.0),
        jv.balls(count=count, mass=1.0 / count, radius=0.1, drag=0.1),
        jv.ConstantSpeed(100.0),
    )
    jv.jam_modes(scene)
print(pathlib.Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 1_500_000  # kB


@pytest.mark.slow
def test_three_thousand_different_scenes_in_one_process(tmp_path):
    """XLA maps each program into dozens of areas of memory, and a process may have 65530 of them."""
    code = """
import pathlib, sys
import jaxvib as jv

jv.use_cache(sys.argv[1])
maps = pathlib.Path("/proc/self/maps")
for count in range(1, 3001):
    scene = jv.Scene(
        jv.one_mass(mass=49.0, stiffness=4e4, damping=10.0),
        jv.balls(count=count, mass=1.0 / count, radius=0.1, drag=0.1),
        jv.ConstantSpeed(100.0),
    )
    shapes = jv.mode_shapes(scene)
    if count % 100 == 0:
        areas = len(maps.read_text().splitlines()) if maps.exists() else 0
        print(count, float(shapes.frequency[0]), areas, flush=True)
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True)
    rows = [list(map(float, line.split())) for line in done.stdout.splitlines()]
    assert done.returncode == 0 and len(rows) == 30, (done.returncode, rows[-1:], done.stderr[-500:])
    np.testing.assert_allclose([row[1] for row in rows], np.sqrt(4e4 / 50.0), rtol=1e-5)
    assert max(row[2] for row in rows) < 10000, rows


@pytest.mark.parametrize("module", [jam, jv, optimize])
def test_the_key_holds_every_source_and_the_versions(module, monkeypatch):
    """A module of any folder, and those at the top of both packages."""
    text, read, changed = stored._sources(), pathlib.Path.read_bytes, pathlib.Path(module.__file__)
    assert importlib.metadata.version("jaxlib") in text and importlib.metadata.version("diffrax") in text
    assert code_changes.digest_of_sources() in text
    digest = code_changes.digest_of_sources.__wrapped__
    assert digest() == code_changes.digest_of_sources()
    monkeypatch.setattr(pathlib.Path, "read_bytes", lambda path: b"" if path == changed else read(path))
    assert digest() != code_changes.digest_of_sources()


def test_unchanged_programs_are_not_recompiled_after_an_edit(folder, monkeypatch):
    """JAX finds what it compiled by the program and its name."""
    texts = []
    for sources in ("these", "others"):
        monkeypatch.setattr(stored, "_sources", lambda sources=sources: sources)
        function = programs.cached(doubled)
        function(Pair(jnp.arange(3.0), "a"), 2.0)
        (program,) = function.stored.ready.values()
        texts.append(program.run.lower(jnp.arange(3.0)).as_text())
    assert len(traces) == len(list(folder.iterdir())) == 2 and texts[0] == texts[1]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[:100],
        lambda content: b"",
        lambda content: content[:-1] + bytes([content[-1] ^ 1]),
        lambda content: b"z" + content[1:],
        lambda content: b"cposix\nsystem\n(S'touch opened'\ntR.",
    ],
    ids=["short", "empty", "a bit of the program", "a digit of the sum", "a pickle"],
)
def test_a_damaged_program_is_written_anew(folder, damage):
    pair = Pair(jnp.arange(3.0), "a")
    programs.cached(doubled)(pair, 2.0)
    (file,) = folder.iterdir()
    sound = file.read_bytes()
    file.write_bytes(damage(sound))
    np.testing.assert_array_equal(programs.cached(doubled)(pair, 2.0)[0].first, [0.0, 2.0, 4.0])
    assert len(traces) == 2 and len(file.read_bytes()) == len(sound) and not pathlib.Path("opened").exists()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give a file away")
def test_a_program_of_another_user_is_not_read(folder):
    pair = Pair(jnp.arange(3.0), "a")
    programs.cached(doubled)(pair, 2.0)
    (file,) = folder.iterdir()
    os.chown(file, 12345, -1)
    programs.cached(doubled)(pair, 2.0)
    assert len(traces) == 2 and file.stat().st_uid == os.geteuid()


def test_what_cannot_be_stored_still_runs(folder):
    """A callback has no form on disk; a function made on the spot has no name; a class from outside may change unseen."""
    assert float(programs.cached(with_callback)(jnp.asarray(1.0))) == 2.0
    assert float(programs.cached(lambda f, x: f(x))(lambda x: 3.0 * x, jnp.asarray(1.0))) == 3.0
    with pytest.warns(UserWarning, match="static"):
        assert programs.cached(hidden)(jnp.asarray(1.0)).name.tolist() == [0, 1]
    structure.KNOWN_PACKAGES.discard(__name__)
    assert programs.cached(doubled)(Pair(jnp.arange(3.0), "a"), 2.0)[0].name == "a!"
    assert not list(folder.iterdir())


def test_checks_at_run_time_keep_no_program_from_the_disk(folder):
    """Checks of Equinox and diffrax become NaN in place of errors, which need a callback."""
    function = programs.cached(checked)
    assert float(function(jnp.asarray(2.0))) == 2.0 and np.isnan(function(jnp.asarray(-2.0)))
    assert len(list(folder.iterdir())) == 1
    with pytest.raises(RuntimeError, match="negative"):
        eqx.filter_jit(checked)(jnp.asarray(-2.0))  # elsewhere they stay errors


def checked(x):
    return eqx.error_if(x, x < 0.0, "negative")


def test_an_error_of_the_function_is_raised_once(folder):
    def fails(x):
        traces.append("fails")
        raise ValueError("the function's own")

    with pytest.raises(ValueError, match="the function's own"):
        programs.cached(fails)(jnp.asarray(1.0))
    assert traces == ["fails"]


@pytest.mark.parametrize("place", ["read-only", "not there", "full"])
def test_a_folder_that_cannot_be_written_to_does_no_harm(folder, place):
    """The disk is full for files of more than 100 bytes."""
    where = {"read-only": pathlib.Path("/proc"), "not there": folder / "no", "full": folder}[place]
    cache.set_program_folder(where)
    _, hard = limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        if place == "full":
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
        answer = programs.cached(doubled)(Pair(jnp.arange(3.0), "a"), 2.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    np.testing.assert_array_equal(answer[0].first, [0.0, 2.0, 4.0])
    assert not list(folder.iterdir())


def test_a_library_call_outlives_its_process(tmp_path):
    """LAPACK must be bound before a stored program calls it: JAX does that when it lowers the call of an exported program."""
    code = """
import sys, pathlib, jax, jax.numpy as jnp
from jaxvib.runtime import cache, programs
folder = pathlib.Path(sys.argv[1])
cache.use_cache(folder)
def values(x):
    print("traced")
    return jnp.linalg.eigvalsh(x @ x.T)
total = programs.cached(values)(jnp.arange(16.0).reshape(4, 4)).sum()
print(round(float(total)), len(list((folder / "programs").iterdir())))
"""
    # Where the developer's own environment names a folder for JAX's cache, `use_cache` leaves it there.
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    command, printed = [sys.executable, "-c", code, str(tmp_path)], []
    for _ in range(2):
        done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
        printed.append(done.stdout.split())
    assert printed == [["traced", "1240", "1"], ["1240", "1"]]
    assert [file for file in tmp_path.iterdir() if file.name.startswith("jit_values")]  # JAX's cache has what XLA made of it


def test_python_looks_for_no_garbage_while_a_program_is_traced(folder):
    before = gc.isenabled()
    with stored._no_garbage_collection():
        assert not gc.isenabled()
        with stored._no_garbage_collection():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled() == before
    gc.disable()
    try:
        with stored._no_garbage_collection():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_derivatives_go_through_cached_functions(folder):
    slope = jax.grad(lambda x: programs.cached(doubled)(Pair(x, "a"), 2.0)[0].first.sum())(jnp.arange(3.0))
    np.testing.assert_array_equal(slope, [2.0, 2.0, 2.0])


def test_jams_from_a_stored_program_are_the_same(folder):
    s = scene("two_mass", "balls")
    jv.jam_modes(s)
    jam.jams_of.stored.ready.clear()
    again = jv.jam_modes(s)
    cache.set_program_folder(None)
    traced = jv.jam_modes(s)
    assert jax.tree.structure(again) == jax.tree.structure(traced) and len(list(folder.iterdir())) == 1
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(traced), strict=True):
        assert jax.typeof(a) == jax.typeof(b)
        np.testing.assert_array_equal(a, b)


def test_no_stored_program_is_used_while_debugging(folder):
    root = programs.cached(jnp.sqrt)
    assert np.isnan(root(jnp.asarray(-1.0)))
    with jax.debug_nans(True), pytest.raises(FloatingPointError, match="invalid value"):
        root(jnp.asarray(-1.0))
    called = []
    sums = programs.cached(lambda x: called.append(type(x)) or x + 1.0)
    sums(jnp.asarray(1.0))
    with jax.disable_jit():
        assert sums(jnp.asarray(2.0)) == 3.0
    assert len(called) == 2 and not issubclass(called[1], jax.core.Tracer)
