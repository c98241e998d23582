"""Quantities of a scene that a search minimises or holds."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import linear_model
from jaxvib.errors import InputError
from jaxvib.machine.platforms import Platforms
from jaxvib.machine.scene import Scene
from jaxvib.numerics.linalg import magnitude
from jaxvib.steady.jams.jam import Jam, JamModes, jam_modes
from jaxvib.units import FIELD_UNITS

__all__ = [
    "Quantity",
    "amplitude",
    "between",
    "force_per_amplitude",
    "foundation_force",
    "jam_frequency",
    "negative",
    "support_frequency_squared",
    "total",
]

Pair = int | tuple[int, int] | None
"""Whose amplitude: a platform's own, or that of one platform relative to another; None: see `between`."""


class Quantity:
    """A number of a scene with a name and a unit.

    **Arguments**: `name`; `unit`, "" for none; `function` of a `Scene` and its jam modes (`jaxvib.JamModes`) that gives a
    scalar, differentiable, NaN where the quantity does not exist; `mode` the jam mode it belongs to, if any; `of` whose
    amplitude it is about, if any.

    >>> import jaxvib as jv
    >>> from optimize import Quantity
    >>> heaviest = Quantity("heaviest", "kg", lambda scene, modes: scene.machine.mass.max())
    """

    def __init__(
        self,
        name: str,
        unit: str,
        function: Callable[[Scene, JamModes], Array],
        *,
        mode: int | None = None,
        of: Pair = None,
    ):
        self.name = name
        self.unit = unit
        self.function = function
        self.mode = mode
        self.of = of

    def __call__(self, scene: Scene, modes: JamModes | None = None) -> Array:
        """The quantity's value for a scene, a scalar in `unit`; `modes` saves computing its jam modes once more."""
        return self.function(scene, jam_modes(scene) if modes is None else modes)


def between(scene: Scene, of: Pair = None) -> int | tuple[int, int]:
    """Whose amplitude is meant: `of`, or, if it is None, platform 1 against 2, and the only platform where there is one.

    **Raises** `InputError` for a platform that is not there.
    """
    n = scene.machine.carrier().mass.shape[0]
    if of is None:
        return (1, 2) if n > 1 else 1
    platforms = tuple(of) if isinstance(of, (tuple, list)) else (of,)
    whole = all(isinstance(p, (int, np.integer)) and not isinstance(p, bool) and 1 <= p <= n for p in platforms)
    if whole and len(platforms) == 1:
        return platforms[0]
    if whole and len(platforms) == 2 and platforms[0] != platforms[1]:
        return platforms[0], platforms[1]
    raise InputError("of", f"is {of!r}; give a platform or a pair of different platforms of 1 to {n}")


def _amplitude(scene: Scene, jam: Jam, of: Pair) -> Array:
    chosen = between(scene, of)
    if isinstance(chosen, int):
        return jam.amplitude[chosen - 1]
    i, j = chosen
    return magnitude(jam.displacement[i - 1] - jam.displacement[j - 1])


def amplitude(*, mode: int, of: Pair = None) -> Quantity:
    """Amplitude in a jam mode, m zero to peak: of a platform, or of one relative to another (see `between`).

    **Arguments**: `mode` number of the jam mode; `of` whose amplitude, a platform or a pair of them.

    **Returns** `Quantity`, NaN where the mode does not exist. A number of a mode or platform that the machine does not have
    raises `InputError` where the quantity is computed.

    >>> from optimize import amplitude
    >>> amplitude(mode=3, of=1).unit
    'm'
    """
    return Quantity(
        "amplitude", "m", lambda scene, modes: _amplitude(scene, modes.select(mode, throw=False), of), mode=mode, of=of
    )


def foundation_force(*, mode: int) -> Quantity:
    """Force of all supports on the bed in a jam mode, N zero to peak.

    **Arguments**: `mode` number of the jam mode.

    **Returns** `Quantity`, NaN where the mode does not exist. A number of a mode that the machine does not have raises
    `InputError` where the quantity is computed.

    >>> from optimize import foundation_force
    >>> foundation_force(mode=3).unit
    'N'
    """
    return Quantity("foundation_force", "N", lambda _, modes: modes.select(mode, throw=False).foundation_force, mode=mode)


