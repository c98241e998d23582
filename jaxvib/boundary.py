"""Checks of the arguments of public functions against the annotations of their signatures.

The decorator `validated` is applied to every public function and to the public methods of results. An argument of a wrong type
therefore raises an error before anything is traced, for example None in place of a scene or a string in place of a count. The
message of this error is one sentence. Each function itself checks the properties that a type does not express: bounds, units
and names of parameters.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import numbers
import os
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal, TypeVar, Union

import equinox as eqx
import jax
import jax.typing as jax_typing
import numpy as np
import numpy.typing as np_typing

from jaxvib.errors import InputError, quoted, require_path, suggest_name

_MAX_ENTRIES = 10**7
"""Largest length of a list. Longer lists are refused, because the check of each entry takes time."""

F = TypeVar("F", bound=Callable[..., Any])

_EXAMPLES = {
    "Machine": "for example two_mass(...)",
    "Loads": "for example balls(...)",
    "Drive": "for example ConstantSpeed('1500 rpm')",
    "Effect": "for example Gravity()",
    "Scene": "for example load_scene('machine.toml')",
    "Vibration": "for example regime.vibration() or run.vibration()",
    "State": "for example initial_state(scene)",
    "Quantity": "for example foundation_force(mode=3)",
    "DesignSpace": "for example DesignSpace(scene, free={'machine.stiffness': (1e4, 1e5)})",
    "BearingPendulum": "for example BearingPendulum(mass=2.0, length=0.3)",
    "Demand": "for example amplitude(mode=3) > '2 mm'",
    "Record": "for example read_record('swing.csv')",
    "Axes": "of matplotlib",
    "Figure": "of matplotlib",
    "tolerances": "for example {'machine.stiffness': 0.05}, a share of 5 %",
    "changes": "for example {'drive.speed': '1200 rpm'}",
}
"""Examples for error messages, by the name of a class or of an argument."""

_MAX_WHOLE = 2**63 - 1
"""Largest integer of a NumPy array (int64)."""


def validated(function: F) -> F:
    """Check the arguments of a public function by its annotations before it runs.

    A list given in place of an array is converted to an array of floats, and an array given in place of a list to a list.

    **Raises** `InputError` for an argument of another type, for a traced argument if the function needs its value, and if
    JAX's option `jax_numpy_dtype_promotion` is 'strict' but must be 'standard'; `TypeError`, as Python does, for a missing
    argument and for an unknown name.

    >>> from pathlib import Path
    >>> @validated
    ... def area(width: float, count: int = 1, path: str | Path | None = None) -> float:
    ...     return width * count
    >>> area(2.0, count=3)
    6.0
    >>> area(2.0, count="3")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: count is '3'; it must be a whole number
    """
    signature = inspect.signature(function)
    checks: dict[str, Any] = {}

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        if not checks:
            checks.update(_annotations(function, signature))
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError:  # the call raises the same error with Python's message
            _explain_names(function, kwargs, function.__name__)
            return function(*args, **kwargs)
        for name, value in bound.arguments.items():
            kind = checks[name]
            if kind is not Any and value is not signature.parameters[name].default:
                parameter_kind = signature.parameters[name].kind
                if parameter_kind is inspect.Parameter.VAR_POSITIONAL:
                    for index, each in enumerate(value):
                        _require(each, kind, f"{name}[{index}]")
                elif parameter_kind is not inspect.Parameter.VAR_KEYWORD:
                    _require(value, kind, name)
                    if isinstance(value, (list, tuple, Decimal)) and _has_array(kind):
                        bound.arguments[name] = np.asarray(value, dtype=float)
                    elif isinstance(value, (np.ndarray, jax.Array)) and not _is_traced(value) and _is_list(kind):
                        bound.arguments[name] = value if value.dtype == object else np.asarray(value).tolist()
        try:
            return function(*bound.args, **bound.kwargs)
        except _NEEDS_VALUE:
            _require_known(bound.arguments)
            raise
        except jax.dtypes.TypePromotionError as error:
            if getattr(jax.config, "jax_numpy_dtype_promotion", "strict") != "strict":
                raise
            problem = "is 'strict'; it must be 'standard', for example in `with jax.numpy_dtype_promotion('standard'):`"
            raise InputError("jax_numpy_dtype_promotion", problem) from error

    return typing.cast(F, checked)


def _explain_names(function: Callable[..., Any], given: Mapping[str, Any], name: str) -> None:
    """**Raises** `TypeError`, as Python does, for the first of the `given` keywords that a function does not have; the message
    lists its arguments. `name`: that of the function in the message."""
    parameters = inspect.signature(function).parameters
    if any(each.kind is inspect.Parameter.VAR_KEYWORD for each in parameters.values()):
        return
    allowed = [key for key, each in parameters.items() if each.kind is not inspect.Parameter.POSITIONAL_ONLY and key != "self"]
    for key in given:
        if key not in allowed:
            advice = suggest_name(key, allowed, given) if allowed else "it has no arguments"
            raise TypeError(f"{name}() got an unexpected keyword argument {key!r}; {advice}") from None


def with_known_names(function: F) -> F:
    """Explain unknown keywords of a function, or of the constructor of a class, that reads its other arguments itself, see
    `_explain_names`. A class is changed in place.

    >>> @with_known_names
    ... def disc(*, mass: float, radius: float) -> float:
    ...     return mass * radius
    >>> disc(mass=1.0, raduis=2.0)
    Traceback (most recent call last):
        ...
    TypeError: disc() got an unexpected keyword argument 'raduis'; did you mean 'radius'? allowed: mass, radius
    """
    # A named tuple has no constructor of its own but `__new__`.
    constructor = "__new__" if isinstance(function, type) and issubclass(function, tuple) else "__init__"
    inner = getattr(function, constructor) if isinstance(function, type) else function

    @functools.wraps(inner)
    def called(*args: Any, **kwargs: Any) -> Any:
        try:
            return inner(*args, **kwargs)
        except TypeError:
            _explain_names(function, kwargs, function.__name__)
            raise

    if not isinstance(function, type):
        return typing.cast(F, called)
    setattr(function, constructor, staticmethod(called) if constructor == "__new__" else called)
    return typing.cast(F, function)


if typing.TYPE_CHECKING:
    Module = eqx.Module
else:

    class _ModuleType(type(eqx.Module)):
        """Metaclass that explains unknown keywords of constructors, which may be those of dataclasses."""

        def __call__(cls, *args: Any, **kwargs: Any) -> Any:
            try:
                return super().__call__(*args, **kwargs)
            except TypeError:
                _explain_names(cls.__init__, kwargs, cls.__name__)
                raise

    class Module(eqx.Module, metaclass=_ModuleType):
        """Module of Equinox whose constructor explains unknown keywords, see `_explain_names`."""


def _require_known(arguments: Mapping[str, Any]) -> None:
    """Raise `InputError` for the first argument that contains a traced number."""
    for name, value in arguments.items():
        if any(map(_is_traced, jax.tree.leaves(value))):
            field = type(value).__name__ if name == "self" else name
            problem = "contains a value that JAX traces, but the value is needed here; call this outside of jit, grad and vmap"
            raise InputError(field, problem)


def _annotations(function: Callable[..., Any], signature: inspect.Signature) -> dict[str, Any]:
    """Return the annotations of the parameters, with `Any` for annotations that only type checkers can resolve."""
    annotations = {}
    for name, parameter in signature.parameters.items():
        kind = Any if parameter.annotation is parameter.empty else parameter.annotation
        annotations[name] = _resolved(kind, inspect.unwrap(function).__globals__)
    return annotations


def _resolved(kind: Any, names: Mapping[str, Any]) -> Any:
    """Evaluate an annotation that is a string; return `Any` for one that only type checkers can resolve."""
    names = dict(names)
    for _ in range(6):  # the value of an alias may be a string too, and some names are imported by type checkers only
        if not isinstance(kind, str):
            break
        try:
            kind = eval(kind, names)  # safe, because annotations are code of this package
        except NameError as error:
            names[error.name or ""] = Any
        except (TypeError, AttributeError):
            kind = Any
    return Any if isinstance(kind, str) else kind


def require_field_types(part: Any, place: str) -> None:
    """Check the fields of a dataclass, and of the dataclasses in it, against their annotations.

    Numbers may have any value and shape, and may be traced. **Raises** `InputError` for a field of another type.

    **Arguments**: `part`, an instance of a dataclass; `place`: its name in messages.

    >>> import equinox as eqx, jaxvib as jv
    >>> require_field_types(eqx.tree_at(lambda motor: motor.speed, jv.ConstantSpeed(60.0), 1j), "drive")
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: drive.speed is 1j, which is not a number; give a number in SI units
    """
    for name, kind, has_array, is_optional, is_tuple in _fields_of(type(part)):
        value, field = getattr(part, name), f"{place}.{name}"
        if value is None and is_optional:
            continue
        if has_array:
            if not _is_number(value):
                raise InputError(field, f"is {quoted(value)}, which is not a number; give a number in SI units")
            continue
        if is_tuple and isinstance(value, (list, np.ndarray)):
            raise InputError(field, f"is {quoted(value)}; it must be a tuple")
        _require(value, kind, field)
        entries = {f"{field}[{k}]": each for k, each in enumerate(value)} if isinstance(value, tuple) else {field: value}
        for inner, each in entries.items():
            if dataclasses.is_dataclass(each):
                require_field_types(each, inner)


class _Field(typing.NamedTuple):
    """Field of a dataclass: its annotation `kind`, and which alternatives the annotation has."""

    name: str
    kind: Any
    has_array: bool
    is_optional: bool
    is_tuple: bool


@functools.lru_cache(256)
def _fields_of(owner: type) -> tuple[_Field, ...]:
    """Return the fields of a dataclass."""
    fields = []
    for field in dataclasses.fields(owner):
        base = next(each for each in owner.__mro__ if field.name in inspect.get_annotations(each))
        kind = _resolved(field.type, vars(sys.modules[base.__module__]))
        kinds = _alternatives(kind)
        is_tuple = any(typing.get_origin(each) is tuple for each in kinds)
        fields.append(_Field(field.name, kind, any(map(_is_array, kinds)), type(None) in kinds, is_tuple))
    return tuple(fields)


def _is_number(value: Any) -> bool:
    """Return True for a number or an array of numbers that can be converted to floating-point numbers, and for traced ones."""
    if not is_real(value) or np.ma.is_masked(value):
        return False
    try:
        return isinstance(value, jax.Array) or np.asarray(value, dtype=float) is not None
    except (TypeError, ValueError, OverflowError):
        return False


class _ByName(type):
    """Metaclass that recognizes instances of a class by its name."""

    def __instancecheck__(cls, value: object) -> bool:
        return any(each.__name__ == cls.__name__ for each in type(value).__mro__)


class Axes(metaclass=_ByName):
    """Stand-in for matplotlib's class of the same name in annotations, without the slow import of matplotlib."""


