"""Times until a call returns: in a new process with an empty cache of programs, in a new process with a warm cache, and
repeated in the same process. The table is that of `docs/speed.md`.

    python benchmarks/first_answers.py [--only NAME ...]

Each function is called from plain Python, without `jit`, in separate processes. The time of the first call, s, includes the
import of jaxvib and the construction of the scene, but not the import of JAX, Equinox, diffrax and optimistix. The time of a
repeated call, ms, is the shortest of 5. The scene is a two-mass machine with three balls. The times of commands are those of
the whole process, including the start of Python and JAX, with the files of `examples/antiphase`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from parts.common import machine_line

PRELUDE = """
import time
import jax, equinox, diffrax, optimistix
jax.config.update("jax_enable_x64", True)
begun = time.perf_counter()
import jaxvib as jv
scene = jv.Scene(jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 3e4), damping=(40.0, 20.0), link_stiffness=2e5,
                             link_damping=60.0), jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed(120.0))
def stiffer(k):
    return equinox.tree_at(lambda s: s.machine.stiffness, scene, k)
K = scene.machine.stiffness
"""

CALLS = {
    "jam_modes": "call = lambda: jv.jam_modes(scene)",
    "jam_modes, gradient": (
        "call = lambda: jax.grad(lambda k: jv.jam_modes(stiffer(k)).select(3, throw=False).foundation_force)(K)"
    ),
    "branches": "call = lambda: jv.branches(scene)",
    "branches(exact=True)": "call = lambda: jv.branches(scene, exact=True)",
    "jam_orbit": "call = lambda: jv.jam_orbit(scene, mode=3)",
    "jam_orbit, gradient": "call = lambda: jax.grad(lambda k: jv.jam_orbit(stiffer(k), mode=3).foundation_force)(K)",
    "phase_jams": "call = lambda: jv.phase_jams(scene)",
    "criterion": "call = lambda: jv.criterion(scene)",
    "simulate, 5 s, window": "call = lambda: jv.simulate(scene, 5.0, start='jam', mode=3, save='window')",
    "simulate, 5 s": "call = lambda: jv.simulate(scene, 5.0, start='jam', mode=3)",
    "simulate, gradient forward": (
        "call = lambda: jax.jacfwd(lambda k: jv.simulate(stiffer(k), 5.0, start='jam', mode=3, save='window', "
        "adjoint=diffrax.ForwardMode()).foundation_force)(K)"
    ),
    "simulate, gradient reverse": (
        "call = lambda: jax.grad(lambda k: jv.simulate(stiffer(k), 5.0, start='jam', mode=3, save='window', "
        "max_steps=4096).foundation_force)(K)"
    ),
    "settle": "call = lambda: jv.settle(scene, start='jam', mode=3)",
    "envelope": "call = lambda: jv.envelope(scene, 5.0, start='jam', mode=3)",
    "ensemble of 64": (
        "speeds = jax.numpy.linspace(100.0, 120.0, 64)\n"
        "make = lambda n: equinox.tree_at(lambda s: s.drive.speed, scene, n)\n"
        "call = lambda: jv.ensemble(make, speeds, 5.0)"
    ),
    "synthesize, 64 starts": (
        "from optimize import DesignSpace, force_per_amplitude, hold, jam_frequency, synthesize\n"
        "space = DesignSpace(scene, free={'machine.stiffness': (1e4, 1e5), 'machine.link_stiffness': (1e5, 4e5)}, "
        "hold=[hold(jam_frequency(mode=3), 70.0)])\n"
        "call = lambda: synthesize(space, force_per_amplitude(mode=3), starts=64, verify=False)"
    ),
}

EXAMPLE = Path(__file__).parent.parent / "examples" / "antiphase"

COMMANDS = {
    "jaxvib modes": "modes machine.toml",
    "jaxvib criterion": "criterion machine.toml",
    "jaxvib simulate, 5 s": "simulate machine.toml --until 5s --start jam --mode 3",
    "jaxvib optimize": "optimize design.toml",
}

MEASURE = """
jax.block_until_ready(jax.tree.leaves(call()))
first = time.perf_counter() - begun
again = []
for _ in range(5):
    begun = time.perf_counter()
    jax.block_until_ready(jax.tree.leaves(call()))
    again.append(time.perf_counter() - begun)
print("TIMES", first, min(again))
"""


def time_call(name: str, cache: str) -> tuple[float, float]:
    """Return the times, s, of the first and of a repeated call in a new process."""
    printed = process([sys.executable, "-c", PRELUDE + CALLS[name] + MEASURE], cache)
    first, again = next(line for line in printed.splitlines() if line.startswith("TIMES")).split()[1:]
    return float(first), float(again)


def time_command(name: str, cache: str) -> float:
    """Return the time of a command, s."""
    begun = time.perf_counter()
    process([sys.executable, "-c", "from jaxvib.cli import main; main()", *COMMANDS[name].split()], cache)
    return time.perf_counter() - begun


def process(command: list[str], cache: str) -> str:
    """Return the output of a process that runs in the folder of the example with the given cache.

    **Raises** `SystemExit` if the process fails.
    """
    ours = ("XLA_FLAGS", "EQX_ON_ERROR", "JAX_COMPILATION_CACHE_DIR", "JAXVIB_AUTOMATIC")  # engine.py sets the last
    clean = {key: value for key, value in os.environ.items() if key not in ours} | {"XDG_CACHE_HOME": cache}
    done = subprocess.run(command, env=clean, cwd=EXAMPLE, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)[-200:]}: {done.stderr}")
    return done.stdout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=[*CALLS, *COMMANDS], default=[*CALLS, *COMMANDS])
    options = parser.parse_args()
    print(machine_line())
    print("| call | empty cache, s | warm cache, s | repeated call, ms |\n|---|---|---|---|")
    for name in options.only:
        with tempfile.TemporaryDirectory() as cache:
            if name in CALLS:
                empty, _ = time_call(name, cache)
                warm, again = time_call(name, cache)
                print(f"| {name} | {empty:.1f} | {warm:.1f} | {1e3 * again:.2f} |", flush=True)
            else:
                empty, warm = (time_command(name, cache) for _ in range(2))
                print(f"| command `{name}` | {empty:.1f} | {warm:.1f} |  |", flush=True)


if __name__ == "__main__":
    main()
