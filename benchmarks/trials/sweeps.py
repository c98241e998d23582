"""Cost and robustness of sweeps: a map of captures, killed runs, a killed worker, a million cases.

    python benchmarks/trials/sweeps.py map --out out
    python benchmarks/trials/sweeps.py killed
    python benchmarks/trials/sweeps.py cluster
    python benchmarks/trials/sweeps.py million --out out
    python benchmarks/trials/sweeps.py memory

The machine is the two-mass machine of the antiphase paper in dimensionless parameters, with one load and eps = 0.05. Both the
elapsed time and the CPU time are printed; the CPU time hardly depends on other programs that are running.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
import jaxvib.sweeps.cluster
from optimize import Quantity, amplitude, jam_frequency

jv.prepare_cpu()
jax.config.update("jax_enable_x64", True)

READ = ["run.regime", "run.mode", "run.load_speed", "run.amplitude", "run.foundation_force", "run.settling_time"]


def machine() -> jv.Scene:
    return jv.Dimensionless(
        "antiphase",
        natural=(1 / 3, 1 / 3),
        damping=(0.01, 0.01),
        link_natural=2 / 3,
        link_damping=0.01,
        rho=1.0,
        eps=0.05,
        beta=1.0,
        speed=3.0,
    ).scene()


def capture(store: pathlib.Path, size: int = 200, until: float = 1000.0, **more) -> jv.Sweep:
    """Rotor speed against the speed that the load starts with."""
    axes = {"drive.speed": {"from": 0.3, "to": 3.0, "count": size}, "start.rate": {"from": 0.0, "to": 2.0, "count": size}}
    return jv.sweep(machine(), axes, READ, store, until=until, **more)


def light(store: pathlib.Path, cases: int, **more) -> jv.Sweep:
    """Jams of light loads over sampled rotor speeds and drag, from half to twice the published one."""
    drag = float(machine().loads.drag)
    axes = {"drive.speed": {"from": 0.5, "to": 6.0}, "loads.drag": {"from": 0.5 * drag, "to": 2.0 * drag, "scale": "log"}}
    measure = [jam_frequency(mode=3), amplitude(mode=3, of=(1, 2))]
    return jv.sweep(machine(), axes, measure, store, samples=cases, chunk=8192, **more)


def lowest(scene: jv.Scene) -> jax.Array:
    return jv.natural_frequencies(scene)[0]


def many_chunks(store: pathlib.Path, **more) -> jv.Sweep:
    """Cases that cost next to nothing, in 625 chunks: most of the time goes into writing."""
    axes = {
        "machine.stiffness[0]": {"from": 0.08, "to": 0.15, "count": 200},
        "machine.stiffness[1]": {"from": 0.08, "to": 0.15, "count": 200},
    }
    return jv.sweep(machine(), axes, [Quantity("lowest", "rad/s", lowest)], store, chunk=64, **more)


def clocks() -> tuple[float, float]:
    spent = os.times()  # that of workers counts when they have ended
    return time.perf_counter(), spent.user + spent.system + spent.children_user + spent.children_system


def since(begun: tuple[float, float]) -> str:
    now = clocks()
    return f"{now[0] - begun[0]:.1f} s, {now[1] - begun[1]:.1f} s of CPU time"


def same(one: pathlib.Path, other: pathlib.Path) -> bool:
    """True if two stores hold the same numbers, bit for bit."""
    first, second = jv.open_sweep(one).data, jv.open_sweep(other).data
    return all(first[name].values.tobytes() == second[name].values.tobytes() for name in first if name != "error")


def captures(folder: pathlib.Path, out: pathlib.Path) -> None:
    begun = clocks()
    found = capture(folder / "map.zarr", report=told)
    print(found.summary(), f"\n{since(begun)}", flush=True)
    begun = clocks()
    found.plot().savefig(out / "jam_map.png")
    print("figure with its folds and torus points:", since(begun), flush=True)
    data, generator = found.data.load(), np.random.default_rng(0)
    speed, rate = data["drive.speed"].values, data["start.rate"].values
    agree, worst, sample = 0, 0.0, 60
    for _ in range(sample):
        i, j = generator.integers(speed.size), generator.integers(rate.size)
        scene = eqx.tree_at(lambda s: s.drive.speed, machine(), jnp.asarray(speed[i]))
        start = eqx.tree_at(lambda s: s.rate, jv.initial_state(scene), (jnp.full(1, rate[j]),))
        run = jv.simulate(scene, 1000.0, start=start, save="window", estimate=False)
        cell = data.isel({"drive.speed": int(i), "start.rate": int(j)})
        alike = (
            int(run.regime.mode) == int(cell["mode"])
            and jv.RegimeName[run.regime.name] == list_of_regimes(data)[int(cell.regime)]
        )
        agree += alike
        if not alike:
            print("differs at", speed[i], rate[j], run.regime.summary(), "; map:", int(cell["mode"]), float(cell.load_speed))
        worst = max(worst, abs(float(run.omega) / float(cell.load_speed) - 1.0))
    print(f"single runs by simulate: {agree} of {sample} have the same label; load speed differs by {worst:.1e} at most")


def list_of_regimes(data) -> list[str]:
    return [jv.RegimeName[getattr(jv.RegimeName, word)] for word in data.regime.attrs["flag_meanings"].split()]


def told(now) -> None:
    print(f"  {now.done} of {now.cases}, {now.rate:.0f} a second, {now.left:.0f} s left", flush=True)


CHILD = """
import pathlib, sys
sys.path.insert(0, {folder!r})
import sweeps
if __name__ == "__main__":
    sweeps.many_chunks(pathlib.Path({store!r}), report=lambda now: print(now.done, flush=True))
