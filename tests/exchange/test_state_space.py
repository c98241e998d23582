"""State-space models against branches, whirl, averaged growth and finite differences."""

import control
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io
import scipy.signal
from scenes import BALLS, ROTOR, TWO_MASS, machines, scene

import jaxvib as jv
from jaxvib.equations.averaged import Amplitudes, averaged_field
from jaxvib.machine.effects.terms import SupportForce

UNBALANCE = 3 * 0.8 * 0.12
EFFECTS = (jv.CubicSupport(1e9, platform=1), jv.Stop(1e6, gap=0.01, platform=2))


def rotor_scene():
    return jv.Scene(jv.rotor(**ROTOR), jv.pendulums(count=4, mass=0.05, radius=0.08, drag=0.1), jv.ConstantSpeed(460.0))


def rows(model, name):
    return [k for k, each in enumerate(model.outputs) if each.name.startswith(name)]


def test_frequency_response_equals_branches():
    found, model = jv.branches(scene()), jv.state_space(scene())
    omega = np.asarray(found.omega)
    response = model.frequency_response(omega)[:, :, 2] * (-1j * UNBALANCE * omega**2)[:, None]
    moved = response[:, rows(model, "displacement")]
    assert np.max(np.abs(moved - found.displacement) / np.abs(found.displacement)) < 1e-10
    force = np.abs(response[:, rows(model, "foundation_force")[0]])
    np.testing.assert_allclose(force, found.foundation_force, rtol=1e-10)


def test_force_at_exciter_equals_force_on_its_platform():
    model = jv.state_space(scene("three_mass"))
    assert [each.name for each in model.inputs] == ["force.y1", "force.y2", "force.y3", "exciter.up"]
    assert np.array_equal(model.B[:, 2], model.B[:, 3]) and np.array_equal(model.D[:, 2], model.D[:, 3])


def test_two_exciters_give_the_responses_of_each():
    """A force at an exciter is a force on its platform, whose mass includes the loads of that exciter."""
    two = machines()["two_mass"]
    placed = [
        jv.Exciter(jv.balls(**BALLS), jv.ConstantSpeed(n), at=k, direction=d) for k, n, d in ((1, 100.0, 1), (2, 60.0, -1))
    ]
    model = jv.state_space(jv.Scene(two, exciters=placed))
    assert [each.name for each in model.inputs] == ["force.y1", "force.y2", "exciters[0].up", "exciters[1].up"]
    assert np.array_equal(model.B[:, :2], model.B[:, 2:]) and np.array_equal(model.D[:, :2], model.D[:, 2:])
    mass = np.asarray(two.mass) + 3 * 0.8
    np.testing.assert_allclose(model.B[2:, :2], np.diag(1.0 / mass), rtol=1e-12)
    assert "at the rotor speed 20 rad/s" in model.about
    assert model.control().input_labels[2] == "exciters_0_up"


