"""Quantities: arithmetic, demands, tiers, cases, tolerances."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from optimize import (
    Quantity,
    amplitude,
    expected,
    fold_margin,
    force_per_amplitude,
    foundation_force,
    jam_frequency,
    largest,
    largest_multiplier,
    least,
    peak_force,
    phase,
    power,
    product,
    quantile,
    settling_time,
    spring_cost,
    static_deflection,
    total,
    total_mass,
    under,
    worst,
)
from optimize.search.problem import evaluate_quantities

SCENE = scene("two_mass", speed=120.0)
STIFFNESS = Quantity("sum of stiffnesses", "N/m", lambda s: jnp.sum(s.machine.stiffness))


def one(leaf):
    return jnp.asarray(leaf)[None]


def test_arithmetic_is_that_of_the_numbers():
    force, whose = foundation_force(mode=3), amplitude(mode=3)
    built = {
        "ratio": force / whose,
        "weighted": 0.3 * whose / "1 mm" + force / "10 N",
        "power": (force**2 - 4.0 * force * force) / force,
        "minus": 1.0 - force / "1 kN",
        "largest": largest(force, -force, 2.0 * force),
        "least": least(force, 0.5 * force),
        "two arguments": Quantity("w", "rad/s", lambda s, modes: modes.omega[2]),
    }
    f, a, *rest = evaluate_quantities([force, whose, *built.values(), force_per_amplitude(mode=3)], jax.tree.map(one, SCENE))[0]
    jam = jv.jam_modes(SCENE).select(3)
    np.testing.assert_allclose([f, a], [jam.foundation_force, abs(jam.displacement[0] - jam.displacement[1])], rtol=1e-9)
    awaited = [f / a, 0.3 * a / 1e-3 + f / 10.0, -3.0 * f, 1.0 - f / 1e3, 2.0 * f, 0.5 * f, float(jam.omega), f / a]
    np.testing.assert_allclose(rest, awaited, rtol=1e-9)
    assert (force / whose).unit == "N/m" and built["weighted"].unit == "" and built["two arguments"].words == "w"


def test_quantities_of_a_jam_and_of_the_machine():
    machine, loads, n = SCENE.machine, SCENE.loads, 120.0
    jam = jv.jam_modes(SCENE).select(3)
    prices = spring_cost([(1e4, 20.0), (1e5, 56.0)])
    asked = [power(mode=3), phase(mode=3), jam_frequency(mode=3), total_mass(), static_deflection(1), prices]
    asked += [product("machine.mass"), total("machine.stiffness"), fold_margin(mode=3), fold_margin(mode=4)]
    found = evaluate_quantities(asked, jax.tree.map(one, SCENE))[0]
    first, second = np.asarray(jam.displacement)
    assembled, weight = np.asarray(machine.carrier().stiffness), 9.80665 * np.asarray([120.0, 95.0 + 2.4])
    each = np.interp([5e4, 3e4], [1e4, 1e5], [20.0, 56.0]).sum() + 56.0 + 36.0 / 9e4 * 1e5  # the link, beyond the list's end
    folds = np.asarray(jv.jam_modes(SCENE).folds.rotor_speed)
    awaited = [
        n * 3 * float(loads.drag) * float(loads.radius) ** 2 * (n - float(jam.omega)),
        abs(np.angle(first / second)),
        float(jam.omega),
        120.0 + 95.0 + 2.4,
        np.linalg.solve(assembled, weight)[0],
        each,
        120.0 * 95.0,
        8e4,
        min(n - folds[1], folds[2] - n),
        min(folds[2] - n, n - folds[3]),
    ]
    there = np.isfinite(found)
    assert there[:9].all()
    np.testing.assert_allclose(found[there], np.asarray(awaited)[there], rtol=1e-8)


@pytest.mark.parametrize("effects", [(), (jv.DryFriction(0.02, 0.01),)])
def test_power_is_what_the_dampers_take_at_the_loads_speed(effects):
    """The rotor's torque on the loads is that of the vibration: what the dampers take in a radian of the loads."""
    s = scene("two_mass", "pendulums", speed=120.0, effects=effects)
    jam = jv.jam_modes(s).select(3)
    y, omega = np.asarray(jam.displacement), float(jam.omega)
    taken = 0.5 * omega**2 * np.real(np.conj(y) @ np.asarray(s.machine.carrier().damping) @ y)
    np.testing.assert_allclose(power(mode=3)(s), 120.0 * taken / omega, rtol=1e-8)


