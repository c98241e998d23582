"""Dampings as ratios and loss factors, and springs side by side, against modal quantities."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.rewrite import rewrite_scene


def decay_ratios(machine):
    """The damping ratios of the modes, from the eigenvalues of the first-order system."""
    carrier = machine.carrier()
    mass, damping, stiffness = (np.asarray(x) for x in (carrier.mass, carrier.damping, carrier.stiffness))
    n = len(mass)
    inverse = np.linalg.inv(mass)
    system = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    roots = np.linalg.eigvals(system)
    return np.sort((-roots.real / np.abs(roots))[roots.imag > 0.0])


def test_a_ratio_is_that_of_the_single_platform():
    machine = jv.one_mass(mass=250.0, stiffness="4 x 50 N/mm", damping="5 %")
    assert float(machine.stiffness[0]) == 2e5
    np.testing.assert_allclose(decay_ratios(machine), [0.05], rtol=1e-12)


def test_a_ratio_of_a_link_is_that_of_two_free_platforms():
    link = dict(link_stiffness=2e5, link_damping="3 %")
    machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(0.0, 0.0), damping=(0.0, 0.0), **link)
    np.testing.assert_allclose(np.max(decay_ratios(machine)), 0.03, rtol=1e-6)


def test_a_ratio_of_a_rotor_is_that_of_its_translation():
    machine = jv.rotor(
        mass=37.0,
        transverse_inertia=0.5,
        polar_inertia=0.1,
        stiffness=(6e5, 3e5),
        damping="4 %",
        position=(0.1, -0.2),
    )  # no coupling of translation and tilt
    assert np.min(np.abs(decay_ratios(machine) - 0.04)) < 1e-9


def test_a_loss_factor_is_the_energy_lost_at_its_frequency():
    eta, w, amplitude = 0.1, 2.0 * np.pi * 16.0, 2e-3
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=f"loss factor {eta} at 16 Hz")
    lost = np.pi * float(machine.damping[0]) * w * amplitude**2  # in a period
    np.testing.assert_allclose(lost, 2.0 * np.pi * eta * 0.5 * 4e4 * amplitude**2, rtol=1e-12)


def test_a_support_of_a_body_needs_the_mass_it_carries():
    spring = dict(at=(1.0, 0.0), stiffness=(1e5, 4e5))
    with pytest.raises(jv.InputError, match=r"damping\[0\] is '5 %'.*needs the mass m .* write for example '5 % of 250 kg'"):
        jv.support(**spring, damping="5 %")
    found = jv.support(**spring, damping="5 % of 250 kg").damping
    np.testing.assert_allclose(found, 0.1 * np.sqrt([1e5 * 250.0, 4e5 * 250.0]), rtol=1e-12)


def test_a_loss_factor_at_the_frequency_of_the_message_is_read():
    """At the resonance of a rotor a loss factor is twice a damping ratio."""
    rotor = {"mass": 62.0, "stiffness": 95e3}
    with pytest.raises(jv.InputError, match=r"'loss factor 0\.08 at 6\.23 Hz'"):
        jv.planar_rotor(**rotor, damping="loss factor 8 %")
    found, ratio = (jv.planar_rotor(**rotor, damping=each).damping for each in ("loss factor 0.08 at 6.23 Hz", "4 %"))
    np.testing.assert_allclose(found, ratio, rtol=1e-3)
    spring = {"at": (0.0, 0.0), "stiffness": (1e5, 4e5)}
    with pytest.raises(jv.InputError, match=r"'loss factor 0.08 at 16 Hz' \(for a rotor, that of its resonance\)"):
        jv.support(**spring, damping="loss factor 8 %")


@pytest.mark.parametrize(
    ("damping", "words"),
    [
        ("-5 %", "must be at least 0"),
        ("5 % of 3 m", "not in kg"),
        ("loss 0.1", "without the frequency of the vibration; write for example 'loss factor 0.1 at 4.502 Hz'"),
        ("loss factor 8 %", r"'loss factor 0.08 at 4.502 Hz' \(at resonance on this spring it is 4.502 Hz\)"),
        ("loss factor high", "write a damping as '5 %'"),
        ("% 5", "write a damping as '5 %'"),
        ("loss factor 0.1 at 3 kg", "not in rad/s"),
        ("loss factor 0.1 at 16", "write the frequency with its unit: 'loss factor 0.1 at 16 Hz'"),
        (("5 %", "5 %"), r"machine\.damping has 2 values; the number of springs is 1"),
    ],
)
def test_wrong_ratios_are_refused(damping, words):
    with pytest.raises(jv.InputError, match=words):
        jv.one_mass(mass=50.0, stiffness=4e4, damping=damping)


def test_a_ratio_of_a_spring_without_stiffness_is_refused():
    with pytest.raises(jv.InputError, match=r"machine.damping\[1\] is '5 %' of a spring without stiffness"):
        jv.two_mass(mass=(1.0, 1.0), stiffness=(1e4, 0.0), damping=("5 %", "5 %"), link_stiffness=1e4, link_damping=1.0)


FILE = """[machine]
kind = "one_mass"
mass = 120.0
stiffness = "4 x 50 N/mm"   # four springs
damping = "5 %"             # of critical
[loads]
kind = "ball"
count = 3
mass = "800 g"
radius = "120 mm"
ball_radius = "20 mm"
[loads.drag]
cause = "oil"
radius = "120 mm"
load_speed = "400 rpm"
rotor_speed = "600 rpm"
ball_radius = "20 mm"
viscosity = "0.1 Pa s"
density = 870
[drive]
kind = "constant_speed"
speed = "600 rpm"
"""


def test_a_found_machine_keeps_the_constant_of_a_ratio():
    scene = jv.scene_from_toml(FILE)
    assert float(scene.loads.drag) == float(
        jv.drag_of(
            "oil",
            radius=0.12,
            load_speed="400 rpm",
            rotor_speed="600 rpm",
            ball_radius=0.02,
            viscosity=0.1,
            density=870.0,
        )
    )
    stiffer = scene.replace(machine=jv.one_mass(mass=120.0, stiffness="4 x 55 N/mm", damping=scene.machine.damping))
    text = rewrite_scene(FILE, stiffer)
    assert 'stiffness = "4 x 55 N/mm"  # was "4 x 50 N/mm"; four springs' in text and 'was "5 %"; of critical' in text
    assert 'stiffness = "4*55 N/mm"' in rewrite_scene(FILE.replace("4 x 50", "4*50"), stiffer)
    np.testing.assert_allclose(jv.scene_from_toml(text).machine.damping, scene.machine.damping, rtol=1e-7)
    faster = scene.replace(drive=jv.ConstantSpeed("700 rpm"))
    assert 'damping = "5 %"             # of critical' in rewrite_scene(FILE, faster)


def test_a_changed_product_of_mass_and_radius_keeps_its_radius():
    text = """machine = { kind = "planar_rotor", mass = "18 kg", stiffness = "30 N/mm", damping = "8 %" }
