"""Growth of disturbances: its exponent and its name, against attractors that are known and against Floquet multipliers."""

import itertools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.motion.growth import _classify_growth, _uncertainty


def forced(cubic, stiffness):
    """x'' + 0.05 x' + stiffness x + cubic x^3 = 7.5 sin t, with a load that is a speck."""
    machine = jv.one_mass(mass=1.0, stiffness=stiffness, damping=0.05)
    loads = jv.pendulums(count=1, mass=1e-9, radius=1.0, drag=1e-9)
    scene = jv.Scene(machine, loads, jv.ConstantSpeed(1.0), (jv.StaticImbalance(7.5), jv.CubicSupport(cubic)))
    return scene, jv.State(jnp.full(1, 2.5), jnp.zeros(1), (jnp.zeros(1),), (jnp.ones(1),))


def test_a_strange_attractor_is_named():
    """Ueda's; the validation compares its exponent with SciPy's, over more turns."""
    scene, start = forced(1.0, 1e-6)
    found = jv.growth(scene, 4800.0, start=start, segments=160)
    assert found.status_name == "chaotic" and 0.05 < found.exponent < 0.2
    np.testing.assert_allclose(found.horizon * found.exponent, -np.log(np.finfo(float).eps))


def test_a_linear_oscillator_is_regular():
    """It forgets at half its damping over its mass, the load's angle keeps what it has."""
    scene, start = forced(0.0, 1.0)
    found = jv.growth(scene, 100.0, start=start, segments=8)
    assert found.status_name == "regular" and np.isinf(found.horizon) and found.rates.shape == (8,)
    assert -0.026 < found.exponent < 1e-3


def jammed(**numbers):
    """One ball jammed at a resonance at 28.1 rad/s."""
    values = {"damping": 100.0, "drag": 0.5, "speed": 60.0} | numbers
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=values["damping"])
    loads = jv.balls(count=1, mass=0.5, radius=0.1, drag=values["drag"])
    return jv.Scene(machine, loads, jv.ConstantSpeed(values["speed"]))


def on_orbit(scene, mode):
    """The state on an exact jam, and its largest rate of growth by its multipliers, 1/s."""
    orbit = jv.jam_orbit(scene, mode=mode)
    rate = np.log(np.max(np.abs(orbit.multipliers))) * float(orbit.omega) / (2.0 * np.pi)
    return jv.State(*orbit.at(jnp.zeros(()))), float(rate)


@pytest.mark.parametrize("numbers", [{}, {"speed": 80.0, "drag": 0.4}])
def test_an_unstable_jam_grows_as_its_multiplier(numbers):
    scene = jammed(**numbers)
    start, rate = on_orbit(scene, 2)
    found = jv.growth(scene, 20.0 / rate, start=start, segments=16)
    assert found.status_name == "unstable"
    np.testing.assert_allclose(found.exponent, rate, rtol=0.01)
    np.testing.assert_allclose(found.horizon, -np.log(np.finfo(float).eps) / rate, rtol=0.01)


@pytest.mark.parametrize(("until", "segments"), [(1.0, 8), (2.0, 8), (3.0, 20)])
def test_a_short_run_at_an_unstable_jam_is_undecided(until, segments):
    """Its rate is certain long before disturbances have grown a thousandfold."""
    scene = jammed()
    start, rate = on_orbit(scene, 2)
    found = jv.growth(scene, until, start=start, segments=segments)
    assert found.status_name == "undecided" and found.exponent > 3.0 * found.uncertainty
    assert 0.7 < found.horizon * rate / -np.log(np.finfo(float).eps) < 1.0
    assert "horizon at least" in found.summary()


def test_growth_after_leaving_a_jam_is_that_of_the_new_motion():
    """Rounding leaves the unstable jam after some 8 s; the later half of the run is at the stable one."""
    scene = jammed()
    found = jv.growth(scene, 40.0, start=on_orbit(scene, 2)[0], segments=40)
    assert found.status_name == "regular" and np.isinf(found.horizon)
    np.testing.assert_allclose(found.rates[2:6], on_orbit(scene, 2)[1], rtol=0.01)


@pytest.mark.parametrize("numbers", [{}, {"speed": 45.0}])
def test_a_stable_jam_is_regular(numbers):
    scene = jammed(**numbers)
    start, rate = on_orbit(scene, 1)
    found = jv.growth(scene, 10.0, start=start)
    assert rate < 0.0 and found.status_name == "regular"


def test_growth_in_proportion_to_time_is_regular():
    """Two loads without drag that turn at speeds a little apart separate in proportion to time."""
    scene = jammed(drag=0.0, damping=1e4)
    start = jv.State(jnp.zeros(1), jnp.zeros(1), (jnp.zeros(1),), (jnp.full(1, 300.0),))
    scene = eqx.tree_at(lambda s: s.loads.mass, scene, jnp.asarray(1e-9))
    found = jv.growth(scene, 40.0, start=start)
    assert found.status_name == "regular" and found.exponent > 3.0 * found.uncertainty
    np.testing.assert_allclose(np.sum(found.rates[20:]) * found.time[0], np.log(2.0), rtol=0.05)
    quarter = found.time[-1] / 4  # the rate falls from ln(3/2) to ln(4/3) in the quarters of the later half
    np.testing.assert_allclose(found.uncertainty, 0.5 * np.log(9 / 8) / quarter, rtol=0.05)


