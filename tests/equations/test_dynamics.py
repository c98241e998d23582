"""The vector field against independent derivations of the equations of motion."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import loads, machines, published, scene

import jaxvib as jv
from jaxvib.equations.exciter import ExciterDynamics
from jaxvib.equations.sliding import kinematics


def random_state(s, seed=0):
    rng = np.random.default_rng(seed)
    nd, n = s.machine.carrier().mass.shape[0], s.loads.count
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape))  # noqa: E731
    return jv.State(draw(nd), draw(nd), (3.0 * draw(n),), (50.0 * draw(n),))


evaluate = eqx.filter_jit(lambda s, state: jv.vector_field(s)(0.0, state))


def euler_lagrange(s, state, gravity):
    """Accelerations from T, V and the dissipated power alone, the mass matrix assembled whole by automatic differentiation."""
    machine, load = s.machine, s.loads
    nd, n = machine.mass.shape[0], load.count
    m, r, b = (np.broadcast_to(np.asarray(x), (n,)) for x in (load.mass, load.radius, load.drag))
    kappa = {"ball": 7 / 5, "roller": 3 / 2}.get(load.kind)
    extra = m * r**2 * (kappa - 1.0) if kappa else np.broadcast_to(np.asarray(load.inertia), (n,))
    port = machine.exciter - 1
    speed = float(s.drive.speed)

    def kinetic(x, v):
        def point(x):
            return jnp.stack([r * jnp.cos(x[nd:]), x[port] + r * jnp.sin(x[nd:])])

        velocity = jax.jvp(point, (x,), (v,))[1]
        return (
            0.5 * jnp.sum(machine.mass * v[:nd] ** 2)
            + 0.5 * jnp.sum(m[None, :] * velocity**2)
            + 0.5 * jnp.sum(jnp.asarray(extra) * v[nd:] ** 2)
        )

    def links(x):
        return jnp.stack([x[i - 1] - x[j - 1] for i, j in machine.links]) if machine.links else jnp.zeros(0)

    def potential(x):
        spring = jnp.sum(machine.stiffness * x[:nd] ** 2) + jnp.sum(machine.link_stiffness * links(x) ** 2)
        return 0.5 * spring + gravity * jnp.sum(m * r * jnp.sin(x[nd:]))

    def dissipation(v):
        dampers = jnp.sum(machine.damping * v[:nd] ** 2) + jnp.sum(machine.link_damping * links(v) ** 2)
        return 0.5 * dampers + 0.5 * jnp.sum(b * r**2 * (v[nd:] - speed) ** 2)

    x = jnp.concatenate([state.displacement, state.angle[0]])
    v = jnp.concatenate([state.velocity, state.rate[0]])
    mass = jax.hessian(kinetic, 1)(x, v)
    momentum_along = jax.jvp(lambda y: jax.grad(kinetic, 1)(y, v), (x,), (v,))[1]
    force = jax.grad(kinetic)(x, v) - jax.grad(potential)(x) - jax.grad(dissipation)(v) - momentum_along
    a = jnp.linalg.solve(mass, force)
    return a[:nd], a[nd:]


@functools.cache
def accelerations_of(machine, load):
    """One program for a machine and its loads, with gravity and without."""
    return eqx.filter_jit(functools.partial(euler_lagrange, scene(machine, load)))


@pytest.mark.parametrize("effects", [(), (jv.Gravity(),)], ids=["plain", "gravity"])
@pytest.mark.parametrize("load", loads())
@pytest.mark.parametrize("machine", machines())
def test_vector_field_is_euler_lagrange(machine, load, effects):
    s = scene(machine, load, effects=effects)
    for seed in range(3):
        state = random_state(s, seed)
        field = evaluate(s, state)
        q, phi = accelerations_of(machine, load)(state, 9.81 if effects else 0.0)
        np.testing.assert_allclose(field.velocity, q, rtol=1e-12, atol=1e-12 * float(jnp.max(jnp.abs(q))))
        np.testing.assert_allclose(field.rate[0], phi, rtol=1e-12, atol=1e-12 * float(jnp.max(jnp.abs(phi))))
        np.testing.assert_array_equal(field.displacement, state.velocity)


@pytest.mark.parametrize("form", ["antiphase", "criterion"])
def test_two_mass_is_the_papers_equation(form):
    """Equation (2) of the antiphase paper, written by hand, in its own variables."""
    n1, n2, n12, h1, h2, h12, rho, eps, beta, n, count = 0.3, 0.4, 0.7, 0.01, 0.02, 0.03, 1.3, 0.05, 0.8, 3.0, 3
    size = dict(mass_scale=40.0, frequency_scale=100.0, radius=0.15, kappa=1.4)
    numbers = dict(natural=(n1, n2), damping=(h1, h2), link_natural=n12, link_damping=h12, rho=rho)
    paper = jv.Dimensionless(form, **numbers, eps=eps, beta=beta, speed=n, count=count, **size)
    s = paper.scene()
    w = size["frequency_scale"]

    rng = np.random.default_rng(1)
    v, dv, phi, dphi = rng.normal(size=2), rng.normal(size=2), rng.normal(size=count), rng.normal(size=count)
    state = jv.State(v * paper.length_units, dv * paper.length_units * w, (jnp.asarray(phi),), (jnp.asarray(dphi * w),))
    field = evaluate(s, state)
    ddv, ddphi = field.velocity / paper.length_units / w**2, field.rate[0] / w**2

    share = 1.0 / count if form == "criterion" else 1.0
    s_y2 = share * np.sum(np.cos(phi) * ddphi - np.sin(phi) * dphi**2)
    pull = 2 * h12 * (rho * dv[0] - dv[1]) + n12**2 * (rho * v[0] - v[1])
    residual = [
        ddv[0] + 2 * h1 * dv[0] + n1**2 * v[0] + pull,
        ddv[1] + 2 * h2 * dv[1] + n2**2 * v[1] - pull + s_y2,
        *(ddphi + eps * beta * (dphi - n) + eps * ddv[1] * np.cos(phi)),
    ]
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)


def test_three_mass_is_the_papers_equation_mended():
    """Equation (39) of the criterion paper with the third platform's link term n23^2 (y2 - rho3 y3)."""
    n, h, nl, hl = (0.3, 0.4, 0.5), (0.01, 0.02, 0.03), (0.7, 0.6, 0.8), (0.01, 0.02, 0.04)
    rho1, rho3, eps, beta, speed = 1.3, 0.7, 0.05, 0.8, 3.0
    paper = jv.Dimensionless(
        "criterion", natural=n, damping=h, link_natural=nl, link_damping=hl, rho=(rho1, rho3), eps=eps, beta=beta, speed=speed
    )
    rng = np.random.default_rng(2)
    v, dv, phi, dphi = rng.normal(size=3), rng.normal(size=3), rng.normal(size=1), rng.normal(size=1)
    state = jv.State(v * paper.length_units, dv * paper.length_units, (jnp.asarray(phi),), (jnp.asarray(dphi),))
    field = evaluate(paper.scene(), state)
    a, ddphi = field.velocity / paper.length_units, field.rate[0]
    r = np.array([rho1, 1.0, rho3])
    y, dy = r * v, r * dv
    link = [2 * hl[k] * (dy[i] - dy[j]) + nl[k] ** 2 * (y[i] - y[j]) for k, (i, j) in enumerate([(0, 1), (0, 2), (1, 2)])]
    own = [a[i] + 2 * h[i] * dv[i] + n[i] ** 2 * v[i] for i in range(3)]
    s_y2 = np.sum(np.cos(phi) * ddphi - np.sin(phi) * dphi**2)
    residual = [own[0] + link[0] + link[1], own[1] - link[0] + link[2] + s_y2, own[2] - link[1] - link[2]]
    residual += list(ddphi + eps * beta * (dphi - speed) + eps * a[1] * np.cos(phi))
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)


