"""What the antiphase paper prints: the two-mass resonance machine, its jam modes and its synthesis."""

from __future__ import annotations

import math
from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import natural_frequencies, steady_displacement
from jaxvib.machine.dimensionless import Dimensionless
from jaxvib.machine.platforms import Platforms
from jaxvib.machine.scene import Scene
from jaxvib.numerics.roots import bracketed_root
from jaxvib.steady.branches import branches
from jaxvib.steady.jams.jam import jam_modes
from jaxvib.study.published.entry import MISPRINT, PaperAnswer, PublishedRow, compared

__all__ = ["antiphase_paper", "antiphase_scene"]

_PAPER = "antiphase"

_BIFURCATIONS = ((0.3339, 0.7978), (0.3806, 0.4141), (1.0015, 5.1829), (1.2154, 1.3932))
"""(41), (42): load speeds where jams appear or vanish, each with its rotor speed; (42) lists these in another order."""

_OTHER = ((0.3, 0.5), 0.6, 1.3)
"""n1 and n2, n12, rho of a machine whose supports are not alike, on which general formulas are tried."""


def antiphase_scene(speed: float = 3.0, count: int = 1, beta: float = 1.0) -> Scene:
    """The paper's machine, (40), with light loads; `count` of them with the drag `beta` each.

    >>> antiphase_scene().loads.count
    1
    """
    return _form((1 / 3, 1 / 3), 2 / 3, 1.0, speed=speed, count=count, beta=beta).scene()


def _form(
    natural: tuple[float, float],
    link_natural: float,
    rho: float,
    damping: tuple[float, float, float] = (0.01, 0.01, 0.01),
    *,
    speed: float = 3.0,
    count: int = 1,
    beta: float = 1.0,
) -> Dimensionless:
    """`damping` h1, h2, h12."""
    return Dimensionless(
        "antiphase",
        natural=natural,
        link_natural=link_natural,
        rho=rho,
        damping=damping[:2],
        link_damping=damping[2],
        eps=1e-4,
        beta=beta,
        speed=speed,
        count=count,
    )


def antiphase_paper() -> PaperAnswer:
    """Equations (13), (16), (29), the numbers (40) to (42) and what the text says of modes and of three loads.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> answer = antiphase_paper()
    >>> [row.verdict for row in answer.rows if row.verdict != "reproduced"]
    ['misprint']
    """
    rows = [*_numbers(), *_formulas()]
    scene = antiphase_scene()

    def modes(count: int):
        return lambda: branches(antiphase_scene(count=count, beta=float(count))).plot()

    return PaperAnswer(rows, {"figure_2_to_4a": modes(1), "figure_3b_4b": modes(3), "modes": lambda: jam_modes(scene).plot()})


def _numbers() -> list[PublishedRow]:
    scene = antiphase_scene()
    resonances, modes = natural_frequencies(scene), jam_modes(scene)
    folds = modes.folds
    rows = [
        compared(_PAPER, "5.3, after (40)", "resonance 1", 0.3333, float(resonances[0]), within=5e-5),
        compared(_PAPER, "5.3, after (40)", "resonance 2", 1.0, float(resonances[1]), within=5e-5),
    ]
    for k, (omega, speed) in enumerate(_BIFURCATIONS):
        rows.append(compared(_PAPER, "(41)", f"bifurcation {k + 1}, loads", omega, float(folds.omega[k]), within=5e-5))
        rows.append(compared(_PAPER, "(42)", f"bifurcation {k + 1}, rotor", speed, float(folds.rotor_speed[k]), within=5e-5))
    count = int(jnp.sum(folds.exists)) + 1
    rows.append(compared(_PAPER, "5.2.2, abstract", "jam modes", 5.0, float(count), within=0.0, note="pieces between folds"))
    one = modes.select(3)
    three = jam_modes(antiphase_scene(count=3, beta=3.0)).select(3)
    ratio, larger = float(three.amplitude[1] / one.amplitude[1]), float(three.foundation_force / one.foundation_force)
    said = "three loads, each with three times the drag, mode 3 at n = 3"
    # A result's amplitudes are lengths: in both machines the length y~ of one load.
    rows.append(compared(_PAPER, "5.3, figures 3, 4", "amplitude with three loads", 3.0, ratio, within=1e-6, note=said))
    rows.append(compared(_PAPER, "5.3, figures 3, 4", "force with three loads", 3.0, larger, within=1e-6, note=said))
    return rows


def _formulas() -> list[PublishedRow]:
    (n1, n2), n12, rho = _OTHER
    form = _form(*_OTHER, (0.0, 0.0, 0.0))
    still = form.scene()
    stiffness = cast(Platforms, still.machine).stiffness
    ideal = math.sqrt(n1**2 * n2**2 + n12**2 * n1**2 + rho * n12**2 * n2**2) / n2

    @jax.jit
    def quiet(near: Array) -> tuple[Array, Array]:
        """The speed near that one at which the supports' forces cancel, and the platforms' motion there."""
        omega = bracketed_root(lambda w: jnp.sum(stiffness * steady_displacement(still, w).imag), 0.9 * near, 1.1 * near)
        return omega, -form.read(amplitude=steady_displacement(still, omega).imag)["amplitude"]

    found, both = quiet(jnp.asarray(ideal))
    said = f"n1 = {n1}, n2 = {n2}, n12 = {n12}, rho = {rho}"
    row = partial(compared, _PAPER, within=1e-9, kind="formula")
    (h1, h2, h12), omega = (0.02, 0.05, 0.01), 0.7
    damped = _form(*_OTHER, (h1, h2, h12))
    answer = jax.jit(steady_displacement)(damped.scene(), jnp.asarray(omega))
    computed = float(jnp.abs(damped.read(amplitude=answer)["amplitude"][1]))
    printed, corrected = (_platform_2(omega, (n1, n2), n12, (h1, h2), h12, rho, own) for own in (0, 1))
    note = (
        "a33 = n2^2 + n12^2 - W^2, a34 = -2 W (h2 + h12): the exciter's platform stands on its own support, whose numbers 2 "
        f"are printed as 1; it matters where supports differ ({said}, h1 = {h1}, h2 = {h2}, h12 = {h12}, W = {omega}); proved "
        "by the machine's equations, solved for the steady motion"
    )
    return [
        row("(16)", "speed at which the supports' forces cancel", ideal, float(found), note=said),
        row("(13)", "platform 1 there", n2**2 / (n1**2 - n2**2), float(both[0]), note=said),
        row("(13)", "platform 2 there", -(n1**2) / (n1**2 - n2**2), float(both[1]), note=said),
        row("(29), a33, a34", "amplitude of platform 2", printed, computed, known=MISPRINT, corrected=corrected, note=note),
    ]


def _platform_2(
    omega: float, natural: tuple[float, float], n12: float, damping: tuple[float, float], h12: float, rho: float, own: int
) -> float:
    """Amplitude of platform 2 by the determinants (27) to (30), s = 1; `own` 0 with the support of platform 1 in a33, a34."""
    (n1, h1), (n, h) = (natural[0], damping[0]), (natural[own], damping[own])
    one = n1**2 + rho * n12**2 - omega**2 + 2j * omega * (h1 + rho * h12)
    two = n**2 + n12**2 - omega**2 + 2j * omega * (h + h12)
    link = n12**2 + 2j * omega * h12
    # The four real equations are two complex ones: a11 - i a12, a33 - i a34, a13 - i a14.
    return float(abs(np.linalg.solve(np.array([[one, -link], [-rho * link, two]]), np.array([0.0, omega**2]))[1]))
