"""Closed forms of several exciters, each compared with the averaged, the exact and the simulated motion.

The body has equal supports in x and y whose forces pass through its centre of mass, so that its three coordinates are not
coupled. M and J are the mass and the moment of inertia of the whole machine.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq, minimize_scalar

import jaxvib as jv
from jaxvib.machine.structures.plane_body import PlaneBody

Place = tuple[float, float]
Tier = Literal["averaged", "exact", "simulated"]
TIERS: tuple[Tier, ...] = ("averaged", "exact", "simulated")

MASS, INERTIA, S, NO_LOAD, STALL = 300.0, 75.0, 0.4, 100.0, 300.0
MOTOR = jv.DCMotor(NO_LOAD, stall_torque=STALL, inertia=0.5)
TURNS = 0.3 + 2.0 * np.pi * np.arange(3) / 3.0


@dataclasses.dataclass(frozen=True)
class ClosedForm:
    """Closed form of the motion of exciters.

    **Attributes**: `name`: machine; `formula` in words; `error` of jaxvib in a tier, relative or in rad, inf if the motion
    does not have the stability of the closed form; `within`: largest error in each tier, 0 for an unstable motion that a
    simulation leaves.
    """

    name: str
    formula: str
    error: Callable[[Tier], float]
    within: tuple[float, float, float]


def body(stiffness: float, damping: float, lever: float = 0.6) -> PlaneBody:
    """Return a body with the `stiffness` and `damping` in x and in y, and `lever`^2 times them for the turn."""
    across = (stiffness / 2.0,) * 2, (damping / 2.0,) * 2
    springs = [jv.support(at=(x, 0.0), stiffness=across[0], damping=across[1]) for x in (-lever, lever)]
    return jv.plane_body(mass=MASS, inertia=INERTIA, supports=springs)


def motors(places: Sequence[Place], machine: PlaneBody, ways: Sequence[int] = (), motor=MOTOR) -> jv.Scene:
    """Return a machine with equal motors at the `places`, in the directions `ways`."""
    pairs = zip(places, ways or (1,) * len(places), strict=True)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=S, at=at, direction=way) for at, way in pairs])


def on_circle(radius: float) -> list[Place]:
    """Return the corners of an equilateral triangle."""
    return [(radius * float(np.cos(a)), radius * float(np.sin(a))) for a in TURNS]


def on_line(*across: float) -> list[Place]:
    """Return places on the line y = 0."""
    return [(x, 0.0) for x in across]


class Synchronous(NamedTuple):
    """Motion at one speed, as a closed form states it: `phases` relative to the first exciter; `speed` near the motion;
    `has_speed`: the speed is part of the closed form; `stable`. A simulation of `until`, s, starts without vibration,
    at the share `begin` of the speed and `away` from the phases, rad."""

    scene: jv.Scene
    phases: Sequence[float]
    speed: float
    has_speed: bool = True
    stable: bool = True
    begin: float = 1.0
    until: float = 60.0
    away: float = 0.2

    def error(self, tier: Tier) -> float:
        """Return the largest relative error of the speed, or error of a phase in rad."""
        speed, phases, stable = getattr(self, tier)()
        if stable != self.stable:
            return np.inf
        if tier == "simulated" and not stable:
            return 0.0
        wrong = np.abs(np.angle(np.exp(1j * (phases - phases[0] - self.phases))))
        return max(float(np.max(wrong)), abs(speed / self.speed - 1.0) if self.has_speed else 0.0)

    def averaged(self) -> tuple[float, np.ndarray, bool]:
        """Return speed, phases and stability of the averaged regime."""
        regime = jv.synchronous_regimes(self.scene, near=(self.speed, jnp.asarray(self.phases)))
        return float(regime.speed), np.asarray(regime.phases), bool(regime.stable)

    def exact(self) -> tuple[float, np.ndarray, bool]:
        """Return speed, phases and stability of the exact orbit."""
        orbit = jv.synchronous_orbit(self.scene, speed=self.speed, phases=self.phases)
        return float(orbit.speed), np.asarray(orbit.phases), bool(orbit.stable)

    def simulated(self) -> tuple[float, np.ndarray, bool]:
        """Return mean speed, phases at the end, and True if the phases remained close to those of the closed form."""
        off, own = self.away * np.array([0.0, 1.0, -1.5]), []
        for exciter, phase, change in zip(self.scene.exciters, self.phases, off, strict=False):
            angle, rate = (jnp.asarray(exciter.direction * x) for x in (phase + change, self.begin * self.speed))
            has_loads = exciter.loads is not None
            own.append(jv.ExciterState((angle[None],), (rate[None],)) if has_loads else jv.ExciterState(rotor=(angle, rate)))
        start = jv.State(jnp.zeros(3), jnp.zeros(3), exciters=own)
        tight = jv.Tolerance(1e-11)
        run = jv.simulate(self.scene, self.until, start=start, save="window", estimate=False, stepsize_controller=tight)
        angles = [(own.angle[0][:, 0] if own.rotor is None else own.rotor[0]) for own in run.window.state.exciters]
        turned = np.array([e.direction * np.asarray(angle) for e, angle in zip(self.scene.exciters, angles, strict=True)])
        phases = turned - turned[0]
        speed = float(np.mean(np.abs(run.load_speed)))
        away = np.abs(np.angle(np.exp(1j * (phases - np.asarray(self.phases)[:, None]))))
        return speed, phases[:, -1], bool(np.max(away) < 0.5 and abs(speed / self.speed - 1.0) < 0.1)


def circular_speed(count: int, stiffness: float, damping: float) -> float:
    """Return Omega of L(Omega) = N c S^2 Omega^5 / |D|^2."""

    def balance(w: float) -> float:
        return (
            STALL * (1.0 - w / NO_LOAD) - count * damping * S**2 * w**5 / abs(stiffness - MASS * w**2 + 1j * damping * w) ** 2
        )

    return brentq(balance, 0.9 * NO_LOAD, NO_LOAD, xtol=1e-14)


def circular(places: Sequence[Place], stiffness: float, damping: float, lever: float = 0.6, **numbers) -> Synchronous:
    """Return the circular translation of motors in phase."""
    speed = circular_speed(len(places), stiffness, damping)
    return Synchronous(motors(places, body(stiffness, damping, lever)), [0.0] * len(places), speed, **numbers)


def pair(share: float) -> Synchronous:
    """Return the stable motion of two exciters of one direction with M l^2 = `share` 2 J: in phase, or in antiphase."""
    half = float(np.sqrt(2.0 * share * INERTIA / MASS))
    if share > 1.0:
        return circular(on_line(-half, half), 3e3, 300.0)
    return Synchronous(motors(on_line(-half, half), body(3e3, 300.0)), [0.0, np.pi], NO_LOAD, has_speed=False)


def opposite() -> Synchronous:
    """Return two exciters of opposite directions at the polar angles 2.3 and 0.4."""
    polar = (2.3, 0.4)
    places = [(0.5 * float(np.cos(d)), 0.5 * float(np.sin(d))) for d in polar]
    return Synchronous(motors(places, body(3e3, 300.0), (1, -1)), [0.0, -sum(polar)], NO_LOAD, has_speed=False)


def at_rest() -> Synchronous:
    """Return three exciters on a triangle with phases opposite to their places."""
    return Synchronous(motors(on_circle(1.0), body(3e3, 300.0)), TURNS[0] - TURNS, NO_LOAD)


def middle_opposes() -> Synchronous:
    """Return three exciters on a line, the outer ones far from each other."""
    return Synchronous(motors(on_line(-2.0, 0.0, 2.0), body(3e3, 300.0, 2.0)), [0.0, np.pi, 0.0], NO_LOAD, has_speed=False)


def light_rotors() -> Synchronous:
    """Return three light rotors on a lightly damped body, in phase with M l^2 = 9 J: a minimum that grows."""
    motor = jv.DCMotor(NO_LOAD, stall_torque=50.0, inertia=0.03)
    scene = motors(on_circle(1.5), body(MASS * 50.0**2, 600.0), motor=motor)
    regime = Synchronous(scene, [0.0] * 3, 98.86, has_speed=False, stable=False, away=1e-3)
    assert float(jv.synchronous_regimes(scene, near=(98.86, jnp.zeros(3))).quasi_static) < 0.0
    return regime


def balancers(phase: float) -> Synchronous:
    """Return two loads that jam below the resonance of the translation (`phase` 0) or of the turn (`phase` pi).

    b R^2 (n - Omega) = 2 c S^2 Omega^5 / |D|^2 in translation, and c l^2 S^2 Omega^5 / |D|^2 with the D and c of the turn. The
    forces of a turn alternate, so that the latter holds to leading order.
    """
    (k, c, lever), load, radius, drag, n = (2e5, 300.0, 0.5), 2.0, 0.15, 0.3, 200.0
    loads, far = jv.balls(count=1, mass=load, radius=radius, drag=drag), 1.2
    exciters = [jv.Exciter(loads, jv.ConstantSpeed(n), at=(x, 0.0)) for x in (-lever, lever)]
    scene = jv.Scene(body(k, c, far), exciters=exciters)
    size, mass = (2.0, MASS + 2.0 * load) if phase == 0.0 else (lever**2, INERTIA + 2.0 * load * lever**2)
    if phase != 0.0:
        k, c = far**2 * k, far**2 * c

    def balance(w: float) -> float:
        taken = size * c * (load * radius) ** 2 * w**5 / abs(k - mass * w**2 + 1j * c * w) ** 2
        return drag * radius**2 * (n - w) - taken

    resonance = float(np.sqrt(k / mass))
    return Synchronous(scene, [0.0, phase], brentq(balance, 0.5 * resonance, resonance, xtol=1e-14), begin=0.7, until=400.0)


def torque_limit(tier: Tier) -> float:
    """Return the error of W = Omega^2 S^2 l_1 l_2 / (2 J): the exciters lose synchronization if the half difference of the
    torques reaches W."""
    machine, w = body(30.0, 60.0), S**2 * 0.6 * 0.5 / (2.0 * INERTIA)
    speed = brentq(lambda speed: STALL * (1.0 - speed / NO_LOAD) - w * speed**2, 0.5 * NO_LOAD, NO_LOAD)
    fold = speed / (1.0 + w * speed**2 / STALL)  # no-load speed of the second motor, of the same stall torque

    def case(share: float) -> Synchronous:
        drives = [jv.DCMotor(n, stall_torque=STALL, inertia=0.5) for n in (NO_LOAD, NO_LOAD + share * (fold - NO_LOAD))]
        parts = zip(drives, on_line(-0.6, 0.5), (1, -1), strict=True)
        exciters = [jv.Exciter(drive=d, unbalance=S, at=at, direction=way) for d, at, way in parts]
        phase = np.pi - float(np.arcsin(min(share, 1.0)))
        return Synchronous(jv.Scene(machine, exciters=exciters), [0.0, phase], speed, stable=share < 1.0)

    if tier == "simulated":
        return 0.05 if all(each.simulated()[2] == each.stable for each in (case(0.95), case(1.05))) else np.inf
    near = case(0.5)
    regime = jv.synchronous_regimes(near.scene, near=(near.speed, jnp.asarray(near.phases)))
    if tier == "averaged":
        half = float(regime.torque[0] - regime.torque[1]) / 2.0
        return abs(float(regime.margin) * half / (w * float(regime.speed) ** 2) - 1.0)
    limit = jv.synchronization_limit(near.scene, regime, over="exciters[1].drive.speed")
    return abs((float(limit.value[0]) - fold) / (fold - NO_LOAD))


def jam_limit(tier: Tier) -> float:
    """Return the error of the largest torque at which a resonance catches one exciter."""
    stiffness, damping = 6e4, 600.0

    def torque(w: float) -> float:
        return damping * S**2 * w**5 / abs(stiffness - MASS * w**2 + 1j * damping * w) ** 2 / (1.0 - w / NO_LOAD)

    at = minimize_scalar(lambda w: -torque(w), bounds=(13.0, 15.5), method="bounded", options={"xatol": 1e-12}).x

    def case(share: float) -> Synchronous:
        motor = jv.DCMotor(NO_LOAD, stall_torque=share * torque(at), inertia=0.5)
        scene = motors([(0.0, 0.0)], body(stiffness, damping), motor=motor)
        return Synchronous(scene, [0.0], at, stable=share < 1.0, begin=0.7)

    if tier == "simulated":
        return 0.05 if all(each.simulated()[2] == each.stable for each in (case(0.95), case(1.05))) else np.inf
    if tier == "averaged":
        counts = [jv.synchronous_regimes(case(1.0 + side).scene).speed.size for side in (-1e-6, 1e-6)]
        return 1e-6 if counts == [3, 1] else np.inf
    caught = jv.synchronous_orbit(case(0.95).scene, speed=0.97 * at)
    limit = jv.synchronization_limit(case(0.95).scene, caught, over="drive.stall_torque")
    return abs(float(limit.value[1]) / torque(at) - 1.0)


def averaged_errors(unbalances: Sequence[float]) -> list[float]:
    """Return the relative errors of the averaged torque of two motors on two platforms, from the exact motion."""
    errors = []
    for unbalance in unbalances:
        machine = jv.network(
            mass=[300.0, 200.0], stiffness=[3e5, 1e5], damping=[900.0, 600.0], links=[(1, 2)],
            link_stiffness=[2e5], link_damping=[300.0], exciter=1,
        )  # fmt: skip
        scene = jv.Scene(machine, exciters=[jv.Exciter(drive=MOTOR, unbalance=unbalance, at=at) for at in (1, 2)])
        regime = jv.synchronous_regimes(scene, near=(99.0, jnp.array([0.0, -0.05])))
        orbit = jv.synchronous_orbit(scene, regime)
        errors.append(abs(float(jnp.sum(orbit.torque) / jnp.sum(regime.torque)) - 1.0))
    return errors


def of(motion: Callable[[], Synchronous]) -> Callable[[Tier], float]:
    """Return the error of a motion."""
    return lambda tier: motion().error(tier)


ONE_WAY, TRIANGLE, LINE = "two exciters of one direction", "three exciters on a triangle", "three exciters on a line"

FORMS = (
    ClosedForm(f"1: {ONE_WAY}, M l^2 = 2.4 J", "in phase", of(lambda: pair(1.2)), (2e-14, 2e-14, 4e-14)),
    ClosedForm(f"1: {ONE_WAY}, M l^2 = 1.6 J", "in antiphase", of(lambda: pair(0.8)), (2e-14, 2e-14, 1e-12)),
    ClosedForm("2: two exciters of opposite directions", "phase -(d_1 + d_2)", of(opposite), (2e-14, 2e-14, 2e-12)),
    ClosedForm("2: limit of synchronization", "W = Omega^2 S^2 l_1 l_2 / (2 J)", torque_limit, (1e-3, 1e-3, 0.05)),
    ClosedForm(
        f"3: {TRIANGLE}, in phase",
        "circular translation, L(Omega) = N c S^2 Omega^5 / |D|^2",
        of(lambda: circular(on_circle(1.5), 3e4, 900.0)),
        (2e-14, 2e-14, 4e-14),
    ),
    ClosedForm(f"4: {TRIANGLE}", "body at rest, Omega = no-load speed", of(at_rest), (2e-14, 2e-14, 4e-12)),
    ClosedForm(
        f"4: {TRIANGLE}, in phase, M l^2 = 4.84 J",
        "stable",
        of(lambda: circular(on_circle(1.1), 3e3, 300.0)),
        (2e-14, 2e-14, 4e-14),
    ),
    ClosedForm(
        f"4: {TRIANGLE}, in phase, M l^2 = 3.24 J",
        "unstable",
        of(lambda: circular(on_circle(0.9), 3e3, 300.0, stable=False, away=1e-3)),
        (2e-14, 2e-14, 0.0),
    ),
    ClosedForm(
        f"4: {TRIANGLE}, in phase, light rotors, M l^2 = 9 J",
        "least Lambda, but unstable",
        of(light_rotors),
        (2e-14, 2e-14, 0.0),
    ),
    ClosedForm(
        f"4: {LINE}, above the resonances",
        "outer ones in phase, middle one in antiphase",
        of(middle_opposes),
        (0.01, 0.01, 0.01),
    ),
    ClosedForm(
        f"4: {LINE}, below all resonances",
        "in phase",
        of(lambda: circular(on_line(-2.0, 0.0, 2.0), 8e6, 4000.0, 2.0)),
        (2e-14, 2e-14, 4e-13),
    ),
    ClosedForm(
        "5: one exciter below a resonance",
        "largest stall torque of a motor that the resonance catches",
        jam_limit,
        (1e-6, 1e-12, 0.05),
    ),
    ClosedForm(
        "6: two auto-balancers below the resonance of translation",
        "in phase, b R^2 (n - Omega) = 2 c S^2 Omega^5 / |D|^2",
        of(lambda: balancers(0.0)),
        (2e-14, 2e-14, 1e-10),
    ),
    ClosedForm(
        "6: two auto-balancers below the resonance of rotation",
        "in antiphase, b R^2 (n - Omega) = c l^2 S^2 Omega^5 / |D|^2",
        of(lambda: balancers(np.pi)),
        (2e-14, 4e-4, 4e-4),
    ),
)
"""Closed forms 1 to 6. The middle one of three on a line is in antiphase, except for the effect of the damping.

A deviation of the balancers from the motion in phase decays at a rate of only 0.05 1/s. The phase therefore contains the
rounding errors of the last 2000 steps, at angles of 1e4 rad: about 5e-11 rad, for any tolerance of the integration.
"""
