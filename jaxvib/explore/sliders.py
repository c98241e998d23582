"""Sliders for the parameters of a scene: their ranges, and the scene for given values of the sliders."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxvib.display import shown_unit
from jaxvib.errors import InputError
from jaxvib.explore.latest import keep_latest
from jaxvib.machine.files import rebuild_part
from jaxvib.machine.numbers.named import NamedNumber, numbers_of, put_numbers
from jaxvib.machine.scene import Scene
from jaxvib.results.table import is_number
from jaxvib.steady.regimes.collected import has_equal_loads
from jaxvib.units.reading import to_float

COUNT = "loads.count"
"""Name of the slider that changes the number of loads."""

_LOAD_NUMBERS = ("loads.mass", "loads.radius", "loads.drag")
_MACHINE_NUMBERS = ("machine.mass", "machine.stiffness", "machine.link_stiffness", "machine.damping", "machine.link_damping")
"""Parameters of loads and of a machine that have sliders."""

_EXCITER_NUMBERS = (("loads", "mass"), ("loads", "radius"), ("loads", "drag"), ("unbalance",), ("position",))
"""Parameters of an exciter that have sliders if the scene is not plain (`Scene.is_plain`), by their paths in the exciter."""

_MACHINE_FIELDS = ("stiffness", "link_stiffness", "angle", "mass", "inertia", "damping", "link_damping")
"""Fields of a machine, or of its supports and bodies, that have sliders if the scene is not plain (`Scene.is_plain`)."""

_HALF_TURN = 180
"""Half the range of the slider of an angle, in degrees; the slider has steps of 1 degree."""

_MAX_SINGLE_SLIDERS = 15
"""Maximum number of sliders for single parameters of a machine. A machine with more parameters has one slider for all of a
field, such as all stiffnesses."""

_VALUE_FACTORS = tuple(np.geomspace(0.1, 10.0, 81).tolist())
_SPEED_FACTORS = tuple((np.arange(1, 301) / 100.0).tolist())
_SHIFT_STEPS = 80
"""Number of steps of a position to each side."""


class Slider(NamedTuple):
    """Slider for a parameter of a scene.

    The parameter is multiplied by value / `start`. A position or an angle is shifted by value - `start` instead. At `start` it
    therefore keeps exactly its value.

    **Attributes**

    - `name` in the scene; `label`, the name shown to the user; `unit` on the slider
    - `steps`: ascending values of the slider; `start`: the value in the scene, which is one of the `steps`
    - `number`: the parameter; None for the number of loads
    - `shift`: shift of the parameter, SI, for a change of the slider by 1; None for a parameter that is multiplied
    """

    name: str
    label: str
    unit: str
    steps: tuple[float, ...]
    start: float
    number: NamedNumber | None
    shift: float | None = None

    @property
    def title(self) -> str:
        """Label of the slider."""
        return f"{self.label}, {self.unit}" if self.unit else self.label


@keep_latest
def sliders_of(scene: Scene) -> list[Slider]:
    """Return the sliders of a scene; the sliders of the drives and the loads come first.

    - masses, springs and dampers of the machine, masses, radii and drags of the loads, unbalances of exciters and torques of
      their motors: a tenth to ten times the scene's values
    - speeds of drives: a hundredth to three times the scene's value
    - positions of exciters and angles of supports on bodies in a plane, in a range around the scene's value
    - number of loads, if all loads have equal parameters

    A parameter that is 0 has no slider, because a factor does not change it; positions and angles always have one.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness="40 N/mm", damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("600 rpm"))
    >>> [slider.title for slider in sliders_of(scene)][:3]
    ['rotor speed, rpm', 'number of loads', 'mass of each ball, g']
    >>> sliders_of(scene)[-2].title, sliders_of(scene)[-2].start
    ('stiffness of the support, N/mm', 40.0)
    """
    named = numbers_of(scene)
    if scene.is_plain:
        sliders = [_slider(scene, named["drive.speed"], _SPEED_FACTORS)]
        if has_equal_loads(scene, 0):
            sliders.append(_count_slider(COUNT, "number of loads", scene.loads.count))
        numbers = [named[name] for name in _LOAD_NUMBERS if _is_adjustable(scene, name)]
        arrays = [named[name] for name in _MACHINE_NUMBERS if _is_adjustable(scene, name)]
    else:
        sliders, numbers = _exciter_sliders(scene, named), []
        in_machine = [each for each in named.values() if each.path[0] == "machine"]
        arrays = [each for field in _MACHINE_FIELDS for each in in_machine if field in each.path]
        arrays = [each for each in arrays if _is_shifted(each) or np.any(each.read(scene))]
    single = [entry for array in arrays for entry in array.single(scene) if _is_shifted(entry) or np.any(entry.read(scene))]
    numbers += single if len(single) <= _MAX_SINGLE_SLIDERS else arrays
    return sliders + [_slider(scene, number, _VALUE_FACTORS) for number in numbers]


def _exciter_sliders(scene: Scene, named: Mapping[str, NamedNumber]) -> list[Slider]:
    """Return the sliders of the exciters of a scene that is not plain: speeds of the drives, loads, unbalances, positions,
    torques of the motors."""
    reach = max([0.1, *(float(np.max(np.abs(e.position))) for e in scene.exciters if e.position is not None)])
    sliders = []
    for k in range(len(scene.exciters)):
        of_exciter = [each for each in named.values() if each.path[:2] == ("exciters", k)]
        speed = [each for each in of_exciter if each.path[2:] == ("drive", "speed")]
        loads = scene.exciters[k].loads
        if loads is not None and has_equal_loads(scene, k):
            label = f"number of loads{f' of exciter {k + 1}' * (len(scene.exciters) > 1)}"
            sliders.append(_count_slider(f"{scene.prefix_of(k)}{COUNT}", label, loads.count))
        others = [each for each in of_exciter if each.path[2:] in _EXCITER_NUMBERS]
        torques = [each for each in of_exciter if each.path[2] == "drive" and each.spec.unit == "N m"]
        sliders += [_slider(scene, each, _SPEED_FACTORS) for each in speed]
        for entry in (entry for each in (*others, *torques) for entry in each.single(scene)):
            if _is_shifted(entry) or np.any(entry.read(scene)):
                sliders.append(_slider(scene, entry, _VALUE_FACTORS, reach))
    return sliders


def scene_at(scene: Scene, values: Mapping[str, float]) -> Scene:
    """Return the scene for `values` of the sliders by name, in the units of the sliders; other parameters keep their values.

    **Raises** `InputError` for a name that is not a slider of the scene, and for loads that do not fit into the rotor.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness="40 N/mm", damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("600 rpm"))
    >>> moved = scene_at(scene, {"machine.stiffness[0]": 80.0, "loads.count": 3})
    >>> float(moved.machine.stiffness[0]), moved.loads.count
    (80000.0, 3)
    """
    sliders = {slider.name: slider for slider in sliders_of(scene)}
    counts = {}
    for name, value in values.items():
        if name not in sliders:
            raise InputError(name, f"is not a slider of this scene; the sliders are: {', '.join(sliders)}")
        slider = sliders[name]
        if value == slider.start:
            continue
        if slider.number is None:
            counts[name] = int(value)
        else:
            old = slider.number.read(scene)
            new = old * (value / slider.start) if slider.shift is None else old + slider.shift * (value - slider.start)
            scene = put_numbers(scene, (slider.number,), new)
    for k, exciter in enumerate(scene.exciters):
        name = f"{scene.prefix_of(k)}{COUNT}"
        if name in counts and exciter.loads is not None:
            loads = rebuild_part(dataclasses.replace(exciter.loads, count=counts[name]), f"{scene.prefix_of(k)}loads")
            scene = eqx.tree_at(lambda s, k=k: s.exciters[k].loads, scene, loads)
    return scene


def typed_value(scene: Scene, slider: Slider, text: str) -> float:
    """Return the value of the slider that a user typed: a number in the unit of the slider, or with a unit of its own.

    **Raises** `InputError` for a text that is not such a number, and for a value outside the range of the slider.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness="40 N/mm", damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("600 rpm"))
    >>> speed = sliders_of(scene)[0]
    >>> typed_value(scene, speed, "725"), round(typed_value(scene, speed, "12 Hz"), 6)
    (725.0, 720.0)
    """
    text = text.strip()
    if is_number(text, ","):
        value = float(text)
    else:
        unit = slider.number.unit if slider.number is not None and slider.unit else ""
        value = float(np.asarray(to_float(text, unit, slider.label)))
        if unit and slider.number is not None:
            scale = slider.start / float(slider.number.read(scene)[0]) if slider.shift is None else 1.0 / slider.shift
            value = float(f"{value * scale:.12g}")
    low, high = slider.steps[0], slider.steps[-1]
    if not low <= value <= high:
        unit = f" {slider.unit}" if slider.unit else ""
        raise InputError(slider.label, f"is {value:.6g}{unit}; the slider is from {low:g} to {high:g}{unit}")
    if slider.number is None and value not in slider.steps:
        raise InputError(slider.label, f"is {value:g}; it must be a whole number")
    return value


def _is_adjustable(scene: Scene, name: str) -> bool:
    """Return True if the scene has this parameter with a value other than 0, and no other parameter, such as `stiffness_terms`
    of a rotor, replaces it."""
    part, _, field = name.partition(".")
    owner = getattr(scene, part)
    value = getattr(owner, field, None)
    return value is not None and bool(np.any(np.asarray(value))) and getattr(owner, f"{field}_terms", None) is None


def _count_slider(name: str, label: str, count: int) -> Slider:
    """Return the slider of a number of loads."""
    return Slider(name, label, "", tuple(range(1, min(256, max(8, 2 * count)) + 1)), count, None)


def _is_shifted(number: NamedNumber) -> bool:
    """Return True for a single parameter that may be negative: a position or an angle."""
    return number.size == 1 and number.unit in ("m", "rad") and number.spec.bounds.low < 0.0


def _slider(scene: Scene, number: NamedNumber, factors: tuple[float, ...], reach: float = 0.0) -> Slider:
    """Return the slider of a parameter: its value times the `factors`, or from -`reach` to +`reach` around the value."""
    values = np.asarray(number.read(scene))
    if number.size > 1:
        part, _, field = number.name.partition(".")
        steps = tuple(float(f"{f:.3g}") for f in factors)
        return Slider(number.name, f"{field.replace('_', ' ')} of the {part}, common factor", "", steps, 1.0, number)
    label = number.words(scene)[0]
    if not _is_shifted(number):
        unit, scale = shown_unit(number.unit_of_tables, float(values[0]))
        start = float(f"{scale * values[0]:.6g}")
        return Slider(number.name, label, unit, _steps(start, factors), start, number)
    unit, scale = shown_unit(number.unit, 1e-3)
    start, count = float(f"{scale * values[0]:.6g}"), _HALF_TURN if number.unit == "rad" else _SHIFT_STEPS
    step = float(f"{scale * (np.pi if number.unit == 'rad' else reach) / count:.2g}")
    steps = tuple(float(f"{start + step * k:.6g}") for k in range(-count, count + 1))
    return Slider(number.name, label, unit, steps, start, number, 1.0 / scale)


@functools.lru_cache(maxsize=256)
def _steps(start: float, factors: tuple[float, ...]) -> tuple[float, ...]:
    """Return `start` times each factor, with four digits, and `start` itself, ascending. The values are cached because each
    move of a slider needs the values of all sliders."""
    return tuple(sorted({start, *(float(f"{f * start:.4g}") for f in factors if f != 1.0)}))
