"""Sweeps: their numbers against single answers, what they survive, what they refuse."""

import errno

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zarr
from scenes import published, scene

import jaxvib as jv
from jaxvib.motion import batch
from jaxvib.sweeps import program
from jaxvib.sweeps import sweep as sweep_module
from jaxvib.sweeps.definition import _round_up
from jaxvib.sweeps.study import study
from jaxvib.sweeps.sweep import run_study
from optimize import Quantity, jam_frequency

SCENE = scene("one_mass", "balls", speed=60.0)
AXES = {"drive.speed": {"from": 10.0, "to": 90.0, "count": 9}, "loads.drag": [0.5, 1.5, 3.0, 5.0, 8.0]}


def power(scene):
    return scene.loads.drag * scene.drive.speed**2


def beyond(scene):
    """There is none below 40 rad/s."""
    return jnp.sin(jnp.sqrt(scene.drive.speed - 40.0)) * scene.loads.drag


MEASURE = [Quantity("power", "N m/s", power), Quantity("beyond", "", beyond)]
STUDY = study(SCENE, AXES, MEASURE, chunk=10)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run_study(STUDY, tmp_path_factory.mktemp("stores") / "whole.zarr")


def files(store):
    """Every file of a store by its name, but its metadata and their digests: they tell whether a part was replaced."""
    left_out = ("zarr.json", "layout")
    return {p.relative_to(store): p.read_bytes() for p in store.rglob("*") if p.is_file() and p.name not in left_out}


def same(one, other):
    first, second = one.data, other.data
    return all(first[name].values.tobytes() == second[name].values.tobytes() for name in first if name != "error")


def test_every_case_has_the_numbers_of_its_scene(whole):
    data = whole.data
    speed, drag = data["drive.speed"].values[:, None], data["loads.drag"].values
    assert data.power.dims == ("drive.speed", "loads.drag") and data.power.attrs["units"] == "N m/s"
    np.testing.assert_allclose(data.power.values, drag * speed**2, rtol=1e-15)
    with np.errstate(invalid="ignore"):
        expected = np.sin(np.sqrt(speed - 40.0)) * drag
    np.testing.assert_allclose(data.beyond.values, expected, rtol=1e-14)
    words, missing = data.status.attrs["flag_meanings"].split(), np.isnan(expected)
    np.testing.assert_array_equal(data.status.values, np.where(missing, words.index("absent"), words.index("done")))
    assert dict(whole.counts) == {"absent": 15, "done": 30}


@pytest.mark.parametrize(("chunk", "together", "size"), [(None, 15808, 15808), (200, 256, 256), (300_000, 2**18, 2**19)])
def test_batches_on_accelerators_are_multiples_of_ensembles(monkeypatch, chunk, together, size):
    """The CPU stands in for the accelerator. The identity of a study does not depend on the device."""

    def asked():
        return study(SCENE, {"drive.speed": {"from": 10.0, "to": 90.0}}, MEASURE, samples=300_000, chunk=chunk)

    on_cpu = asked()
    assert on_cpu.batch == 64 and on_cpu.size % 64 == 0
    monkeypatch.setattr(batch, "is_cpu", lambda: False)
    assert (asked().batch, asked().size, asked().key) == (together, size, on_cpu.key)


def test_one_batch_for_a_chunk_gives_the_same_numbers(monkeypatch, tmp_path):
    asked = study(SCENE, AXES, MEASURE, chunk=200)
    small = run_study(asked, tmp_path / "small.zarr")
    monkeypatch.setattr(batch, "_ACCELERATOR_BATCH_SIZE", 256)
    monkeypatch.setattr(batch, "is_cpu", lambda: False)
    large = run_study(asked, tmp_path / "large.zarr")
    for name in ("power", "beyond"):
        np.testing.assert_allclose(large.data[name], small.data[name], rtol=1e-14)


@pytest.mark.slow
def test_quantities_of_jams_agree_with_single_jams(tmp_path):
    """The program is that of the example in the docstring of `sweep`."""
    light = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        jv.balls(count=2, mass=0.25, radius=0.1, drag=0.25),
        jv.ConstantSpeed("60 rad/s"),
    )
    axes = {"drive.speed": [20.0, 27.0, 60.0], "loads.drag": [0.1, 0.4]}
    data = jv.sweep(light, axes, [jam_frequency(mode=1)], tmp_path / "jams.zarr").data
    for i, speed in enumerate(axes["drive.speed"]):
        for j, drag in enumerate(axes["loads.drag"]):
            one = eqx.tree_at(lambda s: (s.drive.speed, s.loads.drag), light, (jnp.asarray(speed), jnp.asarray(drag)))
            np.testing.assert_allclose(data.jam_frequency[i, j], jv.jam_modes(one).select(1, throw=False).omega, rtol=1e-10)


