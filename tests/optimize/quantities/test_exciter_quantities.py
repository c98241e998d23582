"""Quantities of machines with several exciters: an independent calculation, other tiers, derivatives, bad input."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.files import SCREENS
from optimize import (
    amplitude_spread,
    conveying_speed,
    force_per_throw,
    foundation_force,
    least_torque,
    motion_spread,
    power,
    resonance_distance,
    roundness,
    synchronization_margin,
    throw_angle,
    throw_number,
    throw_stroke,
    tolerance_ranges,
)
from optimize.quantities import exciters
from optimize.quantities.evaluation import Evaluation

DECK = [(-1.5, 0.1), (0.2, 0.1), (1.5, 0.1)]


@pytest.fixture(scope="module")
def screen():
    """The linear screen with its motors apart from their best places, and unequal motors."""
    scene = jv.scene_from_toml(SCREENS["linear_screen"])
    faster = scene.exciters[1].drive.speed * 1.003
    return eqx.tree_at(lambda s: (s.exciters[0].position, s.exciters[1].drive.speed), scene, (jnp.array([0.3, 0.7]), faster))


def by_hand(scene, points):
    """Speed and complex amplitudes of points, of the coordinates and of the force, from speed and phases of the regime."""
    regime = jv.working_regime(scene)
    w, phases = float(regime.speed), np.asarray(regime.phases)
    mass = np.diag([2600.0, 2600.0, 3800.0])
    rows = {at: np.array([[1.0, 0.0, -at[1]], [0.0, 1.0, at[0]]]) for at in [*points, (-1.6, -0.3), (1.6, -0.3)]}
    k = sum(rows[at].T @ np.diag([280e3, 460e3]) @ rows[at] for at in [(-1.6, -0.3), (1.6, -0.3)])
    c = sum(rows[at].T @ np.diag([2000.0, 2500.0]) @ rows[at] for at in [(-1.6, -0.3), (1.6, -0.3)])
    force = np.zeros(3, complex)
    for exciter, phase in zip(scene.exciters, phases, strict=True):
        x, y = np.asarray(exciter.position)
        lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
        e = np.array([1.0, -1j * exciter.direction])
        force += w**2 * float(exciter.unbalance) * np.exp(1j * phase) * lever.T @ e
    q = np.linalg.solve(k - w**2 * mass + 1j * w * c, force)
    on_ground = ((k + 1j * w * c) @ q)[:2]
    return w, np.array([rows[at] @ q for at in points]), on_ground


def test_quantities_agree_with_an_independent_calculation(screen):
    w, u, force = by_hand(screen, DECK)
    t = np.linspace(0.0, 2.0 * np.pi, 20001)
    path = np.real(u[0][:, None] * np.exp(1j * t))
    size = np.hypot(*path)
    at = {"at": DECK[0]}
    np.testing.assert_allclose(throw_stroke(**at)(screen), 2.0 * size.max(), rtol=1e-6)
    np.testing.assert_allclose(roundness(**at)(screen), size.min() / size.max(), rtol=1e-3)
    along = np.arctan(path[1] / path[0])[np.argmax(size)]
    np.testing.assert_allclose(throw_angle(**at)(screen), along, atol=1e-3)
    mean = u.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum(np.abs(u - mean) ** 2, axis=1)) / np.sum(np.abs(mean) ** 2))
    np.testing.assert_allclose(motion_spread(DECK)(screen), spread, rtol=1e-6)
    sizes = [np.hypot(*np.real(each[:, None] * np.exp(1j * t))).max() for each in u]
    np.testing.assert_allclose(amplitude_spread(DECK)(screen), np.ptp(sizes) / np.mean(sizes), rtol=1e-5)
    total = np.sqrt(np.sum(np.abs(force) ** 2))
    np.testing.assert_allclose(foundation_force()(screen), total, rtol=1e-6)
    np.testing.assert_allclose(force_per_throw(**at)(screen), total / size.max(), rtol=1e-6)
    np.testing.assert_allclose(throw_number(**at)(screen), w**2 * abs(u[0][1]) / 9.80665, rtol=1e-6)
    upward = np.abs(u[0] @ [-np.sin(-0.1), np.cos(-0.1)])  # normal to a deck that falls along x by 0.1 rad
    np.testing.assert_allclose(throw_number(**at, slope=-0.1)(screen), w**2 * upward / (9.80665 * np.cos(0.1)), rtol=1e-6)
    np.testing.assert_allclose(
        conveying_speed(**at, slope="-5 deg")(screen), jv.conveying_speed(u[0], w, slope="-5 deg"), rtol=1e-6
    )
    torques = [float(exciter.drive.torque(w)) for exciter in screen.exciters]
    np.testing.assert_allclose(power()(screen), w * sum(torques), rtol=1e-6)
    resonances = np.asarray(jv.natural_frequencies(screen))
    np.testing.assert_allclose(resonance_distance()(screen), np.min(np.abs(resonances / w - 1.0)), rtol=1e-9)
    np.testing.assert_allclose(synchronization_margin()(screen), jv.working_regime(screen).margin, rtol=1e-9)


@pytest.mark.slow
def test_exact_motion_and_integration_confirm_the_quantities(screen):
    """The relative error of averaged torques is about S^2/(2 M I), here 0.7 %."""
    evaluation = Evaluation(screen)
    for quantity, allowed in ((throw_stroke(at=DECK[2]), 0.01), (throw_angle(), 0.02), (foundation_force(), 0.01)):
        leading, exact, time = (float(quantity.at_tier(tier).read(evaluation)) for tier in ("leading", "exact", "time"))
        np.testing.assert_allclose(leading, exact, rtol=allowed)
        np.testing.assert_allclose(time, exact, rtol=1e-4)


@pytest.mark.slow
def test_derivatives_of_all_quantities_agree_with_differences(screen):
    quantities = [
        throw_stroke(at=DECK[0]), throw_angle(at=DECK[0]), throw_number(at=DECK[2], slope=-0.1), roundness(at=DECK[0]),
        conveying_speed(at=DECK[1]),
        motion_spread(DECK), amplitude_spread(DECK), force_per_throw(), foundation_force(), power(), synchronization_margin(),
        resonance_distance(), least_torque(),
    ]  # fmt: skip
    start = jnp.array([0.3, 460e3, 2500.0, 4.5])

    def where(s):
        return s.exciters[0].position, s.machine.supports[0].stiffness, s.machine.supports[0].damping, s.exciters[1].unbalance

    def values(x):
        new = jnp.stack([x[0], jnp.asarray(0.7)]), jnp.stack([0.6 * x[1], x[1]]), jnp.full(2, x[2]), x[3]
        evaluation = Evaluation(eqx.tree_at(where, screen, new))
        return jnp.stack([quantity.read(evaluation) for quantity in quantities])

    forward, reverse = jax.jit(jax.jacfwd(values))(start), jax.jit(jax.jacrev(values))(start)
    assert np.all(np.isfinite(forward))
    np.testing.assert_allclose(forward, reverse, rtol=1e-6, atol=1e-10)
    steps = 1e-5 * start
    batch = np.asarray(jax.jit(jax.vmap(values))(start[None] + jnp.concatenate([jnp.diag(steps), -jnp.diag(steps)])))
    differences = ((batch[:4] - batch[4:]) / (2.0 * np.asarray(steps)[:, None])).T * np.asarray(start)
    scale = np.max(np.abs(differences), axis=1, keepdims=True)
    np.testing.assert_allclose(np.asarray(forward) * np.asarray(start) / scale, differences / scale, atol=1e-4)


def test_nearest_resonance_lies_on_either_side(monkeypatch):
    monkeypatch.setattr(exciters, "natural_frequencies", lambda scene: jnp.array([50.0, 90.0, 130.0]))
    for speed, each in ((100.0, [0.5, 0.1, 0.3]), (120.0, [7.0 / 12.0, 0.25, 1.0 / 12.0])):
        at = SimpleNamespace(scene=None, regime=SimpleNamespace(speed=jnp.asarray(speed)))
        np.testing.assert_allclose(resonance_distance().read(at), min(each), rtol=1e-12)
        np.testing.assert_allclose(resonance_distance().pieces(at, 1.0), [min(each)], rtol=1e-12)
        np.testing.assert_allclose(resonance_distance().pieces(at, -1.0), -np.array(each), rtol=1e-12)


@pytest.mark.slow
def test_equal_motors_have_the_largest_margin_and_no_slope():
    scene = jv.scene_from_toml(SCREENS["linear_screen"])
    margin = synchronization_margin()
    assert float(margin(scene)) == 1000.0
    with_mass = jax.jit(jax.grad(lambda mass: margin(eqx.tree_at(lambda s: s.machine.mass, scene, mass))))
    assert float(with_mass(scene.machine.mass)) == 0.0


def shaft(torque):
    """Circular translation under a motor of large inertia."""
    springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    motor = jv.DCMotor(100.0, stall_torque=torque, inertia=2.0)
    machine = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=0.4, at=(0.0, 0.0))])


def test_least_torque_is_that_of_the_resonance_curve():
    """Circular translation: the largest ratio of c S^2 w^5 / |K - M w^2 + i w c|^2 and the motor's torque."""
    w = np.linspace(12.0, 17.0, 200001)
    ratio = 600.0 * 0.4**2 * w**5 / np.abs(6e4 - 300.0 * w**2 + 600.0j * w) ** 2 / (5.0 * (1.0 - w / 100.0))
    np.testing.assert_allclose(least_torque()(shaft(5.0)), ratio.max(), rtol=1e-8)


