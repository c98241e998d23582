"""Universal files (UFF, UNV) of modal analysis, written and read by the package pyuff.

A machine is represented by nodes: its platforms, points on a rotor's axis, or points of bodies in a plane. The direction +X is
along the axis, +Y horizontal, +Z up.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxvib.boundary import validated, with_known_names
from jaxvib.equations.linear import estimated_frequencies, linear_model
from jaxvib.errors import InputError, open_regular, optional_module, quoted, require_one_of, require_writable, written
from jaxvib.exchange.state_space import state_space
from jaxvib.machine.carrier import Place, on_body
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import SupportForce
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.motion.run import Run
from jaxvib.units import Number, Numbers, numbers

Quantity = Literal["displacement", "velocity", "acceleration"]

_ORDERS: dict[str, tuple[int, str]] = {"displacement": (8, "m"), "velocity": (11, "m/s"), "acceleration": (12, "m/s^2")}
"""Specific data types of the format, and units, of displacements, velocities and accelerations."""

_FORCE, _REACTION, _TIME, _FREQUENCY = 13, 9, 17, 18
_HISTORY, _RESPONSE, _GENERAL = 1, 4, 0
_KINDS: Mapping[int, Literal["history", "response"]] = {_HISTORY: "history", _RESPONSE: "response"}
_EXPONENTS = {8: (1, 0), 11: (1, 0), 12: (1, 0), 9: (0, 1), 13: (0, 1), 15: (-2, 1), 16: (-1, 1)}
"""Exponents of length and force in the unit of a quantity, by its specific data type."""

_LINES = 2048
"""Default number of frequencies."""

_HIGHEST_FREQUENCY_RATIO = 1.5
"""Highest default frequency, relative to the highest natural frequency."""

_DIGITS = 5
"""Number of significant digits of the default spacing of frequencies. Numbers of the abscissa have 6 digits in a file."""

_MAX_UNEVEN = 1e-6
"""Largest difference of two steps of even frequencies or times, relative to the largest of the frequencies or times."""

_MAX_BYTES = 2**28
_TAIL = 200
"""Number of bytes at the end of a file that are examined for the end of its last dataset."""


class _Node(NamedTuple):
    """Node of a machine: `number`; `position` (x, y, z), m; `rows`: the matrix from coordinates to displacements of the
    node."""

    number: int
    position: tuple[float, float, float]
    rows: np.ndarray


@with_known_names
class UffFunction(NamedTuple):
    """Function of a universal file.

    Returned by `read_uff` in `UffFile.functions`.

    **Attributes**

    - `kind`: "history", "response" (frequency response function) or "other"
    - `x` (n,), s or Hz, and `values` (n,), real or complex, in SI
    - `quantity` such as "acceleration", "" if the file does not state it
    - `response` and `reference`: node and direction of the response and of the force; 1 to 3 are +X to +Z, 4 to 6 rotations
      about +X to +Z, negative numbers the opposite directions
    - `about`: the first line of the description of the function in the file
    """

    kind: Literal["history", "response", "other"]
    x: np.ndarray
    values: np.ndarray
    quantity: str
    response: tuple[int, int]
    reference: tuple[int, int]
    about: str


@with_known_names
class UffFile(NamedTuple):
    """Contents of a universal file: `functions`; `nodes`, the position (x, y, z) in m of each node by its number.

    Returned by `read_uff`.
    """

    functions: tuple[UffFunction, ...]
    nodes: dict[int, tuple[float, float, float]]


@validated
def export_uff(
    source: Scene | Run,
    path: str | Path,
    *,
    quantity: Quantity = "displacement",
    frequencies: Numbers | None = None,
    rotor_speed: Number | None = None,
) -> Path:
    """Write a universal file of a scene or of a run, with the datasets 15, 55, 58, 82, 151 and 164.

    - Frequency responses of a `Scene` at evenly spaced frequencies: one function for each pair of a response (node and
      direction) and a force (exciter and direction)
    - Natural modes of a `Scene`: undamped (normal modes) for machines that move up and down; damped, at the rotor speed
      (complex modes, the whirl), for machines that move horizontally and vertically
    - Histories of a `Run`: the motion of every node and the force on the foundation (node 0; not of a machine from matrices
      without a foundation), and the amplitude spectra at the end of the run

    Modes and responses are those of small vibrations: they include only the linear parts of nonlinear supports. In this case
    the description of the machine in the file states this.

    Header, units (SI), nodes and lines come first, because programs for modal analysis reject functions without them. Numbers
    have 12 digits; those of the abscissa and of mode shapes have 6 digits, as the format prescribes.

    **Arguments**

    - `source`: a `Scene` or a `Run`
    - `path` of the file, which is overwritten
    - `quantity` of responses and histories: "displacement" (the default), "velocity" or "acceleration"
    - `frequencies`, Hz, evenly spaced; typical: 1000 to 4000 frequencies up to 50 Hz; default: 2048 frequencies up to 1.5 times
      the highest natural frequency
    - `rotor_speed`, rad/s, as in `state_space`; typical: 0 to 500

    **Returns** the path. **Raises** `InputError` for frequencies that are not evenly spaced or not positive, for accelerations
    of a run, which are not stored, for `frequencies` or `rotor_speed` of a run, and for a path that cannot be written to.

    >>> import pathlib, tempfile, numpy as np, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "machine.uff"
    >>> jv.export_uff(scene, path, frequencies=np.linspace(0.1, 20.0, 200)).name
    'machine.uff'
    """
    path = Path(path)
    require_writable(path)
    require_one_of(quantity, _ORDERS, "quantity")
    if isinstance(source, Scene):
        scene = validate_scene(source)
        content = [*_modes(scene, rotor_speed), *_responses(scene, quantity, frequencies, rotor_speed)]
    else:
        scene_options = {"frequencies": frequencies, "rotor_speed": rotor_speed}
        for name, value in scene_options.items():
            if value is not None:
                raise InputError(name, f"is {quoted(value)}, which is an option for a scene, not for a run; leave it out")
        if quantity == "acceleration":
            raise InputError("quantity", "is 'acceleration', which a run does not save; use 'displacement' or 'velocity'")
        scene, content = source.scene, _histories(source, quantity)
    head = _head(scene, path, is_linearized=isinstance(source, Scene) and has_term(scene.all_effects, SupportForce))
    pyuff = optional_module("pyuff", "uff")
    with written(path) as part:
        part.touch()  # raises an error that pyuff would hide
        pyuff.UFF(str(part)).write_sets([*head, *content], mode="overwrite")
    return path


def _nodes(scene: Scene) -> list[_Node]:
    """Return the nodes of a machine; points that always have the same motion form one node."""
    nodes: dict[bytes, _Node] = {}
    for place, position in _places(scene):
        rows = np.asarray(scene.machine.rows_at(place))
        nodes.setdefault(rows.tobytes(), _Node(len(nodes) + 1, position, rows))
    return list(nodes.values())


def _places(scene: Scene) -> list[tuple[Place, tuple[float, float, float]]]:
    """Return the places of the nodes and their positions (x, y, z), m."""
    machine, exciters = scene.machine, scene.exciters
    if machine.places == "platform":
        return [(k + 1, (float(k), 0.0, 0.0)) for k in range(machine.structure().mass.shape[0])]
    if machine.places == "number":
        return [(k, (float(k), 0.0, 0.0)) for k in sorted({item.at if isinstance(item.at, int) else 1 for item in exciters})]
    if machine.places == "shaft":
        distances = [position for position, *_ in machine.shaft_supports() or []]
        for item in exciters:
            mount = machine.mount(item.place)
            distances += np.asarray(mount.distances(1 if item.loads is None else item.loads.count)).tolist()
        dtype = machine.structure().mass.dtype
        return [(jnp.asarray(s, dtype), (s, 0.0, 0.0)) for s in sorted({0.0, *distances})]
    if machine.places == "plane":
        points: list[tuple[Any, int]] = [(None, body) for body in range(machine.body_count)]
        for item in machine.supports:  # pyright: ignore[reportAttributeAccessIssue]
            points += [(item.at, item.body)] + ([] if item.to is None else [(item.at_other, item.to)])
        points += [(item.at, item.body) for item in exciters]
        return [
            (on_body(at, body), (0.0, 0.0, 0.0) if at is None else (0.0, float(at[0]), float(at[1]))) for at, body in points
        ]
    return [(None, (0.0, 0.0, 0.0))]


def _directions(scene: Scene) -> list[int]:
    """Return the numbers of the directions of a node's rows: 2 (+Y) horizontal, 3 (+Z) up."""
    return [2 + axis for axis in scene.machine.mounting(scene.exciters[0].place).axes]


