"""The named pipelines: from what a device has, one frame, to where it is."""

from estimator.dataset import DeviceFrame
from estimator.huynh2016 import huynh2016, huynh2016_as_printed
from estimator.pipeline import Estimate, Variant
from estimator.position import position_from_pixels
from estimator.sighting import centroids_px, led_positions_m, sightings
from estimator.undistort import pinhole_pixels


def pnp(frame: DeviceFrame) -> Estimate:
    """Perspective-n-point on centroids of the raw image; gravity is not used."""
    seen = sightings(frame)
    pixels = pinhole_pixels(centroids_px(seen), frame.camera)
    return Estimate(position_from_pixels(led_positions_m(seen), pixels, frame.camera.matrix()))


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
