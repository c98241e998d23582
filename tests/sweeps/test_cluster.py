"""Sweeps by workers."""

import socket
import threading

import pytest
from test_sweep import STUDY, same

import jaxvib as jv
from jaxvib.sweeps.sweep import run_study


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_workers_compute_what_one_process_does(tmp_path):
    whole = run_study(STUDY, tmp_path / "whole.zarr")
    found = run_study(STUDY, tmp_path / "workers.zarr", workers=2)
    assert found.status_name == "done" and same(whole, found)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_that_is_none(tmp_path):
    """The address has no listener, or one that is no scheduler."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(jv.InputError, match="no scheduler with workers answers there within 1 s"):
            run_study(STUDY, tmp_path / "s.zarr", scheduler=address, timeout="1 s")
        server.listen()

        def answer():
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                connection.sendall(b"HTTP/1.1 400 Bad Request and so on and so on and so on")

        threading.Thread(target=answer, daemon=True).start()
        with pytest.raises(jv.InputError, match="no scheduler with workers answers there within 2 s"):
            run_study(STUDY, tmp_path / "s.zarr", scheduler=address, timeout="2 s")
    assert run_study(STUDY, tmp_path / "s.zarr").status_name == "done"


def test_workers_and_a_scheduler_exclude_each_other(tmp_path):
    with pytest.raises(jv.InputError, match="scheduler cannot be combined with workers"):
        run_study(STUDY, tmp_path / "s.zarr", workers=2, scheduler="tcp://127.0.0.1:1")
