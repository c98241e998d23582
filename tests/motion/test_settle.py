"""Runs until nothing changes: where they end, and how they go on from segment to segment."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, scene, turning_body
from small_machine import small_machine, small_run, small_start

import jaxvib as jv
from jaxvib.motion.integrate import whole_turns
from jaxvib.motion.settle import _distance_from_steady_state, _is_creeping, _is_steady_in_the_mean, _slowest_decay
from jaxvib.motion.simulate import last_state, run_planned


def test_settle_names_a_motion_that_left_its_mode():
    s = scene("two_mass", speed=150.0)
    with pytest.raises(jv.ComputationError) as caught:
        jv.settle(s, mode=4)
    assert caught.value.status == "left_mode"


def test_settle_does_not_pass_a_jam_that_only_glued_loads_keep():
    """Mode 5 is stable by slope, but two balls in it separate and balance the rotor."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    s = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=5.0), jv.ConstantSpeed(100.0))
    assert bool(jv.jam_modes(s).select(3).stable)
    with pytest.raises(jv.ComputationError) as caught:
        jv.settle(s, mode=3)
    assert caught.value.status in ("left_mode", "not_settled")


def test_a_segment_goes_on_where_the_last_one_ended():
    """Under an imbalance too: the rotor is where it was after whole turns, and every load where it is within a turn."""
    machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    loads = jv.pendulums(count=2, mass=0.05, radius=0.08, drag=1.94)
    s = jv.Scene(machine, loads, jv.ConstantSpeed(460.0), effects=(jv.StaticImbalance("8 g m"),))
    start = jv.initial_state(s, angles=[0.3, 2.0])
    segment = whole_turns(s, 0.2)
    assert segment <= 0.2 and abs(np.sin(460.0 * segment)) < 1e-12
    given = dict(save="window", stepsize_controller=jv.Tolerance(1e-11), estimate=False)
    once = jv.simulate(s, 2.0 * segment, start=start, **given).window.state
    first = last_state(s, jv.simulate(s, segment, start=start, **given))
    assert float(jnp.max(jnp.abs(first.angle[0]))) <= np.pi
    twice = jv.simulate(s, segment, start=first, **given).window.state
    np.testing.assert_allclose(twice.displacement[-1], once.displacement[-1], rtol=1e-6)
    np.testing.assert_allclose(np.sin(twice.angle[0][-1]), np.sin(once.angle[0][-1]), atol=1e-6)


def test_a_segment_is_a_whole_number_of_periods_of_the_supply():
    circuit = dict(stator_resistance=1.2, rotor_resistance=1.0, stator_leakage=6e-3, rotor_leakage=6e-3)

    def motor(frequency):
        return jv.InductionMotorElectrical(400.0, frequency, 2, **circuit, magnetizing_inductance=0.15, inertia=0.05)

    def screen(*frequencies):
        body = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
        return jv.Scene(body, exciters=[jv.Exciter(drive=motor(each), unbalance=0.1) for each in frequencies])

    np.testing.assert_allclose(whole_turns(screen("50 Hz", "50 Hz"), 0.99), 0.98, rtol=1e-12)
    with pytest.raises(jv.InputError, match=r"^exciters have unbalances or supplies at .* rad/s; these must be equal"):
        whole_turns(screen("50 Hz", "60 Hz"), 0.99)


