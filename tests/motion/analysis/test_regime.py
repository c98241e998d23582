"""Regimes are named from a motion alone; motors, dry friction and the published rotor end where they should."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published

import jaxvib as jv
from jaxvib.study.maps.published_rotor import published_rotor, rotor_regimes

TIME = jnp.linspace(0.0, 1.0, 801)


def made(phase, speed, *, wobble=0.0, slow=0.0, effects=()):
    """A made-up stretch of four loads on a rotor at 460 rad/s: phases (4,), speeds, a wobble, a slow change of speed."""
    s = eqx.tree_at(lambda s: s.drive, published_rotor(variant="uncoupled"), jv.ConstantSpeed(460.0))
    s = jv.Scene(s.machine, s.loads, s.drive, effects)
    speed = jnp.broadcast_to(jnp.asarray(speed, float), (4,))
    angle = jnp.asarray(phase)[None] + speed[None] * TIME[:, None] + wobble * jnp.sin(100.0 * TIME)[:, None]
    angle = angle + slow * TIME[:, None] ** 2
    rate = speed[None] + (100.0 * wobble * jnp.cos(100.0 * TIME) + 2.0 * slow * TIME)[:, None]
    still = jnp.zeros((801, 4))
    return s, jv.Trajectory(
        TIME, jv.State(still, still, (angle,), (rate,)), jnp.zeros((801, 2)), 460.0 * TIME, jnp.full(801, 460.0)
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
    "parted": (dict(phase=[0.0, 0.0, 0.0, 0.0], speed=[170.0, 170.0, 460.0, 460.0]), "parted", None, 0),
    "unsettled": (dict(phase=[0.0, 0.0, 0.0, 0.0], speed=200.0, slow=5.0), "unsettled", None, 0),
}


@pytest.mark.parametrize("name", CASES)
def test_regimes_of_made_up_motions(name):
    given, label, pattern, mode = CASES[name]
    found = jv.regime(*made(**given))
    assert found.label == label
    assert pattern is None or found.pattern_label == pattern
    assert int(found.mode) == mode
    assert str(jv.RegimeName[found.name]) in found.summary()


@pytest.mark.parametrize(("effects", "label"), [((), "balanced"), ((jv.MomentImbalance(2e-3),), "unbalanced")])
def test_loads_at_one_station_cannot_balance_what_tilts_their_rotor(effects, label):
    s, motion = made([0.0, np.pi, np.pi, 0.0], 460.0, effects=effects)
    machine = eqx.tree_at(lambda m: m.stations, s.machine, jnp.asarray(0.05))
    assert jv.regime(jv.Scene(machine, s.loads, s.drive, effects), motion).label == label


@pytest.mark.parametrize(
    ("speed", "damping", "mode", "near"),
    [
        (3.0, 0.01, 5, "beyond resonance 2 at 1 rad/s"),
        (3.0, 0.01, 3, "by resonance 2 at 1 rad/s"),
        (0.5, 0.05, 3, "beyond resonance 1 at 0.3"),
    ],
)
def test_a_run_that_starts_in_a_mode_and_stays_has_that_mode(speed, damping, mode, near):
    """Close to the rotor's speed it is the mode that rises there, not the unstable one that falls from the resonance below."""
    s = published(speed=speed, damping=damping, eps=0.01).scene()
    run = jv.simulate(s, 300.0, start="jam", mode=mode, save="window", tolerance=1e-6, estimate=False)
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


def test_weak_motor_is_caught_at_the_resonance_and_a_strong_one_passes():
    """The mean torque that the resonance takes, S^2 w^3 / (2 c) = 4.24 N m, against the motor's at that speed."""
    weak = jv.simulate(with_motor(jv.DCMotor(60.0, stall_torque=2.0, inertia=0.05)), 15.0, tolerance=1e-6)
    strong = jv.simulate(with_motor(jv.DCMotor(60.0, stall_torque=6.0, inertia=0.05)), 15.0, tolerance=1e-6)
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
    """How far the pendulum falls back behind the shaft, that it turned with at first or hung still beside, rad."""
    rate = jnp.zeros(1) if from_rest else s.drive.speed[None]
    start = jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.zeros(1),), (rate,))
    run = jv.simulate(s, until, start=start, samples=2, tolerance=tolerance, **options)
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


def test_published_rotor_at_three_frictions():
    """First jam 169.6 rad/s with ripple 3.1, second 271.1 in opposite pairs, and balancing, with the data read as c2 = 0."""
    first = rotor_regimes([9.2e-4, 1.24e-2], ["uncoupled, both dampers"], until=6.0)
    found = first.computed["uncoupled, both dampers"]
    assert found.kind[:, 0].tolist() == ["jammed", "jammed"]
    np.testing.assert_allclose(found.omega[:, 0], [169.6, 271.15], atol=0.1)
    np.testing.assert_allclose(found.regime.ripple[0, 0], 3.1, atol=0.1)
    # The torque balance at unequal phases, started from the phases of the run, gives the speed the run has locked to.
    for k, mu in enumerate(first.mu):
        jam = jv.phase_jam(published_rotor(float(mu), "uncoupled, both dampers"), found.omega[k, 0], found.regime.phase[k, 0])
        assert bool(jam.stable)
        np.testing.assert_allclose(jam.omega, found.omega[k, 0], atol=0.1)
    assert "together" in first.said("uncoupled, both dampers", 0)
    assert "opposite" in first.said("uncoupled, both dampers", 1)
    assert "169.6" in first.summary()


