"""Functions that run, resume and read studies of many cases."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn
from jaxvib.errors import InputError, optional_module
from jaxvib.machine.files import scene_from_toml
from jaxvib.machine.scene import Scene
from jaxvib.motion.start import Start
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import member, sentence
from jaxvib.runtime.operations import PYTHON
from jaxvib.runtime.parallel import in_parallel
from jaxvib.sweeps.axes import AxisSpec
from jaxvib.sweeps.definition import CASE_STATUSES, CaseStatus, Study, SweepStatus
from jaxvib.sweeps.measures import RUN_MEASURES
from jaxvib.sweeps.program import compute, traced_program
from jaxvib.sweeps.store import ChunkState, Store
from jaxvib.sweeps.study import Measures, study
from jaxvib.units import Number, count
from optimize.quantities.quantity import Tier

if TYPE_CHECKING:
    import xarray

_MAX_WORKERS = 16
"""Maximum number of worker processes on a machine with at most four cores; otherwise it is four for each core."""


class Progress(NamedTuple):
    """Progress of a sweep.

    **Attributes**

    - `done`: number of finished cases, including those of earlier calls; `cases`: number of all cases
    - `rate`: cases per second in this call
    - `left`: estimated seconds until the end
    """

    done: int
    cases: int
    rate: float
    left: float


Report = Callable[[Progress], None]
"""Type of a function that is called after every chunk."""


class CaseCount(NamedTuple):
    """Number of `cases` with the same `status`: a name of `CaseStatus`, or the name of a regime with its jam mode."""

    status: str
    cases: int


class Sweep(Result):
    """Progress of a study and the path of its store; the results stay on disk.

    Returned by `sweep` and `open_sweep`.

    **Attributes**

    - `status`: a `SweepStatus`
    - `store`: path of the store
    - `cases`: number of cases
    - `counts`: number of cases with each status
    - `regimes`: number of finished cases in each regime, with the jam mode, the most frequent first; empty if neither regimes
      nor jam modes were measured, or if files were damaged when this call began
    - `computed`: number of cases computed in this call; `seconds`: their time, including compilation
    - `damaged`: number of cases whose files were damaged or incomplete; `sweep` has computed them again, `open_sweep` counts
      them as missing
    """

    status: SweepStatus
    store: str
    cases: int = eqx.field(metadata=in_unit(""))
    counts: tuple[CaseCount, ...] = eqx.field(metadata=in_unit("", "kind"))
    computed: int = eqx.field(metadata=in_unit(""))
    seconds: float = eqx.field(metadata=in_unit("s"))
    damaged: int = eqx.field(metadata=in_unit(""), default=0)
    regimes: tuple[CaseCount, ...] = eqx.field(metadata=in_unit("", "regime"), default=())

    @property
    def data(self) -> xarray.Dataset:
        """Labelled results as an xarray dataset, which reads from disk on demand (like `xarray.open_zarr(found.store)`).

        **Raises** `InputError` if xarray is not installed or a chunk of the store is damaged.
        """
        open_dataset = optional_module("xarray", "sweep").open_dataset
        Store(Path(self.store)).require_whole()
        return open_dataset(self.store, engine="zarr")

    @property
    def scene(self) -> Scene:
        """Scene from which all cases are derived."""
        return scene_from_toml(Store(Path(self.store)).record["scene"])

    def summary(self) -> str:
        """Return a text about the progress of the study, the outcomes of its cases and its duration."""
        lines = [f"{self.message}: {self.cases} cases in {self.store}"]
        for name, cases in self.counts:
            lines.append(f"  {self._share(cases)} {name}: {sentence(member(CaseStatus, name))}")
        lines += [f"  {self._share(cases)} {name.replace('_', ' ')}" for name, cases in self.regimes]
        if any(name == "unsettled" for name, _ in self.regimes):
            lines.append("  unsettled cases may settle in longer runs: increase `until`")
        if self.damaged:
            again = "they were computed again" if self.computed else "run the study again, which computes them again"
            lines.append(f"  {self.damaged} cases were in damaged or incomplete files: {again}")
        if self.computed:
            milliseconds = 1e3 * self.seconds / self.computed
            lines.append(
                f"  {self.computed} cases were computed in this call, in {self.seconds:.3g} s ({milliseconds:.3g} ms a case)"
            )
        return "\n".join(lines)

    def _share(self, cases: int) -> str:
        return f"{cases} ({100.0 * cases / self.cases:.3g} %)"

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the figure that fits the study, see `plot_sweep`."""
        from jaxvib.sweeps.figures import plot_sweep

        return plot_sweep(self.store, ax=ax)


