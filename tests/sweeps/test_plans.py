"""Steps and windows of the runs of a sweep, from the fastest and the slowest case of the study."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.motion.batch import PARTS_OF_RUN
from jaxvib.sweeps.axes import Axis, Target, extreme_cases
from jaxvib.sweeps.definition import CASE_STATUSES
from jaxvib.sweeps.study import study

SCENE = jv.Scene(
    jv.one_mass(mass=50.0, stiffness=4e4, damping=1000.0),
    jv.balls(count=2, mass=0.25, radius=0.1, drag=5.0),
    jv.ConstantSpeed("60 rad/s"),
)
SINGLE = {
    "machine.damping": [1000.0],
    "loads.radius": [0.1],
    "loads.mass": [0.25],
    "drive.speed": [60.0],
    "start.angle[0]": [0.0],
    "start.angle[1]": [0.1],
    "start.rate[0]": [0.0],
    "start.displacement": [0.0],
    "start.velocity": [0.0],
}


def axes_between(low, high):
    return [Axis(str(k), "", None, a, b, False, Target(None, "", None)) for k, (a, b) in enumerate(zip(low, high, strict=True))]


@pytest.mark.parametrize("number", [4, 14, 40])
def test_extreme_cases_are_found_for_any_number_of_axes(number):
    random = np.random.default_rng(number)
    low, high = random.uniform(1.0, 2.0, number), random.uniform(3.0, 90.0, number)
    sign = random.choice([-1.0, 1.0], number)

    def rates(x):
        """Products of powers of all axes; a maximum beside a constant; a maximum within the first axis."""
        power = np.exp(np.log(x) @ sign / np.sqrt(number))
        within = -((x[:, 0] - 0.5 * (low[0] + high[0])) ** 2) + x[:, 1:] @ sign[1:]
        return np.stack([power, -power, np.maximum(power, 1e-3 * np.max(np.where(sign > 0, high, low))), within], axis=1)

    up, down = np.where(sign > 0.0, high, low), np.where(sign > 0.0, low, high)
    expected = np.stack([up, down, up, np.append(0.5 * (low[0] + high[0]), up[1:])])
    np.testing.assert_allclose(extreme_cases(axes_between(low, high), rates), expected)


def test_lists_are_tried_at_their_own_values():
    axes = [axes_between([1.0], [900.0])[0]._replace(values=np.array([900.0, 7.0, 1.0]))]
    seen = []

    def rates(x):
        seen.extend(x[:, 0])
        return -np.abs(x - 7.0)

    assert extreme_cases(axes, rates).tolist() == [[7.0]] and set(seen) == {1.0, 7.0, 900.0}


def test_the_fastest_of_many_axes_sets_the_steps(tmp_path):
    """A light, stiff machine is in neither of the two opposite corners; its steps were 5.8 times too long for it."""
    axes = {"machine.mass": [1.0, 50.0], "machine.stiffness": [4e4, 4e6], "loads.drag": [3.0, 5.0], **SINGLE}
    assert len(axes) == 12
    data = jv.sweep(SCENE, axes, ["run.foundation_force", "run.load_speed"], tmp_path / "s.zarr", until=2.0).data.squeeze()
    for mass, stiffness in itertools.product(axes["machine.mass"], axes["machine.stiffness"]):
        machine = jv.one_mass(mass=mass, stiffness=stiffness, damping=1000.0)
        scene = jv.Scene(machine, SCENE.loads, SCENE.drive)
        start = jv.initial_state(scene, "rest")
        start = dataclasses.replace(start, angle=(jnp.asarray([0.0, 0.1]),))
        run = jv.simulate(scene, 2.0, start=start)
        case = data.sel({"machine.mass": mass, "machine.stiffness": stiffness, "loads.drag": 5.0})
        np.testing.assert_allclose(case.load_speed, run.omega, rtol=2e-5)
        np.testing.assert_allclose(case.foundation_force, run.foundation_force, rtol=1e-5)


def test_loads_that_start_fast_shorten_the_steps(tmp_path):
    axes = {"start.rate[0]": [0.0, 3000.0]}
    data = jv.sweep(SCENE, axes, ["run.foundation_force", "run.load_speed"], tmp_path / "s.zarr", until=1.0).data
    start = jv.initial_state(SCENE, "rest")
    run = jv.simulate(SCENE, 1.0, start=dataclasses.replace(start, rate=(jnp.asarray([3000.0, 0.0]),)))
    np.testing.assert_allclose(data.load_speed[1], run.omega, rtol=2e-5)
    np.testing.assert_allclose(data.foundation_force[1], run.foundation_force, rtol=1e-5)


def test_a_plan_does_not_depend_on_further_single_values():
    few = {"machine.mass": [1.0, 50.0], "machine.stiffness": [4e4, 4e6], "drive.speed": [10.0, 300.0]}
    many = {**few, **{name: value for name, value in SINGLE.items() if name != "drive.speed"}}
    plans = [study(SCENE, axes, ["run.load_speed"], until=2.0).plan for axes in (few, many)]
    assert plans[0] == plans[1]


def test_the_stiffest_stop_sets_the_steps():
    exciter = jv.Exciter(drive=jv.ConstantSpeed("60 rad/s"), unbalance=0.08)
    scene = jv.Scene(SCENE.machine, exciters=[exciter], effects=[jv.Stop(1e6, gap=2e-3)])
    plan = study(scene, {"effects.stop[0].stiffness": [1e5, 1e7]}, ["run.amplitude"], until=2.0).plan
    fastest = float(jnp.maximum(60.0, jv.natural_frequencies(scene)[0]))
    rate = 4.0 * np.sqrt(fastest**2 + 1e7 / float(SCENE.machine.mass[0]))
    part = (2.0 - plan.window) / PARTS_OF_RUN
    assert plan.each == np.ceil(part * rate) and plan.each > 10 * part * fastest


def forced(effect):
    exciter = jv.Exciter(drive=jv.ConstantSpeed("60 rad/s"), unbalance=0.1)
    return jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0), exciters=[exciter], effects=[effect])


def test_forces_on_stiff_stops_are_those_of_all_steps(tmp_path):
    """Samples of the window, 1.6 per contact with the stop of 1e8 N/m, gave 13956 N and a peak of 16306 N."""
    stiffnesses, names = [1e7, 1e8], ["run.foundation_force", "run.peak_force"]
    axes = {"effects.stop[0].stiffness": stiffnesses}
    data = jv.sweep(forced(jv.Stop(1e7, gap=2e-3)), axes, names, tmp_path / "s.zarr", until=4.0).data
    for k, stiffness in enumerate(stiffnesses):
        run = jv.simulate(forced(jv.Stop(stiffness, gap=2e-3)), 4.0, samples=200_000, estimate=False)
        force = np.asarray(run.trajectory.foundation_force)[:, 0]
        np.testing.assert_allclose(data.peak_force[k], np.max(np.abs(force)), rtol=5e-3)
        np.testing.assert_allclose(data.foundation_force[k], np.ptp(force[100_000:]) / 2.0, rtol=5e-3)


def test_cases_with_steps_too_long_are_named(tmp_path):
    """The stiffness of the cubic support at the displacement of the run, and the stop, are faster than 2 rad per step."""
    for k, (effect, name, values, steps) in enumerate(
        (
            (jv.CubicSupport(1e7), "effects.cubic_support[0].stiffness", [1e7, 1e10], None),
            (jv.Stop(1e6, gap=2e-3), "effects.stop[0].stiffness", [1e4, 1e8], 800),
        )
    ):
        found = jv.sweep(forced(effect), {name: values}, ["run.foundation_force"], tmp_path / f"{k}", until=4.0, steps=steps)
        assert [CASE_STATUSES[n] for n in found.data.status.values] == ["done", "not_resolved"]
        assert "not_resolved: steps too long for contacts" in found.summary()


def test_contacts_between_loads_have_four_steps_per_radian():
    loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=0.5, ball_radius=0.02)
    scene = jv.Scene(SCENE.machine, loads, jv.ConstantSpeed(60.0), [jv.LoadContact(1e5, damping=1.0)])
    rounding = 1e-9
    for damping, rate in ((30.0, np.sqrt(1e5 / 0.5 * 2.0 * 0.96 / 1.4)), (1e4, 1e4 / 0.5 * 2.0 * 0.96 / 1.4)):
        plan = study(scene, {"effects.load_contact.damping": [1.0, damping]}, ["run.amplitude"], until=2.0).plan
        assert plan.each == np.ceil((2.0 - plan.window) / PARTS_OF_RUN * 4.0 * rate - rounding)


def test_the_largest_friction_sets_the_steps(tmp_path):
    exciter = jv.Exciter(drive=jv.ConstantSpeed("60 rad/s"), unbalance=0.08)
    scene = jv.Scene(SCENE.machine, exciters=[exciter], effects=[jv.FrictionSupport(30.0, width=1e-3)])
    axes = {"effects.friction_support[0].force": [0.0, 50.0]}
    plan = study(scene, axes, ["run.amplitude"], until=2.0).plan
    decay = (1000.0 + 50.0 / 1e-3) / float(SCENE.machine.mass[0])
    assert plan.each == np.ceil((2.0 - plan.window) / PARTS_OF_RUN * decay / 3.0) and not plan.implicit
    data = jv.sweep(scene, axes, ["run.amplitude"], tmp_path / "s.zarr", until=2.0).data
    run = jv.simulate(scene.replace(effects=jv.FrictionSupport(50.0, width=1e-3)), 2.0)
    np.testing.assert_allclose(np.squeeze(data.amplitude.values)[1], run.amplitude[0], rtol=3e-3)  # a step passes the width


@pytest.mark.parametrize(("until", "window"), [(0.2, 0.1), (200.0, None)])
def test_windows_take_at_most_half_of_a_run(until, window):
    plan = study(SCENE, {"machine.mass": [50.0, 60.0]}, ["run.load_speed"], until=until).plan
    assert plan.window == window if window else 1.0 < plan.window < 50.0
