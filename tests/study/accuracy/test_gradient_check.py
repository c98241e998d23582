"""Checks of derivatives against finite differences: right ones pass, wrong ones are named, noise is told from error."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import jam_rotor_speed, steady_displacement

import jaxvib as jv
from jaxvib.ode import replay
from jaxvib.runtime.programs import cached

SCENE = jv.Scene(
    jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5),
    jv.ConstantSpeed("60 rad/s"),
)


def closed(scene):
    """k^2 c: p dq/dp is twice the value by the stiffness and once by the damping."""
    return scene.machine.stiffness[0] ** 2 * scene.machine.damping[0]


@jax.custom_jvp
def turned(x):
    return x**3


@turned.defjvp
def _(primals, tangents):
    return turned(*primals), -3.0 * primals[0] ** 2 * tangents[0]


def test_difference_from_a_closed_form_is_within_the_noise():
    check = jv.check_gradients(SCENE, closed, free=("machine.stiffness", "machine.damping"), tolerance=1e-6).require()
    assert check.numbers == ("machine.stiffness[0]", "machine.damping[0]") and check.routes == ("forward", "reverse")
    exact = np.array([2.0, 1.0]) * check.value
    np.testing.assert_allclose(check.gradient, np.stack([exact, exact]), rtol=1e-12)
    off = np.abs(check.difference - exact)
    assert np.all(off <= 3.0 * check.noise) and np.all(check.noise < 1e-9 * exact)


@jax.custom_vjp
def cubed(x):
    return x**3


cubed.defvjp(lambda x: (cubed(x), x), lambda x, g: (3.0 * x**2 * g,))


@cached
def reverse_only(x):
    (x,) = replay._reverse_only([x])  # the marker of runs with the default adjoint
    return cubed(x)


def test_default_routes_support_the_quantity():
    check = jv.check_gradients(SCENE, lambda s: reverse_only(s.loads.mass), free=("loads.mass",)).require()
    assert check.routes == ("reverse",) and "numbers are p dq/dp" in check.summary().splitlines()[0]
    np.testing.assert_allclose(check.gradient, [[3.0 * 0.5**3]], rtol=1e-12)
    with pytest.raises(jv.InputError, match="adjoint supports reverse-mode"):
        jv.check_gradients(SCENE, lambda s: reverse_only(s.loads.mass), free=("loads.mass",), routes=("forward", "reverse"))


def test_parameters_without_influence_and_zero_parameters():
    check = jv.check_gradients(SCENE, closed)
    names = dict(zip(check.numbers, check.gradient[0], strict=True))
    assert names["loads.drag"] == 0.0 and check.status_name == "agree"
    free = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=0.0), SCENE.loads, SCENE.drive)
    check = jv.check_gradients(free, lambda s: s.machine.stiffness[0], free=("machine.stiffness", "machine.damping"))
    assert check.left_out == ("machine.damping[0]",) and "left out, at a bound: machine.damping[0]" in check.summary()


def test_a_wrong_derivative_is_named():
    check = jv.check_gradients(
        SCENE, lambda s: turned(s.loads.mass) + closed(s) * 1e-12, free=("loads.mass", "machine.damping")
    )
    assert check.status_name == "differ"
    assert check.summary().splitlines()[1].startswith("  loads.mass: 0.375; forward differs by 2.0e+00")
    with pytest.raises(jv.ComputationError, match=r"differ: derivatives differ .*\n  loads\.mass"):
        check.require()


def test_noise_is_distinguished_from_error():
    def rounded(scene):
        exact = scene.loads.mass**2
        return exact + jax.lax.stop_gradient(jnp.round(exact * 1e6) / 1e6 - exact)

    check = jv.check_gradients(SCENE, rounded, free=("loads.mass",), tolerance=1e-6)
    assert check.status_name == "noisy" and check.noise[0] > 1e-6 * check.difference[0]
    with pytest.raises(jv.ComputationError, match="noisy: no derivative differs, but"):
        check.require()
    assert jv.check_gradients(SCENE, rounded, free=("loads.mass",), tolerance=0.05).status_name == "agree"
    ends = jv.check_gradients(SCENE, lambda s: jnp.where(s.loads.mass > 0.5, jnp.nan, s.loads.mass), free=("loads.mass",))
    assert ends.status_name == "not_finite"


def test_an_implicit_derivative_is_that_of_the_equation():
    """x of b x^3 + k x = c, by hand: dx/dc = 1/(3 b x^2 + k); and the wrong equation is seen."""

    def solved(scene):
        b, k, c = scene.loads.drag, scene.loads.radius, scene.loads.mass
        x = c / k
        for _ in range(20):
            x = x - (b * x**3 + k * x - c) / (3.0 * b * x**2 + k)
        return x

    def residual(scene, x):
        return scene.loads.drag * x**3 + scene.loads.radius * x - scene.loads.mass

    route = jv.ImplicitRoute(solution=solved, residual=residual, read=lambda s, x: 2.0 * x)
    check = jv.check_gradients(SCENE, lambda s: 2.0 * solved(s), free=("loads.drag", "loads.mass"), implicit=route).require()
    x = float(solved(SCENE))
    by_hand = 2.0 / (3.0 * 0.5 * x**2 + 0.1) * np.array([-0.5 * x**3, 0.5])
    numbers = [check.numbers.index(name) for name in ("loads.drag", "loads.mass")]
    np.testing.assert_allclose(check.gradient[2, numbers], by_hand, rtol=1e-9)
    wrong = route._replace(residual=lambda s, x: residual(s, -x))
    assert jv.check_gradients(SCENE, lambda s: 2.0 * solved(s), implicit=wrong, routes=()).status_name == "differ"


@pytest.mark.slow
def test_a_jam_has_the_derivatives_that_its_equation_says():
    """jam_modes against the implicit function theorem on n(Omega) = n, and both against differences."""

    def force(scene):
        return jv.jam_modes(scene).select(1).foundation_force

    def read(scene, omega):
        size = jnp.abs(steady_displacement(scene, omega)[0])
        return size * jnp.hypot(scene.machine.stiffness[0], omega * scene.machine.damping[0])

    route = jv.ImplicitRoute(
        solution=lambda s: jv.jam_modes(s).select(1).omega,
        residual=lambda s, w: jam_rotor_speed(s, w) - s.drive.speed,
        read=read,
    )
    free = ("machine.stiffness", "machine.damping", "loads.mass", "drive.speed")
    check = jv.check_gradients(SCENE, force, free=free, implicit=route).require()
    assert check.routes == ("forward", "reverse", "implicit")
    np.testing.assert_allclose(check.gradient[2], check.gradient[1], rtol=1e-8, atol=1e-8 * np.max(np.abs(check.gradient)))
    wrong = route._replace(residual=lambda s, w: jam_rotor_speed(s, w) + s.drive.speed)
    check = jv.check_gradients(SCENE, force, free=("drive.speed",), routes=(), implicit=wrong)
    assert check.status_name == "differ"


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"quantity": lambda s: s.machine.stiffness}, r"quantity gives float64 of shape \(1,\); it must give one real number"),
        (
            {"quantity": closed, "free": ("machine.masses",)},
            r"free\.machine\.masses is not a parameter of this scene; did you mean 'machine\.mass'",
        ),
        ({"quantity": closed, "routes": ("sideways",)}, r"routes are \['sideways'\]; name some of forward, reverse"),
        ({"quantity": closed, "routes": ()}, r"routes are \[\]"),
        ({"quantity": closed, "tolerance": 0.0}, "tolerance is 0.0; it must be a number between 0 and 1"),
    ],
)
def test_what_cannot_be_checked_is_refused(asked, says):
    with pytest.raises(jv.InputError, match=says):
        jv.check_gradients(SCENE, **asked)


def test_a_quantity_of_chaos_is_named_and_one_with_noise_is_not():
    """x -> 4 x (1 - x), whose exponent is ln 2: 60 times make 1e18 of a change; 5 times make 30, and derivatives are right."""

    def of_orbit(many):
        def quantity(scene):
            x = 0.3 + 1e-6 * scene.machine.stiffness[0]
            return jax.lax.fori_loop(0, many, lambda _, y: 4.0 * y * (1.0 - y), x)

        return quantity

    asked = dict(free=("machine.stiffness",), routes=("forward",))
    found = jv.check_gradients(SCENE, of_orbit(60), **asked)
    assert found.status_name == "chaotic" and np.abs(found.gradient[0, 0]) > 1e7
    with pytest.raises(jv.ComputationError, match="derivatives are meaningless"):
        found.require()
    assert jv.check_gradients(SCENE, of_orbit(5), **asked).status_name == "agree"
    noisy = jv.check_gradients(SCENE, lambda s: closed(s) * (1.0 + 1e-2 * jnp.sin(jax.lax.stop_gradient(closed(s)))), **asked)
    assert noisy.status_name != "chaotic"


def test_a_number_at_its_upper_bound_is_left_out():
    """A step of a difference would cross it."""
    balls = jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25, ball_radius=0.02)
    for restitution, left_out in ((1.0, ("effects.load_contact.restitution",)), (0.5, ())):
        scene = jv.Scene(SCENE.machine, balls, SCENE.drive, (jv.LoadContact(1e5, restitution=restitution),))
        check = jv.check_gradients(scene, closed, free=("effects.load_contact.restitution", "machine.stiffness"))
        assert check.left_out == left_out
