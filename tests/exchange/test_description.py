"""The file modelDescription.xml of a unit with one variable of each kind, element by element."""

import xml.etree.ElementTree as ElementTree

import pytest

from jaxvib.exchange.description import Variable, base_units, describe_model

VARIABLES = [
    Variable("time", "s", "independent"),
    Variable("displacement.y1", "m", "output", "0.5", nominal="0.01"),
    Variable("event_indicator[0]", "", "local", listed=False),
    Variable("der(displacement.y1)", "m/s", "local", state=1),
    Variable("force.y1", "N", "input", "0.0"),
    Variable("foundation_force.up", "N", "output"),
    Variable("machine.mass[0]", "kg", "parameter", "50.0", 'mass <of> "one" & all\x01', "0.0", "1e3"),
]


def described(fmi, variables=VARIABLES):
    text = describe_model(fmi, "a machine", "a_machine", "{42}", "jaxvib 1", "about it", variables, "0.001", "2.0")
    return ElementTree.fromstring(text.encode())


def elements(root, path):
    return [each.attrib for each in root.findall(path)]


COMMON = {"modelIdentifier": "a_machine"}
CALLS = {
    "2.0": {"canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true", "providesDirectionalDerivative": "true"},
    "3.0": {"canGetAndSetFMUState": "true", "canSerializeFMUState": "true", "providesDirectionalDerivatives": "true"},
}
HEAD = {
    "modelName": "a machine", "description": "about it", "generationTool": "jaxvib 1", "variableNamingConvention": "structured",
}  # fmt: skip


@pytest.mark.parametrize("fmi", ["2.0", "3.0"])
def test_head_and_capabilities(fmi):
    root, own = described(fmi), {"guid": "{42}", "numberOfEventIndicators": "1"}
    assert root.attrib == HEAD | {"fmiVersion": fmi} | (own if fmi == "2.0" else {"instantiationToken": "{42}"})
    assert elements(root, "ModelExchange") == [COMMON | CALLS[fmi]]
    assert elements(root, "CoSimulation") == [COMMON | CALLS[fmi] | {"canHandleVariableCommunicationStepSize": "true"}]
    files = [{"name": "fmi2.c"}] * (fmi == "2.0")
    for kind in ("ModelExchange", "CoSimulation"):
        assert elements(root, f"{kind}/SourceFiles/File") == files
    assert elements(root, "DefaultExperiment") == [{"startTime": "0.0", "stopTime": "2.0", "stepSize": "0.001"}]
    assert elements(root, "LogCategories/Category") == [{"name": "logStatusError"}]
    names = [each.tag for each in root]
    ends = ["UnitDefinitions", "LogCategories", "DefaultExperiment", "ModelVariables", "ModelStructure"]
    assert names == ["ModelExchange", "CoSimulation", *ends]
    units = {each.attrib["name"]: each.find("BaseUnit").attrib for each in root.findall("UnitDefinitions/Unit")}
    assert list(units) == ["N", "kg", "m", "m/s", "s"]
    assert units["N"] == {"kg": "1", "m": "1", "s": "-2"} and units["m/s"] == {"m": "1", "s": "-1"}


CASES = [
    ({"name": "time", "valueReference": "0", "causality": "independent", "variability": "continuous"}, {"unit": "s"}),
    (
        {
            "name": "displacement.y1", "valueReference": "1", "causality": "output", "variability": "continuous",
            "initial": "exact",
        },
        {"unit": "m", "nominal": "0.01", "start": "0.5"},
    ),
    ({"name": "event_indicator[0]", "valueReference": "2", "causality": "local", "variability": "continuous"}, {}),
    (
        {"name": "der(displacement.y1)", "valueReference": "3", "causality": "local", "variability": "continuous"},
        {"unit": "m/s", "derivative": "1"},
    ),
    (
        {"name": "force.y1", "valueReference": "4", "causality": "input", "variability": "continuous"},
        {"unit": "N", "start": "0.0"},
    ),
    ({"name": "foundation_force.up", "valueReference": "5", "causality": "output", "variability": "continuous"}, {"unit": "N"}),
    (
        {
            "name": "machine.mass[0]", "valueReference": "6", "description": 'mass <of> "one" & all?',
            "causality": "parameter", "variability": "tunable",
        },
        {"unit": "kg", "min": "0.0", "max": "1e3", "start": "50.0"},
    ),
]  # fmt: skip


def with_initial(head):
    """Return attributes with `initial` for computed variables."""
    is_computed = head["causality"] in ("output", "local") and "initial" not in head
    return head | ({"initial": "calculated"} if is_computed else {})


def test_variables_of_version_2():
    """A state is named by its place, from 1, among the listed variables; indicators are not listed."""
    root = described("2.0")
    found = [(each.attrib, each.find("Real").attrib) for each in root.findall("ModelVariables/ScalarVariable")]
    listed = [(with_initial(head), dict(own)) for head, own in CASES if head["name"] != "event_indicator[0]"]
    listed[2][1]["derivative"] = "2"
    assert found == listed
    structure = {each.tag: [part.attrib["index"] for part in each] for each in root.find("ModelStructure")}
    assert structure == {"Outputs": ["2", "5"], "Derivatives": ["3"], "InitialUnknowns": ["3", "5"]}


def test_variables_of_version_3():
    root = described("3.0")
    listed = [with_initial(head) | own for head, own in CASES]
    assert elements(root, "ModelVariables/Float64") == listed
    structure = [(each.tag, each.attrib["valueReference"]) for each in root.find("ModelStructure")]
    assert structure == [
        ("Output", "1"), ("Output", "5"), ("ContinuousStateDerivative", "3"), ("InitialUnknown", "3"), ("InitialUnknown", "5"),
        ("EventIndicator", "2"),
    ]  # fmt: skip


def test_one_free_name_makes_the_names_flat():
    free = [*VARIABLES[:-1], VARIABLES[-1]._replace(name="mass of the machine")]
    assert described("2.0", free).attrib["variableNamingConvention"] == "flat"


def test_units_as_exponents():
    assert base_units("V s/rad") == {"kg": 1, "m": 2, "s": -2, "A": -1, "rad": -1}
    assert base_units("ohm A^2") == base_units("W") == {"kg": 1, "m": 2, "s": -3} and base_units("m/m") == {}
