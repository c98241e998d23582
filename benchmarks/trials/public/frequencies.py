"""Natural frequencies, mode shapes, whirl and auto-balancing."""

from __future__ import annotations

import numpy as np
from case import balls, case, two
from scipy.linalg import eig, eigh

import jaxvib as jv


def chain(masses, springs, ends: tuple[float, float], *, dampers=None, load: float = 0.5) -> jv.Scene:
    """Masses in a line; `ends` are the springs to the foundation at both ends. The load's mass is part of `masses`."""
    n = len(masses)
    support = np.zeros(n)
    support[0] += ends[0]
    support[-1] += ends[1]
    own = np.array(masses, float)
    own[0] -= load
    machine = jv.network(
        mass=own,
        stiffness=support,
        damping=np.zeros(n),
        links=[[i + 1, i + 2] for i in range(n - 1)],
        link_stiffness=springs,
        link_damping=np.zeros(n - 1) if dampers is None else dampers,
        exciter=1,
    )
    return jv.Scene(machine, balls(load), jv.ConstantSpeed(100.0))


@case("vibrating table: natural frequency of 60 kg and two balls on 250 N/mm")
def _():
    scene = jv.Scene(jv.one_mass(mass=60.0, stiffness="250 N/mm", damping=120.0), balls(0.3, 2), jv.ConstantSpeed("1500 rpm"))
    return jv.natural_frequencies(scene), [np.sqrt(250e3 / 60.6)]


@case("two equal masses between three equal springs (Rao)")
def _():
    scene = two((10.0, 9.5), (2e4, 2e4), (0.0, 0.0), 2e4, 0.0)
    return jv.natural_frequencies(scene), np.sqrt([2e3, 6e3])


@case("two masses joined by a spring and otherwise free", 1e-7)
def _():
    scene = two((4.0, 11.5), (0.0, 0.0), (0.0, 0.0), 3e4, 0.0)
    return jv.natural_frequencies(scene) + 1.0, 1.0 + np.array([0.0, np.sqrt(3e4 * (1 / 4 + 1 / 12))])


@case("absorber of a fifth of the mass splits a resonance into 0.8 and 1.25 (Den Hartog)")
def _():
    scene = jv.Scene(
        jv.two_mass(mass=(1.0, 4.5), stiffness=(0.0, 5e3), damping=(0.0, 0.0), link_stiffness=1e3, link_damping=0.0),
        balls(0.5),
        jv.ConstantSpeed(50.0),
    )
    mu, one = 0.2, np.sqrt(1e3)
    split = 1.0 + mu / 2.0 + np.array([-1.0, 1.0]) * np.sqrt(mu + mu**2 / 4.0)
    assert np.allclose(np.sqrt(split), [0.8, 1.25], atol=2e-3)
    return jv.natural_frequencies(scene), one * np.sqrt(split)


@case("chain of five equal masses between two walls")
def _():
    scene = chain([2.0] * 5, [800.0] * 4, (800.0, 800.0))
    return jv.natural_frequencies(scene), 2.0 * np.sqrt(400.0) * np.sin(np.arange(1, 6) * np.pi / 12.0)


@case("chain of three equal masses, one end free")
def _():
    scene = chain([3.0] * 3, [1200.0] * 2, (1200.0, 0.0))
    return jv.natural_frequencies(scene), 2.0 * np.sqrt(400.0) * np.sin((2.0 * np.arange(1, 4) - 1.0) * np.pi / 14.0)


@case("mode shapes of two unequal platforms")
def _():
    shapes = jv.mode_shapes(two((3.0, 4.5), (1e3, 2e3), (0.0, 0.0), 1.5e3, 0.0))
    stiffness = np.array([[2.5e3, -1.5e3], [-1.5e3, 3.5e3]])
    values, vectors = eigh(stiffness, np.diag([3.0, 5.0]))
    ratio = np.asarray(shapes.shape)[:, 1] / np.asarray(shapes.shape)[:, 0]
    return np.concatenate([shapes.frequency, ratio]), np.concatenate([np.sqrt(values), vectors[1] / vectors[0]])


BOUNCE = dict(mass=1500.0 - 0.5, transverse_inertia=2100.0, polar_inertia=300.0, damping=(0.0, 0.0), position=(-1.35, 1.6))


@case("bounce and pitch of a rigid bar on two unequal springs (Thomson)")
def _():
    scene = jv.Scene(jv.rotor(**BOUNCE, stiffness=(35e3, 38e3)), balls(0.5), jv.ConstantSpeed(10.0))
    c2 = -1.35 * 35e3 + 1.6 * 38e3
    stiffness = np.array([[73e3, c2], [c2, 1.35**2 * 35e3 + 1.6**2 * 38e3]])
    one = np.sqrt(eigh(stiffness, np.diag([1500.0, 2100.0]), eigvals_only=True))
    return jv.natural_frequencies(scene), np.repeat(one, 2)


# Rotors


def conical(polar: float, damping: float = 0.0, stiffness: tuple[float, float] = (2e6, 2e6)) -> jv.Scene:
    machine = jv.rotor(
        mass=30.0,
        transverse_inertia=0.8,
        polar_inertia=polar,
        stiffness=stiffness,
        damping=(damping, 1.5 * damping),
        position=(-0.25, 0.25),
    )
    return jv.Scene(machine, balls(0.01), jv.ConstantSpeed(200.0))


