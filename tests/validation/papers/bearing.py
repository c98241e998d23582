"""Numbers of the bearing paper: friction of a pendulum's bearing, its measurement, and the radial load."""

from __future__ import annotations

import functools
import math
from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.forces import normal_force
from jaxvib.equations.state import State
from jaxvib.machine.drives.drive import ConstantSpeed
from jaxvib.machine.effects.base import Effect, Gravity
from jaxvib.machine.effects.friction import DryFriction
from jaxvib.machine.loads import pendulums
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import one_mass
from jaxvib.study.bearing.decrement import ten_periods
from jaxvib.study.bearing.record import Record
from jaxvib.study.bearing.swing import BearingPendulum, swing
from papers.printed import Misprint, PrintedNumber

__all__ = ["NUMBERS"]

_MASS, _LENGTH, _ROTOR, _JAM = 0.05, 0.08, 460.0, 169.6
"""The pendulum of the rotor paper, its rotor speed and its first jam: this paper prints no machine of its own."""

_MASS_LENGTH = _MASS * _LENGTH

_DRY, _DIAMETER = 0.0015, 0.012
"""mu2 and d, m, of the formula for dry friction."""

_ROD = BearingPendulum(mass=0.3, length=0.25, inertia=0.3 * 0.5**2 / 12.0)
"""A rod of 0.3 kg and 0.5 m, since the paper does not print the one of its measurement."""


def _viscous() -> float:
    """mu1 by the paper's formula from a swing that is integrated with the paper's mu1."""
    time = np.arange(0.0, 15.0, 0.04)
    run = swing(_ROD, time, angle="3 deg", viscous=1.5e-3)
    return ten_periods(_ROD, Record(time, run.angle)).viscous.value


def _scene(*effects: Effect) -> Scene:
    """A pendulum on a shaft that does not move."""
    machine = one_mass(mass=1e9, stiffness=1e15, damping=0.0)
    return Scene(machine, pendulums(count=1, mass=_MASS, radius=_LENGTH, drag=0.0), ConstantSpeed(_ROTOR), effects)


def _state(rate: float, angle: float | Array = 0.0) -> State:
    return State(jnp.zeros(1), jnp.zeros(1), (jnp.asarray([angle], float),), (jnp.asarray([rate], float),))


@functools.cache
def _load(rate: float) -> float:
    """Radial load without gravity, N."""
    return float(normal_force(_scene(), 0.0, _state(rate))[0])


def _share_of_gravity() -> float:
    """Per cent, at the slowest jam that the rotor paper computes."""
    heavy = (float(normal_force(_scene(Gravity()), 0.0, _state(_JAM, sign * math.pi / 2.0))[0]) for sign in (-1.0, 1.0))
    return 100.0 * max(abs(load / _load(_JAM) - 1.0) for load in heavy)


def _friction_torque() -> float:
    smooth, dry = (
        vector_field(scene)(jnp.zeros(()), _state(_JAM)).rate[0]
        for scene in (_scene(), _scene(DryFriction(_DRY, diameter=_DIAMETER)))
    )
    return float((dry - smooth)[0]) * _MASS_LENGTH * _LENGTH


_MACHINE = f"m = {_MASS} kg, l = {_LENGTH} m, w = {_ROTOR:g} rad/s"

_number = partial(PrintedNumber, "bearing")
_formula = partial(PrintedNumber, "bearing", within=1e-9)
_on_rod = partial(_formula, note="a rod of 0.3 kg and 0.5 m")
_measured = partial(_number, "after (3)", computed=None, within=0.05, unit="%")

NUMBERS = (
    _number(
        "(3)",
        "mu1 from ten periods",
        1.5e-3,
        _viscous,
        within=5e-5,
        unit="N m s",
        note="the formula applied to a simulated swing: a rod of 0.3 kg and 0.5 m, released at 3 deg, mu1 of the paper",
    ),
    _on_rod("before (3)", "J = m l^2/3", lambda: 0.3 * 0.5**2 / 3.0, lambda: float(_ROD.total_inertia), unit="kg m^2"),
    _on_rod(
        "before (3)",
        "k1 = (m g a/J)^(1/2)",
        lambda: math.sqrt(0.3 * 9.81 * 0.25 / 0.025),
        lambda: float(_ROD.frequency),
        unit="rad/s",
    ),
    _formula(
        "text after (3), N",
        "radial load, steady",
        lambda: _MASS_LENGTH * _ROTOR**2,
        lambda: _load(_ROTOR),
        unit="N",
        note=_MACHINE,
    ),
    _formula(
        "text after (3), N",
        "radial load in a run-up",
        lambda: _MASS_LENGTH * _JAM**2 - 2.0 * _MASS_LENGTH * _ROTOR * (_ROTOR - _JAM),  # negative in a jam
        lambda: _load(_JAM),
        unit="N",
        note=f"{_MACHINE}, f' = {_JAM} rad/s",
        misprint=Misprint(
            "m l f'^2 - 2 m l w (w - f')",
            "m l f'^2: with the absolute angular velocity f' there is no Coriolis force",
            "radial load of the equations of motion",
            lambda: _MASS_LENGTH * _JAM**2,
        ),
    ),
    _formula(
        "(2)",
        "M2 = mu2 N d/2",
        lambda: _DRY * _load(_JAM) * _DIAMETER / 2.0,
        _friction_torque,
        unit="N m",
        note=f"mu2 = {_DRY}, d = 12 mm, {_MACHINE}",
    ),
    _number(
        "text on gravity",
        "largest change of the radial load by gravity",
        0.5,
        _share_of_gravity,
        within=0.5,
        unit="%",
        note=f"the paper prints an upper limit, without a speed; at the slowest jam that the rotor paper computes, {_JAM} "
        f"rad/s, the change is below it; the limit is reached at {math.sqrt(9.81 / (0.005 * _LENGTH)):.1f} rad/s",
    ),
    _measured("scatter of 20 measurements", 2.1, reason="the twenty measurements are not printed"),
    _measured(
        "error of the instruments", 3.0, reason="neither the data of the rod nor the errors of its mass and length are printed"
    ),
)
"""Equations (2), (3), the measured friction and the statements on the radial load."""
