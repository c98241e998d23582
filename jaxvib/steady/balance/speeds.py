"""Characteristic speeds of a machine, at which coincident loads change between gathering and balancing."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.display import Axes, Drawn, SpeedUnit, speed_unit
from jaxvib.equations.linear import LinearModel, linear_model, require_one_point
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import allowed_unknowns, validate_scene
from jaxvib.numerics.linalg import hermitian_modes, magnitude, relative_to, root_or_zero, small_solve
from jaxvib.numerics.roots import bracketed_root
from jaxvib.results.fields import in_unit, names_along
from jaxvib.results.result import Result
from jaxvib.runtime.programs import cached
from jaxvib.units.known import require_finite, when_known

_GRID_POINTS = 24
"""Number of grid points on each side of each resonance in the search for sign changes of the damped machine."""


class CriterionStatus(eqx.Enumeration):
    """Outcome of the criterion for a machine. The value of each member is the message shown to the user."""

    decided = "stability was decided at every rotor speed"
    free = "no support resists one of the motions of the machine: its lowest resonance is 0, and it can drift"
    not_finite = "the speeds could not be computed: a parameter of the scene is not allowed or exceeds the precision"


class CharacteristicSpeeds(Result):
    """Speeds at which the real part of the mount's receptance changes sign, ascending, rad/s; NaN for a speed that does not
    exist.

    **Attributes** (nd coordinates)

    - `resonances` (nd,): poles of the receptance without damping; above them loads balance, below them they gather
    - `additional` (nd - 1,): zeros of the receptance without damping; above them loads gather, below them they balance. They
      are the resonances of the machine with its mount fixed
    - `shapes` (nd, nd): the mode shapes of the resonances, one column each, with unit modal mass and an arbitrary sign
    - `damped_resonances` (nd,) and `damped_additional` (nd - 1,): the same changes of sign with the machine's damping
    - `coordinates`: the names of the rows of `shapes`

    If a mode does not move the mount, its resonance is also one of the additional speeds, and no sign changes there.
    """

    resonances: Array = eqx.field(metadata=in_unit("rad/s", "resonance"))
    additional: Array = eqx.field(metadata=in_unit("rad/s", "zero"))
    shapes: Array = eqx.field(metadata=in_unit("", "coordinate", "resonance"))
    damped_resonances: Array = eqx.field(metadata=in_unit("rad/s", "resonance"))
    damped_additional: Array = eqx.field(metadata=in_unit("rad/s", "zero"))
    coordinates: tuple[str, ...] = eqx.field(static=True, metadata=names_along("coordinate"))

    @property
    def status(self) -> CriterionStatus:
        """Outcome of the criterion, a `CriterionStatus`.

        Every machine has a first resonance, with damping and without, and finite shapes; other speeds may be absent.
        """
        resonances = jnp.stack([self.resonances[0], self.damped_resonances[0]])
        is_finite = jnp.all(jnp.isfinite(resonances)) & jnp.all(jnp.isfinite(self.shapes))
        status = CriterionStatus.where(self.resonances[0] == 0.0, CriterionStatus.free, CriterionStatus.decided)
        return CriterionStatus.where(is_finite, status, CriterionStatus.not_finite)

    def labelled(self, *, damped: bool = False) -> list[tuple[str, float]]:
        """Return all speeds with their labels ("resonance 1", "additional 1", ...), ascending."""
        kinds = ("resonance", "additional")
        speeds = (self.damped_resonances, self.damped_additional) if damped else (self.resonances, self.additional)
        rows = zip(kinds, speeds, strict=True)
        pairs = [(f"{kind} {k + 1}", float(w)) for kind, row in rows for k, w in enumerate(row)]
        # The order of equal speeds is resonance k, additional k, resonance k + 1.
        pairs.sort(key=lambda pair: (int(pair[0].split()[1]), pair[0][0] != "r"))
        return [pair for pair in pairs if pair[1] == pair[1]]

    def summary(self) -> str:
        """Return the speeds without damping, the mode shapes of the resonances and the sign changes with damping as text."""
        unit, scale = speed_unit()
        lines = [f"{'no damping':14s}{unit:>12s}  mode shape ({', '.join(self.coordinates)})"]
        for label, speed in self.labelled():
            line = f"{label:14s}{scale * speed:12.6g}"
            if label.startswith("resonance"):
                shape = self.shapes[:, int(label.split()[1]) - 1]
                relative = shape / shape[jnp.argmax(jnp.abs(shape))]
                line += "  " + ", ".join(_entry_text(complex(x)) for x in relative)
            lines.append(line)
        damped = ", ".join(f"{label} {scale * speed:.6g}" for label, speed in self.labelled(damped=True))
        lines.append(f"sign changes of the criterion, with this damping: {damped} {unit}")
        return "\n".join(lines)

    def plot(self, *, unit: SpeedUnit | None = None, ax: Axes | None = None) -> Drawn:
        """Plot resonances and additional speeds, without and with damping, on a line each, in `unit`."""
        from jaxvib.draw.results import speeds_chart  # slow import

        rows = [("resonances", self.resonances), ("additional", self.additional)]
        rows += [("damped resonances", self.damped_resonances), ("damped additional", self.damped_additional)]
        return speeds_chart([(label, np.asarray(speeds)) for label, speeds in rows], unit=unit, ax=ax)


def _entry_text(entry: complex) -> str:
    """Return an entry of a mode shape as text, without parts that are rounding errors of 0."""
    real, imaginary = (round(part, 9) + 0.0 for part in (entry.real, entry.imag))
    if imaginary == 0.0:
        return f"{real:.3g}"
    return f"{imaginary:.3g}j" if real == 0.0 else f"{real:.3g}{imaginary:+.3g}j"


def port_receptance(scene: Scene, omega: Array) -> Array:
    """Return the receptance of the exciter's mount at speed `omega` (scalar, rad/s), m/N.

        A(w) = B [K - w^2 (M + sum m_j B^T B) + i w (C + w G)]^-1 B^T,     displacement = Re(A F exp(i w t))

    F is the complex amplitude of a force on the mount, and B maps the coordinates to the displacement of the mount. The masses
    of the loads move with the mount; a gyroscopic matrix G is taken at the rotor speed w.

    The result (p, p), for a mount with p directions, is complex, and not finite at an undamped resonance.

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=49.0, stiffness=4e4, damping=0.0)
    >>> scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> print(port_receptance(scene, 100.0)[0, 0].real)      # 1 / (40000 - 100^2 * 50)
    -2.173913...e-06

    Source: Filimonikhin et al. 2022, equations (14), (30), (48), for any carrier.
    """
    model = linear_model(scene)
    port = model.mount.rows[0]
    stiffness = model.dynamic_stiffness(jnp.asarray(omega, dtype=port.dtype))
    return port @ small_solve(stiffness, port.T.astype(stiffness.dtype))


def characteristic_speeds(scene: Scene) -> CharacteristicSpeeds:
    """Return resonances and additional speeds of a scene's machine with its loads, without and with damping.

    Coincident loads exert the force S w^2 Re(e exp(i w t)) on the mount; e is its rotating direction (a scalar for a mount with
    one direction, (1, -i) for two). The criterion is the mean of force times displacement, with b = B^T e:

        Re(e^H A(w) e) = Re(b^H [K - w^2 (M_S - i G) + i w C]^-1 b)

    M_S = M + sum m_j B^T B is the mass matrix with the loads. Without the gyroscopic matrix G the mean is the real part of the
    trace of A. Without damping, the poles of the mean are the eigenvalues of K y = w^2 (M_S - i G) y, and its zeros are those
    of the same problem on b^H y = 0 (the mount fixed). Poles and zeros interlace.

    With damping, the sign changes of the mean are bracketed on a grid between the lowest and the highest undamped resonance.
    Outside this range damping cannot change the sign, because Re(b^H D^-1 b) = y^H (K - w^2 (M_S - i G)) y, where D is the
    matrix in brackets and y = D^-1 b. A damper between the exciter's platform and the foundation changes none of these speeds,
    because it adds only to the imaginary part of 1/A.

    The derivatives of the speeds are finite for equal resonances and for links without stiffness (0 for a resonance at speed
    0). Two sign changes closer to each other than 1e-11 of the highest resonance count as none.

    **Raises** `InputError` for machines that `criterion` refuses.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("criterion", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3,
    ...                         link_damping=0.01, rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> speeds = characteristic_speeds(form.scene())
    >>> [(label, round(w, 4)) for label, w in speeds.labelled()]
    [('resonance 1', 0.3333), ('additional 1', 0.7454), ('resonance 2', 1.0)]
    >>> [(label, round(w, 4)) for label, w in speeds.labelled(damped=True)]
    [('resonance 1', 0.3334), ('additional 1', 0.7467), ('resonance 2', 0.998)]

    Source: Filimonikhin et al. 2022, equations (12), (32)-(38), (53)-(59) with their misprints corrected, for any carrier.
    """
    scene = validate_scene(scene)
    require_one_point(scene.mounting)
    speeds, *parts = _characteristic_speeds(scene)
    when_known(partial(_require_mount_that_moves, scene), *parts)
    allowed = allowed_unknowns(scene)
    return speeds if allowed is None else jax.tree.map(lambda x: jnp.where(allowed, x, jnp.nan), speeds)


@cached
def _characteristic_speeds(scene: Scene) -> tuple[CharacteristicSpeeds, Array, Array, Array]:
    """Return the characteristic speeds, and the mount, stiffness and mass of the carrier with its loads."""
    model = linear_model(scene)
    carrier, direction = model.carrier, _direction(model)
    gyroscopic = model.mount.gyroscopic
    if gyroscopic is None:
        square, inverse = relative_to(model.mass, carrier.stiffness)
        values, vectors, fixed = _free_and_fixed_modes(square, inverse @ direction)
        resonances, additional = root_or_zero(values), root_or_zero(fixed)
        shapes = inverse.T @ vectors
    else:
        # The metric is K, because M_S - i G is not positive definite for a large polar moment: one of the resonances then does
        # not exist.
        square, inverse = relative_to(carrier.stiffness, model.mass - 1j * gyroscopic)
        values, vectors, fixed = _free_and_fixed_modes(square, inverse @ direction)
        resonances, additional = _inverse_root(values)[::-1], _inverse_root(fixed)[::-1]
        shapes = inverse.T @ vectors[:, ::-1] * jnp.where(jnp.isnan(resonances), 0.0, resonances)[None, :]
    changes = _sign_changes(model, direction, resonances, additional, shapes)
    speeds = CharacteristicSpeeds(resonances, additional, shapes, changes[0::2], changes[1::2], carrier.coordinates)
    return speeds, model.mount.rows[0], carrier.stiffness, model.mass


def _direction(model: LinearModel) -> Array:
    """Return the force direction b = B^T e (nd,); real for a mount with one direction, whose phase has no effect."""
    return model.mount.rows[0][0] if len(model.mount.axes) == 1 else model.direction


def _require_mount_that_moves(scene: Scene, port: np.ndarray, stiffness: np.ndarray, mass: np.ndarray) -> None:
    """**Raises** `InputError` if no coordinate moves the mount, a rotor has a motion without a spring, or a resonance is lost
    in rounding errors."""
    if not np.any(port):
        problem = "does not move with any coordinate, and its loads have no effect; put the exciter at a point that can move"
        raise InputError("machine.mount", problem)
    require_finite("stiffnesses and masses of the machine", stiffness, mass)
    if scene.mounting.gyroscopic is not None:
        if not np.all(np.linalg.eigvalsh(stiffness) > 0.0):
            raise InputError("machine.stiffness", "leaves a motion of the rotor without a spring; every motion needs one")
        return
    # A resonance is lost in rounding errors if it is much lower than the highest one, although a spring resists its motion.
    rounding = mass.shape[0] * np.finfo(mass.dtype).eps
    inverse = np.linalg.inv(np.linalg.cholesky(mass))
    squares = np.linalg.eigvalsh(inverse @ stiffness @ inverse.T)
    size = np.sqrt(np.where(np.diag(stiffness) > 0.0, np.diag(stiffness), 1.0))
    free = np.sum(np.linalg.eigvalsh(stiffness / np.outer(size, size)) <= 100.0 * rounding)
    if np.sum(squares <= rounding * squares[-1]) > free:
        stiff = int(np.argmax(np.diag(stiffness) / np.diag(mass)))
        name = scene.machine.structure().coordinates[stiff]
        reason = "too high for this precision"
        advice = "use a softer spring or leave this coordinate out of the machine"
        if np.any(port[:, stiff]):
            raise InputError("machine.exciter", f"is attached to {name}, where the stiffness is {reason}; {advice}")
        raise InputError("machine.stiffness", f"is {reason} at {name}; {advice}")


def _inverse_root(values: Array) -> Array:
    is_positive = values > 0.0
    return jnp.where(is_positive, 1.0 / jnp.sqrt(jnp.where(is_positive, values, 1.0)), jnp.nan)


def _free_and_fixed_modes(square: Array, c: Array) -> tuple[Array, Array, Array]:
    """Return ascending eigenvalues and vectors of `square` (nd, nd), and its eigenvalues (nd - 1,) on the orthogonal
    complement of c."""
    size = magnitude(c[0])
    phase = jnp.where(size > 0.0, c[0] / jnp.where(size > 0.0, size, 1.0), 1.0)
    # A reflection maps c to the first axis; the other axes are then a basis of the complement of c.
    mirror = c.at[0].add(phase * jnp.sqrt(jnp.sum((c * c.conj()).real)))
    length = jnp.sum((mirror * mirror.conj()).real)
    reflect = jnp.eye(c.shape[0], dtype=c.dtype) - 2.0 * jnp.outer(mirror, mirror.conj()) / length
    fixed = (reflect @ square @ reflect).at[0, :].set(0.0).at[:, 0].set(0.0)
    # One call for both problems; the direction of the mount gets an eigenvalue above all others.
    fixed = fixed.at[0, 0].set(2.0 * jnp.sqrt(jnp.sum(jnp.abs(jax.lax.stop_gradient(square)) ** 2)))
    values, vectors = hermitian_modes(jnp.stack([square.astype(fixed.dtype), fixed]))
    return values[0], vectors[0], values[1, :-1]


def _sign_changes(model: LinearModel, direction: Array, resonances: Array, additional: Array, shapes: Array) -> Array:
    """Return the sign changes of Re(b^H D(w)^-1 b), ascending (2 nd - 1,), the first from + to -; NaN for missing ones."""
    frozen, b, poles, zeros, forms = jax.lax.stop_gradient((model, direction, resonances, additional, shapes))
    carrier = model.carrier
    last = jnp.max(jnp.where(jnp.isnan(poles), 0.0, poles))
    last = jnp.where(last > 0.0, last, 1.0)  # a machine without springs
    tiny_damping = jnp.finfo(last.dtype).eps ** 0.75 * last
    # The term `smooth` changes neither the real part of 1/A nor the sign changes. It makes the functional smooth at the poles.
    participation = jnp.sum(jnp.abs(b.conj() @ forms) ** 2)
    smoothing = 1j * last**2 / participation
    smooth = smoothing * jnp.outer(b, b.conj())

    def functional(m: LinearModel, w: Array) -> Array:
        # A small damping is added, because a mode without damping that never moves the mount gives 0/0 at its resonance.
        matrix = m.dynamic_stiffness(w) + 2j * w * tiny_damping * frozen.mass + smooth
        return jnp.sum(b.conj() * small_solve(matrix, b.astype(matrix.dtype))).real

    damped = eqx.tree_at(lambda m: m.carrier.damping, frozen, frozen.carrier.damping + 2.0 * tiny_damping * frozen.mass)
    modal = damped.decomposed().modal

    def fast_functional(w: Array) -> Array:
        if modal is None:
            return functional(frozen, w)
        receptance = modal.receptance(w)
        return (receptance / (1.0 + smoothing * receptance)).real

    width = jnp.einsum("ar,ab,br->r", forms.conj(), jax.lax.stop_gradient(carrier.damping), forms).real / 2.0 + tiny_damping
    poles = jnp.where(jnp.isnan(poles), last, poles)
    if model.mount.gyroscopic is not None:
        # A rotor with a large polar moment can have its last sign change above the last resonance.
        end = 4.0 * jnp.maximum(last, jnp.max(jnp.where(jnp.isnan(zeros), 0.0, zeros), initial=0.0))
        poles, width = jnp.append(poles, end), jnp.append(width, last)
    s = (jnp.arange(_GRID_POINTS) + 0.5)[None, :] / _GRID_POINTS
    half = (poles[1:] - poles[:-1])[:, None] / 2.0
    left, right = width[:-1, None], width[1:, None]
    inside = jnp.concatenate(
        [
            poles[:-1, None] + left * jnp.sinh(s * jnp.arcsinh(half / left)),
            poles[1:, None] - right * jnp.sinh(s[:, ::-1] * jnp.arcsinh(half / right)),
        ],
        axis=1,
    )
    grid = jnp.concatenate([0.999 * poles[:1], inside.ravel(), 1.001 * poles[-1:]])

    # Below the first resonance the sign is + for any damping; for a machine that can drift, the sign changes at speed 0.
    # `map` loops over the grid points: a batch of machines then needs the memory of only one grid point for each machine.
    positive = jnp.append(jnp.asarray([True]), jax.lax.map(lambda w: fast_functional(w) > 0.0, grid[1:]))
    passed = jnp.cumsum(positive[1:] != positive[:-1])
    order = jnp.arange(2 * resonances.shape[0] - 1)
    cell = jnp.minimum(jnp.sum(passed[None, :] <= order[:, None], axis=1), passed.shape[0] - 1)
    exists = order < passed[-1]

    def refine(low: Array, high: Array) -> Array:
        polish = None if modal is None else modal.is_rough
        return bracketed_root(lambda w: functional(model, w), low, high, fast=fast_functional, polish=polish)

    roots = jax.vmap(refine)(grid[cell], grid[cell + 1])
    roots = jnp.where((order == 0) & (grid[0] == 0.0), 0.0, roots)
    return jnp.where(exists, roots, jnp.nan)
