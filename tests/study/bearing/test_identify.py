"""A bearing's friction from a swing: the swing against SciPy and closed forms, the fit against records made by SciPy."""

import json

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import jaxvib as jv
from jaxvib.cli.app import run
from jaxvib.machine.effects.friction import sliding_sign
from jaxvib.study.bearing.identify import first_guess, fit_swing, steps_for, student_quantile
from jaxvib.study.bearing.swing import SwingStatus, swing_states

T = 0.05 * np.arange(400)
"""The times of most records: one length, so that the fit is compiled once."""
ROD = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.00625, bearing=0.02)


def scipy_swing(rod, times, angle, rate, viscous, dry=0.0):
    """The swing with the sharp sign of sliding, half a swing at a time, and when dry friction stops it (NaN: never)."""
    m, l, j, d, g = (float(x) for x in (rod.mass, rod.length, rod.total_inertia, rod.bearing, rod.g))
    out, t, y = np.full(len(times), np.nan), times[0], np.array([angle, rate])
    while True:
        sign = np.sign(y[1]) if y[1] != 0.0 else -np.sign(y[0])
        if y[1] == 0.0 and abs(np.tan(y[0])) < dry * d / (2.0 * l):
            out[times >= t] = y[0]
            return out, t

        def rhs(t, y, sign=sign):
            load = abs(m * l * y[1] ** 2 + m * g * np.cos(y[0]))
            return [y[1], (-m * g * l * np.sin(y[0]) - viscous * y[1] - dry * load * d / 2.0 * sign) / j]

        turns = lambda t, y: y[1]  # noqa: E731
        turns.terminal, turns.direction = dry > 0.0, -sign
        found = solve_ivp(rhs, (t, times[-1]), y, "DOP853", rtol=1e-9, atol=1e-12, events=turns, dense_output=True)
        inside = (times >= t) & (times <= found.t[-1])
        out[inside] = found.sol(times[inside])[0]
        if found.status == 0:
            return out, np.nan
        t, y = found.t[-1], np.array([found.y[0, -1], 0.0])


# The swing


def test_radial_load_is_what_holds_the_bob_on_its_circle():
    f, rate, acceleration = 0.7, 3.0, -11.0
    circle = lambda t: 0.25 * jnp.array([jnp.sin(angle(t)), -jnp.cos(angle(t))])  # noqa: E731
    angle = lambda t: f + rate * t + acceleration * t**2 / 2.0  # noqa: E731
    felt = jax.jacfwd(jax.jacfwd(circle))(0.0) + jnp.array([0.0, 9.81])
    toward_bearing = -circle(0.0) / 0.25
    np.testing.assert_allclose(ROD.radial_load(f, rate), 0.3 * felt @ toward_bearing, rtol=1e-14)


def test_smooth_sign_loses_the_stated_share():
    width = 0.05  # of the largest speed of a swing
    kept = quad(lambda x: float(np.tanh(np.sin(x) / width)) * np.sin(x), 0.0, np.pi, points=[width, np.pi - width])[0] / 2.0
    np.testing.assert_allclose(1.0 - kept, np.pi**2 / 24.0 * width**2, rtol=2e-2)
    assert sliding_sign(width, width) == np.tanh(1.0)


def test_small_viscous_swing_is_the_closed_form():
    t, mu1, size = np.linspace(0.0, 20.0, 301), 2e-3, 1e-4
    n = mu1 / (2.0 * 0.025)
    w = np.sqrt(0.3 * 9.81 * 0.25 / 0.025 - n**2)
    expected = size * np.exp(-n * t) * (np.cos(w * t) + n / w * np.sin(w * t))
    swing = jv.swing(ROD, t, angle=size, viscous=mu1, tolerance=1e-11)
    np.testing.assert_allclose(swing.angle, expected, atol=1e-6 * size)
    assert jv.SwingStatus[swing.status].startswith("the pendulum still swings") and np.isnan(swing.stopped_at)


