"""Random machines with two exciters whose regimes the quasi-static criterion calls stable although they grow, or the reverse.

Each machine is a lightly damped body on two springs with two equal weak motors. The criterion is compared with the growth rate
of the averaged equations.

    python benchmarks/exciters/quasi_static.py 4000
"""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
from jaxvib.equations.torque_balance import assemble_torque_balance
from jaxvib.steady.regimes.local import quasi_static_growth, regime_growth
from jaxvib.steady.regimes.search import solve_near

BATCH = 250
"""Number of machines in one program."""

LOW = np.array([0.3, 0.3, 1e-3, 2.0, 0.1, 0.02, -0.6, -0.4, -0.4])
HIGH = np.array([1.1, 1.1, 2e-2, 60.0, 0.6, 0.20, 0.6, 0.4, 0.4])
"""Ranges of: stiffness across and up relative to M Omega^2, damping ratio, stall torque, unbalance, inertia, places."""


def machine(x: jax.Array, direction: int) -> jv.Scene:
    across, up, ratio, stall, unbalance, inertia, x2, y1, y2 = x
    stiffness = 300.0 * 1e4 * jnp.stack([across, up]) / 2.0
    damping = 2.0 * ratio * jnp.sqrt(stiffness * 150.0)
    springs = [jv.support(at=(side, 0.0), stiffness=tuple(stiffness), damping=tuple(damping)) for side in (-0.6, 0.6)]
    motor = jv.DCMotor(100.0, stall_torque=stall, inertia=inertia)
    exciters = [
        jv.Exciter(drive=motor, unbalance=unbalance, at=jnp.stack([-0.5 + 0.0 * x2, y1])),
        jv.Exciter(drive=motor, unbalance=unbalance, at=jnp.stack([x2, y2]), direction=direction),
    ]
    return jv.Scene(jv.plane_body(mass=300.0, inertia=75.0, supports=springs), exciters=exciters)


def growths(x: jax.Array, phase: jax.Array, direction: int) -> list[jax.Array]:
    """Return the growth rate, the quasi-static one, speed and phase of the regime near a phase; NaN if there is none."""
    balance = assemble_torque_balance(machine(x, direction))
    speed, phases, neutral, good = solve_near(jnp.asarray(99.0), jnp.stack([0.0 * phase, phase]), balance)
    growth = regime_growth(balance, speed, phases, neutral)
    quasi_static = quasi_static_growth(balance, speed, phases, neutral)
    good &= (speed > 70.0) & (neutral == 0)
    return [jnp.where(good, value, jnp.nan) for value in (growth, quasi_static, speed, phases[1])]


def main(count: int) -> None:
    rng, rows = np.random.default_rng(0), []
    for direction in (1, -1):
        each = jax.jit(jax.vmap(lambda x, a, d=direction: growths(x, a, d)))
        for _ in range(0, count, BATCH):
            x = rng.uniform(LOW, HIGH, (BATCH, LOW.size))
            for phase in (0.0, np.pi):
                found = np.stack(each(jnp.asarray(x), jnp.full(BATCH, phase)), axis=1)
                rows.append(np.concatenate([x, np.full((BATCH, 1), direction), found], axis=1))
    table = np.concatenate(rows)
    table = table[np.isfinite(table[:, 10])]
    growth, quasi_static = table[:, 10], table[:, 11]
    wrong = {
        "grow, called stable": (growth > 0.02) & (quasi_static < -0.02),
        "stable, called growing": (growth < -0.02) & (quasi_static > 0.02),
    }
    print(f"{len(table)} regimes")
    for name, where in wrong.items():
        print(f"{name}: {np.count_nonzero(where)}")
        best = np.flatnonzero(where)
        best = best[np.argsort(-np.minimum(np.abs(growth), np.abs(quasi_static))[best])][:5]
        for row in table[best]:
            print("  " + " ".join(f"{value:.4g}" for value in row))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 4000)
