"""Regime of a motion (swinging, jammed, balanced, ...) with the quantities from which it follows."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, quantity_text, speed_text
from jaxvib.equations.linear import estimated_frequencies
from jaxvib.machine.carrier import scaled
from jaxvib.machine.effects.base import terms_of
from jaxvib.machine.effects.terms import RotorImbalance
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.motion.analysis.measure import STILL_SHARE, Trajectory, mean_speeds
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import sentence, status_name
from jaxvib.runtime.compat import enumeration_names
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.phases import PhasePattern, degrees, phase_pattern
from jaxvib.steady.whirl import whirl

_MAX_EQUAL_SPEED_DIFFERENCE = 3e-3
"""Relative difference below which two speeds count as equal: those of two loads, of a load and the rotor, or of a load in the
first and the second half of the window."""

_MAX_JAM_CHANGE = 0.02
"""Change of the common speed of the loads from the first to the second half of the window, relative to this speed, up to which
they count as jammed. Slow loads that still accelerate change their speed by little in comparison with the rotor speed."""

_LOCKED_PHASE_CHANGE = 0.1
"""Change of the relative phases, rad, from one half of the window to the other below which they count as constant."""

_MAX_LAG_CHANGE = 0.02
"""Relative difference between the lags of a load (angles by which it falls behind the rotor) in the two halves of the window,
below which the lag is steady. A load with a steady lag is jammed, even if the lag is small."""

_MAX_BACKWARD_DIRECTIVITY = -0.98
"""Directivity of a whirl up to which it counts as a backward circle, that is with at most 1 % of forward motion."""

_EQUAL_FREQUENCIES = 1e-6
"""Relative difference of natural frequencies up to which they count as equal."""

_BALANCED_UNBALANCE_SHARE = 0.02
"""Residual unbalance below which loads count as balancing the rotor, relative to the unbalance of all loads at one angle."""


class RegimeName(eqx.Enumeration):
    """Kinds of motion. The value of each member is the message shown to the user."""

    swinging = "the loads swing and do not rotate"
    jammed = "the loads are jammed: they turn together, slower than the rotor"
    unbalanced = "the loads turn with the rotor, which is not balanced"
    balanced = "the loads turn with the rotor and balance it"
    parted = "the loads have separated: they turn at different speeds that no longer change"
    unsettled = "the loads have not reached a steady motion"


REGIMES = enumeration_names(RegimeName)
"""Short names of the members of `RegimeName`, in their order."""


class Regime(Result):
    """Kind of motion over a part of a run, with the quantities from which it follows.

    Returned by `regime` and `Run.regime`.

    **Attributes**

    - `name`: a `RegimeName`, for comparisons such as `name == jv.RegimeName.jammed`; for texts `label` is its short name
      ("jammed"), and `message` its sentence
    - `pattern`: a `PhasePattern` of the loads
    - `load_speed` (count,): mean speeds of the loads over whole turns, and `rotor_speed`, rad/s
    - `ripple`: largest ripple of the speed of a load (half of peak to peak), rad/s
    - `phase` (count,), rad: mean angle of each load relative to the rotor if all loads turn with it, otherwise relative to the
      first load
    - `unbalance`: residual unbalance of loads and rotor in the frame of the rotor, relative to that of all loads at one angle;
      balanced below 0.02
    - `total_load_unbalance`: sum of the unbalances of all loads, kg m
    - `load_unbalance` (count,): unbalance of each load relative to this sum
    - `imbalance`: static imbalance of the rotor relative to this sum, complex, in the frame of the rotor
    - `resonance`: number of the natural frequency nearest to the loads' mean speed, counted from 1; `resonance_speed`, rad/s
    - `mode`: estimated number of the jam mode; 0 if the loads are not jammed. Let natural frequency k be the last one below the
      mean load speed. Mode 2 k begins at this frequency; mode 2 k + 1 ends at the next one, or at the rotor speed if that is
      lower. The estimate is mode 2 k if the mean load speed is nearer to its beginning than to the end of mode 2 k + 1,
      otherwise mode 2 k + 1. Beyond the last of nd frequencies, loads close to the rotor speed are therefore in mode 2 nd + 1
    - `caught`: True if the rotor itself stays at a resonance, below the no-load speed of its motor
    - `change`: largest change of a load's mean speed from the first to the second half, relative to the rotor speed; the motion
      is steady below 0.003. If all loads turn with the rotor, it is at least the largest change of their mean phases, rad
    """

    name: RegimeName
    pattern: PhasePattern
    load_speed: Array = eqx.field(metadata=in_unit("rad/s", "load"))
    rotor_speed: Array = eqx.field(metadata=in_unit("rad/s"))
    ripple: Array = eqx.field(metadata=in_unit("rad/s"))
    phase: Array = eqx.field(metadata=in_unit("rad", "load"))
    unbalance: Array = eqx.field(metadata=in_unit(""))
    total_load_unbalance: Array = eqx.field(metadata=in_unit("kg m"))
    load_unbalance: Array = eqx.field(metadata=in_unit("", "load"))
    imbalance: Array = eqx.field(metadata=in_unit(""))
    resonance: Array = eqx.field(metadata=in_unit(""))
    resonance_speed: Array = eqx.field(metadata=in_unit("rad/s"))
    mode: Array = eqx.field(metadata=in_unit(""))
    caught: Array = eqx.field(metadata=in_unit(""))
    change: Array = eqx.field(metadata=in_unit(""))

    @property
    def status(self) -> RegimeName:
        """Kind of motion: `name`, which is the status of this result."""
        return self.name

    @property
    def label(self) -> str:
        """Short name of the regime: "swinging", "jammed", "unbalanced", "balanced", "parted" or "unsettled"."""
        return status_name(self.name)

    @property
    def pattern_label(self) -> str:
        """Short name of the pattern: "together", "opposite", "spread" or "other"."""
        return status_name(self.pattern)

    def summary(self) -> str:
        """Return the kind of motion and the quantities from which it follows as text."""
        pattern = self._pattern_text()
        loads, rotor = (speed_text(speed) for speed in (self.load_speed, self.rotor_speed))
        evidence = [f"loads {loads}, rotor {rotor}, ripple {speed_text(self.ripple, 2)}"]
        if bool(self.name == RegimeName.jammed):
            # Mode 2 k + 1 begins above natural frequency k.
            relation = "beyond" if int(self.mode) == 2 * int(self.resonance) + 1 else "by"
            speed = speed_text(self.resonance_speed)
            place_text = f"{relation} resonance {int(self.resonance)} at {speed} (mode {int(self.mode)})"
            evidence += [place_text, pattern]
        if bool(self.name == RegimeName.balanced) or bool(self.name == RegimeName.unbalanced):
            evidence += [self._remainder_text(), pattern]
        if bool(self.caught):
            evidence.append("the rotor itself is caught at a resonance, below the speed of its motor")
        if abs(float(self.rotor_speed)) > STILL_SHARE * float(self.resonance_speed):
            evidence.append(f"speeds change by {float(self.change):.1e}")
        return f"{self.message} ({'; '.join(evidence)})"

    def _pattern_text(self) -> str:
        if not bool(self.pattern == PhasePattern.other):
            return sentence(self.pattern)
        frame = "relative to load 1" if bool(self.name == RegimeName.jammed) else "in the rotor"
        angles = ", ".join(f"{degrees(float(a)) % 360.0:.4g}" for a in self.phase)
        return f"at {angles} deg {frame}"

    def _remainder_text(self) -> str:
        share = float(self.unbalance)
        # Loads at one angle add at most their own unbalance to that of the rotor.
        cause = ": the imbalance of the rotor exceeds what the loads can balance" if share > 2.005 else ""
        return f"the remaining unbalance is {self.unbalance_text(share)}{cause}"

    @property
    def _with_moments(self) -> bool:
        """True if `unbalance` of a rotor that tilts is a moment, larger than the static share."""
        static = abs(np.sum(np.asarray(self.load_unbalance) * np.exp(1j * np.asarray(self.phase))) + complex(self.imbalance))
        return float(self.unbalance) > static + _BALANCED_UNBALANCE_SHARE

    def unbalance_text(self, share: float) -> str:
        """Return an unbalance with a `share` of that of all loads as text, with the unbalance of the rotor beside it."""
        total, own = float(self.total_load_unbalance), abs(complex(self.imbalance))
        relative = f"{100.0 * share:.3g} % of" if share < 1.005 else f"{share:.2g} times"
        size = "with moments, " if self._with_moments else f"{quantity_text(share * total, 'kg m', 3)}, "
        rotor = f" (the rotor alone has {quantity_text(own * total, 'kg m', 3)})" if own > 0.0 else ""
        return f"{size}{relative} that of all loads{rotor}"

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the loads on a circle at their `phase`, relative to the first load or to the rotor.

        An arrow shows the mean of the loads. If all loads turn with the rotor, a second arrow shows the `imbalance` of the
        rotor, and the title states the remaining unbalance. For a rotor that tilts this includes moments, unlike the arrows.
        """
        from jaxvib.draw.results import phase_circles  # slow import

        title, weight, imbalance = self.label, np.asarray(self.load_unbalance), 0.0
        if title in ("balanced", "unbalanced"):
            imbalance, share = complex(self.imbalance), float(self.unbalance)
            title += f"\n{100.0 * share:.2g} % of the loads' unbalance left{', with moments' if self._with_moments else ''}"
        return phase_circles([(title, np.asarray(self.phase))], weights=weight, imbalance=imbalance, ax=ax)