class Figure(metaclass=_ByName):
    """Stand-in for matplotlib's class of the same name in annotations, without the slow import of matplotlib."""


def is_real(value: object) -> bool:
    """Return True for a real number or an array of real numbers, traced or not, and False for Booleans and dates."""
    if type(value) is float or type(value) is int:
        return True
    kind = getattr(value, "dtype", None)
    if kind is None or getattr(kind, "kind", "") == "O":
        if kind is None and hasattr(value, "__jax_array__"):
            return True
        entries = value.ravel().tolist() if isinstance(value, np.ndarray) else (value,)
        return all(isinstance(each, (numbers.Real, Decimal)) and not isinstance(each, (bool, np.bool_)) for each in entries)
    return getattr(kind, "kind", "") in "iuf" or str(kind).startswith(("bfloat", "float8", "int", "uint"))


_NEEDS_VALUE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
"""Errors that JAX raises if code needs the value of a traced number."""


def call_user(function: Callable[..., Any], field: str, *arguments: object) -> Any:
    """Return the result of a user's function.

    **Arguments**: `function`; `field`: name of the argument that contains it, for messages; `arguments` of the function.

    **Raises** `InputError` if the function cannot be called with these arguments, or if it needs the value of a traced number.
    Other errors of the function pass unchanged.

    >>> call_user(lambda scene: scene, "make", 1.0, 2.0)
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: make cannot be called with 2 values (<lambda>() takes 1 positional argument but 2 were given)
    """
    try:
        return function(*arguments)
    except _NEEDS_VALUE as error:
        raise InputError(field, "needs the value of a number that JAX traces; use functions of jax.numpy in it") from error
    except TypeError as error:
        inside = error.__traceback__ and error.__traceback__.tb_next
        if inside is not None:  # raised inside the function, not by the call itself
            raise
        values = f"{len(arguments)} values" if len(arguments) != 1 else quoted(*arguments)
        raise InputError(field, f"cannot be called with {values} ({error})") from error


