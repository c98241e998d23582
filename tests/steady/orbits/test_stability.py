"""Floquet multipliers and special points against the full equations."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hard_cases.reference_integration import multipliers
from hard_cases.reference_model import reference_model
from jax.flatten_util import ravel_pytree
from periodic import monodromy, ordered
from scenes import machines, published
from scipy.integrate import solve_ivp

import jaxvib as jv
from jaxvib.steady.orbits.diagram import SpecialPoint
from jaxvib.steady.orbits.jam_orbit import _is_stiff
from jaxvib.steady.orbits.stability import _small_solve, deflate
from jaxvib.study.maps.stability_onset import StabilityMap, stability_onset


def gravity():
    loads = jv.balls(count=2, mass=0.8, radius=0.12, drag=1.5)
    return jv.Scene(machines()["two_mass"], loads, jv.ConstantSpeed(150.0), jv.Gravity())


@pytest.mark.parametrize("make, omega", [(lambda: published(eps=0.05, count=3).scene(), 0.97), (gravity, 60.0)])
def test_multipliers_are_those_of_the_full_equations(make, omega):
    scene = make()
    orbit = jv.jam_orbit(scene, omega=omega)
    scene = eqx.tree_at(lambda s: s.drive.speed, scene, orbit.rotor_speed)
    # The trivial multiplier is taken out; loads that part from each other have theirs count - 1 times.
    expected = [*orbit.multipliers[:-2], *np.tile(orbit.multipliers[-2:], scene.loads.count - 1), 1.0]
    np.testing.assert_allclose(ordered(monodromy(scene, orbit)), ordered(expected), atol=1e-7)
    np.testing.assert_allclose(orbit.trivial, 1.0, atol=1e-8)
    np.testing.assert_allclose(orbit.multiplier, np.max(np.abs(orbit.multipliers)), rtol=1e-12)


@functools.cache
def diagram(eps):
    return jv.branches(published(eps=eps).scene(), exact=True, points=400, least=0.25, most=2.0)


def test_special_points_of_light_loads_are_the_published_folds():
    special = diagram(1e-3).special
    assert [p.kind for p in special] == ["fold"] * 4
    np.testing.assert_allclose([p.omega for p in special], [0.3339, 0.3806, 1.0015, 1.2154], atol=5e-5)
    np.testing.assert_allclose([p.rotor_speed for p in special], [0.7978, 0.4141, 5.1829, 1.3932], rtol=2e-4)


def test_folds_of_a_coarse_diagram_are_exact():
    """However soon others are found: what is left of dn/dOmega there, beside what is left 1e-6 away."""
    scene = published(eps=0.05).scene()
    found = jv.branches(scene, exact=True, points=25, least=0.25, most=2.0)
    folds = [point.omega for point in found.special if point.kind == "fold"]
    assert len(folds) == 4
    for omega in folds:
        at, beside = (abs(float(jv.jam_orbit(scene, omega=omega * away).slope)) for away in (1.0, 1.0 + 1e-6))
        assert at < 1e-2 * beside


def test_heavy_loads_lose_stability_at_a_torus_and_by_symmetry():
    found = diagram(0.3)
    kinds = [(p.kind, round(p.omega, 3)) for p in found.special]
    assert [kind for kind, _ in kinds] == ["fold", "fold", "torus", "symmetry", "symmetry", "fold", "fold", "torus"]
    # Stability in the diagram changes at special points only, and a fold is where dn/dOmega changes sign.
    at = np.array([p.omega for p in found.special])
    change = np.nonzero(found.stable[1:] != found.stable[:-1])[0]
    for k in change:
        assert np.any((at >= found.omega[k]) & (at <= found.omega[k + 1]))
    folds = [p.omega for p in found.special if p.kind == "fold"]
    turns = np.nonzero(found.slope[1:] * found.slope[:-1] < 0.0)[0]
    assert np.all((found.omega[turns] < folds) & (folds < found.omega[turns + 1]))
    assert np.max(found.residual) < 1e-12 and np.max(found.error) < 1e-8


def grows(omega, eps):
    """True if a disturbance of 1e-6 grows in 300 periods of the paper's equations, symmetric motions or not."""
    orbit = jv.jam_orbit(published(eps=eps).scene(), omega=omega)
    form, n = published(eps=eps), float(orbit.rotor_speed)
    q, velocity, (phi,), (rate,) = orbit.at(0.0)
    v, w = np.asarray(q / form.length_units), np.asarray(velocity / form.length_units)
    start = np.array([v[0], w[0], v[1], w[1], phi[0], rate[0]])

    def paper(t, y):
        v1, w1, v2, w2, phi, rate = y
        link = 0.02 * (w1 - w2) + 4 / 9 * (v1 - v2)
        c, s = np.cos(phi), np.sin(phi)
        right, pull = -0.02 * w2 - v2 / 9 + link + s * rate**2, eps * (n - rate)
        a2 = (right - c * pull) / (1.0 - eps * c * c)
        return [w1, -0.02 * w1 - v1 / 9 - link, w2, a2, rate, pull - eps * c * a2]

    times = 2.0 * np.pi / omega * np.arange(301)
    end = start + 1e-6 * np.array([1.0, 0.5, -0.7, 0.3, 0.4, 0.2])
    run = solve_ivp(paper, (0.0, times[-1]), end, "DOP853", times, rtol=1e-10, atol=1e-12).y.T
    # A shift in time is no growth: the rate when the loads pass the same angle is compared, not the phase.
    distance = np.abs(run[:, :4] - start[:4]).max(1)
    return bool(orbit.stable), distance[-1] > 1e-4, float(orbit.multiplier)


