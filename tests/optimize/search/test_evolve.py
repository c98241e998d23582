"""CMA-ES in place of the descent: the same answers where there is one valley, the deepest where there are many."""

import cma
import jax.numpy as jnp
import numpy as np
import pytest
from two_springs import FIRST, FREE, NEAREST, SCENE, SUM, plain

import jaxvib as jv
from jaxvib.steady.jams.jam import jam_modes
from optimize import DesignSpace, Quantity, hold, jam_frequency, synthesize
from optimize.search import evolve as evolve_module
from optimize.search.evolve import PopulationValues, _best, evolve
from optimize.search.problem import problem_of


def found(space, objective, **more):
    options = {"searcher": "cma", "starts": 10, "iterations": 40, "polishing": 12, "verify": False}
    return synthesize(space, objective, **{**options, **more})


@pytest.fixture
def valleys():
    """A bowl with a dozen valleys in each of two numbers; the deepest is at k = (6e4, 5e4)."""

    def rugged(s):
        x = (s.machine.stiffness - jnp.array([6e4, 5e4])) / 1e4
        return jnp.sum(x**2 + 4.0 * jnp.sin(5.0 * x) ** 2)

    return Quantity("rugged", "", rugged)


def test_cma_finds_the_lowest_of_many_minima(valleys):
    space = DesignSpace(SCENE, FREE)
    best = found(space, valleys, starts=20)
    np.testing.assert_allclose(best.after.parameters["machine.stiffness"], [6e4, 5e4], rtol=1e-6)
    assert best.status_name == "done" and 800 <= best.drawn < 1000 and 1 <= best.starts <= 8
    same = found(space, valleys, starts=20)
    np.testing.assert_array_equal(best.designs, same.designs)
    assert best.history.shape[1] == best.starts and best.plot().axes


def test_cma_searches_a_single_free_number():
    """The deepest of a dozen valleys, at 6e4 N/m."""

    def rugged(s):
        x = (s.machine.stiffness[0] - 6e4) / 1e4
        return x**2 + 4.0 * jnp.sin(5.0 * x) ** 2

    best = found(DesignSpace(SCENE, {"machine.stiffness[0]": (1e4, 9e4)}), Quantity("rugged", "", rugged))
    np.testing.assert_allclose(best.after.parameters["machine.stiffness[0]"], 6e4, rtol=1e-6)
    assert best.status_name == "done" and best.designs.shape[1] == 1


def test_cma_meets_demands_and_held_values():
    best = found(DesignSpace(SCENE, FREE), NEAREST, subject_to=[SUM < "90 N/mm", FIRST < 4.5e4])
    np.testing.assert_allclose(best.after.parameters["machine.stiffness"], [4.5e4, 4.5e4], rtol=1e-6)
    held = DesignSpace(SCENE, FREE, [hold(SUM, 9e4)])
    np.testing.assert_allclose(found(held, NEAREST).after.parameters["machine.stiffness"], [5e4, 4e4], rtol=1e-6)


def test_interrupted_cma_returns_its_best_designs():
    def stop(what, share):
        if what.startswith("evolving") and share > 0.2:
            raise KeyboardInterrupt

    best = found(DesignSpace(SCENE, FREE), NEAREST, progress=stop)
    assert best.status_name == "interrupted" and np.isfinite(best.values.min())


def test_unknown_searcher_is_refused(monkeypatch):
    with pytest.raises(jv.InputError, match=r"searcher is 'anneal'; it must be one of: 'gradients', 'cma'"):
        found(DesignSpace(SCENE, FREE), NEAREST, searcher="anneal")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(jv.InputError, match=r"needs the package cma; install it with: pip install '.\[cma\]'"):
        found(DesignSpace(SCENE, FREE), NEAREST)


def test_best_distinct_designs_are_kept():
    designs = np.array([[0.5, 0.5], [0.505, 0.495], [0.2, 0.5], [0.5, 0.52], [0.9, 0.9]])
    merits, kept = _best(np.array([3.0, 2.0, 5.0, 4.0, 1.0]), designs)
    np.testing.assert_array_equal(merits, [1.0, 2.0, 4.0, 5.0])
    np.testing.assert_array_equal(kept, designs[[4, 1, 3, 2]])
    many = np.linspace(0.0, 1.0, 20)
    np.testing.assert_array_equal(_best(many, np.stack([many, many], axis=1))[0], many[:8])


