"""Functional mock-up units: time of the right-hand side in C relative to a native loop, and time to write a unit.

    pip install numba
    python benchmarks/trials/exported_units.py

The right-hand side is that of the published machine with one load. It is evaluated in steps of co-simulation through the
interface of the unit. The native loop is hand-written (`parts/native.py`). Both times are for one evaluation of the equations.
"""

from __future__ import annotations

import ctypes
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import jax

import jaxvib as jv

sys.path.insert(0, str(Path(__file__).parents[1]))

from parts import native
from parts.common import best, flat, machine_line, published, thrown

jv.prepare_cpu()
jax.config.update("jax_enable_x64", True)

STEPS = 20000
NATIVE_STAGES = 12


def unit_seconds(folder: Path) -> float:
    """Time per evaluation of the equations in a unit, s."""
    unit = jv.export_fmu(published(), folder / "machine.fmu")
    zipfile.ZipFile(unit.path).extractall(folder)
    library = ctypes.CDLL(str(next((folder / "binaries").rglob("machine.*"))))
    library.fmi2Instantiate.restype = ctypes.c_void_p
    text = (folder / "modelDescription.xml").read_text()
    token = text.split('guid="')[1].split('"')[0].encode()
    machine = ctypes.c_void_p(library.fmi2Instantiate(b"machine", 1, token, None, None, 0, 0))
    library.fmi2ExitInitializationMode(machine)
    reference = ctypes.c_uint(text[: text.index("</ModelVariables>")].count("<ScalarVariable") - 1)
    step = ctypes.c_double(1e-3)
    assert library.fmi2SetReal(machine, ctypes.byref(reference), ctypes.c_size_t(1), ctypes.byref(step)) == 0
    length = ctypes.c_double(STEPS * step.value)

    def run() -> None:
        assert library.fmi2DoStep(machine, ctypes.c_double(0.0), length, 0) == 0

    return best(run, 20) / (4 * STEPS)


def native_seconds() -> float:
    """Time per evaluation of the equations in the native loop, s."""
    scene, loop = published(), native.single()
    numbers, start = native.numbers(scene), flat(thrown())
    loop(start, 1.0, numbers, 1.0, 5)
    return best(lambda: loop(start, float(scene.drive.speed), numbers, 1000.0, 5000), 20) / (5000 * NATIVE_STAGES)


def main() -> None:
    print(machine_line())
    with tempfile.TemporaryDirectory() as home:
        begin = time.perf_counter()
        unit = jv.export_fmu(published(), Path(home) / "first.fmu")
        first = time.perf_counter() - begin
        begin = time.perf_counter()
        jv.export_fmu(published(), Path(home) / "second.fmu")
        print(f"{unit.statements} statements, written in {first:.2f} s, again in {time.perf_counter() - begin:.2f} s")
        ours, theirs = unit_seconds(Path(home)), native_seconds()
    print(f"right-hand side {1e9 * ours:.0f} ns, native loop {1e9 * theirs:.0f} ns: {ours / theirs:.2f} times")


if __name__ == "__main__":
    main()
