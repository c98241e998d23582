"""A body in a plane with two rotors against MuJoCo, which turns the body by a finite angle."""

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np

import jaxvib as jv

MASS, INERTIA = 200.0, 60.0
STIFFNESS, DAMPING = np.array([4e4, 8e4]), np.array([400.0, 800.0])
SUPPORTS, PLACES = ((-1.2, -0.2), (1.2, -0.2)), ((-0.4, 0.3), (0.5, 0.2))
SPEEDS = (60.0, -50.0)
STEP, END = 1e-4, 0.4


def by_mujoco(mass, radius, inertia):
    """Displacements of the body and absolute angles of the rotors at the end, from MuJoCo's own equations."""
    rotors = "".join(
        f'<body pos="{x} {y} 0"><joint type="hinge" axis="0 0 1"/>'
        f'<inertial pos="{radius} 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/></body>'
        for x, y in PLACES
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" gravity="0 0 0" integrator="RK4"/><worldbody><body>'
        '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="hinge" axis="0 0 1"/>'
        f'<inertial pos="0 0 0" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>{rotors}</body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qvel[3:] = SPEEDS

    def springs(_, data):
        """Forces of the supports, linear in the displacement of their points, on the body at its finite angle."""
        (x, y, psi), force = data.qpos[:3], np.zeros(3)
        c, s = np.cos(psi), np.sin(psi)
        for a, b in SUPPORTS:
            lever = np.array([[1.0, 0.0, -(s * a + c * b)], [0.0, 1.0, c * a - s * b]])
            moved = np.array([x + c * a - s * b - a, y + s * a + c * b - b])
            force -= lever.T @ (STIFFNESS * moved + DAMPING * (lever @ data.qvel[:3]))
        data.qfrc_applied[:3] = force

    mujoco.set_mjcb_control(springs)
    try:
        for _ in range(round(END / STEP)):
            mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_control(None)
    return np.array([*data.qpos[:3], *(data.qpos[3:] + data.qpos[2])])


def by_jaxvib(mass, radius, inertia):
    supports = [jv.support(at=at, stiffness=STIFFNESS.tolist(), damping=DAMPING.tolist()) for at in SUPPORTS]
    body = jv.plane_body(mass=MASS, inertia=INERTIA, supports=supports)
    drive = jv.SwitchedOff(jv.DCMotor(100.0, stall_torque=1.0, inertia=inertia + mass * radius**2))
    exciters = [
        jv.Exciter(drive=drive, unbalance=mass * radius, unbalance_mass=mass, at=at, direction=int(np.sign(speed)))
        for at, speed in zip(PLACES, SPEEDS, strict=True)
    ]
    scene = jv.Scene(body, exciters=exciters)
    rotors = [(jnp.asarray(0.0), jnp.asarray(speed)) for speed in SPEEDS]
    start = eqx.tree_at(lambda s: [each.rotor for each in s.exciters], jv.initial_state(scene), rotors)
    run = jv.simulate(scene, END, start=start, save="window", estimate=False, stepsize_controller=jv.Tolerance(1e-11))
    angles = [each.rotor[0][-1] for each in run.window.state.exciters]
    return np.array([*run.window.state.displacement[-1], *angles])


def test_difference_to_mujoco_falls_with_the_squared_rotation():
    """Half the unbalance halves the rotation of the body and leaves a quarter of the difference."""
    found = []
    for share in (1.0, 0.5):
        numbers = (4.0 * share, 0.05, 0.3 * share)
        exact, linear = by_mujoco(*numbers), by_jaxvib(*numbers)
        np.testing.assert_allclose(linear[:3], exact[:3], rtol=1e-3)
        found.append(np.linalg.norm((exact - linear)[[0, 1, 3, 4]]))
    assert 3.5 < found[0] / found[1] < 4.5
