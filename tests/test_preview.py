"""Previews: block means above the black level with a gamma of 2.2, by hand."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image

from vlcrender.camera.roi import Roi
from vlcrender.dataset.format.preview import MAX_SIDE_PX, write_preview


def shown(path: Path, *images: tuple[Roi, np.ndarray], sensor: Roi, white_dn: int, black_dn: int = 0) -> np.ndarray:
    """Grey values 0 to 1 of the preview, (rows, columns)."""
    write_preview(path / "p.png", images, sensor, white_dn, black_dn)
    with Image.open(path / "p.png") as picture:
        picture.verify()  # checksums of all chunks
    picture = imread(path / "p.png")
    assert picture.ndim == 2
    return picture


STEP = 1 / 256
"""The 256 grey values k / 255 stand for the shares from k / 256 to (k + 1) / 256 of white's."""


def test_a_small_frame_is_shown_pixel_by_pixel_with_gamma(tmp_path: Path) -> None:
    """Above a black level of 100, white is 1000: numbers of 100, 325, 550 and 1000 are 0, 1/4, 1/2 and 1 of white."""
    image = np.array([[100, 325, 550], [1000, 60, 2000]], dtype=np.uint32)
    sensor = Roi(0, 0, 2, 3)
    grey = shown(tmp_path, (sensor, image), sensor=sensor, white_dn=1000, black_dn=100)
    linear = np.array([[0, 0.25, 0.5], [1, 0, 1]])  # below black is black, above white is white
    np.testing.assert_allclose(grey, linear ** (1 / 2.2), atol=STEP)


def test_a_large_frame_is_shown_in_block_means_of_at_most_800_pixels(tmp_path: Path) -> None:
    """1602 columns need blocks of 3: 534 x 2 of them. Block (0, 1) holds one pixel of 900: a mean of 100 of 1000."""
    image = np.zeros((6, 1602), dtype=np.uint32)
    image[1, 4] = 900
    image[3:, 3:6] = 1000
    sensor = Roi(0, 0, 6, 1602)
    grey = shown(tmp_path, (sensor, image), sensor=sensor, white_dn=1000)
    assert grey.shape == (2, 534)
    assert grey.shape[1] <= MAX_SIDE_PX
    expected = np.zeros((2, 534))
    expected[0, 1], expected[1, 1] = 0.1 ** (1 / 2.2), 1.0
    np.testing.assert_allclose(grey, expected, atol=STEP)
    exact = Roi(0, 0, 2, 1600)
    assert shown(tmp_path, (exact, np.zeros((2, 1600))), sensor=exact, white_dn=1).shape == (1, 800)


def test_regions_stand_at_their_place_also_beyond_the_sensor(tmp_path: Path) -> None:
    """A sensor of 4 x 6 pixels, a region two columns to its left and one that ends in its last pixel."""
    left, last = Roi(1, -2, 1, 3), Roi(2, 4, 2, 2)
    images = [(left, np.array([[1, 2, 3]], dtype=np.uint32)), (last, np.array([[4, 5], [6, 7]], dtype=np.uint32))]
    grey = shown(tmp_path, *images, sensor=Roi(0, 0, 4, 6), white_dn=8)
    linear = np.zeros((4, 8))
    linear[1, :3] = 1, 2, 3
    linear[2:, 6:] = (4, 5), (6, 7)
    np.testing.assert_allclose(grey, (linear / 8) ** (1 / 2.2), atol=STEP)


@pytest.mark.parametrize("row", [0, 1, 2])
def test_a_region_that_starts_inside_a_block_counts_in_it(tmp_path: Path, row: int) -> None:
    """Blocks of 3 x 3: three rows of 900 from row `row` on share two blocks, a third of a column each row."""
    roi, sensor = Roi(row, 4, 3, 1), Roi(0, 0, 6, 2400)
    grey = shown(tmp_path, (roi, np.full((3, 1), 900, dtype=np.uint32)), sensor=sensor, white_dn=900)
    linear = np.zeros((2, 800))
    linear[:, 1] = (3 - row) / 9, row / 9
    np.testing.assert_allclose(grey, linear ** (1 / 2.2), atol=STEP)


@pytest.mark.parametrize(("rows", "shown_rows"), [(2, 1), (3, 1), (5, 1), (6, 2)])
def test_blocks_that_the_frame_does_not_fill_are_left_out_but_one(tmp_path: Path, rows: int, shown_rows: int) -> None:
    """Blocks of 3: a rest of one or two rows would be darker than it is, and a picture has at least one row."""
    sensor = Roi(0, 0, rows, 2400)
    grey = shown(tmp_path, (sensor, np.full((rows, 2400), 9, dtype=np.uint32)), sensor=sensor, white_dn=9)
    assert grey.shape == (shown_rows, 800)
    sensor = Roi(0, 0, 2400, rows)
    grey = shown(tmp_path, (sensor, np.full((2400, rows), 9, dtype=np.uint32)), sensor=sensor, white_dn=9)
    assert grey.shape == (800, shown_rows)
