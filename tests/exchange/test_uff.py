"""Universal files through pyuff, with the conditions of files that programs for modal analysis refused."""

import numpy as np
import pytest
import pyuff
from scenes import ROTOR, TWO_MASS, loads, scene

import jaxvib as jv


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("uff")


def rotor_scene():
    machine = jv.rotor(**ROTOR, stations=(0.28, 0.25, -0.25, -0.28))
    return jv.Scene(machine, jv.pendulums(count=4, mass=0.05, radius=0.08, drag=0.1), jv.ConstantSpeed(460.0))


@pytest.fixture(scope="module")
def responses(home):
    return jv.export_uff(scene("three_mass"), home / "responses.unv", quantity="acceleration")


@pytest.fixture(scope="module")
def run():
    return jv.simulate(scene(), 2.0, estimate=False)


@pytest.fixture(scope="module")
def histories(run, home):
    return jv.export_uff(run, home / "histories.unv", quantity="velocity")


def types(path):
    return pyuff.UFF(str(path)).get_set_types().astype(int).tolist()


def test_responses_go_through_pyuff_and_back(responses):
    read, model = jv.read_uff(responses), jv.state_space(scene("three_mass"))
    assert [each.response for each in read.functions] == [(1, 3), (2, 3), (3, 3)]
    for k, each in enumerate(read.functions):
        assert (each.kind, each.quantity, each.reference) == ("response", "acceleration", (3, 3))
        expected = model.frequency_response(2.0 * np.pi * each.x)[:, 6 + k, 3]
        np.testing.assert_allclose(each.values, expected, rtol=1e-9, atol=1e-11 * np.max(np.abs(expected)))
    assert read.nodes == {1: (0.0, 0.0, 0.0), 2: (1.0, 0.0, 0.0), 3: (2.0, 0.0, 0.0)}


def test_default_frequencies_reach_above_all_modes(responses):
    """2048 lines up to 1.5 times the highest natural frequency; the spacing has five digits."""
    spacing = 1.5 * float(jv.natural_frequencies(scene("three_mass"))[-1]) / (2.0 * np.pi * 2048)
    for each in jv.read_uff(responses).functions:
        np.testing.assert_allclose(each.x, float(f"{spacing:.4e}") * np.arange(1, 2049), rtol=1e-5)


def screen(*others):
    """A body in a plane with two unbalances of opposite directions, and two more at the place of the first."""
    supports = [jv.support(at=(x, -0.2), stiffness=(2e5, 4e5), damping=(2e3, 4e3)) for x in (-1.2, 1.2)]
    motor = jv.DCMotor(120.0, stall_torque=8.0, inertia=0.2)
    places = [((-0.2, 0.4), 1), ((0.3, 0.4), -1), *others]
    exciters = [jv.Exciter(drive=motor, unbalance=0.2, at=at, direction=direction) for at, direction in places]
    return jv.Scene(jv.plane_body(mass=2000.0, inertia=600.0, supports=supports), exciters=exciters)


def test_responses_of_a_body_follow_at_its_points(home):
    """A point (a, b) moves by (x - b psi, y + a psi), and a force there has the moment of its lever."""
    path = jv.export_uff(screen(((-0.2, 0.4), -1)), home / "screen.unv", frequencies=np.arange(1.0, 40.0))
    read, model = jv.read_uff(path), jv.state_space(screen())
    assert read.nodes == {
        1: (0.0, 0.0, 0.0), 2: (0.0, -1.2, -0.2), 3: (0.0, 1.2, -0.2), 4: (0.0, -0.2, 0.4), 5: (0.0, 0.3, 0.4)
    }  # fmt: skip
    found = {(each.response, each.reference): each.values for each in read.functions}
    assert len(found) == len(read.functions) == 5 * 2 * 2 * 2
    by_force = model.frequency_response(2.0 * np.pi * read.functions[0].x)[:, :3, :3]
    for ((node, way), (at, along)), values in found.items():
        rows = [np.array([[1.0, 0.0, -read.nodes[n][2]], [0.0, 1.0, read.nodes[n][1]]]) for n in (node, at)]
        expected = np.einsum("i,wij,j->w", rows[0][way - 2], by_force, rows[1][along - 2])
        np.testing.assert_allclose(values, expected, rtol=1e-9, atol=1e-11 * np.max(np.abs(expected)))
    sets = pyuff.UFF(str(path)).read_sets()
    modes = [each for each in sets if each["type"] == 55]
    assert len(modes) == 3 and {each["analysis_type"] for each in modes} == {3}
    for each in modes:  # a rigid body: two points determine the third
        turn = (each["r2"][0] - each["r2"][3]) / 0.4
        np.testing.assert_allclose(each["r3"][4] - each["r3"][0], 0.3 * turn, atol=2e-5)


