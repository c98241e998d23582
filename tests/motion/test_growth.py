"""How disturbances grow: chaos is named, and its exponent is right."""

import itertools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv


def forced(cubic, stiffness):
    """x'' + 0.05 x' + stiffness x + cubic x^3 = 7.5 sin t, with a load that is a speck."""
    machine = jv.one_mass(mass=1.0, stiffness=stiffness, damping=0.05)
    loads = jv.pendulums(count=1, mass=1e-9, radius=1.0, drag=1e-9)
    scene = jv.Scene(machine, loads, jv.ConstantSpeed(1.0), (jv.StaticImbalance(7.5), jv.CubicSupport(cubic)))
    return scene, jv.State(jnp.full(1, 2.5), jnp.zeros(1), (jnp.zeros(1),), (jnp.ones(1),))


def test_a_strange_attractor_is_named():
    """Ueda's; `jaxvib stress` compares its exponent with SciPy's, over more turns."""
    scene, start = forced(1.0, 1e-6)
    found = jv.growth(scene, 4800.0, start=start, stretches=160)
    assert found.status_name == "chaotic" and 0.05 < found.exponent < 0.2
    np.testing.assert_allclose(found.horizon * found.exponent, -np.log(np.finfo(float).eps))


def test_a_linear_oscillator_is_regular():
    """It forgets at half its damping over its mass, the load's angle keeps what it has."""
    scene, start = forced(0.0, 1.0)
    found = jv.growth(scene, 100.0, start=start, stretches=8)
    assert found.status_name == "regular" and np.isinf(found.horizon) and found.rates.shape == (8,)
    assert -0.026 < found.exponent < 1e-3


def test_angles_that_are_kept_within_a_turn_are_compared_across_its_end(monkeypatch):
    """In single precision of two motions that are 2 pi - 6.2 apart one may end at 3.1 rad, the other at -3.1 rad."""
    ends = itertools.cycle([3.1, -3.1])

    def run(scene, stretch, *, start, **_):
        end = eqx.tree_at(lambda s: s.angle, start, (jnp.full(1, next(ends)),))
        return SimpleNamespace(status=jv.RunStatus.done, window=SimpleNamespace(state=jax.tree.map(lambda x: x[None], end)))

    monkeypatch.setattr("jaxvib.motion.growth.simulate", run)
    with jax.enable_x64(False):
        scene, start = forced(0.0, 1.0)
        found = jv.growth(scene, 100.0, start=start, stretches=8)
    # From 0.01 apart, of which what is no angle stays.
    grown = 0.01 * np.exp(found.rates * found.time[0])
    assert np.all((grown > 2.0 * np.pi - 6.2 - 1e-5) & (grown < np.hypot(2.0 * np.pi - 6.2, 0.01) + 1e-5))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [(dict(stretches=4), "at least 8 are needed"), (dict(start="jam"), "mode is missing"), (dict(until=0.0), "greater than 0")],
)
def test_what_is_refused(arguments, says):
    scene = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5),
        jv.ConstantSpeed(60.0),
    )
    with pytest.raises(jv.InputError, match=says):
        jv.growth(scene, **{"until": 10.0, **arguments})


def test_a_drive_that_changes_is_refused():
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.RunUp(60.0, acceleration=3.0))
    with pytest.raises(jv.InputError, match="drive is 'run_up'"):
        jv.growth(scene, 10.0)
