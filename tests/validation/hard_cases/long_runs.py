"""Hard cases of motions in time: a hundred thousand turns, passages through a resonance, period doubling, gradients of runs."""

from __future__ import annotations

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from hard_cases.case import Answer, Case, Reference
from hard_cases.nonsmooth import stop_law
from hard_cases.reference_integration import orbit_rotor_speed, orbit_speed
from hard_cases.reference_model import ReferenceModel, light_speed, platforms, reference_model
from hard_cases.shared import away, final_state, published, run_case, state_of
from jaxvib.machine.drives.drive import ConstantSpeed, DCMotor, Drive, RunUp
from jaxvib.machine.effects.base import StaticImbalance
from jaxvib.machine.effects.supports import CubicSupport, Stop
from jaxvib.machine.loads import pendulums
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import one_mass
from jaxvib.motion.growth import growth
from jaxvib.motion.simulate import simulate
from jaxvib.results.status import status_name
from jaxvib.study.accuracy.gradient_check import check_gradients

__all__ = ["CASES"]

_TURNS = 1e5


def _long(scene: Scene) -> Answer:
    """The mean load speed of the last turns of a hundred thousand."""
    until = _TURNS * 2.0 * np.pi / float(scene.drive.speed)
    run = simulate(scene, until, start="jam", mode=3, save="window", throw=False)
    status = status_name(run.status)
    return Answer([run.omega], float(run.error), "" if status == "done" else status)


def _jam_start(p: ReferenceModel, omega: float) -> tuple[np.ndarray, float]:
    speed, moved, _ = light_speed(p, omega)
    return np.concatenate([moved.imag, omega * moved.real, [0.0, omega]]), speed


def _long_again(scene: Scene) -> Reference:
    p = reference_model(scene)
    return Reference(orbit_speed(p, 0.9720, 0.9735, *_jam_start(p, 0.97266), nodes=5), unknown=1e-9)


def _lossless() -> Scene:
    machine = one_mass(mass=50.0, stiffness=4e4, damping=0.0)
    return Scene(machine, pendulums(count=1, mass=2.0, radius=0.1, drag=0.0), ConstantSpeed(60.0))


def _energy(p: ReferenceModel, y: np.ndarray) -> float:
    """T + V of one platform and one load that nothing drives, J."""
    (q, v, phi, rate), m, radius = y, float(p.m[0]), float(p.radius[0])
    load = m * ((radius * np.sin(phi) * rate) ** 2 + (v + radius * np.cos(phi) * rate) ** 2)
    return 0.5 * (float(p.mass[0, 0]) * v**2 + float(p.stiffness[0, 0]) * q**2 + load)


def _swinging(scene: Scene) -> np.ndarray:
    return away(scene, displacement=2.0, rate=0.4)


def _conserved(scene: Scene) -> Answer:
    """The energy after 1e4 turns of the rotor, to which nothing ties it."""
    until = 1e4 * 2.0 * np.pi / float(scene.drive.speed)
    run = simulate(scene, until, start=state_of(scene, _swinging(scene)), save="window", estimate=False, throw=False)
    last = run.window.state
    y = [float(x) for x in (last.displacement[-1, 0], last.velocity[-1, 0], last.angle[0][-1, 0], last.rate[0][-1, 0])]
    status = status_name(run.status)
    return Answer([_energy(reference_model(scene), np.array(y))], None, "" if status == "done" else status)


def _passing(drive: Drive) -> Scene:
    machine = one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    loads = pendulums(count=1, mass=0.5, radius=0.1, drag=0.5)
    return Scene(machine, loads, drive, (StaticImbalance(0.02),))


def _hanging(scene: Scene) -> np.ndarray:
    return away(scene, angle=-0.5)


_FAST, _SLOW, _STALLED = (final_state(until, _hanging) for until in (2.0, 24.0, 8.0))

_DOUBLED_TURNS = 100


def _doubled() -> Scene:
    """Bounces on a stop 8 times as stiff as the support, shaken 3.4 times as fast as it swings freely; the load is light."""
    machine = one_mass(mass=1.0, stiffness=1.0, damping=0.1)
    loads = pendulums(count=1, mass=1e-3, radius=1.0, drag=1e-3)
    return Scene(machine, loads, ConstantSpeed(3.4), (StaticImbalance(1.0, angle=0.0), Stop(8.0, gap=0.0, side="above")))


