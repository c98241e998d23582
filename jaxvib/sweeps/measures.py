"""Measures of a case: quantities of `optimize`, and quantities of a run."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError, quoted
from jaxvib.machine.files import suggest_name
from jaxvib.motion.analysis.points import vibration_of
from jaxvib.motion.analysis.regime import REGIMES
from jaxvib.motion.batch import BatchRun
from jaxvib.steady.measures import vibration_measures
from optimize.quantities.quantity import Quantity

_SETTLED_SPEED_SHARE = 0.01
"""Difference between a mean load speed and the final one, relative to the rotor speed, below which loads are settled."""


@dataclass(frozen=True)
class RunMeasure:
    """Quantity that is computed from a run, see `BatchRun`.

    **Arguments**: `name`; `unit`, "" for none; `function` of a `BatchRun`, or the name of its attribute, that gives a scalar or
    an array with an additional dimension of the name `axis` ("coordinate", "load"); `meanings`: for a label, the meanings of
    its values 0, 1, ...
    """

    name: str
    unit: str
    function: str | Callable[[BatchRun], Array]
    axis: str = ""
    meanings: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Description of the measure."""
        return self.name.replace("_", " ").removeprefix("run.")

    def read(self, run: BatchRun) -> Array:
        """Return the value of a run."""
        return operator.attrgetter(self.function)(run) if isinstance(self.function, str) else self.function(run)


Measure: TypeAlias = Quantity | RunMeasure
"""Type of a measure of a study."""


def _regime(run: BatchRun) -> Array:
    (which,) = jax.tree.leaves(run.regime.name)
    return which


def _settling(run: BatchRun) -> Array:
    """Return the end, s, of the last part of the run in which the speed of a load differs from its final speed."""
    last, rotor = run.measured.load_speed, run.window.rotor_speed[-1]
    away = jnp.any(jnp.abs(run.part_speed - last[None]) > _SETTLED_SPEED_SHARE * jnp.abs(rotor), axis=1)
    late = jnp.max(jnp.where(away, jnp.arange(1, away.shape[0] + 1), 0)) * run.part_length
    return jnp.where(run.regime.change < _SETTLED_SPEED_SHARE, late, run.window.time[-1])


def _of_vibration(name: str, unit: str, field: str, axis: str = "") -> RunMeasure:
    """Return a measure with the name of a `field` of `VibrationMeasures`."""

    def read(run: BatchRun) -> Array:
        motion = vibration_of(run.scene, run.window, run.measured)
        value = getattr(vibration_measures(run.scene, motion), field)
        if value is None:
            raise InputError("measure", f"is {name}, which needs a body in a plane, not a {quoted(run.scene.machine.kind)}")
        return value

    return RunMeasure(name, unit, read, axis)


def _support_load(run: BatchRun) -> Array:
    return _STATIC.read(run) + _DYNAMIC.read(run)


_STATIC = _of_vibration("", "N", "static_load", "support")
_DYNAMIC = _of_vibration("", "N", "dynamic_load", "support")


RUN_MEASURES = {
    measure.name: measure
    for measure in (
        RunMeasure("run.regime", "", _regime, meanings=REGIMES),
        RunMeasure("run.mode", "", "regime.mode"),
        RunMeasure("run.load_speed", "rad/s", "measured.omega"),
        RunMeasure("run.amplitude", "m or rad", "measured.amplitude", axis="coordinate"),
        RunMeasure("run.foundation_force", "N", "measured.foundation_force"),
        RunMeasure("run.ripple", "rad/s", "regime.ripple"),
        RunMeasure("run.rotor_speed", "rad/s", "regime.rotor_speed"),
        RunMeasure("run.drift", "", "measured.drift"),
        RunMeasure("run.settling_time", "s", _settling),
        _of_vibration("run.stroke", "m", "stroke", "translation"),
        _of_vibration("run.acceleration", "", "acceleration", "translation"),
        _of_vibration("run.velocity", "m/s", "velocity", "translation"),
        _of_vibration("run.transmissibility", "", "transmissibility"),
        _of_vibration("run.shaft_torque", "N m", "torque", "exciter"),
        _of_vibration("run.shaft_power", "W", "power", "exciter"),
        RunMeasure("run.support_load", "N", _support_load, "support"),
        _of_vibration("run.throw_number", "", "throw_number"),
        _of_vibration("run.conveying_speed", "m/s", "conveying_speed"),
    )
}
"""Measures of a run by name: regime (see `regime`) and jam mode (0: not jammed), speeds of loads and rotor, amplitudes and
foundation force (zero to peak), ripple, drift (see `AbstractMeasured`), and settling time. The settling time is the time, with
a resolution of 1/64 of the run, after which each load speed differs from its final value by less than 1 % of the rotor
speed. The measures from stroke to conveying speed are those of `VibrationMeasures`, for the centre of mass as the point. The
support load is the sum of the static and the vertical dynamic load."""


def measure_of(given: Measure | str, field: str) -> Measure:
    """Return a measure, looked up by name if it is a string. **Raises** `InputError` for other values."""
    if isinstance(given, (Quantity, RunMeasure)):
        return given
    if isinstance(given, str) and given in RUN_MEASURES:
        return RUN_MEASURES[given]
    advice = suggest_name(str(given), list(RUN_MEASURES))
    raise InputError(
        field, f"is {quoted(given)}; give a quantity of optimize, such as jam_frequency(mode=3), or a name; {advice}"
    )