@validated
def sweep(
    scene: Scene,
    axes: Mapping[str, AxisSpec],
    measure: Measures,
    store: str | Path,
    *,
    tier: Tier | None = None,
    until: Number | None = None,
    start: Start = "rest",
    mode: int | None = None,
    steps: int | None = None,
    samples: int = 0,
    sampling: str = "low_discrepancy",
    seed: int = 0,
    chunk: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    timeout: Number = "30 s",
    report: Report | None = None,
) -> Sweep:
    """Compute all cases of a study and store the results on disk. If the store of the same study exists, it is continued.

    - Cases are computed in chunks by one compiled program, on all cores of this process or by workers of Dask
    - Each finished chunk is written immediately, and is not lost if the process is terminated. A chunk with damaged files is
      computed again
    - The results of a case do not depend on the order of the cases, on the number of workers, or on restarts. The steps of runs
      are planned for all cases of the study together

    **Arguments**

    - `scene` from which all cases are derived
    - `axes`: a mapping from names to values, see below; typical: 1 to 3 axes of 10 to 100 values
    - `measure`: a list of quantities of `optimize`, your own functions in an `optimize.Quantity`, and names of measures of a
      run (`jaxvib.sweeps.measures.RUN_MEASURES`): "run.regime", "run.mode", "run.load_speed", "run.amplitude",
      "run.foundation_force", "run.settling_time", ...; or a mapping from names in the store to such measures
    - `store`: a folder, usually with the ending ".zarr"
    - `tier` of quantities of a jam: "leading" (light loads), "exact" (exact orbits) or "time" (full equations); default: the
      tier of each quantity
    - `start`, `mode`: initial state of runs: "rest" (the default), "spin_up", or "jam" for a start near the jam mode `mode`.
      With "spin_up", drives of constant speed are accelerated from rest during half of the run. Axes whose names begin with
      "start." change entries of this state
    - `until`: end of runs, s or text; typical: 5 to 60
    - `steps`: number of equal steps of a run, the same in all cases; default: one for each radian of the fastest motion of
      all cases (four for a contact with a stop or between loads), and more if a motion decays fast
    - `samples`: number of samples; typical: 1000 to 100,000; `sampling`: "low_discrepancy" or "random"; `seed` of the samples
    - `chunk`: number of cases that are computed and written together; a store is continued only with the same number.
      Typical: the default, 512 to 16,384 cases, about a second of computation. With smaller chunks an interruption loses fewer
      cases, but there are more file operations. An accelerator computes all cases of a chunk together, up to 262,144; give a
      chunk that fills its memory
    - `workers`: number of processes on this computer; or `scheduler`: address of a Dask scheduler ("tcp://10.0.0.1:8786"),
      which must answer within `timeout`, s. Both need the extra `cluster`
    - `report`: a function that is called with a `Progress` after each chunk

    Names of `axes`:

    - a parameter of the scene, with the same name as in a `DesignSpace` ("machine.stiffness[0]", "loads.drag", "drive.speed")
    - a parameter of the initial state ("start.rate" rad/s, "start.angle" rad, "start.displacement[0]" m, "start.velocity[0]"
      m/s, for tilts rad and rad/s; without an index, all entries change together)

    The values of an axis are a list, or a table of `from`, `to`, `count` and `scale` ("even" or "log"). The cases are all
    combinations of these values. Parameters whose table has no `count` are sampled together, `samples` times for each
    combination of the other axes.

    **Returns** `Sweep`. A case that fails raises no error; its status and its message are in the store.

    **Raises** `InputError` for

    - values that are not allowed
    - a store of another study; two studies are the same only if all values on which the results depend are equal, including
      values in your own functions
    - a store into which another sweep is writing, and a store that cannot be written

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import pathlib, tempfile, jaxvib as jv
    >>> from optimize import jam_frequency
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25), jv.ConstantSpeed("60 rad/s"))
    >>> store = pathlib.Path(tempfile.mkdtemp()) / "study.zarr"
    >>> found = jv.sweep(scene, {"drive.speed": [20.0, 60.0], "loads.drag": {"from": 0.05, "to": 0.25, "count": 3}},
    ...                  [jam_frequency(mode=1)], store)
    >>> found.status_name, found.cases
    ('done', 6)
    >>> found.data.jam_frequency.sel({"drive.speed": 60.0}).round(1).values.tolist()
    [25.9, 27.0, 27.4]
    """
    optional_module("zarr", "sweep")
    new_study = study(
        scene,
        axes,
        measure,
        tier=tier,
        until=until,
        start=start,
        mode=mode,
        steps=steps,
        samples=samples,
        sampling=sampling,
        seed=seed,
        chunk=chunk,
    )
    return run_study(new_study, store, workers=workers, scheduler=scheduler, timeout=timeout, report=report)


