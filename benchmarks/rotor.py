"""One run-up of 6 s of the rotor with four pendulums: `simulate` compared with a compiled native loop at equal achieved error.

    python benchmarks/rotor.py [--quick]

The native loop (numba) contains the equations of the paper, written by hand; the accelerations of the pendulums are eliminated
one by one, which leaves 4 equations. Its method is Dormand and Prince's pair of order 8(7). Both programs have a PI controller
of the step size with the same units, but the controllers differ:

- norm of the error: root of the mean square in the native loop, largest part in `simulate`
- exponents of the errors of this and of the previous step: 0.6/8 and 0.2/8 in the native loop, 3/32 and 1/16 in `simulate`
- largest growth of a step: 10 times in the native loop, 5 times in `simulate`

Equal tolerances therefore give different errors, and times are compared at equal errors. The error of a run is the error of the
pendulums' angles at its end, relative to the native loop with a tolerance of 1e-13. The time is the shortest of 5 runs, without
compilation. --quick integrates 2.5 s with three tolerances, as a test of the program; its numbers have no meaning.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import jaxvib as jv

jv.prepare_cpu()

import diffrax  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numba  # noqa: E402
import numpy as np  # noqa: E402
from machines import published_rotor  # noqa: E402

jax.config.update("jax_enable_x64", True)

TABLEAU = diffrax.Dopri8.tableau
STAGES = len(TABLEAU.b_sol) - 1
A = np.zeros((STAGES, STAGES))
for i, row in enumerate(TABLEAU.a_lower[: STAGES - 1]):
    A[i + 1, : len(row)] = row
B = np.asarray(TABLEAU.b_sol[:STAGES], dtype=float)
E = np.asarray(TABLEAU.b_error[:STAGES], dtype=float)
C = np.concatenate([[0.0], np.asarray(TABLEAU.c)])[:STAGES]

RUNS = 5


@numba.njit(fastmath=True, error_model="numpy")
def rates(t: float, y: np.ndarray, par: np.ndarray, stations: np.ndarray, out: np.ndarray) -> None:
    """Compute the rates by equation (1) of the paper: y = (y, z, theta, psi, their rates, four angles, four rates)."""
    mass, inertia, polar, c1, c2, c3, b1, b2, b3, m, length, mu, me, speed, acceleration, g = par
    w, accel = (acceleration * t, acceleration) if t < speed / acceleration else (speed, 0.0)
    end = speed / acceleration
    phi = 0.5 * acceleration * t * t if t < end else speed * (t - 0.5 * end)
    cosine, sine = np.cos(phi), np.sin(phi)
    right = np.empty(4)
    right[0] = -b1 * y[4] - b2 * y[6] - c1 * y[0] - c2 * y[2] + me * (w * w * cosine + accel * sine)
    right[1] = -b1 * y[5] - b2 * y[7] - c1 * y[1] - c2 * y[3] + me * (w * w * sine - accel * cosine)
    right[2] = -polar * w * y[7] - b2 * y[4] - b3 * y[6] - c2 * y[0] - c3 * y[2]
    right[3] = polar * w * y[6] - b2 * y[5] - b3 * y[7] - c2 * y[1] - c3 * y[3]
    left = np.zeros((4, 4))
    left[0, 0] = left[1, 1] = mass
    left[2, 2] = left[3, 3] = inertia
    sines, cosines, free = np.empty(4), np.empty(4), np.empty(4)
    for k in range(4):
        s, c = np.sin(y[8 + k]), np.cos(y[8 + k])
        sines[k], cosines[k] = s, c
        rate, st = y[12 + k], stations[k]
        free[k] = (mu * (w - rate) / (m * length) - g * c) / length
        # A pendulum loads its pivot with its mass in the direction of its arm only.
        cc, cs, ss = m * c * c, m * c * s, m * s * s
        left[0, 0] += cc
        left[0, 1] += cs
        left[1, 1] += ss
        left[0, 2] += st * cc
        left[0, 3] += st * cs
        left[1, 2] += st * cs
        left[1, 3] += st * ss
        left[2, 2] += st * st * cc
        left[2, 3] += st * st * cs
        left[3, 3] += st * st * ss
        across = m * length * (rate * rate * c + free[k] * s)
        up = m * length * (rate * rate * s - free[k] * c)
        right[0] += across
        right[1] += up
        right[2] += st * across
        right[3] += st * up
    for i in range(4):
        for j in range(i):
            left[i, j] = left[j, i]
    for i in range(4):
        for j in range(i + 1, 4):
            factor = left[j, i] / left[i, i]
            for k in range(i, 4):
                left[j, k] -= factor * left[i, k]
            right[j] -= factor * right[i]
    for i in range(3, -1, -1):
        for j in range(i + 1, 4):
            right[i] -= left[i, j] * right[j]
        right[i] /= left[i, i]
    for i in range(4):
        out[i] = y[4 + i]
        out[4 + i] = right[i]
        out[8 + i] = y[12 + i]
        across, up = right[0] + stations[i] * right[2], right[1] + stations[i] * right[3]
        out[12 + i] = free[i] + (sines[i] * across - cosines[i] * up) / length


@numba.njit(fastmath=True, error_model="numpy")
def native(y0: np.ndarray, par: np.ndarray, stations: np.ndarray, end: float, unit: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the state at `end`; one step ends at the end of the run-up, where the acceleration of the rotor jumps."""
    y, t, dt = y0.copy(), 0.0, 1e-4
    kink = par[13] / par[14]
    k = np.empty((STAGES, 16))
    stage, new = np.empty(16), np.empty(16)
    before = 1.0
    while t < end:
        stop = kink if t < kink else end
        last = t + dt >= stop
        step = stop - t if last else dt
        for i in range(STAGES):
            for n in range(16):
                total = 0.0
                for j in range(i):
                    total += A[i, j] * k[j, n]
                stage[n] = y[n] + step * total
            # A stage at the kink has the acceleration before it.
            at = t + C[i] * step
            if last and t < kink and at >= kink:
                at = kink * (1.0 - 1e-15)
            rates(at, stage, par, stations, k[i])
        worst = 0.0
        for n in range(16):
            move, error = 0.0, 0.0
            for i in range(STAGES):
                move += B[i] * k[i, n]
                error += E[i] * k[i, n]
            new[n] = y[n] + step * move
            size = unit[n] if 8 <= n < 12 else unit[n] + max(abs(y[n]), abs(new[n]))
            worst += (step * error / (tolerance * size)) ** 2
        worst = np.sqrt(worst / 16.0) + 1e-16
        if worst <= 1.0:
            t = stop if last else t + step
            y[:] = new
            factor = 0.9 * worst ** (-0.6 / 8.0) * before ** (0.2 / 8.0)
            before = worst
        else:
            factor = 0.9 * worst ** (-1.0 / 8.0)
        dt = step * min(10.0, max(0.2, factor))
    return y


