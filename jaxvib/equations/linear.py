"""Linear carrier with its loads: natural frequencies, dynamic stiffness, response to loads that turn together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Self, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import speed_text
from jaxvib.equations.modal import ModalResponse, modal_response
from jaxvib.equations.model import Model, assemble
from jaxvib.errors import InputError, quoted
from jaxvib.machine.carrier import Mount
from jaxvib.machine.drives.drive import Drive
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.effects.terms import ContactFriction, GravityField, LoadInteraction, LoadPotential, RotorImbalance, Term
from jaxvib.machine.loads import CircularLoads, Loads
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import allowed_unknowns, validate_scene
from jaxvib.numerics.linalg import (
    MAX_EIGENVALUE_ERROR,
    complex_product,
    hermitian_error,
    hermitian_modes,
    magnitude,
    refine_solution,
    relative_to,
    root_or_zero,
    small_solve,
)
from jaxvib.results.status import failure
from jaxvib.runtime.programs import cached
from jaxvib.units.known import when_known

TURNING_TERMS = (GravityField, LoadPotential, LoadInteraction, RotorImbalance)
"""Terms that analyses of turning loads include.

These terms keep the carrier linear. Their mean torque over a turn on loads that turn together is 0 to leading order of the mass
of the loads.
"""

JAM_TERMS = (*TURNING_TERMS, ContactFriction)
"""Terms that analyses of jams include."""


_MAX_DIRECT_SIZE = 3
"""Largest number of coordinates for which `small_solve` writes the equations out."""


LOST_FREQUENCY = (
    "a natural frequency is lost in rounding errors: use double precision, or stiffnesses and masses that differ less"
)
"""Message of the status `lost_digits` of natural frequencies."""


class FrequencyStatus(eqx.Enumeration):
    """Outcomes of a computation of natural frequencies. The value of each member is the message shown to the user."""

    done = "the result was computed"
    lost_digits = LOST_FREQUENCY


class LinearModel(Model):
    """Model whose loads are masses that move with the machine.

        D(w) = K - w^2 M + i w (C + n G),      M = M_carrier + sum_j m_j B_j^T B_j

    D is the dynamic stiffness. C, K and G are the damping, stiffness and gyroscopic matrices of the carrier, and n is the rotor
    speed. Load j has the mass m_j, and B_j q is the displacement of the point that carries it (B q for loads at one point).

    **Attributes**, in addition to those of `Model`: `mass` M (nd, nd) kg, with each load at its own place; `modal`, the modal
    form of the model, see `decomposed`.
    """

    mass: Array
    modal: ModalResponse | None = eqx.field(default=None, kw_only=True)

    @property
    def direction(self) -> Array:
        """Generalized force B^T e (nd,), complex, of a unit force that turns at the mount, with e from `rotating_direction`."""
        return self.mount.rows[0].T @ rotating_direction(self.mount)

    def damping(self, speed: Array) -> Array:
        """Return C + n G (nd, nd) N s/m at the rotor's `speed` n, rad/s, or at the mean speed of several rotors."""
        damping, gyroscopic = self.carrier.damping, self.mounts[0].gyroscopic
        return damping if gyroscopic is None else damping + speed * gyroscopic

    def dynamic_stiffness(self, omega: Array, speed: Array | None = None) -> Array:
        """Return D(w) (nd, nd), N/m, at the frequency `omega` w and the rotor's `speed` n, rad/s (default: w)."""
        damping = self.damping(omega if speed is None else speed)
        return jax.lax.complex(self.carrier.stiffness - omega**2 * self.mass, omega * damping)

    def dissipated(self, velocity: Array) -> Array:
        """Return the mean power sum_k V_k^H C V_k / 2, W, that the carrier's damping dissipates in a periodic motion with the
        complex amplitudes `velocity` V (nd, K) or (nd,) of the coordinates' rates."""
        return jnp.vdot(velocity, self.carrier.damping @ velocity).real / 2.0

    def peak_matrices(self) -> tuple[Array, Array, Array]:
        """Return M, C and K at the working speed; peaks of the response are near the roots s of det(s^2 M + s C + K) = 0."""
        return self.mass, self.damping(self.scene.drive.speed), self.carrier.stiffness

    @property
    def highest_speed(self) -> Array | None:
        """Speed, rad/s, above which no steady motion exists; None if there is no such limit."""
        return None

    def modes(self) -> tuple[Array, Array]:
        """Return the undamped natural frequencies (nd,) rad/s, ascending, and the mass-normalized mode shapes as columns."""
        square, inverse = relative_to(self.mass, self.carrier.stiffness)
        values, vectors = hermitian_modes(square)
        return root_or_zero(values), inverse.T @ vectors

    def decomposed(self, direction: Array | None = None) -> Self:
        """Return this model with its modal form, which is faster for many load speeds; `direction` (count, nd) of the forces of
        several masses, default: that of the model.

        Two kinds of models have no modal form: those of up to 3 coordinates, because a direct solution takes no longer, and
        those with gyroscopic coupling, which the modal form does not include.
        """
        if self.mass.shape[0] <= _MAX_DIRECT_SIZE or self.mounts[0].gyroscopic is not None:
            return self
        frozen = jax.lax.stop_gradient(self)
        frequencies, shapes = frozen.modes()
        carrier = frozen.carrier
        matrices = carrier.stiffness, carrier.damping, frozen.mass
        direction = frozen.direction if direction is None else jax.lax.stop_gradient(direction)
        modal = modal_response(frequencies, shapes, *matrices, direction)
        return eqx.tree_at(lambda model: model.modal, self, modal, is_leaf=lambda leaf: leaf is None)


