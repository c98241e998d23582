"""Working regime of a machine: the stable synchronous regime at the speed of its motors, from a fixed list of starts."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.equations.averaged import decays, require_rotating_masses
from jaxvib.equations.torque_balance import (
    TorqueBalance,
    assemble_torque_balance,
    influence_of,
    motion_of,
    unknowns_of,
)
from jaxvib.errors import InputError, within
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import validate_scene
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.newton import solve_torques
from jaxvib.steady.outcome import outcome, without_numbers
from jaxvib.steady.regimes.local import Slopes, regime_growth, slopes_of
from jaxvib.steady.regimes.search import is_balanced, relax, sets_of_phases
from jaxvib.steady.regimes.synchronous import RegimeStatus, SynchronousRegime, fields_at, require_one_speed

_SETS_PER_SQUARED_UNKNOWN = 4
"""The number of random sets of phases is this factor times the square of the number of unknown phases. It is small, because a
search for a design evaluates thousands of machines."""

_SPEEDS, _LOWEST_SPEED, _HIGHEST_SPEED = 64, 0.3, 1.01
"""Number and range of the speeds, relative to that of the fastest drive, among which the speed of a start is searched for."""

_ITERATIONS = 20
"""Maximum number of steps of Newton's method from a start."""

_SAME_SPEED = 0.05
"""Relative difference from the fastest regime up to which a regime counts as one at working speed."""


@validated
def working_regime(scene: Scene, *, throw: bool = True) -> SynchronousRegime:
    """Return the regime in which the motors of a machine work: the stable synchronous regime at their speeds.

    Newton's method starts from a fixed list of sets of phases, each at the largest speed at which the sum of all torques is 0.
    Of the regimes whose speeds are within 5 % of that of the fastest regime, the stable one with the least value of Blekhman's
    function Lambda is returned:

        Lambda = -(Omega^4/4) sum_ik S_i S_k Re(exp(i (alpha_k - alpha_i)) H_ik)

    with the symbols of `synchronous_regimes`. Without damping this regime is the deepest minimum of Lambda, which the exciters
    reach from most initial states. (A minimum can be unstable if the rotors are light; such a regime is not returned.) If none
    of these regimes is stable, groups of slower regimes follow, each 5 % wide.

    The search takes 1/50 to 1/5 of the time of `synchronous_regimes`, and works under `jit`, `vmap` and `grad`. Derivatives are
    those of the implicit function theorem. With more than 6 exciters, each start is first moved toward a stable regime, as in
    `synchronous_regimes`.

    **Arguments**

    - `scene` as for `synchronous_regimes`, whose exciters have unbalances and no loads; typical: 1 to 32 exciters
    - `throw`: True to raise an error if no start leads to a stable regime; with False, and under a JAX transformation, only the
      status shows it

    **Returns** `SynchronousRegime`; with the status `none_stable` its numbers are NaN.

    **Raises** `InputError` for exciters with loads, ideal drives of different speeds, and effects that this theory does not
    include; `ComputationError` with the status "none_stable".

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> springs = [jv.support(at=(x, 0.0), stiffness=(3e3, 3e3), damping=(150.0, 150.0)) for x in (-0.6, 0.6)]
    >>> screen = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    >>> motor = jv.InductionMotor(100.0, breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.05)
    >>> exciters = [jv.Exciter(drive=motor, unbalance=0.4, at=(x, 0.0), direction=s) for x, s in ((-0.6, 1), (0.6, -1))]
    >>> regime = jv.working_regime(jv.Scene(screen, exciters=exciters))
    >>> bool(regime.stable), round(abs(float(regime.phases[1])), 4)    # half a turn apart: the body moves along a vertical line
    (True, 3.1416)

    Source: I. I. Blekhman, Synchronization in Science and Technology, 1988, for the function; this package for the choice.
    """
    scene = validate_scene(scene)
    require_rotating_masses(scene)
    for k, exciter in enumerate(scene.exciters):
        if exciter.loads is not None:
            with within(scene.prefix_of(k)):
                raise InputError("loads", "are given; a working regime needs unbalances alone; use jam_modes for loads")
    require_one_speed(scene)
    return outcome(_working(scene), scene, throw=throw, failures=("none_stable",))


