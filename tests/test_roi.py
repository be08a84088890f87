"""Regions of interest: the electrons of the full frame, also beyond the sensor, without new kernels."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL, sealed
from hypothesis import given
from hypothesis import strategies as st

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions, Roi, led_regions
from vlcrender.core.backend import dr
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.verify.verify import verify
from vlcrender.errors import InputError
from vlcrender.rendering.background import _edges
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene

LEDS = LedRegions(kind="leds")
OVERSCAN = LedRegions(kind="leds", overscan=True)
OFFICE_POSES = [Pose((3.15, 3.1, 0.6), 6, -8, 20), Pose((1.5, 2.0, 1.2), 40.0, 35.0, 110.0)]


@pytest.fixture(scope="module")
def office_renderer(office: Scene) -> Renderer:
    return Renderer(office)


def pixels_of(whole: np.ndarray, roi: Roi) -> np.ndarray:
    """Pixels of a full frame in a region on the sensor."""
    return whole[roi.row : roi.end_row, roi.column : roi.end_column]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pose", "regions"),
    [
        *((pose, LEDS) for pose in OFFICE_POSES),
        *((OFFICE_POSES[0], settings) for settings in (OVERSCAN, LedRegions(kind="leds", margin_px=0))),
    ],
    ids=["level", "tilted", "overscan", "no margin"],
)
def test_a_pixel_of_a_region_has_the_electrons_of_the_full_frame(
    office_renderer: Renderer, pose: Pose, regions: LedRegions
) -> None:
    """Exactly, also at the borders of regions and at the edges of panels."""
    camera = Camera(width_px=800, height_px=600, pixel_pitch_um=6.0)
    full = office_renderer.expected_image(PosedCamera(camera, pose)).expected_electrons(1e-5)
    mean = office_renderer.expected_image(PosedCamera(camera, pose), regions)
    sensor = Roi.of_sensor(camera)
    on_sensor = [part for part in mean.parts if part.roi.overlaps(sensor)]
    assert on_sensor
    for part in on_sensor:
        shared = part.roi.intersection(sensor)
        ours = part.expected_electrons(1e-5)[part.roi.slices(shared)]
        assert np.array_equal(ours, pixels_of(full, shared))
    assert sum(part.roi.pixels for part in on_sensor) < sensor.pixels


def test_pixels_on_the_sensor_ignore_surfaces_beyond_it() -> None:
    """A full frame has no pixels beyond the sensor. Here surfaces meet along the sensor's left border."""
    surfaces = np.zeros((5, 8), np.uint32)
    surfaces[:, :3] = 1
    edges = _edges(surfaces, Roi(10, -3, 5, 8), Roi(0, 0, 300, 400))
    assert edges.any(axis=0).tolist() == [False, False, True, False, False, False, False, False]


def test_each_led_has_its_margin_unless_the_sensor_ends(office_renderer: Renderer) -> None:
    camera, pose = Camera(), OFFICE_POSES[0]
    mean = office_renderer.expected_image(PosedCamera(camera, pose), LEDS)
    sensor = Roi.of_sensor(camera)
    assert len(mean.patches) == len(office_renderer.expected_image(PosedCamera(camera, pose)).patches)
    for part in mean.parts:
        assert part.patches
        assert sensor.contains(part.roi)
        for patch in part.patches:
            assert part.roi.contains(patch.roi.padded(20).intersection(sensor))


def test_overscan_agrees_with_a_larger_sensor(table1: Scene) -> None:
    renderer, pose = Renderer(table1), Pose((0.35, 1.75, 0.05), 3.0, 1.0, 10.0)
    camera = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)
    larger = Camera(width_px=1600, height_px=1500, pixel_pitch_um=12.0, principal_point_px=(800.0, 750.0))
    full = renderer.expected_image(PosedCamera(larger, pose)).expected_electrons(1e-5)
    mean = renderer.expected_image(PosedCamera(camera, pose), OVERSCAN)
    assert len(mean.patches) == 4
    assert {patch.imaged_fraction for patch in mean.patches} == {1.0}
    assert min(patch.visible_fraction for patch in mean.patches) == 0.0
    for part in mean.parts:
        there = Roi(part.roi.row + 600, part.roi.column + 600, part.roi.rows, part.roi.columns)
        # two cameras: float32 rounds their rays differently, 1e-7 of the cos^4 and at the LEDs' edges 1e-6 of a pixel
        assert np.allclose(part.expected_electrons(1e-5), pixels_of(full, there), rtol=1e-5)


