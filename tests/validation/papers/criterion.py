"""Numbers of the criterion paper: formulas for characteristic speeds of one, two and three masses."""

from __future__ import annotations

import functools
import math
from functools import partial

import jax.numpy as jnp
import numpy as np
from closed_forms import two_mass_functional, two_mass_speeds

from jaxvib.equations.linear import natural_frequencies
from jaxvib.machine.dimensionless import Dimensionless
from jaxvib.machine.scene import Scene
from jaxvib.steady.balance.speeds import characteristic_speeds, port_receptance
from jaxvib.units import Numbers
from papers.printed import Misprint, PrintedNumber

__all__ = ["NUMBERS"]

_TWO = ((0.7, 0.5), 0.6, 1.4)
_THREE = ((0.7, 0.5, 0.9), (0.6, 0.45, 0.8), (1.4, 0.75))
"""Natural frequencies n_i, those of the links, rho_i of the machines on which formulas are tried: no two are alike."""

_H, _Q = 0.05, 0.8
"""Damping and speed of one mass; the speed of two masses too."""

_TWO_DAMPING, _TWO_LINK_DAMPING = (0.03, 0.02), 0.04


def _machine(
    natural: Numbers, link_natural: Numbers = (), rho: Numbers = (), damping: Numbers = 0.0, link_damping: Numbers = 0.0
) -> Scene:
    of = dict(natural=natural, link_natural=link_natural, rho=rho, damping=damping, link_damping=link_damping)
    return Dimensionless("criterion", **of, eps=1e-4, beta=1.0, speed=3.0, count=2).scene()


def _answer() -> complex:
    """X1 + i X2 of one mass."""
    return complex(port_receptance(_machine(1.0, damping=_H), jnp.asarray(_Q))[0, 0]) * _Q**2


def _answer_again() -> complex:
    below = (1.0 - _Q**2) ** 2 + 4.0 * _H**2 * _Q**2
    return complex(_Q**2 * (1.0 - _Q**2), -2.0 * _Q**3 * _H) / below


def _third() -> float:
    """X3 of two masses."""
    damped = _machine(*_TWO, _TWO_DAMPING, _TWO_LINK_DAMPING)
    return float(port_receptance(damped, jnp.asarray(_Q))[0, 0].real) * _Q**2


@functools.cache
def _two_speeds() -> tuple[float, float, float]:
    """q1, q2 and q~ of two masses."""
    speeds = characteristic_speeds(_machine(*_TWO))
    return (*np.asarray(speeds.resonances).tolist(), *np.asarray(speeds.additional).tolist())


def _two_printed(kind: int, k: int) -> float:
    (n1, n2), n12, rho = _TWO
    return float(two_mass_speeds(n1, n2, n12, rho)[kind][k])


def _product_of_two() -> float:
    q1, q2, between = _two_speeds()
    return (between**2 - q1**2) * (q2**2 - between**2)


def _static() -> tuple[float, float, float]:
    """n1^2 + rho n12^2, the determinant at rest, and the first factor of f(0) as printed."""
    (a, b), c, rho = np.square(_TWO[0]).tolist(), _TWO[1] ** 2, _TWO[2]
    return a + rho * c, a * b + c * (a + rho * b), a * b + (a + rho * c) * c


@functools.cache
def _three_speeds() -> tuple[float, float]:
    """q~1 and q~2 of three masses."""
    low, high = np.asarray(characteristic_speeds(_machine(*_THREE)).additional).tolist()
    return low, high


_A, _B, _E = np.square(_THREE[0]).tolist()
_C12, _C13, _C23 = np.square(_THREE[1]).tolist()
_R1, _R3 = _THREE[2]
_FIRST, _THIRD = _A + _R1 * (_C12 + _C13), _E + _R3 * (_C13 + _C23)
"""Squares of the natural frequencies; the diagonal elements of platforms 1 and 3."""


def _highest(is_printed: bool) -> float:
    """Highest resonance of (39), with y1 of platform 1 in the last link of platform 3, as printed, or with y3."""
    middle = [-_R1 * _C12, _B + _C12 + _C23, -_R3 * _C23]
    last = [_R1 * (_C23 - _C13), -_C23, _THIRD - _R3 * _C23] if is_printed else [-_R1 * _C13, -_C23, _THIRD]
    matrix = np.array([[_FIRST, -_C12, -_R3 * _C13], middle, last])
    return float(np.sqrt(np.max(np.linalg.eigvals(matrix).real)))


def _c(link: float) -> float:
    """(57), c, with the square of n12 in the first factor, or with that of n13, as printed."""
    return (_A + _R1 * link) * _THIRD + _R1 * _C13 * (_E + _R3 * _C23)


_D = (_FIRST - _THIRD) ** 2 + 4.0 * _R1 * _R3 * _C13**2

