"""Exact jams: periodic motions of the full equations with jammed coincident loads, and their properties."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto, quantity_text, speed_text
from jaxvib.equations.jammed_bodies import JammedBodies
from jaxvib.errors import InputError
from jaxvib.machine.carrier import force_directions
from jaxvib.numerics.extrema import greatest
from jaxvib.numerics.fourier import Grid, deviation_synthesis, grid_of, synthesized
from jaxvib.numerics.sincos import sine_and_cosine
from jaxvib.results.fields import in_unit, names_along
from jaxvib.results.result import Result
from jaxvib.runtime.programs import cached
from jaxvib.steady.orbits.solve import Harmonics, Parameter, PeriodicSolution, branch_tangent, harmonics_of, periodic_motion
from jaxvib.steady.orbits.stability import MAX_INTEGRATION_STEPS, Floquet, decay_error, floquet, multiplier_error
from jaxvib.steady.outcome import REFUSED
from jaxvib.units import count, known_number


class OrbitStatus(eqx.Enumeration):
    """Outcomes of a search for an exact jam. The value of each member is the message shown to the user."""

    found = "the loads can jam in this periodic motion"
    absent = "this mode does not exist at this rotor speed"
    not_converged = "no periodic motion was found: the torques could not be balanced"
    under_resolved = "the periodic motion needs more harmonics for the requested accuracy; give more points"
    would_separate = "the loads would separate: staying side by side needs tensile forces between them"
    at_fold = "the rotor speed is that of a fold: the motion merges with another one and has no gradient"
    unresolved = (
        "the motion was found, but not its stability: the fastest motion of the carrier is too fast "
        "compared with that of the loads"
    )
    refused = REFUSED


class Orbit(Result):
    """Exact jam: phi = theta + psi(theta), theta = Omega t, psi periodic with mean 0; everything else follows from psi.

    Returned by `jam_orbit`.

    Values are NaN if the status is `absent`. If it is `not_converged`, all values except `residual` and `offsets` are NaN.
    Signals are Re sum_k c_k exp(i k theta).

    **Attributes** (nd coordinates, nb directions of the force, J and K harmonics)

    - `status`: an `OrbitStatus`
    - `residual` of the torque balance, relative
    - `error`: the larger of the estimated relative error of the computed speed and the estimated error of psi in rad, due to
      the number of harmonics and to rounding
    - `omega` and `rotor_speed`, rad/s; `slope`: dn/dOmega along the branch
    - `amplitude` (nd,), m (rad for tilts), and `foundation_force`, N: zero to peak, (max - min)/2 over the period. For two
      directions of the force: root of the summed squares of their peaks (sqrt 2 times the force of a circular whirl)
    - `power`, W: mean power that the loads take from the rotor, by drag and dry friction
    - `stable`: True if small deviations of the loads from this motion decay (`multiplier` < 1 - `multiplier_error`) and the
      loads do not separate
    - `multiplier`: largest modulus of the non-trivial Floquet multipliers; `multiplier_error`: its estimated numerical error
    - `multipliers`: the Floquet multipliers, complex, without the trivial one; the last ones belong to disturbances that
      separate coincident loads
    - `trivial`: computed value of the trivial multiplier, that of a shift in time; its exact value is 1
    - `deviation_harmonics` (G, J), rad, `displacement_harmonics` (nd, K), m (rad for tilts), `force_harmonics` (nb, K), N: the
      c_k. Loads that have equal parameters have one deviation (G = 1), otherwise each has its own (G = count)
    - `deviation_orders` and `orders`: the k of these harmonics
    - `offsets` (count,), rad: the angle by which each load is ahead of phi
    - `units` (nd,) of the amplitudes, "m" or "rad", and names of the `coordinates` (nd,)
    """

    status: OrbitStatus
    omega: Array = eqx.field(metadata=in_unit("rad/s"))
    rotor_speed: Array = eqx.field(metadata=in_unit("rad/s"))
    slope: Array = eqx.field(metadata=in_unit(""))
    stable: Array = eqx.field(metadata=in_unit(""))
    multiplier: Array = eqx.field(metadata=in_unit(""))
    multiplier_error: Array = eqx.field(metadata=in_unit(""))
    multipliers: Array = eqx.field(metadata=in_unit("", "floquet"))
    trivial: Array = eqx.field(metadata=in_unit(""))
    amplitude: Array = eqx.field(metadata=in_unit("m or rad", "coordinate"))
    foundation_force: Array = eqx.field(metadata=in_unit("N"))
    power: Array = eqx.field(metadata=in_unit("W"))
    residual: Array = eqx.field(metadata=in_unit(""))
    error: Array = eqx.field(metadata=in_unit(""))
    deviation_harmonics: Array = eqx.field(metadata=in_unit("rad", "group", "deviation_orders"))
    displacement_harmonics: Array = eqx.field(metadata=in_unit("m or rad", "coordinate", "orders"))
    force_harmonics: Array = eqx.field(metadata=in_unit("N", "direction", "orders"))
    offsets: Array = eqx.field(metadata=in_unit("rad", "load"))
    deviation_orders: tuple[int, ...] = eqx.field(static=True, metadata=in_unit("", "deviation_orders"))
    orders: tuple[int, ...] = eqx.field(static=True, metadata=in_unit("", "orders"))
    units: tuple[str, ...] = eqx.field(static=True, metadata=names_along("unit"))
    coordinates: tuple[str, ...] = eqx.field(static=True, metadata=names_along("coordinate"))

    @property
    def harmonics(self) -> int:
        """Highest harmonic of the carrier's motion that was used."""
        return self.orders[-1]

    @validated
    def at(self, theta: Array) -> tuple[Array, Array, tuple[Array], tuple[Array]]:
        """Return the motion at the angle `theta` = Omega t (scalar, rad).

        The result contains q (nd,), m, and q', m/s (tilts in rad and rad/s), and then phi (count,), rad, and phi', rad/s, each
        in a tuple of one array. A `State` consists of these four: `jv.State(*orbit.at(0.0))` is a point of the
        motion. For many angles use `jax.vmap(orbit.at)`.

        **Raises** `InputError` for an angle that is not finite, or so large that its digits within a turn are lost.
        """
        return _at(self, known_number(theta, "rad", "theta"))

    @validated
    def relative_amplitude(self, i: int, j: int) -> Array:
        """Return the amplitude of coordinate `i` relative to coordinate `j` (counted from 1), (max - min)/2 over the period.

        **Raises** `InputError` for a coordinate that the machine does not have, and for a displacement and a tilt.
        """
        nd = self.displacement_harmonics.shape[-2]
        for name, coordinate in (("i", i), ("j", j)):
            if count(coordinate, name) > nd:
                raise InputError(name, f"is {coordinate}; the coordinates are numbered 1 to {nd}")
        if self.units[i - 1] != self.units[j - 1]:
            one, other = (f"coordinate {k} is in {self.units[k - 1]}" for k in (j, i))
            raise InputError("j", f"is {j}, but {one}, and {other}; give two displacements or two tilts")
        return _relative_amplitude(self.orders, self.displacement_harmonics, i, j)

    @property
    def judgement(self) -> str:
        """Stability as text: "stable", "unstable" or "stability unknown"."""
        return judgement_of(self.multiplier, self.multiplier_error, self.stable)

    def force_peaks(self) -> Array:
        """Return the greatest foundation force in each of 16 equal parts of the period, N, (16,); the largest is
        `foundation_force`.

        `foundation_force` has a kink if another peak becomes the largest; these forces do not. For a force with even harmonics,
        or with two directions, the result is `foundation_force` alone, (1,).
        """
        if self.force_harmonics.shape[0] > 1 or any(k % 2 == 0 for k in self.orders):
            return self.foundation_force[None]
        return _force_peaks(self.orders, self.force_harmonics)

    def summary(self) -> str:
        """Return the result as a few lines of text; amplitudes zero to peak."""
        kinds = {unit: [k for k, each in enumerate(self.units) if each == unit] for unit in dict.fromkeys(self.units)}
        amplitude = "; ".join(quantity_text(np.asarray(self.amplitude)[places], unit, 6) for unit, places in kinds.items())
        return (
            f"loads {speed_text(self.omega, 9)}, rotor {speed_text(self.rotor_speed, 9)}, "
            f"{self.judgement} (largest multiplier {float(self.multiplier):.6g})\n"
            f"amplitude {amplitude}, foundation force {quantity_text(self.foundation_force, 'N', 6)}, "
            f"power {float(self.power):.6g} W\n"
            f"{self.harmonics} harmonics leave an error of {float(self.error):.1e}, residual {float(self.residual):.1e}"
        )

    @validated
    def plot(self, *, ax: Onto = None) -> Drawn:
        """Plot a period over the angle Omega t: displacements, deviation of the loads, force on the foundation.

        **Returns** a matplotlib figure, or the given `ax`, which has three axes.
        """
        deviation = self.deviation_orders, self.deviation_harmonics, "load angle - Ωt, degrees", "load", "all loads"
        named = (self.coordinates, self.units)
        return plot_period(self.orders, self.displacement_harmonics, named, deviation, self.force_harmonics, ax)