def test_vector_field_is_a_term_of_diffrax():
    s = scene(effects=())
    field, state = jv.vector_field(s), random_state(s)
    assert eqx.tree_equal(diffrax.ODETerm(field).vf(0.0, state, None), field(0.0, state))


def test_absent_effect_is_not_in_the_program():
    """A scene without gravity traces fewer operations, and no constant of gravity is among its inputs."""

    def size(s):
        state = random_state(s)
        return len(jax.make_jaxpr(lambda y: jv.vector_field(s)(0.0, y))(state).jaxpr.eqns)

    assert size(scene(effects=())) < size(scene(effects=(jv.Gravity(),)))
    assert len(jax.tree.leaves(scene(effects=()))) + 1 == len(jax.tree.leaves(scene(effects=(jv.Gravity(),))))


def test_scene_without_effects_traces_as_if_there_were_none(monkeypatch):
    """The program is the same after all terms of effects, a motor and a station are removed from the code."""
    s = scene("two_mass", "pendulums")
    state = random_state(s)

    def program():
        return str(jax.make_jaxpr(lambda t, y: jv.vector_field(s)(t, y))(0.0, state))

    whole = program()
    monkeypatch.setattr(ExciterDynamics, "_add_friction", lambda self, drag, contact: (drag, contact.force, [{}]))
    monkeypatch.setattr(ExciterDynamics, "_imbalance_derivatives", lambda self, t, state: None)
    monkeypatch.setattr(
        ExciterDynamics, "_add_rotor", lambda self, motion, mass, reaction, drag, coupling: (mass, reaction, None)
    )
    monkeypatch.setattr(ExciterDynamics, "at_loads", lambda self, a: dict(zip(self.axes, a, strict=True)))
    monkeypatch.setattr(
        ExciterDynamics, "_total", lambda self, values, *arms: jnp.sum(jnp.broadcast_to(values, (s.loads.count,)))
    )
    for module in ("dynamics", "exciter"):
        monkeypatch.setattr(f"jaxvib.equations.{module}.terms_of", lambda effects, *kinds: [])
    assert program() == whole


