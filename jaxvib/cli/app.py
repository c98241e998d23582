"""Group of all commands, and their common parts: scenes, options, tables, error messages, exit codes."""

from __future__ import annotations

import ast
import difflib
import functools
import importlib
import json
import re
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from jaxvib.cli.document import TypeWithUnit
from jaxvib.cli.output import TABLES, Output, note
from jaxvib.errors import ComputationError, InputError, legible, quoted

if TYPE_CHECKING:
    from jaxvib.machine.effects.base import Effect
    from jaxvib.machine.scene import Exciter, Scene
    from optimize import Quantity, ToleranceRange


def loaded_scene(path: Path, without: Sequence[str] = (), speed: str | None = None, *, constant: bool = False) -> Scene:
    """Load the scene of a file, and change its effects and its drive.

    **Arguments**: `path` of the file; `without`: kinds of effects to leave out; `speed`: constant rotor speed that replaces the
    drives; `constant`: True to replace a run-up by its final speed, with a message on stderr.

    **Raises** `InputError` for an effect that the scene does not have, and for a string that is not a speed.
    """
    from jaxvib.machine.drives.drive import ConstantSpeed  # slow imports, which --help does not need
    from jaxvib.machine.files import load_scene
    from jaxvib.machine.validation import implausible_numbers, start_notes

    scene = load_scene(path)
    if speed is not None:
        scene = _with_exciters(scene, lambda each: each.with_parts(each.loads, ConstantSpeed(speed), each.effects))
    elif constant:
        scene = _with_exciters(scene, _with_final_speed)
    kinds = [effect.kind for effect in scene.all_effects]
    for kind in without:
        if kind not in kinds:
            raise InputError("--without", f"is {quoted(kind)}; the scene's effects are: {', '.join(kinds) or 'none'}")
    scene = _without_effects(scene, without) if without else scene
    for each in (*implausible_numbers(scene), *start_notes(scene)):
        note(f"note: {each}")
    return scene


def _with_exciters(scene: Scene, change: Callable[[Exciter], Exciter]) -> Scene:
    """Return a scene whose exciters are changed by a function."""
    from jaxvib.machine.scene import Scene  # slow import, which --help does not need

    return Scene(scene.machine, exciters=[change(exciter) for exciter in scene.exciters], effects=scene.effects)


def _with_final_speed(exciter: Exciter) -> Exciter:
    """Return an exciter at a constant speed: a run-up is replaced by its final speed, with a message on stderr."""
    from jaxvib.display import speed_text  # slow imports, which --help does not need
    from jaxvib.machine.drives.drive import ConstantSpeed

    drive = exciter.drive
    if not drive.ideal or drive.constant:
        return exciter
    end = float(drive.speed)
    note(f"constant speed of {speed_text(end, 6)}: the final speed of the drive ({drive.kind})")
    return exciter.with_parts(exciter.loads, ConstantSpeed(end), exciter.effects)


def _without_effects(scene: Scene, kinds: Sequence[str]) -> Scene:
    """Return a scene without the effects of these kinds, both on the machine and on its exciters."""
    from jaxvib.machine.scene import Scene  # slow import, which --help does not need

    def remaining(effects: Sequence[Effect]) -> tuple[Effect, ...]:
        return tuple(effect for effect in effects if effect.kind not in kinds)

    exciters = [exciter.with_parts(exciter.loads, exciter.drive, remaining(exciter.effects)) for exciter in scene.exciters]
    return Scene(scene.machine, exciters=exciters, effects=remaining(scene.effects))


WITHOUT = click.option(
    "--without", multiple=True, metavar="EFFECT", help="Leave out an effect of SCENE, such as gravity; repeatable."
)
"""Option of commands that do not support every effect."""


SPEED_TYPE = TypeWithUnit("speed", "rpm", "rad/s")
"""Type of options that are speeds."""

SPEED = click.option("--speed", type=SPEED_TYPE, help="Constant rotor speed in place of the scene's drive, such as '1200 rpm'.")
"""Option of commands about motions at a constant rotor speed."""


