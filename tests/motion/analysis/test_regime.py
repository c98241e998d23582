"""Regimes are named from a motion alone; motors and dry friction end where they should."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from papers.machines import published_rotor
from scenes import published

import jaxvib as jv
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.motion.analysis.regime import _is_rotor_caught, estimated_mode

TIME = jnp.linspace(0.0, 1.0, 801)


def made(phase, speed, *, wobble=0.0, slow=0.0, effects=()):
    """A made-up segment of four loads on a rotor at 460 rad/s: phases (4,), speeds, a wobble, a slow change of speed."""
    s = eqx.tree_at(lambda s: s.drive, published_rotor(variant="uncoupled"), jv.ConstantSpeed(460.0))
    s = jv.Scene(s.machine, s.loads, s.drive, effects)
    speed = jnp.broadcast_to(jnp.asarray(speed, float), (4,))
    angle = jnp.asarray(phase)[None] + speed[None] * TIME[:, None] + wobble * jnp.sin(100.0 * TIME)[:, None]
    angle = angle + slow * TIME[:, None] ** 2
    rate = speed[None] + (100.0 * wobble * jnp.cos(100.0 * TIME) + 2.0 * slow * TIME)[:, None]
    still = jnp.zeros((801, 4))
    return s, Trajectory(
        TIME, jv.State(still, still, (angle,), (rate,)), jnp.zeros((801, 2)), (460.0 * TIME,), (jnp.full(801, 460.0),)
    )


CASES = {
    "swinging": (dict(phase=[-1.5, -1.6, -1.4, -1.5], speed=0.0, wobble=0.5), "swinging", None, 0),
    "together": (dict(phase=[0.0, 0.1, -0.1, 0.05], speed=170.0, wobble=0.01), "jammed", "together", 1),
    "above the first": (dict(phase=[0.0, 0.1, -0.1, 0.05], speed=190.0), "jammed", "together", 2),
    "opposite": (dict(phase=[0.0, 0.1, 3.2, 3.1], speed=271.0), "jammed", "opposite", 3),
    "balanced": (dict(phase=[0.0, np.pi, np.pi, 0.0], speed=460.0), "balanced", "opposite", 0),
    # Each plane's two pendulums at one angle: no force, but a moment that turns with the rotor.
    "a couple is left": (dict(phase=[0.0, 0.0, np.pi, np.pi], speed=460.0), "unbalanced", "opposite", 0),
    "unbalanced": (dict(phase=[0.0, 0.0, 0.1, 0.1], speed=460.0), "unbalanced", "together", 0),
    "imbalance is left": (
        dict(phase=[0.0, np.pi, np.pi, 0.0], speed=460.0, effects=(jv.StaticImbalance(0.008),)),
        "unbalanced",
        "opposite",
        0,
    ),
    "imbalance is balanced": (
        dict(phase=3.8 + np.pi / 3.0 * np.array([1, -1, -1, 1]), speed=460.0, effects=(jv.StaticImbalance(8e-3, 3.8 - np.pi),)),
        "balanced",
        None,
        0,
    ),
    "steadily slower than the rotor": (dict(phase=[0.0, 0.0, 0.1, 0.1], speed=0.9971 * 460.0), "jammed", "together", 5),
    "hardly slower than the rotor": (dict(phase=[0.0, 0.0, 0.1, 0.1], speed=460.0 - 0.09), "unbalanced", "together", 0),
    "gaining on the rotor": (dict(phase=[0.0, 0.0, 0.1, 0.1], speed=0.9971 * 460.0, slow=0.4), "unbalanced", "together", 0),
    "below half the first resonance": (dict(phase=[0.0, 0.1, -0.1, 0.05], speed=80.0), "jammed", "together", 1),
    "parted": (dict(phase=[0.0, 0.0, 0.0, 0.0], speed=[170.0, 170.0, 460.0, 460.0]), "parted", None, 0),
    "slow and still accelerating": (dict(phase=[0.0, 0.0, 0.0, 0.0], speed=20.0, slow=1.0), "unsettled", None, 0),
    "unsettled": (dict(phase=[0.0, 0.0, 0.0, 0.0], speed=200.0, slow=5.0), "unsettled", None, 0),
}


@pytest.mark.parametrize("name", CASES)
def test_regimes_of_prescribed_motions(name):
    given, label, pattern, mode = CASES[name]
    found = jv.regime(*made(**given))
    assert found.label == label
    assert pattern is None or found.pattern_label == pattern
    assert int(found.mode) == mode
    assert str(jv.RegimeName[found.name]) in found.summary()


@pytest.mark.parametrize(
    ("name", "arrows", "with_moments"),
    [
        ("together", "resultant 0.997", False),
        ("imbalance is balanced", "loads 0.5, rotor 0.5 (orange), sum 0", False),
        ("imbalance is left", "loads 0, rotor 0.5 (orange), sum 0.5", False),
        ("a couple is left", "resultant 0", True),
    ],
)
def test_figures_show_the_loads_and_the_imbalance_of_the_rotor(name, arrows, with_moments):
    (axis,) = jv.regime(*made(**CASES[name][0])).plot().axes
    title = axis.get_title().split("\n")
    assert (title[0], title[-1]) == (CASES[name][1], arrows) and ("with moments" in title[1]) == with_moments
    plt.close("all")


@pytest.mark.parametrize(("effects", "label"), [((), "balanced"), ((jv.MomentImbalance(2e-3),), "unbalanced")])
def test_loads_at_one_station_cannot_balance_a_moment(effects, label):
    s, motion = made([0.0, np.pi, np.pi, 0.0], 460.0, effects=effects)
    machine = eqx.tree_at(lambda m: m.stations, s.machine, jnp.asarray(0.05))
    assert jv.regime(jv.Scene(machine, s.loads, s.drive, effects), motion).label == label


@pytest.mark.parametrize(
    ("speed", "damping", "mode", "near"),
    [
        (3.0, 0.01, 5, "beyond resonance 2 at 9.5493 rpm"),
        (3.0, 0.01, 3, "by resonance 2 at 9.5493 rpm"),
        (0.5, 0.05, 3, "beyond resonance 1 at 3.1831 rpm"),
    ],
)
def test_a_run_that_starts_in_a_mode_and_stays_has_that_mode(speed, damping, mode, near):
    """Close to the rotor speed it is the mode that rises there, not the unstable one that falls from the resonance below."""
    s = published(speed=speed, damping=damping, eps=0.01).scene()
    run = jv.simulate(s, 300.0, start="jam", mode=mode, save="window", stepsize_controller=jv.Tolerance(1e-6), estimate=False)
    np.testing.assert_allclose(run.omega, jv.jam_modes(s).select(mode).omega, rtol=0.03)
    np.testing.assert_allclose(run.regime.load_speed, run.load_speed, rtol=1e-12)
    assert run.regime.label == "jammed" and int(run.regime.mode) == mode
    assert near in run.regime.summary() and f"(mode {mode})" in run.regime.summary()


def test_ripple_is_half_of_peak_to_peak():
    found = jv.regime(*made([0.0, 0.0, 0.0, 0.0], 170.0, wobble=0.03))
    np.testing.assert_allclose(found.ripple, 3.0, rtol=1e-3)


def with_motor(drive):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)
    return jv.Scene(machine, jv.balls(count=1, mass=1e-3, radius=0.05, drag=2.0), drive, (jv.StaticImbalance(0.15),))


def test_weak_motor_is_caught_and_a_strong_one_passes():
    """The mean torque that the resonance takes, S^2 w^3 / (2 c) = 4.24 N m, against the motor's at that speed."""
    weak = jv.simulate(
        with_motor(jv.DCMotor(60.0, stall_torque=2.0, inertia=0.05)), 15.0, stepsize_controller=jv.Tolerance(1e-6)
    )
    strong = jv.simulate(
        with_motor(jv.DCMotor(60.0, stall_torque=6.0, inertia=0.05)), 15.0, stepsize_controller=jv.Tolerance(1e-6)
    )
    resonance = np.sqrt(4e4 / 50.0)
    assert 0.9 * resonance < float(jnp.mean(weak.window.rotor_speed)) < resonance
    assert bool(weak.regime.caught) and "caught" in weak.summary()
    assert float(jnp.mean(strong.window.rotor_speed)) > 59.0 and not bool(strong.regime.caught)
    # Where it hangs, torque and what the vibration takes are equal.
    w = float(jnp.mean(weak.window.rotor_speed))
    taken = 0.15**2 * w**3 / 2.0 * (w**2 * 60.0) / ((4e4 - 50.0 * w**2) ** 2 + (60.0 * w) ** 2)
    np.testing.assert_allclose(taken, 2.0 * (1.0 - w / 60.0), rtol=0.05)


