"""State of a scene, and its time derivative."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError, quoted, within
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.results.fields import in_unit, part
from jaxvib.results.readable import Readable
from jaxvib.units.reading import require_real


class Spin(Readable):
    """Free rotation of rolling loads, if effects permit it (`FreeSpin`, `Sliding`), or its time derivative.

    **Attributes** (each is None if no effect permits it)

    - `drilling` (count,), rad/s: a load's spin about the normal of its contact, relative to its track
    - `slip`: a (count,) array, m/s, for each coordinate of a load: the velocity of its point of contact relative to the track
      along that coordinate

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> spin = jv.Spin(drilling=jnp.array([3.0, 3.0]), slip=None)
    >>> spin.drilling.shape
    (2,)
    """

    drilling: Array | None = eqx.field(metadata=in_unit("rad/s", "load"), default=None)
    slip: tuple[Array, ...] | None = eqx.field(metadata=in_unit("m/s", "load"), default=None)


class ExciterState(Readable):
    """Positions and velocities of one exciter, or their time derivatives.

    All angles are anticlockwise.

    **Attributes**

    - `angle` and `rate`: a tuple of (count,) arrays, one for each coordinate of a load: for loads on a circle ((phi_1, ...),)
      in rad and rad/s; () without loads
    - `rotor`: if a motor drives the rotor, its angle, rad, its speed, rad/s, and the states of the motor, such as currents
      (`motor_state` in tables and datasets of a run); None under an ideal drive
    - `spin` of the loads if effects permit it, see `Spin` and `with_spin`; otherwise None

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> state = jv.State(displacement=jnp.zeros(1), velocity=jnp.zeros(1), angle=(jnp.array([0.0, 0.1]),), rate=(jnp.zeros(2),))
    >>> state.azimuth.shape, state.rotor
    ((2,), None)
    """

    angle: tuple[Array, ...] = eqx.field(metadata=in_unit("rad", "load"), default=())
    rate: tuple[Array, ...] = eqx.field(metadata=in_unit("rad/s", "load"), default=())
    rotor: tuple[Array, ...] | None = eqx.field(metadata=in_unit("SI", name="motor_state", first=2), default=None)
    spin: Spin | None = eqx.field(metadata=part(), default=None)


class _Omitted:
    """Default of an argument for which None is a value."""

    def __repr__(self) -> str:
        return "..."


_OMITTED: Any = _Omitted()


class State(Readable):
    """Positions and velocities of all parts of a scene, or their time derivatives.

    **Arguments**

    - `displacement` q (nd,), m, and `velocity` q' (nd,), m/s, of the carrier's coordinates; tilts in rad and rad/s; typical:
      0.1 to 10 mm
    - `angle`, `rate`, `rotor`, `spin` of the exciter of a scene with one exciter, see `ExciterState`
    - `exciters`: instead of these, an `ExciterState` for each exciter. If one `ExciterState` is given together with `angle`,
      `rate`, `rotor` or `spin`, these replace its values. Therefore `dataclasses.replace(state, spin=None)` returns the state
      without a spin

    **Attributes**: `displacement`, `velocity` and `exciters`. Those of the only exciter are `angle`, `rate`, `rotor`, `spin`.

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> state = jv.State(jnp.zeros(2), jnp.zeros(2), angle=(jnp.zeros(3),), rate=(jnp.full(3, 60.0),))
    >>> len(state.exciters), state.rate[0].tolist()
    (1, [60.0, 60.0, 60.0])
    """

    displacement: Array = eqx.field(metadata=in_unit("m or rad", "coordinate"))
    velocity: Array = eqx.field(metadata=in_unit("m/s or rad/s", "coordinate"))
    exciters: tuple[ExciterState, ...] = eqx.field(metadata=part())

    def __init__(
        self,
        displacement: Array,
        velocity: Array,
        angle: tuple[Array, ...] = _OMITTED,
        rate: tuple[Array, ...] = _OMITTED,
        rotor: tuple[Array, ...] | None = _OMITTED,
        spin: Spin | None = _OMITTED,
        *,
        exciters: Sequence[ExciterState] | None = None,
    ):
        named = {"angle": angle, "rate": rate, "rotor": rotor, "spin": spin}
        given = {name: value for name, value in named.items() if value is not _OMITTED}
        self.displacement, self.velocity = displacement, velocity
        self.exciters = (ExciterState(**given),) if exciters is None else tuple(exciters)
        if exciters is not None and given:
            if len(self.exciters) != 1:
                problem = f"are {len(self.exciters)}, together with {' and '.join(given)}; give these to an ExciterState"
                raise InputError("exciters", problem)
            self.exciters = (dataclasses.replace(self.exciters[0], **given),)

    @property
    def exciter(self) -> ExciterState:
        """State of the only exciter. **Raises** `InputError` if there are several."""
        if len(self.exciters) != 1:
            raise InputError("state", f"has {len(self.exciters)} exciters; read state.exciters[0].angle and so on")
        return self.exciters[0]

    @property
    def angle(self) -> tuple[Array, ...]:
        """Coordinates of the loads of the only exciter."""
        return self.exciter.angle

    @property
    def rate(self) -> tuple[Array, ...]:
        """Rates of the coordinates of the loads of the only exciter."""
        return self.exciter.rate

    @property
    def rotor(self) -> tuple[Array, ...] | None:
        """Angle, speed and states of the motor that drives the only rotor; None under an ideal drive."""
        return self.exciter.rotor

    @property
    def spin(self) -> Spin | None:
        """Rotation of the loads of the only exciter, if effects make it free."""
        return self.exciter.spin

    @property
    def azimuth(self) -> Array:
        """Angles of the loads about the rotor's axis, (..., count) rad: the first of their coordinates."""
        return self.angle[0]

    @property
    def azimuth_rate(self) -> Array:
        """Rates of the azimuths, (..., count) rad/s."""
        return self.rate[0]