def is_whole(value: object) -> bool:
    """Return True for an integer of Python or NumPy, and False for Booleans and time differences (`numpy.timedelta64`)."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.timedelta64))


def _require(value: Any, kind: Any, field: str) -> None:
    """Raise `InputError` if the value does not match the annotation `kind`."""
    kinds = _alternatives(kind)
    if any(_is_number_with_unit(each) for each in kinds):
        return
    if _is_array_like(kind):
        problem = _problem_of_array(value)
        if problem is not None and not (value is None and type(None) in kinds):
            raise InputError(field, f"is {quoted(value)}; it must be {problem}")
        return
    if any(each is Path or typing.get_origin(each) is os.PathLike for each in kinds) and not isinstance(
        value, (type(None), *_other_classes(kinds))
    ):
        require_path(value, field)
        return
    problems = []
    for each in kinds:
        if _accepts_all(each):
            return
        problem = _problem(value, each)
        if problem is None:
            return
        problems.append(problem)
    of_entries = [problem for problem in problems if isinstance(problem, InputError)]
    if of_entries:
        raise InputError(f"{field}{of_entries[0].field}", of_entries[0].problem)
    allowed = [problem for problem in problems if problem != "None"] or ["None"]
    example = f", {_EXAMPLES[field]}" if field in _EXAMPLES else ""
    raise InputError(field, f"is {quoted(value)}; it must be {' or '.join(dict.fromkeys(allowed))}{example}")


@functools.lru_cache(1024)
def _is_array_like(kind: Any) -> bool:
    """Return True for an annotation that includes `ArrayLike` of NumPy or JAX."""
    return any(set(_alternatives(each)) <= set(_alternatives(kind)) for each in (np_typing.ArrayLike, jax_typing.ArrayLike))


def _alternatives(kind: Any) -> tuple[Any, ...]:
    """Return the members of a union; for any other annotation, return the annotation itself.

    NumPy 2.5 defines `ArrayLike` as an alias of a union by a `type` statement, which has the union as its `__value__`.
    """
    kind = getattr(kind, "__value__", kind)
    if typing.get_origin(kind) in (Union, types.UnionType):
        return tuple(each for member in typing.get_args(kind) for each in _alternatives(member))
    return (kind,)


def _other_classes(kinds: Sequence[Any]) -> tuple[type, ...]:
    """Return the classes of the annotation other than those of paths and None."""
    return tuple(each for each in kinds if isinstance(each, type) and each not in (str, Path, os.PathLike, type(None)))


def _is_number_with_unit(kind: Any) -> bool:
    """Return True for the member `Quantity` of `jaxvib.units.Number`. Such values are checked when their unit is read."""
    return getattr(kind, "__name__", "") == "Quantity" and getattr(kind, "_is_protocol", False)


def _accepts_all(kind: Any) -> bool:
    return kind is Any or kind is object or isinstance(kind, (TypeVar, str, typing.ForwardRef))


def _problem(value: Any, kind: Any) -> str | InputError | None:
    """Return None for a value that matches the annotation, otherwise a description of the allowed values or the error of an
    entry."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if kind is None or kind is type(None):
        return None if value is None else "None"
    if origin is Literal:
        if isinstance(value, tuple({type(each) for each in inner})):  # the function itself lists the allowed values
            return None
        return " or ".join(map(quoted, inner)) if len(inner) < 3 else f"one of {', '.join(map(str, inner))}"
    if kind is bool:
        return None if isinstance(value, (bool, np.bool_)) else "True or False"
    if kind is int:
        if _is_traced(value):
            return "a whole number that is known outside of jit, grad and vmap"
        if not is_whole(value):
            return "a whole number"
        return None if abs(value) <= _MAX_WHOLE else f"a whole number of up to {_MAX_WHOLE.bit_length()} bits"
    if kind is float:
        return _problem_of_float(value)
    if kind is complex and (isinstance(value, complex) or getattr(getattr(value, "dtype", None), "kind", "") == "c"):
        return None
    if kind is complex or _is_array(kind):
        return _problem_of_array(value)
    if kind is str:
        return None if isinstance(value, str) else "a string"
    if origin is not None and isinstance(origin, type):
        return _problem_of_container(value, origin, inner)
    if isinstance(kind, type):
        if getattr(kind, "_is_protocol", False):
            if not getattr(kind, "_is_runtime_protocol", False) or isinstance(value, kind):
                return None
            return f"an object with {' and '.join(name for name in vars(kind) if not name.startswith('_'))}"
        if kind is Callable or kind is types.FunctionType:
            return None if callable(value) else "a function"
        if kind.__module__ == "jaxtyping":
            return _problem_of_tree(value)
        return None if isinstance(value, kind) else _describe_class(kind.__name__)
    return None


