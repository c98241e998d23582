"""Cost of a run-up with an error of 1 % in amplitude: averaged equations compared with full equations.

    python benchmarks/engine.py --only envelope

For each solver the loosest tolerance with an error below 1 % is determined first. Then the runs are timed in turn, as an
optimizer calls them: under `jax.jit`, with the amplitudes at the end as the result. The time is the shortest of several runs,
without compilation. Ratios of times hardly depend on the computer.

The error is the largest difference of the amplitudes of the platforms from a run with the tolerance 1e-9, relative to the
largest amplitude of the platform. It is evaluated in each 64th part of the run except the first and the last one (the amplitude
there is the modulus of the analytic signal, by Fourier transform), and for the amplitudes measured at the end. The machine is
the two-mass machine of the antiphase paper.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import numpy as np
from parts.common import best_in_turn, first, published, say

import jaxvib as jv
from jaxvib.ode.dopri8 import UnrolledDopri8

BLOCKS, SAMPLES = 64, 2**17
ALLOWED = 1e-2
TOLERANCES = [10.0 ** (-k / 4) for k in range(2, 21)]


def run_up(eps: float, speed: float, until: float) -> jv.Scene:
    """Spun up to `speed` over half the time."""
    return eqx.tree_at(lambda s: s.drive, published(speed, eps, 0.02), jv.SpinUp(speed, until / 2.0))


def peaks(amplitude: np.ndarray, at_the_end: jax.Array) -> np.ndarray:
    blocks = np.max(amplitude.reshape(BLOCKS, -1, amplitude.shape[1]), axis=1)
    return np.concatenate([blocks[1:-1], np.asarray(at_the_end)[None]])


def peaks_of_run(run: jv.Run) -> np.ndarray:
    assert run.trajectory is not None
    spectrum = np.fft.fft(np.asarray(run.trajectory.state.displacement), axis=0)
    spectrum[1 : SAMPLES // 2] *= 2.0
    spectrum[SAMPLES // 2 + 1 :] = 0.0
    return peaks(np.abs(np.fft.ifft(spectrum, axis=0)), run.amplitude)


def full(scene: jv.Scene, until: float, solver: Any, tolerance: float, **given: Any) -> jv.Run:
    asked = dict(window_periods=1, max_steps=2**20, estimate=False, throw=False)
    return jv.simulate(scene, until, solver=solver, stepsize_controller=jv.Tolerance(tolerance), **asked, **given)


def compare(name: str, scene: jv.Scene, until: float, rounds: int) -> None:
    reference = full(scene, until, None, 1e-9, samples=SAMPLES)
    exact = peaks_of_run(reference)
    turns = float(reference.window.state.angle[0][-1, 0]) / (2.0 * np.pi)
    group = f"run-up, {name}"
    print(f"{group}: {turns:.0f} turns of the load, amplitudes within {ALLOWED:.0%}", flush=True)

    def error(values: np.ndarray) -> float:
        return float(np.max(np.abs(values - exact) / np.max(exact, axis=0)))

    slow, off, tolerance = None, np.inf, np.nan
    for tolerance in TOLERANCES:
        slow = jv.envelope(scene, until, stepsize_controller=jv.Tolerance(tolerance), samples=SAMPLES)
        assert slow.trajectory is not None
        off = error(peaks(np.asarray(slow.trajectory.amplitude), slow.amplitude))
        if off < ALLOWED:
            break
    assert slow is not None

    numbers, rest = eqx.partition(scene, eqx.is_array)
    timed: list[tuple[str, Callable[[], Any], float, float, str]] = []

    def add(title: str, run: Callable[..., Any], off: float, note: str) -> None:
        """A way to run: called by the numbers of the scene, asked for the amplitudes at the end."""
        call = jax.jit(lambda x: run(eqx.combine(x, rest)).amplitude)
        timed.append((title, lambda: call(numbers), first(lambda: call(numbers)), off, note))

    note = f"tolerance {tolerance:.1e}, {turns / float(slow.steps):.1f} turns a step"
    add("envelope", lambda s: jv.envelope(s, until, stepsize_controller=jv.Tolerance(tolerance), save="window"), off, note)
    for title, solver in (
        ("full, as simulate does it under jit", None),
        ("full, the step written out", UnrolledDopri8()),
        ("full, Tsit5", diffrax.Tsit5()),
        ("full, Dopri8", diffrax.Dopri8()),
    ):
        run, off = None, np.inf
        for tolerance_ in TOLERANCES:
            run = full(scene, until, solver, tolerance_, samples=SAMPLES)
            off = error(peaks_of_run(run)) if bool(run.status == jv.RunStatus.done) else np.inf
            if off < ALLOWED:
                break
        assert run is not None
        asked = (until, solver, tolerance_)
        note = f"tolerance {tolerance_:.1e}, {int(run.steps + run.rejected)} steps"
        add(title, lambda s, asked=asked: full(s, *asked, save="window"), off, note)

    seconds = best_in_turn([call for _, call, *_ in timed], rounds)
    for each, (title, _, compiling, off, note) in zip(seconds, timed, strict=True):
        say(group, title, each, seconds[0], off, compiling, note)


def run_ups(quick: bool = False) -> None:
    if quick:
        compare("caught", run_up(2e-3, 1.5, 2000.0), 2000.0, 1)
        return
    compare("caught below the second resonance", run_up(2e-3, 1.5, 8000.0), 8000.0, 20)
    compare("past both resonances", run_up(2e-3, 6.0, 8000.0), 8000.0, 20)
    compare("caught, lighter loads, longer", run_up(5e-4, 1.5, 32000.0), 32000.0, 20)