def require_state(scene: Scene, state: State, name: str) -> None:
    """**Raises** `InputError` for a state of another scene, and for a `State` that contains several states (arrays with an
    additional axis); `name` of the state in messages."""
    require_motion(scene, state, name)
    if len(state.exciters) != len(scene.exciters):
        raise InputError(f"{name}.exciters", f"are {len(state.exciters)}; this scene needs {len(scene.exciters)}")
    for k, (exciter, own) in enumerate(zip(scene.exciters, state.exciters, strict=True)):
        with within(scene.prefix_of(k)):
            for field in ("angle", "rate", "rotor"):
                if not isinstance(value := getattr(own, field), tuple) and not (field == "rotor" and value is None):
                    raise InputError(f"{name}.{field}", f"is {quoted(value)}; it must be a tuple of arrays, (array,)")
            _require_rotor(exciter, own, f"{name}.rotor")
            if (loads := exciter.loads) is not None:
                count = 1 if loads.circular else len(jax.eval_shape(loads.rest))
                _require_shapes(f"{name}.angle", own.angle, (loads.count,), count)
                _require_shapes(f"{name}.rate", own.rate, (loads.count,), count)
            elif own.angle or own.rate:
                raise InputError(f"{name}.angle", "is given, but this exciter has no loads; leave angle and rate out")


def require_motion(scene: Scene, state: State, name: str) -> None:
    """**Raises** `InputError` if the displacement and the velocity of a state do not have an entry for each coordinate."""
    size = scene.machine.structure().mass.shape[:1]
    _require_shapes(f"{name}.displacement", state.displacement, size)
    _require_shapes(f"{name}.velocity", state.velocity, size)


def _require_rotor(exciter: Exciter, state: ExciterState, field: str) -> None:
    """**Raises** `InputError` if the states of the rotor are not those of the drive."""
    rotor, kind = state.rotor, quoted(exciter.drive.kind)
    if exciter.drive.ideal and rotor is not None:
        needed = "it must be None, because the drive prescribes the motion of the rotor"
        raise InputError(field, f"is {quoted(rotor)}; under the drive {kind} {needed}")
    if exciter.drive.ideal:
        return
    if rotor is None:
        needed = "it must be (angle, speed), because the angle and speed of a motor's rotor are part of the state"
        raise InputError(field, f"is None; under the drive {kind} {needed}")
    size = 2 + len(jax.eval_shape(exciter.drive.state_units))
    if len(rotor) != size:
        raise InputError(field, f"has {len(rotor)} entries; {size} are needed: angle, speed and the states of the motor")
    _require_shapes(field, rotor, (), size)


def _require_shapes(field: str, values: object, shape: tuple[int, ...], count: int = 1) -> None:
    """**Raises** `InputError` unless there are `count` arrays of this `shape`."""
    for leaf in jax.tree.leaves(values):
        require_real(leaf, "SI units", field)
    shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(values)]
    wrong = [each for each in shapes if each != shape]
    if wrong:
        several = "; for the states of a trajectory use jax.vmap" if len(wrong[0]) > len(shape) else ""
        raise InputError(field, f"has shape {wrong[0]}; this scene needs {shape}{several}")
    if len(shapes) != count:
        needed = f"one array of shape {shape} is" if count == 1 else f"{count} arrays of shape {shape} are"
        raise InputError(field, f"has {len(shapes)} arrays; {needed} needed")
