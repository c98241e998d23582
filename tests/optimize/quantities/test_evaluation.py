"""Evaluation of the quantities of a scene."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from optimize import amplitude, fold_margin, foundation_force, phase, total
from optimize.quantities import evaluation as answers_module
from optimize.quantities.evaluation import Evaluation, TargetRecorder, speed_of_target
from optimize.quantities.jams import resolve_pair
from optimize.quantities.user_inputs import count_required_arguments, same_unit

SCENE = scene("two_mass")


FREE = jv.network(
    mass=[200.0, 100.0], stiffness=[0.0, 0.0], damping=[0.0, 0.0], links=[(1, 2)], link_stiffness=[5e4], link_damping=[50.0],
    exciter=1,
)  # fmt: skip


@pytest.mark.parametrize(("speed", "slowest"), [(60.0, np.sqrt(5e4 * 1.5 / 100.0)), (20.0, 20.0)])
def test_runs_of_a_machine_that_drifts_have_an_end(monkeypatch, speed, slowest):
    """The frequency 0 of the drift counts as the rotor speed."""
    ends = []
    monkeypatch.setattr(answers_module, "simulate", lambda scene, until, **more: ends.append(float(until)))
    drive, loads = jv.ConstantSpeed(speed), jv.balls(count=1, mass=1e-6, radius=0.1, drag=1.0)
    Evaluation(jv.Scene(FREE, loads, drive)).jam_run(1)
    np.testing.assert_allclose(ends, [60.0 * 2.0 * np.pi / slowest], rtol=1e-6)


@pytest.fixture(scope="module")
def modes():
    return jv.jam_modes(SCENE)


def test_runs_from_a_jam_last_sixty_slowest_periods(monkeypatch):
    asked = []
    monkeypatch.setattr(answers_module, "simulate", lambda scene, until, **more: asked.append((until, more)))
    evaluation = Evaluation(SCENE)
    evaluation.jam_run(3)
    evaluation.jam_run(3)
    k, m = np.array([[2.5e5, -2e5], [-2e5, 2.3e5]]), np.diag([120.0, 95.0 + 2.4])
    lowest = np.sqrt(np.linalg.eigvals(np.linalg.solve(m, k)).real.min())
    ((until, more),) = asked
    np.testing.assert_allclose(until, 60.0 * 2.0 * np.pi / lowest, rtol=1e-10)
    assert (more["start"], more["mode"], more["adjoint"]) == ("jam", 3, None)
    evaluation.start_up(5.0, 2.0)
    assert asked[1][0] == 5.0 and asked[1][1]["spin_up"] == 2.0
    kept = Evaluation(SCENE)
    kept.keep_run(3, "the run")
    assert kept.jam_run(3) == "the run" and len(asked) == 2


def test_runs_of_traced_scenes_are_traced(monkeypatch):
    """A search asks for the shapes of all quantities before it has numbers."""
    monkeypatch.setattr(
        answers_module, "simulate", lambda scene, until, **_: SimpleNamespace(window=scene.machine.mass * until)
    )
    found = jax.eval_shape(lambda s: Evaluation(s).jam_run(3).window, SCENE)
    assert found.shape == (2,)


def test_guesses_are_the_jam_and_the_folds_beside_it(modes):
    folds = np.sort(np.asarray(modes.folds.omega)[np.asarray(modes.folds.exists)])
    for mode in (3, 4):
        omega = float(modes.select(mode).omega)
        assert float(speed_of_target(modes, ("jam", mode))) == omega
        np.testing.assert_allclose(speed_of_target(modes, ("below", mode)), folds[folds < omega].max())
        np.testing.assert_allclose(speed_of_target(modes, ("above", mode)), folds[folds > omega].min())
    assert not np.isfinite(speed_of_target(modes, ("above", 5))) and np.isfinite(speed_of_target(modes, ("below", 5)))


def test_margins_are_to_the_nearer_fold(modes):
    """Odd modes end at a lower rotor speed on the side of lower load speeds, even ones on the other; none is 0, or 10 n."""
    evaluation = Evaluation(SCENE, modes=modes)
    assert evaluation.modes is modes
    below, above = evaluation.folds(5)
    assert 0.0 < below < 120.0 and float(above) == 1200.0
    for mode in (3, 4):
        ends = np.array([float(each) for each in evaluation.folds(mode)])
        slow, fast = ends if mode == 3 else ends[::-1]
        assert slow < 120.0 < fast
        np.testing.assert_allclose(fold_margin(mode=mode).read(evaluation), min(120.0 - slow, fast - 120.0), rtol=1e-12)
        pieces = fold_margin(mode=mode).pieces(evaluation, -1.0)
        np.testing.assert_allclose(pieces, [slow - 120.0, 120.0 - fast], rtol=1e-12)
        assert fold_margin(mode=mode).pieces(evaluation).shape == (1,)


def test_modes_are_numbered():
    for wrong in (0, 6, True, 2.0):
        with pytest.raises(jv.InputError, match="numbered 1 to 5"):
            Evaluation(SCENE).jam(wrong)
    recorder = TargetRecorder()
    recorder["a"], recorder["b"], recorder["a"]
    assert recorder.keys == ["a", "b"]


@pytest.mark.parametrize(("of", "found"), [(None, (1, 2)), (2, 2), ([1, 2], (1, 2)), ((2, 1), (2, 1)), ((1,), 1)])
def test_default_platforms_of_an_amplitude(of, found):
    assert resolve_pair(SCENE, of) == found
    assert resolve_pair(scene("one_mass")) == 1


@pytest.mark.parametrize("of", [0, 3, True, 1.0, (1, 1), (1, 3), (1, 2, 1), ()])
def test_unknown_platforms_of_an_amplitude_are_refused(of):
    with pytest.raises(jv.InputError, match="a platform from 1 to 2, or a pair of different platforms"):
        resolve_pair(SCENE, of)


def test_amplitudes_and_forces_of_each_tier():
    """Each quantity takes the right one of known answers."""
    jam = SimpleNamespace(
        amplitude=jnp.array([3.0, 5.0]), displacement=jnp.array([3.0, 4.0j]), foundation_force=jnp.asarray(7.0)
    )
    orbit = SimpleNamespace(
        amplitude=jnp.array([30.0, 50.0]), relative_amplitude=lambda i, j: jnp.asarray(10.0 * i + j),
        foundation_force=jnp.asarray(70.0), omega=jnp.asarray(9.0), orders=(1, 3),
        force_harmonics=jnp.array([[1.0 + 1.0j, 3.0j]]), displacement_harmonics=jnp.array([[1.0, 5.0], [1.0j, 5.0]]),
        force_peaks=lambda: jnp.array([60.0, 70.0]),
    )  # fmt: skip
    run = SimpleNamespace(amplitude=jnp.array([300.0, 500.0]), foundation_force=jnp.asarray(700.0))
    known = SimpleNamespace(scene=SCENE, jam=lambda mode: jam, orbit=lambda mode: orbit, jam_run=lambda mode: run)
    for of, values in ((1, (3.0, 30.0, 300.0)), (2, (5.0, 50.0, 500.0))):
        for tier, value in zip(("leading", "exact", "time"), values, strict=True):
            assert float(amplitude(mode=3, of=of, tier=tier).read(known)) == value
    assert float(amplitude(mode=3, of=(1, 2)).read(known)) == 5.0
    assert float(amplitude(mode=3).read(known)) == 5.0 and float(amplitude(mode=3, of=(2, 1), tier="exact").read(known)) == 21.0
    for tier, value in (("leading", 7.0), ("exact", 70.0), ("time", 700.0)):
        assert float(foundation_force(mode=3, tier=tier).read(known)) == value
    np.testing.assert_allclose(phase(mode=3).read(known), np.pi / 2.0)
    np.testing.assert_allclose(phase(mode=3, tier="exact").read(known), np.pi / 2.0)
    np.testing.assert_allclose(foundation_force(mode=3, harmonic=3).read(known), 3.0)
    assert float(foundation_force(mode=3, harmonic=2).read(known)) == 0.0
    np.testing.assert_array_equal(foundation_force(mode=3, tier="exact").pieces(known), [60.0, 70.0])
    np.testing.assert_array_equal(foundation_force(mode=3, tier="exact").pieces(known, -1.0), [-70.0])
    np.testing.assert_array_equal(foundation_force(mode=3).pieces(known, -1.0), [-7.0])


def test_numbers_and_units_of_users_are_read():
    assert (
        count_required_arguments(lambda s: s) == 1
        and count_required_arguments(lambda s, m: s) == 2
        and count_required_arguments(lambda s, m=3, *, k=2: s) == 1
    )
    assert count_required_arguments(lambda *s: s) == 0 and count_required_arguments(max) in (0, 1)
    assert same_unit("N", "kg m/s^2") and same_unit("", "dimensionless") and same_unit("rad/s", "rad/s")
    assert not same_unit("N", "kN") and not same_unit("N", "m") and not same_unit("nonsense", "N")
    for wrong in ("drive.speed", "machine.kind", "machine", "effects.mass", 3):
        with pytest.raises(jv.InputError, match=r"must name parameters of a scene|must be a string"):
            total(wrong)


def test_following_does_not_reach_another_mode(modes):
    """The start is the speed of mode 4, where the branch falls; mode 3 lies where it rises."""
    key = ((), ("jam", 3))
    near = {mode: Evaluation(SCENE, {key: modes.select(mode).omega}) for mode in (3, 4)}
    np.testing.assert_allclose(near[3].orbit(3).omega, jv.jam_orbit(SCENE, mode=3).omega, rtol=1e-9)
    assert np.isnan(near[4].jam(3).omega)
