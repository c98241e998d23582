"""The balanced motion: arrangements, exact stability, and what the criterion makes of it."""

import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from gyroscopic_rotor import rotor
from hard_cases.reference_integration import multipliers
from hard_cases.reference_model import reference_model
from scenes import machines

import jaxvib as jv
from jaxvib.steady.balance import states
from jaxvib.steady.balance.speeds import characteristic_speeds
from jaxvib.steady.balance.states import (
    BalancedStability,
    BalanceStatus,
    balanced_growth,
    balanced_intervals,
    balanced_stability,
)

POINTS = 112
"""Rotor speeds of one scan; the same in all tests, so that each machine is compiled once."""


def loaded(name="two_mass", count=2, mass=0.3, drag=1.0, speed=30.0, effects=()):
    loads = jv.balls(count=count, mass=mass, radius=0.1, drag=drag)
    return jv.Scene(machines()[name], loads, jv.ConstantSpeed(speed), effects)


def sum_of(s, angles):
    side = np.broadcast_to(np.asarray(s.loads.mass * s.loads.radius), (s.loads.count,))
    return np.sum(side * np.exp(1j * angles), axis=-1) / side.sum()


@pytest.mark.parametrize(
    ("mass", "rows", "dimension", "directions"),
    [
        ([0.3, 0.3], 1, 1, 1),
        ([0.3, 0.3, 0.3], 2, 1, 1),
        ([0.3, 0.4, 0.5], 2, 1, 1),
        ([0.3, 0.4, 0.65], 2, 1, 1),
        ([0.2, 0.3, 0.5], 1, 1, 2),
        ([0.3] * 4, 2, 2, 2),
        ([0.2, 0.3, 0.4, 0.85], 2, 2, 2),
        ([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7], 2, 5, 5),
    ],
)
def test_arrangements_cancel_and_know_their_neutral_directions(mass, rows, dimension, directions):
    s = loaded(count=len(mass), mass=mass)
    states = jv.balanced_states(s)
    assert states.angles.shape == (rows, len(mass)) and states.dimension == dimension
    np.testing.assert_allclose(states.angles[:, 0], 0.0)
    assert len(states.names) == directions and states.names[0] == "turn of all loads"
    for angles, neutral in zip(states.angles, states.neutral, strict=True):
        assert abs(sum_of(s, angles)) < 1e-12
        np.testing.assert_allclose(neutral.T @ neutral, np.eye(directions), atol=1e-12)
        np.testing.assert_allclose(neutral[:, 0], 1.0 / np.sqrt(len(mass)))
        for direction in neutral.T:
            assert abs(sum_of(s, angles + 1e-5 * direction)) < 1e-9
    if len(set(mass)) == 1 and len(mass) > 2:
        np.testing.assert_allclose(np.sort(states.angles[0]), np.arange(len(mass)) * 2 * np.pi / len(mass), atol=1e-12)
    name = "unique" if len(mass) <= 3 else "family"
    assert states.status == getattr(BalanceStatus, name) and "neutral directions: turn" in states.summary()


@pytest.mark.parametrize(("count", "dimension", "directions"), [(1, 0, 0), (2, 0, 0), (3, 1, 1), (4, 2, 2)])
def test_arrangements_cancel_a_rotors_imbalance(count, dimension, directions):
    moment = 0.03 if count == 1 else 0.013
    states = jv.balanced_states(loaded(count=count, effects=(jv.StaticImbalance(moment, angle=0.7),)))
    assert states.dimension == dimension and "turn of all loads" not in states.names
    assert len(states.angles) > 0
    for angles, neutral in zip(states.angles, states.neutral, strict=True):
        assert abs(np.sum(0.03 * np.exp(1j * angles)) + moment * np.exp(0.7j)) < 1e-13
        assert neutral.shape == (count, directions)
    too_large = loaded(count=count, effects=(jv.StaticImbalance(1.0),))
    assert jv.balanced_states(too_large).status == BalanceStatus.outweighed


