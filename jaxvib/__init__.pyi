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
from jaxvib.motion.averaged import Amplitudes, Averaged, averaged_field
from jaxvib.motion.dynamics import Dynamics, State, vector_field
from jaxvib.motion.ensemble import Ensemble, ensemble
from jaxvib.motion.envelope import envelope
from jaxvib.motion.envelopes import Envelope, Envelopes, EnvelopeStatus
from jaxvib.motion.observables import Measured, Trajectory, energy, foundation_force, power
from jaxvib.motion.regime import PhasePattern, Regime, RegimeName, phase_pattern, regime
from jaxvib.motion.run import Run, RunStatus
from jaxvib.motion.settle import settle
from jaxvib.motion.simulate import simulate
from jaxvib.motion.start import initial_state
from jaxvib.motion.swing import BearingPendulum, Swing, SwingStatus, swing
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
from jaxvib.steady.folds import Folds, jam_rotor_speed
from jaxvib.steady.jam import Jam, JamModes, JamStatus, jam_modes
from jaxvib.steady.jam_orbit import jam_orbit
from jaxvib.steady.orbit import Orbit, OrbitStatus
from jaxvib.steady.phase_search import PhaseBranch, PhaseJams, phase_branch, phase_jams
from jaxvib.steady.phases import PhaseJam, PhaseStatus, phase_jam, phase_torques
from jaxvib.steady.response import natural_frequencies, steady_displacement
from jaxvib.steady.speeds import CharacteristicSpeeds, characteristic_speeds, port_receptance
from jaxvib.steady.whirl import CriticalSpeeds, Whirl, critical_speeds, whirl
from jaxvib.study.accuracy import accuracy
from jaxvib.study.cost import Cost, CostRow, cost_figure
from jaxvib.study.criterion_map import CriterionMap, criterion_map
from jaxvib.study.decrement import Decrement, Estimate, TurningPoints, ten_periods, turning_points
from jaxvib.study.harmonics import HarmonicConvergence, harmonic_convergence
from jaxvib.study.identify import Identified, IdentifyStatus, identify
from jaxvib.study.onset import StabilityMap, onset, stability_map
from jaxvib.study.record import Record, read_record
from jaxvib.study.run_ups import RunUps, run_ups
from jaxvib.study.tiers import Tiers, compare_tiers

__all__ = [
    "Amplitudes",
    "Averaged",
    "BalanceStatus",
    "BalancedStability",
    "BalancedStates",
    "BearingPendulum",
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
    "CriticalSpeeds",
    "CubicSupport",
    "DCMotor",
    "Decrement",
    "Dimensionless",
    "Drive",
    "DryFriction",
    "Dynamics",
    "Effect",
    "Ensemble",
    "Envelope",
    "EnvelopeStatus",
    "Envelopes",
    "Estimate",
    "ExactBranches",
    "Folds",
    "Friction",
    "Gravity",
    "HarmonicConvergence",
    "IdealDrive",
    "Identified",
    "IdentifyStatus",
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
    "PhaseBranch",
    "PhaseJam",
    "PhaseJams",
    "PhasePattern",
    "PhaseStatus",
    "PlanarRotor",
    "Platforms",
    "Record",
    "Regime",
    "RegimeName",
    "Rotor",
    "Run",
    "RunStatus",
    "RunUp",
    "RunUps",
    "Scene",
    "SpecialPoint",
    "SpinUp",
    "StabilityMap",
    "State",
    "StaticImbalance",
    "Stop",
    "Swing",
    "SwingStatus",
    "Throw",
    "Tiers",
    "Trajectory",
    "TurningPoints",
    "Whirl",
    "accuracy",
    "averaged_field",
    "balanced_growth",
    "balanced_intervals",
    "balanced_stability",
    "balanced_states",
    "balls",
    "branches",
    "characteristic_speeds",
    "compare_tiers",
    "cost_figure",
    "criterion",
    "criterion_functional",
    "criterion_map",
    "criterion_table",
    "critical_speeds",
    "energy",
    "ensemble",
    "envelope",
    "foundation_force",
    "harmonic_convergence",
    "identify",
    "initial_state",
    "jam_modes",
    "jam_orbit",
    "jam_rotor_speed",
    "load_scene",
    "natural_frequencies",
    "network",
    "one_mass",
    "onset",
    "pendulums",
    "phase_branch",
    "phase_jam",
    "phase_jams",
    "phase_pattern",
    "phase_torques",
    "planar_rotor",
    "port_receptance",
    "power",
    "prepare_cpu",
    "read_record",
    "regime",
    "rollers",
    "rotor",
    "run_ups",
    "save_scene",
    "scene_from_toml",
    "scene_to_toml",
    "settle",
    "simulate",
    "stability_map",
    "steady_displacement",
    "swing",
    "ten_periods",
    "three_mass",
    "turning_points",
    "two_mass",
    "vector_field",
    "whirl",
]
