"""A scene as it is integrated: on single numbers or on arrays, with angles kept within a turn."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rotors import case, rotor_state
from scenes import loads, machines, scene, some_state

import jaxvib as jv
from jaxvib.motion.integrate import frequency_bounds
from jaxvib.motion.integration.system import PackedSystem
from jaxvib.ode.dopri8 import UnrolledDopri8
from jaxvib.ode.dopri8_loop import LoopDopri8


@pytest.mark.parametrize("machine", ["one_mass", "two_mass", "three_mass"])
@pytest.mark.parametrize("load", sorted(loads()))
@pytest.mark.parametrize("effects", [(), (jv.Gravity(),)])
@pytest.mark.parametrize("batch", [False, True])
def test_packed_equations_agree_with_the_vector_field(machine, load, effects, batch):
    """Numbers in a batch, and arrays if one run has several loads."""
    s = jv.Scene(machines()[machine], loads()[load], jv.ConstantSpeed(120.0), effects)
    state, field = some_state(s), jv.vector_field(s)
    motion = PackedSystem(field, state, batch=batch)
    assert motion.is_scalarized is (batch or s.loads.count < 4)
    rates = motion.term.vf(jnp.asarray(0.3), motion.pack(state), motion.args)
    ours = motion.unpack(jax.tree.map(lambda x: x[None], rates))
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(field(jnp.asarray(0.3), state)), strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-12, atol=1e-12 * np.max(np.abs(b)))


@pytest.mark.parametrize(("count", "engine"), [(3, "scalar"), (4, "array")])
def test_runs_name_the_engine_that_integrated_them(count, engine):
    s = jv.Scene(machines()["two_mass"], jv.balls(count=count, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed(120.0))
    assert eqx.filter_eval_shape(lambda s: jv.simulate(s, 1.0, save="window"), s).engine == engine


@pytest.mark.parametrize("name", ["imbalance, spin-up", "imbalance, dc", "supports", "friction, run-up", "contact"])
def test_equations_are_the_same_on_numbers(name):
    """The equations as they are integrated."""
    s = case(name)
    state, t = rotor_state(s, 5), jnp.asarray(0.7)
    motion = PackedSystem(jv.vector_field(s), state, batch=True)
    assert motion.is_scalarized
    rates = motion.term.vf(t, motion.pack(state), motion.args)
    ours = motion.unpack(jax.tree.map(lambda x: x[None], rates))
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(jv.vector_field(s)(t, state)), strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-11, atol=1e-12 * np.max(np.abs(b)))


def test_equations_of_many_operations_stay_on_arrays():
    s = case("friction, exact, dc")
    state = rotor_state(s, 5)
    motion, t = PackedSystem(jv.vector_field(s), state, batch=True), jnp.asarray(0.7)
    assert not motion.is_scalarized
    ours = motion.unpack(motion.term.vf(t, motion.pack(state), motion.args)[None])
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(jv.vector_field(s)(t, state)), strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-13)  # sines are polynomials


@pytest.mark.parametrize("name", ["friction, exact, dc", "imbalance, dc", "contact"])
@pytest.mark.parametrize("batch", [False, True])
def test_a_packed_state_is_unpacked_unchanged(name, batch):
    """Both from a vector and from a tuple of numbers, with wrapped angles and without."""
    state = rotor_state(case(name), 5)
    for wrapped in (False, True):
        motion = PackedSystem(jv.vector_field(case(name)), state, wrapped=wrapped, batch=batch)
        assert motion.is_on_scalars == (batch and motion.is_scalarized)
        back = motion.unpack(jax.tree.map(lambda x: x[None], motion.pack(state)))
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b), back, state)


@pytest.mark.parametrize(("machine", "batch"), [("one_mass", True), ("one_mass", False), ("two_mass", False)])
def test_wrapping_counts_every_turn(machine, batch):
    """Both for numbers held one by one and for a vector."""
    s = scene(machine, "balls")
    state = eqx.tree_at(lambda y: y.angle, some_state(s), (jnp.asarray([7.0, -20.0, 1.0]),))
    for has_common_turns in (False, True):
        motion = PackedSystem(jv.vector_field(s), state, wrapped=True, has_common_turns=has_common_turns, batch=batch)
        assert motion.is_on_scalars == batch
        method = motion.method()
        assert isinstance(method, (LoopDopri8, UnrolledDopri8)) and method.wrap is not None
        held = method.wrap(motion.pack(state))
        inside = np.asarray(motion.state(jax.tree.map(lambda x: x[None], held[0])).angle[0][0])
        if has_common_turns:
            # All by the turns of the first.
            np.testing.assert_allclose(np.diff(inside), np.diff(state.angle[0]), rtol=1e-14)
            assert abs(inside[0]) <= np.pi
        else:
            assert np.max(np.abs(inside)) <= np.pi
        back = motion.unpack(jax.tree.map(lambda *x: jnp.stack(x), motion.pack(state), held))
        np.testing.assert_allclose(back.angle[0], np.stack(2 * [state.angle[0]]), rtol=1e-14)
        alone = motion.unpack(jax.tree.map(lambda x: x[None], held))
        np.testing.assert_allclose(np.sin(alone.angle[0][0]), np.sin(state.angle[0]), atol=1e-13)


def test_turns_of_the_azimuth_leave_the_other_angle():
    """Loads in contact share their turns in each coordinate; the angle in the cross-section of a torus has turns of its own."""
    tube = jv.torus_balls(count=2, mass=0.05, radius=0.2, tube=0.02, ball_radius=0.015)
    s = jv.Scene(jv.planar_rotor(mass=7.0, stiffness=1e3, damping=9.0), tube, jv.ConstantSpeed(140.0))
    angle = jnp.asarray([700.0, 701.0]), jnp.asarray([1.4, 1.6])
    state = jv.State(jnp.zeros(2), jnp.zeros(2), angle, (jnp.zeros(2), jnp.zeros(2)))
    motion = PackedSystem(jv.vector_field(s), state, wrapped=True, has_common_turns=True)
    wrap = motion.method().wrap
    assert wrap is not None
    held = motion.state(wrap(motion.pack(state))[0])
    np.testing.assert_allclose(np.diff(held.angle[0]), 1.0, rtol=1e-12)
    np.testing.assert_array_equal(held.angle[1], angle[1])


def test_the_fastest_and_the_slowest_of_rotor_and_resonances():
    """One mass: its natural frequency is sqrt(k / (M + sum m_j))."""
    machine, balls = jv.one_mass(mass=49.0, stiffness=4e4, damping=30.0), jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
    resonance = np.sqrt(4e4 / 50.0)
    for speed in (10.0, 100.0):
        found = frequency_bounds(jv.Scene(machine, balls, jv.ConstantSpeed(speed)))
        np.testing.assert_allclose(found, (max(speed, resonance), resonance), rtol=1e-12)
    machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 3e4), damping=(40.0, 20.0), link_stiffness=2e5, link_damping=60.0)
    two = jv.Scene(machine, balls, jv.ConstantSpeed(30.0))
    np.testing.assert_allclose(frequency_bounds(two), (jv.natural_frequencies(two)[1], jv.natural_frequencies(two)[0]))


def test_stages_are_reused_only_without_reverse_derivatives():
    s = scene("two_mass", "balls")
    motion = PackedSystem(jv.vector_field(s), some_state(s))
    adjoints = (None, diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint())
    assert motion.size > 8 and [motion.method(adjoint).reuse for adjoint in adjoints] == [True, True, False]
