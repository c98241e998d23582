"""Numbers that the source papers print, and the rule by which they are judged."""

import math
from collections import Counter

import numpy as np
import pytest
from papers.catalogue import NUMBERS
from papers.printed import Misprint, PrintedNumber
from papers.torus import tables


def name_of(number):
    return f"{number.paper}-{number.place}-{number.quantity}"


@pytest.mark.parametrize(
    "number", [pytest.param(n, marks=pytest.mark.slow if n.is_slow else (), id=name_of(n)) for n in NUMBERS]
)
def test_printed_number_has_its_verdict(number):
    number.check()


@pytest.mark.slow
def test_torus_tables_favour_the_printed_lever():
    """Both tables by both levers, with converged steps."""
    printed, correct = tables("printed"), tables("gap lever")
    near = [np.sum(np.abs(found.difference) <= 0.05) for found in (printed, correct)]
    assert near[0] >= 30 and near[0] > near[1]
    assert np.sum(printed.converged) >= 40


def test_every_number_has_a_name_of_its_own():
    assert max(Counter(map(name_of, NUMBERS)).values()) == 1


def test_corrections_are_not_what_they_are_checked_with():
    """The proof of a misprint is computed in another way: it agrees to rounding, not bit for bit, in most cases."""
    misprints = [n for n in NUMBERS if n.paper == "criterion" and n.misprint is not None]
    differ = [n.computed() != n.misprint.corrected() for n in misprints]
    assert len(differ) == 5 and sum(differ) >= 3


def number(printed, computed, within=0.5, **more):
    return PrintedNumber("paper", "(1)", "x", printed, lambda: computed, within, **more)


def misprint(corrected):
    return Misprint("wrong", "right", "proof", corrected)


@pytest.mark.parametrize(
    "right",
    [
        number(3.0, 3.5),
        number(3.0, 4.0, misprint=misprint(4.2)),
        number(3.0, 4.0, reason="data contradict each other", differs=4.04),
        number(3.0, math.nan, reason="there is no such motion"),
        number(3.0, 3.4, reason="chaotic", chaotic=0.5),
        PrintedNumber("paper", "(1)", "x", 3.0, None, 0.5, reason="a measurement"),
    ],
)
def test_right_verdict_passes(right):
    right.check()


@pytest.mark.parametrize(
    "wrong",
    [
        number(3.0, 3.51),
        number(3.0, math.nan),
        number(3.0, 3.4, misprint=misprint(3.4)),
        number(3.0, 4.0, misprint=misprint(4.6)),
        number(3.0, math.nan, misprint=misprint(4.0)),
        number(3.0, 3.4, reason="data contradict each other", differs=3.4),
        number(3.0, 4.0, reason="data contradict each other", differs=4.06),
        number(3.0, 4.0, reason="there is no such motion"),
        number(3.0, 3.6, reason="chaotic", chaotic=0.5),
        number(3.0, math.nan, reason="chaotic", chaotic=0.5),
        PrintedNumber("paper", "(1)", "x", 3.0, None, 0.5),
    ],
)
def test_wrong_verdict_fails(wrong):
    with pytest.raises(AssertionError):
        wrong.check()
