"""The engine: the written-out step, single numbers, sines, ensembles, estimates of error, single precision."""

import subprocess
import sys

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scenes import loads, machines, published, scene

import jaxvib as jv
from jaxvib.motion.integrate import integrate
from jaxvib.motion.system import PackedSystem
from jaxvib.ode.dopri8 import UnrolledDopri8
from jaxvib.ode.dopri8_loop import LoopDopri8
from jaxvib.ode.scalarize import Unwritten, on_numbers, program_on_numbers
from jaxvib.ode.sincos import sine_and_cosine


def some_state(s):
    n, nd = s.loads.count, s.machine.carrier().mass.shape[0]
    rng = np.random.default_rng(0)
    draw = [jnp.asarray(rng.normal(size=k)) for k in (nd, nd, n, n)]
    return jv.State(draw[0], draw[1], (draw[2],), (30.0 + draw[3],))


# Sines


@pytest.mark.parametrize(("dtype", "far", "error"), [(jnp.float64, 1e5, 2.3e-16), (jnp.float32, 1e3, 1.2e-7)])
def test_sines_are_numpys(dtype, far, error):
    rng = np.random.default_rng(0)
    x = jnp.asarray(np.concatenate([np.linspace(-20.0, 20.0, 10_001), rng.uniform(-far, far, 10_000)]), dtype)
    s, c = sine_and_cosine(x)
    assert s.dtype == dtype
    exact = np.asarray(x, np.longdouble)
    for ours, theirs in ((s, np.sin(exact)), (c, np.cos(exact))):
        assert np.max(np.abs(np.asarray(ours, np.longdouble) - theirs)) <= error


def test_sines_have_exact_derivatives_of_any_order():
    x = jnp.asarray(1.3)
    assert float(jax.grad(lambda x: sine_and_cosine(x)[0])(x)) == float(sine_and_cosine(x)[1])
    np.testing.assert_allclose(jax.grad(jax.grad(lambda x: sine_and_cosine(x)[1]))(x), -np.cos(1.3), rtol=1e-15)


# Single numbers


@pytest.mark.parametrize("machine", ["one_mass", "two_mass", "three_mass"])
@pytest.mark.parametrize("load", sorted(loads()))
@pytest.mark.parametrize("effects", [(), (jv.Gravity(),)])
def test_on_numbers_the_equations_are_the_same(machine, load, effects):
    s = jv.Scene(machines()[machine], loads()[load], jv.ConstantSpeed(120.0), effects)
    state, field = some_state(s), jv.vector_field(s)
    motion = PackedSystem(field, state)
    assert motion.is_scalarized
    rates = motion.term.vf(jnp.asarray(0.3), motion.pack(state), motion.args)
    ours = motion.unpack(jax.tree.map(lambda x: x[None], rates))
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(field(jnp.asarray(0.3), state)), strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-12, atol=1e-12 * np.max(np.abs(b)))


def test_complex_numbers_are_written_in_their_parts():
    """Every operation on complex numbers that has a rule, with real ones among them; a factor i costs no multiplication."""

    def linear_combination(x, w):
        real, imag = x
        z = real + 1j * imag
        chosen = jnp.where(x[0] > 0.0, z * w, jnp.conj(z))
        return jnp.stack([z * jnp.conj(w) / x[1] - x[0], w / z + 2.0, -(z**2) + z**3, jnp.square(w) * chosen, 1j - jnp.exp(z)])

    x, w = jnp.asarray([0.7, -1.3]), jnp.asarray(0.4 - 0.9j)
    cells = [np.array([*x], dtype=object), np.full((), w, dtype=object)]
    np.testing.assert_allclose(
        [complex(v) for v in on_numbers(linear_combination, x, w)(*cells)], linear_combination(x, w), rtol=1e-14
    )

    turned = program_on_numbers(lambda a, b: (1j * (a + 1j * b)).real, x[0], x[1])
    assert turned is not None and [e.primitive.name for e in turned.jaxpr.eqns] == ["neg"]


def test_an_operation_without_a_rule_is_named():
    with pytest.raises(Unwritten, match="cumsum"):
        on_numbers(jnp.cumsum, jnp.zeros(3))


def test_a_term_that_is_not_there_is_not_computed():
    """A product with a known 0 leaves no operation; a sine asked for twice is computed once."""

    def with_zero(x):
        return jnp.zeros(2) * jnp.sin(x) + jnp.ones(2) * x

    written = on_numbers(with_zero, jnp.zeros(2))
    cells = np.empty(2, dtype=object)

    def run(a, b):
        cells[0], cells[1] = a, b
        return tuple(written(cells))

    operations = [e.primitive.name for e in jax.make_jaxpr(run)(1.0, 2.0).eqns]
    assert operations.count("mul") == 0 and operations.count("add") == 0


# The step