def run_study(
    new_study: Study,
    store: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    timeout: Number = "30 s",
    report: Report | None = None,
) -> Sweep:
    """Compute the missing cases in the store of a study, see `sweep`."""
    begun = time.perf_counter()
    path = Path(store)
    if workers is not None:
        count(workers, "workers")
        if workers > (limit := max(_MAX_WORKERS, 4 * (os.cpu_count() or 1))):
            raise InputError("workers", f"is {workers}, too many processes for this computer; give at most {limit}")
    if not os.path.exists(path):
        Store.create(path, new_study)
    opened = Store(path, writable=True)
    has_functions = any(measure not in RUN_MEASURES.values() for measure in new_study.measures)
    if has_functions and not new_study.program.startswith(PYTHON) and traced_program(new_study)[1] != new_study.program:
        problem = "has a function that has changed since the study was created, or that gives another program in each call"
        raise InputError("measure", f"{problem} (a clock, random numbers, a file); pass such numbers as constants")
    with opened.locked():
        opened.require_same(new_study)
        states = opened.states(writing=True)
        damaged = np.flatnonzero(states == ChunkState.damaged)
        for chunk in damaged:
            opened.clear(int(chunk))
        finished = states == ChunkState.finished
        sizes = np.asarray([_cases_of_chunk(new_study, chunk) for chunk in range(finished.size)])
        add = _reporter(new_study.grid.cases, int(np.sum(sizes[finished])), report)
        todo = np.flatnonzero(~finished).tolist()
        if todo:
            if workers is None and scheduler is None:
                source = in_parallel(lambda chunk: compute(new_study, chunk), todo)
            else:
                from jaxvib.sweeps.cluster import on_a_cluster  # needs Dask

                source = on_a_cluster(new_study, todo, workers=workers, scheduler=scheduler, timeout=timeout)
            with contextlib.closing(source):
                for chunk, cases in source:
                    opened.write(new_study, chunk, cases)
                    add(int(sizes[chunk]))
        states[:] = ChunkState.finished
        spent, computed = time.perf_counter() - begun, int(np.sum(sizes[~finished]))
        return _sweep_result(opened, states, computed, spent, int(np.sum(sizes[damaged])))


def _reporter(cases: int, done: int, report: Report | None) -> Callable[[int], None]:
    """Return a function that takes the number of cases of each finished chunk and reports the progress."""
    begun, finished_before, finished_now = time.perf_counter(), done, done

    def add(cases_of_chunk: int) -> None:
        nonlocal finished_now
        finished_now += cases_of_chunk
        if report is not None:
            rate = (finished_now - finished_before) / max(time.perf_counter() - begun, 1e-9)
            report(Progress(finished_now, cases, rate, (cases - finished_now) / rate))

    return add


def _cases_of_chunk(new_study: Study, chunk: int) -> int:
    return math.prod(s.stop - s.start for s in new_study.grid.region(chunk))


@validated
def open_sweep(store: str | Path) -> Sweep:
    """Open the store of a finished or running study. Every file is read once, to find damaged chunks.

    **Arguments**: `store`: the folder of the study.

    **Returns** `Sweep`. **Raises** `InputError` for a folder that is not a store, or a store whose metadata are damaged.

    >>> import pathlib, tempfile, jaxvib as jv
    >>> from optimize import jam_frequency
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25), jv.ConstantSpeed("60 rad/s"))
    >>> store = pathlib.Path(tempfile.mkdtemp()) / "study.zarr"
    >>> _ = jv.sweep(scene, {"drive.speed": [20.0, 60.0]}, [jam_frequency(mode=1)], store)
    >>> jv.open_sweep(store).status_name
    'done'
    """
    opened = Store(Path(store))
    states = opened.states()
    damaged = np.flatnonzero(states == ChunkState.damaged)
    cases = sum(math.prod(s.stop - s.start for s in opened.region(int(chunk))) for chunk in damaged)
    return _sweep_result(opened, states, 0, 0.0, cases)


def _sweep_result(store: Store, states: np.ndarray, computed: int, seconds: float, damaged: int) -> Sweep:
    counts = store.counts(states)
    rows = tuple(CaseCount(name, int(n)) for name, n in zip(CASE_STATUSES, counts, strict=True) if n)
    status = SweepStatus.incomplete if counts[0] else SweepStatus.done
    regimes: tuple[CaseCount, ...] = ()
    if not damaged:
        from jaxvib.sweeps.figures import label_counts  # slow import

        store.is_whole = True  # every file has just been read
        regimes = tuple(CaseCount(*pair) for pair in label_counts(store))
    return Sweep(status, str(store.path), math.prod(store.shape), rows, computed, seconds, damaged, regimes)
