"""Amplitudes of a run turn by turn, and the steady machine that is fitted to them."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.identification import start
from jaxvib.identification.problem import build_problem
from jaxvib.identification.response import Samples, Unknowns
from jaxvib.identification.start import _steady_amplitudes, amplitudes, fit_amplitudes
from jaxvib.machine.numbers.named import find_number


def test_amplitudes_follow_from_each_turn():
    """300 turns in groups of 3; the second channel has noise, the third one no readings in the first group."""
    step, n = 1e-3, 30001
    angle = -2.0 * np.pi * 300.0 * np.linspace(0.0, 1.0, n) ** 2
    size = np.linspace(1.0, 2.0, n)
    noise = 0.5 * np.random.default_rng(0).normal(size=n)
    readings = np.stack([0.3 + size * np.cos(angle + 0.4), size * np.sin(angle) + noise, np.full(n, 7.0)], axis=1)
    mask = np.ones((n, 3), bool)
    mask[:4000, 2] = False
    mask[::7, 0] = False
    readings[::7, 0] = 1e9
    speeds, sizes, weights = amplitudes(readings, mask, angle, step)
    cuts = np.searchsorted(-angle / (2.0 * np.pi), np.arange(0.0, 300.0, 3.0))
    assert len(speeds) == 99 and sizes.shape == weights.shape == (99, 3)
    for k in (0, 50, 98):
        part = slice(cuts[k], cuts[k + 1])
        assert speeds[k] == pytest.approx((angle[part][0] - angle[part][-1]) / (step * (cuts[k + 1] - cuts[k] - 1)), rel=1e-12)
        basis = np.stack([np.ones_like(angle[part]), np.cos(angle[part]), np.sin(angle[part])], axis=1)
        for c in range(3):
            counts = mask[part, c]
            if not np.any(counts):
                assert sizes[k, c] == weights[k, c] == 0.0
                continue
            found = np.linalg.lstsq(basis[counts], readings[part, c][counts], rcond=None)[0]
            amplitude = np.hypot(found[1], found[2])
            assert sizes[k, c] == pytest.approx(amplitude, rel=1e-9, abs=1e-12)
            rest = np.var(readings[part, c][counts] - basis[counts] @ found) / np.count_nonzero(counts)
            assert weights[k, c] == pytest.approx(amplitude**2 / (amplitude**2 + 10.0 * rest + 1e-300), rel=1e-9, abs=1e-12)
    np.testing.assert_allclose(sizes[:, 0], size[cuts[:-1]], rtol=0.05)


def test_few_turns_are_not_put_together():
    angle = np.linspace(0.0, 2.0 * np.pi * 20.0, 2001)
    speeds, sizes, _ = amplitudes(np.sin(angle)[:, None], np.ones((2001, 1), bool), angle, 0.01)
    assert len(speeds) == 19
    np.testing.assert_allclose(speeds, 2.0 * np.pi, rtol=1e-9)
    np.testing.assert_allclose(sizes, 1.0, rtol=1e-9)
    assert amplitudes(np.zeros((100, 1)), np.ones((100, 1), bool), angle[:100] * 20.0, 0.01)[0].size == 0  # 5 samples a turn


def test_each_turn_begins_at_its_first_sample():
    """An amplitude that grows by 1 from turn to turn of 49.95 samples."""
    turns = np.arange(999) / 49.95
    readings = (1.0 + np.floor(turns)) * np.sin(2.0 * np.pi * turns)
    _, sizes, _ = amplitudes(readings[:, None], np.ones((999, 1), bool), 2.0 * np.pi * turns, 0.01)
    np.testing.assert_allclose(sizes[:, 0], 1.0 + np.arange(19), rtol=1e-9)


CHANNELS = (
    jv.Channel("a", "acceleration", at=(0.3, -0.1), direction=(0.6, 0.8)),
    jv.Channel("v", "velocity", at=(-0.2, 0.1), direction="across"),
    jv.Channel("d", "displacement", direction="down"),
    jv.Channel("f", "force", direction=(0.8, 0.6)),
)


def test_steady_amplitudes_against_complex_stiffness():
    supports = [
        jv.support(at=(-0.5, -0.2), stiffness=(6e4, 9e4), damping=(300.0, 200.0)),
        jv.support(at=(0.6, -0.1), stiffness=(8e4, 7e4), damping=(100.0, 400.0)),
    ]
    machine = jv.plane_body(mass=80.0, inertia=12.0, supports=supports)
    scene = jv.Scene(
        machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(50.0), unbalance=0.05, at=(0.15, 0.25), direction=-1)]
    )
    unknowns = Unknowns(
        (find_number(scene, "machine.mass", "unknown"),), jnp.array([80.0]), jnp.array([80.0]), jnp.array([True]), (), 0
    )
    samples = Samples(
        *[jnp.zeros(())] * 7, amounts=jnp.array([2.0]), channels=CHANNELS,
        changed=(find_number(scene, "machine.inertia", "change"),), actions=("add",), turn=None,
    )  # fmt: skip
    speeds = np.array([20.0, 45.0, 90.0])
    found = _steady_amplitudes(unknowns, samples, scene, jnp.array([0.1]), jnp.asarray(speeds))

    def point(x, y):
        return np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])

    mass = np.diag([80.0 * np.exp(0.1), 80.0 * np.exp(0.1), 14.0])
    ends = [point(-0.5, -0.2), point(0.6, -0.1)]
    springs, dampers = [np.diag([6e4, 9e4]), np.diag([8e4, 7e4])], [np.diag([300.0, 200.0]), np.diag([100.0, 400.0])]
    k, c = (sum(end.T @ each @ end for end, each in zip(ends, kind, strict=True)) for kind in (springs, dampers))
    force, drag = (sum(each @ end for end, each in zip(ends, kind, strict=True)) for kind in (springs, dampers))
    for w, row in zip(speeds, np.asarray(found), strict=True):
        # clockwise: (cos, -sin) = real part of (1, -i) exp(i angle), with its sign of time reversed
        q = np.linalg.solve(k - w**2 * mass + 1j * w * c, w**2 * point(0.15, 0.25).T @ np.array([1.0, 1j]))
        expected = [
            w**2 * np.array([0.6, 0.8]) @ point(0.3, -0.1) @ q,
            w * point(-0.2, 0.1)[0] @ q,
            point(0.15, 0.25)[1] @ q,
            np.array([0.8, 0.6]) @ (force + 1j * w * drag) @ q,
        ]
        np.testing.assert_allclose(row, np.abs(expected), rtol=1e-9)


def test_tracked_orders_agree_with_the_steady_machine():
    """The readings have the steady amplitudes of another stiffness and damping, at speeds up to 60 rad/s."""
    t = np.linspace(0.0, 60.0, 12001)
    steady = t**3 * 0.05 / np.abs(4e4 - 50.0 * t**2 + 200j * t)
    exciter = jv.Exciter(drive=jv.RunUp(60.0, acceleration=1.0), unbalance=0.05)
    scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=5e4, damping=300.0), exciters=[exciter])
    channel = jv.Channel("frame", "velocity", at=1)
    run = jv.MeasuredRun.from_arrays([channel], t, {"frame": steady * np.cos(0.5 * t**2)})
    problem = build_problem(scene, [run], ["machine.stiffness", "machine.damping"], {})
    found = fit_amplitudes(problem)
    np.testing.assert_allclose([5e4 * np.exp(found[0]), 300.0 * np.exp(found[1])], [4e4, 200.0], rtol=0.03)
    assert not np.any(fit_amplitudes(problem._replace(unbalances=(None, None))))
    assert not np.any(fit_amplitudes(problem._replace(masks=(np.arange(12001)[:, None] < 1900,))))  # 9.5 s are 7.2 turns


def test_tracked_values_are_finite_and_near(monkeypatch):
    problem = SimpleNamespace(
        unknowns=SimpleNamespace(count=2, first=np.ones(2)), unbalances=(None,), scene=None,
        runs=[SimpleNamespace(step=0.01)], raw=[np.zeros((2001, 1))], masks=[np.ones((2001, 1), bool)],
        angles=[np.linspace(0.0, 300.0, 2001)[:, None]],
    )  # fmt: skip
    for values, expected in (([5.0, -9.0], [2.0, -2.0]), ([np.nan, 1.0], [0.0, 0.0])):
        monkeypatch.setattr(start, "_fit_amplitudes", lambda *_, values=values: np.array(values))
        assert fit_amplitudes(problem).tolist() == expected