def whirl_matrix(n: float, polar: float, damping: float, stiffness: tuple[float, float]) -> np.ndarray:
    """First-order matrix of (y, theta) with z = -i y: complex coordinates r = y + i z, a = theta + i psi."""
    arms = np.array([-0.25, 0.25])
    k, c = np.array(stiffness), damping * np.array([1.0, 1.5])
    stiff = np.array([[k.sum(), k @ arms], [k @ arms, k @ arms**2]])
    damp = np.array([[c.sum(), c @ arms], [c @ arms, c @ arms**2]], complex)
    damp[1, 1] -= 1j * polar * n
    mass = np.diag([30.0, 0.8])
    return np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(mass, stiff), -np.linalg.solve(mass, damp)]])


@case("Jeffcott rotor: whirl speed and decay with damping")
def _():
    machine = jv.planar_rotor(mass=20.0, stiffness=8e5, damping=600.0)
    found = jv.whirl(jv.Scene(machine, balls(0.02), jv.ConstantSpeed(300.0)), loads="none")
    decay = 600.0 / 40.0
    return np.concatenate([found.speed[0], found.decay[0]]), [np.sqrt(4e4 - decay**2)] * 2 + [decay] * 2


@case("conical whirl of a symmetric rotor at 200 rad/s")
def _():
    found = np.sort(np.asarray(jv.whirl(conical(0.5), loads="none").speed[0]))
    tilt, turn = 4e6 * 0.25**2, 0.5 * 200.0
    root = np.sqrt(turn**2 + 4.0 * 0.8 * tilt)
    return found, np.sort([np.sqrt(4e6 / 30.0)] * 2 + [(root - turn) / 1.6, (root + turn) / 1.6])


@case("critical speeds of the same rotor, forward and backward")
def _():
    found = jv.critical_speeds(conical(0.5), loads="none").speed
    tilt = 4e6 * 0.25**2
    return found, np.sort([np.sqrt(4e6 / 30.0)] * 2 + [np.sqrt(tilt / 0.3), np.sqrt(tilt / 1.3)])


@case("a thin disc has no forward conical critical speed")
def _():
    found = np.asarray(jv.critical_speeds(conical(1.6), loads="none").speed)
    return np.where(np.isinf(found), 1e9, found), np.sort([np.sqrt(4e6 / 30.0)] * 2 + [np.sqrt(4e6 * 0.0625 / 2.4), 1e9])


@case("whirl of a rotor on unequal damped supports at three speeds", 1e-8)
def _():
    stiffness = (2e6, 3.5e6)
    speeds = np.array([50.0, 300.0, 900.0])
    found = jv.whirl(conical(0.5, 900.0, stiffness), speeds, loads="none")
    right = []
    for n in speeds:
        s = eig(whirl_matrix(n, 0.5, 900.0, stiffness))[0]
        s = s[np.argsort(np.abs(s.imag))]
        right.append(np.concatenate([np.abs(s.imag), -s.real]))
    return np.concatenate([found.speed, found.decay], axis=1), np.array(right)


@case("rotor of Artyunin without pendulums: 176.19 and 278.26 rad/s as printed digits of another convention", 3e-5)
def _():
    machine = jv.rotor(
        mass=37.0,
        transverse_inertia=0.479,
        polar_inertia=0.093,
        stiffness=(0.604e6, 0.555e6),
        damping=(0.0, 0.0),
        position=(0.165, -0.155),
    )
    found = jv.critical_speeds(jv.Scene(machine, balls(0.05), jv.ConstantSpeed(460.0)), loads="none")
    return np.asarray(found.speed)[np.asarray(found.forward)], [176.19, 278.26]


# Auto-balancing


@case("criterion of one mass: the boundary is the undamped resonance")
def _():
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    found = jv.criterion(jv.Scene(machine, balls(0.5, 2), jv.ConstantSpeed(60.0)))
    return [np.asarray(found.balancing)[0, 0]], [np.sqrt(4e4 / 51.0)]


@case("criterion of two masses: resonances and the additional speed between them")
def _():
    scene = two((100.0, 78.4), (5e4, 3e4), (0.0, 0.0), 1e5, 0.0, mass=0.8, count=2)
    mass, stiffness = np.diag([100.0, 80.0]), np.array([[1.5e5, -1e5], [-1e5, 1.3e5]])
    resonances = np.sqrt(eigh(stiffness, mass, eigvals_only=True))
    rows = np.asarray(jv.criterion(scene).undamped_balancing)
    found = rows[np.isfinite(rows)]
    return np.sort(found), np.sort([*resonances, np.sqrt(1.5e5 / 100.0)])


@case("two balls against an imbalance: the angle from the law of cosines")
def _():
    imbalance = jv.StaticImbalance("60 g m")
    scene = jv.Scene(
        jv.planar_rotor(mass=25.0, stiffness=5e5, damping=300.0), balls(0.5, 2), jv.ConstantSpeed(300.0), (imbalance,)
    )
    angles = np.sort(np.mod(np.asarray(jv.balanced_states(scene).angles), 2.0 * np.pi), axis=1)[0]
    half = np.arccos(0.06 / (2.0 * 0.5 * 0.1))
    return angles, [np.pi - half, np.pi + half]


@case("three unequal balls cancel as the sides of a triangle")
def _():
    loads = jv.balls(count=3, mass=[0.3, 0.4, 0.5], radius=0.1, drag=1.0)
    scene = jv.Scene(jv.planar_rotor(mass=25.0, stiffness=5e5, damping=300.0), loads, jv.ConstantSpeed(300.0))
    angles = np.asarray(jv.balanced_states(scene).angles)[0]
    return 2.0 + np.cos(np.diff(angles)), [2.0, 2.0 + (0.09 - 0.16 - 0.25) / (2.0 * 0.4 * 0.5)]