def test_the_store_records_its_study(whole):
    told = zarr.open_group(whole.store, mode="r").attrs
    assert jv.scene_from_toml(told["study"]["scene"]).loads.count == 3 and told["versions"]["jax"] == jax.__version__
    assert told["study"]["seed"] == 0 and told["study"]["precision"] == "float64"
    assert "done" in whole.summary() and whole.status_name == "done" and float(whole.scene.drive.speed) == 60.0


def test_neither_chunks_nor_neighbours_change_a_number(whole, tmp_path):
    larger = jv.sweep(SCENE, AXES, MEASURE, tmp_path / "a.zarr", chunk=1000)
    turned = {name: list(reversed(found)) for name, found in (("loads.drag", AXES["loads.drag"]),)} | {
        "drive.speed": whole.data["drive.speed"].values.tolist()[2:7]
    }
    other = jv.sweep(SCENE, turned, MEASURE, tmp_path / "b.zarr", chunk=10)
    assert same(whole, larger)
    back = other.data.sortby("loads.drag").transpose("drive.speed", "loads.drag")
    part = whole.data.isel({"drive.speed": slice(2, 7)})
    for name in ("power", "beyond"):
        assert back[name].values.tobytes() == part[name].values.tobytes()


def test_a_resumed_sweep_gives_the_same_store(whole, tmp_path, monkeypatch):
    store, computed = tmp_path / "study.zarr", []
    real = program.compute
    monkeypatch.setattr(sweep_module, "compute", lambda *a: computed.append(a[1]) or real(*a))

    def stop(now):
        raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run_study(STUDY, store, report=stop)
    assert jv.open_sweep(store).status_name == "incomplete" and "run the study again" in jv.open_sweep(store).message
    progress = []
    found = run_study(STUDY, store, report=progress.append)
    assert found.computed == 25 and progress[-1].done == progress[-1].cases == 45 and progress[-1].left == 0.0
    assert run_study(STUDY, store).computed == 0
    assert sorted(set(computed)) == list(range(5)) and files(store) == files(tmp_path / whole.store)


def test_finished_chunks_remain_after_a_full_disk(whole, tmp_path, monkeypatch):
    """The write that fails is that of the statuses, after the numbers: the chunk is not finished."""
    store, real = tmp_path / "study.zarr", zarr.Array.__setitem__

    def full(array, where, value):
        if array.name == "/status" and jv.open_sweep(store).counts[0].cases < 30:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(array, where, value)

    with monkeypatch.context() as patched:
        patched.setattr(zarr.Array, "__setitem__", full)
        with pytest.raises(jv.InputError, match=r"cannot be written \(No space left on device\); make room or name another"):
            run_study(STUDY, store)
    kept = jv.open_sweep(store)
    assert kept.status_name == "incomplete" and kept.counts[0].cases == 25
    assert run_study(STUDY, store).computed == 25 and files(store) == files(tmp_path / whole.store)


