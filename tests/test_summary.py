"""The summary of a set against its frames, and its warnings; dry runs; checks of large plans."""

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL, copy_of, run, small_plan

import vlcrender as vr
from vlcrender.config.presets import with_presets
from vlcrender.config.toml_model import check, read_toml
from vlcrender.dataset.format.frame_numbers import FrameNumbers
from vlcrender.dataset.format.summary import Summary, disk_use, size_text, summary_lines
from vlcrender.dataset.recipe.recipe import RecipeFile
from vlcrender.dataset.recipe.recipe_warnings import recipe_warnings
from vlcrender.dataset.run.dry_run import dry_run, file_counts
from vlcrender.dataset.run.frame_job import Job
from vlcrender.dataset.run.possible import MAX_POSES, check_possible, poses_to_check


def summary(folder: Path) -> dict[str, object]:
    found: dict[str, object] = json.loads((folder / "dataset.json").read_text())["summary"]
    return found


def expected_images(folder: Path) -> list[np.ndarray]:
    images = []
    for path in sorted((folder / "expected").iterdir()):
        with OpenEXR.File(str(path)) as file:
            images.append(np.array(file.channels()["Y"].pixels))
    return images


def test_the_summary_is_that_of_the_frames(rendered_set: Path) -> None:
    found = summary(rendered_set)
    images = expected_images(rendered_set)
    truth = pq.read_table(rendered_set / "truth.parquet").to_pylist()
    leds = sorted(sum(led["visible_fraction"] == 1 for led in row["leds"]) for row in truth)
    assert found["leds"] == {"min": leds[0], "median": leds[1], "max": leds[2]}
    assert found["brightest_e"] == max(float(image.max()) for image in images)
    assert found["saturation_e"] == 4095.0
    assert found["saturated_share"] == np.mean([image >= 4095.0 for image in images]) == 0
    # The ceiling covers most pixels of an image, and LEDs few: both medians are of the same surface, within 5 %.
    assert found["background_e"] == pytest.approx(np.median([np.median(image) for image in images]), rel=0.05)
    assert found["field_of_view_deg"] == {"main": pytest.approx(15.189, abs=1e-3)}
    folders = [path for path in rendered_set.rglob("*") if path.is_file() and path.parent != rendered_set]
    tables = list(rendered_set.glob("*.parquet"))
    assert found["bytes"] == sum(path.stat().st_size for path in [*folders, *tables]) == disk_use(rendered_set)
    assert found["warnings"] == []


def test_a_resumed_run_has_the_same_summary(rendered_set: Path, tmp_path: Path) -> None:
    def stop(progress: vr.Progress) -> None:
        if progress.stage == "frames":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        vr.generate(small_plan("expected=true"), tmp_path / "set", progress=stop)
    assert vr.generate(small_plan("expected=true"), tmp_path / "set", workers=1)
    assert summary(tmp_path / "set") == summary(rendered_set)


def test_cells_that_share_files_have_the_numbers_of_both(tmp_path: Path) -> None:
    """Cells that differ in the accelerometer alone are not exposed twice."""
    sweep = 'sweep=[{key="accelerometer.error_deg", values=[0.1, 0.2]}]'
    assert vr.generate(small_plan("poses.count=1", sweep), tmp_path / "sweep")
    one, other = (summary(tmp_path / f"sweep/cells/{number:06d}") for number in range(2))
    assert one["brightest_e"] == other["brightest_e"] is not None
    assert one["saturated_share"] == other["saturated_share"] == 0


def test_a_set_that_is_all_saturated_is_warned_of(tmp_path: Path) -> None:
    arguments = [f"--set={a}" for a in (*SMALL, "poses.count=1", "exposure_s=1e-2")]
    made = run("vlcrender", "generate", "quickstart", "--out", str(tmp_path / "set"), *arguments)
    assert made.returncode == 0
    assert "warning: 100 % of all pixels are saturated" in made.stdout
    assert summary(tmp_path / "set")["saturated_share"] == 1.0
    names = [line[:14].strip() for line in made.stdout.splitlines()[1:7]]
    assert names == ["LEDs a frame", "field of view", "saturated", "brightest LED", "background", "disk use"]


@pytest.mark.parametrize(
    ("electrons", "text"),
    [
        (0.0123456, "0.01235"),
        (17.446, "17.45"),
        (9999.4, "9999"),
        (9999.6, "10000"),
        (13832.0, "13830"),
        (2e6, "2000000"),
    ],
)
def test_electrons_have_four_digits_and_no_exponent(rendered_set: Path, electrons: float, text: str) -> None:
    of_set = Summary.model_validate(summary(rendered_set)).model_copy(update={"brightest_e": electrons})
    (line,) = (line for line in summary_lines(of_set) if line.startswith("brightest LED"))
    assert line.split()[2] == text


