"""Every jam of a scene at unequal phases, and phase patterns followed over the drag."""

from __future__ import annotations

from typing import TYPE_CHECKING, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.averaged import averaged_growth
from jaxvib.errors import InputError
from jaxvib.machine.checked import checked
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.numerics.linalg import damped_newton
from jaxvib.results.fields import in_unit
from jaxvib.results.status import sentence
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.phase_branch import PhaseBranch, drag_curve
from jaxvib.steady.jams.phases import (
    AbstractPhaseJam,
    Parts,
    PhaseJam,
    PhaseStatus,
    balanced,
    influence_of,
    jam_from,
    loads_with_drag,
    parts_of,
    phase_jam,
    torques_at,
)
from jaxvib.units import count

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxvib.draw.style import Drawn, SpeedUnit

__all__ = ["PhaseJams", "phase_branch", "phase_jams"]

_GRID = 240
"""Load speeds at which phases are looked for, besides those near resonances."""

_SHOWN = 30.0
"""So many times the scene's drag, and the same part of it, a figure of all jams reaches."""

_SAME_LINE = 5e-3
"""Unstable patterns whose drags differ by less, relative, are drawn once."""

_SAME = 1e-6
"""Jams whose speeds differ by less, relative, and whose phases do not, are one."""

_HALVINGS = 6
"""Of the stretch between two load speeds that a jam lies in, before Newton's method takes over."""


class PhaseJams(AbstractPhaseJam):
    """Every jam that was found: the arrays of `AbstractPhaseJam` with a leading axis, by falling speed of the loads, stable
    ones first where speeds are equal; `starts` (n,): how many of the starts led to each; and the `scene`."""

    outer_axes = ("jam",)

    starts: Array = eqx.field(metadata=in_unit("", "jam"))
    scene: Scene = eqx.field(metadata=SCENE)

    def select(self, index: int) -> PhaseJam:
        """The jam of that place, counted from 0. **Raises** `InputError` where there are not so many."""
        n = self.omega.shape[0]
        if isinstance(index, bool) or not isinstance(index, (int, np.integer)) or not 0 <= index < n:
            raise InputError("index", f"is {index!r}; there are {n} jams, counted from 0")
        fields = {name: getattr(self, name) for name in PhaseJam.__dataclass_fields__}
        return PhaseJam(**jax.tree.map(lambda leaf: leaf[index], fields))

    def follow(self, index: int, omega: Array) -> PhaseBranch:
        """The phase pattern of the jam of that place over load speeds `omega` (n,) rad/s, see `phase_branch`."""
        return phase_branch(self.scene, self.select(index), omega)

    def summary(self) -> str:
        """A table a person can read; amplitudes zero to peak, phases in degrees."""
        return "\n".join(self.select(k).summary() for k in range(self.omega.shape[0])) or "no jam"

    def plot(self, *, unit: SpeedUnit = "rad/s", ax: Axes | None = None) -> Drawn:
        """Speeds of the loads over the drag, from a 30th of the scene's to 30 times it, of every pattern that jams at the
        scene's, in colours by how the loads stand there; stable solid, unstable dashed, and the jams themselves as points.

        **Returns** a matplotlib figure, or the given `ax`. **Raises** `InputError` for another unit.
        """
        from jaxvib.draw.phases import drag_diagram  # slow to import: only who draws pays

        omega = np.asarray(self.omega)
        speeds = np.unique(np.concatenate([_load_speeds(parts_of(self.scene)), omega]))
        branches: list[PhaseBranch] = []
        curves = []
        for k, place in enumerate(np.searchsorted(speeds, omega)):
            jam = self.select(k)
            if not any(_passes(branch, place, jam.growth) for branch in branches):
                branches.append(phase_branch(self.scene, jam, jnp.asarray(speeds)))
                factor, at, stable = drag_curve(branches[-1])
                for _, other, _, _ in curves:
                    # Dashes on other dashes would look like a line that is not broken.
                    factor = np.where(~stable & (np.abs(factor - other) < _SAME_LINE * factor), np.nan, factor)
                curves.append((sentence(jam.pattern), factor, at, stable))
        top, jams = float(self.scene.drive.speed), (omega, np.asarray(self.stable))
        label = "drag, times the scene's"
        return drag_diagram(curves, top, label=label, at=1.0, jams=jams, within=_SHOWN, unit=unit, ax=ax)


