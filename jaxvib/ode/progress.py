"""A progress bar for one time integration, on the error stream."""

from __future__ import annotations

from typing import TYPE_CHECKING

import diffrax
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.ode.types import RealScalarLike

if TYPE_CHECKING:
    from rich.progress import Progress

_open: list[Progress] = []


def _show(fraction: Array) -> None:
    if not _open:
        from rich.console import Console
        from rich.progress import Progress

        bar = Progress(console=Console(stderr=True), transient=True)
        bar.add_task("simulating", total=1.0)
        bar.start()
        _open.append(bar)
    _open[0].update(_open[0].task_ids[0], completed=float(fraction))
    if float(fraction) >= 1.0:
        _close()


def _close() -> None:
    while _open:
        _open.pop().stop()


class ProgressBar(diffrax.AbstractProgressMeter):
    """Progress bar of a run, in steps of one percent."""

    def init(self) -> Array:
        """Return the state of the meter, the progress that is shown: 0."""
        return jnp.array(0.0)

    def step(self, state: Array, progress: RealScalarLike) -> Array:
        """Show `progress` if it has increased by one percent."""
        progress = jnp.asarray(progress, dtype=state.dtype)
        further = (progress - state > 0.01) | (progress >= 1.0)
        jax.lax.cond(further, lambda p: jax.debug.callback(_show, p), lambda p: None, progress)
        return jnp.where(further, progress, state)

    def close(self, state: Array) -> None:
        """Remove the bar."""
        jax.debug.callback(_close)
