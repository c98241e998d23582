"""Branch diagram: load speeds of jams as a function of the rotor speed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, overload

import equinox as eqx
import numpy as np
from jax import Array

from jaxvib.boundary import validated
from jaxvib.display import Drawn, Onto, SpeedUnit
from jaxvib.equations.linear import jammed_loads, jammed_model, require_drag
from jaxvib.errors import InputError
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import SCENE
from jaxvib.machine.validation import validate_scene
from jaxvib.results.fields import in_unit, part
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.branch_plot import branch_summary, plot_branch
from jaxvib.steady.jams.folds import Folds, grid_near_poles, resampled_grid
from jaxvib.steady.jams.jam import STABILITY_CRITERION, STABILITY_OF_FREE_LOADS, AbstractJam, Jam, branch_points
from jaxvib.steady.jams.phases import growth_of_free_loads
from jaxvib.steady.outcome import outcome
from jaxvib.units import Number, count, number

if TYPE_CHECKING:
    from jaxvib.steady.orbits.diagram import ExactBranches


class Branches(AbstractJam):
    """Branch diagram: the arrays of `AbstractJam` along the load speed Omega, ascending, with a leading axis over the points.

    Returned by `branches`.

    **Additional attributes**: `resonances` (nd,), rad/s, the `folds` of the branch, and the `scene`.
    """

    outer_axes = ("point",)

    resonances: Array = eqx.field(metadata=in_unit("rad/s", "resonance"))
    folds: Folds = eqx.field(metadata=part(prefix="fold_"))
    scene: Scene = eqx.field(metadata=SCENE)

    def summary(self) -> str:
        """Return the ranges of the branch, its resonances and its folds as text."""
        folds = zip(
            *(np.asarray(x)[np.asarray(self.folds.exists)] for x in (self.folds.omega, self.folds.rotor_speed)), strict=True
        )
        return branch_summary(self, [("fold", w, n) for w, n in folds], STABILITY_CRITERION)

    @validated
    def plot(
        self,
        *,
        unit: SpeedUnit | None = None,
        most: float | None = None,
        show: Sequence[str] = ("speed", "amplitude", "force"),
        linear: bool = False,
        ax: Onto = None,
    ) -> Drawn:
        """Plot load speed, amplitudes (zero to peak) and foundation force over the rotor speed.

        Stable jams are solid lines, unstable ones dashed lines. As in the table of `jaxvib modes`, a jam is unstable if its
        loads leave it when each is free to move separately; balls count as points (not computed for loads with dry friction).
        Jams at the scene's rotor speed are marked with the numbers of their modes.

        **Arguments**

        - `unit` of the speeds on the axes, "rad/s", "rpm" or "Hz"
        - `most`: the greatest rotor speed shown, rad/s; default: 4/3 of the scene's rotor speed
        - `show`: names of the panels, such as `("force",)`
        - `linear`: True for linear axes of amplitudes and force; default: logarithmic ones
        - `ax`: axes to draw onto, as many as there are panels

        **Raises** `InputError` for another unit, panel or number of axes.
        """
        folds = self.folds
        existing = np.flatnonzero(np.asarray(folds.exists)).tolist()
        marks = [("fold", float(folds.omega[k]), float(folds.rotor_speed[k])) for k in existing]
        stricter, text = self.with_free_loads()
        return plot_branch(
            stricter, marks, unit, most, text, show, linear, ax, np.asarray(self.mode), np.asarray(self.resonances)
        )

    def with_free_loads(self, stride: int = 1) -> tuple[Branches, str]:
        """Return the branches with `stable` for loads that are free to move separately, and the name of the criterion.

        If this stability is unknown, `stable` does not change. **Arguments**: `stride`: the growth of disturbances is computed
        at every `stride`-th point that is stable by slope; each other point takes the growth of the nearest of these points.
        """
        stable = np.array(self.stable)
        points = np.flatnonzero(stable)
        if not points.size:
            return self, STABILITY_CRITERION
        # A fixed number of points, so that the program is not compiled for each branch.
        chosen = points[::stride]
        padded = np.resize(chosen, -(-stable.size // stride))
        growth = growth_of_free_loads(self.scene, self.omega[padded], self.rotor_speed[padded])
        nearest = np.searchsorted((chosen[1:] + chosen[:-1]) / 2.0, points)
        stable[points] &= ~(growth[nearest] > 0.0)
        text = STABILITY_CRITERION if np.all(np.isnan(growth)) else STABILITY_OF_FREE_LOADS
        return eqx.tree_at(lambda branch: branch.stable, self, stable), text


@overload
def branches(scene: Scene, *, exact: Literal[False] = False, points: int = 2000, most: Number | None = None) -> Branches: ...


@overload
def branches(
    scene: Scene,
    *,
    exact: Literal[True],
    points: int = 2000,
    most: Number | None = None,
    least: Number | None = None,
    accuracy: float | None = None,
) -> ExactBranches: ...


@validated
def branches(
    scene: Scene,
    *,
    exact: bool = False,
    points: int = 2000,
    most: Number | None = None,
    least: Number | None = None,
    accuracy: float | None = None,
) -> Branches | ExactBranches:
    """Return the branch n(Omega) of jams of coincident loads with all its folds, for light loads or, with `exact`, for loads of
    any mass.

        n(Omega) = Omega + (mean braking torque of the vibration on the loads) / sum b_W R^2      (light loads, no dry friction)

    n is the rotor speed, Omega the load speed, and b_W and R are the drag and the radius of a load. For light loads n(Omega) is
    an explicit function. Every point, even of the exact branch, is computed separately, without
    continuation from a neighbouring point. Therefore no part of the branch is missed.

    **Arguments**

    - `scene`; its rotor speed only determines the defaults of `most` and `least`
    - `points` along Omega, denser near the resonances, at least 2; typical: 200 to 2000 (the default). The time is
      proportional to this number
    - `most`: the greatest load speed, rad/s or text; default: 4/3 of the scene's rotor speed
    - `exact`: True for the periodic motions of the full equations in place of their limit for light loads, with Floquet
      multipliers and all special points
    - `least`: the lowest load speed, with `exact`; default: a fifth of the lowest resonance, or a fifth of the rotor speed if
      the rotor speed is below this resonance
    - `accuracy` of the rotor speeds, relative, with `exact`; typical: 1e-4 to 1e-8 (the default; in single precision 1e-3)

    **Returns** `Branches`, or `ExactBranches` if `exact`.

    **Raises** `InputError` for

    - scenes that `jam_modes` does not accept; `exact` accepts machines whose coordinates couple through the rotor speed, but no
      imbalance
    - fewer than 2 points, and a speed that is not positive
    - an accuracy that the precision does not allow
    - `least` or `accuracy` without `exact`

    >>> import jaxvib as jv
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> diagram = jv.branches(form.scene())
    >>> [round(float(w), 4) for w in diagram.folds.omega]
    [0.3339, 0.3806, 1.0015, 1.2154]
    >>> [round(float(n), 4) for n in diagram.folds.rotor_speed]
    [0.7978, 0.4141, 5.1829, 1.3932]

    Source: the antiphase paper, equations (35)-(39), numbers (41), (42).
    """
    scene = validate_scene(scene)
    if exact:
        from jaxvib.steady.orbits.diagram import exact_branches  # imports the time integrator, which only exact branches need

        return exact_branches(scene, points=points, least=least, most=most, accuracy=accuracy)
    if least is not None:
        raise InputError("least", "is only for exact=True; leave it out, because branches of light loads begin near speed 0")
    if accuracy is not None:
        raise InputError("accuracy", "is only for exact=True; leave it out, because branches of light loads are explicit")
    require_drag(jammed_loads(scene))
    count(points, "points", low=2, each=1e3)
    top = scene.drive.speed * 4.0 / 3.0 if most is None else number(most, "rad/s", "most", low=0.0, open_low=True)
    per_side = max(2, math.ceil(points / (2 * scene.machine.structure().mass.shape[0])))
    return outcome(_branches(scene, top, points, per_side), scene)


@cached
def _branches(scene: Scene, top: Array, points: int, per_side: int) -> Branches:
    model = jammed_model(scene).decomposed()
    grid, resonances = grid_near_poles(model, per_side, top)
    jams, folds = branch_points(model, resampled_grid(grid, points, top))
    fields = {name: getattr(jams, name) for name in Jam.__dataclass_fields__}
    return Branches(**fields, resonances=resonances, folds=folds, scene=scene)
