"""Whirl of a rotor: natural motions that turn with the rotor or against it."""

from __future__ import annotations

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, SpeedUnit, speed_text, speed_unit
from jaxvib.equations.linear import LinearModel, linear_model
from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.machine.carrier import Mount
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.linalg import MAX_EIGENVALUE_ERROR, eigenvalues, hermitian_error, hermitian_modes, relative_to
from jaxvib.results.fields import in_unit, part
from jaxvib.results.result import Result
from jaxvib.runtime.programs import cached
from jaxvib.steady.outcome import REFUSED, outcome
from jaxvib.units import Numbers, numbers
from jaxvib.units.known import require_finite, when_known

LoadMasses = Literal["fixed", "none"]

_STRAIGHT = 1e-3
"""Largest 2 a b/(a^2 + b^2) of an ellipse with the semi-axes a and b that counts as a straight line."""

_COUPLING, _MIN_COUPLING_ROUNDINGS = 1e-9, 100.0
"""Size of the added coupling that separates two whirls of one speed, relative to the matrices of the machine, and its minimum
in units of the rounding."""


class WhirlStatus(eqx.Enumeration):
    """Outcomes of a computation of whirls. The value of each member is the message shown to the user."""

    done = "the result was computed"
    refused = REFUSED
    lost_digits = (
        "some of these motions are lost in rounding errors, and their values are NaN: use double precision, "
        "or parameters whose sizes differ less"
    )


