"""Jams at unequal phases: against quadrature, closed forms, the paper's speeds, and the full equations in a turning frame."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import machines
from scenes import scene as platforms

import jaxvib as jv
from jaxvib.draw.style import COLORS
from jaxvib.equations.torque_balance import assemble_torque_balance, influence_of, torques_at
from jaxvib.numerics.linalg import eliminate
from jaxvib.steady.jams.jam import STABILITY_CRITERION, STABILITY_OF_FREE_LOADS
from jaxvib.steady.jams.patterns import is_same_pattern
from jaxvib.steady.jams.phase_search import phase_branch
from jaxvib.steady.jams.phases import growth_of_free_loads, phase_jam, phase_pattern

K1, K2, L1, L2 = 0.604e6, 0.555e6, 0.165, 0.155
STATIONS = (0.28, 0.25, -0.25, -0.28)


def rotor(mu, c2=0.0, b3=10.41, stations=STATIONS):
    """The rotor of Artyunin 2013 with bearing friction mu; its damping terms b1, b2, b3 as printed."""
    machine = jv.rotor(
        mass=37.0,
        transverse_inertia=0.479,
        polar_inertia=0.093,
        stiffness=(K1, K2),
        damping=(420.0, 420.0),
        position=(L1, -L2),
        stations=stations,
        stiffness_terms=(K1 + K2, c2, K1 * L1**2 + K2 * L2**2),
        damping_terms=(843.17, -0.47 if c2 else 0.0, b3),
    )
    return jv.Scene(machine, jv.pendulums(count=4, mass=0.05, radius=0.08, drag=mu / 0.08**2), jv.ConstantSpeed(460.0))


def planar(drag=0.04, count=2, **more):
    machine = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
    return jv.Scene(machine, jv.pendulums(count=count, mass=0.05, radius=0.08, drag=drag, **more), jv.ConstantSpeed(460.0))


def stable(jams):
    return [jams.select(k) for k in range(jams.omega.shape[0]) if bool(jams.stable[k])]


def test_torques_are_means_over_a_turn():
    """The carrier's motion under all loads in NumPy, and the mean of - m R p' . a over 64 angles."""
    scene, w, phase = rotor(1e-3, 13635.0), 240.0, np.array([0.3, -1.0, 2.0, 4.0])
    carrier = scene.machine.carrier()
    rows = np.stack([np.asarray(scene.machine.rows_at(s)) for s in STATIONS])
    mass = np.asarray(carrier.mass) + sum(0.05 * row.T @ row for row in rows)
    damping = np.asarray(carrier.damping + 460.0 * scene.machine.mount().gyroscopic)
    force = sum(
        0.05 * 0.08 * w**2 * row.T @ (np.array([1.0, -1.0j]) * np.exp(1j * a)) for row, a in zip(rows, phase, strict=True)
    )
    answer = np.linalg.solve(np.asarray(carrier.stiffness) - w**2 * mass + 1j * w * damping, force)
    angle = 2.0 * np.pi * np.arange(64) / 64.0
    acceleration = -(w**2) * (answer[:, None] * np.exp(1j * angle)).real
    balance = assemble_torque_balance(scene)
    torques = torques_at(balance.unbalance, influence_of(balance, jnp.asarray(w)), w, np.exp(1j * phase))
    for row, a, torque in zip(rows, phase, torques, strict=True):
        tangent = np.stack([-np.sin(angle + a), np.cos(angle + a)])
        np.testing.assert_allclose(torque, -0.05 * 0.08 * np.mean(np.sum(tangent * (row @ acceleration), axis=0)), rtol=1e-10)


def needed_friction(w, pattern, b3):
    """Bearing friction mu at which the loads jam at w, by the paper's closed forms."""
    ml, a, inertia = 0.05 * 0.08, 0.265, 0.479 + 0.05 * sum(s**2 for s in STATIONS)
    if pattern == "together":
        c, b = K1 + K2 - 37.2 * w**2, 843.17 * w
        return 4.0 * ml**2 * 843.17 * w**5 / (c**2 + b**2) / (460.0 - w)
    c, b = K1 * L1**2 + K2 * L2**2 - inertia * w**2 + 0.093 * 460.0 * w, b3 * w
    return ml**2 * a * sum(map(abs, STATIONS)) * b3 * w**5 / (c**2 + b**2) / (460.0 - w)