def test_balls_that_touch_settle_side_by_side():
    """They start beside each other, however large they are, and go on in their order: nothing presses them apart."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=0.5, ball_radius=0.03)
    s = jv.Scene(machine, loads, jv.ConstantSpeed(60.0), effects=(jv.LoadContact(1e5, 200.0),))
    run = jv.settle(s, mode=1, drift=1e-3, periods=20, segments=8)
    angle = np.asarray(run.window.state.angle[0])
    ahead, beside = angle[:, 1] - angle[:, 0], 2.0 * np.arcsin(0.03 / 0.1)
    assert np.all(np.abs(ahead - beside) < 0.1), (ahead.min(), ahead.max(), beside)


def test_settle_starts_from_rest_where_no_mode_is_named():
    s = scene("one_mass", "rollers", speed=20.0)
    run = jv.settle(s)
    assert float(run.drift) < 1e-6 and np.isnan(run.error) and "error not estimated" in run.summary()
    with jax.enable_x64(False):
        single = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float32), s)
        run = jv.settle(single)
        assert run.omega.dtype == jnp.float32 and float(run.drift) < 1e-3


def two_pendulums(mass, drag, imbalance):
    machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    loads = jv.pendulums(count=2, mass=mass, radius=0.08, drag=drag)
    s = jv.Scene(machine, loads, jv.ConstantSpeed(460.0), effects=(jv.StaticImbalance(imbalance),))
    return s, jv.initial_state(s, separation="3 deg")


def test_a_motion_that_beats_has_settled_in_the_mean():
    """Jammed loads and an imbalance beat for ever; asked for a motion that repeats itself, there is none."""
    s, start = two_pendulums(mass=0.2, drag=0.5, imbalance="4 g m")
    run = jv.settle(s, start=start, segments=100)
    assert run.status_name == "beating" and run.regime.label == "jammed" and 1e-4 < float(run.drift) < 1e-2
    assert "steady in the mean" in run.summary()
    with pytest.raises(jv.ComputationError, match="after 40 segments of 100 periods of the lowest") as caught:
        jv.settle(s, start=start, drift=1e-6, segments=40)
    assert caught.value.status == "not_settled"


def test_a_balanced_rotor_settles_although_its_rounding_does_not():
    """Only changes from turn to turn remain of its amplitude."""
    s, start = two_pendulums(mass=0.2, drag=1.94, imbalance="8 g m")
    run = jv.settle(s, start=start, segments=40)
    assert run.status_name == "done" and run.regime.label == "balanced" and float(run.drift) < 1e-6
    assert float(run.amplitude.max()) < 1e-12


def test_what_is_steady_in_the_mean():
    """Scatter and beats are; trends, slow humps and what dies away, however slowly, are not."""
    k, random = np.arange(32), np.random.default_rng(0)
    noise, drift = random.normal(size=(32, 3)), 1e-3 * random.uniform(0.5, 2.0, 32)

    def steady(drift, values):
        return _is_steady_in_the_mean(np.column_stack([drift, np.broadcast_to(np.transpose(values), (3, 32)).T]))

    assert steady(drift, 5.0 + 0.01 * noise)
    assert steady(drift, 5.0 + 0.01 * np.sin(2.3 * k))
    assert steady(drift, 5.0 + 1e-3 * np.sin(k / 20.0))  # less than the drift says
    assert not steady(drift, 5.0 + 0.01 * noise + 5e-3 * k[:, None])
    assert not steady(drift, 5.0 + 0.1 * np.cos(2.0 * np.pi * (k - 16.0) / 400.0) ** 8)
    assert not steady(drift * 0.9**k, 5.0 + 0.01 * noise)
    for share in (0.96, 0.98):
        assert not steady(1e-3 * share**k, 5.0 + 0.01 * share**k * np.sin(2.3 * k))


def test_settle_refuses_a_spin_up_and_an_accuracy():
    """Each segment begins with the rotor at its full speed, so that this start would be that at rest."""
    with pytest.raises(jv.InputError, match=r"start is 'spin_up'; a motion settles at a constant rotor speed; use .*'rest'"):
        jv.settle(scene(), start="spin_up")
    with pytest.raises(jv.InputError, match=r"^stepsize_controller is Accuracy\(error=0.1\); it must be one of: Tolerance"):
        jv.settle(scene(), stepsize_controller=jv.Accuracy(0.1))


def test_settle_stops_where_a_segment_fails():
    soft = scene("one_mass", "rollers", speed=60.0, effects=(jv.CubicSupport(-4e9),))
    start = jv.State(jnp.asarray([0.01]), jnp.zeros(1), (jnp.zeros(1),), (jnp.zeros(1),))
    run = jv.settle(soft, start=start, periods=1, throw=False)
    assert not bool(run.status == jv.RunStatus.done) and not bool(run.status == jv.RunStatus.no_start)


def test_single_precision_goes_on_from_segment_to_segment(monkeypatch):
    """A long run in segments ends where a run in double precision does, with the rotor's imbalance where it was."""
    machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    loads = jv.pendulums(count=2, mass=0.05, radius=0.08, drag=1.94)
    s = jv.Scene(machine, loads, jv.ConstantSpeed(460.0), effects=(jv.StaticImbalance("4 g m"),))
    start = eqx.tree_at(lambda y: y.rate, jv.initial_state(s, angles=[1.5, -2.0]), (jnp.full(2, 460.0),))
    exact = jv.simulate(s, 3.0, start=start, save="window", estimate=False)
    monkeypatch.setattr("jaxvib.motion.plan._SEGMENT_TURNS", 60.0)
    with jax.enable_x64(False):
        single = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float32), (s, start))
        run = jv.simulate(single[0], 3.0, start=single[1], save="window", estimate=False)
        phase, unbalance = run.regime.phase, run.regime.unbalance
    np.testing.assert_allclose(run.window.time[-1], 3.0, rtol=1e-6)
    assert int(run.evaluations) > 10 * int(run.steps) > 0  # those of all segments
    np.testing.assert_allclose(np.exp(1j * phase), np.exp(1j * exact.regime.phase), atol=1e-2)
    np.testing.assert_allclose(unbalance, exact.regime.unbalance, atol=1e-2)
    assert not np.allclose(np.exp(1j * phase), 1.0, atol=0.3)


