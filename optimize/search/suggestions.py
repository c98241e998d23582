"""Suggestions of fixed parameters, alone or in groups, whose release helps to meet the demands of a design."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from jaxvib.display import shown_unit
from jaxvib.machine.numbers.named import NamedNumber, numbers_of, put_numbers
from jaxvib.machine.scene import Scene
from optimize.quantities.quantity import Quantity
from optimize.search.problem import evaluate_quantities
from optimize.space import DesignSpace

_STEP = 0.01
"""Relative change of the parameters for which effects are stated."""

_MIN_SHOWN_EFFECT, _MAX_SHOWN_GROUPS = 0.05, 3
"""Smallest effect, percent, of a change of fixed parameters by 1 % that is shown, and largest number of groups shown for each
quantity."""

_RANGE = 2.0
"""Ratio of the suggested bounds to the present value."""


class Group(NamedTuple):
    """Fixed parameters that change by one factor.

    **Attributes**: the parameters `members`, single numbers other than 0; their `values`, SI.
    """

    members: tuple[NamedNumber, ...]
    values: tuple[float, ...]

    def free_line(self) -> str:
        """Return the line of the table [free] of a design file with bounds of the first parameter."""
        number, value = self.members[0], self.values[0]
        allowed = number.spec.bounds
        low, high = sorted((value / _RANGE, value * _RANGE))
        low = max(low, (value + allowed.low) / 2.0 if allowed.open_low else allowed.low)
        high = min(high, (value + allowed.high) / 2.0 if allowed.open_high else allowed.high)
        unit, factor = shown_unit(number.unit_of_tables, abs(value))
        shown = [f"{float(f'{bound * factor:.3g}'):g}" for bound in (low, high)]
        bounds = [f'"{bound} {unit}"' if unit else bound for bound in shown]
        return f'"{number.name}" = [{", ".join(bounds)}]'

    def tie_lines(self) -> list[str]:
        """Return the lines of the table [ties] of a design file that tie the other parameters to the first one."""
        first, equal = self.members[0].name, self.values[0]
        pairs = zip(self.members[1:], self.values[1:], strict=True)
        return [f'"{n.name}" = ' + (f'"{first}"' if value == equal else f'["{first}", "keep"]') for n, value in pairs]


def groups_of(space: DesignSpace, scene: Scene) -> list[list[Group]]:
    """Return the groups of fixed parameters of a scene, in one list for each kind of parameter.

    The list of a kind, such as the damping of a support along its axis, has the group of all parameters of this kind, groups of
    those with equal magnitudes, and single parameters. Numbers that are 0 and entries of matrices are left out.
    """
    changed = (*space.free, *(each.target for each in (*space.columns, *space.ties)))
    used = set().union(*(each.entries for each in changed))
    kinds: dict[str, list[tuple[NamedNumber, float]]] = {}
    for number in numbers_of(scene).values():
        if np.ndim(number.leaf(scene)) > 1 or number.path[-1] == "g":
            continue
        for each in number.single(scene):
            value = float(each.read(scene)[0])
            if value and not each.entries & used:
                entry = "" if number.spec.each or each.entry is None else f"[{each.entry}]"
                name = number.name.removesuffix(f"[{each.entry}]")
                kinds.setdefault(re.sub(r"\[\d+\]", "", name) + entry, []).append((each, value))
    return [_groups_of_kind(found) for found in kinds.values()]


def _groups_of_kind(found: Sequence[tuple[NamedNumber, float]]) -> list[Group]:
    magnitudes = dict.fromkeys(abs(value) for _, value in found)
    equal = [[pair for pair in found if abs(pair[1]) == size] for size in magnitudes]
    groups = [found, *(each for each in equal if 1 < len(each) < len(found)), *([pair] for pair in found if len(found) > 1)]
    return [Group(*zip(*group, strict=True)) for group in groups]


def lines_to_free(space: DesignSpace, scene: Scene, wanted: Sequence[tuple[Quantity, float]]) -> list[str]:
    """Return lines of a design file that free the parameters with the largest effects on quantities; an empty list if no fixed
    parameter has an effect.

    Of each kind of parameter, one group is suggested. Comments state the effects and the directions in which the parameters
    must change.

    **Arguments**: `wanted`: each quantity with the value that a design needs.
    """
    kinds = groups_of(space, scene)
    groups = [group for of_kind in kinds for group in of_kind]
    if not groups or not wanted:
        return []
    changed = [put_numbers(scene, g.members, (1.0 + _STEP) * np.asarray(g.values)) for g in groups]
    scenes = jax.tree.map(lambda *leaves: np.stack(leaves), scene, *changed)
    now, *values = evaluate_quantities(tuple(quantity for quantity, _ in wanted), scenes)
    effects = dict(zip(groups, np.nan_to_num(100.0 * (np.asarray(values) - now) / np.abs(now)), strict=True))
    best = [_best_of_kind(of_kind, effects) for of_kind in kinds]
    shown: set[Group] = set()
    for k in range(len(wanted)):
        ranked = sorted(best, key=lambda group: -abs(effects[group][k]))[:_MAX_SHOWN_GROUPS]
        shown |= {group for group in ranked if abs(effects[group][k]) > _MIN_SHOWN_EFFECT}
    chosen = sorted(shown, key=lambda group: -np.max(np.abs(effects[group])))
    missing = [(quantity.words, np.sign(value - at)) for (quantity, value), at in zip(wanted, now, strict=True)]
    free = [line for group in chosen for line in (_comment(group, effects[group], missing), group.free_line())]
    tied = [line for group in chosen for line in group.tie_lines()]
    return [*(["[free]", *free] if free else []), *(["[ties]", *tied] if tied else [])]


def _best_of_kind(groups: Sequence[Group], effects: Mapping[Group, np.ndarray]) -> Group:
    """Return the group with the largest effect; of groups with equal effects, that with the fewest parameters.

    A machine with equal parameters is usually symmetric. The effect of one of them alone therefore counts half.
    """
    magnitudes = np.abs(groups[0].values)

    def score(group: Group) -> tuple[float, int]:
        breaks_symmetry = len(group.members) == 1 and np.count_nonzero(magnitudes == abs(group.values[0])) > 1
        return round(np.max(np.abs(effects[group])) * (0.5 if breaks_symmetry else 1.0), 2), -len(group.members)

    return max(groups, key=score)


def _comment(group: Group, effects: np.ndarray, missing: Sequence[tuple[str, float]]) -> str:
    """Return a comment with the effects, percent, of a change of a group by 1 %.

    **Arguments**: `missing`: name of each quantity, and the sign of the change that it needs.
    """
    by_direction: dict[str, list[str]] = {}
    for (words, up), effect in zip(missing, effects, strict=True):
        if abs(effect) > _MIN_SHOWN_EFFECT:
            by_direction.setdefault("more" if effect * up > 0.0 else "less", []).append(f"{words} {up * abs(effect):+.2g} %")
    together = f"{len(group.members)} by one factor, " if len(group.members) > 1 else ""
    return f"# {together}" + "; ".join(f"1 % {way}: {', '.join(texts)}" for way, texts in by_direction.items())