def judgement_of(multiplier: Array, error: Array, stable: Array) -> str:
    """Return "stable", "unstable", or, for a `multiplier` that is NaN or within its `error` of 1, "stability unknown"."""
    if np.isnan(multiplier) or abs(multiplier - 1.0) <= error:
        return "stability unknown"
    return "stable" if stable else "unstable"


def plot_period(
    orders: tuple[int, ...],
    displacement: Array,
    named: tuple[tuple[str, ...], tuple[str, ...]],
    deviation: tuple[tuple[int, ...], Array, str, str, str],
    force: Array,
    ax: Onto,
) -> Drawn:
    """Plot a period over the angle Omega t from harmonics; `named`: names and units of the coordinates; `deviation`: orders and
    harmonics of the bodies' deviations, the title of their panel, and labels of each of several bodies and of a single body."""
    from jaxvib.draw.results import signals_chart  # slow imports
    from jaxvib.draw.style import axis_unit

    theta = np.linspace(0.0, 2.0 * np.pi, 721)

    def signal(harmonics: Array, orders: tuple[int, ...]) -> np.ndarray:
        return np.real(np.asarray(harmonics) @ np.exp(1j * np.asarray(orders)[:, None] * theta)).T

    deviation_orders, angles, title, one, alone = deviation
    motion, angles_in_degrees, forces = (
        signal(displacement, orders),
        np.rad2deg(signal(angles, deviation_orders)),
        signal(force, orders),
    )
    names, units = named
    kinds = {unit: axis_unit(unit, motion[:, np.asarray(units) == unit]) for unit in units}
    labels = [f"{name}, {kinds[unit][0]}" if len(set(units)) > 1 else name for name, unit in zip(names, units, strict=True)]
    numbered = [f"{one} {k + 1}" for k in range(angles_in_degrees.shape[1])]
    panels = [
        (
            f"displacement, {' or '.join(kinds[unit][0] for unit in dict.fromkeys(units))}",
            motion * [kinds[unit][1] for unit in units],
            labels,
        ),
        (title, angles_in_degrees, numbered if len(numbered) > 1 else [alone]),
        ("foundation force, N", forces, list(force_directions(names, forces.shape[1]))),
    ]
    return signals_chart(np.rad2deg(theta), panels, x_label="load angle Ωt, degrees", ax=ax)