@pytest.mark.parametrize(("share", "status"), [(0.999, "family"), (1.001, "no_room")])
def test_balls_need_room_beside_each_other(share, status):
    """Twelve balls of 25 mm whose centres are on a circle of 187.5 mm: touching ones cancel m R sin 12a / sin a."""
    half = np.arcsin(12.5 / 187.5)
    most = 0.0642 * 0.1875 * np.sin(12 * half) / np.sin(half)
    drum = jv.balls(count=12, mass=0.0642, radius=0.1875, ball_radius=0.0125, drag=0.1)
    machine = jv.planar_rotor(mass=28.0, stiffness=9500.0, damping=40.0)
    states = jv.balanced_states(jv.Scene(machine, drum, jv.ConstantSpeed(115.0), (jv.StaticImbalance(share * most),)))
    assert states.status_name == status and states.capacity == pytest.approx([most], rel=1e-12)
    if status == "no_room":
        assert f"imbalance {1e3 * share * most:.4g} g m; the loads cancel at most {1e3 * most:.4g} g m" in states.summary()
    else:
        gaps = np.diff(np.sort(states.angles[0]))
        assert np.min(gaps) >= 2.0 * half


@pytest.mark.parametrize(
    ("mass", "status", "sentence"),
    [([0.3], "alone", "single load"), ([0.3, 0.2], "outweighed", "larger"), ([0.1, 0.1, 0.1, 0.4], "outweighed", "larger")],
)
def test_loads_that_cannot_cancel_are_named(mass, status, sentence):
    s = loaded(count=len(mass), mass=mass)
    states = jv.balanced_states(s)
    assert states.status == getattr(BalanceStatus, status) and sentence in states.summary()
    with pytest.raises(jv.ComputationError, match=sentence) as error:
        balanced_stability(s)
    assert error.value.status == status


def test_motion_that_is_not_balanced_is_refused():
    with pytest.raises(jv.InputError, match="angles leave an unbalance"):
        balanced_stability(loaded(), np.array([0.0, 3.0]))
    with pytest.raises(jv.InputError, match=r"effects.gravity disturbs the balanced motion; leave it out"):
        balanced_stability(loaded(effects=(jv.Gravity(),)))
    with pytest.raises(jv.InputError, match="low is 5"):
        balanced_intervals(loaded(), 5.0, 3.0)
    with pytest.raises(jv.InputError, match=r"low is 31\.4\d* and high 3; 0 < low < high"):
        balanced_intervals(loaded(), "300 rpm", 3.0)
    with pytest.raises(jv.InputError, match=r"speeds\[1\] is '40 mm', which is not in rad/s"):
        jv.balanced_states(loaded()).growth(["300 rpm", "40 mm"])
    states = jv.balanced_states(loaded())
    with pytest.raises(jv.InputError, match=r"speeds\[1\] is nan rad/s; a finite number is needed"):
        states.growth([40.0, np.nan], steps=16)
    with pytest.raises(jv.InputError, match=r"arrangement is 1; there are 1, counted from 0"):
        states.stability(1)
    with pytest.raises(jv.InputError, match=r"points is 0; it must be a whole number, at least 2"):
        states.intervals(20.0, 40.0, points=0)


def test_summaries_state_rates_without_sign():
    stable, unstable = (
        BalancedStability(g < 0.0, True, g, np.array([1.0, 0.9]), 1, 1e-9, 60.0).summary() for g in (-2.065, 3.0)
    )
    assert "decay at 2.065 1/s" in stable and "grow at 3 1/s" in unstable
    undecided = BalancedStability(False, False, -2e-9, np.array([1.0, 1.0]), 1, 1e-9, 60.0).summary()
    assert "than the error of the computation (-2e-09 1/s)" in undecided
    family = jv.balanced_states(loaded(count=4, effects=(jv.StaticImbalance(0.013),))).summary()
    assert "common rotation" not in family and "along the neutral directions" in family


