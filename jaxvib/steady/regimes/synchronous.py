"""Synchronous regimes of several exciters in the averaged theory: all regimes, or the regime near a start."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, Onto, speed_text
from jaxvib.equations.averaged import decays, require_rotating_masses
from jaxvib.equations.linear import linear_model, natural_frequencies, peak_force
from jaxvib.equations.torque_balance import (
    TorqueBalance,
    assemble_for_search,
    assemble_torque_balance,
    balance_of_group,
    balance_residuals,
    can_start,
    influence_of,
    mass_owners,
    motion_of,
    owners_of,
    response_of,
    resultant_of,
    torques_at,
    unknowns_of,
)
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.validation import off_notes, start_notes, validate_scene, weight_notes
from jaxvib.numerics.linalg import magnitude
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import status_name, status_names
from jaxvib.runtime.devices import on_device
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.newton import solve_torques
from jaxvib.steady.jams.phases import degrees
from jaxvib.steady.outcome import REFUSED, outcome, require_index
from jaxvib.steady.points import Harmonic, PathsOfPoints
from jaxvib.steady.regimes.local import (
    Slopes,
    implicit_step,
    margin_of,
    quasi_static_growth,
    regime_growth,
    slopes_of,
    vibration_scale,
)
from jaxvib.steady.regimes.search import MAX_COMPLETE, all_regimes, is_balanced
from jaxvib.steady.vibration import Vibration
from jaxvib.units import Number, number, numbers
from jaxvib.units.known import when_known

if TYPE_CHECKING:
    from jaxvib.draw.motion.regimes import DrawnRegime

_REGIMES_PER_PROGRAM = 16
"""Number of regimes in one program; typical scenes have 2 to 20."""


class RegimeStatus(eqx.Enumeration):
    """Outcomes of one synchronous regime. The value of each member is the message shown to the user."""

    found = "the rotating masses can turn at one speed in this way"
    degenerate = (
        "one of a family: phases can change without a change of torques, so that even the smallest disturbance changes them"
    )
    no_vibration = (
        "the forces of the rotating masses cancel, and the machine does not vibrate; an example is two equal masses that turn "
        "in antiphase in one direction about one axis"
    )
    not_converged = "no regime was found from this start"
    none_stable = (
        "no stable synchronous regime was found: the exciters turn at different speeds, or a resonance catches them; "
        "synchronous_regimes lists the unstable regimes, run_up shows the motion from rest"
    )
    unbounded = "the masses turn at an undamped resonance: the vibration grows without bounds"
    undecided = (
        "the rotating masses can turn at one speed in this way, but the growth of small disturbances is lost in rounding; "
        "check the largest numbers of the motors and the drag"
    )
    refused = REFUSED


class RegimeSearchStatus(eqx.Enumeration):
    """Outcomes of a search for all regimes."""

    done = "all regimes were searched for"
    sampled = (
        "more than 6 rotating masses: these regimes were reached from a limited number of starts, which approach stable "
        "regimes; there may be others"
    )
    none = (
        "no regime: there is no speed at which the vibrational torque balances the driving torque of every mass; "
        "each mass turns at its own speed"
    )


class AbstractSynchronousRegime(Result):
    """Synchronous regimes, one or several; values are NaN if there is no regime.

        angle of mass k in the fixed frame: direction_k (Omega t + phases_k),       q = Re(displacement exp(i Omega t))

    The masses are the unbalance or the loads of each exciter, in the order of the exciters.

    **Attributes**

    - `status`: a `RegimeStatus`
    - `masses` (mass,): their numbers in the scene, from 0
    - `speed` Omega, rad/s
    - `phases` (mass,), rad, in the direction of rotation. If unbalances have ideal drives, their phases are 0; otherwise that
      of the first mass is 0
    - `growth`, 1/s, of the fastest growing small disturbance of the averaged motion, and `stable`: True if it is negative by
      more than a rounding error
    - `quasi_static`, 1/s: the same according to the usual quasi-static criterion, which assumes that free vibrations of the
      machine decay infinitely fast; -inf if all speeds are prescribed
    - `margin`: the factor by which all differences of the driving torques can grow until the regime ends in a fold; inf if it
      does not end. If an ideal drive turns an unbalance, the torques themselves grow
    - `torque` (mass,), N m: driving torque, by the motor or by the drag; for an ideal drive the torque that it must exert
    - `vibrational_torque` (mass,), N m: mean torque of the vibration on each mass; it balances `torque`
    - `power` (exciter,), W: mean power of each drive
    - `can_start` (exciter,): False if the motor cannot turn its hanging unbalance over the top: L(0) < 0.7246 S g, with the
      starting torque L(0)
    - `displacement` (nd,): complex amplitudes, in m, or in rad for rotations; `amplitude` (nd,): their moduli, zero to peak
    - `foundation_force`, N, zero to peak (for two directions the root of the summed squares of their peaks)
    - `residual` of the balance, relative to the largest vibrational torque that is possible
    - `scene`
    """

    status: RegimeStatus
    masses: Array = eqx.field(metadata=in_unit("", "*", "mass"))
    speed: Array = eqx.field(metadata=in_unit("rad/s", "*"))
    phases: Array = eqx.field(metadata=in_unit("rad", "*", "mass"))
    growth: Array = eqx.field(metadata=in_unit("1/s", "*"))
    stable: Array = eqx.field(metadata=in_unit("", "*"))
    quasi_static: Array = eqx.field(metadata=in_unit("1/s", "*"))
    margin: Array = eqx.field(metadata=in_unit("", "*"))
    torque: Array = eqx.field(metadata=in_unit("N m", "*", "mass"))
    vibrational_torque: Array = eqx.field(metadata=in_unit("N m", "*", "mass"))
    power: Array = eqx.field(metadata=in_unit("W", "*", "exciter"))
    can_start: Array = eqx.field(metadata=in_unit("", "*", "exciter"))
    displacement: Array = eqx.field(metadata=in_unit("m or rad", "*", "coordinate"))
    amplitude: Array = eqx.field(metadata=in_unit("m or rad", "*", "coordinate"))
    foundation_force: Array = eqx.field(metadata=in_unit("N", "*"))
    residual: Array = eqx.field(metadata=in_unit("", "*"))
    scene: Scene = eqx.field(metadata=SCENE)


class SynchronousRegime(PathsOfPoints, AbstractSynchronousRegime):
    """Synchronous regime, see `AbstractSynchronousRegime`.

    Returned by `SynchronousRegimes.select` and `synchronous_regimes(scene, near=...)`.
    """

    def harmonic(self) -> Harmonic:
        """Return the vibration of the coordinates at Omega."""
        return Harmonic(self.scene.machine, self.speed, self.displacement)

    def vibration(self) -> Vibration:
        """Return the vibration, for `vibration_measures`. **Raises** `InputError` unless it has all masses."""
        count = mass_owners(self.scene).size
        if self.phases.size != count:
            problem = f"has {self.phases.size} of the scene's {count} rotating masses"
            raise InputError("masses", f"{problem}; the others add vibrations of other frequencies; use simulate or envelope")
        return _vibration_of(self)

    def summary(self) -> str:
        """Return one line of text; phases in degrees."""
        if not np.isfinite(self.speed):
            return self.message
        phases = ", ".join(f"{degrees(float(a)):.4g}" for a in self.phases)
        name = status_name(self.status)
        stable = f"{'stable' if bool(self.stable) else 'unstable'} ({float(self.growth):.3g} 1/s)"
        stable = "stability lost in rounding errors" if name == "undecided" else stable
        special = {"degenerate": ", one of a family", "no_vibration": ", no vibration"}.get(name, "")
        return f"Omega {speed_text(self.speed, 6)}, {stable}, margin {float(self.margin):.3g}{special}: {phases} deg"

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the phases of the masses on a circle, each in its direction of rotation, and state them with the torques."""
        from jaxvib.draw.motion.regimes import regimes_chart  # slow import

        return regimes_chart([_drawn_regime(self)], None, np.zeros(0), names=(), resultant=_has_resultant(self), ax=ax)