def rubbing(lever, width, speed=100.0):
    """A pendulum on a shaft in a body too heavy to move, held by dry friction alone against gravity."""
    machine = jv.planar_rotor(mass=1e9, stiffness=1e9, damping=0.0)
    loads = jv.pendulums(count=1, mass=0.2, radius=0.08, drag=0.0)
    dry = jv.DryFriction(0.2, diameter=10.0 * lever, width=width)
    return jv.Scene(machine, loads, jv.ConstantSpeed(speed), (jv.Gravity(), dry))


def slipped(s, until=0.5, from_rest=False, tolerance=1e-9, **options):
    """Angle by which the pendulum falls back behind the shaft, rad; it starts at the shaft's speed or at rest."""
    rate = jnp.zeros(1) if from_rest else s.drive.speed[None]
    start = jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.zeros(1),), (rate,))
    run = jv.simulate(s, until, start=start, samples=2, stepsize_controller=jv.Tolerance(tolerance), **options)
    return float(s.drive.speed * until - run.trajectory.state.angle[0][-1, 0])


def test_dry_friction_sticks_and_slides():
    """Against gravity it holds above lever = g / n^2 = 9.8e-4 m, but for a creep that goes to 0 with the width.

    From rest, with N = m R n^2, it drags the pendulum along with the acceleration lever n^2 / R, until it sticks after
    R / (lever n), R / (2 lever) rad behind the shaft; tanh adds pi^2 width^2 R / (12 lever n^2), which goes to 0.
    """
    sticking = [slipped(rubbing(4e-3, width)) for width in (0.4, 0.2, 0.1)]
    assert all(abs(a) < 0.02 for a in sticking)
    np.testing.assert_allclose(np.array(sticking[:2]) / sticking[1:], 2.0, rtol=0.2)
    s = rubbing(4e-3, 0.4)
    behind = 0.08 / (2.0 * 4e-3)
    sliding = []
    for width in (0.4, 0.2, 0.1):
        dry = jv.DryFriction(0.2, diameter=0.04, width=width, reaction="steady")
        sliding.append(slipped(jv.Scene(s.machine, s.loads, s.drive, (dry,)), from_rest=True) - behind)
    drawn = 4e-3 * 100.0**2 / 0.08
    np.testing.assert_allclose(sliding, np.pi**2 / 12.0 * np.array([0.4, 0.2, 0.1]) ** 2 / drawn, atol=1e-8)


