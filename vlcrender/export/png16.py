"""16-bit grey PNG: one image of the whole sensor a frame, digital numbers unscaled; images of other formats.

Pixels outside the regions of a set with `[regions]` are 0, and `masks/` has 255 where a pixel was read out.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vlcrender.export.source import Source


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write images/, and masks/ where only regions were read out."""
    for row in source.frames:
        write_png(out / "images" / f"{row.frame:06d}.png", *source.image_16bit(row), out / "masks")
    return {"image_bits": 16, "image_scale": 1.0, "pixels_not_read": 0}


def write_8bit(source: Source, out: Path, mask_suffix: str = ".png") -> Mapping[str, Any]:
    """Write images/ as 8-bit pictures, and masks/ named NAME + `mask_suffix`, for tools that read 8 bits."""
    for row in source.frames:
        image, is_read = source.image_8bit(row)
        write_png(out / "images" / f"{row.frame:06d}.png", image, is_read, out / "masks", mask_suffix)
    return {"image_bits": 8, "image_scale": source.scale_8bit, "pixels_not_read": 0}


def write_png(
    path: Path,
    pixels: NDArray[np.uint16] | NDArray[np.uint8],
    is_read: NDArray[np.bool_] | None,
    masks: Path | None,
    mask_suffix: str = ".png",
) -> None:
    """Write a grey image, and its mask into the folder `masks` where given."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    if is_read is not None and masks is not None:
        masks.mkdir(exist_ok=True)
        Image.fromarray(np.where(is_read, 255, 0).astype(np.uint8)).save(
            masks / (path.stem + mask_suffix), format="PNG"
        )
