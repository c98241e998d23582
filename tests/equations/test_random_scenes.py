"""Random scenes: what holds for every machine holds for those that nobody thought of."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree
from random_scenes import (
    NUMBERS,
    PLAIN,
    half_turn,
    in_units,
    mirrored,
    motor_driven,
    numbers_for,
    renumbered,
    state_in_units,
    states,
    two_platforms,
    varied,
)

import jaxvib as jv
from jaxvib.machine.effects.base import has_term
from jaxvib.machine.effects.terms import LoadInteraction
from jaxvib.motion.analysis.scaled_error import error_scale, natural_units, scaled_error

SCENES = {"two platforms": two_platforms(), "motor": motor_driven()}


@eqx.filter_jit
def look(scene, state, t):
    """Rates of change, what is left of the energy balance, and the size of its terms."""
    field = jv.vector_field(scene)(t, state)
    slopes, by_time = jax.grad(lambda y, t: jv.energy(scene, y, t), (0, 1))(state, t)
    terms = ravel_pytree(slopes)[0] * ravel_pytree(field)[0]
    supplied, lost = jv.power(scene, t, state)
    left = jnp.sum(terms) + by_time - (supplied - lost)
    return field, left, jnp.sum(jnp.abs(terms)) + jnp.abs(by_time) + jnp.abs(supplied) + jnp.abs(lost)


def close(found, right, within):
    """Two states' numbers agree, each part relative to its largest."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(right), strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=within * float(jnp.max(jnp.abs(b))) + 1e-300)


def holds(scene, state, units):
    """The energy balance, the exchange of loads, the half turn, other units: of the equations of motion at a state."""
    t = jnp.asarray(0.37)
    field, left, size = look(scene, state, t)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(field))
    assert abs(float(left)) < 1e-12 * float(size)
    n = scene.loads.count
    if not has_term(scene.all_effects, LoadInteraction):
        close(look(renumbered(scene, n), renumbered(state, n), t)[0], renumbered(field, n), 1e-10)
    close(look(mirrored(scene), half_turn(state), t)[0], half_turn(field, 0.0), 1e-9)
    length, mass, time = (10.0 ** float(x) for x in units)
    there = look(in_units(scene, length, mass, time), state_in_units(state, length, time), t * time)[0]
    close(there, state_in_units(field, length, time, order=1), 1e-9)


@pytest.mark.parametrize("name", SCENES)
def test_what_holds_for_every_state_of_every_machine(name):
    base = SCENES[name]

    @PLAIN
    @given(numbers_for(base), states(base), st.lists(st.floats(-4.0, 4.0), min_size=3, max_size=3))
    def run(numbers, state, units):
        holds(varied(base, numbers), state, units)

    run()


def test_smaller_steps_come_as_near_as_the_estimate_says():
    two = SCENES["two platforms"]
    base = jv.Scene(two.machine, two.loads, two.drive, tuple(two.all_effects[k] for k in (0, 3)))
    asked = dict(save="window", max_steps=2**15)

    @settings(PLAIN, max_examples=12)
    @given(numbers_for(base), states(base), st.floats(-9.0, -5.0))
    def run(numbers, state, digits):
        scene = varied(base, numbers, 1.5)
        best = jv.simulate(scene, 2.0, start=state, stepsize_controller=jv.Tolerance(1e-13), estimate=False, **asked)
        found = jv.simulate(scene, 2.0, start=state, stepsize_controller=jv.Tolerance(10.0**digits), **asked)
        right = best.window.state
        error = float(scaled_error(found.window.state, right, error_scale(right, natural_units(scene))))
        assert error <= float(found.error), (error, float(found.error))

    run()


def differences(function, flat, along, h):
    """Central differences of a function along a direction, extrapolated, and how much they change with the step."""
    coarse, fine = ((function(flat + k * along) - function(flat - k * along)) / (2.0 * k) for k in (2.0 * h, h))
    return (4.0 * fine - coarse) / 3.0, abs(fine - coarse)


