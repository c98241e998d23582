"""Results of a search: the table, the tiers that verify it, the best of several searches."""

import dataclasses
import math
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, scene

import jaxvib as jv
from optimize import DesignSpace, Quantity, amplitude, expected, foundation_force, hold, jam_frequency, total, total_mass
from optimize.search.find import SearchResult
from optimize.search.polish import Optimality
from optimize.search.problem import Point
from optimize.synthesize import (
    _motion_of,
    _named_quantities,
    _options,
    _other_tiers,
    _rank,
    _report,
    _run,
    _standard_rows,
    _table,
    _with_loads,
    synthesize,
)

SCENE = scene("two_mass")
SPACE = DesignSpace(SCENE, {"machine.stiffness": (1e4, 9e4), "loads.drag": (1.0, 2.0)}, [hold(total("machine.stiffness"), 8e4)])


def test_the_table_has_each_quantity_once():
    standard = [
        "jam frequency",
        "amplitude of platform 1 (y1)",
        "amplitude of platform 2 (y2)",
        "foundation force",
        "force per amplitude of y1 against y2",
    ]
    assert [name for name, _ in _standard_rows(SCENE, 3, None)] == standard and _standard_rows(SCENE, None, None) == []
    force, mass = foundation_force(mode=3), total_mass()
    named = _named_quantities(SPACE, SCENE, force, [mass < 300.0, force < 9.0, amplitude(mode=3, of=1) < 1.0], 3)
    assert [name for name, _ in named] == [*standard, "sum of stiffness of all supports", "mass of platforms and loads"]
    largest = _named_quantities(SPACE, SCENE, -mass, [], None)  # what is to be large is told as it is
    assert [q for _, q in largest] == [mass, total("machine.stiffness")]
    values = np.array([[1.0, 2.0], [3.0, 4.0]])
    rows = _table(SPACE, SCENE, largest, values, ([5.0, 6.0], [7.0, 8.0]))
    assert [row.what for row in rows[:3]] == ["stiffness of support 1", "stiffness of support 2", "drag of each ball"]
    assert rows[0][2:4] == (5e4, 5e4) and all(math.isnan(x) for x in rows[0][4:])
    assert rows[3] == ("mass of platforms and loads", "kg", 1.0, 3.0, 5.0, 7.0) and rows[4][2:] == (2.0, 4.0, 6.0, 8.0)


def test_table_has_other_tiers_if_they_exist():
    quantities = [total_mass(), jam_frequency(mode=3), expected(jam_frequency(mode=3), {"loads.drag": 0.05}, samples=2)]
    exact, time = _other_tiers(SCENE, quantities, True, None, 3)
    np.testing.assert_allclose(exact[1], float(jv.jam_orbit(SCENE, mode=3).omega), rtol=1e-9)
    assert math.isnan(exact[0]) and all(map(math.isnan, time)) and math.isfinite(exact[2])
    assert all(map(math.isnan, _other_tiers(SCENE, quantities, False, None, 3)[0]))

    class Ran:
        omega, amplitude, foundation_force = 60.0, np.array([3.0, 4.0]), 5.0

    of_run = [*quantities, foundation_force(mode=3), amplitude(mode=3, of=2), jam_frequency(mode=3) / total_mass()]
    _, time = _other_tiers(SCENE, of_run, False, Ran(), 3)
    assert time[1] == 60.0 and time[3:5] == [5.0, 4.0]
    assert math.isnan(time[0]) and math.isnan(time[2])  # one run says nothing of other machines
    assert math.isnan(_other_tiers(SCENE, of_run, False, Ran(), None)[1][1])


def test_designs_that_meet_demands_rank_first():
    def found(value, violation):
        point = Point(np.zeros((1, 2)), np.array([[value]]), np.zeros((1, 1, 2)), (), (), np.zeros((1, 0)), np.zeros((1, 0, 2)))
        none = Optimality(np.zeros((1, 0)), np.zeros((1, 0)), np.zeros((1, 2)), np.zeros(1))
        return SearchResult(
            point, np.zeros((1, 1)), np.zeros(1), np.array([violation]), none, 1, 1, False, (np.zeros(2), np.ones(2))
        )

    assert _rank(found(5.0, 0.0)) == (False, 5.0) and _rank(found(5.0, 0.3)) == (True, 0.3)
    assert _rank(found(5.0, 0.0)) < _rank(found(6.0, 9e-8)) < _rank(found(1.0, 0.2)) < _rank(found(0.5, 0.3))


def test_choice_of_the_number_of_loads_needs_equal_loads():
    more = _with_loads(SPACE, 5)
    assert more.scene.loads.count == 5 and more.size == SPACE.size and SPACE.scene.loads.count == 3
    own = DesignSpace(scene("two_mass", "pendulums"), {"machine.stiffness": (1e4, 9e4)})
    with pytest.raises(jv.InputError, match="give one mass, radius and drag for all"):
        _with_loads(own, 5)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (dict(iterations=0), "iterations is 0"),
        (dict(polishing=-1), "polishing is -1"),
        (dict(seed=-1), "seed is -1"),
        (dict(rate=0.0), "rate is 0.0"),
        (dict(rate=1.0), "rate is 1.0"),
        (dict(searcher=None), "searcher is None"),
    ],
)
def test_wrong_options_raise_clear_errors(wrong, says):
    right = dict(starts=1, seed=0, iterations=1, polishing=0, rate=0.5, searcher="gradients")
    assert _options(**right).rate == 0.5
    with pytest.raises(jv.InputError, match=says):
        _options(**{**right, **wrong})


