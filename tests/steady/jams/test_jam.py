"""Leading-order jam modes against the published machine, the paper's determinants and every root of a polynomial."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import polynomial as poly
from scenes import loads, machines, published

import jaxvib as jv
from jaxvib.numerics.linalg import small_solve


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0))
def modes_at(s, speed):
    return jv.jam_modes(eqx.tree_at(lambda x: x.drive.speed, s, speed))


rotor_speeds = eqx.filter_jit(eqx.filter_vmap(jv.jam_rotor_speed, in_axes=(None, 0)))
many_modes = eqx.filter_jit(eqx.filter_vmap(jv.jam_modes))


def stacked(scenes):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)


def name(jam):
    return jv.JamStatus[jam.status]


def matrices(s):
    """Mass with the loads, damping, stiffness and the exciter's index, from the designer's numbers alone."""
    m = s.machine
    mass = np.diag(np.asarray(m.mass))
    mass[m.exciter - 1, m.exciter - 1] += np.sum(np.broadcast_to(np.asarray(s.loads.mass), (s.loads.count,)))
    out = [mass]
    for support, link in ((m.damping, m.link_damping), (m.stiffness, m.link_stiffness)):
        matrix = np.diag(np.asarray(support)).astype(float)
        for (i, j), value in zip(m.links, np.asarray(link), strict=True):
            for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
                matrix[a - 1, b - 1] += sign * value
        out.append(matrix)
    return (*out, m.exciter - 1)


def unbalance_and_drag(s):
    n = s.loads.count
    mass, radius, drag = (np.broadcast_to(np.asarray(x), (n,)) for x in (s.loads.mass, s.loads.radius, s.loads.drag))
    return np.sum(mass * radius), np.sum(drag * radius**2)


def complex_response(s, w):
    """Complex amplitudes in NumPy, of platforms and of the foundation force."""
    mass, damping, stiffness, port = matrices(s)
    force = np.zeros(len(mass), complex)
    force[port] = -1j * unbalance_and_drag(s)[0] * w**2
    y = np.linalg.solve(stiffness - w**2 * mass + 1j * w * damping, force)
    return y, np.sum((np.asarray(s.machine.stiffness) + 1j * w * np.asarray(s.machine.damping)) * y)


# The published machine


def test_published_resonances_and_folds():
    """The antiphase paper, (40)-(42)."""
    modes = jv.jam_modes(published().scene())
    np.testing.assert_allclose(modes.resonances, [1 / 3, 1.0], rtol=1e-12)
    np.testing.assert_allclose(modes.folds.omega, [0.3339, 0.3806, 1.0015, 1.2154], atol=5e-5)
    np.testing.assert_allclose(modes.folds.rotor_speed, [0.7978, 0.4141, 5.1829, 1.3932], atol=5e-5)
    assert bool(modes.folds.exists.all())


def test_published_modes_exist_where_the_paper_says():
    ranges = [(0.05, 0.4140, [1]), (0.4142, 0.7977, [1, 2, 3]), (0.7979, 1.3931, [3]), (1.3933, 5.1828, [3, 4, 5])]
    ranges.append((5.1830, 20.0, [5]))
    speeds = jnp.asarray([n for low, high, _ in ranges for n in np.linspace(low, high, 7)])
    modes = modes_at(published().scene(), speeds)
    there = [[k + 1 for k in range(5) if row[k]] for row in np.asarray(modes.exists)]
    assert there == [expected for _, _, expected in ranges for _ in range(7)]
    stable = np.asarray(modes.stable)
    assert not stable[:, 1::2].any() and (stable[:, ::2] == np.asarray(modes.exists)[:, ::2]).all()


@pytest.mark.parametrize("form", ["antiphase", "criterion"])
def test_rotor_speed_is_the_papers_determinant_formula(form):
    """n = Omega - Omega^2 Delta_4 / (2 beta Delta), real 4x4 determinants over Re v1, Im v1, Re v2, Im v2."""
    n1, n2, n12, h1, h2, h12, rho, beta, count = 0.3, 0.4, 0.7, 0.02, 0.01, 0.03, 1.3, 0.8, 3
    size = dict(mass_scale=40.0, frequency_scale=100.0, radius=0.15, kappa=1.4)
    numbers = dict(natural=(n1, n2), damping=(h1, h2), link_natural=n12, link_damping=h12, rho=rho)
    eps = 1e-3 * (count if form == "criterion" else 1)
    paper = jv.Dimensionless(form, **numbers, eps=eps, beta=beta, speed=3.0, count=count, **size)
    s = 1.0 if form == "criterion" else float(count)
    omega = np.concatenate([np.linspace(0.05, 2.5, 60), [0.3, 0.35, 1.05]])
    expected = []
    for w in omega:
        a1, a2 = n1**2 + rho * n12**2 - w**2, n2**2 + n12**2 - w**2
        d1, d2, d12, k12 = 2 * w * (h1 + rho * h12), 2 * w * (h2 + h12), 2 * w * h12, n12**2
        rows = [[a1, -d1, -k12, d12], [d1, a1, -d12, -k12], [-rho * k12, rho * d12, a2, -d2], [-rho * d12, -rho * k12, d2, a2]]
        delta, right = np.array(rows), np.array([0.0, 0.0, s * w**2, 0.0])
        fourth = delta.copy()
        fourth[:, 3] = right
        expected.append(w - w**2 * np.linalg.det(fourth) / np.linalg.det(delta) / (2 * beta))
    got = rotor_speeds(paper.scene(), jnp.asarray(omega * 100.0)) / 100.0
    np.testing.assert_allclose(got, expected, rtol=1e-10)


def test_both_scalings_are_the_same_machine():
    """Three loads: eps of one load (antiphase) is a third of the eps of all (criterion); beta and v_i shrink by the count."""
    one, all_ = published(eps=1e-3, count=3), published(eps=3e-3, beta=1 / 3, count=3, form="criterion")
    for a, b in zip(jax.tree.leaves(one.scene()), jax.tree.leaves(all_.scene()), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)
    jam = jv.jam_modes(one.scene()).select(3)
    first, second = (f.read(omega=jam.omega, amplitude=jam.amplitude, force=jam.foundation_force) for f in (one, all_))
    assert first["omega"] == second["omega"]
    np.testing.assert_allclose(first["amplitude"], 3 * second["amplitude"], rtol=1e-14)
    np.testing.assert_allclose(first["force"], 3 * second["force"], rtol=1e-14)


# Any machine


def every_scene():
    six = jv.network(
        mass=[5.0, 6.0, 7.0, 8.0, 9.0, 4.0],
        stiffness=[1e4, 0.0, 0.0, 2e4, 1e3, 5e3],
        damping=[5.0, 0.0, 0.0, 5.0, 1.0, 2.0],
        links=[(1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 1)],
        link_stiffness=[2e4, 1e4, 3e4, 2e4, 1e4, 5e3],
        link_damping=[4.0, 3.0, 2.0, 1.0, 0.5, 2.0],
        exciter=5,
    )
    built = {**machines(), "network": six}
    kinds = ["balls", "rollers", "pendulums", "pendulums"]
    return {m: jv.Scene(built[m], loads()[kind], jv.ConstantSpeed(120.0)) for m, kind in zip(built, kinds, strict=True)}


@pytest.mark.parametrize("machine", every_scene())
def test_amplitudes_and_force_are_those_of_a_complex_solve(machine):
    s = every_scene()[machine]
    modes = jv.jam_modes(s)
    assert modes.mode_numbers()
    total, drag = unbalance_and_drag(s)
    for k in modes.mode_numbers():
        jam = modes.select(k)
        w = float(jam.omega)
        y, force = complex_response(s, w)
        np.testing.assert_allclose(jam.displacement, y, rtol=1e-9, atol=1e-9 * np.max(np.abs(y)))
        np.testing.assert_allclose(jam.amplitude, np.abs(y), rtol=1e-9, atol=1e-9 * np.max(np.abs(y)))
        np.testing.assert_allclose(jam.foundation_force, np.abs(force), rtol=1e-8)
        # The rotor's torque balances the mean of m R y'' cos phi over all loads.
        torque = -0.5 * total * w**2 * y[s.machine.exciter - 1].real
        np.testing.assert_allclose(drag * (120.0 - w), torque, rtol=1e-9)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_small_solve_is_numpys(n):
    rng = np.random.default_rng(n)
    for _ in range(5):
        a = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
        b = rng.normal(size=n) + 1j * rng.normal(size=n)
        np.testing.assert_allclose(small_solve(jnp.asarray(a), jnp.asarray(b)), np.linalg.solve(a, b), rtol=1e-11)


def determinant(matrix):
    """Determinant of a matrix of polynomials, by permutations."""
    n, total = len(matrix), np.zeros(1, complex)
    for order in itertools.permutations(range(n)):
        term = np.array([(-1.0) ** sum(a > b for a, b in itertools.combinations(order, 2))], complex)
        for i, j in enumerate(order):
            term = poly.polymul(term, matrix[i][j])
        total = poly.polyadd(total, term)
    return total


def all_load_speeds(s):
    """Every positive real root of P(w) = 2 drag (n - w) |det|^2 + S^2 w^4 Im(minor conj(det)), ascending."""
    mass, damping, stiffness, port = matrices(s)
    n, speed, (total, drag) = len(mass), float(s.drive.speed), unbalance_and_drag(s)
    dynamic = [[np.array([stiffness[i, j], 1j * damping[i, j], -mass[i, j]]) for j in range(n)] for i in range(n)]
    det = determinant(dynamic)
    minor = determinant([[dynamic[i][j] for j in range(n) if j != port] for i in range(n) if i != port])
    balance = 2.0 * drag * poly.polymul([speed, -1.0], poly.polymul(det, det.conj()).real)
    balance = poly.polyadd(balance, poly.polymul([0, 0, 0, 0, total**2], poly.polymul(minor, det.conj()).imag))
    scaled = balance * speed ** np.arange(len(balance))  # the variable is w/n: coefficients of one size
    roots = poly.polyroots(scaled / np.max(np.abs(scaled)))
    return np.sort(roots[(np.abs(roots.imag) < 1e-6 * np.abs(roots)) & (roots.real > 0.0)].real) * speed


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


def test_each_mode_is_listed_with_its_number():
    """Strong dampers on platform 2 take modes 1, 2; what is left keeps the numbers of the second resonance."""
    s = published(speed=3.0).scene()
    damped = eqx.tree_at(lambda x: x.machine.damping, s, jnp.asarray([0.3, 0.3]))
    weak = jv.jam_modes(eqx.tree_at(lambda x: x.drive.speed, damped, jnp.asarray(1.45)))
    assert not weak.exists[0] and not weak.exists[1] and bool(weak.exists[2])


# Hard cases: a sensible answer, or a status that says why there is none


def numbers_of(jam):
    return np.concatenate([np.ravel(jam.omega), np.ravel(jam.amplitude), np.ravel(jam.foundation_force), np.ravel(jam.slope)])


def replaced(s, **values):
    for field, value in values.items():
        s = eqx.tree_at(lambda x, field=field: getattr(x.machine, field), s, jnp.asarray(value))
    return s


def hard_cases():
    s = published().scene()
    return {
        "equal natural frequencies, decoupled": (replaced(s, link_stiffness=[0.0], link_damping=[0.0]), [5]),
        "one support without damping": (replaced(s, damping=[0.0, 0.02]), [3, 4, 5]),
        "all damping 1e-6": (replaced(s, damping=[1e-6, 1e-6], link_damping=[1e-6]), [1, 2, 3, 4, 5]),
        "no damping": (replaced(s, damping=[0.0, 0.0], link_damping=[0.0]), [5]),
        "huge damping": (replaced(s, damping=[1e4, 1e4], link_damping=[1e4]), [5]),
        "free to drift": (replaced(s, stiffness=[0.0, 0.0], damping=[0.0, 0.0]), [3, 4, 5]),
    }


@pytest.mark.parametrize("case", hard_cases())
def test_hard_case_has_every_jam_and_finite_numbers(case):
    s, there = hard_cases()[case]
    modes = jv.jam_modes(s)
    assert modes.mode_numbers() == there
    if case != "no damping":  # there the polynomial has double roots at the poles, where no load can jam
        rtol = 1e-4 if "1e-6" in case else 1e-6  # of the polynomial's roots, two of them close to a pole
        np.testing.assert_allclose(modes.omega[jnp.asarray(there) - 1], all_load_speeds(s), rtol=rtol)
    for k in there:
        jam = modes.select(k)
        assert name(jam) == "the loads can jam in this mode"
        assert np.isfinite(numbers_of(jam)).all()


def test_without_damping_the_loads_turn_with_the_rotor():
    s, _ = hard_cases()["no damping"]
    jam = jv.jam_modes(s).select(5)
    assert float(jam.omega) == 3.0 and float(jam.slope) == 1.0 and bool(jam.stable)


def test_an_undamped_resonance_at_the_rotors_speed_says_so():
    s, _ = hard_cases()["no damping"]
    jam = jv.jam_modes(eqx.tree_at(lambda x: x.drive.speed, s, jnp.asarray(1.0))).select(5)
    assert name(jam) == "the loads turn at a resonance that nothing damps: the vibration has no bound"
    assert np.isnan(jam.amplitude).all() and np.isnan(jam.foundation_force)


def test_a_machine_free_to_drift_has_frequency_zero():
    s, _ = hard_cases()["free to drift"]
    frequencies = jv.natural_frequencies(s)
    assert float(frequencies[0]) == 0.0 and float(frequencies[1]) > 0.9
    assert float(jv.jam_modes(s).select(5).foundation_force) == 0.0


def test_float32_finds_the_published_folds():
    with jax.enable_x64(False):
        modes = jv.jam_modes(published().scene())
        assert modes.omega.dtype == jnp.float32 and modes.mode_numbers() == [3, 4, 5]
        np.testing.assert_allclose(modes.folds.omega, [0.3339, 0.3806, 1.0015, 1.2154], atol=2e-4)
        np.testing.assert_allclose(modes.folds.rotor_speed, [0.7978, 0.4141, 5.1829, 1.3932], rtol=1e-3)


def test_loads_without_drag_are_refused():
    s = jv.Scene(machines()["two_mass"], jv.balls(count=2, mass=0.1, radius=0.1, drag=0.0), jv.ConstantSpeed(10.0))
    with pytest.raises(jv.InputError, match=r"loads\.drag is 0"):
        jv.jam_modes(s)


def test_select_says_what_is_wrong():
    modes = jv.jam_modes(published(speed=1.0).scene())
    for wrong in (0, 6, -1, 2.0, "3", True):
        with pytest.raises(jv.InputError, match="jam modes are numbered 1 to 5"):
            modes.select(wrong)
    with pytest.raises(jv.ComputationError, match=r"jam mode 5 does not exist at rotor speed 1 rad/s; there: 3") as error:
        modes.select(5)
    assert error.value.status == "absent"
    jam = modes.select(5, throw=False)
    assert name(jam) == "this mode does not exist at this rotor speed" and np.isnan(jam.amplitude).all()


def test_summary_lists_the_modes():
    text = jv.jam_modes(published().scene()).summary()
    assert len(text.splitlines()) == 4 and "mode 3: Omega 0.972053 rad/s, stable" in text and "mode 4" in text


# Transformations and folds


def test_vmap_over_rotor_speeds_is_a_loop():
    s, speeds = published().scene(), jnp.asarray([0.3, 0.6, 1.0, 3.0, 6.0])
    batch = modes_at(s, speeds)
    for k, n in enumerate(speeds):
        one = jv.jam_modes(eqx.tree_at(lambda x: x.drive.speed, s, n))
        for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-11, atol=1e-300)


def test_at_a_fold_the_status_says_so_and_nothing_overflows():
    """At a fold the two modes that merge are `at_fold` (or already gone); 1e-6 before it the derivative has its digits."""
    s = published().scene()

    def omega(n):
        modes = jv.jam_modes(eqx.tree_at(lambda x: x.drive.speed, s, n))
        return modes.omega, modes

    forward = jax.jit(lambda n: jax.jvp(omega, (n,), (jnp.ones_like(n),), has_aux=True))
    for fold, speed in enumerate(jv.jam_modes(s).folds.rotor_speed):
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
        return jnp.concatenate([f.omega, f.rotor_speed])

    k, h = s.machine.stiffness, 1e-6
    exact = jax.jit(jax.jacfwd(folds))(k)
    for i in range(2):
        step = jnp.zeros(2).at[i].set(h)
        np.testing.assert_allclose(exact[:, i], (folds(k + step) - folds(k - step)) / (2 * h), rtol=1e-6, atol=1e-7)
