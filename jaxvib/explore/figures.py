"""Contents of the page for a scene: diagram, moving machine, results as text, scene file."""

from __future__ import annotations

import base64
import functools
import gc
import html
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxvib.errors import ComputationError, InputError
from jaxvib.explore.sliders import scene_at, sliders_of
from jaxvib.machine.files import scene_to_toml
from jaxvib.machine.rewrite import rewrite_scene
from jaxvib.machine.scene import Scene
from jaxvib.steady.branches import branches
from jaxvib.steady.jams.jam import jam_modes
from jaxvib.steady.whirl import critical_speeds, whirl

_ABOUT_SLIDERS = """The sliders of masses, springs, dampers, radii, drags, unbalances and torques range from a tenth to ten
times the value in the file. The arrow keys move a slider by one step; the field above the sliders sets one of them to a typed
number."""

_ABOUT_COUNTS = """Each number of loads needs its own compiled program. The programs for the seven numbers closest to the number
in the file are compiled while the page is open. The program for any other number takes one or two seconds the first time, and
is then stored."""

_ABOUT_LOADS = f"""{_ABOUT_COUNTS}

Amplitudes and forces are zero to peak. The page shows the theory of light loads. For exact results, save the machine and run
`jaxvib simulate` or `jaxvib modes --exact`."""

_ABOUT_UNBALANCES = """Amplitudes and forces are zero to peak. The page shows motions averaged over a turn. For exact results,
save the machine and run `jaxvib simulate`; `jaxvib run-up` computes the motion from rest."""

_ABOUT_COLLECTED = """Amplitudes and forces are zero to peak. The page shows motions averaged over a turn, in which all loads
of an exciter are at one angle; a regime in which they would separate is unstable. For other motions use `jaxvib regimes`, for
exact results save the machine and run `jaxvib simulate`."""

_CAMPBELL_SPEEDS = 81
"""Number of rotor speeds of a Campbell diagram."""

_PREPARED_COUNTS = 7
"""Programs are compiled for this many other numbers of loads while the page is open."""


class SceneOrProblem(NamedTuple):
    """Scene at the values of the sliders, or the message of the error that it raised."""

    value: Scene | None
    problem: str


def scene_or_problem(build: Callable[[], Scene]) -> SceneOrProblem:
    """Return the scene from `build`, or the message of its error, because some values of the sliders give no valid machine."""
    try:
        return SceneOrProblem(build(), "")
    except (InputError, ComputationError) as error:
        return SceneOrProblem(None, str(error))


def image(draw: Callable[[], str], scene: SceneOrProblem) -> str:
    """Return an SVG figure as an HTML image with embedded data, or the message of the error."""

    def embed() -> str:
        data = base64.b64encode(draw().encode()).decode()
        return f'<img style="max-width:100%" src="data:image/svg+xml;base64,{data}">'

    return _html_or_problem(embed, scene, "No figure")


def text(read: Callable[[], str], scene: SceneOrProblem) -> str:
    """Return preformatted text as HTML, or the message of the error."""

    def preformatted() -> str:
        return f'<pre style="overflow-x:auto;font-size:0.8rem">{html.escape(read())}</pre>'

    return _html_or_problem(preformatted, scene, "No results")


def _html_or_problem(render: Callable[[], str], scene: SceneOrProblem, title: str) -> str:
    problem = scene.problem
    if not problem:
        try:
            return render()
        except (InputError, ComputationError) as error:
            problem = str(error)
    return f"<p><b>{title}:</b> {html.escape(problem)}</p>"


def toml(scene: SceneOrProblem, source: Path | None = None) -> str:
    """Return the scene file of the scene, with the comments and units of the file `source`; "" if there is no scene."""
    if scene.value is None:
        return ""
    return scene_to_toml(scene.value) if source is None else rewrite_scene(source.read_text(encoding="utf-8"), scene.value)


def prepare(scene: Scene) -> None:
    """Compile and draw the contents of the page. The first move of a slider is then as fast as later ones."""
    for slider in sliders_of(scene):
        if slider.number is not None:  # for another number of loads another program is needed
            moved = {slider.name: slider.steps[slider.steps.index(slider.start) - 1]}
            scene_or_problem(functools.partial(scene_at, scene, moved))
    for _ in range(2):
        _draw_all(scene)
    gc.collect()
    gc.freeze()  # a garbage collection of all programs and modules would take longer than a figure


def prepare_counts(scene: Scene) -> None:
    """Compile the contents of the page for other numbers of loads, the nearest first; each number is a separate program.

    Runs in a thread beside the page. Numbers of loads that are not possible are skipped; the page shows the error message.
    """
    for slider in sliders_of(scene):
        if slider.number is None:
            others = sorted(slider.steps, key=lambda count: (abs(count - slider.start), -count))[1 : 1 + _PREPARED_COUNTS]
            for count in others:
                moved = scene_or_problem(functools.partial(scene_at, scene, {slider.name: count})).value
                if moved is not None:
                    _draw_all(moved)


def _draw_all(scene: Scene) -> None:
    max_speed = 4.0 / 3.0 * float(scene.top_speed)
    drawn = SceneOrProblem(scene, "")
    image(lambda: diagram(scene, max_speed), drawn)
    text(lambda: readings(scene), drawn)
    image(lambda: machine(scene, next(iter(modes_of(scene)), None)), drawn)


