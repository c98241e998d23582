"""Measures of a vibration against closed forms and the flight of a particle."""

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
import optimize

G = 9.80665


@pytest.fixture(scope="module")
def jam():
    shaken = scene("two_mass", speed=150.0)
    return shaken, jv.jam_modes(shaken).select(3)


def test_measures_are_those_of_a_sine(jam):
    shaken, found = jam
    measures = jv.vibration_measures(shaken, found)
    w, t = float(found.omega), np.linspace(0.0, 2.0 * np.pi / float(found.omega), 20001)
    for k in range(2):
        y = np.real(complex(found.displacement[k]) * np.exp(1j * w * t))
        v = np.gradient(y, t)
        np.testing.assert_allclose(measures.stroke[k], np.ptp(y), rtol=1e-6)
        np.testing.assert_allclose(measures.velocity[k], np.sqrt(np.mean(v[:-1] ** 2)), rtol=1e-3)
        np.testing.assert_allclose(measures.acceleration[k], np.max(np.abs(np.gradient(v, t)[2:-2])) / G, rtol=1e-3)


def test_loads_of_supports_balance_weight_and_force(jam):
    shaken, found = jam
    measures = jv.vibration_measures(shaken, found)
    machine, loads = shaken.machine, shaken.loads
    weight = G * (np.sum(machine.mass) + loads.count * np.mean(loads.mass))
    np.testing.assert_allclose(np.sum(measures.static_load), weight, rtol=1e-12)
    each = (np.asarray(machine.stiffness) + 1j * float(found.omega) * np.asarray(machine.damping)) * np.asarray(
        found.displacement
    )
    np.testing.assert_allclose(measures.dynamic_load, np.abs(each), rtol=1e-12)
    np.testing.assert_allclose(abs(np.sum(each)), found.foundation_force, rtol=1e-10)
    exciter = float(loads.unbalance()) * float(found.omega) ** 2
    np.testing.assert_allclose(measures.transmissibility * exciter, found.foundation_force, rtol=1e-12)
    np.testing.assert_allclose(measures.isolation_efficiency, 1.0 - float(found.foundation_force) / exciter, rtol=1e-12)


def test_shaft_power_is_dissipated_by_drag_and_dampers(jam):
    shaken, found = jam
    measures = jv.vibration_measures(shaken, found)
    w, n, machine, loads = float(found.omega), float(shaken.drive.speed), shaken.machine, shaken.loads
    y = np.asarray(found.displacement)
    link = float(machine.link_damping[0]) * abs(y[0] - y[1]) ** 2
    dampers = w**2 / 2.0 * (np.sum(np.asarray(machine.damping) * np.abs(y) ** 2) + link)
    slip = loads.count * np.mean(loads.drag) * np.mean(loads.radius) ** 2 * (n - w) ** 2
    np.testing.assert_allclose(measures.power, dampers + slip, rtol=1e-6)
    np.testing.assert_allclose(measures.torque, measures.power / n, rtol=1e-12)


def test_quantities_equal_the_measures(jam):
    shaken, found = jam
    measures = jv.vibration_measures(shaken, found)
    for quantity, value in (
        (optimize.stroke(mode=3, of=1), measures.stroke[0]),
        (optimize.acceleration(mode=3, of=2), measures.acceleration[1]),
        (optimize.velocity(mode=3, of=1), measures.velocity[0]),
        (optimize.transmissibility(mode=3), measures.transmissibility),
        (optimize.shaft_torque(mode=3), measures.torque),
        (optimize.support_load(mode=3, of=2), measures.static_load[1] + measures.dynamic_load[1]),
    ):
        np.testing.assert_allclose(quantity(shaken), value, rtol=1e-10, err_msg=quantity.words)


def test_zones_change_at_the_boundaries_of_the_standard():
    assert [jv.vibration_zone(f"{v} mm/s") for v in (2.2, 2.4, 4.6, 7.2)] == list("ABCD")
    assert [jv.vibration_zone(v, machine="large", supports="rigid") for v in (2e-3, 3e-3, 5e-3, 8e-3)] == list("ABCD")


def flown(u, w, slope, periods):
    """Mean speed of a particle along a deck by small steps: it sticks while pressed, flies otherwise."""
    gx, gy = -G * np.sin(slope), -G * np.cos(slope)
    dt = 2.0 * np.pi / w / 20000
    t = dt * np.arange(20000 * periods)
    wave = np.exp(1j * w * t)
    (sx, sy), (vx, vy), (_, ay) = ([np.real(f * z * wave) for z in _in_deck(u, slope)] for f in (1.0, 1j * w, -(w**2)))
    x, k = 0.0, 0
    while k < len(t):
        rising = np.flatnonzero(ay[k:] < gy)
        if rising.size == 0:
            break
        k += rising[0]
        tau = t[k:] - t[k]
        gap = sy[k] + vy[k] * tau + gy * tau**2 / 2.0 - sy[k:]
        landed = np.flatnonzero(gap[5:] <= 0.0)
        if landed.size == 0:
            break
        j = landed[0] + 5
        x += vx[k] * tau[j] + gx * tau[j] ** 2 / 2.0 - (sx[k + j] - sx[k])
        k += j
    return x / t[-1]


def _in_deck(u, slope):
    return np.cos(slope) * u[0] + np.sin(slope) * u[1], -np.sin(slope) * u[0] + np.cos(slope) * u[1]


@pytest.mark.parametrize(
    ("u", "w", "slope"),
    [
        (np.array([0.004, 0.003]), 80.0, 0.0),
        (np.array([0.004, 0.003]), 84.0, -0.2),
        (np.array([0.003 + 0.001j, 0.003 - 0.0005j]), 90.0, 0.1),
    ],
)
def test_conveying_speed_is_that_of_a_flying_particle(u, w, slope):
    once, twice = flown(u, w, slope, 40), flown(u, w, slope, 80)
    without_ends = 2.0 * twice - once  # the first and the last period are not whole
    np.testing.assert_allclose(jv.conveying_speed(jnp.asarray(u), w, slope=slope), without_ends, rtol=1e-3)


def test_conveying_speed_has_the_limits_of_handbooks():
    level = jnp.array([0.004, 0.003])
    assert float(jv.conveying_speed(level, 50.0)) == 0.0
    w = np.sqrt(np.sqrt(1.0 + np.pi**2) * G / 0.003) * (1.0 - 1e-9)
    np.testing.assert_allclose(jv.conveying_speed(level, w), G / (2.0 * w / (2.0 * np.pi)) * 4.0 / 3.0, rtol=1e-6)
    assert np.isnan(jv.conveying_speed(level, 1.01 * w))


def test_measures_need_platforms(jam):
    rotor = jv.Scene(
        jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0),
        jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04),
        jv.ConstantSpeed(460.0),
    )
    with pytest.raises(jv.InputError, match=r"'planar_rotor'; measures of a jam needs a machine of platforms"):
        jv.vibration_measures(rotor, jam[1])
