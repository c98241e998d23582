"""Quantities of a jam at each tier, from motions in closed form."""

from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from optimize import (
    acceleration,
    amplitude,
    fold_margin,
    force_per_amplitude,
    foundation_force,
    jam_frequency,
    phase,
    power,
    shaft_torque,
    stroke,
    support_load,
    transmissibility,
    velocity,
)
from optimize.quantities.evaluation import Evaluation


class Moving(NamedTuple):
    displacement: jax.Array
    velocity: jax.Array


class Window(NamedTuple):
    """Samples of two turns, (times, coordinates) m."""

    time: jax.Array
    state: Moving


N, DRAG, BALL, RADIUS, K, C, LINK, MASS = 150.0, 0.8, 0.5, 0.1, (5e4, 4e4), (60.0, 50.0), 2e5, (120.0, 95.0)
SPEEDS = {"leading": 30.0, "exact": 31.0, "time": 32.0}
FIRST, SECOND = {"leading": 3e-3, "exact": 4e-3, "time": 5e-3}, {"leading": 1e-3, "exact": 1.5e-3, "time": 2.5e-3}
FORCES = {"leading": 70.0, "exact": 80.0, "time": 90.0}


@pytest.fixture(scope="module")
def jam():
    """Evaluation of a jam whose platforms move as FIRST and -i SECOND, at the speeds and forces above."""
    machine = jv.two_mass(mass=MASS, stiffness=K, damping=C, link_stiffness=LINK, link_damping=70.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=BALL, radius=RADIUS, drag=DRAG), jv.ConstantSpeed(N))

    def motion(tier):
        z = jnp.array([FIRST[tier], -1j * SECOND[tier]])
        return {
            "omega": jnp.asarray(SPEEDS[tier]),
            "foundation_force": jnp.asarray(FORCES[tier]),
            "displacement": z,
            "amplitude": jnp.abs(z),
        }

    leading, exact, run = (SimpleNamespace(**motion(tier)) for tier in SPEEDS)
    exact.power, exact.orders = jnp.asarray(45.0), (1, 3)
    exact.displacement_harmonics = jnp.stack([exact.displacement, 1j * exact.displacement], axis=1)
    exact.relative_amplitude = lambda i, k: jnp.abs(exact.displacement[i - 1] - exact.displacement[k - 1])
    exact.force_harmonics = jnp.array([[8.0j, 3.0]])
    time = np.linspace(0.0, 4.0 * np.pi / SPEEDS["time"], 801)
    moving = np.asarray(run.displacement) * np.exp(1j * SPEEDS["time"] * time)[:, None]
    run.window = Window(jnp.asarray(time), Moving(jnp.asarray(moving.real), jnp.asarray((1j * SPEEDS["time"] * moving).real)))
    at = {2: leading, 3: leading}, {3: exact}, {3: run}
    ways = dict(zip(("jam", "orbit", "jam_run"), (each.__getitem__ for each in at), strict=True))
    return SimpleNamespace(scene=scene, jammed=Evaluation(scene).jammed, **ways)


@pytest.mark.parametrize("tier", SPEEDS)
def test_quantities_of_a_jam_are_those_of_its_motion(jam, tier):
    w, one, two, force = SPEEDS[tier], FIRST[tier], SECOND[tier], FORCES[tier]
    both = np.hypot(one, two)
    expected = {
        jam_frequency: (w, w, w),
        amplitude: (both, one, two),
        stroke: (2.0 * both, 2.0 * one, 2.0 * two),
        acceleration: tuple(w**2 * y / 9.80665 for y in (both, one, two)),
        velocity: tuple(w * y / np.sqrt(2.0) for y in (both, one, two)),
        force_per_amplitude: tuple(force / y for y in (both, one, two)),
    }
    for quantity, values in expected.items():
        asked = [{}] * 3 if quantity is jam_frequency else [{}, {"of": 1}, {"of": 2}]
        for given, value in zip(asked, values, strict=True):
            np.testing.assert_allclose(
                quantity(mode=3, tier=tier, **given).read(jam), value, rtol=1e-5, err_msg=quantity.__name__
            )
    np.testing.assert_allclose(foundation_force(mode=3, tier=tier).read(jam), force, rtol=1e-14)
    unbalance = 2.0 * BALL * RADIUS
    np.testing.assert_allclose(transmissibility(mode=3, tier=tier).read(jam), force / (unbalance * w**2), rtol=1e-12)


