"""Every result: status, sentence, text, figure, plain and labelled data, files and back."""

import dataclasses
import itertools
import json
import re
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from small_machine import checked_gradients, small_sweep

import jaxvib as jv
import optimize
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.motion.growth import Growth, GrowthStatus
from jaxvib.motion.run import RunStatus
from jaxvib.results.files import _digest
from jaxvib.results.result import Result
from jaxvib.results.status import Computed, failure, is_status, member, sentence, status_name, status_names
from jaxvib.runtime.compat import enumeration_names, enumeration_of
from jaxvib.steady.balance.speeds import characteristic_speeds
from jaxvib.steady.balance.states import balanced_stability
from jaxvib.steady.jams.phase_search import phase_branch
from jaxvib.steady.orbits.diagram import SpecialPoint
from jaxvib.steady.response import OperatingPoints, TorqueFolds
from jaxvib.study.accuracy.cost import CostRow
from jaxvib.study.accuracy.harmonics import HarmonicConvergence
from jaxvib.study.accuracy.tiers import Tiers, TierValues
from jaxvib.study.audit.audit import AuditStatus
from jaxvib.study.audit.compared import EffectRow
from jaxvib.study.audit.numbers import NumberRow
from jaxvib.study.audit.tiers import TierRow
from jaxvib.study.capture.capture import _summarize_captures
from jaxvib.study.capture.curve import ThresholdCurve
from jaxvib.study.maps.run_up_map import RunUpMap
from jaxvib.study.maps.stability_onset import StabilityMap
from optimize.pareto import Front
from optimize.result import Influence, Limit, Machine, Outcome, Row, Synthesis, SynthesisStatus, Unresolved

MACHINE = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
SCENE = jv.Scene(MACHINE, jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25), jv.ConstantSpeed("60 rad/s"))
ROTOR = jv.Scene(
    jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0),
    jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04),
    jv.ConstantSpeed(460.0),
)
SCREEN = jv.Scene(
    jv.plane_body(
        mass=300.0,
        inertia=75.0,
        supports=[jv.support(at=(x, 0.0), stiffness=(3e3, 3e3), damping=(150.0, 150.0)) for x in (-0.6, 0.6)],
    ),
    exciters=[
        jv.Exciter(drive=jv.InductionMotor(100.0, 60.0, 0.1, 0.05), unbalance=0.4, at=(x, 0.0), direction=way)
        for x, way in ((-0.6, 1), (0.6, -1))
    ],
)
ROD = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.00625)


def at_speed(n):
    return eqx.tree_at(lambda s: s.drive.speed, SCENE, n)


def swung():
    return jv.swing(ROD, np.arange(0.0, 15.0, 0.04), angle="25 deg", viscous=1.5e-3)


def identified():
    run = swung()
    noise = 0.002 * np.random.default_rng(0).normal(size=run.time.size)
    return jv.identify(ROD, jv.Record(run.time, np.asarray(run.angle) + noise))


def run_up_map():
    regime = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (2, 3, *leaf.shape)), RESULTS["Run"]().regime)
    kind = np.asarray([["jammed"] * 3, ["failed", "jammed", "balanced"]])
    return RunUpMap(np.array([0.1, 1.0]), np.zeros((3, 2)), regime, kind, np.full((2, 3), 5.0), kind != "failed")


def tiers():
    light = TierValues(np.array([5.0, np.nan]), np.ones((2, 1)), np.ones(2), np.array([True, False]), ("there", "absent"))
    return Tiers(np.array([0.1, 1.0]), light, eqx.tree_at(lambda t: t.omega, light, np.array([5.1, 5.2])))


