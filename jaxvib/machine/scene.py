"""Scene: a machine with its exciters and effects."""

from __future__ import annotations

import functools
import html
import importlib
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import is_real, require_field_types, with_known_names
from jaxvib.errors import InputError, quoted, within
from jaxvib.machine.carrier import Machine, Mount, Place, on_body, read_place, shapes_of
from jaxvib.machine.drives.drive import Directed, Drive
from jaxvib.machine.effects.base import Effect, has_term, terms_of
from jaxvib.machine.effects.terms import DrillingSpinRelease, GravityField, RotorImbalance, SlipRelease, SupportForce
from jaxvib.machine.loads import Loads
from jaxvib.machine.numbers import Part, read_numbers, unit
from jaxvib.machine.shapes import require_drive, require_forces, require_loads, require_machine, require_terms
from jaxvib.units import Number, count, number
from jaxvib.units.known import require_if_known, when_known
from jaxvib.units.reading import in_own_unit, unit_ratio

MAX_USUAL_SPEED = 700.0
"""Largest usual speed of a rotor, rad/s. A larger plain number was probably intended in rpm."""

_MIN_RATIO = 1e-15
"""Ratio of two numbers below which a sum in double precision loses the smaller one."""


class Exciter(Part):
    """Exciter of a machine: a rotor with its drive, and with loads, an unbalance, or both.

    **Arguments**

    - `loads` from `balls`, `rollers`, `pendulums` or `torus_balls`; None for an exciter without loads
    - `drive`, a `Motor` or an `IdealDrive`; the inertia of a motor includes the unbalance
    - `unbalance` S, kg m: static moment m r about the exciter's axis of a mass that turns with the rotor, greater than 0;
      typical: 0.1 to 10 kg m; text: "2 kg m" or "20 kg x 0.1 m". The function `unbalance` computes it from the force that
      catalogues state
    - `unbalance_mass` m, kg: mass of the unbalance, added to the machine at the exciter's axis; typical: 5 to 200; default: the
      machine's mass includes it
    - `at`: place on the machine: the number of a platform or of a place of `from_matrices`, the distance along a rotor's axis
      from its centre of mass, m (a float or text), or the point (x, y) of a body in a plane, m; None for the default of the
      machine
    - `body`: number of the body from 0, on machines with several; typical: 0 (the default)
    - `direction` of rotation: +1 anticlockwise, -1 clockwise. Angles and speeds of a state are positive anticlockwise in
      both cases
    - `effects` of the rotor and its loads such as `StaticImbalance` or `DryFriction`

    **Attributes**: the arguments; `at` is stored as `platform` or `position`; `carries`: "loads", "unbalance", or both.

    **Raises** `InputError` for

    - a part of the wrong type
    - an effect that acts on the whole machine
    - a direction other than +1 or -1
    - an exciter with neither loads nor an unbalance
    - an `unbalance_mass` without an `unbalance`
    - a motor whose rotor has less inertia than the unbalance alone, m r^2 = S^2/m

    >>> import jaxvib as jv
    >>> motor = jv.DCMotor("1500 rpm", stall_torque=20.0, inertia=0.05)
    >>> jv.Exciter(drive=motor, unbalance="0.2 kg m", at=2, direction=-1).at
    2
    """

    loads: Loads | None
    drive: Drive
    effects: tuple[Effect, ...]
    unbalance: Array | None = eqx.field(metadata=unit("kg m", low=0.0, open_low=True, words="unbalance of the rotor"))
    unbalance_mass: Array | None = eqx.field(metadata=unit("kg", low=0.0, open_low=True, words="mass of the unbalance"))
    position: Array | None = eqx.field(metadata=unit("m", words="position of the exciter", typical=0.1))
    platform: int | None = eqx.field(static=True)
    body: int = eqx.field(static=True)
    direction: int = eqx.field(static=True)
    carries: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        loads: Loads | None = None,
        drive: Drive | None = None,
        *,
        unbalance: Number | None = None,
        unbalance_mass: Number | None = None,
        at: int | Number | Sequence[Number] | None = None,
        body: int = 0,
        direction: int = 1,
        effects: Effect | Sequence[Effect] = (),
    ):
        if loads is not None or unbalance is None:
            _require_part("loads", loads, Loads, "balls(...)" if unbalance is not None else "balls(...), or give an unbalance")
        if not isinstance(drive, Drive):
            raise InputError("drive", f'is {quoted(drive)}; it must be a Drive, for example ConstantSpeed("1500 rpm")')
        require_drive(drive)
        if loads is not None:
            require_loads(loads)
        if isinstance(direction, bool) or not isinstance(direction, (int, float, np.number)) or direction not in (1, -1):
            raise InputError("direction", f"is {quoted(direction)}; it must be 1 (anticlockwise) or -1 (clockwise)")
        effects = read_effects(effects)
        for effect in effects:
            if _acts_on_machine(effect):
                problem = "acts on the whole machine; give it to the scene, Scene(effects=...)"
                raise InputError(f"effects.{effect.kind}", problem)
        self.loads, self.drive, self.effects, self.direction = loads, drive, effects, int(direction)
        numbers = {"unbalance": unbalance, "unbalance_mass": unbalance_mass}
        self.unbalance, self.unbalance_mass = read_unbalance(drive, **numbers)
        self.carries = ("loads",) * (loads is not None) + ("unbalance",) * (unbalance is not None)
        place = read_place(at)
        self.platform, self.position = (place, None) if isinstance(place, int) else (None, place)
        self.body = count(body, "body", low=0)

    @property
    def is_plain(self) -> bool:
        """True for an exciter that turns anticlockwise and has loads but no `unbalance`."""
        return self.carries == ("loads",) and self.direction == 1

    @property
    def place(self) -> Place:
        """Place on the machine, with its body."""
        return on_body(self.at, self.body)

    def with_parts(self, loads: Loads | None, drive: Drive, effects: Sequence[Effect] = ()) -> Exciter:
        """Return an exciter with other parts at the same place, with the same unbalance and direction.

        **Arguments**: `loads`, `drive` and `effects` of the new exciter.
        """
        kept = {name: getattr(self, name) for name in ("unbalance", "unbalance_mass", "at", "body", "direction")}
        return Exciter(loads, drive, effects=effects, **kept)

    @property
    def turning_drive(self) -> Drive:
        """Drive that turns the rotor in its direction."""
        return self.drive if self.direction == 1 else Directed(self.drive)

    @property
    def at(self) -> int | Array | None:
        """Place on the machine: a platform number, a distance along a rotor's axis or a point, m; None for the default."""
        return self.position if self.platform is None else self.platform


