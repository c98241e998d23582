"""Properties of JAX, XLA and diffrax that may change in a new version; each test names one."""

import importlib
import importlib.metadata
import json
import pathlib
import subprocess
import sys
import traceback
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import diffrax
import equinox.internal
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.runtime import compat
from jaxvib.runtime.operations import count_operations


def test_backend_starts_with_the_first_array():
    """jax._src.xla_bridge._backends."""
    code = """
import jax.numpy as jnp
from jaxvib.runtime.compat import backend_started
before = backend_started()
jnp.zeros(1)
print(before, backend_started())
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["False", "True"]


def test_tracers_are_recognized():
    """jax.core.Tracer."""

    def answers():
        found = []
        for transform in (jax.jit, jax.grad, jax.jacfwd):
            transform(lambda x: found.append(compat.traced(x)) or x)(1.0)
        return [*found, *map(compat.traced, (1.0, None, np.ones(2), jnp.ones(2)))]

    assert answers() == [True] * 3 + [False] * 4


def test_jaxprs_can_be_read_and_run():
    """jax.extend.core: jaxpr_as_fun, Literal, Jaxpr, ClosedJaxpr; the fields and the primitives of equations."""
    assert compat.HAS_JAXPRS
    closed = jax.make_jaxpr(lambda x: jnp.sin(x) + 2.0)(1.0)
    assert isinstance(closed, compat.ClosedJaxpr) and isinstance(closed.jaxpr, compat.Jaxpr)
    sine, plus = closed.jaxpr.eqns
    assert (sine.primitive.name, plus.primitive.name) == ("sin", "add")
    assert isinstance(plus.invars[1], compat.Literal) and plus.invars[1].val == 2.0
    (value,) = compat.jaxpr_as_fun(closed)(jnp.asarray(1.0))
    assert float(value) == float(sine.primitive.bind(jnp.asarray(1.0), **sine.params)) + 2.0


def test_programs_are_rewritten(monkeypatch):
    """ClosedJaxpr.replace, Jaxpr.replace, JaxprEqn.replace; and the same program where one of them is gone."""
    closed = jax.make_jaxpr(lambda x: (x * x) * (x * x))(1.0)
    first, second, last = closed.jaxpr.eqns
    asked = closed, [(first, first.invars), (last, [*first.outvars, *first.outvars])], closed.jaxpr.outvars
    shorter = compat.rewritten(*asked)
    assert len(shorter.jaxpr.eqns) == 2 and float(compat.jaxpr_as_fun(shorter)(jnp.asarray(2.0))[0]) == 16.0
    monkeypatch.delattr(type(first), "replace")
    assert compat.rewritten(*asked) is closed and second in closed.jaxpr.eqns


def test_known_numbers_are_computed_with_while_jax_transforms():
    """`jax.core.eval_context`."""
    seen = []

    def look(x):
        with compat.evaluating():
            seen.append(jnp.arange(3.0).sum())
        return x

    jax.jit(look)(1.0)
    assert not compat.traced(seen[0]) and float(seen[0]) == 3.0


def test_places_are_left_out_and_come_back():
    before = jax.config.jax_traceback_in_locations_limit
    with compat.without_source_locations():
        assert jax.config.jax_traceback_in_locations_limit == 0
    assert jax.config.jax_traceback_in_locations_limit == before != 0


def test_options_of_jax_can_be_read():
    """Attributes of jax.config; each changes the key of a cached program or where it is cached."""
    from jaxvib.runtime.stored import _OPTIONS, is_debugging

    assert jax.config.jax_enable_x64 is True and jax.config.jax_compilation_cache_dir
    assert all(hasattr(jax.config, name) for name in _OPTIONS) and not is_debugging()
    for option in (jax.disable_jit(), jax.debug_nans(True), jax.debug_infs(True)):
        with option:
            assert is_debugging()


def test_this_jaxlib_starts_with_the_flags_of_prepare_cpu():
    """Flags that XLA does not know end the process."""
    code = "import os; os.environ.pop('XLA_FLAGS', None); import jaxvib as jv; print(jv.prepare_cpu(2))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    flags = done.stdout.split()
    assert len(flags) >= 2 and compat.jax_starts_with(flags)


@pytest.mark.parametrize(("version", "known"), [("0.10.2", 2), ("0.11.2", 1), ("0.12.0", 1)])
def test_a_flag_that_jaxlib_has_no_more_is_left_out(monkeypatch, version, known):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    flags = ["--xla_cpu_prefer_vector_width=512", "--xla_cpu_use_fusion_emitters=false"]
    assert compat.accepted_flags(flags) == flags[:known]


def test_a_jaxlib_that_is_not_known_is_asked_once(tmp_path, monkeypatch):
    """The answer is remembered by version; a file of answers that is damaged is written anew."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    flags = ["--xla_force_host_platform_device_count=2", "--xla_no_such_flag=1"]
    assert compat.accepted_flags(flags) == flags  # a known version is not asked

    version = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "99.1.0" if name == "jaxlib" else version(name))
    (tmp_path / "jaxvib").mkdir()
    (tmp_path / "jaxvib" / "flags-99.1.0.json").write_text("{")
    assert compat.accepted_flags(flags) == flags[:1]
    assert json.loads((tmp_path / "jaxvib" / "flags-99.1.0.json").read_text()) == {flags[0]: True, flags[1]: False}
    monkeypatch.setattr(compat, "jax_starts_with", lambda flags: pytest.fail("asked again"))
    assert compat.accepted_flags(flags) == flags[:1]


