"""Parts of a user's file whose methods return wrong values are refused when the scene is created."""

import equinox as eqx
import jax.numpy as jnp
import pytest
from jax import Array
from plugins.drive import Turbine
from plugins.load import TorusPoints
from plugins.machine import Beam

import jaxvib as jv
from jaxvib.machine.effects.terms import LoadResistance

MACHINE = Beam("100 kg", 12.0, ["40 N/mm", 4e4], [-0.5, "500 mm"], 0.0)
DRIVE = Turbine(160.0, 3.0, 0.02)
LOADS = TorusPoints(0.4, 0.08, 0.02, 0.9, 2)


class Brake(jv.Effect):
    """The torque - c phi' on each load."""

    drag: Array
    kind: str = eqx.field(static=True, default="brake", kw_only=True)

    def terms(self):
        return (LoadResistance(self.force),)

    def force(self, loads, u, rate):
        return -self.drag * rate[0], jnp.zeros_like(rate[1])


class Steady(jv.IdealDrive):
    """A constant speed."""

    speed: Array
    kind: str = eqx.field(static=True, default="steady", kw_only=True)

    def speed_at(self, t):
        return self.speed

    def angle_at(self, t):
        return self.speed * t

    def acceleration_at(self, t):
        return 0.0


def with_method(part, name, function):
    """The part, of a subclass in which a method is replaced."""
    own = type(type(part).__name__, (type(part),), {name: function})
    changed = object.__new__(own)
    for field, value in vars(part).items():
        object.__setattr__(changed, field, value)
    return changed


def scene(machine=MACHINE, loads=LOADS, drive=DRIVE, effects=()):
    return jv.Scene(machine, loads, drive, effects)


def carrier(**changes):
    own = with_method(MACHINE, "carrier", lambda self: eqx.tree_at(at, Beam.carrier(self), value))
    ((name, value),) = changes.items()

    def at(carrier):
        return getattr(carrier, name)

    return dict(machine=own)


def mount(*rows, axes):
    return dict(machine=with_method(MACHINE, "mount", lambda self, at=None: jv.Mount(rows=rows, axes=axes)))


def loads(**method):
    ((name, value),) = method.items()
    return dict(loads=with_method(LOADS, name, value))


BRAKE, STEADY = Brake(drag=jnp.asarray(1e-3)), Steady(speed=jnp.asarray(60.0))
WRONG = {
    "a vector for a matrix": (carrier(stiffness=jnp.ones(2)), r"machine.carrier returns stiffness: .*shape \(2,\).* \(2, 2\)"),
    "the mass of a point": (carrier(mass=jnp.ones((1, 1))), r"machine.carrier returns mass: .*shape \(1, 1\).* \(2, 2\)"),
    "an asymmetric mass": (
        carrier(mass=jnp.asarray([[100.0, 1.0], [0.0, 12.0]])),
        r"machine.carrier\(\).mass is not symmetric",
    ),
    "a negative mass": (carrier(mass=jnp.diag(jnp.asarray([100.0, -1.0]))), "mass has the eigenvalue -1; all must be greater"),
    "three directions": (carrier(foundation_damping=jnp.ones((3, 2))), r"returns foundation_damping: .*\(1, 2\) or \(2, 2\)"),
    "no carrier": (dict(machine=with_method(MACHINE, "carrier", lambda self: None)), "machine.carrier returns None; a Carrier"),
    "rows and axes": (mount(jnp.ones((1, 2)), axes=(0, 1)), r"machine.mount returns rows: .*shape \(1, 2\).* \(2, 2\)"),
    "rows and coordinates": (mount(jnp.ones((1, 3)), axes=(1,)), r"machine.mount returns rows: .*\(1, 3\).* \(1, 2\)"),
    "another axis": (mount(jnp.ones((1, 2)), axes=(2,)), r"machine.mount returns the axes \(2,\); .*0 horizontal, 1 up"),
    "a rest without a tuple": (loads(rest=lambda self: jnp.ones(2)), r"loads.rest returns an array of shape \(2,\); a tuple"),
    "one rest for all": (loads(rest=lambda self: (jnp.ones(()), jnp.ones(2))), r"loads.rest .*shape \(\); the shape \(2,\)"),
    "an array as position": (
        loads(position=lambda self, *u: u[0]),
        "loads.position .* a tuple of 2 or 3 coordinates is needed",
    ),
    "a position on a line": (
        loads(position=lambda self, *u: (u[0],)),
        "loads.position returns a tuple of 1; a tuple of 2 or 3 coordinates is needed",
    ),
    "too few forces": (
        loads(resistance=lambda self, u, rate, speed: (rate[0],)),
        "loads.resistance .* a tuple of 2, one force",
    ),
    "a matrix of inertias": (loads(inertia_factor=lambda self: jnp.ones((2, 2))), r"loads.inertia_factor returns .*\(2, 2\)"),
    "an unknown term": (
        dict(effects=with_method(BRAKE, "terms", lambda self: (1.0,))),
        "effects.brake.terms returns 1.0; terms",
    ),
    "a term without a tuple": (
        dict(effects=with_method(BRAKE, "terms", lambda self: LoadResistance(self.force))),
        "effects.brake.terms returns LoadResistance.*; a tuple of terms is needed",
    ),
    "one force for two coordinates": (
        dict(effects=with_method(BRAKE, "force", lambda self, loads, u, rate: (rate[0],))),
        "effects.brake.resistance returns a tuple of 1; a tuple of 2, one force for each coordinate, is needed",
    ),
    "a list of torques": (dict(drive=with_method(DRIVE, "torque", lambda self, speed: jnp.ones(2))), r"drive.torque .*\(2,\)"),
    "no acceleration": (
        dict(drive=with_method(STEADY, "acceleration_at", lambda self, t: None)),
        "drive.acceleration_at .*None",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_shape_of_a_part_is_named(name):
    parts, says = WRONG[name]
    with pytest.raises(jv.InputError, match=says):
        scene(**parts)


def test_plain_numbers_and_lists_of_terms_are_allowed():
    effects = with_method(BRAKE, "terms", lambda self: [LoadResistance(self.force)])
    own = scene(loads=with_method(LOADS, "inertia_factor", lambda self: 1.0), drive=STEADY, effects=effects)
    assert scene(effects=with_method(BRAKE, "terms", lambda self: ())).exciters[0].effects[0].terms() == ()
    assert own.drive.acceleration_at(0.0) == 0.0 and own.loads.inertia_factor() == 1.0
