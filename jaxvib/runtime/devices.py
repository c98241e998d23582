"""Accelerators that share the work of this process, and the assignment of one to each worker process."""

from __future__ import annotations

import functools
import hashlib
import itertools
import os
import tempfile
import threading
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from jaxvib.runtime.compat import traced

_VISIBILITY_VARIABLES = ("CUDA_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES")
"""Environment variables that restrict a process to some of the computer's accelerators."""

_DEVICE_LOCK = threading.Lock()


def jax_option(name: str) -> Any:
    """Return the value of an option of JAX, which type checkers do not know."""
    return getattr(jax.config, name)


def shared_devices() -> list[object]:
    """Return the accelerators that share this process's work; [None] for a single device, or if the caller chose one.

    The CPU counts as a single device, even if XLA divides it into several, because threads share its cores.
    """
    devices = jax.local_devices()
    chosen = jax_option("jax_default_device")
    return list(devices) if chosen is None and len(devices) > 1 and devices[0].platform != "cpu" else [None]


def is_cpu() -> bool:
    """Return True if JAX computes on the CPU at present, False on an accelerator."""
    chosen = jax_option("jax_default_device")
    return (chosen if isinstance(chosen, str) else (chosen or jax.local_devices()[0]).platform) == "cpu"


def numpy_if_known(value: ArrayLike) -> Any:
    """Convert a value to NumPy, because arithmetic on JAX arrays would compile a program; return a tracer unchanged."""
    return value if traced(value) else np.asarray(value)


def float_dtype() -> np.dtype:
    """Return the type of the floating-point numbers in which JAX computes at present."""
    return np.dtype(np.float64 if jax_option("jax_enable_x64") else np.float32)


def array_module(tree: PyTree) -> ModuleType:
    """Return the module `numpy`, or `jax.numpy` if a leaf of the tree is traced."""
    return jnp if any(map(traced, jax.tree.leaves(tree))) else np


def on_device(tree: PyTree) -> PyTree:
    """Copy NumPy's arrays and numbers in a tree to JAX's device.

    `jnp.asarray` is not used because it compiles a program for each shape.

    >>> on_device({"a": np.arange(2.0), "b": None})
    {'a': Array([0., 1.], dtype=float64), 'b': None}
    """
    leaves, structure = jax.tree.flatten(tree)
    moved = iter(jax.device_put([leaf for leaf in leaves if isinstance(leaf, (np.ndarray, np.generic))]))
    return structure.unflatten(next(moved) if isinstance(leaf, (np.ndarray, np.generic)) else leaf for leaf in leaves)


def arrays_on_device(leaves: Sequence[object]) -> list[Any]:
    """Copy NumPy's arrays among the leaves of a tree to JAX's device.

    Python's numbers are returned unchanged, because they are constants of programs.
    """
    arrays = [leaf for leaf in leaves if isinstance(leaf, np.ndarray)]
    moved = iter(jax.device_put(arrays) if arrays else ())
    return [next(moved) if isinstance(leaf, np.ndarray) else leaf for leaf in leaves]


def take_a_device() -> None:
    """Assign a separate accelerator to this worker process if the computer has several."""
    # Must be set before the first array: otherwise each worker reserves most of the memory of every accelerator.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    devices = jax.local_devices()
    if len(devices) > 1:
        with _DEVICE_LOCK:
            index = _worker_index()
        jax.config.update("jax_default_device", devices[index % len(devices)])


@functools.cache
def _worker_index() -> int:
    """Return the index of this process among the workers on this computer that see the same accelerators.

    A process reserves an index by locking a file. The system releases the lock when the process ends for any reason; the
    worker that replaces it then gets the same index and accelerator.
    """
    import fcntl  # does not exist on Windows, where JAX has no accelerators

    visible = hashlib.sha256(repr([os.environ.get(name) for name in _VISIBILITY_VARIABLES]).encode()).hexdigest()[:16]
    for index in itertools.count():
        path = os.path.join(tempfile.gettempdir(), f"jaxvib-worker-{os.getuid()}-{visible}-{index}")
        file = os.open(path, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o600)  # stays open until the process ends
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return index
        except BlockingIOError:
            os.close(file)
    raise AssertionError
