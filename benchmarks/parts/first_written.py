"""Integration by diffrax as in its documentation, with `State` as the state, in a process without flags of XLA.

`common.as_first_written` starts this program. It reads a task as JSON from stdin, and writes rows [name, seconds, error,
compile] as JSON to stdout.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import diffrax
import equinox as eqx
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from parts.common import TOLERANCES, best, published, reach, thrown  # noqa: E402

import jaxvib as jv  # noqa: E402

SCENE, START = published(), thrown()


def solved(scene: jv.Scene, solver: Any, end: float, tolerance: Any) -> Any:
    term = diffrax.ODETerm(lambda t, y, args: args(t, y))
    control = diffrax.PIDController(rtol=tolerance, atol=tolerance)
    solution = diffrax.diffeqsolve(
        term, solver, 0.0, end, 0.01, START, jv.vector_field(scene), stepsize_controller=control, max_steps=2**20, throw=False
    )
    return jnp.concatenate([jnp.ravel(leaf[-1]) for leaf in jax.tree.leaves(solution.ys)])


def single(end: float, error: float, exact: list[float]) -> list[list[Any]]:
    rows = []
    for name, solver in (("Tsit5", diffrax.Tsit5()), ("Dopri8", diffrax.Dopri8())):
        run = jax.jit(lambda t, solver=solver: solved(SCENE, solver, end, t))
        chosen, found, compiling = reach(lambda t, run=run: np.asarray(run(t)), TOLERANCES[8:], np.asarray(exact), error)
        rows.append([f"diffrax {name} as documented", best(lambda run=run, c=chosen: run(c), 2), found, compiling])
    return rows


def ensemble(end: float, error: float, exact: list[list[float]], speeds: list[float]) -> list[list[Any]]:
    def one(n: Any, tolerance: Any) -> Any:
        return solved(eqx.tree_at(lambda s: s.drive.speed, SCENE, n), diffrax.Dopri8(), end, tolerance)

    many = jax.jit(jax.vmap(one, in_axes=(0, None)))
    values = jnp.asarray(speeds)
    chosen, found, compiling = reach(lambda t: np.asarray(many(values, t)), TOLERANCES[4:], np.asarray(exact), error)
    return [["vmap(diffrax Dopri8) as documented", best(lambda: many(values, chosen), 2), found, compiling]]


if __name__ == "__main__":
    asked = json.loads(sys.stdin.read())
    print(json.dumps({"single": single, "ensemble": ensemble}[asked.pop("task")](**asked)))
