"""Commands `animate` and `sketch` of jaxvib."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import jaxvib as jv
from jaxvib.cli.app import Output, command, loaded_scene
from jaxvib.errors import InputError, written

if TYPE_CHECKING:
    from jaxvib.motion.start import Start


@command("animate", "source")
@click.option("--until", help="Duration of the simulation, if SOURCE is a scene file, such as 20s.")
@click.option("--start", type=click.Choice(["rest", "jam", "spin_up"]), help="Initial state of the simulation [rest].")
@click.option(
    "--mode", type=int, help="Number of the jam mode; without --until, the animation shows the exact motion of this mode."
)
@click.option("--begin", help="First time of the animation, such as 4.5s [four vibration periods before the end].")
@click.option("--end", help="Last time of the animation [end of the run].")
@click.option(
    "--seconds", help="Duration of the animation, s; at most 600 frames [that of about 11 frames for each turn of the rotor]."
)
@click.option("--fps", type=int, default=20, help="Frames per second.")
@click.option(
    "--magnify", type=float, help="Magnification of the displacements relative to the circle of the loads [automatic]."
)
@click.option("--width", type=float, default=6.4, help="Width of the animation, in hundreds of pixels.")
@click.option("--format", "kind", type=click.Choice(["gif", "html", "both"]), default="both", help="Format of the file.")
def animate(
    source: Path, until: str | None, start: Start | None, mode: int | None, kind: str, output: Output, **options: Any
) -> None:
    """Make an animation of the moving machine in slow motion: animation.gif and animation.html, in --out or the current folder.

    SOURCE is a file run.npz of `jaxvib simulate`, the folder of such a file, or a scene file. For a scene file, --until
    simulates the scene first; --mode without --until shows the exact jam."""
    if os.path.isdir(source):
        source = source / "run.npz"
    if source.suffix == ".npz":
        if until is not None or start is not None or mode is not None:
            raise InputError("--until", "and --start and --mode apply to a scene file; they cannot be used with a saved run")
        motion, scene = jv.Run.load(source), None
    else:
        loaded = loaded_scene(source)
        if until is not None:
            motion, scene = jv.simulate(loaded, until, start=start or "rest", mode=mode, estimate=False), None
        elif mode is None:
            raise InputError(
                "--until", "is missing; give the duration of the simulation, or --mode with the number of a jam mode"
            )
        elif start is not None:
            raise InputError("--start", "needs a simulation: give --until with its duration, or leave --start out")
        else:
            motion, scene = jv.jam_orbit(loaded, mode=mode), loaded
    animation = jv.animate(motion, scene=scene, **options)
    for suffix in ("gif", "html"):
        if kind in (suffix, "both"):
            animation.save(output.main_file(f"animation.{suffix}"))
    first, last = animation.figure.axes[1].get_xlim()
    document = {"frames": animation.count, "fps": animation.fps, "begin": first, "end": last}
    output.done(document, lambda: f"{animation.count} frames from {first:.6g} to {last:.6g} s", "animate")


@command("sketch")
def sketch(scene: Path, output: Output) -> None:
    """Draw SCENE with the values of its parameters: sketch.png, in --out or the current folder."""
    figure = jv.sketch(loaded_scene(scene))
    with written(output.main_file("sketch.png")) as part:
        figure.savefig(part)
    output.done({"status": "done"}, lambda: "a sketch of the machine", "sketch")
