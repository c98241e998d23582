"""How many harmonics an exact jam asks for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.draw.comparison import convergence_chart
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.machine.units import Number, number
from jaxvib.steady.jam_orbit import jam_orbit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["HarmonicConvergence", "harmonic_convergence"]


class HarmonicConvergence(NamedTuple):
    """What the number of harmonics leaves: `harmonics` (n,) highest one of the carrier; of the jams at `omega` (w,) rad/s the
    relative `error` (n, w) of the rotor speed against twice as many as the last, and what each orbit says of its own error,
    `known` (n, w)."""

    omega: np.ndarray
    harmonics: np.ndarray
    error: np.ndarray
    known: np.ndarray

    def plot(self) -> Figure:
        """Error over the highest harmonic, a line a load speed; what the orbits say of themselves dashed."""
        names = [f"{w:.4g} rad/s" for w in self.omega]
        return convergence_chart(self.harmonics, self.error, self.known, names=names)


def harmonic_convergence(
    scene: Scene, omega: Sequence[Number], *, points: Sequence[int] = (4, 6, 8, 10, 12, 16, 20, 24)
) -> HarmonicConvergence:
    """The error of exact jams over the number of collocation points: it falls exponentially (spectral convergence).

    **Arguments**: `omega` load speeds, rad/s or text; `points` of the collocation, ascending, see `jam_orbit`.

    **Returns** `HarmonicConvergence`. **Raises** `InputError` as `jam_orbit`.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=0.05, beta=1.0, speed=3.0)
    >>> found = harmonic_convergence(form.scene(), [0.97], points=(4, 8))
    >>> [f"{e:.0e}" for e in found.error[:, 0]]
    """
    if len(points) == 0 or any(b <= a for a, b in zip(points, points[1:], strict=False)):
        raise InputError("points", f"are {points!r}; give numbers of points in ascending order")
    speeds = [float(number(w, "rad/s", "omega", low=0.0, open_low=True)) for w in omega]
    rows = [[jam_orbit(scene, omega=w, points=m, throw=False) for w in speeds] for m in (*points, 2 * points[-1])]
    n = np.array([[float(orbit.rotor_speed) for orbit in row] for row in rows])
    known = np.array([[float(orbit.error) for orbit in row] for row in rows])
    highest = np.array([row[0].harmonics for row in rows])
    return HarmonicConvergence(np.asarray(jnp.asarray(speeds)), highest[:-1], np.abs(n[:-1] / n[-1] - 1.0), known[:-1])