@overload
def phase_jams(scene: Scene, *, starts: int = 128, seed: int = 0) -> PhaseJams: ...


@overload
def phase_jams(scene: Scene, *, near: tuple[Array, Array]) -> PhaseJam: ...


def phase_jams(
    scene: Scene, *, starts: int = 128, seed: int = 0, near: tuple[Array, Array] | None = None
) -> PhaseJams | PhaseJam:
    """Every way in which the scene's light loads can jam at its rotor speed, whatever their phases.

    At each of many load speeds, closer together near resonances, phases are looked for at which all loads need the same
    multiple of their drag, from `starts` random sets of phases and some regular ones; where that multiple passes 1 from one
    load speed to the next, the speed is solved for as well (`phase_jam`). What differs by a common turn, or by which of
    several equal loads stands where, is one jam. Loads that turn with the rotor and balance it are left out.

    A rotor out of balance (`StaticImbalance`, `MomentImbalance`) leaves a jam where it is: it shakes at the rotor's speed,
    loads at theirs, so that no mean torque comes of it at this order. Its vibration and force come on top: the amplitudes and
    the foundation force are the loads' alone. Where both count, ask `simulate`.

    **Arguments**: `starts`: random sets of phases at each load speed; `seed` which. Stable jams are found with a few; unstable
    ones close to where patterns part from each other take many. `near`: a speed (rad/s) and phases (count,) rad of the loads,
    from which Newton's method finds one jam, see `phase_jam`; `jit`, `vmap` and `grad` go through it then.

    **Returns** `PhaseJams`, or `PhaseJam` with `near`. **Raises** `InputError` for loads without drag, drives without a given
    speed, and effects that this theory leaves out.

    >>> import jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
    >>> jams = jv.phase_jams(scene)
    >>> [round(float(w), 1) for w in jams.omega], [bool(s) for s in jams.stable]
    ([412.8, 199.4, 164.6], [False, False, True])

    Source: Artyunin 2013, section V; leading order of the loads' mass, see `jam_modes` for loads at one angle.
    """
    scene = checked(scene)
    if near is not None:
        return phase_jam(scene, *near)
    loads = loads_with_drag(scene)
    number = count(starts, "starts", each=64.0 * loads.count * _GRID)
    parts = parts_of(scene)
    speeds = _load_speeds(parts)
    rng = np.random.default_rng(count(seed, "seed", low=0))
    sets = [rng.uniform(-np.pi, np.pi, (number, loads.count)), _regular(parts)]
    phases = np.concatenate(sets)
    factor, angles, good = _phases_at(parts, jnp.asarray(speeds), jnp.asarray(phases))
    omega, phase = _starts(parts, speeds, np.asarray(factor), np.asarray(angles), np.asarray(good))
    many = _power_of_2(omega.size)
    omega, phase = (np.asarray(x)[: omega.size] for x in _many(parts, jnp.asarray(omega[many]), jnp.asarray(phase[many])))
    groups = _equal_loads(parts)
    starts_at = np.flatnonzero(np.isfinite(omega) & (omega > 0.0) & (omega < float(parts.speed)))
    places, reached = _distinct(omega[starts_at], phase[starts_at], np.ones(starts_at.size, dtype=int), groups)
    # Where a start was solved for hardly, the same jam comes out once more: what is distinct is told of the jams themselves.
    jams = [jam_from(scene, jnp.asarray(omega[k]), jnp.asarray(phase[k])) for k in starts_at[places]]
    found = [k for k, jam in enumerate(jams) if bool(jam.status == PhaseStatus.found)]
    speeds, angles = (np.asarray([getattr(jams[k], name) for k in found]) for name in ("omega", "phase"))
    places, reached = _distinct(speeds, angles, reached[found], groups)
    if not found:
        # Nothing was found: the arrays are empty.
        jams = [jam_from(scene, parts.speed, jnp.asarray(phases[0]))]
    order = sorted(range(len(places)), key=lambda i: (-round(speeds[places[i]], 6), not bool(jams[found[places[i]]].stable)))
    keep = np.asarray([found[places[i]] for i in order], dtype=int)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves)[keep], *jams)
    fields = {name: getattr(stacked, name) for name in PhaseJam.__dataclass_fields__}
    return PhaseJams(**fields, starts=jnp.asarray(reached[order], dtype=int), scene=scene)


