"""Validation of scenes. Public functions validate each scene because `equinox.tree_at` replaces parameters of a scene without
a check."""

from __future__ import annotations

import dataclasses
import functools
import math
import weakref
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import call_user
from jaxvib.display import speed_text
from jaxvib.errors import InputError, quoted, within
from jaxvib.machine.carrier import Machine
from jaxvib.machine.drives.controlled import SwitchedOff
from jaxvib.machine.drives.drive import Drive, Motor
from jaxvib.machine.effects.base import static_imbalances, total_gravity
from jaxvib.machine.files import rebuild_part
from jaxvib.machine.loads import CircularLoads
from jaxvib.machine.scene import MAX_USUAL_SPEED, Exciter, Scene, read_unbalance, require_comparable, require_parts
from jaxvib.machine.structures.platforms import Platforms
from jaxvib.runtime.compat import evaluating, value_of
from jaxvib.runtime.devices import float_dtype
from jaxvib.units import conditions_of_traced_values
from jaxvib.units.known import is_known, when_known
from jaxvib.units.reading import STANDARD_GRAVITY, require_real

_VALID_SCENES: weakref.WeakValueDictionary[tuple[int, np.dtype], Scene] = weakref.WeakValueDictionary()
"""Validated scenes by their `id` and the precision of their arrays. Scenes are immutable and therefore stay valid."""


def validate_scene(scene: Scene) -> Scene:
    """Return the scene with arrays for all its parameters. If none of them is traced, check that the constructors allow the
    values.

    The arrays have the present precision of JAX, even if the scene was created with another setting.

    **Raises** `InputError` for an object that is not a scene, and for a value that is not allowed.

    >>> import equinox as eqx, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
    >>> validate_scene(eqx.tree_at(lambda s: s.drive.speed, scene, -60.0))
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: drive.speed is -60 rad/s; it must be greater than 0
    """
    if not isinstance(scene, Scene):
        raise InputError("scene", f"is {quoted(scene)}; it must be a Scene, for example load_scene('machine.toml')")
    precision = float_dtype()
    if _VALID_SCENES.get((id(scene), precision)) is scene:
        return scene
    require_parts(scene)
    leaves, structure = jax.tree_util.tree_flatten_with_path(scene)
    one = ".exciters[0]" if len(scene.exciters) == 1 else "-"
    arrays = [_number(f"scene{jax.tree_util.keystr(path).removeprefix(one)}", leaf) for path, leaf in leaves]
    if any(new is not old for new, (_, old) in zip(arrays, leaves, strict=True)):
        scene = jax.tree.unflatten(structure, arrays)
    if is_known(arrays):
        numbers = structure, *((leaf.shape, leaf.dtype, leaf.tobytes()) for leaf in map(np.asarray, arrays))
        with evaluating():  # outside an enclosing derivative, because the validation is slower under it
            try:
                hash(structure)
            except TypeError:
                _require_valid.__wrapped__(_SceneKey(numbers, scene))
            else:
                _require_valid(_SceneKey(numbers, scene))
        _VALID_SCENES[id(scene), precision] = scene
    return scene


def require_double(scene: Scene, purpose: str) -> Scene:
    """Return `validate_scene(scene)`. **Raises** `InputError` in single precision; the `purpose`, such as "a search", is the
    subject of its sentence."""
    if isinstance(scene, Scene) and float_dtype() != np.float64:
        raise InputError(
            "scene",
            f"is in single precision; {purpose} needs double precision: call jax.config.update("
            '"jax_enable_x64", True) before the scene is created',
        )
    return validate_scene(scene)


def allowed_unknowns(scene: Scene) -> Array | None:
    """Return a Boolean, True if the constructors allow the traced parameters of a scene; None if no parameter is traced, or if
    the traced values are known, as under `grad` without `jit`, and allowed.

    >>> import equinox as eqx, jax, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
    >>> stiff = jax.jit(lambda k: allowed_unknowns(eqx.tree_at(lambda s: s.machine.stiffness, scene, k[None])))
    >>> bool(stiff(4e4)), bool(stiff(-4e4)), allowed_unknowns(scene)
    (True, False, None)
    """
    if is_known(scene):
        return None
    if is_known(values := jax.tree.map(value_of, scene)):
        return _allowed_value(values)
    with conditions_of_traced_values() as found:
        _rebuild(scene)
    return jnp.all(jnp.stack(found)) if found else None


