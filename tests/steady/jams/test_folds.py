"""Folds of the branch of jams: none missed, derivatives, what is said at one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from load_speeds import all_load_speeds
from scenes import jam_rotor_speed, published

import jaxvib as jv
from jaxvib.equations.linear import linear_model
from jaxvib.steady.jams import folds
from jaxvib.steady.jams.branch_plot import modes_of
from jaxvib.steady.jams.folds import piece_modes, sampled_modes, without_ripples

rotor_speeds = eqx.filter_jit(eqx.filter_vmap(jam_rotor_speed, in_axes=(None, 0)))


many_modes = eqx.filter_jit(eqx.filter_vmap(jv.jam_modes))


def stacked(scenes):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)


def name(jam):
    return jv.JamStatus[jam.status]


def random_scene(rng, n, most=0.0):
    """Any machine of n platforms; dampings from light up to the power of ten `most`."""
    links = {1: (), 2: ((1, 2),), 3: ((1, 2), (1, 3), (2, 3))}[n]

    def power(low, high, size=None):
        return np.asarray(10.0 ** rng.uniform(low, high, size)).tolist()

    machine = jv.network(
        mass=rng.uniform(0.5, 2.0, n).tolist(),
        stiffness=power(-2, 1, n),
        damping=power(-3.5, most, n),
        links=links,
        link_stiffness=power(-2, 1, len(links)),
        link_damping=power(-3.5, most, len(links)),
        exciter=n,
    )
    return jv.Scene(
        machine, jv.pendulums(count=1, mass=1e-3, radius=1.0, drag=1e-6 * power(-1, 1)), jv.ConstantSpeed(power(-0.5, 1.3))
    )


@pytest.mark.parametrize("n", [1, 2, 3])
def test_no_jam_of_random_machines_is_missed(n):
    rng = np.random.default_rng(n)
    scenes = [random_scene(rng, n, most) for most in (0.0, 1.0, 3.0) for _ in range(20)]
    found = np.asarray(many_modes(stacked(scenes)).omega)
    several = 0
    for s, omega in zip(scenes, found, strict=True):
        expected = all_load_speeds(s)
        several += len(expected) > 1
        np.testing.assert_allclose(np.sort(omega[~np.isnan(omega)]), expected, rtol=1e-6)
    assert several > 5


def two(mass, stiffness, damping, link_stiffness, link_damping, drag, speed):
    machine = jv.network(
        mass=mass,
        stiffness=stiffness,
        damping=damping,
        links=[(1, 2)],
        link_stiffness=link_stiffness,
        link_damping=link_damping,
        exciter=2,
    )
    return jv.Scene(machine, jv.pendulums(count=1, mass=1e-3, radius=1.0, drag=drag), jv.ConstantSpeed(speed))


def only_existing(modes):
    omega = np.asarray(modes.omega)
    return np.sort(omega[~np.isnan(omega)])


def test_a_link_that_locks_two_platforms_leaves_its_peak_found():
    """The two move as one, at sqrt((k1 + k2)/(m1 + m2)): far from both undamped resonances, and sharp."""
    s = two((1.0, 1.0), (0.05, 0.5), (1e-4, 1e-4), 1.0, 1e4, 1e-6, 0.7)
    modes, expected = jv.jam_modes(s), all_load_speeds(s)
    assert len(expected) == 3
    np.testing.assert_allclose(only_existing(modes), expected, rtol=1e-6)
    np.testing.assert_allclose(modes.folds.omega[0], np.sqrt(0.55 / 2.001), rtol=1e-3)


def test_a_ripple_of_the_branch_costs_no_peak():
    """Six folds for two platforms: the shallow pair between the peaks once took the place of the second peak's."""
    s = two((0.9355, 1.231), (8.016, 0.2118), (0.01279, 0.0534), 1.322, 0.1128, 1.165e-7, 15.54)
    modes, expected = jv.jam_modes(s), all_load_speeds(s)
    w = np.linspace(2.6, 2.9, 200)
    assert (np.diff(rotor_speeds(s, jnp.asarray(w))) < 0.0).any()
    assert len(expected) == 5 and modes.mode_numbers() == [1, 2, 3, 4, 5]
    np.testing.assert_allclose(modes.omega, expected, rtol=1e-6)


def test_two_peaks_near_one_resonance_are_two_modes():
    """Both peaks are nearest to the second resonance; they once shared its number, and one mode was lost."""
    s = two((0.9326, 1.087), (4.172, 0.1799), (0.006846, 0.8759), 0.177, 0.001393, 1.111e-7, 8.67)
    modes, expected = jv.jam_modes(s), all_load_speeds(s)
    assert len(expected) == 3 and modes.mode_numbers() == [1, 2, 3]
    np.testing.assert_allclose(only_existing(modes), expected, rtol=1e-6)


def test_float32_finds_the_published_folds():
    with jax.enable_x64(False):
        modes = jv.jam_modes(published().scene())
        assert modes.omega.dtype == jnp.float32 and modes.mode_numbers() == [3, 4, 5]
        np.testing.assert_allclose(modes.folds.omega, [0.3339, 0.3806, 1.0015, 1.2154], atol=2e-4)
        np.testing.assert_allclose(modes.folds.rotor_speed, [0.7978, 0.4141, 5.1829, 1.3932], rtol=1e-3)


