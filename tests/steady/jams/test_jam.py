"""Leading-order jam modes against the published machine, the paper's determinants and a complex solve."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from load_speeds import all_load_speeds, complex_response, unbalance_and_drag
from scenes import jam_rotor_speed, loads, machines, published

import jaxvib as jv


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0))
def modes_at(s, speed):
    return jv.jam_modes(eqx.tree_at(lambda x: x.drive.speed, s, speed))


rotor_speeds = eqx.filter_jit(eqx.filter_vmap(jam_rotor_speed, in_axes=(None, 0)))


def name(jam):
    return jv.JamStatus[jam.status]


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
    speeds = jnp.asarray([n for low, high, _ in ranges for n in np.linspace(low, high, 7)])  # 35, as in the other batch
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
    first, second = (
        f.convert_results(omega=jam.omega, amplitude=jam.amplitude, force=jam.foundation_force) for f in (one, all_)
    )
    assert first["omega"] == second["omega"]
    np.testing.assert_allclose(first["amplitude"], 3 * second["amplitude"], rtol=1e-14)
    np.testing.assert_allclose(first["force"], 3 * second["force"], rtol=1e-14)


@pytest.mark.parametrize("amplitude", [1e-3, np.ones(1), np.ones((2, 3))])
def test_an_amplitude_of_other_platforms_is_refused(amplitude):
    with pytest.raises(jv.InputError, match="its last axis must have 2 entries, one for each platform"):
        published().convert_results(amplitude=amplitude)


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


def test_each_mode_is_listed_with_its_number():
    """Strong dampers on platform 2 take modes 1, 2; what is left keeps the numbers of the second resonance."""
    s = published(speed=3.0).scene()
    damped = eqx.tree_at(lambda x: x.machine.damping, s, jnp.asarray([0.3, 0.3]))
    weak = jv.jam_modes(eqx.tree_at(lambda x: x.drive.speed, damped, jnp.asarray(1.45)))
    assert not weak.exists[0] and not weak.exists[1] and bool(weak.exists[2])


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
    assert name(jam) == "the loads turn at an undamped resonance: the vibration grows without bounds"
    assert np.isnan(jam.amplitude).all() and np.isnan(jam.foundation_force)


def test_a_machine_free_to_drift_has_frequency_zero():
    s, _ = hard_cases()["free to drift"]
    frequencies = jv.natural_frequencies(s)
    assert float(frequencies[0]) == 0.0 and float(frequencies[1]) > 0.9
    assert float(jv.jam_modes(s).select(5).foundation_force) == 0.0


def test_loads_of_a_free_undamped_mass_turn_with_the_rotor():
    loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
    modes = jv.jam_modes(jv.Scene(jv.one_mass(mass=50.0, stiffness=0.0, damping=0.0), loads, jv.ConstantSpeed(100.0)))
    assert modes.mode_numbers() == [3]
    np.testing.assert_allclose([modes.omega[2], modes.amplitude[2, 0]], [100.0, 0.1 / 51.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("drag", "analyses"),
    [
        (0.0, [jv.jam_modes, jv.branches]),
        ([0.0, 1.0], [lambda s: jv.branches(s, exact=True), lambda s: jv.jam_orbit(s, near=5.0)]),
    ],
    ids=["all", "one"],
)
def test_loads_without_drag_are_refused(drag, analyses):
    s = jv.Scene(machines()["two_mass"], jv.balls(count=2, mass=0.1, radius=0.1, drag=drag), jv.ConstantSpeed(10.0))
    for analysis in analyses:
        with pytest.raises(jv.InputError, match=r"loads\.drag is 0"):
            analysis(s)


def test_select_says_what_is_wrong():
    modes = jv.jam_modes(published(speed=1.0).scene())
    for wrong in (0, 6, -1):
        with pytest.raises(jv.InputError, match="jam modes are numbered 1 to 5"):
            modes.select(wrong)
    for wrong in (2.0, "3", True, None):
        with pytest.raises(jv.InputError, match="it must be a whole number"):
            modes.select(wrong)
    with pytest.raises(
        jv.ComputationError, match=r"jam mode 5 does not exist at rotor speed 9.5493 rpm; existing modes: 3"
    ) as error:
        modes.select(5)
    assert error.value.status == "absent"
    jam = modes.select(5, throw=False)
    assert name(jam) == "this mode does not exist at this rotor speed" and np.isnan(jam.amplitude).all()


def test_summary_lists_the_modes():
    text = jv.jam_modes(published().scene()).summary()
    lines = text.splitlines()
    assert lines[1].split()[:3] == ["mode", "rpm", "stable"] and lines[2].split()[:2] == ["3", "9.2824"]
    assert text.endswith("that stay together\n(summary(scene) computes whether they stay together)")
    assert lines[2].split()[2:6] == ["yes,", "if", "they", "stay"]


def test_summary_with_a_scene_states_whether_loads_stay_together():
    machine = jv.two_mass(
        mass=(120.0, 117.6), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0
    )
    s = jv.Scene(machine, jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed("1500 rpm"))
    text = jv.jam_modes(s).summary(s)
    stable = {line.split()[0]: " ".join(line.split()[2:]) for line in text.splitlines()[2:-1]}
    assert stable["3"].startswith("yes ") and stable["4"].startswith("no ") and stable["5"].startswith("no: the loads spread ")
    assert text.endswith("stable: for light loads, each of which is free to move separately") and "side by side" not in text
    sized = s.replace(loads=jv.balls(count=3, mass=0.8, radius=0.12, ball_radius=0.03, drag=1.5))
    said = "balls lie side by side; their stability is that of points at one angle (phase_jams: points at any phases)\n"
    assert said in jv.jam_modes(sized).summary(sized) and said[:-1] not in jv.jam_modes(sized).summary()


def test_vmap_over_rotor_speeds_is_a_loop():
    s, speeds = published().scene(), jnp.asarray([0.3, 0.6, 1.0, 3.0, 6.0])
    batch = modes_at(s, jnp.resize(speeds, 35))
    for k, n in enumerate(speeds):
        one = jv.jam_modes(eqx.tree_at(lambda x: x.drive.speed, s, n))
        for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-11, atol=1e-300)


def test_loads_too_unlike_to_stay_together_are_not_called_stable():
    """One of two pendulums is dragged so hard that no vibration of this size holds it: its balance has no root at any phase."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0)

    def modes(drag):
        return jv.jam_modes(jv.Scene(machine, jv.pendulums(count=2, mass=0.5, radius=0.1, drag=drag), jv.ConstantSpeed(60.0)))

    for drag, holds in (([0.4, 0.5], True), ([0.02, 1.5], False)):
        jam = modes(drag).select(1)
        vibration = 0.5 * 0.1 * float(jam.omega) ** 2 * float(jam.amplitude[0]) / 2.0
        need = max(drag) * 0.01 * (60.0 - float(jam.omega))
        assert (vibration > need) == holds == bool(jam.stable), (vibration, need)
        assert jam.status_name == ("found" if holds else "cannot_stay_together") and float(jam.slope) > 0.0
        assert ("stable by slope" in jam.summary()) == holds and ("cannot stay together" in jam.summary()) != holds


