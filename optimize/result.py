"""Result of a search, and its text and tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxvib.boundary import with_known_names
from jaxvib.display import Axes, Drawn, shown_unit
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.structures.platforms import Platforms
from jaxvib.motion.run import Run
from jaxvib.results.fields import Plain, in_unit, plain
from jaxvib.results.result import Result
from jaxvib.units.reading import unit_ratio

_MAX_SHOWN_PERCENT = 1000.0
"""Largest change that is shown in percent; larger ones are shown in the unit of the objective."""


_MAX_LINEAR_PERCENT = 10.0
"""Largest change of the objective, percent, for which a prediction from its slope is shown."""

_MAX_EQUAL_DIFFERENCE = 1e-4
"""Relative difference of the objectives of two machines below which they count as equally good."""

_ROUNDING_SHARE = 1e-8
"""Fraction of the change of the objective that 1 % of the most influential parameter causes. Two machines whose objectives
differ by less count as equally good, too: if the objective is almost zero, the difference is a rounding error."""

_MIN_LIMIT_CHANGE = 1e-6
"""Smallest change of a limit, percent, for which the change of the objective is shown."""


class SynthesisStatus(eqx.Enumeration):
    """Outcomes of a search. The value of each member is the message shown to the user."""

    done = "the search converged: no small change of the free parameters improves the objective"
    not_converged = "the search has not converged: allow more polishing or more iterations"
    contradictory = "no design within the bounds meets all demands"
    interrupted = "the search was interrupted: this is its best design"


@with_known_names
@dataclass(frozen=True)
class Outcome:
    """Quantities of a machine in one jam mode, or in the working regime of its exciters; NaN if there is no such motion.

    Returned by `synthesize` in a `Synthesis`, as `before`, `after` and `verified`.

    **Attributes**

    - `parameters`: the free parameters by name, SI
    - `exists`: True if the motion exists
    - `omega`: load speed, or speed of the exciters, rad/s
    - `amplitude` of each coordinate, platform 1 (y1) first, m or rad, and `foundation_force`, N, zero to peak
    - `force_per_amplitude`, N/m, of a jam mode
    """

    parameters: dict[str, float | list[float]]
    exists: bool
    omega: float
    amplitude: tuple[float, ...]
    foundation_force: float
    force_per_amplitude: float

    def as_dict(self) -> dict[str, Plain]:
        """Return the free parameters and the quantities as a dictionary for JSON, with None instead of NaN."""
        shown = ("omega", "amplitude", "foundation_force", "force_per_amplitude")
        return {name: plain(value) for name, value in {**self.parameters, **{k: getattr(self, k) for k in shown}}.items()}


class Row(NamedTuple):
    """Row of the table, for one parameter or one quantity.

    **Attributes**: name `what`; SI `unit`, "rad/s of a supply" for the frequency of an electrical supply; value `before` the
    search; values of the best design: by the method of the quantity (`after`), by the exact motion (`exact`), and by time
    integration (`time`). A value that was not computed is NaN.
    """

    what: str
    unit: str
    before: float
    after: float
    exact: float
    time: float


class Limit(NamedTuple):
    """Demand, held quantity, or bound.

    **Attributes**

    - `what`: the condition as text; `value` of its quantity and its `limit`, in the SI `unit`
    - `violation`: relative violation of the condition (0: met; infinite: the machine does not have the quantity)
    - `active`: True if it limits the design
    - `multiplier`: derivative of the objective with respect to a relative relaxation of the limit (for held quantities: a
      relative increase of the held value), in the unit of the objective
    - `gain`: change of the objective, percent, if the limit is relaxed by 1 % (a held value: increased), predicted from this
      derivative; negative for an improvement. A prediction of more than a few percent is not reliable
    - `written`: unit in which the user wrote the limit, such as "mm"; "" for the default display unit
    - `held`: True for a held quantity
    """

    what: str
    unit: str
    value: float
    limit: float
    violation: float
    active: bool
    multiplier: float
    gain: float
    written: str = ""
    held: bool = False

    def value_text(self) -> str:
        """Return the value in the unit of the limit as text."""
        factor = unit_ratio(self.unit, self.written) if self.written else None
        if factor is not None:
            return f"{self.value * factor:.5g} {self.written}"
        unit, factor = shown_unit(self.unit, max(abs(self.value), abs(self.limit)))
        return f"{self.value * factor:.5g} {unit}".rstrip()

    def shortfall(self) -> str:
        """Return the distance of the machine from a violated limit as text."""
        if not math.isfinite(self.violation):
            return "the nearest machine does not have this quantity"
        return f"at best {self.value_text()}, {100.0 * self.violation:.3g} % off"


class Influence(NamedTuple):
    """Influence of a free parameter, named `what`, on the objective.

    **Attributes**: change of the objective, percent, if only this parameter is 1 % smaller (`less`) or 1 % larger (`more`); the
    demands that are not met then (`unmet_by_less`, `unmet_by_more`), in words.
    """

    what: str
    less: float
    more: float
    unmet_by_less: tuple[str, ...] = ()
    unmet_by_more: tuple[str, ...] = ()

    def unmet_text(self) -> str:
        """Return the demands that are not met after one of the changes as text; an empty text without them."""
        changes = {"less": self.unmet_by_less, "more": self.unmet_by_more}
        unmet = [f"1 % {change} does not meet {', '.join(demands)}" for change, demands in changes.items() if demands]
        return f" ({'; '.join(unmet)})" if unmet else ""


class Unresolved(NamedTuple):
    """Quantity of a run, named `what`, whose derivatives cannot be trusted.

    **Attributes**: largest change of the quantity, percent, if all free parameters change by at most a millionth (`tiny`), and
    if one of them is 1 % smaller or larger (`large`).
    """

    what: str
    tiny: float
    large: float


class Machine(NamedTuple):
    """Distinct machine of a search.

    **Attributes**: `starts`: the number of starts whose search ended at this machine; `value` of the objective; `numbers`: the
    free parameters, SI.
    """

    starts: int
    value: float
    numbers: tuple[float, ...]


class Synthesis(Result):
    """Result of a search.

    Returned by `synthesize`.

    **Attributes**

    - `status`: a `SynthesisStatus`; `scene`: the best design
    - `before` and `after`: `Outcome` of the initial scene and of the best design, to leading order
    - `verified`: `Outcome` of the best design from `run`, a time integration of the full equations. Both are None if the run
      was not requested or failed; `unverified` states the reason
    - `table` of `Row`: every free parameter and quantity before and after, by the exact motion and by time integration
    - `limits` of `Limit`: demands, held quantities and active bounds, each with the gain from a change of its limit
    - `influences` of `Influence`: the influence of each free parameter
    - `unresolved` of `Unresolved`: quantities of runs whose derivatives cannot be trusted at the best design, for example
      because the motion is chaotic
    - `machines` of `Machine`: the distinct final designs, with the number of starts that ended at each
    - `kkt`: relative residual of the Karush-Kuhn-Tucker conditions at the best design
    - `starts`: number of searches; `drawn`: number of random designs from which their starts were chosen; `converged`: number
      of searches that ended at a design that no change of a free parameter improves; `same`: number of searches that ended at
      the best design
    - `designs` (starts, d) in [0, 1]: the final design of each search; `values` (starts,): its objective, infinite for a design
      that does not meet all demands; `done` (starts,): True if the search converged
    - `history` (steps, starts): the objective after each step of the descent and of the polishing; `history_violation`
      (steps, starts): the largest relative violation of demands and kept quantities
    - `objective` and `unit`: name and unit of the objective
    """

    status: SynthesisStatus
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
    history_violation: np.ndarray = eqx.field(metadata=in_unit("", "iteration", "start"))
    objective: str
    unit: str
    kkt: float = math.nan
    table: tuple[Row, ...] = ()
    limits: tuple[Limit, ...] = ()
    influences: tuple[Influence, ...] = ()
    unresolved: tuple[Unresolved, ...] = ()
    machines: tuple[Machine, ...] = ()

    def summary(self) -> str:
        """Return the design before, after and verified, the active limits and the influences as text."""
        lines = [f"{objective_text(self.objective)}: {self.message}", self.counts_text()]
        lines += [" ".join(line) for line in _align_columns(self.columns())]
        lines += [f"  {line}" for line in self.verification()]
        lines += self.findings()
        return "\n".join(line.rstrip() for line in lines)

    def verification(self) -> list[str]:
        """Return lines about the verification: what it shows, or why there is none."""
        if self.verified is None:
            return [f"not verified: {self.unverified}"]
        return [
            "verified: the full equations keep this motion if they start near it;",
            "this does not show that a start from rest reaches it:",
            "simulate the found machine with start rest and spin_up",
        ]

    def counts_text(self) -> str:
        """Return the numbers of starts, designs and equal results as text."""
        starts = f"{self.starts} starts from {self.drawn} designs"
        return f"{starts}, {self.converged} converged, {self.same} to the best machine"

    def columns(self) -> list[list[str]]:
        """Return the header of the table and its `rows`, without columns that are empty."""
        heads, rows = ["", "before", "after", "exact", "verified"], self.rows()
        shown = [k for k in range(len(heads)) if k < 3 or any(row[k] for row in rows)]
        return [[row[k] for k in shown] for row in (heads, *rows)]

    def rows(self) -> list[list[str]]:
        """Return the table as text in practical units: name, before, after, by the exact motion, by time integration."""
        rows = []
        for row in self.table:
            sizes = [abs(v) for v in row[2:] if math.isfinite(v)]
            unit, factor = shown_unit(row.unit, max(sizes, default=0.0))
            values = ["" if math.isnan(v) else f"{v * factor:.5g}" for v in row[2:]]
            rows.append([f"{row.what}, {unit}".rstrip(", "), *values])
        return rows

    def findings(self) -> list[str]:
        """Return lines of text with unresolved quantities, the limits, the five largest influences, and the distinct final
        designs."""
        lines = [
            f"  derivatives of this quantity cannot be trusted: {each.what} (changes of the parameters by a millionth "
            f"change it by up to {each.tiny:.2g} %, changes by 1 % by up to {each.large:.2g} %: the motion is chaotic, or the "
            "error of the run is large); use a shorter run, or the mean of several runs"
            for each in self.unresolved
        ]
        best = self.machines[0].value if self.machines else math.nan
        sign = -1.0 if objective_text(self.objective).startswith("greatest ") else 1.0  # changes of the maximized quantity

        def change_text(*percent: float) -> str:
            if math.isnan(best) or not max(map(abs, percent)) > _MAX_SHOWN_PERCENT:
                return " / ".join(f"{change + 0.0:+.3g} %" for change in percent) + " of the objective"
            changes = [max(abs(best), 1e-300) * change / 100.0 for change in percent]  # for an objective near 0
            unit, factor = shown_unit(self.unit, max(map(abs, changes)))
            return " / ".join(f"{change * factor:+.3g} {unit}".rstrip() for change in changes)

        for limit in self.limits:
            values = limit.value_text()
            if limit.violation > 0.0:
                lines.append(f"  not met: {limit.what}; {limit.shortfall()}")
            elif limit.active:
                change = "increased" if limit.held else "relaxed"
                lines.append(f"  at its limit: {limit.what} ({values}); {_limit_influence(sign * limit.gain, change)}")
            else:
                lines.append(f"  met: {limit.what} ({values})")
        ranked = sorted(self.influences, key=lambda i: -max(abs(i.less), abs(i.more)))
        for influence in ranked[:5]:
            changes = change_text(sign * influence.less, sign * influence.more)
            lines.append(f"  1 % less / more {influence.what}: {changes}{influence.unmet_text()}")
        largest_percent = max((abs(change) for each in ranked[:1] for change in (each.less, each.more)), default=0.0)
        tolerance = max(_MAX_EQUAL_DIFFERENCE, _ROUNDING_SHARE * largest_percent / 100.0) * max(abs(best), 1e-300)
        equal = [m for m in self.machines if abs(m.value - best) <= tolerance]
        unit, factor = shown_unit(self.unit, abs(best))
        factor *= sign
        if len(equal) > 1 and len(equal) == len(self.machines):
            value = f"{best * factor:.4g} {unit}".rstrip()
            lines.append(
                f"  {len(equal)} different machines are equally good ({value}): the objective does not decide between them"
            )
        elif len(self.machines) > 1:
            counts = ", ".join(f"{m.starts} x {m.value * factor:.4g}" for m in self.machines[:6])
            lines.append(f"  {len(self.machines)} different machines: {counts} {unit}".rstrip())
        return lines

    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot every quantity after the search relative to its value before, on a logarithmic axis."""
        from jaxvib.draw.charts import before_after  # slow import

        shown = []
        for row in self.table:
            unit, factor = shown_unit(row.unit, max(abs(row.before), abs(row.after)))
            shown.append((f"{row.what}, {unit}".rstrip(", "), row.before * factor, row.after * factor))
        return before_after(shown, title=f"search for {objective_text(self.objective)}", ax=ax)

    def plot_convergence(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the objective of every start over the iterations.

        The descent allows violations, and its long steps overshoot: the objective may increase, until the polishing at the end.
        Designs that do not meet the demands are dashed.

        **Returns** a matplotlib figure, or the given `ax`.
        """
        from jaxvib.draw.charts import convergence
        from optimize.search.polish import MAX_VIOLATION

        best = int(np.argmin(self.values)) if np.any(np.isfinite(self.values)) else 0
        unit, factor = shown_unit(self.unit, float(np.max(np.abs(self.history), initial=0.0, where=np.isfinite(self.history))))
        label = f"{self.objective.replace('_', ' ')}, {unit}".rstrip(", ")
        return convergence(factor * self.history, self.history_violation < MAX_VIOLATION, best=best, label=label, ax=ax)


def _align_columns(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        ["  " + row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))] for row in rows
    ]


def _limit_influence(gain: float, change: str) -> str:
    """Return text on the change of a limit and the change of the objective that it causes.

    **Arguments**: `gain`: change of the objective, percent, if the limit changes by 1 %; if it is more than 10 %, the text
    states a smaller change of the limit, for which the linear prediction is valid; `change` of the limit, such as "relaxed".
    """
    share = 1.0
    while abs(gain) * share > _MAX_LINEAR_PERCENT:
        share /= 10.0
    if share < _MIN_LIMIT_CHANGE:
        return "the objective is almost zero relative to its slope"
    return f"{change} by {share:g} %: about {gain * share + 0.0:+.3g} % of the objective"


def objective_text(objective: str) -> str:
    """Return the name of the objective for sentences, such as "least power" or "greatest amplitude"."""
    words = objective.replace("_", " ")
    return f"greatest {words.removeprefix('negative ')}" if words.startswith("negative ") else f"least {words}"


def amplitude_names(scene: Scene) -> list[str]:
    """Return the names of the amplitudes of all coordinates, such as "amplitude of platform 1 (y1)"."""
    names = scene.machine.structure().coordinates
    if not isinstance(scene.machine, Platforms):
        return [f"amplitude of {name}" for name in names]
    return [f"amplitude of platform {k + 1} ({name})" for k, name in enumerate(names)]
