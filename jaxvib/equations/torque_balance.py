"""Balance of the mean torques on rotating masses that turn at one speed: influence coefficients, vibrational torques.

The angle of rotating mass k in the fixed frame is th_k = sigma_k (Omega t + alpha_k), with sigma_k = +1 anticlockwise, -1
clockwise, and e_k = (1, -i sigma_k). The displacement of its point is B_k q, S_k is its unbalance, and L_k its driving
torque. A load is driven by the torque of its drag, and an unbalance by the torque T(Omega) of its motor. M, C, K and G are the
mass, damping, stiffness and gyroscopic matrices of the carrier with its loads, and n is the rotor speed. With
D(w) = K - w^2 M + i w (C + n G),

    H_ik = e_i^H B_i D(Omega)^-1 B_k^T e_k
    V_i = (Omega^4/2) sum_k S_i S_k Im(exp(i (alpha_k - alpha_i)) H_ik)
    L_i(Omega) + V_i = 0,       q = Re(Y exp(i Omega t)),     Y = Omega^2 D^-1 sum_k B_k^T e_k S_k exp(i alpha_k)

Source: the equilibria of the averaged equations (`jaxvib.equations.averaged`); I. I. Blekhman, Synchronization in Science and
Technology, 1988, for unbalances; Artyunin 2013 for pendulums.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.averaged import LATE, Averaged, averaged_model, mean_torque
from jaxvib.equations.linear import ExcitedModel, LinearModel, linear_model, rotating_direction
from jaxvib.equations.model import grouped
from jaxvib.machine.carrier import Mount
from jaxvib.machine.drives.drive import Drive, Motor
from jaxvib.machine.effects.base import has_term, terms_of
from jaxvib.machine.effects.terms import RotorImbalance
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.machine.validation import lifting_torques
from jaxvib.numerics.linalg import magnitude, small_solve, times
from jaxvib.numerics.roots import bracketed_root
from jaxvib.runtime.programs import cached

_TORQUE_POINTS = 33
"""Number of speeds from 0 to the working speed at which the largest torque of a motor is read."""

_COMMON_SPEEDS = 513
"""Number of speeds at which the sum of the torques of several motors is computed."""


class TorqueBalance(eqx.Module):
    """Balance of the mean torques on the rotating masses of a scene.

    **Attributes**

    - `model`: the linear model
    - `averaged`: the averaged equations at the working speed of ideal drives
    - `direction` B_k^T e_k (count, nd), complex: generalized force of each mass per unit of its centrifugal force
    - `motor_torque` (count,) N m: largest torque of the motor of an unbalance from rest to its working speed; 1 for an ideal
      drive and for a motor without torque, 0 for a load
    """

    model: LinearModel
    averaged: Averaged
    direction: Array
    motor_torque: Array

    @property
    def unbalance(self) -> Array:
        """S = m R of each mass, (count,) kg m."""
        return self.averaged.unbalance

    @property
    def drag(self) -> Array:
        """b_W R^2 of each load, (count,) N m s."""
        return self.averaged.drag

    @property
    def speed(self) -> Array:
        """Largest working speed of all drives, rad/s."""
        drives = self.averaged.drives
        return drives[0].speed if len(drives) == 1 else jnp.max(jnp.stack([drive.speed for drive in drives]))

    @property
    def is_prescribed(self) -> np.ndarray:
        """True for the unbalances under ideal drives, (count,)."""
        return self.averaged.is_prescribed

    def driving_torque(self, omega: Array) -> Array:
        """Return L (count,) N m at the speed `omega`; 0 for unbalances under ideal drives."""
        return self.driving_torques(jnp.full_like(self.unbalance, omega))

    def driving_torques(self, rate: Array) -> Array:
        """Return L (count,) N m of masses that turn at the speeds `rate` (count,)."""
        return self.averaged.driving_torque(jnp.full_like(rate[0], LATE), self.rotor_speeds(rate), rate)

    def rotor_speeds(self, rate: Array) -> list[Array]:
        """Return the rotor speeds of each group from the speeds `rate` (count,) of the masses, see `Averaged.rotor_speeds`."""
        return self.averaged.rotor_speeds(jnp.full_like(rate[0], LATE), rate)

    def dynamic_stiffness(self, omega: Array, rate: Array | None = None) -> Array:
        """Return D(omega) (nd, nd) complex, N/m, with masses that turn at the speeds `rate` (count,), default: `omega`."""
        speeds = self.rotor_speeds(jnp.full_like(self.unbalance, omega) if rate is None else rate)
        return self.model.dynamic_stiffness(omega, self.averaged.gyroscopic_speed(speeds))

    def decomposed(self) -> TorqueBalance:
        """Return this balance with the modal form of its model, for searches at many speeds: each influence coefficient costs
        O(nd), and has no derivatives with respect to parameters of the scene."""
        return eqx.tree_at(lambda balance: balance.model, self, self.model.decomposed(self.direction))

    def total_driving_torque(self, omega: Array, factor: Array | None = None) -> Array:
        """Return `driving_torque`, with the differences from the mean multiplied by `factor`. If an ideal drive, which balances
        any torque, turns an unbalance, the torques themselves are multiplied."""
        torque = self.driving_torque(omega)
        if factor is None:
            return torque
        mean = jnp.zeros_like(omega) if any(self.is_prescribed) else jnp.mean(torque)
        return mean + factor * (torque - mean)

    @property
    def torque_scale(self) -> Array:
        """Size of the driving torques, (count,) N m: b_W R^2 n of a load, the `motor_torque` of an unbalance."""
        return self.drag * self.speed + self.motor_torque


def assemble_torque_balance(scene: Scene) -> TorqueBalance:
    """Assemble the torque balance of a validated scene."""
    return balance_of(linear_model(scene))


def balance_of(model: LinearModel) -> TorqueBalance:
    """Return the torque balance of a model."""
    averaged = averaged_model(model)
    directions = []
    for exciter, mount, count in zip(model.scene.exciters, model.mounts, averaged.counts, strict=True):
        rows = mount.load_rows(count) if count else mount.rows[0][None]
        directions.append(jnp.einsum("jka,k->ja", rows, rotating_direction(mount, exciter.direction)))
    drives = tuple(drive.at_working_speed() for drive in averaged.drives)
    averaged = dataclasses.replace(averaged, groups=grouped(drives, averaged.counts))
    direction = directions[0] if len(directions) == 1 else jnp.concatenate(directions)
    return TorqueBalance(model, averaged, direction, _motor_torque(averaged))


class UnbalancedModel(ExcitedModel):
    """Linear model under the unbalances of exciters that turn at one speed Omega with given phases alpha_k.

        Y = Omega^2 D(Omega)^-1 f,      f = sum_k S_k exp(i alpha_k) B_k^T e_k,     braking torque = -(Omega^4/2) Im(f^H D^-1 f)

    **Attributes**, in addition to those of `ExcitedModel`: the `balance` of torques; `phasors` (count,), the complex numbers
    exp(i alpha_k); `resultant`, kg m, complex: sum_k S_k exp(i alpha_k) e_k, the force per Omega^2 in each direction of e_k;
    `shaft`: the balance of one mass in place of all masses, which turn as one because their phases are fixed. The
    `unbalance` of this model is 1, and its `force_direction` is f.
    """

    balance: TorqueBalance
    shaft: TorqueBalance
    phasors: Array
    resultant: Array
    unbalance: Array
    force_direction: Array

    def dynamic_stiffness(self, omega: Array, speed: Array | None = None) -> Array:
        """Return D(w) (nd, nd) complex, N/m, of rotors that turn at w; `speed` has no effect."""
        return super().dynamic_stiffness(omega, self._sense * omega)

    @property
    def _sense(self) -> float:
        """Mean direction of rotation: 1 if all rotors turn anticlockwise."""
        return float(np.mean(self.balance.averaged.directions))

    def peak_matrices(self) -> tuple[Array, Array, Array]:
        """Return M - i s G, C and K, whose poles are those of the response to unbalances; s: mean direction of rotation."""
        gyroscopic, carrier = self.mounts[0].gyroscopic, self.carrier
        mass = self.mass if gyroscopic is None else self.mass - 1j * self._sense * gyroscopic
        return mass, carrier.damping, carrier.stiffness

    @property
    def highest_speed(self) -> Array | None:
        """Speed just below the no-load speed; None if an ideal drive turns an unbalance."""
        if any(self.balance.is_prescribed):
            return None
        return self.shaft.speed * (1.0 - float(jnp.finfo(self.mass.dtype).eps) ** 0.5)

    @property
    def extra_peaks(self) -> int:
        """Number of dips of the motors' torques."""
        return sum(drive.dips for drive in self.balance.averaged.drives if isinstance(drive, Motor))

    def motor_torque(self, omega: Array) -> Array:
        """Return the sum of the torques of all motors at the speed `omega`, N m, at least a tiny positive value."""
        total = jnp.sum(self.balance.driving_torque(omega))
        least = jnp.finfo(total.dtype).eps * jnp.sum(self.balance.motor_torque)
        return jnp.where(total > least, total, least)

    def required_torque(self, omega: Array, displacement: Array) -> Array:
        """Return the mean torque -V that each rotor needs against the vibration with amplitudes `displacement` (nd,), N m."""
        forward = omega**2 * (self.balance.direction.conj() @ displacement)
        return mean_torque(self.balance.unbalance, jnp.conj(self.phasors) * forward)

    def drive_torque(self, omega: Array, required: Array) -> Array:
        """Return the torque of each drive, (count,) N m, from the `required_torque`: an ideal drive supplies that of its rotor
        and an equal share of the torque that the motors lack."""
        prescribed, driving = self.balance.is_prescribed, self.balance.driving_torque(omega)
        if prescribed.all() or not prescribed.any():
            return jnp.where(prescribed, required, driving)
        lack = jnp.sum(jnp.where(prescribed, 0.0, required - driving))
        return jnp.where(prescribed, required + lack / np.sum(prescribed), driving)