def test_at_a_fold_the_status_says_so_and_nothing_overflows():
    """The two modes that merge at a fold are `at_fold` (or already gone); 1e-6 before it the derivative has its digits."""
    s = published().scene()

    def omega(n):
        modes = jv.jam_modes(eqx.tree_at(lambda x: x.drive.speed, s, n))
        return modes.omega, modes

    forward = eqx.filter_jit(lambda n: jax.jvp(omega, (n,), (jnp.ones_like(n),), has_aux=True))
    for fold, speed in enumerate(forward(s.drive.speed)[2].folds.rotor_speed):
        inside = -1.0 if fold % 2 == 0 else 1.0
        at = [forward(speed * (1.0 + step * inside)) for step in (0.0, 1e-13, 1e-6, 1e-6 + 1e-9, 1e-6 - 1e-9, -1e-3)]
        for mode in (fold + 1, fold + 2):
            (_, _, exact), (_, bent, near), (_, slope, clear), (up, _, _), (down, _, _), (_, _, gone) = at
            assert name(exact.select(mode, throw=False)).startswith(("the rotor speed is that of a fold", "this mode does not"))
            assert name(near.select(mode)).startswith("the rotor speed is that of a fold")
            assert np.isfinite(bent[mode - 1])
            assert name(clear.select(mode)) == "the loads can jam in this mode"
            difference = (up - down)[mode - 1] / (2e-9 * inside * speed)
            np.testing.assert_allclose(slope[mode - 1], difference, rtol=1e-4)
            assert not gone.exists[mode - 1]


def test_folds_are_differentiable():
    s = published().scene()

    def folds(k):
        f = jv.jam_modes(eqx.tree_at(lambda x: x.machine.stiffness, s, k)).folds
        return (jnp.concatenate([f.omega, f.rotor_speed]),) * 2

    both = eqx.filter_jit(jax.jacfwd(folds, has_aux=True))
    k, h = s.machine.stiffness, 1e-6
    exact, _ = both(k)
    for i in range(2):
        step = jnp.zeros(2).at[i].set(h)
        np.testing.assert_allclose(exact[:, i], (both(k + step)[1] - both(k - step)[1]) / (2 * h), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    ("cuts", "found", "modes"),
    [
        ([1.1, 1.5, 2.1, 2.5, 3.1, 3.5], 6, [1, 2, 3, 4, 5, 6, 7]),  # a peak at each of three resonances
        ([2.1, 2.5, 3.1, 3.5], 4, [3, 4, 5, 6, 7, 7, 7]),  # none at the first
        ([1.1, 1.5, 3.1, 3.5], 4, [1, 2, 5, 6, 7, 7, 7]),  # none at the second
        ([2.9, 2.95, 3.1, 3.5], 4, [3, 4, 5, 6, 7, 7, 7]),  # two nearest to the third, which the last one needs
        ([1.1, 1.2, 1.3, 1.5], 4, [1, 2, 3, 4, 7, 7, 7]),  # two nearest to the first
        ([1.1, 1.2, 2.1, 2.5], 4, [1, 2, 3, 4, 7, 7, 7]),  # none at the third
        ([], 0, [7] * 7),
    ],
)
def test_peaks_belong_to_the_resonances_they_are_nearest_to(cuts, found, modes):
    cuts = np.array(cuts + [9.0] * (6 - found))
    assert piece_modes(jnp.asarray(cuts), jnp.arange(6) < found, jnp.array([1.0, 2.0, 3.0])).tolist() == modes


@pytest.mark.parametrize("begin", [0, 600])
def test_samples_of_a_branch_have_the_numbers_of_its_pieces(begin):
    # Sample 600 lies after the first peak of the published machine; its second peak lies above the resonance 1.0.
    branch = jv.branches(published().scene(), points=2000, most=8.0)
    omega, speeds, modes = (np.asarray(x)[begin:] for x in (branch.omega, branch.rotor_speed, branch.mode))
    _, ends, numbers = sampled_modes(omega, speeds, np.asarray(branch.resonances))
    found = numbers[np.searchsorted(ends, np.arange(omega.size - 1), side="right")]
    assert set(modes) == ({1, 2, 3, 4, 5} if begin == 0 else {2, 3, 4, 5})
    same = modes[1:] == modes[:-1]  # other intervals contain a fold
    np.testing.assert_array_equal(found[same], modes[:-1][same])

    failed = np.where(np.arange(omega.size) % 10 == 3, np.nan, speeds)  # points of which no orbit converged
    away = np.concatenate([[True], same]) & np.concatenate([same, [True]])
    np.testing.assert_array_equal(modes_of(omega, failed, np.asarray(branch.resonances))[away], modes[away])


def test_a_diagram_reaches_a_speed_far_above_all_resonances():
    branch = jv.branches(published().scene(), points=2000, most=80.0)
    omega = np.asarray(branch.omega)
    np.testing.assert_allclose(omega[-1], 80.0, rtol=1e-12)
    assert np.max(np.diff(omega[omega > 0.1]) / omega[omega > 0.1][1:]) < 0.02 and np.sum(omega < 1.0) > 800