def test_loads_in_contact_balance_in_their_order():
    def with_balls(size, *effects):
        balls = jv.balls(count=3, mass=0.25, radius=0.1, drag=1.0, ball_radius=size)
        imbalance = jv.StaticImbalance(0.03, angle=1.0)
        return jv.balanced_states(jv.Scene(machines()["one_mass"], balls, jv.ConstantSpeed(60.0), (imbalance, *effects)))

    contact = jv.LoadContact(stiffness=1e5)
    free, ordered = with_balls(0.01), with_balls(0.01, contact)
    assert (len(free.angles), len(ordered.angles)) == (2, 1)
    assert np.all(np.diff(ordered.angles[0]) > 0.0) and np.ptp(ordered.angles[0]) < 2.0 * np.pi
    np.testing.assert_allclose(np.exp(1j * ordered.angles[0]), np.exp(1j * free.angles[0]), atol=1e-12)
    np.testing.assert_allclose(ordered.share, [0.03 / 0.075], rtol=1e-12)
    states._require_undisturbed(ordered.scene, ordered.angles[0])
    with pytest.raises(jv.ComputationError, match="no_room: the loads overlap in every arrangement"):
        with_balls(0.075, contact).stability()


def flat_field(s):
    field = jv.vector_field(s)
    nd, n = s.machine.carrier().mass.shape[0], s.loads.count

    def rate(t, y):
        change = field(t, jv.State(y[:nd], y[nd : 2 * nd], (y[2 * nd : 2 * nd + n],), (y[2 * nd + n :],)))
        return jnp.concatenate([change.displacement, change.velocity, change.angle[0], change.rate[0]])

    return rate, nd, n


@pytest.mark.parametrize("speed", [25.0, 50.0])
def test_multipliers_are_those_of_an_independent_integration(speed):
    """The full equations integrated by scipy from pairs of small errors, differenced; and four times the steps."""
    s = loaded("two_mass", 3, speed=speed)
    result = balanced_stability(s)
    assert result.error < 1e-6
    finer = balanced_stability(s, steps=192)
    np.testing.assert_allclose(
        np.sort_complex(result.multipliers), np.sort_complex(finer.multipliers), atol=3.0 * result.error + 1e-9
    )

    rate, nd, n = flat_field(s)
    rate = jax.jit(rate)
    angles = jv.balanced_states(s).angles[0]
    base = np.concatenate([np.zeros(2 * nd), angles, np.full(n, speed)])
    period = 2.0 * np.pi / speed
    columns = []
    for k in range(base.size):
        ends = []
        for sign in (1.0, -1.0):
            start = base + sign * 1e-5 * np.eye(base.size)[k]
            run = scipy.integrate.solve_ivp(
                lambda t, y: np.asarray(rate(t, y)), (0.0, period), start, "DOP853", rtol=1e-11, atol=1e-13
            )
            ends.append(run.y[:, -1])
        columns.append((ends[0] - ends[1]) / 2e-5)
    expected = np.linalg.eigvals(np.stack(columns, axis=1))
    nearest = np.min(np.abs(result.multipliers[:, None] - expected[None, :]), axis=1)
    assert np.max(nearest) < 1e-5  # two real multipliers 1e-3 apart magnify the differences' 1e-9


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_neutral_directions_are_multipliers_of_one(count):
    s = loaded("one_mass", count, speed=60.0)
    result = balanced_stability(s)
    assert result.stable and result.neutral == max(1, count - 2)
    ones = np.sort(np.abs(result.multipliers - 1.0))
    assert np.all(ones[: result.neutral] < 1e-8) and ones[result.neutral] > 1e-3


def unbalance_after(s, speeds, times, errors):
    """Share of the loads' m R that is unbalanced at the end, of runs that start near the balanced motion (diffrax)."""
    angles = jnp.asarray(jv.balanced_states(s).angles[0])

    @eqx.filter_jit
    @jax.vmap
    def run(speed, until, error):
        rate, nd, n = flat_field(eqx.tree_at(lambda x: x.drive.speed, s, speed))
        start = jnp.concatenate([jnp.zeros(2 * nd), angles, jnp.full(n, 1.0) * speed]) + error
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, _: rate(t, y)),
            diffrax.Tsit5(),
            0.0,
            until,
            2.0 * jnp.pi / speed / 50.0,
            start,
            saveat=diffrax.SaveAt(t1=True),
            max_steps=None,
        )
        phi = solution.ys[0, 2 * nd : 2 * nd + n]
        return jnp.hypot(jnp.mean(jnp.cos(phi)), jnp.mean(jnp.sin(phi)))

    return np.asarray(run(speeds, times, errors))


