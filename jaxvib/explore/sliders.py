"""Sliders for the parameters of a scene: their ranges, and the scene for given values of the sliders."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np

from jaxvib.display import shown_unit
from jaxvib.errors import InputError
from jaxvib.machine.files import rebuild_part
from jaxvib.machine.numbers.named import NamedNumber, find_number, put_numbers
from jaxvib.machine.scene import Scene
from jaxvib.units.reading import to_float

COUNT = "loads.count"
"""Name of the slider that changes the number of loads."""

_LOAD_NUMBERS = ("loads.mass", "loads.radius", "loads.drag")
_MACHINE_NUMBERS = ("machine.mass", "machine.stiffness", "machine.link_stiffness", "machine.damping", "machine.link_damping")
"""Numbers of loads and of a machine that have sliders."""

_MAX_SINGLE_SLIDERS = 15
"""Maximum number of sliders for single parameters of a machine. A machine with more parameters has one slider for all of a
field, such as all stiffnesses."""

_VALUE_FACTORS = tuple(np.geomspace(0.1, 10.0, 81).tolist())
_SPEED_FACTORS = tuple((np.arange(1, 301) / 100.0).tolist())


class Slider(NamedTuple):
    """Slider for a parameter of a scene.

    The parameter is multiplied by value / `start`; at `start` it therefore keeps exactly its value.

    **Attributes**

    - `name` in the scene; `label`, the name shown to the user; `unit` on the slider
    - `steps`: ascending values of the slider; `start`: the value in the scene, which is one of the `steps`
    - `number`: the parameter; None for the number of loads
    """

    name: str
    label: str
    unit: str
    steps: tuple[float, ...]
    start: float
    number: NamedNumber | None

    @property
    def title(self) -> str:
        """Label of the slider."""
        return f"{self.label}, {self.unit}" if self.unit else self.label


def sliders_of(scene: Scene) -> list[Slider]:
    """Return the sliders of a scene; the sliders of the drive and the loads come first.

    - masses, springs and dampers of the machine, masses, radii and drags of the loads: a tenth to ten times the scene's values
    - rotor speed: a hundredth to three times the scene's value
    - number of loads, if all loads have equal parameters

    A parameter that is 0 has no slider, because a factor does not change it.

    **Raises** `InputError` for a scene with several exciters, with an unbalance, or with a clockwise rotor.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness="40 N/mm", damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("600 rpm"))
    >>> [slider.title for slider in sliders_of(scene)][:3]
    ['rotor speed, rpm', 'number of loads', 'mass of each ball, g']
    >>> sliders_of(scene)[-2].title, sliders_of(scene)[-2].start
    ('stiffness of the support, N/mm', 40.0)
    """
    if not scene.is_plain:
        raise InputError(
            "scene",
            "has several exciters, an unbalance or a clockwise rotor; the explorer shows machines with one anticlockwise "
            "exciter that has loads (balls, rollers or pendulums); for others use jaxvib regimes, response, run-up or simulate",
        )
    sliders = [_slider(scene, find_number(scene, "drive.speed", "slider"), _SPEED_FACTORS)]
    if _has_equal_loads(scene):
        counts = tuple(range(1, min(256, max(8, 2 * scene.loads.count)) + 1))
        sliders.append(Slider(COUNT, "number of loads", "", counts, scene.loads.count, None))
    numbers = [find_number(scene, name, "slider") for name in _LOAD_NUMBERS if _is_adjustable(scene, name)]
    arrays = [find_number(scene, name, "slider") for name in _MACHINE_NUMBERS if _is_adjustable(scene, name)]
    single = [entry for array in arrays for entry in array.single(scene) if np.any(entry.read(scene))]
    numbers += single if len(single) <= _MAX_SINGLE_SLIDERS else arrays
    return sliders + [_slider(scene, number, _VALUE_FACTORS) for number in numbers]


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
    loads = scene.loads
    for name, value in values.items():
        if name not in sliders:
            raise InputError(name, f"is not a slider of this scene; the sliders are: {', '.join(sliders)}")
        slider = sliders[name]
        if value == slider.start:
            continue
        if slider.number is None:
            loads = dataclasses.replace(loads, count=int(value))
        else:
            scene = put_numbers(scene, (slider.number,), slider.number.read(scene) * (value / slider.start))
    if loads.count == scene.loads.count:
        return scene
    changed = dataclasses.replace(scene.loads, count=loads.count)
    return scene.replace(loads=rebuild_part(changed, "loads"))


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
    try:
        value = float(text)
    except ValueError:
        unit = slider.number.unit if slider.number is not None and slider.unit else ""
        value = float(np.asarray(to_float(text, unit, slider.label)))
        if unit and slider.number is not None:
            value = float(f"{value * slider.start / float(slider.number.read(scene)[0]):.12g}")
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


def _has_equal_loads(scene: Scene) -> bool:
    """Return True if all loads have equal parameters and one station, so that the number of loads can be changed."""
    return scene.mounting.at_one_point and all(np.ndim(leaf) == 0 for leaf in jax.tree.leaves(scene.loads))


def _slider(scene: Scene, number: NamedNumber, factors: tuple[float, ...]) -> Slider:
    values = np.asarray(number.read(scene))
    if number.size > 1:
        part, _, field = number.name.partition(".")
        steps = tuple(float(f"{f:.3g}") for f in factors)
        return Slider(number.name, f"{field.replace('_', ' ')} of the {part}, common factor", "", steps, 1.0, number)
    unit, scale = shown_unit(number.unit, float(values[0]))
    start = float(f"{scale * values[0]:.6g}")
    return Slider(number.name, number.words(scene)[0], unit, _steps(start, factors), start, number)


@functools.lru_cache(maxsize=256)
def _steps(start: float, factors: tuple[float, ...]) -> tuple[float, ...]:
    """Return `start` times each factor, with four digits, and `start` itself, ascending. The values are cached because each
    move of a slider needs the values of all sliders."""
    return tuple(sorted({start, *(float(f"{f * start:.4g}") for f in factors if f != 1.0)}))