def _allowed_value(scene: Scene) -> Array | None:
    """Return None if the constructors allow the parameters of a scene, which have known values here, otherwise False."""
    try:
        validate_scene(scene)
    except InputError:
        return jnp.asarray(False)
    return None


_MAX_MASS, _MAX_LEVERS = 1e5, 3.0
"""Largest usual mass of a machine, kg, and largest usual distance of an exciter from the centre of mass, relative to that of
the farthest support."""

_MAX_RADIUS, _MAX_SAG, _MIN_MASS = 5.0, 1.0, 10.0
"""Largest usual radius of loads, m, largest usual sag of a machine under its own weight, m, and smallest mass, kg, of machines
whose sag and motor power are examined. Machines with dimensionless parameters have masses of about 1."""


_MAX_SUPPORT_DISTANCE = 100.0
"""Largest usual coordinate of a support, m."""

_DIGITS_OF_SPEEDS = 5
"""Largest usual number of digits of a speed that a user writes."""

_MIN_STIFFNESS_RATIO = 5e-3
"""Smallest usual ratio of two stiffnesses of supports."""

_MIN_AMPLITUDE, _MAX_AMPLITUDE = 1e-5, 0.05
"""Smallest and largest usual amplitude above the resonances of a machine that unbalances excite, m: the sum of the unbalances
divided by the mass."""

_MIN_POWER = 0.05
"""Smallest usual rated power of a motor for each kg of the machine, W; usual values are about 1."""


_SUPPLIES, _SUPPLY_TOLERANCE = (50.0, 60.0), 0.01
"""Frequencies of electrical supplies, Hz, and the relative difference of a plain number that probably means one of them."""


def _is_short(speed: float) -> bool:
    """Return True for a speed, rad/s, of few digits. One that was given in rpm or Hz has many digits in rad/s."""
    return math.isclose(speed, float(f"{speed:.{_DIGITS_OF_SPEEDS}g}"), rel_tol=1e-9)


def _supply_frequency(drive: Drive) -> tuple[str, float]:
    """Return the name and the value, rad/s, of the supply frequency of a drive or of the motor in it; 0 if it has none."""
    name = "drive"
    while (motor := getattr(drive, "motor", None)) is not None:
        name, drive = f"{name}.motor", motor
    return f"{name}.frequency", float(getattr(drive, "frequency", 0.0))


def _largest_lever(machine: Machine) -> float:
    """Return the largest distance of a support from the centre of mass, m; 0 for a machine without positions of supports."""
    places = [np.linalg.norm(each.at) for each in getattr(machine, "supports", ())]
    return float(max(places, default=0.0))


_MIN_USUAL_RPM = 10.0
"""Lowest usual speed of an exciter, rpm. A lower one of few digits probably has a point between its thousands."""