def test_what_cannot_be_a_folder(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(jv.InputError, match="cannot be written"):
        run_study(STUDY, "/proc/study.zarr")
    with pytest.raises(jv.InputError, match=r"cannot be written \(File name too long\)"):
        run_study(STUDY, tmp_path / ("a" * 400))
    with pytest.raises(jv.InputError, match="not the store of a sweep"):
        run_study(STUDY, tmp_path / "file")


def test_a_store_of_another_study_is_refused(whole):
    for other, what in (
        (study(SCENE, AXES, MEASURE, chunk=5), "tile"),
        (study(SCENE, AXES, MEASURE[:1], chunk=10), "measure"),
        (study(SCENE, AXES | {"loads.drag": [0.5, 1.0, 3.0, 5.0, 8.0]}, MEASURE, chunk=10), "axes"),
        (study(eqx.tree_at(lambda s: s.machine.mass, SCENE, SCENE.machine.mass + 1.0), AXES, MEASURE, chunk=10), "scene"),
    ):
        with pytest.raises(jv.InputError, match=f"contains another study: its {what} differs"):
            run_study(other, whole.store)


def poisoned(scene):
    def plain(speed):
        if speed == 30.0 or speed == 70.0:
            raise ValueError(f"no answer at {float(speed):g} rad/s")
        return np.asarray(2.0 * speed)

    speed = scene.drive.speed
    return jax.pure_callback(plain, jax.ShapeDtypeStruct((), speed.dtype), speed, vmap_method="sequential")


@pytest.mark.filterwarnings("ignore")
def test_failing_case_is_recorded_and_harms_no_other(tmp_path):
    found = jv.sweep(SCENE, {"drive.speed": AXES["drive.speed"]}, [Quantity("twice", "rad/s", poisoned)], tmp_path / "s.zarr")
    data = found.data
    assert dict(found.counts) == {"done": 7, "failed": 2} and found.status_name == "done"
    errors = data.error.values.tolist()
    assert "no answer at 30 rad/s" in errors[2] and "no answer at 70 rad/s" in errors[6] and set(errors[:2]) == {""}
    np.testing.assert_array_equal(data.twice.values[[0, 1, 3]], [20.0, 40.0, 80.0])
    assert np.isnan(data.twice.values[2])


def product(scene):
    return scene.loads.drag * scene.drive.speed


def test_samples_are_stored_with_their_values(tmp_path):
    axes = {"drive.speed": [40.0, 60.0], "loads.drag": {"from": 1.0, "to": 2.0}}
    found = jv.sweep(SCENE, axes, [Quantity("product", "N", product)], tmp_path / "s.zarr", samples=50, chunk=16, seed=5)
    data = found.data
    assert data["product"].dims == ("drive.speed", "sample") and "loads.drag" in data.coords
    np.testing.assert_array_equal(data["product"].values, data["drive.speed"].values[:, None] * data["loads.drag"].values)
    again = jv.sweep(SCENE, axes, [Quantity("product", "N", product)], tmp_path / "t.zarr", samples=20, chunk=7, seed=5)
    np.testing.assert_array_equal(again.data["loads.drag"].values, data["loads.drag"].values[:20])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Captures of the published machine: its torus of mode 1 lies at n = 0.42, the fold below mode 5 at 1.39."""
    axes = {"drive.speed": [0.35, 0.9, 2.0, 2.9], "start.rate": [0.0, 0.6, 1.6]}
    measure = ["run.regime", "run.mode", "run.load_speed", "run.amplitude", "run.settling_time"]
    return jv.sweep(
        published(eps=0.05).scene(), axes, measure, tmp_path_factory.mktemp("runs") / "runs.zarr", until=400.0, chunk=12
    )


def test_runs_come_to_the_jams_that_are_there(runs):
    data = runs.data
    assert data["mode"].values.tolist() == [[1, 1, 1], [3, 3, 3], [3, 3, 5], [5, 5, 5]]
    assert data.regime.attrs["flag_meanings"].split()[1] == "jammed" and np.all(data.regime.values == 1)
    assert data.amplitude.dims == ("drive.speed", "start.rate", "coordinate")
    # where the run settles it is on the leading order's jam, but for the load's mass
    modes = jv.jam_modes(published(speed=0.9, eps=0.05).scene())
    np.testing.assert_allclose(data.load_speed.values[1], float(modes.select(3).omega), rtol=2e-3)
    assert np.all((data.settling_time.values > 0.0) & (data.settling_time.values < 400.0))
    # a load that starts far from where it ends takes longer
    assert data.settling_time.values[3, 2] < data.settling_time.values[3, 0]


def test_runs_do_not_depend_on_other_runs_of_a_batch(runs):
    """Bit for bit: the same program, to which the numbers come in another order and beside others."""
    given, measure = runs.data, ["run.regime", "run.mode", "run.load_speed", "run.amplitude", "run.settling_time"]
    axes = {name: given[name].values.tolist() for name in ("drive.speed", "start.rate")}
    asked = study(runs.scene, axes, measure, until=400.0, chunk=12)
    values = np.asarray([[n, w] for w in axes["start.rate"][::-1] for n in axes["drive.speed"]])
    beside = np.random.default_rng(0).uniform(0.4, 2.0, (asked.size - len(values), 2))
    found, _ = program._measure_cases_compiled(asked.scene, jnp.concatenate([beside, values]), asked.program, *asked.choices)
    for name, leaf in zip(asked.names, found, strict=True):
        for value, one in zip(values, leaf[len(beside) :], strict=True):
            kept = given[name].sel({"drive.speed": value[0], "start.rate": value[1]}).values
            assert np.asarray(one).astype(kept.dtype).tobytes() == kept.tobytes()


@pytest.mark.slow
def test_runs_agree_with_simulate(runs):
    data = runs.data
    for i, j in ((0, 1), (1, 2), (2, 0), (2, 2), (3, 0)):
        one = published(speed=float(data["drive.speed"][i]), eps=0.05).scene()
        start = eqx.tree_at(lambda s: s.rate, jv.initial_state(one), (jnp.full(1, float(data["start.rate"][j])),))
        run = jv.simulate(one, 400.0, start=start, save="window")
        assert int(run.regime.mode) == int(data["mode"][i, j])
        np.testing.assert_allclose(float(run.omega), data.load_speed.values[i, j], rtol=1e-4)


@pytest.mark.parametrize(("count", "unit", "rounded"), [(0, 4, 0), (1, 4, 4), (4, 4, 4), (5, 4, 8), (7, 1, 7)])
def test_counts_are_rounded_up_to_whole_units(count, unit, rounded):
    assert _round_up(count, unit) == rounded