def linear_model(scene: Scene) -> LinearModel:
    """Return the linear model of a scene with its loads, see `LinearModel`."""
    model = assemble(scene)
    mass = model.carrier.mass
    for exciter, mount in zip(scene.exciters, model.mounts, strict=True):
        if exciter.loads is None:
            continue
        each = jnp.broadcast_to(exciter.loads.mass, (exciter.loads.count,))
        if mount.at_one_point:
            mass = mass + jnp.sum(each) * mount.rows[0].T @ mount.rows[0]
        else:
            rows = mount.load_rows(exciter.loads.count)
            mass = mass + jnp.einsum("j,jka,jkb->ab", each, rows, rows)
    return LinearModel(scene, model.carrier, model.mounts, model.supports, mass)


def mean_speed(scene: Scene, unbalances: Array | None = None) -> Array:
    """Return the mean speed of all rotors, rad/s, anticlockwise, at the working speeds of their drives, or with the speed
    `unbalances` of the rotors without loads."""
    speeds = [
        exciter.direction * (exciter.drive.speed if unbalances is None or exciter.loads is not None else unbalances)
        for exciter in scene.exciters
    ]
    return sum(speeds[1:], speeds[0]) / len(speeds)


class ExcitedModel(LinearModel):
    """Linear model under the force of masses that turn together at the speed w: S w^2 Re(f exp(i w t)) on the coordinates.

    **Attributes**, in addition to those of `LinearModel`: `unbalance` S, kg m; `force_direction` f (nd,) complex.
    """

    if TYPE_CHECKING:  # fields of the subclasses, in their own order
        unbalance: Array = eqx.field(init=False)
        force_direction: Array = eqx.field(init=False)

    @property
    def direction(self) -> Array:
        return self.force_direction

    @property
    def extra_peaks(self) -> int:
        """Largest number of peaks of the branch in addition to those of the resonances."""
        return 0

    def force(self, omega: Array) -> Array:
        """Return the amplitudes (nd,), N, of the force on the coordinates at the speed `omega` of the masses."""
        return self.unbalance * omega**2 * self.force_direction

    def displacement(self, omega: Array, speed: Array | None = None) -> Array:
        """Return the complex amplitudes Y (nd,) of the coordinates at the speed `omega` of the masses, and the `speed` of the
        rotor (default: `omega`), rad/s."""
        modal = self.modal
        if modal is None:
            return small_solve(self.dynamic_stiffness(omega, speed), self.force(omega))

        def product(y: Array) -> Array:
            """Return D(w) y from the matrices, so that derivatives follow from the matrices and not from eigenvectors."""
            carrier = self.carrier
            elastic, inertia, viscous = (complex_product(a, y) for a in (carrier.stiffness, self.mass, carrier.damping))
            return elastic - omega**2 * inertia + 1j * omega * viscous

        def solver(modal: ModalResponse) -> Callable[[Callable[[Array], Array], Array], Array]:
            return lambda product, right: refine_solution(
                product, lambda rest: modal.solve(omega, rest), right, modal.norm(omega)
            )

        return jax.lax.custom_linear_solve(product, self.force(omega), solver(modal), solver(modal.transposed))

    def forward_acceleration(self, omega: Array) -> Array:
        """Return w^2 f^H Y (complex scalar, m/s^2) at the speed `omega` of the masses. With a modal form the cost is O(nd), and
        there are no derivatives with respect to parameters of the scene."""
        if self.modal is None:
            return omega**2 * jnp.sum(jnp.conj(self.force_direction) * self.displacement(omega))
        return self.unbalance * omega**4 * self.modal.receptance(omega)


