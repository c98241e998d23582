"""Numbers of the rotor paper: a rigid rotor with four pendulums, its critical speeds and where its pendulums jam."""

from __future__ import annotations

import functools
import math
from functools import partial
from typing import cast

import jax.numpy as jnp
import numpy as np

from jaxvib.machine.drives.drive import ConstantSpeed
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.rotor import Rotor, rotor
from jaxvib.steady.jams.phase_search import PhaseBranch, phase_branch
from jaxvib.steady.jams.phases import phase_jam
from jaxvib.steady.whirl import critical_speeds
from jaxvib.study.maps.run_up_map import RunUpMap
from papers.machines import published_rotor, rotor_run_up_map
from papers.printed import Misprint, PrintedNumber

__all__ = ["NUMBERS"]

_BOTH = "uncoupled, both dampers"

_FIRST, _SECOND = 9.2e-4, 1.235e-2
"""mu, N m s, at which the corrected data jam at the two printed speeds."""

_TRIED = (5e-5, 3e-4, _FIRST, _SECOND, 1.5e-2, 1.75e-2, 3e-2, 5e-2)
"""mu, N m s, of the run-ups."""

_CRITICAL = (176.69, 274.76)

_L1, _L2, _B1, _B2 = 0.165, 0.155, 843.17, -0.47
"""Distances of the supports, m, and the printed damping terms b1 = b_1 + b_2 and b2 = b_1 L1 - b_2 L2."""

_DAMPER_1 = (_B1 * _L2 + _B2) / (_L1 + _L2)
_DAMPER_2 = _B1 - _DAMPER_1


@functools.cache
def _nearest_critical_speeds() -> list[float]:
    """Critical speeds of that one of four readings (c2 as printed or 0, with pendulums or without) which is nearest to the
    printed speeds."""
    readings = []
    for variant in ("printed", "uncoupled"):
        for loads in ("none", "fixed"):
            found = critical_speeds(published_rotor(variant=variant), loads=loads)
            readings.append(np.asarray(found.speed)[np.asarray(found.forward)])
    return min(readings, key=lambda speeds: float(np.sum((speeds / _CRITICAL - 1.0) ** 2))).tolist()


def _mean_distance() -> float:
    return float(np.mean(np.abs(np.asarray(cast(Rotor, published_rotor().machine).stations))))


def _tilt_damping() -> float:
    """b3 of a rotor on the two dampers that b1 and b2 ask for; the coordinates are y, z, theta, psi."""
    inertias = dict(mass=37.0, transverse_inertia=0.479, polar_inertia=0.093)
    own = rotor(**inertias, stiffness=(6e5, 6e5), damping=(_DAMPER_1, _DAMPER_2), position=(_L1, -_L2))
    damping = np.asarray(own.carrier().damping)
    np.testing.assert_allclose([damping[0, 0], damping[0, 2]], [_B1, _B2], atol=5e-3)
    return float(damping[2, 2])


def _at_working_speed(mu: float, variant: str) -> Scene:
    scene = published_rotor(mu, variant)
    return Scene(scene.machine, scene.loads, ConstantSpeed(460.0))


def _first_jam_as_printed() -> float:
    """NaN if it is not stable."""
    jam = phase_jam(_at_working_speed(_FIRST, "printed"), jnp.asarray(169.6), jnp.zeros(4))
    return float(jam.omega) if bool(jam.stable) else math.nan


@functools.cache
def _jams(mu: float, variant: str, low: float, high: float, step: float, phase: tuple[float, ...]) -> PhaseBranch:
    scene, omega = _at_working_speed(mu, variant), np.arange(low, high, step)
    return phase_branch(scene, phase_jam(scene, omega[0], jnp.asarray(phase)), jnp.asarray(omega))


def _first_jams() -> PhaseBranch:
    return _jams(_FIRST, "uncoupled", 169.0, 171.0, 0.02, (0.0,) * 4)