@validated
def regime(scene: Scene, segment: Trajectory) -> Regime:
    """Return the kind of motion over a part of a run.

    - Loads that make less than one turn swing
    - Loads turn with the rotor if their mean speed differs from the rotor speed by less than 0.3 %, unless they fall behind
      steadily: by more than 0.1 rad over the part, with lags in its two halves that agree within 2 %
    - They balance the rotor if the residual unbalance of loads and rotor together is less than 2 % of the unbalance of the
      loads. For a rotor that tilts the same applies to their moments
    - Loads that all turn at another speed with constant relative phases are jammed
    - A motion is not steady if the speed of a load changes by more than 0.3 % of the rotor speed from one half of the part to
      the other, or if the common speed of loads that turn together changes by more than 2 % of itself

    **Arguments**

    - `scene` of the run
    - `segment`: the part of the run, a `Trajectory` such as `run.window`; typical: 20 or more turns

    **Returns** `Regime`; `jit` and `vmap` are supported. If the motion is not steady, or unknown because the run failed, `name`
    is "unsettled" and no error is raised. **Raises** `InputError` for a scene that is not plain, see `Scene.is_plain`.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> run = jv.simulate(scene, 10.0, start="jam", mode=1)
    >>> bool(run.regime.name == jv.RegimeName.jammed), int(run.regime.mode)
    (True, 1)
    """
    scene = validate_scene(scene)
    _ = scene.exciter  # raises an error for several exciters
    return _regime(scene, segment)


