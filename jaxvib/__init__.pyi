"""Differentiable simulation and design of vibration machines that work on the Sommerfeld effect."""

# Errors, and the processor
from jaxvib.errors import ComputationError, InputError
from jaxvib.runtime.cache import use_cache
from jaxvib.runtime.cpu import prepare_cpu

# Units of texts and figures, tables from files
from jaxvib.display import display_units
from jaxvib.units.tables import csv_column

# Machines
from jaxvib.machine.carrier import Carrier, Machine
from jaxvib.machine.dimensionless import Dimensionless
from jaxvib.machine.carrier import Mount
from jaxvib.machine.structures.matrices import from_matrices
from jaxvib.machine.structures.plane_body import body, plane_body, plane_network, support
from jaxvib.machine.structures.platforms import network, one_mass, three_mass, two_mass
from jaxvib.machine.structures.rotor import planar_rotor, rotor

# Loads
from jaxvib.machine.drag import drag_of
from jaxvib.machine.loads import Loads, ball_mass, balls, pendulums, rollers
from jaxvib.machine.torus import torus_balls

# Drives
from jaxvib.machine.drives.controlled import Converter, SpeedControl, SpeedProfile, TorqueTable
from jaxvib.machine.drives.electrical import DCMotorElectrical, InductionMotorCircuit, InductionMotorElectrical, NamePlateMotor
from jaxvib.machine.drives.drive import (
    ConstantSpeed,
    DCMotor,
    Drive,
    IdealDrive,
    InductionMotor,
    Motor,
    RunUp,
    SpinUp,
    SwitchedOff,
)

# Effects
from jaxvib.machine.effects.base import Effect, Gravity, MomentImbalance, StaticImbalance
from jaxvib.machine.effects.contact import LoadContact
from jaxvib.machine.effects.friction import DryFriction
from jaxvib.machine.effects.rolling import RollingFriction
from jaxvib.machine.effects.sliding import FreeSpin, Sliding
from jaxvib.machine.effects.supports import CubicSupport, Stop

# Scenes, and their files
from jaxvib.machine.files import load_scene, save_scene, scene_from_toml, scene_to_toml
from jaxvib.machine.scene import Exciter, Scene, unbalance

# The equations
from jaxvib.equations.dynamics import vector_field
from jaxvib.equations.state import ExciterState, Spin, State
from jaxvib.equations.forces import energy, foundation_force, foundation_moment, normal_force, power
from jaxvib.equations.linear import natural_frequencies
from jaxvib.motion.start import initial_state, with_spin

# Measures of a vibration
from jaxvib.steady.measures import Vibration, VibrationMeasures, conveying_speed, vibration_measures, vibration_zone

# Motion of points
from jaxvib.motion.analysis.points import PointMotion
from jaxvib.steady.points import Deck, Ellipse, ellipse_of

# Jams of light loads
from jaxvib.steady.branches import Branches, branches
from jaxvib.steady.jams.drag_limits import DragLimits, DragStatus, drag_limits
from jaxvib.steady.jams.jam import Jam, JamModes, JamStatus, jam_modes
from jaxvib.steady.jams.phases import PhasePattern
from jaxvib.steady.jams.phase_search import PhaseJams, phase_jams
from jaxvib.steady.jams.phases import PhaseJam, PhaseStatus
from jaxvib.steady.shapes import ModeShapes, ShapesStatus, mode_shapes

# Response to unbalances
from jaxvib.steady.response import Response, ResponseStatus, response

# Synchronous regimes
from jaxvib.steady.regimes.partitions import RegimePartitions, regime_partitions
from jaxvib.steady.regimes.synchronous import (
    RegimeSearchStatus,
    RegimeStatus,
    SynchronousRegime,
    SynchronousRegimes,
    synchronous_regimes,
)
from jaxvib.steady.regimes.working import working_regime

# Exact jams
from jaxvib.steady.orbits.diagram import ExactBranches
from jaxvib.steady.orbits.jam_orbit import jam_orbit
from jaxvib.steady.orbits.describe import Orbit, OrbitStatus
from jaxvib.steady.orbits.limit import LimitStatus, SynchronizationLimit, synchronization_limit
from jaxvib.steady.orbits.synchronous import SynchronousOrbit, SynchronousStatus, synchronous_orbit
from jaxvib.study.maps.stability_onset import stability_map, stability_onset