def _second_jams() -> PhaseBranch:
    return _jams(_SECOND, "printed", 269.0, 281.0, 0.5, (0.0, 0.1, math.pi, math.pi))


def _holding(branch: PhaseBranch, mu: float, omega: float) -> float:
    """Friction that holds a jam at this speed."""
    return float(np.interp(omega, np.asarray(branch.omega), mu * np.asarray(branch.drag_factor)))


def _last_stable() -> float:
    branch = _first_jams()
    return float(np.max(_FIRST * np.asarray(branch.drag_factor)[np.asarray(branch.stable)]))


def _second_in_the_middle() -> float:
    branch = _second_jams()
    return float(np.interp(1.75e-2, _SECOND * np.asarray(branch.drag_factor), np.asarray(branch.omega)))


_HALF_WINDOW = 0.0123
"""Half of the range of lengths of a pendulum with which the printed range of friction holds 169.6 rad/s, m."""


def _length() -> float:
    """Middle of that range: the friction that holds a jam grows as (m l)^2."""
    holds = _holding(_first_jams(), _FIRST, 169.6)
    low, high = (0.08 * math.sqrt(friction / holds) for friction in (0.5e-3, 1.0e-3))
    return 0.5 * (low + high)


@functools.cache
def _run_up_map() -> RunUpMap:
    return rotor_run_up_map(_TRIED, _BOTH)


def _ended(kind: str) -> list[float]:
    """Frictions tried whose run-up ends in this kind of motion."""
    return [mu for mu, found in zip(_TRIED, _run_up_map().kind[:, 0], strict=True) if found == kind]


def _speed(mu: float) -> float:
    return float(_run_up_map().omega[_TRIED.index(mu), 0])


def _ripple(mu: float) -> float:
    return float(np.asarray(_run_up_map().regime.ripple)[_TRIED.index(mu), 0])


def _least_that_jams() -> float:
    """m g l/Omega: less cannot carry a pendulum over the top; 5e-5 N m s swings, 3e-4 is jammed."""
    assert _ended("swinging") == [5e-5]
    return 0.004 * 9.81 / 460.0


_READING = "run-up of 6 s with b3 of both dampers"
_ECCENTRICITY = (
    "eccentricity e = 0.22 mm, which reproduces the ripple of the first jam (the printed 25*10^-1 m^2 is not a length)"
)

_number = partial(PrintedNumber, "rotor")
_speed_number = partial(_number, "section V", unit="rad/s", within=0.05)
_friction_number = partial(_number, "section V", unit="N m s")
_measured = partial(_number, "section III", computed=None, within=0.05, unit="rad/s")

