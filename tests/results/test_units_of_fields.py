"""Units and axes of the fields of all results."""

import dataclasses
import importlib
import pkgutil

import equinox as eqx
import pytest

import jaxvib
import optimize
from jaxvib.units.reading import unit_ratio


def results():
    """All public classes with a field in a unit, of both packages."""
    for package in (jaxvib, optimize):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    waiting, found = [eqx.Module], {}
    while waiting:
        for kind in waiting.pop().__subclasses__():
            waiting.append(kind)
            is_ours = kind.__module__.split(".")[0] in ("jaxvib", "optimize") and kind.__name__[0] != "_"
            if is_ours and any("axes" in field.metadata for field in dataclasses.fields(kind)):
                found[f"{kind.__module__}.{kind.__qualname__}"] = kind
    return found


RESULTS = results()

NOT_SHOWN = {"kkt"}
"""Numbers that no table shows."""


@pytest.mark.parametrize("name", sorted(RESULTS))
def test_numbers_of_results_have_a_unit(name):
    for field in dataclasses.fields(RESULTS[name]):
        if str(field.type).split("[")[0] in ("Array", "np.ndarray", "float") and field.name not in NOT_SHOWN:
            assert field.metadata.keys() & {"unit", "part", "write"}, field.name
        units = field.metadata["unit"].split(" or ") if "axes" in field.metadata else []
        for unit in set(units) - {"", "SI"}:  # SI: the unit of each number is among the labels
            assert unit_ratio(unit, unit) == 1.0, field.name
