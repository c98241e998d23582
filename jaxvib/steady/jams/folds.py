"""Branch n(Omega) of light loads, divided at its folds into monotone pieces."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.averaged import mean_torque
from jaxvib.equations.jammed_bodies import friction_on_light_loads
from jaxvib.equations.linear import ExcitedModel, JammedModel, LinearModel
from jaxvib.equations.torque_balance import UnbalancedModel
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import ContactFriction
from jaxvib.numerics.linalg import small_solve
from jaxvib.numerics.roots import bracketed_root
from jaxvib.results.fields import in_unit
from jaxvib.results.readable import Readable

Excited = TypeVar("Excited", bound=ExcitedModel)

_GRID_POINTS = 64
"""Number of grid points on each side of each pole in the search for folds."""

_MIN_LARGEST_POLE = 1e-3
"""Lower limit, rad/s, of the largest pole, which scales the grid of load speeds. A free body without damping has only the
pole 0."""

_BLOCK_SIZE = 1024
"""Number of load speeds whose sums over the poles fit into the CPU's first cache."""


class Folds(Readable):
    """Points with dn/dOmega = 0, where two jam modes appear or merge.

    **Attributes**, all (2 nd,), with two more entries for each of the `ExcitedModel.extra_peaks`, ascending in `omega`;
    `exists` is False for unused entries, which are at the end

    - `omega`: load speed, rad/s
    - `rotor_speed`, rad/s
    - `exists`: True for a fold
    """

    omega: Array = eqx.field(metadata=in_unit("rad/s", "fold"))
    rotor_speed: Array = eqx.field(metadata=in_unit("rad/s", "fold"))
    exists: Array = eqx.field(metadata=in_unit("", "fold"))


class DragFactorModel(JammedModel):
    """Model of a scene with jammed loads at the rotor's working speed.

    Its branch is not a rotor speed but a factor of the drag as a function of the load speed: the loads jam at this load speed
    if their drag is multiplied by the factor.
    """

    @property
    def highest_speed(self) -> Array:
        """Load speed just below the rotor speed. The factor has no bound where the load speed reaches the rotor speed."""
        return self.scene.drive.speed * (1.0 - float(jnp.finfo(self.mass.dtype).eps) ** 0.5)


def rotor_speed_at(model: ExcitedModel, omega: Array, speed: Array | None = None) -> Array:
    """Return the rotor speed n (rad/s) of a jam of light, coincident loads with load speed `omega` (scalar, rad/s).

        n(w) = w - S w^2 Im(e^H B Y(w)) / (2 sum_j b_Wj R_j^2)

    S is the unbalance of the loads, and Y are the complex amplitudes of the carrier (`JammedModel.displacement`). B^T e is the
    direction of the loads' force on the coordinates (`force_direction`). The formula states that the torque of the drag
    balances the mean torque of the vibration. It is explicit in `omega` and single-valued through the folds. If the rotor speed
    couples the carrier's coordinates, Y is computed at the rotor speed `speed`.

    Dry friction with the coefficient mu2 in a bearing of diameter d adds the torque mu2 (d/2) N sign(n - w) of each load to the
    torque of the drag, with the normal force N = m R w^2. n is then the speed at which all torques balance; it lies between w
    and the value of the formula. The weight of the loads is neglected, because its effect on N averages to zero over a turn
    unless the weight exceeds N. An imbalance of the rotor acts at the frequency n and not at w, and has no effect here.

    For a model with unbalances instead of loads (`UnbalancedModel`) the value returned is not a speed but the torque of the
    vibration divided by that of the motors; for a `DragFactorModel` it is the factor of the drag. Two motions merge at the
    folds of these functions too.

    >>> import jaxvib as jv
    >>> from jaxvib.equations.linear import jammed_model
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> round(float(rotor_speed_at(jammed_model(form.scene()), 1.0015)), 4)
    5.1829

    Source: the antiphase paper, equations (31), (35).
    """
    return _speed_and_amplitudes(model, omega, speed)[0]