class JammedModel(ExcitedModel):
    """Linear model of a scene with jammed loads.

    It contains the quantities that are equal at all load speeds, so that an analysis computes them once.

    **Attributes**, in addition to those of `LinearModel`: `unbalance` S of the coincident loads, kg m; `drag` sum b_W R^2,
    N m s; `force_direction` (nd,) complex, the `direction` of the loads' force.
    """

    unbalance: Array
    drag: Array
    force_direction: Array

    @property
    def loads(self) -> CircularLoads:
        """Loads of the scene."""
        return cast(CircularLoads, self.scene.loads)

    def displacement(self, omega: Array, speed: Array | None = None) -> Array:
        """Return the complex amplitudes Y (nd,) m of the carrier under loads that turn together at `omega` (scalar, rad/s).

            (K - w^2 (M + sum m_j B^T B) + i w (C + n G)) Y = S w^2 B^T e,     q(t) = Re(Y exp(i w t)),    S = sum m_j R_j

        The angle of the loads is w t. The result is the limit of light loads (eps -> 0) of a jam. If the carrier has a
        gyroscopic matrix G, the rotor's `speed` n, rad/s, is needed; without it, **raises** `InputError`.

        >>> import jaxvib as jv
        >>> machine = jv.one_mass(mass=49.0, stiffness=4e4, damping=0.0)
        >>> scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
        >>> print(abs(jammed_model(scene).displacement(100.0)[0]))      # 0.1 100^2 / (50 100^2 - 4e4)
        0.002173913...

        Source: Filimonikhin et al. 2022, section 4; the antiphase paper, equations (25)-(29).
        """
        if self.mount.gyroscopic is not None and speed is None:
            problem = "jam modes are not defined with gyroscopic coupling; use phase_jams, or jam_orbit near a load speed"
            raise InputError("machine.kind", f"is {quoted(self.scene.machine.kind)}; {problem}")
        return super().displacement(omega, speed)


def jammed_model(scene: Scene) -> JammedModel:
    """Return the carrier of a scene with its jammed loads, see `JammedModel`. **Raises** `InputError` like `jammed_loads`."""
    loads, model = jammed_loads(scene), linear_model(scene)
    linear = model.scene, model.carrier, model.mounts, model.supports, model.mass
    return JammedModel(*linear, loads.unbalance(), loads.drag_sum(), model.direction)


