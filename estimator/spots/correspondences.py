"""Correspondences: from a frame's images to spots of identified LEDs, the input of methods that work on spots."""

import weakref
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.spots.denoise import DENOISERS, Denoiser, neighbourhood_mean
from estimator.spots.detect import Spot, detect
from estimator.spots.excess_noise import excess_noise_of_spots_e2
from estimator.spots.identify import Correspondence, gate_px, identify
from estimator.spots.lamps import has_stripes, lamps_of, light_centre_px, readouts_of
from estimator.spots.led_light import Readout
from estimator.spots.sampling import lens_blur

Floats = NDArray[np.float64]
RAW = DENOISERS["none"]

# Offset of the plain centroid of a steady LED image from the centre of its outline, as a share of its second moment.
MAX_STEADY_OFF = 0.2


def find_correspondences(
    frame: DeviceFrame, denoiser: Denoiser = RAW, cut_too: bool = False, with_covariances: bool = True
) -> list[Correspondence]:
    """Spots in a frame that are identified as LEDs, with `cut_too` also those that a region's border may cut.

    A method that uses no covariances leaves them out by `with_covariances`; those of raw images are always there.

    Under a rolling shutter, spots of LED images with stripes are the centres of their outlines
    (`estimator.spots.striped`), without denoising, which would mix lines. Raises EstimationFailure if no LED is
    detected or identified.
    """
    striped = has_stripes(frame)
    if striped:
        denoiser = RAW
    with_covariances |= denoiser is RAW

    def identified() -> tuple[Correspondence, ...]:
        spots = _striped(frame) if striped else _detected(frame, denoiser, with_covariances)
        return identify(spots, frame.spots, frame.leds, _gate_px(frame, denoiser), cut_too)

    # The reference does not keep the frame, which holds the results, and no other frame equals it.
    return list(frame.once(("correspondences", denoiser, cut_too, with_covariances, weakref.ref(frame)), identified))


def _gate_px(frame: DeviceFrame, denoiser: Denoiser) -> float:
    # A denoiser may move light by its radius: Algorithm 1 as printed does by half of it.
    return gate_px(frame.camera.width_px) + denoiser.radius_px


def _detected(frame: DeviceFrame, denoiser: Denoiser, with_covariances: bool = True) -> tuple[Spot, ...]:
    """Spots of LED images without stripes; raises EstimationFailure if there is none."""
    any_square = any(frame.leds[spot.led].shape == "square" for spot in frame.spots)

    def detected() -> tuple[Spot, ...]:
        readouts, sensor = _denoised(frame, denoiser), frame.sensor
        decoded_px = np.array([(spot.u_px, spot.v_px) for spot in frame.spots]).reshape(-1, 2)
        sensor_px = frame.camera.width_px * frame.camera.height_px
        rest = _gate_px(frame, denoiser), lens_blur(frame.camera), sensor.crosstalk, with_covariances
        spots = detect(readouts, sensor_px, denoiser.radius_px, decoded_px, any_square, *rest)
        excess_e2 = excess_noise_of_spots_e2(readouts, spots, sensor) if with_covariances else 0.0
        if excess_e2 > 0:
            readouts = tuple(replace(readout, floor_e2=readout.floor_e2 + excess_e2) for readout in readouts)
            spots = detect(readouts, sensor_px, denoiser.radius_px, decoded_px, any_square, *rest)
        return spots

    return frame.once(("spots", denoiser, frame.spots, any_square, with_covariances), detected)


def _denoised(frame: DeviceFrame, denoiser: Denoiser) -> tuple[Readout, ...]:
    """Regions of a frame with denoised images."""
    readouts = readouts_of(frame)
    if denoiser is RAW:
        return readouts
    if denoiser.by_means is None:
        floor_sigma_e = float(np.sqrt(frame.sensor.floor_e2()))
        images = [denoiser.apply(one.raw_e, floor_sigma_e) for one in readouts]
    else:
        means = frame.once(("means",), lambda: tuple(neighbourhood_mean(one.raw_e) for one in readouts))
        images = [denoiser.by_means(one.raw_e, mean) for one, mean in zip(readouts, means, strict=True)]
    return tuple(one.denoised(image) for one, image in zip(readouts, images, strict=True))


def _striped(frame: DeviceFrame) -> list[Spot]:
    """Spots of a frame with stripes; steady LED images have their plain centroids."""
    lamps = lamps_of(frame)
    if not lamps:
        raise EstimationFailure("detect", "no LED image with stripes or without found")
    steady = () if all(lamp.striped for lamp in lamps) else _detected(frame, RAW)
    steady_px = np.array([(spot.u_px, spot.v_px) for spot in steady]).reshape(-1, 2)
    spots = []
    for lamp in lamps:
        u_px, v_px = light_centre_px(lamp, frame.camera).tolist()
        spot = replace(lamp.spot(), u_px=u_px, v_px=v_px)
        if not lamp.striped and len(steady):
            off_px = np.abs(steady_px - (lamp.u_px, lamp.v_px))
            nearest = int(off_px.sum(axis=1).argmin())
            # A plain centroid and that of the edges differ by less than a tenth of the LED image's size.
            if (off_px[nearest] ** 2 <= MAX_STEADY_OFF**2 * np.diag(lamp.moments_px2)).all():
                spot = steady[nearest]
        spots.append(spot)
    return spots


def led_positions_m(correspondences: Sequence[Correspondence]) -> Floats:
    """Centres of the LEDs, (n, 3), world metres."""
    return np.array([correspondence.led.position_m for correspondence in correspondences]).reshape(-1, 3)


def centroids_px(correspondences: Sequence[Correspondence]) -> Floats:
    """Centroids (u, v) of the spots, (n, 2), continuous pixels with pixel centres at +0.5."""
    return np.array([(one.spot.u_px, one.spot.v_px) for one in correspondences]).reshape(-1, 2)