def test_stiff_dry_friction_by_an_implicit_solver():
    s = rubbing(4e-3, 1e-2)
    explicit, implicit = slipped(s, 0.2), slipped(s, 0.2, tolerance=1e-7, solver=diffrax.Kvaerno5())
    np.testing.assert_allclose(explicit, implicit, atol=1e-9)


def test_regime_under_jit_and_vmap():
    s, segment = made([0.0, 0.1, -0.1, 0.05], 170.0)
    once = jv.regime(s, segment)
    many = eqx.filter_jit(
        jax.vmap(lambda k: jv.regime(s, eqx.tree_at(lambda x: x.state.rate[0], segment, k * segment.state.rate[0])))
    )
    found = many(jnp.array([1.0, 2.0]))
    assert np.all(found.name == once.name) and found.load_speed.shape == (2, 4)


def test_remaining_moment_is_relative_to_the_radius_of_gyration():
    """Loads at the mount have no levers of their own: J_t = 0.479 kg m^2 of 37 kg, four times 0.05 kg."""
    s, motion = made([0.0, np.pi, np.pi, 0.0], 460.0)
    machine = eqx.tree_at(lambda m: m.stations, s.machine, jnp.asarray(0.0))
    found = jv.regime(jv.Scene(machine, s.loads, s.drive, (jv.MomentImbalance(2e-5),)), motion)
    np.testing.assert_allclose(found.unbalance, 2e-5 / (4 * 0.05 * 0.08 * np.sqrt(0.479 / 37.0)), rtol=1e-9)


def test_summary_names_an_imbalance_beyond_the_loads():
    """Four pendulums of 0.05 kg at 0.08 m: 0.016 kg m of unbalance, opposite each other or all at one angle."""
    opposite, together = [0.0, np.pi, np.pi, 0.0], [0.0] * 4
    found = jv.regime(*made(opposite, 460.0, effects=(jv.StaticImbalance(4.8e3),))).summary()
    more = "3e+05 times that of all loads (the rotor alone has 4800 kg m)"
    cause = "the imbalance of the rotor exceeds what the loads can balance"
    assert f"the remaining unbalance is 4800 kg m, {more}: {cause}" in found
    added = jv.regime(*made(together, 460.0, effects=(jv.StaticImbalance(8e-3),))).summary()
    own = "that of all loads (the rotor alone has 8 g m);"
    assert f"; the remaining unbalance is 0.024 kg m, 1.5 times {own}" in added and "exceeds" not in added
    partly = jv.regime(*made(opposite, 460.0, effects=(jv.StaticImbalance(8e-3),))).summary()
    assert f"; the remaining unbalance is 8 g m, 50 % of {own}" in partly
    plain = jv.regime(*made(together, 460.0))
    assert "; the remaining unbalance is 0.016 kg m, 100 % of that of all loads;" in plain.summary()
    np.testing.assert_allclose(plain.total_load_unbalance, 0.016)


