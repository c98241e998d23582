"""Quantities of a jam: amplitude, phase, force on the foundation, speeds, power, stability."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import peak_force
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import Platforms
from jaxvib.motion.analysis.measure import relative_amplitude
from jaxvib.numerics.linalg import magnitude
from jaxvib.steady.measures import shaft_torque
from jaxvib.units import count
from optimize.quantities.evaluation import Evaluation, require_foundation
from optimize.quantities.exciters import RegimeQuantity, working_force, working_power
from optimize.quantities.quantity import TIERS, BuiltinQuantity, Pair, Quantity, Tier, quantity_function

__all__ = [
    "amplitude",
    "fold_margin",
    "force_per_amplitude",
    "foundation_force",
    "jam_frequency",
    "largest_multiplier",
    "phase",
    "power",
]


def resolve_pair(scene: Scene, of: Pair = None) -> int | tuple[int, int]:
    """Return the platform or the pair of platforms `of`, with its default in place of None.

    The default is platform 1 relative to platform 2, or the only platform. For a machine without platforms, the numbers are
    those of coordinates, and the default is the first one.

    **Raises** `InputError` for a platform that the machine does not have.
    """
    n = scene.machine.structure().mass.shape[0]
    if of is None:
        return (1, 2) if n > 1 and isinstance(scene.machine, Platforms) else 1
    platforms = tuple(of) if isinstance(of, (tuple, list)) else (of,)
    whole = all(isinstance(p, (int, np.integer)) and not isinstance(p, bool) and 1 <= p <= n for p in platforms)
    if whole and len(platforms) == 1:
        return platforms[0]
    if whole and len(platforms) == 2 and platforms[0] != platforms[1]:
        return platforms[0], platforms[1]
    raise InputError("of", f"is {quoted(of)}; give a platform from 1 to {n}, or a pair of different platforms")


def jam_quantity(
    name: str,
    unit: str,
    function: Callable[..., Array] | None,
    mode: int,
    tier: Tier,
    text: str,
    *,
    of: Pair = None,
    settings: tuple[Pair, ...] = (),
    tiers: tuple[Tier, ...] = TIERS,
    pieces_function: Callable[..., Array] | None = None,
) -> Quantity:
    """Return a quantity of the jam with the number `mode`."""
    text = f"{text}, mode {mode}"
    return BuiltinQuantity(name, unit, function, mode, of, tier, (mode, *settings), tiers, text, pieces_function)


def pair_text(of: Pair) -> str:
    """Return the platform or the pair of platforms of a quantity as text."""
    if of is None:
        return ""
    return f" of platform {of}" if isinstance(of, int) else f" of platform {of[0]} against {of[1]}"


def pair_of(of: Pair | list[int]) -> Pair:
    """Return a platform or a pair of platforms; a list from a design file becomes a pair.

    **Raises** `InputError` for other values.
    """
    parts = of if isinstance(of, (list, tuple)) else (of,)
    whole = all(isinstance(part, (int, np.integer)) and not isinstance(part, bool) for part in parts)
    if of is not None and not (whole and len(parts) == (2 if parts is of else 1)):
        raise InputError("of", f"is {quoted(of)}; give a platform or a pair of different platforms")
    return (of[0], of[1]) if isinstance(of, list) else of


@quantity_function
def amplitude(*, mode: int, of: Pair = None, tier: Tier = "leading") -> Quantity:
    """Return the amplitude in a jam mode, m zero to peak, of a platform or of one platform relative to another.

    **Arguments**

    - `mode`: number of the jam mode, 1 to 2 nd + 1; typical: 1, 3, 5, which are stable for light loads
    - `of`: a platform, or a pair of them for a relative amplitude; typical: 1 to 3; default: platform 1 relative to 2, or the
      only one. For a machine without platforms: the number of a coordinate that is a displacement (default: 1, which is
      horizontal)
    - `tier`: "leading" (light loads, by algebra; the default), "exact" (the exact periodic motion), or "time" (the full
      equations, integrated from the jam for 60 periods of the lowest natural frequency); typical computing times for a machine:
      0.2 ms, 0.3 ms, 5 to 100 ms

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 0.5 to 10 mm. A mode or platform that the machine does not
    have raises `InputError` when the quantity is computed.

    >>> from optimize import amplitude
    >>> amplitude(mode=3, of=1).unit
    'm'
    """
    of = pair_of(of)
    return jam_quantity("amplitude", "m", jam_amplitude, mode, tier, f"amplitude{pair_text(of)}", of=of, settings=(of,))


def jam_amplitude(evaluation: Evaluation, tier: Tier, mode: int, of: Pair) -> Array:
    chosen = resolve_pair(evaluation.scene, of)
    structure = evaluation.scene.machine.structure()
    for number in np.ravel(chosen):
        if structure.units[number - 1] != "m":
            problem = f"is {quoted(of)}; coordinate {number}, {structure.coordinates[number - 1]}, is a rotation"
            raise InputError("of", f"{problem}; give the number of a displacement")
    if tier == "leading":
        jam = evaluation.jam(mode)
        if isinstance(chosen, int):
            return jam.amplitude[chosen - 1]
        return magnitude(jam.displacement[chosen[0] - 1] - jam.displacement[chosen[1] - 1])
    if tier == "exact":
        orbit = evaluation.orbit(mode)
        return orbit.amplitude[chosen - 1] if isinstance(chosen, int) else orbit.relative_amplitude(*chosen)
    run = evaluation.jam_run(mode)
    return run.amplitude[chosen - 1] if isinstance(chosen, int) else relative_amplitude(run.window, *chosen)


@quantity_function
def phase(*, mode: int, of: tuple[int, int] = (1, 2), tier: Tier = "leading") -> Quantity:
    """Return the phase difference of two platforms in a jam mode, rad, 0 to pi: 0 in phase, pi in antiphase.

    For the tier "exact" it is the phase difference of the first harmonics.

    **Arguments**

    - `mode`: number of the jam mode; typical: 1, 3, 5
    - `of`: the two platforms (default: 1 and 2)
    - `tier`: "leading" (the default) or "exact"

    **Returns** `Quantity`, NaN if the mode does not exist. **Raises** `InputError` if `of` is not a pair.

    >>> from optimize import phase
    >>> (phase(mode=3) > "170 deg").words
    'phase between platforms 1 and 2, mode 3 at least 170 deg'
    """
    pair = pair_of(of)
    if not isinstance(pair, tuple) or len(pair) != 2:
        raise InputError("of", f"is {quoted(of)}; a phase needs a pair of platforms such as (1, 2)")
    text = f"phase between platforms {pair[0]} and {pair[1]}"
    return jam_quantity("phase", "rad", _phase, mode, tier, text, of=pair, settings=(pair,), tiers=("leading", "exact"))


def _phase(evaluation: Evaluation, tier: Tier, mode: int, of: tuple[int, int]) -> Array:
    resolve_pair(evaluation.scene, of)  # raises an error for platforms that the scene does not have
    i, j = of
    if tier == "leading":
        first = evaluation.jam(mode).displacement
    else:
        orbit = evaluation.orbit(mode)
        first = orbit.displacement_harmonics[:, orbit.orders.index(1)]
    relative = first[i - 1] * jnp.conj(first[j - 1])
    return jnp.arctan2(jnp.abs(relative.imag), relative.real)


@quantity_function
def foundation_force(*, mode: int | None = None, harmonic: int | None = None, tier: Tier = "leading") -> Quantity:
    """Return the force of all supports on the foundation, N zero to peak, in a jam mode or in the working regime.

    **Arguments**

    - `mode`: number of the jam mode; typical: 1, 3, 5; default: the regime of `jaxvib.working_regime`
    - `harmonic`: number k of a harmonic of the exact motion, for the force at k times the load speed only; typical: 1 to 5;
      default: the whole force
    - `tier`: as for `amplitude`; a harmonic is always computed with the tier "exact"

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 1 to 2000 N for jams, 1 to 20 kN for screens. A mode that
    the machine does not have raises `InputError` when the quantity is computed. **Raises** `InputError` for a harmonic with the
    tier "time" or without a mode.

    >>> from optimize import foundation_force
    >>> foundation_force(mode=3).unit
    'N'
    """
    if mode is None:
        if harmonic is not None:
            raise InputError("harmonic", f"is {quoted(harmonic)} without a mode; give the jam mode")
        return RegimeQuantity("foundation_force", "N", working_force, tier=tier, text="foundation force of the settled motion")
    if harmonic is None:
        return jam_quantity(
            "foundation_force", "N", jam_force, mode, tier, "foundation force", settings=(None,), pieces_function=_peaks
        )
    count(harmonic, "harmonic")
    text = f"harmonic {harmonic} of the foundation force"
    tier = "exact" if tier == "leading" else tier
    return jam_quantity("force_harmonic", "N", jam_force, mode, tier, text, settings=(harmonic,), tiers=("exact",))


def jam_force(evaluation: Evaluation, tier: Tier, mode: int, harmonic: int | None) -> Array:
    """Return the foundation force in a jam mode, or a harmonic of it, N zero to peak."""
    require_foundation(evaluation.scene)
    if tier == "leading":
        return evaluation.jam(mode).foundation_force
    if tier == "time":
        return evaluation.jam_run(mode).foundation_force
    orbit = evaluation.orbit(mode)
    if harmonic is None:
        return orbit.foundation_force
    if harmonic not in orbit.orders:  # the half-turn symmetry leaves odd harmonics only
        return jnp.zeros_like(orbit.omega)
    return peak_force(orbit.force_harmonics[:, orbit.orders.index(harmonic)])


@quantity_function
def force_per_amplitude(*, mode: int, of: Pair = None, tier: Tier = "leading") -> Quantity:
    """Return the foundation force per amplitude in a jam mode, N/m.

    **Arguments**

    - `mode`: number of the jam mode; typical: 1, 3, 5
    - `of`: a platform or a pair of platforms, as for `amplitude`
    - `tier`: as for `amplitude`

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 0.001 to 1 times the stiffness of the supports. A mode or
    platform that the machine does not have raises `InputError` when the quantity is computed.

    >>> from optimize import force_per_amplitude
    >>> force_per_amplitude(mode=3).unit
    'N/m'
    """
    of = pair_of(of)
    text = f"force per amplitude{pair_text(of)}"
    return jam_quantity(
        "force_per_amplitude", "N/m", _ratio, mode, tier, text, of=of, settings=(of,), pieces_function=_peaks_per_amplitude
    )


def _ratio(evaluation: Evaluation, tier: Tier, mode: int, of: Pair) -> Array:
    return jam_force(evaluation, tier, mode, None) / jam_amplitude(evaluation, tier, mode, of)


def _peaks(evaluation: Evaluation, sign: float, tier: Tier, mode: int, harmonic: int | None) -> Array:
    """Return pieces whose maximum is `sign` times the force: for the exact force (sign > 0) its peaks within the period.

    If the first harmonic of the force is small, several peaks are nearly equal.
    """
    if tier != "exact" or sign < 0.0:
        return sign * jam_force(evaluation, tier, mode, harmonic)[None]
    return evaluation.orbit(mode).force_peaks()


def _peaks_per_amplitude(evaluation: Evaluation, sign: float, tier: Tier, mode: int, of: Pair) -> Array:
    return _peaks(evaluation, sign, tier, mode, None) / jam_amplitude(evaluation, tier, mode, of)


@quantity_function
def jam_frequency(*, mode: int, tier: Tier = "leading") -> Quantity:
    """Return the speed Omega at which the loads jam in a mode, rad/s.

    **Arguments**: `mode`: number of the jam mode; typical: 1, 3, 5; `tier`: as for `amplitude`.

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 90 % to 100 % of a resonance, 10 to 300 rad/s. A mode that
    the machine does not have raises `InputError` when the quantity is computed.

    >>> from optimize import jam_frequency
    >>> jam_frequency(mode=3).unit
    'rad/s'
    """
    return jam_quantity("jam_frequency", "rad/s", jam_speed, mode, tier, "jam frequency")


def jam_speed(evaluation: Evaluation, tier: Tier, mode: int) -> Array:
    if tier == "leading":
        return evaluation.jam(mode).omega
    return evaluation.orbit(mode).omega if tier == "exact" else evaluation.jam_run(mode).omega


@quantity_function
def fold_margin(*, mode: int) -> Quantity:
    """Return the smallest change of the rotor speed, up or down, at which a jam mode ends at a fold, rad/s (leading order).

        margin = min(n - n_low, n_high - n),    n_low, n_high rotor speeds of the folds that end the mode

    If no fold ends the mode toward lower rotor speeds, n_low is 0; if no fold ends it toward higher ones, n_high is ten times
    the rotor speed.

    **Arguments**: `mode`: number of the jam mode; typical: 1, 3, 5.

    **Returns** `Quantity`, NaN if the mode does not exist; typical demand: above 5 % of the rotor speed.

    >>> from optimize import fold_margin
    >>> (fold_margin(mode=3) > "60 rpm").words
    'distance to the fold, mode 3 at least 60 rpm'
    """
    return jam_quantity(
        "fold_margin", "rad/s", None, mode, "leading", "distance to the fold", tiers=("leading",), pieces_function=_margins
    )


def _margins(evaluation: Evaluation, sign: float, tier: Tier, mode: int) -> Array:
    """Return pieces whose maximum is `sign` times the margin: minus both distances to the folds, or the smaller distance."""
    below, above = evaluation.folds(mode)
    n = evaluation.scene.drive.speed
    slow, fast = (below, above) if mode % 2 == 1 else (above, below)
    both = jnp.stack([n - slow, fast - n]) + 0.0 * evaluation.jam(mode).omega  # NaN if the mode does not exist
    return -both if sign < 0.0 else jnp.minimum(both[0], both[1])[None]


@quantity_function
def largest_multiplier(*, mode: int) -> Quantity:
    """Return the largest modulus of the non-trivial Floquet multipliers of the exact motion; the motion is stable below 1.

    **Arguments**: `mode`: number of the jam mode; typical: 1, 3, 5.

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 0.7 to 1; typical demand: below 0.99.

    >>> from optimize import largest_multiplier
    >>> (largest_multiplier(mode=3) < 0.99).words
    'largest multiplier, mode 3 at most 0.99'
    """
    return jam_quantity("largest_multiplier", "", _multiplier, mode, "exact", "largest multiplier", tiers=("exact",))


def _multiplier(evaluation: Evaluation, tier: Tier, mode: int) -> Array:
    return evaluation.orbit(mode).multiplier


@quantity_function
def power(*, mode: int | None = None, tier: Tier = "leading") -> Quantity:
    """Return the mean power, W, that loads take from the rotor in a jam mode, or of all drives in the working regime.

        P = n (sum_j b_W R^2 (n - Omega) + torque of dry friction)    (jam, leading order)

    **Arguments**: `mode`: number of the jam mode; typical: 1, 3, 5; default: the regime of
    `jaxvib.working_regime`; `tier`: "leading" (the default) or "exact".

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 10 to 2000 W for jams, 0.1 to 20 kW for screens.

    >>> from optimize import power
    >>> power(mode=3).unit
    'W'
    """
    if mode is None:
        return RegimeQuantity("power", "W", working_power, tier=tier, tiers=("leading", "exact"), text="power of all drives")
    return jam_quantity("power", "W", _power, mode, tier, "power drawn", tiers=("leading", "exact"))


def _power(evaluation: Evaluation, tier: Tier, mode: int) -> Array:
    if tier == "exact":
        return evaluation.orbit(mode).power
    jam = evaluation.jam(mode)
    return evaluation.scene.drive.speed * shaft_torque(evaluation.jammed, jam.omega, jam.displacement)
