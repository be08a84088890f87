"""The data sheet's page: the numbers along its axes, and the line of the set values."""

import numpy as np
import pytest

from vlcrender.emva1288.page import _signal_to_noise_of as signal_to_noise_of
from vlcrender.emva1288.page import _steps as steps
from vlcrender.sensor.sensor import Sensor


@pytest.mark.parametrize("end", [1.0, 1.999, 2.0, 4.9, 5.0, 5.1, 9.99, 10.0, 5.9, 34.0, 50.0, 700.0, 1e6, 0.03])
def test_five_to_ten_round_numbers_divide_an_axis(end: float) -> None:
    found = steps(end)
    assert 5 <= len(found) <= 10
    step = found[1] / 10.0 ** np.floor(np.log10(found[1] * 1.001))
    assert np.round(step, 9) in (1, 2, 5)


def test_the_line_of_the_set_values_by_hand() -> None:
    """Variances: 100 of photons, 3^2 of reading, (2^2 + 1/12) 5^2 of the ADC and of rounding."""
    sensor = Sensor(noise="full", read_noise_e=3.0, adc_noise_dn=2.0, gain_e_per_dn=5.0, full_well_e=4000.0)
    expected = 100 / np.sqrt(100 + 9 + (4 + 1 / 12) * 25)
    assert signal_to_noise_of(sensor, np.array([100.0])) == pytest.approx([expected], rel=1e-12)
