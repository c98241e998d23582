"""Differentiable simulation and design of vibration machines that work on the Sommerfeld effect."""

__version__: str

# Errors, and the CPU
from jaxvib.errors import InputError as InputError, ComputationError as ComputationError
from jaxvib.runtime.cpu import prepare_cpu as prepare_cpu
from jaxvib.display import display_units as display_units
from jaxvib.units.tables import csv_column as csv_column
from jaxvib.runtime.cache import use_cache as use_cache

# Machines
from jaxvib.machine.carrier import Machine as Machine, Carrier as Carrier, Mount as Mount
from jaxvib.machine.structures.platforms import one_mass as one_mass, two_mass as two_mass
from jaxvib.machine.structures.plane_body import plane_body as plane_body, plane_network as plane_network
from jaxvib.machine.structures.matrices import from_matrices as from_matrices
from jaxvib.machine.structures.plane_body import body as body, support as support
from jaxvib.machine.structures.platforms import three_mass as three_mass, network as network
from jaxvib.machine.structures.rotor import rotor as rotor, planar_rotor as planar_rotor
from jaxvib.machine.dimensionless import Dimensionless as Dimensionless

# Loads
from jaxvib.machine.drag import drag_of as drag_of
from jaxvib.machine.loads import Loads as Loads, ball_mass as ball_mass, balls as balls, rollers as rollers
from jaxvib.machine.loads import pendulums as pendulums
from jaxvib.machine.torus import torus_balls as torus_balls

# Drives
from jaxvib.machine.drives.drive import Drive as Drive, IdealDrive as IdealDrive, Motor as Motor, ConstantSpeed as ConstantSpeed
from jaxvib.machine.drives.drive import SpinUp as SpinUp, RunUp as RunUp, DCMotor as DCMotor, InductionMotor as InductionMotor
from jaxvib.machine.drives.belt import BeltDrive as BeltDrive
from jaxvib.machine.drives.controlled import Converter as Converter, SpeedControl as SpeedControl, SpeedProfile as SpeedProfile
from jaxvib.machine.drives.controlled import SwitchedOff as SwitchedOff, TorqueTable as TorqueTable
from jaxvib.machine.drives.electrical import DCMotorElectrical as DCMotorElectrical
from jaxvib.machine.drives.electrical import InductionMotorCircuit as InductionMotorCircuit
from jaxvib.machine.drives.electrical import InductionMotorElectrical as InductionMotorElectrical
from jaxvib.machine.drives.electrical import NamePlateMotor as NamePlateMotor

# Effects
from jaxvib.machine.effects.base import Effect as Effect, Gravity as Gravity
from jaxvib.machine.effects.friction import DryFriction as DryFriction
from jaxvib.machine.effects.rolling import RollingFriction as RollingFriction
from jaxvib.machine.effects.sliding import FreeSpin as FreeSpin, Sliding as Sliding
from jaxvib.machine.effects.base import StaticImbalance as StaticImbalance, MomentImbalance as MomentImbalance
from jaxvib.machine.effects.supports import CubicSupport as CubicSupport, FrictionSupport as FrictionSupport, Stop as Stop
from jaxvib.machine.effects.contact import LoadContact as LoadContact

# Scenes, and their files
from jaxvib.machine.scene import Scene as Scene, Exciter as Exciter, unbalance as unbalance
from jaxvib.machine.files import load_scene as load_scene, save_scene as save_scene, scene_from_toml as scene_from_toml
from jaxvib.machine.files import scene_to_toml as scene_to_toml

# The equations
from jaxvib.equations.state import State as State, ExciterState as ExciterState, Spin as Spin
from jaxvib.equations.dynamics import vector_field as vector_field
from jaxvib.motion.start import initial_state as initial_state, with_spin as with_spin
from jaxvib.equations.linear import natural_frequencies as natural_frequencies
from jaxvib.steady.shapes import mode_shapes as mode_shapes, ShapesStatus as ShapesStatus, ModeShapes as ModeShapes
from jaxvib.equations.forces import energy as energy, power as power, foundation_force as foundation_force
from jaxvib.equations.forces import foundation_moment as foundation_moment, normal_force as normal_force

