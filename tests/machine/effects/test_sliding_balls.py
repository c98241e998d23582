"""Balls that spin freely on their contact, and slide before they roll: against a rigid ball in space, closed forms, energy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from torus import MASS, OWN, RADIUS, SPEED, balls, published, scene, some_state
from torus.rigid_ball import RigidBall

import jaxvib as jv
from jaxvib.equations.forces import energy, power
from jaxvib.machine.files import TEMPLATES
from jaxvib.runtime.operations import count_operations

HEAVY = jv.planar_rotor(mass=1e12, stiffness=0.0, damping=0.0)
BOTH = (jv.FreeSpin(), jv.Sliding(0.1))
GAP = 0.0025
RIGID = RigidBall(MASS, OWN, RADIUS, GAP, SPEED, 9.81)

evaluate = eqx.filter_jit(lambda s, t, state: jv.vector_field(s)(t, state))


def one_ball(*effects):
    return jv.Scene(HEAVY, balls(1), jv.ConstantSpeed(SPEED), (jv.Gravity(along="axis"), *effects))


def at(f, a, turn, climb):
    pairs = ((jnp.asarray([x]) for x in pair) for pair in ((f, a), (turn, climb)))
    return jv.State(jnp.zeros(2), jnp.zeros(2), *(tuple(pair) for pair in pairs))


def compared(run):
    """Coordinates of `RigidBall.coordinates` at the end of a run."""
    end = jax.tree.map(lambda leaf: np.asarray(leaf[-1, 0]), (run.trajectory.state.angle, run.trajectory.state.rate))
    (f, a), (turn, climb) = end
    arm = RADIUS + GAP * np.sin(a)
    twist = float(run.trajectory.state.spin.drilling[-1, 0])
    return np.array([turn, climb, arm * np.cos(f), arm * np.sin(f), np.mod(a, 2.0 * np.pi), twist])


START = (0.3, 0.8, 60.0, 30.0)


def test_a_ball_that_spins_freely_is_the_rigid_ball_in_space():
    """Two turns of the rotor; the rigid ball knows no torus coordinates and no law of rolling but that its slip stays 0."""
    place, velocity = RIGID.state(*START)
    n, _ = RIGID.normal(place, velocity)
    wall = SPEED * np.cross([0.0, 0.0, 1.0], place + OWN * n)
    turning = np.cross(n, wall - velocity) / OWN + SPEED * n[2] * n  # rolls, and spins with the wall
    expected, _ = RIGID.ends(np.concatenate([place, velocity, turning]), 0.09)
    run = jv.simulate(
        one_ball(jv.FreeSpin()), 0.09, start=at(*START), samples=2, stepsize_controller=jv.EqualSteps(2000), estimate=False
    )
    found, expected = compared(run), RIGID.coordinates(expected)
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    assert abs(found[-1]) > SPEED  # what it has gathered counts


def test_sliding_ball_starts_to_roll_like_a_rigid_ball():
    place, velocity = RIGID.state(*START)
    still = np.concatenate([place, velocity, np.zeros(3)])
    sliding, _ = RIGID.ends(still, 0.03, coefficient=0.1)
    expected, rolls = RIGID.ends(still, 0.07, coefficient=0.1)
    sliding, expected = RIGID.coordinates(sliding), RIGID.coordinates(expected)
    assert 0.04 < rolls < 0.06
    plain = one_ball(jv.FreeSpin(), jv.Sliding(0.1))
    start = jv.with_spin(plain, at(*START), "none")
    along = RIGID.slip(still) @ np.array([-np.sin(0.3), np.cos(0.3), 0.0])
    np.testing.assert_allclose(start.spin.slip[0], along, rtol=1e-12)
    np.testing.assert_allclose(start.spin.drilling, RIGID.coordinates(still)[-1], rtol=1e-12)

    def ends(until, width):
        s = one_ball(jv.FreeSpin(), jv.Sliding(0.1, width))
        steps = jv.EqualSteps(2000)
        return compared(jv.simulate(s, until, start=start, samples=2, stepsize_controller=steps, estimate=False))

    np.testing.assert_allclose(ends(0.03, 0.1), sliding, rtol=1e-8)
    errors = [np.max(np.abs(ends(0.07, width) / expected - 1.0)) for width in (0.1, 0.025)]
    # The law of Coulomb bends at no slip, over the width here: errors go with it.
    assert errors[1] < 1e-3 and errors[1] < 0.4 * errors[0]


def test_plane_track_ball_rolls_at_the_closed_form_speed():
    """f' grows by mu f'^2, the slip by kappa/(kappa-1) as much: it rolls at f0 + (w (1 + r/R) - f0) (kappa-1)/kappa."""
    machine = jv.one_mass(mass=1e12, stiffness=0.0, damping=0.0)
    loads = jv.rollers(count=1, mass=0.1, radius=0.2, drag=0.0, ball_radius=0.01)
    s = jv.Scene(machine, loads, jv.ConstantSpeed(60.0), (jv.Sliding(0.2, 0.05),))
    rest = jv.State(jnp.zeros(1), jnp.zeros(1), (jnp.zeros(1),), (jnp.full(1, 20.0),))
    start = jv.with_spin(s, rest, "none")
    np.testing.assert_allclose(start.spin.slip[0], 0.2 * 20.0 - 60.0 * 0.21)
    run = jv.simulate(s, 0.5, start=start, samples=200, stepsize_controller=jv.EqualSteps(3000), estimate=False)
    state, end = run.trajectory.state, 20.0 + (60.0 * 1.05 - 20.0) / 3.0
    np.testing.assert_allclose(state.rate[0][-1], end, rtol=1e-6)
    np.testing.assert_allclose(state.spin.slip[0][-1], 0.0, atol=1e-9)
    early = np.asarray(run.trajectory.time) < 0.5 * (1.0 / 20.0 - 1.0 / end) / 0.2
    np.testing.assert_allclose(state.rate[0][early, 0], 20.0 / (1.0 - 0.2 * 20.0 * run.trajectory.time[early]), rtol=1e-9)


def test_contact_rolls_exactly_below_the_limit_and_slides_above():
    s, firm = (scene((*published(), *more), count=1) for more in ((), (jv.Sliding(1e3),)))
    state = at(0.4, 1.1, 90.0, 20.0)
    found, expected = evaluate(firm, 0.1, jv.with_spin(firm, state)), evaluate(s, 0.1, state)
    for mine, theirs in zip((found.velocity, *found.rate), (expected.velocity, *expected.rate), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-10)
    scale = float(jnp.max(jnp.abs(found.rate[0]))) * RADIUS
    np.testing.assert_allclose(found.spin.slip, 0.0, atol=1e-10 * scale)
    # A load that does not press has no contact: a mass alone.
    inner = jv.with_spin(firm, at(0.0, -1.0, 130.0, 0.0))
    free = evaluate(firm, 0.0, inner)
    carried = float(free.velocity[0])
    fall = (RADIUS - GAP * np.sin(1.0)) * 130.0**2 * np.cos(1.0) + 9.81 * np.sin(1.0) - np.cos(1.0) * carried
    np.testing.assert_allclose(free.rate[1][0], fall / GAP, rtol=1e-9)


@pytest.mark.parametrize("effects", [BOTH, BOTH[:1], BOTH[1:], (jv.FreeSpin(), jv.Sliding(0.1, 1e3))])
def test_power_balances_the_energy_of_balls_that_spin_and_slide(effects):
    """The rotor moves, with all kinds of friction: sliding, and in the last case sticking while a slip ends."""
    s = scene((*published(1e-4), *effects), drag=0.2)

    @eqx.filter_jit
    def growth(t, state):
        change = jv.vector_field(s)(t, state)
        return jax.jvp(lambda t, y: energy(s, y, t), (t, state), (jnp.ones_like(t), change))[1], *power(s, t, state)

    rng = np.random.default_rng(2)
    for seed in range(3):
        start = jv.with_spin(s, some_state(seed))
        spin = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)) * 5.0, start.spin)
        state = jv.State(start.displacement, start.velocity, start.angle, start.rate, spin=spin)
        rate, supplied, lost = growth(jnp.asarray(0.7), state)
        np.testing.assert_allclose(rate, supplied - lost, rtol=1e-9, atol=1e-9 * abs(float(supplied)))


def test_power_balances_the_energy_of_sliding_on_a_turning_body():
    """The torque of the drive on its housing is that of the power."""
    springs = [jv.support(at=(x, -0.1), stiffness=(1e5, 2e5), damping=(50.0, 90.0)) for x in (-0.5, 1.0)]
    loads = jv.balls(count=2, mass=0.2, radius=0.1, drag=0.3, ball_radius=0.02)
    effects = (jv.Sliding(0.1), jv.RollingFriction(1e-3))
    exciter = jv.Exciter(loads, jv.ConstantSpeed(50.0), at=(0.1, 0.2), direction=-1, effects=effects)
    s = jv.Scene(jv.plane_body(mass=30.0, inertia=7.5, supports=springs), exciters=[exciter])
    leaves, structure = jax.tree.flatten(jv.initial_state(s))
    rng = np.random.default_rng(1)
    state = jax.tree.unflatten(structure, [jnp.asarray(2.0 * rng.normal(size=leaf.shape)) for leaf in leaves])

    @jax.jit
    def growth(state):
        return jax.jvp(lambda y: energy(s, y), (state,), (jv.vector_field(s)(0.0, state),))[1], *power(s, 0.0, state)

    rate, supplied, lost = growth(state)
    np.testing.assert_allclose(rate, supplied - lost, rtol=1e-9, atol=1e-9 * abs(float(supplied)))


def test_derivatives_with_spin_and_sliding_are_differences():
    """Along one direction in which every number of the scene and of the state changes."""
    s = scene((*published(), *BOTH), count=1)
    start = jv.with_spin(s, at(0.4, 1.1, 90.0, 20.0), "none")
    leaves, rest = jax.tree.flatten((s, start))
    rng = np.random.default_rng(0)
    sizes = [rng.normal(size=np.shape(leaf)) * np.maximum(np.abs(leaf), 1e-3) for leaf in leaves]

    @eqx.filter_jit
    def field(leaves):
        change = jv.vector_field(jax.tree.unflatten(rest, leaves)[0])(0.2, jax.tree.unflatten(rest, leaves)[1])
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves((change.velocity, change.rate, change.spin))])

    step, along = 1e-6, [jnp.asarray(size) for size in sizes]
    values, forward = jax.jvp(field, (leaves,), (along,))
    ahead, back = (field([leaf + sign * step * size for leaf, size in zip(leaves, along, strict=True)]) for sign in (1.0, -1.0))
    np.testing.assert_allclose(forward, (ahead - back) / (2.0 * step), rtol=1e-6, atol=1e-7 * float(jnp.max(jnp.abs(forward))))
    weight = jnp.asarray(rng.normal(size=values.shape)) / values
    (reverse,) = jax.vjp(field, leaves)[1](weight)
    total = sum(float(jnp.sum(x * size)) for x, size in zip(reverse, along, strict=True))
    np.testing.assert_allclose(total, float(weight @ forward), rtol=1e-9)


def test_scene_without_spin_has_no_state_of_it():
    def size(effects):
        s = scene((*published(), *effects))
        state = jv.with_spin(s, some_state())
        return len(jax.tree.leaves(state)), count_operations(lambda s, y: jv.vector_field(s)(0.0, y), s, state)

    (bare, plain), (one, spun), (more, slid) = size(()), size(BOTH[:1]), size(BOTH[1:])
    assert (bare, one, more) == (6, 7, 8)
    # What was counted when this was written, and a little to spare.
    assert plain <= 930 and 30 <= spun - plain <= 60 and slid - plain <= 1000


def test_they_go_through_files_named_starts_and_ensembles():
    s = scene((*published(), *BOTH))
    again = jv.scene_from_toml(jv.scene_to_toml(s))
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), s, again))
    rest = jv.initial_state(s)
    assert rest.spin.drilling.shape == (2,) and len(rest.spin.slip) == 2

    one = one_ball(*BOTH)

    def make(turn):
        return one, at(0.3, 0.8, turn, 30.0)

    steps = jv.EqualSteps(200)
    many = jv.ensemble(make, jnp.asarray([50.0, 60.0]), 0.03, stepsize_controller=steps, estimate=False)
    run = jv.simulate(one, 0.03, start=make(60.0)[1], stepsize_controller=steps, samples=2, estimate=False)
    np.testing.assert_allclose(many.state.spin.drilling[1], run.trajectory.state.spin.drilling[-1], rtol=1e-9)
    np.testing.assert_allclose(many.state.angle[1][1], run.trajectory.state.angle[1][-1], rtol=1e-9)


PLANE = jv.balls(count=1, mass=0.1, radius=0.2, drag=0.1, ball_radius=0.01)
POINTS = jv.balls(count=1, mass=0.1, radius=0.2, drag=0.1)


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda: jv.Sliding(0.0), "effects.sliding.coefficient is 0; it must be greater than 0"),
        (lambda: jv.Sliding(0.1, width=-1.0), "effects.sliding.width is -1 m/s; it must be greater than 0"),
        (
            lambda: jv.Scene(HEAVY, PLANE, jv.ConstantSpeed(1.0), (jv.FreeSpin(),)),
            "effects.free_spin needs balls in a torus; 'ball' have no drilling spin",
        ),
        (
            lambda: jv.Scene(
                HEAVY, jv.balls(count=1, mass=0.1, radius=0.2, drag=0.1), jv.ConstantSpeed(1.0), (jv.Sliding(0.1),)
            ),
            "effects.sliding needs loads that roll and have a ball_radius",
        ),
        (
            lambda: jv.Scene(HEAVY, balls(), jv.DCMotor(140.0, stall_torque=2.0, inertia=0.1), (jv.FreeSpin(),)),
            r"effects.free_spin needs a drive with prescribed speed \(property ideal\), not 'dc_motor'",
        ),
        (lambda: jv.with_spin(scene(BOTH), some_state(), "asleep"), "rotation is 'asleep'; it must be 'rolling' or 'none'"),
        (
            lambda: jv.simulate(scene(), 0.1, start=jv.with_spin(scene(BOTH), some_state())),
            "start.spin is given, but no effect of the scene allows it",
        ),
        (
            lambda: jv.simulate(scene(BOTH), 0.1, start=jv.with_spin(scene(BOTH[:1]), some_state())),
            "start.spin has shapes .* this scene needs",
        ),
        (lambda: jv.vector_field(scene(BOTH))(0.0, some_state()), r"state.spin has no .*; use with_spin\(scene, state\)"),
        (
            lambda: jv.jam_modes(jv.Scene(HEAVY, PLANE, jv.ConstantSpeed(1.0), (jv.Sliding(0.1),))),
            r"effects.sliding is not included in this function \(term SlipRelease\)",
        ),
    ],
)
def test_what_does_not_go_is_said(ask, says):
    with pytest.raises(jv.InputError, match=says):
        ask()


def test_sliding_balls_of_a_torus_move_alike_with_equal_steps():
    """Two coordinates of each ball, and a slip along each."""
    template = jv.scene_from_toml(TEMPLATES["torus"])
    s = jv.Scene(template.machine, template.loads, template.drive, (jv.Sliding(0.1),))
    chosen, equal = (
        jv.simulate(s, 0.05, stepsize_controller=steps, estimate=False, samples=64)
        for steps in (jv.Tolerance(1e-9), jv.EqualSteps(2000))
    )
    for ours, theirs in zip(jax.tree.leaves(chosen.trajectory), jax.tree.leaves(equal.trajectory), strict=True):
        np.testing.assert_allclose(ours[-1], theirs[-1], rtol=1e-6, atol=1e-9)
    assert len(chosen.trajectory.state.spin.slip) == 2