@with_known_names
def unbalance(*, force: Number, at: Number) -> Array:
    """Return the unbalance of an exciter from the centrifugal force that its catalogue states.

        S = F / w^2

    **Arguments** (SI, or strings with a unit, greater than 0)

    - `force` F, N, at the speed w; typical: "1 kN" to "200 kN"
    - `at` w, rad/s: the speed for which the catalogue states the force; typical: "750 rpm" to "3000 rpm"

    **Returns** S, kg m. **Raises** `InputError` for a wrong unit, a value that is not positive, and a plain number above 700
    for the speed, which was probably meant in rpm.

    >>> import jaxvib as jv
    >>> round(float(jv.unbalance(force="20 kN", at="1000 rpm")), 4)
    1.8238
    """
    speed = number(at, "rad/s", "at", low=0.0, open_low=True)
    if is_real(at):
        problem = "is {0:g}, and a plain number is in rad/s; write '{0:g} rpm' or '{0:g} rad/s'"
        require_if_known(lambda speed: speed <= MAX_USUAL_SPEED, speed, field="at", problem=problem)
    return number(force, "N", "force", low=0.0, open_low=True) / speed**2


def read_unbalance(drive: Drive, unbalance: Number | None, unbalance_mass: Number | None) -> tuple[Array | None, Array | None]:
    """Return the unbalance S, kg m, and its mass m, kg, as arrays; None for an absent value. **Raises** errors of `Exciter`."""
    if unbalance_mass is not None and unbalance is None:
        raise InputError("unbalance_mass", f"is {quoted(unbalance_mass)} without an unbalance; give unbalance=..., in kg m")
    try:
        moment, mass = read_numbers(Exciter, "", unbalance=unbalance, unbalance_mass=unbalance_mass).values()
    except InputError as error:
        if error.field != "unbalance" or not _is_force(unbalance):
            raise
        needs = f"{{ force = '{unbalance}', at = '1500 rpm' }}"
        advice = f"state the speed of this force too: in a file by {needs}, in Python by jaxvib.unbalance"
        problem = f"is {quoted(unbalance)}, a force; {advice}"
        raise InputError("unbalance", problem) from error
    if mass is not None and not drive.ideal:
        when_known(_require_inertia, moment, mass, drive.inertia)  # pyright: ignore[reportAttributeAccessIssue]
    return moment, mass


