"""Ensembles: many runs in batches, their errors and their seconds."""

import dataclasses
import logging

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, some_state

import jaxvib as jv
from jaxvib.motion.analysis.scaled_error import error_scale, natural_units, scaled_error
from jaxvib.motion.ensemble import Ensemble
from jaxvib.motion.integration.stiffness import fastest_motion
from jaxvib.motion.plan import _build_scenes
from jaxvib.runtime import cache


def test_an_ensemble_is_a_loop_of_runs():
    s = published(speed=3.0, eps=0.05).scene()
    start, speeds = some_state(s), jnp.linspace(2.0, 4.0, 7)

    def make(n):
        return eqx.tree_at(lambda x: x.drive.speed, s, n), start

    many = jv.ensemble(make, speeds, 20.0, stepsize_controller=jv.EqualSteps(4000), batch=3)
    for k in (0, 3, 6):
        run = jv.simulate(
            make(speeds[k])[0], 20.0, start=start, stepsize_controller=jv.Tolerance(1e-12), save="window", estimate=False
        )
        last = jax.tree.map(lambda x: x[-1], run.window.state)
        for a, b in zip(jax.tree.leaves(many.state), jax.tree.leaves(last), strict=True):
            np.testing.assert_allclose(a[k], b, atol=float(many.error[k]) * 100.0 + 1e-9)
    assert float(many.error.max()) < 1e-6 and many.load_speed.shape == (7, 1)


def make(value):
    """The run that nearly all tests are about: a rotor speed, how far platforms are displaced, how much goes round at all."""
    scene = published(eps=0.05).scene()
    scene = eqx.tree_at(lambda s: (s.drive.speed, s.loads.drag), scene, (value["speed"], value["moving"] * scene.loads.drag))
    displacement = value["displaced"] * jnp.array([-1.0, 1.0])
    return scene, jv.State(displacement, jnp.zeros(2), (jnp.zeros(1),), (value["moving"][None],))


def values(speed=(2.0, 2.5, 3.0), displaced=(1.0, 0.9, 1.1), moving=(1.0, 0.9, 0.8)):
    """No number that is shared: so all tests have one program."""
    return {"speed": jnp.array(speed), "displaced": jnp.array(displaced), "moving": jnp.array(moving)}


def nth(tree, k):
    return jax.tree.map(lambda x: x[k], tree)


def error_of(given, k, found, exact):
    """Quantity that `Ensemble.error` estimates, for run k."""
    a, b = nth(found.state, k), nth(exact.state, k)
    return float(scaled_error(a, b, error_scale(b, natural_units(make(nth(given, k))[0]))))


def test_another_process_need_not_trace_an_ensemble(tmp_path):
    """This holds even if `make` is defined within the call: the program is that of the scenes it made."""
    cache.set_program_folder(tmp_path)
    try:
        jv.ensemble(lambda value: make(value), values(), 5.0, stepsize_controller=jv.EqualSteps(200))
    finally:
        cache.set_program_folder(None)
    assert list(tmp_path.glob("_run_batch-*.program"))


def test_nonfinite_run_leaves_the_errors_of_the_others():
    whole = jv.ensemble(make, values(), 5.0, stepsize_controller=jv.EqualSteps(200))
    broken = jv.ensemble(make, values(displaced=(1.0, jnp.nan, 1.1)), 5.0, stepsize_controller=jv.EqualSteps(200))
    assert broken.finite.tolist() == [True, False, True]
    np.testing.assert_array_equal(broken.error[::2], whole.error[::2])
    assert 0.0 < float(whole.error.max()) < 1e-2 and np.isnan(broken.error[1])


def test_error_of_a_run_is_independent_of_the_batch():
    """One stands still beside them: nothing is not divided by nothing."""
    quiet = values(displaced=(0.1, 0.0, 1.1), moving=(0.0, 0.0, 0.8))
    loud = values(displaced=(0.1, 0.0, 1e2), moving=(0.0, 0.0, 0.8))
    quietly, beside = (jv.ensemble(make, given, 5.0, stepsize_controller=jv.EqualSteps(24)) for given in (quiet, loud))
    np.testing.assert_array_equal(beside.error[:2], quietly.error[:2])
    assert float(beside.error[1]) == 0.0
    exact = jv.ensemble(make, loud, 5.0, stepsize_controller=jv.EqualSteps(4000), estimate=False)
    for k in (0, 2):
        assert 0.0 < error_of(loud, k, beside, exact) <= float(beside.error[k])


