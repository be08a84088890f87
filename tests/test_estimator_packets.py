"""The fit of a packet's chips: its misfit, and bits that no line shows, on sums made by hand."""

import numpy as np
import pytest
from downlink_signals import PACKETS, packet_chips
from numpy.typing import NDArray

from estimator.receiver.packets import PacketFormat, _added, _checked, _Fit

Array = NDArray[np.float64]
FORM = PacketFormat(PACKETS)
CHIPS = np.array(list(map(int, packet_chips(3500, 2500, 3450))))


def fit_of(weight: Array, images: int = 3) -> _Fit:
    """Exact readings of CHIPS, of each chip by itself with a weight (length,), 0 where no line shows it."""
    level = CHIPS - 0.5
    shown = np.where(weight > 0, images, 0).astype(np.int64)
    return _Fit(np.diag(weight), weight * level, float(weight @ level**2), shown)


def test_the_misfit_of_a_packet_is_the_weight_of_the_chips_that_differ() -> None:
    """Levels are 0 and 1: a chip read as the other one leaves its weight times 1."""
    weight = np.random.default_rng(3).uniform(1.0, 2.0, FORM.length)
    misfits = fit_of(weight).misfits(CHIPS)
    for start in (0, 1, 14, 57):
        assert misfits[start] == pytest.approx(weight @ (np.roll(CHIPS, start) != CHIPS), abs=1e-9)


def data_with(hidden: Array) -> list[tuple[int, int]]:
    """Erasures and the number of data bits that differ from the packet's, of each packet that passes."""
    true = CHIPS[len(FORM.preamble) :: 2][: PACKETS.data_bits]
    weight = np.ones(FORM.length)
    weight[hidden] = 0.0
    found = list(_checked([fit_of(weight)], FORM))
    return [(erased, int((data != true).sum())) for _, start, data, erased in found if start == 0]


def test_bits_of_which_no_line_shows_a_chip_are_erasures_and_those_with_one_are_not() -> None:
    """A bit is the difference of its chips. The prior's variance of a chip is 1: with both hidden nothing of it is
    shown, with one a half. Hidden chips count as dark or bright by nothing; bits of 1 that were taken as read would be
    0, and the checks would not fit.
    """
    bits = CHIPS[len(FORM.preamble) :: 2]
    ones = len(FORM.preamble) + 2 * np.flatnonzero(bits == 1)[:3]
    assert data_with(np.concatenate([ones, ones + 1])) == [(3, 0)]
    assert data_with(ones) == [(0, 0)]
    assert data_with(np.array([], dtype=np.int64)) == [(0, 0)]


def test_fits_are_added_chip_by_chip() -> None:
    """Two LED images that show all chips but one each: every chip is shown by two of them but for those two chips."""
    first, second = np.ones(FORM.length), np.full(FORM.length, 2.0)
    first[3], second[8] = 0.0, 0.0
    both = _added([fit_of(first, 1), fit_of(second, 1)], FORM.length)
    assert both.shown.tolist() == [1 if place in (3, 8) else 2 for place in range(FORM.length)]
    assert (np.diag(both.normal) == first + second).all()
    assert (both.right == (first + second) * (CHIPS - 0.5)).all()
    assert both.square == pytest.approx((first + second).sum() / 4)