def unbalanced_model(scene: Scene, phases: Array) -> UnbalancedModel:
    """Assemble the model of a scene whose exciters have unbalances with `phases` (count,), rad."""
    model, phasors = linear_model(scene), jnp.exp(1j * phases)
    resultant = resultant_of(model, phasors)
    balance = balance_of(with_imbalances(model))
    model, force = balance.model, (balance.unbalance * phasors) @ balance.direction
    return UnbalancedModel(
        scene=model.scene,
        carrier=model.carrier,
        mounts=model.mounts,
        supports=model.supports,
        mass=model.mass,
        balance=balance,
        shaft=balance if len(scene.exciters) == 1 else _on_one_shaft(balance, force),
        phasors=phasors,
        resultant=resultant,
        unbalance=jnp.ones((), model.mass.dtype),
        force_direction=force,
    )


class _Shaft(Motor):
    """Motor in place of several motors whose rotors turn as one: it has the sums of their torques and inertias."""

    drives: tuple[Drive, ...]
    speed: Array
    inertia: Array
    kind: str = eqx.field(static=True, default="shaft", kw_only=True)

    def torque(self, speed: Array) -> Array:
        """Return the sum of the torques at the rotors' `speed`, N m."""
        return _sum_of_torques(self.drives, speed)


def _sum_of_torques(drives: Sequence[Drive], speed: Array) -> Array:
    motors = (drive.torque_and_inertia(jnp.full_like(speed, LATE), speed) for drive in drives)
    return jnp.sum(jnp.stack([motor[0] for motor in motors if motor is not None]), axis=0)


