"""Lines in spectra over the rotor's angle and over time, against vibrations in closed form."""

import numpy as np
import pytest

from jaxvib.identification.records.orders import _line, _spectrum, foreign_vibration

STEP = 0.01
T = STEP * np.arange(3000)
ANGLE = -(10.0 * T + 0.8 * T**2)


def signal(rotor=0.0, order=0.0, constant=0.0, noise=0.0):
    values = rotor * np.cos(ANGLE + 0.3) + order * np.cos(0.7 * ANGLE) + constant * np.cos(2.0 * np.pi * 4.0 * T)
    return 5.0 + values + noise * np.random.default_rng(0).normal(size=T.size)


@pytest.mark.parametrize(
    ("parts", "order", "frequency"),
    [
        ({"rotor": 0.5, "order": 1.0}, 0.7, None),
        ({"rotor": 0.5, "constant": 1.0}, None, 4.0),
        ({"order": 0.6, "constant": 1.0}, None, 4.0),
        ({"order": 1.0, "constant": 0.6}, 0.7, None),
    ],
)
def test_strongest_vibration_that_is_not_the_rotors(parts, order, frequency):
    found = foreign_vibration(signal(**parts, noise=0.1), ANGLE, STEP)
    power = sum(each**2 for each in parts.values()) + 2.0 * 0.1**2
    assert found.share == pytest.approx(1.0 / power, abs=0.08)
    if order is None:
        assert found.order is None and found.frequency == pytest.approx(frequency, rel=0.01)
        assert found.frequency_text == f"at {found.frequency:.3g} Hz"
    else:
        assert found.frequency is None and found.order == pytest.approx(order, rel=0.01)
        assert found.frequency_text == f"at {found.order:.3g} times the rotor speed"


@pytest.mark.parametrize("parts", [{"rotor": 1.0, "order": 0.9}, {"rotor": 1.0, "constant": 0.9}, {"noise": 1.0}, {}])
def test_rotor_and_noise_are_not_foreign(parts):
    assert foreign_vibration(signal(**parts), ANGLE, STEP) is None


def test_missing_readings_do_not_count():
    values = signal(rotor=0.5, order=1.0, noise=0.1)
    values[100:160] = np.nan
    found = foreign_vibration(values, ANGLE, STEP)
    assert found.order == pytest.approx(0.7, rel=0.01)


def test_short_records_are_not_examined():
    values = signal(order=1.0)
    assert foreign_vibration(values[:511], 40.0 * ANGLE[:511], STEP) is None
    assert foreign_vibration(values[:512], 2.0 * ANGLE[:512], STEP) is not None
    slow = ANGLE * 15.9 * 2.0 * np.pi / abs(ANGLE[-1])
    assert foreign_vibration(np.cos(0.7 * slow * 20.0), slow, STEP) is None
    assert foreign_vibration(np.cos(0.7 * slow * 20.0), slow * 16.0005 / 15.9, STEP) is not None


def test_shares_of_a_spectrum():
    power, width = _spectrum(np.cos(2.0 * np.pi * 4.0 * T) + 3.0, STEP)
    assert width == pytest.approx(1.0 / (750 * STEP)) and power.size == 376
    assert np.sum(power) == pytest.approx(1.0) and np.argmax(power) == 30
    np.testing.assert_allclose(power[28:33] / power[30], [0.0, 0.25, 1.0, 0.25, 0.0], atol=1e-9)  # a line of Hann's window


def test_place_and_share_of_a_line():
    power = np.full(100, 0.001)
    power[49:52] = 0.2, 0.4, 0.1
    place, share = _line(power)
    assert share == pytest.approx(0.702) and place == pytest.approx((49 * 0.2 + 50 * 0.4 + 51 * 0.1 + 0.048 + 0.052) / 0.702)
    for height, expected in ((9.0, 0.0), (11.0, 1.0)):  # mean power of the five bins of the line
        flat = np.ones(100)
        flat[48:53], flat[50] = height, height + 0.01
        assert (_line(flat)[1] > 0.0) == (expected > 0.0)
    assert _line(np.zeros(100)) == (0.0, 0.0)