def _head(scene: Scene, path: Path, *, is_linearized: bool) -> list[dict[str, Any]]:
    """Return header, units, nodes and the line through them; `is_linearized`: the header names nonlinear supports."""
    nodes = _nodes(scene)
    name = "".join(letter if letter.isprintable() and letter.isascii() else "_" for letter in path.stem)[:80]
    kind = scene.machine.kind + ", linear parts of its nonlinear supports" * is_linearized
    return [
        {"type": 151, "model_name": name, "description": kind, "db_app": "jaxvib", "program": "jaxvib"},
        {"type": 164, "units_code": 1, "units_description": "SI", "temp_mode": 1}
        | {"length": 1.0, "force": 1.0, "temp": 1.0, "temp_offset": 273.15},
        {"type": 15, "node_nums": [node.number for node in nodes]}
        | {axis: [node.position[k] for node in nodes] for k, axis in enumerate("xyz")},
        {"type": 82, "trace_num": 1, "id": "machine", "nodes": np.array([node.number for node in nodes])},
    ]


def _modes(scene: Scene, rotor_speed: Number | None) -> list[dict[str, Any]]:
    """Return the natural modes at the nodes, one dataset 55 for each."""
    nodes, directions = _nodes(scene), _directions(scene)
    numbers_ = [node.number for node in nodes]

    def at_nodes(shape: np.ndarray) -> dict[str, np.ndarray]:
        displacements = np.array([node.rows @ shape for node in nodes]).T
        by_direction = {f"r{k}": np.zeros(len(nodes), displacements.dtype) for k in (1, 2, 3)}
        return by_direction | {f"r{direction}": displacements[k] for k, direction in enumerate(directions)}

    common = {"type": 55, "model_type": 1, "data_ch": 2, "spec_data_type": 8, "load_case": 1, "node_nums": numbers_}
    if len(directions) == 1:
        frequencies, shapes = (np.asarray(x) for x in linear_model(scene).modes())
        return [
            {**common, **at_nodes(shape), "analysis_type": 2, "mode_n": k, "freq": w / (2.0 * np.pi), "modal_m": 1.0}
            for k, (w, shape) in enumerate(zip(frequencies, shapes.T, strict=True), 1)
        ]
    values, vectors = np.linalg.eig(state_space(scene, rotor_speed=rotor_speed).A.astype(complex))
    order = [k for k in np.argsort(np.imag(values)) if np.imag(values[k]) > 0.0]
    nd = len(values) // 2
    return [
        {
            **common,
            **at_nodes(vectors[:nd, k] / np.max(np.abs(vectors[:nd, k]))),
            "analysis_type": 3,
            "mode_n": n,
            "eig": values[k],
        }
        for n, k in enumerate(order, 1)
    ]


