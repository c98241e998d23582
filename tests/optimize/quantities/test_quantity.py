"""Quantities and demands as expressions: their pieces, units, words; what they ask."""

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import optimize
from jaxvib import InputError
from optimize import Quantity, amplitude, foundation_force, largest, least
from optimize.quantities.evaluation import Evaluation
from optimize.quantities.quantity import BuiltinQuantity, Demand

SCENE = scene("two_mass")


def constant(name, value, unit=""):
    return Quantity(name, unit, lambda s: jnp.asarray(value))


A, B, C = constant("a", 2.0), constant("b", 5.0), constant("c", -3.0)
TOP, LOW = largest(A, B), least(A, C)


@pytest.mark.parametrize(
    ("quantity", "sign", "pieces"),
    [
        (A, 1.0, [2.0]),
        (A, -1.0, [-2.0]),
        (TOP, 1.0, [2.0, 5.0]),
        (TOP, -1.0, [-5.0]),  # minus the largest is the least: no search goes along its kinks
        (LOW, -1.0, [-2.0, 3.0]),
        (LOW, 1.0, [-3.0]),
        (-LOW, 1.0, [-2.0, 3.0]),
        (-TOP, -1.0, [2.0, 5.0]),
        (-TOP, 1.0, [-5.0]),
        (TOP + largest(A, C), 1.0, [4.0, -1.0, 7.0, 2.0]),
        (TOP - LOW, 1.0, [0.0, 5.0, 3.0, 8.0]),
        (LOW - TOP, -1.0, [0.0, 3.0, 5.0, 8.0]),
        (TOP * A, 1.0, [4.0, 10.0]),
        (B * TOP, 1.0, [10.0, 25.0]),
        (LOW * A, -1.0, [-4.0, 6.0]),
        (TOP * C, 1.0, [-15.0, -15.0]),  # by what is negative they would be those of the least
        (TOP / A, 1.0, [1.0, 2.5]),
        (TOP / C, 1.0, [-5.0 / 3.0, -5.0 / 3.0]),
        (A / TOP, 1.0, [0.4]),
        (A * B, 1.0, [10.0]),
        (TOP**2, 1.0, [25.0]),
        (largest(TOP, 3.0 * A), 1.0, [2.0, 5.0, 6.0]),
    ],
)
def test_the_largest_piece_is_the_quantity(quantity, sign, pieces):
    found = quantity.pieces(Evaluation(SCENE), sign)
    np.testing.assert_allclose(found, pieces, rtol=1e-14)
    np.testing.assert_allclose(jnp.max(found), sign * quantity(SCENE), rtol=1e-14)


def test_functions_of_a_scene_and_of_its_jam_modes():
    Quantity("one", "", lambda s: s.drive.speed)
    Quantity("two", "", lambda s, modes: modes.omega[0])
    Quantity("more may be given", "", lambda s, k=3: s.drive.speed)
    for wrong in (None, 3.0, lambda: 1.0, lambda s, modes, more: 1.0):
        with pytest.raises(ValueError, match="give a function of a scene, or of a scene and its jam modes"):
            Quantity("wrong", "", wrong)


@pytest.mark.parametrize("value", [None, "3", [1.0], jnp.ones(2)])
def test_function_that_gives_no_scalar_is_named(value):
    with pytest.raises(InputError, match=r"quantity 'weight' gives .*; it must give one real number"):
        Quantity("weight", "kg", lambda scene: value)(SCENE)


def test_units_and_names_of_expressions():
    force, arm, time = constant("force", 3.0, "N"), constant("arm", 2.0, "m"), constant("time", 1.0, "s")
    expressions = {
        (force + "2 N"): ("force + 2 N", "N"),
        (force * arm): ("force * arm", "N m"),
        (force * arm) * time: ("force * arm * time", "(N m) s"),
        ((force + force) * arm): ("(force + force) * arm", "N m"),
        (force / (arm * time)): ("force / arm * time", "N/(m s)"),
        (force / arm): ("force / arm", "N/m"),
        (force / force): ("force / force", ""),
        (force / 2.0): ("force / 2", "N"),
        (1.0 / time): ("1 / time", "1/s"),
        (arm**2): ("(arm)^2", "(m)**2"),
        -force: ("negative force", "N"),
        largest(force, 2.0 * force): ("largest of (force; 2 * force)", "N"),
    }
    for expression, (words, unit) in expressions.items():
        assert (expression.words, expression.unit) == (words, unit)
    own = amplitude(mode=3, of=2)
    for built in (own + own, 2.0 * own, constant("x", 1.0, "m") / own, largest(own, 3.0 * own), own - constant("x", 1.0, "m")):
        assert built.mode == 3 and built.of == 2
    assert (force * arm).mode is None and (force * arm).of is None


@pytest.mark.parametrize("wrong", [True, float("inf"), None, [1.0]])
def test_operands_that_are_not_numbers_are_refused(wrong):
    with pytest.raises(ValueError, match=r"the value combined with a is .*(a plain number|finite number|one plain number)"):
        A + wrong
    with pytest.raises(ValueError, match=r"is 3\.0; it must be a Quantity"):
        largest(A, 3.0)