# Measures of a vibration
from jaxvib.steady.measures import vibration_measures as vibration_measures
from jaxvib.steady.vibration import Vibration as Vibration
from jaxvib.steady.measures import VibrationMeasures as VibrationMeasures
from jaxvib.steady.measures import conveying_speed as conveying_speed
from jaxvib.steady.zone import vibration_zone as vibration_zone

# Motion of points
from jaxvib.steady.points import ellipse_of as ellipse_of, Ellipse as Ellipse, Deck as Deck
from jaxvib.motion.analysis.points import PointMotion as PointMotion

# Jams of light loads
from jaxvib.steady.jams.jam import jam_modes as jam_modes, JamModes as JamModes, Jam as Jam, JamStatus as JamStatus
from jaxvib.steady.jams.drag_limits import drag_limits as drag_limits, DragLimits as DragLimits, DragStatus as DragStatus
from jaxvib.steady.branches import branches as branches, Branches as Branches
from jaxvib.steady.jams.phase_search import phase_jams as phase_jams, PhaseJams as PhaseJams
from jaxvib.steady.jams.phases import PhaseJam as PhaseJam, PhaseStatus as PhaseStatus, PhasePattern as PhasePattern

# Response to unbalances
from jaxvib.steady.response import response as response, Response as Response, ResponseStatus as ResponseStatus

# Synchronous regimes
from jaxvib.steady.regimes.synchronous import synchronous_regimes as synchronous_regimes
from jaxvib.steady.regimes.working import working_regime as working_regime
from jaxvib.steady.regimes.synchronous import SynchronousRegimes as SynchronousRegimes, SynchronousRegime as SynchronousRegime
from jaxvib.steady.regimes.synchronous import RegimeStatus as RegimeStatus, RegimeSearchStatus as RegimeSearchStatus
from jaxvib.steady.regimes.partitions import regime_partitions as regime_partitions, RegimePartitions as RegimePartitions

# Exact jams
from jaxvib.steady.orbits.jam_orbit import jam_orbit as jam_orbit
from jaxvib.steady.orbits.describe import Orbit as Orbit, OrbitStatus as OrbitStatus
from jaxvib.steady.orbits.diagram import ExactBranches as ExactBranches
from jaxvib.steady.orbits.limit import synchronization_limit as synchronization_limit
from jaxvib.steady.orbits.limit import SynchronizationLimit as SynchronizationLimit, LimitStatus as LimitStatus
from jaxvib.steady.orbits.synchronous import synchronous_orbit as synchronous_orbit, SynchronousOrbit as SynchronousOrbit
from jaxvib.steady.orbits.synchronous import SynchronousStatus as SynchronousStatus
from jaxvib.study.maps.stability_onset import stability_map as stability_map, stability_onset as stability_onset

# Auto-balancing, whirl
from jaxvib.steady.balance.criterion import criterion as criterion, Criterion as Criterion
from jaxvib.study.maps.criterion_map import criterion_map as criterion_map
from jaxvib.steady.balance.states import balanced_states as balanced_states, BalancedStates as BalancedStates
from jaxvib.steady.whirl import whirl as whirl, Whirl as Whirl, WhirlStatus as WhirlStatus, critical_speeds as critical_speeds