drive = { kind = "constant_speed", speed = "1200 rpm" }
[loads]
kind = "ball"
count = 2
mass = "0.1 kg"
radius = "250 mm"
drag = 0.15
[effects.static_imbalance]
moment = "0.3 kg x 0.24 m"
"""
    scene = jv.scene_from_toml(text)
    heavier = scene.replace(effects=(jv.StaticImbalance(0.096),))
    assert 'moment = "0.4 kg x 0.24 m"  # was "0.3 kg x 0.24 m"' in rewrite_scene(text, heavier)


def test_gradients_pass_through_a_ratio():
    import jax

    def constant(k):
        return jv.one_mass(mass=250.0, stiffness=k, damping="5 %").damping[0]

    np.testing.assert_allclose(jax.grad(constant)(jnp.asarray(2e5)), 0.05 * np.sqrt(250.0 / 2e5), rtol=1e-12)


@pytest.mark.parametrize("name", ["radius", "ball_radius"])
def test_radii_of_a_drag_and_of_its_loads_are_equal(name):
    head, tail = FILE.split("[drive]")
    old = {"radius": '\nradius = "120 mm"', "ball_radius": 'ball_radius = "20 mm"'}[name]
    place = head.rindex(old)
    other = head[:place] + old.replace("20 mm", "25 mm") + head[place + len(old) :]
    with pytest.raises(jv.InputError, match=rf"^loads\.drag\.{name} is 0\.\d+ m, but loads\.{name} is 0\.\d+ m; give the same"):
        jv.scene_from_toml(f"{other}[drive]{tail}")


def test_the_radius_of_a_drag_is_that_of_its_loads():
    without = FILE.replace('cause = "oil"\nradius = "120 mm"', 'cause = "oil"')
    assert without != FILE
    np.testing.assert_array_equal(jv.scene_from_toml(without).loads.drag, jv.scene_from_toml(FILE).loads.drag)