def test_the_ripples_that_span_least_are_left_out():
    speeds = jnp.array([9.0, 1.0, 1.1, 1.05, 8.0, 2.0, 2.1, 2.09])
    np.testing.assert_array_equal(without_ripples(speeds, jnp.asarray(8), 4), [0, 1, 4, 5])
    np.testing.assert_array_equal(without_ripples(speeds, jnp.asarray(6), 4), [0, 1, 4, 5])
    np.testing.assert_array_equal(without_ripples(speeds, jnp.asarray(4), 4), [0, 1, 2, 3])


def test_folds_are_looked_for_on_both_sides_of_every_pole():
    """Poles of two platforms that know nothing of each other: w^2 = k/m, decay c/2m. Points crowd there by that width."""
    s = two((2.0, 1.0), (8.0, 9.0), (0.04, 0.06), 0.0, 0.0, 1e-6, 0.7)
    model = linear_model(s)
    mass = np.asarray(model.mass)[[0, 1], [0, 1]]
    decay, w2 = np.array([0.04, 0.06]) / (2.0 * mass), np.array([8.0, 9.0]) / mass
    awaited = np.concatenate([sign * 1j * np.sqrt(w2 - decay**2) - decay for sign in (1.0, -1.0)])
    poles = np.asarray(folds._poles(model.mass, model.damping(s.drive.speed), model.carrier.stiffness))
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(awaited), rtol=1e-12)
    grid, resonances = folds.grid_near_poles(model, 40)
    np.testing.assert_allclose(resonances, np.sort(np.sqrt(w2)), rtol=1e-12)
    grid = np.asarray(grid)
    assert grid.shape == (160,) and np.all(np.diff(grid) >= 0.0)
    np.testing.assert_allclose(grid[0], 1e-3 * resonances[0], rtol=1e-9)
    assert grid[-1] > 5.0 * resonances[1]
    for pole in awaited[:2]:
        below, above = pole.imag - grid[grid < pole.imag - 1e-12], grid[grid > pole.imag + 1e-12] - pole.imag
        for side in (below, above):
            assert np.min(side) < 0.5 * -pole.real and np.sum(side < 10.0 * -pole.real) > 6
            away = np.sort(side[side > -pole.real])  # beyond a width each is at most a third further away
            assert np.max(away[1:] / away[:-1]) < 4.0 / 3.0


def test_folds_are_looked_for_beyond_poles_that_only_decay():
    """A strong damper's pole, at c/m, is far above all resonances."""
    model = linear_model(two((2.0, 1.0), (8.0, 9.0), (0.04, 600.0), 0.0, 0.0, 1e-6, 0.7))
    grid, resonances = folds.grid_near_poles(model, 40)
    assert float(resonances[-1]) < 4.0 and float(grid[-1]) > 600.0


def test_two_folds_in_one_interval_are_found():
    """Slopes that touch 0 twice between two points, from above and from below; and one that stays away."""
    grid = jnp.linspace(0.0, 10.0, 21)
    for sign in (1.0, -1.0):
        slope = lambda w, sign=sign: sign * ((w - 3.27) ** 2 - 0.01) * ((w - 7.1) ** 2 + 0.3)  # noqa: E731
        wide, values = folds._with_close_folds(slope, grid, 4)
        assert wide.shape == values.shape == (25,) and np.all(np.diff(wide) >= 0.0)
        np.testing.assert_allclose(values, jax.vmap(slope)(wide), rtol=1e-12)
        turned = np.sign(values) != sign
        assert 0 < np.sum(turned) <= 4 and np.all(np.abs(np.asarray(wide)[turned] - 3.27) < 0.1)
        dense = np.linspace(6.0, 8.0, 20001)
        closest = dense[np.argmin(sign * slope(dense))]  # it stays away from 0 there
        assert np.min(np.abs(np.asarray(wide) - closest)) < 1e-3


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_two_folds_in_the_interval_beside_another_are_found(sign):
    """A fold at 2.2, and slopes of the other sign from 3.17 to 3.37, between points at 3 and 3.5."""
    slope = lambda w: sign * (w - 2.2) * ((w - 3.27) ** 2 - 0.01)  # noqa: E731
    wide, values = folds._with_close_folds(slope, jnp.linspace(0.0, 10.0, 21), 4)
    between = (wide > 3.17) & (wide < 3.37)
    assert np.any(between) and np.all(sign * values[between] < 0.0)
    np.testing.assert_allclose(values, slope(wide), rtol=1e-12)


def test_a_point_that_is_closest_already_is_kept():
    slope = lambda w: jnp.abs(w - 3.5) + 0.1  # noqa: E731
    wide, values = folds._with_close_folds(slope, jnp.linspace(0.0, 10.0, 21), 1)
    np.testing.assert_array_equal(np.sort(wide)[6:10], [3.0, 3.5, 3.5, 4.0])
    np.testing.assert_allclose(values, jax.vmap(slope)(wide), rtol=1e-12)
