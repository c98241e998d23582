"""Functional mock-up units: a scene as C source and as a binary, for tools without Python."""

from __future__ import annotations

import hashlib
import io
import os
import platform
import re
import shutil
import subprocess
import tempfile
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated, with_known_names
from jaxvib.equations.state import State
from jaxvib.errors import InputError, require_one_of, require_writable, with_ending, written
from jaxvib.exchange.c_code import CProgram, number_text, write_program
from jaxvib.exchange.description import Fmi, Variable, describe_model
from jaxvib.exchange.model import DriveBy, Equations, equations_of, has_events, named_entries, without_motor_states
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.motion.analysis.scaled_error import error_scale, natural_units
from jaxvib.motion.integration.stiffness import fastest_decay, fastest_motion
from jaxvib.motion.start import Start, start_state
from jaxvib.ode.scalarize import NotScalarizable, scalar_program
from jaxvib.runtime.compat import HAS_JAXPRS

_STEPS_PER_RADIAN = 16.0
"""Number of steps of co-simulation per radian of the fastest motion; the phase error is then about 1e-7 per radian."""

_COMPILERS = ("cc", "gcc", "clang")
_COMPILER_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden", "-s")
_COMPILE_SECONDS = 120

_PLATFORMS = {
    ("Linux", "x86_64"): ("linux64", "x86_64-linux", ".so"),
    ("Linux", "aarch64"): ("aarch64-linux", "aarch64-linux", ".so"),
    ("Darwin", "x86_64"): ("darwin64", "x86_64-darwin", ".dylib"),
    ("Darwin", "arm64"): ("aarch64-darwin", "aarch64-darwin", ".dylib"),
    ("Windows", "AMD64"): ("win64", "x86_64-windows", ".dll"),
}
"""Folders of binaries in FMI 2.0 and in FMI 3.0, and the file name extension."""


@with_known_names
class Fmu(NamedTuple):
    """Exported functional mock-up unit.

    Returned by `export_fmu`.

    **Attributes**: `path` of the file; `has_binary`: True if it contains a binary for this platform in addition to the source;
    `message`: a sentence about the binary; `statements`: number of C statements of the equations.
    """

    path: Path
    has_binary: bool
    message: str
    statements: int


@validated
def export_fmu(
    scene: Scene,
    path: str | Path,
    *,
    fmi: Fmi = "2.0",
    start: Start | State = "rest",
    mode: int | None = None,
    drive: DriveBy = "scene",
    binary: bool = True,
) -> Fmu:
    """Write a scene as a functional mock-up unit (FMU), for model exchange and co-simulation.

    The file contains the equations as C source and, if a C compiler is found (`CC`, cc, gcc, clang), a binary for this
    platform. Tools that use the file need neither Python nor jaxvib. If the same scene is written twice, the files are
    identical.

    - Parameters are all parameters of the scene with their names (`machine.stiffness[0]`), units and bounds; they may change
      during a simulation. `co_simulation.step`, s, is the longest step of co-simulation, which uses the classical Runge-Kutta
      method of order 4
    - Outputs are the states (`displacement.y1`, `velocity.y1`, `angle.load1`, `rate.load1`), `acceleration.y1`,
      `foundation_force.up` (unless the foundation is unknown), `rotor.angle` and `rotor.speed`
    - Inputs are `force.y1` on each coordinate (N, for angles N m) and, with a motor, `rotor.torque` (N m, anticlockwise), which
      is added to the torque of the motor
    - In a scene with several exciters, the names of their signals begin with the exciter, such as `exciters[1].rotor.torque`
    - Event indicators are the differences that are compared in non-smooth forces (stops, contacts, dry friction) and in a drive
      whose acceleration jumps; a solver ends a step at the time at which an indicator changes its sign
    - Directional derivatives of rates and outputs with respect to states, inputs, parameters and time are exact

    **Arguments**

    - `scene` to export
    - `path` of the file, ".fmu"
    - `fmi`: version of the standard, "2.0" (the default) or "3.0"
    - `start`: "rest" (the default), "jam", or a `State`
    - `mode`: number of the jam mode for `start="jam"`; typical: 1, 3, 5
    - `drive`: "scene" (the default), or "input" for inputs in place of the drive. The inputs are `rotor.speed` and its
      derivative `rotor.acceleration` if the drive is ideal (prescribed motion), and `rotor.torque` if it is a motor
    - `binary`: True to compile a binary

    **Returns** `Fmu`.

    **Raises** `InputError` for a part of the scene whose equations cannot be written in C (the message names the operation),
    and for a path that cannot be written to.

    >>> import pathlib, tempfile, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> unit = jv.export_fmu(scene, pathlib.Path(tempfile.mkdtemp()) / "machine.fmu", binary=False)
    >>> unit.message
    'source only: no binary was requested'
    """
    require_one_of(fmi, ("2.0", "3.0"), "fmi")
    require_one_of(drive, ("scene", "input"), "drive")
    if isinstance(start, str) and start == "spin_up":
        raise InputError("start", "is 'spin_up', which replaces the drive; give the scene a SpinUp drive and start at 'rest'")
    scene = validate_scene(scene)
    state = start_state(scene, start, mode)
    path = with_ending(path, ".fmu")
    require_writable(path)
    files, statements, identifier = _source_files(scene, state, path.stem, fmi, drive)
    message = "source only: no binary was requested"
    library = None
    if binary:
        library, message = _compile(files, fmi, identifier)
    if library is not None:
        files |= library
    with written(path) as part, part.open("wb") as file:
        file.write(_archive(files))
    return Fmu(path, library is not None, message, statements)