"""


def child(store: pathlib.Path) -> subprocess.Popen:
    text = CHILD.format(folder=str(pathlib.Path(__file__).parent), store=str(store))
    return subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True)


def killed(folder: pathlib.Path, out: pathlib.Path) -> None:
    whole, broken = folder / "whole.zarr", folder / "broken.zarr"
    many_chunks(whole)
    generator, kills = random.Random(1), 0
    while kills < 20:
        run = child(broken)
        # at a random moment: of a chunk that is computed, or of one that is being written
        for _ in range(generator.randint(1, 35)):
            run.stdout.readline()
        time.sleep(generator.random() * 0.05)
        run.send_signal(signal.SIGKILL)
        if run.wait() not in (0, -signal.SIGKILL):
            raise RuntimeError("the sweep failed before it was killed")
        kills += 1
        kept = jv.open_sweep(broken)
        print(f"kill {kills}: {dict(kept.counts).get('done', 0)} of {kept.cases} cases kept", flush=True)
    last = child(broken)
    last.communicate()
    print(f"killed {kills} times and resumed, bit for bit as undisturbed:", same(whole, broken))
    print("files left of writing that was cut off:", len(list(broken.rglob("*.partial"))))


def watched(told: str):
    """Computation of a chunk by a worker, with a line in a file for each: the process, begin, end, CPU time."""
    real = jaxvib.sweeps.cluster._compute_remotely

    def remote(*given):
        begun, spent = time.time(), time.process_time()
        found = real(*given)
        with open(told, "a") as file:
            file.write(f"{os.getpid()} {begun} {time.time()} {time.process_time() - spent}\n")
        return found

    return remote


def cluster(folder: pathlib.Path, out: pathlib.Path) -> None:
    """Workers beside this process, in turns. On a busy machine the clock tells little: so also how long workers have nothing
    to do between two chunks, and the CPU time of all processes."""
    import threading

    import psutil  # distributed has it

    def busy() -> float:
        each = [psutil.Process(), *psutil.Process().children(recursive=True)]
        return sum(one.cpu_times().user + one.cpu_times().system for one in each)

    size, options, told = 128, dict(chunk=1024), folder / "told"
    here, there, hurt = folder / "here.zarr", folder / "there.zarr", folder / "hurt.zarr"
    own = jaxvib.sweeps.cluster.versions()  # with what watches the workers, this process would have other sources than they
    jaxvib.sweeps.cluster.versions = lambda: own
    jaxvib.sweeps.cluster._compute_remotely, plain = watched(str(told)), jaxvib.sweeps.cluster._compute_remotely
    for turn in range(3):
        for name, store, more in (("in this process", here, {}), ("two workers", there, {"workers": 2})):
            shutil.rmtree(store, ignore_errors=True)
            told.write_text("")
            times: list[tuple[float, float]] = []
            begun = clocks()
            capture(store, size, **options, **more, report=lambda now, t=times: t.append((time.perf_counter(), busy())))
            clock, spent = np.subtract(times[-1], times[5]) / (len(times) - 6)  # by the sixth every worker has its program
            each = f"from chunk to chunk {clock:.3f} s, {spent:.3f} s of CPU time"
            print(f"{turn} {name}: {since(begun)}; {each}; load {os.getloadavg()[0]:.1f}", flush=True)
        rows = np.loadtxt(told)
        for worker in np.unique(rows[:, 0]):
            mine = rows[rows[:, 0] == worker][2:]  # the first is compiled
            gap, computing = np.mean(mine[1:, 1] - mine[:-1, 2]), np.mean(mine[:, 2] - mine[:, 1])
            share = f"{computing:.3f} s a chunk ({np.mean(mine[:, 3]):.3f} s of CPU time), {1e3 * gap:.1f} ms between two"
            print(f"  worker {worker:.0f}: {share}, {100.0 * gap / computing:.1f} %", flush=True)
    jaxvib.sweeps.cluster._compute_remotely = plain
    print("two workers, bit for bit the same:", same(here, there), flush=True)

    def kill_one(now) -> None:
        if now.done >= 4096 and not victims:
            workers = [one for one in psutil.Process().children(recursive=True) if "spawn_main" in " ".join(one.cmdline())]
            victims.append(workers[-1].pid)
            threading.Thread(target=workers[-1].kill).start()

    victims: list[int] = []
    begun = clocks()
    found = capture(hurt, size, **options, workers=2, report=kill_one)
    print(f"a worker killed (process {victims}): {since(begun)}; {found.message}; bit for bit the same: {same(here, hurt)}")


def million(folder: pathlib.Path, out: pathlib.Path) -> None:
    begun = clocks()
    found = light(folder / "million.zarr", 1_000_000)
    print(found.summary(), f"\n{since(begun)}", flush=True)
    code = (
        "import time; t = time.perf_counter()\nimport sys, jaxvib as jv\n"
        "found = jv.open_sweep(sys.argv[1]); found.plot().savefig(sys.argv[2])\nprint(f'{time.perf_counter() - t:.1f} s')"
    )
    figure = str(out / "million.png")
    told = subprocess.run([sys.executable, "-c", code, found.store, figure], capture_output=True, text=True)
    print("opened and plotted in a fresh process:", told.stdout.strip() or told.stderr[-500:])


def memory(folder: pathlib.Path, out: pathlib.Path) -> None:
    code = (
        f"import pathlib, sys; sys.path.insert(0, {str(pathlib.Path(__file__).parent)!r})\nimport sweeps\n"
        "sweeps.light(pathlib.Path(sys.argv[1]), int(sys.argv[2])); print(sweeps.peak())"
    )
    for cases in (10_000, 100_000, 1_000_000):
        store = str(folder / f"{cases}.zarr")
        said = subprocess.run([sys.executable, "-c", code, store, str(cases)], capture_output=True, text=True)
        print(f"{cases} cases: largest memory {said.stdout.strip() or said.stderr[-500:]} MiB", flush=True)


def peak() -> int:
    """Return the largest resident memory of this process, MiB; `ru_maxrss` would include that of its parent."""
    return int(pathlib.Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) // 1024


def main() -> None:
    parts = {"map": captures, "killed": killed, "cluster": cluster, "million": million, "memory": memory}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=list(parts))
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    folder = pathlib.Path(tempfile.mkdtemp())
    try:
        parts[given.part](folder, given.out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
