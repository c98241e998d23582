"""Pieces of a spectrum: their length, their places, and the heights of their peaks."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.motion.analysis.spectrum import spectrum_of

SCENE = jv.Scene(
    jv.one_mass(mass=50.0, stiffness=4e4, damping=60.0),
    jv.balls(count=1, mass=0.5, radius=0.1, drag=1.0),
    jv.ConstantSpeed(60.0),
)


@pytest.mark.parametrize(("parts", "size"), [(1, 4000), (2, 2666), (4, 1600), (9, 800)])
def test_pieces_of_a_spectrum_share_their_halves(parts, size):
    """P pieces of n samples that share halves cover (P + 1)/2 of their length: each has 2 n / (P + 1) samples."""
    time = jnp.linspace(0.0, 40.0, 4000)
    wave = jnp.sin(28.0 * time)[:, None]
    motion = Trajectory(
        time, jv.State(wave, wave, (wave,), (28.0 + 0.0 * wave,)), wave, (60.0 * time,), (jnp.full(4000, 60.0),)
    )
    found = spectrum_of(SCENE, motion, motion, parts)
    step = 40.0 / 3999.0
    starts = np.linspace(0.0, (4000 - size) * step, parts)
    np.testing.assert_allclose(found.time, starts + (size - 1) * step / 2.0, atol=step)
    # A peak of Hann's window is 0 at two lengths' distance from its middle, and half as high at one.
    peak, row = found.amplitude[-1, :, 0], 2.0 * np.pi / (size * step)
    at = np.interp(28.0 + row * np.array([-2.0, -1.0, 0.0, 1.0, 2.0]), found.frequency, peak)
    np.testing.assert_allclose(at, [0.0, 0.5, 1.0, 0.5, 0.0], atol=0.03)