@pytest.mark.parametrize(
    "kind, which, apart",
    [("torus", 0, 2e-2), ("torus", 1, 2e-2), ("symmetry", 0, 4e-3)],
    ids=["torus on mode 3", "torus on mode 5", "symmetry on mode 3"],
)
def test_time_integration_on_both_sides_of_a_special_point(kind, which, apart):
    point = [p for p in diagram(0.3).special if p.kind == kind][which]
    sides = [grows(point.omega * (1.0 + side), 0.3) for side in (-apart, apart)]
    assert sides[0][0] != sides[1][0]
    for stable, grown, multiplier in sides:
        assert stable == (not grown) == (multiplier < 1.0)


def test_figure_of_stability_over_the_load_mass():
    found = jv.stability_map(lambda x: published(eps=x).scene(), [0.02, 0.05], omega=(0.36, 0.5), points=100)
    assert [[p.kind for p in points] for points in found.special] == [["fold"], ["fold", "torus"]]
    assert found.plot(label="eps").axes[0].get_ylabel() == "eps"
    with pytest.raises(jv.InputError, match="ascending"):
        jv.stability_map(lambda x: published(eps=x).scene(), [0.05, 0.02], omega=(0.36, 0.5))
    with pytest.raises(jv.InputError, match=r"^points is 2; with so few load speeds, .*; give at least 10$"):
        jv.stability_map(lambda x: published(eps=x).scene(), [0.02, 0.05], omega=(0.36, 0.5), points=2)
    # Jams are stable above the fold, or above the torus bifurcation.
    begins = np.array([max(point.omega for point in points) for points in found.special])
    np.testing.assert_allclose(found.stable_share, (0.5 - begins) / 0.14, atol=0.01)


def test_bands_of_the_stability_map_are_its_rows():
    """Each value has a band up to the middle to its neighbours, in the logarithm; the legend fits into the figure."""
    value, omega = np.array([0.1, 1.0]), np.tile(np.linspace(1.0, 5.0, 9), (2, 1))
    found = StabilityMap(
        value,
        omega,
        omega > np.array([[2.75], [3.75]]),
        ((SpecialPoint("torus", 2.75, 9.0),), ()),
    )
    axes = found.plot(unit="rad/s").axes[0]
    boxes = [band.get_paths()[0].get_extents() for band in axes.collections]
    edge = np.sqrt(0.1)
    np.testing.assert_allclose([[b.x0, b.x1, b.y0, b.y1] for b in boxes], [[3, 5, 0.1, edge], [4, 5, edge, 1]])
    axes.figure.canvas.draw()
    legend, whole = axes.get_legend().get_window_extent(), axes.figure.bbox
    assert whole.x0 <= legend.x0 and legend.x1 <= whole.x1 and axes.get_window_extent().width > 0.7 * whole.width


def test_the_stable_share_counts_speeds_without_a_jam():
    nan = np.nan
    omega = np.array([[1.0, 2.0, 3.0, 4.0, 5.0], [nan, 2.0, 3.0, 4.0, nan]])
    found = StabilityMap(np.array([1.0, 2.0]), omega, np.isfinite(omega), ((), ()))
    np.testing.assert_allclose(found.stable_share, [1.0, 0.5])
    assert "50.0 % of the load speeds stable" in found.summary()


@pytest.mark.parametrize(("between", "says"), [((0.06, 0.08), "0.06 the diagram has a torus"), ((0.01, 0.02), "has no torus")])
def test_an_onset_says_which_end_is_wrong(between, says):
    with pytest.raises(jv.InputError, match=says):
        jv.stability_onset(lambda x: published(eps=x).scene(), "torus", between, omega=(0.36, 0.5), points=60)


