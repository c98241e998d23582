"""Information of the records about the parameters of a scene: covariance, and directions that the records do not determine.

The parameters are compared on a logarithmic scale (parameters of either sign: relative to their first values). A direction is a
combination of relative changes; its standard error is 1/sqrt(eigenvalue) of the information matrix of the scene's parameters,
after all other unknowns (gains, errors of the angle and others) are eliminated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxvib.boundary import with_known_names
from jaxvib.identification.fit import Fitted, polar_unbalances
from jaxvib.identification.problem import Problem

UNDETERMINED = 1.0
"""Standard error of a direction, as a relative change, above which it counts as undetermined. On the logarithmic scale 1 is a
factor of e."""

_UNBOUNDED_ERROR = 1e3
"""Standard error of the logarithm of a parameter above which the records do not bound the parameter, not even from above."""

_SINGLE = 0.99
"""Absolute value of the component of a parameter in a direction (a vector of length 1) above which the direction is that of the
parameter alone."""

_MIN_SHARE = 0.05
"""Absolute value of the component of a parameter in an undetermined direction above which the parameter itself counts as
undetermined."""

_MIN_COMMON_PART = 0.95
"""The direction of the common factor of all masses, stiffnesses, dampings and unbalances is a vector of length 1. If the part
of this vector within the undetermined directions is longer than this number, the factor itself counts as undetermined."""

_ADDED_MASS = ", or record a run with a known mass added"
"""Remedy for an unknown common factor. It does not help for unbalances alone: an added mass leaves their size unknown."""

_ADVICE = f"give one of these parameters as known{_ADDED_MASS}"


@with_known_names
class Direction(NamedTuple):
    """Combination of parameters that the records do not determine. Returned by `identify` in a `MachineFit`.

    **Attributes**: `sentence` that describes the direction; `names` (k,) of the parameters; `weights` (k,): their relative
    changes, a vector of length 1; `error`: standard error along the direction, relative.
    """

    sentence: str
    names: tuple[str, ...]
    weights: tuple[float, ...]
    error: float


class Information(NamedTuple):
    """Information about the parameters of a scene (k,), and about the gains.

    **Attributes**

    - `names` (k,) of the parameters; `values` (k,), SI
    - `logarithmic` (k,): True if the variable of the fit is the logarithm of the parameter; otherwise the variable is the
      parameter divided by its scale
    - `scale` (k,): change of the parameter per unit of this variable
    - `covariance` (k, k) of the variables in the determined directions
    - `undetermined` (k, u): directions that the records do not determine; `errors` (u,): their standard errors
    - `determined` (k,): False for parameters that take part in an undetermined direction
    - `vanished` (k,): True for positive parameters that are not distinguishable from 0, because their standard error is larger
      than their value
    - `by_gain` (k, g): directions that are determined only because the gains of the sensors are known to their `gain_error`;
      `by_gain_errors` (g,): their standard errors
    """

    names: tuple[str, ...]
    values: np.ndarray
    scale: np.ndarray
    logarithmic: np.ndarray
    covariance: np.ndarray
    undetermined: np.ndarray
    errors: np.ndarray
    determined: np.ndarray
    vanished: np.ndarray
    by_gain: np.ndarray
    by_gain_errors: np.ndarray


def information_of(fitted: Fitted) -> Information:
    """Return the information of a fit about the parameters of its scene; see `Information`."""
    problem = fitted.problem
    unknowns, p = problem.unknowns, fitted.x.size
    number_count = len(unknowns.numbers)
    data, prior, sizes = in_polar_unbalances(fitted)
    free_exciters = free_unbalances(problem)
    kept = np.array([*range(number_count), *(p + 2 * k for k in free_exciters)], int)
    names = (*(number.name for number in unknowns.numbers), *(f"exciters[{k}].unbalance" for k in free_exciters))
    values = np.concatenate([np.asarray(unknowns.values(fitted.x)), sizes[free_exciters]])
    logarithmic = np.concatenate([np.asarray(unknowns.positive), np.ones(len(free_exciters), bool)])
    scale = np.concatenate([np.where(unknowns.positive, values[:number_count], unknowns.scale), sizes[free_exciters]])
    prior_of_free_gains = prior.copy()
    gains = np.arange(number_count, number_count + len(unknowns.gains))
    prior_of_free_gains[gains, gains] = 0.0

    information, information_of_free_gains = (eliminate(data + known, kept) for known in (prior, prior_of_free_gains))
    errors, axes = principal_errors(information)
    single = np.abs(axes) > _SINGLE
    error = np.sum(single * errors, axis=1)
    # Unbalances are left out: if the size of an unbalance tends to 0, its angle is unknown, too.
    vanished = logarithmic & (error > UNDETERMINED) & (error < _UNBOUNDED_ERROR) & (np.arange(kept.size) < number_count)
    # Changes of a vanished parameter are divided by ten times its standard error instead of by its value: it then counts as
    # determined.
    factors = np.where(vanished, 10.0 * error, 1.0)
    determined_part = covariance_of(information * np.outer(factors, factors))
    covariance, undetermined = determined_part.covariance, determined_part.undetermined
    loose_errors, loose_axes = principal_errors(information_of_free_gains * np.outer(factors, factors))
    by_gain = loose_axes[:, loose_errors > UNDETERMINED]
    # Directions that are undetermined even with known gains are removed from those that the gains determine.
    by_gain = by_gain - undetermined @ (undetermined.T @ by_gain)
    basis, sizes_of, _ = np.linalg.svd(by_gain, full_matrices=False)
    by_gain = basis[:, : int(np.sum(sizes_of > 0.5))]
    by_gain_errors = np.sqrt(np.einsum("ku,kl,lu->u", by_gain, covariance, by_gain))
    determined_part = determined_part._replace(covariance=covariance * np.outer(factors, factors))
    return Information(names, values, scale, logarithmic, *determined_part, vanished, by_gain, by_gain_errors)


class Covariance(NamedTuple):
    """Covariance of parameters (k,) that are not all determined.

    **Attributes**: `covariance` (k, k) in the determined directions; `undetermined` (k, u): the other directions; `errors`
    (u,): their standard errors; `determined` (k,): False for parameters that take part in an undetermined direction.
    """

    covariance: np.ndarray
    undetermined: np.ndarray
    errors: np.ndarray
    determined: np.ndarray


def covariance_of(information: np.ndarray) -> Covariance:
    """Return the covariance that follows from an information matrix, see `Covariance`."""
    errors, axes = principal_errors(information)
    is_undetermined = errors > UNDETERMINED
    covariance = (axes[:, ~is_undetermined] * errors[~is_undetermined] ** 2) @ axes[:, ~is_undetermined].T
    return Covariance(
        covariance,
        axes[:, is_undetermined],
        errors[is_undetermined],
        ~np.any(np.abs(axes[:, is_undetermined]) > _MIN_SHARE, axis=1),
    )


def combined_information(fitted: Fitted) -> np.ndarray:
    """Return the information about the parameters of a fit, the gains of its sensors, and the angle of the first unbalance.

    The information about the angle is 0 if the rotor's angle is measured from a different zero position in each run.
    """
    problem, p = fitted.problem, fitted.x.size
    data, prior, _ = in_polar_unbalances(fitted)
    number_count, gains = len(problem.unknowns.numbers), len(problem.unknowns.gains)
    kept = [*range(number_count), *(p + 2 * k for k in free_unbalances(problem)), *range(number_count, number_count + gains)]
    if problem.marked:
        return eliminate(data + prior, np.array([*kept, p + 1], int))
    return np.pad(eliminate(data + prior, np.array(kept, int)), (0, 1))


def free_unbalances(problem: Problem) -> list[int]:
    """Return the exciters whose unbalance is unknown or has a known error."""
    return [k for k, known in enumerate(problem.unbalances) if known is None or not known.is_exact]


def in_polar_unbalances(fitted: Fitted) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the information of the data and that of known values, each (p + L, p + L), and the sizes (E,) of the unbalances.

    The unknowns are those of the fit, but each unbalance has the unknowns (logarithm of the size, angle) instead of its
    components (a, b). p is the number of nonlinear unknowns, L the number of linear ones.
    """
    jacobian, sizes = polar_unbalances(fitted.problem, fitted.linear)
    return jacobian.T @ fitted.information @ jacobian, jacobian.T @ fitted.prior @ jacobian, sizes


