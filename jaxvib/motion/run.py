"""The result of a time integration."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.dynamics import State
from jaxvib.errors import InputError
from jaxvib.machine.files import scene_from_toml, scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import Measured, Trajectory
from jaxvib.motion.analysis.regime import Regime, regime

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure

__all__ = ["Run", "RunStatus"]


_named = eqx.filter_jit(regime)


class RunStatus(eqx.Enumeration):
    """How a run ended; the members are the sentences a user reads."""

    done = "the run reached its end"
    max_steps_reached = "the run did not reach its end in the steps it was allowed"
    not_finite = "the motion grew beyond all bounds"
    no_step = "a step of the method could not be computed: its implicit equations were not solved"
    not_accurate = "the run reached its end, but its estimated error is larger than the accuracy that was asked for"
    no_start = "the state to start from does not exist or is not finite"


class Run(Measured):
    """A run of a scene: what was measured over its last turns (see `Measured`), and the motion itself.

    **Attributes**: `status` a `RunStatus`; `trajectory` evenly spaced states over the whole run, None where only the window
    was asked for; `window` the densely sampled end of the run, over which was measured; `steps` taken and how many of them
    were `rejected`; `error` estimated, NaN where none was asked for, infinite where it cannot be told; `scene` that ran. What
    it cost, the runs with larger steps that were made for its error included: `evaluations` of the vector field (0 where the
    method does not say) and `seconds`, compiling included where the program was new, NaN under a JAX transformation.

    The `error` is that of everything in the window at the end: displacements and velocities relative to the largest, angles
    in rad, speeds of loads relative to the rotor's. It is what is left of the difference to a run with larger steps, of which
    not all is counted on to vanish with smaller ones. A motion that forgets its phase has a large error and may have exact
    amplitudes all the same.
    """

    status: RunStatus
    trajectory: Trajectory | None
    window: Trajectory
    error: Array
    steps: Array
    rejected: Array
    evaluations: Array
    seconds: Array
    scene: Scene

    @property
    def message(self) -> str:
        """How the run ended, a sentence."""
        return RunStatus[self.status]  # pyright: ignore[reportInvalidTypeArguments]

    def summary(self) -> str:
        """What happened, for a person to read; amplitudes zero to peak."""
        error = "error not estimated" if np.isnan(self.error) else f"estimated error {float(self.error):.1e}"
        speeds = ", ".join(f"{float(w):.6g}" for w in self.load_speed)
        state = "settled" if bool(self.settled) else "not settled"
        return "\n".join(
            [
                f"{self.message}: {float(self.window.time[-1]):.6g} s, {int(self.steps)} steps "
                f"({int(self.rejected)} rejected), {state} (drift {float(self.drift):.1e})",
                f"  {error}; {int(self.evaluations)} evaluations, {float(self.seconds):.3g} s",
                f"  loads turn at {float(self.omega):.6g} rad/s (each: {speeds}), "
                f"rotor at {float(self.window.rotor_speed[-1]):.6g} rad/s",
                f"  {self.extent(self.scene)}",
                f"  {self.regime.summary()}",
            ]
        )

    @property
    def regime(self) -> Regime:
        """What kind of motion the run has come to, see `Regime`."""
        return _named(self.scene, self.window)

    def _kept(self) -> Trajectory:
        return self.window if self.trajectory is None else self.trajectory

    def plot(self) -> Figure:
        """Time histories: platforms, load speeds against the rotor's, foundation force; the window if nothing else was kept.

        **Returns** a matplotlib figure.
        """
        from jaxvib.draw.charts import time_histories  # slow to import: only who draws pays

        kept = self._kept()
        return time_histories(
            np.asarray(kept.time),
            np.asarray(kept.state.displacement),
            np.asarray(kept.state.rate[0]),
            np.asarray(kept.foundation_force),
            np.asarray(kept.rotor_speed),
            names=self.scene.machine.structure().coordinates,
            units=self.scene.machine.structure().units,
        )

    def to_xarray(self) -> xarray.Dataset:
        """The kept motion as a labelled dataset, with units as attributes (needs the extra `jaxvib[xarray]`)."""
        try:
            import xarray as xr
        except ImportError as error:
            raise InputError("to_xarray", "needs xarray; install it with: pip install 'jaxvib[xarray]'") from error
        kept = self._kept()
        structure = self.scene.machine.structure()
        loads = range(1, self.scene.loads.count + 1)

        def column(value: Array, dimension: str, unit: str) -> tuple[tuple[str, str], np.ndarray, dict[str, str]]:
            return ("time", dimension), np.asarray(value), {"units": unit}

        return xr.Dataset(
            {
                "displacement": column(kept.state.displacement, "coordinate", " or ".join(dict.fromkeys(structure.units))),
                "velocity": column(
                    kept.state.velocity, "coordinate", " or ".join(f"{u}/s" for u in dict.fromkeys(structure.units))
                ),
                "angle": column(kept.state.angle[0], "load", "rad"),
                "rate": column(kept.state.rate[0], "load", "rad/s"),
                "foundation_force": column(kept.foundation_force, "direction", "N"),
                "rotor_speed": ("time", np.asarray(kept.rotor_speed), {"units": "rad/s"}),
            },
            coords={
                "time": ("time", np.asarray(kept.time), {"units": "s"}),
                "coordinate": list(structure.coordinates),
                "unit": ("coordinate", list(structure.units)),
                "load": list(loads),
                "direction": list(range(1, kept.foundation_force.shape[1] + 1)),
            },
            attrs={
                "status": self.message,
                "omega": float(self.omega),
                "amplitude": np.asarray(self.amplitude).tolist(),
                "foundation_force_amplitude": float(self.foundation_force),
                "error": float(self.error),
                "steps": int(self.steps),
            },
        )

    def save(self, path: str | Path) -> Path:
        """Writes the run, scene included, to a NumPy archive (".npz"); `Run.load` reads it back bit for bit.

        **Returns** the path written to.
        """
        arrays = {f"leaf{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(eqx.filter(self, eqx.is_array)))}
        path = Path(path)
        path = path if path.suffix == ".npz" else path.with_name(path.name + ".npz")
        arrays |= {"scene": np.asarray(scene_to_toml(self.scene)), "kept_all": np.asarray(self.trajectory is not None)}
        np.savez(path, allow_pickle=False, **arrays)
        return path

    @classmethod
    def load(cls, path: str | Path) -> Run:
        """Reads a run written by `save`.

        **Raises** `InputError` for a file that is missing or was not written by `save`.
        """
        try:
            with np.load(path, allow_pickle=False) as archive:
                scene = scene_from_toml(str(archive["scene"]))
                kept_all = bool(archive["kept_all"])
                leaves = [jnp.asarray(archive[f"leaf{i}"]) for i in range(len(archive.files) - 2)]
                zero = jnp.zeros(())
                rotor = None if scene.drive.ideal else (zero, zero)
                motion = Trajectory(zero, State(zero, zero, (zero,), (zero,), rotor), zero, zero, zero)
                kept = motion if kept_all else None
                shape = cls(zero, zero, zero, zero, zero, RunStatus.done, kept, motion, zero, zero, zero, zero, zero, scene)
                dynamic, static = eqx.partition(shape, eqx.is_array)
                return eqx.combine(jax.tree.unflatten(jax.tree.structure(dynamic), leaves), static)
        except FileNotFoundError as error:
            raise InputError("path", f"is {str(path)!r}; there is no such file") from error
        except (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
            raise InputError("path", f"is {str(path)!r}; it is no run written by Run.save") from error
