"""The catalogue of hard cases: it holds, and it notices what is put wrong."""

import dataclasses
import json

import diffrax
import equinox as eqx
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.cli.app import run
from jaxvib.machine.loads import CircularLoads
from jaxvib.study.stress import run as catalogue
from jaxvib.study.stress import sizes
from jaxvib.study.stress.asked import end_of_run, final_state, state_of
from jaxvib.study.stress.case import Answer, Case, Reference, judged
from jaxvib.study.stress.motions import is_stiff, run_out
from jaxvib.study.stress.plain import plain
from jaxvib.study.stress.result import stress_of
from jaxvib.study.stress.run import CATALOGUE, outcome

CASES = {case.name: case for case in CATALOGUE}
ONE_LOAD = CASES["one load"]


@pytest.mark.parametrize(
    ("name", "verdict"),
    [
        ("light fold, 1e-8 below", "right"),
        ("light fold, 1e-8 above", "right"),
        ("damping 1e-8 of critical", "right"),
        ("three platforms alike, weak links", "right"),
        ("one load", "right"),
        ("watch of 1e-9 kg, run", "right"),
        ("energy over 1e4 turns", "right"),
        ("drag 0, exact jam", "named"),
    ],
)
def test_hard_cases_that_compile_little(name, verdict):
    row = outcome(CASES[name])
    assert row.verdict == verdict, row


@pytest.mark.slow
def test_every_hard_case_in_both_precisions():
    found = jv.stress()
    assert len(found.rows) == 2 * len(CATALOGUE)
    assert found.failures == [] and found.status_name == "passed"


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


@pytest.mark.parametrize("name", ["one load", "light fold, 1e-8 below"])
def test_a_wrong_sign_in_the_equations_is_caught(name):
    case = CASES[name]
    row = outcome(dataclasses.replace(case, answer=lambda scene: case.answer(turned(scene))))
    assert row.verdict == "FAILED", row


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4])
def test_a_loosened_tolerance_is_caught(tolerance):
    loose = final_state(40.0, sizes.begun, steps=(jv.Tolerance(tolerance), None))[0]
    row = outcome(dataclasses.replace(ONE_LOAD, answer=loose))
    assert row.verdict == "FAILED" and row.status == "wrong" and row.error > 1e-6


def test_a_broken_method_is_caught():
    """Euler's method of order 1 in the place of one of order 8."""

    def answer(scene):
        start = sizes.begun(scene)
        steps = jv.EqualSteps(4000)
        found = jv.simulate(
            scene, 40.0, start=state_of(scene, start), save="window", solver=diffrax.Euler(), stepsize_controller=steps
        )
        return Answer(end_of_run(found), float(found.error))

    row = outcome(dataclasses.replace(ONE_LOAD, answer=answer))
    assert row.verdict == "FAILED" and row.status == "wrong"


CASE = Case("a case", "", "", "", None, None, None, within=(1e-6, 1e-2), named=(("absent",), ()))
RIGHT = Reference([1.0, 2.0], unknown=1e-9)


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
        (jv.ComputationError("absent", "there is none"), "named", "absent"),
        (jv.ComputationError("not_settled", "it moves"), "FAILED", "not_settled"),
        (jv.InputError("loads", "is wrong"), "FAILED", "refused"),
        (TypeError("unhashable"), "FAILED", "TypeError: unhashable"),
    ],
)
def test_verdicts(answer, verdict, says):
    row = judged(CASE, "float64", (answer, 0.1), RIGHT)
    assert row.verdict == verdict and says in row.status
    assert stress_of([row]).status_name == ("failed" if verdict == "FAILED" else "passed")


def test_the_command(capsys, tmp_path, monkeypatch):
    asked = ["stress", "--only", "drag 0, exact", "--precision", "float64"]
    assert run([*asked, "--json", "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert document["status"] == "passed" and [row["verdict"] for row in document["rows"]] == ["named"]
    assert "drag 0, exact jam, float64: named" in err and (tmp_path / "stress.png").stat().st_size > 5_000

    monkeypatch.setattr(
        catalogue, "outcome", lambda case: judged(CASE, "float64", (TypeError("no"), 0.1), RIGHT)._replace(case=case.name)
    )
    assert run(asked) == 1
    out, _ = capsys.readouterr()
    assert "FAILED" in out and "TypeError: no" in out
    assert run(["stress", "--only", "nonsense"]) == 2
    assert run(["stress", "--list"]) == 0
    assert all(case.name in capsys.readouterr().out for case in CATALOGUE[:1])


def test_the_other_precision_is_asked_in_a_process_of_its_own():
    found = jv.stress(["light fold, 1e-8 below"])
    assert [(row.dtype, row.verdict) for row in found.rows] == [("float64", "right"), ("float32", "named")]
    with pytest.raises(jv.InputError, match="part of no case's name"):
        jv.stress(["nonsense"])
    with pytest.raises(jv.InputError, match="must be 'float64' or 'float32'"):
        jv.stress(precisions=["float16"])


def test_references_with_strong_drag_are_integrated_implicitly():
    """A load that drag holds to the rotor is an unbalance at its speed; the oscillation at first has decayed by exp(-20)."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=1000.0)
    scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=1e6), jv.ConstantSpeed(60.0))
    p = plain(scene)
    assert is_stiff(p)
    found = run_out(p, np.array([0.0, 0.0, 0.0, 60.0]), 2.0)
    moved = 0.05 * 60.0**2 / abs(4e4 - 50.5 * 60.0**2 + 1000j * 60.0)
    np.testing.assert_allclose(found.displacement, moved, rtol=1e-4)
    np.testing.assert_allclose(found.state[3], 60.0, rtol=1e-6)
