"""Convergence of exact jams with the number of harmonics."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, speed_text
from jaxvib.equations.jammed_bodies import jammed_bodies
from jaxvib.equations.linear import jammed_model
from jaxvib.errors import InputError, quoted
from jaxvib.machine.effects.base import has_half_turn_symmetry
from jaxvib.machine.scene import Scene
from jaxvib.numerics.fourier import grid_of
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.folds import light_rotor_speed
from jaxvib.steady.orbits.solve import branch_tangent, periodic_motion
from jaxvib.units import Number, count, numbers


class HarmonicConvergence(Result):
    """Errors of exact jams that are computed with a limited number of harmonics.

    **Attributes**

    - `harmonics` (n,): the highest harmonic of the carrier
    - `omega` (jams,): load speeds, rad/s
    - `error` (n, jams): relative error of the rotor speed, by comparison with the jam that is computed with twice the
      largest number of collocation points
    - `estimate` (n, jams): estimate of this error, computed without a more accurate jam
    """

    status = Computed.done

    omega: np.ndarray = eqx.field(metadata=in_unit("rad/s", "omega"))
    harmonics: np.ndarray = eqx.field(metadata=in_unit("", "harmonics"))
    error: np.ndarray = eqx.field(metadata=in_unit("", "harmonics", "omega"))
    estimate: np.ndarray = eqx.field(metadata=in_unit("", "harmonics", "omega"))

    def summary(self) -> str:
        """Return a line of text for each highest harmonic: the largest error and the largest estimate."""
        rows = zip(self.harmonics, np.max(self.error, axis=1), np.max(self.estimate, axis=1), strict=True)
        return "\n".join(
            f"harmonics up to {int(n)}: error {error:.1e}, estimated {estimate:.1e}" for n, error, estimate in rows
        )

    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the error over the highest harmonic, with a line for each load speed; the estimates are dashed lines."""
        names = [speed_text(w, 4) for w in self.omega]
        from jaxvib.draw.comparison import convergence_chart  # slow import

        return convergence_chart(self.harmonics, self.error, self.estimate, names=names, ax=ax)


@validated
def harmonic_convergence(
    scene: Scene, omega: Sequence[Number], *, points: Sequence[int] = (4, 6, 8, 10, 12, 16, 20, 24)
) -> HarmonicConvergence:
    """Return the errors of exact jams for several numbers of collocation points; they decrease exponentially.

    **Arguments**

    - `scene` of the jams
    - `omega`: load speeds, rad/s or text; typical: 1 to 5 speeds on the branch
    - `points`: numbers of collocation points, ascending, see `jam_orbit`; typical: 4 to 24 (the default)

    **Returns** `HarmonicConvergence`. **Raises** `InputError` if the points do not ascend, or if a speed is not positive.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=0.05, beta=1.0, speed=3.0)
    >>> found = harmonic_convergence(form.scene(), [0.97], points=(4, 8))
    >>> [bool(error < limit) for error, limit in zip(found.error[:, 0], (1e-4, 1e-10))]
    [True, True]

    Source: this package; the jams are those of `jam_orbit`.
    """
    if len(points) == 0 or any(b <= a for a, b in itertools.pairwise(points)):
        raise InputError("points", f"are {quoted(points)}; give numbers of points in ascending order")
    count(points[0], "points[0]", low=2)
    speeds = jnp.atleast_1d(numbers(omega, "rad/s", "omega", None, low=0.0, open_low=True))
    half = has_half_turn_symmetry(scene.all_effects)
    rows = [_errors(scene, speeds, grid_of(m, half).theta.size) for m in (*points, 2 * points[-1])]
    n, estimate = (np.stack([np.asarray(row[k]) for row in rows]) for k in range(2))
    highest = np.array([grid_of(m, half).orders[-1] for m in points])
    return HarmonicConvergence(np.asarray(speeds), highest, np.abs(n[:-1] / n[-1] - 1.0), estimate[:-1])


@cached
def _errors(scene: Scene, omega: Array, points: int) -> tuple[Array, Array]:
    model = jammed_bodies(jammed_model(scene))
    grid = grid_of(points, model.half_turn)

    def speed_and_error(w: Array) -> tuple[Array, Array]:
        motion = periodic_motion(model, grid, "omega", w, light_rotor_speed(model.linear, w))
        return motion.rotor_speed, branch_tangent(model, grid, motion).speed_error

    return jax.vmap(speed_and_error)(omega)