@pytest.mark.slow
def test_published_rotor_over_its_whole_friction():
    """What the paper reports, what its printed data give, and which readings bring it out; all at once."""
    mu = [5e-5, 9.2e-4, 1.0e-3, 1.02e-2, 1.8e-2, 4.6e-2, 1e-1]
    early, late = rotor_regimes(mu, until=4.0), rotor_regimes(mu, until=12.0)

    def words(found, variant):
        return [str(kind) for kind in found.computed[variant].kind[:, 0]]

    printed = early.computed["printed"]
    assert words(early, "printed")[1] != "jammed"  # no stable first jam with the printed c2
    np.testing.assert_allclose(printed.omega[3, 0], 271.1, atol=0.1)
    plain = words(late, "uncoupled")
    assert plain[:2] == ["swinging", "jammed"] and plain[2] != "jammed"
    assert words(late, "uncoupled, both dampers")[4] == "balanced"
    # "Turns with the rotor, not balanced" is a matter of when one looks.
    assert words(early, "uncoupled, both dampers")[5] == "unbalanced"
    assert words(late, "uncoupled, both dampers")[5:] == ["balanced", "balanced"]


@pytest.mark.slow
def test_first_jam_is_reached_from_equal_starts_only():
    """The first of 201 starts hangs together; one program for all, which takes longer to compile than to run."""
    s = published_rotor(9.2e-4, "uncoupled")
    together, scattered = np.full((1, 4), -np.pi / 2.0), np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 4))
    found = jv.run_ups(s, 6.0, angles=np.concatenate([together, scattered]), batch=8, tolerance=1e-6)
    assert np.all(found.finished)
    near_first = (found.kind[0] == "jammed") & (np.abs(found.omega[0] - 169.6) < 0.1)
    assert near_first[0] and np.mean(near_first[1:]) < 0.05


def test_run_ups_name_each_lane():
    s = jv.Scene(
        jv.planar_rotor(mass=20.0, stiffness=4e4, damping=60.0),
        jv.balls(count=2, mass=0.4, radius=0.08, drag=0.5),
        jv.SpinUp(60.0, duration=1.0),
    )
    found = jv.run_ups(s, 5.0, drag=[0.05, 5.0], angles=[[0.0, 0.1], [1.0, 2.0]], tolerance=1e-5)
    assert found.kind.shape == (2, 2) and np.all(found.finished)
    assert np.all(found.fraction("jammed") + found.fraction("unbalanced") + found.fraction("balanced") <= 1.0)
    assert not np.any(found.fraction("failed"))
    lone = eqx.tree_at(lambda s: s.loads.drag, s, jnp.asarray(5.0))
    start = eqx.tree_at(lambda y: y.angle, jv.initial_state(lone), (jnp.array([1.0, 2.0]),))
    run = jv.simulate(lone, 5.0, start=start, save="window", tolerance=1e-5)
    assert run.regime.label == found.kind[1, 1]
    np.testing.assert_allclose(found.omega[1, 1], run.omega, rtol=1e-6)
    assert len(found.plot().axes) == 2
    lines = found.summary().splitlines()
    assert lines[0] == "of 2 starts at each drag" and lines[1].startswith("drag 0.05 N s/m: ")
    for line, kinds in zip(lines[1:], found.kind, strict=True):
        assert all(f"{50 * np.sum(kinds == kind)} % {kind}" in line for kind in kinds)
    with pytest.raises(jv.InputError, match=r"angles has shape \(1, 3\)"):
        jv.run_ups(s, 5.0, angles=[[0.0, 0.1, 0.2]])
    with pytest.raises(jv.InputError, match="goes without angles"):
        jv.run_ups(s, 5.0, starts=3, angles=[[0.0, 0.1]])


def test_run_ups_that_fail_are_no_motion():
    """In single precision, whose tolerance nobody has named; one drag is none at all."""
    with jax.enable_x64(False):
        s = jv.Scene(
            jv.one_mass(mass=20.0, stiffness=4e4, damping=60.0),
            jv.balls(count=1, mass=0.4, radius=0.08, drag=0.5),
            jv.SpinUp(60.0, duration=0.5),
        )
        found = jv.run_ups(s, 2.0, drag=[5.0, 1e12], max_steps=2**14)
    assert found.finished.tolist() == [[True], [False]]
    assert found.fraction("failed").tolist() == [0.0, 1.0] and found.kind[1, 0] == "failed"
    assert found.summary().splitlines()[2] == "drag 1e+12 N s/m: 100 % failed"
    assert len(found.plot().axes) == 2
    with pytest.raises(jv.InputError, match=r"kind is 'lost'; allowed: swinging, .*unsettled, failed"):
        found.fraction("lost")


def test_regime_under_jit_and_vmap():
    s, stretch = made([0.0, 0.1, -0.1, 0.05], 170.0)
    once = jv.regime(s, stretch)
    many = jax.jit(jax.vmap(lambda k: jv.regime(s, eqx.tree_at(lambda x: x.state.rate[0], stretch, k * stretch.state.rate[0]))))
    found = many(jnp.array([1.0, 2.0]))
    assert np.all(found.name == once.name) and found.load_speed.shape == (2, 4)
