"""The progress bar of a time integration."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rich.progress

from jaxvib.ode import progress


@pytest.fixture
def bar(monkeypatch):
    """Calls that a bar receives: "start", the completed shares of its one task, "stop"."""

    class Recorded:
        def __init__(self, *, console, transient):
            assert console.stderr and transient
            self.told, self.task_ids = told, [7]

        def add_task(self, description, *, total):
            assert description == "simulating" and total == 1.0

        def start(self):
            self.told.append("start")

        def stop(self):
            self.told.append("stop")

        def update(self, task, *, completed):
            assert task == 7
            self.told.append(completed)

    told = []
    monkeypatch.setattr(rich.progress, "Progress", Recorded)
    return told


def solve(steps):
    term = diffrax.ODETerm(lambda t, y, args: -y)
    kept = dict(max_steps=4 * steps, progress_meter=progress.ProgressBar())
    diffrax.diffeqsolve(term, diffrax.Euler(), 0.0, 1.0, 1.0 / steps, jnp.ones(()), **kept)
    jax.effects_barrier()


def test_the_bar_goes_to_its_end_and_away(bar):
    solve(8)
    assert bar[0] == "start" and bar[-1] == "stop" and bar.count("stop") == 1 and not progress._open
    np.testing.assert_allclose(bar[1:-1], np.arange(1, 9) / 8.0, rtol=1e-12)


def test_the_bar_moves_by_a_per_cent_at_least(bar):
    solve(1000)
    shares = np.array([x for x in bar if not isinstance(x, str)])
    assert 80 <= len(shares) <= 101 and shares[-1] == 1.0 and np.min(np.diff(shares[:-1])) > 0.01