TOLERANCE = click.option(
    "--tolerance",
    "tolerances",
    multiple=True,
    metavar="NAME=PERCENT",
    help="Show the ranges of the results for machines within this tolerance, such as stiffness=5%, damping=30%, "
    "material=0..20kg (on platform or body 1); repeatable.",
)
"""Option of commands that show ranges over machines within tolerances."""


def ranges_within(scene: Scene, modes: Sequence[int] | None, tolerances: Sequence[str]) -> list[ToleranceRange]:
    """Return the ranges of speed, motion and forces in jam modes, or in the working regime if `modes` is None."""
    if not tolerances:
        return []
    from optimize import tolerance_ranges

    groups = [_quantities_of_regime(scene)] if modes is None else [_quantities_of_jam(scene, mode) for mode in modes]
    return tolerance_ranges(scene, [quantity for group in groups for quantity in group], list(tolerances))


def _quantities_of_regime(scene: Scene) -> list[Quantity]:
    """Return the quantities of the working regime: of a body in a plane, the throw at the points of the option --deck."""
    from jaxvib.cli.document import deck_of_options
    from optimize import foundation_force, throw_angle, throw_number, throw_stroke
    from optimize.quantities.exciters import working_amplitude, working_speed

    if scene.machine.places != "plane":
        count = len(scene.machine.structure().coordinates)
        return [working_speed(), *(working_amplitude(scene, k) for k in range(count)), foundation_force()]
    deck = deck_of_options()
    slope = deck.get("slope", 0.0)
    points = deck.get("at", [(0.0, 0.0)])
    throws = [q for at in points for q in (throw_stroke(at=at), throw_angle(at=at), throw_number(at=at, slope=slope))]
    return [working_speed(), *throws, foundation_force()]


def _quantities_of_jam(scene: Scene, mode: int) -> list[Quantity]:
    """Return the quantities of a jam mode: speed, strokes, forces and torque."""
    from jaxvib.machine.structures.platforms import Platforms
    from optimize import foundation_force, jam_frequency, shaft_torque, stroke, support_load

    machine = scene.machine
    strokes = [stroke(mode=mode, of=k + 1) for k in range(len(machine.structure().coordinates))]
    supports = [k + 1 for k, each in enumerate(machine.stiffness) if each > 0.0] if isinstance(machine, Platforms) else []
    loads = [support_load(mode=mode, of=k) for k in supports]
    return [jam_frequency(mode=mode), *strokes, *loads, foundation_force(mode=mode), shaft_torque(mode=mode)]


def require_tolerances(scene: Scene, tolerances: Sequence[str]) -> None:
    """**Raises** `InputError` for tolerances that a scene cannot have. Commands call this before a long computation."""
    if tolerances:
        from optimize.tolerance import read_tolerances  # slow import, which --help does not need

        read_tolerances(scene, tolerances)


def tolerance_table(ranges: Sequence[ToleranceRange], tolerances: Sequence[str]) -> str:
    """Return the ranges of quantities over machines within tolerances as a table."""
    from jaxvib.display import shown_unit

    rows = []
    for entry in ranges:
        unit, factor = shown_unit(entry.unit, max(abs(entry.design), abs(entry.high)))
        span, words = (entry.low, entry.high), entry.words
        if words.startswith("negative "):  # a quantity that is maximized
            factor, span, words = -factor, span[::-1], words.removeprefix("negative ")
        values = [f"{factor * x:.4g}" for x in (entry.design, *span, entry.worst)]
        rows.append([f"{words}, {unit}".rstrip(", "), *values, f"{100.0 * entry.share:.3g} %"])
    head = ["leading order", "design", "95 % from", "to", "worst", "machines where it exists, or the demand is met"]
    worst = "worst: the largest value (the smallest if it is maximized or has a lower limit)"
    return "\n".join([table(f"machines with {', '.join(tolerances)}", head, rows), worst])


