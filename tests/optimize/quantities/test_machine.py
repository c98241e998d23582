"""Quantities of the machine itself: sums, weight, sag, cost."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib.machine.files import SCREENS
from optimize import product, spring_cost, static_deflection, support_frequency_squared, total, total_mass

SCENE, THREE, CHAIN = scene("two_mass"), scene("three_mass", "pendulums"), scene("network")


def with_springs(s, support, link):
    return eqx.tree_at(lambda s: (s.machine.stiffness, s.machine.link_stiffness), s, (jnp.asarray(support), jnp.asarray(link)))


def test_a_number_that_loads_share_counts_for_each():
    for field, each in (("loads.mass", 0.8), ("loads.drag", 1.5), ("loads.radius", 0.12)):
        assert float(total(field)(SCENE)) == pytest.approx(3.0 * each) and float(product(field)(SCENE)) == pytest.approx(
            each**3
        )
    assert float(total("loads.mass")(THREE)) == pytest.approx(0.5 + 0.6 + 0.7 + 0.8)
    assert float(product("loads.mass")(THREE)) == pytest.approx(0.5 * 0.6 * 0.7 * 0.8)
    assert float(total("machine.mass")(SCENE)) == 215.0 and float(total_mass()(SCENE)) == pytest.approx(215.0 + 2.4)
    assert float(total_mass()(THREE)) == pytest.approx(90.0 + 2.6)
    slope = jax.grad(lambda mass: total("loads.mass")(eqx.tree_at(lambda s: s.loads.mass, SCENE, mass)))(0.8)
    assert float(slope) == 3.0


def test_sums_are_named_by_what_they_add():
    assert total("loads.mass").words == "sum of mass of all loads"
    assert total("machine.mass").words == "sum of mass of all platforms"
    assert product("loads.drag").words == "product of drag of all loads" and product("loads.drag").unit == ""
    assert total("machine.link_damping").words == "sum of damping of all links" and total("loads.inertia").unit == "kg m^2"
    for wrong in ("drive.speed", "machine.length", "mass", 3, "machine.drag.x"):
        with pytest.raises(jv.InputError, match=r"must name parameters of a scene|field is 3; it must be a string"):
            total(wrong)
    with pytest.raises(jv.InputError, match="which this scene does not have"):
        total("loads.inertia")(SCENE)


def test_the_budget_is_the_sum_of_squared_frequencies():
    """The exciter is on platform 3, with four loads of 2.6 kg."""
    awaited = 1e4 / 30.0 + 4e4 / 40.0 + 3e3 / (20.0 + 2.6)
    np.testing.assert_allclose(support_frequency_squared()(THREE), awaited, rtol=1e-12)


def test_platforms_sag_under_the_weight_above():
    """A platform on a support, another one hung from it, a third one hung from that: forces add from below."""
    hung = with_springs(THREE, [1e4, 0.0, 0.0], [2e4, 0.0, 5e4])  # links 1-2, 1-3, 2-3
    weights = 9.80665 * np.array([30.0, 40.0, 22.6])
    sag = np.cumsum([weights.sum() / 1e4, weights[1:].sum() / 2e4, weights[2] / 5e4])
    np.testing.assert_allclose([static_deflection(k)(hung) for k in (1, 2, 3)], sag, rtol=1e-12)
    np.testing.assert_allclose(static_deflection()(hung), sag[2], rtol=1e-12)
    assert (
        static_deflection(2).words == "static deflection of platform or body 2"
        and static_deflection().words == "static deflection"
    )
    for wrong in (0, -1, 1.5):
        with pytest.raises(jv.InputError, match="of is"):
            static_deflection(wrong)
    with pytest.raises(jv.InputError, match="platforms 1 to 3"):
        static_deflection(4)(hung)


def test_bodies_in_a_plane_have_a_static_deflection():
    """A body in a plane sags by M g / k; a body on another one by the sum of both deflections."""
    feeder = jv.scene_from_toml(SCREENS["feeder"])
    np.testing.assert_allclose(static_deflection()(feeder), 400.0 * 9.80665 / 252e3, rtol=1e-12)
    with pytest.raises(jv.InputError, match="bodies 1 to 1"):
        static_deflection(2)(feeder)
    upper = [jv.support(at=(x, 0.0), stiffness=(2e5, 3e5), damping=(0.0, 0.0), to=1, at_other=(x, 0.0)) for x in (-1.0, 1.0)]
    lower = [jv.support(at=(x, 0.0), stiffness=(5e5, 8e5), damping=(0.0, 0.0), body=1) for x in (-1.0, 1.0)]
    bodies = [jv.body(mass=300.0, inertia=100.0), jv.body(mass=200.0, inertia=80.0)]
    double = jv.Scene(jv.plane_network(bodies, upper + lower), exciters=feeder.exciters)
    below = 500.0 * 9.80665 / 16e5
    np.testing.assert_allclose(static_deflection(2)(double), below, rtol=1e-9)
    np.testing.assert_allclose(static_deflection()(double), below + 300.0 * 9.80665 / 6e5, rtol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e9])
def test_unsupported_platforms_have_no_static_deflection(scale):
    """Up to rounding the stiffness matrix is singular: the solution would be 1e13 m, or any number."""
    free = with_springs(THREE, np.zeros(3), scale * np.array([1e4, 5e3, 2e4]))
    for of in (None, 1, 2, 3):
        assert np.isnan(static_deflection(of)(free))
    part = with_springs(
        THREE, scale * np.array([1e4, 0.0, 0.0]), scale * np.array([2e4, 0.0, 0.0])
    )  # platform 3 hangs in the air
    assert np.isnan(static_deflection()(part)) and np.isnan(static_deflection(3)(part))
    np.testing.assert_allclose(static_deflection(2)(part), 9.80665 * (70.0 / 1e4 + 40.0 / 2e4) / scale, rtol=1e-9)
    # A long chain is carried by its last platform.
    last = with_springs(CHAIN, [0.0, 0.0, 0.0, 0.0, scale], scale * np.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0]))
    np.testing.assert_allclose(static_deflection(5)(last), 9.80665 * (35.0 + 2.4) / scale, rtol=1e-9)
    assert np.isfinite(static_deflection(1)(last))
    slope = jax.grad(
        lambda k: static_deflection(2)(with_springs(part, scale * jnp.array([k, 0.0, 0.0]), part.machine.link_stiffness))
    )
    np.testing.assert_allclose(slope(1e4), -9.80665 * 70.0 / 1e8 / scale, rtol=1e-9)


def cost(prices, *springs):
    support, link = jnp.asarray(springs[:2]), jnp.asarray([springs[2]])
    return float(spring_cost(prices)(with_springs(SCENE, support, link)))


def test_spring_cost_follows_the_price_list():
    rising = [(1e4, 20.0), ("20 N/mm", 30.0), (4e4, 90.0)]
    assert cost(rising, 1e4, 1.5e4, 3e4) == pytest.approx(20.0 + 25.0 + 60.0)
    assert cost(rising, 0.0, 0.0, 4e4) == pytest.approx(90.0)  # no spring costs nothing
    assert cost(rising, 1e2, 0.0, 0.0) == pytest.approx(20.0)  # not 10.1: no softer spring is cheaper
    assert cost(rising, 6e4, 0.0, 0.0) == pytest.approx(150.0)  # on as between the last two
    steep = [(1e5, 1.0), (1.1e5, 100.0)]
    assert cost(steep, 5e4, 3e4, 2e5) == pytest.approx(1.0 + 1.0 + 991.0)
    falling = [(1e4, 90.0), (2e4, 30.0)]
    assert cost(falling, 3e4, 9e4, 5e3) == pytest.approx(30.0 + 30.0 + 120.0)
    assert spring_cost(rising, "EUR").unit == "EUR"


@pytest.mark.parametrize(
    ("prices", "says"),
    [
        ([(1e4, 1.0), (2e4, -1.0)], r"prices\[1\] has the price -1"),
        ([(1e4, 1.0), (2e4, np.nan)], r"prices\[1\] is nan; a finite"),
        ([(1e4, np.inf), (2e4, 1.0)], r"prices\[0\] is inf; a finite"),
        ([(0.0, 1.0), (2e4, 1.0)], "must have ascending stiffnesses"),
        ([(1e4, 1.0), (1e4, 2.0)], "must have ascending stiffnesses"),
        (3.0, "it must be a list of values"),
    ],
)
def test_wrong_price_lists_are_refused(prices, says):
    with pytest.raises(jv.InputError, match=says):
        spring_cost(prices)
