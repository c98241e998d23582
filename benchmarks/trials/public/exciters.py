"""Unbalances on motors, screens, isolation, balancing in time, and swings that identify a bearing."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from case import RUN, case
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar

import jaxvib as jv

G = 9.80665

MASS, STIFFNESS, DAMPING, UNBALANCE = 200.0, 8e5, 600.0, 0.2


def platform(drive: jv.Drive, unbalance: float = UNBALANCE, damping: float = DAMPING) -> jv.Scene:
    machine = jv.one_mass(mass=MASS, stiffness=STIFFNESS, damping=damping)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=unbalance)])


def displacement(w: np.ndarray, damping: float = DAMPING) -> np.ndarray:
    """Amplitude of the platform at unbalance speeds."""
    return w**2 * UNBALANCE / (STIFFNESS - w**2 * MASS + 1j * w * damping)


def vibration_torque(w: np.ndarray) -> np.ndarray:
    """Mean power that the damper takes, divided by the speed."""
    return DAMPING * w * np.abs(displacement(w)) ** 2 / 2.0


def crossings(f: Callable[[float], float], low: float, high: float, count: int = 200_001) -> np.ndarray:
    grid = np.linspace(low, high, count)
    values = np.array([f(x) for x in grid])
    places = np.nonzero(np.sign(values[1:]) != np.sign(values[:-1]))[0]
    return np.array([brentq(f, grid[k], grid[k + 1], xtol=1e-14) for k in places])


# Response to an unbalance


@case("amplitude, phase, torque and transmitted force of an unbalanced machine over the speed")
def _():
    w = np.array([20.0, 50.0, 63.0, 63.5, 80.0, 150.0])
    found, y = jv.response(platform(jv.ConstantSpeed(100.0)), w), displacement(w)
    right = [np.abs(y), np.angle(-1j * y), vibration_torque(w), np.abs((STIFFNESS + 1j * w * DAMPING) * y)]
    return [found.amplitude[:, 0], found.phase[:, 0], found.torque[:, 0], found.foundation_force], right


@case("transmissibility crosses 1 at sqrt 2 times the natural frequency, whatever the damping (Den Hartog)")
def _():
    w = np.sqrt(2.0 * STIFFNESS / MASS)
    damped = [platform(jv.ConstantSpeed(100.0), damping=b) for b in (100.0, 1000.0, 8000.0)]
    return [jv.response(scene, w).transmissibility for scene in damped], np.ones((3, 1))


@case("data sheet: stroke, g, velocity, loads on the springs and shaft power of a vibrating platform")
def _():
    scene, w = platform(jv.ConstantSpeed(100.0)), 100.0
    found, y = jv.vibration_measures(scene, jv.response(scene, w).vibration()), displacement(w)
    right = [2.0 * abs(y), w**2 * abs(y) / G, w * abs(y) / np.sqrt(2.0), abs((STIFFNESS + 1j * w * DAMPING) * y), MASS * G]
    power = vibration_torque(w) * w
    values = [found.stroke[0], found.acceleration[0], found.velocity[0], found.dynamic_load[0], found.static_load[0]]
    return [*values, found.power[0]], [*right, power]


@case("a tuned absorber stops the excited platform (Frahm)", 1e-6)
def _():
    machine = jv.two_mass(mass=(12.0, 80.0), stiffness=(0.0, 3e5), damping=(0.0, 0.0), link_stiffness=4.8e4, link_damping=0.0)
    scene, w = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.05)]), np.sqrt(4.8e4 / 12.0)
    found = jv.response(scene, [0.7 * w, w]).amplitude
    stiff = np.array([[4.8e4 - 0.49 * w**2 * 12.0, -4.8e4], [-4.8e4, 3.48e5 - 0.49 * w**2 * 80.0]])
    below = np.abs(np.linalg.solve(stiff, [0.0, 0.05 * 0.49 * w**2]))
    at = 0.05 * w**2 / 4.8e4  # the absorber's spring balances the exciter's force
    return [*found[0], found[1, 0], 1.0 + found[1, 1]], [*below, at, 1.0]


# The Sommerfeld effect: motors at the resonance


MOTORS = {
    "DC motor": (lambda torque: jv.DCMotor(150.0, stall_torque=torque, inertia=0.1), lambda w: 1.0 - w / 150.0, 12.0),
    "induction motor": (
        lambda torque: jv.InductionMotor(100.0, breakdown_torque=torque, breakdown_slip=0.3, inertia=0.1),
        lambda w: 2.0 * 0.3 * (1.0 - w / 100.0) / ((1.0 - w / 100.0) ** 2 + 0.09),
        8.0,
    ),
}

for _name, (_motor, _share, _torque) in MOTORS.items():

    @case(f"Sommerfeld effect: speeds at which a {_name} can turn", 1e-8)
    def _(motor=_motor, share=_share, torque=_torque):
        points = jv.response(platform(motor(torque))).operating
        return np.sort(points.speed[points.exists]), crossings(lambda w: torque * share(w) - vibration_torque(w), 1.0, 149.99)

    @case(f"Sommerfeld effect: the torque at which a resonance releases a {_name}", 1e-7)
    def _(motor=_motor, share=_share, torque=_torque):
        scene = platform(motor(torque))
        natural = np.sqrt(STIFFNESS / MASS)
        peak = minimize_scalar(
            lambda w: -vibration_torque(w) / share(w), bounds=(0.9 * natural, 1.1 * natural), method="bounded",
            options={"xatol": 1e-10},
        )  # fmt: skip
        return [np.max(jv.response(scene).folds.factor)], [-peak.fun / torque]


def motor_run(scene: jv.Scene, torque: Callable[[float], float], inertia: float, until: float) -> tuple:
    """State of a platform and its motor at the end, computed and by SciPy. The unbalance adds no mass."""
    machine = scene.machine
    m, c, k = (float(x[0]) for x in (machine.mass, machine.damping, machine.stiffness))
    start = jv.initial_state(scene)
    run = jv.simulate(scene, until, start=start, stepsize_controller=jv.Tolerance(1e-11))

    def rates(t: float, y: np.ndarray) -> list[float]:
        q, v, a, w = y
        s, o = UNBALANCE * np.cos(a), UNBALANCE * np.sin(a)
        right = [-c * v - k * q + o * w**2, torque(w)]
        matrix = np.array([[m, s], [s, inertia]])  # T = (m v^2 + J w^2) / 2 + S v w cos a
        return [v, np.linalg.solve(matrix, right)[0], w, np.linalg.solve(matrix, right)[1]]

    begin = [0.0, 0.0, float(start.exciters[0].rotor[0]), 0.0]
    out = solve_ivp(rates, (0.0, until), begin, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    state = jax.tree.map(lambda leaf: leaf[-1], run.trajectory.state)
    found = [state.displacement[0], state.velocity[0], *state.exciters[0].rotor[:2]]
    scale = np.array([1e-3, 0.1, 1.0, 1.0])
    return np.array(found) / scale + 10.0, out / scale + 10.0


for _name, (_torque, _fate) in {"weak": (8.0, "is caught by"), "strong": (40.0, "passes")}.items():

    @case(f"start of a {_name} DC motor, which {_fate} the resonance, by the full equations", 1e-5)
    def _(torque=_torque):
        scene = platform(jv.DCMotor(150.0, stall_torque=torque, inertia=0.1))
        return motor_run(scene, lambda w: torque * (1.0 - w / 150.0), 0.1, 3.0)


@case("start of an induction motor on a soft machine by the full equations", 1e-5)
def _():
    slip = 0.3
    scene = platform(jv.InductionMotor(100.0, breakdown_torque=30.0, breakdown_slip=slip, inertia=0.1))
    return motor_run(scene, lambda w: 60.0 * slip * (1.0 - w / 100.0) / ((1.0 - w / 100.0) ** 2 + slip**2), 0.1, 3.0)


@case("a DC motor with inductance starts as a damped oscillator", RUN)
def _():
    motor = jv.DCMotorElectrical(24.0, 0.6, torque_constant=0.08, inertia=0.002, inductance=0.02)
    scene = jv.Scene(jv.one_mass(mass=1e9, stiffness=1e12, damping=0.0), exciters=[jv.Exciter(drive=motor, unbalance=1e-9)])
    run = jv.simulate(scene, 0.2)
    t = np.asarray(run.trajectory.time)[1:]
    # L J w'' + R J w' + K^2 w = K V from rest
    roots = np.roots([0.02 * 0.002, 0.6 * 0.002, 0.08**2]).astype(complex)
    share = roots[::-1] / (roots[::-1] - roots)
    right = 24.0 / 0.08 * (1.0 - np.sum(share[:, None] * np.exp(roots[:, None] * t), axis=0).real)
    return np.asarray(run.trajectory.rotor_speed)[1:], right


# Screens


def soft_screen(ways: tuple[int, ...], places: tuple[tuple[float, float], ...], inertia: float) -> jv.Scene:
    """A body of 1000 kg on springs that are too soft to matter."""
    springs = [jv.support(at=(x, 0.0), stiffness=(1.0, 1.0), damping=(0.1, 0.1)) for x in (-1.0, 1.0)]
    motor = jv.DCMotor(100.0, stall_torque=100.0, inertia=0.5)
    ends = zip(places, ways, strict=True)
    exciters = [jv.Exciter(drive=motor, unbalance=1.0, at=place, direction=way) for place, way in ends]
    return jv.Scene(jv.plane_body(mass=1000.0, inertia=inertia, supports=springs), exciters=exciters)


for _inertia, _phase in ((100.0, 0.0), (800.0, np.pi)):

    @case(f"two unbalances that turn alike, J {_inertia:g}: in phase if M a^2 is above 2 J (Blekhman)", 1e-5)
    def _(inertia=_inertia, phase=_phase):
        found = jv.working_regime(soft_screen((1, 1), ((-0.8, 0.0), (0.8, 0.0)), inertia))
        assert (2.0 * inertia < 1000.0 * 0.8**2) == (phase == 0.0)
        return [1.0 + abs(np.cos((float(found.phases[1]) - phase) / 2.0))], [2.0]


@case("two unbalances that turn against each other throw a screen along a line: stroke and direction", 1e-4)
def _():
    found = jv.working_regime(soft_screen((1, -1), ((-0.4, 0.3), (0.4, 0.3)), 400.0))
    path, w = found.ellipse((0.0, 0.0)), float(found.speed)
    # the line of the force passes through the centre of mass; without springs x = 2 S / M
    return [path.semi_major, abs(np.sin(path.direction)), 1.0 + path.semi_minor, w], [2.0 / 1000.0, 1.0, 1.0, 100.0]


@case("one unbalance outside the centre of mass of a free body: ellipse of any point", 1e-4)
def _():
    a, j, at = 0.5, 300.0, np.array([0.9, -0.2])
    scene = soft_screen((1,), ((0.0, a),), j)
    found = jv.working_regime(scene)
    path = found.ellipse(at)
    # force S w^2 (cos, sin), moment -a S w^2 cos; free body: displacement -F / (M w^2), rotation a S cos / J
    turn = a / j
    t = np.linspace(0.0, 2.0 * np.pi, 100_001)
    x = -np.cos(t) / 1000.0 - at[1] * turn * np.cos(t)
    y = -np.sin(t) / 1000.0 + at[0] * turn * np.cos(t)
    size = np.hypot(x, y)
    return [path.semi_major, abs(path.semi_minor)], [np.max(size), np.min(size)]


@case("throw number of a feeder: A w^2 sin(b) / (g cos(a))", 1e-4)
def _():
    found = jv.working_regime(soft_screen((1, -1), ((-0.4, 0.3), (0.4, 0.3)), 400.0))
    slope, w = np.radians(-10.0), 100.0
    right = 2.0 / 1000.0 * w**2 * np.cos(slope) / (G * np.cos(slope))
    return [found.ellipse((0.0, 0.0), slope="-10 deg").throw_number], [right]


# Other structures


@case("cantilever of twenty beam elements: its first three natural frequencies (Euler and Bernoulli)", 2e-5)
def _():
    count, length, rigidity, line = 20, 1.0, 500.0, 4.0
    h = length / count
    k = rigidity / h**3 * np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2],
                                    [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2]])  # fmt: skip
    m = line * h / 420 * np.array([[156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2],
                                   [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2]])  # fmt: skip
    mass, stiffness = np.zeros((2, 2 * count + 2, 2 * count + 2))
    for e in range(count):
        part = slice(2 * e, 2 * e + 4)
        mass[part, part] += m
        stiffness[part, part] += k
    mass, stiffness = mass[2:, 2:], stiffness[2:, 2:]
    machine = jv.from_matrices(mass, np.zeros_like(mass), stiffness, places=[[2 * count - 2]])
    found = jv.natural_frequencies(jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(10.0), unbalance=1e-9)]))
    roots = crossings(lambda x: np.cos(x) + 1.0 / np.cosh(x), 0.5, 9.0, 2001)
    return found[:3], roots**2 / length**2 * np.sqrt(rigidity / line)


@case("a mass against a stop on one side: half a period of each spring", 1e-6)
def _():
    soft, hard, m = 2e3, 3e4, 5.0
    machine = jv.one_mass(mass=m, stiffness=soft, damping=0.0)
    effects = (jv.Stop(hard, gap=0.0, side="below"),)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(1.0), unbalance=1e-12)], effects=effects)
    start = eqx.tree_at(lambda y: y.displacement, jv.initial_state(scene), np.array([0.01]))
    period = np.pi * (np.sqrt(m / soft) + np.sqrt(m / (soft + hard)))
    run = jv.simulate(scene, 10.25 * period, start=start, stepsize_controller=jv.Tolerance(1e-10))
    t, y = np.asarray(run.trajectory.time), np.asarray(run.trajectory.state.displacement)[:, 0]
    high, below = np.pi / 2.0 * np.sqrt(m / soft), np.pi * np.sqrt(m / (soft + hard))
    phase = np.mod(t, period)  # down in a quarter of one period, below for half of the other, and up again
    above = 0.01 * np.where(phase < high, np.cos(phase * np.sqrt(soft / m)), np.cos((period - phase) * np.sqrt(soft / m)))
    inside = (phase > high) & (phase < high + below)
    deep = -0.01 * np.sqrt(soft / (soft + hard)) * np.sin((phase - high) * np.sqrt((soft + hard) / m))
    return 2.0 + y / 0.01, 2.0 + np.where(inside, deep, above) / 0.01


@case("poles of a damped two-mass machine at rest (state space)", 1e-8)
def _():
    machine = jv.two_mass(mass=(12.0, 9.0), stiffness=(5e3, 7e3), damping=(20.0, 35.0), link_stiffness=2e4, link_damping=15.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(50.0))
    m, c, k = np.diag([12.0, 10.0]), np.array([[35.0, -15.0], [-15.0, 50.0]]), np.array([[2.5e4, -2e4], [-2e4, 2.7e4]])
    right = np.linalg.eigvals(np.vstack([np.eye(2, 4, 2), -np.linalg.solve(m, np.hstack([k, c]))]))
    found = np.linalg.eigvals(np.asarray(jv.state_space(scene).A))
    order = [np.lexsort((x.real, x.imag)) for x in (found, right)]
    both = [x[k] for x, k in zip((found, right), order, strict=True)]
    return tuple(np.concatenate([x.real, x.imag]) for x in both)


# Automatic balancing


@case("two balls balance a rotor above its critical speed: their path by the equations of Lagrange", RUN)
def _():
    m, k, c, e, n = 25.0, 5e5, 300.0, 0.06, 300.0
    ball, radius, drag = 0.5, 0.1, 4.0
    rotor = jv.planar_rotor(mass=m, stiffness=k, damping=c)
    loads = jv.balls(count=2, mass=ball, radius=radius, drag=drag)
    scene = jv.Scene(rotor, loads, jv.ConstantSpeed(n), (jv.StaticImbalance(e),))
    start = jv.initial_state(scene, "rest", angles=[0.3, 2.0])
    until = 0.5
    run = jv.simulate(scene, until, start=start, stepsize_controller=jv.Tolerance(1e-11))
    own, inertia = ball * radius, 1.4 * ball * radius**2

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        q, v, phi, rate = y[:2], y[2:4], y[4:6], y[6:8]
        matrix = np.diag([m + 2.0 * ball, m + 2.0 * ball, inertia, inertia])
        matrix[0, 2:] = matrix[2:, 0] = -own * np.sin(phi)
        matrix[1, 2:] = matrix[2:, 1] = own * np.cos(phi)
        push = e * n**2 * np.array([np.cos(n * t), np.sin(n * t)])
        pull = own * np.array([np.cos(phi) @ rate**2, np.sin(phi) @ rate**2])
        right = np.concatenate([push + pull - k * q - c * v, drag * radius**2 * (n - rate)])
        change = np.linalg.solve(matrix, right)
        return np.concatenate([v, change[:2], rate, change[2:]])

    begin = np.concatenate([start.displacement, start.velocity, start.angle[0], start.rate[0]])
    end = solve_ivp(rates, (0.0, until), begin, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    state = jax.tree.map(lambda leaf: leaf[-1], run.trajectory.state)
    # the coordinates of the rotor may have another order or sign: compare its distance and speed
    found = [np.hypot(*state.displacement), np.hypot(*state.velocity), *(np.asarray(state.angle[0]) - n * until)]
    right = [np.hypot(*end[:2]), np.hypot(*end[2:4]), *(end[4:6] - n * until)]
    scale = np.array([1e-3, 0.1, 1.0, 1.0])
    return np.array(found) / scale + 10.0, np.array(right) / scale + 10.0


@case("a steel ball of 40 mm weighs 263 g")
def _():
    return [jv.ball_mass(0.02)], [7850.0 * 4.0 / 3.0 * np.pi * 0.02**3]


# Identification of a bearing from a swing


def recorded(viscous: float, dry: float) -> tuple[jv.BearingPendulum, jv.Record]:
    """The record of a pendulum by SciPy, from one turning point to the next; the dry torque is dry |N| d / 2."""
    mass, arm, inertia, bearing = 0.3, 0.25, 0.025, 0.02
    times, angle, begun, now = np.arange(0.0, 25.0, 0.02), [], 0.0, 0.3

    def rates(t: float, y: np.ndarray, way: float) -> list[float]:
        f, v = y
        torque, along, turn = -mass * 9.81 * arm * np.sin(f) - viscous * v, mass * (9.81 * np.cos(f) + arm * v**2), 0.0
        for _ in range(10):  # the normal force depends on the acceleration
            force = np.hypot(along, mass * (9.81 * np.sin(f) + arm * turn))
            turn = (torque - way * dry * bearing / 2.0 * force) / inertia
        return [v, turn]

    def turning(t: float, y: np.ndarray, way: float) -> float:
        return y[1] if t > begun + 0.1 else way

    turning.terminal = True
    while begun < times[-1]:
        how = dict(method="DOP853", rtol=1e-11, atol=1e-13, args=(-np.sign(now),), events=turning, dense_output=True)
        out = solve_ivp(rates, (begun, begun + 2.0), [now, 0.0], **how)
        inside = (times >= begun) & (times < out.t[-1])
        angle.append(out.sol(times[inside])[0])
        begun, now = out.t[-1], out.y[0, -1]
    noise = 1e-4 * np.random.default_rng(0).normal(size=times.size)
    pendulum = jv.BearingPendulum(mass=mass, length=arm, inertia=0.00625, bearing=bearing, g=9.81)
    return pendulum, jv.Record(times, np.concatenate(angle) + noise)


@case("ten periods of a recorded swing: the viscous coefficient (Artyunin)", 5e-3)
def _():
    return [jv.ten_periods(*recorded(1.5e-3, 0.0)).viscous.value], [1.5e-3]


@case("a whole recorded swing: viscous and dry coefficients of a bearing", 2e-2)
def _():
    found = jv.identify(*recorded(1.2e-3, 0.01), dry=True)
    return [found.viscous.value, found.dry.value], [1.2e-3, 0.01]
