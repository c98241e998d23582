"""Measures of a vibration as engineers state them: stroke, acceleration, severity, isolation, forces on supports, conveying."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import quantity_text
from jaxvib.equations.coincident import friction_on_light_loads
from jaxvib.equations.linear import JammedModel, LinearModel, jammed_model, linear_model
from jaxvib.errors import InputError, quoted
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import ContactFriction
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import Platforms
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.linalg import magnitude
from jaxvib.numerics.roots import bracketed_root
from jaxvib.results.fields import in_unit, is_single
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.jam import Jam
from jaxvib.steady.points import STANDARD_GRAVITY
from jaxvib.units import Number, number, numbers
from jaxvib.units.known import when_known

ZONE_LIMITS = {
    ("large", "rigid"): (2.3e-3, 4.5e-3, 7.1e-3),
    ("large", "flexible"): (3.5e-3, 7.1e-3, 11.0e-3),
    ("medium", "rigid"): (1.4e-3, 2.8e-3, 4.5e-3),
    ("medium", "flexible"): (2.3e-3, 4.5e-3, 7.1e-3),
}
"""Boundaries A/B, B/C and C/D of the zones of ISO 20816-3, m/s RMS, for machines of 300 kW to 50 MW ("large") and of 15 to
300 kW ("medium"), on rigid and on flexible supports, as practitioners quote them. The text of the standard was not available
for a comparison, and public pages contradict each other."""

_MIN_SLIP = 1e-4
"""Slip n - Omega, relative to n, below which the torque is computed from the dissipation of the carrier. At this slip both
ways to compute the torque have a relative rounding error of 1e-12."""


def acceleration_of(amplitude: Array, speed: Array | float) -> Array:
    """Return the amplitude of the acceleration, in g, of a sine of `amplitude`, m zero to peak, and `speed`, rad/s."""
    return speed**2 * amplitude / STANDARD_GRAVITY


def rms_velocity_of(amplitude: Array, speed: Array | float) -> Array:
    """Return the root mean square of the velocity, m/s, of a sine of `amplitude`, m zero to peak, and `speed`, rad/s."""
    return speed * amplitude / np.sqrt(2.0)


@validated
def vibration_zone(
    velocity: Number,
    *,
    machine: Literal["medium", "large"] = "medium",
    supports: Literal["rigid", "flexible"] = "flexible",
    limits: Sequence[Number] | None = None,
) -> str:
    """Return the zone A, B, C or D of ISO 20816-3 of a vibration.

    A: new machines; B: allowed for long operation; C: allowed for a limited time; D: causes damage. The standard is about
    parts that shall not vibrate, such as motors, frames and foundations. Platforms of a vibration machine are always in zone D.

    **Arguments**

    - `velocity`: root mean square, m/s or text; typical: "1 mm/s" to "10 mm/s"
    - `machine`: "medium" for 15 to 300 kW (the default), or "large" for 300 kW to 50 MW
    - `supports`: "flexible" (the default) or "rigid"
    - `limits` A/B, B/C, C/D, m/s, ascending, from your copy of the standard or from a contract, in place of the built-in ones;
      typical: ["2.3 mm/s", "4.5 mm/s", "7.1 mm/s"]

    The built-in limits are the usual values of practice. They were not compared with the text of the standard: use `limits` if
    a contract depends on them.

    **Returns** a letter. **Raises** `InputError` for a negative velocity, and for limits that do not ascend.

    >>> vibration_zone("3 mm/s"), vibration_zone("3 mm/s", supports="rigid")
    ('B', 'C')
    >>> vibration_zone("3 mm/s", limits=["3.5 mm/s", "7.1 mm/s", "11 mm/s"])
    'A'

    Source: ISO 20816-3 defines the zones.
    """
    size = float(number(velocity, "m/s", "velocity", low=0.0))
    ends = ZONE_LIMITS[machine, supports] if limits is None else np.asarray(numbers(limits, "m/s", "limits", 3, low=0.0))
    if np.any(np.diff(ends) < 0.0):
        raise InputError("limits", f"are {', '.join(f'{each:g}' for each in ends)} m/s; they must ascend")
    return "ABCD"[int(np.searchsorted(ends, size))]


class VibrationMeasures(eqx.Module):
    """Measures of the vibration in a jam, at the fundamental.

    Returned by `vibration_measures`.

    **Attributes** (nd platforms, each with one coordinate and one support)

    - `speed` of the loads, rad/s
    - `stroke` (nd,), m peak to peak; typical: 2 to 20 mm
    - `acceleration` (nd,), amplitude in g; typical: 2 to 6 for screens
    - `velocity` (nd,), m/s root mean square; typical: 50 to 300 mm/s
    - `exciter_force`, N: centrifugal force S Omega^2 of the loads
    - `transmissibility`: foundation force divided by `exciter_force`
    - `static_load` (nd,), N: weight that each support carries
    - `dynamic_load` (nd,), N zero to peak: force of the vibration on each support
    - `torque`, N m, and `power`, W: means at the shaft of the rotor
    - `coordinates`: the names of the coordinates
    """

    speed: Array = eqx.field(metadata=in_unit("rad/s"))
    stroke: Array = eqx.field(metadata=in_unit("m", "coordinate"))
    acceleration: Array = eqx.field(metadata=in_unit("", "coordinate"))
    velocity: Array = eqx.field(metadata=in_unit("m/s", "coordinate"))
    exciter_force: Array = eqx.field(metadata=in_unit("N"))
    transmissibility: Array = eqx.field(metadata=in_unit(""))
    static_load: Array = eqx.field(metadata=in_unit("N", "coordinate"))
    dynamic_load: Array = eqx.field(metadata=in_unit("N", "coordinate"))
    torque: Array = eqx.field(metadata=in_unit("N m"))
    power: Array = eqx.field(metadata=in_unit("W"))
    coordinates: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def isolation_efficiency(self) -> Array:
        """Share of the exciter's force that does not reach the foundation: 1 - transmissibility, negative above 1."""
        return 1.0 - self.transmissibility

    def summary(self) -> str:
        """Return the measures as text."""
        moving = [
            f"{name}: stroke {quantity_text(self.stroke[k], 'm', 4)} peak to peak, {float(self.acceleration[k]):.3g} g, "
            f"{1e3 * float(self.velocity[k]):.4g} mm/s RMS"
            for k, name in enumerate(self.coordinates)
        ]
        supports = [
            f"support {k + 1}: {float(weight):.4g} N static, {float(load):.4g} N dynamic"
            for k, (weight, load) in enumerate(zip(self.static_load, self.dynamic_load, strict=True))
            if weight > 0.0 or load > 0.0
        ]
        ratio = float(self.transmissibility)
        passed = f"of the exciter's {quantity_text(self.exciter_force, 'N', 4)}, {100.0 * ratio:.3g} % reach the foundation"
        isolated = f" (isolation {100.0 * (1.0 - ratio):.3g} %)" if ratio < 1.0 else ""
        shaft = f"shaft: {float(self.torque):.4g} N m, {float(self.power):.4g} W"
        return "\n".join([*moving, *supports, passed + isolated, shaft])

    def __repr__(self) -> str:
        return self.summary() if is_single(self) else super().__repr__()