def test_reverse_derivatives_of_an_ensemble_are_refused():
    steps = jv.EqualSteps(64)

    def number(speed):
        many = jv.ensemble(make, values() | {"speed": speed * jnp.arange(2.0, 5.0)}, 1.0, stepsize_controller=steps)
        return jnp.sum(many.state.displacement)

    assert jax.eval_shape(jax.jacfwd(number), 1.0).shape == ()
    with pytest.raises(jv.InputError, match=r"^ensemble supports forward derivatives only; use jax.jacfwd or jax.jvp"):
        jax.eval_shape(jax.grad(number), 1.0)


def test_loads_that_start_fast_have_short_steps():
    scene = published(speed=3.0, eps=0.05).scene()
    still = jv.State(jnp.zeros(2), jnp.zeros(2), (jnp.zeros(1),), (jnp.zeros(1),))
    rates = jnp.asarray([0.0, 150.0])
    many = jv.ensemble(lambda rate: (scene, eqx.tree_at(lambda s: s.rate, still, (rate[None],))), rates, 2.0)
    assert float(many.error.max()) < 1e-6
    run = jv.simulate(scene, 2.0, start=eqx.tree_at(lambda s: s.rate, still, (rates[1:],)), save="window")
    np.testing.assert_allclose(many.state.rate[0][1], run.window.state.rate[0][-1], rtol=1e-6)


def test_number_of_steps_is_a_multiple_of_the_parts():
    found = {n: jv.ensemble(make, values(), 5.0, stepsize_controller=jv.EqualSteps(n)) for n in (86, 88, 44, 12, 8)}
    assert {n: int(many.steps) for n, many in found.items()} == {86: 88, 88: 88, 44: 44, 12: 12, 8: 8}
    # Beside 12 steps there are 8, not half as many.
    for fine, coarse in ((88, 44), (12, 8)):
        apart = error_of(values(), 0, found[coarse], found[fine])
        np.testing.assert_allclose(found[fine].error[0], apart * (coarse / fine) ** 3, rtol=1e-6)


def test_a_run_is_not_compared_with_itself():
    few = jv.ensemble(make, values(), 0.5, stepsize_controller=jv.EqualSteps(3))
    assert int(few.steps) == 4 and np.all(np.isinf(few.error)) and np.all(few.finite)
    assert np.all(np.isnan(jv.ensemble(make, values(), 0.5, stepsize_controller=jv.EqualSteps(3), estimate=False).error))


def test_runs_that_are_all_the_same():
    same = jv.ensemble(make, values((2.0,) * 3, (1.0,) * 3, (1.0,) * 3), 5.0, stepsize_controller=jv.EqualSteps(100))
    first = jv.ensemble(make, values(), 5.0, stepsize_controller=jv.EqualSteps(100))
    np.testing.assert_allclose(same.state.angle[0], np.tile(first.state.angle[0][0], (3, 1)), rtol=1e-10)


@pytest.mark.parametrize("place", [0, 1, 2])
def test_one_number_alone_may_differ(place):
    """Whichever it is of the first ones that a run is made of; the others are shared by all."""
    given, structure = jax.tree.flatten(make({name: value[0] for name, value in values().items()}))

    def other(share):
        leaves = list(given)
        leaves[place] = leaves[place] * share
        return jax.tree.unflatten(structure, leaves)

    run = lambda shares: jv.ensemble(other, jnp.asarray(shares), 5.0, stepsize_controller=jv.EqualSteps(100), estimate=False)  # noqa: E731
    both = run([1.0, 1.3]).state.angle[0]
    assert abs(float(both[0, 0] - both[1, 0])) > 1e-6
    for k, share in enumerate((1.0, 1.3)):
        np.testing.assert_allclose(both[k], run([share]).state.angle[0][0], rtol=1e-10)


