"""Look of a variant in pages and plots: hue by family, mark by member. It is fixed by the variant's name alone."""

import zlib
from typing import Literal, get_args

from estimator.io.records import Row

Family = Literal["pixels", "gravity", "spots", "paper", "published", "other"]
Mark = Literal["disc", "square", "triangle", "diamond", "down", "star"]
FAMILIES: tuple[str, ...] = get_args(Family)
MARKS: tuple[str, ...] = get_args(Mark)


class Look(Row):
    """Family, which gives the hue; mark; and whether the mark is hollow and the curve dashed."""

    family: Family
    mark: Mark
    hollow: bool = False


OWN_LOOKS = {
    "ml": Look(family="pixels", mark="disc"),
    "gravity-fit": Look(family="gravity", mark="square"),
    "up2p": Look(family="gravity", mark="triangle"),
    "self-calibrated": Look(family="gravity", mark="diamond"),
    "pnp": Look(family="spots", mark="square"),
    "ippe": Look(family="spots", mark="triangle"),
    "sqpnp": Look(family="spots", mark="diamond"),
    "yoshino2008": Look(family="spots", mark="disc"),
    "huynh2016": Look(family="paper", mark="diamond"),
    "huynh2016-as-printed": Look(family="paper", mark="diamond", hollow=True),
    "kim": Look(family="published", mark="disc"),
    "rahman2011": Look(family="published", mark="square"),
    "nakazawa2013": Look(family="published", mark="triangle"),
    "gopa": Look(family="published", mark="diamond", hollow=True),
    "eca-rssr": Look(family="published", mark="down", hollow=True),
    "circle-centre": Look(family="published", mark="disc", hollow=True),
    "lc-vlp": Look(family="published", mark="star", hollow=True),
    "r-p3p": Look(family="spots", mark="down", hollow=True),
    "v-p4l": Look(family="spots", mark="star", hollow=True),
    "v-pca": Look(family="spots", mark="diamond", hollow=True),
}
"""Looks of this package's variants; the methods published since the paper are hollow."""


def look_of(name: str, family: str = "", mark: str = "") -> Look:
    """Look of a variant by its name; `family` and `mark` are those that a plug-in states, where it states them.

    A variant with options has its parent's family, hollow, with a mark by the CRC-32 of the whole name. A plug-in is of
    the family `other`, hollow, with a mark by the CRC-32 of its name. Two such names may have one look: labels then
    tell them apart.
    """
    if name in OWN_LOOKS:
        return OWN_LOOKS[name]
    parent = OWN_LOOKS.get(name.partition(":")[0])
    by_name = MARKS[zlib.crc32(name.encode()) % len(MARKS)]
    if parent is not None:
        return Look(family=parent.family, mark=by_name, hollow=True)  # type: ignore[arg-type]
    stated = family if family in FAMILIES else "other"
    return Look(family=stated, mark=mark if mark in MARKS else by_name, hollow=mark not in MARKS)  # type: ignore[arg-type]
