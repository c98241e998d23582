"""Leading-order jam modes: where light loads get stuck, by algebra alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.scene import Scene
from jaxvib.steady.response import _modes, circular_loads, magnitude, natural_frequencies, steady_displacement, turning

__all__ = ["Folds", "Jam", "JamModes", "JamStatus", "jam_modes", "jam_rotor_speed"]

_POINTS = 64
"""Grid points on each side of each resonance, where folds are looked for."""


class JamStatus(eqx.Enumeration):
    """What is known of a jam mode; the members are the sentences a user reads."""

    found = "the loads can jam in this mode"
    absent = "this mode does not exist at this rotor speed"
    at_fold = "the rotor speed is that of a fold: the mode merges with its neighbour and has no gradient"


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


class JamModes(Jam):
    """All jam modes at one rotor speed: the arrays of `Jam` with a leading axis over the modes 1 .. 2 nd + 1.

    A mode that does not exist holds NaN and the status `absent`. Adds `resonances` (nd,) rad/s and the `folds` of the branch.
    """

    resonances: Array
    folds: Folds

    @property
    def exists(self) -> Array:
        """Which modes there are, one Boolean a mode."""
        return self.status != JamStatus.absent

    def mode_numbers(self) -> list[int]:
        """The numbers of the modes that exist."""
        return [int(k) for k, there in zip(self.mode, self.exists, strict=True) if there]

    def select(self, mode: int, *, throw: bool = True) -> Jam:
        """The jam mode of that number.

        **Raises** `InputError` for a number there can never be, `ComputationError` (status "absent") where it does not exist
        at this rotor speed; with `throw=False`, and under a JAX transformation, the status says so.
        """
        most = self.mode.shape[0]
        if not isinstance(mode, (int, np.integer)) or not 1 <= mode <= most:
            raise InputError("mode", f"is {mode!r}; this machine's jam modes are numbered 1 to {most}")
        fields = {name: getattr(self, name) for name in Jam.__dataclass_fields__}
        jam = Jam(**jax.tree.map(lambda leaf: leaf[mode - 1], fields))
        if throw and not isinstance(self.omega, jax.core.Tracer) and not bool(self.exists[mode - 1]):
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


def jam_rotor_speed(scene: Scene, omega: Array) -> Array:
    """The rotor's speed n (rad/s) at which the loads jam, collected, at speed `omega` (scalar, rad/s), for light loads.

        n(w) = w - S w^2 Im(e^H B Y(w)) / (2 sum_j b_Wj R_j^2)

    with Y from `steady_displacement`: the drag's torque balances the mean torque of the vibration. It is explicit in
    `omega`, and single-valued through the folds.

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> round(float(jv.jam_rotor_speed(form.scene(), 1.0015)), 4)
    5.1829

    Source: the antiphase paper, equations (31), (35).
    """
    loads = circular_loads(scene)
    carrier = scene.machine.carrier()
    port = carrier.port @ steady_displacement(scene, omega)
    torque = -loads.unbalance() * omega**2 * jnp.sum(jnp.conj(turning(carrier)) * port).imag / 2.0
    return omega + torque / loads.drag_sum()


def jam_modes(scene: Scene) -> JamModes:
    """Every way in which light, collected loads can jam at the scene's rotor speed.

    The branch n(Omega) of `jam_rotor_speed` is cut at its folds dn/dOmega = 0 into monotone pieces; each piece that reaches
    the rotor speed holds one mode. Numbers follow the resonances: 2r - 1 rises toward the peak of resonance r, 2r falls
    from it, 2 nd + 1 is beyond the last; so mode 3 is the jam just below the second resonance even where the first one is
    damped so much that modes 1 and 2 have vanished. Rising pieces (odd modes) are stable by slope, falling ones are not.

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
    drag = circular_loads(scene).drag_sum()
    if not isinstance(drag, jax.core.Tracer) and not float(drag) > 0.0:
        raise InputError("loads.drag", "is 0; loads without drag never follow the rotor, give a drag greater than 0")
    return _jam_modes(scene)


