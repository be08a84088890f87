"""The whole chain from expected electrons to digital numbers, in the sensor's order."""

import numpy as np
from numpy.typing import NDArray

from vlcrender.poisson import LARGEST_MEAN, poisson
from vlcrender.sensor import Electrons, Sensor, clip_full_well


def variance_e2(sensor: Sensor, expected_e: NDArray[np.float32]) -> NDArray[np.float64]:
    """Variance of each pixel's digital number in electrons squared, same shape; inf where it is saturated.

    Saturated are pixels whose mean is at the full well or at the converter's end. Rounding adds gain^2 / 12 but where a
    digital number is an electron.
    """
    variance = expected_e.astype(np.float64)
    if sensor.gain_e_per_dn != 1.0:
        variance += sensor.gain_e_per_dn**2 / 12
    top_e = min(sensor.full_well_e, (sensor.largest_dn - sensor.black_level_dn) * sensor.gain_e_per_dn)
    variance[expected_e >= top_e] = np.inf
    return variance


def expose(
    sensor: Sensor, expected_e: NDArray[np.float32], key: str, row: int = 0, column: int = 0
) -> NDArray[np.uint32]:
    """Turn expected electrons (rows, columns), finite and >= 0, into digital numbers of the same shape.

    `key` names the stream of random numbers; the window starts at pixel (row, column) of the frame, and its noise is
    that of the whole frame's pixels there.
    """
    electrons: Electrons = expected_e
    if sensor.noise == "shot":
        electrons = poisson(np.minimum(expected_e, np.float32(LARGEST_MEAN)), key, row, column)
    return sensor.quantise(clip_full_well(electrons, sensor.full_well_e))
