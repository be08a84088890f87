"""A phone's processed image: what its software makes of the raw numbers. To look at, and to see what it costs.

Black level off, colours from the mosaic, white balance, a tone curve, 8 bits, JPEG. After it the noise is no longer
that of the sensor: neighbours share it, and the curve makes it depend on the signal in another way.
"""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Picture
from pydantic import Field

from vlcrender.config.toml_model import Settings
from vlcrender.sensor.sensor import Sensor


class Processed(Settings):
    """How the processed image is made."""

    curve: Literal["srgb", "gamma"] = "srgb"
    """That of IEC 61966-2-1, or a power of 1 / `gamma`."""
    gamma: Annotated[float, Field(ge=1, le=5)] = 2.2
    format: Literal["jpeg", "png"] = "jpeg"
    quality: Annotated[int, Field(ge=1, le=95)] = 90
    """Of JPEG, as libjpeg counts it."""

    @property
    def suffix(self) -> str:
        """Of the file's name."""
        return {"jpeg": ".jpg", "png": ".png"}[self.format]

    def develop(
        self, image_dn: NDArray[np.uint32], sensor: Sensor, balance: tuple[float, float, float]
    ) -> NDArray[np.uint8]:
        """The picture of a full frame (rows, columns): 8 bits, (rows, columns), with a mosaic (rows, columns, 3).

        White is what the full well or the converter ends at. `balance`: what red, green and blue are multiplied by.
        """
        above_black = image_dn.astype(np.float64) - sensor.black_level_dn
        linear = above_black / (sensor.white_dn - sensor.black_level_dn)
        if sensor.mosaic != "none":
            from colour_demosaicing import demosaicing_CFA_Bayer_Malvar2004  # takes seconds to load

            linear = np.asarray(demosaicing_CFA_Bayer_Malvar2004(linear, sensor.mosaic.upper())) * balance
        linear = np.clip(linear, 0.0, 1.0)
        if self.curve == "srgb":
            toned = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        else:
            toned = linear ** (1 / self.gamma)
        eight_bits: NDArray[np.uint8] = np.rint(255 * toned).astype(np.uint8)
        return eight_bits

    def write(self, path: Path, picture: NDArray[np.uint8]) -> None:
        """Write a picture that `develop` made."""
        options = {"quality": self.quality} if self.format == "jpeg" else {}
        Picture.fromarray(picture).save(path, self.format.upper(), **options)