def test_force_on_a_body_has_the_moment_of_its_lever():
    """M = diag(m, m, J) with loads as masses at their place; a force F at (x, y) has the moment x F_y - y F_x."""
    supports = [jv.support(at=(x, -0.2), stiffness=(2e5, 4e5), damping=(2e3, 4e3)) for x in (-1.2, 1.2)]
    body = jv.plane_body(mass=900.0, inertia=300.0, supports=supports)
    exciter = jv.Exciter(drive=jv.ConstantSpeed(100.0), unbalance=0.5, at=(0.3, 0.4))
    model = jv.state_space(jv.Scene(body, exciters=[exciter]))
    assert [each.name for each in model.inputs][3:] == ["exciter.across", "exciter.up"]
    expected = np.array([[1 / 900, 0.0], [0.0, 1 / 900], [-0.4 / 300, 0.3 / 300]])
    np.testing.assert_allclose(model.B[3:, 3:], expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(model.C[-2:, :3], [[4e5, 0.0, 2 * 0.2 * 2e5], [0.0, 8e5, 0.0]], rtol=1e-9, atol=1e-6)


def test_poles_equal_whirl():
    model, whirl = jv.state_space(rotor_scene(), rotor_speed=300.0), jv.whirl(rotor_scene(), [300.0])
    expected = -np.asarray(whirl.decay[0]) + 1j * np.asarray(whirl.speed[0])
    poles = model.poles()
    np.testing.assert_allclose(np.sort_complex(poles[poles.imag > 0]), np.sort_complex(expected), rtol=1e-10)


def test_nonlinear_supports_at_rest_have_no_part():
    plain, supported = jv.state_space(scene()), jv.state_space(scene(effects=EFFECTS))
    assert all(np.array_equal(one, two) for one, two in zip(plain[:4], supported[:4], strict=True))


class Linear(jv.Effect):
    """Support of platform 2 with a linear spring and damper."""

    kind: str = eqx.field(static=True, kw_only=True, default="linear")

    def terms(self):
        """Return the force of the support."""
        energy, resistance = (lambda x: 1.5e4 * jnp.sum(x**2)), (lambda x, v: 70.0 * v)
        return (SupportForce(lambda machine: machine.rows_at(2), energy, resistance),)


def test_linear_parts_of_supports_belong_to_the_machine():
    stiffer = {**TWO_MASS, "stiffness": np.add(TWO_MASS["stiffness"], (0.0, 3e4))}
    stiffer["damping"] = np.add(TWO_MASS["damping"], (0.0, 70.0))
    expected = jv.state_space(jv.Scene(jv.two_mass(**stiffer), jv.balls(**BALLS), jv.ConstantSpeed(120.0)))
    found = jv.state_space(jv.Scene(jv.two_mass(**TWO_MASS), jv.balls(**BALLS), jv.ConstantSpeed(120.0), Linear()))
    for one, two in zip(found[:4], expected[:4], strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12 * np.max(np.abs(two)))


@pytest.mark.parametrize("mode", [3, 4, 5])
def test_poles_of_a_jam_equal_its_growth(mode):
    jams = jv.phase_jams(scene())
    jam = jv.jam_modes(scene()).select(mode)
    growth = float(jams.growth[np.argmin(np.abs(jams.omega - jam.omega) + np.max(np.abs(jams.phase), axis=1))])
    assert np.max(jv.state_space(scene(), jam).poles().real) == pytest.approx(growth, rel=1e-8)


def test_jam_of_opposite_loads_has_its_growth():
    jams = jv.phase_jams(scene())
    for k in range(len(jams.omega)):
        jam = jams.select(k)
        assert np.max(jv.state_space(scene(), jam).poles().real) == pytest.approx(float(jam.growth), rel=1e-7)


@pytest.mark.parametrize("in_jam", [False, True])
def test_unknown_force_on_the_foundation_is_no_output(in_jam):
    machine = jv.from_matrices([[50.0]], [[30.0]], [[4e4]], places=[[0]])
    turning = jv.Scene(machine, jv.balls(**BALLS), jv.ConstantSpeed(60.0))
    found = jv.state_space(turning, jv.jam_modes(turning).select(1) if in_jam else "rest")
    names = ["load_speed", "amplitude.q1"] if in_jam else ["displacement.q1", "velocity.q1", "acceleration.q1"]
    assert [each.name for each in found.outputs] == names
    assert len(found.C) == len(found.D) == len(found.y0) == len(names)


def test_state_of_a_jam_does_not_depend_on_its_common_phase():
    """All phases are shifted by 0.3 rad, and the complex amplitudes with them."""
    jam = jv.phase_jams(scene()).select(0)
    turned = (jam.phase + 0.3, jam.displacement * np.exp(0.3j))
    shifted = eqx.tree_at(lambda j: (j.phase, j.displacement), jam, turned)
    np.testing.assert_allclose(jv.state_space(scene(), shifted).x0, jv.state_space(scene(), jam).x0, atol=1e-12)


def test_clockwise_rotation_reverses_the_gyroscopic_terms():
    clockwise, rest, other = (jv.state_space(rotor_scene(), rotor_speed=n).A for n in (-300.0, 0.0, 300.0))
    np.testing.assert_allclose(clockwise - rest, rest - other, atol=1e-9 * np.max(np.abs(rest)))
    assert np.max(np.abs(other - rest)) > 1.0


def test_jam_outputs_follow_the_jam_over_rotor_speed():
    modes = [jv.jam_modes(scene(speed=n)).select(3) for n in (120.0, 119.99, 120.01)]
    model = jv.state_space(scene(), modes[0])
    steady = model.D - model.C @ np.linalg.solve(model.A, model.B)
    values = [np.array([m.omega, *m.amplitude, m.foundation_force]) for m in modes]
    np.testing.assert_allclose(steady[:, 0], (values[2] - values[1]) / 0.02, rtol=1e-5)
    np.testing.assert_allclose(model.y0, values[0], rtol=1e-9)


def test_jam_model_follows_the_averaged_equations():
    jam = jv.jam_modes(scene()).select(3)
    model, field, step = jv.state_space(scene(), jam), averaged_field(scene()), 1e-6

    def flow(x):
        y, v = x[0:2] + 1j * x[2:4], x[4:6] + 1j * x[6:8]
        at = field(0.0, Amplitudes(y, v, x[8:11], np.concatenate([[0.0], x[11:]])))
        y, v = at.displacement - 1j * at.phase[0] * y, at.velocity - 1j * at.phase[0] * v
        return np.concatenate([y.real, y.imag, v.real, v.imag, at.rate, at.phase[1:] - at.phase[0]])

    for k, direction in enumerate(step * np.eye(len(model.x0))):
        column = (flow(model.x0 + direction) - flow(model.x0 - direction)) / (2.0 * step)
        assert np.max(np.abs(column - model.A[:, k])) < 1e-6 * np.max(np.abs(model.A))


def test_mat_file_is_read_back_bit_for_bit(tmp_path):
    model = jv.state_space(scene())
    read = scipy.io.loadmat(model.save(tmp_path / "machine"), simplify_cells=True)
    assert all(read[name].tobytes() == np.asarray(getattr(model, name)).tobytes() for name in "ABCD")
    assert list(read["input_names"]) == ["force.y1", "force.y2", "exciter.up"] and list(read["input_units"]) == ["N"] * 3
    assert read["about"] == model.about and str(read["output_units"][-1]) == "N"


def test_other_packages_have_the_same_response():
    model, omega = jv.state_space(scene()), 37.0
    expected = model.frequency_response(omega)[0]
    ours = model.control()
    np.testing.assert_allclose(ours(1j * omega), expected, rtol=1e-12)
    assert ours.input_labels[0] == "force_y1" and ours.output_labels[-1] == "foundation_force_up"
    assert isinstance(model.scipy(), scipy.signal.StateSpace) and np.array_equal(model.scipy().B, model.B)
    time, moved, _ = scipy.signal.lsim(model.scipy(), np.eye(3)[:1].repeat(200, 0), np.linspace(0.0, 0.2, 200))
    np.testing.assert_allclose(control.forced_response(ours, time, np.eye(3)[:1].repeat(200, 0).T).outputs, moved.T, atol=1e-12)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda s: jv.state_space(s, "jam"), "at is 'jam'; "),
        (lambda s: jv.state_space(s, jv.jam_modes(s).select(1, throw=False)), "at must be one existing jam"),
        (lambda s: jv.state_space(s, jv.jam_modes(scene("one_mass")).select(1, throw=False)), "at is "),
        (
            lambda s: jv.state_space(s, jv.jam_modes(scene(load="rollers")).select(3)),
            "at is not an equilibrium of the averaged",
        ),
        (lambda s: jv.state_space(s, jv.jam_modes(s).select(3), rotor_speed=3.0), "rotor_speed is 3.0, but a jam has its own"),
        (lambda s: jv.state_space(s).save("/none/x.mat"), "path is '/none/x.mat', and its folder does not exist"),
    ],
)
def test_wrong_arguments_raise_clear_errors(call, says):
    with pytest.raises(jv.InputError, match="^" + says.replace("(", r"\(")):
        call(scene())


