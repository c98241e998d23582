"""Tables of results in files, read back number by number."""

import csv

import equinox as eqx
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.motion.analysis.spectrum import Spectrum
from jaxvib.results.csv import main_axis, table_along
from jaxvib.results.fields import in_unit
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


class Readings(eqx.Module):
    """Result with complex numbers, real numbers and texts along one axis."""

    amplitude: np.ndarray = eqx.field(metadata=in_unit("m", "load"))
    mass: np.ndarray = eqx.field(metadata=in_unit("kg", "load"))
    version: np.ndarray = eqx.field(metadata=in_unit("", "load"))


class Spectra(eqx.Module):
    """Result with arrays over segments, frequencies and directions."""

    frequency: np.ndarray = eqx.field(metadata=in_unit("rad/s", "frequency"))
    force: np.ndarray = eqx.field(metadata=in_unit("N", "segment", "frequency", "direction"))


def table(result, axis, path, **options):
    text = jv.write_csv(result, axis, path, **options).read_bytes().decode("utf-8")
    assert "\r" not in text and text.endswith("\n")
    head, *rows = csv.reader(text.splitlines(), delimiter=";" if options.get("decimal_comma") else ",")
    return dict(zip(head, np.array(rows).T, strict=True))


def test_complex_numbers_have_two_columns_and_statuses_names(tmp_path):
    modes = jv.jam_modes(jv.Scene(TWO_MASSES, LOADS, jv.ConstantSpeed("60 rad/s")))
    columns = table(modes, "mode", tmp_path / "modes.csv")
    for k in range(2):
        for word, part in (("real", np.real), ("imaginary", np.imag)):
            column = columns[f"{word} displacement y{k + 1} (m)"].astype(float)
            np.testing.assert_allclose(column, part(modes.displacement[:, k]), rtol=1e-8)
    np.testing.assert_allclose(columns["omega (rad/s)"].astype(float), modes.omega, rtol=1e-8)
    assert columns["status"].tolist() == status_names(modes.status).tolist() and len(set(columns["status"])) == 2


def test_rows_of_coordinates_begin_with_their_names(tmp_path):
    scene = jv.Scene(TWO_MASSES, LOADS, jv.ConstantSpeed("60 rad/s"))
    for result in (jv.jam_modes(scene).select(3), jv.jam_orbit(scene, mode=3)):
        columns = table(result, "coordinate", tmp_path / "jam.csv")
        assert next(iter(columns)) == "coordinate" and columns["coordinate"].tolist() == ["y1", "y2"]
        np.testing.assert_allclose(columns["amplitude (m)"].astype(float), result.amplitude, rtol=1e-8)
    run = jv.simulate(jv.Scene(ROTOR, LOADS, jv.ConstantSpeed("60 rad/s")), until=0.2)
    columns = table(run, "coordinate", tmp_path / "rotor.csv")
    assert list(columns)[:2] == ["coordinate", "unit"] and columns["unit"].tolist() == ["m", "m", "rad", "rad"]
    assert "amplitude (m or rad)" in columns


def test_truth_values_are_ones_and_zeros(tmp_path):
    found = jv.whirl(jv.Scene(ROTOR, LOADS, jv.ConstantSpeed("60 rad/s")), [0.0, 30.0])
    columns = table(found, "rotor_speed", tmp_path / "whirl.csv")
    for k in range(4):
        np.testing.assert_array_equal(columns[f"forward {k + 1}"].astype(int), found.forward[:, k])
        np.testing.assert_allclose(columns[f"speed {k + 1} (rad/s)"].astype(float), found.speed[:, k], rtol=1e-8)


def test_real_and_imaginary_part_have_one_display_unit(tmp_path):
    numbers = Readings(np.array([0.01 + 0.02j, 2e-6 - 1e-6j]), np.array([0.5, 0.25]), np.array(["a", "b"]))
    columns = table(numbers, "load", tmp_path / "display.csv", display=True)
    assert list(columns) == ["real amplitude (mm)", "imaginary amplitude (mm)", "mass (g)", "version"]
    assert columns["real amplitude (mm)"].tolist() == ["10", "0.002"]
    assert columns["imaginary amplitude (mm)"].tolist() == ["20", "-0.001"]
    assert columns["mass (g)"].tolist() == ["500", "250"]


def test_display_headers_are_words_with_coordinates(tmp_path):
    found = jv.response(jv.Scene(ROTOR, exciters=[jv.Exciter(None, jv.ConstantSpeed(60.0), unbalance=0.01)]), [30.0, 60.0])
    shown, plain = (list(table(found, "speed", tmp_path / "r.csv", display=display)) for display in (True, False))
    for head in ("acceleration y (g)", "velocity z (mm/s)", "exciter force (N)", "foundation force (N)"):
        assert head in shown
    assert "acceleration z (g0)" in plain and "exciter_force (N)" in plain
    assert not any("_" in head for head in shown)


