"""Measures of a vibration as engineers state them: stroke, acceleration, severity, isolation, forces on supports, conveying."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import GRAVITIES, quantity_text, shown_unit
from jaxvib.equations.jammed_bodies import friction_on_light_loads
from jaxvib.equations.linear import JammedModel, LinearModel, jammed_model, linear_model, peak_force, rotating_direction
from jaxvib.equations.torque_balance import resultant_of
from jaxvib.errors import InputError, quoted
from jaxvib.machine.carrier import BodyPoint, Place, on_body, read_place
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import ContactFriction, GravityField
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.plane_body import PlaneBody, PlaneNetwork
from jaxvib.machine.structures.platforms import Platforms
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.linalg import magnitude
from jaxvib.numerics.roots import bracketed_root
from jaxvib.results.fields import in_unit, names_along
from jaxvib.results.readable import Readable
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.jam import Jam
from jaxvib.steady.jams.phases import PhaseJam
from jaxvib.steady.orbits.describe import Orbit
from jaxvib.steady.points import at_positive_speed, path_at, read_slope, require_amplitudes, rows_in_plane
from jaxvib.steady.vibration import (
    Samples,
    Vibration,
    half_range,
    peak_acceleration,
    peak_forces,
    periodic_samples,
    rms_velocity,
)
from jaxvib.steady.zone import vibration_zone
from jaxvib.units import Number, number
from jaxvib.units.known import when_known
from jaxvib.units.reading import STANDARD_GRAVITY

_MIN_SLIP = 1e-4
"""Slip n - Omega, relative to n, below which the torque is computed from the dissipation of the carrier. At this slip the
difference n - Omega has a relative rounding error of about 1e-12, at smaller slips a larger one."""

_NEGLIGIBLE_FRACTION = 1e-9
"""Fraction of the largest stroke or force below which a value is a rounding error and is not shown."""

_MAX_SHOWN_RATIO = 1e4
"""Largest ratio of forces that is shown. At a larger ratio the loads balance one another, and only a decaying motion is
left."""

_MAX_ACCELERATION, _MAX_THROW_NUMBER = 8.0, 8.0
"""Acceleration, g, and throw number above which `VibrationMeasures.notes` warns. Usual are 3 to 6 g, up to 7 g for fine sieving
and dewatering, and throw numbers of 3 to 5."""

_WEAK_THROW_NUMBER = 1.5
"""Lowest throw number that is usual for feeders. Below it, texts add that material hardly leaves the deck."""

_MAX_RATIO_IN_PERCENT = 10.0
"""Transmissibility above which texts state it as a multiple, not in percent."""


class VibrationMeasures(Readable):
    """Measures of a vibration as data sheets state them.

    Returned by `vibration_measures`.

    **Attributes** (nt coordinates that are displacements, ns supports)

    - `speed` of the loads or unbalances, rad/s
    - `stroke` (nt,), m peak to peak; typical: 2 to 20 mm
    - `acceleration` (nt,), largest magnitude in g; typical: 2 to 6 for screens
    - `velocity` (nt,), m/s root mean square; typical: 50 to 300 mm/s
    - `exciter_force`, N zero to peak: resultant of the centrifugal forces; for forces in two directions the root of the sum of
      the squares of both peaks, that is sqrt(2) times a force that rotates
    - `transmissibility`: foundation force divided by `exciter_force`; inf if the centrifugal forces cancel, NaN if one of the
      two forces is unknown
    - `foundation_load` (directions,), N zero to peak: force on the foundation in each direction, across and up for a body in a
      plane or a rotor
    - `static_deflection` (nt,), m: downward displacement of each coordinate under the weight of machine and loads (for x:
      displacement to the left), 0 for a platform that no support carries; typical: 5 to 30 mm for screens
    - `static_load` (ns,), N: weight that each support carries, negative if the support pulls the foundation up
    - `dynamic_load` (ns,) and `side_load` (ns,), N zero to peak: vertical and horizontal force of the vibration on a support
    - `torque` (exciter,), N m, and `power` (exciter,), W: means at the shaft of each drive, see `Vibration`
    - `point` (2,), m, of a body in a plane, and the motion of this point: `point_stroke`, m peak to peak, the largest extent of
      its path; `point_acceleration`, g, `throw_angle`, rad, and `throw_number`, see `Ellipse`; `conveying_speed`, m/s, the
      estimate of `jaxvib.conveying_speed`. If several points were requested, these have a leading axis. For other machines they
      are None
    - `throughput`, kg/s, at the `point`; None if no `layer` was given
    - `coordinates` (nt,): names of the coordinates, and `directions` of the force on the foundation

    For a run in its window, and for an exact jam, these are those of the whole motion with all its frequencies, except for
    `conveying_speed`, which is that of the harmonic at `speed`.

    `static_deflection` and `static_load` are NaN if the supports cannot carry the weight, if the directions of the coordinates
    are unknown, and for a rotor without the effect `Gravity`, whose axis may be vertical. `dynamic_load`, `side_load`, and
    (except for runs) `foundation_load` in two directions are NaN for a scene with supports that are effects (`CubicSupport`,
    `Stop`, `FrictionSupport`), and for matrices without a foundation.
    """

    speed: Array = eqx.field(metadata=in_unit("rad/s"))
    stroke: Array = eqx.field(metadata=in_unit("m", "translation"))
    acceleration: Array = eqx.field(metadata=in_unit(GRAVITIES, "translation"))
    velocity: Array = eqx.field(metadata=in_unit("m/s", "translation"))
    exciter_force: Array = eqx.field(metadata=in_unit("N"))
    transmissibility: Array = eqx.field(metadata=in_unit(""))
    foundation_load: Array = eqx.field(metadata=in_unit("N", "direction"))
    static_deflection: Array = eqx.field(metadata=in_unit("m", "translation"))
    static_load: Array = eqx.field(metadata=in_unit("N", "support"))
    dynamic_load: Array = eqx.field(metadata=in_unit("N", "support"))
    side_load: Array = eqx.field(metadata=in_unit("N", "support"))
    torque: Array = eqx.field(metadata=in_unit("N m", "exciter"))
    power: Array = eqx.field(metadata=in_unit("W", "exciter"))
    point: Array | None = eqx.field(metadata=in_unit("m", "direction"), default=None)
    point_stroke: Array | None = eqx.field(metadata=in_unit("m"), default=None)
    point_acceleration: Array | None = eqx.field(metadata=in_unit(GRAVITIES), default=None)
    throw_angle: Array | None = eqx.field(metadata=in_unit("rad"), default=None)
    throw_number: Array | None = eqx.field(metadata=in_unit(""), default=None)
    conveying_speed: Array | None = eqx.field(metadata=in_unit("m/s"), default=None)
    throughput: Array | None = eqx.field(metadata=in_unit("kg/s"), default=None)
    coordinates: tuple[str, ...] = eqx.field(static=True, default=(), metadata=names_along("coordinate"))
    directions: tuple[str, ...] = eqx.field(static=True, default=(), metadata=names_along("direction"))

    @property
    def isolation_efficiency(self) -> Array:
        """Share of the exciter's force that does not reach the foundation, 1 - transmissibility; it may be negative."""
        return 1.0 - self.transmissibility

    @property
    def _is_rotor(self) -> bool:
        """True for machines that move in two directions and have no deck: rotors."""
        return self.point is None and len(self.directions) > 1

    def notes(self) -> list[str]:
        """Return warnings of an acceleration above 8 g and of a throw number above 8, which screens do not reach; none for a
        rotor."""
        if self._is_rotor:
            return []
        accelerations, throws = (self.acceleration, self.point_acceleration), (self.throw_number,)
        fastest, highest = (
            max((float(x) for value in values if value is not None for x in np.ravel(value) if np.isfinite(x)), default=0.0)
            for values in (accelerations, throws)
        )
        notes = []
        if fastest > _MAX_ACCELERATION:
            notes.append(f"the acceleration is {fastest:.3g} g; screens usually have 3 to 6 g, up to 7 g for fine sieving")
        if highest > _MAX_THROW_NUMBER:
            notes.append(f"the throw number is {highest:.3g}; screens usually have 3 to 5")
        return notes

    def document(self) -> dict[str, object]:
        """Return all measures by name."""
        named: dict[str, object] = {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}
        present = {name: value for name, value in named.items() if value is not None}
        return present | {"isolation_efficiency": self.isolation_efficiency}

    def summary(self) -> str:
        """Return the measures as text, one line for each coordinate, each support, the isolation, each shaft and each point.

        The zone of ISO 20816-3 is shown for rotors only: the standard does not apply to platforms and decks that must vibrate.
        """
        of = "" if self.point is None else " of the centre of mass"
        velocity_unit, factor = shown_unit("m/s", 0.1)  # mm/s for all values, as in ISO 20816
        lines = [
            f"{name}{of}: stroke {quantity_text(self.stroke[k], 'm', 4)} peak to peak, {float(self.acceleration[k]):.3g} g, "
            f"{factor * float(self.velocity[k]):.4g} {velocity_unit} RMS"
            f"{_zone_text(float(self.velocity[k])) if self._is_rotor else ''}"
            for k, name in enumerate(self.coordinates)
            if not float(self.stroke[k]) < _NEGLIGIBLE_FRACTION * float(np.max(self.stroke))
        ]
        sag, most = np.asarray(self.static_deflection), np.nanmax(np.abs(self.static_deflection), initial=0.0)
        sagging = [
            (name, each) for name, each in zip(self.coordinates, sag, strict=True) if abs(each) > _NEGLIGIBLE_FRACTION * most
        ]
        for way, across in (("down", False), ("to the left", True)):
            named = [f"{name} {quantity_text(each, 'm', 4)}" for name, each in sagging if (name[0] == "x") == across]
            lines += [f"static deflection{of}, {way}: {', '.join(named)}"] if named else []
        for k, each in enumerate(zip(self.static_load, self.dynamic_load, self.side_load, strict=True)):
            words = ("static", "dynamic in z", "dynamic in y") if self._is_rotor else ("static", "dynamic", "to the sides")
            named = zip(each, words, strict=True)
            largest = np.max(np.abs(each), initial=0.0, where=~np.isnan(each))
            parts = [
                f"{quantity_text(load, 'N', 4)} {word}" for load, word in named if abs(load) > _NEGLIGIBLE_FRACTION * largest
            ]
            lines += [f"support {k + 1}: {', '.join(parts)}"] if parts else []
        if len(self.directions) > 1 and not np.any(np.isnan(self.foundation_load)):
            loads = zip(self.foundation_load, self.directions, strict=True)
            along = "in " if self._is_rotor else ""
            forces = ", ".join(f"{quantity_text(force, 'N', 4)} {along}{name}" for force, name in loads)
            lines.append(f"foundation: {forces} (dynamic)")
        lines += self._transmissibility_text()
        shafts = [
            f"mean torque {float(t):.4g} N m, mean power {float(p):.4g} W" for t, p in zip(self.torque, self.power, strict=True)
        ]
        number = [""] if len(shafts) == 1 else [f" of exciter {k + 1}" for k in range(len(shafts))]
        lines += [f"shaft{k}: {text}" for k, text in zip(number, shafts, strict=True) if "nan" not in text]
        return "\n".join([*lines, *self._throw_text()])

    def _transmissibility_text(self) -> list[str]:
        ratio, force = float(self.transmissibility), float(self.exciter_force)
        if force == 0.0:
            return ["the forces of the exciters cancel: there is no transmissibility"]
        if not ratio < _MAX_SHOWN_RATIO:
            return []
        if len(self.torque) > 1:
            name = f"exciters' {quantity_text(force, 'N', 4)}"
        elif len(self.directions) > 1:  # the peak in each direction is that of the rotating force
            name = f"exciter's rotating {quantity_text(force / np.sqrt(2.0), 'N', 4)}"
        else:
            name = f"exciter's {quantity_text(force, 'N', 4)}"
        if ratio > _MAX_RATIO_IN_PERCENT:
            return [f"the foundation receives {ratio:.3g} times the {name}"]
        isolation = f" (isolation {100.0 * (1.0 - ratio):.3g} %)" if ratio < 1.0 else ""
        return [f"of the {name}, {100.0 * ratio:.3g} % reach the foundation{isolation}"]

    def _throw_text(self) -> list[str]:
        names = ("point_stroke", "point_acceleration", "throw_angle", "throw_number", "conveying_speed")
        values = [getattr(self, name) for name in names]
        if self.point is None or any(each is None for each in values):
            return []
        lines = []
        values.append(np.full_like(self.conveying_speed, np.nan) if self.throughput is None else self.throughput)
        for place, *each in zip(np.atleast_2d(self.point), *map(np.atleast_1d, values), strict=True):
            stroke, acceleration, angle, throw, speed, flow = map(float, each)
            conveys = "flights longer than a turn" if np.isnan(speed) else f"conveys {speed:.3f} m/s"
            conveys += "" if np.isnan(flow) else f", {3.6 * flow:.4g} t/h"
            lines += [
                f"point ({', '.join(f'{float(x):.4g}' for x in place)}) m: stroke {quantity_text(stroke, 'm', 4)} peak to peak "
                f"at {quantity_text(angle, 'rad', 4)}, {acceleration:.3g} g,",
                f"  throw number {throw:.3g}{_weak_throw_text(throw)}, {conveys}",
            ]
        return lines


