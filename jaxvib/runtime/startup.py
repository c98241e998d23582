"""Settings of a process before the first computation: XLA's options for the CPU, and the cache of compiled programs."""

from __future__ import annotations

import functools
import os
import warnings

from jaxvib.errors import InputError
from jaxvib.runtime.cache import use_cache
from jaxvib.runtime.compat import backend_started
from jaxvib.runtime.cpu import has_flags, limit_blas_threads, prepare_cpu


@functools.cache
def start() -> None:
    """Call `prepare_cpu()` and `use_cache()`, unless they were called before or JAXVIB_AUTOMATIC=off in the environment.

    `prepare_cpu` is called only with versions of XLA that need its flags. `start` is called when the first part of a scene is
    made, and by the first use of a public name of jaxvib other than errors and names of `jaxvib.runtime`. It issues a warning

    - with such a version, if JAX has already begun to compute, because XLA's options then have no effect
    - if programs cannot be cached
    """
    if os.environ.get("JAXVIB_AUTOMATIC", "").lower() in ("off", "0", "no", "false"):
        return
    limit_blas_threads()
    if not has_flags():
        if backend_started():
            warnings.warn(
                "JAX began to compute before jaxvib was used: in this process, time integration "
                "takes about 10 times as long and "
                "compilation 1.5 times as long. Call jaxvib.prepare_cpu() before any array is created, "
                "or switch this warning off by "
                "JAXVIB_AUTOMATIC=off in the environment",
                stacklevel=3,
            )
        else:
            prepare_cpu()
    try:
        use_cache(only_if_unset=True)
    except InputError as error:
        warnings.warn(f"programs are not cached: {error}", stacklevel=3)
