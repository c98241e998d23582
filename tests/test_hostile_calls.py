"""A sample of the hostile calls of `benchmarks/trials`, of functions that refuse before anything is traced."""

import importlib
import pathlib
import random
import sys

import pytest

TRIALS = pathlib.Path(__file__).parents[1] / "benchmarks" / "trials"
NAMES = {
    "balls", "rotor", "two_mass", "Scene", "ConstantSpeed", "DryFriction", "Stop", "load_scene", "scene_from_toml", "hold",
    "amplitude", "spring_cost", "settling_time", "quantile", "under", "Quantity +", "Quantity **", "DesignSpace",
    "DesignSpace by ties", "Record", "read_record", "write_csv",
}  # fmt: skip


@pytest.fixture(scope="module")
def trial():
    sys.path.insert(0, str(TRIALS))
    try:
        yield importlib.import_module("hostile_calls")
    finally:
        sys.path.remove(str(TRIALS))


def test_hostile_calls_end_in_one_sentence(trial):
    draw, bad, number = random.Random(46), [], 0
    for made in trial.calls():
        if made.named in NAMES:
            call = made()
            for name, valid in call.arguments.items():
                for text in draw.sample(sorted(trial.HOSTILE), 12):
                    if valid is None and trial.HOSTILE[text] is None:
                        continue
                    number += 1
                    kind, said = trial.outcome(call, name, text)
                    bad += [] if kind in ("refused", "answered") else [f"{kind}: {call.name}({name}={text}) {said}"]
    assert number > 500 and bad == []


TRACED = {
    "initial_state", "natural_frequencies", "jam_modes", "phase_jams", "balanced_states", "settle", "growth", "scene_to_toml",
    "ten_periods", "Record.between", "Quantity *", "Quantity **", "hold", "DesignSpace", "DesignSpace.parameters",
    "DesignSpace.within", "peak_force", "PhaseJams.follow", "BalancedStates.intervals", "sketch", "capture",
}  # fmt: skip


def test_traced_numbers_are_answered_or_refused_in_a_sentence(trial):
    ends = {}
    for made in trial.calls():
        if made.named in TRACED:
            call = made()
            for name, valid in call.arguments.items():
                if trial.is_inexact(valid):
                    ends[f"{call.name}({name})"] = trial.judged(lambda call=call, name=name: trial.traced(call, name))
    assert [(name, said) for name, (kind, said) in ends.items() if kind not in ("refused", "answered")] == []
    assert ends["jam_modes(scene)"][0] == "answered"
    assert ends["balanced_states(scene)"][1].startswith("scene contains a value that JAX traces, but the value is needed here")


def test_a_raw_error_and_a_boolean_as_a_number_are_seen(trial):
    def takes_all(size: float) -> float:
        return size

    def fails(size: float) -> float:
        raise KeyError(size)

    call = trial.Call("takes_all", takes_all, {"size": 1.0})
    assert trial.outcome(call, "size", "True")[0] == "silent"
    assert trial.outcome(trial.Call("fails", fails, {"size": 1.0}), "size", "0")[0] == "raw"
