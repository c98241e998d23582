"""Response to unbalances, and the torque that it needs: against closed forms, dense solutions, SciPy and time integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxvib as jv
from jaxvib.results.status import status_names

MASS, SPRING, DAMPER, S = 200.0, 8e5, 600.0, 0.2
SPEEDS = np.array([5.0, 40.0, 63.0, 90.0, 160.0])


def one_mass(damping=DAMPER, drive=None):
    drive = jv.ConstantSpeed("1500 rpm") if drive is None else drive
    machine = jv.one_mass(mass=MASS, stiffness=SPRING, damping=damping)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=S)])


def motor(torque=12.0):
    return jv.DCMotor("1500 rpm", stall_torque=torque, inertia=0.1)


def needed(w):
    """Torque b w |Y|^2 / 2 of one mass, N m."""
    size = S * w**2 / np.abs(SPRING - MASS * w**2 + 1j * w * DAMPER)
    return DAMPER * w * size**2 / 2.0


def body(exciters, at=(0.1, 0.0)):
    springs = [jv.support(at=(x, -0.2), stiffness=(3e4, 5e4), damping=(150.0, 200.0), angle=0.2) for x in (-0.6, 0.7)]
    return jv.Scene(jv.plane_body(mass=300.0, inertia=75.0, supports=springs), exciters=exciters)


def test_one_mass_has_the_closed_form():
    found = jv.response(one_mass(), SPEEDS)
    stiff = SPRING - MASS * SPEEDS**2 + 1j * SPEEDS * DAMPER
    exact = -1j * S * SPEEDS**2 / stiff  # at w t = 0 the unbalance is at the angle 0, across
    np.testing.assert_allclose(found.displacement[:, 0], exact, rtol=1e-12)
    np.testing.assert_allclose(found.phase[:, 0], np.angle(exact), rtol=1e-11)
    np.testing.assert_allclose(found.torque[:, 0], needed(SPEEDS), rtol=1e-10)
    np.testing.assert_allclose(found.power[:, 0], SPEEDS * needed(SPEEDS), rtol=1e-10)
    force = np.abs(exact) * np.hypot(SPRING, SPEEDS * DAMPER)
    np.testing.assert_allclose(found.foundation_force, force, rtol=1e-12)
    np.testing.assert_allclose(found.transmissibility, force / (S * SPEEDS**2), rtol=1e-12)
    np.testing.assert_allclose(found.velocity[:, 0], SPEEDS * np.abs(exact) / np.sqrt(2.0), rtol=1e-12)
    np.testing.assert_allclose(found.acceleration[:, 0], SPEEDS**2 * np.abs(exact) / 9.80665, rtol=1e-12)
    assert found.operating.speed.tolist() == [pytest.approx(50.0 * np.pi)] and bool(found.operating.stable[0])


def test_values_at_rest_are_limits_at_low_speeds():
    link = {"link_stiffness": 2e5, "link_damping": 60.0}
    free = jv.two_mass(mass=(120.0, 95.0), stiffness=(0.0, 0.0), damping=(0.0, 0.0), **link)
    exciters = [jv.Exciter(drive=jv.ConstantSpeed(100.0), unbalance=S)]
    for scene, ratio, amplitude in (
        (one_mass(), 1.0, 0.0),
        (body(exciters), 1.0, 0.0),
        (jv.Scene(free, exciters=exciters), 0.0, S / 215.0),
    ):
        found = jv.response(scene, [0.0, 0.01])
        np.testing.assert_allclose(found.transmissibility, ratio, rtol=1e-6)
        np.testing.assert_allclose(found.amplitude[0], amplitude, rtol=1e-7)
        forces = [found.foundation_force, found.exciter_force, found.torque[:, 0], found.power[:, 0], found.acceleration[:, 0]]
        assert [float(each[0]) for each in forces] == [0.0] * 5 and np.all(found.status == jv.ResponseStatus.done)
        assert float(found.speed[0]) == 0.0 < float(found.exciter_force[1])


def dense(scene, w, phases, senses):
    """Response of a body in its plane, with its matrices from the machine and the forces written out here."""
    carrier = scene.machine.carrier()
    force = np.zeros(3, complex)
    for exciter, phase, sense in zip(scene.exciters, phases, senses, strict=True):
        x, y = np.asarray(exciter.at)
        turning = float(exciter.unbalance) * np.exp(1j * phase) * np.array([1.0, -1j * sense])
        force += np.array([turning[0], turning[1], x * turning[1] - y * turning[0]])
    m, c, k = (np.asarray(each) for each in (carrier.mass, carrier.damping, carrier.stiffness))
    return np.linalg.solve(k - w**2 * m + 1j * w * c, w**2 * force)


def test_a_body_under_two_exciters_is_a_dense_solution():
    drive = jv.ConstantSpeed(80.0)
    places, senses, phases = ((-0.3, 0.4), (0.35, 0.3)), (1, -1), np.array([0.3, -0.8])
    scene = body([jv.Exciter(drive=drive, unbalance=0.4, at=at, direction=way) for at, way in zip(places, senses, strict=True)])
    found = jv.response(scene, SPEEDS, phases=phases)
    exact = np.stack([dense(scene, w, phases, senses) for w in SPEEDS])
    np.testing.assert_allclose(found.displacement, exact, rtol=1e-11)
    damping = np.asarray(scene.machine.carrier().damping)
    lost = SPEEDS**2 / 2.0 * np.einsum("sa,ab,sb->s", exact.conj(), damping, exact).real
    np.testing.assert_allclose(np.sum(found.power, axis=1), lost, rtol=1e-9)
    assert found.operating.speed.tolist() == [80.0] and not found.folds.exists.size


def test_many_platforms_are_a_dense_solution():
    n = 8
    machine = jv.network(
        mass=np.linspace(20.0, 60.0, n), stiffness=np.full(n, 4e4), damping=np.full(n, 30.0),
        links=[(k, k + 1) for k in range(1, n)], link_stiffness=np.full(n - 1, 9e4), link_damping=np.full(n - 1, 25.0),
        exciter=1,
    )  # fmt: skip
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=motor(30.0), unbalance=0.3, at=3)])
    found = jv.response(scene, SPEEDS)
    m, c, k = (np.asarray(each) for each in (machine.carrier().mass, machine.carrier().damping, machine.carrier().stiffness))
    force = -0.3j * np.eye(n)[2]
    exact = np.stack([np.linalg.solve(k - w**2 * m + 1j * w * c, w**2 * force) for w in SPEEDS])
    np.testing.assert_allclose(found.displacement, exact, rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(found.torque[:, 0], -0.15 * SPEEDS**2 * np.imag(1j * exact[:, 2]), rtol=1e-8)
    share = np.where(50.0 * np.pi > SPEEDS, found.torque[:, 0] / found.motor_torque[:, 0], np.inf)
    np.testing.assert_allclose(found.torque_share, share, rtol=1e-9)


def test_a_gyroscopic_rotor_is_a_dense_solution():
    machine = jv.rotor(
        mass=37.0, transverse_inertia=0.479, polar_inertia=0.4, stiffness=(6e5, 5e5), damping=(440.0, 400.0),
        position=(0.165, -0.155), stations=0.2,
    )  # fmt: skip
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=motor(60.0), unbalance=0.02, at=0.1, direction=-1)])
    speeds = np.array([50.0, 170.0, 300.0])
    found = jv.response(scene, speeds)
    carrier, skew = machine.carrier(), np.zeros((4, 4))
    skew[2, 3], skew[3, 2] = 0.4, -0.4
    m, c, k = (np.asarray(each) for each in (carrier.mass, carrier.damping, carrier.stiffness))
    force = 0.02 * np.array([1.0, 1j, 0.1, 0.1j])  # clockwise
    exact = np.stack([np.linalg.solve(k - w**2 * m + 1j * w * (c - w * skew), w**2 * force) for w in speeds])
    np.testing.assert_allclose(found.displacement, exact, rtol=1e-11)


def imbalanced(way, drive):
    machine = jv.rotor(
        mass=37.0, transverse_inertia=0.479, polar_inertia=0.093, stiffness=(6e5, 5e5), damping=(840.0, 800.0),
        position=(0.165, -0.155),
    )  # fmt: skip
    effects = (jv.StaticImbalance(0.03, angle=0.7), jv.MomentImbalance(1e-3, angle=-0.4))
    return jv.Scene(machine, exciters=[jv.Exciter(drive=drive, unbalance=0.02, at=0.1, direction=way, effects=effects)])


@pytest.mark.parametrize("way", [1, -1])
def test_imbalances_of_a_rotor_excite_the_machine(way):
    scene, w = imbalanced(way, jv.ConstantSpeed(120.0)), 120.0
    found = jv.response(scene, [w])
    carrier, skew = scene.machine.carrier(), np.zeros((4, 4))
    skew[2, 3], skew[3, 2] = 0.093, -0.093
    m, c, k = (np.asarray(each) for each in (carrier.mass, carrier.damping, carrier.stiffness))
    # A vector at the angle way (w t) + a is Re(e exp(i w t)) with e = exp(i way a) (1, -i way).
    heavy, inclined, turn = 0.03 * np.exp(0.7j * way), 1e-3 * np.exp(-0.4j * way), np.array([1.0, -1j * way])
    force = np.concatenate([(0.02 + heavy) * turn, (0.1 * 0.02 + inclined) * turn])
    exact = np.linalg.solve(k - w**2 * m + 1j * w * (c + way * w * skew), w**2 * force)
    np.testing.assert_allclose(found.displacement[0], exact, rtol=1e-10)
    np.testing.assert_allclose(found.torque[0, 0], w * np.real(exact.conj() @ c @ exact) / 2.0, rtol=1e-9)
    np.testing.assert_allclose(found.exciter_force, np.sqrt(2.0) * abs(0.02 + heavy) * w**2, rtol=1e-12)


@pytest.mark.slow
def test_a_motor_with_an_imbalance_runs_at_the_operating_point():
    scene = imbalanced(1, jv.DCMotor("1400 rpm", stall_torque=40.0, inertia=0.5))
    found = jv.response(scene).operating
    run = jv.simulate(scene, "30 s", save="window")
    there = np.flatnonzero(np.asarray(found.stable))
    nearest = there[np.argmin(np.abs(np.asarray(found.speed)[there] - run.omega))]
    np.testing.assert_allclose(run.omega, found.speed[nearest], rtol=2e-3)
    np.testing.assert_allclose(run.amplitude, found.amplitude[nearest], rtol=2e-2)


def test_operating_points_and_folds_are_scipys():
    scene = one_mass(drive=motor())
    found = jv.response(scene)
    assert {"operating_speed", "fold_speed"} <= set(found.to_xarray().variables)

    def share(w):
        return needed(w) / (12.0 * (1.0 - w / (50.0 * np.pi)))

    grid = np.linspace(1.0, 157.0, 200_000)
    values = share(grid)
    turns = 1 + np.flatnonzero(np.diff(np.sign(np.diff(values))))
    folds = []
    for k in turns:
        side = np.sign(values[k] - values[k - 50])
        near = {"bounds": (grid[k - 5], grid[k + 5]), "method": "bounded", "options": {"xatol": 1e-10}}
        folds.append(scipy.optimize.minimize_scalar(lambda w, side=side: -side * share(w), **near).x)
    assert found.folds.exists.tolist() == [True, True]
    np.testing.assert_allclose(found.folds.speed, folds, rtol=1e-7)
    np.testing.assert_allclose(found.folds.factor, share(found.folds.speed), rtol=1e-10)
    np.testing.assert_allclose(found.folds.torque, needed(found.folds.speed), rtol=1e-10)
    places = np.flatnonzero(np.diff(np.sign(values - 1.0)))
    roots = [scipy.optimize.brentq(lambda w: share(w) - 1.0, grid[k], grid[k + 1], xtol=1e-13) for k in places]
    np.testing.assert_allclose(found.operating.speed, roots, rtol=1e-11)
    assert found.operating.stable.tolist() == [True, False, True]
    for fold, low, high in ((0, folds[1], 157.0), (1, 1.0, folds[0])):
        lands = scipy.optimize.brentq(lambda w, fold=fold: share(w) - share(folds[fold]), low, high, xtol=1e-12)
        np.testing.assert_allclose(found.folds.lands_at[fold], lands, rtol=1e-7)


def test_operating_points_at_a_dip_of_the_torque_are_scipys():
    """The resonance at 30 rad/s and the dip at 90 rad/s can both catch the motor, which has one coordinate to shake."""
    dip = jv.TorqueTable([0.0, 80.0, 90.0, 100.0, 150.0, 157.0], [0.8, 0.8, 0.013, 0.8, 0.8, 0.0], inertia=0.1)
    machine = jv.one_mass(mass=MASS, stiffness=MASS * 30.0**2, damping=DAMPER)
    found = jv.response(jv.Scene(machine, exciters=[jv.Exciter(drive=dip, unbalance=S)]), SPEEDS)

    def gap(w):
        size = S * w**2 / np.abs(MASS * (30.0**2 - w**2) + 1j * w * DAMPER)
        return DAMPER * w * size**2 / 2.0 - np.interp(w, dip.speeds, dip.torques)

    brackets = ((25.0, 30.0), (30.1, 40.0), (80.0, 90.0), (90.0, 95.0), (120.0, 157.0))
    roots = [scipy.optimize.brentq(gap, *each, xtol=1e-12) for each in brackets]
    there = np.asarray(found.operating.exists)
    np.testing.assert_allclose(found.operating.speed[there], roots, rtol=1e-9)
    assert found.operating.stable[there].tolist() == [True, False, True, False, True]
    np.testing.assert_allclose(found.folds.lands_at[0], 90.0, atol=0.5)  # from the resonance into the dip


def test_operating_points_are_the_regimes_of_one_exciter():
    drive = jv.InductionMotor("1000 rpm", breakdown_torque=1.2, breakdown_slip=0.3, inertia=0.5)
    scene = body([jv.Exciter(drive=drive, unbalance=0.4, at=(0.1, 0.3))])
    operating, regimes = jv.response(scene).operating, jv.synchronous_regimes(scene)
    there, order = np.asarray(operating.exists), np.argsort(regimes.speed)
    assert there.sum() == order.size >= 3
    np.testing.assert_allclose(operating.speed[there], regimes.speed[order], rtol=1e-8)
    assert operating.stable[there].tolist() == regimes.stable[order].tolist()
    np.testing.assert_allclose(operating.growth[there], regimes.growth[order], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(operating.foundation_force[there], regimes.foundation_force[order], rtol=1e-7)


def test_a_run_at_constant_speed_settles_in_the_response():
    scene = body([jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.4, at=(0.1, 0.3))])
    run = jv.simulate(scene, "40 s", save="window")
    found = jv.response(scene, [60.0])
    np.testing.assert_allclose(run.amplitude, found.amplitude[0], rtol=1e-5)


def test_a_caught_motor_runs_at_the_operating_point():
    found = jv.response(one_mass(drive=motor()))
    heavy = jv.DCMotor("1500 rpm", stall_torque=12.0, inertia=4.0)  # runs up slowly
    run = jv.simulate(one_mass(drive=heavy), "90 s", save="window")
    speed = float(np.mean(run.window.rotor_speeds[0]))
    np.testing.assert_allclose(speed, found.operating.speed[0], rtol=2e-3)  # the torque of light unbalances, first order
    np.testing.assert_allclose(run.amplitude[0], found.operating.amplitude[0, 0], rtol=1e-2)


FIRST = jv.DCMotor("1000 rpm", stall_torque=1.0, inertia=0.05)
SECOND = jv.DCMotor("1200 rpm", stall_torque=0.3, inertia=0.09)


def sum_of_both():
    slope = 1.0 / float(FIRST.speed) + 0.3 / float(SECOND.speed)
    return jv.DCMotor(1.3 / slope, stall_torque=1.3, inertia=0.14)


def same_operation(one, other):
    """Compare operating points and folds; entries without a point are NaN in both."""
    names = ("speed", "displacement", "foundation_force", "torque_share", "growth")
    for name in names:
        np.testing.assert_allclose(getattr(one.operating, name), getattr(other.operating, name), rtol=1e-8, atol=1e-10)
    assert one.operating.exists.tolist() == other.operating.exists.tolist()
    assert one.operating.stable.tolist() == other.operating.stable.tolist()
    for name in ("speed", "factor", "torque", "lands_at"):
        np.testing.assert_allclose(getattr(one.folds, name), getattr(other.folds, name), rtol=1e-8)


@pytest.mark.parametrize("way", [1, -1])
def test_two_motors_on_one_shaft_are_one_motor(way):
    def exciter(drive, unbalance):
        return jv.Exciter(drive=drive, unbalance=unbalance, at=(0.1, 0.3), direction=way)

    two = jv.response(body([exciter(FIRST, 0.1), exciter(SECOND, 0.3)]))
    same_operation(two, jv.response(body([exciter(sum_of_both(), 0.4)])))
    operating, there = two.operating, np.asarray(two.operating.exists)
    assert there.sum() >= 3
    np.testing.assert_allclose(operating.torque[there].sum(axis=1), operating.motor_torque[there].sum(axis=1), rtol=1e-10)
    own = np.stack([np.asarray(motor.torque(operating.speed[there])) for motor in (FIRST, SECOND)], axis=1)
    np.testing.assert_allclose(operating.motor_torque[there], own, rtol=1e-12)


def test_geared_exciters_in_one_line_are_one_mass():
    springs = [jv.support(at=(x, 0.0), stiffness=(5e5, 4e5), damping=(100.0, 300.0)) for x in (-0.5, 0.5)]
    machine = jv.plane_body(mass=MASS, inertia=40.0, supports=springs)
    pair = [jv.Exciter(drive=motor(6.0), unbalance=0.1, at=(0.0, 0.0), direction=way) for way in (1, -1)]
    geared = jv.response(jv.Scene(machine, exciters=pair), phases=["0 deg", "180 deg"])  # forces across cancel
    single = jv.DCMotor("1500 rpm", stall_torque=12.0, inertia=0.2)
    alone = jv.response(one_mass(drive=single))
    there = np.asarray(alone.operating.exists)
    points = np.asarray(geared.operating.exists)
    assert points.sum() == there.sum() == 3
    for name in ("speed", "foundation_force", "growth"):
        values = (np.asarray(getattr(each.operating, name))[at] for each, at in ((geared, points), (alone, there)))
        np.testing.assert_allclose(*values, rtol=1e-7)
    folds = (np.asarray(each.folds.factor)[np.asarray(each.folds.exists)] for each in (geared, alone))
    np.testing.assert_allclose(*folds, rtol=1e-7)


def test_an_ideal_drive_supplies_the_lack_of_a_motor():
    exciters = [jv.Exciter(drive=drive, unbalance=0.2, at=(0.1, 0.3)) for drive in (jv.ConstantSpeed(80.0), FIRST)]
    found = jv.response(body(exciters)).operating
    assert found.speed.tolist() == [80.0]
    np.testing.assert_allclose(found.motor_torque[0, 1], FIRST.torque(80.0), rtol=1e-12)
    np.testing.assert_allclose(jnp.sum(found.motor_torque[0]), jnp.sum(found.torque[0]), rtol=1e-12)


def test_motors_without_a_common_speed_are_refused():
    slow = jv.InductionMotor("500 rpm", breakdown_torque=60.0, breakdown_slip=0.05, inertia=0.05)
    fast = jv.InductionMotor("1500 rpm", breakdown_torque=60.0, breakdown_slip=0.05, inertia=0.05)
    exciters = [jv.Exciter(drive=drive, unbalance=0.2, at=(0.1, 0.3)) for drive in (slow, fast)]
    with pytest.raises(jv.InputError, match=r"^exciters.drive brake each other at .*give motors on one shaft similar speeds"):
        jv.response(body(exciters))
    ideal = [jv.Exciter(drive=jv.ConstantSpeed(speed), unbalance=0.2, at=(0.1, 0.3)) for speed in (60.0, 61.0)]
    with pytest.raises(jv.InputError, match="give the same speed to all ideal drives"):
        jv.response(body(ideal))


def test_derivatives_of_a_shaft_are_finite_differences():
    def values(stall):
        drives = jv.DCMotor("1000 rpm", stall_torque=stall, inertia=0.05), SECOND
        found = jv.response(body([jv.Exciter(drive=each, unbalance=0.2, at=(0.1, 0.3)) for each in drives]), [55.0])
        return jnp.stack([found.operating.speed[2], found.operating.foundation_force[2], found.folds.factor[0]])

    near = [np.asarray(values(1.0 + k * 1e-3)) for k in (-2, -1, 1, 2)]
    difference = (near[0] - 8.0 * near[1] + 8.0 * near[2] - near[3]) / (12.0 * 1e-3)
    np.testing.assert_allclose(jax.jacfwd(values)(1.0), difference, rtol=1e-6)
    np.testing.assert_allclose(jax.jacrev(values)(1.0), difference, rtol=1e-6)


def test_derivatives_are_finite_differences():
    def values(stiffness):
        machine = jv.one_mass(mass=MASS, stiffness=stiffness, damping=DAMPER)
        found = jv.response(jv.Scene(machine, exciters=[jv.Exciter(drive=motor(), unbalance=S)]), [55.0])
        operating, folds = found.operating, found.folds
        points = [operating.speed[0], operating.foundation_force[2], folds.factor[0], folds.torque[1], folds.speed[1]]
        return jnp.stack([*points, found.amplitude[0, 0], found.foundation_force[0], found.torque[0, 0]])

    step = 1e-4 * SPRING
    near = [np.asarray(values(SPRING + k * step)) for k in (-2, -1, 1, 2)]
    difference = (near[0] - 8.0 * near[1] + 8.0 * near[2] - near[3]) / (12.0 * step)
    np.testing.assert_allclose(jax.jacrev(values)(SPRING), difference, rtol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(values)(SPRING), difference, rtol=1e-6)


def test_an_undamped_resonance_is_named_without_nan():
    at = np.sqrt(SPRING / MASS)
    found = jv.response(one_mass(damping=0.0), [at, 1.01 * at])
    assert "an undamped resonance" in found.message
    assert np.isinf(found.amplitude[0, 0]) and np.isinf(found.foundation_force[0]) and np.isfinite(found.amplitude[1, 0])
    numbers = [leaf for leaf in jax.tree.leaves(found) if np.issubdtype(np.asarray(leaf).dtype, np.inexact)]
    assert not any(np.any(np.isnan(each)) for each in numbers)

    def total(mass):
        machine = jv.one_mass(mass=mass, stiffness=SPRING, damping=0.0)
        scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(100.0), unbalance=S)])
        curve = jv.response(scene, [at, 1.01 * at])
        return jnp.sum(jnp.where(jnp.isfinite(curve.amplitude), curve.amplitude, 0.0))

    assert np.isfinite(jax.grad(total)(MASS))


def test_drive_at_an_undamped_resonance_has_unbounded_torque():
    """An ideal drive supplies the torque that the vibration needs, and a motor that of its curve, which is finite."""
    at = float(np.sqrt(SPRING / MASS))
    ideal = jv.response(one_mass(damping=0.0, drive=jv.ConstantSpeed(at)), [0.9 * at, at])
    np.testing.assert_array_equal(ideal.motor_torque, ideal.torque)
    assert np.isinf(ideal.torque[1, 0]) and np.isinf(ideal.operating.motor_torque[0, 0])
    assert "operating point, at an undamped resonance, inf N m" in ideal.summary()
    driven = jv.response(one_mass(damping=0.0, drive=motor()), [at])
    assert np.isinf(driven.torque[0, 0])
    np.testing.assert_allclose(driven.motor_torque[0, 0], motor().torque(at), rtol=1e-12)


def test_an_undamped_machine_lets_its_motor_idle():
    found = jv.response(one_mass(damping=0.0, drive=motor()))
    assert not np.any(found.folds.exists) and found.operating.exists.sum() == 1
    speed = found.operating.speed[np.asarray(found.operating.exists)][0]
    np.testing.assert_allclose(speed, 50.0 * np.pi, rtol=1e-12)


def test_default_speeds_reach_beyond_the_working_speed():
    """The working speed is 31 times the resonance; resonance and working speed are equally well covered."""
    soft = jv.one_mass(mass=MASS, stiffness=MASS * 5.0**2, damping=100.0)
    speeds = np.asarray(jv.response(jv.Scene(soft, exciters=[jv.Exciter(drive=motor(), unbalance=S)])).speed)
    np.testing.assert_allclose(speeds[-1], 4.0 / 3.0 * 50.0 * np.pi, rtol=1e-12)
    assert np.all(np.diff(speeds) >= 0.0) and np.max(np.diff(speeds) / speeds[1:], where=speeds[1:] > 1.0, initial=0.0) < 0.1


@pytest.mark.parametrize("damping", [0.0, 100.0])
def test_a_free_machine_has_an_operating_point(damping):
    """Without a spring the vibration needs the torque c S^2 w^3 / (2 (M^2 w^2 + c^2))."""
    free = jv.one_mass(mass=MASS, stiffness=0.0, damping=damping)
    found = jv.response(jv.Scene(free, exciters=[jv.Exciter(drive=motor(), unbalance=S)]))
    w = float(found.operating.speed[0])
    needed = damping * S**2 * w**3 / (2.0 * (MASS**2 * w**2 + damping**2))
    assert np.asarray(found.operating.exists).tolist() == [True, False, False] and w > 150.0
    np.testing.assert_allclose(needed, 12.0 * (1.0 - w / (50.0 * np.pi)), atol=1e-12)


def test_forces_that_cancel_cause_no_vibration():
    drive = jv.ConstantSpeed("1500 rpm")
    machine = jv.one_mass(mass=MASS, stiffness=SPRING, damping=DAMPER)  # moves up only
    exciters = [jv.Exciter(drive=drive, unbalance=S, direction=way) for way in (1, -1)]
    found = jv.response(jv.Scene(machine, exciters=exciters), SPEEDS)
    assert status_names(found.status).tolist() == ["done"] * SPEEDS.size
    assert not np.any(found.amplitude) and not np.any(found.torque) and np.all(np.isinf(found.transmissibility))


def test_converter_that_comes_to_rest_has_its_working_speed():
    stop = jv.SpeedProfile([0.0, 5.0, 60.0, 65.0], [0.0, 90.0, 90.0, 0.0])
    converter = jv.Converter(jv.DCMotor(120.0, stall_torque=8.0, inertia=0.1), stop)
    shifted = jv.DCMotor(90.0, stall_torque=6.0, inertia=0.1)  # the same line, moved to the no-load speed 90 rad/s
    first, second = (body([jv.Exciter(drive=drive, unbalance=S)] * 2) for drive in (converter, shifted))
    found, exact = (jv.response(scene, SPEEDS) for scene in (first, second))
    np.testing.assert_allclose(found.motor_torque, exact.motor_torque, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.operating.speed, exact.operating.speed, rtol=1e-9)
    np.testing.assert_allclose(found.folds.factor, exact.folds.factor, rtol=1e-9)
    found, exact = map(jv.synchronous_regimes, (first, second))
    np.testing.assert_allclose(found.speed, exact.speed, rtol=1e-9)
    np.testing.assert_allclose(found.power, exact.power, rtol=1e-7, atol=1e-9)


def test_a_batch_is_its_scenes():
    def speed(stiffness):
        machine = jv.one_mass(mass=MASS, stiffness=stiffness, damping=DAMPER)
        return jv.response(jv.Scene(machine, exciters=[jv.Exciter(drive=motor(), unbalance=S)]), [50.0]).operating.speed

    many = jax.vmap(speed)(jnp.array([6e5, SPRING]))
    np.testing.assert_allclose(many[1], speed(SPRING), rtol=1e-12)


@pytest.mark.parametrize("stiffness", [153500.0, 153492.0])
def test_equal_speeds_are_no_peaks(stiffness):
    """Default speeds with pairs that differ by rounding (first stiffness), and so do their forces."""
    machine = jv.planar_rotor(mass=12.0, stiffness=stiffness, damping="2 %")
    exciter = jv.Exciter(drive=jv.ConstantSpeed("3000 rpm"), unbalance=2e-3)
    assert len(jv.response(jv.Scene(machine, exciters=[exciter]), most="4000 rpm").peaks()) == 1


def test_speeds_that_overflow_have_a_status():
    exciter = jv.Exciter(drive=jv.DCMotor(1.5e308, stall_torque=60.0, inertia=0.05), unbalance=0.4)
    with pytest.raises(jv.ComputationError, match=r"^overflow: speeds of the response are not finite"):
        jv.response(jv.Scene(jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0), exciters=[exciter]))


def test_torques_that_overflow_have_a_status():
    exciter = jv.Exciter(drive=jv.DCMotor(100.0, stall_torque=60.0, inertia=0.05), unbalance=1e154)
    with pytest.raises(jv.ComputationError, match=r"^overflow: values of the response are not finite"):
        jv.response(jv.Scene(jv.one_mass(mass=300.0, stiffness=6e4, damping=600.0), exciters=[exciter]))


def test_scenes_with_loads_are_refused():
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    with pytest.raises(jv.InputError, match=r"^loads turn at a speed of their own.*use branches \(command modes\)$"):
        jv.response(scene)
    several = jv.Scene(machine, exciters=[jv.Exciter(scene.loads, scene.drive), jv.Exciter(None, scene.drive, unbalance=0.01)])
    with pytest.raises(jv.InputError, match=r"for loads use synchronous_regimes \(command regimes\) or simulate$"):
        jv.response(several)


@pytest.mark.parametrize(("name", "value"), [("most", b"12"), ("most", True), ("most", -1.0), ("points", 0)])
def test_settings_of_default_speeds_are_validated_beside_speeds(name, value):
    with pytest.raises(jv.InputError, match=rf"^{name} is "):
        jv.response(one_mass(drive=motor()), [10.0], **{name: value})


def test_the_figure_shows_curves_motor_and_folds():
    found = jv.response(one_mass(drive=motor()))
    labels = [text for axis in found.plot().axes for text in axis.get_legend_handles_labels()[1]]
    assert {"y1", "force on the foundation", "needed by the vibration", "of the motor", "fold: the speed jumps"} <= set(labels)
    with pytest.raises(jv.InputError, match="show"):
        found.plot(show=["speed"])


def test_the_curve_of_a_motor_contains_its_operating_points():
    found = jv.response(one_mass(drive=jv.InductionMotor("1500 rpm", 40.0, 0.1, inertia=0.1)))
    axis = found.plot(show=["torque"], unit="rad/s").axes[0]
    (line,) = (each for each in axis.get_lines() if each.get_label() == "of the motor")
    speeds, torques = line.get_data()
    points = found.operating
    for k in np.flatnonzero(points.exists):
        assert np.interp(points.speed[k], speeds, torques) == pytest.approx(float(points.torque[k, 0]), rel=1e-9)
    slip = 1.0 - speeds / found.scene.drive.speed
    np.testing.assert_allclose(torques, 2.0 * 40.0 * 0.1 * slip / (slip**2 + 0.1**2), atol=1e-9)
    assert np.max(np.diff(speeds[speeds <= found.scene.drive.speed])) < 0.003 * found.scene.drive.speed


def test_motor_that_is_off_has_no_folds():
    for bearing in (0.0, 0.01):
        off = jv.SwitchedOff(jv.DCMotor(460.0, stall_torque=20.0, inertia=0.1), at=5.0, bearing=bearing)
        machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
        found = jv.response(jv.Scene(machine, exciters=[jv.Exciter(drive=off, unbalance=1e-3)]))
        assert not np.any(found.folds.exists) and np.all(np.isnan(found.folds.factor)) and "fold" not in found.summary()
