"""XLA's options for time integration on the CPU, which must be set before JAX starts."""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import re
from pathlib import Path

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted
from jaxvib.runtime.compat import accepted_flags, backend_started, loops_need_a_flag, wide_vectors_are_right

_EXTRA_OPTIONS_FLAG = "--xla_backend_extra_options="
_LOOP_OPTION = "xla_cpu_small_while_loop_byte_threshold"
"""Option of XLA: size, bytes, up to which a loop is compiled into one function."""

_CODE_GENERATOR_FLAG = "--xla_cpu_use_fusion_emitters=false"
"""Flag that selects XLA's older code generator: equally fast programs in two thirds of the compile time."""

_VECTOR_WIDTH_FLAG = "--xla_cpu_prefer_vector_width"


@validated
def prepare_cpu(devices: int | None = 1) -> str:
    """Set XLA's flags in the environment, before JAX computes anything.

    With jax before 0.12 the first use of a public name of jaxvib calls this function, unless JAXVIB_AUTOMATIC=off in the
    environment. Without the first of the flags below, XLA's CPU backend runs the body of all but the smallest loops as a chain
    of small functions. Time integration then takes many times as long; the time for steady states hardly changes. From 0.12 on
    XLA needs no flag for this, and jaxvib does not call this function. The flags, in `XLA_FLAGS`:

    - `xla_cpu_small_while_loop_byte_threshold=1000000000`, jax before 0.12: compiles a whole time loop into one function
    - `--xla_cpu_use_fusion_emitters=false`, jax before 0.11: a code generator that needs two thirds of the compile time
    - `--xla_cpu_prefer_vector_width=512` on CPUs with AVX-512, except with jax 0.11: batches of runs take 0.9 of the time
    - `--xla_force_host_platform_device_count` for several `devices`, for use in your own programs; jaxvib itself uses all
      cores without this flag

    OpenBLAS, which does the linear algebra of JAX and SciPy, is limited to one thread by OPENBLAS_NUM_THREADS=1, because its
    waiting threads take the cores from all other computations.

    Options that are already set are not changed. Flags that the installed jaxlib does not know are omitted, because XLA would
    end the process.

    **Arguments**: `devices`: number of CPU devices, at least 1; typical: 1 (the default); None: the number of cores that this
    process may use.

    **Returns** the flags. **Raises** `InputError` if JAX has computed already, because flags then have no effect, and for a
    number of devices below 1.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> _ = jnp.zeros(1)
    >>> jv.prepare_cpu()                    # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: prepare_cpu was called after JAX had begun to compute; call it before any array is created
    """
    if devices is None:
        devices = cores()
    if isinstance(devices, bool) or not isinstance(devices, int) or devices < 1:
        raise InputError("devices", f"is {quoted(devices)}; it must be a whole number, at least 1, or None for all cores")
    if backend_started():
        raise InputError("prepare_cpu", "was called after JAX had begun to compute; call it before any array is created")
    flags = os.environ.get("XLA_FLAGS", "").split()
    added = []
    if loops_need_a_flag():
        for index, flag in enumerate(flags):
            if flag.startswith(_EXTRA_OPTIONS_FLAG) and _LOOP_OPTION not in flag:
                flags[index] = f"{flag},{_LOOP_OPTION}=1000000000"
        if not any(_LOOP_OPTION in flag for flag in flags):
            added.append(f"{_EXTRA_OPTIONS_FLAG}{_LOOP_OPTION}=1000000000")
    added.append(_CODE_GENERATOR_FLAG)
    if devices > 1:
        added.append(f"--xla_force_host_platform_device_count={devices}")
    names = [flag.partition("=")[0] for flag in flags]
    flags += accepted_flags([flag for flag in added if flag.partition("=")[0] not in names])
    if re.search(r"\bavx512f\b", processor()) and _VECTOR_WIDTH_FLAG not in names and wide_vectors_are_right(flags):
        flags += accepted_flags([f"{_VECTOR_WIDTH_FLAG}=512"])
    os.environ["XLA_FLAGS"] = " ".join(flags)
    limit_blas_threads()
    return os.environ["XLA_FLAGS"]


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def limit_blas_threads() -> None:
    """Limit the linear algebra of JAX, which is SciPy's OpenBLAS, to one thread, unless OPENBLAS_NUM_THREADS is set.

    The threads of OpenBLAS wait for work in a busy loop and take the cores from all other computations: the solution of 50
    equations needs 14 ms of CPU time instead of 0.3 ms. If SciPy's linear algebra was imported before, this function has
    no effect.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def has_flags() -> bool:
    """Return True if time loops are compiled into one function: this jaxlib needs no flag, or XLA_FLAGS contains the flag."""
    return not loops_need_a_flag() or _LOOP_OPTION in os.environ.get("XLA_FLAGS", "")


@functools.cache
def processor() -> str:
    """Return the architecture and the name of the processor, with its instruction sets if the system lists them (Linux)."""
    features = ""
    with contextlib.suppress(OSError):  # Linux only
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        features = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    return f"{platform.machine()} {platform.processor()} {features}"
