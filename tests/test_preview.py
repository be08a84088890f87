"""Previews: block means above the black level with gamma 2.2; the sensor and all regions, black elsewhere."""

from pathlib import Path

import numpy as np
from PIL import Image

from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.dataset.preview import MAX_SIDE_PX, write_preview


def grey(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))[..., 0].astype(int)


def test_blocks_are_means_above_black_with_gamma(tmp_path: Path) -> None:
    """1600 x 1200 px become 800 x 600. Halves of white: 255 * 0.5^(1/2.2) = 186; to a step of matplotlib's 256."""
    image = np.full((1200, 1600), 100, dtype=np.uint32)
    image[:2, 0:2] = [[100, 1100], [1100, 100]]  # half of white above black
    image[:2, 2:4] = 1100
    image[:2, 4:6] = 50  # below black
    image[2:4, 0:2] = 5000  # beyond white
    write_preview(tmp_path / "a.png", [RegionImage(Roi(0, 0, 1200, 1600), image)], Roi(0, 0, 1200, 1600), 1100, 100)
    picture = grey(tmp_path / "a.png")
    assert picture.shape == (600, MAX_SIDE_PX)
    assert np.abs(picture[0, :4] - [186, 255, 0, 0]).max() <= 1
    assert picture[1, 0] == 255
    assert not picture[2:].any()


def test_regions_stand_in_their_places_also_beyond_the_sensor(tmp_path: Path) -> None:
    """A sensor of 10 x 20 px, a region on it, and one that begins 5 px above and 3 px to the left of it."""
    regions = [
        RegionImage(Roi(4, 6, 2, 3), np.full((2, 3), 255, dtype=np.uint32)),
        RegionImage(Roi(-5, -3, 1, 2), np.full((1, 2), 255, dtype=np.uint32)),
    ]
    write_preview(tmp_path / "b.png", regions, Roi(0, 0, 10, 20), 255)
    expected = np.zeros((15, 23), dtype=int)
    expected[9:11, 9:12] = 255
    expected[0, 0:2] = 255
    assert np.array_equal(grey(tmp_path / "b.png"), expected)


def test_a_region_that_cuts_blocks_has_its_share_of_them(tmp_path: Path) -> None:
    """Blocks of 2 x 2 px: a region of one pixel makes a quarter of white, 255 * 0.25^(1/2.2) = 136."""
    region = RegionImage(Roi(3, 5, 1, 1), np.full((1, 1), 255, dtype=np.uint32))
    write_preview(tmp_path / "c.png", [region], Roi(0, 0, 1200, 1600), 255)
    picture = grey(tmp_path / "c.png")
    assert abs(picture[1, 2] - 136) <= 1
    assert np.count_nonzero(picture) == 1
