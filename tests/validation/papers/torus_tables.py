"""Published tables of the lowest initial speeds from which balls are captured, compared with computed ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.state import State
from jaxvib.machine.effects.contact import LoadContact
from jaxvib.machine.effects.sliding import FreeSpin
from jaxvib.machine.scene import Scene
from jaxvib.machine.torus import require_torus_balls
from jaxvib.motion.ensemble import Equations, ensemble
from jaxvib.motion.plan import EqualSteps
from jaxvib.study.capture.capture import DOUBLINGS, MAX_CAPTURED_LAG, moving_state, steps_per_second
from papers.machines import TORUS_SPEED, published_torus
from papers.printed_torus import TABLES, PublishedRow, cosine_torus, gap_torus, printed_torus
from papers.step_doubling import refine

__all__ = ["CONTACT", "MODELS", "TorusTables", "published_tables"]

CONTACT = LoadContact(stiffness=4e4, restitution=0.5)
"""Contact between balls, which the paper does not describe. A contact lasts 3 ms, 0.07 turns."""

SPIN = FreeSpin()

_COARSE, _ROUNDS, _LANES = 19, 2, 64

_GRID = np.linspace(-1.0, -0.1, _COARSE)
"""Initial speeds that are tried first."""


class _Runs(NamedTuple):
    """Batch of runs: parameters (B,), and shifts (B, 2) of the balls from the positions of the paper."""

    gap: Array
    damping: Array
    stiffness: Array
    friction: Array
    speed: Array
    shift: Array


def _alone(run: _Runs) -> tuple[Scene, State]:
    scene = published_torus(run.gap, damping=run.damping, stiffness=run.stiffness, friction=run.friction)
    return scene, moving_state(scene, run.speed, run.shift)


def _touching(run: _Runs) -> tuple[Scene, State]:
    scene, state = _alone(run)
    # At the paper's angle the balls would overlap by 0.2 % of their size.
    loads = require_torus_balls(scene.loads, "the table")
    ratio = loads.ball_radius / loads.radius
    apart = 2.0 * (jnp.arcsin(ratio) - jnp.arctan(ratio))
    state = eqx.tree_at(lambda s: s.angle[0], state, state.angle[0] + jnp.asarray([0.0, 1.0]) * apart)
    return Scene(scene.machine, scene.loads, scene.drive, (*scene.all_effects, CONTACT)), state


def _spinning(run: _Runs) -> tuple[Scene, State]:
    scene, state = _alone(run)
    return Scene(scene.machine, scene.loads, scene.drive, (*scene.all_effects, SPIN)), state


class _Model(NamedTuple):
    make: Callable[[_Runs], tuple[Scene, State]]
    equations: Equations


MODELS = {
    "derived": _Model(_alone, vector_field),
    "printed": _Model(_alone, printed_torus),
    "gap lever": _Model(_alone, gap_torus),
    "cosine": _Model(_alone, cosine_torus),
    "spinning": _Model(_spinning, vector_field),
    "contact": _Model(_touching, vector_field),
}
"""Models by name. "derived": the equations of jaxvib; "spinning" with `FreeSpin`, "contact" with `CONTACT`. "printed": the
equations as printed in the paper (`PrintedTorus`); "gap lever" with the gap as the lever arm of the friction in the equation of
the angle in the tube, "cosine" with the correct projection of the unbalance."""


TABLE_TOLERANCE = 0.011
"""Largest change of a threshold by a doubling of the steps that counts as converged: 0.01 plus half of the resolution."""


class TorusTables(NamedTuple):
    """Points of the paper's tables 1 and 2, and computed values.

    **Attributes** (P points, M models)

    - `damping` n, `stiffness` p, `friction` k (m), `gap` (R_1 - r)/e, and the `paper`'s speed, (P,); `models`: M names
    - `least` (M, P): lowest initial speed that is captured, -1 if a ball at rest is captured, NaN if no speed is captured
    - `threshold` (M, P): speed above which all speeds are captured, NaN if the highest speed is not captured. `least` and
      `threshold` lie halfway between two speeds whose difference is the resolution
    - `captured` (M, P, S): True for each of the speeds `tried` (S,) that is captured
    - `fraction` (M, P): captured fraction of `starts` perturbed starts at the paper's speed
    - `steps_per_turn` (M, P): smallest number of steps per turn of the rotor in the last scan
    - `last_change` (M, P, 2): changes of `least` and `threshold` by the last doubling of the steps, infinite if one of them
      appeared or vanished; NaN without a doubling
    - `turns` of the rotor in each run

    If `least` and `threshold` differ, captures and failures alternate between them, and the paper's number may be any of the
    boundaries. If the fraction is neither 0 nor 1, or a boundary still changes, the outcome there is chaotic. Intervals
    narrower than the spacing of the speeds `tried` are not detected.
    """

    damping: np.ndarray
    stiffness: np.ndarray
    friction: np.ndarray
    gap: np.ndarray
    paper: np.ndarray
    models: tuple[str, ...]
    least: np.ndarray
    threshold: np.ndarray
    fraction: np.ndarray
    tried: np.ndarray
    captured: np.ndarray
    steps_per_turn: np.ndarray
    last_change: np.ndarray
    resolution: float
    starts: int
    turns: int

    def rows(self) -> list[np.ndarray]:
        """The points of each row of the tables, as indices."""
        keys = np.stack([self.damping, self.stiffness, self.friction], axis=1)
        ends = np.flatnonzero(np.any(np.diff(keys, axis=0) != 0.0, axis=1)) + 1
        return np.split(np.arange(self.gap.size), ends)

    @property
    def difference(self) -> np.ndarray:
        """The computed speed minus the paper's, (M, P): of `least` and `threshold` the nearer one; NaN if there is neither."""
        return self._nearer(np.stack([self.least, self.threshold], axis=-1) - self.paper[:, None])

    @property
    def converged(self) -> np.ndarray:
        """True if the last doubling of the steps moved the nearer border by 0.011 of the rotor speed at most, (M, P)."""
        return self._nearer(self.last_change) <= TABLE_TOLERANCE

    def _nearer(self, values: np.ndarray) -> np.ndarray:
        """Entries of `values` (M, P, 2) for the border that is nearer to the paper's speed."""
        far = np.abs(np.stack([self.least, self.threshold], axis=-1) - self.paper[:, None])
        which = np.argmin(np.where(np.isnan(far), np.inf, far), axis=-1)
        return np.take_along_axis(values, which[..., None], axis=-1)[..., 0]

    def summary(self) -> str:
        """For each row of the tables a line for each gap and model, for a person to read; "#" are captures, "." failures."""
        low, high, n = self.tried[0], self.tried[-1], self.tried.size
        lines = [
            f"initial speeds captured in {self.turns} turns: the least, all from; {n} speeds {low:g} .. {high:g};",
            f"difference of the nearer one from the paper; share of {self.starts} starts perturbed at the paper's speed;",
            "steps for a turn, and by how much their last doubling moved the two borders",
        ]
        for row in self.rows():
            i = row[0]
            lines.append(f"n = {self.damping[i]:g}, p = {self.stiffness[i]:g}, k = {self.friction[i]:g} m")
            lines.append(f"   gap   paper  {'model':9s}  least    from  nearer  share  steps   moved         {'outcomes':{n}s}")
            for i in row:
                for m, name in enumerate(self.models):
                    point = f"  {self.gap[i]:4.1f} {self.paper[i]:7.3f}" if m == 0 else " " * 14
                    pattern = "".join(".#"[int(x)] for x in self.captured[m, i])
                    numbers = f"{self.least[m, i]:7.3f} {self.threshold[m, i]:7.3f} {self.difference[m, i]:+7.3f}"
                    steps = f"{self.steps_per_turn[m, i]:5.0f} " + " ".join(f"{x:6.3f}" for x in self.last_change[m, i])
                    lines.append(f"{point}  {name:9s}{numbers}  {self.fraction[m, i]:5.2f}  {steps}  {pattern}")
        return "\n".join(lines)