def test_a_jam_close_to_the_rotors_speed_is_a_jam():
    """An exact one, whose slip of 0.29 % balances drag and vibration."""
    loads = jv.balls(count=1, mass=0.5, radius=0.1, drag=2.8)
    s = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0), loads, jv.ConstantSpeed(60.0))
    orbit = jv.jam_orbit(s, mode=3)
    assert 0.9965 < float(orbit.omega) / 60.0 < 0.9975
    run = jv.simulate(s, 20.0, start=jv.State(*orbit.at(jnp.zeros(()))), save="window", estimate=False)
    np.testing.assert_allclose(run.omega, orbit.omega, rtol=1e-7)
    assert run.regime.label == "jammed" and int(run.regime.mode) == 3


@pytest.mark.parametrize(
    ("rotor", "caught"),
    [(0.84, False), (0.86, True), (1.01, True), (1.03, False), (1.69, False), (1.95, True), (2.84, True), (2.86, False)],
)
def test_a_motor_is_caught_below_a_resonance_and_its_speed(rotor, caught):
    """Resonances at 1, 2 and 3; the motor without a load turns at 3, so that from 2.85 on it is at its own speed."""
    drive = jv.DCMotor(3.0, stall_torque=2.0, inertia=0.05)
    natural = jnp.asarray([1.0, 2.0, 3.0])
    assert bool(_is_rotor_caught(with_motor(drive), natural, jnp.asarray(rotor))) == caught
    assert not bool(_is_rotor_caught(with_motor(jv.ConstantSpeed(3.0)), natural, jnp.asarray(rotor)))


@pytest.mark.parametrize(("tilts", "label"), [(1.0, "balanced"), (0.0, "unbalanced"), (-1.0, "unbalanced")])
def test_loads_off_the_mass_centre_balance_tilted_rotors(tilts, label):
    """Loads 0.05 m from an imbalance U tilt the rotor, unless its principal axis leans by 0.05 U: the carrier then rests."""
    unbalance, place = 4.0 * 0.05 * 0.08 * 0.5, 0.05
    effects = (jv.StaticImbalance(unbalance, np.pi), jv.MomentImbalance(tilts * place * unbalance, np.pi))
    phase = jnp.asarray([1.0, -1.0, -1.0, 1.0]) * jnp.pi / 3.0
    s, motion = made(phase, 460.0, effects=effects)
    s = jv.Scene(eqx.tree_at(lambda m: m.stations, s.machine, jnp.asarray(place)), s.loads, s.drive, effects)
    start = jv.State(jnp.zeros(4), jnp.zeros(4), (phase,), (jnp.full(4, 460.0),))
    pushed = float(jnp.max(jnp.abs(jv.vector_field(s)(0.0, start).velocity)))
    assert (pushed < 1e-9) == (label == "balanced")
    assert jv.regime(s, motion).label == label


def test_modes_of_equal_frequencies_are_those_of_jam_modes():
    """A planar rotor on equal supports has modes 1, 2 and 5 at its two equal natural frequencies."""
    machine = jv.planar_rotor(mass=20.0, stiffness=6.3e5, damping=60.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.05, radius=0.08, drag=1.0), jv.ConstantSpeed(320.0))
    natural = jnp.sort(jv.natural_frequencies(scene))
    modes = jv.jam_modes(scene).omega
    assert [int(estimated_mode(natural, modes[k - 1], jnp.asarray(320.0))) for k in (1, 2, 5)] == [1, 2, 5]


def test_a_motion_that_does_not_exist_has_no_regime():
    """The states of a run without a start are NaN, those after max_steps infinite."""
    loads = jv.balls(count=2, mass=0.3, radius=0.09, drag=300.0)
    scene = jv.Scene(jv.one_mass(mass=60.0, stiffness=2.5e5, damping=120.0), loads, jv.ConstantSpeed(64.65))
    for status, arguments in ("no_start", dict(start="jam", mode=1)), ("max_steps_reached", dict(max_steps=100)):
        run = jv.simulate(scene, 10.0, throw=False, estimate=False, **arguments)
        assert run.status_name == status and np.all(np.isnan(run.regime.load_speed))
        assert run.regime.label == "unsettled" and np.isnan(run.regime.ripple)


def test_regime_of_several_exciters_is_refused():
    scene, segment = made([0.0] * 4, 460.0)
    both = jv.Scene(scene.machine, exciters=[scene.exciters[0]] * 2)
    with pytest.raises(jv.InputError, match="scene has 2 exciters; this function needs a scene with one exciter"):
        jv.regime(both, segment)