def light_rotor_speed(model: JammedModel, omega: Array) -> Array:
    """Return the rotor speed of light loads at a load speed (rad/s), see `rotor_speed_at`. The search for exact jams starts
    from it.

    If the response of the carrier depends on the rotor speed (gyroscopic), n = w + torque(w, n)/drag can have several roots.
    The result is the lowest one on a grid of rotor speeds from w to 1e4 w.
    """
    if model.mount.gyroscopic is None:
        return rotor_speed_at(model, omega)

    def residual(n: Array) -> Array:
        return n - rotor_speed_at(model, omega, n)

    speeds = omega * (1.0 + np.append(0.0, np.logspace(-6.0, 4.0, 120)))
    above = jax.vmap(residual)(speeds) > 0.0
    first = jnp.maximum(jnp.argmax(above), 1)
    return bracketed_root(residual, speeds[first - 1], speeds[first])


def _speed_and_amplitudes(model: ExcitedModel, omega: Array, speed: Array | None = None) -> tuple[Array, Array]:
    """Return the value of `rotor_speed_at` and the amplitudes of the carrier."""
    displacement = model.displacement(omega, speed)
    acceleration = omega**2 * jnp.sum(jnp.conj(model.force_direction) * displacement)
    return _speed_from_acceleration(model, omega, acceleration), displacement


def _speed_from_acceleration(model: ExcitedModel, omega: Array, acceleration: Array) -> Array:
    """Return the value of `rotor_speed_at` at `omega`, from w^2 e^H B Y, m/s^2, see `ExcitedModel.forward_acceleration`."""
    # The drag torque is minus the mean torque of the vibration. The vibration has the acceleration -w^2 Y, so that the mean
    # torque of +w^2 Y is the drag torque.
    torque = mean_torque(model.unbalance, acceleration)
    if isinstance(model, UnbalancedModel):
        return torque / model.motor_torque(omega)
    assert isinstance(model, JammedModel)
    if isinstance(model, DragFactorModel):
        return torque / (model.drag * (model.scene.drive.speed - omega))
    free = omega + torque / model.drag
    effects = model.scene.all_effects
    if not has_term(effects, ContactFriction):
        return free

    def friction(n: Array) -> Array:
        return jnp.sum(friction_on_light_loads(model.loads, effects, omega, n))

    # The root is between omega and `free` if the friction brakes the slip n - omega. The wider bracket also contains the root
    # for any torque that does not fall as n rises, such as a constant one.
    margin = 2.0 * jnp.abs(friction(free)) / model.drag
    low, high = jnp.minimum(omega, free - margin), jnp.maximum(omega, free + margin)
    return bracketed_root(lambda n: model.drag * (n - omega) + friction(n) - torque, low, high)


def scanned_speed(model: ExcitedModel, omega: Array) -> Array:
    """Return `rotor_speed_at` in modal form, for a search: O(nd) operations, without derivatives with respect to parameters."""
    return _speed_from_acceleration(model, omega, model.forward_acceleration(omega))


def branch_tangent(model: ExcitedModel, omega: Array) -> tuple[Array, Array, Array]:
    """Return the rotor speed at a load speed, dn/dOmega along the branch, and the amplitudes (nd,) of the carrier."""
    return jax.jvp(lambda w: _speed_and_amplitudes(model, w), (omega,), (jnp.ones_like(omega),), has_aux=True)


def branch_slope(model: ExcitedModel, omega: Array) -> Array:
    """Return the slope dn/dOmega of the branch."""
    return branch_tangent(model, omega)[1]


def scanned_slope(model: ExcitedModel, omega: Array) -> Array:
    """Return the slope dn/dOmega of `scanned_speed`."""
    return jax.jvp(partial(scanned_speed, model), (omega,), (jnp.ones_like(omega),))[1]


def scanned_slopes(model: ExcitedModel, omegas: Array) -> Array:
    """Return the slope dn/dOmega of `scanned_speed` at many load speeds, in blocks if there are many."""
    each = partial(scanned_slope, model)
    return jax.vmap(each)(omegas) if omegas.shape[0] <= _BLOCK_SIZE else jax.lax.map(each, omegas, batch_size=_BLOCK_SIZE)


@eqx.filter_custom_jvp
def _fold_speed(model: ExcitedModel, omega: Array) -> Array:
    """Return `rotor_speed_at` in modal form, or from the full matrices if the modal form is inaccurate.

    The derivatives are those of `rotor_speed_at` from the full matrices, and are computed only if they are needed.
    """
    assert model.modal is not None
    return jax.lax.cond(model.modal.is_rough, rotor_speed_at, scanned_speed, model, omega)


