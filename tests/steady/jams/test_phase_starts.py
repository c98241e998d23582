"""Starts of the search for jams at unequal phases, and Newton's method for phases at a load speed."""

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxvib as jv
from jaxvib.equations.torque_balance import assemble_torque_balance, influence_of, torques_at
from jaxvib.steady.jams import phase_starts
from jaxvib.steady.jams.phase_starts import _regular_phases, distinct_rows, load_speeds, phases_near, search_data, starts_of
from jaxvib.steady.jams.phases import phase_pattern, solve_balance

MACHINE = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
RESONANCE = np.sqrt(1.16e6 / 37.1)


def parts(count=2, drag=0.04):
    return assemble_torque_balance(
        jv.Scene(MACHINE, jv.pendulums(count=count, mass=0.1 / count, radius=0.08, drag=drag), jv.ConstantSpeed(460.0))
    )


def needed(omega, drag=0.04):
    """The multiple of the drag that loads need which are together, by hand: half of w^4 S^2 Im 1/D for both directions."""
    dynamic = 1.16e6 - 37.1 * omega**2 + 843.0j * omega
    torque = omega**4 * (0.1 * 0.08) * (0.05 * 0.08) * (-1.0 / dynamic).imag
    return torque / (drag * 0.08**2 * (460.0 - omega))


def test_load_speeds_crowd_about_the_resonance():
    speeds = load_speeds(parts())
    assert np.all(np.diff(speeds) > 0.0) and speeds[0] > 0.0 and 460.0 * (1.0 - 2e-6) < speeds[-1] < 460.0
    damped = np.sqrt(RESONANCE**2 - (843.0 / 74.2) ** 2)
    for side in (-1.0, 1.0):
        away = np.sort(side * (speeds - damped))
        away = away[away > 1e-9]
        assert away[0] < 1.1e-4 * damped and np.sum(away < 0.01 * damped) > 12
    assert np.max(np.diff(speeds[speeds < 0.98 * 460.0])) < 0.005 * 460.0


def test_rotor_speed_without_smaller_numbers_has_a_status():
    scene = jv.Scene(MACHINE, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(5e-324))
    with pytest.raises(jv.ComputationError, match=r"^lost_digits: no number is a load speed below"):
        load_speeds(assemble_torque_balance(scene))


def test_regular_phases_are_every_split_into_two():
    splits = _regular_phases(parts(count=3))
    assert {tuple(np.round(row / np.pi).astype(int)) for row in splits} == {(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)}
    five = {tuple(np.round(row / np.pi).astype(int)) for row in _regular_phases(parts(count=5))}
    assert five == {(*four, 0) for four in itertools.product((0, 1), repeat=4)}


@pytest.mark.parametrize("omega", [150.0, 170.0, 200.0])
def test_loads_together_need_the_drag_that_is_computed_by_hand(omega):
    p, w = parts(), jnp.asarray(omega)
    influence = influence_of(p, w)
    factor, phase, residual = phases_near(p, search_data(p, w), jnp.array([0.3, 0.3001]))
    np.testing.assert_allclose(factor, needed(omega), rtol=1e-9)
    np.testing.assert_allclose(phase, [0.0, 0.0], atol=1e-9)
    assert residual < 1e-14
    # Without a step: how far the loads' multiples differ, beside what their torques could be at most.
    start = jnp.array([0.0, 1.0])
    factor, phase, residual = phases_near(p, search_data(p, w), start, 0)
    each = -np.asarray(torques_at(p.unbalance, influence, w, jnp.exp(1j * start))) / (0.04 * 0.08**2 * (460.0 - omega))
    most = omega**4 * np.sum(np.abs(influence)) * 0.004**2 / (0.04 * 0.08**2 * (460.0 - omega))
    np.testing.assert_allclose(residual, abs(each[1] - each[0]) / most, rtol=1e-9)
    np.testing.assert_allclose([factor, phase[1]], [each[0], 1.0], rtol=1e-9)


def test_a_common_turn_of_the_start_changes_nothing():
    p, start = parts(count=3), jnp.array([0.0, 0.4, -0.3])
    at = search_data(p, jnp.asarray(170.0))
    for one, other in zip(phases_near(p, at, start), phases_near(p, at, start + 1.1), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-12)


def test_a_load_alone_needs_what_it_needs():
    p = parts(count=1)
    factor, phase, residual = phases_near(p, search_data(p, jnp.asarray(170.0)), jnp.array([2.0]))
    np.testing.assert_allclose(factor, 2.0 * needed(170.0), rtol=1e-9)
    assert phase.tolist() == [0.0] and residual == 0.0


def test_starts_lie_at_the_jams_that_are_known():
    """Coincident loads: the required drag is that of the scene."""
    p = parts()
    omega, phase = starts_of(p, np.zeros((1, 2)))
    assert omega.shape == (len(phase),) and np.all((omega > 0.0) & (omega < 460.0))
    speeds = np.linspace(20.0, 455.0, 200001)
    off = needed(speeds) - 1.0
    jams = speeds[:-1][off[1:] * off[:-1] < 0.0]
    assert len(jams) >= 1
    # Either their own multiple is near 1, or they are next to a jam.
    multiples = jax.vmap(lambda w, a: phases_near(p, search_data(p, w), a, 0)[0])(jnp.asarray(omega), jnp.asarray(phase))
    assert np.all((multiples > 1.0 / 3.001) & (multiples < 3.001))
    together = np.abs(np.angle(np.exp(1j * (phase[:, 1] - phase[:, 0])))) < 1e-3
    for jam in jams:
        assert np.min(np.abs(omega[together] / jam - 1.0)) < 1e-3


