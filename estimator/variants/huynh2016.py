"""Huynh & Yoo, Sensors 2016: denoise, find the LEDs, level by gravity, ranges from pairs, position from ranges.

Each stage can be chosen by name: `huynh2016:denoise=none,position=z-shift`. What is not chosen is corrected.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import level, printed_eq6, rotation, tilt_from_gravity
from estimator.camera.undistort import pinhole_pixels
from estimator.errors import EstimationFailure
from estimator.io.dataset import DeviceFrame
from estimator.solvers.ranging import PairLaw, law_of_sines, led_ranges, printed_eq3
from estimator.solvers.trilateration import position_by_range_fit, position_by_shifted_leds, position_from_ranges
from estimator.spots.correspondences import centroids_px, correspondences, led_positions_m
from estimator.spots.denoise import DENOISERS
from estimator.spots.identify import Correspondence
from estimator.variants.options import read_options
from estimator.variants.variant import Estimate, Variant

Floats = NDArray[np.float64]


def brightest_px(seen: Sequence[Correspondence]) -> Floats:
    """Brightest pixels (u, v) of the spots, (n, 2), by their centres: what the paper takes."""
    return np.array(
        [(correspondence.spot.brightest_u_px, correspondence.spot.brightest_v_px) for correspondence in seen]
    )


SPOTS: dict[str, Callable[[Sequence[Correspondence]], Floats]] = {"centroid": centroids_px, "brightest": brightest_px}
LEVELS: dict[str, Callable[[float, float], Floats]] = {"corrected": rotation, "printed": printed_eq6}
RANGES: dict[str, PairLaw] = {"corrected": law_of_sines, "printed": printed_eq3}
POSITIONS: dict[str, Callable[[Floats, Floats], Floats]] = {
    "direct": position_from_ranges,
    "z-shift": position_by_shifted_leds,
    "nonlinear": position_by_range_fit,
}
STAGES: dict[str, tuple[str, ...]] = {
    "denoise": tuple(DENOISERS),
    "spot": tuple(SPOTS),
    "level": tuple(LEVELS),
    "ranges": tuple(RANGES),
    "position": tuple(POSITIONS),
}
"""The values that each stage may have; the first is the corrected one, and the default."""
DEFAULTS = {stage: values[0] for stage, values in STAGES.items()}
AS_PRINTED = {"denoise": "literal", "spot": "brightest", "level": "printed", "ranges": "printed", "position": "z-shift"}
"""All that computes anything as it stands. Eq. 2 does not: its angles depend on the unit of length, so it has its
squares here too. Eq. 9 is right for square pixels, and Eq. 14's sigma_S is not what Algorithm 1 uses."""


@dataclass(frozen=True)
class Huynh2016:
    """The paper's pipeline with a value for each of STAGES."""

    denoise: str
    spot: str
    level: str
    ranges: str
    position: str

    def __call__(self, frame: DeviceFrame) -> Estimate:
        """Denoise, find the LEDs, take the lens and the tilt out, ranges, position. Raises EstimationFailure."""
        denoiser, noise_e = DENOISERS[self.denoise], float(np.sqrt(frame.sensor.floor_e2()))
        seen = correspondences(frame, lambda raw_e: denoiser.apply(raw_e, noise_e), denoiser.reach_px)
        K, leds_m = frame.camera.matrix(), led_positions_m(seen)
        tilt = LEVELS[self.level](*tilt_from_gravity(frame.accelerometer_m_s2))
        level_px = level(pinhole_pixels(SPOTS[self.spot](seen), frame.camera), K, tilt)
        distances_m = led_ranges(level_px, K, leds_m, RANGES[self.ranges])
        ranges_m = {correspondence.led.id: float(d) for correspondence, d in zip(seen, distances_m, strict=True)}
        try:
            return Estimate(POSITIONS[self.position](leds_m, distances_m), ranges_m)
        except EstimationFailure as failure:
            raise EstimationFailure(failure.stage, failure.why, ranges_m) from None


def huynh2016_with(name: str) -> Variant:
    """`huynh2016:stage=value,...`, under that name; raises InputError for a stage or value there is none of."""
    chosen = read_options(name, STAGES)
    return Variant(name, f"huynh2016 with {', '.join(chosen.values())}", Huynh2016(**(DEFAULTS | chosen)))


HUYNH2016 = Variant(
    "huynh2016",
    "Huynh & Yoo 2016, corrected: denoise, centroids, level by gravity, ranges from pairs, trilateration",
    Huynh2016(**DEFAULTS),
)
HUYNH2016_AS_PRINTED = Variant(
    "huynh2016-as-printed",
    "Huynh & Yoo 2016 as printed: Algorithm 1, brightest pixels, Eq. 6, Eq. 3, LEDs moved in z",
    Huynh2016(**AS_PRINTED),
)