def test_large_viscous_swing_is_scipys():
    t = np.linspace(0.0, 20.0, 301)
    expected, _ = scipy_swing(ROD, t, 2.8, 1.0, 2e-3)
    swing = jv.swing(ROD, t, angle=2.8, rate=1.0, viscous=2e-3)
    np.testing.assert_allclose(swing.angle, expected, atol=1e-6)


def test_dry_friction_tends_to_the_sharp_sign_and_stops_where_it_stops():
    t = np.linspace(0.0, 80.0, 801)
    expected, stop = scipy_swing(ROD, t, 0.17, 0.0, 2e-4, 0.02)
    errors = []
    for width in (1e-3, 1e-4, 1e-5):
        swing = jv.swing(ROD, t, angle=0.17, viscous=2e-4, dry=0.02, width=width)
        errors.append(np.max(np.abs(swing.angle - expected)))
        assert abs(float(swing.stopped_at) - stop) < 0.5
        assert float(swing.rate[-1]) == 0.0 and float(swing.angle[-1]) == float(swing.angle[-40])
    assert errors[1] < 0.2 * errors[0] and errors[2] < 0.2 * errors[1] and errors[2] < 5e-6
    swing = jv.swing(ROD, t, angle=0.17, viscous=2e-4, dry=0.02)
    assert jv.SwingStatus[swing.status].startswith("dry friction brought") and abs(float(swing.stopped_at) - stop) < 0.3
    np.testing.assert_allclose(swing.angle, expected, atol=1e-4)


def test_a_pendulum_let_go_in_the_dead_zone_stays():
    zone = float(ROD.dead_zone(jnp.asarray(0.02)))
    np.testing.assert_allclose(np.tan(zone), 0.02 * 0.02 / (2 * 0.25))
    stays = jv.swing(ROD, np.linspace(0.0, 50.0, 11), angle=0.8 * zone, viscous=0.0, dry=0.02)
    np.testing.assert_allclose(stays.angle, 0.8 * zone, rtol=2e-3)
    assert bool(stays.status == jv.SwingStatus.stopped)
    goes = jv.swing(ROD, np.linspace(0.0, 50.0, 11), angle=2.0 * zone, viscous=0.0, dry=0.02)
    assert abs(float(goes.angle[-1])) < 0.1 * zone


def test_derivatives_of_the_swing():
    """Central differences, step 1e-4 of each number: their own error is about 1e-6 at a tolerance of 1e-11."""
    t = jnp.linspace(0.0, 10.0, 60)
    at = jnp.array([0.3, 0.1, 2e-3, 0.02])

    def angles(x, adjoint=None):
        given = dict(angle=x[0], rate=x[1], viscous=x[2], dry=x[3], width=5e-3, tolerance=1e-11, adjoint=adjoint)
        return jv.swing(ROD, t, **given).angle

    forward = jax.jit(jax.jacfwd(lambda x: angles(x, diffrax.ForwardMode())))(at)
    steps = 1e-4 * jnp.diag(at)
    around = jax.jit(jax.vmap(angles))(jnp.concatenate([at[None, :] + steps, at[None, :] - steps]))
    difference = (around[:4] - around[4:]) / (2.0 * jnp.diagonal(steps)[:, None])
    for k in range(4):
        np.testing.assert_allclose(forward[:, k], difference[k], atol=3e-5 * np.max(np.abs(difference[k])))
    weights = jnp.cos(jnp.arange(60.0))
    np.testing.assert_allclose(jax.grad(lambda x: weights @ angles(x))(at), weights @ forward, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(time=1.0), "time is one number"),
        (dict(time=[0.0, 2.0, 1.0]), "time must ascend"),
        (dict(viscous=-1.0), "viscous is -1 N m s; it must be at least 0"),
        (dict(angle="3 kg"), "angle is '3 kg', which is not in rad"),
        (dict(dry=0.1, width=0.0), "width is 0 rad/s; it must be greater than 0"),
        (dict(pendulum=jv.BearingPendulum(0.3, 0.2), dry=0.1), "pendulum.bearing is missing"),
        (dict(pendulum="rod"), "pendulum is 'rod'; it must be a BearingPendulum"),
    ],
)
def test_wrong_swings(change, says):
    given = {**dict(pendulum=ROD, time=[0.0, 1.0, 2.0], angle=0.1, viscous=1e-3), **change}
    with pytest.raises(jv.InputError, match=says):
        jv.swing(given.pop("pendulum"), given.pop("time"), **given)
    with pytest.raises(jv.InputError, match=r"pendulum.mass is 0 kg; it must be greater than 0"):
        jv.BearingPendulum(0.0, 0.2)