@cached
def _at(orbit: Orbit, theta: Array | np.ndarray) -> tuple[Array, Array, tuple[Array], tuple[Array]]:
    k, j = np.asarray(orbit.orders), np.asarray(orbit.deviation_orders)
    wave, deviation_wave = jnp.exp(1j * k * theta), jnp.exp(1j * j * theta)
    phi = theta + (orbit.deviation_harmonics @ deviation_wave).real
    rate = orbit.omega * (1.0 + (orbit.deviation_harmonics @ (1j * j * deviation_wave)).real)
    return (
        (orbit.displacement_harmonics @ wave).real,
        orbit.omega * (orbit.displacement_harmonics @ (1j * k * wave)).real,
        (orbit.offsets + phi,),
        (jnp.broadcast_to(rate, orbit.offsets.shape),),
    )


@cached
def _relative_amplitude(orders: tuple[int, ...], displacement: Array, i: int, j: int) -> Array:
    return half_range(np.asarray(orders), displacement[i - 1 : i] - displacement[j - 1 : j])[0]


@cached
def _force_peaks(orders: tuple[int, ...], force: Array) -> Array:
    return _peaks(np.asarray(orders), force[0])


def orbits(
    model: JammedBodies,
    value: Array,
    start: Array,
    given: Parameter,
    points: int,
    steps: int | Array,
    accuracy: float,
    deviation: Array | None = None,
    *,
    implicit: bool,
    max_steps: int | None = None,
) -> tuple[Orbit, Floquet]:
    """Solve for several exact jams of one machine.

    **Arguments** (P jams, G bodies of loads, M points of the grid)

    - `value` (P,), rad/s: the prescribed speed of each jam, the load speed or the rotor speed as `given` states
    - `start` (P,), rad/s: initial values of the other speed; `deviation` (P, G, M), rad: initial psi
    - `points`: number of collocation points; `accuracy`: largest error of a motion with the status `found`
    - `steps`, `implicit`, `max_steps`: see `floquet`

    **Returns** `Orbit` with a leading axis P on each of its arrays, and their `Floquet`.
    """
    grid = grid_of(points, model.half_turn)
    motion, harmonics, measured = _solve_each(model, grid, given, (value, start, deviation))
    # Steps of twice the length that `steps_for` chooses have errors of 1e-8.
    resolved = jnp.asarray(steps) <= (MAX_INTEGRATION_STEPS if max_steps is None else 2 * max_steps)
    limited = jnp.where(resolved, steps if max_steps is None else jnp.minimum(steps, max_steps), 1)
    growth = floquet(model, grid, motion, harmonics, limited, implicit=implicit, max_steps=max_steps)
    multipliers, trivial, largest = _multipliers_of(growth, grid)
    turn, turns = (np.pi, 2.0) if grid.symmetric else (2.0 * np.pi, 1.0)
    largest_error = multiplier_error(trivial, turns * decay_error(steps, limited, turn, implicit=implicit))
    slope, residual, speed_error, deviation_error, amplitude, force, power, contact_torque = measured
    tiny = jnp.finfo(slope.dtype).eps
    relative = jnp.abs(slope) * motion.omega / motion.rotor_speed
    met = residual < 4096.0 * tiny
    speed_error = speed_error + tiny  # near a fold, rounding errors of the load speed are magnified too
    error = jnp.maximum(speed_error / (jnp.maximum(relative, tiny) if given == "rotor_speed" else 1.0), deviation_error)
    flat = (relative < tiny**0.25) & (given == "rotor_speed")
    separates = contact_torque < 0.0

    def or_nan(values: Array) -> Array:
        return jnp.moveaxis(jnp.where(met, values, jnp.nan), -1, 0)

    orbit = Orbit(
        status=jax.vmap(_status, in_axes=(0, 0, 0, None, 0))(met, separates, flat, resolved, error <= accuracy),
        omega=or_nan(motion.omega),
        rotor_speed=or_nan(motion.rotor_speed),
        slope=or_nan(slope),
        stable=met & resolved & (largest < 1.0 - largest_error) & ~separates,
        multiplier=or_nan(jnp.where(resolved, largest, jnp.nan)),
        multiplier_error=or_nan(jnp.where(resolved, largest_error, jnp.nan)),
        multipliers=or_nan(jnp.where(resolved, multipliers, jnp.nan)),
        trivial=or_nan(jnp.where(resolved, trivial, jnp.nan)),
        amplitude=or_nan(amplitude),
        foundation_force=or_nan(force),
        power=or_nan(power),
        residual=residual,
        error=or_nan(error),
        deviation_harmonics=or_nan(harmonics.deviation),
        displacement_harmonics=or_nan(harmonics.displacement),
        force_harmonics=or_nan(harmonics.force),
        deviation_orders=tuple(map(int, grid.deviation_orders)),
        orders=tuple(map(int, grid.orders)),
        units=model.linear.carrier.units,
        coordinates=model.linear.carrier.coordinates,
        offsets=jnp.broadcast_to(model.offsets, (value.shape[0], model.loads.count)),
    )
    return orbit, growth