def _responses(scene: Scene, quantity: str, frequencies: Numbers | None, rotor_speed: Number | None) -> list[dict[str, Any]]:
    """Return the frequency response functions of the nodes to forces at the exciter."""
    nodes, directions = _nodes(scene), _directions(scene)
    x = _even_frequencies(scene, frequencies)
    model = state_space(scene, rotor_speed=rotor_speed)
    nd, start = len(model.A) // 2, list(_ORDERS).index(quantity)
    responses = model.frequency_response(2.0 * np.pi * x)[:, start * nd : (start + 1) * nd, nd:]
    references: dict[tuple[int, int], np.ndarray] = {}  # exciters at the same place form one reference
    columns = iter(np.moveaxis(responses, 2, 0))
    for exciter in scene.exciters:
        mounted = np.asarray(scene.machine.mount(exciter.place).rows[0])
        node = next((node.number for node in nodes if np.array_equal(node.rows, mounted)), 0)
        references |= {(node, direction): next(columns) for direction in directions}
    return [
        _function(x, (node.rows @ displacements.T)[k], _RESPONSE, quantity, (node.number, direction), reference, _FREQUENCY)
        for reference, displacements in references.items()
        for node in nodes
        for k, direction in enumerate(directions)
    ]


def _even_frequencies(scene: Scene, frequencies: Numbers | None) -> np.ndarray:
    """Return the given or the default frequencies, Hz. **Raises** `InputError` if they are not evenly spaced."""
    if frequencies is None:
        highest = float(np.max(np.asarray(estimated_frequencies(scene))))
        if highest == 0.0:
            raise InputError(
                "frequencies", "is missing; a machine without a natural frequency above 0 has no default; give frequencies"
            )
        step = _HIGHEST_FREQUENCY_RATIO * highest / (2.0 * np.pi * _LINES)
        return float(f"{step:.{_DIGITS - 1}e}") * np.arange(1, _LINES + 1)
    x = np.asarray(numbers(frequencies, "Hz", "frequencies", None, low=0.0, open_low=True), float)
    if x.ndim != 1 or x.size < 2:
        raise InputError("frequencies", f"are {quoted(frequencies)}; at least 2 evenly spaced frequencies are needed")
    _require_even(x, "frequencies")
    return x


