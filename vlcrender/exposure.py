"""The whole chain from expected electrons to digital numbers, in the sensor's order."""

import numpy as np
from numpy.typing import NDArray

from vlcrender.poisson import LARGEST_MEAN, poisson
from vlcrender.sensor import Electrons, Sensor, clip_full_well


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