def synthesis():
    outcome = Outcome({"machine.stiffness": [4e4]}, True, 27.0, (1e-3,), 100.0, 1e5)
    rest = dict(unverified="not requested", starts=2, drawn=9, converged=1, same=1, objective="amplitude", unit="m")
    found = dict(designs=np.zeros((2, 1)), values=np.ones(2), done=np.array([True, False]))
    found |= dict(history=np.ones((3, 2)), history_violation=np.zeros((3, 2)))
    told = dict(
        status=SynthesisStatus.done,
        kkt=1e-9,
        table=(Row("stiffness of the support", "N/m", 4e4, 5e4, float("nan"), float("nan")),),
        limits=(Limit("power drawn, mode 1 at most 50 W", "W", 50.0, 50.0, 0.0, True, -0.1, -0.1),),
        influences=(Influence("stiffness of the support", -1.0, 1.0),),
        unresolved=(Unresolved("largest foundation force of a run from rest", 0.1, 0.4),),
        machines=(Machine(1, 1e-3, (5e4,)), Machine(1, 2e-3, (4e4,))),
    )
    return Synthesis(scene=SCENE, before=outcome, after=outcome, verified=None, run=None, **rest, **found, **told)


def audited():
    rows = [
        EffectRow("gravity", True, "exact orbit", 0.1, 0.2, np.nan, 1e-3, 1e-9, 14, 0.1, 0.2, "needed", ""),
        EffectRow("stop", False, "full", 1e-5, 0.0, 0.0, np.nan, 1e-9, 60, np.nan, np.nan, "negligible", "as given"),
    ]
    tiers = [TierRow("leading order", False, *[np.nan] * 5, note="refused"), TierRow("full", True, *[1e-3] * 5, note="all")]
    numbers = [NumberRow("lift: R / (M g)", 2.0, 1.0, "perhaps needed", "springs would have to pull")]
    own = dict(kind="jam mode 1", omega=27.0, amplitude=np.ones(1), foundation_force=9.0, fold=90.0, coordinates=("y1",))
    cost = dict(operations=200, seconds=0.1, compile=2.0, effects=rows, tiers=tiers, numbers=numbers)
    return jv.Audit(status=AuditStatus.done, accuracy=0.01, motion="jam mode 1 at 60 rad/s", **own, **cost)


def cached(make):
    made = []

    def one():
        return made[0] if made else made.append(make()) or made[0]

    return one


def measured_run():
    t, frame = np.arange(0.0, 10.0, 0.005), jv.Channel("frame", "acceleration", at=1)
    return jv.MeasuredRun.from_arrays([frame], t, {"frame": np.random.default_rng(0).normal(size=t.size)})


def machine_fit():
    scene = jv.Scene(MACHINE, exciters=[jv.Exciter(drive=jv.RunUp(60.0, acceleration=6.0), unbalance=0.05)])
    return jv.identify(scene, measured_run(), unknown=["machine.stiffness", "machine.damping"], throw=False)