def _is_force(value: object) -> bool:
    """Return True for a text with a unit of a force."""
    try:
        return isinstance(value, str) and unit_ratio(in_own_unit(value, "unbalance")[1], "N") is not None
    except InputError:
        return False


def _require_inertia(unbalance: float, mass: float, inertia: float) -> None:
    smallest = unbalance * unbalance / mass  # a power of a large float raises an OverflowError
    if inertia < smallest * (1.0 - 1e-12):
        problem = f"turns a rotor with the inertia {inertia:g} kg m^2, less than that of the unbalance alone"
        raise InputError("drive", f"{problem}, S^2/m = {smallest:g} kg m^2; the inertia must include the unbalance")


class Scene(Part):
    """Complete description of a machine in motion; a frozen pytree of SI numbers.

    `jax.grad`, `jax.vmap` and `jax.jit` apply to every parameter; `equinox.tree_at` replaces a parameter.

    **Arguments**

    - `machine` from `one_mass`, `two_mass`, `three_mass`, `network`, `planar_rotor`, `rotor`, `plane_body`, `plane_network` or
      `from_matrices`
    - `loads` from `balls`, `rollers`, `pendulums` or `torus_balls`; typical: 0.1 % to 5 % of the machine's mass
    - `drive` such as `ConstantSpeed`; typical: 600 to 3000 rpm
    - `effects` such as `Gravity`, each kind at most once, except `CubicSupport`, `Stop` and `FrictionSupport`, which may occur
      once for each support; typical: none
    - `exciters`: instead of `loads` and `drive`, a list of `Exciter`

    **Attributes**: `machine`; `exciters`; `effects` that act on the whole machine. Effects on a rotor and its loads are in
    `Exciter.effects`; `all_effects` contains both. A scene with one exciter also has `loads` and `drive`.

    **Raises** `InputError` for

    - a part of the wrong type
    - an effect that occurs twice but is allowed only once
    - a number of stations that differs from the number of loads
    - an exciter at a place that the machine does not have
    - an effect that cannot act on this machine or these loads

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> scene = jv.Scene(machine, loads=jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), drive=jv.ConstantSpeed("600 rpm"))
    >>> scene.loads.count
    2
    """

    machine: Machine
    exciters: tuple[Exciter, ...]
    effects: tuple[Effect, ...]

    def __init__(
        self,
        machine: Machine,
        loads: Loads | None = None,
        drive: Drive | None = None,
        effects: Effect | Sequence[Effect] = (),
        *,
        exciters: Sequence[Exciter] | None = None,
    ):
        _require_part("machine", machine, Machine, "two_mass(...)")
        require_field_types(machine, "machine")
        effects = read_effects(effects)
        shared = tuple(effect for effect in effects if _acts_on_machine(effect))
        rotating = tuple(effect for effect in effects if not _acts_on_machine(effect))
        if exciters is None:
            if not isinstance(loads, Loads):
                problem = f"is {quoted(loads)}, which is not of the type Loads"
                field, start = ("exciters", "are missing") if loads is None else ("loads", problem)
                example = 'exciters=[Exciter(drive=ConstantSpeed("1500 rpm"), unbalance="1 kg m")]'
                raise InputError(field, f"{start}; give {example}, or loads and a drive")
            exciters = (Exciter(loads, drive, effects=rotating),)
        else:
            exciters = _read_exciters(exciters, loads, drive, rotating)
        for k, exciter in enumerate(exciters):
            require_field_types(exciter, f"exciters[{k}]")
            require_machine(machine, exciter.place)
        self.machine, self.exciters, self.effects = machine, exciters, shared
        for term in terms_of(self.all_effects, SupportForce):
            term.rows(machine)  # raises for a place that the machine does not have
        for k, exciter in enumerate(exciters):
            if exciter.loads is not None:
                for effect in shared:
                    _require_effect(effect, machine, exciter.loads)
            with within(self.prefix_of(k)):
                machine.require_body(exciter.body)
                levers = machine.mounting(exciter.place).levers
            _require_stations(levers, exciter.loads)
            with within(self.prefix_of(k)):
                _require_fit(machine, exciter)

    def __repr__(self) -> str:
        """Return the text of a scene file with units; for a traced scene or a part of a user's class, return the fields."""
        files = importlib.import_module("jaxvib.machine.files")  # imports this module
        try:
            return files.scene_text(self).rstrip()
        except InputError:
            return super().__repr__()

    def _repr_html_(self) -> str:
        """Return the representation and, if the scene can be drawn, its sketch, for notebooks."""
        sketches = importlib.import_module("jaxvib.show.moving")  # imports this module
        text = f"<pre>{html.escape(repr(self))}</pre>"
        try:
            return text + sketches.sketch_svg(self)
        except InputError:
            return text

    @property
    def all_effects(self) -> tuple[Effect, ...]:
        """Effects on the whole machine and on every rotor."""
        groups = self.effects, *(exciter.effects for exciter in self.exciters)
        # `equinox.tree_at` evaluates this property on a scene in which it has replaced each empty tuple by a leaf.
        return tuple(effect for group in groups if isinstance(group, tuple) for effect in group)

    @property
    def top_speed(self) -> Array:
        """Largest of the working speeds of the drives, rad/s."""
        return functools.reduce(jnp.maximum, (exciter.drive.speed for exciter in self.exciters))

    @property
    def exciter(self) -> Exciter:
        """Only exciter of the scene. **Raises** `InputError` if the scene has several."""
        if len(self.exciters) != 1:
            problem = f"has {len(self.exciters)} exciters; this function needs a scene with one exciter"
            instead = "for others use simulate, settle, envelope, response or synchronous_regimes (command regimes)"
            raise InputError("scene", f"{problem}; {instead}; parts of an exciter are scene.exciters[0].drive and so on")
        return self.exciters[0]

    @property
    def is_plain(self) -> bool:
        """True for a scene with one exciter that turns anticlockwise and has loads but no `unbalance`."""
        return len(self.exciters) == 1 and self.exciters[0].is_plain

    @property
    def not_smooth(self) -> tuple[Effect | Drive, ...]:
        """Effects and drives whose forces or torques are not smooth. Jumps at the times `Drive.jump_ts` do not count."""
        effects = [effect for effect in self.all_effects if not all(term.is_smooth for term in effect.terms())]
        return (*effects, *(exciter.drive for exciter in self.exciters if not exciter.drive.is_smooth))

    @property
    def has_loads(self) -> bool:
        """True if an exciter has loads."""
        return any(exciter.loads is not None for exciter in self.exciters)

    @property
    def loads(self) -> Loads:
        """Loads of a scene with one exciter that turns anticlockwise and has no `unbalance`.

        **Raises** `InputError` for other scenes, because analyses that read this property do not include them.
        """
        exciter = _require_anticlockwise(self.exciter)
        if exciter.loads is None or not exciter.is_plain:
            problem = (
                "has an unbalance; this function needs an exciter with loads and without unbalance=...; use simulate for others"
            )
            raise InputError("scene.exciters[0]", problem)
        return exciter.loads

    @property
    def drive(self) -> Drive:
        """Drive of a scene with one exciter that turns anticlockwise. **Raises** `InputError` otherwise."""
        return _require_anticlockwise(self.exciter).drive

    def mount(self) -> Mount:
        """Return the mount of the only exciter."""
        return self.machine.mount(self.exciter.place)

    @property
    def mounting(self) -> Mount:
        """Directions of the only exciter's mount, and the shapes of its arrays without their values."""
        # A property, because each analysis reads it and a method of an Equinox module costs 30 us a call.
        return shapes_of(self.machine, self.exciter.place)[1]

    def replace(self, **parts: Any) -> Scene:
        """Return a scene of one exciter with other `parts`: `machine`, `loads`, `drive` or `effects`.

        `effects` replaces all effects: those on the whole machine, and those on the rotor and its loads.

        >>> import jaxvib as jv
        >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
        ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
        >>> scene.replace(effects=(jv.Gravity(),)).all_effects[0].kind
        'gravity'
        """
        require_parts(self)
        old = self.exciter
        all_parts = {"machine": self.machine, "loads": old.loads, "drive": old.drive, "effects": self.all_effects} | parts
        exciter = old.with_parts(all_parts.pop("loads"), all_parts.pop("drive"))
        return Scene(**all_parts, exciters=[exciter])

    def prefix_of(self, k: int) -> str:
        """Return the prefix of the names of the parts of exciter `k`: "exciters[1].", or "" if there is one exciter."""
        return f"exciters[{k}]." if len(self.exciters) > 1 else ""


