"""Reliability of error estimates: share of runs whose estimated error is below the true one, and of missed accuracies.

    python benchmarks/trials/estimates.py --scenes 30 --out out

Random scenes of each kind below are integrated in float64 and float32, to a random tolerance and to a random accuracy. The true
error is the distance (as in `Run.error`) from a run in float64 with the tolerance 1e-14, at the same times, minus the distance
of this reference from a run with the tolerance 1e-13: chaotic motions have no more accurate reference. The scenes of a kind
differ only in their parameters, so that two programs are sufficient for each kind.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
from jaxvib.motion.analysis.scaled_error import error_scale, natural_units, scaled_error, with_nearest_turns

jv.prepare_cpu()

UNTIL, MAX_STEPS, BEST = 6.0, 2**18, (1e-14, 1e-13)
Draw = Callable[[float, float], float]


def one_mass(draw: Draw) -> jv.Machine:
    return jv.one_mass(mass=draw(30.0, 60.0), stiffness=draw(2e4, 6e4), damping=draw(20.0, 200.0))


def planar(draw: Draw) -> jv.Machine:
    return jv.planar_rotor(mass=draw(10.0, 30.0), stiffness=draw(1e4, 6e4), damping=draw(20.0, 200.0))


def pendulums(draw: Draw, count: int) -> jv.Loads:
    return jv.pendulums(count=count, mass=draw(0.3, 1.5), radius=draw(0.08, 0.15), drag=draw(0.3, 2.0), inertia=1e-3)


def motor(draw: Draw) -> jv.Drive:
    return jv.DCMotor(draw(30.0, 80.0), stall_torque=draw(2.0, 10.0), inertia=draw(0.05, 0.3))


def two_masses(draw: Draw, *effects: jv.Effect) -> jv.Scene:
    machine = jv.two_mass(
        mass=(draw(80.0, 120.0), draw(80.0, 120.0)),
        stiffness=(draw(3e4, 6e4), draw(3e4, 6e4)),
        damping=(draw(20.0, 80.0), draw(20.0, 80.0)),
        link_stiffness=draw(1e5, 2e5),
        link_damping=draw(20.0, 100.0),
    )
    loads = jv.balls(count=1, mass=draw(0.5, 3.0), radius=draw(0.08, 0.15), drag=draw(0.5, 3.0))
    return jv.Scene(machine, loads, jv.ConstantSpeed(draw(30.0, 120.0)), effects)


def touching(draw: Draw) -> jv.Scene:
    loads = jv.balls(count=2, mass=draw(0.2, 0.5), radius=0.1, drag=draw(0.3, 2.0), ball_radius=draw(0.01, 0.03))
    contact = jv.LoadContact(stiffness=draw(1e4, 1e5), damping=draw(1.0, 30.0))
    return jv.Scene(one_mass(draw), loads, jv.ConstantSpeed(draw(20.0, 60.0)), (contact, jv.Gravity()))


def ringed(draw: Draw) -> jv.Scene:
    stop = jv.Stop(draw(1e4, 2e5), gap=draw(1e-3, 5e-3), damping=draw(0.0, 100.0))
    return jv.Scene(planar(draw), pendulums(draw, 1), jv.RunUp(draw(30.0, 60.0), acceleration=draw(10.0, 60.0)), (stop,))


KINDS: dict[str, Callable[[Draw], jv.Scene]] = {
    "no effect": two_masses,
    "gravity, imbalance": lambda draw: jv.Scene(
        planar(draw), pendulums(draw, 2), motor(draw), (jv.Gravity(), jv.StaticImbalance(draw(0.0, 0.05)))
    ),
    "cubic support": lambda draw: jv.Scene(
        one_mass(draw), pendulums(draw, 1), jv.ConstantSpeed(draw(20.0, 60.0)), (jv.CubicSupport(draw(0.0, 1e9)),)
    ),
    "stop": lambda draw: jv.Scene(
        one_mass(draw), pendulums(draw, 1), motor(draw), (jv.Stop(draw(1e4, 1e6), gap=draw(1e-4, 5e-3)),)
    ),
    "stop that damps": lambda draw: two_masses(draw, jv.Stop(draw(1e4, 5e5), gap=draw(1e-4, 3e-3), damping=draw(10.0, 900.0))),
    "ring, run-up": ringed,
    "dry friction": lambda draw: jv.Scene(
        one_mass(draw),
        pendulums(draw, 1),
        jv.ConstantSpeed(draw(20.0, 60.0)),
        (jv.DryFriction(draw(0.01, 0.3), diameter=0.02, width=10.0 ** draw(-2.0, 0.0)), jv.Gravity()),
    ),
    "contact": touching,
}


def drawn(kind: str, seed: int) -> jv.Scene:
    """A random scene whose numbers are those of single precision, so that both precisions run the same machine."""
    rng = np.random.default_rng([seed, *map(ord, kind)])
    scene = KINDS[kind](lambda low, high: float(rng.uniform(low, high)))
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, np.float32), float), scene)


def true_error(scene: jv.Scene, run: jv.Run, best: jv.Run) -> float:
    """The run's distance from the best one, moved to the times that the run reports."""
    ours, theirs = (jax.tree.map(lambda x: np.asarray(x, float), r.window.state) for r in (run, best))
    late = np.asarray(run.window.time, float) - np.asarray(best.window.time)
    times = np.asarray(best.window.time)

    def moved(x: np.ndarray) -> np.ndarray:
        return x + np.gradient(x, times, axis=0) * late.reshape(-1, *[1] * (x.ndim - 1))

    theirs = jax.tree.map(moved, theirs)
    return float(scaled_error(with_nearest_turns(ours, theirs), theirs, error_scale(theirs, natural_units(scene))))


