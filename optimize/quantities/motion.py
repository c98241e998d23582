"""Quantities of a run from rest, by time integration."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError, quoted
from jaxvib.units import Number, count
from optimize.quantities.evaluation import Evaluation, require_foundation
from optimize.quantities.quantity import BuiltinQuantity, Quantity, Tier, quantity_function
from optimize.quantities.user_inputs import Point, number_in, read_point

__all__ = ["peak_displacement", "peak_force", "settling_time"]


def _times(until: Number, spin_up: Number | None) -> tuple[float, float | None]:
    end = number_in(until, "s", "until")
    up = None if spin_up is None else number_in(spin_up, "s", "spin_up")
    if not 0.0 < (end if up is None else up) <= end:
        if up is None:
            raise InputError("until", f"is {end:g} s; it must be greater than 0")
        raise InputError("spin_up", f"is {up:g} s; it must be greater than 0 and at most until, {end:g} s")
    return end, up


@quantity_function
def peak_force(*, until: Number, spin_up: Number | None = None) -> Quantity:
    """Return the largest foundation force, N, of a run from rest (full equations).

    The force is computed at 4000 times of the run, and a parabola estimates the largest value between them. The value is too
    small by at most 0.1 % if a period of the force contains 16 of these times, and by at most 1 % if it contains 8. If the run
    is longer, or the peak shorter, such as that of a collision with a `Stop`, the value may be too small by a few percent. The
    measure `run.peak_force` of sweeps evaluates the force at each step of the integration and does not have this error.

    **Arguments**

    - `until`: end of the integration, s or text; typical: 5 to 30
    - `spin_up`: time during which the rotor speed rises smoothly, s or text; typical: 1 to 10. None (the default): the drives
      of the scene accelerate and stop the rotors (motors, run-ups, `SpeedProfile`)

    **Returns** `Quantity`; its derivatives exist in forward mode only; typical: 500 N to 10 kN. **Raises** `InputError` for a
    time that is not positive, and for a `spin_up` longer than the run.

    >>> from optimize import peak_force
    >>> (peak_force(until="20 s", spin_up="5 s") < "2 kN").words
    'largest foundation force of a run from rest at most 2 kN'
    """
    text = "largest foundation force of a run from rest"
    return BuiltinQuantity("peak_force", "N", _peak, tier="time", tiers=("time",), text=text, settings=_times(until, spin_up))


def _peak(evaluation: Evaluation, tier: Tier, until: float, spin_up: float | None) -> Array:
    require_foundation(evaluation.scene)
    return evaluation.start_up(until, spin_up).largest_force


@quantity_function
def peak_displacement(
    *, until: Number, at: int | Sequence[Number] | None = None, body: int = 0, spin_up: Number | None = None
) -> Quantity:
    """Return the largest displacement, m, of a point during a run from rest (full equations), for example while motors pass
    the resonances. It is computed at 4000 times of the run, see `peak_force`.

    **Arguments**

    - `until` and `spin_up`: as for `peak_force`
    - `at`: number of a platform, or a point (x, y) of a body, m or text, from its centre of mass; default: the centre of mass,
      platform 1, or the common station of a rotor's loads; typical: (1.5, 0.1)
    - `body`: number of the body from 0; typical: 0 (the default)

    **Returns** `Quantity`; its derivatives exist in forward mode only; typical: 5 to 30 mm, two to four times the amplitude at
    working speed. **Raises** `InputError` for times as in `peak_force`, and for a point that is not (x, y). For a place that
    the machine does not have, `InputError` is raised when the quantity is computed.

    >>> from optimize import peak_displacement
    >>> (peak_displacement(until="10 s", at=(1.5, 0.1)) < "15 mm").words
    'largest displacement at (1.5, 0.1) m of a run from rest at most 15 mm'
    """
    place, where = at, ""
    if isinstance(at, (list, tuple)):
        place = read_point(at, "at")
        where = f" at ({place[0]:g}, {place[1]:g}) m"
    elif at is not None:
        where = f" of platform {count(at, 'at')}"
    text = f"largest displacement{where} of a run from rest"
    settings = (*_times(until, spin_up), place, count(body, "body", low=0))
    return BuiltinQuantity(
        "peak_displacement", "m", _peak_displacement, tier="time", tiers=("time",), text=text, settings=settings
    )


def _peak_displacement(
    evaluation: Evaluation, tier: Tier, until: float, spin_up: float | None, place: int | Point | None, body: int
) -> Array:
    return evaluation.start_up(until, spin_up).point(place, body, part="all").largest_displacement


@quantity_function
def settling_time(*, until: Number, spin_up: Number, within: float = 0.05, of: int = 1) -> Quantity:
    """Return the time, s, from the start at rest until the amplitude of a platform stays near its final value.

    The full equations are integrated. The amplitude at a time is sqrt(y^2 + (y'/w)^2), where w is the load speed at the end of
    the run; the final value is its mean over the last twentieth of the run.

    **Arguments**

    - `until` and `spin_up` (required): as for `peak_force`
    - `within`: the largest relative deviation from the final amplitude; typical: 0.02 to 0.1 (default 0.05)
    - `of`: number of the platform; typical: 1 (the default)

    **Returns** `Quantity`; its derivatives exist in forward mode only; typical: the duration of the spin-up plus 2 to
    20 s. A value close to `until` shows that the motion has not settled.

    **Raises** `InputError` for a `within` that is not between 0 and 1, and for a `spin_up` as for `peak_force`. For a platform
    that the machine does not have, `InputError` is raised when the quantity is computed.

    >>> from optimize import settling_time
    >>> settling_time(until="20 s", spin_up="5 s").unit
    's'
    """
    count(of, "of")
    if not 0.0 < (share := number_in(within, "", "within")) < 1.0:
        raise InputError("within", f"is {quoted(within)}; it must be greater than 0 and less than 1")
    text = f"time until platform {of} settles"
    settings = (*_times(until, spin_up), share, of)
    return BuiltinQuantity("settling_time", "s", _settling, tier="time", tiers=("time",), text=text, settings=settings)


def _settling(evaluation: Evaluation, tier: Tier, until: float, spin_up: float | None, within: float, of: int) -> Array:
    run = evaluation.start_up(until, spin_up)
    assert run.trajectory is not None
    state, time = run.trajectory.state, run.trajectory.time
    if of > state.displacement.shape[1]:
        raise InputError("of", f"is {of}; the machine has platforms 1 to {state.displacement.shape[1]}")
    y, v = state.displacement[:, of - 1], state.velocity[:, of - 1]
    size = jnp.sqrt(y**2 + (v / run.omega) ** 2 + jnp.finfo(y.dtype).tiny)
    last = size.shape[0] // 20
    off = jnp.abs(size / jnp.mean(size[-last:]) - 1.0) - within
    # The last sample outside the range, and the time at which the line from it to the next sample enters the range.
    index = jnp.arange(off.shape[0])
    k = jax.lax.stop_gradient(jnp.clip(jnp.max(jnp.where(off > 0.0, index, 0)), 0, off.shape[0] - 2))
    share = jnp.clip(off[k] / (off[k] - off[k + 1]), 0.0, 1.0)
    return time[k] + share * (time[k + 1] - time[k])
