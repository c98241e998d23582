"""Motion in time and exact jams, with the equations written out for every load; swings of pendulums."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from case import RPM, RUN, TWO_MASS, Linear, balls, case, linear, three, two
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve
from scipy.special import ellipj, ellipk

import jaxvib as jv


def field(model: Linear, own: np.ndarray, inertia: np.ndarray, drag: np.ndarray, speed: Callable[[float], float]):
    """Right-hand side in (q, v, phi, phi') with S_j = m_j R and I_j = kappa m_j R^2 (SI), drag in N m s."""
    nd, count = len(model.port), len(own)
    at = int(np.argmax(model.port))

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        q, v, phi, rate = np.split(y, [nd, 2 * nd, 2 * nd + count])
        matrix, right = np.zeros((nd + count, nd + count)), np.zeros(nd + count)
        matrix[:nd, :nd] = model.mass
        matrix[at, nd:] = matrix[nd:, at] = own * np.cos(phi)
        matrix[nd:, nd:] = np.diag(inertia)
        right[:nd] = -model.damping @ v - model.stiffness @ q
        right[at] += np.sum(own * np.sin(phi) * rate**2)
        right[nd:] = drag * (speed(t) - rate)
        change = np.linalg.solve(matrix, right)
        return np.concatenate([v, change[:nd], rate, change[nd:]])

    return rates


def field_of(scene: jv.Scene, speed: Callable[[float], float] | None = None):
    loads, one = scene.loads, np.ones(scene.loads.count)
    mass, radius, kappa = float(loads.mass) * one, float(loads.radius), 1.4
    n = float(scene.drive.speed)
    own = mass * radius
    drag = float(loads.drag) * radius**2 * one
    return field(linear(scene), own, kappa * own * radius, drag, speed or (lambda t: n))


def integrated(rates, y: np.ndarray, until: float, **options) -> np.ndarray:
    return solve_ivp(rates, (0.0, until), y, method="DOP853", rtol=1e-12, atol=1e-14, **options).y[:, -1]


def end_state(run: jv.Run) -> np.ndarray:
    last = jax.tree.map(lambda leaf: np.asarray(leaf)[-1], run.window.state)
    return np.concatenate([last.displacement, last.velocity, last.angle[0], last.rate[0]])


def compared(run: jv.Run, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Differences relative to the largest displacement, velocity, and 1 rad; the rotor speed for rates."""
    found = end_state(run)
    nd, count = run.window.state.displacement.shape[1], run.scene.loads.count
    kept = run.window.state
    sizes = [np.max(np.abs(x)) for x in (kept.displacement, kept.velocity)] + [1.0, float(run.scene.drive.speed)]
    scale = np.repeat(sizes, [nd, nd, count, count])
    return found / scale + 1.0, right / scale + 1.0


def started(scene: jv.Scene, angles) -> jv.State:
    return jv.initial_state(scene, "rest", angles=list(angles))


def flat(state: jv.State) -> np.ndarray:
    return np.concatenate([state.displacement, state.velocity, state.angle[0], state.rate[0]])


for _count in (1, 2, 3):

    @case(f"run of one mass with {_count} loads over 40 turns", RUN)
    def _(count=_count):
        machine = jv.one_mass(mass=60.0, stiffness=250e3, damping=120.0)
        scene = jv.Scene(machine, balls(0.3, count, 0.09, 0.8), jv.ConstantSpeed(100.0))
        start = started(scene, -1.5 + 0.7 * np.arange(count))
        return compared(jv.simulate(scene, 2.5, start=start), integrated(field_of(scene), flat(start), 2.5))


@case("run-up of the antiphase screen through its first resonance", RUN)
def _():
    scene = two(*list(TWO_MASS["antiphase screen"])[:5], **TWO_MASS["antiphase screen"][5])
    scene = eqx.tree_at(lambda s: s.drive, scene, jv.RunUp(150.0, 100.0))
    start = started(scene, [-1.5, -1.2, -0.9])
    right = integrated(field_of(scene, lambda t: min(100.0 * t, 150.0)), flat(start), 1.5)
    right = integrated(field_of(scene), right, 1.5)
    return compared(jv.simulate(scene, 3.0, start=start), right)


@case("run of three masses", RUN)
def _():
    scene = three(3)
    start = started(scene, [-1.5, -1.2, 0.9])
    return compared(jv.simulate(scene, 1.0, start=start), integrated(field_of(scene), flat(start), 1.0))


def shot(scene: jv.Scene, orbit: jv.Orbit) -> tuple[np.ndarray, np.ndarray]:
    """Rotor speed of the periodic motion at the orbit's load speed and its largest multiplier, by shooting."""
    w, at = float(orbit.omega), orbit.at(0.0)
    nd = len(linear(scene).port)
    first = np.concatenate([at[0], at[1], [0.0], np.asarray(at[3][0])[:1]])
    own = scene.loads.count * float(scene.loads.mass) * float(scene.loads.radius)
    model = linear(scene)
    inertia, turn = 1.4 * own * float(scene.loads.radius), 2.0 * np.pi / w

    def after(y: np.ndarray, n: float) -> np.ndarray:
        rates = field(model, np.array([own]), np.array([inertia]), np.array([model.drag]), lambda t: n)
        return integrated(rates, y, turn)

    def miss(x: np.ndarray) -> np.ndarray:
        y = np.concatenate([x[: 2 * nd], [0.0], x[2 * nd : -1]])
        return after(y, x[-1]) - y - np.concatenate([np.zeros(2 * nd), [2.0 * np.pi], [0.0]])

    guess = np.concatenate([np.delete(first, 2 * nd), [float(orbit.rotor_speed)]]) * (1.0 + 1e-3)
    found, _, ok, message = fsolve(miss, guess, xtol=1e-11, full_output=True)
    assert ok == 1 or np.max(np.abs(miss(found))) < 1e-9, message
    y, n = np.concatenate([found[: 2 * nd], [0.0], found[2 * nd : -1]]), found[-1]
    steps = 1e-6 * np.maximum(np.abs(y), 1e-3)
    columns = [(after(y + h * e, n) - after(y - h * e, n)) / (2.0 * h) for h, e in zip(steps, np.eye(len(y)), strict=True)]
    values = np.linalg.eigvals(np.array(columns).T)
    values = np.delete(values, np.argmin(np.abs(values - 1.0)))
    return np.array([float(orbit.rotor_speed), float(orbit.multiplier)]), np.array([n, np.max(np.abs(values))])


ORBITS = {
    "one mass below its resonance": (jv.one_mass(mass=60.0, stiffness=250e3, damping=120.0), 62.0),
    "one mass with a twentieth of it in the load": (jv.one_mass(mass=6.0, stiffness=25e3, damping=60.0), 60.0),
    "two masses near the second resonance": (
        jv.two_mass(mass=(60.0, 50.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0), 90.0,
    ),
}  # fmt: skip

for _name, (_machine, _omega) in ORBITS.items():

    @case(f"exact jam and its multiplier by shooting: {_name}", 1e-5)
    def _(machine=_machine, omega=_omega):
        scene = jv.Scene(machine, balls(0.3, 1, 0.09, 4.0), jv.ConstantSpeed(100.0))
        return shot(scene, jv.jam_orbit(scene, omega=omega))


@case("settled jam: amplitude and load speed after 150 s of SciPy", 1e-6)
def _():
    scene = jv.Scene(jv.one_mass(mass=60.0, stiffness=2.5e4, damping=300.0), balls(0.3, 1, 0.09, 0.2), jv.ConstantSpeed(24.0))
    run = jv.settle(scene, mode=1, drift=1e-9)
    rates, y = field_of(scene), flat(jv.initial_state(scene, "jam", mode=1))
    y = integrated(rates, y, 150.0)
    turn = 2.0 * np.pi / float(run.omega)
    out = solve_ivp(
        rates, (0.0, 3.0 * turn), y, method="DOP853", rtol=1e-12, atol=1e-14, max_step=turn / 500.0, dense_output=True
    )
    moved = out.sol(np.linspace(0.0, 3.0 * turn, 30_000))
    times = brentq(lambda t: out.sol(t)[2] - y[2] - 2.0 * np.pi, 0.5 * turn, 1.5 * turn, xtol=1e-15)
    return [run.amplitude[0], run.omega], [np.ptp(moved[0]) / 2.0, 2.0 * np.pi / times]


LIGHT = dict(mass=1e-7, radius=0.1)


def free(**machine) -> jv.Scene:
    """A machine whose loads are too light to matter."""
    return jv.Scene(jv.one_mass(**machine), balls(**LIGHT, drag=1e-7), jv.ConstantSpeed(20.0))


def released(scene: jv.Scene, displacement: float, velocity: float = 0.0) -> jv.State:
    change = ([displacement], [velocity])
    start = jv.initial_state(scene, "rest")
    return eqx.tree_at(lambda y: (y.displacement, y.velocity), start, tuple(np.array(x) for x in change))


@case("free decay of a damped platform", 1e-6)
def _():
    scene = free(mass=10.0, stiffness=4e3, damping=20.0)
    run = jv.simulate(scene, 3.0, start=released(scene, 0.01))
    t = np.asarray(run.trajectory.time)
    decay, w = 1.0, np.sqrt(400.0 - 1.0)
    right = 0.01 * np.exp(-decay * t) * (np.cos(w * t) + decay / w * np.sin(w * t))
    return np.asarray(run.trajectory.state.displacement)[:, 0] + 0.02, right + 0.02


@case("a ball on a heavy platform approaches the rotor speed exponentially", 1e-6)
def _():
    scene = jv.Scene(jv.one_mass(mass=1e9, stiffness=1e12, damping=0.0), balls(0.5, 1, 0.1, 2.0), jv.ConstantSpeed(60.0))
    run = jv.simulate(scene, 2.0)
    t = np.asarray(run.trajectory.time)
    return np.asarray(run.trajectory.state.rate[0])[1:, 0], 60.0 * (1.0 - np.exp(-2.0 / (1.4 * 0.5) * t[1:]))


def unbalanced(r: float) -> tuple[jv.Scene, float]:
    natural = np.sqrt(4e3 / 10.0)
    machine = jv.one_mass(mass=10.0, stiffness=4e3, damping=20.0)
    return jv.Scene(machine, balls(**LIGHT, drag=1e-7), jv.ConstantSpeed(r * natural), (jv.StaticImbalance("5 g m"),)), r


for _ratio in (0.7, 1.0, 2.5):

    @case(f"unbalance response and transmitted force at {_ratio} of the natural frequency (Rao)", 1e-5)
    def _(ratio=_ratio):
        scene, r = unbalanced(ratio)
        run = jv.settle(scene, drift=1e-8)
        zeta = 20.0 / (2.0 * np.sqrt(4e3 * 10.0))
        size = 0.005 / 10.0 * r**2 / np.hypot(1.0 - r**2, 2.0 * zeta * r)
        return [run.amplitude[0], run.foundation_force], [size, 4e3 * size * np.hypot(1.0, 2.0 * zeta * r)]


@case("free vibration on a cubic support (Duffing): Jacobi's elliptic cosine", 1e-6)
def _():
    machine = jv.one_mass(mass=10.0, stiffness=4e3, damping=0.0)
    scene = jv.Scene(machine, balls(**LIGHT, drag=1e-7), jv.ConstantSpeed(20.0), (jv.CubicSupport(4e7),))
    run = jv.simulate(scene, 1.0, start=released(scene, 0.02))
    t, size = np.asarray(run.trajectory.time), 0.02
    w = np.sqrt(400.0 + 4e6 * size**2)
    modulus = 4e6 * size**2 / (2.0 * w**2)
    return np.asarray(run.trajectory.state.displacement)[:, 0] + 2.0 * size, size * ellipj(w * t, modulus)[1] + 2.0 * size


@case("a DC motor with a bare rotor runs up exponentially", 1e-6)
def _():
    motor = jv.DCMotor("3000 rpm", stall_torque=2.0, inertia=0.02)
    scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0), balls(**LIGHT, drag=1e-9), motor)
    run = jv.simulate(scene, 3.0)
    t, top = np.asarray(run.trajectory.time)[1:], 3000 * RPM
    return np.asarray(run.trajectory.rotor_speed)[1:], top * (1.0 - np.exp(-2.0 / (0.02 * top) * t))


@case("an induction motor by Kloss's formula: time to 90 % of its speed", 1e-5)
def _():
    motor = jv.InductionMotor("1500 rpm", breakdown_torque=12.0, breakdown_slip=0.2, inertia=0.1)
    scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0), balls(**LIGHT, drag=1e-9), motor)
    run = jv.simulate(scene, 4.0)
    speed = np.asarray(run.trajectory.rotor_speed)
    when = np.interp(0.9 * 1500 * RPM, speed[: np.argmax(speed) + 1], np.asarray(run.trajectory.time)[: np.argmax(speed) + 1])
    # J n ds / (2 T_b s s_b) (s^2 + s_b^2), from s = 1 to 0.1
    right = 0.1 * 1500 * RPM / (2.0 * 12.0 * 0.2) * ((1.0 - 0.1**2) / 2.0 + 0.2**2 * np.log(10.0))
    return [when], [right]