@functools.cache
def derivatives():
    """Derivatives of jams and of a run of the two platforms by every number of the scene, in one program each."""
    two, loads = SCENES["two platforms"], jv.pendulums(count=2, mass=0.4, radius=0.1, drag=0.9, inertia=1e-3)
    base = jv.Scene(two.machine, loads, two.drive)
    restore = ravel_pytree(base)[1]
    start = jv.initial_state(base, separation=0.5)

    def jam(flat):
        return jv.jam_modes(restore(flat)).select(1, throw=False).foundation_force

    def run(flat):
        steps = jv.Tolerance(1e-12)
        found = jv.simulate(restore(flat), 1.0, start=start, save="window", max_steps=2048, stepsize_controller=steps)
        return jnp.sum(found.window.state.displacement[-1] * jnp.asarray([1e3, 2e3]))

    return base, {name: eqx.filter_jit(jax.value_and_grad(f)) for name, f in (("jam", jam), ("run", run))}


@pytest.mark.parametrize("quantity", ["jam", pytest.param("run", marks=pytest.mark.slow)])
def test_gradients_are_those_of_differences(quantity):
    base, functions = derivatives()
    function = functions[quantity]
    size = ravel_pytree(base)[0].size

    @settings(PLAIN, max_examples=10)
    @given(numbers_for(base), st.lists(NUMBERS, min_size=size, max_size=size))
    def run(numbers, direction):
        flat = ravel_pytree(varied(base, numbers, 1.5))[0]
        along = flat * jnp.asarray(direction)
        assume(float(jnp.max(jnp.abs(along))) > 0.0)
        value, slopes = function(flat)
        assume(np.isfinite(float(value)))  # a mode that these numbers have
        right, noise = differences(lambda x: float(function(x)[0]), flat, along, 1e-4)
        size = float(jnp.sum(jnp.abs(slopes * along)))
        assert abs(float(slopes @ along) - right) < 1e-6 * size + noise

    run()


@st.composite
def structures(draw):
    """Networks of one to four platforms with some links, loads of any kind and number, effects and drives drawn."""
    nd = draw(st.integers(1, 4))
    pairs = [(i, j) for i in range(1, nd + 1) for j in range(i + 1, nd + 1)]
    links = [pair for k, pair in enumerate(pairs) if k < nd - 1 or draw(st.booleans())]
    machine = jv.network(
        mass=[5.0 + k for k in range(nd)], stiffness=[1e4] * nd, damping=[9.0] * nd, links=links,
        link_stiffness=[5e3] * len(links), link_damping=[4.0] * len(links), exciter=draw(st.integers(1, nd)),
    )  # fmt: skip
    n = draw(st.integers(1, 4))
    masses = [0.2 + 0.1 * k for k in range(n)]
    kind = draw(st.sampled_from(["balls", "rollers", "pendulums"]))
    more = {"inertia": [1e-3] * n} if kind == "pendulums" else {}
    loads = getattr(jv, kind)(count=n, mass=masses, radius=0.1, drag=[0.9] * n, **more)
    effects = [jv.Gravity(), jv.StaticImbalance(0.02, angle=0.3), jv.CubicSupport(1e7), jv.Stop(2e4, gap=2e-3, damping=9.0)]
    effects += [jv.DryFriction(0.1, diameter=0.02, width=0.5)] if kind == "pendulums" else []
    drives = [jv.ConstantSpeed(40.0), jv.RunUp(40.0, acceleration=30.0), jv.DCMotor(40.0, stall_torque=4.0, inertia=0.05)]
    chosen = tuple(effect for effect in effects if draw(st.booleans()))
    return jv.Scene(machine, loads, draw(st.sampled_from(drives)), chosen)


@pytest.mark.slow
@settings(PLAIN, max_examples=60)
@given(st.data(), structures(), st.lists(st.floats(-4.0, 4.0), min_size=3, max_size=3))
def test_what_holds_for_every_structure(data, base, units):
    holds(varied(base, data.draw(numbers_for(base))), data.draw(states(base)), units)
