"""Veiling glare of a lens: a share of the light, scattered into a halo around every bright point.

ISO 9358:1994 (Veiling glare of image-forming systems) names two measures: the glare spread function, which is the light
around the image of a point, and the veiling glare index, which is the light in the image of a small black spot in a
uniformly bright field over the light of the field. Here the glare spread function has a closed form, the profile of
A. F. J. Moffat, Astron. Astrophys. 3 (1969) 455,

    h(r) = (k - 1) / (pi r_0^2) * (1 + (r / r_0)^2)^-k,

whose integral over the plane is 1. The image is (1 - share) image + share (h * image): `share` is the veiling glare
index in an unbounded bright field of a spot much smaller than r_0. A bright field of radius R about the spot gives
share (1 - (1 + (R / r_0)^2)^(1 - k)).

The form with a power law far out is that of models of stray light in digital cameras (B. Bitlis, P. A. Jansson,
J. P. Allebach, Proc. SPIE 6498 (2007) 649804), without their dependence on the place in the field. Default values are
ours.
"""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.config.toml_model import Settings

Array = NDArray[np.float64]


class Glare(Settings):
    """Veiling glare: a halo with a share of the light. Only light that the lens images onto the sensor is scattered."""

    share: Annotated[float, Field(gt=0, le=0.5)]
    """Share of the light that goes into the halo, 0 to 0.5: the veiling glare index (ISO 9358) of a small black spot in
    an unbounded bright field."""
    radius_um: Annotated[float, Field(gt=0, le=1e5)] = 200.0
    """Radius r_0 of the halo's core on the sensor, um. At least 6 pixels and 1 % of the sensor's longer side."""
    exponent: Annotated[float, Field(ge=1.1, le=5)] = 1.5
    """Exponent k of the halo's fall-off (1 + (r / r_0)^2)^-k, 1.1 to 5. At 1.5, half of the halo's light is within
    1.7 r_0."""

    def spread_per_px2(self, r_px: Array, pixel_pitch_um: float) -> Array:
        """Share of a point's halo light that falls on a pixel `r_px` pixels away."""
        radius_px = self.radius_um / pixel_pitch_um
        at_center = (self.exponent - 1) / (np.pi * radius_px**2)
        spread: Array = at_center * (1 + (r_px / radius_px) ** 2) ** -self.exponent
        return spread
