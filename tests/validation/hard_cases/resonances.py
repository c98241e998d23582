"""Hard cases of jams: folds, damping that is none or too much, natural frequencies that coincide."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hard_cases.case import Answer, Case, Reference
from hard_cases.reference_integration import orbit_speed
from hard_cases.reference_model import light_modes, light_speed, platforms, reference_model
from hard_cases.shared import away, final_state, jam_case, light_force_slope, published, run_case
from jaxvib.equations.linear import natural_frequencies
from jaxvib.machine.drives.drive import ConstantSpeed
from jaxvib.machine.loads import balls
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import three_mass
from jaxvib.results.status import status_name
from jaxvib.steady.jams.jam import jam_modes
from jaxvib.steady.orbits.jam_orbit import jam_orbit

__all__ = ["CASES"]

_LIGHT_FOLD, _EXACT_FOLD = 5.18285890976257, 5.2028247151614755
"""Rotor speeds of the third fold of the published machine, of light loads and of a load of eps = 0.05: where the questions
are asked. What is right there the references find for themselves."""


def _exact(modes: tuple[int, ...]) -> tuple[Callable[[Scene], Answer], Callable[[Scene], Reference]]:
    """Load speeds of exact jams near the third fold, and by shooting on both sides of it."""

    def answer(scene: Scene) -> Answer:
        orbits = [jam_orbit(scene, mode=mode, throw=False) for mode in modes]
        names = [status_name(orbit.status) for orbit in orbits]
        other = [name for name in names if name != "found"]
        speeds = np.sort([float(orbit.omega) for orbit in orbits])
        return Answer(speeds, max(float(orbit.error) for orbit in orbits), other[0] if other else "")

    def reference(scene: Scene) -> Reference:
        p = reference_model(scene)
        speed, moved, _ = light_speed(p, 1.0022684)
        start = np.concatenate([moved.imag, 1.0022684 * moved.real, [0.0, 1.0022684]])
        # slopes are 30 to 30,000 times as steep as the accuracy of shooting, 1e-13, is good for
        return Reference(orbit_speed(p, 1.0022684 - 1e-3, 1.0022684 + 1e-3, start, speed), unknown=1e-9)

    return answer, reference


def _force_slopes(scene: Scene) -> Answer:
    """Derivatives of the foundation force of the slowest jam by the logarithm of each stiffness, by reverse mode."""
    mode = jam_modes(scene).mode_numbers()[0]

    def force(s: Scene) -> jnp.ndarray:
        return jam_modes(s).select(mode, throw=False).foundation_force

    slopes, machine = platforms(eqx.filter_grad(force)(scene)), platforms(scene)
    supports, links = slopes.stiffness * machine.stiffness, slopes.link_stiffness * machine.link_stiffness
    return Answer(jnp.concatenate([supports, links]))


def _force_slopes_again(scene: Scene) -> Reference:
    slowest = light_modes(reference_model(scene), float(scene.drive.speed))[0]
    return Reference(light_force_slope(scene, slowest), unknown=1e-8)


def _foundation_only(speed: float = 3.0) -> Scene:
    """The published machine with a link that is not there: only the exciter's platform can move."""
    return published(speed, link_natural=0.0, link_damping=0.0)


def _alike(link: float) -> Scene:
    """Three platforms of one natural frequency, joined by links of the stiffness `link`, N/m."""
    machine = three_mass(
        mass=(2.0, 1.0, 2.0),
        stiffness=(2e4, 2e4, 2e4),  # with the load 2 kg each
        damping=(4.0, 4.0, 4.0),
        link_stiffness=(link, 0.0, link),
        link_damping=(0.0, 0.0, 0.0),
        exciter=2,
    )
    return Scene(machine, balls(count=1, mass=1.0, radius=0.01, drag=30.0), ConstantSpeed(200.0))


def _frequencies(scene: Scene) -> Answer:
    """Natural frequencies, and the derivative of the sum of their squares by each stiffness."""

    def total(s: Scene) -> jnp.ndarray:
        return jnp.sum(natural_frequencies(s) ** 2)

    slopes = platforms(eqx.filter_grad(total)(scene))
    found = natural_frequencies(scene)
    return Answer(jnp.concatenate([found / 100.0, slopes.stiffness, slopes.link_stiffness]))


