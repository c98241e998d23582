"""Response to unbalances over the speed, and the torque that it needs in comparison with that of the motor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import GRAVITIES, Drawn, Onto, SpeedUnit, quantity_text, speed_text
from jaxvib.equations.averaged import AVERAGED_TERMS, decays, require_rotating_masses
from jaxvib.equations.linear import peak_force
from jaxvib.equations.torque_balance import UnbalancedModel, common_speeds, common_torques, unbalanced_model
from jaxvib.errors import InputError
from jaxvib.machine.effects.terms import RotorImbalance
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.linalg import magnitude
from jaxvib.results.fields import in_unit, part
from jaxvib.results.readable import Readable
from jaxvib.results.result import Result
from jaxvib.results.status import status_names
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.folds import Pieces, branch_pieces, branch_root, grid_near_poles, resampled_grid, scanned_speed
from jaxvib.steady.outcome import REFUSED, outcome, require_index
from jaxvib.steady.regimes.local import regime_growth
from jaxvib.steady.regimes.synchronous import require_one_speed
from jaxvib.steady.vibration import Vibration, acceleration_of, rms_velocity_of
from jaxvib.units import Number, Numbers, count, number, numbers
from jaxvib.units.known import require_finite, when_known

_LENGTHS = ("displacement", "amplitude")
"""Fields of a response that are 0 at speed 0, except for those of a machine without supports."""

_RATES_AND_FORCES = ("acceleration", "velocity", "exciter_force", "foundation_force", "torque", "power")
"""Further fields of a response that are 0 at speed 0."""

_POINTS_PER_SIDE = 64
"""Number of speeds on each side of a resonance in the default range."""


class ResponseStatus(eqx.Enumeration):
    """Outcomes of a response at one speed. The value of each member is the message shown to the user."""

    done = "the vibration was computed"
    unbounded = "an undamped resonance: the vibration grows without bounds"
    refused = REFUSED


class AbstractResponse(Readable):
    """Vibration q = Re(displacement exp(i w t)) under unbalances that turn at the speed w, for several speeds.

    **Attributes** (nd coordinates, of which nt are displacements in m)

    - `speed` w, rad/s
    - `displacement` (nd,): complex amplitudes, m or rad; at w t = 0 an unbalance with the phase 0 is at the angle 0, which is
      the horizontal direction
    - `amplitude` (nd,), zero to peak, and `phase` (nd,) rad: moduli and arguments of `displacement`
    - `acceleration` (nt,), in g, and `velocity` (nt,), m/s root mean square, of the coordinates in m
    - `exciter_force` and `foundation_force`, N zero to peak: resultant of the centrifugal forces, and force on the foundation;
      in two directions: the root of the sum of the squares of their peaks (for a rotating force sqrt 2 times its magnitude)
    - `transmissibility`: `foundation_force` divided by `exciter_force`; inf if the centrifugal forces cancel
    - `torque` (exciter,), N m: mean torque that each rotor needs to sustain the vibration; `power` (exciter,), W
    - `motor_torque` (exciter,), N m: torque of each drive at this speed. The torque that motors lack (their `torque` minus
      their `motor_torque`) is supplied by the ideal drives in equal parts, in addition to the `torque` of their own rotors
    - `torque_share`: the sum of `torque` divided by that of `motor_torque`; inf above the no-load speed, where the motors brake

    At an undamped resonance the values other than `speed`, `exciter_force` and the `motor_torque` of motors are infinite.
    Values at speed 0 are the limits at low speeds: the transmissibility of a machine on springs is 1, and the amplitude of one
    without supports is S/M.
    """

    speed: Array = eqx.field(metadata=in_unit("rad/s", "*"))
    displacement: Array = eqx.field(metadata=in_unit("m or rad", "*", "coordinate"))
    amplitude: Array = eqx.field(metadata=in_unit("m or rad", "*", "coordinate"))
    phase: Array = eqx.field(metadata=in_unit("rad", "*", "coordinate"))
    acceleration: Array = eqx.field(metadata=in_unit(GRAVITIES, "*", "translation"))
    velocity: Array = eqx.field(metadata=in_unit("m/s", "*", "translation"))
    exciter_force: Array = eqx.field(metadata=in_unit("N", "*"))
    foundation_force: Array = eqx.field(metadata=in_unit("N", "*"))
    transmissibility: Array = eqx.field(metadata=in_unit("", "*"))
    torque: Array = eqx.field(metadata=in_unit("N m", "*", "exciter"))
    motor_torque: Array = eqx.field(metadata=in_unit("N m", "*", "exciter"))
    torque_share: Array = eqx.field(metadata=in_unit("", "*"))
    power: Array = eqx.field(metadata=in_unit("W", "*", "exciter"))

    @validated
    def vibration(self, index: int = 0) -> Vibration:
        """Return the vibration at the speed with this `index`, counted from 0, for `vibration_measures`.

        **Raises** `InputError` if there are fewer speeds.
        """
        require_index(index, self.speed.shape[0], "speeds")
        named = {name: getattr(self, name)[index] for name in Vibration._fields if name not in Vibration._field_defaults}
        return Vibration(**named)


class OperatingPoints(AbstractResponse):
    """Speeds at which the torques of the drives equal the torque that the vibration needs.

    **Additional attributes**, ascending in `speed`; entries whose `exists` is False are NaN

    - `exists`: True for an operating point
    - `growth`, 1/s, of the fastest growing small disturbance of the averaged motion (without disturbances of the differences
      of the phases, which are fixed), and `stable`: True if it is negative
    """

    outer_axes = ("operating_point",)

    exists: Array = eqx.field(metadata=in_unit("", "*"))
    growth: Array = eqx.field(metadata=in_unit("1/s", "*"))
    stable: Array = eqx.field(metadata=in_unit("", "*"))


class TorqueFolds(Readable):
    """Folds: speeds at which `torque_share` is a maximum (at a resonance) or a minimum (beyond it).

    **Attributes**: arrays of 2 nd entries, ascending in `speed`; a `TorqueTable` with n points adds up to n - 2 entries (at
    most 8); entries whose `exists` is False are NaN

    - `speed`, rad/s
    - `factor`: `torque_share` at the fold. With a motor of `factor` times the torque, two operating points merge here. At a
      maximum above 1 the resonance catches the rotor, and a motor that runs up slowly needs `factor` times its torque to pass
    - `torque`, N m, that the vibration needs at the fold
    - `lands_at`, rad/s: speed to which a motor of `factor` times the torque jumps, up from a maximum, down from a minimum; NaN
      if there is no such speed. `lands_at` has no derivatives
    - `exists`: True for a fold
    """

    speed: Array = eqx.field(metadata=in_unit("rad/s", "fold"))
    factor: Array = eqx.field(metadata=in_unit("", "fold"))
    torque: Array = eqx.field(metadata=in_unit("N m", "fold"))
    lands_at: Array = eqx.field(metadata=in_unit("rad/s", "fold"))
    exists: Array = eqx.field(metadata=in_unit("", "fold"))


class Response(AbstractResponse, Result):
    """Response to unbalances over the speed: the arrays of `AbstractResponse` with a leading axis over the speeds.

    Returned by `response`.

    **Additional attributes**

    - `status`: a `ResponseStatus` for each speed
    - `operating`: the `OperatingPoints`
    - `folds`: the `TorqueFolds`; no entries for an ideal drive
    - `resonances` (nd,), rad/s: natural frequencies, ascending
    - `scene`
    """

    outer_axes = ("speed",)

    status: ResponseStatus
    operating: OperatingPoints = eqx.field(metadata=part(prefix="operating_"))
    folds: TorqueFolds = eqx.field(metadata=part(prefix="fold_"))
    resonances: Array = eqx.field(metadata=in_unit("rad/s", "resonance"))
    scene: Scene = eqx.field(metadata=SCENE)

    def peaks(self) -> list[int]:
        """Return the indices of the speeds at which the foundation force has a maximum."""
        speed = np.asarray(self.speed)
        order = np.argsort(speed, kind="stable")
        # Two points at one speed, which may differ by rounding, would be a peak if their forces differ by rounding.
        order = order[np.diff(speed[order], prepend=-1.0) > 10.0 * np.finfo(speed.dtype).eps * speed[order]]
        force = np.asarray(self.foundation_force)[order]
        inner = (force[1:-1] > force[:-2]) & (force[1:-1] >= force[2:])
        return order[np.flatnonzero(inner) + 1].tolist()

    def summary(self) -> str:
        """Return the resonances, the operating points, the peaks of the force and the folds as text."""
        structure = self.scene.machine.structure()
        lines = [f"resonances {speed_text(self.resonances)}"]

        def motion(of: AbstractResponse, k: int) -> str:
            pairs = zip(structure.coordinates, np.asarray(of.amplitude)[k], structure.units, strict=True)
            moves = ", ".join(f"{name} {quantity_text(a, unit, 4)}" for name, a, unit in pairs)
            return f"{speed_text(of.speed[k])}: {moves}, foundation force {quantity_text(of.foundation_force[k], 'N', 4)}"

        for k in np.flatnonzero(np.asarray(self.operating.exists)).tolist():
            is_bounded = np.all(np.isfinite(self.operating.amplitude[k]))
            stable = "stable" if bool(self.operating.stable[k]) else "unstable" if is_bounded else "at an undamped resonance"
            share = f"{float(np.sum(self.operating.torque[k])):.4g} N m"
            lines.append(f"operating point, {stable}, {share}, at {motion(self.operating, k)}")
        lines += [f"peak of the force at {motion(self, k)}" for k in self.peaks()]
        for k in np.flatnonzero(np.asarray(self.folds.exists)):
            lands = float(self.folds.lands_at[k])
            jump = f", jump to {speed_text(lands)}" if np.isfinite(lands) else ""
            lines.append(
                f"fold at {speed_text(self.folds.speed[k])}: {float(self.folds.factor[k]):.4g} times the drive torque{jump}"
            )
        return "\n".join(lines)

    @validated
    def plot(
        self, *, unit: SpeedUnit | None = None, show: Sequence[str] = ("amplitude", "phase", "force", "torque"), ax: Onto = None
    ) -> Drawn:
        """Plot amplitudes, phases, foundation force and torque over the speed, with operating points and folds.

        **Arguments**

        - `unit` of the speeds, "rad/s", "rpm" or "Hz"
        - `show`: names of the panels, such as `("force",)`
        - `ax`: axes to draw onto, as many as there are panels

        **Raises** `InputError` for another unit, panel or number of axes.
        """
        from jaxvib.draw.motion.response import response_chart  # slow import

        structure, folds, exists = self.scene.machine.structure(), self.folds, np.asarray(self.operating.exists)
        names = ("speed", "amplitude", "phase", "foundation_force")

        def arrays(of: AbstractResponse) -> dict[str, np.ndarray]:
            return {name: np.asarray(getattr(of, name)) for name in names} | {"torque": np.sum(np.asarray(of.torque), axis=1)}

        points = arrays(self.operating) | {"stable": np.asarray(self.operating.stable)}
        points = {name: values[exists] for name, values in points.items()}
        is_ideal = any(exciter.drive.ideal for exciter in self.scene.exciters)
        return response_chart(
            arrays(self),
            points,
            {"speed": np.asarray(folds.speed), "torque": np.asarray(folds.torque)},
            np.asarray(self.resonances),
            names=structure.coordinates,
            units=structure.units,
            motors=0 if is_ideal else len(self.scene.exciters),
            motor={} if is_ideal else self._motor_curve(points),
            unit=unit,
            show=show,
            ax=ax,
        )

    def _motor_curve(self, points: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the torque of all motors over the speed. The speeds of the response lie close together at resonances only;
        those of the operating `points` let the curve pass through them."""
        speed, torque = (np.asarray(each) for each in _common_torques(self.scene))
        inside = speed <= np.max(self.speed)
        speeds = np.concatenate([self.speed, speed[inside], points["speed"]])
        torques = np.concatenate([np.sum(np.asarray(self.motor_torque), axis=1), torque[inside], points["torque"]])
        order = np.argsort(speeds)
        return {"speed": speeds[order], "torque": torques[order]}


