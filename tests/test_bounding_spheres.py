"""Spheres around LEDs that a camera may see: by blocks the same as one by one, whatever the order of the LEDs."""

import numpy as np
import pytest

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.scene.bounding_spheres import BLOCK, BoundingSpheres

LENSES = {"perspective": Camera(focal_length_mm=6.0), "fish-eye": Camera(projection="equidistant", focal_length_mm=2.0)}


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("order", ["panels", "mixed"])
def test_blocks_leave_out_no_sphere_that_may_be_seen(camera: Camera, order: str, rng: np.random.Generator) -> None:
    """A grid of 2 025 spheres, the last block not full, at two heights, some of them below the camera."""
    x, y = (index.ravel().astype(float) for index in np.meshgrid(np.arange(45), np.arange(45)))
    centers = np.column_stack([x, y, np.where(rng.uniform(size=x.size) < 0.2, 1.2, 3.5)])
    if order == "mixed":
        rng.shuffle(centers)
    spheres = BoundingSpheres(centers, rng.uniform(0.01, 0.3, len(centers)))
    assert len(centers) % BLOCK
    found = of_bands = 0
    for _ in range(30):
        pose = Pose((*rng.uniform(5, 40, 2).tolist(), 1.5), *rng.uniform(-30, 30, 2), rng.uniform(-180, 180))
        posed = PosedCamera(camera, pose)
        above = centers[:, 2] > 1.5
        one_by_one = np.flatnonzero(spheres._in_view(posed, camera.field_of_view(3.0)) & above)
        assert np.array_equal(spheres.candidates(posed, 3.0), one_by_one)
        found += len(one_by_one)
        u, v = posed.project(centers).T
        row = int(rng.uniform(0, camera.height_px - 80))
        band = spheres.candidates(posed, within=Roi(row, 0, 80, camera.width_px))
        in_band = (u >= 0) & (u < camera.width_px) & (v >= row) & (v < row + 80) & above
        assert set(np.flatnonzero(in_band)) <= set(band) <= set(one_by_one)
        of_bands += len(band)
    assert 30 < found < 30 * len(centers) / 2
    # A cone is about the axis, whatever the lines.
    assert of_bands < (0.5 if camera.projection == "perspective" else 1.01) * found
