"""Parts of an averaged run in closed form: units, saved times, status, gravity, text, search for the weakest motors."""

from types import SimpleNamespace

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scenes import turning_body

import jaxvib as jv
from jaxvib.equations.averaged import Amplitudes, averaged_model
from jaxvib.equations.linear import linear_model
from jaxvib.equations.model import assemble
from jaxvib.machine.scene_field import SCENE
from jaxvib.motion.envelope import envelope as module
from jaxvib.motion.envelope import run_up as run_up_module
from jaxvib.motion.envelope.result import Envelopes, plot_histories

G = 9.81


def platform(drag=0.5, effects=(), count=2, speed=60.0):
    loads = jv.balls(count=count, mass=0.05, radius=0.1, drag=drag)
    return jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0), loads, jv.ConstantSpeed(speed), effects)


def body():
    springs = [jv.support(at=(x, -0.2), stiffness=(3e4, 3e4), damping=(600.0, 600.0)) for x in (-0.6, 0.6)]
    return jv.plane_body(mass=300.0, inertia=75.0, supports=springs)


def motor(speed=100.0, torque=60.0):
    return jv.DCMotor(speed, stall_torque=torque, inertia=0.05)


def mixed(effects=(), drives=None):
    """A clockwise motor with an unbalance of 0.4 kg m, an anticlockwise tube with two balls of 0.1 kg m each."""
    first, second = drives or (motor(), jv.ConstantSpeed(80.0))
    loads = jv.balls(count=2, mass=0.5, radius=0.2, drag=2.0)
    exciters = [
        jv.Exciter(drive=first, unbalance=0.4, at=(-0.5, 0.3), direction=-1),
        jv.Exciter(loads, second, at=(0.4, 0.1)),
    ]
    return jv.Scene(body(), exciters=exciters, effects=effects)


UNITS = {
    jv.Envelope: {
        "omega": ("rad/s", ()),
        "load_speed": ("rad/s", ("load",)),
        "amplitude": ("m or rad", ("coordinate",)),
        "foundation_force": ("N", ()),
        "drift": ("", ()),
        "ripple": ("rad", ("load",)),
        "steps": ("", ()),
        "rejected": ("", ()),
    },
    Envelopes: {
        "time": ("s", ("time",)),
        "displacement": ("m or rad", ("time", "coordinate")),
        "velocity": ("m/s or rad/s", ("time", "coordinate")),
        "amplitude": ("m or rad", ("time", "coordinate")),
        "foundation_force": ("N", ("time", "direction")),
        "omega": ("rad/s", ("time",)),
        "load_speed": ("rad/s", ("time", "load")),
        "phase": ("rad", ("time", "load")),
        "rotor_speeds": ("rad/s", ("time",)),
        "ripple": ("rad", ("time", "load")),
    },
    jv.MotorRunUp: {
        "resonances": ("rad/s", ("resonance",)),
        "speed": ("rad/s", ("exciter",)),
        "caught_at": ("", ("exciter",)),
        "peak_amplitude": ("m or rad", ("coordinate",)),
        "peak_force": ("N", ()),
        "least_torque": ("", ()),
    },
}
PREFIXES = {jv.Envelope: {"trajectory": "trajectory_", "window": "window_"}, jv.MotorRunUp: {"run": "run_"}}


@pytest.mark.parametrize("part", UNITS, ids=lambda part: part.__name__)
def test_numbers_of_results_have_units_and_axes(part):
    fields = {name: field.metadata for name, field in part.__dataclass_fields__.items()}
    assert {name: (m["unit"], m["axes"]) for name, m in fields.items() if "unit" in m} == UNITS[part]
    assert {name: m["prefix"] for name, m in fields.items() if m.get("prefix")} == PREFIXES.get(part, {})
    assert part is Envelopes or fields["scene"] == SCENE
    if part is Envelopes:
        assert fields["rotor_speeds"]["name"] == "rotor_speed"