def test_wrong_arguments_raise_clear_errors():
    wish = Quantity("k", "N/m", lambda s: s.machine.stiffness[0])
    running = DesignSpace(jv.Scene(SCENE.machine, SCENE.loads, jv.RunUp(120.0, acceleration=5.0)), {"loads.drag": (1.0, 2.0)})
    for space, subject_to, begin, says in (
        (3.0, [], None, "must be a DesignSpace"),
        (SPACE, [3.0], None, "must be a Demand, for example"),
        (SPACE, [], 3.0, "must be a Synthesis"),
        (running, [], None, "use ConstantSpeed"),
    ):
        with pytest.raises(jv.InputError, match=says):
            synthesize(space, wish, subject_to=subject_to, begin=begin)
    assert _run(SCENE, None, True)[1].startswith("no quantity of the search belongs to a jam or a working regime")
    assert _run(SCENE, 3, False) == (None, "not requested")


def test_unstable_modes_are_not_verified():
    """Loads slide from mode 4 to mode 3, and separate in mode 5: neither mode has verified amplitudes."""
    fast = scene("two_mass", speed=120.0)
    for mode in (4, 5):
        multiplier = float(jv.jam_orbit(fast, mode=mode).multiplier)
        run, why = _run(fast, mode, True)
        assert run is None and multiplier > 1.0
        assert why == f"mode {mode} is unstable: the largest multiplier of its exact motion is {multiplier:.4g}"
    absent, why = _run(scene("two_mass", speed=40.0), 5, True)
    assert absent is None and "does not exist" in why


def test_other_modes_of_demands_are_verified_by_settled_runs():
    fast = scene("two_mass", speed=120.0)
    run, _ = _run(fast, 3, True)
    exact, verified = _other_tiers(fast, [amplitude(mode=m) for m in (1, 3, 4)], True, run, 3)
    np.testing.assert_allclose(verified[:2], exact[:2], rtol=1e-3)
    assert math.isfinite(exact[2]) and math.isnan(verified[2])


def test_weakly_damped_machines_are_verified_to_the_exact_motion():
    """Their free vibrations last for a hundred thousand periods; the integration begins beside the exact motion."""
    s = published(damping=1e-5, count=3).scene()
    exact = jv.jam_orbit(s, mode=3)
    run, why = _run(s, 3, True)
    assert why == "" and run is not None
    np.testing.assert_allclose(run.foundation_force, exact.foundation_force, rtol=1e-5)
    np.testing.assert_allclose(run.amplitude, exact.amplitude, rtol=1e-6)
    angle = np.asarray(run.window.state.angle[0])
    assert np.ptp(angle[0]) > 0.0  # the loads were not at one angle


def test_a_run_that_left_its_mode_is_no_verification(monkeypatch):
    def settled(scene, **start):
        run = jv.simulate(scene, 1.0, estimate=False, save="window")
        return dataclasses.replace(run, omega=run.omega * 0.0 + 50.0)

    monkeypatch.setattr(sys.modules[synthesize.__module__], "settle", settled)
    assert _run(scene("two_mass", speed=120.0), 3, True) == (None, "the motion left mode 3 and settled at 477.465 rpm")


def test_verification_without_exact_motion_starts_in_the_jam(monkeypatch):
    def refused(scene, **how):
        raise jv.InputError("effects", "has what no theory includes")

    asked = []
    monkeypatch.setattr(sys.modules[synthesize.__module__], "settle", lambda scene, **how: asked.append(how) or "run")
    monkeypatch.setattr(sys.modules[synthesize.__module__], "jam_orbit", refused)
    assert _run(SCENE, 3, True) == ("run", "")
    monkeypatch.setattr(sys.modules[synthesize.__module__], "jam_orbit", lambda *_, **__: SimpleNamespace(multiplier=math.nan))
    assert _run(SCENE, 3, True) == ("run", "")
    assert asked == [{"mode": 3}] * 2


def test_meaningless_derivatives_of_runs_are_stated():
    """x -> 4 x (1 - x): 60 times make 1e18 of a change; 5 times make 30, and derivatives are right."""

    def search(steps):
        def last(scene):
            x = 0.3 + 1e-6 * scene.machine.stiffness[0]
            return 1.0 + jax.lax.fori_loop(0, steps, lambda _, y: 4.0 * y * (1.0 - y), x)

        space = DesignSpace(scene("two_mass"), {"machine.stiffness[0]": (1e4, 9e4)})
        return synthesize(space, Quantity("last", "", last), starts=2, iterations=5, polishing=2, verify=False)

    found = search(60)
    (unresolved,) = found.unresolved
    assert unresolved.what == "last" and unresolved.tiny > 0.01 * unresolved.large > 0.0
    assert "derivatives of this quantity cannot be trusted: last (changes of the parameters by a millionth" in found.summary()
    assert search(5).unresolved == ()


