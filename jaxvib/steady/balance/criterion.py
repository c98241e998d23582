"""Empirical criterion of auto-balancing: rotor speeds at which loads balance the rotor, and at which they gather."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, SpeedUnit, speed_unit
from jaxvib.equations.linear import require_one_point, require_terms, rotating_direction, turning_loads
from jaxvib.errors import InputError
from jaxvib.machine.effects.base import terms_of
from jaxvib.machine.effects.terms import (
    ContactFriction,
    DrillingSpinRelease,
    GravityField,
    LoadInteraction,
    RotorImbalance,
    SlipRelease,
    SupportForce,
)
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.results.fields import in_unit, part
from jaxvib.results.result import Result
from jaxvib.runtime.programs import cached
from jaxvib.steady.balance.speeds import CharacteristicSpeeds, CriterionStatus, characteristic_speeds, port_receptance


class Criterion(Result):
    """Result of the criterion for one machine with its loads.

    Returned by `criterion`.

    **Attributes**

    - `status`: a `CriterionStatus`
    - `speeds`: the `CharacteristicSpeeds`
    - `balancing` (nd, 2): intervals of rotor speed in which f < 0 and auto-balancing is stable, with the machine's damping
    - `gathering` (nd, 2): intervals in which f > 0 and loads gather, with the machine's damping
    - `undamped_balancing` and `undamped_gathering` (nd, 2): the same without damping

    Intervals are rows [from, to] in rad/s. An end `inf` means that the interval has no upper end; a row of NaN means that
    there is no interval.
    """

    status: CriterionStatus
    speeds: CharacteristicSpeeds = eqx.field(metadata=part())
    balancing: Array = eqx.field(metadata=in_unit("rad/s", "interval", "end"))
    gathering: Array = eqx.field(metadata=in_unit("rad/s", "interval", "end"))
    undamped_balancing: Array = eqx.field(metadata=in_unit("rad/s", "interval", "end"))
    undamped_gathering: Array = eqx.field(metadata=in_unit("rad/s", "interval", "end"))

    @property
    def resonances(self) -> Array:
        """Resonances without damping, (nd,) rad/s."""
        return self.speeds.resonances

    @property
    def additional(self) -> Array:
        """Additional speeds without damping, (nd - 1,) rad/s."""
        return self.speeds.additional

    @validated
    def balances(self, speed: Array) -> Array:
        """Return True if the criterion predicts stable auto-balancing at a rotor `speed` (any shape, rad/s)."""
        w = jnp.asarray(speed)
        return jnp.any(jnp.stack([(start < w) & (w < end) for start, end in self.balancing]), axis=0)

    def summary(self) -> str:
        """Return the characteristic speeds and intervals as a table in text."""

        def intervals_text(intervals: list[list[float | None]]) -> str:
            ranges = (f"{scale * (a or 0.0):.6g} .. {'infinity' if b is None else f'{scale * b:.6g}'}" for a, b in intervals)
            return f"{', '.join(ranges)} {unit}" if intervals else "no rotor speed"

        if self.status_name == "not_finite":
            return self.message
        table, (unit, scale) = criterion_table(self), speed_unit()
        lines = [f"{table['status']}", self.speeds.summary()]
        lines += [f"{name + ' at':14s}{intervals_text(table[name])}" for name in ("balancing", "gathering")]
        return "\n".join(lines)

    @validated
    def plot(self, *, unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot the characteristic speeds with damping, and the intervals between them, in `unit`."""
        from jaxvib.draw.results import speeds_chart  # slow import

        rows = [("resonances", self.speeds.damped_resonances), ("additional", self.speeds.damped_additional)]
        spans = [("balancing", self.balancing), ("gathering", self.gathering)]
        drawn = ([(label, np.asarray(values)) for label, values in group] for group in (rows, spans))
        return speeds_chart(*drawn, unit=unit, ax=ax)


def criterion_functional(scene: Scene, omega: Array) -> Array:
    """Return the functional of the criterion at speed `omega` (scalar, rad/s): mean of S . r over one turn, kg m^2.

        f(S, w) = (S^2 w^2 / 2) Re(e^H A(w) e)

    S is the unbalance of all loads at one point, r the displacement of the exciter's axis that it causes, A the receptance of
    the mount and e the rotating direction of the force (`rotating_direction`). For a mount with two directions e^H A e is the
    trace of A plus a term of the gyroscopic coupling. If f < 0, the displacement of the axis is on average opposite to the
    loads, and they spread until they balance; if f > 0, they gather. The paper states this for two or more loads, as an
    approximation; `balanced_states(scene).stability()` has the exact result.

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=49.0, stiffness=4e4, damping=30.0)
    >>> scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> [bool(criterion_functional(scene, w) < 0) for w in (28.0, 29.0)]     # the resonance is at 28.28 rad/s
    [False, True]

    Source: Filimonikhin et al. 2022, equations (1)-(3), (15), (28).
    """
    direction = rotating_direction(scene.mounting)
    unbalance = turning_loads(scene, at_one_point=True).unbalance()
    receptance = jnp.sum(direction.conj() * (port_receptance(scene, omega) @ direction)).real
    return unbalance**2 * omega**2 / 2.0 * receptance


CRITERION_TERMS = (
    GravityField,
    LoadInteraction,
    RotorImbalance,
    ContactFriction,
    DrillingSpinRelease,
    SlipRelease,
    SupportForce,
)
"""Terms that the criterion allows. A term with a separate force on each load, such as that of a potential, is not allowed."""