def test_vertical_machine_has_no_sideways_coordinate():
    assert scene("two_mass").machine.mount().rows[0].shape == (1, 2)
    assert scene("two_mass").machine.mount().gyroscopic is None


def test_structure_is_the_carriers_and_traced_once_for_a_form():
    for machine in machines().values():
        carrier, structure = machine.carrier(), machine.structure()
        assert [x.shape for x in jax.tree.leaves(structure)] == [x.shape for x in jax.tree.leaves(carrier)]
        assert structure.coordinates == carrier.coordinates
        heavier = jax.tree.map(lambda leaf: 2.0 * leaf, machine)
        assert heavier.structure() is structure
    assert machines()["one_mass"].structure().mass.dtype == jnp.float64
    with jax.enable_x64(False):
        assert jv.one_mass(mass=1.0, stiffness=1.0, damping=0.0).structure().mass.dtype == jnp.float32


def test_time_loop_holds_no_library_call():
    """LAPACK, callbacks, scatter and sort would keep the compiler from making one function of a step."""
    s = scene("network", "pendulums", effects=(jv.Gravity(),))
    field = jv.vector_field(s)
    names = {e.primitive.name for e in jax.make_jaxpr(field)(0.0, random_state(s)).jaxpr.eqns}
    banned = {"lu", "cholesky", "eigh", "triangular_solve", "sort", "scatter", "scatter-add", "pure_callback", "dot_general"}
    assert not names & banned


def test_published_numbers_build_the_published_machine():
    machine = published().scene().machine
    np.testing.assert_allclose(machine.stiffness, 1 / 9, rtol=1e-15)
    np.testing.assert_allclose(machine.link_stiffness, 4 / 9, rtol=1e-15)