RESULTS = {
    "Run": cached(lambda: jv.simulate(SCENE, 2.0, start="jam", mode=1, samples=32)),
    "Regime": lambda: RESULTS["Run"]().regime,
    "Ensemble": lambda: jv.ensemble(at_speed, jnp.linspace(40.0, 80.0, 3), 1.0, stepsize_controller=jv.EqualSteps(64)),
    "EnsembleRegimes": lambda: (
        jv.ensemble(
            lambda n: eqx.tree_at(lambda s: s.exciters[1].drive.speed, SCREEN, n),
            jnp.array([90.0, 100.0]),
            1.0,
            stepsize_controller=jv.EqualSteps(400),
            estimate=False,
        ).regimes
    ),
    "Envelope": lambda: jv.envelope(SCENE, 2.0, samples=16),
    "MotorRunUp": lambda: jv.run_up(SCREEN, 2.0),
    "JamModes": cached(lambda: jv.jam_modes(SCENE)),
    "Jam": lambda: RESULTS["JamModes"]().select(1),
    "DragLimits": cached(lambda: jv.drag_limits(SCENE)),
    "Branches": lambda: jv.branches(SCENE, points=50),
    "ModeShapes": lambda: jv.mode_shapes(SCENE),
    "Spectrum": lambda: RESULTS["Run"]().spectrum(),
    "ExactBranches": lambda: jv.branches(SCENE, exact=True, points=20),
    "Orbit": lambda: jv.jam_orbit(SCENE, mode=1),
    "PhaseJams": cached(lambda: jv.phase_jams(ROTOR, starts=4)),
    "PhaseJam": lambda: RESULTS["PhaseJams"]().select(0),
    "SynchronousRegimes": cached(lambda: jv.synchronous_regimes(SCREEN)),
    "SynchronousRegime": lambda: RESULTS["SynchronousRegimes"]().select(0),
    "RegimePartitions": lambda: jv.RegimePartitions(
        status=jv.RegimeSearchStatus.done,
        group=np.array([[0, 1]]),
        speed=np.array([[100.0, 60.0]]),
        phases=np.zeros((1, 2)),
        growth=np.array([-1.0]),
        stable=np.array([True]),
        interaction=np.array([0.1]),
        scene=SCREEN,
    ),
    "Deck": lambda: RESULTS["SynchronousRegime"]().deck([(-1.0, 0.2), (1.0, 0.2)]),
    "SynchronousOrbit": cached(lambda: jv.synchronous_orbit(SCREEN, RESULTS["SynchronousRegime"]())),
    "SynchronizationLimit": lambda: jv.synchronization_limit(
        SCREEN, RESULTS["SynchronousRegime"](), over="exciters[1].drive.speed"
    ),
    "PhaseBranch": lambda: phase_branch(ROTOR, RESULTS["PhaseJams"]().select(0), jnp.array([150.0, 172.0])),
    "CharacteristicSpeeds": lambda: characteristic_speeds(SCENE),
    "Criterion": lambda: jv.criterion(SCENE),
    "CriterionMap": lambda: jv.criterion_map(SCENE, speeds=[20.0, 60.0], mass=[0.1, 2.0], drag=[1.0], steps=24),
    "BalancedStates": lambda: jv.balanced_states(SCENE),
    "BalancedStability": lambda: balanced_stability(SCENE),
    "Whirl": lambda: jv.whirl(ROTOR, [100.0, 460.0]),
    "CriticalSpeeds": lambda: jv.critical_speeds(ROTOR),
    "Swing": swung,
    "Identified": cached(identified),
    "MachineFit": cached(machine_fit),
    "RunPlan": lambda: jv.plan_runs(
        RESULTS["MachineFit"](),
        [
            jv.PlannedRun(
                "slow", jv.RunUp(60.0, acceleration=6.0), "10 s", [jv.Channel("frame", "acceleration", at=1)], rate=200.0
            )
        ],
    ),
    "RunPrediction": lambda: jv.predict_run(RESULTS["MachineFit"](), measured_run()),
    "Decrement": lambda: RESULTS["Identified"]().decrement,
    "Response": lambda: jv.response(SCREEN, np.linspace(50.0, 110.0, 7)),
    "RunUpMap": run_up_map,
    "Capture": lambda: _summarize_captures(
        np.array([-0.5, -0.2]), np.array([[False] * 3, [True] * 3]), np.ones((2, 3), bool), np.eye(2, 3, dtype=bool), 150, 7200
    ),
    "ThresholdCurve": lambda: ThresholdCurve(
        *np.array([[1.0, 2.0], [-0.6, np.nan], [1e-3, np.nan], [-0.7, -0.2], [0.0, np.inf], [1.0, 0.0]]), turns=np.asarray(2000)
    ),
    "Growth": lambda: Growth(member(GrowthStatus, "chaotic"), 0.1, 0.02, 360.0, np.array([0.2, 0.0, 0.1, 0.1]), np.arange(4.0)),
    "Tiers": tiers,
    "HarmonicConvergence": lambda: HarmonicConvergence(
        np.array([5.0]), np.array([3, 5]), np.array([[1e-3], [1e-5]]), np.array([[2e-3], [2e-5]])
    ),
    "StabilityMap": lambda: StabilityMap(
        np.array([0.1, 0.2]), np.array([[1.0, 2.0, 3.0]] * 2), np.ones((2, 3), bool), ((), (SpecialPoint("torus", 1.0, 2.0),))
    ),
    "Cost": lambda: jv.Cost("amplitude", [1.0], 1e-9, [CostRow("full", "Tsit5", "float64", "1e-3", 1e-3, 0.1, 1.0)] * 2),
    "Audit": audited,
    "GradientCheck": checked_gradients,
    "Sweep": cached(lambda: small_sweep(SCENE)),
    "Synthesis": synthesis,
    "Front": lambda: Front(np.array([[1.0, 2.0], [2.0, 1.0]]), ("force", "power"), ("N", "W"), (jv.scene_to_toml(SCENE),) * 2),
}

