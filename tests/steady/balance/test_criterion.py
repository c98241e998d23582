"""Characteristic speeds and the criterion of auto-balancing against closed forms, scipy and theorems."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from closed_forms import one_mass_speeds, three_mass_speeds, two_mass_functional, two_mass_speeds
from gyroscopic_rotor import rotor
from scenes import BALLS, machines, scene

import jaxvib as jv
from jaxvib.steady.balance.criterion import criterion_functional, criterion_table
from jaxvib.steady.balance.speeds import CriterionStatus, characteristic_speeds
from jaxvib.steady.balance.states import balanced_growth, balanced_stability

LINKS = {1: (), 2: ((1, 2),), 3: ((1, 2), (1, 3), (2, 3))}


def paper(n, natural, link, rho, damping=None, link_damping=None):
    """A machine in the criterion paper's numbers; frequency unit 30 rad/s, so that no unit is 1 by luck."""
    return jv.Dimensionless(
        "criterion",
        natural=natural,
        damping=np.zeros(n) if damping is None else damping,
        link_natural=link,
        link_damping=np.zeros(len(LINKS[n])) if link_damping is None else link_damping,
        rho=rho,
        eps=1e-2,
        beta=1.0,
        speed=2.0,
        count=2,
        mass_scale=40.0,
        frequency_scale=30.0,
        radius=0.1,
        kappa=1.4,
    )


def drawn(rng, n):
    return rng.uniform(0.2, 2.0, n), rng.uniform(0.2, 2.0, len(LINKS[n])), rng.uniform(0.3, 3.0, n - 1)