def require_parts(scene: Scene) -> None:
    """**Raises** `InputError` for an object of another class in place of a part or a number of the scene, which
    `equinox.tree_at` does not check."""
    try:
        require_field_types(scene, "scene")
    except InputError as error:
        one = isinstance(scene.exciters, tuple) and len(scene.exciters) == 1
        name = error.field.replace("scene.exciters[0].", "scene.") if one else error.field
        raise InputError(name, error.problem) from error
    if not scene.exciters:
        raise InputError("scene.exciters", "is empty; at least one Exciter is needed")


def _require_anticlockwise(exciter: Exciter) -> Exciter:
    # A method of an Equinox module costs 30 us a call, and each analysis reads this several times.
    if exciter.direction != 1:
        raise InputError(
            "scene.exciters[0].direction", "is -1; this function needs an anticlockwise rotor; use simulate for others"
        )
    return exciter


def _require_stations(levers: Sequence[Array | None], loads: Loads | None) -> None:
    """**Raises** `InputError` if there are not as many stations as loads."""
    for lever in levers:
        if lever is not None and (loads is None or lever.shape != (loads.count,)):
            needed = (
                "give the exciter a place, at=..., m" if loads is None else f"one for all loads or {loads.count} are needed"
            )
            raise InputError("machine.stations", f"has {lever.shape[0]} values; {needed}")


