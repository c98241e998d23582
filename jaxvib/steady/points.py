"""Motion of points of a machine: ellipses, throw, and their spread over a deck.

A point moves by u = B q, where B are its rows (`Machine.rows_at`). If all coordinates vibrate at one speed,
q = Re(Y e^{i w t}), the point moves on the ellipse with the complex amplitudes U = B Y.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import GRAVITIES, Axes, Drawn, quantity_text
from jaxvib.errors import InputError, quoted
from jaxvib.machine.carrier import Machine, Place, on_body, read_place
from jaxvib.numerics.extrema import sampled_maximum
from jaxvib.numerics.linalg import magnitude
from jaxvib.results.fields import in_unit, part
from jaxvib.results.readable import Readable
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.runtime.programs import cached
from jaxvib.steady.vibration import Samples, largest_extent
from jaxvib.units import Number, known_number, number, numbers
from jaxvib.units.known import require_finite, require_if_known, when_known
from jaxvib.units.reading import STANDARD_GRAVITY


def _rounding(semi_axis: Array) -> float:
    """Return the relative size below which a semi-axis, or the difference of both semi-axes, is a rounding error.

    The path is then a straight line, or a circle, whose long axis has no direction.
    """
    return max(1e-12, 8.0 * float(jnp.finfo(semi_axis.dtype).eps))


_SHOWN_DIFFERENCE = 1e-3
"""Relative difference between the stroke and the long axis of an ellipse above which texts state the stroke, too."""


class Ellipse(Readable):
    """Path of a point that vibrates at one speed w, with measures of the whole path of runs and exact motions.

    **Attributes**

    - `semi_major` a, m, of the ellipse on which the point moves at the speed w; typical: 1 to 10 mm for screens and feeders
    - `semi_minor` b, m, positive if the point turns anticlockwise, negative if it turns clockwise, 0 on a straight line
    - `stroke`, m peak to peak: largest extent of the path in any direction; 2 a for averaged motions
    - `direction` of the stroke, rad from x anticlockwise, above -pi/2 and at most pi/2; the throw angle of a point that moves
      on a straight line. The direction is 0 for a circle, which has no long axis
    - `acceleration`, in g: the largest one, with g = 9.80665 m/s^2; w^2 a / g for averaged motions; typical: 3 to 6
    - `throw_number`: the largest acceleration perpendicular to the deck, toward its lower side, divided by the component of g
      in this direction; typical: 2 to 5
    - `remainder`: root-mean-square displacement that is not on the ellipse, relative to the root-mean-square displacement on
      it; 0 for averaged motions

    `stroke`, `direction`, `acceleration` and `throw_number` of an exact motion, and of a run in its window, are those of the
    whole motion with all its frequencies.

    >>> import jax.numpy as jnp
    >>> path = ellipse_of(jnp.array([0.003 + 0.0j, 0.003 + 0.0j]), 100.0)        # 3 mm in x and in y, in phase
    >>> round(1e3 * float(path.semi_major), 3), round(float(jnp.rad2deg(path.direction)), 3), float(path.sense)
    (4.243, 45.0, 0.0)
    """

    semi_major: Array = eqx.field(metadata=in_unit("m"))
    semi_minor: Array = eqx.field(metadata=in_unit("m"))
    stroke: Array = eqx.field(metadata=in_unit("m"))
    direction: Array = eqx.field(metadata=in_unit("rad"))
    acceleration: Array = eqx.field(metadata=in_unit(GRAVITIES))
    throw_number: Array = eqx.field(metadata=in_unit(""))
    remainder: Array = eqx.field(metadata=in_unit(""))

    @property
    def is_circle(self) -> Array:
        """True if the semi-axes are equal to rounding; `direction` is then 0 and has no meaning."""
        return self.semi_major - jnp.abs(self.semi_minor) <= _rounding(self.semi_major) * self.semi_major

    @property
    def sense(self) -> Array:
        """Sense of rotation: 1 anticlockwise, -1 clockwise, 0 on a straight line (to rounding)."""
        turns = jnp.abs(self.semi_minor) > _rounding(self.semi_major) * self.semi_major
        return jnp.where(turns, jnp.sign(self.semi_minor), 0.0)

    def summary(self) -> str:
        """Return the ellipse as a line of text."""
        turn = {1: ", anticlockwise", -1: ", clockwise", 0: ""}[int(self.sense)]
        axes = f"semi-axes {quantity_text([self.semi_major, abs(self.semi_minor)], 'm', 4, ' and ')}{turn}"
        # Rounding errors of 0 are not shown.
        angle, throw = round(np.rad2deg(float(self.direction)), 9) + 0.0, round(float(self.throw_number), 9)
        along = "a circle" if bool(self.is_circle) else f"long axis at {angle:.4g} deg"
        numbers = f"{float(self.acceleration):.4g} g, throw number {throw:.4g}"
        rest = f", remainder {float(self.remainder):.2g}" if float(self.remainder) > 0.0 else ""
        if abs(float(self.stroke) / (2.0 * float(self.semi_major)) - 1.0) > _SHOWN_DIFFERENCE:
            axes += f", stroke {quantity_text(self.stroke, 'm', 4)} peak to peak"
        return f"{axes}, {along}, {numbers}{rest}"


@validated
def ellipse_of(amplitude: Array | complex, speed: Number, *, slope: Number = 0.0, remainder: Number = 0.0) -> Ellipse:
    """Return the ellipse of u = Re(U e^{i w t}).

        x + i y = P e^{i w t} + N e^{-i w t},    P = (U_x + i U_y)/2,    N = conj(U_x - i U_y)/2
        a = |P| + |N|,    b = |P| - |N|,    direction = arg(P N)/2

    **Arguments**

    - `amplitude` U (2,), m, complex
    - `speed` w, rad/s; typical: 75 to 160; a negative speed reverses the sense of rotation
    - `slope` of the deck, rad from x anticlockwise; typical: 0 to -0.4
    - `remainder` of the motion, see `Ellipse`

    **Returns** `Ellipse`. Derivatives are finite everywhere. At a circle, where the derivative of |P| or |N| does not exist,
    it is set to 0. **Raises** `InputError` for numbers that are not finite, and for another number of amplitudes.

    >>> import jax.numpy as jnp
    >>> print(ellipse_of(jnp.array([0.005, -0.005j]), 100.0).summary())
    semi-axes 5 and 5 mm, anticlockwise, a circle, 5.099 g, throw number 5.099
    """
    require_amplitudes(amplitude)
    w, along = number(speed, "rad/s", "speed"), read_slope(slope)
    return ellipse_at(jnp.asarray(amplitude), w, along, number(remainder, "", "remainder", low=0.0))


def read_slope(slope: Number, field: str = "slope") -> Any:
    """Return the slope of a deck, rad. **Raises** `InputError` for a right angle or more, such as degrees without a unit."""
    value = known_number(slope, "rad", field)
    problem = "is {:.4g} rad ({:.4g} degrees), which is not a slope of a deck; write degrees as '{:g} deg'"
    values = value, np.rad2deg(1.0) * value, value
    require_if_known(lambda radians, *_: abs(radians) < 0.5 * np.pi, *values, field=field, problem=problem)
    return value


def require_amplitudes(amplitude: Array | complex) -> None:
    """**Raises** `InputError` for anything other than two finite amplitudes."""
    if jnp.shape(amplitude) != (2,):
        raise InputError("amplitude", f"has the shape {jnp.shape(amplitude)}; give two amplitudes, horizontal and up")
    if when_known(lambda known: not np.all(np.isfinite(known)), amplitude):
        raise InputError("amplitude", f"is {quoted(amplitude)}; finite numbers are needed")


def ellipse_at(amplitude: Array, speed: Array, slope: Array, remainder: Array) -> Ellipse:
    """Return `ellipse_of` for validated values."""
    (x, y), speed = at_positive_speed(amplitude, speed)
    forward, backward = (x + 1j * y) / 2.0, jnp.conj(x - 1j * y) / 2.0
    forward_radius, backward_radius = magnitude(forward), magnitude(backward)
    long, short = forward_radius + backward_radius, forward_radius - backward_radius
    is_circle = 2.0 * jnp.minimum(forward_radius, backward_radius) <= _rounding(long) * long
    product = jnp.where(is_circle, 1.0, forward * backward)
    normal = magnitude(-jnp.sin(slope) * x + jnp.cos(slope) * y)
    factor = speed**2 / STANDARD_GRAVITY
    return Ellipse(
        semi_major=long,
        semi_minor=short,
        stroke=2.0 * long,
        direction=0.5 * jnp.arctan2(product.imag, product.real),
        acceleration=factor * long,
        throw_number=factor * normal / jnp.cos(slope),
        remainder=jnp.asarray(remainder, long.dtype),
    )


def path_at(rows: Array, amplitude: Array, speed: Array, slope: Array, samples: Samples | None, remainder: Array) -> Ellipse:
    """Return the path of the point with the `rows` (2, nd): the ellipse of the complex amplitudes (nd,) at the `speed`, with
    the measures of the whole motion if there are `samples` of it."""
    path = ellipse_at(rows @ amplitude, speed, slope, remainder)
    if samples is None:
        return path
    extent = largest_extent(samples.displacement @ rows.T)
    across, up = (samples.acceleration @ rows.T / STANDARD_GRAVITY).T
    away = jnp.sin(slope) * across - jnp.cos(slope) * up  # a deck that accelerates downward throws its material
    return dataclasses.replace(
        path,
        stroke=extent.stroke,
        direction=extent.direction,
        acceleration=sampled_maximum(magnitude(across + 1j * up), axis=0),
        throw_number=sampled_maximum(jnp.maximum(away, 0.0), axis=0) / jnp.cos(slope),
    )


def at_positive_speed(amplitude: Array, speed: Array) -> tuple[Array, Array]:
    """Return the amplitudes and the speed of Re(U e^{i w t}) for w >= 0: conj(U) and -w for a negative w."""
    return jnp.where(speed < 0.0, jnp.conj(amplitude), amplitude), jnp.abs(speed)


class Deck(Result):
    """Motion of several points of a body, such as those of a screening deck.

    Returned by `Run.deck`, and by the same method of steady motions.

    **Attributes** (n points)

    - `points` (n, 2), m, of the body
    - `amplitude` U (n, 2), m: complex amplitudes, horizontal and up
    - `ellipses`: an `Ellipse` whose arrays are (n,)
    - `motion_spread`: root mean square of |U_p - mean U| over the points p, divided by |mean U|; typical: 0.01 to 0.3. It is 0
      if all points have the same motion, and inf if the mean is 0, as for a deck that only turns about its middle
    """

    status = Computed.done

    points: Array = eqx.field(metadata=in_unit("m", "point", "direction"))
    amplitude: Array = eqx.field(metadata=in_unit("m", "point", "direction"))
    ellipses: Ellipse = eqx.field(metadata=part("point"))
    motion_spread: Array = eqx.field(metadata=in_unit(""))

    @property
    def amplitude_spread(self) -> Array:
        """Range of the semi-major axes divided by their mean."""
        size = self.ellipses.semi_major
        return (jnp.max(size) - jnp.min(size)) / jnp.mean(size)

    @property
    def direction_spread(self) -> Array:
        """Range of the directions of the long axes about their mean direction, rad; opposite directions count as equal."""
        turn = jnp.exp(2j * self.ellipses.direction)
        difference = 0.5 * jnp.angle(turn / jnp.mean(turn))
        return jnp.max(difference) - jnp.min(difference)

    def summary(self) -> str:
        """Return a line for each point, and the spread."""
        each = [
            f"({float(x):.4g}, {float(y):.4g}) m: {jax.tree.map(lambda leaf, k=k: leaf[k], self.ellipses).summary()}"
            for k, (x, y) in enumerate(np.asarray(self.points))
        ]
        spread = (
            f"spread over the deck: amplitude {100.0 * float(self.amplitude_spread):.3g} %, "
            f"direction {np.rad2deg(float(self.direction_spread)):.3g} deg, motion {float(self.motion_spread):.3g}"
        )
        return "\n".join([*each, spread])

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the ellipses at their points, magnified; a dot marks the phase at one common time."""
        from jaxvib.draw.machine.deck import deck_chart  # slow import

        return deck_chart(np.asarray(self.points), np.asarray(self.amplitude), ax=ax)


