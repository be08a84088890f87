"""LED images of a frame whose LEDs are modulated under a rolling shutter, with the stripes that the downlink makes."""

import re

import numpy as np
from numpy.typing import NDArray

from estimator.camera.projection import relative_illumination
from estimator.io.camera import Camera
from estimator.io.device import DeviceFrame
from estimator.io.downlink import Codes, Downlink, Packets, SquareFace, Tones, Transmitter
from estimator.spots.led_light import Readout
from estimator.spots.striped import Lamp, find_lamps

Floats = NDArray[np.float64]

# Step of the derivative of the illumination, pixels: it hardly changes over hundreds.
STEP_PX = 4.0


def has_stripes(frame: DeviceFrame) -> bool:
    """Whether the LED images of a frame have stripes: the shutter rolls, and LEDs are modulated."""
    return frame.downlink is not None and frame.camera.shutter.rolls


def longest_dark_s(downlink: Downlink) -> float:
    """Longest time that an LED of the downlink is dark, seconds."""
    return max(_dark_s(transmitter) for transmitter in downlink.transmitters)


def _dark_s(transmitter: Transmitter) -> float:
    if isinstance(transmitter, Codes):
        return max(_longest_run(code + code) for code in transmitter.codes) * transmitter.chip_us * 1e-6
    if isinstance(transmitter, Packets):
        # Manchester code may end with a dark chip before the preamble, and start with one after it.
        return max(2, _longest_run(f"0{transmitter.preamble}0")) * transmitter.chip_us * 1e-6
    if isinstance(transmitter, Tones):
        return (1 - transmitter.duty) / min(transmitter.frequencies_hz)
    raise TypeError(f"{type(transmitter).__name__} is no transmitter")


def _longest_run(chips: str) -> int:
    return max((len(run) for run in re.findall("0+", chips)), default=0)


def readouts_of(frame: DeviceFrame) -> tuple[Readout, ...]:
    """Regions of a frame, in electrons, as they are; once for all variants of the frame."""

    def made() -> tuple[Readout, ...]:
        readouts, sensor = [], frame.sensor
        noise = sensor.floor_e2(), sensor.prnu, sensor.rounding_e2()
        for part in frame.parts:
            electrons = frame.electrons(part)
            readouts.append(Readout(part.row, part.column, electrons, electrons, frame.clipped(part), *noise))
        return tuple(readouts)

    return frame.once(("readouts",), made)


def lamps_of(frame: DeviceFrame) -> tuple[Lamp, ...]:
    """LED images of a frame with a rolling shutter and a downlink, striped or not, larger ones first."""
    shutter, downlink = frame.camera.shutter, frame.downlink
    if downlink is None or not shutter.rolls:
        return ()
    stripe_px = (longest_dark_s(downlink) + frame.exposure_s) / shutter.row_time_s
    squares = any(led.shape == "square" for led in frame.leds.values())
    squares |= any(isinstance(one, Packets) and isinstance(one.led, SquareFace) for one in downlink.transmitters)
    sensor_px = frame.camera.width_px * frame.camera.height_px
    return frame.once(
        ("lamps", stripe_px, squares),
        lambda: find_lamps(readouts_of(frame), shutter.along, stripe_px, sensor_px, squares),
    )


def light_centre_px(lamp: Lamp, camera: Camera) -> Floats:
    """Centroid (u, v), (2,), of the light of an LED image, which the lens illuminates unevenly.

    Within the outline the illumination is linear: the centroid lies off the outline's centre by the second moments
    times the gradient of its logarithm.
    """
    centre = np.array([lamp.u_px, lamp.v_px])
    steps = STEP_PX * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    with np.errstate(all="ignore"):
        right, left, down, up = np.log(relative_illumination(centre + steps, camera))
    gradient = np.array([right - left, down - up]) / (2 * STEP_PX)
    return centre + (lamp.moments_px2 @ gradient if np.isfinite(gradient).all() else 0.0)