def test_a_frame_without_leds_has_one_pixel(table1: Scene) -> None:
    mean = Renderer(table1).expected_image(PosedCamera(Camera(), Pose((5.0, 5.0, 0.5))), LEDS)
    assert [part.roi for part in mean.parts] == [Roi(0, 0, 1, 1)]
    assert mean.patches == ()


def test_regions_of_too_many_pixels_are_refused(table1: Scene) -> None:
    with pytest.raises(InputError, match=r"margin_px"):
        Renderer(table1).expected_image(
            PosedCamera(Camera(), Pose((5.0, 5.0, 0.5))), LedRegions(kind="leds", margin_px=9000, overscan=True)
        )


@given(st.lists(st.tuples(*[st.integers(0, 60)] * 2, *[st.integers(1, 12)] * 2), max_size=12), st.integers(0, 5))
def test_regions_share_no_pixel_and_contain_all_led_images(boxes: list[tuple[int, ...]], margin: int) -> None:
    camera = Camera(width_px=72, height_px=72)
    led_rois = [Roi(*box) for box in boxes]
    regions = led_regions(led_rois, camera, LedRegions(kind="leds", margin_px=margin))
    assert not any(a.overlaps(b) for i, a in enumerate(regions) for b in regions[:i])
    for roi in led_rois:
        assert any(r.contains(roi.padded(margin).intersection(Roi.of_sensor(camera))) for r in regions)


@pytest.mark.parametrize("regions", [None, LEDS], ids=["full frame", "regions"])
def test_a_new_pose_compiles_no_kernel(office_renderer: Renderer, regions: LedRegions | None) -> None:
    camera = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)
    office_renderer.expected_image(PosedCamera(camera, OFFICE_POSES[0]), regions)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        office_renderer.expected_image(PosedCamera(camera, Pose((3.3, 3.0, 0.7), 3, 2, -50)), regions)
        kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert kernels
    assert all(entry["cache_hit"] for entry in kernels)


@pytest.fixture(scope="module")
def table1_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("regions") / "set"
    assignments = ["poses.columns=4", "poses.rows=4", *SMALL[:4], "expected=true"]
    generate(load_plan(ROOT / "datasets/table1.toml", assignments), directory)
    return directory


def test_frames_with_regions_beyond_the_sensor_are_not_capturable(table1_set: Path) -> None:
    """Level on the floor at the 16 cell centres no pose has all four LEDs in its 0.93 x 0.70 m of ceiling."""
    assert verify(table1_set) == []
    frames = pq.read_table(table1_set / "frames.parquet").to_pylist()
    truth = pq.read_table(table1_set / "truth.parquet").to_pylist()
    assert not any(row["capturable"] for row in frames)
    assert all(len(row["spots"]) == 4 for row in frames)
    # x goes up fastest, in the middles of the cells
    assert [row["position_m"][:2] for row in truth[3:5]] == [[6.125, 0.875], [0.875, 2.625]]


def test_verify_compares_capturable_with_the_regions(table1_set: Path, tmp_path: Path) -> None:
    for path in [table1_set, *table1_set.rglob("*")]:
        target = tmp_path / "set" / path.relative_to(table1_set)
        target.mkdir() if path.is_dir() else target.write_bytes(path.read_bytes())
    table = pq.read_table(tmp_path / "set/frames.parquet")
    rows = table.to_pylist()
    rows[2]["capturable"] = True
    pq.write_table(table.from_pylist(rows, schema=table.schema), tmp_path / "set/frames.parquet")
    sealed(tmp_path / "set")
    (problem,) = verify(tmp_path / "set")
    assert "000002.exr" in problem
    assert "capturable" in problem
