"""Quantities of the response to unbalances: in the working regime, at a speed, or the largest value over a range of speeds.

The exciters have unbalances and no loads, see `jaxvib.response`. At a given speed all exciters have equal phases.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import is_whole
from jaxvib.display import speed_text
from jaxvib.equations.torque_balance import UnbalancedModel, unbalanced_model
from jaxvib.errors import InputError, quoted
from jaxvib.machine.carrier import Place, on_body
from jaxvib.steady.points import ellipse_at, rows_in_plane
from jaxvib.steady.response import motion_at, operation_of, require_unbalances
from jaxvib.units import Number, count
from optimize.quantities.evaluation import Evaluation, require_foundation
from optimize.quantities.quantity import BuiltinQuantity, Quantity, Tier, quantity_function
from optimize.quantities.user_inputs import number_in

__all__ = [
    "fold_distance",
    "response_amplitude",
    "response_force",
    "response_stroke",
    "response_torque",
    "response_transmissibility",
]

_POINTS_PER_SIDE = 24
"""Number of speeds on each side of a resonance at which the largest value is searched for."""

_REFINEMENTS = 40
"""Number of golden-section steps; the speed then has a relative error of 1e-8."""

_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)

Speeds = tuple[float, float] | None
"""Lowest and highest speed, rad/s; equal for a single speed; None for the working regime."""

Read = Callable[..., Array]
"""Function of an `UnbalancedModel`, a speed, rad/s, and settings, that returns a scalar."""


def _response_quantity(
    name: str, unit: str, read: Read, text: str, speed: Number | None, between: Sequence[Number] | None, *settings: object
) -> Quantity:
    if speed is not None and between is not None:
        raise InputError("between", "is given together with speed; give one of them")
    speeds: Speeds = None
    if speed is not None:
        at = number_in(speed, "rad/s", "speed")
        speeds, text = (at, at), f"{text} at {speed_text(at)}"
    elif between is not None:
        if not isinstance(between, (list, tuple)) or len(between) != 2:
            raise InputError("between", f"is {quoted(between)}; give the lowest and the highest speed, ['200 rpm', '900 rpm']")
        speeds = number_in(between[0], "rad/s", "between[0]"), number_in(between[1], "rad/s", "between[1]")
        text = f"largest {text} from {speed_text(list(speeds), between=' to ')}"
    if speeds is not None and not 0.0 < speeds[0] <= speeds[1]:
        if between is None:
            raise InputError("speed", f"is {quoted(speed)}; it must be positive")
        raise InputError("between", f"is {quoted(between)}; speeds must be positive and ascend")
    return BuiltinQuantity(
        name, unit, tiers=("leading",), text=text, settings=(read, speeds, *settings), pieces_function=_pieces
    )


def _pieces(evaluation: Evaluation, sign: float, tier: Tier, read: Read, speeds: Speeds, *settings: object) -> Array:
    """Return pieces whose maximum is `sign` times the largest value: for `sign` 1 the values of `_values`."""
    values = _values(evaluation, read, speeds, settings)
    return values if sign > 0.0 else -jnp.max(values)[None]


def _values(evaluation: Evaluation, read: Read, speeds: Speeds, settings: tuple[object, ...]) -> Array:
    """Return the value in the working regime or at one speed, (1,), or the largest value near each resonance, (nd,)."""
    scene = evaluation.scene
    require_unbalances(scene)
    if speeds is None:
        regime = evaluation.regime
        return read(unbalanced_model(scene, regime.phases), regime.speed, *settings)[None]
    model = unbalanced_model(scene, jnp.zeros(len(scene.exciters), scene.top_speed.dtype))
    low, high = (jnp.asarray(end, model.mass.dtype) for end in speeds)
    if speeds[0] == speeds[1]:
        return read(model, low, *settings)[None]
    frozen = jax.lax.stop_gradient(model)
    resonances = jnp.clip(frozen.modes()[0], low, high)
    middle = 0.5 * (resonances[1:] + resonances[:-1])
    begins, ends = jnp.concatenate([low[None], middle]), jnp.concatenate([middle, high[None]])
    # A value inside the range is stationary where it is largest; therefore the derivative of the speed is not needed.
    speeds_of_largest = jax.vmap(partial(_speed_of_largest, lambda w: read(frozen, w, *settings)))(begins, resonances, ends)
    return jax.vmap(lambda w: read(model, w, *settings))(jax.lax.stop_gradient(speeds_of_largest))


def _speed_of_largest(value: Callable[[Array], Array], begin: Array, resonance: Array, end: Array) -> Array:
    """Return the speed between `begin` and `end`, which enclose a `resonance`, at which a value is largest."""
    share = np.linspace(0.0, 1.0, _POINTS_PER_SIDE + 1) ** 3
    grid = jnp.concatenate([resonance + (begin - resonance) * share[:0:-1], resonance + (end - resonance) * share])
    best = jnp.argmax(jax.vmap(value)(grid))
    left, right = grid[jnp.maximum(best - 1, 0)], grid[jnp.minimum(best + 1, grid.size - 1)]

    def narrow(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        left_point, right_point = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        is_left = value(left_point) > value(right_point)
        return jnp.where(is_left, low, left_point), jnp.where(is_left, right_point, high)

    low, high = jax.lax.fori_loop(0, _REFINEMENTS, narrow, (left, right))
    inside = 0.5 * (low + high)
    return jnp.where(value(inside) > value(grid[best]), inside, grid[best])


def _point_settings(at: Any, body: int) -> tuple[object, int]:
    """Return a place and the number of a body as hashable values."""
    place: object = at
    if isinstance(at, (list, tuple)):
        if len(at) != 2:
            raise InputError("at", f"is {quoted(at)}; give a point (x, y) of a body, the number of a platform, or a distance")
        place = tuple(number_in(each, "m", f"at[{k}]") for k, each in enumerate(at))
    elif at is not None:
        place = int(at) if is_whole(at) else number_in(at, "m", "at")
    return place, count(body, "body", low=0)


def _words(name: str, at: int | Number | Sequence[Number] | None, body: int) -> str:
    """Return the words of a quantity at a point; tables may contain it for several points."""
    point = ", ".join(map(str, at)) if isinstance(at, Sequence) and not isinstance(at, str) else at
    parts = ([] if at is None else [f"at = {point}"]) + ([f"body = {body}"] if body else [])
    where = f" ({', '.join(parts)})" if parts else ""
    return f"{name}{where} under unbalances"


@quantity_function
def response_amplitude(
    *,
    at: int | Number | Sequence[Number] | None = None,
    body: int = 0,
    speed: Number | None = None,
    between: Sequence[Number] | None = None,
) -> Quantity:
    """Return the amplitude of a point under the unbalances of the exciters, m zero to peak: the long semi-axis of its path.

    **Arguments**

    - `at`: the number of a platform, a distance along a rotor's axis, m, or the point (x, y) of a body, m; default: platform 1,
      the common station of a rotor (with several stations its centre of mass), or the centre of mass of a body
    - `body`: number of the body from 0; typical: 0 (the default)
    - `speed`, rad/s or text, of all exciters; typical: 50 to 160 rad/s; default: the speed of `jaxvib.working_regime`
    - `between`: the lowest and the highest speed in place of `speed`, for the largest value in this range; typical:
      ["100 rpm", "900 rpm"], a range with the resonances that a slow run-up passes

    **Returns** `Quantity`; typical: 0.5 to 10 mm, 5 to 50 mm at a resonance. A scene whose exciters have loads raises
    `InputError` when the quantity is computed. **Raises** `InputError` for `speed` together with `between`.

    >>> from optimize import response_amplitude
    >>> (response_amplitude(between=("100 rpm", "900 rpm")) < "20 mm").words
    'largest amplitude under unbalances from 100 to 900 rpm at most 20 mm'
    """
    place = _point_settings(at, body)
    return _response_quantity("response_amplitude", "m", _amplitude, _words("amplitude", at, body), speed, between, *place)


def _amplitude(model: UnbalancedModel, w: Array, at: int | Array | None, body: int) -> Array:
    machine = model.scene.machine
    place: Place = on_body(at, machine.require_body(body))
    moved = rows_in_plane(machine, place) @ motion_at(model, w)[1]["displacement"]
    return ellipse_at(moved, w, jnp.zeros_like(w), jnp.zeros_like(w)).semi_major


@quantity_function
def response_stroke(
    *,
    at: int | Number | Sequence[Number] | None = None,
    body: int = 0,
    speed: Number | None = None,
    between: Sequence[Number] | None = None,
) -> Quantity:
    """Return the stroke of a point under the unbalances of the exciters, m peak to peak: twice `response_amplitude`.

    **Arguments**: `at`, `body`, `speed`, `between` as in `response_amplitude`; typical: at=2 for platform 2.

    **Returns** `Quantity`; typical: 2 to 20 mm. **Raises** `InputError` for `speed` together with `between`.

    >>> from optimize import response_stroke
    >>> response_stroke(at=1, speed="950 rpm").words
    'stroke (at = 1) under unbalances at 950 rpm'
    """
    place = _point_settings(at, body)
    return _response_quantity("response_stroke", "m", _stroke, _words("stroke", at, body), speed, between, *place)


def _stroke(model: UnbalancedModel, w: Array, at: int | Array | None, body: int) -> Array:
    return 2.0 * _amplitude(model, w, at, body)


@quantity_function
def response_force(*, speed: Number | None = None, between: Sequence[Number] | None = None) -> Quantity:
    """Return the force on the foundation under the unbalances of the exciters, N zero to peak, see `jaxvib.response`.

    **Arguments**: `speed` and `between` as in `response_amplitude`; typical: between=("100 rpm", "900 rpm").

    **Returns** `Quantity`; typical: 0.1 to 20 kN. **Raises** `InputError` for `speed` together with `between`.

    >>> from optimize import response_force
    >>> response_force(between=("100 rpm", "900 rpm")).unit
    'N'
    """
    return _response_quantity("response_force", "N", _field, "force under unbalances", speed, between, "foundation_force")


@quantity_function
def response_transmissibility(*, speed: Number | None = None, between: Sequence[Number] | None = None) -> Quantity:
    """Return the force on the foundation divided by the resultant of the centrifugal forces of the unbalances.

    **Arguments**: `speed` and `between` as in `response_amplitude`; typical: speed="950 rpm".

    **Returns** `Quantity`; typical: 0.02 to 0.2 above the resonances. **Raises** `InputError` for `speed` together with
    `between`.

    >>> from optimize import response_transmissibility
    >>> (response_transmissibility() < 0.1).words
    'transmissibility under unbalances at most 0.1'
    """
    text = "transmissibility under unbalances"
    return _response_quantity("response_transmissibility", "", _field, text, speed, between, "transmissibility")


@quantity_function
def response_torque(*, speed: Number | None = None, between: Sequence[Number] | None = None) -> Quantity:
    """Return the sum of the mean torques that the rotors need to sustain the vibration, N m, see `jaxvib.response`.

    **Arguments**: `speed` and `between` as in `response_amplitude`; typical: between=("100 rpm", "900 rpm").

    **Returns** `Quantity`; typical: 0.5 to 50 N m. **Raises** `InputError` for `speed` together with `between`.

    >>> from optimize import response_torque
    >>> (response_torque(between=("100 rpm", "900 rpm")) < "12 N m").words
    'largest shaft torque under unbalances from 100 to 900 rpm at most 12 N m'
    """
    return _response_quantity("response_torque", "N m", _field, "shaft torque under unbalances", speed, between, "torque")


def _field(model: UnbalancedModel, w: Array, name: str) -> Array:
    """Return a field of a response; the torques of several exciters are added."""
    if name in ("foundation_force", "transmissibility"):
        require_foundation(model.scene)
    return jnp.sum(motion_at(model, w)[1][name])


@quantity_function
def fold_distance() -> Quantity:
    """Return the distance of the speed of a motor from the nearest fold of the response, relative to this speed.

        min_f |w_f / w - 1|

    w is the highest speed at which the motor can run, w_f the speed of a fold, see `TorqueFolds`. If the motor becomes weaker,
    or the damping larger, the operating point at the speed w disappears at a fold.

    **Returns** `Quantity`; typical: 0.2 to 0.9; 1 without a fold. A scene with several exciters or with an ideal drive raises
    `InputError` when the quantity is computed.

    >>> from optimize import fold_distance
    >>> (fold_distance() > 0.2).words
    'distance from the nearest fold of the response at least 0.2'
    """
    text = "distance from the nearest fold of the response"
    return BuiltinQuantity("fold_distance", "", tiers=("leading",), text=text, pieces_function=_fold_distances)


def _fold_distances(evaluation: Evaluation, sign: float, tier: Tier) -> Array:
    scene = evaluation.scene
    require_unbalances(scene)
    if len(scene.exciters) > 1 or scene.exciter.drive.ideal:
        problem = f"has {len(scene.exciters)} exciters" if len(scene.exciters) > 1 else "has an ideal drive"
        raise InputError("scene", f"{problem}; folds of the response exist for one exciter with a motor")
    operating, folds = operation_of(unbalanced_model(scene, jnp.zeros(1, scene.top_speed.dtype)))
    working = jnp.max(jnp.where(operating.exists, operating.speed, -jnp.inf))
    speeds = jnp.where(folds.exists, folds.speed, 0.0)
    distances = jnp.where(jnp.isfinite(working), -jnp.abs(speeds / working - 1.0), jnp.nan)
    return distances if sign < 0.0 else -jnp.max(distances)[None]
