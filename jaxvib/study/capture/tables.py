"""The published tables of least initial speeds, paper against computed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import State, vector_field
from jaxvib.errors import InputError
from jaxvib.machine.effects.contact import LoadContact
from jaxvib.machine.scene import Scene
from jaxvib.motion.ensemble import Equations, ensemble
from jaxvib.motion.steps import EqualSteps
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.study.capture.capture import CAUGHT, PER_RADIAN, thrown_state
from jaxvib.study.capture.published_torus import TABLES, PublishedRow, letter_torus, printed_torus, published_scene
from jaxvib.units import count

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["CONTACT", "MODELS", "TorusTables", "published_tables"]

CONTACT = LoadContact(stiffness=4e4, restitution=0.5)
"""Of balls that touch: the paper leaves contact open. A contact lasts 3 ms, 0.07 turns."""

_PER_CONTACT = 2.0
"""Steps for each radian of what a contact swings with."""

_COARSE, _REFINED, _ROUNDS, _LANES = 19, 4, 2, 64


class _Runs(NamedTuple):
    """Runs side by side, (B,) each, and the positions (B, 2) of the balls besides the paper's."""

    gap: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    friction: np.ndarray
    speed: np.ndarray
    shift: np.ndarray


def _alone(run: _Runs) -> tuple[Scene, State]:
    scene = published_scene(jnp.asarray(run.gap), run.damping, run.stiffness, run.friction)
    return scene, thrown_state(scene, run.speed, run.shift)


def _touching(run: _Runs) -> tuple[Scene, State]:
    scene, state = _alone(run)
    # At the paper's angle the balls would overlap by 0.2 % of their size.
    ratio = scene.loads.own_radius / scene.loads.radius  # pyright: ignore[reportAttributeAccessIssue]
    apart = 2.0 * (jnp.arcsin(ratio) - jnp.arctan(ratio))
    state = eqx.tree_at(lambda s: s.angle[0], state, state.angle[0] + jnp.asarray([0.0, 1.0]) * apart)
    return Scene(scene.machine, scene.loads, scene.drive, (*scene.effects, CONTACT)), state


class _Model(NamedTuple):
    make: Callable[[_Runs], tuple[Scene, State]]
    equations: Equations
    contact: bool


MODELS = {
    "derived": _Model(_alone, vector_field, False),
    "printed": _Model(_alone, printed_torus, False),
    "letter": _Model(_alone, letter_torus, False),
    "contact": _Model(_touching, vector_field, True),
}
"""By name: this package's equations, the paper's (`PrintedTorus`), the same to the letter, this package's with `CONTACT` of the balls."""