@pytest.mark.parametrize(("given", "says"), [(dict(kind="Hopf"), "kind is 'Hopf'"), (dict(accuracy=1e-17), "accuracy is")])
def test_an_onset_needs_a_kind_and_an_accuracy(given, says):
    asked = {"kind": "torus", "between": (0.02, 0.05), "omega": (0.36, 0.5), **given}
    with pytest.raises(jv.InputError, match=says):
        jv.stability_onset(lambda x: published(eps=x).scene(), **asked)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, between, omega, eps",
    [
        ("torus", (0.02, 0.05), (0.34, 0.9), 0.0336),
        ("torus", (0.05, 0.15), (1.1, 2.0), 0.0928),
        ("symmetry", (0.2, 0.3), (0.9, 1.01), 0.273),
    ],
)
def test_load_mass_at_which_odd_modes_lose_stability(kind, between, omega, eps):
    """eps = m/(kappa M2S): self-pins, confirmed by the time integrations above on both sides at eps = 0.3."""
    found = stability_onset(lambda x: published(eps=x).scene(), kind, between, omega=omega)
    np.testing.assert_allclose(found, eps, rtol=4e-3)


@pytest.mark.slow
def test_gradient_of_the_largest_multiplier():
    flat, restore = ravel_pytree(gravity())
    f = eqx.filter_jit(lambda x: jv.jam_orbit(restore(x), omega=60.0, points=33).multiplier)
    direction = jnp.asarray(flat * np.random.default_rng(0).normal(size=flat.shape))
    forward, reverse = jax.jvp(f, (flat,), (direction,))[1], jax.grad(f)(flat)
    h = 1e-4
    np.testing.assert_allclose((f(flat + h * direction) - f(flat - h * direction)) / (2.0 * h), forward, rtol=1e-5)
    np.testing.assert_allclose(jnp.vdot(reverse, direction), forward, rtol=1e-9)


@pytest.mark.parametrize("size", [1, 2])
def test_a_small_system_is_solved(size):
    weight, right = np.random.default_rng(size).normal(size=(size, size, 5)), np.random.default_rng(9).normal(size=(size, 5))
    expected = [np.linalg.solve(np.eye(size) - weight[..., k], right[:, k]) for k in range(5)]
    np.testing.assert_allclose(_small_solve(jnp.asarray(weight), jnp.asarray(right)), np.transpose(expected), rtol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_known_eigenvalue_is_taken_out(sign):
    rng = np.random.default_rng(3)
    vectors, values = rng.normal(size=(4, 4)), np.array([1.0, -2.0, 3.0, 0.5])
    vectors[:, 0] = [sign, 0.0, 0.0, 0.0]  # along the first axis, where the wrong one of two reflections is none
    matrix = vectors @ np.diag(values) @ np.linalg.inv(vectors)
    known, left = deflate(jnp.asarray(matrix), jnp.asarray(vectors[:, 0]))
    np.testing.assert_allclose(known, 1.0, rtol=1e-12)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(left).real), [-2.0, 0.5, 3.0], rtol=1e-9)


def stiff(drag, damping=100.0, count=1, machine=None):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=damping) if machine is None else machine
    loads = jv.balls(count=count, mass=0.5, radius=0.1, drag=drag)
    return jv.Scene(machine, loads, jv.ConstantSpeed(60.0))


def test_loads_with_much_drag_are_stable():
    """A load that nearly turns with the rotor: the slowest decay is that of the carrier, exp(-pi c / (M Omega))."""
    scene = stiff(1000.0)
    orbit = jv.jam_orbit(scene, mode=3)
    assert bool(orbit.stable)
    np.testing.assert_allclose(orbit.multiplier, 0.9015, atol=5e-5)
    assert jv.branches(scene, exact=True, points=200).special == ()
    for drag in (1e6, 1e9, 1e12):
        locked = jv.jam_orbit(stiff(drag), mode=3)
        np.testing.assert_allclose(locked.multiplier, 0.901511, atol=1e-6)
        np.testing.assert_allclose(locked.trivial, 1.0, atol=1e-9)


