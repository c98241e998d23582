"""Reference for the integration engine: the two-mass machine in hand-written native loops (numba).

The method is that of Dormand and Prince of order 8 with fixed steps (the coefficients of diffrax's Dopri8), unrolled; sine and
cosine are polynomials:

- `single`: one run, with scalars
- `scalar_ensemble`: many runs, one after another on each core (`prange`)
- `simd_ensemble`: many runs, in blocks whose inner loops become vector instructions
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import diffrax
import numba
import numpy as np

TABLEAU = diffrax.Dopri8.tableau
NAMES = ("y1", "y2", "v1", "v2", "p", "w")

_SINCOS = """
    q{i} = math.floor({x} * 0.6366197723675814 + 0.5)
    r{i} = (({x} - q{i} * 1.5707963109016418) - q{i} * 1.5893254712295857e-08) - q{i} * 6.123233995736766e-17
    z{i} = r{i} * r{i}
    a{i} = r{i} + r{i} * z{i} * ({sine})
    b{i} = 1.0 - 0.5 * z{i} + z{i} * z{i} * ({cosine})
    u{i} = q{i} - 4.0 * math.floor(q{i} * 0.25)
    odd{i} = u{i} == 1.0 or u{i} == 3.0
    s{i} = (b{i} if odd{i} else a{i}) * (-1.0 if u{i} >= 2.0 else 1.0)
    c{i} = (a{i} if odd{i} else b{i}) * (-1.0 if (u{i} == 1.0 or u{i} == 2.0) else 1.0)
"""

_RATES = """
    f{i} = -d22 * {v2} - k22 * {y2} - d12 * {v1} - k12 * {y1}
    t{i} = g * (n - {w})
    h{i} = (f{i} + mR * ({w} * {w} * s{i} - t{i} * c{i})) / (M2 - e * c{i} * c{i})
    K{i}_v1 = (-d11 * {v1} - k11 * {y1} - d12 * {v2} - k12 * {y2}) * M1i
    K{i}_v2 = h{i}
    K{i}_w = t{i} - ek * h{i} * c{i}
    K{i}_y1 = {v1}
    K{i}_y2 = {v2}
    K{i}_p = {w}
"""


def horner(coefficients: list[float], x: str) -> str:
    text = f"{coefficients[-1]!r}"
    for value in reversed(coefficients[:-1]):
        text = f"({value!r} + {x} * {text})"
    return text


def sincos(i: int | str, x: str) -> str:
    """Assignments of s{i} and c{i}, the sine and the cosine of x."""
    sine = [(-1) ** k / math.factorial(2 * k + 1) for k in range(1, 8)]
    cosine = [(-1) ** k / math.factorial(2 * k) for k in range(2, 9)]
    return _SINCOS.format(i=i, x=x, sine=horner(sine, f"z{i}"), cosine=horner(cosine, f"z{i}"))


def step_source() -> str:
    """One step of the 13 stages that the solution needs, for one lane, as assignments."""
    lines = []
    stages = len(TABLEAU.b_sol) - 1
    for i in range(stages):
        row = [] if i == 0 else TABLEAU.a_lower[i - 1]
        names = {}
        for name in NAMES:
            total = " + ".join(f"{float(a)!r} * K{j}_{name}" for j, a in enumerate(row) if a != 0.0)
            names[name] = f"Y{i}_{name}" if total else name
            if total:
                lines.append(f"    Y{i}_{name} = {name} + dt * ({total})")
        lines += sincos(i, names["p"]).strip("\n").split("\n")
        lines += _RATES.format(i=i, **names).strip("\n").split("\n")
    for name in NAMES:
        total = " + ".join(f"{float(b)!r} * K{i}_{name}" for i, b in enumerate(TABLEAU.b_sol[:-1]) if b != 0.0)
        lines.append(f"    {name} = {name} + dt * ({total})")
    return "\n".join(lines)


_UNPACK = "    k11, k12, k22, d11, d12, d22, M1i, M2, mR, e, ek, g = par"


def numbers(scene: Any) -> tuple[float, ...]:
    """The machine's numbers as the native code takes them."""
    carrier, loads = scene.machine.carrier(), scene.loads
    k, c, m = (np.asarray(x) for x in (carrier.stiffness, carrier.damping, carrier.mass))
    mass, radius, drag = float(loads.mass), float(loads.radius), float(loads.drag)
    kappa = float(loads.inertia_factor())
    stiff = (k[0, 0], k[0, 1], k[1, 1], c[0, 0], c[0, 1], c[1, 1])
    values = (*stiff, 1.0 / m[0, 0], m[1, 1] + mass, mass * radius, mass / kappa, 1.0 / (kappa * radius), drag / (kappa * mass))
    return tuple(float(x) for x in values)