def _weak_throw_text(throw: float) -> str:
    if throw < 1.0:
        return " (below 1: material does not leave the deck)"
    return " (material hardly leaves the deck; feeders have 1.5 to 3.3)" if throw < _WEAK_THROW_NUMBER else ""


def _zone_text(velocity: float) -> str:
    return f" (zone {vibration_zone(velocity)})" if np.isfinite(velocity) else ""


@validated
def vibration_measures(
    scene: Scene,
    motion: Jam | PhaseJam | Orbit | Vibration,
    *,
    at: int | Number | Sequence[Number] | Sequence[Sequence[Number]] | None = None,
    body: int = 0,
    slope: Number = 0.0,
    layer: Sequence[Number] | None = None,
) -> VibrationMeasures:
    """Return stroke, acceleration, velocity, isolation, forces on supports, torque, power and throw of a vibration.

        stroke = 2 |Y|,    acceleration = Omega^2 |Y| / g,    velocity = Omega |Y| / sqrt 2,
        dynamic load of a support = |k u + i Omega c u|,    static load = k s with K s = M g

    Omega is the speed, and Y the complex amplitude of a coordinate. k and c are the stiffness and the damping of a support, u
    and s its displacements by the vibration and by the weight. M and K are the mass and stiffness matrices of the machine.
    For a run and an exact jam, strokes, accelerations, velocities and forces are those of the whole motion, see
    `VibrationMeasures`.

    **Arguments**

    - `scene`
    - `motion` of the scene: a jam of light loads such as `jam_modes(scene).select(3)` or `phase_jams(scene).select(0)`, an
      exact jam such as `jam_orbit(scene, mode=3)`, or the `vibration()` of a run, of an envelope, of a synchronous regime or
      of a response
    - `at`: point of a deck, (x, y) of the body with the number `body`, m, or a list of points; default: the body's centre of
      mass; typical: both ends of the deck
    - `slope` of the deck, rad or text from x anticlockwise; typical: "-15 deg" to 0 (the default)
    - `layer`: width, m, height, m, and bulk density, kg/m^3, of the material on the deck, for the throughput; typical:
      ("1.5 m", "55 mm", "1600 kg/m^3")

    **Returns** `VibrationMeasures`, with derivatives. **Raises** `InputError` for a point that the machine does not have, and
    for `at`, `slope` or `layer` with a machine that is not a body in a plane.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("400 rpm"))
    >>> print(vibration_measures(scene, jv.jam_modes(scene).select(1)).summary())
    y1: stroke 17.11 mm peak to peak, 0.638 g, 163.6 mm/s RMS
    static deflection, down: y1 12.5 mm
    support 1: 500.1 N static, 349.1 N dynamic
    of the exciter's 73.14 N, 477 % reach the foundation
    shaft: mean torque 0.2969 N m, mean power 12.43 W
    """
    scene = validate_scene(scene)
    along, kind = read_slope(slope), scene.machine.kind
    tilted = when_known(lambda tilt: tilt != 0.0, along)
    for name, given, is_given in (("at", at, at is not None), ("slope", slope, tilted), ("layer", layer, layer is not None)):
        if is_given and scene.machine.places != "plane":
            problem = f"is {quoted(given)}; it is for bodies in a plane, not for a machine of kind {quoted(kind)}; leave it out"
            raise InputError(name, problem)
    deck = scene.machine.require_body(body)
    has_list = isinstance(at, (list, tuple)) and len(at) > 0 and all(isinstance(each, (list, tuple)) for each in at)
    points = cast("Sequence[Sequence[Number]]", at) if has_list else [cast("Sequence[Number] | None", at)]
    places = tuple(on_body(read_place(point), deck) for point in points)
    if isinstance(motion, Jam):
        motion = _vibration_of(scene, motion.omega, motion.displacement, motion.foundation_force)
    elif isinstance(motion, PhaseJam):
        power = -motion.rotor_speed * jnp.sum(motion.torque)
        vibration = (motion.displacement, motion.amplitude, motion.foundation_force)
        motion = _vibration_at_phases(scene, motion.rotor_speed, motion.omega, motion.phase, *vibration, power)
    elif isinstance(motion, Orbit):
        first = motion.displacement_harmonics[:, motion.orders.index(1)]
        vibration = (first, motion.amplitude, motion.foundation_force)
        phase = motion.offsets + motion.deviation_harmonics[:, 0].real  # of loads that differ
        samples = periodic_samples(motion.orders, motion.omega, motion.displacement_harmonics, motion.force_harmonics)
        vibration_at_phases = _vibration_at_phases(scene, motion.rotor_speed, motion.omega, phase, *vibration, motion.power)
        motion = vibration_at_phases._replace(samples=samples)
    measures = _measures(scene, motion, places if has_list else places[0], along)
    if layer is None or measures.conveying_speed is None:
        return measures
    return dataclasses.replace(measures, throughput=_mass_per_length(layer) * jnp.abs(measures.conveying_speed))


