"""Scene: a machine with its loads, drive and effects."""

from __future__ import annotations

from functools import partial

import numpy as np

from jaxvib.errors import InputError, quoted
from jaxvib.machine.carrier import Machine
from jaxvib.machine.drive import Drive
from jaxvib.machine.effects.base import Effect, has_term
from jaxvib.machine.effects.terms import DrillingSpinRelease, SlipRelease
from jaxvib.machine.loads import Loads
from jaxvib.machine.numbers import Part
from jaxvib.units.known import when_known

__all__ = ["Scene", "require_comparable"]

_MIN_RATIO = 1e-15
"""Ratio of two numbers below which double precision loses the smaller one in a sum."""


class Scene(Part):
    """Complete description of a machine in motion; a frozen pytree of SI numbers.

    `jax.grad`, `jax.vmap` and `jax.jit` apply to every number in it; `equinox.tree_at` replaces one.

    **Arguments**

    - `machine` from `one_mass`, `two_mass`, `three_mass`, `network`, `planar_rotor` or `rotor`
    - `loads` from `balls`, `rollers`, `pendulums` or `torus_balls`; typical: 0.1 % to 5 % of the machine's mass
    - `drive` such as `ConstantSpeed`; typical: 600 to 3000 rpm
    - `effects` such as `Gravity`, each once; `CubicSupport` and `Stop` once for each such support. typical: none

    **Raises** `InputError` for

    - a part of the wrong type
    - an effect that occurs twice and may occur once
    - a number of stations other than that of the loads
    - an effect that cannot act on this machine or these loads

    >>> import jaxvib as jv
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    >>> scene = jv.Scene(machine, loads=jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), drive=jv.ConstantSpeed("600 rpm"))
    >>> scene.loads.count
    2
    """

    machine: Machine
    loads: Loads
    drive: Drive
    effects: tuple[Effect, ...]

    def __init__(self, machine: Machine, loads: Loads, drive: Drive, effects: tuple[Effect, ...] = ()):
        parts = (("machine", machine, Machine, "two_mass(...)"), ("loads", loads, Loads, "balls(...)"))
        parts += (("drive", drive, Drive, 'ConstantSpeed("1500 rpm")'),)
        for name, part, kind, example in parts:
            if not isinstance(part, kind):
                raise InputError(name, f"is {quoted(part)}; it must be a {kind.__name__}, for example {example}")
        if isinstance(effects, Effect):
            effects = (effects,)
        if not isinstance(effects, (tuple, list)):
            raise InputError("effects", f"is {quoted(effects)}; it must be a tuple of effects, for example (Gravity(),)")
        effects = tuple(effects)
        for index, effect in enumerate(effects):
            if not isinstance(effect, Effect):
                raise InputError(f"effects[{index}]", f"is {quoted(effect)}; it must be an Effect, for example Gravity()")
        kinds = [effect.kind for effect in effects if not effect.repeatable]
        for kind in kinds:
            if kinds.count(kind) > 1:
                raise InputError("effects", f"names {kind} {kinds.count(kind)} times; once is allowed")
        for levers in machine.mounting().levers:
            if levers is not None and levers.shape != (loads.count,):
                problem = f"has {levers.shape[0]} values; one for all loads or {loads.count} are needed"
                raise InputError("machine.stations", problem)
        for effect in effects:
            effect.validate(machine, loads)
            if not drive.ideal and has_term([effect], DrillingSpinRelease, SlipRelease):
                problem = f"needs a drive of given speed (property ideal), not {drive.kind!r}; use ConstantSpeed"
                raise InputError(f"effects.{effect.kind}", problem)
        require_comparable(machine, loads, drive)
        self.machine = machine
        self.loads = loads
        self.drive = drive
        # The order has no meaning; it is that of scene files.
        first = {effect.kind: index for index, effect in reversed(list(enumerate(effects)))}
        self.effects = tuple(sorted(effects, key=lambda effect: (not effect.repeatable, first[effect.kind])))


def require_comparable(machine: Machine, loads: Loads, drive: Drive) -> None:
    """**Raises** `InputError` if rounding loses one of two numbers that are known.

    This happens for loads too heavy or too light for the machine, and for drag too weak for their inertia.
    """
    parts = getattr(machine, "mass", None), loads.mass, getattr(loads, "drag", None), drive.speed
    when_known(partial(_require_comparable, loads.count), *parts)


@np.errstate(over="ignore", divide="ignore", invalid="ignore")  # shares of the largest and least numbers there are
def _require_comparable(
    count: int, platforms: np.ndarray | float | None, mass: np.ndarray | float, drag: np.ndarray | float | None, speed: float
) -> None:
    each = np.broadcast_to(np.asarray(mass, dtype=float), (count,))
    if platforms is not None:
        whole, total = float(np.sum(platforms)), float(np.sum(each))
        if not _MIN_RATIO <= total / whole <= 1.0 / _MIN_RATIO:
            raise InputError(
                "loads.mass",
                f"makes {total:.3g} kg in all on a machine of {whole:.3g} kg, so that rounding loses one beside the other; "
                f"loads may have {_MIN_RATIO:g} to {1.0 / _MIN_RATIO:g} times the machine's mass",
            )
    if drag is not None:
        share = np.asarray(drag, dtype=float) / (each * speed)
        lost = (share > 0.0) & (share < _MIN_RATIO)
        if np.any(lost):
            least = _MIN_RATIO * float(np.max(each[lost])) * speed
            raise InputError(
                "loads.drag",
                f"takes {float(np.min(share[lost])):.1e} of a load's speed while the rotor turns by a radian, which is lost in "
                f"rounding; give 0, or {least:.1g} N s/m at least",
            )
