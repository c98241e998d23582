"""Entry point of the command `jaxvib`.

Ctrl-C ends a command at once, from the first import on, and also within a compiled program. The exception KeyboardInterrupt
cannot do this: the main thread receives it only after the compiled program, Python discards it in some callbacks, and some
extension modules crash if it is raised within them. Commands that use an interrupt, such as a search that then returns its best
design, replace this behaviour when they begin (see `jaxvib.cli.main`).

This module is outside the package `jaxvib` because an interrupt must also end the import of the package.
"""

import os
import sys

_MESSAGE = "\njaxvib: interrupted\n"

_DOCUMENT = """{
  "error": {
    "kind": "computation",
    "status": "interrupted",
    "message": "interrupted"
  }
}
"""
"""JSON document of an interrupted command, as `jaxvib.cli.app` prints it."""


def main() -> None:
    """Run the command line. An interrupt ends the process with one line on stderr and exit code 1."""
    # XLA writes a warning addressed to its developers on stderr if a program compiles in more than two minutes. Its other
    # messages of this level are raised as exceptions too.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    try:
        _end_at_interrupts()
    except KeyboardInterrupt:
        _end()
    from jaxvib.cli import main as run

    run()


def _end_at_interrupts() -> None:
    """End the process at an interrupt, whatever its main thread does."""
    import signal
    import threading

    if not hasattr(os, "set_blocking"):  # Windows with Python 3.11
        signal.signal(signal.SIGINT, lambda *_: _end())
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def wait() -> None:
        while os.read(reading, 1)[0] != signal.SIGINT:
            pass
        _end()

    threading.Thread(target=wait, daemon=True).start()
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, lambda *_: None)  # the thread ends the process


def _end() -> None:
    """End the process without cleanup: other threads may be compiling, and XLA must not be destroyed while they do."""
    if sys.stderr.isatty():  # remove a progress bar, and show the cursor that it hid
        os.write(2, b"\r\x1b[K\x1b[?25h")
    os.write(2, _MESSAGE.encode())
    if "--json" in sys.argv:
        os.write(1, _DOCUMENT.encode())
    os._exit(1)
