"""The command line."""

from __future__ import annotations

import gc
import signal
import sys
import warnings

__all__ = ["main"]


def main() -> None:
    """The command `jaxvib`; exit code 0 done, 1 the computation failed, 2 bad input."""
    gc.disable()
    if sys.argv[1:] and not {"-h", "--help", "--version"} & set(sys.argv[1:]):
        prepare()
    from jaxvib.cli.app import run

    gc.freeze()  # modules stay: looking through them again and again, and at the end, takes a fifth of a short command
    gc.enable()
    try:
        code = run(sys.argv[1:])
    except KeyboardInterrupt:  # a second one, while the first was answered
        code = 1
    # Python now waits for threads that still compile. Another Ctrl-C would end that, and XLA under their feet: a crash.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    sys.exit(code)


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