@pytest.mark.parametrize(
    ("mu", "b3", "start", "phase", "pattern"),
    [
        (9.2e-4, 10.41, 169.0, [0.0, 0.1, 0.1, 0.0], "together"),
        (3e-4, 10.41, 120.0, [0.0, 0.0, 0.0, 0.0], "together"),
        (1.24e-2, 21.56, 271.0, [0.0, 0.1, np.pi, np.pi], "opposite"),
        (3e-3, 21.56, 200.0, [0.0, 0.1, np.pi, np.pi], "opposite"),
    ],
)
def test_closed_forms_of_the_rotor(mu, b3, start, phase, pattern):
    jam = phase_jam(rotor(mu, 0.0, b3), start, jnp.asarray(phase))
    assert bool(jam.status == jv.PhaseStatus.found)
    assert bool(jam.pattern == getattr(jv.PhasePattern, pattern))
    np.testing.assert_allclose(needed_friction(float(jam.omega), pattern, b3), mu, rtol=0.01)


def test_the_papers_jams_of_the_rotor():
    """All phases equal: 169.6 at 9.2e-4, gone above 9.5e-4; opposite pairs: 271.1; no first jam with c2 as printed."""
    (first,) = stable(jv.phase_jams(rotor(9.2e-4), starts=8))
    assert bool(first.pattern == jv.PhasePattern.together) and abs(float(first.omega) - 169.6) < 0.05
    assert stable(jv.phase_jams(rotor(9.6e-4), starts=8)) == []
    for scene in (rotor(1.24e-2, 0.0, 21.56), rotor(1.02e-2, 13635.0)):
        (second,) = stable(jv.phase_jams(scene, starts=8))
        assert bool(second.pattern == jv.PhasePattern.opposite) and abs(float(second.omega) - 271.1) < 0.1
    assert stable(jv.phase_jams(rotor(9.2e-4, 13635.0), starts=8)) == []


@pytest.mark.slow
@pytest.mark.parametrize(("mu", "c2", "b3"), [(9.2e-4, 0.0, 10.41), (1.24e-2, 0.0, 21.56), (1.02e-2, 13635.0, 10.41)])
def test_other_and_more_starts_find_the_same_jams(mu, c2, b3):
    usual, more = jv.phase_jams(rotor(mu, c2, b3)), jv.phase_jams(rotor(mu, c2, b3), starts=300, seed=7)
    np.testing.assert_allclose(usual.omega, more.omega, rtol=1e-8)


