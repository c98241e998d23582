"""Starts the page on this computer."""

from __future__ import annotations

import importlib.util
import os
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path

from jaxvib.errors import InputError

__all__ = ["leave", "require_free", "require_marimo", "serve", "served_path"]

_VARIABLE = "JAXVIB_EXPLORE"
"""The environment variable by which the page hears of the scene file."""

_HOST = "127.0.0.1"
"""Nobody else reaches the page."""


def served_path() -> Path:
    """The scene file of the page that is being served. **Raises** `InputError` where none is."""
    path = os.environ.get(_VARIABLE)
    if not path:
        raise InputError(_VARIABLE, "is not set; start the page with: jaxvib explore machine.toml")
    return Path(path)


def require_marimo() -> None:
    """**Raises** `InputError` where marimo, which shows the page, is not installed."""
    if importlib.util.find_spec("marimo") is None:
        raise InputError("explore", "needs marimo; install it with: pip install 'jaxvib[explore]'")


def require_free(port: int) -> None:
    """**Raises** `InputError` where another program listens at that port of this computer, or none may."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as tried:
        # As the server does: a port that a page left a minute ago is free.
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(os.name == "posix"))
        try:
            tried.bind((_HOST, port))
        except OSError as error:
            raise InputError(
                "--port", f"is {port}, which cannot be used ({error.strerror}); name another, such as --port {port % 60000 + 1}"
            ) from error


def serve(scene: Path, port: int, browser: bool, said: Callable[[str], None]) -> None:
    """Serves the page of a scene file until it is interrupted, and ends the process.

    **Arguments**: `scene` file; `port` of this computer; whether to open a `browser`; `said` is told where the page is.

    **Raises** `InputError` where marimo is not installed or the port is taken.
    """
    require_marimo()
    require_free(port)
    import marimo  # an extra, and slow to import
    import uvicorn  # marimo's own server

    os.environ[_VARIABLE] = str(scene.resolve())
    page = marimo.create_asgi_app(quiet=True).with_app(path="", root=str(Path(__file__).with_name("page.py"))).build()
    address = f"http://{_HOST}:{port}"
    said(address)
    if browser:
        opener = threading.Timer(1.0, webbrowser.open, [address])
        opener.daemon = True
        opener.start()
    uvicorn.run(page, host=_HOST, port=port, log_level="warning", timeout_graceful_shutdown=1)
    leave()


def leave() -> None:
    """Ends the process: marimo's threads would wait for pages that are still open."""
    sys.stdout.flush()
    os._exit(0)
