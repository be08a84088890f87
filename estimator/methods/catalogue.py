"""Catalogue of this package's variants, by name."""

from estimator.errors import InputError
from estimator.methods.circle_centre import CIRCLE_CENTRE
from estimator.methods.eca_rssr import ECA_RSSR
from estimator.methods.gopa import GOPA
from estimator.methods.gravity_fit import GRAVITY_FIT, gravity_fit_with
from estimator.methods.huynh2016 import HUYNH2016, HUYNH2016_AS_PRINTED, huynh2016_with
from estimator.methods.kim import KIM
from estimator.methods.lc_vlp import LC_VLP
from estimator.methods.maximum_likelihood import ML
from estimator.methods.nakazawa2013 import NAKAZAWA2013
from estimator.methods.pnp import IPPE, PNP, SQPNP
from estimator.methods.r_p3p import R_P3P
from estimator.methods.rahman2011 import RAHMAN2011
from estimator.methods.self_calibrated import SELF_CALIBRATED
from estimator.methods.up2p import UP2P, up2p_with
from estimator.methods.v_p4l import V_P4L
from estimator.methods.v_pca import V_PCA
from estimator.methods.variant import Variant
from estimator.methods.yoshino2008 import YOSHINO2008

VARIANTS = {
    variant.name: variant
    for variant in (
        HUYNH2016,
        HUYNH2016_AS_PRINTED,
        YOSHINO2008,
        NAKAZAWA2013,
        RAHMAN2011,
        KIM,
        PNP,
        IPPE,
        SQPNP,
        UP2P,
        GRAVITY_FIT,
        ML,
        SELF_CALIBRATED,
    )
}
"""Variants that run by default."""
PUBLISHED_SINCE = {variant.name: variant for variant in (GOPA, ECA_RSSR, R_P3P, V_P4L, V_PCA, CIRCLE_CENTRE, LC_VLP)}
"""Methods published since the paper, in the order of publication. They run where they are named.

Each needs what many datasets lack (one luminance of all LEDs, square faces, LED images of some size), and the four that
find contours take longer than the detection of spots.
"""
OWN = VARIANTS | PUBLISHED_SINCE
"""All variants of this package."""
STAGED = {"huynh2016": huynh2016_with, "gravity-fit": gravity_fit_with, "up2p": up2p_with}
"""Variants with options after a colon, by name: a function from the whole text to the variant."""


def variant_named(name: str) -> Variant:
    """The variant of a name, or of a name with options, `NAME:option=value,...`; raises InputError."""
    base, colon, _ = name.partition(":")
    if colon and base in STAGED:
        return STAGED[base](name)
    if colon and base in OWN:
        raise InputError(f"variant {name}: {base} has no options; those that have: {', '.join(STAGED)}")
    if name not in OWN:
        raise InputError(f"variant {name}: unknown; allowed: {', '.join(OWN)}")
    return OWN[name]