def test_too_few_steps_have_a_status():
    with pytest.raises(jv.ComputationError, match="max_steps_reached"):
        jv.swing(ROD, [0.0, 100.0], angle=0.1, viscous=1e-3, max_steps=20)
    swing = jv.swing(ROD, [0.0, 100.0], angle=0.1, viscous=1e-3, max_steps=20, throw=False)
    assert bool(swing.status == jv.SwingStatus.max_steps_reached) and np.isnan(swing.angle[-1])


# Turning points and the formula of ten periods


def noisy(clean, noise, seed):
    return clean + noise * np.random.default_rng(seed).normal(size=clean.size)


def test_turning_points_are_those_of_the_closed_form():
    t = np.sort(np.random.default_rng(0).uniform(0.0, 9.0, 400))
    turns = jv.turning_points(jv.Record(t, 0.4 + 0.1 * np.exp(-0.02 * t) * np.sin(3.0 * t)))
    expected = (np.arctan(3.0 / 0.02) + np.pi * np.arange(9)) / 3.0
    np.testing.assert_allclose(turns.time, expected[expected < t[-1] - 0.17], atol=2e-3)
    np.testing.assert_allclose(turns.angle, 0.4 + 0.1 * np.exp(-0.02 * turns.time) * np.sin(3.0 * turns.time), atol=2e-5)


def test_ten_periods_hold_mu1_in_their_interval():
    """200 records of small swings; of 200 intervals of 95 %, 190 hold the number, give or take 3."""
    t, rng, held, ratios = np.arange(0.0, 16.0, 0.04), np.random.default_rng(5), 0, []
    for k in range(200):
        mu1 = rng.uniform(1e-3, 3e-3)
        n = mu1 / 0.05
        w = np.sqrt(float(ROD.frequency) ** 2 - n**2)
        clean = 0.05 * np.exp(-n * t) * np.cos(w * t + rng.uniform(0.0, 6.0)) + rng.normal()
        found = jv.ten_periods(ROD, jv.Record(t, noisy(clean, 5e-4, k))).viscous
        held += found.low < mu1 < found.high
        ratios.append((found.value - mu1) / found.error)
    assert 184 <= held <= 198
    assert 0.85 < np.std(ratios) < 1.15


def test_instruments_widen_the_interval():
    t = np.arange(0.0, 15.0, 0.04)
    record = jv.Record(t, scipy_swing(ROD, t, 0.05, 0.0, 1.5e-3)[0])
    found = jv.ten_periods(ROD, record, instrument=0.03)
    np.testing.assert_allclose(found.viscous.value, 1.5e-3, rtol=1e-3)
    np.testing.assert_allclose((found.viscous.high - found.viscous.low) / 2.0, 0.03 * found.viscous.value, rtol=1e-3)
    np.testing.assert_allclose(found.period, 2.0 * np.pi / float(ROD.frequency), rtol=1e-3)
    assert found.scatter < 2e-3
    with pytest.raises(jv.InputError, match=r"record has 12 periods between turning points; 20.5 are needed"):
        jv.ten_periods(ROD, record, periods=20)