def _require_even(x: np.ndarray, name: str) -> None:
    steps = np.diff(x)
    if not (steps[0] > 0.0 and np.all(np.abs(steps - steps[0]) <= _MAX_UNEVEN * max(abs(x[-1]), steps[0]))):
        raise InputError(name, f"are not evenly spaced (steps of {np.min(steps):.6g} to {np.max(steps):.6g}); give even ones")


def _histories(run: Run, quantity: str) -> list[dict[str, Any]]:
    """Return the histories of a run at the nodes, and the amplitude spectra of its end."""
    trajectory: Trajectory = run.window if run.trajectory is None else run.trajectory
    nodes, directions = _nodes(run.scene), _directions(run.scene)
    time, spectrum = np.asarray(trajectory.time, float), run.spectrum()
    _require_even(time, "times of the run")
    motion = np.asarray(getattr(trajectory.state, quantity), float)
    functions = [
        _function(time, motion @ node.rows[k], _HISTORY, quantity, (node.number, direction), (0, 0), _TIME)
        for node in nodes
        for k, direction in enumerate(directions)
    ]
    force, frequency = np.asarray(trajectory.foundation_force, float), np.asarray(spectrum.frequency) / (2.0 * np.pi)
    known = list(enumerate(directions)) if run.scene.machine.has_foundation else []
    functions += [_function(time, force[:, k], _HISTORY, "force", (0, direction), (0, 0), _TIME) for k, direction in known]
    functions += [
        _function(frequency, spectrum.force[-1, :, k], _GENERAL, "force", (0, direction), (0, 0), _FREQUENCY)
        for k, direction in known
    ]
    for name, unit, values in zip(spectrum.coordinates, spectrum.units, spectrum.amplitude[-1].T, strict=True):
        if unit == "m":
            about = f"amplitude spectrum of the coordinate {name}"
            functions.append(
                _function(frequency, values, _GENERAL, "displacement", (0, 0), (0, 0), _FREQUENCY) | {"id1": about}
            )
    return functions


def _function(
    x: np.ndarray,
    values: np.ndarray,
    kind: int,
    quantity: str,
    response: tuple[int, int],
    reference: tuple[int, int],
    abscissa: int,
) -> dict[str, Any]:
    """Return a function as dataset 58."""
    ordinate, unit = _ORDERS.get(quantity, (_REACTION, "N"))
    per_force = kind == _RESPONSE
    about = f"{quantity} of node {response[0]}{f' per force on node {reference[0]}' * per_force}"
    return {
        "type": 58,
        "id1": f"{'spectrum of ' * (kind == _GENERAL)}{about}",
        "func_type": kind,
        "rsp_node": response[0],
        "rsp_dir": response[1],
        "ref_node": reference[0],
        "ref_dir": reference[1],
        "data": np.asarray(values),
        "x": x,
        "abscissa_spacing": 1,
        "abscissa_inc": float(x[1] - x[0]),
        "abscissa_spec_data_type": abscissa,
        "abscissa_axis_lab": "Time" if abscissa == _TIME else "Frequency",
        "abscissa_axis_units_lab": "s" if abscissa == _TIME else "Hz",
        "ordinate_spec_data_type": ordinate,
        "ordinate_axis_lab": quantity.capitalize(),
        "ordinate_axis_units_lab": unit,
        "orddenom_spec_data_type": _FORCE if per_force else 0,
        "orddenom_axis_lab": "Force" if per_force else "NONE",
        "orddenom_axis_units_lab": "N" if per_force else "NONE",
    }