def implausible_numbers(scene: Scene) -> list[str]:
    """Return a sentence for each parameter of a scene that was probably intended in another unit.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(1500.0))
    >>> implausible_numbers(scene)
    ["drive.speed is 14324 rpm; a plain number is in rad/s: did you mean '1500 rpm'?"]
    """
    notes = []
    mass = float(np.sum(getattr(scene.machine, "mass", 0.0)))
    likely_mass = mass / 1e3 if mass > _MAX_MASS else mass  # one wrong mass shall not cause notes about motors and springs

    def note(name: str, value: str, si: str, meant: str) -> None:
        notes.append(f"{name} is {value}; a plain number is in {si}: did you mean '{meant}'?")

    for k, exciter in enumerate(scene.exciters):
        place, loads = scene.prefix_of(k), exciter.loads
        speed = float(exciter.drive.speed)
        if speed > MAX_USUAL_SPEED and _is_short(speed):
            note(f"{place}drive.speed", speed_text(speed), "rad/s", f"{speed:g} rpm")
        if 0.0 < (rpm := speed * 30.0 / np.pi) < _MIN_USUAL_RPM and _is_short(rpm):
            thousands = f"{1e3 * rpm:g} rpm"
            notes.append(f"{place}drive.speed is {rpm:g} rpm; a point separates decimals: did you mean '{thousands}'?")
        name, frequency = _supply_frequency(exciter.drive)
        if _is_short(frequency) and any(math.isclose(frequency, hertz, rel_tol=_SUPPLY_TOLERANCE) for hertz in _SUPPLIES):
            note(f"{place}{name}", f"{frequency / (2.0 * np.pi):.4g} Hz", "rad/s", f"{frequency:g} Hz")
        power = float(getattr(exciter.drive, "power", np.inf))
        if mass >= _MIN_MASS and power < _MIN_POWER * likely_mass:
            note(f"{place}drive.power", f"{power:g} W for a machine of {likely_mass:g} kg", "W", f"{power:g} kW")
        radius = 0.0 if loads is None else float(np.max(getattr(loads, "radius", 0.0)))
        if radius > _MAX_RADIUS:
            note(f"{place}loads.radius", f"{radius:g} m", "m", f"{radius:g} mm")
        at, lever = exciter.position, _largest_lever(scene.machine)
        if at is not None and lever and (far := float(np.linalg.norm(at))) > _MAX_LEVERS * lever:
            value = f"{far:.4g} m from the centre of mass, the supports at most {lever:.4g} m"
            note(f"{place}at", value, "m", f"{float(np.max(np.abs(at))):g} mm")
    for k, support in enumerate(getattr(scene.machine, "supports", ())):
        if (far := float(np.max(np.abs(getattr(support, "at", 0.0))))) > _MAX_SUPPORT_DISTANCE:
            note(f"machine.supports[{k}].at", f"{far:g} m from the centre of mass", "m", f"{far:g} mm")
        if (angle := abs(float(getattr(support, "angle", 0.0)))) > 2.0 * np.pi:
            note(f"machine.supports[{k}].angle", f"{angle:g} rad", "rad", f"{angle:g} deg")
    moments = [0.0 if each.unbalance is None else float(each.unbalance) for each in scene.exciters]
    if min(mass, *moments) > 0.0:  # only unbalances excite the machine
        amplitude = sum(moments) / mass
        if amplitude > _MAX_AMPLITUDE:
            value = f"{mass:g} kg, and the unbalances would move the machine by {amplitude:.3g} m"
            note("machine.mass", value, "kg", f"{mass:g} t")
        if amplitude < _MIN_AMPLITUDE:
            value = f"so small that it moves the machine by {1e6 * amplitude:.3g} µm"
            note("exciters.unbalance", value, "kg m, a plain force in N", "kg m' or 'kN")
    if mass > _MAX_MASS:
        note("machine.mass", f"{mass / 1e3:g} t", "kg", f"{mass / 1e3:g} kg")
    supports = [each.stiffness for each in getattr(scene.machine, "supports", ())]
    names = [f"machine.supports[{k}].stiffness[{i}]" for k, each in enumerate(supports) for i in range(np.size(each))]
    springs = getattr(scene.machine, "stiffness", ()) if not supports else np.ravel(supports)
    if np.ndim(springs) == 1 and np.size(springs) > 1:
        for k, value in enumerate(np.asarray(springs)):
            if 0.0 < value < _MIN_STIFFNESS_RATIO * np.max(springs):
                name = names[k] if supports else f"machine.stiffness[{k}]"
                note(name, f"{value:g} N/m, but another one is {np.max(springs):g} N/m", "N/m", f"{value:g} N/mm")
    for name, stiffness in (("supports.stiffness", supports), ("stiffness", getattr(scene.machine, "stiffness", 0.0))):
        total = float(np.sum(stiffness))
        if mass >= _MIN_MASS and 0.0 < total * _MAX_SAG < STANDARD_GRAVITY * likely_mass:
            value = f"so small that the machine sags by {STANDARD_GRAVITY * likely_mass / total:.3g} m"
            note(f"machine.{name}", value, "N/m", f"{float(np.max(stiffness)):g} N/mm")
    return [*notes, *(_damping_notes(scene.machine) if mass >= _MIN_MASS else ())]


_MIN_DAMPING_RATIO, _MAX_PERCENT = 1e-3, 20.0
"""Smallest usual ratio of a damper to the critical damping, and largest usual ratio in percent."""