def _frequencies_again(scene: Scene) -> Reference:
    """Frequencies by a symmetric eigenproblem; the sum of squares is the trace of M^-1 K, whose derivatives are inverse
    masses."""
    p = reference_model(scene)
    mass = np.diag(p.whole_mass)
    root = np.sqrt(mass)
    found = np.sqrt(np.linalg.eigvalsh(p.stiffness / root[:, None] / root))
    links = [sum(1.0 / mass[end - 1] for end in pair) for pair in platforms(scene).links]
    return Reference(np.concatenate([found / 100.0, 1.0 / mass, np.array(links)]))


_RUN, _RUN_AGAIN = final_state(40.0, lambda scene: away(scene, displacement=1.0))

CASES = (
    *(
        jam_case(
            f"fold of light loads, 1e-8 {side}",
            hard="two modes merge: the load speed has an infinite slope, and the 8th digit of the rotor speed decides "
            "whether they exist",
            scene=lambda sign=sign: published(_LIGHT_FOLD * (1.0 + sign * 1e-8)),
            named=((), ("at_fold",)),
        )
        for side, sign in (("below", -1.0), ("above", 1.0))
    ),
    *(
        Case(
            f"exact fold, 1e-8 {side}",
            hard="two periodic motions merge: Newton's method has a singular matrix there",
            quantity="load speeds of the exact jams 3 and 4",
            against="shooting with SciPy at 9 load speeds, interpolated",
            scene=lambda sign=sign: published(_EXACT_FOLD * (1.0 + sign * 1e-8), eps=0.05),
            answer=_exact((3, 4))[0],
            reference=_exact((3, 4))[1],
            within=(1e-8, 1e-3),
            named=(() if sign < 0.0 else ("absent",), ("found", "at_fold")),
        )
        for side, sign in (("below", -1.0), ("above", 1.0))
    ),
    jam_case(
        "no damping at all",
        hard="the vibration is unbounded at a resonance, and exerts no torque at other speeds",
        scene=lambda: published(damping=0.0),
    ),
    jam_case(
        "damping 1e-8 of critical",
        hard="peaks of relative width 1e-8 and height 1e8 lie between the points of any uniform grid",
        against="roots of n(Omega) - n between points that approach the resonances to 1e-15",
        scene=lambda: published(damping=1e-8),
    ),
    jam_case(
        "overdamped, modes",
        hard="there is no resonance and no fold, and one mode remains",
        scene=lambda: published(damping=5.0),
    ),
    run_case(
        "overdamped, run",
        hard="decay rates with a ratio of 2e4 make the equations stiff",
        scene=lambda: published(damping=50.0, eps=0.05),
        answer=_RUN,
        reference=_RUN_AGAIN,
        within=(1e-6, 1e-2),
    ),
    Case(
        "n1 = n2 exactly, gradient",
        hard="equal partial natural frequencies of the platforms; a formula of the criterion paper divides 0 by 0 there",
        quantity="derivatives of the foundation force of the slowest jam with respect to each stiffness",
        against="finite differences of dense complex linear algebra",
        scene=published,
        answer=_force_slopes,
        reference=_force_slopes_again,
        within=(1e-6, 2e-2),
    ),
    jam_case(
        "link of stiffness 0",
        hard="a platform without excitation has a resonance that does not act on the loads",
        scene=_foundation_only,
    ),
    Case(
        "link of 1e-9, gradient",
        hard="two natural frequencies differ by 1e-9",
        quantity="derivatives of the foundation force of the slowest jam with respect to each stiffness",
        against="finite differences of dense complex linear algebra",
        scene=lambda: published(0.6, link_natural=1e-5, link_damping=0.0),
        answer=_force_slopes,
        reference=_force_slopes_again,
        within=(1e-5, 5e-2),
    ),
    Case(
        "three platforms alike, no links",
        hard="a threefold natural frequency: the derivative of one of the three does not exist, that of their sum does",
        quantity="natural frequencies, and derivatives of the sum of their squares",
        against="symmetric eigenvalue problem, and the trace of M^-1 K",
        scene=lambda: _alike(0.0),
        answer=_frequencies,
        reference=_frequencies_again,
        within=(1e-12, 1e-5),
    ),
    Case(
        "three platforms alike, weak links",
        hard="three natural frequencies differ by 1e-9, and derivatives of each are inversely proportional to this difference",
        quantity="natural frequencies, and derivatives of the sum of their squares",
        against="symmetric eigenvalue problem, and the trace of M^-1 K",
        scene=lambda: _alike(2e-5),
        answer=_frequencies,
        reference=_frequencies_again,
        within=(1e-6, 1e-2),
    ),
    jam_case(
        "three platforms alike, jams",
        hard="three resonances have the same frequency, and only one of them acts on the load",
        scene=lambda: _alike(0.0),
    ),
)
