"""Many cases by one way: what is held, what stops, what the threads know, which devices they use."""

import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvib.runtime import parallel
from jaxvib.runtime.cache import set_program_folder
from jaxvib.runtime.programs import cached


def test_items_are_taken_as_there_is_room(monkeypatch):
    monkeypatch.setattr(parallel, "cores", lambda: 3)
    taken = []

    def items():
        for k in range(20):
            taken.append(k)
            yield k

    def computed(k):
        return k * k

    finished = 0
    for k, found in parallel.in_parallel(computed, items()):
        finished += 1
        assert found == k * k and len(taken) - finished <= 4
    assert finished == 20
    assert list(parallel.in_parallel(computed, [])) == []


def test_a_result_does_not_wait_for_other_items(monkeypatch):
    monkeypatch.setattr(parallel, "cores", lambda: 2)
    first_is_there = threading.Event()

    def computed(k):
        return k == 0 or first_is_there.wait(timeout=20.0)

    for k, in_time in parallel.in_parallel(computed, [0, 1]):
        assert in_time, "the second item ended before the result of the first was given"
        if k == 0:
            first_is_there.set()


def test_an_error_ends_it_and_what_has_not_begun_is_not_computed(monkeypatch):
    monkeypatch.setattr(parallel, "cores", lambda: 2)
    begun = []

    def computed(k):
        begun.append(k)
        if k == 3:
            raise KeyError("three")

    with pytest.raises(KeyError, match="three"):
        list(parallel.in_parallel(computed, range(1000)))
    assert len(begun) < 20
    with pytest.raises(KeyboardInterrupt):
        for _ in parallel.in_parallel(lambda k: begun.append(k), range(1000, 2000)):
            raise KeyboardInterrupt
    assert len(begun) < 30


@pytest.mark.parametrize("stored", [True, False])
def test_threads_compile_a_new_program_once(monkeypatch, tmp_path, unwatched, stored):
    monkeypatch.setattr(parallel, "cores", lambda: 4)
    set_program_folder(tmp_path if stored else None)
    traces, compiled = [], []

    def listen(event, seconds, **_):
        compiled.extend([event] * (event == "/jax/core/compile/backend_compile_duration"))

    def tripled(x):
        traces.append(threading.get_ident())
        time.sleep(0.1)  # until the other threads ask for the same program
        return 3.0 * x

    function = cached(tripled)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        found = parallel.in_threads(lambda k: function(np.full(2, float(k))).tolist(), 4)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert found == [[3.0 * k] * 2 for k in range(4)]
    assert len(traces) == 1 and len(compiled) == 1
    assert len(list(tmp_path.iterdir())) == stored


def test_items_are_computed_side_by_side(monkeypatch):
    monkeypatch.setattr(parallel, "cores", lambda: 2)
    both = threading.Barrier(2, timeout=20.0)
    assert sorted(parallel.in_threads(lambda _: both.wait(), 2)) == [0, 1]
    assert sorted(found for _, found in parallel.in_parallel(lambda _: both.wait(), range(2))) == [0, 1]


def test_an_error_in_a_chunk_ends_all_threads(monkeypatch):
    monkeypatch.setattr(parallel, "cores", lambda: 3)
    begun = []

    def computed(x):
        begun.append(x[0])
        if x[0] == 5.0:
            raise KeyError("five")
        return x

    with pytest.raises(KeyError, match="five"):
        parallel.in_chunks(1, computed, np.arange(1000.0))
    assert len(begun) < 30


def test_nobody_waits_for_a_thread_that_has_not_begun(monkeypatch):
    """The calling thread computes everything if all others are busy, for example with work that needs threads itself."""
    pool, free = ThreadPoolExecutor(1), threading.Event()
    monkeypatch.setattr(parallel, "_threads", lambda: pool)
    busy = pool.submit(free.wait)

    def squared(k):
        return k * k, threading.current_thread()

    try:
        assert parallel.in_threads(squared, 3) == [(k * k, threading.current_thread()) for k in range(3)]
        assert not busy.done()
    finally:
        free.set()
        pool.shutdown()


