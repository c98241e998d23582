"""Numerical form of a search: values and derivatives of many designs at once.

Jams are followed from one design to the next: each search for a jam starts near its load speed in the last design.

The designs are computed in batches of at most 64, which run in parallel on all cores. The main compiled programs are the
derivatives of a batch (`evaluate`) and a number of steps of the descent (`descent`).

Sizes of arrays: s designs, d free parameters, me held quantities (equalities), mi demands (inequalities), p pieces of the
objective, q quantities. In a design z in [0, 1]^d, each free parameter is scaled to its bounds.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.machine.scene import Scene
from jaxvib.runtime.compat import ClosedJaxpr
from jaxvib.runtime.devices import on_device
from jaxvib.runtime.operations import program_digest
from jaxvib.runtime.parallel import in_chunks
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.jam import JamModes, jam_modes
from optimize.quantities.evaluation import Evaluation, Key, TargetRecorder, mapped, speed_of_target
from optimize.quantities.quantity import BuiltinQuantity, Demand, Quantity, walk
from optimize.space import DesignSpace, HeldQuantity

_MAX_BATCH_SIZE = 64
"""Largest number of designs in a batch; each core computes one batch at a time."""

_ROUNDING_SHARE = 1e-9
"""Value of a quantity, relative to its values for other designs, below which it counts as 0 with a rounding error."""

Speeds = tuple[Any, ...]
"""Load speeds, rad/s, near which jams and folds are searched for: for each jam or fold (`Key`) an array with a leading axis
over the designs."""


class Problem(eqx.Module):
    """Design space with an objective and demands.

    **Attributes**

    - `space`; `objective`
    - `demands`: each without its limit if the limit is a number, so that demands that differ only in this number share compiled
      programs (`Demand.form`); `constants` (mi,): these numbers, 0 for a limit that is a quantity
    - `keys`: the jams and folds whose load speeds are followed, see `Key`
    - `scales` (mi,): positive numbers by which the excesses of the demands are divided
    - `batch_size`: the number of designs in a batch
    - `parts`: the number of smooth pieces whose maximum is the objective
    - `program`: digest of the program of the user's functions, see `find_targets`
    """

    space: DesignSpace
    objective: Quantity = eqx.field(static=True)
    demands: tuple[Demand, ...] = eqx.field(static=True)
    keys: tuple[Key, ...] = eqx.field(static=True)
    constants: Array | np.ndarray
    scales: Array | np.ndarray
    batch_size: int = eqx.field(static=True, default=_MAX_BATCH_SIZE)
    parts: int = eqx.field(static=True, default=1)
    program: str = eqx.field(static=True, default="")

    @property
    def designs_per_call(self) -> int:
        """Number of designs that a compiled program computes in one call."""
        return 1 if self.forward_only else self.batch_size

    @property
    def equalities(self) -> int:
        """Number of held quantities, the equality constraints."""
        return len(self.space.held)

    def values(self, z: Array, near: Sequence[Array], pieces: bool = False) -> tuple[Array, tuple[Array, ...]]:
        """Return the values of the objective, deviations of held quantities and excesses of demands, in one array, with the
        `pieces` of the objective appended if requested; and the followed speeds."""
        evaluation = Evaluation(self.space.at(z), dict(zip(self.keys, near, strict=True)))
        values = self.read(evaluation)
        if pieces:
            values = jnp.concatenate([values, self.objective.pieces(evaluation)])
        return values, tuple(evaluation.speeds[key] for key in self.keys)

    def read(self, evaluation: Evaluation) -> Array:
        """Return the objective, deviations of held quantities and excesses of demands from an evaluation of a scene."""
        objective = jnp.reshape(self.objective.read(evaluation), (1,))
        held = self.space.residuals(evaluation)
        excess = [demand.excess(evaluation, limit) for demand, limit in zip(self.demands, self.constants, strict=True)]
        return jnp.concatenate([objective, held, jnp.stack(excess) / self.scales if excess else jnp.zeros((0,))])

    def simplified(self) -> Problem | None:
        """Return the problem of the first search: leading-order quantities of the machine without tolerances.

        Demands on quantities without a leading order are omitted.

        **Returns** None if the simplified problem is the same problem, or if the objective or a held quantity has no leading
        order.
        """
        objective = self.objective.simplified
        demands = [replace(d, quantity=d.quantity.simplified, limit=d.limit.simplified) for d in self.demands]
        held = tuple(HeldQuantity(h.quantity.simplified, h.value) for h in self.space.held)
        same = objective == self.objective and demands == list(self.demands)
        if same and all(a.quantity == b.quantity for a, b in zip(held, self.space.held, strict=True)):
            return None
        if _needs_other_tier(objective) or any(_needs_other_tier(h.quantity) for h in held):
            return None
        kept_demands = [k for k, d in enumerate(demands) if not (_needs_other_tier(d.quantity) or _needs_other_tier(d.limit))]
        space = eqx.tree_at(lambda s: s.held, self.space, held)
        forms, index = tuple(demands[k] for k in kept_demands), np.asarray(kept_demands, int)
        keys, parts, program = _targets_of_search(space, objective, forms)
        return Problem(
            space, objective, forms, keys, self.constants[index], self.scales[index], self.batch_size, parts, program
        )

    def violations(self, values: np.ndarray) -> np.ndarray:
        """Return the relative violations (s, me + mi) of held quantities and demands from the values of s designs."""
        m = self.equalities
        return np.concatenate([np.abs(values[:, 1 : 1 + m]), np.maximum(values[:, 1 + m :], 0.0)], axis=1)

    @property
    def forward_only(self) -> bool:
        """True if the derivatives of a quantity exist in forward mode only."""
        quantities = [self.objective, *(q for d in self.demands for q in (d.quantity, d.limit))]
        return has_runs([*quantities, *(h.quantity for h in self.space.held)])


def has_runs(quantities: Iterable[Quantity]) -> bool:
    """Return True if one of the quantities is computed by time integration."""
    return any(quantity.forward_only for quantity in quantities)


def _targets_of_search(space: DesignSpace, objective: Quantity, demands: Sequence[Demand]) -> tuple[tuple[Key, ...], int, str]:
    """Return the keys of the load speeds that a search follows, the number of smooth pieces of the objective, and the digest of
    the program, see `find_targets`."""
    sides = (q for demand in demands for q in (demand.quantity, demand.limit))
    return find_targets((objective, *(h.quantity for h in space.held), *sides), space.scene)


def _needs_other_tier(quantity: Quantity) -> bool:
    """Return True if part of the quantity is not computed to leading order."""
    return any(isinstance(q, BuiltinQuantity) and q.tier != "leading" for q in walk(quantity))


class Point(NamedTuple):
    """Designs with their values and derivatives.

    **Attributes**: designs `z` (s, d); `values` (s, 1 + me + mi) and their derivatives `slopes` (s, 1 + me + mi, d); the
    followed speeds `speeds` and their derivatives with respect to z, `speed_slopes` (s, ..., d), zeros if the derivatives were
    computed in reverse mode; the objective's `pieces` (s, p) and their derivatives `piece_gradients` (s, p, d), empty for an
    objective of one piece.
    """

    z: np.ndarray
    values: np.ndarray
    slopes: np.ndarray
    speeds: Speeds
    speed_slopes: Speeds
    pieces: np.ndarray
    piece_gradients: np.ndarray

    def exists(self) -> np.ndarray:
        """Return True (s,) for designs at which all values and derivatives exist."""
        return np.all(np.isfinite(self.values), axis=1) & np.all(np.isfinite(self.slopes), axis=(1, 2))

    def where(self, chosen: np.ndarray, other: Point) -> Point:
        """Return a point with the designs of this point if `chosen` (s,) is True, otherwise with those of `other`."""
        return jax.tree.map(lambda a, b: np.where(chosen.reshape((-1,) + (1,) * (a.ndim - 1)), a, b), self, other)

    def take(self, index: np.ndarray) -> Point:
        """Return the point with the designs of these indices."""
        return jax.tree.map(lambda a: a[index], self)

    def put(self, index: np.ndarray, new: Point) -> Point:
        """Return a copy with the designs of `new` at these indices."""

        def replaced(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            a = np.array(a)
            a[index] = b
            return a

        return jax.tree.map(replaced, self, new)

    def extrapolate_speeds(self, z: np.ndarray) -> Speeds:
        """Extrapolate the followed speeds linearly to other designs."""
        step = z - self.z
        guess = []
        for k, r in zip(self.speeds, self.speed_slopes, strict=True):
            extrapolated = k + np.einsum("s...d,sd->s...", r, step)
            with np.errstate(invalid="ignore"):  # a fold that does not exist is infinite
                is_near = np.isfinite(extrapolated) & (np.abs(extrapolated / k - 1.0) < 0.2)
            guess.append(np.where(is_near, extrapolated, k))
        return tuple(guess)


def problem_of(space: DesignSpace, objective: Quantity, demands: Sequence[Demand], starts: int = _MAX_BATCH_SIZE) -> Problem:
    """Return the problem of a search with its followed speeds and the scale of each demand.

    The scale is the modulus of the limit. If the limit is 0 or a quantity, the scale is the larger modulus of the demand's
    quantity and limit for the initial design. It is 1 if both are 0 within rounding, or if one of them is not finite.
    """
    forms = tuple(demand.form() for demand in demands)
    keys, parts, program = _targets_of_search(space, objective, forms)
    constants = np.asarray([demand.constant or 0.0 for demand in demands], float)
    scales = np.abs(constants)
    if np.any(scales == 0.0):
        sizes = _sizes(space, tuple(q for d in demands for q in (d.quantity, d.limit))).reshape(-1, 2).max(axis=1)
        scales = np.where(scales > 0.0, scales, np.where(np.isfinite(sizes) & (sizes > 0.0), sizes, 1.0))
    return Problem(space, objective, forms, keys, constants, scales, _batch_size(starts), parts, program)


def _sizes(space: DesignSpace, quantities: tuple[Quantity, ...]) -> np.ndarray:
    """Return the modulus of each quantity (q,) for the initial design; 0 if it is negligible beside its values for other
    designs."""
    z = np.random.default_rng(0).uniform(size=(7, space.size))
    scenes = _scenes_of(space, on_device(space.numbers(z)))
    batch = jax.tree.map(lambda first, more: np.concatenate([np.asarray(first)[None], more]), space.scene, scenes)
    values = np.abs(evaluate_quantities(quantities, batch))
    largest = np.max(values, axis=0, initial=0.0, where=np.isfinite(values))
    return np.where(values[0] < _ROUNDING_SHARE * largest, 0.0, values[0])


def derive(
    problem: Problem, z: Array, near: Sequence[Array], pieces: bool = False
) -> tuple[Array, Array, tuple[Array, ...], tuple[Array, ...]]:
    """Return values, derivatives, followed speeds and their derivatives of one design.

    If `pieces` is True, the pieces of the objective are the last values. In reverse mode the derivatives of the followed speeds
    are not computed; zeros take their place.
    """

    def values_and_speeds(x: Array) -> tuple[tuple[Array, tuple[Array, ...]], tuple[Array, tuple[Array, ...]]]:
        values, speeds = problem.values(x, near, pieces)
        return (values, speeds), (values, speeds)

    rows = 1 + problem.equalities + len(problem.demands) + (problem.parts if pieces else 0)
    if z.shape[0] <= 4 * rows or problem.forward_only:
        (slopes, speed_slopes), (values, speeds) = jax.jacfwd(values_and_speeds, has_aux=True)(z)
    else:
        slopes, (values, speeds) = jax.jacrev(lambda x: (values_and_speeds(x)[0][0], values_and_speeds(x)[1]), has_aux=True)(z)
        speed_slopes = tuple(jnp.zeros((*w.shape, z.shape[0])) for w in speeds)
    return values, slopes, speeds, speed_slopes


@cached
def _derive_all(
    problem: Problem, z: Array, near: tuple[Array, ...]
) -> tuple[Array, Array, tuple[Array, ...], tuple[Array, ...]]:
    return mapped(lambda x, w: derive(problem, x, w, problem.parts > 1), one_by_one=problem.forward_only)(z, near)


@cached
def _speeds_of_branches(keys: tuple[Key, ...], scenes: Scene) -> tuple[Array, ...]:
    """Return the load speed of each key for a batch of scenes, from whole branches."""

    def speeds_of_scene(scene: Scene) -> tuple[Array, ...]:
        paths: dict[tuple, JamModes] = {}
        for path, _ in keys:
            if path not in paths:
                at, has_several = scene, False
                for case in path:
                    at, has_several = case.scenes(at), has_several or case.has_several
                paths[path] = jax.lax.map(jam_modes, at) if has_several else jam_modes(at)

        def guess(path: tuple, target: tuple[str, int]) -> Array:
            modes = paths[path]
            return (
                jax.vmap(lambda m: speed_of_target(m, target))(modes)
                if modes.omega.ndim > 1
                else speed_of_target(modes, target)
            )

        return tuple(guess(path, target) for path, target in keys)

    # One scene after the other: this compiles in two thirds of the time and runs equally fast.
    return jax.lax.map(speeds_of_scene, scenes)


@cached
def _scenes_of(space: DesignSpace, numbers: Array) -> Scene:
    return jax.vmap(space.scene_of)(numbers)


def _batch_size(count: int) -> int:
    return min(_MAX_BATCH_SIZE, 1 << max(count - 1, 0).bit_length())


def evaluate(problem: Problem, z: np.ndarray, near: Speeds) -> Point:
    """Return values and derivatives of designs z (s, d). Jams and folds are searched for near the load speeds `near`.

    **Raises** `ValueError` if there is no design.
    """
    if len(z) == 0:
        raise ValueError("no designs")
    values, slopes, speeds, speed_slopes = in_chunks(problem.designs_per_call, lambda x, w: _derive_all(problem, x, w), z, near)
    rows = 1 + problem.equalities + len(problem.demands)
    return Point(z, values[:, :rows], slopes[:, :rows], speeds, speed_slopes, values[:, rows:], slopes[:, rows:])


def find_speeds(problem: Problem, z: np.ndarray) -> Speeds:
    """Return the followed speeds of designs z (s, d) from whole branches; NaN for a jam and infinite for a fold that does not
    exist."""
    if not problem.keys:
        return ()
    numbers = problem.space.numbers(np.asarray(z))
    scenes = scenes_of(problem, numbers)
    return in_chunks(problem.designs_per_call, lambda batch: _speeds_of_branches(problem.keys, batch), scenes)


def scenes_of(problem: Problem, numbers: np.ndarray) -> Scene:
    """Return the scenes with these free parameters (s, d), SI, as NumPy arrays with a leading axis."""
    return in_chunks(problem.designs_per_call, lambda x: _scenes_of(problem.space, x), numbers)


class _Shapes(NamedTuple):
    """Structure of a scene, without the values of its arrays."""

    tree: Any
    leaves: tuple[tuple[tuple[int, ...], np.dtype], ...]

    @classmethod
    def of(cls, scene: Scene) -> _Shapes:
        leaves, tree = jax.tree.flatten(scene)
        return cls(tree, tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves))


def find_targets(quantities: Sequence[Quantity], scene: Scene) -> tuple[tuple[Key, ...], int, str]:
    """Return the keys of the load speeds that these quantities follow, the number of pieces of the first quantity, and a
    digest. The pieces are smooth, and their maximum is the quantity. The digest is that of the program of the quantities, "" if
    they contain no function of the user.

    The digest is an argument of the compiled functions, because a user's function still compares equal after a change of its
    global variables. Without the digest, the program from before the change would be used again.
    """
    quantities, shapes = tuple(quantities), _Shapes.of(scene)
    parts = (part for quantity in quantities for part in walk(quantity))
    if any(part.function is not None and not isinstance(part, BuiltinQuantity) for part in parts):
        keys, count, program = _traced(quantities, shapes)
        return keys, count, program_digest(program)
    return *_targets_of_builtin(quantities, shapes), ""


@functools.lru_cache(maxsize=256)
def _targets_of_builtin(quantities: tuple[Quantity, ...], shapes: _Shapes) -> tuple[tuple[Key, ...], int]:
    return _traced(quantities, shapes)[:2]


def _traced(quantities: tuple[Quantity, ...], shapes: _Shapes) -> tuple[tuple[Key, ...], int, ClosedJaxpr]:
    """Return the keys and the number of smooth pieces, see `find_targets`, and the program of the quantities."""
    recorder = TargetRecorder()

    def evaluate_all(scene: Scene) -> tuple[Array, list[Array]]:
        evaluation = Evaluation(scene, recorder)
        return quantities[0].pieces(evaluation), [q.read(evaluation) for q in quantities]

    scene = jax.tree.unflatten(shapes.tree, [jax.ShapeDtypeStruct(*leaf) for leaf in shapes.leaves])
    program, (pieces, _) = jax.make_jaxpr(evaluate_all, return_shape=True)(scene)
    return tuple(recorder.keys), pieces.shape[0], program


@cached
def _evaluate_all(
    quantities: tuple[Quantity, ...], keys: tuple[Key, ...], program: str, scenes: Scene, near: tuple[Array, ...]
) -> Array:
    def values_of_scene(scene: Scene, speeds: tuple[Array, ...]) -> Array:
        evaluation = Evaluation(scene, dict(zip(keys, speeds, strict=True)))
        return jnp.stack([q.read(evaluation) for q in quantities])

    return mapped(values_of_scene, one_by_one=has_runs(quantities))(scenes, near)


def evaluate_quantities(quantities: Sequence[Quantity], scenes: Scene, problem: Problem | None = None) -> np.ndarray:
    """Return the values (s, q) of quantities of several scenes (arrays with a leading axis), NaN for a value that does not
    exist.

    If a `problem` is given, the programs of its search are reused if possible.
    """
    quantities, leaves = tuple(quantities), jax.tree.leaves(scenes)
    if not quantities:
        return np.zeros((leaves[0].shape[0], 0))
    keys, _, program = find_targets(quantities, jax.tree.map(lambda leaf: leaf[0], scenes))
    followed = keys if problem is None or set(keys) - set(problem.keys) else problem.keys

    def part(batch: Scene) -> Array:
        near = dict(zip(followed, _speeds_of_branches(followed, batch), strict=True)) if followed else {}
        return _evaluate_all(quantities, keys, program, batch, tuple(near[key] for key in keys))

    return in_chunks(_batch_size(leaves[0].shape[0]) if problem is None else problem.batch_size, part, scenes)
