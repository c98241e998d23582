"""Trade-offs against dense scans: every machine of a front is one that no other machine beats."""

import itertools
import sys
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from optimize import DesignSpace, Quantity, foundation_force, pareto, total_mass
from optimize.pareto import Front, not_dominated

SCENE = scene("two_mass", speed=120.0)
TWO = {"machine.stiffness": (1e4, 9e4, "even")}
THREE = {**TWO, "machine.link_stiffness": (1e5, 9e5, "even")}


def of_springs(name, function):
    """A quantity of the three stiffnesses, in tenths of their upper bounds; and the function of them."""
    return Quantity(name, "", lambda s: function(*(s.machine.stiffness / 1e4), s.machine.link_stiffness[0] / 1e5)), function


BOWL = of_springs("bowl", lambda x, y, link: (x - 6.0) ** 2 + (y - 5.0) ** 2 + 2.0)
FLAT = of_springs("flat", lambda x, y, link: 217.4 + 0.0 * x)
FIRST = of_springs("first", lambda x, y, link: x)
BENT = of_springs("bent", lambda x, y, link: (90.0 - x**2) ** 0.5 + 0.1 * (y - 3.0) ** 2)  # its front is concave
SUM = of_springs("sum", lambda x, y, link: x + y + link)
DEEP = of_springs("deep", lambda x, y, link: (x - 6.0) ** 2 + 0.5 * (y - 5.0) ** 2 + (link - x) ** 2 + 1.0)


def test_single_precision_is_refused():
    with jax.enable_x64(False):
        space = DesignSpace(scene("two_mass", speed=120.0), TWO)
        with pytest.raises(jv.InputError, match="needs double precision"):
            pareto(space, FIRST[0], BOWL[0], points=3, starts=2)


@pytest.mark.parametrize(
    ("one", "other", "free"),
    [(FLAT, BOWL, TWO), (FIRST, BOWL, TWO), (FIRST, BENT, TWO), (SUM, DEEP, THREE), (FLAT, DEEP, THREE)],
)
def test_fronts_are_those_of_dense_scans_in_both_orders(one, other, free):
    axis = np.linspace(1.0, 9.0, 65 if free is TWO else 33)
    grid = np.meshgrid(axis, axis, [2.0] if free is TWO else axis)
    scan = np.stack([np.broadcast_to(function(*grid), grid[0].shape).ravel() for _, function in (one, other)], axis=1)
    best = scan[not_dominated(scan)]
    span = np.maximum(np.ptp(best, axis=0), 1e-6 * best.max(axis=0))
    for order in (slice(None), slice(None, None, -1)):
        front = pareto(DesignSpace(SCENE, free), *[each for each, _ in (one, other)[order]], points=4, starts=8)
        values = front.values[:, order]
        for own in values:  # no machine of the scan is better in both, none of the front is as good as another one
            assert not np.any(np.all(scan < own - 1e-6 * span, axis=1))
        assert len(not_dominated(values)) == len(values) <= 4
        assert np.all(values.min(axis=0) <= best.min(axis=0) + 1e-6 * span)  # both ends are there
        if one is FLAT:
            assert len(values) == 1
        else:
            assert np.max(np.abs(np.diff(values[:, order][:, 1]))) <= np.ptp(values[:, order][:, 1]) / 3.0 + 1e-6


def test_springs_that_do_not_change_the_mass_leave_one_machine():
    """The least force at the only mass there is, whichever quantity is named first."""
    space, mass, force = DesignSpace(SCENE, TWO), total_mass(), foundation_force(mode=3)
    front = pareto(space, mass, force, points=3, starts=8)
    forces = []
    for k in itertools.product(np.linspace(1e4, 9e4, 5), repeat=2):
        built = eqx.tree_at(lambda s: s.machine.stiffness, SCENE, jnp.asarray(k))
        forces.append(float(jv.jam_modes(built).select(3).foundation_force))
    assert len(front.values) == 1 and front.values[0, 0] == pytest.approx(217.4)
    assert front.values[0, 1] <= min(forces) + 1e-6
    np.testing.assert_allclose(front.values[0, 1], float(force(front.scene(0))), rtol=1e-9)
    for wrong in (-1, 1, 0.0):
        with pytest.raises(jv.InputError, match="k is"):
            front.scene(wrong)


