"""Greatest drag of jams: against searches of all jams just below and just above it, and a closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv

PLANE = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
SPLIT = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0, stiffness_up=0.8e6)
LONG = jv.rotor(
    mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, stiffness=(6.04e5, 5.55e5), damping=(439.0, 404.0),
    position=(0.165, -0.155), stations=[0.28, -0.28],
)  # fmt: skip


def with_drag(scene, factor):
    return eqx.tree_at(lambda each: each.exciters[0].loads.drag, scene, factor * scene.loads.drag)


@pytest.mark.parametrize("kind", ["one_mass", "two_mass", "three_mass"])
def test_modes_of_a_resonance_end_at_its_limit(kind):
    base = scene(kind, speed=150.0)
    limits = jv.drag_limits(base)
    there = np.flatnonzero(np.isfinite(limits.factor))
    assert there.size >= 1
    for r in there:
        for share, exists in ((0.999, True), (1.001, False)):
            numbers = jv.jam_modes(with_drag(base, share * limits.factor[r])).mode_numbers()
            assert (2 * r + 1 in numbers, 2 * r + 2 in numbers) == (exists, exists)


def pendulums(machine, mass=0.05, effects=(), drag=0.04):
    loads = jv.pendulums(count=2, mass=mass, radius=0.08, drag=drag)
    return jv.Scene(machine, loads, jv.ConstantSpeed(460.0), effects=effects)


@pytest.mark.parametrize(
    "rotor",
    [
        pendulums(PLANE, effects=(jv.StaticImbalance(8e-3),)),
        pendulums(SPLIT),
        pendulums(PLANE, mass=[0.05, 0.04]),
        pendulums(PLANE, drag=[0.04, 0.06]),
        pendulums(LONG),
    ],
    ids=["imbalance", "split", "masses", "drags", "two_planes"],
)
def test_no_jam_at_any_phases_exists_above_the_limit(rotor):
    limits = jv.drag_limits(rotor, phases=True)
    there = np.flatnonzero(np.isfinite(limits.factor))
    assert there.size >= 1
    for r in there:
        jams = (jv.phase_jams(with_drag(rotor, share * limits.factor[r])).omega for share in (0.999, 1.001))
        counts = [int(np.sum(np.abs(np.asarray(w) / limits.omega[r] - 1.0) < 0.02)) for w in jams]
        assert counts == [2, 0]


def test_unequal_loads_do_not_reach_the_limit_of_gathered_ones():
    rotor = pendulums(PLANE, drag=[0.04, 0.06])
    assert jv.drag_limits(rotor, phases=True).factor[0] < 0.95 * jv.drag_limits(rotor).factor[0]
    equal = pendulums(PLANE)
    np.testing.assert_allclose(jv.drag_limits(equal, phases=True).factor[0], jv.drag_limits(equal).factor[0], rtol=1e-12)


def test_one_mass_has_the_closed_form():
    mass, stiffness, damping, n = 50.0, 4e4, 30.0, 90.0
    loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
    base = jv.Scene(jv.one_mass(mass=mass, stiffness=stiffness, damping=damping), loads, jv.ConstantSpeed(n))
    w = np.linspace(27.5, 28.5, 2_000_001)
    size = 0.1 * w**2 / np.abs(stiffness - (mass + 1.0) * w**2 + 1j * w * damping)
    factor = damping * w * size**2 / 2.0 / (2.0 * 0.01 * (n - w))
    np.testing.assert_allclose(jv.drag_limits(base).factor, [np.max(factor)], rtol=1e-10)
    np.testing.assert_allclose(jv.drag_limits(base).drag, [np.max(factor)], rtol=1e-10)


def test_dry_friction_is_refused():
    loads = jv.pendulums(count=3, mass=0.8, radius=0.12, drag=1.5)
    friction = jv.DryFriction(1e-4, "20 mm")
    with pytest.raises(jv.InputError, match=r"effects.dry_friction.*ContactFriction"):
        jv.drag_limits(jv.Scene(scene("two_mass").machine, loads, jv.ConstantSpeed(150.0), effects=friction))


def test_derivatives_are_finite_differences():
    def factor(stiffness):
        machine = jv.one_mass(mass=50.0, stiffness=stiffness, damping=30.0)
        return jv.drag_limits(
            jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(90.0))
        ).factor[0]

    near = [float(factor(4e4 + step)) for step in (-4.0, 4.0)]
    np.testing.assert_allclose(jax.grad(factor)(jnp.asarray(4e4)), (near[1] - near[0]) / 8.0, rtol=1e-6)


def test_a_resonance_above_the_rotor_speed_has_no_limit():
    slow = jv.Scene(scene("two_mass").machine, scene("two_mass").loads, jv.ConstantSpeed(1.0))
    found = jv.drag_limits(slow)
    assert np.all(np.isnan(found.factor)) and found.summary().startswith("no jam at any resonance")
    assert found.plot().axes