def test_other_values_need_no_new_program(caplog):
    """Neither with the number of steps that is chosen for them."""

    def compiled(first, last, **given):
        caplog.clear()
        with jax.log_compiles(), caplog.at_level(logging.WARNING):
            jv.ensemble(
                make, values(jnp.linspace(first, last, 4), *np.random.default_rng(0).uniform(0.5, 1.0, (2, 4))), 5.0, **given
            )
        return [record.getMessage() for record in caplog.records if "Compiling" in record.getMessage()]

    assert compiled(2.0, 3.0)
    assert compiled(2.1, 4.0) == []
    assert compiled(2.2, 3.5, stepsize_controller=jv.EqualSteps(64)) == []


def test_seconds_measure_the_whole_call(monkeypatch):
    """The clock is read first and last."""
    calls, ticks = [], iter(range(10, 100))
    monkeypatch.setattr("jaxvib.motion.plan._build_scenes", lambda *asked: calls.append(clock()) or _build_scenes(*asked))

    def clock():
        return float(next(ticks))

    monkeypatch.setattr("jaxvib.motion.ensemble.time.perf_counter", clock)
    found = jv.ensemble(make, values(), 5.0, stepsize_controller=jv.EqualSteps(64))
    assert calls == [11.0] and float(found.seconds) == 2.0


def test_single_precision_keeps_its_phase():
    """A load that turns with its rotor for 5000 turns; each step would round an angle of 3e4 rad by 1e-3."""

    def off(many):
        return np.abs(np.angle(np.exp(1j * (np.asarray(many.state.angle[0][:, 0], float) - reference))))

    def freely(n):
        scene = eqx.tree_at(lambda s: s.drive.speed, free(), n)
        return scene, jv.State(jnp.zeros(1), jnp.zeros(1), (jnp.zeros(1),), (n[None],))

    def free():
        machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0)
        return jv.Scene(machine, jv.pendulums(count=1, mass=1e-6, radius=0.1, drag=1e-4), jv.ConstantSpeed(100.0))

    speeds, end = [90.0, 100.0], 314.15926
    double = jv.ensemble(freely, jnp.array(speeds), end)
    with jax.enable_x64(False):
        single = jv.ensemble(freely, jnp.array(speeds), end)
        assert single.state.angle[0].dtype == jnp.float32 and int(single.steps) > 100_000
        runs = [
            jv.simulate(scene, end, start=start, save="window", estimate=False)
            for scene, start in (freely(jnp.asarray(n)) for n in speeds)
        ]
        ends = [np.asarray(run.window.state.angle[0][-1, 0], float) for run in runs]
        last = float(jnp.asarray(end))
    # Time itself is rounded to single precision: so far the load has turned by then.
    reference = np.asarray(double.state.angle[0][:, 0]) + np.array(speeds) * (last - end)
    simulated = np.abs(np.angle(np.exp(1j * (np.array(ends) - reference))))
    assert np.all(off(single) < 2e-3) and np.all(off(single) < 10.0 * np.maximum(simulated, 1e-4))
    assert np.all(np.abs(single.state.angle[0]) <= 3.15)
    np.testing.assert_allclose(single.load_speed[:, 0], speeds, rtol=1e-5)
    np.testing.assert_allclose(single.load_speed, double.load_speed, rtol=1e-5)
    assert np.all(single.error < 1e-3)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (dict(values=jnp.zeros(())), "values has leading axes"),
        (dict(values=(jnp.zeros(2), jnp.zeros(3))), "values has leading axes"),
        (dict(batch=0), "batch is 0"),
        (dict(stepsize_controller=jv.EqualSteps(0)), "steps is 0"),
        (dict(make=lambda v: v), "make returns"),
        (dict(make=int), "make needs the value of a number that JAX traces"),
        (dict(make=lambda: None), "make cannot be called with"),
        (dict(equations=int), "equations cannot be called with"),
        (dict(equations=lambda _: None), "equations returns None"),
        (dict(values=iter([1.0, 2.0])), "values is"),
        (dict(make=lambda v: (published().scene(), v)), "make returns"),
        (dict(make=lambda v: (v, some_state(published().scene()))), "make returns"),
    ],
)
def test_ensembles_that_cannot_be(change, says):
    s = published().scene()
    given = {"make": lambda n: eqx.tree_at(lambda x: x.drive.speed, s, n), "values": jnp.ones(2), "until": 1.0, **change}
    with pytest.raises(jv.InputError) as caught:
        jv.ensemble(**given)
    assert says in str(caught.value)


