"""Many run-ups of one rotor."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv


def test_run_ups_name_each_lane():
    s = jv.Scene(
        jv.planar_rotor(mass=20.0, stiffness=4e4, damping=60.0),
        jv.balls(count=2, mass=0.4, radius=0.08, drag=0.5),
        jv.SpinUp(60.0, duration=1.0),
    )
    found = jv.run_up_map(s, 5.0, drag=[0.05, 5.0], angles=[[0.0, 0.1], [1.0, 2.0]], stepsize_controller=jv.Tolerance(1e-5))
    assert found.kind.shape == (2, 2) and np.all(found.finished)
    assert np.all(found.fraction("jammed") + found.fraction("unbalanced") + found.fraction("balanced") <= 1.0)
    assert not np.any(found.fraction("failed"))
    lone = eqx.tree_at(lambda s: s.loads.drag, s, jnp.asarray(5.0))
    start = eqx.tree_at(lambda y: y.angle, jv.initial_state(lone), (jnp.array([1.0, 2.0]),))
    run = jv.simulate(lone, 5.0, start=start, save="window", stepsize_controller=jv.Tolerance(1e-5))
    assert run.regime.label == found.kind[1, 1]
    np.testing.assert_allclose(found.omega[1, 1], run.omega, rtol=1e-6)
    assert len(found.plot().axes) == 2
    lines = found.summary().splitlines()
    assert (
        lines[0] == "of 2 starts at each drag (in brackets: 95 % intervals)"
        and "% (" in lines[1]
        and lines[1].startswith("drag 0.05 N s/m: ")
    )
    for line, kinds in zip(lines[1:], found.kind, strict=True):
        assert all(f"{50 * np.sum(kinds == kind)} % (" in line and f"%) {kind}" in line for kind in kinds)
    with pytest.raises(jv.InputError, match=r"angles has shape \(1, 3\)"):
        jv.run_up_map(s, 5.0, angles=[[0.0, 0.1, 0.2]])
    for more, says in ((dict(drag=np.zeros(0)), "drag is an empty array"), (dict(starts=2, seed=-1), "seed is -1")):
        with pytest.raises(jv.InputError, match=says):
            jv.run_up_map(s, 5.0, **more)
    with pytest.raises(jv.InputError, match="cannot be combined with angles"):
        jv.run_up_map(s, 5.0, starts=3, angles=[[0.0, 0.1]])


def test_run_ups_that_fail_are_no_motion():
    """The tolerance of single precision is the default; one of the drags is 0."""
    with jax.enable_x64(False):
        s = jv.Scene(
            jv.one_mass(mass=20.0, stiffness=4e4, damping=60.0),
            jv.balls(count=1, mass=0.4, radius=0.08, drag=0.5),
            jv.SpinUp(60.0, duration=0.5),
        )
        found = jv.run_up_map(s, 2.0, drag=[5.0, 1e12], max_steps=2**14)
    assert found.finished.tolist() == [[True], [False]]
    assert found.fraction("failed").tolist() == [0.0, 1.0] and found.kind[1, 0] == "failed"
    assert found.summary().splitlines()[2] == "drag 1e+12 N s/m: failed"
    assert "%" not in found.summary() and "one start at each drag; a small change" in found.summary()
    assert len(found.plot().axes) == 2
    with pytest.raises(jv.InputError, match=r"kind is 'lost'; allowed: swinging, .*unsettled, failed"):
        found.fraction("lost")


def test_run_ups_start_with_the_given_separation():
    s = jv.Scene(
        jv.planar_rotor(mass=20.0, stiffness=4e4, damping=60.0),
        jv.balls(count=2, mass=0.4, radius=0.08, drag=0.5),
        jv.SpinUp(60.0, duration=1.0),
    )
    for separation in ("10 deg", 0.0):
        found = jv.run_up_map(s, 0.1, separation=separation, stepsize_controller=jv.Tolerance(1e-5))
        np.testing.assert_allclose(np.degrees(np.ptp(found.angle)), 10.0 if separation else 0.0, atol=1e-12)
    for others in ({"starts": 3}, {"angles": [[0.0, 0.1]]}):
        with pytest.raises(jv.InputError, match=r"separation is '10 deg'; it is only for a single start"):
            jv.run_up_map(s, 0.1, separation="10 deg", **others)
