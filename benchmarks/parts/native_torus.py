"""Reference for captures: two balls in a torus in a hand-written native loop (numba).

The equations are those of `torus_balls` with `RollingFriction(direction="along")`, `Gravity(along="axis")` and
`StaticImbalance`. The loop solves for the accelerations as if every ball were pressed against its wall. The engine first
determines the sign of the contact force; both agree while all balls are pressed against the wall.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from parts.native import TABLEAU, horner, indented, made, sincos

NAMES = ("x", "y", "f1", "f2", "a1", "a2", "vx", "vy", "u1", "u2", "w1", "w2", "turn")

_EXP = [1.0 / math.factorial(k) for k in range(14)]

_BALL = """
    B{j} = R + rho * sa{j}
    vf{j} = B{j} * (u{j} - w)
    va{j} = rho * w{j}
    v{j} = math.sqrt(vf{j} * vf{j} + va{j} * va{j}) + 1e-300
    h{j} = min(v{j} / width, 20.0) / 32.0
    e{j} = {exp}
    e{j} = e{j} * e{j}
    e{j} = e{j} * e{j}
    e{j} = e{j} * e{j}
    e{j} = e{j} * e{j}
    e{j} = e{j} * e{j}
    e{j} = e{j} * e{j}
    q{j} = mu * (1.0 - 2.0 / (e{j} + 1.0)) / v{j}
    N{j} = B{j} * u{j} * u{j} * sa{j} + rho * w{j} * w{j} + g * ca{j}
    F{j} = ((0.4 * w / 1.4 - 2.0 * u{j}) * rho * ca{j} * w{j} - q{j} * vf{j} * N{j} / 1.4) / B{j}
    A{j} = B{j} * ca{j} * u{j} * (u{j} - 0.4 * w / 1.4) / rho
    A{j} = A{j} - (g * sa{j} + q{j} * va{j} * N{j}) / (1.4 * rho)
    fr{j} = q{j} * vf{j} * sa{j}
    ar{j} = q{j} * va{j} * sa{j} - ca{j}
    fx{j} = (sf{j} + fr{j} * cf{j}) / (1.4 * B{j})
    fy{j} = (fr{j} * sf{j} - cf{j}) / (1.4 * B{j})
    ax{j} = ar{j} * cf{j} / (1.4 * rho)
    ay{j} = ar{j} * sf{j} / (1.4 * rho)
    o{j} = B{j} * u{j} * u{j} + rho * sa{j} * w{j} * w{j} - rho * ca{j} * A{j}
    k{j} = 2.0 * rho * ca{j} * w{j} * u{j} + B{j} * F{j}
    px{j} = rho * ca{j} * cf{j}
    py{j} = rho * ca{j} * sf{j}
    xx{j} = 1.0 - B{j} * sf{j} * fx{j} + px{j} * ax{j}
    xy{j} = -B{j} * sf{j} * fy{j} + px{j} * ay{j}
    yx{j} = B{j} * cf{j} * fx{j} + py{j} * ax{j}
    yy{j} = 1.0 + B{j} * cf{j} * fy{j} + py{j} * ay{j}
"""
"""Coefficients of ball j: f'' = F + fx x'' + fy y'', a'' = A + ax x'' + ay y'', and its reaction on the rotor."""

_ROTOR = """
    gx = imb * w * w * cturn - k * x - c * vx + m * (o1 * cf1 + k1 * sf1 + o2 * cf2 + k2 * sf2)
    gy = imb * w * w * sturn - k * y - c * vy + m * (o1 * sf1 - k1 * cf1 + o2 * sf2 - k2 * cf2)
    mxx = M + m * (xx1 + xx2)
    mxy = m * (xy1 + xy2)
    myx = m * (yx1 + yx2)
    myy = M + m * (yy1 + yy2)
    det = mxx * myy - mxy * myx
    ax = (myy * gx - mxy * gy) / det
    ay = (mxx * gy - myx * gx) / det
    K[stage, 6, lane] = ax
    K[stage, 7, lane] = ay
    K[stage, 8, lane] = F1 + fx1 * ax + fy1 * ay
    K[stage, 9, lane] = F2 + fx2 * ax + fy2 * ay
    K[stage, 10, lane] = A1 + ax1 * ax + ay1 * ay
    K[stage, 11, lane] = A2 + ax2 * ax + ay2 * ay
    K[stage, 0, lane] = vx
    K[stage, 1, lane] = vy
    K[stage, 2, lane] = u1
    K[stage, 3, lane] = u2
    K[stage, 4, lane] = w1
    K[stage, 5, lane] = w2
    K[stage, 12, lane] = w
