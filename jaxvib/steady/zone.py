"""Zones of vibration severity of ISO 20816-3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from jaxvib.boundary import validated
from jaxvib.errors import InputError, require_one_of
from jaxvib.units import Number, number, numbers

ZONE_LIMITS = {
    ("large", "rigid"): (2.3e-3, 4.5e-3, 7.1e-3),
    ("large", "flexible"): (3.5e-3, 7.1e-3, 11.0e-3),
    ("medium", "rigid"): (1.4e-3, 2.8e-3, 4.5e-3),
    ("medium", "flexible"): (2.3e-3, 4.5e-3, 7.1e-3),
}
"""Boundaries A/B, B/C and C/D of the zones of ISO 20816-3, m/s RMS, for machines of 300 kW to 50 MW ("large") and of 15 to
300 kW ("medium"), on rigid and on flexible supports, as practitioners quote them. The text of the standard was not available
for a comparison, and public pages contradict each other."""


@validated
def vibration_zone(
    velocity: Number,
    *,
    machine: Literal["medium", "large"] = "medium",
    supports: Literal["rigid", "flexible"] = "flexible",
    limits: Sequence[Number] | None = None,
) -> str:
    """Return the zone A, B, C or D of ISO 20816-3 of a vibration.

    A: new machines; B: allowed for long operation; C: allowed for a limited time; D: can cause damage. The standard applies to
    parts that must not vibrate, such as motors, frames and foundations. It does not apply to decks, which must vibrate; their
    velocities are usually in zone D.

    **Arguments**

    - `velocity`: root mean square, m/s or text; typical: "1 mm/s" to "10 mm/s"
    - `machine`: "medium" for 15 to 300 kW (the default), or "large" for 300 kW to 50 MW
    - `supports`: "flexible" (the default) or "rigid"
    - `limits` A/B, B/C, C/D, m/s, ascending, from your copy of the standard or from a contract, in place of the built-in ones;
      typical: ["2.3 mm/s", "4.5 mm/s", "7.1 mm/s"]

    The built-in limits are values usual in practice. They were not compared with the text of the standard: use `limits` if
    a contract depends on them.

    **Returns** a letter. **Raises** `InputError` for a negative velocity, another name, and limits that do not ascend.

    >>> vibration_zone("3 mm/s"), vibration_zone("3 mm/s", supports="rigid")
    ('B', 'C')
    >>> vibration_zone("3 mm/s", limits=["3.5 mm/s", "7.1 mm/s", "11 mm/s"])
    'A'

    Source: ISO 20816-3 defines the zones.
    """
    size = float(number(velocity, "m/s", "velocity", low=0.0))
    require_one_of(machine, ("medium", "large"), "machine")
    require_one_of(supports, ("rigid", "flexible"), "supports")
    ends = ZONE_LIMITS[machine, supports] if limits is None else np.asarray(numbers(limits, "m/s", "limits", 3, low=0.0))
    if np.any(np.diff(ends) < 0.0):
        raise InputError("limits", f"are {', '.join(f'{each:g}' for each in ends)} m/s; they must ascend")
    return "ABCD"[int(np.searchsorted(ends, size))]