@pytest.mark.parametrize("cpu", [True, False])
def test_default_batch_follows_from_the_device(monkeypatch, cpu):
    monkeypatch.setattr("jaxvib.motion.batch.is_cpu", lambda: cpu)
    seen = []
    monkeypatch.setattr("jaxvib.motion.ensemble.plan_ensemble", lambda *_, batch, **__: seen.append(batch) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        jv.ensemble(make, values(), 5.0)
    assert seen == [64 if cpu else 2**18]


@pytest.mark.parametrize(("batch", "together"), [(2, 2), (64, 3)])
def test_batches_have_the_given_size(monkeypatch, batch, together):
    """At most the number of runs, so that nothing is computed for runs that do not exist."""
    seen = []

    def in_chunks(size, *_, **__):
        seen.append(size)
        raise InterruptedError

    monkeypatch.setattr("jaxvib.motion.ensemble.in_chunks", in_chunks)
    with pytest.raises(InterruptedError):
        jv.ensemble(make, values(), 5.0, stepsize_controller=jv.EqualSteps(8), batch=batch)
    assert seen == [together]


def test_runs_are_grouped_by_the_speed_of_their_masses():
    speeds = np.array([[27.0, 26.9], [60.0, 60.0], [0.0, 0.1], [26.8, 27.2], [27.0, 60.0], [np.nan, np.nan], [-60.0, 60.0]])
    finite, none = np.all(np.isfinite(speeds), axis=1), np.zeros(7)
    flags = {"allowed": np.ones(7, bool), "finite": finite, "resolved": np.ones(7, bool), "detached": np.zeros((7, 2), bool)}
    runs = Ensemble(
        state=jv.State(np.zeros((7, 1)), np.zeros((7, 1))),
        load_speed=speeds,
        relative_rotation=none,
        error=none,
        steps=np.asarray(8),
        seconds=np.asarray(1.0),
        **flags,
    )
    assert runs.speed_group.tolist() == [2, 3, 1, 2, 0, 0, 3]
    assert runs.summary().splitlines()[2:] == [
        "  1 of 7 runs: all masses turn at 0.47746 rpm",
        "  2 of 7 runs: all masses turn at 257.35 .. 257.83 rpm",
        "  2 of 7 runs: all masses turn at 572.96 rpm",
        "  1 of 7 runs: masses turn at different speeds",
    ]
    equal = dataclasses.replace(runs, load_speed=np.full((7, 2), 60.0), finite=np.ones(7, bool))
    assert equal.speed_group.tolist() == [1] * 7 and "of 7 runs:" not in equal.summary()
    lost = dataclasses.replace(runs, finite=np.zeros(7, bool))
    assert lost.speed_group.tolist() == [0] * 7


def test_equal_steps_resolve_the_contact_with_a_stop():
    def make(stiffness):
        machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
        exciter = jv.Exciter(drive=jv.SpinUp(60.0, duration=0.5), unbalance=0.08)
        return jv.Scene(machine, exciters=[exciter], effects=[jv.Stop(stiffness, gap=2e-3, damping=200.0)])

    np.testing.assert_allclose(fastest_motion(make(1e7)), np.sqrt(60.0**2 + 1e7 / 50.0), rtol=1e-12)
    many = jv.ensemble(make, jnp.asarray([1e6, 1e7]), 1.5)
    assert float(jnp.max(many.error)) < 0.05  # 1.7 with steps for the rotor and the support alone
    one = jv.simulate(make(1e7), 1.5, save="window", estimate=False)
    np.testing.assert_allclose(many.state.displacement[1], one.window.state.displacement[-1], atol=1e-5)


def damped_stop(damping):
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    exciter = jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.1)
    return jv.Scene(machine, exciters=[exciter], effects=[jv.Stop(1e6, gap=2e-3, damping=damping)])


