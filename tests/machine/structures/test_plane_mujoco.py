"""Bodies in a plane with exciters against MuJoCo, which turns the bodies by finite angles."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxvib as jv

STEP, END = 1e-4, 0.4


class Spring(NamedTuple):
    """Arguments of `jv.support`."""

    at: tuple[float, float]
    stiffness: tuple[float, float] = (4e4, 8e4)
    damping: tuple[float, float] = (400.0, 800.0)
    angle: float = 0.0
    body: int = 0
    to: int | None = None
    at_other: tuple[float, float] | None = None


class Turning(NamedTuple):
    """Unbalance, or pendulum under an ideal drive, at a point of a body; `speed` at the start, rad/s, is signed.

    `stall`: torque of a motor without speed, N m; its working speed is 60 rad/s. `drag`, N s/m, of a pendulum relative to a
    rotor that turns at 55 rad/s in the direction of `speed`.
    """

    at: tuple[float, float]
    speed: float
    body: int = 0
    angle: float = 0.0
    stall: float = 0.0
    drag: float = 0.0
    mass: float = 4.0
    radius: float = 0.05
    inertia: float = 0.3


WORKING, IDEAL = 60.0, 55.0

MACHINES = {
    "one body": (
        [(200.0, 60.0)],
        [Spring((-1.2, -0.2)), Spring((1.2, -0.2))],
        [Turning((-0.4, 0.3), 60.0), Turning((0.5, 0.2), -50.0)],
    ),
    "two bodies with motors": (
        [(200.0, 60.0), (90.0, 30.0)],
        [
            *(Spring((x, -0.2), (2e4, 4e4), body=1) for x in (-1.2, 1.2)),
            *(Spring((x, -0.3), (4e4, 9e4), angle=0.3, to=1, at_other=(x, 0.2)) for x in (-0.9, 1.0)),
        ],
        [
            Turning((-0.4, 0.3), 45.0, stall=20.0),
            Turning((0.5, 0.2), -40.0, stall=30.0),
            Turning((0.3, -0.1), 50.0, body=1, stall=15.0, mass=2.0),
        ],
    ),
    "inclined springs and auto-balancer": (
        [(200.0, 60.0)],
        [Spring((-1.2, -0.2), angle=0.4), Spring((1.1, -0.3), (6e4, 3e4), angle=-0.5)],
        [
            Turning((-0.4, 0.3), 50.0, stall=20.0),
            *(Turning((0.5, 0.2), -45.0, angle=a, drag=6.0, mass=2.0, inertia=0.02, radius=0.1) for a in (0.5, 2.0)),
        ],
    ),
}


def by_mujoco(bodies, springs, turning, share):
    """Displacements of the bodies and absolute angles of the rotors and loads at the end, from MuJoCo's own equations."""
    texts = []
    for number, (mass, inertia) in enumerate(bodies):
        own = "".join(
            f'<body pos="{t.at[0]} {t.at[1]} 0"><joint name="turning{k}" type="hinge" axis="0 0 1"/>'
            f'<inertial pos="{t.radius} 0 0" mass="{t.mass * share}" '
            f'diaginertia="{t.inertia * share} {t.inertia * share} {t.inertia * share}"/></body>'
            for k, t in enumerate(turning)
            if t.body == number
        )
        texts.append(
            f'<body><joint name="body{number}" type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
            f'<joint type="hinge" axis="0 0 1"/>'
            f'<inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>{own}</body>'
        )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" gravity="0 0 0" integrator="RK4"/><worldbody>{"".join(texts)}</worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    of_bodies = [model.joint(f"body{k}").dofadr[0] for k in range(len(bodies))]
    of_turning = [model.joint(f"turning{k}").dofadr[0] for k in range(len(turning))]
    for dof, t in zip(of_turning, turning, strict=True):
        data.qpos[dof], data.qvel[dof] = t.angle, t.speed

    def moved(data, at, body):
        """Displacement of a point of a body at its finite angle, and its derivatives by the body's coordinates."""
        x, y, psi = data.qpos[of_bodies[body] :][:3]
        (a, b), c, s = at, np.cos(psi), np.sin(psi)
        lever = np.array([[1.0, 0.0, -(s * a + c * b)], [0.0, 1.0, c * a - s * b]])
        return np.array([x + c * a - s * b - a, y + s * a + c * b - b]), lever

    def forces(_, data):
        """Forces of the springs, linear in the displacements of their points, and torques of motors and drags."""
        force = np.zeros(model.nv)
        for spring in springs:
            ends = [(spring.at, spring.body, 1.0)]
            ends += [] if spring.to is None else [(spring.at_other, spring.to, -1.0)]
            turned = np.array([[np.cos(spring.angle), np.sin(spring.angle)], [-np.sin(spring.angle), np.cos(spring.angle)]])
            found = [(sign, of_bodies[body], *moved(data, at, body)) for at, body, sign in ends]
            u = turned @ sum(sign * way for sign, _, way, _ in found)
            v = turned @ sum(sign * lever @ data.qvel[dof : dof + 3] for sign, dof, _, lever in found)
            pull = turned.T @ (np.array(spring.stiffness) * u + np.array(spring.damping) * v)
            for sign, dof, _, lever in found:
                force[dof : dof + 3] -= sign * lever.T @ pull
        for dof, t in zip(of_turning, turning, strict=True):
            way, rate = np.sign(t.speed), data.qvel[dof]  # relative to the body
            if t.drag:
                force[dof] = share * t.drag * t.radius**2 * (way * IDEAL - rate - data.qvel[of_bodies[t.body] + 2])
            else:
                force[dof] = share * t.stall * (way - rate / WORKING)
        data.qfrc_applied[:] = force

    mujoco.set_mjcb_control(forces)
    try:
        for _ in range(round(END / STEP)):
            mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_control(None)
    q = np.concatenate([data.qpos[dof : dof + 3] for dof in of_bodies])
    return q, np.array([data.qpos[d] + data.qpos[of_bodies[t.body] + 2] for d, t in zip(of_turning, turning, strict=True)])


