"""Beats of loads with the imbalance of a rotor that turns faster."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.motion.analysis.beat import beat_period


def run_of(speed=60.0, drag=0.3, until=6.0, imbalance="5 g m"):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    loads = jv.balls(count=1, mass=0.5, radius=0.1, drag=drag)
    scene = jv.Scene(machine, loads, jv.ConstantSpeed(speed), (jv.StaticImbalance(imbalance),))
    return jv.simulate(scene, until, start="jam", mode=1, samples=2000, estimate=False)  # one program serves all runs


@pytest.mark.parametrize(
    ("values", "beats"),
    [
        ({"speed": 22.0, "drag": 0.1, "until": 60.0, "imbalance": "3 g m"}, True),  # a beat is as long as the measured window
        ({}, True),
        ({"speed": 22.0, "drag": 0.1, "until": 8.0, "imbalance": "3 g m"}, False),  # too short to recognize a beat
    ],
)
def test_summary_names_a_beat_with_its_period(values, beats):
    run = run_of(**values)
    line = run.summary().splitlines()[0]
    assert not run.settled and ("run longer" in line) != beats
    balanced = jv.Scene(run.scene.machine, run.scene.loads, run.scene.drive)
    assert beat_period(balanced, run.trajectory) is None  # nothing to beat with
    if beats:
        t, angle = np.asarray(run.trajectory.time), np.asarray(run.trajectory.state.azimuth[:, 0])
        late = t > t[-1] / 2.0
        slip = np.polyfit(t[late], (np.asarray(run.trajectory.rotor_angle) - angle)[late], 1)[0]
        period = float(line.split("with a period of ")[1].split(" s")[0])
        np.testing.assert_allclose(period, 2.0 * np.pi / slip, rtol=5e-3)


def test_regime_states_angles_of_an_irregular_pattern():
    found = run_of().regime
    angles = {"pattern": jv.PhasePattern.other, "phase": jnp.deg2rad(jnp.asarray([100.7, 180.0, -100.7]))}
    for name, text in (("balanced", "at 100.7, 180, 259.3 deg in the rotor"), ("jammed", "259.3 deg relative to load 1")):
        assert text in dataclasses.replace(found, name=getattr(jv.RegimeName, name), **angles).summary()
