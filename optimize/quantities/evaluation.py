"""Results of a scene from which quantities are computed.

Each result is computed once. The search for a jam can start from the jam of a similar machine.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from functools import cached_property, partial
from typing import Any, Literal, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.equations.linear import JammedModel, LinearModel, jammed_model, linear_model, natural_frequencies
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.motion.run import Run
from jaxvib.motion.simulate import simulate
from jaxvib.runtime.devices import array_module, numpy_if_known
from jaxvib.steady.jams.follow import follow_fold, follow_jam
from jaxvib.steady.jams.jam import Jam, JamModes, jam_modes, require_mode_of
from jaxvib.steady.orbits.describe import Orbit
from jaxvib.steady.orbits.jam_orbit import jam_orbit
from jaxvib.steady.orbits.synchronous import SynchronousOrbit, synchronous_orbit
from jaxvib.steady.outcome import without_numbers
from jaxvib.steady.regimes.synchronous import SynchronousRegime
from jaxvib.steady.regimes.working import working_regime
from jaxvib.units.known import is_known

T = TypeVar("T")

_NO_FOLD = 10.0
"""Rotor speed, in multiples of that of the scene, that is returned for a mode without a fold at its end toward higher rotor
speeds."""

_RUN_UP_SAMPLES = 4000
"""Number of stored states of a run-up."""


class Case(Protocol):
    """Scenes that are derived from the scene of a design: a load case, or samples of tolerances."""

    def scenes(self, scene: Scene) -> Scene:
        """Return the scene in this case; if the case has several scenes, its arrays have a leading axis."""
        ...

    @property
    def has_several(self) -> bool:
        """True if the case has several scenes."""
        ...


Target = tuple[str, int]
"""Jam or fold that is followed. ("jam", mode): the jam of a mode. ("below", mode), ("above", mode): the fold at the end of the
mode with the lower, or the higher, load speed."""

Key = tuple[tuple[Case, ...], Target]
"""A jam or fold that is followed, and its scene. The scene is described by its load cases: the first one is applied to the
scene of the design, and each further one to the resulting scene. Without cases it is the scene of the design itself."""


class TargetRecorder:
    """Recorder of the jams and folds that quantities request. It is used as the argument `near_speeds` of an `Evaluation`, and
    returns the speed 1 rad/s for every key."""

    def __init__(self) -> None:
        self.keys: list[Key] = []

    def __getitem__(self, key: Key) -> Array:
        if key not in self.keys:
            self.keys.append(key)
        return jnp.asarray(1.0)


class Evaluation:
    """Results of one scene; each result is computed when it is first requested.

    **Attributes**

    - `scene`; `is_known`: True if its parameters have values, False if they are traced
    - `near_speeds`: load speeds (rad/s) near which jams and folds are searched for, by `Key`; None to compute the whole branch
    - `path`: the cases that lead to this scene from the scene of the design
    - `speeds`: the load speeds of the jams and folds that were computed, rad/s, by `Key`
    """

    def __init__(
        self,
        scene: Scene,
        near_speeds: Mapping[Key, Array] | TargetRecorder | None = None,
        path: tuple[Case, ...] = (),
        modes: JamModes | None = None,
    ):
        self.scene = scene
        self.is_known = is_known(scene)
        self.near_speeds = near_speeds
        self.path = path
        self.speeds: dict[Key, Array] = {}
        if modes is not None:
            self.modes = modes
        self._jams: dict[Key, Jam] = {}
        self._orbits: dict[int, Orbit] = {}
        self._runs: dict[Hashable, Run] = {}

    @cached_property
    def model(self) -> LinearModel:
        """Linear model of the carrier with its loads."""
        return linear_model(self.scene)

    @cached_property
    def jammed(self) -> JammedModel:
        """Linear model with the quantities that jams of all speeds share."""
        return jammed_model(self.scene)

    @cached_property
    def modes(self) -> JamModes:
        """All jam modes."""
        return jam_modes(self.scene)

    def jam(self, mode: int) -> Jam:
        """Return the jam of the mode with this number, with NaN values if it does not exist."""
        require_mode_of(self.scene, mode)
        key: Key = (self.path, ("jam", mode))
        if key not in self._jams:
            jam = (
                self.modes.select(mode, throw=False)
                if self.near_speeds is None
                else follow_jam(self.jammed, mode, self.near_speeds[key])
            )
            self._jams[key] = jam
            self.speeds[key] = jam.omega
        return self._jams[key]

    def folds(self, mode: int) -> tuple[Array, Array]:
        """Return the rotor speeds, rad/s, of the two folds at the ends of a jam mode: first that with the lower load speed.

        If there is no fold at an end, the value is 0 at the end toward lower rotor speeds, and ten times the rotor speed of the
        scene at the end toward higher rotor speeds.
        """
        rotor_speeds = []
        for side in ("below", "above"):
            key: Key = (self.path, (side, mode))
            near = speed_of_target(self.modes, (side, mode)) if self.near_speeds is None else self.near_speeds[key]
            exists = jnp.isfinite(near)
            omega, speed = follow_fold(self.jammed, jnp.where(exists, near, 1.0))
            self.speeds[key] = jnp.where(exists, omega, near)
            slower = (side == "below") == (mode % 2 == 1)
            rotor_speeds.append(jnp.where(exists, speed, 0.0 if slower else _NO_FOLD * self.scene.drive.speed))
        return rotor_speeds[0], rotor_speeds[1]

    def orbit(self, mode: int) -> Orbit:
        """Return the exact periodic motion of a jam mode, with NaN values if it does not exist."""
        if mode not in self._orbits:
            jam = self.jam(mode)
            if self.near_speeds is None and self.is_known:
                orbit = jam_orbit(self.scene, mode=mode, throw=False)
            else:
                orbit = jam_orbit(self.scene, near=jax.lax.stop_gradient(jam.omega), throw=False)
                is_other_mode = (orbit.slope > 0.0) != (mode % 2 == 1)
                orbit = jax.tree.map(
                    lambda leaf: jnp.where(is_other_mode, jnp.nan, leaf) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf,
                    orbit,
                )
            self._orbits[mode] = orbit
        return self._orbits[mode]

    def jam_run(self, mode: int) -> Run:
        """Integrate the full equations from a jam mode for 60 periods of the lowest natural frequency."""
        until = self._sixty_periods()
        return self._run(("jam", mode), partial(simulate, self.scene, until, start="jam", mode=mode, save="window"))

    @cached_property
    def regime(self) -> SynchronousRegime:
        """Working regime of the exciters.

        **Raises** `ComputationError` if there is no working regime. For a traced scene nothing is raised; the values are NaN.
        """
        return working_regime(self.scene)

    @cached_property
    def synchronous(self) -> SynchronousOrbit:
        """Exact motion near the working regime, with NaN values if it does not exist or is unstable."""
        speed, phases = jax.lax.stop_gradient((self.regime.speed, self.regime.phases))
        orbit = synchronous_orbit(self.scene, speed=speed, phases=phases, throw=False)
        return without_numbers(orbit.stable, orbit)

    def working(self, tier: Literal["leading", "exact", "time"]) -> SynchronousRegime | SynchronousOrbit | Run:
        """Return the working regime of the exciters: averaged, exact, or integrated from the exact motion."""
        if tier == "leading":
            return self.regime
        if tier == "exact":
            return self.synchronous

        def integrate(**options: Any) -> Run:
            start = self.synchronous.at(jnp.zeros_like(self.synchronous.speed))
            return simulate(self.scene, self._sixty_periods(), start=start, save="window", **options)

        return self._run("working", integrate)

    def _sixty_periods(self) -> Array:
        """Return the length of 60 periods of the lowest natural frequency, s; a frequency of 0 counts as the rotor speed."""
        frequencies, speed = map(numpy_if_known, jax.lax.stop_gradient((natural_frequencies(self.scene), self.scene.top_speed)))
        return 60.0 * 2.0 * np.pi / array_module(frequencies).where(frequencies > 0.0, frequencies, speed).min()

    def keep_run(self, motion: int | Literal["working"], run: Run) -> None:
        """Store a run that has settled in a jam mode or in the working regime; quantities then use it in place of a
        new run."""
        self._runs["working" if motion == "working" else ("jam", motion)] = run

    def start_up(self, until: float, spin_up: float | None) -> Run:
        """Integrate the full equations from rest to the time `until`, s; the rotor speed rises during the time `spin_up`, s, or
        as the drives of the scene determine (None)."""
        start = {"start": "rest"} if spin_up is None else {"start": "spin_up", "spin_up": spin_up}
        integrate = partial(simulate, self.scene, until, samples=_RUN_UP_SAMPLES, **start)
        return self._run(("start_up", until, spin_up), integrate)

    def _run(self, key: Hashable, integrate: Callable[..., Run]) -> Run:
        """Return the run with this key, which is integrated once. Its derivatives exist in forward mode only."""
        import diffrax

        if key not in self._runs:
            adjoint = None if self.is_known else diffrax.ForwardMode()
            self._runs[key] = integrate(estimate=False, adjoint=adjoint, throw=False)
        return self._runs[key]

    def in_case(self, case: Case) -> tuple[Scene, tuple[Case, ...]]:
        """Return the scene of a case (several: arrays with a leading axis), and its `path`."""
        return case.scenes(self.scene), (*self.path, case)


def mapped(function: Callable[..., T], *, one_by_one: bool) -> Callable[..., T]:
    """Return a function of one case as a function of many cases, along a leading axis, in a batch or `one_by_one`.

    Functions that integrate the equations of motion are evaluated one by one. In a batch every run would take as many steps as
    the slowest one. Measured for two-mass machines, rotors and plane bodies: the derivatives of a batch of 64 runs take 2.5 to
    5 times as long, and their program takes twice as long to compile.
    """
    return (lambda *cases: jax.lax.map(lambda each: function(*each), cases)) if one_by_one else jax.vmap(function)


def require_foundation(scene: Scene) -> None:
    """**Raises** `InputError` for a machine from matrices whose force on the foundation is unknown."""
    if not scene.machine.has_foundation:
        problem = "is not given, so that the force on the foundation is unknown; give from_matrices(foundation=(T_K, T_C))"
        raise InputError("machine.foundation", problem)


def speed_of_target(modes: JamModes, target: Target) -> Array:
    """Return the load speed of a target, rad/s, read from the jam modes of a scene.

    The value is NaN for a jam that does not exist, and -inf ("below") or inf ("above") for a fold that does not exist.
    """
    kind, mode = target
    omega = modes.select(mode, throw=False).omega
    if kind == "jam":
        return omega
    folds = jnp.where(modes.folds.exists, modes.folds.omega, jnp.nan)
    if kind == "below":
        return jnp.nanmax(jnp.where(folds < omega, folds, jnp.nan), initial=-jnp.inf)
    return jnp.nanmin(jnp.where(folds > omega, folds, jnp.nan), initial=jnp.inf)