def eliminate(matrix: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return the information about the unknowns with the indices `kept` if all other unknowns are free."""
    free, size, vectors, values = _free(matrix, kept)
    coupling = (matrix[np.ix_(kept, free)] / size) @ vectors / np.sqrt(values)
    return matrix[np.ix_(kept, kept)] - coupling @ coupling.T


def elimination(matrix: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return L: the changes of all unknowns per change of the unknowns with the indices `kept`, if all other unknowns are free.

    `eliminate` returns L^T F L of the matrix F; to first order its change by dF is L^T dF L.
    """
    free, size, vectors, values = _free(matrix, kept)
    changes = np.zeros((len(matrix), kept.size))
    changes[kept, np.arange(kept.size)] = 1.0
    changes[free] = -((vectors / values) @ vectors.T @ (matrix[np.ix_(free, kept)] / size[:, None])) / size[:, None]
    return changes


def _free(matrix: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the indices (r,) of the unknowns that are not `kept` and about which there is information, their scales (r,), and
    the eigenvectors (r, s) and eigenvalues (s,) > 0 of their scaled information."""
    free = np.setdiff1d(np.arange(len(matrix)), kept)
    free = free[np.diagonal(matrix)[free] > 0.0]
    size = np.sqrt(np.diagonal(matrix)[free])
    values, vectors = np.linalg.eigh(matrix[np.ix_(free, free)] / np.outer(size, size))
    is_determined = values > 1e-12 * np.max(values, initial=0.0)
    return free, size, vectors[:, is_determined], values[is_determined]


def principal_errors(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard errors (k,) of the principal directions, and these directions, the columns (k, k). The direction
    with the smallest error is the last one."""
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    floor = 1e-14 * max(float(values[-1]), 1e-300) if values.size else 0.0
    return 1.0 / np.sqrt(np.maximum(values, floor)), vectors


def directions_of(information: Information) -> tuple[tuple[Direction, ...], tuple[Direction, ...]]:
    """Return the undetermined directions, and the directions that only the gains of the sensors determine, with sentences."""
    undetermined = [
        each.direction._replace(sentence=f"{each.change} changes no reading by more than its noise: {each.advice}")
        for each in _described(information, information.undetermined, information.errors)
    ]
    gains = [
        each.direction._replace(
            sentence=f"{each.subject} is known from the gains of the sensors only, to {100.0 * each.direction.error:.1f} %, "
            f"and an error of a gain leaves no trace in the residuals; calibrate the sensors, or {each.advice_for_gain}"
        )
        for each in _described(information, information.by_gain, information.by_gain_errors)
    ]
    return tuple(undetermined), tuple(gains)


class _Described(NamedTuple):
    """A direction without its sentence, and parts of sentences about it: its `change`, the `subject` of the change, the
    `advice` if it is undetermined, and the `advice_for_gain` if only the gains determine it."""

    direction: Direction
    change: str
    subject: str
    advice: str
    advice_for_gain: str


def _described(information: Information, axes: np.ndarray, errors: np.ndarray) -> list[_Described]:
    names = information.names
    described = []
    common = has_kg(names).astype(float)
    if axes.size and np.sum(common) > 1.0:
        common /= np.linalg.norm(common)
        inside = axes @ (axes.T @ common)
        if np.linalg.norm(inside) > _MIN_COMMON_PART:
            spread = axes * errors
            direction = Direction("", names, tuple(map(float, common)), float(np.linalg.norm((axes.T @ common) * errors)))
            described.append(_common_factor(direction))
            axes = axes - np.outer(common, common @ axes)
            basis, size, _ = np.linalg.svd(axes, full_matrices=False)
            axes = basis[:, size > 0.5]
            errors = np.linalg.norm(axes.T @ spread, axis=1)
    for axis, error in zip(axes.T, errors, strict=True):
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        described.append(_combination(Direction("", names, tuple(map(float, axis)), float(error))))
    return described


def _common_factor(direction: Direction) -> _Described:
    present = {_kind_with_kg(name) for name in direction.names}
    kinds = [kind for kind in _KINDS_WITH_KG.values() if kind in present]
    listed = " and ".join(filter(None, [", ".join(kinds[:-1]), kinds[-1]]))
    advice = _ADVICE if kinds != ["unbalances"] else _ADVICE.removesuffix(_ADDED_MASS)
    return _Described(
        direction, f"multiplying all {listed} by one number", f"the common factor of all {listed}", advice, advice
    )


def _combination(direction: Direction) -> _Described:
    names, axis = direction.names, np.array(direction.weights)
    order = np.argsort(-np.abs(axis))
    largest = [order[0], *(k for k in order[1:] if abs(axis[k]) > 0.2)]
    known = "give one of these parameters as known"
    if len(largest) == 1:
        known, subject = "give it as known", names[order[0]]
        change = f"changing {subject}"
    else:
        parts = ", ".join(f"{names[k]} by {axis[k]:+.2g}" for k in largest) + " (relative to one another)"
        subject, change = f"a change of {parts}", f"changing {parts}"
    remedies = "add a sensor at another place, or record a run through all resonances"
    return _Described(direction, change, subject, f"{known}, {remedies}", known)


_KINDS_WITH_KG = {
    "mass": "masses",
    "inertia": "inertias",
    "stiffness": "stiffnesses",
    "damping": "dampings",
    "drag": "drags",
    "unbalance": "unbalances",
    "torque": "torques",
    "power": "powers",
    "bearing": "frictions of bearings",
}
"""Words in the names of parameters whose unit is proportional to kg (kg, N s/m, kg m and others), and their plurals. The
readings do not change if all these parameters are multiplied by the same factor."""


def has_kg(names: Sequence[str]) -> np.ndarray:
    """Return (k,) True for parameters whose unit is proportional to kg."""
    return np.array([_kind_with_kg(name) is not None for name in names], bool)


def _kind_with_kg(name: str) -> str | None:
    """Return the kind of a parameter whose unit is proportional to kg; None for other parameters."""
    last = name.rpartition(".")[2]
    return next((plural for word, plural in _KINDS_WITH_KG.items() if word in last), None)