@pytest.mark.parametrize("dry", [0.002, 0.01])
def test_dry_friction_biases_the_formula_as_stated(dry):
    """mu1 + 4 T_f/(pi w A), A between the first and the last swing of a pair; second order in the loss left out."""
    t = np.arange(0.0, 14.0, 0.01)
    clean, _ = scipy_swing(ROD, t, 0.1, 0.0, 1e-3, dry)
    found = jv.ten_periods(ROD, jv.Record(t, clean))
    torque, w = dry * 0.01 * 0.3 * 9.81, float(ROD.frequency)
    last = jv.turning_points(jv.Record(t, clean)).amplitude[20]
    middle = (0.1 - last) / np.log(0.1 / last)
    bias = found.estimates[0] - 1e-3
    np.testing.assert_allclose(bias, 4.0 * torque / (np.pi * w * middle), rtol=0.05)


def test_large_swings_bias_the_formula_and_not_the_fit():
    t, biases = T, []
    for degrees in (2.0, 20.0, 40.0, 80.0):
        clean, _ = scipy_swing(ROD, t, np.deg2rad(degrees), 0.0, 1.5e-3)
        record = jv.Record(t, clean)
        biases.append(jv.ten_periods(ROD, record).estimates[0] / 1.5e-3 - 1.0)
        np.testing.assert_allclose(jv.identify(ROD, record).viscous.value, 1.5e-3, rtol=1e-5)
    assert abs(biases[0]) < 2e-4 and np.all(np.diff(biases) > 0.0) and 0.02 < biases[3] < 0.2


# The fit


def many(records, t, dry, pendulum=ROD):
    """All records fitted at once."""
    guesses = [first_guess(pendulum, r, jv.turning_points(r), dry) for r in records]
    start, width = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(a) for a in x]), *guesses)
    steps = steps_for(start, t)
    angles = jnp.asarray(np.stack([r.angle for r in records]))
    fit = eqx.filter_vmap(lambda a, s, w: fit_swing(pendulum, jnp.asarray(t), a, jnp.ones(t.size), s, w, steps))(
        angles, start, width
    )
    assert np.all(fit.converged)
    return fit


def trials(count, t, rng, noise, dry=None):
    """Records with every number drawn at random, and the mu1, mu2 in them."""
    records, truth = [], []
    for k in range(count):
        mu1 = rng.uniform(3e-4, 3e-3) if dry is None else rng.uniform(2e-4, 1e-3)
        mu2 = 0.0 if dry is None else rng.uniform(0.5, 1.5) * dry
        angle, rate, offset = rng.uniform(0.15, 0.8), rng.uniform(-0.5, 0.5), rng.normal()
        clean, _ = scipy_swing(ROD, t, angle, rate, mu1, mu2)
        records.append(jv.Record(t, offset + noisy(clean, noise, k)))
        truth.append((mu1, mu2))
    return records, np.array(truth)


def coverage(fit, truth, names, samples):
    """How many intervals hold the truth, and the spread of (found - truth)/error, for each of the numbers."""
    out = []
    for k, name in enumerate(names):
        error = np.sqrt(np.asarray(fit.covariance)[:, 4 + k, 4 + k])
        ratio = (np.asarray(getattr(fit.unknowns, name)) - truth[:, k]) / error
        out.append((int(np.sum(np.abs(ratio) < student_quantile(samples - 4 - len(names)))), float(np.std(ratio))))
    return out


def test_identification_holds_mu1_in_its_interval():
    """Of 200 intervals of 95 %, 190 hold the number, give or take 3."""
    t = np.arange(0.0, 12.0, 0.06)
    records, truth = trials(200, t, np.random.default_rng(11), 3e-3)
    ((held, spread),) = coverage(many(records, t, False), truth, ["viscous"], t.size)
    assert 184 <= held <= 197
    assert 0.85 < spread < 1.15


@pytest.mark.slow
def test_both_frictions_are_held_in_their_intervals():
    t = np.arange(0.0, 25.0, 0.06)
    records, truth = trials(200, t, np.random.default_rng(4), 2e-3, 0.02)
    for held, spread in coverage(many(records, t, True), truth, ["viscous", "dry"], t.size):
        assert 184 <= held <= 197 and 0.85 < spread < 1.15