@pytest.mark.parametrize(("segments", "forces"), [(1, ["force 1 (N)", "force 2 (N)"]), (2, [])])
def test_table_of_one_segment_has_its_spectrum(segments, forces, tmp_path):
    spectra = Spectra(np.arange(3.0), np.arange(segments * 6.0).reshape(segments, 3, 2))
    columns = table(spectra, "frequency", tmp_path / "spectra.csv")
    assert list(columns) == ["frequency (rad/s)", *forces]
    if segments == 1:
        np.testing.assert_array_equal(columns["force 2 (N)"].astype(float), [1.0, 3.0, 5.0])


def test_equal_entries_have_separate_rows(tmp_path):
    numbers = Readings(np.array([1j, 1j, 1j]), np.array([0.5, 0.5, 0.5]), np.array(["a", "a", "a"]))
    assert table(numbers, "load", tmp_path / "equal.csv")["version"].tolist() == ["a", "a", "a"]


def test_each_speed_of_a_response_has_one_row(tmp_path):
    machine = jv.one_mass(mass=200.0, stiffness=8e5, damping=600.0)
    motor = jv.DCMotor(157.0, stall_torque=12.0, inertia=0.1)
    curve = jv.response(jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=0.2)]), points=40)
    speeds = table(curve, "speed", tmp_path / "curve.csv")["speed (rad/s)"].astype(float)
    assert np.all(np.diff(speeds) > 0.0) and speeds.size > 30


def test_decimal_commas_are_in_numbers_only(tmp_path):
    columns = table(
        Readings(np.array([1.5 + 0j]), np.array([0.5]), np.array(["v1.2"])), "load", tmp_path / "comma.csv", decimal_comma=True
    )
    assert columns["version"].tolist() == ["v1.2"] and columns["mass (kg)"].tolist() == ["0,5"]


@pytest.mark.parametrize("axis", ["coordinate", "", "time"])
def test_another_axis_is_refused(axis, tmp_path):
    found = jv.whirl(jv.Scene(ROTOR, LOADS, jv.ConstantSpeed("60 rad/s")), [0.0, 30.0])
    with pytest.raises(jv.InputError, match=r"^axis is .*; the axes of \w+ are: .*rotor_speed"):
        jv.write_csv(found, axis, tmp_path / "whirl.csv")
    assert not list(tmp_path.iterdir())


def test_tables_of_runs_have_states_of_motors_and_rolling_loads():
    rows = np.arange(6.0).reshape(3, 2)
    spin = jv.Spin(drilling=rows, slip=(rows + 6.0,))
    exciter = jv.ExciterState((rows,), (rows,), rotor=tuple(np.arange(4 * 3.0).reshape(4, 3)), spin=spin)
    angles = (np.zeros(3),) * 2
    for number, exciters in (("", (exciter,)), ("exciters_2_", (jv.ExciterState(), exciter))):
        state = jv.State(rows[:, :1], rows[:, :1], exciters=exciters)
        columns = table_along(Trajectory(np.arange(3.0), state, rows[:, :1], angles, angles), "time")
        for k in (1, 2):
            np.testing.assert_array_equal(columns[f"{number}motor_state_{k} (SI)"], exciter.rotor[k + 1])
            np.testing.assert_array_equal(columns[f"{number}drilling {k} (rad/s)"], rows[:, k - 1])
            np.testing.assert_array_equal(columns[f"{number}slip {k} (m/s)"], rows[:, k - 1] + 6.0)
        assert sum("motor_state" in head for head in columns) == 2


@pytest.mark.parametrize(("segments", "axis"), [(1, "frequency"), (2, "segment")])
def test_main_axis_of_one_spectrum_is_its_frequency(segments, axis):
    means = np.zeros((segments, 1))
    spectrum = Spectrum(
        np.zeros(segments), np.zeros(5), np.zeros((segments, 5, 2)), np.zeros((segments, 5, 1)), means, means, np.zeros(2),
        coordinates=("y1", "tilt"), units=("m", "rad"),
    )  # fmt: skip
    table = table_along(spectrum, axis)
    assert main_axis(spectrum) == axis and len(table) > 3
    assert axis == "segment" or {"amplitude y1 (m)", "amplitude tilt (rad)"} < set(table)


def test_table_of_a_batch_is_refused():
    batch = Readings(*(np.zeros((2, 3)) for _ in range(3)))
    with pytest.raises(jv.InputError, match=r"^result is a batch with 1 outer axis; take one of its results, "):
        table_along(batch, "load")


class Curve(eqx.Module):
    """Points of a curve of two pieces with a common end."""

    speed: np.ndarray = eqx.field(metadata=in_unit("rad/s", "point"))
    sample: np.ndarray = eqx.field(metadata=in_unit("m", "time"))


@pytest.mark.parametrize("axis, expected", [("point", [1.0, 2.0, 3.0]), ("time", [1.0, 2.0, 2.0, 3.0])])
def test_the_common_end_of_two_pieces_is_written_once(tmp_path, axis, expected):
    values = np.array([1.0, 2.0, 2.0, 3.0])
    (column,) = table(Curve(values, values), axis, tmp_path / "curve.csv").values()
    assert column.astype(float).tolist() == expected
