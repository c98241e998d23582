"""Steps of averaged runs that take the blocks of the exciters one by one, against dense matrices, and their cost."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.equations.averaged import averaged_model
from jaxvib.equations.linear import linear_model
from jaxvib.motion.envelope import envelope
from jaxvib.ode.rodas4 import Rodas4
from jaxvib.runtime.operations import count_operations

SPRINGS = [jv.support(at=(x, -0.2), stiffness=(4e5, 7e5), damping=(2e3, 3e3)) for x in (-1.0, 1.1)]
BODY = jv.plane_body(mass=2000.0, inertia=600.0, supports=SPRINGS)
BALLS = jv.balls(count=2, mass=[0.5, 0.7], radius=0.2, drag=1.5)


def dc(k):
    return jv.DCMotor(100.0 + k, stall_torque=60.0 + k, inertia=0.2 + 0.01 * k)


def kloss(k):
    return jv.InductionMotor(100.0 + k, breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.3)


def motors(n, drive=dc):
    at = [(-1.0 + 2.0 * (k + 0.5) / n, 0.1 * (k % 3)) for k in range(n)]
    return [jv.Exciter(drive=drive(k), unbalance=0.3 + 0.01 * k, at=at[k], direction=(1, -1)[k % 2]) for k in range(n)]


def gyroscopic_machine():
    rng = np.random.default_rng(2)
    mass, damping, stiffness = (a @ a.T + 4.0 * np.eye(4) for a in rng.normal(size=(3, 4, 4)))
    skew = rng.normal(size=(4, 4))
    places = [rng.normal(size=(2, 4)) for _ in range(3)]
    return jv.from_matrices(100.0 * mass, 50.0 * damping, 1e5 * stiffness, 20.0 * (skew - skew.T), places=places)


IDEAL = [jv.Exciter(drive=jv.SpinUp(90.0, 2.0), unbalance=0.2, at=(0.3, 0.4), direction=-1)]
LOADED = [jv.Exciter(BALLS, jv.SpinUp(80.0 + k, 2.0), at=(0.1 * k, 0.4), direction=(1, -1)[k % 2]) for k in range(9)]
OFF = [jv.Exciter(drive=jv.SwitchedOff(dc(0), at=1.0, bearing=1e-3), unbalance=0.2, at=(0.4, -0.3))]
AT_PLACES = [jv.Exciter(drive=dc(k), unbalance=0.3, at=k + 1, direction=way) for k, way in enumerate((1, 1, -1))]
SCENES = {
    "two motors": jv.Scene(BODY, exciters=motors(2)),
    "motors of two kinds": jv.Scene(BODY, exciters=[x for pair in zip(motors(9), motors(9, kloss), strict=True) for x in pair]),
    "loads and prescribed speeds": jv.Scene(BODY, exciters=[*IDEAL, *LOADED, *OFF, *motors(2)]),
    "gyroscopic": jv.Scene(gyroscopic_machine(), exciters=AT_PLACES),
}


def parts_of(scene):
    """The field on the integrator's vector, and the solution x of (shift - J) x = r by blocks."""
    model = linear_model(scene)
    field, units, t = averaged_model(model), envelope._units(model), jnp.asarray(0.7)
    nd, count = field.stiffness.shape[0], field.unbalance.size

    def flow(y):
        return units.pack(field(t, units.unpack(y, nd)))

    def solve(y, shift, right):
        return units.pack(field.shifted_inverse(t, units.unpack(y, nd), shift)(units.unpack(right, nd)))

    y, right = np.random.default_rng(0).normal(size=(2, 4 * nd + 2 * count))
    y[4 * nd : 4 * nd + count] = 0.6 + 0.1 * y[4 * nd : 4 * nd + count]
    return flow, jax.jit(solve), jnp.asarray(y), jnp.asarray(right)


@pytest.mark.parametrize("name", SCENES)
def test_blocks_solve_the_dense_equations(name):
    flow, solve, y, right = parts_of(SCENES[name])
    slopes = np.asarray(jax.jit(jax.jacfwd(flow))(y))
    for shift in (3e4, 300.0, 20.0):
        expected = np.linalg.solve(shift * np.eye(y.size) - slopes, right)
        np.testing.assert_allclose(solve(y, jnp.asarray(shift), right), expected, atol=1e-12 * np.max(np.abs(expected)))


@pytest.mark.parametrize("name", ["motors of two kinds", "loads and prescribed speeds"])
def test_steps_by_blocks_are_those_of_dense_matrices(name):
    control = diffrax.ConstantStepSize()
    found, dense = (
        jv.envelope(SCENES[name], 0.05, stepsize_controller=control, solver=solver, save="window", throw=False)
        for solver in (None, Rodas4())
    )
    assert int(found.steps) == int(dense.steps) > 10
    np.testing.assert_allclose(found.window.load_speed, dense.window.load_speed, rtol=1e-11)
    np.testing.assert_allclose(
        found.window.displacement, dense.window.displacement, atol=1e-11 * float(jnp.max(dense.amplitude))
    )


def test_reverse_derivatives_outside_jit_equal_differences():
    scene = jv.Scene(BODY, exciters=motors(2))

    def speed(torque):
        changed = eqx.tree_at(lambda s: s.exciters[1].drive.stall_torque, scene, torque)
        run = jv.envelope(changed, 0.5, save="window", stepsize_controller=jv.Tolerance(1e-8), throw=False)
        return run.load_speed[1]

    torque, step = jnp.asarray(61.0), 0.01
    difference = (speed(torque + step) - speed(torque - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.grad(speed)(torque), difference, rtol=1e-5)


def test_cost_of_a_step_is_linear_in_the_exciters():
    """Operations of the program, which set the time of a first call, and arithmetic operations of a step."""

    def cost(count):
        model = linear_model(jv.Scene(BODY, exciters=motors(count)))
        field, units = averaged_model(model), envelope._units(model)
        y = jnp.ones(12 + 2 * count)
        rates, args, method = envelope._equations(y, (field, units), 3, None)

        def step(y):
            return method.step(diffrax.ODETerm(rates), 0.0, 1e-3, y, args, None, False)[0]

        return count_operations(step, y), jax.jit(step).lower(y).cost_analysis()["flops"]

    program, arithmetic = zip(*map(cost, (8, 16, 32, 64)), strict=True)
    assert len(set(program[1:])) == 1
    np.testing.assert_allclose(np.diff(arithmetic)[1:] / np.diff(arithmetic)[:-1], 2.0, rtol=0.1)
    assert arithmetic[-1] < 8.0 * arithmetic[0]
