"""Codes without noise: their phases in a later frame whose clock has drifted, and the fewest lines that tell one."""

import numpy as np
import pytest
from downlink_signals import EXPOSURE_S, ROW_TIME_S, Sent
from test_estimator_receiver import BOOKS, CHIP_S, CODES

from estimator.receiver.codes import MIN_LINES, match_code, match_phase
from estimator.receiver.signal import Signal

LINES = np.arange(60) * ROW_TIME_S


def seen(one: Sent, start_s: float, lines: int = len(LINES)) -> Signal:
    starts_s = start_s + LINES[:lines]
    return Signal(starts_s, EXPOSURE_S, one.gains(starts_s), np.ones(lines))


@pytest.mark.parametrize("drift_chips", [-2.75, -0.6, 0.0, 2.25])
def test_a_code_is_followed_by_a_clock_that_drifts(drift_chips: float) -> None:
    """0.25 s are 10 000 chips, of which 3 sigmas of 1e-4 are 3: the phase that is found is that of the drifted clock.

    Waves of the test are sums of 400 steps of an exposure, in which a switch is off by half a step at most; the phase's
    last step is 2e-3 chips. Both together are less than a hundredth of a chip.
    """
    row = 7
    sent, later_s = Sent(CODES[row], CHIP_S, 5.3), 10_000 * CHIP_S
    first = seen(sent, 0.0)
    later = seen(Sent(CODES[row], CHIP_S, 5.3 + drift_chips), later_s)
    found = BOOKS[0].near(later, row, 5.25, first, 1e-4)
    assert found.correlation > 0.999
    off = (found.wave.start_chips - (5.3 + drift_chips + 10_000) + 16) % 32 - 16
    assert abs(off) < 0.01


def test_eight_lines_are_the_fewest_of_a_signal() -> None:
    """Eight lines are 80 us, three chips of 25 us, and as many exposures of 40 us as there are free phases to tell."""
    one = Sent(CODES[0], CHIP_S, 0.0)
    starts = [start for start in np.arange(0, 32 * CHIP_S, CHIP_S) if np.ptp(one.gains(start + LINES[:7])) > 0.5]
    shorter, enough = seen(one, starts[0], MIN_LINES - 1), seen(one, starts[0], MIN_LINES)
    assert (match_phase(shorter, BOOKS[0], 100), match_code(shorter, BOOKS)) == (None, None)
    assert match_phase(enough, BOOKS[0], 100) is not None
    assert match_code(enough, BOOKS) is not None
    assert MIN_LINES == 8