def table(title: str, columns: list[str], rows: list[list[str]]) -> str:
    """Return a table with a title, column headers and lines; the first column is aligned to the left, the others to the right.

    Empty columns are omitted. The table fits into a terminal of 80 columns; longer headers and texts continue on a new line.
    For a report, return a mark that stands for the table.
    """
    shown_columns = [k for k in range(len(columns)) if not rows or any(row[k] for row in rows)]
    context = click.get_current_context(silent=True)
    if context is not None and TABLES in context.meta:
        from jaxvib.report.tables import TextTable, mark_of  # slow import, which is needed for reports only

        tables = context.meta[TABLES]
        tables.append(TextTable(title, [columns[k] for k in shown_columns], [[row[k] for k in shown_columns] for row in rows]))
        return mark_of(len(tables) - 1)
    from rich.console import Console  # slow import, which --json does not need
    from rich.table import Table

    rich_table = Table()
    for k in shown_columns:
        rich_table.add_column(columns[k], justify="left" if k == 0 else "right", overflow="fold")
    for row in rows:
        rich_table.add_row(*(row[k] for k in shown_columns))
    console = Console(width=80)
    with console.capture() as capture:
        console.print(rich_table)
    return f"{textwrap.fill(title, 80)}\n{capture.get().rstrip()}"


_GROUPS = {
    "To begin": {"new": "commands", "describe": "describe", "sketch": "animate", "explore": "explore"},
    "Steady states": {
        "modes": "modes",
        "criterion": "criterion",
        "balance": "criterion",
        "whirl": "whirl",
        "response": "motion.response",
        "regimes": "motion.regimes",
        "stability-map": "motion.stability",
        "onset": "motion.stability",
    },
    "Motion in time": {
        "simulate": "commands",
        "settle": "motion.settle",
        "envelope": "motion.settle",
        "run-up": "motion.run_up",
        "run-up-map": "motion.run_up",
        "growth": "motion.settle",
        "capture": "study.capture",
        "animate": "animate",
    },
    "Design and studies": {
        "optimize": "optimize",
        "sweep": "study.sweep",
        "show": "study.sweep",
        "record": "study.record",
        "identify": "study.identify",
        "plan": "study.plan",
    },
    "Accuracy": {"cost": "study.cost", "audit": "study.audit"},
    "Other tools": {"export": "export"},
}
"""Commands by purpose, each with the module of `jaxvib.cli` that contains it."""

_MODULES = {name: home for group in _GROUPS.values() for name, home in group.items()}

_ARGUMENTS = {
    "scene": "a scene file, such as `jaxvib new two-mass > machine.toml` makes",
    "design": "a design file, such as `jaxvib new design > design.toml` makes",
    "study": "a study file, such as `jaxvib new sweep > study.toml` makes",
    "identification": "an identification file, such as `jaxvib new identification > fit.toml` makes",
    "recording": "a file of a recorder, such as run_up.csv",
    "source": "a scene file, or a run.npz that `jaxvib simulate` saved",
}
"""Descriptions of the arguments of commands, for messages about missing arguments."""


class _LazyGroup(click.Group):
    """Group of commands whose modules are imported when a command is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(_MODULES)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands with their summaries. The summaries are read from the source files, because an import of all
        modules would take a second."""
        widest = max(map(len, _MODULES))
        for title, group in _GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(widest), _first_line(name)) for name in group])

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in _MODULES:
            importlib.import_module(f"jaxvib.cli.{_MODULES[cmd_name]}")
        return super().get_command(ctx, cmd_name)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command of the first argument. **Raises** a usage error that suggests a similar name."""
        if args and not args[0].startswith("-") and args[0] not in _MODULES:
            ctx.fail(f"No such command {quoted(args[0])}.{_similar(args[0], list(_MODULES))}")
        return super().resolve_command(ctx, args)


def _similar(name: str, allowed: Sequence[str]) -> str:
    """Return a sentence with the most similar allowed name; an empty text if none is similar."""
    near = difflib.get_close_matches(name, allowed, n=1, cutoff=0.5)
    return f" Did you mean {near[0]!r}?" if near else ""


def _first_line(name: str) -> str:
    """Return the first sentence of a command's docstring, up to a full stop or semicolon."""
    source = Path(__file__).parent.joinpath(*_MODULES[name].split(".")).with_suffix(".py").read_text(encoding="utf-8")
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef) and any(_is_command(decorator, name) for decorator in node.decorator_list):
            return " ".join(re.split(r"[.;](?=\s|$)", ast.get_docstring(node) or "", maxsplit=1)[0].split())
    return ""


