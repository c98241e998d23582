"""Balanced motion: arrangements in which loads cancel each other, and their exact stability."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, Onto, SpeedIntervals, speed_text
from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.linear import natural_frequencies, turning_loads
from jaxvib.errors import InputError, quoted
from jaxvib.machine.effects.base import has_term, terms_of
from jaxvib.machine.effects.terms import GravityField, LoadInteraction, RotorImbalance
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.structures.rotor import PlanarRotor, Rotor
from jaxvib.machine.validation import validate_scene
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import failure
from jaxvib.runtime.devices import float_dtype
from jaxvib.runtime.programs import cached
from jaxvib.steady.balance.arrangements import arrangements, distinct_arrangements
from jaxvib.steady.balance.monodromy import (
    BATCH,
    at_constant_speed,
    balanced_motion,
    fine_and_coarse,
    monodromies,
    validate_steps,
)
from jaxvib.steady.jams.patterns import images_text
from jaxvib.steady.jams.phases import degrees
from jaxvib.units import Number, Numbers, count, number, numbers


class BalanceStatus(eqx.Enumeration):
    """Outcomes of the balance of loads. The value of each member is the message shown to the user."""

    unique = "the loads of each plane cancel in one arrangement and its mirror image"
    family = "the loads cancel in a family of arrangements: angles that change along the neutral directions keep the balance"
    alone = "a single load has no other load to cancel it"
    outweighed = (
        "one load's m R, or the rotor's imbalance in the plane of the loads, is larger than all others together and cannot be "
        "cancelled"
    )
    no_room = (
        "the loads overlap in every arrangement in which they would cancel the rotor's imbalance: more, heavier or smaller "
        "loads are needed"
    )


class BalancedStates(Result):
    """Arrangements in which a set of loads cancels the rotor's imbalance, in the frame of the rotor.

    Returned by `balanced_states`.

    **Attributes** (N loads)

    - `status`: a `BalanceStatus`
    - `angles` (k, N), rad: one arrangement in each row, with load 1 at angle 0 unless the rotor has an imbalance; no rows if
      the loads cannot cancel
    - `dimension` of the set of arrangements, including the common rotation: N - 2, but 0 for a single load, and 1 for two
      loads on a rotor without imbalance; for loads in two planes the sum for both planes
    - `neutral` (k, N, d): orthonormal changes of the angles that keep each arrangement balanced to first order
    - `names` (d,) of these changes: "turn of all loads" first (not if the rotor has an imbalance), then "shape 1", ...; for
      loads in two planes "turn in plane 1", "shape 1 in plane 1", ...
    - `scene`

    If all loads of a plane are on one line, the plane has one neutral direction more than `dimension` counts. Exception: two
    loads on a rotor without imbalance.
    """

    status: BalanceStatus
    angles: np.ndarray = eqx.field(metadata=in_unit("rad", "arrangement", "load"))
    dimension: int = eqx.field(metadata=in_unit(""))
    neutral: list[np.ndarray] = eqx.field(metadata=in_unit("", "arrangement", "load", "neutral_direction"))
    names: tuple[str, ...] = eqx.field(metadata=in_unit("", "neutral_direction", name="neutral_direction"))
    scene: Scene = eqx.field(metadata=SCENE)

    @validated
    def stability(self, arrangement: int = 0, *, steps: int | None = None) -> BalancedStability:
        """Return the exact stability of an arrangement at the scene's rotor speed.

        The full equations are linearized about the balanced motion and integrated over one turn of the rotor.

        **Arguments**: `arrangement`: its number, counted from 0; `steps` of Radau's method over one turn (default: as many as
        the natural frequencies need); the time is proportional to this number.
        """
        return balanced_stability(self.scene, self._angles_of(arrangement), steps=steps)

    @validated
    def growth(self, speeds: Numbers, arrangement: int = 0, *, steps: int | None = None) -> np.ndarray:
        """Return the growth rate of deviations from an arrangement at rotor speeds, 1/s, in an array of the shape of `speeds`.
        The balanced motion is stable if the rate is negative.

        **Arguments**: `speeds`, rad/s; `arrangement`: its number, counted from 0; `steps`: as for `stability`.
        """
        return balanced_growth(self.scene, speeds, self._angles_of(arrangement), steps=steps)

    @validated
    def intervals(
        self, low: Number, high: Number, arrangement: int = 0, *, points: int = 200, steps: int | None = None
    ) -> SpeedIntervals:
        """Return the intervals of rotor speed, rad/s, in which an arrangement is stable; their ends are accurate to 1e-7 of the
        speed.

        **Arguments**

        - `low` and `high`: the range, rad/s; strings may have a unit, "300 rpm"
        - `arrangement`: its number, counted from 0
        - `points`: number of speeds that are computed in the range; typical: 200 (the default). An interval narrower than
          their spacing can be missed; the time is proportional to this number
        - `steps`: as for `stability`
        """
        return balanced_intervals(self.scene, low, high, self._angles_of(arrangement), points=points, steps=steps)

    @property
    def planes(self) -> list[np.ndarray]:
        """Loads of each plane, counted from 0. Planes ascend along the axis."""
        return [plane.loads for plane in _planes(self.scene)]

    @property
    def share(self) -> np.ndarray:
        """Imbalance of the rotor in each plane of the loads, divided by the sum of m_j R_j there, (planes,): 0 for a balanced
        rotor. Loads cannot cancel a share above 1. `planes` lists the loads of each plane."""
        sides = _sides(turning_loads(self.scene))
        return np.array([abs(plane.imbalance) / np.sum(sides[plane.loads]) for plane in _planes(self.scene)])

    @property
    def capacity(self) -> np.ndarray:
        """Largest imbalance of the rotor that the loads in each plane can cancel, (planes,) kg m: the unbalance of all loads at
        one angle (balls and rollers with a `ball_radius`: side by side). If one load outweighs all others together, the loads
        cannot cancel small imbalances."""
        sides, touching = _sides(turning_loads(self.scene)), _touching_angle(self.scene)
        chains = [sides[plane.loads] * np.exp(1j * touching * np.arange(plane.loads.size)) for plane in _planes(self.scene)]
        return np.array([abs(np.sum(chain)) for chain in chains])

    def _angles_of(self, arrangement: int) -> np.ndarray:
        """Return the angles of an arrangement. **Raises** `ComputationError` if there is no arrangement."""
        if not len(self.angles):
            raise failure(self.status)
        if not 0 <= arrangement < len(self.angles):
            raise InputError("arrangement", f"is {quoted(arrangement)}; there are {len(self.angles)}, counted from 0")
        return self.angles[arrangement]

    @property
    def distinct(self) -> list[np.ndarray]:
        """Indices of arrangements that differ only by an exchange of equal loads or, for a rotor whose supports are equal in
        all directions, by a reflection, in one array for each distinct arrangement."""
        planes = _planes(self.scene)
        angles = {np.angle(plane.imbalance) % np.pi for plane in planes if plane.imbalance}
        axis = min(angles, default=0.0)
        one_axis = all(abs(np.sin(angle - axis)) < 1e-9 for angle in angles)
        is_symmetric = one_axis and _is_isotropic(self.scene)
        groups = _equal_loads(self.scene, [plane.loads for plane in planes])
        return distinct_arrangements(self.angles, groups, axis if is_symmetric else None, can_turn=not angles)

    def summary(self) -> str:
        """Return the arrangements, see `distinct`, and their neutral directions as text."""
        first = {each[0]: images_text(each) for each in self.distinct}
        rows = [f"  {', '.join(f'{degrees(a) % 360.0:.4g}' for a in self.angles[k])} deg{text}" for k, text in first.items()]
        if not rows:
            pairs = [(abs(plane.imbalance), most) for plane, most in zip(_planes(self.scene), self.capacity, strict=True)]
            amounts = [
                f"  imbalance {1e3 * imbalance:.4g} g m; the loads cancel at most {1e3 * most:.4g} g m"
                for imbalance, most in pairs
                if imbalance > 0.0
            ]
            return "\n".join([self.message, *amounts])
        directions = f"neutral directions: {', '.join(self.names) or 'none'}"
        return "\n".join([self.message, *rows, directions])

    @validated
    def plot(self, *, ax: Onto = None) -> Drawn:
        """Plot the `distinct` arrangements in the rotor's frame, each on a circle; for loads in two planes on a circle for each
        plane.

        Arrows show the unbalance of the loads and the imbalance of the rotor in the plane, relative to the unbalance of all
        loads there at one angle. **Arguments**: `ax`: one axes object for each circle, plane by plane.
        """
        from jaxvib.draw.results import draw_circle  # slow imports
        from jaxvib.draw.style import panels

        sides, planes, distinct = _sides(turning_loads(self.scene)), _planes(self.scene), self.distinct
        figure, axes = panels(len(planes), max(len(distinct), 1), size=(3.2, 3.2), ax=ax)
        for axis in axes:
            axis.set_axis_off()
        for axis, ((p, plane), images) in zip(axes, itertools.product(enumerate(planes), distinct), strict=False):
            k = images[0]
            own = sides[plane.loads]
            shown = {"weights": own / np.sum(own), "imbalance": plane.imbalance / np.sum(own), "numbers": plane.loads}
            title = f"arrangement {k + 1}{images_text(images)}" + (f", plane {p + 1}" if len(planes) > 1 else "")
            draw_circle(axis, title, self.angles[k, plane.loads], **shown)
        return figure if ax is None else ax


@validated
def balanced_states(scene: Scene) -> BalancedStates:
    """Return arrangements in which the scene's loads cancel each other and the rotor's imbalance.

        sum_j m_j R_j exp(i alpha_j) + U = 0,    sum_j m_j R_j s_j exp(i alpha_j) + W = 0

    U is the `StaticImbalance` and W the `MomentImbalance` of the rotor, s_j the distance of a load along the axis from the
    rotor's centre of mass. For loads in one plane the first equation is sufficient.

    Balls and rollers with a `ball_radius` must have room beside each other, even without the effect `LoadContact`.

    - Two loads cancel if they are equal and opposite each other
    - Three loads cancel in one triangle and its mirror image
    - Four or more loads cancel in a family of arrangements with N - 2 dimensions. In the returned arrangement and its mirror
      image, m_j R_j are the sides of a polygon inscribed in a circle. Equal loads are then as far from each other as the
      balance allows. `neutral` gives the directions of the family
    - An imbalance of the rotor is an additional side of the polygon; the loads then cannot rotate together
    - Loads in two planes at s_1 and s_2 cancel in each plane the part of the imbalance that acts there, (W - s_2 U)/(s_1 - s_2)
      and (W - s_1 U)/(s_2 - s_1). The arrangements of both planes are combined

    Each arrangement has `stability()`, `growth(speeds)` and stable `intervals(low, high)` of rotor speed.

    **Arguments**: `scene` with loads on a circle in one plane or in two planes; typical: 2 to 4 loads in each plane, an
    imbalance up to the sum of m_j R_j.

    **Returns** `BalancedStates`.

    **Raises** `InputError` for

    - loads that do not run on a circle, and loads in more than two planes
    - loads in one plane if the imbalance tilts the rotor, because they cannot cancel it: a moment imbalance, or a static
      imbalance if the loads are not in the plane of the rotor's centre of mass

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> loads = jv.balls(count=3, mass=[0.3, 0.4, 0.5], radius=0.1, drag=1.0)
    >>> states = jv.balanced_states(jv.Scene(machine, loads, jv.ConstantSpeed(100.0)))
    >>> print(states.summary())
    the loads of each plane cancel in one arrangement and its mirror image
      0, 90, 233.1 deg
      0, 270, 126.9 deg
    neutral directions: turn of all loads
    >>> loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
    >>> imbalance = jv.StaticImbalance("50 g m", angle="90 deg")    # as much as each of the balls
    >>> print(jv.balanced_states(jv.Scene(machine, loads, jv.ConstantSpeed(100.0), (imbalance,))).summary())
    the loads of each plane cancel in one arrangement and its mirror image
      210, 330 deg (2 mirror images)
    neutral directions: none

    Source: Filimonikhin et al. 2022, section 2 (families of three or more loads, including the common rotation); derived here.
    For two planes Rodrigues et al. 2008, Int. J. Non-Linear Mechanics 43.
    """
    scene = validate_scene(scene)
    sides, planes = _sides(turning_loads(scene)), _planes(scene)
    ordered = has_term(scene.all_effects, LoadInteraction)
    touching = _touching_angle(scene)
    found = [arrangements(sides[plane.loads], plane.imbalance, touching, ordered=ordered) for plane in planes]
    n, failed = sides.size, [each.status for each in found if not len(each.angles)]
    if failed:
        return BalancedStates(_status(failed), np.zeros((0, n)), 0, [], (), scene)
    angles, neutral = [], []
    for chosen in itertools.product(*(range(len(each.angles)) for each in found)):
        row, directions = np.zeros(n), []
        for plane, each, k in zip(planes, found, chosen, strict=True):
            row[plane.loads] = each.angles[k]
            within = np.zeros((n, each.neutral[k].shape[1]))
            within[plane.loads] = each.neutral[k]
            directions.append(within)
        angles.append(row)
        neutral.append(np.concatenate(directions, axis=1))
    names = [name if len(planes) == 1 else f"{name} in plane {k + 1}" for k, each in enumerate(found) for name in each.names]
    names = [name.replace("turn of all loads in", "turn in") for name in names]
    dimension = sum(each.dimension for each in found)
    return BalancedStates(_status([each.status for each in found]), np.array(angles), dimension, neutral, tuple(names), scene)


def _status(names: list[str]) -> BalanceStatus:
    """Return the status of loads in several planes: that of the plane whose status comes first in `order` below."""
    order = ("alone", "outweighed", "no_room", "family", "unique")
    return getattr(BalanceStatus, min(names, key=order.index))


def _touching_angle(scene: Scene) -> float:
    """Return the angle between two loads that touch each other, rad; 0 for loads without a size."""
    loads = turning_loads(scene)
    return 0.0 if loads.ball_radius is None else float(np.max(2.0 * np.arcsin(loads.ball_radius / loads.radius)))


def _sides(loads: CircularLoads) -> np.ndarray:
    """Return the unbalance m R of each load, (N,) kg m: the sides of the polygon of `arrangements`."""
    return np.broadcast_to(np.asarray(loads.mass) * np.asarray(loads.radius), (loads.count,))


class _Plane(NamedTuple):
    """Loads of one plane: their indices, and the imbalance of the rotor that they must cancel, kg m."""

    loads: np.ndarray
    imbalance: complex


def _imbalances(scene: Scene) -> tuple[complex, complex, np.ndarray]:
    """Return the static imbalance of the rotor, kg m, its moment about the centre of mass, kg m^2, and the distance of each
    load from the centre of mass, (N,) m."""
    imbalances = [term.at(jnp.zeros_like(scene.drive.speed)) for term in terms_of(scene.all_effects, RotorImbalance)]
    static = sum((complex(*map(float, each.static)) for each in imbalances), 0j)
    moment = sum((complex(*map(float, each.moment)) for each in imbalances), 0j)
    return static, moment, np.asarray(_distances(scene))


@cached
def _distances(scene: Scene) -> Array:
    return scene.mount().distances(scene.loads.count)


def _planes(scene: Scene) -> list[_Plane]:
    """Return the planes of the loads. **Raises** `InputError` for more than two, and if loads in one plane cannot cancel the
    imbalance."""
    static, moment, distances = _imbalances(scene)
    places = np.unique(distances)
    if places.size > 2:
        problem = f"are in {places.size} planes; this function needs loads in one plane or two; use simulate for others"
        raise InputError("machine.stations", problem)
    if places.size == 1:
        tilting = moment - places[0] * static
        if abs(tilting) > _rounding() * max(abs(moment), abs(places[0] * static)):
            problem = (
                "tilt the rotor: loads at one point cannot cancel a moment imbalance, or a static imbalance at another point "
                "(it acts at the centre of mass of the rotor); give loads at two stations, or leave the imbalance out"
            )
            raise InputError("effects", problem)
        return [_Plane(np.arange(distances.size), static)]
    planes = []
    for here, other in (places, places[::-1]):
        imbalance = (moment - other * static) / (here - other)
        is_zero = abs(imbalance) <= _rounding() * (abs(static) + abs(moment) / abs(here - other))
        planes.append(_Plane(np.flatnonzero(distances == here), 0j if is_zero else imbalance))
    return planes


def _equal_loads(scene: Scene, planes: list[np.ndarray]) -> list[np.ndarray]:
    """Return the indices of the loads of each group of equal loads in one plane."""
    loads = turning_loads(scene)
    columns = [np.broadcast_to(np.asarray(leaf), (loads.count,)) for leaf in jax.tree.leaves(loads)]
    _, which = np.unique(np.stack(columns), axis=1, return_inverse=True)
    groups = (plane[which.ravel()[plane] == k] for plane in planes for k in range(loads.count))
    return [group for group in groups if group.size]


def _is_isotropic(scene: Scene) -> bool:
    """Return True for a rotor on supports that are equal in all directions, without effects on the machine."""
    machine = scene.machine
    if scene.effects or not isinstance(machine, (Rotor, PlanarRotor)):
        return False
    pairs = ((machine.stiffness, machine.stiffness_up), (machine.damping, machine.damping_up))
    return all(up is None or np.array_equal(np.asarray(across), np.asarray(up)) for across, up in pairs)


def balanced_stability(scene: Scene, angles: ArrayLike | None = None, *, steps: int | None = None) -> BalancedStability:
    """Return the exact stability of the motion in which the loads turn with the rotor and cancel each other and its imbalance.

    No approximation is made for heavy loads or weak drag, unlike the criterion.

    **Arguments**: `angles` (N,), rad, in the rotor's frame, at which the loads cancel each other and the imbalances (default:
    the first of `balanced_states`); `steps` of Radau's method of order 11 over one turn, which is valid for any drag of the
    loads and any damping of the carrier (typical: 24 to 200; default: as many as the natural frequencies need).

    **Raises** `ComputationError` with the status of `balanced_states` if the loads cannot cancel, and `InputError` for angles
    at which they do not cancel, a machine that can drift, effects that disturb the balanced motion (gravity), a rotor that is
    too slow, see `validate_steps`, and the scenes that `balanced_states` does not accept.

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> loads = jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0)
    >>> [balanced_stability(jv.Scene(machine, loads, jv.ConstantSpeed(n))).stable for n in (20.0, 40.0)]
    [False, True]

    Source: Floquet's theorem; Radau's method of Hairer, Wanner, Solving Ordinary Differential Equations II, section IV.5.
    """
    angles, neutral = _validate_arrangement(scene, angles)
    matrices = fine_and_coarse(scene, angles, validate_steps(scene, scene.drive.speed, steps))
    fine, coarse = (np.linalg.eigvals(np.asarray(each)) for each in matrices)
    speed = float(scene.drive.speed)
    growth = float(_growth_rate(fine, speed, neutral))
    # Half as many steps have at least 64 times the error: the order is 11 if the steps resolve all motions, and 6 if the motion
    # of the loads decays within a step.
    error = float(np.max(np.min(np.abs(fine[:, None] - coarse[None, :]), axis=1))) / 63.0
    # Neutral multipliers are 1; their difference from 1 is rounding, which grows with the number of steps.
    rounding = float(np.max(np.sort(np.abs(fine - 1.0))[:neutral], initial=fine.size * np.finfo(fine.real.dtype).eps))
    is_decided = abs(growth) * 2.0 * np.pi / speed > error + 2.0 * rounding
    order = np.argsort(-np.abs(fine))
    return BalancedStability(is_decided and growth < 0.0, is_decided, growth, fine[order], neutral, error, speed)


def balanced_growth(scene: Scene, speeds: Numbers, angles: ArrayLike | None = None, *, steps: int | None = None) -> np.ndarray:
    """Return the growth rates, 1/s, of deviations from the balanced motion at rotor `speeds` of any shape, rad/s; the speed of
    the scene is not used. Other arguments and errors are those of `balanced_stability`.

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> scene = jv.Scene(machine, jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(40.0))
    >>> balanced_growth(scene, [20.0, 40.0]) < 0.0
    array([False,  True])
    """
    angles, neutral = _validate_arrangement(scene, angles)
    if isinstance(speeds, (np.ndarray, jax.Array)):
        if np.size(speeds) == 0:
            return np.zeros(np.shape(speeds))
        values = np.asarray(numbers(np.ravel(speeds), "rad/s", "speeds", None), dtype=float).reshape(np.shape(speeds))
    else:
        values = np.asarray(numbers(speeds, "rad/s", "speeds", None), dtype=float)
    flat = values.ravel()
    # Speeds are padded to whole batches, so that few shapes are compiled.
    padded = np.pad(flat, (0, -flat.size % BATCH), mode="edge")
    flows = monodromies(at_constant_speed(scene), angles, padded, validate_steps(scene, flat, steps))[: flat.size]
    return _growth_rate(np.linalg.eigvals(np.asarray(flows)), flat, neutral).reshape(values.shape)


_DECAY_ERROR = 5e-11
"""Smallest decay over a turn that counts: errors of the integration let an undamped vibration decay by up to 2e-11."""


def decays_over_turn(speeds: np.ndarray, growth: np.ndarray) -> np.ndarray:
    """Return True for growth rates, 1/s, at which deviations decay in a turn by more than the error of the computation."""
    return growth * 2.0 * np.pi / speeds < -max(_DECAY_ERROR, 32.0 * float(np.finfo(float_dtype()).eps))


def balanced_intervals(
    scene: Scene, low: Number, high: Number, angles: ArrayLike | None = None, *, points: int = 200, steps: int | None = None
) -> SpeedIntervals:
    """Return the intervals of `BalancedStates.intervals` for loads at `angles`. **Raises** the errors of `balanced_stability`,
    and `InputError` for an empty range.

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> scene = jv.Scene(machine, jv.balls(count=2, mass=0.01, radius=0.1, drag=5.0), jv.ConstantSpeed(40.0))
    >>> balanced_intervals(scene, 20.0, 60.0, points=40)
    270.041 .. 572.958 rpm
    """
    low, high = (float(number(value, "rad/s", name)) for name, value in (("low", low), ("high", high)))
    if not 0.0 < low < high:
        raise InputError("low", f"is {low:g} and high {high:g}; 0 < low < high is needed, both finite")
    grid = np.linspace(low, high, count(points, "points", low=2, each=1e4))
    stable = decays_over_turn(grid, balanced_growth(scene, grid, angles, steps=steps))
    changes = stability_changes(scene, grid, stable, angles, steps=steps).tolist()
    ends = [*([low] if stable[0] else []), *changes, *([high] if stable[-1] else [])]
    return SpeedIntervals([float(a), float(b)] for a, b in zip(ends[0::2], ends[1::2], strict=True))


def stability_changes(
    scene: Scene,
    speeds: np.ndarray,
    stable: np.ndarray,
    angles: ArrayLike | None = None,
    *,
    rtol: float = 1e-7,
    steps: int | None = None,
) -> np.ndarray:
    """Return the speeds at which the balanced motion changes its stability, ascending: changes between neighbouring entries of
    `stable` at `speeds`, refined by bisection to the relative accuracy `rtol`."""
    (change,) = np.nonzero(stable[1:] != stable[:-1])
    left, right = speeds[change], speeds[change + 1]
    while left.size and np.max((right - left) / right) > rtol:
        middle = (left + right) / 2.0
        same = decays_over_turn(middle, balanced_growth(scene, middle, angles, steps=steps)) == stable[change]
        left, right = np.where(same, middle, left), np.where(same, right, middle)
    return (left + right) / 2.0


def _rounding() -> float:
    """Return the largest relative value that counts as 0, because it can be caused by rounding."""
    return max(1e-9, 32.0 * float(np.finfo(float_dtype()).eps))


def _validate_arrangement(scene: Scene, angles: ArrayLike | None) -> tuple[np.ndarray, int]:
    """Return angles at which the loads cancel each other, validated, or the default; and the number of neutral directions."""
    sides = _sides(turning_loads(scene))
    if not np.min(np.asarray(natural_frequencies(scene))) > 0.0:
        problem = (
            "lets the machine drift; this neutral motion hides the growth or decay of deviations of the loads; add a support"
        )
        raise InputError("machine.stiffness", problem)
    if angles is None:
        states = balanced_states(scene)
        if not len(states.angles):
            raise failure(states.status)
        angles = states.angles[0]
    angles = np.broadcast_to(np.asarray(angles, dtype=float), sides.shape)
    static, moment, distances = _imbalances(scene)
    tilting, arms = moment - distances[0] * static, distances - distances[0]
    forces = sides * np.exp(1j * angles)
    is_unbalanced = abs(np.sum(forces) + static) > _rounding() * sides.sum()
    tilts = abs(np.sum(arms * forces) + tilting) > _rounding() * max(float(np.sum(np.abs(arms) * sides)), abs(moment))
    if is_unbalanced or tilts:
        raise InputError("angles", "leave an unbalance; use angles from balanced_states(scene).angles")
    _require_undisturbed(scene, angles)
    length = np.max(np.abs(arms))
    levers = [np.ones(sides.size)] + ([arms / length] if length > 0.0 else [])
    change = np.concatenate([lever * sides * np.stack([-np.sin(angles), np.cos(angles)]) for lever in levers]) / sides.max()
    rank = int(np.sum(np.linalg.svd(change, compute_uv=False) > 1e-6))
    return angles, sides.size - rank


def _growth_rate(multipliers: np.ndarray, speed: float | np.ndarray, neutral: int) -> np.ndarray:
    """Return the largest growth rate, 1/s, of multipliers (..., n) over a turn, without the `neutral` ones nearest to 1."""
    nearest = np.argsort(np.abs(multipliers - 1.0), axis=-1)
    others = np.take_along_axis(multipliers, nearest[..., neutral:], -1)
    return np.log(np.max(np.abs(others), axis=-1)) * np.asarray(speed) / (2.0 * np.pi)


def _require_undisturbed(scene: Scene, angles: np.ndarray) -> None:
    if float(_disturbance(scene, angles)) > _rounding() * float(scene.drive.speed) ** 2:
        reasons = {GravityField: "disturbs the balanced motion", LoadInteraction: "pushes loads out of this arrangement"}
        for kind, reason in reasons.items():
            for effect in scene.all_effects:
                if has_term([effect], kind):
                    raise InputError(f"effects.{effect.kind}", f"{reason}; leave it out, or simulate")
        raise InputError("effects", "disturb the balanced motion; leave them out, or simulate")


@cached
def _disturbance(scene: Scene, angles: Any) -> Array:
    """Return the largest acceleration of a load, rad/s^2, in the balanced motion, at three angles of the rotor."""
    field, speed = vector_field(at_constant_speed(scene)), scene.drive.speed

    def acceleration(turn: Array) -> Array:
        return jnp.max(jnp.abs(field(turn / speed, balanced_motion(scene, angles, turn)).azimuth_rate))

    return jnp.max(jax.vmap(acceleration)(jnp.arange(3.0)))


class StabilityStatus(eqx.Enumeration):
    """Stability of a balanced motion. The value of each member is the message shown to the user."""

    stable = "deviations from the balanced motion decay"
    unstable = "deviations from the balanced motion grow"
    undecided = "deviations from the balanced motion change during a turn by less than the error of the computation"


class BalancedStability(Result):
    """Stability of a balanced motion by the Floquet multipliers of the full equations over one turn of the rotor.

    **Attributes**

    - `stable`: True if deviations decay; `is_decided`: True if the growth over a turn exceeds the error of the computation
    - `growth`, 1/s: the largest growth rate of a deviation (if negative: the slowest decay), without neutral directions
    - `multipliers` (2 (nd + N),), complex, the largest first
    - `neutral`: the number of multipliers that are 1 because the arrangements form a family. Without an imbalance, the family
      contains at least the common rotation of all loads
    - `error` of the multipliers, estimated by a second computation with half as many steps
    - `rotor_speed`, rad/s, at which the stability was computed
    """

    stable: bool = eqx.field(metadata=in_unit(""))
    is_decided: bool = eqx.field(metadata=in_unit(""))
    growth: float = eqx.field(metadata=in_unit("1/s"))
    multipliers: np.ndarray = eqx.field(metadata=in_unit("", "floquet"))
    neutral: int = eqx.field(metadata=in_unit(""))
    error: float = eqx.field(metadata=in_unit(""))
    rotor_speed: float = eqx.field(metadata=in_unit("rad/s"))

    @property
    def status(self) -> StabilityStatus:
        """Outcome, a `StabilityStatus`."""
        if not self.is_decided:
            return StabilityStatus.undecided
        return StabilityStatus.stable if self.stable else StabilityStatus.unstable

    def summary(self) -> str:
        """Return the stability and the growth rate as text."""
        rate = f"at {abs(self.growth):.4g} 1/s" if self.is_decided else f"({self.growth:.4g} 1/s)"
        largest = ", ".join(f"{abs(m):.6g}" for m in self.multipliers[:3])
        return (
            f"at the rotor speed {speed_text(self.rotor_speed)}: {self.message} {rate}; "
            f"largest Floquet multipliers, in absolute value: {largest} "
            f"(neutral: {self.neutral}; estimated error {self.error:.1e})"
        )

    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the multipliers in the complex plane, and the unit circle."""
        from jaxvib.draw.results import multiplier_chart  # slow import

        return multiplier_chart(np.asarray(self.multipliers), ax=ax)
