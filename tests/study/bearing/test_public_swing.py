"""A recorded swing that others have published, with their estimates (file tests/data/pendulum_free_swing.csv, MIT licence).

Kaheman et al. 2022 (arXiv 2205.06231) recorded a pendulum of 0.148 kg at 0.148 m with 1.091e-4 kg m^2 about its centre of mass.
"""

import pathlib

import numpy as np
import pytest

import jaxvib as jv

RECORD = pathlib.Path(__file__).parents[2] / "data" / "pendulum_free_swing.csv"
PENDULUM = jv.BearingPendulum(mass=0.14775, length=0.14758, inertia=1.091e-4, bearing="10 mm")


@pytest.fixture(scope="module")
def record():
    return jv.read_record(RECORD)


def test_record_of_the_authors_is_read(record):
    assert record.samples == 2751 and record.time[-1] == pytest.approx(55.0)
    assert np.rad2deg(record.angle[0]) == pytest.approx(-92.72915)


def test_inertia_agrees_with_the_published_one(record):
    found = jv.identify(PENDULUM, record, throw=False)
    assert found.inertia == pytest.approx(1.091e-4 + 0.14775 * 0.14758**2, rel=5e-3)


def test_swing_from_93_degrees_needs_two_more_frictions(record):
    """The residuals fall to a tenth with dry friction and drag of the air, and viscous friction would be negative."""
    viscous = jv.identify(PENDULUM, record, throw=False)
    assert viscous.status_name == "patterned" and any("identify mu2" in note for note in viscous.notes)
    assert any("a law with dry friction and drag of the air fits clearly better" in note for note in viscous.notes)
    all_three = jv.identify(PENDULUM, record, dry=True, air=True, throw=False)
    assert all_three.noise < 0.12 * viscous.noise
    assert all_three.status_name == "negative" and all_three.viscous.high < 0.0 < all_three.air.low < all_three.dry.low