@pytest.mark.parametrize(
    ("phases", "pattern"),
    [
        ([0.0, 0.2, 0.1], jv.PhasePattern.together),
        ([0.0, 0.1, 3.1, 3.2], jv.PhasePattern.opposite),
        ([0.0, 2.0 * np.pi / 3.0, 4.0 * np.pi / 3.0], jv.PhasePattern.spread),
        ([0.0, 1.0, 2.0], jv.PhasePattern.other),
        ([0.0, np.pi, 0.0], jv.PhasePattern.other),
    ],
)
def test_patterns_by_their_resultants(phases, pattern):
    assert bool(phase_pattern(jnp.array(phases)) == pattern)


def test_the_search_is_written_on_single_numbers():
    """Single numbers take a third of the time for thousands of starts."""
    machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 3e4), damping=(40.0, 20.0), link_stiffness=2e5, link_damping=60.0)
    p = assemble_torque_balance(jv.Scene(machine, jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed(120.0)))
    w, start = jnp.asarray(100.0), jnp.zeros(3)
    for search in (lambda: phases_near(p, search_data(p, w), start), lambda: solve_balance(p, w, start, on_scalars=True)):
        loops = [e for e in jax.make_jaxpr(search)().jaxpr.eqns if e.primitive.name == "while"]
        newton = max(loops, key=lambda e: len(e.outvars))
        assert len(newton.outvars) > 10 and all(v.aval.shape == () for v in newton.outvars)


def test_rows_that_are_the_same_are_found_where_they_stand_first():
    rows = np.random.default_rng(3).integers(-2, 3, (400, 3)).astype(float)
    first, which = distinct_rows(rows)
    np.testing.assert_array_equal(rows[first][which], rows)
    assert len({tuple(row) for row in rows}) == first.size and np.all(np.diff(first) > 0)
    assert all(np.flatnonzero(which == k)[0] == place for k, place in enumerate(first))
    assert [found.size for found in distinct_rows(np.zeros((0, 3)))] == [0, 0]


@pytest.mark.parametrize("count", [1, 3, 5])
def test_jams_of_equal_loads_are_two_clusters(count):
    """All jams in closed form: k loads stand an angle d from the others, tan(d/2) = -n cos(v)/((n - 2k) sin(v)), v = arg g."""
    loads = jv.pendulums(count=count, mass=0.1 / count, radius=0.08, drag=0.08 / count)
    scene = jv.Scene(jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0), loads, jv.ConstantSpeed(460.0))
    unbalance, drag = 0.1 / count * 0.08, 0.08 / count * 0.08**2

    def surplus(w, k):
        g = 2.0 / (1.16e6 - 37.1 * w**2 + 843j * w)
        v = np.angle(g)
        d = 2.0 * np.arctan(-count * np.cos(v) / ((count - 2 * k) * np.sin(v))) if k else 0.0
        return drag * (460.0 - w) + w**4 / 2.0 * unbalance**2 * np.imag(g * (count - k + k * np.exp(1j * d)))

    awaited = []
    for k in range((count + 1) // 2):
        grid = np.linspace(20.0, 459.99, 4000)
        values = np.array([surplus(w, k) for w in grid])
        for i in np.flatnonzero(values[1:] * values[:-1] < 0.0):
            awaited.append(brentq(surplus, grid[i], grid[i + 1], args=(k,), xtol=1e-10))
    found = jv.phase_jams(scene, starts=16)
    assert len(awaited) == 3 * ((count + 1) // 2)
    np.testing.assert_allclose(np.sort(found.omega), np.sort(awaited), rtol=1e-8)


def test_every_division_of_equal_loads_is_tried_once():
    found = phase_starts._divisions([np.array([0, 2, 3, 5]), np.array([1]), np.array([4, 6])])
    assert [part.tolist() for part in found] == [[0, 1, 0, 0, 2, 3, 4], [0, 1, 0, 3, 2, 3, 4]]
    (alone,) = phase_starts._divisions([np.arange(20 * k, 20 * k + 20) for k in range(3)])
    np.testing.assert_array_equal(alone, np.arange(60))


@pytest.mark.parametrize("count", [4, 6])
def test_two_clusters_of_one_size_jam_at_the_resonance(count):
    """Together 3 jams for each division but that into halves, which has one, at the undamped natural frequency."""
    loads = jv.pendulums(count=count, mass=0.1 / count, radius=0.08, drag=0.08 / count)
    found = jv.phase_jams(jv.Scene(MACHINE, loads, jv.ConstantSpeed(460.0)), starts=16)
    assert found.omega.size == 3 * (count // 2) + 1
    assert np.min(np.abs(np.asarray(found.omega) / RESONANCE - 1.0)) < 1e-9


@pytest.mark.parametrize("count", [1, 2, 4, 7])
def test_regular_phases_are_all_divisions_each_once(count):
    """At most five loads have a side of their own."""
    found = _regular_phases(SimpleNamespace(unbalance=np.ones(count)))
    sides = {tuple(np.round(row / np.pi).astype(int)) for row in found}
    free = min(count - 1, 5)
    assert len(found) == len(sides) == 2**free and all(not any(row[free:]) and {*row} <= {0, 1} for row in sides)
