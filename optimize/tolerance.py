"""Quantities of machines whose parameters differ from the design: ranges, and the share of machines that meet demands."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np

from jaxvib.boundary import validated, with_known_names
from jaxvib.errors import ComputationError, InputError, quoted, suggest_name
from jaxvib.machine.numbers.named import NamedNumber, find_number, numbers_of, present_numbers, put_numbers, put_present
from jaxvib.machine.scene import Scene
from jaxvib.units import Bounds, count, number
from optimize.quantities.cases import Robust, Sampled, require_single_tolerances
from optimize.quantities.quantity import Demand, Quantity, walk

_SHORT_NAMES = {
    "stiffness": re.compile(r"machine\.(link_|supports\[\d+\]\.)?stiffness(_up)?(\[\d+\])?"),
    "damping": re.compile(r"machine\.(link_|supports\[\d+\]\.)?damping(_up)?(\[\d+\])?"),
    "mass": re.compile(r"machine\.(bodies\[\d+\]\.)?mass"),
    "drag": re.compile(r"(exciters\[\d+\]\.)?loads\.drag"),
    "unbalance": re.compile(r"exciters\[\d+\]\.unbalance"),
}
"""Pattern of the names of the parameters for which each short name stands."""

_PERCENT = re.compile(r"([+-]?\d+(?:\.\d*)?)\s*%")
_RANGE = re.compile(r"(.+?)\.\.(.+)")
_MATERIAL = re.compile(r"material(?:\[(\d+)\])?")

_STATISTIC = re.compile(r"\b(worst \((?:highest|lowest)\)|expected|\d+ % quantile of) ")
"""Pattern of the names of statistics over machines."""

_DEFAULT_SAMPLES = 128


@with_known_names
class ToleranceRange(NamedTuple):
    """Range of a quantity over machines within tolerances.

    Returned by `tolerance_ranges`.

    **Attributes**: `words`: name of the quantity or demand; `unit` of the quantity, SI; `design`: its value for the design;
    `low` and `high`: the quantity is between these values in 95 % of the machines for which it exists; `worst`: the largest
    value, for a demand "at least" the smallest; `share`: fraction of the machines for which the quantity exists and, if it is a
    demand, the demand is met.
    """

    words: str
    unit: str
    design: float
    low: float
    high: float
    worst: float
    share: float


class _NumberRange(NamedTuple):
    """Range of a parameter from `low` to `high`, SI; if `is_added`, of a mass that is added to the parameter."""

    number: NamedNumber
    low: float
    high: float
    is_added: bool


@validated
def tolerance_ranges(
    scene: Scene,
    quantities: Sequence[Quantity | Demand],
    tolerances: Sequence[str],
    *,
    samples: int = _DEFAULT_SAMPLES,
    seed: int = 0,
) -> list[ToleranceRange]:
    """Return the ranges of quantities over machines whose parameters differ from a design, to leading order of the loads' mass.

    **Arguments**

    - `scene` of the design
    - `quantities`, or demands of quantities; typical: 1 to 5
    - `tolerances`: texts of one of two forms. NAME=PERCENT, such as "stiffness=5%": each parameter is within the tolerance in
      95 of 100 machines, and the deviations of all parameters are independent. NAME=LOW..HIGH, such as
      "machine.mass[0]=100kg..130kg": all values of the range are equally likely. Short names are stiffness and damping (of all
      springs and dampers), mass, drag and unbalance. "material=0..20kg" is material on platform or body 1, at its centre of
      mass, "material[2]=..." on platform or body 2
    - `samples`: number of machines; typical: 64 to 1000 (default 128)
    - `seed` of the random deviations

    **Returns** a list of `ToleranceRange`, one for each of the `quantities`. **Raises** `InputError` for a text of another
    form, an unknown name, and a parameter that is named twice, even if one of the two names is short.

    >>> import jaxvib as jv
    >>> from optimize import jam_frequency
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("400 rpm"))
    >>> found = tolerance_ranges(scene, [jam_frequency(mode=1)], ["stiffness=2%"], samples=16)[0]
    >>> found.share, found.low < found.design < found.high
    (1.0, True)
    """
    count(samples, "samples", low=2, each=1e4)  # a scene for each machine
    machines = list(_machines(scene, tolerances, samples, seed))
    ranges = []
    for item in quantities:
        quantity = (item.quantity if isinstance(item, Demand) else item).simplified
        values = np.array([_value(quantity, machine) for machine in machines])
        existing = values[np.isfinite(values)]
        is_met = np.isfinite(values)
        at_least = isinstance(item, Demand) and item.sense == "at least"
        if isinstance(item, Demand):
            limits = np.array([_value(item.limit.simplified, machine) for machine in machines])
            is_met = values >= limits if at_least else values <= limits
        low, high = np.quantile(existing, [0.025, 0.975]) if existing.size else (np.nan, np.nan)
        worst = np.nan if not existing.size else np.min(existing) if at_least else np.max(existing)
        design = float(quantity(scene))
        ranges.append(
            ToleranceRange(_words(item), quantity.unit, design, float(low), float(high), float(worst), float(np.mean(is_met)))
        )
    return ranges


def _words(item: Quantity | Demand) -> str:
    """Return the name of a quantity or demand for a single machine, without the name of a statistic over machines."""
    quantity = item.quantity if isinstance(item, Demand) else item
    is_statistic = any(isinstance(part, Robust) for part in walk(quantity))
    return _STATISTIC.sub("", item.words) if is_statistic else item.words


def _value(quantity: Quantity, scene: Scene) -> float:
    """Return the value of a quantity for a scene, NaN if it does not exist."""
    try:
        return float(quantity(scene))
    except ComputationError:  # there is no stable synchronous regime
        return math.nan


class Tolerances(NamedTuple):
    """Tolerances of a scene.

    **Attributes**: `relative`: names of parameters with their relative tolerances; `ranges` of parameters.
    """

    relative: tuple[tuple[str, float], ...]
    ranges: tuple[_NumberRange, ...]


def read_tolerances(scene: Scene, tolerances: Sequence[str]) -> Tolerances:
    """Return tolerances from texts, see `tolerance_ranges`. **Raises** `InputError` for a text of another form, an unknown
    name, or a parameter that is named twice."""
    relative: list[tuple[str, float]] = []
    ranges: list[_NumberRange] = []
    present = numbers_of(scene)
    for text in tolerances:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise InputError("tolerances", f"is {quoted(text)}; write NAME=PERCENT or NAME=LOW..HIGH, such as stiffness=5%")
        if "." not in name and name not in _SHORT_NAMES and not _MATERIAL.fullmatch(name):
            known = suggest_name(name, [*_SHORT_NAMES, "material"])
            allowed = f"{known} (mass on a platform), and parameters such as machine.mass"
            raise InputError(f"tolerances.{name}", f"is not a short name; {allowed}")
        if percent := _PERCENT.fullmatch(value):
            size = float(percent[1]) / 100.0
            if not 0.0 < size < 1.0:
                raise InputError("tolerances", f"is {quoted(text)}; the tolerance must be greater than 0 % and less than 100 %")
            pattern = _SHORT_NAMES.get(name)
            matching = [parameter for parameter in present if pattern is not None and pattern.fullmatch(parameter)]
            relative += [(parameter, size) for parameter in matching or [find_number(scene, name, "tolerances").name]]
        elif ends := _RANGE.fullmatch(value):
            ranges.append(_range(scene, name, ends[1], ends[2]))
        else:
            raise InputError("tolerances", f"is {quoted(text)}; write NAME=PERCENT or NAME=LOW..HIGH, such as stiffness=5%")
    # Material is added to a mass, which may have a tolerance of its own.
    changed = (each.number for each in ranges if not each.is_added)
    require_single_tolerances([*(find_number(scene, name, "tolerances") for name, _ in relative), *changed])
    return Tolerances(tuple(relative), tuple(ranges))


def _machines(scene: Scene, tolerances: Sequence[str], samples: int, seed: int) -> Iterator[Scene]:
    """Yield copies of the scene whose parameters have random deviations."""
    relative, ranges = read_tolerances(scene, tolerances)
    random = np.random.default_rng((count(seed, "seed", low=0), 1))  # other random numbers than those of `Sampled`
    batch = Sampled(relative, samples, seed).scenes(scene) if relative else None
    fractions = [random.permutation((np.arange(samples) + 0.5) / samples) for _ in ranges]
    for k in range(samples):
        machine = scene if batch is None else jax.tree.map(lambda leaf, k=k: leaf[k], batch)
        for entry, fraction in zip(ranges, fractions, strict=True):
            value = entry.low + (entry.high - entry.low) * fraction[k]
            if entry.is_added:
                machine = put_numbers(machine, (entry.number,), entry.number.read(machine) + value)
            else:
                machine = put_present(machine, entry.number, value)
        yield machine


def _range(scene: Scene, name: str, low: str, high: str) -> _NumberRange:
    """Return the range of a parameter from texts; if `low` has no unit, it has that of `high`."""
    material = _MATERIAL.fullmatch(name)
    entry = find_number(scene, _mass_name(scene, int(material[1] or 1)) if material else name, "tolerances")
    unit = "".join(re.findall(r"[^\d.eE+\-\s].*$", high.strip()))
    ends = [low if re.search(r"[^\d.eE+\-\s]", low) else f"{low.strip()} {unit}".strip(), high]
    if material:  # a negative range removes material
        bounds = Bounds(low=-float(entry.read(scene)[0]), open_low=True)
    else:
        present_numbers(scene, entry, "tolerances")  # raises an error for an array of absent springs
        bounds = entry.spec.bounds
    first, last = (float(number(end.strip(), entry.unit, f"tolerances.{name}", **bounds._asdict())) for end in ends)
    if not first < last:
        raise InputError(f"tolerances.{name}", f"is {low}..{high}; the second value must be larger than the first")
    return _NumberRange(entry, first, last, material is not None)


def _mass_name(scene: Scene, number: int) -> str:
    """Return the name of the mass of a platform or body; the only body of a machine has no number."""
    present = numbers_of(scene)
    if f"machine.bodies[{number - 1}].mass" in present:
        return f"machine.bodies[{number - 1}].mass"
    is_single = number == 1 and "machine.mass" in present and present["machine.mass"].size == 1
    return "machine.mass" if is_single else f"machine.mass[{number - 1}]"