def test_units_scale_each_part_of_the_state():
    units = module._Units(jnp.asarray(2e-3), jnp.asarray(50.0))
    state = Amplitudes(
        jnp.array([2e-3 - 4e-3j, 6e-3j]), jnp.array([0.1 + 0.3j, -0.2]), jnp.array([50.0, 25.0]), jnp.array([0.3, -0.3])
    )
    flat = units.pack(state)
    np.testing.assert_allclose(flat, [1.0, 0.0, -2.0, 3.0, 1.0, -2.0, 3.0, 0.0, 1.0, 0.5, 0.3, -0.3], atol=1e-15)
    back = units.unpack(jnp.stack([flat, 2.0 * flat]), 2)
    for name in ("displacement", "velocity", "rate", "phase"):
        value = np.asarray(getattr(state, name))
        np.testing.assert_allclose(getattr(back, name), np.stack([value, 2.0 * value]), rtol=1e-14)


def test_units_are_the_largest_unbalance_and_speed():
    plain, several = (module._units(assemble(scene)) for scene in (platform(), mixed()))
    np.testing.assert_allclose([plain.length, plain.speed], [2 * 0.05 * 0.1 / 50.0, 60.0], rtol=1e-12)
    np.testing.assert_allclose([several.length, several.speed], [0.4 / np.mean([300.0, 300.0, 75.0]), 100.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("frequencies", "end", "periods", "window"),
    [
        ([10.0, 40.0], 1e3, 20, 2.0 * np.pi * 20 / 10.0),
        ([0.0, 40.0], 1e3, 20, 2.0 * np.pi * 20 / 40.0),
        ([0.0, 0.0], 1e3, 20, 2.0 * np.pi * 20 / 100.0),
        ([0.5, 40.0], 1e3, 20, 2.0 * np.pi * 256 / 100.0),
        ([10.0, 40.0], 8.0, 20, 4.0),
    ],
)
def test_window_holds_periods_of_the_slowest_resonance(frequencies, end, periods, window):
    last, whole = module._saves(jnp.asarray(100.0), jnp.array(frequencies), jnp.asarray(end), 5, periods)
    np.testing.assert_allclose(last.ts, np.linspace(end - window, end, 512), rtol=1e-12)
    np.testing.assert_allclose(whole.ts, np.linspace(0.0, end, 5), rtol=1e-12)
    assert len(module._saves(jnp.asarray(100.0), jnp.array(frequencies), jnp.asarray(end), 0, periods)) == 1


@pytest.mark.parametrize(
    ("result", "exists", "finite", "turning", "name"),
    [
        ("successful", True, True, True, "done"),
        ("successful", True, True, False, "not_turning"),
        ("successful", True, False, False, "not_finite"),
        ("max_steps_reached", True, True, True, "max_steps_reached"),
        ("dt_min_reached", True, True, True, "not_finite"),
        ("nonlinear_divergence", True, True, True, "no_step"),
        ("max_steps_reached", False, False, False, "no_start"),
    ],
)
def test_status_follows_from_the_end_of_a_run(result, exists, finite, turning, name):
    found = module._status(getattr(diffrax.RESULTS, result), *(jnp.asarray(x) for x in (exists, finite, turning)))
    assert bool(found == getattr(jv.EnvelopeStatus, name))


def test_hints_name_the_remedy():
    assert module._hint(7, "max_steps_reached") == " (7 steps); give a larger max_steps, a larger tolerance or a shorter run"
    assert module._hint(7, "no_step") == "; give a smaller tolerance, or leave the solver out"
    assert module._hint(7, "not_finite") == ""


def test_state_of_rest_counts_phases_from_their_mean():
    scene = platform(count=2)
    rest = module._at_rest(scene)
    (angle,) = jv.initial_state(scene).angle
    np.testing.assert_allclose(rest.phase, angle - np.mean(angle), atol=1e-15)
    assert np.ptp(rest.phase) == pytest.approx(np.pi / 180.0) and rest.rate.tolist() == [0.0, 0.0]
    assert rest.displacement.tolist() == [0.0] == rest.velocity.tolist() and rest.velocity.dtype == complex


def test_envelope_of_a_state_has_signed_speeds():
    scene = mixed()
    model, field = linear_model(scene), averaged_model(linear_model(scene))
    y, v = np.array([1e-3, 2e-3j, -1e-3 + 1e-3j]), np.array([0.1j, -0.2, 0.05 - 0.1j])
    state = Amplitudes(jnp.asarray(y), jnp.asarray(v), jnp.array([90.0, 70.0, 50.0]), jnp.array([0.1, 0.2, -0.3]))
    found = module._at(model, field, jnp.asarray(2.0), state)
    assert (float(found.time), float(found.omega)) == (2.0, 70.0)
    assert found.load_speed.tolist() == [-90.0, 70.0, 50.0] and [float(n) for n in found.rotor_speeds] == [-90.0, 80.0]
    np.testing.assert_allclose(found.amplitude, np.abs(y), rtol=1e-14)
    force = 6e4 * y + 1200.0 * v
    force = [force[0] + 0.2 * (6e4 * y[2] + 1200.0 * v[2]), force[1]]
    np.testing.assert_allclose(found.foundation_force, np.abs(force), rtol=1e-12)
    backward = np.array([v[0] + 1j * v[1] + (-0.3 - 0.5j) * v[2], *[v[0] - 1j * v[1] + (-0.1 - 0.4j) * v[2]] * 2])
    unbalance, inertia = np.array([0.4, 0.1, 0.1]), np.asarray(field.inertia)
    np.testing.assert_allclose(found.ripple, unbalance * np.abs(backward) / (8.0 * inertia * 70.0), rtol=1e-12)
    np.testing.assert_array_equal(found.displacement, y)
    np.testing.assert_array_equal(found.velocity, v)
    np.testing.assert_array_equal(found.phase, [0.1, 0.2, -0.3])


@pytest.mark.parametrize("ways", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_clockwise_speeds_are_negative(ways):
    exciters = [
        jv.Exciter(drive=motor(), unbalance=0.4, at=(x, 0.3), direction=way) for x, way in zip((-0.5, 0.5), ways, strict=True)
    ]
    found = module._anticlockwise(jv.Scene(body(), exciters=exciters), jnp.array([90.0, 70.0]))
    np.testing.assert_array_equal(found, [90.0 * ways[0], 70.0 * ways[1]])


def test_measured_speeds_are_positive_in_each_direction():
    late = np.arange(8) >= 4
    speed = np.stack([np.full(8, -90.0), np.where(late, 71.0, 69.0), np.full(8, 50.0)], axis=1)
    window = SimpleNamespace(
        time=np.arange(8.0),
        amplitude=jnp.zeros((8, 3)),
        foundation_force=jnp.asarray(np.where(late, 3e-3, 2e-3)[:, None] * np.array([1.0, 0.0])),
        load_speed=jnp.asarray(speed),
    )
    found = module._measure(assemble(mixed()), window)
    assert found.load_speed.tolist() == [-90.0, 70.0, 50.0] and float(found.omega) == 70.0
    np.testing.assert_allclose(found.foundation_force, 3e-3, rtol=1e-12)
    np.testing.assert_allclose(found.drift, 1.0 / 70.0, rtol=1e-12)  # the force of 3 mN is small against 1e-4 S n^2
    window.foundation_force = 100.0 * window.foundation_force
    np.testing.assert_allclose(module._measure(assemble(mixed()), window).drift, 1.0 / 3.0, rtol=1e-12)


def window_of(load_speeds, rotor_speeds):
    speeds = tuple(jnp.asarray(n) for n in rotor_speeds)
    return SimpleNamespace(load_speed=jnp.asarray(load_speeds, float), rotor_speeds=speeds)


def begins(*rates):
    return SimpleNamespace(rate=jnp.asarray(rates, float))


def is_turning(scene, begin, window):
    scene = jv.Scene(scene.machine, exciters=scene.exciters, effects=scene.effects)
    return bool(module._can_turn_fully(scene, averaged_model(linear_model(scene)), begin, window))


def test_loads_turn_above_the_speed_that_passes_the_top():
    """I w^2/2 > m g R: the ball's speed is above sqrt(2 g / (kappa R)); its drag lifts it if D n > m g R."""
    loads = jv.balls(count=2, mass=0.05, radius=0.1, drag=0.5)
    pass_top = np.sqrt(2.0 * G * 0.05 * 0.1 / float(loads.inertia_factor() * 0.05 * 0.1**2))
    least = 0.05 * G * 0.1 / 60.0 / 0.1**2  # drag that lifts a ball
    strong, weak = (jv.Scene(body(), exciters=[jv.Exciter(
        jv.balls(count=2, mass=0.05, radius=0.1, drag=share * least), jv.ConstantSpeed(60.0)), jv.Exciter(
        drive=jv.ConstantSpeed(60.0), unbalance=0.1)], effects=jv.Gravity()) for share in (1.01, 0.99))  # fmt: skip

    def turns(scene, first, last):
        ends = [[60.0, last * pass_top, 60.0], [60.0, 1.1 * last * pass_top, 60.0]]
        return is_turning(scene, begins(60.0, first * pass_top, 60.0), window_of(ends, [[0.0, 60.0], [60.0, 60.0]]))

    assert turns(strong, 0.0, 1.01) and not turns(strong, 0.0, 0.99)
    assert turns(weak, 1.01, 1.01) and not turns(weak, 0.99, 1.01) and not turns(weak, 1.01, 0.99)
    without = jv.Scene(body(), exciters=weak.exciters)
    assert is_turning(without, begins(0.0, 0.0, 0.0), window_of(np.zeros((2, 3)), [[0.0, 0.0]] * 2))


def test_unbalance_turns_above_the_speed_that_passes_the_top():
    """J w^2/2 > S g; the motor lifts it if its torque at rest is above 0.7246 S g = 2.84 N m."""
    pass_top = np.sqrt(2.0 * 0.4 * G / 0.05)
    for torque, first, last, expected in (
        (2.85, 0.0, 1.01, 1),
        (2.85, 0.0, 0.99, 0),
        (2.83, 1.01, 1.01, 1),
        (2.83, 0.99, 1.01, 0),
    ):
        scene = mixed((jv.Gravity(),), (motor(torque=torque), jv.ConstantSpeed(80.0)))
        ends = window_of([[-last * pass_top, 80.0, 80.0]] * 2, [[-50.0] * 2, [80.0] * 2])
        assert is_turning(scene, begins(first * pass_top, 80.0, 80.0), ends) == bool(expected)


def test_gravity_on_loads_has_a_height_and_a_torque():
    scene = platform(effects=(jv.Gravity(),))
    height, torque = module._potential_of_loads(scene, scene.exciters[0])
    np.testing.assert_allclose(height, [2.0 * 0.05 * G * 0.1] * 2, rtol=1e-9)
    np.testing.assert_allclose(torque, [0.05 * G * 0.1] * 2, rtol=1e-9)
    assert module._potential_of_loads(platform(), scene.exciters[0]) is None
    assert module._potential_of_loads(scene, jv.Exciter(drive=motor(), unbalance=0.4)) is None


def judged(phase, rate, plain, drift=1e-4, status="done", growth=1.0, end=2.0):
    """Name of the status of a run with the given phases and speeds over `end` seconds."""
    phase, scene = np.asarray(phase, float), platform() if plain else mixed()
    window = SimpleNamespace(
        phase=phase,
        time=np.linspace(3.0, 3.0 + end, len(phase)),
        load_speed=np.asarray(rate, float),
        omega=np.full(len(phase), 60.0),
        displacement=np.zeros((len(phase), 1)),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_growth_at_end", lambda *_: np.asarray(growth))
        found = module._with_separation_status(Run(scene, window, drift, getattr(jv.EnvelopeStatus, status)))
    return module.status_name(found.status)


class Run(eqx.Module):
    scene: jv.Scene
    window: object = eqx.field(static=True)
    drift: float
    status: jv.EnvelopeStatus


NEAR, APART = [[0.0, 0.1], [0.05, 0.1]], [[0.0, 1.0], [1e-4, 1.0]]
TURNING = [[60.0, -60.0], [60.0, -60.0]]


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ((NEAR, TURNING, True), "would_separate"),
        ((APART, TURNING, True), "done"),
        ((APART, TURNING, False), "unstable"),
        ((NEAR, TURNING, False), "done"),  # the phases change by 0.05 rad: not one speed
        (([[0.0], [0.0]], [[60.0], [60.0]], False), "done"),
        ((APART, [[60.0, 0.0], [60.0, -60.0]], False), "done"),
        ((NEAR, TURNING, True, 2e-3), "done"),
        ((NEAR, TURNING, True, 1e-4, "not_turning"), "not_turning"),
        ((NEAR, TURNING, True, 1e-4, "done", 4.9e-3), "done"),
        ((NEAR, TURNING, True, 1e-4, "done", 5.1e-3), "would_separate"),
        ((NEAR, TURNING, True, 1e-4, "done", np.nan), "done"),
    ],
)
def test_settled_runs_that_grow_have_a_status(given, name):
    assert judged(*given) == name


def window_at(end, phase=(0.0, 0.0)):
    rows = np.ones((3, 1))
    return Envelopes(
        time=jnp.linspace(0.0, end, 3),
        displacement=jnp.asarray(rows * 1e-3 + 0j),
        velocity=jnp.asarray(rows * 0.06j),
        amplitude=jnp.asarray(rows * 1e-3),
        foundation_force=jnp.asarray(rows * 40.0),
        omega=jnp.full(3, 58.0),
        load_speed=jnp.asarray(rows * np.array([57.0, 59.0])),
        phase=jnp.asarray(rows * np.array(phase)),
        rotor_speeds=(jnp.array([50.0, 55.0, 60.0]),),
        ripple=jnp.asarray(rows * np.array([1e-3, 2e-3])),
    )


def run_of(status="done", drift=1e-4, trajectory=None):
    return jv.Envelope(
        omega=jnp.asarray(20.0 * np.pi),
        load_speed=jnp.array([19.0 * np.pi, 21.0 * np.pi]),
        amplitude=jnp.array([1e-3]),
        foundation_force=jnp.asarray(40.0),
        drift=jnp.asarray(drift),
        ripple=jnp.array([1e-3, 2e-3]),
        status=getattr(jv.EnvelopeStatus, status),
        trajectory=trajectory,
        window=window_at(5.0),
        steps=jnp.asarray(31),
        rejected=jnp.asarray(4),
        scene=platform(),
    )


def test_summary_states_the_duration_of_a_spin_up():
    run = run_of()
    run = eqx.tree_at(lambda r: r.scene.exciters[0].drive, run, jv.SpinUp(60.0, "2.5 s"))
    assert ": 5 s (spin-up during the first 2.5 s), 31 steps" in run.summary()


def test_speeds_state_that_a_changing_rotor_speed_is_the_last():
    steady, changing = jnp.array([59.9, 60.0]), jnp.array([50.0, 60.0])
    assert run_of().speeds_text(platform(), (steady,)).endswith("rotor at 572.958 rpm")
    assert run_of().speeds_text(platform(), (changing,)).endswith("rotor at 572.958 rpm at the end")


def test_summary_of_a_run():
    lines = run_of().summary().splitlines()
    assert lines[0] == "the averaged run reached its end: 5 s, 31 steps (4 rejected), settled (drift 1.0e-04)"
    assert lines[1] == "  loads turn at 600 rpm (each: 570, 630 rpm), rotor at 572.958 rpm at the end"
    assert lines[2] == "  amplitude, zero to peak: y1 1 mm; foundation force 40 N"
    assert lines[3].startswith("  y1: stroke 2 mm peak to peak, ") and lines[5].startswith("  support 1: ")
    assert lines[4].startswith("  static deflection, down: y1 ")
    assert lines[-1] == "  averaged: relative error of the order of 2.0e-03" and len(lines) == 9
    grown = eqx.tree_at(lambda run: run.amplitude, run_of("not_finite"), jnp.array([jnp.nan]))
    assert len(grown.summary().splitlines()) == 4
    assert "steps (4 rejected), not settled: run longer (drift 2.0e-03)" in run_of(drift=2e-3).summary()
    for name, when in (("would_separate", "while the loads are at one angle"), ("unstable", "until disturbed")):
        run = run_of(name)
        first, second = run.summary().splitlines()[:2]
        assert first == f"not settled: {run.message}" and not bool(run.settled)
        assert second == f"the averaged run reached its end: 5 s, 31 steps (4 rejected), periodic only {when} (drift 1.0e-04)"
    assert bool(run_of().settled) and not bool(run_of(drift=1e-3).settled)


@pytest.mark.parametrize("stiffness", [0.0, 4e4])
def test_summary_names_displacements_that_no_spring_returns(stiffness):
    run = run_of()
    machine = jv.one_mass(mass=50.0, stiffness=stiffness, damping=100.0)
    free = eqx.tree_at(lambda run: run.scene, run, jv.Scene(machine, run.scene.loads, run.scene.drive))
    assert ("amplitudes include its displacement from the start" in free.summary()) == (stiffness == 0.0)


def test_plot_of_a_run_shows_its_histories():
    run = run_of(trajectory=window_at(9.0))
    axes = plot_histories(run, resonances=[28.0, 99.0], unit="rad/s").axes
    lines = [line.get_xydata() for line in axes[1].get_lines()]
    assert len(axes) == 3 and lines[0][-1].tolist() == [9.0, 57.0] and lines[1][-1].tolist() == [9.0, 59.0]
    assert lines[2][:, 1].tolist() == [50.0, 55.0, 60.0] and lines[-1][0, 1] == 28.0 and len(lines) == 4
    assert axes[0].get_lines()[0].get_xydata()[-1].tolist() == [9.0, 1.0] and axes[0].get_legend_handles_labels()[1] == ["y1"]
    assert axes[2].get_lines()[0].get_xydata()[0].tolist() == [0.0, 40.0]
    _, given = plt.subplots(3)
    assert run_of().plot(unit="rpm", ax=given) is given and given[0].get_lines()[0].get_xydata()[-1, 0] == 5.0
    np.testing.assert_allclose(given[1].get_lines()[0].get_ydata(), 57.0 * 30.0 / np.pi)
    plt.close("all")
    unbalanced = eqx.tree_at(lambda r: (r.window, r.scene), run_of(), (several_window(), mixed()))
    speeds = plot_histories(unbalanced, unit="rad/s").axes[-2].get_lines()
    assert [line.get_ydata()[0] for line in speeds] == [70.0, 71.0, -90.0, 80.0]  # two balls, then the rotors


def several_window():
    window = window_at(5.0)
    rows = np.ones((3, 1))
    return eqx.tree_at(
        lambda w: (w.amplitude, w.load_speed, w.rotor_speeds, w.foundation_force),
        window,
        (
            jnp.asarray(rows * np.array([1e-3, 2e-3, 3e-3])),
            jnp.asarray(rows * np.array([-90.0, 70.0, 71.0])),
            (jnp.full(3, -90.0), jnp.full(3, 80.0)),
            jnp.asarray(rows * np.array([1.0, 2.0])),
        ),
    )


def ended(status, *speeds):
    windows = tuple(jnp.asarray([n - 0.5, n + 0.5]) for n in speeds)
    return SimpleNamespace(status=getattr(jv.EnvelopeStatus, status), window=SimpleNamespace(rotor_speeds=windows))


@pytest.mark.parametrize(
    ("status", "speeds", "caught", "name"),
    [
        ("done", (-10.4, 80.0), [1, 0], "caught"),
        ("done", (-10.6, 80.0), [2, 0], "caught"),
        ("done", (-20.9, 80.0), [2, 0], "caught"),
        ("done", (-21.1, 5.0), [0, 0], "passed"),  # 96 rad/s is above 0.95 of the working speed; an ideal drive is not caught
        ("unstable", (-90.0, 80.0), [0, 0], "passed"),
        ("would_separate", (-90.0, 80.0), [0, 0], "passed"),
        ("not_turning", (-5.0, 80.0), [1, 0], "not_turning"),
        ("max_steps_reached", (-90.0, 80.0), [0, 0], "not_finished"),
    ],
)
def test_exciter_is_caught_by_the_lowest_resonance_ahead(status, speeds, caught, name):
    speed, at, found = run_up_module._judgement(mixed(), ended(status, *speeds), np.array([10.0, 20.0, 96.0]))
    np.testing.assert_allclose(speed, [-speeds[0], speeds[1]])
    assert at.tolist() == caught and found == name


@pytest.mark.parametrize(
    ("threshold", "expected"),
    [(0.3, 0.3), (0.9, 0.9), (1.7, 1.7), (30.0, 30.0), (0.016, 0.016), (70.0, np.nan), (0.01, 1.0 / 64.0)],
)
def test_least_torque_is_found_by_bisection(monkeypatch, threshold, expected):
    def at_factor(scene, end, *, save, throw):
        assert float(end) == 9.0 and save == "window" and throw is False
        assert scene.exciters[1].drive.kind == "constant_speed"
        factor = float(scene.exciters[0].drive.factor)
        return ended("done", -90.0 if factor >= threshold else -5.0, 80.0)

    monkeypatch.setattr(run_up_module, "envelope", at_factor)
    found = run_up_module._least_torque(mixed(), jnp.asarray(9.0), np.array([10.0, 20.0, 96.0]), passed=threshold <= 1.0)
    if np.isnan(expected):
        assert np.isnan(found)
    else:
        assert threshold <= found <= 1.01 * threshold or found == expected


def test_scaled_motor_has_a_multiple_of_the_torque():
    electrical = jv.DCMotorElectrical(24.0, 0.6, 0.08, 0.002, 0.02)
    scaled = run_up_module._Scaled(electrical, jnp.asarray(3.0))
    assert float(scaled.torque(100.0)) == pytest.approx(3.0 * 0.08 * 16.0 / 0.6) and scaled.kind == "scaled"
    assert float(scaled.torque_at(0.0, 100.0, (jnp.asarray(2.0),))) == pytest.approx(0.48)
    assert float(scaled.speed) == pytest.approx(300.0) and float(scaled.inertia) == 0.002
    assert float(jax.grad(lambda f: run_up_module._Scaled(electrical, f).torque(100.0))(3.0)) == pytest.approx(
        0.08 * 16.0 / 0.6
    )


def test_run_up_reads_peaks_and_speeds(monkeypatch):
    scene = mixed()
    window, whole = several_window(), several_window()
    force = np.array([[3.0, 4.0], [6.0, 6.0j], [0.0, 0.0]])  # 5 N along a line, 6 N on a circle
    moved = jnp.asarray(force @ np.linalg.pinv(scene.machine.carrier().foundation_stiffness).T)
    amplitude = jnp.asarray([[1e-3, 5e-3, 0.02], [4e-3, 2e-3, 0.01], [1e-3, 1e-3, 0.03]])
    values = amplitude, moved, 0.0 * moved
    whole = eqx.tree_at(lambda w: (w.amplitude, w.displacement, w.velocity), whole, values)
    run = eqx.tree_at(lambda r: (r.window, r.scene), run_of(), (window, scene))
    run = eqx.tree_at(lambda r: r.trajectory, run, whole, is_leaf=lambda x: x is None)
    asked, angles = [], []

    def averaged(scene, end, *, samples, throw, start=None):
        asked.append((float(end), samples, throw))
        angles.append(0.0 if start is None else float(start.exciters[0].rotor[0]))
        return run

    monkeypatch.setattr(run_up_module, "envelope", averaged)
    monkeypatch.setattr(run_up_module, "_least_torque", lambda *_, passed: 0.5 if passed else 2.0)
    found = jv.run_up(scene, "9 s")
    assert asked == [(9.0, 4096, False)] * 8 and found.status_name == "passed" and np.isnan(found.least_torque)
    assert found.peak_amplitude.tolist() == [4e-3, 5e-3, 0.03] and float(found.peak_force) == pytest.approx(6.0)
    assert found.speed.tolist() == [90.0, 80.0] and found.caught_at.tolist() == [0, 0]
    np.testing.assert_allclose(found.resonances, np.sort(jv.natural_frequencies(scene)), rtol=1e-12)
    again = jv.run_up(scene, "9 s", least=True)
    assert float(again.least_torque) == 0.5 and again.least_torque.dtype == again.resonances.dtype
    lines = again.summary().splitlines()
    assert lines[0] == "all exciters pass all resonances below their working speeds"
    assert lines[1:3] == ["  exciter 1: 859.44 rpm", "  exciter 2: 763.94 rpm"]
    np.testing.assert_allclose(angles[:8], np.arange(8) * np.pi / 4.0, rtol=1e-12)
    assert lines[3] == "  peaks on the way (largest of several initial angles; the figure shows one run):"
    assert lines[4].startswith("    x 4 mm") and lines[4].endswith("foundation force 6 N")
    assert lines[5] == "  all pass with torques of at least 0.5 times those of the motors" and len(lines) == 7
    assert lines[6] == "  (by the averaged equations; test weaker motors with simulate)"
    assert len(found.summary().splitlines()) == 5
    slow = eqx.tree_at(lambda r: r.window.rotor_speeds[0], run, jnp.full(3, -5.0))
    monkeypatch.setattr(run_up_module, "envelope", lambda *_, **__: slow)
    caught = jv.run_up(scene, "9 s", least=True)
    assert caught.status_name == "caught" and float(caught.least_torque) == 2.0
    assert caught.summary().splitlines()[1].startswith("  exciter 1: 47.746 rpm, caught by resonance 1 at ")
    drawn = caught.plot(unit="rad/s").axes[-2].get_lines()
    assert any(line.get_ydata()[0] == pytest.approx(float(caught.resonances[0])) for line in drawn)
    plt.close("all")


def test_run_up_of_a_prescribed_speed_is_refused():
    ideal = jv.Scene(body(), exciters=[jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.1)])
    with pytest.raises(jv.InputError, match=r"^scene has no motor; a run-up needs a drive of limited power"):
        jv.run_up(ideal, 5.0)
    with pytest.raises(jv.InputError, match=r"^until is 0 s; it must be greater than 0"):
        jv.run_up(mixed(), 0.0)


def test_drift_of_an_envelope_does_not_depend_on_the_size():
    small, large = (jv.envelope(turning_body(size), 2.0) for size in (0.1, 10.0))
    np.testing.assert_allclose(small.drift, large.drift, rtol=0.01)
