"""Windows alone: the same electrons as in the full frame, beyond the sensor too, and no kernel compiled anew."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL
from hypothesis import given
from hypothesis import strategies as st

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.roi import LedRegions, Roi, led_regions
from vlcrender.core.backend import dr
from vlcrender.dataset.generate import generate
from vlcrender.dataset.recipe import load_plan
from vlcrender.dataset.verify import verify
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
    """What a full frame has in a window on the sensor."""
    return whole[roi.row : roi.end_row, roi.column : roi.end_column]


@pytest.mark.parametrize(
    ("pose", "regions"),
    [
        *((pose, LEDS) for pose in OFFICE_POSES),
        *((OFFICE_POSES[0], w) for w in (OVERSCAN, LedRegions(kind="leds", margin_px=0))),
    ],
    ids=["level", "tilted", "overscan", "no margin"],
)
def test_a_windowed_pixel_holds_what_it_holds_in_the_full_frame(
    office_renderer: Renderer, pose: Pose, regions: LedRegions
) -> None:
    """Exactly, at the windows' own borders and at the edges of panels too."""
    camera = Camera(width_px=800, height_px=600, pixel_pitch_um=6.0)
    full = office_renderer.expected_image(camera, pose).expected_electrons(1e-5)
    view = office_renderer.expected_image(camera, pose, regions)
    sensor = Roi.of_sensor(camera)
    seen = [part for part in view.parts if part.roi.overlaps(sensor)]
    assert seen
    for part in seen:
        shared = part.roi.intersection(sensor)
        ours = part.expected_electrons(1e-5)[part.roi.slices(shared)]
        assert np.array_equal(ours, pixels_of(full, shared))
    assert sum(part.roi.pixels for part in seen) < sensor.pixels


def test_on_the_sensor_no_edge_comes_from_beyond_it() -> None:
    """A full frame does not look there. Here surfaces meet exactly along the sensor's left border."""
    surfaces = np.zeros((5, 8), np.uint32)
    surfaces[:, :3] = 1
    edges = _edges(surfaces, Roi(10, -3, 5, 8), Roi(0, 0, 300, 400))
    assert edges.any(axis=0).tolist() == [False, False, True, False, False, False, False, False]


def test_each_led_has_its_margin_unless_the_sensor_ends(office_renderer: Renderer) -> None:
    camera, pose = Camera(), OFFICE_POSES[0]
    view = office_renderer.expected_image(camera, pose, LEDS)
    sensor = Roi.of_sensor(camera)
    assert len(view.patches) == len(office_renderer.expected_image(camera, pose).patches)
    for part in view.parts:
        assert part.patches
        assert sensor.contains(part.roi)
        for patch in part.patches:
            assert part.roi.contains(patch.roi.padded(20).intersection(sensor))


def test_beyond_the_sensor_is_what_a_larger_sensor_would_see(table1: Scene) -> None:
    renderer, pose = Renderer(table1), Pose((0.35, 1.75, 0.05), 3.0, 1.0, 10.0)
    camera = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)
    larger = Camera(width_px=1600, height_px=1500, pixel_pitch_um=12.0, principal_point_px=(800.0, 750.0))
    full = renderer.expected_image(larger, pose).expected_electrons(1e-5)
    view = renderer.expected_image(camera, pose, OVERSCAN)
    assert len(view.patches) == 4
    assert {patch.imaged_fraction for patch in view.patches} == {1.0}
    assert min(patch.visible_fraction for patch in view.patches) == 0.0
    for part in view.parts:
        there = Roi(part.roi.row + 600, part.roi.column + 600, part.roi.rows, part.roi.columns)
        # two cameras: float32 rounds their rays differently, 1e-7 of the cos^4 and at the LEDs' edges 1e-6 of a pixel
        assert np.allclose(part.expected_electrons(1e-5), pixels_of(full, there), rtol=1e-5)


def test_a_frame_that_sees_no_led_has_one_dark_pixel(table1: Scene) -> None:
    view = Renderer(table1).expected_image(Camera(), Pose((5.0, 5.0, 0.5)), LEDS)
    assert [part.roi for part in view.parts] == [Roi(0, 0, 1, 1)]
    assert view.patches == ()


def test_windows_larger_than_the_sensor_allows_are_refused(table1: Scene) -> None:
    with pytest.raises(InputError, match=r"margin_px"):
        Renderer(table1).expected_image(
            Camera(), Pose((5.0, 5.0, 0.5)), LedRegions(kind="leds", margin_px=9000, overscan=True)
        )


@given(st.lists(st.tuples(*[st.integers(0, 60)] * 2, *[st.integers(1, 12)] * 2), max_size=12), st.integers(0, 5))
def test_windows_share_no_pixel_and_hold_all_that_is_lit(boxes: list[tuple[int, ...]], margin: int) -> None:
    camera = Camera(width_px=72, height_px=72)
    lit = [Roi(*box) for box in boxes]
    regions = led_regions(lit, camera, LedRegions(kind="leds", margin_px=margin))
    assert not any(a.overlaps(b) for i, a in enumerate(regions) for b in regions[:i])
    for roi in lit:
        assert any(w.contains(roi.padded(margin).intersection(Roi.of_sensor(camera))) for w in regions)


@pytest.mark.parametrize("regions", [None, LEDS], ids=["full frame", "regions"])
def test_a_new_pose_compiles_no_kernel(office_renderer: Renderer, regions: LedRegions | None) -> None:
    camera = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)
    office_renderer.expected_image(camera, OFFICE_POSES[0], regions)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        office_renderer.expected_image(camera, Pose((3.3, 3.0, 0.7), 3, 2, -50), regions)
        kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert kernels
    assert all(entry["cache_hit"] for entry in kernels)


@pytest.fixture(scope="module")
def table1_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("regions") / "set"
    assignments = ["poses.columns=4", "poses.rows=4", *SMALL[:4], "expected=true"]
    generate(load_plan(ROOT / "datasets/table1.toml", assignments), directory)
    return directory


def test_frames_beyond_the_sensor_are_marked(table1_set: Path) -> None:
    """Level on the floor at the 16 cell centres no pose has all four LEDs in its 0.93 x 0.70 m of ceiling."""
    assert verify(table1_set) == []
    frames = pq.read_table(table1_set / "frames.parquet").to_pylist()
    truth = pq.read_table(table1_set / "truth.parquet").to_pylist()
    assert not any(row["capturable"] for row in frames)
    assert all(len(row["spots"]) == 4 for row in frames)
    # x goes up fastest, in the middles of the cells
    assert [row["position_m"][:2] for row in truth[3:5]] == [[6.125, 0.875], [0.875, 2.625]]


def test_verify_holds_the_mark_against_the_windows(table1_set: Path, tmp_path: Path) -> None:
    for path in [table1_set, *table1_set.rglob("*")]:
        target = tmp_path / "set" / path.relative_to(table1_set)
        target.mkdir() if path.is_dir() else target.write_bytes(path.read_bytes())
    table = pq.read_table(tmp_path / "set/frames.parquet")
    rows = table.to_pylist()
    rows[2]["capturable"] = True
    pq.write_table(table.from_pylist(rows, schema=table.schema), tmp_path / "set/frames.parquet")
    (problem,) = verify(tmp_path / "set")
    assert "000002.exr" in problem
    assert "capturable" in problem