def _mass_per_length(layer: Sequence[Number]) -> Array:
    """Return the product of width, height and bulk density of a layer, kg/m."""
    if not isinstance(layer, (list, tuple)) or len(layer) != 3:
        raise InputError("layer", f"is {quoted(layer)}; give width, height and density, as ('1.5 m', '55 mm', '1600 kg/m^3')")
    kinds = zip(("width", "height", "density"), layer, ("m", "m", "kg/m^3"), strict=True)
    width, height, density = (number(x, unit, f"layer ({name})", low=0.0) for name, x, unit in kinds)
    return width * height * density


@cached
def _vibration_of(scene: Scene, omega: Array, displacement: Array, force: Array) -> Vibration:
    """Return the vibration in a jam of light loads."""
    model = jammed_model(scene)
    torque = shaft_torque(model, omega, displacement)[None]
    size = magnitude(displacement)
    return Vibration(omega, displacement, size, force, exciter_force(model, omega), torque, scene.drive.speed * torque)


@cached
def _vibration_at_phases(
    scene: Scene, speed: Array, omega: Array, phase: Array, displacement: Array, amplitude: Array, force: Array, power: Array
) -> Vibration:
    """Return the vibration in a jam whose loads have the phases (count,), rad, and take a mean `power`, W, from a rotor of this
    `speed`, rad/s."""
    exciting = peak_force(omega**2 * resultant_of(linear_model(scene), jnp.exp(1j * phase)))
    torque = (power / speed)[None]
    return Vibration(omega, displacement, amplitude, force, exciting, torque, power[None])


