"""The torus paper's equations as printed, and its tables of least initial speeds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from papers.machines import published_torus
from papers.printed_torus import TABLES, cosine_torus, gap_torus, printed_torus
from papers.torus_tables import published_tables

from jaxvib.equations.state import State
from jaxvib.study.capture.capture import steps_per_second


@pytest.mark.parametrize(("equations", "lever"), [(printed_torus, 15.0), (gap_torus, 2.5), (cosine_torus, 15.0)])
def test_printed_model_solves_the_printed_equations(equations, lever):
    """Against the printed equations with x'', y'' and the balls' accelerations as unknowns of one linear system."""
    scene = published_torus(2.5)
    e, w = 1e-3, 140.0
    mb = float(scene.loads.mass) / 7.0
    n, p, kb, g, e2, e1, eb = 0.1, 0.01, 4e-5 / 12.5e-3, 0.5005, 200.0, 15.0, 2.5
    rng = np.random.default_rng(0)
    x, v, psi, a, dpsi, da = (rng.normal(size=2) * size for size in (1.0, 1.0, 2.0, 2.0, 0.4, 0.4))
    turn = 0.7

    def residual(unknown):
        ax, ay = unknown[:2]
        total = [ax + n * v[0] + p * x[0] - (1 - 2 * mb) * np.cos(turn), ay + n * v[1] + p * x[1] - (1 - 2 * mb) * np.sin(turn)]
        balls = []
        for i in range(2):
            f, u, ddpsi, dda = turn + psi[i], 1.0 + dpsi[i], unknown[2 + i], unknown[4 + i]
            c, s, ca, sa, arm = np.cos(f), np.sin(f), np.cos(a[i]), np.sin(a[i]), e2 + eb * np.sin(a[i])
            total[0] -= mb * (arm * u**2 * c + 2 * eb * ca * da[i] * u * s + eb * sa * da[i] ** 2 * c)
            total[1] -= mb * (arm * u**2 * s - 2 * eb * ca * da[i] * u * c + eb * sa * da[i] ** 2 * s)
            total[0] -= mb * (arm * s * ddpsi - eb * ca * c * dda)
            total[1] += mb * (arm * c * ddpsi + eb * ca * s * dda)
            pressed = max(g * ca + e2 * u**2 * sa + eb * da[i] ** 2, 0.0)
            slow = arm / e2**2 * (e2 + e1 * sa) * kb * pressed * np.tanh(dpsi[i] / 0.02)
            stop = lever / eb * kb * pressed * np.tanh(eb * da[i] / 0.1)
            wrong = (1 - 2 * mb) * ca * (np.sin(psi[i]) - np.cos(psi[i])) * (equations is not cosine_torus)
            balls.append(1.4 * arm * ddpsi - (ax * s - ay * c - 2 * eb * ca * da[i] * u - slow))
            balls.append(1.4 * eb * dda - (arm * u**2 * ca - g * sa - ca * (ax * c + ay * s) - wrong - stop))
        return np.asarray(total + balls)

    matrix = np.stack([residual(unit) - residual(np.zeros(6)) for unit in np.eye(6)], axis=1)
    expected = np.linalg.solve(matrix, -residual(np.zeros(6)))
    given = ((x * e, v * e * w), ((turn + psi, a), ((1.0 + dpsi) * w, da * w)))
    (place, velocity), (angle, rate) = jax.tree.map(jnp.asarray, given)
    field = equations(scene)(jnp.asarray(turn / w), State(place, velocity, angle, rate))
    np.testing.assert_allclose(field.velocity / (e * w**2), expected[:2], rtol=1e-10)
    np.testing.assert_allclose(field.rate[0] / w**2, expected[2:4], rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(field.rate[1] / w**2, expected[4:], rtol=1e-10)


@pytest.mark.parametrize(
    ("model", "least", "threshold"),
    [("printed", (-0.111, -0.159), (-0.111, -0.155)), ("gap lever", (-0.115, -0.217), (-0.115, -0.211))],
)
def test_tables_agree_with_an_independent_program(model, least, threshold):
    """Two gaps after 60 turns by either lever, against a program in C: RK4 in the rotor's frame, 1420 and 732 steps a turn."""
    row = TABLES[-1]._replace(gap=(0.5, 1.9), speed=(-0.388, -0.565))
    found = published_tables([model], [row], turns=60, starts=1)
    np.testing.assert_allclose(found.least[0], least, atol=0.003)
    np.testing.assert_allclose(found.threshold[0], threshold, atol=0.003)
    assert np.all(found.converged) and np.all(found.last_change <= 0.01) and found.last_change.shape == (1, 2, 2)
    first = [steps_per_second(published_torus(gap), dict(printed=printed_torus).get(model, gap_torus)) for gap in row.gap]
    np.testing.assert_allclose(found.steps_per_turn[0], 2.0 * np.asarray(first) * 2.0 * np.pi / 140.0, rtol=1e-9)
