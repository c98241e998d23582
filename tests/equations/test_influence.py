"""Influence coefficients of rotating masses in modal form, against dense algebra in NumPy."""

from typing import Any
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.equations.linear import linear_model
from jaxvib.equations.torque_balance import (
    TorqueBalance,
    assemble_torque_balance,
    influence_of,
    resultant_of,
    unknowns_of,
)
from jaxvib.steady.regimes.local import margin_of
from jaxvib.steady.regimes.search import all_regimes

N, PLACES, WAYS, UNBALANCE = 6, (1, 4, 6), (1, -1, 1), (0.3, 0.4, 0.2)
SPEEDS = np.array([2.0, 9.0, 14.1, 14.15, 30.0, 61.0])


def chain(damping=30.0, links=2e5, link_damping=40.0, count=3):
    """Equal platforms in a row, with two or three exciters."""
    machine = jv.network(
        mass=[100.0] * N,
        stiffness=[2e4] * N,
        damping=[damping] * N,
        links=[(k, k + 1) for k in range(1, N)],
        link_stiffness=[links] * (N - 1),
        link_damping=[link_damping] * (N - 1),
        exciter=1,
    )
    motors = [jv.InductionMotor(speed, breakdown_torque=60.0, breakdown_slip=0.1, inertia=0.05) for speed in (60.0, 60.2, 60.4)]
    parts = zip(PLACES, WAYS, UNBALANCE, motors, strict=True)
    exciters = [jv.Exciter(at=at, direction=w, unbalance=s, drive=m) for at, w, s, m in parts]
    return jv.Scene(machine, exciters=exciters[:count])


def margin_of_matrices(balance, x):
    """`margin_of` without the modal form."""
    with mock.patch.object(TorqueBalance, "decomposed", lambda balance: balance):
        return jax.jit(margin_of)(balance, x)


def dense(scene, omega):
    """Influence coefficients and their derivative by the speed."""
    carrier = jax.tree.map(np.asarray, scene.machine.carrier())
    force = np.zeros((N, 3), complex)
    force[np.asarray(PLACES) - 1, range(3)] = -1j * np.asarray(WAYS)
    inverse = np.linalg.inv(carrier.stiffness - omega**2 * carrier.mass + 1j * omega * carrier.damping)
    change = -2.0 * omega * carrier.mass + 1j * carrier.damping
    return force.conj().T @ inverse @ force, -force.conj().T @ inverse @ change @ inverse @ force


CHAINS = {
    "damped": chain(),
    "without damping": chain(damping=0.0, link_damping=0.0),
    "equal frequencies": chain(links=0.0, link_damping=0.0),
    "equal frequencies, coupled by dampers": chain(links=0.0),
}


@pytest.mark.parametrize("name", CHAINS)
def test_modal_influence_coefficients_are_dense_ones(name):
    balance = assemble_torque_balance(CHAINS[name])
    modal = balance.decomposed()
    assert modal.model.modal is not None and balance.model.modal is None
    one, along = jax.jit(jax.vmap(lambda w: jax.jvp(lambda w: influence_of(modal, w), (w,), (jnp.ones_like(w),))))(SPEEDS)
    matrices = jax.jit(jax.vmap(lambda w: influence_of(balance, w)))(SPEEDS)
    for k, w in enumerate(SPEEDS):
        exact, slope = dense(CHAINS[name], w)
        for found in (one[k], matrices[k]):
            np.testing.assert_allclose(found, exact, atol=1e-10 * np.max(np.abs(exact)), rtol=0.0)
        np.testing.assert_allclose(along[k], slope, atol=1e-9 * np.max(np.abs(slope)), rtol=0.0)


def test_sizes_of_torques_are_those_after_all_changes():
    """A motor that is switched off after 2 s has the friction of its bearings, 0.1 N m s at 60 rad/s; without friction 1."""
    scene = chain()
    off = [jv.SwitchedOff(scene.exciters[0].drive, at=2.0, bearing=bearing) for bearing in (0.1, 0.0)]
    sizes = assemble_torque_balance(eqx.tree_at(lambda s: [each.drive for each in s.exciters[:2]], scene, off)).motor_torque
    np.testing.assert_allclose(sizes[:2], [0.1 * 60.0, 1.0], rtol=1e-12)
    assert 55.0 < float(sizes[2]) <= 60.0


def test_search_and_margin_in_modal_form_are_those_of_matrices():
    """The slope of the margin follows from the matrices, although the search for the fold is in modal form."""
    scene: Any = chain(count=2)
    balance = assemble_torque_balance(scene)
    (speeds, phases), (dense_speeds, dense_phases) = all_regimes(balance.decomposed()), all_regimes(balance)
    assert speeds.size > 1
    np.testing.assert_allclose(speeds, dense_speeds, rtol=1e-10)
    np.testing.assert_allclose(np.exp(1j * phases), np.exp(1j * dense_phases), atol=1e-8)

    x, h = unknowns_of(balance, jnp.asarray(speeds[0]), jnp.asarray(phases[0])), 1e-4

    def margin(scale):
        changed = eqx.tree_at(lambda s: s.machine.stiffness, scene, scale * scene.machine.stiffness)
        return margin_of(assemble_torque_balance(changed), x)

    margins, slopes = jax.jit(jax.vmap(jax.value_and_grad(margin)))(jnp.array([1.0 - h, 1.0, 1.0 + h]))
    np.testing.assert_allclose(margins[1], margin_of_matrices(balance, x), rtol=1e-9)
    np.testing.assert_allclose(slopes[1], (margins[2] - margins[0]) / (2.0 * h), rtol=1e-5)


def test_forces_that_cancel_have_the_resultant_zero():
    """The phase pi is not exact in floating-point numbers: its sine is 1.2e-16."""
    exciters = [jv.Exciter(drive=jv.ConstantSpeed(20.0), unbalance=0.3) for _ in range(2)]
    model = linear_model(jv.Scene(jv.one_mass(mass=100.0, stiffness=2e4, damping=30.0), exciters=exciters))
    opposite, equal = (np.asarray(resultant_of(model, jnp.exp(1j * jnp.array([0.0, a])))) for a in (np.pi, 0.0))
    assert np.all(opposite == 0.0)
    np.testing.assert_allclose(np.max(np.abs(equal)), 0.6, rtol=1e-15)
