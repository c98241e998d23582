"""Branch diagram of exact jams, with the points of stability changes."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto, SpeedUnit
from jaxvib.equations.jammed_bodies import jammed_bodies
from jaxvib.equations.linear import jammed_loads, jammed_model, require_drag
from jaxvib.errors import InputError
from jaxvib.machine.effects.base import has_half_turn_symmetry
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.numerics.roots import next_share
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.runtime.parallel import in_background, in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.branch_plot import branch_summary, plot_branch
from jaxvib.steady.jams.folds import grid_near_poles, light_rotor_speed
from jaxvib.steady.orbits.describe import OrbitStatus, orbits
from jaxvib.steady.orbits.jam_orbit import collocation_points
from jaxvib.steady.orbits.stability import Floquet, is_stiff, steps_for
from jaxvib.units import Number, count, number, validate_tolerance

_ORBITS_PER_BATCH = 32
"""Number of orbits in a batch: enough to fill vector registers, few enough for the CPU's cache memory."""

_COLLOCATION_POINTS = (16, 32, 64)
"""Collocation points on half a period, tried one after the other until the accuracy is reached."""

_STABILITY_CRITERION = "by the multipliers of the full equations"


class SpecialPoint(NamedTuple):
    """Point at which the stability of exact jams changes.

    **Attributes**

    - `kind`: "fold" (dn/dOmega = 0), "torus" (Neimark-Sacker), "period_doubling" or "symmetry" (a symmetry of the motion is
      lost at a multiplier +1)
    - `omega` and `rotor_speed`, rad/s
    """

    kind: str
    omega: float
    rotor_speed: float


class ExactBranches(Result):
    """Branch n(Omega) of exact jams, ascending in Omega, with a leading axis over its P points.

    Returned by `branches(scene, exact=True)`.

    **Attributes**

    - `omega` and `rotor_speed` (P,), rad/s; `slope`: dn/dOmega
    - `amplitude` (P, nd), m (rad for tilts), and `foundation_force` (P,), N, zero to peak, as in `Orbit`
    - `power` (P,), W
    - `stable`, `multiplier` (P,) and `multipliers` (P, ...), as in `Orbit`
    - `residual` and `error` (P,), and `status`: an `OrbitStatus` for each point
    - `special`: the special points, ascending in Omega
    - `scene`
    """

    outer_axes = ("point",)

    status: OrbitStatus
    omega: Array = eqx.field(metadata=in_unit("rad/s", "point"))
    rotor_speed: Array = eqx.field(metadata=in_unit("rad/s", "point"))
    slope: Array = eqx.field(metadata=in_unit("", "point"))
    amplitude: Array = eqx.field(metadata=in_unit("m or rad", "point", "coordinate"))
    foundation_force: Array = eqx.field(metadata=in_unit("N", "point"))
    power: Array = eqx.field(metadata=in_unit("W", "point"))
    stable: Array = eqx.field(metadata=in_unit("", "point"))
    multiplier: Array = eqx.field(metadata=in_unit("", "point"))
    multipliers: Array = eqx.field(metadata=in_unit("", "point", "floquet"))
    residual: Array = eqx.field(metadata=in_unit("", "point"))
    error: Array = eqx.field(metadata=in_unit("", "point"))
    scene: Scene = eqx.field(metadata=SCENE)
    special: tuple[SpecialPoint, ...] = eqx.field(static=True, metadata=in_unit("", "special_point"))

    def summary(self) -> str:
        """Return the ranges of the branch, its resonances and its special points as text."""
        return f"{branch_summary(self, list(self.special), _STABILITY_CRITERION)}\n{self.message}"

    @validated
    def plot(
        self,
        *,
        unit: SpeedUnit | None = None,
        most: float | None = None,
        show: Sequence[str] = ("speed", "amplitude", "force"),
        linear: bool = False,
        ax: Onto = None,
    ) -> Drawn:
        """Plot the diagram: stable parts as solid lines, unstable parts as dashed lines, special points by their kind.

        **Arguments**: `unit`, `most`, `show`, `linear`, `ax` as for `Branches.plot`.
        """
        return plot_branch(self, list(self.special), unit, most, _STABILITY_CRITERION, show, linear, ax)


