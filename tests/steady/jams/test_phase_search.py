"""A phase pattern followed over the load speed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.equations.torque_balance import assemble_torque_balance
from jaxvib.steady.jams import phase_search
from jaxvib.steady.jams.phase_search import _contains_jam, phase_branch
from jaxvib.steady.jams.phase_starts import equal_loads
from jaxvib.steady.jams.phases import PhaseStatus, jam_from, phase_jam

MACHINE = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
SCENE = jv.Scene(MACHINE, jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))


def test_a_branch_is_made_of_the_jams_that_each_drag_has():
    """Loads with different drags, at unequal phases: speeds and growth are those of the scene with so many times the drag,
    whose jam is solved for by itself."""
    scene = eqx.tree_at(lambda s: s.loads.drag, SCENE, jnp.array([0.04, 0.05]))
    jam = phase_jam(scene, 182.0, jnp.zeros(2))
    speeds = np.sort([178.0, 180.0, float(jam.omega), 190.0])
    at = int(np.searchsorted(speeds, float(jam.omega)))
    branch = phase_branch(scene, jam, jnp.asarray(speeds))
    np.testing.assert_allclose(branch.drag_factor[at], 1.0, rtol=1e-9)
    np.testing.assert_allclose(branch.growth[at], jam.growth, rtol=1e-6)
    assert abs(float(jam.phase[1])) > 0.1 and float(jam.growth) > 1.0
    for k, omega in enumerate(speeds):
        braked = eqx.tree_at(lambda s: s.loads.drag, scene, scene.loads.drag * branch.drag_factor[k])
        alone = phase_jam(braked, omega, branch.phase[k])
        np.testing.assert_allclose(alone.omega, omega, rtol=1e-8)
        np.testing.assert_allclose(branch.growth[k], alone.growth, rtol=1e-5)
        assert bool(branch.stable[k]) == bool(alone.stable)


def test_a_branch_is_followed_from_its_jam_both_ways(monkeypatch):
    asked = []

    def followed(scene, phase, omega, anew):
        asked.append((np.asarray(phase), np.asarray(omega), np.asarray(anew)))
        return omega, omega, omega, omega

    monkeypatch.setattr(phase_search, "_follow_pattern", followed)
    jam = phase_jam(SCENE, 165.0, jnp.zeros(2))
    branch = phase_branch(SCENE, jam, jnp.array([150.0, 160.0, 168.0, 172.0]))
    ((phase, omega, anew),) = asked
    np.testing.assert_array_equal(phase, jam.phase)
    at = int(np.sum(np.array([150.0, 160.0, 168.0, 172.0]) < float(jam.omega)))
    assert 0 < at < 4
    np.testing.assert_array_equal(omega, [*[150.0, 160.0, 168.0, 172.0][at:], *[150.0, 160.0, 168.0, 172.0][:at][::-1]])
    np.testing.assert_array_equal(anew, np.arange(4) == 4 - at)  # below the jam from its own phases again
    np.testing.assert_array_equal(branch.growth, branch.omega)


@pytest.mark.parametrize("growth", [-100.0, -0.01, 2.0])
def test_a_branch_has_the_jam_of_the_same_growth(growth):
    """The growth agrees to a thousandth, for small and large growth."""
    jam = phase_jam(SCENE, 165.0, jnp.zeros(2))
    branch = phase_branch(SCENE, jam, jnp.atleast_1d(jam.omega))
    branch = eqx.tree_at(lambda b: (b.growth, b.drag_factor), branch, (jnp.full(1, growth), jnp.ones(1)))
    assert _contains_jam(branch, 0, jnp.asarray(growth * (1.0 + 0.9e-3)))
    assert not _contains_jam(branch, 0, jnp.asarray(growth * (1.0 + 1.1e-3)))
    assert not _contains_jam(eqx.tree_at(lambda b: b.drag_factor, branch, jnp.full(1, 1.0002)), 0, jnp.asarray(growth))


def test_loads_are_equal_that_are_alike_in_every_number():
    loads = jv.pendulums(count=5, mass=0.05, radius=0.08, drag=0.04)
    heavier, braked = jnp.array([0.05, 0.05, 0.05, 0.1, 0.05]), jnp.array([0.04, 0.08, 0.04, 0.04, 0.04])
    loads = eqx.tree_at(lambda x: (x.mass, x.drag), loads, (heavier, braked))
    groups = equal_loads(assemble_torque_balance(jv.Scene(MACHINE, loads, jv.ConstantSpeed(460.0))))
    assert sorted(group.tolist() for group in groups) == [[0, 2, 4], [1], [3]]


@pytest.mark.parametrize(("away", "status"), [(0.0, PhaseStatus.unbounded), (1e-12, PhaseStatus.with_rotor)])
def test_loads_that_turn_with_the_rotor_at_an_undamped_resonance(away, status):
    """The amplitude there is rounding, not an answer; beside it, it is one, also where a load is hardly unbalanced."""
    machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=0.0)
    loads = jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04)
    loads = eqx.tree_at(lambda x: x.mass, loads, jnp.array([0.05, 1e-7]))
    speed = float(np.sqrt(1.16e6 / (37.0 + 0.05 + 1e-7))) * (1.0 + away)
    jam = jam_from(jv.Scene(machine, loads, jv.ConstantSpeed(speed)), jnp.asarray(speed), jnp.zeros(2))
    assert bool(jam.status == status)


def test_more_starts_than_fit_are_refused():
    """Each takes 64 bytes for each load at each load speed: how many fit into the memory is said."""
    fit = []
    for loads in (2, 6):
        scene = jv.Scene(MACHINE, jv.pendulums(count=loads, mass=0.05, radius=0.08, drag=0.04), SCENE.drive)
        with pytest.raises(jv.InputError, match=r"at most \d+ fit") as error:
            jv.phase_jams(scene, starts=10**12)
        fit.append(int(str(error.value).split("; ")[1].split()[2]))
    np.testing.assert_allclose(fit[0] / fit[1], 3.0, rtol=1e-3)


@pytest.mark.parametrize(("speed", "damping", "count"), [(5.0, 843.0, 1), (5.0, 0.0, 1), (460.0, 0.0, 1), (5.0, 843.0, 2)])
def test_no_jam_is_an_empty_result(speed, damping, count):
    """Far below the resonance no load needs what its drag takes."""
    machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=damping)
    loads = jv.pendulums(count=count, mass=0.05, radius=0.08, drag=0.04)
    found = jv.phase_jams(jv.Scene(machine, loads, jv.ConstantSpeed(speed)), starts=8)
    assert found.omega.shape == (0,) and found.phase.shape == (0, count) and found.starts.shape == (0,)
    assert found.summary() == "no jam" and found.plot().axes


def test_jams_come_by_falling_speed_and_stable_ones_first(monkeypatch):
    speeds, growth = np.array([200.0, 410.0, 200.0, 300.0]), np.array([1.0, 1.0, -1.0, -1.0])
    phases = np.array([[0.0, 0.5], [0.0, 1.0], [0.0, 1.5], [0.0, 2.0]])
    one = phase_jam(SCENE, 165.0, jnp.zeros(2))

    def solved(scene, omega, phase):
        jams = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], len(omega), axis=0), one)
        rate = growth[np.argmin(np.abs(phase[:, None, 1] - phases[None, :, 1]), axis=1)]
        return eqx.tree_at(lambda j: (j.omega, j.phase, j.growth, j.stable), jams, (omega, phase, rate, rate < 0.0))

    monkeypatch.setattr(phase_search, "_jams_from", solved)
    found = phase_search._jams_from_starts(SCENE, assemble_torque_balance(SCENE), speeds, phases)
    np.testing.assert_array_equal(found.omega, [410.0, 300.0, 200.0, 200.0])
    np.testing.assert_array_equal(found.stable, [False, True, True, False])
    np.testing.assert_array_equal(found.growth, [1.0, -1.0, -1.0, 1.0])