def _solve_each(
    model: JammedBodies, grid: Grid, given: Parameter, starts: tuple[Array, Array, Array | None]
) -> tuple[PeriodicSolution, Harmonics, tuple[Array, ...]]:
    """Return the periodic motions from the `starts` of `orbits`, their harmonics and quantities; the last axis is P."""

    def one(v: Array, s: Array, deviation: Array | None) -> tuple[PeriodicSolution, Harmonics, tuple[Array, ...]]:
        motion = periodic_motion(model, grid, given, v, s, deviation)
        return motion, *_all_quantities(model, grid, motion)

    if starts[0].shape[0] == 1:  # a program without an axis of length one is smaller
        return jax.tree.map(lambda x: x[..., None], one(*jax.tree.map(lambda x: x[0], starts)))
    return jax.vmap(one, out_axes=-1)(*starts)


def _multipliers_of(growth: Floquet, grid: Grid) -> tuple[Array, Array, Array]:
    """Return all multipliers of a period, the trivial one, and the largest modulus."""
    roots = growth.roots if growth.inner is None else jnp.concatenate([growth.roots, growth.inner])
    multipliers = roots**2 if grid.symmetric else roots
    trivial = growth.trivial**2 if grid.symmetric else growth.trivial
    return multipliers, trivial, jnp.sqrt(jnp.max(multipliers.real**2 + multipliers.imag**2, axis=0))