def test_demands_hold_on_the_whole_front():
    first, other = FIRST[0], BOWL[0]
    front = pareto(DesignSpace(SCENE, TWO), first, other, points=3, starts=4, subject_to=first > 2.0)
    assert len(front.values) == 3
    np.testing.assert_allclose(front.values[:, 0].min(), 2.0, rtol=1e-6)
    np.testing.assert_allclose(front.values[:, 1], (front.values[:, 0] - 6.0) ** 2 + 2.0, rtol=1e-6)


def test_machines_without_one_of_the_quantities_are_left_out():
    half = Quantity(
        "half", "", lambda s: jnp.where(s.machine.stiffness[0] > 3e4, (s.machine.stiffness[1] / 1e4 - 5.0) ** 2, jnp.nan)
    )
    front = pareto(DesignSpace(SCENE, TWO), FIRST[0], half, points=3, starts=8)
    assert np.all(np.isfinite(front.values)) and np.all(front.values[:, 0] > 3.0)


def test_not_dominated_rows_are_those_of_all_comparisons():
    random = np.random.default_rng(0)
    values = np.round(random.normal(size=(200, 2)), 1) * [1.0, 1e6]  # many are equal in one column, some in both
    found = not_dominated(values)
    expected = {tuple(own) for own in values if not any(np.all(other <= own) and np.any(other < own) for other in values)}
    assert sorted(map(tuple, values[found])) == sorted(expected) and len(found) == len(expected)
    assert np.all(np.diff(values[found][:, 0]) > 0.0)
    near = np.array([[1.0, 5.0], [1.0 + 1e-8, 5.0 - 1e-8], [2.0, 1.0]])
    assert len(not_dominated(near)) == 2
    assert not_dominated(np.array([[3.0, -1.0]])) == [0] and not_dominated(np.array([[0.0, 2.0], [0.0, 1.0]])) == [1]


def test_rows_equal_within_tolerance_count_once():
    """1e-7 of the largest value of a column that hardly changes, 1e-6 of the range of one that does."""
    assert not_dominated(np.array([[1e6, 2.0], [1e6 + 0.05, 1.0]])) == [1]
    assert not_dominated(np.array([[1e6, 2.0], [1e6 + 0.2, 1.0]])) == [0, 1]
    assert not_dominated(np.array([[0.0, 2.0], [5e-7, 1.0], [1.0, 0.0]])) == [1, 2]
    assert not_dominated(np.array([[0.0, 2.0], [2e-6, 1.0], [1.0, 0.0]])) == [0, 1, 2]


def test_the_figure_of_a_front_has_the_first_quantity_upward():
    values = np.array([[10.0, 3e-3], [20.0, 2e-3], [40.0, 1e-3]])
    front = Front(values=values, names=("mass", "sag"), units=("kg", "m"), machines=("a", "b", "c"))
    axis = front.plot().axes[0]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("sag, mm", "mass, kg")
    shown = values[:, ::-1] * [1e3, 1.0]
    np.testing.assert_allclose(axis.lines[0].get_xydata(), shown[::-1], rtol=1e-12)
    assert [text.get_text() for text in axis.texts] == ["0", "1", "2"]
    np.testing.assert_allclose([text.xy for text in axis.texts], shown, rtol=1e-12)
    assert front.summary().splitlines()[:2] == ["mass, kg against sag, mm", "  10  3"]


def test_interrupt_of_a_search_ends_the_front(monkeypatch):
    searches = []

    def interrupted(space, objective, **options):
        searches.append(objective)
        return SimpleNamespace(status_name="interrupted", scene=SCENE)

    monkeypatch.setattr(sys.modules[pareto.__module__], "synthesize", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pareto(DesignSpace(SCENE, TWO), FLAT[0], BOWL[0])
    assert len(searches) == 2


def test_each_search_of_a_front_adds_one_machine(monkeypatch):
    """Second searches that end elsewhere on the front are left out."""
    ends = iter([1.0, 1.1, 9.0, 8.5, 3.0, 3.3, 5.0, 5.5])

    def searched(*_, **__):
        stiffness = jnp.asarray([1e4 * next(ends), 1e4])
        return SimpleNamespace(status_name="not_converged", scene=eqx.tree_at(lambda s: s.machine.stiffness, SCENE, stiffness))

    monkeypatch.setattr(sys.modules[pareto.__module__], "synthesize", searched)
    inverse, _ = of_springs("inverse", lambda x, y, link: 9.0 / x)
    front = pareto(DesignSpace(SCENE, TWO), FIRST[0], inverse, points=4)
    np.testing.assert_allclose(front.values[:, 0], [1.0, 3.0, 5.0, 9.0], rtol=1e-12)