class Harmonic(NamedTuple):
    """Vibration q = Re(Y e^{i w t}) of all coordinates of a `machine` at the `speed` w, rad/s, with the `amplitude` Y (nd,),
    complex. `rest` (nd, nd): mean of r r^T, where r is the part of the motion about its mean that the harmonic does not
    contain; None if there is no such part."""

    machine: Machine
    speed: Array
    amplitude: Array
    rest: Array | None = None


class PathsOfPoints(eqx.Module):
    """Base of results whose motion at the points of a machine is known."""

    @abc.abstractmethod
    def harmonic(self) -> Harmonic:
        """Return the vibration of the coordinates at the speed of the exciters."""

    def samples(self) -> Samples | None:
        """Return samples of the whole motion with all its frequencies; None for a motion that is known at one speed only."""
        return None

    @validated
    def ellipse(self, at: int | Number | Sequence[Number] | None = None, body: int = 0, *, slope: Number = 0.0) -> Ellipse:
        """Return the path of a point, see `Ellipse`.

        **Arguments**

        - `at`: the place on the machine, see `Exciter`: (x, y) of a body, m, the number of a platform, or a distance along a
          rotor's axis, m; default: the centre of mass, platform 1, or the common station of a rotor's loads
        - `body`: number of the body from 0, on machines with several; typical: 0 (the default)
        - `slope` of the deck, rad or a string with a unit, anticlockwise from x, for the throw number; typical: "-15 deg" to 0
          (the default)

        **Returns** `Ellipse`. **Raises** `InputError` for a place that the machine does not have.
        """
        motion = self.harmonic()
        place = on_body(read_place(at), motion.machine.require_body(body))
        return _ellipse(motion, self.samples(), place, read_slope(slope))

    @validated
    def deck(self, points: Sequence[Sequence[Number]], body: int = 0, *, slope: Number = 0.0) -> Deck:
        """Return the paths of several points of a body and their spread, see `Deck`.

        **Arguments**: `points`: a list of (x, y), m; `body` and `slope` as in `ellipse`; typical: 3 to 10 points.

        **Returns** `Deck`. **Raises** `InputError` for points that the machine does not have.
        """
        is_list = isinstance(points, (list, tuple))
        are_pairs = is_list and all(isinstance(each, (list, tuple)) or getattr(each, "ndim", 0) == 1 for each in points)
        if not (are_pairs or getattr(points, "ndim", 0) == 2) or len(points) == 0:
            raise InputError("points", f"is {quoted(points)}; it must be a list of points, [(x, y), ...]")
        places = jnp.stack([numbers(point, "m", f"points[{k}]", 2) for k, point in enumerate(points)])
        motion = self.harmonic()
        return _deck(motion, self.samples(), places, read_slope(slope), motion.machine.require_body(body))

    @validated
    def foundation_moment(self, about: Sequence[Number] = (0.0, 0.0)) -> Array:
        """Return the amplitude of the moment of the supports on the foundation at the speed of the exciters, N m, zero to peak.

        **Arguments**: `about`: the fixed point to which the moment refers, see `jaxvib.foundation_moment`.

        **Raises** `InputError` for a machine that is not a body in a plane; `ComputationError` with the status "overflow" if
        the moment of a finite motion is not finite.
        """
        motion = self.harmonic()
        moment = _moment(motion, numbers(about, "m", "about", 2))
        when_known(_require_finite_moment, motion.amplitude, moment)
        return moment


