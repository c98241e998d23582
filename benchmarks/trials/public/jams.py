"""Jams of light loads by the balance of powers: drag R^2 (n - W) N = W sum b |relative velocity|^2 / (2 W^2)."""

from __future__ import annotations

import jax
import numpy as np
from case import RPM, TWO_MASS, balls, case, linear, three, two
from numpy.polynomial import Polynomial
from scipy.linalg import eigh
from scipy.optimize import brentq, minimize_scalar

import jaxvib as jv


def jam_speeds(scene: jv.Scene) -> np.ndarray:
    """All load speeds at which the powers balance, from sign changes on a fine grid."""
    model, n = linear(scene), float(scene.drive.speed)
    natural = np.sqrt(eigh(model.stiffness, model.mass, eigvals_only=True))
    near = (natural[:, None] * (1.0 + np.linspace(-0.2, 0.2, 4001) ** 3)).ravel()
    grid = np.unique(np.concatenate([np.linspace(1e-3, 1.0, 20_001) * n, near[near < n]]))
    miss = np.array([model.rotor_speed(w) - n for w in grid])
    places = np.nonzero(np.sign(miss[1:]) != np.sign(miss[:-1]))[0]
    return np.array([brentq(lambda w: model.rotor_speed(w) - n, grid[k], grid[k + 1], xtol=1e-13) for k in places])


def jams(scene: jv.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Load speeds, amplitudes and foundation forces of all jam modes, computed and referred."""
    model, supports = linear(scene), np.asarray(scene.machine.stiffness) + 0j
    modes = jv.jam_modes(scene)
    there = np.asarray(modes.exists)
    computed = np.concatenate(
        [
            np.asarray(modes.omega)[there],
            np.ravel(np.asarray(modes.amplitude)[there]),
            np.asarray(modes.foundation_force)[there],
        ]
    )
    speeds = jam_speeds(scene)
    moved = np.array([model.response(w) for w in speeds])
    force = [abs((supports + 1j * w * np.asarray(scene.machine.damping)) @ y) for w, y in zip(speeds, moved, strict=True)]
    return computed, np.concatenate([speeds, np.ravel(np.abs(moved)), force])


ONE_MASS = {
    "vibrating table at 1500 rpm": (60.0, 250e3, 120.0, dict(mass=0.3, count=2, radius=0.09, drag=0.8), 1500 * RPM),
    "screen of 800 kg at 960 rpm": (800.0, 1.2e6, 2500.0, dict(mass=6.0, count=3, radius=0.25, drag=12.0), 960 * RPM),
    "feeder of 250 kg far above its resonance": (250.0, 9e4, 350.0, dict(mass=1.5, count=4, radius=0.15, drag=3.0), 3000 * RPM),
    "laboratory shaker of 2 kg": (2.0, 8e3, 2.0, dict(mass=0.004, count=2, radius=0.03, drag=0.02), 2400 * RPM),
    "overdamped isolator": (120.0, 4e4, 6e3, dict(mass=0.8, count=2, radius=0.12, drag=1.5), 900 * RPM),
    "rotor speed below the resonance": (60.0, 250e3, 120.0, dict(mass=0.3, count=2, radius=0.09, drag=0.8), 40.0),
}

for _name, (_mass, _stiffness, _damping, _loads, _speed) in ONE_MASS.items():

    @case(f"jams, one mass: {_name}", 1e-8)
    def _(mass=_mass, stiffness=_stiffness, damping=_damping, loads=_loads, speed=_speed):
        machine = jv.one_mass(mass=mass, stiffness=stiffness, damping=damping)
        return jams(jv.Scene(machine, balls(**loads), jv.ConstantSpeed(speed)))


@case("jams, one mass: speeds are the roots of a polynomial of degree five", 1e-8)
def _():
    mass, k, b, n, drag, s = 50.6, 4e4, 100.0, 60.0, 0.05, 0.06
    scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=k, damping=b), balls(0.3, 2, 0.1, 5.0 * drag), jv.ConstantSpeed(n))
    w = Polynomial([0.0, 1.0])
    # 2 N drag R^2 (n - W) |D|^2 = W^5 s^2 b
    equation = 2.0 * (10.0 * drag * 0.01) * (n - w) * ((k - mass * w**2) ** 2 + (b * w) ** 2) - w**5 * s**2 * b
    roots = equation.roots()
    real = np.sort(roots[(abs(roots.imag) < 1e-7) & (roots.real > 0.0)].real)
    modes = jv.jam_modes(scene)
    return np.sort(np.asarray(modes.omega)[np.asarray(modes.exists)]), real


for _name, (_mass, _stiffness, _damping, _link, _link_damping, _loads) in TWO_MASS.items():

    @case(f"jams, two masses: {_name}", 1e-8)
    def _(numbers=(_mass, _stiffness, _damping, _link, _link_damping), loads=_loads):
        return jams(two(*numbers, **loads))


for _at in (2, 3):

    @case(f"jams, three masses, exciter on platform {_at}", 1e-8)
    def _(at=_at):
        return jams(three(at))


@case("folds of one mass: the greatest rotor speed that still holds the jam", 1e-7)
def _():
    scene = jv.Scene(jv.one_mass(mass=60.0, stiffness=250e3, damping=120.0), balls(0.3, 2, 0.09, 0.8), jv.ConstantSpeed(400.0))
    model = linear(scene)
    natural = np.sqrt(250e3 / 60.6)
    top = minimize_scalar(lambda w: -model.rotor_speed(w), bounds=(0.97 * natural, 1.03 * natural), options=dict(xatol=1e-12))
    low = minimize_scalar(model.rotor_speed, bounds=(1.03 * natural, 4.0 * natural), options=dict(xatol=1e-12))
    return jv.branches(scene).folds.rotor_speed, [-top.fun, low.fun]


@case("antiphase machine: printed load speeds and rotor speeds of its folds", 2e-4)
def _():
    form = jv.Dimensionless(
        "antiphase", natural=(1 / 3, 1 / 3), damping=(0.01, 0.01), link_natural=2 / 3, link_damping=0.01, rho=1.0, eps=1e-3,
        beta=1.0, speed=3.0,
    )  # fmt: skip
    folds = jv.branches(form.scene()).folds
    printed = [0.3339, 0.3806, 1.0015, 1.2154, 0.7978, 0.4141, 5.1829, 1.3932]
    return np.concatenate([folds.omega, folds.rotor_speed]), printed


@case("derivative of a jam's foundation force by the stiffness, by differences of the polynomial's root", 1e-5)
def _():
    def scene(k):
        return jv.Scene(jv.one_mass(mass=60.0, stiffness=k, damping=120.0), balls(0.3, 2, 0.09, 0.8), jv.ConstantSpeed(150.0))

    def force(k):
        one = scene(k)
        w = jam_speeds(one)[0]
        return abs((k + 1j * w * 120.0) * linear(one).response(w)[0])

    slope = jax.grad(lambda k: jv.jam_modes(scene(k)).select(1).foundation_force)(250e3)
    return [slope], [(force(250e3 + 25.0) - force(250e3 - 25.0)) / 50.0]