def common_speeds(drives: Sequence[Drive]) -> Array:
    """Return a grid of speeds from 0 to the largest no-load speed of several motors, (points,) rad/s."""
    return jnp.linspace(0.0, 1.0, _COMMON_SPEEDS) * jnp.max(jnp.stack([drive.speed for drive in drives]))


def common_torques(drives: Sequence[Drive]) -> Array:
    """Return the sum of the torques of several motors at `common_speeds`, (points,) N m."""
    return jax.vmap(partial(_sum_of_torques, drives))(common_speeds(drives))


def _common_no_load_speed(drives: tuple[Drive, ...]) -> Array:
    """Return the largest speed at which the sum of the torques of several motors falls to 0, rad/s."""
    speeds, total = jax.lax.stop_gradient((common_speeds(drives), common_torques(drives)))
    falls = (total[:-1] > 0.0) & (total[1:] <= 0.0)
    last = falls.size - 1 - jnp.argmax(falls[::-1])
    root = bracketed_root(partial(_sum_of_torques, drives), speeds[last], speeds[last + 1], (total[last], total[last + 1]))
    return jnp.where(jnp.any(falls), root, speeds[-1])


def _on_one_shaft(balance: TorqueBalance, force: Array) -> TorqueBalance:
    """Return the balance of one mass in place of all masses, with their force f (nd,) per Omega^2, torques and inertias."""
    model, drives = balance.model, balance.averaged.drives
    first, ideal = model.scene.exciters[0], [drive for drive in drives if drive.ideal]
    if ideal:
        drive: Drive = ideal[0]
    else:
        inertia = jnp.sum(balance.averaged.inertia)
        drive = _Shaft(drives=drives, speed=_common_no_load_speed(drives), inertia=inertia)
    gyroscopic = model.mounts[0].gyroscopic
    if gyroscopic is not None:
        gyroscopic = float(np.mean(balance.averaged.directions)) * first.direction * gyroscopic
    mount = _mount_of_force(force, first.direction, dataclasses.replace(model.mounts[0], gyroscopic=gyroscopic))
    one = eqx.tree_at(lambda each: (each.unbalance, each.drive), first, (jnp.ones_like(model.mass[0, 0]), drive))
    scene = eqx.tree_at(lambda each: each.exciters, model.scene, (one,))
    return balance_of(dataclasses.replace(model, scene=scene, mounts=(mount,)))