# fmt: off
SEVERAL_PANELS = ["Run", "Envelope", "MotorRunUp", "JamModes", "Jam", "Branches", "ExactBranches", "Orbit", "CriterionMap",
                  "BalancedStates", "Response", "Swing", "Identified", "MachineFit", "RunPrediction", "RunUpMap",
                  "SynchronousRegimes", "SynchronousOrbit"]
# fmt: on


@pytest.fixture(scope="module", params=list(RESULTS))
def result(request):
    return RESULTS[request.param]()


def alike(one, other):
    """The same classes with the same values, bit for bit: arrays of JAX stay arrays of JAX, with their type."""
    assert type(one) is type(other)
    if is_status(one):
        assert enumeration_of(one) is enumeration_of(other)
        np.testing.assert_array_equal(status_names(one), status_names(other))
    elif isinstance(one, (jax.Array, np.ndarray, np.generic)):
        assert one.dtype == other.dtype and one.shape == other.shape
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()
    elif dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            alike(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, dict):
        alike(list(one.items()), list(other.items()))
    elif isinstance(one, (tuple, list)):
        assert len(one) == len(other)
        for mine, its in zip(one, other, strict=True):
            alike(mine, its)
    else:
        assert one == other or (one != one and other != other)


def test_speaks(result):
    assert isinstance(result.message, str) and " " in result.message and "<" not in result.message
    assert result.summary().strip() and "Array(" not in result.summary() and isinstance(result.plot(), Figure)


def drawn_points(axes):
    """Points (n, 2) of the lines, areas and cells of axes, as fractions of the axes, without those that have no place there."""
    lines = [line.get_xydata() for line in axes.lines if line.get_transform() == axes.transData]
    for points in (*lines, *(each.get_datalim(axes.transData).corners() for each in axes.collections)):
        points = np.asarray(points, float)
        is_drawn = np.all(np.isfinite(points), axis=1)
        for k, scale in enumerate((axes.get_xscale(), axes.get_yscale())):
            is_drawn &= (scale != "log") | (points[:, k] > 0.0)
        yield axes.transLimits.transform(axes.transScale.transform(points[is_drawn]))


def test_figures_cut_neither_points_nor_texts(result):
    """Axes of some figures end where the rest has no meaning."""
    figure, cropped = result.plot(), ("Branches", "ExactBranches", "PhaseJams", "Whirl", "Response")
    figure.canvas.draw()
    drawn = figure.get_tightbbox().get_points()  # of all texts, legends and axes
    assert np.all(drawn >= -0.01) and np.all(drawn <= figure.get_size_inches() + 0.01)
    if type(result).__name__ not in cropped:
        for points in itertools.chain.from_iterable(map(drawn_points, figure.axes)):
            assert np.all((points > -1e-6) & (points < 1.0 + 1e-6))


def test_every_array_has_a_unit(result):
    """Tables, labelled data and stores of studies name units and axes by it."""
    fields = dataclasses.fields(result) if dataclasses.is_dataclass(result) else ()
    bare = [
        each.name for each in fields if isinstance(getattr(result, each.name), (jax.Array, np.ndarray)) and not each.metadata
    ]
    assert not bare