def _is_command(decorator: ast.expr, name: str) -> bool:
    return isinstance(decorator, ast.Call) and name in [x.value for x in decorator.args if isinstance(x, ast.Constant)]


@click.group(
    cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "show_default": True}, no_args_is_help=True
)
@click.version_option(package_name="jaxvib")
def app() -> None:
    """Simulate and design vibration machines that work on the Sommerfeld effect.

    Begin with: jaxvib new two-mass > machine.toml (or linear-screen, feeder, rotor: see jaxvib new --help)

    In the help of a command, the text in square brackets after the description of an option is its default.
    """


_COMMON_OPTIONS = (
    click.Option(["--json", "as_json"], is_flag=True, help="Print only one JSON document on stdout."),
    click.Option(["--out"], type=click.Path(path_type=Path, file_okay=False), help="Write figures and data into this folder."),
    click.Option(
        ["--report"],
        type=click.Path(path_type=Path, dir_okay=False),
        help="Write a report with inputs, results and figures to this file (.html).",
    ),
    click.Option(["--title"], help="Title of the report [name of the command and of its file]."),
    click.Option(["--author"], help="Author of the report."),
    click.Option(
        ["--unit"],
        type=click.Choice(["rpm", "Hz", "rad/s", "SI"], case_sensitive=False),
        default="rpm",
        help="Unit of speeds; SI: all numbers in SI units. JSON documents are always in SI units.",
    ),
)


def command(
    name: str, source: str | None = "scene", *, required: bool = True, **settings: Any
) -> Callable[[Callable[..., None]], click.Command]:
    """Declare a command with the path of its main file as its first argument, and the options --json, --out, --report, --title,
    --author and --unit, which it receives as an `Output`.

    **Arguments**: `name` of the command; `source`: name of the argument of the main file, None for a command without one;
    `required`: False if the file can be omitted; `settings` of `click.Command`.
    """

    def declare(function: Callable[..., None]) -> click.Command:
        @functools.wraps(function)  # also copies the command's own options, which click stores on the function
        def run_command(
            as_json: bool, out: Path | None, report: Path | None, title: str | None, author: str | None, unit: str, **rest: Any
        ) -> None:
            from jaxvib.display import display_units  # slow import, which --help does not need

            display_units(speed="rad/s" if unit == "SI" else unit, si=unit == "SI")  # pyright: ignore[reportArgumentType]
            path = rest.get(source or "")
            for option, value in (("--title", title), ("--author", author)):
                if value is not None and report is None:
                    raise InputError(option, "is used only with --report; add --report FILE.html")
            heading = title if title or path is None else f"{name}: {path.stem}"
            output = Output(as_json, out, report, rest.get("scene"), title=heading, author=author)
            with output.waiting():
                function(output=output, **rest)

        made = app.command(name, **settings)(run_command)
        if source is not None:
            made.params.insert(0, click.Argument([source], type=click.Path(path_type=Path), required=required))
        made.params += _COMMON_OPTIONS
        return made

    return declare


_NO_ARGUMENTS: type[click.UsageError] | tuple[()] = getattr(click.exceptions, "NoArgsIsHelpError", ())
"""Exception with the help text of a command without arguments; click before 8.2 prints this text without an exception."""