def exact_branches(
    scene: Scene,
    *,
    points: int = 2000,
    least: Number | None = None,
    most: Number | None = None,
    accuracy: float | None = None,
) -> ExactBranches:
    """Compute the branch n(Omega) of exact jams with its stability and the points of stability changes.

    Each point is solved separately at its own load speed; therefore folds need no continuation. Special points are bracketed by
    the points of the diagram and then computed as roots of functions of the growth factors s_i of disturbances. The s_i are the
    Floquet multipliers of a period. If the motion has the half-turn symmetry, they are instead the eigenvalues of the map from
    a disturbance to the disturbance half a period later, rotated by half a turn. Coincident loads have two sets of s_i: those
    of disturbances that keep the loads coincident, and those of disturbances that separate them. The special points are the
    roots

    - of dn/dOmega: fold
    - of prod (1 - s_i s_j) over pairs of the first set: torus
    - of prod (1 + s_i), of either set: loss of symmetry if the motion has the half-turn symmetry, otherwise period doubling
    - of prod (1 - s_i) of the second set: loss of symmetry

    The arguments are those of `branches`. At a load speed without a solution the values are NaN, and the
    status states the reason.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=0.05, beta=1.0, speed=1.5)
    >>> diagram = jv.branches(form.scene(), exact=True, points=200, least=0.3)
    >>> [(p.kind, round(p.omega, 4)) for p in diagram.special]
    [('fold', 0.3342), ('fold', 0.3811), ('torus', 0.3953), ('fold', 1.0023), ('fold', 1.217)]
    """
    require_drag(jammed_loads(scene), each=True)
    count(points, "points", low=2, each=1e4)
    dtype = scene.drive.speed.dtype
    if accuracy is None:
        accuracy = 1e-8 if dtype.itemsize >= 8 else 1e-3
    accuracy = validate_tolerance(accuracy, "accuracy", dtype, 1e3)
    speed = scene.drive.speed
    top = speed * 4.0 / 3.0 if most is None else number(most, "rad/s", "most", low=0.0, open_low=True)
    if not _search_grid.is_ready(scene, top):
        load_speeds = np.ones(_ORBITS_PER_BATCH, dtype)
        fewest = collocation_points(scene, _COLLOCATION_POINTS[0])
        in_background(functools.partial(_values.prepare, scene, load_speeds, fewest, accuracy, False))
    grid, resonances = map(np.asarray, _search_grid(scene, top))
    lowest = np.min(resonances[resonances > 0.0], initial=float(speed))
    low = float(0.2 * lowest if least is None else number(least, "rad/s", "least", low=0.0, open_low=True))
    high = float(top)
    if not high > low:
        raise InputError("most", f"is {high:.6g} rad/s; it must be above the lowest load speed (least), {low:.6g} rad/s")
    grid = np.concatenate([[low], grid[(grid > low) & (grid < high)], [high]])
    omega = np.interp(np.linspace(0.0, 1.0, points), np.linspace(0.0, 1.0, grid.size), grid)
    solve = _Solver(scene, accuracy, low)
    values = solve(omega)
    return ExactBranches(**{name: values[name] for name in _FIELDS}, scene=scene, special=_special_points(solve, values))


_FIELDS = tuple(name for name in ExactBranches.__dataclass_fields__ if name not in ("special", "scene"))
_Values: TypeAlias = dict[str, Any]
"""The `_FIELDS` of exact jams, with a leading axis, and the `tests` (P, 4) of `_tests`, which change sign where the stability
changes."""


class _Solver:
    """Solver for exact jams at given load speeds, in batches, with as many harmonics as each jam needs."""

    def __init__(self, scene: Scene, accuracy: float, slowest: float):
        self.scene, self.accuracy = scene, accuracy
        # Multipliers of all points are integrated by the same method (explicit or implicit), so that no test function changes
        # sign only because the method changes. The lowest load speed selects the method, because the decay of loads and
        # carrier is fastest there in comparison with the load speed.
        self.implicit = bool(_is_stiff(scene, jnp.asarray(slowest, scene.drive.speed.dtype)))

    def __call__(self, omega: np.ndarray) -> _Values:
        """Solve for the jams at load speeds; a batch takes as many integration steps as its slowest loads need."""
        first, *more = (collocation_points(self.scene, points) for points in _COLLOCATION_POINTS)
        found = self._batches(omega, first)
        for point_count in more:
            todo = np.flatnonzero(~(found["error"] <= self.accuracy))
            if todo.size == 0:
                break
            found = jax.tree.map(functools.partial(_replace_rows, todo), found, self._batches(omega[todo], point_count))
        return found

    def _batches(self, omega: np.ndarray, points: int) -> _Values:
        return in_chunks(_ORBITS_PER_BATCH, lambda w: _values(self.scene, w, points, self.accuracy, self.implicit), omega)


