"""Terms of effects: theories include the types that they state, and each type acts in the full equations."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import rates_at

import jaxvib as jv
from jaxvib.equations.averaged import averaged_loads
from jaxvib.equations.jammed_bodies import require_periodic_jams
from jaxvib.equations.linear import jammed_loads, turning_loads
from jaxvib.machine.effects.terms import (
    ContactFriction,
    DrillingSpinRelease,
    Friction,
    GravityField,
    LoadInteraction,
    LoadPotential,
    LoadResistance,
    RotorImbalance,
    SlipRelease,
    SupportForce,
)

TERMS = (
    GravityField(1, 9.81),
    LoadPotential(lambda loads, u: jnp.cos(u[0])),
    LoadResistance(lambda loads, u, rate: (-0.01 * rate[0],)),
    LoadInteraction(lambda loads, u: jnp.zeros_like(u[0])),
    RotorImbalance(0.01, 0.0),
    ContactFriction(lambda loads, u, rate, speed, g: Friction(jnp.tanh(speed - rate[0]), jnp.full_like(u[0], 1e-5), None)),
    DrillingSpinRelease(),
    SlipRelease(0.1, 0.2),
    SupportForce(lambda carrier: jnp.eye(2)[:1], lambda x: 0.5 * 3e3 * jnp.sum(x**2)),
)

THEORIES = {
    turning_loads: "GravityField LoadPotential LoadInteraction RotorImbalance",
    jammed_loads: "GravityField LoadPotential LoadInteraction RotorImbalance ContactFriction",
    require_periodic_jams: "GravityField LoadPotential LoadInteraction ContactFriction",
    averaged_loads: "GravityField LoadPotential",
    jv.criterion: "GravityField LoadInteraction RotorImbalance ContactFriction DrillingSpinRelease SlipRelease SupportForce",
}
"""Each theory with the terms that it includes."""


class Adding(jv.Effect):
    """Effect that adds one term."""

    term: Any = eqx.field(static=True)
    kind: ClassVar[str] = "adding"

    def terms(self):
        return (self.term,)


def scene(*terms, stiffness=4e4):
    machine = jv.two_mass(
        mass=(30.0, 20.0), stiffness=(stiffness, 3e4), damping=(9.0, 8.0), link_stiffness=2e4, link_damping=5.0
    )
    loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
    return jv.Scene(machine, loads, jv.ConstantSpeed(60.0), tuple(map(Adding, terms)))


def state():
    numbers = np.random.default_rng(1).normal(size=(4, 2))
    q, v, angle, rate = map(jnp.asarray, numbers)
    return jv.State(1e-2 * q, v, (angle,), (rate,))


@pytest.mark.parametrize("theory", THEORIES, ids=lambda theory: theory.__name__)
@pytest.mark.parametrize("term", TERMS, ids=lambda term: type(term).__name__)
def test_theory_includes_exactly_the_terms_it_states(theory, term):
    if type(term).__name__ in THEORIES[theory].split():
        theory(scene(term))
    else:
        with pytest.raises(jv.InputError, match=rf"effects\.adding .*\(term {type(term).__name__}\); leave it out"):
            theory(scene(term))


def test_refusal_names_every_effect_and_term():
    loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0, ball_radius=0.01)
    both = jv.Scene(scene().machine, loads, scene().drive, (jv.CubicSupport(1e9), jv.Sliding(0.1)))
    says = r"effects cubic_support and sliding are not included .*\(terms SupportForce and SlipRelease\); leave them out"
    with pytest.raises(jv.InputError, match=says):
        turning_loads(both)


@pytest.mark.parametrize("term", [TERMS[1], TERMS[2], TERMS[5], TERMS[8]], ids=lambda term: type(term).__name__)
def test_power_of_a_term_balances_the_energy(term):
    given = scene(term)
    change = rates_at(given, jnp.asarray(0.0), state())
    growth = jax.jvp(lambda y: jv.energy(given, y), (state(),), (change,))[1]
    supplied, lost = jv.power(given, jnp.asarray(0.0), state())
    np.testing.assert_allclose(growth, supplied - lost, rtol=1e-11)


def test_resistance_brakes_each_load_by_its_force():
    """A torque -c phi' on each load adds c phi'^2 to the dissipated power."""
    _, lost = jv.power(scene(TERMS[2]), jnp.asarray(0.0), state())
    _, without = jv.power(scene(), jnp.asarray(0.0), state())
    np.testing.assert_allclose(lost - without, 0.01 * jnp.sum(state().rate[0] ** 2), rtol=1e-9)


def test_linear_support_force_equals_a_stiffer_spring():
    added, stiffer = (rates_at(s, jnp.asarray(0.0), state()) for s in (scene(TERMS[8]), scene(stiffness=4.3e4)))
    np.testing.assert_allclose(added.velocity, stiffer.velocity, rtol=1e-12)
    np.testing.assert_allclose(added.rate[0], stiffer.rate[0], rtol=1e-12)


def test_gravity_field_without_a_normal_force_traces_nothing():
    bare, field = (jax.make_jaxpr(lambda y, s=s: jv.vector_field(s)(0.0, y))(state()) for s in (scene(), scene(TERMS[0])))
    assert str(bare) == str(field)
