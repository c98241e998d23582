"""Run-ups of a screen with two motors whose no-load speeds differ at random: share that synchronizes, and time.

    python benchmarks/exciters/run_ups.py --runs 4096

The machine is that of docs/exciters.md. Times are CPU times; the first call includes tracing and compilation. They
are stated as ratios to one run by the same function.
"""

from __future__ import annotations

import argparse
import os
import time

import equinox as eqx
import jax
import numpy as np

import jaxvib as jv

os.environ["JAXVIB_AUTOMATIC"] = "off"  # no program comes from a cache
jv.prepare_cpu()

jax.config.update("jax_enable_x64", True)

SCATTER = 0.5
"""Standard deviation of the no-load speed of the second motor, rad/s."""


def screen() -> jv.Scene:
    springs = [jv.support(at=(x, -0.2), stiffness=(3e4, 3e4), damping=(150.0, 150.0)) for x in (-0.6, 0.6)]
    body = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    motor = jv.InductionMotor("1000 rpm", breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.05)
    exciters = [
        jv.Exciter(drive=motor, unbalance=0.4, at=(-0.3, 0.4), direction=1),
        jv.Exciter(drive=motor, unbalance=0.4, at=(0.3, 0.4), direction=-1),
    ]
    return jv.Scene(body, exciters=exciters)


def main(runs: int, seconds: float) -> None:
    scene = screen()
    rated = float(scene.exciters[1].drive.speed)
    speeds = np.random.default_rng(0).normal(rated, SCATTER, size=runs)

    def machine(speed: jax.Array) -> jv.Scene:
        return eqx.tree_at(lambda s: s.exciters[1].drive.speed, scene, speed)

    def timed(values: np.ndarray) -> tuple[jv.Ensemble, float]:
        begun = time.process_time()
        found = jv.ensemble(machine, values, seconds, estimate=False)
        jax.block_until_ready(found.state)
        return found, time.process_time() - begun

    timed(speeds[:1])
    one = min(timed(speeds[:1])[1] for _ in range(3))
    found, first = timed(speeds)
    again = timed(speeds)[1]
    share = found.synchronous_share
    error = np.sqrt(share.value * (1.0 - share.value) / runs)
    print(f"{runs} run-ups of {seconds:g} s, {int(found.steps)} steps each: {share.text}; standard error {100.0 * error:.2g} %")
    print(f"one run {one:.3g} s; {runs} runs: first call {first / one:.4g} times, second call {again / one:.4g} times one run")
    print(f"CPU time per run in the second call: {again / runs / one:.3g} times that of one run")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=4096)
    parser.add_argument("--seconds", type=float, default=20.0)
    given = parser.parse_args()
    main(given.runs, given.seconds)
