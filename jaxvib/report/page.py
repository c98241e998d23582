"""Report of a result as one web page: command, results, figures, machine, all numbers, versions."""

from __future__ import annotations

import base64
import dataclasses
import datetime
import io
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Figure
from jaxvib.errors import written
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.regime import Regime
from jaxvib.report.tables import (
    COMPLEX,
    TextTable,
    Units,
    accuracy_table,
    escaped,
    in_display_units,
    parameter_tables,
    result_tables,
    text_with_tables,
)
from jaxvib.results.fields import Plain, as_dict
from jaxvib.results.result import Result
from jaxvib.steady.measures import VibrationMeasures

_LIBRARIES = ("jaxvib", "jax", "jaxlib", "equinox", "diffrax", "optimistix", "numpy")


@dataclass
class Report:
    """Contents of a page.

    **Arguments**: `title`; `document`: the result as plain values; `units` of its numbers, by name; `command`: the command line
    that computed the result; `text`: the result as printed on the terminal, with marks in place of its `tables`; `scene` of the
    result, and a `sketch` of the scene; `figures`: pairs of a name and a figure; `author`; `notes`: sentences about input and
    results that are probably wrong.
    """

    title: str
    document: Mapping[str, Plain]
    units: Units = field(default_factory=dict)
    command: str = ""
    text: str = ""
    scene: Scene | None = None
    figures: Sequence[tuple[str, Figure]] = ()
    sketch: Figure | None = None
    author: str = ""
    notes: Sequence[str] = ()
    tables: Sequence[TextTable] = ()

    def html(self) -> str:
        """Return the page as HTML with embedded style and figures. The page loads nothing from a network; all text is
        escaped."""
        parts = [f"<h1>{escaped(self.title)}</h1>"]
        if self.author:
            parts.append(f"<p>{escaped(self.author)}</p>")
        if self.command:
            parts.append(f'<p class="command"><code>{escaped(self.command)}</code></p>')
        coordinate_units = () if self.scene is None else self.scene.machine.structure().units
        document, units = in_display_units(self.document, self.units, coordinate_units)
        tables = result_tables(document, units, has_text=bool(self.text), tables=self.tables)
        numbers = [_section("Accuracy", accuracy_table(document, units)), _section("Numbers", tables)]
        parts.append(_section("Notes", "".join(f"<p>{escaped(each)}</p>" for each in self.notes)))
        if self.text:
            parts.append(_section("Results", text_with_tables(self.text, self.tables)))
        parts.append(_section("Figures", "".join(_figure(name, figure) for name, figure in self.figures)))
        if not self.text:
            parts += numbers
        if self.scene is not None:
            sketch = "" if self.sketch is None else _figure("sketch", self.sketch)
            parts += [_section("Machine", sketch + parameter_tables(self.scene))]
        if self.text:
            parts.append(f"<details><summary>All numbers</summary>{''.join(numbers)}</details>")
        parts.append(_section("Made with", _versions()))
        return _PAGE.format(title=escaped(self.title), style=_STYLE, body="\n".join(filter(None, parts)))


@validated
def html_report(
    result: Result,
    path: str | Path,
    *,
    title: str = "",
    author: str = "",
    scene: Scene | None = None,
    figures: Sequence[tuple[str, Figure]] | None = None,
) -> Path:
    """Write a result as one web page: numbers with units, figures, machine, accuracy of the result, versions.

    The page loads nothing from a network, and can be read on a phone and printed.

    **Arguments**

    - `result` of any kind
    - `path` of the file, which is overwritten
    - `title` of the page; default: the name of the class of the result
    - `author` of the report; default: none
    - `scene` whose parameters are listed; default: the scene of the result if it has one
    - `figures`: pairs of a name and a matplotlib figure; default: the figure of the result's method `plot`

    **Returns** the path. **Raises** `InputError` for an object that is not a result, and for a path that cannot be written to.

    >>> import pathlib, tempfile, jaxvib as jv
    >>> scene = jv.Scene(jv.planar_rotor(mass=20.0, stiffness=4e4, damping=60.0),
    ...                  jv.balls(count=2, mass=0.4, radius=0.08, drag=0.5), jv.ConstantSpeed(60.0))
    >>> path = jv.html_report(jv.critical_speeds(scene), pathlib.Path(tempfile.mkdtemp()) / "report.html", scene=scene)
    >>> "<!doctype html>" in path.read_text()
    True
    """
    kind, path = type(result).__name__, Path(path)
    own_scene = getattr(result, "scene", None)
    if scene is None and isinstance(own_scene, Scene):
        scene = own_scene
    named_figures = [(kind, result.plot())] if figures is None else figures
    document = as_dict(result, infinity=True)
    page = Report(title or kind, document, units_of(result), "", result.summary(), scene, named_figures, author=author)
    with written(path) as part:
        part.write_text(page.html(), encoding="utf-8", errors="replace")
    return path


