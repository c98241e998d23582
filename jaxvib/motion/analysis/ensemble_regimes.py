"""Regimes of the runs of an ensemble: exciters that turn at one speed, their phases, and the resonances that catch them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, speed_text
from jaxvib.equations.linear import estimated_frequencies
from jaxvib.equations.state import State
from jaxvib.equations.torque_balance import mass_owners
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import mass_names
from jaxvib.motion.analysis.caught import catching_resonance, has_no_resonance
from jaxvib.motion.analysis.measure import turning_angles, turning_directions
from jaxvib.results.estimate import wilson
from jaxvib.results.fields import in_unit, names_along
from jaxvib.results.readable import Readable
from jaxvib.results.result import Result
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.phases import degrees
from jaxvib.steady.outcome import require_index

MAX_RELATIVE_ROTATION = 0.5
"""Largest difference, rad, between the angles through which masses of one speed turn in the last quarter of a run. The value
lies between that of a small swing about constant phases and that of a slow drift of the phases."""

_PHASE_GAP = np.pi / 4.0
"""Smallest gap, rad, between the phases of two regimes. It lies between the scatter of the phases of one regime and the
distance of two regimes, which is typically half a turn."""


class RotatingMasses(Readable):
    """Motion of each rotating mass at the end of the runs: of each load, or of the rotor of an exciter without loads.

    **Attributes** (mass,), in the order of the exciters

    - `rotation`, rad: angle through which the mass turns in the last quarter of the run, in its direction
    - `phase`, rad: its angle at the end in its direction, minus that of the first mass, from -pi to pi
    - `resonance`: number, from 1, of the resonance that catches the mass, see `catching_resonance`; 0 if it passes all
    - `names`: "2" for the rotor of exciter 2, "2.1" for its first load
    - `equal`: the same number for all loads of an exciter that have equal parameters, different numbers for other masses
    """

    rotation: Array = eqx.field(metadata=in_unit("rad", "mass"))
    phase: Array = eqx.field(metadata=in_unit("rad", "mass"))
    resonance: Array = eqx.field(metadata=in_unit("", "mass"))
    names: tuple[str, ...] = eqx.field(static=True, metadata=names_along("mass"))
    equal: tuple[int, ...] = eqx.field(static=True)


@cached
def rotating_masses(scenes: Scene, states: State, mean_speed: Array, end: Array, length: Array) -> RotatingMasses:
    """Return the motions of the masses of runs from `scenes` and final `states` with a leading axis over the runs, and
    `mean_speed` (runs, mass), rad/s, over the last part of the runs, with its `length` and `end`, s."""
    directions, owners = jnp.asarray(turning_directions(scenes)), mass_owners(scenes).tolist()

    def of_run(scene: Scene, state: State, speed: Array) -> RotatingMasses:
        angles, _ = turning_angles(scene, lambda: end[None], jax.tree.map(lambda leaf: leaf[None], state))
        relative, turned = directions * angles[0] - directions[0] * angles[0, 0], directions * speed
        resonances = jax.lax.stop_gradient(estimated_frequencies(scene))
        exciters = [scene.exciters[owner] for owner in owners]
        numbers = [
            0 if each.loads is None and has_no_resonance(each) else catching_resonance(own, each.drive.speed, resonances)
            for each, own in zip(exciters, jnp.unstack(jax.lax.stop_gradient(turned)), strict=True)
        ]
        has_equal_loads = [e.loads is not None and all(np.ndim(x) == 0 for x in jax.tree.leaves(e.loads)) for e in exciters]
        equal = [owners.index(owner) if has_equal_loads[k] else k for k, owner in enumerate(owners)]
        phase = jnp.arctan2(jnp.sin(relative), jnp.cos(relative))
        return RotatingMasses(turned * length, phase, jnp.stack(numbers), mass_names(scene), tuple(equal))

    return jax.vmap(of_run)(scenes, states, mean_speed)


class EnsembleRegimesStatus(eqx.Enumeration):
    """Outcomes of the naming of regimes. The value of each member is the message shown to the user."""

    named = "each run that stayed finite has a regime"
    none = "no run stayed finite"


class EnsembleRegimes(Result):
    """Regimes in which the runs of an `Ensemble` of machines with several exciters end, the most frequent first.

    Returned by `Ensemble.regimes`. A rotating mass is a load, or the rotor of an exciter without loads. Two runs have the same
    regime if the same masses turn at one speed, if the same resonances catch the same masses, and if the phase of each mass
    lies in the same range. Two ranges of a phase are separated by a gap of at least 45 degrees in which no run has its phase.
    Runs that differ by an exchange of equal loads of one exciter have the same regime.

    **Attributes** (n regimes, B runs)

    - `status`: an `EnsembleRegimesStatus`
    - `regime_of_run` (B,): number of the regime of each run, from 1; 0 for a run that did not stay finite
    - `runs` (n,): number of runs; `share` p (n,) of all runs; `standard_error` (n,) of the share, sqrt(p (1 - p)/B); `low` and
      `high` (n,): Wilson's confidence interval of 95 %
    - `group` (n, mass): number of the group of masses that turn at one speed, from 0; -1 for a mass that makes less than one
      turn in the last quarter of the run
    - `speed` (n, mass), rad/s: mean over the runs, in the direction of rotation; `speed_low` and `speed_high`: its range
    - `phase` (n, mass), rad: mean over the runs, relative to the first mass of the group, as in `synchronous_regimes`, but at
      the end of the run; `phase_low` and `phase_high`: its range
    - `resonance` (n, mass): number, from 1, of the lowest resonance that the mass does not pass, as in `run_up`; 0 if it passes
      all resonances below 0.95 of the working speed of its drive
    - `masses`: name of each mass: "2" for exciter 2, "2.1" for its first load
    """

    status: EnsembleRegimesStatus
    regime_of_run: np.ndarray = eqx.field(metadata=in_unit("", "run"))
    runs: np.ndarray = eqx.field(metadata=in_unit("", "regime"))
    share: np.ndarray = eqx.field(metadata=in_unit("", "regime"))
    standard_error: np.ndarray = eqx.field(metadata=in_unit("", "regime"))
    low: np.ndarray = eqx.field(metadata=in_unit("", "regime"))
    high: np.ndarray = eqx.field(metadata=in_unit("", "regime"))
    group: np.ndarray = eqx.field(metadata=in_unit("", "regime", "mass"))
    speed: np.ndarray = eqx.field(metadata=in_unit("rad/s", "regime", "mass"))
    speed_low: np.ndarray = eqx.field(metadata=in_unit("rad/s", "regime", "mass"))
    speed_high: np.ndarray = eqx.field(metadata=in_unit("rad/s", "regime", "mass"))
    phase: np.ndarray = eqx.field(metadata=in_unit("rad", "regime", "mass"))
    phase_low: np.ndarray = eqx.field(metadata=in_unit("rad", "regime", "mass"))
    phase_high: np.ndarray = eqx.field(metadata=in_unit("rad", "regime", "mass"))
    resonance: np.ndarray = eqx.field(metadata=in_unit("", "regime", "mass"))
    masses: tuple[str, ...] = eqx.field(static=True, metadata=names_along("mass"))

    @validated
    def name(self, index: int) -> str:
        """Return the name of the regime with an `index`, counted from 0: its groups of masses, with phases in degrees.

        **Raises** `InputError` if there are fewer regimes.
        """
        require_index(index, self.runs.size, "regimes")
        group, parts = self.group[index], []
        for number in dict.fromkeys(group.tolist()):
            members = np.flatnonzero(group == number)
            named = _masses_text([self.masses[k] for k in members])
            if number < 0:
                parts.append(f"{named}: not turning")
                continue
            low, high = np.min(self.speed_low[index, members]), np.max(self.speed_high[index, members])
            text = f"{named}: {speed_text([low] if np.isclose(low, high, rtol=1e-3) else [low, high], 4, ' .. ')}"
            if caught := sorted({int(k) for k in self.resonance[index, members]} - {0}):
                text += f", caught by resonance {' and '.join(map(str, caught))}"
            if len(members) > 1:
                text += f", phases {', '.join(self._phase_text(index, k) for k in members.tolist())} deg"
            parts.append(text)
        return "; ".join(parts)

    def _phase_text(self, index: int, mass: int) -> str:
        mean, low, high = (float(values[index, mass]) for values in (self.phase, self.phase_low, self.phase_high))
        middle = f"{round(degrees(mean)) + 0}"
        is_wide = np.rad2deg(high - low) > 2.0
        return f"{middle} ({round(np.rad2deg(low)) + 0} .. {round(np.rad2deg(high)) + 0})" if is_wide else middle

    def summary(self) -> str:
        """Return a line of text for each regime: its share of the runs with its standard error, and its name."""
        if not self.runs.size:
            return self.message
        lines = []
        for k, count in enumerate(self.runs):
            share = f"{100.0 * self.share[k]:.3g} % (standard error {100.0 * self.standard_error[k]:.2g} %)"
            lines.append(f"{count} of {self.regime_of_run.size} runs, {share}: {self.name(k)}")
        failed = int(np.sum(self.regime_of_run == 0))
        return "\n".join(lines + [f"{failed} of {self.regime_of_run.size} runs did not stay finite"] * bool(failed))

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the share of each regime with its confidence interval of 95 %."""
        from jaxvib.draw.results import shares_chart  # slow import

        names = [f"regime {k + 1}" for k in range(self.runs.size)]
        return shares_chart(100.0 * self.share, 100.0 * self.low, 100.0 * self.high, names=names, ax=ax)