def turning_frame(scene, jam):
    """The full equations' flow in the frame that turns with the jam, at the jam: its rest, and its Jacobian."""
    nd, n, w = jam.displacement.shape[0], jam.phase.shape[0], jam.omega
    spin = jnp.kron(jnp.eye(nd // 2), jnp.array([[0.0, -1.0], [1.0, 0.0]]))
    field = jv.vector_field(scene)

    def flow(x):
        q, v, phi, rate = x[:nd], x[nd : 2 * nd], x[2 * nd : 2 * nd + n], x[2 * nd + n :]
        change = field(0.0, jv.State(q, v, (phi,), (rate,)))
        parts = (change.displacement - w * spin @ q, change.velocity - w * spin @ v, change.angle[0] - w, change.rate[0])
        return jnp.concatenate(parts)

    rest = (jam.displacement.real, (1j * w * jam.displacement).real, jam.phase, jnp.full(n, w))
    at = jnp.concatenate(rest)
    return eqx.filter_jit(lambda x: (flow(x), jax.jacfwd(flow)(x)))(at)


@pytest.mark.parametrize("which", ["rotor together", "rotor opposite", "rotor unequal", "planar heavy"])
def test_jams_on_isotropic_supports_are_exact(which):
    scene, start, phase = {
        "rotor together": (rotor(9.2e-4), 169.6, [0.0] * 4),
        "rotor opposite": (rotor(1.24e-2, 0.0, 21.56), 271.1, [0.0, 0.13, -3.0, 3.14]),
        "rotor unequal": (rotor(1.02e-2, 13635.0), 271.0, [0.0, 0.06, -3.05, -3.12]),
        "planar heavy": (planar(4.0, 3, inertia=1e-3), 160.0, [0.0] * 3),
    }[which]
    jam = phase_jam(scene, start, jnp.asarray(phase))
    rest, matrix = turning_frame(scene, jam)
    assert bool(jam.status == jv.PhaseStatus.found)
    assert np.max(np.abs(rest)) < 1e-9 * float(jam.omega) ** 2
    values = np.linalg.eigvals(np.asarray(matrix))
    others = np.delete(values, np.argmin(np.abs(values)))
    np.testing.assert_allclose(float(jam.growth), np.max(others.real), atol=1e-6 * np.max(np.abs(values)))
    assert bool(jam.stable) == (np.max(others.real) < 0.0)


def test_equal_phases_on_platforms_are_the_jam_modes():
    scene = jv.Scene(machines()["two_mass"], jv.balls(count=2, mass=0.02, radius=0.12, drag=2e-3), jv.ConstantSpeed(80.0))
    modes, jams = jv.jam_modes(scene), jv.phase_jams(scene, starts=8)
    spread = np.max(np.abs(np.exp(1j * np.asarray(jams.phase)) - 1.0), axis=1)
    together = [k for k in range(spread.size) if spread[k] < 1e-6]
    numbers = modes.mode_numbers()[::-1]
    np.testing.assert_allclose(jams.omega[np.asarray(together)], [float(modes.omega[k - 1]) for k in numbers], rtol=1e-9)
    for k, number in zip(together, numbers, strict=True):
        mode, jam = modes.select(number), jams.select(k)
        np.testing.assert_allclose(jam.amplitude, mode.amplitude, rtol=1e-6)
        np.testing.assert_allclose(jam.foundation_force, mode.foundation_force, rtol=1e-6)
        assert not bool(jam.stable) or bool(mode.stable)


def test_a_branch_over_the_drag_passes_its_folds():
    scene = rotor(9.2e-4)
    jam = phase_jam(scene, 169.6, jnp.zeros(4))
    omega = np.sort(
        np.append(
            np.concatenate([np.linspace(150.0, 168.0, 10), np.linspace(169.0, 171.0, 41), [180.0, 200.0]]), float(jam.omega)
        )
    )
    branch = phase_branch(scene, jam, omega)
    np.testing.assert_allclose(branch.drag_factor[int(np.argmin(np.abs(omega - float(jam.omega))))], 1.0, rtol=1e-8)
    expected = [needed_friction(w, "together", 10.41) / 9.2e-4 for w in omega]
    np.testing.assert_allclose(branch.drag_factor, expected, rtol=0.01)
    np.testing.assert_allclose(branch.phase, 0.0, atol=1e-9)
    # The peak of the drag that the vibration can hold is the fold; the pattern parts before it, at 9.5e-4 as the paper says.
    assert not np.any(branch.stable[int(np.argmax(branch.drag_factor)) :])
    last = np.max(np.asarray(branch.drag_factor)[np.asarray(branch.stable)])
    assert 9.2e-4 < 9.2e-4 * last < 9.6e-4
    for wrong in ([100.0, 500.0], []):
        with pytest.raises(jv.InputError, match="omega must be an ascending list of load speeds"):
            phase_branch(scene, jam, wrong)


def test_figure_of_a_branch_is_solid_where_it_is_stable():
    scene = rotor(9.2e-4)
    omega = np.linspace(140.0, 190.0, 53)
    branch = phase_branch(scene, phase_jam(scene, 169.6, jnp.zeros(4)), omega)
    (axis,) = branch.plot(unit="rpm").axes
    assert axis.get_xlabel() == "drag, N s/m" and axis.get_ylabel() == "load speed, rpm"
    expected = np.stack([np.asarray(branch.drag_factor) * 9.2e-4 / 0.08**2, 30.0 / np.pi * omega], axis=1)
    lines = [line for line in axis.lines if len(line.get_xdata()) > 2]
    assert [line.get_linestyle() for line in lines] == ["--", "-", "--"]  # patterns part below 151 and above 170 rad/s
    changes = np.flatnonzero(np.diff(np.asarray(branch.stable).astype(int)) != 0) + 1
    for line, start, stop in zip(lines, [0, *changes], [*(changes + 1), 53], strict=True):
        np.testing.assert_allclose(line.get_xydata(), expected[start:stop], rtol=1e-12)
    assert {"rotor speed", "the scene's drag; points: its jams", "unstable"} <= {line.get_label() for line in axis.lines}
    np.testing.assert_allclose(
        [line.get_ydata()[0] for line in axis.lines if line.get_label() == "rotor speed"], 460.0 * 30.0 / np.pi
    )
    with pytest.raises(jv.InputError, match="unit is 'mph'; it must be one of 'rad/s', 'rpm', 'Hz'"):
        branch.plot(unit="mph")


def test_figure_of_all_jams_has_each_on_a_line():
    jams = jv.phase_jams(planar(), starts=8)
    (axis,) = jams.plot(unit="rad/s").axes
    assert axis.get_xlabel() == "drag, N s/m" and axis.get_xlim() == pytest.approx((0.04 / 30.0, 0.04 * 30.0))
    lines = [line.get_xydata() for line in axis.lines if len(line.get_xdata()) > 2 and line.get_linestyle() != "None"]
    for w in np.asarray(jams.omega):
        assert any(np.min(np.abs(line - [0.04, w])[np.isfinite(line[:, 0])].sum(axis=1)) < 1e-6 for line in lines)
    points = {line.get_markerfacecolor(): line.get_ydata() for line in axis.lines if line.get_marker() == "o"}
    np.testing.assert_allclose(points["black"], [w for w, good in zip(jams.omega, jams.stable, strict=True) if good])
    assert len(points["white"]) == 2


@pytest.mark.parametrize("times", [1e-3, 200.0])
def test_figure_of_all_jams_reaches_their_greatest_drag(times):
    scene = planar(0.04 * times)
    factor = float(jv.drag_limits(scene, phases=True).factor[0])
    (axis,) = jv.phase_jams(scene, starts=8).plot(unit="rad/s").axes
    low, high = np.divide(axis.get_xlim(), 0.04 * times)
    assert not 1.0 / 30.0 < factor < 30.0 and low < factor < high
    drags = np.concatenate([line.get_xdata() for line in axis.lines if len(line.get_xdata()) > 2])
    assert np.nanmin(np.abs(np.log(drags / (0.04 * times * factor)))) < 0.05


def test_derivatives_are_the_implicit_function_theorems():
    """Central differences, step 1e-5 of each number: their error is about 1e-9."""
    phase = jnp.array([0.0, 0.13, -3.0, 3.14])

    def answer(mu, b3, mass):
        scene = eqx.tree_at(lambda s: s.loads.mass, rotor(1e-2, 0.0, 21.56), mass)
        scene = eqx.tree_at(lambda s: s.loads.drag, scene, mu / 0.08**2)
        scene = eqx.tree_at(lambda s: s.machine.damping_terms, scene, jnp.array([843.17, 0.0, 1.0]).at[2].set(b3))
        jam = phase_jam(scene, 271.0, phase)
        return (jnp.concatenate([jam.omega[None], jnp.sin(jam.phase[1:]), 1e3 * jam.amplitude]),) * 2

    at = (jnp.asarray(1.24e-2), jnp.asarray(21.56), jnp.asarray(0.05))
    both = eqx.filter_jit(jax.jacfwd(answer, argnums=(0, 1, 2), has_aux=True))
    forward, _ = both(*at)
    reverse, _ = eqx.filter_jit(jax.jacrev(answer, argnums=(0, 1, 2), has_aux=True))(*at)
    for k in range(3):
        up, down = ([x * (1.0 + s * (i == k)) for i, x in enumerate(at)] for s in (1e-5, -1e-5))
        difference = (both(*up)[1] - both(*down)[1]) / (2e-5 * at[k])
        np.testing.assert_allclose(forward[k], difference, rtol=1e-5, atol=1e-6 * np.max(np.abs(difference)))
        np.testing.assert_allclose(reverse[k], forward[k], rtol=1e-8, atol=1e-10 * np.max(np.abs(forward[k])))


def test_a_common_turn_and_equal_loads_make_no_new_jam():
    rng = np.random.default_rng(0)
    phase, groups = rng.uniform(-3.0, 3.0, 4), [np.array([0, 1]), np.array([2, 3])]
    assert is_same_pattern(phase, phase + 1.234, groups) and is_same_pattern(phase, phase[[1, 0, 2, 3]] - 9.0, groups)
    assert not is_same_pattern(phase, phase[[2, 1, 0, 3]], groups) and not is_same_pattern(
        phase, phase + np.array([0.0, 0.0, 0.0, 1e-3]), groups
    )


def test_elimination_is_numpys():
    rng = np.random.default_rng(1)
    for n in (1, 2, 5):
        a, b = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n)), rng.normal(size=(n, 3))
        a[0, 0] = 0.0 if n > 1 else 1.0
        np.testing.assert_allclose(eliminate(jnp.asarray(a), jnp.asarray(b, complex)), np.linalg.solve(a, b), rtol=1e-10)


