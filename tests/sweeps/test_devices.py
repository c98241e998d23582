"""Work shared by several devices: two that XLA makes of the CPU, in a process of its own."""

import os
import subprocess
import sys

import pytest

CODE = """
import sys
import equinox as eqx, jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxvib as jv
from jaxvib.runtime import parallel
from jaxvib.sweeps.sweep import sweep
from optimize import amplitude

assert len(jax.local_devices()) == 2
scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0), jv.balls(count=2, mass=0.5, radius=0.1, drag=0.5),
                 jv.ConstantSpeed(60.0))
make = lambda n: eqx.tree_at(lambda s: s.drive.speed, scene, n)
used, same_options = set(), parallel._same_options

def watched(function):
    with_options = same_options(function)
    return lambda item, device: (used.add(device), with_options(item, device))[1]

def arrays(name):
    used.clear()
    runs = jv.ensemble(make, np.linspace(40.0, 80.0, 8), 1.0, batch=2)
    first = set(used)
    used.clear()
    axes = {"drive.speed": {"from": 40.0, "to": 80.0, "count": 8}}
    cases = sweep(scene, axes, {"amplitude": amplitude(mode=1, of=1)}, f"{sys.argv[1]}/{name}.zarr", chunk=2)
    found = runs.state.displacement, runs.load_speed, runs.error, cases.data["amplitude"].values
    return first, set(used), list(map(np.asarray, found))

parallel._same_options = watched
*one, alone = arrays("alone")
parallel.shared_devices = jax.local_devices  # as for accelerators
*both, shared = arrays("shared")
assert one == [{None}] * 2 and both == [set(jax.local_devices())] * 2, (one, both)
for a, b in zip(alone, shared, strict=True):
    assert a.size and np.all(np.isfinite(a)), a
    np.testing.assert_array_equal(a, b)
"""


@pytest.mark.slow
def test_two_devices_give_the_results_of_one(tmp_path):
    flags = "--xla_force_host_platform_device_count=2"
    subprocess.run([sys.executable, "-c", CODE, str(tmp_path)], check=True, env=os.environ | {"XLA_FLAGS": flags})