@validated
def read_uff(path: str | Path) -> UffFile:
    """Read histories and frequency response functions (dataset 58) and nodes (15, 2411) of a universal file, in SI units.

    The abscissa may be evenly or unevenly spaced, the data text or binary, real or complex. Values are converted to SI by
    dataset 164; a file without this dataset is assumed to be in SI units.

    **Arguments**: `path` of the file.

    **Returns** `UffFile`. **Raises** `InputError` for a file that cannot be read or has no function.

    >>> import pathlib, tempfile, numpy as np, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "machine.uff"
    >>> found = jv.read_uff(jv.export_uff(scene, path, frequencies=np.linspace(0.1, 20.0, 200)))
    >>> found.functions[0].kind, found.functions[0].values.shape
    ('response', (200,))
    """
    pyuff = optional_module("pyuff", "uff")
    try:
        with open_regular(path) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - _TAIL, 0))
            tail = file.read().split()
    except OSError as error:
        raise InputError("path", f"is {quoted(str(path))}, which cannot be read ({error.strerror}); give a UFF file") from error
    if size > _MAX_BYTES:
        raise InputError("path", f"is {quoted(str(path))}, which is larger than {_MAX_BYTES >> 20} MB; split it")
    try:
        sets = pyuff.UFF(str(path)).read_sets()
    except Exception as error:  # pyuff raises bare exceptions
        reason = " ".join(str(error).split())
        raise InputError("path", f"is {quoted(str(path))}, which cannot be read as a UFF file ({reason})") from error
    sets = sets if isinstance(sets, list) else [sets]
    if sets and tail[-1:] != [b"-1"]:
        raise InputError("path", f"is {quoted(str(path))}, whose last dataset was cut off; export it again")
    for k, dataset in enumerate(dataset for dataset in sets if dataset.get("type") == 58):
        stated, read_count = int(dataset["num_pts"]), np.size(dataset["data"])
        if stated != read_count:
            problem = f"whose function {k + 1} has {read_count} values where its header states {stated}"
            raise InputError("path", f"is {quoted(str(path))}, {problem}; export it again")
    length, force = next(((dataset["length"], dataset["force"]) for dataset in sets if dataset.get("type") == 164), (1.0, 1.0))
    functions = tuple(_read_function(dataset, length, force) for dataset in sets if dataset.get("type") == 58)
    if not functions:
        raise InputError(
            "path",
            f"is {quoted(str(path))}, which contains no function (dataset 58); give a file with time "
            "histories or frequency response functions",
        )
    nodes = {}
    for dataset in sets:
        if dataset.get("type") in (15, 2411):
            names = dataset["node_nums"] if dataset["type"] == 15 else dataset["grid_global"][:, 0]
            columns = [dataset[axis] for axis in "xyz"] if dataset["type"] == 15 else dataset["grid_global"][:, 1:].T
            nodes |= {int(n): tuple(float(v) / length for v in xyz) for n, *xyz in zip(names, *columns, strict=True)}
    return UffFile(functions, nodes)


def _read_function(dataset: dict[str, Any], length: float, force: float) -> UffFunction:
    """Return a function in SI units."""
    scale = _scale(dataset, "ordinate", length, force) / _scale(dataset, "orddenom", length, force)
    names = {code: name for name, (code, _) in _ORDERS.items()} | {_FORCE: "force", _REACTION: "force"}
    return UffFunction(
        _KINDS.get(int(dataset["func_type"]), "other"),
        np.asarray(dataset["x"], float),
        np.asarray(dataset["data"]) * scale,
        names.get(int(dataset["ordinate_spec_data_type"]), ""),
        (int(dataset["rsp_node"]), int(dataset["rsp_dir"])),
        (int(dataset["ref_node"]), int(dataset["ref_dir"])),
        str(dataset["id1"]).strip(),
    )


def _scale(dataset: dict[str, Any], side: str, length: float, force: float) -> float:
    """Return the factor from the units of the file to SI, for the numerator ("ordinate") or the denominator ("orddenom")."""
    kind = int(dataset[f"{side}_spec_data_type"])
    stated_exponents = int(dataset[f"{side}_len_unit_exp"]), int(dataset[f"{side}_force_unit_exp"])
    lengths, forces = stated_exponents if kind == 1 else _EXPONENTS.get(kind, (0, 0))
    return length**-lengths * force**-forces