def published_tables(
    models: Sequence[str] = ("derived", "printed"),
    rows: Sequence[PublishedRow] = TABLES,
    *,
    turns: int = 2000,
    starts: int = 8,
    spread: float = 1e-3,
    seed: int = 0,
    doublings: int = DOUBLINGS,
) -> TorusTables:
    """Compute the paper's tables of lowest initial speeds by several models, with the convergence of each entry.

    For each point 19 speeds from -1 to -0.1 are tried. Then four speeds between the lowest captured one and the next lower one,
    and four below the threshold, are tried, twice. The scan is repeated with twice the steps until `least` and `threshold`
    change by at most 0.011; points that have converged are not repeated. Finally `starts` perturbed starts at the paper's speed
    are computed. All points are computed together, sorted by the number of steps: about 5000 runs and ten minutes of CPU time
    for each model.

    **Arguments**: `models`: names of `MODELS`; `rows` of `TABLES`; `turns` of the rotor in each run; `starts`: in all except
    the first, each ball is shifted along the ring by its own random angle of up to `spread` rad, with the `seed`; `doublings`:
    largest number of doublings of the steps.

    Results:

    - "printed": 35 of the 47 speeds differ by less than 0.05 from the paper; "gap lever": 28 (`doublings=1`). The lever arm
      R_1 is wrong, but it reproduces the tables more closely. At three of the smallest gaps with the lower friction, captures
      take long: with n = 0.1 and a gap of 0.5 the lowest speed is -0.757 in 2000 turns and -0.865 in 4000 (paper: -0.857). At p
      = 0.010 and a gap of 5.1 failures occur among captures up to -0.87 (paper: -0.868), at other speeds with other steps
    - "cosine", computed for two points with the gap as lever arm: no boundary changes by more than 0.002, except chaotic ones
    - "derived": no captures from speeds below -0.7, except isolated ones. The thresholds at p = 0.003 and 0.005 are 0.2 to 0.7
      above those of the paper, whose equations contain the rotation of the ball with f'^2 and not with f' (f' - w)
    - "spinning", computed for eight points with all gaps: captures from rest at seven of them, from -0.967 in the other. A free
      spin that begins at the bottom increases the speed of the balls by up to 0.35 of the rotor speed
    - "contact" changes the thresholds of "derived" by -0.07 to 0.07, a quarter of them by more than 0.03, mostly upward

    Source: Strautmanis et al. 2018, tables 1 and 2, where each speed has one start.
    """
    points = np.asarray(
        [(row.damping, row.stiffness, row.friction, *pair) for row in rows for pair in zip(row.gap, row.speed, strict=True)]
    )
    damping, stiffness, friction, gap, paper = points.T
    shifts = np.random.default_rng(seed).uniform(-spread, spread, (starts, 2))
    shifts[0] = 0.0

    def column(model: _Model) -> list[np.ndarray]:
        """Return `least` and `threshold` (P, 2), `captured` (P, S), `fraction`, `steps_per_turn` (P,), `last_change` (P, 2)."""
        needed = np.array([_steps_per_second(model, *point[:4]) for point in points])
        found = refine(
            lambda which, multiple: _scanned(model, points[which], multiple * needed[which], turns),
            lambda answer: answer[0],
            gap.size,
            TABLE_TOLERANCE,
            doublings,
        )
        steps = needed * found.multiple
        fraction = np.mean(_tried(model, points, steps, np.tile(paper[:, None], (1, starts)), shifts, turns), axis=1)
        per_turn = steps * 2.0 * np.pi / TORUS_SPEED
        return [*map(np.stack, zip(*found.results, strict=True)), fraction, per_turn, found.last_change]

    borders, captured, fraction, per_turn, last_change = map(np.stack, zip(*(column(MODELS[m]) for m in models), strict=True))
    return TorusTables(
        damping=damping,
        stiffness=stiffness,
        friction=friction,
        gap=gap,
        paper=paper,
        models=tuple(models),
        least=borders[..., 0],
        threshold=borders[..., 1],
        fraction=fraction,
        tried=_GRID,
        captured=captured,
        steps_per_turn=per_turn,
        last_change=last_change,
        resolution=float((_GRID[1] - _GRID[0]) * _SHARES[0] ** _ROUNDS),
        starts=starts,
        turns=turns,
    )


