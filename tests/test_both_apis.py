"""The Python APIs of both packages together: ten lines from a scene to scores, with nothing shared but the format."""

from pathlib import Path

import numpy as np
import pytest
from conftest import SMALL

import estimator as est
import vlcrender as vr

POSE = vr.Pose((3.15, 3.10, 0.60), tilt_x_deg=6, tilt_y_deg=-8)


def test_ten_lines_make_a_frame_a_position_a_data_set_and_scores(tmp_path: Path) -> None:
    """The error is within five of the estimate's own standard deviations, and each of those below a millimetre."""
    scene = vr.load_scene("office")
    camera = vr.Camera(width_px=1000, height_px=750, pixel_pitch_um=4.8)
    mean = vr.render(scene, camera, POSE)
    raw = vr.expose(mean, vr.Sensor.preset("phone-1.2um"), exposure_s=160e-6, seed=1)
    answer = est.estimate(est.frame(raw.record()), "ml")
    vr.generate("quickstart", tmp_path / "q", overrides=[*SMALL, "poses.count=2"])
    est.run(tmp_path / "q", ["ml"])
    table = est.score(tmp_path / "q").to_pandas()

    sigma_m = np.sqrt(np.linalg.eigvalsh(answer.covariance_m2).max())
    assert sigma_m < 1e-3
    assert np.linalg.norm(answer.position_m - np.array(POSE.position_m)) < 5 * sigma_m
    (row,) = table.to_dict("records")
    assert (row["variant"], row["frames"], row["success_rate"]) == ("ml", 2, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("regions", [None, vr.LedRegions(kind="leds", margin_px=10)])
def test_a_record_is_what_the_reader_of_data_sets_gives(regions: vr.LedRegions | None, tmp_path: Path) -> None:
    """All fields of the frame that `estimator.read_frame` reads from a dataset of the same seed and pose."""
    overrides = [*SMALL, "poses.count=1", "sensor.preset=phone-1.2um", "camera.pixel_pitch_um=12.0"]
    overrides += ["regions.kind=leds", "regions.margin_px=10"] if regions is not None else []
    plan = vr.load_recipe("quickstart", overrides)
    vr.generate(plan, tmp_path / "set")
    read = est.read_frame(est.read_dataset(tmp_path / "set"), 0)
    recipe = plan.recipe
    pose = _first_pose(tmp_path / "set")
    mean = vr.render(plan.scene, recipe.camera, pose, regions=regions)
    assert recipe.exposure_s is not None
    raw = vr.expose(mean, recipe.sensor, recipe.exposure_s, recipe.seed, recipe.accelerometer)
    made = est.frame(raw.record())
    for name in ("camera", "sensor", "accelerometer", "accelerometer_m_s2", "exposure_s", "spots", "leds"):
        assert getattr(made, name) == getattr(read, name), name
    assert len(made.parts) == len(read.parts)
    for own, other in zip(made.parts, read.parts, strict=True):
        assert (own.row, own.column) == (other.row, other.column)
        assert np.array_equal(own.image_dn, other.image_dn)


def _first_pose(directory: Path) -> vr.Pose:
    import pyarrow.parquet as pq

    truth = pq.read_table(directory / "truth.parquet").to_pylist()[0]
    x, y, z = truth["position_m"]
    return vr.Pose((x, y, z), truth["tilt_x_deg"], truth["tilt_y_deg"], truth["yaw_deg"])
