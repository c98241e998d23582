"""Resonances that hold rotors at the end of a run."""

import numpy as np

import jaxvib as jv
from jaxvib.cli.document import measured_document
from jaxvib.motion.analysis.caught import held_lines, held_rotors


def screen(*exciters):
    """Resonances at 14.1 rad/s, 135 rpm."""
    springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    return jv.Scene(jv.plane_body(mass=300.0, inertia=75.0, supports=springs), exciters=exciters)


def motor(stall_torque, direction=1):
    return jv.Exciter(drive=jv.DCMotor(100.0, stall_torque, inertia=0.5), unbalance=0.4, direction=direction)


def test_a_run_states_the_resonance_that_catches_its_motor():
    scene = screen(motor(0.6))
    run = jv.simulate(scene, "90 s", save="window", estimate=False, stepsize_controller=jv.Tolerance(1e-6))
    assert run.caught_at.tolist() == jv.run_up(scene, "90 s").caught_at.tolist() == [1]
    said = "exciter 1 is caught by resonance 1 at 135.05 rpm"
    assert said in run.summary() and "run longer (drift" not in run.summary()
    assert measured_document(run, scene)["caught_at"].tolist() == [1]


def test_rotors_are_held_near_a_resonance_at_a_constant_speed():
    resonances, time = np.array([14.0, 14.1, 18.0]), np.linspace(0.0, 1.0, 100)
    scene = screen(motor(1.0), motor(1.0, -1), jv.Exciter(drive=jv.ConstantSpeed(14.0), unbalance=0.4))

    def held(*speeds):
        return held_rotors(scene, speeds, resonances).tolist()

    still = np.full_like(time, 13.5)
    assert held(still, -still, still) == [1, 1, 0]
    assert held(still + 2.0 * np.sin(60.0 * time), np.full_like(time, -99.0), still) == [1, 0, 0]
    assert held(still + time, -0.5 * still, still) == [0, 0, 0]  # still accelerating, and on its way
    assert held_lines(np.array([1, 1, 3]), resonances) == [
        "exciters 1, 2 are caught by resonance 1 at 133.69 rpm: the motion is not that of the working speed",
        "exciter 3 is caught by resonance 3 at 171.89 rpm: the motion is not that of the working speed",
    ]
