"""What a demodulator would say of the spots in a frame: which LED each is, and roughly where.

Stands where true demodulation of the LEDs' flicker will stand; the identities are always right.
"""

from collections.abc import Sequence

import numpy as np

from vlcrender.rendering.expected_image import ExpectedRegion

ROUGH_PX = 10.0
"""Standard deviation of a decoded spot's pixel on the 4000-pixel-wide sensor; scales with the width."""
DECODABLE_FRACTION = 0.5
"""An LED of which less is in the image is not decoded."""


def decoded_spots(
    parts: Sequence[ExpectedRegion], width_px: int, generator: np.random.Generator
) -> list[dict[str, int | float]]:
    """Identities with rough pixels, one dict (led, u_px, v_px) a decoded LED, sorted by LED id.

    `width_px` is the whole sensor's. A rough pixel stays in the window that shows its LED.
    """
    sigma = ROUGH_PX * width_px / 4000
    seen = ((patch, part.roi) for part in parts for patch in part.patches)
    spots: list[dict[str, int | float]] = []
    for patch, roi in sorted(seen, key=lambda pair: pair[0].led_id):
        error_u, error_v = sigma * generator.standard_normal(2)
        u, v = patch.center_px
        inside = roi.column <= u < roi.end_column and roi.row <= v < roi.end_row
        if patch.imaged_fraction < DECODABLE_FRACTION or not inside:
            continue
        rough_u = float(np.clip(u + error_u, roi.column, roi.end_column))
        rough_v = float(np.clip(v + error_v, roi.row, roi.end_row))
        spots.append({"led": patch.led_id, "u_px": rough_u, "v_px": rough_v})
    return spots
