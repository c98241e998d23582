"""Differentiable simulation and design of vibration machines that work on the Sommerfeld effect."""

from jaxvib.equations.averaged import Amplitudes, Averaged, averaged_field
from jaxvib.equations.dynamics import Dynamics, State, vector_field
from jaxvib.equations.forces import energy, foundation_force, power
from jaxvib.equations.linear import natural_frequencies, steady_displacement
from jaxvib.errors import ComputationError, InputError
from jaxvib.machine.carrier import Carrier, Machine
from jaxvib.machine.dimensionless import Dimensionless
from jaxvib.machine.drive import ConstantSpeed, DCMotor, Drive, IdealDrive, InductionMotor, Motor, RunUp, SpinUp
from jaxvib.machine.effects.base import Effect, Friction, Gravity, Imbalance, MomentImbalance, StaticImbalance
from jaxvib.machine.effects.contact import LoadContact
from jaxvib.machine.effects.friction import DryFriction
from jaxvib.machine.effects.supports import CubicSupport, Stop
from jaxvib.machine.files import load_scene, save_scene, scene_from_toml, scene_to_toml
from jaxvib.machine.loads import CircularLoads, Loads, balls, pendulums, rollers
from jaxvib.machine.platforms import Platforms, network, one_mass, three_mass, two_mass
from jaxvib.machine.rotor import PlanarRotor, Rotor, planar_rotor, rotor
from jaxvib.machine.scene import Scene
from jaxvib.motion.analysis.measure import Measured, Trajectory
from jaxvib.motion.analysis.regime import Regime, RegimeName, regime
from jaxvib.motion.ensemble import Ensemble, ensemble
from jaxvib.motion.envelope.envelope import envelope
from jaxvib.motion.envelope.result import Envelope, Envelopes, EnvelopeStatus
from jaxvib.motion.run import Run, RunStatus
from jaxvib.motion.settle import settle
from jaxvib.motion.simulate import simulate
from jaxvib.motion.start import initial_state
from jaxvib.runtime.cache import use_cache
from jaxvib.runtime.cpu import prepare_cpu
from jaxvib.steady.balance.criterion import Criterion, CriterionStatus, criterion, criterion_functional, criterion_table
from jaxvib.steady.balance.speeds import CharacteristicSpeeds, characteristic_speeds, port_receptance
from jaxvib.steady.balance.states import (
    BalancedStability,
    BalancedStates,
    BalanceStatus,
    balanced_growth,
    balanced_intervals,
    balanced_stability,
    balanced_states,
)
from jaxvib.steady.branches import Branches, branches
from jaxvib.steady.jams.folds import Folds, jam_rotor_speed
from jaxvib.steady.jams.jam import Jam, JamModes, JamStatus, jam_modes
from jaxvib.steady.jams.patterns import PhasePattern, phase_pattern
from jaxvib.steady.jams.phase_search import PhaseBranch, PhaseJams, phase_branch, phase_jams
from jaxvib.steady.jams.phases import PhaseJam, PhaseStatus, phase_jam, phase_torques
from jaxvib.steady.orbits.diagram import ExactBranches, SpecialPoint
from jaxvib.steady.orbits.jam_orbit import jam_orbit
from jaxvib.steady.orbits.orbit import Orbit, OrbitStatus
from jaxvib.steady.whirl import CriticalSpeeds, Whirl, critical_speeds, whirl
from jaxvib.study.accuracy.cost import Cost, CostRow, cost_figure
from jaxvib.study.accuracy.harmonics import HarmonicConvergence, harmonic_convergence
from jaxvib.study.accuracy.tiers import Tiers, compare_tiers
from jaxvib.study.accuracy.work_precision import work_precision
from jaxvib.study.bearing.decrement import Decrement, Estimate, TurningPoints, ten_periods, turning_points
from jaxvib.study.bearing.identify import Identified, IdentifyStatus, identify
from jaxvib.study.bearing.record import Record, read_record
from jaxvib.study.bearing.swing import BearingPendulum, Swing, SwingStatus, swing
from jaxvib.study.maps.criterion_map import CriterionMap, criterion_map
from jaxvib.study.maps.run_ups import RunUps, run_ups
from jaxvib.study.maps.stability_onset import StabilityMap, stability_map, stability_onset

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
    "Imbalance",
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
    "Tiers",
    "Trajectory",
    "TurningPoints",
    "Whirl",
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
    "stability_onset",
    "steady_displacement",
    "swing",
    "ten_periods",
    "three_mass",
    "turning_points",
    "two_mass",
    "use_cache",
    "vector_field",
    "whirl",
    "work_precision",
]
