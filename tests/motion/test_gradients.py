"""Gradients by independent routes: implicit, forward and reverse through time, finite differences."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, scene

import jaxvib as jv

NAMES = ("mass", "stiffness", "damping", "link_stiffness", "link_damping", "load_mass", "drag", "speed")


def numbers(s):
    m = s.machine
    return {
        **{name: getattr(m, name) for name in NAMES[:5]},
        "load_mass": s.loads.mass,
        "drag": s.loads.drag,
        "speed": s.drive.speed,
    }


def with_numbers(s, values):
    def where(x):
        return [*(getattr(x.machine, name) for name in NAMES[:5]), x.loads.mass, x.loads.drag, x.drive.speed]

    return eqx.tree_at(where, s, [values[name] for name in NAMES])


def flat(values):
    return jnp.concatenate([jnp.ravel(values[name]) for name in NAMES])


def unflat(vector, like):
    out, at = {}, 0
    for name in NAMES:
        size = like[name].size
        out[name] = vector[at : at + size].reshape(like[name].shape)
        at += size
    return out


def jam_outputs(s, mode=3):
    """(parameters as multiples of their own value) -> amplitudes and foundation force; relative parameters scale all alike."""
    base = numbers(s)
    x0 = flat(base)

    def outputs(factors):
        jam = jv.jam_modes(with_numbers(s, unflat(x0 * factors, base))).select(mode, throw=False)
        return jnp.append(jam.amplitude, jam.foundation_force)

    return outputs, jnp.ones_like(x0)


def with_value(derivative, f):
    """One program for a derivative of f and for its value: what differences of f need is compiled already."""
    return eqx.filter_jit(derivative(lambda x: (f(x),) * 2, has_aux=True))


def central(f, x, h):
    """Central differences. Noise floor: eps |f| / h; truncation: h^2 f'''/6, narrow peaks making f''' large."""
    columns = []
    for i in range(x.size):
        step = jnp.zeros_like(x).at[i].set(h)
        columns.append((f(x + step) - f(x - step)) / (2.0 * h))
    return jnp.stack(columns, axis=-1)


@pytest.fixture(scope="module", params=["published", "three_mass"])
def case(request):
    s = published(natural=(0.3, 0.36)).scene() if request.param == "published" else scene("three_mass", "balls", 35.0)
    mode = 3 if request.param == "published" else jv.jam_modes(s).mode_numbers()[0]
    return jam_outputs(s, mode)


def test_implicit_gradient_is_the_finite_difference(case):
    """Forward, reverse, jitted: all numbers of the machine, loads and drive; the step 1e-5 leaves an error of 1e-6."""
    outputs, x = case
    both = with_value(jax.jacfwd, outputs)
    forward, reverse = both(x)[0], eqx.filter_jit(jax.jacrev(outputs))(x)
    scale = jnp.max(jnp.abs(forward), axis=1, keepdims=True)
    np.testing.assert_allclose(forward / scale, reverse / scale, atol=1e-12)
    difference = central(lambda x: both(x)[1], x, 1e-5)
    np.testing.assert_allclose(forward / scale, difference / scale, atol=1e-6)
    assert np.isfinite(forward).all() and (np.abs(forward).max(axis=0) > 0.0).all()


def test_gradient_of_a_batch_is_the_batch_of_gradients():
    outputs, x = jam_outputs(published(natural=(0.3, 0.36)).scene())
    force = eqx.filter_jit(jax.grad(lambda v: outputs(v)[-1]))
    batch = x[None, :] * jnp.asarray([0.99, 1.0, 1.01])[:, None]
    np.testing.assert_allclose(jax.vmap(force)(batch), jnp.stack([force(v) for v in batch]), rtol=1e-9)


def test_hessian_is_the_finite_difference_of_the_gradient():
    s = published(natural=(0.3, 0.36)).scene()

    def force(k):
        moved = eqx.tree_at(lambda x: (x.machine.stiffness, x.machine.link_stiffness), s, (k[:2], k[2:]))
        return jv.jam_modes(moved).select(3, throw=False).foundation_force

    k = jnp.concatenate([s.machine.stiffness, s.machine.link_stiffness])
    both = with_value(jax.jacfwd, jax.grad(force))
    exact = both(k)[0]
    np.testing.assert_allclose(exact, exact.T, rtol=1e-9)
    difference = central(lambda k: both(k)[1], k, 1e-6)
    np.testing.assert_allclose(exact, difference, rtol=1e-5, atol=1e-6 * float(jnp.max(jnp.abs(exact))))


@eqx.filter_jit
@eqx.filter_value_and_grad
def everything(values, s, mode):
    moved = with_numbers(s, values)
    modes = jv.jam_modes(moved)
    frequencies = jnp.sum(jv.natural_frequencies(moved))
    return jnp.sum(modes.amplitude[mode - 1]) + modes.foundation_force[mode - 1] + frequencies


def test_gradient_is_finite_where_machines_degenerate():
    """Equal natural frequencies, n1 = n2, one support undamped, no supports: a sum over equal frequencies is smooth."""
    s = published().scene()
    mode3, mode5 = jnp.asarray(3), jnp.asarray(5)
    decoupled = eqx.tree_at(lambda x: (x.machine.link_stiffness, x.machine.link_damping), s, (jnp.zeros(1), jnp.zeros(1)))
    undamped = eqx.tree_at(lambda x: x.machine.damping, s, jnp.asarray([0.0, 0.02]))
    floating = eqx.tree_at(lambda x: x.machine.stiffness, s, jnp.zeros(2))
    for machine, mode in ((decoupled, mode5), (s, mode3), (undamped, mode3), (floating, mode3)):
        base = numbers(machine)
        _, gradient = everything(base, machine, mode)
        assert all(np.isfinite(g).all() for g in gradient.values())
        if machine is floating:  # a frequency starts from 0 as a root: it is counted as if it stayed there
            continue
        h = 1e-6
        up, down = (everything({**base, "stiffness": base["stiffness"].at[0].add(d)}, machine, mode)[0] for d in (h, -h))
        np.testing.assert_allclose(gradient["stiffness"][0], (up - down) / (2 * h), rtol=1e-5)


# Through the time integration: light loads, caught in mode 3

EPS = 2e-3


def damped():
    return published(speed=1.5, eps=EPS, damping=0.05).scene()


def moved(s, x):
    """The scene with its stiffnesses and dampings, of supports and link, multiplied by x (6,)."""
    m = s.machine
    return eqx.tree_at(
        lambda y: (y.machine.stiffness, y.machine.damping, y.machine.link_stiffness, y.machine.link_damping),
        s,
        (m.stiffness * x[:2], m.damping * x[2:4], m.link_stiffness * x[4:5], m.link_damping * x[5:]),
    )


def through_time(adjoint, until, of=lambda run: jnp.append(run.amplitude, run.foundation_force)):
    """The start is held: what the numbers change reaches the jam through the motion alone."""
    s = damped()
    start = jv.initial_state(s, "jam", mode=3)

    def outputs(x):
        run = jv.simulate(
            moved(s, x),
            until,
            start=start,
            save="window",
            window_periods=4,
            stepsize_controller=jv.Tolerance(1e-9),
            adjoint=adjoint,
            max_steps=2**15,
            throw=False,
        )
        return of(run)

    return outputs


def from_algebra(x):
    jam = jv.jam_modes(moved(damped(), x)).select(3, throw=False)
    return jnp.append(jam.amplitude, jam.foundation_force)


def relative(gradient):
    return gradient / jnp.max(jnp.abs(gradient), axis=1, keepdims=True)


def test_forward_gradient_through_time_is_the_implicit_one():
    """The jam is reached; the two differ by the order of the loads' share of the mass, eps = 2e-3."""
    both, x = with_value(jax.jacfwd, through_time(diffrax.ForwardMode(), 1000.0)), jnp.ones(6)
    gradient = both(x)[0]
    np.testing.assert_allclose(relative(gradient), relative(eqx.filter_jit(jax.jacfwd(from_algebra))(x)), atol=10 * EPS)
    # The difference of two runs: steps that come out otherwise leave 1e-9 tolerance / 1e-3 step = 1e-6 of noise or more.
    ahead = (both(x.at[4].add(1e-3))[1] - both(x.at[4].add(-1e-3))[1]) / 2e-3
    np.testing.assert_allclose(gradient[:, 4], ahead, atol=1e-4 * float(jnp.max(jnp.abs(gradient))))