@validated
def natural_frequencies(scene: Scene) -> Array:
    """Return the undamped natural frequencies of the carrier with its loads, ascending, (nd,) rad/s.

        det(K - w^2 (M + sum_j m_j B_j^T B_j)) = 0

    K and M are the stiffness and mass matrices of the carrier. Load j has the mass m_j, and B_j maps the coordinates of the
    carrier to the displacement of the point that carries the load.

    **Arguments**: `scene`; only its machine, its loads and the masses of its unbalances are used.

    **Returns** an array (nd,), rad/s; typical: 10 to 100 for platforms on springs, 100 to 500 for rotors. Derivatives are
    finite for equal frequencies, and taken as 0 at frequency 0 (a carrier that is free to drift).

    **Raises** `ComputationError` (status "lost_digits") if a frequency is lost in rounding errors, for example that of a soft
    spring next to a link 1e8 times as stiff, in single precision. Under a JAX transformation such a frequency is NaN, and all
    are NaN if a parameter has a value that its constructor would reject.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> [round(float(w), 4) for w in jv.natural_frequencies(form.scene())]
    [0.3333, 1.0]

    Source: the antiphase paper, equations (19), (23).
    """
    scene = validate_scene(scene)
    frequencies, lost = _natural_frequencies(scene)
    is_lost = when_known(lambda lost, _: bool(np.any(lost)), lost, frequencies)
    if is_lost:
        raise failure(FrequencyStatus.lost_digits)
    allowed = allowed_unknowns(scene)
    missing = lost if allowed is None else lost | ~allowed
    return jnp.where(missing, jnp.nan, frequencies) if is_lost is None else frequencies


def estimated_frequencies(scene: Scene) -> Array:
    """Return `natural_frequencies` without the error for lost digits, for marks in figures and choices of step sizes."""
    return _natural_frequencies(validate_scene(scene))[0]


@cached
def _natural_frequencies(scene: Scene) -> tuple[Array, Array]:
    """Return the natural frequencies (nd,) rad/s, and flags (nd,) that are True for those lost in rounding errors."""
    model = linear_model(scene)
    frequencies, shapes = model.modes()
    return frequencies, lost_frequencies(model, frequencies, shapes)


def lost_frequencies(model: LinearModel, frequencies: Array, shapes: Array) -> Array:
    """Return True for each of the natural frequencies (nd,) that is lost in rounding errors, from `LinearModel.modes`."""
    w, x, mass, carrier = jax.lax.stop_gradient((frequencies, shapes, model.mass, model.carrier))
    lost = hermitian_error((carrier.stiffness, mass), w**2, x) > 2.0 * MAX_EIGENVALUE_ERROR
    # A motion of frequency 0 is free to drift unless springs resist it. Beside stiff springs soft ones can be seen in their own
    # row only; next to stiff links, soft supports can be seen in the force on the foundation only.
    springs = jnp.concatenate([carrier.stiffness, carrier.foundation_stiffness])
    largest = jnp.max(jnp.abs(springs), axis=1)[:, None] * jnp.max(jnp.abs(x), axis=0)[None, :]
    resisted = jnp.any(jnp.abs(springs @ x) > 1e-3 * largest, axis=0)
    return jnp.where(w > 0.0, lost, resisted)


def rotating_direction(mount: Mount, direction: int = 1) -> Array:
    """Return the rotating direction e, one entry for each direction of the mount: a point on the unit circle at the angle
    `direction` w t (-1: clockwise) has the position Re(e exp(i w t))."""
    return jnp.asarray([(1.0, -1.0j if direction == 1 else 1.0j)[axis] for axis in mount.axes])


def peak_force(force: Array) -> Array:
    """Return the root of the sum of the squared peaks, N, of a force with a complex amplitude, N, for each direction."""
    return magnitude(force[0]) if force.shape[0] == 1 else jnp.sqrt(jnp.sum(magnitude(force) ** 2))


def jammed_loads(scene: Scene) -> CircularLoads:
    """Return the loads of a scene, for an analysis of coincident loads, which may have dry friction."""
    return turning_loads(scene, JAM_TERMS, at_one_point=True)