def test_hostile_frequencies_of_responses_are_refused():
    for omega in ("a", {}, [1.0 + 1j], [float("nan")], object()):
        with pytest.raises(jv.InputError, match=r"^omega"):
            jv.state_space(scene()).frequency_response(omega)


def test_residual_of_a_jam_is_relative_to_its_drag():
    """A displacement that is 0.1 % too large moves the loads; the largest of their accelerations is stated."""
    jams = jv.phase_jams(scene())
    jam = jams.select(int(np.argmax(np.ptp(jams.phase, axis=1))))  # loads at different angles
    moved = eqx.tree_at(lambda j: j.displacement, jam, 1.001 * jam.displacement)
    field, y = averaged_field(scene()), moved.displacement * np.exp(-1j * moved.phase[0])
    rates = np.abs(field(0.0, Amplitudes(y, 1j * jam.omega * y, 0.0 * jam.phase + jam.omega, jam.phase - jam.phase[0])).rate)
    residual = np.max(rates) / np.max(np.asarray(field.drag) * abs(120.0 - float(jam.omega)) / np.asarray(field.inertia))
    assert np.min(rates) < 0.9 * np.max(rates)
    with pytest.raises(jv.InputError, match=rf"is not an equilibrium .* \(relative residual {residual:.1e}\); use a"):
        jv.state_space(scene(), moved)
    small = eqx.tree_at(lambda j: j.displacement, jam, (1.0 + 0.5e-6 * 1e-3 / residual) * jam.displacement)
    assert jv.state_space(scene(), small).A.shape == (13, 13)


def test_infinite_response_of_a_free_machine_is_refused():
    free = jv.Scene(jv.one_mass(mass=50.0, stiffness=0.0, damping=0.0), jv.balls(**BALLS), jv.ConstantSpeed(60.0))
    model = jv.state_space(free)
    assert np.all(np.isfinite(model.frequency_response([1.0])))
    with pytest.raises(jv.InputError, match="omega contains an undamped natural frequency, such as 0"):
        model.frequency_response([1.0, 0.0])
