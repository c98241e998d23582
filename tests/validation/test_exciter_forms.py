"""Closed forms of several exciters against the averaged, the exact and the simulated motion."""

import numpy as np
import pytest
from exciter_forms import FORMS, TIERS, averaged_errors, circular, on_circle

COMPILES_LITTLE = ("4: three exciters", "3: ")
"""Names of forms that share the programs of three motors; the others, and the averaged tier, which
`tests/steady/regimes/test_closed_forms.py` tests too, are part of `make validate`."""


def question(form, tier):
    marks = () if form.name.startswith(COMPILES_LITTLE) and tier != "averaged" else pytest.mark.slow
    return pytest.param(form, tier, marks=marks, id=f"{form.name}-{tier}")


@pytest.mark.parametrize(("form", "tier"), [question(form, tier) for form in FORMS for tier in TIERS])
def test_closed_form(form, tier, record_property):
    error = form.error(tier)
    record_property("error", error)
    assert error <= form.within[TIERS.index(tier)]


@pytest.mark.parametrize("tier", TIERS[1:])
def test_wrong_closed_form_fails(tier):
    """A braking torque of four exciters in place of three, and the wrong stability."""
    motion = circular(on_circle(1.5), 3e4, 900.0)
    wrong = circular([*on_circle(1.5), (0.0, 0.0)], 3e4, 900.0).speed
    assert 1e-4 < motion._replace(speed=wrong).error(tier) < 1e-2
    assert motion._replace(stable=False).error(tier) == np.inf


@pytest.mark.slow
def test_error_of_averaged_torques_falls_with_the_square():
    """About S^2 / (2 M I) for the lighter of two platforms; a quarter for half the unbalance."""
    errors = averaged_errors([0.8, 0.4, 0.2])
    assert 0.25 < errors[0] / (0.8**2 / (2.0 * 200.0 * 0.5)) < 1.0
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 4.0, rtol=0.01)
