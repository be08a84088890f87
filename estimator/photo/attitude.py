"""Attitude of a camera: what a photographer knows of its tilt, as the reading of an accelerometer."""

from dataclasses import dataclass

import numpy as np

from estimator.camera.pose import rotation
from estimator.errors import InputError
from estimator.io.device import Accelerometer

GRAVITY_M_S2 = 9.80665
# Standard deviation of a given direction of gravity where none is stated.
DEFAULT_SIGMA_DEG = 1.0


@dataclass(frozen=True)
class Attitude:
    """Reading (x, y, z) of an accelerometer in the axes of the picture, and its error; both None for unknown."""

    accelerometer_m_s2: tuple[float, float, float] | None
    accelerometer: Accelerometer | None
    said: str


def attitude(
    gravity: str | None = None, tilt: str | None = None, level_deg: float | None = None, sigma_deg: float | None = None
) -> Attitude:
    """Attitude by one of three statements, or unknown.

    Parameters
    ----------
    gravity
        "x,y,z": direction that an accelerometer at rest reads, up, in the picture's axes (right, down, forward).
    tilt
        "tilt_x,tilt_y", degrees (datasets/FORMAT.md).
    level_deg
        The camera was held level, looking straight up, with this standard deviation of each tilt, degrees.
    sigma_deg
        Standard deviation of each tilt for `gravity` and `tilt`, degrees; by default DEFAULT_SIGMA_DEG.

    Raises
    ------
    InputError
        Several statements, or one that is no direction.
    """
    given = [
        name for name, value in (("--gravity", gravity), ("--tilt", tilt), ("--level", level_deg)) if value is not None
    ]
    if len(given) > 1:
        raise InputError(f"{' and '.join(given)}: give one")
    if sigma_deg is not None and given not in (["--gravity"], ["--tilt"]):
        raise InputError("--attitude-sigma: needs --gravity or --tilt")
    error_deg = sigma_deg if sigma_deg is not None else DEFAULT_SIGMA_DEG
    name = "--attitude-sigma"
    if gravity is not None:
        reading = np.array(_numbers("--gravity", gravity, 3))
        if not np.linalg.norm(reading) > 0:
            raise InputError("--gravity: has no direction")
        reading *= GRAVITY_M_S2 / np.linalg.norm(reading)
        said = "gravity given"
    elif tilt is not None:
        tilts = np.radians(_numbers("--tilt", tilt, 2))
        reading = GRAVITY_M_S2 * rotation(float(tilts[0]), float(tilts[1]))[:, 2]
        said = "tilt given"
    elif level_deg is not None:
        reading, error_deg, name = np.array([0.0, 0.0, GRAVITY_M_S2]), level_deg, "--level"
        said = "held level"
    else:
        return Attitude(None, None, "attitude unknown")
    if not 0 < error_deg <= 90:
        raise InputError(f"{name} {error_deg:g}: needed a standard deviation above 0 and at most 90 degrees")
    x, y, z = reading.tolist()
    return Attitude((x, y, z), Accelerometer(kind="tilt-error", error_deg=error_deg), f"{said}, {error_deg:g} deg")


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f"{option} {text!r}: needed {count} numbers with commas between them")
    return numbers
