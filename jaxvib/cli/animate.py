"""jaxvib animate, sketch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

import jaxvib as jv
from jaxvib.cli.app import Output, app, shared
from jaxvib.errors import InputError

if TYPE_CHECKING:
    from jaxvib.motion.start import Start


@app.command("animate")
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--until", help="Length of the run if a scene is given, such as 20s.")
@click.option("--start", type=click.Choice(["rest", "jam", "spin_up"]), help="Start of that run [rest].")
@click.option("--mode", type=int, help="Jam mode of a scene; its exact motion is shown without --until.")
@click.option("--begin", help="First time, such as 4.5s [four vibrations before the end].")
@click.option("--end", help="Last time [the end].")
@click.option("--seconds", help="Length of the film, s [10 pictures in a turn of the rotor].")
@click.option("--fps", type=int, default=20, show_default=True, help="Pictures per second.")
@click.option("--magnify", type=float, help="Scale of displacements relative to the circle of the loads.")
@click.option("--width", type=float, default=6.4, show_default=True, help="Width of the picture, in hundreds of dots.")
@click.option("--format", "kind", type=click.Choice(["gif", "html", "both"]), default="both", show_default=True)
@shared
def animate(
    source: Path,
    until: str | None,
    start: Start | None,
    mode: int | None,
    begin: str | None,
    end: str | None,
    seconds: str | None,
    fps: int,
    magnify: float | None,
    width: float,
    kind: str,
    output: Output,
) -> None:
    """Make a film of the moving machine in slow motion: animation.gif and animation.html, in --out or the current folder.

    SOURCE is a run.npz of `jaxvib simulate`, or its folder, or a scene file. With --until the scene is simulated first; with
    --mode the film shows its exact jam."""
    if source.is_dir():
        source = source / "run.npz"
    if source.suffix == ".npz":
        if until is not None or start is not None or mode is not None:
            raise InputError("--until", "goes, as --start and --mode, with a scene file; a kept run has its own")
        motion, scene = jv.Run.load(source), None
    else:
        loaded = jv.load_scene(source)
        if until is not None:
            motion, scene = jv.simulate(loaded, until, start=start or "rest", mode=mode, estimate=False), None
        elif mode is None:
            raise InputError("--until", "is missing; say how long to simulate, or by --mode which jam to show")
        else:
            motion, scene = jv.jam_orbit(loaded, mode=mode), loaded
    film = jv.animate(motion, scene=scene, begin=begin, end=end, seconds=seconds, fps=fps, magnify=magnify, width=width)
    for suffix in ("gif", "html"):
        if kind in (suffix, "both"):
            film.save(output.made(f"animation.{suffix}"))
    first, last = film.figure.axes[1].get_xlim()
    document = {"pictures": film.count, "fps": film.fps, "begin": first, "end": last}
    output.done(document, lambda: f"{film.count} pictures of {first:.6g} to {last:.6g} s", "animate")


@app.command("sketch")
@click.argument("scene", type=click.Path(path_type=Path))
@shared
def sketch(scene: Path, output: Output) -> None:
    """Draw SCENE with its numbers: sketch.png, in --out or the current folder."""
    jv.sketch(jv.load_scene(scene)).savefig(output.made("sketch.png"))
    output.done({"status": "done"}, lambda: "a sketch of the machine", "sketch")
