"""Differentiable simulation and design of vibration machines that work on the Sommerfeld effect."""

from jaxvib.backend import prepare_cpu
from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.carrier import Carrier, Machine
from jaxvib.machine.contact import LoadContact
from jaxvib.machine.dimensionless import Dimensionless
from jaxvib.machine.drive import ConstantSpeed, DCMotor, Drive, IdealDrive, InductionMotor, Motor, RunUp, SpinUp
from jaxvib.machine.effects import Effect, Friction, Gravity, MomentImbalance, StaticImbalance, Throw
from jaxvib.machine.files import load_scene, save_scene, scene_from_toml, scene_to_toml
from jaxvib.machine.friction import DryFriction
from jaxvib.machine.loads import CircularLoads, Loads, balls, pendulums, rollers
from jaxvib.machine.platforms import Platforms, network, one_mass, three_mass, two_mass
from jaxvib.machine.rotor import PlanarRotor, Rotor, planar_rotor, rotor
from jaxvib.machine.scene import Scene
from jaxvib.machine.supports import CubicSupport, Stop
from jaxvib.motion.dynamics import Dynamics, State, vector_field
from jaxvib.motion.ensemble import Ensemble, ensemble
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
from jaxvib.study.accuracy import Cost, CostRow, accuracy
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
    "Cost",
    "CostRow",
    "Criterion",
    "CriterionMap",
    "CriterionStatus",
    "CubicSupport",
    "DCMotor",
    "Dimensionless",
    "Drive",
    "DryFriction",
    "Dynamics",
    "Effect",
    "Ensemble",
    "ExactBranches",
    "Folds",
    "Friction",
    "Gravity",
    "IdealDrive",
    "InductionMotor",
    "InputError",
    "Jam",
    "JamModes",
    "JamStatus",
    "LoadContact",
    "Loads",
    "Machine",
    "Measured",
    "MomentImbalance",
    "Motor",
    "Orbit",
    "OrbitStatus",
    "PlanarRotor",
    "Platforms",
    "Rotor",
    "Run",
    "RunStatus",
    "RunUp",
    "Scene",
    "SpecialPoint",
    "SpinUp",
    "State",
    "StaticImbalance",
    "Stop",
    "Throw",
    "Trajectory",
    "accuracy",
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
    "ensemble",
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
    "planar_rotor",
    "port_receptance",
    "power",
    "prepare_cpu",
    "rollers",
    "rotor",
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