@validated
def vibration_measures(scene: Scene, jam: Jam) -> VibrationMeasures:
    """Return stroke, acceleration, velocity, isolation, forces on supports, torque and power of a jam of light loads.

        stroke = 2 |Y|,    acceleration = Omega^2 |Y| / g,    velocity = Omega |Y| / sqrt 2,
        dynamic load of support i = |k_i + i Omega b_i| |Y_i|,    static load = k_i s_i with K s = M g

    **Arguments**: `scene` with a machine of platforms; `jam` of it, such as `jam_modes(scene).select(3)`.

    **Returns** `VibrationMeasures`, with derivatives. **Raises** `InputError` for a machine without platforms.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("400 rpm"))
    >>> print(vibration_measures(scene, jv.jam_modes(scene).select(1)).summary())
    y1: stroke 17.11 mm peak to peak, 0.638 g, 163.6 mm/s RMS
    support 1: 500.1 N static, 349.1 N dynamic
    of the exciter's 73.14 N, 477 % reach the foundation
    shaft: 0.2969 N m, 12.43 W
    """
    scene = validate_scene(scene)
    require_platforms(scene, "measures of a jam")
    return _measures(scene, jam.omega, jam.displacement, jam.foundation_force)


@cached
def _measures(scene: Scene, omega: Array, displacement: Array, force: Array) -> VibrationMeasures:
    model, amplitude = jammed_model(scene), magnitude(displacement)
    exciter = model.unbalance * omega**2
    torque = shaft_torque(model, omega, displacement)
    static, dynamic = support_loads(model, omega, displacement)
    return VibrationMeasures(
        speed=omega,
        stroke=2.0 * amplitude,
        acceleration=acceleration_of(amplitude, omega),
        velocity=rms_velocity_of(amplitude, omega),
        exciter_force=exciter,
        transmissibility=force / exciter,
        static_load=static,
        dynamic_load=dynamic,
        torque=torque,
        power=scene.drive.speed * torque,
        coordinates=model.carrier.coordinates,
    )