@pytest.mark.parametrize("wrong", [dict(angle=jnp.nan), dict(dry=jnp.inf), dict(g=-9.81)])
def test_a_swing_that_does_not_exist_leaves_those_beside_it_alone(wrong):
    """As where a fit's step leads into nothing; their stops and slopes are looked for together."""

    def swing(x):
        pendulum = eqx.tree_at(lambda p: p.g, ROD, x["g"])
        given = (x["angle"], jnp.zeros(()), jnp.asarray(1e-3), x["dry"], jnp.asarray(1e-3))
        run = swing_states(pendulum, T[:200], *given, 1e-8, diffrax.Tsit5(), diffrax.ForwardMode(), 4096)
        return run.angle, run.status

    right = dict(angle=0.3, dry=0.02, g=9.81)
    both = {name: jnp.asarray([value, wrong.get(name, value)]) for name, value in right.items()}
    (value, status), slope = jax.jit(jax.vmap(lambda x: (swing(x), jax.jacfwd(swing, has_aux=True)(x)[0])))(both)
    assert np.all(np.isfinite(value[0])) and np.all(np.isnan(value[1]))
    assert all(np.all(np.isfinite(s[0])) and np.any(s[0]) for s in jax.tree.leaves(slope))
    assert np.asarray(status == SwingStatus.no_start).tolist() == [False, True]


def test_a_whole_swing_down_to_rest_gives_both_frictions():
    clean, stop = scipy_swing(ROD, T, 0.2, 0.0, 8e-4, 0.09)
    found = jv.identify(ROD, jv.Record(T + 100.0, noisy(clean, 2e-4, 0)), dry=True)
    assert found.status_name == "found" and stop < 18.0
    assert abs(found.stopped_at - 100.0 - stop) < 0.2
    assert found.viscous.low < 8e-4 < found.viscous.high and found.viscous.error < 1e-5
    assert found.dry.low < 0.09 < found.dry.high and found.dry.error < 3e-4
    assert -1.0 < found.correlation < -0.5
    assert any("holds the pendulum from" in note for note in found.notes)


def test_what_is_wrong_with_a_fit_is_said():
    t = T
    clean, _ = scipy_swing(ROD, t, 0.3, 0.0, 3e-4, 0.03)
    without = jv.identify(ROD, jv.Record(t, noisy(clean, 5e-4, 1)))
    assert without.status_name == "patterned" and any("ask for mu2" in note for note in without.notes)
    frictionless = scipy_swing(ROD, t, 0.1, 0.0, 0.0)[0]
    nothing = [jv.identify(ROD, jv.Record(t, noisy(frictionless, 5e-3, k))) for k in range(3)]
    assert any(found.status_name == "undetermined" and "cannot be told from 0" in found.notes[0] for found in nothing)
    heavier = jv.BearingPendulum(mass=0.3, length=0.25, inertia=0.008)
    clean, _ = scipy_swing(ROD, t, 0.3, 0.0, 1e-3)
    other = jv.identify(heavier, jv.Record(t, noisy(clean, 5e-4, 2)))
    assert "moment of inertia" in other.notes[0]
    np.testing.assert_allclose(other.inertia, 0.025, rtol=1e-3)
    np.testing.assert_allclose(other.viscous.value / 1e-3, float(heavier.total_inertia) / 0.025, rtol=2e-2)
    faster_and_faster = 0.2 * np.sin(4.0 * t + 0.15 * t**2)
    with pytest.raises(jv.ComputationError, match="not_converged: record: no fit was found"):
        jv.identify(ROD, jv.Record(t, faster_and_faster))


def test_student_quantile_is_scipys():
    from scipy.stats import t

    for freedom in (10, 30, 1000):
        np.testing.assert_allclose(student_quantile(freedom), t.ppf(0.975, freedom), rtol=2e-4)


# Records


def table(head, separator=",", comma=False, factor=1.0):
    lines = [separator.join((f"{k / 10 * factor:.3f}", f"{0.1 * (-1) ** k:.3f}")) for k in range(20)]
    return head + "".join((line.replace(".", ",") if comma else line) + "\n" for line in lines)