def _damping_notes(machine: Machine) -> list[str]:
    """Return a sentence for each damper of platforms that was probably intended as a ratio in percent."""
    if not isinstance(machine, Platforms):
        return []
    mass, ends = np.asarray(machine.mass), np.reshape(np.asarray(machine.links, int), (-1, 2)) - 1
    joined = 1.0 / np.sum(1.0 / mass[ends], axis=1)
    springs = (("damping", machine.damping, machine.stiffness, mass),)
    springs += (("link_damping", machine.link_damping, machine.link_stiffness, joined),)
    notes = []
    for name, dampings, stiffness, masses in springs:
        for i in np.flatnonzero(stiffness):
            c, ratio = float(dampings[i]), float(dampings[i] / (2.0 * np.sqrt(stiffness[i] * masses[i])))
            if 0.0 < ratio < _MIN_DAMPING_RATIO and 1.0 <= c <= _MAX_PERCENT:
                value = f"machine.{name}{f'[{i}]' * (np.size(dampings) > 1)} is {c:g} N s/m, {100.0 * ratio:.2g} %"
                meant = f"of the critical damping; a plain number is in N s/m: did you mean '{c:g} %'?"
                notes.append(f"{value} {meant}")
    return notes


_SWING_SHARE = 0.7246113537767085
"""Largest value of (1 - cos x)/x."""


def lifting_torques(scene: Scene) -> list[tuple[Array, Array] | None]:
    """Return two torques for each exciter, N m: the least constant torque that turns its hanging unbalance S over the top,
    0.7246 S g, and that of the motor at rest. The entry is None without a motor, an unbalance or gravity, or if the torque at
    rest changes during a run.

    S contains the static imbalances. The condition is torque x > S g (1 - cos x) for every angle x: the unbalance swings past
    the height at which the torque would hold it.
    """
    gravity = total_gravity(scene.all_effects)
    found: list[tuple[Array, Array] | None] = []
    for exciter in scene.exciters:
        moment, drive = first_moment(exciter), exciter.drive
        start = drive.starting_torque() if 1 in gravity and moment is not None and isinstance(drive, Motor) else None
        found.append(None if start is None or moment is None else (_SWING_SHARE * moment * jnp.abs(gravity[1]), start))
    return found


def first_moment(exciter: Exciter) -> Array | None:
    """Return the modulus of the vector sum of the unbalance S and the static imbalances M e, kg m; None if there are none."""
    terms = static_imbalances(exciter.effects)
    if not terms:
        return exciter.unbalance
    own = jnp.zeros_like(exciter.drive.speed) if exciter.unbalance is None else exciter.unbalance
    vectors = [term.at(jnp.zeros_like(term.phase)).static for term in terms]
    return jnp.hypot(own + sum(x for x, _ in vectors), sum(y for _, y in vectors))


def weight_accelerations(scene: Scene) -> dict[int, float]:
    """Return S g / I, rad/s^2, for each exciter with a motor and an unbalance S; the keys are the numbers of these exciters,
    counted from 0. At the speed w the weight changes the speed of the rotor of inertia I within a turn by the share S g / (I
    w^2)."""
    g = float(np.hypot.reduce([float(each) for each in total_gravity(scene.all_effects).values()] or [0.0]))
    found = {}
    for k, exciter in enumerate(scene.exciters):
        moment, drive = first_moment(exciter), exciter.drive
        if moment is not None and isinstance(drive, Motor):
            found[k] = g * float(moment / drive.inertia)
    return found


_MIN_SHOWN_WEIGHT = 0.05
"""Smallest relative change of a speed within a turn by the weight for which there is a note. The change is 0.005 to 0.008 at
the working speeds of the templates of screens, and 0.29 to 0.36 at their lowest resonances."""


def weight_notes(scene: Scene, slowest: Mapping[int, float]) -> list[str]:
    """Return a sentence about the exciter whose speed the weight of its unbalance changes most, if this change is large.
    `slowest`: lowest speed, rad/s, of stable averaged motions by the number of the exciter."""
    shares = {k: each / slowest[k] ** 2 for k, each in weight_accelerations(scene).items() if k in slowest}
    k = max(shares, key=lambda k: shares[k], default=None)
    if k is None or shares[k] < _MIN_SHOWN_WEIGHT:
        return []
    return [f"{_weight_text('an unbalance', slowest[k], shares[k])}; synchronous_orbit and simulate include it"]