def run(arguments: list[str]) -> int:
    """Run a command line and return its exit code: 0 for success, 1 for a failed computation, 2 for bad input."""
    wants_json = "--json" in arguments
    try:
        # a command whose result is a failure exits with its own code
        return app.main(args=arguments, prog_name="jaxvib", standalone_mode=False, obj=tuple(arguments)) or 0
    except InputError as error:
        error = _with_option_names(arguments, error)
        message = f"{error}{remedy_hint(arguments, error)}"
        return _report_error(wants_json, 2, {"kind": "input", "field": error.field, "message": message})
    except ComputationError as error:
        return _report_error(wants_json, 1, {"kind": "computation", "status": error.status, "message": str(error)})
    except _NO_ARGUMENTS as error:
        click.echo(error.format_message())
        return 0
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except OSError as error:
        name = str(error.filename or "a file")
        message = f"{name} cannot be written or read ({error.strerror}); give another folder with --out"
        return _report_error(wants_json, 2, {"kind": "input", "field": name, "message": message})
    except click.UsageError as error:
        field = error.ctx.command.name if error.ctx else "jaxvib"
        hint = f" (see: {error.ctx.command_path} --help)" if error.ctx else ""
        message = " ".join(error.format_message().split())
        if isinstance(error, click.BadParameter) and error.param is not None and isinstance(error.param.type, click.Choice):
            wrong = re.search(r"'(.*?)' is not one of", message)
            message += "" if wrong is None else _similar(wrong[1], list(map(str, error.param.type.choices)))
        if isinstance(error, click.MissingParameter) and error.param is not None:
            description = getattr(error.param, "help", None) or _ARGUMENTS.get(error.param.name or "", "")
            message = f"{message.rstrip('.')}: {description.rstrip('.')}" if description else message
        message += _repeat_hint(arguments, error) + hint
        return _report_error(wants_json, 2, {"kind": "input", "field": field, "message": message})
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except (click.Abort, KeyboardInterrupt):
        return _report_error(wants_json, 1, {"kind": "computation", "status": "interrupted", "message": "interrupted"})


def _repeat_hint(arguments: list[str], error: click.UsageError) -> str:
    """Return a hint for surplus values of a repeatable option, which click reads as arguments; "" for other errors."""
    options = error.ctx.command.params if error.ctx and "unexpected extra" in error.format_message() else []
    names = [option.opts[-1] for option in options if isinstance(option, click.Option) and option.multiple]
    used = [name for name in names if name in arguments]
    return f"; repeat the option for each value: {used[0]} ... {used[0]} ..." if used else ""


def _parameters(arguments: Sequence[str]) -> list[click.Parameter]:
    """Return the arguments and options of the command in a command line."""
    called = app.commands.get(arguments[0]) if arguments else None
    return [] if called is None else called.params


def _with_option_names(arguments: list[str], error: InputError) -> InputError:
    """Return an error with the names of options of the command line in place of the arguments of a function."""
    names = {each.name: each.opts[-1] for each in _parameters(arguments) if isinstance(each, click.Option)}
    field, problem = names.get(error.field, error.field), error.problem
    if field == "drive.speed" and "--speed" in arguments:
        field = "--speed"
    for name, option in names.items():
        problem = re.sub(rf"(?<![\w.]){name}=('?)([\w. ]+)\1", rf"{option} \2", problem)
    return InputError(field, problem)


def remedy_hint(arguments: Sequence[str], error: InputError) -> str:
    """Return a hint to the option that removes an unsupported effect or replaces an unsupported drive; "" for other errors."""
    table, _, name = error.field.partition(".")
    options = [each.name for each in _parameters(arguments)]
    if table == "effects" and name.isidentifier() and "without" in options:
        return f" (--without {name})"
    return " (--speed gives one)" if table == "drive" and name in ("", "kind") and "speed" in options else ""


def _report_error(wants_json: bool, code: int, error: dict[str, str | None]) -> int:
    """Print an error on stderr, with --json also on stdout, and return the exit `code`."""
    note("\n".join(map(legible, f"jaxvib: {error['message']}".splitlines())))
    if wants_json:
        click.echo(json.dumps({"error": error}, indent=2))
    return code
