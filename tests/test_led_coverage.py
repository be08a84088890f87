"""Pixel coverage of discs and rectangles against closed forms and brute force."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.core.planar_shapes import Disc, Rectangle, circle_polygon_area, rectangle_polygon_area
from vlcrender.rendering.led_coverage import (
    CoverageBlocks,
    LedCoverage,
    LedFace,
    _coverage_of_band,
    coverage_of_led,
    outline_roi,
)
from vlcrender.scene.bounding_spheres import BoundingSpheres

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def image_of_disc(
    camera: Camera, pose: Pose, center_m: np.ndarray, radius_m: float, margin_px: int = 0
) -> LedCoverage | None:
    return coverage_of_led(PosedCamera(camera, pose), LedFace(center_m, Disc(radius_m)), margin_px)


def area(polygon: np.ndarray, radius: float) -> float:
    return float(circle_polygon_area(polygon[None], radius)[0])


@pytest.mark.parametrize(
    ("polygon", "radius", "expected"),
    [
        (SQUARE, 0.5, np.pi / 4),  # the disc is inside
        (SQUARE, 2.0, 4.0),  # the square is inside
        (SQUARE + [1, 1], 1.0, np.pi / 4),  # a quarter disc
        (SQUARE + [1, 0], 0.5, np.pi / 8),  # half a disc
        (SQUARE + [5, 0], 1.0, 0.0),  # apart
        (SQUARE[::-1] + [1, 1], 1.0, np.pi / 4),  # clockwise
        # the disc cuts off the vertices: 4 minus 4 of them; area = 4 sqrt(r2-1) + r2 (pi - 4 acos(1/r)), r2 = 1.25
        (SQUARE, np.sqrt(1.25), 4 * 0.5 + 1.25 * (np.pi - 4 * np.arccos(1 / np.sqrt(1.25)))),
    ],
)
def test_area_shared_by_disc_and_polygon(polygon: np.ndarray, radius: float, expected: float) -> None:
    assert area(polygon, radius) == pytest.approx(expected, abs=1e-12)


@given(
    st.floats(-2, 2),
    st.floats(-2, 2),
    st.floats(0.1, 2),
    st.floats(0, np.pi),
    st.floats(0.2, 3),
)
@example(x=0.0, y=1.0, radius=1.0, angle=3.8e-16, stretch=1.0)  # a vertex within rounding of the centre
@example(x=2.9e-9, y=2.9e-9, radius=1.0, angle=0.0, stretch=1.0)  # and near it
def test_areas_shared_with_parts_add_up(x: float, y: float, radius: float, angle: float, stretch: float) -> None:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    quad = (SQUARE * [stretch, 1]) @ turn.T + [x, y]
    middle = quad.mean(axis=0)
    parts = [
        np.array([quad[i], (quad[i] + quad[(i + 1) % 4]) / 2, middle, (quad[i] + quad[i - 1]) / 2]) for i in range(4)
    ]
    # sums of a few numbers below 10 in double precision
    assert sum(area(part, radius) for part in parts) == pytest.approx(area(quad, radius), abs=1e-9)


POSES = [
    Pose((3.0, 3.0, 0.5)),
    Pose((3.0, 2.0, 1.5), tilt_x_deg=-25.0, yaw_deg=10.0),
    Pose((2.0, 2.0, 1.8), tilt_x_deg=-30.0, tilt_y_deg=25.0, yaw_deg=4.0),
]


def aim(pose: Pose) -> np.ndarray:
    """The point 3.45 m high that a pose's optical axis meets."""
    axis = pose.rotation[2]
    return np.array(pose.position_m) + axis * (3.45 - pose.position_m[2]) / axis[2]


