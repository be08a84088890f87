"""Decoded identities: rough pixels with the stated error, in the region of their LED, of LEDs that are in the frame."""

import numpy as np
import pytest

from vlcrender.camera.roi import Roi
from vlcrender.core.random_keys import stream
from vlcrender.dataset.world.downlink import decoded_spots
from vlcrender.rendering.expected_image import ExpectedRegion, LedPatch

COUNT = 1000


def patch(led: int, u: float, v: float, imaged: float = 1.0) -> LedPatch:
    """An LED of one pixel."""
    return LedPatch(led, (u, v), int(v), int(u), np.ones((1, 1), dtype=np.float32), 1.0, imaged)


def region(roi: Roi, *patches: LedPatch) -> ExpectedRegion:
    return ExpectedRegion(roi, np.zeros((1, 1), dtype=np.float32), patches)


@pytest.mark.parametrize(("width_px", "sigma_px"), [(4000, 10.0), (400, 1.0)])
def test_rough_pixels_err_by_10_px_on_a_sensor_of_4000(width_px: int, sigma_px: float) -> None:
    """Normal errors of both coordinates, in proportion to the width: standard deviations to 5 standard errors.

    A standard deviation of n normal numbers has the standard error sigma / sqrt(2 n), their mean sigma / sqrt(n).
    """
    middle = (width_px / 2, width_px / 3)
    whole = region(Roi(0, 0, width_px * 2 // 3, width_px), *(patch(led, *middle) for led in range(COUNT)))
    spots = decoded_spots([whole], width_px, stream(7, 0, "demodulator"))
    errors = np.array([(spot.u_px, spot.v_px) for spot in spots]) - middle
    assert errors.shape == (COUNT, 2)
    assert errors.std(axis=0, ddof=1) == pytest.approx(sigma_px, rel=5 / np.sqrt(2 * COUNT))
    assert np.abs(errors.mean(axis=0)).max() < 5 * sigma_px / np.sqrt(COUNT)
    assert abs(np.corrcoef(errors.T)[0, 1]) < 5 / np.sqrt(COUNT)


def test_a_rough_pixel_stays_in_the_region_of_its_led() -> None:
    """An LED in the corner of a region of 4 x 6 px: errors of 10 px end at the region's border."""
    roi = Roi(100, 200, 4, 6)
    parts = [region(roi, *(patch(led, 200.5, 100.5) for led in range(50)))]
    spots = decoded_spots(parts, 4000, stream(7, 0, "demodulator"))
    places = np.array([(spot.u_px, spot.v_px) for spot in spots])
    assert places.min(axis=0).tolist() == [200, 100]
    assert places.max(axis=0).tolist() == [206, 104]


def test_leds_with_half_of_their_image_and_their_centre_in_the_frame_are_decoded_by_id() -> None:
    roi = Roi(0, 0, 300, 400)
    parts = [
        region(roi, patch(9, 50.0, 50.0, 0.5), patch(4, 60.0, 50.0, 0.499), patch(6, 400.0, 50.0)),
        region(Roi(0, 500, 300, 400), patch(2, 510.0, 299.9), patch(3, 510.0, 300.0), patch(5, 499.9, 10.0)),
    ]
    spots = decoded_spots(parts, 400, stream(7, 0, "demodulator"))
    assert [spot.led for spot in spots] == [2, 9]


def test_an_led_that_is_not_decoded_leaves_the_errors_of_the_others_alone() -> None:
    roi = Roi(0, 0, 300, 400)
    spots = [
        decoded_spots(
            [region(roi, patch(1, 50.0, 50.0, share), patch(2, 90.0, 50.0))], 400, stream(7, 0, "demodulator")
        )
        for share in (1.0, 0.1)
    ]
    assert spots[0][1] == spots[1][0]
