"""Parts of the search for exact jams."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published

import jaxvib as jv
from jaxvib.display import speed_text
from jaxvib.equations.jammed_bodies import jammed_bodies
from jaxvib.equations.linear import jammed_model
from jaxvib.steady.jams.branch_plot import branch_summary
from jaxvib.steady.orbits import diagram, search
from jaxvib.steady.orbits.describe import half_range
from jaxvib.steady.orbits.search import _interpolate
from jaxvib.steady.orbits.stability import steps_for


def test_points_between_follow_the_hermite_cubic():
    x = np.array([0.0, 1.0, 3.0, 3.5])
    cubic, slope = np.poly1d([1.0, -4.0, 2.0, 5.0]), np.polyder(np.poly1d([1.0, -4.0, 2.0, 5.0]))
    between, values = _interpolate(x, cubic(x), slope(x))
    parts = search._PARTS_PER_INTERVAL
    assert between.size == values.size == 3 * parts + 1 and parts > 2
    np.testing.assert_allclose(between[::parts], x)
    np.testing.assert_allclose(np.diff(between[parts : 2 * parts]), 2.0 / parts)
    np.testing.assert_allclose(values, cubic(between), rtol=1e-13)


@pytest.mark.parametrize(
    ("top", "target", "ends"), [(5.0, 5.001, True), (5.0, 4.999, False), (-5.0, -5.001, True), (-5.0, -4.999, False)]
)
def test_a_branch_may_turn_back_before_the_rotor_speed(monkeypatch, top, target, ends):
    """n = top -/+ (w - 2)^2, whose fold is at 2; a target that the parabola passes is not before its end."""
    sign = np.sign(top)
    monkeypatch.setattr(search, "branch_at", lambda scene, w: (top - sign * (w - 2.0) ** 2, -2.0 * sign * (w - 2.0)))
    scene = published().scene()
    assert search._ends_before(scene, 1.7, 2.4, target) == ends
    assert not search._ends_before(scene, 2.1, 2.4, target)  # no fold in there


def test_the_diagram_begins_at_a_fifth_of_the_lowest_resonance(monkeypatch):
    class Asked(Exception):
        pass

    def solver(scene, accuracy, slowest):
        def solve(omega):
            raise Asked(omega)

        return solve

    monkeypatch.setattr(diagram, "_Solver", solver)
    scene = published(natural=(0.3, 0.4)).scene()
    with pytest.raises(Asked) as caught:
        jv.branches(scene, exact=True, points=50)
    (omega,) = caught.value.args
    lowest = float(jnp.min(jv.jam_modes(scene).resonances))
    np.testing.assert_allclose([omega[0], omega[-1]], [0.2 * lowest, 4.0], rtol=1e-12)
    assert omega.size == 50 and np.all(np.diff(omega) > 0.0)
    slow = eqx.tree_at(lambda s: s.drive.speed, scene, jnp.asarray(0.1))
    with pytest.raises(Asked) as caught:
        jv.branches(slow, exact=True, points=50)
    np.testing.assert_allclose(caught.value.args[0][[0, -1]], [0.02, 0.4 / 3.0], rtol=1e-12)
    for accuracy, exact, problem in ((-1.0, True, "at least"), (1e-20, True, "at least"), (1e-6, False, "only")):
        with pytest.raises(jv.InputError, match=f"^accuracy is .*{problem}"):
            jv.branches(scene, exact=exact, points=50, accuracy=accuracy)


def test_summary_of_a_branch_leaves_out_points_without_a_jam():
    class Branch:
        omega, stable = np.array([np.nan, 2.0, 3.0, np.nan]), np.array([False, True, True, False])
        scene = published().scene()

    speeds = speed_text(np.array([2.0, 3.0]), 6, " to ")
    assert branch_summary(Branch, [], "here").startswith(f"4 points from {speeds}, 50.0 % ")


def test_swings_are_half_of_what_lies_between_the_extremes():
    """Unsymmetric signals: 3 + cos t + cos 2 t lies between 3 - 9/8 and 5."""
    orders = np.array([0, 1, 2])
    np.testing.assert_allclose(
        half_range(orders, jnp.array([[3.0, 1.0, 1.0], [0.0, 1.0, 0.0]], complex)), [(2.0 + 9.0 / 8.0) / 2.0, 1.0], rtol=1e-12
    )
    np.testing.assert_allclose(half_range(np.array([1, 3]), jnp.array([[1.0, 0.0], [0.0, 2.0j]])), [1.0, 2.0], rtol=1e-12)


@pytest.mark.parametrize("orders", [np.arange(1, 16, 2), np.arange(1, 9)], ids=["odd", "all"])
def test_swings_miss_no_peak(orders):
    """Random signals whose harmonics do not fall, against samples so dense that they miss 3e-7 of a peak at most."""
    harmonics = np.random.default_rng(7).normal(size=(300, orders.size, 2)) @ [1.0, 1.0j]
    dense = np.zeros((300, 2**15 + 1), complex)
    dense[:, orders] = harmonics
    samples = np.fft.irfft(dense, axis=1) * 2**15
    lies_between = (samples.max(axis=1) - samples.min(axis=1)) / 2.0
    np.testing.assert_allclose(half_range(orders, jnp.asarray(harmonics)), lies_between, rtol=1e-6)


def test_a_whole_turn_takes_twice_the_steps_of_half_a_turn():
    """A whole turn is needed if gravity makes the halves of the motion differ."""
    half = published().scene()
    whole = jv.Scene(half.machine, half.loads, half.drive, (jv.Gravity(9.81),))
    models = [jammed_bodies(jammed_model(s)) for s in (half, whole)]
    few, many = (int(steps_for(model, jnp.asarray(1.7), jnp.asarray(3.0), implicit=False)) for model in models)
    assert few > 4 and 2 * few - 1 <= many <= 2 * few


def test_a_branch_is_looked_at_once_at_each_point(monkeypatch):
    """The diagram is evaluated on n = Omega and in whole numbers, some repeated; at the rotor speed itself nothing remains."""
    points = np.concatenate([np.ones(9), np.arange(1.0, search._BRANCH_POINTS + 1)])
    monkeypatch.setattr(search, "_search_grid", lambda scene: (points, jnp.array([2.0, 3.0])))
    monkeypatch.setattr(search, "branch_at", lambda scene, omega: (omega, jnp.ones_like(omega)))
    assert search.exact_mode_speeds(published(speed=30.0).scene()) == {5: 30.0}


def test_jams_that_no_load_speed_has_end_in_a_status():
    machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 3e4), damping=(40.0, 20.0), link_stiffness=2e5, link_damping=60.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.8, radius=1e-300, drag=1.5), jv.ConstantSpeed(120.0))
    with pytest.raises(jv.ComputationError, match=r"^not_converged: no exact jam was found at any load speed; check"):
        jv.jam_orbit(scene, mode=3, points=8)
