"""Balancing in two planes: against the equations of Rodrigues et al. in the rotating frame, and time integration."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.cli.criterion import _balance_text

MASS, ACROSS, ALONG, K1, K2, B1, B2, L1, L2 = 20.0, 0.6, 0.15, 6e5, 5e5, 700.0, 600.0, 0.25, -0.2
LOAD, R, DRAG, STATIONS = 0.05, 0.08, 1.0, (0.2, 0.2, -0.15, -0.15)
EFFECTS = (jv.StaticImbalance("3 g m", angle=0.4), jv.MomentImbalance(4e-4, angle=2.0))


def rotor(stations=STATIONS, **up):
    return jv.rotor(
        mass=MASS, transverse_inertia=ACROSS, polar_inertia=ALONG, stiffness=(K1, K2), damping=(B1, B2), position=(L1, L2),
        stations=stations, **up,
    )  # fmt: skip


def scene(speed=450.0, effects=EFFECTS, machine=None, count=4):
    balls = jv.balls(count=count, mass=LOAD, radius=R, drag=DRAG)
    return jv.Scene(rotor() if machine is None else machine, balls, jv.ConstantSpeed(speed), effects)


def test_forces_and_moments_cancel_in_all_arrangements():
    states = jv.balanced_states(scene())
    turned, stations = LOAD * R * np.exp(1j * states.angles), np.array(STATIONS)
    np.testing.assert_allclose(np.sum(turned, axis=1) + 3e-3 * np.exp(0.4j), 0.0, atol=1e-15)
    np.testing.assert_allclose(turned @ stations + 4e-4 * np.exp(2j), 0.0, atol=1e-15)
    assert states.angles.shape == (4, 4) and states.dimension == 0 and states.names == ()
    pairs = {tuple(np.round(np.sort(row[:2]), 9)) + tuple(np.round(np.sort(row[2:]), 9)) for row in states.angles}
    axes = states.plot().axes
    assert [axis.get_title().split("\n")[0] for axis in axes] == [f"arrangement 1 (4 mirror images), plane {p}" for p in (1, 2)]
    numbers = [
        sorted(text.get_text() for text in axis.texts if "°" not in text.get_text() and text.get_text()) for axis in axes
    ]
    assert numbers == [["3", "4"], ["1", "2"]] and all(axis.get_title().endswith("sum 0") for axis in axes)
    assert len(pairs) == 1  # equal loads: the arrangements differ by exchanges


def test_summary_lists_angles_within_a_turn():
    balls = jv.balls(count=4, mass=LOAD, radius=R, drag=DRAG, ball_radius=0.01)
    effects = (*EFFECTS, jv.LoadContact(1e5, restitution=0.6))
    states = jv.balanced_states(jv.Scene(rotor(), balls, jv.ConstantSpeed(450.0), effects))
    assert np.max(states.angles) > 2.0 * np.pi  # loads that cannot pass each other: angles ascend within a plane
    head, *rows, _ = states.summary().splitlines()
    assert head == "the loads of each plane cancel in one arrangement and its mirror image" and len(rows) == 1
    angles = rows[0].removesuffix(" deg (4 mirror images)").split(",")
    assert len(angles) == 4 and all(0.0 <= float(angle) < 360.0 for angle in angles)


def test_stations_that_differ_by_rounding_are_in_one_plane():
    states = jv.balanced_states(scene(machine=rotor(stations=(np.nextafter(0.2, 1.0), 0.2, -0.15, -0.15))))
    np.testing.assert_allclose(states.angles, jv.balanced_states(scene()).angles, atol=1e-9)
    stability = states.stability()
    assert stability.is_decided and "largest Floquet multipliers, in absolute value: 1.0" in stability.summary()


def test_planes_of_a_balanced_rotor_turn_separately():
    states = jv.balanced_states(scene(effects=()))
    assert states.names == ("turn in plane 1", "turn in plane 2") and states.dimension == 2
    for row in states.angles:
        np.testing.assert_allclose(np.exp(1j * row[0]) + np.exp(1j * row[1]), 0.0, atol=1e-15)
        np.testing.assert_allclose(np.exp(1j * row[2]) + np.exp(1j * row[3]), 0.0, atol=1e-15)


def growth_in_rotating_frame(speed, angles, neutral):
    """Largest growth rate of the autonomous equations of Rodrigues et al., with the rotor's angle n t taken out."""
    s, kappa = jnp.array(STATIONS), 1.4  # solid balls that roll
    c1, c2, c3 = K1 + K2, K1 * L1 + K2 * L2, K1 * L1**2 + K2 * L2**2
    b1, b2, b3 = B1 + B2, B1 * L1 + B2 * L2, B1 * L1**2 + B2 * L2**2
    static, moment = 3e-3 * jnp.exp(0.4j), 4e-4 * jnp.exp(2j)

    def rates(x):
        (u, v), (ud, vd) = (x[0] + 1j * x[1], x[2] + 1j * x[3]), (x[4] + 1j * x[5], x[6] + 1j * x[7])
        a, ad = x[8:12], x[12:16]
        turn, rate = jnp.exp(1j * a), ad + speed

        def residual(z):
            udd, vdd, add = z[0] + 1j * z[1], z[2] + 1j * z[3], z[4:]
            eta = udd + 2j * speed * ud - speed**2 * u  # second derivatives, in the rotating frame
            tau = vdd + 2j * speed * vd - speed**2 * v
            eta1, tau1 = ud + 1j * speed * u, vd + 1j * speed * v
            ball = eta + s * tau + R * turn * (1j * add - rate**2)
            force = MASS * eta + b1 * eta1 + b2 * tau1 + c1 * u + c2 * v + LOAD * jnp.sum(ball) - speed**2 * static
            couple = (
                ACROSS * tau - 1j * ALONG * speed * tau1 + b2 * eta1 + b3 * tau1 + c2 * u + c3 * v
                + LOAD * jnp.sum(s * ball) - speed**2 * moment
            )  # fmt: skip
            along = kappa * LOAD * R**2 * add + DRAG * R**2 * ad + LOAD * R * jnp.real(jnp.conj(1j * turn) * (eta + s * tau))
            return jnp.concatenate([jnp.stack([force.real, force.imag, couple.real, couple.imag]), along])

        zero = jnp.zeros(8)
        found = jnp.linalg.solve(jax.jacfwd(residual)(zero), -residual(zero))
        return jnp.concatenate([x[4:8], found[:4], ad, found[4:]])

    rest = jnp.concatenate([jnp.zeros(8), jnp.asarray(angles), jnp.zeros(4)])
    assert float(jnp.max(jnp.abs(rates(rest)))) < 1e-6 * speed**2
    values = np.linalg.eigvals(np.asarray(jax.jacfwd(rates)(rest)))
    return np.max(np.delete(values, np.argsort(np.abs(values))[:neutral]).real)