@validated
def response(
    scene: Scene, speeds: Numbers | None = None, *, phases: Numbers | None = None, points: int = 500, most: Number | None = None
) -> Response:
    """Return the vibration of a machine under the unbalances of its exciters over their speed, and the torque that it needs.

        Y = w^2 D(w)^-1 f,    f = sum_k S_k exp(i alpha_k) B_k^T e_k,    D = K - w^2 M + i w (C + sigma w G)
        torque of exciter k = -(S_k/2) Im(exp(-i alpha_k) e_k^H B_k w^2 Y)

    The symbols are those of `synchronous_regimes`; Y are the complex amplitudes of the coordinates, and sigma is the mean of
    the directions of rotation (+1 or -1). The curve of the torque over the speed has a peak at each resonance (Sommerfeld
    effect). A motor can turn at the speeds at which its torque equals that of the curve, `operating`. If the torque of the
    motor changes, operating points appear and merge at the `folds` of the curve. The phases of several exciters are fixed, by
    gears or a common shaft: their torques are added, and they turn as one rotor with the sum of their inertias. For motors
    without gears use `synchronous_regimes`.

    **Arguments**

    - `scene`, whose exciters have an unbalance and no loads; its effects may be gravity, and static and moment imbalances of
      the rotors, which excite the machine as well
    - `speeds`, rad/s, one or a list; typical: 100 to 1000 values; default: `points` speeds from a thousandth of the lowest
      resonance to `most`, denser near resonances
    - `phases` (exciter,), rad or text, of the unbalances, each in its direction of rotation; the phases are the same at all
      speeds; default: 0
    - `points`: number of the default speeds; typical: 200 to 2000 (default: 500)
    - `most`: highest of the default speeds, rad/s or text; default: 4/3 of the working speed

    **Returns** `Response`. Derivatives with respect to all parameters of the scene are exact, except for `growth`, `stable` and
    `lands_at`, which have none. An undamped resonance has the status `unbounded` and infinite values.

    **Raises** `InputError` for exciters with loads, for effects that this function does not include, for ideal drives of
    different speeds, and for several motors whose torques have the sum 0 at several speeds; `ComputationError` with the status
    "overflow" if a value exceeds the range of floating-point numbers.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=200.0, stiffness=8e5, damping=600.0)                      # resonance at 604 rpm
    >>> weak = jv.DCMotor("1500 rpm", stall_torque=12.0, inertia=0.1)
    >>> found = jv.response(jv.Scene(machine, exciters=[jv.Exciter(drive=weak, unbalance=0.2)]))
    >>> [round(float(w), 2) for w in found.operating.speed[found.operating.exists]]   # caught below 604 rpm; unstable; passed
    [62.69, 63.96, 156.2]
    >>> [round(float(f), 3) for f in found.folds.factor]
    [1.179, 0.019]

    Source: Sommerfeld 1902; I. I. Blekhman, Vibrational Mechanics, 2000, for the torque; the folds are those of `branches`.
    """
    scene = validate_scene(scene)
    require_unbalances(scene)
    require_one_speed(scene)
    _require_one_no_load_speed(scene)
    n = len(scene.exciters)
    angles = jnp.zeros(n, scene.top_speed.dtype) if phases is None else numbers(phases, "rad", "phases", n)
    top = None if most is None else number(most, "rad/s", "most", low=0.0, open_low=True)
    size = count(points, "points", low=2, each=1e3)
    if speeds is None:
        w = _default_speeds(scene, scene.top_speed * 4.0 / 3.0 if top is None else top, size)
    else:
        w = jnp.atleast_1d(numbers(speeds, "rad/s", "speeds", None, low=0.0))
    require_finite("speeds of the response", w)
    found = outcome(_response(scene, w, angles), scene)
    when_known(lambda *_: _require_no_overflow(found, scene.machine.has_foundation), found.exciter_force)
    return found


