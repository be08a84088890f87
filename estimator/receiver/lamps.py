"""LED images of a frame whose LEDs are modulated: detection with the stripes that the downlink makes."""

import re

import numpy as np

from estimator.io.device import DeviceFrame
from estimator.io.downlink import Codes, Downlink, Packets, SquareFace, Tones
from estimator.spots.detect import Readout
from estimator.spots.striped import Lamp, find_lamps


def longest_dark_s(downlink: Downlink) -> float:
    """Longest time that an LED of the downlink is dark, seconds."""
    return max(_dark_s(transmitter) for transmitter in downlink.transmitters)


def _dark_s(transmitter: Codes | Packets | Tones) -> float:
    if isinstance(transmitter, Codes):
        return max(_longest_run(code + code) for code in transmitter.codes) * transmitter.chip_us * 1e-6
    if isinstance(transmitter, Packets):
        # Manchester code may end with a dark chip before the preamble, and start with one after it.
        return max(2, _longest_run(f"0{transmitter.preamble}0")) * transmitter.chip_us * 1e-6
    return (1 - transmitter.duty) / min(transmitter.frequencies_hz)


def _longest_run(chips: str) -> int:
    return max((len(run) for run in re.findall("0+", chips)), default=0)


def lamps_of(frame: DeviceFrame) -> tuple[Lamp, ...]:
    """LED images of a frame with a rolling shutter and a downlink, striped or not, larger ones first."""
    shutter, sensor, downlink = frame.camera.shutter, frame.sensor, frame.downlink
    if downlink is None or not shutter.rolls:
        return ()
    readouts = []
    for part in frame.parts:
        electrons = frame.electrons(part)
        noise = sensor.floor_e2(), sensor.prnu, sensor.rounding_e2()
        readouts.append(Readout(part.row, part.column, electrons, electrons, frame.clipped(part), *noise))
    stripe_px = (longest_dark_s(downlink) + frame.exposure_s) / shutter.row_time_s
    squares = any(led.shape == "square" for led in frame.leds.values())
    squares |= any(isinstance(one, Packets) and isinstance(one.led, SquareFace) for one in downlink.transmitters)
    sensor_px = frame.camera.width_px * frame.camera.height_px
    return find_lamps(readouts, shutter.along, float(np.ceil(stripe_px)), sensor_px, squares)