def network_of(count, seed=0, damping=1.0):
    rng = np.random.default_rng(seed)
    links = [(i, i + 1) for i in range(1, count)] + [(1, count // 2), (2, count)]
    machine = jv.network(
        mass=rng.uniform(5.0, 9.0, count),
        stiffness=rng.uniform(1e3, 1e4, count),
        damping=damping * rng.uniform(0.1, 3.0, count),
        links=links,
        link_stiffness=rng.uniform(1e3, 2e4, len(links)),
        link_damping=damping * rng.uniform(0.1, 3.0, len(links)),
        exciter=3,
    )
    return jv.Scene(machine, jv.balls(count=2, mass=0.3, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))


def real_part_of(s):
    """w -> Re(e^H A e) by numpy from the matrices alone."""
    carrier, mount = s.machine.carrier(), s.machine.mount()
    mass, damping, stiffness, port = map(np.asarray, (carrier.mass, carrier.damping, carrier.stiffness, mount.rows[0]))
    mass = mass + float(jnp.sum(jnp.broadcast_to(s.loads.mass, (s.loads.count,)))) * port.T @ port
    skew = 0.0 * damping if mount.gyroscopic is None else np.asarray(mount.gyroscopic)
    b = port.T @ np.array([(1.0, -1.0j)[axis] for axis in mount.axes])
    return lambda w: (b.conj() @ np.linalg.solve(stiffness - w**2 * mass + 1j * w * (damping + w * skew), b)).real


@pytest.mark.parametrize("n", [1, 2, 3])
def test_closed_forms_are_the_general_method(n):
    rng = np.random.default_rng(n)
    for _ in range(30):
        natural, link, rho = drawn(rng, n)
        speeds = characteristic_speeds(paper(n, natural, link, rho).scene())
        if n == 1:
            resonances, additional = one_mass_speeds(natural[0])
        elif n == 2:
            resonances, additional = two_mass_speeds(*natural, *link, *rho)
        else:
            resonances, additional = three_mass_speeds(natural, link, rho)
        np.testing.assert_allclose(speeds.resonances / 30.0, resonances, rtol=1e-12)
        np.testing.assert_allclose(speeds.additional / 30.0, additional, rtol=1e-12)
        # Without damping the sign changes are the poles and zeros themselves.
        np.testing.assert_allclose(speeds.damped_resonances, speeds.resonances, rtol=1e-12)
        np.testing.assert_allclose(speeds.damped_additional, speeds.additional, rtol=1e-12)


def test_damped_closed_form_is_the_functional():
    """Equations (29), (30): X3(q)/s times s^2/2 is the functional, in the paper's unit S^2/M2S."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        natural, link, rho = drawn(rng, 2)
        h, h12, q = rng.uniform(0.01, 0.5, 2), rng.uniform(0.01, 0.5, 1), rng.uniform(0.1, 4.0)
        s = paper(2, natural, link, rho, h, h12).scene()
        unit = float(s.loads.unbalance()) ** 2 / 40.0
        closed = two_mass_functional(q, tuple(natural), link[0], tuple(h), h12[0], rho[0]) / 2.0
        np.testing.assert_allclose(criterion_functional(s, 30.0 * q) / unit, closed, rtol=1e-11, atol=1e-13)


def test_order_of_ten_thousand_three_mass_machines():
    """q1 < q~1 < q2 < q~2 < q3, by the general method and by the closed forms."""
    rng = np.random.default_rng(0)
    count = 10_000
    values = {"mass": rng.uniform(1.0, 9.0, (count, 3)), "stiffness": rng.uniform(0.1, 9.0, (count, 3))}
    values["link_stiffness"] = rng.uniform(0.1, 9.0, (count, 3))
    base = scene("three_mass")

    @eqx.filter_jit
    @jax.vmap
    def speeds(values):
        machine = eqx.tree_at(lambda m: tuple(getattr(m, name) for name in values), base.machine, tuple(values.values()))
        found = characteristic_speeds(eqx.tree_at(lambda s: s.machine, base, machine))
        return found.resonances, found.additional

    poles, zeros = speeds({name: jnp.asarray(value) for name, value in values.items()})
    ordered = np.stack([poles[:, 0], zeros[:, 0], poles[:, 1], zeros[:, 1], poles[:, 2]])
    assert np.all(ordered[1:] > ordered[:-1])

    numbers = [jnp.asarray(rng.uniform(0.2, 2.0, (3, count))), jnp.asarray(rng.uniform(0.2, 2.0, (3, count)))]
    poles, zeros = jax.vmap(lambda n, l, r: three_mass_speeds(tuple(n), tuple(l), tuple(r)), in_axes=1)(
        *numbers, jnp.asarray(rng.uniform(0.3, 3.0, (2, count)))
    )
    ordered = np.stack([poles[:, 0], zeros[:, 0], poles[:, 1], zeros[:, 1], poles[:, 2]])
    assert np.all(ordered[1:] > ordered[:-1])


def test_one_mass_boundary_does_not_depend_on_damping_others_do():
    def damped(name, factor):
        s = scene(name)
        where = lambda x: (x.machine.damping, x.machine.link_damping)  # noqa: E731
        return characteristic_speeds(eqx.tree_at(where, s, tuple(factor * c for c in where(s))))

    one = [float(damped("one_mass", f).damped_resonances[0]) for f in (0.0, 1.0, 30.0)]
    np.testing.assert_allclose(one, one[0], rtol=1e-14)
    for name in ("two_mass", "three_mass"):
        light, heavy = damped(name, 1.0), damped(name, 3.0)
        moved = np.abs(np.asarray(heavy.damped_resonances - light.damped_resonances))
        assert np.all(moved > 1e-4), moved


def test_damper_under_the_exciter_moves_no_speed():
    s = scene("two_mass")
    more = eqx.tree_at(lambda x: x.machine.damping, s, s.machine.damping.at[1].add(5e3))
    for a, b in zip(jv.criterion(s).balancing, jv.criterion(more).balancing, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)


def test_damping_moves_no_speed_out_of_the_range_of_resonances():
    for damping in (1.0, 30.0, 1000.0):
        speeds = characteristic_speeds(network_of(6, damping=damping))
        found = np.array([w for _, w in speeds.labelled(damped=True)])
        assert found.min() >= speeds.resonances[0] * (1 - 1e-12) and found.max() <= speeds.resonances[-1] * (1 + 1e-12)


@pytest.mark.parametrize(
    "s",
    [*(scene(name) for name in machines()), network_of(6, damping=30.0), rotor(0.093), rotor(0.9), rotor(0.0, (1e6, 2e6))],
    ids=[*machines(), "heavily damped", "rotor", "disc", "anisotropic"],
)
def test_sign_of_the_functional_is_that_of_the_receptance(s):
    """Between boundaries the receptance, by numpy, keeps the sign that the criterion says; at each it changes."""
    result = jv.criterion(s)
    real_part = real_part_of(s)
    boundaries = [w for _, w in result.speeds.labelled(damped=True)]
    assert boundaries
    for k, w in enumerate(boundaries):
        assert real_part(w * (1 - 1e-9)) * (-1) ** k > 0 > real_part(w * (1 + 1e-9)) * (-1) ** k
    speeds = np.linspace(0.02, 1.5, 2000) * float(np.nanmax(result.resonances))
    speeds = speeds[np.min(np.abs(speeds[:, None] / np.array(boundaries) - 1.0), axis=1) > 1e-9]
    negative = np.array([real_part(w) < 0.0 for w in speeds])
    np.testing.assert_array_equal(result.balances(speeds), negative)
    functional = jax.vmap(lambda w: criterion_functional(s, w))(jnp.asarray(speeds))
    np.testing.assert_array_equal(functional < 0.0, negative)


@pytest.mark.parametrize("s", [rotor(0.093), rotor(0.9), rotor(0.0, (1e6, 2e6))], ids=["rotor", "disc", "anisotropic"])
def test_port_of_two_directions_without_damping(s):
    """Poles by scipy from the quadratic pencil, zeros as roots of the functional."""
    carrier = s.machine.carrier()
    speeds = characteristic_speeds(s)
    (port,), gyroscopic = s.machine.mount().rows, s.machine.mount().gyroscopic
    mass = carrier.mass + 0.4 * port.T @ port - 1j * gyroscopic
    inverse = scipy.linalg.eigvals(mass, carrier.stiffness).real
    poles = np.sort(1.0 / np.sqrt(inverse[inverse > 1e-12 * inverse.max()]))
    there = ~np.isnan(np.asarray(speeds.resonances))
    np.testing.assert_allclose(np.asarray(speeds.resonances)[there], poles, rtol=1e-9)
    bare = eqx.tree_at(lambda m: m.polar, s.machine, s.machine.polar)
    for w in np.asarray(speeds.additional):
        if np.isfinite(w) and np.min(np.abs(w / poles - 1.0)) > 1e-6:
            b = np.asarray(port).T @ np.array([1.0, -1.0j])
            d = np.asarray(bare.carrier().stiffness) - w**2 * np.asarray(mass)
            size = np.abs(b.conj() @ np.linalg.solve(d + 1e-2 * np.asarray(carrier.stiffness), b))
            assert abs(b.conj() @ np.linalg.solve(d, b)) < 1e-9 * size
    # Rounding errors of mode shapes are not shown, and speeds with damping are not assigned to those without.
    *rows, damped = speeds.summary().splitlines()
    assert "e-" not in "".join(rows[1:]) and "+0j" not in "".join(rows)
    assert damped.startswith("sign changes of the criterion, with this damping: resonance 1 ")


def test_twenty_platforms():
    s = network_of(20, damping=0.2)
    result = jv.criterion(s)
    carrier = s.machine.carrier()
    (port,) = s.machine.mount().rows
    mass = carrier.mass + 0.6 * port.T @ port
    np.testing.assert_allclose(result.resonances**2, scipy.linalg.eigh(carrier.stiffness, mass, eigvals_only=True), rtol=1e-9)
    held = [k for k in range(20) if k != 2]
    inner = np.ix_(held, held)
    zeros = scipy.linalg.eigh(np.asarray(carrier.stiffness)[inner], np.asarray(mass)[inner], eigvals_only=True)
    np.testing.assert_allclose(result.additional**2, zeros, rtol=1e-9)
    speeds = np.linspace(5.0, 1.2 * float(result.resonances[-1]), 4000)
    real_part = real_part_of(s)
    found = np.nonzero(np.diff([real_part(w) < 0.0 for w in speeds]))[0]
    exact = [scipy.optimize.brentq(real_part, speeds[k], speeds[k + 1], xtol=1e-13) for k in found]
    labelled = np.array([w for _, w in result.speeds.labelled(damped=True)])
    # The even mesh of this test can miss narrow pairs that the criterion's clustered one finds.
    nearest = labelled[np.argmin(np.abs(labelled[None, :] - np.array(exact)[:, None]), axis=1)]
    np.testing.assert_allclose(nearest, exact, rtol=1e-11)
    assert (len(labelled) - len(exact)) % 2 == 0


def test_damped_speeds_and_gradients_of_equal_satellites():
    """Four equal satellites on the exciter's platform have three equal modes that never move it, and the modal form is used.

    Closed form at Re A(w) = 0, A = b^T y, y = D^-1 b: dw/dk = -Re(y_k^2) / Re(y^T (dD/dw) y), from NumPy's dense matrices.
    """
    links = [(1, k) for k in range(2, 6)]

    def loaded(stiffness):
        machine = jv.network(
            mass=[5.0, 2.0, 2.0, 2.0, 2.0],
            stiffness=stiffness,
            damping=[8.0, 3.0, 3.0, 3.0, 3.0],
            links=links,
            link_stiffness=[2e3] * 4,
            link_damping=[2.0] * 4,
            exciter=1,
        )
        return jv.Scene(machine, jv.balls(count=2, mass=0.2, radius=0.1, drag=1.0), jv.ConstantSpeed(50.0))

    def damped(stiffness):
        found = characteristic_speeds(loaded(stiffness))
        return jnp.concatenate([found.damped_resonances, found.damped_additional])

    stiffness = jnp.asarray([2e4, 3e3, 3e3, 3e3, 3e3])
    speeds, slopes = np.asarray(damped(stiffness)), np.asarray(jax.jit(jax.jacrev(damped))(stiffness))
    s, there = loaded(stiffness), np.flatnonzero(np.isfinite(speeds))
    carrier, (b,) = s.machine.carrier(), np.asarray(s.machine.mount().rows[0])
    k, c, mass = (np.asarray(a) for a in (carrier.stiffness, carrier.damping, carrier.mass))
    mass = mass + 0.4 * np.outer(b, b)
    assert there.size >= 3
    for j in there:
        w = speeds[j]
        y = np.linalg.solve(k - w**2 * mass + 1j * w * c, b)
        by_speed = (y @ (-2.0 * w * mass + 1j * c) @ y).real
        assert abs((b @ y).real / by_speed) < 1e-10 * w
        np.testing.assert_allclose(slopes[j], -(y**2).real / by_speed, rtol=1e-8, atol=1e-10 * np.max(np.abs(slopes[j])))


NAMES = ("mass", "stiffness", "damping", "link_stiffness", "link_damping")


def speeds_of(values, name):
    base = scene(name)
    machine = eqx.tree_at(lambda m: tuple(getattr(m, n) for n in NAMES), base.machine, tuple(values[n] for n in NAMES))
    r = characteristic_speeds(eqx.tree_at(lambda x: x.machine, base, machine))
    parts = (r.resonances, r.additional, r.damped_resonances, r.damped_additional)
    speeds = jnp.concatenate([jnp.nan_to_num(part) for part in parts])
    return (speeds, r.shapes), speeds


forward = eqx.filter_jit(jax.jacfwd(speeds_of, has_aux=True))
reverse = eqx.filter_jit(jax.jacrev(speeds_of, has_aux=True))


@pytest.mark.parametrize("name", ["two_mass", "three_mass"])
def test_gradients_against_finite_differences(name):
    """Central differences, relative step 1e-4: truncation 1e-7, noise 1e-12 of the speed over the step."""
    machine = scene(name).machine
    values = {n: getattr(machine, n) for n in NAMES}
    (up_front, _), speeds = forward(values, name)
    largest = float(jnp.max(speeds))
    if name == "three_mass":
        (backward, _), _ = reverse(values, name)
        for key in NAMES:
            np.testing.assert_allclose(backward[key], up_front[key], rtol=1e-9, atol=1e-12 * largest)
    for key, value in values.items():
        for k in range(value.shape[0]):
            step = 1e-4 * float(value[k])
            up, down = (forward({**values, key: value.at[k].add(sign * step)}, name)[1] for sign in (1.0, -1.0))
            difference = (up - down) / (2.0 * step)
            np.testing.assert_allclose(up_front[key][:, k], difference, rtol=1e-6, atol=1e-12 * largest / step)


def test_gradients_are_finite_at_degenerate_points():
    """The exciter is on platform 3, with 2.4 kg of loads."""
    zero = np.zeros(3)
    equal = {"mass": [4.0, 4.0, 1.6], "stiffness": [4e4, 4e4, 4e4], "damping": zero}
    equal |= {"link_stiffness": zero, "link_damping": zero}
    cases = {
        "equal and apart": equal,
        "equal and symmetric": {**equal, "damping": [9.0, 9.0, 0.0], "link_stiffness": [0.0, 1e3, 1e3]},
        "hanging on nothing": {**equal, "stiffness": [0.0, 4e4, 2e4], "damping": [0.0, 0.0, 5.0]},
    }
    for case in cases.values():
        values = {name: jnp.asarray(value) for name, value in case.items()}
        for leaf in jax.tree.leaves((forward(values, "three_mass"), reverse(values, "three_mass"))):
            assert np.all(np.isfinite(leaf))


def test_mode_that_does_not_move_the_exciter_changes_no_sign():
    """Outer platforms in antiphase about the exciter: resonance and additional speed coincide, intervals join."""
    machine = jv.three_mass(
        mass=(4.0, 3.0, 4.0), stiffness=(4e4, 2e4, 4e4), damping=(0, 0, 0), link_stiffness=(1e3, 0, 1e3), link_damping=(0, 0, 0)
    )
    result = jv.criterion(jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0)))
    table = criterion_table(result)
    assert len(table["resonances"]) == 3 and len(table["additional"]) == 2
    assert len(table["balancing"]) == len(table["undamped_balancing"]) == 2
    np.testing.assert_allclose(np.array(table["balancing"][0]), table["undamped_balancing"][0], rtol=1e-7)


def test_table_is_ready_for_json_and_covers_all_speeds():
    import json

    for name in machines():
        table = json.loads(json.dumps(criterion_table(jv.criterion(scene(name)))))
        ends = sorted([*table["balancing"], *table["gathering"]])
        assert ends[0][0] == 0.0 and ends[-1][1] is None
        assert [a[1] for a in ends[:-1]] == [b[0] for b in ends[1:]]
        assert table["status"].endswith("every rotor speed")


def test_free_machine_balances_at_all_speeds():
    machine = jv.two_mass(mass=(4.0, 3.0), stiffness=(0, 0), damping=(0, 0), link_stiffness=1e4, link_damping=3.0)
    result = jv.criterion(jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0)))
    assert CriterionStatus[result.status].startswith("no support")
    assert result.resonances[0] == 0.0
    np.testing.assert_allclose(result.additional, 50.0, rtol=1e-14)
    table = criterion_table(result)
    assert table["balancing"][0][0] == 0.0 and len(table["gathering"]) == 1
    assert "no support" in result.summary()


@pytest.mark.parametrize("damping", [0.0, 30.0])
@pytest.mark.parametrize("count", [1, 2])
def test_machine_without_springs_balances_at_all_speeds(count, damping):
    none = [damping] * count
    links = [] if count == 1 else [(1, 2)]
    machine = jv.network(
        mass=[50.0] * count, stiffness=[0.0] * count, damping=none, links=links, link_stiffness=[0.0] * len(links),
        link_damping=[damping] * len(links), exciter=1,
    )  # fmt: skip
    result = jv.criterion(jv.Scene(machine, jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(9.0)))
    table = criterion_table(result)
    assert result.status_name == "free" and table["balancing"] == [[0.0, None]] and table["gathering"] == []
    assert result.summary().endswith("balancing at  0 .. infinity rpm\ngathering at  no rotor speed")


def test_exciter_that_cannot_move_is_refused():
    class Fixed(jv.Machine):
        kind: str = eqx.field(static=True)

        def carrier(self):
            return machines()["two_mass"].carrier()

        def mount(self, at=None):
            return jv.Mount((jnp.zeros((1, 2)),), axes=(1,))

    s = jv.Scene(Fixed(kind="fixed"), jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    with pytest.raises(jv.InputError, match=r"machine\.mount does not move with any"):
        jv.criterion(s)
    with pytest.raises(jv.InputError, match=r"machine\.stiffness.* is inf"):
        jv.one_mass(mass=1.0, stiffness=float("inf"), damping=0.0)
    for exciter, field in ((2, "exciter is attached to y2, where the stiffness is"), (1, "stiffness is")):
        machine = jv.two_mass(
            mass=(4.0, 3.0), stiffness=(1e4, 1e20), damping=(3.0, 3.0), link_stiffness=2e4, link_damping=1.0, exciter=exciter
        )
        with pytest.raises(jv.InputError, match=rf"machine\.{field} too high for this precision"):
            jv.criterion(eqx.tree_at(lambda x: x.machine, scene("two_mass"), machine))


def test_one_trace_judges_a_batch():
    base = scene("two_mass")
    factors = jnp.linspace(0.5, 2.0, 7)
    scaled = lambda k: eqx.tree_at(lambda s: s.machine.link_stiffness, base, k * base.machine.link_stiffness)  # noqa: E731
    batch = jax.vmap(lambda k: jv.criterion(scaled(k)).balancing)(factors)
    for k, row in zip(factors, batch, strict=True):
        np.testing.assert_allclose(row, jv.criterion(scaled(k)).balancing, rtol=1e-13)


def test_the_criterion_is_for_several_loads_that_nothing_pulls():
    machine = jv.one_mass(mass=49.0, stiffness=4e4, damping=30.0)

    def asked(count, *effects):
        loads = jv.balls(count=count, mass=0.5, radius=0.1, drag=1.0, ball_radius=0.01)
        return jv.criterion(jv.Scene(machine, loads, jv.ConstantSpeed(100.0), effects))

    with pytest.raises(jv.InputError, match=r"loads\.count is 1; the criterion is about the gathering of loads"):
        asked(1)
    with pytest.raises(jv.InputError, match=r"effects\.gravity acts on each load separately.*\(term LoadPotential\)"):
        asked(2, jv.Gravity())
    assert asked(2, jv.LoadContact(1e5)).status_name == "decided"


@pytest.mark.parametrize("place", [lambda s: s.machine.mass, lambda s: s.machine.stiffness])
def test_numbers_that_are_not_finite_are_not_judged(place):
    """Numbers that come to be known in the program only: negative ones and infinite ones have a status of their own."""
    scene = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0), jv.balls(**{**BALLS, "count": 2}), jv.ConstantSpeed(9.0)
    )

    def judged(x):
        return jv.criterion(eqx.tree_at(place, scene, x))

    good = place(scene)
    found = [jax.jit(judged)(x) for x in (good, -good, good * jnp.inf)]
    assert [each.status_name for each in found] == ["decided", "not_finite", "not_finite"]
    for unknown in found[1:]:
        assert unknown.summary() == unknown.message and np.all(np.isnan(unknown.gathering))
        assert criterion_table(unknown)["gathering"] == criterion_table(unknown)["undamped_gathering"] == []


@pytest.mark.parametrize("steps", [-1, 0, 1, 2.5])
def test_steps_of_a_criterion_map_are_checked(steps):
    scene = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0), jv.balls(**{**BALLS, "count": 2}), jv.ConstantSpeed(9.0)
    )
    for ask in (
        lambda: jv.criterion_map(scene, speeds=[20.0, 30.0], mass=[1.0], drag=[1.0], steps=steps),
        lambda: balanced_growth(scene, [20.0], steps=steps),
        lambda: balanced_stability(scene, steps=steps),
    ):
        with pytest.raises(jv.InputError, match=r"steps is .* it must be a whole number"):
            ask()