def _require_no_overflow(found: Response, has_foundation: bool) -> None:
    """**Raises** `ComputationError` for values that are not finite. Allowed are the infinite values at an undamped resonance
    and the force on an unknown foundation, NaN."""
    done = status_names(found.status) == "done"
    values = (found.amplitude, found.torque, *((found.foundation_force,) if has_foundation else ()))
    require_finite("values of the response", found.exciter_force, *(np.asarray(each)[done] for each in values))


def require_unbalances(scene: Scene) -> None:
    """**Raises** `InputError` for exciters with loads, and for effects that the response does not include."""
    for k, exciter in enumerate(scene.exciters):
        if exciter.loads is not None:
            for_loads = "branches (command modes)" if scene.is_plain else "synchronous_regimes (command regimes) or simulate"
            problem = f"turn at a speed of their own; this function needs unbalances; for loads use {for_loads}"
            raise InputError(f"{scene.prefix_of(k)}loads", problem)
    require_rotating_masses(scene, (*AVERAGED_TERMS, RotorImbalance))


def _require_one_no_load_speed(scene: Scene) -> None:
    """**Raises** `InputError` for several motors whose torques have the sum 0 at several speeds, if they are known."""
    if len(scene.exciters) == 1 or any(exciter.drive.ideal for exciter in scene.exciters):
        return

    def check(speeds: np.ndarray, total: np.ndarray) -> None:
        rises = np.flatnonzero((total[:-1] < 0.0) & (total[1:] > 0.0))
        if rises.size:
            problem = f"brake each other at {speed_text(speeds[rises[0]])}, and drive again at a higher speed"
            advice = "give motors on one shaft similar speeds, or compute one of them alone"
            raise InputError("exciters.drive", f"{problem}; {advice}")

    when_known(check, *_common_torques(scene))