def _source_files(scene: Scene, state: State, name: str, fmi: Fmi, drive: DriveBy) -> tuple[dict[str, bytes], int, str]:
    """Return the files of the unit without a binary, the number of C statements, and the identifier of the model."""
    equations, names = equations_of(scene, state, drive), named_entries(scene)
    events = has_events(scene)
    programs = _programs(scene, equations, events, len(names))
    step = _max_step(scene)
    variables = _variables(scene, equations, programs.rates.branches, step)
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)[:60]
    identifier = identifier if re.match("[A-Za-z]", identifier) else f"machine_{identifier}"
    body = _model_source(scene, equations, programs, variables)
    c_folder = Path(__file__).parent / "c"
    files = {f"sources/{c_file}": (c_folder / c_file).read_bytes() for c_file in ("machine.h", "fmi.h", f"fmi{fmi[0]}.c")}

    def description(token: str) -> str:
        tool, about = f"jaxvib {version('jaxvib')}", _describe_scene(scene)
        return describe_model(fmi, name, identifier, token, tool, about, variables, _text(step), "10.0")

    content = "".join([description(""), body, *(text.decode() for text in files.values())])
    token = "{" + hashlib.sha256(content.encode()).hexdigest()[:32] + "}"
    files["sources/model.h"] = f'#define TOKEN "{token}"\n{body}'.encode()
    files["modelDescription.xml"] = description(token).encode()
    if fmi == "3.0":
        files["sources/buildDescription.xml"] = (
            '<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">\n'
            f'<BuildConfiguration modelIdentifier="{identifier}"><SourceFileSet><SourceFile name="fmi3.c"/></SourceFileSet>'
            "</BuildConfiguration>\n</fmiBuildDescription>\n"
        ).encode()
    return files, len(programs.rates.body), identifier


def _describe_scene(scene: Scene) -> str:
    """Return a description of the machine and its exciters."""
    carried_parts = [
        " and ".join(
            ([] if exciter.loads is None else [f"{exciter.loads.count} {exciter.loads.kind}"])
            + ["an unbalance"] * (exciter.unbalance is not None)
        )
        for exciter in scene.exciters
    ]
    return f"{scene.machine.kind} with {', '.join(carried_parts)}"


def _max_step(scene: Scene) -> float:
    """Return the longest step of co-simulation, s."""
    fastest, decay = float(fastest_motion(scene)), float(fastest_decay(scene))
    return float(f"{1.0 / max(_STEPS_PER_RADIAN * fastest, decay):.3g}")


class _Programs(NamedTuple):
    """Programs in C.

    **Attributes**: `rates`: rates and outputs; `tangent`: their directional derivatives with respect to states and inputs,
    which implicit solvers need often; `full_tangent`: their directional derivatives with respect to parameters, time, states
    and inputs.
    """

    rates: CProgram
    tangent: CProgram
    full_tangent: CProgram


