"""Kim et al., the fourth of Huynh & Yoo 2016's Table 3 (their [15]): two image sensors, position by vectors.

Known of it, from Huynh & Yoo alone: it implements the idea of rahman2011 with two sensors parallel to the ceiling, in
two steps, and reaches 85 cm. By its place in their list it should be Kim, Cho, Park & Kim, "Implementation of indoor
positioning using LED and dual PC cameras", Ubiquitous and Future Networks 2012, whose text was not to be had.

Filled in: nearly all. Disparity gives the vector from the camera to each LED (stereo.py), in the camera's axes. With
the sensors parallel to the ceiling these are the world's but for a turn about the vertical, which the LEDs' vectors
among themselves show; the position is where the vectors, turned back from the LEDs, lead on average. The accelerometer
takes no part, but for refusing what is plainly not level: the answer is off by the depth times the tilt.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import tilt_from_gravity
from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame
from estimator.solvers.stereo import led_vectors
from estimator.spots.correspondences import led_positions_m
from estimator.variants.variant import Estimate, Variant

Floats = NDArray[np.float64]

# A tilt of 5 deg moves the answer by 0.09 of the depth, 0.2 m below a ceiling: no answer any more.
MAX_TILT_DEG = 5.0
MIN_LEDS = 2


def kim(frame: DeviceFrame) -> Estimate:
    """Position from vectors by disparity, of cameras that look straight up. May fail by name."""
    seen, vectors_m = led_vectors(frame)
    ranges_m = {s.led.id: float(d) for s, d in zip(seen, np.linalg.norm(vectors_m, axis=1), strict=True)}
    try:
        _check_level(frame.accelerometer_m_s2)
        return Estimate(position_from_vectors(led_positions_m(seen), vectors_m), ranges_m)
    except EstimationFailure as failure:
        raise EstimationFailure(failure.stage, failure.why, ranges_m) from None


def _check_level(accelerometer_m_s2: tuple[float, float, float]) -> None:
    if np.degrees(np.abs(tilt_from_gravity(accelerometer_m_s2)).max()) > MAX_TILT_DEG:
        raise EstimationFailure("level", "the camera is tilted, and the method takes it to be parallel to the ceiling")


def position_from_vectors(leds_m: Floats, vectors_m: Floats) -> Floats:
    """The position, (3,) metres, of a level camera from LEDs (n, 3) and the vectors to them (n, 3) in its axes.

    Yaw is the turn about z that takes the LEDs' offsets from their centre nearest to the vectors', in squares.
    Raises EstimationFailure for fewer than two LEDs.
    """
    if len(leds_m) < MIN_LEDS:
        raise EstimationFailure("position", f"LEDs identified: {len(leds_m)}, needed: {MIN_LEDS}")
    led_m, vector_m = leds_m.mean(axis=0), vectors_m.mean(axis=0)
    a, v = (leds_m - led_m)[:, :2], (vectors_m - vector_m)[:, :2]
    yaw = np.arctan2((a[:, 1] * v[:, 0] - a[:, 0] * v[:, 1]).sum(), (a * v).sum())
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(led_m - np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]).T @ vector_m)


KIM = Variant("kim", "Kim et al. (Table 3 of Huynh & Yoo 2016): vectors from two parallel level cameras", kim)
