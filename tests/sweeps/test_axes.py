"""Axes, samples and the grid of cases."""

import dataclasses
import itertools
import json

import jax.numpy as jnp
import numpy as np
import pint
import pytest
from scenes import BALLS, ROTOR, scene

import jaxvib as jv
from jaxvib.sweeps.axes import Axis, Grid, Target, axis_of, put_start, put_values, samples, tile_of
from jaxvib.sweeps.study import study
from optimize import jam_frequency

SCENE = scene("one_mass", "balls", speed=60.0)
MEASURE = [jam_frequency(mode=1)]
SPEED = {"drive.speed": [50.0, 60.0]}


def asked(axes=SPEED, measure=MEASURE, **more):
    return study(SCENE, axes, measure, **more)


@pytest.mark.parametrize("sampling", ["random", "low_discrepancy"])
def test_a_sample_does_not_depend_on_the_range_that_is_drawn(sampling):
    whole = samples(0, 500, 5, 3, sampling)
    assert whole.shape == (500, 5) and np.all((whole >= 0.0) & (whole < 1.0))
    np.testing.assert_array_equal(whole[123:300], samples(123, 300, 5, 3, sampling))
    assert not np.any(whole == samples(0, 500, 5, 4, sampling))


def test_low_discrepancy_is_low_and_keeps_its_digits():
    def worst_gap(sampling):
        """Between the share of samples below x and x itself."""
        drawn = np.sort(samples(0, 2000, 1, 0, sampling)[:, 0])
        return np.max(np.abs(np.arange(1, 2001) / 2000 - drawn))

    assert worst_gap("low_discrepancy") < 2e-3 < 0.3 * worst_gap("random")
    # by whole numbers of any length, the golden ratio among them to 2^-64
    far, golden = 10**12, int(((5**0.5 + 1) / 2) ** -1.0 * 2.0**64)
    begin = int(np.random.Philox(key=0).random_raw(1)[0])
    assert samples(far, far + 1, 1, 0, "low_discrepancy")[0, 0] == ((begin + far * golden) % 2**64 >> 11) * 2.0**-53


def test_axes_of_quantities_with_units_equal_those_of_texts():
    hertz = pint.get_application_registry().hertz
    pairs = [
        ([9.0 * hertz, 12.0], ["9 Hz", 12.0]),
        ({"from": 9.0 * hertz, "to": 12.0 * hertz, "count": 3}, {"from": "9 Hz", "to": "12 Hz", "count": 3}),
    ]
    for given, text in pairs:
        found, expected = asked({"drive.speed": given}), asked({"drive.speed": text})
        np.testing.assert_allclose(found.grid.values(0), expected.grid.values(0), rtol=1e-15)
        assert "9.0 hertz" in json.dumps(found.record)


def test_every_case_is_in_one_chunk_with_its_numbers():
    axes = {"drive.speed": [1.0, 2.0, 3.0, 4.0, 5.0], "loads.drag": {"from": 0.1, "to": 10.0, "count": 3, "scale": "log"}}
    sampled = {"machine.mass": {"from": 40.0, "to": 60.0}}
    found = tuple(axis_of(SCENE, name, spec) for name, spec in (axes | sampled).items())
    grid = Grid(found, 7, 1, "random", ())
    grid = grid._replace(tile=tile_of(grid.shape, 12))
    seen = np.full((*grid.shape, 3), np.nan)
    for chunk in range(grid.chunks):
        region = grid.region(chunk)
        assert np.all(np.isnan(seen[region]))
        seen[region] = grid.values(chunk).reshape(*(s.stop - s.start for s in region), 3)
    masses = 40.0 + 20.0 * samples(0, 7, 1, 1, "random")[:, 0]
    expected = list(itertools.product([1.0, 2.0, 3.0, 4.0, 5.0], [0.1, 1.0, 10.0], masses))
    np.testing.assert_allclose(seen.reshape(-1, 3), expected, rtol=1e-15)
    assert grid.dims == ("drive.speed", "loads.drag", "sample") and np.prod(grid.tile) <= 12


def test_tiles_have_nearly_equal_sizes_below_the_limit():
    assert tile_of((200, 200), 1024) == (5, 200)
    assert tile_of((10**6,), 16384) == (16130,)
    assert tile_of((7, 5, 3), 1) == (1, 1, 1)
    assert tile_of((2, 2), 1000) == (2, 2)


def test_values_are_put_into_the_named_numbers():
    given = scene("two_mass", "balls")
    names = ["machine.stiffness[1]", "loads.drag", "start.rate[2]", "start.angle", "start.velocity"]
    targets = [axis_of(given, name, [1.0, 2.0]).target for name in names]
    values = np.array([7e4, 2.5, 30.0, 0.4, -0.1])
    moving = dataclasses.replace(jv.initial_state(given), velocity=jnp.asarray([0.3, 0.7]))
    put_in, state = put_values(given, targets, values), put_start(moving, targets, values)
    assert put_in.machine.stiffness.tolist() == [5e4, 7e4] and float(put_in.loads.drag) == 2.5
    assert state.rate[0].tolist() == [0.0, 0.0, 30.0] and np.allclose(state.angle[0], 0.4 + np.deg2rad([-1.0, 0.0, 1.0]))
    assert state.velocity.tolist() == [-0.1, -0.1] and state.displacement.tolist() == [0.0, 0.0]


def test_an_axis_of_a_tilt_has_the_unit_rad():
    tilting = jv.Scene(jv.rotor(**ROTOR), jv.balls(**BALLS), jv.ConstantSpeed(120.0))
    units = {name: axis_of(tilting, name, [0.1]).unit for name in ("start.displacement[1]", "start.displacement[2]")}
    assert units == {"start.displacement[1]": "m", "start.displacement[2]": "rad"}
    assert axis_of(tilting, "start.velocity[3]", ["1 deg/s"]).unit == "rad/s"
    with pytest.raises(jv.InputError, match=r"axes.start.velocity sets displacements and rotations to one number"):
        axis_of(tilting, "start.velocity", [0.1])