def test_threads_have_the_options_of_the_caller():
    def kind(_):
        return jnp.zeros(1).dtype.name, jnp.result_type(float).name

    with jax.enable_x64(False):
        assert {found for _, found in parallel.in_parallel(kind, range(5))} == {("float32", "float32")}
    assert {found for _, found in parallel.in_parallel(kind, range(5))} == {("float64", "float64")}


@pytest.mark.parametrize("count", [1, 4, 5, 13])
def test_chunks_are_put_together_in_their_order(count):
    sizes = []

    def function(x, y, common):
        sizes.append(x["a"].shape)
        return {"sum": x["a"] + y[:, 0] + common, "pair": jnp.stack([x["a"], x["a"]], axis=1)}

    x, y = {"a": np.arange(count, dtype=float)}, jnp.arange(2.0 * count).reshape(count, 2)
    found = parallel.in_chunks(4, function, x, y, shared=(1.0,))
    np.testing.assert_array_equal(found["sum"], 3.0 * np.arange(count) + 1.0)
    assert found["pair"].shape == (count, 2) and set(sizes) == {(4,)}


def test_chunks_within_a_transformation():
    def total(scale):
        return parallel.in_chunks(4, lambda x, scale: jnp.sin(scale * x), np.arange(10.0), shared=(scale,))

    value, slope = jax.jvp(total, (2.0,), (1.0,))
    np.testing.assert_allclose(value, np.sin(2.0 * np.arange(10.0)), rtol=1e-14)
    np.testing.assert_allclose(slope, np.arange(10.0) * np.cos(2.0 * np.arange(10.0)), rtol=1e-14)


def test_all_accelerators_are_used_and_their_programs_stored(tmp_path):
    """Three devices that XLA makes of the CPU stand for them."""
    code = f"""
import jaxvib as jv
jv.prepare_cpu(3)
jv.use_cache({str(tmp_path)!r})
import jax, jax.numpy as jnp
from jaxvib import code_changes
from jaxvib.runtime import cache, parallel, programs
assert parallel.shared_devices() == [None]  # CPUs are one, however they are divided
parallel.shared_devices = jax.local_devices
code_changes._code.differences = list  # as `unwatched`

def doubled(x):
    return 2.0 * x

function = programs.cached(doubled)
doubled.__module__ = "jaxvib.doubled"
for k, found in parallel.in_parallel(lambda k: function(jnp.full(2, float(k))), range(7)):
    assert found.devices() == {{jax.devices()[k % 3]}} and found.tolist() == [2.0 * k] * 2, (k, found.devices())
assert None not in function.stored.ready.values() and len(list(cache.program_folder().glob("*.program"))) == 1
"""
    subprocess.run([sys.executable, "-c", code], check=True)


WORKER = """
import sys
import jax, jax.numpy as jnp
from jaxvib.runtime.devices import take_a_device
take_a_device()
print(jnp.zeros(1).devices().pop().id, flush=True)
sys.stdin.read()
"""


def test_workers_of_a_machine_have_a_device_each(tmp_path):
    """Two devices that XLA makes of the CPU stand for accelerators; who comes in place of a dead worker has its own."""
    more = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "TMPDIR": str(tmp_path)}

    def worker():
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        return subprocess.Popen([sys.executable, "-c", WORKER], env=os.environ | more, **pipes)

    workers = [worker(), worker()]
    devices = [int(one.stdout.readline()) for one in workers]
    assert sorted(devices) == [0, 1]
    workers[0].kill()
    workers[0].communicate()
    workers += [worker(), worker()]  # more workers than devices share them
    assert sorted(int(one.stdout.readline()) for one in workers[2:]) == sorted([devices[0], 0])
    for one in workers[1:]:
        one.communicate("")
        assert one.returncode == 0


def test_no_case_at_all_has_a_result_of_its_form():
    found = parallel.in_chunks(4, lambda x, y: {"sum": x + y, "low": x[:, 0] < y}, np.zeros((0, 2)), shared=(1.0,))
    assert found["sum"].shape == (0, 2) and found["low"].shape == (0,) and found["low"].dtype == bool
    assert jax.jit(lambda x: parallel.in_chunks(4, jnp.sin, x))(jnp.zeros((0, 3))).shape == (0, 3)
