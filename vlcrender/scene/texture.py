"""Textures: grey values of a PNG as reflectances, repeated tile by tile, and exact means over rectangles.

Reflectance is linear between the centres of the image's pixels. Means take each pixel as a square of one reflectance:
this conserves energy and differs from the linear form by a blur of half a pixel.
"""

import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.errors import InputError

Array = NDArray[np.float64]

MAX_PIXELS = 4_000_000
"""Largest number of pixels of an image; its table of sums takes 32 bytes a pixel."""
GREY_MODES = ("L", "I;16", "I")
"""Pillow's modes of grey images of 8 and of 16 bits."""


@dataclass(frozen=True)
class Texture:
    """An image of reflectances, repeated tile by tile in the plane of a surface."""

    reflectances: Array
    """Reflectances of one tile, (rows, columns), 0 to 1."""
    origin_m: Array
    """Position of the first pixel's outer corner, (3,), world."""
    across_m: Array
    """Side of a tile along the image's rows, (3,), world."""
    down_m: Array
    """Side of a tile along the image's columns, (3,), world; at a right angle to `across_m`."""

    @property
    def mean(self) -> float:
        """Mean reflectance."""
        return float(self.reflectances.mean())

    def at_px(self, points_m: Array) -> Array:
        """Column and row (..., 2) of points (..., 3); (0, 0) is the first pixel's outer corner."""
        rows, columns = self.reflectances.shape
        sides = np.stack([self.across_m / (self.across_m**2).sum(), self.down_m / (self.down_m**2).sum()], axis=1)
        at: Array = (points_m - self.origin_m) @ sides * np.array([columns, rows])
        return at

    def means(self, first_m: Array, last_m: Array) -> Array:
        """Mean reflectances (n,) of rectangles with sides along the tile's, given by two opposite corners (n, 3)."""
        a, b = self.at_px(first_m), self.at_px(last_m)
        (x0, y0), (x1, y1) = np.minimum(a, b).T, np.maximum(a, b).T
        total = self._sum_to(x1, y1) - self._sum_to(x0, y1) - self._sum_to(x1, y0) + self._sum_to(x0, y0)
        means: Array = total / ((x1 - x0) * (y1 - y0))
        return means

    @cached_property
    def _sums(self) -> Array:
        """Sum of all reflectances above and to the left of each pixel corner, (rows + 1, columns + 1)."""
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
    """Reflectances (rows, columns) of a grey PNG: 0 to 255, or 0 to 65535, is 0 to 1, linearly, without gamma.

    Raises InputError that starts with `where` for a file that cannot be read or is no PNG, an image that is not grey or
    has transparency, and one of more than MAX_PIXELS pixels.
    """
    values = read_image(path, where, ("PNG",), GREY_MODES)
    return values.astype(np.float64) / (255 if values.dtype == np.uint8 else 65535)


def read_image(path: Path, where: str, formats: tuple[str, ...], modes: tuple[str, ...]) -> NDArray[Any]:
    """Values (rows, columns), or with a last axis of 3 colours, of an image: uint8, or uint16 of 16 bits.

    formats: PNG, JPEG; modes: Pillow's, of images without transparency. Raises InputError that starts with `where`.
    """
    from PIL import Image, UnidentifiedImageError  # loaded for scenes with a texture only

    kinds = " or ".join(formats)
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=formats) as image:
            if image.width * image.height > MAX_PIXELS:
                raise InputError(
                    f"{where}: has {image.width} x {image.height} pixels; at most {MAX_PIXELS} in all are allowed"
                )
            if image.mode not in modes or "transparency" in image.info:
                grey = "grey" if "RGB" not in modes else "grey or RGB"
                raise InputError(f"{where}: is no {grey} image of 8 or 16 bits without transparency")
            values = np.array(image)  # Mitsuba takes no read-only array
    except InputError:
        raise
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{where}: is no {kinds} that can be read: {' '.join(str(error).split())[:120]}") from None
    return values if values.dtype == np.uint8 else values.astype(np.uint16)
