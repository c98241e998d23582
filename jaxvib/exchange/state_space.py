"""State-space models of a machine at rest and of a jam."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated, with_known_names
from jaxvib.equations.averaged import Amplitudes, averaged_field
from jaxvib.equations.linear import linear_model, mean_speed
from jaxvib.errors import InputError, optional_module, quoted, require_writable, with_ending, written
from jaxvib.exchange.model import Signal, coordinate_signals, force_inputs, foundation_forces, omit_unknown_force
from jaxvib.machine.drives.drive import ConstantSpeed
from jaxvib.machine.effects.base import terms_of
from jaxvib.machine.effects.terms import SupportForce
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.linalg import magnitude
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.jam import Jam
from jaxvib.steady.jams.phases import PhaseJam
from jaxvib.units import Number, Numbers, number, numbers

if TYPE_CHECKING:
    import control
    import scipy.signal

_MAX_RESIDUAL = 1e-6, 1e-3
"""Largest residual acceleration of a load in a jam, relative to the acceleration that its drag alone causes, in double and in
single precision."""

_AT_REST = (
    "linear machine with the masses of its loads at their places, at the rotor speed {speed:.6g} rad/s; inputs are forces on "
    "the coordinates and at each exciter; loads do not turn"
)
_IN_JAM = (
    "averaged equations linearized about a jam at the load speed {omega:.6g} rad/s and the rotor speed {speed:.6g} rad/s; "
    "signals are deviations from the operating point, slow compared with the vibration; amplitudes are zero to peak; "
    "the common phase of all loads is left out"
)


@with_known_names
class StateSpace(NamedTuple):
    """Linear model x' = A x + B u, y = C x + D u with named signals.

    Returned by `state_space`.

    **Attributes** (nx states, nu inputs, ny outputs)

    - `A` (nx, nx), `B` (nx, nu), `C` (ny, nx), `D` (ny, nu), SI units
    - `states`, `inputs`, `outputs`: a `Signal` (`name`, `unit`) for each entry of x, u and y
    - `x0`, `u0`, `y0`: values at the operating point, 0 for a machine at rest; x, u and y are deviations from these values
    - `about`: a sentence about the equations
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    x0: np.ndarray
    u0: np.ndarray
    y0: np.ndarray
    about: str

    def poles(self) -> np.ndarray:
        """Return the eigenvalues of A, complex, 1/s."""
        return np.linalg.eigvals(self.A)

    @validated
    def frequency_response(self, omega: Numbers) -> np.ndarray:
        """Return the frequency responses C (i w I - A)^-1 B + D: complex amplitude of each output per amplitude of each input.

        **Arguments**: `omega`: frequencies w, rad/s or text.

        **Returns** an array (frequencies, ny, nu). **Raises** `InputError` for a frequency at which the response is infinite.
        """
        frequencies = np.ravel(np.asarray(numbers(omega, "rad/s", "omega", None), float))[:, None, None]
        try:
            inner = np.linalg.solve(1j * frequencies * np.eye(len(self.A)) - self.A, self.B.astype(complex))
        except np.linalg.LinAlgError:
            problem = "contains an undamped natural frequency, such as 0 for a free machine; leave out this frequency"
            raise InputError("omega", problem) from None
        return self.C @ inner + self.D

    def scipy(self) -> scipy.signal.StateSpace:
        """Return the model as `scipy.signal.StateSpace`, without names. **Raises** `InputError` if SciPy is not installed."""
        return optional_module("scipy.signal", "mat").StateSpace(self.A, self.B, self.C, self.D)

    def control(self) -> control.StateSpace:
        """Return the model for python-control, with the names of its signals; dots and brackets in a name become "_".

        **Raises** `InputError` if python-control is not installed (extra `control`).
        """
        names = {
            name: [re.sub(r"[.\[\]]+", "_", signal.name) for signal in getattr(self, name)]
            for name in ("states", "inputs", "outputs")
        }
        return optional_module("control", "control").ss(self.A, self.B, self.C, self.D, **names)

    @validated
    def save(self, path: str | Path) -> Path:
        """Write a MAT file (".mat", added if it is missing) that MATLAB, Octave and SciPy read.

        The file contains A, B, C, D, x0, u0, y0, the text `about`, and names and units as cell arrays: state_names,
        state_units, input_names, input_units, output_names, output_units.

        **Arguments**: `path` of the file.

        **Returns** the path. **Raises** `InputError` for a path that cannot be written to.
        """
        path = with_ending(path, ".mat")
        require_writable(path)
        content: dict[str, Any] = {name: getattr(self, name) for name in ("A", "B", "C", "D", "x0", "u0", "y0", "about")}
        for kind in ("state", "input", "output"):
            signals = getattr(self, f"{kind}s")
            content[f"{kind}_names"] = np.asarray([signal.name for signal in signals], dtype=object)
            content[f"{kind}_units"] = np.asarray([signal.unit for signal in signals], dtype=object)
        io = optional_module("scipy.io", "mat")
        with written(path) as part, part.open("wb") as file:
            io.savemat(file, content, oned_as="column")
        return path