def test_loads_that_balance_are_no_jam():
    jam = phase_jam(planar(), 459.9, jnp.array([0.0, np.pi]))
    assert jv.PhaseStatus[jam.status].startswith("the loads turn with the rotor") and np.isclose(jam.omega, 460.0)
    lost = phase_jam(planar(), 1e9, jnp.array([0.0, 1.0]))
    assert bool(lost.status == jv.PhaseStatus.not_converged) and np.isnan(lost.omega) and np.isnan(lost.amplitude).all()


def test_wrong_questions():
    with pytest.raises(jv.InputError, match=r"loads.drag is 0; this function needs a viscous drag greater than 0"):
        jv.phase_jams(planar(0.0))
    with pytest.raises(jv.InputError, match=r"phase has shape \(3,\); one phase for each load is needed, \(2,\)"):
        phase_jam(planar(), 100.0, jnp.zeros(3))
    starts = ((np.ones(2), np.zeros(2)), (-1.0, np.zeros(2)), (1.0, 0.0))
    for near, says in zip(starts, ("omega has shape", "omega is -1", "phase has shape"), strict=True):
        with pytest.raises(jv.InputError, match=says):
            jv.phase_jams(planar(), near=near)
    with pytest.raises(jv.InputError, match=r"phase\[1\] is nan rad; a finite number is needed"):
        jv.phase_jams(planar(), near=(100.0, np.asarray([0.0, np.nan])))
    with pytest.raises(jv.InputError, match="starts is 0"):
        jv.phase_jams(planar(), starts=0)
    jams = jv.phase_jams(planar(), starts=8)
    assert "stable" in jams.summary() and "all together" in jams.summary() and "as points" not in jams.summary()
    sized = eqx.tree_at(lambda j: j.scene.loads.ball_radius, jams, jnp.asarray(0.01), is_leaf=lambda leaf: leaf is None)
    points, hint = sized.summary().splitlines()[-2:]
    assert points == "loads count as points: jams at free phases do not include their ball_radius"
    assert hint == "(jam_modes places equal loads side by side)"
    with pytest.raises(jv.InputError, match="index is 3; there are 3 jams, counted from 0"):
        jams.select(3)


