"""Pieces of a spectrum: their length, their places, and the heights of their peaks."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

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


def test_spectra_of_few_samples_are_refused():
    """Two states for each turn: a vibration at 50 rad/s would have its peak at 10 rad/s."""
    run = jv.simulate(SCENE, 40.0, samples=764, estimate=False)
    with pytest.raises(jv.InputError, match=r"^parts is 4, but the run has 2 states for each turn .* at least 3 are needed"):
        run.spectrum(4)
    assert run.spectrum().frequency[-1] > 80.0


def test_rounded_times_do_not_move_a_peak():
    """Late in a run in single precision a step between two times, 2^-10 s, is rounded by up to 6 %."""
    exact = 1000.0 + 1.03 * 2.0**-10 * np.arange(4096)
    time, wave = jnp.asarray(exact, jnp.float32), jnp.asarray(np.sin(28.0 * exact), jnp.float32)[:, None]
    motion = Trajectory(time, jv.State(wave, wave, (wave,), (0.0 * wave,)), wave, (time,), (0.0 * time + 60.0,))
    found = spectrum_of(SCENE, motion, None, 1)
    assert abs(found.frequency[np.argmax(found.amplitude[0, :, 0])] - 28.0) <= found.frequency[1] / 2.0


def test_waterfall_is_drawn_onto_given_axes():
    time = jnp.linspace(0.0, 40.0, 4000)
    wave = jnp.sin(28.0 * time)[:, None]
    motion = Trajectory(time, jv.State(wave, wave, (wave,), (0.0 * wave,)), wave, (time,), (0.0 * time + 60.0,))
    axes = Figure().subplots()
    assert spectrum_of(SCENE, motion, motion, 3).plot(ax=axes) is axes and axes.has_data()


def test_an_unknown_force_has_no_figure():
    time = jnp.linspace(0.0, 1.0, 64)
    motion = Trajectory(
        time,
        jv.State(time[:, None], time[:, None], (time[:, None],), (time[:, None],)),
        jnp.nan * time[:, None],
        (time,),
        (time,),
    )
    found = spectrum_of(SCENE, motion, None, 1)
    with pytest.raises(jv.InputError, match=r"^show is 'force', but the machine is from matrices without a foundation"):
        found.plot(show="force")


def test_spectrum_marks_the_speed_of_each_exciter():
    """Unbalances at 60 and 90 rad/s, clockwise and anticlockwise, on a platform far above its resonance: a peak at each."""
    exciters = [jv.Exciter(drive=jv.ConstantSpeed(w), unbalance=0.1, direction=d, at=1) for w, d in ((60.0, 1), (90.0, -1))]
    scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e3, damping=300.0), exciters=exciters)
    found = jv.simulate(scene, 20.0, estimate=False).spectrum()
    np.testing.assert_allclose(found.rotor_speeds, [[60.0, -90.0]])
    assert found.load_speeds.shape == (1, 0)
    for w, expected in ((60.0, 0.1 * 60.0**2), (90.0, 0.1 * 90.0**2)):
        near = np.abs(found.frequency - w) < 5.0
        height = expected / abs(4e3 - 50.0 * w**2 + 300.0j * w)
        np.testing.assert_allclose(np.max(found.amplitude[0, near, 0]), height, rtol=0.03)
    drawn = found.plot(unit="rad/s").axes[0]
    assert sorted(round(line.get_xdata()[0], 6) for line in drawn.lines if line.get_linestyle() == "-.") == [60.0, 90.0]