def _masses_text(names: Sequence[str]) -> str:
    """Return names of masses as text.

    >>> _masses_text(["1", "2"]), _masses_text(["2.1"])
    ('exciters 1, 2', 'load 2.1')
    """
    kinds = []
    for kind, own in (("exciter", [n for n in names if "." not in n]), ("load", [n for n in names if "." in n])):
        if own:
            kinds.append(f"{kind}{'s' * (len(own) > 1)} {', '.join(own)}")
    return " and ".join(kinds)


def regimes_of_runs(masses: RotatingMasses, load_speed: np.ndarray, finite: np.ndarray) -> EnsembleRegimes:
    """Return the regimes of runs from their `masses`, `load_speed` (runs, mass), rad/s, and `finite` (runs,), False for runs
    that failed."""
    used, runs = np.flatnonzero(finite), np.size(finite)
    values = [np.asarray(each)[used] for each in (masses.rotation, masses.phase, masses.resonance, load_speed)]
    order = _order_of_equal(values[0], values[1], masses.equal)
    rotation, phase, resonance, speed = (np.take_along_axis(each, order, 1) for each in values)
    speed, group = np.sign(rotation) * np.abs(speed), _group_numbers(rotation)
    first = np.argmax(group[:, :, None] == group[:, None], axis=2)
    phase = _wrap_angle(phase - np.take_along_axis(phase, first, 1))
    number = _regime_numbers(np.concatenate([group, resonance], axis=1), phase)
    counts = np.bincount(number)
    by_share = np.argsort(-counts, kind="stable")
    regime = np.zeros(runs, int)
    regime[used] = 1 + np.argsort(by_share)[number]
    rows = [np.flatnonzero(number == k) for k in by_share]

    def of_regimes(value: Callable[[np.ndarray], np.ndarray], kind: type = float) -> np.ndarray:
        return np.array([value(own) for own in rows], kind).reshape(len(rows), len(masses.names))

    counts = counts[by_share]
    share, (low, high) = counts / runs, wilson(counts, np.full(counts.shape, runs))
    mean = of_regimes(lambda own: np.angle(np.mean(np.exp(1j * phase[own]), axis=0)))
    around = [_wrap_angle(phase[own] - mean[k]) for k, own in enumerate(rows)]
    return EnsembleRegimes(
        status=EnsembleRegimesStatus.named if rows else EnsembleRegimesStatus.none,
        regime_of_run=regime,
        runs=counts,
        share=share,
        standard_error=np.sqrt(share * (1.0 - share) / runs),
        low=low,
        high=high,
        group=of_regimes(lambda own: group[own[0]], int),
        speed=of_regimes(lambda own: np.mean(speed[own], axis=0)),
        speed_low=of_regimes(lambda own: np.min(speed[own], axis=0)),
        speed_high=of_regimes(lambda own: np.max(speed[own], axis=0)),
        phase=mean,
        phase_low=mean + np.array([np.min(each, axis=0) for each in around]).reshape(mean.shape),
        phase_high=mean + np.array([np.max(each, axis=0) for each in around]).reshape(mean.shape),
        resonance=of_regimes(lambda own: resonance[own[0]], int),
        masses=masses.names,
    )


