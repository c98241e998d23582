"""What the criterion paper prints: formulas for characteristic speeds of one, two and three masses."""

from __future__ import annotations

import math
from functools import partial

import jax.numpy as jnp
import numpy as np

from jaxvib.equations.linear import natural_frequencies
from jaxvib.machine.dimensionless import Dimensionless
from jaxvib.machine.scene import Scene
from jaxvib.steady.balance.criterion import criterion
from jaxvib.steady.balance.speeds import characteristic_speeds, port_receptance
from jaxvib.study.published.entry import MISPRINT, PaperAnswer, PublishedRow, compared
from jaxvib.units import Numbers

__all__ = ["criterion_paper"]

_PAPER = "criterion"

_TWO = ((0.7, 0.5), 0.6, 1.4)
_THREE = ((0.7, 0.5, 0.9), (0.6, 0.45, 0.8), (1.4, 0.75))
"""Natural frequencies n_i, those of the links, rho_i of the machines that formulas are tried on."""

_row = partial(compared, _PAPER, kind="formula", within=1e-9)


def _form(
    natural: Numbers, link_natural: Numbers = (), rho: Numbers = (), damping: Numbers = 0.0, link_damping: Numbers = 0.0
) -> Scene:
    return Dimensionless(
        "criterion",
        natural=natural,
        link_natural=link_natural,
        rho=rho,
        damping=damping,
        link_damping=link_damping,
        eps=1e-4,
        beta=1.0,
        speed=3.0,
        count=2,
    ).scene()


def criterion_paper() -> PaperAnswer:
    """Equations (10) to (14), (29) to (38), (39), (57) to (59), each on a machine none of whose numbers are alike.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> [row.place for row in criterion_paper().rows if row.verdict == "misprint"]
    ['(10)', 'after (38), f(0)', '(39), platform 3', '(57), c', '(59), d']
    """
    three = _form(*_THREE)
    return PaperAnswer([*_one_mass(), *_two_masses(), *_three_masses()], {"three_masses": lambda: criterion(three).plot()})


def _one_mass() -> list[PublishedRow]:
    h, q = 0.05, 0.8
    still, damped = _form(1.0), _form(1.0, damping=h)
    answer = port_receptance(damped, jnp.asarray(q))[0, 0] * q**2
    below = (1.0 - q**2) ** 2 + 4.0 * h**2 * q**2
    in_phase, across = q**2 * (1.0 - q**2) / below, -2.0 * q**3 * h / below
    resonance = float(characteristic_speeds(still).resonances[0])
    damped_one = float(characteristic_speeds(damped).damped_resonances[0])
    said = f"h = {h}, q = {q}, s = 1"
    sign = (
        "s_y = + s sin(q tau): with the printed minus, (4) has - s q^2 sin(q tau) on the right and the platform answers the "
        f"other way round; (11) and (14) go with plus ({said}); proved by the machine's receptance"
    )
    return [
        compared(_PAPER, "(12)", "resonance of one mass", 1.0, resonance, within=1e-9),
        compared(_PAPER, "(16)", "where balancing begins, with damping", 1.0, damped_one, within=1e-6, note=f"h = {h}"),
        _row("(14)", "X1", in_phase, float(answer.real), note=said),
        _row("(14)", "X2", across, float(answer.imag), note=said),
        _row("(10)", "X1 by (4), (10)", -in_phase, float(answer.real), known=MISPRINT, corrected=in_phase, note=sign),
    ]


def _two_masses() -> list[PublishedRow]:
    (a, b), c, rho = (0.7**2, 0.5**2), 0.6**2, 1.4
    speeds = characteristic_speeds(_form(*_TWO))
    (q1, q2), (between,) = (np.asarray(x).tolist() for x in (speeds.resonances, speeds.additional))
    root = math.sqrt((a - b - (1.0 - rho) * c) ** 2 + 4.0 * rho * c**2)
    said = "n1 = 0.7, n2 = 0.5, n12 = 0.6, rho = 1.4"
    determinant = a * b + c * (a + rho * b)
    product = (between**2 - q1**2) * (q2**2 - between**2)
    static = q1**2 * q2**2 * between**2
    wrong = (a * b + (a + rho * c) * c) * (a + rho * c)
    first = (
        "f(0) = [n1^2 n2^2 + n12^2 (n1^2 + rho n2^2)] (n1^2 + rho n12^2), as (32) gives at q = 0 and (34) has it; the printed "
        f"first factor has n12 in place of n2 ({said}); proved by q1^2 q2^2 q~^2 of the machine"
    )
    q, damping, h12 = 0.8, (0.03, 0.02), 0.04
    damped = _form(*_TWO, damping, h12)
    third = float(port_receptance(damped, jnp.asarray(q))[0, 0].real) * q**2
    return [
        _row("(35)", "resonance 1 of two masses", math.sqrt((a + b + (1.0 + rho) * c - root) / 2.0), q1, note=said),
        _row("(35)", "resonance 2 of two masses", math.sqrt((a + b + (1.0 + rho) * c + root) / 2.0), q2, note=said),
        _row("(37)", "additional speed of two masses", math.sqrt(a + rho * c), between, note=said),
        _row("before (38)", "(q~^2 - q1^2)(q2^2 - q~^2)", rho * c**2, product, note=said),
        _row("(34)", "Delta^(1/2) at 0", determinant, q1**2 * q2**2, note=said),
        _row("(29), (30)", "X3 with damping", _x3(q, damping, h12), third, note=f"{said}, h = 0.03, 0.02, h12 = 0.04, q = 0.8"),
        _row("after (38), f(0)", "f(0)", wrong, static, known=MISPRINT, corrected=determinant * (a + rho * c), note=first),
    ]


