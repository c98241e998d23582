"""Quantities of machines whose exciters synchronize: motion of a deck, force, power, margins.

The quantities are those of the working regime, see `jaxvib.working_regime`. For a scene without a stable synchronous regime a
quantity raises `ComputationError` with the status "none_stable" when it is computed; in a search its value is NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.equations.linear import natural_frequencies
from jaxvib.equations.torque_balance import TorqueBalance, assemble_torque_balance, influence_of
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.motion.run import Run
from jaxvib.numerics.linalg import magnitude
from jaxvib.steady.measures import conveying_speed_at
from jaxvib.steady.points import Ellipse, at_positive_speed, read_slope
from jaxvib.units import Number, count
from optimize.quantities.evaluation import Evaluation, require_foundation
from optimize.quantities.quantity import BuiltinQuantity, Quantity, Tier, quantity_function, walk
from optimize.quantities.user_inputs import Point, number_in, read_point

__all__ = [
    "amplitude_spread",
    "conveying_speed",
    "force_per_throw",
    "least_torque",
    "motion_spread",
    "resonance_distance",
    "roundness",
    "synchronization_margin",
    "throw_angle",
    "throw_number",
    "throw_stroke",
]

_LARGEST_MARGIN = 1e3
"""Largest value of a margin. That of equal motors is infinite, but a search needs a finite number."""

_PEAK_STEPS, _PEAK_REACH = 8, 0.1
"""Number of steps of the search for the speed of the largest torque at a resonance, and largest relative distance of this speed
from the resonance."""

_MAX_PASSED_RESONANCE = 0.95
"""Largest natural frequency, relative to the least no-load speed of the motors, that counts as a resonance that a run-up
passes."""


class RegimeQuantity(BuiltinQuantity):
    """Quantity of the working regime of a machine with several exciters."""


def _point_quantity(
    name: str,
    unit: str,
    function: Callable[..., Array],
    text: str,
    at: Sequence[Number],
    body: int,
    tier: Tier,
    *settings: object,
) -> Quantity:
    point = read_point(at, "at")
    text = f"{text} at ({point[0]:g}, {point[1]:g}) m"
    return RegimeQuantity(name, unit, function, tier=tier, text=text, settings=(point, count(body, "body", low=0), *settings))


def _ellipse(evaluation: Evaluation, tier: Tier, at: Point, body: int, slope: float = 0.0) -> Ellipse:
    return evaluation.working(tier).ellipse(at, body, slope=slope)


def _field_of_ellipse(evaluation: Evaluation, tier: Tier, at: Point, body: int, name: str, slope: float = 0.0) -> Array:
    return getattr(_ellipse(evaluation, tier, at, body, slope), name)


@quantity_function
def throw_stroke(*, at: Sequence[Number] = (0.0, 0.0), body: int = 0, tier: Tier = "leading") -> Quantity:
    """Return the stroke of a point, m peak to peak: the largest extent of its path, "double amplitude" in data sheets.

    **Arguments**

    - `at`: the point (x, y) of the body, m or text, from its centre of mass; default: the centre of mass
    - `body`: number of the body from 0; typical: 0 (the default)
    - `tier`: "leading" (averaged theory, the default), "exact" (the exact periodic motion), or "time" (the full equations,
      integrated from the exact motion)

    **Returns** `Quantity`; typical: 4 to 16 mm. **Raises** `InputError` for `at` that is not a point.

    >>> from optimize import throw_stroke
    >>> (throw_stroke(at=(0.5, 0.1)) > "6 mm").words
    'stroke at (0.5, 0.1) m at least 6 mm'
    """
    return _point_quantity("throw_stroke", "m", _throw_stroke, "stroke", at, body, tier)


def _throw_stroke(evaluation: Evaluation, tier: Tier, at: Point, body: int) -> Array:
    return _ellipse(evaluation, tier, at, body).stroke


@quantity_function
def throw_angle(*, at: Sequence[Number] = (0.0, 0.0), body: int = 0, tier: Tier = "leading") -> Quantity:
    """Return the throw angle: direction of the largest extent of a point's path, rad from x anticlockwise, -pi/2 to pi/2.

    **Arguments**: `at`, `body`, `tier` as in `throw_stroke`; typical: the middle of the deck.

    **Returns** `Quantity`; typical: 30 to 60 degrees. **Raises** `InputError` for `at` that is not a point.

    >>> from optimize import throw_angle
    >>> (throw_angle() > "40 deg").words
    'throw angle at (0, 0) m at least 40 deg'
    """
    return _point_quantity("throw_angle", "rad", _field_of_ellipse, "throw angle", at, body, tier, "direction")


@quantity_function
def throw_number(*, at: Sequence[Number] = (0.0, 0.0), slope: Number = 0.0, body: int = 0, tier: Tier = "leading") -> Quantity:
    """Return the throw number of a point of a deck, see `jaxvib.Ellipse`.

    **Arguments**: `at`, `body`, `tier` as in `throw_stroke`; `slope` of the deck, rad or text; typical: "-15 deg" to 0 (the
    default).

    **Returns** `Quantity`; typical: 2 to 5. **Raises** `InputError` for `at` that is not a point.

    >>> from optimize import throw_number
    >>> throw_number(at=(1.5, 0.1), slope="-5 deg").unit
    ''
    """
    along = number_in(read_slope(slope), "rad", "slope")
    return _point_quantity("throw_number", "", _field_of_ellipse, "throw number", at, body, tier, "throw_number", along)


@quantity_function
def conveying_speed(
    *, at: Sequence[Number] = (0.0, 0.0), slope: Number = 0.0, body: int = 0, tier: Tier = "leading"
) -> Quantity:
    """Return the estimated mean speed of material at a point of a deck, m/s, positive in the direction of x (down a deck with a
    negative slope), see `jaxvib.conveying_speed`.

    Its value is 0 for throw numbers of at most 1, and NaN above 3.297.

    **Arguments**: `at`, `body`, `tier` as in `throw_stroke`; `slope` of the deck, rad or text; typical: "-15 deg" to 0 (the
    default).

    **Returns** `Quantity`; typical: 0.1 to 0.5 m/s. **Raises** `InputError` for `at` that is not a point.

    >>> from optimize import conveying_speed
    >>> (conveying_speed(at=(0.0, 0.1)) > "0.25 m/s").words
    'conveying speed at (0, 0.1) m at least 0.25 m/s'
    """
    along = number_in(read_slope(slope), "rad", "slope")
    return _point_quantity("conveying_speed", "m/s", _conveying_speed, "conveying speed", at, body, tier, along)


def _conveying_speed(evaluation: Evaluation, tier: Tier, at: Point, body: int, slope: float) -> Array:
    motion = evaluation.working(tier)
    moved, speed = at_positive_speed(motion.deck([at], body).amplitude[0], motion.harmonic().speed)
    return conveying_speed_at(moved, speed, jnp.asarray(slope))


@quantity_function
def roundness(*, at: Sequence[Number] = (0.0, 0.0), body: int = 0, tier: Tier = "leading") -> Quantity:
    """Return the ratio of the semi-axes of the path of a point: 0 for a straight line, 1 for a circle.

    **Arguments**: `at`, `body`, `tier` as in `throw_stroke`; typical: the middle of the deck.

    **Returns** `Quantity`; typical: below 0.05 for a linear screen, above 0.9 for a circular one. **Raises** `InputError` for
    `at` that is not a point.

    >>> from optimize import roundness
    >>> (roundness() > 0.9).words
    'roundness at (0, 0) m at least 0.9'
    """
    return _point_quantity("roundness", "", _roundness, "roundness", at, body, tier)


def _roundness(evaluation: Evaluation, tier: Tier, at: Point, body: int) -> Array:
    path = _ellipse(evaluation, tier, at, body)
    return jnp.abs(path.semi_minor) / path.semi_major


@quantity_function
def force_per_throw(*, at: Sequence[Number] = (0.0, 0.0), body: int = 0, tier: Tier = "leading") -> Quantity:
    """Return the foundation force, N zero to peak, divided by half of the stroke of a point, N/m.

    **Arguments**: `at`, `body`, `tier` as in `throw_stroke`; typical: the middle of the deck.

    **Returns** `Quantity`; typical: the stiffness of all supports, 1e5 to 2e6 N/m. **Raises** `InputError` for `at` that is not
    a point.

    >>> from optimize import force_per_throw
    >>> force_per_throw().unit
    'N/m'
    """
    return _point_quantity(
        "force_per_throw", "N/m", _force_per_throw, "foundation force divided by the amplitude of a point", at, body, tier
    )


def _force_per_throw(evaluation: Evaluation, tier: Tier, at: Point, body: int) -> Array:
    return working_force(evaluation, tier) / (0.5 * _ellipse(evaluation, tier, at, body).stroke)


@quantity_function
def motion_spread(points: Sequence[Sequence[Number]], *, body: int = 0, tier: Tier = "leading") -> Quantity:
    """Return the spread of the motions over a deck: root mean square over its points of |U_p - mean| / |mean|.

    U_p is the complex amplitude (x, y) of point p. The spread is 0 if all points have the same motion; the deck then throws in
    the same way at all points.

    **Arguments**: `points`: a list of (x, y), m or text; `body`, `tier` as in `throw_stroke`; typical: 2 to 10 points.

    **Returns** `Quantity`; typical: 0.01 to 0.3. **Raises** `InputError` for `points` that are not a list of points.

    >>> from optimize import motion_spread
    >>> (motion_spread([(-1.0, 0.1), (1.0, 0.1)]) < 0.05).words
    'spread of the motions over the deck at most 0.05'
    """
    return _deck_quantity("motion_spread", "spread of the motions over the deck", points, body, tier)


@quantity_function
def amplitude_spread(points: Sequence[Sequence[Number]], *, body: int = 0, tier: Tier = "leading") -> Quantity:
    """Return the range of the amplitudes of points of a deck divided by their mean; 0 if all are equal.

    **Arguments**: `points`: a list of (x, y), m or text; `body`, `tier` as in `throw_stroke`; typical: 2 to 10 points.

    **Returns** `Quantity`; typical: 0.01 to 0.5. **Raises** `InputError` for `points` that are not a list of points.

    >>> from optimize import amplitude_spread
    >>> amplitude_spread([(-1.0, 0.1), (1.0, 0.1)]).unit
    ''
    """
    return _deck_quantity("amplitude_spread", "spread of amplitudes over the deck", points, body, tier)


def _deck_quantity(name: str, text: str, points: Sequence[Sequence[Number]], body: int, tier: Tier) -> Quantity:
    """Return the quantity that is a property of the `Deck`."""
    if not isinstance(points, (list, tuple)) or len(points) < 2:
        raise InputError("points", f"is {quoted(points)}; it must be a list of at least two points (x, y)")
    places = tuple(read_point(point, f"points[{k}]") for k, point in enumerate(points))
    return RegimeQuantity(name, "", _field_of_deck, tier=tier, text=text, settings=(places, count(body, "body", low=0), name))


def _field_of_deck(evaluation: Evaluation, tier: Tier, points: tuple[Point, ...], body: int, name: str) -> Array:
    return getattr(evaluation.working(tier).deck(points, body), name)


@quantity_function
def synchronization_margin() -> Quantity:
    """Return the factor by which all differences of the motors' torques can grow until the synchronous regime ends.

    See `margin` of `jaxvib.SynchronousRegime`. Values above 1000 are replaced by 1000.

    **Returns** `Quantity`; typical: 2 to 50; 1000 for equal motors. A scene without a stable regime raises `ComputationError`
    when the quantity is computed.

    >>> from optimize import synchronization_margin
    >>> (synchronization_margin() > 3.0).words
    'margin of synchronization at least 3'
    """
    return RegimeQuantity("synchronization_margin", "", _margin, text="margin of synchronization", tiers=("leading",))


def _margin(evaluation: Evaluation, tier: Tier) -> Array:
    margin = evaluation.regime.margin
    is_large = margin > _LARGEST_MARGIN
    # NaN (no regime) stays NaN, and an infinite margin leaves no NaN in derivatives.
    return jnp.where(is_large, _LARGEST_MARGIN, jnp.where(is_large, 1.0, margin))


@quantity_function
def resonance_distance() -> Quantity:
    """Return the distance of the speed of the working regime from the nearest natural frequency, relative to this speed.

        min_r |w_r / Omega - 1|,    w_r natural frequencies, Omega speed of the working regime

    **Returns** `Quantity`; typical: 0.3 to 0.9. A scene without a stable regime raises `ComputationError` when the quantity is
    computed.

    >>> from optimize import resonance_distance
    >>> (resonance_distance() > 0.5).words
    'distance from the nearest resonance at least 0.5'
    """
    text = "distance from the nearest resonance"
    return RegimeQuantity("resonance_distance", "", text=text, tiers=("leading",), pieces_function=_distances)


def _distances(evaluation: Evaluation, sign: float, tier: Tier) -> Array:
    distances = -jnp.abs(natural_frequencies(evaluation.scene) / evaluation.regime.speed - 1.0)
    return distances if sign < 0.0 else -jnp.max(distances)[None]


@quantity_function
def least_torque() -> Quantity:
    """Return the smallest factor of the torques of all motors with which the motors still pass the resonances of a run-up.

        max_r max_w (w^4/2) sum_ik S_i S_k |A_ik(w)| / sum_i L_i(w),      A = (H^H - H)/(2 i),    w within 10 % of w_r

    S_i is the unbalance of exciter i, kg m, L_i(w) the torque of its motor, N m, and H(w) the matrix of displacements per
    centrifugal force of the exciters. For any phases of the exciters, the numerator is an upper bound of the mean torque of a
    steady vibration at the speed w. The maximum over w is a local maximum below the no-load speed; without such a maximum, the
    ratio at the natural frequency w_r is used. Only natural frequencies up to 95 % of the lowest no-load speed of the motors
    count. Rotors of large inertia need this torque in a slow run-up. A fast passage needs less; `jaxvib.run_up` integrates the
    run-up.

    **Returns** `Quantity`; typical: 0.1 to 0.8; above 1 the motors are caught by a resonance. A scene with an ideal drive
    raises `InputError` when the quantity is computed.

    >>> from optimize import least_torque
    >>> (least_torque() < 0.7).words
    'least torque needed to pass the resonances at most 0.7'
    """
    text = "least torque needed to pass the resonances"
    return RegimeQuantity("least_torque", "", text=text, tiers=("leading",), pieces_function=_least_torques)


def _least_torques(evaluation: Evaluation, sign: float, tier: Tier) -> Array:
    """Return pieces whose maximum is `sign` times the largest ratio of the torques: for `sign` 1 the ratio near each resonance,
    0 for resonances that a run-up does not pass."""
    scene = evaluation.scene
    balance = assemble_torque_balance(scene)
    if any(balance.is_prescribed):
        raise InputError("scene", "has an ideal drive, which passes every resonance; this quantity needs motors")

    def ratio(speed: Array, ratio_balance: TorqueBalance = balance) -> Array:
        influence = influence_of(ratio_balance, speed)
        resisting = magnitude((influence.conj().T - influence) / 2j)
        needed = speed**4 / 2.0 * (ratio_balance.unbalance @ resisting @ ratio_balance.unbalance)
        return needed / jnp.sum(ratio_balance.driving_torque(speed))

    frozen = jax.lax.stop_gradient(balance)

    resonances = natural_frequencies(scene)
    slowest = jax.lax.stop_gradient(jnp.min(jnp.stack([exciter.drive.speed for exciter in scene.exciters])))
    is_passed = (resonances > 0.0) & (resonances < _MAX_PASSED_RESONANCE * slowest)

    def peak(resonance: Array) -> Array:
        begin = jax.lax.stop_gradient(resonance)
        low, high = (1.0 - _PEAK_REACH) * begin, jnp.minimum((1.0 + _PEAK_REACH) * begin, 0.5 * (begin + slowest))

        def slope(w: Array) -> Array:
            return jax.grad(lambda w: 1.0 / ratio(w, frozen))(w)

        def step(_: int, w: Array) -> Array:
            value, curvature = jax.jvp(slope, (w,), (jnp.ones_like(w),))
            move = jnp.nan_to_num(value / jnp.abs(curvature))
            return jnp.clip(w - jnp.clip(move, -0.02 * begin, 0.02 * begin), low, high)

        # The ratio is stationary at its peak; therefore the derivative of that speed is not needed. Close to the no-load speed
        # a broad resonance has no peak, because the torques of the motors decrease to 0.
        found = jax.lax.fori_loop(0, _PEAK_STEPS, step, begin)
        return ratio(jnp.where((found > low) & (found < high), found, resonance))

    ratios = jax.vmap(peak)(jnp.where(is_passed, resonances, 0.5 * slowest))
    ratios = jnp.where(is_passed, ratios, 0.0)
    return ratios if sign > 0.0 else -jnp.max(ratios)[None]


def deck_points(quantities: Iterable[Quantity]) -> list[Point] | None:
    """Return the points of body 0 to which quantities of the working regime refer; None if there are no such quantities."""
    points_of_deck: dict[Point, None] = {}
    regime_quantities = [part for quantity in quantities for part in walk(quantity) if isinstance(part, RegimeQuantity)]
    for part in regime_quantities:
        match part.settings:
            case ((float(x), float(y)), 0, *_):
                points_of_deck[x, y] = None
            case (tuple() as points, 0, *_):
                points_of_deck |= dict.fromkeys(points)
    return list(points_of_deck) if regime_quantities else None


def working_speed() -> Quantity:
    """Return the mean speed of the exciters in the working regime."""
    return RegimeQuantity("speed", "rad/s", _working_speed, text="speed")


def _working_speed(evaluation: Evaluation, tier: Tier) -> Array:
    motion = evaluation.working(tier)
    return jnp.mean(jnp.abs(motion.load_speed)) if isinstance(motion, Run) else motion.speed


def working_amplitude(scene: Scene, k: int) -> Quantity:
    """Return the amplitude of coordinate `k`, counted from 0, in the working regime."""
    structure = scene.machine.structure()
    name = f"amplitude of {structure.coordinates[k]}"
    return RegimeQuantity("amplitude", structure.units[k], _working_amplitude, text=name, settings=(k,))


def _working_amplitude(evaluation: Evaluation, tier: Tier, k: int) -> Array:
    return evaluation.working(tier).amplitude[k]


def working_force(evaluation: Evaluation, tier: Tier) -> Array:
    """Return the foundation force of the working regime, N."""
    require_foundation(evaluation.scene)
    return evaluation.working(tier).foundation_force


def working_power(evaluation: Evaluation, tier: Tier) -> Array:
    """Return the power of all drives in the working regime, W."""
    motion = evaluation.working(tier)
    assert not isinstance(motion, Run)  # runs do not contain the torques of the drives
    return jnp.sum(motion.power)