@pytest.mark.parametrize(("separation", "steady"), [(2.5, True), (6.0, False)])
def test_means_of_quarters_are_compared_with_their_error(separation, steady):
    """40 segments a quarter, scattering by +-1e-3 about means that are so many errors of a mean apart."""
    swing = 1e-3 * np.tile([1.0, -1.0], 20)
    error = np.std(swing, ddof=1) / np.sqrt(40.0)
    quarters = [1.0 + swing + (separation * error if k == 2 else 0.0) for k in range(4)]
    values = np.concatenate(quarters)
    seen = np.stack([np.full(160, 1e-7) * (1.0 + 0.1 * np.tile([1.0, -1.0], 80)), values, values, values, values], axis=1)
    assert _is_steady_in_the_mean(seen) is steady


def begins_at(monkeypatch, s, **given):
    """The state that the first segment starts from."""
    starts = []

    def interrupted(plan, **_):
        starts.append(plan.state)
        raise InterruptedError

    monkeypatch.setattr("jaxvib.motion.settle.run_planned", interrupted)
    with pytest.raises(InterruptedError):
        jv.settle(s, **given)
    return starts[0]


@pytest.mark.parametrize("given", [{"mode": 3}, {}, {"start": "rest"}, {"separation": "1 deg"}])
def test_loads_settle_from_angles_one_degree_apart(monkeypatch, given):
    s = scene("two_mass", "balls", speed=150.0)
    np.testing.assert_allclose(np.diff(begins_at(monkeypatch, s, **given).azimuth), np.deg2rad([1.0, 1.0]), rtol=1e-12)
    np.testing.assert_array_equal(np.diff(begins_at(monkeypatch, s, separation=0.0).azimuth), [0.0, 0.0])


@pytest.mark.parametrize(("periods", "segments"), [(100, 32), (400, 32), (50, 64), (30, 108)])
def test_at_least_32_segments_are_judged(monkeypatch, periods, segments):
    """A segment has 100 slow periods; every quarter has a whole number of segments."""
    run, seen = small_run(save="window"), []
    monkeypatch.setattr("jaxvib.motion.settle.run_planned", lambda *_, **__: run)
    monkeypatch.setattr("jaxvib.motion.settle._is_steady_in_the_mean", lambda rows: seen.append(rows.shape) or len(seen) > 1)
    found = jv.settle(small_machine(), start=small_start(), periods=periods)
    assert found.status_name == "beating" and seen == [(segments, 5)] * 2


def test_rotations_are_compared_as_lengths(monkeypatch):
    run, seen = jv.simulate(turning_body(), 1.0, estimate=False, save="window"), []
    monkeypatch.setattr("jaxvib.motion.settle.run_planned", lambda *_, **__: run)
    monkeypatch.setattr("jaxvib.motion.settle._is_steady_in_the_mean", lambda rows: seen.append(rows[0, 3:]) or True)
    jv.settle(turning_body(), start="rest")
    np.testing.assert_allclose(seen[0], run.amplitude * np.array([1.0, 1.0, 0.3]), rtol=1e-12)


@pytest.mark.parametrize("periods", [100, 30])
def test_a_segment_is_so_many_periods_of_the_slowest_resonance(monkeypatch, periods):
    """A segment has a whole number of turns of the rotor, which turns three times in a time unit of this machine."""
    asked, run = [], small_run(save="window")
    monkeypatch.setattr("jaxvib.motion.settle.run_planned", lambda plan, **_: asked.append(float(plan.end)) or run)
    jv.settle(small_machine(), start=small_start(), periods=periods, segments=1, throw=False)
    slowest, turn = float(np.min(jv.natural_frequencies(small_machine()))), 2.0 * np.pi / float(small_machine().drive.speed)
    turns = asked[0] / turn
    np.testing.assert_allclose(turns, round(turns), rtol=1e-9)
    assert abs(asked[0] - 2.0 * np.pi * periods / slowest) <= turn