def numbers(scene: jv.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters of the scene in the order of the native loop, and the stations."""
    machine: Any = scene.machine
    loads: Any = scene.loads
    drive: Any = scene.drive
    gravity: Any = scene.all_effects[0]
    imbalance: Any = scene.all_effects[1]
    par = [machine.mass, machine.transverse_inertia, machine.polar_inertia, *machine.stiffness_terms, *machine.damping_terms]
    par += [
        loads.mass,
        loads.radius,
        loads.drag * loads.radius**2,
        imbalance.moment,
        drive.speed,
        drive.acceleration,
        gravity.g,
    ]
    return np.array([float(x) for x in par]), np.asarray(machine.stations)


def timed(call: Callable[[], Any]) -> tuple[float, float, Any]:
    """Return the compile time (first call minus the fastest one), s, the time of the fastest of 5 later calls, s, and the last
    result."""
    begun = time.perf_counter()
    result = call()
    first = time.perf_counter() - begun
    best = np.inf
    for _ in range(RUNS):
        begun = time.perf_counter()
        result = call()
        best = min(best, time.perf_counter() - begun)
    return first - best, best, result


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="short run, as a test of the program")
    quick = parser.parse_args().quick
    end, tolerances = (2.5, (1e-4, 1e-6, 1e-8)) if quick else (6.0, [10.0**-k for k in range(3, 11)])
    scene = published_rotor(9.2e-4, "uncoupled")
    par, stations = numbers(scene)
    start = jv.initial_state(scene)
    y0 = np.concatenate([np.zeros(8), np.asarray(start.angle[0]), np.zeros(4)])
    length = 4 * 0.05 * 0.08 / 18.7
    unit = np.concatenate([np.full(4, length), np.full(4, 460.0 * length), np.ones(4), np.full(4, 460.0)])
    reference = native(y0, par, stations, end, unit, 1e-13)[8:12]
    print(f"{'':16} {'tolerance':>9} {'error, rad':>10} {'seconds':>9} {'compile, s':>10}")
    rows: dict[str, list[tuple[float, float]]] = {"native": [], "jaxvib": []}
    for tolerance in tolerances:
        compiling, seconds, y = timed(lambda tol=tolerance: native(y0, par, stations, end, unit, tol))
        error = float(np.max(np.abs(y[8:12] - reference)))
        rows["native"].append((error, seconds))
        print(f"{'native loop':16} {tolerance:9.0e} {error:10.1e} {seconds:9.4f} {compiling:10.1f}")

        def run(tol: float = tolerance) -> Any:
            found = jv.simulate(scene, end, start=start, stepsize_controller=jv.Tolerance(tol), samples=2, estimate=False)
            return jax.block_until_ready(found.trajectory.state.angle[0][-1])

        compiling, seconds, angle = timed(run)
        error = float(jnp.max(jnp.abs(angle - reference)))
        rows["jaxvib"].append((error, seconds))
        print(f"{'jaxvib.simulate':16} {tolerance:9.0e} {error:10.1e} {seconds:9.4f} {compiling:10.1f}")
    for error in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9):
        times = [_at(error, rows[name]) for name in rows]
        print(f"at an error of {error:.0e} rad: {times[1] / times[0]:.2f} times the native loop")


def _at(error: float, rows: list[tuple[float, float]]) -> float:
    """Return the time, s, for an error, interpolated between the measured errors; NaN outside them."""
    errors, seconds = (np.log(x) for x in zip(*sorted(rows), strict=True))
    return float(np.exp(np.interp(np.log(error), errors, seconds, left=np.nan, right=np.nan)))


if __name__ == "__main__":
    main()