def _describe_class(name: str) -> str:
    article = "an" if name[0] in "AEIOU" else "a"
    return f"{article} {name}" + (f", {_EXAMPLES[name]}" if name in _EXAMPLES else "")


def _is_traced(value: Any) -> bool:
    """Return True for a traced value. Only public functions of JAX are used, since this module must not import `runtime`."""
    try:
        return isinstance(value, jax.Array) and not value.devices()
    except jax.errors.ConcretizationTypeError:
        return True


def _has_array(kind: Any) -> bool:
    """Return True if the annotation allows arrays, but no lists, other containers or numbers with units."""
    kinds = _alternatives(kind)
    others = any(typing.get_origin(each) is not None or _is_number_with_unit(each) for each in kinds)
    return any(map(_is_array, kinds)) and not others


def _is_list(kind: Any) -> bool:
    """Return True if the annotation allows lists or tuples, but no arrays."""
    kinds = _alternatives(kind)
    origins = [typing.get_origin(each) for each in kinds]
    lists = any(isinstance(each, type) and issubclass(each, (Sequence, list, tuple)) for each in origins)
    members = [member for each in kinds for member in typing.get_args(each) or (each,)]
    members = [member for each in members for member in typing.get_args(each) or (each,)]
    return lists and not any(_is_array(each) or _is_number_with_unit(each) or _accepts_all(each) for each in members)


