"""Comparison of derivatives of any quantity of a scene with finite differences of known error."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxvib.boundary import call_user, is_real, validated, with_known_names
from jaxvib.display import Axes, Drawn
from jaxvib.errors import ComputationError, InputError, quoted
from jaxvib.machine.numbers.named import NamedNumber, find_number, numbers_of, put_numbers
from jaxvib.machine.scene import Scene
from jaxvib.machine.validation import require_double
from jaxvib.results.fields import in_unit
from jaxvib.results.result import Result
from jaxvib.results.status import member

_STEP_RATIO = math.sqrt(10.0)
_DIFFERENCE_STEPS = tuple(float(h) for h in np.logspace(-2.0, -7.0, 11))
"""Relative steps of the finite differences; each is `_STEP_RATIO` times the next."""

_SMALL_DERIVATIVE_SHARE = 1e-3
"""Smallest scale for the relative error of a derivative, as a share of the largest derivative."""

_NOISE_FACTOR = 3.0
"""A deviation below this factor times the error of the finite differences counts as noise."""

_MIN_LARGE_CHANGE, _MAX_ROUNDING_CHANGE = 1e-2, 1e4 * float(np.finfo(float).eps)
"""Share of the largest change above which the change at a small step counts as large; share of the quantity below which a
change counts as rounding."""


class GradientStatus(eqx.Enumeration):
    """Outcomes of a check. The value of each member is the message shown to the user."""

    agree = "every derivative agrees with finite differences"
    differ = "derivatives differ from finite differences by more than the tolerance plus the error of the differences"
    noisy = "no derivative differs, but finite differences are too noisy for the requested tolerance"
    not_finite = "a derivative, or the quantity near the point, is not a finite number"
    chaotic = (
        "the quantity changes by the same amount for any small change of a parameter: nearby motions "
        "diverge, and derivatives are meaningless"
    )


@with_known_names
class ImplicitRoute(NamedTuple):
    """Quantity that is computed from the solution of an equation.

    `solution(scene)` returns x, an array (n,) or a scalar; `residual(scene, x)` is 0 at the solution and has the shape of x;
    `read(scene, x)` returns the quantity. By the implicit function theorem, the derivative of the quantity is
    d read/dp - (d read/dx) (d residual/dx)^-1 (d residual/dp).

    >>> import jax.numpy as jnp, jaxvib as jv
    >>> def stiffness_per_mass(scene):
    ...     return scene.machine.stiffness[0] / (scene.machine.mass[0] + scene.loads.mass)
    >>> route = jv.ImplicitRoute(
    ...     solution=lambda scene: jnp.sqrt(stiffness_per_mass(scene)),
    ...     residual=lambda scene, x: x**2 - stiffness_per_mass(scene),
    ...     read=lambda scene, x: x / (2.0 * jnp.pi),           # natural frequency in Hz
    ... )
    >>> scene = jv.Scene(jv.one_mass(mass=49.5, stiffness=5e3, damping=30.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
    >>> round(float(route.read(scene, route.solution(scene))), 3)
    1.592
    """

    solution: Callable[[Scene], Array]
    residual: Callable[[Scene, Array], Array]
    read: Callable[[Scene, Array], Array]


class GradientCheck(Result):
    """Comparison of derivatives of a quantity q with respect to parameters p of a scene with finite differences.

    Returned by `check_gradients`. A route is a method of differentiation: forward mode, reverse mode, or implicit.

    All derivatives are p dq/dp, the change per relative change of the parameter, in the unit of the quantity. For a parameter
    that is 0, p is its typical size (1 rad for an angle, 0.1 m for a position).

    **Attributes** (n parameters, r routes, k steps)

    - `value` of the quantity
    - `numbers` (n,): names of the parameters, and `at` (n,): their values in SI
    - `routes` (r,): names of the routes
    - `gradient` (r, n): derivatives by each route
    - `difference` (n,): derivatives by finite differences; `noise` (n,): their possible error; `step` (n,): their best relative
      step
    - `error` (r, n): relative deviation of each route from the finite differences
    - `steps` (k,): all relative steps; `sweep` (n, k): the central differences with each step
    - `tolerance` of the check
    - `left_out`: parameters too close to a bound for a step
    """

    status: GradientStatus
    value: float = eqx.field(metadata=in_unit(""))
    numbers: tuple[str, ...]
    at: np.ndarray = eqx.field(metadata=in_unit("SI", "number"))
    routes: tuple[str, ...]
    gradient: np.ndarray = eqx.field(metadata=in_unit("", "route", "number"))
    difference: np.ndarray = eqx.field(metadata=in_unit("", "number"))
    noise: np.ndarray = eqx.field(metadata=in_unit("", "number"))
    step: np.ndarray = eqx.field(metadata=in_unit("", "number"))
    error: np.ndarray = eqx.field(metadata=in_unit("", "route", "number"))
    steps: np.ndarray = eqx.field(metadata=in_unit("", "step"))
    sweep: np.ndarray = eqx.field(metadata=in_unit("", "number", "step"))
    tolerance: float = eqx.field(metadata=in_unit(""))
    left_out: tuple[str, ...] = ()

    def summary(self) -> str:
        """Return a line of text for each parameter, the worst first."""
        scale = _scale(self.difference)
        with np.errstate(invalid="ignore"):
            worst = np.max(np.where(np.isfinite(self.error), self.error, np.inf), axis=0)
        lines = [f"{self.message} (relative tolerance {self.tolerance:.0e}); numbers are p dq/dp, p: parameter, q: quantity"]
        for i in np.argsort(-worst):
            deviations = ", ".join(f"{route} differs by {self.error[k, i]:.1e}" for k, route in enumerate(self.routes))
            floor = f"finite differences accurate to {self.noise[i] / scale[i]:.1e} at a step of {self.step[i]:.1e}"
            lines.append(f"  {self.numbers[i]}: {self.difference[i]:.9g}; {deviations}; {floor}")
        if self.left_out:
            lines.append(f"  left out, at a bound: {', '.join(self.left_out)}")
        return "\n".join(lines)

    def require(self) -> GradientCheck:
        """Return the check itself if every derivative agrees.

        **Raises** `ComputationError` with the summary otherwise: `differ`, `noisy`, `not_finite`, `chaotic`.
        """
        if not bool(self.status == GradientStatus.agree):
            raise ComputationError(self.status_name, self.summary())
        return self

    @validated
    def plot(self, *, ax: Axes | None = None) -> Drawn:
        """Plot the deviation of the central differences from the first route over their step, with a line for each parameter.

        The best steps are marked.
        """
        from jaxvib.draw.comparison import steps_chart  # slow import

        off = np.abs(self.sweep - self.gradient[0][:, None]) / _scale(self.difference)[:, None]
        best = np.abs(self.difference - self.gradient[0]) / _scale(self.difference)
        return steps_chart(self.steps, off, self.step, best, self.tolerance, names=self.numbers, route=self.routes[0], ax=ax)


@validated
def check_gradients(
    scene: Scene,
    quantity: Callable[[Scene], ArrayLike],
    *,
    free: Sequence[str] | None = None,
    routes: Sequence[str] | None = None,
    implicit: ImplicitRoute | None = None,
    tolerance: float = 1e-5,
) -> GradientCheck:
    """Compare the derivatives of a quantity of a scene, by each route, with finite differences.

    Each parameter p of the scene is changed by relative steps h from 1e-2 to 1e-7. The central differences D are extrapolated
    once, which gives E:

        D(h) = (q(p + h p) - q(p - h p)) / (2 h),      E(h) = D(h/r) + (D(h/r) - D(h)) / (r^2 - 1),      r = sqrt 10

    - The best step is the step h for which E(h) agrees best with E at the next larger and at the next smaller step. The larger
      of these two differences is the possible error of E, called noise. At large steps it is caused by truncation, at small
      steps by rounding (at least eps |q|/h) and by the tolerance of the quantity itself
    - A derivative differs if its distance from E is more than `tolerance` plus three times the noise
    - The status is `chaotic`, even if the routes agree, if two conditions are met: steps of 1e-5 to 1e-7 change the quantity by
      more than a hundredth of the largest change, and a derivative predicts such a change for the smallest step. Disturbances
      have then grown by about 1e5. `growth` gives the time after which this happens

    **Arguments**

    - `scene` in double precision
    - `quantity`: a function of a `Scene` that returns one number, such as
      `lambda s: jv.jam_modes(s).select(3).foundation_force`
    - `free`: names of parameters or arrays, such as "machine.stiffness", "loads.drag" or "effects.stop[0].gap"; all entries of
      an array are checked; default: all parameters of the scene; typical: 5 to 20. The steps of a parameter that is 0 are
      relative to its typical size. A parameter at a bound, such as a damping of 0, is left out. Each parameter needs 22
      evaluations
    - `routes`: "forward" and "reverse" mode of JAX; default: those that the quantity supports (`simulate` supports reverse mode
      by default, and forward mode with `diffrax.ForwardMode()`)
    - `implicit`: an additional route for a quantity that is computed from the solution of an equation, see `ImplicitRoute`
    - `tolerance` of each derivative, relative to the derivative itself, or to a thousandth of the largest derivative (as
      p dq/dp) if that is more; typical: 1e-4 to 1e-6 (default 1e-5)

    **Returns** `GradientCheck`; its method `require()` raises an error if a derivative differs. **Raises** `InputError` for a
    scene in single precision, a quantity that is not a real scalar, and unknown names and routes.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    ...                  jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))
    >>> check = jv.check_gradients(scene, lambda s: jv.natural_frequencies(s)[0], free=("machine.stiffness", "machine.mass"))
    >>> check.require().status_name, bool(check.noise[0] < 1e-7 * abs(check.difference[0]))
    ('agree', True)

    Source: Ridders 1982, for the extrapolation and its error.
    """
    scene = require_double(scene, "a comparison with differences")
    requested = tuple(_MODES) if routes is None else routes
    unknown = [route for route in requested if route not in _MODES]
    if unknown or not (requested or implicit):
        raise InputError("routes", f"are {quoted(list(requested))}; name some of {', '.join(_MODES)}")
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)) or not 0.0 < tolerance < 1.0:
        raise InputError("tolerance", f"is {quoted(tolerance)}; it must be a number between 0 and 1, such as 1e-5")
    numbers, scales, left_out = _changeable_parameters(scene, free)
    at = np.asarray([float(parameter.read(scene)[0]) for parameter in numbers])

    def put(shares: Array) -> Scene:
        return put_numbers(scene, numbers, at + shares * scales)

    def quantity_at(shares: Array) -> Array:
        """Return the quantity with each parameter changed by `shares` (n,) of its size."""
        returned = call_user(quantity, "quantity", put(shares))
        if not is_real(returned):
            raise InputError("quantity", f"gives {quoted(returned)}; it must give one real number")
        return jnp.asarray(returned)

    no_change = jnp.zeros(len(numbers))
    value = quantity_at(no_change)
    if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise InputError("quantity", f"gives {value.dtype} of shape {value.shape}; it must give one real number")
    gradient = _gradients(quantity_at, no_change, requested, only_supported=routes is None)
    if implicit is not None:
        gradient["implicit"] = np.asarray(_implicit(implicit, put, no_change), float)
    sweep = np.asarray([[_central_difference(quantity_at, at.size, i, h) for h in _DIFFERENCE_STEPS] for i in range(at.size)])
    difference, noise, best = (np.asarray(x) for x in zip(*(_extrapolate(row, float(value)) for row in sweep), strict=True))
    scale, by_route = _scale(difference), np.stack(list(gradient.values()))
    deviation = np.abs(by_route - difference)
    is_chaotic = any(_is_chaotic(row, slopes, float(value)) for row, slopes in zip(sweep, by_route.T, strict=True))
    return GradientCheck(
        status=member(GradientStatus, "chaotic" if is_chaotic else _compare_derivatives(deviation, noise, scale, tolerance)),
        value=float(value),
        numbers=tuple(parameter.name for parameter in numbers),
        at=at,
        routes=tuple(gradient),
        gradient=by_route,
        difference=difference,
        noise=noise,
        step=best,
        error=deviation / scale,
        steps=np.asarray(_DIFFERENCE_STEPS),
        sweep=sweep,
        tolerance=float(tolerance),
        left_out=left_out,
    )


def _gradients(
    quantity_at: Callable[[Array], Array], at: Array, routes: Sequence[str], *, only_supported: bool
) -> dict[str, np.ndarray]:
    """Return the derivatives (n,) by each route. If `only_supported` is True, a mode that the runs in the quantity do not
    support is left out; otherwise it raises an error."""
    gradients: dict[str, np.ndarray] = {}
    for route in routes:
        try:
            gradients[route] = np.asarray(_MODES[route](quantity_at)(at), float)
        except InputError as error:
            if not only_supported or error.field != "adjoint":
                raise
    return gradients


_MODES: dict[str, Callable[[Callable[[Array], Array]], Callable[[Array], Array]]] = {"forward": jax.jacfwd, "reverse": jax.grad}


def _changeable_parameters(scene: Scene, free: Sequence[str] | None) -> tuple[list[NamedNumber], np.ndarray, tuple[str, ...]]:
    """Return the checked parameters, the sizes to which their steps are relative, and the names of parameters at a bound."""
    parameters, scales, left_out = [], [], []
    for name in numbers_of(scene) if free is None else free:
        for parameter in find_number(scene, name, "free").single(scene):
            value = float(parameter.read(scene)[0])
            scale = value or parameter.spec.typical or 0.0
            ends = value + _DIFFERENCE_STEPS[0] * scale * np.asarray([-1.0, 1.0])
            if scale and np.all(parameter.spec.bounds.allow(ends)):
                parameters.append(parameter)
                scales.append(scale)
            else:
                left_out.append(parameter.name)
    if not parameters:
        raise InputError(
            "free", "contains no parameter that can change in both directions; name parameters that are not at their bounds"
        )
    return parameters, np.asarray(scales), tuple(left_out)


def _central_difference(quantity_at: Callable[[Array], Array], n: int, i: int, step: float) -> float:
    move = jnp.asarray(np.eye(n)[i] * step)
    return (float(quantity_at(move)) - float(quantity_at(-move))) / (2.0 * step)


def _extrapolate(central: np.ndarray, value: float) -> tuple[float, float, float]:
    """Return the derivative from central differences (k,) with decreasing steps, its possible error, and the best step."""
    extrapolated = central[1:] + (central[1:] - central[:-1]) / (_STEP_RATIO**2 - 1.0)
    changes = np.abs(np.diff(extrapolated))
    rounding = np.finfo(float).eps * abs(value) / np.asarray(_DIFFERENCE_STEPS[2:-1])
    noise = np.maximum(np.maximum(changes[:-1], changes[1:]), rounding)
    # Steps below the resolution of the quantity give differences that agree with each other, but not with those of larger
    # steps.
    inner = extrapolated[1:-1]
    for k in range(1, noise.size):
        with np.errstate(invalid="ignore"):
            if np.any(np.abs(inner[k] - inner[:k]) > noise[:k] + noise[k]):
                noise[k] = math.nan
    if not np.any(np.isfinite(noise)):
        return math.nan, math.nan, math.nan
    k = int(np.nanargmin(noise))
    return float(inner[k]), float(noise[k]), _DIFFERENCE_STEPS[k + 1]


def _is_chaotic(central: np.ndarray, slopes: np.ndarray, value: float) -> bool:
    """Return True if small steps change the quantity about as much as large steps, and a derivative predicts such a change.

    **Arguments**: `central` (k,): central differences for all steps; `slopes` (r,): derivatives by each route.

    Noise also causes changes at small steps, but not large derivatives; a wrong derivative does not cause changes of the
    quantity.
    """
    changes = 2.0 * np.abs(central) * np.asarray(_DIFFERENCE_STEPS)
    largest, typical_small = float(np.max(changes)), float(np.median(changes[-5:]))
    predicted = np.abs(slopes) * 2.0 * _DIFFERENCE_STEPS[-1]
    return typical_small > max(_MIN_LARGE_CHANGE * largest, _MAX_ROUNDING_CHANGE * abs(value)) and bool(
        np.any(predicted > _MIN_LARGE_CHANGE * largest)
    )


def _scale(difference: np.ndarray) -> np.ndarray:
    size = np.abs(difference)
    largest = np.max(size[np.isfinite(size)], initial=0.0)
    return np.maximum(size, _SMALL_DERIVATIVE_SHARE * largest if largest > 0.0 else np.finfo(float).tiny)


def _compare_derivatives(deviation: np.ndarray, noise: np.ndarray, scale: np.ndarray, tolerance: float) -> str:
    if not (np.all(np.isfinite(deviation)) and np.all(np.isfinite(noise))):
        return "not_finite"
    if np.any(deviation > tolerance * scale + _NOISE_FACTOR * noise):
        return "differ"
    return "noisy" if np.any(_NOISE_FACTOR * noise > tolerance * scale) else "agree"


def _implicit(route: ImplicitRoute, put: Callable[[Array], Scene], no_change: Array) -> Array:
    solved = jnp.asarray(route.solution(put(no_change)))
    x, shape = jnp.atleast_1d(solved), solved.shape

    def residual(p: Array, x: Array) -> Array:
        return jnp.atleast_1d(route.residual(put(p), x.reshape(shape)))

    def read(p: Array, x: Array) -> Array:
        return route.read(put(p), x.reshape(shape))

    inner = jnp.linalg.solve(jax.jacfwd(residual, 1)(no_change, x), jax.jacfwd(residual)(no_change, x))
    return jax.grad(read)(no_change, x) - jax.grad(read, 1)(no_change, x) @ inner