def test_responses_have_a_reference_for_each_exciter(home):
    balls = loads()["balls"]
    two = [jv.Exciter(balls, jv.ConstantSpeed(120.0), at=k) for k in (1, 2)]
    read = jv.read_uff(jv.export_uff(jv.Scene(jv.two_mass(**TWO_MASS), exciters=two), home / "two.unv")).functions
    assert [(each.response, each.reference) for each in read] == [((k, 3), (j, 3)) for j in (1, 2) for k in (1, 2)]
    np.testing.assert_allclose(read[1].values, read[2].values, rtol=1e-9, atol=1e-16)  # reciprocity


def test_nodes_of_a_matrix_model_are_the_places_of_its_exciters(home):
    machine = jv.from_matrices(np.diag([2.0, 3.0]), np.diag([4.0, 5.0]), np.diag([2e4, 8e4]), places=[[0], [1]])
    exciters = [jv.Exciter(at=at, drive=jv.ConstantSpeed(50.0), unbalance=0.01) for at in (1, 2)]
    read = jv.read_uff(jv.export_uff(jv.Scene(machine, exciters=exciters), home / "matrices.unv", frequencies=[1.0, 2.0]))
    assert read.nodes == {1: (1.0, 0.0, 0.0), 2: (2.0, 0.0, 0.0)}


def test_a_run_without_a_foundation_has_no_force(home):
    machine = jv.from_matrices(np.diag([2.0, 3.0]), np.diag([4.0, 5.0]), np.diag([2e4, 8e4]), places=[[0], [1]])
    scene = jv.Scene(machine, exciters=[jv.Exciter(at=1, drive=jv.ConstantSpeed(50.0), unbalance=0.01)])
    read = jv.read_uff(jv.export_uff(jv.simulate(scene, 1.0, estimate=False), home / "no_foundation.unv"))
    assert read.functions and all(each.quantity != "force" and np.all(np.isfinite(each.values)) for each in read.functions)


