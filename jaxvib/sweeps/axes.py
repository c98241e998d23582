"""Axes of a study: parameters of the scene or of the initial state, with values from lists, ranges or samples."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.state import State
from jaxvib.errors import InputError, quoted, suggest_name
from jaxvib.machine.numbers.named import NamedNumber, find_number, present_numbers, put_present
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.units import Number, count, number

SAMPLE = "sample"
"""Name of the dimension of the samples."""

_START_UNITS = {"angle": "rad", "rate": "rad/s", "displacement": "m", "velocity": "m/s"}
"""Parameters of an initial state, with the names of `State`, and their units."""

_AXIS_FIELDS = ["from", "to", "count", "scale"]

_MAX_CORNERS = 1024
"""Maximum number of corners with which the search for extreme cases begins: all corners of up to 10 axes."""

_VALUES_TO_TRY = 9
"""Number of values of an axis in the search for extreme cases: its ends and values between them."""

_MAX_ROUNDS = 20
"""Maximum number of rounds over all axes in the search for extreme cases; usually the second round changes nothing."""

AxisSpec: TypeAlias = Sequence[Number] | np.ndarray | Mapping[str, Number | int | str]
"""A list of values, or a table of `from`, `to`, `count` and `scale`; without `count` the parameter is sampled."""


class Target(NamedTuple):
    """Target of an axis: a parameter of the scene, or an entry of the initial state.

    **Attributes**: `number`: the parameter of the scene, None for an entry of the initial state; `field` of the initial state;
    `entry`: index in this field, None for all entries.
    """

    number: NamedNumber | None
    field: str
    entry: int | None


class Axis(NamedTuple):
    """Axis of a study: one or several parameters with a common name, whose common value changes from case to case.

    **Attributes**

    - `name`, `unit` (SI)
    - `values` (n,), SI; None if the values are sampled
    - `low`, `high`: the smallest and the largest value, SI; `log`: True for a logarithmic scale between them
    - `target`: the parameters that the axis changes
    """

    name: str
    unit: str
    values: np.ndarray | None
    low: float
    high: float
    log: bool
    target: Target

    def at(self, fraction: np.ndarray) -> np.ndarray:
        """Return the values at fractions in [0, 1] of the range."""
        if self.log:
            return self.low * (self.high / self.low) ** fraction
        return self.low + (self.high - self.low) * fraction


class Grid(NamedTuple):
    """All cases of a study: all combinations of the values of the axes, and for each combination all samples.

    **Attributes**: `axes`; `samples`: number of samples, 0 without sampled axes; `seed` and `sampling`: arguments of the
    function `samples`; `tile`: number of cases of a chunk along each dimension.
    """

    axes: tuple[Axis, ...]
    samples: int
    seed: int
    sampling: str
    tile: tuple[int, ...]

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of the dimensions."""
        return (*(axis.name for axis in self.axes if axis.values is not None), *([SAMPLE] if self.samples else []))

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of cases along each dimension."""
        return (*(axis.values.size for axis in self.axes if axis.values is not None), *([self.samples] if self.samples else []))

    @property
    def cases(self) -> int:
        """Number of cases."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def tiles(self) -> tuple[int, ...]:
        """Number of chunks along each dimension."""
        return tuple(-(-n // t) for n, t in zip(self.shape, self.tile, strict=True))

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return int(np.prod(self.tiles, dtype=np.int64))

    def region(self, chunk: int) -> tuple[slice, ...]:
        """Return the slices of the cases of a chunk along the dimensions."""
        first = [k * t for k, t in zip(np.unravel_index(chunk, self.tiles), self.tile, strict=True)]
        return tuple(slice(int(a), min(int(a) + t, n)) for a, t, n in zip(first, self.tile, self.shape, strict=True))

    def values(self, chunk: int) -> np.ndarray:
        """Return the values (cases, axes), SI, of the axes in the cases of a chunk, in C order."""
        region = self.region(chunk)
        index = np.indices([s.stop - s.start for s in region]).reshape(len(region), -1)
        drawn = self.sampled_values(region[-1]) if self.samples else np.zeros((0, 0))
        columns, grid, sampled = [], 0, 0
        for axis in self.axes:
            if axis.values is None:
                columns.append(drawn[index[-1], sampled])
                sampled += 1
            else:
                columns.append(axis.values[region[grid]][index[grid]])
                grid += 1
        return np.stack(columns, axis=1)

    def sampled_values(self, which: slice) -> np.ndarray:
        """Return the values (samples, sampled axes), SI, of the sampled axes for a slice of the samples."""
        axes = [axis for axis in self.axes if axis.values is None]
        shares = samples(which.start, which.stop, len(axes), self.seed, self.sampling)
        return np.stack([axis.at(shares[:, k]) for k, axis in enumerate(axes)], axis=1)


def axis_of(scene: Scene, name: str, spec: AxisSpec) -> Axis:
    """Return the axis of the parameter with this name; `spec`: a list of values, or a table.

    **Raises** `InputError` for a name that does not exist and for values that are not allowed.
    """
    target, unit = _target_of(scene, name)

    def value(stated: Number, field: str) -> float:
        return float(number(stated, unit, field)) if target.number is None else target.number.value(stated, field)

    if isinstance(spec, Mapping):
        for key in spec:
            if key not in _AXIS_FIELDS:
                hint = f'; write the whole name in quotes, "{name}.{key}"' if not {"from", "to"} & set(spec) else ""
                raise InputError(f"axes.{name}.{key}", f"is not a field of an axis{hint}; {suggest_name(key, _AXIS_FIELDS)}")
        for key in ("from", "to"):
            if key not in spec:
                raise InputError(f"axes.{name}.{key}", "is missing; an axis is a list, or a table with from and to")
        low, high = value(spec["from"], f"axes.{name}.from"), value(spec["to"], f"axes.{name}.to")
        if not low < high:
            raise InputError(f"axes.{name}", f"has from = {low:g} and to = {high:g}; from must be less than to")
        scale = spec.get("scale", "even")
        if scale not in ("even", "log"):
            raise InputError(f"axes.{name}.scale", f"is {quoted(scale)}; it must be 'even' or 'log'")
        if scale == "log" and not low > 0.0:
            raise InputError(f"axes.{name}.from", f"is {low:g}; it must be greater than 0 for the scale 'log'")
        values = None
        if "count" in spec:
            size = count(spec["count"], f"axes.{name}.count", low=2, each=64.0)
            values = np.geomspace(low, high, size) if scale == "log" else np.linspace(low, high, size)
        axis = Axis(name, unit, values, low, high, scale == "log", target)
    else:
        if isinstance(spec, str) or not isinstance(spec, (list, tuple, np.ndarray)) or len(spec) == 0:
            raise InputError(f"axes.{name}", f"is {quoted(spec)}; give a list of values, or a table with from, to and count")
        values = np.asarray([value(v, f"axes.{name}[{k}]") for k, v in enumerate(spec)])
        if np.unique(values).size < values.size:
            raise InputError(f"axes.{name}", "has a value twice; give each value once")
        axis = Axis(name, unit, values, float(np.min(values)), float(np.max(values)), False, target)
    for end in (axis.low, axis.high):  # the constructors of the scene's parts check the range of each number
        validate_scene(put_values(scene, (target,), jnp.asarray([end])))
    return axis


def _target_of(scene: Scene, name: str) -> tuple[Target, str]:
    """Return the target with this name, in the scene or in the initial state, and its unit."""
    if not str(name).startswith("start."):
        parameter = find_number(scene, name, "axes")
        present_numbers(scene, parameter, "axes")  # raises an error for an array of absent springs
        return Target(parameter, "", None), parameter.unit
    match = re.fullmatch(r"start\.([a-z]+)(?:\[(\d+)\])?", str(name))
    if match is None or match[1] not in _START_UNITS:
        raise InputError(
            f"axes.{name}",
            f"is not a parameter of the initial state; {suggest_name(str(name), [f'start.{f}' for f in _START_UNITS])}",
        )
    size = scene.loads.count if match[1] in ("angle", "rate") else scene.machine.structure().mass.shape[0]
    entry = None if match[2] is None else int(match[2])
    if entry is not None and entry >= size:
        raise InputError(f"axes.{name}", f"does not exist; start.{match[1]} has {size} entries, counted from 0")
    unit = _START_UNITS[match[1]]
    if unit in ("m", "m/s"):
        units = scene.machine.structure().units  # a coordinate may be a rotation
        changed = set(units if entry is None else units[entry : entry + 1])
        if len(changed) > 1:
            problem = "sets displacements and rotations to one number; give an index"
            raise InputError(f"axes.{name}", f"{problem}, such as start.{match[1]}[0]")
        unit = unit.replace("m", changed.pop())
    return Target(None, match[1], entry), unit


def require_disjoint(scene: Scene, axes: Sequence[Axis]) -> None:
    """**Raises** `InputError` if two axes change the same parameter."""
    owners: dict[object, str] = {}
    for axis in axes:
        parameter, field, entry = axis.target
        if parameter is not None:
            entries: set = parameter.entries
        else:
            size = scene.loads.count if field in ("angle", "rate") else scene.machine.structure().mass.shape[0]
            entries = {(field, k) for k in (range(size) if entry is None else (entry,))}
        for entry_of_axis in entries:
            if entry_of_axis in owners:
                raise InputError(
                    f"axes.{axis.name}",
                    f"changes a parameter that axes.{owners[entry_of_axis]} also changes; use one of these axes",
                )
            owners[entry_of_axis] = axis.name


def put_values(scene: Scene, targets: Sequence[Target], values: Array) -> Scene:
    """Return the scene with the values (axes,) of the axes in a case. Absent springs and dampers stay absent."""
    for k, target in enumerate(targets):
        if target.number is not None:
            scene = put_present(scene, target.number, values[k])
    return scene


def put_start(state: State, targets: Sequence[Target], values: Array) -> State:
    """Return the initial state with the values (axes,) of the axes in a case.

    A common value for all angles sets the mean angle of the loads and keeps their differences.
    """
    for k, (parameter, field, entry) in enumerate(targets):
        if parameter is None:
            old = getattr(state, field)
            leaf = old[0] if isinstance(old, tuple) else old
            if entry is not None:
                new = leaf.at[entry].set(values[k])
            elif field == "angle":
                new = leaf - jnp.mean(leaf) + values[k]
            else:
                new = jnp.full_like(leaf, values[k])
            state = eqx.tree_at(lambda s, f=field: getattr(s, f), state, (new, *old[1:]) if isinstance(old, tuple) else new)
    return state


def extreme_cases(axes: Sequence[Axis], rates: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return cases (R, axes), SI, in the range of all axes: case k has the largest value of rate k.

    `rates` is a function that returns R rates (cases, R) for cases (cases, axes). The search begins at the best of all corners
    or, with more than 10 axes, of 1024 random corners. It then changes one axis at a time to the best of its ends and 7 values
    between them, until no change increases a rate.
    """
    tried = np.stack([_values_to_try(axis) for axis in axes])
    axes_count = len(axes)
    if 2**axes_count <= _MAX_CORNERS:
        is_high = np.indices((2,) * axes_count).reshape(axes_count, -1).T
    else:
        is_high = np.random.Generator(np.random.Philox(key=0)).integers(0, 2, (_MAX_CORNERS, axes_count))
    corners = np.where(is_high, tried[:, -1], tried[:, 0])
    best = corners[np.argmax(rates(corners), axis=0)]
    rate_index = np.arange(len(best))
    for _ in range(_MAX_ROUNDS):
        before = best
        for k in range(axes_count):
            trials = np.repeat(best[:, None], 1 + _VALUES_TO_TRY, axis=1)  # the first is unchanged and wins if rates are equal
            trials[:, 1:, k] = tried[k]
            rates_of_trials = rates(trials.reshape(-1, axes_count)).reshape(len(best), -1, len(best))[rate_index, :, rate_index]
            best = trials[rate_index, np.argmax(rates_of_trials, axis=1)]
        if np.array_equal(best, before):
            break
    return best


def _values_to_try(axis: Axis) -> np.ndarray:
    """Return increasing values (9,) of an axis from its lower to its upper end; short lists have repeated values."""
    shares = np.linspace(0.0, 1.0, _VALUES_TO_TRY)
    if axis.values is None:
        return axis.at(shares)
    return np.sort(axis.values)[np.round(shares * (axis.values.size - 1)).astype(int)]


def tile_of(shape: Sequence[int], max_cases: int) -> tuple[int, ...]:
    """Return the number of cases of a chunk along each dimension; a chunk has at most `max_cases` cases.

    Chunks extend along the last dimension first; their sizes are nearly equal.
    """
    tile, room = [], max_cases
    for n in reversed(shape):
        parts = -(-n // max(min(n, room), 1))
        tile.append(-(-n // parts))
        room = room // tile[-1]
    return tuple(reversed(tile))


SAMPLINGS = ("low_discrepancy", "random")
"""Methods of sampling: a low-discrepancy sequence, or independent random samples."""


def samples(first: int, last: int, size: int, seed: int, sampling: str) -> np.ndarray:
    """Return the samples `first` to `last` - 1 of a sequence in [0, 1)^size, as an array (last - first, size).

    "low_discrepancy" is the additive sequence x_k = frac(x_0 + k a) with a_j = g^-j, where g > 1 solves g^(size+1) = g + 1 and
    x_0 is random with the seed `seed`. The sequence is computed with 64-bit integers; therefore even the billionth sample has
    full precision. "random" samples come from a counter-based generator (Philox) with the key `seed`.

    >>> samples(0, 4, 1, 0, "low_discrepancy").round(3).ravel().tolist()
    [0.012, 0.63, 0.248, 0.866]
    >>> bool((samples(2, 4, 3, 7, "random") == samples(0, 4, 3, 7, "random")[2:]).all())
    True

    Source: M. Roberts, The unreasonable effectiveness of quasirandom sequences, 2018; Salmon et al., Parallel random numbers:
    as easy as 1, 2, 3, 2011.
    """
    if sampling == "random":
        blocks = -(-size // 4)  # the generator returns four numbers at a time
        raw = np.random.Philox(key=seed, counter=first * blocks).random_raw((last - first) * blocks * 4)
        numbers = raw.reshape(last - first, 4 * blocks)[:, :size]
    else:
        root = 2.0
        for _ in range(64):
            root = (1.0 + root) ** (1.0 / (size + 1))
        steps = np.asarray([int(root ** -(j + 1.0) * 2.0**64) for j in range(size)], np.uint64)
        begin = np.random.Philox(key=seed).random_raw(size)
        with np.errstate(over="ignore"):
            numbers = begin + np.arange(first, last, dtype=np.uint64)[:, None] * steps
    return (numbers >> np.uint64(11)) * 2.0**-53