def test_missing_quantities_of_all_starts_are_named():
    nowhere = Quantity("nowhere", "", lambda s: s.drive.speed * jnp.nan)
    half = [Quantity(f"half {sign:+d}", "", lambda s, sign=sign: jnp.sqrt(sign * (s.loads.drag - 1.5))) for sign in (1, -1)]
    for objective, demands, says in (
        (total_mass(), [nowhere < 1.0], r"nowhere: does not exist for any"),
        (nowhere, [total_mass() < 1.0], r"nowhere: does not exist for any"),
        (half[0], [half[1] < 1.0], r"half \+1, half -1, 1: do not all exist for any"),
    ):
        with pytest.raises(jv.ComputationError, match=says) as caught:
            synthesize(DesignSpace(SCENE, {"loads.drag": (1.0, 2.0)}), objective, subject_to=demands, starts=4)
        assert caught.value.status == "no_feasible_start"


def test_added_springs_are_marked_new():
    free = DesignSpace(scene("network"), {"machine.stiffness[1]": (0.0, 1e4), "machine.stiffness[2]": (0.0, 1e4)})
    built = free.at(jnp.array([0.5, 0.0]))
    rows = _table(free, built, [], np.zeros((2, 0)), ([], []))
    assert [(row.what, row.before, row.after) for row in rows] == [
        ("stiffness of support 2 (new)", 0.0, 5e3),
        ("stiffness of support 3", 0.0, 0.0),
    ]


def test_tied_parameters_are_in_the_table():
    ties = {"machine.stiffness[1]": ("machine.stiffness[0]", 0.5)}
    space = DesignSpace(SCENE, {"machine.stiffness[0]": (1e4, 9e4)}, ties=ties)
    rows = _table(space, space.at(jnp.array([0.5])), [], np.zeros((2, 0)), ([], []))
    assert [row.what for row in rows] == ["stiffness of support 1", "stiffness of support 2 (tied)"]
    assert rows[1].unit == "N/m" and np.isclose(rows[1].after, 0.5 * rows[0].after)


def test_the_mode_of_a_search_is_that_of_its_objective():
    force, whose, mass = foundation_force(mode=3), amplitude(mode=4), total_mass()
    assert _motion_of(SPACE, force, [whose < 1.0]) == 3 and _motion_of(SPACE, -force / mass, []) == 3
    assert (
        _motion_of(SPACE, mass, [mass < 9.0, whose < 1.0, force < 1.0]) == 4 and _motion_of(SPACE, mass, [mass < 9.0]) is None
    )


def test_the_mode_of_a_search_can_be_that_of_a_held_quantity():
    free = {"machine.stiffness": (1e4, 9e4), "loads.drag": (1.0, 2.0)}
    held = DesignSpace(SCENE, free, [hold(jam_frequency(mode=3), 60.0)])
    assert _motion_of(held, total_mass(), []) == 3 and _motion_of(held, amplitude(mode=4), []) == 4


def test_searches_of_all_numbers_of_loads_count(monkeypatch):
    """Searches with two, three and four loads: three are best, four have no design, and all starts are counted."""
    none = Optimality(np.zeros((1, 0)), np.zeros((1, 0)), np.zeros((1, 1)), np.zeros(1))

    def choose(problem, options, tell):
        loads = problem.space.scene.loads.count
        point = Point(
            np.zeros((1, 1)), np.array([[9.0 - loads]]), np.zeros((1, 1, 1)), (), (), np.zeros((1, 0)), np.zeros((1, 0, 1))
        )
        bounds = np.zeros(1), np.ones(1)
        found = SearchResult(point, np.zeros((1, 1)), np.zeros(1), np.zeros(1), none, 10 * loads, loads, False, bounds)
        return None if loads == 4 else found

    module = sys.modules[synthesize.__module__]
    monkeypatch.setattr(module, "choose", choose)
    space = DesignSpace(SCENE, {"loads.drag": (1.0, 2.0)}, choices={"loads.count": [2, 3, 4]})
    options = _options(starts=4, seed=0, iterations=1, polishing=0, rate=0.5, searcher="gradients")
    here, problem, found = module._search(space, total_mass(), (), options, lambda *_: None)
    assert here.scene.loads.count == problem.space.scene.loads.count == 3
    assert (found.drawn, found.existing) == (50, 5) and found.point.values[0, 0] == 6.0


def test_reported_shares_grow_from_search_to_verification():
    told = []
    for share in (0.0, 0.45, 0.9, 0.95, 1.0):
        _report(lambda what, shown: told.append(shown), 0.6, "searching", share)
    np.testing.assert_allclose(told, [0.0, 0.3, 0.6, 0.8, 1.0], atol=1e-12)
