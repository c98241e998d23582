"""Start of the command `jaxvib`, and its response to interrupts (Ctrl-C)."""

from __future__ import annotations

import _thread
import contextlib
import gc
import os
import signal
import sys
import threading
import warnings
from importlib.machinery import ExtensionFileLoader
from types import FrameType

_REPEAT_DELAY = 0.05
"""Time, s, after which an interrupt is repeated if it could not be handled."""


_USING_INTERRUPTS = ("optimize", "sweep", "explore")
"""Commands that handle an interrupt as an exception: they report what is finished, or end a server."""


def main() -> None:
    """Run the command `jaxvib`. The exit code is 0 for success, 1 for a failed computation, 2 for bad input.

    Except for the commands in `_USING_INTERRUPTS`, interrupts are handled by `jaxvib_command`.
    """
    gc.disable()
    interrupts: list[int] = []
    try:
        if sys.argv[1:] and not {"-h", "--help", "--version"} & set(sys.argv[1:]):
            prepare()
        from jaxvib.cli.app import run

        gc.freeze()  # garbage collection of the modules would take one fifth of the time of a short command
        gc.enable()
        if sys.argv[1:] and sys.argv[1] in _USING_INTERRUPTS:
            _raise_interrupts(interrupts)
        code = run(sys.argv[1:])
    except KeyboardInterrupt:  # a second interrupt while the first was handled
        print("\njaxvib: interrupted", file=sys.stderr)
        code = 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    if interrupts:
        _exit_at_once(code)
    sys.exit(code)


def _raise_interrupts(interrupts: list[int]) -> None:
    """Raise KeyboardInterrupt in the main thread at each interrupt, which is added to a list."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        interrupts.append(number)
        if _is_loading_extension(frame):
            _interrupt_later()
        else:
            signal.default_int_handler(number, frame)

    signal.signal(signal.SIGINT, interrupt)
    signal.set_wakeup_fd(-1)
    sys.unraisablehook = _repeat_lost_interrupt


def _is_loading_extension(frame: FrameType | None) -> bool:
    """Return True while an extension module is imported. Some of them, such as that of XLA, crash if an exception is raised
    during their import."""
    while frame is not None:
        if isinstance(frame.f_locals.get("self"), ExtensionFileLoader):
            return True
        frame = frame.f_back
    return False


def _repeat_lost_interrupt(lost: sys.UnraisableHookArgs) -> None:
    """Interrupt again if Python discarded an interrupt. Python discards exceptions in callbacks of weak references and of C.

    The default hook would only print the interrupt, and the command would continue.
    """
    if issubclass(lost.exc_type, KeyboardInterrupt):
        _interrupt_later()
    else:
        sys.__unraisablehook__(lost)


def _interrupt_later() -> None:
    timer = threading.Timer(_REPEAT_DELAY, _interrupt_main_thread)
    timer.daemon = True
    timer.start()


def _interrupt_main_thread() -> None:
    if sys.platform == "win32":
        _thread.interrupt_main()
    else:  # also ends a sleep of the main thread
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


def _exit_at_once(code: int) -> None:
    """Exit without cleanup of the interpreter.

    Threads may still be compiling. A normal exit would destroy XLA while the threads use it: if an earlier join of a thread was
    interrupted, CPython before 3.13 regards this thread as finished and does not wait for it.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def prepare() -> None:
    """Enable double precision, and the cache of compiled programs on disk, which makes later calls of a command fast."""
    from jaxvib.runtime.startup import start

    with warnings.catch_warnings(record=True) as found:
        start()
    import jax

    jax.config.update("jax_enable_x64", True)
    for warning in found:
        print(f"jaxvib: {warning.message}", file=sys.stderr)
    if found:  # JAX must not use a folder that was rejected as its cache
        jax.config.update("jax_compilation_cache_dir", None)
