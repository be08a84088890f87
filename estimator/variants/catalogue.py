"""The named pipelines: from what a device has, one frame, to where it is."""

from estimator.errors import InputError
from estimator.variants.gravity_fit import GRAVITY_FIT
from estimator.variants.huynh2016 import HUYNH2016, HUYNH2016_AS_PRINTED, huynh2016_with
from estimator.variants.kim import KIM
from estimator.variants.maximum_likelihood import ML
from estimator.variants.nakazawa2013 import NAKAZAWA2013
from estimator.variants.pnp import IPPE, PNP, SQPNP
from estimator.variants.rahman2011 import RAHMAN2011
from estimator.variants.up2p import UP2P
from estimator.variants.variant import Variant
from estimator.variants.yoshino2008 import YOSHINO2008

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
    )
}
STAGED = {"huynh2016": huynh2016_with}
"""Pipelines whose stages can be chosen after a colon, by name: from the whole text to the variant."""


def variant_named(name: str) -> Variant:
    """The variant of this name, or of `NAME:stage=value,...` (estimator/variants/options.py); raises InputError."""
    base, colon, _ = name.partition(":")
    if colon and base in STAGED:
        return STAGED[base](name)
    if colon and base in VARIANTS:
        raise InputError(f"variant {name}: {base} has no stages to choose; those that have: {', '.join(STAGED)}")
    if name not in VARIANTS:
        raise InputError(f"variant {name}: unknown; allowed: {', '.join(VARIANTS)}")
    return VARIANTS[name]
