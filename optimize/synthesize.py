"""From a design space and a wish to a machine, checked by time integration."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.platforms import Platforms
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.motion.analysis.measure import relative_amplitude
from jaxvib.motion.run import Run
from jaxvib.motion.settle import settle
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.steady.jams.jam import JamStatus, jam_modes
from jaxvib.units import count
from optimize.quantities import Pair, Quantity, between, force_per_amplitude
from optimize.search import Search, descend, draw_starts, polish
from optimize.space import DesignSpace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Outcome", "Synthesis", "synthesize"]

_CONVERGED = 1e-6
"""By how much, in relation to its value, the objective may still be above its least value nearby."""

_SAME = 1e-3
"""How near two designs must be, relative to the ranges of the free numbers, to count as the same machine."""


@dataclass(frozen=True)
class Outcome:
    """A machine in numbers, in one jam mode.

    **Attributes**: `parameters` the freed numbers by name, SI; `exists` whether the mode exists; `omega` rad/s; `amplitude` m,
    of platform 1 (y1) first, and `foundation_force` N, zero to peak; `force_per_amplitude` N/m. NaN where the mode does not
    exist.
    """

    parameters: dict[str, float | list[float]]
    exists: bool
    omega: float
    amplitude: tuple[float, ...]
    foundation_force: float
    force_per_amplitude: float

    def as_dict(self) -> dict[str, Any]:
        """The same for JSON: freed numbers beside the quantities, None where there is no number."""

        def plain(value: float) -> float | None:
            return value if math.isfinite(value) else None

        return {
            **self.parameters,
            "omega": plain(self.omega),
            "amplitude": [plain(a) for a in self.amplitude],
            "foundation_force": plain(self.foundation_force),
            "force_per_amplitude": plain(self.force_per_amplitude),
        }


class Synthesis(Result):
    """What a search found.

    **Attributes**: `scene` the best design; `before`, `after` its `Outcome` by the jam's equations, `verified` by time
    integration of the full equations from `run` (both None where that was not done or failed: `unverified` says why); `starts`
    searches made, from `drawn` random designs;
    `converged` how many of them ended where no free number can improve; `same` how many ended at the best design; `designs`
    (starts, d) in [0, 1] where each search ended, with their `values` and whether each is `done`; `history` (iterations,
    starts) of the objective; `objective` and `unit` its name and unit.
    """

    status = Computed.done

    scene: Scene = eqx.field(metadata=SCENE)
    before: Outcome
    after: Outcome
    verified: Outcome | None
    run: Run | None
    unverified: str
    starts: int
    drawn: int
    converged: int
    same: int
    designs: np.ndarray = eqx.field(metadata=in_unit("", "start", "parameter"))
    values: np.ndarray = eqx.field(metadata=in_unit("", "start"))
    done: np.ndarray = eqx.field(metadata=in_unit("", "start"))
    history: np.ndarray = eqx.field(metadata=in_unit("", "iteration", "start"))
    objective: str
    unit: str

    def summary(self) -> str:
        """Before, after and verified, for a person to read."""
        rows = [("before", self.before), ("after", self.after)] + ([("verified", self.verified)] if self.verified else [])
        lines = [f"{self.starts} starts ({self.drawn} drawn), {self.converged} converged, {self.same} to the best machine"]
        for name, outcome in rows:
            numbers = ", ".join(f"{key} {_show(value)}" for key, value in outcome.parameters.items())
            lines.append(f"  {name}: {numbers}")
            if outcome.exists:
                lines.append(
                    f"    Omega {outcome.omega:.6g} rad/s, amplitude {_show(list(outcome.amplitude))} m, foundation force "
                    f"{outcome.foundation_force:.4g} N, force per amplitude {outcome.force_per_amplitude:.4g} N/m"
                )
            else:
                lines.append("    this jam mode does not exist")
        if self.unverified:
            lines.append(f"  not verified: {self.unverified}")
        return "\n".join(lines)

    def plot(self, *, ax: Axes | None = None) -> Figure:
        """Every quantity after the search against before.

        **Returns** a matplotlib figure, that of the axes `ax` where they are given.
        """
        from jaxvib.draw.charts import before_after  # slow to import: only who draws pays

        names = amplitude_names(self.scene)
        return before_after(
            _flat(self.before, names), _flat(self.after, names), title=f"search for {wanted(self.objective)}", ax=ax
        )

    def plot_convergence(self, *, ax: Axes | None = None) -> Figure:
        """The objective of every start over the iterations.

        **Returns** a matplotlib figure, that of the axes `ax` where they are given.
        """
        from jaxvib.draw.charts import convergence

        return convergence(
            self.history, best=int(np.argmin(self.values)), label=f"{self.objective}, {self.unit}".rstrip(", "), ax=ax
        )


def wanted(objective: str) -> str:
    """The objective in words."""
    return f"greatest {objective.removeprefix('negative ')}" if objective.startswith("negative ") else f"least {objective}"


def _show(value: float | list[float]) -> str:
    return ", ".join(f"{v:.5g}" for v in value) if isinstance(value, list) else f"{value:.5g}"


def amplitude_names(scene: Scene) -> list[str]:
    """Names of the coordinates' amplitudes: that of platform 1 is the coordinate y1's."""
    names = scene.machine.structure().coordinates
    if not isinstance(scene.machine, Platforms):
        return [f"amplitude of {name}" for name in names]
    return [f"amplitude of platform {k + 1} ({name})" for k, name in enumerate(names)]


def _flat(outcome: Outcome, names: list[str]) -> dict[str, float]:
    flat: dict[str, float] = {}
    for name, value in outcome.parameters.items():
        if isinstance(value, list):
            flat.update({f"{name}[{k}]": v for k, v in enumerate(value)} if len(value) > 1 else {name: value[0]})
        else:
            flat[name] = value
    flat["jam frequency, rad/s"] = outcome.omega
    flat.update({f"{name}, m": a for name, a in zip(names, outcome.amplitude, strict=True)})
    flat["foundation force, N"] = outcome.foundation_force
    flat["force per amplitude, N/m"] = outcome.force_per_amplitude
    return flat


def synthesize(
    space: DesignSpace,
    objective: Quantity,
    *,
    starts: int = 256,
    seed: int = 0,
    iterations: int = 100,
    polishing: int = 12,
    rate: float = 0.05,
    verify: bool = True,
    progress: Callable[[str, float], None] | None = None,
) -> Synthesis:
    """Searches a design space from many random starts at once for the least value of a quantity.

    Starts are drawn evenly from the bounds and moved onto what is held; Adam (optax) descends from all of them at once, each
    step along what is held; Newton's method with a line search polishes. Gradients are those of the jam's equations.

    **Arguments**

    - `space`: a `DesignSpace`; `objective`: a `Quantity` such as `force_per_amplitude(mode=3)`
    - `starts`, `seed`: how many random starts, and which; `iterations` of the descent with first step `rate` (in parts of a
      free number's range), then `polishing` steps of Newton's method
    - `verify`: integrate the full equations of the best design, from its jam until it has settled, and measure
    - `progress`: called with what is being done and how much of it is (0 to 1)

    **Returns** `Synthesis`. **Raises** `InputError` for values that are not allowed, `ComputationError` (status
    "no_feasible_start") if no design in the bounds has the objective and keeps what is held.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from optimize import DesignSpace, force_per_amplitude, hold, jam_frequency, support_frequency_squared, synthesize
    >>> form = jv.Dimensionless("antiphase", natural=(0.2, 0.4), damping=(1e-3, 1e-3), link_natural=2/3, link_damping=1e-3,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> space = DesignSpace(form.scene(), free={"machine.stiffness": (0.02, 0.3), "machine.link_stiffness": (0.2, 0.8)},
    ...                     hold=[hold(jam_frequency(mode=3), 1.0), hold(support_frequency_squared(), 2/9)])
    >>> best = synthesize(space, force_per_amplitude(mode=3), starts=8, verify=False)
    >>> best.same, [round(k, 2) for k in best.after.parameters["machine.stiffness"]]     # n2 = n1 came out
    (8, [0.11, 0.11])

    Source: the antiphase paper, section 5.1, found there by algebra.
    """
    count(starts, "starts")
    count(iterations, "iterations")
    count(polishing, "polishing", low=0)
    if not 0.0 < rate < 1.0:
        raise InputError("rate", f"is {rate!r}; it must be greater than 0 and less than 1")
    if not isinstance(objective, Quantity):
        raise InputError("objective", f"is {objective!r}; it must be a Quantity, for example force_per_amplitude(mode=3)")
    between(space.scene, objective.of)
    if objective.mode is not None:
        jam_modes(space.scene).select(objective.mode, throw=False)  # says which numbers there are
    tell = progress or (lambda _what, _share: None)
    if not space.scene.drive.constant:
        raise InputError("drive", f"is {space.scene.drive.kind!r}; a design is sought at one speed, give a ConstantSpeed")
    if space.scene.drive.speed.dtype != jnp.float64:
        raise InputError(
            "scene", 'is in float32; a search needs jax.config.update("jax_enable_x64", True) before the scene is built'
        )
    count(seed, "seed", low=0)
    search = Search(space, objective)

    tell("drawing starts", 0.0)
    drawn = draw_starts(search, starts, seed)
    if len(drawn.z) == 0:
        raise ComputationError(
            "no_feasible_start",
            f"of {drawn.drawn} random designs in the bounds {drawn.existing} have {objective.name}, and none of those keeps "
            f"what is held (the nearest is off by {drawn.nearest:.2g} of the value); widen the bounds, hold other values or "
            "ask for another mode",
        )
    z, descent = descend(search, drawn.z, iterations, rate, lambda share: tell("descending", 0.1 + 0.4 * share))
    ends = polish(search, z, polishing, lambda share: tell("polishing", 0.5 + 0.4 * share))
    values = np.where(ends.good, ends.history[-1], np.inf)
    done = ends.good & (ends.left < _CONVERGED)
    if not np.any(np.isfinite(values)):
        raise ComputationError(
            "diverged",
            f"no search from {starts} starts ended at a possible design; give a smaller rate (search.rate of a design file)",
        )
    best = int(np.argmin(values))
    scene = space.at(jnp.asarray(ends.z[best]))
    tell("checking by time integration", 0.9)
    run, unverified = None, ""
    if objective.mode is None:
        unverified = "the objective belongs to no jam mode that could be integrated"
    elif not verify:
        unverified = "not asked for"
    else:
        try:
            run = settle(scene, mode=objective.mode)
        except ComputationError as error:  # the machine that was found is worth more than the check that failed
            unverified = str(error)
    tell("done", 1.0)
    return Synthesis(
        scene=scene,
        before=_by_algebra(space, space.scene, objective),
        after=_by_algebra(space, scene, objective),
        verified=None if run is None else _by_run(space, run, objective),
        run=run,
        unverified=unverified,
        starts=len(drawn.z),
        drawn=drawn.drawn,
        converged=int(np.sum(done)),
        same=int(np.sum(np.max(np.abs(ends.z - ends.z[best]), axis=1) < _SAME)),
        designs=ends.z,
        values=values,
        done=done,
        history=np.concatenate([descent, ends.history]),
        objective=objective.name,
        unit=objective.unit,
    )


def _by_algebra(space: DesignSpace, scene: Scene, objective: Quantity) -> Outcome:
    mode = objective.mode
    parameters = space.parameters(scene)
    if mode is None:
        nothing = tuple(math.nan for _ in scene.machine.carrier().coordinates)
        return Outcome(parameters, False, math.nan, nothing, math.nan, math.nan)
    jam = jam_modes(scene).select(mode, throw=False)
    return Outcome(
        parameters=parameters,
        exists=not bool(jam.status == JamStatus.absent),
        omega=float(jam.omega),
        amplitude=tuple(float(a) for a in jam.amplitude),
        foundation_force=float(jam.foundation_force),
        force_per_amplitude=float(force_per_amplitude(mode=mode, of=objective.of)(scene)),
    )


def _by_run(space: DesignSpace, run: Run, objective: Quantity) -> Outcome:
    of: Pair = between(run.scene, objective.of)
    force = float(run.foundation_force)
    whose = float(run.amplitude[of - 1]) if isinstance(of, int) else float(relative_amplitude(run.window, *of))
    return Outcome(
        parameters=space.parameters(run.scene),
        exists=True,
        omega=float(run.omega),
        amplitude=tuple(float(a) for a in run.amplitude),
        foundation_force=force,
        force_per_amplitude=force / whose,
    )
