"""Greatest drag of the loads at which a jam exists, for each resonance."""

from __future__ import annotations

from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, SpeedUnit, quantity_text, speed_text
from jaxvib.equations.linear import estimated_frequencies, jammed_model, require_drag, turning_loads
from jaxvib.equations.torque_balance import TorqueBalance, assemble_for_search
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.runtime.devices import on_device
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.folds import DragFactorModel, branch_pieces
from jaxvib.steady.jams.phase_starts import phases_near, search_data, search_phases
from jaxvib.steady.jams.phases import loads_with_drag
from jaxvib.steady.outcome import REFUSED, outcome

_SETS_OF_PHASES = 64
"""Number of random sets of phases at each load speed."""

_GOLDEN_STEPS = 60
"""Number of golden-section steps; the relative error is then 1e-8 for the speed of a maximum, and 1e-15 for its value."""


class DragStatus(eqx.Enumeration):
    """Outcomes of the search for the greatest drag. The value of each member is the message shown to the user."""

    done = "the greatest drag was searched for at every resonance below the rotor speed"
    refused = REFUSED


class DragLimits(Result):
    """Greatest drag at which the loads can jam at each resonance. Returned by `drag_limits`.

    **Attributes** (nd,), in the order of the resonances; NaN for a resonance above the rotor speed or without a separate jam

    - `status`: a `DragStatus`
    - `factor`: greatest factor by which the drag of the scene can be multiplied; with a larger one this resonance has no jam
    - `drag`, N s/m: the drag of the first load times `factor`
    - `omega`, rad/s: load speed of the jam at the greatest drag
    - `resonances`, rad/s
    """

    status: DragStatus
    factor: Array = eqx.field(metadata=in_unit("", "resonance"))
    drag: Array = eqx.field(metadata=in_unit("N s/m", "resonance"))
    omega: Array = eqx.field(metadata=in_unit("rad/s", "resonance"))
    resonances: Array = eqx.field(metadata=in_unit("rad/s", "resonance"))

    def summary(self) -> str:
        """Return a line of text for each resonance with a limit."""
        there = np.flatnonzero(np.isfinite(self.factor))
        lines = [
            f"resonance {speed_text(self.resonances[k])}: jams up to a drag of {quantity_text(self.drag[k], 'N s/m', 4)}, "
            f"{float(self.factor[k]):.4g} times that of the scene"
            for k in there
        ]
        return "\n".join(lines) or "no jam at any resonance below the rotor speed, at any drag"

    @validated
    def plot(self, *, unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot the greatest drag over the load speed of its jam, in `unit`, with the resonances as lines."""
        from jaxvib.draw.results import drag_limits_chart  # slow import

        omega, drag, resonances = map(np.asarray, (self.omega, self.drag, self.resonances))
        return drag_limits_chart(omega, drag, resonances, unit=unit, ax=ax)


@validated
def drag_limits(scene: Scene, *, phases: bool = False) -> DragLimits:
    """Return the greatest drag at which light loads can jam, for each resonance below the rotor speed.

        factor(w) sum b_W R^2 (n - w) = braking torque of the vibration at w

    n is the rotor speed, w the load speed, and b_W and R are the drag and the radius of a load. The greatest drag of a
    resonance is the maximum of `factor` over the load speeds w near it. At this maximum two jams merge in a fold; with a larger
    drag the loads pass this resonance. In the limit of light loads an imbalance of the rotor does not change the limits, see
    `jam_modes`.

    - For equal loads at one point of the machine no other arrangement can jam at a larger drag: the torques of all loads have
      the sum (w^4/2) |sum_j S_j exp(i a_j)|^2 Im h, whose modulus is largest for equal angles a_j. S_j = m_j R_j is the
      unbalance of a load, and h is the receptance of the point that carries the loads, for a rotating force
    - Loads at several points of a rotor, or unequal loads, jam at unequal phases. With `phases`, `factor` is the largest
      factor of all phases that a search finds. Loads then count as points, see `phase_jams`. Balls with a `ball_radius` that
      touch each other have a smaller common unbalance, and jam only up to a smaller drag. For equal loads at one point, the
      limit without `phases` includes this

    **Arguments**

    - `scene` as for `jam_modes`; with `phases` as for `phase_jams`
    - `phases`: True for jams with any phases; typical: True for rotors

    **Returns** `DragLimits`. Its derivatives are exact without `phases`; with `phases` there are none.

    **Raises** `InputError` for the reasons of `jam_modes` or `phase_jams`, and for dry friction, which the factor
    would not multiply.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> [round(float(factor), 3) for factor in jv.drag_limits(form.scene()).factor]
    [0.174, 2.092]

    Source: the branch of the antiphase paper, equations (31), (35), solved for the drag.
    """
    scene = validate_scene(scene)
    if phases:
        loads_with_drag(scene)
        return outcome(_limits_of_phases(scene), scene)
    require_drag(turning_loads(scene, at_one_point=True))
    return outcome(_limits_of_coincident_loads(scene), scene)


@cached
def _limits_of_coincident_loads(scene: Scene) -> DragLimits:
    model = jammed_model(scene)
    parts = {name: getattr(model, name) for name in DragFactorModel.__dataclass_fields__}
    pieces = branch_pieces(DragFactorModel(**parts).decomposed())
    # The folds 0, 2, 4, ... are maxima. The piece before a maximum has the mode number 2 r - 1 of its resonance r = 1, 2, ...
    peaks, owner = pieces.folds.exists[0::2], (pieces.mode[0:-1:2] - 1) // 2
    is_own = peaks[None, :] & (owner[None, :] == np.arange(owner.size)[:, None])
    exists, peak = jnp.any(is_own, axis=1), jnp.argmax(is_own, axis=1)
    factor, omega = (jnp.where(exists, each[0::2][peak], jnp.nan) for each in (pieces.folds.rotor_speed, pieces.folds.omega))
    return _limits(scene, factor, omega, pieces.resonances)


def _limits(scene: Scene, factor: Array, omega: Array, resonances: Array) -> DragLimits:
    drag = factor * jnp.ravel(cast(CircularLoads, scene.loads).drag)[0]
    return DragLimits(status=DragStatus.done, factor=factor, drag=drag, omega=omega, resonances=resonances)


def _limits_of_phases(scene: Scene) -> DragLimits:
    """Return the limits for any phases: maxima over the load speed of the largest factor of all phases."""
    balance, resonances = assemble_for_search(scene), np.asarray(estimated_frequencies(scene))
    random = np.random.default_rng(0).uniform(-np.pi, np.pi, (_SETS_OF_PHASES, balance.unbalance.size))
    speeds, _, row, factor, angles = search_phases(balance, random)
    largest, best = np.zeros(speeds.size), np.full(speeds.size, -1)
    for k in np.argsort(factor):
        largest[row[k]], best[row[k]] = factor[k], k
    maxima = np.flatnonzero((largest[1:-1] > largest[:-2]) & (largest[1:-1] >= largest[2:])) + 1
    owner = np.argmin(np.abs(resonances[None, :] - speeds[maxima, None]), axis=1)
    factors, omegas = np.full(resonances.size, np.nan), np.full(resonances.size, np.nan)
    for r in range(resonances.size):
        if not (own := maxima[owner == r]).size:
            continue
        k = own[np.argmax(largest[own])]
        around = on_device(speeds[k - 1 : k + 2])
        omegas[r], factors[r] = (float(each) for each in _largest_factor(balance, around, on_device(angles[best[k]])))
    return _limits(scene, *(on_device(each) for each in (factors, omegas, resonances)))


@cached
def _largest_factor(balance: TorqueBalance, around: Array, phase: Array) -> tuple[Array, Array]:
    """Return the load speed in the interval `around` (low, start, high) at which the factor of a pattern of phases is largest,
    and the factor. A speed at which the pattern does not exist has the factor 0."""

    def factor(w: Array) -> Array:
        value, _, residual = phases_near(balance, search_data(balance, w), phase)
        good = (residual < jnp.sqrt(jnp.finfo(residual.dtype).eps)) & (value > 0.0)
        return jnp.where(good, value, 0.0)

    golden = 0.5 * (np.sqrt(5.0) - 1.0)

    def narrowed(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        left, right = high - golden * (high - low), low + golden * (high - low)
        values = jax.vmap(factor)(jnp.stack([left, right]))
        is_left = values[0] > values[1]
        return jnp.where(is_left, low, left), jnp.where(is_left, right, high)

    low, high = jax.lax.fori_loop(0, _GOLDEN_STEPS, narrowed, (around[0], around[2]))
    candidates = jnp.stack([0.5 * (low + high), around[1]])
    values = jax.vmap(factor)(candidates)
    return candidates[jnp.argmax(values)], jnp.max(values)