def _weight_text(what: str, speed: float, share: float) -> str:
    effect = f"the weight of {what}, which averaging omits, changes the speed by {100.0 * share:.0f} % within a turn"
    return f"at {speed_text(speed, 6)} {effect} and can make the motion unstable"


def load_weight_notes(scene: Scene, slowest: float | None = None) -> list[str]:
    """Return sentences about loads whose drag cannot turn them over the top from rest, and about the effect of their weight at
    the speed `slowest`, rad/s, of the slowest stable jam (None: not judged).

    The torque on a load at rest is at most b_W R^2 n; 0.7246 m g R is needed. The weight changes the speed w of a load within a
    turn by the share g / (kappa R w^2).
    """
    gravity, notes = total_gravity(scene.all_effects), []
    g = math.hypot(*(float(gravity.get(axis, 0.0)) for axis in (0, 1)))
    for exciter in scene.exciters if g > 0.0 else ():
        loads = exciter.loads
        if not isinstance(loads, CircularLoads) or not loads.circular:
            continue
        need, drag = np.broadcast_arrays(
            _SWING_SHARE * g * np.asarray(loads.mass * loads.radius),
            np.asarray(loads.drag * loads.radius**2 * exciter.drive.speed),
        )
        k = np.argmax(need - drag)
        if need.flat[k] > drag.flat[k]:
            torques = f"the weight of a load needs {need.flat[k]:.3g} N m, its drag gives at most {drag.flat[k]:.3g} N m"
            notes.append(f"loads at rest swing and do not turn over: {torques}; a jam needs loads that turn already")
        if slowest is not None:
            share = float(np.max(g / (np.asarray(loads.inertia_factor() * loads.radius) * slowest**2)))
            if share >= _MIN_SHOWN_WEIGHT:
                notes.append(f"{_weight_text('the loads', slowest, share)}; simulate includes it")
    return notes


def start_notes(scene: Scene, exciters: Iterable[int] | None = None) -> list[str]:
    """Return sentences about the motors that cannot turn their hanging unbalances over the top. Motors with equal torques share
    one sentence.

    Motors whose torque at rest changes over time, such as those of converters, are not judged. `exciters`: numbers, from 0, of
    the exciters to judge; default: all.

    >>> import jaxvib as jv
    >>> motor = jv.DCMotor(100.0, stall_torque=2.5, inertia=0.5)
    >>> start_notes(jv.Scene(jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0),
    ...                      exciters=[jv.Exciter(drive=motor, unbalance=0.4)], effects=jv.Gravity()))
    ['the motor cannot start: the weight of its unbalance needs 2.84 N m, its starting torque is 2.5 N m']
    """
    chosen = set(range(len(scene.exciters)) if exciters is None else exciters)
    equal: dict[str, list[str]] = {}
    for k, (exciter, torques) in enumerate(zip(scene.exciters, lifting_torques(scene), strict=True)):
        if k not in chosen or torques is None or exciter.drive.jump_ts() or float(torques[1]) > float(torques[0]):
            continue
        weight, start = (f"{float(each):.3g} N m" for each in torques)
        by_plate = getattr(exciter.drive, "starting_ratio", 0.0) is None
        hint = " by Kloss's formula; give that of the catalogue as starting_ratio" if by_plate else ""
        reason = f"cannot start: the weight of its unbalance needs {weight}, its starting torque is {start}{hint}"
        equal.setdefault(reason, []).append(str(k + 1))
    notes = []
    for reason, numbers in equal.items():
        if len(numbers) > 1:
            notes.append(f"each motor of the exciters {', '.join(numbers[:-1])} and {numbers[-1]} {reason}")
        else:
            notes.append(f"the motor{f' of exciter {numbers[0]}' if len(scene.exciters) > 1 else ''} {reason}")
    return notes


def off_notes(scene: Scene) -> list[str]:
    """Return a sentence about each motor that is switched off during a run: steady motions are those after this time.

    >>> import jaxvib as jv
    >>> motor = jv.SwitchedOff(jv.DCMotor(100.0, stall_torque=2.5, inertia=0.5), at="8 s")
    >>> off_notes(jv.Scene(jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0),
    ...                    exciters=[jv.Exciter(drive=motor, unbalance=0.4)]))
    ['exciter 1 is switched off at 8 s: steady motions are those after this time; leave switched_off out for those before it']
    """
    times = {k: float(e.drive.at) for k, e in enumerate(scene.exciters, 1) if isinstance(e.drive, SwitchedOff)}
    end = "steady motions are those after this time; leave switched_off out for those before it"
    return [f"exciter {k} is switched off at {at:g} s: {end}" for k, at in times.items() if at > 0.0]