@pytest.mark.parametrize(
    ("degrees", "pattern"),
    [
        ([0.0] * 7 + [-76.18], "other"),
        ([0.0] * 7 + [61.42], "other"),
        ([0.0, 10.0, 20.0, 40.0], "together"),
        ([0.0] * 7 + [180.0], "other"),
        ([0.0, 5.0, 180.0, 190.0], "opposite"),
        ([0.0, 60.0, 180.0, 240.0], "spread"),
    ],
)
def test_patterns_hold_for_every_load(degrees, pattern):
    assert bool(phase_pattern(jnp.radians(jnp.asarray(degrees))) == getattr(jv.PhasePattern, pattern))


def test_jams_by_slope_are_judged_for_loads_that_may_part():
    """On platforms only the jam below a resonance keeps free loads; in mode 5, which is stable by slope, they separate."""
    s = platforms()
    modes = jv.jam_modes(s)
    growth = growth_of_free_loads(s, modes.omega)
    assert modes.stable.tolist() == [False, False, True, False, True]
    np.testing.assert_array_equal(np.isnan(growth), [True, True, False, False, False])
    assert growth[2] < 0.0 < growth[3] and growth[4] > 0.0
    assert modes.stable_with_free_loads(s).tolist() == [False, False, True, False, False]
    for given, label, filled in (((), "stable by slope", [3, 5]), ((s,), "stable with free loads", [3])):
        speeds = modes.plot(*given).axes[0]
        assert [x for x in speeds.lines[0].get_xdata() if x in modes.mode_numbers()] == filled
        assert label in [text.get_text() for text in speeds.get_legend().get_texts()]
    # The full equations, loads 0.01 rad apart, and together.
    asked = dict(start="jam", mode=5, estimate=False, samples=2)
    coincident, separated = (jv.simulate(s, 2.0, separation=a, **asked) for a in (0.0, 0.01))
    separation = [float(np.ptp(run.trajectory.state.angle[0][k])) for run in (coincident, separated) for k in (0, -1)]
    assert separation[0] == 0.0 and separation[1] < 1e-6 and abs(separation[2] - 0.02) < 1e-12 and separation[3] > 0.5
    assert bool(coincident.coincident) and not bool(separated.coincident)
    assert coincident.summary().startswith("not settled: loads of one track are at nearly one angle, and")
    assert "unstable" not in separated.summary()


