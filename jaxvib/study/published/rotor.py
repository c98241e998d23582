"""What the rotor paper prints: a rigid rotor with four pendulums, its critical speeds and where its pendulums jam."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, cast

import jax.numpy as jnp
import numpy as np

from jaxvib.machine.drive import ConstantSpeed
from jaxvib.machine.rotor import Rotor, rotor
from jaxvib.machine.scene import Scene
from jaxvib.motion.simulate import simulate
from jaxvib.steady.jams.phase_branch import PhaseBranch
from jaxvib.steady.jams.phase_search import phase_branch
from jaxvib.steady.jams.phases import phase_jam
from jaxvib.steady.whirl import critical_speeds, whirl
from jaxvib.study.maps.published_rotor import VARIANTS, published_rotor, rotor_regimes
from jaxvib.study.published.entry import MISPRINT, NOT_REPRODUCIBLE, PaperAnswer, PublishedRow, compared

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["rotor_paper"]

_PAPER = "rotor"

_BOTH = "uncoupled, both dampers"

_FIRST, _SECOND = 9.2e-4, 1.235e-2
"""mu, N m s, at which the corrected data jam at the two printed speeds."""

_TRIED = (5e-5, 3e-4, _FIRST, _SECOND, 1.5e-2, 1.75e-2, 3e-2, 5e-2)
"""mu, N m s, of the run-ups."""

_row = partial(compared, _PAPER)


def rotor_paper() -> PaperAnswer:
    """Section IV's data, section V's critical speeds, jams and limits of friction, section III's measured speeds.

    >>> from jaxvib.study.published.rotor import rotor_paper
    >>> callable(rotor_paper)
    True
    """
    rows = [*_critical_speeds(), *_data(), *_jams(), *_run_ups(), *_measured()]
    return PaperAnswer(
        rows, {"campbell": lambda: whirl(published_rotor(), np.linspace(0.0, 600.0, 121)).plot(), "figure_4_curve_2": _figure_4}
    )


def _figure_4() -> Figure:
    return simulate(published_rotor(_FIRST, "uncoupled"), 6.0, apart=0.0).plot()


def _critical_speeds() -> list[PublishedRow]:
    printed, found = np.array([176.69, 274.76]), {}
    for variant in ("printed", "uncoupled"):
        for loads in ("none", "fixed"):
            speeds = critical_speeds(published_rotor(variant=variant), loads=loads)
            found[variant, loads] = np.asarray(speeds.speed)[np.asarray(speeds.forward)]
    words = {"printed": "c2 as printed", "uncoupled": "c2 = 0", "none": "no pendulums", "fixed": "four pendulums"}
    nearest = min(found, key=lambda key: float(np.sum((found[key] / printed - 1.0) ** 2)))
    all_of_them = "; ".join(f"{words[v]}, {words[p]}: {w[0]:.2f}, {w[1]:.2f}" for (v, p), w in found.items())
    why = f"no reading of the data gives both. {all_of_them} (nearest: {words[nearest[0]]}, {words[nearest[1]]})"
    row = partial(_row, "section V", within=0.005, unit="rad/s", known=NOT_REPRODUCIBLE, note=why)
    return [row(f"critical speed {k + 1}", float(printed[k]), float(found[nearest][k])) for k in (0, 1)]


def _data() -> list[PublishedRow]:
    machine = cast(Rotor, published_rotor().machine)
    stations = np.abs(np.asarray(machine.stations))
    l1, l2, b1, b2 = 0.165, 0.155, 843.17, -0.47
    first = (b1 * l2 + b2) / (l1 + l2)
    swapped = (b1 * l1 + b2) / (l1 + l2) * l2**2
    second = b1 - first
    own = rotor(
        mass=37.0,
        transverse_inertia=0.479,
        polar_inertia=0.093,
        stiffness=(6e5, 6e5),
        damping=(first, second),
        position=(l1, -l2),
    )
    damping = np.asarray(own.carrier().damping)
    # The coordinates are y, z, theta, psi.
    note = (
        "b3 = b_1 L1^2 + b_2 L2^2 of the two dampers that b1 = b_1 + b_2 and b2 = b_1 L1 - b_2 L2 ask for; the printed number "
        f"is one damper's share alone, with L1 and L2 exchanged ({swapped:.2f}); proved by the damping matrix of a rotor on "
        f"these dampers, which has b1 = {damping[0, 0]:.2f} and b2 = {damping[0, 2]:.2f}"
    )
    both = first * l1**2 + second * l2**2
    return [
        _row("section IV", "mean distance a", 0.265, float(np.mean(stations)), within=5e-4, unit="m"),
        _row(
            "section IV",
            "b3",
            10.41,
            float(damping[2, 2]),
            within=5e-3,
            unit="N m s",
            known=MISPRINT,
            corrected=both,
            note=note,
        ),
    ]


def _still(mu: float, variant: str) -> Scene:
    """The rotor at its working speed, as theories of jams ask."""
    scene = published_rotor(mu, variant)
    return Scene(scene.machine, scene.loads, ConstantSpeed(460.0))


def _held(mu: float, variant: str, omega: np.ndarray, phase: list[float]) -> tuple[PhaseBranch, Callable[[float], float]]:
    """Jams at the speeds `omega`, and the mu that holds one of them."""
    scene = _still(mu, variant)
    branch = phase_branch(scene, phase_jam(scene, omega[0], jnp.asarray(phase)), jnp.asarray(omega))
    return branch, lambda w: float(np.interp(w, np.asarray(branch.omega), mu * np.asarray(branch.drag_factor)))


def _jams() -> list[PublishedRow]:
    near = phase_jam(_still(_FIRST, "printed"), jnp.asarray(169.6), jnp.zeros(4))
    as_printed = float(near.omega) if bool(near.stable) else math.nan
    branch, friction = _held(_FIRST, "uncoupled", np.arange(169.0, 171.0, 0.02), [0.0] * 4)
    holds, stable = friction(169.6), np.asarray(branch.stable)
    last = float(np.max(_FIRST * np.asarray(branch.drag_factor)[stable]))
    opposite = [0.0, 0.1, math.pi, math.pi]
    second = {v: _held(_SECOND, v, np.arange(269.0, 281.0, 0.5), opposite) for v in ("printed", _BOTH)}
    middle = {
        v: float(np.interp(1.75e-2, _SECOND * np.asarray(b.drag_factor), np.asarray(b.omega))) for v, (b, _) in second.items()
    }
    low, high = 0.08 * math.sqrt(0.5e-3 / holds), 0.08 * math.sqrt(1.0e-3 / holds)
    length = (
        "l = 0.08 m, a power of ten; what holds a jam grows as (m l)^2, so that the printed window of friction holds 169.6 "
        f"rad/s with lengths from {low:.3f} to {high:.3f} m, with 0.8 m only a friction a hundred times as large"
    )
    window = partial(_row, unit="N m s", within=2.5e-3, known=NOT_REPRODUCIBLE)
    return [
        _row(
            "section V",
            "first jam, data as printed",
            169.6,
            as_printed,
            within=0.05,
            unit="rad/s",
            known=NOT_REPRODUCIBLE,
            note=f"with the printed c2 = 13635 N no first jam is stable at mu = {_FIRST:g}; with c2 = 0 see below",
        ),
        _row(
            "section V",
            "friction that holds 169.6 rad/s",
            7.5e-4,
            holds,
            within=2.5e-4,
            unit="N m s",
            note="the printed window, 0.5e-3 to 1.0e-3, is its middle and bound; c2 = 0",
        ),
        _row(
            "section V",
            "friction above which the first jam is gone",
            1.0e-3,
            last,
            within=5e-5,
            unit="N m s",
            known=NOT_REPRODUCIBLE,
            note="c2 = 0; the pendulums part from each other at less, by 7 %",
        ),
        _row(
            "section IV",
            "pendulum's length",
            0.8,
            0.5 * (low + high),
            within=0.5 * (high - low),
            unit="m",
            known=MISPRINT,
            corrected=0.08,
            note=length,
        ),
        window(
            "section V",
            "friction that holds 271.1 rad/s",
            1.75e-2,
            second["printed"][1](271.1),
            note=(
                f"the printed window is 1.5e-2 to 2.0e-2; data as printed. With c2 = 0 and both dampers "
                f"{second[_BOTH][1](271.1):.3g}"
            ),
        ),
        _row(
            "section V",
            "second jam in the middle of its window",
            271.1,
            middle["printed"],
            within=0.05,
            unit="rad/s",
            known=NOT_REPRODUCIBLE,
            note=(
                f"at 1.75e-2, data as printed; with c2 = 0 and both dampers {middle[_BOTH]:.1f}. The printed "
                f"speed needs less friction"
            ),
        ),
    ]


def _run_ups() -> list[PublishedRow]:
    """What full run-ups of 6 s come to, with c2 = 0 and both dampers."""
    found = rotor_regimes(_TRIED, [_BOTH], until=6.0).computed[_BOTH]
    kind, omega, ripple = found.kind[:, 0], found.omega[:, 0], np.asarray(found.regime.ripple)[:, 0]
    first, second = _TRIED.index(_FIRST), _TRIED.index(_SECOND)
    swinging, balanced = (np.asarray(_TRIED)[kind == word] for word in ("swinging", "balanced"))
    told = ", ".join(f"{mu:g}: {word}" for mu, word in zip(_TRIED, kind, strict=True))
    reading = f"run-up of 6 s with {VARIANTS[_BOTH]}"
    unbalanced = [mu for mu, word in zip(_TRIED, kind, strict=True) if word == "unbalanced"]
    limit = partial(_row, "section V", unit="N m s", known=NOT_REPRODUCIBLE)
    eccentricity = "e = 0.22 mm (the printed 25*10^-1 m^2 is no length; this one makes the ripple of the first jam)"
    return [
        _row(
            "section V",
            "first jam",
            169.6,
            float(omega[first]),
            within=0.05,
            unit="rad/s",
            note=f"mu = {_FIRST:g}, inside the printed window; {reading}",
        ),
        _row("section V", "ripple of the first jam", 3.1, float(ripple[first]), within=0.05, unit="rad/s", note=eccentricity),
        _row(
            "section V",
            "second jam",
            271.1,
            float(omega[second]),
            within=0.05,
            unit="rad/s",
            note=f"mu = {_SECOND:g}, chosen for it, outside the printed window; {reading}",
        ),
        _row(
            "section V",
            "ripple of the second jam",
            4.6,
            float(ripple[second]),
            within=0.05,
            unit="rad/s",
            known=NOT_REPRODUCIBLE,
            note=f"{eccentricity}; it is 8 % larger than the paper's",
        ),
        limit(
            "friction below which pendulums only swing",
            0.5e-3,
            0.004 * 9.81 / 460.0,
            within=5e-5,
            note=(
                f"m g l/Omega: less cannot carry a pendulum over the top; {swinging.max(initial=0.0):g} swings, 3e-4 is jammed"
            ),
        ),
        limit(
            "least friction that balances",
            2.0e-2,
            float(np.min(balanced)),
            within=5e-4,
            note=f"of the frictions tried ({told}); {reading}",
        ),
        limit(
            "friction above which nothing balances",
            4.0e-2,
            min(unbalanced, default=math.nan),
            within=5e-4,
            note=f"5e-2 balances within 6 s: the paper looked earlier, or at another data set; {reading}",
        ),
    ]


def _measured() -> list[PublishedRow]:
    row = partial(_row, "section III", computed=math.nan, within=0.05, unit="rad/s", known=NOT_REPRODUCIBLE)
    why = "a measurement; the friction of the bearings on the stand is not printed"
    inertia = "a measurement; the pendulum's moment of inertia is printed in kg m^2 and kg cm^2 and with a digit less in turn"
    return [
        row("first jam on the stand", 165.5, note=why),
        row("second jam on the stand", 251.2, note=why),
        row("inertia below which pendulums balanced", 0.3060, unit="kg cm^2", note=inertia),
    ]