def require_platforms(scene: Scene, what: str) -> Platforms:
    """Return the machine of a scene. **Raises** `InputError` for other machines: `what` needs platforms."""
    if not isinstance(scene.machine, Platforms):
        raise InputError("machine.kind", f"is {quoted(scene.machine.kind)}; {what} needs a machine of platforms")
    return scene.machine


def shaft_torque(model: JammedModel, omega: Array, displacement: Array) -> Array:
    """Return the mean torque, N m, that light loads in a jam take from the rotor.

    **Arguments**: the load speed `omega`, rad/s, and the complex amplitudes `displacement` (nd,) of the coordinates, m.
    """
    scene, loads = model.scene, model.loads
    n = scene.drive.speed
    torque = loads.drag_sum() * (n - omega)
    if has_term(scene.all_effects, ContactFriction):
        torque = torque + friction_on_light_loads(loads, scene.all_effects, omega, n)
    # With strong drag n - Omega has few correct digits. The torque then follows from the dissipation of the carrier, which has
    # all digits.
    close = n - omega < _MIN_SLIP * n
    taken = model.dissipated(omega * jnp.where(close, displacement, 0.0))
    return jnp.where(close, taken / omega, torque)


def support_loads(model: LinearModel, omega: Array, displacement: Array) -> tuple[Array, Array]:
    """Return the weight on the support of each platform, and the force of the vibration on it, zero to peak, (nd,) N each."""
    machine = require_platforms(model.scene, "the force on a support")
    static = machine.stiffness * jnp.nan_to_num(static_deflections(model.scene))
    spring = magnitude(jax.lax.complex(machine.stiffness, omega * machine.damping))
    return static, spring * magnitude(displacement)


def static_deflections(scene: Scene) -> Array:
    """Return the static deflection (nd,), m, of each platform under the weight of platforms and loads: K y = M g.

    It is NaN for a platform that no support carries, directly or by links.
    """
    machine = require_platforms(scene, "the deflection")
    model, carried = linear_model(scene), _has_support(machine)
    # The stiffness matrix of platforms without supports is singular up to rounding. They are attached to the ground here, and
    # their deflection is replaced by NaN.
    held = jnp.where(carried, 0.0, 1.0)[:, None] * np.eye(len(carried))
    sag = jnp.linalg.solve(model.carrier.stiffness + held, STANDARD_GRAVITY * jnp.diagonal(model.mass))
    return jnp.where(carried, jnp.abs(sag), jnp.nan)


def _has_support(machine: Platforms) -> Array:
    """Return True (n,) for each platform that has a support or is connected by links to a platform with one."""
    n = machine.mass.shape[0]
    joined = jnp.eye(n, dtype=bool)
    for (i, j), stiffness in zip(machine.links, machine.link_stiffness, strict=True):
        joined = joined.at[[i - 1, j - 1], [j - 1, i - 1]].max(stiffness > 0.0)
    for _ in range(max(n - 1, 1).bit_length()):  # each product doubles the length of the included paths
        joined = jnp.any(joined[:, :, None] & joined[None], axis=1)
    return jnp.any(joined & (machine.stiffness > 0.0)[None], axis=1)