def _drawn_regime(regime: SynchronousRegime) -> DrawnRegime:
    from jaxvib.draw.motion.regimes import DrawnRegime  # slow import

    masses, phases, torque = (np.asarray(values) for values in (regime.masses, regime.phases, regime.torque))
    return DrawnRegime(float(regime.speed), masses, phases, torque, bool(regime.stable))


@cached
def _vibration_of(regime: SynchronousRegime) -> Vibration:
    scene, speed = regime.scene, regime.speed
    exciter = peak_force(speed**2 * resultant_of(linear_model(scene), jnp.exp(1j * regime.phases)))
    rotors = jnp.stack([speed if exciter.loads is None else exciter.drive.speed for exciter in scene.exciters])
    return Vibration(
        speed, regime.displacement, regime.amplitude, regime.foundation_force, exciter, regime.power / rotors, regime.power
    )


_MAX_CIRCLES = 7
"""Maximum number of circles in a figure."""

_CURVE_POINTS = 401
"""Number of speeds of the curves of torques."""


class SynchronousRegimes(AbstractSynchronousRegime):
    """All synchronous regimes of a scene: the arrays of `AbstractSynchronousRegime` with a leading axis over the n regimes.

    Returned by `synchronous_regimes`. Stable regimes come first; regimes of the same stability are in the order of decreasing
    speed.

    **Additional attribute**: `search`, a `RegimeSearchStatus`.
    """

    outer_axes = ("regime",)

    search: RegimeSearchStatus = eqx.field(metadata=in_unit(""))

    @validated
    def select(self, index: int) -> SynchronousRegime:
        """Return the regime with an `index`, counted from 0. **Raises** `InputError` if there are fewer regimes."""
        require_index(index, self.speed.shape[0], "regimes")
        fields = {name: getattr(self, name) for name in SynchronousRegime.__dataclass_fields__ if name != "scene"}
        return SynchronousRegime(**jax.tree.map(lambda leaf: leaf[index], fields), scene=self.scene)

    def notes(self) -> list[str]:
        """Return sentences about motors that are switched off or cannot start, and about the weight of the unbalances."""
        owners = np.unique(mass_owners(self.scene)[np.ravel(self.masses)]).tolist() or range(len(self.scene.exciters))
        stable = np.asarray(self.speed)[np.asarray(self.stable)]
        slowest = dict.fromkeys(owners, float(np.min(stable))) if stable.size else {}
        return [*off_notes(self.scene), *start_notes(self.scene, owners), *weight_notes(self.scene, slowest)]

    def summary(self) -> str:
        """Return a line of text for each regime, and the `notes`."""
        lines = [self.select(k).summary() for k in range(self.speed.shape[0])]
        complete = lines and status_name(self.search) == "done"
        return "\n".join([*lines, *([] if complete else [RegimeSearchStatus[self.search]]), *self.notes()])

    @validated
    def plot(self, *, ax: Onto = None) -> Drawn:
        """Plot the torques of the motors over the speed with all regimes, and the phases of each regime on a circle.

        Circles begin with the stable regimes; without `ax` there are at most 7. The torques that the vibration needs are those
        at the phases of the first regime. The panel of torques is omitted if the regimes are those of only some of the masses,
        or if all torques are those of ideal drives.

        **Returns** a matplotlib figure, or the given `ax`, which must contain one axes object for each panel.
        """
        from jaxvib.draw.motion.regimes import TorqueCurves, regimes_chart  # slow import

        order = np.argsort(~np.asarray(self.stable), kind="stable")[: None if ax is not None else _MAX_CIRCLES]
        regimes = [_drawn_regime(self.select(int(k))) for k in order]
        owners, curves = mass_owners(self.scene), None
        if regimes and self.phases.shape[1] == owners.size:
            curves = TorqueCurves(*map(np.asarray, _torque_curves(self.scene, self.phases[order[0]])))
            curves = None if np.all(np.isnan(curves.driving)) else curves
        names = [f"{'motor' if self.scene.exciters[owner].loads is None else 'load'} {k + 1}" for k, owner in enumerate(owners)]
        resonances = np.asarray(natural_frequencies(self.scene))
        return regimes_chart(regimes, curves, resonances, names=names, resultant=_has_resultant(self), ax=ax)