def test_a_figure_of_one_panel_goes_onto_given_axes(result):
    if type(result).__name__ in SEVERAL_PANELS:
        many = len([axes for axes in result.plot().axes if axes.axison or axes.has_data()])
        given = np.atleast_1d(Figure().subplots(1, many))
        assert result.plot(ax=given) is given and all(axes.has_data() for axes in given)
        with pytest.raises(jv.InputError, match=f"{many + 1} axes; this figure has {many} panels"):
            result.plot(ax=[*given, given[0]])
        return
    axes = Figure().subplots(1, 2)
    assert result.plot(ax=axes[1]) is axes[1]
    assert axes[1].has_data() and not axes[0].has_data() and len(axes[0].figure.axes) == 2


def test_speeds_are_drawn_in_the_unit_that_is_asked_for(result):
    if "unit" in (type(result).plot.__kwdefaults__ or {}):
        for unit, other in (("rpm", "rad/s"), ("Hz", "rpm")):
            told = [f"{x.get_xlabel()} {x.get_ylabel()} {x.get_xticklabels()}" for x in result.plot(unit=unit).axes]
            assert unit in " ".join(told) and other not in " ".join(told)
        with pytest.raises(jv.InputError, match="unit is 'turns'; it must be one of"):
            result.plot(unit="turns")


def test_representation_is_the_summary_and_html_has_the_figure(result):
    assert repr(result) == result.summary()
    assert result._repr_html_().startswith("<pre>") and "data:image/png;base64," in result._repr_html_()


def test_representation_of_a_batch_shows_values():
    batch = jax.vmap(lambda n: jv.jam_modes(at_speed(n)))(jnp.array([40.0, 60.0]))
    rpm = 30.0 / np.pi * np.asarray(batch.omega)
    rows = ", ".join(f"[{', '.join(f'{x:.5g}' for x in row)}]" for row in rpm)
    assert repr(batch).startswith("JamModes:") and f"\n  omega: {rows} rpm\n" in repr(batch)
    assert "<img" not in batch._repr_html_()


def test_parts_of_results_show_values_with_units():
    motor = jv.DCMotor("1500 rpm", stall_torque=12.0, inertia=0.1)
    scene = jv.Scene(jv.one_mass(mass=200.0, stiffness=8e5, damping=600.0), exciters=[jv.Exciter(drive=motor, unbalance=0.2)])
    found = jv.response(scene)
    speeds = ", ".join(f"{30.0 / np.pi * float(w):.5g}" for w in found.operating.speed)
    assert f"\n  speed: {speeds} rpm\n" in repr(found.operating) and "f64[" not in repr(found.operating) + repr(found.folds)
    shown = []
    jax.jit(lambda x: shown.append(repr(jv.State(x, x, angle=(x,), rate=(x,)))))(jnp.zeros(2))
    assert "displacement=f64[2]" in shown[0]  # a traced object has no values


def test_every_public_class_with_arrays_shows_values():
    """Classes of parts of scenes, results and their parts, and inputs; not those of integration methods."""
    public = [getattr(package, name) for package in (jv, optimize) for name in package.__all__]
    classes = {each for each in public if isinstance(each, type) and issubclass(each, eqx.Module)}
    for each in list(classes):
        hints = " ".join(str(field.type) for field in dataclasses.fields(each))
        module = vars(sys.modules[each.__module__])
        classes |= {
            value for name, value in module.items() if re.search(rf"\b{name}\b", hints)
            and isinstance(value, type) and issubclass(value, eqx.Module)
        }  # fmt: skip
    assert {jv.State, jv.Run, Trajectory, OperatingPoints, TorqueFolds} <= classes
    shapes = {each.__name__ for each in classes if each.__repr__ is eqx.Module.__repr__}
    assert shapes == set()