def _require_fit(machine: Machine, exciter: Exciter) -> None:
    """**Raises** `InputError` for an effect that does not fit the machine, the loads or the drive, and for loads that are not
    comparable with the machine, see `require_comparable`."""
    loads = exciter.loads
    for effect in exciter.effects:
        tilts = any(term.about_tilts for term in terms_of([effect], RotorImbalance))
        if tilts and machine.mounting(exciter.place).tilt is None:
            raise InputError(f"effects.{effect.kind}", f"needs a rotor that can tilt, not {quoted(machine.kind)}; remove it")
        if loads is not None:
            _require_effect(effect, machine, loads)
        elif not all(isinstance(term, RotorImbalance) for term in effect.terms()):
            raise InputError(f"effects.{effect.kind}", "acts on loads, but this exciter has none; remove it")
        if not exciter.drive.ideal and has_term([effect], DrillingSpinRelease, SlipRelease):
            problem = f"needs a drive with prescribed speed (property ideal), not {exciter.drive.kind!r}; use ConstantSpeed"
            raise InputError(f"effects.{effect.kind}", problem)
    if loads is not None:
        require_comparable(machine, loads, exciter.drive)


def _require_effect(effect: Effect, machine: Machine, loads: Loads) -> None:
    """**Raises** `InputError` for an effect that cannot act on this machine or these loads."""
    require_forces(effect, loads)
    effect.validate(machine, loads)


def _acts_on_machine(effect: Effect) -> bool:
    """Return True if an effect acts on the whole machine, False if it acts on one rotor and its loads."""
    return has_term([effect], GravityField, SupportForce)


def _require_part(name: str, part: object, kind: type, example: str) -> None:
    if not isinstance(part, kind):
        raise InputError(name, f"is {quoted(part)}; it must be a {kind.__name__}, for example {example}")


