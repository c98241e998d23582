"""What accuracy costs: every way of computing a quantity is set against one reference."""

import json

import numpy as np
import pytest
from scenes import published

import jaxvib as jv
from jaxvib.cli.app import run
from jaxvib.study.accuracy import Cost, CostRow


def test_ways_agree_where_they_should(tmp_path, capsys):
    """The leading order errs by its eps, the exact orbit by rounding; the command prints the same as JSON, with its figure."""
    jv.save_scene(published(speed=1.5, eps=1e-3, damping=0.05).scene(), tmp_path / "machine.toml")
    asked = ["cost", str(tmp_path / "machine.toml"), "--mode", "3", "--until", "40s", "--repeats", "1", "--json"]
    assert run([*asked, "--out", str(tmp_path / "out")]) == 0
    told = json.loads(capsys.readouterr().out)
    by_tier = {}
    for row in told["rows"]:
        by_tier.setdefault(row["tier"], []).append(row["error"])
    assert set(by_tier) == {"leading order", "exact orbit", "envelope", "full"}
    assert 1e-7 < by_tier["leading order"][0] < 1e-2 and min(by_tier["exact orbit"]) < 1e-9
    assert told["reference_error"] < 1e-9 and told["cheapest"]["1e-06"]["tier"] == "exact orbit"
    assert (tmp_path / "out" / "cost.png").stat().st_size > 10_000


def row(error, seconds):
    return CostRow("full", "", "float64", "", error, seconds, 0.0)


def test_the_cheapest_is_the_fastest_that_is_exact_enough():
    cost = Cost("amplitude", [1.0], 1e-9, [row(1e-2, 1.0), row(1e-5, 3.0), row(1e-6, 2.0), row(np.inf, 0.1)])
    assert cost.cheapest(0.1) == row(1e-2, 1.0) and cost.cheapest(1e-4) == row(1e-6, 2.0)
    assert cost.cheapest(1e-7) is None and cost.cheapest(1e-10) is None
    assert cost.plot().axes[0].get_ylabel() == "relative error of amplitude"


def test_another_quantity_is_refused():
    with pytest.raises(jv.InputError, match="quantity is 'mass'; it must be one of amplitude"):
        jv.accuracy(published().scene(), "mass")
