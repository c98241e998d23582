"""Parts of the balanced arrangements, by geometry."""

import numpy as np
import pytest
from scenes import machines

import jaxvib as jv
from jaxvib.steady.balance import states
from jaxvib.steady.balance.arrangements import arrangements, inscribed_polygon, neutral_directions
from jaxvib.steady.balance.states import _growth_rate, stability_changes


@pytest.mark.parametrize("sides", [[1.0, 1.0, 1.0], [3.0, 4.0, 5.0], [1.0, 1.2, 2.1], [1.0, 2.0, 3.0, 5.5], [0.2, 7.0, 6.9]])
@pytest.mark.parametrize("size", [1.0, 1e-9, 1e6])
def test_sides_in_these_directions_close_a_polygon_in_a_circle(sides, size):
    """Corners are as far from one centre: that of the triangle of the first three."""
    sides = size * np.asarray(sides)
    steps = sides * np.exp(1j * inscribed_polygon(sides))
    corners = np.cumsum(steps)
    assert abs(corners[-1]) < 1e-12 * size and steps[0] == sides[0]
    a, b = corners[0], corners[1]  # the third of them is the origin
    centre = (a * abs(b) ** 2 - b * abs(a) ** 2) / (np.conj(b) * a - np.conj(a) * b)
    np.testing.assert_allclose(np.abs(corners - centre), abs(centre), rtol=1e-8)


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e7])
def test_arrangements_do_not_depend_on_the_size_of_the_loads(size):
    def arrangement(mass):
        loads = jv.balls(count=3, mass=mass, radius=0.1, drag=1.0)
        return jv.balanced_states(jv.Scene(machines()["two_mass"], loads, jv.ConstantSpeed(30.0)))

    found = arrangement([3.0 * size, 4.0 * size, 5.0 * size])
    np.testing.assert_allclose(found.angles, arrangement([3.0, 4.0, 5.0]).angles, atol=1e-9)
    assert len(found.angles) == 2
    line = arrangement([0.1 * size, 0.2 * size, 0.3 * size])  # 0.1 + 0.2 is 0.3 but for rounding
    np.testing.assert_allclose(line.angles, [[0.0, 0.0, np.pi]], atol=1e-12)
    assert not len(arrangement([0.1 * size, 0.2 * size, 0.3001 * size]).angles)


def test_neutral_directions_keep_the_sum():
    sides = np.array([1.0, 1.0, 1.0, 1.0, 2.0])
    angles = inscribed_polygon(sides)
    for turns in (True, False):
        found = neutral_directions(sides, angles, turns=turns)
        assert found.shape == (5, 3)  # of five angles two conditions leave three, a common turn among them
        change = np.stack([-sides * np.sin(angles), sides * np.cos(angles)]) @ found
        np.testing.assert_allclose(change, 0.0, atol=1e-11)
        np.testing.assert_allclose(found.T @ found, np.eye(3), atol=1e-12)
        if turns:
            np.testing.assert_allclose(found[:, 0], 5**-0.5)


def test_growth_is_that_of_the_multipliers_but_the_neutral_ones():
    """A multiplier exp(2 pi (g + i w)/n) has the growth g."""
    growth, speed = np.array([0.0, -0.2, 0.3, 0.0]), 50.0
    multipliers = np.exp(2.0 * np.pi * (growth + 1j * np.array([0.0, 3.0, 7.0, 0.0])) / speed)
    np.testing.assert_allclose(_growth_rate(multipliers, speed, 2), 0.3, rtol=1e-10)
    np.testing.assert_allclose(_growth_rate(multipliers[:2], speed, 1), -0.2, rtol=1e-10)


def test_changes_of_stability_are_halved_until_they_are_known(monkeypatch):
    at, asked = np.array([12.3456, 34.5678]), []

    def growth(scene, speeds, angles, *, steps):
        asked.append(speeds)
        return np.prod(np.asarray(speeds)[:, None] - at, axis=1)

    monkeypatch.setattr(states, "balanced_growth", growth)
    speeds = np.linspace(10.0, 40.0, 7)
    found = stability_changes(None, speeds, growth(None, speeds, None, steps=0) < 0.0, rtol=1e-4)
    np.testing.assert_allclose(found, at, rtol=1e-4)
    assert 10 < len(asked) < 18  # from 5 in 10 to 1e-4


def test_balance_of_a_machine_free_to_drift_is_refused():
    machine = jv.two_mass(mass=50.0, stiffness=0.0, damping=0.0, link_stiffness=4e4, link_damping=50.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.2, radius=0.1, drag=0.2), jv.ConstantSpeed(60.0))
    with pytest.raises(jv.InputError, match=r"^machine\.stiffness lets the machine drift"):
        states.balanced_stability(scene)


@pytest.mark.parametrize(
    "speeds",
    [
        None,
        set(),
        [True],
        [1j],
        b"12",
        "x",
        ["x"],
        [[20.0]],
        [10**400],
        range(10**9),
        np.array(["x"]),
        np.ma.array([1.0], mask=[True]),
    ],
    ids=lambda speeds: str(speeds)[:20],
)
def test_speeds_of_growth_rates_are_numbers(speeds):
    scene = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
        jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0),
        jv.ConstantSpeed(40.0),
    )
    with pytest.raises(jv.InputError, match=r"^speeds"):
        jv.balanced_states(scene).growth(speeds)


@pytest.mark.parametrize("stiffness", [5e4, 2e7])
def test_undamped_vibration_has_no_stable_interval(stiffness):
    machine = jv.two_mass(
        mass=(120.0, 95.0), stiffness=(stiffness, 5e4), damping=(0.0, 400.0), link_stiffness=0.0, link_damping=0.0
    )
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=5.0), jv.ConstantSpeed(60.0))
    assert jv.balanced_states(scene).stability().status_name == "undecided"
    assert jv.balanced_states(scene).intervals(50.0, 90.0, points=20) == []


def test_loads_without_unbalance_in_rounding_are_refused():
    with pytest.raises(jv.InputError, match=r"^loads have unbalances of 0 within rounding"):
        arrangements(np.zeros(2), 0.0, 0.0, ordered=False)