@pytest.mark.parametrize(("name", "count"), [("one_mass", 2), ("two_mass", 3), ("three_mass", 2)])
def test_runs_balance_inside_the_exact_intervals_only(name, count):
    """Six time constants each, on both sides of every boundary, whatever the criterion says of the same speed."""
    s = loaded(name, count)
    resonances = np.asarray(jv.natural_frequencies(s))
    low, high = 0.7 * resonances[0], 1.6 * resonances[-1]
    intervals = balanced_intervals(s, low, high, points=POINTS)
    cuts = sorted({low, high, *(w for row in intervals for w in row)})
    # Narrow regions are left out: errors change too slowly there for a test.
    wide = [(a, b) for a, b in itertools.pairwise(cuts) if b > 1.05 * a]
    speeds = np.array([w for a, b in wide for w in (1.02 * a, 0.98 * b)])
    growth = balanced_growth(s, speeds)
    inside = np.array([any(a < w < b for a, b in intervals) for w in speeds])
    np.testing.assert_array_equal(growth < 0.0, inside)
    assert 1 < inside.sum() < inside.size - 1
    rng = np.random.default_rng(0)
    nd = len(resonances)
    sizes = np.concatenate([np.full(nd, 1e-5), np.full(nd, 1e-4), np.full(count, 2e-3), np.full(count, 1e-3)])
    errors = rng.normal(size=(speeds.size, sizes.size)) * sizes
    end = unbalance_after(s, jnp.asarray(speeds), jnp.asarray(6.0 / np.abs(growth)), jnp.asarray(errors))
    assert np.all(end[inside] < 2e-4), (speeds, growth, end)
    assert np.all(end[~inside] > 4e-3), (speeds, growth, end)


def test_light_loads_with_strong_drag_follow_the_criterion():
    for name, count, top in (("one_mass", 2, 40.0), ("two_mass", 3, 90.0), ("three_mass", 2, 60.0)):
        s = loaded(name, count, mass=0.001, drag=5.0)
        exact = np.array(balanced_intervals(s, 12.0, top, points=POINTS))
        said = np.asarray(jv.criterion(s).balancing)
        np.testing.assert_allclose(exact[:, 0], said[:, 0], rtol=1e-4)
        np.testing.assert_allclose(exact[:-1, 1], said[:-1, 1], rtol=1e-4)


@pytest.mark.parametrize("polar", [0.093, 0.9], ids=["long rotor", "disc"])
def test_gyroscopic_rotor_follows_the_criterion(polar):
    """The first balancing interval, exact to 1e-6: what turns backward is rightly left out of the functional."""
    s = rotor(polar, mass=0.05)
    said = np.asarray(jv.criterion(s).balancing[0])
    (exact,) = balanced_intervals(s, 0.8 * said[0], 1.2 * said[1], points=48)
    np.testing.assert_allclose(exact, said, rtol=1e-6)


def test_twenty_platforms():
    s = loaded(count=2, mass=0.002, drag=3.0)
    count = 20
    links = [(i, i + 1) for i in range(1, count)]
    chain = jv.network(
        mass=np.linspace(4.0, 6.0, count),
        stiffness=np.full(count, 2e3),
        damping=np.full(count, 2.0),
        links=links,
        link_stiffness=np.full(count - 1, 8e3),
        link_damping=np.full(count - 1, 1.0),
        exciter=7,
    )
    s = eqx.tree_at(lambda x: x.machine, s, chain)
    speeds = np.linspace(15.0, 90.0, 16)
    said = np.asarray(jv.criterion(s).balances(speeds))
    assert 0 < said.sum() < said.size
    np.testing.assert_array_equal(balanced_growth(s, speeds) < 0.0, said)


def test_criterion_improves_for_lighter_loads_and_stronger_drag():
    """Loads of 0.1, 0.3 and 3 % of their platform's mass. On the heaviest, stronger drag makes it worse again."""
    speeds = np.linspace(12.0, 90.0, POINTS)
    found = jv.criterion_map(loaded("two_mass", 3), speeds=speeds, mass=[0.1, 0.3, 3.0], drag=[0.1, 1.0, 10.0])
    assert np.all(np.diff(found.agreement, axis=1) <= 0.0) and np.all(found.agreement[:, 2] < found.agreement[:, 0] - 0.2)
    assert np.all(np.diff(found.agreement[:, :2], axis=0) > 0.0)
    assert found.agreement[1, 2] > found.agreement[2, 2] > found.agreement[0, 2]
    first = found.shift[:, :, 0]
    assert np.all(np.diff(first, axis=1) > 0.0)
    assert np.all(np.diff(first[:, :2], axis=0) < 0.0) and first[2, 2] > first[1, 2]
    figure = found.plot()
    assert len(figure.axes) == 3 and "drag factor" in found.summary()