def last_state(run):
    """The state at the end of a run. Amplitudes are the largest of many peaks, of which rounding chooses one: the derivatives
    of two settled peaks differ by what has not died out yet, 1e-6."""
    return jnp.concatenate([leaf[-1] for leaf in jax.tree.leaves(run.window.state)])


def test_reverse_gradient_through_time_is_the_forward_one():
    x = jnp.ones(6)
    forward = eqx.filter_jit(jax.jacfwd(through_time(diffrax.ForwardMode(), 60.0, last_state)))(x)
    reverse = eqx.filter_jit(jax.jacrev(through_time(None, 60.0, last_state)))(x)
    np.testing.assert_allclose(relative(reverse), relative(forward), atol=1e-11)


@pytest.mark.parametrize("integrate", [jv.simulate, jv.envelope])
def test_a_run_depends_on_the_time_of_switching_off(integrate):
    """A motor that no load brakes keeps the speed n (1 - exp(-at/T)) at which it is switched off; T is 1 s."""
    machine = jv.one_mass(mass=1e4, stiffness=1e6, damping=1e4)

    def final_speed(at):
        motor = jv.SwitchedOff(jv.DCMotor(100.0, stall_torque=50.0, inertia=0.5), at=at)
        scene = jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=1e-4)])
        return integrate(scene, 3.0, save="window", stepsize_controller=jv.Tolerance(1e-7)).omega

    np.testing.assert_allclose(jax.grad(final_speed)(jnp.asarray(0.8)), 100.0 * np.exp(-0.8), rtol=1e-4)