def _read_exciters(
    exciters: Sequence[Exciter], loads: Loads | None, drive: Drive | None, effects: tuple[Effect, ...]
) -> tuple[Exciter, ...]:
    """Return the exciters of a scene. The `effects` of a rotor are added to the only exciter."""
    if loads is not None or drive is not None:
        raise InputError("exciters", "are given together with loads or drive; give these to an Exciter")
    if not isinstance(exciters, (tuple, list)) or len(exciters) == 0:
        raise InputError("exciters", f"is {quoted(exciters)}; it must be a list of exciters, for example [Exciter(...)]")
    for k, each in enumerate(exciters):
        _require_part(f"exciters[{k}]", each, Exciter, "Exciter(balls(...), ConstantSpeed(100.0))")
    if not effects:
        return tuple(exciters)
    if len(exciters) > 1:
        raise InputError(f"effects.{effects[0].kind}", "acts on one rotor; give it to an exciter, Exciter(effects=...)")
    one = exciters[0]
    return (one.with_parts(one.loads, one.drive, read_effects((*one.effects, *effects))),)


def read_effects(effects: object) -> tuple[Effect, ...]:
    """Return effects in the order of scene files. **Raises** `InputError` for other values, and for forbidden repetitions."""
    if isinstance(effects, Effect):
        effects = (effects,)
    if not isinstance(effects, (tuple, list)):
        raise InputError("effects", f"is {quoted(effects)}; it must be a tuple of effects, for example (Gravity(),)")
    for index, effect in enumerate(effects):
        if not isinstance(effect, Effect):
            raise InputError(f"effects[{index}]", f"is {quoted(effect)}; it must be an Effect, for example Gravity()")
        require_terms(effect)
    kinds = [effect.kind for effect in effects if not effect.repeatable]
    for kind in kinds:
        if kinds.count(kind) > 1:
            raise InputError("effects", f"contains {kind} {kinds.count(kind)} times; it is allowed once")
    first = {effect.kind: index for index, effect in reversed(list(enumerate(effects)))}
    return tuple(sorted(effects, key=lambda effect: (not effect.repeatable, first[effect.kind])))


def require_comparable(machine: Machine, loads: Loads, drive: Drive) -> None:
    """**Raises** `InputError` if known numbers would be lost in rounding errors: the loads are too heavy or too light for the
    machine, or their drag is too weak for their inertia."""
    parts = getattr(machine, "mass", None), loads.mass, getattr(loads, "drag", None), drive.speed
    when_known(functools.partial(_require_comparable, loads.count), *parts)


@np.errstate(over="ignore", divide="ignore", invalid="ignore")  # ratios of the largest and smallest floating-point numbers
def _require_comparable(
    count: int, platforms: np.ndarray | float | None, mass: np.ndarray | float, drag: np.ndarray | float | None, speed: float
) -> None:
    for name, value in (("mass", mass), ("drag", drag)):
        if value is not None and np.shape(value) not in ((), (count,)):
            raise InputError(f"loads.{name}", f"is an array of shape {np.shape(value)}; the shape {(count,)} or () is needed")
    if np.shape(speed):
        raise InputError("drive.speed", f"is an array of shape {np.shape(speed)}; a single number is needed")
    speed = float(speed)
    each = np.broadcast_to(np.asarray(mass, dtype=float), (count,))
    if platforms is not None:
        machine_mass, loads_mass = float(np.sum(platforms)), float(np.sum(each))
        if not _MIN_RATIO <= loads_mass / machine_mass <= 1.0 / _MIN_RATIO:
            mass_text = f"gives {loads_mass:.3g} kg for all loads on a machine of {machine_mass:.3g} kg"
            raise InputError(
                "loads.mass",
                f"{mass_text}; one of them is lost in rounding errors; "
                f"loads may have {_MIN_RATIO:g} to {1.0 / _MIN_RATIO:g} times the machine's mass",
            )
    if drag is not None:
        share = np.asarray(drag, dtype=float) / (each * speed)
        lost = (share > 0.0) & (share < _MIN_RATIO)
        if np.any(lost):
            least = _MIN_RATIO * float(np.max(each[lost])) * speed
            raise InputError(
                "loads.drag",
                f"changes a load's speed by the fraction {float(np.min(share[lost])):.1e} while the rotor turns by one radian, "
                f"which is less than the rounding error; give 0, or at least {least:.1g} N s/m",
            )
