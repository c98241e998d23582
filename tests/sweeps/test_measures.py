"""Numbers that are read off the runs of a sweep."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.motion.batch import BatchPlan, run_in_batch
from jaxvib.motion.start import initial_state
from jaxvib.sweeps import measures
from jaxvib.sweeps.measures import RUN_MEASURES
from jaxvib.sweeps.study import study


def watched(speeds, change=1e-4):
    """A run of 10 s under a rotor at 100 rad/s, watched in parts of 2 s: the speeds of two loads in each."""
    speeds = jnp.asarray(speeds)
    return SimpleNamespace(
        part_speed=speeds,
        part_length=jnp.asarray(2.0),
        measured=SimpleNamespace(load_speed=speeds[-1]),
        window=SimpleNamespace(rotor_speed=jnp.full(3, 100.0), time=jnp.asarray([9.0, 9.5, 10.0])),
        regime=SimpleNamespace(change=jnp.asarray(change)),
    )


@pytest.mark.parametrize(
    ("second", "settled"),
    [
        ([27.0, 27.0, 27.0, 27.0, 27.0], 0.0),
        ([10.0, 27.0, 27.0, 27.0, 27.0], 2.0),
        ([10.0, 27.0, 25.9, 27.0, 27.0], 6.0),  # near means within 1 % of the rotor speed
        ([10.0, 27.0, 26.1, 27.0, 27.0], 2.0),
        ([10.0, 20.0, 23.0, 28.1, 27.0], 8.0),
    ],
)
def test_settling_ends_with_the_last_part_that_is_away(second, settled):
    measure = RUN_MEASURES["run.settling_time"].function
    speeds = np.stack([np.full(5, 27.0), second], axis=1)
    np.testing.assert_allclose(measure(watched(speeds)), settled)
    np.testing.assert_allclose(measure(watched(speeds[:, ::-1])), settled)
    np.testing.assert_allclose(measure(watched(speeds, change=0.02)), 10.0)


@pytest.mark.parametrize(("gain", "settled"), [(0.0, 0.0), (4.0, 10.0)])
def test_runs_of_exciters_settle_when_all_speeds_are_constant(gain, settled, monkeypatch):
    """The speed of the second mass differs between the halves of the window."""
    run = watched(np.full((5, 2), 27.0))
    run.regime, run.scene, run.window.state = None, None, None
    monkeypatch.setattr(measures, "turning_angles", lambda *_: ())
    monkeypatch.setattr(measures, "mean_speeds", lambda *_, **__: (jnp.asarray([27.0, 27.0]), jnp.asarray([27.0, 27.0 + gain])))
    np.testing.assert_allclose(RUN_MEASURES["run.settling_time"].function(run), settled)


def test_measures_of_data_sheets_follow_from_a_run():
    table = jv.one_mass(mass=49.0, stiffness=4e4, damping=100.0)
    scene = jv.Scene(table, jv.balls(count=2, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed(60.0))
    state = initial_state(scene, "jam", mode=1, separation=0.0)
    plan = BatchPlan(until=20.0, window=4.0, samples=1024, each=400, between=2)

    @jax.jit
    def computed(scene):
        run = run_in_batch(scene, state, plan)
        names = ("stroke", "transmissibility", "shaft_torque", "shaft_power", "support_load")
        return run.measured, [RUN_MEASURES[f"run.{name}"].read(run) for name in names]

    measured, (stroke, ratio, torque, power, load) = computed(scene)
    np.testing.assert_allclose(stroke, 2.0 * measured.amplitude, rtol=1e-12)
    np.testing.assert_allclose(ratio, measured.foundation_force / (0.1 * measured.omega**2), rtol=1e-3)
    np.testing.assert_allclose(torque, [2 * 0.5 * 0.1**2 * (60.0 - measured.omega)], rtol=1e-3)
    np.testing.assert_allclose(power, 60.0 * torque, rtol=1e-9)
    np.testing.assert_allclose(load, [50.0 * 9.80665 + measured.foundation_force], rtol=2e-2)


def test_the_unit_of_an_acceleration_is_named():
    assert RUN_MEASURES["run.acceleration"].words == "acceleration in g" and RUN_MEASURES["run.velocity"].words == "velocity"


def test_runs_of_several_exciters_are_measured(tmp_path):
    """Motors of opposite directions on soft supports; a no-load speed of 130 rad/s is beyond their synchronization."""
    springs = [jv.support(at=(x, 0.0), stiffness=(1e4, 1e4), damping=(500.0, 500.0)) for x in (-1.0, 1.0)]
    body = jv.plane_body(mass=2000.0, inertia=600.0, supports=springs)
    parts = ((-0.9, 1, 100.0), (0.8, -1, 100.5))
    motors = [(x, way, jv.DCMotor(n, stall_torque=300.0, inertia=0.2)) for x, way, n in parts]
    scene = jv.Scene(body, exciters=[jv.Exciter(drive=m, unbalance=1.5, at=(x, 0.0), direction=w) for x, w, m in motors])
    names = ["load_speed", "relative_rotation", "amplitude", "shaft_torque", "settling_time"]
    measures = [f"run.{name}" for name in names]
    found = jv.sweep(scene, {"exciters[1].drive.speed": [100.5, 130.0]}, measures, tmp_path / "motors.zarr", until=12.0).data
    run = jv.simulate(scene, 12.0, save="window", estimate=False)
    np.testing.assert_allclose(found["load_speed"][0], run.omega, rtol=1e-5)
    np.testing.assert_allclose(found["amplitude"][0][:2], run.amplitude[:2], rtol=1e-3)
    torque = [300.0 * (1.0 - float(run.omega) / n) for n in (100.0, 100.5)]
    np.testing.assert_allclose(found["shaft_torque"][0], torque, rtol=0.05, atol=1e-3)
    assert found["relative_rotation"][0] < 0.05 and found["relative_rotation"][1] > 2.0 * np.pi
    assert 0.0 < found["settling_time"][0] < 9.0
    with pytest.raises(
        jv.InputError, match=r"run.regime, which needs a scene with one anticlockwise exciter .*; for other scenes use"
    ):
        jv.sweep(scene, {"exciters[0].unbalance": [1.0, 1.5]}, ["run.regime"], tmp_path / "regime.zarr", until=1.0)


def test_runs_of_a_clockwise_exciter_are_measured(tmp_path):
    """Without gravity its speeds are those of the anticlockwise exciter with the other sign."""
    table, balls = jv.one_mass(mass=49.0, stiffness=4e4, damping=100.0), jv.balls(count=1, mass=0.5, radius=0.1, drag=2.0)
    found = []
    for way in (1, -1):
        scene = jv.Scene(table, exciters=[jv.Exciter(balls, jv.ConstantSpeed(60.0), direction=way)])
        path = tmp_path / f"{way}.zarr"
        found.append(jv.sweep(scene, {"drive.speed": [25.0, 60.0]}, ["run.load_speed", "run.drift"], path, until=2.0).data)
    for name in ("load_speed", "drift"):
        np.testing.assert_allclose(found[1][name], found[0][name], rtol=1e-6)


def test_a_spin_up_in_a_sweep_is_that_of_simulate(tmp_path):
    table = jv.one_mass(mass=49.0, stiffness=4e4, damping=100.0)
    scene = jv.Scene(table, jv.balls(count=1, mass=0.5, radius=0.1, drag=2.0), jv.ConstantSpeed(60.0))
    found = jv.sweep(scene, {"drive.speed": [25.0, 60.0]}, ["run.load_speed"], tmp_path / "s.zarr", until=10.0, start="spin_up")
    runs = [jv.simulate(jv.Scene(table, scene.loads, jv.ConstantSpeed(n)), 10.0, start="spin_up") for n in (25.0, 60.0)]
    np.testing.assert_allclose(found.data["load_speed"].values, [run.omega for run in runs], rtol=1e-4)
    assert float(found.scene.drive.duration) == 5.0
    turning = jv.Scene(table, scene.loads, jv.SpinUp(60.0, duration=2.0))
    with pytest.raises(jv.InputError, match="start is 'spin_up', which needs a constant speed, but the drive is 'spin_up'"):
        study(turning, {"loads.drag": [1.0]}, ["run.load_speed"], until=9.0, start="spin_up")


@pytest.mark.parametrize("measure", ["run.regime", next(iter(RUN_MEASURES.values())), [], {}, 3.0])
def test_measures_that_are_no_list_are_refused(measure):
    scene = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
        jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0),
        jv.ConstantSpeed(60.0),
    )
    with pytest.raises(jv.InputError, match=r"measure is .*; give a list of quantities, such as"):
        study(scene, {"loads.drag": [0.5, 1.0]}, measure)
