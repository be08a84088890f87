"""Images on surfaces: a PNG's grey values as reflectances, repeated tile by tile, and their exact means.

Between the centres of the image's pixels reflectance is linear; means take each pixel as a square of one reflectance,
which differs from that by half a pixel of blur and keeps the light.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vlcrender.errors import InputError

Array = NDArray[np.float64]

MAX_PIXELS = 4_000_000
"""Of an image: the table of sums that a view looks up takes 32 bytes a pixel."""


@dataclass(frozen=True)
class Texture:
    """Reflectances (rows, columns) of one tile that repeats.

    The first pixel's outer corner lies at `origin_m`; `across_m` and `down_m` (3,) are the tile's sides along the
    image's rows and columns, at right angles, in the surface's plane.
    """

    reflectances: Array
    origin_m: Array
    across_m: Array
    down_m: Array

    @property
    def mean(self) -> float:
        """Mean reflectance of a tile."""
        return float(self.reflectances.mean())

    def at_px(self, points_m: Array) -> Array:
        """Column and row (..., 2) of points (..., 3); (0, 0) is the first pixel's outer corner."""
        rows, columns = self.reflectances.shape
        sides = np.stack([self.across_m / (self.across_m**2).sum(), self.down_m / (self.down_m**2).sum()], axis=1)
        at: Array = (points_m - self.origin_m) @ sides * np.array([columns, rows])
        return at

    def means(self, first_m: Array, last_m: Array) -> Array:
        """Mean reflectance of rectangles (n,) with sides along the tile's, of which two opposite corners are given."""
        a, b = self.at_px(first_m), self.at_px(last_m)
        (x0, y0), (x1, y1) = np.minimum(a, b).T, np.maximum(a, b).T
        total = self._sum_to(x1, y1) - self._sum_to(x0, y1) - self._sum_to(x1, y0) + self._sum_to(x0, y0)
        means: Array = total / ((x1 - x0) * (y1 - y0))
        return means

    @cached_property
    def _sums(self) -> Array:
        """Sum of all reflectances above and left of each pixel corner, (rows + 1, columns + 1)."""
        return np.pad(self.reflectances.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))

    def _sum_to(self, x: Array, y: Array) -> Array:
        """Integral of the repeated image from (0, 0) to (x, y), in pixels."""
        rows, columns = self.reflectances.shape
        tile_x, tile_y = np.floor(x / columns), np.floor(y / rows)
        x, y = x - tile_x * columns, y - tile_y * rows
        whole = self._sums[-1, -1]
        to_x, to_y = self._within(x, np.full_like(y, rows)), self._within(np.full_like(x, columns), y)
        total: Array = tile_x * tile_y * whole + tile_y * to_x + tile_x * to_y + self._within(x, y)
        return total

    def _within(self, x: Array, y: Array) -> Array:
        rows, columns = self.reflectances.shape
        i, j = np.minimum(x.astype(int), columns - 1), np.minimum(y.astype(int), rows - 1)
        fx, fy, s = x - i, y - j, self._sums
        top = s[j, i] + fx * (s[j, i + 1] - s[j, i])
        below = s[j + 1, i] + fx * (s[j + 1, i + 1] - s[j + 1, i])
        within: Array = top + fy * (below - top)
        return within


def read_reflectances(path: Path, where: str) -> Array:
    """A grey PNG's values as reflectances, (rows, columns): 0 to 255, or 0 to 65535, is 0 to 1, linearly, no gamma.

    Raises InputError, which starts with `where`, for what is missing, no PNG, not grey or larger than MOST_PIXELS.
    """
    from PIL import Image, UnidentifiedImageError  # loaded only where a scene has a texture

    if not path.is_file():
        raise InputError(f"{where}: no such file from the scene's folder")
    try:
        with Image.open(path, formats=["PNG"]) as image:
            if image.width * image.height > MAX_PIXELS:
                raise InputError(
                    f"{where}: is {image.width} x {image.height} pixels; at most {MAX_PIXELS} in all are allowed"
                )
            if image.mode not in LARGEST:
                raise InputError(f"{where}: is no grey image of 8 or 16 bits without transparency")
            values = np.asarray(image, dtype=np.float64) / LARGEST[image.mode]
    except InputError:
        raise
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{where}: is no PNG that can be read: {' '.join(str(error).split())[:120]}") from None
    return values


LARGEST = {"L": 255, "I;16": 65535, "I": 65535}
"""By Pillow's mode of grey images, the value of a reflectance of 1."""
