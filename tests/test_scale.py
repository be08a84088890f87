"""Recipes scaled to fewer, larger pixels of the same camera."""

from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.recipe.recipe import Recipe, ScaleMode
from vlcrender.errors import InputError
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene

QUICKSTART = ROOT / "datasets/quickstart.toml"
FULL = ("camera.width_px=800", "camera.height_px=600", "camera.pixel_pitch_um=6.0")
SKEWED = ("camera.skew_px=3.0", "camera.principal_point_px=[391.5, 310.25]")


def recipe(*assignments: str, scale: int = 1, mode: ScaleMode = "binned", path: Path = QUICKSTART) -> Recipe:
    return load_plan(path, [*FULL, *assignments], scale, mode).recipe


def test_pixel_positions_scale_with_the_pixels() -> None:
    """u' = u / 10 and v' = v / 10, with the principal point off centre and skew."""
    full, small = (recipe(*SKEWED, scale=scale).camera for scale in (1, 10))
    assert (small.width_px, small.height_px) == (80, 60)
    points = np.random.Generator(np.random.Philox(3)).uniform([2, 2, 2.5], [4, 4, 3.4], (50, 3))
    pose = Pose((3.0, 3.0, 0.5), 5.0, -3.0, 40.0)
    assert PosedCamera(small, pose).project(points) == pytest.approx(
        PosedCamera(full, pose).project(points) / 10, rel=1e-12
    )


def test_keys_in_pixels_are_scaled_and_the_light_follows_the_mode() -> None:
    regions = ('regions={ kind = "leds", margin_px = 80 }', "poses.border_px=20")
    full = recipe(*regions)
    binned, same = (recipe(*regions, scale=10, mode=mode) for mode in ("binned", "same-photons"))
    for small in (binned, same):
        assert small.regions is not None
        assert small.regions.margin_px == 8.0
        assert small.poses.border_px == 2.0  # type: ignore[union-attr]
        assert small.camera.pixel_pitch_um == 60.0
        assert small.camera.f_number == full.camera.f_number
    assert (binned.exposure_s, binned.sensor.full_well_e, binned.sensor.gain_e_per_dn) == (full.exposure_s, 600000, 100)
    assert same.exposure_s == pytest.approx(full.exposure_s / 100)
    assert same.sensor == full.sensor


@pytest.mark.parametrize(("margin_px", "expected_px"), [(80.0, 8.0), (60.0, 6.0), (20.0, 6.0), (6.0, 6.0), (3.0, 3.0)])
def test_a_scaled_region_keeps_a_margin_for_the_background(margin_px: float, expected_px: float) -> None:
    """A tenth of the margin, but at least 6 px, or the recipe's own where that is smaller."""
    small = recipe(f'regions={{ kind = "leds", margin_px = {margin_px} }}', scale=10)
    assert small.regions is not None
    assert small.regions.margin_px == expected_px


@pytest.mark.slow
def test_a_metered_exposure_equals_that_of_the_full_camera(office: Scene) -> None:
    """Binned pixels gather a hundred times the light in one time, by either metering; else a frame is too dark.

    In the middle of an image of an LED, 4 of the large pixels wide; across one light changes by the cos^4 of 10 of the
    small ones, below 4 tan(17 deg) 10 / 3000 = 0.4 %.
    """
    pose = Pose((3.15, 3.1, 0.6), 6, -8, 20)
    kinds = {
        "peak": ["exposure.kind=peak", "exposure.share_of_saturation=0.6", "exposure.max_s=1.0"],
        "noise-level": ["exposure.kind=noise-level", "exposure.level_db=-30"],
    }
    for metering in kinds.values():
        of_camera = ("camera.width_px=2000", "camera.height_px=1500", "camera.pixel_pitch_um=2.4")
        full, small = (recipe(*of_camera, *metering, scale=scale) for scale in (1, 10))
        views = [Renderer(office).expected_image(PosedCamera(r.camera, pose)) for r in (full, small)]
        times = [r.time_s(view) for r, view in zip((full, small), views, strict=True)]
        assert max(patch.roi.columns for patch in views[1].patches) > 4
        assert times[1] == pytest.approx(times[0], rel=4e-3)
        same = recipe(*of_camera, *metering, scale=10, mode="same-photons")
        assert same.time_s(views[1]) == pytest.approx(times[0] / 100, rel=4e-3)


@pytest.mark.slow
@pytest.mark.parametrize("skewed", [(), SKEWED], ids=["plain", "skewed"])
@pytest.mark.parametrize("pose", [Pose((3.15, 3.1, 0.6), 6, -8, 20), Pose((3.5, 3.2, 0.8), 40, 10, 30)])
def test_a_binned_pixel_holds_the_sum_of_its_pixels(office: Scene, pose: Pose, skewed: tuple[str, ...]) -> None:
    full, small = (recipe(*skewed, scale=scale) for scale in (1, 10))
    renderer = Renderer(office)
    image = renderer.expected_image(PosedCamera(full.camera, pose)).expected_electrons(full.exposure_s).astype(float)
    sums = image.reshape(60, 10, 80, 10).sum(axis=(1, 3))
    binned = renderer.expected_image(PosedCamera(small.camera, pose)).expected_electrons(small.exposure_s)
    # Two first-order errors of a pixel that an LED covers in part, f = 300 px. cos^4 is taken at its centre, its light
    # may be a quarter of a pixel off: 4 * 0.17 / (4 * 300) = 6e-4. Coverage is an area on the LED's plane, where the
    # pixel's far side counts for more by 3 tan(angle from the vertical) / 300; its half errs by 1/4 of it.
    corners = PosedCamera(small.camera, pose).rays_world(np.array([[0.0, 0.0], [80.0, 0.0], [0.0, 60.0], [80.0, 60.0]]))
    steepest = (np.hypot(corners[:, 0], corners[:, 1]) / corners[:, 2]).max()
    tolerance = (1e-3 + 3 * steepest / 300 / 4) * sums
    # Where surfaces meet, an 8 x 8 grid errs by 1.3 % of the step between them, which is at most the whole of the
    # brightest surface; 4 sigma.
    background = np.median(sums)
    off = np.abs(binned - sums) > tolerance
    assert off.mean() < 0.1
    assert (np.abs(binned - sums) <= tolerance + 4 * 0.013 * 2 * background).all()
    assert binned.max() > 5 * background, "an LED must be in view"


def test_same_photons_in_a_larger_pixel(office: Scene) -> None:
    pose = Pose((3.15, 3.1, 0.6), 6, -8, 20)
    renderer = Renderer(office)
    full, small = recipe(), recipe(scale=10, mode="same-photons")
    images = [
        renderer.expected_image(PosedCamera(r.camera, pose)).expected_electrons(r.exposure_s) for r in (full, small)
    ]
    assert np.median(images[1]) == pytest.approx(np.median(images[0]), rel=0.02)


def test_a_scale_that_leaves_part_of_a_pixel_is_refused() -> None:
    with pytest.raises(InputError, match=r"--scale 7: does not divide the camera's 800 x 600 pixels"):
        recipe(scale=7)
    with pytest.raises(InputError, match=r"--scale 200: camera.width_px = 4"):
        recipe(scale=200)