@cached
def _torque_curves(scene: Scene, phases: Array) -> tuple[Array, Array, Array]:
    """Return speeds up to the largest working speed, and at each the torques of the drives (NaN for an ideal drive) and those
    that the vibration needs."""
    balance = assemble_torque_balance(scene)
    speeds = balance.speed * jnp.linspace(0.0, 1.0, _CURVE_POINTS)[1:]

    def torques(w: Array) -> tuple[Array, Array]:
        needed = -torques_at(balance.unbalance, influence_of(balance, w), w, jnp.exp(1j * phases))
        return jnp.where(balance.is_prescribed, jnp.nan, balance.driving_torque(w)), needed

    return (speeds, *jax.vmap(torques)(speeds))


def _has_resultant(found: AbstractSynchronousRegime) -> bool:
    """Return True if all masses of regimes turn in one direction; otherwise the mean of their phases has no meaning."""
    owners = mass_owners(found.scene)[np.ravel(found.masses)]
    return len({found.scene.exciters[owner].direction for owner in owners}) < 2


@overload
def synchronous_regimes(scene: Scene, *, masses: Sequence[int] | None = None) -> SynchronousRegimes: ...


@overload
def synchronous_regimes(
    scene: Scene, *, masses: Sequence[int] | None = None, near: tuple[Number, Array]
) -> SynchronousRegime: ...


