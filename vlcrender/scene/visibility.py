"""LEDs in view of a pose, and visibility: the share of poses with enough LEDs in view."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vlcrender.camera.intrinsics import Camera, Pose, transform
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.core.random_keys import stream
from vlcrender.scene.loader import Scene

LEVEL_GRID = 350
"""Positions along x and along y, as in Table 1 of Huynh & Yoo 2016: 7 m in steps of 0.02 m."""
TILTED_POSES = 5_000
"""Random poses of `tilted_visibility`."""
TILT_LIMIT_DEG = 60.0
"""Largest tilt of `tilted_visibility` about each axis."""
SAME_HEIGHT = 1e-4
"""Relative difference below which two heights count as equal."""
ENOUGH_LEDS = 4
"""LEDs in view that count as enough for a position."""


@dataclass(frozen=True)
class Visibility:
    """Count of poses with ENOUGH_LEDS LEDs or more in view."""

    height_m: float
    """Height of all poses above the floor."""
    attitude: str
    """Orientation of the poses, in words."""
    poses: int
    """Number of poses."""
    seen: int
    """Poses with enough LEDs in view."""

    @property
    def share(self) -> float:
        """Share of poses with enough LEDs in view, 0 to 1."""
        return self.seen / self.poses


def leds_in_view(posed: PosedCamera, scene: Scene, margin_px: float = 0.0) -> NDArray[np.int64]:
    """Indices of the LEDs whose whole face (a square's circle) is on the sensor, `margin_px` or more inside."""
    leds, camera = scene.leds, posed.camera
    near = leds.spheres.candidates(posed)
    candidates = near[_on_sensor(camera, posed.camera_coordinates(leds.centers_m[near]))]
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    # The 24-gon about the circle: a sensor that contains it contains the circle.
    points = leds.centers_m[candidates, None, :] + rim * (
        leds.circumradii_m[candidates, None, None] / np.cos(np.pi / 24)
    )
    pixels = posed.project(points)
    inside = (pixels >= margin_px) & (pixels <= np.array([camera.width_px, camera.height_px]) - margin_px)
    visible: NDArray[np.int64] = candidates[inside.all(axis=(-1, -2))]
    return visible


def can_occlude_leds(scene: Scene) -> bool:
    """Whether anything in a scene can hide an LED: furniture, frames of panels, or a panel lower than an LED."""
    panels = scene.settings.panels
    lowest_m = min((grid.first_center_m[2] for grid in panels), default=np.inf)
    return (
        bool(scene.settings.furniture)
        or any(grid.frame is not None for grid in panels)
        or bool(lowest_m < scene.leds.centers_m[:, 2].max() * (1 - SAME_HEIGHT))
    )


def level_visibility(camera: Camera, scene: Scene, height_m: float, yaw_deg: float) -> Visibility:
    """Visibility of LED centres over level poses at the cell centres of a LEVEL_GRID x LEVEL_GRID grid of the floor."""
    room = scene.room_m
    x = (np.arange(LEVEL_GRID) + 0.5) * room[0] / LEVEL_GRID
    y = (np.arange(LEVEL_GRID) + 0.5) * room[1] / LEVEL_GRID
    positions = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((LEVEL_GRID, LEVEL_GRID), height_m)], axis=-1)
    positions = positions.reshape(-1, 3)
    pose = Pose((0.0, 0.0, 0.0), yaw_deg=yaw_deg)
    size = np.array([camera.width_px, camera.height_px])
    corners = PosedCamera(camera, pose).rays_world(size * np.array([[0, 0], [1, 0], [0, 1], [1, 1]]))
    with np.errstate(divide="ignore"):
        slopes = np.where(corners[:, 2:] > 0, corners[:, :2] / corners[:, 2:], np.inf)
    tree = cKDTree(positions[:, :2])
    counts = np.zeros(len(positions), dtype=np.int64)
    for center in scene.leds.centers_m[scene.leds.centers_m[:, 2] > height_m]:
        radius_m = np.hypot(slopes[:, 0], slopes[:, 1]).max() * (center[2] - height_m)
        near = np.array(tree.query_ball_point(center[:2], radius_m), dtype=np.int64)
        counts[near] += _on_sensor(camera, transform(pose.rotation, center - positions[near]))
    side = "x" if yaw_deg == 0 else "y"
    return Visibility(height_m, f"level, long side along {side}", len(positions), int((counts >= ENOUGH_LEDS).sum()))


def tilted_visibility(camera: Camera, scene: Scene, height_m: float) -> Visibility:
    """Visibility of LED centres over random poses: any position, 0 to TILT_LIMIT_DEG about both axes, any yaw."""
    generator = stream(0, 0, "tilted-coverage")
    room = scene.room_m
    positions = np.stack(
        [
            generator.uniform(0, room[0], TILTED_POSES),
            generator.uniform(0, room[1], TILTED_POSES),
            np.full(TILTED_POSES, height_m),
        ],
        axis=1,
    )
    angles = generator.uniform([0, 0, -180], [TILT_LIMIT_DEG, TILT_LIMIT_DEG, 180], (TILTED_POSES, 3))
    counts = np.zeros(TILTED_POSES, dtype=np.int64)
    for i, (position, triple) in enumerate(zip(positions.tolist(), angles.tolist(), strict=True)):
        posed = PosedCamera(camera, Pose(tuple(position), *triple))
        near = scene.leds.spheres.candidates(posed)
        counts[i] = _on_sensor(camera, posed.camera_coordinates(scene.leds.centers_m[near])).sum()
    attitude = f"tilted 0 to {TILT_LIMIT_DEG:.0f} deg on both axes"
    return Visibility(height_m, attitude, TILTED_POSES, int((counts >= ENOUGH_LEDS).sum()))


def _on_sensor(camera: Camera, p_cam: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether points in camera axes (n, 3) are imaged on the sensor, shape (n,)."""
    pixels = camera.image_of_points(p_cam)  # NaN, which is on no side of a border, where the lens does not image
    tolerance = 1e-6  # a point on the border counts, whichever way its last digit rounds
    size = np.array([camera.width_px, camera.height_px])
    seen = ((pixels >= -tolerance) & (pixels <= size + tolerance)).all(axis=1)
    return np.asarray(seen, dtype=np.bool_)
