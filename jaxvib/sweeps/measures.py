"""Measures of a case: quantities of `optimize`, and quantities of a run."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError, quoted, suggest_name
from jaxvib.motion.analysis.measure import mean_speeds, turning_angles, turning_directions
from jaxvib.motion.analysis.points import has_vibration, vibration_of, vibration_share
from jaxvib.motion.analysis.regime import REGIMES
from jaxvib.motion.batch import BatchRun
from jaxvib.steady.measures import vibration_measures
from optimize.quantities.quantity import Quantity

_SETTLED_SPEED_SHARE = 0.01
"""A load or rotor has settled if its mean speed in a part of the run differs from its final speed
by less than this share of the rotor speed."""


@dataclass(frozen=True)
class RunMeasure:
    """Quantity that is computed from a run, see `BatchRun`.

    **Arguments**: `name`; `unit`, "" for none; `function` of a `BatchRun` that returns a scalar or an array (n,), or the name
    of an attribute of `BatchRun`; `axis`: name of the dimension of such an array ("coordinate", "load"), "" for a scalar;
    `meanings`: for a label, the meanings of its values 0, 1, ...; `of_whole_run`: True if the function reads `BatchRun.peaks`;
    `text`: description, default: the name.
    """

    name: str
    unit: str
    function: str | Callable[[BatchRun], Array]
    axis: str = ""
    meanings: tuple[str, ...] = ()
    of_whole_run: bool = False
    text: str = ""

    @property
    def words(self) -> str:
        """Description of the measure."""
        return self.text or self.name.replace("_", " ").removeprefix("run.")

    def read(self, run: BatchRun) -> Array:
        """Return the value of a run."""
        return operator.attrgetter(self.function)(run) if isinstance(self.function, str) else self.function(run)


Measure: TypeAlias = Quantity | RunMeasure
"""Type of a measure of a study."""


def _regime_measure(name: str, unit: str, field: str, meanings: tuple[str, ...] = ()) -> RunMeasure:
    """Return a measure with the name of a `field` of `Regime`."""

    def read(run: BatchRun) -> Array:
        if run.regime is None:
            problem = f"is {name}, which needs a scene with one anticlockwise exciter that has loads and no unbalance"
            raise InputError(
                "measure", f"{problem}; for other scenes use run.load_speed, run.relative_rotation or run.shaft_torque"
            )
        (value,) = jax.tree.leaves(getattr(run.regime, field))
        return value

    return RunMeasure(name, unit, read, meanings=meanings)


def _settling_time(run: BatchRun) -> Array:
    """Return the end, s, of the last part of the run in which the speed of a load or rotor differs from its final speed by more
    than 1 %.

    If a speed still changes within the window, the end of the run is returned. For a scene that is not plain
    (`Scene.is_plain`), differences are relative to the largest speed in the window, otherwise to the rotor speed.
    """
    last = run.measured.load_speed
    if run.regime is None:
        end, half = run.window.time.shape[0] - 1, run.window.time.shape[0] // 2
        motion = turning_angles(run.scene, lambda: run.window.time, run.window.state)
        early, late = mean_speeds(run.window.time, *motion, first=(0, half), last=(half - 1, end))
        top = jnp.max(jnp.abs(last))
        change = jnp.max(jnp.abs(late - early)) / top
    else:
        top, change = jnp.abs(run.window.rotor_speed[-1]), run.regime.change
    is_away = jnp.any(jnp.abs(run.part_speed - last[None]) > _SETTLED_SPEED_SHARE * top, axis=1)
    at = jnp.max(jnp.where(is_away, jnp.arange(1, is_away.shape[0] + 1), 0)) * run.part_length
    return jnp.where(change < _SETTLED_SPEED_SHARE, at, run.window.time[-1])


def _relative_rotation(run: BatchRun) -> Array:
    """Return the largest difference, rad, between the angles through which two loads or rotors turn in the window."""
    angles, _ = turning_angles(run.scene, lambda: run.window.time, run.window.state)
    turned = turning_directions(run.scene) * (angles[-1] - angles[0])
    return jnp.max(turned) - jnp.min(turned)


_MEAN_FIELDS = ("torque", "power", "static_load")
"""Fields of `VibrationMeasures` that are mean values, and exist for motions without a vibration."""


def _vibration_measure(name: str, unit: str, field: str, axis: str = "", text: str = "") -> RunMeasure:
    """Return a measure with the name of a `field` of `VibrationMeasures`."""

    def read(run: BatchRun) -> Array:
        motion = vibration_of(run.scene, run.window, run.measured)
        value = getattr(vibration_measures(run.scene, motion), field)
        if value is None:
            raise InputError("measure", f"is {name}, which needs a body in a plane, not a {quoted(run.scene.machine.kind)}")
        if field in _MEAN_FIELDS:
            return value
        share = vibration_share(run.scene.machine, run.window.time, run.measured, motion.displacement)
        return jnp.where(has_vibration(share), value, jnp.nan)

    return RunMeasure(name, unit, read, axis, text=text)


def _support_load(run: BatchRun) -> Array:
    return _STATIC.read(run) + _DYNAMIC.read(run)


_STATIC = _vibration_measure("", "N", "static_load", "support")
_DYNAMIC = _vibration_measure("", "N", "dynamic_load", "support")


RUN_MEASURES = {
    measure.name: measure
    for measure in (
        _regime_measure("run.regime", "", "name", REGIMES),
        _regime_measure("run.mode", "", "mode"),
        RunMeasure("run.load_speed", "rad/s", "measured.omega"),
        RunMeasure("run.amplitude", "m or rad", "measured.amplitude", axis="coordinate"),
        RunMeasure("run.foundation_force", "N", "measured.foundation_force"),
        _regime_measure("run.ripple", "rad/s", "ripple"),
        _regime_measure("run.rotor_speed", "rad/s", "rotor_speed"),
        RunMeasure("run.relative_rotation", "rad", _relative_rotation),
        RunMeasure("run.drift", "", "measured.drift"),
        RunMeasure("run.peak_displacement", "m or rad", "peaks.displacement", axis="coordinate", of_whole_run=True),
        RunMeasure("run.peak_force", "N", "peaks.force", of_whole_run=True),
        RunMeasure("run.settling_time", "s", _settling_time),
        _vibration_measure("run.stroke", "m", "stroke", "translation"),
        _vibration_measure("run.acceleration", "", "acceleration", "translation", "acceleration in g"),
        _vibration_measure("run.velocity", "m/s", "velocity", "translation"),
        _vibration_measure("run.transmissibility", "", "transmissibility"),
        _vibration_measure("run.shaft_torque", "N m", "torque", "exciter"),
        _vibration_measure("run.shaft_power", "W", "power", "exciter"),
        RunMeasure("run.support_load", "N", _support_load, "support"),
        _vibration_measure("run.throw_number", "", "throw_number"),
        _vibration_measure("run.conveying_speed", "m/s", "conveying_speed"),
    )
}
"""Measures of a run by name.