@validated
def synchronous_regimes(
    scene: Scene, *, masses: Sequence[int] | None = None, near: tuple[Number, Array] | None = None
) -> SynchronousRegimes | SynchronousRegime:
    """Return all synchronous regimes of a scene, in which all rotating masses turn at one speed, by averaging over a turn.

        L_i(Omega) + V_i(Omega, alpha) = 0 for every mass i
        V_i = (Omega^4/2) sum_k S_i S_k Im(exp(i (alpha_k - alpha_i)) H_ik)
        H_ik = e_i^H B_i D(Omega)^-1 B_k^T e_k,    e_k = (1, -i direction_k),    D = K - Omega^2 M + i Omega (C + n G)

    - The masses are the unbalances of the exciters and the loads. S is the unbalance of a mass, and alpha its phase. L is the
      torque of the motor of an unbalance, or that of the drag on a load. V is the vibrational torque. An ideal drive prescribes
      the angle Omega t of its unbalance, and Omega is then the speed of this drive
    - M, C, K and G are the mass, damping, stiffness and gyroscopic matrices of the machine with all masses; G is 0 for most
      machines. B maps the coordinates to the displacement of the axis of a mass, e_k is the direction of its rotating force,
      and n is the mean of the rotors' speeds, anticlockwise positive
    - Regimes that differ by the same shift of all phases or by an exchange of equal exciters, such as mirror images, are listed
      once. One member of a family of regimes is listed, with the status `degenerate`
    - If the forces of the masses cancel, for example those of two equal unbalances of one direction and one axis in antiphase,
      the status is `no_vibration`
    - Stability is the growth of small disturbances of amplitudes, speeds and phases together in the averaged equations, which
      `envelope` integrates
    - The relative error of the torques is of the order S^2/(2 M I), where M is the mass of the machine and I the inertia of a
      rotor. Close to the parameters at which two regimes exchange their stability, the error of the phases is some tenths of a
      radian
    - Gravity is omitted. The weight of an unbalance S changes the speed of its rotor within a turn by the share
      S g/(I Omega^2). If this share is large, as in regimes caught at a low resonance, the weight can make a stable regime
      unstable
    - In this approximation exciters with different speeds do not act on each other. `masses` selects a group that turns at one
      speed; `regime_partitions` returns the motions of all divisions into such groups
    - With more than 6 masses the number of regimes, most of them unstable, is too large for a complete list. The starts then
      approach stable regimes before Newton's method begins; the list may be incomplete, and `search` is "sampled"

    **Arguments**

    - `scene`, with gravity as its only effect or without effects; exciters have an unbalance, or loads and an ideal drive;
      typical: 2 to 32 rotating masses
    - `masses`: numbers, from 0, of the rotating masses that turn at the common speed; the result contains only these and their
      exciters. The others turn at different speeds and affect the result by their mass only. If the machine has a gyroscopic
      matrix, their rotors also affect n, with the working speeds of their drives. Default: all
    - `near`: (speed, phases), rad/s and (mass,) rad, from which Newton's method finds one regime. The function can then be used
      under `jit`, `vmap` and `grad`. Derivatives are those of the implicit function theorem; `growth`, `quasi_static`
      and `stable` have none

    **Returns** `SynchronousRegimes`, or `SynchronousRegime` with `near`.

    **Raises** `InputError` for exciters with both loads and an unbalance, loads with a motor, unbalances whose ideal drives
    have different speeds, and effects that this theory does not include; `ComputationError` with the status "overflow" if
    torques exceed the range of floating-point numbers.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> springs = [jv.support(at=(x, 0.0), stiffness=(3e3, 3e3), damping=(150.0, 150.0)) for x in (-0.6, 0.6)]
    >>> screen = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    >>> motor = jv.InductionMotor(100.0, breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.05)
    >>> exciters = [jv.Exciter(drive=motor, unbalance=0.4, at=(x, 0.0), direction=s) for x, s in ((-0.6, 1), (0.6, -1))]
    >>> found = jv.synchronous_regimes(jv.Scene(screen, exciters=exciters))
    >>> phases = [round(abs(float(a)), 4) for a in found.phases[:, 1]]
    >>> phases, found.stable.tolist()    # stable: half a turn apart, the body moves along a vertical line
    ([3.1416, 0.0], [True, False])

    Source: I. I. Blekhman, Synchronization in Science and Technology, 1988. The stability is not computed by his integral
    criterion but from eigenvalues of the linearized averaged equations.
    """
    scene = validate_scene(scene)
    require_rotating_masses(scene)
    owners = mass_owners(scene)
    group = _read_group(masses, owners.size)
    require_one_speed(scene, owners if group is None else owners[list(group)])
    count = owners.size if group is None else len(group)
    if near is not None:
        if not isinstance(near, (tuple, list)) or len(near) != 2 or np.shape(near[1]) != (count,):
            raise InputError("near", f"must be (speed, phases) with one phase for each of the {count} rotating masses")
        speed, phases = number(near[0], "rad/s", "near[0]", low=0.0, open_low=True), numbers(near[1], "rad", "near[1]", count)
        return outcome(_regime_near(scene, speed, phases, group), scene)
    balance = assemble_for_search(scene, group)
    return regimes_from(scene, balance, partial(_regimes_near, group=group))


