"""Time integration until the motion repeats itself."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.drive import ConstantSpeed
from jaxvib.machine.scene import Scene
from jaxvib.machine.units import count
from jaxvib.motion.dynamics import State
from jaxvib.motion.run import Run
from jaxvib.motion.simulate import simulate
from jaxvib.motion.start import Start, initial_state
from jaxvib.steady.jam import jam_modes
from jaxvib.steady.response import natural_frequencies

__all__ = ["settle"]

_APART = 0.05
"""How far from their middle the outermost loads start in a jam, rad."""


def settle(
    scene: Scene,
    *,
    start: Start | State = "jam",
    mode: int | None = None,
    drift: float = 1e-6,
    periods: int = 100,
    stretches: int = 200,
    tolerance: float = 1e-9,
    throw: bool = True,
) -> Run:
    """Simulates a stretch after a stretch until amplitudes and speed no longer change.

    **Arguments**: `start`, `mode`, `tolerance` as `simulate`; `drift` the change that counts as none, see `Measured`;
    `periods` of the lowest natural frequency a stretch is long; at most so many `stretches`; `throw` raise if the motion has
    not settled by then, otherwise the last run says so by its `drift`.

    In a jam the loads start up to 0.05 rad apart: a motion that only loads glued together would keep does not pass for settled.

    **Returns** the `Run` of the last stretch, without a trajectory.

    **Raises** `ComputationError` (status "not_settled", or "left_mode" where the loads went to another
    mode than they began in), `InputError` for a drive whose speed changes; as `simulate` besides.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> bool(jv.settle(scene, mode=1).drift < 1e-6)
    True
    """
    if not isinstance(scene.drive, ConstantSpeed):
        raise InputError("drive", f"is {scene.drive.kind!r}; a motion settles under a constant speed only")
    count(periods, "periods")
    frequencies = natural_frequencies(scene)
    slowest = float(jnp.min(jnp.where(frequencies > 0.0, frequencies, scene.drive.speed)))
    state = start if isinstance(start, State) else initial_state(scene, start, mode=mode, angles=_parted(scene, start))
    stretch = 2.0 * math.pi * periods / slowest
    run = simulate(scene, stretch, start=state, save="window", tolerance=tolerance, estimate=False, throw=throw)
    for _ in range(count(stretches, "stretches") - 1):
        if float(run.drift) < drift:
            break
        state = jax.tree.map(lambda leaf: leaf[-1], run.window.state)
        # Only where the loads are within a turn matters; kept small, an angle keeps its digits.
        turns = jnp.floor(state.angle[0] / (2.0 * jnp.pi))
        state = State(state.displacement, state.velocity, (state.angle[0] - 2.0 * jnp.pi * turns,), state.rate)
        run = simulate(scene, stretch, start=state, save="window", tolerance=tolerance, estimate=False, throw=throw)
    if throw and not float(run.drift) < drift:
        raise ComputationError(
            "not_settled",
            f"after {stretches} stretches of {periods} slow periods the motion still changes by {float(run.drift):.1e}; "
            "it may have no steady state here, otherwise allow more stretches",
        )
    if throw and mode is not None:
        _require_mode(scene, run, mode)
    return run


def _parted(scene: Scene, start: Start) -> list[float] | None:
    n = scene.loads.count
    if start != "jam" or n == 1:
        return None
    return [_APART * (2.0 * k / (n - 1) - 1.0) for k in range(n)]


def _require_mode(scene: Scene, run: Run, mode: int) -> None:
    """Whether the loads still turn at the speed of the jam mode they started in, and not at that of another one."""
    modes = jam_modes(scene)
    away = {k: abs(float(modes.select(k).omega) - float(run.omega)) for k in modes.mode_numbers()}
    away[0] = abs(float(scene.drive.speed) - float(run.omega))
    nearest = min(away, key=lambda k: away[k])
    if nearest != mode:
        now = f"jam mode {nearest}" if nearest else "turning with the rotor"
        raise ComputationError(
            "left_mode",
            f"the motion left jam mode {mode} and settled at {float(run.omega):.6g} rad/s, {now}; mode {mode} is unstable",
        )
