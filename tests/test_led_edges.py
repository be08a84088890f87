"""Parts of the pixels at an LED's edge, against the pixels of a camera with finer pixels."""

import numpy as np
import pytest

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.core.planar_shapes import Disc, Rectangle
from vlcrender.rendering.led_coverage import LedFace, coverage_of_led
from vlcrender.rendering.led_edges import edges_of_led

SPLIT = 8
SMALL = {"width_px": 64, "height_px": 48, "pixel_pitch_um": 40.0, "focal_length_mm": 3.0}
FINE = {"width_px": 64 * SPLIT, "height_px": 48 * SPLIT, "pixel_pitch_um": 40.0 / SPLIT, "focal_length_mm": 3.0}
LENSES = {
    "pinhole": {},
    "distorted": {"distortion": Distortion(k1=-0.2, p1=0.01)},
    "fish-eye": {"projection": "equidistant"},
}


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("shape", [Disc(0.2), Rectangle((0.3, 0.2), 20.0)], ids=["disc", "rectangle"])
def test_parts_are_the_pixels_of_a_finer_camera(lens: dict, shape: Disc | Rectangle) -> None:
    pose, center_m = Pose((1.0, 1.0, 0.5), 6, -8, 30), np.array([1.3, 0.9, 2.5])
    camera, fine = Camera(**SMALL, **lens), Camera(**FINE, **lens)
    image = coverage_of_led(PosedCamera(camera, pose), LedFace(center_m, shape), 10)
    finer = coverage_of_led(PosedCamera(fine, pose), LedFace(center_m, shape), 10 * SPLIT)
    assert image is not None
    assert finer is not None
    edges = edges_of_led(PosedCamera(camera, pose), LedFace(center_m, shape), image, SPLIT)
    assert len(edges.rows) > 10
    drawn = np.zeros(((48 + 40) * SPLIT, (64 + 40) * SPLIT))
    top, left = finer.roi.row + 20 * SPLIT, finer.roi.column + 20 * SPLIT
    drawn[top : top + finer.coverage.shape[0], left : left + finer.coverage.shape[1]] = finer.coverage
    parts = drawn.reshape(48 + 40, SPLIT, 64 + 40, SPLIT).swapaxes(1, 2)[edges.rows + 20, edges.columns + 20]
    # areas of parts of 1/8 px, rounded to 2^-52 of the disc's, of which they are some 1e-4; COVERAGE_TOLERANCE is 1e-9
    assert np.abs(edges.excess - (parts - parts.mean(axis=(1, 2), keepdims=True))).max() < 5e-9
    # in every other pixel all parts have the same coverage
    whole = drawn.reshape(48 + 40, SPLIT, 64 + 40, SPLIT).swapaxes(1, 2)
    spread = whole.max(axis=(2, 3)) - whole.min(axis=(2, 3))
    spread[edges.rows + 20, edges.columns + 20] = 0
    assert spread.max() < 1e-8
