"""Whirl and critical speeds against closed forms, published numbers and the equations of motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from papers.machines import published_rotor
from scenes import scene as platforms

import jaxvib as jv
from jaxvib.steady.whirl import _has_all_springs


@pytest.mark.parametrize(
    "variant, loads, forward",
    [("printed", "none", (176.19, 278.26)), ("printed", "fixed", (175.70, 273.34)), ("uncoupled", "fixed", (176.51, 272.81))],
)
def test_critical_speeds_of_the_published_rotor(variant, loads, forward):
    """The paper prints 176.69 and 274.76, which no convention gives; these are what its data give."""
    found = jv.critical_speeds(published_rotor(variant=variant), loads=loads)
    np.testing.assert_allclose(found.speed[found.forward], forward, atol=0.0051)


def test_second_forward_whirl_at_working_speed():
    """A* w^2 - C n w - c3 = 0 for the tilt, without damping."""
    closed = published_rotor(variant="uncoupled").machine
    c3, tilted = float(closed.stiffness_terms[2]), 0.479 + 0.05 * 2 * (0.28**2 + 0.25**2)
    w = (0.093 * 460.0 + np.sqrt((0.093 * 460.0) ** 2 + 4.0 * tilted * c3)) / (2.0 * tilted)
    assert 292.5 < w < 293.5
    undamped = eqx.tree_at(lambda s: s.machine.damping_terms, published_rotor(variant="uncoupled"), jnp.zeros(3))
    np.testing.assert_allclose(jv.whirl(undamped).speed[0][3], w, rtol=1e-10)


def test_whirl_is_the_free_motion_of_the_vector_field():
    """Eigenvalues of the field's own Jacobian at rest; massless loads leave the rotor's motion alone."""
    loads = jv.pendulums(count=4, mass=1e-13, radius=0.08, drag=1e-10)
    s = jv.Scene(published_rotor().machine, loads, jv.ConstantSpeed(460.0))
    rest = jv.initial_state(s)
    field = jv.vector_field(s)

    def motion(x):
        state = eqx.tree_at(lambda y: (y.displacement, y.velocity), rest, (x[:4], x[4:]))
        change = field(0.0, state)
        return jnp.concatenate([change.displacement, change.velocity])

    values = np.linalg.eigvals(np.asarray(jax.jacfwd(motion)(jnp.zeros(8))))
    values = values[values.imag > 0.0]
    values = values[np.argsort(values.imag)]
    found = jv.whirl(s, loads="none")
    np.testing.assert_allclose(found.speed[0], values.imag, rtol=1e-8)
    np.testing.assert_allclose(found.decay[0], -values.real, rtol=1e-6)


def test_thin_disc_has_no_second_forward_critical_speed():
    s = eqx.tree_at(lambda s: s.machine.polar_inertia, published_rotor(variant="uncoupled"), jnp.asarray(0.9))
    found = jv.critical_speeds(s)
    assert int(jnp.sum(jnp.isinf(found.speed))) == 1
    assert np.all(np.isfinite(np.asarray(found.speed[:3])))


def test_heavily_damped_motion_does_not_oscillate():
    s = jv.Scene(
        jv.planar_rotor(mass=10.0, stiffness=1e3, damping=1e3),
        jv.pendulums(count=1, mass=0.1, radius=0.1, drag=0.1),
        jv.ConstantSpeed(50.0),
    )
    found = jv.whirl(s, loads="none")
    np.testing.assert_array_equal(found.speed[0], 0.0)
    assert np.all(np.asarray(found.decay) > 0.0)


def test_gradients_of_whirl_speeds():
    s = published_rotor()

    def speeds(k):
        changed = eqx.tree_at(lambda s: s.machine.polar_inertia, s, k)
        return jnp.concatenate([jv.whirl(changed).speed[0], jv.critical_speeds(changed).speed])

    at, step = jnp.asarray(0.093), 1e-5
    forward, reverse = eqx.filter_jit(jax.jacfwd(speeds))(at), eqx.filter_jit(jax.jacrev(speeds))(at)
    numeric = (speeds(at + step) - speeds(at - step)) / (2.0 * step)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-7)
    # Rounding of a speed, 1e-11, over the step: 1e-6; the difference's own error is smaller.
    np.testing.assert_allclose(forward, numeric, rtol=1e-5, atol=1e-4)


def test_campbell_diagram_has_both_senses():
    found = jv.whirl(published_rotor(), list(np.linspace(0.0, 600.0, 13)))
    assert found.speed.shape == (13, 4)
    labels = [line.get_label() for line in found.plot().axes[0].lines]
    assert "forward whirl" in labels and "backward whirl" in labels
    with pytest.raises(jv.InputError, match="rotor_speed is a single speed; a Campbell diagram needs several"):
        jv.whirl(published_rotor()).plot()


def test_platforms_do_not_whirl():
    with pytest.raises(jv.InputError, match=r"machine\.kind is 'two_mass', which moves only up and down"):
        jv.whirl(platforms("two_mass"))
    with pytest.raises(jv.InputError, match=r"rotor_speed\[1\] is -5 rad/s; it must be at least 0"):
        jv.whirl(published_rotor(), [10.0, -5.0])
    with pytest.raises(jv.InputError, match=r"loads is 'some'; allowed: fixed, none"):
        jv.whirl(published_rotor(), loads="some")


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_whirls_of_one_speed_are_distinguished_at_every_size(size):
    """Without damping and gyroscopic coupling both turn at sqrt(k/m), one in each sense."""
    machine = jv.planar_rotor(mass=37.0 * size, stiffness=1.16e6 * size, damping=0.0)
    scene = jv.Scene(machine, jv.pendulums(count=1, mass=0.5 * size, radius=0.08, drag=0.1), jv.ConstantSpeed(460.0))
    found = jv.whirl(scene, loads="none")
    np.testing.assert_allclose(found.speed[0], (1.16e6 / 37.0) ** 0.5, rtol=1e-9)
    assert sorted(np.asarray(found.forward[0]).tolist()) == [False, True]


def test_springs_hold_whatever_the_units_of_their_coordinates():
    assert _has_all_springs(1e-9 * np.eye(3)) and _has_all_springs(np.diag([1e12, 1e-12]))
    assert not _has_all_springs(1e10 * np.array([[1.0, 1.0], [1.0, 1.0]])) and not _has_all_springs(np.diag([1e-9, 0.0]))


def overdamped(translation, tilt, speed=0.0, polar=0.1):
    """A rotor of 20 kg and 0.5 kg m^2 whose motions have these pairs of real roots -a, -b, 1/s, while it is at rest."""
    (a, b), (c, d) = translation, tilt
    machine = jv.rotor(
        mass=20.0,
        transverse_inertia=0.5,
        polar_inertia=polar,
        stiffness=(1.0, 1.0),
        damping=(1.0, 1.0),
        position=(0.2, -0.2),
        stiffness_terms=[20.0 * a * b, 0.0, 0.5 * c * d],
        damping_terms=[20.0 * (a + b), 0.0, 0.5 * (c + d)],
    )
    loads = jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0)
    return jv.whirl(jv.Scene(machine, loads, jv.ConstantSpeed(60.0)), [speed], loads="none")


@pytest.mark.parametrize(
    ("translation", "tilt"), [((1.0, 9e3), (1.5, 2e4)), ((1.0, 100.0), (200.0, 300.0)), ((40.0, 50.0), (3.0, 800.0))]
)
def test_an_overdamped_motion_has_its_slower_decay(translation, tilt):
    """m s^2 + c s + k = m (s + a) (s + b), a < b, whether the roots of the motions lie apart or between each other."""
    found = overdamped(translation, tilt)
    np.testing.assert_array_equal(found.speed, 0.0)
    np.testing.assert_allclose(found.decay[0], sorted([translation[0]] * 2 + [tilt[0]] * 2), rtol=1e-6)
    assert not np.any(found.forward) and found.summary().count("(overdamped)") == 4
    assert np.all(np.isnan(found.directivity))


@pytest.mark.parametrize("speed", [1.0, 20.0, 60.0, 3e3])
def test_overdamped_whirls_keep_their_decays_at_speed(speed):
    """Across and up keep their real roots; tilts z = theta + i psi turn: 0.5 z'' + (c - 0.1 i n) z' + k z = 0."""
    found = overdamped((1.0, 9e3), (1.5, 2e4), speed)
    roots = np.roots([0.5, 0.5 * (1.5 + 2e4) - 0.1j * speed, 0.5 * 1.5 * 2e4])
    roots = roots[np.argsort(np.abs(roots.imag))]
    np.testing.assert_allclose(found.speed[0], [0.0, 0.0, *np.abs(roots.imag)], rtol=1e-4)
    np.testing.assert_allclose(found.decay[0], [1.0, 1.0, *-roots.real], rtol=1e-6)
    assert found.forward[0].tolist() == [False, False, *(roots.imag > 0.0)]