def test_pandas_table_has_a_row_for_each_point(result):
    data = result.to_xarray()
    if any(data[name].dims for name in data.data_vars):
        table = result.to_pandas()
        assert len(table) in data.sizes.values() and len(table.columns)
    with pytest.raises(jv.InputError, match="axis is 'nowhere'; the axes of"):
        result.to_pandas("nowhere")


def test_pandas_table_of_jam_modes_holds_their_numbers():
    modes = RESULTS["JamModes"]()
    table = modes.to_pandas("mode")
    np.testing.assert_array_equal(table["omega (rad/s)"], modes.omega)
    np.testing.assert_array_equal(table["amplitude y1 (m)"], modes.amplitude[:, 0])


def test_plain_data_is_json(result):
    plain = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    assert plain["message"] == result.message
    assert set(plain) >= set(type(result).__dataclass_fields__)


def test_labelled_data_has_units_and_names(result):
    data = result.to_xarray()
    assert data.sizes and data.attrs["result"] == type(result).__name__ and data.attrs["message"] == result.message
    assert not [axis for axis in data.dims if str(axis).startswith("batch")]
    for field in type(result).__dataclass_fields__.values():
        value = getattr(result, field.name)
        if isinstance(value, (jax.Array, np.ndarray)) and value.ndim:
            assert (field.metadata.get("name") or field.name) in data
        if field.metadata.get("unit") and isinstance(value, (jax.Array, np.ndarray)):
            name = field.metadata["name"] or field.name
            assert data[name].attrs["units"] in (field.metadata["unit"], *field.metadata["unit"].split(" or "))
            np.testing.assert_array_equal(data[name].values, np.asarray(value))


def test_file_and_back_is_bit_for_bit(result, tmp_path):
    path = result.save(tmp_path / "answer")
    assert path.suffix == ".npz"
    alike(jv.load(path), result)
    assert (jv.load(path) == result) is True
    with jax.enable_x64(False):  # single precision, which could not hold them
        alike(type(result).load(path), result)
    other = "Orbit" if type(result) is jv.Jam else "Jam"
    with pytest.raises(jv.InputError, match=f"it contains a result of class .*, not {other}|not a result"):
        (jv.Orbit if type(result) is jv.Jam else jv.Jam).load(path)


def test_results_are_equal_if_all_fields_are():
    def with_speeds(change):
        return eqx.tree_at(lambda m: m.omega, RESULTS["JamModes"](), change(RESULTS["JamModes"]().omega))

    one = with_speeds(lambda omega: omega.at[0].set(jnp.nan))
    assert one == with_speeds(lambda omega: omega.at[0].set(jnp.nan))
    assert one != with_speeds(lambda omega: omega) and one != with_speeds(lambda omega: omega[1:]) and one != "modes"
    assert bool(jax.jit(lambda a: with_speeds(lambda _: a) == with_speeds(lambda _: 1.0 * a))(one.omega[1:]))


def test_every_result_class_is_final_and_is_in_this_file():
    def below(kind):
        return {kind, *(each for sub in kind.__subclasses__() for each in below(sub))}

    assert all(hasattr(jv, name) for name in jv.__all__)  # imports them
    concrete = {kind for kind in below(Result) if not kind.__abstractmethods__}
    own = {kind for kind in concrete if kind.__module__.split(".")[0] in ("jaxvib", "optimize")}
    assert {kind.__name__ for kind in own} == set(RESULTS)
    assert not [kind for kind in own if set(kind.__mro__[1:]) & own]


def test_loads_of_a_single_exciter_have_no_numbered_axis():
    run = RESULTS["Run"]().to_xarray()
    assert run.angle.dims == ("time", "load") and run.window_rate.dims == ("window_time", "load")