# Auto-balancing, whirl
from jaxvib.steady.balance.criterion import Criterion, criterion
from jaxvib.steady.balance.states import BalancedStates, balanced_states
from jaxvib.steady.whirl import Whirl, WhirlStatus, critical_speeds, whirl
from jaxvib.study.maps.criterion_map import criterion_map

# Motion in time
from jaxvib.motion.analysis.regime import Regime, RegimeName, regime
from jaxvib.motion.analysis.spectrum import Spectrum
from jaxvib.motion.ensemble import Ensemble, ensemble
from jaxvib.motion.envelope.envelope import envelope
from jaxvib.motion.envelope.result import Envelope, EnvelopeStatus
from jaxvib.motion.envelope.run_up import MotorRunUp, MotorRunUpStatus, run_up
from jaxvib.motion.growth import Growth, GrowthStatus, growth
from jaxvib.motion.run import Run, RunStatus
from jaxvib.motion.settle import settle
from jaxvib.motion.simulate import simulate
from jaxvib.motion.plan import Accuracy, EqualSteps, Tolerance
from jaxvib.study.maps.run_up_map import run_up_map

# Accuracy and its cost
from jaxvib.study.accuracy.cost import Cost
from jaxvib.study.accuracy.gradient_check import GradientCheck, GradientStatus, ImplicitRoute, check_gradients
from jaxvib.study.accuracy.harmonics import harmonic_convergence
from jaxvib.study.accuracy.tiers import compare_tiers
from jaxvib.study.accuracy.work_precision import work_precision

# Influence of effects
from jaxvib.study.audit.audit import Audit, AuditStatus, audit

# Friction of a bearing
from jaxvib.study.bearing.decrement import ten_periods
from jaxvib.study.bearing.identify import Identified, IdentifyStatus
from jaxvib.study.bearing.record import Record, read_record
from jaxvib.study.bearing.swing import BearingPendulum, Swing, SwingStatus, swing

# Recorded runs of a machine, and its identification
from jaxvib.identification.checks import FitStatus
from jaxvib.identification.directions import Direction
from jaxvib.identification.identify import MachineFit, identify
from jaxvib.identification.further_runs.plan import RunPlan, plan_runs
from jaxvib.identification.further_runs.planned import PlannedRun
from jaxvib.identification.further_runs.predict import PredictionStatus, RunPrediction, predict_run
from jaxvib.identification.records.channel import Channel
from jaxvib.identification.run import MeasuredRun
from jaxvib.exchange.recordings.read import read_recording, read_run

# Capture in a torus
from jaxvib.study.capture.capture import Capture, CaptureStatus, capture
from jaxvib.study.capture.curve import ThresholdCurve, threshold_curve

# Many cases
from jaxvib.sweeps.definition import CaseStatus, SweepStatus
from jaxvib.sweeps.sweep import Sweep, open_sweep, sweep

# Figures and animations
from jaxvib.show.animate import animate
from jaxvib.show.sketch import sketch

# Results
from jaxvib.report.page import html_report
from jaxvib.results.csv import write_csv
from jaxvib.results.estimate import Share, estimate_share
from jaxvib.results.files import load
from jaxvib.results.result import Result

# Exchange with other tools
from jaxvib.exchange.fmu import Fmu, export_fmu
from jaxvib.exchange.state_space import StateSpace, state_space
from jaxvib.exchange.uff import UffFile, UffFunction, export_uff, read_uff

__version__: str

