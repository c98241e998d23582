"""Class of a validated study: its identity, the static arguments of its program, and the statuses of its cases."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np

from jaxvib.machine.files import scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.motion.batch import BATCH_SIZE, BatchPlan, batch_size
from jaxvib.motion.start import Start
from jaxvib.results.fields import Plain
from jaxvib.runtime.compat import enumeration_names
from jaxvib.sweeps.axes import Grid, Target
from jaxvib.sweeps.measures import Measure
from optimize.quantities.quantity import Tier

_OPTIONS = ("jax_enable_x64", "jax_numpy_dtype_promotion", "jax_default_matmul_precision")
"""Options of JAX that change results."""


class CaseStatus(eqx.Enumeration):
    """Outcomes of a case. The value of each member is the message shown to the user. The order is part of the format of the
    store."""

    missing = "the case has not been computed yet"
    done = "the case was computed"
    absent = "a requested quantity does not exist in this case, such as the speed of a jam beyond its fold"
    not_finite = "the motion grew without bounds"
    failed = "an error was raised; its message is stored with the case"
    lost = "the process that computed the case terminated unexpectedly several times"
    not_resolved = (
        "steps too long for contacts, for the stiffness of a support at the displacements of the run, or for the motion: use "
        "more steps"
    )


CASE_STATUSES = enumeration_names(CaseStatus)
"""Names of the statuses in the order of their numbers in a store."""

WITH_RESULTS = tuple(CASE_STATUSES.index(name) for name in ("done", "absent"))
"""Numbers of the statuses of cases whose results are valid; the results of an absent quantity are NaN."""


class SweepStatus(eqx.Enumeration):
    """Progress of a study. The value of each member is the message shown to the user."""

    done = "every case was computed"
    incomplete = "some cases have not been computed yet; run the study again to continue"


@dataclass(frozen=True)
class Study:
    """Validated study, see `study`.

    **Attributes**: `scene`; `grid` of the cases; `names` of the `measures`; `plan`: steps and window of the runs, None without
    runs; `start` and `mode` of the runs; `tier`: method by which quantities are computed, see `Tier`; `specs`: the values of
    the axes as the user wrote them; `forms`: shape and type of each measure in one case; `program`: the digest of the program
    of a case when the study was created.
    """

    scene: Scene
    grid: Grid
    names: tuple[str, ...]
    measures: tuple[Measure, ...]
    plan: BatchPlan | None
    start: Start
    mode: int | None
    tier: Tier
    specs: dict[str, Plain]
    forms: tuple[jax.ShapeDtypeStruct, ...] = ()
    program: str = ""

    @property
    def targets(self) -> tuple[Target, ...]:
        """Parameters that the axes change."""
        return tuple(axis.target for axis in self.grid.axes)

    @property
    def choices(self) -> tuple[int, tuple[Target, ...], tuple[Measure, ...], BatchPlan | None, Start, int | None]:
        """Static arguments of the program of a case."""
        return self.batch, self.targets, self.measures, self.plan, self.start, self.mode

    @property
    def batch(self) -> int:
        """Number of cases that are computed at the same time: 64 on a CPU; all cases of a chunk, up to 262,144, on an
        accelerator."""
        return min(batch_size(), _round_up(self._cases_in_chunk, BATCH_SIZE))

    @property
    def size(self) -> int:
        """Number of cases in one call of the program.

        It is a multiple of the batch size, because other instructions, with other rounding errors, compute a partial batch.
        """
        return _round_up(self._cases_in_chunk, self.batch)

    @property
    def _cases_in_chunk(self) -> int:
        return int(np.prod(self.grid.tile, dtype=np.int64))

    @property
    def record(self) -> dict[str, Plain]:
        """Identity of the study: all values on which its results depend, as plain data for JSON."""
        options: dict[str, Plain] = {name: str(getattr(jax.config, name)) for name in _OPTIONS}
        return {
            "scene": scene_to_toml(self.scene),
            "axes": self.specs,
            "samples": self.grid.samples,
            "sampling": self.grid.sampling,
            "seed": self.grid.seed,
            "tier": self.tier,
            "measure": {name: measure.unit for name, measure in zip(self.names, self.measures, strict=True)},
            "run": None if self.plan is None else {**self.plan._asdict(), "start": self.start, "mode": self.mode},
            "tile": list(self.grid.tile),
            "precision": str(self.scene.top_speed.dtype),
            "options": options | {"EQX_ON_ERROR": os.environ.get("EQX_ON_ERROR")},
            "program": self.program,
        }

    @property
    def key(self) -> str:
        """String that is unique for the study."""
        return digest(self.record)

    def placeholders(self, cases: int) -> list[np.ndarray]:
        """Return an array (cases, ...) for each measure, for `cases` without values: NaN, or -1 for integers."""
        return [np.full((cases, *f.shape), np.nan if np.issubdtype(f.dtype, np.inexact) else -1, f.dtype) for f in self.forms]


def _round_up(count: int, unit: int) -> int:
    """Return the smallest multiple of `unit` that is not less than `count`."""
    return -(-count // unit) * unit


def digest(value: Plain) -> str:
    """Return a digest of plain data, a string of 32 hexadecimal digits."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:32]


def difference(first: Plain, second: Plain, name: str = "") -> tuple[str, Plain, Plain] | None:
    """Return the path of the first difference between two plain values, and the two different entries; None for equal
    values."""
    if isinstance(first, dict) and isinstance(second, dict) and first.keys() == second.keys():
        pairs = [(f"{name}.{key}" if name else key, first[key], second[key]) for key in first]
    elif isinstance(first, list) and isinstance(second, list) and len(first) == len(second):
        pairs = [(f"{name}[{k}]", a, b) for k, (a, b) in enumerate(zip(first, second, strict=True))]
    else:  # compared as strings, because 1 == 1.0 == True in Python
        return None if json.dumps(first, sort_keys=True) == json.dumps(second, sort_keys=True) else (name, first, second)
    return next((found for key, a, b in pairs if (found := difference(a, b, key))), None)
