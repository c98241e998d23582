"""Motions of rotating masses in groups: each group turns at one speed, different groups at different speeds.

The mean torque between masses of different speeds is zero. The torque of mass k on mass i alternates at the difference of their
speeds, with the amplitude

    T_ik = (S_i S_k / 2) w_k^4 |H_ik(w_k)|

where w_i is the speed of mass i, S_i its unbalance, and H_ik the influence coefficient of the masses (see `local`). The torque
changes the speed of mass i, whose inertia is I_i and whose driving torque has the slope L_i' = dL_i/dw_i. The change alternates
at the difference d = w_k - w_i, with the amplitude T_ik/sqrt((d I_i)^2 + L_i'^2). The groups are independent if this amplitude
is small compared with |d|. For each mass i, the ratios of amplitude to |d| are added over the masses k of all other groups. The
`interaction` of a motion is the largest of these sums.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, speed_text
from jaxvib.equations.averaged import require_rotating_masses
from jaxvib.equations.torque_balance import assemble_for_search, assemble_torque_balance, influence_of, mass_owners
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.validation import validate_scene, weight_notes
from jaxvib.numerics.linalg import magnitude
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import status_name
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.steady.outcome import require_index
from jaxvib.steady.regimes.search import exchanges_in
from jaxvib.steady.regimes.symmetry import Exchange
from jaxvib.steady.regimes.synchronous import (
    RegimeSearchStatus,
    SynchronousRegime,
    SynchronousRegimes,
    synchronous_regimes,
)

_MAX_MASSES = 6
"""Largest number of rotating masses; 6 have 63 possible groups and 203 partitions."""

_LARGEST_INTERACTION = 1.0
"""Interaction above which groups are not independent."""

_EQUAL_SPEEDS = 1e-9
"""Relative difference of speeds below which two groups are not different."""

_EQUAL_NUMBERS, _EQUAL_PHASES = 1e-5, 1e-3
"""Differences of speeds and torques, relative to the largest, and of exp(i alpha) below which two motions count as one."""

_MOTIONS_PER_PROGRAM = 64
"""Number of motions whose interaction is computed in one program."""


class RegimePartitions(Result):
    """Motions of rotating masses in groups, each with one speed. Returned by `regime_partitions`.

    Stable motions come first; among the stable ones, and among the others, those with fewer groups come first.

    **Attributes** (n motions)

    - `status`: a `RegimeSearchStatus`
    - `group` (n, mass): number of the group of each rotating mass, from 0
    - `speed` (n, mass), rad/s, and `phases` (n, mass), rad, of each rotating mass; the phases of a group are those of a
      `SynchronousRegime` of the group
    - `growth` (n,), 1/s: the largest growth rate of a small disturbance of any group, see `SynchronousRegime`; `stable` (n,):
      True if it is negative by more than a rounding error
    - `interaction` (n,): estimated relative error of the differences of the speeds; the error arises because groups act on each
      other. It is 0 for a single group; typical: 1e-4 to 0.3
    - `scene`
    """

    status: RegimeSearchStatus
    group: np.ndarray = eqx.field(metadata=in_unit("", "motion", "mass"))
    speed: np.ndarray = eqx.field(metadata=in_unit("rad/s", "motion", "mass"))
    phases: np.ndarray = eqx.field(metadata=in_unit("rad", "motion", "mass"))
    growth: np.ndarray = eqx.field(metadata=in_unit("1/s", "motion"))
    stable: np.ndarray = eqx.field(metadata=in_unit("", "motion"))
    interaction: np.ndarray = eqx.field(metadata=in_unit("", "motion"))
    scene: Scene = eqx.field(metadata=SCENE)

    @validated
    def select(self, index: int) -> list[SynchronousRegime]:
        """Return the regime of each group of the motion with an `index`, counted from 0.

        **Raises** `InputError` if there are fewer motions.
        """
        require_index(index, self.speed.shape[0], "motions")
        regimes = []
        for number in range(int(np.max(self.group[index])) + 1):
            masses = np.flatnonzero(self.group[index] == number)
            near = float(self.speed[index, masses[0]]), jnp.asarray(self.phases[index, masses])
            regimes.append(synchronous_regimes(self.scene, masses=masses.tolist(), near=near))
        return regimes

    def summary(self) -> str:
        """Return a line of text for each motion: the masses of each group, counted from 1, and its speed. A note follows if the
        weight of the unbalances can change the stability of a motion."""
        lines = []
        for group, speed, stable, growth, interaction in zip(
            self.group, self.speed, self.stable, self.growth, self.interaction, strict=True
        ):
            named = []
            for number in range(int(np.max(group)) + 1):
                masses = np.flatnonzero(group == number)
                named.append(f"{', '.join(map(str, masses + 1))}: {speed_text(speed[masses[0]], 6)}")
            judged = f"{'stable' if stable else 'unstable'} ({growth:.3g} 1/s), interaction {interaction:.2g}"
            lines.append(f"{'; '.join(named)}; {judged}")
        slowest = np.min(np.asarray(self.speed)[np.asarray(self.stable)], axis=0, initial=np.inf)
        notes = weight_notes(self.scene, dict(zip(mass_owners(self.scene).tolist(), slowest.tolist(), strict=True)))
        return "\n".join([*lines, *notes]) or RegimeSearchStatus[RegimeSearchStatus.none]

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the speed of each mass over the number of the motion."""
        from jaxvib.draw.results import points_chart  # slow import

        return points_chart(self.speed, x_label="motion", y_label="speed, rad/s", ax=ax)


