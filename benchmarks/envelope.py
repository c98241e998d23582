"""What a run-up costs at 1 % error in amplitude: the averaged equations against the full ones.

    python benchmarks/envelope.py

For every solver the loosest tolerance that still gives 1 % is found first, then the runs are timed in turn, best of several,
compile and run time apart; ratios travel between machines, absolute times do not. The error is the largest difference of
the platforms' amplitudes to a run at tolerance 1e-9, relative to the greatest amplitude of the platform: in each 64th of the
run (the modulus of the analytic signal, by Fourier transform; not in the first and the last, where it has no
neighbours), and as measured at the end. The machine is the two-mass one of the antiphase paper.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxvib as jv  # noqa: E402

BLOCKS, SAMPLES = 64, 2**17
ALLOWED = 1e-2


def run_up(eps: float, speed: float, until: float) -> jv.Scene:
    """Spun up to `speed` over half the time."""
    numbers = dict(natural=(1 / 3, 1 / 3), damping=(0.02, 0.02), link_natural=2 / 3, link_damping=0.02, rho=1.0, beta=1.0)
    scene = jv.Dimensionless("antiphase", **numbers, eps=eps, speed=speed).scene()
    return eqx.tree_at(lambda s: s.drive, scene, jv.SpinUp(speed, until / 2.0))


def peaks(amplitude: np.ndarray, at_the_end: jax.Array) -> np.ndarray:
    blocks = np.max(amplitude.reshape(BLOCKS, -1, amplitude.shape[1]), axis=1)
    return np.concatenate([blocks[1:-1], np.asarray(at_the_end)[None]])


def peaks_of_run(run: jv.Run) -> np.ndarray:
    assert run.trajectory is not None
    spectrum = np.fft.fft(np.asarray(run.trajectory.state.displacement), axis=0)
    spectrum[1 : SAMPLES // 2] *= 2.0
    spectrum[SAMPLES // 2 + 1 :] = 0.0
    return peaks(np.abs(np.fft.ifft(spectrum, axis=0)), run.amplitude)


def full(scene: jv.Scene, until: float, solver: diffrax.AbstractSolver, tolerance: float, **given) -> jv.Run:
    return jv.simulate(scene, until, solver=solver, tolerance=tolerance, turns=1, max_steps=2**20, throw=False, **given)


def timed(call: Callable, runs: int) -> tuple[float, float]:
    begin = time.perf_counter()
    jax.block_until_ready(call())
    first, best = time.perf_counter() - begin, np.inf
    for _ in range(runs):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        best = min(best, time.perf_counter() - begin)
    return first - best, best


def compare(name: str, scene: jv.Scene, until: float, runs: int) -> None:
    reference = full(scene, until, diffrax.Dopri8(), 1e-9, samples=SAMPLES)
    exact = peaks_of_run(reference)
    turns = float(reference.window.state.angle[0][-1, 0]) / (2.0 * np.pi)
    print(f"\n{name}: {turns:.0f} turns of the load", flush=True)

    def error(values: np.ndarray) -> float:
        return float(np.max(np.abs(values - exact) / np.max(exact, axis=0)))

    best = np.inf
    for solver in (diffrax.Tsit5(), diffrax.Dopri8()):
        for tolerance in (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5):
            run = full(scene, until, solver, tolerance, samples=SAMPLES)
            off = error(peaks_of_run(run)) if bool(run.status == jv.RunStatus.done) else np.inf
            if off < ALLOWED:
                break
        else:
            continue
        first, seconds = timed(lambda s=solver, t=tolerance: full(scene, until, s, t, save="window"), runs)
        best = min(best, seconds)
        title = f"full, {type(solver).__name__}"
        print(f"  {title:16s} tolerance {tolerance:.0e} error {off:.1e} steps {int(run.steps + run.rejected):7d} "
              f"compile {first:6.2f} s  run {1e3 * seconds:9.2f} ms", flush=True)  # fmt: skip
    for tolerance in (3e-2, 1e-2, 3e-3, 1e-3, 1e-4):
        slow = jv.envelope(scene, until, tolerance=tolerance, samples=SAMPLES)
        assert slow.trajectory is not None
        off = error(peaks(np.asarray(slow.trajectory.amplitude), slow.amplitude))
        if off < ALLOWED:
            break
    first, seconds = timed(lambda: jv.envelope(scene, until, tolerance=tolerance, save="window"), 10 * runs)
    print(f"  {'envelope':16s} tolerance {tolerance:.0e} error {off:.1e} steps {int(slow.steps + slow.rejected):7d} "
          f"compile {first:6.2f} s  run {1e3 * seconds:9.2f} ms")  # fmt: skip
    print(f"  the envelope is {best / seconds:.0f} times as fast; {turns / float(slow.steps):.1f} turns a step")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    compare("caught below the second resonance", run_up(2e-3, 1.5, 8000.0), 8000.0, options.runs)
    compare("past both resonances", run_up(2e-3, 6.0, 8000.0), 8000.0, options.runs)
    compare("caught, lighter loads, longer", run_up(5e-4, 1.5, 32000.0), 32000.0, options.runs)
    print("\nload of this machine over the last minutes: " + " ".join(f"{x:.1f}" for x in os.getloadavg()))


if __name__ == "__main__":
    main()