- regime (see `regime`), jam mode (0: not jammed), ripple and rotor speed. They need a scene with one exciter that
  turns anticlockwise and has loads and no unbalance
- mean load speed, amplitudes and foundation force (zero to peak), drift (see `AbstractMeasured`)
- peak displacement and peak force: the largest displacement of each coordinate from static equilibrium, and the largest
  magnitude of the foundation force. Both are those of the whole run (start, passage through resonances, stop), as in the
  quantity `peak_force`
- relative rotation: the largest difference between the angles through which two loads, or rotors without loads, turn in the
  measuring window
- settling time: the time after which each load speed differs from its final value by less than 1 % of the rotor speed. For
  a scene that is not plain (see `Scene.is_plain`), it is 1 % of the largest final speed. The resolution is 1/64 of the time
  before the measuring window. If the loads do not settle, the value is the end of the run
- the measures from `run.stroke` to `run.conveying_speed`: those of `VibrationMeasures` with the centre of mass as the point.
  All of them except torque and power are NaN for a run that does not end in a vibration at the speed of its exciters (see
  `Run.no_vibration`)
- support load: the sum of the static and the vertical dynamic load
"""


def measure_of(given: Measure | str, field: str) -> Measure:
    """Return a measure; a string is the name of a measure of `RUN_MEASURES`. **Raises** `InputError` for other values."""
    if isinstance(given, (Quantity, RunMeasure)):
        return given
    if isinstance(given, str) and given in RUN_MEASURES:
        return RUN_MEASURES[given]
    advice = suggest_name(str(given), list(RUN_MEASURES))
    raise InputError(
        field, f"is {quoted(given)}; give a quantity of optimize, such as jam_frequency(mode=3), or a name; {advice}"
    )