@validated
def regime_partitions(scene: Scene, *, stable: bool = True) -> RegimePartitions:
    """Return the motions in which rotating masses turn in groups of different speeds, by averaging over a turn.

    Unbalances or loads that cannot synchronize, or of which a resonance catches only some, turn at different speeds. At this
    order of the averaging, groups of different speeds do not act on each other. A motion is therefore a partition of the
    masses into groups, and a synchronous regime of each group. Motions of a single group are included.

    - The groups are independent if the torques between them change the differences of their speeds little; the ratio is
      `interaction`. Motions whose interaction is above 1 are left out
    - Motions that differ by an exchange of equal exciters are listed once

    **Arguments**

    - `scene` as for `synchronous_regimes`, with 1 to 6 rotating masses
    - `stable`: True (the default) for motions whose groups are all stable; False for all motions, which can be thousands

    **Returns** `RegimePartitions`.

    **Raises** `InputError` in the cases of `synchronous_regimes`, and for more than 6 rotating masses.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    >>> screen = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    >>> motors = [jv.DCMotor(n, stall_torque=60.0, inertia=0.05) for n in (100.0, 60.0)]
    >>> exciters = [jv.Exciter(drive=m, unbalance=0.4, at=(x, 0.0)) for m, x in zip(motors, (-0.3, 0.3))]
    >>> found = jv.regime_partitions(jv.Scene(screen, exciters=exciters))
    >>> found.group.tolist(), found.speed.round().tolist()
    ([[0, 1]], [[100.0, 60.0]])

    Source: Blekhman 1988, Synchronization in Science and Technology.
    """
    scene = validate_scene(scene)
    require_rotating_masses(scene)
    owners = mass_owners(scene)
    count = owners.size
    if count > _MAX_MASSES:
        raise InputError("scene", f"has {count} rotating masses; at most {_MAX_MASSES} are possible, which have 63 groups")
    subsets = [each for size in range(1, count + 1) for each in itertools.combinations(range(count), size)]
    regimes = {
        subset: _regimes_of_group(scene, subset, stable=stable) for subset in subsets if _can_share(scene, owners[list(subset)])
    }
    motions = [_motion(parts, count) for parts in _products(tuple(range(count)), regimes)]
    if motions:
        rows = _Rows(*map(np.array, zip(*motions, strict=True)))
    else:
        none = np.zeros((0, count))
        rows = _Rows(none.astype(int), none, none, none, none.astype(bool), np.zeros(0), np.zeros(0, bool))
    interaction = in_chunks(_MOTIONS_PER_PROGRAM, _interactions, rows.speed, rows.group, shared=(scene,))
    kept = np.flatnonzero(interaction <= _LARGEST_INTERACTION)
    kept = kept[np.lexsort((np.max(rows.group[kept], axis=1, initial=0), ~rows.stable[kept]))]
    kept = kept[_distinct_motions(_Rows(*(field[kept] for field in rows)), exchanges_in(assemble_for_search(scene)))]
    return RegimePartitions(
        status=RegimeSearchStatus.done if kept.size else RegimeSearchStatus.none,
        group=rows.group[kept],
        speed=rows.speed[kept],
        phases=rows.phases[kept],
        growth=rows.growth[kept],
        stable=rows.stable[kept],
        interaction=interaction[kept],
        scene=scene,
    )


class _Rows(NamedTuple):
    """Motions: `group`, `speed`, `phases`, `torque` (n, masses), `family`: True in a group whose regime is one of a family;
    `growth` and `stable` (n,)."""

    group: np.ndarray
    speed: np.ndarray
    phases: np.ndarray
    torque: np.ndarray
    family: np.ndarray
    growth: np.ndarray
    stable: np.ndarray


def _can_share(scene: Scene, owners: np.ndarray) -> bool:
    """Return False if ideal drives turn unbalances of the exciters `owners` at different speeds."""
    exciters = [scene.exciters[k] for k in owners]
    return len({float(each.drive.speed) for each in exciters if each.loads is None and each.drive.ideal}) < 2