def test_touching_balls_leave_the_jams_that_points_leave():
    """Mode 5 of these touching balls is stable by slope only: `phase_jams`, whose balls are points, has one stable jam.

    In a run the balls stay in mode 1 and leave mode 5.
    """
    machine = jv.planar_rotor(mass=18.0, stiffness=3e4, damping="8 %", stiffness_up=4e4, damping_up="8 %")
    balls = jv.balls(count=6, mass=0.1, radius=0.25, drag=0.15, ball_radius=0.015)
    s = jv.Scene(machine, balls, jv.ConstantSpeed("1200 rpm"), (jv.LoadContact(stiffness=1e5, restitution=0.6),))
    modes, phases = jv.jam_modes(s), jv.phase_jams(s)
    assert modes.stable.tolist() == [True, False, False, False, True]
    assert modes.stable_with_free_loads(s).tolist() == [True, False, False, False, False]
    assert abs(float(phases.omega[int(np.flatnonzero(phases.stable)[0])]) / float(modes.omega[0]) - 1.0) < 0.02
    text = modes.summary(s)
    assert np.sum(phases.stable) == 1 and "if they stay together" not in text and "several modes are stable" not in text
    for mode, stays in ((1, True), (5, False)):
        angle = jv.simulate(s, 3.0, start="jam", mode=mode, estimate=False, samples=2).trajectory.state.angle[0]
        assert (float(np.ptp(angle[1])) < 1.01 * float(np.ptp(angle[0]))) == stays


def test_branch_diagram_is_dashed_where_loads_separate():
    """The loads leave mode 5, which is stable by slope, see above. A single load cannot leave it."""
    several = platforms()
    balls = several.loads
    alone = jv.balls(count=1, mass=balls.count * balls.mass, radius=balls.radius, drag=balls.count * balls.drag)
    for s, styles in ((several, ("-", "--")), (several.replace(loads=alone), ("-", "-"))):
        modes = jv.jam_modes(s)
        axis = jv.branches(s).plot(unit="rad/s").axes[0]
        lines = [line for line in axis.lines if line.get_color() == COLORS[0]]
        for mode, style in zip((3, 5), styles, strict=True):
            place = np.array([[float(s.drive.speed)], [float(modes.omega[mode - 1])]])
            points = [np.nan_to_num(np.linalg.norm(np.array(line.get_data()) / place - 1.0, axis=0), nan=9.0) for line in lines]
            far = [float(np.min(each, initial=9.0)) for each in points]
            assert min(far) < 1e-2 and lines[int(np.argmin(far))].get_linestyle() == style