@pytest.mark.parametrize("method", [UnrolledDopri8(), UnrolledDopri8(lanes=True), LoopDopri8()])
def test_the_step_is_diffraxs(method):
    """Same method, another form: the same steps to rounding, dense output included."""
    s = published(speed=3.0, eps=0.05).scene()
    field, start = jv.vector_field(s), some_state(s)

    def solve(solver):
        term = diffrax.ODETerm(lambda t, y, args: args(t, y))
        control = diffrax.PIDController(rtol=1e-8, atol=1e-8)
        save = diffrax.SaveAt(ts=jnp.linspace(0.0, 5.0, 37))
        return diffrax.diffeqsolve(term, solver, 0.0, 5.0, 0.01, start, field, saveat=save, stepsize_controller=control)

    ours, theirs = solve(method), solve(diffrax.Dopri8())
    assert int(ours.stats["num_steps"]) == int(theirs.stats["num_steps"])
    for a, b in zip(jax.tree.leaves(ours.ys), jax.tree.leaves(theirs.ys), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_equal_steps_are_of_order_8():
    s = published(speed=1.5, eps=0.05).scene()
    start = jv.initial_state(s, "jam", mode=3)
    ends = [ravel_pytree(jax.tree.map(lambda x: x[-1], run.window.state))[0] for run in _runs(s, start, (60, 90, 135, 600))]
    error = [float(jnp.max(jnp.abs(end - ends[-1]))) for end in ends[:-1]]
    orders = np.log(np.array(error[:-1]) / np.array(error[1:])) / np.log(1.5)
    assert np.all(orders > 7.0), (error, orders)


def _runs(s, start, steps):
    return [jv.simulate(s, 40.0, start=start, steps=n, save="window", estimate=False) for n in steps]


# Error and cost


def test_the_estimate_is_above_the_error_and_near_it():
    s = published(speed=5.0, eps=0.05).scene()
    start = some_state(s)
    best = jv.simulate(s, 60.0, start=start, tolerance=1e-13, save="window").window.state

    def apart(run):
        a, b = run.window.state, best
        pairs = ((a.displacement, b.displacement), (a.velocity, b.velocity))
        parts = [float(jnp.max(jnp.abs(x - y)) / jnp.max(jnp.abs(y))) for x, y in pairs]
        return max(
            *parts, float(jnp.max(jnp.abs(a.angle[0] - b.angle[0]))), float(jnp.max(jnp.abs(a.rate[0] - b.rate[0]))) / 5.0
        )

    for tolerance in (1e-5, 1e-7, 1e-9, 1e-11):
        run = jv.simulate(s, 60.0, start=start, tolerance=tolerance, save="window")
        assert apart(run) <= float(run.error) <= 300.0 * apart(run), (tolerance, apart(run), float(run.error))
        alone = jv.simulate(s, 60.0, start=start, tolerance=tolerance, save="window", estimate=False)
        assert int(alone.evaluations) == 13 * int(alone.steps) == 13 * int(run.steps) and np.isnan(alone.error)
        # What the estimate cost is counted: the run with larger steps takes at least half as many, at most all.
        assert 1.5 * int(alone.evaluations) < int(run.evaluations) < 2 * int(alone.evaluations)
        assert float(run.seconds) > 0.0
    for accuracy in (1e-3, 1e-8):
        run = jv.simulate(s, 60.0, start=start, accuracy=accuracy, save="window")
        assert bool(run.status == jv.RunStatus.done) and apart(run) <= float(run.error) <= accuracy


def test_an_accuracy_that_is_not_reached_is_said(monkeypatch):
    s = published(speed=5.0, eps=0.05).scene()
    monkeypatch.setattr("jaxvib.motion.simulate._ATTEMPTS", 2)
    asked = dict(start=some_state(s), save="window", accuracy=1e-12)
    # So long that rounding alone makes more than this error.
    run = jv.simulate(s, 400.0, **asked, throw=False)
    assert bool(run.status == jv.RunStatus.not_accurate) and float(run.error) > 1e-12
    with pytest.raises(jv.ComputationError, match=r"asked for 1\.0e-12") as caught:
        jv.simulate(s, 400.0, **asked)
    assert caught.value.status == "not_accurate"


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (dict(accuracy=1e-4, tolerance=1e-6), "accuracy is given together with tolerance; give one of them"),
        (dict(accuracy=1e-14), "accuracy is 1e-14; in float64 it must be at least 2e-13"),
        (dict(steps=0), "steps is 0"),
    ],
)
def test_ways_to_choose_steps_that_cannot_be(given, says):
    with pytest.raises(jv.InputError) as caught:
        jv.simulate(published().scene(), 1.0, **given)
    assert says in str(caught.value)


def test_accuracy_looks_at_numbers():
    s = published().scene()
    with pytest.raises(jv.InputError, match="under a JAX transformation give a tolerance"):
        jax.jit(lambda n: jv.simulate(eqx.tree_at(lambda x: x.drive.speed, s, n), 1.0, accuracy=1e-4).omega)(jnp.asarray(2.0))


def test_a_scan_of_parameters_is_one_compilation():
    s, start = published(speed=3.0, eps=0.05).scene(), None
    before = integrate.jitted._cached._cache_size()
    for n in (2.0, 2.5, 3.0):
        moved = eqx.tree_at(lambda x: x.drive.speed, s, jnp.asarray(n))
        start = some_state(moved) if start is None else start
        for tolerance in (1e-6, 1e-8):
            jv.simulate(moved, 7.0, start=start, tolerance=tolerance, save="window", max_steps=2**14)
    assert integrate.jitted._cached._cache_size() - before <= 1