def _is_array(kind: Any) -> bool:
    module, _, name = f"{getattr(kind, '__module__', '')}.{getattr(kind, '__name__', '')}".rpartition(".")
    return module.startswith(("jax", "numpy")) and name in ("Array", "ndarray")


def _problem_of_float(value: Any) -> str | None:
    if not is_real(value) or np.ma.is_masked(value):
        return "a number"
    if _is_traced(value):
        return None
    if getattr(value, "ndim", 0):
        return "a single number"
    if isinstance(value, int) and abs(value).bit_length() > 1023:
        return "a number below 1e308"
    return "a number, not NaN" if value != value else None


def _problem_of_array(value: Any) -> str | None:
    if isinstance(value, (list, tuple)):
        try:
            array = np.asarray(value)
        except (ValueError, TypeError):
            return "an array of numbers"
        if _has_boolean(value):  # NumPy would convert it to a number
            return "an array of numbers, without Booleans"
        value = array
    if not is_real(value) or np.ma.is_masked(value):
        return "an array of numbers"
    if isinstance(value, (float, Decimal)) and value != value:
        return "a number or an array of numbers, not NaN"
    return "an array of numbers below 1e308" if isinstance(value, int) and abs(value).bit_length() > 1023 else None


def _has_boolean(value: Any) -> bool:
    """Return True if nested lists contain a Boolean or an array of Booleans."""
    if isinstance(value, (list, tuple)):
        return not set(map(type, value)) <= {int, float} and any(map(_has_boolean, value))
    return isinstance(value, bool) or getattr(value, "dtype", None) == np.bool_


