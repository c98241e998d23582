"""Sweeps by workers."""

import pytest
from test_sweep import STUDY, same

from jaxvib.sweeps.sweep import run_study


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_workers_compute_what_one_process_does(tmp_path):
    whole = run_study(STUDY, tmp_path / "whole.zarr")
    found = run_study(STUDY, tmp_path / "workers.zarr", workers=2)
    assert found.status_name == "done" and same(whole, found)
