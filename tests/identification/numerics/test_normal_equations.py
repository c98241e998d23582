"""Normal equations of a recorded run, against integration by SciPy and against differences."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxvib as jv
from jaxvib.identification.angle import RecordedDrive
from jaxvib.identification.response import (
    Samples,
    Unknowns,
    linear_equations,
    model_readings,
    normal_equations,
    state_count,
)
from jaxvib.machine.numbers.named import find_number

STEP, SEGMENT, COUNT = 1e-3, 64, 128
BEGIN = 0.3
TAPS = np.array([[1.0, 1.0, 1.0, 1.0], [-0.5, 0.3, 0.0, 0.1], [0.2, 0.1, -0.4, 0.0]])
CHANNELS = (
    jv.Channel("a", "acceleration", at=(0.3, -0.1), direction=(0.6, 0.8)),
    jv.Channel("v", "velocity", at=(-0.2, 0.1), direction="across", high_pass=3.0, gain_error=0.02),
    jv.Channel("d", "displacement", direction="down"),
    jv.Channel("f", "force", direction=(0.8, 0.6), high_pass=5.0),
)
X = np.array([0.02, -0.3, 0.1, 0.4, 0.7, -0.5, 0.3])
"""Stiffness, place of a support, gain, zero of the angle, and three errors of the angle, of which the run has the last two."""


def angle(t):
    """Return the angle of the rotor, its two errors, and their first two derivatives: (derivatives, columns, n)."""
    zero = 0.0 * t
    return np.array(
        [
            [0.3 + 40.0 * t + 30.0 * t**2, 0.02 + 0.01 * t**2, 0.03 * t],
            [40.0 + 60.0 * t, 0.02 * t, 0.03 + zero],
            [60.0 + zero, 0.02 + zero, zero],
        ]
    )


@functools.cache
def drive():
    """Return the recorded drive of `angle`, in intervals of 0.1 s from 0.2 s."""
    starts = 0.2 + 0.1 * np.arange(4)
    values = angle(starts)
    table = np.stack([values[p].T / (1.0, 1.0, 2.0)[p] for p in range(3)], axis=1)
    return RecordedDrive(*map(jnp.asarray, (70.0, table, starts)))


@functools.cache
def scene():
    springs = [
        jv.support(at=(-0.5, -0.2), stiffness=(6e4, 9e4), damping=(300.0, 200.0), angle=0.3),
        jv.support(at=(0.6, -0.1), stiffness=(8e4, 7e4), damping=(100.0, 400.0)),
    ]
    machine = jv.plane_body(mass=80.0, inertia=12.0, supports=springs)
    exciter = jv.Exciter(drive=jv.ConstantSpeed(50.0), unbalance=0.05, at=(0.15, 0.25), direction=-1)
    return jv.Scene(machine, exciters=[exciter])


@functools.cache
def problem():
    numbers = tuple(
        find_number(scene(), name, "unknown") for name in ("machine.supports[0].stiffness[1]", "machine.supports[1].at[0]")
    )
    first = jnp.asarray([9e4, 0.6])
    unknowns = Unknowns(numbers, first, jnp.asarray([9e4, 0.5]), jnp.asarray([True, False]), ("v",), turns=1, errors=3)
    rng = np.random.default_rng(0)
    shape = (COUNT // SEGMENT, SEGMENT, len(CHANNELS))
    changes = {
        "machine.mass": ("add", 10.0),
        "machine.inertia": ("scale", 1.1),
        "machine.supports[1].damping[0]": ("set", 150.0),
    }
    samples = Samples(
        drives=(drive(),),
        begin=jnp.asarray(BEGIN),
        end=jnp.asarray(BEGIN + (COUNT - 1) * STEP),
        readings=jnp.asarray(rng.normal(size=shape)),
        weights=jnp.asarray(rng.uniform(0.5, 1.5, size=shape)),
        taps=jnp.asarray(TAPS),
        step=jnp.asarray(STEP),
        amounts=jnp.asarray([amount for _, amount in changes.values()]),
        channels=CHANNELS,
        changed=tuple(find_number(scene(), name, "change") for name in changes),
        actions=tuple(action for action, _ in changes.values()),
        turn=0,
        errors=(5, 2),
    )
    return unknowns, samples


def by_scipy():
    """Return the readings (n, C, linear unknowns without offsets) of unit states and of unit components of the unbalance."""
    mass, inertia = 90.0, 12.0 * 1.1
    turned = X[3]

    def support(x, y, stiffness, damping, tilt=0.0):
        rows = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
        turn = np.array([[np.cos(tilt), np.sin(tilt)], [-np.sin(tilt), np.cos(tilt)]])
        return rows, *(turn.T @ np.diag(each) @ turn @ rows for each in (stiffness, damping))

    supports = (
        support(-0.5, -0.2, (6e4, 9e4 * np.exp(X[0])), (300.0, 200.0), 0.3),
        support(0.6 + 0.5 * X[1], -0.1, (8e4, 7e4), (150.0, 400.0)),
    )
    k, c = (sum(each[0].T @ each[i] for each in supports) for i in (1, 2))
    force_k, force_c = (sum(each[i] for each in supports) for i in (1, 2))
    inverse = np.diag([1.0 / mass, 1.0 / mass, 1.0 / inertia])
    rotor = np.array([[1.0, 0.0, -0.25], [0.0, 1.0, 0.15]])

    def push(t, component):
        columns = angle(t)
        theta, rate, change = columns[:, 0] + np.einsum("dm,m->d", columns[:, 1:], X[5:])
        # The rotor turns clockwise; the zero of its angle and the component b turn the unbalance.
        unit = (rate**2 + 1j * change) * np.exp(-1j * theta) * np.exp(1j * turned) * 1j**component
        return inverse @ rotor.T @ np.array([unit.real, unit.imag])

    def point(x, y):
        return np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])

    high_pass = np.array([0.0, 2.0 * np.pi * 3.0, 0.0, 2.0 * np.pi * 5.0])
    gain = np.array([1.0, np.exp(X[2]), 1.0, 1.0])

    def unfiltered(q, v, a):
        return np.array(
            [
                np.array([0.6, 0.8]) @ point(0.3, -0.1) @ a,
                point(-0.2, 0.1)[0] @ v,
                -rotor[1] @ q,
                np.array([0.8, 0.6]) @ (force_k @ q + force_c @ v),
            ]
        )

    fixed = np.sqrt(np.max(np.diagonal(k) / np.diagonal(np.linalg.inv(inverse))))
    times = BEGIN + STEP * np.arange(COUNT)

    def case(start, component):
        def parts(t, y):
            q, v = y[:3], y[3:6]
            a = -inverse @ (k @ q + c @ v) + (0.0 if component is None else push(t, component))
            slow = np.array([0.0, y[6], 0.0, y[7]])
            return v, a, unfiltered(q, v, a) - slow

        def rates(t, y):
            v, a, found = parts(t, y)
            return np.concatenate([v, a, (high_pass * found)[[1, 3]]])

        run = solve_ivp(rates, (times[0], times[-1]), start, "DOP853", t_eval=times, rtol=1e-12, atol=1e-14)
        return np.array([parts(t, y)[2] for t, y in zip(times, run.y.T, strict=True)])

    starts = np.diag([1.0 / fixed] * 3 + [1.0] * 5)
    found = [case(start, None) for start in starts] + [case(np.zeros(8), component) for component in (0, 1)]
    return gain[:, None] * np.stack(found, axis=2)


def filtered(values):
    """Return columns (n, C, k) after the filter; all samples before the first are 0."""
    late = [np.concatenate([np.zeros((j, *values.shape[1:])), values[: len(values) - j]]) for j in range(len(TAPS))]
    return sum(taps[None, :, None] * each for taps, each in zip(TAPS, late, strict=True))


@functools.cache
def columns():
    """Return the columns (n, C, linear unknowns) of all linear unknowns after the filter."""
    offsets = np.broadcast_to(np.diag(np.sum(TAPS, axis=0)), (COUNT, 4, 4))
    return np.concatenate([filtered(by_scipy()), offsets], axis=2)


def weighted(z):
    _, samples = problem()
    z = z * np.asarray(samples.weights).reshape(COUNT, -1, 1)
    return z.reshape(-1, z.shape[2])


def close(found, z, atol):
    size = np.linalg.norm(z, axis=0)
    np.testing.assert_allclose(found / np.outer(size, size), (z.T @ z) / np.outer(size, size), rtol=0.0, atol=atol)


def test_linear_equations_against_scipy():
    unknowns, samples = problem()
    readings = np.asarray(samples.readings).reshape(COUNT, -1, 1)
    found = linear_equations(unknowns, samples, scene(), jnp.asarray(X))
    close(np.asarray(found), weighted(np.concatenate([columns(), readings], axis=2)), 1e-9)
    assert state_count(scene(), CHANNELS) == 8 and unknowns.count == X.size


LINEAR = np.array([1e-2, -2e-2, 3e-2, 0.1, 0.2, -0.3, 0.01, 5.0, 0.04, -0.03, 0.2, 0.01, -1e-3, 3.0])
"""Displacements times the fixed frequency, velocities, high-pass filters, components of the unbalance, offsets."""


def readings_at(x):
    """Return the readings (n, C) of the model from the same displacements at all unknowns; its fixed frequency follows `x`."""
    unknowns, samples = problem()

    def fixed(x):
        carrier = samples.scene(unknowns.scene(scene(), jnp.asarray(x))).machine.carrier()
        return float(jnp.sqrt(jnp.max(jnp.diagonal(carrier.stiffness) / jnp.diagonal(carrier.mass))))

    linear = np.concatenate([LINEAR[:3] * fixed(x) / fixed(X), LINEAR[3:]])
    return np.asarray(model_readings(unknowns, samples, scene(), jnp.asarray(x), jnp.asarray(linear)))


def test_model_readings_against_scipy():
    raw = np.einsum("ncl,l->nc", by_scipy(), LINEAR[:10]) + LINEAR[10:]
    np.testing.assert_allclose(readings_at(X), raw, rtol=1e-8, atol=1e-8)


def test_normal_equations_against_differences():
    unknowns, samples = problem()
    step, weights = 1e-3, {2.0: -1.0 / 12.0, 1.0: 2.0 / 3.0, -1.0: -2.0 / 3.0, -2.0: 1.0 / 12.0}
    slopes = [sum(w * readings_at(X + k * step * each) for k, w in weights.items()) / step for each in np.eye(X.size)]
    left = np.asarray(samples.readings).reshape(COUNT, -1) - columns() @ LINEAR
    z = weighted(np.concatenate([filtered(np.stack(slopes, axis=2)), columns(), left[:, :, None]], axis=2))
    found = np.asarray(normal_equations(unknowns, samples, scene(), jnp.asarray(X), jnp.asarray(LINEAR)))
    assert not np.any(found[4]) and not np.any(found[:, 4])  # the error of the angle of another run
    others = np.delete(np.arange(found.shape[0]), 4)
    close(found[np.ix_(others, others)], z[:, others], 1e-7)


def test_errors_of_the_angle_of_another_run_have_no_effect():
    unknowns, samples = problem()
    alone = dataclasses.replace(samples, errors=(0, 0))
    found = np.asarray(normal_equations(unknowns, alone, scene(), jnp.asarray(X), jnp.asarray(LINEAR)))
    assert not np.any(found[4:7]) and not np.any(found[:, 4:7]) and np.all(np.diagonal(found)[:4] > 0.0)
