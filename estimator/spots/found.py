"""Spots found in a frame, as the estimates state them: identified LED images and their signal to noise."""

import numpy as np

from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.io.estimates import FoundSpot
from estimator.spots.correspondences import find_correspondences


def found_spots(frame: DeviceFrame) -> tuple[FoundSpot, ...]:
    """Identified spots of a frame, those that a region's border may cut left out; none where detection fails.

    The signal to noise is that of the brightest pixel, `peak / sqrt(peak + floor + (prnu peak)^2)` in electrons, with
    the signal-independent variance `floor` of the sensor; None where the sensor states neither noise nor electrons.
    """
    sensor = frame.sensor
    states_noise = sensor.noise != "none" and sensor.gain_e_per_dn is not None

    def snr(peak_e: float) -> float | None:
        if not states_noise:
            return None
        variance_e2 = peak_e + sensor.floor_e2() + (sensor.prnu * peak_e) ** 2
        return float(peak_e / np.sqrt(variance_e2)) if peak_e > 0 else 0.0

    try:
        correspondences = find_correspondences(frame)
    except EstimationFailure:
        return ()
    return tuple(
        FoundSpot(led=one.led.id, u_px=one.spot.u_px, v_px=one.spot.v_px, snr=snr(one.spot.peak_e))
        for one in sorted(correspondences, key=lambda one: one.led.id)
    )