def test_means_scatter_by_their_standard_errors():
    """Quarters of n values whose spread is 1: their means lie within 3.6 / sqrt(n) of each other where they do not move."""
    for n in (8, 32):
        spread = np.resize([1.0, -1.0], n) * np.sqrt((n - 1) / n)  # the variance is 1
        drift = np.resize([0.9e-9, 1.1e-9, 1.1e-9, 0.9e-9], 4 * n)
        for share, steady in ((0.98, True), (1.02, False)):
            shift = np.repeat([0.0, 0.0, 0.0, share * 3.6 / np.sqrt(n)], n)
            values = 5.0 + np.tile(spread, 4) + shift
            assert _is_steady_in_the_mean(np.column_stack([drift, values, values, values])) == steady


@pytest.mark.parametrize(("share", "steady"), [(0.45, True), (0.55, False)])
def test_less_than_half_the_drift_is_not_seen(share, steady):
    """Quarters that do not scatter, and the last of which is another by a share of the drift."""
    drift = 1e-3 * np.resize([0.9, 1.1, 1.1, 0.9], 128)
    values = 5.0 * (1.0 + share * np.median(drift) * np.repeat([0.0, 0.0, 0.0, 1.0], 32))
    assert _is_steady_in_the_mean(np.column_stack([drift, values, values, values])) == steady


@pytest.mark.parametrize("count", [1, 3])
def test_weakly_damped_motions_settle_at_the_exact_one(count):
    """Free vibrations, which lose 1e-4 of themselves a radian, carry most of the force of an antiphase machine."""
    s = published(damping=1e-4, count=count).scene()
    run, exact = jv.settle(s, mode=3), jv.jam_orbit(s, mode=3)
    np.testing.assert_allclose(run.foundation_force, exact.foundation_force, rtol=1e-5)
    np.testing.assert_allclose(run.amplitude, exact.amplitude, rtol=1e-6)
    assert float(run.drift) < 1e-6


def test_the_slowest_decay_is_that_of_the_free_carrier():
    """x'' + 2 z w x' + w^2 x = 0 decays at z w; heavily damped at w^2/(2 z w) about; an undamped platform not at all."""
    s = scene("one_mass", "rollers")
    mass = 50.0 + 0.5
    np.testing.assert_allclose(_slowest_decay(s), 30.0 / (2.0 * mass), rtol=1e-9)
    heavy = eqx.tree_at(lambda s: s.machine.damping, s, jnp.array([1e5]))
    np.testing.assert_allclose(_slowest_decay(heavy), min(-np.roots([mass, 1e5, 4e4]).real), rtol=1e-6)
    two = eqx.tree_at(lambda s: (s.machine.damping, s.machine.link_damping), scene("two_mass"), (jnp.zeros(2), jnp.zeros(1)))
    assert _slowest_decay(two) == 0.0


def test_the_distance_from_the_end_follows_from_decays():
    """exp(-a t) falls by 1 - exp(-a T) of itself from one half of the window to the other."""
    run = SimpleNamespace(window=SimpleNamespace(time=np.array([3.0, 5.0])))

    def far(drifts, decay):
        return _distance_from_steady_state(drifts, run, decay, 10.0)

    np.testing.assert_allclose(far([1e-3], 1.0), 1e-3 / (1.0 - np.exp(-1.0)), rtol=1e-12)
    weak = 1.0 - np.exp(-0.1)
    assert far([1e-3], 0.1) == far([1e-3, 1e-4], 0.1) == np.inf  # a single drift may be small by chance
    np.testing.assert_allclose(far([9.0, 1e-4, 1e-3, 1e-5], 0.1), 1e-3 / weak, rtol=1e-12)
    # Without a decay of the carrier that of the drifts counts: the largest of three fall to a hundredth in three segments.
    falling = [1e-2, 5e-3, 1e-3, 1e-4, 2e-5, 1e-5]
    np.testing.assert_allclose(far(falling, 0.0), 1e-4 / (1.0 - 100.0 ** (-1.0 / 30.0)), rtol=1e-12)
    assert far(falling[::-1], 0.0) == far(falling[:5], 0.0) == np.inf and far([0.0], 0.0) == 0.0


