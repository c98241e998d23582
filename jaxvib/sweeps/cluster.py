"""Computation of chunks by Dask workers: processes on this computer, or a cluster with a scheduler at an address."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Generator, Iterable

import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.errors import InputError, optional_module
from jaxvib.runtime.devices import take_a_device
from jaxvib.sweeps.definition import CASE_STATUSES, Study
from jaxvib.sweeps.program import Chunk, compute
from jaxvib.sweeps.store import versions
from jaxvib.units import Number, number

_CHUNKS_PER_WORKER = 2
"""Number of submitted chunks for each worker: one in computation, one waiting."""

_STUDIES: dict[str, Study] = {}
"""Studies whose programs this worker has compiled."""


def on_a_cluster(
    study: Study, todo: Iterable[int], *, workers: int | None, scheduler: str | None, timeout: Number
) -> Generator[tuple[int, Chunk], None, None]:
    """Compute the chunks `todo` by workers, and yield the number and the results of each finished chunk.

    The calling process writes the results to the store; the workers do not access it.

    If a worker terminates, other workers compute its chunks. If several workers terminated while they computed the same chunk,
    the cases of this chunk have the status "lost".

    **Raises** `InputError` if Dask is not installed, the scheduler does not answer, no worker connects, or a worker has other
    versions of the packages than the store.
    """
    optional_module("distributed", "cluster")
    import dask.config
    from distributed import Client, LocalCluster, as_completed
    from distributed.scheduler import KilledWorker

    if workers is not None and scheduler is not None:
        raise InputError("scheduler", "cannot be combined with workers, which are processes on this computer; give one of them")
    seconds = float(number(timeout, "s", "timeout", low=0.0, open_low=True))
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            # Dask profiles its workers by default. This is half of their overhead, and its results are not used here.
            stack.enter_context(dask.config.set({"distributed.worker.profile.enabled": False}))
            options = {"dashboard_address": None, "silence_logs": 50}
            address = stack.enter_context(LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, **options))
        else:
            address = scheduler
        try:
            client = stack.enter_context(Client(address, timeout=seconds, set_as_default=False))
            client.wait_for_workers(1, timeout=seconds)
        except Exception as error:  # another server at that address may send anything
            problem = f"is {scheduler!r}, and no scheduler with workers answers there within {seconds:g} s"
            advice = "start one with: dask scheduler; dask worker ADDRESS"
            raise InputError("scheduler", f"{problem} ({_first_line(error)}); {advice}") from error
        # NumPy arrays, because a worker that unpacks JAX arrays before it enables double precision loses half their digits.
        picklable = dataclasses.replace(study, scene=jax.tree.map(np.asarray, study.scene))
        precise, chunks = jnp.result_type(float) == np.float64, iter(todo)
        running, numbers = as_completed(loop=client.loop), {}

        def submit_next() -> None:
            for chunk in chunks:
                future = client.submit(_compute_remotely, picklable, chunk, study.key, versions(), precise, pure=False)
                numbers[future.key] = chunk
                running.add(future)
                return

        for _ in range(_CHUNKS_PER_WORKER * max(1, len(client.scheduler_info(n_workers=-1)["workers"]))):
            submit_next()
        for future in running:
            chunk = numbers.pop(future.key)
            try:
                result = future.result()
            except KilledWorker:
                result = _lost_chunk(study, chunk)
            future.release()
            if isinstance(result, str):
                raise InputError("worker", f"{result}; install the same versions everywhere")
            submit_next()
            yield chunk, result


def _compute_remotely(study: Study, chunk: int, key: str, expected_versions: dict[str, str], is_double: bool) -> Chunk | str:
    """Compute the cases of a chunk on a worker.

    **Returns** the results; if versions differ from those in the store, a text about the difference.
    """
    for name, version in versions().items():
        if expected_versions[name] != version:
            return f"has {name} {version}, but the store was created with {expected_versions[name]}: digits may differ"
    jax.config.update("jax_enable_x64", is_double)
    take_a_device()
    if key not in _STUDIES:  # the first received copy is stored, because the program was compiled for its functions
        _STUDIES[key] = dataclasses.replace(study, scene=jax.tree.map(jnp.asarray, study.scene))
    return compute(_STUDIES[key], chunk)


def _lost_chunk(study: Study, chunk: int) -> Chunk:
    cases = int(np.prod([s.stop - s.start for s in study.grid.region(chunk)], dtype=np.int64))
    status = np.full(cases, CASE_STATUSES.index("lost"), np.uint8)
    return Chunk(dict(zip(study.names, study.placeholders(cases), strict=True)), status, {})


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]
