"""Edges of LED images along a row: a place by the light between the two levels."""

import numpy as np

from estimator.spots.contours import SIDE_PX
from estimator.spots.contours import _right_edges as right_edges


def test_a_row_whose_light_does_not_fall_has_no_edge() -> None:
    """Three rows with `own` pixels on the left: light that falls from 100 to 20 electrons with 40 % of an edge pixel
    lit, light that rises, as noise may make it, and light that is level, which no place of an edge explains.
    """
    own = np.tile(np.arange(2 * SIDE_PX + 4) < SIDE_PX + 2, (3, 1))
    last = SIDE_PX + 1
    electrons = np.where(own, 100.0, 20.0)
    electrons[0, last + 1] = 20.0 + 0.4 * 80.0
    electrons[1], electrons[2] = np.where(own[1], 20.0, 100.0), 50.0
    with np.errstate(all="raise"):
        found = right_edges(electrons, own, np.ones_like(own))
    np.testing.assert_allclose(found, [[last + 1 + 0.4, 0.5]], atol=1e-12)


def test_an_edge_needs_pixels_of_one_image_before_it_and_none_of_another_behind() -> None:
    """Three rows of light that falls by 80 electrons behind a pixel: below a whole side of the image, behind too few
    pixels of it, and before another piece of it that is nearer than a side is long.
    """
    own = np.zeros((3, 4 * SIDE_PX), dtype=bool)
    last = 2 * SIDE_PX - 1
    own[:, : last + 1] = True
    own[1, : last - SIDE_PX + 2] = False
    own[2, last + SIDE_PX] = True
    electrons = np.where(np.arange(own.shape[1]) <= last, 100.0, 20.0) * np.ones((3, 1))
    used = np.zeros_like(own)
    used[:, last] = True
    np.testing.assert_allclose(right_edges(electrons, own, used), [[last + 1, 0.5]], atol=1e-12)