@pytest.mark.parametrize("pose", POSES, ids=["level", "tilted", "tilted twice"])
@pytest.mark.parametrize("pitch_um", [1.2, 12.0])
def test_coverage_adds_up_to_the_solid_angle_of_the_disc(pose: Pose, pitch_um: float) -> None:
    """sum over pixels of coverage * pixel solid angle = solid angle of the disc = A cos / d^2 (small disc)."""
    camera = Camera(width_px=int(4800 / pitch_um), height_px=int(3600 / pitch_um), pixel_pitch_um=pitch_um)
    center = aim(pose)
    radius = 0.01
    image = image_of_disc(camera, pose, center, radius)
    assert image is not None
    axis_pixel_sr = 1 / camera.focal_px**2
    to_led = center - np.array(pose.position_m)
    distance = np.linalg.norm(to_led)
    disc_sr = np.pi * radius**2 * (to_led[2] / distance) / distance**2
    # On the axis, cos^3 = 1 to (r f / h)^2; the small-disc formula is off by about (r / d)^2 too: 2e-5 together.
    assert image.coverage.sum() * axis_pixel_sr == pytest.approx(disc_sr, rel=1e-4)
    assert image.visible_fraction == 1.0


@pytest.mark.parametrize("pose", POSES, ids=["level", "tilted", "tilted twice"])
def test_each_pixels_coverage_is_the_share_of_its_area(pose: Pose, small_camera: Camera) -> None:
    center = aim(pose) + [0.011, 0.007, 0.0]
    image = image_of_disc(small_camera, pose, center, 0.03)
    assert image is not None
    n = 64
    rows, columns = image.coverage.shape
    u = image.roi.column + (np.arange(columns * n) + 0.5) / n
    v = image.roi.row + (np.arange(rows * n) + 0.5) / n
    # independent of the module: conic of the disc's image through the inverse homography of its plane
    r, t = pose.rotation, pose.rotation @ (center - np.array(pose.position_m))
    homography = np.linalg.inv(small_camera.matrix @ np.column_stack([r[:, 0], r[:, 1], t]))
    grid = np.stack([*np.meshgrid(u, v), np.ones((rows * n, columns * n))])
    x, y, w = np.einsum("ij,jrc->irc", homography, grid)
    inside = (x / w) ** 2 + (y / w) ** 2 < 0.03**2
    share = inside.reshape(rows, n, columns, n).mean(axis=(1, 3))
    error = (image.coverage - share)[(image.coverage > 0) & (image.coverage < 1)]
    # The grid's own error: about 0.3 / n^1.5 = 6e-4 rms over edges of any direction, of which a small disc has few,
    # so three times that; and at worst half a grid line, where the edge runs along one.
    assert np.sqrt((error**2).mean()) < 3 * 0.3 / n**1.5
    assert np.abs(error).max() < 0.5 / n
    assert ((image.coverage > 0.01) & (image.coverage < 0.99)).sum() > 20  # there were edges to test


@pytest.mark.parametrize("shape", [Disc(1.0), Rectangle((1.5, 2.0), 30.0)], ids=str)
@pytest.mark.parametrize(
    ("focal_px", "half_px", "change"),
    [(600.0, 1.3, 0.0146), (600.0, 5.0, 0.0146), (4000.0, 450.0, 0.0022)],
    ids=["two pixels", "ten pixels", "in blocks"],
)
def test_the_plane_is_smaller_on_the_near_side_of_a_pixel(
    shape: Disc | Rectangle, focal_px: float, half_px: float, change: float
) -> None:
    """A camera tilted by 71 deg, its axis on the LED: a pixel has 3 tan(71 deg) / f = g more of the plane than the one
    before it, which without the correction leaves an error of up to g / 8 where an edge is across it.

    Independent of the module: the outline's image, and the area that it shares with each pixel. The scale is the
    depth cubed: to first order about the centroid of a part, the terms left out are 2/3 g^2 x^2 with x^2 up to 1/4 px^2
    and half of (g / 4)^2; and g itself changes by g^2 / 3 a pixel, over the half size of the image.
    """
    pose = Pose((3.0, 3.0, 0.5), tilt_x_deg=45.0, tilt_y_deg=62.6, yaw_deg=10.0)
    camera = Camera(width_px=2400, height_px=2400, pixel_pitch_um=18e3 / focal_px, focal_length_mm=18.0)
    ray = pose.rotation[2]
    center = np.array(pose.position_m) + 3.0 / ray[2] * ray + [1e-4, 2e-4, 0.0]
    size_m = half_px * 3.0 / ray[2] / focal_px
    face = LedFace(center, Disc(size_m) if isinstance(shape, Disc) else Rectangle((1.5 * size_m, 2 * size_m), 30.0))
    image = coverage_of_led(PosedCamera(camera, pose), face)
    assert image is not None
    assert isinstance(image.pixels, CoverageBlocks) == (half_px > 100)
    rim = face.shape.rim(20_000 if isinstance(shape, Disc) else 4)
    outline = PosedCamera(camera, pose).project(np.column_stack([rim, np.zeros(len(rim))]) + center)
    edge_rows, edge_columns = np.nonzero((image.coverage > 0) & (image.coverage < 1))
    chosen = np.linspace(0, len(edge_rows) - 1, min(len(edge_rows), 200)).astype(int)
    errors = [
        image.coverage[row, column]
        - rectangle_polygon_area(
            (outline - (column + image.roi.column + 0.5, row + image.roi.row + 0.5))[None], 0.5, 0.5
        )[0]
        for row, column in zip(edge_rows[chosen], edge_columns[chosen], strict=True)
    ]
    # The polygon of a disc's rim lacks 1.6e-8 of the area.
    assert np.abs(errors).max() < change**2 * (1 / 6 + 1 / 32) + change**2 / 3 * half_px / 8 + 1e-5