@pytest.mark.parametrize(
    ("text", "degrees"),
    [
        (table(""), False),
        (table("# camera 3\n\ntime,angle\n"), False),
        (table("time (s), angle (deg)\n"), True),
        (table("t [ms];phi [°]\n", ";", True, 1000.0), True),
        (table("time_s\tangle_deg\n", "\t"), True),
        (table("Time;Angle\ns;deg\n", ";"), True),
        (table('"time / s", "angle / mrad"\n'), None),
        (table("", " "), False),
        (table("clock, deflection\n"), False),
    ],
)
def test_records_come_in_as_laboratories_write_them(tmp_path, text, degrees):
    path = tmp_path / "swing.csv"
    path.write_text(text, encoding="utf-8")
    record = jv.read_record(path)
    np.testing.assert_allclose(record.time, np.arange(20) / 10, rtol=1e-12)
    unit = {True: np.pi / 180.0, False: 1.0, None: 1e-3}[degrees]
    np.testing.assert_allclose(record.angle, 0.1 * unit * (-1.0) ** np.arange(20), rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "holds no lines of numbers; it needs two columns"),
        ("time, angle\n", "holds no lines of numbers below its header"),
        (table("").replace("0.300,-0.100", "0.300,oops"), "line 4 has 'oops' where the angle should be"),
        (table("").replace("0.300,-0.100", "0.300,nan"), "line 4 has 'nan' where the angle should be; a finite number"),
        (table("# a\ntime,angle\n").replace("0.300,-0.100", "0.300"), "line 6 has 1 columns; the lines above have 2"),
        (table("").replace("0.300,", "0.100,"), "line 4 has the time 0.1 s after 0.2 s; times must ascend"),
        ("0.1\n0.2\n", "has one column; two are needed"),
        ("1,2,3\n", "has 3 columns and no line of names"),
        ("time, x, y\n1,2,3\n", "has no column 'angle' for the angle; its columns are time, x, y"),
        (table("time (s), angle (kg)\n"), "unit of angle is '1 kg', which is not in rad"),
        ("0,1\n1,2\n", "has 2 samples; a swing needs at least 16"),
        (table("").replace("0.100\n", "25.0\n"), "more than a full turn; if these are degrees, say so"),
    ],
)
def test_wrong_tables_say_which_line(tmp_path, text, says):
    path = tmp_path / "swing.csv"
    path.write_text(text)
    with pytest.raises(jv.InputError) as error:
        jv.read_record(path)
    assert says in str(error.value) and str(error.value).startswith(str(path))


def test_wrong_records(tmp_path):
    t = np.arange(20.0)
    wrong = [
        ((t, t[:5]), r"has shapes time \(20,\), angle \(5,\)"),
        ((t, ["a"] * 20), "has entries that are no numbers"),
        ((t, np.where(t == 3, np.inf, 0.0)), "has angle inf at sample 4"),
        ((np.where(t == 3, 1.0, t), t), "has the time 1 s after 2 s at sample 4"),
    ]
    for given, says in wrong:
        with pytest.raises(jv.InputError, match=says):
            jv.Record(*given)
    with pytest.raises(jv.InputError, match="has 3 samples from 1 s to 3 s; it goes from 0 s to 19 s"):
        jv.Record(t, 0.01 * t).between(1.0, 3.0)
    with pytest.raises(jv.InputError, match="cannot be read"):
        jv.read_record(tmp_path / "none.csv")
    with pytest.raises(jv.InputError, match="turns 0 times; at least 3 turning points"):
        jv.identify(ROD, jv.Record(t, 0.01 * t))
    with pytest.raises(jv.InputError, match=r"has \d samples about the turning point at .* s; 5 are needed"):
        jv.identify(ROD, jv.Record(t, 0.1 * np.cos(np.pi * t / 3.0)))
    with pytest.raises(jv.InputError, match=r"record is tuple; it must be a Record"):
        jv.identify(ROD, (t, t))
    with pytest.raises(jv.InputError, match=r"instrument is 2.0; the relative uncertainty of J"):
        jv.identify(ROD, jv.Record(t, 0.01 * t), instrument=2.0)
    with pytest.raises(jv.InputError, match=r"pendulum.bearing is missing"):
        jv.identify(jv.BearingPendulum(0.3, 0.2), jv.Record(t, 0.01 * t), dry=True)