def _turn_by_turn(scene: Scene) -> Answer:
    """The displacement after so many turns of the rotor, and after one more."""
    found, claimed = [], []
    for turns in (_DOUBLED_TURNS, _DOUBLED_TURNS + 1):
        until = turns * 2.0 * np.pi / float(scene.drive.speed)
        run = simulate(scene, until, start=state_of(scene, _still(scene)), save="window", throw=False)
        if status_name(run.status) != "done":
            return Answer([], None, status_name(run.status))
        found.append(float(run.window.state.displacement[-1, 0]))
        claimed.append(float(run.error))
    return Answer(found, max(claimed))


def _still(scene: Scene) -> np.ndarray:
    return np.array([0.0, 0.0, 0.0, float(scene.drive.speed)])


def _turn_by_turn_again(scene: Scene) -> Reference:
    found = []
    for turns in (_DOUBLED_TURNS, _DOUBLED_TURNS + 1):
        until = turns * 2.0 * np.pi / float(scene.drive.speed)
        found.append(stop_law(until, _still)(scene))
    values = [np.asarray(each.values, float)[0] for each in found]
    return Reference(values, scale=np.asarray(found[0].scale, float)[0], unknown=1e-6)


def _slopes(scene: Scene) -> Answer:
    """Derivatives of the load speed at the end of a long run by the logarithm of each support's stiffness."""

    def omega(factor: jax.Array) -> jax.Array:
        now = eqx.tree_at(lambda s: platforms(s).stiffness, scene, platforms(scene).stiffness * factor)
        forward = diffrax.ForwardMode()
        run = simulate(now, 1500.0, start="jam", mode=3, save="window", adjoint=forward, max_steps=2**16, throw=False)
        return run.omega

    return Answer(jax.jacfwd(omega)(jnp.ones(2)))


def _slopes_again(scene: Scene) -> Reference:
    """dw/dk at a given rotor speed is -(dn/dk)/(dn/dw), by differences of shooting."""
    p, speed = reference_model(scene), float(scene.drive.speed)
    (omega,) = orbit_speed(p, 0.9720, 0.9735, *_jam_start(p, 0.97266), nodes=5)
    start = _jam_start(p, omega)[0]

    def rotor_speed(k: int, step: float) -> float:
        factor = np.ones(2)
        if k < 2:
            factor[k] += step
        change = np.diag(p.foundation_stiffness * (factor - 1.0))
        now = dataclasses.replace(p, stiffness=p.stiffness + change)
        return orbit_rotor_speed(now, omega * (1.0 + step if k == 2 else 1.0), start, speed)[0]

    h = 2e-5
    slope = [(rotor_speed(k, h) - rotor_speed(k, -h)) / (2.0 * h) for k in range(3)]
    return Reference([-omega * slope[0] / slope[2], -omega * slope[1] / slope[2]], unknown=1e-6)


def _ueda() -> Scene:
    """x'' + 0.05 x' + x^3 = 7.5 sin t, but for a support of 1e-6 and a load of 1e-3: Ueda's strange attractor."""
    machine = one_mass(mass=1.0, stiffness=1e-6, damping=0.05)
    loads = pendulums(count=1, mass=1e-3, radius=1.0, drag=1e-3)
    return Scene(machine, loads, ConstantSpeed(1.0), (StaticImbalance(7.5), CubicSupport(1.0)))


_CHAOTIC_TURNS = 1000