@validated
def state_space(
    scene: Scene, at: Literal["rest"] | Jam | PhaseJam = "rest", *, rotor_speed: Number | None = None
) -> StateSpace:
    """Return the state-space model of a scene's machine, at rest or in a jam.

    At rest the model is

        M q'' + (R + n G) q' + K q = f + P^T f_e,      x = (q, q'),  u = (f, f_e),  y = (q, q', q'', F_K q + F_R q')

    - q are the coordinates, f forces on the coordinates and f_e forces at the exciters; P maps q to the displacements of the
      exciters
    - the mass matrix M includes the masses of the loads; the stiffness matrix K and the damping matrix R include the linear
      parts of nonlinear supports; G is the gyroscopic matrix
    - the last output is the force on the foundation, which is omitted if the foundation is unknown (`from_matrices`); F_K and
      F_R contain stiffness and damping of the supports on the foundation

    In a jam, the model is the linearization of the averaged equations (`envelope`) about the jam:

    - the states are the complex amplitudes of displacements and velocities of the carrier (real and imaginary parts), the load
      speeds, and the phases of the loads relative to the first load
    - the input is the rotor speed
    - the outputs are the mean load speed and the amplitudes of the coordinates and of the foundation force
    - the largest real part of the poles is the `growth` of `phase_jams`

    **Arguments**

    - `scene`: for a model at rest only the machine, the loads, the nonlinear supports and the rotor speed matter, and several
      exciters are allowed
    - `at`: "rest" (the default), or a jam from `jam_modes(scene).select(mode)` or `phase_jams(scene)`
    - `rotor_speed` n, rad/s, negative if clockwise, for a machine at rest with a gyroscopic matrix; default: the mean speed of
      the drives; typical: 0 to 500

    **Returns** `StateSpace`.

    **Raises** `InputError` for a jam that does not exist or is not an equilibrium of the averaged equations of this scene, for
    effects that these equations do not include, and for a rotor speed together with a jam.

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> model = jv.state_space(scene)
    >>> [each.name for each in model.inputs], [round(float(x), 2) for x in model.A[1]]
    (['force.y1', 'exciter.up'], [-784.31, -0.59])
    """
    scene = validate_scene(scene)
    if isinstance(at, (Jam, PhaseJam)):
        if rotor_speed is not None:
            raise InputError("rotor_speed", f"is {quoted(rotor_speed)}, but a jam has its own rotor speed; leave it out")
        return _model_in_jam(scene, at)
    if at != "rest":
        raise InputError("at", f"is {quoted(at)}; it must be 'rest' or a jam, for example jam_modes(scene).select(3)")
    speed = mean_speed(scene) if rotor_speed is None else number(rotor_speed, "rad/s", "rotor_speed")
    return _model_at_rest(scene, speed)