@pytest.mark.parametrize("speed", [260.0, 450.0, 600.0, 900.0])
def test_growth_is_that_of_the_rotating_frame(speed):
    states = jv.balanced_states(scene())
    found = states.growth([speed])[0]
    np.testing.assert_allclose(found, growth_in_rotating_frame(speed, states.angles[0], 0), rtol=1e-7)
    stability = jv.balanced_states(scene(speed)).stability()
    assert stability.is_decided and stability.stable == (found < 0.0)


def test_a_run_above_the_critical_speeds_ends_balanced():
    fast = scene(900.0)
    at = jv.balanced_states(fast).angles[0] + np.array([0.2, -0.1, 0.15, 0.1])
    parts = (jnp.asarray(at), jnp.full(4, 900.0))
    start = eqx.tree_at(lambda s: (s.exciters[0].angle[0], s.exciters[0].rate[0]), jv.initial_state(fast), parts)
    run = jv.simulate(fast, "4 s", start=start, save="window")
    assert np.max(run.amplitude) < 1e-8 and run.regime.label == "balanced"


def test_loads_in_three_planes_are_refused():
    machine = rotor(stations=(0.2, 0.1, -0.1, -0.1))
    with pytest.raises(jv.InputError, match=r"stations are in 3 planes; this function needs loads in one plane or two"):
        jv.balanced_states(scene(machine=machine))


def test_a_plane_without_enough_loads_is_named():
    heavy = (jv.StaticImbalance("20 g m"),)
    states = jv.balanced_states(scene(effects=heavy))
    assert states.status_name == "outweighed" and states.angles.shape == (0, 4)
    # Loads 1 and 2 are at the station 0.2 m, which is the second plane along the axis.
    lines = _balance_text(states, [], []).splitlines()
    heads = ("imbalance in plane 1 (loads 3, 4): ", "imbalance in plane 2 (loads 1, 2): ")
    assert all(any(line.startswith(head) for line in lines) for head in heads)


ALONG_ONE_AXIS = (jv.StaticImbalance("3 g m", angle=0.4), jv.MomentImbalance(1e-4, angle=0.4))
UNEQUAL = [0.05, 0.06, 0.04, 0.05]


@pytest.mark.parametrize(
    ("mass", "effects", "more", "distinct"),
    [
        (LOAD, EFFECTS, {}, [[0, 1, 2, 3]]),  # exchanges of equal loads need no symmetry of the rotor
        (LOAD, EFFECTS, {"stiffness_up": (9e5, 5e5)}, [[0, 1, 2, 3]]),
        (UNEQUAL, ALONG_ONE_AXIS, {}, [[0, 3], [1, 2]]),
        (UNEQUAL, ALONG_ONE_AXIS, {"stiffness_up": (K1, K2)}, [[0, 3], [1, 2]]),
        (UNEQUAL, ALONG_ONE_AXIS, {"stiffness_up": (9e5, 5e5)}, [[0], [1], [2], [3]]),
        (UNEQUAL, EFFECTS, {}, [[0], [1], [2], [3]]),  # two imbalances at different angles
    ],
)
def test_mirror_images_are_one_row(mass, effects, more, distinct):
    balls = jv.balls(count=4, mass=mass, radius=R, drag=DRAG)
    states = jv.balanced_states(jv.Scene(rotor(**more), balls, jv.ConstantSpeed(450.0), effects))
    assert [each.tolist() for each in states.distinct] == distinct and len(states.angles) == 4
    counts = [f" ({len(each)} mirror images)" if len(each) > 1 else "" for each in distinct]
    assert [row.partition(" deg")[2] for row in states.summary().splitlines()[1:-1]] == counts
    growth = [states.stability(k).growth for k in range(4)]
    for each in distinct:
        np.testing.assert_allclose([growth[k] for k in each], growth[each[0]], rtol=1e-6)
    if distinct == [[0, 3], [1, 2]]:
        assert abs(growth[0] - growth[1]) > 1e-3 * abs(growth[0])
    text = _balance_text(states, [states.stability(k) for k in range(4)], [])
    assert text.count("mirror images)") == sum(len(each) > 1 for each in distinct)
