"""Programs that are compiled in threads while the question goes on."""

import threading

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib.motion.analysis.separation import _transition
from jaxvib.motion.envelope.envelope import _growth_at_end, _run
from jaxvib.motion.integrate import integrate
from jaxvib.runtime.cache import set_program_folder
from jaxvib.runtime.parallel import in_background
from jaxvib.runtime.programs import cached
from jaxvib.steady.jams.jam import jams_of
from jaxvib.steady.orbits.diagram import _values
from jaxvib.steady.orbits.jam_orbit import _solve_program

TRACES = []


@cached
def slow_square(x):
    TRACES.append(threading.current_thread())
    return x**2


def test_a_call_waits_for_its_prepared_program(tmp_path):
    set_program_folder(tmp_path)
    began = threading.Event()
    assert not slow_square.is_ready(np.ones(3))
    in_background(lambda: (began.set(), slow_square.prepare(jnp.zeros(3))))
    assert began.wait(60.0)
    np.testing.assert_array_equal(slow_square(np.full(3, 2.0)), 4.0)
    assert len(TRACES) == 1 and slow_square.is_ready(np.ones(3))


@pytest.mark.parametrize(
    ("ask", "functions"),
    [
        (lambda s: jv.simulate(s, 1.0, start="jam", mode=3, save="window"), [integrate]),
        (lambda s: jv.settle(s, mode=3), [integrate, _transition]),
        (lambda s: jv.envelope(s, 20.0, start="jam", mode=3, save="window"), [_run, _growth_at_end]),
        (lambda s: jv.jam_orbit(s, mode=3), [_solve_program]),
        (lambda s: jv.branches(s, exact=True, points=20, accuracy=1e-2), [_values]),
    ],
)
def test_prepared_programs_are_those_that_run(ask, functions):
    """A program for other types of arguments would be a second one."""
    for function in (jams_of, *functions):
        function.stored.ready.clear()
    ask(scene("two_mass", "balls", speed=120.0))
    for function in functions:
        with function.stored.lock:  # until a thread that prepares another program has ended
            assert len(function.stored.ready) == 1
