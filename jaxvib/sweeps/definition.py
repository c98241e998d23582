"""A study that was checked: what its results depend on, and the shape of the program that computes them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import cast

import jax
import numpy as np

from jaxvib.machine.files import scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.motion.lanes import LANES, Plan
from jaxvib.motion.start import Start
from jaxvib.results.fields import Plain
from jaxvib.sweeps.axes import Grid, Spot
from jaxvib.sweeps.measures import Measure, identity
from optimize.wishes.quantity import Tier

__all__ = ["Study"]


@dataclass(frozen=True)
class Study:
    """A study that was checked, see `study`.

    **Attributes**: `scene`; `grid` of the cases; `names` and `measures` of what is measured, with the `dtypes` and shapes
    (`extra`) that one case has; `plan` of the runs, None where there are none; `start` and `mode` they start from; `tier`.
    """

    scene: Scene
    grid: Grid
    names: tuple[str, ...]
    measures: tuple[Measure, ...]
    plan: Plan | None
    start: Start
    mode: int | None
    tier: Tier
    specs: dict[str, Plain]
    forms: tuple[jax.ShapeDtypeStruct, ...] = ()

    @property
    def spots(self) -> tuple[Spot, ...]:
        """Where the axes' numbers stand."""
        return tuple(axis.spot for axis in self.grid.axes)

    @property
    def program(self) -> tuple[tuple[Spot, ...], tuple[Measure, ...], Plan | None, Start, int | None]:
        """What the compiled program depends on beside the scene and the cases."""
        return self.spots, self.measures, self.plan, self.start, self.mode

    @property
    def size(self) -> int:
        """How many cases the program computes at a time: whole groups of lanes, for in the rest of one that does not fill the
        processor's vectors a case would be computed by other instructions."""
        return -(-int(np.prod(self.grid.tile, dtype=np.int64)) // LANES) * LANES

    @property
    def record(self) -> dict[str, Plain]:
        """All that the results depend on, ready for JSON."""
        return {
            "scene": scene_to_toml(self.scene),
            "axes": self.specs,
            "samples": self.grid.samples,
            "sampling": self.grid.sampling,
            "seed": self.grid.seed,
            "tier": self.tier,
            "measure": {name: cast(Plain, identity(m)) for name, m in zip(self.names, self.measures, strict=True)},
            "run": None if self.plan is None else {**self.plan._asdict(), "start": self.start, "mode": self.mode},
            "tile": list(self.grid.tile),
            "precision": str(self.scene.drive.speed.dtype),
        }

    @property
    def key(self) -> str:
        """A text that differs from that of every other study."""
        return hashlib.sha256(json.dumps(self.record, sort_keys=True).encode()).hexdigest()

    def nothing(self, cases: int) -> list[np.ndarray]:
        """What stands for measures of cases that have none: NaN, of whole numbers -1."""
        return [np.full((cases, *f.shape), np.nan if np.issubdtype(f.dtype, np.inexact) else -1, f.dtype) for f in self.forms]
