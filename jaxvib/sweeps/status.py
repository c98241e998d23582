"""How a case ended."""

from __future__ import annotations

import equinox as eqx

from jaxvib.runtime.compat import enumeration_names

__all__ = ["CASE_STATUSES", "CaseStatus", "SweepStatus"]


class CaseStatus(eqx.Enumeration):
    """How a case ended; the members are the sentences a user reads. Their order is part of the format of a store."""

    missing = "the case was not computed yet"
    done = "the case was computed"
    absent = "something that was asked for does not exist in this case, such as a jam beyond its fold"
    not_finite = "the motion grew beyond all bounds"
    failed = "an error was raised, see the sentence beside it"
    lost = "the worker that computed it died, several times"


CASE_STATUSES = enumeration_names(CaseStatus)
"""The names of the statuses in the order of their numbers in a store."""


class SweepStatus(eqx.Enumeration):
    """How far a study came; the members are the sentences a user reads."""

    done = "every case was computed"
    partly = "not every case was computed yet; run the study again to go on"