def _distinct(
    omega: np.ndarray, phase: np.ndarray, starts: np.ndarray, groups: list[np.ndarray]
) -> tuple[list[int], np.ndarray]:
    """Places of jams (n,) that differ, by falling speed, and how many of the `starts` (n,) of all of them led to each."""
    places: list[int] = []
    reached: list[int] = []
    for k in np.argsort(-omega, kind="stable"):
        same = (i for i, p in enumerate(places) if abs(omega[p] - omega[k]) < _SAME * omega[p])
        place = next((i for i in same if _same(phase[places[i]], phase[k], groups)), None)
        if place is None:
            places.append(int(k))
            reached.append(int(starts[k]))
        else:
            reached[place] += int(starts[k])
    return places, np.asarray(reached, dtype=int)


def _starts(
    parts: Parts, speeds: np.ndarray, factor: np.ndarray, phase: np.ndarray, good: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Speeds and phases to solve from, given the drag multiples (no, ns) of phases (no, ns, count) at load `speeds` (no,).

    Where a pattern, followed to the next load speed up or down, passes the multiple 1 there is a jam between the two, which is
    narrowed down by halving. Points whose own multiple is near 1 are starts too.
    """
    places = np.flatnonzero(good)
    if places.size == 0:
        return speeds[:1], phase[:1, 0]
    row, size = places // good.shape[1], np.log(factor.ravel()[places])
    angles = phase.reshape(-1, phase.shape[-1])[places]
    digits = [1e4 * size[:, None], 1e3 * np.cos(angles), 1e3 * np.sin(angles)]
    kinds = np.concatenate([row[:, None], *(np.round(d).astype(int) for d in digits)], axis=1)
    once = np.unique(kinds, axis=0, return_index=True)[1]
    row, size, angles = row[once], size[once], angles[once]
    near = np.abs(size) < np.log(3.0)
    omega, phases = [speeds[row[near]]], [angles[near]]
    for side in (-1, 1):
        beside = speeds[np.clip(row + side, 0, speeds.size - 1)]
        there, _, found = _follow(parts, beside, angles)
        low, high, held = (x[found & (size * there < 0.0)] for x in (speeds[row], beside, np.arange(row.size)))
        at, sign = angles[held], np.sign(size[held])
        for _ in range(_HALVINGS):
            middle = (low + high) / 2.0
            there, turned, found = _follow(parts, middle, at)
            same = found & (there * sign > 0.0)
            low, high, at = np.where(same, middle, low), np.where(same, high, middle), np.where(same[:, None], turned, at)
        omega.append(low)
        phases.append(at)
    return np.concatenate(omega), np.concatenate(phases)


def _follow(parts: Parts, omega: np.ndarray, phase: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`_phases` at each of some load speeds (n,) from its own start (n, count), with the logarithm of the drag's multiple."""
    if omega.size == 0:
        return omega, phase, omega > 0.0
    many = _power_of_2(omega.size)
    factor, angles, good = (
        np.asarray(x)[: omega.size] for x in _followed_phases(parts, jnp.asarray(omega[many]), jnp.asarray(phase[many]))
    )
    return np.log(np.where(good, factor, 1.0)), angles, good


@cached
def _followed_phases(parts: Parts, omega: Array, phase: Array) -> tuple[Array, Array, Array]:
    return jax.vmap(lambda w, start: _phases(parts, influence_of(parts, w)[0], w, start))(omega, phase)


def _power_of_2(n: int) -> np.ndarray:
    """Places 0 .. n - 1, starting over until there is a power of 2 of them, so that few scenes compile anew."""
    return np.resize(np.arange(n), 2 ** int(np.ceil(np.log2(max(n, 1024)))))


@cached
def _many(parts: Parts, omega: Array, phase: Array) -> tuple[Array, Array]:
    """`balanced` from many speeds and phases."""
    return eqx.filter_vmap(balanced, in_axes=(None, 0, 0))(parts, omega, phase)


@cached
def _phases_at(parts: Parts, omega: Array, phase: Array) -> tuple[Array, Array, Array]:
    """`_phases` at load speeds (no,) from starts (ns, count): drag multiples (no, ns), phases (no, ns, count), success."""
    influences = jax.vmap(lambda w: influence_of(parts, w)[0])(omega)
    return jax.vmap(lambda w, a: jax.vmap(lambda start: _phases(parts, a, w, start))(phase))(omega, influences)


def _phases(parts: Parts, influence: Array, omega: Array, start: Array) -> tuple[Array, Array, Array]:
    """The multiple of the drag and the phases (count,) of a jam at a given load speed, near `start` (count,); whether found.

    All loads must need the same multiple, - T_j / (b_j R_j^2 (n - w)): it is explicit, and the phases are all that is sought.
    """

    def needs(x: Array) -> Array:
        angles = jnp.concatenate([jnp.zeros(1, x.dtype), x])
        return -torques_at(parts, influence, omega, angles) / (parts.drag * (parts.speed - omega))

    scale = jnp.sum(jnp.abs(influence) * parts.unbalance[:, None] * parts.unbalance[None, :]) * omega**4 / jnp.min(parts.drag)
    scale = scale / jnp.abs(parts.speed - omega)

    def differ(x: Array) -> Array:
        each = needs(x) / scale
        return each[1:] - each[:-1]

    x = damped_newton(differ, start[1:] - start[0]) if start.shape[0] > 1 else start[1:]
    each = needs(x)
    good = (jnp.max(jnp.abs(each - each[0])) < 1e-8 * scale) & (each[0] > 0.0)
    return each[0], jnp.concatenate([jnp.zeros(1, x.dtype), x]), good


def _passes(branch: PhaseBranch, place: int, growth: Array) -> bool:
    """Whether the branch has the jam of this growth, or its mirror image, at that place and the scene's own drag."""
    near = abs(float(branch.drag_factor[place]) - 1.0) < 1e-4
    return near and abs(float(branch.growth[place] - growth)) < 1e-3 * abs(float(growth))


def phase_branch(scene: Scene, jam: PhaseJam, omega: Array) -> PhaseBranch:
    """The phase pattern of `jam` followed over load speeds `omega` (n,) rad/s, ascending, below the rotor's.

    The drag is explicit in the load speed, so that there is no turning back at folds: where the drag factor has an extremum
    over `omega`, two jams of the pattern merge. Where a pattern ends, what comes next may be another one: phases jump there.

    **Returns** `PhaseBranch`. **Raises** `InputError` for speeds that do not ascend or are not between 0 and the rotor's.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
    >>> jam = phase_jam(scene, 165.0, jnp.zeros(2))
    >>> branch = phase_branch(scene, jam, jnp.array([150.0, float(jam.omega), 172.0]))
    >>> [round(float(x), 3) for x in branch.drag_factor], [bool(x) for x in branch.stable]
    ([0.212, 1.0, 2.21], [True, True, True])
    """
    loads = loads_with_drag(scene)
    speeds = np.asarray(omega, dtype=float)
    top = float(scene.drive.speed)
    if speeds.ndim != 1 or not np.all((speeds > 0.0) & (speeds < top)) or not np.all(np.diff(speeds) > 0.0):
        raise InputError("omega", f"must be a list of load speeds that ascend, above 0 and below the rotor's {top:g}")
    # From the jam upward, then from the jam downward.
    places, cut = np.arange(speeds.size), int(np.searchsorted(speeds, float(jam.omega)))
    order = np.concatenate([places[cut:], places[:cut][::-1]])
    followed = _followed(scene, jam.phase, jnp.asarray(speeds[order]), jnp.asarray(places == speeds.size - cut))
    values = (value[np.argsort(order)] for value in followed)
    drag = jnp.broadcast_to(loads.drag, (loads.count,))
    return PhaseBranch(jnp.asarray(speeds), *values, rotor_speed=scene.drive.speed, drag=drag)


@cached
def _followed(scene: Scene, phase: Array, omega: Array, anew: Array) -> tuple[Array, ...]:
    """The pattern at load speeds (n,), each from that of the one before, or from `phase` itself where `anew` (n,)."""
    parts = parts_of(scene)

    def step(last: Array, at: tuple[Array, Array]) -> tuple[Array, tuple[Array, ...]]:
        w, begins = at
        start = jnp.where(begins, phase, last)
        influence, answer = influence_of(parts, w)
        factor, angles, good = _phases(parts, influence, w, start)
        braked = eqx.tree_at(lambda field: field.drag, parts.averaged, factor * parts.drag)
        growth = averaged_growth(braked, w, angles, w**2 * answer @ (parts.unbalance * jnp.exp(1j * angles)))
        factor, growth = (jnp.where(good, value, jnp.nan) for value in (factor, growth))
        return jnp.where(good, angles, start), (factor, jnp.where(good, angles, jnp.nan), growth, good & (growth < 0.0))

    return jax.lax.scan(step, phase, (omega, anew))[1]


def _load_speeds(parts: Parts) -> np.ndarray:
    """Load speeds below the rotor's, closer together near the carrier's resonances at this rotor speed."""
    mass, nd = np.asarray(parts.model.mass), parts.model.mass.shape[0]
    stiffness, damping = np.asarray(parts.model.carrier.stiffness), np.asarray(parts.model.damping(parts.speed))
    flow = np.linalg.solve(mass, np.concatenate([-stiffness, -damping], axis=1))
    poles = np.linalg.eigvals(np.concatenate([np.eye(nd, 2 * nd, nd), flow]))
    speed = float(parts.speed)
    centres = np.unique(np.abs(poles[np.abs(poles.imag) > 0.0].imag))
    apart = np.concatenate([[0.0], np.geomspace(1e-4, 0.3, 30)])
    crowd = [w * (1.0 + side * apart) for w in centres for side in (-1.0, 1.0)]
    top = speed * (1.0 - np.geomspace(1e-6, 0.1, 12))
    speeds = np.unique(np.concatenate([np.linspace(0.02, 0.98, _GRID) * speed, top, *crowd]))
    return speeds[(speeds > 1e-3 * speed) & (speeds < speed)]


def _regular(parts: Parts) -> np.ndarray:
    """Regular sets of phases (ns, count): together, and every split into two opposite groups."""
    n = parts.unbalance.shape[0]
    splits = range(2 ** min(n - 1, 5))
    return np.array([[np.pi * ((k >> j) & 1) if j < min(n - 1, 5) else 0.0 for j in range(n)] for k in splits])


def _equal_loads(parts: Parts) -> list[np.ndarray]:
    """Groups of loads that are alike in every number, by their places."""
    rows = np.concatenate(
        [parts.direction.real, parts.direction.imag, np.stack([parts.unbalance, parts.drag, parts.averaged.inertia], 1)], axis=1
    )
    _, which = np.unique(rows, axis=0, return_inverse=True)
    return [np.flatnonzero(which.ravel() == g) for g in range(int(np.max(which)) + 1)]


def _same(first: np.ndarray, second: np.ndarray, groups: list[np.ndarray]) -> bool:
    """Whether two sets of phases differ by a common turn, and by an exchange of equal loads, only."""

    def points(phase: np.ndarray, group: np.ndarray) -> np.ndarray:
        return np.exp(1j * phase[group])

    lead = points(first, groups[0])[0]
    for start in points(second, groups[0]):
        turned = [points(second, g) * lead / start for g in groups]
        if all(_match(points(first, g), other) for g, other in zip(groups, turned, strict=True)):
            return True
    return False


def _match(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two sets of points are the same in some order."""
    left = list(second)
    for point in first:
        near = int(np.argmin([abs(point - other) for other in left]))
        if abs(point - left.pop(near)) > 1e-5:
            return False
    return True
