"""JAX's CPU backend made ready for time loops, before it starts."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import sys
from pathlib import Path

from jaxvib.errors import InputError

__all__ = ["prepare_cpu", "processor"]

_LOOPS = "xla_cpu_small_while_loop_byte_threshold"


def prepare_cpu(devices: int | None = 1) -> str:
    """Lets XLA compile a whole time loop into one function; call it before JAX computes anything.

    Without it XLA's CPU backend (jax before 0.12) runs the body of all but the smallest loops as a chain of small functions,
    and time integration takes many times as long; steady answers hardly change. It can be set in the environment only, as

        XLA_FLAGS="--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000 ..."

    which this does for you: it also asks for vectors of 512 bits where the processor has them, and for `devices` devices in one
    process, over which `ensemble` spreads its runs. What the environment says already is left as it is.

    **Arguments**: `devices`, 1 unless said otherwise; None: as many as this process may use cores.

    **Returns** the flags. **Raises** `InputError` where JAX has begun to compute already, so that they would go unheard, or
    for a number of devices below 1.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> _ = jnp.zeros(1)
    >>> jv.prepare_cpu()                    # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: prepare_cpu comes too late, JAX has begun to compute; call it before any array is made
    """
    if devices is None:
        devices = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    if isinstance(devices, bool) or not isinstance(devices, int) or devices < 1:
        raise InputError("devices", f"is {devices!r}; it must be a whole number, at least 1, or None for all cores")
    if _started():
        raise InputError("prepare_cpu", "comes too late, JAX has begun to compute; call it before any array is made")
    flags = os.environ.get("XLA_FLAGS", "").split()
    options = [f"{_LOOPS}=1000000000"]
    for place, flag in enumerate(flags):
        if flag.startswith("--xla_backend_extra_options="):
            if _LOOPS not in flag:
                flags[place] = f"{flag},{options[0]}"
            options = []
    flags += [f"--xla_backend_extra_options={option}" for option in options]
    wanted = {"xla_force_host_platform_device_count": devices if devices > 1 else None}
    wanted["xla_cpu_prefer_vector_width"] = 512 if _has_wide_vectors() else None
    for name, value in wanted.items():
        if value is not None and not any(flag.startswith(f"--{name}=") for flag in flags):
            flags.append(f"--{name}={value}")
    os.environ["XLA_FLAGS"] = " ".join(flags)
    return os.environ["XLA_FLAGS"]


def _started() -> bool:
    """Whether JAX has a backend already; there is no public way to ask without starting one."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and bool(getattr(bridge, "_backends", None))


def _has_wide_vectors() -> bool:
    return re.search(r"\bavx512f\b", processor()) is not None


def processor() -> str:
    """The kind of processor this is, with its instruction sets where the system tells them."""
    told = ""
    with contextlib.suppress(OSError):  # Linux only
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        told = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    return f"{platform.machine()} {platform.processor()} {told}"