def test_units_of_coordinates_and_labels():
    data = RESULTS["JamModes"]().to_xarray()
    assert data.amplitude.dims == ("mode", "coordinate") and data.amplitude.attrs["units"] == "m"
    assert data.mode.values.tolist() == [1, 2, 3] and data.fold_omega.dims == ("fold",)
    data = RESULTS["Run"]().to_xarray()
    assert data.displacement.attrs["units"] == "m" and data.displacement.dims == ("time", "coordinate")
    assert data.coordinate.values.tolist() == ["y1"] and data.unit.values.tolist() == ["m"]
    assert data.window_displacement.sizes["window_time"] == 4096 and data.foundation_force_amplitude.dims == ()
    many = jax.vmap(jv.jam_modes)(jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), SCENE))
    assert many.to_xarray().amplitude.dims == ("batch", "mode", "coordinate")
    assert RESULTS["JamModes"]().message.count(" of 3)") >= 1


def test_batch_of_runs_has_its_own_axis():
    run = RESULTS["Run"]()
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, 2.0 * leaf]) if leaf.dtype == float else jnp.stack([leaf, leaf]), run)
    data = batch.to_xarray()
    assert data.displacement.dims == ("batch", "time", "coordinate") and data.coordinate.values.tolist() == ["y1"]
    for name in ("largest_displacement", "largest_force", "largest_displacement_time", "largest_force_time"):
        one = getattr(run, name)
        np.testing.assert_allclose(getattr(batch, name), jnp.stack([one, 2.0 * one]), rtol=1e-12)
    one = run.point().largest_displacement
    moved = jax.tree.map(lambda leaf: jnp.stack([leaf, 2.0 * leaf]), run.point())
    np.testing.assert_allclose(moved.largest_displacement, [one, 2.0 * one], rtol=1e-12)
    with pytest.raises(jv.InputError, match=r"^result contains a scene that load could not read; for a batch of results, save"):
        batch.save("runs")
    averaged = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), RESULTS["Envelope"]())
    full = (batch.summary, batch.plot, batch.spectrum, batch.ellipse, batch.point, lambda: batch.regime)
    for ask in (*full, averaged.summary, averaged.plot, averaged.ellipse):
        with pytest.raises(jv.InputError, match=r"^run is a batch of runs of shape \(2,\); take one of them"):
            ask()


def test_plain_data_of_statuses_complex_and_infinite_numbers():
    plain = RESULTS["JamModes"]().as_dict()
    assert set(plain["status"]) <= set(enumeration_names(jv.JamStatus)) and len(plain["status"]) == 3
    real, imaginary = plain["displacement"][0][0]
    assert complex(real, imaginary) == RESULTS["JamModes"]().displacement[0, 0]
    assert RESULTS["Criterion"]().as_dict()["balancing"][-1][1] is None
    assert RESULTS["Run"]().as_dict()["scene"].startswith("[machine]")


def test_names_of_statuses():
    assert status_name(RunStatus.no_step) == "no_step" and sentence(Computed.done) == "the result was computed"
    several = member(RunStatus, [["done", "no_start"], ["done", "done"]])
    assert status_names(several).tolist() == [["done", "no_start"], ["done", "done"]]
    assert status_names(member(RunStatus, np.zeros((0, 2), dtype=str))).shape == (0, 2)
    assert sentence(several) == f"{RunStatus[RunStatus.done]} (3 of 4); {RunStatus[RunStatus.no_start]} (1 of 4)"
    assert str(failure(RunStatus.no_start, "; look")) == f"no_start: {RunStatus[RunStatus.no_start]}; look"
    with pytest.raises(TypeError, match="has no name yet"):
        jax.jit(lambda x: status_name(RunStatus.where(x, RunStatus.done, RunStatus.no_start)))(True)


def test_a_file_alone_is_enough(tmp_path):
    path = RESULTS["JamModes"]().save(tmp_path / "modes.npz")
    code = f"import jaxvib as jv; print(type(jv.load({str(path)!r})).__name__)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "JamModes"


