"""Quantisation: whether the noise of a pixel is large enough for rounding to act as one more independent noise.

A mean of x digital numbers, with normal noise of s digital numbers, is rounded to a mean of x + sin(2 pi x) / pi *
exp(-2 pi^2 s^2), and smaller terms (B. Widrow and I. Kollar, Quantization Noise, 2008, chapter 4: the characteristic
function of the noise at multiples of the rounding's frequency). This error is the same in every pixel of one mean. From
s = MIN_NOISE_STEPS on it is below a tenth of the standard deviation that rounding adds to a single pixel, 1 / sqrt(12):
exp(-2 pi^2 s^2) / pi < 0.1 / sqrt(12) for s > sqrt(ln(10 sqrt(12) / pi) / (2 pi^2)) = 0.349.
"""

import math

import numpy as np

from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import variance_e2

MIN_NOISE_STEPS = 0.35
"""Standard deviation of a pixel's noise, digital numbers, below which rounding does not act as independent noise."""


def noise_steps(sensor: Sensor, mean_e: float, exposure_s: float) -> float:
    """Standard deviation of a pixel's noise without rounding, digital numbers.

    mean_e: mean electrons of the pixel, not saturated. Infinite where digital numbers are counts of electrons, which
    are not rounded, and where the sensor has no noise by its settings.
    """
    gain = sensor.gain_at_iso_e_per_dn
    if sensor.noise == "none" or (sensor.noise == "shot" and gain == 1.0):
        return math.inf
    variance = float(variance_e2(sensor, np.full((1, 1), mean_e, dtype=np.float32), exposure_s)[0, 0])
    return math.sqrt(variance - gain**2 / 12) / gain
