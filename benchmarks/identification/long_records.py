"""CPU time and memory of the identification of long records, in a new process and again in the same one.

    python benchmarks/identification/long_records.py

Two masses run up through both resonances (22 and 64 rad/s) under an unbalance, to 100 rad/s. Three channels are recorded: two
accelerometers with noise, and a tachometer of 24 pulses per turn. The motion is the sum of the modes, each of them exact for a
force that is linear between the samples. A WAV file with values in single precision is read by `read_run`.

The memory is the largest one of the process, with the interpreter and all packages.
"""

from __future__ import annotations

import os
import pathlib
import resource
import subprocess
import sys
import tempfile

import numpy as np

CASES = ((40.0, 2000.0), (600.0, 10_000.0))
"""Durations, s, and sampling rates, Hz."""

MASS, STIFFNESS, DAMPING = (120.0, 95.0), (5e4, 6e4), (160.0, 120.0)
LINK_STIFFNESS, LINK_DAMPING, UNBALANCE = 2e5, 130.0, 0.05
TOP, NOISE, MARKS = 100.0, 0.05, 24


def write_record(path: pathlib.Path, duration: float, rate: float) -> None:
    """Write a record."""
    from scipy.io import wavfile
    from scipy.signal import lfilter

    t, rise = np.arange(round(duration * rate)) / rate, TOP / duration
    angle, speed = 0.5 * rise * t**2, rise * t
    force = UNBALANCE * (speed**2 * np.sin(angle) - rise * np.cos(angle))
    stiffness = np.diag(STIFFNESS) + LINK_STIFFNESS * np.array([[1.0, -1.0], [-1.0, 1.0]])
    damping = np.diag(DAMPING) + LINK_DAMPING * np.array([[1.0, -1.0], [-1.0, 1.0]])
    mass = np.array(MASS)[:, None]
    flow = np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness / mass, -damping / mass]])
    entry = np.array([0.0, 0.0, 0.0, 1.0 / MASS[1]])
    poles, shapes = np.linalg.eig(flow)
    readings = entry[2:, None] * force
    for pole, shape, push in zip(poles, shapes.T, np.linalg.solve(shapes, entry.astype(complex)), strict=True):
        if pole.imag < 0.0:
            continue
        z, grown = pole / rate, np.exp(pole / rate)
        late = (grown - 1.0 - z) / z**2
        state = push / rate * lfilter([late, (grown - 1.0) / z - late], [1.0, -grown], force)
        readings = readings + 2.0 * np.real((flow[2:] @ shape)[:, None] * state)
    rng = np.random.default_rng(0)
    readings += NOISE * rng.normal(size=readings.shape)
    tachometer = np.where(MARKS * angle / (2.0 * np.pi) % 1.0 < 0.5, 1.0, 0.0)
    wavfile.write(path, round(rate), np.stack([*readings, tachometer], axis=1).astype(np.float32))


def measure(path: str) -> None:
    """Identify the machine from a record twice, and print the CPU time and the largest memory."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxvib as jv

    spent = [0.0]
    machine = jv.two_mass(
        mass=MASS,
        stiffness=(1.05 * STIFFNESS[0], 0.96 * STIFFNESS[1]),
        damping=(200.0, 100.0),
        link_stiffness=LINK_STIFFNESS,
        link_damping=LINK_DAMPING,
    )
    motor = jv.DCMotor("1500 rpm", stall_torque=5.0, inertia=0.1)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=UNBALANCE, at=2)])
    channels = [jv.Channel(f"channel {k}", "acceleration", at=k, gain_error=0.0) for k in (1, 2)]
    channels.append(jv.Channel("channel 3", "pulses", per_turn=MARKS))
    names = ["machine.stiffness", "machine.damping", "machine.link_stiffness", "machine.link_damping", "exciters[0].unbalance"]
    fit = None
    for _ in range(2):
        run = jv.read_run(path, channels)
        fit = jv.identify(scene, run, unknown=names)
        del run
        used = resource.getrusage(resource.RUSAGE_SELF)
        spent.append(used.ru_utime + used.ru_stime)
    assert isinstance(fit, jv.MachineFit)
    truth = np.array([*STIFFNESS, *DAMPING, LINK_STIFFNESS, LINK_DAMPING, UNBALANCE])
    found = np.array([each.value for each in fit.estimates])
    away = np.max(np.abs(found - truth) / np.array([each.error for each in fit.estimates]))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    first, again = np.diff(spent)
    print(f"| {first:.1f} s | {again:.1f} s | {memory:.2f} GB | {fit.status_name}, at most {away:.1f} standard errors away |")
    if "--summary" in sys.argv:
        print(fit.summary())


def main() -> None:
    """Print the table."""
    print("| record | new process | again | memory | fit |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for duration, rate in CASES:
            path = pathlib.Path(folder) / "run.wav"
            write_record(path, duration, rate)
            print(f"| {duration:g} s at {rate:g} Hz ", end="", flush=True)
            subprocess.run([sys.executable, __file__, str(path)], check=True, env=dict(os.environ))


if __name__ == "__main__":
    if len(sys.argv) > 1:
        measure(sys.argv[1])
    else:
        main()