def _wrap_angle(angle: np.ndarray) -> np.ndarray:
    """Return angles, rad, from -pi to pi."""
    return np.arctan2(np.sin(angle), np.cos(angle))


def _group_numbers(rotation: np.ndarray) -> np.ndarray:
    """Return the number, from 0, of the group of masses of equal `rotation` (runs, mass), rad, to which each mass belongs, and
    -1 for masses that make less than one turn. Groups are numbered in the order of their first masses."""
    order = np.argsort(rotation, axis=1)
    group, start = np.zeros(rotation.shape, int), np.full(rotation.shape[0], -np.inf)
    count, rows = np.full(rotation.shape[0], -1), np.arange(rotation.shape[0])
    for place in order.T:
        turned = rotation[rows, place]
        begins = turned - start >= MAX_RELATIVE_ROTATION
        start, count = np.where(begins, turned, start), count + begins
        group[rows, place] = count
    group = np.argmax(group[:, :, None] == group[:, None], axis=2)  # the first mass of each group
    group = np.where(np.abs(rotation) < 2.0 * np.pi, -1, group)
    is_first = group == np.arange(group.shape[1])
    return np.where(group < 0, -1, np.take_along_axis(np.cumsum(is_first, axis=1) - 1, np.maximum(group, 0), 1))


