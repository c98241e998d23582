"""Wrong descriptions of channels: a reversed direction, swapped places, a wrong unit.

After a fit that does not explain the records, the readings are changed as other descriptions of their channels would change
them. If a description fits better than the given one with the first values of the unknowns, and much better after a fit, it is
named.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxvib.errors import quoted
from jaxvib.identification.fit import minimize, project
from jaxvib.identification.problem import Problem, channel_sizes, with_noise
from jaxvib.identification.records.agreement import OTHER_UNITS
from jaxvib.identification.records.channel import UNITS, Channel
from jaxvib.identification.start import fit_amplitudes
from jaxvib.numerics.noise import Noise
from jaxvib.units.columns import unit_factor

_MAX_COST, _MAX_COST_OF_UNIT, _MAX_COST_OF_MOTION = 0.5, 0.05, 0.25
"""Largest costs at which another description is named. The first two are relative to the cost with the given description: for
another direction or place, and for another unit. The third is relative to the cost of a model without motion. The limit for
units is low, because readings of a sensor with a wrong gain also fit better with a unit near this gain."""

_EQUAL_COST = 1e-3
"""Relative difference of the costs of two descriptions up to which the records do not distinguish them."""

_MAX_SCALE_ERROR = 1.25
"""Largest ratio of the common factor of the fitted parameters, relative to their first values, to the factor between two
units."""


class _Description(NamedTuple):
    """Other description of channels.

    **Attributes**: `words` of the description; `readings`: for the name of each changed channel, the name of the channel that
    contains its readings, and their factor; `limit`: largest cost at which the description is named, relative to the cost with
    the given one.
    """

    words: str
    readings: Mapping[str, tuple[str, float]]
    limit: float


def description_notes(problem: Problem) -> list[str]:
    """Return a list with a sentence that names the descriptions of channels with which a machine fits the records much better.

    The list is empty if there is no such description, and for a motion with loads or on nonlinear supports.

    **Arguments**: the `problem` of a fit that does not explain the records.
    """
    if problem.linear is not None:
        return []
    given, others = _weighted(problem), list(_descriptions(problem))
    changed = [_weighted(_with_description(problem, each)) for each in others]
    costs = np.array([_first_cost(each) for each in changed])
    if not others or np.min(costs) >= _first_cost(given):
        return []
    best, readings = int(np.argmin(costs)), sum(int(np.count_nonzero(mask)) for mask in problem.masks)
    if _least_cost(changed[best]) > min(_MAX_COST_OF_MOTION * readings, others[best].limit * _least_cost(given)):
        return []
    words = [each.words for each, cost in zip(others, costs, strict=True) if cost <= (1.0 + _EQUAL_COST) * np.min(costs)]
    return [f"the model explains the records with {', or with '.join(words)}: correct the description of the channels"]


def scale_notes(problem: Problem, ratios: np.ndarray) -> list[str]:
    """Return a sentence if the unit of all vibration channels is probably wrong; otherwise an empty list.

    Readings that are too small by the factor of a wrong unit are explained by masses, stiffnesses and dampings that are too
    large by the same factor. The fit then has no misfit, and only the first values contradict this factor.

    **Arguments**: the `problem` of a fit; `ratios` (k,) of the fitted masses, stiffnesses, dampings and so on to their first
    values.
    """
    channels = list({channel.name: channel for samples in problem.runs for channel in samples.channels}.values())
    if not ratios.size or len({(channel.kind, channel.unit) for channel in channels}) != 1:
        return []
    kind, stated = channels[0].kind, channels[0].unit
    scale = float(np.exp(np.median(np.log(ratios))))
    for unit, of_unit in itertools.product(
        OTHER_UNITS.get(kind, ()), OTHER_UNITS.get(kind, ()) if stated is None else (stated,)
    ):
        factor = (unit_factor(unit, UNITS[kind]) or 1.0) / (unit_factor(of_unit, UNITS[kind]) or 1.0)
        if factor != 1.0 and abs(np.log(scale / factor)) < np.log(_MAX_SCALE_ERROR):
            words = f"{scale:.2g}" if scale < 99.5 else f"{scale:.0f}"
            return [
                f"the fitted parameters are about {words} times their first values, as if the readings of "
                f"{_names(channels)} were in {quoted(unit)} and not in {quoted(of_unit)}: check the unit"
            ]
    return []


def _descriptions(problem: Problem) -> Iterator[_Description]:
    """Yield the descriptions that differ from the given one in a direction, in two places, or in a unit."""
    channels = list({channel.name: channel for samples in problem.runs for channel in samples.channels}.values())
    for channel in channels:
        yield _Description(f"a reversed sign of {_names([channel])}", {channel.name: (channel.name, -1.0)}, _MAX_COST)
    for one, other in itertools.combinations(channels, 2):
        if one.kind == other.kind:
            readings = {one.name: (other.name, 1.0), other.name: (one.name, 1.0)}
            yield _Description(f"{_names([one, other])} swapped", readings, _MAX_COST)
    alike: dict[tuple[str, str | None], list[Channel]] = {}
    for channel in channels:
        alike.setdefault((channel.kind, channel.unit), []).append(channel)
    for group in [*([channel] for channel in channels), *(each for each in alike.values() if len(each) > 1)]:
        kind, units = group[0].kind, OTHER_UNITS.get(group[0].kind, ())
        for unit, stated in itertools.product(units, units if group[0].unit is None else [group[0].unit]):
            factor = (unit_factor(unit, UNITS[kind]) or 1.0) / (unit_factor(stated, UNITS[kind]) or 1.0)
            words = f"{factor:.4g} times the readings of {_names(group)} ({quoted(unit)} in place of {quoted(stated)})"
            if factor != 1.0:
                yield _Description(words, {each.name: (each.name, factor) for each in group}, _MAX_COST_OF_UNIT)


def _names(channels: Sequence[Channel]) -> str:
    return f"channel{'s' if len(channels) > 1 else ''} {' and '.join(quoted(each.name) for each in channels)}"


def _with_description(problem: Problem, description: _Description) -> Problem:
    """Return the problem with the readings of another description."""
    raw, masks = [], []
    for samples, values, mask in zip(problem.runs, problem.raw, problem.masks, strict=True):
        names = [channel.name for channel in samples.channels]
        sources = [description.readings.get(name, (name, 1.0)) for name in names]
        columns = [names.index(source if source in names else name) for name, (source, _) in zip(names, sources, strict=True)]
        raw.append(values[:, columns] * np.array([factor for _, factor in sources]))
        masks.append(mask[:, columns])
    return problem._replace(raw=tuple(raw), masks=tuple(masks))


def _weighted(problem: Problem) -> Problem:
    """Return the problem with each channel weighted by the size of its readings."""
    return with_noise(problem, [[Noise(np.ones(1), size) for size in of_run] for of_run in channel_sizes(problem)])


def _starts(problem: Problem) -> list[np.ndarray]:
    return [np.zeros(problem.unknowns.count), fit_amplitudes(problem)]


def _first_cost(problem: Problem) -> float:
    """Return the least cost at the starts of a fit."""
    return min(project(problem, x).cost for x in _starts(problem))


def _least_cost(problem: Problem) -> float:
    """Return the cost of the best fit from the starts; infinite if none has converged."""
    minima = [minimize(problem, x) for x in _starts(problem)]
    return min((trial.cost for trial, _, _, converged in minima if converged), default=np.inf)