def _x3(q: float, damping: tuple[float, float], h12: float) -> float:
    """X3 of `_TWO` by (26), (29), (30), s = 1."""
    (n1, n2), (h1, h2), n12, rho = (0.7, 0.5), damping, 0.6, 1.4
    a11, a12 = n1**2 + rho * n12**2 - q**2, -2.0 * q * (h1 + rho * h12)
    a13, a14 = -(n12**2), 2.0 * q * h12
    a33, a34 = n2**2 + n12**2 - q**2, -2.0 * q * (h2 + h12)
    top = rho * (a11 * (a14**2 - a13**2) - 2.0 * a12 * a13 * a14) + a33 * (a11**2 + a12**2)
    in_phase = a11 * a33 - rho * (a13**2 - a14**2) - a12 * a34
    quarter = 2.0 * rho * a13 * a14 - a12 * a33 - a11 * a34
    return q**2 * top / (in_phase**2 + quarter**2)


def _three_masses() -> list[PublishedRow]:
    (a, b, e), (c12, c13, c23), (r1, r3) = np.square(_THREE[0]), np.square(_THREE[1]), _THREE[2]
    scene = _form(*_THREE)
    low, high = np.asarray(characteristic_speeds(scene).additional).tolist()
    first, third = a + r1 * (c12 + c13), e + r3 * (c13 + c23)
    good_c = (a + r1 * c12) * third + r1 * c13 * (e + r3 * c23)
    bad_c = (a + r1 * c13) * third + r1 * c13 * (e + r3 * c23)
    good_d = (first - third) ** 2 + 4.0 * r1 * r3 * c13**2
    bad_d = (first - (third - 2.0 * e)) ** 2 + 4.0 * r1 * 1.0 * c13**2
    said = "n = 0.7, 0.5, 0.9; n12, n13, n23 = 0.6, 0.45, 0.8; rho1 = 1.4, rho3 = 0.75"

    def highest(first_of_last: bool) -> float:
        """Highest resonance of (39), with y1 of platform 1 in the last link of platform 3 as printed, or with y3."""
        matrix = np.array([[first, -c12, -r3 * c13], [-r1 * c12, b + c12 + c23, -r3 * c23], [-r1 * c13, -c23, third]])
        if first_of_last:
            matrix[2] = [-r1 * c13 + r1 * c23, -c23, third - r3 * c23]
        return float(np.sqrt(np.max(np.linalg.eigvals(matrix).real)))

    link = (
        f"the last term of platform 3 is n23^2 (y2 - rho3 y3), printed with rho1 y1 ({said}); proved by the machine's own "
        "highest natural frequency, from stiffness and mass matrices that are symmetric"
    )
    top = float(natural_frequencies(scene)[2])
    c_note = f"the first factor is n1^2 + rho1 n12^2, printed with n13 ({said}); proved by q~1^2 q~2^2 of the machine"
    d_note = (
        "{n1^2 + rho1 (n12^2 + n13^2) - [n3^2 + rho3 (n23^2 + n13^2)]}^2 + 4 rho1 rho3 n13^4; printed with - "
        f"n3^2 and rho1 rho2, where rho2 is 1 ({said}); proved by (q~2^2 - q~1^2)^2 of the machine"
    )
    root = math.sqrt(good_d)
    sums = _row("(57), b", "q~1^2 + q~2^2", first + third, low**2 + high**2, note=said)
    return [
        _row(
            "(39), platform 3",
            "resonance 3 of three masses",
            highest(True),
            top,
            known=MISPRINT,
            corrected=highest(False),
            note=link,
        ),
        sums,
        _row("(57), c", "q~1^2 q~2^2", bad_c, low**2 * high**2, known=MISPRINT, corrected=good_c, note=c_note),
        _row("(59), d", "(q~2^2 - q~1^2)^2", bad_d, (high**2 - low**2) ** 2, known=MISPRINT, corrected=good_d, note=d_note),
        _row(
            "(58)", "additional speed 1 of three masses", math.sqrt((first + third - root) / 2.0), low, note=f"{said}; d mended"
        ),
        _row(
            "(58)",
            "additional speed 2 of three masses",
            math.sqrt((first + third + root) / 2.0),
            high,
            note=f"{said}; d mended",
        ),
    ]