def test_saturated_pixels_in_every_frame_are_warned_of(tmp_path: Path) -> None:
    """LEDs alone: the ceiling is far below."""
    assert vr.generate(small_plan("poses.count=1", "exposure_s=4e-6"), tmp_path / "set")
    (warning,) = summary(tmp_path / "set")["warnings"]  # type: ignore[misc]
    assert str(warning).startswith("every frame has saturated pixels")


@pytest.mark.parametrize(
    ("recipe", "assignments", "words"),
    [
        ("quickstart", ["camera.focal_length_mm=0.018"], "sees 179 deg across: a lens of 0.018 mm"),
        ("quickstart", ["camera.focal_length_mm=1000"], "sees 0.275 deg across"),
        ("office200", ["camera.pixel_pitch_um=2.4"], "pixels of 2.4 um, but the full well, 4900 electrons, of preset"),
    ],
)
def test_odd_recipes_are_warned_of(recipe: str, assignments: Sequence[str], words: str) -> None:
    (warning,) = vr.load_recipe(recipe, assignments).warnings
    assert words in warning


@pytest.mark.parametrize("path", sorted((ROOT / "datasets").glob("*.toml")), ids=lambda path: path.stem)
def test_no_recipe_of_the_package_is_odd(path: Path) -> None:
    tree = with_presets(read_toml(path), [], path.stem)
    assert recipe_warnings(check(tree, RecipeFile, path.stem)) == ()


def test_a_scaled_recipe_keeps_its_preset() -> None:
    for mode in ("binned", "same-photons"):
        assert vr.load_recipe("office200", scale=20, scale_mode=mode).warnings == ()


def test_the_median_number_of_leds_is_numpys() -> None:
    from collections import Counter

    from vlcrender.dataset.format.summary import _counts

    for numbers in ([3], [1, 2], [0, 0, 7], [5, 1, 1, 9], [2, 2, 2, 8, 9]):
        counts = _counts(Counter(numbers))
        assert (counts.min, counts.median, counts.max) == (min(numbers), float(np.median(numbers)), max(numbers))


def test_sizes_have_three_digits() -> None:
    assert [size_text(n) for n in (0, 999, 1000, 52_958, 1.5e9, 2e13)] == [
        *("0 B", "999 B", "1 kB", "53 kB", "1.5 GB", "20 TB"),
    ]


def test_a_dry_run_writes_nothing_and_estimates_the_size(rendered_set: Path, tmp_path: Path) -> None:
    arguments = [f"--set={a}" for a in (*SMALL, "poses.count=3", "expected=true")]
    out = tmp_path / "set"
    done = run("vlcrender", "generate", "quickstart", "--out", str(out), "--dry-run", *arguments)
    assert (done.returncode, out.exists()) == (0, False)
    assert "frames   3 = 3 poses" in done.stdout
    assert "3 frames (exr-uint32), 3 previews, 3 expected images" in done.stdout
    found = dry_run(small_plan("expected=true"))
    # All three frames were made: their files are those of the set, and the journal's rows stand for the tables.
    files = sum(path.stat().st_size for path in rendered_set.glob("*/*"))
    rows = found.bytes - files
    assert 0 < rows < 3 * 100_000
    assert found.seconds > 0


def test_files_of_shards_and_cells_are_counted() -> None:
    regions = ('regions.kind="leds"', "files.frames_per_file=2", "files.previews=1")
    assert file_counts(small_plan(*regions)) == {"shards": 2, "previews": 1}
    sweep = 'sweep=[{key="accelerometer.error_deg", values=[0.1, 0.2]}]'
    assert file_counts(small_plan(*regions, sweep)) == {"shards": 4, "previews": 2}


def test_a_dry_run_refuses_what_a_run_refuses(tmp_path: Path) -> None:
    plan = vr.load_recipe("table1", ["poses.height_m=3.6"])
    with pytest.raises(vr.InputError, match=r"pose 0: camera position .* is not inside the room"):
        dry_run(plan)


def test_a_thousand_of_many_poses_are_checked() -> None:
    assert poses_to_check(range(3, 3 + MAX_POSES)) == list(range(3, 3 + MAX_POSES))
    chosen = poses_to_check(range(5, 1_000_005))
    assert (len(set(chosen)), chosen[0], chosen[-1]) == (MAX_POSES, 5, 1_000_004)
    assert max(np.diff(chosen)) - min(np.diff(chosen)) <= 1