def test_reverse_gradient_of_many_loads_is_the_forward_one():
    """Their state is held as it is, on arrays, and has parts that are None."""
    s = scene("one_mass", "balls")
    s = eqx.tree_at(lambda s: s.loads, s, jv.balls(count=20, mass=0.01, radius=0.08, drag=0.4))
    start = jv.initial_state(s, "rest", angles=jnp.linspace(0.0, 6.0, 20))

    def end(stiffness, adjoint):
        moved = eqx.tree_at(lambda s: s.machine.stiffness, s, stiffness)
        run = jv.simulate(moved, 0.2, start=start, save="window", adjoint=adjoint, max_steps=1024)
        return run.window.state.displacement[-1, 0]

    forward, reverse = (
        eqx.filter_jit(way(lambda k, adjoint=adjoint: end(k, adjoint)))(s.machine.stiffness)
        for way, adjoint in ((jax.jacfwd, diffrax.ForwardMode()), (jax.grad, None))
    )
    assert jnp.all(forward != 0.0)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


@pytest.mark.slow
def test_every_gradient_through_time_is_the_finite_difference():
    x = jnp.ones(6)

    def both(run):
        return jnp.concatenate([last_state(run), run.amplitude, run.foundation_force[None]])

    forward = eqx.filter_jit(jax.jacfwd(through_time(diffrax.ForwardMode(), 1000.0, both)))(x)
    reverse = eqx.filter_jit(jax.jacrev(through_time(None, 1000.0, both)))(x)
    np.testing.assert_allclose(relative(reverse)[:-3], relative(forward)[:-3], atol=1e-10)
    np.testing.assert_allclose(relative(reverse)[-3:], relative(forward)[-3:], atol=1e-5)
    forward = forward[-3:]
    difference = central(eqx.filter_jit(through_time(diffrax.ForwardMode(), 1000.0)), x, 1e-3)
    scale = jnp.max(jnp.abs(forward), axis=1, keepdims=True)
    np.testing.assert_allclose(forward / scale, difference / scale, atol=1e-3)
    np.testing.assert_allclose(relative(forward), relative(jax.jacfwd(from_algebra)(x)), atol=10 * EPS)


def of_stiffness(question):
    """A function of one mass' stiffness, and the stiffness."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed(60.0))
    k = scene.machine.stiffness
    return lambda x: question(eqx.tree_at(lambda s: s.machine.stiffness, scene, x)), k


@pytest.mark.parametrize("question", [lambda s: jv.simulate(s, 0.2).omega, lambda s: jv.envelope(s, 0.5).omega])
def test_forward_derivatives_name_the_adjoint_they_need(question):
    function, k = of_stiffness(question)
    with pytest.raises(jv.InputError, match=r"adjoint .* use adjoint=diffrax.ForwardMode\(\)"):
        jax.jvp(function, (k,), (k,))


@pytest.mark.parametrize(
    "transformation",
    [
        lambda f: jax.jit(lambda x: jax.jvp(f, (x,), (x,))),
        lambda f: lambda x: jax.linearize(f, x)[1](x),
        lambda f: lambda x: jax.jit(jax.linearize(jax.jit(f), x)[1])(x),
        lambda f: jax.jacfwd(jax.jit(f)),
    ],
    ids=["jit of jvp", "linearize", "linearize of jit", "jacfwd of jit"],
)
def test_every_forward_derivative_names_the_adjoint(transformation):
    function, k = of_stiffness(lambda s: jv.simulate(s, 0.2).omega)
    with pytest.raises(jv.InputError, match=r"adjoint .* use adjoint=diffrax.ForwardMode\(\)"):
        transformation(function)(k)


def test_linearized_runs_can_be_transposed():
    function, k = of_stiffness(lambda s: jv.simulate(s, 0.2).omega)
    transposed = jax.linear_transpose(jax.linearize(function, k)[1], k)
    np.testing.assert_allclose(transposed(1.0)[0], jax.grad(function)(k), rtol=1e-9)


@pytest.mark.parametrize("transformation", [jax.jit, jax.grad, lambda f: lambda x: jax.vmap(f)(x[None])])
@pytest.mark.parametrize("question", [lambda s: jv.settle(s).omega, lambda s: jv.growth(s, 5.0).rate])
def test_what_decides_in_python_says_so_under_jax(question, transformation):
    function, k = of_stiffness(lambda s: question(s).sum())
    with pytest.raises(jv.InputError, match="use jam_orbit or simulate in it"):
        transformation(function)(k)
