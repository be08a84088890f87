"""Detection of LED images of a few pixels: which pixels are theirs, and what is their background."""

import numpy as np
import pytest
from estimator_synthetic import Array
from test_estimator_detect import blank, by_nearest, spots_of

from estimator.spots.detect import detect
from estimator.spots.led_light import Ellipse, Readout, light_of


def disc(u_px: float, v_px: float, radius_px: float, led_e: float) -> Array:
    """A disc on 60 x 60 px, by 20 x 20 samples a pixel."""
    at = (np.arange(1200) + 0.5) / 20
    inside = (at[None] - u_px) ** 2 + (at[:, None] - v_px) ** 2 <= radius_px**2
    return led_e * inside.reshape(60, 20, 60, 20).mean(axis=(1, 3))


def test_led_images_of_a_pixel_are_found_below_a_ceiling_at_a_hundredth_of_their_luminance() -> None:
    """The 5 x 5 mean of one pixel is a 25th of it: 5 % of that, 1/500, is less than the ceiling's 1/100."""
    led_e, wall_e, ceiling_e = 300_000.0, 10_000.0, 13_000.0
    image = np.full((120, 120), ceiling_e)
    image[:, :40] = wall_e  # a third of the outermost pixels: their darkest quarter
    image[50:115:8, 50:115:8] = led_e
    part = Readout(0, 0, image.astype(np.float32), image.astype(np.float32), np.zeros(image.shape, bool))
    v_px, u_px = np.mgrid[50:115:8, 50:115:8] + 0.5
    leds_px = np.column_stack([u_px.ravel(), v_px.ravel()])
    spots = list(detect([part], 120 * 160, 0, leds_px, near_px=4.0))
    assert len(spots) == len(leds_px)
    # Symmetric about each LED but for its neighbours, which are left out.
    np.testing.assert_allclose(by_nearest(spots, leds_px), 0.0, atol=1e-3)


def test_led_images_that_the_smoothing_merges_are_told_apart() -> None:
    """Discs of 2.3 px with centres 4.3 px apart: a dark column between them is dark before the 5 x 5 mean alone. What
    the pixels add to a centroid is up to 0.02 px (`estimator.spots.sampling`).
    """
    centres_px = [(20.5, 20.5), (24.8, 21.1), (29.1, 21.7)]
    image = blank(13_000.0) + sum(disc(u, v, 1.15, 400_000.0) for u, v in centres_px)
    spots = by_nearest(spots_of(image), np.array(centres_px))
    assert len(spots_of(image)) == len(centres_px)
    np.testing.assert_allclose(spots, 0.0, atol=0.02)


def test_an_uneven_background_does_not_move_the_centroid_of_a_small_led_image() -> None:
    """A fifth more light from 2 px beside the LED on, one step of a coarse ADC: the disc has 13 % of a pixel's light
    more for each of some ten pixels 3 px away, which would move the centroid by 0.02 px. A tenth of it is allowed.
    """
    even = blank(13_000.0) + disc(30.2, 30.4, 1.15, 400_000.0)
    uneven = even.copy()
    uneven[:, 33:] += 3_000.0
    (before,), (after,) = spots_of(even), spots_of(uneven)
    assert abs(after.u_px - before.u_px) < 2e-3


def test_the_background_of_a_small_led_image_is_that_beside_it() -> None:
    """A surface that is brighter by three quarters under the LED and 3 px around it, while the ring is beyond: 3 000
    electrons of some twenty pixels would be light of the LED, not evenly about the disc, and move it by 0.008 px,
    of which a quarter is allowed.
    """
    alone, on_a_surface = blank(4_000.0) + disc(30.2, 30.4, 1.15, 400_000.0), blank(4_000.0)
    on_a_surface[26:35, 27:35] += 3_000.0
    on_a_surface += disc(30.2, 30.4, 1.15, 400_000.0)
    (before,), (after,) = spots_of(alone), spots_of(on_a_surface)
    assert abs(after.u_px - before.u_px) < 2e-3
    assert abs(after.v_px - before.v_px) < 2e-3


def test_an_led_image_between_the_margins_of_others_has_its_background_subtracted() -> None:
    """Eight others 7 px away, whose margins hold all pixels of the ring: what is beyond their images is background."""

    def face(u_px: float, v_px: float) -> Ellipse:
        low_px, high_px = (u_px - 3.0, v_px - 3.0), (u_px + 3.0, v_px + 3.0)
        return Ellipse((u_px, v_px), (1.0, 0.0), (3.0, 3.0), low_px, high_px, 25, 1.0)

    others = [face(30.0 + du, 30.0 + dv) for du in (-7, 0, 7) for dv in (-7, 0, 7) if du or dv]
    image = (4_000.0 + disc(30.0, 30.0, 1.15, 400_000.0)).astype(np.float32)
    light = light_of(Readout(0, 0, image, image, np.zeros(image.shape, bool)), face(30.0, 30.0), others, 0)
    assert light.sums.flux == pytest.approx(float(disc(30.0, 30.0, 1.15, 400_000.0).sum()), rel=1e-6)


def test_noise_that_is_not_stated_hides_which_pixels_are_lit() -> None:
    """Noise of a quarter of the light, a hundred times the shot noise of its background: a tenth of the brightest pixel
    is below three of its standard deviations, and all of the support counts.
    """
    noise_e = np.random.default_rng(3).normal(0.0, 1_000.0, (60, 60))
    image = (100.0 + disc(30.2, 30.4, 5.5, 4_000.0) + noise_e).astype(np.float32)
    face = Ellipse((30.2, 30.4), (1.0, 0.0), (5.5, 5.5), (24.0, 24.0), (36.0, 36.0), 95, 1.0)
    light = light_of(Readout(0, 0, image, image, np.zeros(image.shape, bool)), face, [], 0)
    assert light.lit(0) == [light]