@validated
def criterion(scene: Scene) -> Criterion:
    """Return the ranges of rotor speed in which loads balance a machine, and those in which they gather.

        f(S, w) = (S^2 w^2 / 2) Re(e^H A(w) e),    f < 0: balancing,    f > 0: gathering

    f is the mean, over a turn at the rotor speed w, of the product of two vectors: the unbalance of all loads at one point, of
    the size S, and the displacement of the exciter's axis that this unbalance causes. A is the receptance of the mount. e is
    (1, -i) for a mount that moves in two directions, and -i for a mount that moves up only. f changes its sign only at the
    characteristic speeds: from + to - at a resonance, and from - to + at an additional speed. These speeds are therefore the
    ends of the intervals.

    **Arguments**: `scene` with at least two loads; typical: loads of 0.1 % to 1 % of the machine's mass. The share of correct
    predictions for random machines was 0.99 for loads of 0.1 %, and 0.55 for 10 %.

    **Returns** `Criterion`. Its speeds have exact derivatives with respect to every parameter of the scene, forward and
    reverse, and `vmap` over scenes evaluates many machines.

    **Raises** `InputError` for

    - a single load, and loads at different stations
    - effects whose potential exerts a torque on each single load (`Gravity`), or that damp the machine at rest
      (`FrictionSupport`)
    - a mount that moves with no coordinate
    - a spring that is so much stiffer than the others that a resonance is lost in rounding errors
    - a gyroscopic machine that has a motion without a spring

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("criterion", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3,
    ...                         link_damping=0.01, rho=1.0, eps=1e-3, beta=1.0, speed=3.0, count=2)
    >>> [[round(float(w), 4) for w in row] for row in jv.criterion(form.scene()).balancing]
    [[0.3334, 0.7467], [0.998, inf]]

    Source: Filimonikhin et al. 2022, sections 5.1-5.3, for any carrier.
    """
    scene = validate_scene(scene)
    require_one_point(scene.mounting)
    if scene.loads.count < 2:
        raise InputError("loads.count", "is 1; the criterion is about the gathering of loads and needs 2 or more")
    require_terms(scene.all_effects, CRITERION_TERMS, "acts|act on each load separately, which the criterion excludes")
    for effect in scene.all_effects:
        if any(term.damping is not None for term in terms_of([effect], SupportForce)):
            problem = "holds a machine without vibration, which the criterion excludes; leave it out here, or simulate"
            raise InputError(f"effects.{effect.kind}", problem)
    return _criterion_at_speeds(characteristic_speeds(scene))


@cached
def _criterion_at_speeds(speeds: CharacteristicSpeeds) -> Criterion:
    return Criterion(
        status=speeds.status,
        speeds=speeds,
        balancing=_balancing_intervals(speeds.damped_resonances, speeds.damped_additional),
        gathering=_gathering_intervals(speeds.damped_resonances, speeds.damped_additional),
        undamped_balancing=_balancing_intervals(speeds.resonances, speeds.additional),
        undamped_gathering=_gathering_intervals(speeds.resonances, speeds.additional),
    )


def _balancing_intervals(resonances: Array, additional: Array) -> Array:
    ends = jnp.append(jnp.where(jnp.isnan(additional), jnp.inf, additional), jnp.inf)
    return jnp.stack([resonances, jnp.where(jnp.isnan(resonances), jnp.nan, ends)], axis=1)


def _gathering_intervals(resonances: Array, additional: Array) -> Array:
    starts = jnp.concatenate([0.0 * resonances[:1], additional])  # NaN if the first resonance is unknown
    ends = jnp.where(jnp.isnan(resonances), jnp.inf, resonances)
    return jnp.stack([starts, jnp.where(jnp.isnan(starts), jnp.nan, ends)], axis=1)


def criterion_table(result: Criterion) -> dict[str, Any]:
    """Return the result of the criterion as plain lists and numbers for JSON, with speeds in rad/s.

    `status` is a sentence; the other entries are the fields of `Criterion` and its `speeds`. Intervals are [from, to], without
    an end if `to` is None. Intervals that touch are joined; empty ones are omitted.

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=49.0, stiffness=1e6, damping=30.0)
    >>> scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> table = criterion_table(jv.criterion(scene))
    >>> [[round(a, 3), b] for a, b in table["balancing"]], [[a, round(b, 3)] for a, b in table["gathering"]]
    ([[141.421, None]], [[0.0, 141.421]])
    """
    speeds = result.speeds
    lists = {
        name: [float(w) for w in np.asarray(getattr(speeds, name)) if not np.isnan(w)]
        for name in ("resonances", "additional", "damped_resonances", "damped_additional")
    }
    intervals = {
        name: _join_intervals(np.asarray(getattr(result, name)))
        for name in ("balancing", "gathering", "undamped_balancing", "undamped_gathering")
    }
    return {"status": result.message, **lists, **intervals}


def _join_intervals(rows: np.ndarray) -> list[list[float | None]]:
    """Join rows [from, to] that touch and omit empty ones, within rounding."""
    joined: list[list[float]] = []
    close = np.sqrt(np.finfo(rows.dtype).eps)
    for start, end in rows[~np.isnan(rows[:, 0])].tolist():
        if end - start <= close * start:
            continue
        if joined and start - joined[-1][1] <= close * start:
            joined[-1][1] = end
        else:
            joined.append([start, end])
    return [[start, None if np.isinf(end) else end] for start, end in joined]
