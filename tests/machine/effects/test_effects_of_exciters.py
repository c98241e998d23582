"""Every effect on scenes with two exciters: each analysis includes it, or names it and another analysis in an error."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import pytest

import jaxvib as jv
from jaxvib.machine.effects.registry import EFFECTS
from jaxvib.machine.files import TEMPLATES
from jaxvib.runtime.programs import CachedFunction

IDEAL, MOTOR = jv.ConstantSpeed(90.0), jv.DCMotor(100.0, stall_torque=50.0, inertia=0.1)
PLATFORMS = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0)
SHAFT = jv.rotor(
    mass=37.0,
    transverse_inertia=0.479,
    polar_inertia=0.093,
    stiffness=(6e5, 5e5),
    damping=400.0,
    position=(0.165, -0.155),
)
PLANAR = jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0)
BALL = jv.balls(count=1, mass=0.05, radius=0.1, drag=0.5, ball_radius=0.01)
BALLS = jv.balls(count=2, mass=0.05, radius=0.1, drag=0.5, ball_radius=0.01)
PENDULUMS = jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04)


def unbalanced(machine, effects=(), own=(), at=(None, None)):
    """Two exciters with unbalances; `effects` of the machine, `own` effects of the first rotor."""
    first = jv.Exciter(drive=MOTOR, unbalance=0.4, effects=own, at=at[0])
    return jv.Scene(machine, exciters=[first, jv.Exciter(drive=MOTOR, unbalance=0.3, at=at[1], direction=-1)], effects=effects)


def loaded(machine, loads, own):
    """An exciter with loads and an effect on them, and one with an unbalance."""
    second = jv.Exciter(drive=IDEAL, unbalance=0.3)
    return jv.Scene(machine, exciters=[jv.Exciter(loads, IDEAL, effects=own), second])


def _torus():
    return jv.scene_from_toml(TEMPLATES["torus"]).loads


SCENES = {
    "gravity": lambda: unbalanced(PLATFORMS, jv.Gravity()),
    "static_imbalance": lambda: unbalanced(PLATFORMS, own=jv.StaticImbalance(0.1)),
    "moment_imbalance": lambda: unbalanced(SHAFT, own=jv.MomentImbalance(1e-3), at=(0.1, -0.1)),
    "dry_friction": lambda: loaded(PLATFORMS, PENDULUMS, jv.DryFriction(0.01, 0.02)),
    "rolling_friction": lambda: loaded(PLATFORMS, BALL, jv.RollingFriction(3e-5)),
    "cubic_support": lambda: unbalanced(PLATFORMS, jv.CubicSupport(1e8, platform=1)),
    "stop": lambda: unbalanced(PLATFORMS, jv.Stop(1e5, gap=1e-3, platform=1)),
    "friction_support": lambda: unbalanced(PLATFORMS, jv.FrictionSupport(50.0, platform=2, to=1)),
    "load_contact": lambda: loaded(PLATFORMS, BALLS, jv.LoadContact(1e5)),
    "free_spin": lambda: loaded(PLANAR, _torus(), jv.FreeSpin()),
    "sliding": lambda: loaded(PLANAR, BALLS, jv.Sliding(0.1)),
}


def _masses(scene):
    return sum(exciter.loads.count if exciter.loads else 1 for exciter in scene.exciters)


class Start(NamedTuple):
    """Start of an exact synchronous motion."""

    speed: jax.Array
    phases: jax.Array


def _regime(scene):
    return Start(jnp.asarray(90.0), jnp.zeros(len(scene.exciters)))


AVERAGED = {"gravity"}
IMBALANCES = {"static_imbalance", "moment_imbalance"}
PERIODIC = {*AVERAGED, *IMBALANCES, "dry_friction", "rolling_friction", "cubic_support", "stop", "friction_support"}
ANALYSES = {
    "synchronous_regimes": (jv.synchronous_regimes, AVERAGED),
    "near": (lambda s: jv.synchronous_regimes(s, near=(90.0, jnp.zeros(_masses(s)))), AVERAGED),
    "masses": (lambda s: jv.synchronous_regimes(s, masses=[0]), AVERAGED),
    "working_regime": (jv.working_regime, AVERAGED),
    "regime_partitions": (jv.regime_partitions, AVERAGED),
    "envelope": (lambda s: jv.envelope(s, 1.0), AVERAGED),
    "run_up": (lambda s: jv.run_up(s, 1.0), AVERAGED),
    "response": (jv.response, AVERAGED | IMBALANCES),
    "synchronous_orbit": (lambda s: jv.synchronous_orbit(s, _regime(s)), PERIODIC),
    "synchronization_limit": (lambda s: jv.synchronization_limit(s, _regime(s), over="exciters[1].unbalance"), PERIODIC),
    "simulate": (lambda s: jv.simulate(s, 1.0), set(EFFECTS)),
    "settle": (jv.settle, set(EFFECTS)),
    "growth": (lambda s: jv.growth(s, 1.0), set(EFFECTS)),
    "ensemble": (lambda s: jv.ensemble(lambda x: s, jnp.ones(2), 1.0), set(EFFECTS)),
}
"""Analyses of scenes with several exciters, with the effects that each includes."""

ONE_EXCITER = {
    "jam_modes": jv.jam_modes,
    "branches": jv.branches,
    "phase_jams": jv.phase_jams,
    "jam_orbit": lambda s: jv.jam_orbit(s, mode=1),
    "balanced_states": jv.balanced_states,
    "criterion": jv.criterion,
    "whirl": lambda s: jv.whirl(s, [9.0]),
    "critical_speeds": jv.critical_speeds,
    "drag_limits": jv.drag_limits,
    "audit": jv.audit,
    "run_up_map": lambda s: jv.run_up_map(s, 1.0),
    "capture": jv.capture,
}


class _Included(Exception):
    """The first compiled function of an analysis is reached: it has accepted its scene."""


@pytest.fixture
def stop_before_computation(monkeypatch):
    original = CachedFunction.__call__

    def call(self, *args, **kwargs):
        if self.__name__ == "_natural_frequencies":  # of `run_up`, which then calls `envelope`
            return original(self, *args, **kwargs)
        raise _Included

    monkeypatch.setattr(CachedFunction, "__call__", call)


def test_every_effect_has_a_scene():
    assert set(SCENES) == set(EFFECTS)
    assert all(kind in {effect.kind for effect in SCENES[kind]().all_effects} for kind in SCENES)


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.usefixtures("stop_before_computation")
def test_effects_are_included_or_refused_by_name(kind):
    scene = SCENES[kind]()
    has_loads = scene.exciters[0].loads is not None
    for name, (ask, included) in ANALYSES.items():
        is_refused_with_loads = has_loads and name in ("working_regime", "run_up", "response")
        if kind in included and not is_refused_with_loads:
            with pytest.raises(_Included):
                ask(scene)
            continue
        with pytest.raises(jv.InputError) as raised:
            ask(scene)
        said = str(raised.value)
        # Loads, whose effect it is, may be refused first.
        assert said.startswith(f"effects.{kind} ") or "loads" in said or "no motor" in said, (name, said)
        assert "use " in said or "or simulate" in said, (name, said)


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.usefixtures("stop_before_computation")
def test_theories_of_one_exciter_name_the_other_analyses(kind):
    scene = SCENES[kind]()
    for ask in ONE_EXCITER.values():
        with pytest.raises(jv.InputError, match=r"has 2 exciters; .* use simulate, settle, envelope, response or synchronous"):
            ask(scene)


def test_moment_imbalance_needs_tilt_without_loads_too():
    """The rotor of an unbalance on a body in a plane cannot tilt: the moment would be ignored."""
    support = jv.support(at=(0.0, -0.2), stiffness=(3e4, 3e4), damping=(150.0, 150.0))
    body = jv.plane_body(mass=300.0, inertia=75.0, supports=[support])
    for machine, at in ((body, ((0.0, 0.3), (0.2, 0.3))), (PLATFORMS, (1, 2))):
        with pytest.raises(jv.InputError, match=r"^exciters\[0\]\.effects\.moment_imbalance needs a rotor that can tilt"):
            unbalanced(machine, own=jv.MomentImbalance(1e-3), at=at)
