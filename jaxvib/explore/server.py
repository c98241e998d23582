"""Server of the page of `jaxvib explore`. It listens only on this computer.

A browser lets every open web site send requests to servers on the same computer. The address of the page therefore contains a
random token. A request is answered only if it has this token, names this computer as its host, and comes from the page.
"""

from __future__ import annotations

import hmac
import importlib.util
import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Awaitable, Callable, MutableMapping
from pathlib import Path
from typing import Any, TypeAlias

from jaxvib.errors import InputError

_Message: TypeAlias = "MutableMapping[str, Any]"
_Send: TypeAlias = "Callable[[_Message], Awaitable[None]]"
_Receive: TypeAlias = "Callable[[], Awaitable[_Message]]"
_Page: TypeAlias = "Callable[[_Message, _Receive, _Send], Awaitable[None]]"
"""Type of an ASGI application."""

_PATH_VARIABLE = "JAXVIB_EXPLORE"
"""Environment variable with the path of the scene file."""

_HOST = "127.0.0.1"
"""Loopback address, which other computers cannot reach."""


def served_path() -> Path:
    """Return the path of the scene file of the page. **Raises** `InputError` if no page is being served."""
    path = os.environ.get(_PATH_VARIABLE)
    if not path:
        raise InputError(_PATH_VARIABLE, "is not set; start the page with: jaxvib explore machine.toml")
    return Path(path)


def require_marimo() -> None:
    """**Raises** `InputError` if marimo, which shows the page, is not installed."""
    if importlib.util.find_spec("marimo") is None:
        raise InputError(
            "explore", "needs marimo; install it with: pip install '.[explore]' (in the folder of jaxvib's sources)"
        )


def require_free(port: int) -> None:
    """**Raises** `InputError` if another program listens at the `port`, or if this process may not use it."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listener:
        # The server sets this option too. With it, a port that another page has just released counts as free.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(os.name == "posix"))
        try:
            listener.bind((_HOST, port))
        except OSError as error:
            raise InputError(
                "--port", f"is {port}, which cannot be used ({error.strerror}); name another, such as --port {port % 60000 + 1}"
            ) from error


def guarded(page: _Page, token: str, port: int) -> _Page:
    """Return an ASGI application that forwards only requests to `/token/` from the page itself.

    Other requests receive an empty 404, and other websockets are refused.

    The header Host must name this computer and `port`. This rejects sites whose name points to this computer (DNS rebinding).
    Browsers add the header Origin to all websockets, and to those requests of other sites that send data or read the answer;
    if the header is present, it must agree with Host.
    """
    hosts = [f"{name}:{port}".encode() for name in (_HOST, "localhost")]

    def is_own(scope: _Message) -> bool:
        host_headers = [value for name, value in scope["headers"] if name.lower() == b"host"]
        origins = [value for name, value in scope["headers"] if name.lower() == b"origin"]
        first = scope["path"].encode().split(b"/")[1:2]
        return (
            len(host_headers) == 1
            and host_headers[0] in hosts
            and all(origin == b"http://" + host_headers[0] for origin in origins)
            and len(first) == 1
            and hmac.compare_digest(first[0], token.encode())
        )

    async def application(scope: _Message, receive: _Receive, send: _Send) -> None:
        if scope["type"] == "lifespan" or is_own(scope):
            await page(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await send({"type": "http.response.start", "status": 404, "headers": []})
            await send({"type": "http.response.body", "body": b""})

    return application


def serve(scene: Path, port: int, browser: bool, announce: Callable[[str], None]) -> None:
    """Serve the page of a scene file until it is interrupted, and end the process.

    **Arguments**: `scene`: path of the scene file; `port` of this computer; `browser`: True to open the page; `announce`: a
    function that is called with the address of the page.

    **Raises** `InputError` if marimo is not installed or the port is taken.
    """
    require_marimo()
    require_free(port)
    import marimo  # optional and slow import
    import uvicorn  # marimo's own server

    os.environ[_PATH_VARIABLE] = str(scene.resolve())
    token = secrets.token_urlsafe(32)
    page = marimo.create_asgi_app(quiet=True)
    page = page.with_app(path=f"/{token}", root=str(Path(__file__).with_name("page.py"))).build()
    address = f"http://{_HOST}:{port}/{token}/"
    announce(address)
    if browser:
        opener = threading.Timer(1.0, webbrowser.open, [address])
        opener.daemon = True
        opener.start()
    uvicorn.run(
        guarded(page, token, port),  # pyright: ignore[reportArgumentType]
        host=_HOST,
        port=port,
        log_level="warning",
        timeout_graceful_shutdown=1,
    )
    leave()


def leave() -> None:
    """End the process at once. A normal exit would wait for marimo's threads, which wait for pages that are still open."""
    sys.stdout.flush()
    os._exit(0)