def test_an_overdamped_motion_creeps_back_at_its_decay():
    """A rotor on two stiff dampers, its equations integrated from a displacement at rest: x falls as exp(-1.0001 t)."""
    c, k, m = 2e5, 2e5, 20.0
    machine = jv.rotor(
        mass=m, transverse_inertia=0.5, polar_inertia=0.1, stiffness=(1e5, 1e5), damping=(1e5, 1e5), position=(0.2, -0.2)
    )
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
    decay = (c - np.sqrt(c**2 - 4.0 * k * m)) / (2.0 * m)
    for speed in (0.0, 60.0):
        found = jv.whirl(scene, [speed], loads="none")
        assert int(np.sum(np.isclose(found.decay[0], decay, rtol=1e-9))) == 2


@pytest.mark.parametrize("soft", [1e6, 1e4, 1e3, 300.0])
def test_single_precision_says_which_whirls_it_loses(soft):
    """Two supports of which one is soft: all is right to 1 % or NaN under a status of its own."""

    def found(stiffness):
        machine = jv.rotor(
            mass=20.0, transverse_inertia=0.5, polar_inertia=0.1, stiffness=stiffness, damping=0.0, position=(0.2, -0.155)
        )
        scene = jv.Scene(machine, jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
        return jv.whirl(scene, [0.0, 60.0])

    exact = found((1e8, soft))
    assert exact.status_name == "done" and exact.critical.status_name == "done"
    with jax.enable_x64(False):
        single = found((1e8, soft))
        for ours, theirs in ((single, exact), (single.critical, exact.critical)):
            speed, right = np.asarray(ours.speed, float), np.asarray(theirs.speed)
            lost = np.isnan(speed)
            assert ours.status_name == ("lost_digits" if np.any(lost) else "done")
            np.testing.assert_allclose(speed[~lost & np.isfinite(right)], right[~lost & np.isfinite(right)], rtol=0.01)
        assert bool(np.any(np.isnan(np.asarray(single.speed)))) == (soft < 1e4)
        with pytest.raises(jv.InputError, match=r"within single precision.*or use double precision"):
            found((1e8, 10.0))


def test_machines_from_matrices_have_the_same_sense_of_whirls():
    """Two springs of different stiffness move the axis on straight lines, equal ones on circles in both directions."""
    loads, drive = jv.balls(count=2, mass=0.05, radius=0.08, drag=1.0), jv.ConstantSpeed(100.0)
    for up, sense in ((1.4e6, ["straight at 0 deg", "straight at 90 deg"]), (1e6, ["backward", "forward"])):
        other = {} if up == 1e6 else {"stiffness_up": up}
        matrices = {"mass": 37.0 * np.eye(2), "damping": 100.0 * np.eye(2), "stiffness": np.diag([1e6, up])}
        for machine in (
            jv.from_matrices(**matrices, places=[[[1.0, 0.0], [0.0, 1.0]]]),
            jv.planar_rotor(mass=37.0, stiffness=1e6, damping=100.0, **other),
        ):
            assert jv.critical_speeds(jv.Scene(machine, loads, drive)).sense.tolist() == sense


@pytest.mark.parametrize("direction", [1, -1])
def test_clockwise_rotors_whirl_at_their_own_speed(direction):
    """Damping that couples both directions acts in one sense only, the gyroscopic moments in that of the rotor."""
    stiffness, damping = np.diag([4e4, 5e4]), np.array([[20.0, 60.0], [-60.0, 30.0]])
    gyroscopic = np.array([[0.0, 2.0], [-2.0, 0.0]])
    machine = jv.from_matrices(10.0 * np.eye(2), damping, stiffness, gyroscopic, places=[np.eye(2)])
    exciter = jv.Exciter(jv.balls(count=1, mass=0.05, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0), direction=direction)
    found, mass = jv.whirl(jv.Scene(machine, exciters=[exciter])), 10.05
    flow = np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness / mass, -(damping + direction * 60.0 * gyroscopic) / mass]])
    right = sorted((s for s in np.linalg.eigvals(flow) if s.imag > 0.0), key=lambda s: s.imag)
    np.testing.assert_allclose(found.speed[0] * 1j - found.decay[0], right, rtol=1e-9)
    assert found.sense[0].tolist() == ["backward", "forward"]


def test_stiffnesses_that_overflow_have_a_status():
    shaft = dict(mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, stiffness=(1e308, 1e308), damping=400.0)
    machine = jv.rotor(**shaft, position=(0.165, -0.155))
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.1, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
    with pytest.raises(jv.ComputationError, match=r"^overflow: stiffnesses of the machine are not finite"):
        jv.whirl(scene, [0.0])


def test_whirls_that_are_not_finite_count_as_lost():
    scene = eqx.tree_at(lambda s: s.machine.stations, published_rotor(), jnp.asarray(1e300))
    found = jv.whirl(scene, (100.0, 200.0))
    assert found.status_name == "lost_digits" and np.all(np.isnan(found.speed) == np.isnan(found.decay))