def _mount_of_force(force: Array, direction: int, mount: Mount) -> Mount:
    """Return a mount on which an unbalance of 1 kg m causes the generalized force w^2 f, with f = `force` (nd,) = B^T e: the
    displacement of its point is B q with B = (Re f, -Im f) for the direction e = (1, -i)."""
    rows = jnp.stack([force.real, -direction * force.imag])
    return Mount(rows=(rows,), axes=(0, 1), gyroscopic=mount.gyroscopic, turn=mount.turn)


def _imbalances(exciter: Exciter, *, about_tilts: bool) -> list[Array]:
    """Return the imbalances of a rotor, complex: amount times exp(i phase) with the phase in the direction of rotation."""
    terms = terms_of(exciter.effects, RotorImbalance)
    return [term.amount * jnp.exp(1j * exciter.direction * term.phase) for term in terms if term.about_tilts == about_tilts]


def with_imbalances(model: LinearModel) -> LinearModel:
    """Return the model with one unbalance of the same force in place of the unbalance and the imbalances of each rotor."""
    if not has_term(model.scene.all_effects, RotorImbalance):
        return model
    exciters, mounts = [], []
    for exciter, mount in zip(model.scene.exciters, model.mounts, strict=True):
        turning = rotating_direction(mount, exciter.direction)
        assert exciter.unbalance is not None  # the response has no loads
        force = exciter.unbalance * turning @ mount.rows[0]
        force = force + sum(_imbalances(exciter, about_tilts=False)) * turning @ mount.rotor_rows()
        if mount.tilt is not None:
            force = force + sum(_imbalances(exciter, about_tilts=True)) * turning @ mount.tilt
        mounts.append(_mount_of_force(force, exciter.direction, mount))
        exciters.append(eqx.tree_at(lambda each: each.unbalance, exciter, jnp.ones_like(model.mass[0, 0])))
    scene = eqx.tree_at(lambda each: each.exciters, model.scene, tuple(exciters))
    return dataclasses.replace(model, scene=scene, mounts=tuple(mounts))