def _replace_rows(where: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    old = old.copy()
    old[where] = new
    return old


@cached
def _search_grid(scene: Scene, highest: Array) -> tuple[Array, Array]:
    """Return the grid of load speeds for the search for folds, up to at least the speed `highest`, and the resonances."""
    return grid_near_poles(jammed_model(scene), 64, highest)


@cached
def _is_stiff(scene: Scene, omega: Array) -> Array:
    model = jammed_bodies(jammed_model(scene))
    return is_stiff(model, omega, light_rotor_speed(model.linear, omega))


@cached
def _values(scene: Scene, omega: Array | np.ndarray, points: int, accuracy: float, implicit: bool) -> _Values:
    model, omega = jammed_bodies(jammed_model(scene)), jnp.asarray(omega)
    start = jax.vmap(lambda w: light_rotor_speed(model.linear, w))(omega)
    steps = jnp.max(steps_for(model, omega, start, implicit=implicit))
    orbit, growth = orbits(model, omega, start, "omega", points, steps, accuracy, implicit=implicit)
    return {name: getattr(orbit, name) for name in _FIELDS} | {"tests": _tests(growth)}


_KINDS_OF_TESTS = ("torus", "half_turn", "half_turn", "symmetry")
"""Kind of the bifurcation at a sign change of each test; without the half-turn symmetry, s = -1 is a period doubling."""


def _tests(growth: Floquet) -> Array:
    """Return four test functions (P, 4) of the growth factors s.

    - Two for disturbances that keep the loads coincident, s = `roots` of `Floquet`: prod (1 - s_i s_j) over pairs, and
      prod (1 + s_i)
    - Two for disturbances that separate the loads, s = `inner` of `Floquet`: prod (1 + s_i), and prod (1 - s_i)
    """
    s = growth.roots
    first, second = np.triu_indices(s.shape[0], 1)
    tests = [jnp.prod(1.0 - s[first] * s[second], axis=0), jnp.prod(1.0 + s, axis=0)]
    inner = jnp.zeros((1, s.shape[1])) if growth.inner is None else growth.inner
    tests += [jnp.prod(1.0 + inner, axis=0), jnp.prod(1.0 - inner, axis=0)]
    return jnp.stack([test.real for test in tests], axis=-1)


def _special_points(solve: _Solver, grid: _Values) -> tuple[SpecialPoint, ...]:
    """Return the roots of the test functions, from all sign changes between neighbouring points."""
    kinds = ["fold", *("symmetry" if kind == "half_turn" else kind for kind in _KINDS_OF_TESTS)]
    if not has_half_turn_symmetry(solve.scene.all_effects):
        kinds = ["fold", *("period_doubling" if kind == "half_turn" else kind for kind in _KINDS_OF_TESTS)]

    def read(values: _Values) -> np.ndarray:
        return np.concatenate([values["slope"][:, None], values["tests"]], axis=1)

    tests = read(grid)
    row, which = np.nonzero(tests[:-1] * tests[1:] < 0.0)
    if row.size == 0:
        return ()
    pick = np.arange(row.size)
    a, b = grid["omega"][row], grid["omega"][row + 1]
    fa, fb = tests[row, which], tests[row + 1, which]
    beyond = np.maximum(row - 1, 0)
    with np.errstate(all="ignore"):
        share = next_share(np, (a, fa), (b, fb), (grid["omega"][beyond], tests[beyond, which]), 1e-12)
    values, done = grid, np.zeros(row.size, bool)
    while not np.all(done):
        # A converged root stays unchanged until all have converged.
        x = np.where(done, a, a + share * (b - a))
        values = solve(x)
        f = read(values)[pick, which]
        done |= (np.abs(x - a) <= 1e-8 * a) | ~np.isfinite(f)
        same = (f > 0.0) == (fa > 0.0)
        before = np.where(same, a, b), np.where(same, fa, fb)
        other = np.where(same, b, a), np.where(same, fb, fa)
        with np.errstate(all="ignore"):
            share = next_share(np, (x, f), other, before, 1e-12)
        (a, fa), (b, fb) = (x, f), other
    points = []
    for k in range(row.size):
        s = values["multipliers"][k]
        # Two real multipliers with product 1 are a root of the torus test, but not a bifurcation: such a point is left out.
        is_real_pair = which[k] == 1 and not np.any((np.abs(np.abs(s) - 1.0) < 1e-4) & (np.abs(s.imag) > 1e-6))
        if np.isfinite(values["rotor_speed"][k]) and not is_real_pair:
            points.append(SpecialPoint(kinds[which[k]], float(a[k]), float(values["rotor_speed"][k])))
    return tuple(sorted(points, key=lambda point: point.omega))