@pytest.mark.parametrize(
    ("late", "name"),
    [
        (np.full(20, 0.5), "chaotic"),
        (np.full(20, 0.3), "undecided"),  # e^6: certain, but not a thousandfold
        (np.full(20, 1e-5), "regular"),  # less than the integration's own errors
        (np.random.default_rng(0).normal(0.1, 1.0, 20), "undecided"),  # the scatter hides a thousandfold growth
        (np.tile([1.0, -1.0], 10) + 0.02, "regular"),  # cancels
        (1.0 / np.arange(21, 41), "regular"),
        (np.log1p(2.0 / np.arange(21, 41)), "undecided"),  # with the square of time
        (np.geomspace(4.0, 1e-3, 20), "undecided"),  # a passage, after which nothing grows
        (np.repeat([1.0, 0.4], 10) + np.tile([0.05, -0.05], 10), "undecided"),  # falls by far more than it scatters
        (np.geomspace(0.05, 1e-4, 20), "regular"),
    ],
)
def test_the_later_half_decides(late, name):
    assert _classify_growth(late) == name


@pytest.mark.parametrize("difference", [1e-3, 0.01, 0.1, 1.0])
def test_uncertainty_includes_nearly_equal_rates(difference):
    """Two equal disturbances grow at the rates 0.5 and 0.5 - difference for 10 s."""
    time = np.linspace(0.0, 10.0, 41)
    logs = np.logaddexp(2.0 * 0.5 * time, 2.0 * (0.5 - difference) * time) / 2.0
    late = np.diff(logs)[20:] / 0.25
    assert 0.0 < 0.5 - np.mean(late) < _uncertainty(late, 0.25) < 0.05


def test_wrapped_angles_are_compared_across_a_turn(monkeypatch):
    """Two motions in single precision that are 2 pi - 6.2 apart may end at 3.1 rad and -3.1 rad."""
    ends = itertools.cycle([3.1, -3.1])

    def run(plan, **_):
        end = eqx.tree_at(lambda s: s.angle, plan.state, (jnp.full(1, next(ends)),))
        window = SimpleNamespace(state=jax.tree.map(lambda x: x[None], end))
        return SimpleNamespace(status=jv.RunStatus.done, window=window)

    monkeypatch.setattr("jaxvib.motion.growth.run_planned", run)
    monkeypatch.setattr("jaxvib.motion.growth._has_returned", lambda *_: False)
    with jax.enable_x64(False):
        scene, start = forced(0.0, 1.0)
        found = jv.growth(scene, 100.0, start=start, segments=8)
    # From 0.01 apart, of which what is no angle stays.
    grown = 0.01 * np.exp(found.rates * found.time[0])
    assert np.all((grown > 2.0 * np.pi - 6.2 - 1e-5) & (grown < np.hypot(2.0 * np.pi - 6.2, 0.01) + 1e-5))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (dict(segments=4), "at least 8 are needed"),
        (dict(start="jam"), "mode is missing"),
        (dict(start="spin_up"), "start is 'spin_up'; the growth of disturbances needs a constant rotor speed"),
        (dict(until=0.0), "greater than 0"),
        (dict(until=1e308), "turns of the rotor"),
    ],
)
def test_what_is_refused(arguments, says):
    scene = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5),
        jv.ConstantSpeed(60.0),
    )
    with pytest.raises(jv.InputError, match=says):
        jv.growth(scene, **{"until": 10.0, **arguments})


def test_a_drive_that_changes_is_refused():
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.RunUp(60.0, acceleration=3.0))
    with pytest.raises(jv.InputError, match="drive is 'run_up'"):
        jv.growth(scene, 10.0)


def test_growth_starts_with_the_given_separation(monkeypatch):
    """A run that is asked for has loads at these angles; those of a `State` are its own."""
    s = jv.Scene(jammed().machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed(60.0))
    starts = []

    def noted(plan, **_):
        starts.append(np.ptp(np.asarray(plan.state.angle[0])))
        raise jv.ComputationError("stopped", "no more is needed")

    monkeypatch.setattr("jaxvib.motion.growth.run_planned", noted)
    for separation in (None, "10 deg", 0.0):
        with pytest.raises(jv.ComputationError, match="no more"):
            jv.growth(s, 10.0, separation=separation)
    np.testing.assert_allclose(np.degrees(starts), [1.0, 10.0, 0.0], atol=1e-12)
    with pytest.raises(jv.InputError, match="it is used only with named starts"):
        jv.growth(s, 10.0, start=jv.initial_state(s), separation=0.0)


@pytest.mark.parametrize(("phase", "name"), [(0.0, "unstable"), (np.pi, "regular")])
def test_growth_of_two_motors_is_that_of_their_multiplier(phase, name):
    supports = [jv.support(at=(x, 0.0), stiffness=(4e5, 4e5), damping=(4e3, 4e3)) for x in (-1.0, 1.0)]
    machine = jv.plane_body(mass=2000.0, inertia=600.0, supports=supports)
    drive = jv.SwitchedOff(jv.DCMotor(100.0, stall_torque=300.0, inertia=0.5), at=1e9)
    drives = (drive.motor, eqx.tree_at(lambda d: d.at, drive, 1e-3))
    exciters = [jv.Exciter(drive=d, unbalance=1.0, at=(x, 0.0)) for d, x in zip(drives, (-0.4, 0.4), strict=True)]
    scene = jv.Scene(machine, exciters=exciters)
    orbit = jv.synchronous_orbit(scene, phases=[0.0, phase])
    growth = jv.growth(scene, 5.0 if name == "unstable" else 20.0, start=orbit.at(0.0), segments=16)
    assert growth.status_name == name and bool(orbit.stable) == (name == "regular")
    if name == "unstable":
        exponent = np.log(float(orbit.multiplier)) * float(orbit.speed) / (2.0 * np.pi)
        assert growth.exponent == pytest.approx(exponent, rel=1e-2)