@cached
def _regime(scene: Scene, segment: Trajectory) -> Regime:
    times, state = segment.time, segment.state
    phi, rate = state.azimuth, state.azimuth_rate
    half, end = times.shape[0] // 2, times.shape[0] - 1
    turn = segment.rotor_angle

    angles, rates = jnp.column_stack([phi, turn]), jnp.column_stack([rate, segment.rotor_speed])
    whole, early, late = mean_speeds(times, angles, rates, first=(0, 0, half), last=(end, half - 1, end))
    speed, rotor = whole[:-1], whole[-1]
    mean, reference = jnp.mean(speed), jnp.maximum(jnp.abs(rotor), jnp.finfo(rotor.dtype).tiny)
    change = jnp.max(jnp.abs(late - early)[:-1]) / reference
    is_steady = change < _MAX_EQUAL_SPEED_DIFFERENCE
    # XLA's maximum of NaN is -inf on CPUs.
    is_known = jnp.isfinite(speed)
    swings = is_known & (jnp.max(phi, axis=0) - jnp.min(phi, axis=0) < 2.0 * jnp.pi)
    lags = [speeds[:-1] - speeds[-1] for speeds in (early, late)]
    is_behind = jnp.abs(phi[-1] - phi[0] - (turn[-1] - turn[0])) > _LOCKED_PHASE_CHANGE
    is_behind = is_behind & (jnp.abs(lags[1] - lags[0]) < _MAX_LAG_CHANGE * jnp.abs(lags[1] + lags[0]) / 2.0)
    with_rotor = (jnp.abs(speed - rotor) < _MAX_EQUAL_SPEED_DIFFERENCE * reference) & ~is_behind
    all_with_rotor = jnp.all(with_rotor)
    # Circular means of phi_j - phi_1. If the means of the two halves differ, the phase is not constant.
    to_first, load_phase_change = _mean_phases(phi - phi[:, :1], half)
    to_rotor, rotor_phase_change = _mean_phases(phi - turn[:, None], half)
    has_one_speed = (jnp.max(speed) - jnp.min(speed) < _MAX_EQUAL_SPEED_DIFFERENCE * reference) & (
        jnp.max(load_phase_change) < _LOCKED_PHASE_CHANGE
    )

    unbalances, imbalance = _unbalances(scene, turn)
    size = jnp.sum(jnp.abs(unbalances))
    unbalance = _unbalance(scene, unbalances * jnp.exp(1j * to_rotor), imbalance, turn)
    name = RegimeName.where(is_steady, RegimeName.parted, RegimeName.unsettled)
    keeps_speed = jnp.abs(jnp.mean((late - early)[:-1])) < _MAX_JAM_CHANGE * jnp.abs(mean)
    jam = RegimeName.where(keeps_speed, RegimeName.jammed, RegimeName.unsettled)
    name = RegimeName.where(is_steady & has_one_speed & ~jnp.any(with_rotor), jam, name)
    name = RegimeName.where(
        is_steady & all_with_rotor,
        RegimeName.where(unbalance < _BALANCED_UNBALANCE_SHARE, RegimeName.balanced, RegimeName.unbalanced),
        name,
    )
    name = RegimeName.where(jnp.all(swings), RegimeName.swinging, name)

    natural = excited_frequencies(scene, rotor)
    nearest = jnp.argmin(jnp.abs(natural - mean))
    return Regime(
        name=name,
        pattern=phase_pattern(jnp.where(all_with_rotor, to_rotor, to_first)),
        load_speed=speed,
        rotor_speed=rotor,
        ripple=jnp.where(jnp.all(is_known), jnp.max(jnp.max(rate, axis=0) - jnp.min(rate, axis=0)) / 2.0, jnp.nan),
        phase=jnp.where(all_with_rotor, to_rotor, to_first),
        unbalance=unbalance,
        total_load_unbalance=size,
        load_unbalance=unbalances / size,
        imbalance=imbalance / size,
        resonance=nearest + 1,
        resonance_speed=natural[nearest],
        mode=jnp.where(name == RegimeName.jammed, estimated_mode(natural, mean, rotor), 0),
        caught=_is_rotor_caught(scene, natural, rotor),
        change=jnp.maximum(change, jnp.where(all_with_rotor, jnp.max(rotor_phase_change), 0.0)),
    )