# The command


@pytest.fixture
def typed(capsys, tmp_path, monkeypatch):
    """Runs a command line in a folder with a record in degrees and its measurement file; gives exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    t = T
    clean, _ = scipy_swing(ROD, t, 0.3, 0.0, 1.5e-3)
    angle = np.rad2deg(noisy(clean, 1e-3, 0))
    np.savetxt("swing.csv", np.stack([t, angle], axis=1), delimiter=",", header="time (s), angle (deg)", comments="")

    def type_(*words):
        code = run(list(words))
        out, err = capsys.readouterr()
        return code, out, err

    (tmp_path / "m.toml").write_text(type_("new", "measurement")[1].replace("dry = true", "dry = false"))
    return type_


def test_identify_from_the_command_line(typed, tmp_path):
    code, out, err = typed("identify", "m.toml", "--json", "--out", "o")
    document = json.loads(out)
    assert code == 0 and err == "" and document["status"] == "found"
    assert document["viscous"]["low"] < 1.5e-3 < document["viscous"]["high"] and document["dry"] is None
    np.testing.assert_allclose(document["decrement"]["viscous"]["value"], 1.5e-3, rtol=0.03)
    half = (document["viscous"]["high"] - document["viscous"]["low"]) / 2.0
    assert half > 0.03 * document["viscous"]["value"]
    assert (tmp_path / "o" / "record.png").stat().st_size > 10_000
    kept = np.loadtxt(tmp_path / "o" / "fit.csv", delimiter=",", skiprows=1)
    assert kept.shape == (400, 3) and np.std(kept[:, 1] - kept[:, 2]) < 1.1e-3

    words = ["identify", "swing.csv", "--mass", "300 g", "--length", "25 cm", "--inertia", "0.00625"]
    code, out, err = typed(*words)
    assert code == 0 and "mu1, N m s" in out and "found: the fit explains" in out


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (("swing.csv",), 2, "pendulum.mass is missing; needed here: mass, length"),
        (("swing.csv", "--mass", "3 s", "--length", "1"), 2, "pendulum.mass is '3 s', which is not in kg"),
        (("none.csv", "--mass", "1", "--length", "1"), 2, "none.csv cannot be read"),
        (("m.toml", "--columns", "a,b"), 2, "swing.csv has no column 'a' for the time; its columns are time, angle"),
        (("m.toml", "--columns", "a"), 2, "record.columns is ['a']; write the names of two columns"),
        (("m.toml", "--angle-unit", "rad"), 2, "more than a full turn; if these are degrees"),
        (("m.toml", "--from", "19.9 s"), 2, "has 2 samples from 19.9 s to inf s"),
        (("m.toml", "--instrument", "-1"), 2, "identify.instrument is -1; it must be at least 0"),
        (("swing.csv", "--mass", "1", "--length", "1", "--dry"), 2, "pendulum.bearing is missing"),
    ],
)
def test_wrong_commands(typed, words, code, says):
    got, out, err = typed("identify", *words)
    assert (got, out) == (code, "")
    assert says in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[pendulum]", "[rod]"), "rod is no table of a measurement file"),
        (("mass =", "masses ="), "pendulum.masses is no field here; did you mean 'mass'"),
        (("dry = false", "dry = 1"), "identify.dry is 1; write true or false"),
        (('file = "swing.csv"', "file = 3"), "record.file is 3; write the path of a CSV file"),
        (("[identify]", "[[identify]]"), "it must be a table, write [identify]"),
    ],
)
def test_wrong_measurement_files(typed, tmp_path, change, says):
    text = (tmp_path / "m.toml").read_text()
    assert change[0] in text
    (tmp_path / "m.toml").write_text(text.replace(*change, 1))
    code, out, err = typed("identify", "m.toml")
    assert (code, out) == (2, "") and says in err