_number = partial(PrintedNumber, "criterion")
_formula = partial(PrintedNumber, "criterion", within=1e-9)
_one = partial(_formula, note=f"h = {_H}, q = {_Q}, s = 1")
_two = partial(_formula, note="n1 = 0.7, n2 = 0.5, n12 = 0.6, rho = 1.4")
_three = partial(_formula, note="n = 0.7, 0.5, 0.9; n12, n13, n23 = 0.6, 0.45, 0.8; rho1 = 1.4, rho3 = 0.75")

NUMBERS = (
    _number(
        "(12)",
        "resonance of one mass",
        1.0,
        lambda: float(characteristic_speeds(_machine(1.0)).resonances[0]),
        within=1e-9,
    ),
    _number(
        "(16)",
        "lowest speed of balancing, with damping",
        1.0,
        lambda: float(characteristic_speeds(_machine(1.0, damping=_H)).damped_resonances[0]),
        within=1e-6,
        note=f"h = {_H}",
    ),
    _one("(14)", "X1", lambda: _answer_again().real, lambda: _answer().real),
    _one("(14)", "X2", lambda: _answer_again().imag, lambda: _answer().imag),
    _one(
        "(10)",
        "X1 from (4) and (10)",
        lambda: -_answer_again().real,
        lambda: _answer().real,
        misprint=Misprint(
            "s_y = - s sin(q tau)",
            "+ s sin(q tau), as in (11) and (14)",
            "receptance of the machine",
            lambda: _answer_again().real,
        ),
    ),
    _two("(35)", "resonance 1 of two masses", lambda: _two_printed(0, 0), lambda: _two_speeds()[0]),
    _two("(35)", "resonance 2 of two masses", lambda: _two_printed(0, 1), lambda: _two_speeds()[1]),
    _two("(37)", "additional speed of two masses", lambda: _two_printed(1, 0), lambda: _two_speeds()[2]),
    _two("before (38)", "(q~^2 - q1^2)(q2^2 - q~^2)", lambda: _TWO[2] * _TWO[1] ** 4, _product_of_two),
    _two("(34)", "Delta^(1/2) at 0", lambda: _static()[1], lambda: math.prod(_two_speeds()[:2]) ** 2),
    _two(
        "(29), (30)",
        "X3 with damping",
        lambda: float(two_mass_functional(_Q, _TWO[0], _TWO[1], _TWO_DAMPING, _TWO_LINK_DAMPING, _TWO[2])),
        _third,
        note="n1 = 0.7, n2 = 0.5, n12 = 0.6, rho = 1.4, h = 0.03, 0.02, h12 = 0.04, q = 0.8",
    ),
    _two(
        "after (38)",
        "first factor of f(0)",
        lambda: _static()[2] * _static()[0],
        lambda: math.prod(_two_speeds()) ** 2,
        misprint=Misprint(
            "n1^2 n2^2 + (n1^2 + rho n12^2) n12^2",
            "n1^2 n2^2 + n12^2 (n1^2 + rho n2^2), as in (34)",
            "f(0) = q1^2 q2^2 q~^2 of the machine, divided by the other factor n1^2 + rho n12^2",
            lambda: _static()[1] * _static()[0],
        ),
    ),
    _three(
        "(39), platform 3",
        "resonance 3 of three masses",
        lambda: _highest(True),
        lambda: float(natural_frequencies(_machine(*_THREE))[2]),
        misprint=Misprint(
            "n23^2 (y2 - rho1 y1)",
            "n23^2 (y2 - rho3 y3)",
            "highest natural frequency of symmetric matrices",
            lambda: _highest(False),
        ),
    ),
    _three("(57), b", "q~1^2 + q~2^2", lambda: _FIRST + _THIRD, lambda: sum(q**2 for q in _three_speeds())),
    _three(
        "(57), c",
        "q~1^2 q~2^2",
        lambda: _c(_C13),
        lambda: math.prod(_three_speeds()) ** 2,
        misprint=Misprint("n1^2 + rho1 n13^2", "n1^2 + rho1 n12^2", "q~1^2 q~2^2 of the machine", lambda: _c(_C12)),
    ),
    _three(
        "(59), d",
        "(q~2^2 - q~1^2)^2",
        lambda: (_FIRST - (_THIRD - 2.0 * _E)) ** 2 + 4.0 * _R1 * 1.0 * _C13**2,  # rho2 = 1
        lambda: (_three_speeds()[1] ** 2 - _three_speeds()[0] ** 2) ** 2,
        misprint=Misprint("- n3^2, rho1 rho2", "+ n3^2, rho1 rho3", "(q~2^2 - q~1^2)^2 of the machine", lambda: _D),
    ),
    *(
        _three(
            "(58)",
            f"additional speed {k + 1} of three masses",
            lambda sign=sign: math.sqrt((_FIRST + _THIRD + sign * math.sqrt(_D)) / 2.0),
            lambda k=k: _three_speeds()[k],
        )
        for k, sign in ((0, -1.0), (1, 1.0))
    ),
)
"""Equations (10) to (14), (29) to (38), (39), (57) to (59), the last with d corrected."""