def estimated_mode(natural: Array, mean: Array, rotor: Array) -> Array:
    """Return the estimated jam mode of loads with the mean speed `mean`, rad/s, see `mode` of `Regime`; `natural`: natural
    frequencies, rad/s, ascending, infinite for missing ones."""
    ends = jnp.concatenate([jnp.zeros_like(natural[:1]), natural, jnp.full_like(natural[:1], jnp.inf)])
    below = jnp.sum(natural <= mean)
    rises = jnp.minimum(ends[below + 1], rotor) - mean < mean - ends[below]
    first_of_equal = 1 + jnp.sum(natural < ends[below] * (1.0 - _EQUAL_FREQUENCIES))
    return jnp.where(rises | (below == 0), 2 * below + 1, 2 * first_of_equal)


def _is_rotor_caught(scene: Scene, natural: Array, rotor: Array) -> Array:
    """Return True if the rotor of a motor is caught at a resonance: its speed is at most 15 % below or 2 % above the resonance,
    and more than 5 % below the no-load speed of the motor."""
    if scene.drive.ideal:
        return jnp.zeros((), bool)
    return jnp.any((rotor > 0.85 * natural) & (rotor < 1.02 * natural)) & (rotor < 0.95 * scene.drive.speed)


def _mean_phases(angle: Array, half: int) -> tuple[Array, Array]:
    """Return the circular means (count,), rad, of angles (nt, count), and their changes from the first to the second half."""
    point = jnp.exp(1j * angle)
    early, late = jnp.mean(point[:half], axis=0), jnp.mean(point[half:], axis=0)
    return jnp.angle(jnp.mean(point, axis=0)), jnp.abs(jnp.angle(late * jnp.conj(early)))


