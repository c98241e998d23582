"""Output of commands: text or JSON on stdout, files in a folder, a report."""

from __future__ import annotations

import contextlib
import json
import shlex
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import jaxvib as jv
from jaxvib.errors import InputError, quoted, written

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure

    from jaxvib.results.fields import Plain
    from jaxvib.results.result import Result


_COMMA = "jaxvib.decimal_comma"
"""Key of the value of --decimal-comma in the context of click."""

DECIMAL_COMMA = click.option(
    "--decimal-comma",
    is_flag=True,
    expose_value=False,
    callback=lambda context, _, value: context.meta.update({_COMMA: value}),
    help="Write decimal commas, and semicolons between columns, in the CSV file.",
)
"""Option of commands that write a CSV file, for `Output.csv` and `Output.table`."""


def csv_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of commands that have curves: --csv and --decimal-comma."""
    path = click.Path(path_type=Path, dir_okay=False)
    return click.option("--csv", type=path, help="Write the curves to this CSV file.")(DECIMAL_COMMA(command))


SECONDS_TO_FIRST_LINE = 10.0
"""Time until the first line of progress, s, if stderr is not a terminal. The time doubles from line to line."""

_MAX_SECONDS_BETWEEN_LINES = 600.0

_COMPUTING = "{}, {} (new programs are compiled once, then stored)"


def _is_compiling() -> bool:
    """Return True if a thread is compiling a program. The module is not imported here, in the thread that shows the time."""
    stored = sys.modules.get("jaxvib.runtime.stored")
    return stored is not None and hasattr(stored, "is_compiling") and stored.is_compiling()


def duration_text(seconds: float) -> str:
    """Return a duration in hours, minutes and seconds."""
    total = round(seconds)
    hours, rest = divmod(total, 3600)
    return f"{hours} h {rest // 60} min" if hours else f"{rest // 60} min {rest % 60} s" if rest >= 60 else f"{rest} s"


def fields_of(result: object, *names: str) -> dict[str, object]:
    """Return fields of a result by their names, for a document."""
    return {name: getattr(result, name) for name in names}


_NOTES = "jaxvib.notes"
"""Key of the printed notes in the context of click."""


TABLES = "jaxvib.tables"
"""Key in the context of click. Its value is the list to which `table` adds tables of the text of a report."""


def note(text: str) -> None:
    """Print a text on stderr, on a terminal in lines that fit, in place of the line of the elapsed time; reports contain it."""
    context = click.get_current_context(silent=True)
    if context is not None:
        context.meta.setdefault(_NOTES, []).append(text.removeprefix("note: "))
    click.echo(f"\r\x1b[K{_wrapped(text)}" if sys.stderr.isatty() else text, err=True)


def write_file(path: Path, text: str) -> None:
    """Write a text file; an existing file is replaced when the new one is complete."""
    with written(path) as part:
        part.write_text(text, encoding="utf-8", errors="replace")


_KEPT_LINES = '┏┃┡│└#["'
"""First characters of lines of tables and of design files, which are not broken."""


def _wrapped(text: str) -> str:
    """Return a text whose lines fit on the terminal and break between words. Continued lines are indented; tables and lines of
    files are kept."""
    columns = shutil.get_terminal_size().columns
    folded = []
    for line in text.splitlines():
        indent = line[: len(line) - len(line.lstrip())] + "    "
        options: dict[str, Any] = {"subsequent_indent": indent, "break_long_words": False, "break_on_hyphens": False}
        folded.append(line if len(line) <= columns or line[:1] in _KEPT_LINES else textwrap.fill(line, columns, **options))
    return "\n".join(folded)


class Output:
    """Output of a command: a JSON document or text on stdout, files in a folder, and a report as an HTML page.

    **Arguments**: `as_json`: True for JSON on stdout; `folder`: the folder of `--out`; `report`: the file of `--report`;
    `scene`: the scene file of the command; `title` and `author` of the report.
    """

    def __init__(
        self,
        as_json: bool,
        folder: Path | None,
        report: Path | None = None,
        scene: Path | None = None,
        *,
        title: str | None = None,
        author: str | None = None,
    ):
        self.as_json = as_json
        self.title = title
        self.author = author
        self._done = threading.Event()
        self._step = ""
        self.folder = folder
        self.report = report
        self.scene = scene
        self.files: list[str] = []
        self.figures: list[tuple[str, Figure]] = []
        if report is not None:
            if report.suffix.lower() not in (".html", ".htm"):
                raise InputError("--report", f"is {quoted(str(report))}; give a file name that ends in .html")
            self._make_folder(report.parent, "--report")
        if folder is not None:
            self._make_folder(folder, "--out")

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Show the elapsed time until the command prints something: on the last line of a terminal, from one second after the
        start; elsewhere in lines at increasing intervals, with the progress of the command."""
        show = self._show_elapsed_time if sys.stderr.isatty() else self._print_lines
        threading.Thread(target=show, daemon=True).start()
        try:
            yield
        finally:
            self.end_waiting()

    def end_waiting(self) -> None:
        """End the display of `waiting`. Commands with their own progress call this before they show it."""
        if not self._done.is_set():
            self._done.set()
            if sys.stderr.isatty():
                click.echo("\r\x1b[K", nl=False, err=True)

    @contextlib.contextmanager
    def progress(self) -> Iterator[Callable[[str, float], None]]:
        """Show a bar on a terminal, elsewhere the progress in the lines of `waiting`; the yielded function takes the name of a
        step and the finished share (0 to 1). "compiling, once" follows the bar while a program is compiled."""
        from rich.console import Console  # slow imports, which --help does not need
        from rich.progress import BarColumn, Progress, Task, TextColumn, TimeElapsedColumn
        from rich.text import Text

        if not sys.stderr.isatty():

            def store_step(what: str, share: float) -> None:
                self._step = f"{what}: {share:.0%}"

            yield store_step
            self._step = ""
            return

        class CompilingColumn(TextColumn):
            def render(self, task: Task) -> Text:
                return Text("compiling, once" if _is_compiling() else "")

        self.end_waiting()
        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), CompilingColumn(""))
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("", total=1.0)
            yield lambda what, share: bar.update(task, description=what, completed=share)

    def _show_elapsed_time(self) -> None:
        begin = time.monotonic()
        while not self._done.wait(1.0):
            text = _COMPUTING.format("compiling" if _is_compiling() else "computing", f"{time.monotonic() - begin:.0f} s")
            click.echo(f"\r\x1b[K{text}", nl=False, err=True)

    def _print_lines(self) -> None:
        begin, due = time.monotonic(), SECONDS_TO_FIRST_LINE
        while not self._done.wait(min(max(begin + due - time.monotonic(), 0.0), threading.TIMEOUT_MAX)):
            elapsed, compiling = duration_text(time.monotonic() - begin), _is_compiling()
            if self._step:
                text = f"{self._step}, {'compiling, once, ' if compiling else ''}after {elapsed}"
            else:
                text = _COMPUTING.format("compiling" if compiling else "computing", elapsed)
            click.echo(text, err=True)
            due += min(due, _MAX_SECONDS_BETWEEN_LINES)

    @staticmethod
    def _make_folder(folder: Path, option: str) -> None:
        """Create a folder. For --out and --report this is done before the computation, because a result that cannot be written
        would be lost."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(option, f"is {quoted(str(folder))}, which cannot be created ({error.strerror})") from error

    def file(self, name: str) -> Path | None:
        """Return the path of a result file, which is added to the list of written files; None without --out."""
        if self.folder is None:
            return None
        self.files.append(str(self.folder / name))
        return self.folder / name

    def save_result(self, name: str, result: Result) -> None:
        """Save a result to the file `name` if --out is used."""
        path = self.file(name)
        if path is not None:
            result.save(path)

    def main_file(self, name: str) -> Path:
        """Return the path of the main file of a command, in the folder of --out or in the current folder."""
        path = (self.folder or Path()) / name
        self.files.append(str(path))
        return path

    def figure(self, name: str, draw: Callable[[], Figure]) -> None:
        """Draw a figure, and save it to the file `name` (--out) and in the report (--report)."""
        path = self.file(name)
        if path is None and self.report is None:
            return
        figure = draw()
        if path is not None:
            with written(path) as part:
                figure.savefig(part)
        if self.report is not None:
            self.figures.append((Path(name).stem.replace("_", " "), figure))

    def csv(self, path: Path | None, result: Result, axis: str) -> None:
        """Write the values of a result along an axis, in display units, to the CSV file `path`; None writes nothing."""
        if path is None:
            return
        from jaxvib.results.csv import write_csv  # slow import, which --help does not need

        self._make_folder(path.parent, "--csv")
        write_csv(result, axis, path, display=True, decimal_comma=click.get_current_context().meta.get(_COMMA, False))
        self.files.append(str(path))

    def table(self, name: str, columns: Mapping[str, np.ndarray]) -> None:
        """Write columns by their headers to the CSV file `name` if --out is used."""
        path = self.file(name)
        if path is not None:
            from jaxvib.results.csv import write_table  # slow import, which --help does not need

            write_table(columns, path, decimal_comma=click.get_current_context().meta.get(_COMMA, False))

    def done(self, document: Mapping[str, object], text: Callable[[], str], name: str, result: Result | None = None) -> None:
        """Print the document or the text; write the document to NAME.json in the folder, and write the report.

        **Arguments**: `result`: the source of the values in the document; its fields define their units in the report.
        """
        self.end_waiting()
        path = self.file(f"{name}.json")
        from jaxvib.results.fields import plain  # slow import, which --help does not need

        values = {key: plain(value) for key, value in document.items()}
        body = json.dumps(values, indent=2, allow_nan=False)
        if path is not None:
            write_file(path, body + "\n")
        if self.report is not None:
            shown = {key: plain(value, infinity=True) for key, value in document.items()}
            self._write_report(self.report, shown, text, name, result)
        if self.as_json:
            click.echo(body)
            return
        click.echo(_wrapped(text()) if sys.stdout.isatty() else text())
        for name_of_file in self.files:
            click.echo(f"wrote {name_of_file}")

    def _write_report(
        self, path: Path, document: dict[str, Plain], text: Callable[[], str], name: str, result: Result | None
    ) -> None:
        from jaxvib.machine.files import load_scene
        from jaxvib.machine.scene import Scene
        from jaxvib.report.page import Report, units_of_document

        scene = getattr(result, "scene", None)
        if not isinstance(scene, Scene):
            scene = None if self.scene is None else load_scene(self.scene)
        draw_sketch = getattr(jv, "sketch", None)
        context = click.get_current_context()
        arguments = context.find_root().obj or [name]
        tables = context.meta[TABLES] = []
        text_with_marks = click.unstyle(text())  # without colours and bold print of the terminal
        del context.meta[TABLES]
        page = Report(
            title=self.title or name,
            author=self.author or "",
            command=shlex.join(["jaxvib", *arguments]),
            document=document,
            units=units_of_document(document, result),
            text=text_with_marks,
            tables=tables,
            scene=scene,
            sketch=None if scene is None or draw_sketch is None else draw_sketch(scene),
            figures=self.figures,
            notes=context.meta.get(_NOTES, ()),
        )
        write_file(path, page.html())
        self.files.append(str(path))