def _status(met: Array, separates: Array, flat: Array, resolved: Array, accurate: Array) -> OrbitStatus:
    """Return the status of one motion, the first that applies: equations not satisfied, loads that separate, a fold, stability
    not resolved, error above the accuracy."""
    status = OrbitStatus.where(accurate, OrbitStatus.found, OrbitStatus.under_resolved)
    status = OrbitStatus.where(resolved, status, OrbitStatus.unresolved)
    status = OrbitStatus.where(flat, OrbitStatus.at_fold, status)
    status = OrbitStatus.where(separates, OrbitStatus.would_separate, status)
    return OrbitStatus.where(met, status, OrbitStatus.not_converged)


def differentiable_fields(
    model: JammedBodies, orbit: Orbit, value: Array, start: Array, given: Parameter, points: int
) -> dict[str, Array]:
    """Return fields of `orbits` for one known motion, with derivatives; 0 in place of NaN."""
    grid, exists = grid_of(points, model.half_turn), ~jnp.isnan(orbit.omega)
    x = jnp.where(exists, orbit.omega if given == "rotor_speed" else orbit.rotor_speed, start)
    deviation = synthesized(jnp.where(exists, orbit.deviation_harmonics, 0.0), deviation_synthesis(grid))
    motion = periodic_motion(model, grid, given, value, x, deviation, is_known=True)
    harmonics, (slope, _, _, _, amplitude, force, power, _) = _all_quantities(model, grid, motion)
    fields = {
        "omega": motion.omega,
        "rotor_speed": motion.rotor_speed,
        "slope": slope,
        "amplitude": amplitude,
        "foundation_force": force,
        "power": power,
        "deviation_harmonics": harmonics.deviation,
        "displacement_harmonics": harmonics.displacement,
        "force_harmonics": harmonics.force,
    }
    return {name: jnp.where(exists, field, 0.0) for name, field in fields.items()}


def _all_quantities(model: JammedBodies, grid: Grid, motion: PeriodicSolution) -> tuple[Harmonics, tuple[Array, ...]]:
    """Return harmonics of one motion; slope of the branch, residual, errors of the rotor speed and of the deviation; and
    `_motion_quantities`."""
    branch = branch_tangent(model, grid, motion)
    harmonics = harmonics_of(model, grid, motion, branch.response)
    return harmonics, (*branch[:-2], *_motion_quantities(model, grid, motion, harmonics, branch.acceleration))


def _motion_quantities(
    model: JammedBodies, grid: Grid, motion: PeriodicSolution, harmonics: Harmonics, acceleration: Array
) -> tuple[Array, ...]:
    """Return amplitude, foundation force, power and contact torque between the loads of one motion.

    The power is the sum of the dissipation by drag, friction and the carrier. It equals n times the mean torque; for strong
    drag this product loses significant digits, because the torque is computed from a small difference n - phi'.
    """
    phi, rate = grid.theta[None] + motion.deviation, motion.omega * (1.0 + motion.deviation @ grid.first.T)
    torque = model.torque(phi, rate, motion.rotor_speed, acceleration, model.rotor_torque)
    power = jnp.sum(torque * (motion.rotor_speed - rate)) / grid.theta.size
    velocity = motion.omega * (harmonics.displacement * grid.orders[None])
    power = power + model.linear.dissipated(velocity)
    nd = harmonics.displacement.shape[0]
    ranges = half_range(grid.orders, jnp.concatenate([harmonics.displacement, harmonics.force]))
    # Components of the foundation force are combined as those of a vector.
    force = jnp.sqrt(jnp.sum(ranges[nd:] ** 2))
    contact_torque = _least_contact_torque(model, grid, motion, harmonics)
    return (ranges[:nd], force, power, contact_torque)


