"""Correspondences: what of a frame detection and identification are told."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from estimator_synthetic import Array, View, render, view_of
from test_estimator_maximum_likelihood import frame_of

from estimator.io.device import DecodedSpot, DeviceFrame, Part
from estimator.io.led_map import Led, SquareLed
from estimator.spots.correspondences import centroids_px, find_correspondences, led_positions_m
from estimator.spots.denoise import Denoiser
from estimator.spots.detect import detect
from estimator.spots.led_light import Readout
from estimator.spots.sampling import sampling_variance_px2

TARGET = (3.5, 3.6, 3.5)
LEDS = np.array(TARGET) + [[-0.04, 0.0, 0.0], [0.05, 0.02, 0.0]]
VIEW = view_of(TARGET, 3.0, 10.0, 5.0, 30.0, size=(120, 100, 1500.0))


def rendered(view: View = VIEW, leds_m: Array = LEDS) -> DeviceFrame:
    return frame_of(view, leds_m, np.rint(render(view, leds_m, 0.01)).astype(np.uint32))


def squares(frame: DeviceFrame) -> DeviceFrame:
    """The map with squares in place of discs, and the image unchanged."""
    leds: dict[int, Led] = {
        key: SquareLed(id=key, position_m=led.position_m, side_m=0.02) for key, led in frame.leds.items()
    }
    return replace(frame, leds=leds)


def with_crosstalk(frame: DeviceFrame) -> DeviceFrame:
    return replace(frame, sensor=frame.sensor.model_copy(update={"crosstalk": 0.2}))


def full_noise(frame: DeviceFrame) -> DeviceFrame:
    values = {"noise": "full", "read_noise_e": 20.0, "dsnu_e": 15.0, "prnu": 0.02}
    return replace(frame, sensor=frame.sensor.model_copy(update=values))


@pytest.mark.parametrize(
    ("changed", "noise", "any_square", "crosstalk"),
    [
        pytest.param(lambda frame: frame, (0.0, 0.0, 0.0), False, 0.0, id="shot noise"),
        # 20^2 + 15^2 and rounding.
        pytest.param(full_noise, (625.0 + 1 / 12, 0.02, 1 / 12), False, 0.0, id="full noise"),
        pytest.param(squares, (0.0, 0.0, 0.0), True, 0.0, id="squares"),
        pytest.param(with_crosstalk, (0.0, 0.0, 0.0), False, 0.2, id="crosstalk"),
    ],
)
def test_detection_is_told_the_sensor_s_noise_and_the_leds_shape(
    changed: Callable[[DeviceFrame], DeviceFrame],
    noise: tuple[float, float, float],
    any_square: bool,
    crosstalk: float,
) -> None:
    frame = changed(rendered())
    image = frame.parts[0].image_dn.astype(np.float32)
    readout = Readout(0, 0, image, image, np.zeros(image.shape, bool), *noise)
    expected = {
        round(spot.u_px): spot for spot in detect([readout], image.size, 0, any_square=any_square, crosstalk=crosstalk)
    }
    found = find_correspondences(frame)
    assert [one.led.id for one in found] == [10, 11]
    np.testing.assert_array_equal(led_positions_m(found), LEDS)
    for one, (u, v) in zip(found, centroids_px(found), strict=True):
        spot = expected[round(u)]
        assert (u, v) == pytest.approx((spot.u_px, spot.v_px), abs=1e-12)
        np.testing.assert_allclose(one.spot.covariance_px2, spot.covariance_px2, rtol=1e-12)


def test_a_denoised_image_is_measured_and_the_raw_one_weighs_it() -> None:
    """Doubled light has the same centroid; its covariance is by the raw electrons, over four times the flux squared.

    The variance that the correction for sampling leaves is in both: it is less than without a correction, at a half
    extent of 5 px.
    """
    rest_px2 = sampling_variance_px2(np.array([5.0]), square=False)[0]
    frame = rendered()
    plain, doubled = find_correspondences(frame), find_correspondences(frame, Denoiser(lambda raw_e, _: 2 * raw_e, 0))
    np.testing.assert_allclose(centroids_px(doubled), centroids_px(plain), atol=1e-6)
    for one, other in zip(plain, doubled, strict=True):
        np.testing.assert_allclose(4 * other.spot.covariance_px2, one.spot.covariance_px2, rtol=1e-6, atol=4 * rest_px2)
        assert 4 * rest_px2 < 0.5 * one.spot.covariance_px2[0, 0]


def test_leds_are_found_beside_brighter_lights() -> None:
    """A lamp that is not decoded, and one of three LEDs, are fifty times brighter than the others: the scale of
    brightness is the median near the decoded pixels, so that a twentieth of it is below the others.
    """
    view = view_of(TARGET, 3.0, size=(300, 260, 1500.0))
    leds_m = np.array(TARGET) + [[-0.2, -0.1, 0], [0.0, -0.1, 0], [0.2, -0.1, 0], [0.1, 0.15, 0]]
    image = render(view, leds_m, 0.01, [1000.0, 50000.0, 1000.0, 50000.0])
    frame = frame_of(view, leds_m, np.rint(image).astype(np.uint32))
    frame = replace(frame, spots=frame.spots[:3])
    assert [one.led.id for one in find_correspondences(frame)] == [10, 11, 12]


def test_a_region_s_place_on_the_sensor_counts() -> None:
    frame = rendered()
    whole = centroids_px(find_correspondences(frame))
    moved = replace(
        frame,
        parts=(Part(7, 11, frame.parts[0].image_dn),),
        spots=tuple(DecodedSpot(led=one.led, u_px=one.u_px + 11, v_px=one.v_px + 7) for one in frame.spots),
    )
    np.testing.assert_allclose(centroids_px(find_correspondences(moved)), whole + [11, 7], atol=1e-9)