def test_an_axis_of_an_array_adds_no_spring():
    machine = jv.two_mass(mass=(50.0, 40.0), stiffness=(4e4, 0.0), damping=(0.0, 0.0), link_stiffness=1e5, link_damping=60.0)
    given = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed("400 rpm"))
    axis = axis_of(given, "machine.stiffness", [1e4, 2e4])
    assert put_values(given, (axis.target,), np.array([2e4])).machine.stiffness.tolist() == [2e4, 0.0]
    with pytest.raises(jv.InputError, match=r"axes\.machine\.damping is 0 in every entry"):
        axis_of(given, "machine.damping", [1.0, 2.0])


RUN = ["run.mode"]


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (dict(axes={}), "axes is empty; name at least one parameter"),
        (dict(axes={"drive.sped": [1.0]}), "is not a parameter of this scene; did you mean 'drive.speed'"),
        (dict(axes={"start.rat": [1.0]}), "is not a parameter of the initial state; did you mean 'start.rate'"),
        (dict(axes={"start.rate[3]": [1.0]}), "start.rate has 3 entries"),
        (
            dict(axes={"machine.mass": [40.0], "machine.mass[0]": [50.0]}),
            r"changes a parameter that axes.machine.mass also changes",
        ),
        (
            dict(axes={"start.rate": [1.0], "start.rate[1]": [2.0]}, measure=RUN, until=1.0),
            r"axes.start.rate\[1\] changes a parameter",
        ),
        (dict(axes={"drive.speed": [60.0, 60.0]}), "has a value twice"),
        (dict(axes={"drive.speed": ["3 kg"]}), "which is not in rad/s"),
        (dict(axes={"drive.speed": [-3.0]}), "must be greater than 0"),
        (dict(axes={"drive.speed": 60.0}), "give a list of values, or a table"),
        (dict(axes={"drive.speed": {"from": 1.0, "to": 2.0, "steps": 3}}), "steps is not a field of an axis"),
        (dict(axes={"drive": {"speed": [1.0]}}), "is not a parameter of this scene"),
        (dict(axes={"drive.speed": {"from": 1.0}}), "to is missing"),
        (dict(axes={"drive.speed": {"from": 2.0, "to": 1.0, "count": 3}}), "has from = 2 and to = 1"),
        (dict(axes={"drive.speed": {"from": 1.0, "to": 2.0, "count": -3}}), "count is -3; it must be a whole number"),
        (dict(axes={"drive.speed": {"from": 1.0, "to": 2.0, "scale": "ln"}}), "scale is 'ln'; it must be 'even' or 'log'"),
        (dict(axes={"loads.drag": {"from": 0.0, "to": 2.0, "scale": "log"}}), "must be greater than 0 for the scale"),
        (dict(axes={"drive.speed": {"from": 1.0, "to": 2.0}}), "give samples, or a count"),
        (dict(samples=9), "samples is 9, but no axis is sampled"),
        (dict(samples=-9), "samples is -9; it must be a whole number, at least 0"),
        (dict(sampling="sobol"), "sampling is 'sobol'; allowed: low_discrepancy, random"),
        (dict(seed=-1), "seed is -1"),
        (dict(chunk=0), "chunk is 0"),
        (dict(tier="best"), "tier is 'best'; allowed: leading, exact, time"),
        (dict(measure=[]), r"measure is \[\]; give a list"),
        (dict(measure=["run.foundationforce"]), "did you mean 'run.foundation_force'"),
        (dict(measure={"status": jam_frequency(mode=1)}), "is a name that is used already"),
        (dict(measure={"regime": "run.relative_rotation"}, until=1.0), "is the name of the measure run.regime"),
        (dict(measure={"mode": jam_frequency(mode=1)}), "is the name of the measure run.mode"),
        (
            dict(measure={"coordinate": jam_frequency(mode=1), "a": "run.amplitude"}, until=1.0),
            "measure.coordinate is a name that is used already",
        ),
        (dict(measure=[jam_frequency(mode=1)] * 2), "has several jam_frequency"),
        (dict(measure=RUN), "until is missing; run.mode is measured in a run"),
        (dict(until=1.0), "until applies to runs, but no quantity is measured in a run"),
        (dict(axes={"start.rate": [1.0]}), "axes.start.rate applies to runs"),
        (dict(mode=1, start="jam"), "mode applies to runs"),
        (dict(steps=50), "steps applies to runs"),
        (dict(start="spin_up"), "start applies to runs"),
        (dict(measure=RUN, until=-1.0), "until is -1 s"),
        (dict(measure=RUN, until=1.0, steps=0), "steps is 0"),
        (dict(measure=RUN, until=1.0, start="jam"), "mode is missing"),
        (dict(measure=[jam_frequency(mode=9)]), "mode is 9; this machine's jam modes are numbered 1 to 3"),
    ],
)
def test_values_that_are_not_allowed_raise_clear_errors(more, says):
    with pytest.raises(jv.InputError, match=says):
        asked(**more)


def test_sampled_ranges_are_divided_by_ratio_on_request():
    share = np.array([0.0, 0.25, 0.5])
    for log, values in ((False, [1.0, 2500.75, 5000.5]), (True, [1.0, 10.0, 100.0])):
        axis = Axis("drive.speed", "rad/s", None, 1.0, 1e4, log, Target(None, "", None))
        np.testing.assert_allclose(axis.at(share), values, rtol=1e-14)
