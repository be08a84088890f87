"""A mosaic of colour filters on the pixels: each pixel sees the view through its own."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vlcrender.quantum_efficiency import COLOURS
from vlcrender.view import Image, LedPatch, Reflection, View, ViewPart
from vlcrender.windows import Window


def colour_of_pixels(mosaic: str, window: Window) -> NDArray[np.intp]:
    """Index into COLOURS of each pixel of a window, (rows, columns). `mosaic` as in `sensor.Sensor`, such as "rggb"."""
    tile = np.array([[colour[0] for colour in COLOURS].index(letter) for letter in mosaic]).reshape(2, 2)
    rows = np.arange(window.row, window.row + window.rows) % 2
    columns = np.arange(window.column, window.end_column) % 2
    pixels: NDArray[np.intp] = tile[rows[:, None], columns]
    return pixels


def mosaicked(views: Sequence[View], mosaic: str) -> View:
    """What a sensor with a mosaic has of a view; `views` are one of all pixels under each of COLOURS.

    They include the lens's blur, which comes before the filters.
    """
    parts = []
    for of_colours in zip(*(view.parts for view in views), strict=True):
        first = of_colours[0]
        background = _picked([part.background_e_per_s for part in of_colours], mosaic, first.window)
        patches = tuple(
            LedPatch(
                led_id=same[0].led_id,
                center_px=same[0].center_px,
                row=same[0].row,
                column=same[0].column,
                electrons_per_s=_picked([patch.electrons_per_s for patch in same], mosaic, same[0].window),
                visible_fraction=same[0].visible_fraction,
                imaged_fraction=same[0].imaged_fraction,
            )
            for same in zip(*(part.patches for part in of_colours), strict=True)
        )
        reflections = tuple(
            Reflection(r.led_id, r.row, r.column, r.electrons_per_s * (colour_of_pixels(mosaic, r.window) == colour))
            for colour, part in enumerate(of_colours)
            for r in part.reflections
        )
        parts.append(ViewPart(first.window, background, patches, reflections))
    return View(tuple(parts))


def _picked(images: Sequence[Image], mosaic: str, window: Window) -> Image:
    """Of each pixel of a window the image of its colour."""
    picked: Image = np.take_along_axis(np.stack(images), colour_of_pixels(mosaic, window)[None], axis=0)[0]
    return picked
