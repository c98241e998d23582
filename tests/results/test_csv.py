"""Tables of results in files, read back number by number."""

import csv

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.results.status import status_names

LOADS = jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25)
TWO_MASSES = jv.two_mass(mass=(50.0, 30.0), stiffness=(4e4, 3e4), damping=(100.0, 80.0), link_stiffness=2e4, link_damping=50.0)
ROTOR = jv.rotor(
    mass=20.0,
    transverse_inertia=0.3,
    polar_inertia=0.1,
    stiffness=(4e4, 3e4),
    damping=(60.0, 50.0),
    position=(-0.2, 0.3),
)


def table(result, axis, path):
    text = jv.write_csv(result, axis, path).read_bytes().decode("utf-8")
    assert "\r" not in text and text.endswith("\n")
    head, *rows = csv.reader(text.splitlines())
    return dict(zip(head, np.array(rows).T, strict=True))


def test_complex_numbers_have_two_columns_and_statuses_names(tmp_path):
    modes = jv.jam_modes(jv.Scene(TWO_MASSES, LOADS, jv.ConstantSpeed("60 rad/s")))
    columns = table(modes, "mode", tmp_path / "modes.csv")
    for k in range(2):
        for word, part in (("real", np.real), ("imaginary", np.imag)):
            column = columns[f"{word} displacement {k + 1} (m or rad)"].astype(float)
            np.testing.assert_allclose(column, part(modes.displacement[:, k]), rtol=1e-8)
    np.testing.assert_allclose(columns["omega (rad/s)"].astype(float), modes.omega, rtol=1e-8)
    assert columns["status"].tolist() == status_names(modes.status).tolist() and len(set(columns["status"])) == 2


def test_truth_values_are_ones_and_zeros(tmp_path):
    found = jv.whirl(jv.Scene(ROTOR, LOADS, jv.ConstantSpeed("60 rad/s")), [0.0, 30.0])
    columns = table(found, "rotor_speed", tmp_path / "whirl.csv")
    for k in range(4):
        np.testing.assert_array_equal(columns[f"forward {k + 1}"].astype(int), found.forward[:, k])
        np.testing.assert_allclose(columns[f"speed {k + 1} (rad/s)"].astype(float), found.speed[:, k], rtol=1e-8)


@pytest.mark.parametrize("axis", ["coordinate", "", "time"])
def test_another_axis_is_refused(axis, tmp_path):
    found = jv.whirl(jv.Scene(ROTOR, LOADS, jv.ConstantSpeed("60 rad/s")), [0.0, 30.0])
    with pytest.raises(jv.InputError, match=r"^axis is .*; the axes of \w+ are: .*rotor_speed"):
        jv.write_csv(found, axis, tmp_path / "whirl.csv")
    assert not list(tmp_path.iterdir())
