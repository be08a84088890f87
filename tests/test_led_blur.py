"""LEDs after a narrow blur: against closed forms; sum and centroid of the light; slopes for the bound."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import j1
from test_raycast import room

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.psf import AIRY_TAIL, MIN_DEVIATION, defocus_diameter_px, split_for, split_kernel
from vlcrender.camera.roi import Roi
from vlcrender.core.planar_shapes import Disc
from vlcrender.rendering.led_blur import LedKernel, led_blur
from vlcrender.rendering.led_coverage import LedFace, coverage_of_led
from vlcrender.rendering.led_edges import LedEdges, edges_of_led
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene

Array = np.ndarray[Any, np.dtype[np.float64]]

PEAK_E, BACKGROUND_E = 4000.0, 24.0
"""An LED and the ceiling beside it, as in a frame of the quickstart."""
OVERHEAD_M = 2.5
LENS = {"width_px": 64, "height_px": 64, "pixel_pitch_um": 10.0, "focal_length_mm": 18.0}
RADIUS_PX = 6.3
RADIUS_M = RADIUS_PX * OVERHEAD_M / 1800
CENTER_PX = np.array([32.3, 31.85])
"""Image of the LED's centre: neither a pixel's centre nor on its border."""


def defocused(diameter_px: float) -> Camera:
    """A camera focused at infinity whose defocus disc of a point overhead has this diameter."""
    wide_open = Camera(**LENS, focus_distance_m="infinity", f_number=1.0)
    return Camera(
        **LENS,
        focus_distance_m="infinity",
        f_number=float(defocus_diameter_px(wide_open, OVERHEAD_M)) / diameter_px,
    )


def diffracting(scale_px: float) -> Camera:
    """A camera whose lambda N is this many pixels."""
    return Camera(**LENS, psf="diffraction", f_number=scale_px * 10.0 / 0.55)


CAMERAS = {f"disc {d} px": defocused(d) for d in (0.2, 0.35, 0.7, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0)} | {
    f"Airy {s} px": diffracting(s) for s in (0.6, 1.0, 2.0)
}


def sharp_image(camera: Camera) -> tuple[Array, Roi, LedEdges]:
    """Coverage of an LED overhead imaged at CENTER_PX, its region and edges."""
    pose = Pose((1.0, 1.0, 1.0))
    center_m = np.array([*(1.0 + (CENTER_PX - 32) * OVERHEAD_M / camera.focal_px), 1.0 + OVERHEAD_M])
    posed, face = PosedCamera(camera, pose), LedFace(center_m, Disc(RADIUS_M))
    image = coverage_of_led(posed, face, 40)
    assert image is not None
    return image.coverage, image.roi, edges_of_led(posed, face, image, split_for(camera, OVERHEAD_M))


def blurred_image(camera: Camera) -> tuple[Array, Roi]:
    """The LED's image after the lens, and its region."""
    coverage, roi, edges = sharp_image(camera)
    parts = split_kernel(camera, OVERHEAD_M)
    assert parts is not None
    kernel = LedKernel(parts.whole, parts)
    return kernel.blurred(coverage, roi, [edges], 1.0), roi.padded(kernel.radius_px)


def shared_by_discs(distance: Array, first: float, second: float) -> Array:
    """Area that two discs of these radii share, with their centres at a distance."""
    near, far = abs(first - second), first + second
    d = np.clip(distance, near + 1e-12, far - 1e-12)
    half_1 = np.arccos(np.clip((d**2 + first**2 - second**2) / (2 * d * first), -1, 1))
    half_2 = np.arccos(np.clip((d**2 + second**2 - first**2) / (2 * d * second), -1, 1))
    lens = first**2 * (half_1 - np.sin(2 * half_1) / 2) + second**2 * (half_2 - np.sin(2 * half_2) / 2)
    return np.where(distance <= near, np.pi * min(first, second) ** 2, np.where(distance >= far, 0.0, lens))


