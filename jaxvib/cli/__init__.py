"""The command line."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import warnings
from types import FrameType

__all__ = ["main"]


def main() -> None:
    """The command `jaxvib`; exit code 0 done, 1 the computation failed, 2 bad input."""
    gc.disable()
    interrupts: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        interrupts.append(number)
        signal.default_int_handler(number, frame)

    signal.signal(signal.SIGINT, interrupt)
    try:
        if sys.argv[1:] and not {"-h", "--help", "--version"} & set(sys.argv[1:]):
            prepare()
        from jaxvib.cli.app import run

        gc.freeze()  # modules stay: looking through them again and again, and at the end, takes a fifth of a short command
        gc.enable()
        code = run(sys.argv[1:])
    except KeyboardInterrupt:  # before the command began, or a second one while the first was answered
        code = 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    if interrupts:
        _exit_at_once(code)
    sys.exit(code)


def _exit_at_once(code: int) -> None:
    """Leave the process to the system. Threads may still compile, and an orderly exit would destroy XLA under their feet: it
    does not wait for them, since CPython before 3.13 takes a thread for finished if joining it was interrupted."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def prepare() -> None:
    """Float64, and compiled programs cached on disk, so that the second call of a command answers at once."""
    from jaxvib.runtime.startup import start

    with warnings.catch_warnings(record=True) as found:
        start()
    import jax

    jax.config.update("jax_enable_x64", True)
    for warning in found:
        print(f"jaxvib: {warning.message}", file=sys.stderr)
    if found:  # nor in a folder that was refused
        jax.config.update("jax_compilation_cache_dir", None)
