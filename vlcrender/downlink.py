"""What a demodulator would say of the spots in a frame: which LED each is, and roughly where.

Stands where true demodulation of the LEDs' flicker will stand; the identities are always right.
"""

import numpy as np

from vlcrender.render import LedPatch

ROUGH_PX = 10.0
"""Standard deviation of a decoded spot's pixel on the 4000-pixel-wide sensor; scales with the width."""
DECODABLE_FRACTION = 0.5
"""An LED of which less is on the sensor is not decoded."""


def decoded_spots(
    patches: tuple[LedPatch, ...], width_px: int, height_px: int, generator: np.random.Generator
) -> list[dict[str, int | float]]:
    """Identities with rough pixels, one dict (led, u_px, v_px) a decoded LED, sorted by LED id."""
    sigma = ROUGH_PX * width_px / 4000
    spots: list[dict[str, int | float]] = []
    for patch in sorted(patches, key=lambda patch: patch.led_id):
        error_u, error_v = sigma * generator.standard_normal(2)
        u, v = patch.center_px
        if patch.visible_fraction < DECODABLE_FRACTION or not (0 <= u < width_px and 0 <= v < height_px):
            continue
        rough_u = float(np.clip(u + error_u, 0, width_px))
        rough_v = float(np.clip(v + error_v, 0, height_px))
        spots.append({"led": patch.led_id, "u_px": rough_u, "v_px": rough_v})
    return spots
