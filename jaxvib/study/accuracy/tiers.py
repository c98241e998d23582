"""Error of the leading order: jams of light loads compared with exact jams for increasing mass of the loads."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, speed_text
from jaxvib.equations.linear import jammed_loads
from jaxvib.machine.scene import Scene
from jaxvib.results.fields import in_unit, part
from jaxvib.results.readable import Readable
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.steady.jams.jam import Jam, jam_modes
from jaxvib.steady.orbits.describe import Orbit
from jaxvib.steady.orbits.jam_orbit import jam_orbit
from jaxvib.units import numbers


class TierValues(Readable):
    """Results of one tier for n masses, NaN for a missing result.

    **Attributes**: `omega` (n,), rad/s; `amplitude` (n, nd), m (tilts: rad), and `foundation_force` (n,), N, zero to peak;
    `stable` (n,); `message` (n,): the outcome of each computation as a sentence, with the reason for a missing result.
    """

    omega: np.ndarray = eqx.field(metadata=in_unit("rad/s", "mass"))
    amplitude: np.ndarray = eqx.field(metadata=in_unit("m or rad", "mass", "coordinate"))
    foundation_force: np.ndarray = eqx.field(metadata=in_unit("N", "mass"))
    stable: np.ndarray = eqx.field(metadata=in_unit("", "mass"))
    message: tuple[str, ...] = eqx.field(metadata=in_unit("", "mass"))


class Tiers(Result):
    """Jams computed by two tiers for several masses of a load.

    **Attributes**: `mass` (n,) of one load, kg (the mean if loads differ); `leading` and `exact`: `TierValues` of the two
    tiers.
    """

    status = Computed.done

    mass: np.ndarray = eqx.field(metadata=in_unit("kg", "mass"))
    leading: TierValues = eqx.field(metadata=part(prefix="leading_"))
    exact: TierValues = eqx.field(metadata=part(prefix="exact_"))

    def summary(self) -> str:
        """Return a line of text for each mass: the load speed by both tiers, or the reason why it is missing."""
        lines = []
        for k, mass in enumerate(self.mass):
            light, exact = (
                speed_text(tier.omega[k], 9) if np.isfinite(tier.omega[k]) else tier.message[k]
                for tier in (self.leading, self.exact)
            )
            lines.append(f"load of {mass:.4g} kg: leading order {light}, exact {exact}")
        return "\n".join(lines)

    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot relative differences of load speed, amplitude and foundation force against the mass of a load.

        Hollow symbols mark unstable jams.
        """
        differences = {
            "load speed": np.abs(self.leading.omega / self.exact.omega - 1.0),
            "amplitude": np.max(np.abs(self.leading.amplitude / self.exact.amplitude - 1.0), axis=1),
            "foundation force": np.abs(self.leading.foundation_force / self.exact.foundation_force - 1.0),
        }
        from jaxvib.draw.comparison import tiers_chart  # slow import

        return tiers_chart(self.mass, differences, self.exact.stable, ax=ax)


@validated
def compare_tiers(scene: Scene, factors: Sequence[float], *, mode: int) -> Tiers:
    """Compare the leading-order result for a jam mode with the exact jam, for heavier and lighter loads than in the scene.

    The drag is multiplied by the square of the factor on the mass. The leading-order balance n(Omega) then stays the same,
    except for the contribution of the loads to the mass of their platform. Dry friction is proportional to the mass, as in a
    machine, and changes the balance.

    **Arguments**

    - `scene` of the jam
    - `factors` on the mass, and on the moment of inertia, of the loads; typical: 0.1 to 10
    - `mode`: a jam mode, see `jam_modes`; typical: 1, 3, 5

    **Returns** `Tiers`. **Raises** `InputError` for a mode out of 1 .. 2 nd + 1.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> tiers = compare_tiers(form.scene(), (0.1, 1.0, 10.0), mode=3)
    >>> [f"{abs(a / b - 1):.0e}" for a, b in zip(tiers.leading.omega, tiers.exact.omega)]
    ['1e-06', '1e-05', '1e-04']

    Source: the antiphase paper for the leading order, see `jam_modes`; the comparison: this package.
    """
    loads, factors = jammed_loads(scene), np.atleast_1d(numbers(factors, "", "factors", None, low=0.0, open_low=True)).tolist()
    jams_of_masses: list[tuple[Jam, Orbit]] = []
    for factor in factors:
        heavier = eqx.tree_at(
            lambda x: (x.mass, x.drag, x.inertia),
            loads,
            (loads.mass * factor, loads.drag * factor**2, None if loads.inertia is None else loads.inertia * factor),
            is_leaf=lambda x: x is None,
        )
        scene_of_mass = eqx.tree_at(lambda s: s.loads, scene, heavier)
        jams_of_masses.append(
            (jam_modes(scene_of_mass).select(mode, throw=False), jam_orbit(scene_of_mass, mode=mode, throw=False))
        )

    def tier(which: int) -> TierValues:
        jams = [jams[which] for jams in jams_of_masses]
        names = ("omega", "amplitude", "foundation_force", "stable")
        numbers = (np.stack([np.asarray(getattr(jam, name)) for jam in jams]) for name in names)
        return TierValues(*numbers, message=tuple(jam.message for jam in jams))

    return Tiers(float(jnp.mean(loads.mass)) * np.asarray(factors, dtype=float), tier(0), tier(1))