@cached
def _working(scene: Scene) -> SynchronousRegime:
    balance = assemble_torque_balance(scene)
    fields = fields_at(balance, *_stable_solution(jax.lax.stop_gradient(balance)))
    stable = fields["stable"]
    status = RegimeStatus.where(stable, fields["status"], RegimeStatus.none_stable)
    fields = {**without_numbers(stable, fields), "status": status, "can_start": fields["can_start"]}
    return SynchronousRegime(**fields, scene=scene)


def _stable_solution(balance: TorqueBalance) -> tuple[Array, Slopes | None, Array | None]:
    """Return the unknowns, the slopes and the growth of the stable regime; of any regime if none is stable."""
    if balance.is_prescribed.all():
        return jnp.zeros(0, balance.unbalance.dtype), None, None
    sets = sets_of_phases(balance.is_prescribed, balance.unbalance.dtype, _SETS_PER_SQUARED_UNKNOWN)
    sets = sets[np.unique(np.mod(sets, 2.0 * np.pi).round(6), axis=0, return_index=True)[1]]

    def solve(omega: Array, phase: Array) -> tuple[Array, Array, Array]:
        """Return the unknowns, the speed (0 without a solution) and Blekhman's function."""
        start = relax(unknowns_of(balance, omega, phase), balance)
        x = solve_torques(start, balance, _ITERATIONS)
        w, angles = motion_of(balance, x)
        return x, jnp.where(is_balanced(balance, x), w, 0.0), _potential(balance, w, angles)

    solutions, omega, potential = jax.vmap(solve)(_fastest_starts(balance, sets), jnp.asarray(sets))
    speed_band = jnp.floor((1.0 - omega / jnp.max(omega, initial=jnp.finfo(omega.dtype).tiny)) / _SAME_SPEED)
    order = jnp.lexsort((potential, speed_band))

    def growth_of(k: Array) -> tuple[Array, Slopes, Array]:
        x = solutions[order[k]]
        slopes = slopes_of(x, balance)
        w, angles = motion_of(balance, x)
        speed = jnp.where(omega[order[k]] > 0.0, w, jnp.nan)
        return k, slopes, regime_growth(balance, speed, angles, slopes.neutral)

    def undecided(state: tuple[Array, Slopes, Array]) -> Array:
        k, _, growth = state
        return ~decays(growth, omega[order[k]]) & (k < len(sets) - 1)

    # The loop has one body, which is compiled once; its first iteration judges the first regime.
    begin = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(growth_of, jnp.asarray(0)))
    begin = (jnp.asarray(-1), begin[1], jnp.asarray(jnp.nan, omega.dtype))
    which, slopes, growth = jax.lax.while_loop(undecided, lambda state: growth_of(state[0] + 1), begin)
    return solutions[order[which]], slopes, growth


def _fastest_starts(balance: TorqueBalance, sets: np.ndarray) -> Array:
    """Return for each set of phases (n, count) the largest speed (n,) at which the sum of all torques falls through 0."""
    if balance.is_prescribed.any():
        return jnp.full(len(sets), balance.speed)
    speeds = balance.speed * np.linspace(_LOWEST_SPEED, _HIGHEST_SPEED, _SPEEDS)
    influence, torque = jax.vmap(lambda w: (influence_of(balance, w), balance.driving_torque(w)))(speeds)
    unbalances = balance.unbalance[None] * np.exp(1j * sets)
    vibration = jnp.einsum("ai,gik,ak->ag", unbalances.conj(), influence, unbalances).imag * (speeds**4 / 2.0)[None]
    total = jnp.sum(torque, axis=1)[None] + vibration
    falls = (total[:, :-1] > 0.0) & (total[:, 1:] <= 0.0)
    last = jnp.max(jnp.where(falls, jnp.arange(_SPEEDS - 1)[None], 0), axis=1)
    low, high = (jnp.take_along_axis(total, (last + k)[:, None], axis=1)[:, 0] for k in (0, 1))
    share = low / jnp.where(low > high, low - high, 1.0)
    found = speeds[last] + jnp.clip(share, 0.0, 1.0) * (speeds[last + 1] - speeds[last])
    return jnp.where(jnp.any(falls, axis=1), found, balance.speed)


def _potential(balance: TorqueBalance, omega: Array, phase: Array) -> Array:
    """Return Blekhman's function Lambda, N m; infinite if it is not a number."""
    unbalances = balance.unbalance * jnp.exp(1j * phase)
    value = -(omega**4) / 4.0 * (unbalances.conj() @ influence_of(balance, omega) @ unbalances).real
    return jnp.nan_to_num(value, nan=jnp.inf)
