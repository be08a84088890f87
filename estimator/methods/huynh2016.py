"""Huynh & Yoo, Sensors 2016: denoise, detect the LEDs, level by gravity, ranges from pairs, position from ranges.

LEDs may be at unequal heights: they send three coordinates, though the paper's figures show one ceiling. What had to be
filled in for them is in `estimator.solvers.ranging` and `estimator.solvers.trilateration`.

Each stage can be chosen by name: `huynh2016:denoise=none,position=z-shift`. The default of every stage is the corrected
one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import level, printed_eq6, tilt_from_gravity
from estimator.camera.pose import rotation
from estimator.camera.undistort import pinhole_pixels
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.options import read_options
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.ranging import PairLaw, law_of_sines, led_ranges, printed_eq3
from estimator.solvers.trilateration import position_by_range_fit, position_by_shifted_leds, position_from_ranges
from estimator.spots.correspondences import centroids_px, find_correspondences, led_positions_m
from estimator.spots.denoise import DENOISERS
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]


def brightest_px(correspondences: Sequence[Correspondence]) -> Floats:
    """Centres (u, v) of the spots' brightest pixels, (n, 2), which the paper uses."""
    return np.array([(one.spot.brightest_u_px, one.spot.brightest_v_px) for one in correspondences])


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
"""Values of each stage; the first is the corrected one, and the default."""
DEFAULTS = {stage: values[0] for stage, values in STAGES.items()}
AS_PRINTED = {"denoise": "literal", "spot": "brightest", "level": "printed", "ranges": "printed", "position": "z-shift"}
"""The paper's equations exactly as printed, but for Eq. 2: as printed its angles depend on the unit of length, so its
squares are restored here too. Eq. 9 is right for square pixels, and Algorithm 1 does not use Eq. 14's sigma_S."""


@dataclass(frozen=True)
class Huynh2016:
    """The paper's method with a value for each of STAGES."""

    denoise: str
    spot: str
    level: str
    ranges: str
    position: str

    def __call__(self, frame: DeviceFrame) -> Estimate:
        """Denoise, detect, undistort, level, ranges, position. Raises EstimationFailure."""
        correspondences = find_correspondences(frame, DENOISERS[self.denoise], with_covariances=False)
        K, leds_m = frame.camera.matrix(), led_positions_m(correspondences)
        tilt = LEVELS[self.level](*tilt_from_gravity(frame.accelerometer_m_s2))
        level_px = level(pinhole_pixels(SPOTS[self.spot](correspondences), frame.camera), K, tilt)
        distances_m = led_ranges(level_px, K, leds_m, RANGES[self.ranges])
        ranges_m = {one.led.id: float(d) for one, d in zip(correspondences, distances_m, strict=True)}
        try:
            return Estimate(POSITIONS[self.position](leds_m, distances_m), ranges_m)
        except EstimationFailure as failure:
            raise EstimationFailure(failure.stage, failure.why, ranges_m) from None


def huynh2016_with(name: str) -> Variant:
    """The variant `huynh2016:stage=value,...`; raises InputError for an unknown stage or value."""
    chosen = read_options(name, STAGES)
    return Variant(name, f"huynh2016 with {', '.join(chosen.values())}", Huynh2016(**(DEFAULTS | chosen)))


HUYNH2016 = Variant(
    "huynh2016",
    "Huynh & Yoo 2016, corrected: denoise, centroids, level by gravity, ranges from pairs, trilateration",
    Huynh2016(**DEFAULTS),
    needs=Needs(3, sensors=("accelerometer",)),
)
HUYNH2016_AS_PRINTED = Variant(
    "huynh2016-as-printed",
    "Huynh & Yoo 2016 as printed: Algorithm 1, brightest pixels, Eq. 6, Eq. 3, LEDs moved in z",
    Huynh2016(**AS_PRINTED),
    needs=Needs(4, sensors=("accelerometer",)),
)
