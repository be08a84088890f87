"""What scores.json states of the frames themselves: poses, readings, and what errors at the bound would be."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Strict

from estimator.io.dataset import FrameRecord
from estimator.io.records import Number, Size, small_row
from estimator.io.truth import TruthRow

Floats = NDArray[np.float64]
DRAWS = 200_000
"""Errors that are drawn for the quantiles: the share below each has a standard error of 0.1 % or less."""
DRAW_KEY = 20161119


@small_row
class FramePose:
    """A frame's camera, exposure and true attitude, row by row.

    `gravity_error_deg` is the angle between the accelerometer's reading and the true vertical; null without a reading.
    """

    camera: Annotated[str, Strict()]
    exposure_s: Size
    R_cam_world: Annotated[tuple[Number, ...], Strict(False)]
    gravity_error_deg: Size | None


def frame_pose(record: FrameRecord, true: TruthRow) -> FramePose:
    """Pose of a frame."""
    return FramePose(
        camera=record.camera,
        exposure_s=record.exposure_s,
        R_cam_world=true.R_cam_world,
        gravity_error_deg=_gravity_error_deg(record, true),
    )


def _gravity_error_deg(record: FrameRecord, true: TruthRow) -> float | None:
    if record.accelerometer_m_s2 is None or not any(record.accelerometer_m_s2):
        return None
    reading = np.array(record.accelerometer_m_s2)
    up = np.reshape(true.R_cam_world, (3, 3))[:, 2]
    # The arc tangent is exact for small angles, the arc cosine is not.
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(reading, up)), reading @ up)))


def bound_quantiles_m(bounds_m2: Floats) -> tuple[float, ...] | None:
    """Sizes of errors at the quantiles 0, 1, ..., 100 %, metres, if each frame's error were drawn from its bound.

    The errors are normal, and the frames of `bounds_m2` (n, 3, 3) count alike; None without a frame. The first and the
    last are the quantiles 0.1 and 99.9 %: those of 0 and 100 % are 0 and infinity.
    """
    if not len(bounds_m2):
        return None
    generator = np.random.Generator(np.random.Philox(key=DRAW_KEY))
    # An error's squared size is the sum of the variances along the axes of the bound, times chi-square of one.
    variances_m2 = np.clip(np.linalg.eigvalsh(bounds_m2), 0, None)
    count = -(-DRAWS // len(variances_m2))
    sizes_m = np.sqrt(
        np.einsum("fca,fa->fc", generator.standard_normal((len(variances_m2), count, 3)) ** 2, variances_m2)
    )
    shares = np.clip(np.arange(101) / 100, 0.001, 0.999)
    return tuple(np.quantile(sizes_m, shares).tolist())