def exciter_force(model: JammedModel, omega: Array) -> Array:
    """Return the centrifugal force of coincident loads, N zero to peak, see `peak_force`."""
    return peak_force(model.unbalance * omega**2 * rotating_direction(model.mount))


@cached
def _measures(scene: Scene, motion: Vibration, place: Place | tuple[Place, ...], slope: Array) -> VibrationMeasures:
    model = linear_model(scene)
    carrier = model.carrier
    lengths = np.flatnonzero(np.asarray(carrier.units) == "m")
    amplitude, (displacement, w) = motion.amplitude[lengths], at_positive_speed(motion.displacement, motion.speed)
    has_weight = scene.machine.places not in ("shaft", "point") or has_term(scene.effects, GravityField)
    sag = weight_deflection(model) if has_weight else None
    static, dynamic, side = support_loads(model, w, displacement, sag, motion.samples)
    forced = motion.exciter_force != 0.0  # True for NaN
    force = model.known_force(motion.foundation_force)
    ratio = jnp.where(forced, force / jnp.where(forced, motion.exciter_force, 1.0), jnp.inf)
    measures = VibrationMeasures(
        speed=motion.speed,
        stroke=2.0 * amplitude,
        acceleration=peak_acceleration(motion)[lengths],
        velocity=rms_velocity(motion)[lengths],
        exciter_force=motion.exciter_force,
        transmissibility=ratio,
        foundation_load=_foundation_load(model, motion, force),
        static_deflection=jnp.full_like(amplitude, jnp.nan) if sag is None else sag[lengths],
        static_load=static,
        dynamic_load=dynamic,
        side_load=side,
        torque=motion.torque,
        power=motion.power,
        coordinates=tuple(carrier.coordinates[k] for k in lengths),
        directions=carrier.foundation_directions,
    )
    if scene.machine.places != "plane":
        return measures
    of_points = [_measures_at(scene, motion, point, slope) for point in (place if isinstance(place, tuple) else (place,))]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *of_points) if isinstance(place, tuple) else of_points[0]
    return dataclasses.replace(measures, **stacked)


