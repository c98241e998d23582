"""Methods of a run."""

import dataclasses
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_machine import small_run

import jaxvib as jv
from jaxvib.motion.integrate import _is_coincident


@pytest.fixture(scope="module")
def run():
    return small_run((jv.Gravity(),))


@pytest.fixture(scope="module")
def window():
    return small_run((jv.Gravity(),), save="window")


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)
        assert x.dtype == y.dtype


def test_a_saved_run_is_read_back_bit_for_bit(run, window, tmp_path):
    again = jv.Run.load(run.save(tmp_path / "run"))
    same(again, run)
    assert again.summary() == run.summary()
    back = jv.Run.load(window.save(tmp_path / "window.npz"))
    assert back.trajectory is None
    same(back, window)


def test_reading_what_is_no_run_is_an_input_error(tmp_path):
    with pytest.raises(jv.InputError, match="there is no such file"):
        jv.Run.load(tmp_path / "missing.npz")
    (tmp_path / "text.npz").write_text("no run")
    np.savez(tmp_path / "other.npz", x=np.zeros(2))
    for name in ("text.npz", "other.npz"):
        with pytest.raises(jv.InputError, match=r"it is not a result written by save"):
            jv.Run.load(tmp_path / name)


def test_to_xarray_has_names_and_units(run):
    data = run.to_xarray()
    assert dict(data.sizes) == {"time": 21, "window_time": 4096, "coordinate": 2, "load": 3, "direction": 1}
    assert data["displacement"].attrs["units"] == "m" and data["time"].attrs["units"] == "s"
    np.testing.assert_array_equal(data["displacement"].sel(coordinate="y2"), run.trajectory.state.displacement[:, 1])
    assert data.attrs["message"] == "the run reached its end"


def test_summary_and_plot_show_the_run(run):
    assert run.summary().startswith("the run reached its end: 20 s") and "zero to peak: y1" in run.summary()
    assert "detached" not in run.summary()
    assert len(run.plot().axes) == 6  # three quantities, each as a whole and its last periods


def test_summary_omits_a_number_of_evaluations_that_is_unknown(run):
    assert f"; {int(run.evaluations)} evaluations in " in run.summary()
    assert "; computed in " in dataclasses.replace(run, evaluations=jnp.array(0)).summary()


def test_summary_states_that_the_phase_is_not_determined(run):
    said = [eqx.tree_at(lambda r: r.error, run, jnp.asarray(error)).summary() for error in (0.9, 5.4)]
    assert "phase included, 9.0e-01" in said[0] and "the phase of the motion is not determined" not in said[0]
    assert "the phase of the motion is not determined (estimated error of the states in the window 5.4e+00); small" in said[1]


def test_window_alone_measures_the_same(run, window):
    assert window.trajectory is None and len(window.plot().axes) == 6
    np.testing.assert_allclose(window.amplitude, run.amplitude, rtol=1e-12)
    np.testing.assert_allclose(window.omega, run.omega, rtol=1e-12)
    np.testing.assert_allclose(window.foundation_force, run.foundation_force, rtol=1e-12)


def test_largest_force_is_a_magnitude():
    """The force of an unbalance that turns: its steady magnitude is that of each direction, both peaks are not at one time."""
    machine = jv.planar_rotor(mass=10.0, stiffness=1e5, damping=50.0)
    s = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.02)])
    run = jv.simulate(s, 1.0, estimate=False)
    force, state = np.asarray(run.trajectory.foundation_force), run.trajectory.state
    np.testing.assert_allclose(force, 1e5 * state.displacement + 50.0 * state.velocity, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(run.largest_force, np.max(np.hypot(*force.T)), rtol=1e-5)
    assert float(run.largest_force) < 0.9 * np.hypot(*np.max(np.abs(force), axis=0))
    assert f"magnitude of the foundation force {float(run.largest_force):.4g} N" in run.summary()
    # One rotating force has both values in the summary.
    relation = "root sum square of both directions: sqrt(2) times the magnitude of a force that rotates"
    assert f"foundation force {float(run.foundation_force):.4g} N ({relation})" in run.summary()


def test_forces_of_a_rotor_are_labelled_by_direction():
    """The scene of the test above."""
    machine = jv.planar_rotor(mass=10.0, stiffness=1e5, damping=50.0)
    s = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.02)])
    run = jv.simulate(s, 1.0, estimate=False)
    force = run.to_xarray()["foundation_force"]
    np.testing.assert_array_equal(force.sel(direction="z"), run.trajectory.foundation_force[:, 1])
    assert {"foundation_force y (N)", "foundation_force z (N)"} <= set(run.to_pandas())
    measures = jv.vibration_measures(s, run.vibration())
    y, z = (f"{float(each):.4g} N" for each in measures.foundation_load)
    text = measures.summary()
    assert f"foundation: {y} in y, {z} in z (dynamic)" in text
    assert f"support 1: {z} dynamic in z, {y} dynamic in y" in text


def test_loads_run_together_that_have_one_angle_all_the_time():
    """Several of them, but for what rounding may have grown to: with any two apart at one instant they are not together."""
    once = np.linspace(0.0, 100.0, 5)[:, None] + np.zeros(3)
    parted = once + np.eye(5, 3) * 1e-3
    assert bool(_is_coincident([once], [None])) and bool(_is_coincident([once + np.eye(5, 3) * 1e-9], [None]))
    assert not bool(_is_coincident([parted], [None])) and not bool(_is_coincident([once[:, :1]], [None]))
    turned, stations = once + np.array([0.0, 1.0, 0.0]), np.array([0.1, -0.1, 0.1])
    assert bool(_is_coincident([turned], [stations])) and not bool(_is_coincident([turned], [np.sort(stations)]))


def test_the_summary_names_the_loads_that_left_their_track(run):
    def said(times):
        return type(run)._detachment(types.SimpleNamespace(detached=np.asarray(times)))

    (sentence,) = said([np.nan, 0.25, 1.5])
    assert "loads lost contact with their track (load 2 at 0.25 s, 3 at 1.5 s)" in sentence
    assert said([np.nan, np.nan]) == []