def test_run_time_checks_are_switched_off_by_thread():
    """equinox._errors: branched_error_if_impl_jit; while one thread leaves its checks out, others come, go, and have theirs."""
    begun, ended = Barrier(2, timeout=60.0), Barrier(2, timeout=60.0)

    def unchecked():
        with compat.no_host_checks():
            begun.wait()
            answer = square_root(-1.0)
            ended.wait()
            return answer

    before = equinox._errors.branched_error_if_impl_jit
    with ThreadPoolExecutor(1) as pool:
        theirs = pool.submit(unchecked)
        begun.wait()
        with pytest.raises(RuntimeError, match="negative"):
            square_root(-1.0)
        with compat.no_host_checks():
            ended.wait()
            assert jnp.isnan(theirs.result())
            assert jnp.isnan(square_root(-2.0))
    assert equinox._errors.branched_error_if_impl_jit is before
    with pytest.raises(RuntimeError, match="negative"):
        square_root(-1.0)


def test_checks_without_errors_read_no_source_lines(monkeypatch):
    """equinox._errors.traceback_util.include_frame."""
    stacks = []
    monkeypatch.setattr(traceback, "format_tb", lambda *_: stacks.append(1) or [])

    def trace():
        jax.make_jaxpr(lambda x: equinox.error_if(x, x < 0.0, "not positive"))(1.0)

    with compat.no_host_checks():
        trace()
    assert not stacks
    trace()
    assert stacks


def square_root(x):
    return jax.jit(lambda x: jnp.sqrt(equinox.error_if(jnp.abs(x), x < 0.0, "negative")))(x)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@compat.no_host_checks()  # programs with these are compiled anew each time
def test_time_loops_find_their_end_at_once(dtype):
    """diffrax._integrate.loop: how it finds the time a hundred units in the last place before the end."""
    for x in (0.7, 1.0, 3e-30, 1e30, -2.0):
        below = number = jnp.asarray(x, dtype)
        for _ in range(100):
            below = equinox.internal.prevbefore(below)
        assert compat.ulps_below(number, 100) == below

    def run(max_steps):  # of each number diffrax keeps the traced loop
        term = diffrax.ODETerm(lambda t, y, args: -y)
        return lambda end: diffrax.diffeqsolve(
            term, diffrax.Heun(), 0 * end, end, end / 3, jnp.ones((), dtype), max_steps=max_steps
        ).ys[0]

    end = jnp.asarray(0.7, dtype)
    plain, expected = count_operations(run(100), end), run(100)(end)
    with compat.fast_diffrax_loop_end():
        assert plain - count_operations(run(101), end) > 290
        assert run(101)(end) == expected
    assert count_operations(run(102), end) == plain
    with ThreadPoolExecutor(4) as pool:  # sweeps trace in threads
        assert set(pool.map(short_in_a_thread, [run(k) for k in range(103, 111)], [end] * 8)) == {float(expected)}


def short_in_a_thread(run, end):
    with compat.fast_diffrax_loop_end():
        return float(run(end))


def test_time_loops_that_are_written_otherwise_stay(monkeypatch):
    loop = diffrax._integrate.loop
    monkeypatch.setattr(compat, "_source", lambda function: "")
    with compat.fast_diffrax_loop_end():
        assert diffrax._integrate.loop is loop


def test_members_of_enumerations_have_names():
    """equinox.Enumeration: _enumeration of a member, _name_to_item of the class; and the fallbacks where they are gone."""
    status = jv.RunStatus.where(jnp.asarray(True), jv.RunStatus.no_step, jv.RunStatus.done)
    assert status._enumeration is jv.RunStatus and compat.enumeration_of(status) is jv.RunStatus
    names = ("done", "max_steps_reached", "not_finite", "no_step", "not_accurate", "no_start", "beating", "creeping")
    names += ("would_separate", "refused", "overlapping")
    assert tuple(jv.RunStatus._name_to_item) == names and compat.enumeration_names(jv.RunStatus) == names

    class Bare:
        done = "it is done"
        other = "it is not"

    assert compat.enumeration_names(Bare) == ("done", "other")
    text = type("Item", (), {"__repr__": lambda self: repr(status)})()
    assert compat.enumeration_of(text) is jv.RunStatus


def test_private_modules_are_used_in_one_file_only():
    """No other module reaches into private or unstable parts of JAX and diffrax."""
    package = pathlib.Path(jv.__file__).parent
    private = (
        "jax._src",
        "jax.extend",
        "jax.core",
        "config.values",
        "eval_coeffs",
        "._enumeration",
        "_name_to_item",
    )
    found = {
        f"{path.relative_to(package)}: {name}"
        for path in package.rglob("*.py")
        for name in private
        if path.name != "compat.py" and name in path.read_text()
    }
    assert found == set()