def _foundation_load(model: LinearModel, motion: Vibration, force: Array) -> Array:
    """Return the foundation force of each direction, N zero to peak; `force`: that of all directions."""
    carrier, samples = model.carrier, motion.samples
    has_harmonic = samples is None and not model.supports and model.scene.machine.has_foundation
    if has_harmonic:
        rows = carrier.foundation_stiffness, carrier.foundation_damping
        return peak_forces(*rows, *at_positive_speed(motion.displacement, motion.speed), None)
    if len(carrier.foundation_directions) == 1:
        return force[None]
    if samples is None or not model.scene.machine.has_foundation:
        return jnp.full(len(carrier.foundation_directions), jnp.nan, force.dtype)
    return half_range(samples.foundation_force)


def _measures_at(scene: Scene, motion: Vibration, place: Place, slope: Array) -> dict[str, Array]:
    """Return the measures of a point of a body in a plane by the names of their fields."""
    displacement, w = at_positive_speed(motion.displacement, motion.speed)
    rows = rows_in_plane(scene.machine, place)
    path = path_at(rows, displacement, w, slope, motion.samples, jnp.zeros_like(w))
    at = place.at if isinstance(place, BodyPoint) else place
    return {
        "point": jnp.zeros(2, motion.amplitude.dtype) if at is None else jnp.asarray(at, motion.amplitude.dtype),
        "point_stroke": path.stroke,
        "point_acceleration": path.acceleration,
        "throw_angle": path.direction,
        "throw_number": path.throw_number,
        "conveying_speed": conveying_speed_at(rows @ displacement, w, slope),
    }


