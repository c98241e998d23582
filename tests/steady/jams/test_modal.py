"""Modal form of carriers: against dense algebra in NumPy, where eigenvectors are well separated and where they are not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from load_speeds import complex_response, matrices, unbalance_and_drag

import jaxvib as jv
from jaxvib.equations.linear import jammed_model
from jaxvib.steady.jams.folds import rotor_speed_at, scanned_slope, scanned_slopes, scanned_speed
from jaxvib.steady.jams.jam import jams_of

N = 6
MASS, LINK = 2.0, 8.0


def chain(damping=(0.02, 0.05), links=LINK, stiffness=None, speed=3.0, spread=0.0, exciter=N, n=N, drag=0.05):
    """Platforms in a row; `damping` of supports and of links."""
    uneven = 1.0 + spread * np.sin(np.arange(n) ** 2)
    machine = jv.network(
        mass=(MASS * uneven).tolist(),
        stiffness=(np.ones(n) * uneven if stiffness is None else stiffness).tolist(),
        damping=(damping[0] * np.ones(n) * uneven[::-1]).tolist(),
        links=[(k, k + 1) for k in range(1, n)],
        link_stiffness=[links] * (n - 1),
        link_damping=[damping[1]] * (n - 1),
        exciter=exciter,
    )
    return jv.Scene(machine, jv.balls(count=2, mass=0.01, radius=0.1, drag=drag), jv.ConstantSpeed(speed))


def critical():
    """A support of which the only mode of its platform is damped critically, beside others that know nothing of it."""
    return with_damping(chain(links=0.0, damping=(0.01, 0.0)), N - 1, 2.0 * np.sqrt(1.0 * (MASS + 0.02)))


def with_damping(scene, platform, value):
    return eqx.tree_at(lambda s: s.machine.damping, scene, scene.machine.damping.at[platform].set(value))


SCENES = {
    "damping in proportion": chain(damping=(0.02, 0.16)),
    "general damping": chain(spread=0.4),
    "no damping": chain(damping=(0.0, 0.0)),
    "equal frequencies": chain(links=0.0, damping=(0.03, 0.0)),
    "equal frequencies, coupled by dampers": chain(links=0.0, damping=(0.03, 0.2)),
    "one damper without bound": with_damping(chain(spread=0.4), 2, 1e6),
    "dampers near critical": chain(damping=(2.0, 9.0), spread=0.4),
    "critical damping": critical(),
    "free to drift": chain(stiffness=np.zeros(N), damping=(0.0, 0.05)),
}
ROUGH = {"critical damping", "free to drift"}
SPEEDS = np.array([0.05, 0.3, 0.69, 0.7, 0.715, 1.3, 2.9, 4.01, 11.0])


def dense_speed(s, w):
    (unbalance, drag), port = unbalance_and_drag(s), matrices(s)[3]
    felt = 1j * complex_response(s, w)[0][..., port]  # the force of a load at angle 0 is upward a quarter of a turn later
    return w - unbalance * w**2 * felt.imag / (2.0 * drag)


@pytest.mark.parametrize("name", SCENES)
def test_displacement_is_that_of_a_dense_solve(name):
    s = SCENES[name]
    found = jax.jit(lambda m: jax.vmap(m.displacement)(jnp.asarray(SPEEDS)))(jammed_model(s).decomposed())
    for awaited, y in zip(complex_response(s, SPEEDS)[0], np.asarray(found), strict=True):
        np.testing.assert_allclose(y, awaited, atol=1e-10 * np.max(np.abs(awaited)), rtol=0.0)


@pytest.mark.parametrize("name", SCENES)
def test_scanned_rotor_speed_is_that_of_a_dense_solve(name):
    s = SCENES[name]
    model = jammed_model(s).decomposed()
    scan = jax.jit(jax.vmap(lambda w: (scanned_speed(model, w), rotor_speed_at(model, w), scanned_slope(model, w))))
    scanned, exact, slope = map(np.asarray, scan(jnp.asarray(SPEEDS)))
    awaited = dense_speed(s, SPEEDS)
    np.testing.assert_allclose(exact, awaited, rtol=1e-10)
    np.testing.assert_allclose(scanned, awaited, rtol=1e-7 if name in ROUGH else 1e-10)
    h = 1e-6
    differences = (dense_speed(s, SPEEDS + h) - dense_speed(s, SPEEDS - h)) / (2.0 * h)
    np.testing.assert_allclose(slope, differences, atol=1e-6 * np.max(np.abs(differences)))


def test_slopes_in_blocks_are_those_of_single_speeds():
    model = jammed_model(SCENES["general damping"]).decomposed()
    grid = jnp.linspace(0.1, 6.0, 12_001)
    one_by_one = jax.jit(jax.vmap(lambda w: scanned_slope(model, w)))(grid)
    np.testing.assert_allclose(jax.jit(scanned_slopes)(model, grid), one_by_one, rtol=1e-9)


@pytest.mark.parametrize("name", ["general damping", "equal frequencies", "free to drift"])
def test_fold_speeds_and_their_derivatives_are_those_of_matrices(name):
    s = SCENES[name]

    def speeds(scale):
        return jams_of(eqx.tree_at(lambda s: s.machine.damping, s, scale * s.machine.damping)).folds.rotor_speed

    folds, one, h = jams_of(s).folds, jnp.asarray(1.0), 1e-5
    there = np.asarray(folds.exists)
    awaited = dense_speed(s, np.asarray(folds.omega)[there])
    np.testing.assert_allclose(folds.rotor_speed[there], awaited, rtol=1e-10)
    slope = jax.jit(jax.jacfwd(speeds))(one)[there]
    differences = ((speeds(one + h) - speeds(one - h)) / (2.0 * h))[there]
    np.testing.assert_allclose(slope, differences, atol=1e-6 * np.max(np.abs(differences)))


@pytest.mark.parametrize("name", SCENES)
def test_jams_of_six_platforms_are_those_of_a_fine_grid(name):
    s = SCENES[name]
    modes = jv.jam_modes(s)
    found = np.sort(np.asarray(modes.omega)[np.isfinite(modes.omega)])
    grid = np.unique(np.concatenate([np.linspace(0.01, 4.0, 4001), found * (1.0 + 1e-6), found * (1.0 - 1e-6)]))
    gaps = dense_speed(s, grid) - 3.0
    if name != "no damping":  # whose poles look like crossings
        assert np.sum(gaps[1:] * gaps[:-1] < 0.0) == found.size
    np.testing.assert_allclose(dense_speed(s, found), 3.0, rtol=1e-9)
    is_rising = dense_speed(s, found * (1.0 + 1e-7)) > dense_speed(s, found * (1.0 - 1e-7))
    np.testing.assert_array_equal(np.asarray(modes.stable)[np.asarray(modes.exists)], is_rising)


def test_undamped_carriers_take_no_power_at_any_speed():
    model = jammed_model(SCENES["no damping"]).decomposed()
    speeds = jnp.linspace(0.05, 6.0, 500)
    np.testing.assert_array_equal(jax.vmap(lambda w: scanned_speed(model, w))(speeds), speeds)


@pytest.mark.parametrize("name", ["general damping", "equal frequencies", "critical damping"])
def test_derivatives_are_those_of_finite_differences(name):
    """Also where natural frequencies are equal, of which the eigenvectors have no derivative."""
    s = SCENES[name]
    row = int(np.flatnonzero(np.asarray(jv.jam_modes(s).exists))[0])

    def values(x):
        k, c = s.machine.stiffness, s.machine.damping
        changed = eqx.tree_at(lambda s: (s.machine.stiffness, s.machine.damping), s, (k * (1.0 + x[:N]), c * (1.0 + x[N:])))
        jams = jams_of(changed)
        return jnp.stack([jams.omega[row], jams.foundation_force[row], jams.slope[row]])

    zero, h = jnp.zeros(2 * N), 1e-5
    forward, reverse = jax.jit(jax.jacfwd(values))(zero), jax.jit(jax.jacrev(values))(zero)
    many = jax.jit(jax.vmap(values))(h * jnp.concatenate([jnp.eye(2 * N), -jnp.eye(2 * N)]))
    differences = np.asarray(many[: 2 * N] - many[2 * N :]).T / (2.0 * h)
    size = np.max(np.abs(differences), axis=1, keepdims=True)
    np.testing.assert_allclose(forward / size, differences / size, atol=1e-6)
    np.testing.assert_allclose(reverse / size, forward / size, atol=1e-11)


def test_second_derivatives_are_those_of_finite_differences():
    s = SCENES["general damping"]

    def slope(k):
        changed = eqx.tree_at(lambda s: s.machine.stiffness, s, k * s.machine.stiffness)
        model = jammed_model(changed).decomposed()
        return jax.grad(lambda w: rotor_speed_at(model, w))(jnp.asarray(0.72))

    one, h = jnp.asarray(1.0), 1e-5
    first = jax.jit(jax.grad(slope))
    np.testing.assert_allclose(first(one), (slope(one + h) - slope(one - h)) / (2.0 * h), rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.grad(first))(one), (first(one + h) - first(one - h)) / (2.0 * h), rtol=1e-5)


def test_single_precision_finds_the_jams_of_double_precision():
    double = jv.jam_modes(SCENES["general damping"])
    with jax.enable_x64(False):
        found = jv.jam_modes(chain(spread=0.4))
    assert found.omega.dtype == jnp.float32
    np.testing.assert_array_equal(found.exists, double.exists)
    np.testing.assert_allclose(found.omega, double.omega, rtol=2e-5)
    np.testing.assert_allclose(found.foundation_force, double.foundation_force, rtol=2e-3)


@pytest.mark.parametrize("apart", [0.9, 1.1])
def test_close_resonances_share_a_peak_within_their_bandwidth(apart):
    """Sum of two equal peaks 1/((w - w_r)^2 + d^2), d = c/(2 m): one peak up to the distance 2 d/sqrt(3)."""
    c = 2e-3
    link = 0.5 * ((1.0 + apart * 2.0 / np.sqrt(3.0) * c / 2.0) ** 2 - 1.0)
    machine = jv.two_mass(mass=1.0, stiffness=1.0, damping=c, link_stiffness=link, link_damping=0.0)
    scene = jv.Scene(machine, jv.balls(count=1, mass=1e-9, radius=0.1, drag=1e-18), jv.ConstantSpeed(3.0))
    modes = jv.jam_modes(scene)
    assert modes.unresolved in (([],) if apart > 1.0 else ([1, 2], [3, 4]))
    assert not set(modes.unresolved) & set(modes.mode_numbers())


def test_equal_resonances_leave_one_pair_of_modes():
    """Only one combination of equal platforms without links moves the exciter."""
    modes = jv.jam_modes(SCENES["equal frequencies"])
    assert len(modes.unresolved) == 2 * (N - 1)
    with pytest.raises(jv.ComputationError, match="no peak of its own"):
        modes.select(modes.unresolved[0])
