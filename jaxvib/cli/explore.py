"""Command `explore` of jaxvib."""

from __future__ import annotations

import threading
from pathlib import Path

import click

from jaxvib.cli.app import app, loaded_scene


@app.command("explore")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--port", type=click.IntRange(1, 65535), default=2718, help="Network port of this computer.")
@click.option("--no-browser", is_flag=True, help="Do not open a browser; only print the address of the page.")
def explore(scene: Path, port: int, no_browser: bool) -> None:
    """Open a local page with sliders for SCENE; the diagrams follow the sliders, and the machine can be saved as TOML.

    The command ends with Ctrl-C. It prints the address of the page, which contains a random token: other computers, and other
    sites in your browser, cannot open the page. Needs: pip install '.[explore]' in the source folder of jaxvib"""
    from jaxvib.explore.figures import prepare, prepare_counts
    from jaxvib.explore.server import require_free, require_marimo, serve  # slow import

    require_marimo()
    require_free(port)
    loaded = loaded_scene(scene)
    click.echo("compiling ...")
    prepare(loaded)
    threading.Thread(target=prepare_counts, args=(loaded,), daemon=True).start()
    serve(scene, port, not no_browser, lambda address: click.echo(f"the page is at {address}; press Ctrl-C to stop"))