def behind_airy(distance: Array, scale: float) -> Array:
    """A disc of RADIUS_PX blurred by an Airy pattern, at distances from its centre.

    Sum over rings of the pattern: light of the ring times the share of the ring inside the disc.
    """
    s = (np.arange(20_000) + 0.5) * (24.0 / 20_000)  # greater than the distance of any point of the disc
    x = np.pi * s / scale
    light = (2 * j1(x) / x) ** 2 * np.pi / 4 / scale**2 * 2 * np.pi * s * (s[1] - s[0])
    table = np.linspace(0.0, 14.0, 1401)
    inside = [
        np.arccos(np.clip((r**2 + s**2 - RADIUS_PX**2) / np.maximum(2 * r * s, 1e-12), -1, 1)) / np.pi for r in table
    ]
    return np.interp(distance, table, np.stack(inside) @ light)


def share_kept(scale: float) -> float:
    """Share of the Airy pattern's light in the square of the kernel."""
    half_side = int(np.ceil(2 / (np.pi**2 * AIRY_TAIL) * scale)) + 0.5
    at = (np.arange(4000) + 0.5) * (half_side / 4000)
    x = np.pi / scale * np.hypot(*np.meshgrid(at, at))
    return float(4 * ((2 * j1(x) / x) ** 2).sum() * (half_side / 4000) ** 2 * np.pi / 4 / scale**2)


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_an_edge_errs_by_less_than_a_twentieth_of_the_shot_noise(name: str) -> None:
    """Against the closed form of a disc behind a disc, or rings of the Airy pattern, at 64 x 64 points a pixel."""
    camera = CAMERAS[name]
    image, roi = blurred_image(camera)
    if camera.psf == "diffraction":
        scale = camera.working_f_number * 0.55 / 10.0
        image = image * share_kept(scale)  # kernels are scaled up by the light left out
    inside = (np.arange(64) + 0.5) / 64 - 0.5
    centers = np.stack(np.broadcast_arrays(*roi.centers_px()), axis=-1)
    near = np.hypot(*np.moveaxis(centers - CENTER_PX, -1, 0)) < 13
    rows, columns = np.nonzero(near)
    u, v = centers[rows, columns].T
    distance = np.hypot(u[:, None, None] + inside - CENTER_PX[0], v[:, None, None] + inside[:, None] - CENTER_PX[1])
    if camera.psf == "diffraction":
        truth = behind_airy(distance, scale).mean(axis=(1, 2))
    else:
        disc = float(defocus_diameter_px(camera, OVERHEAD_M))
        truth = (shared_by_discs(distance, RADIUS_PX, disc / 2) / (np.pi * disc**2 / 4)).mean(axis=(1, 2))
    error_e = PEAK_E * (image[rows, columns] - truth)
    share = error_e**2 / (PEAK_E * truth + BACKGROUND_E)
    print(f"{name}: {np.abs(error_e).max():.2f} e, {share.max():.2%} of the variance at most")
    # The bound of `split_for`. Error of the truth: 64^2 points at a disc's rim, 0.3 / 64^1.5 = 6e-4 of the step where
    # the blur is no wider than the spacing of the points, and far less where it is wider.
    assert share.max() < 0.05


@pytest.mark.parametrize("name", CAMERAS)
def test_parts_keep_the_light_and_its_centroid(name: str) -> None:
    camera = CAMERAS[name]
    image, roi = blurred_image(camera)
    coverage, _, _ = sharp_image(camera)
    # rounding, 2^-52 of each of some thousand pixels
    assert image.sum() == pytest.approx(coverage.sum(), rel=1e-11)
    assert image.min() >= 0
    centroid = np.array([(image * coordinate).sum() for coordinate in roi.centers_px()]) / image.sum()
    # parts hold their light at their centres: that moves an edge by up to 1 / (8 n) of a part's width, n >= 4 here,
    # at 80 places and more around the rim which it moves either way
    assert np.abs(centroid - CENTER_PX).max() < 1 / (8 * 4**2) / np.sqrt(80) * 3