def test_negative_least_torque_is_that_of_the_worst_resonance():
    machine = jv.two_mass(mass=(90.0, 60.0), stiffness=(3e4, 3e4), damping=(60.0, 90.0), link_stiffness=4e4, link_damping=30.0)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.DCMotor(100.0, stall_torque=5.0, inertia=0.5), unbalance=0.2)])
    peaks = least_torque().pieces(Evaluation(scene))
    assert peaks.shape == (2,) and float(jnp.ptp(peaks)) > 0.01
    np.testing.assert_allclose((-least_torque()).pieces(Evaluation(scene)), [-jnp.max(peaks)], rtol=1e-12)
    np.testing.assert_allclose((-least_torque())(scene), -jnp.max(peaks), rtol=1e-12)


@pytest.mark.parametrize("ratio", [0.02, 0.05, 0.1, 0.2])
def test_least_torque_near_the_no_load_speed_is_positive(ratio):
    """A damping above 0.03 leaves no local maximum below the no-load speed; the value is then that at the resonance."""
    mass, resonance, speed, stall = 200.0, 93.0, 100.0, 50.0
    damping = 2.0 * ratio * mass * resonance
    machine = jv.one_mass(mass=mass, stiffness=mass * resonance**2, damping=damping)
    motor = jv.DCMotor(speed, stall_torque=stall, inertia=0.5)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=0.2)])
    w = np.append(np.linspace(0.9 * resonance, 0.999 * speed, 20001), resonance)
    dynamic = (mass * (resonance**2 - w**2)) ** 2 + (damping * w) ** 2
    needed = damping * 0.2**2 * w**5 / 2.0 / dynamic / (stall * (1.0 - w / speed))
    inner = needed[1:-2]
    peaks = inner[(inner > needed[:-3]) & (inner > needed[2:-1])]
    np.testing.assert_allclose(least_torque()(scene), peaks[0] if peaks.size else needed[-1], rtol=1e-6)