@cached
def _common_torques(scene: Scene) -> tuple[Array, Array]:
    drives = tuple(exciter.drive.at_working_speed() for exciter in scene.exciters)
    return common_speeds(drives), common_torques(drives)


@cached
def _default_speeds(scene: Scene, top: Array, points: int) -> Array:
    model = unbalanced_model(scene, jnp.zeros(len(scene.exciters), top.dtype)).decomposed()
    grid, _ = grid_near_poles(model, _POINTS_PER_SIDE, top)
    return resampled_grid(grid, points, top)


@cached
def _response(scene: Scene, speeds: Array, phases: Array) -> Response:
    model = unbalanced_model(scene, phases).decomposed()
    resonances = jax.lax.stop_gradient(model).modes()[0]
    status, curve = jax.vmap(partial(motion_at, model))(jnp.where(speeds > 0.0, speeds, _slow_speed(resonances)))
    rests, moves = speeds == 0.0, resonances[0] == 0.0
    for name in (*_LENGTHS, *_RATES_AND_FORCES):
        is_zero = rests & ~moves if name in _LENGTHS else rests
        is_zero = is_zero.reshape((-1,) + (1,) * (curve[name].ndim - 1))
        curve[name] = jnp.where(is_zero, 0.0 * curve[name], curve[name])  # an unknown force stays NaN
    operating, folds = operation_of(model)
    fields = curve | {"speed": speeds}
    return Response(**fields, status=status, operating=operating, folds=folds, resonances=resonances, scene=scene)


