"""Numbers that are not known while a program is built and turn out not to be allowed end in a status."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.validation import allowed_unknowns
from jaxvib.results.status import status_names
from jaxvib.steady.jams.phases import phase_jam
from jaxvib.steady.outcome import unknown_is_positive
from optimize import static_deflection, total_mass

BALL = dict(count=1, mass=0.5, radius=0.1, drag=0.5)
ONE = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0), jv.balls(**BALL), jv.ConstantSpeed(60.0))
ROTOR = jv.Scene(
    jv.planar_rotor(mass=37.0, stiffness=1.16e6, damping=843.0),
    jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04),
    jv.ConstantSpeed(460.0),
)

QUESTIONS = {
    "jam_modes": (ONE, jv.jam_modes),
    "jam_orbit": (ONE, lambda scene: jv.jam_orbit(scene, omega=27.0)),
    "phase_jam": (ROTOR, lambda scene: phase_jam(scene, 165.0, jnp.zeros(2))),
    "phase_jams": (ROTOR, lambda scene: jv.phase_jams(scene, near=(jnp.asarray(165.0), jnp.zeros(2)))),
    "whirl": (ROTOR, jv.whirl),
    "critical_speeds": (ROTOR, jv.critical_speeds),
    "mode_shapes": (ONE, jv.mode_shapes),
    "branches": (ONE, lambda scene: jv.branches(scene, points=20)),
    "drag_limits": (ONE, jv.drag_limits),
}

PLACES = {
    "stiffness": lambda scene: scene.machine.stiffness,
    "damping": lambda scene: scene.machine.damping,
    "mass": lambda scene: scene.machine.mass,
    "drag": lambda scene: scene.loads.drag,
    "speed": lambda scene: scene.drive.speed,
}


@pytest.mark.parametrize("question", QUESTIONS)
def test_numbers_that_are_not_allowed_end_in_a_status(question):
    """A program answers for the machine, and says of a negative number, or of one that is not finite, that it is refused."""
    scene, ask = QUESTIONS[question]

    def answer(values):
        return ask(eqx.tree_at(lambda s: [place(s) for place in PLACES.values()], scene, values))

    program = jax.jit(answer)
    values = [place(scene) for place in PLACES.values()]
    good = program(values)
    assert set(np.ravel(status_names(good.status))) <= {"found", "absent", "done", "under_resolved"}
    for k in range(len(values)):
        for wrong in (-values[k], values[k] * jnp.nan):
            found = program([wrong if j == k else value for j, value in enumerate(values)])
            assert set(np.ravel(status_names(found.status))) == {"refused"}, list(PLACES)[k]
            leaves = jax.tree.leaves(found, is_leaf=lambda leaf: isinstance(leaf, jv.Scene))
            numbers = [leaf for leaf in leaves if eqx.is_inexact_array(leaf)]
            assert numbers and all(bool(jnp.all(jnp.isnan(leaf))) for leaf in numbers)


@pytest.mark.parametrize("ask", [jv.natural_frequencies, static_deflection(1), total_mass(), 2.0 * total_mass()])
def test_numbers_without_status_are_nan_if_not_allowed(ask):
    program = jax.jit(lambda k, m: ask(eqx.tree_at(lambda s: (s.machine.stiffness, s.machine.mass), ONE, (k[None], m[None]))))
    np.testing.assert_allclose(program(4e4, 50.0), ask(ONE), rtol=1e-12)
    assert all(bool(jnp.all(jnp.isnan(program(*numbers)))) for numbers in ((-4e4, 50.0), (4e4, -3.0), (np.nan, 50.0)))


def test_each_machine_of_a_batch_is_refused_for_itself():
    """Under `vmap` the others keep their jams and their derivatives."""
    stiffness = jnp.asarray([4e4, -4e4, 5e4])

    def jams(k):
        return jv.jam_modes(eqx.tree_at(lambda s: s.machine.stiffness, ONE, k[None]))

    found, slope = jax.vmap(jams)(stiffness), jax.vmap(jax.grad(lambda k: jams(k).omega[0]))(stiffness)
    assert status_names(found.status)[:, 0].tolist() == ["found", "refused", "found"]
    assert not bool(jnp.any(found.stable[1])) and (slope != 0.0).tolist() == [True, False, True]
    alone = jams(jnp.asarray(5e4))
    np.testing.assert_allclose(found.omega[2], alone.omega, rtol=1e-12)


@pytest.mark.parametrize(("stiffness", "expected"), [(4e4, None), (-4e4, False)])
def test_derivatives_of_known_numbers_are_checked_by_value(stiffness, expected):
    """A derivative without `jit` has a value to be checked, and needs no operations for that."""
    found = []

    def question(k):
        found.append(allowed_unknowns(eqx.tree_at(lambda s: s.machine.stiffness, ONE, k[None])))
        return k

    jax.grad(question)(stiffness)
    assert expected is found[0] if expected is None else bool(found[0]) is expected


@pytest.mark.parametrize(("number", "positive"), [(2.0, True), (0.0, False), (-1.0, False), (np.inf, False), (np.nan, False)])
def test_a_number_known_to_the_program_only_is_judged_in_it(number, positive):
    assert unknown_is_positive(jnp.asarray(number)) is None
    assert bool(jax.jit(unknown_is_positive)(number)) is positive
