"""Differentiable simulation and design of vibration machines that work on the Sommerfeld effect."""

from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.carrier import Carrier, Machine
from jaxvib.machine.dimensionless import Dimensionless
from jaxvib.machine.drive import ConstantSpeed, Drive, SpinUp
from jaxvib.machine.effects import Effect, Gravity
from jaxvib.machine.files import load_scene, save_scene, scene_from_toml, scene_to_toml
from jaxvib.machine.loads import CircularLoads, Loads, balls, pendulums, rollers
from jaxvib.machine.platforms import Platforms, network, one_mass, three_mass, two_mass
from jaxvib.machine.scene import Scene
from jaxvib.motion.dynamics import Dynamics, State, vector_field
from jaxvib.motion.observables import Measured, Trajectory, energy, foundation_force, power
from jaxvib.motion.run import Run, RunStatus
from jaxvib.motion.settle import settle
from jaxvib.motion.simulate import simulate
from jaxvib.motion.start import initial_state
from jaxvib.steady.balance import (
    BalancedStability,
    BalancedStates,
    BalanceStatus,
    balanced_growth,
    balanced_intervals,
    balanced_stability,
    balanced_states,
)
from jaxvib.steady.branches import Branches, branches
from jaxvib.steady.criterion import Criterion, CriterionStatus, criterion, criterion_functional, criterion_table
from jaxvib.steady.diagram import ExactBranches, SpecialPoint
from jaxvib.steady.jam import Folds, Jam, JamModes, JamStatus, jam_modes, jam_rotor_speed
from jaxvib.steady.orbit import Orbit, OrbitStatus, jam_orbit
from jaxvib.steady.response import natural_frequencies, steady_displacement
from jaxvib.steady.speeds import CharacteristicSpeeds, characteristic_speeds, port_receptance
from jaxvib.study.criterion_map import CriterionMap, criterion_map

__all__ = [
    "BalanceStatus",
    "BalancedStability",
    "BalancedStates",
    "Branches",
    "Carrier",
    "CharacteristicSpeeds",
    "CircularLoads",
    "ComputationError",
    "ConstantSpeed",
    "Criterion",
    "CriterionMap",
    "CriterionStatus",
    "Dimensionless",
    "Drive",
    "Dynamics",
    "Effect",
    "ExactBranches",
    "Folds",
    "Gravity",
    "InputError",
    "Jam",
    "JamModes",
    "JamStatus",
    "Loads",
    "Machine",
    "Measured",
    "Orbit",
    "OrbitStatus",
    "Platforms",
    "Run",
    "RunStatus",
    "Scene",
    "SpecialPoint",
    "SpinUp",
    "State",
    "Trajectory",
    "balanced_growth",
    "balanced_intervals",
    "balanced_stability",
    "balanced_states",
    "balls",
    "branches",
    "characteristic_speeds",
    "criterion",
    "criterion_functional",
    "criterion_map",
    "criterion_table",
    "energy",
    "foundation_force",
    "initial_state",
    "jam_modes",
    "jam_orbit",
    "jam_rotor_speed",
    "load_scene",
    "natural_frequencies",
    "network",
    "one_mass",
    "pendulums",
    "port_receptance",
    "power",
    "rollers",
    "save_scene",
    "scene_from_toml",
    "scene_to_toml",
    "settle",
    "simulate",
    "steady_displacement",
    "three_mass",
    "two_mass",
    "vector_field",
]
