"""The room as Mitsuba sees it: what is behind a window is seen through it, wherever the window is."""

import numpy as np
import pytest

from vlcrender.core.backend import dr, mi
from vlcrender.light.mitsuba_room import glazing_shape, outside_shape
from vlcrender.scene.surfaces import Glazing

SIDE_M = 2.0
OUTSIDE_CD_M2 = 1000.0


def seen_cd_m2(away_m: float, angle_deg: float, across_m: np.ndarray) -> np.ndarray:
    """Luminance along rays through points of a window `away_m` from the origin on all axes, (points,).

    The window is in the plane x = `away_m` and faces -x. The points are `across_m` from its middle along y; the rays
    are at `angle_deg` to its normal.
    """
    glazing = Glazing(
        "window",
        np.full(3, away_m),
        np.array([0.0, 0.0, SIDE_M]),
        np.array([0.0, SIDE_M, 0.0]),
        OUTSIDE_CD_M2,
        1.52,
    )
    assert np.allclose(glazing.normal, [-1, 0, 0])
    scene = mi.load_dict(
        {"type": "scene", "glass": glazing_shape(glazing), "outside": outside_shape(glazing)}, optimize=False
    )
    angle = np.radians(angle_deg)
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    through = np.array([away_m, away_m + SIDE_M / 2, away_m + SIDE_M / 2]) + np.outer(across_m, [0.0, 1.0, 0.0])
    origins = through - 1.5 * direction
    rays = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(*direction.tolist()))
    glass = scene.ray_intersect(rays)
    behind = scene.ray_intersect(glass.spawn_ray(rays.d))
    glow = dr.select(behind.is_valid(), behind.shape.eval_attribute_1("vertex_glow", behind), 0.0)
    first = np.array(dr.select(glass.is_valid(), glass.shape.eval_attribute_1("vertex_glow", glass), -1.0))
    assert (first == 0).all(), "the glass is met first"
    return np.array(glow)


@pytest.mark.parametrize("away_m", [0.0, 10.0, 100.0, 1000.0])
@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 60.0, 80.0])
def test_the_outdoors_are_seen_through_a_window_far_from_the_origin(away_m: float, angle_deg: float) -> None:
    """To float32's 1e-7 in an interpolated luminance. Mitsuba lifts a ray off what it has met by 9e-5 of the largest
    coordinate: 1 mm behind a window 10 m away nothing is seen.
    """
    across_m = np.linspace(-0.49, 0.49, 99) * SIDE_M
    np.testing.assert_allclose(seen_cd_m2(away_m, angle_deg, across_m), OUTSIDE_CD_M2, rtol=1e-6)


def test_the_outdoors_are_seen_through_the_edge_of_a_window() -> None:
    """Obliquely through the last 0.1 mm of either side; 10 m away, the outdoors are some centimetres behind."""
    across_m = np.array([-0.5, 0.5]) * SIDE_M + [1e-4, -1e-4]
    np.testing.assert_allclose(seen_cd_m2(10.0, 80.0, across_m), OUTSIDE_CD_M2, rtol=1e-6)
