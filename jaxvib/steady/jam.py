"""Leading-order jam modes: where light loads get stuck, by algebra alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.friction import DryFriction
from jaxvib.machine.scene import Scene
from jaxvib.machine.units import traced
from jaxvib.programs import kept
from jaxvib.steady.bodies import light_friction
from jaxvib.steady.response import (
    _modes,
    jammed_loads,
    loaded_mass,
    magnitude,
    natural_frequencies,
    steady_displacement,
    turning,
)
from jaxvib.steady.roots import bracketed_root

__all__ = ["Folds", "Jam", "JamModes", "JamStatus", "jam_modes", "jam_rotor_speed"]

_POINTS = 64
"""Grid points on each side of each pole, where folds are looked for."""


class JamStatus(eqx.Enumeration):
    """What is known of a jam mode; the members are the sentences a user reads."""

    found = "the loads can jam in this mode"
    absent = "this mode does not exist at this rotor speed"
    at_fold = "the rotor speed is that of a fold: the mode merges with its neighbour and has no gradient"
    unbounded = "the loads turn at a resonance that nothing damps: the vibration has no bound"


class Folds(eqx.Module):
    """Where two jam modes appear or merge: dn/dOmega = 0.

    **Attributes**, all (2 nd,), ascending in `omega`, padded at the end where `exists` is False: `omega` load speed rad/s;
    `rotor_speed` rad/s; `exists`.
    """

    omega: Array
    rotor_speed: Array
    exists: Array


class Jam(eqx.Module):
    """One jam mode of a scene.

    **Attributes**: `mode` number; `status` a `JamStatus`; `omega` speed of the loads, rad/s; `rotor_speed` rad/s; `stable`
    by the slope; `slope` dn/dOmega; `displacement` (nd,) complex amplitudes, m, at load angle Omega t; `amplitude` (nd,) m and
    `foundation_force` N, zero to peak.
    """

    mode: Array
    status: JamStatus
    omega: Array
    rotor_speed: Array
    stable: Array
    slope: Array
    displacement: Array
    amplitude: Array
    foundation_force: Array

    @property
    def message(self) -> str:
        """What is known of this mode, a sentence."""
        return JamStatus[self.status]  # pyright: ignore[reportInvalidTypeArguments]


class JamModes(Jam):
    """All jam modes at one rotor speed: the arrays of `Jam` with a leading axis over the modes 1 .. 2 nd + 1.

    A mode that does not exist holds NaN and the status `absent`; one without a bound has NaN amplitudes and says `unbounded`.
    Adds `resonances` (nd,) rad/s and the `folds` of the branch. Derivatives of a mode that does not exist are 0, so that it
    does not spoil those of a batch: ask the status, not the gradient.
    """

    resonances: Array
    folds: Folds

    @property
    def exists(self) -> Array:
        """Which modes there are, one Boolean a mode."""
        return self.status != JamStatus.absent

    def mode_numbers(self) -> list[int]:
        """The numbers of the modes that exist."""
        return [int(k) for k, there in zip(np.asarray(self.mode), np.asarray(self.exists), strict=True) if there]

    def select(self, mode: int, *, throw: bool = True) -> Jam:
        """The jam mode of that number.

        **Raises** `InputError` for a number there can never be, `ComputationError` (status "absent") where it does not exist
        at this rotor speed; with `throw=False`, and under a JAX transformation, the status says so.
        """
        most = self.mode.shape[0]
        if isinstance(mode, bool) or not isinstance(mode, (int, np.integer)) or not 1 <= mode <= most:
            raise InputError("mode", f"is {mode!r}; this machine's jam modes are numbered 1 to {most}")
        fields = {name: getattr(self, name) for name in Jam.__dataclass_fields__}
        jam = Jam(**jax.tree.map(lambda leaf: leaf[mode - 1], fields))
        if throw and not traced(self.omega) and not np.asarray(self.exists)[mode - 1]:
            there = ", ".join(map(str, self.mode_numbers()))
            raise ComputationError(
                "absent",
                f"jam mode {mode} does not exist at rotor speed {float(self.rotor_speed[0]):.6g} rad/s; there: {there}",
            )
        return jam

    def summary(self) -> str:
        """A table a person can read; amplitudes zero to peak."""
        lines = [f"rotor speed {float(self.rotor_speed[0]):.6g} rad/s, resonances "]
        lines[0] += ", ".join(f"{float(w):.6g}" for w in self.resonances) + " rad/s"
        for k in self.mode_numbers():
            jam = self.select(k)
            amplitude = ", ".join(f"{float(a):.4g}" for a in jam.amplitude)
            lines.append(
                f"  mode {k}: Omega {float(jam.omega):.6g} rad/s, {'stable' if jam.stable else 'unstable'}, "
                f"amplitude {amplitude} m, foundation force {float(jam.foundation_force):.4g} N"
            )
        return "\n".join(lines)


def jam_rotor_speed(scene: Scene, omega: Array, speed: Array | None = None) -> Array:
    """The rotor's speed n (rad/s) at which the loads jam, collected, at speed `omega` (scalar, rad/s), for light loads.

        n(w) = w - S w^2 Im(e^H B Y(w)) / (2 sum_j b_Wj R_j^2)

    with Y from `steady_displacement`: the drag's torque balances the mean torque of the vibration. It is explicit in
    `omega`, and single-valued through the folds. Where the carrier couples through the rotor's speed, Y is that at `speed`.
    Dry friction helps the drag with mu2 (d/2) N sign(n - w) a load; n is then the root of that balance between w and the above,
    N = m R w^2 (the loads' weight left out: it adds nothing on the average of a turn unless it exceeds that).

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> round(float(jv.jam_rotor_speed(form.scene(), 1.0015)), 4)
    5.1829

    Source: the antiphase paper, equations (31), (35).
    """
    loads = jammed_loads(scene)
    carrier = scene.machine.carrier()
    port = carrier.port @ steady_displacement(scene, omega, speed)
    torque = -loads.unbalance() * omega**2 * jnp.sum(jnp.conj(turning(carrier)) * port).imag / 2.0
    free = omega + torque / loads.drag_sum()
    if not any(isinstance(effect, DryFriction) for effect in scene.effects):
        return free

    def left_over(n: Array) -> Array:
        return loads.drag_sum() * (n - omega) + light_friction(scene, omega, n) - torque

    return bracketed_root(left_over, omega, free)


def jam_modes(scene: Scene) -> JamModes:
    """Every way in which light, collected loads can jam at the scene's rotor speed, held back by drag and dry friction.

    The branch n(Omega) of `jam_rotor_speed` is cut at its folds dn/dOmega = 0 into monotone pieces; each piece that reaches
    the rotor speed holds one mode. Numbers follow the resonances: 2r - 1 rises toward the peak of resonance r, 2r falls
    from it, 2 nd + 1 is beyond the last; so mode 3 is the jam just below the second resonance even where the first one is
    damped so much that modes 1 and 2 have vanished. Rising pieces (odd modes) are stable by slope, falling ones are not.
    Where the branch has more peaks than resonances, the lowest ripples, each over a narrow range of rotor speeds, are left out.

    **Returns** `JamModes`; derivatives of every number with respect to every number of the scene are exact (implicit
    function theorem), forward and reverse. `vmap` over scenes gives many rotor speeds at once.

    **Raises** `InputError` for loads without drag, or a machine whose coordinates couple through the rotor's speed.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> modes = jv.jam_modes(form.scene())
    >>> modes.mode_numbers(), round(float(modes.omega[2]), 4)
    ([3, 4, 5], 0.9721)

    Source: the antiphase paper, section 5.2, equations (30)-(39).
    """
    drag = jammed_loads(scene).drag
    if not traced(drag) and not np.any(np.asarray(drag) > 0.0):
        raise InputError("loads.drag", "is 0; loads without drag never follow the rotor, give a drag greater than 0")
    return _jam_modes(scene)


@kept
def _jam_modes(scene: Scene) -> JamModes:
    n = scene.drive.speed
    pieces = _pieces(scene)
    omega, exists = jax.vmap(lambda lo, hi: _solve_on_piece(scene, lo, hi))(pieces.low, pieces.high)

    numbers = jnp.arange(1, 2 * pieces.resonances.shape[0] + 2)
    hits = (pieces.mode[None, :] == numbers[:, None]) & exists[None, :]
    there = jnp.any(hits, axis=1)
    chosen = jnp.argmax(hits, axis=1)
    omega = jnp.where(there, omega[chosen], n)

    # Closer to a fold than this, its rotor speed cannot be told from the scene's, and a derivative has no digits left.
    speeds = jax.lax.stop_gradient(jnp.where(pieces.folds.exists, pieces.folds.rotor_speed, jnp.inf))
    close = jnp.concatenate([jnp.zeros((1,), bool), jnp.abs(speeds - n) < 4096.0 * jnp.finfo(n.dtype).eps * n])
    close = (close | jnp.roll(close, -1))[chosen]

    def jam(number: Array, w: Array, is_there: Array, flat: Array) -> Jam:
        found = _jam_at(scene, number, w, n, flat)
        values = jax.tree.map(
            lambda value: jnp.where(is_there, value, jnp.nan) if jnp.issubdtype(value.dtype, jnp.inexact) else value,
            found,
        )
        return eqx.tree_at(
            lambda j: (j.status, j.stable, j.rotor_speed),
            values,
            (JamStatus.where(is_there, found.status, JamStatus.absent), is_there & found.stable, n),
        )

    jams = jax.vmap(jam)(numbers, omega, there, close)
    fields = {name: getattr(jams, name) for name in Jam.__dataclass_fields__}
    return JamModes(**fields, resonances=natural_frequencies(scene), folds=pieces.folds)


def _jam_at(scene: Scene, number: Array, omega: Array, rotor_speed: Array, at_fold: Array) -> Jam:
    displacement = steady_displacement(scene, omega)
    # Within a few units of the last digit of an undamped resonance the amplitude is rounding, not an answer.
    throw = jammed_loads(scene).unbalance() / jnp.min(jnp.diagonal(loaded_mass(scene)))
    bounded = jnp.all(magnitude(displacement) * 100.0 * jnp.finfo(throw.dtype).eps < throw)
    displacement = jnp.where(bounded, displacement, jnp.nan)
    slope = jnp.where(bounded, _slope(scene, omega), jnp.nan)
    status = JamStatus.where(at_fold, JamStatus.at_fold, JamStatus.found)
    return Jam(
        mode=number,
        status=JamStatus.where(bounded, status, JamStatus.unbounded),
        omega=omega,
        rotor_speed=rotor_speed,
        stable=slope > 0.0,
        slope=slope,
        displacement=displacement,
        amplitude=magnitude(displacement),
        foundation_force=_bed_force(scene, omega, displacement),
    )


def branch_points(scene: Scene, omega: Array) -> tuple[Jam, Folds]:
    """The jams at load speeds `omega` (any number, ascending), each at the rotor speed it belongs to, and the folds."""
    pieces = _pieces(scene)
    cuts = jnp.where(pieces.folds.exists, pieces.folds.omega, jnp.inf)
    numbers = pieces.mode[jnp.searchsorted(cuts, omega)]

    def jam(number: Array, w: Array) -> Jam:
        flat = jnp.abs(_slope(scene, w)) < jnp.sqrt(jnp.finfo(w.dtype).eps)
        return _jam_at(scene, number, w, jam_rotor_speed(scene, w), flat)

    jams = jax.vmap(jam)(numbers, omega)
    return jams, pieces.folds


def _slope(scene: Scene, omega: Array) -> Array:
    """dn/dOmega along the branch."""
    return jax.jvp(lambda w: jam_rotor_speed(scene, w), (omega,), (jnp.ones_like(omega),))[1]


def _bed_force(scene: Scene, omega: Array, displacement: Array) -> Array:
    carrier = scene.machine.carrier()
    forces = (carrier.bed_stiffness + 1j * omega * carrier.bed_damping) @ displacement
    return magnitude(forces[0]) if forces.shape[0] == 1 else jnp.sqrt(jnp.sum(magnitude(forces) ** 2))


class _Pieces(NamedTuple):
    low: Array
    high: Array
    mode: Array
    resonances: Array
    folds: Folds


def _pieces(scene: Scene) -> _Pieces:
    """The branch cut at its folds into monotone pieces, each with its mode number; empty pieces have low = high."""
    frozen = jax.lax.stop_gradient(scene)
    grid, resonances = fold_points(frozen, _POINTS)
    nd = resonances.shape[0]
    grid, slopes = _with_close_folds(lambda w: _slope(frozen, w), grid, 2 * nd)
    falling = slopes < 0.0
    (change,) = jnp.nonzero(falling[1:] != falling[:-1], size=4 * nd, fill_value=grid.shape[0] - 1)
    found = change < grid.shape[0] - 1
    change = jnp.minimum(change, grid.shape[0] - 2)
    ends = (grid[change], grid[change + 1], (slopes[change], slopes[change + 1]))
    omega = jax.vmap(partial(bracketed_root, lambda w: _slope(scene, w)))(*ends)
    speeds = jax.vmap(lambda w: jam_rotor_speed(scene, w))(omega)
    main = without_ripples(jax.lax.stop_gradient(speeds), jnp.sum(found), 2 * nd)
    omega, speeds, found = omega[main], speeds[main], found[main]
    end = jnp.maximum(grid[-1], 2.0 * frozen.drive.speed)
    folds = Folds(
        omega=jnp.where(found, omega, jnp.nan),
        rotor_speed=jnp.where(found, speeds, jnp.nan),
        exists=found,
    )
    cuts = jax.lax.stop_gradient(jnp.where(found, omega, end))
    low = jnp.concatenate([jnp.zeros_like(cuts[:1]), cuts])
    high = jnp.concatenate([cuts, jnp.reshape(end, (1,))])

    return _Pieces(low, high, piece_modes(cuts, found, resonances), resonances, folds)


def piece_modes(cuts: Array, found: Array, resonances: Array) -> Array:
    """Mode numbers (2 nd + 1,) of the pieces of a branch, which turns at load speeds `cuts` (2 nd,) where they are `found`.

    Each peak belongs to the resonance it is nearest to; two peaks never share one, and the last ones find one too.
    """
    nd = resonances.shape[0]
    owners: list[Array] = []
    later = jnp.sum(found) // 2 - 1
    for k, peak in enumerate(cuts[0::2]):
        nearest = 1 + jnp.argmin(jnp.abs(resonances - peak))
        free = jnp.clip(nd - (later - k), 1, nd)
        owners.append(jnp.minimum(jnp.maximum(nearest, owners[-1] + 1 if owners else 1), free))
    mode = []
    for k, owner in enumerate(owners):
        last = 2 * nd + 1
        mode += [jnp.where(found[2 * k], 2 * owner - 1, last), jnp.where(found[2 * k], 2 * owner, last)]
    return jnp.stack([*mode, jnp.asarray(2 * nd + 1)])


def without_ripples(speeds: Array, count: Array, most: int) -> Array:
    """Indices of the `most` folds that matter, of twice as many with rotor speeds `speeds`, of which the first `count` exist.

    A branch has a peak for each resonance; where it ripples besides, the neighbours that span least are left out.
    """
    index = jnp.arange(2 * most)
    keep = index
    for _ in range(most // 2):
        known = speeds[keep]
        span = jnp.abs(jnp.log(known[1:] / known[:-1]))
        least = jnp.argmin(jnp.where(index[1:] < count, span, jnp.inf))
        skip = (count > most) & (index >= least)
        keep = keep[jnp.where(skip, jnp.minimum(index + 2, 2 * most - 1), index)]
        count = jnp.where(count > most, count - 2, count)
    return keep[:most]


def fold_points(scene: Scene, per_side: int) -> tuple[Array, Array]:
    """Load speeds, `per_side` on each side of every pole, that crowd there as closely as its width asks, and the resonances.

    Folds lie between some of these points. They crowd about the poles s of det(K + s^2 M + s C) = 0, not about undamped
    resonances: a strong damper between two platforms locks them into one, whose sharp peak is at neither's resonance.
    """
    resonances, _ = _modes(scene)
    carrier = scene.machine.carrier()
    damping = carrier.damping
    if carrier.gyroscopic is not None:
        damping = damping + scene.drive.speed * carrier.gyroscopic
    poles = _poles(loaded_mass(scene), damping, carrier.stiffness)
    top = jnp.maximum(jnp.max(resonances), jnp.max(jnp.abs(poles)))
    tiny = jnp.finfo(top.dtype).eps * 16.0
    width = jnp.maximum(jnp.abs(poles.real), tiny * top)[:, None]
    low = 1e-3 * jnp.min(jnp.where(resonances > 0.0, resonances, top))
    s = jnp.linspace(0.0, 1.0, per_side)[None, :]

    def crowded(reach: Array) -> Array:
        return width * jnp.sinh(s * jnp.arcsinh(reach / width))

    # Of a pair of poles one has the points above, the other one those below; a pole that is real has nothing below.
    centre = jnp.abs(poles.imag)[:, None]
    below, above = centre - crowded(jnp.maximum(centre - low, 0.0)), centre + crowded(jnp.full_like(width, 5.0 * top))
    points = jnp.where(poles.imag[:, None] >= 0.0, above, below)
    return jnp.sort(jnp.maximum(points.ravel(), low)), resonances


def _poles(mass: Array, damping: Array, stiffness: Array) -> Array:
    """The 2 nd complex s with det(K + s C + s^2 M) = 0."""
    n = mass.shape[0]
    solved = jnp.linalg.solve(mass, jnp.concatenate([stiffness, damping], axis=1))
    shift = jnp.concatenate([jnp.zeros((n, n), mass.dtype), jnp.eye(n, dtype=mass.dtype)], axis=1)
    return jnp.linalg.eigvals(jnp.concatenate([shift, -solved]))


def _with_close_folds(slope: Callable[[Array], Array], grid: Array, most: int) -> tuple[Array, Array]:
    """The grid and the slope at it, with points added where that comes closest to 0 and turns back: two folds may hide in one
    interval."""
    value = jax.vmap(slope)(grid)
    sign, size = jnp.sign(value), jnp.abs(value)
    same = (sign[1:-1] == sign[:-2]) & (sign[1:-1] == sign[2:])
    dips = same & (size[1:-1] <= size[:-2]) & (size[1:-1] < size[2:])
    (at,) = jnp.nonzero(dips, size=most, fill_value=0)
    step = (jnp.sqrt(jnp.asarray(5.0, grid.dtype)) - 1.0) / 2.0

    def lowest(low: Array, high: Array, side: Array) -> Array:
        def narrow(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
            a, b = bracket
            x, y = b - step * (b - a), a + step * (b - a)
            at_x, at_y = jax.vmap(slope)(jnp.stack([x, y]))
            left = side * at_x < side * at_y
            return jnp.where(left, a, x), jnp.where(left, y, b)

        a, b = jax.lax.fori_loop(0, 16, narrow, (low, high))
        return (a + b) / 2.0

    added = jax.vmap(lowest)(grid[at], grid[at + 2], sign[at + 1])
    order = jnp.argsort(jnp.concatenate([grid, added]))
    return jnp.concatenate([grid, added])[order], jnp.concatenate([value, jax.vmap(slope)(added)])[order]


def _solve_on_piece(scene: Scene, low: Array, high: Array) -> tuple[Array, Array]:
    """The load speed on a monotone piece at which the branch has the scene's rotor speed, and whether there is one."""

    def gap(w: Array) -> Array:
        return jam_rotor_speed(scene, w) - scene.drive.speed

    gap_low, gap_high = jax.vmap(gap)(jnp.stack([jnp.where(low > 0.0, low, high), high]))
    gap_low = jnp.where(low > 0.0, gap_low, -scene.drive.speed)
    exists = (high > low) & (gap_low * gap_high <= 0.0)
    return bracketed_root(gap, low, high, (gap_low, gap_high)), exists
