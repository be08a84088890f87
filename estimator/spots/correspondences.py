"""From a frame's images to identified LEDs: what pipelines that work on spots start from."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.io.dataset import DeviceFrame
from estimator.spots.detect import Readout, detect
from estimator.spots.identify import Sighting, identify

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


def sightings(frame: DeviceFrame, denoise: Callable[[Image], Image] | None = None, reach_px: int = 0) -> list[Sighting]:
    """The LEDs in a frame; `denoise` averages over `reach_px` pixels on each side. Raises EstimationFailure."""
    readouts = []
    for part in frame.parts:
        raw = frame.electrons(part)
        image = raw if denoise is None else denoise(raw)
        noise = {"floor_e2": frame.sensor.floor_e2(), "prnu": frame.sensor.prnu}
        readouts.append(Readout(part.row, part.column, image, raw, frame.clipped(part), **noise))
    decoded_px = np.array([(spot.u_px, spot.v_px) for spot in frame.spots]).reshape(-1, 2)
    corners = any(frame.leds[spot.led].shape == "square" for spot in frame.spots)
    spots = detect(readouts, frame.camera.width_px * frame.camera.height_px, reach_px, decoded_px, corners)
    return list(identify(spots, frame.spots, frame.leds))


def led_positions_m(seen: Sequence[Sighting]) -> Floats:
    """Centres of the LEDs seen, (n, 3), world metres."""
    return np.array([sighting.led.position_m for sighting in seen])


def centroids_px(seen: Sequence[Sighting]) -> Floats:
    """Centroids (u, v) of their spots, (n, 2), continuous pixels with pixel centres at +0.5."""
    return np.array([(sighting.spot.u_px, sighting.spot.v_px) for sighting in seen])