def require_platforms(scene: Scene, what: str) -> Platforms:
    """Return the machine of a scene. **Raises** `InputError` for other machines: `what` needs platforms."""
    if not isinstance(scene.machine, Platforms):
        raise InputError("machine.kind", f"is {quoted(scene.machine.kind)}; {what} needs a machine of platforms")
    return scene.machine


def shaft_torque(model: JammedModel, omega: Array, displacement: Array) -> Array:
    """Return the mean torque, N m, with which light loads in a jam brake the rotor, from load speed and amplitudes."""
    scene, loads = model.scene, model.loads
    n = scene.drive.speed
    torque = loads.drag_sum() * (n - omega)
    if has_term(scene.all_effects, ContactFriction):
        torque = torque + jnp.sum(friction_on_light_loads(loads, scene.all_effects, omega, n))
    # With strong drag n - Omega has few correct digits. The torque then follows from the dissipation of the carrier, which has
    # all digits.
    is_close = n - omega < _MIN_SLIP * n
    power = model.dissipated(omega * jnp.where(is_close, displacement, 0.0))
    return jnp.where(is_close, power / omega, torque)


def support_loads(
    model: LinearModel, omega: Array, displacement: Array, sag: Array | None, samples: Samples | None = None
) -> tuple[Array, Array, Array]:
    """Return the static, the vertical dynamic and the horizontal dynamic force on each support, (ns,) N each.

    Dynamic forces are zero to peak, NaN for a scene with supports that are effects. The static force is NaN if `sag`, the
    `weight_deflection`, is NaN or None.
    """
    machine = model.scene.machine
    stiffness, damping = machine.support_rows()
    forces = peak_forces(stiffness, damping, displacement, omega, samples)
    if model.supports or not machine.has_foundation:
        forces = jnp.full_like(forces, jnp.nan)
    static = jnp.full(forces.shape[0], jnp.nan) if sag is None else stiffness[:, -1] @ sag
    if isinstance(machine, PlaneNetwork):  # the order of the ends of a support between two bodies has no meaning
        between_bodies = np.array([each.to is not None for each in machine.supports])
        static = jnp.where(between_bodies, jnp.abs(static), static)
    side = jnp.zeros_like(forces[:, 0]) if forces.shape[1] == 1 else forces[:, 0]
    return static, forces[:, -1], side


