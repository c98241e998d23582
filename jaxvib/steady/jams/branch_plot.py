"""Diagram and summary of a branch of jams."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jax import Array

from jaxvib.display import Drawn, Onto, SpeedUnit, speed_text
from jaxvib.equations.linear import estimated_frequencies
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.steady.jams.folds import sampled_modes


class _Branch(Protocol):
    """Plotted arrays of a branch, with one entry for each point along the load speed."""

    omega: Array
    rotor_speed: Array
    stable: Array
    amplitude: Array
    foundation_force: Array
    scene: Scene


def branch_summary(branch: _Branch, marks: Sequence[tuple[str, float, float]], stability_text: str) -> str:
    """Return text with the ranges of a branch and its special points, for arguments as in `plot_branch`."""
    omega, stable = np.asarray(branch.omega), np.asarray(branch.stable)
    ends = speed_text([np.fmin.reduce(omega), np.fmax.reduce(omega)], 6, " to ")
    lines = [
        f"{omega.size} points from {ends}, {100.0 * np.mean(stable):.1f} % of them stable {stability_text}; "
        f"resonances {speed_text(estimated_frequencies(branch.scene), 6)}"
    ]
    return "\n".join(
        [*lines, *(f"  {KINDS[kind]}: Omega {speed_text(w, 6)}, rotor {speed_text(n, 6)}" for kind, w, n in marks)]
    )


KINDS = {
    "fold": "fold",
    "torus": "torus bifurcation",
    "symmetry": "loss of symmetry",
    "period_doubling": "period doubling",
}
"""Names of special points, for texts and tables."""

MARKS = {
    "fold": "fold: the jam ends and the loads jump",
    "torus": "torus bifurcation: the jam begins to pulsate",
    "symmetry": "loss of symmetry: loads separate, or the two halves of a turn differ",
    "period_doubling": "period doubles",
}
"""Meanings of special points, for a legend."""


def modes_of(omega: np.ndarray, rotor_speed: np.ndarray, resonances: np.ndarray) -> np.ndarray:
    """Return the number of the jam mode of each point of a branch, from the folds between its points: `omega`, rad/s,
    ascending, and `rotor_speed`, rad/s, NaN if no orbit converged."""
    solved = np.isfinite(rotor_speed)
    _, ends, numbers = sampled_modes(omega[solved], rotor_speed[solved], resonances)
    return numbers[np.searchsorted(np.append(omega[solved], np.inf)[ends], omega, side="right")]


def plot_branch(
    branch: _Branch,
    marks: Sequence[tuple[str, float, float]],
    unit: SpeedUnit | None,
    most: float | None,
    stability_text: str,
    show: Sequence[str],
    linear: bool,
    ax: Onto,
    modes: np.ndarray | None = None,
    resonances: np.ndarray | None = None,
) -> Drawn:
    """Plot a branch, see `Branches.plot`. **Raises** `InputError` for `most` below all rotor speeds of the branch.

    **Arguments**: `marks`: special points (kind, load speed, rotor speed); `stability_text`: text on how stability is
    determined; `modes`: number of the jam mode at each point, default: from the folds between the points; `resonances` (nd,)
    rad/s, default: computed here.
    """
    from jaxvib.draw.charts import branch_diagram  # slow import

    at = float(branch.scene.drive.speed)
    top = 4.0 / 3.0 * at if most is None else most
    kinds = sorted({kind for kind, _, _ in marks})
    shown = {kind: np.array([(w, n) for k, w, n in marks if k == kind and n <= top]).reshape(-1, 2) for kind in kinds}
    rotor_speed = np.asarray(branch.rotor_speed)
    if not np.any(rotor_speed <= top):
        raise InputError("most", f"is {top:g} rad/s; the branches begin at {np.nanmin(rotor_speed):.4g} rad/s")
    if resonances is None:
        resonances = np.asarray(estimated_frequencies(branch.scene))
    if modes is None:
        modes = modes_of(np.asarray(branch.omega), rotor_speed, resonances)
    return branch_diagram(
        np.where(rotor_speed <= top, rotor_speed, np.nan),
        np.asarray(branch.omega),
        np.asarray(branch.stable),
        amplitude=np.asarray(branch.amplitude),
        force=np.asarray(branch.foundation_force),
        resonances=resonances,
        modes=modes,
        marks=[(MARKS.get(kind, kind), points[:, 1], points[:, 0]) for kind, points in shown.items() if points.size],
        names=branch.scene.machine.structure().coordinates,
        units=branch.scene.machine.structure().units,
        at=at if at <= top else None,
        unit=unit,
        stability_text=stability_text,
        show=show,
        linear=linear,
        ax=ax,
    )