def test_each_led_near_the_focus_has_its_own_kernel(table1: Scene) -> None:
    """2 mm of depth are a disc of 0.07 px; in steps of DEPTH_STEP, 18 mm, all would share one."""
    leds, camera = table1.leds, Camera(focus_distance_m=2.5)
    pose = Pose((float(leds.centers_m[0, 0]), float(leds.centers_m[0, 1]), 0.98))
    lower = Pose((pose.position_m[0], pose.position_m[1], 0.982))
    one, other = (led_blur(leds, PosedCamera(camera, at)).kernel(0).parts for at in (pose, lower))
    assert one is not None
    assert other is not None
    expected = split_kernel(camera, float(leds.centers_m[0, 2]) - 0.98)
    assert expected is not None
    assert np.array_equal(one.parts, expected.parts)
    assert other.parts.shape != one.parts.shape or not np.allclose(other.parts, one.parts, atol=1e-3)


@pytest.mark.parametrize("lens", [{"focus_distance_m": 2.95}, {"psf": "diffraction"}], ids=["focus", "diffraction"])
def test_slopes_of_blurred_edges_are_independent_of_the_step(table1: Scene, lens: dict[str, Any]) -> None:
    """For the bound: central differences over 2e-5 px with one kernel, not dominated by rounding."""
    camera = Camera(**lens)
    at = Pose((0.31, 1.92, 0.5), 2.0, -1.0, 10.0)
    renderer = Renderer(table1)

    def slope(step_px: float) -> Array:
        images = []
        for sign in (1, -1):
            moved = Pose((0.31 + sign * step_px * 3.0 / camera.focal_px, *at.position_m[1:]), 2.0, -1.0, 10.0)
            (patch,) = (p for p in renderer.led_patches(PosedCamera(camera, moved), None, at) if p.led_id == 2)
            images.append(patch.electrons_per_s)
        return (images[0] - images[1]) / (2 * step_px)

    small, large = slope(1e-5), slope(1e-4)
    # Slopes jump where the edge enters a part: in a share of up to 2e-4 * 16 of the parts, by up to their own size.
    assert np.linalg.norm(small - large) < 2e-4 * 16 * 4 * np.linalg.norm(small)
    assert np.linalg.norm(small) > 0