def regimes_from(
    scene: Scene, balance: TorqueBalance, near: Callable[[Scene, Array, Array], dict[str, Any]]
) -> SynchronousRegimes:
    """Return all regimes of a torque balance, the stable ones first.

    **Arguments**: `near`: function that returns the fields of the regimes near speeds (n,), rad/s, and phases (n, mass), rad.
    """
    fields = in_chunks(_REGIMES_PER_PROGRAM, lambda w, a: near(scene, w, a), *all_regimes(balance))
    order = np.flatnonzero(status_names(fields["status"]) != "not_converged")
    order = order[np.lexsort((-fields["speed"][order], ~fields["stable"][order]))]
    is_complete = balance.unbalance.size <= MAX_COMPLETE or balance.is_prescribed.all()
    all_found = RegimeSearchStatus.done if order.size else RegimeSearchStatus.none
    search = all_found if is_complete else RegimeSearchStatus.sampled
    return SynchronousRegimes(**on_device(jax.tree.map(lambda leaf: leaf[order], fields)), scene=scene, search=search)


def _read_group(masses: Sequence[int] | None, count: int) -> tuple[int, ...] | None:
    """Return the numbers of some masses in ascending order, or None for all."""
    if masses is None:
        return None
    numbers = sorted(int(k) for k in masses)
    if not numbers or len(set(numbers)) < len(numbers) or numbers[0] < 0 or numbers[-1] >= count:
        raise InputError("masses", f"is {quoted(masses)}; give different numbers of rotating masses, 0 to {count - 1}")
    return tuple(numbers) if len(numbers) < count else None


