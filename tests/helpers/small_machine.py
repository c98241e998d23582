"""A machine whose motion is of order 1 in 20 s, and its runs: all of one length and of so many samples, for one program."""

import pathlib
import tempfile

import jax.numpy as jnp
import numpy as np

import jaxvib as jv
from optimize import Quantity

GRAVITY = 9.81


def small_machine(effects=(), drive=None):
    """A machine whose motion is of order 1 in 20 s: three different pendulums shake two platforms hard."""
    machine = jv.two_mass(mass=(2.0, 1.5), stiffness=(3.0, 2.0), damping=(0.1, 0.05), link_stiffness=4.0, link_damping=0.2)
    pendulums = jv.pendulums(count=3, mass=[0.1, 0.12, 0.15], radius=0.5, drag=[0.2, 0.25, 0.3], inertia=[0.001, 0.002, 0.003])
    return jv.Scene(machine, pendulums, drive or jv.ConstantSpeed(3.0), effects)


def small_start():
    return jv.State(
        jnp.asarray([0.05, -0.03]), jnp.asarray([0.1, 0.2]), (jnp.asarray([0.3, -1.0, 2.0]),), (jnp.asarray([1.0, 0.5, -0.5]),)
    )


def small_run(effects=(), **given):
    """20 s of it, 21 samples unless only the window is saved."""
    return jv.simulate(small_machine(effects), 20.0, **{"start": small_start(), "samples": 21, **given})


def heaviness(scene):
    return scene.machine.mass[0] * scene.drive.speed


def small_sweep(scene):
    """A sweep of three cases that is computed at once."""
    store = pathlib.Path(tempfile.mkdtemp()) / "study.zarr"
    return jv.sweep(scene, {"drive.speed": [40.0, 60.0, 80.0]}, [Quantity("heaviness", "kg rad/s", heaviness)], store)


def checked_gradients():
    """A check of gradients as it would come out."""
    shape = np.array([[1.0, 2.0], [1.0, 2.1]])
    found = dict(gradient=shape, error=0.1 * shape, difference=shape[0], noise=1e-9 * shape[0], step=np.array([1e-4, 1e-3]))
    names = dict(numbers=("machine.mass", "loads.drag"), at=np.ones(2), routes=("forward", "reverse"))
    swept = dict(steps=np.array([1e-2, 1e-3, 1e-4]), sweep=np.ones((2, 3)), tolerance=1e-5, left_out=("machine.damping",))
    return jv.GradientCheck(status=jv.GradientStatus.differ, value=3.0, **names, **found, **swept)
