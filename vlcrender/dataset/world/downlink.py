"""Decoded identities: which LEDs a frame shows, and roughly where.

A stand-in for demodulation of the LEDs' modulation; every identity is correct.
"""

from collections.abc import Sequence

import numpy as np

from vlcrender.dataset.format.rows import SpotRow
from vlcrender.rendering.expected_image import ExpectedRegion

ROUGH_PX = 10.0
"""Standard deviation of a decoded pixel on a sensor 4000 pixels wide; proportional to the width."""
MIN_IMAGED_FRACTION = 0.5
"""An LED is decoded where at least this share of its image is in the frame."""


def decoded_spots(
    parts: Sequence[ExpectedRegion], width_px: int, generator: np.random.Generator
) -> tuple[SpotRow, ...]:
    """Identities with rough pixels, sorted by LED id.

    `width_px` is the width of the whole sensor. A rough pixel stays in the region that shows its LED.
    """
    sigma = ROUGH_PX * width_px / 4000
    seen = ((patch, part.roi) for part in parts for patch in part.patches)
    spots = []
    for patch, roi in sorted(seen, key=lambda pair: pair[0].led_id):
        error_u, error_v = sigma * generator.standard_normal(2)
        u, v = patch.center_px
        inside = roi.column <= u < roi.end_column and roi.row <= v < roi.end_row
        if patch.imaged_fraction < MIN_IMAGED_FRACTION or not inside:
            continue
        rough_u = float(np.clip(u + error_u, roi.column, roi.end_column))
        rough_v = float(np.clip(v + error_v, roi.row, roi.end_row))
        spots.append(SpotRow(led=patch.led_id, u_px=rough_u, v_px=rough_v))
    return tuple(spots)
