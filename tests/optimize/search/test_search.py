"""Searches under demands, on quantities whose answers are known by hand, and on machines."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published
from two_springs import FIRST, FREE, NEAREST, SCENE, SUM, plain

import jaxvib as jv
from optimize import (
    DesignSpace,
    Quantity,
    Synthesis,
    amplitude,
    expected,
    fold_margin,
    force_per_amplitude,
    hold,
    jam_frequency,
    largest,
    least,
    product,
    support_frequency_squared,
    synthesize,
    worst,
)


def found(space, objective, **more):
    return synthesize(space, objective, **{"starts": 4, "iterations": 25, "polishing": 12, "verify": False, **more})


def test_multipliers_are_those_computed_by_hand():
    """min (k1 - 6)^2 + (k2 - 5)^2 where k1 + k2 <= 9, k1 <= 4.5 (1e4 N/m): both k 4.5, multipliers 1 and 2."""
    best = found(DesignSpace(SCENE, FREE), NEAREST, subject_to=[SUM < "90 N/mm", FIRST < 4.5e4])
    np.testing.assert_allclose(best.after.parameters["machine.stiffness"], [4.5e4, 4.5e4], rtol=1e-7)
    assert best.status_name == "done" and best.converged == best.same == 4 and best.kkt < 1e-8
    ((often, _, numbers),) = best.machines  # all starts end at one machine
    assert often == 4 and numbers == pytest.approx((4.5e4, 4.5e4))
    budget, first = best.limits
    # d objective / d limit = - multiplier; the whole limit is 9, or 4.5.
    np.testing.assert_allclose([budget.multiplier, first.multiplier], [-1e8 * 9.0, -2e8 * 4.5], rtol=1e-6)
    assert budget.active and first.active and budget.gain < 0.0
    lines = "\n".join(best.findings())
    assert "at its limit: sum of stiffness of all supports at most 90 N/mm (90 N/mm)" in lines
    assert [row.what for row in best.table[:2]] == ["stiffness of support 1", "stiffness of support 2"]
    assert best.rows()[0] == ["stiffness of support 1, N/mm", "50", "45", "", ""]


def test_inactive_demand_has_no_multiplier():
    best = found(DesignSpace(SCENE, FREE), NEAREST, subject_to=[SUM < "150 N/mm"])
    np.testing.assert_allclose(best.after.parameters["machine.stiffness"], [6e4, 5e4], rtol=1e-6)
    assert not best.limits[0].active and best.limits[0].multiplier == 0.0


def test_machines_that_differ_in_one_spring_are_not_the_same():
    """The second stiffness has no effect on the objective."""
    best = found(DesignSpace(SCENE, FREE), plain("first", lambda x, y: (x - 6.0) ** 2 + 0.0 * y))
    assert best.converged == 4 and best.same == 1
    assert np.ptp(best.designs[:, 0]) < 1e-6 and np.ptp(best.designs[:, 1]) > 0.1


def test_contradictory_demands_are_named_with_their_excess():
    space, demands = DesignSpace(SCENE, FREE), [SUM > "120 N/mm", FIRST < 2e4]
    best = found(space, NEAREST, subject_to=demands, throw=False)  # 2e4 + 9e4 at most
    assert best.status_name == "contradictory" and best.same == 0
    broken = [limit for limit in best.limits if limit.violation > 0.0]
    total_off = sum(limit.violation * abs(limit.limit) for limit in broken)
    np.testing.assert_allclose(total_off, 1e4, rtol=1e-4)
    assert "not met" in "\n".join(best.findings())
    assert best.unverified == "the machine does not meet all demands" and best.run is None
    with pytest.raises(jv.ComputationError, match=r"contradictory: .*not met by the nearest machine: .*% off.*relax a demand"):
        found(space, NEAREST, subject_to=demands)


@pytest.mark.parametrize(("limit", "advice"), [("150 N/mm", "1 % less: share +1.8 %"), ("5 N/mm", "1 % more: share -1.8 %")])
def test_contradictory_demands_name_parameters_that_would_help(limit, advice):
    """The quantity is k1 / m^1.8, with the mass relative to that of the scene."""
    mass = SCENE.machine.mass[0]
    quantity = Quantity("share", "N/m", lambda s: s.machine.stiffness[0] / (s.machine.mass[0] / mass) ** 1.8)
    demand = quantity > limit if limit == "150 N/mm" else quantity < limit
    with pytest.raises(jv.ComputationError) as error:
        found(DesignSpace(SCENE, FREE), NEAREST, subject_to=[demand])
    assert str(error.value).splitlines()[1:] == ["[free]", f"# {advice}", '"machine.mass[0]" = ["60 kg", "240 kg"]']


def both_ways(name, function):
    return [plain(f"{sign} {name}", lambda x, y, sign=sign: sign * function(x, y)) for sign in (1.0, -1.0)]


PARABOLAS = [plain(str(at), lambda x, y, at=at: (x - at) ** 2 + (y - 4.0) ** 2) for at in (3.0, 6.0)]
BOWL = [*both_ways("x", lambda x, y: x - 5.0), *both_ways("y", lambda x, y: y - 3.0 + 0.25 * (x - 5.0) ** 2)]
CONE = plain("cone", lambda x, y: jnp.sqrt((x - 5.0 + 0.1 * (y - 2.0) ** 2) ** 2 + (20.0 * (y - 3.0)) ** 2 + 1e-30))


@pytest.mark.parametrize(
    ("wish", "at", "value"),
    [
        (largest(*PARABOLAS), [4.5, 4.0], 2.25),  # they meet in the line x = 4.5
        (0.5 - least(*(-each for each in BOWL)), [5.0, 3.0], 0.5),
        (CONE, [4.9, 3.0], 0.0),  # a modulus that vanishes: no second derivative shows the tip
    ],
)
def test_searches_end_at_kinks(wish, at, value):
    best = found(DesignSpace(SCENE, FREE), wish, starts=8)
    assert best.status_name == "done" and best.same == best.converged == 8
    assert best.kkt < 1e-6 or wish is CONE  # a cone has no slope at its tip
    np.testing.assert_allclose(best.after.parameters["machine.stiffness"], 1e4 * np.asarray(at), rtol=1e-6)
    np.testing.assert_allclose(best.values.min(), value, rtol=1e-9, atol=1e-8)


def test_worst_of_samples_ends_at_a_kink():
    """Stiffness a k of each sample is to be 5e4; a, A its extremes: the least of the largest |a k/5e4 - 1| is (A-a)/(A+a)."""
    wish = worst(plain("off", lambda x, y: jnp.abs(x / 5.0 - 1.0)), {"machine.stiffness[0]": 0.05}, samples=16)
    best = found(DesignSpace(SCENE, {"machine.stiffness[0]": (1e4, 9e4, "even")}), wish)
    low, high = (float(f) for f in np.percentile(np.asarray(wish.case.factors(SCENE)[0][1]), [0.0, 100.0]))
    np.testing.assert_allclose(best.values.min(), (high - low) / (high + low), rtol=1e-9)
    assert best.status_name == "done"


def test_active_bounds_are_listed():
    best = found(DesignSpace(SCENE, {"machine.stiffness": (1e4, 5.5e4)}), NEAREST)
    (limit,) = best.limits  # k1 at 5.5; the objective falls by 2 (6 - 5.5) for each 1e4 N/m
    assert limit.what == "stiffness of support 1 at most 55 N/mm"
    np.testing.assert_allclose(limit.multiplier, -1e8 * 5.5, rtol=1e-5)


def test_held_quantities_keep_their_values_exactly():
    least = Quantity("sum of squares", "", lambda s: jnp.sum((s.machine.stiffness / 1e4) ** 2))
    best = found(DesignSpace(SCENE, FREE, [hold(product("machine.stiffness"))]), least)
    np.testing.assert_allclose(best.after.parameters["machine.stiffness"], np.full(2, np.sqrt(15e8)), rtol=1e-6)
    best = found(DesignSpace(SCENE, FREE, [hold(SUM, "70 N/mm")]), least)
    np.testing.assert_allclose(best.after.parameters["machine.stiffness"], [3.5e4, 3.5e4], rtol=1e-9)
    np.testing.assert_allclose(np.sum(best.after.parameters["machine.stiffness"]), 7e4, rtol=1e-12)


def test_tied_parameters_follow_their_sources():
    ties = {
        "machine.stiffness[1]": ("machine.stiffness[0]", 0.5),
        "machine.link_stiffness": ("machine.stiffness[0]", "keep"),
        "machine.damping[1]": "machine.damping[0]",
    }
    space = DesignSpace(SCENE, {"machine.stiffness[0]": (1e4, 9e4)}, ties=ties)
    best = found(space, NEAREST)
    k = best.scene.machine.stiffness
    np.testing.assert_allclose(k, [(6e4 + 0.5 * 5e4) / 1.25, 0.5 * (6e4 + 0.5 * 5e4) / 1.25], rtol=1e-7)
    np.testing.assert_allclose(best.scene.machine.link_stiffness, 4.0 * k[0], rtol=1e-12)
    np.testing.assert_array_equal(best.scene.machine.damping, [40.0, 40.0])


def test_catalogues_give_the_best_of_all_choices():
    springs = [1e4, 1.5e4, 2.2e4, 3.3e4, 4.7e4, 6.8e4]
    twisted = Quantity("twisted", "", lambda s: _twisted(s.machine.stiffness / 1e4, s.machine.link_stiffness[0] / 1e5))

    def _twisted(k, link):
        return (k[0] * k[1] - 6.0) ** 2 + (k[0] - 2.0 * k[1]) ** 2 + (link - k[0] / 3.0) ** 2

    space = DesignSpace(SCENE, {"machine.link_stiffness": (5e4, 3e5)}, choices={"machine.stiffness": springs})
    best = found(space, twisted, subject_to=[SUM < 8e4])
    tried = {}
    for pair in itertools.product(springs, springs):
        if sum(pair) <= 8e4:
            k = np.asarray(pair) / 1e4
            tried[pair] = float(_twisted(k, np.clip(k[0] / 3.0, 0.5, 3.0)))
    least = min(tried, key=lambda pair: tried[pair])
    np.testing.assert_allclose(best.after.parameters["machine.stiffness"], least, rtol=1e-12)
    np.testing.assert_allclose(best.values.min(), tried[least], rtol=1e-9)
    continued = space.at(jnp.asarray(best.designs[np.argmin(best.values)])).machine
    np.testing.assert_allclose(continued.stiffness, least, rtol=1e-9)
    several = DesignSpace(SCENE, FREE, choices={"loads.count": [2, 3, 5]})
    mass = Quantity("mass", "kg", lambda s: NEAREST(s) / 1e8 + (s.loads.mass * s.loads.count - 3.8) ** 2)
    most = found(several, mass)
    assert most.scene.loads.count == 5
    rows = {row.what: (row.before, row.after) for row in most.table}
    assert rows["number of loads"] == (3.0, 5.0)  # the scene has 3 loads
    np.testing.assert_allclose(rows["mass"], [float(mass(scene)) for scene in (SCENE, most.scene)], rtol=1e-9)


def test_interrupted_search_continues_from_the_best(tmp_path):
    space = DesignSpace(SCENE, FREE)

    def stop(what, share):
        if what.startswith("polishing"):
            raise KeyboardInterrupt

    first = found(space, NEAREST, progress=stop)
    assert first.status_name == "interrupted" and np.isfinite(first.values.min())
    again = found(space, NEAREST, begin=Synthesis.load(first.save(tmp_path / "search")))
    assert again.status_name == "done" and again.starts == 4 and again.values.min() < 1e-3
    with pytest.raises(jv.InputError, match="this space has 1"):
        found(DesignSpace(SCENE, {"machine.stiffness[0]": (1e4, 9e4)}), NEAREST, begin=first)


def antiphase(damping):
    form = published(damping=damping, natural=(0.2, 0.4))
    held = [hold(jam_frequency(mode=3), 1.0), hold(support_frequency_squared(), 2 / 9)]
    return DesignSpace(form.scene(), {"machine.stiffness": (0.01, 0.3), "machine.link_stiffness": (0.1, 1.0)}, held)


def test_multiplier_predicts_the_cost_of_a_demand():
    """The multiplier of a demand, against searches with the limit moved to either side."""
    space = antiphase(1e-2)
    stiff = Quantity("k1", "N/m", lambda s: s.machine.stiffness[0])
    limit = 0.102  # 0.1053 is where the search would end
    at = [found(space, force_per_amplitude(mode=3), starts=8, subject_to=[stiff < limit * f]) for f in (0.999, 1.0, 1.001)]
    told = at[1].limits[-1]
    assert told.active and at[1].kkt < 1e-6
    measured = (at[2].values.min() - at[0].values.min()) / 0.002
    np.testing.assert_allclose(told.multiplier, measured, rtol=1e-4)


@pytest.mark.slow
def test_design_keeps_the_demanded_distance_from_a_fold():
    """The largest amplitude lies at the fold of the jam; a demand on the distance to it is at its limit, and the fold of the
    exact branch is where it should be."""
    space = DesignSpace(SCENE, {"machine.stiffness": (1e4, 2e5), "machine.link_stiffness": (5e4, 5e5)})
    distance, speed = fold_margin(mode=3), 30.0 / np.pi
    free = found(space, -amplitude(mode=3), starts=16)
    kept = found(space, -amplitude(mode=3), starts=16, subject_to=[distance > "100 rpm"])
    assert float(distance(free.scene)) * speed < 10.0  # 5 rpm more, and that machine would leave its jam
    assert kept.status_name == "done" and kept.limits[0].active
    np.testing.assert_allclose(float(distance(kept.scene)) * speed, 100.0, rtol=1e-7)
    assert -kept.values.min() > 0.99 * -free.values.min()
    exact = jv.branches(kept.scene, exact=True, points=400)
    jam = float(jv.jam_orbit(kept.scene, mode=3).omega)
    folds = [each for each in exact.special if each.kind == "fold"]
    beside = min((each for each in folds if each.omega > jam), key=lambda each: each.omega)
    np.testing.assert_allclose((beside.rotor_speed - 120.0) * speed, 100.0, rtol=0.05)  # loads of 2.4 kg are not light


@pytest.mark.slow
def test_exact_designs_begin_at_those_to_leading_order():
    exact = force_per_amplitude(mode=3, tier="exact")
    best = found(antiphase(1e-2), exact, starts=8, subject_to=[amplitude(mode=3, tier="exact") > 0.01])
    before = force_per_amplitude(mode=3, tier="exact")(found(antiphase(1e-2), force_per_amplitude(mode=3), starts=8).scene)
    assert best.status_name == "done" and best.values.min() < float(before) * (1.0 + 1e-9)


@pytest.mark.slow
def test_robust_design_is_better_on_other_samples():
    off = {"machine.stiffness": 0.05}
    force = force_per_amplitude(mode=3)
    space = antiphase(1e-2)
    nominal = found(space, force, starts=8)
    robust = found(space, expected(force, off, samples=32), starts=8)
    unseen = expected(force, off, samples=4000, seed=1)
    assert float(unseen(robust.scene)) <= float(unseen(nominal.scene)) * (1.0 + 1e-6)
    assert worst(force, off).words.startswith("worst")


def test_influences_on_a_tiny_objective_have_its_unit():
    """The objective nearly vanishes at the best machine, so that a percentage of it means nothing."""
    result = found(DesignSpace(SCENE, FREE), NEAREST + Quantity("rest", "N^2/m^2", lambda s: jnp.asarray(1e-3)))
    lines = [line for line in result.findings() if "1 % less / more" in line]
    assert len(lines) == 2
    assert "+3.6e+05 N^2/m^2 / +3.6e+05 N^2/m^2" in lines[0] and "%" not in lines[0].split(":")[1]


def test_inactive_demands_do_not_change_the_search():
    """The objective vanishes: small multipliers of demands with room would be large beside it."""
    alone = found(DesignSpace(SCENE, FREE), CONE, starts=8)
    beside = found(DesignSpace(SCENE, FREE), CONE, starts=8, subject_to=[FIRST < 8.9e4, SUM > 3e4])
    assert alone.status_name == beside.status_name == "done" and beside.converged == 8
    assert beside.values.min() < 1e-9 and not any(each.active for each in beside.limits)