_CARRIED = ("loads", "unbalance")


def _rebuild(scene: Scene) -> None:
    """Construct each part of a scene again. **Raises** `InputError` for a known value or a shape that is not allowed."""
    _rebuild_part(scene.machine, "machine")
    scene.machine.require_valid()
    for k, exciter in enumerate(scene.exciters):
        with within(scene.prefix_of(k)):
            if exciter.loads is not None:
                _rebuild_part(exciter.loads, "loads")
            _rebuild_part(exciter.drive, "drive")
            if (exciter.loads is not None, exciter.unbalance is not None) != tuple(x in exciter.carries for x in _CARRIED):
                raise InputError("carries", f"is {exciter.carries}, but the exciter has other parts; create a new Exciter")
            for name in ("unbalance", "unbalance_mass"):
                if shape := np.shape(0.0 if (value := getattr(exciter, name)) is None else value):
                    raise InputError(name, f"is an array of shape {shape}; the shape () is needed")
            read_unbalance(exciter.drive, exciter.unbalance, exciter.unbalance_mass)
            scene.machine.mounting(exciter.place)
            for effect in exciter.effects:
                _rebuild_part(effect, f"effects.{effect.kind}")
    for effect in scene.effects:
        _rebuild_part(effect, f"effects.{effect.kind}")


def _rebuild_part(part: Any, section: str) -> None:
    """Construct a part again. **Raises** `InputError` for values that the constructor rejects, and for a shape that only the
    constructor accepts, such as one number for an array of one value."""
    named, rebuilt = jax.tree_util.tree_leaves_with_path(part), jax.tree.leaves(rebuild_part(part, section))
    for (path, leaf), new in zip(named, rebuilt, strict=False):
        if np.shape(leaf) != np.shape(new):
            name = f"{section}{jax.tree_util.keystr(path)}"
            raise InputError(name, f"is an array of shape {np.shape(leaf)}; the shape {np.shape(new)} is needed")


@dataclasses.dataclass(frozen=True)
class _SceneKey:
    """Scene compared by the values of all its parameters, because a derivative creates equal scenes several times."""

    numbers: Hashable
    scene: Scene = dataclasses.field(compare=False)


@functools.lru_cache(256)
def _require_valid(key: _SceneKey) -> None:
    """**Raises** `InputError` for a value that is not allowed."""
    scene = key.scene
    _rebuild(scene)
    for k, exciter in enumerate(scene.exciters):
        if exciter.loads is not None:
            with within(scene.prefix_of(k)):
                require_comparable(scene.machine, exciter.loads, exciter.drive)


def make_scene(make: Callable[..., Scene], *values: object) -> Scene:
    """Return the scene that a user's function `make` returns for `values`. **Raises** the errors of `validate_scene`.

    >>> make_scene(lambda x: None, 1.0)
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: make(1.0) is None; it must return a Scene
    """
    scene = call_user(make, "make", *values)
    if not isinstance(scene, Scene):
        call = f"make({', '.join(map(quoted, values))})"
        raise InputError(call, f"is {quoted(scene)}; it must return a Scene")
    return validate_scene(scene)


def _number(name: str, leaf: object) -> Array:
    """Return a leaf as a floating-point array. **Raises** `InputError` for text, and for values that are not finite."""
    if not isinstance(leaf, str):
        require_real(leaf, "", name)
    if not isinstance(leaf, jax.Array) or leaf.dtype != float_dtype():
        try:
            leaf = jnp.asarray(leaf, dtype=float)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(name, f"is {quoted(leaf)}, which is not a number; give a number in SI units") from error
    when_known(functools.partial(_require_finite, name), leaf)
    return leaf


def _require_finite(name: str, value: np.ndarray | float) -> None:
    if not np.all(np.isfinite(value)):
        wrong = np.asarray(value)[~np.isfinite(value)].ravel()[0]
        raise InputError(name, f"is {wrong}; it must be finite; check how it was computed")
