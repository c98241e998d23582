"""Machines from matrices: equal to the machines that have them, reduced to modes, whirl of a shaft of finite elements."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import rates_at

import jaxvib as jv
from jaxvib.motion.analysis.scaled_error import natural_units
from optimize import amplitude, foundation_force, transmissibility

BALLS = jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0)
DRIVE = jv.ConstantSpeed(60.0)
SPRINGS = [jv.support(at=(x, -0.2), stiffness=(2e5, 4e5), damping=(2e3, 4e3), angle="20 deg") for x in (-1.2, 1.1)]
BODY = jv.plane_body(mass=200.0, inertia=60.0, supports=SPRINGS)


def state_of(scene):
    leaves, structure = jax.tree.flatten(jv.initial_state(scene))
    rng = np.random.default_rng(1)
    return jax.tree.unflatten(structure, [jnp.asarray(rng.normal(size=np.shape(leaf))) for leaf in leaves])


def same_field(one, other):
    state = state_of(one)
    for found, wanted in zip(*(jax.tree.leaves(rates_at(s, 0.3, state)) for s in (one, other)), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)


def test_matrices_of_a_plane_body_move_as_it_does():
    """Two exciters, one of them a motor whose torque reacts on the body."""
    places = ((-0.3, 0.5), (0.4, 0.2))
    carrier = BODY.carrier()
    rows = [[[1, 0, -y], [0, 1, x], [0, 0, 1]] for x, y in places]
    machine = jv.from_matrices(
        carrier.mass,
        carrier.damping,
        carrier.stiffness,
        places=rows,
        foundation=(carrier.foundation_stiffness, carrier.foundation_damping),
    )
    motor = jv.DCMotor(90.0, stall_torque=6.0, inertia=0.1)

    def scene_of(machine, at):
        return jv.Scene(
            machine,
            exciters=[jv.Exciter(drive=motor, unbalance=0.1, at=at[0]), jv.Exciter(BALLS, DRIVE, at=at[1], direction=-1)],
        )

    same_field(scene_of(machine, (1, 2)), scene_of(BODY, places))
    q, v = np.random.default_rng(0).normal(size=(2, 3))
    np.testing.assert_allclose(machine.carrier().foundation_force(q, v), carrier.foundation_force(q, v), rtol=1e-12)


@pytest.mark.parametrize(("count", "axes"), [(1, (1,)), (2, (0, 1)), (3, (0, 1))])
def test_rows_of_a_place_are_up_or_across_up_and_a_turn(count, axes):
    rows = np.random.default_rng(2).normal(size=(2, count, 3))
    machine = jv.from_matrices(np.eye(3), 0.1 * np.eye(3), 4.0 * np.eye(3), places=list(rows))
    for number, given in ((None, rows[0]), (1, rows[0]), (2, rows[1])):
        mount = machine.mount(number)
        assert mount.axes == axes and len(mount.rows) == 1 and (mount.turn is None) == (count < 3)
        np.testing.assert_array_equal(mount.rows[0], given[:2])
        np.testing.assert_array_equal(machine.rows_at(number), given[:2])
        if count == 3:
            np.testing.assert_array_equal(mount.turn, given[2])
    with pytest.raises(jv.InputError, match="1 to 2"):
        machine.mount(3)


def test_matrices_of_a_rotor_have_its_gyroscopic_force():
    rotor = jv.rotor(
        mass=37.0, transverse_inertia=0.5, polar_inertia=0.1, stiffness=(6e5, 5e5), damping=(400.0, 300.0), position=(0.2, -0.2)
    )
    carrier, mount = rotor.carrier(), rotor.mount()
    machine = jv.from_matrices(carrier.mass, carrier.damping, carrier.stiffness, mount.gyroscopic, places=[mount.rows[0]])
    same_field(jv.Scene(machine, BALLS, DRIVE), jv.Scene(rotor, BALLS, DRIVE))


LENGTH, RADIUS, E, RHO = 1.2, 0.02, 2.1e11, 7800.0
AREA, SECOND = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4.0


def shaft(elements):
    """Pinned shaft of Hermite elements with rotary inertia: mass, stiffness, gyroscopic of (u, u', w, w') at each node."""
    h = LENGTH / elements
    bending = np.array(
        [
            [12, 6 * h, -12, 6 * h],
            [6 * h, 4 * h * h, -6 * h, 2 * h * h],
            [-12, -6 * h, 12, -6 * h],
            [6 * h, 2 * h * h, -6 * h, 4 * h * h],
        ]
    )
    moved = np.array(
        [
            [156, 22 * h, 54, -13 * h],
            [22 * h, 4 * h * h, 13 * h, -3 * h * h],
            [54, 13 * h, 156, -22 * h],
            [-13 * h, -3 * h * h, -22 * h, 4 * h * h],
        ]
    )
    tilted = np.array(
        [
            [36, 3 * h, -36, 3 * h],
            [3 * h, 4 * h * h, -3 * h, -h * h],
            [-36, -3 * h, 36, -3 * h],
            [3 * h, -h * h, -3 * h, 4 * h * h],
        ]
    )
    size = 2 * (elements + 1)
    m, k, tilt = np.zeros((3, size, size))
    for j in range(elements):
        own = np.ix_(range(2 * j, 2 * j + 4), range(2 * j, 2 * j + 4))
        k[own] += E * SECOND / h**3 * bending
        tilt[own] += RHO * SECOND / (30.0 * h) * tilted
        m[own] += RHO * AREA * h / 420.0 * moved
    free = [j for j in range(size) if j not in (0, size - 2)]
    m, k, tilt = (x[np.ix_(free, free)] for x in (m + tilt, k, tilt))
    both, turn = np.eye(2), np.array([[0.0, 1.0], [-1.0, 0.0]])
    return np.kron(both, m), np.kron(both, k), np.kron(turn, 2.0 * tilt), len(free)


def closed_form(mode, speed):
    """Whirl of a Rayleigh beam: (rho A + rho I b^2) w^2 -+ 2 rho I b^2 n w - E I b^4 = 0, b = mode pi/L."""
    b = mode * np.pi / LENGTH
    inertia, spin = RHO * (AREA + SECOND * b**2), RHO * SECOND * b**2 * speed
    root = np.sqrt(spin**2 + inertia * E * SECOND * b**4)
    return sorted([(root - spin) / inertia, (root + spin) / inertia])


def test_campbell_diagram_of_a_shaft_is_the_closed_form():
    """24 elements, 96 coordinates, reduced to 12 modes; the gyroscopic force is that of a fast rotor."""
    mass, stiffness, gyroscopic, each = shaft(24)
    machine = jv.from_matrices(mass, 0.0 * mass, stiffness, gyroscopic, places=[[each // 2, each + each // 2]])
    light = jv.balls(count=1, mass=1e-9, radius=0.01, drag=1e-9)
    speeds = np.array([100.0, 2000.0])
    found = jv.whirl(jv.Scene(machine, light, DRIVE), speeds, loads="fixed")
    for k, speed in enumerate(speeds):
        wanted = np.concatenate([closed_form(mode, speed) for mode in (1, 2)])
        np.testing.assert_allclose(np.asarray(found.speed)[k, :4], wanted, rtol=1e-5)


def test_reduced_model_has_the_lowest_frequencies():
    chain = 4e4 * (2 * np.eye(30) - np.eye(30, k=1) - np.eye(30, k=-1))
    machine = jv.from_matrices(2.0 * np.eye(30), 1e-4 * chain, chain, places=[[29]], reduce=6)
    wanted = 2.0 * np.sqrt(4e4 / 2.0) * np.sin(np.arange(1, 7) * np.pi / 62)
    shape = np.sqrt(2.0 / 31.0 / 2.0) * np.abs(np.sin(30 * np.arange(1, 7) * np.pi / 31))  # for the modal masses 1
    np.testing.assert_allclose(machine.mass, np.eye(6) / np.max(shape) ** 2, atol=1e-12 / np.max(shape) ** 2)
    np.testing.assert_allclose(np.sqrt(np.diagonal(machine.stiffness)) * np.max(shape), wanted, rtol=1e-9)
    np.testing.assert_allclose(np.abs(machine.rows_at(1))[0], shape / np.max(shape), rtol=1e-9)


def test_natural_unit_of_a_heavy_reduced_model_is_its_vibration():
    """Far above the resonances each mode k vibrates by S f_k^2 at the place, with the shape f_k for the modal masses 1."""
    chain = 4e7 * (2 * np.eye(30) - np.eye(30, k=1) - np.eye(30, k=-1))
    machine = jv.from_matrices(2e3 * np.eye(30), 1e-4 * chain, chain, places=[[29]], reduce=2)
    scene = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(1e3), unbalance=0.3, at=1)])
    shape = np.sqrt(2.0 / 31.0 / 2e3) * np.abs(np.sin(30 * np.arange(1, 3) * np.pi / 31))
    np.testing.assert_allclose(natural_units(scene).displacement, 0.3 * np.max(shape) ** 2, rtol=1e-9)
    vibration = np.max(np.abs(machine.rows_at(1)[0] * jv.response(scene, [1e3]).displacement[0]))
    np.testing.assert_allclose(vibration, 0.3 * np.max(shape) ** 2, rtol=0.01)


@pytest.mark.parametrize(("kept", "size"), [(4, 4), (5, 6), (6, 6)])
def test_reduced_models_keep_both_modes_of_equal_frequencies(kept, size):
    chain = np.kron(4e4 * (2 * np.eye(8) - np.eye(8, k=1) - np.eye(8, k=-1)), np.eye(2))
    machine = jv.from_matrices(2.0 * np.eye(16), 1e-4 * chain, chain, places=[[6, 7]], reduce=kept)
    across = machine.places_rows[0] @ machine.places_rows[0].T
    assert machine.mass.shape == (size, size)
    np.testing.assert_allclose(across, across[0, 0] * np.eye(2), atol=1e-12)


def test_gradients_of_reduced_models_with_equal_frequencies():
    """Two equal planes; all squares of the frequencies are proportional to the factor of the stiffness."""
    chain = np.kron(np.eye(2), 4e4 * (2 * np.eye(8) - np.eye(8, k=1) - np.eye(8, k=-1)))

    def lowest(factor):
        machine = jv.from_matrices(2.0 * np.eye(16), 0.0 * chain, factor * chain, places=[[3, 11]], reduce=4)
        return machine.stiffness[0, 0] + machine.stiffness[1, 1]

    np.testing.assert_allclose(jax.grad(lowest)(1.0), lowest(1.0), rtol=1e-9)


ONE = np.eye(2)


def test_a_body_may_move_without_a_spring():
    free = jv.from_matrices(ONE, 0.0 * ONE, [[1.0, -1.0], [-1.0, 1.0]], places=[[0]])
    np.testing.assert_allclose(jv.natural_frequencies(jv.Scene(free, BALLS, DRIVE))[0], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("stiffness", -np.eye(2), "machine.stiffness has the eigenvalue -1; all must be at least 0"),
        ("mass", np.diag([1.0, 0.0]), "machine.mass has the eigenvalue 0; all must be greater than 0"),
        ("damping", np.eye(3), r"machine.damping has the shape \(3, 3\); 2 x 2 is needed"),
        ("places_rows", np.ones((2, 2)), "machine has places or a foundation of another shape"),
    ],
)
def test_replaced_matrices_are_validated(name, value, says):
    scene = jv.Scene(jv.from_matrices(np.eye(2), np.eye(2), np.eye(2), places=[[0]]), BALLS, DRIVE)
    with pytest.raises(jv.InputError, match=says):
        jv.natural_frequencies(eqx.tree_at(lambda s: getattr(s.machine, name), scene, jnp.asarray(value)))


def test_a_machine_does_not_share_memory_with_its_matrix():
    whole = np.zeros(4 + 8)
    begin = -whole.ctypes.data // 8 % 8  # JAX shares memory that begins at a multiple of 64 bytes
    stiffness = whole[begin : begin + 4].reshape(2, 2)
    stiffness[:] = np.eye(2)
    machine = jv.from_matrices(np.eye(2), np.zeros((2, 2)), stiffness, places=[[0]])
    stiffness[0, 0] = 7.0
    assert machine.stiffness[0, 0] == 1.0


def test_a_chain_without_support_is_read_in_single_precision():
    with jax.enable_x64(False):
        for seed in range(5):
            springs = np.random.default_rng(seed).uniform(1e4, 1e7, 39)
            ends = np.eye(39, 40, 1) - np.eye(39, 40)
            jv.from_matrices(np.eye(40), 0.0 * np.eye(40), ends.T @ np.diag(springs) @ ends, places=[[0]])


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: jv.from_matrices(np.ones((2, 3)), ONE, ONE, places=[[0]]), r"machine.mass has the shape \(2, 3\); a square"),
        (
            lambda: jv.from_matrices(ONE, np.eye(3), ONE, places=[[0]]),
            r"machine.damping has the shape \(3, 3\); 2 x 2 is needed",
        ),
        (
            lambda: jv.from_matrices(-ONE, ONE, ONE, places=[[0]]),
            "machine.mass has the eigenvalue -1; all must be greater than 0",
        ),
        (
            lambda: jv.from_matrices(ONE, ONE, -ONE, places=[[0]]),
            "machine.stiffness has the eigenvalue -1; all must be at least",
        ),
        (lambda: jv.from_matrices(ONE, ONE, [[1, 1], [0, 1]], places=[[0]]), "machine.stiffness is not symmetric"),
        (lambda: jv.from_matrices(ONE, ONE, ONE * np.nan, places=[[0]]), "machine.stiffness has an entry that is not finite"),
        (lambda: jv.from_matrices("a", ONE, ONE, places=[[0]]), "machine.mass is 'a'; it must be a square array"),
        (lambda: jv.from_matrices([[1, 2], [3]], ONE, ONE, places=[[0]]), r"machine.mass is \[\[1, 2\], \[3\]\]; it must be a"),
        (lambda: jv.from_matrices(10**400, ONE, ONE, places=[[0]]), "machine.mass is a whole number of 1329 bits; it must"),
        (lambda: jv.from_matrices(ONE, ONE, ONE, places=np.array("x")), "machine.places is .*; it must be a list of places"),
        (lambda: jv.from_matrices(ONE, ONE, (1 + 0.1j) * ONE, places=[[0]]), "machine.stiffness is complex; a real one"),
        (lambda: jv.from_matrices(ONE, ONE, ONE, ONE, places=[[0]]), "machine.gyroscopic is not skew-symmetric"),
        (
            lambda: jv.from_matrices(ONE, ONE, ONE, places=[[0, 0]]),
            r"machine.places\[0\] is \[0, 0\], which names .* \[\[0, 0\]\]",
        ),
        (
            lambda: jv.from_matrices(ONE, ONE, ONE, places=[[[1], [0, 1]]]),
            r"machine.places\[0\] is \[\[1\], \[0, 1\]\]; give 1 to 3 indices",
        ),
        (lambda: jv.from_matrices(ONE, ONE, ONE, places=[[np.nan]]), r"machine.places\[0\] is \[nan\]; give 1 to 3 indices"),
        (
            lambda: jv.from_matrices(ONE, ONE, ONE, places=[[0]], foundation=([[1, 0]], [[1]])),
            "machine.foundation must be two arrays",
        ),
        (
            lambda: jv.from_matrices(np.array([[1.0, 2.0], [2.0, 1.0]]), ONE, ONE, places=[[0]]),
            "machine.mass has the eigenvalue -1; all must be greater than 0",
        ),
        (
            lambda: jv.from_matrices(range(10**9), ONE, ONE, places=[[0]]),
            r"machine.mass is range\(0, 1000000000\); it must be a square array of numbers",
        ),
        (lambda: jv.from_matrices(ONE, iter(ONE), ONE, places=[[0]]), "machine.damping is .*iterator.*; it must be a square"),
        (
            lambda: jv.from_matrices(ONE, ONE, ONE, places=[[0]], foundation=range(10**9)),
            "machine.foundation must be two arrays",
        ),
        (lambda: jv.from_matrices(ONE, ONE, ONE, places=[]), r"machine.places is \[\]; it must be a list of places"),
        (
            lambda: jv.from_matrices(ONE, ONE, ONE, places=[[2]]),
            r"machine.places\[0\] is \[2\]; give 1 to 3 coordinates, 0 to 1",
        ),
        (lambda: jv.from_matrices(ONE, ONE, ONE, places=[[0], [0, 1]]), "machine.places has places with different numbers"),
        (lambda: jv.from_matrices(ONE, ONE, ONE, places=[[0]], foundation=[1.0]), "machine.foundation must be two arrays"),
        (lambda: jv.from_matrices(ONE, ONE, ONE, places=[[0]], reduce=0), "machine.reduce is 0; it must be a whole number"),
        (
            lambda: jv.Scene(jv.from_matrices(ONE, ONE, ONE, places=[[0]]), exciters=[jv.Exciter(BALLS, DRIVE, at=2)]),
            "at is 2; give the number of a place, 1 to 1",
        ),
        (
            lambda: jv.Scene(jv.from_matrices(ONE, ONE, ONE, places=[[0]]), exciters=[jv.Exciter(BALLS, DRIVE, at=0.5)]),
            "^at is .*0.5.*; give the number of a place, 1 to 1",
        ),
        (
            lambda: jv.sketch(jv.Scene(jv.from_matrices(ONE, ONE, ONE, places=[[0]]), BALLS, DRIVE)),
            "machine.kind is 'matrices'; sketches are available",
        ),
        (
            lambda: jv.scene_to_toml(jv.Scene(jv.from_matrices(ONE, ONE, ONE, places=[[0]]), BALLS, DRIVE)),
            "machine.kind is 'matrices', which scene files do not describe; build it in Python",
        ),
    ],
)
def test_wrong_input_ends_in_one_sentence(make, says):
    with pytest.raises(jv.InputError, match=says):
        make()


def test_forces_on_an_unknown_foundation_are_nan():
    stiffness = np.array([[9e4, -4e4], [-4e4, 7e4]])
    machine = jv.from_matrices(np.diag([100.0, 80.0]), 2e-3 * stiffness, stiffness, places=[[0]])
    scene = jv.Scene(machine, jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5), jv.ConstantSpeed(60.0))
    run = jv.simulate(scene, 3.0, save="window")
    assert np.all(np.isnan(run.window.foundation_force)) and np.isnan(run.foundation_force) and np.isnan(run.largest_force)
    assert np.all(np.isfinite(run.amplitude)) and np.isfinite(run.drift)
    assert "foundation force unknown" in run.summary()
    assert np.all(np.isnan(jv.foundation_force(scene, jv.initial_state(scene))))
    jam = jv.jam_modes(scene)
    assert np.all(np.isnan(jam.foundation_force)) and float(amplitude(mode=5)(scene)) == float(jam.amplitude[jam.row(5), 0])
    for quantity in (foundation_force(mode=5), transmissibility(mode=5).named("share of the force")):
        with pytest.raises(jv.InputError, match=r"^machine.foundation is not given, so that the force on the foundation is"):
            quantity(scene)
    turning = jv.Scene(machine, exciters=[jv.Exciter(drive=jv.ConstantSpeed(60.0), unbalance=0.1)])
    found = jv.response(turning, [0.0, 20.0])
    assert np.all(np.isnan(found.foundation_force)) and np.all(np.isnan(found.transmissibility))
    assert found.exciter_force.tolist() == [0.0, 40.0]


def test_traced_entries_are_read_and_traced_indices_refused():
    def rows(entry, place):
        return jv.from_matrices([[entry, 0.0], [0.0, 2.0]], ONE, ONE, places=[place(entry)]).places_rows

    traced = jax.jit(lambda entry: rows(entry, lambda entry: [[entry, 3.0]]))(2.0)
    np.testing.assert_array_equal(traced, [[[2.0, 3.0]]])
    with pytest.raises(jv.InputError, match=r"^machine.places\[0\] contains values .* give the indices of coordinates"):
        jax.eval_shape(lambda entry: rows(1.0 * entry, lambda entry: [entry]), 1)