def balancing_time_text(scene: Scene, motion: Regime, trajectory: Trajectory | None) -> str:
    """Return the time after which the loads balance the rotor as text; an empty text for another `motion` at the end, and for a
    run without a `trajectory`."""
    if trajectory is None or not bool(motion.name == RegimeName.balanced):
        return ""
    away = np.flatnonzero(np.asarray(_unbalance_history(scene, trajectory)) >= _BALANCED_UNBALANCE_SHARE)
    time = np.asarray(trajectory.time)
    if not away.size or away[-1] + 1 == time.size:
        return ""
    left = motion.unbalance_text(_BALANCED_UNBALANCE_SHARE)
    return f"balanced from {time[away[-1] + 1]:.4g} s on: the remaining unbalance is below {left}"


@cached
def _unbalance_history(scene: Scene, trajectory: Trajectory) -> Array:
    turn = trajectory.rotor_angle
    unbalances, imbalance = _unbalances(scene, turn)
    in_rotor = jnp.exp(1j * (trajectory.state.azimuth - turn[:, None]))
    return jax.vmap(lambda direction: _unbalance(scene, unbalances * direction, imbalance, turn))(in_rotor)


def _unbalances(scene: Scene, turn: Array) -> tuple[Array, Array]:
    """Return the unbalances of the loads (count,), kg m, and the static imbalance of the rotor, complex, in its frame."""
    loads, origin = scene.loads, jnp.zeros_like(turn[0])
    static = [term.at(origin).static for term in terms_of(scene.all_effects, RotorImbalance)]
    imbalance = sum((x + 1j * y for x, y in static), jnp.zeros_like(1j * origin))
    return jnp.broadcast_to(loads.mass * loads.arm(), (loads.count,)), imbalance


def _unbalance(scene: Scene, unbalances: Array, rotor_unbalance: Array, turn: Array) -> Array:
    """Return the residual unbalance of the loads and the rotor, relative to that of all loads at one angle.

    `unbalances` (count,) and `rotor_unbalance` are complex. For a rotor that tilts, the result is the larger of this value and
    the relative residual moment. The residual moment is that of all unbalances about the reference point of the mount. It is
    divided by the largest moment that the loads can have, or, if all levers of the loads are 0, by the unbalance of the loads
    times the radius of gyration of the rotor.
    """
    mount, origin = scene.mount(), jnp.zeros_like(turn[0])
    imbalances = [term.at(origin) for term in terms_of(scene.all_effects, RotorImbalance)]
    size = jnp.sum(jnp.abs(unbalances))
    residual = jnp.abs(jnp.sum(unbalances) + rotor_unbalance) / size
    if mount.tilt is None:
        return residual
    tilting = [scaled(lever, unbalances) for lever in mount.levers[1:]]
    moment = sum(
        (imbalance.moment[0] + 1j * imbalance.moment[1] for imbalance in imbalances), jnp.sum(sum(tilting, 0.0 * unbalances))
    )
    moment = sum((scaled(lever, rotor_unbalance) for lever in mount.rotor_levers[1:]), moment)
    mass = scene.machine.carrier().mass
    rows = [jnp.linalg.solve(mass, row[0]) @ row[0] for row in mount.rows]
    total_moment = jnp.sum(jnp.abs(sum(tilting, 0.0 * unbalances)))
    return jnp.maximum(
        residual, jnp.abs(moment) / jnp.where(total_moment > 0.0, total_moment, size * jnp.sqrt(rows[0] / rows[1]))
    )


def excited_frequencies(scene: Scene, rotor_speed: Array) -> Array:
    """Return the natural frequencies that turning loads excite, rad/s, ascending; for a gyroscopic rotor those of the whirls at
    the rotor speed that are not backward circles. Missing frequencies are infinite."""
    if len(scene.exciters) > 1 or scene.mounting.gyroscopic is None:
        return estimated_frequencies(scene)
    whirls = whirl(jax.lax.stop_gradient(scene), jax.lax.stop_gradient(rotor_speed)[None])
    excited = (whirls.speed[0] > 0.0) & (whirls.directivity[0] > _MAX_BACKWARD_DIRECTIVITY)
    return jnp.sort(jnp.where(excited, whirls.speed[0], jnp.inf))