def resultant_of(model: LinearModel, phasors: Array) -> Array:
    """Return the resultant of the centrifugal forces per w^2, sum_j S_j exp(i alpha_j) e_j, kg m, complex, shaped like e_j,
    from the `phasors` (count,) exp(i alpha) of the rotating masses; an unbalance includes the static imbalance of its rotor.

    The result is NaN for loads that do not move on a circle, and 0 if the forces cancel up to the errors of the phases.
    """
    total, largest, first = jnp.zeros((), phasors.dtype), 0.0, 0
    for exciter, mount in zip(model.scene.exciters, model.mounts, strict=True):
        loads = exciter.loads
        if loads is None:
            unbalance = 0.0 if exciter.unbalance is None else exciter.unbalance
            size = sum((amount for amount in _imbalances(exciter, about_tilts=False)), unbalance)
        else:
            size = loads.mass * loads.radius if isinstance(loads, CircularLoads) else jnp.nan
        each = size * phasors[first : first + (1 if loads is None else loads.count)]
        total = total + jnp.sum(each) * rotating_direction(mount, exciter.direction)
        largest = largest + jnp.sum(magnitude(each))
        first += each.shape[0]
    return jnp.where(magnitude(total) <= jnp.finfo(phasors.dtype).eps ** 0.5 * largest, 0.0, total)


@cached
def assemble_for_search(scene: Scene, masses: tuple[int, ...] | None = None) -> TorqueBalance:
    """Assemble the torque balance for searches, see `TorqueBalance.decomposed`, of a validated scene or of some of its
    `masses`, see `balance_of_group`."""
    balance = assemble_torque_balance(scene)
    return (balance if masses is None else balance_of_group(balance, masses)).decomposed()


def balance_of_group(balance: TorqueBalance, masses: tuple[int, ...]) -> TorqueBalance:
    """Return the balance of some rotating masses, by number. The others move with the machine, but exert no force; the rotors
    of other exciters turn at the working speeds of their drives."""
    field, indices = balance.averaged, np.asarray(masses)
    owner = owners_of(field.counts)[indices]
    exciters = sorted(set(owner.tolist()))
    rows = indices if field.levers is None else np.flatnonzero(np.isin(field.owners, exciters))
    drives = field.drives
    others = tuple(field.directions[k] * drive.speed for k, drive in enumerate(drives) if k not in exciters)
    counts = tuple(int(np.sum(owner == k)) if field.counts[k] else 0 for k in exciters)
    averaged = dataclasses.replace(
        field,
        input_matrix=field.input_matrix[rows],
        port=field.port[rows],
        levers=None if field.levers is None else field.levers[np.ix_(rows, indices)],
        unbalance=field.unbalance[indices],
        inertia=field.inertia[indices],
        drag=field.drag[indices],
        groups=grouped([drives[k] for k in exciters], counts),
        counts=counts,
        directions=tuple(field.directions[k] for k in exciters),
        owners=tuple(exciters.index(field.owners[row]) for row in rows),
        other_rotors=others,
    )
    return TorqueBalance(balance.model, averaged, balance.direction[indices], balance.motor_torque[indices])


def owners_of(counts: Sequence[int]) -> np.ndarray:
    """Return the exciter of each rotating mass from `counts`: number of loads of each exciter, 0 for one with an unbalance."""
    return np.repeat(np.arange(len(counts)), [max(count, 1) for count in counts])


def mass_owners(scene: Scene) -> np.ndarray:
    """Return the exciter of each rotating mass."""
    return owners_of([0 if exciter.loads is None else exciter.loads.count for exciter in scene.exciters])


def _motor_torque(averaged: Averaged) -> Array:
    """Return the largest torque of each mass's motor, see `TorqueBalance`."""
    shares, each = jnp.linspace(0.0, 1.0, _TORQUE_POINTS, dtype=averaged.drag.dtype), []
    for count, drive in zip(averaged.counts, averaged.drives, strict=True):

        def torque(share: Array, drive: Drive = drive) -> Array:
            motor = drive.torque_and_inertia(jnp.full_like(share, LATE), share * drive.speed)
            return jnp.ones_like(share) if motor is None else jnp.abs(motor[0])

        largest = jnp.max(jax.vmap(torque)(shares))[None]
        each.append(jnp.zeros(count, shares.dtype) if count else jnp.where(largest > 0.0, largest, 1.0))
    return jax.lax.stop_gradient(each[0] if len(each) == 1 else jnp.concatenate(each))