def test_the_centroid_is_not_the_image_of_the_centre_when_tilted() -> None:
    """The ellipse's centre is off by about f r^2 sin cos.../h^2; only when level the two agree."""
    camera = Camera()
    offsets = []
    for pose in (POSES[0], POSES[2]):
        center = aim(pose)
        image = image_of_disc(camera, pose, center, 0.02)
        assert image is not None
        rows, columns = image.coverage.shape
        u = (image.coverage.sum(axis=0) * (image.roi.column + 0.5 + np.arange(columns))).sum() / image.coverage.sum()
        v = (image.coverage.sum(axis=1) * (image.roi.row + 0.5 + np.arange(rows))).sum() / image.coverage.sum()
        pixels = PosedCamera(camera, pose).project(center)
        offsets.append(float(np.hypot(u - pixels[0], v - pixels[1])))
    assert offsets[0] < 1e-6
    # f r^2 tan / d^2 with f = 15000, r = 0.02, d = 2.1, tan = 0.8: 1.1 px * cos^2 terms; half to double is the claim
    assert 0.3 < offsets[1] < 2.0


def test_visible_fraction_of_a_disc_cut_by_the_border() -> None:
    camera = Camera()
    # centre exactly on the left border: half is seen
    center = np.array([3.0 - 2000 * 3.0 / 15000, 3.0, 3.5])
    image = image_of_disc(camera, Pose((3.0, 3.0, 0.5)), center, 0.01)
    assert image is not None
    assert image.roi.column == 0
    assert image.visible_fraction == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize(
    ("center", "why"),
    [
        ([3.0, 3.0, 0.4], "behind"),
        ([5.0, 3.0, 3.5], "out of view"),
        ([3.0, 3.0, 0.5], "level with the lens"),
    ],
)
def test_a_disc_out_of_sight_has_no_image(center: list[float], why: str) -> None:
    assert image_of_disc(Camera(), Pose((3.0, 3.0, 0.5)), np.array(center), 0.01) is None, why


def test_a_face_at_the_height_of_the_lens_has_no_outline() -> None:
    """It shows its edge, which emits nothing; from 1 mm below, its whole face, however narrow."""
    face = LedFace(np.array([3.0, 4.0, 3.5]), Disc(0.05))
    level, below = (PosedCamera(Camera(), Pose((3.0, 3.0, height), tilt_x_deg=-85.0)) for height in (3.5, 3.499))
    assert outline_roi(below, face) is not None
    assert outline_roi(level, face) is None


def rectangle_area(polygon: np.ndarray, half_x: float, half_y: float) -> float:
    return float(rectangle_polygon_area(polygon[None], half_x, half_y)[0])