def test_every_listed_place_is_checked_however_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """One place in 5000 is in a wall, and none of the poses that are made before the first frame."""
    monkeypatch.setattr("vlcrender.dataset.run.possible.MAX_POSES", 2)
    poses = [{"position_m": [2.0, 2.0, 1.0]}] * 5000
    poses[1234] = {"position_m": [2.0, 7.0, 1.0]}
    plan = vr.load_recipe(ROOT / "datasets/quickstart.toml", {"poses": {"kind": "list", "pose": poses}})
    with pytest.raises(vr.InputError, match=r"poses: pose 1234: camera position \[2.0, 7.0, 1.0\] m"):
        check_possible(plan)


def test_an_impossible_pose_among_many_stops_its_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pose 1 of 3 is not checked before; its frame is refused by name, and the others are in the journal."""
    monkeypatch.setattr("vlcrender.dataset.run.possible.MAX_POSES", 2)
    from vlcrender.dataset.recipe import pose_sampling

    found = pose_sampling._aimed_pose

    def none_for_1(poses, tilts, frame, *rest):  # type: ignore[no-untyped-def]
        if frame == 1:
            raise vr.InputError("poses: frame 1: no position")
        return found(poses, tilts, frame, *rest)

    monkeypatch.setattr(pose_sampling, "_aimed_pose", none_for_1)
    with pytest.raises(vr.InputError, match="poses: frame 1: no position"):
        vr.generate(small_plan(), tmp_path / "set")
    assert (tmp_path / "set/journal.jsonl").read_bytes().count(b"\n") == 1


def test_numbers_that_are_not_known_leave_their_lines_out(rendered_set: Path, tmp_path: Path) -> None:
    found = Summary.model_validate(summary(copy_of(rendered_set, tmp_path / "set")))
    unknown = found.model_copy(update={"saturated_share": None, "brightest_e": None, "background_e": None})
    assert len(summary_lines(found)) == len(summary_lines(unknown)) + 3


def test_dark_current_counts_towards_saturation() -> None:
    from vlcrender.camera.roi import RegionImage, Roi
    from vlcrender.rendering.expected_image import ExpectedImage, ExpectedRegion
    from vlcrender.sensor.sensor import Sensor

    roi = Roi(0, 0, 1, 3)
    electrons = np.array([[80.0, 95.0, 100.0]], dtype=np.float32)
    image = ExpectedImage((ExpectedRegion(roi, electrons, ()),))
    for noise, saturated in (("shot", 1), ("full", 2)):
        sensor = Sensor(full_well_e=100.0, noise=noise, dark_current_e_s=10.0)
        assert FrameNumbers.of(image, [RegionImage(roi, electrons)], sensor, 1.0) == FrameNumbers(
            pixels=3, saturated=saturated, brightest_e=100.0, background_e=95.0
        )


def test_the_share_of_checked_poses_is_reported_from_time_to_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vlcrender.dataset.run.possible.POSES_A_REPORT", 2)
    shares: list[float] = []
    check_possible(small_plan("poses.count=5"), shares.append)
    assert shares == [2 / 5, 4 / 5]


def test_the_start_of_a_process_takes_no_negative_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the first frame takes beyond the others counts as the start; a first frame that is quicker has none."""
    made = iter([1.5, 4.0, 4.0, 9.0, 4.0, 4.0])

    def timed(job: Job, frame: int) -> tuple[SimpleNamespace, float, float]:
        return SimpleNamespace(model_dump_json=lambda: ""), next(made), 1.0

    monkeypatch.setattr("vlcrender.dataset.run.dry_run._timed", timed)
    found = [dry_run(small_plan("poses.count=3")) for _ in range(2)]
    assert [(one.start_s, one.wall_s) for one in found] == [(0.0, 4.0), (5.0, 4.0)]


@pytest.mark.parametrize(
    ("share", "text"), [(1.0, "100 %"), (0.125, "12 %"), (0.0123, "1.2 %"), (3e-7, "3e-05 %"), (0.0, "no pixel")]
)
def test_the_share_of_saturated_pixels_is_a_number_as_people_write_it(
    rendered_set: Path, share: float, text: str
) -> None:
    found = Summary.model_validate(summary(rendered_set)).model_copy(update={"saturated_share": share})
    (line,) = [line for line in summary_lines(found) if line.startswith("saturated")]
    assert line.removeprefix("saturated").strip().removesuffix(" of the pixels") == text
