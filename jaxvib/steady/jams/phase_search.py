"""Search for all jams of a scene with any phases, and phase patterns followed over the load speed."""

from __future__ import annotations

from typing import overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, SpeedUnit, speed_text
from jaxvib.equations.averaged import averaged_growth, decays
from jaxvib.equations.torque_balance import (
    TorqueBalance,
    assemble_for_search,
    assemble_torque_balance,
    influence_of,
    response_of,
)
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.validation import validate_scene
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import sentence, status_names
from jaxvib.runtime.devices import on_device
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.patterns import SAME_PHASE_DIFFERENCE, images_text, is_same_pattern
from jaxvib.steady.jams.phase_starts import (
    LOAD_SPEEDS,
    distinct_rows,
    equal_loads,
    load_speeds,
    phases_near,
    search_clusters,
    search_data,
)
from jaxvib.steady.jams.phases import AbstractPhaseJam, PhaseJam, PhaseStatus, jam_from, loads_with_drag, phase_jam
from jaxvib.steady.outcome import entry, require_index
from jaxvib.steady.regimes.symmetry import Exchange, exchanges_of
from jaxvib.units import count, random_numbers

_SHOWN_DRAG_FACTOR = 30.0
"""Factor of the drag range in a figure of all jams: the range begins at the drag of the scene divided by this factor, and ends
at this drag multiplied by it, or farther if a jam ends at a resonance outside of this range."""

_SHOWN_BEYOND_A_FOLD = 2.0
"""Ratio of the end of the drag axis and the drag of the last fold."""

_MAX_SHOWN_DRAG_FACTOR = 1e4
"""Largest ratio of an end of the drag axis and the drag of the scene."""

_SAME_LINE_DIFFERENCE = 5e-3
"""Relative difference of drags below which the lines of two unstable patterns are drawn as one line."""

_JAMS_PER_PROGRAM = 64
"""Number of jams in one program; typical scenes have some tens."""

_SAME_SPEED_DIFFERENCE = 1e-6
"""Relative difference of speed below which two jams count as one if their phases are the same, too."""