def _exponent(scene: Scene) -> Answer:
    start = state_of(scene, np.array([2.5, 0.0, 0.0, 1.0]))
    found = growth(scene, _CHAOTIC_TURNS * 2.0 * np.pi, start=start, segments=_CHAOTIC_TURNS // 5)
    if status_name(found.status) != "chaotic":
        return Answer([], None, status_name(found.status))
    return Answer([found.exponent], 4.0 * found.uncertainty / found.exponent)


def _exponent_again(scene: Scene) -> Reference:
    """Lyapunov exponent by the variational equation of Ueda's oscillator, in segments of a turn, the first fifth left out."""

    def field(t: float, y: np.ndarray) -> list[float]:
        x, v, dx, dv = y
        return [v, 7.5 * np.sin(t) - 0.05 * v - x**3, dv, -0.05 * dv - 3.0 * x**2 * dx]

    y, rates = np.array([2.5, 0.0, 1.0, 0.0]), []
    for k in range(_CHAOTIC_TURNS):
        turn = 2.0 * np.pi * np.array([k, k + 1])
        y = solve_ivp(field, turn, y, method="DOP853", rtol=1e-8, atol=1e-8).y[:, -1]
        grown = float(np.hypot(y[2], y[3]))
        y[2:] /= grown
        rates.append(np.log(grown) / (2.0 * np.pi))
    late = np.array(rates[_CHAOTIC_TURNS // 5 :])
    return Reference([np.mean(late)], unknown=float(4.0 * np.std(late) / np.sqrt(late.size) / np.mean(late)))


def _meaningless(scene: Scene) -> Answer:
    """The derivative of where Ueda's oscillator is after 100 turns by the logarithm of its damping, and what a check says."""
    start = state_of(scene, np.array([2.5, 0.0, 0.0, 1.0]))

    def last(now: Scene) -> jax.Array:
        run = simulate(
            now,
            200.0 * np.pi,
            start=start,
            save="window",
            estimate=False,
            adjoint=diffrax.ForwardMode(),
            max_steps=2**15,
            throw=False,
        )
        return run.window.state.displacement[-1, 0]

    found = check_gradients(scene, last, free=("machine.damping",), routes=("forward",))
    return Answer(found.gradient[0], None, "" if found.status_name == "agree" else found.status_name)


CASES = (
    Case(
        "1e5 turns",
        hard="single precision cannot represent the time, and the errors of 3e6 steps add up",
        quantity="mean load speed in the jam at the end",
        against="shooting with SciPy",
        scene=lambda: published(eps=0.05),
        answer=_long,
        reference=_long_again,
        within=(1e-8, 1e-4),
    ),
    Case(
        "energy over 1e4 turns",
        hard="without losses the errors of all steps add up",
        quantity="energy at the end",
        against="energy at the start",
        scene=_lossless,
        answer=_conserved,
        reference=lambda scene: Reference([_energy(reference_model(scene), _swinging(scene))]),
        within=(1e-7, 1e-2),
    ),
    run_case(
        "run-up through the resonance, fast",
        hard="the acceleration of the drive jumps at the end of the run-up",
        scene=lambda: _passing(RunUp(60.0, acceleration=100.0)),
        answer=_FAST[0],
        reference=_FAST[1],
        within=(1e-6, 1e-2),
    ),
    run_case(
        "run-up through the resonance, slow",
        hard="small differences during the passage decide whether the load jams at the resonance",
        scene=lambda: _passing(RunUp(60.0, acceleration=3.0)),
        answer=_SLOW[0],
        reference=_SLOW[1],
        within=(1e-5, 0.1),
    ),
    run_case(
        "motor caught by the resonance",
        hard="the rotor itself is caught: its speed is an unknown, which the vibration changes",
        scene=lambda: _passing(DCMotor(60.0, stall_torque=3.0, inertia=0.2)),
        answer=_STALLED[0],
        reference=_STALLED[1],
        within=(1e-5, 0.1),
    ),
    Case(
        "period doubling",
        hard="the motion repeats after two turns, not after one; an average over one turn does not show this",
        quantity="displacements after 100 and after 101 turns",
        against="non-smooth law, integrated from event to event by SciPy's DOP853",
        scene=_doubled,
        answer=_turn_by_turn,
        reference=_turn_by_turn_again,
        within=(1e-5, 1e-2),
    ),
    Case(
        "gradient of a long run",
        hard="a derivative through 1500 units of time; in a stable jam it converges like the motion",
        quantity="derivatives of the load speed at the end with respect to the support stiffnesses",
        against="shooting: -(dn/dk)/(dn/dOmega)",
        scene=lambda: published(eps=0.05),
        answer=_slopes,
        reference=_slopes_again,
        within=(1e-4, 0.1),
    ),
    Case(
        "chaos, growth of derivatives",
        hard="derivatives of a long run are meaningless even if they are exact; a status must state this",
        quantity="largest Lyapunov exponent of Ueda's attractor",
        against="variational equation, integrated by SciPy's DOP853",
        scene=_ueda,
        answer=_exponent,
        reference=_exponent_again,
        within=(0.4, 0.4),  # both are means over some hundred turns
    ),
    Case(
        "chaos, gradient of a run",
        hard="forward mode gives 17 digits of a derivative that is valid only for changes smaller than rounding errors",
        quantity="checked derivative of the displacement after 100 turns with respect to the damping",
        against="no correct value exists, only a status",
        scene=_ueda,
        answer=_meaningless,
        reference=lambda scene: Reference([0.0]),
        within=(0.0, 0.0),
        named=(("chaotic",), ("refused",)),
    ),
)