def test_populations_follow_jams_from_the_nearest_design(monkeypatch):
    """Values are those of whole branches, which are looked at for the first designs, and where following leads nowhere."""
    problem = problem_of(DesignSpace(SCENE, FREE), jam_frequency(mode=3), [])
    looked = []
    look = evolve_module.find_speeds
    monkeypatch.setattr(evolve_module, "find_speeds", lambda problem, z: looked.append(len(z)) or look(problem, z))
    followed = PopulationValues(problem)
    first = np.array([[0.2, 0.3], [0.8, 0.7], [0.5, 0.9]])
    second = first[::-1] + 0.01
    found = np.concatenate([followed.of(first), followed.of(second)])[:, 0]
    awaited = [float(jam_modes(problem.space.at(jnp.asarray(z))).select(3).omega) for z in (*first, *second)]
    np.testing.assert_allclose(found, awaited, rtol=1e-9)
    assert looked == [3] and len(followed.latest[0]) == 6
    np.testing.assert_allclose(followed.latest[1], awaited, rtol=1e-9)
    followed.latest = followed.latest[0], np.full(6, 1e-3)  # nothing is near there
    np.testing.assert_allclose(followed.of(first)[:, 0], awaited[:3], rtol=1e-9)
    assert looked == [3, 3]
    np.testing.assert_allclose(followed.latest[1][-3:], awaited[:3], rtol=1e-9)
    for _ in range(40):
        followed.of(second)
    assert len(followed.latest[0]) == len(followed.latest[1]) <= 200
    monkeypatch.setattr(evolve_module, "_MAX_STORED_DESIGNS", 4)  # the last ones
    followed.of(first)
    np.testing.assert_array_equal(followed.latest[0], [second[2], *first])


def test_restarts_have_twice_the_population(monkeypatch):
    begun = []
    strategy = cma.CMAEvolutionStrategy

    def begin(where, step, options):
        begun.append((options["popsize"], options["seed"], tuple(where)))
        return strategy(where, step, options)

    monkeypatch.setattr(cma, "CMAEvolutionStrategy", begin)
    problem = problem_of(DesignSpace(SCENE, FREE), plain("bowl", lambda x, y: (x - 6.0) ** 2 + (y - 5.0) ** 2 + 2.0), [])
    found = evolve(problem, 1200, 5, lambda share, least: None)
    sizes, seeds, starts = zip(*begun, strict=True)
    assert len(begun) >= 2 and sizes == tuple(6 * 2**k for k in range(len(begun))) and seeds == tuple(range(6, 6 + len(begun)))
    np.testing.assert_array_equal(starts, np.random.default_rng(5).uniform(size=(len(begun), 2)))
    assert 1200 <= found.drawn < 1200 + sizes[-1]


def test_evolution_counts_and_reports_its_designs():
    """The condition x > 5 alone has the objective: half of what is drawn at first. Breaking x + y <= 9 costs."""
    problem = problem_of(
        DesignSpace(SCENE, FREE),
        plain("half", lambda x, y: jnp.where(x > 5.0, (x - 6.0) ** 2 + (y - 5.0) ** 2 + 2.0, jnp.nan)),
        [plain("sum", lambda x, y: x + y) < 9.0],
    )
    told = []
    found = evolve(problem, 300, 0, lambda share, least: told.append((share, least)))
    assert 300 <= found.drawn < 340 and 0 < found.existing < found.drawn and not found.interrupted
    shares, least = np.array(told).T
    assert np.all(np.diff(shares) > 0.0) and shares[-1] == found.drawn / 300 and len(found.history) == len(told)
    there = np.isfinite(least)
    assert np.all(np.diff(least[there]) <= 1e-12)
    best = 1.0 + 8.0 * found.point.z[0]
    np.testing.assert_allclose(best, [5.0, 4.0], atol=0.01)  # where the line x + y = 9 ends
    assert 1 <= len(found.point.z) <= 8 and np.all(found.point.z[:, 0] > 0.5)
    nowhere = problem_of(DesignSpace(SCENE, FREE), plain("no", lambda x, y: x * jnp.nan), [])
    none = evolve(nowhere, 20, 0, lambda share, least: None)
    assert none.point is None and none.existing == 0 and none.drawn >= 20


def test_cma_draws_designs_within_their_ranges(monkeypatch):
    drawn = []

    def outside(_, z):
        drawn.append(z)
        return np.sum((z - 1.2) ** 2, axis=1)[:, None]

    monkeypatch.setattr(PopulationValues, "of", outside)
    evolve(problem_of(DesignSpace(SCENE, FREE), NEAREST, []), 300, 0, lambda *_: None)
    z = np.concatenate(drawn)
    assert np.all((z >= 0.0) & (z <= 1.0)) and np.mean(z == 1.0) < 0.01