@eqx.filter_jit
def _jam_modes(scene: Scene) -> JamModes:
    n = scene.drive.speed
    pieces = _pieces(scene)
    omega, exists = jax.vmap(lambda lo, hi: _solve_on_piece(scene, lo, hi))(pieces.low, pieces.high)

    nd = pieces.resonances.shape[0]
    numbers = jnp.arange(1, 2 * nd + 2)
    hits = (pieces.mode[None, :] == numbers[:, None]) & exists[None, :]
    chosen = jnp.argmax(hits, axis=1)
    there = jnp.any(hits, axis=1)
    omega = jnp.where(there, omega[chosen], n)

    def jam(number: Array, w: Array, is_there: Array) -> Jam:
        displacement = steady_displacement(scene, w)
        slope = jax.jvp(lambda x: jam_rotor_speed(scene, x), (w,), (jnp.ones_like(w),))[1]
        flat = jnp.abs(slope) < jnp.sqrt(jnp.finfo(slope.dtype).eps)
        known = JamStatus.where(flat, JamStatus.at_fold, JamStatus.found)

        def or_nan(value: Array) -> Array:
            return jnp.where(is_there, value, jnp.nan)

        return Jam(
            mode=number,
            status=JamStatus.where(is_there, known, JamStatus.absent),
            omega=or_nan(w),
            rotor_speed=n,
            stable=is_there & (slope > 0.0),
            slope=or_nan(slope),
            displacement=or_nan(displacement),
            amplitude=or_nan(magnitude(displacement)),
            foundation_force=or_nan(_bed_force(scene, w, displacement)),
        )

    jams = jax.vmap(jam)(numbers, omega, there)
    fields = {name: getattr(jams, name) for name in Jam.__dataclass_fields__}
    return JamModes(**fields, resonances=natural_frequencies(scene), folds=pieces.folds)


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
    grid, resonances = _fold_grid(frozen)
    nd = resonances.shape[0]

    def slope(s: Scene, w: Array) -> Array:
        return jax.jvp(lambda x: jam_rotor_speed(s, x), (w,), (jnp.ones_like(w),))[1]

    falling = jax.vmap(lambda w: slope(frozen, w))(grid) < 0.0
    (change,) = jnp.nonzero(falling[1:] != falling[:-1], size=2 * nd, fill_value=grid.shape[0] - 1)
    found = change < grid.shape[0] - 1
    change = jnp.minimum(change, grid.shape[0] - 2)
    omega = jax.vmap(lambda lo, hi: bracketed_root(lambda w: slope(scene, w), lo, hi))(grid[change], grid[change + 1])
    end = jnp.maximum(grid[-1], 2.0 * frozen.drive.speed)
    folds = Folds(
        omega=jnp.where(found, omega, jnp.nan),
        rotor_speed=jnp.where(found, jax.vmap(lambda w: jam_rotor_speed(scene, w))(omega), jnp.nan),
        exists=found,
    )
    cuts = jax.lax.stop_gradient(jnp.where(found, omega, end))
    low = jnp.concatenate([jnp.zeros_like(cuts[:1]), cuts])
    high = jnp.concatenate([cuts, jnp.reshape(end, (1,))])

    # Each peak belongs to the resonance it is nearest to; two peaks never share one.
    owners: list[Array] = []
    for k, peak in enumerate(cuts[0::2]):
        nearest = 1 + jnp.argmin(jnp.abs(resonances - peak))
        owners.append(jnp.clip(jnp.maximum(nearest, owners[-1] + 1 if owners else 1), k + 1, nd))
    mode = []
    for k, owner in enumerate(owners):
        last = 2 * nd + 1
        mode += [jnp.where(found[2 * k], 2 * owner - 1, last), jnp.where(found[2 * k], 2 * owner, last)]
    return _Pieces(low, high, jnp.stack([*mode, jnp.asarray(2 * nd + 1)]), resonances, folds)


def _fold_grid(scene: Scene) -> tuple[Array, Array]:
    """Load speeds that crowd about every resonance as closely as its width asks; folds lie between some of them."""
    resonances, shapes = _modes(scene)
    carrier = scene.machine.carrier()
    width = jnp.einsum("ar,ab,br->r", shapes, carrier.damping, shapes) / 2.0
    top = jnp.max(resonances)
    tiny = jnp.finfo(top.dtype).eps * 16.0
    width = jnp.maximum(width, tiny * top)
    reach = 5.0 * top
    s = jnp.linspace(0.0, 1.0, _POINTS)[None, :]
    offset = width[:, None] * jnp.sinh(s * jnp.arcsinh(reach / width)[:, None])
    grid = jnp.concatenate([resonances[:, None] - offset, resonances[:, None] + offset]).ravel()
    low = 1e-3 * jnp.min(jnp.where(resonances > 0.0, resonances, top))
    return jnp.sort(jnp.clip(grid, low, top + reach)), resonances


def _solve_on_piece(scene: Scene, low: Array, high: Array) -> tuple[Array, Array]:
    """The load speed on a monotone piece at which the branch has the scene's rotor speed, and whether there is one."""

    def gap(w: Array) -> Array:
        return jam_rotor_speed(scene, w) - scene.drive.speed

    gap_low = jnp.where(low > 0.0, gap(jnp.where(low > 0.0, low, high)), -scene.drive.speed)
    exists = (high > low) & (gap_low * gap(high) <= 0.0)
    return bracketed_root(gap, low, high), exists


def bracketed_root(f: Callable[[Array], Array], low: Array, high: Array, *, halvings: int | None = None) -> Array:
    """The root of `f` between `low` and `high` (scalars), where f changes sign once.

    Halvings, then Newton steps that stay inside the bracket. `halvings` may be few where f is smooth all over the bracket;
    left out, they alone leave 3/4 of the digits right. Derivatives by the implicit function theorem.
    """

    def solve(g: Callable[[Array], Array], _: Array) -> Array:
        rises = g(high) > 0.0

        def step(_: int, bracket: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            a, b, x = bracket
            value, slope = jax.jvp(g, (x,), (jnp.ones_like(x),))
            above = (value > 0.0) == rises
            a, b = jnp.where(above, a, x), jnp.where(above, x, b)
            newton = x - value / jnp.where(slope == 0.0, 1.0, slope)
            good = (slope != 0.0) & (newton >= a) & (newton <= b)
            return a, b, jnp.where(good, newton, (a + b) / 2.0)

        # A Newton step can crawl along one side of the bracket; halving first makes sure that it does not.
        first = 3 * jnp.finfo(low.dtype).nmant // 4 if halvings is None else halvings

        def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
            a, b = bracket
            middle = (a + b) / 2.0
            above = (g(middle) > 0.0) == rises
            return jnp.where(above, a, middle), jnp.where(above, middle, b)

        a, b = jax.lax.fori_loop(0, first, halve, (low, high))
        return jax.lax.fori_loop(0, 6, step, (a, b, (a + b) / 2.0))[2]

    low, high = jax.lax.stop_gradient((low, high))
    return jax.lax.custom_root(f, low, solve, lambda g, y: y / _nonzero(g(jnp.ones_like(y))))


def _nonzero(slope: Array) -> Array:
    """At a fold the slope is 0 and there is no derivative; the status says so, and nothing overflows."""
    tiny = jnp.finfo(slope.dtype).tiny ** 0.5
    return jnp.where(jnp.abs(slope) < tiny, tiny, slope)