def _require_finite_moment(amplitude: np.ndarray, moment: np.ndarray) -> None:
    if np.all(np.isfinite(amplitude)):
        require_finite("parts of the foundation moment", moment)


def rows_in_plane(machine: Machine, place: Place, name: str = "at") -> Array:
    """Return the rows (2, nd) of a point, horizontal and up. If a machine only moves up, the first row is 0."""
    rows = machine.rows_at(place, name)
    return rows if rows.shape[0] == 2 else jnp.concatenate([jnp.zeros_like(rows), rows])


@cached
def _ellipse(motion: Harmonic, samples: Samples | None, place: Place, slope: Array) -> Ellipse:
    return _at_rows(motion, samples, rows_in_plane(motion.machine, place), slope)[1]


@cached
def _moment(motion: Harmonic, about: Array) -> Array:
    rows = motion.machine.moment_rows(about)
    return magnitude((rows[0] + 1j * motion.speed * rows[1]) @ motion.amplitude)


@cached
def _deck(motion: Harmonic, samples: Samples | None, points: Array, slope: Array, body: int) -> Deck:
    rows = jnp.stack([rows_in_plane(motion.machine, on_body(point, body), "points") for point in points])
    amplitude, ellipses = jax.vmap(lambda each: _at_rows(motion, samples, each, slope))(rows)
    mean = jnp.mean(amplitude, axis=0, keepdims=True)
    variance = jnp.mean(jnp.sum(jnp.abs(amplitude - mean) ** 2, axis=1))
    return Deck(points, amplitude, ellipses, _root_of_ratio(variance, jnp.sum(jnp.abs(mean) ** 2)))


def _root_of_ratio(part: Array, whole: Array) -> Array:
    """Return sqrt(part/whole): 0 with the derivative 0 for a part of 0, otherwise inf for a whole of 0."""
    is_zero = part == 0.0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, part) / jnp.where(is_zero, 1.0, whole)))


def _at_rows(motion: Harmonic, samples: Samples | None, rows: Array, slope: Array) -> tuple[Array, Ellipse]:
    """Return the complex amplitudes (2,) and the ellipse of the point with these rows."""
    amplitude = rows @ motion.amplitude
    on_ellipse = 0.5 * jnp.sum(jnp.abs(amplitude) ** 2)
    off_ellipse = jnp.zeros_like(on_ellipse) if motion.rest is None else jnp.sum((rows @ motion.rest) * rows)
    remainder = _root_of_ratio(off_ellipse, on_ellipse)
    return amplitude, path_at(rows, motion.amplitude, motion.speed, slope, samples, remainder)