def _slow_speed(resonances: Array) -> Array:
    """Return a speed, rad/s, so low that a response differs from its limit at speed 0 by at most about 1e-9 (phases: 1e-5) in
    double precision."""
    lowest = jnp.min(jnp.where(resonances > 0.0, resonances, jnp.inf))
    return float(jnp.finfo(lowest.dtype).eps) ** 0.3 * jnp.where(jnp.isfinite(lowest), lowest, 1.0)


def motion_at(model: UnbalancedModel, omega: Array) -> tuple[ResponseStatus, dict[str, Any]]:
    """Return the status and the fields of `AbstractResponse` at one speed, rad/s."""
    # Within a few units in the last place of the speed of an undamped resonance, the amplitude consists of rounding errors.
    size = jnp.max(magnitude(model.force_direction)) / jnp.min(jnp.diagonal(model.mass))
    trial = magnitude(jax.lax.stop_gradient(model).displacement(jax.lax.stop_gradient(omega)))
    bounded = jnp.all(trial * 100.0 * jnp.finfo(size.dtype).eps <= size)  # both are 0 if the forces cancel
    z = model.displacement(jnp.where(bounded, omega, 1.01 * omega + 1.0))
    lengths = np.flatnonzero(np.asarray(model.carrier.units) == "m")
    amplitude = magnitude(z)
    exciter, force = peak_force(model.resultant * omega**2), peak_force(model.vibration_force(z, omega))
    torque = model.required_torque(omega, z)
    motor = model.drive_torque(omega, torque)
    forced = exciter > 0.0
    ratio = jnp.where(forced, force / jnp.where(forced, exciter, 1.0), jnp.inf)
    share, needed = jnp.ones_like(omega), jnp.sum(torque)
    if model.highest_speed is not None:
        share = jnp.where((jnp.sum(motor) < 0.0) & (needed > 0.0), jnp.inf, needed / model.motor_torque(omega))
    fields = {
        "displacement": z,
        "amplitude": amplitude,
        "phase": jnp.angle(jnp.where(z == 0.0, 1.0, z)),
        "acceleration": acceleration_of(amplitude[lengths], omega),
        "velocity": rms_velocity_of(amplitude[lengths], omega),
        "foundation_force": force,
        "transmissibility": ratio,
        "torque": torque,
        "torque_share": share,
        "power": omega * torque,
    }
    finite = {name: jnp.where(bounded, value, jnp.inf) for name, value in fields.items()}
    if model.highest_speed is None:
        motor = jnp.where(bounded | ~model.balance.is_prescribed, motor, jnp.inf)
    status = ResponseStatus.where(bounded, ResponseStatus.done, ResponseStatus.unbounded)
    return status, {**finite, "speed": omega, "exciter_force": exciter, "motor_torque": motor}


