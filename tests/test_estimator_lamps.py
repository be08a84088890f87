"""Correspondences of frames whose LEDs are modulated under a rolling shutter."""

import json
from dataclasses import replace

import numpy as np
import pytest
from estimator_synthetic import Array, View, grid, poisson, render, view_of
from striped_images import code, gains
from test_estimator_maximum_likelihood import frame_of

from estimator.camera.pose import Pose
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.io.downlink import Downlink
from estimator.io.shutter import Shutter
from estimator.solvers.observations import centroid_images
from estimator.spots.correspondences import centroids_px, find_correspondences
from estimator.spots.lamps import lamps_of, longest_dark_s

# A wide lens near the ceiling: LED images of 70 px, 25 deg off the axis, whose light is uneven.
TARGET = (3.5, 3.6, 3.5)
LEDS = grid(4, 3, 0.09, TARGET)
VIEW = view_of(TARGET, 0.45, 20.0, 12.0, 30.0, size=(1200, 900, 1600.0))
ROW_US, EXPOSURE_US, CHIP_US = 10.0, 40.0, 25.0
CODES = ["00001111010110010101100110100101", "01010011110000110010110101011010"]


def downlink() -> Downlink:
    sent = {"send": "code", "chip_us": CHIP_US, "depth": 1.0, "clock_error": 0.0, "leds": [10, 11], "codes": CODES}
    return Downlink.model_validate_json(json.dumps({"demodulation": "given", "transmitters": [sent]}))


def striped(expected: Array, view: View, led_gains: dict[int, Array]) -> Array:
    """The expected image with each LED's lines multiplied by its gains; LEDs do not touch."""
    image = expected.copy()
    for number, of_lines in led_gains.items():
        u, v = view.project(LEDS[number][None])[0]
        rows, columns = np.ogrid[: view.height_px, : view.width_px]
        near = (columns - u) ** 2 + (rows - v) ** 2 < 60**2
        lit = near * (expected - 40.0)
        image += lit * (of_lines[:, None] - 1)
    return image


def framed(image: Array, seed: int) -> DeviceFrame:
    frame = frame_of(VIEW, LEDS, poisson(image, seed))
    shutter = Shutter(kind="rolling", row_time_us=ROW_US, direction="down")
    camera = frame.camera.model_copy(update={"shutter": shutter})
    return replace(frame, camera=camera, downlink=downlink(), exposure_s=1e-6 * EXPOSURE_US)


@pytest.fixture(scope="module")
def expected() -> Array:
    return render(VIEW, LEDS, 0.01)


def test_the_longest_dark_run_of_a_code_counts_around_its_end() -> None:
    """The first code begins with four dark chips and ends with a bright one; the second ends and begins with one."""
    assert longest_dark_s(downlink()) == pytest.approx(4 * CHIP_US * 1e-6)


def test_spots_of_striped_led_images_are_the_centroids_of_their_light(expected: Array) -> None:
    """The uneven light of a lens moves centroids by up to 0.25 px here, along each direction of the image."""
    rng = np.random.default_rng(1)
    starts = np.arange(VIEW.height_px) * ROW_US
    waves = {k: 2 * gains(code(rng), CHIP_US, starts + 1e3 * rng.random(), EXPOSURE_US) for k in range(len(LEDS))}
    frame = framed(striped(expected, VIEW, waves), 2)
    found = find_correspondences(frame)
    assert len(found) == len(frame.spots) >= 10
    pose = Pose(np.array(VIEW.position_m), VIEW.R_cam_world)
    leds_m = np.array([one.led.position_m for one in found])
    image = centroid_images(pose, leds_m, np.array([4 * one.led.mean_square_extent_m2 for one in found]))[0]
    off = centroids_px(found) - frame.camera.to_pixels(image)
    assert np.abs(off).max() < 0.05
    # 12 LED images of 0.01 px each.
    assert np.abs(off.mean(axis=0)).max() < 0.01


def test_steady_led_images_have_the_centroids_of_a_global_shutter(expected: Array) -> None:
    rolling = framed(expected, 3)
    steady = replace(rolling, downlink=None)
    assert not any(lamp.striped for lamp in lamps_of(rolling))
    assert (centroids_px(find_correspondences(rolling)) == centroids_px(find_correspondences(steady))).all()


def test_a_dark_frame_has_no_led_image() -> None:
    with pytest.raises(EstimationFailure, match="detect: no LED image"):
        find_correspondences(framed(np.full((VIEW.height_px, VIEW.width_px), 40.0), 4))