@pytest.mark.parametrize(
    "scene",
    [stiff(1000.0), stiff(1e6, damping=1e6), stiff(3000.0, count=2, machine=machines()["two_mass"])],
    ids=["drag", "drag and damping", "two platforms"],
)
def test_stiff_multipliers_are_those_of_scipys_radau(scene):
    orbit = jv.jam_orbit(scene, omega=45.0)
    assert bool(_is_stiff(scene, orbit.omega, orbit.rotor_speed))
    scene = eqx.tree_at(lambda s: s.drive.speed, scene, orbit.rotor_speed)
    harmonics, orders = np.asarray(orbit.displacement_harmonics), np.asarray(orbit.orders)
    deviation, of_deviation = np.asarray(orbit.deviation_harmonics[0]), np.asarray(orbit.deviation_orders)
    w, n = float(orbit.omega), scene.loads.count

    def motion(t):
        wave, lag = np.exp(1j * orders * w * t), np.exp(1j * of_deviation * w * t)
        phi, rate = w * t + (deviation @ lag).real, w * (1.0 + (deviation @ (1j * of_deviation * lag)).real)
        q, v = (harmonics @ wave).real, (harmonics @ (1j * orders * w * wave)).real
        return np.concatenate([q, v, np.full(n, phi), np.full(n, rate)])

    right = multipliers(reference_model(scene), motion, 2.0 * np.pi / w)
    found = [*orbit.multipliers, 1.0] if n == 1 else [*orbit.multipliers[:-2], *orbit.multipliers[-2:], 1.0]
    np.testing.assert_allclose(np.sort(np.abs(found)), np.sort(np.abs(right)), atol=1e-7)


def test_multipliers_of_unknown_scenes_hold_for_much_drag():
    """Under `jit`, where no number tells how many steps are enough."""
    value = eqx.filter_jit(lambda drag: jv.jam_orbit(stiff(drag), omega=45.0).multiplier)
    for drag in (1.0, 1000.0, 1e6):
        np.testing.assert_allclose(value(drag), jv.jam_orbit(stiff(drag), omega=45.0).multiplier, rtol=1e-9)


def test_stiff_multipliers_have_derivatives_of_differences():
    f = eqx.filter_jit(lambda drag: jv.jam_orbit(stiff(drag), omega=45.0).multiplier)
    reverse, h = jax.grad(f)(1000.0), 0.1
    np.testing.assert_allclose(reverse, (f(1000.0 + h) - f(1000.0 - h)) / (2.0 * h), rtol=1e-5)


@pytest.mark.parametrize("question", [dict(omega=9.0), dict(near=9.0)])
def test_stability_beside_a_far_faster_carrier_is_not_computed(question):
    """The jam is found: on a machine whose resonance is 1e7 times as fast, thus rigid, the loads turn with the rotor."""
    machine = jv.one_mass(mass=50.0, stiffness=5e17, damping=100.0)
    scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed(9.0))
    found = jv.jam_orbit(scene, **question)
    assert found.status_name == "unresolved" and found.judgement == "stability unknown"
    assert np.isnan(found.multiplier) and not found.stable and np.all(np.isnan(found.multipliers))
    np.testing.assert_allclose([found.omega, found.rotor_speed], 9.0, rtol=1e-9)


def test_a_multiplier_within_its_error_of_one_gives_no_verdict():
    """Two loads on a nearly rigid machine: they separate or gather within 1e16 turns."""
    machine = jv.one_mass(mass=50.0, stiffness=4e6, damping=100.0)
    scene = jv.Scene(machine, jv.balls(count=2, mass=0.25, radius=0.1, drag=0.5), jv.ConstantSpeed(0.01))
    found = jv.jam_orbit(scene, near=0.01)
    assert abs(found.multiplier - 1.0) <= abs(found.trivial - 1.0) < 1e-9
    assert found.judgement == "stability unknown" and "stability unknown" in found.summary()


def undamped(stiffness, **parts):
    """Scene on the second of two platforms without link; the first one has no damping: two multipliers of modulus 1."""
    machine = jv.two_mass(
        mass=(120.0, 95.0), stiffness=(stiffness, 5e4), damping=(0.0, 400.0), link_stiffness=0.0, link_damping=0.0
    )
    return jv.Scene(machine, **parts)


@pytest.mark.parametrize("stiffness", [5e4, 3e5, 2e7])
@pytest.mark.parametrize("drag", [1.0, 1e4])  # explicit and implicit steps
def test_undamped_vibration_is_neither_stable_nor_unstable(stiffness, drag):
    loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=drag)
    jam = jv.jam_orbit(undamped(stiffness, loads=loads, drive=jv.ConstantSpeed(40.0)), omega=20.0)
    exciter = jv.Exciter(drive=jv.ConstantSpeed(30.0), unbalance=0.1)
    for orbit in (jam, jv.synchronous_orbit(undamped(stiffness, exciters=[exciter]))):
        assert abs(orbit.multiplier - 1.0) < orbit.multiplier_error < 2e-7
        assert not orbit.stable and orbit.judgement == "stability unknown"