@cached
def _regimes_near(scene: Scene, omega: Array, phases: Array, group: tuple[int, ...] | None) -> dict[str, Any]:
    return jax.vmap(lambda w, a: fields_near(scene, w, a, group))(omega, phases)


@cached
def _regime_near(scene: Scene, omega: Array, phases: Array, group: tuple[int, ...] | None) -> SynchronousRegime:
    return SynchronousRegime(**fields_near(scene, omega, phases, group), scene=scene)


def fields_near(scene: Scene, omega: Array, phases: Array, group: tuple[int, ...] | None) -> dict[str, Any]:
    """Return the fields, except `scene`, of the regime that is found from a start, for a group of masses (None: all)."""
    balance = assemble_torque_balance(scene)
    if group is None:
        return fields_of_balance(balance, omega, phases)
    fields = fields_of_balance(balance_of_group(balance, group), omega, phases)
    can_start = fields["can_start"][np.unique(mass_owners(scene)[list(group)])]
    return {**fields, "masses": jnp.asarray(group), "can_start": can_start}


def fields_of_balance(balance: TorqueBalance, omega: Array, phases: Array) -> dict[str, Any]:
    """Return the fields, except `scene`, of the regime that is found from a start in a torque balance."""
    frozen = jax.lax.stop_gradient(balance)
    x = jax.lax.stop_gradient(unknowns_of(frozen, omega, phases))
    if x.size == 0:
        return fields_at(balance, x, None)
    x = solve_torques(x, frozen)
    return fields_at(balance, x, slopes_of(x, frozen))