class PhaseJams(AbstractPhaseJam):
    """All jams of a search: the arrays of `AbstractPhaseJam` with a leading axis over the n jams.

    Returned by `phase_jams`.

    The jams are in the order of decreasing load speed; stable ones come first if speeds are equal.

    **Additional attributes**: `starts` (n,): the number of starts that led to each jam; `scene`.
    """

    outer_axes = ("jam",)

    starts: Array = eqx.field(metadata=in_unit("", "jam"))
    scene: Scene = eqx.field(metadata=SCENE)

    @validated
    def select(self, index: int) -> PhaseJam:
        """Return the jam with an `index`, counted from 0. **Raises** `InputError` if there are fewer jams."""
        require_index(index, self.omega.shape[0], "jams")
        return entry(self, PhaseJam, index)

    @validated
    def follow(self, index: int, omega: Array) -> PhaseBranch:
        """Return the phase pattern of the jam with an `index`, counted from 0, at load speeds `omega` (n,), rad/s.

        The speeds ascend and are below the rotor speed. The result states the drag at which the loads jam at each speed.
        """
        return phase_branch(self.scene, self.select(index), omega)

    @property
    def distinct(self) -> list[np.ndarray]:
        """Indices of jams that differ only by a mirror image or another exchange of loads that leaves the machine unchanged, in
        one array for each distinct jam. Example: exchange of the loads of two planes of a rotor whose ends are equal."""
        omega, phase = np.asarray(self.omega), np.asarray(self.phase)
        if not omega.size:
            return []
        balance = assemble_torque_balance(self.scene)
        groups = equal_loads(balance)  # one load stands for all equal loads of a station
        one, sizes = np.array([group[0] for group in groups]), [len(group) for group in groups]
        influence = np.asarray(_influences(balance, self.omega))[:, one[:, None], one]
        parameters = np.stack([balance.unbalance, balance.drag, balance.averaged.inertia], axis=1)[one]
        exchanges = exchanges_of(influence, np.column_stack([parameters, sizes]))
        found: list[list[int]] = []
        for k, each in enumerate(phase):
            images = [_exchanged(each, groups, exchange) for exchange in exchanges]
            for indices in found:
                first = indices[0]
                near = abs(omega[k] - omega[first]) < _SAME_SPEED_DIFFERENCE * omega[k]
                if near and any(is_same_pattern(phase[first], image, groups) for image in images):
                    indices.append(k)
                    break
            else:
                found.append([k])
        return [np.array(indices) for indices in found]

    def summary(self) -> str:
        """Return a line for each jam, see `distinct`; phases in degrees."""
        jams = [self.select(each[0]).summary() + images_text(each) for each in self.distinct] or ["no jam"]
        as_points = (
            "loads count as points: jams at free phases do not include their ball_radius\n"
            "(jam_modes places equal loads side by side)"
        )
        return "\n".join([*jams, *([] if getattr(self.scene.loads, "ball_radius", None) is None else [as_points])])

    @validated
    def plot(self, *, unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot the load speeds over the drag, from 1/30 to 30 times the drag of the scene, for each pattern of these jams.

        The drag axis is longer if the jams at a resonance end outside of this range. Colours show the arrangement of the loads.
        Stable parts are solid lines, unstable parts dashed lines, and the jams of the scene are points.
        """
        from jaxvib.draw.results import drag_diagram  # slow import

        omega = np.asarray(self.omega)
        speeds = np.unique(np.concatenate([load_speeds(assemble_torque_balance(self.scene)), omega]))
        branches: list[PhaseBranch] = []
        curves = []
        for k, place in enumerate(np.searchsorted(speeds, omega)):
            jam = self.select(k)
            if not any(_contains_jam(branch, place, jam.growth) for branch in branches):
                branches.append(phase_branch(self.scene, jam, jnp.asarray(speeds)))
                factor, at, stable = drag_curve(branches[-1])
                for _, other, _, _ in curves:
                    # Dashed lines on top of each other would look like a solid line.
                    factor = np.where(~stable & (np.abs(factor - other) < _SAME_LINE_DIFFERENCE * factor), np.nan, factor)
                curves.append((sentence(jam.pattern), factor, at, stable))
        top, jams = float(self.scene.drive.speed), (omega, np.asarray(self.stable))
        times, label = _drag_axis(loads_with_drag(self.scene).drag)
        within = _shown_drags(curves)
        curves = [(name, times * factor, at, stable) for name, factor, at, stable in curves]
        return drag_diagram(curves, top, label=label, at=times, jams=jams, within=within, unit=unit, ax=ax)


def _drag_axis(drag: Array) -> tuple[float, str]:
    """Return the factor and the label of a drag axis: N s/m, or multiples of the drag of the scene if the loads differ."""
    each = np.ravel(drag)
    return (float(each[0]), "drag, N s/m") if np.all(each == each[0]) else (1.0, "drag / drag of the scene")


def _shown_drags(curves: list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """Return the ends of the drag axis, relative to the drag of the scene, between which the folds of the `curves` lie."""
    folds = [1.0]
    for _, factor, _, _ in curves:
        is_peak = (factor[1:-1] > factor[:-2]) & (factor[1:-1] > factor[2:])
        folds.extend(factor[1:-1][is_peak])
    low, high = min(folds) / _SHOWN_BEYOND_A_FOLD, max(folds) * _SHOWN_BEYOND_A_FOLD
    return (
        max(min(low, 1.0 / _SHOWN_DRAG_FACTOR), 1.0 / _MAX_SHOWN_DRAG_FACTOR),
        min(max(high, _SHOWN_DRAG_FACTOR), _MAX_SHOWN_DRAG_FACTOR),
    )


@overload
def phase_jams(scene: Scene, *, starts: int = 128, seed: int = 0) -> PhaseJams: ...


@overload
def phase_jams(scene: Scene, *, near: tuple[Array, Array]) -> PhaseJam: ...


@validated
def phase_jams(
    scene: Scene, *, starts: int = 128, seed: int = 0, near: tuple[Array, Array] | None = None
) -> PhaseJams | PhaseJam:
    """Return all jams of the scene's light loads at its rotor speed, with any phases.

        b_W R^2 (n - Omega) = mean braking torque of the vibration on load j,  for every load j, solved for Omega and the phases

    b_W and R are the drag and the radius of the load, n is the rotor speed and Omega the load speed.

    - The search computes, at each of many load speeds, the phases at which all loads need the same multiple of their drag. It
      starts from `starts` random sets of phases and some regular ones. If this multiple passes 1 between two load speeds, a jam
      lies between them, and Newton's method solves for its speed and phases. The load speeds are closer together near
      resonances
    - Jams that differ by a common rotation of all loads, or by an exchange of equal loads, count as one
    - Loads that turn with the rotor and balance it are left out. Two equal loads of one station also have a jam at the load
      speed at which the vibration of the machine lags behind the force of the loads by 90 degrees. It is left out too;
      `synchronous_regimes` lists it
    - Loads count as points: their `ball_radius` is not used, so that loads at one angle have the unbalance N m R. `jam_modes`
      places them side by side
    - An imbalance of the rotor (`StaticImbalance`, `MomentImbalance`) does not change a jam: its force rotates at the rotor
      speed, that of the loads at the load speed. At this order the imbalance therefore exerts no mean torque on the loads.
      The amplitudes and the foundation force are those caused by the loads only. If the contribution of the imbalance matters,
      use `simulate`

    **Arguments**

    - `scene` with a drive of prescribed speed and loads with drag; typical: 2 to 4 loads
    - `starts`: number of random sets of phases at each load speed; typical: 16 to 1024 (default 128). A few are enough for
      stable jams. Many are necessary for unstable jams near a load speed at which one pattern branches off from another. The
      time is proportional to this number
    - `seed` of these random phases
    - `near`: (omega, phase), a speed rad/s and the phases (count,) rad of the loads, from which Newton's method finds one jam.
      The function can then be used under `jit`, `vmap` and `grad`. Derivatives follow from the implicit function theorem;
      `growth` and `stable` have none

    **Returns** `PhaseJams`, or `PhaseJam` with `near`.

    **Raises** `InputError` for loads without drag, drives without a prescribed speed, and effects that this function does not
    include.

    >>> import jaxvib as jv
    >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
    >>> jams = jv.phase_jams(scene)
    >>> [round(float(w), 1) for w in jams.omega], [bool(s) for s in jams.stable]
    ([412.8, 199.4, 164.6], [False, False, True])

    Source: Artyunin 2013, section V; leading order of the loads' mass, see `jam_modes` for loads at one angle.
    """
    scene = validate_scene(scene)
    if near is not None:
        return phase_jam(scene, *near)
    loads = loads_with_drag(scene)
    number = count(starts, "starts", each=64.0 * loads.count * LOAD_SPEEDS)
    balance = assemble_for_search(scene)
    return _jams_from_starts(scene, balance, *search_clusters(balance, number, random_numbers(seed)))


def _jams_from_starts(scene: Scene, balance: TorqueBalance, omega: np.ndarray, phase: np.ndarray) -> PhaseJams:
    """Return the distinct jams to which Newton's method leads from the load speeds `omega` (n,) and phases (n, count) that the
    search found."""
    groups = equal_loads(balance)
    starts_at = np.flatnonzero(np.isfinite(omega) & (omega > 0.0) & (omega < float(balance.speed)))
    places, reached = _distinct_jams(omega[starts_at], phase[starts_at], np.ones(starts_at.size, dtype=int), groups)
    # Several starts can lead to the same jam; at the low accuracy of the search their results may still differ.
    first = starts_at[np.asarray(places, dtype=int)]
    jams = in_chunks(_JAMS_PER_PROGRAM, lambda w, a: _jams_from(scene, w, a), omega[first], phase[first])
    found = np.flatnonzero(status_names(jams.status) == "found")
    places, reached = _distinct_jams(jams.omega[found], jams.phase[found], reached[found], groups)
    keep = found[np.asarray(places, dtype=int)]
    order = sorted(range(keep.size), key=lambda i: (-round(float(jams.omega[keep[i]]), 6), not jams.stable[keep[i]]))
    fields = {name: getattr(jams, name) for name in PhaseJam.__dataclass_fields__}
    sorted_fields = on_device(jax.tree.map(lambda leaf: leaf[keep[order]], fields))
    return PhaseJams(**sorted_fields, starts=on_device(reached[order]), scene=scene)


def _distinct_jams(
    omega: np.ndarray, phase: np.ndarray, starts: np.ndarray, groups: list[np.ndarray]
) -> tuple[list[int], np.ndarray]:
    """Return indices of distinct jams among n, by falling speed, and the sum of the `starts` (n,) that led to each."""
    # Most jams occur many times: those in one cell of half the allowed difference are merged first.
    cells = np.concatenate(
        [
            np.log(omega)[:, None] / _SAME_SPEED_DIFFERENCE,
            np.cos(phase) / SAME_PHASE_DIFFERENCE,
            np.sin(phase) / SAME_PHASE_DIFFERENCE,
        ],
        axis=1,
    )
    once, which = distinct_rows(np.floor(2.0 * cells))
    starts = np.bincount(which, starts, once.size).astype(int)
    places: list[int] = []
    reached: list[int] = []
    near = 0  # first of `places` whose speed is close enough to be the same jam
    for m in np.argsort(-omega[once], kind="stable"):
        k = once[m]
        while near < len(places) and not abs(omega[places[near]] - omega[k]) < _SAME_SPEED_DIFFERENCE * omega[places[near]]:
            near += 1
        place = next((i for i in range(near, len(places)) if is_same_pattern(phase[places[i]], phase[k], groups)), None)
        if place is None:
            places.append(int(k))
            reached.append(int(starts[m]))
        else:
            reached[place] += int(starts[m])
    return places, np.asarray(reached, dtype=int)


def _exchanged(phase: np.ndarray, groups: list[np.ndarray], exchange: Exchange) -> np.ndarray:
    """Return phases (count,) after an exchange of the `groups` of equal loads."""
    image = np.empty_like(phase)
    for group, place, shift in zip(groups, exchange.permutation, exchange.shift, strict=True):
        image[groups[place]] = phase[group] + shift
    return image


@cached
def _influences(balance: TorqueBalance, omega: Array) -> Array:
    return jax.vmap(lambda w: influence_of(balance, w))(omega)


@cached
def _jams_from(scene: Scene, omega: Array, phase: Array) -> PhaseJam:
    return eqx.filter_vmap(jam_from, in_axes=(None, 0, 0))(scene, omega, phase)


def _contains_jam(branch: PhaseBranch, place: int, growth: Array) -> bool:
    """Return True if point `place` of the branch is, at the scene's drag, a jam with this `growth` (or its mirror image)."""
    near = abs(float(branch.drag_factor[place]) - 1.0) < 1e-4
    return near and abs(float(branch.growth[place] - growth)) < 1e-3 * abs(float(growth))


def phase_branch(scene: Scene, jam: PhaseJam, omega: Array) -> PhaseBranch:
    """Follow the phase pattern of `jam` over load speeds `omega` (n,) rad/s, see `PhaseJams.follow`.

    The drag is computed directly from the load speed; therefore folds need no continuation. Two jams of the pattern merge at an
    extremum of the drag factor over `omega`. If a pattern ends, the next phases may belong to another pattern; the phases then
    jump.

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
    if speeds.ndim != 1 or speeds.size == 0 or not np.all((speeds > 0.0) & (speeds < top)) or not np.all(np.diff(speeds) > 0.0):
        raise InputError("omega", f"must be an ascending list of load speeds above 0 and below the rotor speed {top:g}")
    # From the jam upward, then from the jam downward.
    places, cut = np.arange(speeds.size), int(np.searchsorted(speeds, float(jam.omega)))
    order = np.concatenate([places[cut:], places[:cut][::-1]])
    followed = _follow_pattern(scene, jam.phase, jnp.asarray(speeds[order]), jnp.asarray(places == speeds.size - cut))
    values = (value[np.argsort(order)] for value in followed)
    drag = jnp.broadcast_to(loads.drag, (loads.count,))
    return PhaseBranch(jnp.asarray(speeds), *values, rotor_speed=scene.drive.speed, drag=drag)


@cached
def _follow_pattern(scene: Scene, phase: Array, omega: Array, restart: Array) -> tuple[Array, ...]:
    """Return phases at load speeds (n,), each computed from the previous ones, or from `phase` if `restart` (n,) is True."""
    balance = assemble_torque_balance(scene)

    def step(last: Array, at: tuple[Array, Array]) -> tuple[Array, tuple[Array, ...]]:
        w, begins = at
        start = jnp.where(begins, phase, last)
        factor, angles, residual = phases_near(balance, search_data(balance, w), start)
        good = (residual < jnp.sqrt(jnp.finfo(residual.dtype).eps)) & (factor > 0.0)
        braked = eqx.tree_at(lambda field: field.drag, balance.averaged, factor * balance.drag)
        growth = averaged_growth(braked, w, angles, w**2 * response_of(balance, w) @ (balance.unbalance * jnp.exp(1j * angles)))
        factor, growth = (jnp.where(good, value, jnp.nan) for value in (factor, growth))
        return jnp.where(good, angles, start), (factor, jnp.where(good, angles, jnp.nan), growth, good & decays(growth, w))

    return jax.lax.scan(step, phase, (omega, restart))[1]


_PHASE_JUMP = 0.3
"""Change of a phase between neighbouring load speeds, rad, above which a figure shows another pattern."""


class PhaseBranch(Result):
    """Phase pattern over the load speed, at a fixed rotor speed.

    **Attributes** (n speeds)

    - `omega` (n,), rad/s
    - `drag_factor` (n,): the loads jam at this speed if the drag of the scene is multiplied by this factor; NaN if the pattern
      has no jam
    - `phase` (n, count), rad
    - `growth` (n,), 1/s, and `stable` (n,), as in `PhaseJam`
    - `rotor_speed`, rad/s
    - `drag` (count,), N s/m: drag of the loads in the scene
    """

    omega: Array = eqx.field(metadata=in_unit("rad/s", "omega"))
    drag_factor: Array = eqx.field(metadata=in_unit("", "omega"))
    phase: Array = eqx.field(metadata=in_unit("rad", "omega", "load"))
    growth: Array = eqx.field(metadata=in_unit("1/s", "omega"))
    stable: Array = eqx.field(metadata=in_unit("", "omega"))
    rotor_speed: Array = eqx.field(metadata=in_unit("rad/s"))
    drag: Array = eqx.field(metadata=in_unit("N s/m", "load"))

    @property
    def status(self) -> PhaseStatus:
        """Outcome of the search for the pattern at each load speed, a `PhaseStatus`."""
        return jax.vmap(lambda f: PhaseStatus.where(jnp.isnan(f), PhaseStatus.not_converged, PhaseStatus.found))(
            self.drag_factor
        )

    def summary(self) -> str:
        """Return the ranges of load speed and drag as text."""
        factor, omega = np.asarray(self.drag_factor), np.asarray(self.omega)
        there = np.isfinite(factor)
        if not np.any(there):
            return f"no jam from {speed_text(omega[[0, -1]], 6, ' to ')}"
        return (
            f"{np.sum(there)} of {omega.size} load speeds have a jam, {np.sum(np.asarray(self.stable))} a stable one, from "
            f"{speed_text([np.min(omega[there]), np.max(omega[there])], 6, ' to ')}, at {np.min(factor[there]):.4g} to "
            f"{np.max(factor[there]):.4g} times the drag of the scene"
        )

    def plot(self, *, unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot the speeds of loads and rotor over the drag: stable parts as solid lines, unstable parts as dashed lines.

        The drag is in N s/m, or a multiple of the scene's drag if the loads have different drags.
        """
        from jaxvib.draw.results import drag_diagram  # slow import

        times, label = _drag_axis(self.drag)
        factor, omega, stable = drag_curve(self)
        curve = ("loads", times * factor, omega, stable)
        return drag_diagram([curve], float(self.rotor_speed), label=label, at=times, unit=unit, ax=ax)


def drag_curve(branch: PhaseBranch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return drag factor, load speed and stability for a figure; the factor is NaN if phases jump to another pattern."""
    turned = np.exp(1j * np.diff(np.asarray(branch.phase), axis=0))
    jump = np.append(False, np.max(np.abs(turned - 1.0), axis=1) > _PHASE_JUMP)
    return np.where(jump, np.nan, np.asarray(branch.drag_factor)), np.asarray(branch.omega), np.asarray(branch.stable)