@pytest.mark.parametrize(
    ("layout", "says"),
    [
        ('{"class": "os:path", "fields": {}}', "it is not a result written by save"),
        ('{"class": "jaxvib.motion.run:simulate", "fields": {}}', "it is not a result written by save"),
        ('{"class": "jaxvib.motion.run:np", "fields": {}}', "it is not a result written by save"),
        ('{"class": "jaxvib.steady.jams.jam:JamModes", "fields": {}}', "it is not a result written by save"),
        ('{"array": "gone", "kind": "jax"}', "it is not a result written by save"),
        ("{", "it is not a result written by save"),
    ],
)
def test_files_that_hold_something_else(tmp_path, layout, says):
    np.savez(tmp_path / "other.npz", result=np.asarray(layout))
    with pytest.raises(jv.InputError, match=says):
        jv.load(tmp_path / "other.npz")


def test_a_class_that_moved_is_found_by_its_public_name(tmp_path):
    path = RESULTS["JamModes"]().save(tmp_path / "modes")
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    layout = str(arrays.pop("result")).replace("jaxvib.steady.jams.jam:", "jaxvib.steady.elsewhere:")
    arrays["digest"] = np.asarray(_digest(layout, {name: array for name, array in arrays.items() if name != "digest"}))
    np.savez(path, result=np.asarray(layout), **arrays)
    alike(jv.load(path), RESULTS["JamModes"]())


def test_jams_and_arrangements_answer_further_questions():
    jams = RESULTS["PhaseJams"]()
    jam = jams.select(jams.omega.shape[0] - 1)
    near = jv.phase_jams(ROTOR, near=(jam.omega * 1.001, jam.phase))
    np.testing.assert_allclose(near.omega, jam.omega, rtol=1e-9)
    branch = jams.follow(jams.omega.shape[0] - 1, jnp.array([float(jam.omega), 172.0]))
    np.testing.assert_allclose(branch.drag_factor[0], 1.0, rtol=1e-9)
    states = jv.balanced_states(SCENE)
    alike(states.stability(), balanced_stability(SCENE, states.angles[0]))
    (interval,) = states.intervals(29.0, 60.0, points=16)
    assert (states.growth([25.0, 50.0]) < 0.0).tolist() == [False, True] and interval[1] == 60.0
    alone = jv.balanced_states(jv.Scene(MACHINE, jv.balls(count=1, mass=0.25, radius=0.1, drag=0.25), SCENE.drive))
    with pytest.raises(jv.ComputationError, match="alone: a single load has no other load to cancel it"):
        alone.stability()


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda: jv.envelope(SCENE, 1.0, stepsize_controller=jv.EqualSteps(9)), "must be a Tolerance or an Abstract"),
        (lambda: jv.ensemble(at_speed, jnp.ones(2), 1.0, stepsize_controller=jv.Tolerance(1e-6)), "must be an EqualSteps"),
        (
            lambda: jv.swing(ROD, [0.0, 1.0], angle=0.1, viscous=0.0, stepsize_controller=9),
            "stepsize_controller is 9; it must be",
        ),
    ],
)
def test_former_spellings_and_other_choices_of_steps_are_refused(ask, says):
    with pytest.raises(jv.InputError, match=says):
        ask()


def test_places_that_cannot_be_written_to(tmp_path):
    (tmp_path / "folder.npz").mkdir()
    missing = r"cannot be written \(its folder does not exist\); create the folder first"
    for name, why in (("folder", r"cannot be written \(Is a directory\); name another file"), ("missing/file", missing)):
        with pytest.raises(jv.InputError, match=f"path is .* {why}"):
            RESULTS["Run"]().save(tmp_path / name)
    with pytest.raises(jv.InputError, match="cannot be written"):
        jv.save_scene(SCENE, tmp_path)


def test_what_no_file_can_hold():
    odd = eqx.tree_at(lambda cost: cost.quantity, RESULTS["Cost"](), print)
    with pytest.raises(jv.InputError, match="which cannot be saved"):
        odd.save("never_written")
