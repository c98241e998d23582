"""Cost of the equations of motion over the number of exciters."""

import jax
import pytest

import jaxvib as jv
from jaxvib.runtime.operations import count_operations

SPRINGS = [jv.support(at=(x, -0.2), stiffness=(4e5, 7e5), damping=(2e3, 3e3)) for x in (-1.0, 1.1)]
BODY = jv.plane_body(mass=2000.0, inertia=600.0, supports=SPRINGS)
MOTOR = jv.DCMotor(100.0, stall_torque=300.0, inertia=0.5)


def scene_of(count):
    places = [(-1.0 + 2.0 * k / count, 0.1 * (k % 3)) for k in range(count)]
    exciters = [jv.Exciter(drive=MOTOR, unbalance=1.5, at=at, direction=(1, -1)[k % 2]) for k, at in enumerate(places)]
    return jv.Scene(BODY, exciters=exciters)


def cost(count):
    """Number of operations of the program, which sets the time of a first call, and of arithmetic operations of a call."""
    scene = scene_of(count)
    state = jv.initial_state(scene)

    def field(s):
        return jv.vector_field(scene)(0.0, s)

    return count_operations(field, state), jax.jit(field).lower(state).cost_analysis()["flops"]


@pytest.mark.parametrize("kind", (0, 1))
def test_cost_grows_linearly_with_exciters_up_to_64(kind):
    few, more, most = (cost(count)[kind] for count in (16, 32, 64))
    assert 1.9 < (most - more) / (more - few) < 2.1
    assert most / few < 4.1