def _model_at_rest(scene: Scene, speed: Array) -> StateSpace:
    a, b, c, d = map(np.asarray, _rest_matrices(scene, speed))
    carrier = scene.machine.structure()
    states = (*coordinate_signals(carrier, "displacement", 0), *coordinate_signals(carrier, "velocity", 1))
    places = [
        f"{scene.prefix_of(k) or 'exciter.'}{('across', 'up')[axis]}"
        for k, exciter in enumerate(scene.exciters)
        for axis in scene.machine.mounting(exciter.at).axes
    ]
    outputs = (*states, *coordinate_signals(carrier, "acceleration", 2), *foundation_forces(scene.machine))
    inputs = (*force_inputs(carrier), *(Signal(place, "N") for place in places))
    x0, u0, y0 = (np.zeros(len(signals)) for signals in (states, inputs, outputs))
    return StateSpace(a, b, c, d, states, inputs, outputs, x0, u0, y0, _AT_REST.format(speed=float(speed)))


@cached
def _rest_matrices(scene: Scene, speed: Array) -> tuple[Array, Array, Array, Array]:
    model = linear_model(scene)
    carrier, nd = model.carrier, model.mass.shape[0]
    stiffness, damping = carrier.stiffness, model.damping(speed)
    foundation = [carrier.foundation_stiffness, carrier.foundation_damping]
    rest = jnp.zeros(nd, model.mass.dtype)
    for term, rows in zip(terms_of(scene.effects, SupportForce), model.supports, strict=True):
        slopes = [slope @ rows for slope in jax.jacfwd(term.force, (0, 1))(rows @ rest, rows @ rest)]
        stiffness, damping = stiffness + rows.T @ slopes[0], damping + rows.T @ slopes[1]
        if not term.is_link:
            foundation = [matrix + slope for matrix, slope in zip(foundation, slopes, strict=True)]
    forces = jnp.concatenate([jnp.eye(nd, dtype=model.mass.dtype), *(mount.rows[0].T for mount in model.mounts)], axis=1)
    solved = jnp.linalg.solve(model.mass, jnp.concatenate([-stiffness, -damping, forces], axis=1))
    zero, identity = jnp.zeros_like(model.mass), jnp.eye(nd, dtype=model.mass.dtype)
    no_force = jnp.zeros_like(forces)
    a = jnp.block([[zero, identity], [solved[:, : 2 * nd]]])
    b = jnp.concatenate([no_force, solved[:, 2 * nd :]])
    reaction = omit_unknown_force(scene.machine, jnp.concatenate(foundation, axis=1))
    c = jnp.concatenate([jnp.eye(2 * nd, dtype=model.mass.dtype), solved[:, : 2 * nd], reaction])
    d = jnp.concatenate([no_force, no_force, solved[:, 2 * nd :], jnp.zeros((len(reaction), forces.shape[1]), forces.dtype)])
    return a, b, c, d


