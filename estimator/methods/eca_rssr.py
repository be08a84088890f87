"""eCA-RSSR: Bai, Yang, Feng, Guo & Cheng, "A high coverage camera assisted received signal strength ratio algorithm for
indoor visible light positioning", arXiv 2004.06294, 2020: ranges from ratios of received power.

Published, as far as known from its abstract: the camera gives the angles of incidence, a photodiode the ratios of
received power, and both the ratios of the distances to three LEDs; a theorem of Euclidean plane geometry makes the
ratios absolute; linear least squares give the position; any orientation; a compensation for the distance between
photodiode and camera; centimetres over 80 % of the area in simulation.

Chosen here: the power is the flux of the LED's image (`estimator.solvers.received_power`), so the photodiode is in the
camera and there is nothing to compensate. All LEDs are Lambertian, of one radiance, face down and at one height: cos
phi is then h / d, and flux is proportional to cos(theta) h / d^3. The theorem is the law of cosines, for all pairs of
LEDs by least squares: with d_i = k_i d it gives `|a_i - a_j| = d sqrt(k_i^2 + k_j^2 - 2 k_i k_j cos(gamma_ij))`. The
position is that of `position_from_ranges`. More than three LEDs are used if there are more.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.camera.undistort import pinhole_image
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.received_power import fluxes, with_power
from estimator.solvers.trilateration import check_pattern, position_from_ranges
from estimator.spots.correspondences import centroids_px, find_correspondences, led_positions_m

Floats = NDArray[np.float64]

# Height differences below which the ceiling counts as one: at 3 m a ratio of ranges changes by a third of their share,
# 0.1 %, as by 0.3 % of flux.
MAX_HEIGHTS_M = 0.01


def eca_rssr(frame: DeviceFrame) -> Estimate:
    """Position from ratios of received power; raises EstimationFailure."""
    correspondences = with_power(find_correspondences(frame))
    leds_m = led_positions_m(correspondences)
    check_pattern(leds_m, needed=3, flat=True)
    if np.ptp(leds_m[:, 2]) > MAX_HEIGHTS_M:
        raise EstimationFailure("power", f"the LEDs' heights differ by more than {MAX_HEIGHTS_M:g} m")
    image = pinhole_image(centroids_px(correspondences), frame.camera)
    distances_m = ranges_from_ratios(leds_m, image, fluxes(correspondences))
    ranges_m = {one.led.id: float(d) for one, d in zip(correspondences, distances_m, strict=True)}
    try:
        return Estimate(position_from_ranges(leds_m, distances_m), ranges_m)
    except EstimationFailure as failure:
        raise EstimationFailure(failure.stage, failure.why, ranges_m) from None


def ranges_from_ratios(leds_m: Floats, image: Floats, flux: Floats) -> Floats:
    """Distances (n,), metres, to LEDs (n, 3) at one height, from spots (n, 2) at unit depth and fluxes of any unit."""
    rays = np.column_stack([image, np.ones(len(image))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ends = np.cbrt(rays[:, 2] / flux)[:, None] * rays
    a, b = np.triu_indices(len(leds_m), k=1)
    of_ends = np.linalg.norm(ends[a] - ends[b], axis=1)
    apart_m = np.linalg.norm(leds_m[a] - leds_m[b], axis=1)
    return np.asarray(np.linalg.norm(ends, axis=1) * (apart_m @ of_ends) / (of_ends @ of_ends))


ECA_RSSR = Variant(
    "eca-rssr",
    "Bai et al. 2020: ratios of ranges from ratios of received power, the law of cosines, linear least squares",
    eca_rssr,
    needs=Needs(3, sizes=True),
)