def _programs(scene: Scene, equations: Equations, events: bool, parameters: int) -> _Programs:
    """Return the programs of a scene."""
    if not HAS_JAXPRS:
        raise InputError("scene", "cannot be written in C, because this version of JAX does not give access to its programs")
    time = jnp.zeros((), scene.top_speed.dtype)
    arguments = (scene, time, equations.states, equations.inputs)

    def tangent(scene: Scene, t: Array, states: object, inputs: object, *direction: object) -> object:
        return jax.jvp(lambda *changing: equations.rates(scene, t, *changing), (states, inputs), direction)[1]

    def full_tangent(*values: object) -> object:
        return jax.jvp(equations.rates, values[: len(arguments)], values[len(arguments) :])[1]

    try:
        rates = scalar_program(equations.rates, *arguments)
        tangents = scalar_program(tangent, *arguments, *arguments[2:]), scalar_program(full_tangent, *arguments, *arguments)
    except NotScalarizable as error:
        problem = f"needs the operation {str(error)!r} of JAX, which is not available for scalars"
        remedy = "write the part of the scene with other operations, such as jnp.stack in place of .at[].set, or remove it"
        raise InputError("scene", f"{problem}; {remedy}") from error
    numbers, number_seeds = ([f"{name}[{k}]" for k in range(parameters)] for name in ("p", "p_seed"))
    count = {"x": len(equations.state_signals), "u": len(equations.input_signals), "y": len(equations.output_signals)}
    changing = [f"{name}[{k}]" for name in "xu" for k in range(count[name])]
    seeds = [f"{name}_seed[{k}]" for name in "xu" for k in range(count[name])]
    results = [f"{name}[{k}]" for name, size in (("rate", "x"), ("y", "y")) for k in range(count[size])]
    values = [*numbers, "t", *changing]
    return _Programs(
        write_program(rates, values, parameters, results, has_events=events),
        write_program(tangents[0], [*values, *seeds], parameters, results),
        write_program(tangents[1], [*values, *number_seeds, "t_seed", *seeds], parameters, results),
    )


def _text(value: object) -> str:
    return number_text(np.asarray(value, float).item())


def _flat(tree: object) -> list[str]:
    """Return all values in the arrays of a tree as texts for C and XML."""
    return [_text(value) for leaf in jax.tree.leaves(tree) for value in np.asarray(leaf).ravel()]


def _variables(scene: Scene, equations: Equations, branches: int, step: float) -> list[Variable]:
    """Return all variables in the order of their value references."""
    signals, state = equations.state_signals, equations.states.machine
    units = natural_units(scene)
    units = without_motor_states(units) if equations.by_input else units
    scales = _flat(jax.tree.map(lambda size, leaf: np.full(np.shape(leaf), size), error_scale(state, units), state))
    nominals = [*scales, *["1.0"] * (len(signals) - len(scales))]
    states = [
        Variable(item.name, item.unit, "output", start, nominal=nominal)
        for item, start, nominal in zip(signals, _flat(equations.states), nominals, strict=True)
    ]
    rates = [
        Variable(f"der({item.name})", f"{item.unit}/s" if "/" not in item.unit else f"{item.unit}^2", "local", state=k)
        if rate_signal is None
        else Variable(rate_signal.name, rate_signal.unit, "output", state=k)
        for k, (item, rate_signal) in enumerate(zip(signals, equations.rate_signals, strict=True), 1)
    ]
    starts = zip(equations.input_signals, _flat(equations.inputs), strict=True)
    parameters = []
    for item, value in zip(named_entries(scene), _flat(scene), strict=True):
        low, high = (_text(x) if np.isfinite(x) else None for x in (item.spec.bounds.low, item.spec.bounds.high))
        (about,) = item.words(scene)
        parameters.append(Variable(item.name, item.unit, "parameter", value, about, low, high))
    return [
        Variable("time", "s", "independent"),
        *states,
        *rates,
        *(Variable(item.name, item.unit, "input", start) for item, start in starts),
        *(Variable(item.name, item.unit, "output") for item in equations.output_signals),
        *parameters,
        Variable("co_simulation.step", "s", "parameter", _text(step), "longest step of co-simulation", "0.0"),
        *(Variable(f"event_indicator[{k}]", "", "local", listed=False) for k in range(branches)),
    ]


