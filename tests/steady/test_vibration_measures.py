"""Measures of a vibration against closed forms and the flight of a particle."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
import optimize
from jaxvib.steady.vibration import Vibration

G = 9.80665


@pytest.fixture(scope="module")
def jam():
    shaken = scene("two_mass", speed=150.0)
    return shaken, jv.jam_modes(shaken).select(3)


def test_measures_are_those_of_a_sine(jam):
    shaken, found = jam
    measures = jv.vibration_measures(shaken, found)
    w, t = float(found.omega), np.linspace(0.0, 2.0 * np.pi / float(found.omega), 20001)
    for k in range(2):
        y = np.real(complex(found.displacement[k]) * np.exp(1j * w * t))
        v = np.gradient(y, t)
        np.testing.assert_allclose(measures.stroke[k], np.ptp(y), rtol=1e-6)
        np.testing.assert_allclose(measures.velocity[k], np.sqrt(np.mean(v[:-1] ** 2)), rtol=1e-3)
        np.testing.assert_allclose(measures.acceleration[k], np.max(np.abs(np.gradient(v, t)[2:-2])) / G, rtol=1e-3)


def test_loads_of_supports_balance_weight_and_force(jam):
    shaken, found = jam
    measures = jv.vibration_measures(shaken, found)
    machine, loads = shaken.machine, shaken.loads
    weight = G * (np.sum(machine.mass) + loads.count * np.mean(loads.mass))
    np.testing.assert_allclose(np.sum(measures.static_load), weight, rtol=1e-12)
    each = (np.asarray(machine.stiffness) + 1j * float(found.omega) * np.asarray(machine.damping)) * np.asarray(
        found.displacement
    )
    np.testing.assert_allclose(measures.dynamic_load, np.abs(each), rtol=1e-12)
    np.testing.assert_allclose(abs(np.sum(each)), found.foundation_force, rtol=1e-10)
    exciter = float(loads.unbalance()) * float(found.omega) ** 2
    np.testing.assert_allclose(measures.transmissibility * exciter, found.foundation_force, rtol=1e-12)
    np.testing.assert_allclose(measures.isolation_efficiency, 1.0 - float(found.foundation_force) / exciter, rtol=1e-12)


def test_shaft_power_is_dissipated_by_drag_and_dampers(jam):
    shaken, found = jam
    measures = jv.vibration_measures(shaken, found)
    w, n, machine, loads = float(found.omega), float(shaken.drive.speed), shaken.machine, shaken.loads
    y = np.asarray(found.displacement)
    link = float(machine.link_damping[0]) * abs(y[0] - y[1]) ** 2
    dampers = w**2 / 2.0 * (np.sum(np.asarray(machine.damping) * np.abs(y) ** 2) + link)
    slip = loads.count * np.mean(loads.drag) * np.mean(loads.radius) ** 2 * (n - w) ** 2
    np.testing.assert_allclose(measures.power, dampers + slip, rtol=1e-6)
    np.testing.assert_allclose(measures.torque, measures.power / n, rtol=1e-12)


def test_quantities_equal_the_measures(jam):
    shaken, found = jam
    measures = jv.vibration_measures(shaken, found)
    for quantity, value in (
        (optimize.stroke(mode=3, of=1), measures.stroke[0]),
        (optimize.acceleration(mode=3, of=2), measures.acceleration[1]),
        (optimize.velocity(mode=3, of=1), measures.velocity[0]),
        (optimize.transmissibility(mode=3), measures.transmissibility),
        (optimize.shaft_torque(mode=3), measures.torque),
        (optimize.support_load(mode=3, of=2), measures.static_load[1] + measures.dynamic_load[1]),
    ):
        np.testing.assert_allclose(quantity(shaken), value, rtol=1e-10, err_msg=quantity.words)


def test_zones_change_at_the_boundaries_of_the_standard():
    assert [jv.vibration_zone(f"{v} mm/s") for v in (2.2, 2.4, 4.6, 7.2)] == list("ABCD")
    assert [jv.vibration_zone(v, machine="large", supports="rigid") for v in (2e-3, 3e-3, 5e-3, 8e-3)] == list("ABCD")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"machine": "small"}, "machine is 'small'; allowed: medium, large"),
        ({"supports": "soft"}, "supports is 'soft'; allowed: rigid, flexible"),
    ],
)
def test_zones_of_other_machines_and_supports_are_refused(given, says):
    with pytest.raises(jv.InputError, match=says):
        jv.vibration_zone(3e-3, **given)


def flown(u, w, slope, periods):
    """Mean speed of a particle along a deck by small steps: it sticks while pressed, flies otherwise."""
    gx, gy = -G * np.sin(slope), -G * np.cos(slope)
    dt = 2.0 * np.pi / w / 20000
    t = dt * np.arange(20000 * periods)
    wave = np.exp(1j * w * t)
    (sx, sy), (vx, vy), (_, ay) = ([np.real(f * z * wave) for z in _in_deck(u, slope)] for f in (1.0, 1j * w, -(w**2)))
    x, k = 0.0, 0
    while k < len(t):
        rising = np.flatnonzero(ay[k:] < gy)
        if rising.size == 0:
            break
        k += rising[0]
        tau = t[k:] - t[k]
        gap = sy[k] + vy[k] * tau + gy * tau**2 / 2.0 - sy[k:]
        landed = np.flatnonzero(gap[5:] <= 0.0)
        if landed.size == 0:
            break
        j = landed[0] + 5
        x += vx[k] * tau[j] + gx * tau[j] ** 2 / 2.0 - (sx[k + j] - sx[k])
        k += j
    return x / t[-1]


def _in_deck(u, slope):
    return np.cos(slope) * u[0] + np.sin(slope) * u[1], -np.sin(slope) * u[0] + np.cos(slope) * u[1]


@pytest.mark.parametrize(
    ("u", "w", "slope"),
    [
        (np.array([0.004, 0.003]), 80.0, 0.0),
        (np.array([0.004, 0.003]), 84.0, -0.2),
        (np.array([0.003 + 0.001j, 0.003 - 0.0005j]), 90.0, 0.1),
    ],
)
def test_conveying_speed_is_that_of_a_flying_particle(u, w, slope):
    once, twice = flown(u, w, slope, 40), flown(u, w, slope, 80)
    without_ends = 2.0 * twice - once  # the first and the last period are not whole
    np.testing.assert_allclose(jv.conveying_speed(jnp.asarray(u), w, slope=slope), without_ends, rtol=1e-3)


def test_conveying_speed_has_the_limits_of_handbooks():
    level = jnp.array([0.004, 0.003])
    assert float(jv.conveying_speed(level, 50.0)) == 0.0
    w = np.sqrt(np.sqrt(1.0 + np.pi**2) * G / 0.003) * (1.0 - 1e-9)
    np.testing.assert_allclose(jv.conveying_speed(level, w), G / (2.0 * w / (2.0 * np.pi)) * 4.0 / 3.0, rtol=1e-6)
    assert np.isnan(jv.conveying_speed(level, 1.01 * w))


def rows_of(place):
    """Rows of the motion of a point of a body in a plane."""
    return np.array([[1.0, 0.0, -place[1]], [0.0, 1.0, place[0]]])


TILTED = [((-1.2, -0.3), (2e5, 4e5), (9e3, 9e3), 0.3), ((0.9, -0.1), (1e5, 5e5), (6e3, 9e3), -0.2)]


@pytest.fixture(scope="module")
def screen():
    supports = [jv.support(at=at, stiffness=k, damping=c, angle=a) for at, k, c, a in TILTED]
    body = jv.plane_body(mass=2000.0, inertia=900.0, supports=supports)
    drive = jv.ConstantSpeed("950 rpm")
    exciters = [jv.Exciter(at=(x, 0.4), unbalance=2.0, drive=drive, direction=way) for x, way in ((0.0, 1), (0.3, -1))]
    return jv.Scene(body, exciters=exciters)


def test_loads_of_inclined_supports_follow_from_their_springs(screen):
    found = jv.response(screen, speeds=[90.0]).vibration()
    measures = jv.vibration_measures(screen, found, at=(1.0, 0.2), slope="-10 deg")
    w, z = float(found.speed), np.asarray(found.displacement)
    weight, moment, total = 0.0, 0.0, np.zeros(2)
    sag = np.zeros((3, 3))
    for at, k, _, a in TILTED:
        turn = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
        sag += rows_of(at).T @ turn.T @ np.diag(k) @ turn @ rows_of(at)
    sunk = np.linalg.solve(sag, [0.0, 2000.0 * G, 0.0])
    for j, (at, k, c, a) in enumerate(TILTED):
        turn = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
        force = turn.T @ np.diag(np.asarray(k) + 1j * w * np.asarray(c)) @ turn @ rows_of(at) @ z
        np.testing.assert_allclose([measures.side_load[j], measures.dynamic_load[j]], np.abs(force), rtol=1e-9)
        total = total + force
        static = turn.T @ np.diag(k) @ turn @ rows_of(at) @ sunk
        np.testing.assert_allclose(measures.static_load[j], static[1], rtol=1e-9)
        weight, moment = weight + static[1], moment + at[0] * static[1] - at[1] * static[0]
    np.testing.assert_allclose([weight, moment], [2000.0 * G, 0.0], atol=1e-6)
    np.testing.assert_allclose(measures.foundation_load, np.abs(total), rtol=1e-9)
    assert f"foundation: {abs(total[0]):.4g} N across, {abs(total[1]):.4g} N up (dynamic)" in measures.summary()
    u = rows_of((1.0, 0.2)) @ z
    np.testing.assert_allclose(measures.conveying_speed, jv.conveying_speed(jnp.asarray(u), w, slope="-10 deg"), rtol=1e-12)
    assert measures.throughput is None and "t/h" not in measures.summary()
    carried = jv.vibration_measures(screen, found, at=(1.0, 0.2), slope="-10 deg", layer=("1.5 m", "50 mm", "1.6 t/m^3"))
    np.testing.assert_allclose(carried.throughput, 1.5 * 0.05 * 1600.0 * np.abs(measures.conveying_speed), rtol=1e-12)
    assert f"m/s, {3.6 * float(carried.throughput):.4g} t/h" in carried.summary()
    with pytest.raises(jv.InputError, match=r"^layer is \(1.5, 0.05\); give width, height and density"):
        jv.vibration_measures(screen, found, layer=(1.5, 0.05))
    path = jv.ellipse_of(jnp.asarray(u), w, slope="-10 deg")
    np.testing.assert_allclose(measures.throw_number, path.throw_number, rtol=1e-12)
    np.testing.assert_allclose(measures.throw_angle, path.direction, rtol=1e-12)


def test_run_regime_and_response_have_the_same_measures(screen):
    """Two equal unbalances under ideal drives of one speed: regime, response and run describe one motion."""
    run = jv.simulate(screen, "14 s", save="window")
    motions = [
        jv.response(screen, speeds=[screen.exciters[0].drive.speed]).vibration(),
        jv.working_regime(screen).vibration(),
        run.vibration(),
    ]
    first, second, third = (jv.vibration_measures(screen, motion) for motion in motions)
    for other, tolerance in ((second, 1e-9), (third, 2e-4)):
        for name, value in first.document().items():
            if name in ("coordinates", "directions"):
                continue
            np.testing.assert_allclose(getattr(other, name), value, rtol=tolerance, atol=tolerance, err_msg=name)
    states, carrier = run.window.state, screen.machine.carrier()
    lost = np.einsum("ti,ij,tj->t", states.velocity, carrier.damping, states.velocity)
    np.testing.assert_allclose(np.sum(third.power), np.mean(lost), rtol=0.02)  # the window is not a whole number of turns


def test_runs_with_two_frequencies_have_the_measures_of_both(screen):
    """A forced and a free vibration, against differences of the saved velocities; the harmonic alone has other values."""
    run, at, slope = jv.simulate(screen, "0.8 s", save="window"), (1.0, 0.2), np.deg2rad(-10.0)
    motion, q, v = run.vibration(), np.asarray(run.window.state.displacement), np.asarray(run.window.state.velocity)
    measures, alone = (
        jv.vibration_measures(screen, each, at=at, slope=slope) for each in (motion, motion._replace(samples=None))
    )
    a = np.gradient(v, np.asarray(run.window.time), axis=0)[1:-1]
    np.testing.assert_allclose(measures.velocity, np.sqrt(np.mean(v[:, :2] ** 2, axis=0)), rtol=0.02)  # not whole turns
    np.testing.assert_allclose(measures.acceleration, np.max(abs(a[:, :2]), axis=0) / G, rtol=3e-3)
    (x, y), u = (a @ rows_of(at).T / G).T, q @ rows_of(at).T
    np.testing.assert_allclose(measures.point_acceleration, np.max(np.hypot(x, y)), rtol=3e-3)
    throw = np.max(np.sin(slope) * x - np.cos(slope) * y) / np.cos(slope)
    np.testing.assert_allclose(measures.throw_number, throw, rtol=3e-3)
    angle = float(measures.throw_angle)
    np.testing.assert_allclose(measures.point_stroke, np.ptp(u @ [np.cos(angle), np.sin(angle)]), rtol=3e-3)
    np.testing.assert_allclose(measures.foundation_load, np.ptp(run.window.foundation_force, axis=0) / 2.0, rtol=3e-3)
    for j, (place, k, c, tilt) in enumerate(TILTED):
        turn = np.array([[np.cos(tilt), np.sin(tilt)], [-np.sin(tilt), np.cos(tilt)]])
        of_spring, of_damper = ((turn.T @ np.diag(each) @ turn @ rows_of(place)).T for each in (k, c))
        side, up = np.ptp(q @ of_spring + v @ of_damper, axis=0) / 2.0
        np.testing.assert_allclose([measures.side_load[j], measures.dynamic_load[j]], [side, up], rtol=3e-3)
    for name in ("velocity", "acceleration", "point_stroke", "foundation_load", "dynamic_load"):
        assert np.max(np.abs(getattr(alone, name) / getattr(measures, name) - 1.0)) > 0.01, name
    assert "rpm; the conveying speed is computed from this part only" in run.summary()


def test_one_mass_has_the_measures_of_the_closed_form():
    m, k, c, unbalance, w = 200.0, 8e5, 600.0, 0.2, 120.0
    table = jv.one_mass(mass=m, stiffness=k, damping=c)
    scene = jv.Scene(table, exciters=[jv.Exciter(drive=jv.ConstantSpeed(w), unbalance=unbalance, direction=-1)])
    y = abs(unbalance * w**2 / (k - m * w**2 + 1j * w * c))
    for motion in (jv.response(scene).operating.vibration(), jv.simulate(scene, "14 s", save="window").vibration()):
        measures = jv.vibration_measures(scene, motion)
        np.testing.assert_allclose(measures.stroke, [2.0 * y], rtol=1e-4)
        np.testing.assert_allclose(measures.power, [c * (w * y) ** 2 / 2.0], rtol=1e-3)
        np.testing.assert_allclose(measures.torque, measures.power / w, rtol=1e-6)
        np.testing.assert_allclose(measures.static_load, [m * G], rtol=1e-12)
        np.testing.assert_allclose(measures.static_deflection, [m * G / k], rtol=1e-12)
        assert f"static deflection, down: y1 {1e3 * m * G / k:.4g} mm" in measures.summary()
        np.testing.assert_allclose(measures.dynamic_load, [abs(k + 1j * w * c) * y], rtol=1e-4)
        np.testing.assert_allclose(measures.transmissibility, abs(k + 1j * w * c) * y / (unbalance * w**2), rtol=1e-4)


def test_weight_moves_a_feeder_on_inclined_springs_to_the_left():
    """Leaf springs that let the trough move at 25 degrees: it slides by g sin(25 deg)/w^2 in this direction."""
    m, soft, stiff, angle = 1800.0, 3e6, 8e8, np.deg2rad(25.0)
    springs = [
        jv.support(at=(x, 0.0), stiffness=(soft / 2.0, stiff / 2.0), damping=(0.0, 0.0), angle=angle) for x in (-0.6, 0.6)
    ]
    feeder = jv.Scene(jv.plane_body(mass=m, inertia=250.0, supports=springs), exciters=[EXCITER])
    along, across = m * G * np.sin(angle) / soft, m * G * np.cos(angle) / stiff
    x, y = along * np.cos(angle) - across * np.sin(angle), along * np.sin(angle) + across * np.cos(angle)
    measures = of_values(feeder, force=2e4, displacement=(1e-3, 1e-3, 0.0))
    np.testing.assert_allclose(measures.static_deflection, [x, y], rtol=1e-12)
    text = measures.summary()
    assert f"static deflection of the centre of mass, down: y {1e3 * y:.4g} mm\n" in text
    assert f"static deflection of the centre of mass, to the left: x {1e3 * x:.4g} mm\n" in text
    up = abs(measures.foundation_load[1])
    assert f"{up / 1e3:.4g} kN up (dynamic)" in text and up > 1e4


def test_bearings_of_a_rotor_carry_weight_and_whirl():
    machine = jv.rotor(
        mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, stiffness=(6e5, 5e5), damping=(400.0, 300.0),
        position=(0.165, -0.155), stiffness_up=(9e5, 8e5),
    )  # fmt: skip
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(300.0), unbalance=1e-3, at=0.1)])
    motion = jv.response(scene).operating.vibration()
    measures = jv.vibration_measures(scene, motion)
    assert np.all(np.isnan(measures.static_load)) and "static" not in measures.summary()  # the axis may be vertical
    measures = jv.vibration_measures(dataclasses.replace(scene, effects=(jv.Gravity(),)), motion)
    y, z, theta, psi = np.asarray(motion.displacement)
    for j, place in enumerate((0.165, -0.155)):
        across = ((6e5, 5e5)[j] + 300j * (400.0, 300.0)[j]) * (y + place * theta)
        up = ((9e5, 8e5)[j] + 300j * (400.0, 300.0)[j]) * (z + place * psi)
        np.testing.assert_allclose([measures.side_load[j], measures.dynamic_load[j]], [abs(across), abs(up)], rtol=1e-9)
    np.testing.assert_allclose(np.sum(measures.static_load), 37.0 * G, rtol=1e-9)
    np.testing.assert_allclose(measures.static_load @ np.array([0.165, -0.155]), 0.0, atol=1e-9)
    assert measures.throw_number is None and len(measures.stroke) == 2


def test_no_transmissibility_is_shown_for_balanced_loads(jam):
    measures = jv.vibration_measures(*jam)
    balanced = dataclasses.replace(measures, transmissibility=jnp.asarray(3.5e5))
    assert "reach the foundation" in measures.summary() and "reach the foundation" not in balanced.summary()


def test_texts_of_rotors_state_the_rotating_force():
    drive = jv.ConstantSpeed(40.0)
    rotor = jv.Scene(jv.planar_rotor(mass=50.0, stiffness=4e4, damping=0.0), exciters=[jv.Exciter(drive=drive, unbalance=0.1)])
    near = jv.vibration_measures(rotor, jv.response(rotor, speeds=[29.0]).vibration())
    circle = 0.1 * 29.0**2  # N, not sqrt(2) times as much
    ratio = 4e4 / (4e4 - 50.0 * 29.0**2)
    assert f"the foundation receives {abs(ratio):.3g} times the exciter's rotating {circle:.4g} N" in near.summary()
    assert "static" not in near.summary()  # the axis may be vertical
    assert "zone D" in near.summary() and near.notes() == [] and max(near.acceleration) > 1.0
    far = jv.vibration_measures(rotor, jv.response(rotor, speeds=[40.0]).vibration())
    assert "of the exciter's rotating 160 N, 100 % reach the foundation" in far.summary()


def test_an_exact_jam_has_the_measures_of_its_period(jam):
    shaken, _ = jam
    orbit = jv.jam_orbit(shaken, mode=3)
    measures = jv.vibration_measures(shaken, orbit)
    turns = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    q, v, _, (rate,) = jax.tree.map(np.asarray, jax.vmap(orbit.at)(jnp.asarray(turns)))
    n, w, machine = float(shaken.drive.speed), float(orbit.omega), shaken.machine
    torque = 3 * 1.5 * 0.12**2 * (n - np.mean(rate))
    np.testing.assert_allclose(measures.torque, torque, rtol=1e-9)
    np.testing.assert_allclose(measures.power, n * torque, rtol=1e-9)
    np.testing.assert_allclose(measures.stroke, np.ptp(q, axis=0), rtol=1e-4)
    forces = np.asarray(machine.stiffness) * q + np.asarray(machine.damping) * v
    np.testing.assert_allclose(measures.dynamic_load, np.ptp(forces, axis=0) / 2.0, rtol=1e-4)
    np.testing.assert_allclose(measures.velocity, np.sqrt(np.mean(v**2, axis=0)), rtol=1e-6)
    np.testing.assert_allclose(measures.exciter_force, 3 * 0.8 * 0.12 * w**2, rtol=1e-9)


def test_exact_jam_of_unlike_loads_has_the_force_of_their_phases():
    table = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    loads = jv.balls(count=2, mass=[0.5, 0.3], radius=0.1, drag=[0.1, 0.3])
    unlike = jv.Scene(table, loads, jv.ConstantSpeed(60.0))
    orbit = jv.jam_orbit(unlike, mode=1)
    turns = jnp.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    phases = np.mean(np.asarray(jax.vmap(orbit.at)(turns)[2][0]) - turns[:, None], axis=0)
    assert abs(phases[0] - phases[1]) > 0.3
    resultant = abs(0.05 * np.exp(1j * phases[0]) + 0.03 * np.exp(1j * phases[1]))
    found = jv.vibration_measures(unlike, orbit)
    np.testing.assert_allclose(found.exciter_force, resultant * float(orbit.omega) ** 2, rtol=1e-9)


def test_jams_with_phases_have_the_measures_of_their_resultant():
    machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    rotor = jv.Scene(machine, jv.pendulums(count=3, mass=0.05, radius=0.08, drag=0.04), jv.ConstantSpeed(460.0))
    found = jv.phase_jams(rotor)
    for k in range(found.omega.shape[0]):
        each = found.select(k)
        measures, w = jv.vibration_measures(rotor, each), float(each.omega)
        resultant = abs(np.sum(0.05 * 0.08 * np.exp(1j * np.asarray(each.phase)))) * w**2
        np.testing.assert_allclose(measures.exciter_force, np.sqrt(2.0) * resultant, rtol=1e-9)
        torque = 3 * 0.04 * 0.08**2 * (460.0 - w)
        np.testing.assert_allclose([measures.torque[0], measures.power[0]], [torque, 460.0 * torque], rtol=1e-6)
        lift = np.hypot(1.16e6, 843.0 * w) * np.asarray(each.amplitude)[1]
        np.testing.assert_allclose(measures.dynamic_load, lift, rtol=1e-9)


def test_an_averaged_jam_has_the_measures_of_light_loads(jam):
    shaken, found = jam
    run = jv.envelope(shaken, "20 s", start="jam", mode=3)
    measures, light = (jv.vibration_measures(shaken, each) for each in (run.vibration(), found))
    for name in ("stroke", "acceleration", "velocity", "dynamic_load", "static_load", "transmissibility", "torque", "power"):
        np.testing.assert_allclose(getattr(measures, name), getattr(light, name), rtol=1e-6, err_msg=name)
    assert measures.summary().splitlines()[0] in run.summary()


def test_an_averaged_motor_has_the_torque_of_its_speed():
    body = jv.one_mass(mass=200.0, stiffness="800 N/mm", damping=600.0)
    motor = jv.DCMotor("1500 rpm", stall_torque=12.0, inertia=0.1)
    table = jv.Scene(body, exciters=[jv.Exciter(drive=motor, unbalance="0.05 kg m")])
    run = jv.envelope(table, "100 s", start="rest")
    measures, n = jv.vibration_measures(table, run.vibration()), float(np.mean(run.window.rotor_speed))
    line = 12.0 * (1.0 - n / (50.0 * np.pi))
    np.testing.assert_allclose([measures.torque[0], measures.power[0]], [line, n * line], rtol=1e-6)
    lost = 300.0 * n**2 * float(run.amplitude[0]) ** 2  # c (w A)^2 / 2
    np.testing.assert_allclose(measures.power, lost, rtol=1e-3)  # the tolerance of a step is 1e-4


@pytest.mark.parametrize(
    ("unbalance", "notes", "throw"),
    [
        (0.15, [], "0.773 (below 1: material does not leave the deck), conveys 0.000 m/s"),
        (0.25, [], "1.29 (material hardly leaves the deck; feeders have 1.5 to 3.3), "),
        (0.6, [], "3.09, conveys"),
        (1.9, ["the acceleration is 9.", "the throw number is 9."], "9.79, flights longer"),
    ],
)
def test_unusual_accelerations_and_throws_have_notes(unbalance, notes, throw):
    springs = [jv.support(at=(x, 0.0), stiffness=(1e4, 1e4), damping=(50.0, 50.0)) for x in (-1.0, 1.0)]
    body = jv.plane_body(mass=200.0, inertia=100.0, supports=springs)
    scene = jv.Scene(body, exciters=[jv.Exciter(drive=jv.ConstantSpeed(100.0), unbalance=unbalance, at=(0.0, 0.0))])
    measures = jv.vibration_measures(scene, jv.response(scene, speeds=[100.0]).vibration())
    y = unbalance * 1e4 / abs(2e4 - 200.0 * 1e4 + 1e4j)  # closed form
    np.testing.assert_allclose(measures.throw_number, 1e4 * y / G, rtol=1e-9)
    assert [each[: len(start)] for each, start in zip(measures.notes(), notes, strict=True)] == notes
    assert f"throw number {throw}" in measures.summary()


EXCITER = jv.Exciter(drive=jv.ConstantSpeed(40.0), unbalance=0.1)
JOINT = {"stiffness": (2e5, 4e5), "damping": (800, 900)}


def of_values(scene, *, speed=40.0, force=450.0, exciting=100.0, displacement=(5e-3,)):
    """Measures of a vibration with these values."""
    z = jnp.asarray(displacement, complex)
    values = (jnp.asarray(each) for each in (force, exciting))
    return jv.vibration_measures(scene, Vibration(jnp.asarray(speed), z, jnp.abs(z), *values, jnp.ones(1), jnp.ones(1)))


def test_loads_include_or_deny_supports_that_are_effects():
    loads, drive = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(40.0)
    stiff = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=0.0), loads, drive, (jv.CubicSupport(2e9),))
    measures = of_values(stiff)  # 450 N = k y + k3 y^3
    np.testing.assert_allclose(measures.foundation_load, [450.0], rtol=1e-12)
    np.testing.assert_allclose(measures.static_load, [51.0 * G], rtol=1e-12)
    assert np.all(np.isnan(measures.dynamic_load))
    assert "support 1: 500.1 N static\nof the exciter's 100 N, 450 % reach" in measures.summary()
    rotor = jv.Scene(jv.planar_rotor(mass=50.0, stiffness=4e4, damping=0.0), loads, drive, (jv.Stop(1e6, gap=1e-3),))
    assert np.all(np.isnan(of_values(rotor, displacement=(5e-3, 5e-3j)).foundation_load))


def test_unknown_forces_are_nan():
    table = jv.one_mass(mass=50.0, stiffness=4e4, damping=0.0)
    for exciting, ratio in ((np.nan, np.nan), (0.0, np.inf), (900.0, 0.5)):
        measures = of_values(jv.Scene(table, exciters=[EXCITER]), exciting=exciting)
        np.testing.assert_equal(float(measures.transmissibility), ratio)
    matrices = jv.from_matrices(50.0, 0.0, 4e4, places=[[0]])
    measures = of_values(jv.Scene(matrices, exciters=[EXCITER]), force=0.0)
    loads = (measures.foundation_load, measures.dynamic_load, measures.static_load)
    assert np.all(np.isnan([measures.transmissibility, *np.concatenate(loads)]))
    assert "isolation" not in measures.summary() and "support" not in measures.summary()
    known = jv.from_matrices(50.0, 0.0, 4e4, places=[[0]], foundation=([[4e4]], [[0.0]]))
    np.testing.assert_allclose(of_values(jv.Scene(known, exciters=[EXCITER])).dynamic_load, [200.0], rtol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 0.3])
def test_weight_rests_on_springs_of_one_direction(angle):
    """Springs along one direction carry the weight if it acts in this direction, and nothing carries it otherwise."""
    springs = [jv.support(at=(x, -0.2), stiffness=(0.0, 1e5), damping=(10.0, 50.0), angle=angle) for x in (-1.0, 1.0)]
    body = jv.plane_body(mass=300.0, inertia=75.0, supports=springs)
    measures = of_values(jv.Scene(body, exciters=[EXCITER]), displacement=(1e-3, 1e-3, 0.0))
    np.testing.assert_allclose(measures.static_load, [150.0 * G if angle == 0.0 else np.nan] * 2, rtol=1e-12)


def test_static_load_does_not_depend_on_the_order_of_ends():
    frame = [jv.support(at=(x, -0.2), stiffness=(1e5, 2e5), damping=(500, 900), body=1) for x in (-1.5, 1.5)]
    joints = {
        "from above": [jv.support(at=(x, -0.3), to=1, at_other=(x, 0.2), **JOINT) for x in (-1, 1)],
        "from below": [jv.support(at=(x, 0.2), body=1, to=0, at_other=(x, -0.3), **JOINT) for x in (-1, 1)],
    }
    for each in joints.values():
        machine = jv.plane_network([jv.body(mass=2000, inertia=600), jv.body(mass=900, inertia=400)], frame + each)
        measures = of_values(jv.Scene(machine, exciters=[EXCITER]), displacement=(0.0, 1e-3, 0.0, 0.0, 1e-3, 0.0))
        np.testing.assert_allclose(measures.static_load, [1450.0 * G] * 2 + [1000.0 * G] * 2, rtol=1e-9)
        assert "support 4: 9807 N static" in measures.summary()


def test_points_are_refused_except_on_bodies_in_a_plane(jam):
    shaken, found = jam
    for given in ({"at": 7}, {"at": (3.0, 1.0)}, {"at": [(3.0, 1.0)]}, {"slope": "-10 deg"}, {"body": 1}, {"layer": [1]}):
        with pytest.raises(jv.InputError, match=rf"^{next(iter(given))} is .*(leave it out|number 0)"):
            jv.vibration_measures(shaken, found, **given)


def test_exact_jam_under_a_speed_profile_has_measures():
    table = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
    drives = jv.SpeedProfile([0.0, 5.0], [0.0, 41.9]), jv.ConstantSpeed(41.9)
    scenes = [jv.Scene(table, loads, drive) for drive in drives]
    one, other = (jv.vibration_measures(each, jv.jam_orbit(each, mode=1)) for each in scenes)
    np.testing.assert_allclose([*one.torque, *one.power], [*other.torque, *other.power], rtol=1e-9)


def test_negative_speed_is_the_reversed_vibration(screen):
    z = np.array([2e-3 + 1e-3j, 3e-3j, 1e-3])
    one, other = (of_values(screen, speed=w, displacement=y) for w, y in ((90.0, z), (-90.0, np.conj(z))))
    for name, value in one.document().items():
        if name not in ("speed", "coordinates", "directions"):
            np.testing.assert_allclose(getattr(other, name), value, rtol=1e-12, err_msg=name)