@pytest.mark.parametrize("drag", [1e6, 1e9, 1e12, 1e15])
def test_power_keeps_its_digits_for_any_drag(drag):
    """Loads that nearly turn with the rotor: n^2 c |y|^2 / 2 of the damper under an unbalance at speed n."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    s = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=drag), jv.ConstantSpeed(60.0))
    moved = 0.05 * 60.0**2 / abs(4e4 - 50.5 * 60.0**2 + 100j * 60.0)
    right = 100.0 * (60.0 * moved) ** 2 / 2.0
    np.testing.assert_allclose(power(mode=3)(s), right, rtol=1.0 / drag + 1e-12)
    # The torque of the moving mass shakes the load's speed, by its share in inertia per drag.
    np.testing.assert_allclose(power(mode=3, tier="exact")(s), right, rtol=30.0 / drag + 1e-12)
    slope = jax.grad(lambda x: power(mode=3, tier="exact")(eqx.tree_at(lambda s: s.machine.stiffness, s, x)).sum())
    if drag > 1e8:
        amount = 4.0 * (50.5 * 60.0**2 - 4e4) / abs(4e4 - 50.5 * 60.0**2 + 100j * 60.0) ** 2 / 2.0
        np.testing.assert_allclose(slope(s.machine.stiffness), [right * amount], rtol=1e-6)


def test_tiers_agree_with_the_functions_of_the_package():
    orbit = jv.jam_orbit(SCENE, mode=3)
    np.testing.assert_allclose(amplitude(mode=3, of=2, tier="exact")(SCENE), orbit.amplitude[1], rtol=1e-12)
    np.testing.assert_allclose(foundation_force(mode=3, tier="exact")(SCENE), orbit.foundation_force, rtol=1e-12)
    np.testing.assert_allclose(foundation_force(mode=3, harmonic=3)(SCENE), abs(orbit.force_harmonics[0, 1]), rtol=1e-12)
    assert float(foundation_force(mode=3, harmonic=2)(SCENE)) == 0.0  # the half-turn symmetry
    np.testing.assert_allclose(largest_multiplier(mode=3)(SCENE), orbit.multiplier, rtol=1e-12)
    np.testing.assert_allclose(power(mode=3, tier="exact")(SCENE), orbit.power, rtol=1e-12)
    theta = np.linspace(0.0, 2.0 * np.pi, 4001)
    motion = np.real(np.asarray(orbit.displacement_harmonics) @ np.exp(1j * np.asarray(orbit.orders)[:, None] * theta))
    apart = motion[0] - motion[1]
    np.testing.assert_allclose(amplitude(mode=3, tier="exact")(SCENE), np.ptp(apart) / 2.0, rtol=1e-6)
    force = foundation_force(mode=3)
    assert force.at_tier("exact") == foundation_force(mode=3, tier="exact") and total_mass().at_tier("exact") == total_mass()
    assert (2.0 * force).at_tier("exact").parts[1].tier == "exact" and peak_force(until=2.0, spin_up=1.0).forward_only


def test_a_case_changes_parameters_of_the_scene():
    heavy = under(jam_frequency(mode=3), "heavy", {"machine.mass[0]": "150 kg", "drive.speed": 130.0})
    there = eqx.tree_at(lambda s: (s.machine.mass, s.drive.speed), SCENE, (jnp.array([150.0, 95.0]), jnp.asarray(130.0)))
    found = evaluate_quantities([heavy, jam_frequency(mode=3)], jax.tree.map(one, SCENE))[0]
    np.testing.assert_allclose(found, [float(jv.jam_modes(s).select(3).omega) for s in (there, SCENE)], rtol=1e-9)
    with pytest.raises(jv.InputError, match="is not set in this scene"):
        under(STIFFNESS, "x", {"loads.inertia": 1.0})(SCENE)


def test_95_of_100_samples_are_within_the_tolerance():
    off = {"machine.stiffness": 0.05}
    stiff = Quantity("k", "N/m", lambda s: s.machine.stiffness[0])
    asked = [expected(stiff, off), worst(stiff, off), quantile(stiff, 0.975, off, samples=1000), -worst(-stiff, off)]
    mean, most, high, low = (float(q(SCENE)) for q in asked)
    np.testing.assert_allclose(mean, 5e4, rtol=1e-12)  # as many above as below
    np.testing.assert_allclose(high, 5e4 * (1.0 + 0.05 * 1.96 / 2.0), rtol=2e-4)
    assert 5e4 * 1.05 < most < 5e4 * 1.08 and abs(low + most - 1e5) < 1e-6
    # The mean force over machines that are off by so much is larger than the force: it is convex about its least value.
    force = foundation_force(mode=3)
    nominal, spread = evaluate_quantities([force, expected(force, off, samples=16)], jax.tree.map(one, SCENE))[0]
    assert np.isfinite(spread) and abs(spread / nominal - 1.0) < 0.2


@pytest.mark.slow
def test_quantities_by_time_integration():
    s = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5),
        jv.ConstantSpeed(60.0),
    )
    run = jv.simulate(s, 20.0, start="spin_up", spin_up=5.0)
    force = np.asarray(run.trajectory.foundation_force)
    np.testing.assert_allclose(peak_force(until=20.0, spin_up=5.0)(s), np.abs(force).max(), rtol=1e-3)
    settled = float(settling_time(until=20.0, spin_up=5.0)(s))
    assert 2.0 < settled < 15.0
    np.testing.assert_allclose(amplitude(mode=1, tier="time")(s), amplitude(mode=1, tier="exact")(s), rtol=1e-3)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: foundation_force(mode=3) + amplitude(mode=3), "combines N and m; divide each"),
        (lambda: foundation_force(mode=3) < "3 kg", "a kilogram is a mass"),
        (lambda: foundation_force(mode=3) < amplitude(mode=3), "is in N and compared with"),
        (lambda: 1.0 < foundation_force(mode=3) < 2.0, "is a demand, not True or False"),
        (lambda: foundation_force(mode=3) * "three", "is not a plain number"),
        (lambda: foundation_force(mode=3) + None, "None, which is not a number"),
        (lambda: foundation_force(mode=3) ** "2", "must be a plain number"),
        (lambda: amplitude(mode=3, tier="exakt"), "tier is 'exakt'; allowed: leading, exact, time"),
        (lambda: phase(mode=3, tier="time"), "is computed as: leading, exact"),
        (lambda: phase(mode=3, of=1), "must be a list of whole numbers"),
        (lambda: largest(), "give one quantity or several"),
        (lambda: Quantity("x", "m", 3.0), "give a function of a scene"),
        (lambda: Quantity(None, "m", lambda scene: 1.0), "quantity.name is None; it must be a string"),
        (lambda: Quantity("x", 1, lambda scene: 1.0), "quantity.unit is 1; it must be a string"),
        (lambda: foundation_force(mode=3).named(10**5000), "name is a whole number of 16610 bits"),
        (lambda: foundation_force(mode=3, harmonic=0), "harmonic is 0"),
        (lambda: peak_force(until=1.0, spin_up=2.0), "at most until"),
        (lambda: settling_time(until=3.0, spin_up=2.0, within=2.0), "less than 1"),
        (lambda: settling_time(until=3.0, spin_up=2.0, of=0), "of is 0"),
        (lambda: spring_cost([(1e4, 1.0)]), "at least two pairs"),
        (lambda: spring_cost([(1e4, 1.0), (1e3, 1.0)]), "must have ascending stiffnesses"),
        (lambda: under(STIFFNESS, "x", {}), "must be a dictionary"),
        (lambda: under(STIFFNESS, "x", {"drive.speed": "3 kg"}), "is not in rad/s"),
        (lambda: expected(STIFFNESS, {"machine.stiffness": 5.0}), "it must be between 0 and 1, such as 0.05"),
        (lambda: quantile(STIFFNESS, 1.5, {"machine.stiffness": 0.05}), "less than 1"),
        (lambda: expected(3.0, {"machine.stiffness": 0.05}), "must be a Quantity"),
        (lambda: amplitude(mode=9)(SCENE), "numbered 1 to 5"),
        (lambda: static_deflection(7)(SCENE), "platforms 1 to 2"),
        (lambda: total("machine.length"), "must name parameters of a scene"),
    ],
)
def test_wrong_quantities_raise_clear_errors(make, says):
    with pytest.raises(jv.InputError) as caught:
        make()
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_power_of_a_quantity_has_the_power_of_its_unit():
    share = Quantity("share", "", lambda s: s.loads.mass / s.machine.mass[0])
    assert (STIFFNESS**2).unit == "(N/m)**2" and (share**2).unit == ""


@pytest.mark.parametrize("text", ["600 min^-1", "600 rpm", "10 Hz"])
def test_ratios_with_a_speed_count_revolutions(text):
    speed = Quantity("speed", "rad/s", lambda s: s.drive.speed)
    turns = Quantity("turns", "Hz", lambda s: s.drive.speed / (2 * np.pi))
    for ratio in (speed / text, turns / text, 1.0 / (text / speed)):
        assert ratio.unit == ""
        np.testing.assert_allclose(ratio(SCENE), SCENE.drive.speed / (20 * np.pi), rtol=1e-14)
    with pytest.raises(jv.InputError, match="does not state radians or revolutions"):
        speed / "10 1/s"


def test_arithmetic_keeps_the_platforms_of_a_phase():
    for made in (phase(mode=3, of=(2, 1)), -phase(mode=3, of=(2, 1)), 2.0 * phase(mode=3, of=(2, 1))):
        assert made.of == (2, 1)


def test_total_mass_includes_the_mass_of_unbalances():
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    turning = dict(unbalance=0.5, drive=jv.ConstantSpeed(60.0))
    heavy = jv.Scene(machine, exciters=[jv.Exciter(unbalance_mass=10.0, **turning), jv.Exciter(**turning)])
    np.testing.assert_allclose(total_mass()(heavy), 60.0)
