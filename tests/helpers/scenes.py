"""Platforms, loads on a circle, and states of scenes with them, which many tests share."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxvib as jv
from jaxvib.equations.jammed_bodies import jammed_bodies
from jaxvib.equations.linear import jammed_model
from jaxvib.steady.jams.folds import rotor_speed_at

TWO_MASS = dict(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0)
BALLS = dict(count=3, mass=0.8, radius=0.12, drag=1.5)
ROTOR = dict(
    mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, stiffness=(6e5, 5e5), damping=400.0, position=(0.165, -0.155)
)


def machines():
    return {
        "one_mass": jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
        "two_mass": jv.two_mass(
            mass=(120.0, 95.0), stiffness=(5e4, 3e4), damping=(40.0, 20.0), link_stiffness=2e5, link_damping=60.0
        ),
        "three_mass": jv.three_mass(
            mass=(30.0, 40.0, 20.0),
            stiffness=(1e4, 4e4, 3e3),
            damping=(10.0, 20.0, 5.0),
            link_stiffness=(1e4, 5e3, 2e4),
            link_damping=(5.0, 1.0, 7.0),
            exciter=3,
        ),
        "network": jv.network(
            mass=[5.0, 6.0, 7.0, 8.0, 9.0],
            stiffness=[1e4, 0.0, 0.0, 2e4, 1e3],
            damping=[5.0, 0.0, 0.0, 5.0, 1.0],
            links=[(1, 2), (2, 3), (3, 4), (4, 5), (5, 1), (2, 4)],
            link_stiffness=[2e4, 1e4, 3e4, 2e4, 1e4, 5e3],
            link_damping=[4.0, 3.0, 2.0, 1.0, 0.0, 2.0],
            exciter=2,
        ),
    }


def loads():
    return {
        "balls": jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5),
        "rollers": jv.rollers(count=1, mass=0.5, radius=0.1, drag=0.7),
        "pendulums": jv.pendulums(count=4, mass=[0.5, 0.6, 0.7, 0.8], radius=0.1, drag=[0.7, 0.8, 0.9, 1.0], inertia=1e-3),
    }


def scene(machine="two_mass", load="balls", speed=120.0, effects=()):
    return jv.Scene(machines()[machine], loads()[load], jv.ConstantSpeed(speed), effects)


def turning_body(size=1.0):
    """A body whose motion in units of `size` does not depend on the size; sqrt(inertia / mass) is 0.3 size."""
    springs = [jv.support(at=(x * size, 0.0), stiffness=(4e4, 6e4), damping=(60.0, 80.0)) for x in (-0.5, 0.4)]
    machine = jv.plane_body(mass=100.0, inertia=9.0 * size**2, supports=springs)
    return jv.Scene(machine, jv.balls(count=1, mass=0.4, radius=0.1 * size, drag=1.0), jv.ConstantSpeed(60.0))


def published(speed=3.0, eps=1e-3, damping=0.01, count=1, form="antiphase", **more):
    """The machine of the antiphase paper, equation (40); `damping` of all, or of both supports with `link_damping`."""
    pair = np.broadcast_to(damping, 2).tolist()
    numbers = dict(natural=(1 / 3, 1 / 3), damping=pair, link_natural=2 / 3, link_damping=damping, rho=1.0)
    return jv.Dimensionless(form, **{**numbers, "eps": eps, "beta": 1.0, "speed": speed, "count": count, **more})


def some_state(s):
    n, nd = s.loads.count, s.machine.carrier().mass.shape[0]
    rng = np.random.default_rng(0)
    draw = [jnp.asarray(rng.normal(size=k)) for k in (nd, nd, n, n)]
    return jv.State(draw[0], draw[1], (draw[2],), (30.0 + draw[3],))


@eqx.filter_jit
def rates_at(scene, t, state):
    """Rates of change of a state, from one program: operation by operation each of some hundred is compiled."""
    return jv.vector_field(scene)(t, state)


def assembled(scene):
    """The scene's carrier with its coincident loads, as exact jams take it."""
    return jammed_bodies(jammed_model(scene))


@eqx.filter_jit
def jam_rotor_speed(scene, omega):
    return rotor_speed_at(jammed_model(scene), omega)


@eqx.filter_jit
def steady_displacement(scene, omega):
    return jammed_model(scene).displacement(omega)
