"""Error of huynh2016 by the accelerometer's error: predicted to first order, and measured on images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from estimator_synthetic import GRAVITY_M_S2, Array, grid, view_of

from estimator.camera.leveling import level
from estimator.camera.pose import rotation
from estimator.io.dataset import Dataset, read_dataset, read_frame
from estimator.methods.catalogue import VARIANTS
from estimator.solvers.ranging import law_of_sines, led_ranges
from estimator.solvers.trilateration import position_from_ranges

STEP = 1e-6


@pytest.fixture(scope="module")
def quiet(exact_synthetic_set: Path) -> Path:
    """Frames without noise: level, tilted, and tilted the other way and turned."""
    return exact_synthetic_set


def position_at(dataset: Dataset, leds: list[dict[str, float]], tilt: Array) -> Array:
    """What the paper's geometry makes of exact pixels, were the tilt this one."""
    K = dataset.cameras["main"].matrix()
    leds_m = np.array([dataset.leds[int(led["led"])].position_m for led in leds])
    pixels = np.array([(led["u_px"], led["v_px"]) for led in leds])
    level_px = level(pixels, K, rotation(*tilt))
    return position_from_ranges(leds_m, led_ranges(level_px, K, leds_m, law_of_sines))


def slopes(dataset: Dataset, leds: list[dict[str, float]], tilt: Array) -> Array:
    """Metres a radian of error on (tilt_x, tilt_y), (3, 2), by central differences at exact pixels."""
    ends = [
        position_at(dataset, leds, tilt + STEP * axis) - position_at(dataset, leds, tilt - STEP * axis)
        for axis in np.eye(2)
    ]
    return np.column_stack(ends) / (2 * STEP)


@pytest.mark.parametrize("error_deg", [0.1, 0.5, 2.0])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (0.8, -0.6)])
def test_the_error_is_the_slope_times_the_tilt_error(
    quiet: Path, error_deg: float, direction: tuple[float, float]
) -> None:
    """What is left of first order is second order, (p(+) + p(-) - 2 p(0)) / 2 at exact pixels, and a third that is
    smaller still by the error over what changes it, 2 deg over some 30 deg; and the ellipse's bias, below 1 mm.
    """
    dataset = read_dataset(quiet)
    truth = pq.read_table(quiet / "truth.parquet").to_pylist()
    for record, true in zip(dataset.frames, truth, strict=True):
        tilt = np.radians([true["tilt_x_deg"], true["tilt_y_deg"]])
        delta = np.radians(error_deg) * np.array(direction)
        x, y, z = rotation(*(tilt + delta)) @ [0.0, 0.0, GRAVITY_M_S2]
        frame = replace(read_frame(dataset, record), accelerometer_m_s2=(float(x), float(y), float(z)))
        estimate = VARIANTS["huynh2016"].estimate(frame)
        leds = [led for led in true["leds"] if led["led"] in estimate.ranges_m]
        error = estimate.position_m - true["position_m"]
        first = slopes(dataset, leds, tilt) @ delta
        ends = [position_at(dataset, leds, tilt + sign * delta) for sign in (1, -1)]
        second = np.linalg.norm(sum(ends) / 2 - true["position_m"])
        assert np.linalg.norm(first) > 10e-3 * error_deg
        assert np.linalg.norm(error - first) < 1.2 * second + 1e-3


@pytest.mark.parametrize("axis", [0, 1])
def test_below_a_square_of_leds_the_slope_is_three_quarters_of_the_depth(axis: int) -> None:
    """By hand: LEDs at (+-w, +-w), the camera level below their middle at depth h, e = w / h.

    An error t moves u = +-e to u + t (1 + u^2) and v to v (1 + t u). That lengthens the ray to an LED at u = e by t e.
    Of its pairs the side along v grows by t e in the image, with a quarter of the weights, the others do not: ranges
    change by t e (1 - 1/4), squares of ranges by twice that, and x by 3/4 t h (1 + 2 e^2). Table 2 of the paper has
    4.6e-7 m for 2 deg, this 79 mm at 3 m.
    """
    view, w = view_of((3, 2, 3.5), 3.0, size=(4000, 3000, 15000.0)), 0.15
    leds_m = grid(2, 2, 2 * w, (3, 2, 3.5))

    def position(error: float) -> Array:
        tilt = error * np.eye(2)[axis]
        level_px = level(view.project(leds_m), view.K, rotation(*tilt))
        return position_from_ranges(leds_m, led_ranges(level_px, view.K, leds_m, law_of_sines))

    slope = (position(STEP) - position(-STEP)) / (2 * STEP)
    # Differences round at 1e-13 m over the step, and turn by a share of the step squared.
    assert np.linalg.norm(slope) == pytest.approx(0.75 * 3.0 * (1 + 2 * (w / 3.0) ** 2), abs=1e-5)
