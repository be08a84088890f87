"""Blobs of LED images, closed along the readout axis over dark stripes, and their light above the background."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.spots.detect import MAX_BLOBS, MIN_BLOB_PX
from estimator.spots.led_light import Readout

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Along = Literal["rows", "columns"]

# Pixels beyond an LED image that hold its blur, and those beyond them that give each line's background.
GAP_PX = 4
RING_PX = 8
MIN_RING_PIXELS = 4


@dataclass(frozen=True, eq=False)
class TurnedRegion:
    """A region with lines as rows: views of the readout's arrays."""

    line: int
    across: int
    electrons: NDArray[np.float32]
    clipped: Mask
    floor_e2: float
    prnu: float

    @classmethod
    def of(cls, readout: Readout, along: Along) -> "TurnedRegion":
        """The readout, transposed if lines are columns."""
        if along == "rows":
            return cls(readout.row, readout.column, readout.raw_e, readout.clipped, readout.floor_e2, readout.prnu)
        return cls(readout.column, readout.row, readout.raw_e.T, readout.clipped.T, readout.floor_e2, readout.prnu)


def closed_along_readout(mask: NDArray[np.uint8], stripe_px: float) -> NDArray[np.uint8]:
    """The mask, closed along its columns over gaps of `stripe_px` lines."""
    length = int(np.ceil(stripe_px)) + 1
    padded = cv2.copyMakeBorder(mask, length, length, 0, 0, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((length, 1), np.uint8))
    return np.ascontiguousarray(closed[length:-length])


@dataclass(frozen=True, eq=False)
class StripedBlob:
    """A connected part of a closed mask: its upright box and its pixels in it, and the pixels of other blobs there."""

    left: int
    top: int
    right: int
    bottom: int
    own: Mask
    others: Mask
    area_px: int


def blobs_of(closed: NDArray[np.uint8], largest_px: float) -> list[StripedBlob]:
    """Blobs of a closed mask, the largest first; the box of each is wider by what gives its background."""
    outlines, nesting = cv2.findContours(closed, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return []
    outer = [one for one, (*_, parent) in zip(outlines, nesting[0], strict=True) if parent < 0]
    blobs = []
    around = GAP_PX + RING_PX
    height, width = closed.shape
    for outline in sorted(outer, key=len, reverse=True)[:MAX_BLOBS]:
        left, top, columns, rows = cv2.boundingRect(outline)
        x0, y0 = max(left - around, 0), max(top - around, 0)
        x1, y1 = min(left + columns + around, width), min(top + rows + around, height)
        if (x1 - x0) * (y1 - y0) > 4 * largest_px:
            continue
        labels = cv2.connectedComponents(np.ascontiguousarray(closed[y0:y1, x0:x1]), connectivity=8)[1]
        column, row = outline[0, 0]
        own = labels == labels[row - y0, column - x0]
        area = int(np.count_nonzero(own))
        if MIN_BLOB_PX <= area <= largest_px:
            blobs.append(StripedBlob(x0, y0, x1, y1, own, (labels > 0) & ~own, area))
    return blobs


@dataclass(frozen=True, eq=False)
class BlobLight:
    """Light of a blob's box, (rows, columns): electrons above each line's background, and their variances."""

    signal: Floats
    variance: Floats
    usable: Mask
    background_variance: Floats


def light_of(turned: TurnedRegion, blob: StripedBlob, background_e: float) -> BlobLight:
    """Light of a blob above the background of each line, which the pixels beside the blob give."""
    box = np.s_[blob.top : blob.bottom, blob.left : blob.right]
    electrons = turned.electrons[box].astype(np.float64)
    usable = ~cv2.dilate(blob.others.view(np.uint8), np.ones((3, 3), np.uint8)).view(np.bool_)
    # The lines of a flickering room have backgrounds of their own, beside the LED image.
    near = cv2.dilate(blob.own.view(np.uint8), np.ones((2 * GAP_PX + 1, 2 * GAP_PX + 1), np.uint8)).view(np.bool_)
    ring = usable & ~near
    count = ring.sum(axis=1)
    whole_e = float(np.median(electrons[ring])) if ring.any() else background_e
    sums = np.where(ring, electrons, 0.0).sum(axis=1)
    enough = count >= MIN_RING_PIXELS
    lines_e = np.where(enough, sums / np.maximum(count, 1), whole_e)
    raw = np.maximum(electrons, 0.0)
    variance = raw + turned.floor_e2 + (turned.prnu * raw) ** 2
    background_variance = (np.maximum(lines_e, 0.0) + turned.floor_e2) / np.maximum(count, MIN_RING_PIXELS)
    return BlobLight(electrons - lines_e[:, None], variance, usable, background_variance)
