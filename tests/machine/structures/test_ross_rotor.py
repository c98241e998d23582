"""Flexible rotor from the matrices of ROSS (see tests/data/ross_rotor.py): Campbell diagram, jammed and balanced motion."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv

DATA = np.load(Path(__file__).parents[2] / "data" / "ross_rotor.npz")
DISC = [8, 9]  # x and y of node 2
LOADS = jv.balls(count=2, mass=0.4, radius=0.12, drag=0.4)


SPEED = 300.0


def scene_of(speed=SPEED, reduce=None):
    names = ("mass", "damping", "stiffness", "gyroscopic")
    machine = jv.from_matrices(*(DATA[name] for name in names), places=[DISC], reduce=reduce)
    return jv.Scene(machine, LOADS, jv.ConstantSpeed(speed))


def test_campbell_diagram_is_that_of_ross():
    found = jv.whirl(scene_of(), DATA["speeds"], loads="none")
    for own, expected in zip(np.asarray(found.speed), DATA["whirl"], strict=True):
        nearest = own[np.argmin(np.abs(own[None] - expected[:, None]), axis=1)]
        np.testing.assert_allclose(nearest, expected, rtol=1e-6)


def braking(omega, phases, speed):
    """Mean braking torque of the vibration on each of two balls, by all 28 coordinates."""
    mass = DATA["mass"].copy()
    mass[DISC, DISC] += 0.8
    dynamic = DATA["stiffness"] - omega**2 * mass + 1j * omega * (DATA["damping"] + speed * DATA["gyroscopic"])
    push = np.zeros(28, complex)
    push[DISC] = 1.0, -1.0j
    turn = np.exp(1j * phases)
    forward = push.conj() @ np.linalg.solve(dynamic, push) * np.sum(turn)
    return -0.5 * (0.4 * 0.12) ** 2 * omega**4 * np.imag(turn.conj() * forward)


def test_jams_of_an_auto_balancer_meet_the_torque_balance():
    found = jv.phase_jams(scene_of(SPEED, 12), starts=8)
    assert found.omega.size > 1
    for omega, phases in zip(np.asarray(found.omega), np.asarray(found.phase), strict=True):
        drag = 0.4 * 0.12**2 * (SPEED - omega)
        np.testing.assert_allclose(braking(omega, phases, SPEED), drag, rtol=5e-3)


@pytest.mark.slow
def test_jam_and_balance_of_the_rotor_are_simulated():
    scene = scene_of(SPEED, 12)
    found = jv.phase_jams(scene, starts=8)
    jam = found.select(int(np.flatnonzero(np.asarray(found.stable))[0]))
    omega, z = jam.omega, jam.displacement

    def start(angles, rates, q, v):
        return jv.State(q, v, exciters=[jv.ExciterState(angle=(angles,), rate=(rates,))])

    stuck = start(jam.phase, jnp.full(2, omega), z.real, (1j * omega * z).real)
    free = start(jnp.array([0.0, 3.0]), jnp.full(2, SPEED), 0.0 * z.real, 0.0 * z.real)
    runs = [jv.simulate(scene, 10.0, start=each, save="window", estimate=False) for each in (stuck, free)]
    np.testing.assert_allclose(runs[0].omega, omega, rtol=5e-3)
    np.testing.assert_allclose(runs[1].load_speed, SPEED, rtol=1e-4)
    paths = [float(run.ellipse(1).semi_major) for run in runs]
    assert paths[1] < 1e-2 * paths[0]
