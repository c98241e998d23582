"""The page's server answers the page alone: no other site, no request without the token."""

import contextlib
import http.client
import socket
import subprocess
import sys
import time

import pytest

pytest.importorskip("marimo")
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import jaxvib as jv
from jaxvib.machine.files import TEMPLATES

SERVE = """
import pathlib, sys
from jaxvib.explore.server import serve
serve(pathlib.Path(sys.argv[1]), int(sys.argv[2]), False, lambda address: print(address, flush=True))
"""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Port and token of the page of a machine, served by a process of its own, since marimo's threads do not end."""
    path = jv.save_scene(jv.scene_from_toml(TEMPLATES["one_mass"]), tmp_path_factory.mktemp("served") / "machine.toml")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with subprocess.Popen([sys.executable, "-c", SERVE, str(path), str(port)], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        token = server.stdout.readline().split("/")[3]
        while True:
            assert server.poll() is None
            with contextlib.suppress(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port)):
                break
            time.sleep(0.02)
        yield port, token
        server.terminate()


def ask(port, path, method="GET", **headers):
    """Status and length of an answer."""
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20.0)) as connection:
        connection.putrequest(method, path, skip_host=True)
        for name, value in ({"host": f"127.0.0.1:{port}", "connection": "close"} | headers).items():
            connection.putheader(name, value)
        connection.endheaders()
        with connection.getresponse() as answer:
            return answer.status, len(answer.read())


def test_the_page_itself_is_answered(address):
    port, token = address
    status, length = ask(port, f"/{token}/")
    assert status == 200 and length > 1000
    for name in ("127.0.0.1", "localhost"):
        own = {"host": f"{name}:{port}", "origin": f"http://{name}:{port}"}
        assert ask(port, f"/{token}/", **own) == (status, length)


STRANGE = {
    "no token": lambda port, token: ("/", {}),
    "a part of the token": lambda port, token: (f"/{token[:-1]}/", {}),
    "a letter that is no ASCII": lambda port, token: ("/%C3%A4/", {}),
    "an asset": lambda port, token: ("/assets/index.js", {}),
    "another origin": lambda port, token: (f"/{token}/", {"origin": "http://evil.example"}),
    "another port as origin": lambda port, token: (f"/{token}/", {"origin": f"http://127.0.0.1:{port + 1}"}),
    "an origin without a name": lambda port, token: (f"/{token}/", {"origin": "null"}),
    "another host": lambda port, token: (f"/{token}/", {"host": f"evil.example:{port}"}),
    "another host as origin too": lambda port, token: (
        f"/{token}/",
        {"host": f"evil.example:{port}", "origin": f"http://evil.example:{port}"},
    ),
}


@pytest.mark.parametrize("request_of", STRANGE)
@pytest.mark.parametrize("method", ["GET", "POST", "OPTIONS"])
def test_other_requests_are_not_found(address, request_of, method):
    path, headers = STRANGE[request_of](*address)
    assert ask(address[0], path, method, **headers) == (404, 0)


def socket_of(port, path, origin, host="127.0.0.1"):
    """The first message of the page's websocket."""
    raw = socket.create_connection(("127.0.0.1", port), timeout=20.0)
    with raw, connect(f"ws://{host}:{port}{path}?session_id=s_test", sock=raw, origin=origin) as opened:
        return opened.recv(timeout=20.0)


def test_the_websocket_of_the_page_is_answered(address):
    port, token = address
    assert "kernel-ready" in socket_of(port, f"/{token}/ws", f"http://127.0.0.1:{port}")


@pytest.mark.parametrize(
    ("path", "origin"),
    [("/{}/ws", "http://evil.example"), ("/{}/ws", "null"), ("/ws", None), ("/x{}/ws", None), ("/ws", "http://127.0.0.1")],
)
def test_other_websockets_are_refused(address, path, origin):
    port, token = address
    with pytest.raises(InvalidStatus, match="403"):
        socket_of(port, path.format(token), origin)


def test_a_websocket_of_another_host_is_refused(address):
    port, token = address
    with pytest.raises(InvalidStatus, match="403"):
        socket_of(port, f"/{token}/ws", f"http://evil.example:{port}", "evil.example")