def fields_at(balance: TorqueBalance, x: Array, slopes: Slopes | None, growth: Array | None = None) -> dict[str, Any]:
    """Return the fields of a regime, except `scene`, with derivatives with respect to parameters of the scene: from unknowns
    `x` that solve the balance, the `slopes` there (None without unknowns), and the `growth` of disturbances if it is known."""
    frozen = jax.lax.stop_gradient(balance)
    neutral = jnp.asarray(0) if slopes is None else slopes.neutral
    if slopes is not None:
        x = implicit_step(x, slopes, balance_residuals(x, balance))
    w, angles = motion_of(balance, x)
    angles = jnp.concatenate([angles[:1], jnp.arctan2(jnp.sin(angles[1:]), jnp.cos(angles[1:]))])
    turn, response = jnp.exp(1j * angles), response_of(balance, w)
    vibration = torques_at(balance.unbalance, balance.direction.conj() @ response, w, turn)
    driving = jnp.where(balance.is_prescribed, -vibration, balance.driving_torque(w))
    z = w**2 * response @ (balance.unbalance * turn)
    force = peak_force(balance.model.vibration_force(z, w))
    scale = vibration_scale(balance, w)
    residual = jnp.max(jnp.abs(driving + vibration) / jnp.where(scale > 0.0, scale, 1.0))

    eps = jnp.finfo(w.dtype).eps
    is_still = jnp.all(magnitude(z) <= eps**0.5 * w**2 * (magnitude(response) @ balance.unbalance))
    size = jnp.max(balance.unbalance) / jnp.min(jnp.diagonal(balance.model.mass))
    bounded = jnp.all(magnitude(z) * 100.0 * eps < size)
    good = is_balanced(frozen, x) & _has_one_speed(balance)
    exists = good & bounded
    status = RegimeStatus.where(is_still, RegimeStatus.no_vibration, RegimeStatus.found)
    status = RegimeStatus.where(neutral > 0, RegimeStatus.degenerate, status)
    status = RegimeStatus.where(good, status, RegimeStatus.not_converged)
    status = RegimeStatus.where(bounded | ~jnp.isfinite(w), status, RegimeStatus.unbounded)

    speed, at = jax.lax.stop_gradient((jnp.where(exists, w, jnp.nan), angles))
    growth = regime_growth(frozen, speed, at, neutral) if growth is None else jnp.where(exists, growth, jnp.nan)
    status = RegimeStatus.where(exists & jnp.isnan(growth), RegimeStatus.undecided, status)
    numbers = {
        "speed": w,
        "phases": angles,
        "growth": growth,
        "quasi_static": quasi_static_growth(frozen, speed, at, neutral),
        "margin": margin_of(balance, x),
        "torque": driving,
        "vibrational_torque": vibration,
        "power": _power(balance, w, driving),
        "displacement": z,
        "amplitude": magnitude(z),
        "foundation_force": force,
        "residual": residual,
    }
    with_nan = {name: jnp.where(exists, value, jnp.nan) for name, value in numbers.items()}
    stable = exists & decays(growth, w)
    masses, starts = jnp.arange(angles.size), can_start(balance.model.scene)
    return {"status": status, "masses": masses, "stable": stable, "can_start": starts, **with_nan}


def _power(balance: TorqueBalance, omega: Array, driving: Array) -> Array:
    """Return the power of each drive, (exciters,) W: the driving torque of its masses times the speed of its rotor."""
    averaged, rate = balance.averaged, jnp.full_like(driving, omega)
    each = owners_of(averaged.counts)
    torque = jnp.zeros(len(averaged.counts), driving.dtype).at[each].add(driving)
    return torque * jnp.stack(averaged.by_exciter(balance.rotor_speeds(rate)))


def _has_one_speed(balance: TorqueBalance) -> Array:
    """Return True if all prescribed speeds of unbalances are equal, see `require_one_speed` for known speeds."""
    field = balance.averaged
    speeds = [drive.speed for count, drive in zip(field.counts, field.drives, strict=True) if count == 0 and drive.ideal]
    return jnp.all(jnp.stack([speed == speeds[0] for speed in speeds])) if speeds else jnp.asarray(True)


def require_one_speed(scene: Scene, exciters: Iterable[int] | None = None) -> None:
    """**Raises** `InputError` if ideal drives turn unbalances at different speeds. Traced speeds are not checked."""
    chosen = range(len(scene.exciters)) if exciters is None else exciters
    ideal = [k for k in chosen if scene.exciters[k].loads is None and scene.exciters[k].drive.ideal]

    def check(*speeds: float) -> None:
        for k, speed in zip(ideal, speeds, strict=True):
            if speed != speeds[0]:
                problem = f"is {float(speed):g} rad/s and that of exciters[{ideal[0]}] {float(speeds[0]):g} rad/s"
                advice = "a regime has one speed; give the same speed to all ideal drives of unbalances"
                raise InputError(f"exciters[{k}].drive.speed", f"{problem}; {advice}")

    when_known(check, *(scene.exciters[k].drive.speed for k in ideal))
