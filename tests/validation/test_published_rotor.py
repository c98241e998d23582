"""Run-ups of the published rotor under several readings of its data."""

import numpy as np
import pytest
from papers.machines import published_rotor, rotor_run_up_map

import jaxvib as jv
from jaxvib.results.status import status_name
from jaxvib.steady.jams.phases import phase_jam, phase_pattern

BOTH = "uncoupled, both dampers"


def test_published_rotor_at_three_frictions():
    """First jam 169.6 rad/s with ripple 3.1, second 271.1 in opposite pairs, and balancing, with the data read as c2 = 0."""
    frictions = (9.2e-4, 1.24e-2)
    found = rotor_run_up_map(frictions, BOTH)
    assert found.kind[:, 0].tolist() == ["jammed", "jammed"]
    np.testing.assert_allclose(found.omega[:, 0], [169.6, 271.15], atol=0.1)
    np.testing.assert_allclose(found.regime.ripple[0, 0], 3.1, atol=0.1)
    # The torque balance at unequal phases, started from the phases of the run, gives the speed at which the run has locked.
    for k, mu in enumerate(frictions):
        jam = phase_jam(published_rotor(mu, BOTH), found.omega[k, 0], found.regime.phase[k, 0])
        assert bool(jam.stable)
        np.testing.assert_allclose(jam.omega, found.omega[k, 0], atol=0.1)
    patterns = [status_name(phase_pattern(found.regime.phase[k, 0])) for k in (0, 1)]
    assert "together" in patterns[0] and "opposite" in patterns[1]


@pytest.mark.slow
def test_published_rotor_over_its_whole_friction():
    """The regimes that the paper reports, those of its printed data, and the readings under which the former come out."""
    mu = [5e-5, 9.2e-4, 1.0e-3, 1.02e-2, 1.8e-2, 4.6e-2, 1e-1]
    printed, early = rotor_run_up_map(mu, "printed", until=4.0), rotor_run_up_map(mu, BOTH, until=4.0)
    uncoupled, late = rotor_run_up_map(mu, "uncoupled", until=12.0), rotor_run_up_map(mu, BOTH, until=12.0)
    assert printed.kind[1, 0] != "jammed"  # no stable first jam with the printed c2
    np.testing.assert_allclose(printed.omega[3, 0], 271.1, atol=0.1)
    assert uncoupled.kind[:2, 0].tolist() == ["swinging", "jammed"] and uncoupled.kind[2, 0] != "jammed"
    # "Turns with the rotor, not balanced" depends on the time of the observation.
    assert early.kind[5, 0] == "unbalanced"
    assert late.kind[4:, 0].tolist() == ["balanced"] * 3


@pytest.mark.slow
def test_first_jam_is_reached_from_equal_starts_only():
    """The first of 201 starts hangs together; one program for all, which takes longer to compile than to run."""
    s = published_rotor(9.2e-4, "uncoupled")
    together, scattered = np.full((1, 4), -np.pi / 2.0), np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 4))
    found = jv.run_up_map(s, 6.0, angles=np.concatenate([together, scattered]), batch=8, stepsize_controller=jv.Tolerance(1e-6))
    assert np.all(found.finished)
    near_first = (found.kind[0] == "jammed") & (np.abs(found.omega[0] - 169.6) < 0.1)
    assert near_first[0] and np.mean(near_first[1:]) < 0.05
