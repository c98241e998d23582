"""Decaying swing of a pendulum on a fixed bearing, from which bearing friction is measured without the machine."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto
from jaxvib.errors import InputError
from jaxvib.machine.effects.friction import dry_lever
from jaxvib.motion.plan import Tolerance, require_step_choice
from jaxvib.ode.types import RealScalarLike
from jaxvib.results.fields import in_unit
from jaxvib.results.readable import Readable
from jaxvib.results.result import Result
from jaxvib.runtime.compat import fast_diffrax_loop_end
from jaxvib.runtime.programs import cached
from jaxvib.steady.outcome import outcome
from jaxvib.units import Number, Numbers, count, number, numbers
from jaxvib.units.known import require_if_known


class BearingPendulum(Readable):
    """Pendulum on a stationary bearing; its angle f is measured from the hanging position.

        J f'' = - m g l sin f - mu1 f' - mu2 |N| (d/2) sign(f') - b |f'| f' + M
        J = m l^2 + J_C,      N = m (l f'^2 + g cos f)

    mu1 and mu2 are the viscous and dry friction of the bearing; N is its radial load, along the rod. b is the drag of the air,
    M a constant torque, for example of a cable.

    **Arguments** (SI, or strings with a unit)

    - `mass` m, kg; typical: 0.1 to 1
    - `length` l from the axis of the bearing to the centre of mass, m; typical: 0.1 to 0.5
    - `inertia` J_C about the centre of mass, kg m^2 (default 0: a point mass; a rod of length L has m L^2/12); typical: 1e-3 to
      0.05
    - `bearing`: its diameter d, m, needed for dry friction only; typical: 0.005 to 0.02
    - `g`, m/s^2; typical: 9.81 (the default)

    **Raises** `InputError` for wrong units and values that are not positive.

    >>> import jaxvib as jv
    >>> rod = jv.BearingPendulum(mass="300 g", length="25 cm", inertia=0.3 * 0.5**2 / 12)
    >>> round(float(rod.total_inertia), 6), round(float(rod.frequency), 4)
    (0.025, 5.4249)

    Source: Artyunin, Sumenkov 2019, figure 2; extended here to large swings and dry friction.
    """

    mass: Array
    length: Array
    inertia: Array
    bearing: Array | None
    g: Array

    @validated
    def __init__(self, mass: Number, length: Number, inertia: Number = 0.0, bearing: Number | None = None, g: Number = 9.81):
        self.mass = number(mass, "kg", "pendulum.mass", low=0.0, open_low=True)
        self.length = number(length, "m", "pendulum.length", low=0.0, open_low=True)
        self.inertia = number(inertia, "kg m^2", "pendulum.inertia", low=0.0)
        self.bearing = None if bearing is None else number(bearing, "m", "pendulum.bearing", low=0.0, open_low=True)
        self.g = number(g, "m/s^2", "pendulum.g", low=0.0, open_low=True)

    @property
    def total_inertia(self) -> Array:
        """Moment of inertia about the bearing, J = m l^2 + J_C, kg m^2; typical: 2e-3 to 0.1."""
        return self.mass * self.length**2 + self.inertia

    @property
    def frequency(self) -> Array:
        """Natural frequency of small swings without friction, sqrt(m g l/J), rad/s; typical: 4 to 10."""
        return jnp.sqrt(self.mass * self.g * self.length / self.total_inertia)

    @property
    def diameter(self) -> Array:
        """Diameter at which dry friction acts, m. **Raises** `InputError` if it is missing."""
        if self.bearing is None:
            raise InputError("pendulum.bearing", "is missing; dry friction acts at the bearing's diameter; give it in m")
        return self.bearing

    def radial_load(self, angle: Array, rate: Array) -> Array:
        """Return N = m (l f'^2 + g cos f), N: the load of the bearing along the rod.

        **Arguments**: `angle` f, rad, and its `rate` f', rad/s.
        """
        return self.mass * (self.length * rate**2 + self.g * jnp.cos(angle))

    def rest_angle(self, torque: Array | float) -> Array:
        """Return the angle, rad, at which the pendulum rests under a constant `torque` M, N m: m g l sin f = M."""
        return jnp.arcsin(jnp.clip(torque / (self.mass * self.g * self.length), -1.0, 1.0))

    def dead_zone(self, dry: Array) -> Array:
        """Return the angle, rad, up to which dry friction mu2 (`dry`) holds the pendulum at rest: tan f = mu2 d/(2 l)."""
        return jnp.arctan(dry * self.diameter / (2.0 * self.length))


class Friction(NamedTuple):
    """Coefficients of the torques on a pendulum, except the torque of gravity.

    **Attributes**: `viscous` mu1, N m s; `dry` mu2; `air` b, N m s^2; constant `torque` M, N m; None for an absent torque.
    """

    viscous: Array
    dry: Array | None = None
    air: Array | None = None
    torque: Array | None = None


class SwingStatus(eqx.Enumeration):
    """Outcomes of a swing. The value of each member is the message shown to the user."""

    swinging = "the pendulum still swings at the last time"
    stopped = "dry friction stopped the pendulum"
    max_steps_reached = "the swing needs more steps than max_steps to reach its last time"
    no_start = "the swing does not exist: one of its parameters is not finite, or its centre of mass would be above the bearing"


class Swing(Result):
    """Decaying swing of a pendulum.

    Returned by `swing`.

    **Attributes**

    - `status`: a `SwingStatus`
    - `time` (n,), s
    - `angle` (n,), rad, from the hanging position, and angular velocity `rate` (n,), rad/s
    - `stopped_at`: time, s, at which the pendulum stopped; NaN if it still swings
    - `width`, rad/s: range of angular velocities over which dry friction was smoothed; NaN without dry friction
    - `steps`: number of steps of the integration
    """

    status: SwingStatus
    time: Array = eqx.field(metadata=in_unit("s", "time"))
    angle: Array = eqx.field(metadata=in_unit("rad", "time"))
    rate: Array = eqx.field(metadata=in_unit("rad/s", "time"))
    stopped_at: Array = eqx.field(metadata=in_unit("s"))
    width: Array = eqx.field(metadata=in_unit("rad/s"))
    steps: Array = eqx.field(metadata=in_unit(""))

    def summary(self) -> str:
        """Return the outcome of the swing as text."""
        when = f" at {float(self.stopped_at):.6g} s" if np.isfinite(self.stopped_at) else ""
        first, last = (f"{float(np.rad2deg(self.angle[k])):.4g} deg at {float(self.time[k]):.6g} s" for k in (0, -1))
        return f"{self.message}{when}; from {first} to {last}, {int(self.steps)} steps"

    @validated
    def plot(self, *, ax: Onto = None) -> Drawn:
        """Plot angle and rate over time, onto two axes `ax` if given."""
        from jaxvib.draw.results import signals_chart  # slow import

        angle, rate = (np.asarray(x)[:, None] for x in (self.angle, self.rate))
        signals = [("angle, deg", np.rad2deg(angle), ["angle"]), ("rate, rad/s", rate, ["rate"])]
        return signals_chart(np.asarray(self.time), signals, x_label="time, s", ax=ax)


@validated
def swing(
    pendulum: BearingPendulum,
    time: Numbers,
    *,
    angle: Number,
    rate: Number = 0.0,
    viscous: Number,
    dry: Number | None = None,
    air: Number | None = None,
    torque: Number | None = None,
    width: Number | None = None,
    stepsize_controller: Tolerance | diffrax.AbstractStepSizeController | None = None,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int = 2**17,
    throw: bool = True,
) -> Swing:
    """Return the motion of a pendulum at the times `time`, from `angle` and `rate` at the first time.

        J f'' = - m g l sin f - mu1 f' - mu2 |N| (d/2) tanh(f'/width) - b |f'| f' + M

    If the pendulum reverses its motion within the dead zone |sin f - M/(m g l)| < mu2 d/(2 l) cos f, dry friction holds it
    permanently.

    **Arguments** (SI, or strings with a unit)

    - `pendulum`: a `BearingPendulum`
    - `time` (n,), s, ascending; typical: 10 to 200 s
    - `angle` from hanging, rad, and `rate`, rad/s (default 0), at time[0]; typical: 3 to 60 deg
    - `viscous` mu1, N m s; typical: 3e-4 to 2e-3
    - `dry` mu2, no unit; typical: about 0.0015 for ball bearings; default: no dry friction
    - `air`: drag b of the air, N m s^2; typical: 1e-6 to 1e-3; default: none
    - `torque` M, N m, constant, below m g l; typical: -0.01 to 0.01; default: none
    - `width`, rad/s: range of f' over which the dry friction changes its sign; default: a twentieth of the dead zone's angle
      times the natural frequency. A swing as small as the dead zone then loses 0.1 % too little energy; the error of larger
      swings is smaller. A smaller width needs more steps
    - `stepsize_controller`: a `Tolerance`, whose number is the relative tolerance of a step and also the absolute tolerance, in
      rad and rad/s, or a controller of diffrax; typical: 1e-6 to 1e-9 (the default; in single precision 1e-5)
    - `solver`, `adjoint`, `max_steps`: as in diffrax; default: `Tsit5`, `RecursiveCheckpointAdjoint`, 131,072 steps
    - `throw`: True to raise `ComputationError` if `max_steps` is too small; otherwise, and under a JAX transformation, the
      status shows it

    **Returns** `Swing`. Derivatives in reverse mode, and in forward mode (with `adjoint=diffrax.ForwardMode()`), `jit` and
    `vmap` are supported.

    **Raises** `InputError` for wrong values and for dry friction without the diameter of the bearing; `ComputationError` with
    the status "max_steps_reached".

    >>> import numpy as np, jaxvib as jv
    >>> rod = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.00625, bearing=0.02)
    >>> run = jv.swing(rod, np.linspace(0.0, 200.0, 5), angle="10 deg", viscous=2e-4, dry=0.02)
    >>> bool(run.status == jv.SwingStatus.stopped), round(float(run.stopped_at), 1)
    (True, 56.2)

    Source: Artyunin, Sumenkov 2019, equations (1)-(3).
    """
    times = numbers(time, "s", "time", None)
    chosen = Tolerance(1e-9 if times.dtype.itemsize >= 8 else 1e-5) if stepsize_controller is None else stepsize_controller
    require_step_choice(chosen, Tolerance, diffrax.AbstractStepSizeController)
    if times.ndim != 1:
        raise InputError("time", "is one number; a list of times is needed")
    problem = "must ascend, each time later than the one before"
    require_if_known(lambda t: np.all(np.diff(t) > 0.0), times, field="time", problem=problem)
    friction = Friction(
        number(viscous, "N m s", "viscous", low=0.0),
        None if dry is None else number(dry, "", "dry", low=0.0),
        None if air is None else number(air, "N m s^2", "air", low=0.0),
        None if torque is None else number(torque, "N m", "torque"),
    )
    if dry is not None:
        _ = pendulum.diameter  # raises if it is missing
    if torque is not None:
        problem = "is {:g} N m; it must be below m g l, {:.4g} N m"
        weight = pendulum.mass * pendulum.g * pendulum.length
        require_if_known(lambda torque, limit: abs(torque) < limit, friction.torque, weight, field="torque", problem=problem)
    run = swing_states(
        pendulum,
        times,
        number(angle, "rad", "angle"),
        number(rate, "rad/s", "rate"),
        friction,
        None if width is None else number(width, "rad/s", "width", low=0.0, open_low=True),
        controller_to(chosen.tolerance) if isinstance(chosen, Tolerance) else chosen,
        diffrax.Tsit5() if solver is None else solver,
        diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        count(max_steps, "max_steps"),
    )
    return outcome(run, throw=throw, failures=("max_steps_reached",), hint=lambda _: f" ({max_steps}); give a larger max_steps")


def controller_to(tolerance: float) -> diffrax.AbstractStepSizeController:
    """Return a proportional-integral controller of steps to a relative and absolute tolerance."""
    return diffrax.PIDController(rtol=tolerance, atol=tolerance, pcoeff=0.2, icoeff=0.4)


@cached
@fast_diffrax_loop_end()
def swing_states(
    pendulum: BearingPendulum,
    times: Array,
    angle: Array,
    rate: Array,
    friction: Friction,
    width: Array | None,
    controller: diffrax.AbstractStepSizeController,
    solver: diffrax.AbstractSolver,
    adjoint: diffrax.AbstractAdjoint,
    max_steps: int,
) -> Swing:
    """Compute a `swing` without validation of its arguments; coefficients may be negative, which happens in a fit to noise."""
    values = jnp.stack(jnp.broadcast_arrays(pendulum.frequency, angle, rate, *jax.tree.leaves(friction)))
    exists = jnp.all(jnp.isfinite(values))
    # A swing of a batch that does not exist (a step of a fit left the allowed range) must not disturb the other swings.
    angle, rate, friction = jax.tree.map(lambda value: jnp.where(exists, value, 0.0), (angle, rate, friction))
    pendulum = eqx.tree_at(lambda p: p.g, pendulum, jnp.where(exists, pendulum.g, 1.0))
    frequency, dry = pendulum.frequency, friction.dry
    if dry is not None and width is None:
        width = _usual_width(pendulum, dry)
    margin = None if dry is None or width is None else _margin_to_rest(pendulum, friction, dry, width)
    # The function of the event does not change its sign if friction already holds the pendulum at the start.
    free = None if margin is None else margin(times[0], (angle, rate), None) > 0.0
    scale = jax.lax.stop_gradient(frequency)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(_rates(pendulum, friction, width, free)),
        solver,
        t0=times[0],
        t1=times[-1],
        dt0=0.02 / scale,
        y0=(angle, rate),
        saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=times), diffrax.SubSaveAt(t1=True)]),
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=max_steps,
        throw=False,
        # `flip=True` states that the function decreases through 0. Without it the search would fail if the last step ends just
        # before the root: by rounding, the function may then have the same sign at both ends of the step.
        event=None if margin is None else diffrax.Event(margin, root_finder=optx.Bisection(1e-12, 1e-12, flip=True)),
    )
    assert solution.ts is not None and solution.ys is not None
    (f, rates), ((end,), (end_rate,)) = solution.ys
    stopped = solution.result == diffrax.RESULTS.event_occurred
    last = solution.ts[1][0]
    if dry is not None and free is not None:
        last, stopped = jnp.where(free, last, times[0]), stopped | ~free
        last, rest = _motion_to_rest(pendulum, friction, dry, times, last, (end, end_rate))
        is_after_stop = stopped & ~jnp.isfinite(f)
        f, rates = (jnp.where(is_after_stop, value, before) for value, before in zip(rest, (f, rates), strict=True))
    finished = stopped | (solution.result == diffrax.RESULTS.successful)
    is_usable = exists & finished
    return Swing(
        status=_status(exists, finished, stopped),
        time=times,
        angle=jnp.where(is_usable, f, jnp.nan),
        rate=jnp.where(is_usable, rates, jnp.nan),
        stopped_at=jax.lax.stop_gradient(jnp.where(stopped, last, jnp.nan)),
        width=jnp.full_like(frequency, jnp.nan) if width is None else width,
        steps=solution.stats["num_steps"],
    )


def _usual_width(pendulum: BearingPendulum, dry: Array) -> Array:
    """Return the width of the smoothed dry friction, 5 % of the speed of a swing through the dead zone, rad/s."""
    frequency = pendulum.frequency
    zone = jax.lax.stop_gradient(pendulum.dead_zone(jnp.abs(dry)) * frequency)
    return 0.05 * jnp.where(zone > 0.0, zone, frequency)


def _status(exists: Array, finished: Array, stopped: Array) -> SwingStatus:
    status = SwingStatus.where(stopped, SwingStatus.stopped, SwingStatus.swinging)
    status = SwingStatus.where(finished, status, SwingStatus.max_steps_reached)
    return SwingStatus.where(exists, status, SwingStatus.no_start)


_Pair: TypeAlias = tuple[Array, Array]
"""Angle and rate of a pendulum, or their rates."""


def _margin_to_rest(pendulum: BearingPendulum, friction: Friction, dry: Array, width: Array) -> Callable[..., Array]:
    """Return a function of the motion that becomes negative when the pendulum is slow and within the dead zone.

    The integration then ends, because with the smoothed sign of dry friction the pendulum would creep.
    """

    def moving(t: RealScalarLike, y: _Pair, args: None, **_: object) -> Array:
        f, rate = y
        slow = jnp.abs(rate) - 3.0 * width
        lean = jnp.tan(f)
        if friction.torque is not None:  # gravity without the part that balances the torque
            lean = lean - friction.torque / (pendulum.mass * pendulum.g * pendulum.length * jnp.cos(f))
        return jnp.maximum(slow, pendulum.frequency * (jnp.abs(lean) - jnp.tan(pendulum.dead_zone(dry))))

    return moving


def _rates(
    pendulum: BearingPendulum, friction: Friction, width: Array | None, free: Array | None
) -> Callable[[RealScalarLike, _Pair, None], _Pair]:
    """Return the equations of motion of the pendulum.

    **Arguments**: `free`: False if dry friction holds the pendulum at the start; it then stays at rest. None without dry
    friction.
    """

    def rates(t: RealScalarLike, y: _Pair, args: None) -> _Pair:
        f, rate = y
        torque = -pendulum.mass * pendulum.g * pendulum.length * jnp.sin(f) - friction.viscous * rate
        if friction.air is not None:
            torque = torque - friction.air * jnp.abs(rate) * rate
        if friction.torque is not None:
            torque = torque + friction.torque
        dry = friction.dry
        if dry is None or width is None or free is None:
            return rate, torque / pendulum.total_inertia
        torque = torque - dry_lever(dry, pendulum.diameter, rate, width) * jnp.abs(pendulum.radial_load(f, rate))
        return jnp.where(free, rate, 0.0), jnp.where(free, torque / pendulum.total_inertia, 0.0)

    return rates


def _motion_to_rest(
    pendulum: BearingPendulum, friction: Friction, dry: Array, times: Array, last: Array, y: _Pair
) -> tuple[Array, _Pair]:
    """Return the time at which a slow pendulum comes to rest, and its angles and rates at `times`.

    The motion continues from the state `y` at the time `last`. With the exact sign of dry friction it is a harmonic motion
    about that boundary of the dead zone which lies behind the moving pendulum.
    """
    (end, end_rate), frequency = y, pendulum.frequency
    direction = jnp.where(end_rate < 0.0, -1.0, 1.0)
    centre = -direction * pendulum.dead_zone(dry)
    if friction.torque is not None:
        rest = pendulum.rest_angle(friction.torque)
        centre, frequency = centre + rest, frequency * jnp.sqrt(jnp.cos(rest))
    radius = jnp.hypot(end - centre, end_rate / frequency)
    last = last + jnp.arctan2(jnp.abs(end_rate) / frequency, jnp.abs(end - centre)) / frequency
    phase = frequency * jnp.maximum(last - times, 0.0)
    return last, (centre + direction * radius * jnp.cos(phase), direction * radius * frequency * jnp.sin(phase))
