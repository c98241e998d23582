"""Figures of stores: intervals, shares, sensitivities, and which figure fits."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from scenes import scene

import jaxvib as jv
from jaxvib.draw.sweeps import label_map
from jaxvib.sweeps.figures import label_counts, plot_distribution, plot_map, plot_shares, plot_tornado
from jaxvib.sweeps.results import results_table
from jaxvib.sweeps.store import Store
from jaxvib.sweeps.study import study
from jaxvib.sweeps.sweep import run_study
from optimize import Quantity

SCENE = scene("one_mass", "balls", speed=60.0)


def weighted(scene):
    return 3.0 * scene.loads.drag + 0.01 * scene.drive.speed


def number(scene):
    return (scene.drive.speed // 40.0).astype(int)


def labelled(axes, names, store):
    """Labels of modes without runs; a study refuses this name for other measures."""
    measures = {"weighted": Quantity("weighted", "N", weighted), "mode": Quantity("number", "", number)}
    asked = study(SCENE, axes, [measures[name] for name in names], chunk=16)
    return run_study(dataclasses.replace(asked, names=names), store)


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    axes = {
        "drive.speed": {"from": 20.0, "to": 100.0, "count": 11},
        "loads.drag": {"from": 0.1, "to": 10.0, "count": 6, "scale": "log"},
    }
    return labelled(axes, ("weighted", "mode"), tmp_path_factory.mktemp("grid") / "grid.zarr")


@pytest.fixture(scope="module")
def sampled(tmp_path_factory):
    axes = {"loads.drag": {"from": 1.0, "to": 2.0}, "drive.speed": {"from": 40.0, "to": 80.0}}
    asked = study(SCENE, axes, [Quantity("weighted", "N", weighted)], samples=3000, chunk=1024)
    return run_study(asked, tmp_path_factory.mktemp("sampled") / "sampled.zarr")


def test_a_map_has_the_values_at_their_place(grid):
    figure = plot_map(grid.store, "weighted", x="drive.speed", y="loads.drag")
    mesh = figure.axes[0].collections[0]
    np.testing.assert_array_equal(np.asarray(mesh.get_array()), grid.data["weighted"].values.T)
    assert figure.axes[0].get_yscale() == "log" and figure.axes[0].get_xlabel() == "rotor speed, rpm"
    cases = figure.axes[0].lines[0].get_xydata()
    assert len(cases) == 66 and cases[-1] == pytest.approx([3000.0 / np.pi, 10.0])
    turned = plot_map(grid.store, "weighted", x="loads.drag")
    np.testing.assert_array_equal(np.asarray(turned.axes[0].collections[0].get_array()), grid.data["weighted"].values)


def test_each_label_has_a_colour_and_so_has_a_missing_label():
    codes = np.array([[0, 2], [2, -1]])
    figure = label_map(
        np.arange(2.0),
        np.arange(2.0),
        codes,
        ["a", "b", "c"],
        x_label="x",
        y_label="y",
        lines={"fold": [(np.ones(2), np.arange(2.0))]},
    )
    axis = figure.axes[0]
    mesh = axis.collections[0]
    colours = [to_hex(c) for c in mesh.to_rgba(np.asarray(mesh.get_array())).reshape(-1, 4)]
    assert colours[1] == colours[2] and len(set(colours)) == 3
    assert [(p.get_hatch(), p.get_path().vertices[0].tolist()) for p in axis.patches] == [("...", [0.5, 0.5])]
    assert [t.get_text() for t in axis.get_legend().get_texts()] == [
        "a",
        "c",
        "no result",
        "fold of exact jams",
        "case",
    ]


def test_shares_are_counted_over_the_cases(grid):
    axis = plot_shares(grid.store, "drive.speed").axes[0]
    lines = {line.get_label(): np.asarray(line.get_ydata()) for line in axis.lines}
    expected = np.linspace(20.0, 100.0, 11) // 40.0
    np.testing.assert_array_equal(lines["not jammed"], 100.0 * (expected == 0.0))
    np.testing.assert_array_equal(lines["jammed, mode 2"], 100.0 * (expected == 2.0))
    assert axis.get_ylabel() == "share of the cases, %" and not axis.containers  # no confidence interval without samples


def test_a_distribution_separates_the_regimes(grid):
    axis = plot_distribution(grid.store, "weighted").axes[0]
    names = [text.get_text() for text in axis.get_legend().get_texts()]
    assert sorted(names) == sorted(f"{name}: {n} cases" for name, n in label_counts(Store(Path(grid.store))))
    values, modes = grid.data["weighted"].values, grid.data["mode"].values
    for k, bars in enumerate(axis.containers):
        assert [bar.get_height() for bar in bars] == np.histogram(
            values[modes == k], np.linspace(values.min(), values.max(), 61)
        )[0].tolist()


def test_a_tornado_has_one_regime(grid):
    axis = plot_tornado(grid.store, "weighted").axes[0]
    assert axis.get_xlabel().endswith("only the most common regime, 30 of 66 cases: jammed, mode 1")
    within, speed = grid.data["weighted"].sel({"drive.speed": slice(40.0, 79.0)}), [0.01 * 44.0, 0.01 * 76.0]
    assert within.shape == (5, 6) and axis.lines[0].get_xdata()[0] == pytest.approx(within.values.mean())
    bars = {round(bar.get_x() + bar.get_width(), 9) for bar in axis.patches if bar.get_y() < 0.0}
    rest = within.values.mean() - 0.01 * 60.0
    assert bars == {round(rest + each, 9) for each in speed}


@pytest.mark.parametrize(("values", "scale"), [([0.1, 0.2, 2.5], "log"), ([1.0, 2.0, 3.0], "linear"), ([1.0, 9.0], "linear")])
def test_a_list_of_values_selects_the_scale_of_its_axis(values, scale, tmp_path):
    found = jv.sweep(SCENE, {"loads.drag": values}, [Quantity("weighted", "N", weighted)], tmp_path / "s.zarr")
    assert found.plot().axes[0].get_xscale() == scale


def test_a_tornado_shows_what_each_number_does(sampled):
    axis = plot_tornado(sampled.store).axes[0]
    ends = {text.get_text(): [] for text in axis.get_yticklabels()}
    assert list(ends) == ["rotor speed", "drag of each ball"]
    for bar in axis.patches:
        ends[list(ends)[round(bar.get_y() + bar.get_height() / 2.0)]].append(bar.get_x() + bar.get_width())
    # the means of a sum that is linear: at the middles of the lowest and the highest fifth, all else at its own;
    # 600 samples in a fifth are off by about a 600th of the range of the sum
    np.testing.assert_allclose(ends["drag of each ball"], [3.0 * 1.1 + 0.6, 3.0 * 1.9 + 0.6], atol=1e-2)
    np.testing.assert_allclose(ends["rotor speed"], [4.5 + 0.44, 4.5 + 0.76], atol=1e-2)


def test_a_distribution_counts_every_case(sampled):
    axis = plot_distribution(sampled.store).axes[0]
    assert sum(bar.get_height() for bar in axis.patches) == 3000


def test_the_figure_that_fits(sampled, tmp_path):
    assert sampled.plot().axes[0].get_ylabel() == "cases"
    line = jv.sweep(SCENE, {"drive.speed": [40.0, 50.0]}, [Quantity("weighted", "N", weighted)], tmp_path / "s.zarr")
    assert isinstance(line.plot(), Figure) and line.plot().axes[0].get_ylabel() == "weighted, N"
    both = labelled({"drive.speed": [30.0, 50.0, 90.0]}, ("mode", "weighted"), tmp_path / "both.zarr")
    modes, values = both.plot().axes
    assert [text.get_text() for text in modes.get_yticklabels()] == ["not jammed", "jammed, mode 1", "jammed, mode 2"]
    np.testing.assert_allclose(values.lines[0].get_ydata(), both.data["weighted"].values, rtol=1e-12)
    assert results_table(both.store)[1:] == (
        ["rotor speed, rpm", "number", "weighted, N"],
        [["286.48", "not jammed", "4.8"], ["477.46", "jammed, mode 1", "5"], ["859.44", "jammed, mode 2", "5.4"]],
    )


def test_an_absent_quantity_hides_no_other_result(tmp_path):
    root = Quantity("root", "", lambda scene: jnp.sqrt(scene.drive.speed - 40.0))
    asked = study(SCENE, {"drive.speed": [30.0, 56.0, 90.0]}, [Quantity("number", "", number), root], chunk=16)
    found = run_study(dataclasses.replace(asked, names=("mode", "root")), tmp_path / "root.zarr")
    assert dict(found.counts) == {"done": 2, "absent": 1} and dict(found.regimes)["not jammed"] == 1
    assert results_table(found.store)[2][:2] == [["286.48", "not jammed", ""], ["534.76", "jammed, mode 1", "4"]]


def test_whole_numbers_are_stored_without_overflow(tmp_path):
    whole = Quantity("whole", "N/m", lambda scene: (1e3 * scene.drive.speed).astype(int))
    found = jv.sweep(SCENE, {"drive.speed": [30.0, 56.0, 90.0]}, [whole], tmp_path / "whole.zarr")
    assert found.data["whole"].values.tolist() == [30_000, 56_000, 90_000]
    (line,) = found.plot().axes[0].lines
    np.testing.assert_allclose(line.get_ydata(), [30.0, 56.0, 90.0])  # N/mm


def test_a_table_of_many_cases_has_their_range(grid, sampled):
    _, heads, ((name, *weights),) = results_table(grid.store)
    values = grid.data["weighted"].values
    assert heads == ["measure", "least", "median", "largest"] and name == "weighted, N"
    assert weights == [f"{x:.4g}" for x in (values.min(), np.median(values), values.max())]
    counts = [(name, cases / grid.cases) for name, cases in grid.regimes]
    assert counts == [("jammed, mode 1", 5 / 11), ("not jammed", 3 / 11), ("jammed, mode 2", 3 / 11)]
    assert "(45.5 %) jammed, mode 1\n" in grid.summary()
    assert results_table(sampled.store)[0] == "results of 3000 cases"


@pytest.mark.parametrize(
    ("draw", "says"),
    [
        (lambda grid, sampled: plot_map(grid.store, "wieghted"), "measure is 'wieghted'; did you mean 'weighted'"),
        (lambda grid, sampled: plot_map(grid.store, x="drive.sped"), "x is 'drive.sped'; did you mean 'drive.speed'"),
        (lambda grid, sampled: plot_map(grid.store, x="loads.drag", y="loads.drag"), "must be two different axes"),
        (lambda grid, sampled: plot_map(sampled.store), "must be two different axes; this study has: none"),
        (lambda grid, sampled: plot_shares(grid.store, "machine.mass"), "over is 'machine.mass'"),
        (lambda grid, sampled: plot_shares(sampled.store), "over is None"),
    ],
)
def test_what_no_figure_can_show(grid, sampled, draw, says):
    with pytest.raises(jv.InputError, match=says):
        draw(grid, sampled)


def test_theory_lines_are_those_of_the_shown_cases(tmp_path, monkeypatch):
    axes = {"drive.speed": [30.0, 50.0], "loads.drag": [1.0, 2.0], "machine.stiffness": [1e4, 3e4, 2e4]}
    asked, seen = labelled(axes, ("mode",), tmp_path / "three.zarr"), []

    def branches_of(scene):
        seen.append(scene.machine.stiffness.tolist())
        return SimpleNamespace(special=())

    monkeypatch.setattr("jaxvib.sweeps.figures.exact_branches", branches_of)
    plot_map(asked.store)
    assert seen and all(stiffness == [3e4] for stiffness in seen)


def test_theory_lines_have_points_between_uneven_values(tmp_path, monkeypatch):
    axes = {"drive.speed": [30.0, 50.0], "loads.drag": [1.0, 1.1, 1.2, 16.0]}
    asked, seen = labelled(axes, ("mode",), tmp_path / "uneven.zarr"), []

    def branches_of(scene):
        seen.append(float(np.mean(scene.loads.drag)))
        return SimpleNamespace(special=())

    monkeypatch.setattr("jaxvib.sweeps.figures.exact_branches", branches_of)
    plot_map(asked.store)
    np.testing.assert_allclose(seen, np.geomspace(1.0, 16.0, 9))


@pytest.mark.slow
def test_theory_lines_pass_through_the_points_of_the_diagram(grid):
    axis = plot_map(grid.store).axes[0]
    special = jv.branches(SCENE, exact=True).special
    assert any("fold" in text.get_text() for text in axis.get_legend().get_texts()) == any(p.kind == "fold" for p in special)
