"""Differentiable simulation and design of vibration machines that work on the Sommerfeld effect."""

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.carrier import Carrier, Machine
from jaxvib.machine.dimensionless import Dimensionless
from jaxvib.machine.drive import ConstantSpeed, Drive, SpinUp
from jaxvib.machine.effects import Effect, Gravity
from jaxvib.machine.loads import CircularLoads, Loads, balls, pendulums, rollers
from jaxvib.machine.platforms import Platforms, network, one_mass, three_mass, two_mass
from jaxvib.machine.scene import Scene
from jaxvib.motion.dynamics import Dynamics, State, vector_field
from jaxvib.steady.diagram import ExactBranches, SpecialPoint, exact_branches
from jaxvib.steady.jam import Folds, Jam, JamModes, JamStatus, jam_modes, jam_rotor_speed
from jaxvib.steady.orbit import Orbit, OrbitStatus, jam_orbit
from jaxvib.steady.response import natural_frequencies, steady_displacement