class TorusTables(Result):
    """Tables 1 and 2 of the paper, point by point, beside what was computed.

    **Attributes** (P points, M models): `damping` n, `stiffness` p, `friction` k m, `gap` and the `paper`'s least speed of
    each point, (P,); `models` M names; `threshold` (M, P), the least initial speed from which on every start is captured,
    -1 where all speeds are, NaN where the highest is not; `uncertainty` (M, P) of it, half the distance of the speeds that
    were tried last; `islands` (M, P), how often captures give way to failures again, going up the speeds; `fraction` (M, P),
    the share captured of `starts` perturbed starts at the paper's speed.

    Where there are islands the outcome below the threshold is chaotic: a speed that the paper has found is then one of many,
    and the share says how often its neighbours agree.
    """

    status = Computed.done

    damping: np.ndarray = eqx.field(metadata=in_unit("", "point"))
    stiffness: np.ndarray = eqx.field(metadata=in_unit("", "point"))
    friction: np.ndarray = eqx.field(metadata=in_unit("m", "point"))
    gap: np.ndarray = eqx.field(metadata=in_unit("", "point"))
    paper: np.ndarray = eqx.field(metadata=in_unit("", "point"))
    models: tuple[str, ...] = eqx.field(metadata=in_unit("", "model"))
    threshold: np.ndarray = eqx.field(metadata=in_unit("", "model", "point"))
    uncertainty: np.ndarray = eqx.field(metadata=in_unit("", "model", "point"))
    islands: np.ndarray = eqx.field(metadata=in_unit("", "model", "point"))
    fraction: np.ndarray = eqx.field(metadata=in_unit("", "model", "point"))
    starts: Array = eqx.field(metadata=in_unit(""))
    turns: Array = eqx.field(metadata=in_unit(""))

    def rows(self) -> list[np.ndarray]:
        """The points of each row of the tables, as indices."""
        keys = np.stack([self.damping, self.stiffness, self.friction], axis=1)
        ends = np.flatnonzero(np.any(np.diff(keys, axis=0) != 0.0, axis=1)) + 1
        return np.split(np.arange(self.gap.size), ends)

    def summary(self) -> str:
        """A line for each point: paper, and of each model threshold, its difference, islands, share at the paper's speed."""
        lines = [f"least initial speeds, {int(self.turns)} turns; share captured of {int(self.starts)} starts at the paper's"]
        for row in self.rows():
            i = row[0]
            lines.append(f"n = {self.damping[i]:g}, p = {self.stiffness[i]:g}, k = {self.friction[i]:g} m")
            lines.append("   gap   paper" + "".join(f" | {name:>9s}   diff isl share" for name in self.models))
            for i in row:
                cells = (
                    f" | {self.threshold[m, i]:9.3f} {self.threshold[m, i] - self.paper[i]:+6.3f} {int(self.islands[m, i]):3d}"
                    f" {self.fraction[m, i]:5.2f}"
                    for m in range(len(self.models))
                )
                lines.append(f"  {self.gap[i]:4.1f} {self.paper[i]:7.3f}" + "".join(cells))
        return "\n".join(lines)

    def plot(self) -> Figure:
        """Least initial speeds over the gap, a panel for each row of the tables. **Returns** a matplotlib figure."""
        from jaxvib.draw.capture import tables_chart  # slow to import: only who draws pays

        panels = [
            (
                f"n = {self.damping[row[0]]:g}, p = {self.stiffness[row[0]]:g}, k = {1e5 * self.friction[row[0]]:.0f}e-5 m",
                self.gap[row],
                {"paper": self.paper[row], **{name: self.threshold[m][row] for m, name in enumerate(self.models)}},
            )
            for row in self.rows()
        ]
        return tables_chart(panels)