@pytest.mark.slow
def test_heavy_rotors_need_the_least_torque_to_run_up():
    found = float(least_torque()(shaft(5.0)))
    run_up = [jv.run_up(shaft(5.0 * found * share), 400.0).status_name for share in (0.95, 1.05)]
    assert run_up == ["caught", "passed"]


def test_machine_without_a_regime_is_named(screen):
    apart = eqx.tree_at(lambda s: s.exciters[1].drive.speed, screen, screen.exciters[1].drive.speed * 1.5)
    with pytest.raises(jv.ComputationError, match="no stable synchronous regime"):
        motion_spread(DECK)(apart)


def test_machines_without_a_regime_count_in_tolerances(screen):
    spread = motion_spread(DECK)
    speeds = ["exciters[1].drive.speed=1000rpm..2000rpm"]
    found, demand = tolerance_ranges(screen, [spread, spread < 2.0 * spread], speeds, samples=8)
    assert 0.0 < found.share == demand.share < 1.0 and np.isfinite(found.high)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: throw_stroke(at=(1.0, 2.0, 3.0)), "it must be a point"),
        (lambda: throw_stroke(at=("1 s", 0.0)), r"at\[0\]"),
        (lambda: motion_spread([(0.0, 0.0)]), "at least two points"),
        (lambda: motion_spread([(0.0, 0.0), (1.0, 0.0)], body=-1), "body"),
        (lambda: foundation_force(harmonic=3), "without a mode"),
        (lambda: synchronization_margin() > "3 mm", "margin of synchronization"),
        (lambda: least_torque()(jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0), exciters=[
            jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.1)])), "needs motors"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_refused(make, says):
    with pytest.raises(jv.InputError, match=says):
        make()


@pytest.mark.parametrize("ratio", [0.4, 0.9, 1.7])
def test_pieces_of_the_resonance_distance_have_its_value(ratio):
    """The nearest natural frequency decides; a lower bound needs each of them, an upper bound the nearest only."""
    scene = jv.scene_from_toml(SCREENS["linear_screen"])
    speed = ratio * float(jnp.max(jv.natural_frequencies(scene)))
    given = SimpleNamespace(scene=scene, regime=SimpleNamespace(speed=speed))
    distances = np.abs(np.asarray(jv.natural_frequencies(scene)) / speed - 1.0)
    np.testing.assert_allclose(exciters._distances(given, -1.0, "leading"), -distances, rtol=1e-12)
    np.testing.assert_allclose(exciters._distances(given, 1.0, "leading"), [np.min(distances)], rtol=1e-12)
    np.testing.assert_allclose(resonance_distance().read(given), np.min(distances), rtol=1e-12)