DIAMOND = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])


@pytest.mark.parametrize(
    ("polygon", "half", "expected"),
    [
        (SQUARE, (0.5, 0.25), 0.5),  # the rectangle is inside
        (SQUARE, (2.0, 3.0), 4.0),  # the square is inside
        (SQUARE, (1.0, 1.0), 4.0),  # the same
        (SQUARE + [1.5, 1.5], (1.0, 1.0), 0.25),  # vertices overlap
        (SQUARE + [2.0, 0.0], (1.0, 1.0), 0.0),  # they touch
        (SQUARE + [3.0, 3.0], (1.0, 1.0), 0.0),  # apart, beyond a vertex
        (SQUARE + [0.0, 1.0], (1.0, 1.0), 2.0),  # sides run along each other
        (DIAMOND, (0.5, 0.5), 1.0),  # its sides pass through the vertices
        (DIAMOND, (0.75, 0.75), 2 - 4 * 0.25**2),  # four vertices cut off
        (DIAMOND[::-1] + [1.0, 0.0], (1.0, 1.0), 1.0),  # clockwise; half of it
    ],
)
def test_area_shared_by_rectangle_and_polygon(polygon: np.ndarray, half: tuple[float, float], expected: float) -> None:
    assert rectangle_area(polygon, *half) == pytest.approx(expected, abs=1e-12)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.1, 2), st.floats(0.1, 2), st.floats(0, np.pi))
def test_areas_shared_with_parts_of_a_rectangle_add_up(x: float, y: float, w: float, h: float, angle: float) -> None:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    quad = SQUARE @ turn.T + [x, y]
    quarters = [quad - [i * w / 2, j * h / 2] for i in (-1, 1) for j in (-1, 1)]
    # sums of a few numbers below 10 in double precision
    total = sum(rectangle_area(quarter, w / 2, h / 2) for quarter in quarters)
    assert total == pytest.approx(rectangle_area(quad, w, h), abs=1e-9)


SMALL = {"width_px": 400, "height_px": 300, "pixel_pitch_um": 12.0}
LENSES = {
    "pinhole": Camera(**SMALL),
    "barrel": Camera(
        **SMALL,
        focal_length_mm=5.0,
        distortion=Distortion(k1=-0.3, k2=0.1, p1=0.005, p2=-0.004),
    ),
    "fish-eye": Camera(focal_length_mm=2.0, projection="equidistant"),
}