def test_loads_that_creep_along_balanced_arrangements_settle(monkeypatch):
    """Three balls and an imbalance have one free direction of balanced arrangements; gravity moves them along it for hours."""
    machine = jv.planar_rotor(mass=25.0, stiffness=5e5, damping=300.0)
    loads = jv.balls(count=3, mass=0.04, radius=0.1, drag=2.0)
    s = jv.Scene(machine, loads, jv.ConstantSpeed(314.0), (jv.Gravity(), jv.StaticImbalance("6 g m")))
    runs, integrate = [], run_planned
    monkeypatch.setattr(
        "jaxvib.motion.settle.run_planned", lambda *args, **given: runs.append(integrate(*args, **given)) or runs[-1]
    )
    start = jv.initial_state(s, angles=np.radians([89.8, 188.2, 239.1]))
    found = jv.settle(s, start=start, periods=40)
    assert found.status_name == "creeping" and bool(found.settled) and bool(found.finished) and len(runs) < 12
    assert found.regime.label == "balanced" and float(found.foundation_force) < 1e-3 * 0.012 * 314.0**2
    # Independently of the residual unbalance that was measured: the angles change as no unbalance does to first order.
    before, after = (np.asarray(run.regime.phase) for run in runs[-2:])
    change = np.angle(np.exp(1j * (after - before)))
    assert np.max(np.abs(change)) > 1e-6
    assert abs(np.sum(np.exp(1j * after) * change)) < 0.02 * np.sum(np.abs(change))
    with pytest.raises(jv.ComputationError) as caught:
        jv.settle(s, start=start, periods=40, drift=1e-6, segments=8)
    assert caught.value.status == "not_settled"


def balanced(phase, unbalance, name=jv.RegimeName.balanced):
    return SimpleNamespace(name=name, phase=np.array(phase), unbalance=unbalance)


@pytest.mark.parametrize(
    ("change", "creeping"),
    [
        ({}, True),
        ({"phase": lambda k: 1e-4 * 0.8**k}, False),  # comes to rest
        ({"phase": lambda k: 1e-4 * 1.2**k}, False),  # leaves, faster and faster
        ({"unbalance": lambda k: 1e-5 + 3e-5 * k}, False),  # leaves balance, or comes to it
        ({"phase": lambda k: 0.0}, False),
        ({"name": jv.RegimeName.unbalanced}, False),
    ],
)
def test_creeping_loads_move_evenly_and_stay_balanced(change, creeping):
    phase, unbalance = change.get("phase", lambda k: 1e-4 * k), change.get("unbalance", lambda k: 1e-5)
    name = change.get("name", jv.RegimeName.balanced)
    # One load passes half a turn, where its angle jumps.
    regimes = [balanced([3.14150 + phase(k), 1.0 - phase(k)], unbalance(k), name) for k in range(4)]
    for regime in regimes:
        regime.phase = np.angle(np.exp(1j * regime.phase))
    assert _is_creeping(regimes) is creeping
    assert not _is_creeping(regimes[:3])


def test_settle_counts_the_cost_and_time_of_all_segments():
    s = scene("one_mass", speed=60.0)
    steps = jv.Tolerance(1e-9)
    run = jv.settle(s, mode=1, periods=10, stepsize_controller=steps)
    segment = float(whole_turns(s, 2.0 * np.pi * 10 / float(jv.natural_frequencies(s)[0])))
    count = round(float(run.window.time[-1]) / segment)
    state = jv.initial_state(s, "jam", mode=1, separation="1 deg")
    single = [jv.simulate(s, segment, start=state, save="window", estimate=False, stepsize_controller=steps)]
    while len(single) < count:
        state = last_state(s, single[-1])
        single.append(jv.simulate(s, segment, start=state, save="window", estimate=False, stepsize_controller=steps))
    assert count > 1 and float(run.window.time[-1]) == pytest.approx(count * segment)
    np.testing.assert_allclose(run.steps, sum(int(each.steps) for each in single), rtol=0.02)
    np.testing.assert_allclose(run.evaluations, sum(int(each.evaluations) for each in single), rtol=0.02)
    assert int(run.steps) > 1.5 * max(int(each.steps) for each in single) and f"{int(run.steps)} steps" in run.summary()
