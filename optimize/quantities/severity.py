"""Quantities of a jam as engineers state them: stroke, acceleration, velocity, isolation, torque, forces on supports."""

from __future__ import annotations

from jax import Array

from jaxvib.errors import InputError
from jaxvib.steady import measures
from jaxvib.steady.measures import exciter_force, support_loads, weight_deflection
from jaxvib.steady.vibration import acceleration_of, rms_velocity_of
from jaxvib.units import count
from optimize.quantities.evaluation import Evaluation, require_foundation
from optimize.quantities.jams import jam_amplitude, jam_force, jam_quantity, jam_speed, pair_of, pair_text
from optimize.quantities.quantity import Pair, Quantity, Tier, quantity_function

__all__ = ["acceleration", "shaft_torque", "stroke", "support_load", "transmissibility", "velocity"]


@quantity_function
def stroke(*, mode: int, of: Pair = None, tier: Tier = "leading") -> Quantity:
    """Return the stroke in a jam mode, m peak to peak: twice the amplitude.

        stroke = 2 Y

    **Arguments**

    - `mode`: number of the jam mode; typical: 1, 3, 5
    - `of`: a platform, or a pair of platforms, as for `amplitude`
    - `tier`: as for `amplitude`

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 2 to 20 mm. A mode or platform that the machine does
    not have raises `InputError` when the quantity is computed.

    >>> from optimize import stroke
    >>> stroke(mode=3, of=1).unit
    'm'
    """
    of = pair_of(of)
    return jam_quantity("stroke", "m", _stroke, mode, tier, f"stroke{pair_text(of)}", of=of, settings=(of,))


def _stroke(evaluation: Evaluation, tier: Tier, mode: int, of: Pair) -> Array:
    return 2.0 * jam_amplitude(evaluation, tier, mode, of)


@quantity_function
def acceleration(*, mode: int, of: Pair = None, tier: Tier = "leading") -> Quantity:
    """Return the amplitude of the acceleration in a jam mode, in g = 9.80665 m/s^2, for a vibration at the load speed.

        a = Omega^2 Y / g

    **Arguments**

    - `mode`: number of the jam mode; typical: 1, 3, 5
    - `of`: a platform, or a pair of platforms, as for `amplitude`
    - `tier`: as for `amplitude`

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 2 to 6 for screens. A mode or platform that the machine
    does not have raises `InputError` when the quantity is computed.

    >>> from optimize import acceleration
    >>> acceleration(mode=3, of=1).unit
    ''
    """
    of = pair_of(of)
    return jam_quantity(
        "acceleration", "", _acceleration, mode, tier, f"acceleration in g{pair_text(of)}", of=of, settings=(of,)
    )


def _acceleration(evaluation: Evaluation, tier: Tier, mode: int, of: Pair) -> Array:
    return acceleration_of(jam_amplitude(evaluation, tier, mode, of), jam_speed(evaluation, tier, mode))


@quantity_function
def velocity(*, mode: int, of: Pair = None, tier: Tier = "leading") -> Quantity:
    """Return the root mean square of the velocity in a jam mode, m/s, for a vibration at the load speed.

        v = Omega Y / sqrt 2

    **Arguments**

    - `mode`: number of the jam mode; typical: 1, 3, 5
    - `of`: a platform, or a pair of platforms, as for `amplitude`
    - `tier`: as for `amplitude`

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 0.05 to 0.3 m/s for platforms. A mode or platform that the
    machine does not have raises `InputError` when the quantity is computed.

    >>> from optimize import velocity
    >>> velocity(mode=3, of=1).unit
    'm/s'
    """
    of = pair_of(of)
    return jam_quantity("velocity", "m/s", _velocity, mode, tier, f"RMS velocity{pair_text(of)}", of=of, settings=(of,))


def _velocity(evaluation: Evaluation, tier: Tier, mode: int, of: Pair) -> Array:
    return rms_velocity_of(jam_amplitude(evaluation, tier, mode, of), jam_speed(evaluation, tier, mode))


@quantity_function
def transmissibility(*, mode: int, tier: Tier = "leading") -> Quantity:
    """Return the foundation force in a jam mode, divided by the centrifugal force of the loads.

        T = F / (S Omega^2),    isolation = 1 - T

    **Arguments**: `mode`: number of the jam mode; typical: 1, 3, 5; `tier`: as for `amplitude`.

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 0.01 to 5. A mode that the machine does not have raises
    `InputError` when the quantity is computed.

    >>> from optimize import transmissibility
    >>> (transmissibility(mode=3) < 0.1).words
    'transmissibility, mode 3 at most 0.1'
    """
    return jam_quantity("transmissibility", "", _transmissibility, mode, tier, "transmissibility")


def _transmissibility(evaluation: Evaluation, tier: Tier, mode: int) -> Array:
    return jam_force(evaluation, tier, mode, None) / exciter_force(evaluation.jammed, jam_speed(evaluation, tier, mode))


@quantity_function
def shaft_torque(*, mode: int, tier: Tier = "leading") -> Quantity:
    """Return the mean torque of the loads on the rotor in a jam mode, N m.

    **Arguments**: `mode`: number of the jam mode; typical: 1, 3, 5; `tier`: "leading" (the default) or "exact".

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 0.1 to 20 N m. A mode that the machine does not have
    raises `InputError` when the quantity is computed.

    >>> from optimize import shaft_torque
    >>> shaft_torque(mode=3).unit
    'N m'
    """
    return jam_quantity("shaft_torque", "N m", _shaft_torque, mode, tier, "shaft torque", tiers=("leading", "exact"))


def _shaft_torque(evaluation: Evaluation, tier: Tier, mode: int) -> Array:
    if tier == "exact":
        return evaluation.orbit(mode).power / evaluation.scene.drive.speed
    jam = evaluation.jam(mode)
    return measures.shaft_torque(evaluation.jammed, jam.omega, jam.displacement)


@quantity_function
def support_load(*, mode: int, of: int) -> Quantity:
    """Return the greatest force on a support in a jam mode, N: the weight on it plus the amplitude of the force of the
    vibration.

    **Arguments**: `mode`: number of the jam mode; typical: 1, 3, 5; `of`: number of the support (of a machine with platforms:
    number of the platform above it); typical: 1 to 3.

    **Returns** `Quantity`, NaN if the mode does not exist; typical: 200 N to 50 kN. A machine without this support raises
    `InputError` when the quantity is computed.

    >>> from optimize import support_load
    >>> support_load(mode=3, of=2).words
    'force on support 2, mode 3'
    """
    count(of, "of")
    return jam_quantity(
        "support_load", "N", _support_load, mode, "leading", f"force on support {of}", settings=(of,), tiers=("leading",)
    )


def _support_load(evaluation: Evaluation, tier: Tier, mode: int, of: int) -> Array:
    require_foundation(evaluation.scene)
    jam = evaluation.jam(mode)
    static, dynamic, _ = support_loads(evaluation.jammed, jam.omega, jam.displacement, weight_deflection(evaluation.jammed))
    if of > static.shape[0]:
        raise InputError("of", f"is {of}; the machine has supports 1 to {static.shape[0]}")
    return static[of - 1] + dynamic[of - 1]
