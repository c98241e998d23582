"""Machines in the dimensionless parameters of the two papers on platform machines, and conversion of results to these
parameters."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted
from jaxvib.machine.drives.drive import ConstantSpeed
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import Platforms
from jaxvib.results.readable import Readable
from jaxvib.runtime.devices import array_module, numpy_if_known, on_device
from jaxvib.units import Number, Numbers, number, numbers
from jaxvib.units import count as whole

_LINKS: dict[int, tuple[tuple[int, int], ...]] = {1: (), 2: ((1, 2),), 3: ((1, 2), (1, 3), (2, 3))}
_KINDS = {1: "one_mass", 2: "two_mass", 3: "three_mass"}


class Dimensionless(Readable):
    """Platform machine in the dimensionless parameters of the antiphase paper or the criterion paper (see the source). The
    exciter is on platform 2, or on the only platform.

    With the exciter's total mass M2S = M2 + N m (loads included), time tau = w t, unbalance scale s~ and length y~ = s~/M2S:

        v_i = y_i/(rho_i y~), rho_i = M2S/M_i, n = speed/w, n_i^2 = k_i/(M_i w^2), n_ij^2 = k_ij/(M2S w^2),
        h_i = b_i/(2 M_i w), h_ij = b_ij/(2 M2S w), eps = y~/(kappa R), beta = b_W/(eps kappa m w)

    Platform i has the displacement y_i, the mass M_i, the stiffness k_i and the damping b_i. For the platform with the exciter,
    M2S replaces M_i in these formulas, so that its rho_i is 1. The N loads have the mass m, the radius R, the drag b_W and
    kappa = 1 + (moment of inertia about the centre of mass)/(m R^2). phi_j are the angles of the loads, and s_y is the vertical
    component of their dimensionless unbalance s.

    The two papers scale the unbalance differently, and therefore also eps and v_i:

    - `form="antiphase"`: s~ = m R, so s_y = sum sin phi_j, coincident loads have s = N, and eps is m/(kappa M2S)
    - `form="criterion"`: s~ = N m R, so s_y = (1/N) sum sin phi_j, coincident loads have s = 1, and eps is N m/(kappa M2S)

    **Arguments** (p platforms; numbers are dimensionless unless a unit is stated)

    - `form`: "antiphase" or "criterion"
    - `natural` n_i (p,): natural frequency of each platform on its own support; typical: 0.2 to 1
    - `damping` h_i (p,); typical: 0.01 to 0.05
    - `link_natural` n_ij: square root of the stiffness of each link (12 for two masses; 12, 13, 23 for three); typical: 0.3
      to 1
    - `link_damping` h_ij, one number for each link; typical: 0.01 to 0.05
    - `rho` rho_i (p - 1,) of the platforms without the exciter, in order; typical: 0.5 to 2
    - `eps`: mass of one load ("antiphase") or of all loads ("criterion"), divided by kappa M2S; typical: 1e-3 to 0.1
    - `beta`: drag of the loads; typical: 0.1 to 10
    - `speed` n of the rotor; typical: 1 to 5 times the lowest resonance
    - `count` N of loads; typical: 1 to 4
    - `mass_scale` M2S, kg, `frequency_scale` w, rad/s, and `radius` R, m: the size of the machine, which can be chosen freely;
      typical: 1 each, or 50 to 5000 kg, 10 to 100 rad/s and 0.05 to 0.3 m
    - `kappa`, at least 1: inertia factor of the loads, which are pendulums; typical: 1 to 1.5

    **Raises** `InputError` for lengths that do not fit, negative values, 0 for arguments other than `natural`, `damping`,
    `link_natural` and `link_damping`, a `kappa` below 1, and loads that are not lighter than M2S.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> form.scene().machine.stiffness.round(6).tolist()
    [0.111111, 0.111111]

    Source: the antiphase paper, equations (2)-(8); Filimonikhin et al. 2022, equations (9)-(11), (20), (39).
    """

    natural: Array
    damping: Array
    link_natural: Array
    link_damping: Array
    rho: Array
    eps: Array
    beta: Array
    speed: Array
    mass_scale: Array
    frequency_scale: Array
    radius: Array
    kappa: Array
    count: int = eqx.field(static=True)
    form: Literal["antiphase", "criterion"] = eqx.field(static=True)

    @validated
    def __init__(
        self,
        form: Literal["antiphase", "criterion"],
        *,
        natural: Numbers,
        damping: Numbers,
        link_natural: Numbers = (),
        link_damping: Numbers = (),
        rho: Numbers = (),
        eps: Number,
        beta: Number,
        speed: Number,
        count: int = 1,
        mass_scale: Number = 1.0,
        frequency_scale: Number = 1.0,
        radius: Number = 1.0,
        kappa: Number = 1.0,
    ):
        if form not in ("antiphase", "criterion"):
            raise InputError("form", f"is {quoted(form)}; it must be 'antiphase' or 'criterion'")
        n_i = numbers(natural, "", "natural", None, low=0.0)
        n = 1 if n_i.ndim == 0 else n_i.shape[0]
        if n not in _LINKS:
            raise InputError("natural", f"has {n} values; the machines of these papers have 1, 2 or 3 platforms")
        self.form = form
        self.count = whole(count, "count")
        self.natural = n_i if n_i.ndim else jnp.broadcast_to(n_i, (n,))
        self.damping = numbers(damping, "", "damping", n, low=0.0)
        links = len(_LINKS[n])
        self.link_natural = numbers(link_natural, "", "link_natural", links, low=0.0) if links else jnp.zeros((0,))
        self.link_damping = numbers(link_damping, "", "link_damping", links, low=0.0) if links else jnp.zeros((0,))
        self.rho = numbers(rho, "", "rho", n - 1, low=0.0, open_low=True) if n > 1 else jnp.zeros((0,))
        positive = {"low": 0.0, "open_low": True}
        self.eps = number(eps, "", "eps", **positive)
        self.beta = number(beta, "", "beta", **positive)
        self.speed = number(speed, "", "speed", **positive)
        self.mass_scale = number(mass_scale, "kg", "mass_scale", **positive)
        self.frequency_scale = number(frequency_scale, "rad/s", "frequency_scale", **positive)
        self.radius = number(radius, "m", "radius", **positive)
        self.kappa = number(kappa, "", "kappa", low=1.0)
        share = self.eps * self.kappa * (self.count if form == "antiphase" else 1)
        number(1.0 - share, "", "1 - (mass of all loads)/M2S (from eps, kappa and count)", **positive)

    @property
    def _load_mass(self) -> Array:
        return self.eps * self.kappa * self.mass_scale / (1 if self.form == "antiphase" else self.count)

    @property
    def length_unit(self) -> Array:
        """Length y~ = s~/M2S in m, the unit of v_i of the platform with the exciter; it equals eps kappa R in both forms."""
        return self.eps * self.kappa * self.radius

    @property
    def length_units(self) -> Array:
        """Unit rho_i y~ of each platform's v_i, (p,) m."""
        return self._by_platform(self.rho, 1.0) * self.length_unit

    @property
    def force_unit(self) -> Array:
        """Force M2S w^2 y~ in N, the unit of the foundation force."""
        return self.mass_scale * self.frequency_scale**2 * self.length_unit

    def _by_platform(self, others: Array | np.ndarray, exciter: float) -> Array:
        """Return values in the order of the platforms: `exciter` for the platform with the exciter, between the `others`."""
        others = numpy_if_known(others)  # within `jit` even a slice of a JAX array is traced
        index = min(1, others.shape[0])
        return array_module(others).concatenate([others[:index], np.full(1, exciter, dtype=others.dtype), others[index:]])

    def scene(self) -> Scene:
        """Return the `Scene` in SI units, with the chosen size."""
        return on_device(jax.tree.map(numpy_if_known, self)._scene())

    def _scene(self) -> Scene:
        n = self.natural.shape[0]
        w, m_total, m = self.frequency_scale, self.mass_scale, self._load_mass
        mass = m_total / self._by_platform(self.rho, 1.0)
        loads_mass = self._by_platform(np.zeros(self.rho.shape, self.rho.dtype), 1.0) * self.count * m
        machine = Platforms(
            mass=mass - loads_mass,
            stiffness=self.natural**2 * mass * w**2,
            damping=2.0 * self.damping * mass * w,
            link_stiffness=self.link_natural**2 * m_total * w**2,
            link_damping=2.0 * self.link_damping * m_total * w,
            links=_LINKS[n],
            exciter=min(n, 2),
            kind=_KINDS[n],
        )
        loads = CircularLoads(
            mass=m,
            radius=self.radius,
            drag=self.beta * self.eps * self.kappa * m * w,
            inertia=(self.kappa - 1.0) * m * self.radius**2,
            count=self.count,
            kind="pendulum",
        )
        return Scene(machine, loads, ConstantSpeed(self.speed * w))

    @validated
    def convert_results(
        self, *, omega: Array | None = None, amplitude: Array | complex | None = None, force: Array | None = None
    ) -> dict[str, Array]:
        """Convert results in SI to the dimensionless quantities of the paper of this `form`.

        **Arguments**

        - `omega`, rad/s, any shape
        - `amplitude`, m, real or complex; its last axis has one entry for each platform (a single number for one platform)
        - `force`, N, any shape

        NaN in an array (modes that do not exist) stays NaN.

        **Returns** a dict with the same keys: omega/w, amplitude_i/(rho_i y~), force/(M2S w^2 y~).

        **Raises** `InputError` if the last axis of `amplitude` does not have one entry for each platform.

        >>> import jaxvib as jv
        >>> form = jv.Dimensionless("antiphase", natural=1/3, damping=0.01, eps=1e-3, beta=1.0, speed=3.0, frequency_scale=50.0)
        >>> round(float(form.convert_results(omega=jv.natural_frequencies(form.scene()))["omega"][0]), 4)
        0.3333
        """
        units = {"omega": self.frequency_scale, "amplitude": self.length_units, "force": self.force_unit}
        given = {"omega": omega, "amplitude": amplitude, "force": force}
        platforms = self.length_units.shape[0]
        if amplitude is not None and (jnp.shape(amplitude) or (1,))[-1] != platforms:
            problem = f"has shape {jnp.shape(amplitude)}; its last axis must have {platforms} entries, one for each platform"
            raise InputError("amplitude", problem)
        return {name: value / units[name] for name, value in given.items() if value is not None}
