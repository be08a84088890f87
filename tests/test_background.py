"""Pixels of the background where surfaces meet: which they are, and where their rays are cast."""

import numpy as np
import pytest

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import mounted_cameras
from vlcrender.dataset.recipe.motion import Motion, poses_during
from vlcrender.rendering import background
from vlcrender.rendering.background import EDGE_GRID, differs_from_neighbour, sub_pixels
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene


@pytest.mark.parametrize("row", range(4))
@pytest.mark.parametrize("column", range(4))
def test_a_pixel_of_another_surface_and_its_eight_neighbours_are_edges(row: int, column: int) -> None:
    """Also across corners: a surface may enter a pixel there."""
    labels = np.full((4, 4), 3)
    labels[row, column] = 5
    rows, columns = np.indices((4, 4))
    near = (np.abs(rows - row) <= 1) & (np.abs(columns - column) <= 1)
    assert np.array_equal(differs_from_neighbour(labels), near)
    assert not differs_from_neighbour(np.full((4, 4), 3)).any()


def test_the_rays_of_an_edge_pixel_are_a_centred_grid_in_it() -> None:
    """Rows before columns, pixel by pixel; their mean is the pixel's centre, and each stands for as large a part."""
    u, v = (x.numpy().reshape(2, EDGE_GRID, EDGE_GRID) for x in sub_pixels(np.array([7, 2]), np.array([5, 300])))
    inside = (np.arange(EDGE_GRID) + 0.5) / EDGE_GRID
    for number, (row, column) in enumerate(((7, 5), (2, 300))):
        assert np.array_equal(u[number], np.broadcast_to(column + inside, u[number].shape))
        assert np.array_equal(v[number], np.broadcast_to(row + inside[:, None], v[number].shape))


@pytest.mark.parametrize("speed_m_s", [0.0, 0.4])
def test_edges_have_the_same_bits_however_many_are_cast_at_once(
    table1: Scene, small_camera: Camera, monkeypatch: pytest.MonkeyPatch, speed_m_s: float
) -> None:
    """Batches keep memory flat and change no frame, also where the rays of a pixel have times of their own."""
    pose = Pose((0.3, 1.9, 0.5))
    motion = Motion(linear_velocity_m_s=(speed_m_s, 0.0, 0.0)) if speed_m_s else None
    during = poses_during(motion, mounted_cameras(small_camera, ())[0], pose, 0.01, table1)
    renderer = Renderer(table1)

    def electrons(batch: int) -> np.ndarray:
        monkeypatch.setattr(background, "EDGE_BATCH", batch)
        return renderer.expected_image(PosedCamera(small_camera, pose), None, during).expected_electrons(0.01)

    together = electrons(2**14)
    assert np.array_equal(electrons(100), together)
    monkeypatch.setattr(background, "EDGE_GRID", 1)
    assert not np.array_equal(electrons(100), together), "no pixel of the view has an edge"