def units_of_document(document: Mapping[str, Plain], result: eqx.Module | None) -> dict[str, str]:
    """Return the units of the numbers in the document of a command, by name: those of its `result`, of measures of vibrations,
    and of numbers that commands add."""
    units = {} if result is None else units_of(result)
    units |= {"natural_frequencies": "rad/s", "rotor_speed": "rad/s", "largest_displacement": "m or rad", "largest_force": "N"}
    units |= {"largest_displacement_time": "s", "largest_force_time": "s"}
    units |= {"growth_of_free_loads": "1/s", "drag": "N s/m", "exact_up_to": "rad/s", "exact_balancing": "rad/s"}
    units.setdefault("phases", "rad")
    if "regime" in document:
        units = {each.name: each.metadata.get("unit", "") for each in dataclasses.fields(Regime)} | units
    if document.get("stays"):
        units |= {"speed": "rad/s", "start": "s", "end": "s", "resonance_speed": "rad/s"}
    rows = [row for value in document.values() if isinstance(value, list) for row in value if isinstance(row, Mapping)]
    if any("measures" in each for each in (document, *rows)):
        of_measures = {each.name: each.metadata.get("unit", "") for each in dataclasses.fields(VibrationMeasures)}
        units |= {name: unit for name, unit in of_measures.items() if unit}
    return units


def units_of(result: eqx.Module) -> dict[str, str]:
    """Return the units of the numbers of a result and of its parts, by the names of their fields; those of complex numbers end
    in `COMPLEX`."""
    units: dict[str, str] = {}
    for field_of_result in dataclasses.fields(result):
        value = getattr(result, field_of_result.name)
        if field_of_result.metadata.get("unit"):
            mark = COMPLEX if np.iscomplexobj(value) else ""
            units.setdefault(field_of_result.name, f"{field_of_result.metadata['unit']}{mark}")
        elif "part" in field_of_result.metadata and isinstance(value, eqx.Module):
            for name, unit in units_of(value).items():
                units.setdefault(name, unit)
    return units


def _section(title: str, body: str) -> str:
    return f"<section><h2>{escaped(title)}</h2>{body}</section>" if body else ""


def _figure(name: str, figure: Figure) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png")
    text = base64.b64encode(data.getvalue()).decode("ascii")
    image = f'<img alt="{escaped(name)}" src="data:image/png;base64,{text}">'
    return f"<figure>{image}<figcaption>{escaped(name)}</figcaption></figure>"


def _versions() -> str:
    versions = []
    for name in _LIBRARIES:
        try:
            versions.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    time_text = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    platform_text = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    return f"<p>{escaped(', '.join([*versions, platform_text]))}</p><p>{escaped(time_text)}</p>"


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
{body}
</body>
</html>
"""

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1c2430; background: #fff; }
body { max-width: 60rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; margin: 0.5rem 0; }
h2 { font-size: 1.2rem; margin: 2rem 0 0.5rem; border-bottom: 2px solid #1f5aa6; }
h3 { font-size: 1rem; margin: 1.2rem 0 0.3rem; }
.command { color: #555; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 0.3rem 0; }
th, td { padding: 0.2rem 0.7rem 0.2rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid #ddd; }
th { font-weight: 600; }
td.n, th.n { text-align: right; white-space: nowrap; }
td.unit { color: #555; white-space: nowrap; }
td.below { color: #555; padding-left: 1.5rem; }
figure { margin: 1rem 0; break-inside: avoid; }
figure img { max-width: 100%; height: auto; }
figcaption { color: #555; font-size: 0.9rem; }
pre { overflow-x: auto; font-size: 0.75rem; line-height: 1.25; white-space: pre-wrap; }
details { margin-top: 2rem; }
summary { cursor: pointer; }
@media screen and (max-width: 45rem) { pre { font-size: min(0.75rem, 1.9vw); } }
@page { margin: 18mm; }
@media print {
  body { font-size: 10pt; max-width: none; padding: 0; }
  .wide { overflow: visible; }
  table { font-size: 8pt; }
  tr, figure { break-inside: avoid; }
  figure img { max-height: 19cm; }
  h2, h3 { break-after: avoid; }
  details { display: none; }
}
"""