def test_equal_steps_resolve_the_damper_of_a_stop():
    """Steps of its spring alone give a displacement that is 1.6 times too large for 1e5 N s/m, NaN for 1e6."""
    np.testing.assert_allclose(fastest_motion(damped_stop(1e5)), 4.0 * 1e5 / 50.0, rtol=1e-12)
    many = jv.ensemble(damped_stop, jnp.asarray([1e5, 1e6]), 1.0)
    assert bool(jnp.all(many.resolved)) and float(jnp.max(many.error)) < 5e-3
    for damping, end in zip((1e5, 1e6), many.state.displacement, strict=True):
        one = jv.simulate(damped_stop(damping), 1.0, stepsize_controller=jv.Tolerance(1e-10), save="window", estimate=False)
        np.testing.assert_allclose(end, one.window.state.displacement[-1], atol=5e-6)


def test_steps_too_long_for_a_stop_are_named():
    """The damper of 1e5 N s/m makes the displacement grow to 1e187 m, which is finite."""
    many = jv.ensemble(damped_stop, jnp.asarray([0.0, 1e5, 1e6]), 1.0, stepsize_controller=jv.EqualSteps(400))
    assert many.resolved.tolist() == many.finite.tolist() == [True, False, False]
    assert "steps are too long for contacts" in many.summary() and "(2 of 3)" in many.summary()


def test_equal_steps_resolve_the_damper_of_colliding_loads():
    """Steps of its spring alone turn the loads by 19,000 rad."""
    machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=300.0)
    loads = jv.balls(count=2, mass=0.5, radius=0.1, drag=0.5, ball_radius=0.02)
    still = jnp.zeros(1)
    start = jv.State(still, still, (jnp.asarray([0.0, 1.0]),), (jnp.asarray([60.0, 10.0]),))

    def make(damping):
        return jv.Scene(machine, loads, jv.ConstantSpeed(60.0), [jv.LoadContact(1e5, damping=damping)]), start

    many = jv.ensemble(make, jnp.asarray([1e4]), 0.3)
    one = jv.simulate(make(1e4)[0], 0.3, start=start, stepsize_controller=jv.Tolerance(1e-10), save="window", estimate=False)
    np.testing.assert_allclose(many.state.angle[0][0], one.window.state.angle[0][-1], atol=0.01)


def test_tables_name_coordinates_and_masses(tmp_path):
    supports = [jv.support(at=(x, 0.0), stiffness=(1e5, 1e5), damping=(50.0, 50.0)) for x in (-0.5, 0.5)]
    machine, drive = jv.plane_body(mass=100.0, inertia=5.0, supports=supports), jv.ConstantSpeed(60.0)
    with_balls = jv.Exciter(jv.balls(count=2, mass=0.5, radius=0.1, drag=0.5), drive, at=(0.0, 0.1))
    scene = jv.Scene(machine, exciters=[with_balls, jv.Exciter(drive=drive, unbalance=0.05)])
    change = lambda n: eqx.tree_at(lambda s: s.exciters[0].drive.speed, scene, n)  # noqa: E731
    runs = jv.ensemble(change, jnp.array([50.0, 60.0]), 0.01, stepsize_controller=jv.EqualSteps(4), estimate=False)
    heads = set(jv.load(runs.save(tmp_path / "runs")).to_pandas())
    assert {"displacement x (m)", "velocity psi (rad/s)", "load_speed 1.2 (rad/s)", "load_speed 2 (rad/s)"} < heads
    assert {"detached 1.1", "phase 2 (rad)", "exciters_1_angle 1 (rad)"} < heads
    data = runs.to_xarray()
    assert data.unit.values.tolist() == ["m", "m", "rad"]
    for axis in ("load", "mass"):
        assert data[axis].values.tolist() == ["1.1", "1.2", "2"]
    regimes = runs.regimes.to_xarray()
    assert regimes.mass.values.tolist() == ["1.1", "1.2", "2"]