def influence_of(balance: TorqueBalance, omega: Array, rate: Array | None = None) -> Array:
    """Return the influence coefficients H_jk (count, count), m/N, for masses that turn at `rate` (default: `omega`), rad/s."""
    if balance.model.modal is not None:
        return balance.model.modal.receptance(omega)
    return balance.direction.conj() @ response_of(balance, omega, rate)


def response_of(balance: TorqueBalance, omega: Array, rate: Array | None = None) -> Array:
    """Return the response of the carrier per force of each mass, D^-1 B_k^T e_k (nd, count), complex, m/N."""
    dynamic = balance.dynamic_stiffness(omega, rate)
    return small_solve(dynamic, balance.direction.T.astype(dynamic.dtype))


def torques_at(unbalance: Array, influence: Array, omega: Array, phasors: Array) -> Array:
    """Return the mean torques V (count,), N m, of the vibration on masses that turn at `omega`, rad/s.

    **Arguments**, with the symbols above: `unbalance` S (count,), kg m; `influence` H (count, count), m/N, see `influence_of`;
    `phasors` exp(i alpha) (count,).

    Source: Artyunin 2013, the pendulums' equation of (1), averaged over a turn.
    """
    return mean_torque(unbalance, -(omega**4) * jnp.conj(phasors) * times(influence, unbalance * phasors))


def unknowns_of(balance: TorqueBalance, omega: Array, phase: Array) -> Array:
    """Return the unknowns of the balance: the speed relative to `TorqueBalance.speed`, and all phases relative to the first. If
    ideal drives prescribe the speed of unbalances, the unknowns are only the phases of the other masses."""
    if any(balance.is_prescribed):
        return phase[np.flatnonzero(~balance.is_prescribed)]
    return jnp.concatenate([jnp.reshape(omega / jax.lax.stop_gradient(balance.speed), (1,)), phase[1:] - phase[0]])


def motion_of(balance: TorqueBalance, x: Array) -> tuple[Array, Array]:
    """Return the speed, rad/s, and the phases (count,) rad from the unknowns of the balance, see `unknowns_of`."""
    prescribed = balance.is_prescribed
    if not any(prescribed):
        return x[0] * jax.lax.stop_gradient(balance.speed), jnp.concatenate([jnp.zeros(1, x.dtype), x[1:]])
    field = balance.averaged
    omega = next(drive.speed for n, drive in zip(field.counts, field.drives, strict=True) if n == 0 and drive.ideal)
    return omega, jnp.zeros(prescribed.size, x.dtype).at[np.flatnonzero(~prescribed)].set(x)


def balance_residuals(x: Array, balance: TorqueBalance, factor: Array | None = None) -> Array:
    """Return L_i + V_i of the masses of unknown motion, relative to `TorqueBalance.torque_scale`, at the unknowns `x` of
    `unknowns_of`; `factor`: see `TorqueBalance.total_driving_torque`."""
    w, angles = motion_of(balance, x)
    phasors = jax.lax.complex(jnp.cos(angles), jnp.sin(angles))
    torque = torques_at(balance.unbalance, influence_of(balance, w), w, phasors)
    residual = (balance.total_driving_torque(w, factor) + torque) / balance.torque_scale
    return residual[np.flatnonzero(~balance.is_prescribed)] if any(balance.is_prescribed) else residual


def can_start(scene: Scene) -> Array:
    """Return True for each exciter whose motor lifts its unbalance from rest against gravity, or that has nothing to lift."""
    each = lifting_torques(scene)
    return jnp.stack([jnp.asarray(True) if torques is None else torques[1] > torques[0] for torques in each])