def turning_loads(
    scene: Scene, included: tuple[type[Term], ...] = TURNING_TERMS, *, at_one_point: bool = False
) -> CircularLoads:
    """Return the loads of a scene, for an analysis of loads on circles in a rotor of prescribed speed.

    **Raises** `InputError`, which names the property or the term, for

    - a body in a plane, because the housing of its exciter rotates
    - loads that are not `circular`, and a drive that is not `ideal`
    - effects with terms that are not `included`
    - loads at several stations, if `at_one_point` is True
    """
    if not isinstance(scene, Scene):
        raise InputError("scene", f"is {quoted(scene)}; it must be a Scene, for example load_scene('machine.toml')")
    mounting, loads, drive, effects = scene.mounting, scene.loads, scene.drive, scene.all_effects
    if mounting.turn is not None:
        problem = (
            "rotates with the housing of its exciter, which this function does not include: use simulate, settle or ensemble"
        )
        raise InputError("machine.kind", f"is {quoted(scene.machine.kind)}, which {problem}")
    require_circular(loads, drive)
    require_terms(effects, included)
    if at_one_point:
        require_one_point(mounting)
    return cast(CircularLoads, loads)


def require_drag(loads: CircularLoads, *, each: bool = False) -> None:
    """**Raises** `InputError` unless one load or, with `each`, all loads have drag. Traced values are not checked."""
    if when_known(lambda drag: not (np.all if each else np.any)(np.asarray(drag) > 0.0), loads.drag):
        raise InputError("loads.drag", "is 0; this function needs a viscous drag greater than 0, also with dry friction")


def require_one_point(mounting: Mount) -> None:
    """**Raises** `InputError` for loads at different stations along the machine's axis."""
    if not mounting.at_one_point:
        problem = (
            "differ; this function needs loads that run at one point of the machine: use phase_jams for their jams, "
            "balanced_states for their balance (jaxvib balance), or simulate"
        )
        raise InputError("machine.stations", problem)


def require_circular(loads: Loads, drive: Drive) -> None:
    """**Raises** `InputError` for loads that are not `circular` and for a drive that is not `ideal`."""
    if not loads.circular:
        needed = "this function needs loads on a circle with viscous drag (property circular): ball, roller, pendulum"
        raise InputError("loads.kind", f"is {quoted(loads.kind)}, and {needed}; use simulate for other loads")
    if not drive.ideal:
        raise InputError(
            "drive.kind",
            f"is {quoted(drive.kind)}; this function needs a prescribed rotor speed (property ideal); use simulate for loads "
            f"on the rotor of a motor, or ConstantSpeed{_no_load_text(drive)}",
        )


def _no_load_text(drive: Drive) -> str:
    """Return the no-load speed of the rotor as the argument of `ConstantSpeed`; "" for a traced speed."""
    speed = when_known(speed_text, drive.speed)
    return "" if speed is None else f"({quoted(speed)}) at the no-load speed of the rotor"


def require_terms(
    effects: Sequence[Effect],
    included: tuple[type[Term], ...],
    problem: str = "is|are not included in this function",
    advice: str = "here, or simulate",
) -> None:
    """**Raises** `InputError` that names the `effects` with terms that are not `included` in an analysis, and their types.

    **Arguments**: `problem`, the message, which begins with the verbs for one effect and, after |, for several; `advice`: end
    of the sentence that advises to leave the effects out.
    """
    others = [(effect.kind, type(term).__name__) for effect in effects for term in effect.terms() if type(term) not in included]
    if not others:
        return
    kinds, terms = (list(dict.fromkeys(names)) for names in zip(*others, strict=True))
    verbs, rest = problem.split(" ", 1)
    singular, plural = verbs.split("|")
    rest = f"{rest} (term{'s' * (len(terms) > 1)} {_list_words(terms)})"
    if len(kinds) == 1:
        raise InputError(f"effects.{kinds[0]}", f"{singular} {rest}; leave it out {advice}")
    raise InputError("effects", f"{_list_words(kinds)} {plural} {rest}; leave them out {advice}")


def _list_words(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))
