"""Quantities of the response to unbalances: dense scans, closed forms, derivatives, design files, bad input."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from optimize import (
    fold_distance,
    load_design,
    response_amplitude,
    response_force,
    response_stroke,
    response_torque,
    response_transmissibility,
)
from optimize.quantities import response
from optimize.quantities.evaluation import Evaluation

RANGE = ("100 rpm", "1400 rpm")


@pytest.fixture(scope="module")
def table():
    machine = jv.two_mass(
        mass=(120.0, 95.0), stiffness=(5e5, 4e5), damping=(900.0, 700.0), link_stiffness=2e5, link_damping=300.0
    )
    motor = jv.DCMotor("1500 rpm", stall_torque=40.0, inertia=0.1)
    return jv.Scene(machine, exciters=[jv.Exciter(drive=motor, unbalance=0.1)])


def by_hand(scene, w):
    """Amplitude of platform 1, force, transmissibility and torque of two masses at speeds (n,)."""
    m, unbalance = scene.machine, float(scene.exciter.unbalance)
    k1, k2, link = *np.asarray(m.stiffness), float(m.link_stiffness[0])
    c1, c2, drag = *np.asarray(m.damping), float(m.link_damping[0])
    out = []
    for each in w:
        s = 1j * each
        d = np.diag([k1 + s * c1, k2 + s * c2]) + (link + s * drag) * np.array([[1, -1], [-1, 1]])
        d = d - each**2 * np.diag(np.asarray(m.mass))
        f = unbalance * each**2 * np.array([0.0, -1j]) if m.exciter == 2 else unbalance * each**2 * np.array([-1j, 0.0])
        y = np.linalg.solve(d, f)
        force = abs((k1 + s * c1) * y[0] + (k2 + s * c2) * y[1])
        lost = c1 * abs(y[0]) ** 2 + c2 * abs(y[1]) ** 2 + drag * abs(y[0] - y[1]) ** 2
        out.append([abs(y[0]), force, force / (unbalance * each**2), each * lost / 2.0])
    return np.array(out)


def test_values_at_a_speed_and_the_largest_are_those_of_a_scan(table):
    dense = by_hand(table, np.linspace(100.0, 1400.0, 20001) * np.pi / 30.0)
    at = by_hand(table, [900.0 * np.pi / 30.0])[0]
    for kind, column in ((response_amplitude, 0), (response_force, 1), (response_transmissibility, 2), (response_torque, 3)):
        np.testing.assert_allclose(kind(speed="900 rpm")(table), at[column], rtol=1e-9)
        np.testing.assert_allclose(kind(between=RANGE)(table), dense[:, column].max(), rtol=1e-5)
    np.testing.assert_allclose(response_stroke(between=RANGE)(table), 2.0 * dense[:, 0].max(), rtol=1e-5)
    working = jv.response(table).operating
    last = int(np.flatnonzero(np.asarray(working.exists))[-1])
    np.testing.assert_allclose(response_force()(table), working.foundation_force[last], rtol=1e-6)


@pytest.mark.parametrize(
    ("width", "top"),
    [*((10.0, top) for top in (1.0, 2.0, 3.3, 5.0, 5.02, 7.7, 9.0, 10.0)), *((0.01, top) for top in (1.0, 5.0, 5.02, 10.0))],
)
def test_speed_of_the_largest_value_lies_in_its_range(width, top):
    """Peaks anywhere from 2 to 9 for a resonance at 5; a narrow one lies near the resonance or beyond the range."""

    def value(w):
        return 1.0 / (1.0 + ((w - top) / width) ** 2)

    found = float(response._speed_of_largest(value, jnp.asarray(2.0), jnp.asarray(5.0), jnp.asarray(9.0)))
    np.testing.assert_allclose(found, np.clip(top, 2.0, 9.0), atol=1e-6)


@pytest.mark.parametrize(
    ("working", "folds", "distance"),
    [
        ((120.0, 90.0), (-119.0, 144.0, 80.0), 0.2),
        ((-200.0, 60.0), (-61.0, -144.0, 30.0), 0.5),
        ((120.0, 90.0), (-119.0, -90.0, -80.0), 1.0),
        ((-120.0, -90.0), (119.0, 144.0, 80.0), np.nan),
    ],
)
def test_nearest_fold_counts_from_the_highest_working_speed(table, monkeypatch, working, folds, distance):
    """Speeds with a minus do not exist."""
    found = [
        SimpleNamespace(exists=jnp.asarray(speeds) > 0.0, speed=jnp.abs(jnp.asarray(speeds))) for speeds in (working, folds)
    ]
    monkeypatch.setattr(response, "operation_of", lambda model: found)
    np.testing.assert_allclose(fold_distance().read(Evaluation(table)), distance, rtol=1e-14)


@pytest.mark.slow
def test_distance_is_that_of_the_nearest_fold(table):
    found = jv.response(table)
    speeds = np.asarray(found.folds.speed)[np.asarray(found.folds.exists)]
    working = np.asarray(found.operating.speed)[np.asarray(found.operating.exists)].max()
    np.testing.assert_allclose(fold_distance()(table), np.min(np.abs(speeds / working - 1.0)), rtol=1e-9)


@pytest.mark.slow
def test_derivatives_of_the_response_agree_with_differences(table):
    quantities = [
        response_amplitude(at=2, between=RANGE), response_stroke(speed="900 rpm"), response_force(between=RANGE),
        response_transmissibility(), response_torque(between=RANGE), fold_distance(),
    ]  # fmt: skip
    start = jnp.array([5e5, 900.0, 40.0])

    def values(x):
        changed = eqx.tree_at(
            lambda s: (s.machine.stiffness, s.machine.damping, s.exciters[0].drive.stall_torque),
            table,
            (jnp.stack([x[0], jnp.asarray(4e5)]), jnp.stack([x[1], jnp.asarray(700.0)]), x[2]),
        )
        evaluation = Evaluation(changed)
        return jnp.stack([quantity.read(evaluation) for quantity in quantities])

    forward, reverse = jax.jit(jax.jacfwd(values))(start), jax.jit(jax.jacrev(values))(start)
    np.testing.assert_allclose(forward, reverse, rtol=1e-7, atol=1e-12)
    steps = 1e-5 * start
    batch = np.asarray(jax.jit(jax.vmap(values))(start[None] + jnp.concatenate([jnp.diag(steps), -jnp.diag(steps)])))
    differences = (batch[:3] - batch[3:]).T / 2e-5
    scale = np.max(np.abs(differences), axis=1, keepdims=True)
    np.testing.assert_allclose(np.asarray(forward) * np.asarray(start) / scale, differences / scale, atol=2e-5)


def test_a_design_file_states_demands_on_the_response(table, tmp_path):
    jv.save_scene(table, tmp_path / "table.toml")
    text = 'scene = "table.toml"\n[free]\n"machine.stiffness" = [2e5, 9e5]\n[[demand]]\nquantity = "response_force"\n'
    text += 'between = ["100 rpm", "900 rpm"]\nat_most = "3 kN"\n[objective]\nquantity = "response_stroke"\nat = 2\n'
    (tmp_path / "design.toml").write_text(text)
    design = load_design(tmp_path / "design.toml")
    (demand,) = design.subject_to
    assert demand.words == "largest force under unbalances from 100 to 900 rpm at most 3 kN"
    np.testing.assert_allclose(demand.quantity(table), response_force(between=("100 rpm", "900 rpm"))(table), rtol=1e-12)
    (tmp_path / "design.toml").write_text(text.replace('["100 rpm", "900 rpm"]', '["900 rpm", "100 rpm"]'))
    with pytest.raises(jv.InputError, match="speeds must be positive and ascend"):
        load_design(tmp_path / "design.toml")


def test_points_of_a_body_and_wrong_scenes():
    supports = [jv.support(at=(x, 0.0), stiffness=(3e5, 4e5), damping=(2e3, 3e3)) for x in (-0.6, 0.6)]
    drive = jv.ConstantSpeed(100.0)
    body = jv.Scene(
        jv.plane_body(mass=300.0, inertia=75.0, supports=supports),
        exciters=[jv.Exciter(drive=drive, unbalance=0.4, at=(0.2, 0.1))],
    )
    z = jv.response(body, speeds=[80.0]).displacement[0]
    path = jv.ellipse_of(jnp.array([z[0] - 0.3 * z[2], z[1] + 0.5 * z[2]]), 80.0)
    np.testing.assert_allclose(response_amplitude(at=(0.5, 0.3), speed=80.0)(body), path.semi_major, rtol=1e-9)
    with pytest.raises(
        jv.InputError, match="scene has an ideal drive; folds of the response exist for one exciter with a motor"
    ):
        fold_distance()(body)
    with pytest.raises(jv.InputError, match=r"speed is -80\.0; it must be positive"):
        response_force(speed=-80.0)
    with pytest.raises(jv.InputError, match="at is True"):
        response_amplitude(at=True)
    assert response_amplitude(at=np.int64(1)) == response_amplitude(at=1)
    with pytest.raises(jv.InputError, match="between is given together with speed"):
        response_force(speed=80.0, between=RANGE)
    balls = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0), jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), drive
    )
    with pytest.raises(jv.InputError, match="loads turn at a speed of their own"):
        response_force(speed=80.0)(balls)


def test_words_name_the_point():
    """A table with the strokes of two platforms needs different words for them."""
    assert response_stroke(at=2).words == "stroke (at = 2) under unbalances"
    assert response_amplitude(at=(0.5, 0.1), body=1).words == "amplitude (at = 0.5, 0.1, body = 1) under unbalances"
