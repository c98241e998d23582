"""Description of a functional mock-up unit: the file modelDescription.xml of FMI 2.0 and 3.0."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple
from xml.sax.saxutils import quoteattr

from jaxvib.errors import CONTROL

Fmi = Literal["2.0", "3.0"]
"""Versions of the functional mock-up interface."""

_BASE: Mapping[str, Mapping[str, int]] = {
    "m": {"m": 1},
    "kg": {"kg": 1},
    "s": {"s": 1},
    "rad": {"rad": 1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "A": {"A": 1},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "H": {"kg": 1, "m": 2, "s": -2, "A": -2},
}
"""Units as exponents of SI base units."""

_STRUCTURED_NAME = re.compile(r"(der\()?[A-Za-z_]\w*(\[\d+\])?(\.[A-Za-z_]\w*(\[\d+\])?)*\)?", re.ASCII)
"""Names that the naming convention "structured" of FMI permits."""


class Variable(NamedTuple):
    """Variable of a functional mock-up unit; its value reference is its index in the list of all variables.

    **Attributes**: `name`; `unit`, "" for none; `kind`: the causality in FMI; `start`: the initial value, None if it is
    computed; `about`: a description; bounds `low` and `high`, or None; `state`: for the rate of a state, the index of the
    state, otherwise None; `nominal`: typical size, or None; `listed`: False for an event indicator, which is not a variable
    in FMI 2.0.
    """

    name: str
    unit: str
    kind: Literal["independent", "output", "local", "input", "parameter"]
    start: str | None = None
    about: str = ""
    low: str | None = None
    high: str | None = None
    state: int | None = None
    nominal: str | None = None
    listed: bool = True

    @property
    def variability(self) -> str:
        """Variability in the sense of FMI: "tunable" or "continuous"."""
        return "tunable" if self.kind == "parameter" else "continuous"

    @property
    def is_calculated(self) -> bool:
        """True if the initial value is computed from other variables."""
        return self.kind in ("output", "local") and self.start is None


def base_units(unit: str) -> dict[str, int]:
    """Return a unit as exponents of SI base units.

    >>> base_units("N s/m"), base_units("kg m^2")
    ({'kg': 1, 's': -1}, {'kg': 1, 'm': 2})
    """
    powers: dict[str, int] = {}
    for place, part in enumerate(unit.split("/")):
        for word in part.split():
            name, _, power = word.partition("^")
            if word == "1":
                continue
            for base, exponent in _BASE[name].items():
                powers[base] = powers.get(base, 0) + exponent * int(power or 1) * (-1 if place else 1)
    return {base: exponent for base, exponent in powers.items() if exponent}


def describe_model(
    fmi: Fmi, name: str, identifier: str, token: str, tool: str, about: str, variables: Sequence[Variable], step: str, stop: str
) -> str:
    """Return the text of modelDescription.xml.

    **Arguments**: `name` and `identifier` of the model; `token`: text that the binary must contain too; `variables` in the
    order of their value references; `step` of co-simulation and `stop` time of the default experiment, s.
    """
    is_version_2 = fmi == "2.0"
    listed = [(reference, variable) for reference, variable in enumerate(variables) if variable.listed or not is_version_2]
    places = {reference: place for place, (reference, _) in enumerate(listed, 1)}
    indicators = [reference for reference, variable in enumerate(variables) if not variable.listed]
    structured = all(_STRUCTURED_NAME.fullmatch(variable.name) for variable in variables)
    attributes = {
        "fmiVersion": fmi,
        "modelName": name,
        "guid" if is_version_2 else "instantiationToken": token,
        "description": about,
        "generationTool": tool,
        "variableNamingConvention": "structured" if structured else "flat",
        **({"numberOfEventIndicators": str(len(indicators))} if is_version_2 else {}),
    }
    states = "canGetAndSetFMUstate", "canSerializeFMUstate"
    capabilities = states if is_version_2 else tuple(variable.replace("state", "State") for variable in states)
    common = {
        "modelIdentifier": identifier,
        **dict.fromkeys(capabilities, "true"),
        "providesDirectionalDerivative" + "s" * (not is_version_2): "true",
    }
    stepping = {"canHandleVariableCommunicationStepSize": "true"}
    files = [f'<SourceFiles><File name="fmi{fmi[0]}.c"/></SourceFiles>'] if is_version_2 else []
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        _tag("fmiModelDescription", attributes, closed=False),
        *_element("ModelExchange", common, files),
        *_element("CoSimulation", {**common, **stepping}, files),
        "<UnitDefinitions>",
        *(
            f"<Unit name={_attribute(unit)}>{_tag('BaseUnit', {k: str(v) for k, v in base_units(unit).items()})}</Unit>"
            for unit in sorted({variable.unit for _, variable in listed if variable.unit})
        ),
        "</UnitDefinitions>",
        '<LogCategories><Category name="logStatusError"/></LogCategories>',
        _tag("DefaultExperiment", {"startTime": "0.0", "stopTime": stop, "stepSize": step}),
        "<ModelVariables>",
        *(_variable_element(is_version_2, reference, variable, places) for reference, variable in listed),
        "</ModelVariables>",
        "<ModelStructure>",
    ]
    outputs = [reference for reference, variable in listed if variable.kind == "output"]
    rates = [reference for reference, variable in listed if variable.state is not None]
    initial = [reference for reference, variable in listed if variable.is_calculated and variable.listed]
    groups = {"Outputs": outputs, "Derivatives": rates, "InitialUnknowns": initial}
    if is_version_2:
        for group, members in groups.items():
            lines += [f"<{group}>", *(_tag("Unknown", {"index": str(places[variable])}) for variable in members), f"</{group}>"]
    else:
        names = "Output", "ContinuousStateDerivative", "InitialUnknown", "EventIndicator"
        for group, members in zip(names, (*groups.values(), indicators), strict=True):
            lines += [_tag(group, {"valueReference": str(variable)}) for variable in members]
    return "\n".join([*lines, "</ModelStructure>", "</fmiModelDescription>", ""])


def _variable_element(is_version_2: bool, reference: int, variable: Variable, places: Mapping[int, int]) -> str:
    attributes = {"name": variable.name, "valueReference": str(reference)}
    if variable.about:
        attributes["description"] = variable.about
    attributes |= {"causality": variable.kind, "variability": variable.variability}
    if variable.kind in ("output", "local"):
        attributes["initial"] = "calculated" if variable.is_calculated else "exact"
    derivative = None if variable.state is None else str(places[variable.state] if is_version_2 else variable.state)
    type_attributes = {
        "unit": variable.unit or None,
        "min": variable.low,
        "max": variable.high,
        "nominal": variable.nominal,
        "derivative": derivative,
    }
    type_attributes = {key: value for key, value in {**type_attributes, "start": variable.start}.items() if value is not None}
    if is_version_2:
        return f"{_tag('ScalarVariable', attributes, closed=False)}{_tag('Real', type_attributes)}</ScalarVariable>"
    return _tag("Float64", {**attributes, **type_attributes})


def _element(name: str, attributes: Mapping[str, str], content: Sequence[str]) -> list[str]:
    return [_tag(name, attributes, closed=False), *content, f"</{name}>"] if content else [_tag(name, attributes)]


def _tag(name: str, attributes: Mapping[str, str], *, closed: bool = True) -> str:
    inner = "".join(f" {key}={_attribute(value)}" for key, value in attributes.items())
    return f"<{name}{inner}{'/' if closed else ''}>"


def _attribute(text: str) -> str:
    """Return a quoted text without the characters that XML does not allow."""
    return quoteattr(re.sub(f"{CONTROL.pattern}|[\ud800-\udfff\ufffe\uffff]", "?", text))
