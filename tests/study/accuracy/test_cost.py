"""Cost of accuracy: all methods for a quantity against one reference."""

import json
import math

import jax
import numpy as np
import pytest
from scenes import published

import jaxvib as jv
from jaxvib.cli.app import run
from jaxvib.study.accuracy.cost import Cost, CostRow, cost_figure, relative
from jaxvib.study.accuracy.exact_reference import slow_period


def test_methods_agree_within_their_errors(tmp_path, capsys):
    """The leading order errs by its eps, the exact orbit by rounding; the command prints the same as JSON, with its figure."""
    jv.save_scene(published(speed=1.5, eps=1e-3, damping=0.05).scene(), tmp_path / "machine.toml")
    asked = ["cost", str(tmp_path / "machine.toml"), "--mode", "3", "--until", "40s", "--repeats", "1", "--json"]
    assert run([*asked, "--solver", "default", "--out", str(tmp_path / "out")]) == 0
    told = json.loads(capsys.readouterr().out)
    by_tier = {}
    for row in told["rows"]:
        by_tier.setdefault(row["tier"], []).append(row["error"])
    assert set(by_tier) == {"leading order", "exact orbit", "envelope", "full"} and told["left_out"] == []
    assert {row["dtype"] for row in told["rows"] if row["tier"] in ("leading order", "full")} == {"float64", "float32"}
    assert 1e-7 < by_tier["leading order"][0] < 1e-2 and min(by_tier["exact orbit"]) < 1e-9
    assert told["reference_error"] < 1e-9 and told["cheapest"]["1e-06"]["tier"] == "exact orbit"
    assert (tmp_path / "out" / "cost.png").stat().st_size > 10_000


def test_errors_are_relative_within_a_unit():
    reference, units = np.array([1e-3, 1e-3, 0.1]), ("m", "m", "rad")
    assert relative([2e-3, 1e-3, 0.1], reference, units) == pytest.approx(1.0)
    assert relative([2e-3, 1e-3, 0.1], reference) == pytest.approx(0.01)
    assert relative([1e-9, 0.0, 0.2], np.array([0.0, 0.0, 0.1]), units) == pytest.approx(1.0)
    assert relative([math.nan, 1e-3, 0.1], reference, units) == relative([1.0], np.zeros(1)) == math.inf


