"""Rotors, motors and effects in the equations of motion, against an independent derivation and the energy balance."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.motion.system import PackedSystem

STATIONS = (0.28, 0.25, -0.25, -0.28)
MASS, ECCENTRICITY, LEAN, GAMMA = 37.0, 2.2e-4, 3e-4, 0.7


def machine(stations=STATIONS, **change):
    numbers = dict(
        mass=MASS,
        transverse_inertia=0.479,
        polar_inertia=0.093,
        stiffness=(0.604e6, 0.555e6),
        damping=(430.0, 410.0),
        position=(0.165, -0.155),
        stations=stations,
    )
    return jv.rotor(**(numbers | change))


def pendulums(count=4, drag=0.2, mass=0.05):
    return jv.pendulums(count=count, mass=mass, radius=0.08, drag=drag, inertia=2e-5)


DRIVES = {
    "constant": lambda: jv.ConstantSpeed(460.0),
    "spin_up": lambda: jv.SpinUp(460.0, duration=2.0),
    "run_up": lambda: jv.RunUp(460.0, acceleration=230.0),
    "dc": lambda: jv.DCMotor(460.0, stall_torque=3.0, inertia=0.02),
    "induction": lambda: jv.InductionMotor(460.0, breakdown_torque=3.0, breakdown_slip=0.3, inertia=0.02),
}
IMBALANCE = (jv.Gravity(), jv.StaticImbalance(MASS * ECCENTRICITY), jv.MomentImbalance((0.479 - 0.093) * LEAN, angle=-GAMMA))


def rotor_state(s, seed=0):
    """A random state; loads in the order of their track, two of them pressed together, the rotor off its rest position."""
    rng = np.random.default_rng(seed)
    nd, n = s.machine.carrier().mass.shape[0], s.loads.count
    angle = np.sort(rng.uniform(-1.0, 3.0, n))
    angle[1:2] = angle[0] + 0.2
    moving = isinstance(s.drive, jv.Motor)
    return jv.State(
        jnp.asarray(rng.normal(size=nd) * 2e-3),
        jnp.asarray(rng.normal(size=nd)),
        (jnp.asarray(np.sort(angle)),),
        (jnp.asarray(rng.normal(size=n) * 100.0 + 100.0),),
        (jnp.asarray(rng.normal()), jnp.asarray(150.0)) if moving else None,
    )


CASES = {
    "stations": lambda: (machine(), "constant", ()),
    "one station": lambda: (machine(0.1), "constant", IMBALANCE),
    "imbalance, constant": lambda: (machine(), "constant", IMBALANCE),
    "imbalance, spin-up": lambda: (machine(), "spin_up", IMBALANCE),
    "imbalance, run-up": lambda: (machine(), "run_up", IMBALANCE),
    "imbalance, dc": lambda: (machine(), "dc", IMBALANCE),
    "imbalance, induction, one station": lambda: (machine(-0.2), "induction", IMBALANCE),
    "planar, dc": lambda: (jv.planar_rotor(mass=MASS, stiffness=1.1e6, damping=800.0), "dc", IMBALANCE[:2]),
    "friction, exact": lambda: (machine(), "run_up", (*IMBALANCE, jv.DryFriction(0.15, diameter=0.02, width=20.0))),
    "friction, exact, dc": lambda: (machine(), "dc", (*IMBALANCE, jv.DryFriction(0.15, diameter=0.02, width=20.0))),
    "friction, run-up": lambda: (machine(), "run_up", (jv.DryFriction(0.15, diameter=0.02, reaction="run_up"),)),
    "friction, steady, dc": lambda: (machine(), "dc", (jv.DryFriction(0.15, diameter=0.02, reaction="steady"),)),
    "supports": lambda: (
        machine(),
        "dc",
        (
            jv.CubicSupport(3e11, position=0.165),
            jv.Stop(4e6, gap=5e-4, damping=900.0, position=-0.155),
            jv.CubicSupport(1e11, position=-0.1),
        ),
    ),
    "platforms": lambda: (
        jv.two_mass(mass=(20.0, 15.0), stiffness=(1e4, 2e4), damping=(5.0, 6.0), link_stiffness=3e4, link_damping=7.0),
        "induction",
        (
            jv.Gravity(),
            jv.StaticImbalance(0.02, angle=0.4),
            jv.CubicSupport(2e9, platform=1),
            jv.Stop(1e6, gap=1e-4, damping=500.0, side="above", platform=2),
            jv.Stop(2e6, gap=2e-4, damping=300.0, side="below", platform=1),
        ),
    ),
    "contact": lambda: (machine(0.0), "dc", (jv.Gravity(), jv.LoadContact(stiffness=1e5, damping=20.0))),
}


def case(name):
    carried, drive, effects = CASES[name]()
    loads = pendulums()
    if name == "contact":
        loads = jv.balls(count=4, mass=0.05, radius=0.08, drag=0.2, own_radius=0.015)
    return jv.Scene(carried, loads, DRIVES[drive](), effects)


def residual(s, t, state, field):
    """Lagrange's equations of the second kind, from positions and potentials alone, in units of their largest term.

    Everything is written anew here: coordinates x = (q, phi_1.., theta), the rotor's angle being one of them.
    """
    nd, n = state.displacement.shape[0], s.loads.count
    planar = nd == 2
    vertical = isinstance(s.machine, jv.Platforms)
    motor = isinstance(s.drive, jv.Motor)
    m, r, drag = (float(getattr(s.loads, name)) for name in ("mass", "radius", "drag"))
    inertia = float(s.loads.inertia) if s.loads.kind == "pendulum" else 0.4 * m * r**2
    stations = np.zeros(n) if planar else np.broadcast_to(np.asarray(s.machine.stations), (n,))
    kinds = {e.kind: e for e in s.effects}
    g = float(kinds["gravity"].g) if "gravity" in kinds else 0.0
    if motor:
        theta, spin, change = *state.rotor, field.rotor[1]
    else:
        time = jnp.asarray(t)
        speed_of = jax.grad(s.drive.angle_at)
        theta, spin, change = s.drive.angle_at(time), speed_of(time), jax.grad(speed_of)(time)
    x = jnp.concatenate([state.displacement, state.angle[0], theta[None]])
    v = jnp.concatenate([state.velocity, state.rate[0], spin[None]])
    a = jnp.concatenate([field.velocity, field.rate[0], change[None]])

    def centre(x, s_):
        """Where the axis is at the distance s_ from the mass centre."""
        if vertical:
            return jnp.stack([0.0 * x[1], x[1]])
        return x[:2] if planar else x[:2] + s_ * x[2:4]

    def bob(x, j):
        return centre(x, stations[j]) + r * jnp.stack([jnp.cos(x[nd + j]), jnp.sin(x[nd + j])])

    def kinetic(x, v):
        def speed2(point):
            return jnp.sum(jax.jvp(point, (x,), (v,))[1] ** 2)

        total = sum(0.5 * m * speed2(lambda x, j=j: bob(x, j)) for j in range(n)) + 0.5 * inertia * jnp.sum(v[nd:-1] ** 2)
        body = s.machine.mass if vertical else jnp.asarray([s.machine.mass])
        heavy = body[-1]
        if "static_imbalance" in kinds:
            e = kinds["static_imbalance"].moment / heavy
            lead = kinds["static_imbalance"].angle

            def off(x):
                return centre(x, 0.0) + e * jnp.stack([jnp.cos(x[-1] + lead), jnp.sin(x[-1] + lead)])

            # The whole of the rotor's inertia, M e^2 included, is the motor's number.
            total += 0.5 * heavy * speed2(off) - 0.5 * heavy * e**2 * v[-1] ** 2
        else:
            total += 0.5 * heavy * speed2(lambda x: centre(x, 0.0))
        if vertical:
            total += 0.5 * body[0] * v[0] ** 2
        elif not planar:
            total += 0.5 * s.machine.transverse_inertia * jnp.sum(v[2:4] ** 2)
        if "moment_imbalance" in kinds:
            moment, lead = kinds["moment_imbalance"].moment, kinds["moment_imbalance"].angle
            total += moment * v[-1] * (-jnp.sin(x[-1] + lead) * v[2] + jnp.cos(x[-1] + lead) * v[3])
        if motor:
            total += 0.5 * s.drive.inertia * v[-1] ** 2
        return total

    def potential(x):
        total = g * m * sum(bob(x, j)[1] - centre(x, stations[j])[1] for j in range(n))
        if vertical:
            k, link = s.machine.stiffness, s.machine.link_stiffness[0]
            total += 0.5 * jnp.sum(k * x[:2] ** 2) + 0.5 * link * (x[0] - x[1]) ** 2
        elif planar:
            total += 0.5 * s.machine.stiffness * jnp.sum(x[:2] ** 2)
        else:
            for k, at in zip(s.machine.stiffness, s.machine.position, strict=True):
                total += 0.5 * k * jnp.sum(centre(x, at) ** 2)
        for e in s.effects:
            if e.kind in ("cubic_support", "stop"):
                at = x[e.platform - 1] if vertical else jnp.sqrt(jnp.sum(centre(x, e.position) ** 2))
                if e.kind == "cubic_support":
                    total += e.stiffness * at**4 / 4.0
                else:
                    total += 0.5 * e.stiffness * jnp.maximum((-at if e.side == "below" else at) - e.gap, 0.0) ** 2
        if "load_contact" in kinds:
            c = kinds["load_contact"]
            for j in range(n):
                apart = jnp.sqrt(jnp.sum((bob(x, j) - bob(x, (j + 1) % n)) ** 2))
                total += 0.5 * c.stiffness * jnp.maximum(2.0 * s.loads.own_radius - apart, 0.0) ** 2
        return total

    def resisting(x, v):
        """Generalised forces that no potential has."""
        slip = v[-1] - v[nd:-1]
        torque = drag * r**2 * slip
        if "dry_friction" in kinds:
            f = kinds["dry_friction"]
            lever = 0.5 * f.coefficient * f.diameter * jnp.tanh(slip / f.width)
            if f.reaction == "exact":
                across = jnp.stack(
                    [jax.jvp(lambda y, j=j: jax.jvp(lambda x: bob(x, j), (y,), (v,))[1], (x,), (v,))[1] for j in range(n)]
                )
                across += jnp.stack([jax.jvp(lambda x, j=j: bob(x, j), (x,), (a,))[1] for j in range(n)])
                outward = jnp.stack([jnp.cos(x[nd:-1]), jnp.sin(x[nd:-1])], axis=1)
                load = -m * jnp.sum((across + jnp.array([[0.0, g]])) * outward, axis=1)
            elif f.reaction == "run_up":
                load = m * r * v[nd:-1] ** 2 - 2.0 * m * r * v[-1] * slip
            else:
                load = m * r * v[-1] ** 2 * jnp.ones(n)
            torque += lever * jnp.abs(load)
        force = jnp.zeros_like(x).at[nd:-1].add(torque).at[-1].add(-jnp.sum(torque))
        dampers = lambda y: 0.0  # noqa: E731
        if vertical:
            c, link = s.machine.damping, s.machine.link_damping[0]
            dampers = lambda y: 0.5 * jnp.sum(c * y[:2] ** 2) + 0.5 * link * (y[0] - y[1]) ** 2  # noqa: E731
        elif planar:
            dampers = lambda y: 0.5 * s.machine.damping * jnp.sum(y[:2] ** 2)  # noqa: E731
        else:
            each = list(zip(s.machine.damping, s.machine.position, strict=True))
            dampers = lambda y: sum(0.5 * c * jnp.sum(centre(y, at) ** 2) for c, at in each)  # noqa: E731
            polar = s.machine.polar_inertia * v[-1]
            force = force.at[2].add(-polar * v[3]).at[3].add(polar * v[2])
        force -= jax.grad(dampers)(v) if not isinstance(dampers(v), float) else 0.0
        for e in s.effects:
            if e.kind == "stop":
                radius = (
                    (lambda y, e=e: (-1.0 if e.side == "below" else 1.0) * y[e.platform - 1])
                    if vertical
                    else (lambda y, e=e: jnp.sqrt(jnp.sum(centre(y, e.position) ** 2)))
                )
                beyond, closing = jax.jvp(radius, (x,), (v,))
                press = jnp.maximum(e.stiffness * (beyond - e.gap) + e.damping * closing, 0.0)
                force -= jnp.where(beyond > e.gap, press - e.stiffness * (beyond - e.gap), 0.0) * jax.grad(radius)(x)
        if "load_contact" in kinds:
            c = kinds["load_contact"]
            for j in range(n):
                apart = lambda y, j=j: jnp.sqrt(jnp.sum((bob(y, j) - bob(y, (j + 1) % n)) ** 2))  # noqa: E731
                gap, rate = jax.jvp(apart, (x,), (v,))
                spring = c.stiffness * (2.0 * s.loads.own_radius - gap)
                press = jnp.maximum(spring - c.damping * rate, 0.0)
                force += jnp.where(spring > 0.0, press - spring, 0.0) * jax.grad(apart)(x)
        if motor:
            force = force.at[-1].add(s.drive.torque(v[-1]))
        return force

    momentum = jax.grad(kinetic, 1)
    inertial = jax.jvp(momentum, (x, v), (v, a))[1]
    terms = jnp.stack([inertial, -jax.grad(kinetic)(x, v), jax.grad(potential)(x), -resisting(x, v)])
    left = jnp.sum(terms, axis=0) / jnp.max(jnp.abs(terms), axis=0)
    return left if motor else left[:-1]


@pytest.mark.parametrize("name", CASES)
def test_equations_are_lagranges(name):
    s = case(name)
    for seed in range(2):
        state = rotor_state(s, seed)
        t = jnp.asarray(0.7)
        field = jv.vector_field(s)(t, state)
        np.testing.assert_allclose(residual(s, t, state, field), 0.0, atol=2e-12)


@pytest.mark.parametrize("name", ["imbalance, spin-up", "imbalance, dc", "supports", "friction, run-up"])
def test_equations_are_the_same_on_numbers(name):
    """As they are integrated."""
    s = case(name)
    state, t = rotor_state(s, 5), jnp.asarray(0.7)
    motion = PackedSystem(jv.vector_field(s), state)
    assert motion.is_scalarized
    rates = motion.term.vf(t, motion.pack(state), motion.args)
    ours = motion.states(jax.tree.map(lambda x: x[None], rates))
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(jv.vector_field(s)(t, state)), strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-11, atol=1e-12 * np.max(np.abs(b)))


@pytest.mark.parametrize("name", ["friction, exact, dc", "contact"])
def test_equations_that_are_many_or_cut_arrays_up_stay_on_arrays(name):
    s = case(name)
    state = rotor_state(s, 5)
    motion = PackedSystem(jv.vector_field(s), state)
    assert not motion.is_scalarized
    assert motion.pack(state) is state


@pytest.mark.parametrize("name", CASES)
def test_energy_changes_by_the_power_that_comes_and_goes(name):
    s = case(name)
    state, t = rotor_state(s, 3), jnp.asarray(0.7)
    field = jv.vector_field(s)(t, state)
    _, change = jax.jvp(functools.partial(jv.energy, s), (state, t), (field, jnp.ones_like(t)))
    supplied, lost = jv.power(s, t, state)
    size = abs(float(supplied)) + abs(float(lost))
    assert float(lost) > 0.0
    np.testing.assert_allclose(change, supplied - lost, atol=1e-11 * size)


def test_published_equations_of_the_rotor():
    """Equation (1) of the paper, written by hand with its own numbers, c2 and b2 as printed."""
    k1, k2, l1, l2, big, a_, c_, m, length, mu = 0.604e6, 0.555e6, 0.165, 0.155, 37.0, 0.479, 0.093, 0.05, 0.08, 1e-2
    c = (k1 + k2, k1 * l1 - k2 * l2, k1 * l1**2 + k2 * l2**2)
    b, accel, e, moment, gamma = (843.17, -0.47, 10.41), 230.0, 2.2e-4, 1e-3, 0.3
    s = jv.Scene(
        jv.rotor(
            mass=big,
            transverse_inertia=a_,
            polar_inertia=c_,
            stiffness=(k1, k2),
            damping=(0.0, 0.0),
            position=(l1, -l2),
            stations=STATIONS,
            damping_terms=b,
        ),
        jv.pendulums(count=4, mass=m, radius=length, drag=mu / length**2),
        jv.RunUp(460.0, accel),
        (jv.Gravity(), jv.StaticImbalance(big * e), jv.MomentImbalance((a_ - c_) * moment, angle=-gamma)),
    )
    state, t = rotor_state(s, 5), 1.1
    field = jv.vector_field(s)(jnp.asarray(t), state)
    (y, z, th, ps), (dy, dz, dth, dps), (ddy, ddz, ddth, ddps) = state.displacement, state.velocity, field.velocity
    f, df, ddf, st = state.angle[0], state.rate[0], field.rate[0], np.array(STATIONS)
    w, phi = accel * t, accel * t**2 / 2
    whole, tilted = big + 4 * m, a_ + m * np.sum(st**2)
    radial, along = df**2 * np.cos(f) + ddf * np.sin(f), df**2 * np.sin(f) - ddf * np.cos(f)
    force = m * length
    out = (a_ - c_) * moment
    sine, cosine = np.sin(phi), np.cos(phi)
    lean_sine, lean_cosine = np.sin(phi - gamma), np.cos(phi - gamma)
    rows = [
        [whole * ddy, b[0] * dy + b[1] * dth, c[0] * y + c[1] * th],
        [whole * ddz, b[0] * dz + b[1] * dps, c[0] * z + c[1] * ps],
        [tilted * ddth, c_ * w * dps, b[1] * dy + b[2] * dth, c[1] * y + c[2] * th],
        [tilted * ddps, -c_ * w * dth, b[1] * dz + b[2] * dps, c[1] * z + c[2] * ps],
    ]
    rows[0] += [-big * e * (w**2 * cosine + accel * sine), -force * np.sum(radial)]
    rows[1] += [-big * e * (w**2 * sine - accel * cosine), -force * np.sum(along)]
    rows[2] += [-out * (w**2 * lean_cosine + accel * lean_sine), -force * np.sum(st * radial)]
    rows[3] += [-out * (w**2 * lean_sine - accel * lean_cosine), -force * np.sum(st * along)]
    # The stations' sum is zero here, so that y and theta do not couple through the masses.
    for row in rows:
        assert abs(sum(row)) < 1e-11 * max(map(abs, row))
    swing = (
        m * length**2 * ddf,
        -force * np.sin(f) * (ddy + st * ddth) + force * np.cos(f) * (ddz + st * ddps),
        -mu * (w - df),
        force * 9.81 * np.cos(f),
    )
    np.testing.assert_allclose(sum(swing), 0.0, atol=1e-11 * np.max(np.abs(swing)))


def test_a_rotor_held_in_its_plane_is_the_planar_rotor():
    """Supports, loads and imbalance in the plane of the mass centre: nothing tilts, y and z go as the planar rotor's."""
    flat = dict(stiffness=(6e5, 6e5), damping=(400.0, 400.0), position=(0.1, -0.1), stations=0.0)
    effects = (jv.Gravity(), jv.StaticImbalance(0.01))
    loads, drive = pendulums(count=2), jv.ConstantSpeed(300.0)
    whole = jv.Scene(machine(**flat), loads, drive, effects)
    plane = jv.Scene(jv.planar_rotor(mass=MASS, stiffness=1.2e6, damping=800.0), loads, drive, effects)
    state = rotor_state(plane, 1)
    padded = eqx.tree_at(
        lambda x: (x.displacement, x.velocity),
        state,
        (jnp.concatenate([state.displacement, jnp.zeros(2)]), jnp.concatenate([state.velocity, jnp.zeros(2)])),
    )
    t = jnp.asarray(0.3)
    a, b = jv.vector_field(whole)(t, padded), jv.vector_field(plane)(t, state)
    np.testing.assert_allclose(a.velocity[2:], 0.0, atol=1e-12)
    np.testing.assert_allclose(a.velocity[:2], b.velocity, rtol=1e-12)
    np.testing.assert_allclose(a.rate[0], b.rate[0], rtol=1e-12)


