"""Columns of CSV files: catalogues of springs in designs, torques of motors in scene files."""

import numpy as np
import pytest

import jaxvib as jv
from jaxvib.units.columns import split_head
from optimize import load_design
from optimize.synthesize import _table

SCENE = """[machine]
kind = "one_mass"
mass = 50.0
stiffness = "40 N/mm"
damping = 30.0
[loads]
kind = "ball"
count = 2
mass = 0.5
radius = 0.1
drag = 1.0
[drive]
kind = "torque_table"
file = "curves/motor.csv"
inertia = 0.02
"""


@pytest.mark.parametrize(
    "text",
    [
        "part,rate (N/mm),free length (mm)\nA,12.5,80\nB,20,90\n",
        "part;rate [N/mm];free length [mm]\nA;12,5;80\nB;20,0;90\n",
        "\n \n;;\npart;rate (N/mm);free length (mm)\n\nA;12,5;80\nB;20,0;90\n",
        "part\trate / N/mm\tfree length / mm\nA\t12.5\t80\n\t\t\nB\t20\t90\n",
        "\ufeffpart;rate (kN/m);free length (mm)\r\nA;12,5;80\r\nC;;95\r\nB;2,0e1;90\r\n",
    ],
)
def test_a_column_is_read_in_si(text, tmp_path):
    path = tmp_path / "springs.csv"
    path.write_bytes(text.encode())
    np.testing.assert_allclose(jv.csv_column(path, "N/m"), [12.5e3, 20e3], rtol=1e-14)
    np.testing.assert_allclose(jv.csv_column(path, "N/m", "rate"), [12.5e3, 20e3], rtol=1e-14)


@pytest.mark.parametrize(
    ("head", "name", "unit"),
    [
        ("torque/N m", "torque", "N m"),
        ("torque / N m", "torque", "N m"),
        ("drag / N s/m", "drag", "N s/m"),
        ("speed / m/s", "speed", "m/s"),
        ("in/out (N m)", "in/out", "N m"),
        ("input / output ratio", "input / output ratio", ""),
        ("Input 1/Channel 2 raw", "Input 1/Channel 2 raw", ""),
    ],
)
def test_units_with_blanks_follow_a_slash(head, name, unit, tmp_path):
    assert split_head(head, "m") == (name, unit)
    if unit:
        (tmp_path / "a.csv").write_text(f"part,{head}\nA,3\n")
        assert jv.csv_column(tmp_path / "a.csv", unit).tolist() == [3.0]


@pytest.mark.parametrize(
    ("text", "column", "words"),
    [
        ("rate (N/mm)\n", None, "has no rows"),
        ("part;rate\nA;20,5\n", None, r"has no column with a unit such as N/m; write it in the header: NAME \(N/m\)"),
        ("a (N/mm),b (N/m)\n1,2\n", None, "has 2 columns with a unit such as N/m; set column to one of"),
        ("a (N/mm),b (N/m)\n1,2\n", "c", "has no columns 'c'; set column to one of: 'a .N/mm.', 'b .N/m.'"),
        ("a (mm)\n1\n", "a", "whose unit is missing or not convertible to N/m; write a .N/m."),
        ("a (N/mm)\n1\ntwo\n", None, "row 3 has 'two', which is not a number"),
        ("\na (N/mm)\n\n1\n\ntwo\n", None, "row 6 has 'two', which is not a number"),
        ("a (N/mm)\n1_000\n", None, "row 2 has '1_000', which is not a number"),
        ("a (N/mm)\nnan\n", None, "a finite number is needed"),
        ("a (N/mm);b\n;3\n", None, "has no number in the column"),
    ],
)
def test_wrong_tables_are_refused(text, column, words, tmp_path):
    path = tmp_path / "springs.csv"
    path.write_text(text)
    with pytest.raises(jv.InputError, match=words):
        jv.csv_column(path, "N/m", column)


def test_a_torque_table_is_read_beside_its_scene(tmp_path):
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "motor.csv").write_text("speed (rpm);torque (Nm)\n0;15\n1000;22,5\n1500;0\n")
    (tmp_path / "machine.toml").write_text(SCENE)
    drive = jv.load_scene(tmp_path / "machine.toml").drive
    same = jv.TorqueTable(["0 rpm", "1000 rpm", "1500 rpm"], [15.0, 22.5, 0.0], inertia=0.02)
    np.testing.assert_allclose(drive.torques, same.torques, rtol=1e-14)
    np.testing.assert_allclose(drive.speeds, same.speeds, rtol=1e-14)
    with pytest.raises(jv.InputError, match=r"drive\.file is not a field here"):
        jv.scene_from_toml(SCENE)
    (tmp_path / "curves" / "motor.csv").write_text("speed (rpm);torque (Nm)\n1500;0\n1000;22,5\n0;15\n")
    assert repr(jv.load_scene(tmp_path / "machine.toml").drive) == repr(drive)
    (tmp_path / "curves" / "motor.csv").write_text("speed (rad/s);torque (Nm)\n150;0\n100;22,5\n100;15\n")
    with pytest.raises(
        jv.InputError, match=r"has 100 rad/s in row 4 of motor\.csv after 100 rad/s; list the speeds in ascending"
    ):
        jv.load_scene(tmp_path / "machine.toml")
    (tmp_path / "curves" / "motor.csv").write_text("speed (rpm);torque (Nm)\n0;15\n800;\n;18\n1500;0\n")
    with pytest.raises(jv.InputError, match="has a row with only one of speed and torque"):
        jv.load_scene(tmp_path / "machine.toml")
    (tmp_path / "curves" / "motor.csv").write_text("speed,torque (Nm)\n0,15\n1500,0\n")
    with pytest.raises(jv.InputError, match=r"has no column with a unit such as rpm; write it in the header: NAME \(rpm\)"):
        jv.load_scene(tmp_path / "machine.toml")


