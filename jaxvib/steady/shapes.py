"""Mode shapes: free vibrations of the machine at its natural frequencies."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, SpeedUnit, speed_text
from jaxvib.equations.linear import LOST_FREQUENCY, linear_model, lost_frequencies
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.results.fields import in_unit, names_along
from jaxvib.results.result import Result
from jaxvib.runtime.programs import cached
from jaxvib.steady.outcome import REFUSED, outcome


class ShapesStatus(eqx.Enumeration):
    """Outcomes of a computation of mode shapes. The value of each member is the message shown to the user."""

    done = "the shapes were computed"
    lost_digits = LOST_FREQUENCY
    refused = REFUSED


class ModeShapes(Result):
    """Undamped free vibrations, in the order of their frequencies.

    Returned by `mode_shapes`.

    **Attributes**

    - `status`: a `ShapesStatus`
    - `frequency` (nd,), rad/s
    - `shape` (nd, nd), a row for each mode: the amplitude of each coordinate, divided by the largest one; a tilt (rad) is
      multiplied by its `lever`
    - `lever` (nd,): for a tilt its radius of gyration, m, for a displacement 1
    - `coordinates` (nd,): their names
    """

    status: ShapesStatus
    frequency: Array = eqx.field(metadata=in_unit("rad/s", "shape_mode"))
    shape: Array = eqx.field(metadata=in_unit("", "shape_mode", "coordinate"))
    lever: Array = eqx.field(metadata=in_unit("m", "coordinate"))
    coordinates: tuple[str, ...] = eqx.field(static=True, metadata=names_along("coordinate"))

    def summary(self) -> str:
        """Return a line of text for each mode."""
        rows = zip(np.asarray(self.frequency), np.asarray(self.shape), strict=True)
        parts = [
            f"{speed_text(w, 6)}: " + ", ".join(f"{name} {x:+.3f}" for name, x in zip(self.coordinates, row, strict=True))
            for w, row in rows
        ]
        return "\n".join(parts)

    @validated
    def plot(self, *, unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot the shapes as bars, a group for each mode with its frequency in `unit`."""
        from jaxvib.draw.results import shapes_chart  # slow import

        return shapes_chart(np.asarray(self.frequency), np.asarray(self.shape), names=self.coordinates, unit=unit, ax=ax)


@validated
def mode_shapes(scene: Scene) -> ModeShapes:
    """Return the natural frequencies and mode shapes of the machine with its loads, without damping and with the rotor at rest.

        K X = w^2 (M + sum_j m_j B_j^T B_j) X

    m_j are the masses of the loads and of the unbalances that have an `unbalance_mass`; B_j maps the coordinates to the
    displacement of the point that carries the mass.

    **Arguments**: `scene`; only its machine and these masses are used.

    **Returns** `ModeShapes`; typical: frequencies of 10 to 100 rad/s for platforms, 100 to 500 rad/s for rotors.

    **Raises** `InputError` for an argument that is not a scene, and `ComputationError` (status "lost_digits") if a natural
    frequency is lost in rounding errors. Under a JAX transformation such a frequency and its shape are NaN.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> print(jv.mode_shapes(form.scene()).summary())
    3.1831 rpm: y1 +1.000, y2 +1.000
    9.5493 rpm: y1 +1.000, y2 -1.000

    Source: the antiphase paper, equations (19), (23).
    """
    scene = validate_scene(scene)
    return outcome(_mode_shapes(scene), scene, throw=True, failures=("lost_digits",))


@cached
def _mode_shapes(scene: Scene) -> ModeShapes:
    model = linear_model(scene)
    frequency, vectors = model.modes()
    inertia = jnp.diagonal(model.mass)
    tilts = np.array([unit == "rad" for unit in model.carrier.units])
    # The displacements of a body precede its tilts.
    of_displacement = np.maximum.accumulate(np.where(tilts, 0, np.arange(tilts.size)))
    lever = jnp.where(tilts, jnp.sqrt(inertia / inertia[of_displacement]), 1.0)
    rows = vectors.T * lever[None, :]
    # The largest amplitude is 1; if several are equal, the first one counts.
    size = jnp.abs(rows)
    largest = jnp.argmax(size > (1.0 - 1e-6) * jnp.max(size, axis=1, keepdims=True), axis=1)
    rows = rows / jnp.take_along_axis(rows, largest[:, None], axis=1)
    lost = lost_frequencies(model, frequency, vectors)
    return ModeShapes(
        status=ShapesStatus.where(jnp.any(lost), ShapesStatus.lost_digits, ShapesStatus.done),
        frequency=jnp.where(lost, jnp.nan, frequency),
        shape=jnp.where(lost[:, None], jnp.nan, rows),
        lever=lever,
        coordinates=model.carrier.coordinates,
    )