@_fold_speed.def_jvp
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return eqx.filter_jvp(rotor_speed_at, primals, tangents)


def branch_root(
    model: Excited,
    exact: Callable[[Excited, Array], Array],
    scanned: Callable[[Excited, Array], Array],
    low: Array,
    high: Array,
    ends: tuple[Array, Array],
) -> Array:
    """Return the load speed between `low` and `high` at which a function of the branch is 0, with exact derivatives.

    `exact` computes the function from the matrices, `scanned` in modal form; `ends` are its values at `low` and `high`.
    """
    f = partial(exact, model)
    if model.modal is None:
        return bracketed_root(f, low, high, ends)
    frozen = jax.lax.stop_gradient(model)
    return bracketed_root(f, low, high, ends, fast=partial(scanned, frozen), polish=model.modal.is_rough)


class Pieces(NamedTuple):
    """Monotone pieces of a branch between its folds.

    **Attributes**: those of the pieces have 2 nd + 1 entries, and two more for each of the `ExcitedModel.extra_peaks`

    - `low` and `high`: load speeds at the ends of each piece, rad/s
    - `speed_low` and `speed_high`: rotor speeds at these ends, rad/s
    - `mode`: number of the jam mode of each piece
    - `resonances` (nd,), rad/s
    - `folds` between the pieces
    """

    low: Array
    high: Array
    speed_low: Array
    speed_high: Array
    mode: Array
    resonances: Array
    folds: Folds


def branch_pieces(model: ExcitedModel) -> Pieces:
    """Divide the branch at its folds into monotone pieces with mode numbers; empty pieces have low = high."""
    frozen = jax.lax.stop_gradient(model)
    grid, resonances = grid_near_poles(model, _GRID_POINTS)
    highest = frozen.highest_speed
    grid = grid if highest is None else jnp.minimum(grid, highest)
    fold_count = 2 * (resonances.shape[0] + model.extra_peaks)
    grid, slopes = _with_close_folds(partial(scanned_slopes, frozen), grid, fold_count)
    falling = slopes < 0.0
    change = _first_true_indices(falling[1:] != falling[:-1], 2 * fold_count, grid.shape[0] - 1)
    exists = change < grid.shape[0] - 1
    change = jnp.minimum(change, grid.shape[0] - 2)
    ends = (grid[change], grid[change + 1], (slopes[change], slopes[change + 1]))
    omega = jax.vmap(partial(branch_root, model, branch_slope, scanned_slope))(*ends)
    end = jnp.maximum(grid[-1:], 2.0 * frozen.scene.drive.speed) if highest is None else highest[None]
    speed = partial(rotor_speed_at, model) if model.modal is None else partial(scanned_speed, frozen)
    speeds = jax.vmap(speed)(jnp.concatenate([omega, end]))
    speeds, speed_end = speeds[:-1], jax.lax.stop_gradient(speeds[-1:])
    main = without_ripples(jax.lax.stop_gradient(speeds), jnp.sum(exists), fold_count)
    omega, speeds, exists = omega[main], speeds[main], exists[main]
    if model.modal is not None:  # again, with derivatives with respect to parameters
        speeds = jax.vmap(partial(_fold_speed, model))(omega)
    folds = Folds(omega=jnp.where(exists, omega, jnp.nan), rotor_speed=jnp.where(exists, speeds, jnp.nan), exists=exists)
    cuts, turns = jax.lax.stop_gradient((jnp.where(exists, omega, end), jnp.where(exists, speeds, speed_end)))
    zero, mode = jnp.zeros_like(end), piece_modes(cuts, exists, resonances)
    low, high = jnp.concatenate([zero, cuts]), jnp.concatenate([cuts, end])
    return Pieces(low, high, jnp.concatenate([zero, turns]), jnp.concatenate([turns, speed_end]), mode, resonances, folds)


