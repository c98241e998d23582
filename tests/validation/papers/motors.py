"""Numbers of papers on motors that a resonance catches."""

from __future__ import annotations

import functools
import itertools
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxvib.equations.linear import jammed_model, natural_frequencies
from jaxvib.machine.drives.drive import ConstantSpeed, DCMotor
from jaxvib.machine.loads import balls
from jaxvib.machine.scene import Exciter, Scene
from jaxvib.machine.structures.platforms import one_mass
from jaxvib.steady.jams.folds import rotor_speed_at
from jaxvib.steady.jams.jam import jam_modes
from papers.printed import PrintedNumber

__all__ = ["NUMBERS"]

_FRAME, _MOTOR, _ECCENTRICITY = 4.9, 2.45, 8.336e-3
"""Masses of the frame and of the motor, kg, and eccentricity, m, of the two-motor paper."""


def _resonance(stiffness: float) -> float:
    machine = one_mass(mass=_FRAME + _MOTOR, stiffness=stiffness, damping=5.0)
    drive = DCMotor(50.0, stall_torque=1.0, inertia=0.01)
    return float(natural_frequencies(Scene(machine, exciters=[Exciter(drive=drive, unbalance=_MOTOR * _ECCENTRICITY)]))[0])


@functools.cache
def _counts() -> tuple[tuple[int, int], ...]:
    """Numbers of jams, and of jams below the resonance, in the four ranges of the rotor speed."""
    machine = one_mass(mass=100.0, stiffness=1e4, damping=20.0)
    scene = Scene(machine, balls(count=2, mass=0.5, radius=0.1, drag=0.2), ConstantSpeed(20.0))
    folds = np.sort(np.asarray(jam_modes(scene).folds.rotor_speed))
    resonance = natural_frequencies(scene)[0]
    ends = [0.5 * folds[0], folds[0], float(rotor_speed_at(jammed_model(scene), resonance)), folds[1], 1.5 * folds[1]]
    found = []
    for low, high in itertools.pairwise(ends):
        changed = eqx.tree_at(lambda s: s.drive.speed, scene, jnp.asarray(0.5 * (low + high)))
        omega = np.asarray(jam_modes(changed).omega)
        omega = omega[np.isfinite(omega)]
        found.append((omega.size, int(np.sum(omega < float(resonance)))))
    return tuple(found)


_frame = partial(PrintedNumber, "two motors", "table 1", unit="rad/s", within=5e-3)
_ranges = partial(PrintedNumber, "dual-frequency", "abstract", within=0.0, note="two light balls, small damping and drag")
_RANGES = ("below the first", "between the first and second", "between the second and third", "above the third")

NUMBERS = (
    _frame(
        quantity="natural frequency, 2000 N/m",
        printed=16.51,
        computed=lambda: _resonance(2000.0),
        reason="sqrt(2000/7.35) is 16.496; the springs of 2000 and 6000 N/m carry the same mass, therefore the frequencies "
        "must have the ratio sqrt(3), but 28.57/16.51 is 1.7305; with a damping of 5 N s/m the vibrational torque is largest "
        "at 16.506 rad/s",
        differs=16.4957,
    ),
    _frame(
        quantity="natural frequency, 6000 N/m",
        printed=28.57,
        computed=lambda: _resonance(6000.0),
        note="mass of 7.35 kg: frame and one motor",
    ),
    *(
        number
        for k, (where, jams, below) in enumerate(zip(_RANGES, (1, 3, 3, 1), (1, 1, 0, 0), strict=True))
        for number in (
            _ranges(
                quantity=f"jams {where} characteristic speed", printed=float(jams), computed=lambda k=k: float(_counts()[k][0])
            ),
            _ranges(
                quantity=f"jams below the resonance, at rotor speeds {where} characteristic speed",
                printed=float(below),
                computed=lambda k=k: float(_counts()[k][1]),
            ),
        )
    ),
)
"""Table 1 of the two-motor paper, and the numbers of jams in the abstract of the dual-frequency paper."""
