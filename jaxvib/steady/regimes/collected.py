"""Synchronous regimes in which all loads of each exciter are at one angle, and their course over the speed of the drives.

One mass stands for all loads of an exciter: it has the sum of their unbalances, moments of inertia and drags. In the averaged
equations the loads can also separate. Small deviations of the phases of N equal loads whose sum is 0 do not change the total
force of the loads, nor the acceleration of the point about which they turn. The averaged equation of each load becomes

    I d'' + D d' - (S/2) Re(e^{-i psi} a) d = 0

with the deviation d, the phase psi of the loads, and the unbalance S, the moment of inertia I and the drag D of one load. The
complex number a = e^H A contains the amplitudes A of the acceleration of the point; e is the rotating direction. A regime is
stable if the disturbances of the masses and these deviations decay.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.averaged import decays, require_rotating_masses
from jaxvib.equations.torque_balance import TorqueBalance, assemble_for_search, assemble_torque_balance
from jaxvib.machine.loads import Loads
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.runtime.programs import cached
from jaxvib.steady.regimes.synchronous import (
    RegimeStatus,
    SynchronousRegimes,
    fields_of_balance,
    regimes_from,
    require_one_speed,
)

POINTS = 31
"""Number of speeds at which a regime is followed to each side, including the speed of the scene."""


class _CollectedBalance(TorqueBalance):
    """Torque balance in which each mass stands for several loads; `loads_per_mass` is their number."""

    loads_per_mass: tuple[int, ...] = eqx.field(static=True, kw_only=True)

    def total_driving_torque(self, omega: Array, factor: Array | None = None) -> Array:
        """Return `driving_torque`, with the differences from the mean multiplied by `factor`, as in the base class.

        The mean is that of the single loads: the torque of a mass that stands for k loads is compared with k times this mean.
        """
        torque, count = self.driving_torque(omega), jnp.asarray(self.loads_per_mass)
        if factor is None:
            return torque
        mean = jnp.zeros_like(omega) if any(self.is_prescribed) else jnp.sum(torque) / jnp.sum(count)
        return count * mean + factor * (torque - count * mean)


def collected_regimes(scene: Scene) -> SynchronousRegimes:
    """Return the synchronous regimes in which the loads of each exciter stay together.

    The search is that of `synchronous_regimes` for a scene in which one load has the mass and the drag of all loads of its
    exciter. The result contains all loads, and its stability includes the separation of loads. Regimes with separated loads are
    not found. For scenes with unequal loads, or with loads at several stations, the result is that of `synchronous_regimes`.

    **Raises** `InputError` in the cases of `synchronous_regimes`.
    """
    scene = validate_scene(scene)
    require_rotating_masses(scene)
    require_one_speed(scene)
    return regimes_from(scene, assemble_for_search(_with_collected_loads(scene)), _collected_near)


def has_equal_loads(scene: Scene, exciter: int) -> bool:
    """Return True if all loads of the exciter with this number have equal parameters and one station, so that their number can
    be changed."""
    mount, loads = scene.machine.mount(scene.exciters[exciter].place), scene.exciters[exciter].loads
    return mount.at_one_point and all(np.ndim(leaf) == 0 for leaf in jax.tree.leaves(loads))


def _loads_per_mass(scene: Scene) -> tuple[int, ...]:
    """Return how many loads each mass of the scene with collected loads represents; 1 for an unbalance."""
    counts = [1 if exciter.loads is None else exciter.loads.count for exciter in scene.exciters]
    if all(count == 1 or has_equal_loads(scene, k) for k, count in enumerate(counts)):
        return tuple(counts)
    return (1,) * sum(counts)


def _with_collected_loads(scene: Scene) -> Scene:
    """Return the scene in which one load has the mass, the moment of inertia and the drag of all loads of its exciter."""
    several = [k for k, count in enumerate(_loads_per_mass(scene)) if count > 1]
    if not several:
        return scene

    def one_load(loads: Loads) -> Loads:
        names = [name for name in ("mass", "drag", "inertia") if getattr(loads, name, None) is not None]
        return dataclasses.replace(loads, count=1, **{name: loads.count * getattr(loads, name) for name in names})

    single = [one_load(cast(Loads, scene.exciters[k].loads)) for k in several]
    return eqx.tree_at(lambda s: [s.exciters[k].loads for k in several], scene, single)


@cached
def _collected_near(scene: Scene, omega: Array, phases: Array) -> dict[str, Any]:
    return jax.vmap(lambda w, a: _fields_near(scene, w, a))(omega, phases)


def _fields_near(scene: Scene, omega: Array, phases: Array) -> dict[str, Any]:
    """Return the fields of `fields_near` for all loads, from a start with the phases of the collected masses."""
    count = np.asarray(_loads_per_mass(scene))
    collected = assemble_torque_balance(_with_collected_loads(scene))
    parts = {field.name: getattr(collected, field.name) for field in dataclasses.fields(TorqueBalance)}
    balance = _CollectedBalance(**parts, loads_per_mass=tuple(count.tolist()))
    fields = fields_of_balance(balance, omega, phases)
    separation = _separation_growth(balance, fields)[np.flatnonzero(count > 1)]
    growth, quasi_static = (jnp.max(separation, initial=fields[name]) for name in ("growth", "quasi_static"))
    each = np.repeat(np.arange(count.size), count)
    shared = {name: fields[name][each] / count[each] for name in ("torque", "vibrational_torque")}
    stable = fields["stable"] & decays(growth, fields["speed"])
    changed = {"growth": growth, "quasi_static": quasi_static, "stable": stable}
    return {**fields, **changed, **shared, "masses": jnp.arange(each.size), "phases": fields["phases"][each]}


def _separation_growth(balance: TorqueBalance, fields: dict[str, Any]) -> Array:
    """Return the growth rate of deviations of loads from the common phase of their exciter, (mass,) 1/s."""
    averaged = balance.averaged
    acceleration = -(fields["speed"] ** 2) * (balance.direction.conj() @ fields["displacement"])
    stiffness = -averaged.unbalance * (jnp.exp(-1j * fields["phases"]) * acceleration).real / (2.0 * averaged.inertia)
    half = averaged.drag / (2.0 * averaged.inertia)
    return -half + jnp.sqrt(jnp.maximum(half**2 - stiffness, 0.0))


class FollowedRegimes(NamedTuple):
    """r regimes at n factors of the speeds of all drives: `factor` (n,); `speed` (r, n), rad/s; `phases` (r, n, rotating
    masses), rad; `amplitude` (r, n, nd) of the nd coordinates, m or rad; `foundation_force` (r, n), N; `stable` (r, n). Beyond
    the end of a regime the numbers are NaN, and `stable` is False."""

    factor: Array
    speed: Array
    phases: Array
    amplitude: Array
    foundation_force: Array
    stable: Array


@cached
def follow_regimes(
    scene: Scene, speed: Array | np.ndarray, phases: Array | np.ndarray, low: Array | np.ndarray, high: Array | np.ndarray
) -> FollowedRegimes:
    """Follow regimes while all drives change their speed by a common factor, from `low` below 1 to `high` above 1.

    At each factor Newton's method starts from the regime at the previous factor. A regime ends at the factor at which
    Newton's method does not converge.

    **Arguments**: `speed` (r,), rad/s, and `phases` (r, rotating masses), rad, of the regimes at the factor 1.
    """
    first = np.cumsum((0, *_loads_per_mass(scene)))[:-1]

    def at(factor: Array, start: tuple[Array, Array]) -> tuple[tuple[Array, Array], FollowedRegimes]:
        speeds = [factor * exciter.drive.speed for exciter in scene.exciters]
        changed = eqx.tree_at(lambda s: [exciter.drive.speed for exciter in s.exciters], scene, speeds)
        names = ("speed", "phases", "amplitude", "foundation_force", "stable")
        fields = _fields_near(changed, *start)
        is_lost = fields["status"] == RegimeStatus.not_converged
        w, a = (jnp.where(is_lost, jnp.nan, fields[name]) for name in names[:2])
        return (w, a[first]), FollowedRegimes(factor, *(fields[name] for name in names))

    def along(end: Array, w: Array, a: Array) -> FollowedRegimes:
        factors = 1.0 + (end - 1.0) * jnp.linspace(0.0, 1.0, POINTS)
        return jax.lax.scan(lambda carry, factor: at(factor, carry), (w, a), factors)[1]

    def follow(w: Array, a: Array) -> FollowedRegimes:
        both = jax.vmap(along, in_axes=(0, None, None))(jnp.asarray([low, high]), w, a)
        return jax.tree.map(lambda leaf: jnp.concatenate([leaf[0, :0:-1], leaf[1]]), both)

    found = jax.vmap(follow)(jnp.asarray(speed), jnp.asarray(phases)[:, first])
    return found._replace(factor=found.factor[0])
