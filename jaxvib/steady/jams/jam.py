"""Leading-order jam modes: the speeds at which light loads jam, from algebraic equations, without time integration."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto, SpeedUnit, quantity_text, shown_unit, speed_text, speed_unit
from jaxvib.equations.jammed_bodies import friction_on_light_loads
from jaxvib.equations.linear import JammedModel, jammed_loads, jammed_model, peak_force, require_drag
from jaxvib.errors import ComputationError, InputError, quoted
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import ContactFriction
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.numerics.linalg import magnitude
from jaxvib.numerics.roots import known_root
from jaxvib.results.fields import in_unit, names_along, part
from jaxvib.results.result import Result
from jaxvib.results.status import failure, sentence, status_names
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.folds import (
    Folds,
    Pieces,
    branch_pieces,
    branch_root,
    branch_tangent,
    piece_modes,
    rotor_speed_at,
    scanned_speed,
)
from jaxvib.steady.jams.phases import growth_of_free_loads
from jaxvib.steady.outcome import REFUSED, entry, outcome
from jaxvib.units.known import when_known

STABILITY_CRITERION = "by slope, for light loads that stay together"
"""Name of the stability criterion of jam modes, with its assumption."""

STABILITY_OF_FREE_LOADS = "for light loads, each of which is free to move separately"
"""Name of the stability criterion of branch diagrams, with its assumption."""

_UNRESOLVED = "no peak of its own on the branch (strong damping, a close resonance, or an exciter that does not move)"


def side_by_side_lines(scene: Scene) -> list[str]:
    """Return a line about balls that lie side by side in jam modes; an empty list for loads at one point."""
    loads = jammed_loads(scene)
    if loads.ball_radius is None or loads.count == 1 or not loads.alike:
        return []
    return ["balls lie side by side; their stability is that of points at one angle (phase_jams: points at any phases)"]


class JamStatus(eqx.Enumeration):
    """Outcomes of a jam mode. The value of each member is the message shown to the user."""

    found = "the loads can jam in this mode"
    absent = "this mode does not exist at this rotor speed"
    at_fold = "the rotor speed is that of a fold: the mode merges with another one and has no gradient"
    cannot_stay_together = (
        "these loads cannot jam at one angle: one of them needs more torque than the vibration can supply at any phase"
    )
    unbounded = "the loads turn at an undamped resonance: the vibration grows without bounds"
    refused = REFUSED
    ambiguous = (
        "the resistance of the loads falls as the rotor speed rises, and jams may therefore be missed; use simulate, or a "
        "friction that does not fall"
    )


class AbstractJam(Result):
    """Jam modes of a scene, one or several.

    **Attributes**

    - `mode`: number of the mode
    - `status`: a `JamStatus`
    - `omega`: load speed, rad/s; `rotor_speed`, rad/s
    - `stable`: True if the slope dn/dOmega > 0 and the vibration can balance the drag and dry friction of each load.
      This holds for light loads that stay together (`JamModes.stable_with_free_loads` computes whether they do)
    - `slope`: dn/dOmega
    - `displacement` (nd,): complex amplitudes of q = Re(displacement exp(i Omega t)), m (rad for tilts)
    - `amplitude` (nd,), m (rad for tilts), zero to peak; typical: 0.5 to 10 mm
    - `foundation_force`, N, zero to peak; for two directions of the force it is the root of the sum of the squares of their
      peaks (sqrt 2 times the force of a circular whirl)
    - `coordinates` (nd,): names of the coordinates, and `units` (nd,), "m" or "rad"
    """

    mode: Array = eqx.field(metadata=in_unit("", "*"))
    status: JamStatus
    omega: Array = eqx.field(metadata=in_unit("rad/s", "*"))
    rotor_speed: Array = eqx.field(metadata=in_unit("rad/s", "*"))
    stable: Array = eqx.field(metadata=in_unit("", "*"))
    slope: Array = eqx.field(metadata=in_unit("", "*"))
    displacement: Array = eqx.field(metadata=in_unit("m or rad", "*", "coordinate"))
    amplitude: Array = eqx.field(metadata=in_unit("m or rad", "*", "coordinate"))
    foundation_force: Array = eqx.field(metadata=in_unit("N", "*"))
    coordinates: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True, metadata=names_along("coordinate"))
    units: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True, metadata=names_along("unit"))


class Jam(AbstractJam):
    """One jam mode of a scene, see `AbstractJam`.

    Returned by `JamModes.select`.
    """

    def summary(self) -> str:
        """Return one line of text; amplitude zero to peak."""
        if not np.isfinite(self.omega):
            return f"mode {int(self.mode)}: {self.message}"
        return (
            f"mode {int(self.mode)}: Omega {speed_text(self.omega, 6)}, {self.judgement}, "
            f"amplitude {quantity_text(self.amplitude, 'm', 4)}, "
            f"foundation force {quantity_text(self.foundation_force, 'N', 4)}"
        )

    @property
    def judgement(self) -> str:
        """Stability as text: "stable by slope", "unstable by slope", or "loads cannot stay together"."""
        if bool(self.status == JamStatus.cannot_stay_together):
            return "loads cannot stay together"
        return f"{'stable' if self.stable else 'unstable'} by slope"

    @validated
    def plot(self, *, unit: SpeedUnit | None = None, ax: Onto = None) -> Drawn:
        """Plot the load speed in `unit`, and the amplitudes; `ax`: two axes to plot onto."""
        return _modes_chart(jax.tree.map(lambda leaf: leaf[None], self), None, unit, ax)


class JamModes(AbstractJam):
    """All jam modes at one rotor speed: the arrays of `Jam` with a leading axis over the modes 1 .. 2 nd + 1.

    Returned by `jam_modes`.

    - A mode that does not exist has NaN values, except for `rotor_speed`, and the status `absent`. Its derivatives are 0 in
      place of NaN, which keeps the derivatives of a batch finite: test the status, not the gradient
    - All values are NaN, and the status is `ambiguous`, if dry friction with a falling radial load makes the resistance of the
      loads fall as the rotor speed rises
    - A mode at an undamped resonance has NaN amplitudes and the status `unbounded`

    **Additional attributes**: `resonances` (nd,), rad/s, and the `folds` of the branch.
    """

    outer_axes = ("mode",)

    resonances: Array = eqx.field(metadata=in_unit("rad/s", "resonance"))
    folds: Folds = eqx.field(metadata=part(prefix="fold_"))

    @property
    def exists(self) -> Array:
        """Existence of each mode, (2 nd + 1,) Booleans."""
        return (self.status != JamStatus.absent) & (self.status != JamStatus.ambiguous)

    @property
    def unresolved(self) -> list[int]:
        """Numbers of the modes that exist at no rotor speed, because their resonance has no peak of its own on the branch.

        Such a resonance is closer to another one than its bandwidth, is strongly damped, or does not move the exciter.
        """
        if np.all(self.folds.exists):
            return []
        numbers = np.asarray(_modes_of_pieces(self.folds, self.resonances))
        return [int(k) for k in np.asarray(self.mode) if k not in numbers]

    def missing_text(self) -> str:
        """Return a sentence about modes that are ambiguous or in `unresolved`; empty if there are none."""
        if "ambiguous" in status_names(self.status):
            return sentence(JamStatus.ambiguous)
        if not (modes := self.unresolved):
            return ""
        resonances = sorted({(mode + 1) // 2 for mode in modes})
        subject = f"{'each of resonances' if len(resonances) > 1 else 'resonance'} {', '.join(map(str, resonances))}"
        return f"modes {', '.join(map(str, modes))} exist at no rotor speed: {subject} has {_UNRESOLVED}"

    def mode_numbers(self) -> list[int]:
        """Return the numbers of the modes that exist, from 1 to 2 nd + 1."""
        names = zip(np.asarray(self.mode), status_names(self.status), strict=True)
        return [int(k) for k, name in names if name not in ("absent", "ambiguous")]

    @validated
    def row(self, mode: int, *, throw: bool = False) -> int:
        """Return the row of the jam mode with number `mode` in the arrays, even for a mode that does not exist.

        **Raises** `InputError` for a number outside 1 .. 2 nd + 1; with `throw` also the errors of `select`.
        """
        require_mode_number(mode, self.mode.shape[0])
        if throw:
            when_known(lambda *_: self._require_mode(int(mode)), self.omega, self.status)
        return int(mode) - 1

    def _require_mode(self, mode: int) -> None:
        name = status_names(self.status)[mode - 1]
        if name == "ambiguous":
            raise failure(JamStatus.ambiguous)
        if name == "absent":
            there, rotor = ", ".join(map(str, self.mode_numbers())), speed_text(np.asarray(self.rotor_speed)[0], 6)
            why = f": resonance {(mode + 1) // 2} has {_UNRESOLVED}" if mode in self.unresolved else ""
            raise ComputationError(
                "absent", f"jam mode {mode} does not exist at rotor speed {rotor}{why}; existing modes: {there}"
            )

    @validated
    def select(self, mode: int, *, throw: bool = True) -> Jam:
        """Return the jam mode with number `mode`.

        **Raises** `InputError` for a number outside 1 .. 2 nd + 1, and `ComputationError` for a mode that does not exist at
        this rotor speed (status "absent") or is not determined ("ambiguous"). With `throw=False`, and under a JAX
        transformation, only the status shows this.
        """
        return entry(self, Jam, self.row(mode, throw=throw))

    @validated
    def summary(self, scene: Scene | None = None) -> str:
        """Return the table of `jaxvib modes` in text; amplitudes and foundation force are zero to peak.

        **Arguments**: `scene` of the modes. If it is given, the column "stable" also states whether the loads stay together, as
        in the table of the command; balls count as points (not computed for loads with dry friction).
        """
        rotor, resonances = (speed_text(speed) for speed in (np.asarray(self.rotor_speed)[0], self.resonances))
        growth = {} if scene is None else growth_of_modes(self, scene)
        lines = modes_table(self, growth)
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        rows = ("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in lines)
        notes = [text] if (text := self.missing_text()) else []
        notes += [] if scene is None else side_by_side_lines(scene)
        is_known = any(map(math.isfinite, growth.values()))
        notes += [f"stable: {STABILITY_OF_FREE_LOADS if is_known else STABILITY_CRITERION}"]
        notes += ["(summary(scene) computes whether they stay together)"] if scene is None else []
        stable = [k for k in growth if bool(self.stable[self.row(k)]) and growth[k] < 0.0]
        notes += ["several modes are stable: simulate(..., start='spin_up') shows which is reached"] if len(stable) > 1 else []
        return "\n".join([f"rotor {rotor}; resonances {resonances}", *rows, *notes])

    @validated
    def stable_with_free_loads(self, scene: Scene) -> np.ndarray:
        """Return True for each mode (2 nd + 1,) that is `stable` and whose loads stay together if each is free to move
        separately, as in the table of `jaxvib modes`. Balls count as points; loads with dry friction are assumed to
        stay together.

        **Arguments**: `scene` of the modes.

        >>> import jaxvib as jv
        >>> machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
        >>> scene = jv.Scene(machine, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
        >>> modes = jv.jam_modes(scene)
        >>> modes.stable.tolist(), modes.stable_with_free_loads(scene).tolist()
        ([True, False, False, False, True], [True, False, False, False, False])
        """
        return np.asarray(self.stable) & ~(growth_of_free_loads(scene, self.omega) > 0.0)

    @validated
    def plot(self, scene: Scene | None = None, *, unit: SpeedUnit | None = None, ax: Onto = None) -> Drawn:
        """Plot the load speed of each mode in `unit`, with the resonances, and the amplitudes; `ax`: two axes to plot onto.

        Stable modes are filled: by slope, or, if the `scene` of the modes is given, according to `stable_with_free_loads`.
        """
        stricter = None if scene is None else self.stable_with_free_loads(scene)
        return _modes_chart(self, self.resonances, unit, ax, stricter)


def require_mode_number(mode: object, count: int) -> None:
    """Raise `InputError` unless `mode` is a whole number from 1 to `count`."""
    if isinstance(mode, bool) or not isinstance(mode, (int, np.integer)) or not 1 <= mode <= count:
        raise InputError("mode", f"is {quoted(mode)}; this machine's jam modes are numbered 1 to {count}")


def require_mode_of(scene: Scene, mode: object) -> None:
    """Raise `InputError` unless `mode` is the number of a jam mode of a `scene`, which has 2 nd + 1."""
    require_mode_number(mode, 2 * len(scene.machine.structure().coordinates) + 1)


def growth_of_modes(jams: JamModes, scene: Scene) -> dict[int, float]:
    """Return `growth_of_free_loads` of each mode, 1/s, by mode number."""
    numbers = np.asarray(jams.mode).tolist()
    return dict(zip(numbers, growth_of_free_loads(scene, jams.omega).tolist(), strict=True))


def modes_table(jams: JamModes, growth: Mapping[int, float]) -> list[list[str]]:
    """Return the headers and the rows of the table of all jam modes that exist.

    **Arguments**: `growth`: growth rates of disturbances that separate the loads, 1/s, by mode number; missing if unknown.
    """
    unit, scale = speed_unit()
    existing = [jams.select(k) for k in jams.mode_numbers()]
    shown = [shown_unit(each, _largest_amplitude(jams, k)) for k, each in enumerate(jams.units)]
    headers = [f"{name}, {length}" for name, (length, _) in zip(jams.coordinates, shown, strict=True)]
    rows = [
        [
            f"{int(jam.mode)}",
            f"{scale * float(jam.omega):.5g}",
            stability_text(jam, growth.get(int(jam.mode), math.nan)),
            *(f"{factor * float(a):.4g}" for a, (_, factor) in zip(np.asarray(jam.amplitude), shown, strict=True)),
            f"{float(jam.foundation_force):.4g}",
        ]
        for jam in existing
    ]
    return [["mode", unit, "stable", *headers, "force, N"], *rows]


def _largest_amplitude(jams: JamModes, coordinate: int) -> float:
    """Return the largest amplitude of the coordinates that have the unit of this one, m or rad."""
    same = np.asarray([unit == jams.units[coordinate] for unit in jams.units])
    values = np.asarray(jams.amplitude)[:, same]
    return float(np.max(values, initial=0.0, where=np.isfinite(values)))


def stability_text(jam: Jam, growth: float) -> str:
    """Return a text about the stability of a jam, from its slope and from the growth rate of disturbances that separate the
    loads, NaN if it is unknown."""
    if jam.judgement == "loads cannot stay together":
        return "no: the loads differ too much"
    if not bool(jam.stable):
        return "no"
    return "yes, if they stay together" if math.isnan(growth) else "yes" if growth < 0.0 else "no: the loads spread"


@cached
def _modes_of_pieces(folds: Folds, resonances: Array) -> Array:
    """Return the mode number of each piece of a branch."""
    return piece_modes(jnp.where(folds.exists, folds.omega, jnp.inf), folds.exists, resonances)


def _modes_chart(
    jams: AbstractJam, resonances: Array | None, unit: SpeedUnit | None, ax: Onto, stricter: np.ndarray | None = None
) -> Drawn:
    from jaxvib.draw.results import modes_chart  # slow import

    mode, omega, stable, amplitude = map(np.asarray, (jams.mode, jams.omega, jams.stable, jams.amplitude))
    stable, label = (stable, "stable by slope") if stricter is None else (stricter, "stable with free loads")
    lines, about = None if resonances is None else np.asarray(resonances), {"names": jams.coordinates, "units": jams.units}
    return modes_chart(mode, omega, stable, amplitude, lines, **about, stable_label=label, unit=unit, ax=ax)


@validated
def jam_modes(scene: Scene) -> JamModes:
    """Return all jam modes of light, coincident loads at the scene's rotor speed; drag and dry friction drive the loads.

        sum b_W R^2 (n - Omega) + dry friction = mean braking torque of the vibration at Omega,  solved for Omega at the rotor
        speed n

    b_W and R are the drag and the radius of a load, and Omega is the load speed. The rotor speed is an explicit function
    n(Omega) of the load speed, the branch (see `branches`). The branch is cut at its folds dn/dOmega = 0 into monotone pieces;
    each piece that contains the rotor speed of the scene gives one mode.

    - Mode numbers follow the resonances: mode 2r - 1 is on the piece that rises to the peak of resonance r, mode 2r on the
      piece that falls from it, and mode 2 nd + 1 is beyond the last resonance. Mode 3 is therefore the jam just below the
      second resonance, even if the first one is damped so much that modes 1 and 2 have vanished
    - Rising pieces (odd modes) are stable by slope, falling ones are not
    - If several modes are stable, or one mode and the balanced motion (`balanced_states(scene).stability()`), the start of the
      machine decides which one it reaches: `simulate(scene, until, start="spin_up")`
    - If the branch has more peaks than resonances, the smallest ones are ignored: those whose rotor speed is hardly above that
      of the neighbouring minimum
    - An imbalance of the rotor (`StaticImbalance`, `MomentImbalance`) does not change a jam: its force rotates at the rotor
      speed, that of the loads at the load speed. At this order the imbalance therefore exerts no mean torque on the loads.
      The amplitudes and the foundation force are those caused by the loads only. If the contribution of the imbalance matters,
      use `simulate`

    **Arguments**: `scene` with loads that have drag, and a drive of prescribed speed, of which only the working speed matters;
    typical: loads of 0.1 % to 5 % of the machine's mass. The relative error of the result is proportional to the mass of the
    loads, see `jam_orbit`.

    Resonances whose distance is smaller than their bandwidth have one common peak of the branch and one pair of modes, which
    belongs to the resonance nearest to the peak. The status of the other modes is `absent`, and `unresolved` lists them.

    **Returns** `JamModes`; derivatives of every field with respect to every parameter of the scene are exact (implicit
    function theorem), forward and reverse. `vmap` over scenes computes the jams at many rotor speeds at once.

    **Raises** `InputError` for

    - loads without drag, at different stations, or not on a circle
    - a machine whose coordinates couple through the rotor speed (`rotor`), and a body in a plane, because the housing of the
      exciter rotates with the body
    - a motor in place of a prescribed speed
    - effects that this function does not include, such as `CubicSupport`, `Stop`, `FrictionSupport` and `Sliding`

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> modes = jv.jam_modes(form.scene())
    >>> modes.mode_numbers(), round(float(modes.omega[2]), 4)
    ([3, 4, 5], 0.9721)

    Source: the antiphase paper, section 5.2, equations (30)-(39).
    """
    scene = validate_scene(scene)
    require_drag(jammed_loads(scene))
    return outcome(jams_of(scene), scene)


def _from_jams(jams: JamModes, scene: Scene) -> JamModes:
    """Return jams with all fields computed from their load speeds, without resonances and folds."""
    n, model, exists = scene.drive.speed, jammed_model(scene).decomposed(), jams.exists
    omega = jax.vmap(lambda root: known_root(lambda w: rotor_speed_at(model, w) - n, root))(jnp.where(exists, jams.omega, n))
    fields = _fields(model, jnp.where(exists, omega, n), exists, jams.status == JamStatus.at_fold)
    return dataclasses.replace(jax.tree.map(lambda _: None, jams), **fields)


@cached(outputs_from_solution=_from_jams)
def jams_of(scene: Scene) -> JamModes:
    """Return `jam_modes` for a validated scene."""
    n, model = scene.drive.speed, jammed_model(scene).decomposed()
    pieces = branch_pieces(model)
    omega, has_root = _solve_on_pieces(model, pieces)

    numbers = jnp.arange(1, 2 * pieces.resonances.shape[0] + 2)
    hits = (pieces.mode[None, :] == numbers[:, None]) & has_root[None, :]
    exists = jnp.any(hits, axis=1)
    piece = jnp.argmax(hits, axis=1)
    omega = jnp.where(exists, omega[piece], n)

    # If the rotor speeds of the scene and of a fold differ by less than this limit, their difference is lost in rounding
    # errors, and derivatives are not significant.
    speeds = jax.lax.stop_gradient(jnp.where(pieces.folds.exists, pieces.folds.rotor_speed, jnp.inf))
    is_near = jnp.concatenate([jnp.zeros((1,), bool), jnp.abs(speeds - n) < 4096.0 * jnp.finfo(n.dtype).eps * n])
    at_fold = (is_near | jnp.roll(is_near, -1))[piece]

    fields = _fields(model, omega, exists, at_fold)
    return JamModes(**fields, resonances=pieces.resonances, folds=pieces.folds)


def _fields(model: JammedModel, omega: Array, exists: Array, at_fold: Array) -> dict[str, Any]:
    """Return the fields of `JamModes` from load speeds, rad/s, existence flags and fold flags."""
    n = model.scene.drive.speed
    missing = JamStatus.absent
    if has_term(model.scene.all_effects, ContactFriction):
        falls = _resistance_falls(model, n)
        missing, exists = JamStatus.where(falls, JamStatus.ambiguous, missing), exists & ~falls

    def jam(number: Array, w: Array, has_mode: Array, has_fold: Array) -> Jam:
        solved = jam_at(model, number, w, n, has_fold)
        values = jax.tree.map(
            lambda value: jnp.where(has_mode, value, jnp.nan) if jnp.issubdtype(value.dtype, jnp.inexact) else value, solved
        )
        return eqx.tree_at(
            lambda j: (j.status, j.stable, j.rotor_speed),
            values,
            (JamStatus.where(has_mode, solved.status, missing), has_mode & solved.stable, n),
        )

    jams = jax.vmap(jam)(jnp.arange(1, omega.shape[0] + 1), omega, exists, at_fold)
    return {name: getattr(jams, name) for name in Jam.__dataclass_fields__}


def jam_at(
    model: JammedModel, number: Array, omega: Array, rotor_speed: Array | None = None, at_fold: Array | None = None
) -> Jam:
    """Return the jam of the mode `number`.

    **Arguments**, all scalars: `omega`, rad/s, the load speed of the jam; `rotor_speed`, rad/s, at which the jam has this load
    speed (default: that of the branch); `at_fold`: True if the jam is at a fold (default: True if the slope of the branch is
    almost 0). The status is never `absent`, because the caller has checked that the mode exists.
    """
    speed, slope, displacement = branch_tangent(model, omega)
    rotor_speed = speed if rotor_speed is None else rotor_speed
    at_fold = jnp.abs(slope) < jnp.sqrt(jnp.finfo(omega.dtype).eps) if at_fold is None else at_fold
    # If the speed equals that of an undamped resonance up to rounding, the amplitude consists of rounding errors.
    radius = model.unbalance / jnp.min(jnp.diagonal(model.mass))
    bounded = jnp.all(magnitude(displacement) * 100.0 * jnp.finfo(radius.dtype).eps < radius)
    displacement = jnp.where(bounded, displacement, jnp.nan)
    slope = jnp.where(bounded, slope, jnp.nan)
    status = JamStatus.where(at_fold, JamStatus.at_fold, JamStatus.found)
    can_stay = _can_stay_together(model, omega, rotor_speed, displacement)
    status = JamStatus.where(can_stay, status, JamStatus.cannot_stay_together)
    is_unique = True
    if has_term(model.scene.all_effects, ContactFriction):
        is_unique = ~_resistance_falls(model, rotor_speed)
        status = JamStatus.where(is_unique, status, JamStatus.ambiguous)
    return Jam(
        mode=number,
        status=JamStatus.where(bounded, status, JamStatus.unbounded),
        omega=omega,
        rotor_speed=rotor_speed,
        stable=can_stay & is_unique & (slope > 0.0),
        slope=slope,
        displacement=displacement,
        amplitude=magnitude(displacement),
        foundation_force=peak_force(model.vibration_force(displacement, omega)),
        coordinates=model.carrier.coordinates,
        units=model.carrier.units,
    )


def _can_stay_together(model: JammedModel, omega: Array, rotor_speed: Array, displacement: Array) -> Array | bool:
    """Return True if the torque of the vibration can balance the drag of every load; always True for equal loads.

    m R w^2 |e^H B Y| / 2 is the largest torque of the vibration on a load of mass m: the torque at the best phase of the load.
    It must reach the sum of the torques of the drag, b_W R^2 (n - w), and of the dry friction of this load. The vibration is
    largest for coincident loads.
    """
    loads = model.loads
    if loads.alike:
        return True
    available = loads.mass * loads.radius * omega**2 * magnitude(jnp.sum(model.force_direction.conj() * displacement)) / 2.0
    needed = loads.drag * loads.radius**2 * (rotor_speed - omega)
    effects = model.scene.all_effects
    if has_term(effects, ContactFriction):
        needed = needed + friction_on_light_loads(loads, effects, omega, rotor_speed)
    return jnp.all(~(available < (1.0 - 1e-6) * needed))


def _resistance_falls(model: JammedModel, speed: Array) -> Array:
    """Return True if the torque of drag and dry friction falls as the rotor speed rises, at this `speed` and any load speed.

    A load speed then belongs to several rotor speeds, of which `rotor_speed_at` returns one. Example: the radial load of
    `DryFriction` with `reaction="run_up"`, which is negative at large slips.
    """

    def resistance(omega: Array, n: Array) -> Array:
        return model.drag * n + jnp.sum(friction_on_light_loads(model.loads, model.scene.all_effects, omega, n))

    slopes = jax.vmap(jax.grad(resistance, argnums=1), in_axes=(0, None))(speed * np.linspace(0.01, 0.99, 16), speed)
    return jnp.any(slopes <= 0.0)


def branch_points(model: JammedModel, omega: Array) -> tuple[Jam, Folds]:
    """Return jams at load speeds `omega` (any number, ascending), each at its own rotor speed, and the folds."""
    pieces = branch_pieces(model)
    cuts = jnp.where(pieces.folds.exists, pieces.folds.omega, jnp.inf)
    numbers = pieces.mode[jnp.searchsorted(cuts, omega)]
    jams = jax.vmap(lambda number, w: jam_at(model, number, w))(numbers, omega)
    return jams, pieces.folds


def _solve_on_pieces(model: JammedModel, pieces: Pieces) -> tuple[Array, Array]:
    """Return the load speed on each monotone piece at which the branch has the scene's rotor speed, and True for each piece
    that has one."""
    target = model.scene.drive.speed
    gaps = pieces.speed_low - target, pieces.speed_high - target
    exists = (pieces.high > pieces.low) & (gaps[0] * gaps[1] <= 0.0)

    def gap(speed: Callable[[JammedModel, Array], Array]) -> Callable[[JammedModel, Array], Array]:
        return lambda model, w: speed(model, w) - model.scene.drive.speed

    root = partial(branch_root, model, gap(rotor_speed_at), gap(scanned_speed))
    return jax.vmap(root)(pieces.low, pieces.high, gaps), exists
