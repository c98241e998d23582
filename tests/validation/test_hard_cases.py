"""Hard cases in double and single precision against their references, and faults that these must notice."""

import dataclasses

import diffrax
import equinox as eqx
import numpy as np
import pytest
from hard_cases import CASES, extreme_scales
from hard_cases.case import PRECISIONS, Answer, Reference, judge, outcome
from hard_cases.reference_integration import is_stiff, run_out
from hard_cases.reference_model import reference_model
from hard_cases.shared import end_of_run, final_state, state_of

import jaxvib as jv
from jaxvib.machine.loads import CircularLoads

BY_NAME = {case.name: case for case in CASES}
FAST = {
    ("fold of light loads, 1e-8 below", "float64"),
    ("fold of light loads, 1e-8 below", "float32"),
    ("fold of light loads, 1e-8 above", "float64"),
    ("exact fold, 1e-8 below", "float32"),
    ("damping 1e-8 of critical", "float64"),
    ("three platforms alike, weak links", "float64"),
    ("one load", "float64"),
    ("micromachine of 1e-9 kg, run", "float64"),
    ("energy over 1e4 turns", "float64"),
    ("drag 0, exact jam", "float64"),
}
"""Cases that compile little; the others are part of `make validate`."""


def question(case, precision):
    marks = () if (case.name, precision) in FAST else pytest.mark.slow
    return pytest.param(case, precision, marks=marks, id=f"{case.name}-{precision}")


@pytest.mark.parametrize(("case", "precision"), [question(case, precision) for case in CASES for precision in PRECISIONS])
def test_hard_case(case, precision, record_property):
    found = outcome(case, precision)
    for name in ("status", "error", "claimed"):
        record_property(name, getattr(found, name))
    assert found.verdict in case.verdicts(precision), found


ONE_LOAD = BY_NAME["one load"]


class Turned(CircularLoads):
    """Loads whose drag has the wrong sign."""

    def resistance(self, u, rate, speed):
        (torque,) = super().resistance(u, rate, speed)
        return (-torque,)

    def drag_sum(self):
        return -super().drag_sum()


def turned(scene):
    fields = {field.name: getattr(scene.loads, field.name) for field in dataclasses.fields(scene.loads)}
    return eqx.tree_at(lambda s: s.loads, scene, Turned(**fields))


@pytest.mark.parametrize("name", ["one load", "fold of light loads, 1e-8 below"])
def test_wrong_sign_in_the_equations_fails(name):
    case = BY_NAME[name]
    found = outcome(dataclasses.replace(case, answer=lambda scene: case.answer(turned(scene))))
    assert found.verdict == "FAILED", found


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4])
def test_loosened_tolerance_fails(tolerance):
    loose = final_state(40.0, extreme_scales.begun, steps=(jv.Tolerance(tolerance), None))[0]
    found = outcome(dataclasses.replace(ONE_LOAD, answer=loose))
    assert found.verdict == "FAILED" and found.status == "wrong" and found.error > 1e-6


def test_method_of_too_low_order_fails():
    """Euler's method of order 1 in place of one of order 8."""

    def answer(scene):
        start = state_of(scene, extreme_scales.begun(scene))
        how = dict(solver=diffrax.Euler(), stepsize_controller=jv.EqualSteps(4000))
        run = jv.simulate(scene, 40.0, start=start, save="window", **how)
        return Answer(end_of_run(run), float(run.error))

    found = outcome(dataclasses.replace(ONE_LOAD, answer=answer))
    assert found.verdict == "FAILED" and found.status == "wrong"


@pytest.mark.parametrize(
    ("answer", "verdict", "says"),
    [
        (Answer([1.0, 2.0]), "right", ""),
        (Answer([1.0, 2.0 + 1e-7], claimed=1e-7), "right", ""),
        (Answer([1.0, 2.0 + 1e-7], claimed=1e-9), "FAILED", "larger than the one claimed"),
        (Answer([1.0, 2.0 + 1e-5]), "FAILED", "wrong"),
        (Answer([1.0, 2.0 + 1e-5], claimed=1.0), "FAILED", "wrong"),
        (Answer([1.0, np.nan]), "FAILED", "no status says so"),
        (Answer([1.0]), "FAILED", "1 values in place of 2"),
        (Answer([], status="absent"), "named", "absent"),
        (Answer([], status="not_converged"), "FAILED", "not_converged"),
        (jv.ComputationError("absent", "no members"), "named", "absent"),
        (jv.ComputationError("not_settled", "it moves"), "FAILED", "not_settled"),
        (jv.InputError("loads", "is wrong"), "FAILED", "refused"),
        (TypeError("unhashable"), "FAILED", "TypeError: unhashable"),
    ],
)
def test_verdict_on_an_answer(answer, verdict, says):
    found = judge(answer, Reference([1.0, 2.0], unknown=1e-9), 1e-6, ("absent",))
    assert found.verdict == verdict and says in found.status


def test_strong_drag_is_integrated_implicitly_by_the_reference():
    """A load that drag holds to the rotor is an unbalance at its speed; the oscillation at first has decayed by exp(-20)."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=1000.0)
    scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=1e6), jv.ConstantSpeed(60.0))
    p = reference_model(scene)
    assert is_stiff(p)
    found = run_out(p, np.array([0.0, 0.0, 0.0, 60.0]), 2.0)
    moved = 0.05 * 60.0**2 / abs(4e4 - 50.5 * 60.0**2 + 1000j * 60.0)
    np.testing.assert_allclose(found.displacement, moved, rtol=1e-4)
    np.testing.assert_allclose(found.state[3], 60.0, rtol=1e-6)