def test_choices_of_a_design_come_from_a_catalogue(tmp_path):
    (tmp_path / "springs.csv").write_text("rate (N/mm)\n30\n40\n55\n")
    motor = 'kind = "torque_table"\nfile = "curves/motor.csv"\ninertia = 0.02\n'
    (tmp_path / "machine.toml").write_text(SCENE.replace(motor, 'kind = "constant_speed"\nspeed = "1500 rpm"\n'))
    design = 'scene = "machine.toml"\n[choices]\n"machine.stiffness" = { file = "springs.csv", column = "rate" }\n'
    objective = '[objective]\nquantity = "foundation_force"\nmode = 1\n'
    (tmp_path / "design.toml").write_text(design + objective)
    loaded = load_design(tmp_path / "design.toml")
    space = loaded.space
    assert [list(choice.values) for choice in space.choices] == [[30e3, 40e3, 55e3]]
    stiffest = space.scene_of(np.full(space.size, 55e3))
    assert loaded.catalogues[0].chosen(stiffest) == "chosen machine.stiffness: row 4 of springs.csv"
    (tmp_path / "design.toml").write_text(design.replace("file =", "path =") + objective)
    with pytest.raises(jv.InputError, match=r"write a list, or file = 'springs.csv', column = 'rate'"):
        load_design(tmp_path / "design.toml")


MOTORS = """motor;speed (rpm);power (kW);breakdown (-);inertia (kg m^2)
90L;1445;1,5;2,8;0,0040
90S;1430;1,1;2,6;0,0030
100L;1450;2,2;2,9;0,0065
"""


def test_motors_are_chosen_by_rows_of_a_catalogue(tmp_path):
    (tmp_path / "motors.csv").write_text(MOTORS)
    drive = 'drive = { kind = "name_plate_motor", power = "1.5 kW", rated_speed = "1440 rpm", breakdown_ratio = 2.5, '
    machine = (
        SCENE.split("[loads]")[0]
        + '[[exciters]]\nunbalance = "0.2 kg m"\n'
        + drive
        + "inertia = 0.004, frequency = '50 Hz' }\n"
    )
    (tmp_path / "machine.toml").write_text(machine)
    named = {"power": "power", "rated_speed": "speed", "breakdown_ratio": "breakdown", "inertia": "inertia"}
    columns = ", ".join(f'"drive.{name}" = "{column}"' for name, column in named.items())
    design = f'scene = "machine.toml"\n[choices]\nmotor = {{ file = "motors.csv", columns = {{ {columns} }} }}\n'
    objective = '[objective]\nquantity = "foundation_force"\n'
    (tmp_path / "design.toml").write_text(design + objective)
    loaded = load_design(tmp_path / "design.toml")
    space, (catalogue,) = loaded.space, loaded.catalogues
    assert [choice.values for choice in space.choices] == [(1100.0, 1500.0, 2200.0)]
    scene = space.scene_of(np.array([1100.0]))
    assert catalogue.chosen(scene) == "chosen motor: 90S, row 3 of motors.csv"
    rows = _table(space, scene, [], np.zeros((2, 0)), ([], []))
    np.testing.assert_allclose([row.after for row in rows], [1100.0, 1430.0 * np.pi / 30.0, 2.6, 0.003])
    for power, speed, ratio, inertia in ((1100.0, 1430.0, 2.6, 0.003), (2200.0, 1450.0, 2.9, 0.0065)):
        chosen = space.scene_of(np.array([power])).drive
        found = [chosen.power, chosen.rated_speed * 30.0 / np.pi, chosen.breakdown_ratio, chosen.inertia]
        np.testing.assert_allclose(found, [power, speed, ratio, inertia], rtol=1e-12)
    for wrong, words in (
        (MOTORS.replace(";1,1;", ";;"), r"choices.motor has columns of different lengths \(drive.power 2, drive.rated_speed 3"),
        (MOTORS.replace(";1,1;", ";1,5;"), "choices.motor has rows with equal values of drive.power; name a column first"),
        (MOTORS.replace(";power", ";watts"), "has no columns 'power'"),
    ):
        (tmp_path / "motors.csv").write_text(wrong)
        with pytest.raises(jv.InputError, match=words):
            load_design(tmp_path / "design.toml")


def test_a_csv_file_with_decimal_commas_is_read_back(tmp_path):
    scene = jv.Scene(
        jv.planar_rotor(mass=20.0, stiffness=4e4, damping=60.0),
        jv.balls(count=2, mass=0.4, radius=0.08, drag=0.5),
        jv.ConstantSpeed(60.0),
    )
    from jaxvib.results.csv import write_csv

    path = write_csv(jv.whirl(scene, [10.0, 20.5]), "rotor_speed", tmp_path / "whirl.csv", decimal_comma=True)
    lines = path.read_text().splitlines()
    assert lines[0].startswith("rotor_speed (rad/s);speed 1 (rad/s)") and lines[2].startswith("20,5;")
    np.testing.assert_allclose(jv.csv_column(path, "rad/s", "rotor_speed"), [10.0, 20.5], rtol=1e-9)