def test_map_refuses_what_is_no_range():
    with pytest.raises(jv.InputError, match="mass must be an ascending list"):
        jv.criterion_map(loaded(), speeds=[20.0], mass=[1.0, -1.0], drag=[1.0])


def two_mass():
    """Two platforms, and with the held load on the exciter's; nothing tilts."""
    machine = machines()["two_mass"]
    return machine, eqx.tree_at(lambda m: m.mass, machine, machine.mass.at[machine.exciter - 1].add(0.2)), None


def tilting(station=0.1):
    """A rotor with its loads off the centre of mass, which the held load shifts; the place of the loads from the new one."""
    shift = 0.2 * station / 37.2

    def machine(mass, inertia, shift):
        position = (0.165 - shift, -0.155 - shift)
        numbers = dict(polar_inertia=0.093, stiffness=(6e4, 5e4), damping=(80.0, 90.0), position=position)
        return jv.rotor(mass=mass, transverse_inertia=inertia, stations=station - shift, **numbers)

    inertia = 0.479 + 37.0 * 0.2 / 37.2 * station**2
    return machine(37.0, 0.479, 0.0), machine(37.2, inertia, shift), station - shift


@pytest.mark.parametrize(
    ("machines", "speed", "weak"),
    [(two_mass, 24.0, 300.0), (two_mass, 40.0, 300.0), (tilting, 80.0, 5e3)],
    ids=["two_mass, 24", "two_mass, 40", "rotor"],
)
def test_imbalance_is_a_load_that_cannot_leave_the_rotor(machines, speed, weak):
    """The third load of a balanced three, held to the rotor by a strong drag, is the rotor's imbalance to the other two."""
    loads = jv.balls(count=2, mass=0.3, radius=0.1, drag=1.0)
    machine, heavier, place = machines()

    def two(angle):
        effects = [jv.StaticImbalance(0.2 * 0.1, angle)]
        if place is not None:
            effects.append(jv.MomentImbalance(0.2 * 0.1 * place, angle))
        return jv.Scene(heavier, loads, jv.ConstantSpeed(speed), tuple(effects))

    off = []
    for drag in (weak, 10.0 * weak):
        held = jv.balls(count=3, mass=[0.2, 0.3, 0.3], radius=0.1, drag=[drag, 1.0, 1.0])
        three = jv.Scene(machine, held, jv.ConstantSpeed(speed))
        angles = jv.balanced_states(three).angles[0]
        found = balanced_stability(two(angles[0] + 0.3), angles[1:] + 0.3)
        whole = balanced_stability(three, angles).multipliers
        moving = found.multipliers[np.abs(found.multipliers) > 1e-3]
        off.append(max(np.min(np.abs(whole - multiplier)) for multiplier in moving))
        assert found.neutral == 0
    # What is left of the held load's freedom goes as 1/drag.
    assert off[1] < 3e-5, off
    np.testing.assert_allclose(off[0] / off[1], 10.0, rtol=0.1)
    np.testing.assert_allclose(balanced_stability(two(0.0)).growth, found.growth, rtol=1e-6)


def test_imbalance_that_loads_cannot_cancel_is_refused():
    unbalanced = (jv.StaticImbalance(0.01),)
    with pytest.raises(jv.InputError, match="leave an unbalance"):
        balanced_stability(loaded(effects=unbalanced), [0.0, np.pi])
    moment = (jv.MomentImbalance(1e-3),)
    for station, effects in ((0.0, moment), (0.2, moment), (0.2, unbalanced)):
        machine, *_ = tilting(station)
        s = jv.Scene(machine, jv.balls(count=2, mass=0.3, radius=0.1, drag=1.0), jv.ConstantSpeed(80.0), effects)
        with pytest.raises(jv.InputError, match="effects tilt the rotor: loads at one point cannot cancel"):
            jv.balanced_states(s)


