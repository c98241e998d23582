"""Docstrings of the public surface: an example, each argument and typical values of functions, each field of classes.

Methods of public classes explain their arguments too: in their own docstring, in that of the method that they override, or in
that of their class.
"""

import dataclasses
import inspect
import re

import equinox as eqx
import pytest

import jaxvib
import optimize

SURFACE = {f"{package.__name__}.{name}": getattr(package, name) for package in (jaxvib, optimize) for name in package.__all__}

NUMERIC = {"Number", "Numbers", "int", "float", "Sequence[Number]", "Sequence[float]"}
"""Annotations of arguments whose docstring states typical values."""


def plain(value):
    """The function within a method as a class holds it; the value itself if it is no method."""
    value = getattr(value, "__func__", value)
    value = getattr(value, "method", value)  # as Equinox wraps methods
    return inspect.unwrap(value) if callable(value) else value


def own_constructor(kind):
    """The constructor that a class writes itself; None for one that follows from its fields."""
    found = plain(vars(kind).get("__init__"))
    written = inspect.isfunction(found) and found.__qualname__ == f"{kind.__qualname__}.__init__"
    return found if written and found.__code__.co_filename == inspect.getsourcefile(kind) else None


def callables():
    """{name: (function, docstring)} of public functions and of constructors that classes write."""
    found = {}
    for name, value in SURFACE.items():
        if inspect.isfunction(inspect.unwrap(value)):
            found[name] = inspect.unwrap(value), value.__doc__ or ""
        elif inspect.isclass(value) and not issubclass(value, eqx.Enumeration) and own_constructor(value):
            found[name] = own_constructor(value), value.__doc__ or ""
    return found


def methods():
    """{name: (function, docstring with those of its class and of overridden methods)} of public methods."""
    found = {}
    for owner, kind in SURFACE.items():
        if inspect.isclass(kind):
            for name, value in vars(kind).items():
                if not name.startswith("_") and inspect.isfunction(plain(value)):
                    texts = [plain(vars(base)[name]).__doc__ for base in kind.__mro__ if name in vars(base)]
                    found[f"{owner}.{name}"] = plain(value), "\n".join(map(str, [*texts, kind.__doc__]))
    return found


CALLABLES, METHODS = callables(), methods()


def arguments(function):
    return [each for each in inspect.signature(function).parameters.values() if each.name not in ("self", "cls")]


def missing_arguments(function, text):
    return [each.name for each in arguments(function) if not re.search(rf"`{each.name}\b", text)]


def takes_numbers(function):
    kinds = {each.name: str(each.annotation).split(" | ")[0] for each in arguments(function)}
    return any(kind in NUMERIC and name != "seed" for name, kind in kinds.items())


def test_surface_has_functions_constructors_and_methods():
    assert len(CALLABLES) > 100 and len(METHODS) > 100
    assert {"jaxvib.balls", "jaxvib.Scene", "jaxvib.Stop", "optimize.synthesize"} <= set(CALLABLES)
    assert {"jaxvib.JamModes.select", "jaxvib.Run.plot", "jaxvib.Effect.typical"} <= set(METHODS)


@pytest.mark.parametrize("name", CALLABLES)
def test_docstring_has_an_example_and_each_argument(name):
    function, text = CALLABLES[name]
    assert ">>> " in text
    assert missing_arguments(function, text) == []


@pytest.mark.parametrize("name", [name for name, (function, _) in CALLABLES.items() if takes_numbers(function)])
def test_docstring_states_typical_values(name):
    assert "typical" in CALLABLES[name][1]


@pytest.mark.parametrize("name", [name for name in CALLABLES if inspect.isfunction(inspect.unwrap(SURFACE[name]))])
def test_docstring_states_what_is_returned(name):
    assert "**Returns** " in CALLABLES[name][1]


@pytest.mark.parametrize("name", METHODS)
def test_method_explains_each_argument(name):
    assert missing_arguments(*METHODS[name]) == []


@pytest.mark.parametrize("name", [name for name, kind in SURFACE.items() if dataclasses.is_dataclass(kind)])
def test_class_explains_each_field(name):
    kind = SURFACE[name]
    text = "\n".join(base.__doc__ or "" for base in kind.__mro__)
    assert [each.name for each in dataclasses.fields(kind) if not re.search(rf"`{each.name}\b", text)] == []


@pytest.mark.parametrize("name", [name for name, kind in SURFACE.items() if inspect.isclass(kind)])
def test_class_has_an_example_or_names_its_function(name):
    kind = SURFACE[name]
    assert issubclass(kind, eqx.Enumeration) or ">>> " in kind.__doc__ or "Returned by `" in kind.__doc__