def _regimes_of_group(scene: Scene, subset: tuple[int, ...], *, stable: bool) -> list[SynchronousRegime]:
    """Return the regimes of a group of masses."""
    found: SynchronousRegimes = synchronous_regimes(scene, masses=subset)
    finite = np.isfinite(np.asarray(found.speed))
    wanted = np.flatnonzero(finite & np.asarray(found.stable) if stable else finite)
    numpy = jax.tree.map(np.asarray, eqx.filter(found, eqx.is_array))
    found = eqx.combine(numpy, found)
    return [found.select(int(k)) for k in wanted]


_Group = tuple[tuple[int, ...], SynchronousRegime]


def _products(left: tuple[int, ...], regimes: dict[tuple[int, ...], list[SynchronousRegime]]) -> Iterator[list[_Group]]:
    """Yield all partitions of the masses `left` into groups, with each combination of their regimes."""
    if not left:
        yield []
        return
    for subset, found in regimes.items():
        if subset[0] == left[0] and set(subset) <= set(left):
            rest = tuple(k for k in left if k not in subset)
            for others in _products(rest, regimes):
                yield from ([(subset, regime), *others] for regime in found)


def _motion(parts: list[_Group], count: int) -> tuple:
    """Return the fields of `_Rows` of a motion."""
    group, family, (speed, phases, torque) = np.zeros(count, int), np.zeros(count, bool), np.zeros((3, count))
    for number, (subset, regime) in enumerate(parts):
        masses = list(subset)
        group[masses], family[masses] = number, status_name(regime.status) == "degenerate"
        speed[masses], phases[masses], torque[masses] = regime.speed, regime.phases, regime.torque
    growth = float(np.max([regime.growth for _, regime in parts]))  # NaN if one of them is unknown
    return group, speed, phases, torque, family, growth, all(bool(regime.stable) for _, regime in parts)


@cached
def _interactions(speed: Array, group: Array, scene: Scene) -> Array:
    """Return the interaction (n,) of motions whose masses turn at `speed` (n, masses) in their `group` (n, masses)."""
    balance = assemble_torque_balance(scene)
    unbalance, inertia = balance.unbalance, balance.averaged.inertia

    def interaction(speed: Array, group: Array) -> Array:
        influence = jax.vmap(lambda w: magnitude(influence_of(balance, w, speed)))(speed)
        from_each = jnp.diagonal(influence, axis1=0, axis2=2)  # (i, k): at the speed of mass k
        torque = 0.5 * unbalance[:, None] * unbalance[None] * speed[None] ** 4 * from_each
        slope = jnp.diagonal(jax.jacfwd(balance.driving_torques)(speed))
        difference = speed[None] - speed[:, None]
        resistance = jnp.abs(difference) * jnp.sqrt((difference * inertia[:, None]) ** 2 + slope[:, None] ** 2)
        acts = (group[None] != group[:, None]) & (torque > 0.0) & jnp.isfinite(inertia)[:, None]
        equal = (group[None] != group[:, None]) & (jnp.abs(difference) <= _EQUAL_SPEEDS * jnp.abs(speed)[None])
        found = jnp.max(jnp.sum(jnp.where(acts, torque / resistance, 0.0), axis=1))
        return jnp.where(jnp.any(equal), jnp.inf, found)

    return jax.vmap(interaction)(speed, group)


def _distinct_motions(motions: _Rows, exchanges: list[Exchange]) -> np.ndarray:
    """Return indices of motions of which no two differ only by an exchange of masses, or by common shifts of groups."""
    permutations, shifts = (np.array(parts) for parts in zip(*exchanges, strict=True))
    inverses = np.argsort(permutations)
    numbers = np.stack([motions.speed, motions.torque], axis=-1)
    scale = _EQUAL_NUMBERS * np.max(np.abs(numbers), axis=(0, 1), initial=1e-300)
    phasors = np.exp(1j * motions.phases)
    # For each pair of masses of one group the difference of their phases, as a phasor; 1 in a family, 0 for two groups.
    group, family = motions.group[:, :, None] == motions.group[:, None], motions.family[:, :, None] & motions.family[:, None]
    pairs = np.where(group & ~family, phasors[:, :, None] * phasors[:, None].conj(), group)
    kept: list[int] = []
    for k, motion in enumerate(numbers):
        turned = pairs[k] * np.where(family[k], 1.0, np.exp(1j * (shifts[:, :, None] - shifts[:, None])))
        exchanged = np.take_along_axis(np.take_along_axis(turned, inverses[:, :, None], 1), inverses[:, None], 2)
        equal = np.all(np.abs(motion[inverses] - numbers[kept][:, None]) <= scale, axis=(2, 3))
        equal &= np.all(np.abs(exchanged - pairs[kept][:, None]) <= _EQUAL_PHASES, axis=(2, 3))
        if not np.any(equal):
            kept.append(k)
    return np.asarray(kept, dtype=int)