def test_torque_and_power_of_a_jam(jam):
    torque = 2.0 * DRAG * RADIUS**2 * (N - SPEEDS["leading"])
    np.testing.assert_allclose(shaft_torque(mode=3).read(jam), torque, rtol=1e-12)
    np.testing.assert_allclose(power(mode=3).read(jam), N * torque, rtol=1e-12)
    np.testing.assert_allclose(shaft_torque(mode=3, tier="exact").read(jam), 45.0 / N, rtol=1e-14)
    np.testing.assert_allclose(power(mode=3, tier="exact").read(jam), 45.0, rtol=1e-14)


def test_phases_and_harmonics_of_a_jam(jam):
    for tier in ("leading", "exact"):
        np.testing.assert_allclose(phase(mode=3, tier=tier).read(jam), np.pi / 2.0, rtol=1e-14)
    forces = [float(foundation_force(mode=3, harmonic=k, tier="exact").read(jam)) for k in (1, 2, 3)]
    np.testing.assert_allclose(forces, [8.0, 0.0, 3.0], rtol=1e-14)


def test_largest_pieces_are_the_quantity(jam):
    """Forces above their first harmonic have two peaks, a fold margin two sides."""
    peaks = jnp.array([80.0, -75.0])
    jam = SimpleNamespace(
        **vars(jam), folds=lambda mode: [jnp.asarray(speed) for speed in ((28.0, 160.0) if mode == 3 else (160.0, 28.0))]
    )
    jam.orbit(3).force_peaks = lambda: peaks
    both = np.hypot(FIRST["exact"], SECOND["exact"])
    cases = (
        (foundation_force(mode=3, tier="exact"), [80.0, -75.0], [-80.0]),
        (force_per_amplitude(mode=3, tier="exact"), [80.0 / both, -75.0 / both], [-80.0 / both]),
        (foundation_force(mode=3), [70.0], [-70.0]),
        (fold_margin(mode=3), [10.0], [-122.0, -10.0]),
        (fold_margin(mode=2), [10.0], [-122.0, -10.0]),
        (stroke(mode=3, of=1), [6e-3], [-6e-3]),
    )
    for quantity, up, down in cases:
        np.testing.assert_allclose(quantity.pieces(jam, 1.0), up, rtol=1e-12)
        np.testing.assert_allclose(quantity.pieces(jam, -1.0), down, rtol=1e-12)
        np.testing.assert_allclose(quantity.read(jam), np.max(up), rtol=1e-12)


def test_support_carries_weight_and_force_of_the_vibration(jam):
    w = SPEEDS["leading"]
    stiffness = np.diag(K) + LINK * np.array([[1.0, -1.0], [-1.0, 1.0]])
    weight = np.asarray(jam.jammed.mass) @ np.full(2, 9.80665)
    static = np.array(K) * np.linalg.solve(stiffness, weight)
    moving = np.abs((np.array(K) + 1j * w * np.array(C)) * [FIRST["leading"], SECOND["leading"]])
    for k in (1, 2):
        np.testing.assert_allclose(support_load(mode=3, of=k).read(jam), (static + moving)[k - 1], rtol=1e-9)
    with pytest.raises(jv.InputError, match="supports 1 to 2"):
        support_load(mode=3, of=3).read(jam)


def test_machines_without_platforms_have_the_first_coordinate():
    """The two coordinates of a planar rotor are at right angles: their difference has no meaning."""
    loads, drive = jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0)
    disk = jv.Scene(jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0), loads, drive)
    for mode in (1, 5):
        found = jv.jam_modes(disk).select(mode)
        for quantity, value in ((amplitude, found.amplitude[0]), (stroke, 2.0 * found.amplitude[0])):
            np.testing.assert_allclose(quantity(mode=mode)(disk), value, rtol=1e-10)
    springs = [jv.support(at=(x, -0.2), stiffness=(2e5, 4e5), damping=(100.0, 100.0)) for x in (-1.0, 1.0)]
    body = jv.Scene(jv.plane_body(mass=200.0, inertia=60.0, supports=springs), loads, drive)
    for of in (3, (1, 3)):
        with pytest.raises(jv.InputError, match="coordinate 3, psi, is a rotation; give the number of a displacement"):
            amplitude(mode=1, of=of)(body)
