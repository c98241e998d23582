"""Numbers of the antiphase paper: the two-mass resonance machine, its jam modes and its synthesis."""

from __future__ import annotations

import functools
import math
from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import scenes
from jax import Array

from jaxvib.equations.linear import jammed_model, natural_frequencies
from jaxvib.machine.dimensionless import Dimensionless
from jaxvib.machine.structures.platforms import Platforms
from jaxvib.numerics.roots import bracketed_root
from jaxvib.steady.jams.jam import JamModes, jam_modes
from papers.printed import Misprint, PrintedNumber

__all__ = ["NUMBERS"]

_BIFURCATIONS = ((0.3339, 0.7978), (0.3806, 0.4141), (1.0015, 5.1829), (1.2154, 1.3932))
"""(41), (42): load speeds at which jams appear or vanish, each with its rotor speed; (42) lists these in another order."""

_NATURAL, _LINK, _RHO = (0.3, 0.5), 0.6, 1.3
"""n1 and n2, n12, rho of a machine whose supports differ, on which general formulas are tried."""

_DAMPING, _LINK_DAMPING, _OMEGA = (0.02, 0.05), 0.01, 0.7

_SETTING = f"n1, n2 = {_NATURAL}, n12 = {_LINK}, rho = {_RHO}"


@functools.cache
def _modes(count: int = 1) -> JamModes:
    """Jam modes of the paper's machine, (40), with `count` loads of the drag `count` each."""
    return jam_modes(scenes.published(eps=1e-4, count=count, beta=float(count)).scene())


def _resonance(k: int) -> float:
    return float(natural_frequencies(scenes.published(eps=1e-4).scene())[k])


def _ratio(quantity: str, *which: int) -> float:
    """Ratio of a quantity of mode 3 with three loads to that with one. Amplitudes are lengths: in both machines the length y~
    of one load."""
    one, three = (np.asarray(getattr(_modes(count).select(3), quantity)) for count in (1, 3))
    return float((three / one)[which])


def _other(damping: tuple[float, float], link_damping: float) -> Dimensionless:
    change = dict(natural=_NATURAL, link_natural=_LINK, link_damping=link_damping, rho=_RHO)
    return scenes.published(eps=1e-4, damping=damping, **change)


def _ideal() -> float:
    (n1, n2), n12 = _NATURAL, _LINK
    return math.sqrt(n1**2 * n2**2 + n12**2 * n1**2 + _RHO * n12**2 * n2**2) / n2


@functools.cache
def _quiet() -> tuple[float, float, float]:
    """The speed at which the supports' forces cancel, and the platforms' motion there."""
    form = _other((0.0, 0.0), 0.0)
    scene, near = form.scene(), _ideal()
    light, stiffness = jammed_model(scene), cast(Platforms, scene.machine).stiffness

    @jax.jit
    def solve() -> tuple[Array, Array]:
        omega = bracketed_root(
            lambda w: jnp.sum(stiffness * light.displacement(w).imag), jnp.asarray(0.9 * near), jnp.asarray(1.1 * near)
        )
        return omega, -form.convert_results(amplitude=light.displacement(omega).imag)["amplitude"]

    omega, (first, second) = solve()
    return float(omega), float(first), float(second)


def _platform_2() -> float:
    """Amplitude of platform 2 with damping, from the machine's equations."""
    form = _other(_DAMPING, _LINK_DAMPING)
    answer = jax.jit(lambda scene: jammed_model(scene).displacement(jnp.asarray(_OMEGA)))(form.scene())
    return float(jnp.abs(form.convert_results(amplitude=answer)["amplitude"][1]))


def _platform_2_again(own: int) -> float:
    """The same by the determinants (27) to (30), s = 1; `own` 0 with the support of platform 1 in a33, a34, as printed."""
    (n1, h1), (n, h), n12, h12 = (_NATURAL[0], _DAMPING[0]), (_NATURAL[own], _DAMPING[own]), _LINK, _LINK_DAMPING
    one = n1**2 + _RHO * n12**2 - _OMEGA**2 + 2j * _OMEGA * (h1 + _RHO * h12)
    two = n**2 + n12**2 - _OMEGA**2 + 2j * _OMEGA * (h + h12)
    link = n12**2 + 2j * _OMEGA * h12
    # The four real equations are two complex ones: a11 - i a12, a33 - i a34, a13 - i a14.
    return float(abs(np.linalg.solve(np.array([[one, -link], [-_RHO * link, two]]), np.array([0.0, _OMEGA**2]))[1]))


_number = partial(PrintedNumber, "antiphase")
_formula = partial(PrintedNumber, "antiphase", within=1e-9, note=_SETTING)
_three_loads = partial(
    _number, printed=3.0, within=1e-6, note="three loads, each with three times the drag of the single load; mode 3 at n = 3"
)

NUMBERS = (
    _number("5.3, after (40)", "resonance 1", 0.3333, lambda: _resonance(0), within=5e-5),
    _number("5.3, after (40)", "resonance 2", 1.0, lambda: _resonance(1), within=5e-5),
    *(
        number
        for k, (omega, speed) in enumerate(_BIFURCATIONS)
        for number in (
            _number("(41)", f"bifurcation {k + 1}, loads", omega, lambda k=k: float(_modes().folds.omega[k]), within=5e-5),
            _number(
                "(42)", f"bifurcation {k + 1}, rotor", speed, lambda k=k: float(_modes().folds.rotor_speed[k]), within=5e-5
            ),
        )
    ),
    _number(
        "5.2.2, abstract",
        "jam modes",
        5.0,
        lambda: float(np.sum(_modes().folds.exists)) + 1.0,
        within=0.0,
        note="counted as the pieces of the branch between folds",
    ),
    _three_loads("5.3, figures 3, 4", "amplitude with three loads / with one load", computed=lambda: _ratio("amplitude", 1)),
    _three_loads("5.3, figures 3, 4", "force with three loads / with one load", computed=lambda: _ratio("foundation_force")),
    _formula("(16)", "speed at which the support forces cancel", _ideal, lambda: _quiet()[0]),
    _formula(
        "(13)",
        "motion of platform 1 at the speed of (16)",
        lambda: _NATURAL[1] ** 2 / (_NATURAL[0] ** 2 - _NATURAL[1] ** 2),
        lambda: _quiet()[1],
    ),
    _formula(
        "(13)",
        "motion of platform 2 at the speed of (16)",
        lambda: -(_NATURAL[0] ** 2) / (_NATURAL[0] ** 2 - _NATURAL[1] ** 2),
        lambda: _quiet()[2],
    ),
    _formula(
        "(29), a33, a34",
        "amplitude of platform 2",
        lambda: _platform_2_again(0),
        _platform_2,
        misprint=Misprint(
            "n1, h1 of the other platform",
            "n2, h2",
            "steady motion by the equations of the machine, with unequal supports",
            lambda: _platform_2_again(1),
        ),
    ),
)
"""Equations (13), (16), (29), the numbers (40) to (42) and the statements on modes and on three loads."""