class Planar(jv.Machine):
    """A body that moves across and up and also tilts, its mount away from the tilt's axis: two-directional, gyroscopic."""

    matrices: tuple
    kind: str = eqx.field(static=True)

    def carrier(self):
        none = jnp.zeros((1, 3))
        return jv.Carrier(*self.matrices[:3], none, none, ("x", "y", "tilt"), ("m", "m", "rad"))

    def mount(self, at=None):
        return jv.Mount((self.matrices[4],), axes=(0, 1), gyroscopic=self.matrices[3])


@pytest.mark.parametrize("load", loads())
def test_two_directional_port_is_euler_lagrange(load):
    rng = np.random.default_rng(5)
    root = rng.normal(size=(3, 3))
    skew = rng.normal(size=(3, 3))
    mass, damping, stiffness = root @ root.T + 3.0 * np.eye(3), np.diag([3.0, 4.0, 5.0]), root.T @ root * 1e3
    port = np.array([[1.0, 0.0, 0.3], [0.0, 1.0, -0.2]])
    matrices = tuple(jnp.asarray(a) for a in (mass, damping, stiffness, skew - skew.T, port))
    s = jv.Scene(Planar(matrices=matrices, kind="planar"), loads()[load], jv.ConstantSpeed(40.0), (jv.Gravity(),))
    state = random_state(s)
    n, m, r = s.loads.count, s.loads.mass, s.loads.radius

    def kinetic(x, v):
        def point(x):
            return jnp.stack([r * jnp.cos(x[3:]), r * jnp.sin(x[3:])])

        own = jax.jvp(point, (x,), (v,))[1]
        whole = own + (matrices[4] @ v[:3])[:, None]
        weight = jnp.broadcast_to(m, (n,))[None, :]
        rolling = (jnp.broadcast_to(s.loads.inertia_factor(), (n,)) - 1.0)[None, :]
        return 0.5 * v[:3] @ matrices[0] @ v[:3] + 0.5 * jnp.sum(weight * (whole**2 + rolling * own**2))

    def potential(x):
        return 0.5 * x[:3] @ matrices[2] @ x[:3] + jnp.sum(m * 9.81 * r * jnp.sin(x[3:]))

    x = jnp.concatenate([state.displacement, state.angle[0]])
    v = jnp.concatenate([state.velocity, state.rate[0]])
    resistance = jnp.concatenate(
        [-(matrices[1] + 40.0 * matrices[3]) @ v[:3], jnp.broadcast_to(s.loads.drag * r**2, (n,)) * (40.0 - v[3:])]
    )

    @eqx.filter_jit
    def accelerations(x, v):
        along = jax.jvp(lambda y: jax.grad(kinetic, 1)(y, v), (x,), (v,))[1]
        return jnp.linalg.solve(
            jax.hessian(kinetic, 1)(x, v), jax.grad(kinetic)(x, v) - jax.grad(potential)(x) + resistance - along
        )

    field = evaluate(s, state)
    found = jnp.concatenate([field.velocity, field.rate[0]])
    np.testing.assert_allclose(found, accelerations(x, v), rtol=1e-11)


@pytest.mark.parametrize("kind", ["balls", "pendulums"])
def test_a_circles_tangents_are_as_long_as_its_loads_say(kind):
    """`tangent_lengths`, which lets the equations leave out terms, equals the value that they would compute."""
    load = loads()[kind]
    u, rate = (jnp.linspace(-2.0, 3.0, load.count),), (jnp.linspace(7.0, -5.0, load.count),)
    told = kinematics(load, u, rate)
    computed = told._replace(lengths=None)
    for ours, theirs in ((told.sizes, computed.sizes), (told.metric[0], computed.metric[0])):
        np.testing.assert_allclose(jnp.broadcast_to(ours[0], u[0].shape), theirs[0], rtol=1e-14)
    assert told.curvature_along is None
    np.testing.assert_allclose(computed.curvature_along[0], 0.0, atol=1e-13)