def operation_of(model: UnbalancedModel) -> tuple[OperatingPoints, TorqueFolds]:
    """Return the operating points and the folds."""
    none = jnp.zeros(0, model.mass.dtype)
    no_folds = TorqueFolds(none, none, none, none, none.astype(bool))
    if model.highest_speed is None:
        working = model.shaft.speed[None]
        return _operating_points(model, working, jnp.ones(1, bool)), no_folds
    pieces = branch_pieces(model)
    speed, exists = _balanced_speeds(model, pieces)
    folds = pieces.folds
    torque = folds.rotor_speed * jax.vmap(model.motor_torque)(folds.omega)
    lands = _landing_speeds(jax.lax.stop_gradient(model), jax.lax.stop_gradient(pieces))
    # A motor that drives at no speed, because it is switched off, has no folds.
    drives = jax.vmap(lambda w: jnp.sum(model.balance.driving_torque(w)) > 0.0)(folds.omega)
    omega, factor, torque, lands = (
        jnp.where(drives, value, jnp.nan) for value in (folds.omega, folds.rotor_speed, torque, lands)
    )
    return _operating_points(model, speed, exists), TorqueFolds(omega, factor, torque, lands, folds.exists & drives)


def _balanced_speeds(model: UnbalancedModel, pieces: Pieces) -> tuple[Array, Array]:
    """Return the speed on each piece of the curve at which the motor supplies the required torque, and True if it exists."""
    top = model.shaft.speed
    # The grid ends just below the no-load speed, at which the torque of the motor vanishes. The root of the last piece can lie
    # between these two speeds.
    high = jax.lax.stop_gradient(jnp.where(pieces.high < pieces.high[-1], pieces.high, top))
    gaps = (jax.vmap(partial(_torque_gap, model))(w) for w in (pieces.low, high))
    low_gap, high_gap = (jax.lax.stop_gradient(gap) for gap in gaps)
    # At speed 0 no vibration needs a torque; the amplitude of a machine without supports is 0/0 there.
    low_gap = jnp.where(pieces.low > 0.0, low_gap, -jnp.sum(model.balance.driving_torque(jnp.zeros_like(top))))
    high_gap = jnp.where(high < top, high_gap, jnp.maximum(high_gap, 0.0))
    root = partial(branch_root, model, _torque_gap, _scanned_gap)
    exists = (pieces.high > pieces.low) & (low_gap * high_gap <= 0.0)
    return jax.vmap(root)(pieces.low, high, (low_gap, high_gap)), exists