def light():
    """One platform, one ball."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    return jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed("60 rad/s"))


@pytest.mark.slow
def test_runs_are_long_enough_to_forget_their_start():
    """Had they half the time, the square root of the tolerance would be left of the start."""
    cost = jv.work_precision(light(), mode=1, tolerances=(1e-4, 1e-8), solvers=["Tsit5"], repeats=1)
    error = {row.setting: row.error for row in cost.rows if row.tier == "full"}
    assert error.keys() == {"1e-04", "1e-08"} and error["1e-04"] < 3e-4 and error["1e-08"] < 3e-8


def test_a_run_does_not_stay_in_an_unstable_jam():
    cost = jv.work_precision(light(), mode=2, repeats=1)
    assert {row.tier for row in cost.rows} == {"leading order", "exact orbit"}
    (reason,) = cost.left_out
    assert reason.startswith("envelope, full: jam mode 2 is unstable (largest Floquet multiplier 2.2")


@pytest.mark.slow
def test_no_run_gives_the_gradient_of_an_unstable_jam():
    """Nor is it asked how long a run would need to forget its start: less than no time."""
    scene = jv.Scene(light().machine, light().loads, jv.ConstantSpeed("40 rad/s"))
    cost = jv.work_precision(scene, "gradient", mode=2, repeats=1)
    assert {row.tier for row in cost.rows} == {"leading order", "exact orbit"}
    (reason,) = cost.left_out
    assert reason.startswith("full: jam mode 2 is unstable (largest Floquet multiplier 1.597")


@pytest.mark.slow
def test_exact_motion_exists_without_a_light_jam():
    """The exact fold of a machine with one heavy load lies beyond that of light loads, 5.1829."""
    scene = published(speed=5.19, eps=0.05).scene()
    cost = jv.work_precision(scene, mode=3, until=30.0, tolerances=(1e-6,), solvers=["Tsit5"], repeats=1)
    by_tier = {row.tier: row.error for row in cost.rows}
    assert by_tier.keys() == {"exact orbit", "envelope", "full"} and by_tier["full"] < 1e-4 < by_tier["envelope"]
    (reason,) = cost.left_out
    assert reason.startswith("leading order: this mode does not exist at this rotor speed; runs start from the exact jam")


def test_a_run_up_is_measured_at_its_end():
    machine = jv.planar_rotor(mass=20.0, stiffness=4e4, damping=60.0)
    loads = jv.balls(count=1, mass=0.4, radius=0.08, drag=0.5)
    scene = jv.Scene(machine, loads, jv.RunUp(60.0, 60.0), (jv.StaticImbalance("1 g m"),))
    cost = jv.work_precision(scene, until=2.0, tolerances=(1e-4, 1e-7), solvers=["Tsit5"], repeats=1)
    assert [row.setting for row in cost.rows] == ["1e-04", "1e-07"] and {row.method for row in cost.rows} == {"Tsit5"}
    assert cost.reference_error < 1e-9 and cost.rows[1].error < 1e-8 < cost.rows[0].error
    run = jv.simulate(scene, 2.0, stepsize_controller=jv.Tolerance(1e-10), estimate=False)
    np.testing.assert_allclose(cost.reference, run.amplitude, rtol=1e-7)
    exact, averaged = cost.left_out
    assert exact == "leading order, exact orbit: drive.kind is 'run_up'; a jam needs a constant speed: use ConstantSpeed"
    assert averaged.startswith("envelope: effects.static_imbalance is not included in this function (term RotorImbalance)")
    with pytest.raises(jv.InputError, match=r"drive\.kind is 'run_up'; a jam needs a constant speed"):
        jv.work_precision(scene, mode=1)


def test_final_states_are_compared_up_to_whole_turns():
    cost = jv.work_precision(light(), "final_state", until=20.0, tolerances=(1e-5,), solvers=["default"], repeats=1)
    error = {row.dtype: row.error for row in cost.rows}
    assert error.keys() == {"float64", "float32"} and 0.0 < error["float64"] < 1e-3 and error["float32"] < 0.1
    assert cost.reference_error < 1e-8 and len(cost.reference) == 4


def test_a_final_state_has_natural_units():
    scene = light()
    cost = jv.work_precision(scene, "final_state", until=2.0, tolerances=(1e-5,), solvers=["default"], repeats=1)
    run = jv.simulate(scene, 2.0, save="window", stepsize_controller=jv.Tolerance(1e-11), estimate=False)
    last = jax.tree.map(lambda leaf: float(np.ravel(leaf[-1])[0]), run.window.state)
    np.testing.assert_allclose(cost.reference[2:], [last.angle[0], last.rate[0] / 60.0], rtol=1e-7)  # rad, in the rotor speed
    np.testing.assert_array_equal(np.sign(cost.reference[:2]), np.sign([last.displacement, last.velocity]))


def test_the_slow_period_is_that_of_the_lowest_mode():
    """Closed form: equal masses m between two springs k and one of k in the middle; a free machine has what oscillates."""
    k, m = 4e4, 50.0
    spread = jv.two_mass(mass=m, stiffness=k, damping=1.0, link_stiffness=k, link_damping=1.0)
    free = jv.two_mass(mass=m, stiffness=0.0, damping=1.0, link_stiffness=k, link_damping=1.0)
    for machine, stiffness in ((spread, k), (free, 2.0 * k)):
        scene = jv.Scene(machine, jv.balls(count=1, mass=1e-9, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
        assert slow_period(scene) == pytest.approx(2.0 * np.pi * np.sqrt(m / stiffness), rel=1e-6)


def row(error, seconds):
    return CostRow("full", "", "float64", "", error, seconds, 0.0)


def test_the_cheapest_is_the_fastest_that_is_exact_enough():
    cost = Cost("amplitude", [1.0], 1e-9, [row(1e-2, 1.0), row(1e-5, 3.0), row(1e-6, 2.0), row(np.inf, 0.1)])
    assert cost.cheapest(0.1) == row(1e-2, 1.0) and cost.cheapest(1e-4) == row(1e-6, 2.0)
    assert cost.cheapest(1e-7) is None and cost.cheapest(1e-10) is None
    assert cost.plot().axes[0].get_ylabel() == "relative error of amplitude"
    three = cost_figure({"a": cost, "b": cost, "c": Cost("amplitude", [1.0], 1.0, [row(np.inf, 0.1)])})
    assert [axes.get_title() for axes in three.axes] == ["a", "b", "c", ""]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (dict(quantity="mass"), "quantity is 'mass'; allowed: amplitude"),
        (dict(solvers=["Euler"]), r"solvers are \['Euler'\]; name some of default, Tsit5, Dopri8"),
        (dict(solvers=[]), r"solvers are \[\]; name some of default"),
        (dict(until=-1.0), "until is -1"),
        (dict(tolerances=()), r"tolerances are \(\); give at least one, such as 1e-6"),
        (dict(tolerances=(1e-6, 0.0)), r"tolerances\[1\] is 0; it must be greater than 0"),
        (dict(repeats=0), "repeats is 0; it must be a whole number, at least 1"),
    ],
)
def test_invalid_arguments_raise_clear_errors(asked, message):
    with pytest.raises(jv.InputError, match=message):
        jv.work_precision(published().scene(), **asked)


def test_single_precision_raises_a_clear_error():
    with jax.enable_x64(False), pytest.raises(jv.InputError, match="single precision; a comparison of errors needs"):
        jv.work_precision(light())