def weight_deflection(model: LinearModel) -> Array | None:
    """Return the static displacements (nd,) of the coordinates under the weight of the machine and its loads, with the
    opposite sign, m (rad for tilts): positive if the coordinate moves downward.

    It is 0 for a platform that no support carries, NaN for other machines whose supports cannot carry the weight, and None if
    the directions of the coordinates are unknown. A motion that no spring resists is left out if the weight does not cause it.
    """
    machine = model.scene.machine
    up = machine.upward()
    if up is None:
        return None
    stiffness, weight = model.carrier.stiffness, STANDARD_GRAVITY * (model.mass @ jnp.asarray(up, model.mass.dtype))
    if not isinstance(machine, Platforms):
        frequencies, shapes = jax.lax.stop_gradient(model).modes()
        free = jnp.where(frequencies == 0.0, shapes, 0.0)
        directions = model.mass @ free  # springs along them keep the free motions at 0
        sag = jnp.linalg.solve(stiffness + jnp.max(frequencies) ** 2 * directions @ directions.T, weight)
        falls = jnp.abs(free.T @ weight) > jnp.sqrt(jnp.finfo(weight.dtype).eps) * jnp.max(jnp.abs(shapes.T @ weight))
        return jnp.where(jnp.any(falls), jnp.nan, sag)
    # The stiffness matrix of platforms without supports is singular up to rounding.
    # Such platforms get a spring to the ground here.
    carried = has_support(machine)
    added = jnp.where(carried, 0.0, 1.0)[:, None] * np.eye(len(up))
    return jnp.where(carried, jnp.linalg.solve(stiffness + added, weight), 0.0)


def static_deflections(scene: Scene) -> Array:
    """Return the static deflection, m, of each platform, or of the centre of mass of each body in a plane, under the weight of
    the machine and its loads: K y = M g. It is positive if a body moves downward.

    It is NaN for a platform that no support carries, directly or by links, and for bodies whose supports cannot carry them.
    """
    machine = scene.machine
    if not isinstance(machine, Platforms | PlaneBody | PlaneNetwork):
        raise InputError("machine.kind", f"is {quoted(machine.kind)}; the deflection needs platforms or bodies in a plane")
    sag = weight_deflection(linear_model(scene))
    assert sag is not None
    if not isinstance(machine, Platforms):
        return sag[np.flatnonzero(machine.upward())]
    return jnp.where(has_support(machine), jnp.abs(sag), jnp.nan)