@pytest.mark.slow
@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("shape", [Disc(1.0), Rectangle((1.5, 1.5)), Rectangle((2.0, 1.0), 30.0)], ids=str)
@pytest.mark.parametrize("where", [(0.5, 0.5), (0.9, 0.85), (0.98, 0.1)])
def test_every_shape_through_every_lens_covers_the_share_of_each_pixel(
    camera: Camera, shape: Disc | Rectangle, where: tuple[float, float]
) -> None:
    pose = Pose((3.0, 2.0, 0.5), 12.0, -8.0, 25.0)
    on_sensor = np.array(where) * [camera.width_px, camera.height_px] + [0.3, 0.7]
    ray = PosedCamera(camera, pose).rays_world(on_sensor)
    center = np.array(pose.position_m) + ray * (3.45 - 0.5) / ray[2]
    size = 15 * float(np.linalg.norm(center - pose.position_m)) / camera.focal_px  # about 30 px
    if isinstance(shape, Disc):
        shape = Disc(size * shape.radius_m)
    else:
        shape = Rectangle((size * shape.size_m[0], size * shape.size_m[1]), shape.yaw_deg)
    image = coverage_of_led(PosedCamera(camera, pose), LedFace(center, shape))
    assert image is not None
    n = 64
    rows, columns = image.coverage.shape
    u = image.roi.column + (np.arange(columns * n) + 0.5) / n
    v = image.roi.row + (np.arange(rows * n) + 0.5) / n
    rays = PosedCamera(camera, pose).rays_world(np.stack(np.meshgrid(u, v), axis=-1))
    xy = rays[..., :2] / rays[..., 2:] * (3.45 - 0.5) + np.array(pose.position_m[:2]) - center[:2]
    if isinstance(shape, Disc):
        inside = np.hypot(xy[..., 0], xy[..., 1]) < shape.radius_m
    else:
        c, s = np.cos(np.radians(shape.yaw_deg)), np.sin(np.radians(shape.yaw_deg))
        inside = abs(c * xy[..., 0] + s * xy[..., 1]) < shape.size_m[0] / 2
        inside &= abs(c * xy[..., 1] - s * xy[..., 0]) < shape.size_m[1] / 2
    share = inside.reshape(rows, n, columns, n).mean(axis=(1, 3))
    error = image.coverage - share
    mixed = (share > 0) & (share < 1)
    # The grid's own error, 0.3 / n^1.5 = 6e-4 rms at edges of any direction (of a straight one not: three times that)
    # and half a line of it at worst, and the change of scale within a pixel: less than 1e-3 here.
    assert np.sqrt((error[mixed] ** 2).mean()) < 3 * 0.3 / n**1.5
    assert np.abs(error).max() < 0.5 / n + 1e-3
    assert abs(error.mean()) < 1e-4  # the errors of the grid have mean 0, and those of the coverage should
    assert mixed.sum() > 10


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_an_image_extends_into_the_margin_beyond_the_sensor(camera: Camera) -> None:
    pose = Pose((3.0, 2.0, 0.5), yaw_deg=10.0)
    # half of it is off the left border
    ray = PosedCamera(camera, pose).rays_world(np.array([0.0, camera.height_px / 2]))
    center = np.array(pose.position_m) + ray * 3.0 / ray[2]
    radius = 8 * float(np.linalg.norm(center - pose.position_m)) / camera.focal_px
    cut = image_of_disc(camera, pose, center, radius)
    whole = image_of_disc(camera, pose, center, radius, margin_px=20)
    assert cut is not None
    assert whole is not None
    assert cut.roi.column == 0
    assert -20 <= whole.roi.column < 0
    assert np.array_equal(whole.coverage[:, -whole.roi.column :], cut.coverage)
    assert whole.visible_fraction == cut.visible_fraction
    assert cut.coverage.sum() / whole.coverage.sum() == pytest.approx(cut.visible_fraction, abs=1e-4)


def test_a_level_square_of_whole_pixels_covers_exactly_them() -> None:
    # 0.1 m at 3 m is 500 px; sides run along pixel borders
    posed = PosedCamera(Camera(), Pose((3.0, 3.0, 0.5)))
    image = coverage_of_led(posed, LedFace(np.array([3.0, 3.0, 3.5]), Rectangle((0.1, 0.1))))
    assert image is not None
    assert image.coverage.sum() == pytest.approx(250_000, rel=1e-9)
    assert image.coverage[1:-1, 1:-1].min() > 1 - 1e-9


def test_yaw_rotates_a_rectangle_from_x_towards_y() -> None:
    # a long thin one turned by 45 deg runs from the upper left to the lower right: +x is +u, +y is +v
    posed = PosedCamera(Camera(), Pose((3.0, 3.0, 0.5)))
    image = coverage_of_led(posed, LedFace(np.array([3.0, 3.0, 3.5]), Rectangle((0.02, 0.002), 45.0)))
    assert image is not None
    rows, columns = np.indices(image.coverage.shape)
    u, v = columns - columns.mean(), rows - rows.mean()
    assert (image.coverage * u * v).sum() > 0