def piece_modes(cuts: Array, exists: Array, resonances: Array) -> Array:
    """Return mode numbers (2 nd + 1,) of the pieces of a branch; its folds are the load speeds `cuts` (2 nd,) with `exists`
    True.

    Each peak belongs to the nearest resonance, but no two peaks share a resonance, and every peak has one.
    """
    nd = resonances.shape[0]
    peak = np.arange(cuts.shape[0] // 2)
    nearest = 1 + jnp.argmin(jnp.abs(resonances[None, :] - cuts[0::2, None]), axis=1)
    # Numbers of resonances rise by at least 1 from peak to peak, and leave at least one for each later peak.
    owner = peak + jnp.minimum(jax.lax.cummax(nearest - peak), nd + 1 - jnp.sum(exists[1::2]))
    owner = jnp.minimum(owner, nd)
    last = 2 * nd + 1
    rising, falling = (jnp.where(exists[0::2], mode, last) for mode in (2 * owner - 1, 2 * owner))
    return jnp.append(jnp.stack([rising, falling], axis=1).ravel(), last)


def sampled_modes(omega: np.ndarray, speeds: np.ndarray, resonances: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pieces of a branch n(Omega) with the samples `omega` and `speeds` (P,).

    **Returns** the indices of the samples at all folds; the indices of the samples at the folds between pieces, ascending, with
    P for folds that do not exist; and the mode number of each piece.
    """
    nd, rising = resonances.shape[0], np.diff(speeds) > 0.0
    folds = 1 + np.flatnonzero(rising[1:] != rising[:-1])[: 4 * nd]
    if not rising[0]:  # the samples begin after the first peak
        folds = np.append(0, folds)[: 4 * nd]
    padded = np.pad(folds, (0, 4 * nd - folds.size))
    main = np.asarray(without_ripples(jnp.asarray(speeds[padded]), jnp.asarray(folds.size), 2 * nd))
    exists = main < folds.size
    cuts = np.where(exists, omega[padded[main]], np.inf)
    modes = np.asarray(piece_modes(jnp.asarray(cuts), jnp.asarray(exists), jnp.asarray(resonances)))
    return folds, np.where(exists, padded[main], omega.size), modes


def without_ripples(speeds: Array, count: Array, count_left: int) -> Array:
    """Return the indices of the `count_left` most relevant folds.

    `speeds` (2 `count_left`,) are rotor speeds of folds, of which the first `count` exist.

    A branch has one peak for each resonance. If it has additional ripples, the pairs of neighbouring folds whose rotor speeds
    have the ratio closest to 1 are dropped.
    """
    index = jnp.arange(2 * count_left)

    def without_smallest(_: int, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        keep, count = carry
        values = speeds[keep]
        span = jnp.abs(jnp.log(values[1:] / values[:-1]))
        least = jnp.argmin(jnp.where(index[1:] < count, span, jnp.inf))
        skip = (count > count_left) & (index >= least)
        keep = keep[jnp.where(skip, jnp.minimum(index + 2, 2 * count_left - 1), index)]
        return keep, jnp.where(count > count_left, count - 2, count)

    return jax.lax.fori_loop(0, count_left // 2, without_smallest, (index, count))[0][:count_left]


def grid_near_poles(model: LinearModel, per_side: int, highest: Array | None = None) -> tuple[Array, Array]:
    """Return a grid of load speeds for the search for folds, and the resonances; only the resonances have derivatives.

    The grid has `per_side` points on each side of each pole s of det(K + s^2 M + s C) = 0, with a density that follows the
    width of its peak. It reaches five times the largest |s|, and at least the speed `highest`. A grid that is dense only near
    the undamped resonances would miss peaks: a strong damper between two platforms locks them into one body, whose sharp peak
    is at none of the undamped resonances.
    """
    resonances, _ = model.modes()
    fixed = jax.lax.stop_gradient(resonances)
    poles = _poles(*jax.lax.stop_gradient(model.peak_matrices())) if model.modal is None else model.modal.poles
    top = jnp.maximum(jnp.max(fixed), jnp.max(jnp.abs(poles), initial=_MIN_LARGEST_POLE))
    beyond = 5.0 * top if highest is None else jnp.maximum(5.0 * top, highest)
    tiny = jnp.finfo(top.dtype).eps * 16.0
    width = jnp.maximum(jnp.abs(poles.real), tiny * top)[:, None]
    low = 1e-3 * jnp.min(jnp.where(fixed > 0.0, fixed, top))
    s = np.linspace(0.0, 1.0, per_side, dtype=width.dtype)[None, :]

    def distances(reach: Array) -> Array:
        return width * jnp.sinh(s * jnp.arcsinh(reach / width))

    # One pole of a conjugate pair gets the points above, the other the points below; a real pole has no points below.
    centre = jnp.abs(poles.imag)[:, None]
    below, above = centre - distances(jnp.maximum(centre - low, 0.0)), centre + distances(jnp.full_like(width, beyond))
    points = jnp.where(poles.imag[:, None] >= 0.0, above, below)
    return jnp.sort(jnp.maximum(points.ravel(), low)), resonances


def resampled_grid(grid: Array, points: int, top: Array) -> Array:
    """Return `points` ascending load speeds up to `top`, with the density of `grid`.

    They are equally spaced in the index of this grid. Points that would lie above `top` are replaced by evenly spaced ones
    below it.
    """
    inside = jnp.interp(jnp.linspace(0.0, 1.0, points), jnp.linspace(0.0, 1.0, grid.shape[0]), grid)
    share = jnp.linspace(0.0, 1.0, points)
    return jnp.sort(jnp.where(inside < top, inside, top * (0.001 + 0.999 * share)))


def _poles(mass: Array, damping: Array, stiffness: Array) -> Array:
    """Return the poles: the 2 nd complex s with det(K + s C + s^2 M) = 0; of complex matrices also their conjugates."""
    n = mass.shape[0]
    solved = small_solve(mass, jnp.concatenate([stiffness, damping], axis=1).astype(mass.dtype))
    shift = jnp.concatenate([jnp.zeros((n, n), mass.dtype), jnp.eye(n, dtype=mass.dtype)], axis=1)
    poles = jnp.linalg.eigvals(jnp.concatenate([shift, -solved]))
    return jnp.concatenate([poles, poles.conj()]) if jnp.iscomplexobj(mass) else poles


def _first_true_indices(mask: Array, size: int, fill: int) -> Array:
    """Return the first `size` indices at which `mask` (n,) is True, ascending, padded with `fill`."""
    return jnp.sort(jnp.where(mask, jnp.arange(mask.shape[0]), fill))[:size]


def _with_close_folds(slopes: Callable[[Array], Array], grid: Array, added_count: int) -> tuple[Array, Array]:
    """Return a grid with `added_count` additional points at minima of |slope|, and `slopes` on this grid.

    The points are added because one interval of the grid can contain two folds.
    """
    value = slopes(grid)
    sign, size = jnp.sign(value), jnp.abs(value)
    same = (sign[1:-1] == sign[:-2]) & (sign[1:-1] == sign[2:])
    dips = same & (size[1:-1] <= size[:-2]) & (size[1:-1] < size[2:])
    at = _first_true_indices(dips, added_count, dips.shape[0] - 1)
    step = (jnp.sqrt(jnp.asarray(5.0, grid.dtype)) - 1.0) / 2.0

    side, lowest = jnp.sign(value[at + 1]), jnp.abs(value[at + 1])

    def narrow(_: int, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        a, b, best, least = carry
        x, y = b - step * (b - a), a + step * (b - a)
        at_x, at_y = jnp.split(slopes(jnp.concatenate([x, y])), 2)
        left = side * at_x < side * at_y
        lower, where = side * jnp.where(left, at_x, at_y), jnp.where(left, x, y)
        best, least = jnp.where(lower < least, where, best), jnp.where(lower < least, lower, least)
        return jnp.where(left, a, x), jnp.where(left, y, b), best, least

    added, least = jax.lax.fori_loop(0, 16, narrow, (grid[at], grid[at + 2], grid[at + 1], lowest))[2:]
    # Both lists of points are ascending. Merging them takes a tenth of the time of sorting all points.
    places = at + 1 + (added > grid[at + 1]) + np.arange(added_count)
    is_added = jnp.zeros(grid.shape[0] + added_count, bool).at[places].set(True)
    before = jnp.cumsum(is_added)
    order = jnp.where(is_added, grid.shape[0] + before - 1, np.arange(is_added.shape[0]) - before)
    return jnp.concatenate([grid, added])[order], jnp.concatenate([value, side * least])[order]
