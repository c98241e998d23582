"""Linearized least-squares fits of records with white noise."""

import numpy as np
from run_ups_by_scipy import pulse_times


def used_samples(times, turning):
    """Return True (n,) for samples from the first of 24 pulses in a turn on; before it the angle of the rotor is unknown."""
    return times >= pulse_times(turning, float(times[-1]), 24)[1][0]


def estimator(slopes, used, count):
    """Return the matrix (count, n, 2) from the noise of a record to the errors of the first `count` unknowns.

    The rows for white noise of standard deviation 1 have the lengths of the Cramer-Rao bound.

    **Arguments**: `slopes` (n, 2, unknowns): derivatives of the readings; `used` (n,): True for samples that count.
    """
    shape, slopes = slopes.shape[:2], (slopes * used[:, None, None]).reshape(-1, slopes.shape[2])
    scale = np.linalg.norm(slopes, axis=0)
    return (np.linalg.pinv(slopes / scale) / scale[:, None])[:count].reshape(-1, *shape)


def bound(estimates, noise):
    """Return the Cramer-Rao bound of the standard errors for an `estimator` and white noise, m/s^2."""
    return noise * np.linalg.norm(estimates, axis=(1, 2))


def linear_errors(estimates, run, clean):
    """Return the errors of the linearized fit by an `estimator` to a record of the `clean` accelerations (n, 2)."""
    readings = np.stack([run.values[name] for name in ("a1", "a2")], axis=1)
    return np.einsum("kij,ij->k", estimates, readings - clean)
