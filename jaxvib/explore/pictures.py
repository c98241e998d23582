"""Contents of the page for a scene: diagram, moving machine, numbers, file."""

from __future__ import annotations

import base64
import functools
import gc
import html
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from jaxvib.errors import ComputationError, InputError
from jaxvib.explore.sliders import scene_at, sliders_of
from jaxvib.machine.files import scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.steady.branches import branches
from jaxvib.steady.jams.jam import jam_modes
from jaxvib.steady.whirl import critical_speeds, whirl

__all__ = [
    "ABOUT",
    "SceneOrProblem",
    "diagram",
    "has_branches",
    "heading",
    "image",
    "machine",
    "modes_of",
    "prepare",
    "prepare_counts",
    "readings",
    "scene_or_problem",
    "text",
    "toml",
]

ABOUT = """Springs and dampers, masses and drags of loads: a tenth to ten times the file's. Arrow keys move a slider by a
step. Each number of loads is a program of its own: the seven next to the file's are compiled while the page is open, any
other takes a second or two the first time. Afterwards it is stored.

Amplitudes and forces are zero to peak. What is seen here is the theory of light loads; `jaxvib simulate` and
`jaxvib modes --exact` answer for the saved machine exactly."""
"""Text below the sliders, as Markdown."""

_SPEEDS = 81
"""Rotor speeds of a Campbell diagram."""

_PREPARED_COUNTS = 7
"""Number of other numbers of loads that are compiled while the page is open."""


class SceneOrProblem(NamedTuple):
    """Requested scene, or a sentence that says why there is none."""

    value: Scene | None
    problem: str


def scene_or_problem(ask: Callable[[], Scene]) -> SceneOrProblem:
    """The scene that `ask` gives, or what its `InputError` says: a slider may go where no machine is."""
    try:
        return SceneOrProblem(ask(), "")
    except (InputError, ComputationError) as error:
        return SceneOrProblem(None, str(error))


def image(draw: Callable[[], str], scene: SceneOrProblem) -> str:
    """The text of an SVG file as an HTML image that holds its own data, or the sentence that says why there is none."""

    def made() -> str:
        data = base64.b64encode(draw().encode()).decode()
        return f'<img style="max-width:100%" src="data:image/svg+xml;base64,{data}">'

    return _shown(made, scene)


def text(read: Callable[[], str], scene: SceneOrProblem) -> str:
    """Text as HTML, as it stands, or the sentence that says why there is none."""
    return _shown(lambda: f'<pre style="white-space:pre-wrap;font-size:0.8rem">{html.escape(read())}</pre>', scene)


def _shown(make: Callable[[], str], scene: SceneOrProblem) -> str:
    problem = scene.problem
    if not problem:
        try:
            return make()
        except (InputError, ComputationError) as error:
            problem = str(error)
    return f"<p><b>Nothing to show here:</b> {html.escape(problem)}</p>"


def toml(scene: SceneOrProblem) -> str:
    """The scene file of what the sliders say; empty where they say no machine."""
    return "" if scene.value is None else scene_to_toml(scene.value)


def prepare(scene: Scene) -> None:
    """Compiles and draws once what the page will ask for, so that its first slider moves as fast as the next."""
    for slider in sliders_of(scene):
        if slider.number is not None:  # another number of loads is another program
            moved = {slider.name: slider.steps[slider.steps.index(slider.start) - 1]}
            scene_or_problem(functools.partial(scene_at, scene, moved))
    for _ in range(2):
        _draw_all(scene)
    gc.collect()
    gc.freeze()  # programs and modules stay: to look through them all again takes longer than a picture


def prepare_counts(scene: Scene) -> None:
    """Compiles what the page will ask for with other numbers of loads, the next ones first: each is a program of its own.

    Meant for a thread beside the page. What cannot be computed is left to the page, which says why."""
    for slider in sliders_of(scene):
        if slider.number is None:
            others = sorted(slider.steps, key=lambda count: (abs(count - slider.start), -count))[1 : 1 + _PREPARED_COUNTS]
            for count in others:
                moved = scene_or_problem(functools.partial(scene_at, scene, {slider.name: count})).value
                if moved is not None:
                    _draw_all(moved)


def _draw_all(scene: Scene) -> None:
    most = 4.0 / 3.0 * float(scene.drive.speed)
    given = SceneOrProblem(scene, "")
    image(lambda: diagram(scene, most), given)
    text(lambda: readings(scene), given)
    image(lambda: machine(scene, next(iter(modes_of(scene)), None)), given)


def has_branches(scene: Scene) -> bool:
    """True if jams of the scene lie on branches over the rotor speed, that is if its machine moves up and down only."""
    return scene.mounting().axes == (1,)


def heading(scene: Scene) -> str:
    """Heading of `diagram` for this scene, with a reference to other results."""
    if has_branches(scene):
        return (
            "Where light loads jam: their speed and the foundation force over the rotor's speed. Solid: stable by slope, for "
            "loads that stay together; dashed: unstable. Where the line of the rotor's speed crosses, jams stand with the "
            "numbers of their modes."
        )
    return (
        "Whirl of the rotor over its speed (Campbell diagram), the loads' masses where they run, and its critical speeds. "
        "There is no branch diagram and no force chart: loads of a machine that moves both ways jam at any phases, which "
        "`jaxvib modes` finds."
    )


def diagram(scene: Scene, most: float) -> str:
    """Branch diagram with the force chart for a machine that moves up and down; Campbell diagram for a rotor.

    **Arguments**: `most` the greatest rotor speed shown, rad/s; more where the scene's own speed asks for it.

    **Returns** the text of an SVG file. **Raises** `InputError` for scenes that the theory leaves out; it says which part.

    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> "whirl speed, rpm" in diagram(jv.scene_from_toml(TEMPLATES["planar_rotor"]), most=600.0)
    True
    """
    from jaxvib.explore.campbell import campbell  # slow import
    from jaxvib.explore.chart import chart

    speed = float(scene.drive.speed)
    most = max(most, 1.15 * speed)
    if has_branches(scene):
        return chart(jax.device_get(branches(scene, most=most)), most)
    return campbell(jax.device_get(whirl(scene, np.linspace(0.0, most, _SPEEDS))), speed)


def readings(scene: Scene) -> str:
    """The jams at the rotor's speed, or a rotor's critical speeds, as text. **Raises** `InputError` as `diagram`."""
    return jax.device_get(jam_modes(scene) if has_branches(scene) else critical_speeds(scene)).summary()


def modes_of(scene: Scene) -> list[int]:
    """The jam modes that `machine` can show moving, stable by slope. First come those that exist at the scene's rotor speed, of
    these the one at the highest resonance, last the one beyond all resonances. None of a machine that moves both ways.
    """
    if not has_branches(scene):
        return []
    modes = range(1, 2 * len(scene.machine.structure().coordinates) + 2, 2)
    try:
        there = jax.device_get(jam_modes(scene)).mode_numbers()
    except (InputError, ComputationError):
        there = []
    return sorted(modes, key=lambda mode: (mode not in there, mode == modes[-1], -mode))


def machine(scene: Scene, mode: int | None) -> str:
    """The machine as an SVG picture, moving in the jam mode of that number; at rest where there is none."""
    from jaxvib.show.moving import moving, still  # slow import

    return still(scene) if mode is None else moving(scene, jax.device_get(jam_modes(scene)).select(mode))