def _model_in_jam(scene: Scene, jam: Jam | PhaseJam) -> StateSpace:
    if not np.ndim(jam.omega) == 0 or not np.isfinite(jam.omega):
        raise InputError("at", f"must be one existing jam ({jam.message}); choose one with select(mode)")
    scene = scene.replace(drive=ConstantSpeed(jam.rotor_speed))
    phase = jam.phase if isinstance(jam, PhaseJam) else jnp.zeros(scene.loads.count)
    if phase.shape != (scene.loads.count,) or jam.displacement.shape != scene.machine.structure().mass.shape[:1]:
        raise InputError(
            "at", "is the jam of a machine with other coordinates or another number of loads; use a jam of this scene"
        )
    averaged_field(scene)  # raises errors for effects outside the averaged equations before anything is compiled
    matrices_and_point = jax.tree.map(np.asarray, _jam_matrices(scene, jam.omega, phase, jam.displacement))
    (a, b, c, d), x0, y0, residual = matrices_and_point
    if not residual < _MAX_RESIDUAL[residual.dtype.itemsize < 8]:
        problem = f"is not an equilibrium of the averaged equations of this scene (relative residual {float(residual):.1e})"
        raise InputError("at", f"{problem}; use a jam of this scene, or for different loads one from phase_jams(scene)")
    carrier, loads = scene.machine.structure(), range(1, scene.loads.count + 1)
    parts = [("displacement", 0), ("velocity", 1)]
    states = [signal for name, order in parts for part in ("real", "imaginary")
              for signal in coordinate_signals(carrier, f"{part}_{name}", order)]  # fmt: skip
    states += [
        *(Signal(f"rate.load{j}", "rad/s") for j in loads),
        *(Signal(f"phase.load{j}", "rad") for j in loads[1:]),
    ]
    outputs = [Signal("load_speed", "rad/s"), *coordinate_signals(carrier, "amplitude", 0)]
    outputs += foundation_forces(scene.machine)
    about = _IN_JAM.format(omega=float(jam.omega), speed=float(jam.rotor_speed))
    inputs = (Signal("rotor_speed", "rad/s"),)
    return StateSpace(a, b, c, d, tuple(states), inputs, tuple(outputs), x0, np.atleast_1d(jam.rotor_speed), y0, about)


@cached
def _jam_matrices(
    scene: Scene, omega: Array, phase: Array, displacement: Array
) -> tuple[tuple[Array, Array, Array, Array], Array, Array, Array]:
    """Return A, B, C, D; the operating point of states and outputs; the relative residual of the equations of the loads."""
    nd, count, carrier = displacement.shape[0], phase.shape[0], linear_model(scene).carrier

    def amplitudes(x: Array) -> Amplitudes:
        y = x[: 2 * nd], x[2 * nd : 4 * nd]
        relative = jnp.concatenate([jnp.zeros_like(x[:1]), x[4 * nd + count :]])
        rate = x[4 * nd : 4 * nd + count]
        return Amplitudes(jax.lax.complex(y[0][:nd], y[0][nd:]), jax.lax.complex(y[1][:nd], y[1][nd:]), rate, relative)

    def flow(x: Array, speed: Array) -> Array:
        state = amplitudes(x)
        change = averaged_field(eqx.tree_at(lambda s: s.drive.speed, scene, speed))(jnp.zeros_like(omega), state)
        # The phases of the averaged amplitudes are relative to the mean angle of the loads; here, to that of the first load.
        rotation = 1j * change.phase[0]
        rates = [change.displacement - rotation * state.displacement, change.velocity - rotation * state.velocity]
        parts = [part for rate in rates for part in (rate.real, rate.imag)]
        return jnp.concatenate([*parts, change.rate, change.phase[1:] - change.phase[0]])

    def outputs(x: Array, speed: Array) -> Array:
        state = amplitudes(x)
        force = omit_unknown_force(scene.machine, carrier.foundation_force(state.displacement, state.velocity))
        return jnp.concatenate([jnp.mean(state.rate)[None], magnitude(state.displacement), magnitude(force)])

    rotated = displacement * jnp.exp(-1j * phase[0])
    velocity = 1j * omega * rotated
    x = [rotated.real, rotated.imag, velocity.real, velocity.imag, jnp.full_like(phase, omega), phase[1:] - phase[0]]
    x, speed = jnp.concatenate(x), scene.drive.speed
    (a, b), (c, d) = jax.jacfwd(flow, (0, 1))(x, speed), jax.jacfwd(outputs, (0, 1))(x, speed)
    field = averaged_field(scene)
    drag = jnp.max(field.drag * jnp.abs(speed - omega) / field.inertia)
    residual = jnp.max(jnp.abs(flow(x, speed)[4 * nd : 4 * nd + count])) / drag
    return (a, b[:, None], c, d[:, None]), x, outputs(x, speed), residual
