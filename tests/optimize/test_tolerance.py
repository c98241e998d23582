"""Ranges of quantities over machines within tolerances, against closed forms of one mass."""

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.files import SCREENS, scene_from_toml
from optimize import expected, jam_frequency, quantile, static_deflection, tolerance_ranges, total, worst
from optimize.tolerance import _machines, read_tolerances


@pytest.fixture
def scene():
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    return jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("400 rpm"))


def test_range_of_a_sag_is_that_of_the_stiffness(scene):
    found = tolerance_ranges(scene, [static_deflection()], ["stiffness=10%"], samples=400)[0]
    sag = 51.0 * 9.80665 / 4e4
    np.testing.assert_allclose(found.design, sag, rtol=1e-12)
    np.testing.assert_allclose([found.low, found.high], [sag / 1.1, sag / 0.9], rtol=0.01)
    assert found.share == 1.0 and found.worst <= sag / 0.85 * (1.0 + 1e-9)


def test_material_on_the_platform_adds_its_weight(scene):
    found = tolerance_ranges(scene, [static_deflection()], ["material=0..20kg"], samples=400)[0]
    lowest, highest = (9.80665 * (51.0 + 20.0 * share) / 4e4 for share in (0.025, 0.975))
    np.testing.assert_allclose([found.low, found.high], [lowest, highest], rtol=1e-3)


def test_share_of_machines_that_meet_a_demand(scene):
    limit = 9.80665 * (51.0 + 5.0) / 4e4
    below, above = tolerance_ranges(
        scene, [static_deflection() < limit, static_deflection() > limit], ["machine.mass=50..70 kg"], samples=400
    )
    np.testing.assert_allclose([below.share, above.share], [0.25, 0.75], atol=0.003)
    assert below.worst > limit > above.worst


def test_a_statistic_is_named_as_the_quantity_of_one_machine(scene):
    sag = static_deflection()
    least = worst(sag, {"machine.mass": 0.1}, is_large_good=True)
    off = {"machine.mass": 0.1}
    others = [worst(sag, off), expected(sag, off), quantile(sag, 0.95, off)]
    found = tolerance_ranges(scene, [least > "1 mm", sag.named("worst sag"), *others], ["mass=5%"], samples=4)
    assert [each.words for each in found] == [f"{sag.words} at least 1 mm", "worst sag", *[sag.words] * 3]


def test_modes_that_vanish_lower_the_share(scene):
    found = tolerance_ranges(scene, [jam_frequency(mode=1)], ["machine.stiffness=1e4..1e5 N/m"], samples=32)[0]
    assert 0.0 < found.share < 1.0 and np.isfinite(found.high)


@pytest.mark.parametrize(
    "text",
    [
        *["stiffness", "stiffness=5", "stiffness=200%", "nothing=5%", "material=20..0kg", "material=0..2m"],
        *["machine.mass=-70..-60 kg", "material=-50..0 kg"],  # no machine has such masses
    ],
)
def test_wrong_tolerances_are_refused(scene, text):
    with pytest.raises(jv.InputError, match="tolerance"):
        tolerance_ranges(scene, [static_deflection()], [text], samples=4)


@pytest.mark.parametrize("samples", [0, -3, 10**12])
def test_numbers_of_machines_are_limited(scene, samples):
    for compute in (
        tolerance_ranges,
        lambda *_, samples: expected(static_deflection(), {"machine.mass": 0.1}, samples=samples),
    ):
        with pytest.raises(jv.InputError, match=f"samples is {samples}"):
            compute(scene, [static_deflection()], ["mass=1%"], samples=samples)


def test_deviations_of_two_kinds_of_tolerances_are_independent(scene):
    machines = list(_machines(scene, ["stiffness=5%", "loads.drag=0.5..1.5"], 64, 0))
    numbers = np.array([[float(each.machine.stiffness[0]), float(each.loads.drag)] for each in machines])
    assert abs(np.corrcoef(numbers.T)[0, 1]) < 0.3


def test_unknown_short_names_are_answered_by_the_known_ones(scene):
    for text, says in (
        ("stiffnes=5%", "did you mean 'stiffness'"),
        ("load=0..20kg", r"unbalance, material \(mass on a platform\), and parameters"),
    ):
        with pytest.raises(jv.InputError, match=says):
            read_tolerances(scene, [text])


def test_range_of_an_array_adds_no_spring():
    machine = jv.two_mass(mass=(50.0, 40.0), stiffness=(4e4, 0.0), damping=(0.0, 0.0), link_stiffness=1e5, link_damping=60.0)
    two = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("400 rpm"))
    sums = tolerance_ranges(two, [total("machine.stiffness")], ["machine.stiffness=4e4..6e4"], samples=4)[0]
    np.testing.assert_allclose([sums.low, sums.worst], [4.25e4 + 0.025 * 1.5e4, 5.75e4])
    with pytest.raises(jv.InputError, match=r"machine\.damping is 0 in every entry"):
        read_tolerances(two, ["machine.damping=1..2"])


@pytest.mark.parametrize(
    "texts",
    [
        ["stiffness=5%", "machine.stiffness[0]=2%"],
        ["machine.stiffness=30..50 N/mm", "stiffness=5%"],
        ["mass=1%", "mass=2%"],
        ["machine.mass=50..60 kg", "machine.mass=55..65 kg"],
    ],
)
def test_number_with_two_tolerances_is_refused(scene, texts):
    with pytest.raises(jv.InputError, match=r"tolerances name a number of .* twice; give one tolerance"):
        read_tolerances(scene, texts)
    with pytest.raises(jv.InputError, match="twice"):
        expected(static_deflection(), {"machine.stiffness": 0.05, "machine.stiffness[0]": 0.02})(scene)
    assert len(read_tolerances(scene, ["mass=1%", "material=0..20kg"]).ranges) == 1


def test_short_names_of_a_body_are_all_its_springs():
    scene = scene_from_toml(SCREENS["linear_screen"])
    each = [f"machine.supports[{k}].stiffness[{j}]" for k in (0, 1) for j in (0, 1)]
    assert read_tolerances(scene, ["stiffness=5%"]).relative == tuple((name, 0.05) for name in each)
    assert [name for name, _ in read_tolerances(scene, ["mass=1%", "unbalance=2%"]).relative] == [
        "machine.mass",
        "exciters[0].unbalance",
        "exciters[1].unbalance",
    ]
    (material,) = read_tolerances(scene, ["material=0..20kg"]).ranges
    assert (material.number.name, material.low, material.high, material.is_added) == ("machine.mass", 0.0, 20.0, True)
    with pytest.raises(jv.InputError, match=r"machine.mass\[1\]"):
        read_tolerances(scene, ["material[2]=0..20kg"])


def test_short_names_of_a_network_of_bodies():
    supports = [jv.support(at=(0.0, 0.0), stiffness=(1e5, 2e5), damping=(1e2, 2e2), body=k) for k in (0, 1)]
    machine = jv.plane_network([jv.body(mass=100.0, inertia=10.0), jv.body(mass=50.0, inertia=5.0)], supports)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.1)])
    relative = read_tolerances(scene, ["mass=1%", "damping=30%"]).relative
    assert relative[:2] == (("machine.bodies[0].mass", 0.01), ("machine.bodies[1].mass", 0.01)) and len(relative) == 6
    assert read_tolerances(scene, ["material[2]=0..20kg"]).ranges[0].number.name == "machine.bodies[1].mass"