def test_histories_of_a_body_follow_at_its_points(home):
    run = jv.simulate(screen(), 1.0, estimate=False)
    read = {e.response: e for e in jv.read_uff(jv.export_uff(run, home / "screen_run.unv")).functions if e.kind == "history"}
    x, y, psi = np.asarray(run.trajectory.state.displacement).T
    np.testing.assert_allclose(read[5, 2].values, x - 0.4 * psi, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(read[5, 3].values, y + 0.3 * psi, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(read[0, 2].values, run.trajectory.foundation_force[:, 0], rtol=1e-9, atol=1e-9)


def test_histories_go_through_pyuff_and_back(run, histories):
    read, kept = jv.read_uff(histories), run.trajectory
    found = {each.response: each for each in read.functions if each.kind == "history"}
    np.testing.assert_allclose(found[1, 3].values, kept.state.velocity[:, 0], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found[2, 3].values, kept.state.velocity[:, 1], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found[0, 3].values, kept.foundation_force[:, 0], rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(found[1, 3].x, kept.time, rtol=5e-6)  # 6 digits, as the format prescribes
    assert found[1, 3].quantity == "velocity" and found[0, 3].quantity == "force"


def test_spectra_of_a_run_are_written(run, histories):
    spectra = [each for each in jv.read_uff(histories).functions if each.kind == "other"]
    spectrum = run.spectrum()
    np.testing.assert_allclose(spectra[0].values, spectrum.force[0, :, 0], rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(spectra[2].values, spectrum.amplitude[0, :, 1], rtol=1e-10, atol=1e-15)
    assert spectra[2].about == "amplitude spectrum of the coordinate y2"
    assert (spectra[0].quantity, spectra[0].response, spectra[0].reference) == ("force", (0, 3), (0, 0))


def test_files_begin_with_header_units_and_geometry(responses, histories):
    """OpenModal 33, 43, 54 and 55: functions without header, units or nodes are not shown."""
    for path in (responses, histories):
        found = types(path)
        assert found[:4] == [151, 164, 15, 82] and set(found[4:]) <= {55, 58} and 58 in found
        sets = pyuff.UFF(str(path)).read_sets()
        assert sets[1]["units_code"] == 1 and sets[1]["length"] == sets[1]["force"] == 1.0
        nodes = {int(node) for node in sets[2]["node_nums"]}
        assert {each["rsp_node"] for each in sets if each["type"] == 58} - {0} <= nodes
        assert {int(node) for node in sets[3]["nodes"]} == nodes


def test_spacing_is_even_and_stored_without_abscissa(responses, histories):
    """OpenModal 14: the increment is in the file, and the abscissa follows from it."""
    for path in (responses, histories):
        abscissas = set()
        for each in (each for each in pyuff.UFF(str(path)).read_sets() if each["type"] == 58):
            assert each["abscissa_spacing"] == 1 and each["abscissa_inc"] > 0.0
            np.testing.assert_allclose(np.diff(each["x"]), each["abscissa_inc"], rtol=1e-6)
            abscissas.add((each["func_type"] == 1, each["abscissa_axis_lab"].strip(), each["abscissa_axis_units_lab"].strip()))
            assert each["ordinate_spec_data_type"] in (8, 9, 11, 12)
        time, frequency = (True, "Time", "s"), (False, "Frequency", "Hz")
        assert abscissas == ({frequency} if path == responses else {time, frequency})


def test_each_node_has_one_response_per_reference(responses):
    """OpenModal 16: several functions of one node and one reference stop the analysis."""
    keys = [(each.response, each.reference) for each in jv.read_uff(responses).functions]
    assert len(keys) == len(set(keys))


def test_normal_modes_agree_with_mode_shapes(responses):
    modes = [each for each in pyuff.UFF(str(responses)).read_sets() if each["type"] == 55]
    found = jv.mode_shapes(scene("three_mass"))
    for each, w, shape in zip(modes, found.frequency, found.shape, strict=True):
        assert each["freq"] == pytest.approx(float(w) / (2.0 * np.pi), rel=1e-5) and each["node_nums"].tolist() == [1, 2, 3]
        largest = each["r3"][np.argmax(np.abs(each["r3"]))]
        np.testing.assert_allclose(each["r3"] / largest, shape / shape[np.argmax(np.abs(shape))], atol=2e-5)


def test_complex_modes_are_the_whirl_at_points_of_the_axis(home):
    path = jv.export_uff(rotor_scene(), home / "rotor.unv", rotor_speed=300.0, frequencies=np.arange(1.0, 9.0))
    sets = pyuff.UFF(str(path)).read_sets()
    modes, whirl = [each for each in sets if each["type"] == 55], jv.whirl(rotor_scene(), [300.0])
    assert [each["analysis_type"] for each in modes] == [3] * 4
    eigenvalues = np.array([each["eig"] for each in modes])
    np.testing.assert_allclose(eigenvalues.imag, whirl.speed[0], rtol=1e-5)
    np.testing.assert_allclose(-eigenvalues.real, whirl.decay[0], rtol=1e-5)
    position = np.array(sets[2]["x"])
    assert position.tolist() == [-0.28, -0.25, -0.155, 0.0, 0.165, 0.25, 0.28]
    for each, forward in zip(modes, whirl.forward[0], strict=True):
        for row in (each["r2"], each["r3"]):  # a rigid rotor stays straight
            line = np.polyfit(position, row, 1)
            assert np.max(np.abs(np.polyval(line, position) - row)) < 1e-5
        turn = -np.sum((each["r3"] * np.conj(each["r2"])).imag)
        assert (turn > 0.0) == bool(forward)
    assert {(each["ref_node"], each["ref_dir"]) for each in sets if each["type"] == 58} == {(4, 2), (4, 3)}


def test_uneven_files_in_other_units_are_read_in_si(home):
    x = np.array([0.0, 0.1, 0.25, 0.6])
    path = home / "uneven.uff"
    common = dict(
        type=58, func_type=1, rsp_node=4, rsp_dir=-2, ref_node=0, ref_dir=0, x=x, abscissa_spacing=0, orddenom_spec_data_type=0
    )
    units = dict(type=164, units_code=5, units_description="mm", temp_mode=1, length=1e3, force=1e3, temp=1.0, temp_offset=0.0)
    sets = [
        units,
        {**common, "data": np.array([1.0, 2.0, 3.0, 4.0]), "ordinate_spec_data_type": 8},
        {**common, "func_type": 4, "data": 1j * x, "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 13},
    ]
    pyuff.UFF(str(path)).write_sets(sets, mode="overwrite")
    history, response = jv.read_uff(path).functions
    np.testing.assert_allclose(history.x, x, rtol=1e-5)
    np.testing.assert_allclose(history.values, [1e-3, 2e-3, 3e-3, 4e-3])
    assert history.response == (4, -2) and history.kind == "history" and history.quantity == "displacement"
    np.testing.assert_allclose(response.values, 1j * x, atol=1e-12)


def test_binary_files_are_read(home):
    data, text, path = np.sin(np.arange(64.0)), home / "text.uff", home / "binary.uff"
    function = dict(type=58, func_type=1, rsp_node=1, rsp_dir=3, ref_node=0, ref_dir=0, data=data, x=0.01 * np.arange(64))
    function |= dict(abscissa_spacing=1, ordinate_spec_data_type=12, orddenom_spec_data_type=0)
    pyuff.UFF(str(text)).write_sets([function], mode="overwrite")
    lines = text.read_bytes().splitlines(True)
    lines[1] = b"    58b%6i%6i%12i%12i%6i%6i%12i%12i\n" % (1, 2, 11, 8 * 64, 0, 0, 0, 0)
    path.write_bytes(b"".join([*lines[:13], data.astype("<f8").tobytes(), b"    -1\n"]))
    np.testing.assert_array_equal(jv.read_uff(path).functions[0].values, data)


def test_sdypy_finds_the_poles_of_an_exported_response(home):
    ema = pytest.importorskip("sdypy.EMA")
    damped = jv.Scene(jv.two_mass(**{**TWO_MASS, "damping": (250.0, 250.0)}), loads()["balls"], jv.ConstantSpeed(120.0))
    step = 1e-2
    path = jv.export_uff(damped, home / "ema.unv", quantity="acceleration", frequencies=step * np.arange(1, 2001))
    read = jv.read_uff(path).functions
    model = ema.Model(
        np.array([each.values for each in read]), read[0].x, lower=1.0, upper=19.0, pol_order_high=20, frf_form="accelerance"
    )
    model.get_poles(show_progress=False)
    poles = jv.state_space(damped).poles()
    for pole in poles[poles.imag > 0.0]:
        frequency, damping = np.abs(pole) / (2.0 * np.pi), -pole.real / np.abs(pole)
        order = -1
        found = model.pole_freq[order][np.argmin(np.abs(model.pole_freq[order] - frequency))]
        assert found == pytest.approx(frequency, rel=1e-3)
        share = model.pole_xi[order][np.argmin(np.abs(model.pole_freq[order] - frequency))]
        assert share == pytest.approx(damping, rel=1e-2)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(path="/none/m.unv"), "path is '/none/m.unv', and its folder does not exist"),
        (dict(path="/proc/m.unv"), "path is '/proc/m.unv', which cannot be written"),
        (dict(path=400 * "m"), "path is 'mmmm"),
        (dict(quantity="jerk"), "quantity is 'jerk'; "),
        (dict(frequencies=[1.0, 2.0, 4.0]), "frequencies are not evenly spaced (steps of 1 to 2); give even ones"),
        (dict(frequencies=[1.0]), "frequencies are [1.0]; at least 2"),
        (dict(frequencies=[0.0, 1.0]), "frequencies[0] is 0"),
        (dict(frequencies=[2.0, 1.0]), "frequencies are not evenly spaced"),
        (dict(source=3), "source is 3; "),
    ],
)
def test_wrong_arguments_of_files_raise_clear_errors(change, says, tmp_path):
    with pytest.raises(jv.InputError) as error:
        jv.export_uff(**{"source": scene(), "path": tmp_path / "m.unv", **change})
    assert str(error.value).startswith(says) and list(tmp_path.iterdir()) == []


def test_free_machine_has_no_default_frequencies(tmp_path):
    free = jv.Scene(jv.one_mass(mass=50.0, stiffness=0.0, damping=0.0), loads()["balls"], jv.ConstantSpeed(100.0))
    with pytest.raises(jv.InputError, match="frequencies is missing; a machine without a natural frequency above 0"):
        jv.export_uff(free, tmp_path / "free.unv")


def test_frequencies_in_single_precision_are_even(tmp_path):
    frequencies = np.linspace(1.0, 100.0, 991, dtype=np.float32)
    path = jv.export_uff(rotor_scene(), tmp_path / "single.unv", frequencies=frequencies)
    np.testing.assert_allclose(jv.read_uff(path).functions[0].x, frequencies, rtol=1e-5)


def test_a_run_has_no_acceleration_and_no_frequencies(run, tmp_path):
    with pytest.raises(jv.InputError, match="quantity is 'acceleration', which a run does not save"):
        jv.export_uff(run, tmp_path / "m.unv", quantity="acceleration")
    with pytest.raises(jv.InputError, match=r"frequencies is .* which is an option for a scene"):
        jv.export_uff(run, tmp_path / "m.unv", frequencies=[1.0, 2.0])


@pytest.mark.parametrize("text", ["", "no file of this kind", "    -1\n    58\n", "    -1\n   151\n    -1\n", "\x00" * 99])
def test_files_of_another_kind_are_refused(text, tmp_path):
    path = tmp_path / "wrong.unv"
    path.write_text(text)
    with pytest.raises(jv.InputError, match=r"^path is "):
        jv.read_uff(path)


def test_missing_files_and_folders_are_refused(tmp_path):
    for path in (tmp_path / "none.unv", tmp_path):
        with pytest.raises(jv.InputError, match=r"^path is .*, which cannot be read"):
            jv.read_uff(path)


@pytest.mark.parametrize("package", ["pyuff", "control", "scipy.io"])
def test_missing_packages_are_named(package, tmp_path, monkeypatch):
    import importlib

    real = importlib.import_module

    def missing(name, *rest):
        if name == package:
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(importlib, "import_module", missing)
    calls = {
        "pyuff": lambda: jv.export_uff(scene(), tmp_path / "m.unv"),
        "control": lambda: jv.state_space(scene()).control(),
        "scipy.io": lambda: jv.state_space(scene()).save(tmp_path / "m"),
    }
    with pytest.raises(jv.InputError, match=r"is not installed; install it with: pip install '\.\["):
        calls[package]()


@pytest.mark.parametrize("effects", [(), (jv.CubicSupport(1e9),)])
def test_header_states_that_nonlinear_supports_are_linearized(home, effects):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0), effects)
    path = jv.export_uff(scene, home / "supports.unv", frequencies=[1.0, 2.0])
    (header,) = [each for each in pyuff.UFF(str(path)).read_sets() if each["type"] == 151]
    assert ("linear parts of its nonlinear supports" in header["description"]) == bool(effects)