@validated
def conveying_speed(amplitude: Array | complex, speed: Number, *, slope: Number = 0.0) -> Array:
    """Return an estimate of the mean speed of material along a deck that throws it, m/s, positive up the deck.

        G (cos(p + f) - cos p) = -G sin(p) f - f^2/2,    cos p = 1/G, p < 0;
        v = w/(2 pi) [ x'(p) f/w - (x(p + f) - x(p)) - g sin(slope) (f/w)^2 / 2 ]

    A particle leaves the deck when the deck's acceleration reaches that of gravity, at the phase p, flies for the phase f,
    lands without rebound and moves with the deck until the next throw. x is the motion along the deck, G the throw number.
    For motion along a straight line at the angle b to a level deck, v = g f^2 / (4 pi w tan b), the formula of handbooks. Real
    material is slower; typical: 0.7 to 0.9 of v, less in deep or sticky layers.

    **Arguments**

    - `amplitude` U (2,), m, complex: amplitudes horizontal (along x) and up, u = Re(U e^{i w t})
    - `speed` w, rad/s or text; typical: 75 to 160
    - `slope` of the deck, rad or text, measured anticlockwise from x; typical: "-15 deg" to 0 (the default)

    **Returns** the speed, m/s; typical: 0.1 to 0.5. It is 0 for throw numbers of at most 1, at which material only slides, and
    NaN above 3.297, at which a flight is longer than a period.

    >>> import jax.numpy as jnp
    >>> round(float(conveying_speed(0.005 * jnp.array([1.0, 0.6]), 100.0)), 4)
    0.4732

    Source: derived here from the flight of a particle. In handbooks it is v = g n^2 / (2 F tan b), with n the time of flight
    in periods and F the frequency, Hz. Sloot and Kruyt (Powder Technology 87, 1996) add sliding, and report larger deviations
    from experiments for conveyors that throw than for those that slide.
    """
    if jnp.shape(amplitude) != (2,):
        raise InputError("amplitude", f"has the shape {jnp.shape(amplitude)}; give two amplitudes, horizontal and up")
    when_known(_require_finite, amplitude)
    w, tilt = number(speed, "rad/s", "speed", low=0.0, open_low=True), number(slope, "rad", "slope")
    return _conveying_speed(jnp.asarray(amplitude, complex), w, tilt)


def _require_finite(amplitude: np.ndarray) -> None:
    if not np.all(np.isfinite(amplitude)):
        raise InputError("amplitude", f"is {quoted(amplitude)}; finite numbers are needed")


@cached
def _conveying_speed(amplitude: Array, w: Array, slope: Array) -> Array:
    along = jnp.cos(slope) * amplitude[0] + jnp.sin(slope) * amplitude[1]
    normal = -jnp.sin(slope) * amplitude[0] + jnp.cos(slope) * amplitude[1]
    size = magnitude(normal)
    throw = w**2 * size / (STANDARD_GRAVITY * jnp.cos(slope))
    flies = throw > 1.0
    g = jnp.where(flies, throw, 2.0)
    begin = -jnp.arccos(1.0 / g)

    def height(phase: Array) -> Array:
        """Height of the particle above the deck, divided by the amplitude, times the throw number, divided by phase^2."""
        return (-g * jnp.sin(begin) * phase - phase**2 / 2.0 - g * (jnp.cos(begin + phase) - jnp.cos(begin))) / phase**2

    full = jnp.asarray(2.0 * np.pi, g.dtype)
    lands = height(full) <= 0.0
    flight = bracketed_root(height, jnp.asarray(1e-3, g.dtype), jnp.where(lands, full, 4.0 * full))
    # The phase of `normal` is zero at its highest point.
    turned = along * jnp.where(flies, jnp.conj(normal), 1.0) / jnp.where(flies, size, 1.0)

    def path(phase: Array) -> Array:
        return (turned * jnp.exp(1j * phase)).real

    rate = w * (1j * turned * jnp.exp(1j * begin)).real
    time = flight / w
    step = rate * time - (path(begin + flight) - path(begin)) - STANDARD_GRAVITY * jnp.sin(slope) * time**2 / 2.0
    speed = w / (2.0 * np.pi) * step
    return jnp.where(flies, jnp.where(lands, speed, jnp.nan), 0.0)