class CriticalSpeeds(Result):
    """Rotor speeds at which a whirl turns as fast as the rotor, without damping.

    **Attributes**

    - `speed` (nd,), rad/s, ascending; inf for a speed that does not exist (a thin disc has no second forward critical speed)
    - `forward` (nd,): True if the whirl turns in the direction of the rotor. On supports that are equal in both directions an
      imbalance excites forward whirls only. If horizontal and vertical supports differ, it excites all whirls; between
      the two speeds into which a critical speed is split, the rotor's axis then whirls backward
    - `straight` (nd,): True if the axis moves on a straight line, which needs different horizontal and vertical supports
    - `angle` (nd,), rad: anticlockwise angle of this line from the first direction, x, from -45 to 135 degrees; NaN for others
    - `status`: a `WhirlStatus`
    """

    status: WhirlStatus
    speed: Array = eqx.field(metadata=in_unit("rad/s", "whirl"))
    forward: Array = eqx.field(metadata=in_unit("", "whirl"))
    straight: Array = eqx.field(metadata=in_unit("", "whirl"))
    angle: Array = eqx.field(metadata=in_unit("rad", "whirl"))

    @property
    def sense(self) -> np.ndarray:
        """Sense of each whirl, (nd,): "forward", "backward", or for a straight line its angle, "straight at 90 deg"."""
        return _sense_words(self.forward, self.straight, self.angle)

    def summary(self) -> str:
        """Return a line of text for each speed."""
        pairs = zip(np.asarray(self.speed), self.sense, strict=True)
        lines = [f"critical speed {speed_text(w, 6)}, {sense}" for w, sense in pairs if np.isfinite(w)]
        lost = [self.message] if self.status_name != "done" else []
        return "\n".join([*lines, *lost]) or "no critical speed"

    def plot(self, *, unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot the critical speeds in `unit`, on a line for each sense."""
        from jaxvib.draw.results import speeds_chart  # slow import

        speed, sense = np.asarray(self.speed), self.sense
        shown = ["forward", "backward", *np.unique(sense[np.asarray(self.straight)]).tolist()]
        return speeds_chart([(word, speed[sense == word]) for word in shown], unit=unit, ax=ax)


class Whirl(Result):
    """Natural motions of a turning rotor over rotor speeds: the Campbell diagram.

    Returned by `whirl`.

    **Attributes** (ns rotor speeds, nd natural motions each, ascending in speed)

    - `rotor_speed`: (ns,) rad/s
    - `speed`: (ns, nd) rad/s of the whirl, 0 if damping allows no oscillation
    - `decay`: (ns, nd) 1/s, negative if the motion grows. An overdamped motion has two decay rates; `decay` is the smaller
      one, with which the displacement creeps back. Several overdamped motions are in the order of increasing decay
    - `forward`: (ns, nd) True if the motion turns with the rotor, False if it turns against the rotor or not at all
    - `straight`: (ns, nd) True if the axis moves on a straight line, which needs different horizontal and vertical supports
    - `angle`: (ns, nd), rad, anticlockwise angle of this line from the first direction, x, from -45 to 135 degrees; NaN for
      other motions
    - `directivity`: (ns, nd) (f - b)/(f + b), where the ellipse of the motion is the sum of a forward circle of the radius f
      and a backward circle of the radius b. It is 1 for a forward circle, 0 for a straight line, and -1 for a backward circle.
      No force that turns with the rotor excites a motion of the directivity -1. For a rotor that tilts, f and b are root sums
      of squares over the displacement of the axis, m, and its tilts, rad. It is NaN for a motion that does not oscillate
    - `critical`: the critical speeds
    - `status`: a `WhirlStatus`; motions that are lost in rounding errors are NaN
    """

    status: WhirlStatus
    rotor_speed: Array = eqx.field(metadata=in_unit("rad/s", "rotor_speed"))
    speed: Array = eqx.field(metadata=in_unit("rad/s", "rotor_speed", "whirl"))
    decay: Array = eqx.field(metadata=in_unit("1/s", "rotor_speed", "whirl"))
    forward: Array = eqx.field(metadata=in_unit("", "rotor_speed", "whirl"))
    straight: Array = eqx.field(metadata=in_unit("", "rotor_speed", "whirl"))
    angle: Array = eqx.field(metadata=in_unit("rad", "rotor_speed", "whirl"))
    directivity: Array = eqx.field(metadata=in_unit("", "rotor_speed", "whirl"))
    critical: CriticalSpeeds = eqx.field(metadata=part(prefix="critical_"))

    @property
    def sense(self) -> np.ndarray:
        """Sense of each whirl, (ns, nd): "forward", "backward" (including a motion that does not oscillate), or for a straight
        line its angle, "straight at 90 deg"."""
        return _sense_words(self.forward, self.straight, self.angle)

    def summary(self) -> str:
        """Return the whirls at each rotor speed, and the critical speeds, as text."""
        lines, (unit, scale) = [], speed_unit()
        for n, *whirls in zip(*(np.asarray(x).tolist() for x in (self.rotor_speed, self.speed, self.sense)), strict=True):
            pairs = zip(*whirls, strict=True)
            shown = ", ".join(f"{scale * w:.6g} {'(overdamped)' if w == 0.0 else word}" for w, word in pairs)
            lines.append(f"rotor {scale * n:.6g} {unit}: whirl {shown} {unit}")
        lost = [self.message] if self.status_name != "done" else []
        return "\n".join([*lines, *lost, self.critical.summary()])

    @validated
    def plot(self, *, at: float | None = None, unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot the Campbell diagram: speeds of forward, backward and straight whirls over the rotor speed.

        Critical speeds are marked on the line on which the whirl frequency is equal to the rotor speed. A vertical line marks
        the working speed `at` if it is given.

        **Arguments**: `at`, rad/s; `unit` of the speeds. **Raises** `InputError` for whirls at a single rotor speed, and for an
        `at` that is not finite.
        """
        from jaxvib.draw.whirl import campbell_diagram  # slow import

        if self.rotor_speed.shape[0] < 2:
            problem = "is a single speed; a Campbell diagram needs several, such as numpy.linspace(0.0, 500.0, 101)"
            raise InputError("rotor_speed", problem)
        if at is not None and not np.isfinite(at):
            raise InputError("at", f"is {at:g} rad/s; it must be finite")
        critical = (np.asarray(self.critical.speed), self.critical.sense)
        whirls = map(np.asarray, (self.rotor_speed, self.speed, self.sense))
        return campbell_diagram(*whirls, critical=critical, at=at, unit=unit, ax=ax)


@validated
def whirl(scene: Scene, rotor_speed: Numbers | None = None, *, loads: LoadMasses = "fixed") -> Whirl:
    """Return the whirl frequencies of the scene's rotor, with its damping, at one or several rotor speeds.

        (K + i w (C + n G) - w^2 M) X = 0,      q = Re(X exp(i w t)),  w complex

    K, C, G and M are the stiffness, damping, gyroscopic and mass matrices of the machine, and n is the rotor speed. w is the
    complex whirl frequency; it is an eigenvalue of the first-order form of the equation.

    **Arguments**

    - `scene` with a machine that moves in two directions
    - `rotor_speed`, rad/s, one or a list (default: the drive's); typical: 50 values from 0 to 500 for a Campbell diagram
    - `loads`: "fixed": the masses of the loads are fixed to the axis of the rotor at their station (the default); "none":
      without the loads

    **Returns** `Whirl`. Speeds and decays have derivatives if no two of them are equal.

    **Raises** `InputError` for a machine that does not move in two directions or has a motion that no spring resists, and for
    values that are not allowed.

    >>> import jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=0.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=1, mass=0.5, radius=0.08, drag=0.1), jv.ConstantSpeed(460.0))
    >>> [round(float(w), 2) for w in jv.whirl(scene).speed[0]]
    [175.88, 175.88]

    Source: Artyunin 2013, section IV; free motion of equation (1).
    """
    model = _two_directions(scene)
    speeds = (
        model.scene.exciter.drive.speed[None]
        if rotor_speed is None
        else numbers(rotor_speed, "rad/s", "rotor_speed", None, low=0.0)
    )
    return outcome(_whirl(model, jnp.atleast_1d(speeds), loads), scene)


def _sense_words(forward: Array, straight: Array, angle: Array) -> np.ndarray:
    """Return "forward", "backward" or the angle of a straight line as text for each whirl."""
    lines = np.vectorize(lambda a: f"straight at {np.degrees(a) + 0.0:.0f} deg", otypes=[object])(np.round(angle, 6))
    return np.where(straight, lines, np.where(forward, "forward", "backward")).astype(str)


@cached
def _whirl(model: LinearModel, speeds: Array, loads: LoadMasses) -> Whirl:
    carrier, mass = model.carrier, _mass(model, loads)
    nd = mass.shape[0]
    gyroscopic = jnp.zeros_like(mass) if model.mount.gyroscopic is None else model.mount.gyroscopic
    size = _coupling_size(mass.dtype) * jnp.sqrt(jnp.trace(carrier.stiffness) * jnp.trace(mass))
    coupling = size * _sense_matrix(model.mount)

    def first_order(resisting: Array) -> Array:
        flow = jnp.linalg.solve(mass, jnp.concatenate([-carrier.stiffness, -resisting], axis=1))
        return jnp.concatenate([jnp.eye(nd, 2 * nd, nd, dtype=mass.dtype), flow])

    def one_of_each_pair(values: Array, kind: Array) -> tuple[Array, Array]:
        # Of each conjugate pair, the value with the positive frequency is chosen. Real values are of two kinds: a displacement
        # that creeps back (`kind` is small), and a velocity that decays (`kind` is large). Without gyroscopic coupling both
        # kinds have the same number of values, see `_kinds_and_errors`.
        oscillates = jnp.abs(values.imag) > 1e-12 * jnp.max(jnp.abs(values))
        rank = jnp.argsort(jnp.argsort(jnp.where(oscillates, jnp.inf, kind)))
        creeps = rank < jnp.sum(~oscillates) // 2
        speed = jnp.where(creeps, 0.0, jnp.where(oscillates & (values.imag > 0.0), values.imag, jnp.inf))
        return jnp.lexsort((-values.real, speed))[:nd], oscillates

    def at(n: Array) -> tuple[Array, ...]:
        resisting = carrier.damping + n * gyroscopic
        values = eigenvalues(first_order(resisting))
        # The coupling is too small to change the speeds. It separates two whirls of equal speed.
        coupled = jax.lax.stop_gradient(resisting + coupling)
        separated, vectors = jnp.linalg.eig(jax.lax.stop_gradient(first_order(coupled)))
        shapes = vectors[:nd]
        kind, error = _kinds_and_errors(jax.lax.stop_gradient((mass, coupled, carrier.stiffness)), separated, shapes)
        nearest = jnp.argmin(jnp.abs(values[:, None] - separated[None, :]), axis=1)
        chosen, oscillates = one_of_each_pair(values, kind[nearest])
        turns = oscillates[chosen]
        chosen_shapes = shapes[:, one_of_each_pair(separated, kind)[0]]
        straight = turns & _is_straight(model, chosen_shapes)
        return (
            jnp.where(turns, values.imag[chosen], 0.0),
            -values.real[chosen],
            turns & (_sense(model.mount, chosen_shapes) > 0.0) & ~straight,
            straight,
            jnp.where(straight, _line_angle(model, chosen_shapes), jnp.nan),
            jnp.where(turns, _directivity(model.mount, chosen_shapes), jnp.nan),
            ~(error[nearest][chosen] <= MAX_EIGENVALUE_ERROR),  # True for NaN
        )

    speed, decay, forward, straight, angle, directivity, lost = jax.vmap(at)(speeds)
    status = WhirlStatus.where(jnp.any(lost), WhirlStatus.lost_digits, WhirlStatus.done)
    speed, decay = (jnp.where(lost, jnp.nan, x) for x in (speed, decay))
    critical = _critical_speeds(model, loads)
    return Whirl(status, speeds, speed, decay, forward, straight, angle, directivity, critical)


def _coupling_size(dtype: np.dtype) -> float:
    return max(_COUPLING, _MIN_COUPLING_ROUNDINGS * float(jnp.finfo(dtype).eps))


def _kinds_and_errors(matrices: tuple[Array, Array, Array], values: Array, shapes: Array) -> tuple[Array, Array]:
    """Return the kind of each natural motion, and the relative error of its eigenvalue, from the `matrices` M, C (gyroscopic
    terms included) and K (nd, nd), the `values` s (k,) and the `shapes` x (nd, k).

        (s^2 M + s C + K) x = 0,      m s^2 + c s + k = 0 with m = x^H M x, c = x^H C x, k = x^H K x

    The kind is - Re(2 s + c/m), in the theory of Hermitian matrix polynomials the sign characteristic. An overdamped motion has
    two real roots. The kind is negative at the slower root, at which damping balances the spring, and positive at the faster
    root, at which damping stops the mass. This holds even if a slow root of one motion is larger than a fast root of another.
    The error is the step of Newton's method for the scalar equation, plus the rounding of its terms.
    """
    sizes = jnp.abs(shapes)
    m, c, k = (jnp.sum(shapes.conj() * (matrix @ shapes), axis=0) for matrix in matrices)
    rough = [jnp.sum(sizes * (jnp.abs(matrix) @ sizes), axis=0) for matrix in matrices]
    slope, length = jnp.abs(2.0 * m * values + c), jnp.abs(values)
    rounding = len(sizes) * jnp.finfo(sizes.dtype).eps * (rough[0] * length**2 + rough[1] * length + rough[2])
    residual = jnp.abs((m * values + c) * values + k) + rounding
    # If two roots are nearly equal, a residual r moves them by at most about sqrt(r/m), although the step of Newton is longer.
    step = jnp.minimum(residual / jnp.where(slope > 0.0, slope, 1.0), jnp.sqrt(residual / m.real))
    step = jnp.where(slope > 0.0, step, jnp.sqrt(residual / m.real))
    return -(2.0 * values + c / m).real, step / length


@validated
def critical_speeds(scene: Scene, *, loads: LoadMasses = "fixed") -> CriticalSpeeds:
    """Return the critical speeds, at which a whirl turns at the speed w of the rotor: (K - w^2 (M - i G)) X = 0.

    K, M and G are the stiffness, mass and gyroscopic matrices of the machine. The eigenproblem is Hermitian. On supports that
    are equal in both directions, the inertia of a forward tilt is the transverse inertia of the rotor minus the polar one, that
    of a backward tilt their sum. Supports that differ split each critical speed in two.

    **Arguments** as for `whirl`: `scene`; `loads` "fixed" or "none".

    **Returns** `CriticalSpeeds`; typical: 100 to 500 rad/s. **Raises** `InputError` in the cases of `whirl`.

    >>> import jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=0.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=1, mass=0.5, radius=0.08, drag=0.1), jv.ConstantSpeed(460.0))
    >>> [round(float(w), 2) for w in jv.critical_speeds(scene, loads="none").speed]
    [177.06, 177.06]

    Source: Artyunin 2013, section V.
    """
    return outcome(_critical_speeds(_two_directions(scene), loads), scene)


@cached
def _critical_speeds(model: LinearModel, loads: LoadMasses) -> CriticalSpeeds:
    carrier, mount, mass = model.carrier, model.mount, _mass(model, loads)
    inertia = mass if mount.gyroscopic is None else mass - 1j * mount.gyroscopic
    coupling = 1j * _coupling_size(mass.dtype) * jnp.trace(mass) * _sense_matrix(model.mount)
    values, _ = hermitian_modes(relative_to(carrier.stiffness, inertia)[0])
    square, inverse = relative_to(carrier.stiffness, jax.lax.stop_gradient(inertia - coupling))
    shapes = inverse.T @ hermitian_modes(square)[1]
    values, shapes = values[::-1], shapes[:, ::-1]
    # A whirl 1e7 times as fast as the slowest one counts as absent.
    limit = 1e-14 * jnp.max(values)
    exists, is_absent = values > limit, jnp.abs(values) < limit
    error = hermitian_error(jax.lax.stop_gradient((inertia, carrier.stiffness)), values, shapes)
    lost = ~is_absent & (error > 2.0 * MAX_EIGENVALUE_ERROR)
    speed = jnp.where(exists, 1.0 / jnp.sqrt(jnp.where(exists, values, 1.0)), jnp.inf)
    status = WhirlStatus.where(jnp.any(lost), WhirlStatus.lost_digits, WhirlStatus.done)
    straight = _is_straight(model, shapes)
    angle = jnp.where(straight, _line_angle(model, shapes), jnp.nan)
    return CriticalSpeeds(status, jnp.where(lost, jnp.nan, speed), (_sense(mount, shapes) > 0.0) & ~straight, straight, angle)


def _two_directions(scene: Scene) -> LinearModel:
    scene = validate_scene(scene)
    model = linear_model(scene)
    carrier = model.carrier
    if model.mount.axes != (0, 1):
        advice = "for its resonances use `jam_modes` (`jaxvib modes`); whirl needs a rotor such as rotor(...)"
        raise InputError("machine.kind", f"is {quoted(scene.machine.kind)}, which moves only up and down: {advice}")
    when_known(_require_springs, carrier.stiffness)
    return model if scene.exciter.direction == 1 else _mirrored(model)


def _mirrored(model: LinearModel) -> LinearModel:
    """Return the model of a clockwise rotor with the second direction of its mount reversed: the rotor then turns from the
    first direction to the second, as an anticlockwise rotor does."""
    mount = model.mount
    rows = tuple(row * np.array([[1.0], [-1.0]], row.dtype) for row in mount.rows)
    gyroscopic = None if mount.gyroscopic is None else -mount.gyroscopic
    return dataclasses.replace(model, mounts=(dataclasses.replace(mount, rows=rows, gyroscopic=gyroscopic),))


def _require_springs(stiffness: np.ndarray) -> None:
    """**Raises** `InputError` if a motion of the rotor has no spring, `ComputationError` for stiffnesses that overflow."""
    require_finite("stiffnesses of the machine", stiffness)
    if not _has_all_springs(stiffness):
        within, advice = (
            (", within single precision", ", or use double precision") if stiffness.dtype.itemsize < 8 else ("", "")
        )
        problem = f"leaves a motion of the rotor without a spring{within}; every motion needs one{advice}"
        raise InputError("machine.stiffness", problem)


def _has_all_springs(stiffness: np.ndarray) -> bool:
    """Return True if springs resist every motion, within rounding."""
    size = np.sqrt(np.where(np.diag(stiffness) > 0.0, np.diag(stiffness), 1.0))
    rounding = 4.0 * stiffness.shape[0] * np.finfo(stiffness.dtype).eps
    return bool(np.all(np.linalg.eigvalsh(stiffness / np.outer(size, size)) > rounding))


def _mass(model: LinearModel, loads: LoadMasses) -> Array:
    require_one_of(loads, ("fixed", "none"), "loads")
    return model.mass if loads == "fixed" else model.carrier.mass


def _sense_matrix(mount: Mount) -> Array:
    """Return a gyroscopic matrix (nd, nd) that separates whirls of one speed by their direction."""
    planes = jnp.stack(mount.rows)
    turn = planes[:, 0].T @ planes[:, 1]
    return turn - turn.T


def _sense(mount: Mount, shapes: Array) -> Array:
    """Return the area of the ellipses of shapes (nd, k), divided by pi: the sum over the displacement and the tilts of the
    axis, positive in the direction of the rotor."""
    moved = jnp.stack(mount.rows).astype(shapes.dtype) @ shapes
    return jnp.sum(jnp.imag(moved[:, 0] * jnp.conj(moved[:, 1])), axis=0)


def _directivity(mount: Mount, shapes: Array) -> Array:
    """Return (f - b)/(f + b) for shapes (nd, k), see `Whirl`."""
    moved = jnp.stack(mount.rows).astype(shapes.dtype) @ shapes
    forward, backward = (jnp.sqrt(jnp.sum(jnp.abs(moved[:, 0] + turn * moved[:, 1]) ** 2, axis=0)) for turn in (1j, -1j))
    return (forward - backward) / (forward + backward)


def _is_straight(model: LinearModel, shapes: Array) -> Array:
    """Return True for shapes (nd, k) in which the axis moves on straight lines, which needs supports that differ."""
    moved = jnp.stack(model.mount.rows).astype(shapes.dtype) @ shapes
    return jnp.abs(_sense(model.mount, shapes)) < _STRAIGHT * jnp.sum(jnp.abs(moved) ** 2, axis=(0, 1)) / 2.0


def _line_angle(model: LinearModel, shapes: Array) -> Array:
    """Return the angle, rad, of the straight line of each of the shapes (nd, k), from -pi/4 to 3 pi/4: neither 0 nor pi/2 is at
    a limit, where rounding errors would decide the sign."""
    x, y = jnp.moveaxis(jnp.stack(model.mount.rows).astype(shapes.dtype) @ shapes, 1, 0)
    # `_mirrored` has reversed the second direction of a clockwise rotor.
    product = 2.0 * model.scene.exciter.direction * jnp.sum((x * jnp.conj(y)).real, axis=0)
    angle = jnp.arctan2(product, jnp.sum(jnp.abs(x) ** 2 - jnp.abs(y) ** 2, axis=0)) / 2.0
    return jnp.mod(angle + jnp.pi / 4.0, jnp.pi) - jnp.pi / 4.0