@case("energy of an undamped machine with three loads without drag", 1e-8)
def _():
    machine = jv.two_mass(mass=(12.0, 9.0), stiffness=(5e3, 5e3), damping=(0.0, 0.0), link_stiffness=2e4, link_damping=0.0)
    scene = jv.Scene(machine, jv.balls(count=3, mass=0.4, radius=0.1, drag=0.0), jv.ConstantSpeed(50.0))
    start = started(scene, [0.0, 0.5, 1.7])
    start = eqx.tree_at(lambda y: y.rate, start, (np.array([30.0, 34.0, 27.0]),))
    run = jv.simulate(scene, 5.0, start=start, stepsize_controller=jv.Tolerance(1e-12))
    last = jax.tree.map(lambda leaf: leaf[-1], run.trajectory.state)
    return [jv.energy(scene, last)], [jv.energy(scene, start)]


# Pendulums on bearings

ROD = dict(mass=0.3, length=0.25, inertia=0.00625)
INERTIA = 0.3 * 0.25**2 + 0.00625


for _degrees in (5.0, 60.0, 150.0):

    @case(f"period of a pendulum that swings by {_degrees:g} degrees (elliptic integral)", 1e-6)
    def _(degrees=_degrees):
        w = np.sqrt(0.3 * 9.81 * 0.25 / INERTIA)
        period = 4.0 / w * ellipk(np.sin(np.radians(degrees) / 2.0) ** 2)
        pendulum = jv.BearingPendulum(**ROD, g=9.81)
        found = jv.swing(pendulum, np.array([0.0, period / 4.0, period]), angle=np.radians(degrees), viscous=0.0)
        size = np.radians(degrees)
        return 1.0 + np.asarray(found.angle) / size, [2.0, 1.0, 2.0]


@case("damped swing against SciPy", RUN)
def _():
    t = np.linspace(0.0, 20.0, 50)
    found = jv.swing(jv.BearingPendulum(**ROD, g=9.81), t, angle=1.2, viscous=1.5e-3)
    out = solve_ivp(
        lambda _, y: [y[1], -(0.3 * 9.81 * 0.25 * np.sin(y[0]) + 1.5e-3 * y[1]) / INERTIA],
        (0.0, 20.0), [1.2, 0.0], t_eval=t, method="DOP853", rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    return np.asarray(found.angle) + 1.2, out.y[0] + 1.2


@case("dry friction takes the same angle off every half swing", 1e-3)
def _():
    torque = 0.005 * 0.3 * 9.81 * 0.02 / 2.0
    size = 0.05
    w = np.sqrt(0.3 * 9.81 * 0.25 / INERTIA)
    found = jv.swing(
        jv.BearingPendulum(**ROD, bearing=0.02, g=9.81), np.array([0.0, 10.0 * np.pi / w]), angle=size, viscous=0.0, dry=0.005
    )
    return [found.angle[-1]], [size - 10.0 * 2.0 * torque / (0.3 * 9.81 * 0.25)]
