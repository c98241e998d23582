"""Random numbers for scenes, and what a scene and its state look like from elsewhere: mirrored, renumbered, in other units."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree

import jaxvib as jv

PLAIN = settings(
    derandomize=True, deadline=None, database=None, max_examples=25, suppress_health_check=[HealthCheck.filter_too_much]
)
"""The same examples at every run, however long one takes."""

NUMBERS = st.floats(-1.0, 1.0, width=32)

DIMENSIONS = {
    "mass": (0, 1, 0),
    "stiffness": (0, 1, -2),
    "link_stiffness": (0, 1, -2),
    "damping": (0, 1, -1),
    "link_damping": (0, 1, -1),
    "radius": (1, 0, 0),
    "ball_radius": (1, 0, 0),
    "drag": (0, 1, -1),
    "inertia": (2, 1, 0),
    "speed": (0, 0, -1),
    "stall_torque": (2, 1, -2),
    "acceleration": (0, 0, -2),
    "g": (1, 0, -2),
    "moment": (1, 1, 0),
    "angle": (0, 0, 0),
    "gap": (1, 0, 0),
    "coefficient": (0, 0, 0),
    "diameter": (1, 0, 0),
    "width": (0, 0, -1),
    "cubic_support.stiffness": (-2, 1, -2),
}
"""Powers of length, mass and time in the numbers of a scene, an effect's own ones where its kind is said."""


def two_platforms():
    """Unlike pendulums, every effect of single loads and of supports, a constant speed."""
    machine = jv.two_mass(mass=(8.0, 5.0), stiffness=(9e3, 4e3), damping=(9.0, 5.0), link_stiffness=8e3, link_damping=7.0)
    loads = jv.pendulums(count=2, mass=[0.3, 0.5], radius=[0.1, 0.12], drag=[0.9, 1.1], inertia=[1e-3, 2e-3])
    effects = (
        jv.Gravity(),
        jv.StaticImbalance(0.02, angle=0.3),
        jv.CubicSupport(1e7),
        jv.Stop(2e4, gap=2e-3, damping=9.0),
        jv.DryFriction(0.1, diameter=0.02, width=0.5),
    )
    return jv.Scene(machine, loads, jv.ConstantSpeed(40.0), effects)


def motor_driven():
    """Unlike balls in a planar rotor that a motor with a rotor of its own drives."""
    loads = jv.balls(count=2, mass=[0.3, 0.5], radius=0.1, drag=[0.9, 1.1])
    drive = jv.DCMotor(50.0, stall_torque=4.0, inertia=0.05)
    machine = jv.planar_rotor(mass=9.0, stiffness=2e4, damping=20.0)
    return jv.Scene(machine, loads, drive, (jv.Gravity(), jv.StaticImbalance(0.02, angle=0.3)))


def numbers_for(scene):
    """Random numbers from -1 to 1, as many as the scene has numbers."""
    size = ravel_pytree(scene)[0].size
    return st.lists(NUMBERS, min_size=size, max_size=size).map(np.asarray)


def varied(scene, numbers, most=3.0):
    """The scene whose numbers are those of the given one, each times or over up to `most`."""
    flat, restore = ravel_pytree(scene)
    return restore(flat * most ** jnp.asarray(numbers))


@st.composite
def states(draw, scene):
    """States of some millimetres, any angles, loads from backward to twice as fast as the rotor."""
    nd, n = scene.machine.structure().mass.shape[0], scene.loads.count
    several = lambda k: jnp.asarray(draw(st.lists(NUMBERS, min_size=k, max_size=k)))  # noqa: E731
    speed = float(scene.drive.speed)
    rotor = None
    if not scene.drive.ideal:
        rotor = tuple(several(2) * jnp.asarray([3.0, 0.5 * speed]) + jnp.asarray([0.0, speed]))
    q, v, phi, rate = several(nd), several(nd), several(n), several(n)
    return jv.State(4e-3 * q, 4e-3 * speed * v, (np.pi * phi,), (speed * (0.5 + 1.5 * rate),), rotor)


def renumbered(tree, count):
    """A scene's loads, or a state, with the loads counted from the other end."""
    if isinstance(tree, jv.State):
        return eqx.tree_at(lambda y: (y.angle, y.rate), tree, jax.tree.map(lambda x: x[::-1], (tree.angle, tree.rate)))
    loads = jax.tree.map(lambda x: x[::-1] if jnp.shape(x) == (count,) else x, tree.loads)
    return eqx.tree_at(lambda s: s.loads, tree, loads)


def mirrored(scene):
    """The scene turned by half a turn: what pulls down pulls up, what is out of balance is so on the other side."""

    def one(effect):
        if effect.kind == "gravity":
            return eqx.tree_at(lambda e: e.g, effect, -effect.g)
        return eqx.tree_at(lambda e: e.angle, effect, effect.angle + np.pi) if effect.kind == "static_imbalance" else effect

    return eqx.tree_at(lambda s: s.all_effects, scene, tuple(map(one, scene.all_effects)), is_leaf=lambda x: x is None)


def half_turn(state, angle=np.pi):
    """The state turned by half a turn, its loads' angles by `angle`: pi, or 0 for a rate of change."""
    return jv.State(-state.displacement, -state.velocity, tuple(x + angle for x in state.angle), state.rate, state.rotor)


def in_units(scene, length, mass, time):
    """The scene's numbers where the units of length, mass and time are so many times smaller."""

    def one(path, leaf):
        names = [getattr(step, "name", "") for step in path]
        holder = scene.exciters[0] if names[0] == "exciters" else scene
        owner = f"{holder.effects[path[names.index('effects') + 1].idx].kind}." if "effects" in names else ""
        powers = DIMENSIONS.get(owner + path[-1].name, DIMENSIONS.get(path[-1].name))
        return leaf * length ** powers[0] * mass ** powers[1] * time ** powers[2]

    return jax.tree_util.tree_map_with_path(one, scene)


def state_in_units(state, length, time, order=0):
    """A state there; `order` 1 for its rate of change."""
    s, v = length / time**order, 1.0 / time**order
    rotor = None if state.rotor is None else (state.rotor[0] * v, state.rotor[1] * v / time)
    angles, rates = tuple(x * v for x in state.angle), tuple(x * v / time for x in state.rate)
    return jv.State(state.displacement * s, state.velocity * s / time, angles, rates, rotor)