def force_per_amplitude(*, mode: int, of: Pair = None) -> Quantity:
    """Foundation force per amplitude in a jam mode, N/m; whose amplitude as `amplitude`.

    **Arguments**: `mode` number of the jam mode; `of` whose amplitude, a platform or a pair of them.

    **Returns** `Quantity`, NaN where the mode does not exist. A number of a mode or platform that the machine does not have
    raises `InputError` where the quantity is computed.

    >>> from optimize import force_per_amplitude
    >>> force_per_amplitude(mode=3).unit
    'N/m'
    """

    def ratio(scene: Scene, modes: JamModes) -> Array:
        jam = modes.select(mode, throw=False)
        return jam.foundation_force / _amplitude(scene, jam, of)

    return Quantity("force_per_amplitude", "N/m", ratio, mode=mode, of=of)


def jam_frequency(*, mode: int) -> Quantity:
    """Speed Omega at which the loads jam in a mode, rad/s.

    **Arguments**: `mode` number of the jam mode.

    **Returns** `Quantity`, NaN where the mode does not exist. A number of a mode that the machine does not have raises
    `InputError` where the quantity is computed.

    >>> from optimize import jam_frequency
    >>> jam_frequency(mode=3).unit
    'rad/s'
    """
    return Quantity("jam_frequency", "rad/s", lambda _, modes: modes.select(mode, throw=False).omega, mode=mode)


def support_frequency_squared() -> Quantity:
    """sum_i k_i/M_i over the platforms, loads included in M, (rad/s)^2: the stiffness budget n_1^2 + n_2^2 of the papers.

    **Returns** `Quantity`. A machine without platforms raises `InputError` where the quantity is computed.

    >>> import jaxvib as jv
    >>> from optimize import support_frequency_squared
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> round(float(support_frequency_squared()(form.scene())), 6)
    0.222222

    Source: the antiphase paper, section 5.1.
    """

    def budget(scene: Scene, _: JamModes) -> Array:
        if not isinstance(scene.machine, Platforms):
            raise InputError("machine.kind", f"is {scene.machine.kind!r}; the budget is that of platforms' supports")
        return jnp.sum(scene.machine.stiffness / jnp.diagonal(linear_model(scene).mass))

    return Quantity("support_frequency_squared", "rad^2/s^2", budget)


def total(field: str) -> Quantity:
    """The sum of an array of the scene, such as "machine.stiffness", in the unit of its entries.

    **Returns** `Quantity`. **Raises** `InputError` for a name that no scene has.

    >>> from optimize import total
    >>> total("machine.stiffness").unit
    'N/m'
    """
    part, _, name = field.partition(".") if isinstance(field, str) else ("", "", "")
    if part not in ("machine", "loads") or name not in FIELD_UNITS:
        raise InputError("field", f"is {field!r}; it must name numbers of a scene, for example 'machine.stiffness'")

    def summed(scene: Scene, _: JamModes) -> Array:
        leaf = getattr(getattr(scene, part), name, None)
        if not isinstance(leaf, jax.Array):
            raise InputError("field", f"is {field!r}, which this scene does not have")
        return jnp.sum(leaf)

    return Quantity(f"total {field}", FIELD_UNITS[name], summed)


def negative(quantity: Quantity) -> Quantity:
    """The quantity with its sign turned: a search that makes it small makes the quantity itself large.

    **Returns** `Quantity`.

    >>> from optimize import amplitude, negative
    >>> negative(amplitude(mode=3, of=1)).name
    'negative amplitude'
    """
    return Quantity(
        f"negative {quantity.name}",
        quantity.unit,
        lambda scene, modes: -quantity(scene, modes),
        mode=quantity.mode,
        of=quantity.of,
    )