__all__ = [
    # Errors, and the processor
    "InputError",
    "ComputationError",
    "prepare_cpu",
    "display_units",
    "csv_column",
    "use_cache",
    # Machines
    "Machine",
    "Carrier",
    "Mount",
    "one_mass",
    "two_mass",
    "plane_body",
    "plane_network",
    "from_matrices",
    "body",
    "support",
    "three_mass",
    "network",
    "rotor",
    "planar_rotor",
    "Dimensionless",
    # Loads
    "drag_of",
    "Loads",
    "ball_mass",
    "balls",
    "rollers",
    "pendulums",
    "torus_balls",
    # Drives
    "Drive",
    "IdealDrive",
    "Motor",
    "ConstantSpeed",
    "SpinUp",
    "RunUp",
    "DCMotor",
    "InductionMotor",
    "SwitchedOff",
    "Converter",
    "SpeedControl",
    "SpeedProfile",
    "TorqueTable",
    "DCMotorElectrical",
    "InductionMotorCircuit",
    "InductionMotorElectrical",
    "NamePlateMotor",
    # Effects
    "Effect",
    "Gravity",
    "DryFriction",
    "RollingFriction",
    "FreeSpin",
    "Sliding",
    "StaticImbalance",
    "MomentImbalance",
    "CubicSupport",
    "Stop",
    "LoadContact",
    # Scenes, and their files
    "Scene",
    "Exciter",
    "unbalance",
    "load_scene",
    "save_scene",
    "scene_from_toml",
    "scene_to_toml",
    # The equations
    "State",
    "ExciterState",
    "Spin",
    "vector_field",
    "initial_state",
    "with_spin",
    "natural_frequencies",
    "mode_shapes",
    "ShapesStatus",
    "ModeShapes",
    "energy",
    "power",
    "foundation_force",
    "foundation_moment",
    "normal_force",
    # Measures of a vibration
    "vibration_measures",
    "Vibration",
    "VibrationMeasures",
    "vibration_zone",
    "conveying_speed",
    # Motion of points
    "ellipse_of",
    "Ellipse",
    "Deck",
    "PointMotion",
    # Jams of light loads
    "jam_modes",
    "JamModes",
    "Jam",
    "JamStatus",
    "drag_limits",
    "DragLimits",
    "DragStatus",
    "branches",
    "Branches",
    "phase_jams",
    "PhaseJams",
    "PhaseJam",
    "PhaseStatus",
    "PhasePattern",
    # Response to unbalances
    "response",
    "Response",
    "ResponseStatus",
    # Synchronous regimes
    "synchronous_regimes",
    "working_regime",
    "SynchronousRegimes",
    "SynchronousRegime",
    "RegimeStatus",
    "RegimeSearchStatus",
    "regime_partitions",
    "RegimePartitions",
    # Exact jams
    "jam_orbit",
    "Orbit",
    "OrbitStatus",
    "ExactBranches",
    "synchronization_limit",
    "SynchronizationLimit",
    "LimitStatus",
    "synchronous_orbit",
    "SynchronousOrbit",
    "SynchronousStatus",
    "stability_map",
    "stability_onset",
    # Auto-balancing, whirl
    "criterion",
    "Criterion",
    "criterion_map",
    "balanced_states",
    "BalancedStates",
    "whirl",
    "Whirl",
    "WhirlStatus",
    "critical_speeds",
    # Motion in time
    "simulate",
    "settle",
    "envelope",
    "run_up",
    "ensemble",
    "estimate_share",
    "run_up_map",
    "regime",
    "Tolerance",
    "Accuracy",
    "EqualSteps",
    "Run",
    "RunStatus",
    "Envelope",
    "EnvelopeStatus",
    "MotorRunUp",
    "MotorRunUpStatus",
    "Ensemble",
    "Share",
    "Regime",
    "RegimeName",
    "Spectrum",
    "growth",
    "Growth",
    "GrowthStatus",
    # Accuracy and its cost
    "work_precision",
    "compare_tiers",
    "harmonic_convergence",
    "Cost",
    "check_gradients",
    "GradientCheck",
    "GradientStatus",
    "ImplicitRoute",
    # Influence of effects
    "audit",
    "Audit",
    "AuditStatus",
    # Friction of a bearing
    "BearingPendulum",
    "swing",
    "Swing",
    "SwingStatus",
    "Record",
    "read_record",
    "ten_periods",
    "identify",
    "Identified",
    "IdentifyStatus",
    # Recorded runs of a machine, and its identification
    "Channel",
    "Direction",
    "FitStatus",
    "MachineFit",
    "PlannedRun",
    "RunPlan",
    "plan_runs",
    "PredictionStatus",
    "RunPrediction",
    "predict_run",
    "MeasuredRun",
    "read_run",
    "read_recording",
    # Capture in a torus
    "capture",
    "Capture",
    "CaptureStatus",
    "threshold_curve",
    "ThresholdCurve",
    # Many cases
    "sweep",
    "open_sweep",
    "Sweep",
    "SweepStatus",
    "CaseStatus",
    # Figures and animations
    "sketch",
    "animate",
    # Results
    "Result",
    "load",
    "write_csv",
    "html_report",
    # Exchange with other tools
    "export_fmu",
    "Fmu",
    "state_space",
    "StateSpace",
    "export_uff",
    "read_uff",
    "UffFile",
    "UffFunction",
]
