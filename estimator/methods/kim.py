"""Kim et al., the fourth of Huynh & Yoo 2016's Table 3 (their [15]): two image sensors, position by vectors.

Published, as far as known from Huynh & Yoo alone: it implements the idea of `rahman2011` with two sensors parallel to
the ceiling, in two steps, and reaches 85 cm. By its place in their list it should be Kim, Cho, Park & Kim,
"Implementation of indoor positioning using LED and dual PC cameras", Ubiquitous and Future Networks 2012, which was not
available.

Chosen here: nearly all. Disparity gives the vector from the camera to each LED (`estimator.solvers.stereo`), in camera
axes. With the sensors parallel to the ceiling these are the world's axes up to a rotation about the vertical, which the
differences of the vectors determine. The position is the mean of the LEDs minus their rotated vectors. The
accelerometer is used only to refuse cameras that are not level: the error is the depth times the tilt.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import tilt_from_gravity
from estimator.camera.pose import rotation
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.stereo import led_vectors
from estimator.spots.correspondences import led_positions_m

Floats = NDArray[np.float64]

# A tilt of 5 deg causes an error of 0.09 of the depth, 0.2 m below a ceiling.
MAX_TILT_DEG = 5.0
MIN_LEDS = 2


def kim(frame: DeviceFrame) -> Estimate:
    """Position from vectors by disparity, for level cameras; raises EstimationFailure."""
    correspondences, vectors_m = led_vectors(frame)
    distances_m = np.linalg.norm(vectors_m, axis=1)
    ranges_m = {one.led.id: float(d) for one, d in zip(correspondences, distances_m, strict=True)}
    try:
        _check_level(frame.accelerometer_m_s2)
        return Estimate(position_from_vectors(led_positions_m(correspondences), vectors_m), ranges_m)
    except EstimationFailure as failure:
        raise EstimationFailure(failure.stage, failure.why, ranges_m) from None


def _check_level(accelerometer_m_s2: tuple[float, float, float] | None) -> None:
    if np.degrees(np.abs(tilt_from_gravity(accelerometer_m_s2)).max()) > MAX_TILT_DEG:
        why = "the camera is tilted, and the method assumes it parallel to the ceiling"
        raise EstimationFailure("leveling", why)


def position_from_vectors(leds_m: Floats, vectors_m: Floats) -> Floats:
    """Position, (3,) world metres, of a level camera from LEDs (n, 3) and vectors to them (n, 3) in camera axes.

    Yaw is the rotation about z that best maps the LEDs' offsets from their centre to the vectors', by least squares.
    Raises EstimationFailure for fewer than two LEDs.
    """
    if len(leds_m) < MIN_LEDS:
        raise EstimationFailure("position", f"LEDs identified: {len(leds_m)}, needed: {MIN_LEDS}")
    led_m, vector_m = leds_m.mean(axis=0), vectors_m.mean(axis=0)
    a, v = (leds_m - led_m)[:, :2], (vectors_m - vector_m)[:, :2]
    yaw = float(np.arctan2((a[:, 1] * v[:, 0] - a[:, 0] * v[:, 1]).sum(), (a * v).sum()))
    return np.asarray(led_m - rotation(0.0, 0.0, yaw).T @ vector_m)


KIM = Variant(
    "kim",
    "Kim et al. (Table 3 of Huynh & Yoo 2016): vectors from two parallel level cameras",
    kim,
    needs=Needs(2, sensors=("second camera", "accelerometer"), attitude="level"),
)
