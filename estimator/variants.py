"""The named pipelines: from what a device has, one frame, to where it is."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimator.dataset import DeviceFrame
from estimator.denoise import REACH_PX, neighbourhood_mean
from estimator.detect import Readout, detect
from estimator.errors import EstimationFailure
from estimator.identify import Sighting, identify
from estimator.position import position_from_pixels, position_from_ranges
from estimator.ranging import PairLaw, law_of_sines, led_ranges, printed_eq3
from estimator.rectify import level, rotation, tilt_from_gravity
from estimator.undistort import pinhole_pixels

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Estimate:
    """The camera's position in the world, (3,) metres, and the distances to LEDs (id -> metres) where it has them."""

    position_m: Floats
    ranges_m: dict[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Variant:
    """A pipeline, the name it goes by, and a line about it; `estimate` raises EstimationFailure."""

    name: str
    summary: str
    estimate: Callable[[DeviceFrame], Estimate]


def huynh2016(frame: DeviceFrame) -> Estimate:
    """Huynh & Yoo 2016 with its slips corrected, and centroids in place of brightest pixels."""
    sightings = _sightings(frame, neighbourhood_mean, REACH_PX)
    return _two_step(frame, sightings, _centroids(sightings), law_of_sines)


def huynh2016_as_printed(frame: DeviceFrame) -> Estimate:
    """Huynh & Yoo 2016 to the letter where the letter computes: brightest pixels and Eq. 3 with its extra cosines.

    Corrected are Eq. 2 (as printed its angles depend on the unit of length), Eq. 6 (its matrix is no rotation) and
    Algorithm 1 (the adjusted intensity is not said; it takes c - mu_S). Eq. 4 has no z with LEDs at one height: z is
    taken from the spheres, as in `huynh2016`, and not by moving LEDs in z.
    """
    sightings = _sightings(frame, neighbourhood_mean, REACH_PX)
    pixels = np.array([(sighting.spot.brightest_u_px, sighting.spot.brightest_v_px) for sighting in sightings])
    return _two_step(frame, sightings, pixels, printed_eq3)


def pnp(frame: DeviceFrame) -> Estimate:
    """Perspective-n-point on centroids of the raw image; gravity is not used."""
    sightings = _sightings(frame, lambda image: image, reach_px=0)
    pixels = pinhole_pixels(_centroids(sightings), frame.camera)
    return Estimate(position_from_pixels(_positions(sightings), pixels, frame.camera.matrix()))


def _sightings(frame: DeviceFrame, denoise: Callable[[Image], Image], reach_px: int) -> tuple[Sighting, ...]:
    """The LEDs in a frame; `denoise` averages over `reach_px` pixels on each side."""
    readouts = []
    for part in frame.parts:
        raw = frame.electrons(part)
        readouts.append(Readout(part.row, part.column, denoise(raw), raw, frame.clipped(part)))
    spots = detect(readouts, frame.camera.width_px * frame.camera.height_px, reach_px)
    return identify(spots, frame.spots, frame.leds)


def _two_step(frame: DeviceFrame, sightings: Sequence[Sighting], pixels: Floats, pair_law: PairLaw) -> Estimate:
    """The paper's way from pixels (n, 2), once the lens is taken out: level them by gravity, ranges, position."""
    K = frame.camera.matrix()
    leds_m = _positions(sightings)
    level_px = level(pinhole_pixels(pixels, frame.camera), K, rotation(*tilt_from_gravity(frame.accelerometer_m_s2)))
    distances_m = led_ranges(level_px, K, leds_m, pair_law)
    ranges_m = {sighting.led.id: float(d) for sighting, d in zip(sightings, distances_m, strict=True)}
    try:
        return Estimate(position_from_ranges(leds_m, distances_m), ranges_m)
    except EstimationFailure as failure:
        raise EstimationFailure(failure.stage, failure.why, ranges_m) from None


def _positions(sightings: Sequence[Sighting]) -> Floats:
    return np.array([sighting.led.position_m for sighting in sightings])


def _centroids(sightings: Sequence[Sighting]) -> Floats:
    return np.array([(sighting.spot.u_px, sighting.spot.v_px) for sighting in sightings])


VARIANTS = {
    variant.name: variant
    for variant in (
        Variant(
            "huynh2016",
            "Huynh & Yoo 2016, corrected: denoise, centroids, level by gravity, ranges from pairs, trilateration",
            huynh2016,
        ),
        Variant(
            "huynh2016-as-printed",
            "Huynh & Yoo 2016 as printed: brightest pixels, Eq. 3 with its extra cosines",
            huynh2016_as_printed,
        ),
        Variant("pnp", "perspective-n-point (SQPNP, IPPE, Levenberg-Marquardt) on raw centroids, no gravity", pnp),
    )
}
