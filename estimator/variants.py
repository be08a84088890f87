"""The named pipelines: from what a device has, one frame, to where it is."""

from estimator.gravity_fit import GRAVITY_FIT
from estimator.huynh2016 import huynh2016, huynh2016_as_printed
from estimator.maximum_likelihood import ML
from estimator.pipeline import Variant
from estimator.pnp import IPPE, PNP, SQPNP
from estimator.upright import UP2P

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
        PNP,
        IPPE,
        SQPNP,
        UP2P,
        GRAVITY_FIT,
        ML,
    )
}
