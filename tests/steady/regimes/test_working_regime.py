"""Working regime: equal to the complete search, closed forms, derivatives, and machines without a stable regime."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv

MASS, INERTIA, S = 300.0, 75.0, 0.4


def body(stiffness=3e4, damping=150.0):
    springs = [jv.support(at=(x, -0.2), stiffness=(stiffness,) * 2, damping=(damping,) * 2) for x in (-0.6, 0.6)]
    return jv.plane_body(mass=MASS, inertia=INERTIA, supports=springs)


def screen(speeds=("1000 rpm", "1000 rpm"), torque=60.0, machine=None, places=((-0.3, 0.4), (0.35, 0.4)), directions=(1, -1)):
    motors = [jv.InductionMotor(w, breakdown_torque=torque, breakdown_slip=0.1, inertia=0.05) for w in speeds]
    parts = zip(motors, places, directions, strict=True)
    exciters = [jv.Exciter(drive=m, unbalance=S, at=at, direction=d) for m, at, d in parts]
    return jv.Scene(body() if machine is None else machine, exciters=exciters)


@pytest.fixture(scope="module")
def two():
    return screen(speeds=("1000 rpm", "1004 rpm"))


@pytest.mark.slow
def test_working_regime_is_the_stable_one_of_the_full_search(two):
    every = jv.synchronous_regimes(two)
    stable = np.flatnonzero(np.asarray(every.stable) & (np.asarray(every.speed) > 90.0))
    assert stable.size == 1
    regime = jv.working_regime(two)
    assert regime.status_name == "found"
    for name in ("speed", "phases", "power", "displacement", "foundation_force", "margin", "growth"):
        np.testing.assert_allclose(getattr(regime, name), getattr(every.select(int(stable[0])), name), rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_three_exciters_leave_the_body_at_rest():
    """Equilateral triangle above the resonances: phases opposite to the places, at the no-load speed."""
    corners = [(0.5 * np.cos(a), 0.5 * np.sin(a)) for a in 2.0 * np.pi / 3.0 * np.arange(3)]
    springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(300.0, 300.0)) for x in (-0.6, 0.6)]
    machine = jv.plane_body(mass=MASS, inertia=INERTIA, supports=springs)
    regime = jv.working_regime(screen(("1000 rpm",) * 3, machine=machine, places=corners, directions=(1, 1, 1)))
    np.testing.assert_allclose(regime.speed, 1000.0 * np.pi / 30.0, rtol=1e-9)
    assert float(jnp.max(regime.amplitude)) < 1e-9 and abs(np.sum(np.exp(1j * np.asarray(regime.phases)))) < 1e-6


def test_single_shaft_balances_the_damping():
    """Circular translation: T(w) = c S^2 w^5 / |K - M w^2 + i w c|^2."""
    springs = [jv.support(at=(x, 0.0), stiffness=(3e4, 3e4), damping=(400.0, 400.0)) for x in (-0.6, 0.6)]
    machine = jv.plane_body(mass=MASS, inertia=INERTIA, supports=springs)
    scene = screen(("1000 rpm",), machine=machine, places=((0.0, 0.0),), directions=(-1,))
    regime = jv.working_regime(scene)
    w = float(regime.speed)
    braking = 800.0 * S**2 * w**5 / abs(6e4 - MASS * w**2 + 800.0j * w) ** 2
    np.testing.assert_allclose(scene.exciters[0].drive.torque(w), braking, rtol=1e-9)
    np.testing.assert_allclose(regime.power, [w * braking], rtol=1e-9)


def test_ideal_drives_prescribe_the_regime():
    drive = jv.ConstantSpeed("1000 rpm")
    exciters = [jv.Exciter(drive=drive, unbalance=S, at=(x, 0.4), direction=d) for x, d in ((-0.3, 1), (0.3, -1))]
    regime = jv.working_regime(jv.Scene(body(), exciters=exciters))
    assert regime.status_name == "found" and bool(regime.stable)
    np.testing.assert_array_equal(regime.phases, [0.0, 0.0])


def test_motors_of_different_speeds_have_a_named_status():
    apart = screen(speeds=("1000 rpm", "1500 rpm"))
    with pytest.raises(jv.ComputationError, match="no stable synchronous regime") as raised:
        jv.working_regime(apart)
    assert raised.value.status == "none_stable"
    traced = jax.jit(lambda s: jv.working_regime(s))(apart)
    assert traced.status_name == "none_stable" and not bool(traced.stable) and np.isnan(float(traced.speed))


def test_loads_are_refused_in_one_sentence():
    scene = jv.Scene(body(), jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    with pytest.raises(jv.InputError, match="needs unbalances alone"):
        jv.working_regime(scene)


@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences(two):
    start = jnp.array([0.4, 3e4, 150.0, S])

    def where(s):
        return s.exciters[1].position, s.machine.supports[0].stiffness, s.machine.supports[1].damping, s.exciters[0].unbalance

    def value(x):
        new = jnp.stack([jnp.asarray(0.35), x[0]]), jnp.full(2, x[1]), jnp.full(2, x[2]), x[3]
        regime = jv.working_regime(eqx.tree_at(where, two, new))
        path = regime.ellipse((0.5, 0.1))
        return jnp.stack([regime.speed, regime.phases[1], path.semi_major, path.direction, regime.foundation_force])

    forward, reverse = jax.jit(jax.jacfwd(value))(start), jax.jit(jax.jacrev(value))(start)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-12)
    steps = 1e-5 * start
    batch = np.asarray(jax.jit(jax.vmap(value))(start[None] + jnp.concatenate([jnp.diag(steps), -jnp.diag(steps)])))
    differences = ((batch[:4] - batch[4:]) / (2.0 * np.asarray(steps)[:, None])).T
    scale = np.max(np.abs(differences * np.asarray(start)), axis=1, keepdims=True) / np.asarray(start)
    np.testing.assert_allclose(np.asarray(forward) / scale, differences / scale, atol=1e-5)
