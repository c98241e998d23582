"""Scenes of rotors, one of every drive, imbalance and effect, and a state of each."""

import jax.numpy as jnp
import numpy as np

import jaxvib as jv

STATIONS = (0.28, 0.25, -0.25, -0.28)


MASS, ECCENTRICITY, LEAN, GAMMA = 37.0, 2.2e-4, 3e-4, 0.7


def machine(stations=STATIONS, **change):
    numbers = dict(
        mass=MASS,
        transverse_inertia=0.479,
        polar_inertia=0.093,
        stiffness=(0.604e6, 0.555e6),
        damping=(430.0, 410.0),
        position=(0.165, -0.155),
        stations=stations,
    )
    return jv.rotor(**(numbers | change))


def pendulums(count=4, drag=0.2, mass=0.05):
    return jv.pendulums(count=count, mass=mass, radius=0.08, drag=drag, inertia=2e-5)


DRIVES = {
    "constant": lambda: jv.ConstantSpeed(460.0),
    "spin_up": lambda: jv.SpinUp(460.0, duration=2.0),
    "run_up": lambda: jv.RunUp(460.0, acceleration=230.0),
    "dc": lambda: jv.DCMotor(460.0, stall_torque=3.0, inertia=0.02),
    "induction": lambda: jv.InductionMotor(460.0, breakdown_torque=3.0, breakdown_slip=0.3, inertia=0.02),
}


IMBALANCE = (jv.Gravity(), jv.StaticImbalance(MASS * ECCENTRICITY), jv.MomentImbalance((0.479 - 0.093) * LEAN, angle=-GAMMA))


def rotor_state(s, seed=0):
    """A random state; loads in the order of their track, two of them pressed together, the rotor off its rest position."""
    rng = np.random.default_rng(seed)
    nd, n = s.machine.carrier().mass.shape[0], s.loads.count
    angle = np.sort(rng.uniform(-1.0, 3.0, n))
    angle[1:2] = angle[0] + 0.2
    moving = isinstance(s.drive, jv.Motor)
    return jv.State(
        jnp.asarray(rng.normal(size=nd) * 2e-3),
        jnp.asarray(rng.normal(size=nd)),
        (jnp.asarray(np.sort(angle)),),
        (jnp.asarray(rng.normal(size=n) * 100.0 + 100.0),),
        (jnp.asarray(rng.normal()), jnp.asarray(150.0)) if moving else None,
    )


CASES = {
    "stations": lambda: (machine(), "constant", ()),
    "one station": lambda: (machine(0.1), "constant", IMBALANCE),
    "imbalance, constant": lambda: (machine(), "constant", IMBALANCE),
    "imbalance, spin-up": lambda: (machine(), "spin_up", IMBALANCE),
    "imbalance, run-up": lambda: (machine(), "run_up", IMBALANCE),
    "imbalance, dc": lambda: (machine(), "dc", IMBALANCE),
    "imbalance, induction, one station": lambda: (machine(-0.2), "induction", IMBALANCE),
    "planar, dc": lambda: (jv.planar_rotor(mass=MASS, stiffness=1.1e6, damping=800.0), "dc", IMBALANCE[:2]),
    "friction, exact": lambda: (machine(), "run_up", (*IMBALANCE, jv.DryFriction(0.15, diameter=0.02, width=20.0))),
    "friction, exact, dc": lambda: (machine(), "dc", (*IMBALANCE, jv.DryFriction(0.15, diameter=0.02, width=20.0))),
    "friction, run-up": lambda: (machine(), "run_up", (jv.DryFriction(0.15, diameter=0.02, reaction="run_up"),)),
    "friction, steady, dc": lambda: (machine(), "dc", (jv.DryFriction(0.15, diameter=0.02, reaction="steady"),)),
    "supports": lambda: (
        machine(),
        "dc",
        (
            jv.CubicSupport(3e11, position=0.165),
            jv.Stop(4e6, gap=5e-4, damping=900.0, position=-0.155),
            jv.CubicSupport(1e11, position=-0.1),
            jv.FrictionSupport(3e3, width=0.3, position=-0.155),
        ),
    ),
    "platforms": lambda: (
        jv.two_mass(mass=(20.0, 15.0), stiffness=(1e4, 2e4), damping=(5.0, 6.0), link_stiffness=3e4, link_damping=7.0),
        "induction",
        (
            jv.Gravity(),
            jv.StaticImbalance(0.02, angle=0.4),
            jv.CubicSupport(2e9, platform=1),
            jv.Stop(1e6, gap=1e-4, damping=500.0, side="above", platform=2),
            jv.Stop(2e6, gap=2e-4, damping=300.0, side="below", platform=1),
            jv.FrictionSupport(500.0, width=0.1, platform=2),
            jv.FrictionSupport(900.0, width=0.2, platform=1, to=2),
        ),
    ),
    "contact": lambda: (machine(0.0), "dc", (jv.Gravity(), jv.LoadContact(stiffness=1e5, damping=20.0))),
}


def case(name):
    carried, drive, effects = CASES[name]()
    loads = pendulums()
    if name == "contact":
        loads = jv.balls(count=4, mass=0.05, radius=0.08, drag=0.2, ball_radius=0.015)
    return jv.Scene(carried, loads, DRIVES[drive](), effects)
