"""Derivatives of every quantity by every route: forward, reverse, as a search follows jams, and finite differences."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.study.accuracy.gradient_check import _DIFFERENCE_STEPS, _NOISE_FACTOR, _extrapolate, _scale
from optimize import (
    amplitude,
    expected,
    fold_margin,
    force_per_amplitude,
    foundation_force,
    jam_frequency,
    largest,
    largest_multiplier,
    peak_force,
    phase,
    power,
    product,
    quantile,
    settling_time,
    spring_cost,
    static_deflection,
    support_frequency_squared,
    total,
    total_mass,
    under,
    worst,
)
from optimize.quantities import evaluation
from optimize.quantities.evaluation import Evaluation, speed_of_target
from optimize.search.problem import find_targets

OFF = {"machine.stiffness": 0.05}
FORCE = foundation_force(mode=3)
JAMS = [amplitude(mode=3), amplitude(mode=3, of=1), phase(mode=3), FORCE, force_per_amplitude(mode=3), jam_frequency(mode=3)]
LEADING = [
    *JAMS,
    *(fold_margin(mode=3), power(mode=3), static_deflection(1), total_mass(), spring_cost([(1e4, 20.0), (1e5, 56.0)])),
    *(product("machine.stiffness"), total("machine.stiffness"), support_frequency_squared()),
    *(under(FORCE, "heavy", {"machine.mass[0]": 160.0}), 0.3 * FORCE / "10 N" + power(mode=3) ** 2 / "100 W^2"),
    largest(FORCE, 2.0 * under(FORCE, "heavy", {"machine.mass[0]": 160.0})),
]
ROBUST = [expected(FORCE, OFF, samples=8), worst(FORCE, OFF, samples=8), quantile(FORCE, 0.8, OFF, samples=8)]
EXACT = [q.at_tier("exact") for q in (*JAMS, power(mode=3), foundation_force(mode=3, harmonic=3), largest_multiplier(mode=3))]
TIME = [peak_force(until=6.0, spin_up=3.0), settling_time(until=6.0, spin_up=3.0), amplitude(mode=3, tier="time")]


def machine(seed):
    random = np.random.default_rng(seed)
    two = jv.two_mass(
        mass=random.uniform(90.0, 150.0, 2), stiffness=random.uniform(2e4, 8e4, 2), damping=random.uniform(30.0, 80.0, 2),
        link_stiffness=random.uniform(1e5, 3e5), link_damping=random.uniform(30.0, 80.0),
    )  # fmt: skip
    return jv.Scene(two, jv.balls(count=3, mass=0.8, radius=0.12, drag=random.uniform(1.0, 2.0)), jv.ConstantSpeed(130.0))


def moved(scene, shares):
    """The scene with stiffness (2), damping (2), the link's stiffness and the drag each more by a share (6,)."""

    def places(s):
        return s.machine.stiffness, s.machine.damping, s.machine.link_stiffness, s.loads.drag

    now = places(scene)
    parts = jnp.split(shares, [2, 4, 5])
    return eqx.tree_at(
        places, scene, tuple(old * (1.0 + part.reshape(old.shape)) for old, part in zip(now, parts, strict=True))
    )


class Routes:
    """All derivatives of some quantities, compiled once: of the whole branch, and as a search follows jams."""

    def __init__(self, quantities, modes=("forward", "reverse"), whole=True):
        self.quantities, self.keys = quantities, find_targets(quantities, machine(0))[0]
        self.near = eqx.filter_jit(self.speeds)
        by = {"forward": jax.jacfwd, "reverse": jax.jacrev}
        self.routes = {}
        for how, kept in [("whole branch", False)] * whole + [("followed", True)] * ("reverse" in modes):
            for mode in modes:
                self.routes[f"{how}, {mode}"] = eqx.filter_jit(lambda s, near, kept=kept, mode=mode: by[mode](
                    lambda e: self.read(s, near if kept else None, e))(jnp.zeros(6)))  # fmt: skip
        self.value = eqx.filter_jit(lambda s, near, e: self.read(s, None if whole else near, e))

    def read(self, scene, near, shares):
        evaluation = Evaluation(moved(scene, shares), near)
        return jnp.stack([q.read(evaluation) for q in self.quantities])

    def speeds(self, scene):
        """Load speeds that a search follows."""

        def of(scene, path, asked):
            if not path:
                return speed_of_target(jv.jam_modes(scene), asked)
            at = path[0].scenes(scene)
            return jax.vmap(lambda s: of(s, path[1:], asked))(at) if path[0].has_several else of(at, path[1:], asked)

        return {(path, asked): of(scene, path, asked) for path, asked in self.keys}

    def check(self, scene, tolerance=1e-5):
        """Check agreement to the tolerance wherever finite differences are accurate enough; return the number of compared
        derivatives."""
        near = self.near(scene)
        value = np.asarray(self.value(scene, near, jnp.zeros(6)))
        if not np.all(np.isfinite(value)):
            return None
        found = {name: np.asarray(route(scene, near)) for name, route in self.routes.items()}
        central = np.empty((len(value), 6, len(_DIFFERENCE_STEPS)))
        for k, step in enumerate(_DIFFERENCE_STEPS):
            for i in range(6):
                high, low = (np.asarray(self.value(scene, near, sign * step * np.eye(6)[i])) for sign in (1.0, -1.0))
                central[:, i, k] = (high - low) / (2.0 * step)
        judged = 0
        for q, rows in enumerate(central):
            difference, noise, _ = (np.asarray(x) for x in zip(*(_extrapolate(row, value[q]) for row in rows), strict=True))
            scale = np.maximum(_scale(difference), 1e-3 * abs(value[q]))
            for name, slopes in found.items():
                off, allowed = (
                    np.abs(slopes[q] - difference),
                    tolerance * scale + _NOISE_FACTOR * np.nan_to_num(noise, nan=np.inf),
                )
                # A peak of a run-up changes its course within the larger steps: a difference that noisy says nothing.
                tells = noise < 1e-2 * scale
                assert np.all(off[tells] <= allowed[tells]), (name, self.quantities[q].words, slopes[q], difference, noise)
                np.testing.assert_allclose(slopes[q], next(iter(found.values()))[q], atol=tolerance * scale.max())
            judged += int(np.sum(_NOISE_FACTOR * noise < tolerance * scale))
        return judged


def test_routes_agree_on_a_machine():
    judged = Routes([FORCE, fold_margin(mode=3), phase(mode=3)], whole=False).check(machine(1))
    assert judged is not None and judged >= 16  # of 18


@pytest.mark.slow
@pytest.mark.parametrize(("quantities", "least"), [(LEADING, 0.95), (ROBUST, 0.95), (EXACT, 0.9), (TIME, 0.8)])
def test_every_route_agrees_on_ten_random_machines(quantities, least, monkeypatch):
    """Agreement to 1e-5 wherever finite differences are accurate enough; runs are noisy and have forward derivatives only. Runs
    are to a tolerance at which what they compute has the derivatives of what they integrate: to 1e-8 the two differ by up to
    6e-5 after 60 periods."""
    monkeypatch.setattr(evaluation, "simulate", functools.partial(jv.simulate, stepsize_controller=jv.Tolerance(1e-12)))
    routes = Routes(quantities, ("forward",) if quantities is TIME else ("forward", "reverse"))
    machines = seed = judged = 0
    while machines < 10:
        found = routes.check(machine(seed))
        seed += 1
        if found is not None:
            machines, judged = machines + 1, judged + found
    assert judged >= least * 60 * len(quantities)