def has_branches(scene: Scene) -> bool:
    """Return True if the jams of the scene form branches over the rotor speed. This requires one exciter with loads on a
    machine that moves only up and down."""
    return scene.is_plain and scene.mounting.axes == (1,)


def about(scene: Scene) -> str:
    """Return the text below the figures, as Markdown."""
    if scene.is_plain:
        theory = _ABOUT_LOADS if has_branches(scene) else _ABOUT_COUNTS
    else:
        theory = _ABOUT_COLLECTED if scene.has_loads else _ABOUT_UNBALANCES
    return f"{heading(scene)}\n\n{_ABOUT_SLIDERS} {theory}"


def heading(scene: Scene) -> str:
    """Return the description of `diagram` for this scene, with a reference to other results."""
    if not scene.is_plain and scene.has_loads:
        return (
            "Synchronous regimes: all loads and unbalances turn at one speed, the loads of an exciter at one angle. The "
            "diagram shows the first four regimes of the list over the no-load speed of the drives: their speeds, amplitudes "
            "and the phases of the exciters (for one exciter: the foundation force). All drive speeds change by one factor. "
            "Dashed lines: unstable. A line ends where its regime ends. The sketch shows the first regime of the list; "
            "ellipses are the paths of points of the body."
        )
    if not scene.is_plain:
        return (
            "Working regime: the stable synchronous regime at the speed of the motors. The diagram shows its rotor speed, its "
            "amplitudes and the phases of the exciters (for one exciter: the foundation force) over the no-load speed of the "
            "motors; all no-load speeds change by one factor. A line has a gap where no synchronous regime is stable. The "
            "sketch shows the first regime of the list; ellipses are the paths of points of the body."
        )
    if has_branches(scene):
        return (
            "Jams of light loads: load speed, amplitudes and foundation force over the rotor speed. Solid lines: stable; "
            "dashed lines: unstable, or the loads spread. The numbers on the vertical line of the working speed are those of "
            "the jam modes at this rotor speed."
        )
    return (
        "Whirl frequencies of the rotor over the rotor speed (Campbell diagram), with the masses of the loads fixed to the "
        "rotor, and critical speeds. There is no branch diagram and no force chart, because the loads of a machine that moves "
        "in two directions can jam at any phases; `jaxvib modes` finds these jams."
    )


def diagram(scene: Scene, max_speed: float) -> str:
    """Draw the diagram of a scene.

    For one exciter with loads, it is the branch diagram with amplitudes and force if the machine moves only up and down, and
    the Campbell diagram if it moves in two directions. For other scenes (exciters with unbalances, several exciters), it shows
    synchronous regimes over the speed of the drives.

    **Arguments**: `max_speed`: the highest rotor speed in the diagram, rad/s; the diagram always reaches at least 1.15 times
    the rotor speed of the scene.

    **Returns** the text of an SVG file. **Raises** `InputError` for a scene without such a diagram; the message names the part
    of the scene that prevents it.

    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import TEMPLATES
    >>> "whirl frequency, rpm" in diagram(jv.scene_from_toml(TEMPLATES["planar_rotor"]), max_speed=600.0)
    True
    """
    from jaxvib.explore.campbell import campbell  # slow import
    from jaxvib.explore.chart import chart
    from jaxvib.explore.regimes import regime_chart

    speed = float(scene.top_speed)
    max_speed = max(max_speed, 1.15 * speed)
    if not scene.is_plain:
        return regime_chart(scene, max_speed)
    if has_branches(scene):
        return chart(jax.device_get(branches(scene, most=max_speed)), max_speed)
    return campbell(jax.device_get(whirl(scene, np.linspace(0.0, max_speed, _CAMPBELL_SPEEDS))), speed)


def readings(scene: Scene) -> str:
    """Return the results of a scene as text: the jams at the rotor speed, the critical speeds of a rotor, or the synchronous
    regimes. **Raises** `InputError` like `diagram`."""
    from jaxvib.explore.regimes import regime_readings  # slow import

    if not scene.is_plain:
        return regime_readings(scene)
    if has_branches(scene):
        return jax.device_get(jam_modes(scene)).summary(scene)
    return jax.device_get(critical_speeds(scene)).summary()


def modes_of(scene: Scene) -> list[int]:
    """Return the numbers of the jam modes that `machine` can animate: 1, 3, 5, ..., the modes that are stable by slope.

    Modes that exist at the rotor speed of the scene come first, then the modes that do not. In each group the mode at the
    highest resonance comes first, and the mode above all resonances last. The list is empty if `has_branches` is False.
    """
    if not has_branches(scene):
        return []
    modes = range(1, 2 * len(scene.machine.structure().coordinates) + 2, 2)
    try:
        existing = jax.device_get(jam_modes(scene)).mode_numbers()
    except (InputError, ComputationError):
        existing = []
    return sorted(modes, key=lambda mode: (mode not in existing, mode == modes[-1], -mode))


def machine(scene: Scene, mode: int | None) -> str:
    """Return the machine as an SVG figure: moving in the first synchronous regime of the list, or in the jam mode with the
    number `mode`, or at rest if `mode` is None."""
    from jaxvib.explore.regimes import deck_points, regimes_of
    from jaxvib.show.moving import moving_svg, regime_svg, sketch_svg  # slow import

    if not scene.is_plain and (regimes := regimes_of(scene)):
        return regime_svg(scene, regimes[0], deck_points(scene))
    return sketch_svg(scene) if mode is None else moving_svg(scene, jax.device_get(jam_modes(scene)).select(mode))