def test_excess_of_a_demand_is_its_violation():
    evaluation = Evaluation(SCENE)
    most, more, other = A < 3.0, A > 5.0, B < A
    assert (most.constant, more.constant, other.constant) == (3.0, 5.0, None)
    for demand, limit, excess in ((most, 3.0, -1.0), (more, 5.0, 3.0), (other, 0.0, 3.0), (B > A, 0.0, -3.0), (most, 1.5, 0.5)):
        np.testing.assert_allclose(demand.excess(evaluation, jnp.asarray(limit)), excess, rtol=1e-14)
    assert most.form() == (A < 8.0).form() != (A > 8.0).form() and most.form().constant == 0.0
    assert other.form() == Demand(B, A, "at most", "") and other.words == "b at most a"
    assert (foundation_force(mode=3) < "2 kN").words == "foundation force, mode 3 at most 2 kN"


def test_quantities_list_their_tiers():
    asked = []

    def function(evaluation, tier, *settings):
        asked.append((tier, settings))
        return evaluation.scene.drive.speed

    both = BuiltinQuantity("a_b", "", function, settings=(1, 2), tiers=("leading", "exact"))
    assert both.words == "a b" and both.at_tier("exact").words == "a b, exact" and both.at_tier("time") is both
    assert BuiltinQuantity("a_b", "", function, tiers=("leading",)).words == "a b"
    assert BuiltinQuantity("a_b", "", function, text="said so").words == "said so"
    exact = both.at_tier("exact")
    np.testing.assert_array_equal(exact.pieces(Evaluation(SCENE), -1.0), [-120.0])
    assert asked == [("exact", (1, 2))] and exact.simplified == both and not exact.forward_only
    timed = BuiltinQuantity("t", "", function, tier="time")
    assert timed.forward_only and (A + timed).forward_only and (timed * A).forward_only and not (A + both).forward_only
    assert (A + exact).simplified.parts == (A, both) and (A + both).at_tier("exact").parts == (A, exact)
    assert len(asked) == 1
    parted = BuiltinQuantity(
        "p", "", function, settings=(7,), pieces_function=lambda evaluation, sign, tier, seven: sign * jnp.array([1.0, seven])
    )
    np.testing.assert_array_equal(parted.pieces(Evaluation(SCENE), -1.0), [-1.0, -7.0])


@pytest.mark.parametrize("text", ["10 Hz", "600 rpm", "600 1/min", "10 rps", "62.83185307179586 rad/s"])
def test_text_in_a_sum_has_the_unit_of_the_quantity(text):
    speed = constant("speed", 100.0, "rad/s")
    np.testing.assert_allclose((speed - text)(SCENE), 100.0 - 20.0 * np.pi, rtol=1e-14)
    np.testing.assert_allclose((text + speed)(SCENE), 100.0 + 20.0 * np.pi, rtol=1e-14)
    np.testing.assert_allclose((speed < text).constant, 20.0 * np.pi, rtol=1e-14)


def test_ratio_of_a_speed_to_hertz_counts_revolutions():
    speed = constant("speed", 100.0, "rad/s")
    assert (speed / "10 Hz").unit == ""
    np.testing.assert_allclose((speed / "10 Hz")(SCENE), 5.0 / np.pi, rtol=1e-14)


def test_hertz_and_radians_per_second_are_not_compared():
    speed, frequency = constant("speed", 100.0, "rad/s"), constant("frequency", 10.0, "Hz")
    for wrong in (lambda: frequency < speed, lambda: speed > frequency, lambda: speed - frequency):
        with pytest.raises(InputError, match=r"rad/s"):
            wrong()
    np.testing.assert_allclose((frequency < "600 rpm").constant, 10.0, rtol=1e-14)
    np.testing.assert_allclose((frequency - "62.83185307179586 rad/s")(SCENE), 0.0, atol=1e-14)


def test_an_acceleration_is_compared_across_radians():
    size, speed = constant("size", 2e-3, "m"), constant("speed", 100.0, "rad/s")
    assert (size * speed**2 < "2 m/s^2").constant == 2.0


def test_comparisons_make_demands_of_their_sense():
    for demand, sense in ((A < 3.0, "at most"), (A <= 3.0, "at most"), (A > 3.0, "at least"), (A >= 3.0, "at least")):
        assert demand.sense == sense and demand.constant == 3.0 and demand.words == f"a {sense} 3"


def test_quantities_and_demands_read_as_they_are_written():
    force, travel, mass = optimize.foundation_force(mode=3), optimize.amplitude(mode=3, of=1), optimize.total_mass()
    slow = optimize.under(force, "slow", {"drive.speed": "1200 rpm"})
    expected = {
        'amplitude(mode=3, of=1) > "60 mm"': travel > "60 mm",
        'total_mass() < "300 kg"': mass < 300.0,
        "foundation_force(mode=3) / (total_mass() + total_mass())": force / (mass + mass),
        'amplitude(mode=3, of=1) - "1 mm"': travel - "1 mm",
        "-(foundation_force(mode=3) * 2)": -(force * 2.0),
        "foundation_force(mode=3) > total_mass() ** 2": Demand(force, mass**2.0, "at least", ""),
        'amplitude(mode=3, of=1).at_tier("exact")': travel.at_tier("exact"),
        'largest(total_mass(), total_mass().named("x"))': optimize.largest(mass, mass.named("x")),
        "under(foundation_force(mode=3), \"slow\", {'drive.speed': '1200 rpm'})": slow,
        'Quantity("heaviest", "kg", heaviest)': optimize.Quantity("heaviest", "kg", heaviest),
    }
    assert [repr(value) for value in expected.values()] == list(expected)
    assert travel.at_tier("exact") == optimize.amplitude(mode=3, of=1, tier="exact")


def heaviest(scene):
    return scene.machine.mass.max()
