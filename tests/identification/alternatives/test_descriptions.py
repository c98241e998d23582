"""Channels that are described wrongly; SciPy integrates the run-up of the machine that they measure."""

import functools

import numpy as np
import pytest
from run_ups_by_scipy import TRUTH, accelerations, record, scene_of

import jaxvib as jv
from jaxvib.identification.alternatives.descriptions import description_notes, scale_notes
from jaxvib.identification.problem import build_problem

TIMES = np.arange(0.0, 16.0, 0.01)
UNKNOWN = ["machine.stiffness", "machine.damping"]
G = 9.80665
REVERSED = "a reversed sign of channel 'a1', or with a reversed sign of channel 'a2'"


@functools.cache
def run_up():
    return record(TIMES, accelerations(TIMES, [TRUTH])[0], 0.2, np.random.default_rng(0))


def first_values():
    """Return the scene with stiffnesses and dampings away from the truth."""
    factors = {"machine.stiffness[0]": 1.1, "machine.stiffness[1]": 0.92, "machine.damping[0]": 1.5}
    return scene_of({name: value * factors.get(name, 1.0) for name, value in TRUTH.items()})


def run_of(factors=(1.0, 1.0), descriptions=({}, {}), lost=()):
    """Return the run-up with readings multiplied by factors, and with changed descriptions of the channels."""
    run = run_up()
    places = ({"at": 1, "gain_error": 0.0}, {"at": 2, "gain_error": 0.0})
    sensors = [jv.Channel(f"a{k + 1}", "acceleration", **{**places[k], **descriptions[k]}) for k in (0, 1)]
    readings = {f"a{k + 1}": run.values[f"a{k + 1}"] * factors[k] for k in (0, 1)}
    channels = tuple(each for each in (*sensors, run.channels[2]) if each.name not in lost)
    return jv.MeasuredRun(channels, run.times, {**run.values, **readings}, run.clipped, {}, (), "run")


def notes_of(*runs, unknown=UNKNOWN):
    return description_notes(build_problem(first_values(), runs, unknown, {}))


@pytest.mark.parametrize(
    ("runs", "unknown", "words"),
    [
        ([run_of(descriptions=({}, {"direction": "down"}))], UNKNOWN, REVERSED),
        ([run_of(descriptions=({"at": 2}, {"at": 1}))], UNKNOWN, "channels 'a1' and 'a2' swapped"),
        ([run_of((1.0, -1.0)), run_of(lost=["a2"])], UNKNOWN, REVERSED),
        ([run_of((1.0, 1.0 / G))], UNKNOWN, "9.807 times the readings of channel 'a2' ('g' in place of 'm/s^2')"),
        (
            [run_of((1e3, 1e3), ({"unit": "m/s^2"}, {"unit": "m/s^2"}))],
            UNKNOWN,
            "0.001 times the readings of channels 'a1' and 'a2' ('mm/s^2' in place of 'm/s^2')",
        ),
        (
            [run_of((1.0 / G, 1.0))],
            [*UNKNOWN, "exciters[0].unbalance"],
            "9.807 times the readings of channel 'a1' ('g' in place of 'm/s^2'), or with "
            "0.102 times the readings of channel 'a2' ('m/s^2' in place of 'g')",
        ),
    ],
)
def test_description_that_fits_is_named(runs, unknown, words):
    expected = f"the model explains the records with {words}: correct the description of the channels"
    assert notes_of(*runs, unknown=unknown) == [expected]


@pytest.mark.parametrize("factors", [(1.0, 1.0), (1.0, 0.5), (0.0, 0.0)], ids=["right", "wrong gain", "silent"])
def test_other_faults_are_no_wrong_description(factors):
    assert notes_of(run_of(factors)) == []


def test_unit_of_all_channels_is_doubted_if_masses_are_unknown():
    """Readings in g that are taken as m/s^2: masses, stiffnesses and dampings 9.8 times too large explain them."""
    run = run_of((1.0 / G, 1.0 / G), ({"gain_error": 0.01}, {"gain_error": 0.01}))
    unknown = [*UNKNOWN, "machine.mass", "machine.link_stiffness", "machine.link_damping"]
    fit = jv.identify(first_values(), run, unknown=unknown)
    np.testing.assert_allclose(fit.estimate("machine.mass[0]").value, G * TRUTH["machine.mass[0]"], rtol=0.03)
    assert fit.notes[0] == (
        "the fitted parameters are about 9.8 times their first values, as if the readings of channels 'a1' and 'a2' were in "
        "'g' and not in 'm/s^2': check the unit"
    )


@pytest.mark.parametrize("ratio", [1.0, 2.0, 7.0])
def test_factor_of_no_unit_raises_no_doubt(ratio):
    assert scale_notes(build_problem(first_values(), [run_of()], UNKNOWN, {}), np.full(5, ratio)) == []