def test_a_machine_that_can_drift_is_refused():
    """Its free motion has multipliers of 1, and what is left of them by rounding would be read as growth."""
    s = eqx.tree_at(lambda x: x.machine.stiffness, loaded(), jnp.zeros(2))
    with pytest.raises(jv.InputError, match="lets the machine drift"):
        balanced_growth(s, [30.0, 60.0])


def test_every_change_of_stability_is_halved_to_the_same_part(monkeypatch):
    """Two changes, one in a narrow gap and one in a wide one."""
    monkeypatch.setattr(states, "balanced_growth", lambda scene, w, *_, **__: np.where((w > np.pi) & (w < 500.0), -1.0, 1.0))
    speeds = np.array([1.0, 3.1415, 3.1416, 400.0, 900.0])
    stable = (speeds > np.pi) & (speeds < 500.0)
    found = states.stability_changes(loaded(), speeds, stable, rtol=1e-9)
    np.testing.assert_allclose(found, [np.pi, 500.0], rtol=1e-9)


def test_motion_without_a_spring_is_refused():
    gyroscopic = rotor(0.1, stiffness=(1.1e6, 0.0))
    with pytest.raises(jv.InputError, match="leaves a motion of the rotor without a spring"):
        characteristic_speeds(gyroscopic)
    characteristic_speeds(rotor(0.1))


def plain_multipliers(s):
    """Multipliers by SciPy from the dense equations; loads at the first arrangement."""
    angles, n, nd = jv.balanced_states(s).angles[0], float(s.drive.speed), s.machine.structure().mass.shape[0]
    motion = lambda t: np.concatenate([np.zeros(2 * nd), angles + n * t, np.full(angles.size, n)])  # noqa: E731
    return multipliers(reference_model(s), motion, 2.0 * np.pi / n)


@pytest.mark.parametrize(
    ("numbers", "mass", "drag", "speed"),
    [
        ((50.0, 4e4, 100.0), 0.5, 1.0, 0.4),
        ((50.0, 4e4, 1e6), 0.5, 1.0, 40.0),
        ((50.0, 4e4, 100.0), 1e-6, 1.0, 40.0),
        ((50.0, 4e4, 100.0), 0.5, 1e5, 40.0),
        ((50.0, 4e4, 0.0), 0.5, 1.0, 20.0),
    ],
    ids=["slow rotor", "damped carrier", "light loads", "strong drag", "no damping"],
)
def test_multipliers_of_hard_balanced_motions_are_those_of_scipy(numbers, mass, drag, speed):
    machine = jv.one_mass(**dict(zip(("mass", "stiffness", "damping"), numbers, strict=True)))
    s = jv.Scene(machine, jv.balls(count=2, mass=mass, radius=0.1, drag=drag), jv.ConstantSpeed(speed))
    result = balanced_stability(s)
    np.testing.assert_allclose(np.abs(result.multipliers), np.sort(np.abs(plain_multipliers(s)))[::-1], atol=1e-7)
    np.testing.assert_allclose(balanced_growth(s, [speed])[0], result.growth, rtol=1e-9)
    assert result.status_name == ("stable" if speed == 40.0 else "unstable")


def test_growth_of_a_slow_rotor_is_that_of_light_loads():
    """It falls with the fourth power of the speed: the vibration's torque, a share m n^2/k of the loads' own, per drag."""
    s = loaded("one_mass", 2)
    growth = balanced_growth(s, np.array([0.4, 0.2, 0.1]))
    np.testing.assert_allclose(growth[:-1] / growth[1:], 16.0, rtol=2e-2)
    assert np.all(growth > 0.0)


def test_what_is_below_rounding_is_not_called_stable():
    found = balanced_stability(loaded("one_mass", 2, speed=1e-4))
    assert found.status_name == "undecided" and not found.stable
    undamped = eqx.tree_at(lambda x: x.machine.damping, loaded("one_mass", 2, speed=1e-5), jnp.zeros(1))
    with pytest.raises(jv.InputError, match=r"drive.speed is 1e-05 rad/s, at which a turn takes more"):
        balanced_stability(undamped)
