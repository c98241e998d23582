"""Quantities in other load cases and over tolerances."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError, quoted
from jaxvib.machine.numbers.named import NamedNumber, find_number, put_numbers, put_present, read_value
from jaxvib.machine.scene import Scene
from jaxvib.numerics.extrema import greatest
from jaxvib.units import Number, count
from optimize.quantities.evaluation import Evaluation, Key, TargetRecorder, mapped
from optimize.quantities.quantity import Quantity, quantity_function


@dataclass(frozen=True)
class Changed:
    """Case in which some parameters of the scene have other values."""

    name: str
    values: tuple[tuple[str, float], ...]

    has_several = False

    def scenes(self, scene: Scene) -> Scene:
        """Return the scene with these values."""
        for name, value in self.values:
            scene = put_present(scene, find_number(scene, name, "under"), value)
        return scene


def require_single_tolerances(numbers: Iterable[NamedNumber]) -> None:
    """**Raises** `InputError` if two of the `numbers` contain the same parameter."""
    used: set = set()
    for each in numbers:
        if each.entries & used:
            raise InputError("tolerances", f"name a number of {each.name} twice; give one tolerance for each number")
        used |= each.entries


@dataclass(frozen=True)
class Sampled:
    """Case of many scenes whose parameters deviate within relative `tolerances`. The seed determines the samples."""

    tolerances: tuple[tuple[str, float], ...]
    samples: int
    seed: int

    has_several = True

    def factors(self, scene: Scene) -> list[tuple[NamedNumber, np.ndarray]]:
        """Return the factors (samples, entries) of each parameter, with normally distributed deviations from 1.

        The deviations are limited to three standard deviations, and a factor is at least 0.05. The factors are a Latin
        hypercube: the samples of each entry cover its distribution evenly, in an order that is independent of the other
        entries.
        """
        random, out = np.random.default_rng(self.seed), []
        normal = NormalDist()
        for name, tolerance in self.tolerances:
            entry = find_number(scene, name, "tolerance")
            shares = (np.arange(self.samples) + 0.5) / self.samples
            deviations = np.clip([normal.inv_cdf(float(share)) for share in shares], -3.0, 3.0)
            deviation = np.stack([random.permutation(deviations) for _ in range(entry.size)], axis=1)
            # The tolerance is two standard deviations: 95 of 100 machines are within it.
            out.append((entry, np.maximum(1.0 + 0.5 * tolerance * deviation, 0.05)))
        require_single_tolerances([entry for entry, _ in out])
        return out

    def scenes(self, scene: Scene) -> Scene:
        """Return the scenes; every array has a leading axis."""
        factors = [(entry, jnp.asarray(f)) for entry, f in self.factors(scene)]

        def scene_with(*factors_of_scene: Array) -> Scene:
            changed = scene
            for (entry, _), factor in zip(factors, factors_of_scene, strict=True):
                changed = put_numbers(changed, (entry,), entry.read(changed) * factor)
            return changed

        return jax.vmap(scene_with)(*(f for _, f in factors))


@dataclass(frozen=True, repr=False)
class _DerivedQuantity(Quantity):
    """Quantity that is computed from another quantity."""

    @property
    def words(self) -> str:
        return self.name


@dataclass(frozen=True, repr=False)
class Under(_DerivedQuantity):
    """Quantity of the scene in another load case."""

    case: Changed = Changed("", ())

    def read(self, evaluation: Evaluation) -> Array:
        return self._value_of_cases(evaluation, self.parts[0].read)

    def pieces(self, evaluation: Evaluation, sign: float = 1.0) -> Array:
        return self._value_of_cases(evaluation, lambda inner: self.parts[0].pieces(inner, sign))

    def _value_of_cases(self, evaluation: Evaluation, compute: Callable[[Evaluation], Array]) -> Array:
        scene, path = evaluation.in_case(self.case)
        inner = Evaluation(scene, evaluation.near_speeds, path)
        value = compute(inner)
        evaluation.speeds.update(inner.speeds)
        return value


@dataclass(frozen=True, repr=False)
class Robust(_DerivedQuantity):
    """Statistic of a quantity over tolerances."""

    case: Sampled = Sampled((), 1, 0)
    statistic: str = "expected"
    level: float = 0.0

    def read(self, evaluation: Evaluation) -> Array:
        values = self._sampled(evaluation, self.parts[0].read)
        if self.statistic == "expected":
            return jnp.mean(values)
        if self.statistic == "worst":
            return greatest(values)
        # The mean of the values above the quantile would be smoother, but the user requests the quantile itself.
        return jnp.quantile(values, self.level)

    def pieces(self, evaluation: Evaluation, sign: float = 1.0) -> Array:
        if self.statistic != "worst" or sign < 0.0:
            return super().pieces(evaluation, sign)
        return self._sampled(evaluation, self.parts[0].pieces).reshape(-1)

    def _sampled(self, evaluation: Evaluation, compute: Callable[[Evaluation], Array]) -> Array:
        """Return the values of all samples, (samples, ...)."""
        scenes, path = evaluation.in_case(self.case)
        near_speeds, keys = evaluation.near_speeds, []
        near: tuple[Array, ...] | None = None
        if not isinstance(near_speeds, TargetRecorder) and near_speeds is not None:
            keys = [key for key in near_speeds if key[0][: len(path)] == path]
            near = tuple(near_speeds[key] for key in keys)
        keys_found: list[Key] = []

        def value_of(scene: Scene, near: tuple[Array, ...] | None) -> tuple[Array, tuple[Array, ...]]:
            recorder = near_speeds if isinstance(near_speeds, TargetRecorder) else None
            inner = Evaluation(scene, recorder if near is None else dict(zip(keys, near, strict=True)), path)
            value = compute(inner)
            keys_found[:] = inner.speeds
            return value, tuple(inner.speeds.values())

        values, speeds = mapped(value_of, one_by_one=self.forward_only)(scenes, near)
        evaluation.speeds.update(zip(keys_found, speeds, strict=True))
        return values

    @property
    def simplified(self) -> Quantity:
        return self.parts[0].simplified


@quantity_function
def under(quantity: Quantity, name: str, changes: Mapping[str, Number]) -> Quantity:
    """Return a quantity of the same machine in another load case, in which some parameters, such as the rotor speed, differ.

    **Arguments**

    - `quantity`, which is computed for the changed scene
    - `name` of the case, for tables
    - `changes`: a mapping from the name of a parameter, such as "drive.speed" or "machine.mass[0]", to its value, SI or text
      with a unit; the name of an array changes each of its entries that is not 0; typical: 1 or 2 parameters, 0.5 to 2 times
      their values

    **Returns** `Quantity`. **Raises** `InputError` for a value in a wrong unit. A name that the scene does not have raises
    `InputError` when the quantity is computed.

    >>> from optimize import foundation_force, under
    >>> under(foundation_force(mode=3), "loaded", {"machine.mass[0]": "180 kg"}).words
    'foundation force, mode 3 (loaded)'
    """
    if not isinstance(changes, Mapping) or not changes:
        raise InputError("changes", f"is {quoted(changes)}; it must be a dictionary such as {{'drive.speed': '1200 rpm'}}")
    values = tuple((key, read_value(key, value)) for key, value in changes.items())
    case = Changed(name, values)
    words = f"{quantity.words} ({name})"
    return Under(words, quantity.unit, mode=quantity.mode, of=quantity.of, case=case, parts=(quantity,))


def _robust(
    quantity: Quantity, tolerances: Mapping[str, float], samples: int, seed: int, statistic: str, level: float
) -> Quantity:
    if not isinstance(tolerances, Mapping) or not tolerances:
        raise InputError(
            "tolerances", f"is {quoted(tolerances)}; it must be a dictionary such as {{'machine.stiffness': 0.05}}"
        )
    for name, value in tolerances.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 < value < 1.0:
            raise InputError(f"tolerances.{name}", f"is {quoted(value)}; it must be between 0 and 1, such as 0.05 for 5 %")
    size = count(samples, "samples", low=2, each=64.0 * len(tolerances))
    case = Sampled(tuple((k, float(v)) for k, v in tolerances.items()), size, count(seed, "seed", low=0))
    words = {"worst": "worst (highest)", "quantile": f"{100.0 * level:.0f} % quantile of"}.get(statistic, statistic)
    return Robust(
        f"{words} {quantity.words}",
        quantity.unit,
        mode=quantity.mode,
        of=quantity.of,
        case=case,
        parts=(quantity,),
        statistic=statistic,
        level=level,
    )


@quantity_function
def expected(quantity: Quantity, tolerances: Mapping[str, float], *, samples: int = 64, seed: int = 0) -> Quantity:
    """Return the mean of a quantity over machines whose parameters deviate from the design.

    **Arguments**

    - `quantity` of each machine
    - `tolerances`: a mapping from the name of a parameter or array of the scene to a relative tolerance (0.05: 5 %); typical:
      0.01 to 0.1 for masses and springs, 0.3 to 0.5 for damping. A tolerance is two standard deviations: 95 of 100 machines are
      within it. Each entry of an array has an independent, normally distributed error, limited to one and a half tolerances
    - `samples`: number of random machines; typical: 16 to 256 (default 64). The computing time is proportional to this number
    - `seed` of the random machines (a Latin hypercube)

    **Returns** `Quantity`, NaN if it does not exist for one of the machines. **Raises** `InputError` for wrong tolerances.

    >>> from optimize import expected, foundation_force
    >>> expected(foundation_force(mode=3), {"machine.stiffness": 0.05}).words
    'expected foundation force, mode 3'
    """
    return _robust(quantity, tolerances, samples, seed, "expected", 0.0)


@quantity_function
def worst(
    quantity: Quantity, tolerances: Mapping[str, float], *, samples: int = 64, seed: int = 0, is_large_good: bool = False
) -> Quantity:
    """Return the largest value of a quantity over machines whose parameters deviate from the design, see `expected`.

    **Arguments**

    - `quantity`, `tolerances`, `samples` and `seed`: as for `expected`; typical: 64 samples (the default)
    - `is_large_good`: True for a quantity that should be large; the result is then the smallest value; typical: False (the
      default)

    **Returns** `Quantity`, NaN if it does not exist for one of the machines. **Raises** `InputError` for wrong tolerances.

    >>> from optimize import foundation_force, worst
    >>> worst(foundation_force(mode=3), {"machine.damping": 0.3}).unit
    'N'
    """
    if is_large_good:
        largest = _robust(-quantity, tolerances, samples, seed, "worst", 0.0)
        return (-largest).named(f"worst (lowest) {quantity.words}")
    return _robust(quantity, tolerances, samples, seed, "worst", 0.0)


@quantity_function
def quantile(
    quantity: Quantity, level: float, tolerances: Mapping[str, float], *, samples: int = 64, seed: int = 0
) -> Quantity:
    """Return a quantile: the value below which a quantity lies for a given fraction of the machines, see `expected`.

    **Arguments**

    - `quantity`, `tolerances`, `samples` and `seed`: as for `expected`
    - `level`: the fraction, between 0 and 1; typical: 0.9 to 0.99. The number of samples should be several times
      1 / (1 - level)

    **Returns** `Quantity`, NaN if it does not exist for one of the machines. **Raises** `InputError` for wrong tolerances or a
    wrong level.

    >>> from optimize import foundation_force, quantile
    >>> quantile(foundation_force(mode=3), 0.95, {"machine.stiffness": 0.05}).words
    '95 % quantile of foundation force, mode 3'
    """
    if isinstance(level, bool) or not isinstance(level, (int, float)) or not 0.0 < level < 1.0 or math.isnan(level):
        raise InputError("level", f"is {quoted(level)}; it must be greater than 0 and less than 1")
    return _robust(quantity, tolerances, samples, seed, "quantile", float(level))