def by_jaxvib(bodies, springs, turning, share):
    supports = [jv.support(**spring._asdict()) for spring in springs]
    if len(bodies) == 1:
        machine = jv.plane_body(mass=bodies[0][0], inertia=bodies[0][1], supports=supports)
    else:
        machine = jv.plane_network([jv.body(mass=m, inertia=j) for m, j in bodies], supports)
    exciters, states = [], []
    for t in turning:
        place = {"at": t.at, "body": t.body, "direction": int(np.sign(t.speed))}
        if not t.drag:
            about_axis = share * (t.inertia + t.mass * t.radius**2)
            motor = jv.DCMotor(WORKING, stall_torque=share * max(t.stall, 1e-9), inertia=about_axis)
            numbers = {"unbalance": share * t.mass * t.radius, "unbalance_mass": share * t.mass}
            exciters.append(jv.Exciter(drive=motor if t.stall else jv.SwitchedOff(motor), **numbers, **place))
            states.append(jv.ExciterState(rotor=(jnp.asarray(t.angle), jnp.asarray(t.speed))))
    loads = [t for t in turning if t.drag]
    if loads:
        t = loads[0]
        numbers = {"mass": share * t.mass, "radius": t.radius, "inertia": share * t.inertia, "drag": share * t.drag}
        pendulums = jv.pendulums(count=len(loads), **numbers)
        place = {"at": t.at, "body": t.body, "direction": int(np.sign(t.speed))}
        exciters.append(jv.Exciter(pendulums, jv.ConstantSpeed(IDEAL), **place))
        angle, rate = (jnp.array([getattr(t, name) for t in loads]) for name in ("angle", "speed"))
        states.append(jv.ExciterState(angle=(angle,), rate=(rate,)))
    scene = jv.Scene(machine, exciters=exciters)
    start = eqx.tree_at(lambda s: s.exciters, jv.initial_state(scene), tuple(states))
    run = jv.simulate(scene, END, start=start, save="window", estimate=False, stepsize_controller=jv.Tolerance(1e-11))
    ends = run.window.state
    angles = [own.angle[0][-1] if own.angle else own.rotor[0][-1:] for own in ends.exciters]
    return np.asarray(ends.displacement[-1]), np.concatenate(angles)


@pytest.mark.parametrize(
    "name", ["one body", pytest.param("two bodies with motors", marks=pytest.mark.slow), "inclined springs and auto-balancer"]
)
def test_difference_to_mujoco_falls_with_the_squared_rotation(name):
    """Half the unbalance halves the rotation of the body and leaves a quarter of the difference."""
    away = []
    for share in (1.0, 0.5):
        (q, angles), (linear, turned) = by_mujoco(*MACHINES[name], share), by_jaxvib(*MACHINES[name], share)
        np.testing.assert_allclose(linear, q, rtol=2e-3, atol=2e-3 * np.max(np.abs(q)))
        np.testing.assert_allclose(turned, angles, rtol=1e-4)
        way = np.delete(np.arange(q.size), np.arange(2, q.size, 3))
        away.append(np.linalg.norm(np.append((linear - q)[way], turned - angles)))
    assert 3.5 < away[0] / away[1] < 4.5