def has_support(machine: Platforms) -> Array:
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
    """Return an estimate of the mean speed of material along a deck that throws it, m/s, positive in the direction of x.

    A deck with a negative slope falls in this direction: its material moves down at a positive speed.

        G (cos(p + f) - cos p) = -G sin(p) f - f^2/2,    cos p = 1/G, p < 0;
        v = w/(2 pi) [ x'(p) f/w - (x(p + f) - x(p)) - g sin(slope) (f/w)^2 / 2 ]

    A particle leaves the deck at the phase p, when the deck's acceleration reaches that of gravity. It flies for the phase f,
    lands without rebound and moves with the deck until the next throw. x is the motion along the deck, G the throw number.
    For motion along a straight line at the angle b to a level deck, v = g f^2 / (4 pi w tan b), the formula of handbooks. Real
    material is slower; typical: 0.7 to 0.9 of v, less in deep or sticky layers.

    **Arguments**

    - `amplitude` U (2,), m, complex: amplitudes horizontal (along x) and up, u = Re(U e^{i w t})
    - `speed` w, rad/s or text; typical: 75 to 160
    - `slope` of the deck, rad or text, measured anticlockwise from x; typical: "-15 deg" to 0 (the default)

    **Returns** the speed, m/s; typical: 0.1 to 0.5. It is 0 for throw numbers of at most 1, at which material does not
    leave the deck, and NaN above 3.297, because a flight is then longer than a period.

    >>> import jax.numpy as jnp
    >>> round(float(conveying_speed(0.005 * jnp.array([1.0, 0.6]), 100.0)), 4)
    0.4732

    Source: derived here from the flight of a particle. In handbooks it is v = g n^2 / (2 F tan b), with n the time of flight
    in periods and F the frequency, Hz. Sloot and Kruyt (Powder Technology 87, 1996) add sliding, and report larger deviations
    from experiments for conveyors that throw than for those that slide.
    """
    require_amplitudes(amplitude)
    w, tilt = number(speed, "rad/s", "speed", low=0.0, open_low=True), read_slope(slope)
    return _conveying_speed(jnp.asarray(amplitude, complex), w, tilt)


def conveying_speed_at(amplitude: Array, w: Array, slope: Array) -> Array:
    """Return `conveying_speed` for validated values."""
    along = jnp.cos(slope) * amplitude[0] + jnp.sin(slope) * amplitude[1]
    normal = -jnp.sin(slope) * amplitude[0] + jnp.cos(slope) * amplitude[1]
    size = magnitude(normal)
    throw = w**2 * size / (STANDARD_GRAVITY * jnp.cos(slope))
    flies = throw > 1.0
    g = jnp.where(flies, throw, 2.0)
    begin = -jnp.arccos(1.0 / g)

    def height(phase: Array) -> Array:
        """Return the height of the particle above the deck, relative to the amplitude, times G / phase^2."""
        return (-g * jnp.sin(begin) * phase - phase**2 / 2.0 - g * (jnp.cos(begin + phase) - jnp.cos(begin))) / phase**2

    full = jnp.asarray(2.0 * np.pi, g.dtype)
    lands = height(full) <= 0.0
    flight = bracketed_root(height, jnp.asarray(1e-3, g.dtype), jnp.where(lands, full, 4.0 * full))
    # The phase of `normal` is zero at its highest point.
    relative_to_normal = along * jnp.where(flies, jnp.conj(normal), 1.0) / jnp.where(flies, size, 1.0)

    def path(phase: Array) -> Array:
        return (relative_to_normal * jnp.exp(1j * phase)).real

    rate = w * (1j * relative_to_normal * jnp.exp(1j * begin)).real
    time = flight / w
    step = rate * time - (path(begin + flight) - path(begin)) - STANDARD_GRAVITY * jnp.sin(slope) * time**2 / 2.0
    speed = w / (2.0 * np.pi) * step
    return jnp.where(flies, jnp.where(lands, speed, jnp.nan), 0.0)


_conveying_speed = cached(conveying_speed_at)
