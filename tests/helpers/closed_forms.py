"""The criterion paper's answers for one, two and three masses, its misprints mended, in its dimensionless numbers."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

__all__ = ["one_mass_speeds", "three_mass_speeds", "two_mass_functional", "two_mass_speeds"]


def one_mass_speeds(n1: Array) -> tuple[Array, Array]:
    """Resonances (1,) and additional speeds (0,) of one mass: q1 = n1 (1 in the paper's unit of time).

    >>> [speeds.tolist() for speeds in one_mass_speeds(1.0)]
    [[1.0], []]

    Source: Filimonikhin et al. 2022, equation (12).
    """
    return jnp.asarray([n1]), jnp.zeros(0)


def two_mass_speeds(n1: Array, n2: Array, n12: Array, rho: Array) -> tuple[Array, Array]:
    """Resonances (2,) and additional speeds (1,) of two masses, the exciter on platform 2 (scalars, dimensionless).

        q_{1,2}^2 = [n1^2 + n2^2 + (1 + rho) n12^2 -/+ sqrt(D)]/2,  D = [n1^2 - n2^2 - (1 - rho) n12^2]^2 + 4 rho n12^4
        q~^2 = n1^2 + rho n12^2

    the smaller root through the product of both, which does not cancel.

    >>> [[round(float(q), 4) for q in speeds] for speeds in two_mass_speeds(1/3, 1/3, 2/3, 1.0)]
    [[0.3333, 1.0], [0.7454]]

    Source: Filimonikhin et al. 2022, equations (34)-(37).
    """
    a, b, c = n1**2, n2**2, n12**2
    high = (a + b + (1.0 + rho) * c + jnp.sqrt((a - b - (1.0 - rho) * c) ** 2 + 4.0 * rho * c**2)) / 2.0
    low = (a * b + c * (a + rho * b)) / high
    return jnp.sqrt(jnp.stack([low, high])), jnp.sqrt(jnp.stack([a + rho * c]))


def two_mass_functional(
    q: Array, natural: tuple[Array, Array], n12: Array, damping: tuple[Array, Array], h12: Array, rho: Array
) -> Array:
    """X3(q, s)/s of two damped masses: in-phase amplitude of the exciter's platform, of the functional's sign.

        X3 = s q^2 { rho [a11 (a14^2 - a13^2) - 2 a12 a13 a14] + a33 (a11^2 + a12^2) } / Delta
        Delta = {a11 a33 - rho (a13^2 - a14^2) - a12 a34}^2 + {2 rho a13 a14 - a12 a33 - a11 a34}^2

    **Arguments** (dimensionless): `q` speed; `natural` (n1, n2), `damping` (h1, h2) of the supports; `n12`, `h12` of
    the link.

    >>> round(float(two_mass_functional(0.5, (1/3, 1/3), 2/3, (0.01, 0.01), 0.01, 1.0)), 3)
    -0.729

    Source: Filimonikhin et al. 2022, equations (26), (29)-(31).
    """
    (n1, n2), (h1, h2) = natural, damping
    a11, a12 = n1**2 + rho * n12**2 - q**2, -2.0 * q * (h1 + rho * h12)
    a13, a14 = -(n12**2), 2.0 * q * h12
    a33, a34 = n2**2 + n12**2 - q**2, -2.0 * q * (h2 + h12)
    top = rho * (a11 * (a14**2 - a13**2) - 2.0 * a12 * a13 * a14) + a33 * (a11**2 + a12**2)
    in_phase = a11 * a33 - rho * (a13**2 - a14**2) - a12 * a34
    quarter = 2.0 * rho * a13 * a14 - a12 * a33 - a11 * a34
    return q**2 * top / (in_phase**2 + quarter**2)


def three_mass_speeds(
    natural: tuple[Array, Array, Array], link: tuple[Array, Array, Array], rho: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Resonances (3,) and additional speeds (2,) of three masses, the exciter on platform 2 (scalars, dimensionless).

        a11 a33 a55 - a11 a35 a53 - a13 a31 a55 + a13 a51 a35 + a31 a15 a53 - a15 a33 a51 = 0      (a cubic in q^2)
        q~_{1,2}^2 = (b -/+ sqrt(d))/2,   b = n1^2 + rho1 (n12^2 + n13^2) + n3^2 + rho3 (n23^2 + n13^2)
        d = {n1^2 + rho1 (n12^2 + n13^2) - [n3^2 + rho3 (n23^2 + n13^2)]}^2 + 4 rho1 rho3 n13^4
        c = (n1^2 + rho1 n12^2) [n3^2 + rho3 (n23^2 + n13^2)] + rho1 n13^2 (n3^2 + rho3 n23^2)

    **Arguments**: `natural` (n1, n2, n3); `link` (n12, n13, n23); `rho` (rho1, rho3).

    >>> speeds = three_mass_speeds((1.0, 1.0, 1.0), (1.0, 0.0, 1.0), (1.0, 1.0))
    >>> [[round(float(q), 4) for q in kind] for kind in speeds]
    [[1.0, 1.4142, 2.0], [1.4142, 1.4142]]

    Source: Filimonikhin et al. 2022, equations (47), (54)-(59); c and d as printed there hold misprints, mended here.
    """
    (a, b, e), (c12, c13, c23), (rho1, rho3) = ([jnp.square(x) for x in natural], [jnp.square(x) for x in link], rho)
    first = a + rho1 * (c12 + c13)
    second = b + c12 + c23
    third = e + rho3 * (c13 + c23)
    # Products a13 a31, a15 a51, a35 a53 and the triple a13 a35 a51 of the matrix, whose diagonal is `first` - q^2, ...
    p12, p13, p23 = rho1 * c12**2, rho1 * rho3 * c13**2, rho3 * c23**2
    sum_two = first * second + second * third + third * first - p12 - p13 - p23
    product = first * second * third - first * p23 - second * p13 - third * p12 - 2.0 * rho1 * rho3 * c12 * c13 * c23
    resonances = jnp.sqrt(_cubic(first + second + third, sum_two, product))

    root = jnp.sqrt((first - third) ** 2 + 4.0 * p13)
    high = (first + third + root) / 2.0
    low = ((a + rho1 * c12) * third + rho1 * c13 * (e + rho3 * c23)) / high
    return resonances, jnp.sqrt(jnp.stack([low, high]))


def _cubic(s1: Array, s2: Array, s3: Array) -> Array:
    """Ascending roots of x^3 - s1 x^2 + s2 x - s3, all real (Viete), each improved by one Newton step."""
    centre = s1 / 3.0
    spread = jnp.sqrt(jnp.maximum(s1**2 - 3.0 * s2, 0.0)) / 3.0
    half = centre**3 - centre * s2 / 2.0 + s3 / 2.0
    safe = jnp.where(spread > 0.0, spread, 1.0)
    angle = jnp.arccos(jnp.clip(jnp.where(spread > 0.0, half / safe**3, 1.0), -1.0, 1.0)) / 3.0
    x = centre + 2.0 * spread * jnp.cos(angle + jnp.asarray([2.0, 4.0, 0.0]) * jnp.pi / 3.0)
    value = ((x - s1) * x + s2) * x - s3
    slope = (3.0 * x - 2.0 * s1) * x + s2
    return x - jnp.where(slope == 0.0, 0.0, value / jnp.where(slope == 0.0, 1.0, slope))