def _problem_of_tree(value: Any) -> str | None:
    if isinstance(value, Iterator):  # JAX does not treat an iterator as a tree
        return "an array of numbers, or a tree of arrays"
    return next(filter(None, map(_problem_of_array, jax.tree.leaves(value))), None)


def _problem_of_container(value: Any, origin: type, inner: tuple[Any, ...]) -> str | InputError | None:
    if origin is Callable or issubclass(origin, typing.cast(type, Callable)):
        return None if callable(value) else "a function"
    if issubclass(origin, Mapping):
        if not isinstance(value, Mapping):
            return "a dictionary"
        for key, each in value.items():
            if not isinstance(key, str):
                return f"a dictionary of names, not of {quoted(key)}"
            problem = _problem_of_entries([(f".{quoted(key)[1:-1]}", each)], inner[-1:])
            if problem is not None:
                return problem
        return None
    if issubclass(origin, (Sequence, list, tuple)):
        has_entries = isinstance(value, (Sequence, np.ndarray, jax.Array))
        if any(_is_number_with_unit(each) for kind in inner for each in (typing.get_args(kind) or (kind,))) and not isinstance(
            value, Mapping
        ):
            return None if has_entries or is_real(value) else "a list of numbers"
        if isinstance(value, Sequence) and not isinstance(value, str) and len(value) > _MAX_ENTRIES:
            return f"a list of at most {_MAX_ENTRIES} entries"
        if not has_entries or isinstance(value, (str, bytes, bytearray)) or getattr(value, "ndim", 1) == 0:
            names = {float: "numbers", int: "whole numbers", str: "texts"}
            return f"a list of {names.get(inner[0], 'values') if inner else 'values'}"
        if origin is tuple and inner and Ellipsis not in inner:
            if len(value) != len(inner):
                return f"{len(inner)} values"
            for index, (each, kind) in enumerate(zip(value, inner, strict=True)):
                problem = _problem_of_entries([(f"[{index}]", each)], (kind,))
                if problem is not None:
                    return problem
            return None
        if getattr(value, "dtype", None) is not None:
            if _is_traced(value) or np.ma.is_masked(value) or any(map(_is_array, inner)):
                return _problem_of_array(value)
            value = np.asarray(value).tolist()
        return _problem_of_entries(((f"[{index}]", each) for index, each in enumerate(value)), inner[:1])
    return None if isinstance(value, origin) else _describe_class(origin.__name__)


def _problem_of_entries(entries: Any, kinds: tuple[Any, ...]) -> InputError | None:
    for place, each in entries:
        for kind in kinds:
            try:
                _require(each, kind, place)
            except InputError as error:
                return error
    return None