def _order_of_equal(rotation: np.ndarray, phase: np.ndarray, equal: Sequence[int]) -> np.ndarray:
    """Return the order (runs, mass) of the masses in which those that may be exchanged are sorted, the fastest first; masses of
    one speed by phases, from the phase that follows the largest gap between two phases."""
    order = np.tile(np.arange(len(equal)), (phase.shape[0], 1))
    for number in set(equal):
        own = np.flatnonzero(np.asarray(equal) == number)
        if own.size == 1:
            continue
        ascending = np.sort(np.mod(phase[:, own], 2.0 * np.pi), axis=1)
        gaps = np.diff(ascending, axis=1, prepend=ascending[:, -1:] - 2.0 * np.pi)
        start = np.take_along_axis(ascending, np.argmax(gaps, axis=1)[:, None], 1)
        after = np.mod(phase[:, own] - start + 1e-6, 2.0 * np.pi)
        group = _group_numbers(rotation[:, own])
        first = np.argmax(group[:, :, None] == group[:, None], axis=2)
        fastest = np.where(group < 0, np.inf, -np.take_along_axis(rotation[:, own], first, 1))
        order[:, own] = own[np.lexsort((after, fastest), axis=1)]
    return order


def _regime_numbers(pattern: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return numbers (runs,), from 0, that are equal for runs with equal rows of `pattern` (runs, n) and with `phase`
    (runs, mass) in the same ranges, which gaps of at least `_PHASE_GAP` separate."""
    _, number = np.unique(pattern, axis=0, return_inverse=True)
    keys = np.column_stack([number.ravel(), np.zeros(phase.shape, int)])
    for each in np.unique(keys[:, 0]):
        own = np.flatnonzero(keys[:, 0] == each)
        keys[own, 1:] = np.stack([_range_numbers(column) for column in phase[own].T], axis=1)
    return np.unique(keys, axis=0, return_inverse=True)[1].ravel()


def _range_numbers(angle: np.ndarray) -> np.ndarray:
    """Return the number, from 0, of the range of angles (n,), rad, on the circle to which each belongs.

    >>> _range_numbers(np.array([3.1, -3.1, 0.1, -0.1])).tolist()
    [1, 1, 0, 0]
    """
    angle = np.mod(angle, 2.0 * np.pi)
    order = np.argsort(angle)
    gaps = np.diff(angle[order], prepend=angle[order[-1:]] - 2.0 * np.pi)
    numbers = np.empty(angle.size, int)
    numbers[order] = np.cumsum(gaps >= _PHASE_GAP)
    # Without a gap at angle 0, the last range continues in the first one.
    return numbers % max(int(np.max(numbers, initial=0)), 1)