# Ensembles


def test_an_ensemble_is_a_loop_of_runs():
    s = published(speed=3.0, eps=0.05).scene()
    start, speeds = some_state(s), jnp.linspace(2.0, 4.0, 7)

    def make(n):
        return eqx.tree_at(lambda x: x.drive.speed, s, n), start

    many = jv.ensemble(make, speeds, 20.0, steps=4000, lanes=3)
    for k in (0, 3, 6):
        run = jv.simulate(make(speeds[k])[0], 20.0, start=start, tolerance=1e-12, save="window", estimate=False)
        last = jax.tree.map(lambda x: x[-1], run.window.state)
        for a, b in zip(jax.tree.leaves(many.state), jax.tree.leaves(last), strict=True):
            np.testing.assert_allclose(a[k], b, atol=float(many.error[k]) * 100.0 + 1e-9)
    assert float(many.error.max()) < 1e-6 and many.load_speed.shape == (7, 1)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(values=jnp.zeros(())), "values has leading axes"),
        (dict(values=(jnp.zeros(2), jnp.zeros(3))), "values has leading axes"),
        (dict(lanes=0), "lanes is 0"),
        (dict(steps=0), "steps is 0"),
        (dict(make=lambda v: v), "make gives"),
    ],
)
def test_ensembles_that_cannot_be(change, says):
    s = published().scene()
    given = {"make": lambda n: eqx.tree_at(lambda x: x.drive.speed, s, n), "values": jnp.ones(2), "until": 1.0, **change}
    with pytest.raises(jv.InputError) as caught:
        jv.ensemble(**given)
    assert says in str(caught.value)


# Single precision and the backend


def test_single_precision_keeps_its_phase():
    """A load that turns with its rotor for 1e5 turns: an angle of 6e5 rad would be good to 0.06 only, and each step would round
    it anew; so the only error is that of the time itself."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
    with jax.enable_x64(False):
        free = jv.Scene(machine32(machine), jv.pendulums(count=1, mass=1e-6, radius=0.1, drag=1e-4), jv.ConstantSpeed(100.0))
        start = eqx.tree_at(lambda y: (y.angle, y.rate), jv.initial_state(free), ((jnp.zeros(1),), (jnp.full(1, 100.0),)))
        run = jv.simulate(free, 6283.185, start=start, save="window", tolerance=1e-5, estimate=False)
        phase = np.asarray(run.window.state.angle[0][:, 0], float) - 100.0 * np.asarray(run.window.time, float)
        assert run.amplitude.dtype == jnp.float32
        # A mean speed is an angle over a time between two samples, each of whose times is rounded by up to a spacing.
        times = np.asarray(run.window.time)
        bound = 2.0 * float(np.spacing(times[-1])) / float(times[-1] - times[0])
        np.testing.assert_allclose(float(run.omega), 100.0, rtol=bound)
    assert np.max(np.abs((phase + np.pi) % (2.0 * np.pi) - np.pi)) < 100.0 * float(np.spacing(times[-1]))


def machine32(machine):
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float32), machine)


def test_wrapping_counts_every_turn():
    s = scene("one_mass", "balls")
    state = eqx.tree_at(lambda y: y.angle, some_state(s), (jnp.asarray([7.0, -20.0, 1.0]),))
    for together in (False, True):
        motion = PackedSystem(jv.vector_field(s), state, wrapped=True, together=together)
        method = motion.method()
        assert isinstance(method, (LoopDopri8, UnrolledDopri8)) and method.wrap is not None
        held = method.wrap(motion.pack(state))
        if not together:
            assert float(jnp.max(jnp.abs(motion._angles(held[0])[0]))) <= np.pi
        back = motion.unpack(jax.tree.map(lambda *x: jnp.stack(x), motion.pack(state), held))
        np.testing.assert_allclose(back.angle[0], np.stack(2 * [state.angle[0]]), rtol=1e-14)
        alone = motion.unpack(jax.tree.map(lambda x: x[None], held))
        np.testing.assert_allclose(np.sin(alone.angle[0][0]), np.sin(state.angle[0]), atol=1e-13)


def test_prepare_cpu_sets_flags_before_anything_else_and_says_when_it_is_late():
    code = """
import os, jaxvib as jv
os.environ["XLA_FLAGS"] = "--xla_cpu_prefer_vector_width=256"
flags = jv.prepare_cpu(3)
assert "loop_byte_threshold=1000000000" in flags and flags.count("vector_width") == 1 and flags == jv.prepare_cpu(3)
import jax
assert len(jax.devices()) == 3
jax.numpy.zeros(1)
try:
    jv.prepare_cpu()
except jv.InputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert "prepare_cpu comes too late" in done.stdout
    with pytest.raises(jv.InputError, match="devices is 0"):
        jv.prepare_cpu(0)
