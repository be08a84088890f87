"""Processed pictures: the image signal processing of a phone's software, for comparison with raw frames.

Black level subtraction, demosaicing, white balance, tone curve, 8 bits, JPEG. The noise no longer follows the sensor's
law: demosaicing and JPEG correlate neighbouring pixels, and the curve changes how it depends on the signal.
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
    """Settings of the processed pictures."""

    curve: Literal["srgb", "gamma"] = "srgb"
    """Tone curve: that of IEC 61966-2-1 (sRGB), or a power of 1 / `gamma`."""
    gamma: Annotated[float, Field(ge=1, le=5)] = 2.2
    """Exponent of the "gamma" curve."""
    format: Literal["jpeg", "png"] = "jpeg"
    """File format."""
    quality: Annotated[int, Field(ge=1, le=95)] = 90
    """JPEG quality on libjpeg's scale."""

    @property
    def suffix(self) -> str:
        """Suffix of the file names."""
        return {"jpeg": ".jpg", "png": ".png"}[self.format]

    def develop(
        self, image_dn: NDArray[np.uint32], sensor: Sensor, balance: tuple[float, float, float]
    ) -> NDArray[np.uint8]:
        """The picture of a full frame (rows, columns): 8 bits, (rows, columns), or (rows, columns, 3) with a mosaic.

        White is the sensor's `white_dn`. `balance` multiplies red, green and blue.
        """
        above_black = image_dn.astype(np.float64) - sensor.black_level_dn
        linear = above_black / (sensor.white_dn - sensor.black_level_dn)
        if sensor.mosaic != "none":
            from colour_demosaicing import demosaicing_CFA_Bayer_Malvar2004  # loads in seconds

            linear = np.asarray(demosaicing_CFA_Bayer_Malvar2004(linear, sensor.mosaic.upper())) * balance
        linear = np.clip(linear, 0.0, 1.0)
        if self.curve == "srgb":
            toned = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        else:
            toned = linear ** (1 / self.gamma)
        eight_bits: NDArray[np.uint8] = np.rint(255 * toned).astype(np.uint8)
        return eight_bits

    def write(self, path: Path, picture: NDArray[np.uint8]) -> None:
        """Write a picture made by `develop`."""
        options = {"quality": self.quality} if self.format == "jpeg" else {}
        Picture.fromarray(picture).save(path, self.format.upper(), **options)
