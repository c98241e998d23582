"""The published rotor with four pendulums: what the paper says its pendulums do, and what its equations give."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxvib.errors import require_one_of
from jaxvib.machine.drive import RunUp
from jaxvib.machine.effects.base import Gravity, StaticImbalance
from jaxvib.machine.loads import pendulums
from jaxvib.machine.rotor import rotor
from jaxvib.machine.scene import Scene
from jaxvib.results.status import status_name
from jaxvib.steady.jams.patterns import phase_pattern
from jaxvib.study.maps.run_ups import RunUps, run_ups

__all__ = ["VARIANTS", "RotorRegimes", "published_rotor", "rotor_regimes"]

_STIFFNESS, _POSITION, _LENGTH = (0.604e6, 0.555e6), (0.165, -0.155), 0.08

VARIANTS = {
    "printed": "c2 = k1 L1 - k2 L2, b as printed",
    "uncoupled": "c2 = 0, b as printed",
    "uncoupled, both dampers": "c2 = 0, b3 = 21.56 N m s as b1, b2, L1, L2 imply (the printed 10.41 is one support's share)",
}
"""Readings of the printed data under which a part of what the paper reports comes out."""

_PAPER = (
    (0.5e-3, 1.0e-3, "jammed at 169.6 rad/s, ripple 3.1, together"),
    (1.0e-3, 1.5e-2, "unsteady between the critical speeds, in opposite pairs"),
    (1.5e-2, 2.0e-2, "jammed at 271.1 rad/s, ripple 4.6, in opposite pairs"),
    (2.0e-2, 4.0e-2, "balanced"),
    (4.0e-2, np.inf, "turning with the rotor, not balanced"),
)


def published_rotor(mu: float = 9.2e-4, variant: str = "printed", *, eccentricity: float = 2.2e-4) -> Scene:
    """The rotor with four pendulums of the paper, run up at 230 rad/s^2 to 460 rad/s.

    **Arguments**: `mu` N m s, of the pendulums' bearings; `variant` one of `VARIANTS`; `eccentricity` m (the printed 25*10^-1
    is no length; the ripple says about 2.2e-4).

    **Returns** `Scene`. **Raises** `InputError` for a variant that is none.

    >>> from jaxvib.study.maps.published_rotor import published_rotor
    >>> published_rotor().loads.count
    4

    Source: Artyunin 2013, section IV; the length 0.08 m of the pendulums is printed as "L1=L2=0,8".
    """
    require_one_of(variant, VARIANTS, "variant")
    (k1, k2), (l1, l2) = _STIFFNESS, _POSITION
    machine = rotor(
        mass=37.0,
        transverse_inertia=0.479,
        polar_inertia=0.093,
        stiffness=_STIFFNESS,
        damping=0.0,
        position=_POSITION,
        stations=(0.28, 0.25, -0.25, -0.28),
        stiffness_terms=(k1 + k2, k1 * l1 + k2 * l2 if variant == "printed" else 0.0, k1 * l1**2 + k2 * l2**2),
        damping_terms=(843.17, -0.47, 21.56 if variant == "uncoupled, both dampers" else 10.41),
    )
    bobs = pendulums(count=4, mass=0.05, radius=_LENGTH, drag=mu / _LENGTH**2)
    return Scene(machine, bobs, RunUp(460.0, 230.0), (Gravity(), StaticImbalance(37.0 * eccentricity)))


class RotorRegimes(NamedTuple):
    """Regimes of the published rotor over its pendulums' friction.

    **Attributes**: `mu` (nm,) N m s; `paper` what the paper says at each; `computed` for each variant the `RunUps` over mu;
    `until` s, when it was looked at.
    """

    mu: np.ndarray
    paper: list[str]
    computed: dict[str, RunUps]
    until: float

    def said(self, variant: str, k: int) -> str:
        """The regime of the variant at the k-th mu from the first start, in words."""
        found = self.computed[variant]
        kind = str(found.kind[k, 0])
        if kind == "jammed":
            pattern = status_name(phase_pattern(found.regime.phase[k, 0]))
            return f"jammed at {found.omega[k, 0]:.1f}, ripple {float(found.regime.ripple[k, 0]):.1f}, {pattern}"
        if kind in ("unsettled", "parted"):
            return f"{kind}, mean {found.omega[k, 0]:.1f}"
        return kind

    def summary(self) -> str:
        """A table: mu, the paper, each variant."""
        names = list(self.computed)
        rows = [["mu, N m s", "paper", *names]]
        rows += [
            [f"{m:.2e}", said, *(self.said(v, k) for v in names)]
            for k, (m, said) in enumerate(zip(self.mu, self.paper, strict=True))
        ]
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([f"the published rotor {self.until:g} s after the start, pendulums together at first", *lines])


def rotor_regimes(
    mu: Sequence[float], variants: Sequence[str] = tuple(VARIANTS), *, until: float = 6.0, starts: int | None = None
) -> RotorRegimes:
    """Runs the published rotor up at each friction `mu` (N m s), in each of the `variants`, and names what comes out.

    **Arguments**: `until` s; `starts` random starts in place of the one in which the pendulums hang together.

    **Returns** `RotorRegimes`. **Raises** `InputError` for a variant that is none.

    Source: Artyunin 2013, section V.
    """
    values = np.asarray(mu, dtype=float)
    # The paper's pendulums hang at exactly one angle.
    angles = [[-0.5 * np.pi] * 4] if starts is None else None
    computed = {
        name: run_ups(
            published_rotor(variant=name), until, drag=list(values / _LENGTH**2), starts=starts, angles=angles, batch=8
        )
        for name in variants
    }
    paper = [next((words for low, high, words in _PAPER if low <= m < high), "not said") for m in values]
    return RotorRegimes(values, paper, computed, until)