def _torque_gap(model: UnbalancedModel, omega: Array) -> Array:
    """Return the required torque minus that of the motor, N m."""
    required = jnp.sum(model.required_torque(omega, model.displacement(omega)))
    return required - jnp.sum(model.balance.driving_torque(omega))


def _scanned_gap(model: UnbalancedModel, omega: Array) -> Array:
    """Return `_torque_gap` in modal form, for a search."""
    required = scanned_speed(model, omega) * model.motor_torque(omega)
    return required - jnp.sum(model.balance.driving_torque(omega))


def _landing_speeds(model: UnbalancedModel, pieces: Pieces) -> Array:
    """Return the speed to which the rotor jumps from each fold, (2 nd,) rad/s: the nearest one on a rising piece with the same
    share of the torque, above a maximum or below a minimum; NaN if there is none."""
    number = np.arange(pieces.low.shape[0])
    rising = (number % 2 == 0) & (pieces.high > pieces.low)

    def landing(fold: Array, share: Array, exists: Array) -> Array:
        covers = rising & (pieces.speed_low <= share) & (share <= pieces.speed_high)
        up = covers & (number > fold + 1) & (fold % 2 == 0)
        down = covers & (number < fold) & (fold % 2 == 1)
        at = jnp.where(fold % 2 == 0, jnp.argmax(up), number[-1] - jnp.argmax(down[::-1]))

        def gap(model: UnbalancedModel, omega: Array) -> Array:
            return scanned_speed(model, omega) - share

        ends = pieces.speed_low[at] - share, pieces.speed_high[at] - share
        root = branch_root(model, gap, gap, pieces.low[at], pieces.high[at], ends)
        return jnp.where(exists & jnp.any(up | down), root, jnp.nan)

    folds = pieces.folds
    return jax.vmap(landing)(jnp.asarray(number[:-1]), folds.rotor_speed, folds.exists)


def _operating_points(model: UnbalancedModel, speed: Array, exists: Array) -> OperatingPoints:
    """Return the operating points at the speeds, rad/s, for which `exists` is True."""
    order = jnp.argsort(jnp.where(exists, speed, jnp.inf))
    speed, exists = speed[order], exists[order]
    safe = jnp.where(exists, speed, model.shaft.speed)
    fields = jax.vmap(partial(motion_at, model))(safe)[1]
    frozen, at = jax.lax.stop_gradient((model.shaft, safe))
    growth = jax.vmap(lambda w: regime_growth(frozen, w, jnp.zeros(1, w.dtype), 0))(at) if at.size else at

    def nan_if_absent(value: Array) -> Array:
        return jnp.where(exists.reshape(exists.shape + (1,) * (value.ndim - 1)), value, jnp.nan)

    return OperatingPoints(
        **{name: nan_if_absent(value) for name, value in fields.items()},
        exists=exists,
        growth=nan_if_absent(growth),
        stable=exists & decays(growth, at),
    )