def test_stability_with_a_stride_differs_at_few_points():
    curve = jv.branches(platforms())
    (each, text), (some, same) = curve.with_free_loads(), curve.with_free_loads(stride=16)
    assert text == same and np.sum(np.asarray(curve.stable) & ~np.asarray(each.stable)) > 300
    assert np.sum(np.asarray(each.stable) != np.asarray(some.stable)) < 50


@pytest.mark.parametrize("unknown, text", [(slice(1), STABILITY_OF_FREE_LOADS), (slice(None), STABILITY_CRITERION)])
def test_criterion_of_branches_where_growth_is_unknown(monkeypatch, unknown, text):
    def growth(scene, omega, rotor_speed):
        values = np.full(omega.shape, -1.0)
        values[unknown] = np.nan
        return values

    curve = jv.branches(platforms(), points=200)
    monkeypatch.setattr("jaxvib.steady.branches.growth_of_free_loads", growth)
    stricter, found = curve.with_free_loads()
    assert found == text
    np.testing.assert_array_equal(stricter.stable, curve.stable)


def test_every_jam_is_listed_once_and_in_order():
    """Three equal balls on two platforms; many starts hardly reach the jams next to the rotor speed."""
    jams = jv.phase_jams(platforms())
    omega = np.asarray(jams.omega)
    assert omega.size == 6 and np.all(np.diff(omega) < 0.0) and np.min(-np.diff(omega)) > 0.5
    assert jams.stable.tolist() == [False] * 5 + [True] and int(jnp.sum(jams.starts)) > 100


@pytest.mark.parametrize("stiffness", [1e5, 3e5])
def test_an_undamped_motion_apart_from_the_loads_is_not_stable(stiffness):
    """Its growth is 0 up to rounding of either sign."""
    damping, springs = np.diag([843.0, 843.0, 0.0]), np.diag([1.16e6, 1.16e6, stiffness])
    machine = jv.from_matrices(37.0 * np.eye(3), damping, springs, places=[[0, 1]])
    loads = jv.pendulums(count=1, mass=0.05, radius=0.08, drag=0.04)
    scene = jv.Scene(machine, exciters=[jv.Exciter(loads, jv.ConstantSpeed(460.0), at=1)])
    jam = jv.phase_jams(scene, near=(165.0, np.zeros(1)))
    assert abs(float(jam.growth)) < 1e-9 and not jam.stable


@pytest.mark.parametrize(("second", "mirrored"), [(6e5, True), (6.1e5, False)])
def test_exchanges_of_equal_planes_are_one_row(second, mirrored):
    """The results keep all jams."""
    machine = jv.rotor(
        mass=37.0, transverse_inertia=0.5, polar_inertia=0.1, stiffness=(6e5, second), damping=(400.0, 400.0),
        position=(0.15, -0.15), stations=(0.1, 0.1, -0.1, -0.1),
    )  # fmt: skip
    loads = jv.pendulums(count=4, mass=0.05, radius=0.08, drag=0.1)
    jams = jv.phase_jams(jv.Scene(machine, loads, jv.ConstantSpeed(460.0)), starts=16)
    several = [each for each in jams.distinct if len(each) > 1]
    assert sorted(np.concatenate(jams.distinct).tolist()) == list(range(jams.omega.size)) and bool(several) == mirrored
    rows = jams.summary().splitlines()
    assert len(rows) == len(jams.distinct) and sum("(2 mirror images)" in row for row in rows) == len(several)
    for first, other in several:
        for name in ("omega", "growth", "foundation_force"):
            np.testing.assert_allclose(getattr(jams, name)[first], getattr(jams, name)[other], rtol=1e-6)
        swapped = jams.phase[other][jnp.array([2, 3, 0, 1])]
        assert is_same_pattern(jams.phase[first], swapped, [np.array([0, 1]), np.array([2, 3])])
    if mirrored:
        assert len(several) >= 3