def measured(kind: str, seed: int, dtype: type) -> dict[str, float | str | int]:
    scene, double = drawn(kind, seed), dtype is np.float64
    rng = np.random.default_rng([seed, 1])
    low, high = (-9.0, -5.0) if double else (-5.9, -3.0)
    tolerance, accuracy = 10.0 ** rng.uniform(low, high), 10.0 ** rng.uniform(-5.0 if double else -3.5, -2.0)
    asked = dict(save="window", max_steps=MAX_STEPS, throw=False)
    best, other = (jv.simulate(scene, UNTIL, stepsize_controller=jv.Tolerance(t), estimate=False, **asked) for t in BEST)
    unknown = true_error(scene, other, best)
    row: dict[str, float | str | int] = dict(kind=kind, seed=seed, dtype=dtype.__name__, best=best.status_name)
    own = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), scene)
    end = jnp.asarray(UNTIL, dtype)
    for name, chosen in {"tolerance": jv.Tolerance(tolerance), "accuracy": jv.Accuracy(accuracy)}.items():
        with jax.enable_x64(double):
            run = jv.simulate(own, end, stepsize_controller=chosen, **asked)
        row |= {f"{name}_status": run.status_name, f"{name}_estimate": float(run.error)}
        row |= {f"{name}_steps": int(run.steps), f"{name}_evaluations": int(run.evaluations)}
        row |= {f"{name}_error": max(true_error(scene, run, best) - unknown, 0.0)}
    return row | dict(unknown=unknown, tolerance=tolerance, accuracy=accuracy)


def table(rows: list[dict]) -> str:
    """Table for each kind and dtype: runs, share and worst ratio of errors above estimates, and of accuracies broken
    silently."""
    lines = [f"{'':20s}{'':9s}{'runs':>5s}{'above':>8s}{'worst':>7s}{'broken':>8s}{'worst':>7s}{'refused':>8s}{'median':>8s}"]
    for kind in [*KINDS, "all"]:
        for dtype in ("float64", "float32"):
            some = [r for r in rows if kind in (r["kind"], "all") and r["dtype"] == dtype and r["best"] == "done"]
            if not some:
                continue
            done = [
                (r[f"{n}_error"], r[f"{n}_estimate"])
                for r in some
                for n in ("tolerance", "accuracy")
                if r[f"{n}_status"] == "done"
            ]
            ratio = np.array([error / estimate for error, estimate in done])
            kept = np.array([r["accuracy_error"] / r["accuracy"] for r in some if r["accuracy_status"] == "done"])
            lines.append(
                f"{kind:20s}{dtype:9s}{ratio.size:5d}{np.mean(ratio > 1.0):8.1%}{np.max(ratio, initial=0.0):7.2g}"
                f"{np.mean(kept > 1.0) if kept.size else 0.0:8.1%}{np.max(kept, initial=0.0):7.2g}"
                f"{1.0 - kept.size / len(some):8.1%}{1.0 / np.median(ratio) if np.any(ratio) else 0.0:8.3g}"
            )
    return "\n".join(lines)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--scenes", type=int, default=30, help="of each kind")
    options.add_argument("--first", type=int, default=0, help="number of the first one")
    options.add_argument("--kinds", nargs="*", default=list(KINDS))
    options.add_argument("--out", type=pathlib.Path)
    given = options.parse_args()
    rows, begun = [], time.perf_counter()
    jv.use_cache()
    for kind in given.kinds:
        for dtype in (np.float64, np.float32):
            rows += [measured(kind, k, dtype) for k in range(given.first, given.first + given.scenes)]
            print(f"{kind}, {dtype.__name__}: {time.perf_counter() - begun:.0f} s", flush=True)
            if given.out is not None:  # what is done so far
                given.out.mkdir(parents=True, exist_ok=True)
                (given.out / "estimates.json").write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))
    print("above: true error above the estimate; broken: above the accuracy asked for, status done; median: estimate / error")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
