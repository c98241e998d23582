"""Cases, and platforms with their matrices written out."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import jaxvib as jv

RPM = np.pi / 30.0

EXACT, RUN = 1e-9, 1e-6
"""Bounds of a relative difference: to closed forms, and to a second integration in time."""


class Case(NamedTuple):
    """A question and its reference; both return arrays of the same shape."""

    name: str
    computed: Callable[[], np.ndarray]
    reference: Callable[[], np.ndarray]
    bound: float = EXACT


CASES: list[Case] = []


def case(name: str, bound: float = EXACT) -> Callable[[Callable[[], tuple]], Callable[[], tuple]]:
    """Add the function, which returns the computed value and the reference, as a case."""

    def add(function: Callable[[], tuple]) -> Callable[[], tuple]:
        both = functools.cache(function)
        CASES.append(Case(name, lambda: both()[0], lambda: both()[1], bound))
        return function

    return add


def balls(mass: float = 0.5, count: int = 1, radius: float = 0.1, drag: float = 1.0) -> jv.Loads:
    return jv.balls(count=count, mass=mass, radius=radius, drag=drag)


def two(masses, stiffness, damping, link, link_damping, **loads) -> jv.Scene:
    machine = jv.two_mass(mass=masses, stiffness=stiffness, damping=damping, link_stiffness=link, link_damping=link_damping)
    return jv.Scene(machine, balls(**loads), jv.ConstantSpeed(150.0))


class Linear(NamedTuple):
    """Matrices of platforms with the loads' mass on them."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    port: np.ndarray
    unbalance: float
    drag: float

    def response(self, w: float) -> np.ndarray:
        dynamic = self.stiffness - w**2 * self.mass + 1j * w * self.damping
        return np.linalg.solve(dynamic, self.port * self.unbalance * w**2)

    def rotor_speed(self, w: float) -> float:
        y = self.response(w)
        return w + w * (y.conj() @ self.damping @ y).real / (2.0 * self.drag)


def linear(scene: jv.Scene) -> Linear:
    """The same machine assembled here from the numbers of its springs."""
    machine, loads = scene.machine, scene.loads
    n, total = len(machine.mass), loads.count * float(loads.mass)
    mass = np.diag(np.asarray(machine.mass, float))
    damping, stiffness = np.diag(np.asarray(machine.damping, float)), np.diag(np.asarray(machine.stiffness, float))
    for (i, j), k, b in zip(machine.links, machine.link_stiffness, machine.link_damping, strict=True):
        e = np.zeros(n)
        e[i - 1], e[j - 1] = 1.0, -1.0
        stiffness, damping = stiffness + float(k) * np.outer(e, e), damping + float(b) * np.outer(e, e)
    port = np.zeros(n)
    port[machine.exciter - 1] = 1.0
    mass[machine.exciter - 1, machine.exciter - 1] += total
    radius = float(loads.radius)
    return Linear(mass, damping, stiffness, port, total * radius, loads.count * float(loads.drag) * radius**2)


TWO_MASS = {
    "antiphase screen": ((120.0, 95.0), (5e4, 5e4), (40.0, 40.0), 2e5, 60.0, dict(mass=0.8, count=3, radius=0.12, drag=1.5)),
    "screen on a heavy frame": (
        (900.0, 300.0),
        (8e5, 1e5),
        (900.0, 60.0),
        6e5,
        90.0,
        dict(mass=2.0, count=2, radius=0.2, drag=4.0),
    ),
    "soft link": ((80.0, 60.0), (3e5, 1e5), (60.0, 30.0), 2e3, 5.0, dict(mass=0.5, count=2, radius=0.1, drag=1.0)),
}


def three(exciter: int = 2) -> jv.Scene:
    machine = jv.three_mass(
        mass=(350.0, 180.0, 90.0),
        stiffness=(6e4, 0.0, 2e4),
        damping=(100.0, 0.0, 30.0),
        link_stiffness=(6e5, 0.0, 3e5),
        link_damping=(150.0, 0.0, 80.0),
        exciter=exciter,
    )
    return jv.Scene(machine, balls(0.8, 3, 0.12, 1.5), jv.ConstantSpeed(1500 * RPM))
