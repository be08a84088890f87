"""Accuracy of the whole chain on full-size frames, compared with the expected errors."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import ROOT

from estimator.camera.leveling import level, tilt_from_gravity
from estimator.camera.pose import rotation
from estimator.io.dataset import Dataset, read_dataset, read_frame
from estimator.methods.catalogue import VARIANTS, variant_named
from estimator.solvers.ranging import law_of_sines, led_ranges
from estimator.solvers.trilateration import position_from_ranges
from vlcrender.camera.intrinsics import Camera
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.generate import generate


@pytest.fixture(scope="module")
def ideal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The quickstart's first frames at full size, without noise and with an exact accelerometer."""
    out = tmp_path_factory.mktemp("accuracy") / "ideal"
    plan = load_plan(
        ROOT / "datasets/quickstart.toml",
        ["poses.count=3", "sensor.noise=none", "accelerometer.error_deg=0"],
    )
    generate(plan, out)
    return out


def from_pixels(dataset: Dataset, frame: int, leds: list[int], pixels: np.ndarray) -> np.ndarray:
    """The paper's geometry alone, from given pixels of given LEDs to a position."""
    record = dataset.frames[frame]
    matrix = dataset.cameras[record.camera].matrix()
    world = np.array([dataset.leds[led].position_m for led in leds])
    leveled = level(pixels, matrix, rotation(*tilt_from_gravity(record.accelerometer_m_s2)))
    return position_from_ranges(world, led_ranges(leveled, matrix, world, law_of_sines))


def image_of_a_circle_centre(
    matrix: np.ndarray, r: np.ndarray, position: np.ndarray, led: np.ndarray, radius: float
) -> np.ndarray:
    """Centre (u, v) of the ellipse that a horizontal circle makes, from its conic: independent of both packages."""
    homography = matrix @ np.column_stack([r[:, 0], r[:, 1], r @ (led - position)])
    inverse = np.linalg.inv(homography)
    conic = inverse.T @ np.diag([1.0, 1.0, -(radius**2)]) @ inverse
    return np.linalg.solve(conic[:2, :2], -conic[:2, 2])


@pytest.mark.slow
def test_without_noise_huynh2016_errs_only_by_what_a_pixel_can_explain(ideal: Path) -> None:
    dataset = read_dataset(ideal)
    truth = pq.read_table(ideal / "truth.parquet").to_pylist()
    generator = np.random.Generator(np.random.Philox(1))
    for record, row in zip(dataset.frames, truth, strict=True):
        position = np.array(row["position_m"])
        r = np.array(row["R_cam_world"]).reshape(3, 3)
        whole = [led for led in row["leds"] if led["visible_fraction"] == 1]
        ids = [led["led"] for led in whole]
        exact = np.array([[led["u_px"], led["v_px"]] for led in whole])

        # exact pixels give the exact position: 1e-16 * condition (distance^2 / baseline^2, some 1e3)
        assert np.linalg.norm(from_pixels(dataset, record.frame, ids, exact) - position) < 1e-9

        estimate = VARIANTS["huynh2016"].estimate(read_frame(dataset, record))
        error = np.linalg.norm(estimate.position_m - position)

        # 1. Expected of whole pixels: each coordinate in error by up to half a pixel, uniformly distributed.
        rounded = [
            np.linalg.norm(
                from_pixels(dataset, record.frame, ids, exact + generator.uniform(-0.5, 0.5, exact.shape)) - position
            )
            for _ in range(200)
        ]
        assert error < np.median(rounded)

        # 2. Expected of centroids: a disc's image is an ellipse whose centre is not the image of the disc's centre.
        ellipses = np.array(
            [
                image_of_a_circle_centre(
                    dataset.cameras["main"].matrix(),
                    r,
                    position,
                    np.array(dataset.leds[led].position_m),
                    dataset.leds[led].half_width_m,
                )
                for led in ids
            ]
        )
        predicted = np.linalg.norm(from_pixels(dataset, record.frame, ids, ellipses) - position)
        # The remainder: illumination across the disc (cos^4) and rounding to digital numbers, 0.02 px together,
        # 1/15 of the even half pixel's 0.29 px rms.
        left = np.median(rounded) / 15
        print(
            f"frame {record.frame}: measured {1e6 * error:.0f} um; ellipse centres {1e6 * predicted:.0f} um; "
            f"whole pixels {1e6 * np.median(rounded):.0f} um"
        )
        assert abs(error - predicted) < left


@pytest.mark.slow
def test_the_printed_equation_3_does_not_find_the_camera(ideal: Path) -> None:
    dataset = read_dataset(ideal)
    frame = read_frame(dataset, dataset.frames[0])
    with pytest.raises(Exception, match="too short to reach"):
        variant_named("huynh2016:ranges=printed").estimate(frame)


def test_fov_of_the_default_camera_is_the_papers_sensor_and_lens() -> None:
    assert Camera().width_px * Camera().pixel_pitch_um == pytest.approx(4800)
    assert Camera().focal_length_mm == 18.0