NUMBERS = (
    *(
        _number(
            "section V",
            f"critical speed {k + 1}",
            _CRITICAL[k],
            lambda k=k: _nearest_critical_speeds()[k],
            within=0.005,
            unit="rad/s",
            differs=differs,
            reason="no interpretation of the data gives both critical speeds; the closest one is c2 = 0 with four pendulums",
        )
        for k, differs in ((0, 176.51), (1, 272.81))
    ),
    _number(
        "section IV", "mean distance a of the pendulums from the centre of mass", 0.265, _mean_distance, within=5e-4, unit="m"
    ),
    _number(
        "section IV",
        "b3",
        10.41,
        _tilt_damping,
        within=5e-3,
        unit="N m s",
        note="10.41 is the contribution of one damper with L1 and L2 exchanged",
        misprint=Misprint(
            "10.41 N m s",
            "21.56 N m s",
            "sum of b L^2 over the two dampers, whose coefficients b follow from b1 (their sum) and b2 (their sum weighted "
            "with +L1 and -L2)",
            _DAMPER_1 * _L1**2 + _DAMPER_2 * _L2**2,
        ),
    ),
    _speed_number(
        quantity="first jam, data as printed",
        printed=169.6,
        computed=_first_jam_as_printed,
        reason="with the printed c2 = 13635 N there is no stable first jam at 9.2e-4 N m s",
    ),
    _friction_number(
        "friction at which the first jam has 169.6 rad/s",
        7.5e-4,
        lambda: _holding(_first_jams(), _FIRST, 169.6),
        within=2.5e-4,
        note="value and bound are the middle and the half-width of the printed range, 0.5e-3 to 1.0e-3; c2 = 0",
    ),
    _friction_number(
        "friction above which the first jam does not exist",
        1.0e-3,
        _last_stable,
        within=5e-5,
        differs=9.292e-4,
        reason="c2 = 0; above this friction, which is 7 % below the printed one, the pendulums separate",
    ),
    _number(
        "section IV",
        "length of a pendulum",
        0.8,
        _length,
        within=_HALF_WINDOW,
        unit="m",
        note="the bound is half of the range of lengths with a jam at 169.6 rad/s in the printed range of friction",
        misprint=Misprint("0.8 m", "0.08 m", "friction at which the printed jam exists", 0.08),
    ),
    _friction_number(
        "friction at which the second jam has 271.1 rad/s",
        1.75e-2,
        lambda: _holding(_second_jams(), _SECOND, 271.1),
        within=2.5e-3,
        differs=1.0224e-2,
        reason="the printed range is 1.5e-2 to 2.0e-2; data as printed",
    ),
    _speed_number(
        quantity="second jam at the middle of the printed friction range",
        printed=271.1,
        computed=_second_in_the_middle,
        differs=276.88,
        reason="at 1.75e-2 N m s, data as printed; the printed speed requires a smaller friction",
    ),
    _speed_number(
        quantity="first jam",
        printed=169.6,
        computed=lambda: _speed(_FIRST),
        note=f"mu = {_FIRST:g} N m s, inside the printed range; {_READING}",
    ),
    _speed_number(
        quantity="ripple of the first jam", printed=3.1, computed=lambda: _ripple(_FIRST), note=f"{_READING}; {_ECCENTRICITY}"
    ),
    _speed_number(
        quantity="second jam",
        printed=271.1,
        computed=lambda: _speed(_SECOND),
        note=f"mu = {_SECOND:g} N m s, chosen to give this speed, outside the printed range; {_READING}",
    ),
    _speed_number(
        quantity="ripple of the second jam",
        printed=4.6,
        computed=lambda: _ripple(_SECOND),
        differs=4.954,
        reason=f"8 % larger than in the paper, with {_ECCENTRICITY}",
    ),
    _friction_number(
        "friction below which pendulums only swing",
        0.5e-3,
        _least_that_jams,
        within=5e-5,
        differs=8.5304e-5,
        reason="m g l/w with the rotor speed w = 460 rad/s: less friction cannot carry a pendulum over the top; at 5e-5 they "
        "swing, at 3e-4 they are jammed",
    ),
    _friction_number(
        "lowest friction at which the pendulums balance the rotor",
        2.0e-2,
        lambda: min(_ended("balanced")),
        within=5e-4,
        differs=1.75e-2,
        reason=f"computed at {', '.join(f'{mu:g}' for mu in _TRIED)}; below 0.0175 they do not balance the rotor; {_READING}",
    ),
    _friction_number(
        "friction above which the pendulums do not balance the rotor",
        4.0e-2,
        lambda: min(_ended("unbalanced"), default=math.nan),
        within=5e-4,
        reason="at 5e-2 they balance the rotor within 6 s; the paper may have evaluated an earlier time or other data; "
        f"{_READING}",
    ),
    *(
        _measured(name, speed, reason="a measurement; the friction of the bearings on the test rig is not printed")
        for name, speed in (("first jam on the test rig", 165.5), ("second jam on the test rig", 251.2))
    ),
    _measured(
        "inertia below which pendulums balanced",
        0.3060,
        unit="kg cm^2",
        reason="a measurement; the moment of inertia of a pendulum is printed in kg m^2 and kg cm^2, with different digits",
    ),
)
"""The data of section IV, critical speeds, jams and limits of friction of section V, measured speeds of section III."""
