"""Machines from matrices of other tools, such as finite-element models of rotors and frames, reduced to their lowest modes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import is_real, with_known_names
from jaxvib.errors import InputError, quoted
from jaxvib.machine.carrier import Carrier, Machine, Mount, Place, read_number_of_place
from jaxvib.machine.numbers import unit
from jaxvib.numerics.linalg import hermitian_modes, relative_to
from jaxvib.units import count
from jaxvib.units.known import require_known, when_known

_MAX_ASYMMETRY = 1e-9
"""Largest asymmetry of a matrix, relative to its largest entry, in double precision."""

_EQUAL_SQUARES = 1e-6
"""Largest relative difference of squared natural frequencies that count as equal, in addition to rounding."""

_REDUCTION_ERROR = 1e-6
"""Largest error of the eigenvalues of a reduced matrix, relative to its largest entry: rounding at omitted high frequencies."""


class MatrixMachine(Machine):
    """Linear structure from matrices, in modal coordinates if it was reduced; `from_matrices` returns it.

    **Attributes** (nd coordinates)

    - `mass`, `damping`, `stiffness` and `gyroscopic` (or None), (nd, nd)
    - `places_rows` (number of places, directions of a place, nd): displacement of each place = rows times q, see `Mount`
    - `foundation` (2, nb, nd): stiffness and damping of the force on the foundation in its nb directions; None if unknown
    """

    mass: Array = eqx.field(metadata=unit("", words="mass matrix"))
    damping: Array = eqx.field(metadata=unit("", words="damping matrix"))
    stiffness: Array = eqx.field(metadata=unit("", words="stiffness matrix"))
    gyroscopic: Array | None = eqx.field(metadata=unit("", words="gyroscopic matrix"))
    places_rows: Array = eqx.field(metadata=unit("", words="rows of the places"))
    foundation: Array | None = eqx.field(metadata=unit("", words="rows of the force on the foundation"))
    kind: str = eqx.field(static=True)
    places = "number"

    def carrier(self) -> Carrier:
        """Return the matrices."""
        names = tuple(f"q{k + 1}" for k in range(self.mass.shape[0]))
        force = jnp.zeros((2, 1, len(names)), self.mass.dtype) if self.foundation is None else self.foundation
        return Carrier(self.mass, self.damping, self.stiffness, force[0], force[1], names)

    @property
    def has_foundation(self) -> bool:
        """True if the rows of the force on the foundation are given."""
        return self.foundation is not None

    def mount(self, at: Place = None) -> Mount:
        """Return the mount of an exciter at the place with the number `at`."""
        rows = self._all_rows(at, "at")
        axes = (1,) if rows.shape[0] == 1 else (0, 1)
        turn = rows[2] if rows.shape[0] == 3 else None
        return Mount(rows=(rows[: len(axes)],), axes=axes, gyroscopic=self.gyroscopic, turn=turn)

    def rows_at(self, place: Place, name: str = "place") -> Array:
        """Return the matrix that gives the displacement of the place with this number, from 1; None is the first place."""
        return self._all_rows(place, name)[:2]

    def require_valid(self) -> None:
        """**Raises** `InputError` for arrays whose shapes do not fit, and for an indefinite mass or stiffness matrix. Only the
        symmetric part is checked, because a sweep or a design may change one of two symmetric entries without the other."""
        size, rows = self.places_rows.shape[-1], self.foundation
        for name in ("mass", "damping", "stiffness", "gyroscopic"):
            if (matrix := getattr(self, name)) is not None and matrix.shape != (size, size):
                raise InputError(f"machine.{name}", f"has the shape {matrix.shape}; {size} x {size} is needed")
        if self.places_rows.ndim != 3 or (rows is not None and (rows.ndim != 3 or rows.shape[-1] != size)):
            raise InputError("machine", "has places or a foundation of another shape; create it anew by from_matrices")

        def check(mass: np.ndarray | float, stiffness: np.ndarray | float) -> None:
            for name, matrix in (("mass", np.atleast_2d(mass)), ("stiffness", np.atleast_2d(stiffness))):
                # In single precision, rounding can make the smallest eigenvalue of a positive definite matrix negative.
                positive = name == "mass" and matrix.dtype == np.float64
                whole = (matrix + matrix.T) / 2.0
                require_definite(whole, f"machine.{name}", positive=positive, tolerance=_REDUCTION_ERROR)

        when_known(check, self.mass, self.stiffness)

    def _all_rows(self, place: Place, name: str) -> Array:
        last = self.places_rows.shape[0]
        return self.places_rows[read_number_of_place(place, f"give the number of a place, 1 to {last}", last, name) - 1]


@with_known_names
def from_matrices(
    mass: Any,
    damping: Any,
    stiffness: Any,
    gyroscopic: Any = None,
    *,
    places: Sequence[Any],
    foundation: Any = None,
    reduce: int | None = 12,
) -> MatrixMachine:
    """Return a machine with the matrices of any linear model, such as a finite-element model of a flexible rotor.

        M q'' + (C + n G) q' + K q = forces,        q = Phi r,    K Phi = M Phi diag(w^2),    Phi^T M Phi = m I

    A model with more than `reduce` coordinates is reduced to its lowest real normal modes, which are computed without damping
    and rotation. The coordinates of the machine are then the modal amplitudes r, and results for coordinates are values of r.
    All modes have the same modal mass m, with which r = 1 m of any mode displaces the places by at most 1 m. Displacements,
    forces and speeds at the places are those of the model, except for the contributions of the omitted modes.

    **Arguments** (numbers and arrays in SI; nd coordinates of the model, nb directions of the force)

    - `mass` M and `stiffness` K (nd, nd), symmetric, M positive definite, K without negative eigenvalues
    - `damping` C (nd, nd), real; for the structural damping of a finite-element model give an equivalent viscous damping
    - `gyroscopic` G (nd, nd), skew-symmetric: the factor of the rotor speed n in the equation; None without a rotor
    - `places`: a list of points to which exciters can be attached, numbered from 1 in `Exciter(at=)`. A place is a list of the
      indices, from 0, of its coordinates: [up], [horizontal, up] or [horizontal, up, rotation]. It can also be a matrix (1 to
      3, nd) that gives the displacement of the place from q. All places have the same number of directions
    - `foundation`: (T_K, T_C), two arrays (nb, nd): the force on the foundation is T_K q + T_C q', up (nb = 1) or horizontal
      and up (nb = 2); default: the force is unknown, and results that depend on it are NaN
    - `reduce`: largest number of coordinates; typical: 6 to 20 (default: 12); None keeps all. If the last mode has the same
      natural frequency as omitted ones, such as the other direction of a round shaft, these modes are kept as well

    **Returns** `MatrixMachine`.

    **Raises** `InputError` for

    - matrices of other shapes, and values that are complex or not finite
    - an asymmetric or indefinite mass or stiffness matrix
    - a gyroscopic matrix that is not skew-symmetric
    - coordinates that do not exist

    >>> import jaxvib as jv, numpy as np
    >>> chain = 4e4 * (2 * np.eye(30) - np.eye(30, k=1) - np.eye(30, k=-1))
    >>> machine = jv.from_matrices(2.0 * np.eye(30), 1e-4 * chain, chain, places=[[29]], reduce=6)
    >>> machine.carrier().stiffness.shape
    (6, 6)

    Source: modal reduction, for example Krämer 1993, Dynamics of Rotors and Foundations.
    """
    m = _matrix(mass, "machine.mass", None)
    size = m.shape[0]
    c, k = _matrix(damping, "machine.damping", (size, size)), _matrix(stiffness, "machine.stiffness", (size, size))
    g = None if gyroscopic is None else _matrix(gyroscopic, "machine.gyroscopic", (size, size))
    rows = _read_places(places, size)
    force = None if foundation is None else _read_foundation(foundation, size)
    for name, matrix in (("machine.mass", m), ("machine.stiffness", k)):
        when_known(lambda matrix, name=name: require_definite(matrix, name, positive=name == "machine.mass"), matrix)
    if g is not None:
        when_known(_require_skew, g)
    limit = size if reduce is None else count(reduce, "machine.reduce")
    if size > limit:
        modes = _lowest_modes(m, k, limit)
        largest = jax.lax.stop_gradient(jnp.max(jnp.abs(rows[:, :2] @ modes)))
        modes = modes / jnp.where(largest > 0.0, largest, 1.0)  # S/m, the unit of r in runs, then suits the places
        m, c, k, g = (None if x is None else modes.T @ x @ modes for x in (m, c, k, g))
        rows, force = rows @ modes, None if force is None else force @ modes
    parts = {"mass": m, "damping": c, "stiffness": k, "gyroscopic": g, "places_rows": rows, "foundation": force}
    return MatrixMachine(**parts, kind="matrices")  # pyright: ignore[reportArgumentType]


def _lowest_modes(mass: Array, stiffness: Array, number: int) -> Array:
    """Return the lowest real normal modes (nd, `number`) with modal masses 1, and all further ones of equal frequency."""
    square, inverse = relative_to(mass, stiffness)
    squares, modes = hermitian_modes(square)
    equal = when_known(lambda values: _number_of_equal(values, number), squares)
    return inverse.T @ modes[:, : equal or number]


def _number_of_equal(squares: np.ndarray, number: int) -> int:
    """Return how many of the ascending `squares` of natural frequencies are below or equal to the one with this number."""
    rounding = 64.0 * squares.size * float(np.finfo(squares.dtype).eps) * squares[-1]
    return int(np.sum(squares <= (1.0 + _EQUAL_SQUARES) * squares[number - 1] + rounding))


def _matrix(value: Any, name: str, shape: tuple[int, int] | None) -> Array:
    """Return a matrix, square if `shape` is None; a number stands for a 1 x 1 matrix."""
    if isinstance(value, (Iterator, range)):
        raise InputError(name, f"is {quoted(value)}; it must be a square array of numbers, in SI units")
    try:
        is_complex = any(map(np.iscomplexobj, jax.tree.leaves(value)))
        matrix = jnp.array(value, dtype=None if is_complex else float)  # a copy: JAX may share the memory of an array of NumPy
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(name, f"is {quoted(value)}; it must be a square array of numbers, in SI units") from error
    if is_complex:
        problem = "is complex; a real one is needed, structural damping as an equivalent viscous damping in machine.damping"
        raise InputError(name, problem)
    matrix = matrix[None, None] if matrix.ndim == 0 else matrix
    if matrix.ndim != 2 or matrix.shape != (matrix.shape[:1] * 2 if shape is None else shape) or matrix.size == 0:
        needed = "a square matrix" if shape is None else " x ".join(map(str, shape))
        raise InputError(name, f"has the shape {matrix.shape}; {needed} is needed")
    if when_known(lambda known: bool(np.all(np.isfinite(known))), matrix) is False:
        raise InputError(name, "has an entry that is not finite; finite numbers are needed")
    return matrix


def require_definite(matrix: np.ndarray | float, name: str, *, positive: bool, tolerance: float = _MAX_ASYMMETRY) -> None:
    """**Raises** `InputError` for a matrix that is asymmetric, or has eigenvalues below 0 (if `positive`: at most 0)."""
    full = np.atleast_2d(matrix)
    allowed_error = _allowed_error(full, tolerance)
    if np.max(np.abs(full - full.T)) > allowed_error:
        raise InputError(name, "is not symmetric; put skew-symmetric parts into gyroscopic, or take (A + A^T)/2")
    least = float(np.min(np.linalg.eigvalsh(full)))
    if least <= 0.0 if positive else least < -allowed_error:
        allowed = "greater than 0" if positive else "at least 0"
        raise InputError(name, f"has the eigenvalue {least:g}; all must be {allowed}")


def _require_skew(matrix: np.ndarray | float) -> None:
    full = np.atleast_2d(matrix)
    if np.max(np.abs(full + full.T)) > _allowed_error(full):
        problem = "is not skew-symmetric, G^T = -G; put symmetric parts into damping, or take (G - G^T)/2"
        raise InputError("machine.gyroscopic", problem)


def _allowed_error(matrix: np.ndarray, tolerance: float = _MAX_ASYMMETRY) -> float:
    """Return the error of the entries and of the eigenvalues of a matrix that counts as rounding."""
    return max(tolerance, len(matrix) * float(np.finfo(matrix.dtype).eps)) * float(np.max(np.abs(matrix), initial=1e-300))


def _read_places(places: Any, size: int) -> Array:
    if not isinstance(places, (list, tuple, np.ndarray, Array)) or getattr(places, "ndim", 1) == 0 or len(places) == 0:
        raise InputError("machine.places", f"is {quoted(places)}; it must be a list of places such as [[0, 1]]")
    rows = [_read_rows(place, f"machine.places[{k}]", size) for k, place in enumerate(places)]
    if len({each.shape for each in rows}) > 1:
        raise InputError("machine.places", "has places with different numbers of directions; give all the same number")
    return jnp.stack(rows)


def _read_rows(place: Any, name: str, size: int) -> Array:
    """Return the matrix that gives the displacement of a place, from the indices of its coordinates or from a matrix."""
    shape = _shape_of(place)
    if len(shape) == 1:
        require_known(list(place), name, "from_matrices", "give the indices of coordinates as whole numbers of Python")
    if len(shape) == 1 and all(is_real(each) and float(each).is_integer() for each in place):
        chosen = [int(each) for each in place]
        if not all(0 <= each < size for each in chosen) or not 1 <= len(chosen) <= 3:
            raise InputError(name, f"is {quoted(list(place))}; give 1 to 3 coordinates, 0 to {size - 1}")
        if len(set(chosen)) < len(chosen):
            problem = f"is {quoted(list(place))}, which names a coordinate twice; a row of numbers is written [{list(place)}]"
            raise InputError(name, problem)
        return jnp.asarray(np.eye(size)[chosen], dtype=float)
    number = shape[0] if len(shape) == 2 else 0
    if not 1 <= number <= 3:
        raise InputError(name, f"is {quoted(place)}; give 1 to 3 indices of coordinates, or 1 to 3 rows of {size} numbers")
    return _matrix(place, name, (number, size))


def _read_foundation(foundation: Any, size: int) -> Array:
    shape = _shape_of(foundation)
    if len(shape) != 3 or shape[0] != 2 or shape[1] not in (1, 2):
        raise InputError("machine.foundation", f"must be two arrays (T_K, T_C) of 1 or 2 rows of {size} numbers")
    return jnp.stack([_matrix(each, f"machine.foundation[{k}]", (shape[1], size)) for k, each in enumerate(foundation)])


def _shape_of(value: Any) -> tuple[int, ...]:
    """Return the shape of an array or of nested lists; () if the lists have different lengths."""
    try:
        return () if isinstance(value, (Iterator, range)) else np.shape(value)
    except jax.errors.TracerArrayConversionError:
        return jnp.asarray(value).shape
    except ValueError:
        return ()