def made(source: str, name: str, known: dict[str, Any] | None = None, **options: Any) -> Callable[..., Any]:
    """The function of that name in the source, compiled; `known` are constants that it reads."""
    space: dict[str, Any] = {"math": math, "np": np, "prange": numba.prange, **(known or {})}
    exec(source, space)
    return numba.njit(fastmath={"contract", "afn", "arcp", "nsz"}, error_model="numpy", **options)(space[name])


def indented(text: str, by: int) -> str:
    return "\n".join(" " * by + line for line in text.split("\n"))


def single() -> Callable[..., np.ndarray]:
    """f(start (6,), speed, numbers, end, steps) -> state (6,)."""
    source = f"""
def run(y, n, par, end, steps):
{_UNPACK}
    y1, y2, v1, v2, p, w = y[0], y[1], y[2], y[3], y[4], y[5]
    dt = end / steps
    for _ in range(steps):
{indented(step_source(), 4)}
    return np.array([y1, y2, v1, v2, p, w])
"""
    return made(source, "run")


def scalar_ensemble() -> Callable[..., np.ndarray]:
    """f(start (6,), speeds (N,), numbers, end, steps) -> states (N, 6); runs spread over the cores."""
    source = f"""
def run(y, speeds, par, end, steps):
{_UNPACK}
    out = np.empty((len(speeds), 6))
    dt = end / steps
    for lane in prange(len(speeds)):
        n = speeds[lane]
        y1, y2, v1, v2, p, w = y[0], y[1], y[2], y[3], y[4], y[5]
        for _ in range(steps):
{indented(step_source(), 8)}
        out[lane, 0], out[lane, 1], out[lane, 2], out[lane, 3], out[lane, 4], out[lane, 5] = y1, y2, v1, v2, p, w
    return out
"""
    return made(source, "run", parallel=True)


def simd_ensemble(lanes: int = 16) -> Callable[..., np.ndarray]:
    """Ensemble like `scalar_ensemble`, blocks of `lanes` runs stepped together, each statement a loop over the lanes."""
    body = step_source()
    source = f"""
def run(y, speeds, par, end, steps):
{_UNPACK}
    out = np.empty((len(speeds), 6))
    dt = end / steps
    for block in prange(len(speeds) // {lanes}):
        S = np.empty((6, {lanes}))
        for lane in range({lanes}):
            for j in range(6):
                S[j, lane] = y[j]
        for _ in range(steps):
            for lane in range({lanes}):
                n = speeds[block * {lanes} + lane]
                y1, y2, v1, v2, p, w = S[0, lane], S[1, lane], S[2, lane], S[3, lane], S[4, lane], S[5, lane]
{indented(body, 12)}
                S[0, lane], S[1, lane], S[2, lane], S[3, lane], S[4, lane], S[5, lane] = y1, y2, v1, v2, p, w
        for lane in range({lanes}):
            for j in range(6):
                out[block * {lanes} + lane, j] = S[j, lane]
    return out
"""
    return made(source, "run", parallel=True)


def rates_source() -> str:
    """The vector field alone, `rates(y, par)` with the rotor speed before the other numbers."""
    names = dict(zip(NAMES, (f"y[{k}]" for k in range(6)), strict=True))
    body = _RATES.format(i=0, **names).replace("s0", "math.sin(y[4])").replace("c0", "math.cos(y[4])")
    return f"""
import numpy as np
def rates(y, par):
    n, k11, k12, k22, d11, d12, d22, M1i, M2, mR, e, ek, g = par
{body}
    return np.array([K0_y1, K0_y2, K0_v1, K0_v2, K0_p, K0_w])
"""


def symbolic(y: Any, algebra: Any, speed: float, par: Any) -> list[Any]:
    """The vector field in the symbols of jitcode."""
    k11, k12, k22, d11, d12, d22, M1i, M2, mR, e, ek, g = par
    s, c = algebra.sin(y(4)), algebra.cos(y(4))
    torque = g * (speed - y(5))
    force = -d22 * y(3) - k22 * y(1) - d12 * y(2) - k12 * y(0)
    lift = (force + mR * (y(5) ** 2 * s - torque * c)) / (M2 - e * c * c)
    first = (-d11 * y(2) - k11 * y(0) - d12 * y(3) - k12 * y(1)) * M1i
    return [y(2), y(3), first, lift, y(5), torque - ek * lift * c]