"""


def numbers(scene: Any) -> tuple[float, ...]:
    """The scene's numbers as the native code takes them."""
    machine, loads, (gravity, imbalance, rolling) = scene.machine, scene.loads, scene.all_effects
    values = (machine.mass, machine.stiffness, machine.damping, loads.mass, loads.radius, loads.gap, scene.drive.speed)
    lever = rolling.coefficient / loads.ball_radius
    return tuple(float(x) for x in (*values, gravity.g, imbalance.moment, lever, rolling.width))


def simd_ensemble(lanes: int = 64) -> Callable[..., np.ndarray]:
    """f(starts (N, 13), numbers, end, steps) -> states (N, 13); blocks of `lanes` runs stepped together, spread over the cores.

    The stages are a loop, as the engine has it for as large a state; written out they take the compiler more than ten minutes.
    """
    balls = "".join(_BALL.format(j=j, exp=horner(_EXP, f"h{j}")) for j in (1, 2))
    angles = "".join(sincos(name, name) for name in ("f1", "f2", "a1", "a2", "turn"))
    size = len(NAMES)
    read = "\n".join(f"    {name} = Y[{k}, lane]" for k, name in enumerate(NAMES))
    source = f"""
def run(starts, par, end, steps):
    M, k, c, m, R, rho, w, g, imb, mu, width = par
    out = np.empty((len(starts), {size}))
    dt = end / steps
    for block in prange(len(starts) // {lanes}):
        S, Y, K = np.empty(({size}, {lanes})), np.empty(({size}, {lanes})), np.empty((STAGES, {size}, {lanes}))
        for lane in range({lanes}):
            for j in range({size}):
                S[j, lane] = starts[block * {lanes} + lane, j]
        for _ in range(steps):
            for stage in range(STAGES + 1):
                # The last row gives the step itself.
                for j in range({size}):
                    for lane in range({lanes}):
                        Y[j, lane] = S[j, lane]
                    for earlier in range(stage):
                        share = dt * WEIGHTS[stage, earlier]
                        if share != 0.0:
                            for lane in range({lanes}):
                                Y[j, lane] += share * K[earlier, j, lane]
                if stage == STAGES:
                    break
                for lane in range({lanes}):
{indented(read, 16)}
{indented(angles + balls + _ROTOR, 16)}
            S, Y = Y, S
        for lane in range({lanes}):
            for j in range({size}):
                out[block * {lanes} + lane, j] = S[j, lane]
    return out
"""
    stages = len(TABLEAU.b_sol) - 1
    weights = np.zeros((stages + 1, stages))
    for i, row in enumerate(TABLEAU.a_lower[: stages - 1]):
        weights[i + 1, : i + 1] = row
    weights[stages] = TABLEAU.b_sol[:-1]
    return made(source, "run", parallel=True, known={"STAGES": stages, "WEIGHTS": weights})


def flat(state: Any) -> np.ndarray:
    """A `State` as the native code holds it."""
    parts = (state.displacement, *state.angle, state.velocity, *state.rate)
    return np.concatenate([*(np.ravel(np.asarray(part)) for part in parts), [0.0]])