def published_tables(
    models: Sequence[str] = ("derived", "printed"),
    rows: Sequence[PublishedRow] = TABLES,
    *,
    turns: int = 2000,
    starts: int = 8,
    spread: float = 1e-3,
    seed: int = 0,
) -> TorusTables:
    """The paper's tables of least initial speeds by other equations, and how sure each entry is.

    For each point 19 speeds from -1 to -0.1 are tried, the stretch below the least from which on all are captured twice finer,
    five times each, and `starts` perturbed starts at the paper's own speed. All points advance together, sorted by the steps
    they need; the whole is about 1700 runs a model, some minutes on two cores.

    **Arguments**: `models` names of `MODELS`; `rows` of `TABLES`; `turns` of the rotor that each run takes; `starts`, all but
    the first moved along the ring, each ball by itself, by up to `spread` rad, by `seed`.

    **Returns** `TorusTables`. **Raises** `InputError` for a model that there is not.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> from jaxvib.study.capture.published_torus import TABLES
    >>> row = TABLES[-1]._replace(gap=(5.1,), speed=(-0.868,))
    >>> found = published_tables(["printed"], [row], turns=5, starts=1)
    >>> found.paper.tolist(), found.threshold.shape
    ([-0.868], (1, 1))

    Source: Strautmanis et al. 2018, tables 1 and 2, where each speed has one start.
    """
    for name in models:
        if name not in MODELS:
            raise InputError("models", f"has {name!r}; allowed: {', '.join(MODELS)}")
    points = [
        (row.damping, row.stiffness, row.friction, *pair) for row in rows for pair in zip(row.gap, row.speed, strict=True)
    ]
    damping, stiffness, friction, gap, paper = np.asarray(points).T
    shifts = np.random.default_rng(seed).uniform(-spread, spread, (count(starts, "starts"), 2))
    shifts[0] = 0.0

    def tried(model: _Model, speed: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Whether each point is captured from speeds (P, S) and positions (S, 2)."""
        each = speed.shape[1]
        fields = (np.repeat(x, each) for x in (gap, damping, stiffness, friction))
        runs = _Runs(*fields, speed.ravel(), np.tile(shift, (gap.size, 1)))
        return _outcomes(model, runs, count(turns, "turns")).reshape(speed.shape)

    def entry(model: _Model) -> tuple[np.ndarray, ...]:
        speed = np.tile(np.linspace(-1.0, -0.1, _COARSE), (gap.size, 1))
        captured = tried(model, speed, np.zeros((_COARSE, 2)))
        for _ in range(_ROUNDS):
            least = np.array([_least(line) for line in captured])
            # Without a threshold between two speeds any stretch is as good.
            at = np.clip(least, 1, speed.shape[1] - 1)
            low, high = (np.take_along_axis(speed, (at - k)[:, None], axis=1) for k in (1, 0))
            finer = low + (high - low) * np.arange(1, _REFINED + 1) / (_REFINED + 1)
            speed = np.concatenate([speed, finer], axis=1)
            captured = np.concatenate([captured, tried(model, finer, np.zeros((_REFINED, 2)))], axis=1)
            order = np.argsort(speed, axis=1)
            speed, captured = (np.take_along_axis(x, order, axis=1) for x in (speed, captured))
        least = np.array([_least(line) for line in captured])
        at = np.clip(least, 1, speed.shape[1] - 1)
        low, high = (np.take_along_axis(speed, (at - k)[:, None], axis=1)[:, 0] for k in (1, 0))
        threshold = np.where(least == 0, -1.0, np.where(least == speed.shape[1], math.nan, 0.5 * (low + high)))
        islands = np.sum(captured[:, :-1] & ~captured[:, 1:], axis=1)
        fraction = np.mean(tried(model, np.tile(paper[:, None], (1, starts)), shifts), axis=1)
        return threshold, np.where(least == 0, 0.0, 0.5 * (high - low)), islands.astype(float), fraction

    found = [np.stack(part) for part in zip(*(entry(MODELS[name]) for name in models), strict=True)]
    numbers = (damping, stiffness, friction, gap, paper)
    return TorusTables(*numbers, tuple(models), *found, starts=jnp.asarray(starts), turns=jnp.asarray(turns))


def _least(captured: np.ndarray) -> int:
    failing = np.flatnonzero(~captured)
    return 0 if failing.size == 0 else int(failing[-1]) + 1


def _outcomes(model: _Model, runs: _Runs, turns: int) -> np.ndarray:
    """Whether all balls of each run (B,) turn with the rotor at its end.

    Runs go in blocks of one size, sorted by the steps they need, so that one program answers them all. Beside the runs each
    block has one of its own kind: no number is shared by all, which would ask for another program.
    """
    gaps, which = np.unique(runs.gap, return_inverse=True)
    speed = float(published_scene(1.0, 0.1, 0.01, 0.0).drive.speed)
    needed = np.array([_steps_per_second(model, float(gap)) for gap in gaps])[which]
    order, size = np.argsort(-needed, kind="stable"), _LANES * len(jax.devices()) - 1
    other = _Runs(*(np.asarray([x]) for x in (7.5, 0.2, 0.02, 1e-5, 0.0)), np.asarray([[1e-3, 2e-3]]))
    end, captured = 2.0 * np.pi * turns / speed, np.zeros(runs.gap.size, dtype=bool)
    for begin in range(0, order.size, size):
        block = order[begin : begin + size]
        filled = np.concatenate([block, np.full(size - block.size, block[-1])])
        values = _Runs(*(jnp.asarray(np.concatenate([x[filled], y])) for x, y in zip(runs, other, strict=True)))
        steps = EqualSteps(max(16, math.ceil(end * needed[block[0]])))
        ran = ensemble(
            model.make, values, end, stepsize_controller=steps, estimate=False, lanes=_LANES, equations=model.equations
        )
        slip = np.abs(np.asarray(ran.load_speed) / speed - 1.0)
        captured[block] = (np.all(slip < CAUGHT, axis=1) & np.asarray(ran.finite))[: block.size]
    return captured


def _steps_per_second(model: _Model, gap: float) -> float:
    scene = published_scene(gap, 0.1, 0.01, 0.0)
    own = scene.loads.own_frequency(scene.drive.speed)
    assert own is not None
    if not model.contact:
        return PER_RADIAN * float(own)
    # Two balls side by side, rolling counted in.
    swing = math.sqrt(2.0 * float(CONTACT.stiffness) / (float(scene.loads.inertia_factor()) * float(scene.loads.mass)))
    return max(PER_RADIAN * float(own), _PER_CONTACT * swing)
