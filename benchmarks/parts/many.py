"""An ensemble of runs over rotor speeds: jaxvib against native loops and vmap(diffrax) as its documentation shows.

Run by engine.py. The machine and its start are those of single.py, rotor speeds from 3 to 6; the error is the largest one
in all states at the end. diffrax runs a share of them only, spread over the same speeds, and its time is scaled up.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from parts import native
from parts.common import as_first_written, best, first, flat, published, reach, say, thrown

import jaxvib as jv
from jaxvib.runtime.parallel import cores


def ensemble(quick: bool = False, error: float = 1e-5) -> None:
    runs, share, end = (256, 64, 50.0) if quick else (4096, 256, 200.0)
    group = f"ensemble of {runs}"
    print(f"{group}, T = {end:g}, error {error:g}, {cores()} cores")
    scene, start = published(), thrown()
    par, y0, speeds = native.numbers(scene), flat(start), np.linspace(3.0, 6.0, runs)
    simd, scalar = native.simd_ensemble(), native.scalar_ensemble()
    native_compile = first(lambda: simd(y0, speeds, par, 1.0, 20))
    exact = simd(y0, speeds, par, end, int(20 * end))

    def make(n: jax.Array) -> tuple[jv.Scene, jv.State]:
        return eqx.tree_at(lambda s: s.drive.speed, scene, n), start

    values = jnp.asarray(speeds)

    def ours(steps: float) -> np.ndarray:
        many = jv.ensemble(make, values, end, stepsize_controller=jv.EqualSteps(int(steps)), estimate=False)
        return np.concatenate([np.asarray(leaf).reshape(runs, -1) for leaf in jax.tree.leaves(many.state)], axis=1)

    settings = [float(int(end * r)) for r in np.arange(3.0, 12.0, 0.5)]
    chosen, found, _ = reach(lambda n: simd(y0, speeds, par, end, int(n)), settings, exact, error)
    base = best(lambda: simd(y0, speeds, par, end, int(chosen)))
    steps = f"{chosen:g} steps"
    say(group, "native, hand-written vector instructions (numba)", base, base, found, native_compile, steps)
    _, found, compiling = reach(ours, [chosen], exact, error)
    seconds = best(lambda: jv.ensemble(make, values, end, stepsize_controller=jv.EqualSteps(int(chosen)), estimate=False).state)
    say(group, "jaxvib.ensemble", seconds, base, found, compiling, steps)
    _, found, compiling = reach(lambda n: scalar(y0, speeds, par, end, int(n)), [chosen], exact, error)
    seconds = best(lambda: scalar(y0, speeds, par, end, int(chosen)), 3)
    say(group, "native scalar loop, prange", seconds, base, found, compiling, steps)
    every = runs // share
    asked = dict(end=end, error=error, exact=exact[::every].tolist(), speeds=speeds[::every].tolist())
    for name, seconds, found, compiling in as_first_written("ensemble", **asked):
        say(group, name, seconds * every, base, found, compiling, f"{share} runs, their time {every} times")