_MODEL = """/* Equations of one scene, written by jaxvib.

   p parameters, t time, x states, u inputs, y outputs; constants: the results of `prepare`, which depend on parameters only. */

#define STATES {states}
#define INPUTS {inputs}
#define OUTPUTS {outputs}
#define PARAMETERS {parameters}
#define INDICATORS {indicators}
#define CONSTANTS {constants}
#define TANGENT_CONSTANTS {tangent_constants}
#define FULL_TANGENT_CONSTANTS {full_tangent_constants}

static const char *const NAMES[] = {{{names}}};
static const double START_STATES[] = {{{start_states}}};
static const double START_INPUTS[] = {{{start_inputs}}};
static const double START_PARAMETERS[] = {{{start_parameters}}};
static const double NOMINALS[] = {{{nominals}}};
static const double LOW[] = {{{low}}};
static const double HIGH[] = {{{high}}};
static const char OPEN[] = {{{open}}};  /* 1: the lower bound itself is not allowed, 2: the upper one */

static void prepare(const double *p, double *constants) {{
{prepare}
}}

static void evaluate(const double *p, const double *constants, double t, const double *x, const double *u, double *rate,
                     double *y, double *indicators) {{
{body}
}}

/* Derivatives of rates and outputs in the direction (x_seed, u_seed). */
static void prepare_tangent(const double *p, double *constants) {{
{prepare_tangent}
}}

static void tangent(const double *p, const double *constants, double t, const double *x, const double *u, const double *x_seed,
                    const double *u_seed, double *rate, double *y) {{
{tangent}
}}

/* Derivatives of rates and outputs in the direction (p_seed, t_seed, x_seed, u_seed). */
static void prepare_full_tangent(const double *p, double *constants) {{
{prepare_full_tangent}
}}

static void full_tangent(const double *p, const double *constants, double t, const double *x, const double *u,
                         const double *p_seed, double t_seed, const double *x_seed, const double *u_seed, double *rate,
                         double *y) {{
{full_tangent}
}}
"""


def _model_source(scene: Scene, equations: Equations, programs: _Programs, variables: list[Variable]) -> str:
    """Return the C source of the equations."""
    parameters = [item for item in variables if item.kind == "parameter"]
    bounds = [item.spec.bounds for item in named_entries(scene)]
    open_bounds = [*(int(item.open_low) + 2 * int(item.open_high) for item in bounds), 1]
    states = [item for item in variables if item.nominal is not None]
    inputs = [item for item in variables if item.kind == "input"]
    lists = {
        "names": ['"' + re.sub(r"[^ -~]|[\"\\%?]", "_", item.name) + '"' for item in variables],
        "start_states": [str(item.start) for item in states],
        "start_inputs": [str(item.start) for item in inputs],
        "start_parameters": [str(item.start) for item in parameters],
        "nominals": [str(item.nominal) for item in states],
        "low": [item.low or "-INFINITY" for item in parameters],
        "high": [item.high or "INFINITY" for item in parameters],
        "open": [str(item) for item in open_bounds],
    }
    blocks = {"prepare": programs.rates.prepare, "body": programs.rates.body}
    for name in ("tangent", "full_tangent"):
        program = getattr(programs, name)
        blocks |= {f"prepare_{name}": program.prepare, name: program.body}
    return _MODEL.format(
        states=len(states),
        inputs=len(inputs),
        outputs=len(equations.output_signals),
        parameters=len(parameters),
        indicators=programs.rates.branches,
        constants=programs.rates.constants,
        tangent_constants=programs.tangent.constants,
        full_tangent_constants=programs.full_tangent.constants,
        **{name: ", ".join(texts) for name, texts in lists.items()},
        **{name: "\n".join(f"    {line}" for line in lines) for name, lines in blocks.items()},
    )


def _compile(files: dict[str, bytes], fmi: Fmi, identifier: str) -> tuple[dict[str, bytes] | None, str]:
    """Return the binary for this platform, or None, and a sentence about it."""
    folders = _PLATFORMS.get((platform.system(), platform.machine()))
    compiler = next(filter(None, map(shutil.which, filter(None, (os.environ.get("CC"), *_COMPILERS)))), None)
    if folders is None or compiler is None:
        no_compiler, no_platform = "a C compiler (CC, cc, gcc or clang) was not found", "this platform is not supported"
        reason = no_compiler if compiler is None else no_platform
        return None, f"source only: {reason}; the tool that reads the file has to compile it"
    folder = folders[0] if fmi == "2.0" else folders[1]
    with tempfile.TemporaryDirectory() as home:
        for name, content in files.items():
            if name.startswith("sources/"):
                (Path(home) / Path(name).name).write_bytes(content)
        command = [compiler, *_COMPILER_FLAGS, "-o", "machine", f"fmi{fmi[0]}.c", "-lm"]
        try:
            subprocess.run(command, cwd=home, capture_output=True, text=True, timeout=_COMPILE_SECONDS, check=True)
        except (OSError, subprocess.SubprocessError) as error:
            output = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
            reason = f"{Path(compiler).name} failed ({output[0] if output else 'no message'})"
            return None, f"source only: {reason}; the tool that reads the file has to compile it"
        return {
            f"binaries/{folder}/{identifier}{folders[2]}": (Path(home) / "machine").read_bytes()
        }, f"with a binary for {folder}"


def _archive(files: dict[str, bytes]) -> bytes:
    """Return a ZIP archive whose bytes depend only on the files, not on the time of writing."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(files):
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, files[name])
    return buffer.getvalue()