def test_dry_friction_needs_torque_of_the_vibration_too():
    """Pendulums that the vibration holds against their drag, or against their dry friction, but not against both."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    for drag, holds in (([0.12, 0.02], True), ([0.12, 0.12], False)):
        hung = jv.pendulums(count=2, mass=[0.5, 0.1], radius=0.1, drag=drag)
        scene = jv.Scene(machine, hung, jv.ConstantSpeed(60.0), jv.DryFriction(0.1, diameter="40 mm"))
        assert jv.jam_modes(scene).select(1).status_name == ("found" if holds else "cannot_stay_together")
        assert jv.jam_orbit(scene, mode=1, throw=False).status_name == ("found" if holds else "absent")


@pytest.mark.parametrize("friction", [False, True], ids=["drag", "friction"])
def test_derivatives_at_known_jams_equal_those_of_the_search(friction):
    """Derivatives of all jams, some of them absent, by every number of the scene; then of a fold as well."""
    hung = jv.pendulums(count=2, mass=[0.8, 0.9], radius=0.12, drag=[1.5, 1.4], inertia=1e-3)
    effects = jv.DryFriction(0.01, diameter=0.02) if friction else ()
    s = jv.Scene(machines()["two_mass"], hung if friction else loads()["balls"], jv.ConstantSpeed(120.0), effects)
    assert 0 < len(jv.jam_modes(s).mode_numbers()) < 5
    weights = np.random.default_rng(0).normal(size=(5, 4))

    def total(s, fold):
        jams = jv.jam_modes(s)
        numbers = jnp.stack([jams.omega, jams.slope, jams.amplitude[:, 1], jams.foundation_force], axis=1)
        return jnp.nansum(weights * numbers) + (jams.folds.rotor_speed[1] if fold else 0.0)

    for fold in (False,) if friction else (False, True):
        ours, theirs = jax.grad(total)(s, fold), eqx.filter_jit(jax.grad(total))(s, fold)
        for (path, a), b in zip(jax.tree.leaves_with_path(ours), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-7, err_msg=f"{path}")
            assert np.all(np.isfinite(a))