def test_mujoco_agrees_on_a_planar_rotor_with_loads():
    """Two pendulums on a body with springs across and up, under gravity, driven by their drag alone, 0.3 s by MuJoCo's RK4."""
    stiffness, damping, drag, speed, step, n = 4e4, 30.0, 0.8, 60.0, 1e-5, 30000
    bodies = "".join(
        f"""<body name="b{j}"><joint name="f{j}" type="hinge" axis="0 -1 0"/>
        <inertial pos="0.08 0 0" mass="0.4" diaginertia="2e-5 2e-5 2e-5"/></body>"""
        for j in range(2)
    )
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{step}" integrator="RK4" gravity="0 0 0"/>
        <compiler autolimits="false"/><worldbody><body name="rotor">
        <joint name="y" type="slide" axis="1 0 0" stiffness="{stiffness}" damping="{damping}"/>
        <joint name="z" type="slide" axis="0 0 1" stiffness="{stiffness}" damping="{damping}"/>
        <inertial pos="0 0 0" mass="20" diaginertia="1 1 1"/>{bodies}</body></worldbody></mujoco>"""
    )
    s = jv.Scene(
        jv.planar_rotor(mass=20.0, stiffness=stiffness, damping=damping),
        jv.pendulums(count=2, mass=0.4, radius=0.08, drag=drag, inertia=2e-5),
        jv.ConstantSpeed(speed),
        (jv.Gravity(),),
    )
    data = mujoco.MjData(model)
    start = np.array([1e-3, -2e-3, 0.3, 1.9])
    data.qpos[:] = start

    def drive(model, data):
        data.qfrc_applied[2:] = drag * 0.08**2 * (speed - data.qvel[2:]) - 0.4 * 9.81 * 0.08 * np.cos(data.qpos[2:])

    mujoco.set_mjcb_passive(None)
    mujoco.set_mjcb_control(drive)
    try:
        for _ in range(n):
            mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_control(None)
    state = jv.State(jnp.asarray(start[:2]), jnp.zeros(2), (jnp.asarray(start[2:]),), (jnp.zeros(2),))
    run = jv.simulate(s, step * n, start=state, tolerance=1e-11, samples=2)
    end = run.trajectory.state
    np.testing.assert_allclose(end.displacement[-1], data.qpos[:2], atol=1e-8)
    np.testing.assert_allclose(end.angle[0][-1], data.qpos[2:], atol=1e-6)


def test_loads_in_contact_keep_their_order_and_their_distance():
    """Four balls, pressed together at rest, spun up: they touch, never pass, and overlap by no more than the spring allows."""
    diameter, stiffness = 0.03, 2e5
    s = jv.Scene(
        jv.planar_rotor(mass=5.0, stiffness=2e4, damping=40.0),
        jv.balls(count=4, mass=0.1, radius=0.1, drag=0.3, own_radius=0.5 * diameter),
        jv.ConstantSpeed(60.0),
        (jv.Gravity(), jv.LoadContact(stiffness=stiffness, damping=30.0)),
    )
    start = jv.initial_state(s)
    step = 2.0 * np.arcsin(diameter / 0.2)
    np.testing.assert_allclose(np.diff(start.angle[0]), step, rtol=1e-12)
    run = jv.simulate(s, 3.0, start=start, tolerance=1e-7)
    angle = np.asarray(run.trajectory.state.angle[0])
    gaps = np.diff(np.concatenate([angle, angle[:, :1] + 2.0 * np.pi], axis=1), axis=1)
    assert np.all(gaps > 0.9 * step)
    assert np.any(gaps[:, :3] < step)


def test_touching_loads_start_a_jam_side_by_side():
    """A start in a jam lays touching loads side by side about the jam's angle."""
    s = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        jv.balls(count=3, mass=0.2, radius=0.1, drag=0.15, own_radius=0.005),
        jv.ConstantSpeed(60.0),
        (jv.LoadContact(stiffness=1e5),),
    )
    start = jv.initial_state(s, "jam", mode=1)
    np.testing.assert_allclose(np.diff(start.angle[0]), 2.0 * np.arcsin(0.05), rtol=1e-12)
    np.testing.assert_allclose(jnp.mean(start.angle[0]), 0.0, atol=1e-12)
