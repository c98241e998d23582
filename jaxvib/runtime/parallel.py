"""Parallel evaluation of many cases on all cores and accelerators, with one compiled program for all chunks.

Sweeps, ensembles, run-ups, maps and searches use it. `in_parallel` is for cases with Python code between compiled programs (a
diagram, a criterion). `in_chunks` is for cases that are entries of arrays; it pads the last chunk, and therefore uses the same
program for any number of cases.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import operator
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxvib.runtime.compat import traced
from jaxvib.runtime.cpu import cores
from jaxvib.runtime.devices import shared_devices
from jaxvib.runtime.stored import is_debugging

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

_OPTIONS = {
    "jax_enable_x64": jax.enable_x64,
    "jax_numpy_rank_promotion": jax.numpy_rank_promotion,
    "jax_numpy_dtype_promotion": jax.numpy_dtype_promotion,
    "jax_default_matmul_precision": jax.default_matmul_precision,
    "jax_default_device": jax.default_device,
}
"""JAX's options on which results depend, and the context managers that set them in one thread."""


def in_parallel(function: Callable[[Item], Outcome], items: Iterable[Item]) -> Generator[tuple[Item, Outcome], None, None]:
    """Evaluate a function of many items in threads, on all cores and accelerators; yield each item with its result.

    Results come in the order in which they are finished. Threads that need the same new program wait for the thread that
    compiles it. The number of items in progress exceeds the number of threads by at most one, and therefore memory does not
    grow with the number of items. JAX's options are those of the caller's thread. After an error of the function or of the
    consumer of the results, no further item is computed.

    >>> sorted(in_parallel(lambda x: x * x, [3, 1, 2]))
    [(1, 1), (2, 4), (3, 9)]
    """
    remaining, devices = iter(items), itertools.cycle(shared_devices())
    with_options, threads = _same_options(function), cores()
    pool = ThreadPoolExecutor(threads)
    running: dict[Future[Outcome], Item] = {}

    try:
        while True:
            for item in itertools.islice(remaining, threads + 1 - len(running)):
                running[pool.submit(with_options, item, next(devices))] = item
            if not running:
                return
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                yield running.pop(future), future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _same_options(function: Callable[[Item], Outcome]) -> Callable[[Item, object], Outcome]:
    """Return a function of an item and a device that calls `function` with the JAX options of the current thread."""
    wanted = {name: getattr(jax.config, name) for name in _OPTIONS}

    def with_options(item: Item, device: object) -> Outcome:
        with contextlib.ExitStack() as stack:
            for name, value in (wanted if device is None else wanted | {"jax_default_device": device}).items():
                if getattr(jax.config, name) != value:  # setting an option makes JAX trace programs again
                    stack.enter_context(_OPTIONS[name](value))
            return function(item)

    return with_options


def in_chunks(
    size: int, function: Callable[..., PyTree], *cases: PyTree, shared: tuple[PyTree, ...] = ()
) -> PyTree[np.ndarray]:
    """Evaluate a function for any number of cases, `size` at a time, and concatenate the results in their order.

    The last chunk is padded with copies of the last case. Under a JAX transformation the chunks are computed one after another
    within the program.

    **Arguments**: `function` of trees of arrays (size, ...) and of the `shared` values; `cases`: trees of arrays (n, ...).

    **Returns** the tree of the function's results with NumPy arrays (n, ...), or with JAX arrays under a transformation.

    >>> in_chunks(4, lambda x, y: {"sum": x + y}, np.arange(6.0), shared=(1.0,))
    {'sum': array([1., 2., 3., 4., 5., 6.])}
    """
    count = jax.tree.leaves(cases)[0].shape[0]
    if count == 0:
        rows = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((size, *leaf.shape[1:]), leaf.dtype), cases)
        like = jax.eval_shape(lambda *rows: function(*rows, *shared), *rows)
        return jax.tree.map(lambda leaf: np.zeros((0, *leaf.shape[1:]), leaf.dtype), like)
    chunks = -(-count // size)
    index = np.minimum(np.arange(chunks * size), count - 1).reshape(chunks, size)
    if any(traced(leaf) for leaf in jax.tree.leaves((cases, shared))):

        def evaluate_traced(rows: jax.Array) -> PyTree[jax.Array]:
            return function(*jax.tree.map(lambda leaf: jnp.asarray(leaf)[rows], cases), *shared)

        results = jax.lax.map(evaluate_traced, jnp.asarray(index))
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], results)
    known_cases = jax.tree.map(np.asarray, cases)

    def evaluate(chunk: int) -> PyTree[np.ndarray]:
        result = function(*jax.tree.map(lambda leaf: leaf[index[chunk]], known_cases), *shared)
        return jax.tree.map(np.asarray, result)

    parts = in_threads(evaluate, chunks, shared_devices())
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)


def in_threads(function: Callable[[int], Outcome], number: int, devices: Sequence[object] = (None,)) -> list[Outcome]:
    """Return the function's results for 0, 1, ..., `number` - 1, in this order, computed in threads.

    Each thread, including the caller's, takes the next number when it is free, which is faster than a submission of each item
    to the pool. Each thread uses one of the `devices`. Options and errors are treated as in `in_parallel`. If JAX is debugging
    (operation by operation, or with checks for NaN), the caller's thread computes everything.

    >>> in_threads(lambda k: k * k, 3)
    [0, 1, 4]
    """
    if is_debugging():
        return [function(k) for k in range(number)]
    with_options = _same_options(function)
    workers = min(max(cores(), len(devices)), number)
    remaining, outcomes, failures = iter(range(number)), [], []

    def work(worker: int) -> None:
        try:
            for k in remaining:
                if failures:
                    break
                outcomes.append((k, with_options(k, devices[worker % len(devices)])))
        except BaseException:
            failures.append(True)
            raise

    others = [_threads().submit(work, k) for k in range(1, workers)]
    try:
        work(0)
    finally:
        begun = [other for other in others if not other.cancel()]
        wait(begun)
    for other in begun:
        other.result()
    return [value for _, value in sorted(outcomes, key=lambda outcome: outcome[0])]


def in_background(*tasks: Callable[[], object]) -> None:
    """Begin tasks in threads, with the JAX options of this thread, without waiting for them; their errors are ignored.

    This reduces the time of the first evaluation of a function that calls several `cached` functions one after the other. The
    programs of the later functions are known before their arguments have values, and can be compiled at the same time:
    `task = lambda: integrate.prepare(...)`. A later call of the `cached` function waits for its program, and raises the error
    if there was one.
    """
    with_options = _same_options(operator.call)
    for task in tasks:
        _threads().submit(with_options, task, None)


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Return the pool of threads other than the caller's, which is reused because starting threads takes longer than submitting
    a run. Callers cancel tasks that have not begun instead of waiting; therefore a task may itself use threads."""
    return ThreadPoolExecutor(max(64, cores()))
