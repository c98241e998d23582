"""What the bearing paper prints: friction of a pendulum's bearing, how it is measured, and the radial load."""

from __future__ import annotations

import math
from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import State, vector_field
from jaxvib.equations.forces import normal_force
from jaxvib.machine.drive import ConstantSpeed
from jaxvib.machine.effects.base import Effect, Gravity
from jaxvib.machine.effects.friction import DryFriction
from jaxvib.machine.loads import pendulums
from jaxvib.machine.platforms import one_mass
from jaxvib.machine.scene import Scene
from jaxvib.study.bearing.decrement import ten_periods
from jaxvib.study.bearing.record import Record
from jaxvib.study.bearing.swing import BearingPendulum, swing
from jaxvib.study.published.entry import MISPRINT, NOT_REPRODUCIBLE, PaperAnswer, PublishedRow, compared

__all__ = ["bearing_paper"]

_PAPER = "bearing"

_MASS, _LENGTH, _ROTOR, _JAM = 0.05, 0.08, 460.0, 169.6
"""The pendulum of the rotor paper, its rotor's speed and its first jam: this paper prints no machine of its own."""

_ROD = BearingPendulum(mass=0.3, length=0.25, inertia=0.3 * 0.5**2 / 12.0)
"""A rod of 0.3 kg and 0.5 m, since the paper does not print the one it measured with."""


def bearing_paper() -> PaperAnswer:
    """Equations (2), (3), the measured friction and what is printed of the radial load.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> [row.quantity for row in bearing_paper().rows if row.verdict == "misprint"]
    ['radial load in a run-up']
    """
    time = np.arange(0.0, 15.0, 0.04)
    run = swing(_ROD, time, angle="3 deg", viscous=1.5e-3)
    rows = [*_measurement(Record(time, run.angle)), *_radial_load(), *_measured_only()]
    return PaperAnswer(rows, {"swing": lambda: run.plot()})


def _measurement(record: Record) -> list[PublishedRow]:
    found = ten_periods(_ROD, record)
    rod = "a rod of 0.3 kg and 0.5 m"
    said = f"the formula on a swing of {rod}, 3 deg at first, integrated with the paper's mu1 (its own rod is not printed)"
    row = partial(compared, _PAPER, kind="formula", within=1e-9, note=rod)
    return [
        compared(_PAPER, "(3)", "mu1 from ten periods", 1.5e-3, found.viscous.value, within=5e-5, unit="N m s", note=said),
        row("before (3)", "J = m l^2/3", 0.3 * 0.5**2 / 3.0, float(_ROD.total_inertia), unit="kg m^2"),
        row("before (3)", "k1 = (m g a/J)^(1/2)", math.sqrt(0.3 * 9.81 * 0.25 / 0.025), float(_ROD.frequency), unit="rad/s"),
    ]


def _scene(*effects: Effect) -> Scene:
    """A pendulum on a shaft that does not move."""
    machine = one_mass(mass=1e9, stiffness=1e15, damping=0.0)
    return Scene(machine, pendulums(count=1, mass=_MASS, radius=_LENGTH, drag=0.0), ConstantSpeed(_ROTOR), effects)


def _state(rate: float, angle: float | Array = 0.0) -> State:
    return State(jnp.zeros(1), jnp.zeros(1), (jnp.asarray([angle], float),), (jnp.asarray([rate], float),))


def _radial_load() -> list[PublishedRow]:
    m_l = _MASS * _LENGTH
    plain, heavy = _scene(), _scene(Gravity())
    steady, run_up = (float(normal_force(plain, 0.0, _state(rate))[0]) for rate in (_ROTOR, _JAM))
    printed = m_l * _JAM**2 - 2.0 * m_l * _ROTOR * (_ROTOR - _JAM)
    machine = f"m = {_MASS} kg, l = {_LENGTH} m, w = {_ROTOR:g} rad/s"
    frames = (
        "N = m l f'^2: f' is the absolute angular velocity, so that l f'^2 is all of the acceleration along the rod; the "
        "Coriolis force belongs to a turning frame, in which the centrifugal force would have another speed. The printed load "
        f"is negative in a jam ({machine}, f' = {_JAM} rad/s); proved by the radial load of the equations of motion"
    )
    share = max(
        abs(float(normal_force(heavy, 0.0, _state(_JAM, angle))[0]) / run_up - 1.0) for angle in (-0.5 * math.pi, 0.5 * math.pi)
    )
    least = math.sqrt(9.81 / (0.005 * _LENGTH))
    bound = f"an upper bound, without a speed; at the slowest published jam, {_JAM} rad/s, less above; reached at {least:.1f}"
    rate, dry = vector_field(plain), vector_field(_scene(DryFriction(0.0015, diameter=0.012)))
    slowed = dry(jnp.zeros(()), _state(_JAM)).rate[0] - rate(jnp.zeros(()), _state(_JAM)).rate[0]
    torque = float(slowed[0]) * m_l * _LENGTH
    row = partial(compared, _PAPER, kind="formula")
    return [
        row("text after (3), N", "radial load, steady", m_l * _ROTOR**2, steady, within=1e-9, unit="N", note=machine),
        row(
            "text after (3), N",
            "radial load in a run-up",
            printed,
            run_up,
            within=1e-9,
            unit="N",
            known=MISPRINT,
            corrected=m_l * _JAM**2,
            note=frames,
        ),
        row(
            "(2)",
            "M2 = mu2 N d/2",
            0.0015 * run_up * 0.006,
            torque,
            within=1e-9,
            unit="N m",
            note=f"mu2 = 0.0015, d = 12 mm, {machine}",
        ),
        compared(
            _PAPER, "text on gravity", "gravity's share of the load", 0.5, 100.0 * share, within=0.5, unit="%", note=bound
        ),
    ]


def _measured_only() -> list[PublishedRow]:
    row = partial(compared, _PAPER, "after (3)", computed=math.nan, unit="%", known=NOT_REPRODUCIBLE, within=0.05)
    return [
        row("scatter of 20 measurements", 2.1, note="the twenty measurements are not printed"),
        row("error of the instruments", 3.0, note="neither the rod nor the errors of its mass and its length are printed"),
    ]