_SHARES = np.arange(1, 5) / 5.0
"""Positions between two speeds at which others are tried."""


def _from(captured: np.ndarray) -> np.ndarray:
    """Return the index of the lowest speed above which all are captured, for captures (P, S); S if there is none."""
    failing = ~captured[:, ::-1]
    return np.where(np.any(failing, axis=1), captured.shape[1] - np.argmax(failing, axis=1), 0)


def _between(speed: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the speeds (P, 1) below and at an index; at the ends of the grid, the two outermost ones."""
    at = np.clip(at, 1, speed.shape[1] - 1)[:, None]
    return np.take_along_axis(speed, at - 1, axis=1), np.take_along_axis(speed, at, axis=1)


def _scanned(model: _Model, points: np.ndarray, steps: np.ndarray, turns: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return `least` and `threshold` of each of the `points` (P, 5), and `captured`; `steps` (P,) per second."""
    speed = np.tile(_GRID, (len(points), 1))
    captured = first = _tried(model, points, steps, speed, np.zeros((_COARSE, 2)), turns)
    for _ in range(_ROUNDS):
        inside = [_between(speed, np.argmax(captured, axis=1)), _between(speed, _from(captured))]
        finer = np.concatenate([low + (high - low) * _SHARES for low, high in inside], axis=1)
        outcomes = _tried(model, points, steps, finer, np.zeros((finer.shape[1], 2)), turns)
        speed, captured = np.concatenate([speed, finer], axis=1), np.concatenate([captured, outcomes], axis=1)
        order = np.argsort(speed, axis=1)
        speed, captured = (np.take_along_axis(x, order, axis=1) for x in (speed, captured))
    lowest, above = np.argmax(captured, axis=1), _from(captured)
    least, threshold = (np.where(at == 0, -1.0, np.mean(_between(speed, at), axis=0)[:, 0]) for at in (lowest, above))
    least = np.where(np.any(captured, axis=1), least, math.nan)
    threshold = np.where(above == speed.shape[1], math.nan, threshold)
    return list(zip(np.stack([least, threshold], axis=1), first, strict=True))


def _tried(
    model: _Model, points: np.ndarray, steps: np.ndarray, speed: np.ndarray, shift: np.ndarray, turns: int
) -> np.ndarray:
    """Return True for each point (P, 5) that is captured from speeds (P, S) and positions (S, 2)."""
    each = speed.shape[1]
    damping, stiffness, friction, gap = (jnp.asarray(np.repeat(x, each)) for x in points.T[:4])
    places = jnp.asarray(np.tile(shift, (len(points), 1)))
    runs = _Runs(gap, damping, stiffness, friction, jnp.asarray(speed.ravel()), places)
    return _outcomes(model, runs, np.repeat(steps, each), turns).reshape(speed.shape)


def _outcomes(model: _Model, runs: _Runs, needed: np.ndarray, turns: int) -> np.ndarray:
    """Return True for each run (B,) at whose end all balls turn with the rotor, with at least `needed` (B,) steps per second.

    Runs are computed in blocks of equal size, sorted by the number of steps, by one program. Each block has an additional run
    with different parameters; otherwise a parameter that all runs share would be a constant of another program.
    """
    order, size = np.argsort(-needed, kind="stable"), _LANES * len(jax.devices()) - 1
    gap, damping, stiffness, friction, still = (jnp.asarray([x]) for x in (7.5, 0.2, 0.02, 1e-5, 0.0))
    other = _Runs(gap, damping, stiffness, friction, still, jnp.asarray([[1e-3, 2e-3]]))
    end, captured = 2.0 * np.pi * turns / TORUS_SPEED, np.zeros(runs.gap.size, dtype=bool)
    for begin in range(0, order.size, size):
        block = order[begin : begin + size]
        filled = np.concatenate([block, np.full(size - block.size, block[-1])])
        values = jax.tree.map(lambda x, y, filled=filled: jnp.concatenate([x[filled], y]), runs, other)
        steps = EqualSteps(max(16, math.ceil(end * needed[block[0]])))
        ran = ensemble(
            model.make, values, end, stepsize_controller=steps, estimate=False, batch=_LANES, equations=model.equations
        )
        slip = np.abs(np.asarray(ran.load_speed) / TORUS_SPEED - 1.0)
        captured[block] = (np.all(slip < MAX_CAPTURED_LAG, axis=1) & np.asarray(ran.finite))[: block.size]
    return captured


def _steps_per_second(model: _Model, damping: float, stiffness: float, friction: float, gap: float) -> float:
    numbers = [jnp.asarray(x) for x in (gap, damping, stiffness, friction)]
    scene, _ = model.make(_Runs(*numbers, speed=jnp.zeros(()), shift=jnp.zeros(2)))
    return steps_per_second(scene, model.equations)
