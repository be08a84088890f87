"""What scores.json states of the frames themselves: poses, readings, and what errors at the bound would be."""

from collections.abc import Sequence

import numpy as np

from estimator.io.dataset import FrameRecord
from estimator.io.records import Number, Row, Size
from estimator.io.truth import TruthRow

DRAWS = 200_000
"""Errors that are drawn for the quantiles: the share below each has a standard error of 0.1 % or less."""
DRAW_KEY = 20161119


class FramePose(Row):
    """A frame's camera, exposure and true attitude, row by row.

    `gravity_error_deg` is the angle between the accelerometer's reading and the true vertical; null without a reading.
    """

    camera: str
    exposure_s: Size
    R_cam_world: tuple[Number, ...]
    gravity_error_deg: Size | None


def frame_poses(records: Sequence[FrameRecord], truth: Sequence[TruthRow]) -> tuple[FramePose, ...]:
    """Poses of all frames, in order."""
    return tuple(
        FramePose(
            camera=record.camera,
            exposure_s=record.exposure_s,
            R_cam_world=true.R_cam_world,
            gravity_error_deg=_gravity_error_deg(record, true),
        )
        for record, true in zip(records, truth, strict=True)
    )


def _gravity_error_deg(record: FrameRecord, true: TruthRow) -> float | None:
    if record.accelerometer_m_s2 is None or not any(record.accelerometer_m_s2):
        return None
    reading = np.array(record.accelerometer_m_s2)
    up = np.reshape(true.R_cam_world, (3, 3))[:, 2]
    # The arc tangent is exact for small angles, the arc cosine is not.
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(reading, up)), reading @ up)))


def bound_quantiles_m(truth: Sequence[TruthRow]) -> tuple[float, ...] | None:
    """Sizes of errors at the quantiles 0, 1, ..., 100 %, metres, if each frame's error were drawn from its bound.

    The errors are normal, and the frames that have a bound count alike; None without such a frame. The first and the
    last are the quantiles 0.1 and 99.9 %: those of 0 and 100 % are 0 and infinity.
    """
    bounds_m2 = np.array([row.bound_m2 for row in truth if row.bound_m2 is not None]).reshape(-1, 3, 3)
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
