"""Compiled functions of tests, whose traced programs are kept from one run of the suite to the next."""

import dataclasses
import functools
import hashlib
import importlib
import inspect
import pathlib
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxvib.runtime.programs import cached
from jaxvib.runtime.structure import KNOWN_PACKAGES, Undescribable, describe

HELPERS = pathlib.Path(__file__).parent


def stored_jit(function):
    """`equinox.filter_jit(function)`, whose programs are stored as those of the package are.

    What they depend on beside the package is in their names: the function's place in its file, that file and the helpers, and
    what the function was made with: the values it holds on to, arrays by their bytes, and functions in these alike. Where one
    of these cannot be told from others no program is stored. Of the arguments, arrays and Python's floats are traced.
    """
    try:
        name = hashlib.sha256(repr(_described(function)).encode()).hexdigest()[:32]
    except Undescribable:
        name, asked = None, eqx.filter_jit(function)
    else:

        def program(*args, **kwargs):
            return function(*args, **kwargs)

        program.__name__, program.__qualname__ = "of_a_test", name
        asked = cached(program)

    def call(*args, **kwargs):
        return asked(*jax.tree.map(_number, args), **jax.tree.map(_number, kwargs))

    call.name = name
    return call


def _number(leaf):
    return jnp.asarray(leaf) if type(leaf) is float else leaf


def _described(value):
    inner = _described
    match value:
        case types.FunctionType() if getattr(value, "name", None):  # one of these
            return value.name
        case types.FunctionType():
            held = [cell.cell_contents for cell in value.__closure__ or ()]
            return _place(value), inner(held), inner(value.__defaults__), inner(value.__kwdefaults__)
        case functools.partial():
            return "partial", inner(value.func), inner(value.args), inner(value.keywords)
        case types.MethodType():
            return "method", _place(value.__func__), inner(value.__self__)
        case types.ModuleType():
            return "module", value.__name__
        case jax.tree_util.PyTreeDef() | inspect.Signature() if " at 0x" not in repr(value):
            return repr(value)
        case object() if type(value) is object:  # JAX's functions hold on to some, to tell what was not given
            return "object"
        case list() | tuple() if type(value) in (list, tuple):
            return type(value).__name__, [inner(each) for each in value]
        case dict() if type(value) is dict:
            return "dict", [(key, inner(each)) for key, each in value.items()]
    if type(value).__name__ == "HashablePartial":  # JAX's own, which is no function
        return "partial", inner(value.f), inner(value.args), inner(value.kwargs)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return inner(type(value)), [inner(getattr(value, field.name)) for field in dataclasses.fields(value)]
    return describe(value, _array)


def _array(value):
    content = np.asarray(value)
    return [str(jax.typeof(value)), hashlib.sha256(content.tobytes()).hexdigest()]


def _place(function):
    """Place of a function's text, and the text itself if it is not that of a package whose sources or version are known."""
    code = function.__code__
    file = pathlib.Path(code.co_filename)
    place = [file.name, code.co_qualname, hashlib.sha256(repr([*code.co_positions()]).encode()).hexdigest()]
    if any(folder in file.parents for folder in _known_folders()):
        return place
    if HELPERS.parent not in file.parents:
        raise Undescribable(f"{function} is of no known package and of no test")
    return [*place, *map(_source, [file, *sorted(HELPERS.rglob("*.py"))])]


@functools.cache
def _known_folders():
    return [pathlib.Path(importlib.import_module(name).__file__).parent for name in sorted(KNOWN_PACKAGES)]


@functools.cache
def _source(file):
    return hashlib.sha256(file.read_bytes()).hexdigest()
