"""The filters that compare a signal with all codes and phases: against the wave of each by itself."""

import numpy as np
import pytest

from estimator.io.downlink import Codes
from estimator.receiver.codes import PHASES, CodeBook
from estimator.receiver.signal import Signal

CHIP_S = 25e-6


@pytest.mark.parametrize("length", [15, 16])
@pytest.mark.parametrize("exposure_chips", [1.6, 9.3])
def test_filters_give_each_wave_s_correlation(length: int, exposure_chips: float) -> None:
    """Exposures of two chips, and of more than half a period, in which a chip meets another both before and after it.

    Filters are in single precision, 6e-8: a variance of the gains is the difference of two numbers of some 0.25, and is
    9e-4 at least, so that a rounding is 2e-5 of it; a few of them add.
    """
    rng = np.random.default_rng(8)
    codes = ["".join(map(str, rng.permutation(np.arange(length) % 2))) for _ in range(2)]
    book = CodeBook(CHIP_S, [Codes.model_construct(leds=(4, 7), codes=tuple(codes), depth=1.0, chip_us=25.0)])
    start_s = 3.0 + np.linspace(0.0, 590e-6, 60)
    signal = Signal(start_s, exposure_chips * CHIP_S, rng.uniform(0, 1, 60), rng.uniform(1, 2, 60))
    found = book.correlations(signal)
    for row in range(2):
        for phase in range(length * PHASES):
            gains = book.wave(row, phase / PHASES, start_s[0]).gains(start_s, signal.exposure_s)
            assert found[row, phase] == pytest.approx(signal.correlation(gains), abs=1e-4)
