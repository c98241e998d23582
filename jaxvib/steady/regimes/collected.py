"""Synchronous regimes in which all loads of each exciter are at one angle, and their course over the speed of the drives."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.averaged import require_rotating_masses
from jaxvib.equations.torque_balance import assemble_for_search
from jaxvib.machine.loads import Loads
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.runtime.programs import cached
from jaxvib.steady.regimes.search import MAX_COMPLETE, all_regimes
from jaxvib.steady.regimes.synchronous import (
    RegimeSearchStatus,
    RegimeStatus,
    SynchronousRegimes,
    fields_near,
    regimes_from,
    require_one_speed,
    synchronous_regimes,
)

POINTS = 31
"""Number of speeds at which a regime is followed to each side, including the speed of the scene."""


def collected_regimes(scene: Scene) -> SynchronousRegimes:
    """Return the synchronous regimes in which the loads of each exciter stay together.

    The search is that of `synchronous_regimes` for a scene in which one load has the mass and the drag of all loads of its
    exciter. The result contains all loads, and its stability includes the separation of loads. Regimes with separated loads are
    not found. For scenes with unequal loads, or with loads at several stations, the result is that of `synchronous_regimes`.

    **Raises** `InputError` in the cases of `synchronous_regimes`.
    """
    scene = validate_scene(scene)
    counts = [1 if exciter.loads is None else exciter.loads.count for exciter in scene.exciters]
    several = [k for k, count in enumerate(counts) if count > 1]
    if not several or not all(has_equal_loads(scene, k) for k in several):
        return synchronous_regimes(scene)
    single = [_one_load(cast(Loads, scene.exciters[k].loads)) for k in several]
    require_rotating_masses(scene)
    require_one_speed(scene)
    balance = assemble_for_search(eqx.tree_at(lambda s: [s.exciters[k].loads for k in several], scene, single))
    omega, phases = all_regimes(balance)
    is_complete = balance.unbalance.size <= MAX_COMPLETE
    search = RegimeSearchStatus.done if is_complete else RegimeSearchStatus.sampled
    return regimes_from(scene, omega, np.repeat(phases, counts, axis=1), search=search)


def has_equal_loads(scene: Scene, exciter: int) -> bool:
    """Return True if all loads of the exciter with this number have equal parameters and one station, so that their number can
    be changed."""
    mount, loads = scene.machine.mount(scene.exciters[exciter].place), scene.exciters[exciter].loads
    return mount.at_one_point and all(np.ndim(leaf) == 0 for leaf in jax.tree.leaves(loads))


def _one_load(loads: Loads) -> Loads:
    """Return one load with the mass, the moment of inertia and the drag of all loads."""
    names = [name for name in ("mass", "drag", "inertia") if getattr(loads, name, None) is not None]
    return dataclasses.replace(loads, count=1, **{name: loads.count * getattr(loads, name) for name in names})


class FollowedRegimes(NamedTuple):
    """r regimes at n factors of the speeds of all drives: `factor` (n,); `speed` (r, n), rad/s; `phases` (r, n, rotating
    masses), rad; `amplitude` (r, n, nd); `foundation_force` (r, n), N; `stable` (r, n). Values beyond the end of a regime are
    NaN."""

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

    def at(factor: Array, start: tuple[Array, Array]) -> tuple[tuple[Array, Array], FollowedRegimes]:
        speeds = [factor * exciter.drive.speed for exciter in scene.exciters]
        changed = eqx.tree_at(lambda s: [exciter.drive.speed for exciter in s.exciters], scene, speeds)
        names = ("speed", "phases", "amplitude", "foundation_force", "stable")
        fields = fields_near(changed, *start, None)
        is_lost = fields["status"] == RegimeStatus.not_converged
        w, a = (jnp.where(is_lost, jnp.nan, fields[name]) for name in names[:2])
        return (w, a), FollowedRegimes(factor, *(fields[name] for name in names))

    def along(end: Array, w: Array, a: Array) -> FollowedRegimes:
        factors = 1.0 + (end - 1.0) * jnp.linspace(0.0, 1.0, POINTS)
        return jax.lax.scan(lambda carry, factor: at(factor, carry), (w, a), factors)[1]

    def follow(w: Array, a: Array) -> FollowedRegimes:
        both = jax.vmap(along, in_axes=(0, None, None))(jnp.asarray([low, high]), w, a)
        return jax.tree.map(lambda leaf: jnp.concatenate([leaf[0, :0:-1], leaf[1]]), both)

    found = jax.vmap(follow)(jnp.asarray(speed), jnp.asarray(phases))
    return found._replace(factor=found.factor[0])
