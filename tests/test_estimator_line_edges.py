"""Edges of an LED image in its lines: which lines have edges at all."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from estimator.spots.line_edges import LineEdges, edges_of
from estimator.spots.striped_blobs import BlobLight, StripedBlob

Array = NDArray[np.float64]
ROWS, COLUMNS, FIRST, LAST = 20, 60, 20, 40
"""A bar of 20 lines, lit from one column to before another."""


def bar(level: Array, background_e2: float = 0.0, whole: bool = False) -> LineEdges | None:
    """Edges of a bar with a level for each line, (ROWS,), and this variance of the pixels beside it.

    `whole`: the box holds nothing but pixels of the LED image.
    """
    columns = np.arange(COLUMNS)
    own = np.tile((columns >= FIRST) & (columns < LAST), (ROWS, 1))
    signal = own * level[:, None]
    variance = np.where(own, signal + background_e2, background_e2)
    if whole:
        own = np.ones_like(own)
    blob = StripedBlob(0, 0, COLUMNS, ROWS, own, np.zeros_like(own), int(own.sum()))
    light = BlobLight(signal, variance, np.ones_like(own), np.full(ROWS, background_e2 / COLUMNS))
    return edges_of(light, blob, np.zeros_like(own))


@pytest.mark.parametrize(("share", "seen"), [(0.99, True), (1.01, False)])
def test_a_line_has_edges_where_its_half_level_is_four_sigma(share: float, seen: bool) -> None:
    """At half level p / 2 a pixel has the variance p / 2 of its light and B of the background beside it, and the mean
    of three a third of that: p / 2 = 4 sqrt((p / 2 + B) / 3) where B = 3 (p / 8)^2 - p / 2.
    """
    level = 100.0
    limit_e2 = 3 * (level / 8) ** 2 - level / 2
    found = bar(np.full(ROWS, level), share * limit_e2)
    assert (found is not None) == seen
    if found is not None:
        assert found.left == pytest.approx(np.full(ROWS, FIRST))
        assert found.right == pytest.approx(np.full(ROWS, LAST))


def test_an_image_that_fills_its_box_has_the_noise_of_its_light_alone() -> None:
    """Twice that of the half level: no pixel beside it tells the background's, and no line of it is lost by that."""
    found = bar(np.full(ROWS, 1000.0), whole=True)
    assert found is not None
    assert len(found.lines) == ROWS


def test_lines_below_a_twentieth_of_the_bright_ones_are_background() -> None:
    """Dark lines hold the blur and the glare of the lit ones beside them, whose edges are not the LED's: up to a
    twentieth of its light, which is the share that `estimator.pixels.likelihood` allows a halo (HALO_SHARE).
    """
    level = np.full(ROWS, 1e6)
    level[3], level[8] = 0.048 * 1e6, 0.052 * 1e6
    found = bar(level)
    assert found is not None
    assert sorted(set(range(ROWS)) - set(found.lines.astype(int).tolist())) == [3]


def test_the_edges_of_a_blurred_bar_are_where_it_begins_and_ends() -> None:
    """Each edge is the light within EDGE_PX = 2.5 px of a rough one, where light and shadow that the blur of 1.2 px
    carries beyond are equal: a share of Q(2.5 / 1.2) = 0.02 at each end. A rough edge that is right to half a pixel
    makes them differ by 2 x 0.02 x 0.5 = 0.02 px.
    """
    edges_px, blur_px = np.array([20.3, 40.4]), 1.2
    columns = np.linspace(0, COLUMNS, 100 * COLUMNS + 1)
    shares = ndtr((columns - edges_px[0]) / blur_px) - ndtr((columns - edges_px[1]) / blur_px)
    signal = np.tile(1e5 * shares[:-1].reshape(COLUMNS, 100).mean(axis=1), (ROWS, 1))
    own = signal > 5e3
    blob = StripedBlob(0, 0, COLUMNS, ROWS, own, np.zeros_like(own), int(own.sum()))
    found = edges_of(BlobLight(signal, signal + 1, np.ones_like(own), np.zeros(ROWS)), blob, np.zeros_like(own))
    assert found is not None
    assert found.left == pytest.approx(np.full(ROWS, edges_px[0]), abs=0.02)
    assert found.right == pytest.approx(np.full(ROWS, edges_px[1]), abs=0.02)