# Motion in time
from jaxvib.motion.simulate import simulate as simulate
from jaxvib.motion.settle import settle as settle
from jaxvib.motion.envelope.envelope import envelope as envelope
from jaxvib.motion.envelope.run_up import run_up as run_up
from jaxvib.motion.ensemble import ensemble as ensemble
from jaxvib.results.estimate import estimate_share as estimate_share
from jaxvib.study.maps.run_up_map import run_up_map as run_up_map
from jaxvib.motion.analysis.regime import regime as regime
from jaxvib.motion.plan import Tolerance as Tolerance, Accuracy as Accuracy, EqualSteps as EqualSteps
from jaxvib.motion.run import Run as Run, RunStatus as RunStatus
from jaxvib.motion.envelope.result import Envelope as Envelope, EnvelopeStatus as EnvelopeStatus
from jaxvib.motion.envelope.run_up import MotorRunUp as MotorRunUp, MotorRunUpStatus as MotorRunUpStatus
from jaxvib.motion.analysis.ensemble_regimes import EnsembleRegimes as EnsembleRegimes
from jaxvib.motion.ensemble import Ensemble as Ensemble
from jaxvib.results.estimate import Share as Share
from jaxvib.motion.analysis.regime import Regime as Regime, RegimeName as RegimeName
from jaxvib.motion.analysis.spectrum import Spectrum as Spectrum
from jaxvib.motion.growth import growth as growth, Growth as Growth, GrowthStatus as GrowthStatus

# Accuracy and its cost
from jaxvib.study.accuracy.work_precision import work_precision as work_precision
from jaxvib.study.accuracy.tiers import compare_tiers as compare_tiers
from jaxvib.study.accuracy.harmonics import harmonic_convergence as harmonic_convergence
from jaxvib.study.accuracy.cost import Cost as Cost
from jaxvib.study.accuracy.gradient_check import check_gradients as check_gradients, GradientCheck as GradientCheck
from jaxvib.study.accuracy.gradient_check import GradientStatus as GradientStatus, ImplicitRoute as ImplicitRoute

# Influence of effects
from jaxvib.study.audit.audit import audit as audit, Audit as Audit, AuditStatus as AuditStatus

# Friction of a bearing
from jaxvib.study.bearing.swing import BearingPendulum as BearingPendulum, swing as swing, Swing as Swing
from jaxvib.study.bearing.swing import SwingStatus as SwingStatus
from jaxvib.study.bearing.record import Record as Record, read_record as read_record
from jaxvib.study.bearing.decrement import ten_periods as ten_periods
from jaxvib.identification.identify import identify as identify
from jaxvib.study.bearing.identify import Identified as Identified, IdentifyStatus as IdentifyStatus

# Recorded runs of a machine, and its identification
from jaxvib.identification.records.channel import Channel as Channel
from jaxvib.identification.directions import Direction as Direction
from jaxvib.identification.checks import FitStatus as FitStatus
from jaxvib.identification.identify import MachineFit as MachineFit
from jaxvib.identification.further_runs.planned import PlannedRun as PlannedRun
from jaxvib.identification.further_runs.plan import RunPlan as RunPlan, plan_runs as plan_runs
from jaxvib.identification.further_runs.predict import PredictionStatus as PredictionStatus, RunPrediction as RunPrediction
from jaxvib.identification.further_runs.predict import predict_run as predict_run
from jaxvib.identification.run import MeasuredRun as MeasuredRun
from jaxvib.exchange.recordings.read import read_run as read_run, read_recording as read_recording

# Capture in a torus
from jaxvib.study.capture.capture import capture as capture, Capture as Capture, CaptureStatus as CaptureStatus
from jaxvib.study.capture.curve import threshold_curve as threshold_curve, ThresholdCurve as ThresholdCurve

# Many cases
from jaxvib.sweeps.sweep import sweep as sweep, open_sweep as open_sweep, Sweep as Sweep
from jaxvib.sweeps.definition import SweepStatus as SweepStatus, CaseStatus as CaseStatus

# Figures and animations
from jaxvib.show.sketch import sketch as sketch
from jaxvib.show.animate import animate as animate

# Results
from jaxvib.results.result import Result as Result
from jaxvib.results.files import load as load
from jaxvib.results.csv import write_csv as write_csv
from jaxvib.report.page import html_report as html_report

# Exchange with other tools
from jaxvib.exchange.fmu import export_fmu as export_fmu, Fmu as Fmu
from jaxvib.exchange.state_space import state_space as state_space, StateSpace as StateSpace
from jaxvib.exchange.uff import export_uff as export_uff, read_uff as read_uff, UffFile as UffFile, UffFunction as UffFunction