def test_the_kernel_of_an_led_is_within_a_step_of_depth_of_its_own(table1: Scene) -> None:
    """Focused at infinity the disc's diameter goes with 1 / depth: half of DEPTH_STEP off, its area by twice that.

    The middle pixel of a wide disc is covered whole: its share of the light is 1 / area.
    """
    camera = Camera(focus_distance_m="infinity", width_px=400, height_px=300, pixel_pitch_um=3.0)
    x, y, z = table1.leds.centers_m[1].tolist()
    for depth_m in np.linspace(0.16, 0.3, 8):
        kernel = led_blur(table1.leds, PosedCamera(camera, Pose((x, y, z - float(depth_m))))).kernel(1).whole
        assert kernel is not None
        assert split_for(camera, float(depth_m)) == 1  # LEDs under a narrower blur have kernels of their own
        area = np.pi / 4 * float(defocus_diameter_px(camera, depth_m)) ** 2
        middle = kernel[kernel.shape[0] // 2, kernel.shape[0] // 2]
        assert middle * area == pytest.approx(1.0, abs=0.005 * 1.01)


def test_a_narrow_blur_makes_no_pixel_brighter_than_a_sharp_lens_and_lights_no_hidden_one(tmp_path: Path) -> None:
    """An LED 40 deg off the axis, where relative illumination is 0.34, half of it behind a board.

    The blur is a mean over places of the LED's sharp image: at most its brightest, and nothing beyond the kernel.
    """
    vertices = [(3.0, 3.0), (4.0, 3.0), (4.0, 4.0), (3.0, 4.0)]
    (tmp_path / "board.obj").write_text("".join(f"v {x} {y} 0\n" for x, y in vertices) + "f 1 3 2\nf 1 4 3\n")
    scene = room(tmp_path, furniture=[{"file": "board.obj", "position_m": [0.0, 0.0, 3.499]}])
    renderer = Renderer(scene)
    pose = Pose((3.0, 3.5 - 2.5 * np.tan(np.radians(40.0)), 1.0))
    lens = {"width_px": 400, "height_px": 400, "pixel_pitch_um": 80.0}
    sharp_camera = Camera(**lens)
    wide_open = Camera(**lens, focus_distance_m="infinity", f_number=1.0)
    f_number = float(defocus_diameter_px(wide_open, 2.5)) / 0.7
    camera = Camera(**lens, focus_distance_m="infinity", f_number=f_number)
    (patch,) = renderer.led_patches(PosedCamera(camera, pose))
    (sharp,) = renderer.led_patches(PosedCamera(sharp_camera, pose))
    light = patch.electrons_per_s * (f_number / sharp_camera.f_number) ** 2  # of the same pupil
    assert light.sum() == pytest.approx(sharp.electrons_per_s.sum(), rel=1e-9)
    assert light.max() <= sharp.electrons_per_s.max() * (1 + 1e-9)
    lit = np.nonzero(sharp.electrons_per_s.any(axis=0))[0] + sharp.column
    blurred = np.nonzero((light > 1e-9 * light.max()).any(axis=0))[0] + patch.column
    # a disc of 0.7 px reaches one pixel farther
    assert blurred.max() <= lit.max() + 1


def test_a_narrower_diffraction_pattern_needs_more_parts_of_a_pixel() -> None:
    """By the number that `split_for` states: its error is at most D / (12 n^2), and D grows as the pattern narrows."""
    parts = [
        split_for(Camera(psf="diffraction", f_number=f_number, pixel_pitch_um=1.2), 3.0) for f_number in (1.4, 2.8, 8.0)
    ]
    assert parts == sorted(parts, reverse=True)
    assert parts[0] > parts[-1]


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_kernels_of_parts_differ_where_deviations_say(camera: Camera) -> None:
    """Blurred by deviations alone, the edges give what the whole kernels of their parts give.

    Each pixel is left without what is below MIN_DEVIATION, of at most all edge pixels' excess.
    """
    coverage, roi, edges = sharp_image(camera)
    parts = split_kernel(camera, OVERHEAD_M)
    assert parts is not None
    n, m = parts.split, parts.parts.shape[-1]
    ours = LedKernel(parts.whole, parts).spread(coverage, roi, [edges], 1.0)
    expected = LedKernel(parts.whole).spread(coverage, roi, [], 1.0)
    for row, column, excess in zip(edges.rows - roi.row, edges.columns - roi.column, edges.excess, strict=True):
        expected[row : row + m, column : column + m] += np.tensordot(excess, parts.parts, 2) / n**2
    share = np.abs(edges.excess).mean(axis=(1, 2)).sum()
    assert np.abs(ours - expected).max() < MIN_DEVIATION * share
    assert parts.deviations.shape[-1] <= m


def test_edge_pixels_spread_by_sevens_light_what_they_light_together(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = diffracting(1.0)
    coverage, roi, edges = sharp_image(camera)
    parts = split_kernel(camera, OVERHEAD_M)
    assert parts is not None
    together = LedKernel(parts.whole, parts).spread(coverage, roi, [edges], 1.0)
    assert len(edges.rows) % 7 > 0
    monkeypatch.setattr("vlcrender.rendering.led_blur.EDGE_PIXELS_AT_ONCE", 7)
    assert np.array_equal(LedKernel(parts.whole, parts).spread(coverage, roi, [edges], 1.0), together)
