"""Public functions compute within compiled programs: JAX would compile each operation outside of one by itself."""

import logging
import re

import jax
import jax.numpy as jnp
import pytest
from scenes import scene

import jaxvib as jv


@pytest.fixture(scope="module")
def known():
    s = scene("two_mass", "balls")
    state = jv.initial_state(s, "jam", mode=3)
    return {
        "scene": s,
        "state": state,
        "jams": jv.jam_modes(s),
        "orbit": jv.jam_orbit(s, mode=3),
        "window": jv.simulate(s, 1.0, start=state, save="window").window,
        "states": jv.balanced_states(s),
        "t": jnp.asarray(0.5, dtype=float),
    }


CALLS = {
    "scene": lambda _: scene("three_mass", "pendulums"),
    "natural_frequencies": lambda k: jv.natural_frequencies(k["scene"]),
    "mode_shapes": lambda k: jv.mode_shapes(k["scene"]),
    "energy": lambda k: jv.energy(k["scene"], k["state"], 0.5),
    "power": lambda k: jv.power(k["scene"], k["t"], k["state"]),
    "normal_force": lambda k: jv.normal_force(k["scene"], 0.5, k["state"]),
    "stability": lambda k: k["states"].stability(),
    "regime": lambda k: jv.regime(k["scene"], k["window"]),
    "select": lambda k: k["jams"].select(5),
    "initial_state": lambda k: jv.initial_state(k["scene"], "jam", mode=5),
    "at": lambda k: k["orbit"].at(0.5),
    "relative_amplitude": lambda k: k["orbit"].relative_amplitude(1, 2),
    "force_peaks": lambda k: k["orbit"].force_peaks(),
}


@pytest.mark.parametrize("name", CALLS)
def test_nothing_is_computed_outside_of_a_program(known, name, caplog):
    jax.clear_caches()
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        CALLS[name](known)
    compiled = re.findall(r"Finished XLA compilation of jit\(([^)]*)\)", caplog.text)
    assert all("-" in program for program in compiled), compiled  # those of cached functions have their key in their name


def test_another_number_needs_no_other_program(known, caplog):
    """Another time, mode or angle."""
    jv.energy(known["scene"], known["state"], 0.25)
    known["jams"].select(3), known["orbit"].at(0.25)
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        jv.energy(known["scene"], known["state"], 0.75)
        known["jams"].select(4), known["orbit"].at(0.75)
    assert "Compiling" not in caplog.text and "Finished" not in caplog.text