COARSE_LENSES = LENSES | {
    "fish-eye": Camera(**SMALL, focal_length_mm=2.0, projection="equidistant"),
    "skewed": Camera(**SMALL, focal_length_mm=6.0, skew_px=100.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("camera", COARSE_LENSES.values(), ids=COARSE_LENSES)
def test_candidates_include_every_led_that_lights_a_pixel(camera: Camera, rng: np.random.Generator) -> None:
    centers = np.column_stack([rng.uniform(0, 7, (250, 2)), rng.uniform(2.5, 3.5, 250)])
    radii = rng.uniform(0.05, 0.5, 250)
    false_candidates = 0
    for _ in range(8):
        pose = Pose((3.0, 3.0, 1.0), *rng.uniform(-40, 40, 2), rng.uniform(-180, 180))
        candidates = BoundingSpheres(centers, radii).candidates(PosedCamera(camera, pose), margin_px=5.0)
        images = [image_of_disc(camera, pose, c, float(r), 5) for c, r in zip(centers, radii, strict=True)]
        seen = [i for i, image in enumerate(images) if image is not None]
        assert set(seen) <= set(candidates.tolist())
        false_candidates += len(candidates) - len(seen)
    assert false_candidates < 8 * 250 / 4


@pytest.mark.parametrize("shape", [Disc(0.2), Rectangle((0.5, 0.3))], ids=["disc", "rectangle"])
def test_coverage_of_a_large_image_is_that_of_its_bands(shape: Disc | Rectangle) -> None:
    """Blocks that a face covers whole or not at all have no pixels; all others are computed as without blocks."""
    pose = Pose((1.1, 1.2, 0.5), 2.0, -3.0, 25.0)
    posed = PosedCamera(Camera(width_px=1200, height_px=900, pixel_pitch_um=4.0), pose)
    face = LedFace(np.array([1.2, 1.3, 2.5]), shape)
    image = coverage_of_led(posed, face)
    assert image is not None
    assert isinstance(image.pixels, CoverageBlocks)
    roi = image.roi
    u = np.arange(roi.column, roi.end_column + 1, dtype=float)
    v = np.arange(roi.row, roi.end_row + 1, dtype=float)
    expected, _ = _coverage_of_band(posed, face, u, v)
    assert image.pixels.whole.any()
    assert not (image.pixels.whole | image.pixels.mixed).all()
    # pixels beside the face's edge have rounding errors of their area, 1e-16 of it, where they are not computed
    assert np.allclose(image.coverage, expected, rtol=0, atol=1e-14)
    assert image.area_px == pytest.approx(expected.sum(), rel=1e-12)


def test_no_pixel_at_a_disc_s_edge_is_left_out() -> None:
    """The cells that a circle enters between two corners only, at its four extremes, have a coverage of their own."""
    for center in np.linspace(-0.5, 0.5, 21):
        x, y = np.meshgrid(np.arange(-12.0, 13.0) + center, np.arange(-12.0, 13.0))
        disc = Disc(7.005)  # reaches 0.005 beyond lines of corners, with a chord of half a cell
        whole, mixed = disc.whole_and_mixed(x, y)
        rest = ~(whole | mixed)
        row, column = np.nonzero(rest)
        corners = ((0, 0), (0, 1), (1, 1), (1, 0))
        quads = np.stack([[x[row + i, column + j], y[row + i, column + j]] for i, j in corners]).transpose(2, 0, 1)
        assert disc.shared_area(quads).max() < 1e-12
        assert np.count_nonzero(mixed) < 2 * 8 * 7.005  # a circle of radius r enters at most about 8 r cells


@pytest.mark.parametrize("shape", [Disc(1.0), Rectangle((2.0, 2.0)), Rectangle((2.0, 2.0), yaw_deg=30.0)])
@pytest.mark.parametrize("width_px", [40, 400])
@pytest.mark.parametrize("tilt_deg", [0.0, 6.0])
def test_a_face_that_fills_the_sensor_covers_all_of_every_pixel(
    shape: Disc | Rectangle, width_px: int, tilt_deg: float
) -> None:
    camera = Camera(width_px=width_px, height_px=width_px * 3 // 4, pixel_pitch_um=4800 / width_px)
    posed = PosedCamera(camera, Pose((1.0, 1.0, 1.0), tilt_x_deg=tilt_deg))
    image = coverage_of_led(posed, LedFace(np.array([1.0, 1.0, 2.5]), shape))
    assert image is not None
    assert image.roi == Roi.of_sensor(camera)
    assert np.array_equal(image.coverage, np.ones(image.roi.shape))
