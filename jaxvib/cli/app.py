"""The commands, and what they have in common: JSON, files, exit codes."""

from __future__ import annotations

import importlib
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from jaxvib.errors import ComputationError, InputError

if TYPE_CHECKING:
    from jaxvib.machine.scene import Scene

__all__ = ["WITHOUT", "Output", "app", "loaded_scene", "run", "shared", "table"]


class Output:
    """Where a command's results go: a JSON document or text on stdout, and files in a folder."""

    def __init__(self, as_json: bool, folder: Path | None):
        self.as_json = as_json
        self.folder = folder
        self.files: list[str] = []
        if folder is not None:
            self._make(folder)

    @staticmethod
    def _make(folder: Path) -> None:
        """Before anything is computed: a result that has nowhere to go is lost."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError("--out", f"is {str(folder)!r}, which cannot be made a folder ({error.strerror})") from error

    def file(self, name: str) -> Path | None:
        """The path of a result file; None where no folder was asked for."""
        if self.folder is None:
            return None
        self.files.append(str(self.folder / name))
        return self.folder / name

    def done(self, document: dict[str, Any], text: Callable[[], str], name: str) -> None:
        """Prints the document or the text, and writes the document to NAME.json in the folder."""
        path = self.file(f"{name}.json")
        body = json.dumps(_plain(document), indent=2, allow_nan=False)
        if path is not None:
            path.write_text(body + "\n", encoding="utf-8")
        if self.as_json:
            click.echo(body)
            return
        click.echo(text())
        for written in self.files:
            click.echo(f"wrote {written}")


def _plain(value: Any) -> Any:
    """The value for JSON; a number that is not finite becomes null, which a reader cannot mistake for one."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def loaded_scene(path: Path, without: Sequence[str]) -> Scene:
    """The scene of a file, the effects of the kinds `without` left out. **Raises** `InputError` for one that it has not."""
    from jaxvib.machine.files import load_scene  # slow to import, and --help needs none of it
    from jaxvib.machine.scene import Scene

    scene = load_scene(path)
    there = [effect.kind for effect in scene.effects]
    for kind in without:
        if kind not in there:
            raise InputError("--without", f"is {kind!r}; the scene's effects are: {', '.join(there) or 'none'}")
    kept = tuple(effect for effect in scene.effects if effect.kind not in without)
    return scene if len(kept) == len(there) else Scene(scene.machine, scene.loads, scene.drive, kept)


WITHOUT = click.option("--without", multiple=True, metavar="EFFECT", help="Leave out an effect of SCENE, such as gravity.")
"""The option of commands whose theories do not know every effect."""


def table(title: str, columns: list[str], rows: list[list[str]]) -> str:
    """Rows of text under a title and column heads, drawn with lines; the first column to the left, numbers to the right."""
    from rich.console import Console  # slow to import, and --json needs none of it
    from rich.table import Table

    drawn = Table(title=title, title_justify="left")
    for k, name in enumerate(columns):
        drawn.add_column(name, justify="left" if k == 0 else "right")
    for row in rows:
        drawn.add_row(*row)
    console = Console(width=118)
    with console.capture() as capture:
        console.print(drawn)
    return capture.get().rstrip()


_HOMES = {
    "audit": "study.audit",
    "capture": "study.capture",
    "cost": "study.cost",
    "identify": "study.identify",
    "reproduce": "study.reproduce",
    "stress": "study.stress",
    "whirl": "whirl",
    "criterion": "criterion",
    "modes": "modes",
    "new": "commands",
    "optimize": "optimize",
    "simulate": "commands",
}
"""The module of `jaxvib.cli` that holds each command."""


class _Lazy(click.Group):
    """Commands whose modules are imported when they are called, or when help lists them all."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(_HOMES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in _HOMES:
            importlib.import_module(f"jaxvib.cli.{_HOMES[cmd_name]}")
        return super().get_command(ctx, cmd_name)


@click.group(cls=_Lazy, context_settings={"help_option_names": ["-h", "--help"]}, no_args_is_help=True)
@click.version_option(package_name="jaxvib")
def app() -> None:
    """Simulate and design vibration machines that work on the Sommerfeld effect.

    Begin with: jaxvib new two-mass > machine.toml
    """


def shared(command: Callable[..., None]) -> Callable[..., None]:
    """Adds --json and --out to a command; it gets them as one `Output`."""

    @click.option("--json", "as_json", is_flag=True, help="Print one JSON document on stdout, nothing else.")
    @click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Write pictures and data into this folder.")
    def wrapped(as_json: bool, out: Path | None, **rest: Any) -> None:
        command(output=Output(as_json, out), **rest)

    wrapped.__name__ = command.__name__
    wrapped.__doc__ = command.__doc__
    # click keeps a command's own options on the function itself
    wrapped.__click_params__ = getattr(command, "__click_params__", []) + wrapped.__click_params__  # pyright: ignore
    return wrapped


def run(arguments: list[str]) -> int:
    """Runs a command line and gives its exit code: 0 done, 1 the computation failed, 2 bad input."""
    wants_json = "--json" in arguments
    try:
        # a command that computed all it was asked, and found a failure, exits by itself with its code
        return app.main(args=arguments, prog_name="jaxvib", standalone_mode=False) or 0
    except InputError as error:
        return _failed(wants_json, 2, {"kind": "input", "field": error.field, "message": str(error)})
    except ComputationError as error:
        return _failed(wants_json, 1, {"kind": "computation", "status": error.status, "message": str(error)})
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return 0
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except OSError as error:
        name = str(error.filename or "a file")
        message = f"{name} cannot be written or read ({error.strerror}); name another folder with --out"
        return _failed(wants_json, 2, {"kind": "input", "field": name, "message": message})
    except click.UsageError as error:
        field = error.ctx.command.name if error.ctx else "jaxvib"
        hint = f" (see: {error.ctx.command_path} --help)" if error.ctx else ""
        message = " ".join(error.format_message().split()) + hint
        return _failed(wants_json, 2, {"kind": "input", "field": field, "message": message})
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except (click.Abort, KeyboardInterrupt):
        return _failed(wants_json, 1, {"kind": "computation", "status": "interrupted", "message": "interrupted"})


def _failed(wants_json: bool, code: int, error: dict[str, Any]) -> int:
    click.echo(f"jaxvib: {error['message']}", err=True)
    if wants_json:
        click.echo(json.dumps({"error": error}, indent=2))
    return code