def _least_contact_torque(model: JammedBodies, grid: Grid, motion: PeriodicSolution, harmonics: Harmonics) -> Array:
    """Return the smallest mean torque over a period, N m, with which a load pushes the next one, for loads side by side.

    Load j needs  m R e'(phi_j).a - torque_j  from its neighbours. The criterion is the mean, because no vibration of a jam
    presses the loads together at every instant.
    """
    loads = model.loads
    if loads.ball_radius is None or loads.count == 1:
        return jnp.zeros_like(motion.omega)
    phi, rate = model.each_load(grid.theta[None] + motion.deviation, motion.omega * (1.0 + motion.deviation @ grid.first.T))
    acceleration = synthesized(harmonics.acceleration, grid.synthesis)
    vibration = loads.mass * loads.radius * jnp.einsum("aji,ai->ji", model.circle(phi)[1], acceleration)
    needed = jnp.mean(vibration - model.torque_of_each(phi, rate, motion.rotor_speed, acceleration[:, None]), axis=1)
    return jnp.min(-jnp.cumsum(needed)[:-1])


_PEAK_SEARCH_PARTS = 16
"""Number of parts of a period in which peaks are searched separately; the relevant harmonics have fewer peaks."""


def _peaks(orders: np.ndarray, harmonics: Array, *, half: bool = False) -> Array:
    """Return the maximum, (16,), of the signal with harmonics (K,) in each part of the period, including its ends; with `half`,
    for a signal that changes its sign after half a period, the maximum of its magnitude in parts of half a period."""
    each, width = max(16, int(orders[-1]) // 4), 2.0 * np.pi / _PEAK_SEARCH_PARTS
    if half:
        each, width = each // 2, width / 2.0
    starts, places, k = (
        width * np.arange(_PEAK_SEARCH_PARTS),
        np.arange(each + 1) / each,
        np.asarray(orders, harmonics.real.dtype),
    )
    angles = k * (starts[:, None] + width * places)[..., None]
    # Real and imaginary parts are in one real array, because products of complex numbers take four times as long.
    waves = jnp.asarray(np.concatenate([np.cos(angles), -np.sin(angles)], -1), k.dtype)
    both, none = jnp.concatenate([harmonics.real, harmonics.imag]), np.zeros((k.size, k.size), k.dtype)
    slope, fixed = np.block([[none, -np.diag(k)], [np.diag(k), none]]), jax.lax.stop_gradient(both)
    derivatives, values = np.stack([slope, slope @ slope, slope @ slope @ slope]) @ fixed, waves @ fixed
    best = jnp.argmax(jnp.abs(values) if half else values, axis=1)
    begin = waves[np.arange(_PEAK_SEARCH_PARTS), best]
    side = jnp.where(begin @ fixed < 0.0, -1.0, 1.0) if half else np.ones(_PEAK_SEARCH_PARTS, k.dtype)

    def halley(_: int, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        theta, wave = carry
        first, second, third = derivatives @ wave.T * side[None]
        below = -jnp.finfo(second.dtype).tiny  # almost 0; the step then always goes uphill
        step = first / jnp.minimum(second - 0.5 * first * third / jnp.minimum(second, below), below)
        theta = jnp.clip(theta - jnp.clip(step, -width / each, width / each), starts, starts + width)
        sine, cosine = sine_and_cosine(k[None] * theta[:, None])
        return theta, jnp.concatenate([cosine, -sine], 1)

    # The value at an extremum does not depend on its place to first order; therefore the place needs no derivative.
    return side * (jax.lax.fori_loop(0, 3, halley, (starts + width / each * best, begin))[1] @ both)


def half_range(orders: np.ndarray, harmonics: Array) -> Array:
    """Return (max - min)/2 over the period, between samples too, of the signals with these harmonics (n, K)."""
    symmetric = bool(np.all(orders % 2 == 1))  # the signal is repeated with the opposite sign after half a period

    def highest(c: Array) -> Array:
        return greatest(_peaks(orders, c, half=symmetric))  # the maximum may lie between samples that are not the largest

    def one(c: Array) -> Array:
        return highest(c) if symmetric else (highest(c) + highest(-c)) / 2.0

    return jax.vmap(one)(harmonics)
